"""Airframe drag, linear and quadratic in the airspeed."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, has_values
from ..checks.numbers import check_vector
from ..checks.shapes import Numbers
from ..math.derivative import safe_norm
from ..math.stacked import apply_matrix, apply_transposed
from ..mechanics.load import AbstractForce, ActsOn, Load, Signal, check_signal, evaluate, push
from ..mechanics.state import Kinematics
from ..mechanics.system import System


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
        self.linear = _check_coefficients(linear, f"The linear drag of body '{body}'", "N s/m")
        quantity = f"The quadratic drag of body '{body}'"
        self.quadratic = _check_coefficients(quadratic, quantity, "N s^2/m^2")
        quantity = f"The centre of pressure of body '{body}'"
        self.point = None if point is None else check_vector(point, quantity, "m")
        quantity = f"The wind on body '{body}'"
        self.wind = None if wind is None else check_signal(wind, quantity, (3,), "m/s")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        k = kin.index(self.body)
        arm, velocity = None, kin.v[k]
        if self.point is not None:
            arm, velocity = kin.arm(self.body, self.point), kin.point(self.body, self.point)[1]
        if self.wind is not None:
            quantity = f"AirframeDrag: the wind on body '{self.body}'"
            velocity = velocity - evaluate(self.wind, t, kin, quantity, (3,))
        w = apply_transposed(kin.R_wb[k], velocity)
        # |w| has no derivative at rest, but that of |w| w is zero, as it is here
        force = -(self.linear + self.quadratic * safe_norm(w)) * w
        return push(kin, self.body, apply_matrix(kin.R_wb[k], force), arm)


def with_wind(system: System, wind: Numbers | Callable[..., object]) -> System:
    """System whose airframes are in this wind.

    Args:
        wind: velocity of the air as of `AirframeDrag`.

    Raises:
        ModelError: a system without `AirframeDrag`, on which no wind acts.
    """
    forces = system.forces
    if not any(isinstance(force, AirframeDrag) for force in forces):
        raise ModelError(
            "Wind acts through the drag of an airframe, which this machine does not have: add an AirframeDrag "
            "(of a model's file a force of the kind 'drag', of a built-in scene the option 'drag')."
        )
    air = wind if callable(wind) else check_vector(wind, "The wind", "m/s")
    blown = [dataclasses.replace(f, wind=air) if isinstance(f, AirframeDrag) else f for f in forces]
    return eqx.tree_at(lambda s: s.forces, system, tuple(blown))


def _check_coefficients(value: Numbers, quantity: str, unit: str) -> Float[Array, "3"]:
    coefficients = check_vector(value, quantity, unit)
    if has_values(coefficients) and bool(jnp.any(coefficients < 0)):
        raise ModelError(
            f"{quantity} must not be negative, but it is {np.asarray(coefficients)} {unit}."
        )
    return coefficients
