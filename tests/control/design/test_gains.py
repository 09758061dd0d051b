"""Gains by gradients through closed loops: of a sampled system by hand, a cart-pole, a hexacopter."""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import stmuav_jax as stm
from stmuav_jax.algebra.compiler import quick_jit

sys.path.insert(0, str(Path(__file__).parents[2] / "flight"))
from mechanisms import cart_pole  # pyright: ignore[reportMissingImports]

control = stm.control


def test_gains_of_a_quadratic_cost_are_found():
    """The mean of (g - s)^2 over samples s is least at their mean; held out, by the closed form."""
    samples, held_out = np.array([1.0, 2.0, 6.0]), np.array([2.5, 3.5])
    seen = []
    found = control.tune_gains(
        lambda g, s: jnp.sum((g["a"] - s) ** 2), {"a": np.array([1.0])}, samples, held_out,
        optimiser=optax.sgd(0.5), steps=30, progress=lambda k, value: seen.append((k, value)),
    )  # fmt: skip
    np.testing.assert_allclose(found.gains["a"], [3.0], rtol=1e-9)
    np.testing.assert_allclose(found.before, [2.25, 6.25])
    np.testing.assert_allclose(found.after, [0.25, 0.25], rtol=1e-8)
    assert found.improvement == pytest.approx(1 - 0.25 / 4.25)
    assert found.costs[0] == pytest.approx((0 + 1 + 25) / 3)
    assert len(seen) == len(found.costs) == 31
    # the cost falls towards zero from above, and the gain with it
    down = control.tune_gains(
        lambda g, s: g * s, 1.0, np.ones(2), np.ones(1), steps=5, positive=True
    )
    assert 0 < down.gains < 1


def test_what_cannot_be_tuned_is_refused():
    ones = np.ones(3)
    cost = lambda g, s: g * s
    with pytest.raises(stm.SettingError, match="At least one step"):
        control.tune_gains(cost, 1.0, ones, ones, steps=0)
    with pytest.raises(stm.SettingError, match="The held-out samples must be arrays"):
        control.tune_gains(cost, 1.0, ones, (ones, np.ones(2)))
    with pytest.raises(stm.SettingError, match="must be so at the start, but one is -1"):
        control.tune_gains(cost, -1.0, ones, ones, positive=True)
    with pytest.raises(stm.SettingError, match=r"one number, but its shape is \(2,\)"):
        control.tune_gains(lambda g, s: jnp.ones(2) * g, 1.0, ones, ones)
    with pytest.raises(stm.SimulationError, match="the mean cost is nan"):
        control.tune_gains(lambda g, s: g * s * jnp.nan, 1.0, ones, ones)
    broken = control.tune_gains(lambda g, s: jnp.log(g), 0.1, ones, ones, optimiser=optax.sgd(1.0))
    assert "after 1 steps the mean cost is -inf" in broken.ended
    assert broken.gains == 0.1


@pytest.mark.slow
def test_a_cart_pole_of_uncertain_masses_is_tuned():
    """From a regulator with other weights; held-out samples cost at least a fifth less."""
    space = stm.TreeSpace(cart_pole())
    upright = space.from_state(space.system.reference)
    linear = stm.linearize(space, upright)
    gains = control.regulator(linear, [1.0, 1.0, 10.0, 10.0], [1.0], rate=50.0).K
    start = stm.state_from_joints(space.system, {"rail": 0.3, "hinge": 0.1}, {})

    def cost(K, sample):
        plant = control.Plant(cart_pole(mass=sample[0], bob=sample[1]), start, rate=50.0)
        feedback = control.StateFeedback(space, upright, [0.0], K)
        found = control.rollout(plant, feedback, 101)
        return jnp.mean(found.states.r[:, 0, 0] ** 2) + 1e-6 * jnp.mean(found.inputs**2)

    draw = np.random.default_rng(5).normal(size=(12, 2))
    uncertain = np.array([2.0, 0.5]) * (1 + 0.05 * draw)
    found = control.tune_gains(cost, gains, uncertain[:4], uncertain[4:], steps=12)
    assert found.ended == ""
    assert found.before.shape == (8,)
    assert found.improvement > 0.2
    assert np.all(found.after < found.before)


@pytest.fixture(scope="module")
def hexacopter():
    """A hexacopter's scene aslant, its controller, and the cost of a second's flight."""
    start = stm.scenes.BaseStart(x=0.3, y=-0.2, roll=0.4, pitch=-0.2, p=0.5)
    scene = stm.make_scene("hexacopter", start=start)
    pilot = control.FlightController(scene.system, 400.0)

    def cost(gains, mass):
        system = eqx.tree_at(lambda s: s.bodies.mass, scene.system, jnp.reshape(mass, (1,)))
        plant = control.Plant(system, scene.state0)
        own = eqx.tree_at(lambda p: p.gains, pilot, gains)
        found = control.rollout(
            plant, own, 401, reference=control.at_point([0.0, 0.0, 0.2]), memory=own.start()
        )
        off = found.states.r[:, 0] - jnp.array([0.0, 0.0, 0.2])
        return jnp.mean(jnp.sum(off**2, axis=1)) + 1e-3 * jnp.mean(found.states.omega[:, 0] ** 2)

    return cost, control.FlightGains(integral=0.5), float(scene.system.bodies.mass[0])


@pytest.mark.slow
def test_gradients_of_a_hexacopters_loop(hexacopter):
    """By all five gains and by the mass, through 1 s at 400 Hz: 1e-5 of converged differences."""
    cost, gains, mass = hexacopter
    at = quick_jit(cost)
    by_gains, by_mass = quick_jit(jax.grad(cost, argnums=(0, 1)))(gains, jnp.asarray(mass))

    def difference(f, h):
        return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    for name in ("position", "velocity", "integral", "attitude", "rate"):
        own = float(getattr(gains, name))
        moved = lambda h, name=name, own=own: float(
            at(eqx.tree_at(lambda g: getattr(g, name), gains, jnp.asarray(own * (1 + h))), mass)
        )
        wide, narrow = difference(moved, 2e-3), difference(moved, 1e-3)
        # the differences have converged
        assert wide == pytest.approx(narrow, rel=1e-6)
        assert own * float(getattr(by_gains, name)) == pytest.approx(narrow, rel=1e-5)
    moved = lambda h: float(at(gains, jnp.asarray(mass * (1 + h))))
    narrow = difference(moved, 1e-3)
    assert difference(moved, 2e-3) == pytest.approx(narrow, rel=1e-6)
    assert mass * float(by_mass) == pytest.approx(narrow, rel=1e-5)


@pytest.mark.slow
def test_a_hexacopter_of_uncertain_mass_is_tuned(hexacopter):
    """Held-out masses cost at least a fifth less than with the default gains."""
    cost, gains, mass = hexacopter
    masses = mass * (1 + 0.05 * np.random.default_rng(8).normal(size=12))
    found = control.tune_gains(cost, gains, masses[:4], masses[4:], steps=20, positive=True)
    assert found.improvement > 0.2
