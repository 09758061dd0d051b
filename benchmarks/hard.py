"""Hard cases against known motions: the error that is demanded, the one reached, and what it takes.

    taskset -c 1 python benchmarks/hard.py

writes `results/hard.json` and the section "Hard cases" of `docs/validation.md`.
"""

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from peers import ExudynPeer, MujocoC, PinocchioCpp
from peers.adapter import Peer
from problems.hard import CASES, TOLERANCES, Hard, run_of, swinging
from problems.hard_loops import LOOP_CASES, STARTS
from shared.command import benchmark
from shared.page_sections import write_section
from shared.pages import number, titled
from shared.record import ROOT

import stmuav_jax as stm

EVERY = (*CASES, *LOOP_CASES)
PEERS: tuple[type[Peer], ...] = (MujocoC, ExudynPeer, PinocchioCpp)
PAGE = ROOT / "docs" / "validation.md"
HEAD = """## Hard cases

Each case has a known motion. The table compares the error of a run with the required error and with the run's own
estimate; run times are without compilation. Settings are the defaults of `simulate` unless stated otherwise.
[Evidence](#evidence) names the script.
"""
SWEEP = """### All tolerances

A pendulum of 1 m is released with a horizontal rod and swings for 4.8 s. The required error is the larger of 1,000
tolerances and 1e-11 m.
"""
SINGULAR = """### Starts at a singular posture

The branch of the motion is undetermined, so the start must raise an error that names the posture:
"""
BESIDE = """### Other programs

The table gives error, run time and setting (fixed step or tolerance) of other programs at their finest setting, for
cases with position errors. "Not in our adapter" marks a limit of our adapters (`benchmarks/peers`), not of the
program.
"""
LIMITS = """### Limits

- **Distance from the origin.** A mechanism that is connected to ground only by rods or loop-closing joints stops with
  "the step size fell to round-off" 1,000 km or more from the origin. Put the origin near the mechanism, or set
  `formulation=stm.Augmented()`. A mechanism with a tree joint to ground has no such limit.
- **Size.** The absolute tolerance is a length in metres. For sliding or floating bodies much smaller than a millimetre
  the default of 1e-8 m is too coarse: set a smaller tolerance. Motion in angles only, such as that of rods on
  hinges, is equally accurate at any size.
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


def beside(case: Hard, peer: Peer) -> dict[str, Any]:
    """One case by another program: error and seconds, or the reason why there are none."""
    system, state, ts = case.build()
    scene = stm.Scene(case.name, case.why, system, state, t1=float(ts[-1]))
    row: dict[str, Any] = {"peer": peer.name, "error": None, "seconds": None, "setting": None}
    if reason := peer.missing() or peer.unsupported(scene):
        return row | {"reason": reason}
    reason = "No setting has steps that end at the output times."
    for setting in reversed(peer.settings(scene)):
        try:
            prepared = peer.prepare(scene, ts, setting)
        except ValueError:
            continue
        except Exception as error:
            return row | {"reason": f"{type(error).__name__}: {error}"[:160]}
        clock = time.perf_counter()
        outcome = prepared.run()
        spent = outcome.seconds or [time.perf_counter() - clock]
        row["setting"] = {key: getattr(setting, key) for key in ("solver", "tolerance", "step")}
        if outcome.failure or not np.all(np.isfinite(outcome.positions)):
            return row | {"reason": outcome.failure or "Its positions are not finite."}
        seen: Any = SimpleNamespace(ts=ts, states=SimpleNamespace(r=outcome.positions))
        return row | {"error": case.error(seen), "seconds": float(np.median(spent)), "reason": ""}
    return row | {"reason": reason}


def singular_start(name: str, why: str, system: stm.System) -> dict[str, Any]:
    """A start in a singular posture: how far a run came, and what was said."""
    try:
        run = stm.simulate(system, system.reference, t1=0.1, throw=False)
        reached, said = run.certificate.t_end, run.failure or run.certificate.error_words
    except stm.StateError as error:
        reached, said = 0.0, str(error)
    named = "the start is a singular posture" in said.lower()
    return {"name": name, "why": why, "t_end": reached, "said": said, "named": named}


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
    peers = [peer() for peer in PEERS]
    for case in EVERY[: size[0]]:
        content["cases"].append(row_of(case))
        if case.of_positions:
            content["cases"][-1]["peers"] = [beside(case, peer) for peer in peers]
        print(content["cases"][-1], flush=True)
    made = STARTS[: size[0]]
    content["starts"] = [singular_start(name, why, build()) for name, why, build in made]
    content["tolerances"] = list(sweep(TOLERANCES[: size[1]]))
    yield content


def result_of(one: dict[str, Any]) -> str:
    """Error, seconds and setting of another program; or the reason why there is none, and at which setting."""
    setting, at = one["setting"], ""
    if setting is not None:
        tolerance, step = setting["tolerance"], setting["step"]
        at = f"step {step:.2g} s" if tolerance is None else f"tolerance {tolerance:.0e}"
    if reason := one["reason"]:
        if "not supported" in reason:
            return "not in our adapter"
        return f"{reason.rstrip('.')} ({at})." if at else reason
    return f"{two(one['error'])}, {two(one['seconds'])} s ({at})"


def more(content: dict[str, Any]) -> list[str]:
    """Sections on singular starts and on other programs, where the record has them."""
    parts: list[str] = []
    if starts := content.get("starts"):
        named = lambda x: "yes" if x else "no"
        columns = (
            ("start", "name"),
            ("difficulty", "why"),
            ("error names the posture", "named", named),
        )
        parts += [SINGULAR, titled("", starts, *columns).lstrip(), ""]
    ran = [row for row in content["cases"] if row.get("peers")]
    if ran:
        cell = lambda k: lambda row: result_of(row["peers"][k])
        names = [(one["peer"], None, cell(k)) for k, one in enumerate(ran[0]["peers"])]
        ours = ("stmuav_jax", None, with_unit("reached"))
        parts += [BESIDE, titled("", ran, ("case", "name"), ours, *names).lstrip(), ""]
    return parts


def two(value: float | None) -> str:
    """Two digits, or a dash."""
    return number(value, digits=2)


def with_unit(key: str) -> Callable[[dict[str, Any]], str]:
    """Two digits of a case's number and its unit, or a dash."""
    return lambda row: "-" if row[key] is None else f"{two(row[key])} {row['unit']}"


