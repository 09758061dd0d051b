"""From a wanted wrench to rotor speeds.

u = omega^2 of k rotors gives thrust and moments linearly: w = B u, w = (f_z, tau_x, tau_y,
tau_z) about a point. Of all u with B u = w, `least` is the one of least norm, and so the
one whose speeds differ least. `allocate` keeps to limits of the speeds:

    attainable      min |u - u_0|      with B u = w,  u within its limits
    not attainable  min |W (B u - w)|  with           u within its limits

by two quadratic programs. An interior-point method finds which rotors end at a limit; with
these held there, a linear solve makes the rest exact and carries the derivatives.

Source: report Part II, Eq. 4.10, with B_M built from the arms themselves (corrected).
"""

from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import qpax
from jaxtyping import Array, Bool, Float, Int

from ..algebra.shapes import Numbers
from ..mechanics.errors import ModelError, check_finite, concrete
from ..mechanics.reason import first_reason
from .rotor import Rotors

# Rows of a body-frame wrench (force, moment) that rotors with parallel axes can give.
_ROWS = (2, 3, 4, 5)

# All of these are relative: squared speeds to the widest span of the limits, wrenches to the
# span that each component has within the limits.
ATTAINED = 1e-10  # a wrench missed by less counts as given
_OPTIMAL = 1e-6  # slope of the squared misfit that is taken for zero
_TOLERANCE = 1e-13  # of the interior-point method
_RANK = 1e-9  # singular values below this fraction of the largest count as zero
_MOST_STEPS = 60


def wrench_map(rotors: Rotors, about: Float[Array, "3"]) -> Float[Array, "4 k"]:
    """B: thrust [N] and moments [N m] about a point of the body's frame, per unit of u."""
    zero = jnp.zeros(rotors.spin.shape[0], rotors.arms.dtype)
    return jax.jacfwd(lambda u: rotors.wrench(u, about))(zero)[jnp.array(_ROWS)]


def least(B: Float[Array, "4 k"], wrench: Float[Array, "4"]) -> Float[Array, " k"]:
    """The u of least norm with B u = wrench; NaN where the rotors cannot give every wrench."""
    gram = B @ B.T
    scale = 1 / jnp.sqrt(jnp.diagonal(gram))
    factor = jax.scipy.linalg.cho_factor(scale[:, None] * gram * scale)
    return B.T @ (scale * jax.scipy.linalg.cho_solve(factor, scale * wrench))


