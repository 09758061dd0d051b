"""Rotors' speeds and thrusts that a run keeps: constant, commanded by a function, and of motors that lag."""

import jax
import numpy as np
import pytest

from stmuav_jax import Body, System, inputs_of
from stmuav_jax.dynamics.evaluation import Saved
from stmuav_jax.io.run_file import Held, rotor_table
from stmuav_jax.uav import MotorRotors, RotorLimits, Rotors

TS = np.array([0.0, 0.5, 2.0])
ARMS = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]


def table(speed_squared, internal=None, held=None, **motor):
    rotors = Rotors(
        "frame", arms=ARMS, spin=[1.0, -1.0], k_f=2.0, k_tau=0.1, speed_squared=speed_squared
    )
    force = MotorRotors(rotors, **motor) if motor else rotors
    system = System([Body("frame", 1.0, [1.0, 1.0, 1.0], free=True)], forces=[force])
    states = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), (3, *x.shape)), system.reference)
    saved = Saved(TS, states, np.zeros((3, 0)) if internal is None else internal)
    found = rotor_table(system, saved, None if held is None else Held(inputs_of(system), held))
    return {name: values for name, (_, values, _, _) in found.items()}


def test_constant_speeds():
    found = table([9.0, 16.0])
    assert found["rotor_speed"] == pytest.approx(np.tile([3.0, 4.0], (3, 1)))
    assert found["rotor_thrust"] == pytest.approx(np.tile([18.0, 32.0], (3, 1)))
    assert np.array_equal(found["rotor_position"], ARMS)


def test_commands_by_a_function_within_the_motors_limits():
    command = lambda t, kin: 4.0 + t * np.array([1.0, 10.0])
    assert table(command)["rotor_thrust"] == pytest.approx(
        2 * (4.0 + TS[:, None] * np.array([1.0, 10.0]))
    )
    limited = table(command, limits=RotorLimits(0.0, 3.0))
    assert limited["rotor_speed"][2] == pytest.approx([np.sqrt(6.0), 3.0])


def test_commands_of_a_controller_replace_those_of_the_system():
    commands = np.arange(6.0).reshape(3, 2)
    assert table([9.0, 16.0], held=commands)["rotor_thrust"] == pytest.approx(2 * commands)


def test_speeds_of_motors_that_lag_are_their_own_states():
    speeds = np.arange(6.0).reshape(3, 2)
    found = table([9.0, 16.0], speeds, time_constant=0.1)
    assert found["rotor_speed"] == pytest.approx(speeds)
    assert found["rotor_thrust"] == pytest.approx(2 * speeds**2)
