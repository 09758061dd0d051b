"""Files of every format, mutated: each is read, or refused in one clear paragraph; nothing else.

A mutation deletes, doubles, cuts or swaps lines, puts other numbers, words or characters into them, or
flips bytes. 10,000 of each format are the slow tests, 150 the others.
"""

import contextlib
import random
import re
import shutil
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from jobs.toy import Toy

import stmuav_jax as stm
from stmuav_jax.checks.errors import ModelError, SettingError, StateError
from stmuav_jax.checks.schema import checked
from stmuav_jax.files import FileError, model_file
from stmuav_jax.files.model_schema import ModelFile
from stmuav_jax.files.netcdf import read_toml
from stmuav_jax.files.store import create, open_store
from stmuav_jax.missions.schema import MissionFile
from stmuav_jax.montecarlo import schema
from stmuav_jax.parameters import PART_II
from stmuav_jax.quadrotor import PART_III

ROOT = Path(__file__).parents[2]
REFUSALS = (FileError, ModelError, SettingError, StateError)
# seconds that no input may take, on a machine with other work
PATIENCE = 30.0

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


def fuzzed(use, path, contents, mutate, count, seed=0):
    """Use of mutated files: how many were read; any other error than a refusal is a failure."""
    rng, read = random.Random(seed), 0
    for k in range(count):
        content = mutate(rng.choice(contents), rng)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        begin = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                use(path)
        except REFUSALS as error:
            message = str(error)
        except Exception as error:
            raise AssertionError(
                f"Input {k}: {type(error).__name__}: {error}\n{content!r}"
            ) from error
        else:
            message = "read"
        read += message == "read"
        assert 0 < len(message) < 3000, (k, content)
        assert time.process_time() - begin < PATIENCE, (k, content)
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
NUMBERS = "time,force\n" + "\n".join(f"{0.1 * k:.1f},{k * k}" for k in range(20)) + "\n"


def table_text(table):
    """Parameters as a file gives them, with their units."""
    entry = lambda name: (
        f'{name} = {{value = {np.asarray(table.value(name)).tolist()}, unit = "{table[name].unit}"}}'
    )
    return "\n".join(map(entry, table))


def as_model(path):
    checked(ModelFile, read_toml(path), "A model")


def as_mission(path):
    checked(MissionFile, {"name": "x"} | read_toml(path), "A mission")


def as_study(path):
    schema.flights_file(stm.files.load_study(path))


# use, contents, mutation
FORMATS = {
    "model": (as_model, MODELS, mutated),
    "mission": (as_mission, MISSIONS, mutated),
    "study": (as_study, [STUDY], mutated),
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
        with contextlib.suppress(*REFUSALS):
            assert open_store(copy).load().equals(exact), (k, path, path.read_bytes())
        path.write_bytes(content)
