"""Sensors as functions of a mechanism's motion, and the simulator as the process model of a filter.

A sensor takes positions, velocities and accelerations of all bodies (`SensedMotion`) and returns the
reading of an ideal instrument; noise and bias belong to the filter or the experiment. In the model
of a filter (`system_model`) the states are the independent coordinates of the mechanism,

    x_k = motion of the system over a step from x_(k-1) at held inputs,    y_k = readings at x_k.

Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems
(2013), ch. 4 (gyroscopes and accelerometers).
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError, nearest_names
from ..checks.numbers import as_floats, as_numpy, check_numbers
from ..checks.shapes import Numbers
from ..dynamics.simulation import Run
from ..dynamics.statespace.base import AbstractStateSpace, Time, motion_rates
from ..estimation.model import Sensor, StateSpaceModel, rk4_step
from ..math.rotation import relative_acceleration
from ..math.space import (
    AbstractSpace,
    Composite,
    Concatenated,
    CyclicVector,
    Point,
    Rotation,
    Vector,
)
from ..mechanics.forces import Gravity
from ..mechanics.inputs import Inputs
from ..mechanics.joint import Joint, Which, choose_coordinate, free_coordinates
from ..mechanics.joint_states import evaluate_coordinate
from ..mechanics.state import Kinematics, State
from ..mechanics.system import System


class SensedMotion(NamedTuple):
    """Motion of all bodies at one time.

    Attributes:
        kin: positions and velocities of the bodies and of ground.
        p: Euler parameters of the bodies (n, 4).
        v_rate: accelerations of the centres of mass, world (n, 3) [m/s^2].
        omega_rate: angular accelerations, body axes (n, 3) [rad/s^2].
        gravity: acceleration of free fall, world (3,) [m/s^2].
    """

    kin: Kinematics
    p: Float[Array, "n 4"]
    v_rate: Float[Array, "n 3"]
    omega_rate: Float[Array, "n 3"]
    gravity: Float[Array, "3"]


class AbstractSensor(eqx.Module):
    """Sensor without noise.

    Attributes:
        name: name of the sensor, for messages and for the parts of a measurement.
        needs_accelerations: true if a reading depends on accelerations, which take most of the
            time to compute; they are NaN for sensors that do not need them.
    """

    name: eqx.AbstractVar[str]
    needs_accelerations: ClassVar[bool] = True

    @abstractmethod
    def space(self, system: System) -> AbstractSpace:
        """Space of the readings on a mechanism."""

    @abstractmethod
    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        """Names and units of the components of a reading's error."""

    @abstractmethod
    def read(self, motion: SensedMotion) -> Point:
        """Reading of the sensor during the given motion."""


def _check_axes(axes: Numbers | None) -> Float[Array, "3 3"]:
    return check_numbers(np.eye(3) if axes is None else axes, (3, 3), "The axes of a sensor", "")


def _check_point(point: Numbers | None, sensor: str) -> Float[Array, "3"] | None:
    return None if point is None else check_numbers(point, (3,), f"The point of the {sensor}", "m")


class AbstractVectorSensor(AbstractSensor):
    """Sensor of three numbers on a body, with errors along x, y and z.

    Attributes:
        body: name of the body.
        is_rotation: true if a reading is a rotation, whose error alone is three numbers.
    """

    unit: ClassVar[str] = ""
    is_rotation: ClassVar[bool] = False
    body: eqx.AbstractVar[str]

    def space(self, system: System) -> AbstractSpace:
        return Rotation() if self.is_rotation else Vector(3)

    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        return tuple((f"{self.name} {axis}", self.unit) for axis in "xyz")


class Gyroscope(AbstractVectorSensor):
    """Gyroscope, which reads the angular velocity of a body in the sensor's axes (3,) [rad/s].

    Args:
        body: name of the body.
        axes: axes of the sensor in those of the body, in rows (3, 3); by default the body's.
        name: name of the sensor; by default "gyroscope" and the body's.
    """

    needs_accelerations: ClassVar[bool] = False
    unit: ClassVar[str] = "rad/s"
    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    axes: Float[Array, "3 3"]

    def __init__(self, body: str, axes: Numbers | None = None, *, name: str | None = None) -> None:
        self.name, self.body, self.axes = name or f"gyroscope {body}", body, _check_axes(axes)

    def read(self, motion: SensedMotion) -> Point:
        return self.axes @ motion.kin.omega[motion.kin.index(self.body)]


