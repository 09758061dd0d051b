"""Labelled arrays, which are written as NetCDF (HDF5) without xarray, or made an xarray dataset.

A command that writes a file does not wait for xarray, pandas and what they import.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

# Dimensions, values and attributes of an array.
Parts = tuple[tuple[str, ...], Any, dict[str, str]]


@dataclass(frozen=True)
class Labelled:
    """Arrays with names, dimensions, coordinates and attributes, as in an `xarray.Dataset`.

    Attributes:
        variables: dimensions, values and attributes by name.
        coordinates: the same of coordinates; those with the name of a dimension are its labels.
        attributes: texts and integers.
    """

    variables: Mapping[str, Parts]
    coordinates: Mapping[str, Parts]
    attributes: Mapping[str, str | int]

    def dataset(self) -> "xr.Dataset":
        """Dataset of xarray with the same content."""
        import xarray as xr

        return xr.Dataset(dict(self.variables), dict(self.coordinates), dict(self.attributes))

    def netcdf(self, *, checksums: bool = False) -> bytes:
        """Content of a NetCDF file (HDF5), from which xarray reads `dataset()`.

        Args:
            checksums: add Fletcher's checksum to the numbers, which any reader of HDF5 verifies.
        """
        import h5netcdf

        buffer = io.BytesIO()
        with h5netcdf.File(buffer, "w") as file:
            arrays = {**self.coordinates, **self.variables}
            for dims, values, _ in arrays.values():
                for name, size in zip(dims, np.shape(values), strict=True):
                    if name not in file.dimensions:
                        file.dimensions[name] = size
            for name, parts in arrays.items():
                _write(file, name, parts, checksums)
            others = [k for k, (dims, *_) in self.coordinates.items() if (k,) != dims]
            named = {"coordinates": " ".join(others)} if others else {}
            for key, value in {**self.attributes, **named}.items():
                file.attrs[key] = value
        return buffer.getvalue()


def _write(file: Any, name: str, parts: Parts, checksums: bool) -> None:
    """Write one array with its attributes."""
    import h5py

    dims, values, attributes = parts
    values, about, more = np.asarray(values), dict(attributes), {}
    if values.dtype.kind == "b":
        # NetCDF has no truth values; xarray's mark for them
        values, about["dtype"] = values.astype(np.int8), "bool"
    # HDF5 has no checksums of scalars
    checked = checksums and values.dtype.kind == "f" and values.ndim and values.size
    if checked:
        more["fletcher32"] = True
    kind = h5py.string_dtype() if values.dtype.kind in "UO" else values.dtype
    values = values.astype(object) if values.dtype.kind == "U" else values
    variable = file.create_variable(name, dims, kind, data=values, **more)
    for key, value in about.items():
        variable.attrs[key] = value
