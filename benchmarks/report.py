"""The benchmark page, and the tables of measurements on all other pages, from the stored results alone.

    python benchmarks/report.py

The text of the benchmark page is `page.md.jinja`: a verdict with one figure, one table a question, and
the provenance at the end. A table holds the few rows that answer its question, and the result that it
links holds every run. Other pages name a table in a comment (`sections/page_tables.py`).
"""

import argparse
import json
import os
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure
from sections.page_tables import TABLES, fill
from sections.throughput_page import comparable
from shared.pages import Row, number, panels, power, save, table
from shared.record import RESULTS, ROOT

from stmuav_jax.io.netcdf import write_atomically

PAGE = ROOT / "docs" / "benchmarks.md"
OTHER_PAGES = (ROOT / "README.md", *sorted(PAGE.parent.glob("*.md")))
TEMPLATE = Path(__file__).with_name("page.md.jinja")
# The results with a section on the page, in its order.
SHOWN = (
    "suite_work_precision", "suite_published", "suite_stiff", "suite_scaling", "suite_hexacopter", "montecarlo",
    "suite_batch", "suite_vector_steps", "suite_gradient", "estimation", "trims", "hard", "waiting", "compile_times",
)  # fmt: skip

DEFAULT = "stmuav_jax, Dopri8"
PINOCCHIO = "Pinocchio in C++, Boost rkf78"
MUJOCO = "MuJoCo, RK4"
EXUDYN = "Exudyn, generalised-alpha"
HEYOKA = "heyoka, Taylor series"
DENSE = "the report's dense system in NumPy, DOP853"
# Row of a table -> method and solver in the results.
PROGRAMS = {
    DEFAULT: ("stmuav-jax, tree", "Dopri8"),
    "stmuav_jax, `Augmented`, Dopri8": ("stmuav-jax, augmented", "Dopri8"),
    "stmuav_jax, Kvaerno5": ("stmuav-jax, tree", "Kvaerno5"),
    "stmuav_jax, Tsit5": ("stmuav-jax, tree", "Tsit5"),
    PINOCCHIO: ("Pinocchio (C++), Boost rkf78", "rkf78"),
    "Pinocchio from Python, SciPy DOP853": ("Pinocchio (Python), SciPy DOP853", "DOP853"),
    MUJOCO: ("MuJoCo (C), RK4", "RK4"),
    "MuJoCo, implicitfast": ("MuJoCo (C), RK4", "implicitfast"),
    "MJX on a CPU, RK4": ("MuJoCo MJX (CPU), RK4", "RK4"),
    EXUDYN: ("Exudyn, generalised-alpha", "generalised-alpha"),
    HEYOKA: ("heyoka, Taylor series", "taylor"),
    DENSE: ("NumPy, the report's dense system", "DOP853"),
    "the report's dense system in NumPy, RK45": ("NumPy, the report's dense system", "RK45"),
}
# Method in the results -> row of a table without a choice of solver.
LABELS = {method: name for name, (method, _) in reversed(PROGRAMS.items())}
# The curves: colour, dash and marker.
CURVES = {
    DEFAULT: ("#0072B2", "-", "o"),
    PINOCCHIO: ("#D55E00", "-", "s"),
    MUJOCO: ("#009E73", "-", "^"),
    EXUDYN: ("#CC79A7", "-", "D"),
    HEYOKA: ("#56B4E9", "-", "P"),
    DENSE: ("#666666", "-", "v"),
}
# Loops, stiffness, mass ratios, impacts and long times among the hard cases.
HARD = (
    "massless link", "stiffness 1e9 beside 10 N/m", "impacts on end stops", "singular posture, mass ratio 1e6",
    "redundant loops, Bricard", "redundant loops, four-bars", "ten minutes of the tracker", "2,000 s of a pendulum",
)  # fmt: skip
COMMANDS = ("simulate", "fly", "trim", "sun", "estimate", "montecarlo")
COMPILED = {
    "uav_tracker 2, Dopri8": "flight of the UAV, Dopri8",
    "uav_tracker 2, Kvaerno5": "flight of the UAV, Kvaerno5",
    "forward (jacfwd), 20 parameters": "its derivatives with respect to 20 parameters, forward",
    "reverse (grad), 20 parameters": "its gradient with respect to 20 parameters, reverse",
    "trim": "trim",
}


def text_table(head: Any, rows: Any) -> str:
    """A Markdown table as text."""
    return "\n".join(table(list(head), list(rows)))


def duration(seconds: float | None) -> str:
    """Three digits, in ms below a second."""
    if seconds is None:
        return "not reached"
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"


