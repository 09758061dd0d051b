"""Airframe drag, linear and quadratic in the airspeed."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.derivative import safe_norm
from ..algebra.stacked import apply, apply_transposed
from ..checks.errors import ModelError, concrete
from ..checks.numbers import vector
from ..checks.shapes import Numbers
from ..mechanics.load import AbstractForce, ActsOn, Load, Signal, evaluate, push, signal
from ..mechanics.state import Kinematics


class AirframeDrag(AbstractForce):
    """Drag at a body's centre of pressure, in body axes.

        F_i = -(c_i + d_i |w|) w_i,   w = R^T (v_P - wind)

    with the velocity v_P of the centre of pressure. In still air drag only dissipates energy.

    Args:
        body: name of the body.
        linear: coefficients c along the body's x, y, z (3,) [N s/m].
        quadratic: coefficients d along the body's x, y, z (3,) [N s^2/m^2].
        point: centre of pressure in the body's reference frame (3,) [m]; by default the centre of
            mass.
        wind: velocity of the air, world (3,) [m/s], or a function of (t, kinematics) that
            returns it, such as `Gusts`; by default the air is still.

    Raises:
        ModelError: numbers that are not finite, negative coefficients, wrong shapes.
    """

    body: str = eqx.field(static=True)
    linear: Float[Array, "3"]
    quadratic: Float[Array, "3"]
    point: Float[Array, "3"] | None
    wind: Signal | None

    def __init__(
        self,
        body: str,
        *,
        linear: Numbers = (0.0, 0.0, 0.0),
        quadratic: Numbers = (0.0, 0.0, 0.0),
        point: Numbers | None = None,
        wind: Numbers | Callable[..., object] | None = None,
    ) -> None:
        self.body = body
        self.linear = _coefficients(linear, f"The linear drag of body '{body}'", "N s/m")
        what = f"The quadratic drag of body '{body}'"
        self.quadratic = _coefficients(quadratic, what, "N s^2/m^2")
        what = f"The centre of pressure of body '{body}'"
        self.point = None if point is None else vector(point, what, "m")
        what = f"The wind on body '{body}'"
        self.wind = None if wind is None else signal(wind, what, (3,), "m/s")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        k = kin.index(self.body)
        arm, velocity = None, kin.v[k]
        if self.point is not None:
            arm, velocity = kin.arm(self.body, self.point), kin.point(self.body, self.point)[1]
        if self.wind is not None:
            what = f"AirframeDrag: the wind on body '{self.body}'"
            velocity = velocity - evaluate(self.wind, t, kin, what, (3,))
        w = apply_transposed(kin.R_wb[k], velocity)
        # |w| has no derivative at rest, but that of |w| w is zero, as it is here
        force = -(self.linear + self.quadratic * safe_norm(w)) * w
        return push(kin, self.body, apply(kin.R_wb[k], force), arm)


def _coefficients(value: Numbers, what: str, unit: str) -> Float[Array, "3"]:
    found = vector(value, what, unit)
    if concrete(found) and bool(jnp.any(found < 0)):
        raise ModelError(f"{what} must not be negative, but it is {np.asarray(found)} {unit}.")
    return found
