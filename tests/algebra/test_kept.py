"""Kept programs: found again by another process, and never a wrong one, whatever lies in the folder."""

import os
import subprocess
import sys
import threading
from collections import OrderedDict
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.algebra import compiler, kept

A, B = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5, -1.0, 2.0])
EXPECTED = np.cross(A, B)


def cross(a, b):
    return jnp.cross(a, b)


def dot(a, b):
    return jnp.dot(a, b)


def squares(x):
    return x**2 - 2.0


def pair(layer, x):
    return {"twice": layer(2 * x), "name": ("words", 3)}


def called_back(a):
    return jax.pure_callback(np.sin, jax.ShapeDtypeStruct(a.shape, a.dtype), a)


def factors(a):
    return jnp.linalg.svd(a, compute_uv=False)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder where programs are kept during a test, those of this module too."""
    monkeypatch.setattr(kept, "_PACKAGES", (*kept._PACKAGES, __name__.partition(".")[0]))
    path = tmp_path / "programs"
    kept.keep_programs(path)
    yield path
    kept.keep_programs(None)


def result(function=cross, *args):
    """Result of a program that is loaded or compiled as if by a new process."""
    return compiled(function, *args)(*(args or (A, B)))


def compiled(function=cross, *args):
    """Program that is loaded or compiled as if by a new process."""
    given = args or (A, B)
    key = kept.key_of(function, given, compiler._asked(quick=True))
    return compiler._compiled(function, given, True, key)


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.program"))


def key(function=cross, *args, options=()):
    return kept.key_of(function, args or (A, B), options)


def test_a_kept_program_is_neither_traced_nor_compiled(folder, monkeypatch):
    np.testing.assert_array_equal(result(), EXPECTED)
    assert len(files(folder)) == 1
    monkeypatch.setattr(compiler, "_compiled_now", None)
    np.testing.assert_array_equal(result(), EXPECTED)
    other = compiled()(B, A)
    np.testing.assert_array_equal(other, -EXPECTED)


def test_nothing_is_kept_unless_it_is_asked_for(tmp_path):
    assert key() is None
    np.testing.assert_array_equal(result(), EXPECTED)
    assert kept.load("0" * 64) is None


def test_the_name_depends_on_all_that_the_program_depends_on(folder, monkeypatch):
    names = [
        key(),
        key(dot),
        key(cross, A, jnp.ones((3, 2))),
        key(cross, A, B.astype(jnp.float32)),
        key(cross, A, np.asarray(B)),
        key(cross, A, 2.0 * np.asarray(B)),
        key(options={"xla_backend_optimization_level": 1}),
        key(partial(cross, A), B),
        key(eqx.Partial(cross, A), B),
        key(cross, {"a": A}, B),
        key(cross, [A], B),
        key(cross, (A,), B),
        key(cross, 1, B),
        key(cross, True, B),
        key(cross, 1.0, B),
    ]
    assert None not in names
    for text in ("_processor", "_source", "_versions"):
        kept._platform.cache_clear()
        with monkeypatch.context() as changed:
            changed.setattr(kept, text, lambda: "another")
            names.append(key())
    kept._platform.cache_clear()
    with jax.enable_x64(False):
        names.append(key())
    assert len(set(names)) == len(names)
    assert key() == names[0]


def test_the_numbers_of_arrays_do_not_change_the_name(folder):
    assert key() == key(cross, B, A)


def test_what_no_text_describes_is_not_kept(folder):
    def own(a, b):
        return a + b

    own.__module__ = "of_the_user"
    for function in (own, partial(own, A)):
        assert key(function) is None
    assert key(cross, A, object()) is None
    assert key(cross, A, own) is None
    np.testing.assert_array_equal(result(own), A + B)
    assert not files(folder)


def test_functions_within_functions_are_told_apart(folder):
    def scaled(number):
        return lambda a, b: number * a + b

    same = lambda a, b: a * b
    functions = (scaled(2.0), scaled(3.0), same, lambda a, b: a / b)
    names = [key(function) for function in functions]
    assert None not in names
    assert len(set(names)) == 4
    assert key(scaled(2.0)) == names[0]


def test_numbers_that_become_part_of_the_program_change_its_name(folder):
    def scaled(number):
        return lambda a, b: number * a + b

    for one, other in (
        (scaled(jnp.asarray(2.0)), scaled(jnp.asarray(3.0))),
        (partial(dot, A), partial(dot, B)),
        (eqx.nn.Lambda(partial(dot, A)), eqx.nn.Lambda(partial(dot, B))),
    ):
        assert key(one) is not None
        assert key(one) != key(other)


@pytest.mark.parametrize("jit", [compiler.quick_jit, compiler.outer_jit])
def test_quick_and_outer_programs_are_kept_too(folder, monkeypatch, jit):
    monkeypatch.setattr(compiler, "_programs", OrderedDict())
    np.testing.assert_array_equal(jit(cross)(np.asarray(A), B), EXPECTED)
    assert len(files(folder)) == 1
    compiler._programs.clear()
    monkeypatch.setattr(compiler, "_compiled_now", None)
    np.testing.assert_array_equal(jit(cross)(np.asarray(B), A), -EXPECTED)


def test_the_name_of_a_program_is_made_once_for_arguments_of_one_form(folder, monkeypatch):
    made = []
    text = kept._text
    monkeypatch.setattr(kept, "_text", lambda x, *more: made.append(x) or text(x, *more))
    call = compiler.quick_jit(cross)
    np.testing.assert_array_equal(call(A, B), EXPECTED)
    count = len(made)
    np.testing.assert_array_equal(call(B, A), -EXPECTED)
    assert len(made) == count > 0
    # other settings of JAX may be another program
    with jax.default_matmul_precision("float32"):
        call(A, B)
    assert len(made) > count


def test_what_cannot_be_hashed_is_kept_by_its_text(folder):
    class Holds(eqx.Module):
        numbers: list = eqx.field(static=True)

    kept_before = len(files(folder))
    unhashable = Holds([1.0, 2.0])
    assert compiler._key_once(cross, (unhashable, A), quick=True) == kept.key_of(
        cross, (unhashable, A), compiler._asked(quick=True)
    )
    assert len(files(folder)) == kept_before


def test_programs_that_call_python_are_not_kept(folder):
    assert key(called_back, A) is not None
    np.testing.assert_allclose(result(called_back, A), np.sin(A))
    assert not files(folder)


def test_programs_that_call_lapack_and_searches_work_in_a_new_process(tmp_path):
    # without its initialisation LAPACK would end the process
    words = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
import jax; jax.config.update("jax_enable_x64", True)
from stmuav_jax.algebra import compiler, kept
import test_kept, numpy as np
kept._PACKAGES = (*kept._PACKAGES, "test_kept")
kept.keep_programs({str(tmp_path / "programs")!r})
a = jax.numpy.asarray(np.diag([3.0, 2.0, 1.0]), dtype=float)
loaded = kept.load(kept.key_of(test_kept.factors, (a,), compiler._NO_LIBRARY | compiler._QUICK))
print(test_kept.compiled(test_kept.factors, a)(a).tolist(), loaded is not None)
import optimistix as optx
from stmuav_jax.algebra.least_squares import search
made, compiled_now = [], compiler._compiled_now
compiler._compiled_now = lambda *args: made.append(args) or compiled_now(*args)
found = search(test_kept.squares, a, optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8))
print(len(made), found.history)
"""
    said = [
        subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    factored, searched = zip(*(x.stdout.splitlines() for x in said), strict=True)
    assert [x.split("] ")[1] for x in factored] == ["False", "True"]
    assert all(x.startswith("[3.0") for x in factored)
    made, histories = zip(*(x.split(" ", 1) for x in searched), strict=True)
    assert made == ("3", "0")
    assert histories[0] == histories[1]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: content[:-1],
        lambda content: content[:100] + bytes([content[100] ^ 1]) + content[101:],
        lambda content: b"x" * 1000,
    ],
    ids=["empty", "half", "one byte short", "one bit", "other content"],
)
def test_a_damaged_file_is_replaced(folder, damage):
    result()
    (path,) = files(folder)
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert kept.load(path.stem) is None
    assert not path.exists()
    np.testing.assert_array_equal(result(), EXPECTED)
    assert kept.load(path.stem) is not None


