"""How far the deviations of an identification from a flight log hold: simulated flights of known truth.

Flights in closed loop, with gusts, noise, biases, lag, delay and on-board filters: plain ones for the bias and
the cover of every estimate, and longer ones with a second lag or a sagging battery, which the verdict must say.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from problems.multirotor_flights import LAYOUT, TRUTH, VALUES, Truth, simulate_flights
from shared.record import benchmark

from stmuav_jax.uav import identify_flight

# Lengths [s], flights that are simulated together, and first seed.
PLAIN, LONGER, TOGETHER, FIRST = 30.0, 40.0, 5, 1000
# Changes of the vehicle, with the test of the verdict that must say them.
CHANGES = {
    "second lag of 10 ms": ("lag", {"second_lag": 0.01}),
    "sag of 0.3": ("sag", {"sag": 0.3}),
}
# Level at which a sentence is said.
LEVEL = 0.01


def identify(count: int, length: float, truth: Truth) -> Iterator[Any]:
    """Identification of each of a number of flights."""
    for first in range(FIRST, FIRST + count, TOGETHER):
        seeds = range(first, min(first + TOGETHER, FIRST + count))
        for record in simulate_flights(seeds, length, truth):
            yield identify_flight(record, LAYOUT)


def summarise(name: str, errors: list[tuple[float, float, float]]) -> dict[str, Any]:
    """Bias and cover of an estimate, from its errors, deviations and those of white residuals."""
    error, deviation, white = np.array(errors).T
    z, scale = error / deviation, abs(VALUES[name])
    return {
        "quantity": name, "flights": len(z), "cover_68": float(np.mean(np.abs(z) < 1)),
        "cover_95": float(np.mean(np.abs(z) < 1.96)), "mean_in_deviations": float(np.mean(z)),
        "scatter_in_deviations": float(np.std(z)), "deviation": float(np.median(deviation)),
        "over_white": float(np.median(deviation / white)),
        "bias_percent": 100 * float(np.mean(error)) / scale if scale else None,
    }  # fmt: skip


def measure(sizes: tuple[int, int]) -> Iterator[dict[str, Any]]:
    """Record after each flight, of numbers of plain flights and of those of each change."""
    content: dict[str, Any] = {
        "what": "identification of simulated flights",
        "estimates": [],
        "said": [],
    }
    errors: dict[str, list[tuple[float, float, float]]] = {}
    p_values: list[dict[str, float]] = []
    consistent = 0
    for result in identify(sizes[0], PLAIN, TRUTH):
        for name, value in VALUES.items():
            if name in result.estimates:
                e = result.estimates[name]
                errors.setdefault(name, []).append((e.value - value, e.deviation, e.white))
        p_values.append(result.verdict.p_values)
        consistent += result.verdict.status == "consistent"
        content["estimates"] = [summarise(name, values) for name, values in errors.items()]
        content["consistent"] = consistent / len(p_values)
        content["said"] = [said("nothing", test, p_values, PLAIN) for test, _ in CHANGES.values()]
        yield content
    plain = content["said"]
    for change, (test, numbers) in CHANGES.items():
        p_values = []
        for result in identify(sizes[1], LONGER, TRUTH._replace(**numbers)):
            p_values.append(result.verdict.p_values)
            content["said"] = [*plain, said(change, test, p_values, LONGER)]
            yield content
        plain = content["said"]


def said(change: str, test: str, p_values: list[dict[str, float]], length: float) -> dict[str, Any]:
    """Share of flights in which a sentence is said."""
    share = float(np.mean([p.get(test, 1.0) < LEVEL for p in p_values]))
    return {
        "change": change,
        "test": test,
        "flights": len(p_values),
        "length": length,
        "share": share,
    }


if __name__ == "__main__":
    benchmark("flight_logs", __doc__, measure, ((100, 25), (2, 1)))
