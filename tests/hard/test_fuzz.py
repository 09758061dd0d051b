"""Texts of every format, mutated: each is read, or refused in one clear paragraph; nothing else.

A mutation deletes, doubles, cuts or swaps lines, or puts other numbers, words or
characters into them. 100 of each format are tried.
"""

import contextlib
import random
import re
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.checks.errors import ModelError, SettingError, StateError
from stmuav_jax.checks.schema import validate_model
from stmuav_jax.cli.identify import read_record
from stmuav_jax.figures.day import load_attitude
from stmuav_jax.io import FileError, model_file
from stmuav_jax.io.model_schema import ModelFile
from stmuav_jax.io.netcdf import read_toml
from stmuav_jax.missions.schema import MissionFile, MissionStudyFile
from stmuav_jax.studies import schema
from stmuav_jax.uav import PART_II, PART_III

ROOT = Path(__file__).parents[2]
REFUSALS = (FileError, ModelError, SettingError, StateError)
# seconds of computing that no input may take
PATIENCE = 10.0

VALUES = (
    "nan", "inf", "-inf", "0", "-1", "1e308", "1e-308", "1e400", "true", "[]", "{}", '""', '"x"', "[1, 2]",
    "[[1.0]]", "2024-01-01", "9" * 400, '"\\u0000"', "-0.0", "[nan, 0, 1]", "7", "1e9", "1e-9",
)  # fmt: skip
ODD = "\x00\t\"'[]{}=.,#-e\x7f\u4e2d"
NUMBER, WORD = re.compile(r"-?\d+\.?\d*(e-?\d+)?"), re.compile(r"[A-Za-z_]\w*")


def replaced(line: str, pattern: re.Pattern[str], other: str, rng: random.Random) -> str:
    """A line with one of the pattern's places replaced."""
    places = list(pattern.finditer(line))
    if not places:
        return line
    place = rng.choice(places)
    return line[: place.start()] + other + line[place.end() :]


def mutated(text: str, rng: random.Random) -> str:
    """Text with one to four mutations."""
    lines = text.split("\n")
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        k, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        line = lines[k]
        a, b = sorted(rng.randrange(len(line) + 1) for _ in range(2))
        match rng.randrange(9):
            case 0:
                lines = lines[:k] + lines[k + 1 :] or [""]
            case 1:
                lines.insert(k, lines[j])
            case 2:
                lines[k] = f"{line.split('=')[0]}= {rng.choice(VALUES)}"
            case 3:
                lines[k] = line[:a] + rng.choice(ODD) + line[a:]
            case 4:
                lines = lines[: k + 1]
            case 5:
                lines[k] = line[:a] + line[b:]
            case 6:
                lines[k] = replaced(line, NUMBER, rng.choice(VALUES), rng)
            case 7:
                lines[k], lines[j] = lines[j], lines[k]
            case _:
                lines[k] = replaced(line, WORD, rng.choice(WORD.findall(text) or ["x"]), rng)
    return "\n".join(lines)


class Hangs(BaseException):
    """Alarm about an input that is neither read nor refused; nothing catches it by mistake."""


@contextlib.contextmanager
def alarm(seconds: float = PATIENCE) -> Iterator[None]:
    """Raise `Hangs` in the block once the process has computed for so long.

    Python acts on signals between its own instructions: of a library that never returns, and of a
    wait, the time limit of the tests tells.
    """

    def ring(number: int, frame: object) -> None:
        raise Hangs(f"No end after {seconds:g} s.")

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def test_an_input_that_hangs_is_found():
    def endless(path):
        while True:
            path.exists()

    with pytest.raises(Hangs, match=r"after 0\.2 s"), alarm(0.2):
        endless(ROOT)


def fuzzed(use, path, contents, count, seed=0):
    """Use of mutated files: how many were read; any other error than a refusal is a failure."""
    rng, read = random.Random(seed), 0
    for k in range(count):
        content = mutated(rng.choice(contents), rng)
        path.write_bytes(content.encode())
        try:
            with alarm(), warnings.catch_warnings():
                warnings.simplefilter("error")
                use(path)
        except REFUSALS as error:
            message = str(error)
        except (Exception, Hangs) as error:
            raise AssertionError(
                f"Input {k}: {type(error).__name__}: {error}\n{content!r}"
            ) from error
        else:
            message = "read"
        read += message == "read"
        assert 0 < len(message) < 3000, (k, content)
    return read


MODELS = [path.read_text() for path in sorted((ROOT / "docs" / "models").glob("*.toml"))]
MISSIONS = [
    path.read_text()
    for path in sorted((ROOT / "stmuav_jax" / "missions" / "library").glob("*.toml"))
]
STUDY = """scene = "uav_tracker"
case = 2
t1 = 1.0
samples = 64
seed = 7
design = "sobol"
rtol = 1e-8
every = 0.02
inputs = "case"
drag = true
correlation = [["start.p", "start.q", 0.5]]
[factors."start.p"]
distribution = "normal"
mean = 0.0
standard_deviation = 0.1
[factors."start.q"]
distribution = "uniform"
low = -0.1
high = 0.1
[factors."mass.panel_7"]
distribution = "truncated_normal"
mean = 1.0
standard_deviation = 0.1
low = 0.5
relative = true
[quantities]
fall = {signal = "pointing", take = "when_above", level = 0.5}
phi = {signal = "phi", take = "path"}
"""
STUDY_OF_MISSIONS = """kind = "missions"
mission = "gusts"
samples = 1000
seed = 1
t1 = 12.5
design = "latin"
stratum = 4
correlation = [["mass.panel_7", "rotor.k_f", -0.25]]
[factors."mass.panel_7"]
distribution = "normal"
mean = 1.0
standard_deviation = 0.05
relative = true
[factors."rotor.k_f"]
distribution = "uniform"
low = 0.5
high = 1.5
relative = true
"""
NUMBERS = "time,force\n" + "\n".join(f"{0.1 * k:.1f},{k * k}" for k in range(20)) + "\n"


