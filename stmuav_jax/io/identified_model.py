"""Model, mission and study of the multirotor that a flight has identified.

A rotor's speed is omega = lowest + (highest - lowest) u by its command u, and its thrust agrees with the
identified one in value and slope at the mean command of the flight, and in curvature where the flight or
the airframe's file has one; else it is k_f omega^2.
"""

import itertools
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from scipy.constants import g as GRAVITY

from ..checks.errors import SettingError
from ..uav.flight_controller import FlightGains
from ..uav.flight_identification.stages import AXES, FlightIdentification, ParameterEstimate
from .netcdf import write_atomically

# Control rate of the mission [Hz], and samples of the study.
_RATE, _SAMPLES = 500.0, 100
# First waypoint after the start, time from one to the next, number of them [s].
_FIRST, _STEP, _COUNT = 1.0, 0.3, 107
# Largest share of the usual frequencies of the flight controller, and lag and delay by which it is that of a stable
# loop [s].
_SHARE, _SLOW_LAG, _SLOW_DELAY = 0.7, 0.045, 0.0056
# Coefficients of the curves of thrust and of torque.
_THRUST = ("k_f", "thrust_linear", "thrust_offset")
_TORQUE = ("k_tau", "torque_linear", "torque_offset")
# Largest correlation of factors.
_CORRELATED = 0.99


class IdentifiedFiles(NamedTuple):
    """Paths of the model, of a mission that flies manoeuvres with it, and of a study that draws its numbers.

    Attributes:
        notes: sentences on what the model takes from elsewhere or leaves out.
    """

    model: Path
    mission: Path
    study: Path
    notes: tuple[str, ...]


class _Number(NamedTuple):
    """Number of the model: value, unit, standard deviation [same unit] or None, and where it comes from."""

    value: float
    unit: str
    deviation: float | None
    source: str


def write_identified_model(
    result: FlightIdentification, path: str | os.PathLike[str], *, source: str = "the flight"
) -> IdentifiedFiles:
    """Write the identified multirotor as a model's file, with a mission and a study in the same folder.

    The study draws what the flight determines from normal distributions with the stated deviations; a common thrust
    correlates them. Motors are assumed equal.

    Args:
        path: of the model's file, which ends in .toml. source: name of the log, for the file.

    Raises:
        SettingError: neither the flight nor the layout has a number that the model needs; the message names all
            of them.
    """
    target = Path(path)
    if target.suffix != ".toml":
        raise SettingError(f"A model's file ends in .toml, but its path is to be {target}.")
    numbers, notes = _model_numbers(result, source)
    flight, study = (target.with_name(f"{target.stem}_{end}.toml") for end in ("flight", "study"))
    tables = {
        target: _model(result, numbers, notes, source),
        flight: _mission(result, numbers, target.name, flight.stem),
        study: _study(result, numbers, flight.name),
    }
    for place, table in tables.items():
        write_atomically(place, tomli_w.dumps(table).encode())
    return IdentifiedFiles(target, flight, study, tuple(notes))


