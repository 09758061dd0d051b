"""Functions with derivatives at places where the usual ones have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.math.derivative import length_and_direction, safe_norm, safe_sqrt, sharp_sqrt


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_safe_sqrt_and_norm_have_zero_derivatives_at_zero(mode):
    squares = jnp.array([-1.0, 0.0, 4.0, jnp.inf, jnp.nan])
    assert np.array_equal(safe_sqrt(squares), [0.0, 0.0, 2.0, np.inf, np.nan], equal_nan=True)
    slopes = np.diagonal(mode(safe_sqrt)(squares[:3]))
    assert np.array_equal(slopes, [0.0, 0.0, 0.25])
    assert safe_norm(jnp.zeros(3)) == 0.0
    assert np.array_equal(mode(safe_norm)(jnp.zeros(3)), np.zeros(3))
    slope = mode(safe_norm)(jnp.array([3.0, 0.0, -4.0]))
    assert np.allclose(slope, [0.6, 0.0, -0.8], rtol=1e-15, atol=0)
    assert np.array_equal(mode(mode(safe_norm))(jnp.zeros(2)), np.zeros((2, 2)))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_sharp_sqrt_has_no_derivative_at_zero(mode):
    """Such as that of a rotor's speed by the wrench, at a command of zero; elsewhere it has."""
    squares = jnp.array([-1.0, 0.0, 4.0, jnp.nan])
    assert np.array_equal(sharp_sqrt(squares), [0.0, 0.0, 2.0, np.nan], equal_nan=True)
    for square, slope in zip(squares, [0.0, np.nan, 0.25, np.nan], strict=True):
        assert np.array_equal(mode(sharp_sqrt)(square), slope, equal_nan=True)


def test_safe_norm_sums_over_the_axis_it_is_told():
    vectors = jnp.array([[3.0, 4.0], [0.0, 0.0], [5.0, 12.0]])
    assert np.array_equal(safe_norm(vectors, axis=-1), [5.0, 0.0, 13.0])
    assert safe_norm(vectors[:2].T).dtype == vectors.dtype
    assert safe_norm(vectors.astype(jnp.float32)).dtype == jnp.float32


def test_length_and_direction_of_tiny_and_huge_vectors():
    for size in (1e-300, 1.0, 1e300):
        length, direction, apart = length_and_direction(size * jnp.array([3.0, 4.0]))
        assert np.isclose(length, 5 * size, rtol=1e-15)
        assert np.allclose(direction, [0.6, 0.8], rtol=1e-15)
        assert apart
    length, direction, apart = length_and_direction(jnp.zeros(2))
    assert length == 0
    assert not np.any(direction)
    assert not apart
