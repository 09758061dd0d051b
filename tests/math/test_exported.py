"""Kept programs: a process has the numbers of its own code, whatever another one has computed before."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from diffrax import RESULTS

import stmuav_jax as stm
from stmuav_jax.cli.main import _plain_options
from stmuav_jax.math.compiler import compile_for_shapes, keep_command_programs, quick_jit
from stmuav_jax.math.exported import Programs

pytest.importorskip("flatbuffers")
X = jnp.eye(3)
traced: list[str] = []


def outcome(x, name):
    """A result with all that a run's result has: arrays, modules, rows, enumerations, plain values."""
    traced.append(name)
    state = stm.State(2 * x, jnp.pad(x, ((0, 0), (0, 1))), jnp.linalg.inv(x + 1), -x)
    return (
        {1: "no text"}
        if name == "dict"
        else (state, RESULTS.successful, (None, "words", 3, x @ x), {"x": x})
    )


@pytest.fixture
def command(tmp_path):
    """Function that begins a command, as a new process would, of these plain data."""
    traced.clear()

    def begin(**data):
        programs = Programs(tmp_path / "programs", data)
        keep_command_programs(programs)
        return programs

    yield begin
    keep_command_programs(None)


def files(tmp_path):
    return sorted((tmp_path / "programs").glob("*.program"))


def test_the_same_command_traces_nothing_and_any_other_its_own(command, tmp_path):
    results = []
    for data in ({"t1": 1.0}, {"t1": 1.0}, {"t1": 2.0}):
        command(**data)
        results.append(compile_for_shapes(outcome, X, "a")(2 * X, "a"))
        assert jax.tree.structure(results[-1]) == jax.tree.structure(results[0])
        np.testing.assert_array_equal(results[-1][0].r, 4 * X)
        np.testing.assert_array_equal(results[-1][2][3], 4 * X)
        assert results[-1][2][1:3] == ("words", 3)
        assert results[-1][1] == RESULTS.successful
    assert traced == ["a", "a"]
    # another place in the order, structure, shape, type or options are other programs
    programs = command(t1=1.0)
    keys = [programs.next_key("outcome", (X, "a"), {}) for _ in range(2)]
    for arguments in ((X, "b"), (X[:2], "a"), (X.astype(jnp.float32), "a"), ([X], "a")):
        keys.append(command(t1=1.0).next_key("outcome", arguments, {}))
    keys.append(command(t1=1.0).next_key("outcome", (X, "a"), {"level": 1}))
    assert len({*keys}) == len(keys)
    assert command(t1=1.0).next_key("outcome", (X, "a"), {}) == keys[0]


def test_a_command_keeps_functions_under_quick_jit_too(command):
    for _ in range(2):
        command(t1=1.0)
        # a function of its own, as in a new process
        run = quick_jit(lambda x, name: outcome(x, name))
        np.testing.assert_array_equal(run(X, "a")[0].r, 2 * X)
        np.testing.assert_array_equal(run(X, "a")[3]["x"], X)
    assert traced == ["a"]


def test_a_mission_is_its_file_and_that_of_its_model(tmp_path):
    mission, model = tmp_path / "mission.toml", tmp_path / "model.toml"
    mission.write_text('[machine]\nmodel = "model.toml"\n')
    digests = {_plain_options(str(mission))}
    for text in ("mass = 1.0", "mass = 2.0"):
        model.write_text(text)
        digests |= {_plain_options(str(mission)), _plain_options(mission)}
    assert len(digests) == 3


def test_a_study_of_a_mission_is_their_files_and_that_of_the_model(tmp_path):
    study, mission, model = (tmp_path / f"{name}.toml" for name in ("study", "mission", "model"))
    study.write_text(f'mission = "mission.toml"\nother = ["study.toml", "{"x" * 500}"]\n')
    mission.write_text('[machine]\nmodel = "model.toml"\n')
    digests = set()
    for text in ("mass = 1.0", "mass = 2.0"):
        model.write_text(text)
        digests.add(_plain_options(study))
    assert len(digests) == 2


