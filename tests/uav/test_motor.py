"""Motors: lag, spin-up and gyroscopic torque in closed form, limits, momentum, cost."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation, relative_error, scene_of, state_of
from scipy.integrate import solve_ivp

import stmuav_jax as stm
from stmuav_jax.mechanics.internal import internal_states

MASS, INERTIA = 1.4, np.array([0.02, 0.03, 0.05])
ARMS = 0.3 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
K_F, K_TAU, TAU, J = 2e-6, 4e-8, 0.04, 6e-5
FULL = np.array([900.0, 1000.0, 1100.0, 1200.0])
START = np.array([200.0, 400.0, 0.0, 1500.0])


def rotors(commands, spin=(1.0, -1.0, 1.0, -1.0), k_f=K_F, k_tau=K_TAU):
    return stm.uav.Rotors(
        "hull", arms=ARMS, spin=spin, k_f=k_f, k_tau=k_tau, speed_squared=commands
    )


def system(force, inertia=INERTIA):
    return stm.System([stm.Body("hull", MASS, inertia, free=True)], forces=[force])


def tight(formulation=None):
    return stm.Method(formulation or stm.Tree(), rtol=1e-11, atol=1e-11)


TS = jnp.linspace(0.0, 0.3, 7)
FORMULATIONS = {"tree": stm.Tree(), "augmented": stm.Augmented()}


class Command(eqx.Module):
    """Squares of speeds that vary by a share of `FULL`."""

    share: jax.Array

    def __call__(self, t, kin):
        return (jnp.asarray(FULL) * (1 + self.share * jnp.sin(20 * t))) ** 2


def lagging(share=0.0, inertia=INERTIA, **air):
    """Body with four motors that lag, spins of which do not cancel, and commands that vary by a share."""
    spun = rotors(Command(jnp.asarray(share)), spin=(1.0, -1.0, 1.0, 1.0), **air)
    return system(stm.uav.MotorRotors(spun, time_constant=TAU, inertia=J, start=START), inertia)


@pytest.fixture(scope="module")
def run():
    """Motion of a body with motors from a state, for all of them one program of the tree."""
    return jax.jit(
        lambda made, s, ts, tol: stm.integrate(made, s, ts, stm.Method(rtol=tol, atol=tol))
    )


def spun_at(omega):
    return state_of([[0, 0, 0]], [[1, 0, 0, 0]], None, [omega])


@pytest.mark.slow
def test_step_response_and_thrust_in_closed_form(run):
    """omega = c + (s - c) exp(-t / T); the vertical speed is the integral of its thrust."""
    path = run(lagging(inertia=np.full(3, 1e9), k_tau=0.0), spun_at(np.zeros(3)), TS, 1e-11)
    t = np.asarray(TS)[:, None]
    fade = np.exp(-t / TAU)
    np.testing.assert_allclose(path.internal, FULL + (START - FULL) * fade, rtol=1e-9)
    # of (c + d e)^2, d = s - c
    d = START - FULL
    squares = FULL**2 * t + 2 * FULL * d * TAU * (1 - fade) + d**2 * TAU / 2 * (1 - fade**2)
    np.testing.assert_allclose(
        path.states.v[:, 0, 2], K_F * squares.sum(axis=1) / MASS, rtol=1e-8, atol=1e-10
    )


def test_speeds_steer_the_steps(run):
    """Of a heavy body only the speeds move: were they not in the error, steps would be as long."""
    made = lagging(inertia=np.full(3, 1e9), k_f=0.0, k_tau=0.0)
    path = run(made, spun_at(np.zeros(3)), jnp.linspace(0.0, 2.0, len(TS)), 1e-9)
    exact = FULL + (START - FULL) * np.exp(-2.0 / TAU)
    np.testing.assert_allclose(path.internal[-1], exact, rtol=1e-8)
    assert int(path.counts.accepted[-1]) > 20


def twin(t1, start, omega0, spin, command):
    """SciPy, from Euler's equation with the rotors' angular momentum: Omega and omega at t1."""

    def rate(t, y):
        W, w = y[:3], y[3:]
        w_rate = (command(t) - w) / TAU
        h = J * spin @ w * np.array([0, 0, 1.0])
        thrust = K_F * w**2
        moment = np.array([ARMS[:, 1] @ thrust, -ARMS[:, 0] @ thrust, -K_TAU * spin @ w**2])
        moment[2] -= J * spin @ w_rate
        W_rate = (moment - np.cross(W, INERTIA * W + h)) / INERTIA
        return np.concatenate([W_rate, w_rate])

    y0 = np.concatenate([omega0, start])
    found = solve_ivp(rate, (0, t1), y0, method="DOP853", rtol=1e-12, atol=1e-12)
    return found.y[:3, -1], found.y[3:, -1]


@pytest.mark.slow
def test_tumbling_body_against_scipy(run):
    """Commands that vary in time, unequal spins, all torques; in both formulations."""
    made, omega0 = lagging(0.2), np.array([0.5, -1.0, 2.0])
    command = lambda t: FULL * (1 + 0.2 * np.sin(20 * t))
    W, w = twin(float(TS[-1]), START, omega0, np.array([1.0, -1.0, 1.0, 1.0]), command)
    other = jax.jit(lambda made, s: stm.integrate(made, s, TS, tight(stm.Augmented())))
    for path in (run(made, spun_at(omega0), TS, 1e-11), other(made, spun_at(omega0))):
        np.testing.assert_allclose(path.states.omega[-1, 0], W, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(path.internal[-1], w, rtol=1e-9)


@pytest.mark.slow
def test_gyroscopic_precession_in_closed_form():
    """A symmetric body: W_x + i W_y = W_0 exp(i l t), l = ((C - A) W_z + h) / A."""
    A, C, spin = 0.02, 0.035, np.ones(4)
    motors = stm.uav.MotorRotors(rotors(FULL**2, spin=spin, k_f=0.0, k_tau=0.0), inertia=J)
    made = system(motors, inertia=np.array([A, A, C]))
    assert internal_states(made).shape == (0,)  # constant commands need no states
    omega0 = np.array([0.8, 0.3, 1.5])
    path = jax.jit(lambda s: stm.integrate(made, s, TS, tight()))(spun_at(omega0))
    rate = ((C - A) * omega0[2] + J * FULL.sum()) / A
    turning = (omega0[0] + 1j * omega0[1]) * np.exp(1j * rate * np.asarray(TS))
    omega = np.asarray(path.states.omega)[:, 0]
    np.testing.assert_allclose(omega[:, 0], turning.real, atol=1e-9)
    np.testing.assert_allclose(omega[:, 1], turning.imag, atol=1e-9)
    np.testing.assert_allclose(omega[:, 2], 1.5, atol=1e-12)


def test_angular_momentum_of_body_and_rotors_is_kept(run):
    """No air: rotors that spin up turn the body the other way, whatever its motion."""
    spin = np.array([1.0, -1.0, 1.0, 1.0])
    path = run(lagging(k_f=0.0, k_tau=0.0), spun_at([1.0, -0.5, 0.3]), TS, 1e-11)
    total = []
    for p, omega, w in zip(
        path.states.p[:, 0], path.states.omega[:, 0], path.internal, strict=True
    ):
        h = J * spin @ np.asarray(w) * np.array([0, 0, 1.0])
        total.append(np_rotation(np.asarray(p)) @ (INERTIA * np.asarray(omega) + h))
    assert np.max(np.abs(np.diff(total, axis=0))) < 1e-10 * np.linalg.norm(total[0])
    assert np.linalg.norm(path.states.omega[-1] - path.states.omega[0]) > 0.1


def test_limits_hold_the_speeds():
    """Commands beyond both limits; without lag at once, with lag in the long run."""
    limits = stm.uav.RotorLimits(950.0, [1000.0, 1100.0, 1050.0, 1150.0])
    expected = np.array([950.0, 1000.0, 1050.0, 1150.0])
    motors = stm.uav.MotorRotors(rotors(FULL**2), limits=limits)
    made = system(motors)
    kin = made.kinematics(made.reference)
    t = jnp.asarray(0.0)
    np.testing.assert_allclose(motors.speeds(t, kin), expected, rtol=1e-14)
    by_hand = system(rotors(expected**2)).forces[0].load(t, kin)
    found = made.forces[0].load(t, kin)
    np.testing.assert_allclose(found.force, by_hand.force, rtol=1e-13)
    np.testing.assert_allclose(found.moment, by_hand.moment, rtol=1e-12)
    lagging = stm.uav.MotorRotors(rotors(FULL**2), time_constant=TAU, limits=limits)
    np.testing.assert_allclose(lagging.internal, expected, rtol=1e-14)


@pytest.mark.slow
def test_derivatives_by_time_constant_and_inertia():
    """Of the body's turn by spin-up: against differences, forward and reverse."""

    def turn(tau, inertia, adjoint):
        motors = stm.uav.MotorRotors(
            rotors(FULL**2, spin=np.ones(4)), time_constant=tau, inertia=inertia, start=START
        )
        made = system(motors)
        how = stm.Method(rtol=1e-11, atol=1e-11, adjoint=adjoint)
        return stm.integrate(made, made.reference, jnp.array([0.0, 0.1]), how).states.omega[
            -1, 0, 2
        ]

    forward = jax.jit(jax.jacfwd(lambda a, b: turn(a, b, diffrax.ForwardMode()), argnums=(0, 1)))
    reverse = jax.jit(
        jax.grad(lambda a, b: turn(a, b, stm.dynamics.DiscreteAdjoint()), argnums=(0, 1))
    )
    value = jax.jit(jax.vmap(lambda a, b: turn(a, b, diffrax.ForwardMode())))
    one, two = forward(TAU, J), reverse(TAU, J)
    np.testing.assert_allclose(one, two, rtol=1e-9)
    shifts = np.array([-2.0, -1.0, 1.0, 2.0, 0, 0, 0, 0])
    steps = 1e-3 * TAU, 1e-3 * J
    found = np.asarray(value(TAU + steps[0] * shifts, J + steps[1] * np.roll(shifts, 4)))
    weights = np.array([1, -8, 8, -1]) / 12
    np.testing.assert_allclose(one[0], weights @ found[:4] / steps[0], rtol=1e-7)
    np.testing.assert_allclose(one[1], weights @ found[4:] / steps[1], rtol=1e-7)


