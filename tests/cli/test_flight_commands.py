"""Tables of trims and modes as they are printed."""

import io

import numpy as np
from rich.console import Console

from stmuav_jax.analysis.linear import Mode
from stmuav_jax.cli.trim import modes_table


def printed(table):
    console = Console(width=120, file=io.StringIO(), record=True)
    console.print(table)
    return console.export_text()


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
