"""Studies from TOML files, with the models and the columns of numbers of the files that they name.

A factor {file = "rates.csv", column = "p"} takes the numbers of that column: sampled at random, or
in order where the design is "table". The numbers themselves become part of the study, so that a
store no longer depends on the file.
"""

import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import SHOWN, named, shown
from .model_file import ParametricModel, Robot, read_model
from .mujoco_import import load_robot
from .netcdf import FileError, read_toml


def load_study(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Plain data of a study's TOML file; a study without a name is named after the file.

    A model that the study names is looked for from the study's folder, and read.

    Raises:
        FileError: the file, or a file that it names, is missing or cannot be read.
        SettingError: a column that its file does not have.
    """
    source, content = Path(path), read_toml(path)
    if "bodies" in content:
        raise FileError(
            f'{source} is a model, not a study: a study names it with model = "{source.name}", beside '
            "its factors and quantities (docs/studies.md)."
        )
    if isinstance(content.get("model"), str):
        content["model"] = _model(source.parent / content["model"])
    factors = content.get("factors", {})
    if isinstance(factors, Mapping):
        content["factors"] = {
            name: _filled(one, source.parent) if isinstance(one, Mapping) else one
            for name, one in factors.items()
        }
    return {"name": source.stem} | content


def _model(path: Path) -> ParametricModel | Robot:
    if path.suffix == ".toml":
        return read_model(path)
    return Robot(load_robot(path))


def _filled(given: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Entry of a factor, with the numbers of the file that it names, if it names one."""
    if "file" not in given:
        return dict(given)
    extra = set(given) - {"file", "column", "relative"}
    if extra or "column" not in given:
        raise SettingError("A factor from a file has a file and a column, and nothing else.")
    for name in ("file", "column"):
        if not isinstance(given[name], str) or "\0" in given[name]:
            raise SettingError(f"A factor's '{name}' must be text, but it is {shown(given[name])}.")
    values = column(folder / given["file"], given["column"])
    more = {"relative": given["relative"]} if "relative" in given else {}
    return {"distribution": "empirical", "values": values} | more


def column(path: str | os.PathLike[str], name: str) -> list[float]:
    """Column of a CSV file with a header line, by name.

    Raises:
        FileError: the file is missing or not a text file.
        SettingError: the column is missing or there are two, or an entry in it is not a finite number.
    """
    source = Path(path)
    if source.exists() and not source.is_file():
        raise FileError(f"{source} is no file but a folder or a pipe.")
    try:
        with source.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            rows, header = list(reader), list(reader.fieldnames or [])
    except FileNotFoundError:
        raise FileError(f"There is no file {source}.") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{source} is not a readable CSV file: {error}.") from error
    if not rows:
        raise FileError(f"{source} has no rows below its header.")
    if name not in rows[0]:
        known = [key for key in rows[0] if key]
        near = nearest_names(name[:SHOWN], [key[:SHOWN] for key in known])
        raise SettingError(f"{source} has no column {named(name)}.{near}")
    if header.count(name) > 1:
        raise SettingError(f"{source} has {header.count(name)} columns {named(name)}.")
    values = []
    for line, row in enumerate(rows, start=2):
        try:
            values.append(float(row[name] or ""))
        except (TypeError, ValueError):
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise SettingError(
                f"{source}, line {line}: {shown(row[name])} in column '{name}' is not a finite number."
            )
    return values