def _model_numbers(
    result: FlightIdentification, source: str
) -> tuple[dict[str, _Number], list[str]]:
    """Numbers of the model by name, and notes on those that are not from the flight."""
    layout, estimates, hover = result.layout, result.estimates, result.hover
    numbers: dict[str, _Number] = {}
    notes = ["Motors count as equal. No flight determines the products of inertia."]
    missing = []

    def add(
        name: str, value: float, unit: str, e: ParameterEstimate | None, scale: float = 1.0
    ) -> None:
        """A number that an estimate, times a scale, determines; None for one of the airframe's file."""
        deviation = None if e is None else abs(scale) * e.deviation
        origin = "airframe's file"
        if e is not None:
            origin = f"{source}: {e.name}, deviation {deviation:.2g} {unit}"
        numbers[name] = _Number(float(value), unit, deviation, origin)

    if layout.mass is None:
        missing.append("'mass'")
    if layout.highest_speed is None:
        missing.append("'highest_speed' (the speed's scale)")
    lag = estimates.get("lag", estimates.get("thrust_lag"))
    if lag is None:
        missing.append("the lag of the motors (a flight with manoeuvres)")
    for axis, name in enumerate("xyz"):
        if f"inertia_{name}" not in estimates and layout.inertia is None:
            missing.append(f"'inertia' (J{name})")
        elif f"inertia_{name}" not in estimates and axis < 2:
            notes.append(f"J{name} is the airframe's: the flight does not excite {AXES[axis]}.")
    if "yaw" not in estimates and layout.torque_ratio is None:
        missing.append("'torque_ratio' (the flight does not excite yaw)")
    if missing:
        raise SettingError(
            f"A model needs {', '.join(missing)}, which neither the flight nor the airframe's file gives."
        )
    assert layout.mass is not None
    assert layout.highest_speed is not None
    assert lag is not None
    mass = layout.mass
    add("mass", mass, "kg", None)
    add("time_constant", lag.value, "s", lag)
    # thrust of a rotor at the mean command, which carries the weight, and its slope by the command there
    weight, factor = mass * GRAVITY / len(layout.spin), layout.thrust_model_factor
    force = estimates.get("force")
    if force is None:
        shape = hover * (1 - factor + factor * hover)
        slope = weight / shape * (1 - factor + 2 * factor * hover)
        notes.append("The thrust is that which carries the weight: the flight does not excite it.")
    elif "thrust_slope" in estimates:
        slope = 2 * hover * force.value
    else:
        slope = (1 - factor + 2 * factor * hover) * force.value
    highest = layout.highest_speed
    relative = 0.0 if force is None else force.deviation / force.value
    # curvature of the thrust by the command, halved, of the layout's shape; within two deviations of it another one
    # is not told from it
    quadratic = slope / (1 - factor + 2 * factor * hover) * factor
    measured = estimates.get("thrust_quadratic")
    has_curve = measured is not None and (
        abs(measured.value - quadratic / mass) > 2 * measured.deviation
    )
    if measured is not None and has_curve:
        # Noise may give a curve that falls at some command, which no rotor has.
        quadratic = float(np.clip(mass * measured.value, 0.0, slope / (2 * hover)))
    # The curve is T(u) = offset + linear u + quadratic u^2.
    curve = {}
    if factor == 1 and not has_curve:
        # Of the thrust k_f span^2 (u + idle)^2 the value over the slope is (hover + idle) / 2. An idle
        # speed below zero would be a rotor that turns backwards.
        idle = max(2 * weight / slope - hover, 0.0)
        span = highest / (1 + idle)
        k_f = slope / (2 * span**2 * (hover + idle))
        lowest = span * idle
    else:
        linear = max(slope - 2 * quadratic * hover, 0.0)
        span, k_f = highest, quadratic / highest**2
        curve["thrust_linear"] = linear / highest, "N s/rad"
        if has_curve:
            parts = [estimates[f"thrust_{k}"].value for k in ("offset", "linear", "quadratic")]
            thrust = mass * float(np.polynomial.polynomial.polyval(hover, parts))
            curve["thrust_offset"] = thrust - (linear + quadratic * hover) * hover, "N"
        lowest = 0.0
    text = f"slope of the thrust at the command {hover:.3g}, deviation {100 * relative:.2g} %"
    for name, (value, unit) in ({"k_f": (k_f, "N s^2/rad^2")} | curve).items():
        numbers[name] = _Number(value, unit, abs(value) * relative or None, f"{source}: {text}")
    origin = "value and slope of the thrust at the mean command"
    numbers["lowest"] = _Number(float(lowest), "rad/s", None, origin)
    add("highest", layout.highest_speed, "rad/s", None)
    for axis, name in enumerate("xyz"):
        e = estimates.get(f"inertia_{name}")
        value = e.value if e else layout.inertia[axis]  # pyright: ignore[reportOptionalSubscript]
        add(f"inertia_{name}", value, "kg m^2", e)
    Jz, yaw = numbers["inertia_z"].value, estimates.get("yaw")
    # torque and thrust of a rotor have the same shape
    per_shape = slope / (1 - factor + 2 * factor * hover)
    for name in ("k_f", *curve):
        torque, unit = name.replace("thrust", "torque").replace("k_f", "k_tau"), numbers[name].unit
        value, unit = numbers[name].value, unit.replace("N", "N m")
        if yaw is None:
            add(torque, layout.torque_ratio * value, unit, None)  # pyright: ignore
        else:
            scale = Jz * value / per_shape
            add(torque, yaw.value * scale, unit, yaw, scale)
    spin_up = estimates.get("spin_up")
    # Within two deviations of zero, an inertia of the rotors is not told from none.
    if spin_up is not None and spin_up.value > 2 * spin_up.deviation:
        add("rotor_inertia", spin_up.value * Jz / span, "kg m^2", spin_up, Jz / span)
    for axis, name in enumerate("xy"):
        e = estimates.get(f"centre_{name}")
        add(f"centre_{name}", e.value if e else layout.centre[axis], "m", e)
        if e is None:
            notes.append(
                f"The centre of mass is at the rotors' centre along {name}: it is not determined."
            )
    if layout.centre_height is None:
        notes.append(
            "The centre of mass is at the height of the layout's origin: no flight determines it."
        )
    add("centre_z", layout.centre_height or 0.0, "m", None)
    for name in "xyz":
        e = estimates.get(f"drag_{name}")
        # A drag below zero, which noise may give or a study draw, would feed energy to the model.
        if e is None or e.value < 2 * e.deviation:
            notes.append(f"There is no drag along {name}: it is not clearly positive.")
        else:
            add(f"drag_{name}", mass * e.value, "N s/m", e, mass)
    height = _drag_height(numbers, estimates)
    if height is not None:
        numbers["drag_height"] = height
    if "voltage_exponent" in estimates:
        notes.append("The thrust is that at the mean voltage of the flight.")
    imu = [estimates[f"imu_{x}"].value for x in "xyz" if f"imu_{x}" in estimates]
    if len(imu) == 3:
        place = ", ".join(f"{1e3 * x:.2g}" for x in imu)
        notes.append(
            f"The IMU is at ({place}) mm from the centre of mass; that of missions is at it."
        )
    if "delay" in estimates:
        notes.append(
            f"The delay of {1e3 * estimates['delay'].value:.2g} ms is in the mission's rates: a model has none."
        )
    return numbers, notes


