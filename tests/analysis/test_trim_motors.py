"""Trim and linearisation with motors: their limits, their lag, the rotors' momentum."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.analysis import hover, linearize, steady_turn
from stmuav_jax.uav import TrimLimits, trim_flight
from stmuav_jax.uav.allocation import RotorLimits
from stmuav_jax.uav.scenes.flight_options import Motor
from stmuav_jax.uav.scenes.uav_tracker import make_uav

pytestmark = pytest.mark.slow

START = stm.uav.initial_angles(stm.PART_II)
LAG = 0.04
INERTIA = 0.02  # far too much, to be seen: momenta of rotors that turn both ways nearly cancel
MOTOR = Motor(time_constant=LAG, inertia=INERTIA, lowest=200.0, highest=2000.0)


@pytest.fixture(scope="module")
def uav():
    return make_uav(motor=MOTOR)


@pytest.fixture(scope="module")
def both(uav):
    """The same turn with the rotors' momentum and, by another scene, without."""
    turn = steady_turn(3.0, 0.8, START)
    return trim_flight(uav, turn, NONE), trim_flight(make_uav(), turn)


NONE = TrimLimits(RotorLimits(0.0, 1e4))


def test_momentum_in_a_turn(uav, both):
    """The moments differ by that which turns the rotors' momentum."""
    with_motors, without = both
    rotors = uav.rotors
    W = np.asarray(with_motors.point.omega)
    h = INERTIA * float(jnp.sum(rotors.spin * with_motors.speeds))
    assert abs(h) > 1e-2
    com = jnp.zeros(3)
    moment = lambda found: np.asarray(rotors.wrench(found.speed_squared, com))[3:]
    extra = np.cross(W, [0.0, 0.0, h])
    np.testing.assert_allclose(
        moment(with_motors) - moment(without), extra, atol=2e-2 * np.max(np.abs(extra))
    )
    assert float(with_motors.residual) < 1e-10


def test_limits_of_the_motors_are_kept():
    """Without others given, those of the machine."""
    slow = make_uav(motor=Motor(lowest=1000.0, highest=1360.0))
    with pytest.raises(stm.StateError, match="their limits are 1000 to 1360 rad/s"):
        trim_flight(slow, hover(START))
    found = trim_flight(slow, hover(START), NONE)
    assert float(jnp.max(found.speeds)) > 1360.0
    assert float(found.residual) < 1e-10


@pytest.fixture(scope="module")
def pair():
    """Linearised at hover, with motors of no inertia, whose lag is all that they add, and without."""
    lagging = make_uav(motor=replace(MOTOR, inertia=0.0))
    found = trim_flight(lagging, hover(START))
    at, values, uav = found.point, found.values, make_uav()
    plain = linearize(uav.space, at._replace(internal=jnp.zeros(0)), uav.inputs, values)
    return linearize(lagging.space, at, lagging.inputs, values), plain


def test_lag_has_states_of_its_own(pair):
    """Where speeds have followed their commands, the inputs act as if directly."""
    lagging, plain = pair
    assert len(lagging.states) == 22
    speeds = [(f"hexacopter_1: speed of rotor {k}", "rad/s") for k in range(1, 7)]
    assert lagging.states == (*plain.states, *speeds)
    # eigenvalues -1/T, six of them, by the blocks: those that LAPACK finds of a sixfold one move
    # by far more than round-off with it
    A, B = lagging.A, lagging.B
    np.testing.assert_allclose(A[16:, 16:], -np.eye(6) / LAG, atol=1e-12 / LAG)
    np.testing.assert_array_equal(A[16:, :16], 0)
    np.testing.assert_allclose(A[:16, :16], plain.A, atol=1e-9 * np.max(np.abs(plain.A)))
    followed = -np.linalg.solve(A[16:, 16:], np.hstack([A[16:, :16], B[16:]]))
    np.testing.assert_allclose(followed[:, :16], 0, atol=1e-12)
    # speeding up takes a moment only while it lasts
    quasi = B[:16] + A[:16, 16:] @ followed[:, 16:]
    np.testing.assert_allclose(quasi, plain.B, atol=1e-7 * np.max(np.abs(plain.B)))


@pytest.mark.parametrize(("lowest", "highest"), [(100, 500), (900, 1400)])
def test_a_trim_names_the_limit_of_a_rotor(lowest, highest):
    """Hover needs 700 rad/s; the search starts within the limits, or below them."""
    arms, spin = stm.uav.rotor_layout(4, 0.3)
    rotors = stm.uav.Rotors(
        "frame", arms=arms, spin=spin, k_f=9.81 / (4 * 700**2), k_tau=1e-7, speed_squared=[1e5] * 4
    )
    limits = stm.uav.RotorLimits(lowest, highest)
    motors = stm.uav.MotorRotors(rotors, time_constant=0.03, limits=limits)
    frame = stm.Body("frame", 1.0, [0.02, 0.02, 0.03], free=True)
    space = stm.TreeSpace(stm.System([frame], [], [stm.Gravity(), motors]))
    at = space.from_state(space.system.reference)
    limits_text = f"limits are {lowest} to {highest} rad/s"
    with pytest.raises(stm.StateError, match=f"needs 700 rad/s of the rotor .* {limits_text}"):
        stm.analysis.trim_condition(space, hover(), at=at)
    found = stm.analysis.trim_condition(space, hover(), at=at, throw=False)
    assert not found.converged
    assert np.all(np.isnan(found.values))
