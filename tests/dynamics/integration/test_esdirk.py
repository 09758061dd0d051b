"""Implicit steps with one Jacobian for many, lean explicit ones, factorisations in loops, and what is stiff."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import relative_error

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.solvers import NonDenseESDIRK, NonDenseRungeKutta
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


@pytest.mark.slow
def test_a_jacobian_that_no_longer_fits_is_computed_again():
    """Van der Pol with 1e4 1/s: its fast jumps change df/dy by orders of magnitude in a step."""
    start, rate = jnp.array([2.0, 0.0]), 1e4
    own = NonDenseESDIRK(diffrax.Kvaerno5(), 1e-7, 1e-7, 2)
    found = adaptive(own, van_der_pol, start, 2.0, 1e-7, rate)
    exact = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], rate * ((1 - y[0] ** 2) * y[1] - y[0])], (0, 2), start, "Radau", rtol=1e-10, atol=1e-10,
        jac=lambda t, y: np.array([[0.0, 1.0], [rate * (-2 * y[0] * y[1] - 1), rate * (1 - y[0] ** 2)]]),
    )  # fmt: skip
    assert found.stats["num_steps"] < 2000
    np.testing.assert_allclose(final(found)[0], exact.y[0, -1], atol=2e-5)


def test_stiffness_costs_no_steps_and_no_accuracy():
    """Prothero and Robinson: y' = -lambda (y - cos t) - sin t; explicit steps would be at most 5 / lambda."""
    stiff = lambda t, y, args: -args * (y - jnp.cos(t)) - jnp.sin(t)
    own = NonDenseESDIRK(diffrax.Kvaerno5(), 1e-6, 1e-6, 1)
    run = adaptive(own, stiff, jnp.array([1.0]), 10.0, 1e-6, jnp.asarray(1e8))
    assert run.stats["num_steps"] < 100
    assert abs(final(run)[0] - np.cos(10.0)) < 1e-5


@pytest.mark.slow
def test_many_side_by_side_are_those_one_by_one():
    xs = jnp.array([0.5, 1.0, 2.0])
    together = jax.jit(jax.vmap(lambda x: fixed(x, 0.1)))(xs)
    alone = jnp.stack([END(x, 0.1) for x in xs])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-12)


def test_another_root_finder_is_left_to_diffrax():
    assert own_iterations(stm.dynamics.kvaerno5())
    assert not own_iterations(diffrax.Kvaerno5(root_finder=diffrax.VeryChord(1e-9, 1e-9)))
    assert not own_iterations(diffrax.Dopri8())


# --- explicit


@pytest.mark.parametrize("method", [diffrax.Dopri8(), diffrax.Tsit5()])
def test_lean_steps_are_those_of_the_method(method):
    term, start = diffrax.ODETerm(field), jnp.array([1.0, 0.5])
    state = method.init(term, 0.0, 0.3, start, 1.0)
    one = method.step(term, 0.0, 0.3, start, 1.0, state, True)
    two = NonDenseRungeKutta(method).step(term, 0.0, 0.3, start, 1.0, None, True)
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


@pytest.mark.slow
def test_auto_takes_the_implicit_method_where_it_pays(rail):
    assert isinstance(stm.dynamics.choose_solver(rail, rail.reference), diffrax.Kvaerno5)
    soft = eqx.tree_at(
        lambda s: (s.forces[1].stiffness, s.forces[1].damping),
        rail,
        (jnp.asarray(10.0), jnp.asarray(1.0)),
    )
    assert isinstance(stm.dynamics.choose_solver(soft, soft.reference), diffrax.Dopri8)


@pytest.mark.slow
def test_a_stiff_servo_in_few_steps(rail):
    start = rail.reference
    cart = stm.State(start.r, start.p, start.v.at[0, 2].set(0.3), start.omega)
    scene = stm.Scene("rail", "A stiff servo", rail, cart, t1=1.0, save_every=0.5)
    run = stm.simulate(scene, method=stm.Method(solver="auto", rtol=1e-6, atol=1e-6))
    assert run.settings["solver"] == "Kvaerno5"
    assert run.certificate.accepted_steps < 200
    # the servo holds its target but for the lag of a weight of 9.81 N
    lag = run.states.r[-1, 0, 2] - 0.1 * np.sin(3.0)
    assert abs(lag + 9.81 / 1e6) < 2e-6
