"""Where the panel can point: reach, stroke limits, and the two kinds of singularity.

A posture is in the workspace if post and rods reach it (real roots), the panel is tilted by at
most a limit, the sliders hold it (`parallel_margin` above a limit), and both strokes are within
their stops. Reason codes name the first of these that fails.

Strokes here have two zeros. `strokes` are heights in the base's frame; `shifts` are what slider
joints, servos and end stops measure, zero at the table's initial posture:
shifts = strokes - limits.home. Limits of the strokes ("stop." in a table) are shifts.

How far a singularity is:

    rods      c_i^2 = 1 - (sideways span / L_i)^2, the squared sine of the rod's elevation; zero
              where a rod is level and its slider cannot set the panel (the inverse map's)
    post      cos^2 gamma, zero where the post lies flat
    parallel  det A / (b_2 b_3), zero where held sliders do not hold the panel (the forward
              map's), negative beyond; A: `loop_jacobian`

All are smooth up to and through zero but for `parallel`, which needs the roots.

Source: report Part II, chapter 3, gives the map and no limits; docs/geometry.md.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..algebra.shapes import Numbers
from ..mechanics.errors import ModelError, check_finite, check_shape, concrete
from ..mechanics.reason import first_reason
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
    RISING,
    Reason,
    Rods,
    loop_jacobian,
    panel_angles,
    panel_normal,
    parallel_margin,
    strokes,
    strokes_of,
)
from .parameters import Parameters


class Limits(eqx.Module):
    """What bounds the workspace.

    Args:
        home: strokes at which the shifts are zero (2,) [m].
        lower, upper: of the shifts (2,) [m]; infinite for none.
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
        self.home = jnp.asarray(home, dtype=float)
        self.lower = jnp.asarray(lower, dtype=float)
        self.upper = jnp.asarray(upper, dtype=float)
        self.tilt = jnp.asarray(tilt, dtype=float)
        self.margin = jnp.asarray(margin, dtype=float)
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
    """The limits of a table: its "stop." and "workspace." lines, zero at its initial posture.

    Raises:
        ModelError: numbers that `Limits` refuses, or lengths that cannot be assembled.
    """
    geometry, angles = tracker_geometry(parameters), initial_angles(parameters)
    check_closure(geometry, angles)
    return Limits(
        home=strokes(geometry, angles),
        lower=parameters.value("stop.lower"),
        upper=parameters.value("stop.upper"),
        tilt=parameters.value("workspace.tilt"),
        margin=parameters.value("workspace.margin"),
    )


# --- how far from what


class Margins(NamedTuple):
    """Signed distances from what bounds the workspace, positive inside; each (...).

    Attributes:
        tilt: limit less tilt [rad].
        post: cos^2 gamma. rods: c_i^2 (2, ...). parallel: det A / (b_2 b_3), less the limit.
        lower, upper: strokes from their stops (2, ...) [m].
    """

    tilt: Float[Array, "*s"]
    post: Float[Array, "*s"]
    rods: Float[Array, "2 *s"]
    parallel: Float[Array, "*s"]
    lower: Float[Array, "2 *s"]
    upper: Float[Array, "2 *s"]


class Survey(NamedTuple):
    """What the workspace's map says of postures.

    Attributes:
        angles: (phi, theta) (2, ...) [rad]. normal: of the panel, base axes (3, ...).
        strokes, shifts: heights, and what slider joints measure (2, ...) [m].
        reason: codes of `Reason` (...); 0 is in the workspace.
        margins: signed distances from each limit; NaN where roots are imaginary.
        condition: of d strokes / d angles (...), 1 at best, infinite at a singularity.

    Only `reason` decides: numbers are given wherever they exist, outside the limits too.
    """

    angles: Float[Array, "2 *s"]
    normal: Float[Array, "3 *s"]
    strokes: Float[Array, "2 *s"]
    shifts: Float[Array, "2 *s"]
    reason: Int[Array, "*s"]
    margins: Margins
    condition: Float[Array, "*s"]


def pairwise(pair: Float[Array, "2"], like: Array) -> Float[Array, "2 *s"]:
    """A pair of limits with axes of length one for those of a stack."""
    return pair.reshape(2, *(1,) * (like.ndim - 1))


