"""Computation of a work's samples, in pieces where memory requires it, and sizes of chunks."""

import math
import time
from typing import NamedTuple

import numpy as np

from ..checks.errors import SettingError, SimulationError
from ..files.layout import layout_of
from ..montecarlo.work import AbstractWork

# Bytes of a chunk's results, of which a run holds about three: computed, written, joined.
MEMORY = 2**26
# Seconds of work in a chunk: the loss of an interrupted run, and long enough to hide storing.
SECONDS = 4.0
# A chunk may be larger than the study's total up to this number, since the study may be extended.
_LEAST = 1024


class Piece(NamedTuple):
    """Computed samples and a note on their computation, such as that memory was short."""

    arrays: dict[str, np.ndarray]
    note: str = ""


class Pieces:
    """Function that computes samples of a work, in halves where they do not fit in memory together.

    Attributes:
        limit: largest number of samples to compute together after a lack of memory; None before.
    """

    def __init__(self, work: AbstractWork) -> None:
        self.work = work
        self.limit: int | None = None
        self._ready: dict[int, dict[str, np.ndarray]] = {}

    def __call__(self, first: int, count: int) -> Piece:
        """Compute columns (count, ...) of the samples first, first + 1, ...

        Raises:
            SimulationError: not even a single sample fits in memory.
        """
        parts: list[dict[str, np.ndarray]] = []
        at, end, note = first, first + count, ""
        while at < end:
            ready = self._ready.pop(at, None)
            if ready is not None and len(ready["status"]) <= end - at:
                parts.append(ready)
                at += len(ready["status"])
                continue
            tried = min(self.limit or count, end - at)
            part = _attempted(self.work, at, tried)
            if part is None:
                self.limit = _halved(tried, max(1, self.work.unit), at)
                note = (
                    f"{tried} samples at once do not fit in memory; going on with {self.limit}. "
                    "The numbers are the same."
                )
                continue
            parts.append(part)
            at += tried
        if len(parts) == 1:
            return Piece(parts[0], note)
        return Piece({n: np.concatenate([part[n] for part in parts]) for n in parts[0]}, note)

    def seconds(self, total: int) -> float:
        """Seconds per sample, from two small runs whose results are kept for the first chunks.

        The first run compiles code; the second is timed. The result is 0 where there are too few
        samples for two runs, and no need to know.
        """
        unit = max(1, self.work.unit)
        if total < 2 * unit:
            return 0.0
        self._ready[0] = self(0, unit).arrays
        begin = time.perf_counter()
        self._ready[unit] = self(unit, unit).arrays
        return (time.perf_counter() - begin) / unit


def _attempted(work: AbstractWork, first: int, count: int) -> dict[str, np.ndarray] | None:
    """Compute samples, or return None if they do not fit in memory, which is free again then."""
    try:
        return work.run(first, count)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            return None
        raise


def _halved(count: int, unit: int, first: int) -> int:
    """Number of samples after halving, a multiple of the unit where there is room for one."""
    if count == 1:
        raise SimulationError(f"Sample {first} does not fit in memory, though alone.")
    half = -(-count // 2)
    return min(-(-half // unit) * unit, count - 1) if count > unit else half


def chunk_size(
    work: AbstractWork, total: int, seconds: float, memory: int = MEMORY, target: float = SECONDS
) -> int:
    """Number of samples in a chunk: `target` seconds of work, as far as results fit in `memory`.

    The number is the work's unit times a power of two.

    Args:
        work: work of the study.
        total: number of samples of the study.
        seconds: time per sample [s].
        memory: largest size of a chunk's results in bytes.
        target: wanted time per chunk [s].

    Raises:
        SettingError: memory for less than one sample.
    """
    room = memory // max(1, layout_of(work, total, 1, {}).sample_bytes)
    if room < 1:
        raise SettingError(f"A sample's results need more than the {memory} bytes of memory given.")
    unit = max(1, work.unit)
    wanted = min(target / max(seconds, 1e-12), max(total, _LEAST), room)
    if wanted <= unit:
        return min(unit, room)
    # rounded down to a power of two of units, so that the size hardly depends on the timing
    return unit * 2 ** math.floor(math.log2(wanted / unit))
