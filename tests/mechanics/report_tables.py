"""The report's constraint tables, transcribed to NumPy with their misprints corrected.

AFRL-AFOSR-JP-TR-2019-0058: Part I, Table 3.1 = Part II, Table 4.1 (Jacobian in pdot and
gamma^(m)); Part I, Table 4.1 = Part II, Table 4.2 (Jacobian in omega' and gamma#). Where
the two parts print different things, or both are wrong, the entry here is the one that the
derivatives of the constraint give; the tests check that independently.
"""

from dataclasses import dataclass

import numpy as np
from helpers import np_bar, np_g, np_l, np_rotation, np_skew


@dataclass
class Posture:
    """One body: r, v, p (unit) and the body-frame angular velocity omega'."""

    r: np.ndarray
    v: np.ndarray
    p: np.ndarray
    omega: np.ndarray

    @property
    def p_rate(self) -> np.ndarray:
        """pdot = L^T omega' / 2."""
        return 0.5 * np_l(self.p).T @ self.omega

    @property
    def A(self) -> np.ndarray:
        """Body to world."""
        return np_rotation(self.p)

    @property
    def w(self) -> np.ndarray:
        """Angular velocity in the world."""
        return self.A @ self.omega

    def s(self, fixed: np.ndarray) -> np.ndarray:
        """s = A s'."""
        return self.A @ fixed

    def rate(self, fixed: np.ndarray) -> np.ndarray:
        """sdot = omega x s."""
        return np.cross(self.w, self.s(fixed))

    def h(self, fixed: np.ndarray) -> np.ndarray:
        """h = -2 Gdot Ldot^T s'."""
        return -2 * np_g(self.p_rate) @ np_l(self.p_rate).T @ fixed

    def Gs(self, fixed: np.ndarray) -> np.ndarray:
        """2 G bar(s'), the derivative of s in p."""
        return 2 * np_g(self.p) @ np_bar(fixed)

    def sA(self, fixed: np.ndarray) -> np.ndarray:
        """s~ A."""
        return np_skew(self.s(fixed)) @ self.A

    def wxs(self, fixed: np.ndarray) -> np.ndarray:
        """w x sdot."""
        return np.cross(self.w, self.rate(fixed))


@dataclass
class Numbers:
    """Body-fixed vectors: axes s'_i, s'_j and points s'_i^B, s'_j^B; the length of a rod."""

    axis_i: np.ndarray
    axis_j: np.ndarray
    point_i: np.ndarray
    point_j: np.ndarray
    length: float


def _between(i: Posture, j: Posture, n: Numbers) -> tuple[np.ndarray, np.ndarray]:
    d = j.r + j.s(n.point_j) - i.r - i.s(n.point_i)
    d_rate = j.v + j.rate(n.point_j) - i.v - i.rate(n.point_i)
    return d, d_rate


def value(kind: str, i: Posture, j: Posture, n: Numbers) -> np.ndarray:
    """Phi of each primitive; all three rows of the cross products."""
    d = _between(i, j, n)[0]
    a, b = i.s(n.axis_i), j.s(n.axis_j)
    return np.atleast_1d(
        {
            "point": -d,
            "n1": a @ b,
            "n2": a @ d,
            "displacement": a @ d,
            "p1": np.cross(a, b),
            "p2": np.cross(a, d),
            "distance": d @ d - n.length**2,
        }[kind]
    )


def table_p(kind: str, i: Posture, j: Posture, n: Numbers) -> tuple[np.ndarray, ...]:
    """Phi_ri, Phi_pi, Phi_rj, Phi_pj, gamma^(m) of Table 3.1 (Part II, 4.1), corrected."""
    a, b = i.s(n.axis_i), j.s(n.axis_j)
    a1, b1 = i.rate(n.axis_i), j.rate(n.axis_j)
    ha, hb = i.h(n.axis_i), j.h(n.axis_j)
    hi, hj = i.h(n.point_i), j.h(n.point_j)
    Ga, Gb, Gi, Gj = i.Gs(n.axis_i), j.Gs(n.axis_j), i.Gs(n.point_i), j.Gs(n.point_j)
    d, d1 = _between(i, j, n)
    sa, sb, sd, no = np_skew(a), np_skew(b), np_skew(d), np.zeros
    n2 = (-a, -a @ Gi + d @ Ga, a, a @ Gj, a @ (hj - hi) + d @ ha - 2 * a1 @ d1)
    rows = {
        "n1": (no(3), b @ Ga, no(3), a @ Gb, a @ hb + b @ ha - 2 * a1 @ b1),
        "n2": n2,
        "displacement": n2,
        "p1": (no((3, 3)), -sb @ Ga, no((3, 3)), sa @ Gb,
               sa @ hb - sb @ ha - 2 * np.cross(a1, b1)),
        "p2": (-sa, -sa @ Gi - sd @ Ga, sa, sa @ Gj,
               sa @ (hj - hi) - sd @ ha - 2 * np.cross(a1, d1)),
        "point": (np.eye(3), Gi, -np.eye(3), -Gj, hi - hj),
        "distance": (-2 * d, -2 * d @ Gi, 2 * d, 2 * d @ Gj, 2 * d @ (hj - hi) - 2 * d1 @ d1),
    }[kind]  # fmt: skip
    return (*map(np.atleast_2d, rows[:4]), np.atleast_1d(rows[4]))


def table_omega(kind: str, i: Posture, j: Posture, n: Numbers) -> tuple[np.ndarray, ...]:
    """Phi_ri, b_i, Phi_rj, b_j, gamma# of Table 4.1 (Part II, 4.2), corrected."""
    a, b = i.s(n.axis_i), j.s(n.axis_j)
    a1, b1 = i.rate(n.axis_i), j.rate(n.axis_j)
    d, d1 = _between(i, j, n)
    sa, sb, sd = np_skew(a), np_skew(b), np_skew(d)
    arm_i, arm_j = i.s(n.point_i), j.s(n.point_j)
    aA, bA, iA, jA = i.sA(n.axis_i), j.sA(n.axis_j), i.sA(n.point_i), j.sA(n.point_j)
    w1a, w1b, w1i, w1j = i.wxs(n.axis_i), j.wxs(n.axis_j), i.wxs(n.point_i), j.wxs(n.point_j)
    no = np.zeros
    n2 = (-a, -(d + arm_i) @ aA, a, -a @ jA, -2 * d1 @ a1 - d @ w1a + a @ (w1i - w1j))
    rows = {
        "n1": (no(3), -b @ aA, no(3), -a @ bA,
               -2 * a1 @ b1 + a1 @ np.cross(i.w, b) + b1 @ np.cross(j.w, a)),
        "n2": n2,
        "displacement": n2,
        "p1": (no((3, 3)), sb @ aA, no((3, 3)), -sa @ bA,
               -2 * np.cross(a1, b1) + np.cross(b, w1a) - np.cross(a, w1b)),
        "p2": (-sa, (sa @ np_skew(arm_i) + sd @ sa) @ i.A, sa, -sa @ np_skew(arm_j) @ j.A,
               -2 * np.cross(a1, d1) + np.cross(a, w1i - w1j) + np.cross(d, w1a)),
        "point": (np.eye(3), -iA, -np.eye(3), jA, -w1i + w1j),
        "distance": (-2 * d, 2 * d @ iA, 2 * d, -2 * d @ jA, -2 * d1 @ d1 + 2 * d @ (w1i - w1j)),
    }[kind]  # fmt: skip
    return (*map(np.atleast_2d, rows[:4]), np.atleast_1d(rows[4]))
