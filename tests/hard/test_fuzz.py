"""Files of every format, mutated: each is read, or refused in one clear paragraph; nothing else.

A mutation deletes, doubles, cuts or swaps lines, puts other numbers, words or characters into them, or
flips bytes. 10,000 of each format are the slow tests, 150 the others.
"""

import contextlib
import io
import random
import re
import shutil
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from jobs.toy import Toy

import stmuav_jax as stm
from stmuav_jax.algebra.least_squares import Search, SearchReason
from stmuav_jax.checks.errors import ModelError, SettingError, StateError
from stmuav_jax.checks.schema import checked
from stmuav_jax.commands.models.tuning import read_record
from stmuav_jax.figures.day import load_attitude
from stmuav_jax.figures.tuning import load_search, save_search
from stmuav_jax.files import FileError, model_file
from stmuav_jax.files.labelled import Labelled
from stmuav_jax.files.model_schema import ModelFile
from stmuav_jax.files.netcdf import (
    LOOP_FORMAT,
    LOOP_VERSION,
    _seal,
    labelled,
    read_toml,
    save_checkpoint,
    save_sealed,
)
from stmuav_jax.files.store import create, open_store
from stmuav_jax.missions import keep
from stmuav_jax.missions.schema import MissionFile, MissionStudyFile
from stmuav_jax.montecarlo import schema
from stmuav_jax.parameters import PART_II
from stmuav_jax.quadrotor import PART_III

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


def flipped(content: bytes, rng: random.Random) -> bytes:
    """Bytes that are cut, or some of them others."""
    if rng.random() < 0.2:
        return content[: rng.randrange(len(content))]
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8, 100))):
        # headers are a small part of a file
        found[rng.randrange(min(len(found), rng.choice((200, 5000, len(found)))))] = rng.randrange(
            256
        )
    return bytes(found)


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


def fuzzed(use, path, contents, mutate, count, seed=0):
    """Use of mutated files: how many were read; any other error than a refusal is a failure."""
    rng, read = random.Random(seed), 0
    for k in range(count):
        content = mutate(rng.choice(contents), rng)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
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
SEARCH = Search(
    {"a": jnp.arange(3.0), "b": jnp.asarray(2.0)}, 0.5, (2.0, 0.5, 0.7), 1, SearchReason.STEPS
)


def as_record(path):
    read_record(path, ["hinge.angle", "hinge.angle_rate"], SimpleNamespace(names=[("effort", "N")]))


def as_search(path):
    load_search(path, "a problem", SEARCH.values)


def as_model(path):
    checked(ModelFile, read_toml(path), "A model")


def as_mission(path):
    checked(MissionFile, {"name": "x"} | read_toml(path), "A mission")


def as_study(path):
    schema.flights_file(stm.files.load_study(path))


def as_study_of_missions(path):
    checked(MissionStudyFile, stm.files.load_study(path), "A study of a mission")


# use, contents, mutation
FORMATS = {
    "model": (as_model, MODELS, mutated),
    "mission": (as_mission, MISSIONS, mutated),
    "study": (as_study, [STUDY], mutated),
    "study of a mission": (as_study_of_missions, [STUDY_OF_MISSIONS], mutated),
    "parameters of the UAV": (
        lambda path: stm.files.load_parameters(path, PART_II), [table_text(PART_II)], mutated,
    ),
    "parameters of the quadrotor": (
        lambda path: stm.files.load_parameters(path, PART_III), [table_text(PART_III)], mutated,
    ),
    "column of numbers": (lambda path: stm.files.column(path, "force"), [NUMBERS], mutated),
    "column of numbers, bytes": (
        lambda path: stm.files.column(path, "force"), [NUMBERS.encode()], flipped,
    ),
    "attitudes": (load_attitude, [ATTITUDES], mutated),
    "attitudes, bytes": (load_attitude, [ATTITUDES.encode()], flipped),
    "record": (as_record, [RECORD], mutated),
    "record, bytes": (as_record, [RECORD.encode()], flipped),
}  # fmt: skip
COUNTS = [150, pytest.param(10_000, marks=pytest.mark.slow)]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", FORMATS)
def test_texts(name, count, tmp_path):
    """Some inputs are still valid, so that the mutations get behind the first check."""
    use, contents, mutate = FORMATS[name]
    # the two tables are one format
    count //= 1 + name.startswith("parameters")
    read = fuzzed(use, tmp_path / "file.toml", contents, mutate, count)
    assert 0.02 * count < read < 0.9 * count


