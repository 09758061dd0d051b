"""Trim and linearisation of the UAV: published figures, another formulation, differences."""

import inspect
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import stmuav_jax as stm
from stmuav_jax.analysis import climb, cruise, hover, linearize, steady_turn
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.uav import TrimLimits, TrimReason, Uav, trim_flight, trim_slopes
from stmuav_jax.uav.allocation import RotorLimits, wrench_map
from stmuav_jax.uav.scenes.uav_tracker import make_uav
from stmuav_jax.uav.tracker.kinematics import Reason

START = stm.uav.initial_angles(stm.PART_II)


# phi, theta in degrees and the limit of the table that each breaks
OUTSIDE = {
    TrimReason.VALID: (10.0, 10.0),
    TrimReason.TILT: (20.0, 62.0),
    TrimReason.SINGULAR: (-55.0, 0.0),
    TrimReason.STROKE_2: (0.0, -36.0),
    TrimReason.STROKE_3: (55.0, -12.0),
    TrimReason.POSTURE: (0.0, -60.0),
}


@pytest.fixture(scope="module")
def uav():
    return make_uav()


@pytest.fixture(scope="module")
def many(uav):
    """Trims at several panel angles, the first the initial ones; the 16th out of reach.

    Then one for each of OUTSIDE.
    """
    angles = np.random.default_rng(5).uniform(-0.5, 0.5, (16, 2))
    angles[0] = START
    angles[-1] = [0.2, -1.5]
    angles = np.concatenate([angles, np.radians(list(OUTSIDE.values()))])
    both = jax.vmap(lambda a: trim_flight(uav, hover(a), throw=False))
    return angles, stm.math.outer_jit(both)(jnp.asarray(angles))


@pytest.fixture(scope="module")
def start(many):
    return jax.tree.map(lambda x: x[0], many[1])


@pytest.mark.slow
def test_hover_speeds(many):
    """The trimmed speeds at the initial posture, by a program written apart from this one."""
    angles, found = many
    expected = [1361.0, 1359.7, 1355.0, 1351.7, 1353.0, 1357.6]
    np.testing.assert_allclose(found.speeds[0], expected, atol=0.05)
    assert list(np.asarray(found.reason)) == [0] * 15 + [TrimReason.POSTURE, *OUTSIDE]
    assert np.max(found.residual[:15]) < 1e-10
    assert np.all(np.isnan(found.speeds[15]))
    assert np.ptp(np.asarray(found.forces[:15]), axis=0).min() > 1e-3
    assert len(angles) == 22


@pytest.mark.slow
def test_rotors_with_curves_give_the_wrench_of_rotors_without(uav, start):
    """Thrusts of linear and quadratic parts, and speeds by the roots of the curve in closed form."""
    plain, (c, offset) = uav.rotors, (4e-3, -0.4)
    rotors = stm.uav.Rotors(
        plain.body, arms=plain.arms, spin=plain.spin, k_f=5e-6, k_tau=5e-6 * plain.k_tau / plain.k_f,
        thrust_linear=c, thrust_offset=offset, torque_linear=c * plain.k_tau / plain.k_f,
        torque_offset=offset * plain.k_tau / plain.k_f, speed_squared=np.full(6, 1e6),
    )  # fmt: skip
    forces = [rotors if force is plain else force for force in uav.system.forces]
    space = uav.space.with_system(replace(uav.system, forces=tuple(forces)))
    curved = Uav(space, uav.geometry, uav.displacement, uav.limits)
    found = trim_flight(curved, hover(START))
    assert found.residual < 1e-10
    thrusts = rotors.thrusts(found.speed_squared)
    # torques are in proportion to thrusts, so that moments are linear in them
    B = wrench_map(plain, curved.system.com(curved.space.to_state(found.point))) / plain.k_f
    weight = 9.81 * float(jnp.sum(curved.system.bodies.mass))
    np.testing.assert_allclose(jnp.sum(thrusts), weight, rtol=1e-12)
    np.testing.assert_allclose(B @ thrusts, [weight, 0, 0, 0], atol=1e-10 * weight)
    np.testing.assert_allclose(found.forces, start.forces, rtol=1e-9)
    roots = (np.sqrt(c**2 + 4 * 5e-6 * (np.asarray(thrusts) - offset)) - c) / (2 * 5e-6)
    np.testing.assert_allclose(found.speeds, roots, rtol=1e-12)
    # thrusts of rotors of minimum norm differ from these by the curvature between the speeds alone
    np.testing.assert_allclose(thrusts, plain.k_f * start.speed_squared, rtol=1e-4)


