"""All pages, tables and figures of measurements, from the stored results alone.

    python benchmarks/report.py

The text of the benchmark page is `page.md.jinja`: a verdict with one figure, one table a question, and
the provenance at the end. A table holds the few rows that answer its question, and the result that it
links holds every run. Other pages name a table, or a section, in a comment.
"""

import argparse
import json
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2
from sections.figures import EXPLICIT, HOLDS, draw_figures, name_family
from shared.pages import (
    Row,
    comparable,
    describe_scene,
    duration,
    holds,
    number,
    plain,
    power,
    table,
)
from shared.record import RESULTS, ROOT

from stmuav_jax.io.netcdf import write_atomically

DOCS = ROOT / "docs"
PAGE = DOCS / "benchmarks.md"
OTHER_PAGES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
# The results with a section on the page, in its order.
SHOWN = (
    "suite_work_precision", "suite_published", "suite_stiff", "suite_scaling", "suite_hexacopter", "montecarlo",
    "suite_batch", "suite_vector_steps", "suite_gradient", "estimation", "trims", "hard", "waiting", "compile_times",
    "structures",
)  # fmt: skip

DEFAULT = "stmuav_jax, Dopri8"
PINOCCHIO = "Pinocchio in C++, Boost rkf78"
# Row of a table -> method and solver in the results.
PROGRAMS = {
    DEFAULT: ("stmuav-jax, tree", "Dopri8"),
    "stmuav_jax, `Augmented`, Dopri8": ("stmuav-jax, augmented", "Dopri8"),
    "stmuav_jax, Kvaerno5": ("stmuav-jax, tree", "Kvaerno5"),
    "stmuav_jax, Tsit5": ("stmuav-jax, tree", "Tsit5"),
    PINOCCHIO: ("Pinocchio (C++), Boost rkf78", "rkf78"),
    "Pinocchio from Python, SciPy DOP853": ("Pinocchio (Python), SciPy DOP853", "DOP853"),
    "MuJoCo, RK4": ("MuJoCo (C), RK4", "RK4"),
    "MuJoCo, implicitfast": ("MuJoCo (C), RK4", "implicitfast"),
    "MJX on a CPU, RK4": ("MuJoCo MJX (CPU), RK4", "RK4"),
    "Exudyn, generalised-alpha": ("Exudyn, generalised-alpha", "generalised-alpha"),
    "heyoka, Taylor series": ("heyoka, Taylor series", "taylor"),
    "the report's dense system in NumPy, DOP853": ("NumPy, the report's dense system", "DOP853"),
    "the report's dense system in NumPy, RK45": ("NumPy, the report's dense system", "RK45"),
}
# Programs of the README's table.
COMPARED = (
    DEFAULT, PINOCCHIO, "MuJoCo, RK4", "Exudyn, generalised-alpha", "heyoka, Taylor series",
    "the report's dense system in NumPy, DOP853",
)  # fmt: skip
# Method in the results -> row of a table without a choice of solver.
LABELS = {method: name for name, (method, _) in reversed(PROGRAMS.items())}
# Loops, stiffness, mass ratios, impacts and long times among the hard cases.
HARD = (
    "massless link", "stiffness 1e9 beside 10 N/m", "impacts on end stops", "singular posture, mass ratio 1e6",
    "redundant loops, Bricard", "redundant loops, four-bars", "ten minutes of the tracker", "2,000 s of a pendulum",
)  # fmt: skip
# A row of the table of flight logs -> its estimates.
FLIGHT_LOG_ROWS = (
    ("roll", "pitch", "yaw"), ("roll_over_lag", "pitch_over_lag", "yaw_over_lag"), ("lag", "delay"),
    ("roll_speed", "pitch_speed", "spin_up"), ("centre_x", "centre_y"), ("free_centre_x", "free_centre_y"),
    ("thrust", "thrust_slope", "thrust_linear", "thrust_quadratic", "thrust_lag"),
    ("imu_x", "imu_y", "imu_z"), ("drag_x", "drag_y", "drag_z"),
    ("force", "inertia_x", "inertia_y", "inertia_ratio"),
)  # fmt: skip
# Names of equations in the record -> those of docs/failure.md.
VARIANTS = {
    "h_j with the rate of body i": "h_k with the rate of body i",
    "the same, normalised": "printed p, sign of p4 restored, normalised",
    "rows frozen at the start": "rows chosen once at the start",
}
FIXED_STEPS = {
    "rk4 h=1 ms": "Runge-Kutta 1 ms", "rk4 h=2 ms": "2 ms",
    "euler h=1 ms": "Euler 1 ms", "euler h=2 ms": "2 ms",
}  # fmt: skip


