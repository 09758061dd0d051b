"""Endurance over a day, and break-even of a panel: closed form, root finding, derivatives."""

import re
from datetime import date, timedelta, timezone
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

import stmuav_jax as stm
from stmuav_jax.flight import PanelDesign, break_even, day_endurance, hover_demand, panel_gain

# factor [W/kg^1.5], carrier, fixed mass [kg], p [W/m^2], sigma [kg/m^2]
PAYING = PanelDesign(60.0, 5.4, 0.3, 180.0, 0.4)


def numbers(design):
    return tuple(map(float, design))


@pytest.mark.parametrize("fixed", [0.0, 0.3])
def test_break_even_against_root_finding(fixed):
    design = PAYING._replace(fixed_mass=fixed)
    a, m0, f, p, sigma = numbers(design)
    gain = lambda A: p * A - a * ((m0 + f + sigma * A) ** 1.5 - m0**1.5)
    found = break_even(design)
    assert bool(found.pays)
    best: Any = minimize_scalar(
        lambda A: -gain(A), bounds=(0, 100), method="bounded", options={"xatol": 1e-10}
    )
    assert float(found.best) == pytest.approx(best.x, rel=1e-6)
    assert float(found.gain) == pytest.approx(gain(best.x), rel=1e-12)
    first = brentq(gain, 1e-9, best.x, xtol=1e-14) if fixed else 0.0
    assert float(found.smallest) == pytest.approx(first, abs=1e-10)
    assert float(found.largest) == pytest.approx(brentq(gain, best.x, 300.0), rel=1e-11)
    # the least p / sigma of which the best area gains nothing
    edge = break_even(design._replace(areal_power=0.0))
    assert not bool(edge.pays)
    assert np.isnan(edge.best)

    def at_best(s):
        m = max((2 * s / (3 * a)) ** 2, m0 + f)
        return s * (m - m0 - f) - a * (m**1.5 - m0**1.5)

    if fixed:
        assert float(edge.needed) == pytest.approx(brentq(at_best, 100.0, 900.0), rel=1e-10)
    else:
        assert float(edge.needed) == pytest.approx(1.5 * a * np.sqrt(m0), rel=1e-13)


def test_the_edge_itself_pays_at_one_area_only():
    least = break_even(PAYING).needed
    just = break_even(PAYING._replace(areal_power=least * 0.4 * (1 + 1e-9)))
    assert bool(just.pays)
    assert float(just.gain) == pytest.approx(0.0, abs=1e-5)
    assert float(just.largest - just.smallest) < 1e-3 * float(just.best)


def test_derivatives_of_the_design():
    """Gain at the best area: by its envelope; needed power and areas: against differences."""
    x = jnp.array(PAYING)
    outcome = lambda x: jnp.stack(
        [(r := break_even(PanelDesign(*x))).needed, r.smallest, r.largest, r.best, r.gain]
    )
    slope = jax.jit(jax.jacfwd(outcome))(x)
    run = jax.jit(outcome)
    for k, h in enumerate(1e-4 * np.asarray(x)):
        step = np.eye(5)[k] * h
        away = [np.asarray(run(x + j * step)) for j in (-2, -1, 1, 2)]
        expected = (away[0] - 8 * away[1] + 8 * away[2] - away[3]) / (12 * h)
        np.testing.assert_allclose(slope[:, k], expected, rtol=1e-6, atol=1e-8)
    best = break_even(PAYING).best
    assert float(jax.grad(panel_gain, argnums=1)(PAYING, best)) == pytest.approx(0.0, abs=1e-10)
    # dP/dm = 1.5 P / m
    alone = PAYING._replace(fixed_mass=0.0)
    at_rest = float(jax.grad(panel_gain, argnums=1)(alone, 0.0))
    assert at_rest == pytest.approx(180.0 - 0.4 * 1.5 * 60.0 * np.sqrt(5.4), rel=1e-12)


@pytest.fixture(scope="module")
def day():
    place = stm.environment.Place.degrees(11.55, 104.92, 12.0)
    return stm.tracker.track_day(
        place, date(2024, 3, 21), timezone(timedelta(hours=7)), turbidity=3.5, step=1800.0
    )


def test_endurance_over_a_day(day):
    """At night the flight is that of constant power; by day longer by what the panel gives."""
    outfits = stm.flight.uav_outfits()
    assert outfits["bare"].mass == pytest.approx(5.407)
    hours = [0.0, 12.0]
    found = {name: day_endurance(day, outfit, hours) for name, outfit in outfits.items()}
    battery, cells = stm.rotorcraft.Battery.of(), stm.tracker.SolarCells.of()
    for name, each in found.items():
        assert np.all(np.asarray(each.reason) == stm.rotorcraft.BatteryReason.EMPTY), name
        still = float(stm.rotorcraft.endurance(battery, each.demand))
        # steps cross kinks of the voltage: see test_battery.py
        assert float(each.endurance[0]) == pytest.approx(still, rel=1e-8), name
        assert float(each.demand) == pytest.approx(float(hover_demand(outfits[name].mass)))
    dark, lit = found["tracker in the dark"], found["tracker"]
    assert float(dark.endurance[1]) == pytest.approx(float(dark.endurance[0]), rel=1e-10)
    noon = float(cells.power(np.interp(12.0, day.hours, day.irradiance["tracker"])))
    assert 2.5 < noon < 3.5
    assert float(lit.panel_power[1]) == pytest.approx(noon, rel=1e-12)
    # light changes by a thousandth of itself in these minutes
    expected = float(stm.rotorcraft.endurance(battery, lit.demand - noon))
    gained = float(lit.endurance[1] - lit.endurance[0])
    assert gained == pytest.approx(expected - float(lit.endurance[0]), rel=2e-2)
    assert 0.2 < gained < 1.0
    lost = float(found["bare"].endurance[1] - lit.endurance[1])
    assert lost > 200 * gained


def test_bad_input(day):
    outfit = stm.flight.Outfit(7.0, "tracker")
    with pytest.raises(stm.SettingError, match="Did you mean 'tracker'"):
        day_endurance(day, stm.flight.Outfit(7.0, "traker"), [12.0])
    with pytest.raises(stm.SettingError, match="from 0 to 24 h"):
        day_endurance(day, outfit, [25.0])
    with pytest.raises(stm.ModelError, match=r"within 0 and 1, but it is 1\.2"):
        stm.tracker.SolarCells(1.0, 1.2)
    with pytest.raises(stm.ModelError, match="area of the cells must not be negative"):
        stm.tracker.SolarCells(-1.0, 0.2)
    with pytest.raises(stm.ModelError, match="carrier's mass must be positive"):
        break_even(PAYING._replace(carrier_mass=0.0))
    lossy = stm.parameters.ENERGY.replaced({"rotor.efficiency": 0.0})
    with pytest.raises(stm.ModelError, match="efficiency of the motors"):
        hover_demand(7.0, energy=lossy)


def test_the_pages_python_gives_its_numbers(capsys):
    """docs/energy.md: the endurance that it prints, and the reason for which its discharge ends."""
    page = Path(__file__).parents[2] / "docs" / "energy.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    names: dict = {}
    exec(code, names)
    printed = capsys.readouterr().out.splitlines()
    (said,) = re.findall(r"# ([\d.]+) s$", code, re.MULTILINE)
    assert float(printed[0]) == pytest.approx(float(said), abs=0.05)
    assert printed[1].endswith("empty")
    assert float(printed[2]) == pytest.approx(float(names["slope"](names["mass"])))
    assert float(printed[2]) < 0
