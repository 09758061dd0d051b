"""A study on real worker processes of this machine: the same store, whoever dies on the way."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from jobs.toy import Precise, Toy, contents

import stmuav_jax
from stmuav_jax.checks.errors import SettingError, SimulationError
from stmuav_jax.files import layout
from stmuav_jax.files.netcdf import FileError
from stmuav_jax.files.store import create, open_store
from stmuav_jax.jobs.cluster import run_on_cluster
from stmuav_jax.jobs.local import run_study
from stmuav_jax.jobs.progress import StudyProgress

distributed = pytest.importorskip("distributed")

TESTS = Path(__file__).parents[1]
WORK = Toy(seed=7)


class Outside(NamedTuple):
    """A scheduler and workers without anything that would start them again."""

    address: str
    workers: list[subprocess.Popen[bytes]]


def spawned(tool: str, *arguments: str) -> subprocess.Popen[bytes]:
    paths = [str(Path(stmuav_jax.__file__).parents[1]), str(TESTS)]
    # a worker is not told of double precision: the study brings it along
    kept = {key: value for key, value in os.environ.items() if key != "JAX_ENABLE_X64"}
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.dask_{tool}", *arguments, "--no-dashboard"],
        env=kept | {"PYTHONPATH": os.pathsep.join(paths), "NPROC": "1"},
        stderr=subprocess.DEVNULL,
    )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def outside() -> Iterator[Outside]:
    """Three workers at a scheduler of their own; tests may kill one."""
    port = str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    scheduler = spawned("scheduler", "--host", "127.0.0.1", "--port", port)
    worker = lambda: spawned("worker", address, "--nthreads", "1", "--no-nanny")
    workers = [worker() for _ in range(3)]
    with distributed.Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(3, timeout=120)
    yield Outside(address, workers)
    for process in (*workers, scheduler):
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of a single process: 900 samples in chunks of 30."""
    path = tmp_path_factory.mktemp("whole") / "study.zarr"
    run_study(WORK, path, 900, chunk=30)
    return contents(path)


def test_a_cluster_of_our_own(tmp_path, whole):
    """Three processes; one kills itself in a chunk, and another takes its place."""
    path, marker = tmp_path / "study.zarr", tmp_path / "marker"
    marker.touch()
    seen: list[StudyProgress] = []
    work = Toy(seed=7, pause=0.05, fall=(500, str(marker)), log=str(tmp_path / "log"))
    outcome = run_on_cluster(work, path, 900, workers=3, chunk=30, progress=seen.append)
    assert not marker.exists()
    assert (outcome.done, outcome.computed, outcome.interrupted) == (900, 900, False)
    assert contents(path) == whole
    assert [now.done for now in seen] == list(range(0, 901, 30))
    calls = [tuple(map(int, line.split())) for line in (tmp_path / "log").read_text().splitlines()]
    assert len({pid for pid, *_ in calls}) >= 3
    # each with one thread
    assert {threads for *_, threads in calls} == {1}
    assert os.getpid() not in {pid for pid, *_ in calls}
    # the chunk that was lost was computed twice; more only what the dead had ready
    firsts = [first for _, first, *_ in calls]
    assert firsts.count(480) == 2
    assert len(firsts) <= 30 + 4


def test_a_worker_is_killed(tmp_path, whole, outside):
    """One of three, from outside and for good, while it computes."""
    path = tmp_path / "study.zarr"
    victim = outside.workers[0]

    def kill(now: StudyProgress) -> None:
        if now.done >= 300 and victim.poll() is None:
            victim.send_signal(signal.SIGKILL)
            victim.wait()

    work = Toy(seed=7, pause=0.05, log=str(tmp_path / "log"))
    outcome = run_on_cluster(
        work, path, 900, scheduler=outside.address, chunk=30, progress=kill, resume=True
    )
    assert victim.returncode == -signal.SIGKILL
    assert outcome.done == 900
    assert contents(path) == whole
    pids = [int(line.split()[0]) for line in (tmp_path / "log").read_text().splitlines()]
    assert set(pids) == {worker.pid for worker in outside.workers}