# --- the benchmark page
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
    has_default = PROGRAMS[DEFAULT] in measured
    left_out = {"stmuav_jax, Kvaerno5", "stmuav_jax, Tsit5"} if has_default else set()
    return [name for name, key in PROGRAMS.items() if key in measured and name not in left_out]


def least_times(curve: Row, errors: list[str]) -> str:
    """Least run times of one problem, a column for each error."""
    times = lambda name: (duration(least_time(curve, name, error)) for error in errors)
    rows = ([name, *times(name)] for name in programs_of([curve]))
    return table(["error of any body", *(f"<= {error} m" for error in errors)], rows)


def mechanism_times(curves: list[Row]) -> str:
    """Least run times for a micrometre, a column for each problem."""
    times = lambda name: (duration(least_time(curve, name, "1e-06")) for curve in curves)
    rows = ([name, *times(name)] for name in programs_of(curves))
    return table(["program", *(curve["title"] for curve in curves)], rows)


def time_ratios(curves: list[Row], other: str) -> list[float]:
    """Run time of this package over that of another program at a micrometre, from the least."""
    pairs = ([least_time(curve, name, "1e-06") for name in (DEFAULT, other)] for curve in curves)
    return sorted(ours / theirs for ours, theirs in pairs if ours and theirs)


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
    equal: dict[str, Row] = {row["method"]: row for row in comparable(content)}
    ended: list[Row] = [row for row in content["peers"] if row["largest_error"] is not None]
    for method in dict.fromkeys(row["method"] for row in ended):
        settings: list[Row] = [row for row in ended if row["method"] == method]
        for row in (equal.get(method, settings[-1]), settings[0]):
            at = f"step {row['step']:g} s" if row["step"] else f"tolerance {row['tolerance']:.0e}"
            name = f"{LABELS.get(method, method)}, {at}"
            rates.append((name, row["per_second"], power(row["largest_error"])))
    return [[name, f"{rate:.1f}", error] for name, rate, error in rates]


def block_rates(content: Row) -> dict[str, Row]:
    """Fastest row of each program whose largest error is small enough."""
    most = content["error_wanted"]
    rows = (row for row in content["rows"] if row["per_second"] and row["largest_error"] <= most)
    return {LABELS[row["method"]]: row for row in sorted(rows, key=lambda row: row["per_second"])}


def step_rates(content: Row) -> list[Row]:
    """Rows with most steps per second of each program, machine and method, in double precision."""
    key = lambda row: (row["program"], row["machine"], row["method"])
    best = {
        key(row): row
        for row in sorted(content["rows"], key=lambda row: row["per_second"])
        if row["precision"] != "single" and row.get("position_error_many") is not None
    }
    return [row for _, row in sorted(best.items())]


def hard_errors(content: Row) -> str:
    """Errors of the chosen hard cases, beside other programs."""

    def of_peer(peer: Row) -> str:
        if peer["error"] is not None:
            return power(peer["error"])
        is_ours = "not supported" in peer["reason"]
        return "not in our adapter" if is_ours else peer["reason"].rstrip(".")

    cases = [row for row in content["cases"] if row["name"] in HARD]
    names = list(dict.fromkeys(peer["peer"] for row in cases for peer in row.get("peers", ())))
    rows = []
    for row in cases:
        values = [row[key] for key in ("demanded", "reached", "estimated")]
        errors = [power(x) + (f" {row['unit']}" if x is not None else "") for x in values]
        peers = [of_peer(peer) for peer in row.get("peers", ())] or ["-"] * len(names)
        rows.append([row["name"], *errors, *peers])
    head = ["case", "required", "error", "estimated by the run", *(LABELS[name] for name in names)]
    return table(head, rows)


def peers(results: dict[str, Row]) -> str:
    """Programs, versions, how they are run, and those that were skipped."""
    suites = [content for content in results.values() if "skipped" in content]
    ran = {row["method"]: row for content in suites for row in content["peers"]}
    absent = {row["method"]: row["reason"] for content in suites for row in content["skipped"]}
    rows = [
        [name, x["version"], x.get("how", ""), " ".join(x["caveats"])] for name, x in ran.items()
    ]
    rows += [[name, "skipped", reason, ""] for name, reason in absent.items()]
    head = ["program", "version", "how it is run", "what is left out or done differently"]
    return table(head, rows)