@pytest.mark.slow
def test_a_run_with_joints_motors_and_certificate():
    """Balances, reactions and states between saved times, with both formulations."""
    base = stm.Body("hull", MASS, INERTIA, free=True)
    bob = stm.Body("bob", 0.3, [1e-3, 1e-3, 1e-3], position=(0.0, 0.0, -0.2), free=False)
    hinge = stm.revolute("hinge", "hull", "bob", point=(0, 0, -0.05), axis=(0, 1, 0))
    motors = stm.uav.MotorRotors(rotors(FULL**2), time_constant=TAU, inertia=J, start=START)
    made = stm.System([base, bob], [hinge], [stm.Gravity(), motors])
    runs = [
        stm.simulate(
            scene_of(made, t1=0.2, save_every=step),
            method=stm.Method(formulation=how, rtol=1e-10, atol=1e-10),
        )
        for how, step in zip(FORMULATIONS.values(), (0.05, 0.025), strict=True)
    ]
    for run in runs:
        assert run.certificate.relative_energy_error < 1e-8
        assert (
            max(
                run.certificate.momentum_error or 0.0, run.certificate.angular_momentum_error or 0.0
            )
            < 1e-8
        )
    one, two = (run.trajectory for run in runs)
    assert relative_error(one.states, jax.tree.map(lambda x: x[::2], two.states)) < 1e-8
    np.testing.assert_allclose(one.internal, two.internal[::2], rtol=1e-9)
    between = stm.dynamics.states_at(runs[0], [0.075])
    assert relative_error(between, jax.tree.map(lambda x: x[3:4], runs[1].states)) < 1e-8
    loads = stm.dynamics.joint_loads(
        made, jnp.asarray(one.ts), jax.tree.map(jnp.asarray, one.states), stm.Augmented(),
        jnp.asarray(one.internal),
    )  # fmt: skip
    assert relative_error(loads.force, stm.dynamics.run_loads(runs[0]).force) < 1e-9


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"time_constant": 0.0}, "time constant .* must be positive, but it is 0 s"),
        ({"time_constant": [0.1, 0.2]}, r"one for each of 4 rotors, but the shape is \(2,\)"),
        ({"inertia": -1e-5}, "inertia .* must be not negative"),
        ({"start": START}, "starting speeds .* need their time constant"),
        ({"limits": stm.uav.RotorLimits(5.0, 4.0)}, "lowest < highest"),
    ],
)
def test_senseless_parts_are_refused(parts, words):
    with pytest.raises(stm.ModelError, match=words):
        stm.uav.MotorRotors(rotors(FULL**2), **parts)