def test_each_worker_makes_the_work_once(tmp_path, outside):
    """Unpickled once in a process, also for a second study of the same work."""
    work = Precise(log=str(tmp_path / "log"))
    for total in (40, 80):
        run_on_cluster(
            work, tmp_path / "s.zarr", total, scheduler=outside.address, chunk=5, resume=True
        )
    lines = (tmp_path / "log").read_text().splitlines()
    made = [line for line in lines if line.startswith("made")]
    assert len(made) == len(set(made)) <= 3


def test_double_precision_goes_along(tmp_path, outside):
    """The workers run in single precision by themselves; arrays and results come out double."""
    path = tmp_path / "study.zarr"
    run_on_cluster(Precise(), path, 20, scheduler=outside.address, chunk=5)
    found = open_store(path).load()
    np.testing.assert_array_equal(found["x"].values, np.arange(20) * (1.0 / 3.0))
    run_study(Precise(), tmp_path / "here.zarr", 20, chunk=5)
    assert contents(path) == contents(tmp_path / "here.zarr")


def test_interrupted_and_gone_on_with_here(tmp_path, whole, outside):
    path = tmp_path / "study.zarr"

    def stop(now: StudyProgress) -> None:
        if now.done == 300:
            raise KeyboardInterrupt

    outcome = run_on_cluster(
        Toy(seed=7, pause=0.05), path, 900, scheduler=outside.address, chunk=30, progress=stop
    )
    assert outcome.interrupted
    assert 300 <= outcome.done < 900
    assert open_store(path).finished == outcome.done
    assert run_study(WORK, path, 900, resume=True).computed == 900 - outcome.done
    assert contents(path) == whole


def test_chunks_by_default_and_little_memory(tmp_path, outside):
    """Sized by a worker, halved by it where memory is short; the note comes along."""
    path = tmp_path / "study.zarr"
    work = Toy(seed=7, together=4, most=300, words="RESOURCE_EXHAUSTED: no room")
    outcome = run_on_cluster(work, path, 3000, scheduler=outside.address)
    assert outcome.done == 3000
    assert open_store(path).layout.chunk == 2048
    assert outcome.notes
    # 2048 = 8 * 256, and the other chunk of 952, halved in multiples of 4
    ends = ("going on with 256. The numbers are the same.", "going on with 240. The numbers are")
    assert all(any(end in note for end in ends) for note in outcome.notes)
    run_study(WORK, tmp_path / "here.zarr", 3000, chunk=2048)
    assert contents(path) == contents(tmp_path / "here.zarr")


def test_a_work_that_fails(tmp_path, outside):
    """The workers' error is the user's; what was stored is kept."""
    work = Toy(seed=7, most=0, words="a bug")
    with pytest.raises(RuntimeError, match="a bug"):
        run_on_cluster(work, tmp_path / "s.zarr", 20, scheduler=outside.address, chunk=5)
    assert open_store(tmp_path / "s.zarr").finished == 0


def test_other_versions(tmp_path, outside):
    path = tmp_path / "study.zarr"
    versions = layout.computing_versions()
    create(path, WORK, 20, 5, {**versions, "jax": "0.0.1"}).close()
    words = r"Worker tcp://.* computes with jax [0-9.]+ \(the store has 0\.0\.1\)"
    with pytest.raises(SettingError, match=words):
        run_on_cluster(WORK, path, 20, scheduler=outside.address, resume=True)
    with pytest.raises(FileError, match="seed is 7 there and 8 here"):
        run_on_cluster(Toy(seed=8), path, 20, scheduler=outside.address, resume=True)
    with pytest.raises(FileError, match="exists; go on"):
        run_on_cluster(WORK, path, 20, scheduler=outside.address)


def test_no_scheduler(tmp_path):
    path = tmp_path / "study.zarr"
    begin = time.monotonic()
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        nobody = f"tcp://127.0.0.1:{free_port()}"
        for address in ("nonsense", nobody, f"tcp://127.0.0.1:{mute.getsockname()[1]}"):
            mute.listen()
            with pytest.raises(SettingError, match=f"No Dask scheduler answers at '{address}'"):
                run_on_cluster(WORK, path, 20, scheduler=address, patience=1.0)
    assert time.monotonic() - begin < 10
    assert not path.exists()


