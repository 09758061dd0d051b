"""Wind with Dryden gusts: a path sampled once from a seed, and then a smooth function of time.

Gusts along the mean wind, across it and upward are white noise filtered by

    H_u(s) = sigma_u sqrt(2 T_u / pi)  1 / (1 + T_u s)
    H_v(s) = sigma_v sqrt(T_v / pi) (1 + sqrt(3) T_v s) / (1 + T_v s)^2,   H_w like H_v,

where T = L / V is the time in which a scale length L passes at the airspeed V. Noise of one-sided
density 1 per rad/s gives the variances sigma^2. The filters are discretised exactly: at the
samples, path and process have the same covariances, whatever their spacing. The samples are
interpolated by a cubic with continuous slope (Catmull and Rom's): gusts faster than half the
sampling rate are left out, and an adaptive integrator sees a smooth function.

Sample i of the noise depends on the seed and on i alone, so a longer path begins like a
shorter one. The path is differentiable in scale lengths, intensities and airspeed.

Source: MIL-F-8785C (1980), section 3.7: spectra, and scale lengths and intensities at low
altitude. (MIL-HDBK-1797 defines the lengths across the wind as half of these.)
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from ...checks.errors import ModelError, check_finite, check_shape, has_values
from ...checks.numbers import check_positive, check_vector
from ...checks.shapes import Numbers
from ...math.derivative import length_and_direction, without_derivative
from ...math.stacked import apply_matrix

_FOOT = 0.3048
LOWEST, HIGHEST = 10 * _FOOT, 1000 * _FOOT  # heights between which the formulas hold [m]


class Turbulence(NamedTuple):
    """Scale lengths and intensities of Dryden turbulence along the mean wind, across it, and up.

    Attributes:
        lengths: scale lengths L (3,) [m].
        intensities: standard deviations sigma of the gusts (3,) [m/s].
    """

    lengths: Float[Array, "3"]
    intensities: Float[Array, "3"]


def low_altitude(height: Numbers, wind_20ft: Numbers) -> Turbulence:
    """Scale lengths and intensities of turbulence between 10 and 1000 feet above ground.

        L_w = h,  L_u = L_v = h / (0.177 + 0.000823 h)^1.2          h in feet
        sigma_w = 0.1 W_20,  sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4

    Args:
        height: height above ground [m].
        wind_20ft: W_20, wind speed at 20 feet [m/s]: 7.7 light, 15.4 moderate, 23.2 severe.

    Raises:
        ModelError: a height outside 3.048 to 304.8 m, a wind that is not positive.
    """
    h = check_positive(height, "The height above ground", "m")
    if has_values(h) and not LOWEST <= float(h) <= HIGHEST:
        raise ModelError(
            f"The low-altitude turbulence holds from {LOWEST:.4g} to {HIGHEST:.4g} m above ground, "
            f"but the height is {float(h):g} m. Give scale lengths and intensities instead."
        )
    wind = check_positive(wind_20ft, "The wind speed at 20 feet", "m/s")
    feet = h / _FOOT
    # The formulas of MIL-F-8785C at low altitude are fits in feet.
    spread = 0.177 + 0.000823 * feet
    horizontal_length, vertical = h / spread**1.2, 0.1 * wind
    level = vertical / spread**0.4
    return Turbulence(
        jnp.stack([horizontal_length, horizontal_length, h]), jnp.stack([level, level, vertical])
    )


class Gusts(eqx.Module):
    """Velocity of the air, world (3,) [m/s], as a function of time; made by `dryden`.

    The velocity is NaN before the first and after the last sample.

    Attributes:
        mean: mean wind, world (3,) [m/s].
        R_wg: gust axes along the mean wind, across it and up, as columns (3, 3).
        t0: time of the first sample [s].
        dt: time between samples [s].
        values: gusts in the gust axes (k, 3) [m/s].
    """

    mean: Float[Array, "3"]
    R_wg: Float[Array, "3 3"]
    t0: Float[Array, ""]
    dt: Float[Array, ""]
    values: Float[Array, "k 3"]

    def __call__(self, t: Float[Array, ""], kin: object = None) -> Float[Array, "3"]:
        del kin
        last_index = self.values.shape[0] - 1
        place = (t - self.t0) / self.dt
        k = jnp.clip(jnp.floor(place).astype(int), 0, last_index - 1)
        s = place - k
        # A Catmull-Rom spline has a continuous slope, which an integrator of high order needs, and reads four
        # samples only.
        points = self.values[jnp.clip(k + jnp.arange(-1, 3), 0, last_index)]
        previous_point, a, b, following_point = points
        # one-sided slopes at the two ends
        slope_a = jnp.where(k > 0, 0.5 * (b - previous_point), b - a)
        slope_b = jnp.where(k < last_index - 1, 0.5 * (following_point - a), b - a)
        c = 3 * (b - a) - 2 * slope_a - slope_b
        d = slope_a + slope_b - 2 * (b - a)
        gust = a + s * (slope_a + s * (c + s * d))
        # a time beyond an end by round-off counts as covered
        covered = (place >= -1e-9) & (place <= last_index + 1e-9)
        return jnp.where(covered, self.mean + apply_matrix(self.R_wg, gust), jnp.nan)


class ChangingWind(eqx.Module):
    """Velocity of the air, world (3,) [m/s]: steady wind or gusts, and a smooth change.

    Attributes:
        before: steady wind (3,), or gusts about it. change: added velocity (3,).
        at, rise: beginning and duration of the change [s].
    """

    before: Float[Array, "3"] | Gusts
    change: Float[Array, "3"]
    at: Float[Array, ""]
    rise: Float[Array, ""]

    def __call__(self, t: Float[Array, ""], kin: object = None) -> Float[Array, "3"]:
        before = self.before(t, kin) if callable(self.before) else self.before
        s = jnp.clip((t - self.at) / self.rise, 0.0, 1.0)
        return before + s**2 * (3 - 2 * s) * self.change


def dryden(
    seed: Integer[Array, ""] | int,
    turbulence: Turbulence,
    *,
    airspeed: Numbers,
    duration: float,
    dt: float = 0.01,
    mean: Numbers = (0.0, 0.0, 0.0),
    t0: float = 0.0,
) -> Gusts:
    """Sample a path of Dryden gusts about a mean wind.

    Args:
        seed: seed of the noise.
        turbulence: scale lengths and intensities, for instance from `low_altitude`.
        airspeed: V, speed at which gusts pass [m/s]; that of the wind for a hovering machine.
        duration: time that the path covers from t0 on [s].
        dt: spacing of the samples [s], much less than L / V.
        mean: mean wind, world (3,) [m/s]; its horizontal direction is the first gust axis, or the
            world's x without a horizontal wind.

    Raises:
        ModelError: numbers that are not finite or not positive, or samples so far apart that
            gusts pass between them (dt > L / V).
    """
    for value, quantity in ((duration, "duration"), (dt, "spacing of the samples")):
        if not 0 < value < np.inf:
            raise ModelError(f"The {quantity} of gusts must be positive, but it is {value} s.")
    speed = check_positive(airspeed, "The airspeed of gusts", "m/s")
    for name, value, unit in zip(turbulence._fields, turbulence, ("m", "m/s"), strict=True):
        check_shape(value, (3,), f"The {name} of the turbulence")
        check_finite(value, f"The {name} of the turbulence", unit)
    # Taylor's hypothesis: gusts are frozen in the air, through which the UAV flies at its airspeed.
    times = jnp.asarray(turbulence.lengths, dtype=float) / speed
    sigma = jnp.asarray(turbulence.intensities, dtype=float)
    if has_values(times, sigma):
        if not bool(jnp.all(times > 0) & jnp.all(sigma >= 0)):
            raise ModelError(
                "Scale lengths of turbulence must be positive and intensities not negative, but "
                f"they are {np.asarray(turbulence.lengths)} m and {np.asarray(sigma)} m/s."
            )
        if dt > float(jnp.min(times)):
            raise ModelError(
                f"Samples {dt:g} s apart cannot resolve gusts that last {float(jnp.min(times)):.3g} s "
                "(scale length over airspeed): give a smaller dt."
            )
    # A duration of whole spacings must not get one sample more by round-off.
    count = max(int(np.ceil(duration / dt * (1 - 1e-12))) + 1, 2)
    wind = check_vector(mean, "The mean wind", "m/s")
    values = _sample_path(jnp.asarray(seed), times, sigma, jnp.asarray(dt, float), count)
    return Gusts(wind, _gust_axes(wind), jnp.asarray(t0, float), jnp.asarray(dt, float), values)


def _gust_axes(mean: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Gust axes as columns: along the mean wind's horizontal part, across it, and up.

    Without a horizontal wind the first axis is x, and derivatives by the wind are NaN: the sense
    in which the axes would turn is not known.
    """
    _, direction, blows = length_and_direction(mean[:2])
    calm = without_derivative(jnp.array([1.0, 0.0], mean.dtype) + 0 * mean[:2], ~blows)
    x, y = jnp.where(blows, direction, calm)
    zero, unit = jnp.zeros_like(x), jnp.ones_like(x)
    return jnp.stack([x, -y, zero, y, x, zero, zero, zero, unit]).reshape(3, 3)


