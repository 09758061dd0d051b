"""Battery: current, endurance in closed form and by integration, its derivatives."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import stmuav_jax as stm
from stmuav_jax.uav import Battery, endurance

LINE = dict(capacity=3600.0, resistance=0.05, state_of_charge=[0, 1], open_circuit_voltage=[9, 12])
PACK = Battery.of()


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


def test_endurance_by_another_program():
    """SciPy's integration of ds/dt = -I / Q down to the reserve, over the kinks of the table."""
    places, volts = np.asarray(PACK.state_of_charge), np.asarray(PACK.open_circuit_voltage)

    def rate(t, s):
        u = np.interp(s, places, volts)
        return -(u - np.sqrt(u**2 - 0.06 * 2400.0)) / 0.03 / 57600.0

    empty = lambda t, s: s[0] - 0.2
    empty.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    run = solve_ivp(rate, (0, 900), [1.0], events=empty, rtol=1e-10, atol=1e-12, max_step=5.0)
    assert float(endurance(PACK, 2400.0)) == pytest.approx(run.t[-1], rel=1e-8)


def test_derivatives_of_endurance_against_differences():
    """By power, capacity, resistance, reserve and a voltage."""

    def time(x, voltages):
        voltage = voltages.at[4].set(x[4])
        battery = Battery(
            capacity=x[1], resistance=x[2], state_of_charge=PACK.state_of_charge,
            open_circuit_voltage=voltage, reserve=x[3],
        )  # fmt: skip
        return endurance(battery, x[0])

    x = jnp.array([2400.0, 57600.0, 0.015, 0.23, 22.8])
    slopes = jax.jit(jax.grad(time))
    slope, run = slopes(x, PACK.open_circuit_voltage), jax.jit(time)
    for k, h in enumerate(1e-4 * np.asarray(x)):
        step = np.eye(5)[k] * h
        away = [float(run(x + j * step, PACK.open_circuit_voltage)) for j in (-2, -1, 1, 2)]
        expected = (away[0] - 8 * away[1] + 8 * away[2] - away[3]) / (12 * h)
        assert float(slope[k]) == pytest.approx(expected, rel=1e-7)


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
    for call, words in (
        (
            lambda: endurance(battery, 100.0, start=1.5),
            r"from 0 \(empty\) to 1 \(full\), but it is 1\.5",
        ),
        (lambda: endurance(battery, 100.0, start=np.nan), "but it is nan"),
        (lambda: endurance(battery, 100.0, start=-0.1), "but it is -0.1"),
        (lambda: battery.voltage([0.5, 1.2]), "but it is 1.2"),
        (lambda: battery.current(10.0, 1.2), "but it is 1.2"),
        (
            lambda: battery.current(np.nan, 0.5),
            "power of a battery must be finite, but it is nan W",
        ),
    ):
        with pytest.raises(stm.StateError, match=words):
            call()


def test_the_pages_python_gives_its_numbers(capsys):
    """docs/multirotors.md: the endurance that it prints."""
    page = Path(__file__).parents[2] / "docs" / "multirotors.md"
    code = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)[-1]
    names: dict = {}
    exec(code, names)
    printed = capsys.readouterr().out.splitlines()
    (said,) = re.findall(r"# ([\d.]+) s$", code, re.MULTILINE)
    assert float(printed[0]) == pytest.approx(float(said), abs=0.05)
    assert float(printed[1]) == pytest.approx(float(names["slope"](names["mass"])))
    assert float(printed[1]) < 0
