"""Which solver when: explicit against implicit as the servos get stiffer.

The seven-body UAV (uav_tracker, case 2) with its sliders held by servos of 1e4 to 1e7 N/m, by
end stops, by friction, or not at all: steps, run time and position error over 1 s of Dopri8 and
Tsit5 (explicit) and Kvaerno5 (implicit) at tolerances 1e-4 to 1e-8, with the largest
eigenvalue of the equations of motion. The reference is Dopri8 at 1e-11, checked by Kvaerno5.

All scenes hold the same force elements and differ in numbers only, so that one compilation per
solver serves them all: a servo that is not there has no stiffness and no damping, friction that
is not there no force, and end stops that are not there are 100 m away. Every scene therefore pays
for all elements, in every solver alike.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from sections import stiff_page
from shared.clock import compiled, ready, rounded, timed
from shared.command import benchmark
from shared.methods import trajectory

import stmuav_jax as stm

LEVELS = (1e-4, 1e-6)  # m
FAR = 100.0  # m
TIGHT = 1e-11
SOLVERS: dict[str, Any] = {
    "dopri8": diffrax.Dopri8, "tsit5": diffrax.Tsit5, "kvaerno5": stm.dynamics.kvaerno5,
}  # fmt: skip
EXPLICIT, IMPLICIT = ("dopri8", "tsit5"), ("kvaerno5",)


@dataclass(frozen=True)
class StiffScene:
    """What holds the sliders: servo stiffness [N/m] and damping [N s/m], stops, friction."""

    name: str
    stiffness: float = 0.0
    damping: float = 0.0
    stops: bool = False
    friction: bool = False

    def uav(self) -> stm.Scene:
        """uav_tracker, case 2."""
        away = stm.uav.Stops() if self.stops else stm.uav.Stops(lower=-FAR, upper=FAR)
        rubbing = stm.uav.Friction() if self.friction else stm.uav.Friction(coulomb=0.0)
        servo = stm.uav.Servo(self.stiffness, self.damping)
        return stm.make_scene("uav_tracker", 2, servo=servo, stops=away, friction=rubbing)

    def slider(self) -> stm.Scene:
        """One body on a guide with a servo: a stand-in for the smoke test."""
        body = stm.Body("slider", 1.0, (1e-2, 1e-2, 1e-2))
        guide = stm.translational("guide", "ground", "slider", axis=(0.0, 0.0, 1.0))
        servo = stm.mechanics.JointServo(
            "guide", stiffness=self.stiffness, damping=self.damping, target=1e-3
        )
        system = stm.System([body], [guide], [stm.Gravity(), servo])
        return stm.Scene(self.name, "A slider with a servo", system, system.reference)


FREE = StiffScene("free")
SERVOS = tuple(StiffScene(f"servo {k:.0e}", k, 9e-4 * k) for k in (1e4, 1e5, 1e6, 1e7))
STIFFEST = StiffScene("stiffest servo", 1e7, 6e4)
STOPS = replace(FREE, name="end stops", stops=True)
FRICTION = replace(FREE, name="friction", friction=True)
SCENES = (FREE, *SERVOS, STIFFEST, STOPS, FRICTION)


@dataclass(frozen=True)
class Size:
    """How much is run.

    Attributes:
        pieces: of the path along which eigenvalues are taken.
    """

    build: Callable[[StiffScene], stm.Scene] = StiffScene.uav
    scenes: tuple[StiffScene, ...] = SCENES
    solvers: tuple[str, ...] = (*EXPLICIT, *IMPLICIT)
    tolerances: tuple[float, ...] = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
    t1: float = 1.0
    pieces: int = 50
    repeats: int = 3


QUICK = Size(
    StiffScene.slider,
    SERVOS[::3],
    ("dopri8", "kvaerno5"),
    (1e-6, 1e-8),
    t1=0.1,
    pieces=2,
    repeats=1,
)


def as_given(scene: stm.Scene) -> tuple[stm.System, stm.State]:
    """System and start as arrays that are not weakly typed, so that all scenes share a trace."""
    strong = lambda x: jnp.asarray(x, x.dtype) if eqx.is_array(x) else x
    return jax.tree.map(strong, (scene.system, scene.state0))


class Runner:
    """Runs with output at the start, the middle and the end, compiled on first use."""

    def __init__(self, t1: float, repeats: int) -> None:
        self.ends, self.repeats = jnp.array([0.0, 0.5 * t1, t1]), repeats
        self.calls: dict[str, Any] = {}
        self.compile_seconds: dict[str, float] = {}

    def prepared(self, solver: str, *given: Any) -> Any:
        """The integration by a solver, compiled for (system, state, ts, tolerance)."""
        if solver not in self.calls:
            run = trajectory(stm.Tree(), SOLVERS[solver]())
            done, seconds = compiled(run, *given, clock=time.process_time)
            self.calls[solver], self.compile_seconds[solver] = done, seconds
        return self.calls[solver]

    def positions(self, found: Any) -> np.ndarray:
        """Positions (2, n, 3) [m] behind the start; not numbers if the run did not reach the end."""
        there = bool(np.all(np.asarray(found.ts) >= np.asarray(self.ends) * (1 - 1e-12)))
        positions = np.asarray(found.states.r[1:])
        return positions if there else np.full_like(positions, np.nan)

    def tight(self, solver: str, scene: stm.Scene) -> np.ndarray:
        """Positions (2, n, 3) [m] at the middle and the end, at the tightest tolerance."""
        given = (*as_given(scene), self.ends, jnp.asarray(TIGHT))
        return self.positions(self.prepared(solver, *given)(*given))

    def run(self, solver: str, tol: float, scene: stm.Scene, exact: np.ndarray) -> dict[str, Any]:
        """One timed run: counts, seconds, largest position error over all bodies [m]."""
        given = (*as_given(scene), self.ends, jnp.asarray(tol))
        cost, found = timed(self.prepared(solver, *given), *given, repeats=self.repeats)
        found = ready(found)
        off = np.max(np.linalg.norm(self.positions(found) - exact, axis=-1), axis=-1)
        return {
            "solver": solver, "tolerance": tol,
            "accepted": int(found.counts.accepted[-1]),
            "rejected": int(found.counts.rejected[-1]),
            "seconds": rounded(cost.processor.median), "cost": cost.to_dict(),
            "error_middle": rounded(off[0]), "error_end": rounded(off[1]),
            "error": rounded(np.max(off)), "completed": bool(np.all(np.isfinite(off))),
        }  # fmt: skip

    def along(self, scene: stm.Scene, pieces: int, tol: float) -> Iterator[tuple[float, stm.State]]:
        """Times and states along a run by Kvaerno5: pieces of two, in the same compilation."""
        system, state = as_given(scene)
        times = np.linspace(0.0, float(self.ends[-1]), 2 * pieces + 1)
        yield 0.0, state
        for k in range(pieces):
            given = (system, state, jnp.asarray(times[2 * k : 2 * k + 3]), jnp.asarray(tol))
            found = self.prepared("kvaerno5", *given)(*given)
            for i in (1, 2):
                state = jax.tree.map(lambda x, i=i: x[i], found.states)
                yield float(times[2 * k + i]), state

    def eigenvalues(self, scene: stm.Scene, pieces: int) -> dict[str, Any]:
        """The eigenvalue of df/dx that is largest in size, at the start and along the run."""
        system, _ = as_given(scene)
        values, times = [], []
        for t, state in self.along(scene, pieces, 1e-8):
            if not np.all(np.isfinite(state.r)):
                break
            values.append(stm.dynamics.spectrum(system, state, t)[0])
            times.append(t)
        sizes = np.abs(values)
        peak = int(np.argmax(sizes))
        parts = lambda value: [rounded(value.real), rounded(value.imag)]
        return {
            "start": rounded(sizes[0]), "start_value": parts(values[0]),
            "median": rounded(np.median(sizes)),
            "largest": rounded(sizes[peak]), "largest_value": parts(values[peak]),
            "largest_at": times[peak], "states": len(times),
        }  # fmt: skip


def run_scene(held: StiffScene, size: Size, runner: Runner) -> dict[str, Any]:
    """All solvers on one scene."""
    scene = size.build(held)
    exact, other = runner.tight("dopri8", scene), runner.tight("kvaerno5", scene)
    apart = np.max(np.linalg.norm(exact - other, axis=-1), axis=-1)
    runs = []
    for solver in size.solvers:
        for tol in size.tolerances:
            row = runner.run(solver, tol, scene, exact)
            runs.append(row)
            said = f"{row['seconds']:.3g} s, {row['error']} m"
            print(f"{held.name}: {solver} {tol:g}: {said}", flush=True)
    return {
        **asdict(held),
        "reference": {"tolerance": TIGHT, "kvaerno5_apart": rounded(apart)},
        "eigenvalue": runner.eigenvalues(scene, size.pieces),
        "runs": runs,
        "cheapest": {str(level): cheapest(runs, level) for level in LEVELS},
    }


def cheapest(runs: list[dict[str, Any]], level: float) -> dict[str, Any]:
    """The fastest explicit and implicit run with an error up to the level, and their ratio."""

    def best(solvers: tuple[str, ...]) -> dict[str, Any] | None:
        mine = [row for row in runs if row["solver"] in solvers and row["completed"]]
        fine = [row for row in mine if row["error"] <= level]
        return min(fine, key=lambda row: row["seconds"], default=None)

    explicit, implicit = best(EXPLICIT), best(IMPLICIT)
    ratio = rounded(explicit["seconds"] / implicit["seconds"]) if explicit and implicit else None
    return {"explicit": explicit, "implicit": implicit, "explicit_over_implicit": ratio}


def crossover(scenes: list[dict[str, Any]], level: float) -> dict[str, Any]:
    """Between which servos, and which largest eigenvalues at the start, implicit begins to pay.

    Of the scenes with a servo only, in order of the eigenvalue: the last below which explicit is
    always faster, the first from which implicit always is.
    """
    servos = [s for s in scenes if s["stiffness"] > 0]
    rows = sorted(servos, key=lambda s: s["eigenvalue"]["start"])
    ratios = [s["cheapest"][str(level)]["explicit_over_implicit"] for s in rows]
    pays = [ratio is not None and ratio > 1 for ratio in ratios]
    first = next((i for i in range(len(rows)) if all(pays[i:])), None)
    last = next((i - 1 for i in range(len(rows)) if pays[i]), len(rows) - 1)

    def of(index: int | None) -> dict[str, Any] | None:
        if index is None or index < 0:
            return None
        row = rows[index]
        about = {key: row[key] for key in ("name", "stiffness", "damping")}
        about["eigenvalue_at_start"] = row["eigenvalue"]["start"]
        return {**about, "explicit_over_implicit": ratios[index]}

    return {"explicit_up_to": of(last), "implicit_from": of(first)}


def record(size: Size) -> Iterator[dict[str, Any]]:
    """All scenes."""
    runner = Runner(size.t1, size.repeats)
    scenes = [run_scene(held, size, runner) for held in size.scenes]
    yield {
        "what": "explicit and implicit solvers on scenes of growing stiffness",
        "seconds": "processor time of the process on one core",
        "t1": size.t1,
        "compile_seconds": {k: rounded(v) for k, v in runner.compile_seconds.items()},
        "scenes": scenes,
        "crossover": {str(level): crossover(scenes, level) for level in LEVELS},
    }


if __name__ == "__main__":
    benchmark("stiff", __doc__, record, (Size(), QUICK), stiff_page.show)