class Accelerometer(AbstractVectorSensor):
    """Accelerometer, which reads the specific force at a point of a body (3,) [m/s^2].

    Args:
        body: name of the body.
        point: point in the body's reference frame (3,) [m]; by default the centre of mass.
        axes: axes of the sensor in those of the body, in rows (3, 3); by default the body's.
        name: name of the sensor; by default "accelerometer" and the body's.
    """

    unit: ClassVar[str] = "m/s^2"
    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    point: Float[Array, "3"] | None
    axes: Float[Array, "3 3"]

    def __init__(
        self, body: str, point: Numbers | None = None, axes: Numbers | None = None, *,
        name: str | None = None,
    ) -> None:  # fmt: skip
        self.name, self.body, self.axes = name or f"accelerometer {body}", body, _check_axes(axes)
        self.point = _check_point(point, f"accelerometer on '{body}'")

    def read(self, motion: SensedMotion) -> Point:
        k, kin = motion.kin.index(self.body), motion.kin
        # An accelerometer reads all forces but gravity: at rest it reads 1 g upwards, in free fall
        # nothing.
        felt = kin.R_wb[k].T @ (motion.v_rate[k] - motion.gravity)
        if self.point is not None:
            arm = self.point - kin.com[k]
            felt = felt + relative_acceleration(kin.omega[k], motion.omega_rate[k], arm)
        return self.axes @ felt


class PositionFix(AbstractVectorSensor):
    """Sensor of the world position of a body's centre of mass, or of a point of it (3,) [m]."""

    needs_accelerations: ClassVar[bool] = False
    unit: ClassVar[str] = "m"
    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    point: Float[Array, "3"] | None

    def __init__(self, body: str, point: Numbers | None = None, *, name: str | None = None) -> None:
        self.name, self.body = name or f"position {body}", body
        self.point = _check_point(point, f"position fix on '{body}'")

    def read(self, motion: SensedMotion) -> Point:
        k = motion.kin.index(self.body)
        r = motion.kin.r[k]
        if self.point is None:
            return r
        return r + motion.kin.R_wb[k] @ (self.point - motion.kin.com[k])


class AttitudeFix(AbstractVectorSensor):
    """Attitude sensor: Euler parameters of a body (4,), with errors in its axes (3,) [rad]."""

    needs_accelerations: ClassVar[bool] = False
    unit: ClassVar[str] = "rad"
    is_rotation: ClassVar[bool] = True
    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)

    def __init__(self, body: str, *, name: str | None = None) -> None:
        self.name, self.body = name or f"attitude {body}", body

    def read(self, motion: SensedMotion) -> Point:
        return motion.p[motion.kin.index(self.body)]


class Encoder(AbstractSensor):
    """Encoder, which reads the angle [rad] or displacement [m] of a joint (1,).

    An angle lies in (-pi, pi], and a filter takes it as the same after a turn.

    Args:
        joint: name of the joint.
        coordinate: "angle" or "displacement", needed if the joint leaves both free.
        name: name of the sensor; by default "encoder" and the joint's.
    """

    needs_accelerations: ClassVar[bool] = False
    name: str = eqx.field(static=True)
    joint: str = eqx.field(static=True)
    coordinate: Which | None = eqx.field(static=True)

    def __init__(
        self, joint: str, coordinate: Which | None = None, *, name: str | None = None
    ) -> None:
        self.name, self.joint, self.coordinate = name or f"encoder {joint}", joint, coordinate

    def space(self, system: System) -> AbstractSpace:
        joint = system.joints[system.joint_index(self.joint)]
        # a screw's displacement tells its whole turns
        # The space of a reading says what its differences are: a filter that subtracts plain
        # numbers sees a jump of a turn as an innovation.
        return CyclicVector((self._resolve_coordinate(joint) == "angle" and not joint.pitched,))

    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        joint = system.joints[system.joint_index(self.joint)]
        return ((self.name, "rad" if self._resolve_coordinate(joint) == "angle" else "m"),)

    def read(self, motion: SensedMotion) -> Point:
        joint = motion.kin.joint(self.joint)
        return evaluate_coordinate(motion.kin, joint, self._resolve_coordinate(joint)).value[None]

    def _resolve_coordinate(self, joint: Joint) -> Which:
        return choose_coordinate(joint, self.coordinate, f"The encoder of joint '{self.joint}'")


