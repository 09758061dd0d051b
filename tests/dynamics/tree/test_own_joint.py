"""A joint of a user's own, put together from primitives and motions that there are."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import stmuav_jax as stm
from stmuav_jax.mechanics.joint import CATALOGUE, Freedom, JointKind, Term, X, Y, Z
from stmuav_jax.mechanics.motions.axial import PRISMATIC, REVOLUTE

PLANAR = JointKind(
    (Term("n1", X, Z), Term("n1", Y, Z), Term("n2", Z)),
    (Freedom(PRISMATIC, X, " along x"), Freedom(PRISMATIC, Y, " along y"), Freedom(REVOLUTE)),
)


def test_a_planar_joint_is_one_entry_of_the_catalogue(monkeypatch):
    """Coordinates and rates come back from a state; accelerations are those of all bodies' rows."""
    monkeypatch.setitem(CATALOGUE, "planar", PLANAR)
    rng = np.random.default_rng(4)
    own = lambda name: stm.Body(
        name,
        1.5,
        np.diag([0.1, 0.2, 0.25]),
        position=rng.normal(size=3),
        com=0.1 * rng.normal(size=3),
    )
    bodies = [own(name) for name in "ab"]
    like = stm.cylindrical("plane", "a", "b", axis=[0.3, 0.2, 1.0], point=[0.4, 0.2, 0.1])
    hinge = stm.revolute("hinge", "ground", "a", point=[0.0, 0.0, 0.0], axis=[1.0, 0.2, 0.0])
    joints = [hinge, dataclasses.replace(like, kind="planar")]
    system = stm.System(bodies, joints, [stm.Gravity([0.0, 0.0, -9.81])])
    space = stm.TreeSpace(system)
    assert [name for name, _ in space.names[1:4]] == [
        "plane.displacement_1",
        "plane.displacement_2",
        "plane.angle",
    ]
    x, v = space.from_state(system.reference), jnp.asarray(rng.normal(size=8))

    @jax.jit
    def routes(x):
        state = space.to_state(space.retract(x, v))
        back = space.difference(space.from_state(state), x)
        formulations: list[Any] = [stm.Tree(), stm.Augmented()]
        rates = [
            how.accelerations(how.prepare(system), jnp.zeros(()), state, stm.Unstabilised())
            for how in formulations
        ]
        return back, rates

    back, (tree, augmented) = routes(x)
    np.testing.assert_allclose(back, v, atol=1e-13)
    np.testing.assert_allclose(tree.v_rate, augmented.v_rate, atol=1e-12)
    np.testing.assert_allclose(tree.omega_rate, augmented.omega_rate, atol=1e-12)