def shaping_matrices(
    r: Float[Array, "..."],
) -> tuple[Float[Array, "... 2 2"], Float[Array, "... 2 2"]]:
    """Transition and noise matrices of one step of the filters 1/(1 + T s) and 1/(1 + T s)^2.

    The step is r = dt / T. The states are scaled to the stationary covariance
    [[1/2, 1/4], [1/4, 1/4]]; the noise's covariance is the second matrix times its transpose.
    """
    fade, zero = jnp.exp(-r), jnp.zeros_like(r)
    # integrals of q^k exp(-2 q) up to r, without cancellation for short steps
    # The transition is exact for any spacing, and so is the spectrum; an Euler step's would depend on it.
    a = jnp.sqrt(0.5 * _lower_gamma(1, 2 * r))
    b = 0.25 * _lower_gamma(2, 2 * r) / a
    c = jnp.sqrt(0.25 * _lower_gamma(3, 2 * r) - b * b)
    matrix = lambda p, q, u, v: jnp.stack([jnp.stack([p, q], -1), jnp.stack([u, v], -1)], -2)
    return matrix(fade, zero, r * fade, fade), matrix(a, zero, b, c)


def _lower_gamma(n: int, x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Regularised lower incomplete gamma function P(n, x), n whole, to round-off for x <= 2."""
    total = jnp.ones_like(x)
    for k in reversed(range(n + 1, n + 24)):
        total = 1.0 + total * x / k
    return jnp.exp(-x) * total * x**n / math.factorial(n)


# Cholesky factor of the states' stationary covariance, from which the start is sampled.
_START = np.linalg.cholesky(np.array([[0.5, 0.25], [0.25, 0.25]]))
# Output matrices from states to gusts: along the wind the first state alone, otherwise H_v.
OUTPUT = np.array(
    [[np.sqrt(2.0), 0.0], [np.sqrt(3.0), 1 - np.sqrt(3.0)], [np.sqrt(3.0), 1 - np.sqrt(3.0)]]
)


@eqx.filter_jit
def _sample_path(
    seed: Array, times: Float[Array, "3"], sigma: Float[Array, "3"], dt: Array, count: int
) -> Float[Array, "k 3"]:
    key = jax.random.key(seed)
    # A key for each sample: a longer path begins with the same gusts.
    draw = lambda i: jax.random.normal(jax.random.fold_in(key, i), (3, 2), dtype=times.dtype)
    noise = jax.vmap(draw)(jnp.arange(count))
    step, spread = shaping_matrices(dt / times)

    def filter_step(state: Array, white_noise: Array) -> tuple[Array, Array]:
        kick = jnp.einsum("aij,aj->ai", spread, white_noise)
        state = jnp.einsum("aij,aj->ai", step, state) + kick
        return state, state

    # A start at zero would need several time constants until the gusts have their strength.
    start = noise[0] @ jnp.asarray(_START).T
    _, rest = jax.lax.scan(filter_step, start, noise[1:])
    states = jnp.concatenate([start[None], rest])
    return sigma * jnp.einsum("kai,ai->ka", states, jnp.asarray(OUTPUT))
