"""Results of a study, read column by column: inputs, quantities and curves by name, words and unit.

A study is a dataset over `sample` with one variable per column; attributes of a variable are
`units`, `long_name` and `role` ("input", "quantity", "status"); those of the dataset are JSON texts
`identity` and `reasons` (words by code of the status).
"""

import dataclasses
import functools
import itertools
import json
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from ...files.netcdf import FileError
from ...montecarlo.statistics import independent
from ...montecarlo.work import FINE, MISSING, column_name

# Largest number of components of one column, such as joints; the rest is left out with a note.
COMPONENTS = 12

# Largest number of doubles of a curve that are read at once, 32 MiB.
BLOCK = 2**22


class StudyQuantity(NamedTuple):
    """Quantity with a number for each sample: a column, or one component of it.

    Attributes:
        key: name, such as "peak_force[joint=hinge_1]".
        column, place: column, and indices by dimension of the component in it.
        words, unit: description and unit for labels; "1" is no unit.
        whole: true if its numbers are integers or truth values.
    """

    key: str
    column: str
    place: dict[str, int]
    words: str
    unit: str
    whole: bool = False


class Curve(NamedTuple):
    """Curve of numbers over an axis for each sample, with further attributes as in `StudyQuantity`.

    Attributes:
        axis: dimension of the axis.
        axis_words, axis_unit: description and unit of the axis for its label.
    """

    key: str
    column: str
    place: dict[str, int]
    words: str
    unit: str
    axis: str
    axis_words: str
    axis_unit: str


