"""Steps that are safe for derivatives: about equilibria and steady motions, against closed forms."""

from dataclasses import replace
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum
from scipy.linalg import expm

import stmuav_jax as stm

TIMES = (0.5, 1.0, 2.0, 5.0, 10.0)
ONE = stm.revolute("h", "ground", "bob", point=(0, 0, 0), axis=(0, 1, 0))


def hung(damping, stiffness=0.0):
    """A pendulum of 1 kg at rest, 1 m below its hinge, which may have a spring and a damper."""
    body = stm.Body("bob", 1.0, (1e-3,) * 3, position=(0, 0, -1.0))
    hinge = stm.TorsionalSpringDamper("h", stiffness=stiffness, damping=damping)
    return lambda a: stm.System(
        [body], [ONE], [stm.Gravity(), stm.AppliedForce("bob", a * jnp.eye(3)[0]), hinge]
    )


def moved(make, method, wanted, a, T):
    """What is wanted of the state after T [s] of a system that is at rest where a is zero."""
    system = make(a)
    ts = jnp.stack([jnp.zeros(()), T])
    return wanted(
        jax.tree.map(lambda x: x[-1], stm.integrate(system, system.reference, ts, method).states)
    )


def slopes(make, method, wanted, *, ahead):
    """Derivatives by a at a = 0, at all times, from one compiled function."""
    of = partial(moved, make, method, wanted)
    if ahead:
        found = jax.jit(lambda T: jax.jvp(lambda a: of(a, T), (0.0,), (1.0,))[1])
    else:
        found = jax.jit(jax.grad(of))
        found = partial(found, 0.0)
    return np.array([found(T) for T in TIMES])


def linear(M, C, K, Q, row):
    """By the linearised equations M q'' + C q' + K q = Q a: d (row . q(T)) / d a."""
    n, inverse = len(M), np.linalg.inv(M)
    A = np.zeros((2 * n + 1, 2 * n + 1))
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n, :n], A[n : 2 * n, n : 2 * n] = -inverse @ K, -inverse @ C
    A[n : 2 * n, -1] = inverse @ Q
    return np.array([row @ expm(A * T)[:n, -1] for T in TIMES])


def of_pendulum(damping, stiffness):
    pull = float(np.linalg.norm(stm.Gravity().acceleration))
    number = lambda x: np.array([[x]])
    one = np.ones(1)
    return linear(number(1.001), number(damping), number(pull + stiffness), one, one)


x_of_bob = lambda state: state.r[0, 0]


@pytest.mark.slow
def test_hanging_pendulum_forwards_by_an_implicit_method():
    """With a spring and a damper in its hinge; the double pendulum below goes backwards, without."""
    method = stm.Method(solver=stm.dynamics.kvaerno5(), adjoint=diffrax.ForwardMode())
    found = slopes(hung(0.7, 5.0), method, x_of_bob, ahead=True)
    np.testing.assert_allclose(found, of_pendulum(0.7, 5.0), rtol=1e-6)


@pytest.mark.slow
def test_double_pendulum():
    upper = stm.Body("upper", 2.0, (0.02,) * 3, position=(0, 0, -0.4))
    lower = stm.Body("lower", 0.5, (0.003,) * 3, position=(0, 0, -1.0))
    knee = stm.revolute("k", "upper", "lower", point=(0, 0, -0.8), axis=(0, 1, 0))
    joints = [stm.revolute("h", "ground", "upper", point=(0, 0, 0), axis=(0, 1, 0)), knee]
    make = lambda a: stm.System(
        [upper, lower], joints, [stm.Gravity(), stm.AppliedForce("lower", a * jnp.eye(3)[0])]
    )
    found = slopes(make, stm.Method(), lambda state: state.r[1, 0], ahead=False)
    pull = float(np.linalg.norm(stm.Gravity().acceleration))
    M = [
        [2.0 * 0.4**2 + 0.02 + 0.5 * 0.8**2, 0.5 * 0.8 * 0.2],
        [0.5 * 0.8 * 0.2, 0.5 * 0.2**2 + 0.003],
    ]
    K = np.diag([(2.0 * 0.4 + 0.5 * 0.8) * pull, 0.5 * 0.2 * pull])
    arms = np.array([0.8, 0.2])
    expected = linear(np.array(M), np.zeros((2, 2)), K, arms, arms)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.slow
def test_spinning_disc():
    """A steady motion: a torque-free disc's spin nutates at the rate of the spin itself."""
    rate = 6.0
    system = stm.System([stm.Body("disc", 1.0, (0.1, 0.1, 0.2), free=True)], [], [])
    at = system.reference

    def wobble(a, T):
        start = stm.State(at.r, at.p, at.v, jnp.stack([a, 0 * a, rate + 0 * a])[None])
        ts = jnp.stack([jnp.zeros(()), T])
        return stm.integrate(system, start, ts, stm.Method(rtol=1e-8)).states.omega[-1, 0, 0]

    found = jax.jit(jax.grad(wobble))
    for T in TIMES:
        assert float(found(0.0, T)) == pytest.approx(np.cos(rate * T), rel=1e-6)


def test_steps_for_the_state_alone():
    """At rest they grow at their limit throughout, which the trajectory counts, or to the longest."""
    system = pendulum()
    how = stm.Method(steps="state", adjoint=diffrax.ForwardMode())
    ts = jnp.array([0.0, 5.0])
    run = jax.jit(
        lambda longest: stm.integrate(system, system.reference, ts, replace(how, max_step=longest))
    )
    free, bounded = run(jnp.inf), run(0.05)
    assert int(free.counts.accepted[-1]) < 10
    assert int(bounded.counts.accepted[-1]) >= 100
    assert int(free.counts.at_growth_limit[-1]) == int(free.counts.accepted[-1])
