"""Joint coordinates and rates along states: by kind, counted over turns, with derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation, state_of, turn

import stmuav_jax as stm

POINT, AXIS, SIDE = (
    np.array([0.2, -0.1, 0.3]),
    np.array([1.0, 2.0, 2.0]) / 3,
    np.array([2.0, 1, -2]) / 3,
)
JOINTS = {
    "revolute": stm.revolute("J", "a", "b", point=POINT, axis=AXIS),
    "translational": stm.translational("J", "a", "b", point=POINT, axis=AXIS),
    "cylindrical": stm.cylindrical("J", "a", "b", point=POINT, axis=AXIS),
    "screw": stm.screw("J", "a", "b", point=POINT, axis=AXIS, pitch=0.04),
    "universal": stm.universal("J", "a", "b", point=POINT, axis_i=AXIS, axis_j=SIDE),
    "spherical": stm.spherical("J", "a", "b", point=POINT),
}
COM = np.array([0.1, 0.0, -0.2])
# body a at the state: turned and moving
TURN_A, AT_A = turn([1.0, -2.0, 0.5], 0.8), np.array([1.0, 2.0, 3.0])
OMEGA_A, V_A = np.array([0.3, -0.4, 0.7]), np.array([-0.2, 0.5, 0.1])


def system_of(joint):
    body = lambda name, **more: stm.Body(name, 1.0, [0.1, 0.1, 0.1], com=COM, **more)
    return stm.System([body("a", free=True), body("b")], [joint])


# per kind: coordinates, their rates, and how b turns (in the world at reference) and slides
def moved(kind, q):
    """Rotation of b against a in the axes of both at reference, and displacement along AXIS."""
    rotation = lambda axis, angle: np_rotation(turn(axis, angle)) if angle else np.eye(3)
    if kind == "revolute":
        return rotation(AXIS, q[0]), 0.0
    if kind == "translational":
        return np.eye(3), q[0]
    if kind == "cylindrical":
        return rotation(AXIS, q[1]), q[0]
    if kind == "screw":
        return rotation(AXIS, q[0]), 0.04 * q[0]
    if kind == "universal":
        return rotation(AXIS, q[0]) @ rotation(SIDE, q[1]), 0.0
    return rotation(q, np.linalg.norm(q)), 0.0


NUMBERS = {
    "revolute": ([0.7], [1.3]),
    "translational": ([-0.4], [0.8]),
    "cylindrical": ([0.25, -2.1], [0.6, -1.1]),
    "screw": ([-17.3], [2.1]),  # its displacement tells the whole turns
    "universal": ([2.5, -0.9], [0.4, -1.7]),
    "spherical": ([0.4, -1.1, 0.8], None),
}


def state_at(kind, q, q_rate):
    """By NumPy, velocities by differences of positions where a does not move."""
    R_a = np_rotation(TURN_A)

    def place(x):
        R, along = moved(kind, np.asarray(x))
        return R_a @ R, AT_A + R_a @ (POINT + along * AXIS) + R_a @ R @ (COM - POINT)

    h = 1e-6
    step = np.asarray(q_rate) * h
    (R1, r1), (R0, r0) = place(np.asarray(q) + step), place(np.asarray(q) - step)
    R_b, r_b = place(q)
    skew = (R1 - R0) / (2 * h) @ R_b.T
    w = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    r_a = AT_A + R_a @ COM
    w_a = R_a @ OMEGA_A
    v_b = V_A + (r1 - r0) / (2 * h) + np.cross(w_a, r_b - r_a)
    p_b = np.asarray(stm.rotation.from_matrix(jnp.asarray(R_b)))
    return state_of([r_a, r_b], [TURN_A, p_b], [V_A, v_b], [OMEGA_A, R_b.T @ (w_a + w)]), R_a.T @ w


@pytest.mark.parametrize("kind", NUMBERS)
def test_coordinates_and_rates_by_kind(kind):
    q, q_rate = NUMBERS[kind]
    state, w = state_at(kind, q, np.array([0.5, 0.2, -0.3]) if q_rate is None else q_rate)
    found = stm.mechanics.joint_motion(system_of(JOINTS[kind]), state, "J")
    np.testing.assert_allclose(found.coordinates, q, atol=1e-14)
    # a spherical joint's are the angular velocity, in the axes of frame i
    np.testing.assert_allclose(found.rates, w if q_rate is None else q_rate, atol=1e-9)


def wheel(turns, rate, count):
    """States of a wheel that turns evenly."""
    system = stm.System(
        [stm.Body("wheel", 1.0, [1.0, 1.0, 1.0])],
        [stm.revolute("axle", "ground", "wheel", point=[0.0] * 3, axis=[0.0, 0.0, 1.0])],
    )
    ts = jnp.linspace(0.0, 2 * jnp.pi * turns / rate, count)
    half = 0.5 * rate * ts
    p = jnp.stack([jnp.cos(half), 0 * half, 0 * half, jnp.sin(half)], axis=1)[:, None]
    none = jnp.zeros((count, 1, 3))
    return system, ts, stm.State(none, p, none, none.at[..., 2].set(rate))


@pytest.mark.parametrize("rate", [-7.0, 1e4])
def test_angles_are_counted_on(rate):
    system, ts, states = wheel(1000.0 * np.sign(rate), rate, 2503)
    found = stm.mechanics.joint_motion(system, states, "axle")
    np.testing.assert_allclose(found.angle, rate * ts, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.angle_rate, rate, rtol=1e-15)


def test_a_fast_wheel_saved_rarely_is_counted_by_its_rates():
    system, ts, states = wheel(1e5, 3e3, 11)
    found = stm.mechanics.joint_motion(system, states, "axle", ts)
    np.testing.assert_allclose(found.angle, 3e3 * ts, rtol=1e-12)


def test_derivative_along_a_run():
    system, _, states = wheel(3.0, 2.0, 40)
    turned = lambda p: stm.mechanics.joint_motion(
        system, stm.State(states.r, p, states.v, states.omega), "axle"
    )
    slope = jax.grad(lambda p: turned(p).angle[-1])(states.p)
    expected = 2 * np.array([-states.p[-1, 0, 3], 0, 0, states.p[-1, 0, 0]])
    np.testing.assert_allclose(slope[-1, 0], expected, atol=1e-14)
    assert not np.any(slope[:-1])


def test_words_of_refusals():
    system, ts, states = wheel(1.0, 1.0, 5)
    with pytest.raises(stm.ModelError, match=r"no joint 'axel'\. Did you mean 'axle'"):
        stm.mechanics.joint_motion(system, states, "axel")
    with pytest.raises(
        stm.ModelError, match=r"is revolute and has no coordinate displacement; .*: angle"
    ):
        _ = stm.mechanics.joint_motion(system, states, "axle").displacement
    with pytest.raises(stm.SettingError, match="5 states, but the times have shape"):
        stm.mechanics.joint_motion(system, states, "axle", ts[1:])
    with pytest.raises(stm.SettingError, match=r"use jax\.vmap"):
        stm.mechanics.joint_motion(system, jax.tree.map(lambda x: x[None], states), "axle")
    rod = stm.distance("J", "a", "b", point_i=[0.0] * 3, point_j=[1.0, 0, 0])
    system = system_of(rod)
    with pytest.raises(stm.ModelError, match="a distance joint, which has no joint coordinates"):
        stm.mechanics.joint_motion(system, system.reference, "J")
