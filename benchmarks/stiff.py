"""Which solver when: explicit against implicit as the servos get stiffer.

The seven-body UAV (uav_tracker, case 2) with its sliders held by servos of 1e4 to 1e7 N/m, by
end stops, by friction, or not at all: steps, run time and position error over 1 s of Dopri8 and
Tsit5 (explicit) and Rodas5P and Kvaerno5 (implicit) at tolerances 1e-4 to 1e-8, with the largest
eigenvalue of the equations of motion. The reference is Rodas5P at 1e-11, checked by Dopri8.

All scenes share one compilation per solver (stiffness/scenes.py says at what cost).
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from shared.clock import rounded
from shared.command import benchmark
from stiffness.pages import show
from stiffness.runs import EXPLICIT, IMPLICIT, TIGHT, Runner
from stiffness.scenes import SCENES, SERVOS, Build, StiffScene

LEVELS = (1e-4, 1e-6)  # m


@dataclass(frozen=True)
class Size:
    """How much is run.

    Attributes:
        pieces: of the path along which eigenvalues are taken.
    """

    build: Build = StiffScene.uav
    scenes: tuple[StiffScene, ...] = SCENES
    solvers: tuple[str, ...] = (*EXPLICIT, *IMPLICIT)
    tolerances: tuple[float, ...] = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
    t1: float = 1.0
    pieces: int = 50
    repeats: int = 3


QUICK = Size(
    StiffScene.slider, SERVOS[::3], ("dopri8", "rodas5p"), (1e-6, 1e-8), t1=0.1, pieces=2, repeats=1
)


def run_scene(held: StiffScene, size: Size, runner: Runner) -> dict[str, Any]:
    """All solvers on one scene."""
    scene = size.build(held)
    exact, other = runner.tight("rodas5p", scene), runner.tight("dopri8", scene)
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
        "reference": {"tolerance": TIGHT, "dopri8_apart": rounded(apart)},
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
    ratio = None
    if explicit is not None and implicit is not None:
        ratio = rounded(explicit["seconds"] / implicit["seconds"])
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
        keys = ("name", "stiffness", "damping")
        return {
            **{key: rows[index][key] for key in keys},
            "eigenvalue_at_start": rows[index]["eigenvalue"]["start"],
            "explicit_over_implicit": ratios[index],
        }

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


def main() -> None:
    """Run and write `stiff.json`."""
    benchmark("stiff", __doc__, record, (Size(), QUICK), show)


if __name__ == "__main__":
    main()