def page(content: dict[str, Any]) -> str:
    """The page, from the record alone."""
    steps = lambda row: f"{row['accepted']:,} + {row['rejected']:,}"
    effort = ("steps", None, steps), ("run [s]", "seconds", two)
    energy = ("energy, relative", "relative_energy_error", two)
    drift = ("constraint violation [m]", "position_violation", two), energy
    reached = (
        ("required", None, lambda row: f"{row['demanded']:.0e} {row['unit']}"),
        ("error", None, with_unit("reached")),
        ("estimated by the run", None, with_unit("estimated")),
    )
    rows = [*content["cases"], *content["tolerances"]]
    missed = [row["name"] for row in rows if not holds(row)]
    verdict = f"Missed: {', '.join(missed)}." if missed else "All cases meet the required error."
    where = "Run times are for one core."
    cases = titled(
        "### Cases", content["cases"], ("case", "name"), ("difficulty", "why"),
        ("compared with", "truth"), *reached, *drift, *effort,
    )  # fmt: skip
    swept = titled(
        "", content["tolerances"], ("tolerance", "tolerance", "{:.0e}".format), *reached, *effort
    )
    parts = [HEAD, f"{where} {verdict}", "", cases, "", SWEEP, swept.lstrip(), ""]
    return "\n".join([*parts, *more(content), LIMITS])


def show(path: Path, folder: Path) -> str:
    """Write the page: that of the documentation, or one beside a result that is elsewhere."""
    content = json.loads(path.read_text())
    place = (
        PAGE if path.parent == PAGE.parents[1] / "benchmarks" / "results" else folder / "hard.md"
    )
    return str(write_section(place, "benchmarks/hard.py", page(content)))


if __name__ == "__main__":
    benchmark("hard", __doc__, record, ((None, None), (3, 2)), show)
