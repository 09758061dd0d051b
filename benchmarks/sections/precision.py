"""Work against precision: problems x methods x tolerances, ours and the peers alike."""

from collections.abc import Callable
from typing import Any

import numpy as np
from peers.adapter import Outcome, Peer, Setting
from problems.compared import Problem, published, stiff, tracker
from sections.ours import Ours, explicit, for_stiff
from sections.size import Size
from shared.clock import Timing, measure, summary

from stmuav_jax import Scene

TARGETS = (1e-3, 1e-6, 1e-9)
# A method whose run took longer than this is not tried with finer settings [s].
PATIENCE = 3.0
# Codes that share nothing with ours and converge far enough to check the reference.
SECOND_CODES = ("Pinocchio", "NumPy")


def reason(error: Exception) -> str:
    """An exception as one short line."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else ''}"[:160]


def distance(a: np.ndarray, b: np.ndarray) -> float | None:
    """Largest distance between the same bodies' centres of mass [m]; None if not finite."""
    if a.shape != b.shape or not np.all(np.isfinite(a)):
        return None
    return float(np.max(np.linalg.norm(a - b, axis=-1)))


def timed(run: Callable[[], Outcome], size: Size) -> tuple[Timing, Outcome]:
    """Time a run; the first call is a warm-up unless it failed or took longer than the budget."""
    first, outcome = measure(run, repeats=1, warm_up=0)
    if outcome.seconds:
        return summary(outcome.seconds), outcome
    if outcome.failure or first.median > size.budget:
        return first, outcome
    return measure(run, repeats=size.repeats, warm_up=0, budget=size.budget)


def run(
    peer: Peer, scene: Scene, end: float, setting: Setting, size: Size
) -> tuple[dict[str, Any], np.ndarray | None]:
    """One run: its cost, or why it failed; and where it ended."""
    try:
        prepared = peer.prepare(scene, np.array([end]), setting)
        timing, outcome = timed(prepared.run, size)
    except Exception as error:
        return {"failure": reason(error)}, None
    cost = {"seconds": timing.to_dict(), "compile_seconds": prepared.compile_seconds}
    return cost | outcome.figures(), np.asarray(outcome.positions)[-1]


def line(
    peer: Peer, problem: Problem, end: float, exact: np.ndarray, size: Size
) -> list[dict[str, Any]]:
    """A method's runs from coarse to fine; those left out are rows too."""
    rows: list[dict[str, Any]] = []
    slow: dict[str, str] = {}
    for setting in peer.settings(problem.scene):
        row: dict[str, Any] = {
            "method": peer.name, "solver": setting.solver, "tolerance": setting.tolerance,
            "step": setting.step, "horizon": end, "error": None, "seconds": None,
            "failure": slow.get(setting.solver, ""),
        }  # fmt: skip
        rows.append(row)
        if row["failure"]:
            continue
        found, last = run(peer, problem.scene, end, setting, size)
        row |= found | {"error": None if last is None else distance(last, exact)}
        seconds = row["seconds"]["median"] if row["seconds"] else float("nan")
        if seconds > PATIENCE:
            slow[setting.solver] = f"Left out: the coarser setting took {seconds:.1f} s."
        said = f"{seconds} s, {row['error']} m {row['failure']}"
        print(f"  {peer.name} {setting}: {said}", flush=True)
    return rows


def reference(problem: Problem, ours: Ours, size: Size) -> dict[float, np.ndarray]:
    """Positions at every horizon: the closed form, or one of our methods at its tightest."""
    if problem.exact is not None:
        return {end: problem.exact(end) for end in problem.horizons}
    # explicit steps on stiff problems are short because of stability, so errors stay small
    tolerance = max(size.reference, 1e-11) if problem.stiff else size.reference
    found = {}
    for end in problem.horizons:
        setting = Setting(ours.solver_name, tolerance=tolerance)
        done = ours.prepare(problem.scene, np.array([end]), setting).run()
        if done.failure:
            raise RuntimeError(f"The reference run failed: {done.failure}")
        found[end] = done.positions[-1]
    return found


