"""Battery: current, energy balance, endurance in closed form and by integration, why it ends."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import stmuav_jax as stm
from stmuav_jax.rotorcraft import Battery, BatteryReason, discharge, endurance

LINE = dict(capacity=3600.0, resistance=0.05, state_of_charge=[0, 1], open_circuit_voltage=[9, 12])
PACK = Battery.of()


@pytest.fixture(scope="module")
def flown():
    """One program: a table's battery at a power that sinks with time, from a state of charge."""

    @jax.jit
    def run(battery, power, start, ts):
        return discharge(battery, lambda t: power[0] + power[1] * t, ts, start=start)

    return run


TS = np.linspace(0.0, 900.0, 10)


def test_current_solves_the_quadratic():
    """I of (U - R I) I = P, the smaller root; charging below zero; without resistance P / U."""
    battery = Battery(**LINE)
    for power in (200.0, -50.0):
        roots = np.roots([-0.05, 10.5, -power])
        current = float(battery.current(power, 0.5))
        assert current == pytest.approx(min(roots, key=abs), rel=1e-12)
    assert float(Battery(**LINE | {"resistance": 0.0}).current(21.0, 0.5)) == pytest.approx(2.0)
    assert float(battery.largest_power(0.5)) == pytest.approx(10.5**2 / 0.2)


def test_endurance_in_closed_form():
    """On a line U(s), Q / (2 P U') [U^2 / 2 + (U r - c^2 log(U + r)) / 2], r^2 = U^2 - c^2."""
    power = 300.0
    c2 = 4 * 0.05 * power

    def integral(u):
        r = np.sqrt(u * u - c2)
        return u * u / 2 + (u * r - c2 * np.log(u + r)) / 2

    reserve = 0.1
    expected = 3600.0 / (2 * power * 3.0) * (integral(12.0) - integral(9.3))
    found = endurance(Battery(**LINE, reserve=reserve), power)
    assert float(found) == pytest.approx(expected, rel=1e-13)


# a table of as many points, on a line, so that steps cross no kink
SMOOTH = eqx.tree_at(lambda b: b.open_circuit_voltage, PACK, 21.0 + 4.2 * PACK.state_of_charge)


# steps that cross a kink of the voltage are accurate to the tolerance only: 2e-9 was seen
@pytest.mark.parametrize(
    ("battery", "rtol"), [(SMOOTH, 1e-10), (PACK, 1e-8)], ids=["line", "table"]
)
def test_discharge_agrees_with_endurance_and_balances(flown, battery, rtol):
    """Chemical energy of the voltage's table, by its area, is what came out and what was lost."""
    found = flown(battery, jnp.array([2400.0, 0.0]), 1.0, TS)
    assert int(found.reason) == BatteryReason.EMPTY
    end = float(found.end)
    assert end == pytest.approx(float(endurance(battery, 2400.0)), rel=rtol)
    soc, delivered, lost = map(float, found.at_end)
    assert soc == pytest.approx(0.2, abs=1e-10)
    assert delivered == pytest.approx(2400.0 * end, rel=1e-12)
    places, volts = np.asarray(battery.state_of_charge), np.asarray(battery.open_circuit_voltage)
    chemical = 57600.0 * np.trapezoid(volts[3:], places[3:])
    assert delivered + lost == pytest.approx(chemical, rel=rtol)
    assert float(battery.stored(1.0)) == pytest.approx(chemical, rel=1e-13)
    assert lost > 0.03 * chemical
    # what came before the end is kept, what would come after is not there
    kept = end >= TS
    assert 2 < kept.sum() < len(TS)
    assert np.array_equal(np.isfinite(found.soc), kept)
    np.testing.assert_allclose((found.voltage * found.current)[kept], 2400.0, rtol=1e-12)
    stored = jax.vmap(battery.stored)(found.soc[kept])
    given = chemical - (found.delivered + found.lost)[kept]
    np.testing.assert_allclose(stored, given, atol=rtol * chemical)


def test_discharge_by_another_program(flown):
    """SciPy's implicit Runge-Kutta method, a power that changes with time."""
    found = flown(PACK, jnp.array([1500.0, 0.8]), 0.95, TS[:5])
    assert int(found.reason) == BatteryReason.TIME_OVER
    places, volts = np.asarray(PACK.state_of_charge), np.asarray(PACK.open_circuit_voltage)

    def rate(t, s):
        u = np.interp(s, places, volts)
        return -(u - np.sqrt(u**2 - 0.06 * (1500.0 + 0.8 * t))) / 0.03 / 57600.0

    other = solve_ivp(rate, (0, TS[4]), [0.95], t_eval=TS[:5], rtol=1e-10, atol=1e-12, max_step=5.0)
    np.testing.assert_allclose(found.soc, other.y[0], rtol=1e-8)


