"""A study in this process: complete, resumable, bounded, and the same whatever befell it."""

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from studies.toy import Toy, contents

from stmuav_jax.checks.errors import SettingError, SimulationError
from stmuav_jax.io.netcdf import FileError
from stmuav_jax.studies import StudyProgress, open_store

HERE = Path(__file__).parent
WORK = Toy(seed=7)


def run_whole(path: Path, **settings):
    return WORK.run(path, 1000, chunk=150, **settings)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of an unbroken run of 1000 samples in chunks of 150."""
    path = tmp_path_factory.mktemp("whole") / "study.zarr"
    run_whole(path)
    return contents(path)


def test_a_run_has_all_samples(tmp_path, whole):
    seen: list[StudyProgress] = []
    path = tmp_path / "deep" / "study.zarr"
    outcome = run_whole(path, progress=seen.append)
    assert outcome[:4] == (path, 1000, 1000, 1000)
    assert not outcome.interrupted
    assert "holds all 1000 samples, 1000 of them computed now" in outcome.describe()
    assert [now.completed for now in seen] == [0, 150, 300, 450, 600, 750, 900, 1000]
    found = open_store(path).load()
    for name, values in WORK.compute(0, 1000).items():
        np.testing.assert_array_equal(found[name].values, values, strict=True)
    assert contents(path) == whole


def test_numbers_do_not_depend_on_the_chunk(tmp_path):
    for chunk in (1, 7, 40):
        WORK.run(tmp_path / f"{chunk}.zarr", 40, chunk=chunk)
    first, *others = [open_store(tmp_path / f"{chunk}.zarr").load() for chunk in (1, 7, 40)]
    for other in others:
        for name in first.data_vars:
            np.testing.assert_array_equal(first[name].values, other[name].values)


@pytest.mark.parametrize("befalls", ["removed", "renamed", "replaced", "at the end"])
def test_a_store_that_is_gone_holds_nothing(tmp_path, befalls):
    """The run ends with the next chunk; a renamed store is resumed where it is."""
    path, moved = tmp_path / "study.zarr", tmp_path / "moved.zarr"
    last = 1000 if befalls == "at the end" else 450

    def interfere(now: StudyProgress) -> None:
        if now.completed != last:
            return
        if befalls in ("renamed", "replaced"):
            path.rename(moved)
        else:
            shutil.rmtree(path)
        if befalls == "replaced":
            shutil.copytree(moved, path)

    with pytest.raises(
        FileError, match=r"study\.zarr was removed, renamed or replaced while the study ran"
    ):
        run_whole(path, progress=interfere)
    if befalls == "renamed":
        outcome = WORK.run(moved, 1000, resume=True)
        assert (outcome.completed, outcome.computed) == (1000, 550)


def test_extended_and_refused(tmp_path, whole):
    path = tmp_path / "study.zarr"
    WORK.run(path, 400, chunk=150, resume=True)
    assert WORK.run(path, 1000, resume=True).computed == 600
    assert contents(path) == whole
    with pytest.raises(FileError, match=r"study\.zarr exists: resume it"):
        run_whole(path)
    with pytest.raises(SettingError, match="can grow, not shrink to 999"):
        WORK.run(path, 999, resume=True)
    with pytest.raises(SettingError, match="chunks of 150 samples, which cannot change to 200"):
        WORK.run(path, 1000, chunk=200, resume=True)
    with pytest.raises(FileError, match="seed is 7 there and 8 here"):
        Toy(seed=8).run(path, 1000, resume=True)
    with pytest.raises(SettingError, match="chunk's samples must be 1 or more, not 0"):
        WORK.run(tmp_path / "other.zarr", 10, chunk=0)
    # all of these have let go of the store
    assert WORK.run(path, 1000, resume=True).computed == 0


@pytest.mark.parametrize("words", ["", "RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes."])
def test_chunks_that_do_not_fit_in_memory_are_halved(tmp_path, whole, words):
    path = tmp_path / "study.zarr"
    work = Toy(seed=7, most=40, words=words, together=20, log=str(tmp_path / "log"))
    work.run(path, 1000, chunk=150)
    assert contents(path) == whole
    calls = [int(line.split()[2]) for line in (tmp_path / "log").read_text().splitlines()]
    assert set(calls[:4]) == {150, 80, 40}
    with pytest.raises(SimulationError, match="Sample 0 alone does not fit in memory"):
        Toy(most=0, words="").run(tmp_path / "none.zarr", 100, chunk=10)


def test_lack_of_memory_is_told_from_other_errors_of_jax(tmp_path):
    """JAX itself, asked for 800 TB for more than 10 samples."""

    class Large(Toy):
        def compute(self, first, count):
            if count > 10:
                jnp.zeros(10**14).block_until_ready()
            return Toy.compute(self, first, count)

    assert Large().run(tmp_path / "study.zarr", 80, chunk=40).completed == 80


def test_a_work_that_fails_keeps_what_was_done(tmp_path, whole):
    path = tmp_path / "study.zarr"

    class Broken(Toy):
        def compute(self, first, count):
            if first >= 450:
                raise RuntimeError("a bug")
            return Toy.compute(self, first, count)

    with pytest.raises(RuntimeError, match="a bug"):
        Broken(seed=7).run(path, 1000, chunk=150)
    assert open_store(path).finished == 450
    WORK.run(path, 1000, resume=True)
    assert contents(path) == whole


def test_a_chunk_is_by_default_what_is_best_computed_together(tmp_path):
    Toy(together=48).run(tmp_path / "a.zarr", 100)
    assert open_store(tmp_path / "a.zarr").chunk == 48
    # 61 bytes a sample in 64 MiB
    Toy(together=10**9).run(tmp_path / "b.zarr", 100)
    assert open_store(tmp_path / "b.zarr").chunk == 2**26 // 61


@pytest.mark.slow
def test_killed_at_random_moments(tmp_path):
    """SIGKILL, again and again: the store ends with the same files as an unbroken run's."""
    kills = 4
    path, total = tmp_path / "killed.zarr", 20 * 14 * kills
    command = [sys.executable, HERE / "killed.py", path, *map(str, (total, 20, kills, kills))]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    stages = [int(word) for word in done.stdout.split()]
    assert len(stages) == kills
    # at different stages, and none of them at the end
    assert len(set(stages)) > kills // 2
    assert max(stages) < total
    Toy(seed=7, more=4).run(tmp_path / "unbroken.zarr", total, chunk=20)
    assert contents(path) == contents(tmp_path / "unbroken.zarr")


