"""A mass on a spring of natural length zero, started where the spring is slack."""

from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm

# short enough for 1e-10 whatever the step control makes of a mass at rest
TS = jnp.linspace(0.0, 0.2, 21)
METHOD = stm.Method(rtol=1e-12, atol=1e-12, balances=False)
AHEAD = replace(METHOD, adjoint=diffrax.ForwardMode())
AT = [0.0, 0.1]


def system(damping=0.0):
    spring = stm.LinearSpringDamper("ground", "mass", stiffness=100.0, damping=damping)
    return stm.System([stm.Body("mass", 1.0, [0.1, 0.1, 0.1], free=True)], (), (spring,))


def end(x0, method):
    """Where the mass is at the end [m], started at rest at x0 on the x axis."""
    free = system()
    rest = [getattr(free.reference, name) for name in ("p", "v", "omega")]
    start = stm.State(jnp.array([[1.0, 0.0, 0.0]]) * x0, *rest)
    return stm.integrate(free, start, TS, method).states.r[-1, 0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivative_with_respect_to_the_start(mode):
    """d x(t) / d x0 = cos(omega t) with omega = 10 / s: cos 2 at 0.2 s."""
    if mode == "reverse":
        derivative = jax.jit(jax.grad(lambda x0: end(x0, METHOD)))
    else:
        derivative = jax.jit(jax.jacfwd(lambda x0: end(x0, AHEAD)))
    for x0 in AT:
        assert float(derivative(x0)) == pytest.approx(np.cos(2), rel=0, abs=1e-10)


@pytest.mark.parametrize("damping", [0.0, 4.0])
def test_spectrum(damping):
    """s^2 + c s + 100 = 0 three times, and zeros of the rotation."""
    free = system(damping)
    values = stm.dynamics.spectrum(free, free.reference)
    pair = np.roots([1.0, damping, 100.0])
    np.testing.assert_allclose(
        np.sort_complex(values[:6]), np.sort_complex([*pair] * 3), atol=1e-12
    )
    np.testing.assert_allclose(values[6:], 0, atol=1e-12)


def test_a_spring_with_a_length_has_no_spectrum_where_its_ends_meet():
    spring = stm.LinearSpringDamper("ground", "mass", stiffness=100.0, length=0.2)
    bad = stm.System([stm.Body("mass", 1.0, [0.1, 0.1, 0.1], free=True)], (), (spring,))
    with pytest.raises(stm.StateError, match="a force is discontinuous there"):
        stm.dynamics.spectrum(bad, bad.reference)
