"""Euler parameters: p = (e0, e1, e2, e3), e0 the scalar part, p and -p the same rotation.

With e = (e1, e2, e3) and ~ the cross-product matrix,

    G = [-e,  e~ + e0 I]      L = [-e, -e~ + e0 I]      A = G L^T,

A maps body components to world components, omega' (body frame) = 2 L pdot and
pdot = L^T omega' / 2. All functions here are smooth for unit p, the identity and half
turns included, so that gradients stay finite there. Those up to `from_rotation_vector` also
take stacks, with the axes of the stack last.

Source: P. E. Nikravesh, Computer-Aided Analysis of Mechanical Systems (1988), ch. 6;
AFRL-AFOSR-JP-TR-2019-0058, Part II, Eq. 4.11 and 6.6-6.14 (G and L, undefined there,
are fixed by A = G L^T). Conventions: docs/conventions.md.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from .shapes import Mat3Like, Quat, QuatLike, Quats, Scalar, Vec3, Vec3s
from .stacked import apply, dot, eye

# Below this squared angle (or squared sine) the series replaces the quotient; the first
# neglected term is then under 1e-16.
_SMALL_SQUARE = 1e-5


def skew(a: Vec3s) -> Float[Array, "3 3 ..."]:
    """Cross-product matrix: `skew(a) @ b == cross(a, b)`. Shape (3, 3)."""
    x, y, z = a[0], a[1], a[2]
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])


def cross(a: Vec3s, b: Vec3s) -> Float[Array, "3 ..."]:
    """a x b, shape (3,)."""
    return _cross(a, b)


@jax.custom_jvp
def _cross(a: Array, b: Array) -> Array:
    x, y, z = a[0], a[1], a[2]
    u, v, w = b[0], b[1], b[2]
    return jnp.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def _cross_jvp(primals: Any, tangents: Any) -> Any:
    # by matrices: the transpose of taking components apart is one padded array for each
    (a, b), (a_dot, b_dot) = primals, tangents
    out = _cross(a, b)
    change = jnp.zeros_like(out)
    if not isinstance(b_dot, SymbolicZero):
        change = change + apply(skew(a), b_dot)
    if not isinstance(a_dot, SymbolicZero):
        change = change - apply(skew(b), a_dot)
    return out, change


_cross.defjvp(_cross_jvp, symbolic_zeros=True)


def matrix_g(p: Quats) -> Float[Array, "3 4 ..."]:
    """G = [-e, e~ + e0 I], shape (3, 4)."""
    e = p[1:]
    return jnp.concatenate([-e[:, None], skew(e) + p[0] * eye(e)], axis=1)


def matrix_l(p: Quats) -> Float[Array, "3 4 ..."]:
    """L = [-e, -e~ + e0 I], shape (3, 4)."""
    e = p[1:]
    return jnp.concatenate([-e[:, None], -skew(e) + p[0] * eye(e)], axis=1)


def bar(a: Vec3s) -> Float[Array, "4 4 ..."]:
    """The 4x4 matrix of a body-fixed vector with L(p)^T a = bar(a) p, shape (4, 4)."""
    zero = jnp.zeros_like(a[:1])[None]
    top = jnp.concatenate([zero, -a[None]], axis=1)
    return jnp.concatenate([top, jnp.concatenate([a[:, None], -skew(a)], axis=1)], axis=0)


def rotation_matrix(p: Quats) -> Float[Array, "3 3 ..."]:
    """Body-to-world rotation A = G L^T, shape (3, 3); |p|^2 times a rotation if |p| != 1.

    Source: report Part II, Eq. 6.10, corrected (its (1,1) entry is misprinted).
    """
    e0, e1, e2, e3 = p[0], p[1], p[2], p[3]
    s0, s1, s2, s3 = e0 * e0, e1 * e1, e2 * e2, e3 * e3
    r0 = jnp.stack([s0 + s1 - s2 - s3, 2 * (e1 * e2 - e0 * e3), 2 * (e1 * e3 + e0 * e2)])
    r1 = jnp.stack([2 * (e1 * e2 + e0 * e3), s0 - s1 + s2 - s3, 2 * (e2 * e3 - e0 * e1)])
    r2 = jnp.stack([2 * (e1 * e3 - e0 * e2), 2 * (e2 * e3 + e0 * e1), s0 - s1 - s2 + s3])
    return jnp.stack([r0, r1, r2])


def euler_parameter_rate(p: Quats, omega: Vec3s) -> Float[Array, "4 ..."]:
    """pdot = L^T omega / 2 for the body-frame angular velocity omega [rad/s], shape (4,)."""
    return 0.5 * product(p, jnp.concatenate([jnp.zeros_like(omega[:1]), omega]))


def angular_velocity(p: QuatLike, p_rate: QuatLike) -> Vec3:
    """Body-frame angular velocity omega = 2 L pdot [rad/s], shape (3,)."""
    return 2.0 * matrix_l(p) @ p_rate


def product(p: Quats, q: Quats) -> Float[Array, "4 ..."]:
    """Composition: `rotation_matrix(product(p, q)) == A(p) @ A(q)`. Shape (4,)."""
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
    """The inverse rotation (e0, -e), shape (4,)."""
    return jnp.concatenate([p[:1], -p[1:]])


def normalise(p: Quats) -> Float[Array, "4 ..."]:
    """p / |p|, shape (4,); called only where a user asks for it or a projection does."""
    q = jnp.asarray(p)
    return q / jnp.sqrt(dot(q, q))


def from_rotation_vector(v: Vec3s) -> Float[Array, "4 ..."]:
    """Euler parameters of the rotation by |v| [rad] about v / |v|, shape (4,).

    Smooth everywhere; `from_rotation_vector(zeros)` is the identity.
    """
    square = dot(jnp.asarray(v), jnp.asarray(v))
    small = square < _SMALL_SQUARE
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    cosine = jnp.where(
        small, 1 - square / 8 + square**2 / 384 - square**3 / 46080, jnp.cos(angle / 2)
    )
    factor = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([cosine[None], factor * v])


def to_rotation_vector(p: QuatLike) -> Vec3:
    """Rotation vector of unit p, its length in [0, pi] [rad], shape (3,).

    Inverse of `from_rotation_vector`. p and -p give the same vector, except at a half turn,
    where both are right and the one along e is returned.
    """
    q = jnp.where(p[0] < 0, -p, p)
    square = q[1:] @ q[1:]
    small = square < _SMALL_SQUARE
    length = jnp.sqrt(jnp.where(small, 1.0, square))
    ratio = square / (q[0] * q[0] + jnp.where(small, 0.0, 1.0))
    series = (2 / jnp.where(small, q[0], 1.0)) * (1 - ratio / 3 + ratio**2 / 5 - ratio**3 / 7)
    factor = jnp.where(small, series, 2 * jnp.arctan2(length, q[0]) / length)
    return factor * q[1:]


def from_matrix(A: Mat3Like) -> Quat:
    """Unit Euler parameters of a rotation matrix, largest component first and positive, (4,).

    4 p p^T is linear in A; its row with the largest diagonal entry is used, so none of the
    four branches divides by a small number (the report's Eq. 6.14 is singular at e0 = 0).
    """
    d0, d1, d2 = A[0, 0], A[1, 1], A[2, 2]
    x, y, z = A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]
    xy, xz, yz = A[0, 1] + A[1, 0], A[0, 2] + A[2, 0], A[1, 2] + A[2, 1]
    squares = jnp.stack([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2])
    rows = jnp.stack(
        [
            jnp.stack([squares[0], x, y, z]),
            jnp.stack([x, squares[1], xy, xz]),
            jnp.stack([y, xy, squares[2], yz]),
            jnp.stack([z, xz, yz, squares[3]]),
        ]
    )
    k = jnp.argmax(squares)
    return rows[k] / (2.0 * jnp.sqrt(squares[k]))


def rotation_angle(p: QuatLike) -> Scalar:
    """Angle of the rotation in [0, pi] [rad], shape ().

    It has a tip at the identity, where its derivative is NaN, and a ridge at half turns, where
    its derivative is that of the side e0 > 0 (as of `to_rotation_vector`).
    """
    return 2 * jnp.arctan2(jnp.sqrt(p[1:] @ p[1:]), jnp.where(p[0] < 0, -p[0], p[0]))
