"""Orders of the implicit solvers, observed on the motion of a mechanism: within 0.2 of the nominal ones.

The slow heavy top of `tests/published/test_heavy_top.py`, which has those of the explicit ones, in the
coordinates of its joint and in maximal coordinates with projection, by equal steps. Steps are so fine that
the next order no longer shows, and so coarse that round-off does not yet.
"""

from functools import cache
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems.conservative import SLOW, top

import stmuav_jax as stm
from stmuav_jax.dynamics.choices import solver_named
from stmuav_jax.dynamics.integration.problem import begin_integration, prepare_problem

SPAN = 1.0
# Order, and numbers of steps.
ORDERS = {
    "kvaerno3": (3, (120, 180, 270)),
    "kvaerno5": (5, (80, 120, 180)),
}
SYSTEM, START = top(SLOW)


@cache
def by_equal_steps(solver: Any, formulation: Any) -> Any:
    """Function count -> positions at the end (1, 3), one compiled program for all counts."""
    method = stm.Method(
        formulation=formulation,
        solver=solver_named(solver),
        # to which the stages of implicit methods are solved
        rtol=1e-13,
        atol=1e-13,
        adjoint=diffrax.ForwardMode(),
        steps="state",
    )
    problem = prepare_problem(SYSTEM, method)
    y0 = begin_integration(problem, jnp.zeros(()), START).y

    @jax.jit
    def end(step: Any) -> Any:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(problem.field), problem.solver(), 0.0, SPAN, step, y0, problem.model,
            stepsize_controller=diffrax.ConstantStepSize(), adjoint=method.adjoint,
            max_steps=1024,
        )  # fmt: skip
        assert solution.ys is not None
        return formulation.to_state(problem.model, solution.ys[0][: problem.n_state]).r

    # a last step of round-off's length would be one more
    return lambda count: np.asarray(end(SPAN / count * (1 + 1e-14)))


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
