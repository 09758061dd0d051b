"""Plants whose instruments read while the machine is held at its start, before the loop is closed."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.math.space import Rotation

sys.path.insert(0, str(Path(__file__).parent))
import test_motion_estimator as sensed  # pyright: ignore[reportMissingImports]

control, sensing = stm.control, stm.analysis
POSE = Rotation()
SEEDS, STANDING = 96, 3.0


def standing(scene, biases, *, time=STANDING, supposed=None):
    """Hexacopter on noisy instruments with biases, which stands first, with a supposed start."""
    instruments = sensed.instruments("hexacopter", *biases)
    estimator = stm.uav.MotionEstimator(scene.system, sensed.RATE, instruments)
    memory = estimator.start(scene.state0 if supposed is None else supposed)
    return control.Plant(
        scene, sensors=instruments, estimator=estimator, memory=memory, standing=time
    )


@pytest.fixture(scope="module")
def stood():
    """Errors (seed, 15) and covariances after standing, with biases and pose as the filter believes."""
    scene = stm.make_scene("hexacopter")
    deviations = jnp.repeat(jnp.array([0.02, 0.05, 0.05]), 3)

    def one(seed):
        keys = jax.random.split(jax.random.key(seed), 4)
        biases = 0.02 * jax.random.normal(keys[0], (3,)), 0.1 * jax.random.normal(keys[1], (3,))
        off = deviations * jax.random.normal(keys[3], (9,))
        turned = jax.vmap(lambda p: POSE.retract(p, off[:3]))(scene.state0.p)
        at = scene.state0
        supposed = stm.State(at.r + off[3:6], turned, at.v + off[6:], at.omega)
        now = standing(scene, biases, supposed=supposed).reset(keys[2])
        truth = {"p": now.state.p[0], "r": now.state.r[0], "v": now.state.v[0]}
        truth |= {"gyroscope_bias": biases[0], "accelerometer_bias": biases[1]}
        belief = now.estimate.base
        return sensed.SPACE.difference(truth, belief.mean), belief.covariance

    return jax.tree.map(np.asarray, quick_jit(jax.vmap(one))(jnp.arange(SEEDS)))


@pytest.mark.slow
def test_all_errors_after_standing_are_as_small_as_the_estimator_says(stood):
    """NEES of all 15 errors over the draws, within its 99 % interval, and its parts as well."""
    error, P = stood
    for part in (slice(0, 15), slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)):
        own, covariance = error[:, part], P[:, part, part]
        nees = np.einsum("si,si->s", own, np.linalg.solve(covariance, own[..., None])[..., 0])
        low, high = stm.estimation.mean_interval(own.shape[1], SEEDS, 0.99)
        assert low < np.mean(nees) < high, part
        # none of them is beyond what one in 10,000 of so many draws would be
        assert (
            np.max(nees) < stm.estimation.mean_interval(own.shape[1], level=1 - 1e-4 / SEEDS)[1]
        ), part


def test_biases_and_attitude_are_known_after_standing(stood):
    """Attitude to 0.25 degrees, velocity to 2.5 cm/s, the gyroscope's bias to an eighth of its prior.

    These are four standard deviations or more, and no draw is beyond.
    """
    error, P = stood
    for part, most in (
        (slice(0, 3), np.radians(0.25)),
        (slice(6, 9), 0.025),
        (slice(9, 12), 0.0025),
    ):
        assert np.max(np.sqrt(np.diagonal(P, axis1=1, axis2=2)[:, part])) < most / 4
        assert np.max(np.abs(error[:, part])) < most


@pytest.mark.slow
def test_fixes_that_are_late_are_as_old_as_they_would_be_after_a_long_run():
    """At the first sample a fix that was read while standing arrives; without standing none does."""
    scene = stm.make_scene("hexacopter")
    none = (None, None)
    begun = quick_jit(lambda plant, key: plant.reset(key))
    stands = standing(scene, none, time=0.5)
    late = begun(stands, jax.random.key(0))
    early = begun(standing(scene, none, time=0.0), jax.random.key(0))
    for name in ("position hexacopter", "attitude hexacopter"):
        assert bool(late.readings[name].fresh)
        assert not bool(early.readings[name].fresh)
    # the machine is held: the accelerometer reads what carries it, although its rotors give nothing
    felt = late.readings["accelerometer hexacopter"].value
    np.testing.assert_allclose(felt, [0.0, 0.0, 9.81], atol=6 * sensed.FORCE)
    assert int(late.k) == 0
    assert float(late.t) == 0.0
    other = begun(stands, jax.random.key(1))
    assert not np.allclose(other.estimate.state.r, late.estimate.state.r, atol=1e-6)


def test_what_cannot_stand_is_refused():
    scene = stm.make_scene("hexacopter")
    none = (None, None)
    with pytest.raises(stm.SettingError, match="finite and not negative, but it is -1"):
        standing(scene, none, time=-1.0)
    with pytest.raises(stm.SettingError, match="time of standing must be a whole number"):
        standing(scene, none, time=1.001)
    with pytest.raises(stm.SettingError, match="for a plant without sensors"):
        control.Plant(scene, standing=1.0)
    start = stm.uav.BaseStart(vx=0.3)
    moving = stm.make_scene("hexacopter", start=start)
    with pytest.raises(stm.SettingError, match=r"its start moves, with up to 0.3 m/s"):
        standing(moving, none)
    with pytest.raises(stm.SettingError, match="its start moves"):
        standing(scene, none).reset(state0=moving.state0)
