"""Airframe drag: linear and quadratic in the speed against the air."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.shapes import Numbers
from ..algebra.stacked import apply, apply_transposed, dot
from ..mechanics.errors import ModelError, concrete
from ..mechanics.load import AbstractForce, Load, Signal, evaluate, push, signal, vector
from ..mechanics.state import Kinematics


class AirframeDrag(AbstractForce):
    """Drag at a body's centre of pressure, in body axes:

        F_i = -(c_i + d_i |w|) w_i,   w = R^T (v_P - wind)

    with the velocity v_P of the centre of pressure. It only takes energy out in still air.

    Args:
        body: its name.
        linear: c (3,) [N s/m], along the body's x, y, z. quadratic: d (3,) [N s^2/m^2].
        point: the centre of pressure in the body's reference frame (3,) [m]; by default the
            centre of mass.
        wind: velocity of the air, world (3,) [m/s], or a function of (t, kinematics) that
            returns it, such as `Gusts`; default still air.

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

    def bodies(self) -> tuple[str, ...]:
        return (self.body,)

    def joint_names(self) -> tuple[str, ...]:
        return ()

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        k = kin.index(self.body)
        arm, velocity = None, kin.v[k]
        if self.point is not None:
            arm, velocity = kin.arm(self.body, self.point), kin.point(self.body, self.point)[1]
        if self.wind is not None:
            what = f"AirframeDrag: the wind on body '{self.body}'"
            velocity = velocity - evaluate(self.wind, t, kin, what, (3,))
        w = apply_transposed(kin.R_wb[k], velocity)
        square = dot(w, w)
        # |w| has a tip at rest, but |w| w has the derivative zero, which this gives
        speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        force = -(self.linear + self.quadratic * speed) * w
        return push(kin, self.body, apply(kin.R_wb[k], force), arm)


def _coefficients(value: Numbers, what: str, unit: str) -> Float[Array, "3"]:
    found = vector(value, what, unit)
    if concrete(found) and bool(jnp.any(found < 0)):
        raise ModelError(f"{what} must not be negative, but it is {np.asarray(found)} {unit}.")
    return found