def test_settings_that_cannot_be(tmp_path, outside, monkeypatch):
    path = tmp_path / "study.zarr"
    with pytest.raises(SettingError, match="1 worker or more, not 0"):
        run_on_cluster(WORK, path, 20, workers=0)
    with pytest.raises(SettingError, match=r"has its own workers; their number \(2\)"):
        run_on_cluster(WORK, path, 20, scheduler=outside.address, workers=2)
    with distributed.Client(outside.address, set_as_default=False) as client:
        worker = next(iter(client.nthreads()))
    with pytest.raises(SettingError, match="is a Dask Worker; a scheduler's address is wanted"):
        run_on_cluster(WORK, path, 20, scheduler=worker)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SettingError, match=r"pip install 'stmuav-jax\[cluster\]'"):
        run_on_cluster(WORK, path, 20)


def test_workers_that_come_later(tmp_path, whole):
    """No worker at first, which is said; then one, which is sent the work as the first was."""
    port = str(free_port())
    address, path = f"tcp://127.0.0.1:{port}", tmp_path / "study.zarr"
    processes = [spawned("scheduler", "--host", "127.0.0.1", "--port", port)]
    seen: list[StudyProgress] = []

    def come(now: StudyProgress) -> None:
        seen.append(now)
        if now.note or now.done == 300:
            processes.append(spawned("worker", address, "--nthreads", "1", "--no-nanny"))

    try:
        outcome = run_on_cluster(
            Toy(seed=7), path, 900, scheduler=address, chunk=30, progress=come, patience=60.0
        )
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert seen[0] == StudyProgress(0, 900, 0.0, np.inf, f"Waiting for a worker of {address}.")
    assert outcome.done == 900
    assert contents(path) == whole


@pytest.mark.slow
def test_a_scheduler_that_is_lost(tmp_path, whole):
    port = str(free_port())
    address, path = f"tcp://127.0.0.1:{port}", tmp_path / "study.zarr"
    scheduler = spawned("scheduler", "--host", "127.0.0.1", "--port", port)
    worker = spawned("worker", address, "--nthreads", "1", "--no-nanny")
    with distributed.Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=60)

    def kill(now: StudyProgress) -> None:
        if now.done == 300:
            scheduler.kill()

    work = Toy(seed=7, pause=0.05)
    try:
        with pytest.raises(SimulationError, match=f"Lost the Dask scheduler at {address}"):
            run_on_cluster(work, path, 900, scheduler=address, chunk=30, progress=kill)
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()
    assert 300 <= open_store(path).finished < 900
    run_study(WORK, path, 900, resume=True)
    assert contents(path) == whole


@pytest.mark.slow
def test_a_chunk_that_kills_each_worker(tmp_path, whole):
    path, marker = tmp_path / "study.zarr", tmp_path / "marker"
    marker.write_text("always")
    work = Toy(seed=7, fall=(500, str(marker)))
    with pytest.raises(SimulationError, match="computed the same chunk died"):
        run_on_cluster(work, path, 900, workers=2, chunk=30)
    run_study(WORK, path, 900, resume=True)
    assert contents(path) == whole


CTRL_C = """
import sys
sys.path.insert(0, {tests!r})
import distributed.scheduler
from jobs.toy import Toy
from stmuav_jax.jobs.cluster import run_on_cluster

if __name__ == "__main__":
    # so frequent that some are on their way when the cluster ends
    distributed.scheduler.heartbeat_interval = lambda n: 0.002
    work = Toy(seed=7, pause=0.1)
    tell = lambda now: print(now.done, flush=True)
    print(run_on_cluster(work, {path!r}, 900, workers=2, chunk=30, progress=tell).words())
"""


@pytest.mark.slow
def test_ctrl_c(tmp_path):
    """It reaches all processes, as from a terminal; nobody but the first has anything to say."""
    path, script = tmp_path / "study.zarr", tmp_path / "script.py"
    script.write_text(CTRL_C.format(tests=str(TESTS), path=str(path)))
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= 120:
                break
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate()
    assert process.returncode == 0
    assert err == ""
    assert f"Interrupted: {path} keeps {open_store(path).finished} of 900" in out
