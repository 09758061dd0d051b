"""Ephemeris of the sun: its direction at a place and time by a short series; jitted, vmapped, differentiable.

Time is Unix time: seconds of UTC since 1970-01-01, leap seconds not counted, in double precision
(resolution 0.3 us). Directions are unit vectors `s_w` towards the sun in the world frame, here
x east, y north, z up along the ellipsoid's normal. Components come first and the axes of a
stack last, (3, ...); all arguments broadcast over the stack.

The series is Grena's Algorithm 5: the sun's ecliptic longitude (eccentricity, seven
perturbations, aberration in the mean), nutation in longitude and obliquity, sidereal time.
Working with vectors instead of right ascension and hour angle keeps it smooth everywhere, poles
and zenith included. It agrees with the SPA within 0.0024 degrees over 2020 to 2050, 0.005 over
1950 to 2110 and 0.015 over 1800 to 2200 (docs/sun.md).

UTC replaces UT1, from which it differs by at most 0.9 s: 0.0038 degrees of the earth's rotation.

Source: R. Grena, Five new algorithms for the computation of sun position from 2010 to 2110,
Solar Energy 86 (2012) 1323; refraction: I. Reda, A. Andreas, Solar Position Algorithm for Solar
Radiation Applications, NREL/TP-560-34302 (2008), Eq. 42.
"""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import SettingError, check_finite, has_values
from ...checks.numbers import array_module, as_floats, as_numpy
from ...checks.shapes import Numbers
from ...math.derivative import safe_sqrt

DAY = 86400.0  # [s]
# Excess of a latitude or longitude that is allowed for 90 degrees converted in single precision [rad].
ROUNDING = math.radians(1e-5)
_DAYS_TO_2060 = 32872.0  # from 1970-01-01 to 2060-01-01, the origin of the series' time
_SIDEREAL = 6.300388099 - 2.0 * math.pi  # the earth's rotation in a day beyond one turn [rad]

# perturbations by planets and moon: amplitude [rad], frequency [rad/day], phase [rad]
_PERTURBATIONS = np.array([
    (1.27e-5, 1.49e-3, -2.337),
    (1.21e-5, 4.31e-3, 3.065),
    (2.33e-5, 1.076e-2, -1.533),
    (3.49e-5, 1.575e-2, -2.358),
    (2.67e-5, 2.152e-2, 0.074),
    (1.28e-5, 3.152e-2, 1.547),
    (3.14e-5, 2.1277e-1, -0.488),
]).T  # fmt: skip
_OBLIQUITY = 4.089567e-1  # in 2060 [rad]
_PARALLAX = 4.26e-5  # earth's radius over its distance from the sun [rad]

ALTITUDES = (-500.0, 100_000.0)  # permitted range of a place's altitude [m]

# Elevation at which the sun's upper limb, seen through air, is on the horizon [rad]; refraction
# is left out below it.
_SUNSET = -math.radians(0.26667 + 0.5667)
_ZENITH = 1e-12  # squared sine of the zenith angle below which refraction is linear in it


class Place(eqx.Module):
    """A point on the earth, or an array of points.

    Args:
        latitude: geodetic latitude, north positive [rad].
        longitude: longitude, east positive [rad].
        altitude: height above sea level [m].

    Raises:
        SettingError: a single place with a latitude beyond a quarter turn, a longitude beyond
            a full turn, an altitude outside -500 m to 100 km, or a number that is not finite. In
            arrays such a latitude or number gets a reason code from `sun_position`.
    """

    latitude: Float[Array, "*#s"] = eqx.field(converter=as_floats)
    longitude: Float[Array, "*#s"] = eqx.field(converter=as_floats)
    altitude: Float[Array, "*#s"] = eqx.field(converter=as_floats, default=0.0)

    def __check_init__(self) -> None:
        if has_values(self.latitude, self.longitude, self.altitude) and self.latitude.ndim == 0:
            _check_place(self)

    @staticmethod
    def degrees(latitude: Numbers, longitude: Numbers, altitude: Numbers = 0.0) -> "Place":
        """Place from latitude and longitude in degrees; altitude and errors as for `Place`."""
        turn = lambda angle: as_floats(array_module(angle).radians(angle))
        return Place(turn(latitude), turn(longitude), altitude)


def _check_place(place: Place) -> None:
    for name, unit in (("latitude", "rad"), ("longitude", "rad"), ("altitude", "m")):
        check_finite(getattr(place, name), f"The {name}", unit, SettingError)
    (low, high), altitudes = ALTITUDES, np.atleast_1d(place.altitude)
    outside = altitudes[(altitudes < low) | (altitudes > high)]
    if outside.size:
        raise SettingError(
            f"The altitude must lie within {low:g} and {high:g} m, but it is {outside.flat[0]:g} m."
        )
    for name, value, most in (
        ("latitude", place.latitude, 90),
        ("longitude", place.longitude, 360),
    ):
        angles = np.ravel(value)
        angle = angles[np.argmax(np.abs(angles))] if angles.size else 0.0
        if abs(angle) > math.radians(most) + ROUNDING:
            raise SettingError(
                f"The {name} must lie within -{most} and {most} degrees, but it is {np.degrees(angle):g} degrees. "
                "Place(...) takes radians, Place.degrees(...) degrees."
            )


