"""Centre-of-mass estimation over seeds as work: one of the report's cases, one filter, many runs."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import jax
import numpy as np

from ..estimation.assess import Estimates, convergence, estimate_case, settled_from
from ..estimation.cases import CASES, Record, simulate_case
from ..estimation.tuning import Tuning, consistent_tuning, report_tuning
from ..mechanics.errors import SettingError
from .work import FINE, AbstractWork, Axis, Column

# Runs estimated together; a sample is always in the same place of the same block.
BLOCK = 64
# Every how many steps of the filter errors are kept.
SPACING = 20
LOST = 2


@dataclass(frozen=True)
class EstimationStudy:
    """Runs of one case, each with noise of its own seed.

    Attributes:
        name: short, for files. case: of the report, 1 to 8.
        tuning: "report" (Table 2.4.2) or "consistent". t1: end [s].
        seed: of the first run; sample i is that of seed + i.

    Raises:
        SettingError: another case or tuning, an impossible end or seed.
    """

    name: str
    case: int
    tuning: Literal["report", "consistent"] = "consistent"
    t1: float = 2.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.case not in CASES:
            raise SettingError(f"The report has cases 1 to 8, not {self.case}.")
        if self.tuning not in ("report", "consistent"):
            raise SettingError(f"The tuning is report or consistent, not '{self.tuning}'.")
        if not 0.05 <= self.t1 <= 1e3:
            raise SettingError(f"The end must lie between 0.05 and 1000 s, not {self.t1:g} s.")
        if self.seed < 0:
            raise SettingError(f"The seed must not be negative, but it is {self.seed}.")

    def plain(self) -> dict[str, Any]:
        """Everything that decides the numbers, as plain data."""
        return {
            "kind": "estimation", "name": self.name, "case": self.case, "tuning": self.tuning,
            "t1": self.t1, "seed": self.seed, "settled": settled_from(self.t1),
        }  # fmt: skip


class EstimationWork(AbstractWork):
    """An `EstimationStudy`'s runs by number."""

    def __init__(self, study: EstimationStudy) -> None:
        self.study = study

    def __getstate__(self) -> dict[str, Any]:
        """The tuning is made again where it is needed."""
        return {"study": self.study}

    @property
    def identity(self) -> Mapping[str, Any]:
        """The study's plain data."""
        return self.study.plain()

    @property
    def unit(self) -> int:
        """Runs estimated together."""
        return BLOCK

    @property
    def columns(self) -> Mapping[str, Column]:
        """The seed, how the offset converges, errors, consistency, and the status."""
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
        """Times of the kept errors."""
        return {"time": Axis(self._times[SPACING::SPACING], "s")}

    @property
    def reasons(self) -> Mapping[int, str]:
        """Of filters that failed."""
        return {LOST: "the filter lost its covariance"}

    @cached_property
    def _times(self) -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(self._record(0, 1).t)

    @cached_property
    def _tuning(self) -> Tuning:
        if self.study.tuning == "report":
            return report_tuning()
        return consistent_tuning(self.study.case)

    def _record(self, first: int, count: int) -> Record:
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
    """Of every run (s,), and errors at the kept times (s, k)."""
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