# --- sections of other pages
def peer_result(one: Row) -> str:
    """Error, seconds and setting of another program; or the reason why there is none, and at which setting."""
    setting, at = one["setting"], ""
    if setting is not None:
        tolerance, step = setting["tolerance"], setting["step"]
        at = f"step {step:.2g} s" if tolerance is None else f"tolerance {tolerance:.0e}"
    if reason := one["reason"]:
        if "not supported" in reason:
            return "not in our adapter"
        return f"{reason.rstrip('.')} ({at})." if at else reason
    return f"{number(one['error'], digits=2)}, {number(one['seconds'], digits=2)} s ({at})"


def batch_result(row: Row) -> tuple[str, str, str, str]:
    """Rate, median and largest error of a batch by another program, and why there are none.

    A rate of flights that stopped early says nothing, so it is left out, and the reason told.
    """
    numbers = [row.get(key) for key in ("per_second", "median_error", "largest_error")]
    if all(x is not None and math.isfinite(x) for x in numbers):
        rate, median, largest = numbers
        return f"{rate:.1f}", f"{median:.1e}", f"{largest:.1e}", row["failure"] or "-"
    lost = row.get("not_finite")
    who = "Some flights (how many was not recorded)" if lost is None else f"{lost} flights"
    return "-", "-", "-", row["failure"] or f"{who} ended with a state that is not finite."


# --- tables of other pages
def tabulate_readme(content: Row) -> str:
    """Least run times of the flight by the programs of the curves."""
    curve, errors = content["curves"][0], ("1e-03", "1e-06", "1e-09")
    times = lambda name: (duration(least_time(curve, name, error)) for error in errors)
    rows = ([name.split(",")[0], *times(name)] for name in COMPARED)
    return table(["largest error of any body", *(f"{error} m" for error in errors)], rows)


def tabulate_stabilisations(record: Row) -> str:
    """Energy error and run time of Dopri8 at 1e-6 by stabilisation."""

    def cell(row: Row) -> str:
        if row["largest"] is None:
            return f"stops at {row['reached']:.2g} s"
        return f"{power(row['largest'])} ({plain(1e3 * row['seconds'])} ms)"

    rows = []
    for problem in record["problems"]:
        runs = {(row["solver"], row["hold"], row["tolerance"]): row for row in problem["runs"]}
        of = {hold: runs["dopri8", hold, 1e-6] for hold in HOLDS}
        residual = number(of["none"]["residual"], digits=2)
        rows.append([problem["title"], *map(cell, of.values()), residual])
    head = ["Dopri8 at 1e-6", *HOLDS.values(), "joint error of the unstabilised run [m]"]
    return table(head, rows)


def tabulate_long_times(record: Row) -> str:
    """Milliseconds of the cheapest explicit run of each family with an energy error of at most 1e-9."""
    problems = record["problems"]
    families = [f for f in problems[0]["cheapest"]["1e-09"] if f.split(", ")[0] in EXPLICIT]
    best = lambda problem, family: problem["cheapest"]["1e-09"][family]
    cell = lambda row: plain(row and 1e3 * row["seconds"])
    rows = [[name_family(f), *(cell(best(p, f)) for p in problems)] for f in families]
    return table(["run time [ms]", *(problem["title"] for problem in problems)], rows)


def tabulate_chains(content: Row) -> str:
    """Errors and steps of chains of four-bars by tolerance."""
    heavy = [row for row in content["couplers"] if row["coupler"] == 1e6]
    columns = {f"N = {row['loops']}": row["loops"] for row in content["chains"]}
    rows: dict[float, list[str]] = {}
    for row in [*sorted(content["chains"], key=lambda row: row["loops"]), *heavy]:
        cell = f"{power(row['error'])} ({row['accepted']} + {row['rejected']})"
        rows.setdefault(row["tolerance"], [f"{row['tolerance']:.0e}"]).append(cell)
    return table(["rtol = atol", *columns, "N = 1, coupler of 1e6 kg"], rows.values())


