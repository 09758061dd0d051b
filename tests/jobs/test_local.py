"""A study in this process: complete, resumable, bounded, and the same whatever befell it."""

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from jobs.toy import Toy, contents

from stmuav_jax.checks.errors import SettingError, SimulationError
from stmuav_jax.files.netcdf import FileError
from stmuav_jax.files.store import open_store
from stmuav_jax.jobs.compute import Pieces, chunk_size
from stmuav_jax.jobs.local import run_study
from stmuav_jax.jobs.progress import Meter, StudyProgress, duration
from stmuav_jax.jobs.watch import Watch

HERE = Path(__file__).parent
WORK = Toy(seed=7)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of an unbroken run of 1000 samples in chunks of 150."""
    path = tmp_path_factory.mktemp("whole") / "study.zarr"
    run_study(WORK, path, 1000, chunk=150)
    return contents(path)


def test_a_run(tmp_path, whole):
    seen: list[StudyProgress] = []
    path = tmp_path / "deep" / "study.zarr"
    outcome = run_study(WORK, path, 1000, chunk=150, progress=seen.append)
    assert outcome[:4] == (path, 1000, 1000, 1000)
    assert not outcome.interrupted
    assert "holds all 1000 samples, 1000 of them computed now" in outcome.words()
    assert [now.done for now in seen] == [0, 150, 300, 450, 600, 750, 900, 1000]
    assert seen[0].rate == 0
    assert seen[0].remaining == np.inf
    # nor by the first chunk, on the way to which code is compiled
    assert seen[1].rate == 0
    assert all(now.rate > 0 for now in seen[2:])
    assert seen[-1].remaining == 0
    found = open_store(path).load()
    for name, values in WORK.run(0, 1000).items():
        np.testing.assert_array_equal(found[name].values, values, strict=True)
    assert contents(path) == whole


def test_the_chunk_does_not_matter(tmp_path):
    for chunk in (1, 7, 40):
        run_study(WORK, tmp_path / f"{chunk}.zarr", 40, chunk=chunk)
    first, *others = [open_store(tmp_path / f"{chunk}.zarr").load() for chunk in (1, 7, 40)]
    for other in others:
        for name in first.data_vars:
            np.testing.assert_array_equal(first[name].values, other[name].values)


def test_interrupted_and_resumed(tmp_path, whole):
    path = tmp_path / "study.zarr"

    def stop(now: StudyProgress) -> None:
        if now.done == 450:
            raise KeyboardInterrupt

    outcome = run_study(WORK, path, 1000, chunk=150, progress=stop)
    assert outcome.interrupted
    # the chunk that was at hand is written too
    assert outcome.done in (450, 600)
    assert f"keeps {outcome.done} of 1000 samples" in outcome.words()
    assert open_store(path).finished == outcome.done
    with pytest.raises(FileError, match=r"study\.zarr exists; go on with it"):
        run_study(WORK, path, 1000, chunk=150)
    rest = run_study(WORK, path, 1000, resume=True)
    assert (rest.done, rest.computed) == (1000, 1000 - outcome.done)
    assert contents(path) == whole
    assert run_study(WORK, path, 1000, resume=True).computed == 0


def test_interrupted_twice(tmp_path, whole):
    """In a chunk, and again while the one before is waited for: no more words, and a valid store."""
    path = tmp_path / "study.zarr"

    class Stopped(Toy):
        def run(self, first, count):
            if first == 450:
                raise KeyboardInterrupt
            return Toy.run(self, first, count)

    def stop(now: StudyProgress) -> None:
        if now.done == 450:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(Stopped(seed=7), path, 1000, chunk=150, progress=stop)
    assert open_store(path).finished == 450
    assert run_study(WORK, path, 1000, resume=True).computed == 550
    assert contents(path) == whole


def test_extended(tmp_path, whole):
    path = tmp_path / "study.zarr"
    run_study(WORK, path, 400, chunk=150, resume=True)
    grown = run_study(WORK, path, 1000, resume=True)
    assert grown.computed == 600
    assert contents(path) == whole
    with pytest.raises(SettingError, match="can grow, not shrink to 999"):
        run_study(WORK, path, 999, resume=True)
    with pytest.raises(SettingError, match="chunks of 150 samples, and keeps them; not 200"):
        run_study(WORK, path, 1000, chunk=200, resume=True)
    with pytest.raises(FileError, match="seed is 7 there and 8 here"):
        run_study(Toy(seed=8), path, 1000, resume=True)
    with pytest.raises(SettingError, match="chunk's samples must be 1 or more, not 0"):
        run_study(WORK, tmp_path / "other.zarr", 10, chunk=0)
    # all of these have let go of the store
    assert run_study(WORK, path, 1000, resume=True).done == 1000


@pytest.mark.parametrize("words", ["", "RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes."])
@pytest.mark.parametrize(
    ("most", "limits"), [(149, [80]), (40, [80, 40]), (3, [80, 40, 20, 10, 5, 3])]
)
def test_chunks_that_do_not_fit(tmp_path, whole, words, most, limits):
    seen: list[StudyProgress] = []
    path = tmp_path / "study.zarr"
    work = Toy(seed=7, most=most, words=words, together=20, log=str(tmp_path / "log"))
    outcome = run_study(work, path, 1000, chunk=150, progress=seen.append)
    assert contents(path) == whole
    # it says so once, and does not try too many again
    assert len(outcome.notes) == 1
    assert f"do not fit in memory; going on with {limits[-1]}." in outcome.notes[0]
    assert [now.note for now in seen if now.note] == list(outcome.notes)
    calls = [int(line.split()[2]) for line in (tmp_path / "log").read_text().splitlines()]
    assert [count for count in calls if count > most] == [150, *limits[:-1]]


def test_what_jax_says_of_memory(tmp_path):
    """JAX itself, asked for 800 TB for more than 10 samples."""

    class Large(Toy):
        def run(self, first, count):
            if count > 10:
                jnp.zeros(10**14).block_until_ready()
            return Toy.run(self, first, count)

    outcome = run_study(Large(), tmp_path / "study.zarr", 80, chunk=40)
    assert outcome.done == 80
    assert "20 samples at once do not fit in memory; going on with 10" in outcome.notes[0]


def test_a_sample_that_does_not_fit(tmp_path):
    with pytest.raises(SimulationError, match="Sample 0 does not fit in memory, though alone"):
        run_study(Toy(most=0, words=""), tmp_path / "study.zarr", 100, chunk=10)


def test_a_work_that_fails_keeps_what_was_done(tmp_path, whole):
    path = tmp_path / "study.zarr"

    class Broken(Toy):
        def run(self, first, count):
            if first >= 450:
                raise RuntimeError("a bug")
            return Toy.run(self, first, count)

    with pytest.raises(RuntimeError, match="a bug"):
        run_study(Broken(seed=7), path, 1000, chunk=150)
    # the chunk that was being written is there too
    assert open_store(path).finished == 450
    run_study(WORK, path, 1000, resume=True)
    assert contents(path) == whole


def test_a_disk_that_fails_ends_the_run(tmp_path, whole, monkeypatch):
    from stmuav_jax.files import store

    path, calls = tmp_path / "study.zarr", []

    def write_record(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        return real(*arguments)

    real = store.write_record
    monkeypatch.setattr(store, "write_record", write_record)
    with pytest.raises(FileError, match=r"disk is full: .* keeps 300 of 1000 samples"):
        run_study(WORK, path, 1000, chunk=150)
    run_study(WORK, path, 1000, resume=True)
    assert contents(path) == whole


def test_chunks_by_default(tmp_path):
    # seconds' worth, in powers of two of the unit, within memory; small studies in few chunks
    work = Toy(together=48)
    row = 8 + 8 + 40 + 4 + 1
    assert chunk_size(work, 10**6, 1e-3, target=4.0) == 48 * 64
    assert chunk_size(work, 10**6, 1.0) == 48
    assert chunk_size(work, 10**6, 1e-9, memory=row * 48 * 5) == 48 * 4
    assert chunk_size(work, 10**6, 1e-9, memory=row * 30) == 30
    assert chunk_size(work, 500, 1e-9) == 48 * 16
    assert chunk_size(Toy(), 10**5, 1e-9) == 2**16
    with pytest.raises(SettingError, match="more than the 60 bytes"):
        chunk_size(work, 500, 1e-3, memory=60)
    # what was measured is not computed again, and the store is the same
    log = tmp_path / "log"
    outcome = run_study(Toy(seed=7, together=48, log=str(log)), tmp_path / "a.zarr", 3000)
    calls = [tuple(map(int, line.split()[1:3])) for line in log.read_text().splitlines()]
    assert calls[:2] == [(0, 48), (48, 48)]
    assert sum(count for _, count in calls) == outcome.done == 3000
    run_study(WORK, tmp_path / "b.zarr", 3000, chunk=open_store(tmp_path / "a.zarr").layout.chunk)
    assert contents(tmp_path / "a.zarr") == contents(tmp_path / "b.zarr")
    # too few to measure
    assert Pieces(Toy(together=48, log=str(tmp_path / "none"))).seconds(95) == 0.0
    assert not (tmp_path / "none").exists()


def test_writing_and_computing_overlap(tmp_path, monkeypatch):
    """Each takes 50 ms; one after the other they would take twice as long."""
    from stmuav_jax.files.store import Store

    real, threads = Store.write, set()

    def write(self, chunk, arrays):
        threads.add(threading.get_ident())
        time.sleep(0.05)
        real(self, chunk, arrays)

    monkeypatch.setattr(Store, "write", write)
    begins: list[float] = []

    class Timed(Toy):
        def run(self, first, count):
            begins.append(time.monotonic())
            return Toy.run(self, first, count)

    run_study(Timed(pause=0.05), tmp_path / "study.zarr", 20, chunk=1)
    assert len(threads) == 1
    assert threading.get_ident() not in threads
    assert np.median(np.diff(begins)) < 0.09


def test_standings_in_words(monkeypatch):
    clock = iter([0.0, 10.0, 12.0, 14.0, 14.5])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    meter = Meter(100, 1000)
    # the first chunk's compilation is no part of the rate
    assert meter(200)[:4] == (200, 1000, 0.0, np.inf)
    assert meter(300).rate == 50.0
    assert meter(400).words() == "400 of 1000 samples, 50/s, 12.0 s to go"
    assert meter(400, "memory is short") == StudyProgress(400, 1000, 50.0, 12.0, "memory is short")
    assert StudyProgress(0, 5, 0.0, np.inf).words() == "0 of 5 samples"
    assert StudyProgress(1, 5, 0.125, 32.0).words() == "1 of 5 samples, 0.12/s, 32.0 s to go"
    assert [duration(s) for s in (59.94, 250.0, 7500.0, np.inf)] == [
        "59.9 s", "4 min 10 s", "2 h 5 min", "unknown time",
    ]  # fmt: skip


def test_a_bar(capfd, tmp_path):
    with Watch() as watch:
        run_study(Toy(most=5, words=""), tmp_path / "study.zarr", 20, chunk=10, progress=watch)
        assert watch.bar.tasks[0].completed == watch.bar.tasks[0].total == 20
    out, err = capfd.readouterr()
    assert out == ""
    assert "10 samples at once do not fit in memory" in err


@pytest.mark.parametrize("kills", [4, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_at_random_moments(tmp_path, kills):
    """SIGKILL, again and again: the store ends with the same files as an unbroken run's."""
    path, total = tmp_path / "killed.zarr", 20 * 14 * kills
    command = [sys.executable, HERE / "killed.py", path, *map(str, (total, 20, kills, kills))]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    stages = [int(word) for word in done.stdout.split()]
    assert len(stages) == kills
    # at different stages, and none of them at the end
    assert len(set(stages)) > kills // 2
    assert max(stages) < total
    run_study(Toy(seed=7, more=4), tmp_path / "unbroken.zarr", total, chunk=20)
    assert contents(path) == contents(tmp_path / "unbroken.zarr")


