"""Diagonally implicit steps with one Jacobian for many steps, and factorisations in loops."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.test_util import check_grads

import stmuav_jax as stm
from stmuav_jax.algebra import linalg, loops
from stmuav_jax.dynamics.integration import esdirk
from stmuav_jax.dynamics.integration.esdirk import NonDenseESDIRK
from stmuav_jax.dynamics.integration.stepping import own_iterations

FORWARD = diffrax.ForwardMode()


def field(t, y, args):
    """Nonlinear and dependent on time and on a parameter."""
    turn = -jnp.sin(y[0]) * (1 + 0.3 * jnp.cos(3 * t)) * args
    return jnp.array([y[1], turn - 0.1 * y[1] ** 3])


def van_der_pol(t, y, args):
    return jnp.array([y[1], args * ((1 - y[0] ** 2) * y[1] - y[0])])


def fixed(x, h, adjoint=FORWARD):
    """State after two seconds of equal steps h, whose stages are solved to 1e-13."""
    solver = NonDenseESDIRK(diffrax.Kvaerno5(), 1e-13, 1e-13, 2)
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(field), solver, 0.0, 2.0, h, jnp.stack([x, 0.5 * x]), x,
        adjoint=adjoint, max_steps=256, stepsize_controller=diffrax.ConstantStepSize(),
    )  # fmt: skip
    assert found.ys is not None
    return found.ys[-1]


END = jax.jit(fixed)


def adaptive(solver, terms, y0, t1, tolerance, args):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(terms), solver, 0.0, t1, 1e-4, y0, args, adjoint=FORWARD, max_steps=100_000,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
    )  # fmt: skip


def final(solution: diffrax.Solution) -> np.ndarray:
    """State at the end."""
    assert solution.ys is not None
    return np.asarray(solution.ys[-1])


@pytest.mark.parametrize("native", [False, True])
def test_differences_give_the_jacobian(native, monkeypatch):
    """Columns side by side, or one by one in a native loop; integrals beside the state have none."""
    monkeypatch.setattr(esdirk, "native_loops", lambda: native)
    wider = lambda t, y: jnp.append(field(t, y, 2.0), y[0] ** 2)
    y = jnp.array([0.7, -0.4, 3.0])
    found = esdirk._differences(wider, 0.2, y, 2)
    exact = jax.jacfwd(lambda y: wider(0.2, y))(y)
    # the step of a difference is the root of the round-off
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-7)


def test_observed_order_is_five():
    start = jnp.array([1.0, 0.5])
    exact = final(adaptive(diffrax.Dopri8(), field, start, 2.0, 1e-13, 1.0))
    errors = [np.max(np.abs(np.asarray(END(1.0, h)) - exact)) for h in (0.1, 0.05, 0.025)]
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 5, atol=0.1)


def test_it_differentiates():
    """Forward = reverse = differences, from the stages' equations."""
    forward = jax.jvp(lambda x: END(x, 0.1)[0], (1.0,), (1.0,))[1]
    back: Any = diffrax.RecursiveCheckpointAdjoint()
    reverse = jax.jit(jax.grad(lambda x: fixed(x, 0.1, back)[0]))(1.0)
    move = 1e-5
    difference = (END(1.0 + move, 0.1)[0] - END(1.0 - move, 0.1)[0]) / (2 * move)
    assert float(forward) == pytest.approx(float(reverse), rel=1e-12)
    assert float(forward) == pytest.approx(float(difference), rel=1e-8)


def test_a_jacobian_that_no_longer_fits_is_computed_again():
    """Van der Pol with 1e4 1/s: its fast jumps change df/dy by orders of magnitude in a step."""
    start, rate = jnp.array([2.0, 0.0]), 1e4
    own = NonDenseESDIRK(diffrax.Kvaerno5(), 1e-7, 1e-7, 2)
    found = adaptive(own, van_der_pol, start, 2.0, 1e-7, rate)
    exact = adaptive(stm.Rodas5P(), van_der_pol, start, 2.0, 1e-10, rate)
    assert found.stats["num_steps"] < 2000
    np.testing.assert_allclose(final(found)[0], final(exact)[0], atol=2e-5)


def test_many_side_by_side_are_those_one_by_one():
    xs = jnp.array([0.5, 1.0, 2.0])
    together = jax.jit(jax.vmap(lambda x: fixed(x, 0.1)))(xs)
    alone = jnp.stack([END(x, 0.1) for x in xs])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-12)


def test_another_root_finder_is_left_to_diffrax():
    assert own_iterations(stm.dynamics.kvaerno5())
    assert not own_iterations(diffrax.Kvaerno5(root_finder=diffrax.VeryChord(1e-9, 1e-9)))
    assert not own_iterations(diffrax.Dopri8())


# --- factorisations


@pytest.fixture(params=["LAPACK", "loops"])
def native(request, monkeypatch):
    monkeypatch.setattr(linalg, "native_loops", lambda: request.param == "loops")
    jax.clear_caches()
    yield request.param
    jax.clear_caches()


def test_factorisations_against_scipy(native):
    rng = np.random.default_rng(1)
    for k in (1, 4, 9):
        A, b = rng.normal(size=(k, k)), rng.normal(size=k)
        A[0, 0] = 0.0 if k > 1 else 1.0  # needs a pivot
        S = A @ A.T + np.eye(k)
        expected = scipy.linalg.lu_solve(scipy.linalg.lu_factor(A), b)
        np.testing.assert_allclose(
            linalg.inverted(jnp.asarray(A)).solve(jnp.asarray(b)), expected, rtol=1e-10
        )
        L = np.asarray(linalg.cholesky(jnp.asarray(S)))
        np.testing.assert_allclose(L, scipy.linalg.cholesky(S, lower=True), atol=1e-13)
        for transpose in (False, True):
            x = linalg.solve_lower(jnp.asarray(L), jnp.asarray(A), transpose=transpose)
            expected = scipy.linalg.solve_triangular(L, A, lower=True, trans=int(transpose))
            np.testing.assert_allclose(x, expected, atol=1e-12)
        product = linalg.product_transposed(jnp.asarray(S), jnp.asarray(A))
        np.testing.assert_allclose(product, S @ A.T, atol=1e-12)


def test_singular_matrices_give_no_finite_solution(native):
    ones = jnp.ones((3, 3))
    assert not np.any(np.isfinite(linalg.inverted(ones).solve(jnp.arange(3.0))))
    assert np.all(np.isnan(linalg.factorise(-ones, redundant=False, rcond=0.0).solve(ones[0])))


def test_derivatives_of_the_factorisations(native):
    rng = np.random.default_rng(2)
    A, b = rng.normal(size=(4, 4)), rng.normal(size=4)

    def solutions(A, b):
        S = linalg.product_transposed(A, A) + jnp.eye(4)
        found = linalg.factorise(S, redundant=False, rcond=0.0).solve(b)
        return linalg.inverted(A).solve(b), found, linalg.cholesky(S)

    check_grads(jax.jit(solutions), (A, b), order=1, rtol=1e-5, atol=1e-5)


def test_loops_over_a_batch():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(5, 6, 6))
    S = A @ np.swapaxes(A, 1, 2) + np.eye(6)
    np.testing.assert_allclose(
        jax.vmap(loops.cholesky)(jnp.asarray(S)), np.linalg.cholesky(S), atol=1e-13
    )
