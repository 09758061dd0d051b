"""Workers of Dask distributed that compute a study's chunks; imported only when they are used.

A chunk is a task, which brings the study's small pickle along; a worker keeps the last study that it has
unpickled, with its compiled programs. Chunks come back to this process, which alone writes the store,
with at most two for each thread in progress.
"""

import asyncio
import contextlib
import functools
import logging
import os
import signal
import threading
import uuid
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from ..checks.errors import SettingError, SimulationError
from .store import computing_versions

try:
    import cloudpickle
    import distributed
    from distributed.comm.core import CommClosedError
except ImportError as error:
    raise SettingError(
        f"Workers need Dask distributed: pip install '.[cluster]' in a checkout ({error})."
    ) from None

# Chunks in progress for each thread of a worker: one computed, one waiting.
_AHEAD = 2
# Number of repetitions of a chunk that fails on a worker.
_RETRIES = 2
_JAX_CACHE = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@functools.cache
def _worker_versions() -> dict[str, str]:
    return computing_versions()


class WorkerPool:
    """Workers that compute samples of one study; made by `connect`."""

    def __init__(self, client: Any, study: Any) -> None:
        self.client, self.x64 = client, bool(jax.config.read("jax_enable_x64"))
        # a name of its own, since Dask would take equal names for equal results
        self.name = f"stmuav-{uuid.uuid4().hex}"
        self.content = cloudpickle.dumps(study)

    @classmethod
    @contextlib.contextmanager
    def connect(
        cls, study: Any, scheduler: str | None, workers: int | None, patience: float
    ) -> Iterator["WorkerPool"]:
        """Context of workers at a scheduler, or of so many that are started here."""
        with contextlib.ExitStack() as stack:
            if scheduler is None:
                cluster = stack.enter_context(_start_workers(workers))
                client = stack.enter_context(distributed.Client(cluster, set_as_default=False))
                client.register_plugin(_QuietWorker())
            elif workers is not None:
                raise SettingError(
                    f"The scheduler {scheduler} has its own workers; their number ({workers}) is not "
                    "given."
                )
            else:
                client = stack.enter_context(_connect_scheduler(scheduler, patience))
            with _explain_errors(client):
                yield cls(client, study)

    @functools.cached_property
    def versions(self) -> dict[str, str]:
        """Versions that compute on a worker, with which all others have to agree."""
        return self.client.submit(_worker_versions, pure=False).result()

    def compute(
        self, pieces: Iterable[tuple[int, int]]
    ) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """First numbers and columns of pieces (first, count), as they are done."""
        waiting, versions = iter(pieces), self.versions
        firsts: dict[str, int] = {}
        running = distributed.as_completed(loop=self.client.loop)

        def submit() -> None:
            # A few chunks per worker: all of them at once would fill the scheduler's memory with results.
            most = max(_AHEAD * sum(self.client.nthreads().values()), 1)
            while len(firsts) < most and (piece := next(waiting, None)) is not None:
                future = self.client.submit(
                    _compute_on_worker, self.content, *piece, self.x64, versions,
                    key=f"{self.name}-{piece[0]}-{piece[1]}", pure=False, retries=_RETRIES,
                )  # fmt: skip
                firsts[future.key] = piece[0]
                running.add(future)

        submit()
        for future in running:
            arrays = future.result()
            first = firsts.pop(future.key)
            # the worker releases its results with the future
            del future
            yield first, arrays
            submit()


@functools.lru_cache(maxsize=1)
def _load_study(content: bytes, x64: bool) -> Any:
    # arrays in the study have the client's precision
    with jax.enable_x64(x64):
        return cloudpickle.loads(content)


