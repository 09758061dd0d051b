"""A system is checked as a graph of names, and for its precision."""

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
        (["a"], [], "Attached to nothing: a"),
        (["a", "b", "c"], [("J", "ground", "a"), ("K", "b", "c")], "Attached to nothing: b, c"),
    ],
)
def test_bad_graphs(bodies, joints, words):
    with pytest.raises(stm.ModelError, match=words):
        stm.System([body(b) for b in bodies], [ball(*j) for j in joints])


def test_free_bodies_carry_what_is_joined_to_them():
    bodies = [body("a", free=True), body("b"), body("c"), body("d")]
    joints = [ball("ab", "a", "b"), ball("cb", "c", "b")]
    with pytest.raises(stm.ModelError, match="Attached to nothing: d"):
        stm.System(bodies, joints)
    system = stm.System(bodies[:3], joints)
    assert system.floating
    assert system.names == ("a", "b", "c")
    assert not stm.System(bodies[:3], [*joints, ball("g", "ground", "a")]).floating


@pytest.mark.parametrize(
    ("force", "words"),
    [
        (stm.AppliedForce("bobb", ORIGIN), "AppliedForce names the unknown body 'bobb'. Did you mean 'bob'"),
        (stm.AppliedMoment("x", ORIGIN), "AppliedMoment names the unknown body 'x'"),
        (
            stm.LinearSpringDamper("ground", "bib", stiffness=1.0),
            "LinearSpringDamper names the unknown body 'bib'",
        ),
        (
            stm.TorsionalSpringDamper("hing", stiffness=1.0),
            "TorsionalSpringDamper names the unknown joint 'hing'. Did you mean 'hinge'",
        ),
        (stm.JointDamping("other", turning=1.0), "JointDamping names the unknown joint 'other'"),
    ],
)  # fmt: skip
def test_forces_must_name_what_is_there(force, words):
    with pytest.raises(stm.ModelError, match=words):
        pendulum(forces=(force,))


def test_lookups_suggest_names():
    system = pendulum()
    assert system.index("bob") == 0
    assert system.joint_index("hinge") == 0
    with pytest.raises(stm.ModelError, match=r"no body 'bop'. Did you mean 'bob'"):
        system.index("bop")
    with pytest.raises(stm.ModelError, match=r"no joint 'hinges'. Did you mean 'hinge'"):
        system.joint_index("hinges")


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
    with pytest.raises(stm.SettingError, match=r"State.r must have shape \(..., 1, 3\).*bob"):
        check_state(system, two)
    check_state(system, jax.tree.map(lambda x: x[None], system.reference))


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
        stm.SettingError, match=r"State.p must be an array of shape .*, 1, 4\).* list"
    ):
        check_state(system, listed)