def test_nothing_accelerates_in_maximal_coordinates(uav, start):
    state = uav.space.to_state(start.point)
    found = jax.jit(lambda s, i: stm.dynamics.evaluate(uav.inputs.applied(uav.system, i), s))(
        state, start.values
    )
    assert np.max(np.abs(found.accelerations.v_rate)) < 1e-10
    assert np.max(np.abs(found.accelerations.omega_rate)) < 1e-8


@pytest.mark.slow
def test_refused(uav):
    slow = TrimLimits(RotorLimits(0.0, 1350.0))
    with pytest.raises(stm.ModelError, match=r"72\.25 N are required, but within .* 71\.58 N"):
        trim_flight(uav, hover(START), slow)
    weak = TrimLimits(actuator=0.1)
    with pytest.raises(stm.StateError, match=r"N, but the limit is 0\.1 N"):
        trim_flight(uav, hover(START), weak)
    with pytest.raises(stm.StateError, match="cannot take the panel angles"):
        trim_flight(uav, hover([0.2, -1.5]))
    with pytest.raises(stm.ModelError, match="either the panel's angles or the direction"):
        hover(START, sun=[0, 0, 1.0])
    with pytest.raises(
        stm.ModelError, match=r"sun must be numbers of shape \(3,\), but its shape is \(2,\)"
    ):
        hover(sun=[0, 1.0])
    bare = eqx.tree_at(lambda s: s.forces, uav.system, uav.system.forces[:2])
    with pytest.raises(stm.ModelError, match="one LinearActuator for each slider"):
        Uav(uav.space.with_system(bare), uav.geometry, uav.displacement)


@pytest.mark.slow
def test_outside_the_workspace(uav, many):
    """Each limit has its reason; the values stay, and are those of a trim without the limit."""
    angles, found = many[0][16:], jax.tree.map(lambda x: x[16:], many[1])
    assert np.all(np.isfinite(found.speeds[:5]))
    assert np.all(np.isnan(found.speeds[5]))
    wide = TrimLimits(workspace=stm.uav.Limits(home=(0.0, 0.0), tilt=np.pi))
    for at, speeds in zip(angles[:5], np.asarray(found.speeds), strict=False):
        free = trim_flight(uav, hover(at), wide)
        np.testing.assert_allclose(free.speeds, speeds, rtol=1e-9)
    # the workspace's own map
    seen = stm.uav.survey(uav.geometry, angles[:5].T, uav.limits).reason
    assert [Reason(int(k)).name for k in np.asarray(seen)] == [k.name for k in list(OUTSIDE)[:5]]


def test_words_for_what_is_outside(uav):
    """As `aim` says it: the limit, and by how much it is passed."""
    with pytest.raises(stm.StateError, match=r"theta = 62 degrees .* the tilt limit of 60"):
        trim_flight(uav, hover(np.radians([20.0, 62.0])))
    with pytest.raises(
        stm.StateError, match=r"slider 3 would have to stand at 102\.5 mm .* 100 mm"
    ):
        trim_flight(uav, hover(np.radians([59.9, 0.0])))
    with pytest.raises(stm.StateError, match=r"too near the singularity .* at least 0\.05"):
        trim_flight(uav, hover(np.radians([-55.0, 0.0])))


