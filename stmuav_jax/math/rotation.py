"""Euler parameters p = (e0, e1, e2, e3): e0 is the scalar part; p and -p are the same rotation.

With e = (e1, e2, e3) and ~ the cross-product matrix,

    G = [-e,  e~ + e0 I]      L = [-e, -e~ + e0 I]      A = G L^T,

A maps body components to world components, omega' (body frame) = 2 L pdot and
pdot = L^T omega' / 2. All functions are smooth for unit p, including the identity and half
turns, so that gradients stay finite there. All functions up to `to_rotation_vector` also accept
stacks, whose axes come last.

Source: P. E. Nikravesh, Computer-Aided Analysis of Mechanical Systems (1988), ch. 6;
AFRL-AFOSR-JP-TR-2019-0058, Part II, Eq. 4.11 and 6.6-6.14 (G and L, undefined there,
are fixed by A = G L^T). Conventions: docs/conventions.md.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.shapes import Mat3Like, Quat, QuatLike, Quats, Vec3, Vec3s
from .stacked import dot_product, unit_matrix

# Squared angle (or squared sine) below which the series replaces the quotient; the first
# neglected term is then under 1e-16.
_SMALL_SQUARE = 1e-5


def skew(a: Vec3s) -> Float[Array, "3 3 ..."]:
    """Cross-product matrix (3, 3): `skew(a) @ b == cross(a, b)`."""
    x, y, z = a[0], a[1], a[2]
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])


def cross(a: Vec3s, b: Vec3s) -> Float[Array, "3 ..."]:
    """Cross product a x b, shape (3,)."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    axes = max(a.ndim, b.ndim)
    a, b = (x.reshape(x.shape + (1,) * (axes - x.ndim)) if x.ndim < axes else x for x in (a, b))
    # Half as many operations to trace as by components, whose derivatives double them again.
    return _roll(a * _roll(b) - _roll(a) * b)


def _roll(a: Array) -> Array:
    """Components (y, z, x)."""
    return jax.lax.concatenate([a[1:], a[:1]], 0)


def relative_acceleration(omega: Vec3s, omega_rate: Vec3s, arm: Vec3s) -> Float[Array, "3 ..."]:
    """Acceleration of a point of a rigid body relative to another one [m/s^2], shape (3,).

        omega' x s + omega x (omega x s)

    Args:
        omega: angular velocity [rad/s]. omega_rate: angular acceleration [rad/s^2], same axes.
        arm: vector s between the points [m], same axes.
    """
    return cross(omega_rate, arm) + cross(omega, cross(omega, arm))


def matrix_g(p: Quats) -> Float[Array, "3 4 ..."]:
    """Matrix G = [-e, e~ + e0 I] of Euler parameters, shape (3, 4)."""
    e = p[1:]
    return jnp.concatenate([-e[:, None], skew(e) + p[0] * unit_matrix(e)], axis=1)


def matrix_l(p: Quats) -> Float[Array, "3 4 ..."]:
    """Matrix L = [-e, -e~ + e0 I] of Euler parameters, shape (3, 4)."""
    e = p[1:]
    return jnp.concatenate([-e[:, None], -skew(e) + p[0] * unit_matrix(e)], axis=1)


def rotation_matrix(p: Quats) -> Float[Array, "3 3 ..."]:
    """Body-to-world rotation A = G L^T, shape (3, 3); |p|^2 times a rotation if |p| != 1.

    Source: report Part II, Eq. 6.10, corrected (its (1,1) entry is misprinted).
    """
    return jnp.asarray(rotation_matrix_in(jnp, p))


def rotation_matrix_in(module: Any, p: Quats) -> Float[Array | np.ndarray, "3 3 ..."]:
    """`rotation_matrix` by the functions of a module, `numpy` or `jax.numpy`."""
    e0, e1, e2, e3 = p[0], p[1], p[2], p[3]
    s0, s1, s2, s3 = e0 * e0, e1 * e1, e2 * e2, e3 * e3
    e01, e02, e03 = e0 * e1, e0 * e2, e0 * e3
    e12, e13, e23 = e1 * e2, e1 * e3, e2 * e3
    r0 = module.stack([s0 + s1 - s2 - s3, 2 * (e12 - e03), 2 * (e13 + e02)])
    r1 = module.stack([2 * (e12 + e03), s0 - s1 + s2 - s3, 2 * (e23 - e01)])
    r2 = module.stack([2 * (e13 - e02), 2 * (e23 + e01), s0 - s1 - s2 + s3])
    return module.stack([r0, r1, r2])


