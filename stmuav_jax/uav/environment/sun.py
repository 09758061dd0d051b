"""Direction to the sun for a tracker on a UAV: from place and time by series or SPA, or sensed on board.

Scenario 1: a sensor on the UAV measures the direction in body axes, `s_b`. Scenario 2: position
and time give the direction in the world (x east, y north, z up), and the known attitude turns it:

    s_b = R_wb^T s_w

Functions named after one sun (`sun_at`, `sun_in_body`, `sensed_sun`) raise errors that say what
is wrong; those for arrays (`sun_position`, `sensed_direction`) give a `SunReason` with each
direction and never raise for values. Components come first and the axes of a stack last: s_w,
s_b (3, ...), R_wb (3, 3, ...).

Source: report Part II, section 3.2 and Eq. 3.21. Only its left side is needed here; the report
goes on to solve it for the direction that is known.
"""

import math
from datetime import UTC, datetime
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...checks.errors import (
    AbstractReason,
    SettingError,
    StateError,
    check_finite,
    first_reason,
    has_values,
)
from ...checks.numbers import array_module, as_floats
from ...checks.shapes import Numbers
from .calendar import YEARS, check_year, unix_time, wrap_longitude
from .ephemeris import ROUNDING, Air, Place, sun_azimuth, sun_direction, sun_elevation

_YEARS = tuple(datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in (YEARS[0], YEARS[1] + 1))
# Years whose times pandas, in nanoseconds, can hold.
_SPA_YEARS = (1678, 2262)
_ROTATION = 1e-6  # largest permitted entry of R^T R - I


class SunReason(AbstractReason):
    """Reason for which a direction to the sun is of no use; the first that applies."""

    VALID = 0
    NOT_FINITE = 1
    ZERO_LENGTH = 2
    BELOW_HORIZON = 3
    LATITUDE = 4
    YEAR = 5


class Sun(NamedTuple):
    """Position of the sun, for one time and place or for arrays of them.

    Attributes:
        s_w: unit vector towards the sun in axes east, north, up (3, ...).
        elevation: angle above the horizon (...) [rad].
        azimuth: angle clockwise from north, from 0 to 2 pi (...) [rad].
        reason: codes of `SunReason` (...); the direction is given below the horizon too, and for a
            sun that is up outside of the years 1950 to 2110 (YEAR), less exactly.
    """

    s_w: Float[Array, "3 *s"]
    elevation: Float[Array, "*s"]
    azimuth: Float[Array, "*s"]
    reason: Int[Array, "*s"]

    @property
    def is_up(self) -> Bool[Array, "*s"]:
        """True where the sun's centre is above the horizon."""
        return (self.reason == SunReason.VALID) | (self.reason == SunReason.YEAR)


class SensedDirection(NamedTuple):
    """Unit vectors of sensed directions (3, ...), NaN where there is none, and reason codes."""

    s_b: Float[Array, "3 *s"]
    reason: Int[Array, "*s"]


def _make_sun(
    s_w: Float[Array, "3 *s"], latitude: Float[Array, "*#s"], is_year_known: Bool[Array, "*#s"]
) -> Sun:
    height = sun_elevation(s_w)
    reason = first_reason(
        (~jnp.all(jnp.isfinite(s_w), axis=0), SunReason.NOT_FINITE),
        (jnp.abs(latitude) > jnp.pi / 2 + ROUNDING, SunReason.LATITUDE),
        (~(height > 0.0), SunReason.BELOW_HORIZON),
        (~is_year_known, SunReason.YEAR),
    )
    return Sun(s_w, height, sun_azimuth(s_w), reason)


def sun_position(unix: Numbers, place: Place, *, air: Air | None = None) -> Sun:
    """Position of the sun at Unix times (...) [s] over places of shapes that broadcast.

    The error is within 0.0024 degrees of NREL's SPA over 2020 to 2050, 0.005 over 1950 to 2110 and
    0.015 over 1800 to 2200 (`SunReason.YEAR`); farther away it grows. With `air` the direction is
    the apparent one, through refracting air; by default it is the true one.

    Raises:
        SettingError: JAX is in single precision.
    """
    s_w = sun_direction(unix, place, air=air)
    t = jnp.asarray(unix, dtype=float)
    return _make_sun(s_w, place.latitude, (t >= _YEARS[0]) & (t < _YEARS[1]))


