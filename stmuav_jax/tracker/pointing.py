"""Pointing of the panel: angles and strokes that face a direction, or the reason against it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..checks.errors import StateError, concrete
from .geometry import TrackerGeometry
from .kinematics import RISING, Reason, Rods, panel_angles, turn_by_direction
from .workspace import Limits, Margins, measure, pairwise, reasons

# z component given to a unit direction along x, small enough to drop out of its angle
_POLE = 1e-30


class Aim(NamedTuple):
    """Posture in which the panel's normal has a given direction; NaN where not valid.

    Attributes:
        angles: panel angles (phi, theta) (2, ...) [rad].
        strokes: heights of the rods' lower joints in the base's frame (2, ...) [m].
        displacements: displacements of the slider joints from the initial posture (2, ...) [m].
        reason: codes of `Reason` (...).
    """

    angles: Float[Array, "2 *s"]
    strokes: Float[Array, "2 *s"]
    displacements: Float[Array, "2 *s"]
    reason: Int[Array, "*s"]


def aim(
    geometry: TrackerGeometry,
    direction: Float[Array | np.ndarray, "3 *s"],
    limits: Limits,
    rods: Rods = RISING,
    *,
    throw: bool = True,
) -> Aim:
    """Panel angles and strokes that face a direction of any length in the base's axes.

    A single direction (3,) that is not in the workspace raises; a stack (3, ...), a call inside a
    transformation, or throw=False gives NaN and a reason code instead.

    Raises:
        StateError: a direction outside the workspace; the message says which limit it breaks, and
            by how much.

    Source: report Part II, Eq. 3.9, 3.13 and 3.20, corrected.
    """
    direction = jnp.asarray(direction, dtype=float)
    finite = jnp.all(jnp.isfinite(direction), axis=0)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(direction), axis=0))
    # the length drops out; scaling first avoids squares that overflow or underflow
    usable = finite & (largest > 0)
    n = direction / jnp.where(usable, largest, 1.0)
    # phi is not determined along x, and is taken as zero
    pole = (n[1] == 0) & (n[2] == 0)
    n = jnp.stack(
        [
            jnp.where(usable, n[0], 0.0),
            jnp.where(usable, n[1], 0.0),
            jnp.where(usable & ~pole, n[2], jnp.where(usable, _POLE, 1.0)),
        ]
    )
    turn = turn_by_direction(n)
    q, margins, _ = measure(geometry, limits, turn, rods)
    reason = reasons(margins, (~finite, Reason.NOT_FINITE), (~usable, Reason.ZERO_LENGTH))
    if throw and direction.ndim == 1 and concrete(geometry, direction, limits):
        _raise(geometry, direction, limits, margins, Reason(int(reason)))
    valid = reason == Reason.VALID
    keep = lambda x: jnp.where(valid, x, jnp.nan)
    return Aim(keep(panel_angles(n)), keep(q), keep(q - pairwise(limits.home, q)), reason)


def _raise(
    geometry: TrackerGeometry,
    direction: Array,
    limits: Limits,
    margins: Margins,
    reason: Reason,
) -> None:
    """Raise the `StateError` of one direction outside the workspace."""
    if reason == Reason.VALID:
        return
    shown = np.asarray(direction).tolist()
    if reason == Reason.NOT_FINITE:
        raise StateError(f"The direction to face must be finite, but it is {shown}.")
    if reason == Reason.ZERO_LENGTH:
        raise StateError("The direction to face has zero length; give any vector towards it.")
    raise StateError(
        f"The panel cannot face the direction {shown}: {why_outside(geometry, limits, margins, reason)}"
    )


def why_outside(geometry: TrackerGeometry, limits: Limits, margins: Margins, reason: Reason) -> str:
    """Text that says which limit of the workspace one posture breaks, and by how much."""
    if reason == Reason.TILT:
        limit, over = np.degrees(float(limits.tilt)), -np.degrees(float(margins.tilt))
        return (
            f"it is {limit + over:.4g} degrees from the base's z axis, {over:.3g} more than the "
            f"tilt limit of {limit:.4g}."
        )
    if reason == Reason.POST_ROOT:
        need = float(geometry.post) * np.sqrt(1 - float(margins.post))
        return (
            f"the post is {1e3 * float(geometry.post):.4g} mm long and would have to be longer than "
            f"{1e3 * need:.4g} mm (imaginary root)."
        )
    if reason in (Reason.ROD_2_ROOT, Reason.ROD_3_ROOT):
        k = reason - Reason.ROD_2_ROOT
        rod = float(np.asarray(geometry.rods)[k])
        need = rod * np.sqrt(1 - float(np.asarray(margins.rods)[k]))
        return (
            f"the rod of leg {k + 2} is {1e3 * rod:.4g} mm long and would have to be longer than "
            f"{1e3 * need:.4g} mm (imaginary root)."
        )
    if reason == Reason.SINGULAR:
        limit = float(limits.margin)
        found = float(margins.parallel) + limit
        where = "beyond" if found < 0 else "too near"
        return (
            f"the posture is {where} the singularity where the sliders do not hold the panel "
            f"(margin {found:.3g}, at least {limit:.3g} is needed)."
        )
    k = reason - Reason.STROKE_2
    below, above = float(np.asarray(margins.lower)[k]), float(np.asarray(margins.upper)[k])
    end, over = ("lower", below) if below < 0 else ("upper", above)
    limit = float(np.asarray(getattr(limits, end))[k])
    displacement = limit + over if end == "lower" else limit - over
    return (
        f"slider {k + 2} would have to stand at {1e3 * displacement:.4g} mm from its initial place, "
        f"{-1e3 * over:.3g} mm beyond its {end} stop at {1e3 * limit:.4g} mm."
    )
