"""Facing a direction: right angles and strokes, or the limit that is broken and by how much."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_I, StateError, make_scene
from stmuav_jax.uav import tracker_geometry
from stmuav_jax.uav.tracker.kinematics import Reason, panel_normal, strokes
from stmuav_jax.uav.tracker.workspace import Limits, aim, survey, tracker_limits

G, LIMITS = tracker_geometry(PART_I), tracker_limits(PART_I)
FREE = Limits(home=(0.0, 0.0), tilt=np.pi)
many = jax.jit(aim)


@pytest.fixture(scope="module")
def normals():
    """Directions of random postures, some outside the workspace (3, 500)."""
    return panel_normal(jnp.asarray(np.random.default_rng(30).uniform(-1, 1, (2, 500))))


def test_a_stack_of_directions(normals):
    """Angles are those of the normal, strokes those of the angles, codes those of the map."""
    lengths = np.random.default_rng(31).uniform(0.1, 9, 500)
    found = many(G, lengths * np.asarray(normals), LIMITS)
    valid = np.asarray(found.reason) == Reason.VALID
    assert 100 < valid.sum() < 400
    assert np.max(np.abs(panel_normal(found.angles) - normals)[:, valid]) < 1e-15
    assert np.max(np.abs(strokes(G, found.angles) - found.strokes)[:, valid]) < 1e-15
    home = np.asarray(LIMITS.home)[:, None]
    assert np.max(np.abs(found.strokes - found.displacements - home)[:, valid]) < 1e-16
    assert np.array_equal(np.isnan(found.strokes).any(axis=0), ~valid)
    turned = np.asarray([np.arctan2(-normals[1], normals[2]), np.arcsin(normals[0])])
    assert np.array_equal(survey(G, turned, LIMITS).reason, found.reason)


def test_one_direction():
    found = aim(G, np.array([0.0, 0.0, 3.0]), LIMITS)
    assert np.asarray(found.angles).tolist() == [0, 0]
    # the panel was tilted at the start: level is 18.0 and 18.6 mm away
    assert 1e3 * np.asarray(found.displacements) == pytest.approx([18.01, 18.64], abs=0.005)


def test_shifts_are_what_the_scenes_joints_measure():
    """A servo whose target is the displacement would turn the panel to the direction."""
    n = np.array([0.2, 0.3, 1.0])
    found = aim(G, n, LIMITS)
    table = PART_I.replaced({"posture.phi": found.angles[0], "posture.theta": found.angles[1]})
    moved = make_scene("tracker", 1, table).state0.r - make_scene("tracker", 1).state0.r
    assert np.asarray(found.displacements) == pytest.approx(np.asarray(moved[:2, 2]), abs=1e-16)


@pytest.mark.parametrize(
    ("direction", "limits", "words"),
    [
        ((0, 0, 0), LIMITS, "zero length"),
        ((np.nan, 0, 1), LIMITS, "must be finite"),
        ((1, 0, 0.1), LIMITS, r"84\.29 degrees from the base's z axis, 24\.3 more than .* 60"),
        ((-1, 0, 1.2), LIMITS, r"slider 2 .* at -14\.06 mm .* 2\.06 mm beyond its lower stop at -12"),
        ((0.7, 0, 0.7), LIMITS, r"slider 2 .* 75\.43 mm .* 0\.431 mm beyond its upper stop at 75"),
        ((0.5, 0.7, 0.9), LIMITS, r"beyond the singularity .*margin -0\.0127, at least 0\.05"),
        ((0.3875, 0.5534, 0.737), LIMITS, r"too near the singularity .*margin 0\.0\d+, at least 0\.05"),
        ((-0.99, 0, 0.1), FREE, r"rod of leg 2 is 95 mm .* longer than 99\.3 mm \(imaginary root\)"),
        ((1, 1, 0.1), FREE, r"rod of leg 3 is 95 mm .* longer than 135\.1 mm \(imaginary root\)"),
        ((-0.7, -0.7, 0.5), FREE, "the post is 30 mm long and would have to be longer"),
    ],
)  # fmt: skip
def test_a_direction_outside_says_which_limit_and_by_how_much(direction, limits, words):
    n = np.array(direction, dtype=float)
    g = tracker_geometry(PART_I.replaced({"geometry.post": 0.03})) if "post" in words else G
    with pytest.raises(StateError, match=words):
        aim(g, n, limits)
    quiet = aim(g, n, limits, throw=False)
    assert int(quiet.reason) != Reason.VALID
    assert np.all(np.isnan(quiet.strokes))
    # compiled, and in a stack, nothing raises
    assert int(many(g, n, limits).reason) == int(quiet.reason)


def test_tiny_and_huge_directions_are_directions():
    for length in (1e-300, 1e300):
        found = aim(G, length * np.array([0.1, 0.2, 1.0]), LIMITS)
        assert np.asarray(found.angles) == pytest.approx(
            np.asarray(aim(G, np.array([0.1, 0.2, 1.0]), LIMITS).angles), abs=1e-15
        )


def test_derivatives_by_direction_and_lengths(normals):
    """Through the scaling and the masks: radial ones vanish, others are those of the angles."""
    n = jnp.array([0.3, -0.2, 0.8])
    J = np.asarray(jax.jit(jax.jacfwd(lambda n: aim(G, n, LIMITS).strokes))(n))
    assert np.max(np.abs(J @ np.asarray(n))) < 1e-15
    angles = lambda n: jnp.stack([jnp.arctan2(-n[1], n[2]), jnp.arcsin(n[0] / jnp.sqrt(n @ n))])
    expected = jax.jit(jax.jacfwd(lambda n: strokes(G, angles(n))))(n)
    assert np.max(np.abs(J - expected)) < 1e-13
    total = lambda g: jnp.nansum(aim(g, normals, LIMITS).strokes)
    gradient = jax.jit(jax.grad(total))(G)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