def table_text(table):
    """Parameters as a file gives them, with their units."""
    entry = lambda name: (
        f'{name} = {{value = {np.asarray(table.value(name)).tolist()}, unit = "{table[name].unit}"}}'
    )
    return "\n".join(map(entry, table))


ATTITUDES = "t,roll,pitch,yaw\n" + "\n".join(
    f"{600 * k},{0.1 * k:.1f},-2.5,{k * k}" for k in range(20)
)
RECORD = "t,hinge.angle,hinge.angle_rate,effort\n" + "\n".join(
    f"{0.1 * k:.1f},{0.01 * k * k:.2f},{0.2 * k:.1f},1.5" for k in range(20)
)


def as_record(path):
    read_record(path, ["hinge.angle", "hinge.angle_rate"], SimpleNamespace(names=[("effort", "N")]))


def as_model(path):
    validate_model(ModelFile, read_toml(path), "A model")


def as_mission(path):
    validate_model(MissionFile, {"name": "x"} | read_toml(path), "A mission")


def as_study(path):
    validate_model(schema.FlightsFile, stm.studies.load_study(path), "A study")


def as_study_of_missions(path):
    validate_model(MissionStudyFile, stm.studies.load_study(path), "A study of a mission")


# use, contents
FORMATS = {
    "model": (as_model, MODELS),
    "mission": (as_mission, MISSIONS),
    "study": (as_study, [STUDY]),
    "study of a mission": (as_study_of_missions, [STUDY_OF_MISSIONS]),
    "parameters of the UAV": (
        lambda path: stm.io.load_parameters(path, PART_II), [table_text(PART_II)],
    ),
    "parameters of the quadrotor": (
        lambda path: stm.io.load_parameters(path, PART_III), [table_text(PART_III)],
    ),
    "column of numbers": (lambda path: stm.studies.column(path, "force"), [NUMBERS]),
    "attitudes": (load_attitude, [ATTITUDES]),
    "record": (as_record, [RECORD]),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_texts(name, tmp_path):
    """Some inputs are still valid, so that the mutations get behind the first check."""
    use, contents = FORMATS[name]
    # the two tables are one format
    count = 50 if name.startswith("parameters") else 100
    read = fuzzed(use, tmp_path / "file.toml", contents, count)
    assert 0.02 * count < read < 0.9 * count


def test_systems_of_models(tmp_path, monkeypatch):
    """Bodies, joints and forces of models that have passed the first check; without a start."""
    monkeypatch.setattr(model_file, "_read_start", lambda system, given, table: system.reference)
    read = fuzzed(stm.io.load_model, tmp_path / "file.toml", MODELS, 50, seed=1)
    assert 0.05 * 50 < read < 0.9 * 50


ROBOT = """<mujoco>
<option gravity="0 0 -9.81"/>
<worldbody>
<body name="arm" pos=".1 .2 .3" euler="20 0 40">
<geom type="box" size=".1 .05 .2" pos=".03 .02 .1" mass="2"/>
<joint name="a" axis="0 1 .2" pos="0 0 -.1" ref="30" stiffness="3" springref="50" damping=".2"/>
<body name="hand" pos="0 .1 .2" quat="1 2 3 4">
<geom type="box" size=".1 .05 .2" mass="1"/>
<joint name="d" type="ball" damping=".05"/>
</body>
</body>
</worldbody>
<equality>
<connect name="hung" body1="hand" anchor=".1 .2 .3"/>
</equality>
<actuator>
<motor name="push" joint="a" gear="3"/>
</actuator>
</mujoco>"""
URDF = """<robot name="r">
<link name="base"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><origin xyz="0.2 0 0" rpy="0 0.1 0"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.2" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="h" type="revolute">
<parent link="base"/>
<child link="arm"/>
<origin xyz="0 0 0.3" rpy="0.1 0 0"/>
<axis xyz="0 1 0"/>
<dynamics damping="0.3"/>
<limit lower="-1" upper="1" effort="10" velocity="3"/>
</joint>
</robot>"""


@pytest.mark.parametrize("text", [ROBOT, URDF], ids=["MJCF", "URDF"])
def test_robots(text, tmp_path, monkeypatch):
    """Files that MuJoCo's parser reads or refuses; it writes its log into the present folder."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / ("robot.urdf" if text is URDF else "robot.xml")
    read = fuzzed(stm.io.load_robot, path, [text], 30, seed=2)
    assert 0.02 * 30 < read < 0.9 * 30
