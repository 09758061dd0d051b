"""Schema of a study's file: names, types and ranges of all its entries.

Distributions of factors are checked by `distribution.as_distribution`, names of factors and signals
by the scene that is simulated.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, model_validator

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import (
    LONGEST_NAME,
    MOST,
    SHOWN,
    Count,
    Entries,
    Finite,
    Name,
    Positive,
    Seed as Seed,
    Tuples,
    format_value,
    quote_name,
    validate_model,
)
from ..dynamics.choices import STEP_TOLERANCE, ExplicitSolverName
from ..uav.scenes.registry import SCENES

# Longest permitted run [s]; a longer one is taken for a mistake.
LONGEST = 1e6
# Number of steps after which a run has failed, where a study does not say.
STEPS_OF_A_RUN = 20_000
# Largest number that the store's column type can hold.
MOST_STEPS = 2**31 - 1


def _check_column(name: str) -> str:
    if not name.isidentifier() or len(name) > LONGEST_NAME:
        raise ValueError(
            f"has a quantity {quote_name(name)}; letters, digits and _ can name one, up to "
            f"{LONGEST_NAME} of them."
        )
    return name


def _check_factor(entry: Any) -> Any:
    if isinstance(entry, Mapping):
        relative = entry.get("relative", False)
        if not isinstance(relative, bool):
            raise ValueError(
                f"has 'relative', which must be true or false, not {format_value(relative)}."
            )
        return dict(entry)
    if isinstance(entry, bool) or not isinstance(entry, int | float):
        raise ValueError(
            f"must be a number or a table with a distribution, but it is {format_value(entry)}."
        )
    return entry


def _check_scene(name: str) -> str:
    if name not in SCENES:
        raise ValueError(
            f"must be one of {', '.join(SCENES)}, not {format_value(name)}.{nearest_names(name[:SHOWN], SCENES)}"
        )
    return name


def _check_model(model: Any) -> Any:
    if model is None or not hasattr(model, "system"):
        raise ValueError(
            f"must be a model that stmuav_jax.io.read_model has read, but it is {format_value(model)}; "
            "stmuav_jax.studies.load_study reads the one that a study's file names."
        )
    return model


SceneName = Annotated[str, AfterValidator(_check_scene)]
Factor = Annotated[Any, BeforeValidator(_check_factor)]
Seconds = Annotated[float, Field(gt=0, le=LONGEST)]
# The lower bound is the round-off of a step.
Tolerance = Annotated[float, Field(ge=1e-15, le=1)]
Take = Literal["final", "largest", "smallest", "path", "when_above", "when_below"]
Design = Literal["random", "latin", "sobol", "saltelli", "table"]
Pair = tuple[str, str, Annotated[float, Field(gt=-1, lt=1)]]


class QuantityEntry(Entries):
    """Entry for a quantity that is stored for each run."""

    signal: str
    take: Take
    level: Finite | None = None
    stop: bool = False

    @property
    def is_crossing(self) -> bool:
        """True for the time of a crossing."""
        return self.take.startswith("when_")

    @model_validator(mode="after")
    def _check_crossing(self) -> "QuantityEntry":
        if self.is_crossing != (self.level is not None):
            rule = "needs a level" if self.is_crossing else "has no level"
            raise ValueError(f"is wrong: '{self.take}' of signal {quote_name(self.signal)} {rule}.")
        if self.stop and not self.is_crossing:
            raise ValueError(
                f"has 'stop', which needs take = \"when_above\" or \"when_below\", not '{self.take}'."
            )
        return self


class Quantity(QuantityEntry):
    """Quantity, a number or a history, that is stored for each run.

    Attributes:
        signal: name of a signal, see `stmuav_jax.studies.signal`.
        take: "final" value; "largest", "smallest" over the run; "path": values every
            `Study.every` seconds; "when_above", "when_below": time at which the signal first
            crosses `level` [s], infinite if it never does.
        level: level in the signal's unit, of a crossing alone.
        stop: end the run when the signal crosses the level; final values are then those of that
            step, and paths are NaN from there on.

    Raises:
        SettingError: an unknown `take`, a level without a crossing or a crossing without one, `stop` without
            a crossing, or a level that is not finite.
    """

    def __init__(self, **entries: Any) -> None:
        super().__init__(**validate_model(QuantityEntry, entries, "A quantity").model_dump())


class FailureEntry(Entries):
    """Entry for the condition under which a completed run counts as a failure."""

    quantity: str
    above: Finite | None = None
    below: Finite | None = None


class Failure(FailureEntry):
    """Condition under which a completed run counts as a failure; reports give its probability.

    Attributes:
        quantity: name of one of the study's quantities, not a path.
        above, below: limits in the quantity's unit: a run above the one or below the other has
            failed. A crossing without limits is a failure if it happens at all.

    Raises:
        SettingError: a limit that is not finite.
    """

    def __init__(self, **entries: Any) -> None:
        super().__init__(**validate_model(FailureEntry, entries, "A failure").model_dump())


class Drawing(Entries):
    """Entries of a sampling design, except its factors."""

    seed: Seed = 0
    design: Design = "random"
    stratum: Count | None = None
    correlation: Annotated[tuple[Pair, ...], Tuples] = ()


class Flying(Entries):
    """Entries of a study for the length and the recording of each run."""

    name: Name = "study"
    t1: Seconds = 1.0
    every: Positive | None = None
    direction: Annotated[tuple[Finite, Finite, Finite], Tuples] | None = None


class Integrating(Entries):
    """Entries of a study for the method of its runs, see `stmuav_jax.Method`."""

    rtol: Tolerance = STEP_TOLERANCE
    atol: Annotated[float, Field(ge=1e-15)] = STEP_TOLERANCE
    solver: ExplicitSolverName = "dopri8"
    max_steps: Annotated[int, Field(ge=1, le=MOST_STEPS)] = STEPS_OF_A_RUN


class FlightsFile(Drawing, Flying, Integrating):
    """Entries of a study of simulated motions."""

    scene: SceneName | None = None
    model: Annotated[Any, BeforeValidator(_check_model)] = None
    factors: Annotated[dict[str, Factor], Field(min_length=1, max_length=1000)]
    quantities: Annotated[
        dict[Annotated[str, AfterValidator(_check_column)], QuantityEntry], Field(max_length=1000)
    ]
    kind: Literal["flights"] = "flights"
    case: Annotated[int, Field(ge=1, le=100)] | None = None
    samples: Count = 1024
    chunk: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None
    lanes: Annotated[int, Field(ge=8, le=2**16, multiple_of=8)] | None = None
    inputs: Literal["case", "trim"] = "case"
    drag: bool = False
    gusts: bool = False
    options: dict[str, Any] = Field(default_factory=dict)
    failure: FailureEntry | None = None


class EstimationFile(Entries):
    """Entries of a study of Part III's estimation over noise seeds."""

    kind: Literal["estimation"]
    case: Annotated[int, Field(ge=1, le=8)]
    name: Name = "estimation"
    tuning: Literal["report", "consistent"] = "consistent"
    t1: Annotated[float, Field(ge=0.05, le=1000)] = 2.0
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    samples: Count = 1024
    chunk: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None


class MissionStudyFile(Drawing):
    """Entries of a Monte Carlo study of a mission, which is built in or a file in the study's folder.

    Its end `t1` [s] takes the place of the mission's.
    """

    kind: Literal["missions"]
    name: Name = "missions"
    mission: str
    t1: Annotated[float, Field(gt=0, le=LONGEST)] | None = None
    factors: Annotated[dict[str, Factor], Field(min_length=1, max_length=1000)]
    samples: Count = 1024
    chunk: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None


def study_json_schema() -> dict[str, Any]:
    """JSON schema of a study's file, for editors."""
    return TypeAdapter(FlightsFile | EstimationFile | MissionStudyFile).json_schema()


def check_count(value: Any, subject: str, most: int = MOST) -> int:
    """Check that a value is a whole number from 1 to `most`, and return it.

    Raises:
        SettingError: any other value.
    """
    if type(value) is int and value < 1:
        raise SettingError(f"{subject} must be 1 or more, not {format_value(value)}.")
    if isinstance(value, bool) or not isinstance(value, int) or value > most:
        raise SettingError(
            f"{subject} must be a whole number from 1 to {most:,}, but it is {format_value(value)}."
        )
    return value
