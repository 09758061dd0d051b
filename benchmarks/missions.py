"""Robustness of a mission: share of its flights within 0.5 m and 15 degrees, and flights per second.

The UAV with its tracker holds its place for 30 s in moderate Dryden gusts, on noisy sensors and its
estimator, which stood for 3 s before. Every mass and inertia, thrust and drag torque of the rotors,
their arms, the panel's centre of mass, the airframe's drag and the motors' lag are drawn with a
standard deviation of 5 %, truncated at four of them; each flight has gusts and noise of its own.
Controller and estimator believe the nominal numbers. On one core:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 taskset -c 1 python benchmarks/missions.py

The share has Wilson's interval of 95 %.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from shared.record import benchmark

import stmuav_jax as stm
from stmuav_jax.studies.statistics import probability


@dataclass(frozen=True)
class Size:
    """How much is flown: flights, and the time of each [s]."""

    flights: int = 1008
    t1: float = 30.0


QUICK = Size(flights=16, t1=0.1)
DEVIATION = 0.05
BODIES = ("hexacopter_1", "slider_2", "slider_3", "post_4", "rod_5", "rod_6", "panel_7")
FACTORS = (
    *(f"{kind}.{body}" for body in BODIES for kind in ("mass", "inertia")),
    "rotor.k_f", "rotor.k_tau", "rotor.arms", "geometry.panel_com", "drag.linear", "drag.quadratic",
    "motor.time_constant",
)  # fmt: skip
SHARE = {
    "distribution": "truncated_normal", "mean": 1.0, "standard_deviation": DEVIATION,
    "low": 1.0 - 4 * DEVIATION, "high": 1.0 + 4 * DEVIATION,
}  # fmt: skip
MISSION: dict[str, Any] = {
    "format": 1, "name": "robustness",
    "machine": {"scene": "uav_tracker", "options": {"drag": {}, "motor": {}}},
    "sensors": {},
    "controller": {"gains": {"integral": 5.0}},
    "wind": {"steady": [5.0, 0.0, 0.0], "gusts": {"height": 20.0, "speed_20ft": 15.4}},
    "tolerances": {"position": 0.5, "tilt": 15.0},
}  # fmt: skip


def make_study(t1: float) -> stm.Study:
    """Study of the mission."""
    mission = stm.missions.make_mission(MISSION | {"t1": t1})
    factors = dict.fromkeys(FACTORS, SHARE)
    return stm.missions.make_mission_study(mission, factors, relative=frozenset(FACTORS))


def share(columns: dict[str, np.ndarray]) -> dict[str, Any]:
    """Share of the flights that met tolerances and limits, with its interval, and quantiles of the largest errors."""
    found = probability(int(np.sum(columns["met"])), len(columns["met"]))
    fine = columns["status"] == 1
    tilt = np.degrees(columns["tilt_error"][fine])
    quantiles = lambda x: {f"{q:g}": float(np.quantile(x, q)) for q in (0.5, 0.95, 0.99, 1.0)}
    return {
        "flights": len(fine), "kept": int(np.sum(columns["met"])), "not_finite": int(np.sum(~fine)),
        "share": found.value, "share_low": found.low, "share_high": found.high,
        "position_m": quantiles(columns["position_error"][fine]) if np.any(fine) else {},
        "tilt_degrees": quantiles(tilt) if np.any(fine) else {},
        "least_rotor_margin": float(np.min(columns["rotor_margin"][fine], initial=1.0)),
        "least_stroke_margin": float(np.min(columns["stroke_margin"][fine], initial=1.0)),
    }  # fmt: skip


def measure(size: Size) -> Iterator[dict[str, Any]]:
    """Yield the record after each block of flights; the first block's time includes compiling."""
    of, parts, times = make_study(size.t1), [], []
    for first in range(0, size.flights, of.unit):
        clock = time.perf_counter()
        parts.append(of.compute(first, min(of.unit, size.flights - first)))
        times.append(time.perf_counter() - clock)
        columns = {k: np.concatenate([part[k] for part in parts]) for k in parts[0]}
        steady = times[1:] or times
        rate = (len(columns["met"]) - (of.unit if times[1:] else 0)) / sum(steady)
        yield {
            "t1": size.t1, "deviation": DEVIATION, "factors": list(FACTORS), **share(columns),
            "first_block_s": times[0], "flights_per_second": rate,
            "times_real_time": rate * size.t1,
        }  # fmt: skip


if __name__ == "__main__":
    benchmark("missions", __doc__, measure, (Size(), QUICK))
