"""Figures and tables of docs/estimation.md; takes minutes.

    python docs/make_estimation.py [walk] [loads] [cases] [hover]

Writes docs/figures/estimation/*.png and numbers.json. The tables of the eight cases and of the
hover are those of `stmuav estimate` and `stmuav estimate --hover`.
"""

import json
import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from rich.console import Console

import stmuav_jax as stm
from stmuav_jax.algebra import outer_jit
from stmuav_jax.figures import (
    CASE_FIGURES,
    hover,
    hover_table,
    save_figures,
    summary_table,
)

FOLDER = Path(__file__).parent / "figures" / "estimation"


def cases() -> tuple[list, dict]:
    """All cases with both tunings, 50 seeds, 2 s; figures of case 8; RMSE of smoother and filter."""
    report = stm.quadrotor.report_tuning()
    consistent = {
        False: stm.quadrotor.consistent_tuning(1),
        True: stm.quadrotor.consistent_tuning(5),
    }
    rows, smoothed = [], {}
    for case in range(1, 9):
        own = consistent[case > 4]
        study = stm.quadrotor.study_case(case, [report, own])
        rows += study.summaries.values()
        if case in (1, 8):
            late = stm.quadrotor.estimate_case(study.record, own, smoothed=True)
            rmse = lambda e: np.sqrt(np.mean(np.asarray(e.error)[1200:, 3:] ** 2, axis=(0, 2)))
            smoothed[case] = [
                (1e3 * rmse(e)).tolist() for e in (study.estimates["consistent"], late)
            ]
        if case == 8:
            save_figures(CASE_FIGURES, FOLDER, "png", study, dpi=120)
    out = Console(width=100)
    out.print(summary_table(rows))
    for row in rows:
        out.print(f"case {row.case}, {row.tuning}: {row.verdict.short}", highlight=False)
    return [row.plain() for row in rows], smoothed


def hovers() -> None:
    """Both tunings, 50 seeds, 2 s."""
    flights = {name: stm.quadrotor.simulate_hover(1, name) for name in ("report", "consistent")}
    Console(width=130).print(hover_table(flights))
    save_figures({"hover": hover}, FOLDER, "png", flights, dpi=120)


def loads() -> dict:
    """What a filter with constant inertia makes of a load with mass: errors at the end [mm]."""
    found = {}
    for load, case, t1 in ((0.5, 1, 0.2), (1.0, 1, 0.2), (2.0, 1, 0.2), (1.0, 5, 1.0)):
        record = stm.quadrotor.simulate_case(
            case, seeds=10, t1=t1, world=stm.quadrotor.World(load=load, walk=False)
        )
        start = {0.5: (0.07, 0.13), 1.0: (0.06, 0.13), 2.0: (0.07, 0.06)}[load]
        swing = 4 * (case > 4)
        mean = np.array([0.1, 0.2, 0.3, *start, *[0.0] * swing])
        prior = stm.estimation.gaussian(mean, np.diag([0.1] * 3 + [0.04] * 2 + [0.05] * swing) ** 2)
        for known in (False, True):
            model = stm.quadrotor.extended_model(
                period=2.0 if swing else None, load=load if known else None
            )
            run = lambda y, u, m=model, p=prior: stm.estimation.filter_bank(
                m, p, y, u=u, dt=1e-3
            ).mean[-1]
            last = np.asarray(outer_jit(run)(record.y, record.u))
            offset = last[3:5] + (last[5:7] if swing else 0.0)
            error = np.mean(offset - np.asarray(record.offset)[-1], axis=1)
            found[f"{load} kg, case {case}, {'known' if known else 'neglected'}"] = (
                1e3 * error
            ).tolist()
    return found


def followed() -> dict:
    """The random walk that makes case 5 most likely: variance per step of the offset [m^2]."""
    record = stm.quadrotor.simulate_case(5, seeds=8, t1=1.0)
    value = stm.quadrotor.PART_III.value
    first, R = list(value("true.Q")[3:6]), value("true.R")
    prior = stm.estimation.gaussian(
        np.array([0.1, 0.2, 0.3, 0.05, 0.1]), np.diag([0.1, 0.1, 0.1, 0.01, 0.01]) ** 2
    )

    def model_of(v: dict) -> stm.estimation.StateSpaceModel:
        Q = jnp.concatenate([jnp.asarray(first), v["walk"]])
        return stm.quadrotor.observable_model(Q=Q, R=R)

    found = stm.estimation.tune(
        model_of, {"walk": np.array([1e-8, 1e-8])}, prior, record.y, u=record.u, dt=1e-3
    )
    return {"variance": found.values["walk"].tolist(), "reason": found.reason,
            "gain of log-likelihood": found.log_likelihood - float(found.history[0])}  # fmt: skip


def tabled() -> dict:
    """The eight cases, and what smoothing leaves."""
    rows, smoothed = cases()
    return {"cases": rows, "smoother": smoothed}


PARTS = {
    "walk": lambda: {"random walk": followed()},
    "loads": lambda: {"loads": loads()},
    "cases": tabled,
    "hover": lambda: hovers() or {},
}


def main(names: list[str]) -> None:
    """The parts that are named, or everything; numbers of the other parts stay."""
    path = FOLDER / "numbers.json"
    numbers = json.loads(path.read_text()) if path.exists() else {}
    for name in names or PARTS:
        numbers |= PARTS[name]()
        path.write_text(json.dumps(numbers, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