def test_other_things_in_place_of_a_flight(uav):
    bare = inspect.unwrap(trim_flight)
    with pytest.raises(stm.ModelError, match=r"a steady flight, such as hover.* not 'hover'"):
        bare(uav, "hover")
    with pytest.raises(stm.ModelError, match="positive number of newtons, not nan"):
        trim_flight(uav, hover(START), TrimLimits(actuator=np.nan))
    with pytest.raises(stm.ModelError, match=r"climb must be a number \[m/s\], but it is 'a'"):
        climb("a", START)
    with pytest.raises(stm.ModelError, match="rate of turn must be finite, but it is nan"):
        steady_turn(1.0, np.nan, START)


@pytest.mark.slow
def test_within_rotor_limits(uav, start):
    """Speeds of least norm beyond a limit are refused with both; the values stay."""
    slowest, fastest = float(jnp.min(start.speeds)), float(jnp.max(start.speeds))
    wide = RotorLimits(slowest - 1.0, fastest + 1.0)
    inside = trim_flight(uav, hover(START), TrimLimits(wide))
    np.testing.assert_allclose(inside.speeds, start.speeds, rtol=1e-12)
    assert inside.null_space_dimension == 2
    for limits in (RotorLimits(0.0, fastest - 1.0), RotorLimits(slowest + 1.0, 2000.0)):
        with pytest.raises(
            stm.StateError, match=rf"turn with {slowest:.4g} to {fastest:.4g} rad/s, but"
        ):
            trim_flight(uav, hover(START), TrimLimits(limits))
        refused = trim_flight(uav, hover(START), TrimLimits(limits), throw=False)
        assert refused.reason == TrimReason.ROTOR_LIMIT
        np.testing.assert_allclose(refused.speeds, start.speeds, rtol=1e-12)


@pytest.fixture(scope="module")
def linear(uav, start):
    return linearize(uav.space, start.point, uav.inputs, start.values)


@quick_jit
def end_of(system, state, ts):
    """Base at the end of a flight."""
    run = stm.integrate(system, state, ts, stm.Method(rtol=1e-11, atol=1e-13))
    return jax.tree.map(lambda x: x[-1, 0], run.states)


@pytest.mark.slow
def test_linear_against_the_simulated_flight(uav, start, linear):
    """A small displacement's path over 0.1 s, in maximal coordinates, against expm(A t) x."""
    x = np.zeros(16)
    x[3:8], x[14:] = [1e-6, -2e-6, 1e-6, 2e-6, -1e-6], [1e-5, 2e-5]
    system = uav.inputs.applied(uav.system, start.values)
    ends = [
        end_of(
            system,
            uav.space.to_state(uav.space.retract(start.point, jnp.asarray(sign * x))),
            jnp.array([0.0, 0.1]),
        )
        for sign in (1, -1)
    ]
    later = expm(linear.A * 0.1) @ x
    moved, spun = (np.asarray(a - b) / 2 for a, b in
                   ((ends[0].r, ends[1].r), (ends[0].omega, ends[1].omega)))  # fmt: skip
    np.testing.assert_allclose(moved, later[:3], rtol=1e-6, atol=1e-6 * np.max(np.abs(later[:3])))
    np.testing.assert_allclose(spun, later[11:14], rtol=1e-5, atol=1e-5 * np.max(np.abs(spun)))


def test_coordinates_are_those_that_the_loops_determine(uav):
    """The selection that is made without numbers is the one at the reference posture."""
    assert stm.TreeSpace(uav.system).selection == uav.space.selection


@pytest.mark.slow
def test_slopes_of_a_trim_keep_the_balance():
    """The thrust carries the weight at any mass and coefficient: k sum(w^2) = m g."""
    values = {name: jnp.asarray(stm.PART_II.value(name)) for name in ("mass.panel_7", "rotor.k_f")}
    found, slopes = trim_slopes(
        lambda values: make_uav(stm.PART_II.replaced(values)), values, hover(START)
    )
    places = [k for k, (name, _) in enumerate(found.names) if name.startswith("speed")]
    by_mass, by_k = (np.asarray(slopes[name])[places] for name in values)
    speeds, k = np.asarray(found.speeds), float(values["rotor.k_f"])
    assert len(places) == 6
    assert 2 * k * speeds @ by_mass == pytest.approx(9.81, rel=1e-9)
    assert 2 * k * speeds @ by_k == pytest.approx(-speeds @ speeds, rel=1e-9)


