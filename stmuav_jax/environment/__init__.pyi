"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .ephemeris import (
    Air as Air,
    Place as Place,
    sun_direction as sun_direction,
    unix_time as unix_time,
)
from .sun import (
    SensedDirection as SensedDirection,
    Sun as Sun,
    SunReason as SunReason,
    attitude as attitude,
    in_body as in_body,
    sensed_direction as sensed_direction,
    sensed_sun as sensed_sun,
    sun_at as sun_at,
    sun_in_body as sun_in_body,
    sun_position as sun_position,
    sun_position_spa as sun_position_spa,
)
from .wind import (
    Gusts as Gusts,
    Turbulence as Turbulence,
    dryden as dryden,
    low_altitude as low_altitude,
)