def least_time(curve: Row, program: str, error: str) -> float | None:
    """Least run time [s] of a program to the last horizon with at most an error."""
    for row in curve["cheapest"]:
        same = (row["method"], row["solver"]) == PROGRAMS[program]
        if same and row["horizon"] == curve["horizons"][-1]:
            return row[error]["seconds"]
    return None


def programs_of(curves: list[Row]) -> list[str]:
    """The programs that ran; explicit Tsit5 beside Dopri8 has no row of its own."""
    measured = {(row["method"], row["solver"]) for curve in curves for row in curve["cheapest"]}
    left_out: set[str] = set()
    if PROGRAMS[DEFAULT] in measured:
        left_out = {"stmuav_jax, Kvaerno5", "stmuav_jax, Tsit5"}
    return [name for name, key in PROGRAMS.items() if key in measured and name not in left_out]


def least_times(curve: Row, errors: list[str]) -> str:
    """Least run times of one problem, a column for each error."""
    rows = [
        [name, *(duration(least_time(curve, name, error)) for error in errors)]
        for name in programs_of([curve])
    ]
    return text_table(["error of any body", *(f"<= {error} m" for error in errors)], rows)


def readme_times(content: Row) -> list[str]:
    """Least run times of the flight by the programs of the curves."""
    curve, errors = content["curves"][0], ("1e-03", "1e-06", "1e-09")
    rows = [
        [name.split(",")[0], *(duration(least_time(curve, name, error)) for error in errors)]
        for name in CURVES
    ]
    return table(["largest error of any body", *(f"{error} m" for error in errors)], rows)


def mechanism_times(curves: list[Row]) -> str:
    """Least run times for a micrometre, a column for each problem."""
    rows = [
        [name, *(duration(least_time(curve, name, "1e-06")) for curve in curves)]
        for name in programs_of(curves)
    ]
    return text_table(["program", *(curve["title"] for curve in curves)], rows)


def time_ratios(curves: list[Row], other: str) -> list[float]:
    """Run time of this package over that of another program at a micrometre, from the least."""
    pairs = ([least_time(curve, name, "1e-06") for name in (DEFAULT, other)] for curve in curves)
    return sorted(ours / theirs for ours, theirs in pairs if ours and theirs)


def draw_curves(curve: Row) -> Figure:
    """Run time against error to the last horizon, one colour a program."""
    figure, (ax,) = panels(1, 1, 4.2)
    figure.set_size_inches(5.4, 4.2)  # so that its words are legible on a window of 420 pixels
    for name, (color, dash, mark) in CURVES.items():
        points = [
            (row["error"], 1e3 * row["seconds"]["median"])
            for row in curve["rows"]
            if (row["method"], row["solver"]) == PROGRAMS[name]
            and row["horizon"] == curve["horizons"][-1]
            and (row["error"] and row["seconds"] and not row["failure"])
        ]
        style = {"color": color, "linestyle": dash, "marker": mark, "markersize": 5}
        ax.loglog(*to_columns(points), **style, linewidth=1.6, label=name.split(",")[0])
    ax.set(xlabel="error of any body [m]", ylabel="run time [ms]")
    ax.set_title(f"{curve['horizons'][-1]:g} s of the seven-body UAV on one core")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    return figure


def to_columns(points: list[tuple[float, float]]) -> tuple[list[float], list[float]]:
    """Abscissae and ordinates of points, from left to right."""
    ordered = sorted(points)
    return [x for x, _ in ordered], [y for _, y in ordered]


def loop_times(content: Row) -> str:
    """Times against the number of closed loops."""
    head = [
        "N",
        "bodies",
        "one acceleration [us]",
        "run",
        "compile [s]",
        "constraint violation [m]",
    ]
    rows = [
        [row["loops"], row["bodies"], number(row["acceleration_seconds"], 1e6), duration(row["run_seconds"]["median"]),
         number(row["run_compile_seconds"]), power(row["residual"])]
        for row in content["rows"] if row.get("run_seconds")
    ]  # fmt: skip
    return text_table(head, rows)


def body_times(content: Row) -> str:
    """One free body by the package and by hand."""
    times: dict[float, list[float]] = {}
    for row in content["rows"]:
        times.setdefault(row["tolerance"], []).append(1e6 * row["seconds"]["median"])
    head = ["tolerance", "stmuav_jax [us]", "13 hand-written equations in diffrax [us]", "ratio"]
    rows = [[f"{x:.0e}", f"{a:.0f}", f"{b:.0f}", f"{a / b:.2f}"] for x, (a, b) in times.items()]
    return text_table(head, rows)


