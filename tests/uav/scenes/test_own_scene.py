"""A scene of a user's own: one file, `swing.py`, and one line of the registry."""

import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.cli import main as cli
from stmuav_jax.studies import make_flights
from stmuav_jax.uav import RegisteredScene


@pytest.fixture(autouse=True)
def line(monkeypatch):
    monkeypatch.setitem(stm.SCENES, "swing", RegisteredScene("swing", "a rod", "none", 2.0))


def test_the_command_line_knows_it(capsys):
    """It is listed, and its help has the options of its function with their words."""
    assert cli.main(["list"]) == 0
    assert "swing" in capsys.readouterr().out
    assert cli.main(["simulate", "swing", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "--length" in said
    assert "length of the rod [m]" in said
    assert cli.main(["simulate", "swing", "--lenght", "2"]) == 2


def test_studies_know_it():
    """Its options are read from plain data, and constant inputs of its forces are factors."""
    of = make_flights("swing", options={"length": 0.5})
    assert of.own_factors == {"input.effort": "N m"}
    system, state = of.build({"input.effort": jnp.asarray(0.3)})
    np.testing.assert_allclose(stm.inputs_of(system).values(system), 0.4, rtol=1e-15)
    np.testing.assert_allclose(state.r, [[0.0, 0.25, 0.0]], atol=1e-15)
    with pytest.raises(stm.SettingError, match=r"'input.efort' is neither"):
        of.entry("input.efort")
