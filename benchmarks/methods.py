"""Our methods behind the same adapter as the peers, and compilation timed apart from running."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from adapter import Outcome, Peer, Prepared, Setting
from timer import measure

import stmuav_jax as sj
from stmuav_jax.dynamics.explicit import coefficients
from stmuav_jax.dynamics.rosenbrock import Rodas5P

STEPS = 1_000_000
# Stages of a Rosenbrock step; its Jacobian comes on top.
RODAS_STAGES = 8


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """A function compiled for arguments of this kind, and the seconds for trace and compilation.

    What JAX remembers of traces is dropped first: another method's would shorten this one's.
    """
    jax.clear_caches()
    jitted: Any = sj.outer_jit(function)
    timing, program = measure(lambda: jitted.lower(*arguments).compile(), repeats=1, warm_up=0)
    return program, timing.median


def trajectory(formulation: Any, solver: Any, adjoint: Any = None, steps: int = STEPS) -> Any:
    """(system, state0, ts, tolerance) -> `Trajectory`; one compilation for all tolerances."""
    # runs that are not differentiated need no steps that are safe for derivatives
    kind = "state" if adjoint is None else "sensitivities"
    adjoint = diffrax.ForwardMode() if adjoint is None else adjoint

    def run(system: Any, state0: Any, ts: Any, tolerance: Any) -> sj.Trajectory:
        method = sj.Method(
            formulation=formulation,
            solver=solver,
            rtol=tolerance,
            atol=tolerance,
            adjoint=adjoint,
            max_steps=steps,
            steps=kind,
        )
        return sj.integrate(system, state0, ts, method)

    return run


def evaluations(solver: Any, steps: int) -> int | None:
    """Accelerations in so many attempted steps; None for iterative solvers, which do not count."""
    if isinstance(solver, Rodas5P):
        return RODAS_STAGES * steps
    if isinstance(solver, diffrax.AbstractERK):
        return len(coefficients(solver)[3]) * steps
    return None


def label(formulation: Any) -> str:
    """A formulation in words."""
    if isinstance(formulation, sj.Tree):
        return "tree"
    return "augmented" if formulation.solve == "structured" else "augmented, dense"


def watched(run: Any) -> Any:
    """A `trajectory` that also returns whether it reached the end, found out inside the program."""

    def both(*arguments: Any) -> tuple[sj.Trajectory, Any]:
        path = run(*arguments)
        return path, path.result == diffrax.RESULTS.successful

    return both


def outcome(path: sj.Trajectory, fine: Any, solver: Any) -> Outcome:
    """A trajectory in the suite's words, the start left out.

    In NumPy: what is asked of JAX's arrays here would be compiled, and timed, with the first run.
    """
    accepted, rejected = (
        int(np.asarray(count)[-1]) for count in (path.counts.accepted, path.counts.rejected)
    )
    positions = np.asarray(path.states.r)[1:]
    failure = ""
    if not bool(np.asarray(fine)):
        failure = " ".join(str(diffrax.RESULTS[path.result]).split())[:120]
    elif not np.all(np.isfinite(positions)):
        failure = "The state is not finite."
    return Outcome(
        positions,
        evaluations(solver, accepted + rejected),
        accepted,
        rejected,
        residual=float(np.asarray(path.worst.position)[-1]),
        failure=failure,
    )


class Ours(Peer):
    """One formulation with one solver; compiled once for all tolerances and horizons."""

    def __init__(self, formulation: Any, solver: Any, tolerances: tuple[float, ...]) -> None:
        self.formulation, self.solver = formulation, solver
        self.solver_name = type(solver).__name__
        self.name = f"stmuav-jax, {label(formulation)}"
        self._settings = [Setting(self.solver_name, tolerance=x) for x in tolerances]
        self._kept: dict[str, tuple[Any, float]] = {}
        if isinstance(solver, Rodas5P):
            self.caveats = ("Jacobians, one a step, are not counted as evaluations.",)

    def missing(self) -> str:
        return ""

    def version(self) -> str:
        return sj.__version__

    def settings(self) -> list[Setting]:
        return self._settings

    def prepare(self, scene: sj.Scene, times: np.ndarray, setting: Setting) -> Prepared:
        ts = jnp.asarray([scene.t0, *times], float)
        tolerance = jnp.asarray(setting.tolerance, float)
        arguments = (scene.system, scene.state0, ts, tolerance)
        key = scene.name
        if key not in self._kept:
            run = watched(trajectory(self.formulation, self.solver))
            self._kept[key] = compiled(run, *arguments)
        program, seconds = self._kept[key]

        def run() -> Outcome:
            path, fine = program(*arguments)
            return outcome(path, fine, self.solver)

        return Prepared(run, seconds)


def explicit(tolerances: tuple[float, ...], *, redundant: bool = False) -> list[Ours]:
    """Both formulations with both explicit solvers."""
    return [
        Ours(formulation, solver, tolerances)
        for formulation in (sj.Tree(redundant=redundant), sj.Augmented(redundant=redundant))
        for solver in (diffrax.Dopri8(), diffrax.Tsit5())
    ]


def for_stiff(tolerances: tuple[float, ...]) -> list[Ours]:
    """Explicit and implicit solvers on the spanning tree."""
    solvers = (diffrax.Tsit5(), Rodas5P(), sj.kvaerno5())
    return [Ours(sj.Tree(), solver, tolerances) for solver in solvers]


def peers() -> tuple[list[Peer], list[dict[str, str]]]:
    """Installed peers, and those that are not, with the reason."""
    try:
        from peers import PEERS  # pyright: ignore[reportAttributeAccessIssue]
    except ImportError as error:
        return [], [{"method": "peers", "reason": f"{type(error).__name__}: {error}"}]
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
