"""Simulation of a day of pointing a panel at the sun: angles, strokes, errors and energy.

At each time the sun's apparent direction is rotated to the UAV's axes by the attitude, and gives
panel angles and strokes. Where the tracker cannot face the sun, its panel faces the nearest
direction that it can (`reach.py`). At night there is nothing to point at: angles are NaN.

Five panels of the same area are compared under the same clear sky:

    tracker      the panel on the UAV          single_axis   on the ground, axis north-south
    two_axis     always faces the sun          airframe      fixed on the UAV, normal R_wb e_z
    flat         lies level

Source: report Part II, section 2.4 (comparison) and 3.2 (scenario 2).
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date, datetime, timedelta, timezone, tzinfo
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..algebra.compiler import quick_jit
from ..algebra.rotation import from_rotation_vector, rotation_matrix
from ..checks.errors import SettingError, StateError, check_finite, nearest_names
from ..checks.numbers import as_jax, floats
from ..checks.shapes import Numbers
from ..environment.ephemeris import Air, Place
from ..environment.irradiance import (
    ClearSky,
    clear_sky,
    energy,
    level_normals,
    panel_irradiance,
    single_axis_normals,
)
from ..environment.sun import Sun, check_attitude, in_body, in_world, sun_position
from ..parameters.airframe import PART_II
from ..parameters.table import Parameters
from .forward import angles_from_strokes
from .geometry import TrackerGeometry, tracker_geometry
from .kinematics import Reason, panel_angles, panel_normal, strokes
from .pointing import aim
from .reach import ReachableGrid, nearest_reachable
from .workspace import Limits, tracker_limits

# Years in which the series is within 0.005 degrees of the SPA (docs/sun.md).
YEARS = (1950, 2110)

PANELS = ("tracker", "two_axis", "single_axis", "airframe", "flat")

Attitude = Numbers | Callable[..., object]
Samples = Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Imperfections:
    """Imperfections that keep a real panel from pointing exactly.

    Attributes:
        stroke_step: smallest step of the linear actuators [m]; strokes are rounded to it.
        attitude_error: rotation vector from the true attitude to the one assumed by the
            controller, body axes (3,) [rad].
    """

    stroke_step: float = 0.0
    attitude_error: Numbers = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Day:
    """Results of a day of pointing at the sun, at n times.

    Attributes:
        place: place of the UAV.
        start: local midnight.
        unix: Unix times (n,) [s].
        hours: times since local midnight (n,) [h].
        daylight: intervals (from, to) in which the sun is up, since local midnight [h].
        sun: apparent position of the sun.
        R_wb: attitude of the UAV (3, 3, n).
        s_b: direction to the sun in the UAV's axes (3, n).
        angles: panel angles (phi, theta) (2, n) [rad]; NaN at night.
        strokes: heights of the rods' lower joints (2, n) [m]; NaN at night.
        normals_w: the panel's unit normals in the world (3, n); NaN at night.
        reason: codes of `Reason` (n,), 0 where the panel faces the sun.
        sky: irradiances under a clear sky.
        irradiance: irradiance of each of `PANELS` (n,) [W/m^2].
        energy: the day's energy on each of `PANELS` [J/m^2].
        geometry, limits: lengths of the tracker, and limits of its workspace.
        parameters: parameter table from which both are taken.
        settings: remaining settings of the calculation, by name.
    """

    place: Place
    start: datetime
    unix: Samples
    daylight: list[tuple[float, float]]
    sun: Sun
    R_wb: Float[np.ndarray, "3 3 n"]
    s_b: Float[np.ndarray, "3 n"]
    angles: Float[np.ndarray, "2 n"]
    strokes: Float[np.ndarray, "2 n"]
    normals_w: Float[np.ndarray, "3 n"]
    reason: Int[np.ndarray, " n"]
    sky: ClearSky
    irradiance: dict[str, Samples]
    energy: dict[str, float]
    geometry: TrackerGeometry
    limits: Limits
    parameters: Parameters
    settings: dict[str, Any]

    @property
    def hours(self) -> Samples:
        return (self.unix - self.unix[0]) / 3600.0

    @property
    def is_up(self) -> np.ndarray:
        """True where the sun is above the horizon (n,)."""
        return np.asarray(self.sun.is_up)

    @property
    def displacements(self) -> Float[np.ndarray, "2 n"]:
        """Displacements of the slider joints from the initial posture (2, n) [m]."""
        return self.strokes - np.asarray(self.limits.home)[:, None]

    @property
    def facing(self) -> np.ndarray:
        """True where the sun is up and within reach of the tracker (n,)."""
        return self.reason == Reason.VALID

    @property
    def incidence_cosine(self) -> Samples:
        """Cosine of the angle between the panel's normal and the sun (n,); NaN at night."""
        return np.sum(self.normals_w * np.asarray(self.sun.s_w), axis=0)

    @property
    def pointing_error(self) -> Samples:
        """Angle between the panel's normal and the sun (n,) [rad]; NaN at night."""
        apart = np.linalg.norm(self.normals_w - np.asarray(self.sun.s_w), axis=0)
        return 2.0 * np.arcsin(np.minimum(apart / 2.0, 1.0))

    def gain(self, panel: str, over: str = "flat") -> float:
        """Relative excess of one panel's energy over another's [1]."""
        return self.energy[panel] / self.energy[over] - 1.0

    def hours_of(self, which: np.ndarray) -> float:
        """Total time for which a mask (n,) holds [h]."""
        return float(np.trapezoid(which.astype(float), self.hours))


