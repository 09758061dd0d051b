"""Options of scenes on the command line: the same scenes, clear refusals, new scenes."""

import subprocess
import sys

import equinox as eqx
import pytest

import stmuav_jax as stm
from stmuav_jax import cli
from stmuav_jax.checks.errors import SettingError
from stmuav_jax.commands import simulate
from stmuav_jax.commands.scene_options import scene_among
from stmuav_jax.commands.simulate import scene_of
from stmuav_jax.files.netcdf import load
from stmuav_jax.montecarlo.study import study_from_plain
from stmuav_jax.scenes import BaseStart, Drag, FlightStart, Gear, Motor, Wind
from stmuav_jax.scenes.registry import SCENES, RegisteredScene
from stmuav_jax.tracker import Friction, PanelStart, Servo, Stops, Strokes


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
    "hexacopter --gear.friction 0.5 --gear.depth 0.25 --start.z 0.1": (
        None, {"gear": Gear(friction=0.5, depth=0.25), "start": BaseStart(z=0.1)},
    ),
    "uav_tracker --gear": (None, {"gear": Gear()}),
    "uav_tracker --actuators printed": (None, {"actuators": "printed"}),
}  # fmt: skip


@pytest.mark.parametrize("words", LINES)
def test_the_scene_of_the_words_is_that_of_the_options(words):
    case, options = LINES[words]
    name, given = cli._read(["simulate", *words.split()])
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
    _, command = cli._read(["simulate", *words.split()])
    found = simulate.method_of(command.settings, scene_of(command))
    wanted = stm.Method(
        solver=stm.dynamics.kvaerno5(), formulation=stm.Augmented(), rtol=1e-9, atol=1e-7,
        max_steps=77, first_step=1e-3, max_step=0.02, jump_ts=[0.2, 0.1],
        stabilisation=stm.Baumgarte(5.0, 6.0, 7.0),
    )  # fmt: skip
    assert eqx.tree_equal(found, wanted)
    _, command = cli._read(["simulate", "spin"])
    assert eqx.tree_equal(simulate.method_of(command.settings, scene_of(command)), stm.Method())


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
        ("tracker --drag", "tracker has no drag. Options of its own: --servo, --stops, --friction"),
        ("spin --save-evry 3", "spin has no save-evry. Did you mean --save-every?"),
        ("spin --servo.stiffness 3", "spin has no servo. Options of its own: none"),
        ("hexacopter --motor.tau 3", "There is no --motor.tau; hexacopter has --motor.highest"),
        ("tracker --servo.stiffness -1", "stiffness of the servo in joint 'T12' must"),
        ("tracker --servo.stiffness nan", "'servo.stiffness' must be finite"),
        ("tracker --stops.lower 1 2 3", "'stops.lower' must be 1 or 2 numbers [m]"),
        ("tracker --friction.speed 0", "speed of the friction in joint 'T12' must be positive"),
        ("tracker --start.phi 1.5", "its rods do not reach so far"),
        ("tracker --strokes.duration 0", "duration of the strokes' rise must be positive"),
        (
            "hexacopter --gear.width 0",
            "width of the ground contact of body 'hexacopter' must be positive",
        ),
        ("hexacopter --gear.feet 4", "There is no --gear.feet; hexacopter has --gear.damping"),
        ("hexacopter --wind", "Wind acts through the airframe's drag"),
        ("hexacopter --drag --wind.gusts --wind.mean 0 0 0", "must not be zero"),
        ("hexacopter --motor.highest 300", "N are required"),
    ],
)
def test_options_that_make_no_sense_are_one_paragraph(words, what, capsys, monkeypatch):
    monkeypatch.setattr(simulate, "run_scene", None)
    assert cli.main(["simulate", *words.split(), "--no-cache"]) == 2
    error = capsys.readouterr().err
    assert what in error
    assert error.count("\n") == 1


