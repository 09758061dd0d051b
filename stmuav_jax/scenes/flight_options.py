"""Options of flying scenes: drag, wind, motors, landing gear, and where the flight starts.

Numbers left out are those of the scene's parameter table ("drag.", "wind.", "gust.", "motor.", "gear.");
numbers given go into the table that is kept with the results. `rotors_and_air.py` and `starts.py`
build them; the command line reads this module without JAX.
"""

from dataclasses import dataclass

from ..checks.quantity import Numbers, quantity


@dataclass(frozen=True)
class Drag:
    """Aerodynamic drag of the hexacopter's airframe.

    Attributes:
        linear: linear coefficients (3,) [N s/m].
        quadratic: quadratic coefficients (3,) [N s^2/m^2].
        centre: centre of pressure (3,) [m].
    """

    linear: Numbers | None = quantity("linear coefficients in body axes", "N s/m", 3)
    quadratic: Numbers | None = quantity("quadratic coefficients in body axes", "N s^2/m^2", 3)
    centre: Numbers | None = quantity("centre of pressure in body axes", "m", 3)


@dataclass(frozen=True)
class Wind:
    """Steady wind, and low-altitude Dryden gusts that pass at its speed.

    Attributes:
        mean: mean wind, world (3,) [m/s].
        gusts: add gusts to the mean wind.
        seed: seed of the gusts' noise.
        height: height above ground [m].
        speed_20ft: wind speed at 20 feet, which sets the gusts' intensity [m/s].
        duration: time for which gusts are sampled [s]; a run beyond it stops with an error.
        spacing: time between samples of the gusts [s].
    """

    mean: Numbers | None = quantity("mean wind in world axes", "m/s", 3)
    gusts: bool = quantity("Dryden gusts about the mean wind", kind=bool, default=False)
    seed: int = quantity("seed of the gusts", kind=int, default=0)
    height: Numbers | None = quantity("height above ground, for the gusts", "m")
    speed_20ft: Numbers | None = quantity("wind at 20 feet, for the gusts' intensity", "m/s")
    duration: float = quantity("time for which gusts are drawn", "s", default=60.0)
    spacing: float = quantity("spacing of the gusts' samples", "s", default=0.01)


@dataclass(frozen=True)
class Motor:
    """Motors of the rotors with lag, inertia and limits.

    Attributes:
        time_constant: time constant of the speeds [s]. inertia: inertia of a rotor about its axis
            [kg m^2].
        lowest, highest: limits of the speeds [rad/s]. The motors start at their commands.
    """

    time_constant: Numbers | None = quantity("time constant of the speeds", "s")
    inertia: Numbers | None = quantity("inertia of a rotor about its axis", "kg m^2")
    lowest: Numbers | None = quantity("lowest speed", "rad/s")
    highest: Numbers | None = quantity("highest speed", "rad/s")


@dataclass(frozen=True)
class Gear:
    """Landing gear of the hexacopter on level ground, four feet at the corners of a square.

    Attributes:
        spread: half the side of the square [m]. depth: of the feet below the centre of mass [m].
        ground: height of the ground, world [m].
        stiffness: of each foot [N/m]. damping: of each foot [N s/m]. width: of the smoothing [m].
        friction: coefficient of friction [1]. slip_speed: of its smoothing [m/s].
    """

    spread: Numbers | None = quantity("half the side of the feet's square", "m")
    depth: Numbers | None = quantity("depth of the feet below the base's centre of mass", "m")
    ground: Numbers | None = quantity("height of the ground", "m")
    stiffness: Numbers | None = quantity("stiffness of each foot", "N/m")
    damping: Numbers | None = quantity("damping of each foot", "N s/m")
    width: Numbers | None = quantity("width of the smoothing", "m")
    friction: Numbers | None = quantity("coefficient of friction", "1")
    slip_speed: Numbers | None = quantity("speed of the friction's smoothing", "m/s")


@dataclass(frozen=True)
class AbstractStart:
    """Start of a hexacopter; numbers left out are zero.

    Attributes:
        x, y, z: position [m]. roll, pitch, yaw: attitude R_z(yaw) R_y(pitch) R_x(roll) [rad].
        vx, vy, vz: velocity, world [m/s]. p, q, r: angular velocity in its own axes [rad/s].
    """

    x: Numbers = quantity("position, x", "m", default=0.0)
    y: Numbers = quantity("position, y", "m", default=0.0)
    z: Numbers = quantity("position, height", "m", default=0.0)
    roll: Numbers = quantity("attitude, turn about x", "rad", default=0.0)
    pitch: Numbers = quantity("attitude, turn about y", "rad", default=0.0)
    yaw: Numbers = quantity("attitude, turn about z", "rad", default=0.0)
    vx: Numbers = quantity("velocity, x", "m/s", default=0.0)
    vy: Numbers = quantity("velocity, y", "m/s", default=0.0)
    vz: Numbers = quantity("velocity, upwards", "m/s", default=0.0)
    p: Numbers = quantity("angular velocity about its x axis", "rad/s", default=0.0)
    q: Numbers = quantity("angular velocity about its y axis", "rad/s", default=0.0)
    r: Numbers = quantity("angular velocity about its z axis", "rad/s", default=0.0)


@dataclass(frozen=True)
class BaseStart(AbstractStart):
    """Start of the bare hexacopter, as described by `AbstractStart`."""


@dataclass(frozen=True)
class FlightStart(AbstractStart):
    """Start of the hexacopter and of its tracker's panel.

    Numbers of the hexacopter left out are zero; those of the panel are the initial posture's, at
    rest.

    Attributes:
        phi, theta: panel angles [rad]. phi_rate, theta_rate: rates of the panel angles [rad/s].
    """

    phi: Numbers | None = quantity("first panel angle", "rad")
    theta: Numbers | None = quantity("second panel angle", "rad")
    phi_rate: Numbers = quantity("rate of the first panel angle", "rad/s", default=0.0)
    theta_rate: Numbers = quantity("rate of the second panel angle", "rad/s", default=0.0)