def flight_rates(content: Row) -> list[list[str]]:
    """Program, flights per second and largest error.

    Of each other program: the fastest setting with at most twice our error, else the finest; and the
    coarsest whose flights all came to their end.
    """
    best, cores = max(content["rows"], key=lambda row: row["per_second"]), content["cores"][-1]
    rates: list[tuple[str, float, str]] = [
        (f"stmuav_jax, {best['lanes']} lanes", best["per_second"], power(content["tried"][-1]["largest_error"])),
        ("stmuav_jax, one by one", content["one_lane_per_second"], "same tolerance"),
        (f"stmuav_jax on {cores['devices']} cores, with its store", cores["per_second_stored"], "same tolerance"),
    ]  # fmt: skip
    ended: list[Row] = [row for row in content["peers"] if row["largest_error"] is not None]
    equal: dict[str, Row] = {row["method"]: row for row in comparable({**content, "peers": ended})}
    for method in dict.fromkeys(row["method"] for row in ended):
        settings: list[Row] = [row for row in ended if row["method"] == method]
        for row in (equal.get(method, settings[-1]), settings[0]):
            at = f"step {row['step']:g} s" if row["step"] else f"tolerance {row['tolerance']:.0e}"
            name = f"{LABELS.get(method, method)}, {at}"
            rates.append((name, row["per_second"], power(row["largest_error"])))
    return [[name, f"{rate:.1f}", error] for name, rate, error in rates]


def block_rates(content: Row) -> dict[str, Row]:
    """Fastest row of each program whose largest error is small enough."""
    rows = [
        row for row in content["rows"]
        if row["per_second"] and row["largest_error"] <= content["error_wanted"]
    ]  # fmt: skip
    return {LABELS[row["method"]]: row for row in sorted(rows, key=lambda row: row["per_second"])}


def step_rates(content: Row) -> str:
    """Most steps per second of each program, machine and method, in double precision."""
    rows = [
        row for row in content["rows"]
        if row["precision"] != "single" and row.get("position_error_many") is not None
    ]  # fmt: skip
    key = lambda row: (row["program"], row["machine"], row["method"])
    best = {key(row): row for row in sorted(rows, key=lambda row: row["per_second"])}
    head = [
        "program",
        "machine",
        "method",
        "steps per second",
        f"error after {content['horizon']:g} s [m]",
    ]
    rates = [
        [program.replace("-", "_"), machine, method, power(row["per_second"]), power(row["position_error_many"])]
        for (program, machine, method), row in sorted(best.items())
    ]  # fmt: skip
    return text_table(head, rates)


def gradient_costs(content: Row) -> str:
    """Time and error of derivatives at a tolerance of 1e-8."""
    head = ["mode", "run", "run / simulation", "relative error", "compile [s]"]
    rows = [
        [row["mode"], duration(row["seconds"]["median"]), f"{row['cost_in_simulations']:.1f}", power(row["error"]),
         number(row["compile_seconds"])]
        for row in content["rows"] if row.get("tolerance") == 1e-8
    ]  # fmt: skip
    return text_table(head, rows)


def filter_times(content: Row) -> str:
    """Microseconds per step of one filter and of one among many."""
    forms = {
        "unscented, covariance": "unscented_covariance",
        "cubature, square root (default)": "cubature_square_root",
    }
    measured = {f"stmuav_jax, {how}": content["ours"][form] for how, form in forms.items()}
    if "dynamax" in content:
        measured["dynamax, unscented, covariance"] = content["dynamax"]
    if "filterpy" in content:
        measured["FilterPy, unscented, covariance"] = {"single": content["filterpy"], "bank": None}
    cells = lambda x: [number(x[k] and x[k]["median_us"]) for k in ("single", "bank")]
    return text_table(
        ["filter", "one filter", "one of a bank of 256"],
        [[name, *cells(x)] for name, x in measured.items()],
    )


def hard_missed(content: Row) -> int:
    """How many hard cases and tolerances miss the error that is demanded."""
    rows = [*content["cases"], *content["tolerances"]]
    return sum(row["result"] != "successful" or row["reached"] > row["demanded"] for row in rows)


def hard_errors(content: Row) -> str:
    """Errors of the chosen hard cases, beside other programs."""

    def of_peer(peer: Row) -> str:
        if peer["error"] is not None:
            return power(peer["error"])
        return (
            "not in our adapter"
            if "not supported" in peer["reason"]
            else peer["reason"].rstrip(".")
        )

    cases = [row for row in content["cases"] if row["name"] in HARD]
    names = list(dict.fromkeys(peer["peer"] for row in cases for peer in row.get("peers", ())))
    rows = []
    for row in cases:
        values = [row[key] for key in ("demanded", "reached", "estimated")]
        errors = [power(x) + (f" {row['unit']}" if x is not None else "") for x in values]
        peers = [of_peer(peer) for peer in row.get("peers", ())] or ["-"] * len(names)
        rows.append([row["name"], *errors, *peers])
    head = ["case", "required", "error", "estimated by the run", *(LABELS[name] for name in names)]
    return text_table(head, rows)