# Classes of sensors by the names that models' and missions' files have for them.
SENSORS: dict[str, Callable[..., AbstractSensor]] = {
    "gyroscope": Gyroscope,
    "accelerometer": Accelerometer,
    "encoder": Encoder,
    "position": PositionFix,
    "attitude": AttitudeFix,
}


def gravity_of(system: System) -> Float[Array, "3"]:
    """Acceleration of free fall by a system's gravity, world (3,) [m/s^2]; zero without any."""
    # Gravity is taken from the system and not assumed: a mechanism in a centrifuge, or in orbit,
    # has another one or none.
    accelerations = [as_numpy(f.acceleration) for f in system.forces if isinstance(f, Gravity)]
    return as_floats(sum(accelerations, start=np.zeros(3)))


def sensed_motion_at(
    space: AbstractStateSpace,
    x: Point,
    t: Time = 0.0,
    system: System | None = None,
    *,
    accelerations: bool = True,
) -> SensedMotion:
    """Motion of all bodies at a point of a state space, with accelerations by its equations.

    Args:
        system: system with the same mechanism and other forces; by default the space's own.
        accelerations: false to leave accelerations out, which are then NaN.
    """
    system = space.system if system is None else system
    if not accelerations:
        state = space.to_state(x, t)
        none = jnp.full_like(state.v, jnp.nan)
        return SensedMotion(system.kinematics(state), state.p, none, none, gravity_of(system))
    state, rate = space.state_and_rate(x, t, system)
    return SensedMotion(system.kinematics(state), state.p, rate.v, rate.omega, gravity_of(system))


def sensed_motion_along(run: Run) -> SensedMotion:
    """Motion of all bodies at the saved times of a run, stacked along the first axis.

    Raises:
        SettingError: the run was made with analysis=False.
    """
    system, accelerations = run.scene.system, run.snapshot.accelerations
    states = jax.tree.map(jnp.asarray, run.states)
    kin = jax.vmap(system.kinematics)(states)
    g = jnp.broadcast_to(gravity_of(system), (len(run.ts), 3))
    return SensedMotion(
        kin, states.p, jnp.asarray(accelerations.v_rate), jnp.asarray(accelerations.omega_rate), g
    )


def readings(sensors: tuple[AbstractSensor, ...], run: Run) -> dict[str, Array]:
    """Readings of sensors at the saved times of a run, (k, components) by the sensor's name.

    Raises:
        SettingError: the run was made with analysis=False; no sensors, or two of one name.
    """
    check_sensors(sensors)
    sensed_motion = sensed_motion_along(run)
    return {sensor.name: jax.vmap(sensor.read)(sensed_motion) for sensor in sensors}


