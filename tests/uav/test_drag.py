"""Airframe drag against falls in closed form, its moment by hand, and its energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation, random_quaternion, state_of

from stmuav_jax import Body, Gravity, Method, ModelError, System, integrate
from stmuav_jax.uav import AirframeDrag

MASS, G = 1.7, 9.81
TS = jnp.linspace(0.0, 3.0, 7)


def system(force, gravity=G):
    body = Body("hull", MASS, [0.02, 0.03, 0.04], free=True)
    return System([body], forces=[Gravity(jnp.array([0.0, 0.0, -1.0]) * gravity), force])


@pytest.fixture(scope="module")
def fall():
    """One compilation for all: velocity at TS of a body let go, by drag, wind and gravity."""

    @jax.jit
    def velocity(linear, quadratic, wind, gravity):
        drag = AirframeDrag("hull", linear=linear, quadratic=quadratic, wind=wind)
        made = system(drag, gravity)
        return integrate(made, made.reference, TS, Method(rtol=1e-11, atol=1e-11)).states.v[:, 0]

    return lambda *args: np.asarray(velocity(*map(jnp.asarray, args)))


ZERO = np.zeros(3)


@pytest.mark.slow
def test_terminal_velocity_of_quadratic_drag(fall):
    """v = -v_t tanh(g t / v_t), v_t = sqrt(m g / d)."""
    d = 0.12
    v = fall(ZERO, np.array([0.3, 0.3, d]), ZERO, G)
    final = np.sqrt(MASS * G / d)
    np.testing.assert_allclose(v[:, 2], -final * np.tanh(G * np.asarray(TS) / final), atol=1e-8)
    assert np.max(np.abs(v[:, :2])) == 0


def test_linear_drag_takes_a_body_with_the_wind(fall):
    """v = W (1 - exp(-c t / m)), each axis by its own coefficient."""
    c, wind = np.array([0.4, 0.8, 1.6]), np.array([3.0, -2.0, 1.0])
    v = fall(c, ZERO, wind, 0.0)
    expected = wind * (1 - np.exp(-np.outer(np.asarray(TS), c) / MASS))
    np.testing.assert_allclose(v, expected, atol=1e-9)


def test_force_moment_and_power_by_hand():
    rng = np.random.default_rng(4)
    p, v, omega = random_quaternion(rng), rng.normal(size=3), rng.normal(size=3)
    point, c, d, wind = (rng.uniform(0.1, 1, size=3) for _ in range(4))
    drag = AirframeDrag("hull", linear=c, quadratic=d, point=point, wind=lambda t, kin: t * wind)
    made = system(drag)
    t = 2.0
    kin = made.kinematics(state_of([rng.normal(size=3)], [p], [v], [omega]))
    load = drag.load(jnp.asarray(t), kin)
    R = np_rotation(p)
    v_p = v + np.cross(R @ omega, R @ point)
    w = R.T @ (v_p - t * wind)
    force = R @ (-(c + d * np.linalg.norm(w)) * w)
    np.testing.assert_allclose(load.force[0], force, rtol=1e-12)
    np.testing.assert_allclose(load.moment[0], np.cross(point, R.T @ force), rtol=1e-12)
    assert float(load.power) == pytest.approx(force @ v_p, rel=1e-12)


def test_derivatives_are_finite_at_rest():
    made = system(AirframeDrag("hull", linear=[0.1] * 3, quadratic=[0.2] * 3))

    def force(v):
        kin = made.kinematics(state_of([[0, 0, 0]], [[1, 0, 0, 0]], v[None]))
        return made.forces[1].load(jnp.asarray(0.0), kin).force[0]

    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(force))(jnp.zeros(3)), -0.1 * np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"linear": [-0.1, 0, 0]}, "linear drag of body 'hull' must not be negative"),
        ({"quadratic": [0, np.nan, 0]}, "quadratic drag .* must be finite"),
        ({"quadratic": 0.1}, r"must have shape \(3,\)"),
        ({"wind": [1.0, 2.0]}, r"wind on body 'hull' must have shape \(3,\)"),
    ],
)
def test_senseless_numbers_are_refused(numbers, words):
    with pytest.raises(ModelError, match=words):
        AirframeDrag("hull", **numbers)
