"""Roots by Newton's method: their derivatives, and whether a program with them can be kept."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from stmuav_jax.math.newton import Implicit, Newton


def root(a):
    """The positive y with y^2 = a, and a coupled y_1 y_2 = a_1 a_2."""
    fn = lambda y, a: jnp.stack([y[0] ** 2 - a[0], y[0] * y[1] - a[0] * a[1]])
    found = optx.root_find(
        fn, Newton(atol=1e-13), jnp.ones(2), a, adjoint=Implicit(), max_steps=30, throw=False
    )
    return found.value


A = jnp.array([2.0, 3.0])


def test_derivatives_are_those_of_the_closed_form():
    """y = (sqrt a_1, sqrt a_1 a_2), in both modes and to second order."""
    exact = lambda a: jnp.sqrt(a[0]) * jnp.stack([1.0, a[1]])
    np.testing.assert_allclose(root(A), exact(A), rtol=1e-14)
    expected = jax.jacfwd(exact)(A)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(root))(A), expected, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(jax.jit(jax.jacrev(root))(A), expected, rtol=1e-13, atol=1e-15)
    twice = jax.jit(jax.jacfwd(jax.jacrev(root)))(A)
    np.testing.assert_allclose(twice, jax.jacfwd(jax.jacfwd(exact))(A), rtol=1e-12, atol=1e-14)
    several = jax.vmap(jax.jacfwd(root))(jnp.stack([A, 2 * A]))
    np.testing.assert_allclose(several[1], jax.jacfwd(exact)(2 * A), rtol=1e-13, atol=1e-15)


def test_a_program_of_derivatives_can_be_kept():
    """JAX's compilation cache takes no program that calls back to Python: `stmuav trim --by`."""
    for of in (root, jax.jacfwd(root), jax.jacrev(root)):
        assert "callback" not in jax.jit(of).lower(A).as_text()