def command_times(content: Row) -> str:
    """Wall time of commands, first and later."""
    rows = []
    for name in (name for name in COMMANDS if name in content["commands"]):
        command = content["commands"][name]
        words = command["words"].replace(" --out {out}", "")
        walls = [number(command[kind]["wall"]) for kind in ("cold", "warm")]
        rows.append([f"`stmuav {words}`", *walls, f"{command['warm']['memory']:.0f}"])
    return text_table(["command", "first", "later", "peak memory, later [MB]"], rows)


def program_times(content: Row) -> str:
    """Seconds to make programs."""
    total = lambda row: sum(row[f"{k}_seconds"] for k in ("trace", "lower", "compile"))
    rows = {row["program"]: number(total(row)) for row in content["rows"]}
    return text_table(
        ["program", "time [s]"], [[COMPILED[k], x] for k, x in rows.items() if k in COMPILED]
    )


def peers(results: dict[str, Row]) -> str:
    """Programs, versions, how they are run, and those that were skipped."""
    suites = [content for content in results.values() if "skipped" in content]
    ran = {row["method"]: row for content in suites for row in content["peers"]}
    absent = {row["method"]: row["reason"] for content in suites for row in content["skipped"]}
    rows = [
        [name, x["version"], x.get("how", ""), " ".join(x["caveats"])] for name, x in ran.items()
    ]
    rows += [[name, "skipped", reason, ""] for name, reason in absent.items()]
    return text_table(
        ["program", "version", "how it is run", "what is left out or done differently"], rows
    )


def build(folder: Path, page: Path) -> Path:
    """Write the page, and its figure in `figures` beside it; returns its path."""
    stored = {path.stem: path for path in sorted(folder.glob("*.json"))}
    results = {name: json.loads(stored[name].read_text()) for name in SHOWN if name in stored}
    if not results:
        raise SystemExit(f"There are no results in {folder}.")
    link = lambda name: f"[{name}.json]({os.path.relpath(stored[name], page.parent)})"

    def commits(results: dict[str, Row]) -> str:
        groups: dict[tuple[str, ...], list[str]] = {}
        for name, content in results.items():
            about = content["environment"]
            commit = about["commit"][:10] + (" with changes" if about["dirty"] else "")
            key = commit, about["date"][:10], about["versions"]["stmuav-jax"]
            groups.setdefault(key, []).append(link(name))
        return text_table(
            ["commit", "date", "version", "results"],
            [[*key, ", ".join(x)] for key, x in groups.items()],
        )

    if "suite_work_precision" in results:
        curve = results["suite_work_precision"]["curves"][0]
        save({"work_precision": draw_curves(curve)}, page.parent / "figures" / "benchmarks")
    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(duration=duration, power=power, number=number)
    functions = (
        least_time, least_times, mechanism_times, time_ratios, loop_times, body_times, flight_rates, block_rates,
        step_rates, gradient_costs, filter_times, hard_missed, hard_errors, command_times, program_times,
        peers, commits,
    )  # fmt: skip
    environment.globals.update({function.__name__: function for function in functions})
    environment.globals.update(
        link=link, table=text_table, DEFAULT=DEFAULT, PINOCCHIO=PINOCCHIO, MUJOCO=MUJOCO,
        EXUDYN=EXUDYN, DENSE=DENSE,
    )  # fmt: skip
    text = environment.from_string(TEMPLATE.read_text()).render(
        results=results, others=[name for name in stored if name not in results],
        smallest=any(content.get("size", "full") != "full" for content in results.values()), **results,
    )  # fmt: skip
    return write_atomically(page, f"{text.rstrip()}\n".encode())


ALL_TABLES = TABLES | {"run times": ("suite_work_precision", readme_times)}


def main() -> None:
    """Make the page, and the tables of the others, from the stored results."""
    parser = argparse.ArgumentParser(description="Write the benchmark page.")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    print(build(options.results, options.page))
    if options.results == RESULTS:
        for page in OTHER_PAGES:
            text = page.read_text(encoding="utf-8")
            if (filled := fill(text, ALL_TABLES)) != text:
                print(write_atomically(page, filled.encode()))


if __name__ == "__main__":
    main()
