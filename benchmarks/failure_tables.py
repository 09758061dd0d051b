"""The constraint tables of the report in NumPy, corrected, with switches for its misprints.

AFRL-AFOSR-JP-TR-2019-0058, Part II, Table 4.1: values, Jacobians in pdot and gamma of s,3,
n1,1, p1,2 and p2,2, the primitives of the mechanism's joints.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stmuav_jax import Scene

Array = np.ndarray

_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])


@dataclass(frozen=True)
class Variant:
    """How the equations are written down and solved; the default is the corrected report.

    Attributes:
        lost_dots: gamma of p1,2 and p2,2 with -2 s~_i (.) where -2 s~dot_i (.) is right.
        transposed_gamma: gamma of p2,2 with -d~^T h_i for -d~ h_i.
        transposed_jacobian: Phi_pi of p2,2 with -2 d~^T G_i for -2 d~ G_i.
        shared_index: h_j = -2 Gdot_j Ldot_i^T s'_j, with body i's rate for body j.
        frozen: the two of three rows are chosen at the start and kept.
        inverse: multiply by the inverse matrix instead of solving.
        metres: length of the unit [m]; 1e-3 works in kg, mm, s.
    """

    lost_dots: bool = False
    transposed_gamma: bool = False
    transposed_jacobian: bool = False
    shared_index: bool = False
    frozen: bool = False
    inverse: bool = False
    metres: float = 1.0


@dataclass(frozen=True)
class Rows:
    """Primitives of one kind: bodies i and j, axes and points fixed in them (k, 3)."""

    i: Array
    j: Array
    axis_i: Array
    axis_j: Array
    point_i: Array
    point_j: Array


@dataclass(frozen=True)
class Bodies:
    """What the constraint tables need of all bodies at one state; A = G L^T as printed."""

    r: Array
    v: Array
    p_rate: Array
    G: Array
    L: Array
    G_rate: Array
    L_rate: Array
    A: Array


@dataclass(frozen=True)
class Fixed:
    """Vectors fixed in bodies (k, 3): s, sdot, D = 2 G bar(s') and h = -2 Gdot Ldot^T s'."""

    s: Array
    rate: Array
    D: Array
    h: Array


def skew(a: Array) -> Array:
    """Cross-product matrices (..., 3, 3)."""
    out = np.zeros((*a.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -a[..., 2], a[..., 1], -a[..., 0]
    return out - np.swapaxes(out, -1, -2)


def g_and_l(p: Array) -> tuple[Array, Array]:
    """G = [-e, e~ + e0 I] and L = [-e, -e~ + e0 I], each (..., 3, 4)."""
    turn, scale = skew(p[..., 1:]), p[..., :1, None] * np.eye(3)
    first = -p[..., 1:, None]
    return np.concatenate([first, scale + turn], -1), np.concatenate([first, scale - turn], -1)


def bar(a: Array) -> Array:
    """[[0, -a^T], [a, -a~]], (..., 4, 4)."""
    out = np.zeros((*a.shape[:-1], 4, 4))
    out[..., 0, 1:], out[..., 1:, 0], out[..., 1:, 1:] = -a, a, -skew(a)
    return out


def cross(a: Array, b: Array) -> Array:
    """a x b for stacked vectors (..., 3); np.cross costs ten times as much on a few of them."""
    return a[..., _YZX] * b[..., _ZXY] - a[..., _ZXY] * b[..., _YZX]


def times(matrix: Array, vector: Array) -> Array:
    """Stacked matrix-vector products."""
    return (matrix @ vector[..., None])[..., 0]


def bodies_at(y: Array, n: int) -> Bodies:
    """Unpack a state of n bodies."""
    r, p = y[: 3 * n].reshape(n, 3), y[3 * n : 7 * n].reshape(n, 4)
    v, p_rate = y[7 * n : 10 * n].reshape(n, 3), y[10 * n : 14 * n].reshape(n, 4)
    G, L = g_and_l(p)
    G_rate, L_rate = g_and_l(p_rate)
    return Bodies(r, v, p_rate, G, L, G_rate, L_rate, G @ np.swapaxes(L, 1, 2))


def fixed_vectors(b: Bodies, which: Array, vectors: Array, other: Array | None = None) -> Fixed:
    """Vectors fixed in the bodies `which`; h with Ldot of the bodies `other` if given."""
    rate = np.swapaxes(b.L_rate[which], 1, 2)
    h_rate = rate if other is None else np.swapaxes(b.L_rate[other], 1, 2)
    return Fixed(
        times(b.A[which], vectors),
        2 * times(b.G[which] @ rate, vectors),
        2 * b.G[which] @ bar(vectors),
        -2 * times(b.G_rate[which] @ h_rate, vectors),
    )


@dataclass(frozen=True)
class Block:
    """Rows of one kind: value (k, c), Jacobian parts (k, c, 3) and (k, c, 4), gamma (k, c)."""

    rows: Rows
    value: Array
    r_i: Array
    p_i: Array
    r_j: Array
    p_j: Array
    gamma: Array

    def kept(self, keep: Array) -> "Block":
        """Two of three rows of each."""
        at = (np.arange(len(keep))[:, None], keep)
        parts = (self.value, self.r_i, self.p_i, self.r_j, self.p_j, self.gamma)
        return Block(self.rows, *(part[at] for part in parts))


def _other(q: Rows, variant: Variant) -> Array | None:
    return q.i if variant.shared_index else None


def point(b: Bodies, q: Rows, variant: Variant) -> Block:
    """s,3."""
    i, j = fixed_vectors(b, q.i, q.point_i), fixed_vectors(b, q.j, q.point_j, _other(q, variant))
    eye = np.broadcast_to(np.eye(3), (len(q.i), 3, 3))
    value = b.r[q.i] + i.s - b.r[q.j] - j.s
    return Block(q, value, eye, i.D, -eye, -j.D, i.h - j.h)


def n1(b: Bodies, q: Rows, variant: Variant) -> Block:
    """n1,1."""
    i, j = fixed_vectors(b, q.i, q.axis_i), fixed_vectors(b, q.j, q.axis_j, _other(q, variant))
    dot = lambda a, c: np.sum(a * c, -1, keepdims=True)
    none = np.zeros((len(q.i), 1, 3))
    gamma = dot(i.s, j.h) + dot(j.s, i.h) - 2 * dot(i.rate, j.rate)
    return Block(q, dot(i.s, j.s), none, j.s[:, None] @ i.D, none, i.s[:, None] @ j.D, gamma)


def p1(b: Bodies, q: Rows, variant: Variant) -> Block:
    """All three rows of p1,2."""
    i, j = fixed_vectors(b, q.i, q.axis_i), fixed_vectors(b, q.j, q.axis_j, _other(q, variant))
    none = np.zeros((len(q.i), 3, 3))
    first = i.s if variant.lost_dots else i.rate
    gamma = cross(i.s, j.h) - cross(j.s, i.h) - 2 * cross(first, j.rate)
    return Block(
        q, cross(i.s, j.s), none, -skew(j.s) @ i.D, none, skew(i.s) @ j.D, gamma
    )  # fmt: skip


def p2(b: Bodies, q: Rows, variant: Variant) -> Block:
    """All three rows of p2,2."""
    i = fixed_vectors(b, q.i, q.axis_i)
    end_i, end_j = (
        fixed_vectors(b, q.i, q.point_i),
        fixed_vectors(b, q.j, q.point_j, _other(q, variant)),
    )
    d = b.r[q.j] + end_j.s - b.r[q.i] - end_i.s
    d_rate = b.v[q.j] + end_j.rate - b.v[q.i] - end_i.rate
    S, D = skew(i.s), skew(d)
    first = i.s if variant.lost_dots else i.rate
    sign_gamma = 1 if variant.transposed_gamma else -1
    sign_jacobian = 1 if variant.transposed_jacobian else -1
    gamma = cross(i.s, end_j.h - end_i.h) + sign_gamma * cross(d, i.h) - 2 * cross(first, d_rate)
    p_i = -S @ end_i.D + sign_jacobian * D @ i.D
    return Block(q, cross(i.s, d), -S, p_i, S, S @ end_j.D, gamma)


def collect_rows(scene: Scene, unit: float) -> dict[str, Rows]:
    """The report's rows of all joints, by kind."""
    system = scene.system
    found: dict[str, list[tuple[Any, ...]]] = {"point": [], "n1": [], "p1": [], "p2": []}
    for joint in system.joints:
        i, j = system.index(joint.body_i), system.index(joint.body_j)
        for term in joint.terms("report"):
            data = joint.data(term, system.bodies.com[i], system.bodies.com[j])
            points = (data.point_i / unit, data.point_j / unit)
            found[term.kind].append((i, j, data.axis_i, data.axis_j, *points))
    return {
        kind: Rows(*(np.array([np.asarray(x) for x in part]) for part in zip(*rows, strict=True)))
        for kind, rows in found.items()
    }


def stack_rows(blocks: tuple[Block, ...], n: int) -> tuple[Array, Array]:
    """Phi_q (m, 7 n) and gamma (m,)."""
    rows = []
    for b in blocks:
        k, c = b.value.shape
        block = np.zeros((k, c, n, 7))
        for body, r, p in ((b.rows.i, b.r_i, b.p_i), (b.rows.j, b.r_j, b.p_j)):
            block[np.arange(k), :, body, :3] += r
            block[np.arange(k), :, body, 3:] += p
        rows.append(block.reshape(k * c, 7 * n))
    return np.concatenate(rows), np.concatenate([b.gamma.ravel() for b in blocks])
