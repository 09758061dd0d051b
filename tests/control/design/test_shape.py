"""Shapes of references: rest at both ends, the quintic, and their tuning together with the gains."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.algebra.compiler import quick_jit

sys.path.insert(0, str(Path(__file__).parents[2] / "flight"))
from mechanisms import cart_pole  # pyright: ignore[reportMissingImports]

control = stm.control

RATE, SAMPLES, GOAL, BOUNDS = 50.0, 101, 0.5, (0.6, 1.6)


def test_every_shape_begins_and_ends_at_rest():
    """By hand: the polynomials and their derivatives, of two values with three coefficients."""
    c = [0.05, -0.3, 0.1]
    slew = control.Slew([0.1, -0.3], [0.5, 0.4], 0.8, c, at=0.2)
    way, z = np.array([0.4, 0.7]), np.polynomial.Polynomial([-1.0, 2.0])
    s = np.polynomial.Polynomial([0.0, 1.0])
    rise = s**3 * (10 - 15 * s + 6 * s**2) + 64 * s**3 * (1 - s) ** 3 * (
        c[0] + c[1] * z + c[2] * z**2
    )
    for t in (0.0, 0.2, 0.3, 0.6, 0.95, 1.0, 1.4):
        x, inside = np.clip((t - 0.2) / 0.8, 0.0, 1.0), 0.2 < t < 1.0
        found = slew(jnp.asarray(t))
        np.testing.assert_allclose(found[0], [0.1, -0.3] + way * rise(x), atol=1e-13)
        np.testing.assert_allclose(found[1], inside * way * rise.deriv()(x) / 0.8, atol=1e-12)
        np.testing.assert_allclose(found[2], inside * way * rise.deriv(2)(x) / 0.64, atol=1e-11)
    for k in (0, 1, 2):
        at_ends = rise.deriv(k) if k else rise
        np.testing.assert_allclose(at_ends(np.array([0.0, 1.0])), [0.0, float(k == 0)], atol=1e-12)


def test_numbers_stay_within_their_bounds():
    assert control.within(0.0, 0.6, 1.6) == pytest.approx(1.1)
    ends = control.within(jnp.array([-30.0, 30.0]), 0.6, 1.6)
    np.testing.assert_allclose(ends, [0.6, 1.6], atol=1e-12)
    assert control.within(np.log(3.0), 2.0, 6.0) == pytest.approx(5.0)
    with pytest.raises(stm.SettingError, match="must be below the highest"):
        control.within(0.0, 1.0, 1.0)
    with pytest.raises(stm.ModelError, match="duration of a slew must be positive"):
        control.Slew([0.0], [1.0], 0.0)
    with pytest.raises(stm.ModelError, match="goal of a slew"):
        control.Slew([0.0], [1.0, 2.0], 1.0)


@pytest.mark.slow
def test_a_shape_is_tuned_together_with_the_gains():
    """A cart-pole of uncertain masses is moved by 0.5 m, upright; judged by held-out masses."""
    space = stm.TreeSpace(cart_pole())
    upright = space.from_state(space.system.reference)
    linear = stm.linearize(space, upright)
    gains = control.regulator(linear, [10.0, 10.0, 1.0, 1.0], [0.1], rate=RATE).K

    def cost(tuned, sample):
        duration = control.within(tuned["stretch"], *BOUNDS)
        slew = control.Slew([0.0], [GOAL], duration, tuned["shape"])

        def reference(t):
            (x,), (v,), _ = slew(t)
            return space.retract(upright, jnp.stack([x, 0 * x, v, 0 * v]))

        plant = control.Plant(cart_pole(mass=sample[0], bob=sample[1]), rate=RATE)
        feedback = control.StateFeedback(space, upright, [0.0], tuned["K"])
        found = control.rollout(plant, feedback, SAMPLES, reference=reference)
        cart, pole = found.states.r[:, 0, 0], found.states.r[:, 1, 0]
        # lean of the pole, and the time until the cart has come to its goal and stays
        late = found.ts > 1.0
        off = jnp.where(late, cart - GOAL, 0.0)
        return jnp.mean((pole - cart) ** 2) + jnp.mean(off**2) + 1e-6 * jnp.mean(found.inputs**2)

    start = {"K": gains, "shape": np.zeros(3), "stretch": np.zeros(())}
    draw = np.random.default_rng(5).normal(size=(10, 2))
    uncertain = np.array([2.0, 0.5]) * (1 + 0.05 * draw)
    found = control.tune_gains(cost, start, uncertain[:4], uncertain[4:], steps=25)
    assert found.ended == ""
    assert found.improvement > 0.5
    assert np.all(found.after < found.before)
    assert BOUNDS[0] < control.within(found.gains["stretch"], *BOUNDS) < BOUNDS[1]
    # the shape's own share: with the gains found, but the quintic of the start
    judge = quick_jit(jax.vmap(cost, (None, 0)))
    plain = judge(found.gains | {"shape": start["shape"]}, uncertain[4:])
    assert np.all(found.after < 0.9 * np.asarray(plain))
