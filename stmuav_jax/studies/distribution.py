"""Distributions of uncertain parameters: SciPy's frozen ones, and plain forms for files.

A study's identity contains its distributions, so each has a plain form for TOML and JSON:

    mass = {distribution = "normal", mean = 0.95, standard_deviation = 0.02}
    rate = {distribution = "scipy.gamma", a = 2.0, scale = 0.1}

In Python the first is `scipy.stats.norm(0.95, 0.02)`. SciPy does the mathematics.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
import pydantic
from jaxtyping import Float
from pydantic import Field

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import (
    SHOWN,
    Entries,
    Finite,
    Positive,
    Tuples,
    format_value,
    quote_name,
    validate_model,
)

_Limit = Annotated[float, Field(strict=True, allow_inf_nan=True)]
_Values = Annotated[tuple[Finite, ...], Tuples, Field(min_length=1)]
_Weights = Annotated[tuple[Positive, ...], Tuples]


class _Kind(NamedTuple):
    """Kind of distribution: its parameters, conditions on them, and SciPy's name for it.

    Attributes:
        parameters: types by name, with the default where there is one.
        relations: conditions on the parameters, and their words for error messages.
        scipy: name in `scipy.stats`; "" for tables of values.
        arguments: function from the parameters to SciPy's arguments.
    """

    parameters: Mapping[str, Any]
    relations: tuple[tuple[Callable[[Any], bool], str], ...] = ()
    scipy: str = ""
    arguments: Callable[[Any], dict[str, float]] = lambda p: {}


_ORDERED = (lambda p: p["low"] < p["high"], "low must be below high")


def _uniform_arguments(p: Any, **more: float) -> dict[str, float]:
    return {"loc": p["low"], "scale": p["high"] - p["low"]} | more


def _truncated_arguments(p: Any) -> dict[str, float]:
    a, b = ((p[end] - p["mean"]) / p["standard_deviation"] for end in ("low", "high"))
    return {"a": a, "b": b, "loc": p["mean"], "scale": p["standard_deviation"]}


def _holds_draws(p: Any) -> bool:
    """Test whether doubles can represent quantiles of a truncated normal distribution."""
    import scipy.stats

    middle = scipy.stats.truncnorm.ppf([0.25, 0.75], **_truncated_arguments(p))
    return bool(p["low"] <= middle[0] < middle[1] <= p["high"])


KINDS: Mapping[str, _Kind] = {
    "normal": _Kind(
        {"mean": Finite, "standard_deviation": Positive},
        scipy="norm", arguments=lambda p: {"loc": p["mean"], "scale": p["standard_deviation"]},
    ),
    # mean and standard deviation are those before the truncation
    "truncated_normal": _Kind(
        {"mean": Finite, "standard_deviation": Positive, "low": (_Limit, -math.inf),
         "high": (_Limit, math.inf)},
        (_ORDERED, (_holds_draws, "the limits must not be too far from the mean")),
        "truncnorm", _truncated_arguments,
    ),
    "uniform": _Kind({"low": Finite, "high": Finite}, (_ORDERED,), "uniform", _uniform_arguments),
    "lognormal": _Kind(
        {"median": Positive, "log_standard_deviation": Positive},
        scipy="lognorm", arguments=lambda p: {"s": p["log_standard_deviation"], "scale": p["median"]},
    ),
    "loguniform": _Kind(
        {"low": Positive, "high": Positive}, (_ORDERED,), "loguniform",
        lambda p: {"a": p["low"], "b": p["high"]},
    ),
    "triangular": _Kind(
        {"low": Finite, "mode": Finite, "high": Finite},
        (_ORDERED, (lambda p: p["low"] <= p["mode"] <= p["high"], "mode must lie between low and high")),
        "triang", lambda p: _uniform_arguments(p, c=(p["mode"] - p["low"]) / (p["high"] - p["low"])),
    ),
    "beta": _Kind(
        {"a": Positive, "b": Positive, "low": (Finite, 0.0), "high": (Finite, 1.0)},
        (_ORDERED,), "beta", lambda p: _uniform_arguments(p, a=p["a"], b=p["b"]),
    ),
    "weibull": _Kind(
        {"scale": Positive, "shape": Positive},
        scipy="weibull_min", arguments=lambda p: {"c": p["shape"], "scale": p["scale"]},
    ),
    "constant": _Kind({"value": Finite}),
    "choice": _Kind(
        {"values": _Values, "weights": (_Weights, ())},
        ((lambda p: len(p["weights"]) in (0, len(p["values"])), "every value needs one weight"),),
    ),
    "empirical": _Kind({"values": _Values}),
    # not drawn: sample i has `first` + i, such as seeds of noise
    "counter": _Kind({"first": Finite}),
}  # fmt: skip

# Prefix of the names of SciPy's distributions with SciPy's own parameters.
_SCIPY = "scipy."

# Tail probability at which quantiles are tested for being finite.
_RARE = 1e-9


@dataclasses.dataclass(frozen=True)
class Distribution:
    """Distribution by its name and parameters.

    Attributes:
        name: one of `KINDS`, or "scipy." and the name of a distribution in `scipy.stats`.
        parameters: numbers, and tuples of numbers, by name; those left out have their defaults.

    Raises:
        SettingError: an unknown name, a missing or unknown parameter, an impossible value.
    """

    name: str
    parameters: Mapping[str, Any]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", _check_parameters(self.name, self.parameters))
        with np.errstate(all="ignore"):
            # SciPy returns NaN for parameters out of range and raises nothing.
            quantiles = self.quantile(np.array([_RARE, 0.5, 1 - _RARE]))
        if not np.all(np.isfinite(quantiles)):
            raise SettingError(
                f"The distribution '{self.name}' with {_format_parameters(self.parameters)} has draws that are "
                "not finite."
            )

    def quantile(self, u: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Quantiles of the probabilities u, 0 < u < 1."""
        p, kind = self.parameters, KINDS.get(self.name)
        if kind is None:
            return np.asarray(_of_scipy(self.name).ppf(u, **p), dtype=float)
        if kind.scipy:
            return np.asarray(_of_scipy(_SCIPY + kind.scipy).ppf(u, **kind.arguments(p)))
        values = np.asarray(p.get("values", (p.get("value", p.get("first")),)), dtype=float)
        weights = np.asarray(p.get("weights") or np.ones(len(values)))
        order = np.argsort(values, kind="stable")
        total = np.cumsum(weights[order])
        # Sorted values make the quantile monotonic, so that correlations and even designs keep their meaning.
        return values[order][np.searchsorted(total[:-1] / total[-1], u, side="left")]

    def plain(self) -> dict[str, Any]:
        """Plain form; infinite limits and absent weights, being the defaults, are left out."""
        lists = {k: list(v) if isinstance(v, tuple) else v for k, v in self.parameters.items()}
        parameters = {k: v for k, v in lists.items() if v != [] and v not in (math.inf, -math.inf)}
        return {"distribution": self.name} | parameters