class Air(eqx.Module):
    """State of the air that refracts the light.

    Attributes:
        pressure: pressure at the place [Pa].
        temperature: temperature at the place [K].

    Raises:
        SettingError: single numbers that are not finite, a pressure below or a temperature not
            above zero.
    """

    pressure: Float[Array, "*#s"] = eqx.field(converter=as_floats, default=101325.0)
    temperature: Float[Array, "*#s"] = eqx.field(converter=as_floats, default=285.15)

    def __check_init__(self) -> None:
        check_finite(self.pressure, "The air's pressure", "Pa", SettingError)
        check_finite(self.temperature, "The air's temperature", "K", SettingError)
        if has_values(self.pressure, self.temperature) and not (
            np.all(np.asarray(self.pressure) >= 0) and np.all(np.asarray(self.temperature) > 0)
        ):
            raise SettingError(
                "The air's pressure must not be negative and its temperature must be positive, but "
                f"they are {self.pressure} Pa and {self.temperature} K."
            )

    @staticmethod
    def standard(altitude: Numbers, temperature: Numbers = 285.15) -> "Air":
        """Air with the standard atmosphere's pressure at an altitude [m] of at most 11 km.

        Raises:
            SettingError: an altitude outside -500 to 11,000 m.

        Source: US Standard Atmosphere 1976, troposphere.
        """
        height = as_floats(altitude)
        check_finite(height, "The altitude", "m", SettingError)
        if has_values(height) and np.any(
            (np.asarray(height) < -500) | (np.asarray(height) > 11000)
        ):
            raise SettingError(
                f"The standard atmosphere is known from -500 to 11000 m, not at {height} m."
            )
        return Air(101325.0 * (1.0 - 2.25577e-5 * as_numpy(height)) ** 5.25588, temperature)


def _ecliptic_coordinates(days: Float[Array, "*s"]) -> tuple[Float[Array, "*s"], ...]:
    """Apparent longitude, change of the obliquity from `_OBLIQUITY`, nutation in longitude [rad].

    Args:
        days: terrestrial time since 2060-01-01 [days].
    """
    year = 0.0172019715 * days
    s, c = jnp.sin(year), jnp.cos(year)
    # Multiples of the year's angle follow from its sine and cosine: products are cheaper than further
    # calls.
    s2, c2 = 2.0 * s * c, (c + s) * (c - s)
    s3, c3 = s2 * c + c2 * s, c2 * c - s2 * s
    longitude = 1.7527901 + math.pi + 1.7202792159e-2 * days
    longitude += 3.33024e-2 * s - 2.0582e-3 * c + 3.512e-4 * s2 - 4.07e-5 * c2
    longitude += 5.2e-6 * s3 - 9e-7 * c3 - 8.23e-5 * s * jnp.sin(2.92e-5 * days)
    # one sum over an axis, so that XLA computes it once and not for each of three components
    amplitude, frequency, phase = _PERTURBATIONS.reshape(3, -1, *(1,) * days.ndim)
    longitude += jnp.sum(amplitude * jnp.sin(frequency * days + phase), axis=0)
    node = 9.282e-4 * days - 0.8
    nutation = 8.34e-5 * jnp.sin(node)
    return longitude + nutation, -6.19e-9 * days + 4.46e-5 * jnp.cos(node), nutation


