"""Controller of a flying machine with joints, against the accelerations that its inputs give."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import evaluated

import stmuav_jax as stm
from stmuav_jax.control import at_point
from stmuav_jax.uav.joint_controller import joint_errors, read_joints

uav = stm.uav
SPEED = 60.0


def machine(*, closed=False, servo=False):
    """Quadrotor with an arm of two links; closed by a rod to a four-bar, of which one joint is driven."""
    bodies = [
        stm.Body("frame", 2.0, [0.02, 0.025, 0.04], com=[0.01, 0.0, 0.0], free=True),
        stm.Body("upper", 0.4, [2e-3, 2e-3, 5e-4], position=[0.0, 0.0, -0.1], com=[0.0, 0.0, -0.1]),
        stm.Body(
            "lower", 0.3, [1e-3, 1e-3, 4e-4], position=[0.0, 0.0, -0.3], com=[0.02, 0.0, -0.05]
        ),
    ]
    hinge = lambda name, i, j, x, z: stm.revolute(
        name, i, j, point=[x, 0.0, z], axis=[0.0, 1.0, 0.0]
    )
    joints = [
        hinge("shoulder", "frame", "upper", 0.0, -0.1),
        hinge("elbow", "upper", "lower", 0.0, -0.3),
    ]
    if closed:
        bodies.append(stm.Body("rod", 0.2, [1e-3, 1e-3, 1e-4], position=[0.2, 0.0, -0.2]))
        joints += [
            hinge("rod_top", "frame", "rod", 0.2, -0.1),
            hinge("rod_end", "rod", "lower", 0.2, -0.3),
        ]
    arms, spin = uav.rotor_layout(4, 0.3)
    rotors = uav.Rotors(
        "frame", arms=arms, spin=spin, k_f=1e-5, k_tau=2e-7, speed_squared=4 * [7e5]
    )
    elbow = stm.mechanics.JointServo("elbow", stiffness=3.0, damping=0.1, target=0.2)
    drives = [stm.JointEffort("shoulder", 0.0, limit=30.0)]
    drives += [] if closed else [elbow if servo else stm.JointEffort("elbow", 0.0)]
    return stm.System(bodies, joints, [stm.Gravity(), rotors, *drives])


def moving(system):
    """State in which base and joints turn."""
    arm = {"shoulder": 0.3} if len(system.joints) > 2 else {"shoulder": 0.3, "elbow": -0.5}
    rates = {name: 0.7 - 2 * k for k, name in enumerate(arm)}
    base = np.asarray(stm.rotation.from_rotation_vector(jnp.array([0.1, -0.2, 0.3])))
    start = eqx.tree_at(lambda s: (s.p, s.omega, s.v), system.reference, (
        system.reference.p.at[0].set(base), system.reference.omega.at[0].set([0.2, -0.1, 0.3]),
        system.reference.v.at[0].set([0.3, 0.1, -0.2]),
    ))  # fmt: skip
    return stm.state_from_joints(system, arm, rates, start=start)


def level(state):
    """The same posture at rest with the base level at the origin."""
    R = stm.rotation.rotation_matrix(state.p[0])
    turn = stm.rotation.conjugate(state.p[0])[:, None]
    p = stm.rotation.product(turn, state.p.T).T
    return stm.State((state.r - state.r[0]) @ R, p, 0 * state.v, 0 * state.omega)


def controller(system, **gains):
    flight = uav.FlightController(system, 400.0)
    selected = {
        one.name: uav.JointGains(**gains) for one in uav.driven_joints(system) if one.is_effort
    }
    return uav.JointController(system, flight, selected)


def reference(value, rate, acceleration):
    motions = uav.JointMotions(*(jnp.asarray(x, dtype=float) for x in (value, rate, acceleration)))
    return uav.JointReference(at_point([0.1, 0.0, 0.05]), motions)


@eqx.filter_jit
def command(pilot, state, target):
    return pilot(state, target, pilot.start())[0]


def commanded(system, inputs):
    """Machine whose forces have the inputs of a controller."""
    names = ["speed_squared", *(one.input for one in uav.driven_joints(system))]
    return stm.inputs_of(system, names).applied(system, inputs)


def joint_accelerations(system, state):
    """Accelerations of the driven joints and of all bodies, by the formulation in body coordinates."""
    formulation = stm.dynamics.Augmented(redundant=True)
    found = evaluated(system, state, formulation=formulation).accelerations
    joints = uav.driven_joints(system)
    rate = lambda s: read_joints(system, joints, s)[1]
    p_rate = stm.rotation.euler_parameter_rate(state.p.T, state.omega.T).T
    later = stm.State(state.v, p_rate, jnp.asarray(found.v_rate), jnp.asarray(found.omega_rate))
    return np.asarray(jax.jvp(rate, (state,), (later,))[1]), found


@pytest.mark.slow
@pytest.mark.parametrize("closed", [False, True])
def test_computed_torque_gives_the_accelerations_that_it_asks_for(closed):
    """While the base flies anyhow, joint errors obey e'' + 2 d W e' + W^2 e = 0, also where a loop is closed."""
    system = machine(closed=closed)
    state = moving(system)
    values, rates = (np.asarray(x) for x in read_joints(system, uav.driven_joints(system), state))
    target = reference(values + 0.02, rates - 0.1, 0.0 * values + 0.4)
    inputs = command(controller(system, frequency=SPEED, damping_ratio=0.8), state, target)
    found, _ = joint_accelerations(commanded(system, inputs), state)
    np.testing.assert_allclose(
        found, 0.4 - 2 * 0.8 * SPEED * 0.1 + SPEED**2 * 0.02 + 0 * values, rtol=1e-9
    )


