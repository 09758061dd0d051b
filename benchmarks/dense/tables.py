"""Constraint tables of the report in NumPy, corrected, with switches for its misprints.

AFRL-AFOSR-JP-TR-2019-0058, Part I, Table 3.1, and Part II, Table 4.1: values, Jacobians in pdot and
gamma of s,3, n1,1, p1,2 and p2,2, the primitives of the joints. All vectors are stacked.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from problems.plain import PlainJoint

Array = np.ndarray

# The primitives of a joint: the point, and axes as columns of frames i and j.
_TERMS = {
    "spherical": (("point", 2, 2),),
    "universal": (("point", 2, 2), ("n1", 0, 1)),
    "revolute": (("point", 2, 2), ("p1", 2, 2)),
    "translational": (("p1", 2, 2), ("p2", 2, 2), ("n1", 0, 1)),
}
KINDS = ("point", "n1", "p1", "p2")
# Rows of each kind, of cross products two of three.
COUNTS = (3, 1, 2, 2)
_KEEP = np.array([[1, 2], [0, 2], [0, 1]])
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
    """

    lost_dots: bool = False
    transposed_gamma: bool = False
    transposed_jacobian: bool = False
    shared_index: bool = False
    frozen: bool = False


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
    """[[0, -a^T], [a, -a~]], (..., 4, 4): L(p)^T a = bar(a) p."""
    out = np.zeros((*a.shape[:-1], 4, 4))
    out[..., 0, 1:], out[..., 1:, 0], out[..., 1:, 1:] = -a, a, -skew(a)
    return out


def cross(a: Array, b: Array) -> Array:
    """a x b for stacked vectors (..., 3); np.cross costs ten times as much on a few of them."""
    return a[..., _YZX] * b[..., _ZXY] - a[..., _ZXY] * b[..., _YZX]


def times(matrix: Array, vector: Array) -> Array:
    """Stacked matrix-vector products."""
    return (matrix @ vector[..., None])[..., 0]


class Group(NamedTuple):
    """Primitives of a kind: their bodies, and where their fixed vectors are in the list."""

    i: Array
    j: Array
    axis_i: Array
    axis_j: Array
    point_i: Array
    point_j: Array


class Rows(NamedTuple):
    """Rows of one kind (k, c, .): Jacobians in (rdot, pdot) of i and j, gamma, and Phi."""

    r_i: Array
    p_i: Array
    r_j: Array
    p_j: Array
    gamma: Array
    value: Array

    def two(self, keep: Array) -> "Rows":
        """Two of the three rows of each, by number (k, 2)."""
        return Rows(*(part[np.arange(len(keep))[:, None], keep] for part in self))


class Tables:
    """All rows of some joints; their body-fixed vectors are evaluated together."""

    def __init__(self, joints: tuple[PlainJoint, ...]) -> None:
        bodies: list[tuple[int, int]] = []
        vectors: list[Array] = []

        def add(body: int, other: int, vector: Array) -> int:
            bodies.append((body, other))
            vectors.append(vector)
            return len(bodies) - 1

        found: dict[str, list[tuple[int, ...]]] = {kind: [] for kind in KINDS}
        for one in joints:
            for kind, x, y in _TERMS[one.kind]:
                axes = add(one.i, one.i, one.frame_i[:, x]), add(one.j, one.i, one.frame_j[:, y])
                points = add(one.i, one.i, one.point_i), add(one.j, one.i, one.point_j)
                found[kind].append((one.i, one.j, *axes, *points))
        self.groups = {k: Group(*np.array(v, int).reshape(-1, 6).T) for k, v in found.items()}
        # the body of each vector, and body i of its joint, which one misprint takes for it
        self.at, self.first = np.array(bodies, int).reshape(-1, 2).T
        self.vectors = np.array(vectors).reshape(-1, 3)
        self.bars = bar(self.vectors)
        self.count = sum(len(self.groups[k].i) * c for k, c in zip(KINDS, COUNTS, strict=True))

    def chosen(self, A: Array) -> dict[str, Array]:
        """Rows kept of p1 and p2: without the one where s_i is largest in world axes."""
        kept = {}
        for kind in ("p1", "p2"):
            g = self.groups[kind]
            axis = times(A[g.i], self.vectors[g.axis_i])
            kept[kind] = _KEEP[np.abs(axis).argmax(axis=1)]
        return kept

    def rows(
        self, q: Array, u: Array, G: Array, rates: tuple[Array, Array], variant: Variant
    ) -> dict[str, Rows]:
        """Rows of every kind, all three of a cross product.

        Args:
            q, u: (r, p) and their rates (n + 1, 7), ground last. rates: of G and L.
        """
        at = self.at
        turning = rates[1][self.first if variant.shared_index else at]
        D = 2 * G[at] @ self.bars
        h = -2 * times(rates[0][at], np.einsum("ncb,nc->nb", turning, self.vectors))
        s, rate = 0.5 * times(D, q[at, 3:]), times(D, u[at, 3:])
        r, v, eye = q[:, :3], u[:, :3], np.eye(3)
        first = s if variant.lost_dots else rate
        out = {}
        g = self.groups["point"]
        a, b, none = g.point_i, g.point_j, np.zeros((len(g.i), 3, 3))
        value = r[g.i] + s[a] - r[g.j] - s[b]
        out["point"] = Rows(none + eye, D[a], none - eye, -D[b], h[a] - h[b], value)
        g = self.groups["n1"]
        a, b, none = g.axis_i, g.axis_j, np.zeros((len(g.i), 1, 3))
        gamma = (s[a] * h[b] + s[b] * h[a] - 2 * rate[a] * rate[b]).sum(1, keepdims=True)
        value = (s[a] * s[b]).sum(1, keepdims=True)
        out["n1"] = Rows(none, s[b][:, None] @ D[a], none, s[a][:, None] @ D[b], gamma, value)
        g = self.groups["p1"]
        a, b, none = g.axis_i, g.axis_j, np.zeros((len(g.i), 3, 3))
        gamma = cross(s[a], h[b]) - cross(s[b], h[a]) - 2 * cross(first[a], rate[b])
        p_i, p_j = -skew(s[b]) @ D[a], skew(s[a]) @ D[b]
        out["p1"] = Rows(none, p_i, none, p_j, gamma, cross(s[a], s[b]))
        g = self.groups["p2"]
        a, b, c = g.axis_i, g.point_i, g.point_j
        d, d_rate = r[g.j] + s[c] - r[g.i] - s[b], v[g.j] + rate[c] - v[g.i] - rate[b]
        S, C = skew(s[a]), skew(d)
        in_gamma = 1 if variant.transposed_gamma else -1
        in_jacobian = 1 if variant.transposed_jacobian else -1
        gamma = cross(s[a], h[c] - h[b]) + in_gamma * cross(d, h[a]) - 2 * cross(first[a], d_rate)
        p_i = -S @ D[b] + in_jacobian * C @ D[a]
        out["p2"] = Rows(-S, p_i, S, S @ D[c], gamma, cross(s[a], d))
        return out
