"""Monte Carlo study of centre-of-mass estimation: one case, one filter, many noise seeds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from ..math.compiler import compute_untraced
from ..uav.quadrotor.assessment import (
    consistent_tuning,
    estimate_case,
    last_beyond,
    report_tuning,
    settled_from,
)
from ..uav.quadrotor.cases import record_times, simulate_case
from .columns import FINE, Axis, Column
from .schema import EstimationFile
from .study import AbstractBatch, Study

# Runs estimated together; a sample is always in the same place of the same block.
LANES = 64
# Number of filter steps between kept errors.
SPACING = 20
LOST = 2


@dataclass(frozen=True)
class CaseEvaluation(AbstractBatch):
    """Function of a noise seed that simulates one case, filters it, and returns measures of the estimates.

    Attributes:
        case, tuning, t1: entries of the study, see `stmuav_jax.studies.schema.EstimationFile`.
    """

    case: int
    tuning: str
    t1: float

    def evaluate_batch(
        self, samples: Mapping[str, Any], keys: Any, count: Any, lanes: int
    ) -> dict[str, Any]:
        """Outcomes (n, ...) of n seeds, by column."""
        seeds = samples["seed"].astype(jnp.int64)
        record = simulate_case(self.case, seeds=seeds, t1=self.t1)
        make = lambda: report_tuning() if self.tuning == "report" else consistent_tuning(self.case)
        estimates = estimate_case(record, compute_untraced(make))
        is_valid = estimates.ok[-1]
        hide = lambda x: jnp.where(is_valid.reshape(-1, *[1] * (x.ndim - 1)), x, jnp.nan)
        t = record_times(self.t1)
        settled_mask = t[1:] > settled_from(self.t1)
        mean = lambda x: jnp.mean(x[settled_mask], axis=0)
        error = estimates.error[:, 3:]
        # Never is a time of infinity: quantiles over runs stay right, where NaN would drop the worst runs.
        converged = lambda within: jnp.nan_to_num(last_beyond(error, t, within), nan=jnp.inf)
        # Curves are for pictures; all steps of thousands of runs would be gigabytes.
        stored_error = error[SPACING - 1 :: SPACING]
        measures = {
            "to_2cm": converged(0.02),
            "to_5mm": converged(0.005),
            "rmse_x": jnp.sqrt(mean(error[:, 0] ** 2)),
            "rmse_y": jnp.sqrt(mean(error[:, 1] ** 2)),
            "nees": mean(estimates.nees_offset),
            "nis": mean(estimates.nis),
            "error_x": stored_error[:, 0].T,
            "error_y": stored_error[:, 1].T,
        }
        status = jnp.where(is_valid, FINE, LOST)
        return {name: hide(x) for name, x in measures.items()} | {"status": status}


def make_estimation_study(
    entries: EstimationFile, *, lanes: int | None = None, devices: int | None = None
) -> Study:
    """Study of one case, with runs of different noise; sample i has the seed `entries.seed` + i.

    Args:
        entries: the study's entries. lanes, devices: see `Study`.
    """
    after = f"after {settled_from(entries.t1):g} s"
    labels: dict[str, tuple[str, str]] = {
        "to_2cm": ("s", "last time at which the offset is 2 cm wrong"),
        "to_5mm": ("s", "last time at which the offset is 5 mm wrong"),
        "rmse_x": ("m", f"rms error of the offset's x {after}"),
        "rmse_y": ("m", f"rms error of the offset's y {after}"),
        "nees": ("1", f"mean NEES of the offset (2 degrees), {after}"),
        "nis": ("1", f"mean NIS (3 degrees of freedom), {after}"),
        "error_x": ("m", "error of the offset's x"),
        "error_y": ("m", "error of the offset's y"),
    }
    columns = {"seed": Column("int64", "1", "seed of the noise", "input")} | {
        name: Column("float64", *text, dims=("time",) if name.startswith("error") else ())
        for name, text in labels.items()
    }
    identity = entries.model_dump(include={"kind", "case", "tuning", "t1"})
    return Study(
        CaseEvaluation(entries.case, entries.tuning, entries.t1),
        {"seed": {"distribution": "counter", "first": entries.seed}},
        samples=entries.samples, name=entries.name, chunk=entries.chunk,
        columns=columns | {"status": Column("int8", "1", "how the filter ended", "status")},
        axes={"time": Axis(record_times(entries.t1)[SPACING::SPACING], "s")},
        reasons={LOST: "the filter lost its covariance"},
        identity=identity | {"settled": settled_from(entries.t1)},
        lanes=LANES if lanes is None else lanes, devices=devices,
    )  # fmt: skip
