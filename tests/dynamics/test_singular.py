"""Selection of independent rows, and interpolation about a singular posture, on small examples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.dynamics.singular import interpolated


def removable(by):
    """(sin x / x, cos x) at x = by[0]: not a number at x = 0, where the limit is (1, 1)."""
    return jnp.sin(by[0]) / by[0], jnp.cos(by[0])


@pytest.fixture(scope="module")
def found():
    near = jax.jit(lambda near, u: interpolated(near, u, removable))
    return lambda flag: near(jnp.asarray(flag), jnp.array([3.0, 1.0]))


def test_a_removable_singularity_is_bridged(found):
    """Error s^10 / 252 over 10! or so: round-off."""
    np.testing.assert_allclose(found(True), (1.0, 1.0), rtol=1e-14)


def test_elsewhere_nothing_is_interpolated(found):
    assert np.all(np.isnan(found(False)))


def test_its_derivative_is_bridged_too():
    """d/da of sin(a x) / x at x = 0 is one."""
    f = lambda a: interpolated(
        jnp.asarray(True), jnp.array([2.0]), lambda by: jnp.sin(a * by[0]) / by[0]
    )
    value, rate = jax.jvp(f, (1.5,), (1.0,))
    assert float(value) == pytest.approx(1.5, rel=1e-13)
    assert float(rate) == pytest.approx(1.0, rel=1e-13)
    assert float(jax.grad(f)(1.5)) == pytest.approx(1.0, rel=1e-13)


def test_what_is_not_smooth_is_no_number():
    """A pole does not go away: the run's step control has to see that."""
    f = lambda by: 1 / by[0] + jnp.abs(by[0])
    assert np.isnan(interpolated(jnp.asarray(True), jnp.array([1.0]), f))
