"""The section on throughput of docs/studies.md from results/montecarlo.json, with its figure."""

import json
import math
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from shared.page_sections import write_section
from shared.pages import Row, listed, panels, save

from stmuav_jax.figures import look

PROGRAM = ("program", "tolerance or step", "per second", "median [m]", "largest [m]", "failure")


def comparable(content: Row) -> list[Row]:
    """Each program's fastest setting whose largest error is at most twice ours."""
    ours = content["tried"][-1]["largest_error"]
    found: dict[str, Row] = {}
    for row in content["peers"]:
        error = row.get("largest_error")
        if error is None or not error <= 2 * ours:
            continue
        if row["per_second"] > found.get(row["method"], {"per_second": 0.0})["per_second"]:
            found[row["method"]] = row
    return list(found.values())


def of_peer(row: Row) -> tuple[Any, ...]:
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


def figure(content: Row) -> Figure:
    """Flights per second by lanes."""
    drawn, (ax,) = panels(1, 1, 3.2)
    lanes = [row["lanes"] for row in content["rows"]]
    ax.plot(lanes, [row["per_second"] for row in content["rows"]], **look(0), label="stmuav-jax")
    ax.axhline(content["one_lane_per_second"], color="0.4", linestyle=":", label="one by one")
    for k, peer in enumerate(comparable(content), 1):
        ax.axhline(peer["per_second"], **look(k) | {"marker": ""}, label=peer["method"])
    ax.set_xscale("log", base=2)
    ax.set_xticks(lanes, [str(k) for k in lanes])
    ax.set_ylim(bottom=0)
    ax.set(
        xlabel="flights that are integrated together (lanes)",
        ylabel="flights per second, one core [1/s]",
    )
    ax.legend(fontsize=8)
    return drawn


def write_page(result: Path, page: Path) -> Path:
    """Write page and figure; the page's path."""
    content = json.loads(result.read_text())
    rows, cores = content["rows"], content["cores"]
    tried, one = content["tried"], "{:.1f}".format
    (picture,) = save({"lanes": figure(content)}, page.parent / "figures" / "benchmarks")
    rate, error = max(row["per_second"] for row in rows), tried[-1]["largest_error"]
    spent = lambda r: f"{100 * r['per_second'] / (r['devices'] * cores[0]['per_second']):.0f} %"
    peers: list[Row] = [
        dict(zip(PROGRAM, (cell or "-" for cell in of_peer(r)), strict=True))
        for r in content["peers"]
    ]
    lines = [
        "## Throughput", "",
        f"The tables give medians over {content['flights']} flights ({content['t1']:g} s of "
        f"{content['what'].split(', ')[1]}) with Dopri8 at {content['tolerance']:g}, and with a different initial "
        "state in each flight ([provenance](benchmarks.md#provenance)).",
        "", f"![lanes]({picture.relative_to(page.parent)})", "", "### One core", "",
        *listed(rows, "lanes", ("flights per second", "per_second", one),
                ("us per step and flight", "microseconds_per_step", one),
                ("compile [s]", "compile_seconds", one), "failed"),
        "", f"A single lane completes {one(content['one_lane_per_second'])} flights per second.",
        "", "### Error of a batch", "",
        *listed(tried, ("tolerance", "tolerance", "{:g}".format),
                ("median [m]", "median_error", "{:.1e}".format),
                ("largest [m]", "largest_error", "{:.1e}".format)),
        "", "### Other programs, one core", "", *listed(peers, *PROGRAM), "",
        "The next table gives the fastest setting of each program with at most twice our error:", "",
        *listed([{"program": "stmuav_jax", "per_second": rate, "largest_error": error},
                 *({"program": p["method"]} | p for p in comparable(content))],
                "program", ("per second", "per_second", one),
                ("largest [m]", "largest_error", "{:.1e}".format),
                ("time per flight, relative to ours", None, lambda p: f"{rate / p['per_second']:.2f}")),
        "", "### More cores, and the store", "",
        "The overhead of study and store is the median over pairs of runs, one with and one without them. It can "
        "therefore differ from the ratio of the two rates.", "",
        *listed(cores, ("cores", "devices"), "flights", ("per second", "per_second", one),
                ("efficiency", None, spent), ("with study and store", "per_second_stored", one),
                ("overhead", "overhead", lambda x: f"{100 * x:.1f} %")),
        "",
    ]  # fmt: skip
    return write_section(page, "benchmarks/montecarlo.py", "\n".join(lines))
