"""Permitted values of the command line's options, described and checked in one place."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from ..checks.errors import SettingError
from ..checks.schema import format_value


@dataclasses.dataclass(frozen=True)
class Number:
    """Finite number within a range, or tuple of such numbers, as the value of an option.

    Attributes:
        quantity: name of the number in the error message "The {what} must ...".
        unit: unit of the number.
        low, high: ends of the range, included.
        above: open lower end of the range, instead of `low`.
    """

    quantity: str
    unit: str = ""
    low: float | int = -math.inf
    high: float | int = math.inf
    above: float | int | None = None

    def check(self, value: Any, option: str) -> None:
        """Raise SettingError unless a value, or each of a tuple, is None or within the range."""
        unit = f" {self.unit}" if self.unit else ""
        for entry in value if isinstance(value, tuple) else (value,):
            if entry is None:
                continue
            text = f"{entry:g}" if isinstance(entry, float) else format_value(entry)
            tail = f"but it is {text}{unit} ({option})."
            if not (isinstance(entry, int) or math.isfinite(entry)):
                raise SettingError(f"The {self.quantity} must be finite, {tail}")
            least = entry > self.above if self.above is not None else entry >= self.low
            if least and entry <= self.high:
                continue
            if self.above is not None:
                span = f"be above {self.above:g}"
                span += f" and at most {self.high:g}" if self.high < math.inf else ""
            elif self.low == -math.inf:
                span = f"be at most {self.high:g}"
            elif self.high == math.inf:
                span = f"be at least {self.low:g}"
            else:
                span = f"lie within {self.low:g} and {self.high:g}"
            raise SettingError(f"The {self.quantity} must {span}{unit}, {tail}")


def default_text(text: str) -> Any:
    """Annotation with a text in place of "default: None" in an option's help."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {text})")


# Texts of the options that several commands have: one word, one text.
TEXTS = {
    "case": "Case of the report.",
    "params": "TOML file with values that replace those of the parameter table.",
    "out": "Folder for the results.",
    "figures": "Format of the figures.",
    "cache": "Keep compiled code in the user's cache folder for the next run.",
    "resume": "Continue an interrupted run from the folder of its results.",
    "t1": "End of the time span [s].",
    "seed": "Seed of the random numbers.",
    "seeds": "Number of runs, each with noise of its own.",
    "sun": "Direction of the sun: azimuth clockwise from north (y), and elevation [degrees].",
    "climb": "Speed upwards [m/s].",
    "speed": "Level speed [m/s].",
    "course": "Direction of the level speed, from x (east) towards y (north) [degrees].",
    "turn": "Rate of turn, from x towards y [degrees/s].",
    "yaw": "Heading of the x axis, from x (east) towards y (north) [degrees].",
    "inputs": "Inputs that may be chosen, such as effort; the others stay as they are.",
    "what": "hold: constant inputs that keep the start. slew: histories of inputs that lead to another "
    "posture.",
    "duration": "Time that a slew takes, or over which hold counts departures from the start [s].",
    "knots": "slew: number of knots of the cubic splines.",
    "segments": "Number of segments of multiple shooting.",
    "steps": "Largest number of steps of the search.",
}


def shared_option(name: str, default: str | None = None) -> Any:
    """Annotation with the text of an option that several commands have, by its name in `TEXTS`.

    Args:
        default: text in place of "default: None".
    """
    hint = None if default is None else f"(default: {default})"
    return tyro.conf.arg(help=TEXTS[name], help_behavior_hint=hint)


# Options that several commands have.
ANGLE = Number("angle", "degrees", -360.0, 360.0)
SPEED = Number("speed", "m/s", -1000.0, 1000.0)
END = Number("end of the time span", "s", above=0.0, high=1e5)
SEED = Number("seed", "", 0, 2**32 - 1)
TURN = Number("rate of turn", "degrees/s", -3600.0, 3600.0)
FORCE = Number("limit of the force", "N", above=0.0, high=1e6)
TOLERANCE = Number("tolerance", "", above=0.0, high=1.0)

# Options that all or most commands have; the words of a default stand beside them.
Params = Annotated[Path | None, shared_option("params", "the report's values")]
Cache = Annotated[bool, shared_option("cache")]
Figures = Annotated[Literal["png", "pdf", "svg", "none"], shared_option("figures")]
Resume = Annotated[bool, shared_option("resume")]
Seed = Annotated[int, SEED, shared_option("seed")]


def count_range(items: str, high: float | int = 1e9) -> Number:
    """Range of a number of at least one of something."""
    return Number(f"number of {items}", "", 1, high)


def check_words(arguments: Sequence[str]) -> None:
    """Raise SettingError for an argument that is empty or contains a zero byte."""
    for before, word in zip(["", *arguments], arguments, strict=False):
        if not word.strip():
            where = f" after {before}" if before.startswith("--") else ""
            raise SettingError(f"There is an empty argument{where}: give a value, or leave it out.")
        if "\0" in word:
            raise SettingError("An argument contains a zero byte, which names cannot contain.")


def check_options(command: Any, arguments: Sequence[str]) -> None:
    """Raise SettingError unless every option of a command is in the range of its annotation."""
    hints = get_type_hints(type(command), include_extras=True)
    for field in dataclasses.fields(command):
        option = "--" + field.name.replace("_", "-")
        value = getattr(command, field.name)
        if dataclasses.is_dataclass(value):
            check_options(value, arguments)
        if value == () and option in arguments:
            raise SettingError(f"{option} needs at least one value after it.")
        for note in getattr(hints[field.name], "__metadata__", ()):
            if isinstance(note, Number):
                note.check(value, option)
