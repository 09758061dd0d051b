"""Direction of the sun for a tracker on a UAV: sensed on board, or from place and time.

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
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..checks.errors import StateError, check_finite, concrete
from ..checks.numbers import array_module, floats
from ..checks.reason import AbstractReason, first_reason
from ..checks.shapes import Numbers
from .ephemeris import Air, Place, azimuth, elevation, sun_direction, unix_time

_DELTA_T = 69.2  # terrestrial time less UT, 2020 to 2026 [s]; a second is 1e-5 degrees
_ROTATION = 1e-6  # largest permitted entry of R^T R - I


class SunReason(AbstractReason):
    """Reason for which a direction to the sun is of no use; the first that applies."""

    VALID = 0
    NOT_FINITE = 1
    ZERO_LENGTH = 2
    BELOW_HORIZON = 3
    LATITUDE = 4


class Sun(NamedTuple):
    """Position of the sun, for one time and place or for arrays of them.

    Attributes:
        s_w: unit vector towards the sun in axes east, north, up (3, ...).
        elevation: angle above the horizon (...) [rad].
        azimuth: angle clockwise from north, from 0 to 2 pi (...) [rad].
        reason: codes of `SunReason` (...); the direction is given below the horizon too.
    """

    s_w: Float[Array, "3 *s"]
    elevation: Float[Array, "*s"]
    azimuth: Float[Array, "*s"]
    reason: Int[Array, "*s"]

    @property
    def is_up(self) -> Bool[Array, "*s"]:
        """True where the sun's centre is above the horizon."""
        return self.reason == SunReason.VALID


class SensedDirection(NamedTuple):
    """Unit vectors of sensed directions (3, ...), NaN where there is none, and reason codes."""

    s_b: Float[Array, "3 *s"]
    reason: Int[Array, "*s"]


def _sun(s_w: Float[Array, "3 *s"], latitude: Float[Array, "*#s"]) -> Sun:
    height = elevation(s_w)
    reason = first_reason(
        (~jnp.all(jnp.isfinite(s_w), axis=0), SunReason.NOT_FINITE),
        # an excess of one rounding error is allowed, for 90 degrees converted to radians
        (jnp.abs(latitude) > jnp.pi / 2 + 1e-7, SunReason.LATITUDE),
        (~(height > 0.0), SunReason.BELOW_HORIZON),
    )
    return Sun(s_w, height, azimuth(s_w), reason)


def sun_position(unix: Numbers, place: Place, *, air: Air | None = None) -> Sun:
    """Position of the sun at Unix times (...) [s] over places of shapes that broadcast.

    The error is within 0.0024 degrees of NREL's SPA over 2020 to 2050. With `air` the direction is
    the apparent one, through refracting air; by default it is the true one.

    Raises:
        SettingError: JAX is in single precision.
    """
    return _sun(sun_direction(unix, place, air=air), place.latitude)


def sun_position_spa(unix: Numbers, place: Place, *, air: Air | None = None) -> Sun:
    """Position of the sun by pvlib's implementation of NREL's SPA (0.0003 degrees); not traceable.

    Args:
        unix: Unix times [s], a number or an array with one axis.
        place: a single place.
        air: a single state of the air, as in `sun_position`.
    """
    import pandas as pd
    import pvlib

    times = np.asarray(unix, dtype=float)
    index = pd.to_datetime(np.atleast_1d(times), unit="s", utc=True)
    some = Air() if air is None else air
    table = pvlib.solarposition.spa_python(
        pd.DatetimeIndex(index),
        math.degrees(float(place.latitude)),
        math.degrees(float(place.longitude)),
        altitude=float(place.altitude),
        pressure=float(some.pressure),
        temperature=float(some.temperature) - 273.15,
        delta_t=_DELTA_T,
    )
    height = np.radians(table["elevation" if air is None else "apparent_elevation"].to_numpy())
    around = np.radians(table["azimuth"].to_numpy())
    level = np.cos(height)
    s_w = np.stack([level * np.sin(around), level * np.cos(around), np.sin(height)])
    return _sun(jnp.asarray(s_w.reshape(3, *times.shape)), place.latitude)


def sun_at(when: datetime, place: Place, *, air: Air | None = None, night: bool = False) -> Sun:
    """Position of the sun at one time over one place.

    Args:
        when: a datetime with a time zone.
        air: air that refracts the light; by default there is none.
        night: accept a sun below the horizon.

    Raises:
        SettingError: a datetime without a time zone; JAX is in single precision.
        StateError: the sun is below the horizon.
    """
    sun = sun_position(unix_time(when), place, air=air)
    if concrete(sun) and not night and not bool(sun.is_up):
        utc = when.astimezone(UTC).isoformat(sep=" ", timespec="seconds")
        raise StateError(
            f"The sun is {-math.degrees(float(sun.elevation)):.3g} degrees below the horizon at "
            f"{math.degrees(float(place.latitude)):.5g} degrees north, "
            f"{math.degrees(float(place.longitude)):.5g} east on {utc}: there is nothing to point "
            "at. Is the time zone right? night=True gives its direction all the same."
        )
    return sun


def sun_in_body(
    when: datetime, place: Place, R_wb: Numbers, *, air: Air | None = None
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
    if concrete(direction) and not np.any(np.asarray(direction)):
        raise StateError("The sun's direction has no length: the sensor sees no sun.")
    return sensed_direction(direction).s_b


def sensed_direction(s_b: Float[Array | np.ndarray, "3 *s"]) -> SensedDirection:
    """Scenario 1 for arrays: unit vectors of directions (3, ...) of any length, with reasons."""
    s_b = jnp.asarray(s_b)
    finite = jnp.all(jnp.isfinite(s_b), axis=0)
    # divided by the largest component first, so that no square overflows or underflows
    largest = jnp.max(jnp.abs(s_b), axis=0)
    valid = finite & (largest > 0.0)
    scaled = jnp.where(valid, s_b / jnp.where(valid, largest, 1.0), 1.0)
    unit = scaled / jnp.sqrt(jnp.sum(scaled**2, axis=0))
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
    return floats(xp.stack([xp.stack(flat[3 * k : 3 * k + 3]) for k in range(3)]))


def check_attitude(R_wb: Numbers) -> None:
    """Raise `StateError` unless every R_wb (3, 3, ...) is a rotation within 1e-6."""
    if not concrete(R_wb):
        return
    R = np.asarray(R_wb)
    if R.shape[:2] != (3, 3):
        raise StateError(f"R_wb must have shape (3, 3, ...), but it has {R.shape}.")
    check_finite(R, "R_wb", "", StateError)
    flat = np.moveaxis(R.reshape(3, 3, -1), -1, 0)
    error = np.abs(np.swapaxes(flat, 1, 2) @ flat - np.eye(3)).max(axis=(1, 2))
    mirrored = np.linalg.det(flat) < 0
    worst = int(np.argmax(error + mirrored))
    if error[worst] > _ROTATION or mirrored[worst]:
        raise StateError(
            f"R_wb must be a rotation (body to world), but at sample {worst} its columns are off "
            f"unit and right angles by {error[worst]:.2g}"
            + (" and it mirrors." if mirrored[worst] else ".")
        )