def test_why_a_discharge_ends(flown):
    """Beyond the largest power; full; at once."""
    weak = Battery.of(stm.parameters.ENERGY.replaced({"battery.resistance": 0.05}))
    found = flown(weak, jnp.array([2000.0, 2.0]), 1.0, TS)
    assert int(found.reason) == BatteryReason.BEYOND_LARGEST_POWER
    end, soc = float(found.end), float(found.at_end[0])
    assert 2000.0 + 2.0 * end == pytest.approx(float(weak.largest_power(soc)), rel=1e-9)
    charged = flown(PACK, jnp.array([-500.0, 0.0]), 0.9, TS)
    assert int(charged.reason) in (BatteryReason.FULL, BatteryReason.TIME_OVER)
    assert float(charged.at_end[0]) > 0.9
    full = flown(PACK, jnp.array([-5000.0, 0.0]), 0.9, TS)
    assert int(full.reason) == BatteryReason.FULL
    assert float(full.at_end[0]) == pytest.approx(1.0, abs=1e-8)
    for power, start, reason in (
        (5e4, 1.0, BatteryReason.BEYOND_LARGEST_POWER),
        (1e3, 0.2, BatteryReason.EMPTY),
    ):
        none = flown(PACK, jnp.array([power, 0.0]), start, TS)
        assert (int(none.reason), float(none.end)) == (reason, 0.0)
        assert np.all(np.isnan(none.soc))


def test_derivatives_of_endurance_against_differences():
    """By power, capacity, resistance, reserve and a voltage; and through the integration."""

    def time(x):
        voltage = PACK.open_circuit_voltage.at[4].set(x[4])
        battery = Battery(
            capacity=x[1], resistance=x[2], state_of_charge=PACK.state_of_charge,
            open_circuit_voltage=voltage, reserve=x[3],
        )  # fmt: skip
        return endurance(battery, x[0])

    x = jnp.array([2400.0, 57600.0, 0.015, 0.23, 22.8])
    slope = jax.jit(jax.grad(time))(x)
    run = jax.jit(time)
    for k, h in enumerate(1e-4 * np.asarray(x)):
        step = np.eye(5)[k] * h
        away = [float(run(x + j * step)) for j in (-2, -1, 1, 2)]
        expected = (away[0] - 8 * away[1] + 8 * away[2] - away[3]) / (12 * h)
        assert float(slope[k]) == pytest.approx(expected, rel=1e-7)
    # through the integration to its end
    ts = jnp.array([0.0, 900.0])
    through = jax.jit(jax.grad(lambda p: discharge(SMOOTH, lambda t: p, ts).end))(2400.0)
    at_once = jax.grad(lambda p: endurance(SMOOTH, p))(2400.0)
    assert float(through) == pytest.approx(float(at_once), rel=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"capacity": 0.0}, "capacity must be positive"),
        ({"resistance": -1.0}, "resistance must not be negative, but it is -1 ohm"),
        ({"reserve": 1.0}, "reserve must be below 1"),
        ({"state_of_charge": [0.1, 1.0]}, "rise from 0 to 1"),
        ({"open_circuit_voltage": [0.0, 12.0]}, "must be positive, but the lowest is 0 V"),
        ({"open_circuit_voltage": [9, 10, 12]}, "one voltage for each"),
    ],
)
def test_batteries_that_cannot_be(change, words):
    with pytest.raises(stm.ModelError, match=words):
        Battery(**LINE | change)


def test_powers_that_cannot_be():
    battery = Battery(**LINE)
    with pytest.raises(stm.StateError, match=r"cannot deliver 700 W at a state of charge of 0\.5"):
        battery.current(700.0, 0.5)
    assert np.isnan(jax.jit(lambda p: battery.current(p, 0.5))(700.0))
    with pytest.raises(stm.StateError, match="no current gives more than 405 W"):
        endurance(battery, 500.0)
    assert np.isnan(jax.jit(lambda p: endurance(battery, p))(500.0))
    with pytest.raises(stm.ModelError, match="power must be positive"):
        endurance(battery, 0.0)
    with pytest.raises(stm.SettingError, match="two or more that rise"):
        discharge(battery, lambda t: 1.0, [0.0, 0.0])