def sun_position_spa(unix: Numbers, place: Place, *, air: Air | None = None) -> Sun:
    """Position of the sun by pvlib's implementation of NREL's SPA; not traceable.

    The SPA's own error is 0.0003 degrees where TT - UT is known. Here TT - UT is pvlib's for the
    year and month, of which a second is 1e-5 degrees: known to a second since about 1900 and
    extrapolated in the future.

    Args:
        unix: Unix times [s], a number or an array with one axis, in the years 1678 to 2261.
        place: a single place.
        air: a single state of the air, as in `sun_position`.

    Raises:
        SettingError: an array of places or of air, times of more axes, or outside of those years.
    """
    import pandas as pd
    import pvlib

    times = np.asarray(unix, dtype=float)
    sky_air = Air() if air is None else air
    check_single(place, "sun_position_spa", sky_air)
    if times.ndim > 1:
        raise SettingError(
            f"The times of sun_position_spa must have one axis, but their shape is {times.shape}."
        )
    check_finite(times, "The Unix times", "s", SettingError)
    first_time, end_time = (datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in _SPA_YEARS)
    outside_mask = (times < first_time) | (times >= end_time)
    if np.any(outside_mask):
        raise SettingError(
            f"The Unix times must lie in the years {_SPA_YEARS[0]} to {_SPA_YEARS[1] - 1}, but one is "
            f"{times[outside_mask].flat[0]:g} s. Are they seconds?"
        )
    index = pd.DatetimeIndex(pd.to_datetime(np.atleast_1d(times), unit="s", utc=True))
    # The short series of `ephemeris` is the one in use; the SPA of NREL is an independent reference of a
    # higher accuracy.
    table = pvlib.solarposition.spa_python(
        index,
        math.degrees(float(place.latitude)),
        wrap_longitude(math.degrees(float(place.longitude))),
        altitude=float(place.altitude),
        pressure=float(sky_air.pressure),
        temperature=float(sky_air.temperature) - 273.15,
        delta_t=pvlib.spa.calculate_deltat(index.year, index.month),  # pyright: ignore[reportArgumentType]
    )
    height = np.radians(table["elevation" if air is None else "apparent_elevation"].to_numpy())
    sun_azimuth = np.radians(table["azimuth"].to_numpy())
    level = np.cos(height)
    s_w = np.stack([level * np.sin(sun_azimuth), level * np.cos(sun_azimuth), np.sin(height)])
    return _make_sun(jnp.asarray(s_w.reshape(3, *times.shape)), place.latitude, jnp.asarray(True))


def check_single(place: Place, function: str, air: Air | None = None) -> None:
    """Raise `SettingError` for an array of places, or of states of the air."""
    shape = jnp.broadcast_shapes(
        *(part.shape for part in (place.latitude, place.longitude, place.altitude))
    )
    if shape:
        raise SettingError(
            f"The place of {function} must be a single one, but it is an array of shape {shape}. "
            "sun_position takes arrays of places."
        )
    if air is not None and (
        shape := jnp.broadcast_shapes(air.pressure.shape, air.temperature.shape)
    ):
        raise SettingError(
            f"The air of {function} must be a single state, but it is an array of shape {shape}."
        )


def sun_at(when: Any, place: Place, *, air: Air | None = None, night: bool = False) -> Sun:
    """Position of the sun at one time over one place.

    Args:
        when: a datetime with a time zone, or text such as 2024-03-21T09:00+07:00, in the years 1950
            to 2110. Of a time that clocks show twice, `fold` of the datetime selects one.
        air: air that refracts the light; by default there is none.
        night: accept a sun below the horizon.

    Raises:
        SettingError: a time without a time zone, that the zone's clocks skip, or outside those
            years; several times or places; JAX is in single precision.
        StateError: the sun is below the horizon.
    """
    unix = unix_time(when)
    if unix.shape:
        raise SettingError(
            f"The time of sun_at must be a single one, but its shape is {unix.shape}. sun_position "
            "takes arrays of Unix times (unix_time)."
        )
    check_single(place, "sun_at", air)
    utc = datetime.fromtimestamp(float(unix), UTC)
    check_year(utc.date())
    sun = sun_position(unix, place, air=air)
    # Under a transformation of JAX nothing can be raised; the reason code says the same there.
    if has_values(sun) and not night and not bool(sun.is_up):
        raise StateError(
            f"The sun is {-math.degrees(float(sun.elevation)):.3g} degrees below the horizon at "
            f"{math.degrees(float(place.latitude)):.5g} degrees north, "
            f"{math.degrees(float(place.longitude)):.5g} east on "
            f"{utc.isoformat(sep=' ', timespec='seconds')}: there is nothing to point "
            "at. Is the time zone right? night=True gives its direction all the same."
        )
    return sun


def sun_in_body(
    when: Any, place: Place, R_wb: Numbers, *, air: Air | None = None
) -> Float[Array, "3"]:
    """Scenario 2: unit vector to the sun in body axes (3,), for one time, place and attitude.

    Raises:
        SettingError, StateError: as for `sun_at`.
        StateError: an attitude that is not a rotation.
    """
    R = jnp.asarray(R_wb, dtype=float)
    check_attitude(R)
    return in_body(sun_at(when, place, air=air).s_w, R)