def check_sensors(sensors: tuple[AbstractSensor, ...]) -> None:
    """Raise `SettingError` unless there are sensors and their names differ."""
    names = [sensor.name for sensor in sensors]
    if not names:
        raise SettingError("A measurement needs at least one sensor.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SettingError(f"Two sensors have the name {', '.join(twice)}: each is needed once.")


# --- coordinates of joints by name


class Output(NamedTuple):
    """Scalar output of a mechanism: a function of (system, state), with its unit and label."""

    of: Callable[[System, State], Float[Array, ""]]
    unit: str
    label: str


def joint_outputs(system: System) -> dict[str, Output]:
    """Coordinates of all joints that leave an angle or a displacement free, and their rates, by name.

    `A.angle` is the angle of the joint A [rad], in (-pi, pi] except that of a screw, `A.angle_rate` its
    rate; `A.displacement` and `A.displacement_rate` likewise [m], [m/s]. States of a `TreeSpace` have
    the same names.
    """
    outputs: dict[str, Output] = {}
    for joint in system.joints:
        for kind in free_coordinates(joint):

            def read(
                system: System, state: State, field: str, name: str = joint.name, kind: Which = kind
            ) -> Float[Array, ""]:
                kin = system.kinematics(state)
                return getattr(evaluate_coordinate(kin, kin.joint(name), kind), field)

            unit, name = "rad" if kind == "angle" else "m", f"{joint.name}.{kind}"
            label = f"joint {joint.name}, {kind}"
            outputs[name] = Output(partial(read, field="value"), unit, label)
            outputs[f"{name}_rate"] = Output(
                partial(read, field="rate"), f"{unit}/s", f"{label}, rate"
            )
    return outputs


def joint_output(system: System, name: str) -> Output:
    """Output of a system by its name; raises `SettingError` for an unknown one."""
    outputs = joint_outputs(system)
    if name not in outputs:
        raise SettingError(f"There is no output '{name[:80]}'.{nearest_names(name[:80], outputs)}")
    return outputs[name]


# --- the simulator as the process model of a filter

Adapt = Callable[[AbstractStateSpace, Float[Array, " p"]], AbstractStateSpace]


def moved_over(
    space: AbstractStateSpace, x: Point, dt: Any, system: Any, substeps: int = 1
) -> Point:
    """Point after a motion over dt [s], forces held, by the classical Runge-Kutta method.

    The method integrates the error from the point, whose rates are those of the exact motion, so
    that coordinates do not drift off the constraints and rotations stay rotations.
    """
    # In the error from the start and not in the coordinates: those of rotations and of closed
    # loops lie on a curved surface, errors in a flat space.
    h = dt / substeps

    def take_step(x: Point, _: None) -> tuple[Point, None]:
        rate = lambda v, s: motion_rates(space, x, v, 0.0, system)
        v = rk4_step(rate, space.difference(x, x), h, in_loop=True)
        return space.with_closed_loops(space.retract(x, v)), None

    # stages and substeps are loops: a mechanism's rates are compiled once, not in each of them
    if substeps == 1:
        return take_step(x, None)[0]
    return jax.lax.scan(take_step, x, length=substeps)[0]


def _covariance_matrix(variances: Numbers) -> Numbers:
    """The covariance of independent noises from their variances (n,); matrices stay."""
    return jnp.diag(jnp.asarray(variances)) if np.ndim(variances) == 1 else variances


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

    def adapt_system(x: Point, u: Any) -> tuple[AbstractStateSpace, Point, Any]:
        # The mechanism is made anew from the parameters in each step: they are states, and
        # derivatives with respect to them are what the filter learns from.
        adapted = space if adapt is None else adapt(space, x["parameters"])
        system = adapted.system if inputs is None else inputs.applied(adapted.system, u)
        return adapted, (x if adapt is None else x["motion"]), system

    def step_point(x: Point, u: Any, dt: Any) -> Point:
        adapted, point, system = adapt_system(x, u)
        after = moved_over(adapted, point, dt, system, substeps)
        return after if adapt is None else {"motion": after, "parameters": x["parameters"]}

    def read_sensors(x: Point, u: Any) -> Point:
        adapted, point, system = adapt_system(x, u)
        sensed = sensed_motion_at(adapted, point, 0.0, system, accelerations=felt)
        return jnp.concatenate([sensor.read(sensed) for sensor in sensors])

    # Accelerations cost a solution of the equations of motion, which most sensors do not need.
    felt = any(sensor.needs_accelerations for sensor in sensors)
    parts = [sensor.space(space.system) for sensor in sensors]
    reading_space = Concatenated(*parts)
    if all(isinstance(part, Vector | CyclicVector) for part in parts):
        # Plain vectors are joined to one, whose operations are single array operations; only attitudes
        # need their own.
        reading_space = CyclicVector(tuple(
            turning for part in parts
            for turning in (part.angular if isinstance(part, CyclicVector) else (False,) * part.size)
        ))  # fmt: skip
    names = tuple(name for sensor in sensors for name, _ in sensor.components(space.system))
    # Unknown parameters are constants among the states, and are estimated with the motion.
    states = space if adapt is None else Composite(motion=space, parameters=Vector(len(parameters)))
    return StateSpaceModel(
        step_point,
        _covariance_matrix(Q),
        Sensor(read_sensors, _covariance_matrix(R), space=reading_space, names=names),
        space=states,
        names=(*(name for name, _ in space.names), *parameters),
        noise_per=noise_per,
    )
