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
from shared.clock import compiled, measure_processor, rounded
from shared.methods import trajectory
from shared.record import benchmark

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
    StiffScene.slider, SERVOS[::3], ("dopri8", "kvaerno5"), (1e-6, 1e-8), t1=0.1, pieces=2, repeats=1
)  # fmt: skip


def as_given(scene: stm.Scene) -> tuple[stm.System, stm.State]:
    """System and start as arrays that are not weakly typed, so that all scenes share a trace."""
    strong = lambda x: jnp.asarray(x, x.dtype) if eqx.is_array(x) else x
    return jax.tree.map(strong, (scene.system, scene.state0))


class Runner:
    """Runs of (system, state, ts, tolerance), compiled once for each solver and number of times."""

    def __init__(self) -> None:
        self.calls: dict[tuple[str, int], Any] = {}
        self.compile_seconds: dict[str, float] = {}

    def __call__(self, solver: str, scene: stm.Scene, ts: np.ndarray, tol: float) -> Any:
        """Call without arguments that returns a trajectory."""
        given = (*as_given(scene), jnp.asarray(ts), jnp.asarray(tol))
        if (solver, len(ts)) not in self.calls:
            run = trajectory(stm.Tree(), SOLVERS[solver]())
            call, seconds = compiled(run, *given, clock=time.process_time, jit=stm.math.quick_jit)
            self.calls[solver, len(ts)] = call
            self.compile_seconds.setdefault(solver, seconds)
        return lambda: self.calls[solver, len(ts)](*given)


def positions(found: Any, ts: np.ndarray) -> np.ndarray:
    """Positions (k, n, 3) [m] behind the start; not numbers if the run did not reach the end."""
    there = bool(np.all(np.asarray(found.ts) >= ts * (1 - 1e-12)))
    r = np.asarray(found.states.r[1:])
    return r if there else np.full_like(r, np.nan)


def eigenvalues(run: Runner, scene: stm.Scene, size: Size) -> dict[str, Any]:
    """Size of the largest eigenvalue of df/dx, at the start and along a run by Kvaerno5."""
    ts = np.linspace(0.0, size.t1, 2 * size.pieces + 1)
    states, sizes = run("kvaerno5", scene, ts, 1e-8)().states, []
    system, _ = as_given(scene)
    for k, t in enumerate(ts):
        state = jax.tree.map(lambda x, k=k: x[k], states)
        if not np.all(np.isfinite(state.r)):
            break
        sizes.append(np.abs(stm.dynamics.spectrum(system, state, float(t))[0]))
    return {
        "start": rounded(sizes[0]), "median": rounded(np.median(sizes)), "largest": rounded(max(sizes)),
        "states": len(sizes),
    }  # fmt: skip


def run_scene(held: StiffScene, size: Size, run: Runner) -> dict[str, Any]:
    """All solvers on one scene, with output at the start, the middle and the end."""
    scene, ts = size.build(held), np.array([0.0, 0.5 * size.t1, size.t1])
    exact, other = (
        positions(run(solver, scene, ts, TIGHT)(), ts) for solver in ("dopri8", "kvaerno5")
    )
    apart = np.max(np.linalg.norm(exact - other, axis=-1), axis=-1)
    runs = []
    for solver in size.solvers:
        for tol in size.tolerances:
            timing, found = measure_processor(run(solver, scene, ts, tol), repeats=size.repeats)
            off = np.max(np.linalg.norm(positions(found, ts) - exact, axis=-1))
            runs.append({
                "solver": solver, "tolerance": tol,
                "accepted": int(found.counts.accepted[-1]),
                "rejected": int(found.counts.rejected[-1]),
                "seconds": rounded(timing.median), "error": rounded(off),
                "completed": bool(np.isfinite(off)),
            })  # fmt: skip
            print(held.name, runs[-1], flush=True)
    return {
        **asdict(held),
        "reference": {"tolerance": TIGHT, "kvaerno5_apart": rounded(apart)},
        "eigenvalue": eigenvalues(run, scene, size),
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


def record(size: Size) -> Iterator[dict[str, Any]]:
    """All scenes."""
    runner = Runner()
    scenes = [run_scene(held, size, runner) for held in size.scenes]
    yield {
        "what": "explicit and implicit solvers on scenes of growing stiffness",
        "seconds": "processor time of the process on one core",
        "t1": size.t1,
        "compile_seconds": {k: rounded(v) for k, v in runner.compile_seconds.items()},
        "scenes": scenes,
    }


if __name__ == "__main__":
    benchmark("stiff", __doc__, record, (Size(), QUICK))