def test_help_names_units_and_needs_no_jax():
    code = (
        "import sys; from stmuav_jax.cli import main\n"
        "assert main(['simulate', '--help']) == 0\n"
        "for name in ('spin', 'tracker', 'hexacopter', 'uav_tracker'):\n"
        "    assert main(['simulate', name, '--help']) == 0\n"
        "assert main(['simulate', 'tracker', '--drag']) == 2\n"
        "assert not {'jax', 'scipy', 'pydantic'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, timeout=120, capture_output=True, text=True
    )
    words = " ".join(done.stdout.replace("│", " ").split())
    for part in (
        "--servo.stiffness FLOAT Stiffness [N/m]. (default: the scene's)",
        "--wind.mean FLOAT FLOAT FLOAT Mean wind in world axes [m/s].",
        "--motor Motors of the rotors with lag, inertia and limits.",
        "--actuators {None,consistent,printed}",
    ):
        assert part in words


def test_which_word_is_the_scene():
    assert scene_among(["--out", "tracker", "spin"], ["--loads"]) == "spin"
    assert scene_among(["--loads", "spin"], ["--loads"]) == "spin"
    assert scene_among(["--t1", "3"], []) is None


SWING = '''
"""A pendulum as a scene of a user's own."""

from dataclasses import dataclass

import jax.numpy as jnp

import stmuav_jax as stm
from stmuav_jax.checks.quantity import quantity
from stmuav_jax.parameters import PART_I


@dataclass(frozen=True)
class Push:
    """Push of the arm."""

    force: tuple[float, float, float] = quantity("force", "N", 3, default=(0.0, 0.0, 0.0))


def swing(parameters=PART_I, *, length: float = 1.0, push: Push | None = None):
    """Args:
        length: of the arm [m]. push: a constant force on it.
    """
    arm = stm.Body("arm", 1.0, jnp.eye(3), position=(length, 0.0, 0.0))
    pivot = stm.revolute("pivot", stm.GROUND, "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    forces = [] if push is None else [stm.AppliedForce("arm", jnp.asarray(push.force))]
    system = stm.System([arm], [pivot], forces)
    table = parameters.to_dict()
    return stm.Scene("swing", "A swing", system, system.reference, t1=1.0, parameters=table)
'''


def test_a_new_scene_is_one_file_and_one_line(tmp_path, monkeypatch, capsys):
    """The command line and studies know it and its options."""
    (tmp_path / "swing.py").write_text(SWING)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(SCENES, "swing", RegisteredScene("swing", "a pendulum", "none", 1.0))
    assert cli.main(["list"]) == 0
    assert "a pendulum" in capsys.readouterr().out
    assert cli.main(["simulate", "swing", "--help"]) == 0
    words = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "of the arm [m]. (default: 1.0)" in words
    assert "--push.force FLOAT FLOAT FLOAT Force [N]. (default: 0 0 0)" in words
    line = "simulate swing --length 2 --push.force 1 0 0"
    scene = scene_of(cli._read(line.split())[1])
    assert float(scene.system.reference.r[0, 0]) == 2.0
    assert len(scene.system.forces) == 1
    study = study_from_plain(
        {
            "scene": "swing", "options": {"length": 2.0, "push": {"force": [1.0, 0.0, 0.0]}},
            "factors": {"spin.moment": 1.0}, "t1": 0.1,
            "quantities": {"energy": {"signal": "energy", "take": "final"}},
        }
    )  # fmt: skip
    system, start = study.flights.nominal()
    assert eqx.tree_equal(system, scene.system)
    assert eqx.tree_equal(start, scene.state0)
    assert study.plain()["options"]["length"] == 2.0
    with pytest.raises(SettingError, match="Scene swing has no drag; its options: length, push"):
        study_from_plain(
            {"scene": "swing", "options": {"drag": {}}, "factors": {"spin.moment": 1.0},
             "quantities": {"energy": {"signal": "energy", "take": "final"}}}
        )  # fmt: skip
