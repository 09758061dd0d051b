"""Derivatives of a trim by the numbers that a machine is built from."""

from collections.abc import Callable, Mapping

import jax
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from .flight_trim import FlightTrim, TrimLimits, trim_flight
from .flyer import Flyer
from .steady import FlightCondition

Values = dict[str, Float[Array, "..."]]


def trim_slopes(
    build: Callable[[Values], Flyer],
    values: Mapping[str, Float[Array, "..."]],
    wanted: FlightCondition,
    limits: TrimLimits | None = None,
) -> tuple[FlightTrim, Values]:
    """Trim of a flyer, and the derivatives of `FlightTrim.vector` by values it is built from.

    Args:
        build: function from values by name, traced by JAX, to the flyer.
        values: values at which the derivatives are taken.

    Returns:
        the trim, whose `reason` says whether there is one, and the derivatives by name: the
        vector's axis first, then those of the value, in the units of both.
    """

    def of(values: Values) -> tuple[Float[Array, " n"], FlightTrim]:
        found = trim_flight(build(values), wanted, limits, throw=False)
        return found.vector, found

    slopes, found = quick_jit(jax.jacfwd(of, has_aux=True))(dict(values))
    return found, slopes
