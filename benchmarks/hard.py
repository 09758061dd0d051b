"""Hard cases against known motions: the error that is demanded, the one reached, and what it takes.

    taskset -c 1 python benchmarks/hard.py

writes `results/hard.json`.
"""

import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from peers import ExudynPeer, MujocoC, PinocchioCpp
from peers.adapter import Peer
from problems.hard import CASES, STARTS, TOLERANCES, Hard, run_of, swinging
from shared.record import benchmark

import stmuav_jax as stm

PEERS: tuple[type[Peer], ...] = (MujocoC, ExudynPeer, PinocchioCpp)


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


def record(size: tuple[int | None, int | None]) -> Iterator[dict[str, Any]]:
    """So many cases and tolerances."""
    content: dict[str, Any] = {"what": "hard cases against known motions", "cases": []}
    peers = [peer() for peer in PEERS]
    for case in CASES[: size[0]]:
        content["cases"].append(row_of(case))
        if case.of_positions:
            content["cases"][-1]["peers"] = [beside(case, peer) for peer in peers]
        print(content["cases"][-1], flush=True)
    made = STARTS[: size[0]]
    content["starts"] = [singular_start(name, why, build()) for name, why, build in made]
    content["tolerances"] = list(sweep(TOLERANCES[: size[1]]))
    yield content


if __name__ == "__main__":
    benchmark("hard", __doc__, record, ((None, None), (3, 2)))
