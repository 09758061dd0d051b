"""Studies whose samples NumPy computes, and which can be slow, large or deadly."""

import dataclasses
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from stmuav_jax import Study
from stmuav_jax.studies import FINE, Axis, Column


def uniform(seed: int, stream: int, numbers: np.ndarray) -> np.ndarray:
    """Uniform numbers in [0, 1) by sample number: the finaliser of SplitMix64."""
    with np.errstate(over="ignore"):
        # arrays, not scalars, since only these wrap round in silence
        base = np.asarray([seed * 1000003 + stream], np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = base + (numbers.astype(np.uint64) + np.uint64(1)) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)).astype(np.float64) / 2.0**53


@dataclasses.dataclass(frozen=True)
class Toy(Study):
    """Columns x (drawn), y = x^2, a path (5), a count of steps, and a status.

    Every sample whose x is below 0.1 fails: its y is not a number.
    """

    seed: int = 0
    more: int = 0  # further columns
    pause: float = 0.0  # seconds asleep for each call
    most: int | None = None  # more at once do not fit in memory
    words: str = "Out of memory"
    fall: tuple[int, str] | None = None  # sample whose process dies if this file is there
    together: int = 1
    log: str | None = None  # file that gets a line for each call
    chunk = None

    @property
    def identity(self) -> Mapping[str, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return {"what": "toy", "seed": self.seed, "law": {"power": 2, "limit": 0.1}}

    @property
    def columns(self) -> Mapping[str, Column]:  # pyright: ignore[reportIncompatibleVariableOverride]
        found = {
            "x": Column("float64", "m", "where it starts", "input"),
            "y": Column("float64", "m^2", "its square"),
            "path": Column("float64", "m", "where it goes", dims=("time",)),
            "steps": Column("int32", "1", "steps taken"),
            "status": Column("int8", "1", "how it ended", "status"),
        }
        extra = {f"z{k}": Column("float64", "1", f"number {k}") for k in range(self.more)}
        return found | extra

    @property
    def axes(self) -> Mapping[str, Axis]:
        return {"time": Axis(np.linspace(0.0, 1.0, 5), "s")}

    @property
    def reasons(self) -> Mapping[int, str]:
        return {2: "too near to zero"}

    @property
    def unit(self) -> int:
        return self.together

    def compute(self, first: int, count: int) -> dict[str, np.ndarray]:
        if self.log is not None:
            with open(self.log, "a") as file:
                threads = os.environ.get("NPROC", "0")
                file.write(f"{os.getpid()} {first} {count} {threads}\n")
        if self.most is not None and count > self.most:
            raise (MemoryError if self.words == "" else RuntimeError)(self.words)
        if self.fall is not None and first <= self.fall[0] < first + count:
            marker = Path(self.fall[1])
            if marker.exists():
                # once, or with something in it always
                if not marker.read_text():
                    marker.unlink()
                os.kill(os.getpid(), signal.SIGKILL)
        if self.pause:
            time.sleep(self.pause)
        numbers = np.arange(first, first + count)
        x = uniform(self.seed, 0, numbers)
        fine = x >= 0.1
        extra = {f"z{k}": uniform(self.seed, k + 1, numbers) for k in range(self.more)}
        return {
            "x": x,
            "y": np.where(fine, x**2, np.nan),
            "path": x[:, None] * np.linspace(0.0, 1.0, 5),
            "steps": (100 * x).astype(np.int32),
            "status": np.where(fine, FINE, 2).astype(np.int8),
        } | extra


def contents(folder: str | os.PathLike[str]) -> dict[str, bytes]:
    """All files of a folder by name."""
    root = Path(folder)
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


class Precise(Study):
    """x = a third, times the number, in JAX's precision, which the column demands to be double."""

    chunk = None

    def __init__(self, log: str | None = None) -> None:
        self.log = log
        self.third = jnp.asarray(1.0) / 3.0

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self.log is not None:
            with open(self.log, "a") as file:
                file.write(f"made {os.getpid()}\n")

    @property
    def identity(self) -> Mapping[str, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return {"what": "thirds"}

    @property
    def columns(self) -> Mapping[str, Column]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return {
            "x": Column("float64", "1", "a third of the number"),
            "status": Column("int8", "1", "how it ended", "status"),
        }

    @property
    def axes(self) -> Mapping[str, Axis]:
        return {}

    @property
    def reasons(self) -> Mapping[int, str]:
        return {}

    @property
    def unit(self) -> int:
        return 1

    def compute(self, first: int, count: int) -> dict[str, np.ndarray]:
        numbers = jnp.arange(first, first + count) * self.third
        assert self.third.dtype == numbers.dtype == jnp.float64
        return {"x": np.asarray(numbers), "status": np.full(count, FINE, np.int8)}
