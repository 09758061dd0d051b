"""Joints of a user's own, put together from primitives and motions that there are."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import inertia_of, random_quaternion

import stmuav_jax as stm
from stmuav_jax.mechanics.joint import CATALOGUE, Freedom, JointKind, Term, X, Y, Z
from stmuav_jax.mechanics.joint_states import coordinates_of
from stmuav_jax.mechanics.motions import PRISMATIC, REVOLUTE, SPHERICAL, reference_directions

ALONG_X, ALONG_Y = Freedom(PRISMATIC, X, " along x"), Freedom(PRISMATIC, Y, " along y")
PLANE = (Term("n1", X, Z), Term("n1", Y, Z), Term("n2", Z))
OWN = {
    "planar": JointKind(PLANE, (ALONG_X, ALONG_Y, Freedom(REVOLUTE))),
    "ball_in_slot": JointKind((Term("n2", Y), Term("n2", Z)), (ALONG_X, Freedom(SPHERICAL))),
}


@pytest.fixture
def star(monkeypatch):
    """Bodies on ground by joints of each kind, which lead once from ground and once to it."""
    rng, bodies, joints = np.random.default_rng(4), [], []
    for kind, entry in OWN.items():
        monkeypatch.setitem(CATALOGUE, kind, entry)
        for ends in (("ground", f"{kind}, i"), (f"{kind}, j", "ground")):
            name = next(end for end in ends if end != "ground")
            place, com = rng.normal(size=3), 0.1 * rng.normal(size=3)
            turn = random_quaternion(rng)
            bodies.append(
                stm.Body(name, 1.5, inertia_of(rng), position=place, com=com, orientation=turn)
            )
            like = stm.cylindrical(name, *ends, axis=rng.normal(size=3), point=rng.normal(size=3))
            joints.append(dataclasses.replace(like, kind=kind))
    return stm.System(bodies, joints, [stm.Gravity([0.0, 0.0, -9.81])])


@pytest.mark.slow
def test_coordinates_come_back_in_both_directions(star):
    """From joint coordinates to a state and back, by the joints and by the tree's coordinates."""
    rng = np.random.default_rng(5)
    count = {joint.name: len(coordinates_of(joint.kind)) for joint in star.joints}
    x, u = ({name: 0.8 * rng.normal(size=n) for name, n in count.items()} for _ in range(2))
    state = stm.state_from_joints(star, x, u)
    for name in count:
        found = stm.mechanics.joint_motion(star, state, name)
        np.testing.assert_allclose(found.coordinates, x[name], atol=1e-12)
        np.testing.assert_allclose(found.rates, u[name], atol=1e-12)
    tree, rows = stm.Tree(), stm.Augmented()
    model, other, t = tree.prepare(star), rows.prepare(star), jnp.zeros(())

    @jax.jit
    def routes(state):
        back = tree.to_state(model, tree.to_vector(model, state))
        one = tree.accelerations(model, t, state, stm.Unstabilised())
        return back, one, rows.accelerations(other, t, state, stm.Unstabilised())

    back, one, two = routes(state)
    for name in ("r", "p", "v", "omega"):
        np.testing.assert_allclose(getattr(back, name), getattr(state, name), atol=1e-12)
    np.testing.assert_allclose(one.v_rate, two.v_rate, atol=1e-11)
    np.testing.assert_allclose(one.omega_rate, two.omega_rate, atol=1e-11)


@pytest.mark.parametrize(
    ("motions", "words"),
    [
        ([(REVOLUTE, X), (REVOLUTE, Y), (REVOLUTE, Z)], "more than two rotations in sequence"),
        ([(REVOLUTE, X), (SPHERICAL, Z)], "more than two rotations in sequence"),
        ([(PRISMATIC, X), (REVOLUTE, Y), (PRISMATIC, Z)], "put it behind the rotation"),
    ],
)
def test_sequences_that_cannot_be_read_are_refused(motions, words):
    with pytest.raises(stm.ModelError, match=f"Joint 'own' has .*{words}"):
        reference_directions(motions, "Joint 'own'")


def test_a_joint_that_would_be_held_in_part_is_refused(star):
    with pytest.raises(
        stm.ModelError, match=r"'planar, i' cannot be held: no drivers prescribe all"
    ):
        stm.assemble(star, star.reference, hold_joints=("planar, i",))
