"""Orders of the implicit solvers, observed on the motion of a mechanism: within 0.2 of the nominal ones.

The slow heavy top of `tests/published/test_heavy_top.py`, which has those of the explicit ones, in the
coordinates of its joint and in maximal coordinates with projection, by equal steps. Steps are so fine that
the next order no longer shows, and so coarse that round-off does not yet.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import make_equal_steps
from problems.conservative import SLOW, top

import stmuav_jax as stm
from stmuav_jax.dynamics.choices import solver_named

SPAN = 1.0
# Order, and numbers of steps.
ORDERS = {
    "kvaerno3": (3, (120, 180, 270)),
    "kvaerno5": (5, (80, 120, 180)),
}
SYSTEM, START = top(SLOW)


@cache
def by_equal_steps(solver: Any, formulation: Any) -> Any:
    steps = make_equal_steps(SYSTEM, START, solver_named(solver), formulation)
    return lambda count: steps(SPAN, count)


def orders(solver: Any, formulation: Any, counts: tuple[int, ...]) -> np.ndarray:
    """Orders between the numbers of steps."""
    exact = by_equal_steps("dopri8", stm.Tree())(200)
    errors = [np.linalg.norm(by_equal_steps(solver, formulation)(n) - exact) for n in counts]
    return np.log(np.array(errors[:-1]) / errors[1:]) / np.log(np.array(counts[1:]) / counts[:-1])


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["kvaerno3", "kvaerno5"])
def test_order_in_the_coordinates_of_the_joint(solver):
    order, counts = ORDERS[solver]
    np.testing.assert_allclose(orders(solver, stm.Tree(), counts), order, atol=0.2)


@pytest.mark.slow
def test_order_with_projection():
    """On the constraints of maximal coordinates."""
    order, counts = ORDERS["kvaerno3"]
    np.testing.assert_allclose(orders("kvaerno3", stm.Augmented(), counts), order, atol=0.2)
