"""Constraint primitives: the rows of which joints are made, with exact derivatives.

Every primitive is written once, in terms of body-fixed vectors s = A s' whose second
derivative is linear in the body's rotational acceleration alpha:

    sddot = D alpha + c.

The first two choices of alpha give the report's two sets of tables from the same code, the
third serves relative coordinates:

    form "omega":  alpha = d(omega')/dt,  D = -s~ A,      c = omega x (omega x s)
    form "p":      alpha = pddot,         D = 2 G bar(s'), c = 2 Gdot Ldot^T s' = -h
    form "world":  alpha = d(omega)/dt,   D = -s~,        c = omega x (omega x s)

Arrays have their components first; any further axes (primitives of a kind, states of a
batch) come last.

The rows satisfy J_i (a_i, alpha_i) + J_j (a_j, alpha_j) = gamma, with a the acceleration of
the centre of mass.

Source: report Part I, Tables 3.1 and 4.1 (Part II, 4.1 and 4.2), corrected; Nikravesh
(1988), ch. 7. `tests/mechanics/test_constraint.py` compares every row with the tables and with
automatic differentiation. Derivation: docs/dynamics.md.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import (
    bar,
    cross,
    euler_parameter_rate,
    matrix_g,
    matrix_l,
    rotation_matrix,
    skew,
)
from ..algebra.stacked import apply, dot, multiply

Form = Literal["omega", "p", "world"]
Kind = Literal["point", "n1", "n2", "p1", "p2", "distance", "angle", "displacement", "screw"]

# Number of rows of each primitive: s,3  n1,1  n2,1  p1,2  p2,2  s-s,1, two drivers, the screw.
ROWS: dict[str, int] = {
    "point": 3, "n1": 1, "n2": 1, "p1": 2, "p2": 2, "distance": 1, "angle": 1, "displacement": 1,
    "screw": 1,
}  # fmt: skip

# Primitives whose rows are cosines or angles; the rows of all others are lengths.
ANGULAR = ("n1", "p1", "angle")


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
    """Kinematics of one body (or a stack) in a constraint; made by `side` and `side_world`.

    Attributes:
        r, v: centre of mass and its velocity (3,) [m], [m/s].
        R_wb: body-to-world rotation (3, 3).
        omega_w: angular velocity in world axes (3,) [rad/s].
        turn: factor of D that multiplies alpha: R_wb (3, 3), or 2 G (3, 4) for form "p".
        rest: part of R_wb's second derivative that is free of alpha (3, 3), for form "p".
        velocity: v and the integral of alpha: (v, omega'), (v, pdot) or (v, omega).
    """

    r: Float[Array, "3 *batch"]
    v: Float[Array, "3 *batch"]
    R_wb: Float[Array, "3 3 *batch"]
    omega_w: Float[Array, "3 *batch"]
    turn: Float[Array, "3 k *batch"]
    rest: Float[Array, "3 3 *batch"]
    velocity: Float[Array, "w *batch"]


def side(
    r: Float[Array, "3"],
    v: Float[Array, "3"],
    p: Float[Array, "4"],
    omega: Float[Array, "3"],
    form: Form,
) -> BodyKinematics:
    """Kinematics of a body for form "omega" or "p", from its state (omega in body axes)."""
    R_wb = rotation_matrix(p)
    omega_w = R_wb @ omega
    if form == "omega":
        return BodyKinematics(r, v, R_wb, omega_w, R_wb, R_wb, jnp.concatenate([v, omega]))
    p_rate = euler_parameter_rate(p, omega)
    rest = 2 * matrix_g(p_rate) @ matrix_l(p_rate).T
    return BodyKinematics(r, v, R_wb, omega_w, 2 * matrix_g(p), rest, jnp.concatenate([v, p_rate]))


def side_world(
    r: Float[Array, "3 *batch"],
    v: Float[Array, "3 *batch"],
    R_wb: Float[Array, "3 3 *batch"],
    omega_w: Float[Array, "3 *batch"],
) -> BodyKinematics:
    """Kinematics of bodies for form "world", with the angular velocity in world axes."""
    return BodyKinematics(r, v, R_wb, omega_w, R_wb, R_wb, jnp.concatenate([v, omega_w]))


class BodyVector(eqx.Module):
    """World vector s with its derivatives: rate, and D and c of sddot = D alpha + c."""

    s: Float[Array, "3 *batch"]
    rate: Float[Array, "3 *batch"]
    D: Float[Array, "3 k *batch"]
    c: Float[Array, "3 *batch"]


class Row(eqx.Module):
    """Rows of one primitive between bodies i and j.

    Attributes:
        value: constraint function Phi (k,).
        target: right-hand side at velocity level, J qdot = target (k,).
        J_i, J_j: Jacobian blocks (k, 6) or (k, 7), linear part first.
        gamma: right-hand side at acceleration level (k,).
    """

    value: Float[Array, "k *batch"]
    target: Float[Array, "k *batch"]
    J_i: Float[Array, "k w *batch"]
    J_j: Float[Array, "k w *batch"]
    gamma: Float[Array, "k *batch"]


def jet(
    body: BodyKinematics, fixed: Float[Array | np.ndarray, "3 *batch"], form: Form
) -> BodyVector:
    """World vector with derivatives of a vector fixed in a body, `fixed` in body axes (3,)."""
    s = apply(body.R_wb, fixed)
    rate = cross(body.omega_w, s)
    if form == "p":
        return BodyVector(s, rate, multiply(body.turn, bar(fixed)), apply(body.rest, fixed))
    D = -skew(s) if form == "world" else multiply(body.turn, -skew(fixed))
    return BodyVector(s, rate, D, cross(body.omega_w, rate))


def _blocks(
    linear: Float[Array, "k 3 *batch"], angular: Float[Array, "k w *batch"]
) -> Float[Array, "k w+3 *batch"]:
    return jnp.concatenate([linear, angular], axis=1)


def _row(
    value: Float[Array, "k *batch"],
    J_i: Float[Array, "k w *batch"],
    J_j: Float[Array, "k w *batch"],
    gamma: Float[Array, "k *batch"],
) -> Row:
    return Row(value, jnp.zeros_like(value), J_i, J_j, gamma)


def _times(s: Float[Array, "3 *batch"], D: Float[Array, "3 k *batch"]) -> Float[Array, "k *batch"]:
    """Product s^T D of a vector and a matrix."""
    return jnp.sum(s[:, None] * D, axis=0)


def point(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Coincident points, s,3: r_i + s_i^P - r_j - s_j^P = 0."""
    a, b = jet(i, data.point_i, form), jet(j, data.point_j, form)
    eye = jnp.broadcast_to(
        jnp.eye(3, dtype=a.s.dtype).reshape(3, 3, *(1,) * (a.s.ndim - 1)), (3, *a.s.shape)
    )
    value = (i.r + a.s) - (j.r + b.s)
    return _row(value, _blocks(eye, a.D), _blocks(-eye, -b.D), b.c - a.c)


def n1(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Perpendicular body-fixed vectors, n1,1: s_i . s_j = 0."""
    return _n1(jet(i, data.axis_i, form), jet(j, data.axis_j, form))


def _n1(a: BodyVector, b: BodyVector) -> Row:
    none = jnp.zeros_like(a.s)[None]
    gamma = -(dot(a.s, b.c) + dot(b.s, a.c) + 2 * dot(a.rate, b.rate))
    return _row(
        dot(a.s, b.s)[None],
        _blocks(none, _times(b.s, a.D)[None]),
        _blocks(none, _times(a.s, b.D)[None]),
        gamma[None],
    )


def _between(
    i: BodyKinematics, j: BodyKinematics, data: Data, form: Form
) -> tuple[BodyVector, BodyVector, tuple[Array, ...]]:
    """Arms to both points, and the vector d from the point on i to that on j with rate and c."""
    a, b = jet(i, data.point_i, form), jet(j, data.point_j, form)
    d = (j.r + b.s) - (i.r + a.s)
    d_rate = (j.v + b.rate) - (i.v + a.rate)
    return a, b, (d, d_rate, b.c - a.c)


def n2(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Vector perpendicular to d, n2,1: s_i . d = 0, d from the point on i to the point on j."""
    a = jet(i, data.axis_i, form)
    arm_i, arm_j, (d, d_rate, d_c) = _between(i, j, data, form)
    gamma = -(dot(a.s, d_c) + dot(d, a.c) + 2 * dot(a.rate, d_rate))
    return _row(
        dot(a.s, d)[None],
        _blocks(-a.s[None], (_times(d, a.D) - _times(a.s, arm_i.D))[None]),
        _blocks(a.s[None], _times(a.s, arm_j.D)[None]),
        gamma[None],
    )


def _two_of_three(row: Row, axis_w: Float[Array, "3 *batch"]) -> Row:
    """Drop the row of the largest component of the axis (the report's rule)."""
    keep = jnp.array([[1, 2], [0, 2], [0, 1]])[jnp.argmax(jnp.abs(axis_w), axis=0)]
    keep = jnp.moveaxis(keep, -1, 0)

    def two(x: Array) -> Array:
        index = keep if x.ndim == keep.ndim else keep[:, None]
        return jnp.take_along_axis(x, index, axis=0)

    return Row(two(row.value), two(row.target), two(row.J_i), two(row.J_j), two(row.gamma))


def p1_all(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """All three rows of the parallel vectors s_i x s_j = 0 (p1), of which two are independent."""
    a, b = jet(i, data.axis_i, form), jet(j, data.axis_j, form)
    A, B = skew(a.s), skew(b.s)
    gamma = -(cross(a.s, b.c) - cross(b.s, a.c) + 2 * cross(a.rate, b.rate))
    none = jnp.zeros_like(A)
    return _row(
        cross(a.s, b.s),
        _blocks(none, -multiply(B, a.D)),
        _blocks(none, multiply(A, b.D)),
        gamma,
    )


def p2_all(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """All three rows of s_i x d = 0 (p2), of which two are independent."""
    a = jet(i, data.axis_i, form)
    arm_i, arm_j, (d, d_rate, d_c) = _between(i, j, data, form)
    A, C = skew(a.s), skew(d)
    gamma = -(cross(a.s, d_c) - cross(d, a.c) + 2 * cross(a.rate, d_rate))
    return _row(
        cross(a.s, d),
        _blocks(-A, -multiply(A, arm_i.D) - multiply(C, a.D)),
        _blocks(A, multiply(A, arm_j.D)),
        gamma,
    )


def p1(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Parallel vectors, p1,2: s_i x s_j = 0, two rows by the report's rule at this posture."""
    return _two_of_three(p1_all(i, j, data, form), apply(i.R_wb, data.axis_i))


def p2(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Vector parallel to d, p2,2: s_i x d = 0, two rows by the report's rule at this posture."""
    return _two_of_three(p2_all(i, j, data, form), apply(i.R_wb, data.axis_i))


def distance(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Constant distance of two points, s-s,1: d . d - l^2 = 0."""
    arm_i, arm_j, (d, d_rate, d_c) = _between(i, j, data, form)
    gamma = -2 * (dot(d, d_c) + dot(d_rate, d_rate))
    return _row(
        (dot(d, d) - data.length**2)[None],
        2 * _blocks(-d[None], -_times(d, arm_i.D)[None]),
        2 * _blocks(d[None], _times(d, arm_j.D)[None]),
        gamma[None],
    )


def displacement(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Displacement s_i . d along the axis, the row of a driver, which subtracts its motion."""
    return n2(i, j, data, form)


def angle(i: BodyKinematics, j: BodyKinematics, data: Data, form: Form) -> Row:
    """Angle from s_i to s_j, positive towards side_i, in (-pi, pi]; the row of a driver.

    With a = s_i . s_j and b = side_i . s_j, both n1 rows: phi = atan2(b, a).
    """
    moving = jet(j, data.axis_j, form)
    A = _n1(jet(i, data.axis_i, form), moving)
    B = _n1(jet(i, data.side_i, form), moving)
    a, b = A.value, B.value
    rate = lambda row: apply(row.J_i, i.velocity) + apply(row.J_j, j.velocity)
    a_rate, b_rate = rate(A), rate(B)
    square = a * a + b * b
    twist = 2 * (a * a_rate + b * b_rate) * (a * b_rate - b * a_rate) / square**2
    return _row(
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
    along = n2(i, j, data, form)
    across = cross(data.axis_i, data.side_i)
    twisted = dataclasses.replace(data, axis_i=data.side_i, side_i=across)
    about = angle(i, j, twisted, form)
    off = along.value / h - about.value
    return _row(
        h * jnp.arctan2(jnp.sin(off), jnp.cos(off)),
        along.J_i - h * about.J_i,
        along.J_j - h * about.J_j,
        along.gamma - h * about.gamma,
    )


PRIMITIVES: dict[str, Callable[[BodyKinematics, BodyKinematics, Data, Form], Row]] = {
    "point": point, "n1": n1, "n2": n2, "p1": p1, "p2": p2,
    "distance": distance, "angle": angle, "displacement": displacement,
    "screw": screw,
}  # fmt: skip