def _compute_on_worker(
    content: bytes, first: int, count: int, x64: bool, versions: Mapping[str, str]
) -> dict[str, np.ndarray]:
    """Samples first, first + 1, ... on a worker.

    Raises:
        SettingError: the versions of this worker differ from the store's.
    """
    present = _worker_versions()
    # Other versions give other last digits, and a store must not depend on who computed which sample.
    unlike = [
        f"{key} {present.get(key)} (the store has {versions.get(key)})"
        for key in dict.fromkeys([*present, *versions])
        if present.get(key) != versions.get(key)
    ]
    if unlike:
        address = distributed.get_worker().address
        raise SettingError(f"Worker {address} computes with {', '.join(unlike)}.")
    with jax.enable_x64(x64):
        return _load_study(content, x64).compute_in_parts(first, count)


class _QuietWorker(distributed.WorkerPlugin):
    """Workers started here leave Ctrl-C, which reaches all processes, to the process that started them."""

    def setup(self, worker: Any) -> None:
        """Prepare a worker when it receives the plugin."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        # a heartbeat that was on its way when the cluster ended is no news
        logging.getLogger("distributed").setLevel(logging.CRITICAL)


@contextlib.contextmanager
def _start_workers(workers: int | None) -> Iterator[Any]:
    """Workers as processes of this machine, which import nothing from the current folder."""
    count = workers or 0
    if count < 1:
        raise SettingError(f"A cluster needs 1 worker or more, not {workers}.")
    # One thread in each process; otherwise all workers would compete for all cores.
    threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC")
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=1"
    # workers share the compilation cache of this process
    cache = {n.upper(): str(value) for n in _JAX_CACHE if (value := getattr(jax.config, n))}
    environment = dict.fromkeys(threads, "1") | cache | {"XLA_FLAGS": flags.strip()}
    before = os.environ.get("PYTHONSAFEPATH")
    # A file in the current folder named like a module would be imported by the workers.
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        with distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1",
            # memory is bounded by the chunks; with a limit, JAX's own memory would get workers killed
            memory_limit=None, dashboard_address="127.0.0.1:0", silence_logs=logging.ERROR,
            env=environment,
        ) as cluster:  # fmt: skip
            yield cluster
    finally:
        if before is None:
            os.environ.pop("PYTHONSAFEPATH", None)
        else:
            os.environ["PYTHONSAFEPATH"] = before


def _connect_scheduler(scheduler: str, patience: float) -> Any:
    """Client of an existing scheduler.

    Raises:
        SettingError: nothing answers at the address, or something else than a scheduler.
    """

    async def identify() -> str:
        # a Client would wait for ever where something listens and does not answer
        security = distributed.Security().get_connection_args("client")
        async with distributed.rpc(scheduler, connection_args=security) as remote:
            service: Any = await remote.identity()
            return str(service["type"])

    try:
        # in a separate thread, since that of a notebook has an event loop already
        with ThreadPoolExecutor(1) as thread:
            kind = thread.submit(asyncio.run, asyncio.wait_for(identify(), patience)).result()
        if kind == "Scheduler":
            return distributed.Client(scheduler, timeout=patience, set_as_default=False)
    # an arbitrary service at the address may give any answer
    except Exception as error:
        reason = f"{type(error).__name__} {error}".strip()
        raise SettingError(
            f"No Dask scheduler answers at '{scheduler}' within {patience:g} s ({reason})."
        ) from error
    raise SettingError(f"At '{scheduler}' is a Dask {kind}; a scheduler's address is needed.")


@contextlib.contextmanager
def _explain_errors(client: Any) -> Iterator[None]:
    """Translate errors of the cluster into errors of this package."""
    address = client.scheduler.address if client.scheduler else "the scheduler"
    resume_hint = "Stored samples are kept; resume the study."
    try:
        yield
    except distributed.KilledWorker as error:
        raise SimulationError(
            "The workers that computed the same chunk died, one after another, perhaps because "
            f"memory was short: {error}. {resume_hint}"
        ) from error
    except (CommClosedError, distributed.CancelledError, TimeoutError) as error:
        raise SimulationError(
            f"The Dask scheduler at {address} was lost ({type(error).__name__}). {resume_hint}"
        ) from error
