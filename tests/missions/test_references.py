"""References of missions against closed forms and direct derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.missions.controller import (
    DirectionMotion,
    HeldPath,
    Jam,
    PanelMoves,
    WaypointPath,
    facing_motion,
)
from stmuav_jax.uav import ChangingWind


def test_two_waypoints_are_joined_by_the_polynomial_of_least_snap():
    """At rest up to the third derivative at both ends: 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7."""
    places = np.array([[0.0, 1.0, 2.0, 0.0], [4.0, -1.0, 2.5, 0.6]])
    path = eqx.filter_jit(WaypointPath(np.array([1.0, 3.0]), places))
    for t in (0.3, 1.0, 1.7, 2.4, 3.0, 5.0):
        s = np.clip((t - 1.0) / 2.0, 0.0, 1.0)
        share = np.polyval([-20.0, 70.0, -84.0, 35.0, 0.0, 0.0, 0.0, 0.0], s)
        rate = np.polyval([-140.0, 420.0, -420.0, 140.0, 0.0, 0.0, 0.0], s) / 2.0
        wanted, found = places[0] + share * (places[1] - places[0]), path(jnp.asarray(t))
        np.testing.assert_allclose([*found.r, found.heading], wanted, atol=1e-13)
        np.testing.assert_allclose(found.v, rate * (places[1] - places[0])[:3], atol=1e-12)


def test_a_path_goes_through_its_waypoints_and_is_smooth_between():
    ts, rng = np.array([0.0, 1.0, 2.5, 3.0]), np.random.default_rng(3)
    places = rng.normal(size=(4, 4))
    path = WaypointPath(ts, places)
    for t, place in zip(ts, places, strict=True):
        np.testing.assert_allclose(path.place(jnp.asarray(t)), place, atol=1e-11)
    at = eqx.filter_jit(path)
    before, after = at(jnp.asarray(1.0 - 1e-9)), at(jnp.asarray(1.0 + 1e-9))
    np.testing.assert_allclose(before.snap, after.snap, rtol=1e-5)


def test_headings_turn_the_nearer_way_round():
    """From 170 to -170 degrees by 20, through 180; and on to -60 by another 110."""
    headings = np.radians([170.0, -170.0, -60.0])
    places = np.column_stack([np.zeros((3, 3)), headings])
    path = WaypointPath(np.array([0.0, 3.0, 6.0]), places)
    turned = np.degrees(jax.jit(jax.vmap(path.place))(jnp.linspace(0.0, 6.0, 61))[:, 3])
    np.testing.assert_allclose(turned[[0, 30, 60]], [170.0, 190.0, 300.0], atol=1e-10)
    # a spline of least snap swings back before it turns, by a tenth of the way at most
    assert np.min(turned) > 157.0
    assert np.max(turned) < 313.0


def test_a_held_path_is_left_with_its_acceleration():
    path = HeldPath(jnp.array([1.0, 0.0, 2.0]), jnp.array([0.0, 0.0, 0.5]), jnp.asarray(0.1))
    found = path(jnp.asarray(2.0))
    np.testing.assert_allclose(found.r, [1.0, 0.0, 3.0])
    np.testing.assert_allclose(found.v, [0.0, 0.0, 1.0])


def test_moves_follow_each_other_from_rest_to_rest():
    ats, durations = (jnp.asarray(0.5), jnp.asarray(2.0)), (jnp.asarray(1.0), jnp.asarray(0.5))
    targets = (jnp.array([0.2, -0.1]), jnp.array([0.0, 0.3]))
    moves = eqx.filter_jit(PanelMoves(jnp.array([0.05, 0.05]), targets, ats, durations, False))
    for t, wanted in ((0.0, [0.05, 0.05]), (1.7, [0.2, -0.1]), (2.5, [0.0, 0.3])):
        found = moves(jnp.asarray(t))
        np.testing.assert_allclose(found.value, wanted, atol=1e-15)
        np.testing.assert_allclose([found.rate, found.acceleration], 0.0, atol=1e-12)


def test_a_move_may_have_a_shape_of_its_own():
    """That of a `Slew`, after a move by the quintic."""
    start, middle, goal = jnp.array([0.05, 0.05]), jnp.array([0.2, -0.1]), jnp.array([0.0, 0.3])
    ats, durations = (jnp.asarray(0.5), jnp.asarray(2.0)), (jnp.asarray(1.0), jnp.asarray(0.5))
    shapes = (jnp.zeros(0), jnp.array([0.1, -0.4]))
    moves = PanelMoves(start, (middle, goal), ats, durations, False, shapes)
    slew = stm.control.Slew(middle, goal, 0.5, [0.1, -0.4], at=2.0)
    for t in (1.9, 2.1, 2.3, 2.5):
        for found, wanted in zip(moves(jnp.asarray(t)), slew(jnp.asarray(t)), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-13)
    t = jnp.asarray(0.9)
    np.testing.assert_allclose(
        moves(t).acceleration, stm.control.Slew(start, middle, 1.0, at=0.5)(t)[2], rtol=1e-12
    )


@pytest.mark.slow
def test_a_panel_that_faces_a_moving_direction_from_a_turning_base():
    """Rates and accelerations against derivatives of the angles along the motion itself."""
    omega = jnp.array([0.3, -0.5, 0.7])
    p0 = stm.rotation.normalise(jnp.array([1.0, 0.1, -0.2, 0.3]))

    def p(t):
        return stm.rotation.product(p0, stm.rotation.from_rotation_vector(omega * t))

    def direction(t):
        return jnp.stack([jnp.sin(0.4 * t), 0.3 * t**2 - 0.1, 1.0 + 0.2 * t])

    def angles(t):
        return stm.uav.panel_angles(stm.rotation.rotation_matrix(p(t)).T @ direction(t))

    rate = lambda f: lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]
    t = jnp.asarray(0.6)
    wanted = DirectionMotion(direction(t), rate(direction)(t), rate(rate(direction))(t))
    zero = jnp.zeros((1, 3))
    found = facing_motion(wanted, stm.State(zero, p(t)[None], zero, omega[None]))
    np.testing.assert_allclose(found.value, angles(t), atol=1e-14)
    np.testing.assert_allclose(found.rate, rate(angles)(t), atol=1e-13)
    np.testing.assert_allclose(found.acceleration, rate(rate(angles))(t), atol=1e-12)


def test_a_wind_changes_smoothly_to_the_other():
    wind = ChangingWind(
        jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 2.0, 0.0]), jnp.asarray(1.0), jnp.asarray(0.5)
    )
    for t, wanted in ((0.9, 0.0), (1.25, 1.0), (1.6, 2.0)):
        np.testing.assert_allclose(wind(jnp.asarray(t)), np.array([1.0, wanted, 0.0]))


def test_a_jammed_slider_is_held_where_it_was():
    """The other keeps its force; at the held stroke the force is that of the damping alone."""
    scene = stm.make_scene("uav_tracker", 2)
    geometry = stm.uav.tracker_geometry(stm.PART_II)
    jam = Jam(geometry, jnp.array([1.0, jnp.inf]))
    asked, none = jnp.array([3.0, -2.0]), jnp.full(2, jnp.inf)
    forces, held = jam.forces(jnp.asarray(0.5), scene.state0, asked, none)
    np.testing.assert_allclose(forces, asked)
    assert np.all(np.isinf(held))
    forces, held = jam.forces(jnp.asarray(1.0), scene.state0, asked, none)
    home = stm.uav.tracker_limits(stm.PART_II).home
    np.testing.assert_allclose(held, np.array([float(home[0]), np.inf]))
    np.testing.assert_allclose(forces, [0.0, -2.0], atol=1e-9)
    moved, _ = jam.forces(
        jnp.asarray(1.1), scene.state0, asked, jnp.array([home[0] + 1e-3, np.inf])
    )
    assert moved[0] == pytest.approx(20.0)
