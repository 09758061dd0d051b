"""Joint reactions: statics, a swinging pendulum, signs, and where the moment is taken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import GRAVITY, np_rotation, pendulum, swung, turn, unit

import stmuav_jax as stm

MASS, LENGTH = 2.0, 0.5
EXACT = 1e-11


def evaluated(system, state=None, **more):
    state = system.reference if state is None else state
    return jax.tree.map(
        np.asarray, jax.jit(lambda s: stm.dynamics.evaluate(system, s, **more))(state)
    )


def close(got, expected, tolerance=EXACT):
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


def boom(first, second, kind=None):
    """A body that sticks out from a weld (or another joint) at the origin, loaded."""
    body = stm.Body("arm", 3.0, [0.1, 0.2, 0.15], position=[0.4, 0.3, 0.1])
    joint = stm.weld("J", first, second) if kind is None else kind(first, second)
    return stm.System([body], [joint], [stm.Gravity(), stm.AppliedMoment("arm", [1.0, 2.0, 3.0])])


def test_ground_as_body_i_and_as_body_j():
    """What i exerts on j: opposite when the bodies change places."""
    one, two = (evaluated(boom(*pair)).reactions for pair in (("ground", "arm"), ("arm", "ground")))
    force = np.array([0, 0, 3 * GRAVITY])
    moment = -np.cross([0.4, 0.3, 0.1], -force) - [1, 2, 3]
    close(one.force[0], force)
    close(one.moment[0], moment)
    close(two.force[0], -force)
    close(two.moment[0], -moment)


def test_a_rail_carries_the_moment_of_an_eccentric_load():
    """A translational joint along a tilted axis, with the moment about j's joint point."""
    axis = unit([1.0, 0.0, 2.0])
    rail = lambda i, j: stm.translational("J", i, j, axis=axis, point=[0.1, 0.0, 0.0])
    found = evaluated(boom("ground", "arm", rail))
    weight = np.array([0, 0, -3 * GRAVITY])
    a = (weight @ axis) / 3.0 * axis
    force = 3.0 * a - weight
    arm = np.array([0.3, 0.3, 0.1])  # from the point to the centre of mass
    close(found.accelerations.v_rate[0], a)
    close(found.accelerations.omega_rate[0], np.zeros(3))
    close(found.reactions.force[0], force)
    assert abs(found.reactions.force[0] @ axis) < EXACT
    close(found.reactions.moment[0], np.cross(arm, 3.0 * a - weight) - [1, 2, 3])


def test_the_joint_frame_turns_with_body_i():
    """Two bodies, the first turned since the reference posture: axes fixed in body i."""
    bodies = [
        stm.Body("one", 1.0, [0.1, 0.1, 0.1]),
        stm.Body("two", 2.0, [0.1, 0.1, 0.1], position=[1, 0, 0]),
    ]
    joints = [
        stm.revolute("base", "ground", "one", point=[0, 0, 0], axis=[0, 0, 1]),
        stm.weld("J", "one", "two", point=[0.5, 0, 0]),
    ]
    system = stm.System(bodies, joints)
    p, rate = turn([0, 0, 1], 0.8), 2.0
    R = np_rotation(p)
    omega = np.array([[0, 0, rate]] * 2)
    r = np.array([[0, 0, 0], R @ [1, 0, 0]])
    state = stm.State(*map(jnp.asarray, (r, np.stack([p, p]), np.cross(omega, r), omega)))
    world, joint = (evaluated(system, state, frame=f).reactions for f in ("world", "joint"))
    pull = 2.0 * rate**2  # centripetal, towards the axis
    close(world.force[1], R @ [-pull, 0, 0])
    close(joint.force[1], [-pull, 0, 0])
    close(world.force[0], -R @ [pull, 0, 0])
    close(joint.moment[1], np.zeros(3))


def test_a_motors_moment_is_the_reaction_of_its_driver():
    """A driven crank at rest under gravity: moment m g l sin(angle) about the axis."""
    system = pendulum()
    hinge = system.joints[0]
    fresh = stm.revolute("hinge", "ground", "bob", point=[0, 0, 0], axis=[0, 1, 0])
    assert fresh.kind == hinge.kind
    motor = stm.drive("motor", fresh, lambda t: 0.6 + 0.0 * t, coordinate="angle")
    body = stm.Body("bob", MASS, [0.02, 0.02, 0.01], position=[0, 0, -LENGTH])
    driven = stm.System([body], [fresh, motor], [stm.Gravity([0, 0, -GRAVITY])])
    found = evaluated(driven, swung(pendulum(), 0.6))
    close(found.accelerations.v_rate, np.zeros((1, 3)))
    close(found.reactions.moment[1], [0, MASS * GRAVITY * LENGTH * np.sin(0.6), 0])
    close(found.reactions.force[0], [0, 0, MASS * GRAVITY])


def test_what_a_joint_exerts_on_either_body():
    """On the body its weight, on ground the opposite at the same point; along a run too."""
    system = pendulum()
    found = evaluated(system).reactions
    weight = np.array([0, 0, MASS * GRAVITY])
    for body, sign in ((system.joints[0].body_j, 1), (system.joints[0].body_i, -1)):
        force, moment = stm.dynamics.reaction_on(system, found, "hinge", body)
        close(force, sign * weight)
        close(moment, np.zeros(3))
        along = jax.tree.map(lambda x: np.stack([x, 2 * x]), found)
        close(stm.dynamics.reaction_on(system, along, "hinge", body)[0][1], 2 * sign * weight)
    with pytest.raises(stm.ModelError, match="and not 'x': name one"):
        stm.dynamics.reaction_on(system, found, "hinge", "x")
    with pytest.raises(stm.ModelError, match="no joint 'hinges'"):
        stm.dynamics.reaction_on(system, found, "hinges", "ground")
