"""Parts of the benchmark of many flights at once: starts, errors, and peers that are not there."""

import importlib.util
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from peers import flying
from scipy.spatial.transform import Rotation
from sections.size import ONE
from sections.vector_steps import INTERPRETER, PEERS, moved, of_peer

import stmuav_jax as stm


def test_errors_are_distances_and_angles():
    at = flying.starts(5, 4)
    turned = Rotation.from_quat(at.quaternion) * Rotation.from_rotvec([0.0, 3e-3, 0.0])
    true = {1: (at.position, at.quaternion), 40: (at.position, at.quaternion)}
    found = {1: true[1], 40: (at.position + np.array([0.0, 3e-2, 4e-2]), -turned.as_quat())}
    row = flying.errors(found, true)
    assert row["position_error_one"] == 0.0
    assert row["angle_error_one"] < 1e-15
    assert row["position_error_many"] == pytest.approx(5e-2)
    assert row["angle_error_many"] == pytest.approx(3e-3)


def test_velocities_of_moved_machines_are_those_of_their_motion():
    """Central differences of a pose that turns and drifts; the UAV stays as rigid as it is."""
    state = stm.make_scene("uav_tracker", 2).state0
    at = flying.starts(1, 6)
    r, v, omega = (jnp.asarray(x[0]) for x in (at.position, at.velocity, at.omega))
    p = jnp.roll(jnp.asarray(at.quaternion[0]), 1)
    rotation, h = stm.rotation, 1e-5

    def later(t):
        turned = rotation.product(p, rotation.from_rotation_vector(omega * t))
        return moved(state, r + v * t, turned, v, omega)

    now, before, after = later(0.0), later(-h), later(h)
    np.testing.assert_allclose(now.v, (after.r - before.r) / (2 * h), rtol=0, atol=1e-8)
    for k in range(state.n_bodies):
        between = rotation.product(rotation.conjugate(before.p[k]), after.p[k])
        own = rotation.to_rotation_vector(between) / (2 * h)
        np.testing.assert_allclose(now.omega[k], own, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_that_is_not_installed_is_skipped_with_the_reason(name, monkeypatch):
    if importlib.util.find_spec(name) is not None:
        pytest.skip(f"{name} is installed here.")
    monkeypatch.setenv(INTERPRETER, sys.executable)
    about, rows = of_peer(name, ONE)
    assert rows == []
    assert about["method"] == name
    assert INTERPRETER in about["reason"]
    assert "ModuleNotFoundError" in about["reason"]
