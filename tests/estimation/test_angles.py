"""Wide deviations of angles and rotations: no sigma point comes back on the other side."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.estimation.filter import GaussianFilter, filter_bank, kalman_filter
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.estimation.sigma import Cubature
from stmuav_jax.estimation.smoother import smooth
from stmuav_jax.math.space import Composite, CyclicVector, Rotation, Vector

STAY = lambda x, u, dt: x
ANGLES = CyclicVector((True, True, False, False))
ATTITUDE = Composite(p=Rotation(), x=Vector(1))
NOTHING = np.full((3, 1), np.nan)


def covariance(deviations, seed=0):
    """Covariance with these standard deviations and correlations up to 0.9."""
    a = np.random.default_rng(seed).normal(size=(len(deviations), len(deviations) + 2))
    P = a @ a.T
    scale = np.asarray(deviations) / np.sqrt(np.diag(P))
    return P * np.outer(scale, scale)


def still(space, h):
    n = space.size
    return StateSpaceModel(STAY, np.zeros((n, n)), Sensor(h, [[1.0]]), space=space)


VECTOR = still(ANGLES, lambda x, u: x[-1:]), np.array([3.1, -20.0, 0.0, 0.0])
TURNED = (
    still(ATTITUDE, lambda x, u: x["x"]),
    {"p": jnp.array([0.1, -0.7, 0.5, 0.5]), "x": jnp.zeros(1)},
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "deviations", "form"),
    [
        (VECTOR, [3.0, 1.5, 0.3, 0.3], "square_root"),
        (VECTOR, [3.0, 1.5, 0.3, 0.3], "covariance"),
        (TURNED, 3 * [1.8] + [0.5], "square_root"),
    ],
    ids=["angles", "angles, covariance", "rotation"],
)
def test_step_in_which_nothing_moves_leaves_the_covariance(case, deviations, form):
    """Rounding alone: 1e-12 of variances up to 9 rad^2, filtered and smoothed."""
    model, mean = case
    P = covariance(deviations)
    method = GaussianFilter(form=form)
    out = kalman_filter(model, gaussian(mean, P), NOTHING, dt=1.0, method=method)
    np.testing.assert_allclose(out.covariance, np.tile(P, (3, 1, 1)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        model.space.difference(out.at(-1).mean, out.prior.mean), 0.0, atol=1e-12
    )
    late = smooth(model, out)
    np.testing.assert_allclose(late.covariance, out.covariance, rtol=0, atol=1e-12)


def test_each_filter_of_a_bank_has_its_own_reduction():
    """Here from 0.2 to 30 rad."""
    model, mean = VECTOR
    spreads = np.array([0.2, 3.0, 30.0])
    P = np.stack([covariance([s, 1.0, 0.3, 0.3], seed=1) for s in spreads], axis=-1)
    priors = gaussian(np.repeat(mean[:, None], 3, axis=1), P)
    out = filter_bank(model, priors, np.repeat(NOTHING[..., None], 3, axis=2), dt=1.0)
    # 1e-12 of the largest variance of each
    np.testing.assert_allclose(out.covariance[-1] / spreads**2, P / spreads**2, rtol=0, atol=1e-12)


@pytest.mark.parametrize("wrapped", [False, True])
def test_rate_that_is_hardly_known_turns_far_in_a_gap(wrapped):
    """A known angle, a rate of +- 0.5 rad/s, 10 s without readings: 5 rad, by hand."""

    def step(x, u, dt):
        angle = x[0] + x[1] * dt
        return jnp.stack([jnp.arctan2(jnp.sin(angle), jnp.cos(angle)) if wrapped else angle, x[1]])

    sensor = Sensor(lambda x, u: x[1:], [[1.0]])
    model = StateSpaceModel(step, np.zeros((2, 2)), sensor, space=CyclicVector((True, False)))
    P, F = np.diag([0.01, 0.25]), np.array([[1.0, 10.0], [0.0, 1.0]])
    out = kalman_filter(model, gaussian([1.0, 0.2], P), [[np.nan]], dt=10.0)
    np.testing.assert_allclose(out.covariance[0], F @ P @ F.T, rtol=0, atol=1e-12)


def test_first_reading_of_an_unknown_angle():
    """R P / (P + R) whatever the prior's spread; the rate moves with the innovation's turn."""
    model = StateSpaceModel(
        STAY,
        np.zeros((2, 2)),
        Sensor(lambda x, u: x[:1], [[1e-4]], space=CyclicVector((True,))),
        space=CyclicVector((True, False)),
    )
    for spread in (0.5, 3.0, 100.0):
        prior = gaussian([3.0, 0.0], np.diag([spread, 1.0]) ** 2)
        out = kalman_filter(model, prior, [[-2.9]], dt=1.0)
        expected = 3.0 + (2 * np.pi - 5.9) * spread**2 / (spread**2 + 1e-4)
        np.testing.assert_allclose(out.mean[0], [expected, 0.0], rtol=0, atol=1e-10)
        variance = 1e-4 * spread**2 / (spread**2 + 1e-4)
        np.testing.assert_allclose(out.covariance[0, 0, 0], variance, rtol=1e-8)


@pytest.mark.slow
def test_likelihood_of_rotations_has_gradients():
    """By the size of P0, where points are nearer (1.5) and where not (0.2); central differences."""
    sensor = Sensor(lambda x, u: x["p"], 0.01 * np.eye(3), space=Rotation())
    model = StateSpaceModel(STAY, 1e-3 * np.eye(3), sensor, space=Composite(p=Rotation()))
    y = np.array([[1.0, 0.1, -0.2, 0.05], [0.99, 0.0, 0.1, 0.0]])
    y /= np.linalg.norm(y, axis=1)[:, None]
    method = GaussianFilter(Cubature(means=1))

    def value(size):
        prior = gaussian({"p": jnp.eye(4)[0]}, size**2 * jnp.eye(3))
        return kalman_filter(model, prior, y, dt=1.0, method=method).log_likelihood

    both, h = jax.jit(jax.value_and_grad(value)), 1e-5
    for size in (0.2, 1.5):
        expected = (both(size + h)[0] - both(size - h)[0]) / (2 * h)
        np.testing.assert_allclose(both(size)[1], expected, rtol=1e-7)


def test_mechanism_with_a_revolute_joint_says_how_far_it_turns():
    """Half turns of its joint and of a floating base; lengths and rates have none."""
    import stmuav_jax as stm

    free = stm.Body("free", 1.0, np.eye(3), position=[0.0, 0.0, 0.0], free=True)
    arm = stm.Body("arm", 1.0, np.eye(3), position=[1.0, 0.0, 0.0])
    hinge = stm.revolute("hinge", "free", "arm", point=[0.5, 0.0, 0.0], axis=[0.0, 0.0, 1.0])
    space = stm.TreeSpace(stm.System([free, arm], [hinge]))
    unit = np.eye(space.size)
    turns = np.asarray(space.half_turns(jnp.asarray(unit))) * np.pi
    angular = [name.startswith(("phi", "theta", "psi", "hinge")) for name, _ in space.names]
    angular = np.array(angular[: space.dof] + [False] * (space.size - space.dof))
    np.testing.assert_allclose(turns, angular.astype(float), atol=1e-15)
