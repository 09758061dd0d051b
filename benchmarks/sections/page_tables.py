"""Tables of the documentation's pages from the stored results alone, between the comments that name them."""

import json
import re
from collections.abc import Callable
from pathlib import Path

from sections import long_page, stiff_page
from shared.pages import Lines, Row, number, power, table
from shared.record import RESULTS, ROOT

ESTIMATION = ROOT / "docs" / "figures" / "estimation" / "numbers.json"
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


def chains(content: Row) -> Lines:
    """Errors and steps of chains of four-bars by tolerance."""
    heavy = [row for row in content["couplers"] if row["coupler"] == 1e6]
    columns = {f"N = {row['loops']}": row["loops"] for row in content["chains"]}
    rows: dict[float, list[str]] = {}
    for row in [*sorted(content["chains"], key=lambda row: row["loops"]), *heavy]:
        cell = f"{power(row['error'])} ({row['accepted']} + {row['rejected']})"
        rows.setdefault(row["tolerance"], []).append(cell)
    head = ["rtol = atol", *columns, "N = 1, coupler of 1e6 kg"]
    return table(head, [[f"{tolerance:.0e}", *cells] for tolerance, cells in rows.items()])


def machine_code(content: Row) -> Lines:
    """Times by XLA and by machine code, and their differences."""
    keys = ("xla", "machine_code")
    rows = []
    for row in (row for row in content["rows"] if row["lanes"] in (1, 16, 1024)):
        times = [number(row[key]["us_per_state"], digits=2) for key in keys]
        states = "1 state" if row["lanes"] == 1 else f"{row['lanes']} states"
        rows.append(
            [f"{row['function']}, {states} [us per state]", *times, power(row["difference"], 0)]
        )
    for row in content["flights"]:
        lanes = "1 lane" if row["lanes"] == 1 else f"{row['lanes']} lanes"
        rates = [f"{row[key]['flights_per_second']:.0f}" for key in keys]
        rows.append(
            [f"flights of 1 s at 1e-9, {lanes} [per second]", *rates, power(row["difference"], 0)]
        )
        seconds = [number(row[key]["compile_seconds"], digits=2) for key in keys]
        rows.append([f"compile time of the flights, {lanes} [s]", *seconds, ""])
    return table(["", "XLA", "machine code", "difference"], rows)


def error_estimates(content: Row) -> Lines:
    """True errors of runs and their estimates."""
    rows = []
    for row in content["rows"]:
        second = next(run for run in row["second"] if run["factor"] == 0.1)
        rows.append([
            f"`{row['scene']}` {row['case']}", f"{row['tolerance']:.0e}", power(row["true"], 2),
            power(second["estimate"], 2), f"{second['attempts'] / row['attempts']:.2f}",
        ])  # fmt: skip
    head = [
        "scene",
        "rtol = atol",
        "true position error [m]",
        "estimate [m]",
        "step attempts, second / first run",
    ]
    return table(head, rows)


def error_factors(content: Row) -> Lines:
    """Reliability and cost of second runs by the factor on their tolerances."""
    rows = []
    for factor, row in content["factors"].items():
        words = f"{float(factor):.2g}" + (" (used by `simulate`)" if float(factor) == 0.1 else "")
        attempts = ", ".join(f"{x:.2f}" for x in row["attempts"])
        rows.append([words, f"{row['within']} of {row['of']}", attempts])
    head = [
        "factor on the tolerances of the second run",
        "estimates correct within a factor of three",
        "step attempts, second / first run: smallest, median, largest",
    ]
    return table(head, rows)


def batch_sizes(content: Row) -> Lines:
    """Throughput by the size of the batch."""
    rows = [
        [row["size"], f"{row['flights_per_second']:.0f}", f"{row['filter_step_us']:.2f}"]
        for row in content["rows"]
    ]
    return table(["batch", "flights per second", "step of a filter [us]"], rows)


def flight_logs(content: Row) -> Lines:
    """Coverage and mean error of the estimates from simulated flight logs."""
    found = {row["quantity"]: row for row in content["estimates"]}
    rows = []
    for names in FLIGHT_LOG_ROWS:
        mine = [found[name] for name in names]
        covers = ", ".join(f"{100 * row['cover_95']:.0f}" for row in mine)
        means = ", ".join(f"{row['mean_in_deviations']:.2f}" for row in mine)
        rows.append([", ".join(f"`{name}`" for name in names), f"{covers} %", means])
    return table(
        ["estimate", "coverage of 95 % intervals", "mean error / standard deviation"], rows
    )


def variant(run: Row) -> str:
    """The equations and the method of a run."""
    return f"{VARIANTS.get(run['name'], run['name'])}, {run['scheme']}"