def as_distribution(source: Any, factor: str = "") -> Distribution:
    """Distribution from any of its forms.

    Args:
        source: a frozen distribution of `scipy.stats`, a number (a constant), a plain form, or a
            `Distribution`.
        factor: name of the factor with this distribution, for error messages.

    Raises:
        SettingError: as for `Distribution`; also no entry "distribution", or a user-defined
            distribution, which has no plain form.
    """
    try:
        if isinstance(source, Distribution):
            return source
        # SciPy's frozen distributions have no public class in common; each holds the one it froze.
        if hasattr(source, "dist"):
            return _read_frozen(source)
        if not isinstance(source, Mapping):
            return Distribution("constant", {"value": source})
        if "distribution" not in source:
            raise SettingError(
                f"A factor needs the entry 'distribution' with a name.{nearest_names('', KINDS)}"
            )
        parameters = dict(source)
        name = parameters.pop("distribution")
        return Distribution(name if isinstance(name, str) else format_value(name), parameters)
    except SettingError as error:
        subject = f"Factor {quote_name(factor)}: " if factor else ""
        raise SettingError(f"{subject}{error}") from None


def _read_frozen(frozen: Any) -> Distribution:
    """Distribution from one of SciPy's frozen ones, by name and named parameters."""
    of, name = frozen.dist, f"{_SCIPY}{frozen.dist.name}"
    # A class of the user's own with a name of SciPy's could not be made again from a file.
    if type(_of_scipy(name)) is not type(of):
        raise SettingError(f"The distribution {quote_name(of.name)} is not one of scipy.stats.")
    return Distribution(
        name, dict(zip(_argument_names(of), frozen.args, strict=False)) | frozen.kwds
    )


def _of_scipy(name: str) -> Any:
    """Distribution of `scipy.stats` by its prefixed name; None for other names."""
    import scipy.stats

    of = getattr(scipy.stats, name.removeprefix(_SCIPY), None) if name.startswith(_SCIPY) else None
    return of if hasattr(of, "freeze") and hasattr(of, "ppf") else None


def _argument_names(of: Any) -> list[str]:
    """Names of the parameters of a SciPy distribution, in its order."""
    shapes = of.shapes.split(", ") if of.shapes else []
    return [*shapes, "loc", *(["scale"] if hasattr(of, "pdf") else [])]


@functools.cache
def _parameters_model(name: str) -> type[Entries]:
    """Schema of the parameters of a kind of distribution, or of one of SciPy's."""
    optional = {"loc": 0.0, "scale": 1.0}
    types = KINDS[name].parameters if name in KINDS else {
        k: (Finite, optional.get(k, ...)) for k in _argument_names(_of_scipy(name))
    }  # fmt: skip
    fields: dict[str, Any] = {k: t if isinstance(t, tuple) else (t, ...) for k, t in types.items()}
    return pydantic.create_model("Parameters", __base__=Entries, **fields)


def _check_parameters(name: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Checked parameters with defaults, as floats and tuples."""
    kind = KINDS.get(name)
    if kind is None and _of_scipy(name) is None:
        suggestion = nearest_names(name[:SHOWN], KINDS)
        raise SettingError(f"There is no distribution {quote_name(name)}.{suggestion}")
    entries = validate_model(_parameters_model(name), parameters, f"The distribution '{name}'")
    checked = entries.model_dump()
    for holds, relation in kind.relations if kind else ():
        if not holds(checked):
            text = _format_parameters(checked)
            raise SettingError(f"In the distribution '{name}' {relation}, but it has {text}.")
    return checked


def _format_parameters(parameters: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name} = {format_value(list(value)) if isinstance(value, tuple) else format(value, 'g')}"
        for name, value in parameters.items()
    )