def tabulate_flight_logs(content: Row) -> str:
    """Coverage and mean error of the estimates from simulated flight logs."""
    found = {row["quantity"]: row for row in content["estimates"]}
    rows = []
    for names in FLIGHT_LOG_ROWS:
        covers = ", ".join(f"{100 * found[name]['cover_95']:.0f}" for name in names)
        means = ", ".join(f"{found[name]['mean_in_deviations']:.2f}" for name in names)
        rows.append([", ".join(f"`{name}`" for name in names), f"{covers} %", means])
    head = ["estimate", "coverage of 95 % intervals", "mean error / standard deviation"]
    return table(head, rows)


def name_variant(run: Row) -> str:
    """The equations and the method of a run of the report's system."""
    return f"{VARIANTS.get(run['name'], run['name'])}, {run['scheme']}"


def tabulate_case_2(content: Row) -> str:
    """All runs of the report's system in the second case."""
    rows = []
    for run in sorted((r for r in content["trials"] if r["case"] == 2), key=lambda r: r["part"]):
        at = lambda key, time, run=run: power(run[key].get(time))
        stop = " **stop**" if run["failure"] else ""
        rows.append([
            run["part"], name_variant(run), f"{run['reached']:.3f} s{stop}", run["steps"],
            *(at("violation", time) for time in ("0.1", "0.5", "2")), at("norm_error", "0.5"),
            at("energy_drift", "0.5"), power(run["condition"][1]), f"{run['fastest_rate']:.0f}",
        ])  # fmt: skip
    head = ["", "variant", "reached", "steps", "violation 0.1 s", "0.5 s", "2 s", "norms 0.5 s", "energy 0.5 s",
            "condition", "eigenvalue [1/s]"]  # fmt: skip
    return table(head, rows)


def tabulate_printed_equations(content: Row) -> str:
    """Times at which the printed equations stop."""
    rows: dict[str, list[str]] = {}
    for run in content["trials"]:
        if run["part"] == "b" and run["scheme"].startswith("ode45"):
            name = name_variant(run)
            rows.setdefault(name, [name, *"---"])[run["case"]] = f"{run['reached']:.3f} s"
    return table(["printed", "case 1", "case 2", "case 3"], rows.values())


def tabulate_fixed_steps(content: Row) -> str:
    """Ends of runs of the corrected equations with fixed steps."""
    rows: dict[str, dict[str, str]] = {}
    for run in content["alignment_methods"]:
        near = run["name"] == "nearest sample"
        name = "the geometry with 2.2 degrees at 0.490 s" if near else run["name"]
        stops, reaches = f"stops at {run['reached']:.2f} s", f"reaches {run['reached']:g} s"
        cells = rows.setdefault(f"{name}, case {run['case']}", {})
        cells[run["scheme"]] = stops if run["failure"] else reaches
    cells = [[name, *(row[scheme] for scheme in FIXED_STEPS)] for name, row in rows.items()]
    return table(["", *FIXED_STEPS.values()], cells)


def tabulate_eight_cases(content: Row) -> str:
    """The report's eight cases of estimation with both tunings."""
    runs = {(run["case"], run["tuning"]): run for run in content["cases"]}
    rows = []
    for case in sorted({case for case, _ in runs}):
        pair = [runs[case, tuning] for tuning in ("report", "consistent")]
        both = lambda cell, pair=pair: ", ".join(cell(run) for run in pair)
        rmse = lambda run: ", ".join(f"{1e3 * x:.2f}" for x in run["rmse"])
        rows.append([
            case, both(lambda run: f"{run['to_2cm']:.3f}"), *map(rmse, pair),
            both(lambda run: f"{run['nees_offset']:.3g}"), both(lambda run: f"{run['nis']:.2f}"),
            both(lambda run: f"{run['verdict']['flagged']}"),
        ])  # fmt: skip
    head = ["case", "time to 2 cm: report, consistent [s]", "RMSE x, y after 1.2 s: report [mm]",
            "RMSE x, y: consistent [mm]", "NEES (2): report, consistent", "NIS (3): report, consistent",
            "inconsistent runs of 50: report, consistent"]  # fmt: skip
    return table(head, rows)


ENVIRONMENT = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent), trim_blocks=True, lstrip_blocks=True
)
for _filter in (duration, power, number, plain, peer_result, batch_result):
    ENVIRONMENT.filters[_filter.__name__] = _filter
for _function in (
    min, max, holds, least_time, least_times, mechanism_times, time_ratios, flight_rates, block_rates, step_rates,
    hard_errors, peers, table, comparable, describe_scene,
):  # fmt: skip
    ENVIRONMENT.globals[_function.__name__] = _function