@pytest.mark.slow
def test_the_moment_of_a_move_is_fed_forward():
    """At rest on its reference the base does not turn while the arm is accelerated; without feedforward it does."""
    system = machine()
    state = level(stm.state_from_joints(system, {"shoulder": 0.3, "elbow": -0.5}))
    values, rates = read_joints(system, uav.driven_joints(system), state)
    target = reference(values, rates, [3.0, -2.0])._replace(waypoint=at_point(state.r[0]))
    turning = {}
    for feedforward in (True, False):
        flight = uav.FlightController(system, 400.0, mass=uav.mass_properties(system, state))
        inputs = command(
            uav.JointController(system, flight, feedforward=feedforward), state, target
        )
        found, all_rates = joint_accelerations(commanded(system, inputs), state)
        np.testing.assert_allclose(found, [3.0, -2.0], rtol=1e-9)
        turning[feedforward] = np.linalg.norm(all_rates.omega_rate[0])
    assert turning[False] > 0.5
    assert turning[True] < 1e-9


@pytest.mark.slow
def test_a_servo_of_the_machine_gets_its_target_and_pd_control_its_errors():
    system = machine(servo=True)
    state = moving(system)
    pilot = controller(system, stiffness=20.0, damping=0.5)
    values, rates = read_joints(system, uav.driven_joints(system), state)
    target = reference(values + jnp.array([0.1, 0.4]), rates + jnp.array([-0.2, 0.0]), [0.0, 0.0])
    inputs = command(pilot, state, target)
    assert inputs[4] == pytest.approx(20.0 * 0.1 - 0.5 * 0.2)
    assert inputs[5] == pytest.approx(float(values[1]) + 0.4)
    assert [one.input for one in pilot.joints] == ["effort", "target"]


def test_angles_are_compared_the_nearer_way_round():
    system = machine()
    joints = uav.driven_joints(system)
    errors = joint_errors(joints, jnp.array([3.1, -3.0]), jnp.array([-3.1, 0.1]))
    np.testing.assert_allclose(errors, [6.2 - 2 * np.pi, -3.1])


def test_what_cannot_be_controlled_is_refused():
    system = machine(servo=True)
    flight = uav.FlightController(system, 400.0)
    with pytest.raises(
        stm.SettingError, match=r"no joint 'shouldr' with an effort.*Did you mean 'shoulder'"
    ):
        uav.JointController(system, flight, {"shouldr": uav.JointGains()})
    with pytest.raises(stm.SettingError, match="no joint 'elbow' with an effort"):
        uav.JointController(system, flight, {"elbow": uav.JointGains()})
    twice = system.with_forces(stm.JointEffort("elbow", 0.0))
    with pytest.raises(
        stm.ModelError, match="angle of joint 'elbow' has several efforts or servos"
    ):
        uav.driven_joints(twice)
