"""The simulator as the process model of a filter.

    x_k = motion of the system over a step from x_(k-1) at held inputs,    y_k = readings at x_k

The states are the independent coordinates of the mechanism, closed loops included. Parameters of
the system to be estimated beside the motion, such as a mass, are additional constant states.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.space import AbstractSpace, Composite, Concatenated, CyclicVector, Point, Vector
from ..checks.errors import SettingError
from ..checks.shapes import Numbers
from ..dynamics.statespace.base import AbstractStateSpace, motion_rates
from ..estimation.model import Sensor, StateSpaceModel
from ..estimation.propagate import rk4_step
from ..mechanics.inputs import Inputs
from .sensors import AbstractSensor, check_sensors, sensed_motion_at

Adapt = Callable[[AbstractStateSpace, Float[Array, " p"]], AbstractStateSpace]


def moved_over(
    space: AbstractStateSpace, x: Point, dt: Any, system: Any, substeps: int = 1
) -> Point:
    """Point after a motion over dt [s], forces held, by the classical Runge-Kutta method.

    The method integrates the error from the point, whose rates are those of the exact motion, so
    that coordinates do not drift off the constraints and rotations stay rotations.
    """
    h = dt / substeps

    def onwards(x: Point, _: None) -> tuple[Point, None]:
        rate = lambda v, s: motion_rates(space, x, v, 0.0, system)
        v = rk4_step(rate, space.difference(x, x), h, in_loop=True)
        return space.with_closed_loops(space.retract(x, v)), None

    # stages and substeps are loops: a mechanism's rates are compiled once, not in each of them
    return onwards(x, None)[0] if substeps == 1 else jax.lax.scan(onwards, x, length=substeps)[0]


def _matrix(variances: Numbers) -> Numbers:
    """The covariance of independent noises from their variances (n,); matrices stay."""
    return jnp.diag(jnp.asarray(variances)) if np.ndim(variances) == 1 else variances


def _together(spaces: list[AbstractSpace]) -> AbstractSpace:
    """The space of all readings: one vector where each sensor's are vectors or angles."""
    if not all(isinstance(part, Vector | CyclicVector) for part in spaces):
        return Concatenated(*spaces)
    parts = (
        part.angular if isinstance(part, CyclicVector) else (False,) * part.size for part in spaces
    )
    return CyclicVector(tuple(turning for part in parts for turning in part))


def system_model(
    space: AbstractStateSpace,
    sensors: Sequence[AbstractSensor],
    *,
    Q: Numbers,
    R: Numbers,
    inputs: Inputs | None = None,
    parameters: Sequence[str] = (),
    adapt: Adapt | None = None,
    substeps: int = 1,
    noise_per: Any = "step",
) -> StateSpaceModel:
    """State-space model of a mechanism: the simulator's own equations and its sensors.

    Args:
        space: state space of the mechanism, whose points are the states of the filter; with
            parameters the states are {"motion": point, "parameters": (p,)}.
        sensors: sensors, whose readings are one array in this order; an attitude's are Euler
            parameters (4,) with errors (3,).
        Q: covariance of the process noise (n, n) or (n,), for the errors of the space, then the
            parameters.
        R: covariance of the readings' noise.
        inputs: inputs that change from step to step, see `inputs_of`; others are constant.
        parameters: names of the parameters that are states.
        adapt: function of the space and the values of these parameters that returns the space of
            the mechanism that has them, for example by `TreeSpace.with_system`.
        substeps: number of Runge-Kutta steps in a step of the filter.
        noise_per: "step" or "second", see `StateSpaceModel`.

    Raises:
        SettingError: no sensors, two of one name, or parameters without `adapt` or vice versa.
        ModelError: Q or R has the wrong size.
    """
    sensors = tuple(sensors)
    check_sensors(sensors)
    if bool(parameters) != (adapt is not None):
        raise SettingError(
            "Parameters among the states need `adapt`, and `adapt` needs their names."
        )

    def at(x: Point, u: Any) -> tuple[AbstractStateSpace, Point, Any]:
        own = space if adapt is None else adapt(space, x["parameters"])
        system = own.system if inputs is None else inputs.applied(own.system, u)
        return own, (x if adapt is None else x["motion"]), system

    def step(x: Point, u: Any, dt: Any) -> Point:
        own, point, system = at(x, u)
        after = moved_over(own, point, dt, system, substeps)
        return after if adapt is None else {"motion": after, "parameters": x["parameters"]}

    def read(x: Point, u: Any) -> Point:
        own, point, system = at(x, u)
        seen = sensed_motion_at(own, point, 0.0, system, accelerations=felt)
        return jnp.concatenate([sensor.read(seen) for sensor in sensors])

    felt = any(sensor.needs_accelerations for sensor in sensors)
    seen_in = _together([sensor.space(space.system) for sensor in sensors])
    names = tuple(name for sensor in sensors for name, _ in sensor.components(space.system))
    states = space if adapt is None else Composite(motion=space, parameters=Vector(len(parameters)))
    return StateSpaceModel(
        step,
        _matrix(Q),
        Sensor(read, _matrix(R), space=seen_in, names=names),
        space=states,
        names=(*(name for name, _ in space.names), *parameters),
        noise_per=noise_per,
    )
