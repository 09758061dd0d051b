"""Rotors and actuators against the report's formulas and hand-made sums."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax import PART_II, Body, ModelError, SettingError, State, System
from stmuav_jax.uav import LinearActuator, Rotors

T = jnp.asarray(0.0)


def hexacopter_rotors(u):
    return Rotors(
        "hull",
        arms=PART_II.value("rotor.arms"),
        spin=PART_II.value("rotor.spin"),
        k_f=PART_II.value("rotor.k_f"),
        k_tau=PART_II.value("rotor.k_tau"),
        speed_squared=u,
    )


def test_wrench_is_the_reports_sum_rotor_by_rotor():
    """Eq. 4.24, corrected: f = sum k_f u z, tau = sum (k_f a x z - k_tau s z) u."""
    u = jnp.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 3e5
    wrench = hexacopter_rotors(u).wrench(u, jnp.zeros(3))
    z = np.array([0.0, 0.0, 1.0])
    k_f, k_tau = PART_II.value("rotor.k_f"), PART_II.value("rotor.k_tau")
    force, moment = np.zeros(3), np.zeros(3)
    for a, s, each in zip(
        PART_II.value("rotor.arms"), PART_II.value("rotor.spin"), np.asarray(u), strict=True
    ):
        force += k_f * each * z
        moment += k_f * each * np.cross(a, z) - k_tau * s * each * z
    assert np.asarray(wrench[:3]) == pytest.approx(force, rel=1e-14)
    assert np.asarray(wrench[3:]) == pytest.approx(moment, rel=1e-12)


def test_wrench_map_has_the_signs_of_the_idealised_mixing():
    """The corrected Eq. 4.9 has rotor 1 at -30 degrees; Table 5.2 turns that by 15 degrees."""
    arms = np.asarray(PART_II.value("rotor.arms"))
    radius = arms[:, :2] - arms[:, :2].mean(axis=0)
    angles = np.degrees(np.arctan2(radius[:, 1], radius[:, 0]))
    steps = (angles - angles[0] + 180) % 360 - 180
    assert np.hypot(*radius.T) == pytest.approx(np.full(6, 0.350), abs=1e-5)
    assert angles[0] == pytest.approx(-15, abs=0.01)
    assert steps == pytest.approx([0, -60, -120, 180, 120, 60], abs=0.01) or steps[3] == (
        pytest.approx(-180, abs=0.01)
    )


def test_rotors_need_one_arm_per_spin():
    with pytest.raises(ModelError, match="one arm"):
        Rotors(
            "hull", arms=[[1.0, 0, 0]], spin=[1.0, -1.0], k_f=1, k_tau=1, speed_squared=[1.0, 1.0]
        )


@pytest.mark.parametrize("name", ["k_f", "k_tau"])
@pytest.mark.parametrize(("value", "words"), [(-6e-6, "not be negative"), (np.nan, "be finite")])
def test_coefficients_below_zero_are_refused(name, value, words):
    """Not as a rotor that would have to push downwards, where a trim is sought."""
    given = {"k_f": 1.0, "k_tau": 1.0} | {name: value}
    with pytest.raises(
        ModelError, match=f"coefficient {name} of the rotors of body 'hull'.*{words}"
    ):
        Rotors("hull", arms=[[1.0, 0, 0]], spin=[1.0], speed_squared=[1.0], **given)


def two_bodies():
    hull = Body("hull", 2.0, [0.1, 0.1, 0.1], free=True)
    slider = Body("slider", 0.2, [1e-4, 1e-4, 1e-4], position=(0.1, 0.02, 0.05), free=True)
    system = System([hull, slider])
    rng = np.random.default_rng(3)
    p = rng.normal(size=4)
    p = jnp.asarray(p / np.linalg.norm(p))
    state = State(
        jnp.asarray(rng.normal(size=(2, 3))),
        jnp.stack([p, p]),
        jnp.asarray(rng.normal(size=(2, 3))),
        jnp.asarray(rng.normal(size=(2, 3))),
    )
    return system.kinematics(state)


@pytest.mark.parametrize("couple", ["consistent", "printed"])
def test_actuator_pair_leaves_momentum_alone_only_if_consistent(couple):
    kin = two_bodies()
    load = LinearActuator(
        "hull", "slider", axis_point=(0.11, 0.0, 0.06), force=3.0, couple=couple
    ).load(T, kin)
    moment = jnp.cross(kin.r, load.force) + jnp.einsum("nab,nb->na", kin.R_wb, load.moment)
    assert np.abs(load.force.sum(axis=0)).max() < 1e-15
    net = np.abs(moment.sum(axis=0)).max()
    assert net < 1e-14 if couple == "consistent" else net > 1e-3


def test_actuator_power_is_force_times_sliding_rate():
    kin = two_bodies()
    load = LinearActuator("hull", "slider", axis_point=(0.11, 0.0, 0.06), force=3.0).load(T, kin)
    by_hand = jnp.sum(load.force * kin.v) + jnp.sum(load.moment * kin.omega)
    assert float(load.power) == pytest.approx(float(by_hand), rel=1e-13)


LIMITS = stm.uav.RotorLimits(150.0, 1400.0)


def curved(**curves):
    """Hexacopter of 4 kg whose rotors have curves of their own."""
    arms, spin = stm.uav.rotor_layout(6, 0.35, height=0.03)
    coefficients = {"k_f": 8e-6, "k_tau": 1.4e-7} | curves
    rotors = Rotors("hull", arms=arms, spin=spin, **coefficients, speed_squared=np.full(6, 5e5))
    motors = stm.uav.MotorRotors(rotors, limits=LIMITS)
    body = Body("hull", 4.0, [0.06, 0.06, 0.1], com=[0.01, -0.005, 0.0], free=True)
    return System([body], [], [stm.Gravity(), motors]), rotors


@pytest.mark.slow
@pytest.mark.parametrize(
    "curves",
    [
        {"thrust_linear": 2e-3, "thrust_offset": -0.3, "torque_linear": 1e-5},
        {"thrust_linear": 7e-3, "k_f": 0.0},
        {"thrust_offset": 0.2, "torque_offset": 0.01, "torque_linear": -1e-5},
    ],
)
def test_speeds_of_curves_give_the_thrust_and_the_wrench(curves):
    """The inverse curve, its derivative, and speeds of a controller for thrust, tilt and yaw."""
    system, rotors = curved(**curves)
    thrusts = jnp.array([0.5, 3.0, 6.54, 9.0])
    squared = rotors.squared_speeds(thrusts)
    np.testing.assert_allclose(rotors.thrusts(squared), thrusts, rtol=1e-13)
    slopes = jax.vmap(jax.grad(rotors.thrusts))(squared)
    inverse_slopes = jax.vmap(jax.grad(rotors.squared_speeds))(thrusts)
    np.testing.assert_allclose(inverse_slopes, 1 / slopes, rtol=1e-11)
    pilot = stm.uav.FlightController(system, 400.0)
    base = stm.uav.BaseMotion(
        jnp.zeros(3), jnp.eye(3), jnp.array([0.1, -0.1, 0.3]), jnp.array([0.2, -0.15, 0.1])
    )
    target = stm.control.at_point([0.0, 0.0, 0.0])
    mass = stm.uav.mass_properties(system, system.reference)
    demand = stm.uav.wrench_for(base, target, mass, pilot.gains, pilot.gravity, jnp.zeros(3))
    u, _ = pilot(base, target, pilot.start())
    lever = np.cross(mass.centre, [0.0, 0.0, float(demand.wrench[0])])
    expected = np.asarray(demand.wrench) + np.array([0.0, *lever])
    wrench = np.asarray(rotors.wrench(u, system.bodies.com[0]))
    np.testing.assert_allclose(wrench[2:], expected, rtol=1e-5, atol=1e-7)
    assert np.ptp(np.sqrt(u)) > 50.0


def test_a_standing_rotor_with_offset_gives_nothing():
    _, rotors = curved(thrust_offset=0.3, torque_offset=0.01)
    assert not np.any(rotors.wrench(jnp.zeros(6), jnp.zeros(3)))


def test_the_hover_of_curves_has_the_derivative_of_its_closed_form():
    """w = (s - c) / (2 k), s^2 = c^2 + 4 k (m g / 6 - T_0); its derivative by the linear part is -w / s."""
    weight = 4.0 * 9.81 / 6
    speed = lambda c: (np.sqrt(c**2 + 3.2e-5 * (weight + 0.3)) - c) / 1.6e-5

    def hover(c):
        _, rotors = curved(thrust_linear=c, thrust_offset=-0.3)
        return jnp.sqrt(rotors.hover(4.0, [0.0, 0.0, -9.81])[0])

    value, slope = jax.value_and_grad(hover)(2e-3)
    assert float(value) == pytest.approx(speed(2e-3), rel=1e-14)
    root = np.sqrt(4e-6 + 3.2e-5 * (weight + 0.3))
    assert float(slope) == pytest.approx(-speed(2e-3) / root, rel=1e-12)


def test_unknown_couple_is_refused():
    with pytest.raises(SettingError, match="'consistent' or 'printed'"):
        LinearActuator("a", "b", axis_point=(0, 0, 0), force=1.0, couple="other")


@pytest.mark.parametrize(
    ("number", "coaxial"), [(4, None), (6, None), (8, None), (3, 0.08), (4, 0.1)]
)
@pytest.mark.parametrize("layout", ["x", "plus"])
def test_equal_speeds_of_a_layout_neither_tilt_nor_turn(number, coaxial, layout):
    """All rotors stand on a circle, forward lies on an arm or midway between two, and every moment balances."""
    arms, spin = stm.uav.rotor_layout(number, 0.3, layout=layout, coaxial=coaxial, height=0.05)
    rotors = stm.uav.Rotors(
        "frame", arms=arms, spin=spin, k_f=1e-5, k_tau=2e-7, speed_squared=np.ones(len(spin))
    )
    B = np.asarray(stm.uav.wrench_map(rotors, np.zeros(3)))
    np.testing.assert_allclose(B.sum(axis=1), [len(spin) * 1e-5, 0, 0, 0], atol=1e-18)
    np.testing.assert_allclose(np.linalg.norm(arms[:, :2], axis=1), 0.3)
    nearest = np.min(np.abs(np.arctan2(arms[:, 1], arms[:, 0])))
    assert nearest == pytest.approx(np.pi / number if layout == "x" else 0.0)
    if coaxial is not None:
        np.testing.assert_allclose(arms[::2, 2] - arms[1::2, 2], coaxial)
        np.testing.assert_array_equal(spin[::2], -spin[1::2])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"number": 5}, "even, and at least 4"),
        ({"number": 2, "coaxial": 0.1}, "at least 3 of coaxial rotors"),
        ({"number": 4, "layout": "h"}, "must be 'x' or 'plus', not 'h'"),
        ({"number": 4, "coaxial": -0.1}, "The distance between coaxial rotors"),
    ],
)
def test_layouts_that_do_not_balance_are_refused(settings, words):
    with pytest.raises(stm.ModelError, match=words):
        stm.uav.rotor_layout(**({"radius": 0.3} | settings))
