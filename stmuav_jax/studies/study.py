"""Monte Carlo study: a function of a sample, evaluated for all samples of its factors and stored.

A sample's outcomes depend on the seed, on its number and on the number of lanes, which is part of the
study's identity because compilers order sums by it. They do not depend on other samples: a sample always
has the same place among the lanes, and one program of fixed shape, compiled for one device, evaluates
all of them. The cores of a CPU share it as threads, and other devices have a copy each.
"""

import abc
import contextlib
import functools
import itertools
import math
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..checks.digest import digest_value
from ..checks.errors import SettingError, SimulationError
from ..checks.schema import quote_name
from ..math.compiler import compile_for_shapes
from ..math.native.structure import find_structure
from .columns import FINE, Axis, Column, column_name
from .sampling import Sampling
from .store import check_absent, computing_versions, create_store, resume_store, row_shape

# Samples evaluated together on one device: on a CPU as many as fit its cache, by measurement
# (docs/studies.md); a GPU needs thousands.
LANES = {"cpu": 16}
LANES_ELSEWHERE = 4096
# Number of lanes computed by one vector instruction (AVX-512, double precision). Lanes left over would be
# rounded differently, and results would depend on the lane.
TOGETHER = 8
MOST_DEVICES = 1024
# Largest size of a chunk's results in bytes.
MOST_BYTES = 2**26
# Status of a sample whose function says nothing of its own.
_NOT_A_NUMBER = 2
_REASONS = {_NOT_A_NUMBER: "an outcome is not a number"}


class StudyProgress(NamedTuple):
    """Progress of a running study: numbers of stored samples and of all samples, and a note."""

    completed: int
    total: int
    note: str = ""


class StudyOutcome(NamedTuple):
    """Outcome of a study's run.

    Attributes:
        path: folder of the store.
        completed, total: numbers of stored samples and of all samples.
        computed: number of samples that this run computed.
        seconds: duration of the run [s].
        interrupted: true if the run was stopped.
    """

    path: Path
    completed: int
    total: int
    computed: int
    seconds: float
    interrupted: bool

    def describe(self) -> str:
        """Text of the outcome in one sentence."""
        computed = f"{self.computed} of them computed now, in {self.seconds:.1f} s"
        if self.interrupted:
            return (
                f"Interrupted: {self.path} keeps {self.completed} of {self.total} samples ({computed}); "
                "resume the study to complete it."
            )
        return f"{self.path} holds all {self.completed} samples, {computed}."


class AbstractBatch(abc.ABC):
    """Function of a sample with a faster batch evaluation than `jax.vmap`.

    Attributes:
        block: number of samples in one call of the compiled program, from which the lanes are filled;
            None for as many as there are lanes.
    """

    block: int | None = None

    @abc.abstractmethod
    def evaluate_batch(
        self, samples: Mapping[str, Any], keys: Any, count: Any, lanes: int
    ) -> dict[str, Any]:
        """Outcomes (n, ...) of the first `count` of n samples; those of the others are ignored.

        Args:
            samples: values by factor (n,). keys: random keys (n,). lanes: samples computed at a time.
        """

    def __call__(self, sample: Mapping[str, Any], key: Any) -> dict[str, Any]:
        """Outcomes of one sample."""
        samples, keys = jax.tree.map(lambda x: jnp.asarray(x)[None], (dict(sample), key))
        outcomes = self.evaluate_batch(samples, keys, count=jnp.asarray(1), lanes=1)
        return jax.tree.map(lambda x: x[0], outcomes)