def failure_trials(content: Row) -> Lines:
    """All runs of the second case."""
    rows = []
    for run in sorted((r for r in content["trials"] if r["case"] == 2), key=lambda r: r["part"]):
        at = lambda key, time, run=run: power(run[key].get(time))
        stop = " **stop**" if run["failure"] else ""
        rows.append([
            run["part"], variant(run), f"{run['reached']:.3f} s{stop}", run["steps"],
            *(at("violation", time) for time in ("0.1", "0.5", "2")), at("norm_error", "0.5"),
            at("energy_drift", "0.5"), power(run["condition"][1]), f"{run['fastest_rate']:.0f}",
        ])  # fmt: skip
    head = ["", "variant", "reached", "steps", "violation 0.1 s", "0.5 s", "2 s", "norms 0.5 s", "energy 0.5 s",
            "condition", "eigenvalue [1/s]"]  # fmt: skip
    return table(head, rows)


def failure_printed(content: Row) -> Lines:
    """Times at which the printed equations stop."""
    rows: dict[str, list[str]] = {}
    for run in content["trials"]:
        if run["part"] == "b" and run["scheme"].startswith("ode45"):
            rows.setdefault(variant(run), ["-"] * 3)[run["case"] - 1] = f"{run['reached']:.3f} s"
    head = ["printed", "case 1", "case 2", "case 3"]
    return table(head, [[name, *cells] for name, cells in rows.items()])


def failure_stiffness(content: Row) -> Lines:
    """Eigenvalues before the reported stop."""
    kinds = {
        "fastest": ("largest eigenvalue [1/s]", "{:.0f}"),
        "most_negative_real": ("most negative real part [1/s]", "{:.0f}"),
        "largest_step_times_fastest": (
            "step of ode45 (default) times largest eigenvalue",
            "{:.2f}",
        ),
    }
    rows = [
        [f"{system}: {words}", *(form.format(run[system]["before_half_second"][key]) for run in content["stiffness"])]
        for system in ("dense", "reduced") for key, (words, form) in kinds.items()
    ]  # fmt: skip
    return table(["to 0.5 s", "case 1", "case 2", "case 3"], rows)


def failure_fixed_steps(content: Row) -> Lines:
    """Ends of runs of the corrected equations with fixed steps."""
    rows: dict[str, dict[str, str]] = {}
    for run in content["alignment_methods"]:
        near = run["name"] == "nearest sample"
        name = "the geometry with 2.2 degrees at 0.490 s" if near else run["name"]
        rows.setdefault(f"{name}, case {run['case']}", {})[run["scheme"]] = (
            f"stops at {run['reached']:.2f} s"
            if run["failure"]
            else f"reaches {run['reached']:g} s"
        )
    cells = [[name, *(row[scheme] for scheme in FIXED_STEPS)] for name, row in rows.items()]
    return table(["", *FIXED_STEPS.values()], cells)


def estimation_cases(content: Row) -> Lines:
    """The report's eight cases with both tunings."""
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


# Name in the comments of the pages -> its record and its function.
TABLES: dict[str, tuple[str | Path, Callable[[Row], Lines]]] = {
    "stiff scenes": ("stiff", stiff_page.fastest),
    "symmetric methods": ("long_horizon", long_page.comparisons),
    "stabilisations": ("long_horizon", long_page.at_tolerance),
    "long times": ("long_horizon", long_page.cheapest),
    "chains": ("singular", chains),
    "machine code": ("machine_code", machine_code),
    "error estimates": ("errors", error_estimates),
    "second runs": ("errors", error_factors),
    "batch sizes": ("batch_sizes", batch_sizes),
    "flight logs": ("flight_logs", flight_logs),
    "runs of case 2": ("failure", failure_trials),
    "printed equations": ("failure", failure_printed),
    "eigenvalues": ("failure", failure_stiffness),
    "fixed steps": ("failure", failure_fixed_steps),
    "eight cases": (ESTIMATION, estimation_cases),
}
BLOCK = re.compile(r"(<!-- table: ([\w ]+) -->\n+).*?(\n+<!-- end of table -->)", re.DOTALL)


def fill(text: str, tables: dict[str, tuple[str | Path, Callable[[Row], Lines]]]) -> str:
    """Text of a page with the tables that its comments name."""

    def make(match: re.Match[str]) -> str:
        source, function = tables[match[2]]
        path = source if isinstance(source, Path) else RESULTS / f"{source}.json"
        return match[1] + "\n".join(function(json.loads(path.read_text()))) + match[3]

    return BLOCK.sub(make, text)