def test_commands_that_vary_need_a_start_and_a_lag():
    varying = rotors(lambda t, kin: t * jnp.ones(4))
    with pytest.raises(stm.ModelError, match=r"inertia .* needs their time constant"):
        stm.uav.MotorRotors(varying, inertia=J)
    with pytest.raises(stm.ModelError, match=r"starting speeds .* must be given"):
        stm.uav.MotorRotors(varying, time_constant=TAU)


def test_thrust_has_its_derivative_where_rotors_stand_still():
    """Without lag the thrust is k u: its derivative at u = 0 is k, not that of a root."""

    def thrust(u, **parts):
        force = stm.uav.MotorRotors(rotors(u), **parts)
        made = system(force)
        load = force.load(jnp.zeros(()), made.kinematics(made.reference))
        return load.force[0, 2]

    still = jnp.zeros(4)
    for parts in ({}, {"limits": stm.uav.RotorLimits(0.0, 900.0)}):
        for derivative in (jax.jacfwd, jax.jacrev):
            slope = jax.jit(derivative(lambda u, p=parts: thrust(u, **p)))
            np.testing.assert_allclose(slope(still), K_F)
    assert float(thrust(still)) == 0
    # the speeds themselves are roots: they have none
    speeds = lambda u: stm.uav.MotorRotors(rotors(u)).speeds_of(u)
    assert np.all(np.isnan(np.diagonal(jax.jacfwd(speeds)(still))))
    assert np.all(np.isnan(np.diagonal(jax.jacrev(speeds)(still))))
    # the value at a negative command without limits stays no number
    assert np.isnan(float(thrust(jnp.array([-1.0, 1.0, 1.0, 1.0]))))
