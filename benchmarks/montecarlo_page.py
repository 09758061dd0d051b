"""The page docs/throughput.md from results/montecarlo.json, with its figure."""

import io
import json
import math
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stmuav_jax.view.io import write_atomically


def comparable(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Each program's fastest setting whose largest error is at most twice ours."""
    ours = content["tried"][-1]["largest_error"]
    found: dict[str, dict[str, Any]] = {}
    for row in content["peers"]:
        error = row.get("largest_error")
        if error is None or not error <= 2 * ours:
            continue
        if row["per_second"] > found.get(row["method"], {"per_second": 0.0})["per_second"]:
            found[row["method"]] = row
    return list(found.values())


def of_peer(row: dict[str, Any]) -> tuple[Any, ...]:
    """A row of the table of other programs; flights that were lost have no throughput.

    A rate of flights that stopped early says nothing, so it is left out, and the reason told.
    """
    figures = [row.get(key) for key in ("per_second", "median_error", "largest_error")]
    setting = row.get("tolerance") or row.get("step") or "-"
    failure = row["failure"]
    if not all(x is not None and math.isfinite(x) for x in figures):
        lost = row.get("not_finite")
        who = "Some flights (how many was not recorded)" if lost is None else f"{lost} flights"
        failure = failure or f"{who} ended with a state that is not finite."
        return (row["method"], setting, "-", "-", "-", failure)
    rate, median, largest = figures
    return (row["method"], setting, f"{rate:.1f}", f"{median:.1e}", f"{largest:.1e}", failure)


def figure(content: dict[str, Any]) -> Figure:
    """Flights per second by lanes."""
    drawn = Figure(figsize=(7.0, 3.2), layout="constrained")
    FigureCanvasAgg(drawn)
    ax = drawn.subplots()
    lanes = [row["lanes"] for row in content["rows"]]
    ax.plot(lanes, [row["per_second"] for row in content["rows"]], "o-", color="#0072B2")
    ax.axhline(content["one_lane_per_second"], color="0.5", linestyle=":", label="one by one")
    for peer, color in zip(comparable(content), ("#D55E00", "#009E73"), strict=False):
        ax.axhline(peer["per_second"], color=color, linestyle="--", label=peer["method"])
    ax.set_xscale("log", base=2)
    ax.set_xticks(lanes, [str(k) for k in lanes])
    ax.set_ylim(bottom=0)
    ax.set_xlabel("flights that go on together (lanes)", fontsize=9)
    ax.set_ylabel("flights per second, one core", fontsize=9)
    ax.grid(True, color="0.85", linewidth=0.6)
    ax.legend(fontsize=8)
    return drawn


def _table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> list[str]:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return [*lines, *("| " + " | ".join(str(x) for x in row) + " |" for row in rows), ""]


def write_page(result: Path, page: Path) -> Path:
    """Write page and figure; the page's path."""
    content = json.loads(result.read_text())
    about = content["environment"]
    picture = page.parent / "figures" / "benchmarks" / "lanes.png"
    buffer = io.BytesIO()
    figure(content).savefig(buffer, format="png", dpi=160)
    write_atomically(picture, buffer.getvalue())
    lines = [
        "# Throughput of studies",
        "",
        "Made by `python benchmarks/montecarlo.py` from `benchmarks/results/montecarlo.json`; do not edit.",
        "",
        f"Flights of uav_tracker case 2 to {content['t1']:g} s, {content['flights']} of them, Dopri8 at "
        f"{content['tolerance']:g}; medians. {about['cores']} cores, commit {about['commit'][:10]}"
        f"{' with changes' if about['dirty'] else ''}, {about['date'][:10]}.",
        "",
        f"![lanes]({picture.relative_to(page.parent)})",
        "",
        "## One core",
        "",
    ]
    rows = [
        (r["lanes"], f"{r['per_second']:.1f}", f"{r['microseconds_per_step']:.1f}",
         f"{r['compile_seconds']:.1f}", r["failed"])
        for r in content["rows"]
    ]  # fmt: skip
    head = ("lanes", "flights per second", "us per step and flight", "compile [s]", "failed")
    lines += _table(head, rows)
    lines += [f"One by one: {content['one_lane_per_second']:.1f} per second.", "", "## Error", ""]
    tried = [
        (f"{r['tolerance']:g}", f"{r['median_error']:.1e}", f"{r['largest_error']:.1e}")
        for r in content["tried"]
    ]
    lines += _table(("tolerance", "median [m]", "largest [m]"), tried)
    lines += ["## Other programs, one core", ""]
    peers = [of_peer(row) for row in content["peers"]]
    head = ("program", "tolerance or step", "per second", "median [m]", "largest [m]", "failure")
    lines += _table(head, peers)
    best = max(row["per_second"] for row in content["rows"])
    lines += [
        f"stmuav-jax completes {best:.1f} flights per second at a largest error of "
        f"{content['tried'][-1]['largest_error']:.1e} m. {p['method']} completes "
        f"{p['per_second']:.1f} at {p['largest_error']:.1e} m, its fastest setting with at most twice "
        f"that error: a ratio of {best / p['per_second']:.2f}."
        for p in comparable(content)
    ]
    lines += ["", "## More cores, and the store", ""]
    first = content["cores"][0]
    cores = [
        (r["devices"], r["flights"], f"{r['per_second']:.1f}",
         f"{100 * r['per_second'] / (r['devices'] * first['per_second']):.0f} %",
         f"{r['per_second_stored']:.1f}", f"{100 * r['overhead']:.1f} %")
        for r in content["cores"]
    ]  # fmt: skip
    head = ("cores", "flights", "per second", "efficiency", "with study and store", "overhead")
    lines += _table(head, cores)
    return write_atomically(page, "\n".join(lines).encode())