def euler_parameter_rate(p: Quats, omega: Vec3s) -> Float[Array, "4 ..."]:
    """Rate pdot = L^T omega / 2 of Euler parameters (4,) [1/s] for body-frame omega [rad/s]."""
    return 0.5 * product(p, jnp.concatenate([jnp.zeros_like(omega[:1]), omega]))


def angular_velocity(p: QuatLike, p_rate: QuatLike) -> Vec3:
    """Body-frame angular velocity omega = 2 L pdot [rad/s], shape (3,)."""
    return 2.0 * matrix_l(p) @ p_rate


def product(p: Quats, q: Quats) -> Float[Array, "4 ..."]:
    """Euler parameters (4,) of a composition: `rotation_matrix(product(p, q)) == A(p) @ A(q)`."""
    a, b, c, d = p[0], p[1], p[2], p[3]
    w, x, y, z = q[0], q[1], q[2], q[3]
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def conjugate(p: Quats) -> Float[Array, "4 ..."]:
    """Euler parameters (e0, -e) of the inverse rotation, shape (4,)."""
    return jnp.concatenate([p[:1], -p[1:]])


def normalise(p: Quats) -> Float[Array, "4 ..."]:
    """Unit Euler parameters p / |p|, shape (4,); called only by users and in projections."""
    q = jnp.asarray(p)
    return q / jnp.sqrt(dot_product(q, q))[None]


def turn_about(angle: Float[Array, ""], axis: int) -> Float[Array, "4"]:
    """Euler parameters of a rotation [rad] about a coordinate axis (0, 1 or 2)."""
    e = jnp.zeros(4).at[0].set(jnp.cos(angle / 2))
    return e.at[axis + 1].set(jnp.sin(angle / 2))


def from_rotation_vector(v: Vec3s) -> Float[Array, "4 ..."]:
    """Euler parameters of the rotation by the angle |v| [rad] about v / |v|, shape (4,).

    The function is smooth everywhere; `from_rotation_vector(zeros)` is the identity.
    """
    square = dot_product(jnp.asarray(v), jnp.asarray(v))
    small = square < _SMALL_SQUARE
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    cosine = jnp.where(
        small, 1 - square / 8 + square**2 / 384 - square**3 / 46080, jnp.cos(angle / 2)
    )
    factor = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([cosine[None], factor * v])


def to_rotation_vector(p: Quats) -> Float[Array, "3 ..."]:
    """Rotation vector of unit Euler parameters, of length 0 to pi [rad], shape (3,).

    It is the inverse of `from_rotation_vector`. p and -p give the same vector, except at a half
    turn, where both vectors are valid and the one along e is returned.
    """
    # Of p and -p the one with the shorter rotation.
    q = jnp.where(p[:1] < 0, -p, p)
    square = dot_product(q[1:], q[1:])
    small = square < _SMALL_SQUARE
    length = jnp.sqrt(jnp.where(small, 1.0, square))
    # 2 atan(s)/s as a series in s^2, where s is the tangent of half the angle.
    ratio = square / (q[0] * q[0] + jnp.where(small, 0.0, 1.0))
    series = (2 / jnp.where(small, q[0], 1.0)) * (1 - ratio / 3 + ratio**2 / 5 - ratio**3 / 7)
    factor = jnp.where(small, series, 2 * jnp.arctan2(length, q[0]) / length)
    return factor * q[1:]


def from_matrix(A: Mat3Like) -> Quat:
    """Unit Euler parameters of a rotation matrix, shape (4,); the largest component is positive.

    4 p p^T is linear in A; the row with the largest diagonal entry is used, so that no branch
    divides by a small number (the report's Eq. 6.14 is singular at e0 = 0).
    """
    return jnp.asarray(from_matrix_in(jnp, A))


def from_matrix_in(module: Any, A: Mat3Like) -> Float[Array | np.ndarray, "4"]:
    """`from_matrix` by the functions of a module, `numpy` or `jax.numpy`."""
    d0, d1, d2 = A[0, 0], A[1, 1], A[2, 2]
    x, y, z = A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]
    xy, xz, yz = A[0, 1] + A[1, 0], A[0, 2] + A[2, 0], A[1, 2] + A[2, 1]
    squares = module.stack([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2])
    rows = module.stack(
        [
            module.stack([squares[0], x, y, z]),
            module.stack([x, squares[1], xy, xz]),
            module.stack([y, xy, squares[2], yz]),
            module.stack([z, xz, yz, squares[3]]),
        ]
    )
    # Each row of the table is a multiple of p; that of the largest component has no cancellation and no
    # division by zero.
    row, square = rows[0], squares[0]
    for k in range(1, 4):
        larger = squares[k] > square
        row, square = module.where(larger, rows[k], row), module.where(larger, squares[k], square)
    return row / (2.0 * module.sqrt(square))
