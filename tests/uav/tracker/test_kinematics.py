"""Angles, strokes, normals and rates, each by a second route."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation
from vectors import UNEVEN, np_strokes

from stmuav_jax import PART_I, Augmented, State, make_scene
from stmuav_jax.uav import tracker_geometry
from stmuav_jax.uav.tracker.bodies import place, posture
from stmuav_jax.uav.tracker.geometry import turn_by_angles
from stmuav_jax.uav.tracker.kinematics import (
    RISING,
    PairMotion,
    panel_angles,
    panel_normal,
    solve_2x2,
    stroke_jacobian,
    stroke_motion,
    strokes,
    turn_by_direction,
)

ROUND_OFF = 1e-15  # [m]
AUTODIFF = 1e-11  # of derivatives in SI units
GEOMETRIES = {
    "even": tracker_geometry(PART_I),
    "uneven": tracker_geometry(PART_I.replaced(UNEVEN)),
}


@pytest.fixture(params=GEOMETRIES)
def geometry(request):
    return GEOMETRIES[request.param]


@pytest.fixture(scope="module")
def angles():
    """Postures on the level panel's side (2, 200) [rad]."""
    x = np.random.default_rng(7).uniform(-0.75, 0.75, (2, 200))
    x[1] = x[1].clip(-0.5)
    return jnp.asarray(x)


@pytest.mark.parametrize("rods", [RISING, (-1.0, 1.0), (1.0, -1.0)], ids=["up", "down 2", "down 3"])
def test_strokes_are_those_of_the_vector_equations(geometry, angles, rods):
    got = np.asarray(strokes(geometry, angles, rods))
    expected = np.stack([np_strokes(geometry, x, rods) for x in np.asarray(angles).T], axis=1)
    assert np.max(np.abs(got - expected)) < ROUND_OFF


def test_strokes_of_the_initial_posture():
    """Figures of the reconstruction: 22.06 and 21.43 mm, and 203.1 and 207.8 with falling rods."""
    x = jnp.array([-0.2674, -0.3088])
    g = GEOMETRIES["even"]
    assert 1e3 * np.asarray(strokes(g, x)) == pytest.approx([22.06, 21.43], abs=0.005)
    down = strokes(g, x, (-1.0, -1.0))
    assert 1e3 * np.asarray(down) == pytest.approx([203.1, 207.8], abs=0.05)


@pytest.mark.parametrize("rods", [RISING, (-1.0, 1.0)], ids=["up", "down 2"])
def test_jacobian_is_the_derivative(geometry, angles, rods):
    got = stroke_jacobian(geometry, angles, rods)
    by_autodiff = jax.vmap(jax.jacfwd(lambda x: strokes(geometry, x, rods)), in_axes=1, out_axes=2)
    assert np.max(np.abs(got - by_autodiff(angles))) < AUTODIFF
    assert np.max(np.abs(got)) > 0.05


def test_rates_and_accelerations(geometry, angles):
    """Along x(t) = x + x' t + x'' t^2 / 2, differentiated twice."""
    rng = np.random.default_rng(8)
    rate, acceleration = jnp.asarray(rng.normal(size=(2, *angles.shape)))
    moved = jax.jit(stroke_motion)(geometry, PairMotion(angles, rate, acceleration))
    path = lambda t: strokes(geometry, angles + rate * t + acceleration * t**2 / 2)
    first = lambda t: jax.jvp(path, (t,), (1.0,))[1]
    rates, accelerations = jax.jit(lambda: jax.jvp(first, (0.0,), (1.0,)))()
    assert np.max(np.abs(moved.value - path(0.0))) < ROUND_OFF
    assert np.max(np.abs(moved.rate - rates)) < AUTODIFF
    assert np.max(np.abs(moved.acceleration - accelerations)) < AUTODIFF
    back_rate = solve_2x2(stroke_jacobian(geometry, angles), moved.rate)
    assert np.max(np.abs(back_rate - rate)) < AUTODIFF
    assert np.max(np.abs(moved.acceleration)) > 0.1


def test_angles_of_a_normal_in_every_octant():
    n = np.random.default_rng(9).normal(size=(3, 500))
    found = np.asarray(panel_angles(n))
    back = np.asarray(panel_normal(jnp.asarray(found)))
    assert np.max(np.abs(back - n / np.linalg.norm(n, axis=0))) < 1e-15
    # the report's arcsines are right for normals above the horizon only
    unit = n / np.linalg.norm(n, axis=0)
    theta = np.arcsin(unit[0])
    printed = np.stack([np.arcsin(-unit[1] / np.cos(theta)), theta])
    above = unit[2] > 0.01
    assert np.max(np.abs(found - printed)[:, above]) < 1e-12
    assert np.all(np.abs(found - printed)[0, unit[2] < -0.01] > 1e-3)


def test_a_direction_turns_without_its_angles():
    n = np.random.default_rng(10).normal(size=(3, 100))
    for one, other in zip(turn_by_direction(n), turn_by_angles(panel_angles(n)), strict=True):
        assert np.max(np.abs(one - other)) < 1e-15


@pytest.mark.slow
def test_velocities_keep_every_joint():
    """J u = 0 for the joints' own Jacobian; the sliders move at the strokes' rates."""
    g, scene = GEOMETRIES["uneven"], make_scene("tracker", 2, PART_I.replaced(UNEVEN))
    model = Augmented().prepare(scene.system)
    rng = np.random.default_rng(11)
    x = jnp.asarray(rng.uniform(-0.4, 0.4, (20, 2)))
    rates = jnp.asarray(rng.normal(size=(20, 2)))

    @jax.jit
    @jax.vmap
    def look(x, rate):
        state = posture(g, x, rate)
        eq = model.constraints.equations(jnp.zeros(()), scene.system.kinematics(state))
        u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        return state, eq.value, eq.matrix @ u

    state, value, slip = look(x, rates)
    assert np.max(np.abs(value)) < ROUND_OFF
    assert np.max(np.abs(slip)) < 1e-14
    assert np.min(np.abs(np.linalg.norm(state.v[:, 5], axis=1))) > 1e-4
    moved = stroke_motion(g, PairMotion(x.T, rates.T, jnp.zeros_like(x.T)))
    assert np.max(np.abs(state.v[:, :2, 2].T - moved.rate)) < 1e-15
    assert np.max(np.abs(np.linalg.norm(state.p, axis=2) - 1)) < 1e-15


def test_falling_rods_keep_the_lengths():
    """The second root is the same mechanism, put together the other way."""
    g, x = GEOMETRIES["uneven"], jnp.array([0.2, 0.1])
    at = place(g, x, (-1.0, -1.0))
    for k, (low, high) in enumerate((("R26", "S67"), ("U35", "S57"))):
        along = np.asarray(at.points[high] - at.points[low])
        assert along[2] < -0.05
        assert np.linalg.norm(along) == pytest.approx(float(g.rods[k]), abs=ROUND_OFF)
        assert np_rotation(at.p[(4, 3)[k]])[:, 2] == pytest.approx(
            along / np.linalg.norm(along), abs=1e-14
        )


def test_posture_at_rest_is_the_scenes_start():
    scene = make_scene("tracker", 1)
    at = posture(GEOMETRIES["even"], jnp.array([-0.2674, -0.3088]))
    for field in dataclasses.fields(State):
        assert np.asarray(getattr(at, field.name)) == pytest.approx(
            np.asarray(getattr(scene.state0, field.name)), abs=ROUND_OFF
        )
