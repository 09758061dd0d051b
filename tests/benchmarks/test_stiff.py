"""The scenes of the stiff benchmark."""

import jax
import jax.numpy as jnp
import numpy as np
from stiff import FREE, SCENES, as_given

import stmuav_jax as stm


def test_scenes_share_a_compilation():
    """Exact class: the same structure, shapes and types; only numbers differ."""

    def kind(held):
        leaves, tree = jax.tree.flatten(as_given(held.uav()))
        return tree, [(x.shape, x.dtype, x.weak_type) for x in leaves]

    first = kind(FREE)
    assert all(kind(held) == first for held in SCENES[1:])


def test_elements_that_are_not_there_do_nothing():
    """Exact class: with the sliders off their zero and in motion, no force at all."""
    plain, free = stm.make_scene("uav_tracker", 2), FREE.uav()
    start = plain.state0
    rng = np.random.default_rng(3)
    r, v = start.r + 1e-3 * rng.normal(size=(7, 3)), jnp.asarray(rng.normal(size=(7, 3)))
    kin = free.system.kinematics(stm.State(r, start.p, v, start.omega))
    added = free.system.forces[len(plain.system.forces) :]
    assert len(added) == 6
    for force in added:
        load = force.load(jnp.asarray(0.1), kin)
        assert not np.any(load.force)
        assert not np.any(load.moment)
