"""Controllability within limits of the inputs: by hand, and of hexacopters that lose a rotor."""

import numpy as np
import pytest

import stmuav_jax as stm

control = stm.control


def linear(A, B, names):
    """A linear system with all states measured."""
    states = tuple((name, "") for name in names)
    n, m = np.shape(B)
    inputs = tuple((f"u{k}", "") for k in range(m))
    return stm.flight.Linear(
        np.array(A, float), np.array(B, float), np.eye(n), np.zeros((n, m)), states, inputs, states
    )


def test_a_force_that_only_pushes_controls_a_spring_but_not_a_free_mass():
    """A mass under a force from 0 to 1 can swing back on a spring, and cannot come back without."""
    free = linear([[0, 1], [0, 0]], [[0], [1]], ["x", "v"])
    spring = linear([[0, 1], [-1, 0]], [[0], [1]], ["x", "v"])
    one_sided = control.input_margin(free, [0.0], [1.0])
    assert not one_sided.controllable
    assert one_sided.margin == pytest.approx(0.0, abs=1e-12)
    assert one_sided.direction == (("v", 1.0),)
    assert control.input_margin(spring, [0.0], [1.0]).controllable
    # a quarter of the range below zero
    both = control.input_margin(free, [-0.25], [0.75])
    assert both.controllable
    assert both.margin == pytest.approx(0.25)
    # the force that holds the mass is beyond its limits
    beyond = control.input_margin(free, [0.1], [1.1])
    assert beyond.margin == pytest.approx(-0.1)
    assert not beyond.controllable
    # an input without a range moves nothing
    assert not control.input_margin(free, [0.0], [0.0]).controllable
    assert control.input_margin(free, [0.2], [0.2]).margin == -np.inf


def test_real_modes_other_than_zero_count():
    """An unstable real mode that one input pushes up alone, beside a pair that both move."""
    A = np.diag([2.0, -1.0])
    found = control.input_margin(linear(A, [[1, 1], [1, -1]], ["up", "down"]), [0, 0], [1, 1])
    assert not found.controllable
    assert found.eigenvalue == pytest.approx(2.0)
    assert found.direction[0][0] == "up"


def test_states_are_left_out_only_where_the_others_do_not_depend_on_them():
    free = linear([[0, 1], [0, 0]], [[0], [1]], ["x", "v"])
    kept = control.without_states(free, ["x"])
    assert kept.states == (("v", ""),)
    assert kept.A.shape == (1, 1)
    with pytest.raises(stm.SettingError, match="'v' cannot be left out: 'x' depends on it"):
        control.without_states(free, ["v"])
    with pytest.raises(stm.SettingError, match="no state 'y'"):
        control.without_states(free, ["y"])
    with pytest.raises(stm.ModelError, match="limits of the input 'u0' are 1 to 0"):
        control.input_margin(free, [1.0], [0.0])


@pytest.fixture(scope="module")
def hexacopter():
    """The report's hexacopter linearised in hover, and the squared speeds there."""
    system = stm.make_scene("hexacopter").system
    rotors = next(f for f in system.forces if isinstance(f, stm.rotorcraft.Rotors))
    B = np.asarray(stm.rotorcraft.wrench_map(rotors, system.bodies.com[0]))
    weight = 9.81 * float(system.bodies.mass[0])
    u = np.linalg.pinv(B) @ [weight, 0.0, 0.0, 0.0]
    space = stm.TreeSpace(system)
    x = space.from_state(system.reference)
    return stm.linearize(space, x, stm.inputs_of(system), u), u, B


def test_a_hexacopter_without_one_rotor_keeps_all_but_yaw(hexacopter):
    """Of the turning senses + - + - + -, any rotor lost leaves no yaw within 200 to 1900 rad/s."""
    system, u, B = hexacopter
    reduced = control.without_states(system, ["theta_z", "omega_z"])
    for rotor in range(6):
        low, high = np.full(6, 200.0**2) - u, np.full(6, 1900.0**2) - u
        low[rotor] = high[rotor] = -u[rotor]
        full = control.input_margin(system, low, high)
        assert not full.controllable
        assert -0.02 < full.margin < -0.005
        assert full.direction[0][0] == "omega_z"
        assert full.direction[0][1] > 0.99
        without = control.input_margin(reduced, low, high)
        assert without.controllable
        assert 0.31 < without.margin < 0.32
        # at these speeds nothing but the yaw is accelerated, and that by what the rotors cannot give
        np.testing.assert_allclose(reduced.B @ without.inputs, 0.0, atol=1e-9)
        assert abs((B @ without.inputs)[3]) > 0.009
        assert without.inputs[rotor] == pytest.approx(-u[rotor])
    whole = control.input_margin(system, np.full(6, 200.0**2) - u, np.full(6, 1900.0**2) - u)
    assert whole.controllable
    assert whole.margin > 0.36
