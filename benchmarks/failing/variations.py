"""The failure benchmark over other geometries and axes: parts g and b."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from dense.tables import Variant
from failing.events import approaches
from failing.geometry import deviations, sample, varied_scene
from failing.measures import (
    ALL_MISPRINTS,
    DEFAULT,
    FIXED,
    TIGHT,
    Size,
    attempt,
    describe,
    eigenvalues,
    grid,
    say,
)  # fmt: skip
from failing.steps import Limits, Scheme

from stmuav_jax import Scene, make_scene


def alignment(size: Size) -> dict[str, Any]:
    """Part g: closest approaches of rod 5 over geometries, both orders of the axes."""
    designs = sample(size.samples, seed=0)
    rows, nearest = [], (np.inf, 0, 2)
    for name, case in size.scenes:
        for swapped in (False, True):
            paths = approaches(name, case, designs, swapped=swapped, span=size.span)
            window = [path.closest(0.45, 0.5) for path in paths]
            whole = [path.closest() for path in paths]
            short = lambda entries: [[round(x, 4) for x in entry] for entry in entries]
            rows.append({
                "scene": name, "case": case, "swapped": swapped,
                "finished": sum(path.finished for path in paths),
                "closest": short(whole), "window": short(window),
                "first_within_5_degrees": [path.first_within(5.0) for path in paths],
            })  # fmt: skip
            print("g", name, case, "swapped" if swapped else "adopted", whole[0], flush=True)
            if name == "uav_tracker" and not swapped:
                # only designs that no length puts far outside the fit
                angles = np.where(deviations(designs) <= 2, [e[1] for e in window], np.inf)
                k = int(np.argmin(angles))
                nearest = min(nearest, (float(angles[k]), k, case))
    chosen = {"angle_in_window": nearest[0], "sample": nearest[1], "case": nearest[2]}
    return {"designs": designs.tolist(), "rows": rows, "nearest_in_window": chosen}


def alignment_methods(size: Size, found: dict[str, Any]) -> list[dict[str, Any]]:
    """Part g: what the event does to methods; adopted and swapped axes, and the nearest sample."""
    designs, chosen = np.array(found["designs"]), found["nearest_in_window"]
    scenes: list[tuple[str, int, Scene]] = []
    for case in size.cases:
        for words, swapped in (("adopted axes", False), ("swapped axes", True)):
            scene = varied_scene("uav_tracker", case, jnp.asarray(designs[0]), swapped=swapped)
            scenes.append((words, case, scene))
    design = jnp.asarray(designs[chosen["sample"]])
    case, rows, times = chosen["case"], [], grid(size.t1)
    scenes.append(("nearest sample", case, varied_scene("uav_tracker", case, design)))
    for words, case, scene in scenes:
        for scheme in (DEFAULT, TIGHT, *FIXED):
            model, history = attempt(scene, times, scheme)
            record = describe(model, history, every=len(times))
            k = int(np.argmin(history.sizes[3:-1])) + 3 if len(history.sizes) > 5 else 0
            where = {"smallest_step_at": float(history.ends[k])}
            row = {"part": "g", "name": words, "case": case, "scheme": scheme.label}
            rows.append({**row, **where, **record})
            say(rows[-1])
    return rows


def collapses(size: Size) -> list[dict[str, Any]]:
    """Part b over geometries: when the printed equations stop."""
    designs, times, rows = sample(size.collapses, seed=0), grid(size.t1), []
    kinds = {"gamma: lost dots": Variant(lost_dots=True), "all four": ALL_MISPRINTS}
    for name, variant in kinds.items():
        for case in size.cases:
            for scheme in (DEFAULT, TIGHT):
                ends = []
                for design in designs:
                    scene = varied_scene("uav_tracker", case, jnp.asarray(design))
                    limits = Limits(evaluations=20_000)
                    _, history = attempt(scene, times, scheme, variant, None, limits)
                    ends.append([history.stopped_at, history.failure])
                which = {"name": name, "case": case, "scheme": scheme.label}
                rows.append({**which, "ends": ends})
                print("b geometry", *which.values(), sorted(e[0] for e in ends), flush=True)
    return rows


def nature(size: Size) -> list[dict[str, Any]]:
    """Part b: how the table as printed stops, by explicit and implicit methods.

    Angular rates, condition and eigenvalues at the last states that were kept, 1 ms apart.
    """
    times = np.arange(0.0, size.t1 / 2, 1e-3)
    schemes = (DEFAULT, TIGHT, Scheme("dop853", 1e-6, 1e-9), Scheme("radau"))
    rows = []
    for case in size.cases:
        scene = make_scene("uav_tracker", case)
        for scheme in schemes:
            limits = Limits(evaluations=40_000)
            model, history = attempt(scene, times, scheme, ALL_MISPRINTS, None, limits)
            row: dict[str, Any] = {"case": case, "scheme": scheme.label, **history.summary()}
            row |= {"smallest_step": float(np.min(history.sizes)), "before_the_end": []}
            for back in (100, 30, 10, 3, 1):
                if back >= len(history.times):
                    continue
                t, y = float(history.times[-back]), history.states[-back]
                values = eigenvalues(model, t, y)
                row["before_the_end"].append({
                    "t": t, "fastest_turn": float(np.max(np.abs(model.turning(y)))),
                    "condition": model.condition(t, y), "fastest": float(np.max(np.abs(values))),
                    "largest_real": float(np.max(np.real(values))),
                    "most_negative_real": float(np.min(np.real(values))),
                })  # fmt: skip
            rows.append(row)
            print("b nature", case, scheme.label, row["reached"], row["failure"], flush=True)
    return rows
