"""The sections of the suite's page as Markdown: only what the JSON files hold."""

from peers.flying import FINER
from shared.pages import (
    Lines,
    Row,
    listed,
    micro,
    milliseconds,
    number,
    ours,
    power,
    setting,
    table,
    whole,
)

# What our adapters lack says nothing about what the programs can do.
NOT_WRITTEN = ("not written in our adapter", "what the adapter lacks")
OF_ADAPTERS = (
    "These rows are about the adapters in `benchmarks/peers/`, which hand our scenes to the other "
    "programs, and not about the programs, which may well model the scene."
)
# Columns that several tables have.
SETTING = ("setting", None, setting)
COMPILE = ("compile [s]", "compile_seconds", number)
RESIDUAL = ("residual [m]", "residual", power)
RUN = ("run [ms]", "seconds", milliseconds)
COUNTS = ("evaluations", "evaluations", whole), ("steps", "accepted", whole)
REJECTED = ("rejected", "rejected", whole)


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
            lines += [*reference(check, closed), "", *_cheapest(curve, end), ""]
        if curve["unsupported"]:
            rows = [[x["method"], x["reason"]] for x in curve["unsupported"]]
            lines += [*table(NOT_WRITTEN, rows), "", OF_ADAPTERS, ""]
        lines += ["<details><summary>All runs</summary>", ""]
        lines += listed(
            curve["rows"], "method", "solver", SETTING, ("to [s]", "horizon", "{:g}".format), RUN,
            COMPILE, *COUNTS, REJECTED, ("error [m]", "error", power), RESIDUAL, "failure",
        )  # fmt: skip
        lines += ["", "</details>", ""]
    return lines


def reference(check: Row, closed_form: bool) -> Lines:
    """How well the reference is known."""
    what = "the closed form" if closed_form else "stmuav-jax at its tightest tolerance"
    augmented, said = "the augmented formulation of stmuav-jax", []
    for key, who in (("second_code", "another program"), ("other_formulation", augmented)):
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
        return f"{1e3 * found['seconds']:.3g} ms" + ("" if ratio is None else f" ({ratio:.2g})")

    said = "Least run time that reaches an error, and in brackets its ratio to the fastest run of "
    columns = [(f"<= {t} m", t, cell) for t in targets]
    return [said + "stmuav-jax that reaches it:", "", *listed(rows, "method", "solver", *columns)]


def acceleration(result: Row) -> Lines:
    """One evaluation: ours single and batched, peers."""
    lines = listed(
        result["rows"], "method", ("states at once", "batch"), ("us per state", "seconds", micro),
        COMPILE, ("operations in the program", "operations", whole), "failure",
    )  # fmt: skip
    lines += [
        "",
        "Operations in the program are those of StableHLO before XLA optimises, each called "
        "function counted once: a measure of its size, not of its arithmetic.",
    ]
    done = [row for row in result["rows"] if row["seconds"] is not None]
    cpp = next((row for row in done if row["method"].startswith("Pinocchio (C++)")), None)
    mine = sorted(ours(done), key=lambda r: r["seconds"])
    if cpp and mine:
        best, alone = mine[0], next(r for r in mine if r["batch"] == 1)
        ratios = [f"{row['seconds'] / cpp['seconds']:.2g}" for row in (alone, best)]
        lines += [
            "",
            f"The lower bound, one acceleration in {cpp['method']}: {micro(cpp['seconds'])} "
            f"us. stmuav-jax needs {ratios[0]} times as long for one state, and "
            f"per state {ratios[1]} times as long for {best['batch']} states at once.",
        ]
    return lines


def batch(result: Row) -> Lines:
    """Throughput, and its ratios."""
    single, wanted = result["single"], result["error_wanted"]
    lines = [
        f"To {result['horizon']:g} s; errors over the first {result['references']} trajectories "
        f"against runs at a tighter tolerance, wanted {power(wanted)} m. One "
        f"trajectory alone: {1e3 * single['seconds']['best']:.3g} ms, {number(single['per_second'])} "
        "per second. Studies, whose flights differ in more than their first velocities and whose lanes "
        "are filled again as flights end, are measured apart ([throughput](throughput.md)).",
        "",
    ]
    lines += listed(
        result["rows"], "method", ("trajectories", "trajectories", whole),
        ("block", "block", whole), SETTING, ("per second", "per_second", number),
        ("median error [m]", "median_error", power), ("largest error [m]", "largest_error", power),
        ("failed", "failed", whole), COMPILE, "failure",
    )  # fmt: skip
    done = [row for row in result["rows"] if row["per_second"] is not None]
    rate = max(row["per_second"] for row in ours(done))
    said = [f"{rate / single['per_second']:.2g} times that of one trajectory after the other"]
    for row in done:
        fine = row["largest_error"] is not None and row["largest_error"] <= wanted
        if fine and row not in ours(done):
            said.append(f"{rate / row['per_second']:.2g} times that of {row['method']}")
    return [*lines, "", f"Throughput of the fastest batch: {'; '.join(said)}."]


