"""Control allocation: rotor speeds that give a wanted wrench.

The squared speeds u = omega^2 of k rotors give thrust and moments linearly: w = B u,
w = (f_z, tau_x, tau_y, tau_z) about a point. `minimum_norm` is the minimum-norm u with B u = w, whose
speeds therefore differ least. `allocate` keeps to limits of the speeds:

    attainable      min |u - u_0|      with B u = w,  u within its limits
    not attainable  min |W (B u - w)|  with           u within its limits

by two quadratic programs. An active-set method finds which rotors end at a limit; with these
held there, a linear solve makes the rest exact and carries the derivatives. (On the boundary of the
attainable wrenches no u lies strictly within all limits: interior-point methods, which need one,
mistake free rotors there for held ones.) The Karush-Kuhn-Tucker conditions of both programs are
checked at the end, and a result that does not meet them is flagged.

Source: report Part II, Eq. 4.10, with B_M built from the arms themselves (corrected); J. Nocedal,
S. J. Wright, Numerical Optimization (2006), Algorithm 16.3 (active sets).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..algebra import lapack, linalg
from ..algebra.compiler import quick_jit
from ..algebra.derivative import safe_sqrt
from ..checks.errors import ModelError, check_finite, concrete
from ..checks.numbers import as_numpy, floats, numbers
from ..checks.reason import AbstractReason, first_reason
from ..checks.shapes import Numbers
from .rotor import Rotors

# Rows of a body-frame wrench (force, moment) that rotors with parallel axes can give.
_ROWS = (2, 3, 4, 5)

# All tolerances are relative: those of squared speeds to the widest span of the limits, those of
# wrenches to the span of each component within the limits.
ATTAINED = 1e-10  # a wrench with a smaller residual counts as attained
_OPTIMAL = 1e-5  # slope of the residual's norm that is taken for zero
_ROUND_OFF = 1e-12  # round-off of squared speeds and of multipliers
_LEAST = 1e-8  # slope of the norm of u - u_0 that is taken for zero
_RANK = 1e-9  # singular values below this fraction of the largest count as zero
_MOST_STEPS = 12  # largest number of steps of the active-set method, per rotor


@quick_jit
def wrench_map(rotors: Rotors, about: Float[Array, "3"]) -> Float[Array, "4 k"]:
    """Allocation matrix B: thrust [N] and moments [N m] about a point of the body per unit of u."""
    rows = lambda u: rotors.wrench(u, about)[jnp.array(_ROWS)]
    return jax.jacfwd(rows)(jnp.zeros_like(rotors.arms[:, 0]))


def minimum_norm(B: Float[Array, "4 k"], wrench: Float[Array, "4"]) -> Float[Array, " k"]:
    """Minimum-norm u with B u = wrench; NaN where the rotors cannot give every wrench."""
    gram = B @ B.T
    scale = 1 / jnp.sqrt(jnp.diagonal(gram))
    factor = linalg.Factor(linalg.cholesky(scale[:, None] * gram * scale))
    return B.T @ (scale * factor.solve(scale * wrench))


class RotorLimits(NamedTuple):
    """Lowest and highest speeds of the rotors [rad/s], one number () or one for each (k,)."""

    lowest: Numbers
    highest: Numbers

    def squared(self, count: int) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Smallest and largest squared speeds u of `count` rotors (k,) [rad^2/s^2].

        Raises:
            ModelError: limits that are not finite, not 0 <= lowest < highest, or not k.
        """
        found = []
        for name, value in (("lowest", self.lowest), ("highest", self.highest)):
            check_finite(value, f"The {name} rotor speed", "rad/s")
            speed = as_numpy(floats(value))
            if speed.shape not in ((), (count,)):
                raise ModelError(
                    f"The {name} rotor speed must be one number or one for each of {count} rotors, "
                    f"but its shape is {speed.shape}."
                )
            found.append(speed + np.zeros(count))
        lowest, highest = found
        if concrete(found) and not np.all(right := (lowest >= 0) & (lowest < highest)):
            k = int(np.argmin(right))
            raise ModelError(
                f"The speed limits of a rotor must be 0 <= lowest < highest, but those of rotor {k + 1} "
                f"are {float(lowest[k]):g} and {float(highest[k]):g} rad/s."
            )
        return floats(lowest**2), floats(highest**2)


