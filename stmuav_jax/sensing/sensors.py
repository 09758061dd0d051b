"""Sensors as functions of a mechanism's motion, for filters and for the simulator.

A sensor takes positions, velocities and accelerations of all bodies (`SensedMotion`) and returns the
reading of an ideal instrument; noise and bias belong to the filter or the experiment.

Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems
(2013), ch. 4 (gyroscopes and accelerometers).
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import relative_acceleration
from ..algebra.space import AbstractSpace, CyclicVector, Point, Rotation, Vector
from ..checks.errors import SettingError
from ..checks.numbers import as_numpy, floats, numbers
from ..checks.shapes import Numbers
from ..dynamics.run import Run
from ..dynamics.statespace.base import AbstractStateSpace, Time
from ..mechanics.forces.applied import Gravity
from ..mechanics.joint import Joint
from ..mechanics.joint_coordinate import choose, coordinate
from ..mechanics.joint_kind import Which
from ..mechanics.state import Kinematics
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
    def read(self, seen: SensedMotion) -> Point:
        """Reading of the sensor during the given motion."""


def _axes(axes: Numbers | None) -> Float[Array, "3 3"]:
    return floats(np.eye(3)) if axes is None else numbers(axes, (3, 3), "The axes of a sensor", "")


class Gyroscope(AbstractSensor):
    """Gyroscope, which reads the angular velocity of a body in the sensor's axes (3,) [rad/s].

    Args:
        body: name of the body.
        axes: axes of the sensor in those of the body, in rows (3, 3); by default the body's.
        name: name of the sensor; by default "gyroscope" and the body's.
    """

    needs_accelerations: ClassVar[bool] = False
    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    axes: Float[Array, "3 3"]

    def __init__(self, body: str, axes: Numbers | None = None, *, name: str | None = None) -> None:
        self.name, self.body, self.axes = name or f"gyroscope {body}", body, _axes(axes)

    def space(self, system: System) -> AbstractSpace:
        del system
        return Vector(3)

    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        del system
        return tuple((f"{self.name} {axis}", "rad/s") for axis in "xyz")

    def read(self, seen: SensedMotion) -> Point:
        return self.axes @ seen.kin.omega[seen.kin.index(self.body)]


class Accelerometer(AbstractSensor):
    """Accelerometer, which reads the specific force at a point of a body (3,) [m/s^2].

    Args:
        body: name of the body.
        point: point in the body's reference frame (3,) [m]; by default the centre of mass.
        axes: axes of the sensor in those of the body, in rows (3, 3); by default the body's.
        name: name of the sensor; by default "accelerometer" and the body's.
    """

    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    point: Float[Array, "3"] | None
    axes: Float[Array, "3 3"]

    def __init__(
        self,
        body: str,
        point: Numbers | None = None,
        axes: Numbers | None = None,
        *,
        name: str | None = None,
    ) -> None:
        self.name, self.body, self.axes = name or f"accelerometer {body}", body, _axes(axes)
        self.point = None
        if point is not None:
            self.point = numbers(point, (3,), f"The point of the accelerometer on '{body}'", "m")

    def space(self, system: System) -> AbstractSpace:
        del system
        return Vector(3)

    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        del system
        return tuple((f"{self.name} {axis}", "m/s^2") for axis in "xyz")

    def read(self, seen: SensedMotion) -> Point:
        k, kin = seen.kin.index(self.body), seen.kin
        felt = kin.R_wb[k].T @ (seen.v_rate[k] - seen.gravity)
        if self.point is not None:
            arm = self.point - kin.com[k]
            felt = felt + relative_acceleration(kin.omega[k], seen.omega_rate[k], arm)
        return self.axes @ felt


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
        return CyclicVector((self._which(joint) == "angle" and not joint.pitched,))

    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        joint = system.joints[system.joint_index(self.joint)]
        return ((self.name, "rad" if self._which(joint) == "angle" else "m"),)

    def read(self, seen: SensedMotion) -> Point:
        joint = seen.kin.joint(self.joint)
        return coordinate(seen.kin, joint, self._which(joint)).value[None]

    def _which(self, joint: Joint) -> Which:
        return choose(joint, self.coordinate, f"The encoder of joint '{self.joint}'")


class PositionFix(AbstractSensor):
    """Sensor of the world position of a body's centre of mass, or of a point of it (3,) [m]."""

    needs_accelerations: ClassVar[bool] = False
    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    point: Float[Array, "3"] | None

    def __init__(self, body: str, point: Numbers | None = None, *, name: str | None = None) -> None:
        self.name, self.body, self.point = name or f"position {body}", body, None
        if point is not None:
            self.point = numbers(point, (3,), f"The point of the position fix on '{body}'", "m")

    def space(self, system: System) -> AbstractSpace:
        del system
        return Vector(3)

    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        del system
        return tuple((f"{self.name} {axis}", "m") for axis in "xyz")

    def read(self, seen: SensedMotion) -> Point:
        k = seen.kin.index(self.body)
        r = seen.kin.r[k]
        if self.point is None:
            return r
        return r + seen.kin.R_wb[k] @ (self.point - seen.kin.com[k])


