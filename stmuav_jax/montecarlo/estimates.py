"""Monte Carlo study of centre-of-mass estimation: one case, one filter, many noise seeds."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import jax
import numpy as np

from ..checks.schema import checked
from ..quadrotor.assess import Estimates, convergence, estimate_case, settled_from
from ..quadrotor.cases import CaseRecord, simulate_case
from ..quadrotor.tuning import FilterTuning, consistent_tuning, report_tuning
from .schema import EstimationFile
from .work import FINE, AbstractWork, Axis, Column

# Runs estimated together; a sample is always in the same place of the same block.
BLOCK = 64
# Number of filter steps between kept errors.
SPACING = 20
LOST = 2


@dataclass(frozen=True)
class EstimationStudy:
    """Study of one case, with runs of different noise.

    Attributes:
        name: short name for files.
        case: case of the report, 1 to 8.
        tuning: "report" (Table 2.4.2) or "consistent".
        t1: final time [s].
        seed: seed of the first run; sample i has seed + i.

    Raises:
        SettingError: another case or tuning, an impossible end or seed.
    """

    name: str
    case: int
    tuning: Literal["report", "consistent"] = "consistent"
    t1: float = 2.0
    seed: int = 0

    def __post_init__(self) -> None:
        given = {"kind": "estimation", **vars(self)}
        checked(EstimationFile, given, "A study of estimation")

    def plain(self) -> dict[str, Any]:
        """Plain data of everything on which the numbers depend."""
        return {
            "kind": "estimation", "name": self.name, "case": self.case, "tuning": self.tuning,
            "t1": self.t1, "seed": self.seed, "settled": settled_from(self.t1),
        }  # fmt: skip


class EstimationWork(AbstractWork):
    """Work of an `EstimationStudy`: its runs by number."""

    def __init__(self, study: EstimationStudy) -> None:
        self.study = study

    def __getstate__(self) -> dict[str, Any]:
        """State without the tuning, which is made again where it is needed."""
        return {"study": self.study}

    @property
    def identity(self) -> Mapping[str, Any]:
        """Plain data of the study."""
        return self.study.plain()

    @property
    def unit(self) -> int:
        """Number of runs estimated together."""
        return BLOCK

    @property
    def columns(self) -> Mapping[str, Column]:
        """Columns of the seed, the offset's convergence, errors, consistency, and the status."""
        real, time, after = "float64", ("time",), f"after {settled_from(self.study.t1):g} s"
        return {
            "seed": Column("int64", "1", "seed of the noise", "input"),
            "to_2cm": Column(real, "s", "last time at which the offset is 2 cm wrong"),
            "to_5mm": Column(real, "s", "last time at which the offset is 5 mm wrong"),
            "rmse_x": Column(real, "m", f"rms error of the offset's x {after}"),
            "rmse_y": Column(real, "m", f"rms error of the offset's y {after}"),
            "nees": Column(real, "1", f"mean NEES of the offset (2 degrees), {after}"),
            "nis": Column(real, "1", f"mean NIS (3 degrees of freedom), {after}"),
            "error_x": Column(real, "m", "error of the offset's x", dims=time),
            "error_y": Column(real, "m", "error of the offset's y", dims=time),
            "status": Column("int8", "1", "how the filter ended", "status"),
        }

    @property
    def axes(self) -> Mapping[str, Axis]:
        """Time axis of the kept errors."""
        return {"time": Axis(self._times[SPACING::SPACING], "s")}

    @property
    def reasons(self) -> Mapping[int, str]:
        """Reasons of failed filters by code."""
        return {LOST: "the filter lost its covariance"}

    @cached_property
    def _times(self) -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(self._record(0, 1).t)

    @cached_property
    def _tuning(self) -> FilterTuning:
        if self.study.tuning == "report":
            return report_tuning()
        return consistent_tuning(self.study.case)

    def _record(self, first: int, count: int) -> CaseRecord:
        study = self.study
        return simulate_case(study.case, seeds=count, t1=study.t1, seed=study.seed + first)

    def run(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns of the runs first, first + 1, ..."""
        if not count:
            axis = len(self.axes["time"].values)
            return {
                k: np.zeros((0, axis) if c.dims else 0, c.dtype) for k, c in self.columns.items()
            }
        blocks = range(first // BLOCK, (first + count - 1) // BLOCK + 1)
        with jax.enable_x64(True):
            parts = [self._block(number) for number in blocks]
        skip = first - blocks[0] * BLOCK
        joined = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
        return {k: joined[k][skip : skip + count].astype(c.dtype) for k, c in self.columns.items()}

    def _block(self, number: int) -> dict[str, np.ndarray]:
        first = number * BLOCK
        record = self._record(first, BLOCK)
        found = estimate_case(record, self._tuning)
        fine = np.asarray(found.ok)[-1]
        columns = _measures(found, np.asarray(record.t))
        columns = {k: np.where(_wide(fine, v), v, np.nan) for k, v in columns.items()}
        seeds = self.study.seed + first + np.arange(BLOCK)
        return columns | {"seed": seeds, "status": np.where(fine, FINE, LOST)}


def _wide(fine: np.ndarray, value: np.ndarray) -> np.ndarray:
    return fine.reshape(-1, *([1] * (value.ndim - 1)))


def _measures(found: Estimates, t: np.ndarray) -> dict[str, np.ndarray]:
    """Measures of every run (s,), and errors at the kept times (s, k)."""
    settled = t[1:] > settled_from(t[-1])
    error = np.asarray(found.error)[:, 3:]
    never = lambda when: np.where(np.isnan(when), np.inf, when)
    rmse = np.sqrt(np.mean(error[settled] ** 2, axis=0))
    kept = error[SPACING - 1 :: SPACING]
    return {
        "to_2cm": never(convergence(found, t, 0.02)),
        "to_5mm": never(convergence(found, t, 0.005)),
        "rmse_x": rmse[0],
        "rmse_y": rmse[1],
        "nees": np.mean(np.asarray(found.nees_offset)[settled], axis=0),
        "nis": np.mean(np.asarray(found.nis)[settled], axis=0),
        "error_x": kept[:, 0].T,
        "error_y": kept[:, 1].T,
    }
