"""Workspace of the panel: reach, stroke limits, and the two kinds of singularity.

A posture is in the workspace if post and rods reach it (real roots), the panel is tilted by at
most a limit, the sliders hold it (the margin `parallel` above a limit), and both strokes are within
their stops. Reason codes name the first of these that fails.

Strokes are measured from two zeros. `strokes` are heights in the base's frame; `displacements` are the
displacements that slider joints, servos and end stops measure, zero at the table's initial
posture: displacements = strokes - limits.home. Limits of the strokes ("stop." in a table) are
displacements.

Three margins measure the distance from singularities:

    rods      c_i^2 = 1 - (horizontal span / L_i)^2, the squared sine of the rod's elevation; zero
              where a rod is level and its slider cannot set the panel (inverse map)
    post      cos^2 gamma, zero where the post lies flat
    parallel  det A / (b_2 b_3), zero where held sliders do not hold the panel (forward map),
              negative beyond; A: `loop_jacobian`

All are smooth up to and through zero except `parallel`, which needs the roots.

Source: report Part II, chapter 3, gives the map and no limits; docs/report_machine.md.

Pointing finds angles and strokes that face a direction, or the reason against it. Where a direction leaves the
workspace, the posture of the nearest reachable one is searched on ever finer patterns: there is no simple boundary.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...checks.errors import (
    ModelError,
    StateError,
    check_finite,
    check_shape,
    first_reason,
    has_values,
)
from ...checks.numbers import as_floats
from ...math.compiler import in_blocks, kept_jit, quick_jit
from ...mechanics.parameters import Parameters
from .geometry import (
    TrackerGeometry,
    Turn,
    check_closure,
    close_loops,
    initial_angles,
    tracker_geometry,
    turn_by_angles,
)
from .kinematics import (
    Reason,
    loop_jacobian,
    panel_angles,
    panel_normal,
    strokes,
    strokes_of,
    turn_by_direction,
)


class Limits(eqx.Module):
    """Limits of the workspace.

    Args:
        home: strokes at which the displacements are zero (2,) [m].
        lower, upper: limits of the displacements (2,) [m]; infinite for none.
        tilt: largest angle of the panel's normal from the base's z axis () [rad].
        margin: smallest margin `parallel` ().

    Raises:
        ModelError: lower not below upper, a tilt outside (0, pi], a margin that is not finite.
    """

    home: Float[Array, "2"] = eqx.field(converter=as_floats)
    lower: Float[Array, "2"] = eqx.field(converter=as_floats, default=(-np.inf, -np.inf))
    upper: Float[Array, "2"] = eqx.field(converter=as_floats, default=(np.inf, np.inf))
    tilt: Float[Array, ""] = eqx.field(converter=as_floats, default=np.pi / 3)
    margin: Float[Array, ""] = eqx.field(converter=as_floats, default=0.0)

    def __check_init__(self) -> None:
        for name in ("home", "lower", "upper"):
            check_shape(getattr(self, name), (2,), f"{name} of the workspace's limits")
        check_finite(self.home, "home of the workspace's limits", "m")
        check_finite(self.margin, "margin of the workspace's limits", "")
        if has_values(self.lower, self.upper) and not np.all(
            np.asarray(self.lower) < np.asarray(self.upper)
        ):
            raise ModelError(
                "The workspace's stroke limits must be lower < upper, but they are "
                f"{np.asarray(self.lower).tolist()} and {np.asarray(self.upper).tolist()} m."
            )
        if has_values(self.tilt) and not 0 < float(self.tilt) <= np.pi:
            raise ModelError(
                f"The workspace's tilt limit must be in (0, pi], but it is {float(self.tilt)} rad."
            )


def tracker_limits(parameters: Parameters) -> Limits:
    """Limits of the workspace from a table's "stop." and "workspace." lines.

    Displacements are zero at the table's initial posture.

    Raises:
        ModelError: numbers that `Limits` refuses, or lengths that cannot be assembled.
    """
    geometry, angles = tracker_geometry(parameters), initial_angles(parameters)
    check_closure(geometry, angles)
    return Limits(
        home=kept_jit(strokes)(geometry, angles),
        lower=parameters.value("stop.lower"),
        upper=parameters.value("stop.upper"),
        tilt=parameters.value("workspace.tilt"),
        margin=parameters.value("workspace.margin"),
    )


# --- margins


class Margins(NamedTuple):
    """Signed distances from the limits of the workspace, positive inside; each (...).

    Attributes:
        tilt: limit less tilt [rad].
        post: cos^2 gamma.
        rods: c_i^2 (2, ...).
        parallel: det A / (b_2 b_3) less its limit.
        lower, upper: distances of the sliders from their stops (2, ...) [m].
    """

    tilt: Float[Array, "*s"]
    post: Float[Array, "*s"]
    rods: Float[Array, "2 *s"]
    parallel: Float[Array, "*s"]
    lower: Float[Array, "2 *s"]
    upper: Float[Array, "2 *s"]


class Survey(NamedTuple):
    """Kinematics and margins of postures, inside or outside the workspace.

    Attributes:
        angles: panel angles (phi, theta) (2, ...) [rad].
        normal: normal of the panel, base axes (3, ...).
        strokes: heights of the rods' lower joints (2, ...) [m].
        displacements: displacements of the slider joints (2, ...) [m].
        reason: codes of `Reason` (...); 0 is in the workspace.
        margins: signed distances from each limit; NaN where roots are imaginary.
        condition: condition number of d strokes / d angles (...), infinite at a singularity.

    Only `reason` decides: numbers are given wherever they exist, outside the limits too.
    """

    angles: Float[Array, "2 *s"]
    normal: Float[Array, "3 *s"]
    strokes: Float[Array, "2 *s"]
    displacements: Float[Array, "2 *s"]
    reason: Int[Array, "*s"]
    margins: Margins
    condition: Float[Array, "*s"]


def align_pair(pair: Float[Array, "2"], like: Array) -> Float[Array, "2 *s"]:
    """Pair of limits with an axis of length one for each axis of a stack."""
    return pair.reshape(2, *(1,) * (like.ndim - 1))


def measure(
    geometry: TrackerGeometry, limits: Limits, turn: Turn
) -> tuple[Float[Array, "2 *s"], Margins, Any]:
    """Strokes, margins, and the Jacobians of `loop_jacobian`."""
    loops = close_loops(geometry, turn)
    q = jnp.stack(strokes_of(geometry, loops))
    rows = loop_jacobian(geometry, turn, loops)
    (a, b), _ = rows
    # Divided by the arms, the determinant has no unit, and one margin holds for any size of tracker.
    determinant = (a[1] * b[0] - a[0] * b[1]) / (geometry.panel_arms[0] * geometry.panel_arms[1])
    home, lower, upper = (align_pair(pair, q) for pair in (limits.home, limits.lower, limits.upper))
    displacements = q - home
    horizontal_length = jnp.sqrt(turn.sin_theta**2 + (turn.sin_phi * turn.cos_theta) ** 2)
    # The arc tangent keeps its digits near zero tilt, where an arc cosine loses half of them.
    tilt = jnp.arctan2(horizontal_length, turn.cos_phi * turn.cos_theta)
    post = loops.post_square / geometry.post**2
    rods = jnp.stack([loops.squares[k] / geometry.rods[k] ** 2 for k in (0, 1)])
    margins = Margins(
        limits.tilt - tilt, post, rods, determinant - limits.margin, displacements - lower,
        upper - displacements,
    )  # fmt: skip
    return q, margins, rows


def reasons(margins: Margins, *before: tuple[Array, Reason]) -> Int[Array, "*s"]:
    """Reason code of the first broken limit, after other checks; a NaN margin counts as broken."""
    # Negated comparisons: a NaN fails each of them, and counts as outside.
    stroke = jnp.minimum(margins.lower, margins.upper)
    return first_reason(
        *before,
        (~(margins.tilt >= 0), Reason.TILT),
        (~(margins.post > 0), Reason.POST_ROOT),
        (~(margins.rods[0] > 0), Reason.ROD_2_ROOT),
        (~(margins.rods[1] > 0), Reason.ROD_3_ROOT),
        (~(margins.parallel > 0), Reason.SINGULAR),
        (~(stroke[0] >= 0), Reason.STROKE_2),
        (~(stroke[1] >= 0), Reason.STROKE_3),
    )


def survey(
    geometry: TrackerGeometry, angles: Float[Array | np.ndarray, "2 *s"], limits: Limits
) -> Survey:
    """Kinematics and margins at any postures (2, ...) [rad]; elementwise."""
    angles = jnp.asarray(angles)
    q, margins, ((a, b), c) = measure(geometry, limits, turn_by_angles(angles))
    reason = reasons(margins, (~jnp.isfinite(angles[0] + angles[1]), Reason.NOT_FINITE))
    displacements = q - align_pair(limits.home, q)
    # condition number of the matrix of strokes by angles: its squared singular values solve a quadratic
    a, b, c, d = a[0] / c[0], a[1] / c[0], b[0] / c[1], b[1] / c[1]
    squares, det = a * a + b * b + c * c + d * d, jnp.abs(a * d - b * c)
    spread = jnp.sqrt(jnp.maximum(squares - 2 * det, 0.0) * (squares + 2 * det))
    condition = (squares + spread) / (2 * det)
    return Survey(angles, panel_normal(angles), q, displacements, reason, margins, condition)


# --- grids over the whole workspace


def direction_grid(
    azimuths: Float[Array | np.ndarray, " n"], tilts: Float[Array | np.ndarray, " m"]
) -> Float[Array, "3 n m"]:
    """Unit vectors at azimuths from the base's x axis towards y and tilts from z, both [rad]."""
    azimuth, tilt = jnp.asarray(azimuths)[:, None], jnp.asarray(tilts)[None, :]
    level = jnp.sin(tilt)
    up = jnp.broadcast_to(jnp.cos(tilt), jnp.broadcast_shapes(azimuth.shape, tilt.shape))
    return jnp.stack([level * jnp.cos(azimuth), level * jnp.sin(azimuth), up])


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
    *,
    throw: bool = True,
) -> Aim:
    """Panel angles and strokes that face a direction of any length in the base's axes.

    A single direction (3,) that is not in the workspace raises; a stack (3, ...), a call inside a
    transformation, or throw=False gives NaN and a reason code instead.

    Raises:
        StateError: a direction outside the workspace; the message says which limit it exceeds, and by how much.

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
    z = jnp.where(usable & ~pole, n[2], jnp.where(usable, _POLE, 1.0))
    n = jnp.stack([jnp.where(usable, n[0], 0.0), jnp.where(usable, n[1], 0.0), z])
    q, margins, _ = measure(geometry, limits, turn_by_direction(n))
    reason = reasons(margins, (~finite, Reason.NOT_FINITE), (~usable, Reason.ZERO_LENGTH))
    if throw and direction.ndim == 1 and has_values(geometry, direction, limits):
        code, components = Reason(int(reason)), np.asarray(direction).tolist()
        if code == Reason.NOT_FINITE:
            raise StateError(f"The direction to face must be finite, but it is {components}.")
        if code == Reason.ZERO_LENGTH:
            raise StateError("The direction to face has zero length; give any vector towards it.")
        if code != Reason.VALID:
            explanation = why_outside(geometry, limits, margins, code)
            raise StateError(f"The panel cannot face the direction {components}: {explanation}")
    valid = reason == Reason.VALID
    keep = lambda x: jnp.where(valid, x, jnp.nan)
    return Aim(keep(panel_angles(n)), keep(q), keep(q - align_pair(limits.home, q)), reason)


def why_outside(geometry: TrackerGeometry, limits: Limits, margins: Margins, reason: Reason) -> str:
    """Text that names the limit of the workspace that a posture exceeds, and by how much."""
    if reason == Reason.TILT:
        limit, excess = np.degrees(float(limits.tilt)), -np.degrees(float(margins.tilt))
        return (
            f"it is {limit + excess:.4g} degrees from the base's z axis, {excess:.3g} more than the "
            f"tilt limit of {limit:.4g}."
        )
    if reason == Reason.POST_ROOT:
        needed_length = float(geometry.post) * np.sqrt(1 - float(margins.post))
        return (
            f"the post is {1e3 * float(geometry.post):.4g} mm long and would have to be longer than "
            f"{1e3 * needed_length:.4g} mm (imaginary root)."
        )
    if reason in (Reason.ROD_2_ROOT, Reason.ROD_3_ROOT):
        k = reason - Reason.ROD_2_ROOT
        rod = float(np.asarray(geometry.rods)[k])
        needed_length = rod * np.sqrt(1 - float(np.asarray(margins.rods)[k]))
        return (
            f"the rod of leg {k + 2} is {1e3 * rod:.4g} mm long and would have to be longer than "
            f"{1e3 * needed_length:.4g} mm (imaginary root)."
        )
    if reason == Reason.SINGULAR:
        limit = float(limits.margin)
        margin = float(margins.parallel) + limit
        where = "beyond" if margin < 0 else "too near"
        return (
            f"the posture is {where} the singularity where the sliders do not hold the panel "
            f"(margin {margin:.3g}, at least {limit:.3g} is needed)."
        )
    k = reason - Reason.STROKE_2
    end = "lower" if float(np.asarray(margins.lower)[k]) < 0 else "upper"
    excess, limit = (float(np.asarray(getattr(part, end))[k]) for part in (margins, limits))
    displacement = limit + excess if end == "lower" else limit - excess
    return (
        f"slider {k + 2} would have to stand at {1e3 * displacement:.4g} mm from its initial place, "
        f"{-1e3 * excess:.3g} mm beyond its {end} stop at {1e3 * limit:.4g} mm."
    )


_COARSE = np.radians(0.5)
_BLOCK = 32  # directions refined in one call, so that all calls share one program
_FINER, _SIZES, _AGAIN = 4.0, 6, 20  # ratio of pattern sizes, their number, and repetitions of each


def _steps(count: int, ratio: float) -> Float[np.ndarray, " k"]:
    """Geometric sequence of offsets -1, ..., 0, ..., 1, each a ratio smaller than the last."""
    steps = ratio ** -np.arange(count)
    return np.concatenate([-steps, [0.0], steps[::-1]])


# Offsets along the boundary and towards the direction. At the best posture the boundary is normal
# to the gradient, and a smooth one departs from its tangent by the square of the offset only:
# the steps towards the direction therefore go down to very small ones.
_ALONG, _TOWARDS = (part.reshape(-1, 1) for part in np.meshgrid(_steps(3, 2.0), _steps(6, 4.0)))


class ReachableGrid(NamedTuple):
    """Reachable postures of a grid of half a degree.

    Attributes:
        angles: panel angles (phi, theta) (2, m) [rad].
        normals: normals of the panel, base axes (3, m).
    """

    angles: Float[np.ndarray, "2 m"]
    normals: Float[np.ndarray, "3 m"]


def _inside(
    geometry: TrackerGeometry, limits: Limits, angles: Float[Array, "2 *s"]
) -> Bool[Array, "*s"]:
    return survey(geometry, angles, limits).reason == Reason.VALID


@quick_jit
def _surveyed(
    geometry: TrackerGeometry, limits: Limits, angles: Float[Array, "2 n"]
) -> tuple[Bool[Array, " n"], Float[Array, "3 n"]]:
    return _inside(geometry, limits, angles), panel_normal(angles)


def reachable_grid(geometry: TrackerGeometry, limits: Limits) -> ReachableGrid:
    """Reachable postures of a grid of half a degree, with their normals.

    Raises:
        ModelError: no posture is reachable.
    """
    # The grid is only a start: it must find the right one of several local maxima.
    phi = np.arange(-np.pi / 2, np.pi / 2 + 1e-9, _COARSE)
    grid = np.stack(np.meshgrid(phi, phi)).reshape(2, -1)
    inside, normals = map(np.asarray, _surveyed(geometry, limits, grid))
    if not np.any(inside):
        raise ModelError(
            "The tracker reaches no posture with these lengths and limits of strokes: widen the limits "
            "or change the lengths."
        )
    return ReachableGrid(grid[:, inside], normals[:, inside])


def nearest_reachable(
    geometry: TrackerGeometry,
    directions_b: Float[np.ndarray, "3 n"],
    limits: Limits,
    grid: ReachableGrid | None = None,
) -> Float[np.ndarray, "2 n"]:
    """Postures of the workspace whose normals are nearest to directions, to 0.001 degrees.

    Args:
        directions_b: unit vectors in the base's axes (3, n).
        grid: `reachable_grid` of the same tracker and limits, if there is one already.

    Returns:
        panel angles (phi, theta) (2, n) [rad].

    Raises:
        ModelError: the workspace is empty.
    """
    if directions_b.shape[1] == 0:
        return np.zeros((2, 0))
    grid = reachable_grid(geometry, limits) if grid is None else grid
    # rows of the product are contiguous, in which the largest number is found ten times as fast
    grid_angles = grid.angles[:, np.argmax(directions_b.T @ grid.normals, axis=1)]
    refine_block = lambda rows, start: np.asarray(_refine(geometry, limits, rows.T, start.T)).T
    return in_blocks(refine_block, _BLOCK, directions_b.T, grid_angles.T).T


@quick_jit
def _refine(
    geometry: TrackerGeometry, limits: Limits, directions_b: Array, start: Array
) -> Float[Array, "2 n"]:
    """Refine postures by a pattern search_pattern: the best of 91 around each, on ever finer patterns."""

    closeness = lambda angles: jnp.sum(panel_normal(angles) * directions_b, axis=0)

    def search_pattern(count: int | Array, best: Array) -> Array:
        value, pull = jax.vjp(closeness, best)
        (slope,) = pull(jnp.ones_like(value))
        uphill = slope / jnp.maximum(jnp.linalg.norm(slope, axis=0), 1e-12)
        tangent = jnp.stack([-uphill[1], uphill[0]])
        size = _COARSE * _FINER ** -jnp.floor(count / _AGAIN)
        offsets = _ALONG * tangent[:, None] + _TOWARDS * uphill[:, None]
        candidates = best[:, None] + size * offsets
        close = jnp.sum(panel_normal(candidates) * directions_b[:, None], axis=0)
        # A pattern search needs no derivative of the boundary, which has corners where two limits meet.
        close = jnp.where(_inside(geometry, limits, candidates), close, -jnp.inf)
        return jnp.take_along_axis(candidates, jnp.argmax(close, axis=0)[None, None], axis=1)[:, 0]

    # A fixed number of rounds gives the same work to each direction of a block.
    return jax.lax.fori_loop(0, _SIZES * _AGAIN, search_pattern, start)
