"""Progress of a study while it runs, and its outcome."""

import math
import time
from collections import deque
from pathlib import Path
from typing import NamedTuple

# Number of chunks over which a rate is taken.
_RECENT = 16


class StudyProgress(NamedTuple):
    """Progress of a running study.

    Attributes:
        done: number of stored samples.
        total: number of samples of the study.
        rate: recent rate of storing [samples/s], without the first chunk, whose time includes
            compilation; 0 before there are two chunks.
        remaining: remaining time at this rate [s], infinite while the rate is 0.
        note: message, such as that memory was short; empty if there is none.
    """

    done: int
    total: int
    rate: float
    remaining: float
    note: str = ""

    def words(self) -> str:
        """Text of the progress in one line."""
        at = f"{self.done} of {self.total} samples"
        if not self.rate:
            return at
        digits = 0 if self.rate >= 10 else 2
        return f"{at}, {self.rate:.{digits}f}/s, {duration(self.remaining)} to go"


class Outcome(NamedTuple):
    """Outcome of a study's run.

    Attributes:
        path: folder of the store.
        done, total: numbers of stored samples and of all samples.
        computed: number of samples that this run computed.
        seconds: duration of the run [s].
        interrupted: true if the run was stopped.
        notes: messages of the run.
    """

    path: Path
    done: int
    total: int
    computed: int
    seconds: float
    interrupted: bool
    notes: tuple[str, ...] = ()

    def words(self) -> str:
        """Text of the outcome in one sentence."""
        took = f"{self.computed} of them computed now, in {duration(self.seconds)}"
        if self.interrupted:
            return (
                f"Interrupted: {self.path} keeps {self.done} of {self.total} samples ({took}); "
                "resume to go on."
            )
        return f"{self.path} holds all {self.done} samples, {took}."


class Meter:
    """Measurement of the rate at which samples are stored."""

    def __init__(self, done: int, total: int) -> None:
        self.total = total
        self._seen = deque([(time.monotonic(), done)], _RECENT)
        self._first = True

    def __call__(self, done: int, note: str = "") -> StudyProgress:
        """Progress when `done` samples are stored."""
        now = time.monotonic()
        if done > self._seen[-1][1]:
            self._seen.append((now, done))
            if self._first:
                # the time of the first chunk includes compilation, that of others does not
                self._seen.popleft()
                self._first = False
        begin, before = self._seen[0]
        rate = (self._seen[-1][1] - before) / max(self._seen[-1][0] - begin, 1e-9)
        remaining = (self.total - done) / rate if rate else math.inf
        return StudyProgress(done, self.total, rate, remaining, note)


def duration(seconds: float) -> str:
    """Text of a duration [s], such as "3.2 s", "4 min 10 s" or "2 h 5 min"."""
    if not math.isfinite(seconds):
        return "unknown time"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"
