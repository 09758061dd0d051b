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
from studies.toy import Precise, Toy, contents

import stmuav_jax
from stmuav_jax.checks.errors import SettingError, SimulationError
from stmuav_jax.studies import StudyProgress, open_store

distributed = pytest.importorskip("distributed")

TESTS = Path(__file__).parents[1]
WORK = Toy(seed=7)


class Outside(NamedTuple):
    """A scheduler and workers without anything that would start them again; and their first study."""

    address: str
    workers: list[subprocess.Popen[bytes]]
    files: dict[str, bytes]
    seen: list[StudyProgress]


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
def outside(tmp_path_factory) -> Iterator[Outside]:
    """Three workers at a scheduler of their own, which come to a study that waits for them; tests may kill one."""
    port = str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    path = tmp_path_factory.mktemp("outside") / "study.zarr"
    scheduler = spawned("scheduler", "--host", "127.0.0.1", "--port", port)
    workers: list[subprocess.Popen[bytes]] = []
    seen: list[StudyProgress] = []

    def come(now: StudyProgress) -> None:
        seen.append(now)
        for _ in range(1 if now.note else 2 if now.completed == 300 else 0):
            workers.append(spawned("worker", address, "--nthreads", "1", "--no-nanny"))

    try:
        WORK.run(path, 900, scheduler=address, chunk=30, progress=come, patience=60.0)
        with distributed.Client(address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(3, timeout=120)
        yield Outside(address, workers, contents(path), seen)
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of a single process: 900 samples in chunks of 30."""
    path = tmp_path_factory.mktemp("whole") / "study.zarr"
    WORK.run(path, 900, chunk=30)
    return contents(path)


@pytest.mark.slow
def test_a_cluster_of_our_own(tmp_path, whole, monkeypatch):
    """Three processes; one kills itself in a chunk, and another takes its place.

    None of them imports a module of the current folder, as a new Python does before it hears what to run.
    """
    path, marker = tmp_path / "study.zarr", tmp_path / "marker"
    marker.touch()
    (tmp_path / "pickle.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    seen: list[StudyProgress] = []
    work = Toy(seed=7, pause=0.05, fall=(500, str(marker)), log=str(tmp_path / "log"))
    outcome = work.run(path, 900, workers=3, chunk=30, progress=seen.append)
    assert not marker.exists()
    assert not (tmp_path / "imported").exists()
    assert (outcome.completed, outcome.computed, outcome.interrupted) == (900, 900, False)
    assert contents(path) == whole
    assert [now.completed for now in seen] == list(range(0, 901, 30))
    calls = [tuple(map(int, line.split())) for line in (tmp_path / "log").read_text().splitlines()]
    assert len({pid for pid, *_ in calls}) >= 3
    # each with one thread
    assert {threads for *_, threads in calls} == {1}
    assert os.getpid() not in {pid for pid, *_ in calls}
    # the chunk that was lost was computed twice; more only what the dead had ready
    firsts = [first for _, first, *_ in calls]
    assert firsts.count(480) == 2
    assert len(firsts) <= 30 + 4


@pytest.mark.slow
def test_workers_that_come_later(whole, outside):
    """No worker at first, which is said; then one, and two that are sent the work as the first was."""
    assert outside.seen[0] == StudyProgress(0, 900, f"Waiting for a worker of {outside.address}.")
    assert outside.files == whole


@pytest.mark.slow
def test_a_worker_is_killed(tmp_path, whole, outside):
    """One of three, from outside and for good, while it computes."""
    path = tmp_path / "study.zarr"
    victim = outside.workers[0]

    def kill(now: StudyProgress) -> None:
        if now.completed >= 300 and victim.poll() is None:
            victim.send_signal(signal.SIGKILL)
            victim.wait()

    work = Toy(seed=7, pause=0.05, log=str(tmp_path / "log"))
    outcome = work.run(path, 900, scheduler=outside.address, chunk=30, progress=kill, resume=True)
    assert victim.returncode == -signal.SIGKILL
    assert outcome.completed == 900
    assert contents(path) == whole
    pids = [int(line.split()[0]) for line in (tmp_path / "log").read_text().splitlines()]
    # the victim may still have been importing when it was killed
    assert set(pids) >= {worker.pid for worker in outside.workers[1:]}


@pytest.mark.slow
def test_each_worker_makes_the_work_once(tmp_path, outside):
    """Unpickled once in a process, also for a second study of the same work."""
    work = Precise(log=str(tmp_path / "log"))
    for total in (40, 80):
        work.run(tmp_path / "s.zarr", total, scheduler=outside.address, chunk=5, resume=True)
    lines = (tmp_path / "log").read_text().splitlines()
    made = [line for line in lines if line.startswith("made")]
    assert len(made) == len(set(made)) <= 3


@pytest.mark.slow
def test_double_precision_goes_along(tmp_path, outside):
    """The workers run in single precision by themselves; arrays and results come out double."""
    path = tmp_path / "study.zarr"
    Precise().run(path, 20, scheduler=outside.address, chunk=5)
    found = open_store(path).load()
    np.testing.assert_array_equal(found["x"].values, np.arange(20) * (1.0 / 3.0))
    Precise().run(tmp_path / "here.zarr", 20, chunk=5)
    assert contents(path) == contents(tmp_path / "here.zarr")


@pytest.mark.slow
def test_a_lack_of_memory_on_a_worker_halves_its_chunks(tmp_path, outside):
    path = tmp_path / "study.zarr"
    work = Toy(seed=7, together=600, most=300, words="RESOURCE_EXHAUSTED: no room")
    assert work.run(path, 3000, scheduler=outside.address).completed == 3000
    assert open_store(path).chunk == 600
    WORK.run(tmp_path / "here.zarr", 3000, chunk=600)
    assert contents(path) == contents(tmp_path / "here.zarr")


@pytest.mark.slow
def test_a_work_that_fails(tmp_path, outside):
    """The workers' error is the user's; what was stored is kept."""
    work = Toy(seed=7, most=0, words="a bug")
    with pytest.raises(RuntimeError, match="a bug"):
        work.run(tmp_path / "s.zarr", 20, scheduler=outside.address, chunk=5)
    assert open_store(tmp_path / "s.zarr").finished == 0


def test_no_scheduler(tmp_path):
    path = tmp_path / "study.zarr"
    begin = time.monotonic()
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        nobody = f"tcp://127.0.0.1:{free_port()}"
        for address in ("nonsense", nobody, f"tcp://127.0.0.1:{mute.getsockname()[1]}"):
            mute.listen()
            with pytest.raises(SettingError, match=f"No Dask scheduler answers at '{address}'"):
                WORK.run(path, 20, scheduler=address, patience=0.5)
    assert time.monotonic() - begin < 10
    assert not path.exists()


@pytest.mark.slow
def test_settings_that_cannot_be(tmp_path, outside, monkeypatch):
    path = tmp_path / "study.zarr"
    with pytest.raises(SettingError, match="1 worker or more, not 0"):
        WORK.run(path, 20, workers=0)
    with pytest.raises(SettingError, match=r"has its own workers; their number \(2\)"):
        WORK.run(path, 20, scheduler=outside.address, workers=2)
    with distributed.Client(outside.address, set_as_default=False) as client:
        worker = next(iter(client.nthreads()))
    with pytest.raises(SettingError, match="is a Dask Worker; a scheduler's address is needed"):
        WORK.run(path, 20, scheduler=worker)
    monkeypatch.delitem(sys.modules, "stmuav_jax.studies.cluster")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SettingError, match=r"pip install '\.\[cluster\]' in a checkout"):
        WORK.run(path, 20, workers=1)


@pytest.mark.slow
def test_a_scheduler_that_is_lost(tmp_path, whole):
    port = str(free_port())
    address, path = f"tcp://127.0.0.1:{port}", tmp_path / "study.zarr"
    scheduler = spawned("scheduler", "--host", "127.0.0.1", "--port", port)
    worker = spawned("worker", address, "--nthreads", "1", "--no-nanny")
    with distributed.Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=60)

    def kill(now: StudyProgress) -> None:
        if now.completed == 300:
            scheduler.kill()

    work = Toy(seed=7, pause=0.05)
    try:
        with pytest.raises(SimulationError, match=f"The Dask scheduler at {address} was lost"):
            work.run(path, 900, scheduler=address, chunk=30, progress=kill)
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()
    assert 300 <= open_store(path).finished < 900
    WORK.run(path, 900, resume=True)
    assert contents(path) == whole


@pytest.mark.slow
def test_a_chunk_that_kills_each_worker(tmp_path, whole):
    path, marker = tmp_path / "study.zarr", tmp_path / "marker"
    marker.write_text("always")
    work = Toy(seed=7, fall=(500, str(marker)))
    with pytest.raises(SimulationError, match="computed the same chunk died"):
        work.run(path, 900, workers=2, chunk=30)
    WORK.run(path, 900, resume=True)
    assert contents(path) == whole


CTRL_C = """
import sys
sys.path.insert(0, {tests!r})
import distributed.scheduler
from studies.toy import Toy

if __name__ == "__main__":
    # so frequent that some are on their way when the cluster ends
    distributed.scheduler.heartbeat_interval = lambda n: 0.002
    work = Toy(seed=7, pause=0.1)
    tell = lambda now: now.note or print(now.completed, flush=True)
    print(work.run({path!r}, 900, workers=2, chunk=30, progress=tell).describe())
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
    assert (process.returncode, err) == (0, "")
    assert f"Interrupted: {path} keeps {open_store(path).finished} of 900" in out
