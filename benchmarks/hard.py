"""Hard cases against known motions: the error that is demanded, the one reached, and what it takes.

    taskset -c 1 python benchmarks/hard.py

writes `results/hard.json` and the page `docs/hard.md`.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from problems.hard import CASES, TOLERANCES, Hard, run_of, swinging
from shared.command import benchmark
from shared.pages import number, titled
from shared.record import ROOT

from stmuav_jax.files.netcdf import write_atomically

PAGE = ROOT / "docs" / "hard.md"
HEAD = """# Hard cases

Made by `python benchmarks/hard.py` from `benchmarks/results/hard.json`; do not edit. Each case is
simulated as a user would do it, with the defaults of `simulate` where the case names no other
setting, and compared with a motion that is known without this package
(`benchmarks/problems/hard.py`). The slow tests run all of them (`tests/hard`). Every run estimates
its own error; the estimate stands beside the error here. Seconds are those of the run alone,
without compilation.
"""
SWEEP = """## All tolerances

A pendulum of 1 m, released with its rod horizontal, for 15 radians of a small swing (4.8 s), at
tolerances that users may give. The error that is demanded is 1,000 tolerances, and never less than
1e-11 m.
"""
LIMITS = """## Where it ends

- A mechanism that only rods or cut loops tie to ground, 1,000 km or more from the origin, stops with
  "step size collapsed": its positions are numbers that are 1e6 times as large as its motion. Put the
  origin near the mechanism, or use `formulation=stm.Augmented()`. Trees that stand on ground by a joint
  compute about that joint: a double pendulum at 10,000 km moves as at the origin.
- Tolerances are lengths in metres as well as numbers. For a mechanism much smaller than a
  millimetre the default of 1e-8 m is a large part of it, as the estimated error then tells.
"""


def row_of(case: Hard, **method: Any) -> dict[str, Any]:
    """One case: what was demanded and reached, the run's own estimate, and its effort."""
    run = run_of(case, **method)
    told = run.certificate
    estimate = {"m": told.position_error, "rad": told.angle_error,
                "rad/s": told.angular_velocity_error}.get(case.unit)  # fmt: skip
    return {
        "name": case.name, "why": case.why, "truth": case.truth, "unit": case.unit,
        "demanded": case.demanded, "reached": case.error(run), "estimated": estimate,
        "result": told.result, "position_violation": told.position_violation,
        "relative_energy_error": told.relative_energy_error, "accepted": told.accepted_steps,
        "rejected": told.rejected_steps, "seconds": told.run_seconds, "t_end": told.t_end,
    }  # fmt: skip


def sweep(tolerances: tuple[float, ...]) -> Iterator[dict[str, Any]]:
    """The pendulum at every tolerance."""
    build, error = swinging(1.0, 15.0)
    for tolerance in tolerances:
        demanded = max(1000 * tolerance, 1e-11)
        case = Hard(f"rtol {tolerance:.0e}", "", "", demanded, "m", build, error)
        yield {"tolerance": tolerance, **row_of(case, rtol=tolerance, atol=tolerance)}


def holds(row: dict[str, Any]) -> bool:
    """True if a run reached its end with the error that is demanded."""
    return row["result"] == "successful" and bool(row["reached"] <= row["demanded"])


def record(size: tuple[int | None, int | None]) -> Iterator[dict[str, Any]]:
    """So many cases and tolerances."""
    content: dict[str, Any] = {"what": "hard cases against known motions", "cases": []}
    for case in CASES[: size[0]]:
        content["cases"].append(row_of(case))
        print(content["cases"][-1], flush=True)
    content["tolerances"] = list(sweep(TOLERANCES[: size[1]]))
    yield content


def page(content: dict[str, Any]) -> str:
    """The page, from the record alone."""
    with_unit = lambda key: (
        lambda row: "-" if row[key] is None else f"{number(row[key], digits=2)} {row['unit']}"
    )
    effort = (
        ("steps", None, lambda row: f"{row['accepted']:,} + {row['rejected']:,}"),
        ("run [s]", "seconds", lambda x: number(x, digits=2)),
    )
    reached = (
        ("demanded", None, lambda row: f"{row['demanded']:.0e} {row['unit']}"),
        ("reached", None, with_unit("reached")),
        ("estimated by the run", None, with_unit("estimated")),
    )
    about = content["environment"]
    missed = [
        row["name"] for key in ("cases", "tolerances") for row in content[key] if not holds(row)
    ]
    verdict = f"Not reached: {', '.join(missed)}." if missed else "All are reached."
    where = f"Commit {about['commit'][:10]}, {about['date'][:10]}, run times on one core."
    cases = titled(
        "## Cases", content["cases"], ("case", "name"), ("what makes it hard", "why"),
        ("compared with", "truth"), *reached, *effort,
    )  # fmt: skip
    swept = titled(
        "", content["tolerances"], ("tolerance", "tolerance", "{:.0e}".format), *reached, *effort
    )
    return "\n".join([HEAD, f"{where} {verdict}", "", cases, "", SWEEP, swept.lstrip(), "", LIMITS])


def show(path: Path, folder: Path) -> str:
    """Write the page: that of the documentation, or one beside a result that is elsewhere."""
    content = json.loads(path.read_text())
    place = (
        PAGE if path.parent == PAGE.parents[1] / "benchmarks" / "results" else folder / "hard.md"
    )
    return str(write_atomically(place, page(content).encode()))


if __name__ == "__main__":
    benchmark("hard", __doc__, record, ((None, None), (3, 2)), show)
