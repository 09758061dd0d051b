"""What a store and a scheduler know of a study: samples by number, and named columns of results."""

import abc
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

# Codes of the column "status"; a work adds its own from 2 on.
MISSING, FINE = 0, 1


class Column(NamedTuple):
    """One column of a study's results, a number or an array for each sample.

    Attributes:
        dtype: of its numbers, such as "float64" or "int8".
        unit: in SI units; "1" where there is none. words: what it is, for tables and figures.
        role: "input" was drawn, "quantity" was computed, "diagnostic" is kept but not reported,
            "status" says how the sample ended.
        dims: names of further axes after the samples', which `Axis` gives.
    """

    dtype: str
    unit: str
    words: str
    role: Literal["input", "quantity", "diagnostic", "status"] = "quantity"
    dims: tuple[str, ...] = ()


class Axis(NamedTuple):
    """A further axis of columns: its values (k,) and their unit."""

    values: np.ndarray
    unit: str


class AbstractWork(abc.ABC):
    """Samples that can be computed by number, in any order and anywhere.

    A work pickles small: what is expensive, such as compiled code, is made when it is first needed
    in a process and left out of the pickle.
    """

    @property
    @abc.abstractmethod
    def identity(self) -> Mapping[str, Any]:
        """Everything that decides the numbers, as plain data that JSON can hold."""

    @property
    @abc.abstractmethod
    def columns(self) -> Mapping[str, Column]:
        """Columns by name; one of them, "status", has the role of that name and type int8."""

    @property
    @abc.abstractmethod
    def axes(self) -> Mapping[str, Axis]:
        """Further axes by name."""

    @property
    @abc.abstractmethod
    def reasons(self) -> Mapping[int, str]:
        """What codes of "status" from 2 on mean: why a sample failed."""

    @property
    @abc.abstractmethod
    def unit(self) -> int:
        """Samples best computed together, 1 or more; `run` is quickest for multiples of it."""

    @abc.abstractmethod
    def run(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns (count, ...) of the samples first, first + 1, ...

        A sample's numbers depend on its own number only, not on `first` or `count`.
        """
