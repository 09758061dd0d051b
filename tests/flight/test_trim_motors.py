"""Trim and linearisation with motors: their limits, their lag, the rotors' momentum."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.flight.flight_trim import TrimLimits, TrimReason, hover, steady_turn, trim_flight
from stmuav_jax.flight.flyer import STATES
from stmuav_jax.flight.linear import linearize
from stmuav_jax.rotorcraft.allocation import RotorLimits
from stmuav_jax.scenes.flight_options import Motor
from stmuav_jax.scenes.uav_tracker import uav_flyer

pytestmark = pytest.mark.slow

START = stm.tracker.initial_angles(stm.PART_II)
LAG = 0.04
INERTIA = 0.02  # far too much, to be seen: momenta of rotors that turn both ways nearly cancel
MOTOR = Motor(time_constant=LAG, inertia=INERTIA, lowest=200.0, highest=2000.0)


@pytest.fixture(scope="module")
def flyer():
    return uav_flyer(motor=MOTOR)


@pytest.fixture(scope="module")
def both(flyer):
    """The same turn with the rotors' momentum and, by another scene, without."""
    turn = steady_turn(3.0, 0.8, START)
    return trim_flight(flyer, turn, NONE), trim_flight(uav_flyer(), turn)


NONE = TrimLimits(RotorLimits(0.0, 1e4))


def test_momentum_in_a_turn(flyer, both):
    """The moments differ by that which turns the rotors' momentum."""
    with_motors, without = both
    rotors = flyer.propellers
    W = np.asarray(with_motors.coordinates.omega)
    h = INERTIA * float(jnp.sum(rotors.spin * with_motors.speeds))
    assert abs(h) > 1e-2
    com = jnp.zeros(3)
    moment = lambda found: np.asarray(rotors.wrench(found.inputs.speed_squared, com))[3:]
    extra = np.cross(W, [0.0, 0.0, h])
    np.testing.assert_allclose(
        moment(with_motors) - moment(without), extra, atol=2e-2 * np.max(np.abs(extra))
    )
    assert float(with_motors.residual) < 1e-10


def test_it_stays_steady(flyer, both):
    """Flown with lag and momentum, the turn goes on: base rates and rotor speeds stay."""
    found = both[0]
    system, state = flyer.with_inputs(found.inputs), flyer.to_state(found.coordinates)
    run = jax.jit(lambda s: stm.integrate(system, s, jnp.array([0.0, 0.3]), stm.Method(rtol=1e-10)))
    end = run(state)
    np.testing.assert_allclose(end.states.omega[-1, 0], found.coordinates.omega, atol=1e-6)
    np.testing.assert_allclose(end.internal[-1], found.speeds, rtol=1e-9)


def test_limits_of_the_motors_are_kept():
    """Without others given, those of the machine."""
    slow = uav_flyer(motor=Motor(lowest=1000.0, highest=1360.0))
    found = trim_flight(slow, hover(START))
    assert float(jnp.max(found.speeds)) <= 1360.0 * (1 + 1e-12)
    assert float(found.residual) < 1e-10
    none = trim_flight(slow, hover(START), TrimLimits(RotorLimits(1400.0, 1500.0)), throw=False)
    assert none.reason == TrimReason.ROTOR_LIMIT


@pytest.fixture(scope="module")
def pair():
    """Linearised at hover, with motors of no inertia, whose lag is all that they add, and without."""
    lagging = uav_flyer(motor=replace(MOTOR, inertia=0.0))
    found = trim_flight(lagging, hover(START))
    at, values = found.coordinates, jnp.concatenate(found.inputs)
    plain = linearize(uav_flyer(), at._replace(internal=None), values=values)
    return linearize(lagging, at, values=values), plain


def test_lag_has_states_of_its_own(pair):
    lagging, plain = pair
    assert len(lagging.states) == 22
    assert lagging.states[16:] == tuple((f"speed_{k}", "rad/s") for k in range(1, 7))
    assert lagging.states[:16] == STATES
    # eigenvalues -1/T, six of them, by the blocks: those that LAPACK finds of a sixfold one move
    # by far more than round-off with it
    np.testing.assert_allclose(lagging.A[16:, 16:], -np.eye(6) / LAG, atol=1e-12 / LAG)
    np.testing.assert_array_equal(lagging.A[16:, :16], 0)
    np.testing.assert_allclose(lagging.A[:16, :16], plain.A, atol=1e-9 * np.max(np.abs(plain.A)))


def test_slow_inputs_do_as_without_lag(pair):
    """Where speeds have followed their commands, the inputs act as if directly."""
    lagging, plain = pair
    A, B = lagging.A, lagging.B
    followed = -np.linalg.solve(A[16:, 16:], np.hstack([A[16:, :16], B[16:]]))
    np.testing.assert_allclose(followed[:, :16], 0, atol=1e-12)
    # speeding up takes a moment only while it lasts
    quasi = B[:16] + A[:16, 16:] @ followed[:, 16:]
    np.testing.assert_allclose(quasi, plain.B, atol=1e-7 * np.max(np.abs(plain.B)))