def parse_date(words: str) -> date:
    """Date from text such as 2024-03-21.

    Raises:
        SettingError: text of another form, a day that does not exist, or a year outside `YEARS`.
    """
    if not re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}", words):
        raise SettingError(f"The date must be like 2024-03-21, not '{words[:40]}'.")
    try:
        day = date.fromisoformat(words)
    except ValueError:
        raise SettingError(f"There is no day {words} in the calendar.") from None
    check_year(day)
    return day


def check_year(day: date) -> None:
    """Raise SettingError outside the years in which the sun's position is accurate enough."""
    if not YEARS[0] <= day.year <= YEARS[1]:
        raise SettingError(
            f"The sun's place is known for the years {YEARS[0]} to {YEARS[1]}, not for "
            f"{day.isoformat()}."
        )


def day_zone(words: str | None, longitude: float) -> tzinfo:
    """Time zone from its name, from an offset such as +07:00, or from the longitude [degrees].

    The longitude is used where no words are given (None), and rounded to a whole hour.

    Raises:
        SettingError: a name that is not known.
    """
    if words is None:
        hours = (
            round(((longitude + 180.0) % 360.0 - 180.0) / 15.0) if math.isfinite(longitude) else 0
        )
        return timezone(timedelta(hours=hours))
    if match := re.fullmatch(r"([+-])(\d\d):?(\d\d)", words):
        sign = -1 if match[1] == "-" else 1
        offset = timedelta(hours=int(match[2]), minutes=int(match[3]))
        if offset < timedelta(hours=24):
            return timezone(sign * offset)
    try:
        return ZoneInfo(words)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        hint = nearest_names(words, available_timezones()).split(" Known")[0]
        raise SettingError(
            f"There is no time zone '{words}'.{hint} Give a name like Asia/Phnom_Penh or an offset "
            "like +07:00."
        ) from None


def day_times(day: date, zone: tzinfo, step: float) -> tuple[datetime, Samples]:
    """Local midnight, and Unix times [s] from it to the next midnight, about `step` s apart.

    Raises:
        SettingError: a step outside 1 to 7200 s.
    """
    if not (math.isfinite(step) and 1.0 <= step <= 7200.0):
        raise SettingError(f"The time step must lie within 1 and 7200 s, but it is {step} s.")
    start = datetime(day.year, day.month, day.day, tzinfo=zone)
    after = day + timedelta(days=1)
    # a day may have 23 or 25 hours
    ends = start.timestamp(), datetime(after.year, after.month, after.day, tzinfo=zone).timestamp()
    return start, np.linspace(*ends, 1 + math.ceil((ends[1] - ends[0]) / step))


