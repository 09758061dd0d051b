"""A system is checked as a graph of names, and for its precision."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum

import stmuav_jax as stm
from stmuav_jax.mechanics.system import check_state

ORIGIN = [0.0, 0.0, 0.0]


def body(name, **more):
    return stm.Body(name, 1.0, [0.1, 0.1, 0.1], **more)


def ball(name, i, j):
    return stm.spherical(name, i, j, point=ORIGIN)


@pytest.mark.parametrize(
    ("bodies", "joints", "words"),
    [
        ([], [], "at least one body"),
        (["crank", "crank"], [], "Body names must be unique.*crank"),
        (["a", "b"], [("J", "ground", "a"), ("J", "a", "b")], "Joint names must be unique.*J"),
        (
            ["crank"],
            [("J", "ground", "crnak")],
            "Joint 'J' names the unknown body 'crnak'. Did you mean 'crank'",
        ),
        (["crank"], [("J", "crank", "xyz")], "Known names: crank, ground"),
        (["a"], [], "or to a free body: a"),
        (["a", "b", "c"], [("J", "ground", "a"), ("K", "b", "c")], "or to a free body: b, c"),
    ],
)
def test_bad_graphs(bodies, joints, words):
    with pytest.raises(stm.ModelError, match=words):
        stm.System([body(b) for b in bodies], [ball(*j) for j in joints])


def test_free_bodies_carry_what_is_joined_to_them():
    bodies = [body("a", free=True), body("b"), body("c"), body("d")]
    joints = [ball("ab", "a", "b"), ball("cb", "c", "b")]
    with pytest.raises(stm.ModelError, match="or to a free body: d"):
        stm.System(bodies, joints)
    system = stm.System(bodies[:3], joints)
    assert system.floating
    assert system.names == ("a", "b", "c")
    assert not stm.System(bodies[:3], [*joints, ball("g", "ground", "a")]).floating


@pytest.mark.parametrize(
    ("force", "words"),
    [
        (stm.AppliedForce("bobb", ORIGIN), "AppliedForce names the unknown body 'bobb'. Did you mean 'bob'"),
        (
            stm.LinearSpringDamper("ground", "bib", stiffness=1.0),
            "LinearSpringDamper names the unknown body 'bib'",
        ),
        (
            stm.TorsionalSpringDamper("hing", stiffness=1.0),
            "TorsionalSpringDamper names the unknown joint 'hing'. Did you mean 'hinge'",
        ),
    ],
)  # fmt: skip
def test_forces_must_name_what_is_there(force, words):
    with pytest.raises(stm.ModelError, match=words):
        pendulum(forces=(force,))


def test_single_precision_is_refused_unless_asked_for():
    with jax.enable_x64(False):
        with pytest.raises(stm.SettingError, match="double precision, but this array is float32"):
            stm.System([body("a", free=True)])
        system = stm.System([body("a", free=True)], allow_float32=True)
        assert system.bodies.mass.dtype == jnp.float32
        check_state(system, system.reference)


def test_single_precision_states_are_refused():
    system = pendulum()
    low = jax.tree.map(lambda x: x.astype(jnp.float32), system.reference)
    with pytest.raises(stm.SettingError, match="float32"):
        check_state(system, low)


def test_states_must_have_the_systems_shape():
    system = pendulum()
    two = jax.tree.map(lambda x: jnp.concatenate([x, x]), system.reference)
    with pytest.raises(stm.SettingError, match=r"State.r must have shape \(1, 3\).*bob"):
        check_state(system, two)
    batch = jax.tree.map(lambda x: x[None], system.reference)
    check_state(system, batch, batched=True)
    with pytest.raises(
        stm.SettingError, match=r"but it has \(1, 1, 3\). For many states use jax.vmap"
    ):
        check_state(system, batch)


def test_reference_posture_and_centre_of_mass():
    bodies = [
        stm.Body("a", 1.0, [1, 1, 1], position=[0, 0, 2], free=True),
        stm.Body("b", 3.0, [1, 1, 1], position=[4, 0, 2], com=[0, 0, 1], free=True),
    ]
    system = stm.System(bodies)
    np.testing.assert_allclose(system.reference.r, [[0, 0, 2], [4, 0, 3]])
    np.testing.assert_allclose(system.com(system.reference), [3, 0, 2.75])
    assert not np.any(system.reference.v)
    assert not np.any(system.reference.omega)


def test_a_state_of_lists_is_refused_by_name():
    system = stm.System([body("a", free=True)])
    leaves, form = jax.tree.flatten(system.reference)
    # made so that the type check that the tests switch on does not see it
    listed = form.unflatten([leaves[0], [[1.0, 0.0, 0.0, 0.0]], *leaves[2:]])
    with pytest.raises(
        stm.SettingError, match=r"State.p must be an array of shape \(1, 4\).* list"
    ):
        check_state(system, listed)


def test_the_same_system_with_other_forces():
    """with_forces adds, dataclasses.replace exchanges; all else is the same."""
    system = pendulum()
    push = stm.AppliedForce("bob", [1.0, 0.0, 0.0])
    both = system.with_forces(push)
    assert [type(f).__name__ for f in both.forces] == ["Gravity", "AppliedForce"]
    only = dataclasses.replace(system, forces=(push,))
    assert [type(f).__name__ for f in only.forces] == ["AppliedForce"]
    whole = pendulum(forces=(push,))
    assert jax.tree.structure(both) == jax.tree.structure(whole)
    for mine, expected in zip(jax.tree.leaves(both), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(mine, expected)
    with pytest.raises(stm.ModelError, match=r"unknown body 'bobb'\. Did you mean 'bob'"):
        system.with_forces(stm.AppliedForce("bobb", ORIGIN))
    with pytest.raises(stm.ModelError, match=r"must be forces.*of type int"):
        system.with_forces(3)


def test_a_system_made_of_the_bodies_of_another_says_what_to_do():
    system = pendulum()
    with pytest.raises(stm.ModelError, match=r"system\.with_forces.*dataclasses\.replace"):
        stm.System(system.bodies, system.joints, (stm.Gravity(),))
    again = stm.System(system.bodies, system.joints, system.forces, reference=system.reference)
    assert jax.tree.structure(again) == jax.tree.structure(system)
    with pytest.raises(stm.ModelError, match="leave reference= out"):
        stm.System([body("a", free=True)], reference=system.reference)


def gimbal(mass=0.5, com=(0.01, 0.0, -0.02), k=2.0, k_f=1e-5, g=-9.81):
    """A free frame with rotors, and a camera that a servo holds."""
    bodies = [
        stm.Body("frame", 2.0, [0.02, 0.02, 0.03], free=True),
        stm.Body("camera", mass, [1e-3, 1e-3, 1e-3], com=com, position=[0.0, 0.0, -0.1]),
    ]
    pitch = stm.revolute("pitch", "frame", "camera", point=[0.0, 0.0, -0.1], axis=[0.0, 1.0, 0.0])
    arms, spin = stm.uav.rotor_layout(4, 0.3)
    rotors = stm.uav.Rotors(
        "frame", arms=arms, spin=spin, k_f=k_f, k_tau=1e-7, speed_squared=4 * [6e5]
    )
    servo = stm.mechanics.JointServo("pitch", stiffness=k, damping=0.1, target=0.3)
    motors = stm.uav.MotorRotors(rotors, time_constant=0.03)
    return stm.System(bodies, [pitch], [stm.Gravity([0.0, 0.0, g]), motors, servo])


def test_other_numbers_make_the_system_that_would_be_built_with_them():
    changes = {
        "camera.mass": 0.7, "camera.com": [0.02, 0.01, -0.03], "pitch.stiffness": 3.0, "frame.k_f": 2e-5,
        "Gravity.acceleration": [0.0, 0.0, -1.62],
    }  # fmt: skip
    found = gimbal().with_parameters(changes)
    wanted = gimbal(0.7, (0.02, 0.01, -0.03), 3.0, 2e-5, -1.62)
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-16)
    limited: Any = gimbal().with_parameters({"pitch.limit": 0.5})
    assert float(limited.forces[2].limit) == 0.5
    mass = lambda m: jnp.sum(gimbal().with_parameters({"camera.mass": m}).bodies.mass)
    assert float(jax.grad(mass)(0.5)) == 1.0
    # numbers of a system that was made outside of the traced function, checked again inside
    system: Any = gimbal()
    thrust = lambda k: system.with_parameters({"frame.k_f": k}).forces[1].rotors.k_f
    assert float(jax.jit(thrust)(2e-5)) == 2e-5


def test_a_scene_with_other_numbers_starts_with_its_frames_where_they_were():
    system = gimbal()
    state = stm.state_from_joints(system, {"pitch": 0.4}, {"pitch": 1.0})
    scene = stm.Scene("gimbal", "", system, state)
    push = stm.AppliedForce("frame", [1.0, 0.0, 0.0])
    other = scene.with_(push, parameters={"camera.com": [0.1, 0.0, 0.2]}, t1=5.0)
    assert other.t1 == 5.0
    assert len(other.system.forces) == 4
    again = stm.state_from_joints(other.system, {"pitch": 0.4}, {"pitch": 1.0})
    for a, b in zip(jax.tree.leaves(other.state0), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)
    with pytest.raises(stm.SettingError, match=r"no field 't2'\. Known names: name, title"):
        scene.with_(t2=1.0)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("camera.mas", 1.0, r"there is none of this name\. Did you mean 'camera\.mass'"),
        ("camera.mass", -1.0, "The mass of body 'camera' must be finite and positive"),
        ("camera.inertia", [1.0, 1.0, 9.0], "violates the triangle inequality"),
        (
            "pitch.stiffness",
            -1.0,
            "The stiffness of the servo in joint 'pitch' must not be negative",
        ),
        ("frame.arms", [[0.0, 0.0, 1.0]], "need one arm"),
        ("pitch.internal", 1.0, "none of this name"),
    ],
)
def test_numbers_that_a_system_cannot_have_are_refused(name, value, words):
    with pytest.raises(stm.ModelError, match=words):
        gimbal().with_parameters({name: value})


def test_a_number_that_several_forces_have_is_refused():
    system = gimbal().with_forces(stm.mechanics.JointFriction("pitch", coulomb=0.1, speed=0.1))
    twice = system.with_forces(stm.TorsionalSpringDamper("pitch", stiffness=1.0))
    with pytest.raises(stm.ModelError, match="several forces have it"):
        twice.with_parameters({"pitch.stiffness": 1.0})
