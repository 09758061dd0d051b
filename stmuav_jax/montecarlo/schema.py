"""What a study's file may hold: names, types and ranges of all its entries.

Distributions of factors are checked by `distribution.from_plain`, names of factors and signals by
the scene that is flown.
"""

import unicodedata
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from ..mechanics.errors import SettingError
from ..mechanics.schema import MOST, Count, Entries, Finite, Positive, checked, named, shown

# A flight of more seconds is not meant.
LONGEST = 1e6
# Numbers and rows that a column of the store's types can count.
MOST_STEPS = 2**31 - 1
MOST_SEED = 2**63 - 1
LONGEST_NAME = 100


def name_fault(name: str) -> str | None:
    """Why a text cannot name a study and so a folder: words that follow 'must'; None if it can."""
    if not 1 <= len(name) <= LONGEST_NAME:
        return f"have 1 to {LONGEST_NAME} characters"
    if name.startswith(".") or name != name.strip():
        return "begin with neither a dot nor a space, nor end with one"
    if any(c in '/\\:*?"<>|' or unicodedata.category(c).startswith("C") for c in name):
        return "have no separators of folders, no wildcards and no control characters"
    return None


def check_name(name: Any) -> str:
    """The name of a study.

    Raises:
        SettingError: not a text that can name a folder.
    """
    fault = name_fault(name) if isinstance(name, str) else "be text"
    if fault:
        raise SettingError(f"A study's name must {fault}, but it is {shown(name)}.")
    return name


def _name(name: str) -> str:
    if fault := name_fault(name):
        raise ValueError(f"must {fault}, since a folder has it too, but it is {shown(name)}.")
    return name


def _column(name: str) -> str:
    if not name.isidentifier() or len(name) > LONGEST_NAME:
        raise ValueError(
            f"has a quantity {named(name)}; letters, digits and _ can name one, up to "
            f"{LONGEST_NAME} of them."
        )
    return name


def _factor(given: Any) -> Any:
    if isinstance(given, Mapping):
        relative = given.get("relative", False)
        if not isinstance(relative, bool):
            raise ValueError(f"has 'relative', which must be true or false, not {shown(relative)}.")
        return dict(given)
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise ValueError(
            f"must be a number or a table with a distribution, but it is {shown(given)}."
        )
    return given


Name = Annotated[str, AfterValidator(_name)]
Factor = Annotated[Any, BeforeValidator(_factor)]
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]
Seconds = Annotated[float, Field(gt=0, le=LONGEST)]
Tolerance = Annotated[float, Field(gt=0, le=1)]
Pair = tuple[str, str, Annotated[float, Field(gt=-1, lt=1)]]


def _tuples(given: Any) -> Any:
    """Lists of a file as tuples, which strict models want."""
    return tuple(_tuples(x) for x in given) if isinstance(given, list) else given


class QuantityEntry(Entries):
    """What is kept of each flight."""

    signal: str
    take: Literal["final", "largest", "smallest", "path", "when_above", "when_below"]
    level: Finite | None = None
    stop: bool = False


class FailureEntry(Entries):
    """When a flight that was completed counts as a failure."""

    quantity: str
    above: Finite | None = None
    below: Finite | None = None


class FlightsFile(Entries):
    """A study of flights."""

    scene: Literal["tracker", "hexacopter", "uav_tracker"]
    factors: Annotated[dict[str, Factor], Field(min_length=1, max_length=1000)]
    quantities: Annotated[
        dict[Annotated[str, AfterValidator(_column)], QuantityEntry], Field(max_length=1000)
    ]
    kind: Literal["flights"] = "flights"
    name: Name = "study"
    case: Annotated[int, Field(ge=1, le=100)] | None = None
    samples: Count | None = None
    chunk: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None
    lanes: Annotated[int, Field(ge=8, le=2**16, multiple_of=8)] | None = None
    inputs: Literal["case", "trim"] = "case"
    drag: bool = False
    gusts: bool = False
    precision: Literal["float64", "float32"] = "float64"
    t1: Seconds = 1.0
    every: Positive | None = None
    rtol: Tolerance = 1e-8
    atol: Positive = 1e-8
    solver: Literal["dopri8", "tsit5"] = "dopri8"
    step: Positive | None = None
    max_steps: Annotated[int, Field(ge=1, le=MOST_STEPS)] = 20_000
    direction: (
        Annotated[tuple[Finite, Finite, Finite], BeforeValidator(_tuples)] | None
    ) = None  # fmt: skip
    seed: Seed = 0
    design: Literal["random", "latin", "sobol", "saltelli", "table"] = "random"
    stratum: Count | None = None
    correlation: Annotated[tuple[Pair, ...], BeforeValidator(_tuples)] = ()
    failure: FailureEntry | None = None


class EstimationFile(Entries):
    """A study of Part III's estimation over seeds."""

    kind: Literal["estimation"]
    case: Annotated[int, Field(ge=1, le=8)]
    name: Name = "estimation"
    tuning: Literal["report", "consistent"] = "consistent"
    t1: Annotated[float, Field(gt=0, le=1000)] = 2.0
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    samples: Count | None = None
    chunk: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None


def flights_file(plain: Mapping[str, Any]) -> FlightsFile:
    """A study of flights from its plain data, with all types and ranges checked.

    Raises:
        SettingError: an entry that is unknown, missing, of another type or out of range.
    """
    return checked(FlightsFile, plain, "A study")


def estimation_file(plain: Mapping[str, Any]) -> EstimationFile:
    """A study of estimation, as `flights_file`."""
    return checked(EstimationFile, plain, "A study of estimation")


def check_count(value: Any, what: str, most: int = MOST) -> int:
    """A whole number from 1 on.

    Raises:
        SettingError: another number, or one that is too large to be meant.
    """
    if type(value) is int and value < 1:
        raise SettingError(f"{what} must be 1 or more, not {shown(value)}.")
    if isinstance(value, bool) or not isinstance(value, int) or value > most:
        raise SettingError(
            f"{what} must be a whole number from 1 to {most:,}, but it is {shown(value)}."
        )
    return value
