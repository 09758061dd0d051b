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


def _metres(error: float | None) -> str:
    """An error, if there is one."""
    return f"{error:.1e}" if error is not None and math.isfinite(error) else ""


def _why(peer: dict[str, Any]) -> str:
    """Why a throughput of an older record has no error."""
    error = peer.get("largest_error")
    if error is None or math.isfinite(error):
        return ""
    return "some flights end in numbers that are not finite: the step is too long for them"


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
    peers = [
        (p["method"], p.get("tolerance") or p.get("step") or "",
         f"{p['per_second']:.1f}" if p.get("per_second") else "",
         _metres(p.get("median_error")), _metres(p.get("largest_error")), p["failure"] or _why(p))
        for p in content["peers"]
    ]  # fmt: skip
    head = ("program", "tolerance or step", "per second", "median [m]", "largest [m]", "failure")
    lines += _table(head, peers)
    best = max(row["per_second"] for row in content["rows"])
    lines += [
        f"Ours: {best:.1f} per second at a largest error of {content['tried'][-1]['largest_error']:.1e} m, "
        f"{best / p['per_second']:.2f} times {p['method']} at {p['largest_error']:.1e} m (its fastest "
        "setting with at most twice our error)."
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
