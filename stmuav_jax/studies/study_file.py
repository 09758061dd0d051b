"""Studies from TOML files and their plain data, with the models and columns of numbers that they name.

A factor {file = "rates.csv", column = "p"} takes the numbers of that column: sampled at random, or
in order where the design is "table". The numbers themselves become part of the study, so that a
store no longer depends on the file.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..checks.errors import SettingError
from ..checks.schema import format_value, validate_model
from ..dynamics.choices import solver_named
from ..dynamics.method import Method
from ..io.csv_table import read_csv_table
from ..io.model_file import Robot, read_model
from ..io.mujoco_import import load_robot
from ..io.netcdf import FileError, read_toml
from ..mechanics.parameters import Parameters
from .disturbed_flights import AbstractFlights, ModelFlights, make_flights, start_states
from .estimates import make_estimation_study
from .flights import FlightEvaluation, make_flight_study
from .sampling import Sampling
from .schema import Drawing, EstimationFile, FlightsFile, Integrating, MissionStudyFile
from .study import Study


def load_study(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Plain data of a study's TOML file, checked; a study without a name is named after the file.

    A model that the study names is looked for from the study's folder, and read. What depends on the
    scene, the model or the mission, such as names of factors and signals, is checked where the study
    is made.

    Raises:
        FileError: the file, or a file that it names, is missing or cannot be read.
        SettingError: a column that its file does not have, or as `check_study`.
    """
    source, content = Path(path), read_toml(path)
    if "bodies" in content:
        raise FileError(
            f'{source} is a model, not a study: a study names it with model = "{source.name}", beside '
            "its factors and quantities (docs/studies.md)."
        )
    if isinstance(content.get("model"), str):
        model = source.parent / content["model"]
        is_toml = model.suffix == ".toml"
        content["model"] = read_model(model) if is_toml else Robot(load_robot(model))
    factors = content.get("factors", {})
    if isinstance(factors, Mapping):
        content["factors"] = {
            name: _fill_entry(factor, source.parent) if isinstance(factor, Mapping) else factor
            for name, factor in factors.items()
        }
    content = {"name": source.stem} | content
    try:
        check_study(content)
    except SettingError as error:
        raise SettingError(f"{source}: {error}") from None
    return content


def make_study(plain: Mapping[str, Any], table: Parameters | None = None, **settings: Any) -> Study:
    """Study from plain data in the form of its TOML file (see docs/studies.md).

    Args:
        plain: plain data of a study of flights or of estimation; `stmuav_jax.missions.load_mission_study`
            makes one of a mission.
        table: parameter table of the scene, where the user has changed some.
        settings: `lanes`, `block` and `devices` of the `Study`.

    Raises:
        SettingError: an unknown entry (with the nearest known one), or numbers that do not fit.
    """
    kind = study_kind(plain)
    if kind == "missions":
        raise SettingError(
            "A study of a mission is made by stmuav_jax.missions.load_mission_study."
        )
    if kind == "estimation":
        if table is not None:
            raise SettingError(
                "A study of estimation cannot have a table of parameters: leave it out."
            )
        entries = validate_model(EstimationFile, plain, "A study of estimation")
        return make_estimation_study(entries, **settings)
    entries = validate_model(FlightsFile, plain, "A study")
    factors, relative = factors_of(entries.factors)
    method = entries.model_dump(include=set(Integrating.model_fields))
    evaluation = FlightEvaluation(
        _read_flights(entries, table, relative), entries.quantities, entries.t1, entries.every,
        Method(**method | {"solver": solver_named(entries.solver)}), entries.direction,
    )  # fmt: skip
    if settings.get("lanes") is None:
        settings["lanes"] = entries.lanes
    return make_flight_study(
        evaluation, factors, failure=entries.failure, **study_settings(entries), **settings
    )


def factors_of(entries: Mapping[str, Any]) -> tuple[dict[str, Any], frozenset[str]]:
    """Distributions of the factors in plain form, and the names of relative ones."""
    tables = {name: dict(entry) for name, entry in entries.items() if isinstance(entry, Mapping)}
    relative = frozenset(name for name, table in tables.items() if table.pop("relative", False))
    return {**entries, **tables}, relative


def study_settings(entries: FlightsFile | MissionStudyFile) -> dict[str, Any]:
    """Settings of a `Study` among the entries of its file: name, samples, chunk and design."""
    return entries.model_dump(include={"name", "samples", "chunk", *Drawing.model_fields})


def study_kind(plain: Mapping[str, Any]) -> str:
    """Kind of a study: flights, estimation or missions; raises `SettingError` for any other."""
    kind = plain.get("kind", "flights")
    if kind not in ("flights", "estimation", "missions"):
        raise SettingError(
            f"A study's kind is flights, estimation, or missions with a mission, not {format_value(kind)}."
        )
    return kind


def check_study(plain: Mapping[str, Any]) -> None:
    """Check the plain data of a study of any kind, as far as no scene or mission has to be built.

    Raises:
        SettingError: an entry that is unknown, missing, of another type or out of range; a
            distribution with other parameters than its own, or a design that does not fit.
    """
    kind = study_kind(plain)
    if kind == "estimation":
        validate_model(EstimationFile, plain, "A study of estimation")
        return
    model, owner = (
        (MissionStudyFile, "A study of a mission")
        if kind == "missions"
        else (FlightsFile, "A study")
    )
    entries = validate_model(model, plain, owner)
    # The sampling is made for its checks alone, so that files and Python share one set of them.
    design = entries.model_dump(include=set(Drawing.model_fields))
    Sampling(factors_of(entries.factors)[0], **design)


def _read_flights(
    entries: FlightsFile, table: Parameters | None, relative: frozenset[str]
) -> AbstractFlights:
    """Settings of the runs: of a scene by name, or of a model."""
    if (entries.scene is None) == (entries.model is None):
        raise SettingError("A study needs a scene or a model's file, and not both.")
    if entries.scene is not None:
        return make_flights(
            entries.scene, entries.case, table, relative=relative, inputs=entries.inputs, drag=entries.drag,
            gusts=entries.gusts, options=entries.options, duration=entries.t1,
        )  # fmt: skip
    for name in ("case", "drag", "gusts", "options"):
        if getattr(entries, name):
            raise SettingError(f"'{name}' is for scenes; a model's file has its own numbers.")
    if table is not None:
        raise SettingError("A table of parameters is for scenes; a model's file has its own.")
    return ModelFlights(entries.model, relative, entries.inputs, start_states(entries.factors))


def _fill_entry(entry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Entry of a factor, with the numbers of the file that it names, if it names one."""
    if "file" not in entry:
        return dict(entry)
    extra = set(entry) - {"file", "column", "relative"}
    if extra or "column" not in entry:
        raise SettingError("A factor from a file has a file and a column, and nothing else.")
    for name in ("file", "column"):
        # The system refuses a path with a null character by an error that names neither the file
        # nor the factor.
        if not isinstance(entry[name], str) or "\0" in entry[name]:
            raise SettingError(
                f"A factor's '{name}' must be text, but it is {format_value(entry[name])}."
            )
    # The numbers become part of the study: its store does not depend on a file that may change.
    values = column(folder / entry["file"], entry["column"])
    more = {"relative": entry["relative"]} if "relative" in entry else {}
    return {"distribution": "empirical", "values": values} | more


def column(path: str | os.PathLike[str], name: str) -> list[float]:
    """Column of a CSV file with a header line, by name.

    Raises:
        FileError: the file is missing or not a text file, or an entry of the column is not a finite number.
        SettingError: the column is missing or there are two.
    """
    return read_csv_table(path).read_numbers(name).tolist()
