"""Irradiance under a clear sky on panels of any orientation, by pvlib; not traceable.

The clear sky is the model of Ineichen and Perez with Linke's turbidity, by default from pvlib's
table of monthly means. A panel receives the beam times the cosine of incidence, diffuse light of
the sky by Hay and Davies' model (part of it comes from around the sun), and light reflected by
uniform ground.

Source: P. Ineichen, R. Perez, Solar Energy 73 (2002) 151; J. E. Hay, J. A. Davies (1980);
both as implemented in pvlib.
"""

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...checks.errors import SettingError
from .calendar import wrap_longitude
from .ephemeris import Air, Place
from .sun import Sun

Samples = Float[np.ndarray, " n"]
Normals = Float[np.ndarray, "3 n"]


class ClearSky(NamedTuple):
    """Irradiances under a clear sky at n times (n,) [W/m^2], and the turbidity.

    Attributes:
        beam: beam irradiance of a plane that faces the sun (DNI).
        diffuse: diffuse irradiance of a horizontal plane (DHI).
        global_horizontal: total irradiance of a horizontal plane (GHI).
        extraterrestrial: beam irradiance outside the atmosphere.
        turbidity: Linke's turbidity (n,) [1].
    """

    beam: Samples
    diffuse: Samples
    global_horizontal: Samples
    extraterrestrial: Samples
    turbidity: Samples


def _sun_angles(sun: Sun) -> tuple[Samples, Samples]:
    """Zenith angle and azimuth of the sun [degrees]."""
    return 90.0 - np.degrees(np.asarray(sun.elevation)), np.degrees(np.asarray(sun.azimuth))


def clear_sky(
    unix: Samples, place: Place, sun: Sun, air: Air, *, turbidity: float | None = None
) -> ClearSky:
    """Clear-sky irradiances at one place and Unix times (n,) [s], the sun seen through `air`.

    Args:
        turbidity: Linke's turbidity [1]; by default pvlib's monthly mean for the place.

    Raises:
        SettingError: a turbidity below 1, the value of clean dry air, or that is not finite.
    """
    import pandas as pd
    import pvlib

    if turbidity is not None and not (math.isfinite(turbidity) and turbidity >= 1.0):
        raise SettingError(
            f"Linke's turbidity must be at least 1 (clean, dry air) and finite, but it is {turbidity}."
        )
    times = pd.DatetimeIndex(pd.to_datetime(unix, unit="s", utc=True))
    zenith, _ = _sun_angles(sun)
    with warnings.catch_warnings():
        # pvlib 0.16 uses names of pandas 2 that are deprecated in pandas 3
        warnings.simplefilter("ignore", DeprecationWarning)
        outside = np.asarray(pvlib.irradiance.get_extra_radiation(times), dtype=float)
        if turbidity is None:
            # the table ends at the poles and at -180 and 180 degrees, where a place's numbers need
            # not: a latitude may exceed 90 degrees by a rounding error
            latitude = min(max(math.degrees(float(place.latitude)), -90.0), 90.0)
            longitude = wrap_longitude(math.degrees(float(place.longitude)))
            linke = pvlib.clearsky.lookup_linke_turbidity(times, latitude, longitude).to_numpy()
        else:
            linke = np.full(len(unix), float(turbidity))
    up = np.asarray(sun.is_up)
    # The air mass has no meaning with the sun below the horizon; only times of daylight are evaluated.
    mass = pvlib.atmosphere.get_relative_airmass(zenith[up])
    absolute = pvlib.atmosphere.get_absolute_airmass(mass, float(air.pressure))
    ineichen: Any = pvlib.clearsky.ineichen  # without types
    sky = ineichen(
        zenith[up], absolute, linke[up], altitude=float(place.altitude), dni_extra=outside[up]
    )
    beam, diffuse, level = np.zeros((3, len(unix)))
    beam[up], diffuse[up], level[up] = (np.asarray(sky[k]) for k in ("dni", "dhi", "ghi"))
    return ClearSky(beam, diffuse, level, outside, linke)


def panel_irradiance(
    normals_w: Normals, sun: Sun, sky: ClearSky, *, albedo: float = 0.2
) -> Samples:
    """Total irradiance of the front of a panel with unit normals (3, n), world (n,) [W/m^2].

    Args:
        albedo: reflectivity of the ground, from 0 to 1 [1].

    Raises:
        SettingError: an albedo outside 0 to 1.
    """
    import pvlib

    if not 0.0 <= albedo <= 1.0:
        raise SettingError(f"The ground's albedo must lie within 0 and 1, but it is {albedo}.")
    tilt = np.degrees(np.arctan2(np.hypot(normals_w[0], normals_w[1]), normals_w[2]))
    panel_azimuth = np.degrees(np.arctan2(normals_w[0], normals_w[1])) % 360.0
    up = np.asarray(sun.is_up)
    # Sky light is brighter around the sun, which favours a panel that faces it; an isotropic sky would
    # hide that.
    total = pvlib.irradiance.get_total_irradiance(
        tilt, panel_azimuth, *_sun_angles(sun), sky.beam, sky.global_horizontal, sky.diffuse,
        dni_extra=sky.extraterrestrial, albedo=albedo, model="haydavies",
    )  # fmt: skip
    return np.where(up, np.asarray(total["poa_global"]), 0.0)


def single_axis_normals(sun: Sun, *, limit: float = math.radians(60.0)) -> Normals:
    """Unit normals (3, n) of a tracker that rotates about one horizontal axis, north to south.

    The panel faces the sun as nearly as it can, without backtracking, and is level at night.

    Args:
        limit: largest rotation from level [rad].

    Source: pvlib.tracking.singleaxis.
    """
    import pvlib

    singleaxis: Any = pvlib.tracking.singleaxis  # without types
    # Backtracking avoids shade from neighbouring rows, and there are none here.
    with np.errstate(invalid="ignore"):
        orientation = singleaxis(
            *_sun_angles(sun), axis_tilt=0.0, axis_azimuth=180.0, max_angle=math.degrees(limit),
            backtrack=False,
        )  # fmt: skip
    tilt = np.radians(np.nan_to_num(np.asarray(orientation["surface_tilt"])))
    panel_azimuth = np.radians(np.nan_to_num(np.asarray(orientation["surface_azimuth"])))
    east, north = np.sin(panel_azimuth), np.cos(panel_azimuth)
    return np.stack([np.sin(tilt) * east, np.sin(tilt) * north, np.cos(tilt)])


def level_normals(n: int) -> Normals:
    """Unit normals (3, n) of a horizontal panel."""
    return np.repeat(np.array([[0.0], [0.0], [1.0]]), n, axis=1)
