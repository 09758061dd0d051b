"""What single precision costs a study in accuracy, measured on some of its own flights."""

import numpy as np

from .batch import FlightWork
from .study import with_precision


def precision_error(work: FlightWork, count: int) -> dict[str, tuple[float, str]]:
    """Largest differences of a study's quantities between single and double precision.

    The flights are flown in both precisions, double with its own tolerances of 1e-10, and those
    that failed in either are left out.

    Returns:
        by quantity: the largest difference and its unit; NaN where no flight is left.
    """
    study = work.study
    exact = with_precision(study, float32=False, rtol=1e-10, atol=1e-10)
    single = FlightWork(with_precision(study, float32=True), block=count)
    high = FlightWork(exact, block=count).run(0, count)
    low = single.run(0, count)
    fine = (low["status"] == 1) & (high["status"] == 1)
    found = {}
    for name in study.quantities:
        both = np.isfinite(low[name]) & np.isfinite(high[name])
        both[~fine] = False
        off = np.abs(low[name][both] - high[name][both])
        worst = float(np.max(off)) if off.size else float("nan")
        found[name] = (worst, single.columns[name].unit)
    return found
