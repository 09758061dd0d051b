"""Which solver when: explicit against implicit as the servos get stiffer.

The seven-body UAV (uav_tracker, case 2) with its sliders held by servos of 1e4 to 1e7 N/m, by
end stops, by friction, or not at all: steps, run time and position error over 1 s of Dopri8 and
Tsit5 (explicit) and Rodas5P and Kvaerno5 (implicit) at tolerances 1e-4 to 1e-8, with the largest
eigenvalue of the equations of motion. The reference is Rodas5P at 1e-11, checked by Dopri8.

All scenes share one compilation per solver (stiff_scenes.py says at what cost).
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from record import add_options, begin, write
from stiff_figures import draw
from stiff_runs import EXPLICIT, IMPLICIT, TIGHT, Runner
from stiff_scenes import SCENES, SERVOS, Build, StiffScene
from stiff_tables import tables
from trial import rounded

FIGURES = Path(__file__).parents[1] / "docs" / "figures" / "benchmarks"
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
    build=StiffScene.slider,
    scenes=SERVOS[::3],
    solvers=("dopri8", "rodas5p"),
    tolerances=(1e-6, 1e-8),
    t1=0.1,
    pieces=2,
    repeats=1,
)


def run_scene(held: StiffScene, size: Size, runner: Runner) -> dict[str, Any]:
    """All solvers on one scene."""
    scene = size.build(held)
    exact, other = runner.tight("rodas5p", scene), runner.tight("dopri8", scene)
    apart = np.max(np.linalg.norm(exact - other, axis=-1), axis=-1)
    runs = []
    for solver in size.solvers:
        for tol in size.tolerances:
            runs.append(runner.run(solver, tol, scene, exact))
            row = runs[-1]
            print(
                f"{held.name}: {solver} {tol:g}: {row['seconds']:.3g} s, {row['error']} m",
                flush=True,
            )
    return {
        "name": held.name,
        "stiffness": held.stiffness,
        "damping": held.damping,
        "stops": held.stops,
        "friction": held.friction,
        "reference": {"tolerance": TIGHT, "dopri8_apart": rounded(apart)},
        "eigenvalue": runner.eigenvalues(scene, size.pieces),
        "runs": runs,
        "cheapest": {str(level): cheapest(runs, level) for level in LEVELS},
    }


def cheapest(runs: list[dict[str, Any]], level: float) -> dict[str, Any]:
    """The fastest explicit and implicit run with an error up to the level, and their ratio."""

    def best(solvers: tuple[str, ...]) -> dict[str, Any] | None:
        fine = [
            row
            for row in runs
            if row["solver"] in solvers and row["completed"] and row["error"] <= level
        ]
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


def record(size: Size) -> dict[str, Any]:
    """All scenes."""
    jax.config.update("jax_enable_x64", True)
    runner = Runner(size.t1, size.repeats)
    scenes = [run_scene(held, size, runner) for held in size.scenes]
    return {
        "what": "explicit and implicit solvers on scenes of growing stiffness",
        "seconds": "processor time of the process on one core",
        "t1": size.t1,
        "compile_seconds": {k: rounded(v) for k, v in runner.compile_seconds.items()},
        "scenes": scenes,
        "crossover": {str(level): crossover(scenes, level) for level in LEVELS},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a stand-in of one body, few runs")
    add_options(parser)
    parser.add_argument("--figures", type=Path, default=FIGURES)
    options = parser.parse_args()
    begin(options)
    path = write("stiff", record(QUICK if options.quick else Size()), options.results)
    print(tables(path))
    print(path, *draw(path, options.figures))


if __name__ == "__main__":
    main()
