"""Pole maps and step responses against closed forms."""

import numpy as np
import pytest

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.figures.linear import pole_map, step_response
from stmuav_jax.flight.linear import Linear


def oscillator(ratio, frequency=3.0, mass=2.0, extra=()):
    """Mass on a spring with a damper, pushed by a force; further real poles are not connected."""
    n = 2 + len(extra)
    A, B = np.diag([0.0, 0.0, *extra]), np.zeros((n, 1))
    A[0, 1], A[1, :2], B[1, 0] = 1.0, [-(frequency**2), -2 * ratio * frequency], 1 / mass
    states = (("x", "m"), ("v", "m/s"), *((f"z{k}", "1") for k in range(len(extra))))
    return Linear(A, B, np.eye(n), np.zeros((n, 1)), states, (("push", "N"),), states)


def by_label(figure):
    return {str(line.get_label()): line for line in figure.axes[0].lines}


@pytest.mark.parametrize("extra", [(), (-400.0,)])
def test_poles_lie_on_the_lines_of_their_damping(extra):
    """s = w (-d +- i sqrt(1 - d^2)), in linear and in logarithmic axes."""
    figure = pole_map(oscillator(0.5, extra=extra), "mass")
    ax = figure.axes[0]
    assert ax.get_xscale() == ("symlog" if extra else "linear")
    poles = by_label(figure)["decays"]
    found = np.asarray(poles.get_xdata()) + 1j * np.asarray(poles.get_ydata())
    wanted = 3.0 * np.array([-0.5 + 0.75**0.5 * 1j, -0.5 - 0.75**0.5 * 1j])
    assert sorted(found, key=lambda s: (s.real, s.imag)) == pytest.approx(
        sorted([*extra, *wanted], key=lambda s: (np.real(s), np.imag(s)))
    )
    rays = [line for line in ax.lines if len(np.asarray(line.get_xdata())) > 9]
    assert len(rays) == (6 if extra else 10)
    off = []
    for ray in rays:
        x, y = (np.asarray(part) for part in ray.get_data())
        reached = np.interp(3.0, np.hypot(x, y), x) + 1j * np.interp(3.0, np.hypot(x, y), y)
        off.append(min(abs(reached - s) for s in wanted))
    assert sorted(off)[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert sorted(off)[2] > 0.3
    assert ax.get_xlabel() == "real part [1/s]"
    (names,) = figure.axes[1].texts
    assert "decays, time constant 0.667 s; 0.477 Hz, damping 0.5" in names.get_text()
    assert "v 50 %" in names.get_text()
    # a pair has one number
    assert ("\n2  " in names.get_text()) == bool(extra)


def test_poles_that_grow_oscillate_or_rest_are_told_apart():
    A = np.zeros((6, 6))
    A[0, 1], A[1, 0] = 2.0, -2.0
    A[2, 3], A[3, 2] = 1.0, 9.0
    states = tuple((f"s{k}", "1") for k in range(6))
    linear = Linear(A, np.zeros((6, 0)), np.eye(6), np.zeros((6, 0)), states, (), states)
    figure = pole_map(linear)
    found = by_label(figure)
    assert {"decays", "grows", "neither", "at zero (2)"} <= set(found)
    assert found["grows"].get_xdata() == pytest.approx([3.0])
    assert np.abs(found["neither"].get_ydata()) == pytest.approx([2.0, 2.0])
    (names,) = figure.axes[1].texts
    assert "grows, time constant 0.333 s" in names.get_text()
    assert "0.318 Hz, damping 0" in names.get_text()
    assert linear.settling_time() == pytest.approx(1.0)
    with pytest.raises(SettingError, match="no inputs"):
        step_response(linear)


def test_step_response_is_the_closed_form():
    """x(t) = (1 - e^(-d w t) (cos w_d t + d w / w_d sin w_d t)) / k."""
    linear, d, w = oscillator(0.2), 0.2, 3.0
    figure = step_response(linear, "mass", outputs=["x", "v"], duration=6.0)
    lines = [ax.lines[0] for ax in figure.axes]
    t = np.asarray(lines[0].get_xdata())
    assert (t[0], t[-1]) == (0.0, 6.0)
    w_d, decay = w * np.sqrt(1 - d**2), np.exp(-d * w * t)
    x = (1 - decay * (np.cos(w_d * t) + d * w / w_d * np.sin(w_d * t))) / (2.0 * w**2)
    v = decay * np.sin(w_d * t) / (2.0 * w_d)
    assert np.asarray(lines[0].get_ydata()) == pytest.approx(x, abs=1e-14)
    assert np.asarray(lines[1].get_ydata()) == pytest.approx(v, abs=1e-14)
    assert [ax.get_ylabel() for ax in figure.axes] == ["x\n[m]", "v\n[m/s]"]
    assert lines[0].get_label() == "push, 1 N"
    # four time constants of the slowest mode
    ts, found = linear.step()
    assert ts[-1] == pytest.approx(4 / (d * w))
    assert found.shape == (401, 2, 1)


def test_inputs_of_one_name_and_many_columns():
    rng = np.random.default_rng(1)
    A, B = -np.diag([1.0, 2.0, 3.0]), rng.normal(size=(3, 6))
    states = tuple((name, "m") for name in "abc")
    pushes = (*(("rotor", "N"),) * 5, ("effort", "N m"))
    linear = Linear(A, B, np.eye(3), rng.normal(size=(3, 6)), states, pushes, states)
    figure = step_response(linear, outputs=["b"])
    assert [len(ax.lines) for ax in figure.axes] == [4, 1, 1]
    assert [ax.lines[0].get_label() for ax in figure.axes[1:]] == ["rotor 5, 1 N", "effort, 1 N m"]
    t, y = (np.asarray(part) for part in figure.axes[2].lines[0].get_data())
    assert y == pytest.approx(linear.D[1, 5] + B[1, 5] / 2.0 * (1 - np.exp(-2.0 * t)))
    (ax,) = step_response(linear, inputs=["effort"], outputs=["a"]).axes
    assert len(ax.lines) == 1
    with pytest.raises(SettingError, match="Did you mean 'rotor'"):
        step_response(linear, inputs=["rotr"])
    for duration in (0.0, np.inf, np.nan):
        with pytest.raises(SettingError, match="positive, finite duration"):
            step_response(linear, duration=duration)