def sensed_sun(s_b: Numbers) -> Float[Array, "3"]:
    """Scenario 1: unit vector (3,) of a direction measured by a sensor on the UAV.

    Raises:
        StateError: a direction that is not three finite numbers, or of zero length.
    """
    direction = jnp.asarray(s_b, dtype=float)
    if direction.shape != (3,):
        raise StateError(f"The sun's direction must be three numbers, not {direction.shape}.")
    check_finite(direction, "The sun's direction", "", StateError)
    if has_values(direction) and not np.any(np.asarray(direction)):
        raise StateError("The sun's direction has zero length: the sensor does not detect the sun.")
    return sensed_direction(direction).s_b


def sensed_direction(s_b: Float[Array | np.ndarray, "3 *s"]) -> SensedDirection:
    """Scenario 1 for arrays: unit vectors of directions (3, ...) of any length, with reasons."""
    s_b = jnp.asarray(s_b)
    finite = jnp.all(jnp.isfinite(s_b), axis=0)
    # divided by the largest component first, so that no square overflows or underflows
    largest = jnp.max(jnp.abs(s_b), axis=0)
    valid = finite & (largest > 0.0)
    scaled_direction = jnp.where(valid, s_b / jnp.where(valid, largest, 1.0), 1.0)
    unit = scaled_direction / jnp.sqrt(jnp.sum(scaled_direction**2, axis=0))
    reason = first_reason((~finite, SunReason.NOT_FINITE), (~valid, SunReason.ZERO_LENGTH))
    return SensedDirection(jnp.where(valid, unit, jnp.nan), reason)


def in_body(
    s_w: Float[Array | np.ndarray, "3 *#s"], R_wb: Float[Array | np.ndarray, "3 3 *#s"]
) -> Float[Array, "3 *s"]:
    """Rotate world components to body components, s_b = R_wb^T s_w (3, ...)."""
    return jnp.stack([sum(R_wb[k, i] * s_w[k] for k in range(3)) for i in range(3)])


def in_world(
    s_b: Float[Array | np.ndarray, "3 *#s"], R_wb: Float[Array | np.ndarray, "3 3 *#s"]
) -> Float[Array, "3 *s"]:
    """Rotate body components to world components, s_w = R_wb s_b (3, ...)."""
    return jnp.stack([sum(R_wb[i, k] * s_b[k] for k in range(3)) for i in range(3)])


def attitude(
    roll: Numbers = 0.0, pitch: Numbers = 0.0, yaw: Numbers = 0.0
) -> Float[Array, "3 3 *s"]:
    """Rotation matrix R_wb = R_z(yaw) R_y(pitch) R_x(roll), shape (3, 3, ...).

    All angles [rad] are right-handed about body axes; the world is x east, y north, z up, so
    that yaw turns the body's x axis from east towards north, and a positive pitch lowers it.
    """
    xp = array_module(roll, pitch, yaw)
    angles = [xp.asarray(angle, dtype=float) for angle in (roll, pitch, yaw)]
    (sr, cr), (sp, cp), (sy, cy) = [(xp.sin(angle), xp.cos(angle)) for angle in angles]
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    flat = xp.broadcast_arrays(*(entry for row in rows for entry in row))
    return as_floats(xp.stack([xp.stack(flat[3 * k : 3 * k + 3]) for k in range(3)]))


def check_attitude(R_wb: Numbers) -> None:
    """Raise `StateError` unless every R_wb (3, 3, ...) is a rotation within 1e-6."""
    if not has_values(R_wb):
        return
    R = np.asarray(R_wb)
    if R.shape[:2] != (3, 3):
        raise StateError(f"R_wb must have shape (3, 3, ...), but it has {R.shape}.")
    check_finite(R, "R_wb", "", StateError)
    flat = np.moveaxis(R.reshape(3, 3, -1), -1, 0)
    # An orthogonal matrix may still be a reflection, which only the determinant tells.
    error = np.abs(np.swapaxes(flat, 1, 2) @ flat - np.eye(3)).max(axis=(1, 2))
    mirrored = np.linalg.det(flat) < 0
    worst = int(np.argmax(error + mirrored))
    if error[worst] > _ROTATION or mirrored[worst]:
        raise StateError(
            f"R_wb must be a rotation (body to world), but at sample {worst} its columns "
            f"deviate from unit length and right angles by {error[worst]:.2g}"
            + (", and it is a reflection." if mirrored[worst] else ".")
        )
