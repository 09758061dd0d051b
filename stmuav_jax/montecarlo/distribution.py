"""Distributions of uncertain numbers: by name, checked, and as plain data. SciPy does the mathematics.

A study's identity holds its distributions, so each has a plain form that TOML and JSON can hold:

    mass = {distribution = "normal", mean = 0.95, deviation = 0.02}
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..mechanics.errors import SettingError, nearest_names
from ..mechanics.schema import SHOWN, named, shown

# Whole numbers are fine wherever numbers are.
Number = float | int

# A parameter after its check: a number, or the numbers of a list.
Parameter = float | tuple[float, ...]
Given = Mapping[str, Any]


class _Kind(NamedTuple):
    """What a distribution needs, what must hold between its parameters, and SciPy's name for it.

    Attributes:
        parameters: by name, the kind of number: "finite", "positive", "limit" (may be infinite),
            "list" or "positives" (lists).
        defaults: of those that may be left out.
        relations: what must hold, and the words for it.
        scipy: name in `scipy.stats`; "" for those that are tables of values.
        arguments: SciPy's arguments from the parameters.
    """

    parameters: Mapping[str, str]
    defaults: Mapping[str, Any] = {}
    relations: tuple[tuple[Callable[[Any], bool], str], ...] = ()
    scipy: str = ""
    arguments: Callable[[Any], dict[str, float]] = lambda p: {}


_ORDERED = (lambda p: p["low"] < p["high"], "low must be below high")


def _between(p: Any, **more: float) -> dict[str, float]:
    return {"loc": p["low"], "scale": p["high"] - p["low"]} | more


def _truncated(p: Any) -> dict[str, float]:
    a, b = ((p[end] - p["mean"]) / p["deviation"] for end in ("low", "high"))
    return {"a": a, "b": b, "loc": p["mean"], "scale": p["deviation"]}


KINDS: Mapping[str, _Kind] = {
    "normal": _Kind(
        {"mean": "finite", "deviation": "positive"},
        scipy="norm", arguments=lambda p: {"loc": p["mean"], "scale": p["deviation"]},
    ),
    "truncated_normal": _Kind(
        {"mean": "finite", "deviation": "positive", "low": "limit", "high": "limit"},
        {"low": -math.inf, "high": math.inf}, (_ORDERED,), "truncnorm", _truncated,
    ),
    "uniform": _Kind(
        {"low": "finite", "high": "finite"}, {}, (_ORDERED,), "uniform", _between,
    ),
    "lognormal": _Kind(
        {"median": "positive", "log_deviation": "positive"},
        scipy="lognorm", arguments=lambda p: {"s": p["log_deviation"], "scale": p["median"]},
    ),
    "loguniform": _Kind(
        {"low": "positive", "high": "positive"}, {}, (_ORDERED,), "loguniform",
        lambda p: {"a": p["low"], "b": p["high"]},
    ),
    "triangular": _Kind(
        {"low": "finite", "mode": "finite", "high": "finite"}, {},
        (_ORDERED, (lambda p: p["low"] <= p["mode"] <= p["high"], "mode must lie between low and high")),
        "triang", lambda p: _between(p, c=(p["mode"] - p["low"]) / (p["high"] - p["low"])),
    ),
    "beta": _Kind(
        {"a": "positive", "b": "positive", "low": "finite", "high": "finite"},
        {"low": 0.0, "high": 1.0}, (_ORDERED,), "beta", lambda p: _between(p, a=p["a"], b=p["b"]),
    ),
    "weibull": _Kind(
        {"scale": "positive", "shape": "positive"},
        scipy="weibull_min", arguments=lambda p: {"c": p["shape"], "scale": p["scale"]},
    ),
    "constant": _Kind({"value": "finite"}),
    "choice": _Kind(
        {"values": "list", "weights": "positives"}, {"weights": ()},
        ((lambda p: len(p["weights"]) in (0, len(p["values"])), "every value needs one weight"),),
    ),
    "empirical": _Kind({"values": "list"}),
}  # fmt: skip


# Share of draws beyond those that are tried for being finite.
_RARE = 1e-9


@dataclasses.dataclass(frozen=True)
class Distribution:
    """A distribution by its name and parameters.

    Attributes:
        name: one of `KINDS`.
        parameters: numbers, and tuples of numbers, by name; those left out have their defaults.

    Raises:
        SettingError: an unknown name, a missing or unknown parameter, an impossible value.
    """

    name: str
    parameters: Given

    def __post_init__(self) -> None:
        if self.name not in KINDS:
            near = nearest_names(str(self.name)[:SHOWN], KINDS)
            raise SettingError(f"There is no distribution {named(self.name)}.{near}")
        object.__setattr__(self, "parameters", _checked(self.name, self.parameters))
        self._check_draws()

    def quantile(self, u: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """The values below which the shares u of all draws lie, 0 < u < 1."""
        p = self.parameters
        if self.name == "constant":
            return np.full(np.shape(u), p["value"])
        if not KINDS[self.name].scipy:
            values, shares = self._steps()
            return values[np.searchsorted(shares[:-1], u, side="left")]
        return np.asarray(self._scipy().ppf(u, **KINDS[self.name].arguments(p)), dtype=float)

    def _check_draws(self) -> None:
        """Refuse parameters with which draws are beyond what doubles can hold."""
        if not KINDS[self.name].scipy:
            return
        with np.errstate(all="ignore"):
            drawn = self.quantile(np.array([_RARE, 0.5, 1 - _RARE]))
        if not np.all(np.isfinite(drawn)):
            given = ", ".join(f"{k} = {_shown(v)}" for k, v in self.parameters.items())
            raise SettingError(
                f"The distribution '{self.name}' with {given} has draws that are not finite."
            )

    @property
    def variance(self) -> float:
        """The variance, in the square of the number's unit."""
        if self.name == "constant":
            return 0.0
        if not KINDS[self.name].scipy:
            values, shares = self._steps()
            weights = np.diff(shares, prepend=0.0)
            return float(weights @ (values - weights @ values) ** 2)
        return float(self._scipy().var(**KINDS[self.name].arguments(self.parameters)))

    def plain(self) -> dict[str, Any]:
        """The plain form; infinite limits, being the default, are left out."""
        found: dict[str, Any] = {"distribution": self.name}
        for name, value in self.parameters.items():
            if isinstance(value, tuple):
                if value:
                    found[name] = list(value)
            elif math.isfinite(value):
                found[name] = value
        return found

    def _scipy(self) -> Any:
        import scipy.stats

        return getattr(scipy.stats, KINDS[self.name].scipy)

    def _steps(self) -> tuple[np.ndarray, np.ndarray]:
        """Values in rising order (k,), and the share of draws up to each (k,), the last 1."""
        values = np.asarray(self.parameters["values"])
        weights = np.asarray(self.parameters.get("weights") or np.ones(len(values)))
        order = np.argsort(values, kind="stable")
        total = np.cumsum(weights[order])
        return values[order], total / total[-1]


