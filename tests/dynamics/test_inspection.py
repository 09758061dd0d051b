"""Inspection before a run: each fault or warning is found, by name, and a sound mechanism has none."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import parallelogram

import stmuav_jax as stm
from stmuav_jax.cli.main import main

MODELS = Path(__file__).parents[2] / "docs" / "models"


def by_name(found):
    return {each.quantity: each for each in found.findings}


@pytest.mark.slow
def test_a_parallelogram_near_and_in_its_singular_posture():
    sound = stm.check(parallelogram(0.5))
    assert sound.worst == "note"
    found = by_name(sound)
    assert found["degrees of freedom"].value == "1 (bodies 3, joints 4, rows 20 of rank 17)"
    assert "3 rows" in found["dependent constraints"].value
    # extrapolated from 0.5 rad
    far = found["distance to a singular posture"]
    assert far.severity == "note"
    assert float(far.value.split()[4]) == pytest.approx(0.5, rel=0.3)
    near = by_name(stm.check(parallelogram(0.01)))["distance to a singular posture"]
    # the cranks are 0.01 rad from the flat posture
    assert near.severity == "warning"
    assert float(near.value.split()[4]) == pytest.approx(0.01, rel=0.06)
    assert near.value.endswith(" rad")
    assert found["largest residual of the constraints"].value.count(" rad") == 2
    flat = stm.check(parallelogram(0.0))
    assert flat.worst == "fault"
    assert (
        "nothing determines which one it follows" in by_name(flat)["singular posture at rest"].value
    )
    assert by_name(flat)["singular posture"].value == "rank 16 here, higher nearby"
    assert by_name(flat)["degrees of freedom"].value.startswith("2 ")
    # cranks that turn against each other are the other branch's motion; equal rates are this one's,
    # and no motion through the flat posture has one crank at rest
    system = parallelogram(0.0)
    omega = jnp.array([[0.0, -1.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    v = jnp.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    stuck = stm.State(system.reference.r, system.reference.p, v, omega)
    wrong = stm.check(system, stuck)
    assert wrong.worst == "fault"
    assert "contradict each other" in by_name(wrong)["constraints"].value


def pendulum(mass=1.0, inertia=(0.1, 0.1, 0.01), gravity=9.81, stiffness=0.0):
    body = stm.Body("rod", mass, inertia, com=(0, 0, -0.5))
    pin = stm.revolute("pin", "ground", "rod", point=(0, 0, 0), axis=(0, 1, 0))
    spring = stm.TorsionalSpringDamper("pin", stiffness=stiffness)
    return stm.System([body], [pin], [stm.Gravity((0, 0, -gravity)), spring])


@pytest.mark.slow
def test_wrong_units_show():
    assert stm.check(pendulum()).worst == "note"
    changes: list[tuple[dict[str, Any], str, str]] = [
        ({"inertia": (1e5, 1e5, 1e4)}, "mass and inertia of rod", "an ellipsoid of"),
        ({"inertia": (1e-9, 1e-9, 1e-10)}, "mass and inertia of rod", "a sphere of"),
        ({"gravity": 9810.0}, "gravity", "9810 m/s^2"),
    ]
    for change, what, value in changes:
        found = stm.check(pendulum(**change))
        assert found.worst == "warning"
        assert value in by_name(found)[what].value


def test_stiffness_asks_for_an_implicit_solver():
    soft, stiff = (by_name(stm.check(pendulum(stiffness=k))) for k in (0.0, 1e7))
    assert "Dopri8" in soft["solver"].valid
    # about the pin the moment of inertia is 0.1 + 0.25 kg m^2
    fastest = float(stiff["solver"].value.split()[2])
    assert fastest == pytest.approx(np.sqrt((1e7 + 0.5 * 9.81) / 0.35), rel=1e-2)
    assert "kvaerno5" in stiff["solver"].valid


def test_what_cannot_be_simulated_is_a_fault():
    system = pendulum()
    start = system.reference
    moved = eqx.tree_at(lambda s: s.r, start, start.r + 1e-3)
    found = stm.check(system, moved)
    assert found.worst == "fault"
    assert "joint 'pin' is off by 0.001 m" in by_name(found)["posture"].value
    wrong = eqx.tree_at(
        lambda s: s.bodies.inertia, system, jnp.diag(jnp.array([[1.0, 1, 3]])[0])[None]
    )
    assert "triangle inequality" in by_name(stm.check(wrong))["inertia of rod"].value
    lost = eqx.tree_at(lambda s: s.p, start, start.p * jnp.nan)
    assert "must be finite" in by_name(stm.check(system, lost))["initial state"].value
    assert "fault: initial state" in str(stm.check(system, lost))
    with pytest.raises(stm.SettingError, match="check takes a Scene, or a System"):
        stm.check(stm.make_scene("spin"), start)


@pytest.mark.slow
def test_the_command_says_by_its_exit_code_what_is_wrong(tmp_path, capsys):
    text = (MODELS / "pendulum.toml").read_text()
    good, odd = tmp_path / "good.toml", tmp_path / "odd.toml"
    good.write_text(text)
    odd.write_text(text.replace("0.16666666666666666, 0.16666666666666666, 1e-4", "2e5, 2e5, 1e2"))
    assert main(["check", str(good), "--no-cache"]) == 0
    assert main(["check", str(odd), "--no-cache"]) == 1
    assert "kg m^2" in capsys.readouterr().out
    odd.write_text(text.replace("0.16666666666666666, 0.16666666666666666", "1.0, -1.0"))
    assert main(["check", str(odd), "--no-cache"]) == 2