@dataclasses.dataclass(frozen=True)
class StudyData:
    """Dataset of a study with the meaning of its columns; made by `study_data`.

    Attributes:
        dataset: dataset as stored; columns are read when they are needed.
        status: status codes of the samples (n,).
        identity, reasons: identity of the study and reasons of failures, parsed from attributes.
        inputs, quantities, curves: inputs, quantities and curves of the study.
        notes: remarks on columns that are left out.
    """

    dataset: xr.Dataset
    status: np.ndarray
    identity: dict[str, Any]
    reasons: dict[int, str]
    inputs: tuple[StudyQuantity, ...]
    quantities: tuple[StudyQuantity, ...]
    curves: tuple[Curve, ...]
    notes: tuple[str, ...]

    @functools.cached_property
    def sampling(self) -> dict[str, Any]:
        """Plain form of the sampling design, found in the identity; empty if it has none."""
        return next(_samplings(self.identity), {})

    @property
    def design(self) -> str:
        """Name of the sampling design; "" if unknown."""
        return str(self.sampling.get("design", ""))

    @property
    def factors(self) -> tuple[str, ...]:
        """Columns of the sampling's factors, in their order."""
        given = self.sampling.get("factors", ())
        names = given if isinstance(given, Mapping) else (one["name"] for one in given)
        return tuple(column_name(str(name)) for name in names)

    @property
    def title(self) -> str:
        """Title of the study."""
        for place in (self.dataset.attrs, self.identity):
            for name in ("title", "name", "study"):
                if isinstance(place.get(name), str):
                    return place[name]
        return "Study"

    @functools.cached_property
    def chosen(self) -> np.ndarray:
        """Mask of the samples that share no factor values with others (n,)."""
        return independent(len(self.status), len(self.factors) + 2, self.design)

    @functools.cached_property
    def computed(self) -> np.ndarray:
        """Increasing numbers of the computed samples among the chosen ones."""
        return np.flatnonzero(self.chosen & (self.status != MISSING))

    @functools.cached_property
    def fine(self) -> np.ndarray:
        """Increasing numbers of the completed samples among the chosen ones."""
        return np.flatnonzero(self.chosen & (self.status == FINE))

    def whole_column(self, one: StudyQuantity) -> np.ndarray:
        """Values of all samples (n,) as doubles."""
        return np.asarray(self.dataset[one.column].isel(one.place).values, dtype=float)

    def values(
        self, one: StudyQuantity, of: Literal["fine", "computed"] = "fine", limit: int | None = None
    ) -> np.ndarray:
        """Values of the first `limit` chosen samples that are completed or computed."""
        numbers = (self.fine if of == "fine" else self.computed)[:limit]
        stop = int(numbers[-1]) + 1 if len(numbers) else 0
        part = self.dataset[one.column].isel({"sample": slice(0, stop)} | one.place)
        return np.asarray(part.values, dtype=float)[numbers]

    def table(
        self, of: Literal["fine", "computed"] = "fine", limit: int | None = None
    ) -> np.ndarray:
        """Values of the inputs (n, d) of the samples as in `values`."""
        columns = [self.values(one, of, limit) for one in self.inputs]
        count = len((self.fine if of == "fine" else self.computed)[:limit])
        return np.stack(columns, axis=1) if columns else np.empty((count, 0))

    def curve(self, one: Curve, limit: int) -> tuple[np.ndarray, np.ndarray]:
        """Axis (k,), and curves (m, k) of the first m <= `limit` completed samples."""
        numbers = self.fine[:limit]
        axis = np.asarray(self.dataset[one.axis].values, dtype=float)
        part = self.dataset[one.column].isel(one.place).transpose("sample", one.axis)
        size = max(1, BLOCK // max(len(axis), 1))
        parts = [np.empty((0, len(axis)))]
        # read in blocks, because the completed samples may lie far apart
        for start in range(0, int(numbers[-1]) + 1 if len(numbers) else 0, size):
            here = numbers[(numbers >= start) & (numbers < start + size)] - start
            if len(here):
                block = part.isel(sample=slice(start, start + size)).values
                parts.append(np.asarray(block, dtype=float)[here])
        return axis, np.concatenate(parts)


def study_data(dataset: xr.Dataset) -> StudyData:
    """Read the meaning of a study's columns.

    Raises:
        FileError: no dimension "sample", not one status column, or attributes that are not JSON.
    """
    if "sample" not in dataset.dims:
        raise FileError(f"This is no study: its dimensions are {list(dataset.dims)}, not 'sample'.")
    roles = {str(name): variable.attrs.get("role") for name, variable in dataset.items()}
    status = [name for name, role in roles.items() if role == "status"]
    if len(status) != 1:
        raise FileError(f"A study has one column of the role 'status', but here are {status}.")
    identity = _json(dataset, "identity")
    reasons = {int(code): str(words) for code, words in _json(dataset, "reasons").items()}
    inputs: list[StudyQuantity] = []
    quantities: list[StudyQuantity] = []
    curves: list[Curve] = []
    notes: list[str] = []
    for name, role in roles.items():
        if role not in ("input", "quantity") or "sample" not in dataset[name].dims:
            continue
        for one in _parts(dataset, name, notes):
            if isinstance(one, Curve):
                curves.append(one)
            else:
                (inputs if role == "input" else quantities).append(one)
    codes = np.asarray(dataset[status[0]].values)
    found = (tuple(quantities), tuple(curves), tuple(notes))
    data = StudyData(dataset, codes, identity, reasons, tuple(inputs), *found)
    # inputs in the order of the factors, since a folder may have sorted its columns
    place = {name: k for k, name in enumerate(data.factors)}
    inputs.sort(key=lambda one: place.get(one.key, len(place)))
    return dataclasses.replace(data, inputs=tuple(inputs))


def label(words: str, unit: str) -> str:
    """Label with a unit in brackets."""
    return words if unit in ("", "1") else f"{words} [{unit}]"


def _parts(dataset: xr.Dataset, name: str, notes: list[str]) -> Iterator[StudyQuantity | Curve]:
    """Quantities and curves of a column."""
    variable = dataset[name]
    words = str(variable.attrs.get("long_name") or name.replace("_", " "))
    unit = str(variable.attrs.get("units", "1"))
    further = [str(dim) for dim in variable.dims if dim != "sample"]
    axis = _axis(dataset, further)
    others = [dim for dim in further if dim != axis]
    places = list(itertools.product(*(range(dataset.sizes[dim]) for dim in others)))
    if len(places) > COMPONENTS:
        notes.append(
            f"Of the {len(places)} components of '{name}' the first {COMPONENTS} are shown."
        )
    for place in places[:COMPONENTS]:
        where = dict(zip(others, place, strict=True))
        marks = [f"{dim}={_mark(dataset, dim, k)}" for dim, k in where.items()]
        key = f"{name}[{', '.join(marks)}]" if marks else name
        said = f"{words}, {', '.join(m.split('=')[1] for m in marks)}" if marks else words
        if axis:
            given = dataset[axis].attrs
            axis_words = str(given.get("long_name") or axis.replace("_", " "))
            yield Curve(
                key, name, where, said, unit, axis, axis_words, str(given.get("units", "1"))
            )
        else:
            yield StudyQuantity(key, name, where, said, unit, variable.dtype.kind in "biu")


def _axis(dataset: xr.Dataset, dims: list[str]) -> str | None:
    """Dimension of the curves' axis: time, or else the first that has numbers with a unit."""
    if "time" in dims:
        return "time"
    for dim in dims:
        numbers = dim in dataset.coords and dataset[dim].dtype.kind in "iuf"
        if numbers and dataset[dim].attrs.get("units", "1") not in ("", "1"):
            return dim
    return None


def _mark(dataset: xr.Dataset, dim: str, k: int) -> str:
    return str(dataset[dim].values[k]) if dim in dataset.coords else str(k)


def _json(dataset: xr.Dataset, name: str) -> dict[str, Any]:
    try:
        found = json.loads(dataset.attrs.get(name, "{}"))
    except (TypeError, ValueError) as error:
        raise FileError(f"The study's attribute '{name}' is not JSON: {error}.") from None
    if not isinstance(found, dict):
        raise FileError(f"The study's attribute '{name}' must be a JSON object.")
    return found


def _samplings(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        if {"design", "seed", "factors"} <= set(value):
            yield value
        for inner in value.values():
            yield from _samplings(inner)