class Study:
    """Monte Carlo study: a function of a sample, and the distributions from which samples are drawn.

        study = stm.Study(evaluate, {"mass": scipy.stats.norm(0.95, 0.02)}, samples=10_000, seed=1)
        study.run("study.zarr")

    Args:
        evaluate: function (sample, key) -> outcomes that JAX can trace, evaluated for many samples at once
            in double precision. `sample` has a number by factor, `key` is the sample's own random key, and
            outcomes are a pytree of arrays, of which each leaf is a column of the results. An outcome
            "status" is the result of the sample: `FINE` (1), or a code of `reasons`; without one a sample
            with a NaN has failed.
        factors: distributions by name: frozen ones of `scipy.stats`, numbers or plain forms.
        samples: number of samples.
        seed, design, correlation, stratum: see `Sampling`.
        name: short name for files.
        columns: units and labels of factors and outcomes by column; if a column of the role "status" is
            among them, those of all columns.
        axes: axes of outcomes that are arrays; default numbers from 0.
        reasons: reasons of failed samples by their codes of "status", from 2 on.
        identity: plain data that identify everything else on which the outcomes depend; default the source of
            `evaluate` and of the user's functions that it calls, and the values that they capture.
        lanes: samples evaluated together on a device, a multiple of 8; default 16 on a CPU and 4096
            elsewhere.
        block: for an `AbstractBatch`, samples in one call of the compiled program in place of its own.
        devices: number of threads on a CPU, default one; number of GPUs elsewhere, default all.
        chunk: number of samples stored together; default those of one call on all devices, as far as
            results fit in 64 MiB.

    Raises:
        SettingError: numbers that are not positive, lanes that are not a multiple of 8, more devices than
            there are, two columns of one name; also as for `Sampling`.
    """

    def __init__(
        self,
        evaluate: Callable[[Mapping[str, Any], Any], Any],
        factors: Mapping[str, Any],
        *,
        samples: int = 1024,
        seed: int = 0,
        design: str = "random",
        correlation: Any = (),
        stratum: int | None = None,
        name: str = "study",
        columns: Mapping[str, Column] | None = None,
        axes: Mapping[str, Axis] | None = None,
        reasons: Mapping[int, str] = _REASONS,
        identity: Mapping[str, Any] | None = None,
        lanes: int | None = None,
        block: int | None = None,
        devices: int | None = None,
        chunk: int | None = None,
    ) -> None:
        self.evaluate: Any = evaluate
        self.name, self.samples, self.chunk = name, samples, chunk
        self.sampling = Sampling(factors, seed, design, correlation, stratum)
        self.axes, self.reasons = dict(axes or {}), dict(reasons)
        for quantity, value in (("lanes", lanes), ("block", block), ("devices", devices)):
            if value is not None and value < 1:
                raise SettingError(f"{quantity} must be at least 1, but it is {value}.")
        kind = jax.default_backend()
        self.lanes = LANES.get(kind, LANES_ELSEWHERE) if lanes is None else lanes
        if self.lanes % TOGETHER:
            raise SettingError(
                f"lanes must be a multiple of {TOGETHER}, but it is {lanes}: a vector "
                "register holds that many, and results must not depend on the lane."
            )
        most = MOST_DEVICES if kind == "cpu" else len(jax.local_devices())
        if devices is not None and devices > most:
            raise SettingError(f"There are {most} devices, but {devices} were requested.")
        self._devices = devices
        block = (block or evaluate.block) if isinstance(evaluate, AbstractBatch) else None
        self._block = max((block or 0) // self.lanes, 1) * self.lanes
        # Compilers order sums by the number of lanes, so that it is part of the identity; block and
        # devices are not, since results do not depend on them.
        self.identity: Mapping[str, Any] = {
            "name": name,
            **({"evaluate": digest_value(evaluate)} if identity is None else identity),
            "sampling": self.sampling.plain(),
            "lanes": self.lanes,
        }
        self.columns: Mapping[str, Column] = self._describe_columns(columns or {})

    def __getstate__(self) -> dict[str, Any]:
        """State without the compiled programs, which are not pickled."""
        return {k: v for k, v in vars(self).items() if k not in ("_compiled", "_places")}

    @property
    def unit(self) -> int:
        """Samples that keep all devices busy: chunks of a store are best multiples of this number."""
        return self._block * len(self._places)

    def run(
        self,
        store: str | os.PathLike[str],
        samples: int | None = None,
        *,
        chunk: int | None = None,
        resume: bool = False,
        progress: Callable[[StudyProgress], object] | None = None,
        scheduler: str | None = None,
        workers: int | None = None,
        patience: float = 10.0,
    ) -> StudyOutcome:
        """Compute the missing samples of the study and store them, chunk by chunk.

        Each chunk is stored whole or not at all: a run that is killed loses at most the chunks that are
        computed at that moment, and a run that resumes it ends with the same files. Ctrl-C, or SIGTERM,
        ends the run after the current chunk; a second one ends it immediately.

        A script that starts workers needs `if __name__ == "__main__":`, since new processes import it.

        Args:
            store: folder of the store.
            samples: number of samples in place of the study's; more than the store has extend it.
            chunk: number of samples computed and stored together, in place of the study's; fixed when a
                store is created.
            resume: continue the store if there is one.
            progress: function called with a `StudyProgress` at the start and after each chunk.
            scheduler: address of a Dask scheduler, such as "tcp://10.0.0.1:8786", whose workers compute.
                They may join and leave at any time; each has one chunk in progress and one waiting.
            workers: number of Dask workers to start on this machine, one thread each.
            patience: time for the scheduler to answer [s].

        Raises:
            FileError: the store exists and `resume` is not set, or it is damaged, of another study or
                of other versions; or the disk is full (written chunks are kept).
            SettingError: impossible settings, outcomes other than the declared columns, no scheduler at
                the address, or a worker with other versions than the store's.
            SimulationError: not even a single sample fits in memory; or the scheduler was lost, or
                workers of the same chunk died repeatedly (written chunks are kept).
        """
        target, begin = Path(store), time.monotonic()
        total = self.samples if samples is None else samples
        chunk = self.chunk if chunk is None else chunk
        if not resume:
            # A store is hours of work, and is never overwritten.
            check_absent(target)
        tell = progress or (lambda _: None)
        note = lambda text: tell(StudyProgress(0, total, text))
        with contextlib.ExitStack() as stack:
            stop = stack.enter_context(delayed_interrupt(note))
            compute: Callable[[Iterable[tuple[int, int]]], Iterable[tuple[int, Any]]]
            compute = lambda pieces: (
                (first, self.compute_in_parts(first, n)) for first, n in pieces
            )
            versions = computing_versions
            if scheduler is not None or workers is not None:
                from .cluster import WorkerPool

                pool = stack.enter_context(WorkerPool.connect(self, scheduler, workers, patience))
                compute, versions = pool.compute, lambda: pool.versions
                if not pool.client.nthreads():
                    note(f"Waiting for a worker of {pool.client.scheduler.address}.")
            if not target.exists() or (target.is_dir() and not any(target.iterdir())):
                size = default_chunk(self) if chunk is None else chunk
                opened = stack.enter_context(create_store(target, self, total, size, versions()))
            else:
                opened = stack.enter_context(resume_store(target, self, versions()))
                # A chunk is one file of each column, and samples that are stored are not grouped anew.
                if chunk not in (None, opened.chunk):
                    raise SettingError(
                        f"{target} has chunks of {opened.chunk} samples, which cannot change to {chunk}."
                    )
                opened.extend(total)
            before = opened.finished
            tell(StudyProgress(before, total))
            # Pieces end at an interrupt, and those in work are still stored.
            pieces = itertools.takewhile(lambda _: not stop.is_set(), opened.pending())
            for first, arrays in compute(pieces):
                opened.write(first, arrays)
                tell(StudyProgress(opened.finished, total))
            opened.check_folder()
            finished = opened.finished
            is_stopped, seconds = stop.is_set() and finished < total, time.monotonic() - begin
            return StudyOutcome(target, finished, total, finished - before, seconds, is_stopped)

    def compute(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns (count, ...) of the samples first, first + 1, ..., which are not stored."""
        if not count:
            return {
                name: np.zeros((0, *row_shape(self, column)), column.dtype)
                for name, column in self.columns.items()
            }
        # A sample has the same place among the lanes whichever chunk asks for it: whole fillings
        # are computed, and what was not asked for is cut off.
        begin, end = first - first % self.lanes, -(-(first + count) // self.lanes) * self.lanes
        # beyond the design's end, lanes are filled with its last sample
        end = max(first + count, min(end, self.sampling.limit or end))
        values = self.sampling.draw(begin, end - begin)
        ranges = _split_ranges(first + count - begin, self._block, self.lanes, len(self._places))
        parts = self._on_all(values, begin, list(ranges))
        skip = slice(first - begin, first - begin + count)
        names = [column_name(name) for name in self.sampling.names]
        joined = dict(zip(names, values.T, strict=True))
        joined |= {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return {name: joined[name][skip].astype(c.dtype) for name, c in self.columns.items()}

    def compute_in_parts(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns (count, ...) of samples, in halves where they do not fit in memory together.

        Raises:
            SimulationError: not even a single sample fits in memory.
        """
        try:
            return self.compute(first, count)
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
                raise
            if count == 1:
                raise SimulationError(
                    f"Sample {first} alone does not fit in memory: let the function return smaller arrays."
                ) from error
        # Halving finds a size that fits after a few attempts, without an estimate of the memory that a
        # program needs.
        half = -(-count // 2)
        if self.unit < count:
            half = min(-(-half // self.unit) * self.unit, count - 1)
        halves = (first, half), (first + half, count - half)
        parts = [self.compute_in_parts(*piece) for piece in halves]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _on_all(
        self, values: np.ndarray, begin: int, ranges: list[tuple[int, int]]
    ) -> list[dict[str, np.ndarray]]:
        """Outcomes of ranges of the samples begin, begin + 1, ... with these values of the factors.

        Each device takes the next range that is not taken yet.
        """
        places, idle = self._places[: len(ranges)], queue.SimpleQueue()
        with jax.enable_x64(True):
            # programs are compiled here, once for each device, before the threads need them
            for place in places:
                idle.put(self._device_program(place))

        def carry_out(part: tuple[int, int]) -> dict[str, np.ndarray]:
            # samples begin + start, ..., begin + stop - 1
            start, stop = part
            # The block is always full, so that one program of fixed shape serves every part; the next
            # samples, or repeats of the last, fill it, and their outcomes are cut off.
            rows = np.minimum(np.arange(start, start + self._block), len(values) - 1)
            # A key follows from the seed and the sample's number alone, so that neither the order nor
            # the process of the chunks changes it.
            draw_key = lambda k: np.random.SeedSequence((self.sampling.seed, k)).generate_state(2)
            key_data = np.stack([draw_key(begin + int(row)) for row in rows]).astype(np.uint32)
            program = idle.get()
            try:
                with jax.enable_x64(True):
                    outcomes = program(values[rows], key_data, np.int32(stop - start))
                    outcomes = jax.device_get(outcomes)
            finally:
                idle.put(program)
            return {name: np.array(of[: stop - start]) for name, of in outcomes.items()}

        if len(places) == 1:
            return [carry_out(part) for part in ranges]
        with ThreadPoolExecutor(len(places), thread_name_prefix="study") as pool:
            try:
                return list(pool.map(carry_out, ranges))
            finally:
                # after Ctrl-C or an error no further part is begun
                pool.shutdown(wait=False, cancel_futures=True)

    @cached_property
    def _places(self) -> list[Any]:
        """Device of each thread: on a CPU always the first; elsewhere all of them."""
        devices = jax.local_devices()
        if devices[0].platform == "cpu":
            # On a CPU all threads share one device of JAX; each executes its own program there, one core each.
            return [devices[0]] * (self._devices or 1)
        return devices[: self._devices]

    @cached_property
    def _compiled(self) -> dict[Any, Any]:
        return {}

    def _device_program(self, place: Any) -> Callable[..., dict[str, Any]]:
        """Program of a device, compiled: values (block, d), data of keys (block, 2), count -> outcomes."""
        if place not in self._compiled:
            # Arrays of the function are arguments: constants would be folded at compilation.
            arrays, rest = eqx.partition(self.evaluate, eqx.is_array)

            def run_block(arrays: Any, *block: Any) -> dict[str, Any]:
                return self._evaluate_block(eqx.combine(arrays, rest), *block)

            # where there is one device, the program is that of later processes too
            at = None if place.platform == "cpu" else jax.sharding.SingleDeviceSharding(place)
            arrays = arrays if at is None else jax.device_put(arrays, at)
            of = lambda dtype, *shape: jax.ShapeDtypeStruct(shape, dtype, sharding=at)
            values = of(jnp.float64, self._block, len(self.sampling.names))
            shapes = values, of(jnp.uint32, self._block, 2), of(jnp.int32)
            program = compile_for_shapes(
                run_block, arrays, *shapes, structure=find_structure((arrays,))
            )
            self._compiled[place] = lambda *block: program(arrays, *block)
        return self._compiled[place]

    def _evaluate_block(
        self, evaluate: Any, values: Any, key_data: Any, count: Any
    ) -> dict[str, Any]:
        """Outcomes by column of a block of samples; traced."""
        samples = {name: values[:, k] for k, name in enumerate(self.sampling.names)}
        keys = jax.random.wrap_key_data(key_data, impl="threefry2x32")
        if isinstance(evaluate, AbstractBatch):
            return _name_outcomes(evaluate.evaluate_batch(samples, keys, count, self.lanes))
        outcomes = _name_outcomes(jax.vmap(evaluate)(samples, keys))
        if "status" in outcomes:
            return outcomes
        bad = [jnp.isnan(x).reshape(len(x), -1).any(axis=1) for x in outcomes.values()]
        failed = jnp.any(jnp.stack(bad), axis=0)
        return outcomes | {"status": jnp.where(failed, _NOT_A_NUMBER, FINE)}

    def _describe_columns(self, descriptions: Mapping[str, Column]) -> dict[str, Column]:
        """Columns of the factors and the outcomes, with the units and labels that are known."""
        result: dict[str, Column] = {}
        outcomes = {k: c for k, c in descriptions.items() if k not in self.sampling.factors}
        for name in self.sampling.names:
            column, described = column_name(name), descriptions.get(name)
            if column in outcomes and outcomes[column].role == "input":
                described = outcomes.pop(column)
            if column in result or column in outcomes:
                raise SettingError(f"Two columns would share the name '{column}' of '{name}'.")
            result[column] = described or Column("float64", "1", name, "input")
        if any(column.role == "status" for column in outcomes.values()):
            return result | outcomes
        with jax.enable_x64(True):
            # Tracing gives shapes and types of the outcomes without a compilation.
            of = jax.ShapeDtypeStruct
            forms = of((8, len(result)), jnp.float64), of((8, 2), jnp.uint32), of((), jnp.int32)
            shapes = jax.eval_shape(lambda *x: self._evaluate_block(self.evaluate, *x), *forms)
        for name, shape in shapes.items():
            if name in result:
                raise SettingError(f"{quote_name(name)} is a factor and an outcome: rename one.")
            if name == "status":
                continue
            dims = descriptions[name].dims if name in descriptions else ()
            if not dims:
                dims = tuple(f"{name}_{k}" for k in range(1, len(shape.shape)))
                sizes = zip(dims, shape.shape[1:], strict=True)
                self.axes |= {dim: Axis(np.arange(size), "1") for dim, size in sizes}
            usual = Column(str(shape.dtype), "1", name)
            result[name] = descriptions.get(name, usual)._replace(dtype=str(shape.dtype), dims=dims)
        return result | {"status": Column("int8", "1", "how the sample ended", "status")}


def default_chunk(study: Study) -> int:
    """Number of samples in a chunk: those best computed together, as far as results fit in 64 MiB."""
    size = sum(
        np.dtype(column.dtype).itemsize * math.prod(row_shape(study, column))
        for column in study.columns.values()
    )
    return max(1, min(study.unit, MOST_BYTES // max(size, 1)))


def _name_outcomes(outcomes: Any) -> dict[str, Any]:
    """Leaves of a pytree of outcomes by column, such as "position_x" for {"position": {"x": ...}}."""
    keystr = functools.partial(jax.tree_util.keystr, simple=True, separator="_")
    leaves = jax.tree_util.tree_leaves_with_path(outcomes)
    return {column_name(keystr(path) or "outcome"): jnp.asarray(leaf) for path, leaf in leaves}


def _split_ranges(count: int, block: int, lanes: int, devices: int) -> Iterator[tuple[int, int]]:
    """Ranges (start, stop) of parts of up to a block, from a lane's first place on, that keep devices busy."""
    # no part is so small that some of its lanes are idle
    fillings, least = -(-count // lanes), -(-count // block)
    number = max(least, min(-(-least // devices) * devices, fillings))
    ends = [fillings * k // number * lanes for k in range(number)]
    return itertools.pairwise([*ends, count])


@contextlib.contextmanager
def delayed_interrupt(tell: Callable[[str], object]) -> Iterator[threading.Event]:
    """Context in which the first Ctrl-C or SIGTERM sets an event, and the second interrupts.

    Outside of the main thread, signals are not handled.

    Args:
        tell: function called with a note at the first signal.
    """
    stop = threading.Event()
    # Python lets only the main thread set handlers of signals.
    in_main = threading.current_thread() is threading.main_thread()
    signals = (signal.SIGINT, signal.SIGTERM) if in_main else ()
    before = {number: signal.getsignal(number) for number in signals}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def handle(number: int, frame: Any) -> None:
        stop.set()
        # the next one is handled as without this context
        restore()
        tell("Stopping after the present chunk; Ctrl-C again stops at once.")

    for number in signals:
        signal.signal(number, handle)
    try:
        yield stop
    finally:
        restore()
