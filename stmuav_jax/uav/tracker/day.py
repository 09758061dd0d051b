"""Simulation of a day of pointing a panel at the sun: angles, strokes, errors and energy.

Results of the whole day are computed at times of its daylight (`Day.lit`), whatever the user's
step. At each time the sun's apparent direction is rotated to the UAV's axes by the attitude, and gives
panel angles and strokes. Where the tracker cannot face the sun, its panel faces the nearest
direction that it can. At night there is nothing to point at: angles are NaN.

Five panels of the same area are compared under the same clear sky:

    tracker      the panel on the UAV          single_axis   on the ground, axis north-south
    two_axis     always faces the sun          airframe      fixed on the UAV, normal R_wb e_z
    flat         lies level

Source: report Part II, section 2.4 (comparison) and 3.2 (scenario 2)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date, datetime, tzinfo
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation, Slerp

from ...checks.errors import SettingError, StateError, check_finite
from ...checks.numbers import as_floats, as_jax
from ...checks.shapes import Numbers
from ...math.compiler import quick_jit
from ...math.rotation import from_rotation_vector, rotation_matrix
from ...mechanics.parameters import Parameters
from ..airframe import PART_II
from ..environment.calendar import day_bounds, day_zone, parse_date
from ..environment.ephemeris import Air, Place
from ..environment.irradiance import (
    ClearSky,
    clear_sky,
    level_normals,
    panel_irradiance,
    single_axis_normals,
)
from ..environment.sun import Sun, check_attitude, check_single, in_body, in_world, sun_position
from .geometry import TrackerGeometry, tracker_geometry
from .kinematics import Reason, angles_from_strokes, panel_angles, panel_normal, strokes
from .workspace import Limits, ReachableGrid, aim, nearest_reachable, reachable_grid, tracker_limits

_SCAN = 1441  # times of a day at which the sun's elevation is searched: a minute apart

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
class Pointing:
    """Pointing at the sun at n times.

    Attributes:
        start: first instant of the day, as a rule local midnight.
        unix: Unix times (n,) [s].
        weights: durations for which the times stand in integrals over the day (n,) [s].
        sun: apparent position of the sun.
        R_wb: attitude of the UAV (3, 3, n).
        s_b: direction to the sun in the UAV's axes (3, n).
        angles: panel angles (phi, theta) (2, n) [rad]; NaN at night.
        strokes: heights of the rods' lower joints (2, n) [m]; NaN at night.
        normals_w: the panel's unit normals in the world (3, n); NaN at night.
        reason: codes of `Reason` (n,), 0 where the panel faces the sun.
        sky: irradiances under a clear sky.
        irradiance: irradiance of each of `PANELS` (n,) [W/m^2].
    """

    start: datetime
    unix: Samples
    weights: Samples
    sun: Sun
    R_wb: Float[np.ndarray, "3 3 n"]
    s_b: Float[np.ndarray, "3 n"]
    angles: Float[np.ndarray, "2 n"]
    strokes: Float[np.ndarray, "2 n"]
    normals_w: Float[np.ndarray, "3 n"]
    reason: Int[np.ndarray, " n"]
    sky: ClearSky
    irradiance: dict[str, Samples]

    @property
    def hours(self) -> Samples:
        """Times since the start of the day (n,) [h]."""
        return (self.unix - self.start.timestamp()) / 3600.0

    @property
    def is_up(self) -> np.ndarray:
        """True where the sun is above the horizon (n,)."""
        return np.asarray(self.sun.is_up)

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
        # By the chord, small angles are exact: the arc cosine loses half of the digits near zero.
        chord = np.linalg.norm(self.normals_w - np.asarray(self.sun.s_w), axis=0)
        return 2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))

    def hours_of(self, mask: np.ndarray) -> float:
        """Total time for which a mask (n,) of these times holds [h]."""
        return float(np.sum(self.weights * mask)) / 3600.0


@dataclass(frozen=True)
class Day(Pointing):
    """Results of a day of pointing at the sun: a table at n times, and what holds of the whole day.

    The table has the times of the user's step. Results of the whole day (daylight, energies, times within
    reach, largest angles) come from `lit` and do not depend on that step.

    Attributes:
        place: place of the UAV.
        daylight: intervals (from, to) in which the sun is up, since the start of the day [h].
        culmination: time since the start of the day at which the sun stands highest [h].
        lit: the same pointing at times spread over the daylight alone.
        energy: the day's energy on each of `PANELS` [J/m^2].
        geometry, limits: lengths of the tracker, and limits of its workspace.
        parameters: parameter table from which both are taken.
        settings: remaining settings of the calculation, by name.
    """

    place: Place
    daylight: list[tuple[float, float]]
    culmination: float
    lit: Pointing
    energy: dict[str, float]
    geometry: TrackerGeometry
    limits: Limits
    parameters: Parameters
    settings: dict[str, Any]

    @property
    def displacements(self) -> Float[np.ndarray, "2 n"]:
        """Displacements of the slider joints from the initial posture (2, n) [m]."""
        return self.strokes - np.asarray(self.limits.home)[:, None]

    def gain(self, panel: str, over: str = "flat") -> float:
        """Relative excess of one panel's energy over another's [1]."""
        return self.energy[panel] / self.energy[over] - 1.0


def day_times(day: date, zone: tzinfo, step: float) -> tuple[datetime, Samples]:
    """First instant of a day, and Unix times [s] from it to the next day's, about `step` s apart.

    Raises:
        SettingError: a step outside 1 to 7200 s, or a day that the zone skipped.
    """
    if not (math.isfinite(step) and 1.0 <= step <= 7200.0):
        raise SettingError(f"The time step must lie within 1 and 7200 s, but it is {step} s.")
    start, begin, end = day_bounds(day, zone)
    return start, np.linspace(begin, end, 1 + math.ceil((end - begin) / step))


def attitude_history(attitude: Attitude, times: Samples) -> Float[np.ndarray, "3 3 n"]:
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


def _aim_panel(
    geometry: TrackerGeometry,
    limits: Limits,
    s_w: Float[Array, "3 n"],
    R_wb: Float[Array, "3 3 n"],
    flaws: Imperfections,
    up: np.ndarray,
    grid: ReachableGrid | None,
) -> tuple[Array, Array, Array, Array]:
    """Angles, strokes, normals and reasons as in `Day`, at any time: within reach where the sun is up."""
    s_b, angles, reason = _wish_angles(geometry, limits, s_w, R_wb, as_floats(flaws.attitude_error))
    outside_mask = up & (np.asarray(reason) != Reason.VALID)
    target_angles = np.array(angles)
    # Where the sun is out of reach, the panel stands as near to it as it can, and still collects.
    target_angles[:, outside_mask] = nearest_reachable(
        geometry, np.asarray(s_b)[:, outside_mask], limits, grid
    )
    angles = as_floats(target_angles)
    if flaws.stroke_step > 0:
        q = jnp.round(strokes(geometry, angles) / flaws.stroke_step) * flaws.stroke_step
        # The motors' steps round the strokes, and the panel's angles follow from those.
        angles = jax.jit(angles_from_strokes)(geometry, q, angles).angles
    q, normals = _hold_angles(geometry, angles, R_wb)
    return angles, q, normals, reason


@quick_jit
def _wish_angles(
    geometry: TrackerGeometry, limits: Limits, s_w: Array, R_wb: Array, error: Array
) -> tuple[Array, Array, Array]:
    """Directions to the sun in the axes of the assumed attitude, their panel angles and reasons."""
    # The controller aims in axes that it assumes, and the true ones carry the panel along: the
    # error of attitude becomes one of pointing.
    R_assumed = jnp.einsum("ijn,jk->ikn", R_wb, rotation_matrix(from_rotation_vector(error)))
    s_b = in_body(s_w, R_assumed)
    return s_b, panel_angles(s_b), aim(geometry, s_b, limits, throw=False).reason


@quick_jit
def _hold_angles(geometry: TrackerGeometry, angles: Array, R_wb: Array) -> tuple[Array, Array]:
    """Strokes that hold panel angles, and the panel's normals in the world."""
    return strokes(geometry, angles), in_world(panel_normal(angles), R_wb)