def attitudes(attitude: Attitude, times: Samples) -> Float[np.ndarray, "3 3 n"]:
    """Attitudes R_wb (3, 3, n) from a constant (3, 3), a history (3, 3, n), or a function of time.

    Raises:
        StateError: another shape, or matrices that are no rotations.
    """
    if callable(attitude):
        R = np.asarray(jax.vmap(attitude, out_axes=-1)(jnp.asarray(times)))
    else:
        R = np.asarray(attitude, dtype=float)
    if R.shape == (3, 3):
        R = np.repeat(R[..., None], len(times), axis=-1)
    if R.shape != (3, 3, len(times)):
        raise StateError(
            f"The attitude must be a rotation (3, 3), one for each of the {len(times)} times "
            f"(3, 3, {len(times)}), or a function of time that gives (3, 3); it has {R.shape}."
        )
    check_attitude(R)
    return R


class _Aim(NamedTuple):
    """Pointing of the panel at n times, day or night; arrays as in `Day`."""

    angles: Float[Array, "2 n"]
    strokes: Float[Array, "2 n"]
    normals_w: Float[Array, "3 n"]
    reason: Int[Array, " n"]


def _aim(
    geometry: TrackerGeometry,
    limits: Limits,
    s_w: Float[Array, "3 n"],
    R_wb: Float[Array, "3 3 n"],
    flaws: Imperfections,
    up: np.ndarray,
    grid: ReachableGrid | None,
) -> _Aim:
    """Panel angles and strokes, as the controller computes them: within reach where the sun is up."""
    s_b, angles, reason = _wish(geometry, limits, s_w, R_wb, floats(flaws.attitude_error))
    out = up & (np.asarray(reason) != Reason.VALID)
    wanted = np.array(angles)
    wanted[:, out] = nearest_reachable(geometry, np.asarray(s_b)[:, out], limits, grid)
    angles = floats(wanted)
    if flaws.stroke_step > 0:
        q = jnp.round(strokes(geometry, angles) / flaws.stroke_step) * flaws.stroke_step
        angles = jax.jit(angles_from_strokes)(geometry, q, angles).angles
    q, normals = _hold(geometry, angles, R_wb)
    return _Aim(angles, q, normals, reason)


@quick_jit
def _wish(
    geometry: TrackerGeometry, limits: Limits, s_w: Array, R_wb: Array, error: Array
) -> tuple[Array, Array, Array]:
    """Directions to the sun in the axes of the assumed attitude, their panel angles and reasons."""
    believed = jnp.einsum("ijn,jk->ikn", R_wb, rotation_matrix(from_rotation_vector(error)))
    s_b = in_body(s_w, believed)
    return s_b, panel_angles(s_b), aim(geometry, s_b, limits, throw=False).reason


@quick_jit
def _hold(geometry: TrackerGeometry, angles: Array, R_wb: Array) -> tuple[Array, Array]:
    """Strokes that hold panel angles, and the panel's normals in the world."""
    return strokes(geometry, angles), in_world(panel_normal(angles), R_wb)


@quick_jit
def _sun(times: Array, place: Place, air: Air) -> Sun:
    return sun_position(times, place, air=air)


