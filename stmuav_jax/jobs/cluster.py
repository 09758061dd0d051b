"""Execution of a study on a cluster of Dask distributed, its own or an existing one.

The work is sent once to each worker; a task is a chunk's number. Results come back to this process,
which alone writes the store, with at most two chunks per worker in progress: that bounds memory,
and of a worker that dies only the chunks in progress are lost, which another one computes again.
"""

import asyncio
import contextlib
import os
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from ..checks.errors import SettingError, SimulationError
from ..files.store import Store
from ..montecarlo.work import AbstractWork
from .compute import MEMORY, Piece, chunk_size
from .keep import Keeper, New, Report, begin, there
from .progress import Outcome, StudyProgress
from .stop import stoppable

# Chunks in progress for each thread of a worker: one computed, one waiting.
_AHEAD = 2
_CACHE = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
# Number of repetitions of a chunk that fails on a worker.
_RETRIES = 2


def run_on_cluster(
    work: AbstractWork,
    path: str | os.PathLike[str],
    total: int,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    chunk: int | None = None,
    resume: bool = False,
    progress: Report | None = None,
    memory: int = MEMORY,
    patience: float = 10.0,
) -> Outcome:
    """Compute a study on the workers of a cluster; its store is the same as that of `run_study`.

    A script that starts a cluster of its own needs `if __name__ == "__main__":`, since new
    processes import it. Workers may join and leave at any time.

    Args:
        work, path, total: as in `run_study`. A work of a user's module needs that module on the
            workers.
        scheduler: address of a Dask scheduler, such as "tcp://10.0.0.1:8786"; None starts
            `workers` processes with a thread each on this machine.
        workers: number of processes to start, default one for each core.
        chunk, resume, progress, memory: as in `run_study`.
        patience: time for the scheduler to answer [s].

    Raises:
        FileError, SettingError: as in `run_study`; also no `distributed` here, no scheduler at the
            address, or a worker with other versions than the store's.
        SimulationError: the connection to the scheduler was lost, workers of the same chunk died
            repeatedly, or a single sample does not fit in memory. Written chunks are kept.
    """
    there(path, resume=resume)
    interrupted = False
    with (
        stoppable() as stop,
        _client(scheduler, workers, patience) as client,
        _shipped(client, work, ours=scheduler is None) as name,
    ):

        def new() -> New:
            if not client.nthreads() and progress is not None:
                note = f"Waiting for a worker of {client.scheduler.address}."
                progress(StudyProgress(0, total, 0.0, float("inf"), note))
            seconds, versions = _surveyed(client, name, total if chunk is None else None)
            return New(
                chunk_size(work, total, seconds, memory) if chunk is None else chunk, versions
            )

        with (
            begin(work, path, total, chunk=chunk, resume=resume, new=new, elsewhere=True) as store,
            Keeper(store, progress) as keeper,
        ):
            try:
                _carry_out(client, name, store, keeper)
                keeper.settle()
            except KeyboardInterrupt:
                stop.heard()
                interrupted = True
                keeper.settle()
            return keeper.outcome(interrupted=interrupted)


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise SettingError(
            f"A cluster needs Dask distributed: pip install 'stmuav-jax[cluster]' ({error})."
        ) from None
    return distributed


@contextlib.contextmanager
def _client(scheduler: str | None, workers: int | None, patience: float) -> Iterator[Any]:
    distributed = _distributed()
    if scheduler is None:
        with (
            _local_cluster(workers) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,
        ):
            yield client
        return
    if workers is not None:
        raise SettingError(
            f"The scheduler {scheduler} has its own workers; their number ({workers}) is not given."
        )
    with _reached(scheduler, patience) as client:
        yield client


def _reached(scheduler: str, patience: float) -> Any:
    """Client of an existing scheduler."""
    distributed = _distributed()
    try:
        kind = _kind_at(scheduler, patience)
        if kind == "Scheduler":
            return distributed.Client(scheduler, timeout=patience, set_as_default=False)
    # an arbitrary service at the address may give any answer
    except Exception as error:
        why = f"{type(error).__name__} {error}".strip()
        raise SettingError(
            f"No Dask scheduler answers at '{scheduler}' within {patience:g} s ({why})."
        ) from error
    raise SettingError(f"At '{scheduler}' is a Dask {kind}; a scheduler's address is wanted.")


