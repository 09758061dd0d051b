"""Constraint primitives: the rows of which joints are made, with exact derivatives.

Every primitive is written once, in terms of body-fixed vectors s = A s' whose second
derivative is linear in the body's rotational acceleration alpha:

    sddot = D alpha + c.

The first choice of alpha gives the report's tables, the second serves relative coordinates:

    form "omega":  alpha = d(omega')/dt,  D = -s~ A,      c = omega x (omega x s)
    form "world":  alpha = d(omega)/dt,   D = -s~,        c = omega x (omega x s)

Arrays have their components first; any further axes (primitives of a kind, states of a
batch) come last.

The rows satisfy J_i (a_i, alpha_i) + J_j (a_j, alpha_j) = gamma, with a the acceleration of
the centre of mass.

Source: report Part I, Table 4.1 (Part II, 4.2), corrected; Nikravesh (1988), ch. 7.
Derivation: docs/theory.md.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..math.rotation import cross, skew
from ..math.stacked import apply_matrix, apply_transposed, dot_product, multiply_matrices

Form = Literal["omega", "world"]

# Couplings of two joints' coordinates, each between bodies of its own: the dependent one and its mate.
COUPLINGS: dict[str, tuple[str, str]] = {
    f"{dependent}_by_{mate}": (dependent, mate)
    for dependent in ("angle", "displacement")
    for mate in ("angle", "displacement")
}

# Number of rows of each primitive: s,3  n1,1  n2,1  s-s,1, two drivers, the screw, the couplings.
ROWS: dict[str, int] = {
    "point": 3, "n1": 1, "n2": 1, "distance": 1, "angle": 1, "displacement": 1, "screw": 1,
    **dict.fromkeys(COUPLINGS, 1),
}  # fmt: skip

# Primitives whose rows are cosines or angles; the rows of all others are lengths.
ANGULAR = ("n1", "angle", "angle_by_angle", "angle_by_displacement")


class Data(eqx.Module):
    """Body-fixed parameters of one primitive (or a stack); a primitive reads the ones it needs.

    Attributes:
        point_i, point_j: points relative to the bodies' centres of mass, in body axes (3,) [m].
        axis_i, axis_j: unit vectors in body axes (3,).
        side_i: unit vector in body i, perpendicular to axis_i (3,); rotational drivers, screws.
        length: length of a rod [m], for "distance"; pitch [m/rad], for "screw".
    """

    point_i: Float[Array | np.ndarray, "3 *batch"]
    point_j: Float[Array | np.ndarray, "3 *batch"]
    axis_i: Float[Array | np.ndarray, "3 *batch"]
    axis_j: Float[Array | np.ndarray, "3 *batch"]
    side_i: Float[Array | np.ndarray, "3 *batch"]
    length: Float[Array | np.ndarray, "*batch"]


class BodyKinematics(eqx.Module):
    """Kinematics of one body (or a stack) in a constraint.

    Attributes:
        r, v: centre of mass and its velocity (3,) [m], [m/s].
        R_wb: body-to-world rotation (3, 3).
        omega_w: angular velocity in world axes (3,) [rad/s].
        velocity: v and the integral of alpha: (v, omega') or (v, omega) (6,).
    """

    r: Float[Array, "3 *batch"]
    v: Float[Array, "3 *batch"]
    R_wb: Float[Array, "3 3 *batch"]
    omega_w: Float[Array, "3 *batch"]
    velocity: Float[Array, "6 *batch"]


class BodyVector(eqx.Module):
    """World vector s with its derivatives: rate, and D and c of sddot = D alpha + c."""

    s: Float[Array, "3 *batch"]
    rate: Float[Array, "3 *batch"]
    D: Float[Array, "3 3 *batch"]
    c: Float[Array, "3 *batch"]


class Row(eqx.Module):
    """Rows of one primitive between bodies i and j.

    Attributes:
        value: constraint function Phi (k,).
        target: right-hand side at velocity level, J qdot = target (k,).
        J_i, J_j: Jacobian blocks (k, 6), linear part first.
        gamma: right-hand side at acceleration level (k,).
        J_mate: blocks of the bodies i and j of the mate of a coupling; else none.
    """

    value: Float[Array, "k *batch"]
    target: Float[Array, "k *batch"]
    J_i: Float[Array, "k 6 *batch"]
    J_j: Float[Array, "k 6 *batch"]
    gamma: Float[Array, "k *batch"]
    J_mate: tuple[Float[Array, "k 6 *batch"], ...] = ()

    @property
    def blocks(self) -> tuple[Float[Array, "k 6 *batch"], ...]:
        """Jacobian blocks of all bodies of a row, two or four."""
        return (self.J_i, self.J_j, *self.J_mate)


def vector_jet(
    body: BodyKinematics, fixed: Float[Array | np.ndarray, "3 *batch"], form: Form
) -> BodyVector:
    """World vector with derivatives of a vector fixed in a body, `fixed` in body axes (3,)."""
    s = apply_matrix(body.R_wb, fixed)
    rate = cross(body.omega_w, s)
    D = -skew(s) if form == "world" else multiply_matrices(body.R_wb, -skew(fixed))
    return BodyVector(s, rate, D, cross(body.omega_w, rate))


def _join_blocks(
    linear: Float[Array, "k 3 *batch"], angular: Float[Array, "k w *batch"]
) -> Float[Array, "k w+3 *batch"]:
    return jnp.concatenate([linear, angular], axis=1)


def _make_row(
    value: Float[Array, "k *batch"],
    J_i: Float[Array, "k w *batch"],
    J_j: Float[Array, "k w *batch"],
    gamma: Float[Array, "k *batch"],
) -> Row:
    return Row(value, jnp.zeros_like(value), J_i, J_j, gamma)


def point_rows(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Coincident points, s,3: r_i + s_i^P - r_j - s_j^P = 0."""
    a, b = vector_jet(i, data.point_i, form), vector_jet(j, data.point_j, form)
    eye = jnp.broadcast_to(
        jnp.eye(3, dtype=a.s.dtype).reshape(3, 3, *(1,) * (a.s.ndim - 1)), (3, *a.s.shape)
    )
    value = (i.r + a.s) - (j.r + b.s)
    return _make_row(value, _join_blocks(eye, a.D), _join_blocks(-eye, -b.D), b.c - a.c)


def n1_row(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Perpendicular body-fixed vectors, n1,1: s_i . s_j = 0."""
    return _dot_row(vector_jet(i, data.axis_i, form), vector_jet(j, data.axis_j, form))


def _dot_row(a: BodyVector, b: BodyVector) -> Row:
    none = jnp.zeros_like(a.s)[None]
    gamma = -(dot_product(a.s, b.c) + dot_product(b.s, a.c) + 2 * dot_product(a.rate, b.rate))
    return _make_row(
        dot_product(a.s, b.s)[None],
        _join_blocks(none, apply_transposed(a.D, b.s)[None]),
        _join_blocks(none, apply_transposed(b.D, a.s)[None]),
        gamma[None],
    )


def _arm_jets(
    i: BodyKinematics, j: BodyKinematics, data: Data, form: Form
) -> tuple[BodyVector, BodyVector, tuple[Array, ...]]:
    """Arms to both points, and the vector d from the point on i to that on j with rate and c."""
    a, b = vector_jet(i, data.point_i, form), vector_jet(j, data.point_j, form)
    d = (j.r + b.s) - (i.r + a.s)
    d_rate = (j.v + b.rate) - (i.v + a.rate)
    return a, b, (d, d_rate, b.c - a.c)


def n2_row(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Vector perpendicular to d, n2,1: s_i . d = 0, d from the point on i to the point on j.

    The value s_i . d is the displacement along the axis, from which a driver subtracts its motion.
    """
    a = vector_jet(i, data.axis_i, form)
    arm_i, arm_j, (d, d_rate, d_c) = _arm_jets(i, j, data, form)
    gamma = -(dot_product(a.s, d_c) + dot_product(d, a.c) + 2 * dot_product(a.rate, d_rate))
    return _make_row(
        dot_product(a.s, d)[None],
        _join_blocks(-a.s[None], (apply_transposed(a.D, d) - apply_transposed(arm_i.D, a.s))[None]),
        _join_blocks(a.s[None], apply_transposed(arm_j.D, a.s)[None]),
        gamma[None],
    )


def distance(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Constant distance of two points, s-s,1: d . d - l^2 = 0."""
    arm_i, arm_j, (d, d_rate, d_c) = _arm_jets(i, j, data, form)
    # Right side of J a = gamma: the terms of the second derivative without accelerations.
    gamma = -2 * (dot_product(d, d_c) + dot_product(d_rate, d_rate))
    return _make_row(
        (dot_product(d, d) - data.length**2)[None],
        2 * _join_blocks(-d[None], -apply_transposed(arm_i.D, d)[None]),
        2 * _join_blocks(d[None], apply_transposed(arm_j.D, d)[None]),
        gamma[None],
    )


def driven_angle_row(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Angle from s_i to s_j, positive towards side_i, in (-pi, pi]; the row of a driver.

    With a = s_i . s_j and b = side_i . s_j, both n1 rows: phi = atan2(b, a).
    """
    moving = vector_jet(j, data.axis_j, form)
    A = _dot_row(vector_jet(i, data.axis_i, form), moving)
    B = _dot_row(vector_jet(i, data.side_i, form), moving)
    a, b = A.value, B.value
    rate = lambda row: apply_matrix(row.J_i, i.velocity) + apply_matrix(row.J_j, j.velocity)
    a_rate, b_rate = rate(A), rate(B)
    # Derivatives of the arc tangent hold for a and b of any common length, so that side and axis need not
    # stay exact.
    square = a * a + b * b
    twist = 2 * (a * a_rate + b * b_rate) * (a * b_rate - b * a_rate) / square**2
    return _make_row(
        jnp.arctan2(b, a),
        (a[:, None] * B.J_i - b[:, None] * A.J_i) / square[:, None],
        (a[:, None] * B.J_j - b[:, None] * A.J_j) / square[:, None],
        (a * B.gamma - b * A.gamma) / square + twist,
    )


def screw(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Displacement s_i . d minus the pitch times the angle from side_i to s_j about s_i.

    The angle is known up to whole turns, and the value thus up to their displacement; the value
    nearest to zero is taken. `axis_j` is perpendicular to the axis of the screw.
    """
    h: Any = data.length
    displacement_row = n2_row(i, j, data, form)
    across = cross(data.axis_i, data.side_i)
    twisted = dataclasses.replace(data, axis_i=data.side_i, side_i=across)
    angle_row = driven_angle_row(i, j, twisted, form)
    angle_error = displacement_row.value / h - angle_row.value
    return _make_row(
        # An angle is known up to whole turns; of the displacement's turns only the fraction is compared.
        h * jnp.arctan2(jnp.sin(angle_error), jnp.cos(angle_error)),
        displacement_row.J_i - h * angle_row.J_i,
        displacement_row.J_j - h * angle_row.J_j,
        displacement_row.gamma - h * angle_row.gamma,
    )


def couple(dependent: Row, mate: Row, ratio: Any, offset: Any, period: Any) -> Row:
    """Coupling of two coordinates, x_b - ratio x_a - offset = 0, from their rows.

    Angles are known up to whole turns, and the value thus up to multiples of a period; the value nearest to
    zero is taken. An infinite period leaves it as it is.
    """
    value = dependent.value - ratio * mate.value - offset
    finite = jnp.isfinite(period)
    step = jnp.where(finite, period, 1.0)
    return Row(
        value - jnp.where(finite, step * jnp.round(value / step), 0.0),
        jnp.zeros_like(value),
        dependent.J_i,
        dependent.J_j,
        dependent.gamma - ratio * mate.gamma,
        (-ratio * mate.J_i, -ratio * mate.J_j),
    )


PRIMITIVES: dict[str, Callable[[BodyKinematics, BodyKinematics, Data, Form], Row]] = {
    "point": point_rows, "n1": n1_row, "n2": n2_row,
    "distance": distance, "angle": driven_angle_row, "displacement": n2_row,
    "screw": screw,
}  # fmt: skip
