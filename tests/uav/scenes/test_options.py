"""Options of scenes as they are read from signatures, and made from plain data."""

import dataclasses
import inspect
from typing import get_args, get_type_hints

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import ModelError, SettingError, StateError, make_scene
from stmuav_jax.checks.schema import option_from_plain, quantity_fields
from stmuav_jax.math.rotation import rotation_matrix
from stmuav_jax.uav import (
    PART_I,
    PART_II,
    BaseStart,
    FlightStart,
    PanelStart,
    Servo,
    Strokes,
    Wind,
    panel_angles,
)
from stmuav_jax.uav.scenes.registry import SCENES, options_from_plain
from stmuav_jax.uav.tracker.bodies import stroke_motions


@pytest.mark.parametrize("name", SCENES)
def test_what_is_read_from_the_source_is_the_signature(name):
    entry = SCENES[name]
    own = inspect.signature(entry.build).parameters
    keywords = {k: p for k, p in own.items() if p.kind is inspect.Parameter.KEYWORD_ONLY}
    # every option of the report's scenes can be given as text
    assert list(entry.options) == list(keywords)
    for option in entry.options.values():
        assert option.default == keywords[option.name].default
        assert option.description
        assert option.is_group or option.choices
    assert entry.parameters is own["parameters"].default
    assert entry.cases == get_args(get_type_hints(entry.build).get("case"))
    if "case" in own:
        assert entry.default_case == own["case"].default
        assert entry.default_case in entry.cases


def test_every_field_of_an_option_is_described():
    for entry in SCENES.values():
        for option in entry.options.values():
            if option.is_group:
                described = quantity_fields(option.kind)
                assert list(described) == [f.name for f in dataclasses.fields(option.kind)]
                assert all(each.description for each in described.values())


def test_plain_data_make_the_options():
    made = options_from_plain(
        "tracker", {"servo": {"stiffness": 2e4, "targets": [0.001, 0]}, "start": {"phi": -0.2}}
    )
    assert made == {"servo": Servo(2e4, targets=(0.001, 0)), "start": PanelStart(phi=-0.2)}
    assert options_from_plain("uav_tracker", {"actuators": "printed"}) == {"actuators": "printed"}


@pytest.mark.parametrize(
    ("plain", "words"),
    [
        ({"frictoin": {}}, "its options: servo, .*Did you mean 'friction'"),
        ({"servo": {"kp": 1.0}}, "no field 'kp'.* Known names: stiffness, damping, targets"),
        ({"servo": {"stiffness": "stiff"}}, r"'servo.stiffness' must be a number \[N/m\]"),
        ({"servo": {"targets": [0.1]}}, r"'servo.targets' must be 2 numbers \[m\]"),
        ({"stops": {"lower": [0.1, 0.2, 0.3]}}, "must be 1 or 2 numbers"),
        ({"servo": 3.0}, "must be a table of its fields"),
    ],
)
def test_plain_data_that_do_not_fit_are_refused(plain, words):
    with pytest.raises(SettingError, match=words):
        options_from_plain("tracker", plain)


def test_a_switch_is_true_or_false():
    assert option_from_plain(Wind, {"gusts": True, "seed": 3}, "wind") == Wind(gusts=True, seed=3)
    with pytest.raises(SettingError, match=r"'wind.gusts' must be true or false"):
        option_from_plain(Wind, {"gusts": 1}, "wind")
    with pytest.raises(SettingError, match=r"'wind.seed' must be a whole number"):
        option_from_plain(Wind, {"seed": 1.5}, "wind")


def test_an_option_that_a_scene_does_not_have():
    with pytest.raises(
        SettingError, match="Scene hexacopter has no servo; its options: drag, wind"
    ):
        make_scene("hexacopter", servo=Servo())
    with pytest.raises(SettingError, match="Scene spin has no drag; its options: none"):
        make_scene("spin", drag=None)


def test_starts():
    """Without numbers the start is the report's; with some it is where they say."""
    for name, start in (
        ("tracker", PanelStart()), ("hexacopter", BaseStart()), ("uav_tracker", FlightStart()),
    ):  # fmt: skip
        plain, same = make_scene(name), make_scene(name, start=start)
        states = (jax.tree.leaves(scene.state0) for scene in (plain, same))
        for a, b in zip(*states, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-14)
        assert any("not the report's" in note for note in same.notes)
        assert not any("The start" in note for note in plain.notes)
    moved = make_scene("uav_tracker", start=FlightStart(z=2.0, yaw=0.5, r=0.1, phi=-0.1)).state0
    assert float(moved.r[0, 2]) == 2.0
    assert 2 * np.arctan2(moved.p[0, 3], moved.p[0, 0]) == pytest.approx(0.5, abs=1e-15)
    assert float(moved.omega[0, 2]) == 0.1
    # the panel in the base's axes: the base has turned about the vertical alone
    n = rotation_matrix(moved.p[0]).T @ rotation_matrix(moved.p[-1])[:, 2]
    angles = np.asarray(panel_angles(n))
    np.testing.assert_allclose(angles, [-0.1, PART_II.value("posture.theta")], atol=1e-12)


def test_starts_that_make_no_sense():
    with pytest.raises(StateError, match="rods do not reach"):
        make_scene("tracker", start=PanelStart(phi=1.5))
    with pytest.raises(ModelError, match="start's phi must be finite"):
        make_scene("tracker", start=PanelStart(phi=np.nan))
    with pytest.raises(ModelError, match="start's vx must be finite"):
        make_scene("hexacopter", start=BaseStart(vx=np.inf))


def test_prescribed_strokes_rise_smoothly():
    """Values, speeds and accelerations at both ends; the rise is even about its middle."""
    first, second = stroke_motions(Strokes(to=(0.004, -0.002), duration=0.5))
    speed, acceleration = jax.grad(first), jax.grad(jax.grad(first))
    for t, value in ((0.0, 0.0), (0.25, 0.002), (0.5, 0.004), (0.9, 0.004)):
        assert float(first(jnp.asarray(t))) == pytest.approx(value, abs=1e-17)
        assert float(second(jnp.asarray(t))) == pytest.approx(-value / 2, abs=1e-17)
    for t in (0.0, 0.5):
        assert float(speed(jnp.asarray(t))) == pytest.approx(0.0, abs=1e-15)
        assert float(acceleration(jnp.asarray(t))) == pytest.approx(0.0, abs=1e-13)
    plain = make_scene("tracker", 2, strokes=(first, second))
    made = make_scene("tracker", 2, strokes=Strokes(to=(0.004, -0.002), duration=0.5))
    assert eqx.tree_equal(plain.system, made.system)
    assert "drive T12" in [joint.name for joint in made.system.joints]


@pytest.mark.parametrize(
    ("strokes", "words"),
    [
        (Strokes(to=(0.1, 0.2, 0.3)), r"strokes at the end of their rise must have shape \(2,\)"),
        (Strokes(to=(0.1, np.nan)), "strokes at the end of their rise must be finite"),
        (Strokes(duration=0.0), "duration of the strokes' rise must be positive"),
    ],
)
def test_strokes_that_make_no_sense(strokes, words):
    with pytest.raises(ModelError, match=words):
        make_scene("tracker", strokes=strokes, parameters=PART_I)
