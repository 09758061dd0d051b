"""Columns of a study: their names, units and roles, which stores, statistics and figures read."""

import re
from typing import Literal, NamedTuple

import numpy as np

# Codes of the column "status"; a study adds its own from 2 on.
MISSING = 0
FINE = 1


class Column(NamedTuple):
    """Column of a study's results, with a number or an array for each sample.

    Attributes:
        dtype: type of its numbers, such as "float64" or "int8".
        unit: SI unit; "1" where there is none.
        label: description for tables and figures.
        role: "input" for sampled factors, "quantity" for results, "diagnostic" for numbers that
            reports leave out, "status" for the code with which the sample ended.
        dims: names of further axes after the samples', which `Axis` gives.
    """

    dtype: str
    unit: str
    label: str
    role: Literal["input", "quantity", "diagnostic", "status"] = "quantity"
    dims: tuple[str, ...] = ()


def column_name(factor: str) -> str:
    """Column name of a factor, in which dots and brackets are replaced by underscores."""
    return re.sub(r"\W+", "_", factor).strip("_")


class Axis(NamedTuple):
    """Axis of columns in addition to that of the samples: its values (k,) and their unit."""

    values: np.ndarray
    unit: str