def scaling(result: Row) -> Lines:
    """Cost against the number of loops."""
    only = "Only accelerations were timed."
    lines = listed(
        result["rows"], ("N", "loops"), ("bodies", "bodies", whole),
        ("acceleration [us]", "acceleration_seconds", micro),
        ("run [ms]", "run_seconds", milliseconds), ("steps", "steps", whole),
        ("compile [s]", "run_compile_seconds", number), RESIDUAL,
        ("largest difference between crank heights [m]", "cranks_differ", power),
        ("failure or remark", None,
         lambda row: row["failure"] or ("" if row.get("run_seconds") else only)),
    )  # fmt: skip
    said = [
        f"{what} grows as N^{value:.2f} from N = {least}"
        for what, fits in result["exponents"].items()
        for least, value in fits.items()
        if value is not None
    ]
    return [*lines, "", f"Fitted: {'; '.join(said) or 'too few sizes'}."]


def gradient(result: Row) -> Lines:
    """Cost and error of gradients."""
    return [
        f"After {result['horizon']:g} s, by {result['count']} parameters: {result['parameters']}. "
        "Errors are relative to the largest entry, against central differences, extrapolated "
        f"twice, which changed by {power(result['differences']['own_error'])} in the last "
        "extrapolation.",
        "",
        *listed(
            result["rows"], "mode", SETTING, RUN, ("in simulations", "cost_in_simulations", number),
            ("relative error", "error", power), COMPILE, "failure",
        ),
    ]  # fmt: skip


def compile_times(result: Row) -> Lines:
    """Seconds to trace, lower and compile programs."""
    whole_time = lambda row: number(sum(row[f"{k}_seconds"] for k in ("trace", "lower", "compile")))
    return [
        "Seconds of processor time, each program in a new process with empty caches and the "
        f"package's options for short runs. The 20 parameters: {result['parameters']}.",
        "",
        *listed(
            result["rows"], "program", ("trace [s]", "trace_seconds", number),
            ("lower [s]", "lower_seconds", number), COMPILE, ("all [s]", None, whole_time),
            "equations",
        ),
    ]  # fmt: skip


def vector_steps(result: Row) -> Lines:
    """Steps of many flights at once, beside other programs, and closed loops against real time."""
    h, loops = result["horizon"], result["closed_loops"]
    lines = [
        "Medians of processor time. Errors are the largest distance of the base, after one period and after "
        f"{h:g} s, from {FINER} times as many steps of RK4 of the same program in double precision; each program "
        "has its own machine and equations.",
        "",
        *listed(
            result["rows"], "program", "machine", "method", "precision",
            ("side by side", None, lambda row: whole(row.get("side_by_side", row["flights"]))),
            ("periods a call", "steps_per_call", whole), ("steps per second", "per_second", power),
            ("error of one [m]", "position_error_one", power),
            (f"after {h:g} s [m]", "position_error_many", power), COMPILE,
        ),
    ]  # fmt: skip
    if not loops:
        return lines
    return [
        *lines, "", "Closed loops of the UAV with noisy sensors and the estimator:", "",
        *listed(
            loops, "mission", ("native loops", "native_loops", lambda x: "yes" if x else "no"),
            ("flown [s]", "t1", number), ("first flight, compiled too [s]", "first_flight_seconds", number),
            ("flight [s]", "seconds", number), ("times real time", "times_real_time", number),
        ),
    ]  # fmt: skip


def commands(result: Row) -> Lines:
    """What each command of the command line takes, cold and with what the first run has kept."""
    rows = []
    for name, found in result["commands"].items():
        words = found["words"].replace("{out}", "OUT")
        row = [name, f"`{words}`"]
        for kind in ("cold", "warm"):
            own = found[kind]
            ended = sorted({run["exit"] for run in own["runs"]} - {0})
            row += [number(own["cpu"]), number(own["wall"]), f"{own['memory']:.0f}"]
            if kind == "warm":
                row.append(", ".join(str(code) for code in ended))
        rows.append(row)
    measures = ("CPU [s]", "wall [s]", "peak [MB]")
    both = [f"{k}, {m}" for k in ("cold", "warm") for m in measures]
    repeats = max(len(found["cold"]["runs"]) for found in result["commands"].values())
    return [
        f"Whole processes on {result['environment']['cores']} cores, {repeats} of each: least processor time, "
        "medians of wall time and peak memory. Cold is with an empty cache folder, warm the same command "
        "again. Exit code 3 says that a filter is not consistent, which is the report's.",
        "",
        *table(["command", "words after `stmuav`", *both, "exit code, if not 0"], rows),
    ]


def hexacopter(result: Row) -> Lines:
    """One free body, ours and by hand."""
    lines = listed(
        result["rows"], "method", SETTING, ("run [us]", "seconds", lambda s: micro(s["median"])),
        ("spread [us]", "seconds", lambda s: micro(s["spread"])), "steps",
        ("us per step", "seconds_per_step", micro), COMPILE,
        ("norm error", "quaternion_norm_error", power), "failure",
    )  # fmt: skip
    ratios = ", ".join(f"{r:.2g} at {tol}" for tol, r in result["ratios"].items())
    return [
        *lines,
        "",
        f"Each run simulates {result['span']:g} s. Run time of stmuav-jax over that of the equations "
        f"written by hand: {ratios}. At the tightest tolerance the two end positions differ by "
        f"{power(result['ends_differ'])} m.",
    ]


def scenes(result: Row) -> Lines:
    """All scenes."""
    rows = listed(result["rows"], "scene", RUN, COMPILE, *COUNTS, REJECTED, RESIDUAL, "failure")
    return [f"Each run simulates {result['span']:g} s.", "", *rows]