def _drag_height(
    numbers: dict[str, _Number], estimates: dict[str, ParameterEstimate]
) -> _Number | None:
    """Height at which drag makes the moments of horizontal speed: m_y = h c_y / Jx, m_x = -h c_x / Jy."""
    rows = []
    for name, drag, inertia, sign in (
        ("roll_speed", "drag_y", "inertia_x", 1), ("pitch_speed", "drag_x", "inertia_y", -1)
    ):  # fmt: skip
        if name in estimates and drag in numbers:
            slope, e = sign * numbers[drag].value / numbers[inertia].value, estimates[name]
            rows.append((slope / e.deviation, e.value / e.deviation))
    if not rows:
        return None
    # Each row is over its deviation, so that least squares weighs it by what it determines.
    slope, value = np.array(rows).T
    height, deviation = float(slope @ value / (slope @ slope)), float(1 / np.linalg.norm(slope))
    place = numbers["centre_z"].value + height
    return _Number(
        place, "m", deviation, f"moments of horizontal speed, deviation {deviation:.2g} m"
    )


def _model(
    result: FlightIdentification, numbers: dict[str, _Number], notes: list[str], source: str
) -> dict[str, Any]:
    """Entries of the model's file."""
    layout = result.layout
    centre = [f"centre_{x}" for x in "xyz"]
    motors = {
        "kind": "motors", "body": "frame", "arms": layout.positions.tolist(), "spin": layout.spin.tolist(),
        "time_constant": "time_constant", "lowest": "lowest", "highest": "highest",
        **{name: name for name in (*_THRUST, *_TORQUE) if name in numbers},
    }  # fmt: skip
    if "rotor_inertia" in numbers:
        motors["inertia"] = "rotor_inertia"
    drag = [f"drag_{x}" if f"drag_{x}" in numbers else 0.0 for x in "xyz"]
    forces: dict[str, Any] = {"weight": {"kind": "gravity"}, "motors": motors}
    if any(isinstance(x, str) for x in drag):
        forces["air"] = {"kind": "drag", "body": "frame", "linear": drag}
        if "drag_height" in numbers:
            forces["air"]["point"] = [*centre[:2], "drag_height"]
    return {
        "format": 2, "title": f"Multirotor identified from {source}", "notes": notes,
        "parameters": {
            name: {"value": x.value, "unit": x.unit, "source": x.source} for name, x in numbers.items()
        },
        "bodies": {"frame": {
            "mass": "mass", "inertia": [f"inertia_{x}" for x in "xyz"], "com": centre,
            "com_position": [0.0, 0.0, 0.0], "free": True,
        }},
        "forces": forces,
    }  # fmt: skip