def from_plain(plain: Given | Number, factor: str = "") -> Distribution:
    """A distribution from its plain form; a number alone is a constant.

    Args:
        factor: whose distribution it is, for error messages.

    Raises:
        SettingError: as `Distribution`, and no entry "distribution".
    """
    try:
        if not isinstance(plain, Mapping):
            return Distribution("constant", {"value": plain})
        if "distribution" not in plain:
            raise SettingError(
                f"An entry 'distribution' with its name is missing.{nearest_names('', KINDS)}"
            )
        rest = {name: value for name, value in plain.items() if name != "distribution"}
        if not isinstance(plain["distribution"], str):
            raise SettingError(
                f"'distribution' must be a name, but it is {shown(plain['distribution'])}."
                f"{nearest_names('', KINDS)}"
            )
        return Distribution(plain["distribution"], rest)
    except SettingError as error:
        raise SettingError(f"Factor {named(factor)}: {error}" if factor else str(error)) from None


def normal(mean: Number, deviation: Number) -> Distribution:
    """Normal, of a mean and a standard deviation > 0."""
    return Distribution("normal", {"mean": mean, "deviation": deviation})


def truncated_normal(
    mean: Number, deviation: Number, low: Number = -math.inf, high: Number = math.inf
) -> Distribution:
    """Normal between limits; mean and deviation are those before the truncation."""
    given = {"mean": mean, "deviation": deviation, "low": low, "high": high}
    return Distribution("truncated_normal", given)


def uniform(low: Number, high: Number) -> Distribution:
    """Uniform between low and high."""
    return Distribution("uniform", {"low": low, "high": high})


def lognormal(median: Number, log_deviation: Number) -> Distribution:
    """exp of a normal number: of a median > 0 and the deviation of the natural logarithm."""
    return Distribution("lognormal", {"median": median, "log_deviation": log_deviation})


