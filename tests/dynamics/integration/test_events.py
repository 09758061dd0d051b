"""Events: direction, restarts at the event, other thresholds, values that are not numbers; jumps."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm

BODY = stm.Body("m", 1.0, (1e-3,) * 3, position=(0, 0, 0))
PULL = float(np.linalg.norm(stm.Gravity().acceleration))
AHEAD = stm.Method(adjoint=diffrax.ForwardMode())


class Plane(eqx.Module):
    """Height above a plane; not a number after a time."""

    height: float | jax.Array
    until: float | jax.Array

    def __call__(self, t, state):
        return jnp.where(t > self.until, jnp.nan, state.r[0, 2] - self.height)


@pytest.mark.slow
def test_bouncing_ball():
    """Six arcs from one compiled function, each started at the event that ended the one before."""
    up = stm.translational("h", "ground", "m", point=(0, 0, 0), axis=(0, 0, 1))
    system = stm.System([BODY], [up], [stm.Gravity()])
    at, compiled = system.reference, []

    @eqx.filter_jit
    def fall(t, z, v, plane):
        compiled.append(1)
        start = stm.State(at.r.at[0, 2].set(z), at.p, at.v.at[0, 2].set(v), at.omega)
        method = dataclasses.replace(AHEAD, solver=diffrax.Tsit5(), event=plane, direction=False)
        return stm.integrate(system, start, jnp.stack([t, t + 3.0]), method)

    t, z, v = jnp.zeros(()), jnp.ones(()), jnp.zeros(())
    # of one type, as weakly typed numbers would be compiled again
    plane = lambda height, until: Plane(*(jnp.asarray(x, float) for x in (height, until)))
    ground = plane(0.0, np.inf)
    for bounce in range(6):
        arc = fall(t, z, v, ground)
        assert arc.result == diffrax.RESULTS.event_occurred
        t, z, v = arc.ts[-1], arc.states.r[-1, 0, 2], -0.8 * arc.states.v[-1, 0, 2]
        expected = np.sqrt(2 / PULL) * (1 + 2 * sum(0.8**k for k in range(1, bounce + 1)))
        assert abs(float(t) - expected) < 1e-9, bounce
    # another threshold, and an event that stops being a number
    lost = fall(jnp.zeros(()), jnp.ones(()), jnp.zeros(()), plane(-1.0, 0.3))
    assert lost.result == diffrax.RESULTS.nonfinite
    assert 0.3 < float(lost.ts[-1]) < 3.0
    assert np.isnan(lost.states.r[-1, 0, 2])
    assert len(compiled) == 1


@pytest.mark.slow
def test_known_jumps():
    """A square wave of 3 N: as accurate as the tolerance, and without a rejected step."""
    along = stm.translational("h", "ground", "m", point=(0, 0, 0), axis=(1, 0, 0))
    wave = lambda t, kin: 3 * jnp.sign(jnp.sin(2 * jnp.pi * t)) * jnp.eye(3)[0]
    system = stm.System([BODY], [along], [stm.AppliedForce("m", wave)])
    ts = jnp.array([0.0, 1.0, 2.5, 2.7, 5.0])
    method = eqx.tree_at(
        lambda m: m.jump_ts, AHEAD, jnp.arange(0.0, 5.5, 0.5), is_leaf=lambda x: x is None
    )
    path = jax.jit(lambda: stm.integrate(system, system.reference, ts, method))()
    np.testing.assert_array_equal(path.ts, ts)
    np.testing.assert_allclose(path.states.r[:, 0, 0], [0, 0.75, 1.875, 2.115, 3.75], atol=1e-8)
    assert int(path.counts.rejected[-1]) == 0


HEIGHTS = jnp.array([1.0, 3.0, 10.0, 200.0, 0.0, 2e3])
RAIL = stm.translational("rail", "ground", "ball", axis=(0, 0, 1))
BALL = stm.System([stm.Body("ball", 1.0, [0.1, 0.2, 0.3])], [RAIL], [stm.Gravity()])


def land(h, adjoint):
    """Time at which a ball lands on a rail from a height, and its path; NaN above 1 km."""
    at, ts = BALL.reference, jnp.array([0.0, 1.0, 5.0])
    height = lambda t, s: jnp.where(s.r[0, 2] > 1e3, jnp.nan, s.r[0, 2])
    method = stm.Method(solver=diffrax.Tsit5(), event=height, direction=False, adjoint=adjoint)
    start = stm.State(at.r.at[0, 2].set(h), at.p, at.v, at.omega)
    path = stm.integrate(BALL, start, ts, method)
    return path.ts[-1], (path.ts, path.states.r[:, 0, 2], path.result)


@pytest.mark.slow
def test_each_of_a_batch_ends_at_its_own_event_and_has_the_derivative_of_its_time():
    """Balls from heights whose events lie in different intervals, or do not come at all.

    One falls from its event, which is no event; one is no number. Times are exact to the last digits,
    and their derivatives are those of sqrt(2 h / g), zero without an event.
    """
    heights = np.asarray(HEIGHTS)[:5]
    fall = jax.value_and_grad(lambda h: land(h, stm.Method().adjoint), has_aux=True)
    (_, (ts, z, result)), slope = jax.jit(jax.vmap(fall))(HEIGHTS)
    known = [*(1 / np.sqrt(2 * heights[:3] * PULL)), 0.0]
    np.testing.assert_allclose(slope[:4], known, rtol=1e-9, atol=1e-12)
    exact = np.array([*np.sqrt(2 * heights[:3] / PULL), 5.0, 5.0])
    np.testing.assert_allclose(ts[:5, -1], exact, rtol=1e-13)
    np.testing.assert_allclose(z[:5, -1], heights - 0.5 * PULL * exact**2, atol=1e-11)
    of = diffrax.RESULTS
    expected = [of.event_occurred] * 3 + [of.successful] * 2 + [of.nonfinite]
    assert [int(k) for k in result._value] == [int(one._value) for one in expected]
    assert ts[5, -1] == 0.0
    assert np.isnan(z[5, -1])
