"""How far a study has come: while it runs, and at the end."""

import math
import time
from collections import deque
from pathlib import Path
from typing import NamedTuple

# Chunks over which a rate is taken.
_RECENT = 16


class Standing(NamedTuple):
    """Where a running study stands.

    Attributes:
        done: samples stored. total: samples of the study.
        rate: samples stored in a second lately, without the first chunk, on the way to which code is
            compiled; 0 before there are two.
        remaining: seconds to go at this rate; inf while it is 0.
        note: what there is to say, such as that memory was short; empty if nothing.
    """

    done: int
    total: int
    rate: float
    remaining: float
    note: str = ""

    def words(self) -> str:
        """In one line."""
        at = f"{self.done} of {self.total} samples"
        if not self.rate:
            return at
        digits = 0 if self.rate >= 10 else 2
        return f"{at}, {self.rate:.{digits}f}/s, {duration(self.remaining)} to go"


class Outcome(NamedTuple):
    """What a run of a study came to.

    Attributes:
        path: of the store. done, total: samples stored, of all.
        computed: samples that this run computed. seconds: that it took.
        interrupted: whether it was stopped. notes: what there was to say on the way.
    """

    path: Path
    done: int
    total: int
    computed: int
    seconds: float
    interrupted: bool
    notes: tuple[str, ...] = ()

    def words(self) -> str:
        """In one sentence."""
        took = f"{self.computed} of them computed now, in {duration(self.seconds)}"
        if self.interrupted:
            return (
                f"Interrupted: {self.path} keeps {self.done} of {self.total} samples ({took}); "
                "resume to go on."
            )
        return f"{self.path} holds all {self.done} samples, {took}."


class Meter:
    """Takes the rate as samples are stored."""

    def __init__(self, done: int, total: int) -> None:
        self.total = total
        self._seen = deque([(time.monotonic(), done)], _RECENT)
        self._first = True

    def __call__(self, done: int, note: str = "") -> Standing:
        """The standing when `done` samples are stored."""
        now = time.monotonic()
        if done > self._seen[-1][1]:
            self._seen.append((now, done))
            if self._first:
                # code is compiled on the way to the first chunk, and not on the way to others
                self._seen.popleft()
                self._first = False
        begin, before = self._seen[0]
        rate = (self._seen[-1][1] - before) / max(self._seen[-1][0] - begin, 1e-9)
        remaining = (self.total - done) / rate if rate else math.inf
        return Standing(done, self.total, rate, remaining, note)


def duration(seconds: float) -> str:
    """Seconds in words, such as "3.2 s", "4 min 10 s" or "2 h 5 min"."""
    if not math.isfinite(seconds):
        return "unknown time"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"