def sun_direction(unix: Numbers, place: Place, *, air: Air | None = None) -> Float[Array, "3 *s"]:
    """Unit vector from a place to the sun's centre in axes east, north, up, shape (3, ...).

    Args:
        unix: Unix time [s], shape (...); the error by years is that of `sun_position`.
        place: the observer's place, with shapes that broadcast against `unix`.
        air: air that refracts the light (`refract_direction`); by default there is none.

    Raises:
        SettingError: JAX is in single precision, in which times have a resolution of minutes.

    Source: Grena (2012), Algorithm 5, with its model of TT - UTC; parallax as the earth's
    radius subtracted along the vertical.
    """
    t = jnp.asarray(unix, dtype=float)
    # A Unix time of today has ten digits before the point; in single precision it is known to two minutes
    # only.
    if t.dtype != jnp.float64:
        raise SettingError(
            "A time in single precision has steps of 128 s. Call "
            'jax.config.update("jax_enable_x64", True) first.'
        )
    days = t / DAY - _DAYS_TO_2060
    # The series counts terrestrial time, which differs from universal time by the slowing of the earth's
    # rotation.
    longitude, change, nutation = _ecliptic_coordinates(days + (96.4 + 0.00158 * days) / DAY)
    # components towards the equinox, 90 degrees east of it on the equator, and the pole
    x, across = jnp.cos(longitude), jnp.sin(longitude)
    # first order in the obliquity's change, which is below 1.4e-4: the error is at most 1e-8
    c, s = math.cos(_OBLIQUITY), math.sin(_OBLIQUITY)
    y, pole = across * (c - s * change), across * (s + c * change)
    # the full turns of whole days are subtracted first, because they would cost digits
    turn = 2.0 * math.pi * (days - jnp.floor(days)) + _SIDEREAL * days
    sidereal = 1.7528311 + turn + place.longitude + 0.92 * nutation
    c, s = jnp.cos(sidereal), jnp.sin(sidereal)
    east, outward = y * c - x * s, x * c + y * s
    c, s = jnp.cos(place.latitude), jnp.sin(place.latitude)
    # The place is one earth's radius from the centre to which the series refers.
    north, up = c * pole - s * outward, c * outward + s * pole - _PARALLAX
    size = jnp.sqrt(east**2 + north**2 + up**2)
    s_w = jnp.stack(jnp.broadcast_arrays(east / size, north / size, up / size))
    return s_w if air is None else refract_direction(s_w, air)


def sun_elevation(s_w: Float[Array | np.ndarray, "3 *s"]) -> Float[Array, "*s"]:
    """Elevation of a direction above the horizon [rad]; its gradient at the zenith is set to 0."""
    x, y, z = s_w[0], s_w[1], s_w[2]
    return jnp.arctan2(z, safe_sqrt(jnp.asarray(x**2 + y**2)))


def sun_azimuth(s_w: Float[Array | np.ndarray, "3 *s"]) -> Float[Array, "*s"]:
    """Azimuth of a direction, clockwise from north, from 0 to 2 pi [rad].

    At the zenith the azimuth is not determined: value and gradient are set to 0 there.
    """
    x, y = s_w[0], s_w[1]
    is_off_zenith = x**2 + y**2 > 0.0
    x, y = jnp.where(is_off_zenith, x, 0.0), jnp.where(is_off_zenith, y, 1.0)
    return jnp.arctan2(x, y) % (2.0 * jnp.pi)


def refract_direction(s_w: Float[Array | np.ndarray, "3 *s"], air: Air) -> Float[Array, "3 *s"]:
    """Apparent direction through refracting air, raised by about 0.5 degrees at the horizon.

    With e the elevation in degrees, before air,

        de = p / 1010 hPa  283 K / T  (1.02 / 60) [cot(e + 10.3 / (e + 5.11)) - the same at 90]

    degrees while part of the sun is visible (e > -0.833 degrees), else 0. The second term, 3e-5
    degrees, makes de vanish at the zenith, so that the direction stays smooth there.

    Source: NREL/TP-560-34302, Eq. 42, without the second term.
    """
    x, y, z = s_w[0], s_w[1], s_w[2]
    flat = x**2 + y**2
    at_zenith = flat < _ZENITH
    # The root has no derivative at zero; the branch not taken is given a number with one.
    level = jnp.sqrt(jnp.where(at_zenith, 1.0, flat))
    e = jnp.arctan2(z, level)
    shows = (e > _SUNSET) & ~at_zenith
    degrees = jnp.degrees(jnp.where(shows, e, 1.0))
    strength = air.pressure / 101000.0 * 283.0 / (air.temperature - 0.15)
    unit = strength * math.radians(1.02 / 60.0)
    # The formula leaves a small rest at the zenith, which is subtracted: the direction there stays
    # continuous.
    bent = _refraction_angle(degrees) - _refraction_angle(90.0)
    rise = jnp.where(shows, unit * bent, 0.0)
    shrink = jnp.cos(rise) - z / level * jnp.sin(rise)
    # the zenith angle shrinks in proportion: d cot / d (zenith angle) at 90 degrees
    shrink = jnp.where(at_zenith & (z > 0.0), 1.0 - unit * _SLOPE, shrink)
    up = jnp.where(at_zenith, z, jnp.sin(e + rise))
    return jnp.stack(jnp.broadcast_arrays(x * shrink, y * shrink, up))


def _refraction_angle(degrees: Float[Array, "*s"] | float) -> Float[Array, "*s"]:
    return 1.0 / jnp.tan(jnp.radians(degrees + 10.3 / (degrees + 5.11)))


_SLOPE = (1.0 - 10.3 / 95.11**2) / math.sin(math.radians(90.0 + 10.3 / 95.11)) ** 2