@quick_jit
def _sun_positions(times: Array, place: Place, air: Air) -> Sun:
    return sun_position(times, place, air=air)


def _find_daylight(
    begin: float, end: float, place: Place, air: Air
) -> tuple[list[tuple[float, float]], float, float]:
    """Intervals of Unix time [s] in which the sun is up, and the time and elevation of the highest.

    Elevations are searched every minute, with the vertex of a parabola at each of their extrema, so
    that a sun that rises for less than a minute is seen too, and the ends then within a minute.
    """

    def sun_heights(times: np.ndarray) -> np.ndarray:
        # always as many, so that all days and searches share one program
        sun = _sun_positions(np.resize(times, _SCAN), place, air)
        return np.asarray(sun.elevation)[: len(times)]

    times = np.linspace(begin, end, _SCAN)
    height = sun_heights(times)
    left_height, inner_height, right_height = height[:-2], height[1:-1], height[2:]
    # A short day of high latitudes can lie between two samples; vertices of parabolas find it.
    bend = left_height - 2.0 * inner_height + right_height
    turns = ((inner_height - left_height) * (right_height - inner_height) <= 0.0) & (bend != 0.0)
    shift = 0.5 * ((left_height - right_height)[turns] / bend[turns]) * (times[1] - times[0])
    vertices = times[1:-1][turns] + np.clip(shift, times[0] - times[1], times[1] - times[0])
    if 0 < len(vertices) <= _SCAN:
        times, height = np.append(times, vertices), np.append(height, sun_heights(vertices))
        order = np.argsort(times)
        times, height = times[order], height[order]
    edges = []
    for k in np.flatnonzero((height[1:] > 0) != (height[:-1] > 0)):
        # Sunrise is found by a second, finer scan, which needs no start and cannot fail.
        close = np.linspace(times[k], times[k + 1], _SCAN)
        low = sun_heights(close)
        m = int(np.argmax((low[1:] > 0) != (low[:-1] > 0)))
        edges.append(close[m] + low[m] / (low[m] - low[m + 1]) * (close[m + 1] - close[m]))
    edges = [begin] * bool(height[0] > 0) + edges + [end] * bool(height[-1] > 0)
    top = int(np.argmax(height))
    spans = [(float(a), float(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return spans, float(times[top]), float(height[top])


def _interval_middles(spans: list[tuple[float, float]], samples: int) -> tuple[Samples, Samples]:
    """Middles of equal parts of each interval (n,), and the parts' durations (n,) [s].

    Middles lie inside, where the sun is up: its light ends at the horizon with a jump.
    """
    parts = (np.arange(samples) + 0.5) / samples
    times = np.concatenate([a + (b - a) * parts for a, b in spans])
    return times, np.concatenate([np.full(samples, (b - a) / samples) for a, b in spans])


def _attitudes_between(
    attitude: Attitude, table: Float[np.ndarray, " m"], times: Samples
) -> Attitude:
    """Attitude at times from one at the table's times; rotation is steady between two of these."""
    if callable(attitude) or np.ndim(attitude) == 2:
        return attitude
    turns = Rotation.from_matrix(np.moveaxis(np.asarray(attitude, dtype=float), -1, 0))
    return np.moveaxis(Slerp(table, turns)(times).as_matrix(), 0, -1)


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
    day: Any,
    zone: Any = None,
    attitude: Attitude = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    *,
    step: float = 300.0,
    samples: int = 240,
    flaws: Imperfections | None = None,
    parameters: Parameters = PART_II,
    turbidity: float | None = None,
    albedo: float = 0.2,
    grid: ReachableGrid | None = None,
) -> Day:
    """Point the panel at the sun from local midnight to local midnight.

    Args:
        place: a single place of the UAV.
        day: day of the calendar there, a `datetime.date` or text such as 2024-03-21.
        zone: time zone of the place: a `tzinfo`, a name such as Asia/Phnom_Penh or an offset such as
            +07:00; by default whole hours by the longitude.
        attitude: R_wb of the UAV: constant (3, 3), a history (3, 3, n) at the times of
            `day_times`, or a function of the time since midnight [s] that gives (3, 3).
        step: time between samples of the table [s], made a little shorter to fit the day.
        samples: number of times in each interval of daylight for results of the whole day.
        flaws: imperfections of the actuators and of the known attitude; by default none.
        parameters: table with the tracker's lengths and strokes.
        turbidity: Linke's turbidity [1]; by default the month's mean there.
        albedo: reflectivity of the ground [1].
        grid: `reachable_grid` of the table's tracker; by default it is computed where the sun is
            out of reach.

    Raises:
        SettingError: an invalid date, zone, step, turbidity, albedo or flaw, a day that
            the zone skipped, or several places.
        StateError: a sun that does not rise that day, or an attitude that is no rotation.
        ModelError: a tracker that reaches no posture.
    """
    flaws = Imperfections() if flaws is None else flaws
    _check_flaws(flaws)
    check_single(place, "track_day")
    if samples < 1:
        raise SettingError(f"The samples of a day must be at least 1, but they are {samples}.")
    calendar_day = parse_date(day)
    clock_zone = day_zone(zone, math.degrees(float(place.longitude)))
    start, unix = day_times(calendar_day, clock_zone, step)
    air = Air.standard(place.altitude)
    spans, top, height = _find_daylight(unix[0], unix[-1], place, air)
    if not spans:
        raise StateError(
            f"The sun does not rise at {math.degrees(float(place.latitude)):.5g} degrees north on "
            f"{calendar_day.isoformat()}: at best it stands {-math.degrees(height):.3g} degrees below "
            "the horizon."
        )
    geometry, limits = tracker_geometry(parameters), tracker_limits(parameters)

    def point_panel(times: np.ndarray, weights: np.ndarray, attitude: Attitude) -> Pointing:
        sun = _sun_positions(times, place, air)
        up = np.asarray(sun.is_up)
        sky = clear_sky(times, place, sun, air, turbidity=turbidity)
        R_wb = attitude_history(attitude, times - unix[0])
        *aimed, reason = _aim_panel(geometry, limits, sun.s_w, as_jax(R_wb), flaws, up, grid)
        angles, q, normals = (np.where(up, np.asarray(part), np.nan) for part in aimed)
        faces = {
            # By night the tracker rests level, and its normal must be a number.
            "tracker": np.where(up, normals, level_normals(len(times))),
            "two_axis": np.asarray(sun.s_w),
            "single_axis": single_axis_normals(sun),
            "airframe": R_wb[:, 2],
            "flat": level_normals(len(times)),
        }
        return Pointing(
            start, times, weights, sun, R_wb, np.einsum("jin,jn->in", R_wb, np.asarray(sun.s_w)),
            angles, q, normals, np.where(up, reason, np.int8(Reason.BELOW_HORIZON)), sky,
            {name: panel_irradiance(faces[name], sun, sky, albedo=albedo) for name in PANELS},
        )  # fmt: skip

    hours_after = lambda time: float(time - unix[0]) / 3600.0
    step = float(unix[1] - unix[0])
    trapezoids = np.full(len(unix), step)
    # Weights of the trapezoidal rule at even times of the table.
    trapezoids[[0, -1]] /= 2.0
    table = point_panel(unix, trapezoids, attitude)
    # Energy is integrated over daylight alone: sunrise and sunset are kinks, where an even table would
    # lose accuracy.
    times, weights = _interval_middles(spans, samples)
    lit = point_panel(times, weights, _attitudes_between(attitude, unix, times))
    return Day(
        **vars(table), place=place,
        daylight=[(hours_after(a), hours_after(b)) for a, b in spans],
        culmination=hours_after(top), lit=lit,
        energy={name: float(weights @ lit.irradiance[name]) for name in PANELS},
        geometry=geometry, limits=limits, parameters=parameters,
        settings={
            "step": step,
            "samples": samples,
            "clear sky": "Ineichen-Perez",
            "turbidity": "pvlib's monthly means" if turbidity is None else turbidity,
            "albedo": albedo,
            "pressure": float(air.pressure),
            "temperature": float(air.temperature),
            "stroke step": flaws.stroke_step,
            "attitude error": np.asarray(flaws.attitude_error).tolist(),
        },
    )  # fmt: skip


# Spacings of the headings tried [degrees]: coarse ones, then fine ones beside the best of them.
_COARSE, _FINE = 45, 15
# Times of the daylight: enough to rank headings, but not for the day's figures. The table is not read.
_SAMPLES, _STEP = 48, 7200.0


def best_heading(
    place: Place,
    day: Any,
    zone: Any,
    turn: Callable[[float], Any],
    *,
    parameters: Parameters = PART_II,
    **settings: Any,
) -> float:
    """Yaw [rad], a multiple of 15 degrees, at which `track_day` collects the most energy.

    Args:
        turn: function of a yaw [rad] that returns the attitude R_wb (3, 3).
        parameters: table with the tracker's lengths and strokes.
        settings: other keyword arguments of `track_day`, such as the turbidity.

    Raises:
        StateError, SettingError, ModelError: see `track_day`.
    """
    grid = reachable_grid(tracker_geometry(parameters), tracker_limits(parameters))
    options: Any = dict(parameters=parameters, step=_STEP, samples=_SAMPLES, grid=grid) | settings
    of_day = lambda degrees: track_day(place, day, zone, turn(math.radians(degrees)), **options)
    energies: dict[int, float] = {}

    def find_best(*headings: int) -> int:
        energies.update({degrees: of_day(degrees).energy["tracker"] for degrees in headings})
        return max(energies, key=lambda degrees: energies[degrees])

    # The energy is taken to be smooth over the heading: finer headings are tried beside the best coarse
    # one only.
    coarse = find_best(*range(-180 + _COARSE, 181, _COARSE))
    return math.radians(find_best(coarse - _FINE, coarse + _FINE))
