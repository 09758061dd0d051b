"""Episodes on a cart-pole as pure functions, and as Gymnasium's environments."""

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
SYSTEM = cart_pole()
SPACE = stm.TreeSpace(SYSTEM)
UPRIGHT = SPACE.from_state(SYSTEM.reference)
SAMPLES, LEANS = 40, 0.3


def errors(now):
    """Place, lean and their rates."""
    return SPACE.difference(SPACE.from_state(now.state), UPRIGHT)


def leaning(key):
    """A start with a random lean of the pole."""
    lean = 0.1 * jax.random.normal(key)
    p = jnp.stack([jnp.cos(lean / 2), 0 * lean, jnp.sin(lean / 2), 0 * lean])
    at = SYSTEM.reference
    r = at.r.at[1].set(0.8 * jnp.stack([jnp.sin(lean), 0 * lean, jnp.cos(lean)]))
    return stm.State(r, at.p.at[1].set(p), at.v, at.omega)


def environment(**more):
    given = {
        "lowest": [-20.0], "highest": [20.0], "samples": SAMPLES, "start": leaning,
        "failed": lambda now: jnp.abs(errors(now)[1]) > LEANS, "bounds": (-10.0, 10.0),
    }  # fmt: skip
    plant = control.Plant(SYSTEM, rate=50.0)
    reward = lambda before, inputs, after: 1.0 - 0.01 * jnp.sum(inputs**2)
    return control.Environment(plant, errors, reward, **(given | more))


@pytest.fixture(scope="module")
def pole():
    return environment()


FORCE, BREAKS = 4.0, 5


@pytest.fixture(scope="module")
def flown(pole):
    """Sixty steps of four episodes side by side, each begun anew after its end.

    No force acts on the first three; a constant one on the last, and one that is not finite once.
    """
    inputs = jnp.zeros((60, 4, 1)).at[:, 3].set(FORCE).at[BREAKS, 3].set(jnp.nan)

    def many(env, keys, inputs):
        def one(episode, given):
            after = jax.vmap(env.step_or_reset)(episode, given)
            return after, after

        start = jax.vmap(env.reset)(keys)
        return start, jax.lax.scan(one, start, inputs)[1]

    found = quick_jit(many)(pole, jax.random.split(jax.random.key(4), 4), inputs)
    return jax.tree.map(
        lambda x: x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x), found
    )


def energies(state):
    """Kinetic and potential energy of the cart-pole, by hand; the pole's centre is 0.8 m up."""
    moving = np.sum(np.array([2.0, 0.5]) * np.sum(state.v**2, axis=-1) / 2, axis=-1)
    return moving + 0.02 * state.omega[..., 1, 1] ** 2 / 2 + 0.5 * 9.81 * state.r[..., 1, 2]


def test_an_episode_is_the_plants_own_motion(flown):
    """Without a force energy and momentum are kept from step to step; with one, by its impulse."""
    start, after = flown
    assert len(np.unique(start.observation[:, 1])) == 4
    first = energies(start.now.state)
    np.testing.assert_allclose(after.now.t[:4], np.outer([0.02, 0.04, 0.06, 0.08], np.ones(4)))
    for k in range(5):
        kept = energies(jax.tree.map(lambda x, k=k: x[k, :3], after.now.state))
        np.testing.assert_allclose(kept, first[:3], rtol=1e-7)
        momentum = after.now.state.v[k, :, :, 0] @ np.array([2.0, 0.5])
        np.testing.assert_allclose(momentum, [0.0, 0.0, 0.0, FORCE * 0.02 * (k + 1)], atol=1e-7)
    np.testing.assert_array_equal(after.reward[:5, :3], 1.0)
    np.testing.assert_allclose(after.reward[:5, 3], 1 - 0.01 * FORCE**2)