class RotorLimits(NamedTuple):
    """lowest, highest: speeds of the rotors [rad/s], one for all () or one each (k,)."""

    lowest: Numbers
    highest: Numbers

    def squared(self, count: int) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Least and largest u of `count` rotors (k,) [rad^2/s^2].

        Raises:
            ModelError: limits that are not finite, not 0 <= lowest < highest, or not k.
        """
        found = []
        for name, value in (("lowest", self.lowest), ("highest", self.highest)):
            check_finite(value, f"The {name} rotor speed", "rad/s")
            speed = jnp.asarray(value, dtype=float)
            if speed.shape not in ((), (count,)):
                raise ModelError(
                    f"The {name} rotor speed must be one number or one for each of {count} rotors, "
                    f"but its shape is {speed.shape}."
                )
            found.append(jnp.broadcast_to(speed, (count,)))
        lowest, highest = found
        if concrete(lowest, highest) and not bool(jnp.all((lowest >= 0) & (lowest < highest))):
            k = int(jnp.argmin((lowest >= 0) & (lowest < highest)))
            raise ModelError(
                f"The speed limits of a rotor must be 0 <= lowest < highest, but those of rotor {k + 1} "
                f"are {float(lowest[k]):g} and {float(highest[k]):g} rad/s."
            )
        return lowest**2, highest**2


class AllocationReason(IntEnum):
    """What an allocation is."""

    VALID = 0
    """The wrench is given exactly."""
    UNATTAINABLE = 1
    """Outside what the limits allow: the nearest wrench in the weighted norm."""
    NOT_CONVERGED = 2
    """The speeds are within their limits, but are not the best ones."""


class Allocation(eqx.Module):
    """Rotor speeds for a wanted wrench.

    Attributes:
        squared: u (k,) [rad^2/s^2]. speeds: (k,) [rad/s].
        wrench: given by them (4,) [N], [N m]. missed: wanted less given.
        at_limit: whether each rotor is held at one of its limits.
        reason: a code of `AllocationReason`.
    """

    squared: Float[Array, " k"]
    speeds: Float[Array, " k"]
    wrench: Float[Array, "4"]
    missed: Float[Array, "4"]
    at_limit: Bool[Array, " k"]
    reason: Int[Array, ""]


def allocate(
    B: Float[Array, "4 k"],
    wrench: Numbers,
    limits: RotorLimits,
    *,
    priority: Numbers = (1.0, 1.0, 1.0, 1.0),
    preferred: Numbers = 0.0,
) -> Allocation:
    """Rotor speeds within limits that give a wrench, or come nearest to it.

    Pure: may be jitted, vmapped and differentiated, by the wrench, B and the limits, with
    respect to which the result is piecewise smooth.

    Args:
        B: see `wrench_map`. wrench: wanted thrust [N] and moments [N m] (4,).
        priority: weights of thrust and moments (4,) where not all can be given, each
            component measured by the span it has within the limits; (1, 1, 1, 0.01) gives
            up yaw first.
        preferred: u_0, from which u deviates least where there is a choice, () or (k,).

    Raises:
        ModelError: limits or priorities that make no sense, a wrench that is not finite.
    """
    check_finite(wrench, "The wanted wrench", "N, N m")
    weights = jnp.asarray(priority, dtype=float)
    if weights.shape != (4,) or (concrete(weights) and not bool(jnp.all(weights > 0))):
        raise ModelError(
            f"The priorities of thrust and three moments must be four positive numbers, not {priority}."
        )
    count = B.shape[1]
    lower, upper = limits.squared(count)
    u0 = jnp.broadcast_to(jnp.asarray(preferred, dtype=float), (count,))
    return _allocate(B, jnp.asarray(wrench, dtype=float), lower, upper, weights, u0)


class _Box(NamedTuple):
    """min |x - x_0| with A x = b, or min |A x - b|, for 0 <= x <= r."""

    A: Float[Array, "4 k"]
    b: Float[Array, "4"]
    r: Float[Array, " k"]
    x0: Float[Array, " k"]


@eqx.filter_jit
def _allocate(
    B: Float[Array, "4 k"],
    wrench: Float[Array, "4"],
    lower: Float[Array, " k"],
    upper: Float[Array, " k"],
    priority: Float[Array, "4"],
    preferred: Float[Array, " k"],
) -> Allocation:
    span = jnp.max(upper - lower)
    W = priority / (jnp.abs(B) @ (upper - lower))
    box = _Box(
        W[:, None] * B * span, W * (wrench - B @ lower), (upper - lower) / span,
        (preferred - lower) / span,
    )  # fmt: skip
    known = jax.lax.stop_gradient(box)
    near, held = _nearest(known)
    also = _chosen(known, near, held)
    chosen = _settled(known._replace(b=known.A @ near), also, known.x0)
    better = _inside(known, chosen) & (_size(known.A @ (chosen - near)) < ATTAINED)
    start, held = jnp.where(better, known.x0, near), jnp.where(better, also, held)
    x = _settled(box, held, start)
    missed = wrench - B @ (lower + span * x)
    off = box.b - box.A @ x
    slope = box.A.T @ off
    uphill = jnp.where(held > 0, -slope, jnp.where(held < 0, slope, jnp.abs(slope)))
    optimal = _inside(known, x) & jnp.all(uphill < _OPTIMAL)
    given = _size(off) < ATTAINED
    reason = first_reason(
        (~optimal, AllocationReason.NOT_CONVERGED), (~given, AllocationReason.UNATTAINABLE)
    )
    u = lower + span * x
    turning = u > 0
    speeds = jnp.where(turning, jnp.sqrt(jnp.where(turning, u, 1.0)), 0.0)
    return Allocation(u, speeds, wrench - missed, missed, held != 0, reason)


def _size(x: Float[Array, "..."]) -> Float[Array, ""]:
    return jnp.max(jnp.abs(x))


def _inside(box: _Box, x: Float[Array, " k"]) -> Bool[Array, ""]:
    return jnp.max(jnp.maximum(-x, x - box.r)) < ATTAINED


def _nearest(box: _Box) -> tuple[Float[Array, " k"], Int[Array, " k"]]:
    """A minimiser of |A x - b|, and which of its entries are held at r (+1) or at 0 (-1)."""
    k = box.r.shape[0]
    G, h = jnp.concatenate([jnp.eye(k), -jnp.eye(k)]), jnp.concatenate([box.r, jnp.zeros(k)])
    no_rows = jnp.zeros((0, k)), jnp.zeros(0)
    x, held = _solved(box.A.T @ box.A, -box.A.T @ box.b, *no_rows, G, h)
    return _walked(box, jnp.clip(x[:k], 0.0, box.r), held, None)


def _chosen(box: _Box, near: Float[Array, " k"], held: Int[Array, " k"]) -> Int[Array, " k"]:
    """Which entries are held where x is nearest to x_0 with the same A x as `near`."""
    k, m = box.r.shape[0], box.b.shape[0]
    _, values, rows = jnp.linalg.svd(box.A * (held == 0), full_matrices=False)
    counts = values > _RANK * jnp.max(values)
    rows = jnp.where(counts[:, None], rows, 0.0)
    # unknowns that are zero stand in for rows that say nothing: the solver wants full rank
    C = jnp.concatenate([rows, jnp.diag(1.0 * ~counts)], axis=1)
    G = jnp.concatenate([jnp.eye(k), -jnp.eye(k)])
    G = jnp.concatenate([G, jnp.zeros((2 * k, m))], axis=1)
    h = jnp.concatenate([box.r, jnp.zeros(k)])
    q = -jnp.concatenate([box.x0, jnp.zeros(m)])
    x, also = _solved(jnp.eye(k + m), q, C, rows @ near, G, h)
    also = jnp.where(held == 0, also, held)
    return _walked(box._replace(b=box.A @ near), jnp.clip(x[:k], 0.0, box.r), also, box.x0)[1]


def _solved(
    Q: Array, q: Array, C: Array, d: Array, G: Array, h: Array
) -> tuple[Float[Array, " n"], Int[Array, " k"]]:
    """min x Q x / 2 + q x with C x = d, G x <= h, and which entries end at a limit."""
    x, slack, push, *_ = qpax.solve_qp(
        Q, q, C, d, G, h, backend="i", solver_tol=_TOLERANCE, max_iter=_MOST_STEPS
    )
    at_top, at_bottom = jnp.split(push > slack, 2)
    return x, 1 * at_top - 1 * at_bottom


def _settled(box: _Box, held: Int[Array, " k"], start: Float[Array, " k"]) -> Float[Array, " k"]:
    """The x nearest to `start` that minimises |A x - b| with some entries held."""
    fixed = jnp.where(held > 0, box.r, jnp.where(held < 0, 0.0, start))
    inverse = jnp.linalg.pinv(box.A * (held == 0), rtol=_RANK)
    return fixed + inverse @ (box.b - box.A @ fixed)


def _walked(
    box: _Box, x: Float[Array, " k"], held: Int[Array, " k"], anchor: Float[Array, " k"] | None
) -> tuple[Float[Array, " k"], Int[Array, " k"]]:
    """Go from x to where `_settled` says, holding entries as they meet their limits."""

    def go(now: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, held, _, count = now
        target = _settled(box, held, x if anchor is None else anchor)
        step = jnp.where(held == 0, target - x, 0.0)
        room = jnp.maximum(jnp.where(step > 0, box.r - x, x), 0.0)
        moves = jnp.abs(step) > room
        share = jnp.where(moves, room / jnp.where(moves, jnp.abs(step), 1.0), 1.0)
        first = jnp.argmin(share)
        done = ~jnp.any(moves)
        met = (jnp.arange(x.shape[0]) == first) & ~done
        stop = x + share[first] * step
        reached = jnp.where(done, target, stop)
        held = jnp.where(met, jnp.where(step > 0, 1, -1), held)
        return reached, held, done, count + 1

    def unfinished(now: tuple[Array, Array, Array, Array]) -> Array:
        return ~now[2] & (now[3] <= x.shape[0])

    start = (x, held, jnp.zeros((), bool), jnp.zeros((), int))
    x, held, _, _ = jax.lax.while_loop(unfinished, go, start)
    return x, held


def check_lift(
    rotors: Rotors, limits: RotorLimits, weight: Numbers
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Least and largest thrust [N] of rotors within limits, which must bracket the weight [N].

    Raises:
        ModelError: they do not; says the required and the available thrust.
    """
    lower, upper = limits.squared(rotors.spin.shape[0])
    least, most = rotors.k_f * jnp.sum(lower), rotors.k_f * jnp.sum(upper)
    needed = jnp.asarray(weight, dtype=float)
    if not concrete(least, most, needed):
        return least, most
    range_of = f"rotors of body '{rotors.body}' give {float(least):.4g} to {float(most):.4g} N"
    if float(needed) > float(most):
        raise ModelError(
            f"The rotors cannot carry the weight: {float(needed):.4g} N are required, but within "
            f"their speed limits the {range_of}."
        )
    if float(needed) < float(least):
        raise ModelError(
            f"The rotors cannot turn slowly enough to hover: the weight is {float(needed):.4g} N, "
            f"but within their speed limits the {range_of}."
        )
    return least, most
