"""Splines through samples against SciPy, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import stmuav_jax as stm


@pytest.mark.parametrize("degree", [3, 5])
def test_as_scipy(degree):
    ts = np.sort(np.random.default_rng(0).uniform(0, 3, 12))
    values = np.sin(2 * ts)
    ours, theirs = stm.math.Sampled(ts, values, degree), make_interp_spline(ts, values, k=degree)
    at = np.linspace(ts[0], ts[-1], 57)
    f = jax.jit(jax.vmap(ours))
    slope = jax.vmap(jax.grad(ours))
    np.testing.assert_allclose(f(jnp.asarray(at)), theirs(at), atol=1e-12)
    np.testing.assert_allclose(slope(jnp.asarray(at[:-1])), theirs(at[:-1], 1), atol=1e-10)
    np.testing.assert_allclose(f(jnp.asarray(ts)), values, atol=1e-13)
    assert ours(jnp.asarray(1.0), None) == ours(jnp.asarray(1.0))


def test_converges_at_its_order():
    error = []
    for count in (41, 81):
        ts = np.linspace(0, 3, count)
        f = stm.math.Sampled(ts, np.sin(3 * ts))
        at = jnp.linspace(0.5, 2.5, 301)
        error.append(np.max(np.abs(jax.vmap(f)(at) - np.sin(3 * at))))
    assert 40 < error[0] / error[1] < 100


def test_several_values_and_traced_ones():
    """Columns are splines of their own; what is traced gives the same, with derivatives."""
    ts = np.linspace(0, 1, 9)
    values = np.stack([np.sin(3 * ts), np.cos(2 * ts)], axis=1)
    both = stm.math.Sampled(ts, values, 3)
    t = jnp.asarray(0.37)
    one = stm.math.Sampled(ts, values[:, 1], 3)
    assert float(both(t)[1]) == float(one(t))
    traced = lambda v: stm.math.Sampled(ts, v, 3)(t)
    np.testing.assert_allclose(jax.jit(traced)(jnp.asarray(values)), both(t), rtol=1e-14)
    weights = jax.jit(jax.jacfwd(traced))(jnp.asarray(values[:, 0]))
    np.testing.assert_allclose(weights @ values[:, 0], both(t)[0], rtol=1e-13)


@pytest.mark.parametrize(
    ("ts", "values", "match"),
    [
        ([0, 1, 1, 2, 3, 4], np.zeros(6), "after 1.0 s comes 1.0 s"),
        ([0, 1, 2], np.zeros(3), "at least 6 times"),
        (np.arange(6), [0, 1, np.nan, 0, 0, 0], "finite"),
        (np.arange(6), np.zeros(5), "shapes"),
    ],
)
def test_refused(ts, values, match):
    with pytest.raises(stm.ModelError, match=match):
        stm.math.Sampled(ts, values)


def test_effort_is_checked():
    with pytest.raises(stm.ModelError, match="finite"):
        stm.JointEffort("T12", np.inf)
    with pytest.raises(stm.ModelError, match="shape"):
        stm.JointEffort("T12", lambda t: jnp.stack([t, t]))
