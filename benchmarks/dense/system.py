"""The report's own method in NumPy: one dense system (83 x 83 for the UAV), not stabilised.

With b bodies and m rows, unknowns qddot (7 b) and -lambda (m),

    [ M      B^T ] [ qddot   ]   [ g - c1  ]
    [ P      0   ] [ -lambda ] = [   -c2   ]
    [ Phi_q  0   ]               [ gamma^m ]

and the state is x = (r_i, p_i of all bodies, then their rates). Cross products keep two of three
rows, chosen anew at every evaluation. It shares no equation with the package, so it is also a
check of the package.

Source: AFRL-AFOSR-JP-TR-2019-0058, Part I, Table 3.1 and Eq. 4.19 (Part II, 4.1 and 4.23), with
their misprints corrected.
"""

from typing import Any

import numpy as np
from dense.steps import History, Scheme, integrate
from dense.tables import KINDS, Array, Rows, Tables, Variant, cross, g_and_l, times
from problems.plain import plain, start
from problems.tree import in_plane

from stmuav_jax import Scene

# Singular values below this, relative to the largest, are those of dependent rows.
DEPENDENT = 1e-13
_UP = np.array([0.0, 0.0, 1.0])


class Dense:
    """The report's system of a scene, in one variant."""

    def __init__(self, scene: Scene, variant: Variant | None = None) -> None:
        self.variant = variant if variant is not None else Variant()
        model = plain(scene, any_couple=True)
        # planar loops of spatial joints
        self.redundant = in_plane(model) is not None and len(model.joints) > model.n
        self.model = model
        self.tables, n = Tables(self.model.joints), self.model.n
        self.K = np.zeros((7 * n + self.tables.count, 7 * n + self.tables.count))
        for k in range(n):
            self.K[6 * k : 6 * k + 3, 7 * k : 7 * k + 3] = self.model.mass[k] * np.eye(3)
        body = np.arange(n)
        self.at_turning = (
            (6 * body + 3)[:, None, None] + np.arange(3)[:, None],
            (7 * body + 3)[:, None, None] + np.arange(4),
        )
        self.at_norm = ((6 * n + body)[:, None], (7 * body + 3)[:, None] + np.arange(4))
        self.keep: dict[str, Array] | None = None
        if self.variant.frozen:
            G, L = g_and_l(self.split(self.start(scene))[0][:, 3:])
            self.keep = self.tables.chosen(G @ L.transpose(0, 2, 1))

    def start(self, scene: Scene, p: dict[str, Any] | None = None) -> Array:
        """The scene's initial state; `p` replaces Euler parameters by name, as they are."""
        first = start(scene)
        turned = np.array(first.p)
        for name, value in (p or {}).items():
            turned[self.model.names.index(name)] = value
        p_rate = 0.5 * np.einsum("nap,na->np", g_and_l(turned)[1], first.omega)
        parts = (first.r, turned), (first.v, p_rate)
        return np.concatenate([np.concatenate(part, axis=1).ravel() for part in parts])

    def split(self, x: Array) -> tuple[Array, Array]:
        """(r, p) of all bodies and their rates, each (n + 1, 7) with ground last."""
        n = self.model.n
        q, u = np.zeros((n + 1, 7)), np.zeros((n + 1, 7))
        q[n, 3] = 1.0
        q[:n], u[:n] = x[: 7 * n].reshape(n, 7), x[7 * n : 14 * n].reshape(n, 7)
        return q, u

    def positions(self, x: Array) -> Array:
        """Centres of mass (..., n, 3) [m] of one or many states."""
        n = self.model.n
        return x[..., : 7 * n].reshape(*x.shape[:-1], n, 7)[..., :3]

    def loads(self, t: float, r: Array, A: Array) -> tuple[Array, Array]:
        """World forces and body moments (n + 1, 3), ground last."""
        model = self.model
        force, moment = np.zeros((model.n + 1, 3)), np.zeros((model.n + 1, 3))
        force[:-1] = model.mass[:, None] * model.gravity
        for k, f, n in model.wrenches:
            force[k] += A[k] @ f
            moment[k] += n
        for act in model.actuators:
            along = act.force(t) * _UP
            push, arm = A[act.base] @ along, A[act.base] @ act.arm
            force[act.base] -= push
            moment[act.base] -= cross(act.arm, along)
            force[act.slider] += push
            if act.paired:
                lever = r[act.base] + arm - r[act.slider]
                moment[act.slider] += A[act.slider].T @ cross(lever, push)
        for k, f in model.forces:
            force[k] += f(t)
        for k, n in model.moments:
            moment[k] += A[k].T @ n
        return force, moment

    def pulls(self, q: Array, u: Array, A: Array, omega: Array) -> list[tuple[int, Array, Array]]:
        """Forces that depend on the state, springs and servos: body, world force, world arm."""
        r, v = q[:, :3], u[:, :3]

        def point(body: int, place: Array) -> tuple[Array, Array, Array]:
            arm = A[body] @ place
            return r[body] + arm, v[body] + A[body] @ cross(omega[body], place), arm

        found = []
        for s in self.model.springs:
            (a, a_rate, arm_a), (b, b_rate, arm_b) = point(s.i, s.point_i), point(s.j, s.point_j)
            d = b - a
            now = np.linalg.norm(d)
            pull = s.stiffness * (now - s.length) + s.damping * (d @ (b_rate - a_rate)) / now
            found += [(s.i, pull / now * d, arm_a), (s.j, -pull / now * d, arm_b)]
        for servo in self.model.servos:
            joint = self.model.joints[servo.joint]
            a, a_rate, _ = point(joint.i, joint.point_i)
            b, b_rate, arm_b = point(joint.j, joint.point_j)
            axis = A[joint.i] @ joint.frame_i[:, 2]
            spin = cross(A[joint.i] @ omega[joint.i], b - a)
            x, x_rate = axis @ (b - a), axis @ (b_rate - a_rate - spin)
            push = -servo.stiffness * (x - servo.target) - servo.damping * x_rate
            # both at the second body's point, so that they have no net moment
            found += [(joint.j, push * axis, arm_b), (joint.i, -push * axis, b - r[joint.i])]
        return found

    def matrix(self, t: float, x: Array) -> tuple[Array, Array]:
        """The large matrix, which the next call overwrites, and its right-hand side."""
        n, m, K = self.model.n, self.tables.count, self.K
        q, u = self.split(x)
        (G, L), (Gd, Ld) = g_and_l(q[:, 3:]), g_and_l(u[:, 3:])
        inertia, p_rate, turned = self.model.inertia, u[:n, 3:], L.transpose(0, 2, 1)
        A = G @ turned
        force, moment = self.loads(t, q[:, :3], A)
        omega = 2 * times(L[:n], p_rate)
        if self.model.springs or self.model.servos:
            for k, f, arm in self.pulls(q, u, A, np.concatenate([omega, np.zeros((1, 3))])):
                force[k] += f
                moment[k] += A[k].T @ cross(arm, f)
        # L H pdot with H = 4 Ldot^T J L, as the report writes it
        turning = 2 * times(L[:n] @ Ld[:n].transpose(0, 2, 1), times(inertia, omega))
        K[self.at_turning] = 2 * inertia @ L[:n]
        K[self.at_norm] = q[:n, 3:]
        right = np.empty(7 * n + m)
        right[: 6 * n] = np.concatenate([force[:n], moment[:n] - turning], axis=1).ravel()
        right[6 * n : 7 * n] = -(p_rate * p_rate).sum(1)
        Phi, B = np.zeros((m, n + 1, 7)), np.zeros((m, n + 1, 6))
        first, keep = 0, self.keep if self.keep is not None else self.tables.chosen(A)
        rows = self.tables.rows(q, u, G, (Gd, Ld), self.variant)
        for kind, g in self.tables.groups.items():
            row = rows[kind].two(keep[kind]) if kind in keep else rows[kind]
            k, c = row.gamma.shape
            at = first + np.arange(k * c).reshape(k, c)
            i, j = g.i[:, None], g.j[:, None]
            Phi[at, i, :3], Phi[at, i, 3:], B[at, i, :3] = row.r_i, row.p_i, row.r_i
            Phi[at, j, :3], Phi[at, j, 3:], B[at, j, :3] = row.r_j, row.p_j, row.r_j
            B[at, i, 3:], B[at, j, 3:] = 0.5 * row.p_i @ turned[g.i], 0.5 * row.p_j @ turned[g.j]
            right[7 * n + first : 7 * n + first + k * c] = row.gamma.ravel()
            first += k * c
        K[7 * n :, : 7 * n] = Phi[:, :n].reshape(m, 7 * n)
        K[: 6 * n, 7 * n :] = B[:, :n].reshape(m, 6 * n).T
        return K, right

    def accelerations(self, t: float, x: Array) -> Array:
        """(rddot, pddot) of every body, (n, 7)."""
        (K, right), n = self.matrix(t, x), self.model.n
        if self.redundant:
            found = np.linalg.lstsq(K, right, rcond=DEPENDENT)[0]
        else:
            found = np.linalg.solve(K, right)
        return found[: 7 * n].reshape(n, 7)

    def rate(self, t: float, x: Array) -> Array:
        """dx/dt."""
        n = self.model.n
        return np.concatenate([x[7 * n : 14 * n], self.accelerations(t, x).ravel()])

    def residuals(self, x: Array) -> dict[str, float]:
        """Largest residual of each kind, all rows of cross products counted [m or 1]."""
        q, u = self.split(x)
        G, L = g_and_l(q[:, 3:])
        rows: dict[str, Rows] = self.tables.rows(q, 0 * u, G, (0 * G, 0 * L), Variant())
        return {kind: float(np.abs(rows[kind].value).max(initial=0)) for kind in KINDS}

    def gap(self, x: Array) -> float:
        """Largest residual of the rows that are lengths [m]."""
        found = self.residuals(x)
        return max(found["point"], found["p2"])

    def violation(self, x: Array) -> float:
        """Largest residual, all three rows of cross products counted [m], axes' rows [1]."""
        found = self.residuals(x)
        return max(self.gap(x), found["n1"], found["p1"])

    def norm_error(self, x: Array) -> float:
        """Largest | |p| - 1 |."""
        return float(np.max(np.abs(np.linalg.norm(self.split(x)[0][:-1, 3:], axis=1) - 1)))


def attempt(
    scene: Scene,
    times: Array,
    scheme: Scheme,
    variant: Variant | None = None,
    p: dict[str, Any] | None = None,
) -> tuple[Dense, History]:
    """One run of the dense system, its states kept at `times`."""
    model = Dense(scene, variant)
    return model, integrate(model.rate, model.start(scene, p), times, scheme)