def check(rows: list[dict[str, Any]], end: float) -> dict[str, Any]:
    """How closely an independent code meets the reference."""
    near = [
        row for row in rows
        if row["horizon"] == end and row["error"] is not None and not row["failure"]
        and row["method"].startswith(SECOND_CODES)
    ]  # fmt: skip
    best = min(near, key=lambda row: row["error"], default=None)
    keys = ("method", "solver", "tolerance", "error")
    return {"horizon": end, "second_code": best and {key: best[key] for key in keys}}


def cheapest(rows: list[dict[str, Any]], end: float) -> list[dict[str, Any]]:
    """For every method the least time that reaches each target."""
    table = []
    for name, solver in dict.fromkeys((row["method"], row["solver"]) for row in rows):
        good = [
            row for row in rows
            if (row["method"], row["solver"], row["horizon"]) == (name, solver, end)
            and row["error"] is not None and not row["failure"]
        ]  # fmt: skip
        entry: dict[str, Any] = {"method": name, "solver": solver, "horizon": end}
        for target in TARGETS:
            times = (row["seconds"]["median"] for row in good if row["error"] <= target)
            entry[f"{target:.0e}"] = {"seconds": min(times, default=None)}
        table.append(entry)
    return table


def curve(problem: Problem, ours: list[Ours], others: list[Peer], size: Size) -> dict[str, Any]:
    """All methods on one problem, against `reference`."""
    print(f"{problem.key}: {problem.title}", flush=True)
    rows: list[dict[str, Any]] = []
    result: dict[str, Any] = {
        "problem": problem.key, "title": problem.title, "horizons": problem.horizons,
        "closed_form": problem.exact is not None, "rows": rows, "unsupported": [],
    }  # fmt: skip
    try:
        exact = reference(problem, ours[0], size)
    except Exception as error:
        return result | {"failure": reason(error), "references": [], "cheapest": []}
    for method in (*ours[: size.methods], *others):
        if why := method.unsupported(problem.scene):
            result["unsupported"].append({"method": method.name, "reason": why})
            continue
        for end in problem.horizons:
            rows += line(method, problem, end, exact[end], size)
    result["references"] = [check(rows, end) for end in problem.horizons]
    result["cheapest"] = [x for end in problem.horizons for x in cheapest(rows, end)]
    return result | {"failure": ""}


def describe(others: list[Peer]) -> list[dict[str, Any]]:
    """Versions, settings and caveats of what is compared with."""
    about = lambda peer: {"how": peer.how, "caveats": list(peer.caveats)}
    return [{"method": p.name, "version": p.version(), **about(p)} for p in others]


def work_precision(size: Size, others: list[Peer]) -> dict[str, Any]:
    """The seven-body UAV, ours and all peers."""
    implicit = for_stiff(size.stiff_tolerances)[1:]
    ours = [*explicit(size.tolerances), *implicit]
    curves = [curve(tracker(size.horizons), ours, others, size)]
    return {"what": "time against error, uav_tracker case 2", "curves": curves}


def published_problems(size: Size, others: list[Peer]) -> dict[str, Any]:
    """Problems of the literature."""
    curves = []
    for problem in published()[: size.problems]:
        # Dopri8 with both formulations; Tsit5 is compared on the seven bodies
        ours = explicit(size.tolerances, redundant=problem.redundant)[::2]
        curves.append(curve(problem, ours, others, size))
    return {"what": "time against error, published problems", "curves": curves}


def stiff_variants(size: Size, others: list[Peer]) -> dict[str, Any]:
    """Sliders held by stiff servos, explicit and implicit methods."""
    methods = for_stiff(size.stiff_tolerances)
    curves = [curve(stiff(size.horizons[-1]), methods, others, size)]
    return {"what": "time against error, stiff variants", "curves": curves}
