"""The sections of the suite's page as Markdown: only what the JSON files hold."""

from collections.abc import Sequence
from typing import Any

Lines = list[str]
Row = dict[str, Any]


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> Lines:
    """A Markdown table."""
    cell = lambda x: str(x).replace("|", "/").replace("\n", " ")
    line = lambda cells: "| " + " | ".join(cell(x) for x in cells) + " |"
    return [line(head), line(["---"] * len(head)), *(line(row) for row in rows)]


def number(value: float | None, unit: float = 1.0) -> str:
    """Three digits, or a dash."""
    return "-" if value is None else f"{unit * value:.3g}"


def power(value: float | None) -> str:
    """Two digits and a power of ten, or a dash."""
    return "-" if value is None else f"{value:.1e}"


def whole(value: int | None) -> str:
    """A count, or a dash."""
    return "-" if value is None else str(value)


def milliseconds(timing: Row | None) -> str:
    """Median and, in brackets, spread; a single run is marked."""
    if timing is None:
        return "-"
    if timing["repeats"] == 1:
        return f"{1e3 * timing['median']:.3g} (once)"
    return f"{1e3 * timing['median']:.3g} ({1e3 * timing['spread']:.1g})"


def setting(row: Row) -> str:
    """Tolerance or step."""
    if row.get("tolerance") is not None:
        return f"tol {row['tolerance']:.0e}"
    return f"h = {row['step']:g} s" if row.get("step") is not None else "-"


# What our adapters lack says nothing about what the programs can do.
NOT_WRITTEN = ("not written in our adapter", "what the adapter lacks")
OF_ADAPTERS = (
    "These rows are about the adapters in `benchmarks/peers/`, which hand our scenes to the other "
    "programs, and not about the programs, which may well model the scene."
)


def curves(result: Row) -> Lines:
    """Work-precision: per problem who reaches what in which time, then every run."""
    lines: Lines = []
    for curve in result["curves"]:
        lines += [f"### {curve['title']}", ""]
        if curve["failure"]:
            lines += [f"Nothing was measured here: {curve['failure']}", ""]
            continue
        for end, check in zip(curve["horizons"], curve["references"], strict=True):
            closed = curve.get("closed_form", False)
            lines += [*_reference(check, closed), "", *_cheapest(curve, end), ""]
        if curve["unsupported"]:
            rows = [[x["method"], x["reason"]] for x in curve["unsupported"]]
            lines += [*table(NOT_WRITTEN, rows), "", OF_ADAPTERS, ""]
        lines += [*_points(curve["rows"]), ""]
    return lines


def _reference(check: Row, closed_form: bool) -> Lines:
    """How well the reference is known."""
    what = "the closed form" if closed_form else "stmuav-jax at its tightest tolerance"
    said = []
    for key, who in (
        ("second_code", "another program"),
        ("other_formulation", "the augmented formulation of stmuav-jax"),
    ):
        row = check[key]
        if row is None:
            said.append(f"there is no run by {who} to compare with it")
        else:
            how = f"{row['method']}, {row['solver']}, {setting(row)}"
            said.append(f"{who} comes within {power(row['error'])} m of it ({how})")
    return [f"Runs to {check['horizon']:g} s. The reference is {what}; {'; '.join(said)}."]


def _cheapest(curve: Row, end: float) -> Lines:
    """Least time for every target and method."""
    rows = [row for row in curve["cheapest"] if row["horizon"] == end]
    targets = [key for key in rows[0] if key not in ("method", "solver", "horizon")] if rows else []

    def cell(found: Row) -> str:
        if found["seconds"] is None:
            return "not reached"
        ratio = found["ratio_to_ours"]
        times = "" if ratio is None else f" ({ratio:.2g})"
        return f"{1e3 * found['seconds']:.3g} ms{times}"

    head = ["method", "solver", *(f"<= {t} m" for t in targets)]
    body = [[r["method"], r["solver"], *(cell(r[t]) for t in targets)] for r in rows]
    return [
        "Least run time that reaches an error, and in brackets its ratio to the fastest run of "
        "stmuav-jax that reaches it:",
        "",
        *table(head, body),
    ]


