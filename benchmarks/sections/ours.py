"""Our methods behind the same adapter as the peers, and compilation timed apart from running."""

from functools import partial
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from peers import PEERS
from peers.adapter import Outcome, Peer, Prepared, Setting
from shared.clock import compiled
from shared.methods import evaluations, trajectory, words

import stmuav_jax as stm


def label(formulation: Any) -> str:
    """A formulation in words."""
    return "tree" if isinstance(formulation, stm.Tree) else "augmented"


def outcome(path: stm.dynamics.Trajectory, fine: Any, solver: Any) -> Outcome:
    """A trajectory in the suite's words, the start left out.

    In NumPy: what is asked of JAX's arrays here would be compiled, and timed, with the first run.
    """
    counts = path.counts.accepted, path.counts.rejected
    accepted, rejected = (int(np.asarray(count)[-1]) for count in counts)
    positions = np.asarray(path.states.r)[1:]
    failure = "" if bool(np.asarray(fine)) else words(path.result)
    if not failure and not np.all(np.isfinite(positions)):
        failure = "The state is not finite."
    residual = float(np.asarray(path.worst.position)[-1])
    counted = evaluations(solver, accepted + rejected)
    return Outcome(positions, counted, accepted, rejected, residual, failure=failure)


class Ours(Peer):
    """One formulation with one solver; compiled once for all tolerances and horizons.

    Args:
        known: the system's numbers are known when it is compiled: rows of planar loops that depend on
            others in every posture are then left out.
    """

    def __init__(
        self, formulation: Any, solver: Any, tolerances: tuple[float, ...], *, known: bool = False
    ) -> None:
        self.formulation, self.solver, self.known = formulation, solver, known
        self.solver_name = type(solver).__name__
        self.name = f"stmuav-jax, {label(formulation)}"
        self._settings = [Setting(self.solver_name, tolerance=x) for x in tolerances]
        self._kept: dict[str, tuple[Any, float]] = {}

    def version(self) -> str:
        return stm.__version__

    def settings(self, scene: stm.Scene | None = None) -> list[Setting]:
        return self._settings

    def prepare(self, scene: stm.Scene, times: np.ndarray, setting: Setting) -> Prepared:
        ts = jnp.asarray([scene.t0, *times], float)
        tolerance = jnp.asarray(setting.tolerance, float)
        arguments = (scene.state0, ts, tolerance)
        if not self.known:
            arguments = (scene.system, *arguments)
        key = scene.name
        if key not in self._kept:
            of = trajectory(self.formulation, self.solver)
            if self.known:
                of = partial(of, scene.system)

            def watched(*arguments: Any) -> Any:
                """The trajectory, and whether it reached the end, found out in the program."""
                path = of(*arguments)
                return path, path.result == diffrax.RESULTS.successful

            self._kept[key] = compiled(watched, *arguments)
        program, seconds = self._kept[key]

        def run() -> Outcome:
            path, fine = program(*arguments)
            return outcome(path, fine, self.solver)

        return Prepared(run, seconds)


def explicit(tolerances: tuple[float, ...], *, redundant: bool = False) -> list[Ours]:
    """Both formulations with both explicit solvers; `redundant` for planar loops."""
    return [
        Ours(formulation, solver, tolerances, known=redundant)
        for formulation in (stm.Tree(), stm.Augmented())
        for solver in (diffrax.Dopri8(), diffrax.Tsit5())
    ]


def for_stiff(tolerances: tuple[float, ...]) -> list[Ours]:
    """Explicit and implicit solvers on the spanning tree."""
    solvers = (diffrax.Tsit5(), stm.dynamics.kvaerno5())
    return [Ours(stm.Tree(), solver, tolerances) for solver in solvers]


def peers() -> tuple[list[Peer], list[dict[str, str]]]:
    """Installed peers, and those that are not, with the reason."""
    there: list[Peer] = []
    absent = []
    for kind in PEERS:
        try:
            peer = kind()
            reason = peer.missing()
        except Exception as error:
            absent.append({"method": kind.__name__, "reason": f"{type(error).__name__}: {error}"})
            continue
        if reason:
            absent.append({"method": peer.name, "reason": reason})
        else:
            there.append(peer)
    return there, absent