def test_modes_and_measures(linear):
    """Two falling panel modes in pairs, twelve of a rigid body; all inputs together move them."""
    modes = linear.modes()
    real = np.array([m.eigenvalue.real for m in modes])
    assert real[0] == pytest.approx(-real[-1], rel=1e-6)
    assert real[1] == pytest.approx(-real[-2], rel=1e-6)
    assert 5 < real[1] < real[0] < 15
    assert np.max(np.abs(real[2:-2])) < 1e-4
    assert {name for name, _ in modes[0].states[:2]} == {"U47.angle_2", "U47.angle_2_rate"}
    assert modes[0].doubling_time == pytest.approx(np.log(2) / real[0])
    assert np.min(linear.controllability()) > 1e-3
    deaf = replace(linear, B=np.zeros_like(linear.B))
    assert np.max(deaf.controllability()) < 1e-6
    assert len(linear.states) == 16


def test_outputs_by_name(uav, start):
    few = linearize(
        uav.space, start.point, uav.inputs, start.values, outputs=["U47.angle_1", "r_z"]
    )
    assert few.C.shape == (2, 16)
    assert [name for name, _ in few.outputs] == ["U47.angle_1", "r_z"]
    assert np.min(few.observability()) < 1e-6
    with pytest.raises(stm.SettingError, match="Did you mean 'omega_x'"):
        linearize(uav.space, start.point, uav.inputs, start.values, outputs=["omega_xx"])
    for none in ([], "omega_x", ["omega_x", 3]):
        with pytest.raises(stm.SettingError, match=r"a list of names of states, such as .*, not "):
            linearize(uav.space, start.point, uav.inputs, start.values, outputs=none)


def test_acceleration_upwards(uav):
    """Thrust is m (g + a)."""
    up = climb(2.0, START, 0.3)._replace(acceleration=jnp.array([0.0, 0.0, 1.5]))
    found = trim_flight(uav, up)
    k_f, mass = uav.rotors.k_f, float(np.sum(uav.system.bodies.mass))
    assert float(k_f * jnp.sum(found.speeds**2)) == pytest.approx(mass * 11.31, rel=1e-12)


@pytest.mark.slow
def test_panel_at_the_sun(uav):
    """In level hover the panel's angles are those of the inverse kinematics in the yawed base."""
    s_w = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    found = trim_flight(uav, hover(sun=s_w, yaw=0.4))
    c, s = np.cos(0.4), np.sin(0.4)
    s_b = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) @ s_w
    np.testing.assert_allclose(stm.uav.panel_normal(found.angles), s_b, atol=1e-12)
    with pytest.raises(stm.StateError, match=r"theta = 87\.\d+ degrees .* the tilt limit of 60"):
        trim_flight(uav, hover(sun=[1.0, 0.0, 0.05]))


@pytest.mark.slow
def test_steady_turn_stays_steady(uav):
    """Flown for half a second, the base moves on its circle; its attitude turns with it."""
    speed, rate = 3.0, 0.8
    found = trim_flight(uav, steady_turn(speed, rate, START))
    bank = np.arctan(speed * rate / 9.81)
    up = np.asarray(stm.rotation.rotation_matrix(found.point.p))[:, 2]
    assert np.arccos(up[2]) == pytest.approx(bank, rel=0.02)
    system, state = uav.inputs.applied(uav.system, found.values), uav.space.to_state(found.point)
    end = end_of(system, state, jnp.array([0.0, 0.5]))
    angle, radius = rate * 0.5, speed / rate
    # the centre of the circle lies to the left
    expected = radius * np.array([np.sin(angle), 1 - np.cos(angle), 0])
    np.testing.assert_allclose(end.r, expected, atol=1e-7)
    np.testing.assert_allclose(end.omega, found.point.omega, atol=1e-6)


def test_cruise_without_drag_is_hover(uav, start):
    found = trim_flight(uav, cruise(4.0, 0.7, START))
    np.testing.assert_allclose(found.speeds, start.speeds, rtol=1e-10)
    assert 0 < float(found.conditioning) < 1
