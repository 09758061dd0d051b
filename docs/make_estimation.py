"""Figures and tables of docs/estimation.md; takes minutes.

    python docs/make_estimation.py [walk] [cases]

Writes docs/figures/estimation/*.png and numbers.json. The table of the eight cases is that of
`stmuav estimate`.
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
from stmuav_jax.figures import (
    CASE_FIGURES,
    save_figures,
    summary_table,
)

FOLDER = Path(__file__).parent / "figures" / "estimation"


def cases() -> tuple[list, dict]:
    """All cases with both tunings, 50 seeds, 2 s; figures of case 8; RMSE of smoother and filter."""
    report = stm.uav.report_tuning()
    consistent = {
        False: stm.uav.consistent_tuning(1),
        True: stm.uav.consistent_tuning(5),
    }
    rows, smoothed = [], {}
    for case in range(1, 9):
        own = consistent[case > 4]
        study = stm.uav.study_case(case, [report, own])
        rows += study.summaries.values()
        if case in (1, 8):
            late = stm.uav.estimate_case(study.record, own, smoothed=True)
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


def followed() -> dict:
    """The random walk that makes case 5 most likely: variance per step of the offset [m^2]."""
    record = stm.uav.simulate_case(5, seeds=8, t1=1.0)
    value = stm.uav.PART_III.value
    first, R = list(value("true.Q")[3:6]), value("true.R")
    prior = stm.estimation.gaussian(
        np.array([0.1, 0.2, 0.3, 0.05, 0.1]), np.diag([0.1, 0.1, 0.1, 0.01, 0.01]) ** 2
    )

    def model_of(v: dict) -> stm.estimation.StateSpaceModel:
        Q = jnp.concatenate([jnp.asarray(first), v["walk"]])
        return stm.uav.observable_model(Q=Q, R=R)

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
    "cases": tabled,
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
