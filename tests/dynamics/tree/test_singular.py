"""Selection of independent rows, and interpolation about a singular posture, on small examples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.dynamics.tree.closures import Nearness, interpolate_posture

# displacement between the postures [rad]
APART = 0.06


def posture(near, smallest=1e-6):
    return Nearness(jnp.asarray(near), jnp.asarray(smallest))


def removable(by):
    """(sin x / x, cos x) at x = by[0]: not a number at x = 0, where the limit is (1, 1)."""
    return jnp.sin(by[0]) / by[0], jnp.cos(by[0])


@pytest.fixture(scope="module")
def found():
    near = jax.jit(lambda at, way: interpolate_posture(at, way, removable, power=3))
    return lambda flag: near(posture(flag), jnp.array([APART, APART / 3]))


def test_a_removable_singularity_is_bridged(found):
    """Error s^10 / 252 over 10! or so: round-off."""
    np.testing.assert_allclose(found(True), (1.0, 1.0), rtol=1e-14)


def test_elsewhere_nothing_is_interpolated(found):
    quotient, cosine = found(False)
    assert np.isnan(quotient)
    assert cosine == 1.0


def test_its_derivative_is_bridged_too():
    """d/da of sin(a x) / x at x = 0 is one."""
    f = lambda a: interpolate_posture(
        posture(True), jnp.array([APART]), lambda by: jnp.sin(a * by[0]) / by[0], power=3
    )
    value, rate = jax.jvp(f, (1.5,), (1.0,))
    assert float(value) == pytest.approx(1.5, rel=1e-13)
    assert float(rate) == pytest.approx(1.0, rel=1e-13)
    assert float(jax.grad(f)(1.5)) == pytest.approx(1.0, rel=1e-13)


def test_what_is_not_smooth_is_left_as_it_is():
    """A pole does not go away: the run's step control has to see that."""
    f = lambda by: 1 / by[0] + jnp.abs(by[0])
    assert not np.isfinite(interpolate_posture(posture(True), jnp.array([APART]), f, power=3))
    # that of a linkage which misses the singular posture narrowly
    near_miss = lambda by: 1 / jnp.sqrt(by[0] ** 2 + 1e-4)
    found = interpolate_posture(posture(True), jnp.array([APART]), near_miss, power=3)
    assert float(found) == pytest.approx(100.0, rel=1e-15)


def test_the_equations_serve_where_round_off_is_less_than_the_interpolations_error():
    """exp(10 x) is interpolated to 1e-7 or so: too little where round-off leaves 1e-12."""
    f = lambda by: 1e-3 * jnp.exp(10 * by[0])
    of = lambda smallest: float(
        interpolate_posture(posture(True, smallest), jnp.array([APART]), f, power=3) - 1e-3
    )
    assert of(0.1) == 0.0
    assert 0.0 < abs(of(1e-3)) < 1e-6