ENVIRONMENT.tests["held"] = holds
ENVIRONMENT.globals.update(DEFAULT=DEFAULT, PINOCCHIO=PINOCCHIO)
MACROS: Any = ENVIRONMENT.get_template("tables.md.jinja").module

# Name in the comments of the pages -> the result, or its path, and the function that makes the table.
TABLES: dict[str, tuple[str, Callable[[Row], str]]] = {
    "run times": ("suite_work_precision", tabulate_readme),
    "stiff scenes": ("stiff", MACROS.stiff_scenes),
    "symmetric methods": ("long_horizon", MACROS.symmetric_methods),
    "stabilisations": ("long_horizon", tabulate_stabilisations),
    "long times": ("long_horizon", tabulate_long_times),
    "chains": ("singular", tabulate_chains),
    "machine code": ("machine_code", MACROS.machine_code),
    "by mechanism": ("by_mechanism", MACROS.by_mechanism),
    "error estimates": ("errors", MACROS.error_estimates),
    "second runs": ("errors", MACROS.second_runs),
    "batch sizes": ("batch_sizes", MACROS.batch_sizes),
    "flight logs": ("flight_logs", tabulate_flight_logs),
    "runs of case 2": ("failure", tabulate_case_2),
    "printed equations": ("failure", tabulate_printed_equations),
    "eigenvalues": ("failure", MACROS.eigenvalues),
    "fixed steps": ("failure", tabulate_fixed_steps),
    "eight cases": ("../../docs/figures/estimation/numbers", tabulate_eight_cases),
}
BLOCK = re.compile(r"(<!-- table: ([\w ]+) -->\n+).*?(\n+<!-- end of table -->)", re.DOTALL)
# A section of another page stands between two comments that name the script of its measurements.
SECTION_TEMPLATES = {"hard": "hard.md.jinja", "montecarlo": "throughput.md.jinja"}


def read_result(name: str) -> Row:
    """A stored result."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def fill(text: str) -> str:
    """Text of a page with the tables and the section that its comments name."""

    def make_table(match: re.Match[str]) -> str:
        result, tabulate = TABLES[match[2]]
        return match[1] + tabulate(read_result(result)).strip() + match[3]

    text = BLOCK.sub(make_table, text)
    for result, template in SECTION_TEMPLATES.items():
        script = f"benchmarks/{result}.py"
        begin, end = f"<!-- made by {script} -->\n", f"<!-- end of what {script} makes -->\n"
        before, is_named, rest = text.partition(begin)
        if is_named:
            content = read_result(result)
            section = ENVIRONMENT.get_template(template).render(content, content=content).strip()
            text = f"{before}{begin}\n{section}\n\n{end}{rest.partition(end)[2]}"
    return text


def build(folder: Path, page: Path) -> Path:
    """Write the benchmark page from the results of a folder; returns its path."""
    stored = {path.stem: path for path in sorted(folder.glob("*.json"))}
    results = {name: json.loads(stored[name].read_text()) for name in SHOWN if name in stored}
    if not results:
        raise SystemExit(f"There are no results in {folder}.")
    commits: dict[tuple[str, ...], list[str]] = {}
    for name, content in results.items():
        about = content["environment"]
        commit = about["commit"][:10] + (" with changes" if about["dirty"] else "")
        key = commit, about["date"][:10], about["versions"]["stmuav-jax"]
        commits.setdefault(key, []).append(name)
    text = ENVIRONMENT.get_template("page.md.jinja").render(
        results, results=results, commits=commits,
        link=lambda name: f"[{name}.json]({os.path.relpath(stored[name], page.parent)})",
        others=[name for name in stored if name not in results],
        smallest=any(content.get("size", "full") != "full" for content in results.values()),
    )  # fmt: skip
    return write_atomically(page, f"{text.rstrip()}\n".encode())


def main() -> None:
    """Make the benchmark page and its figures, and the tables and sections of all other pages."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "").parse_args()
    print(build(RESULTS, PAGE))
    for page in OTHER_PAGES:
        text = page.read_text(encoding="utf-8")
        if (filled := fill(text)) != text:
            print(write_atomically(page, filled.encode()))
    print(*draw_figures(RESULTS, DOCS / "figures" / "benchmarks"), sep="\n")


if __name__ == "__main__":
    main()