def _points(rows: Sequence[Row]) -> Lines:
    head = ["method", "solver", "setting", "to [s]", "run [ms]", "compile [s]", "evaluations",
            "steps", "rejected", "error [m]", "residual [m]", "failure"]  # fmt: skip
    body = [
        [
            row["method"],
            row["solver"],
            setting(row),
            f"{row['horizon']:g}",
            milliseconds(row["seconds"]),
            number(row.get("compile_seconds")),
            whole(row.get("evaluations")),
            whole(row.get("accepted")),
            whole(row.get("rejected")),
            power(row["error"]),
            power(row.get("residual")),
            row["failure"],
        ]
        for row in rows
    ]
    return ["<details><summary>All runs</summary>", "", *table(head, body), "", "</details>"]


def acceleration(result: Row) -> Lines:
    """One evaluation: ours single and batched, peers."""
    rows = [
        [
            row["method"],
            row["batch"],
            number(row["seconds"], 1e6),
            number(row.get("compile_seconds")),
            whole(row.get("operations")),
            row["failure"],
        ]
        for row in result["rows"]
    ]
    head = ["method", "states at once", "us per state", "compile [s]", "operations in the program",
            "failure"]  # fmt: skip
    lines = [
        *table(head, rows),
        "",
        "Operations in the program are those of StableHLO before XLA optimises, each called "
        "function counted once: a measure of its size, not of its arithmetic.",
    ]
    done = [row for row in result["rows"] if row["seconds"] is not None]
    cpp = next((row for row in done if row["method"].startswith("Pinocchio (C++)")), None)
    ours = [row for row in done if row["method"].startswith("stmuav-jax")]
    if cpp and ours:
        alone = min((r for r in ours if r["batch"] == 1), key=lambda r: r["seconds"])
        best = min(ours, key=lambda r: r["seconds"])
        lines += [
            "",
            f"The lower bound, one acceleration in {cpp['method']}: {number(cpp['seconds'], 1e6)} "
            f"us. stmuav-jax needs {alone['seconds'] / cpp['seconds']:.2g} times as long for one state, and "
            f"per state {best['seconds'] / cpp['seconds']:.2g} times as long for {best['batch']} "
            "states at once.",
        ]
    return lines


def batch(result: Row) -> Lines:
    """Throughput, and its ratios."""
    rows = [
        [
            row["method"],
            whole(row.get("trajectories")),
            whole(row.get("block")),
            setting(row),
            number(row["per_second"]),
            power(row.get("median_error")),
            power(row.get("largest_error")),
            whole(row.get("failed")),
            number(row.get("compile_seconds")),
            row["failure"],
        ]
        for row in result["rows"]
    ]
    head = ["method", "trajectories", "block", "setting", "per second", "median error [m]",
            "largest error [m]", "failed", "compile [s]", "failure"]  # fmt: skip
    single = result["single"]
    lines = [
        f"To {result['horizon']:g} s; errors over the first {result['references']} trajectories "
        f"against runs at a tighter tolerance, wanted {power(result['error_wanted'])} m. One "
        f"trajectory alone: {1e3 * single['seconds']['best']:.3g} ms, {number(single['per_second'])} "
        "per second. Studies, whose flights differ in more than their first velocities and whose lanes "
        "are filled again as flights end, are measured apart ([throughput](throughput.md)).",
        "",
        *table(head, rows),
    ]
    done = [row for row in result["rows"] if row["per_second"] is not None]
    ours = max((r for r in done if r["method"].startswith("stmuav")), key=lambda r: r["per_second"])
    rate = ours["per_second"]
    said = [f"{rate / single['per_second']:.2g} times that of one trajectory after the other"]
    small = lambda r: (
        r["largest_error"] is not None and r["largest_error"] <= result["error_wanted"]
    )
    others = [r for r in done if not r["method"].startswith("stmuav") and small(r)]
    said += [f"{rate / r['per_second']:.2g} times that of {r['method']}" for r in others]
    return [*lines, "", f"Throughput of the fastest batch: {'; '.join(said)}."]


