"""Functions of time that interpolate given samples."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, has_values
from ..checks.shapes import Numbers


class Sampled(eqx.Module):
    """Interpolating spline through samples, for drivers, servos and joint efforts.

    Degree 5 is four times continuously differentiable, so that a driver's accelerations are
    smooth. Outside the samples the first and last polynomials continue. The spline is called as
    f(t), or as f(t, kinematics) like every signal.

    Args:
        ts: increasing times (k,) [s], concrete numbers, not traced ones.
        values: samples (k,) or (k, m) in the unit of the prescribed quantity.
        degree: 3 or 5.

    Raises:
        ModelError: the times do not increase, a number is not finite, there are too few samples,
            or the degree is another.
    """

    breaks: Float[Array, " k"]
    coefficients: Float[Array, "d s *m"]

    def __init__(self, ts: Numbers, values: Numbers, degree: int = 5) -> None:
        if not has_values(ts):
            raise ModelError("The times of a spline must be known numbers, not traced by JAX.")
        is_concrete = has_values(values)
        t, y = np.asarray(ts, dtype=float), np.asarray(values, float) if is_concrete else values
        if degree not in (3, 5):
            raise ModelError(f"The degree of a spline through samples is 3 or 5, not {degree}.")
        shape = np.shape(y)
        if t.ndim != 1 or t.shape != shape[:1] or len(shape) > 2 or len(t) <= degree:
            raise ModelError(
                f"A spline of degree {degree} needs at least {degree + 1} times and as many values, "
                f"but their shapes are {t.shape} and {shape}."
            )
        if not (np.all(np.isfinite(t)) and (not is_concrete or np.all(np.isfinite(y)))):
            raise ModelError("The samples of a spline must be finite.")
        if np.any(np.diff(t) <= 0):
            at = int(np.flatnonzero(np.diff(t) <= 0)[0])
            raise ModelError(
                f"The times of samples must increase, but after {t[at]} s comes {t[at + 1]} s."
            )
        # imported here, because SciPy's interpolation is slow to import
        from scipy.interpolate import PPoly, make_interp_spline

        # a spline is linear in its values: traced values weigh splines through unit samples
        table = np.reshape(np.asarray(y) if is_concrete else np.eye(len(t)), (len(t), -1))
        pieces = [PPoly.from_spline(make_interp_spline(t, column, k=degree)) for column in table.T]
        # the spline's knots repeat at both ends: pieces of zero length are dropped
        ends = pieces[0].x
        real = np.diff(ends) > 0
        self.breaks = jnp.asarray(np.append(ends[:-1][real], ends[-1]))
        # Polynomials by piece are evaluated with one search; B-splines would need a recursion at each call.
        columns = jnp.asarray(np.stack([piece.c[:, real] for piece in pieces], axis=-1))
        if is_concrete:
            self.coefficients = columns.reshape(*columns.shape[:2], *shape[1:])
        else:
            self.coefficients = jnp.tensordot(columns, jnp.asarray(y), 1)

    def __call__(self, t: Float[Array, ""], kin: object = None) -> Float[Array, "*m"]:
        del kin
        return evaluate_piecewise(self.breaks, self.coefficients, t)


def evaluate_piecewise(
    breaks: Float[Array, " k"], coefficients: Float[Array, "d p *m"], t: Float[Array, ""]
) -> Float[Array, "*m"]:
    """Value at t of polynomials between breaks; outside, the first or the last one continues.

    Args:
        coefficients: of the powers of t less the piece's first break, the highest power first.
    """
    last = coefficients.shape[1] - 1
    piece = jnp.clip(jnp.searchsorted(breaks, t, side="right") - 1, 0, last)
    s, value = t - breaks[piece], jnp.zeros_like(coefficients[0, 0])
    for row in coefficients:
        # Horner's scheme from the break: powers of the time itself would lose digits late in a run.
        value = value * s + row[piece]
    return value
