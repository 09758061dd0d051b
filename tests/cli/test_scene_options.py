"""Options of scenes on the command line: the same scenes, clear refusals, new scenes."""

import equinox as eqx
import pytest

import stmuav_jax as stm
from stmuav_jax.cli import main as cli, simulate
from stmuav_jax.cli.scene_options import named_scene
from stmuav_jax.cli.simulate import scene_of
from stmuav_jax.io.netcdf import load
from stmuav_jax.uav import (
    BaseStart,
    Drag,
    FlightStart,
    Friction,
    Gear,
    Motor,
    PanelStart,
    Servo,
    Stops,
    Strokes,
    Wind,
)


@pytest.fixture(autouse=True)
def private(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setenv("COLUMNS", "1000")


LINES = {
    "hexacopter --drag --wind.mean 6 0 -1 --wind.gusts --wind.seed 3 --wind.duration 1 "
    "--motor.time-constant 0.04 --start.roll 0.2 --start.vz -0.5": (
        None,
        {
            "drag": Drag(), "wind": Wind((6.0, 0.0, -1.0), gusts=True, seed=3, duration=1.0),
            "motor": Motor(time_constant=0.04), "start": BaseStart(roll=0.2, vz=-0.5),
        },
    ),
    "tracker --case 2 --servo.stiffness 2e4 --servo.targets 0.001 0 --stops.lower -0.01 "
    "--stops.upper 0.05 0.06 --friction --start.phi_rate -0.1": (
        2,
        {
            "servo": Servo(2e4, targets=(0.001, 0.0)),
            "stops": Stops(lower=-0.01, upper=(0.05, 0.06)), "friction": Friction(),
            "start": PanelStart(phi_rate=-0.1),
        },
    ),
    "tracker --strokes.to 0.003 -0.002 --strokes.duration=0.5": (
        None, {"strokes": Strokes((0.003, -0.002), 0.5)},
    ),
    "uav_tracker --case 1 --drag.linear 0.1 0.1 0.2 --start.phi -0.2 --start.q 0.1": (
        1, {"drag": Drag(linear=(0.1, 0.1, 0.2)), "start": FlightStart(phi=-0.2, q=0.1)},
    ),
    "uav_tracker --gear": (None, {"gear": Gear()}),
    "uav_tracker --actuators printed": (None, {"actuators": "printed"}),
}  # fmt: skip


@pytest.mark.parametrize("words", LINES)
def test_the_scene_of_the_words_is_that_of_the_options(words):
    case, options = LINES[words]
    name, given = cli._parse_arguments(["simulate", *words.split()])
    assert name == "simulate"
    found, wanted = scene_of(given), stm.make_scene(words.split()[0], case, **options)
    assert eqx.tree_equal(found.system, wanted.system)
    assert eqx.tree_equal(found.state0, wanted.state0)
    assert found.parameters == wanted.parameters
    assert found.notes == wanted.notes


def test_the_words_of_the_method_are_that_of_the_library():
    words = (
        "spin --solver kvaerno5 --formulation augmented --rtol 1e-9 --atol 1e-7 --max-steps 77 "
        "--first-step 1e-3 --max-step 0.02 --jump-times 0.2 0.1 --stabilisation baumgarte "
        "--baumgarte-gains 5 6 7"
    )
    _, command = cli._parse_arguments(["simulate", *words.split()])
    found = simulate.method_of(command.settings, scene_of(command))
    wanted = stm.Method(
        solver=stm.dynamics.kvaerno5(), formulation=stm.Augmented(), rtol=1e-9, atol=1e-7,
        max_steps=77, first_step=1e-3, max_step=0.02, jump_ts=[0.2, 0.1],
        stabilisation=stm.Baumgarte(5.0, 6.0, 7.0),
    )  # fmt: skip
    assert eqx.tree_equal(found, wanted)
    _, command = cli._parse_arguments(["simulate", "spin"])
    assert eqx.tree_equal(simulate.method_of(command.settings, scene_of(command)), stm.Method())


@pytest.mark.slow
def test_a_run_with_options_is_that_of_the_library(tmp_path):
    words = (
        "simulate hexacopter --drag --wind.mean 6 0 0 --motor.time-constant 0.04 --t1 0.05 "
        "--first-step 1e-3 --max-step 2e-3"
    )
    plain = "--figures none --no-error-estimate --no-cache --out"
    assert cli.main([*words.split(), *plain.split(), str(tmp_path)]) == 0
    scene = stm.make_scene(
        "hexacopter", drag=Drag(), wind=Wind((6.0, 0.0, 0.0)), motor=Motor(time_constant=0.04)
    )
    method = stm.Method(first_step=1e-3, max_step=2e-3)
    run = stm.simulate(scene, method=method, t1=0.05, error_estimate=False)
    assert run.certificate.accepted_steps >= 25
    assert (run.settings["first_step"], run.settings["max_step"]) == (1e-3, 2e-3)
    kept = load(tmp_path / "run.nc")
    for name, values in (("position", run.states.r), ("velocity", run.states.v)):
        assert (kept[name].values == values).all()


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ("tracker --servo.stiffness -1", "stiffness of the servo in joint 'T12' must"),
        ("tracker --stops.lower 1 2 3", "'stops.lower' must be 1 or 2 numbers [m]"),
        ("tracker --start.phi 1.5", "its rods do not reach so far"),
        ("hexacopter --motor.highest 300", "N are required"),
    ],
)
def test_options_that_make_no_sense_are_one_paragraph(words, what, capsys, monkeypatch):
    monkeypatch.setattr(simulate, "run_scene", None)
    assert cli.main(["simulate", *words.split(), "--no-cache"]) == 2
    error = capsys.readouterr().err
    assert what in error
    assert error.count("\n") == 1


def test_which_word_is_the_scene():
    for words, scene in (
        (["--out", "tracker", "spin"], "spin"), (["--loads", "spin"], "spin"), (["--t1", "3"], None),
    ):  # fmt: skip
        assert named_scene(simulate.Settings, words) == scene


@pytest.mark.parametrize("words", ["tracker --drag", "spin --save-evry 3"])
def test_an_option_that_a_scene_does_not_have(words, capsys):
    assert cli.main(["simulate", *words.split()]) == 2
    error = capsys.readouterr().err
    assert f"Unrecognized options: {words.split()[1]}" in error
    assert f"`stmuav simulate {words.split()[0]} --help` describes its options" in error
