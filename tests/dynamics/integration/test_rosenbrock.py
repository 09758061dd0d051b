"""Rodas5P, the lean explicit steps, and what tells stiff scenes from others."""

from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum, relative_error, swung

import stmuav_jax as stm
from stmuav_jax.dynamics.integration import rosenbrock
from stmuav_jax.dynamics.integration.explicit import NonDenseRungeKutta, coefficients


def field(t, y, args):
    """Nonlinear and dependent on time."""
    del args
    return jnp.array([y[1], -jnp.sin(y[0]) * (1 + 0.3 * jnp.cos(3 * t)) - 0.1 * y[1] ** 3])


def stiff(t, y, args):
    """Prothero and Robinson: y' = -lambda (y - g(t)) + g'(t), whose solution is g = cos."""
    rate = args
    return -rate * (y - jnp.cos(t)) - jnp.sin(t)


START = jnp.array([1.0, 0.5])


@partial(jax.jit, static_argnums=0)
def fixed(terms, count, start, args=None):
    """Two seconds in `count` equal steps of Rodas5P."""
    h = 2.0 / count
    term, solver = diffrax.ODETerm(terms), stm.Rodas5P()
    step = lambda k, y: solver.step(term, k * h, (k + 1) * h, y, args, None, False)[0]
    return jax.lax.fori_loop(0, count, step, start)


def adaptive(solver, terms, y0, t1, tolerance, args=None) -> Any:
    return diffrax.diffeqsolve(
        diffrax.ODETerm(terms), solver, 0.0, t1, 1e-3, y0, args,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=100_000, adjoint=diffrax.ForwardMode(),
    )  # fmt: skip


def slopes(terms, counts, start, exact, args=None):
    """Observed orders between numbers of steps, each twice the one before, and the last error."""
    found = [fixed(terms, n, start, args) for n in counts]
    errors = np.array([np.max(np.abs(np.asarray(y) - exact)) for y in found])
    return np.log2(errors[:-1] / errors[1:]), errors[-1]


def test_observed_order_is_five():
    exact = np.asarray(adaptive(diffrax.Dopri8(), field, START, 2.0, 1e-13).ys[-1])
    np.testing.assert_allclose(slopes(field, (32, 64, 128), START, exact)[0], 5, atol=0.2)


def test_order_on_a_stiff_problem_is_three_with_an_error_that_falls_with_stiffness():
    """The stages are of low order; what they lack is divided by the rate (Prothero and Robinson)."""
    last = {}
    for rate in (1e5, 1e6):
        found, last[rate] = slopes(stiff, (16, 32, 64), jnp.array([1.0]), np.cos(2.0), rate)
        np.testing.assert_allclose(found, 3, atol=0.2)
    assert last[1e5] / last[1e6] == pytest.approx(10, rel=0.3)


def test_the_coefficients_fulfil_the_conditions_of_order_five():
    """Hairer and Wanner II, Table IV.7.1, in alpha and beta = alpha + gamma; the error's are of order four."""
    A, one = rosenbrock._weights(), np.ones(8)
    gamma = np.linalg.inv(np.eye(8) / rosenbrock._GAMMA - rosenbrock._table(rosenbrock._C))
    alpha = A @ gamma
    beta, a = alpha + gamma, alpha @ one
    B = beta @ one
    np.testing.assert_allclose(
        a, [0.0, 3 * gamma[0, 0], *rosenbrock._POINTS[1:], 1, 1, 1], atol=1e-13
    )
    up_to_four = [
        (one, 1), (B, 2), (a**2, 3), (beta @ B, 6), (a**3, 4), (a * (alpha @ B), 8),
        (beta @ a**2, 12), (beta @ beta @ B, 24),
    ]  # fmt: skip
    five = [
        (a**4, 5), (a**2 * (alpha @ B), 10), ((alpha @ B) ** 2, 20), (a * (alpha @ a**2), 15),
        (a * (alpha @ beta @ B), 30), (beta @ a**3, 20), (beta @ (a * (alpha @ B)), 40),
        (beta @ beta @ a**2, 60), (beta @ beta @ beta @ B, 120),
    ]  # fmt: skip
    embedded = A[7] @ gamma
    step = embedded + gamma[7]
    for weights, count in up_to_four:
        np.testing.assert_allclose((step @ weights, embedded @ weights), 1 / count, atol=3e-14)
    for weights, count in five:
        assert step @ weights == pytest.approx(1 / count, abs=3e-14)
    assert max(abs(embedded @ weights - 1 / count) for weights, count in five) > 1e-3


def test_integrals_beside_the_state_need_no_columns_of_the_jacobian():
    """Energy and distance of `field`, integrated with it: the same step, with a smaller matrix."""

    def wider(t, y, args):
        return jnp.concatenate([field(t, y, args), jnp.stack([y[1] ** 2, y[0] * t])])

    start, term = jnp.concatenate([START, jnp.zeros(2)]), diffrax.ODETerm(wider)
    step = lambda solver: solver.step(term, 0.1, 0.4, start, None, None, False)[:2]
    for one, two in zip(step(stm.Rodas5P()), step(stm.Rodas5P(size=2)), strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-15)


