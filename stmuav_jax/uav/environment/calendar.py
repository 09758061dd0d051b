"""Days, time zones and Unix times of the sun's calculations, read from what a user writes.

Unix time is seconds of UTC since 1970-01-01, leap seconds not counted. A day is that of a place's
calendar, from its first instant to the next day's: it has 23 or 25 hours where clocks change, and
does not exist where its zone skipped it.
"""

import math
import re
from collections.abc import Iterable
from datetime import UTC, date, datetime, time, timedelta, timezone, tzinfo
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

import numpy as np
from jaxtyping import Float

from ...checks.errors import SettingError, closest_name

# Years in which the series for the sun is within 0.005 degrees of the SPA (docs/sun.md).
YEARS = (1950, 2110)

_DAY = timedelta(days=1)
_ZONE_HINT = (
    "Give one, for instance datetime(..., tzinfo=ZoneInfo('Asia/Phnom_Penh')) or tzinfo=UTC."
)


def parse_date(day: Any) -> date:
    """Day of the calendar from a date, from text such as 2024-03-21, or from numpy.datetime64.

    Raises:
        SettingError: another type or form of text, a day that does not exist, a time of day, or a
            year outside `YEARS`.
    """
    value = day.astype("datetime64[us]").item() if isinstance(day, np.datetime64) else day
    if isinstance(value, str):
        if not re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}", value):
            raise SettingError(f"The date must be like 2024-03-21, not '{value[:40]}'.")
        try:
            value = date.fromisoformat(value)
        except ValueError:
            raise SettingError(f"There is no day {value} in the calendar.") from None
    elif isinstance(value, datetime):
        # its clock time and zone would be dropped, and with them perhaps the day that was meant
        if value.tzinfo is not None or value.time() != time():
            raise SettingError(
                f"The date must be a day without a time, such as datetime.date(2024, 3, 21), not "
                f"{value.isoformat(sep=' ')}: give the day of the place's calendar, for instance "
                "its .date()."
            )
        value = value.date()
    elif not isinstance(value, date):
        raise SettingError(
            f"The date must be a datetime.date or text like 2024-03-21, not {day!r} "
            f"({type(day).__name__})."
        )
    check_year(value)
    return value


def check_year(day: date) -> None:
    """Raise SettingError outside the years in which the sun's position is accurate enough."""
    if not YEARS[0] <= day.year <= YEARS[1]:
        raise SettingError(
            f"The sun's position is known for the years {YEARS[0]} to {YEARS[1]}, not for "
            f"{day.isoformat()}."
        )


def wrap_longitude(degrees: float) -> float:
    """Longitude from -180 to less than 180 degrees, as tables by longitude are indexed."""
    return (degrees + 180.0) % 360.0 - 180.0


def day_zone(zone: Any, longitude: float) -> tzinfo:
    """Time zone from its name, from an offset such as +07:00, or from the longitude [degrees].

    A zone that is one already is returned as it is. The longitude is used where none is given
    (None), and rounded to a whole hour.

    Raises:
        SettingError: a name that is not known, or another type.
    """
    if isinstance(zone, tzinfo):
        return zone
    if zone is None:
        hours = round(wrap_longitude(longitude) / 15.0) if math.isfinite(longitude) else 0
        return timezone(timedelta(hours=hours))
    if not isinstance(zone, str):
        raise SettingError(
            "The time zone must be a name like Asia/Phnom_Penh, an offset like +07:00, or a "
            f"datetime.tzinfo, not {zone!r} ({type(zone).__name__})."
        )
    if match := re.fullmatch(r"([+-])(\d\d):?(\d\d)", zone):
        sign = -1 if match[1] == "-" else 1
        offset = timedelta(hours=int(match[2]), minutes=int(match[3]))
        if offset < timedelta(hours=24):
            return timezone(sign * offset)
    try:
        return ZoneInfo(zone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        hint = closest_name(zone, available_timezones())
        raise SettingError(
            f"There is no time zone '{zone}'.{hint} Give a name like Asia/Phnom_Penh or an offset "
            "like +07:00."
        ) from None


def day_bounds(day: date, zone: tzinfo) -> tuple[datetime, float, float]:
    """First instant of a day of a zone's calendar, as a local time, and Unix times of both ends [s].

    Raises:
        SettingError: a day that the zone skipped.
    """
    # a midnight that clocks skip is, by its offset before the change, the instant of the change
    begin, end = (datetime.combine(d, time(), zone).timestamp() for d in (day, day + _DAY))
    if end <= begin:
        raise SettingError(
            f"There was no {day.isoformat()} in {zone}: its calendar skipped that day. Give another "
            "date, or an offset such as +13:00 as the time zone."
        )
    return datetime.fromtimestamp(begin, zone), begin, end


def local_time(day: date, hours: float, zone: tzinfo) -> datetime:
    """Time at which a clock of the zone shows some hours after midnight.

    Raises:
        SettingError: a time that the zone's clocks skip that day, or show twice.
    """
    day_bounds(day, zone)
    when = datetime.combine(day, time(), zone) + timedelta(hours=hours)
    check_exists(when)
    first, second = (when.replace(fold=k).isoformat(timespec="seconds")[19:] for k in (0, 1))
    if first != second:
        raise SettingError(
            f"The time {when:%Y-%m-%d %H:%M:%S} happens twice in {zone}, where clocks are put back: "
            f"give the time zone as an offset, {first} for the first or {second} for the second."
        )
    return when


def check_exists(when: datetime) -> None:
    """Raise SettingError for a local time that the clocks of its zone skip."""
    clock = when.astimezone(UTC).astimezone(when.tzinfo)
    if clock.replace(tzinfo=None) != when.replace(tzinfo=None):
        raise SettingError(
            f"There is no time {when:%Y-%m-%d %H:%M:%S} in {when.tzinfo}: its clocks skip it and show "
            f"{clock:%Y-%m-%d %H:%M:%S} instead. Give a time that they show, or one in UTC."
        )


def unix_time(when: Any) -> Float[np.ndarray, "*s"]:
    """Unix time [s] of one datetime, or of several; each must have a time zone.

    Args:
        when: a datetime, text in ISO 8601 such as 2024-03-21T05:00+07:00, or an iterable of them.
            Of a time that clocks show twice, `fold` selects one, by default the first.

    Raises:
        SettingError: another type, or a time without a time zone or that its zone's clocks skip.
    """
    if isinstance(when, str):
        try:
            return unix_time(datetime.fromisoformat(when))
        except ValueError as error:
            if isinstance(error, SettingError):
                raise
            raise SettingError(
                f"The time must be like 2024-03-21T05:00+07:00, not '{when[:40]}'."
            ) from None
    if isinstance(when, datetime):
        if when.utcoffset() is None:
            raise SettingError(
                f"The time {when.isoformat(sep=' ')} has no time zone, so that it could be any of 24 "
                f"hours. {_ZONE_HINT}"
            )
        check_exists(when)
        return np.asarray((when - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds())
    if isinstance(when, np.datetime64):
        raise SettingError(
            f"The time {when} has no time zone: numpy.datetime64 has none. {_ZONE_HINT}"
        )
    if not isinstance(when, Iterable) or np.ndim(when) == 0:  # pyright: ignore[reportArgumentType]
        raise SettingError(
            f"A time must be a datetime with a time zone, not {when!r} ({type(when).__name__}). "
            "Unix times [s] are what sun_position and sun_direction take."
        )
    return np.array([float(unix_time(instant)) for instant in when])