def loguniform(low: Number, high: Number) -> Distribution:
    """The logarithm is uniform, 0 < low < high."""
    return Distribution("loguniform", {"low": low, "high": high})


def triangular(low: Number, mode: Number, high: Number) -> Distribution:
    """A triangle over low to high with its peak at the mode."""
    return Distribution("triangular", {"low": low, "mode": mode, "high": high})


def beta(a: Number, b: Number, low: Number = 0.0, high: Number = 1.0) -> Distribution:
    """Beta of shapes a, b > 0, stretched over low to high."""
    return Distribution("beta", {"a": a, "b": b, "low": low, "high": high})


def weibull(scale: Number, shape: Number) -> Distribution:
    """Weibull, as of wind speeds; shape 1 is exponential, 2 is Rayleigh."""
    return Distribution("weibull", {"scale": scale, "shape": shape})


def constant(value: Number) -> Distribution:
    """Always the same number."""
    return Distribution("constant", {"value": value})


def choice(values: Any, weights: Any = ()) -> Distribution:
    """One of some values, by relative weights > 0, or all alike."""
    return Distribution("choice", {"values": values, "weights": weights})


def empirical(values: Any) -> Distribution:
    """One of the values of a sample, such as a column of a file, each as likely."""
    return Distribution("empirical", {"values": values})


# --- checks


def _checked(kind: str, given: Given) -> dict[str, Parameter]:
    """Parameters with defaults, as floats and tuples, after all checks."""
    known = KINDS[kind]
    for name in given:
        if name not in known.parameters:
            raise SettingError(
                f"The distribution '{kind}' has no parameter {named(name)}."
                f"{nearest_names(str(name)[:SHOWN], known.parameters)}"
            )
    found: dict[str, Parameter] = {}
    for name, sort in known.parameters.items():
        if name not in given and name not in known.defaults:
            needed = [n for n in known.parameters if n not in known.defaults]
            raise SettingError(
                f"The distribution '{kind}' needs '{name}' (it needs {', '.join(needed)})."
            )
        value = given.get(name, known.defaults.get(name))
        what = f"'{name}' of the distribution '{kind}'"
        found[name] = _list(value, sort, what) if sort in _LISTS else _number(value, sort, what)
    for holds, words in known.relations:
        if not holds(found):
            shown = ", ".join(f"{name} = {_shown(value)}" for name, value in found.items())
            raise SettingError(f"In the distribution '{kind}' {words}, but it has {shown}.")
    if kind == "truncated_normal":
        _check_probability(found)
    return found


_LISTS = ("list", "positives")


def _shown(value: Parameter) -> str:
    return f"{len(value)} numbers" if isinstance(value, tuple) else f"{value:g}"


def _number(value: Any, sort: str, what: str) -> float:
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
        raise SettingError(f"{what} must be a number, but it is {shown(value)}.")
    try:
        number = float(value)
    except OverflowError:
        raise SettingError(f"{what} is too large for a number: {shown(value)}.") from None
    fine = not math.isnan(number) if sort == "limit" else math.isfinite(number)
    if not fine:
        raise SettingError(f"{what} must be finite, but it is {number}.")
    if sort == "positive" and number <= 0:
        raise SettingError(f"{what} must be positive, but it is {number:g}.")
    return number


def _list(values: Any, sort: str, what: str) -> tuple[float, ...]:
    if not isinstance(values, list | tuple | np.ndarray):
        raise SettingError(f"{what} must be a list of numbers, but it is {shown(values)}.")
    if len(values) == 0 and sort == "list":
        raise SettingError(f"{what} must have at least one number, but it is empty.")
    one = "positive" if sort == "positives" else "finite"
    return tuple(_number(value, one, f"Number {k} in {what}") for k, value in enumerate(values))


def _check_probability(p: Mapping[str, Any]) -> None:
    """Refuse limits so far from the mean that doubles hold no normal number between them."""
    import scipy.stats

    middle = scipy.stats.truncnorm.ppf([0.25, 0.75], **_truncated(p))
    if not np.all((middle >= p["low"]) & (middle <= p["high"])) or middle[0] >= middle[1]:
        raise SettingError(
            f"The limits {p['low']:g} and {p['high']:g} are too far from the mean {p['mean']:g} of the "
            f"distribution 'truncated_normal' for its deviation {p['deviation']:g}."
        )
