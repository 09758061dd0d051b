"""Interface of a study to stores and schedulers: samples by number, named columns of results."""

import abc
import re
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

# Codes of the column "status"; a work adds its own from 2 on.
MISSING, FINE = 0, 1


class Column(NamedTuple):
    """Column of a study's results, with a number or an array for each sample.

    Attributes:
        dtype: type of its numbers, such as "float64" or "int8".
        unit: SI unit; "1" where there is none.
        words: description for tables and figures.
        role: "input" for sampled factors, "quantity" for results, "diagnostic" for numbers that
            reports leave out, "status" for the code with which the sample ended.
        dims: names of further axes after the samples', which `Axis` gives.
    """

    dtype: str
    unit: str
    words: str
    role: Literal["input", "quantity", "diagnostic", "status"] = "quantity"
    dims: tuple[str, ...] = ()


def column_name(factor: str) -> str:
    """Column name of a factor, in which dots and brackets are replaced by underscores."""
    return re.sub(r"\W+", "_", factor).strip("_")


class Axis(NamedTuple):
    """Axis of columns in addition to that of the samples: its values (k,) and their unit."""

    values: np.ndarray
    unit: str


class AbstractWork(abc.ABC):
    """Work of a study: samples that can be computed by number, in any order and anywhere.

    Its pickle is small: expensive parts, such as compiled code, are made when they are first
    needed in a process, and are left out of the pickle.
    """

    @property
    @abc.abstractmethod
    def identity(self) -> Mapping[str, Any]:
        """Plain data, for JSON, of everything on which the numbers depend."""

    @property
    @abc.abstractmethod
    def columns(self) -> Mapping[str, Column]:
        """Columns by name; one of them, "status", has the role of that name and type int8."""

    @property
    @abc.abstractmethod
    def axes(self) -> Mapping[str, Axis]:
        """Axes of the columns by name, in addition to that of the samples."""

    @property
    @abc.abstractmethod
    def reasons(self) -> Mapping[int, str]:
        """Reasons of failed samples, by their codes of "status" from 2 on."""

    @property
    @abc.abstractmethod
    def unit(self) -> int:
        """Number of samples best computed together, 1 or more; `run` is quickest for multiples."""

    @abc.abstractmethod
    def run(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns (count, ...) of the samples first, first + 1, ...

        A sample's numbers depend on its own number only, not on `first` or `count`.
        """