@pytest.mark.parametrize("rate", [1e3, 1e8])
def test_stiffness_costs_no_steps_and_no_accuracy(rate):
    """Explicit steps could not be longer than about 5 / rate."""
    run = adaptive(stm.Rodas5P(), stiff, jnp.array([1.0]), 10.0, 1e-6, jnp.asarray(rate))
    assert run.stats["num_steps"] < 100
    assert abs(float(run.ys[-1, 0]) - np.cos(10.0)) < 1e-5


def test_it_differentiates():
    """Forward = reverse = differences, through the factorisation and the Jacobian."""

    def end(x, adjoint):
        y0 = jnp.stack([x, 0.5 * x])
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(field), stm.Rodas5P(), 0.0, 1.0, 0.05, y0, adjoint=adjoint,
            stepsize_controller=diffrax.ConstantStepSize(), max_steps=32,
        )  # fmt: skip
        assert sol.ys is not None
        return sol.ys[-1, 0]

    forward = jax.jvp(lambda x: end(x, diffrax.ForwardMode()), (1.0,), (1.0,))[1]
    reverse = jax.grad(lambda x: end(x, stm.dynamics.DiscreteAdjoint()))(1.0)
    h = 1e-5
    difference = (end(1.0 + h, diffrax.ForwardMode()) - end(1.0 - h, diffrax.ForwardMode())) / (
        2 * h
    )
    assert float(forward) == pytest.approx(float(reverse), rel=1e-12)
    assert float(forward) == pytest.approx(float(difference), rel=1e-8)


# --- explicit


def test_stages_that_only_serve_interpolation_are_left_out():
    assert len(coefficients(diffrax.Dopri8())[3]) == 13
    assert len(coefficients(diffrax.Tsit5())[3]) == 7


@pytest.mark.parametrize("method", [diffrax.Dopri8(), diffrax.Tsit5(), diffrax.Dopri5()])
def test_lean_steps_are_those_of_the_method(method):
    term = diffrax.ODETerm(field)
    state = method.init(term, 0.0, 0.3, START, None)
    one = method.step(term, 0.0, 0.3, START, None, state, True)
    two = NonDenseRungeKutta(method).step(term, 0.0, 0.3, START, None, None, True)
    assert relative_error(two[0], one[0]) < 1e-15
    np.testing.assert_allclose(two[1], one[1], rtol=0, atol=1e-15)


# --- stiff scenes


@pytest.fixture(scope="module")
def rail():
    """A slider on a rail with a servo of 1e6 N/m that follows a sine."""
    body = stm.Body("cart", 1.0, (0.1, 0.1, 0.1))
    joint = stm.translational("rail", "ground", "cart", axis=(0, 0, 1))
    servo = stm.mechanics.JointServo(
        "rail", stiffness=1e6, damping=2e5, target=lambda t: 0.1 * jnp.sin(3 * t)
    )
    return stm.System([body], [joint], [stm.Gravity(), servo])


def test_the_spectrum_of_a_servo(rail):
    """m x'' + c x' + k x = 0: the roots of m s^2 + c s + k."""
    values = stm.dynamics.spectrum(rail, rail.reference)
    expected = np.roots([1.0, 2e5, 1e6])
    np.testing.assert_allclose(values[:2], expected, rtol=1e-8)


def test_the_spectrum_of_a_pendulum_hanging():
    system = pendulum()
    values = stm.dynamics.spectrum(system, swung(system, 0.0))
    assert np.max(np.abs(np.real(values))) < 1e-6
    assert np.min(np.abs(values)) < 1e-6 or len(values) == 2


def test_auto_takes_the_implicit_method_where_it_pays(rail):
    assert isinstance(stm.dynamics.choose_solver(rail, rail.reference), stm.Rodas5P)
    soft = eqx.tree_at(
        lambda s: (s.forces[1].stiffness, s.forces[1].damping),
        rail,
        (jnp.asarray(10.0), jnp.asarray(1.0)),
    )
    assert isinstance(stm.dynamics.choose_solver(soft, soft.reference), diffrax.Dopri8)


def test_a_stiff_servo_in_few_steps(rail):
    start = rail.reference
    cart = stm.State(start.r, start.p, start.v.at[0, 2].set(0.3), start.omega)
    scene = stm.Scene("rail", "A stiff servo", rail, cart, t1=1.0, save_every=0.5)
    run = stm.simulate(scene, method=stm.Method(solver="auto", rtol=1e-6, atol=1e-6))
    assert run.settings["solver"] == "Rodas5P"
    assert run.certificate.accepted_steps < 200
    # the servo holds its target but for the lag of a weight of 9.81 N
    lag = run.states.r[-1, 0, 2] - 0.1 * np.sin(3.0)
    assert abs(lag + 9.81 / 1e6) < 2e-6
