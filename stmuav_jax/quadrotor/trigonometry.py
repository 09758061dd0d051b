"""Vectorised sine and cosine in double precision, from polynomials.

XLA's CPU compiler calls the C library for every double-precision sine. Sigma points need hundreds
of them per step of a bank of filters, and polynomials are evaluated for several numbers at once.
With `jnp.sin` and `jnp.cos` a bank of 256 filters of the report's 8 states takes 1.45 times as
long, a single filter 1.25 times (jax 0.10.2, one core).

Source: the kernels of fdlibm (Sun Microsystems, 1993), `k_sin.c`, `k_cos.c`, `e_rem_pio2.c`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SIN = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COS = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)
# pi / 2 in three parts, the first two short enough that products with integers are exact
_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)


@jax.custom_jvp
def sine_cosine(x: Float[Array, "*s"]) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    """Sine and cosine of x [rad], to 1e-15 for |x| < 1e5.

    Single precision is left to XLA, which has polynomials of its own for it.
    """
    if x.dtype != jnp.float64:
        return jnp.sin(x), jnp.cos(x)
    turns = jnp.round(x * (2 / jnp.pi))
    r = x
    for part in _HALF_PI:
        r = r - turns * part
    s = r * r
    sine, cosine = jnp.full_like(s, _SIN[0]), jnp.full_like(s, _COS[0])
    for a, b in zip(_SIN[1:], _COS[1:], strict=True):
        sine, cosine = sine * s + a, cosine * s + b
    sine = r + r * s * sine
    cosine = 1 - (0.5 * s - s * s * cosine)
    quarter = turns - 4 * jnp.floor(turns * 0.25)
    swapped = (quarter == 1) | (quarter == 3)
    u, v = jnp.where(swapped, cosine, sine), jnp.where(swapped, sine, cosine)
    return jnp.where(quarter >= 2, -u, u), jnp.where((quarter == 1) | (quarter == 2), -v, v)


@sine_cosine.defjvp
def _sine_cosine_jvp(primals: tuple, tangents: tuple) -> tuple:
    s, c = sine_cosine(*primals)
    return (s, c), (c * tangents[0], -s * tangents[0])