def _mission(
    result: FlightIdentification, numbers: dict[str, _Number], model: str, name: str
) -> dict[str, Any]:
    """Entries of a mission whose quick moves along all axes excite what an identification needs."""
    delay = result.estimates["delay"].value if "delay" in result.estimates else 0.0
    share = min(
        _SHARE, _SLOW_LAG / numbers["time_constant"].value, _SLOW_DELAY / (delay + 1 / _RATE)
    )
    usual = FlightGains()
    # Gains of position and attitude are squares of a frequency, those of velocity and rate are
    # frequencies.
    gains = {
        name: float(getattr(usual, name)) * share**power
        for name, power in (("position", 2), ("velocity", 1), ("attitude", 2), ("rate", 1))
    }
    # With a fixed seed one flight always gives the same files.
    rng = np.random.default_rng(0)
    places = rng.choice([-1.0, 0.0, 1.0], (_COUNT, 4)) * [0.09, 0.09, 0.04, 14.0]
    places[[0, -1]] = 0.0
    points = [
        {"t": _FIRST + _STEP * k, "position": place[:3].tolist(), "heading": float(place[3])}
        for k, place in enumerate(places)
    ]
    return {
        "format": 1, "name": name, "title": "Manoeuvres of an identified multirotor",
        "t1": _FIRST + _STEP * _COUNT + 1.0, "machine": {"model": model},
        "rates": {"control": _RATE, "delay": round(delay * _RATE) / _RATE}, "controller": {"gains": gains},
        # vibrations as of small multirotors
        "sensors": {"standing": 1.0, "gyroscope": {"noise": 0.015}, "accelerometer": {"noise": 0.3}},
        "path": {"waypoints": points},
    }  # fmt: skip


def _study(
    result: FlightIdentification, numbers: dict[str, _Number], mission: str
) -> dict[str, Any]:
    """Entries of a study that draws the numbers with their deviations."""
    factors = {
        name: {"distribution": "normal", "mean": x.value, "standard_deviation": x.deviation}
        for name, x in numbers.items()
        if x.deviation
    }
    # J = F l / B: the thrust's error is that of both moments, and the lag's error that of both B
    square = lambda name: (numbers[name].deviation / numbers[name].value) ** 2  # pyright: ignore
    sign = lambda *names: float(np.prod([np.sign(numbers[name].value) for name in names]))
    thrust, torque = ([name for name in names if name in factors] for names in (_THRUST, _TORQUE))
    # One scale is unknown, that of the whole curve.
    correlation = [
        [a, b, sign(a, b)]
        for group in (thrust, torque)
        for a, b in itertools.combinations(group, 2)
    ]
    correlation += [
        [a, b, sign(a) * float(np.sqrt(square(a) / square(b)))]
        for a, b in itertools.product(thrust, ("inertia_x", "inertia_y"))
        if b in factors
    ]
    ratio = result.estimates.get("inertia_ratio")
    if ratio is not None and {"inertia_x", "inertia_y"} <= set(factors):
        x, y = square("inertia_x"), square("inertia_y")
        # The relative variance of Jx / Jy is that of both less twice what they have in common.
        common = (x + y - (ratio.deviation / ratio.value) ** 2) / 2
        correlation.append(["inertia_x", "inertia_y", float(common / np.sqrt(x * y))])
    return {
        "kind": "missions", "mission": mission, "samples": _SAMPLES, "factors": factors,
        "correlation": [[a, b, float(np.clip(rho, -_CORRELATED, _CORRELATED))] for a, b, rho in correlation],
    }  # fmt: skip