def measure(
    geometry: TrackerGeometry, limits: Limits, turn: Turn, rods: Rods
) -> tuple[Float[Array, "2 *s"], Margins, Any]:
    """Strokes, margins and the rows of `loop_jacobian`."""
    loops = close_loops(geometry, turn)
    q = jnp.stack(strokes_of(geometry, loops, rods))
    rows = loop_jacobian(geometry, turn, loops, rods)
    (a, b), _ = rows
    determinant = (a[1] * b[0] - a[0] * b[1]) / (geometry.panel_arms[0] * geometry.panel_arms[1])
    shifts = q - pairwise(limits.home, q)
    across = jnp.sqrt(turn.sin_theta**2 + (turn.sin_phi * turn.cos_theta) ** 2)
    return (
        q,
        Margins(
            limits.tilt - jnp.arctan2(across, turn.cos_phi * turn.cos_theta),
            loops.post_square / geometry.post**2,
            jnp.stack([loops.squares[k] / geometry.rods[k] ** 2 for k in (0, 1)]),
            determinant - limits.margin,
            shifts - pairwise(limits.lower, q),
            pairwise(limits.upper, q) - shifts,
        ),
        rows,
    )


def reasons(margins: Margins, *before: tuple[Array, Reason]) -> Int[Array, "*s"]:
    """The first limit that margins break; other checks may go before. NaN counts as broken."""
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
    """The workspace's map at any postures (2, ...) [rad]; elementwise."""
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
    """Ratio of the singular values of [[a, b], [c, d]]: both roots of one quadratic."""
    squares, det = a * a + b * b + c * c + d * d, jnp.abs(a * d - b * c)
    spread = jnp.sqrt(jnp.maximum(squares - 2 * det, 0.0) * (squares + 2 * det))
    return (squares + spread) / (2 * det)


def angle_to_singularity(
    geometry: TrackerGeometry, angles: Float[Array, "2 *s"], rods: Rods = RISING
) -> Float[Array, "*s"]:
    """Angle in (phi, theta) to the parallel singularity [rad], to first order and signed.

    D / |grad D| of D = `parallel_margin`: positive on the level panel's side, exact as it goes
    to zero. Differentiable.
    """

    def margin(phi: Array, theta: Array) -> Array:
        turn = turn_by_angles(jnp.stack([phi, theta]))
        return parallel_margin(geometry, turn, close_loops(geometry, turn), rods)

    phi, theta = angles[0], angles[1]
    one, none = jnp.ones_like(phi), jnp.zeros_like(phi)
    value, along_phi = jax.jvp(margin, (phi, theta), (one, none))
    _, along_theta = jax.jvp(margin, (phi, theta), (none, one))
    return value / jnp.sqrt(along_phi**2 + along_theta**2)


# --- over the whole workspace


def direction_grid(
    azimuths: Float[Array | np.ndarray, " n"], tilts: Float[Array | np.ndarray, " m"]
) -> Float[Array, "3 n m"]:
    """Unit vectors at azimuths from the base's x axis towards y and tilts from z, both [rad]."""
    azimuth, tilt = jnp.asarray(azimuths)[:, None], jnp.asarray(tilts)[None, :]
    level = jnp.sin(tilt)
    up = jnp.broadcast_to(jnp.cos(tilt), jnp.broadcast_shapes(azimuth.shape, tilt.shape))
    return jnp.stack([level * jnp.cos(azimuth), level * jnp.sin(azimuth), up])


def largest_tilts(
    geometry: TrackerGeometry,
    azimuths: Float[Array | np.ndarray, " n"],
    limits: Limits,
    rods: Rods = RISING,
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """How far the panel tilts towards each azimuth from level before it first leaves the workspace.

    Steps of half a degree, then bisection to 1e-12 rad.

    Args:
        azimuths: from the base's x axis towards y (n,) [rad].

    Returns:
        tilts (n,) [rad], zero where level is not in the workspace, and the codes of `Reason` of
        what ends them.
    """
    azimuths = jnp.asarray(azimuths)

    def codes(tilts: Array) -> Array:
        level = jnp.sin(tilts)
        n = jnp.stack([level * jnp.cos(azimuths), level * jnp.sin(azimuths), jnp.cos(tilts)])
        return survey(geometry, panel_angles(n), limits, rods).reason

    steps = jnp.linspace(0.0, jnp.pi, 361)
    outside = jax.vmap(lambda tilt: codes(jnp.full_like(azimuths, tilt)) != 0)(steps)
    first = jnp.argmax(outside, axis=0)
    low, high = steps[jnp.maximum(first - 1, 0)], steps[first]

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        inside = codes(middle) == 0
        return jnp.where(inside, middle, ends[0]), jnp.where(inside, ends[1], middle)

    low, high = jax.lax.fori_loop(0, 34, halve, (low, high))
    return low, codes(high)