class AllocationReason(AbstractReason):
    """Outcome of an allocation."""

    VALID = 0
    """The wrench is given exactly."""
    UNATTAINABLE = 1
    """Outside what the limits allow: the nearest wrench in the weighted norm."""
    NOT_CONVERGED = 2
    """The speeds are within their limits, but are not the best ones."""


class Allocation(eqx.Module):
    """Rotor speeds for a wanted wrench.

    Attributes:
        speed_squared: squared speeds u (k,) [rad^2/s^2].
        speeds: rotor speeds (k,) [rad/s]; zero with the derivatives of a rotor held at that limit.
        wrench: wrench that they give (4,) [N], [N m].
        wrench_error: wanted wrench less the given one (4,) [N], [N m].
        at_limit: true for each rotor at one of its limits (k,).
        reason: code of `AllocationReason`.
    """

    speed_squared: Float[Array, " k"]
    speeds: Float[Array, " k"]
    wrench: Float[Array, "4"]
    wrench_error: Float[Array, "4"]
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

    The function is pure: it may be jitted, vmapped and differentiated with respect to the wrench,
    B and the limits, in which the result is piecewise smooth.

    Args:
        B: allocation matrix, see `wrench_map`.
        wrench: wanted thrust [N] and moments [N m] (4,).
        priority: weights of thrust and moments (4,) where not all can be given, each
            component measured by its span within the limits; (1, 1, 1, 0.01) gives up yaw first.
        preferred: u_0, the squared speeds to which u is nearest where there is a choice,
            () or (k,).

    Raises:
        ModelError: arguments of another kind, shape or sign, or not finite; the message names
            them.
    """
    if np.ndim(B) != 2 or np.shape(B)[0] != 4:
        raise ModelError(
            f"The map of the rotors has shape (4, k), see `wrench_map`, not {np.shape(B)}."
        )
    count = np.shape(B)[1]
    B = numbers(B, (4, count), "The map of the rotors", "")
    wrench = numbers(wrench, (4,), "The wanted wrench", "N, N m")
    weights = numbers(priority, (4,), "The priorities of thrust and three moments", "")
    if concrete(weights) and not bool(jnp.all(weights > 0)):
        raise ModelError(
            f"The priorities of thrust and three moments must be four positive numbers, not {priority}."
        )
    if not isinstance(limits, RotorLimits):
        raise ModelError(f"The limits of the rotors must be a RotorLimits, not {limits!r}.")
    lower, upper = limits.squared(count)
    each = () if np.ndim(preferred) == 0 else (count,)
    u0 = numbers(preferred, each, "The preferred squares of the speeds", "rad^2/s^2")
    slowest = jnp.broadcast_to(jnp.asarray(limits.lowest, dtype=float), (count,))
    return _allocate(B, wrench, lower, upper, weights, jnp.broadcast_to(u0, (count,)), slowest)


class _Box(NamedTuple):
    """Scaled allocation: min |x - x_0| with A x = b, or min |A x - b|, for 0 <= x <= r <= 1."""

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
    slowest: Float[Array, " k"],
) -> Allocation:
    span = jnp.max(upper - lower)
    W = priority / (jnp.abs(B) @ (upper - lower))
    box = _Box(
        W[:, None] * B * span, W * (wrench - B @ lower), (upper - lower) / span,
        (preferred - lower) / span,
    )  # fmt: skip
    known = jax.lax.stop_gradient(box)
    near = _nearest(known)
    forced = _forced(known, near)
    # the attainable wrench is an equality constraint from here on
    kept = known._replace(b=known.A @ near)
    best, held, *_ = _walked(kept, near, forced, forced, kept.x0)
    # one correction of the result, for the round-off that is left in the wrench
    exact = _settled(known, held, best)
    best = jnp.where(_beyond(known, exact) < 0.1 * ATTAINED, exact, best)
    # the linear solve carries the derivatives by the box
    x = _settled(box, held, box.x0)
    x = best + (x - jax.lax.stop_gradient(x))
    missed = wrench - B @ (lower + span * x)
    off = box.b - box.A @ x
    is_least = _least_norm(known, jax.lax.stop_gradient(x), held, forced)
    optimal = (_beyond(known, x) < ATTAINED) & _is_nearest(known, x) & is_least
    reason = first_reason(
        (~optimal, AllocationReason.NOT_CONVERGED),
        (_size(off) >= ATTAINED, AllocationReason.UNATTAINABLE),
    )
    u = lower + span * x
    at_limit = (x < ATTAINED) | (x > box.r - ATTAINED)
    speeds = jnp.where((held < 0) & (slowest == 0), slowest, safe_sqrt(u))
    return Allocation(u, speeds, wrench - missed, missed, at_limit, reason)


def _size(x: Float[Array, "..."]) -> Float[Array, ""]:
    return jnp.max(jnp.abs(x))


def _beyond(box: _Box, x: Float[Array, " k"]) -> Float[Array, ""]:
    """Largest excess of x over its limits."""
    return jnp.max(jnp.maximum(-x, x - box.r))


# --- the conditions of optimality


def _is_nearest(box: _Box, x: Float[Array, " k"]) -> Bool[Array, ""]:
    """Test whether no feasible change of x lessens |A x - b|, or |A x - b| is negligible."""
    slope, missed = _slope(box, x)
    up, down = x < box.r - ATTAINED, x > ATTAINED
    fine = ~(up & (slope > _OPTIMAL)) & ~(down & (slope < -_OPTIMAL))
    return (missed < ATTAINED) | jnp.all(fine)


def _least_norm(
    box: _Box, x: Float[Array, " k"], held: Int[Array, " k"], forced: Int[Array, " k"]
) -> Bool[Array, ""]:
    """Test whether no feasible change of x that keeps A x lessens |x - x_0|.

    At the optimum x - x_0 = A^T y + z, with z zero for entries between their limits, not negative
    at 0 and not positive at r; entries that |A x - b| itself keeps at a limit may have any z.
    """
    inverse, _ = _inverse(box, held)
    z = x - box.x0 - box.A.T @ (inverse.T @ jnp.where(held == 0, x - box.x0, 0.0))
    up, down = x < box.r - ATTAINED, x > ATTAINED
    limit = _LEAST * (1.0 + _size(z - (x - box.x0)))
    fine = ~(up & (z < -limit)) & ~(down & (z > limit))
    return jnp.all(fine | (forced != 0))


# --- active sets


class _Walk(NamedTuple):
    """State of the active-set method.

    `held` is the active set: entries held at r (+1) or at 0 (-1), others free (0).
    """

    x: Float[Array, " k"]
    held: Int[Array, " k"]
    done: Bool[Array, ""]
    again: Bool[Array, ""]
    steps: Int[Array, ""]


def _nearest(box: _Box) -> Float[Array, " k"]:
    """Point within the limits that minimises |A x - b|."""
    none = jnp.zeros(box.r.shape, int)
    free = _settled(box, none, box.x0)
    held = 1 * (free > box.r) - 1 * (free < 0)
    x = _walked(box, jnp.clip(free, 0.0, box.r), held, none, None).x
    # the last point may pass a limit by round-off
    return jnp.clip(x, 0.0, box.r)


def _forced(box: _Box, near: Float[Array, " k"]) -> Int[Array, " k"]:
    """Entries that every minimiser of |A x - b| has at r (+1) or at 0 (-1); 0 for others."""
    slope, missed = _slope(box, near)
    counts = (missed >= ATTAINED) & (jnp.abs(slope) > _least_slope(missed))
    return jnp.where(counts, jnp.where(slope > 0, 1, -1), 0)


def _slope(box: _Box, x: Float[Array, " k"]) -> tuple[Float[Array, " k"], Float[Array, ""]]:
    """Decrease of |A x - b| per unit of each entry of x, and |A x - b| itself."""
    off = box.b - box.A @ x
    size = jnp.sqrt(jnp.sum(off**2))
    return box.A.T @ off / jnp.where(size > 0, size, 1.0), size


def _least_slope(missed: Float[Array, ""]) -> Float[Array, ""]:
    """Round-off of a slope of |A x - b|, which is large where |A x - b| is small."""
    return jnp.maximum(_RANK, 1e-15 / jnp.maximum(missed, 1e-15))


def _settled(box: _Box, held: Int[Array, " k"], start: Float[Array, " k"]) -> Float[Array, " k"]:
    """Point nearest to `start` that minimises |A x - b| with some entries held at their limits."""
    fixed = jnp.where(held > 0, box.r, jnp.where(held < 0, 0.0, start))
    inverse = lapack.pseudoinverse(box.A * (held == 0), _RANK)
    return fixed + inverse @ (box.b - box.A @ fixed)


def _inverse(box: _Box, held: Int[Array, " k"]) -> tuple[Float[Array, "k 4"], Float[Array, ""]]:
    """Pseudoinverse of the free columns of A, and the round-off of a solution by it."""
    U, values, V = lapack.svd(box.A * (held == 0))
    kept = jnp.where(values > _RANK * values[0], values, jnp.inf)
    smallest = jnp.min(kept) / jnp.where(values[0] > 0, values[0], 1.0)
    return (V.T / kept) @ U.T, _ROUND_OFF + 1e-15 / smallest


def _walked(
    box: _Box,
    x: Float[Array, " k"],
    held: Int[Array, " k"],
    forced: Int[Array, " k"],
    anchor: Float[Array, " k"] | None,
) -> _Walk:
    """Minimise |A x - b| from x by active sets; with an anchor, |x - anchor| where A x = b.

    Each step moves towards the point of `_settled` and holds the first entry that meets a limit
    on the way. At that point an entry is freed whose multiplier has the wrong sign. With an
    anchor the free columns of A keep their rank, so that the multipliers are unique. Entries
    that are `forced` stay held.
    """
    k = box.r.shape[0]

    def go(now: _Walk) -> _Walk:
        x, held = now.x, now.held
        inverse, noise = _inverse(box, held)
        start, noise = (x, _ROUND_OFF) if anchor is None else (anchor, noise)
        fixed = jnp.where(held > 0, box.r, jnp.where(held < 0, 0.0, start))
        target = fixed + inverse @ (box.b - box.A @ fixed)
        step = jnp.where(held == 0, target - x, 0.0)
        room = jnp.maximum(jnp.where(step > 0, box.r - x, x), 0.0)
        moves = jnp.abs(step) > room + noise
        share = jnp.where(moves, room / jnp.where(moves, jnp.abs(step), 1.0), 2.0)
        # of several at once, hold the one that moves most: the rest stays farthest from singular
        early = share <= jnp.min(share) + _ROUND_OFF
        first = jnp.argmax(jnp.where(early & moves, jnp.abs(step), -1.0))
        arrived = ~jnp.any(moves)
        met = (jnp.arange(k) == first) & ~arrived
        here = arrived & (_size(step) <= noise)
        after = jnp.where(here, x, x + jnp.where(arrived, 1.0, share[first]) * step)
        if anchor is None:
            slope, missed = _slope(box, after)
            limit = _least_slope(missed)
            # where the residual is tiny, slopes are lost in round-off: restart once with all free
            small = (missed > 1e-14) & (missed < 1e3 * ATTAINED)
        else:
            back = box.A.T @ (inverse.T @ jnp.where(held == 0, after - anchor, 0.0))
            slope, limit = anchor - after + back, noise * (1.0 + _size(back))
            small = jnp.zeros((), bool)
        wrong = jnp.where(forced == 0, -held * slope, 0.0)
        most = jnp.argmax(wrong)
        leaves = (jnp.arange(k) == most) & arrived & (wrong[most] > limit)
        after = jnp.where(met, jnp.where(step > 0, box.r, 0.0), after)
        held = jnp.where(met, jnp.where(step > 0, 1, -1), jnp.where(leaves, 0, held))
        ends = arrived & ~jnp.any(leaves)
        anew = ends & small & ~now.again
        held = jnp.where(anew, forced, held)
        return _Walk(after, held, ends & ~anew, now.again | anew, now.steps + 1)

    unfinished = lambda now: ~now.done & (now.steps < _MOST_STEPS * k)
    no = jnp.zeros((), bool)
    return jax.lax.while_loop(unfinished, go, _Walk(x, held, no, no, jnp.zeros((), int)))


def check_lift(
    rotors: Rotors, limits: RotorLimits, weight: Numbers
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Smallest and largest thrust [N] of rotors within limits, which must bracket the weight [N].

    Raises:
        ModelError: the weight lies outside; the message has the required and available thrust.
    """
    k_f, *bounds = as_numpy((rotors.k_f, *limits.squared(rotors.spin.shape[0])))
    lowest, most = (floats(k_f * each.sum()) for each in bounds)
    if not concrete(lowest, most, weight):
        return lowest, most
    range_of = f"rotors of body '{rotors.body}' give {float(lowest):.4g} to {float(most):.4g} N"
    if (needed := float(floats(weight))) > float(most):
        words = f"{needed:.4g} N are required, but within their speed limits the {range_of}"
        raise ModelError(f"The rotors cannot carry the weight: {words}.")
    if needed < float(lowest):
        raise ModelError(
            f"The rotors cannot turn slowly enough to hover: the weight is {needed:.4g} N, "
            f"but within their speed limits the {range_of}."
        )
    return lowest, most