CTRL_C = """
import sys
sys.path.insert(0, {tests!r})
from jobs.toy import Toy
from stmuav_jax.jobs.local import run_study
outcome = run_study(
    Toy(seed=7, pause=0.2), {path!r}, 1000, chunk=10, progress=lambda now: print(now.done, flush=True)
)
print(outcome.words())
"""


DEAF = """
import sys
sys.path.insert(0, {tests!r})
from jobs.toy import Toy
from stmuav_jax.jobs.local import run_study
import time
class Deaf(Toy):
    def run(self, first, count):
        if first == 20:
            # as in a callback of a library: the first exception is printed and forgotten
            try:
                print("deaf", flush=True)
                time.sleep(30)
            except KeyboardInterrupt:
                print("lost", flush=True)
        return Toy.run(self, first, count)
outcome = run_study(Deaf(seed=7, pause=0.1), {path!r}, 1000, chunk=10)
print(outcome.words())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_cannot_get_lost(tmp_path, number):
    path = tmp_path / "study.zarr"
    code = DEAF.format(tests=str(HERE.parent), path=str(path))
    command = [sys.executable, "-W", "error", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "deaf"
        process.send_signal(number)
        rest = process.stdout.read().splitlines()
    assert process.returncode == 0
    assert rest[0] == "lost"
    assert rest[-1].startswith(f"Interrupted: {path} keeps ")
    assert 20 <= open_store(path).finished < 100


def test_ctrl_c(tmp_path):
    path = tmp_path / "study.zarr"
    code = CTRL_C.format(tests=str(HERE.parent), path=str(path))
    command = [sys.executable, "-W", "error", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= 50:
                break
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read().splitlines()
    assert process.returncode == 0
    assert rest[-1].startswith(f"Interrupted: {path} keeps ")
    done = open_store(path).finished
    assert 50 <= done < 1000
    assert f"keeps {done} of 1000" in rest[-1]
    run_study(WORK, path, 1000, resume=True)
    run_study(WORK, tmp_path / "unbroken.zarr", 1000, chunk=10)
    assert contents(path) == contents(tmp_path / "unbroken.zarr")


MILLION = """
import sys
sys.path.insert(0, {tests!r})
from jobs.toy import Toy
from stmuav_jax.jobs.local import run_study
from pathlib import Path
# not getrusage: what that says starts at the size of the process that started this one
words = lambda: Path("/proc/self/status").read_text().split("VmHWM:")[1].split()
most = lambda: int(words()[0]) / 2**10
work = Toy(more=20)
run_study(work, {path!r} + "/small.zarr", 40000, chunk=10000)
small = most()
outcome = run_study(work, {path!r} + "/large.zarr", 1000000, chunk=10000)
print(outcome.done, small, most())
"""


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
    assert large < 1024
    files = sum(p.stat().st_size for p in (tmp_path / "large.zarr").rglob("*") if p.is_file())
    assert files > 220e6


def test_overhead(tmp_path):
    """Store and progress take less than 5 % of the processor time of a chunk that computes for 2 s.

    Their time is measured alone, with a study that computes nothing, and the fastest of 20 chunks
    counts: a difference of two times of computing is smaller than the noise of either.
    """
    work = Toy(more=26, seed=1)
    clock: list[float] = []
    tell = lambda _: clock.append(time.process_time())
    run_study(work, tmp_path / "study.zarr", 20 * 1024, chunk=1024, progress=tell)
    fastest = min(np.diff(clock))
    print(f"{fastest:.3f} s of processor time for each chunk of 30 columns")
    assert fastest < 0.05 * 2.0


@pytest.mark.slow
def test_changes_of_devices_give_the_same_files(tmp_path):
    """A study of flights broken off three times and gone on with on other numbers of cores."""
    from stmuav_jax.montecarlo.batch import FlightWork
    from stmuav_jax.montecarlo.study import study_from_plain

    study = study_from_plain(
        {
            "scene": "hexacopter", "t1": 0.02, "seed": 4,
            "factors": {"start.p": {"distribution": "normal", "mean": 0.0, "standard_deviation": 3.0}},
            "quantities": {"tilt": {"signal": "tilt", "take": "largest"}},
        }
    )  # fmt: skip
    first = FlightWork(study, block=16, lanes=8, devices=1)
    run_study(first, tmp_path / "unbroken.zarr", 200, chunk=20)
    path = tmp_path / "study.zarr"
    for devices, end in ((1, 40), (2, 80), (5, 140), (3, 200)):
        work = FlightWork(study, block=16, lanes=8, devices=devices)
        vars(work)["_compiled"] = first._compiled  # pyright: ignore[reportIndexIssue]

        def stop(now: StudyProgress, end: int = end) -> None:
            if end <= now.done < now.total:
                raise KeyboardInterrupt

        run_study(work, path, 200, chunk=20, resume=True, progress=stop)
    assert contents(path) == contents(tmp_path / "unbroken.zarr")
    with pytest.raises(FileError, match="lanes is 8 there and 16 here"):
        run_study(FlightWork(study, lanes=16), path, 200, resume=True)