class AttitudeFix(AbstractSensor):
    """Attitude sensor: Euler parameters of a body (4,), with errors in its axes (3,) [rad]."""

    needs_accelerations: ClassVar[bool] = False
    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)

    def __init__(self, body: str, *, name: str | None = None) -> None:
        self.name, self.body = name or f"attitude {body}", body

    def space(self, system: System) -> AbstractSpace:
        del system
        return Rotation()

    def components(self, system: System) -> tuple[tuple[str, str], ...]:
        del system
        return tuple((f"{self.name} {axis}", "rad") for axis in "xyz")

    def read(self, seen: SensedMotion) -> Point:
        return seen.p[seen.kin.index(self.body)]


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
    found = [as_numpy(f.acceleration) for f in system.forces if isinstance(f, Gravity)]
    return floats(sum(found, start=np.zeros(3)))


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
        accelerations: false for accelerations of NaN, which cost nothing.
    """
    given = space.system if system is None else system
    if not accelerations:
        state = space.to_state(x, t)
        none = jnp.full_like(state.v, jnp.nan)
        return SensedMotion(given.kinematics(state), state.p, none, none, gravity_of(given))
    rates = space.rates(x, t, given)
    time, zero = jnp.asarray(t, rates.dtype), jnp.zeros((), rates.dtype)
    onwards = jax.jvp(lambda s: space.retract(x, s * rates), (zero,), (jnp.ones_like(zero),))[1]
    state, slope = jax.jvp(space.to_state, (x, time), (onwards, jnp.ones_like(time)))
    return SensedMotion(given.kinematics(state), state.p, slope.v, slope.omega, gravity_of(given))


def sensed_motion_along(run: Run) -> SensedMotion:
    """Motion of all bodies at the saved times of a run, stacked along the first axis.

    Raises:
        SettingError: the run was made with analysis=False.
    """
    system, found = run.scene.system, run.snapshot.accelerations
    states = jax.tree.map(jnp.asarray, run.states)
    kin = jax.vmap(system.kinematics)(states)
    g = jnp.broadcast_to(gravity_of(system), (len(run.ts), 3))
    return SensedMotion(kin, states.p, jnp.asarray(found.v_rate), jnp.asarray(found.omega_rate), g)


def readings(sensors: tuple[AbstractSensor, ...], run: Run) -> dict[str, Array]:
    """Readings of sensors at the saved times of a run, (k, components) by the sensor's name.

    Raises:
        SettingError: the run was made with analysis=False; no sensors, or two of one name.
    """
    check_sensors(sensors)
    seen = sensed_motion_along(run)
    return {sensor.name: jax.vmap(sensor.read)(seen) for sensor in sensors}


def check_sensors(sensors: tuple[AbstractSensor, ...]) -> None:
    """Raise `SettingError` unless there are sensors and their names differ."""
    names = [sensor.name for sensor in sensors]
    if not names:
        raise SettingError("A measurement needs at least one sensor.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SettingError(f"Two sensors have the name {', '.join(twice)}: each is needed once.")