def test_the_file_of_another_program_is_not_taken(folder):
    result()
    (path,) = files(folder)
    other = path.with_name(f"{key(dot)}.program")
    path.rename(other)
    np.testing.assert_array_equal(result(dot), np.dot(A, B))


def test_a_program_that_cannot_be_loaded_is_compiled(folder, monkeypatch):
    result()

    def fails(*args, **more):
        raise RuntimeError("made for another processor")

    monkeypatch.setattr(kept.serialize_executable, "deserialize_and_load", fails)
    np.testing.assert_array_equal(result(), EXPECTED)


def test_a_full_or_read_only_disk_is_no_error(folder, monkeypatch):
    def full(*args, **more):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as changed:
        changed.setattr(kept.tempfile, "mkstemp", full)
        np.testing.assert_array_equal(result(), EXPECTED)
    with monkeypatch.context() as changed:
        changed.setattr(kept.os, "replace", full)
        np.testing.assert_array_equal(result(), EXPECTED)
    assert not list(folder.iterdir())


def test_a_folder_that_cannot_be_made_is_not_used(tmp_path):
    (tmp_path / "file").write_text("")
    kept.keep_programs(tmp_path / "file" / "programs")
    assert key() is None
    np.testing.assert_array_equal(result(), EXPECTED)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners of files here")