@pytest.mark.parametrize("count", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_systems_of_models(count, tmp_path, monkeypatch):
    """Bodies, joints and forces of models that have passed the first check; without a start."""
    monkeypatch.setattr(model_file, "_start", lambda system, given, table: system.reference)
    read = fuzzed(stm.files.load_model, tmp_path / "file.toml", MODELS, mutated, count, seed=1)
    assert 0.05 * count < read < 0.9 * count


@pytest.mark.parametrize("count", COUNTS)
def test_results(count, short_run, tmp_path):
    """A run's file has a checksum for every part: what is read is what was saved."""
    content = stm.files.save(short_run, tmp_path / "run.nc").read_bytes()

    def use(path):
        stm.files.load(path).close()

    assert fuzzed(use, tmp_path / "broken.nc", [content], flipped, count) < 0.01 * count + 1


def flight_arrays() -> Labelled:
    """A file like those of closed loops: numbers, names and attributes."""
    rows = {"command": (("time", "input"), np.ones((50, 2)), "N", "inputs from the controller")}
    coordinates = {
        "time": (("time",), np.linspace(0, 1, 50), {"units": "s"}), "input": ["left", "right"],
    }  # fmt: skip
    about = {"format": LOOP_FORMAT, "format_version": LOOP_VERSION, "certificate": {"t_end": 1.0}}
    return labelled(rows, coordinates, **about)


@pytest.mark.parametrize("count", COUNTS)
def test_flights(count, tmp_path):
    """Flights of missions (flight.nc), as written by `stmuav fly`."""
    content = save_sealed(flight_arrays(), tmp_path / "flight.nc").read_bytes()

    def use(path):
        stm.files.load(path).close()

    use(tmp_path / "flight.nc")
    assert fuzzed(use, tmp_path / "broken.nc", [content], flipped, count) < 0.01 * count + 1


def sealed_again(content: bytes, rng: random.Random) -> bytes:
    """Bytes with some of them others, or the text of their head mutated, and a new seal."""
    if rng.random() < 0.5:
        bare = flipped(content, rng)
        return bare + _seal(bare)
    with np.load(io.BytesIO(content)) as found:
        parts = {name: found[name] for name in found.files}
    parts["head"] = np.array(mutated(str(parts["head"]).replace(", ", ",\n"), rng))
    again = io.BytesIO()
    np.savez(again, **parts)
    return again.getvalue() + _seal(again.getvalue())


def unsealed(path: Path) -> bytes:
    """Content of a sealed file."""
    whole = path.read_bytes()
    return whole[: -len(_seal(b""))]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("mutate", [flipped, sealed_again])
def test_checkpoints_of_searches(mutate, count, tmp_path):
    """What a search goes on from is what was saved; also with a seal nothing else ends it."""
    path = save_search(SEARCH, "a problem", tmp_path / "search.npz")
    as_search(path)
    content = path.read_bytes() if mutate is flipped else unsealed(path)
    read = fuzzed(as_search, tmp_path / "broken.npz", [content], mutate, count)
    assert read < (0.01 if mutate is flipped else 0.5) * count + 1


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("mutate", [flipped, sealed_again])
def test_checkpoints_of_flights(mutate, count, tmp_path):
    """Unfinished flights of missions: their head, and the archive of their arrays."""
    head = {
        "format": keep._FORMAT, "mission": "x", "versions": {"jax": "1"}, "soc": 0.9,
        "seconds": [1.0, 2.0], "signals": ["thrust"],
    }  # fmt: skip
    path = save_checkpoint(tmp_path / "unfinished.npz", head, [np.arange(50) / 100])
    keep._content(path)
    content = path.read_bytes() if mutate is flipped else unsealed(path)
    read = fuzzed(keep._content, tmp_path / "broken.npz", [content], mutate, count)
    assert read < (0.01 if mutate is flipped else 0.5) * count + 1


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


@pytest.mark.parametrize("count", [30, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("text", [ROBOT, URDF], ids=["MJCF", "URDF"])
def test_robots(text, count, tmp_path, monkeypatch):
    """Files that MuJoCo's parser reads or refuses; it writes its log into the present folder."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / ("robot.urdf" if text is URDF else "robot.xml")
    read = fuzzed(stm.files.load_robot, path, [text], mutated, count, seed=2)
    assert 0.02 * count < read < 0.9 * count


@pytest.mark.parametrize("count", COUNTS)
def test_stores(count, tmp_path):
    """Descriptions, records and chunks of a study's store."""
    work, whole = Toy(seed=3), tmp_path / "whole.zarr"
    with create(whole, work, 100, 30) as store:
        for chunk in store.pending:
            store.write(chunk, work.run(*store.todo(chunk)))
    exact = open_store(whole).load()
    copy = Path(shutil.copytree(whole, tmp_path / "copy.zarr"))
    files = sorted(path for path in copy.rglob("*") if path.is_file())
    rng = random.Random(5)
    for k in range(count):
        path = rng.choice(files)
        content = path.read_bytes()
        if content:
            as_text = path.suffix == ".json" and rng.random() < 0.5
            path.write_bytes(
                mutated(content.decode(), rng).encode() if as_text else flipped(content, rng)
            )
        # texts about the study may differ, numbers may not
        with contextlib.suppress(*REFUSALS), alarm():
            assert open_store(copy).load().equals(exact), (k, path, path.read_bytes())
        path.write_bytes(content)