def _daylight(unix: Samples, place: Place, air: Air) -> list[tuple[float, float]]:
    """Intervals in which the sun is up [h] since the first time, by its elevation every minute."""
    # refraction sets in with a jump, so that interpolation needs short steps
    times = np.linspace(unix[0], unix[-1], 1 + round((unix[-1] - unix[0]) / 60.0))
    height = np.asarray(_sun(times, place, air).elevation)
    hours = (times - times[0]) / 3600.0
    k = np.flatnonzero((height[1:] > 0) != (height[:-1] > 0))
    edges = list(hours[k] + height[k] / (height[k] - height[k + 1]) * (hours[k + 1] - hours[k]))
    edges = [0.0] * bool(height[0] > 0) + edges + [hours[-1]] * bool(height[-1] > 0)
    return [(float(a), float(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _check_flaws(flaws: Imperfections) -> None:
    if not (math.isfinite(flaws.stroke_step) and 0.0 <= flaws.stroke_step <= 0.05):
        raise SettingError(
            f"The actuators' step must lie within 0 and 0.05 m, but it is {flaws.stroke_step} m."
        )
    error = np.asarray(flaws.attitude_error, dtype=float)
    if error.shape != (3,):
        raise SettingError(f"The attitude error must be three numbers, not {error.shape}.")
    check_finite(error, "The attitude error", "rad", SettingError)


def track_day(
    place: Place,
    day: date,
    zone: tzinfo,
    attitude: Attitude = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    *,
    step: float = 300.0,
    flaws: Imperfections | None = None,
    parameters: Parameters = PART_II,
    turbidity: float | None = None,
    albedo: float = 0.2,
    grid: ReachableGrid | None = None,
) -> Day:
    """Point the panel at the sun from local midnight to local midnight.

    Args:
        place: place of the UAV.
        day: day of the calendar there.
        zone: time zone of the place.
        attitude: R_wb of the UAV: constant (3, 3), a history (3, 3, n) at the times of
            `day_times`, or a function of the time since midnight [s] that gives (3, 3).
        step: time between samples [s], made a little shorter to fit the day.
        flaws: imperfections of the actuators and of the known attitude; by default none.
        parameters: table with the tracker's lengths and strokes.
        turbidity: Linke's turbidity [1]; by default the month's mean there.
        albedo: reflectivity of the ground [1].
        grid: `reachable_grid` of the table's tracker; by default it is computed where the sun is
            out of reach.

    Raises:
        SettingError: a step, turbidity or flaw that makes no sense.
        StateError: a sun that does not rise that day, or an attitude that is no rotation.
        ModelError: a tracker that reaches no posture.
    """
    flaws = Imperfections() if flaws is None else flaws
    _check_flaws(flaws)
    check_year(day)
    start, unix = day_times(day, zone, step)
    air = Air.standard(place.altitude)
    sun = _sun(unix, place, air)
    up = np.asarray(sun.is_up)
    if not np.any(up):
        raise StateError(
            f"The sun does not rise at {math.degrees(float(place.latitude)):.5g} degrees north on "
            f"{day.isoformat()}: at best it stands {-math.degrees(float(np.max(sun.elevation))):.3g}"
            " degrees below the horizon."
        )
    sky = clear_sky(unix, place, sun, air, turbidity=turbidity)
    R_wb = attitudes(attitude, unix - unix[0])
    geometry, limits = tracker_geometry(parameters), tracker_limits(parameters)
    aimed = _aim(geometry, limits, sun.s_w, as_jax(R_wb), flaws, up, grid)
    reason = np.where(up, aimed.reason, np.int8(Reason.BELOW_HORIZON))
    angles, q, normals = (np.where(up, np.asarray(part), np.nan) for part in aimed[:3])
    faces = {
        "tracker": np.where(up, normals, level_normals(len(unix))),
        "two_axis": np.asarray(sun.s_w),
        "single_axis": single_axis_normals(sun),
        "airframe": R_wb[:, 2],
        "flat": level_normals(len(unix)),
    }
    s_b = np.einsum("jin,jn->in", R_wb, np.asarray(sun.s_w))
    light = {name: panel_irradiance(faces[name], sun, sky, albedo=albedo) for name in PANELS}
    return Day(
        place, start, unix, _daylight(unix, place, air), sun, R_wb, s_b,
        angles, q, normals, reason, sky, light, {name: energy(unix, light[name]) for name in PANELS},
        geometry, limits, parameters,
        {
            "step": float(unix[1] - unix[0]),
            "clear sky": "Ineichen-Perez",
            "turbidity": "pvlib's monthly means" if turbidity is None else turbidity,
            "albedo": albedo,
            "pressure": float(air.pressure),
            "temperature": float(air.temperature),
            "stroke step": flaws.stroke_step,
            "attitude error": np.asarray(flaws.attitude_error).tolist(),
                    },
    )  # fmt: skip