def test_files_named_like_scenes_do_not_make_these_equal(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("case-1", "case-2"):
        (tmp_path / name).touch()
    assert _plain_options("case-1") != _plain_options("case-2")


def test_what_has_no_text_or_is_damaged_is_compiled(command, tmp_path):
    command()
    compile_for_shapes(outcome, X, "dict")(X, "dict")
    compile_for_shapes(lambda x: jax.pure_callback(np.sin, x, x), X)(X)
    compile_for_shapes(lambda x: (x, eqx.nn.Lambda(lambda y: y)), X)(X)
    assert not files(tmp_path)
    for damage in (lambda b: b[:-1], lambda b: b"", lambda b: b.replace(b"State", b"Stale", 1)):
        command()
        compile_for_shapes(outcome, X, "a")
        (path,) = files(tmp_path)
        content = path.read_bytes()
        path.write_bytes(damage(content))
        count = len(traced)
        command()
        np.testing.assert_array_equal(compile_for_shapes(outcome, X, "a")(X, "a")[0].r, 2 * X)
        assert len(traced) == count + 1
        assert files(tmp_path) == [path]
        assert len(path.read_bytes()) == len(content)


PATCHED = """
import sys
import jax
import stmuav_jax as stm
from stmuav_jax.cli.main import main
gravity = stm.Gravity.load
stm.Gravity.load = lambda *given: jax.tree.map(lambda x: x / 6, gravity(*given))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_command_has_the_numbers_of_its_own_sources(tmp_path):
    """A process that has patched the package leaves nothing behind, and edited sources have their own programs."""
    package = tmp_path / "package"
    shutil.copytree(
        Path(stm.__file__).parent,
        package / "stmuav_jax",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    paths = [str(package), *(path for path in sys.path if not (Path(path) / "stmuav_jax").is_dir())]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(paths),
        "XDG_CACHE_HOME": str(tmp_path),
        "JAX_EXPLAIN_CACHE_MISSES": "1",
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
    }
    model = tmp_path / "pendulum.toml"
    shutil.copy(Path(__file__).parents[2] / "docs" / "models" / "pendulum.toml", model)
    words = ["simulate", str(model), "--t1", "0.1", "--figures", "none", "--out", str(tmp_path)]

    def fall(*python):
        """End of the run, and number of files of programs after it."""
        subprocess.run(
            [sys.executable, "-P", *python, *words],
            env=environment, check=True, capture_output=True, cwd=tmp_path,
        )  # fmt: skip
        with xr.open_dataset(tmp_path / "run.nc") as run:
            end = run.position.values[-1]
        return end, len(list((tmp_path / "stmuav_jax").glob("programs/*")))

    command = "-m", "stmuav_jax"
    moon, count = fall("-c", PATCHED)
    assert count == 0
    (earth, count), (again, same) = fall(*command), fall(*command)
    assert same == count > 3
    np.testing.assert_array_equal(again, earth)
    assert np.max(np.abs(earth - moon)) > 1e-3
    source = package / "stmuav_jax" / "mechanics" / "forces.py"
    original = source.read_text()
    force = "force = kin.mass[:, None] * self.acceleration[None]\n"
    edited = original.replace(force, force.strip() + " / 6\n")
    assert edited != original
    source.write_text(edited)
    on_edited, count = fall(*command)
    assert count == 2 * same
    np.testing.assert_allclose(on_edited, moon, atol=1e-9)
    source.write_text(original)
    # a model of the same name and structure with another constant
    text = model.read_text()
    weight = 'kind = "gravity"'
    model.write_text(text.replace(weight, weight + "\nacceleration = [0, 0, -1.635]"))
    assert model.read_text() != text
    np.testing.assert_allclose(fall(*command)[0], moon, atol=1e-9)
