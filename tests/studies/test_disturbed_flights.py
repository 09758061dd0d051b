"""From drawn numbers to systems and starts."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_II, Body, SettingError, System, Tree, Unstabilised, make_scene
from stmuav_jax.dynamics import energy
from stmuav_jax.dynamics.formulations.augmented import Augmented
from stmuav_jax.studies.disturbed_flights import make_flights, trim_inputs
from stmuav_jax.uav import PanelStart, Rotors, Servo


def build(of, **values):
    return of.build({k.replace("__", "."): jnp.asarray(v) for k, v in values.items()})


@pytest.mark.parametrize(
    ("name", "case"), [("tracker", 1), ("hexacopter", None), ("uav_tracker", 2)]
)
def test_nothing_drawn_is_the_scene(name, case):
    scene = make_scene(name, case)
    system, state = make_flights(name, case).build({})
    same = jax.tree.map(lambda a, b: bool(jnp.all(a == b)), system, scene.system)
    assert all(jax.tree.leaves(same))
    off = jax.tree.map(lambda a, b: float(jnp.max(jnp.abs(a - b))), state, scene.state0)
    assert max(jax.tree.leaves(off)) < 1e-14


@pytest.mark.slow
def test_a_start_closes_the_loops():
    """Positions and velocities satisfy all rows of the joints, at any posture and rates."""
    of = make_flights("uav_tracker", 1)
    system, state = build(
        of, start__phi=-0.1, start__theta=0.2, start__phi_rate=0.5, start__theta_rate=-0.3,
        start__roll=0.4, start__pitch=-0.2, start__yaw=1.0, start__vx=0.3, start__q=-0.7,
        start__z=2.0,
    )  # fmt: skip
    rows = Augmented()
    model = rows.prepare(system)
    left = rows.residuals(model, jnp.zeros(()), rows.to_vector(model, state))
    assert max(float(x) for x in jax.tree.leaves(left)) < 1e-14
    assert state.r[0, 2] == 2.0
    assert float(energy(system, state, jnp.zeros(())).kinetic) > 0.1


def test_where_factors_go():
    of = make_flights("uav_tracker", 2, relative=frozenset({"mass.panel_7", "geometry.rods"}))
    values = {
        "mass.panel_7": 1.1, "inertia.hexacopter_1[0, 1]": 0.002, "geometry.rods": 1.01,
        "rotor.k_f": 7e-6,
    }  # fmt: skip
    table = of._draw_table({k: jnp.asarray(v) for k, v in values.items()})
    assert table.value("mass.panel_7") == pytest.approx(1.1 * PART_II.value("mass.panel_7"))
    inertia = np.asarray(table.value("inertia.hexacopter_1"))
    assert inertia[0, 1] == inertia[1, 0] == 0.002
    assert inertia[0, 0] == np.asarray(PART_II.value("inertia.hexacopter_1"))[0][0]
    assert np.asarray(table.value("geometry.rods")) == pytest.approx(
        1.01 * np.asarray(PART_II.value("geometry.rods"))
    )
    assert of.entry("mass.panel_7").unit == "1"
    assert of.entry("rotor.k_f").unit == PART_II["rotor.k_f"].unit


def test_inputs():
    of = make_flights("uav_tracker", 2)
    plain = of.build({})[0].forces
    system, state = build(of, input__rotor_2=1.1, input__actuator_3=0.5)
    rotors: Any = lambda forces: next(f for f in forces if hasattr(f, "speed_squared"))
    ratio = rotors(system.forces).speed_squared / rotors(plain).speed_squared
    assert np.asarray(ratio) == pytest.approx([1, 1.1, 1, 1, 1, 1], abs=1e-15)
    force: Any = lambda forces: (
        next(f for f in forces if getattr(f, "slider", "") == "slider_3").force
    )
    push, before = force(system.forces), force(plain)
    t, kin = jnp.asarray(0.03), system.kinematics(state)
    assert float(push(t, kin) - before(t, kin)) == pytest.approx(0.5)


@pytest.mark.slow
def test_a_trims_inputs_hold():
    system, state = make_flights("uav_tracker", inputs="trim").build({})
    tree = Tree()
    model = tree.prepare(system)
    accelerations = jax.jit(lambda s: tree.accelerations(model, jnp.zeros(()), s, Unstabilised()))
    found = accelerations(state)
    level = float(jnp.max(jnp.abs(found.v_rate)))
    # level attitude, while the trim leans by 1e-4: what is left is of that order
    assert level < 0.01


def test_a_trim_of_another_scene():
    """The rotors of the hexacopter at its trim carry its weight; a factor multiplies one of them."""
    study = make_flights("hexacopter", inputs="trim")
    held: Any
    drawn: Any
    systems = study.build({})[0], build(study, input__rotor_1=1.1)[0]
    held, drawn = (next(f for f in s.forces if isinstance(f, Rotors)) for s in systems)
    weight = 9.81 * float(jnp.sum(systems[0].bodies.mass))
    assert float(held.k_f * jnp.sum(held.speed_squared)) == pytest.approx(weight, rel=1e-10)
    ratio = drawn.speed_squared / held.speed_squared
    np.testing.assert_allclose(ratio, [1.1, 1, 1, 1, 1, 1], rtol=1e-15)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        ("mass.panel7", "mean 'mass.panel_7'"),
        ("start.fi", "start.phi"),
        ("inertia.panel_7[3, 0]", "no entry"),
        ("inertia.panel_7", "name one entry"),
        ("wind.x", "neither a parameter"),
    ],
)
def test_unknown_factors(factor, words):
    with pytest.raises(SettingError, match=words):
        make_flights("uav_tracker").entry(factor)


def test_a_factor_that_the_scene_does_not_use_is_refused_and_not_suggested():
    """The table is of all scenes of Part II: the bare hexacopter has a mass of its own."""
    flights = make_flights("hexacopter")
    with pytest.raises(
        SettingError, match=r"'mass\.hexacopter_1' has no effect on hexacopter"
    ) as told:
        flights.entry("mass.hexacopter_1")
    with pytest.raises(SettingError, match="neither a parameter of hexacopter") as asked:
        flights.entry("mass.hexacopter")
    for caught in (told, asked):
        suggestion = str(caught.value).partition("Names like it: ")[2]
        assert "bare.mass" in suggestion
        assert "_1," not in suggestion.replace("rotor_1", "")
    with pytest.raises(SettingError, match=r"'wind.mean\[0\]' has no effect"):
        flights.entry("wind.mean[0]")
    assert make_flights("hexacopter", drag=True).entry("wind.mean[0]").unit == "m/s"


def test_refusals():
    with pytest.raises(SettingError, match="no scene 'spim'"):
        make_flights("spim")
    with pytest.raises(SettingError, match="set drag too"):
        make_flights("hexacopter", gusts=True)
    with pytest.raises(SettingError, match="no airframe"):
        make_flights("tracker", drag=True)
    bare = System([Body("a", 1.0, np.eye(3), free=True)])
    with pytest.raises(SettingError, match="bare has no inputs that a trim could find"):
        trim_inputs("bare", replace(make_scene("spin"), system=bare))
    with pytest.raises(SettingError, match="to multiply"):
        make_flights("hexacopter", relative=frozenset({"start.p"})).entry("start.p")


def test_options_of_the_scene_are_those_of_all_flights():
    options = {"servo": {"stiffness": 2e4}, "start": {"phi": -0.2}}
    of = make_flights("tracker", 2, options=options)
    scene = make_scene("tracker", 2, servo=Servo(2e4), start=PanelStart(phi=-0.2))
    system, state = of.build({})
    same = jax.tree.map(
        lambda a, b: bool(jnp.all(a == b)), (system, state), (scene.system, scene.state0)
    )
    assert all(jax.tree.leaves(same))
    # what is drawn goes on from there
    _, moved = build(of, start__theta=-0.3)
    other = make_scene("tracker", 2, start=PanelStart(phi=-0.2, theta=-0.3)).state0
    np.testing.assert_allclose(moved.r, other.r, atol=1e-15)
    with pytest.raises(SettingError, match=r"'servo\.stiffness' is set by the study's options"):
        of.entry("servo.stiffness")
    assert of.entry("servo.damping").unit == "N s/m"
    with pytest.raises(SettingError, match="leave the option wind out"):
        make_flights("hexacopter", drag=True, options={"wind": {}})
    with pytest.raises(SettingError, match="leave motor out"):
        make_flights("uav_tracker", inputs="trim", options={"motor": {}})
