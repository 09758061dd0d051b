"""Tables and lines as a terminal shows them: brackets are units and names, and nothing is cut."""

import inspect
import io
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console

from stmuav_jax.analysis.linear import Mode
from stmuav_jax.cli.trim import modes_table
from stmuav_jax.figures.estimate import summary_table
from stmuav_jax.figures.terminal import add_row, certificate_table, make_table, print_line


def printed(what, width=120):
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(what)
    return console.export_text()


def test_brackets_are_no_markup():
    made = make_table("turn [rad/s]", "at [s]", title="hull[b] [mm]")
    add_row(made, "[/b]", "[mrad]")
    words = printed(made)
    for part in ("turn [rad/s]", "at [s]", "hull[b] [mm]", "[/b]", "[mrad]"):
        assert part in words
    console = Console(width=80, file=io.StringIO(), record=True)
    print_line(console, "[kg] :x: [/b]")
    assert console.export_text() == "[kg] :x: [/b]\n"


def test_names_in_a_certificate_are_no_markup(monkeypatch):
    rows = [("Rank", "33 of 34 rows; dependent rows in hinge[0], [/b]")]
    monkeypatch.setattr("stmuav_jax.figures.terminal.summary_rows", lambda _: rows)
    named: Any = SimpleNamespace(scene=SimpleNamespace(title="System of arm[b]"), certificate=None)
    words = printed(inspect.unwrap(certificate_table)(named))
    assert "hinge[0], [/b]" in words
    assert "System of arm[b]" in words


def mode(s, doubling):
    return Mode(s, abs(s) / (2 * np.pi), 0.0, doubling, (("theta", 0.5), ("theta_rate", 0.5)))


def test_what_grows_doubles_and_what_decays_halves():
    words = printed(
        modes_table([
            mode(11.41 + 0j, 0.06075), mode(-8.188 + 1e-18j, -0.08465),
            mode(-1.0 + 2.5j, -0.6931), mode(2.5j, np.inf), mode(1e-6 + 0j, 7e5),
        ])
    )  # fmt: skip
    assert "s [1/s]" in words
    assert "doubles in 0.06075" in words
    assert "halves in 0.08465" in words
    assert "-1 + 2.5 i" in words
    assert "neither" in words
    assert "j" not in words
    assert "-0." not in words
    # a free rigid body's
    assert "7e+05" not in words


def test_estimates_fit_an_ordinary_terminal():
    """Every head and every number is there, with units, at 80 columns."""
    one: Any = SimpleNamespace(
        case=8, tuning="consistent", seeds=50, settling_time=1.2, to_2cm=0.366, to_5mm=float("nan"),
        rmse=(0.00226, 0.0123), nees_offset=24.9, nees_offset_window=(1.0, 3.0), nees=0.321,
        nees_window=(4.0, 6.0), nis=2.11, nis_window=(2.9, 3.1),
        verdict=SimpleNamespace(flagged=50),
    )  # fmt: skip
    # past the type check that the tests switch on
    words = printed(inspect.unwrap(summary_table)([one]), 80)
    assert "\u2026" not in words
    assert max(map(len, words.splitlines())) <= 80
    for part in ("[s]", "[mm]", "consistent", "0.366", "never", "2.26", "12.30", "24.9", "0.321",
                 "2.11", "high", "low", "50"):  # fmt: skip
        assert part in words, part