def test_what_others_may_write_is_not_read(folder, monkeypatch):
    result()
    (path,) = files(folder)
    path.chmod(0o666)
    assert kept.load(path.stem) is None
    path.chmod(0o600)
    assert kept.load(path.stem) is not None
    with monkeypatch.context() as changed:
        changed.setattr(kept.os, "getuid", lambda: path.stat().st_uid + 1)
        assert kept.load(path.stem) is None
    folder.chmod(0o777)
    kept.keep_programs(folder)
    assert key() is None


def test_the_oldest_files_are_removed_beyond_the_bound(folder, monkeypatch):
    for k, function in enumerate((cross, dot, partial(cross))):
        result(function)
        for path in files(folder):
            if path.stat().st_mtime > 1e6:
                os.utime(path, (k, k))
    sizes = {path.stat().st_mtime: path.stat().st_size for path in files(folder)}
    monkeypatch.setattr(kept, "MOST_BYTES", sizes[2] + sizes[1] + 1)
    kept._trim(folder)
    assert [path.stat().st_mtime for path in files(folder)].count(0) == 0
    assert len(files(folder)) == 2


def test_processes_that_write_at_once_leave_whole_files(folder):
    content = [bytes([k]) * 200_000 for k in range(4)]
    path, seen = folder / "x.program", []
    threads = [threading.Thread(target=kept._write, args=(path, part)) for part in content * 5]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        if path.exists():
            seen.append(path.read_bytes())
    assert seen
    assert set(seen) <= set(content)
    assert not list(folder.glob(".new-*"))


def test_structure_of_results_is_kept_too(folder):
    def outcome():
        return result(pair, eqx.nn.Identity(), A)

    first, second = outcome(), outcome()
    assert jax.tree.structure(first) == jax.tree.structure(second)
    assert second["name"] == ("words", 3)
    np.testing.assert_array_equal(first["twice"], second["twice"])


def test_a_model_of_the_package_has_a_text(folder):
    from stmuav_jax.dynamics.integration.problem import prepare
    from stmuav_jax.dynamics.method import Method
    from stmuav_jax.scenes.registry import make_scene

    scene = make_scene("hexacopter")
    problem = prepare(scene.system, Method())
    assert key(dot, problem, scene.state0) is not None
    other = prepare(scene.system, Method(max_steps=7))
    assert key(dot, other, scene.state0) != key(dot, problem, scene.state0)
    event = prepare(scene.system, Method(event=users))
    assert key(dot, event, scene.state0) is None


def users(t, state):
    return state.r[0, 2]


users.__module__ = "of_the_user"