def test_episodes_end_by_their_rules_and_begin_anew(flown):
    """Terminated where the pole leans too far, truncated after forty steps, then a fresh start."""
    _, after = flown
    over = after.terminated | after.truncated
    leans = np.abs(after.observation[:, :, 1]) > LEANS
    assert np.any(leans)
    np.testing.assert_array_equal(after.terminated, leans | after.broken)
    np.testing.assert_array_equal(after.truncated, after.now.k == SAMPLES)
    for k, env in zip(*np.nonzero(over[:-1]), strict=True):
        assert after.now.k[k + 1, env] == 0
        assert after.reward[k + 1, env] == 0.0
        assert not over[k + 1, env]
    starts = after.observation[after.now.k == 0][:, 1]
    assert len(np.unique(starts)) == len(starts) > 1


def test_a_motion_that_breaks_off_ends_its_episode(flown):
    """An input that is not finite: the observation before it, no reward, and it says so."""
    _, after = flown
    assert np.argwhere(after.broken).tolist() == [[BREAKS, 3]]
    assert after.terminated[BREAKS, 3]
    assert after.reward[BREAKS, 3] == 0.0
    np.testing.assert_array_equal(after.observation[BREAKS, 3], after.observation[BREAKS - 1, 3])
    # and the next one begins anew
    assert np.all(np.isfinite(after.observation))


def test_environments_that_make_no_sense_are_refused():
    for more, words in (
        ({"samples": 0}, "whole number of steps from 1, not 0"),
        ({"highest": [-20.0]}, "limits of the input 'effort' are -20 to -20"),
        ({"lowest": [-20.0, 0.0]}, "lowest inputs of an environment"),
        ({"failed": lambda now: now.state.r[:, 0] > 1}, "`failed` must return one value"),
    ):
        with pytest.raises(stm.SettingError, match=words):
            environment(**more)
    plant = control.Plant(SYSTEM, rate=50.0)
    with pytest.raises(stm.SettingError, match="must be a vector"):
        control.Environment(
            plant, lambda now: now.t, lambda *a: 0.0, lowest=[0.0], highest=[1.0], samples=2
        )


def test_without_gymnasium_it_is_asked_for(pole, monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "stmuav_jax.control.training.gymnasium_classes", raising=False)
    with pytest.raises(stm.SettingError, match=r"pip install 'stmuav-jax\[gym\]'"):
        control.gymnasium_env(pole)


def test_gymnasium_checks_an_environment(pole):
    """Gymnasium's own checker, with warnings as errors; and the actions' limits."""
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env  # pyright: ignore[reportMissingImports]

    env = control.gymnasium_env(pole)
    check_env(env, skip_render_check=True)
    env.reset(seed=3)
    *_, info = env.step(np.array([0.5]))
    assert info == {"broken": False}
    with pytest.raises(stm.SettingError, match=r"element \(0,\) is 1\.5"):
        env.step(np.array([1.5]))


def test_gymnasiums_vector_is_its_single_episodes(pole):
    """Each row of the vector against the pure functions, through the ends of episodes."""
    gymnasium = pytest.importorskip("gymnasium")
    many = control.gymnasium_vector_env(pole, 3)
    assert isinstance(many, gymnasium.vector.VectorEnv)
    assert many.observation_space.shape == (3, 4)
    seen, _ = many.reset(seed=4)
    assert many.observation_space.contains(seen)
    again, _ = many.reset(seed=4)
    np.testing.assert_array_equal(seen, again)
    keys = jax.random.split(jax.random.key(4), 3)
    episodes = quick_jit(lambda e, k: jax.vmap(e.reset)(k))(pole, keys)
    step = quick_jit(lambda e, now, u: jax.vmap(e.step_or_reset)(now, u))
    np.testing.assert_allclose(seen, episodes.observation, atol=1e-12)
    many.action_space.seed(1)
    ended = 0
    for _ in range(50):
        actions = many.action_space.sample()
        seen, rewards, terminated, truncated, info = many.step(actions)
        episodes = step(pole, episodes, 20.0 * jnp.asarray(actions))
        np.testing.assert_allclose(seen, episodes.observation, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(rewards, episodes.reward, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(terminated, episodes.terminated)
        np.testing.assert_array_equal(truncated, episodes.truncated)
        assert not np.any(info["broken"])
        ended += int(np.sum(terminated | truncated))
    assert ended > 2
    with pytest.raises(stm.SettingError, match="one copy or more, not 0"):
        control.gymnasium_vector_env(pole, 0)