# A shell that starts the tests in the background has them ignore Ctrl-C, which processes inherit.
INTERRUPTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, {tests!r})
from studies.toy import Toy
show = lambda now: print(now.completed, now.note, flush=True)
print(Toy(seed=7, pause={pause}).run({path!r}, 1000, chunk=10, progress=show).describe())
"""


@pytest.mark.slow
def test_a_signal_ends_a_run_after_its_chunk(tmp_path):
    path = tmp_path / "study.zarr"
    code = INTERRUPTED.format(tests=str(HERE.parent), path=str(path), pause=0.2)
    command = [sys.executable, "-W", "error", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line.split()[0]) >= 50:
                break
        process.send_signal(signal.SIGTERM)
        rest = process.stdout.read().splitlines()
    assert process.returncode == 0
    done = open_store(path).finished
    assert 50 <= done < 100
    assert any("Stopping after the present chunk" in line for line in rest)
    assert rest[-1].startswith(f"Interrupted: {path} keeps {done} of 1000")
    WORK.run(path, 1000, resume=True)
    WORK.run(tmp_path / "unbroken.zarr", 1000, chunk=10)
    assert contents(path) == contents(tmp_path / "unbroken.zarr")


@pytest.mark.slow
def test_a_second_signal_ends_a_run_at_once(tmp_path):
    path = tmp_path / "study.zarr"
    code = INTERRUPTED.format(tests=str(HERE.parent), path=str(path), pause=600.0)
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().split() == ["0"]
        process.send_signal(signal.SIGINT)
        assert "Stopping" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=300)
    assert process.returncode != 0
    assert "KeyboardInterrupt" in errors
    assert open_store(path).finished == 0


MILLION = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from studies.toy import Toy
# not getrusage: what that says starts at the size of the process that started this one
words = lambda: Path("/proc/self/status").read_text().split("VmHWM:")[1].split()
most = lambda: int(words()[0]) / 2**10
work = Toy(more=20)
work.run({path!r} + "/small.zarr", 40000, chunk=10000)
small = most()
outcome = work.run({path!r} + "/large.zarr", 1000000, chunk=10000)
print(outcome.completed, small, most())
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells the peak")
def test_memory_is_that_of_a_chunk(tmp_path):
    """221 MB of results, and no more memory than for 9 MB of them."""
    code = MILLION.format(tests=str(HERE.parent), path=str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    small, large = map(float, done[1:])
    assert done[0] == "1000000"
    assert large < small + 40