def scaling(result: Row) -> Lines:
    """Cost against the number of loops."""
    rows = [
        [
            row["loops"],
            whole(row.get("bodies")),
            number(row.get("acceleration_seconds"), 1e6),
            milliseconds(row.get("run_seconds")),
            whole(row.get("steps")),
            number(row.get("run_compile_seconds")),
            power(row.get("residual")),
            power(row.get("cranks_differ")),
            row["failure"] or ("" if row.get("run_seconds") else "Only accelerations were timed."),
        ]
        for row in result["rows"]
    ]
    head = ["N", "bodies", "acceleration [us]", "run [ms]", "steps", "compile [s]",
            "residual [m]", "largest difference between crank heights [m]", "failure or remark"]  # fmt: skip
    said = [
        f"{what} grows as N^{value:.2f} from N = {least}"
        for what, fits in result["exponents"].items()
        for least, value in fits.items()
        if value is not None
    ]
    return [*table(head, rows), "", f"Fitted: {'; '.join(said) or 'too few sizes'}."]


def gradient(result: Row) -> Lines:
    """Cost and error of gradients."""
    rows = [
        [
            row["mode"],
            setting(row),
            milliseconds(row.get("seconds")),
            number(row.get("cost_in_simulations")),
            power(row.get("error")),
            number(row.get("compile_seconds")),
            row["failure"],
        ]
        for row in result["rows"]
    ]
    head = ["mode", "setting", "run [ms]", "in simulations", "relative error", "compile [s]",
            "failure"]  # fmt: skip
    return [
        f"After {result['horizon']:g} s, by {result['count']} parameters: {result['parameters']}. "
        "Errors are relative to the largest entry, against central differences, extrapolated "
        f"twice, which changed by {power(result['differences']['own_error'])} in the last "
        "extrapolation.",
        "",
        *table(head, rows),
    ]


def hexacopter(result: Row) -> Lines:
    """One free body, ours and by hand."""
    rows = [
        [
            row["method"],
            setting(row),
            number(row["seconds"]["median"], 1e6),
            number(row["seconds"]["spread"], 1e6),
            row["steps"],
            number(row["seconds_per_step"], 1e6),
            number(row["compile_seconds"]),
            power(row["quaternion_norm_error"]),
            row["failure"],
        ]
        for row in result["rows"]
    ]
    head = ["method", "setting", "run [us]", "spread [us]", "steps", "us per step",
            "compile [s]", "norm error", "failure"]  # fmt: skip
    ratios = ", ".join(f"{r:.2g} at {tol}" for tol, r in result["ratios"].items())
    return [
        *table(head, rows),
        "",
        f"Each run simulates {result['span']:g} s. Run time of stmuav-jax over that of the equations "
        f"written by hand: {ratios}. At the tightest tolerance the two end positions differ by "
        f"{power(result['ends_differ'])} m.",
    ]


def scenes(result: Row) -> Lines:
    """All scenes."""
    rows = [
        [
            row["scene"],
            milliseconds(row["seconds"]),
            number(row.get("compile_seconds")),
            whole(row.get("evaluations")),
            whole(row.get("accepted")),
            whole(row.get("rejected")),
            power(row.get("residual")),
            row["failure"],
        ]
        for row in result["rows"]
    ]
    head = ["scene", "run [ms]", "compile [s]", "evaluations", "steps", "rejected",
            "residual [m]", "failure"]  # fmt: skip
    return [f"Each run simulates {result['span']:g} s.", "", *table(head, rows)]
