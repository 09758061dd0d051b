"""Workspace of the panel: reach, stroke limits, and the two kinds of singularity.

A posture is in the workspace if post and rods reach it (real roots), the panel is tilted by at
most a limit, the sliders hold it (`parallel_margin` above a limit), and both strokes are within
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

Source: report Part II, chapter 3, gives the map and no limits; docs/geometry.md.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..algebra.compiler import kept_jit
from ..checks.errors import ModelError, check_finite, check_shape, concrete
from ..checks.numbers import floats
from ..checks.reason import first_reason
from ..checks.shapes import Numbers
from ..parameters.table import Parameters
from .geometry import (
    TrackerGeometry,
    Turn,
    check_closure,
    close_loops,
    initial_angles,
    tracker_geometry,
    turn_by_angles,
)
from .kinematics import RISING, Reason, Rods, loop_jacobian, panel_normal, strokes, strokes_of


class Limits(eqx.Module):
    """Limits of the workspace.

    Args:
        home: strokes at which the displacements are zero (2,) [m].
        lower, upper: limits of the displacements (2,) [m]; infinite for none.
        tilt: largest angle of the panel's normal from the base's z axis () [rad].
        margin: smallest `parallel_margin` ().

    Raises:
        ModelError: lower not below upper, a tilt outside (0, pi], a margin that is not finite.
    """

    home: Float[Array, "2"]
    lower: Float[Array, "2"]
    upper: Float[Array, "2"]
    tilt: Float[Array, ""]
    margin: Float[Array, ""]

    def __init__(
        self,
        *,
        home: Numbers,
        lower: Numbers = (-np.inf, -np.inf),
        upper: Numbers = (np.inf, np.inf),
        tilt: Numbers = np.pi / 3,
        margin: Numbers = 0.0,
    ) -> None:
        self.home = floats(home)
        self.lower = floats(lower)
        self.upper = floats(upper)
        self.tilt = floats(tilt)
        self.margin = floats(margin)
        for name in ("home", "lower", "upper"):
            check_shape(getattr(self, name), (2,), f"{name} of the workspace's limits")
        check_finite(self.home, "home of the workspace's limits", "m")
        check_finite(self.margin, "margin of the workspace's limits", "")
        if concrete(self.lower, self.upper) and not np.all(
            np.asarray(self.lower) < np.asarray(self.upper)
        ):
            raise ModelError(
                "The workspace's stroke limits must be lower < upper, but they are "
                f"{np.asarray(self.lower).tolist()} and {np.asarray(self.upper).tolist()} m."
            )
        if concrete(self.tilt) and not 0 < float(self.tilt) <= np.pi:
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


def pairwise(pair: Float[Array, "2"], like: Array) -> Float[Array, "2 *s"]:
    """Pair of limits with an axis of length one for each axis of a stack."""
    return pair.reshape(2, *(1,) * (like.ndim - 1))


def measure(
    geometry: TrackerGeometry, limits: Limits, turn: Turn, rods: Rods
) -> tuple[Float[Array, "2 *s"], Margins, Any]:
    """Strokes, margins, and the Jacobians of `loop_jacobian`."""
    loops = close_loops(geometry, turn)
    q = jnp.stack(strokes_of(geometry, loops, rods))
    rows = loop_jacobian(geometry, turn, loops, rods)
    (a, b), _ = rows
    determinant = (a[1] * b[0] - a[0] * b[1]) / (geometry.panel_arms[0] * geometry.panel_arms[1])
    displacements = q - pairwise(limits.home, q)
    across = jnp.sqrt(turn.sin_theta**2 + (turn.sin_phi * turn.cos_theta) ** 2)
    return (
        q,
        Margins(
            limits.tilt - jnp.arctan2(across, turn.cos_phi * turn.cos_theta),
            loops.post_square / geometry.post**2,
            jnp.stack([loops.squares[k] / geometry.rods[k] ** 2 for k in (0, 1)]),
            determinant - limits.margin,
            displacements - pairwise(limits.lower, q),
            pairwise(limits.upper, q) - displacements,
        ),
        rows,
    )


def reasons(margins: Margins, *before: tuple[Array, Reason]) -> Int[Array, "*s"]:
    """Reason code of the first broken limit, after other checks; a NaN margin counts as broken."""
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
    geometry: TrackerGeometry,
    angles: Float[Array | np.ndarray, "2 *s"],
    limits: Limits,
    rods: Rods = RISING,
) -> Survey:
    """Kinematics and margins at any postures (2, ...) [rad]; elementwise."""
    angles = jnp.asarray(angles)
    q, margins, ((a, b), c) = measure(geometry, limits, turn_by_angles(angles), rods)
    finite = jnp.isfinite(angles[0] + angles[1])
    return Survey(
        angles,
        panel_normal(angles),
        q,
        q - pairwise(limits.home, q),
        reasons(margins, (~finite, Reason.NOT_FINITE)),
        margins,
        _condition(a[0] / c[0], a[1] / c[0], b[0] / c[1], b[1] / c[1]),
    )


def _condition(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Condition number of [[a, b], [c, d]]; its squared singular values solve a quadratic."""
    squares, det = a * a + b * b + c * c + d * d, jnp.abs(a * d - b * c)
    spread = jnp.sqrt(jnp.maximum(squares - 2 * det, 0.0) * (squares + 2 * det))
    return (squares + spread) / (2 * det)


# --- grids over the whole workspace


def direction_grid(
    azimuths: Float[Array | np.ndarray, " n"], tilts: Float[Array | np.ndarray, " m"]
) -> Float[Array, "3 n m"]:
    """Unit vectors at azimuths from the base's x axis towards y and tilts from z, both [rad]."""
    azimuth, tilt = jnp.asarray(azimuths)[:, None], jnp.asarray(tilts)[None, :]
    level = jnp.sin(tilt)
    up = jnp.broadcast_to(jnp.cos(tilt), jnp.broadcast_shapes(azimuth.shape, tilt.shape))
    return jnp.stack([level * jnp.cos(azimuth), level * jnp.sin(azimuth), up])