def _kind_at(address: str, patience: float) -> str:
    """Kind of service at an address; a Client would wait for ever if it did not answer."""
    distributed = _distributed()

    async def identify() -> str:
        security = distributed.Security().get_connection_args("client")
        async with distributed.rpc(address, connection_args=security) as remote:
            return str((await remote.identity())["type"])

    # in a separate thread, since that of a notebook has an event loop already
    with ThreadPoolExecutor(1) as aside:
        return aside.submit(asyncio.run, asyncio.wait_for(identify(), patience)).result()


def _local_cluster(workers: int | None) -> Any:
    distributed = _distributed()
    from dask.system import CPU_COUNT

    count = CPU_COUNT if workers is None else workers
    if count < 1:
        raise SettingError(f"A cluster needs 1 worker or more, not {count}.")
    one = dict.fromkeys(
        ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC"), "1"
    )
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=1"
    # workers share the compilation cache of this process
    kept = {name.upper(): str(value) for name in _CACHE if (value := getattr(jax.config, name))}
    return distributed.LocalCluster(
        n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1",
        # memory is bounded by the chunks; with a limit, JAX's own memory would get workers killed
        memory_limit=None, dashboard_address="127.0.0.1:0", silence_logs="ERROR",
        env=one | kept | {"XLA_FLAGS": flags.strip()},
    )  # fmt: skip


@contextlib.contextmanager
def _shipped(client: Any, work: AbstractWork, *, ours: bool) -> Iterator[str]:
    """Send the work to all workers, later ones included; the context is its name there."""
    from .shipped import Shipped

    name = f"stmuav-{uuid.uuid4().hex}"
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        client.register_plugin(Shipped(work, x64=x64, ours=ours), name=name)
    except Exception as error:
        raise SettingError(
            f"The workers of {client.scheduler.address} cannot take the study; do they have "
            f"stmuav-jax? {type(error).__name__}: {error}"
        ) from error
    try:
        yield name
    finally:
        # a scheduler that has ended has nothing to unregister
        with contextlib.suppress(Exception):
            client.unregister_worker_plugin(name)


def _surveyed(client: Any, name: str, total: int | None) -> tuple[float, dict[str, str]]:
    from .shipped import surveyed

    with _explained(client):
        return client.submit(
            surveyed, name, total, key=f"{name}-survey", pure=False, retries=_RETRIES
        ).result()


def _carry_out(client: Any, name: str, store: Store, keeper: Keeper) -> None:
    """Compute the missing chunks, a bounded number at a time."""
    from distributed import as_completed

    from .shipped import computed

    waiting = store.waiting()
    versions = dict(store.layout.versions)
    running = as_completed(loop=client.loop)
    chunks: dict[str, int] = {}

    def feed() -> None:
        ahead = max(_AHEAD * sum(client.nthreads().values()), 1)
        while len(chunks) < ahead and (chunk := next(waiting, None)) is not None:
            future = client.submit(
                computed, name, *store.todo(chunk), versions,
                key=f"{name}-{chunk}", pure=False, retries=_RETRIES,
            )  # fmt: skip
            chunks[future.key] = chunk
            running.add(future)

    with _explained(client):
        feed()
        for future in running:
            piece: Piece = future.result()
            keeper.keep(chunks.pop(future.key), piece)
            # the worker releases its results with the future
            del future, piece
            feed()


@contextlib.contextmanager
def _explained(client: Any) -> Iterator[None]:
    """Translate errors of the cluster into errors of this package."""
    from distributed import CancelledError, KilledWorker
    from distributed.comm.core import CommClosedError

    address = client.scheduler.address if client.scheduler else "the scheduler"
    try:
        yield
    except KilledWorker as error:
        raise SimulationError(
            "The workers that computed the same chunk died, one after another, perhaps for want "
            f"of memory: {error}. What was stored is kept; go on with the study where it stands."
        ) from error
    except (CommClosedError, CancelledError, TimeoutError) as error:
        raise SimulationError(
            f"Lost the Dask scheduler at {address} ({type(error).__name__}). What was stored is "
            "kept; go on with the study where it stands."
        ) from error
