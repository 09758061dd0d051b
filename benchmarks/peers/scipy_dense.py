"""The report's own method in NumPy: one dense 83 x 83 system, SciPy, no stabilisation.

With b bodies and m rows, unknowns qddot (7 b) and -lambda (m),

    [ M      B^T ] [ qddot   ]   [ g - c1  ]
    [ P      0   ] [ -lambda ] = [   -c2   ]
    [ Phi_q  0   ]               [ gamma^m ]

and the state is x = (r_i, p_i, rdot_i, pdot_i). Cross products keep two of three rows, chosen
anew at every evaluation.

Source: AFRL-AFOSR-JP-TR-2019-0058, Part I, Table 3.1 and Eq. 4.19 (Part II, 4.1 and 4.23),
with their misprints corrected.
"""

import importlib.util
from dataclasses import dataclass

import numpy as np
from adapter import Outcome, Peer, Prepared, Setting

from stmuav_jax import Scene

from .plain import Plain, loop_seconds, plain, start, why_not
from .scipy_run import follow
from .tree import in_plane

# The report's primitives: the point, and axes as columns of frames i and j.
_TERMS = {
    "spherical": (("point", 2, 2),),
    "universal": (("point", 2, 2), ("n1", 0, 1)),
    "revolute": (("point", 2, 2), ("p1", 2, 2)),
    "translational": (("p1", 2, 2), ("p2", 2, 2), ("n1", 0, 1)),
}
# Singular values below this, relative to the largest, are those of dependent rows.
DEPENDENT = 1e-13
_KEEP = np.array([[1, 2], [0, 2], [0, 1]])


def skew(a: np.ndarray) -> np.ndarray:
    """Cross-product matrices (..., 3, 3)."""
    out = np.zeros((*a.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -a[..., 2], a[..., 1], -a[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = a[..., 2], -a[..., 1], a[..., 0]
    return out


def matrices(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """G = [-e, e~ + e0 I] and L = [-e, -e~ + e0 I], (..., 3, 4)."""
    e = p[..., 1:]
    scalar, cross = p[..., :1, None] * np.eye(3), skew(e)
    column = -e[..., None]
    return (
        np.concatenate([column, scalar + cross], axis=-1),
        np.concatenate([column, scalar - cross], axis=-1),
    )


def bar(a: np.ndarray) -> np.ndarray:
    """4 x 4 matrices with L(p)^T a = bar(a) p, (..., 4, 4)."""
    out = np.zeros((*a.shape[:-1], 4, 4))
    out[..., 0, 1:], out[..., 1:, 0], out[..., 1:, 1:] = -a, a, -skew(a)
    return out


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b along the last axis; faster than np.cross for a few vectors."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


@dataclass(frozen=True)
class Group:
    """Primitives of a kind: their bodies, and where their fixed vectors are in the list."""

    i: np.ndarray
    j: np.ndarray
    axis_i: np.ndarray
    axis_j: np.ndarray
    point_i: np.ndarray
    point_j: np.ndarray


class Fixed:
    """All body-fixed vectors of the constraints, evaluated together."""

    def __init__(self, model: Plain) -> None:
        self.bodies: list[int] = []
        self.vectors: list[np.ndarray] = []
        found: dict[str, list[tuple[int, ...]]] = {k: [] for k in ("point", "n1", "p1", "p2")}
        for joint in model.joints:
            for kind, x, y in _TERMS[joint.kind]:
                found[kind].append(
                    (
                        joint.i,
                        joint.j,
                        self._add(joint.i, joint.frame_i[:, x]),
                        self._add(joint.j, joint.frame_j[:, y]),
                        self._add(joint.i, joint.point_i),
                        self._add(joint.j, joint.point_j),
                    )
                )
        self.groups = {
            kind: Group(*np.array(rows, dtype=int).reshape(-1, 6).T) for kind, rows in found.items()
        }
        self.at = np.array(self.bodies, dtype=int)
        self.s = np.array(self.vectors).reshape(-1, 3)
        self.bars = bar(self.s)

    def _add(self, body: int, vector: np.ndarray) -> int:
        self.bodies.append(body)
        self.vectors.append(vector)
        return len(self.bodies) - 1


@dataclass(frozen=True)
class Rows:
    """Rows of one kind (k, c, .): Jacobians in (rdot, pdot) of i and j, gamma, and Phi."""

    r_i: np.ndarray
    p_i: np.ndarray
    r_j: np.ndarray
    p_j: np.ndarray
    gamma: np.ndarray
    value: np.ndarray


class Dense:
    """The report's system of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.model = plain(scene)
        self.fixed = Fixed(self.model)
        n, groups = self.model.n, self.fixed.groups
        self.m = sum(len(g.i) * c for g, c in zip(groups.values(), (3, 1, 2, 2), strict=True))
        self.K = np.zeros((7 * n + self.m, 7 * n + self.m))
        # planar loops of spatial joints
        self.redundant = in_plane(self.model) is not None and len(self.model.joints) > n
        for k in range(n):
            self.K[6 * k : 6 * k + 3, 7 * k : 7 * k + 3] = self.model.mass[k] * np.eye(3)
        body = np.arange(n)
        self.at_turning = (
            (6 * body + 3)[:, None, None] + np.arange(3)[:, None],
            (7 * body + 3)[:, None, None] + np.arange(4),
        )
        self.at_norm = ((6 * n + body)[:, None], (7 * body + 3)[:, None] + np.arange(4))
        first = start(scene)
        L = matrices(first.p)[1]
        p_rate = 0.5 * np.einsum("nap,na->np", L, first.omega)
        self.x0 = np.concatenate(
            [
                np.concatenate([a, b], axis=1).ravel()
                for a, b in ((first.r, first.p), (first.v, p_rate))
            ]
        )

    def rows(self, q: np.ndarray, u: np.ndarray, G: np.ndarray, Gd: np.ndarray, Ld: np.ndarray):
        """Rows of every kind; q, u (n + 1, 7) with ground last."""
        f, at = self.fixed, self.fixed.at
        D = 2 * G[at] @ f.bars
        h = -2 * np.einsum("nab,ncb,nc->na", Gd[at], Ld[at], f.s)
        s = 0.5 * np.einsum("nab,nb->na", D, q[at, 3:])
        rate = np.einsum("nab,nb->na", D, u[at, 3:])
        r, v = q[:, :3], u[:, :3]
        eye = np.eye(3)[None]
        out: list[tuple[Group, Rows]] = []
        g = f.groups["point"]
        a, b, none = g.point_i, g.point_j, np.zeros((len(g.i), 3, 3))
        value = r[g.i] + s[a] - r[g.j] - s[b]
        out.append((g, Rows(none + eye, D[a], none - eye, -D[b], h[a] - h[b], value)))
        g = f.groups["n1"]
        a, b, none = g.axis_i, g.axis_j, np.zeros((len(g.i), 1, 3))
        gamma = (s[a] * h[b] + s[b] * h[a] - 2 * rate[a] * rate[b]).sum(1, keepdims=True)
        value = (s[a] * s[b]).sum(1, keepdims=True)
        p_i, p_j = s[b][:, None] @ D[a], s[a][:, None] @ D[b]
        out.append((g, Rows(none, p_i, none, p_j, gamma, value)))
        g = f.groups["p1"]
        a, b, none = g.axis_i, g.axis_j, np.zeros((len(g.i), 3, 3))
        A, B = skew(s[a]), skew(s[b])
        gamma = cross(s[a], h[b]) - cross(s[b], h[a]) - 2 * cross(rate[a], rate[b])
        every = Rows(none, -B @ D[a], none, A @ D[b], gamma, cross(s[a], s[b]))
        out.append((g, _two(every, s[a])))
        g = f.groups["p2"]
        a, b, c = g.axis_i, g.point_i, g.point_j
        d = r[g.j] + s[c] - r[g.i] - s[b]
        d_rate = v[g.j] + rate[c] - v[g.i] - rate[b]
        A, C = skew(s[a]), skew(d)
        gamma = cross(s[a], h[c] - h[b]) - cross(d, h[a]) - 2 * cross(rate[a], d_rate)
        every = Rows(-A, -A @ D[b] - C @ D[a], A, A @ D[c], gamma, cross(s[a], d))
        out.append((g, _two(every, s[a])))
        return out

    def loads(self, t: float, r: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World forces and body moments (n + 1, 3), ground last."""
        model = self.model
        force, moment = np.zeros((model.n + 1, 3)), np.zeros((model.n + 1, 3))
        force[:-1] = model.mass[:, None] * model.gravity
        for k, f, n in model.wrenches:
            force[k] += A[k] @ f
            moment[k] += n
        for act in model.actuators:
            push, arm = act.force(t) * A[act.base][:, 2], A[act.base] @ act.arm
            lever = r[act.base] + arm - r[act.slider]
            force[act.base] -= push
            moment[act.base] -= A[act.base].T @ cross(arm, push)
            force[act.slider] += push
            moment[act.slider] += A[act.slider].T @ cross(lever, push)
        for k, f in model.forces:
            force[k] += f(t)
        for k, n in model.moments:
            moment[k] += A[k].T @ n
        return force, moment

    def pulls(
        self, q: np.ndarray, u: np.ndarray, A: np.ndarray, omega: np.ndarray
    ) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Forces that depend on the state, springs and servos: body, world force, world arm."""
        r, v = q[:, :3], u[:, :3]

        def point(body: int, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            arm = A[body] @ place
            return r[body] + arm, v[body] + A[body] @ cross(omega[body], place), arm

        found = []
        for s in self.model.springs:
            a, a_rate, arm_a = point(s.i, s.point_i)
            b, b_rate, arm_b = point(s.j, s.point_j)
            d = b - a
            now = np.linalg.norm(d)
            pull = s.stiffness * (now - s.length) + s.damping * (d @ (b_rate - a_rate)) / now
            found += [(s.i, pull / now * d, arm_a), (s.j, -pull / now * d, arm_b)]
        for servo in self.model.servos:
            joint = self.model.joints[servo.joint]
            a, a_rate, arm_a = point(joint.i, joint.point_i)
            b, b_rate, arm_b = point(joint.j, joint.point_j)
            axis = A[joint.i] @ joint.frame_i[:, 2]
            spin = cross(A[joint.i] @ omega[joint.i], b - a)
            x, x_rate = axis @ (b - a), axis @ (b_rate - a_rate - spin)
            push = -servo.stiffness * (x - servo.target) - servo.damping * x_rate
            # both at the second body's point, so that they have no net moment
            found += [(joint.j, push * axis, arm_b), (joint.i, -push * axis, b - r[joint.i])]
        return found

    def acceleration(self, t: float, x: np.ndarray) -> np.ndarray:
        """qddot of all bodies (7 n,)."""
        n, m, K = self.model.n, self.m, self.K
        q, u = np.zeros((n + 1, 7)), np.zeros((n + 1, 7))
        q[n, 3] = 1.0
        q[:n], u[:n] = x[: 7 * n].reshape(n, 7), x[7 * n :].reshape(n, 7)
        (G, L), (Gd, Ld) = matrices(q[:, 3:]), matrices(u[:, 3:])
        inertia, p_rate = self.model.inertia, u[:n, 3:]
        A = G @ L.transpose(0, 2, 1)
        force, moment = self.loads(t, q[:, :3], A)
        omega = 2 * np.einsum("nab,nb->na", L[:n], p_rate)
        if self.model.springs or self.model.servos:
            for k, f, arm in self.pulls(q, u, A, np.concatenate([omega, np.zeros((1, 3))])):
                force[k] += f
                moment[k] += A[k].T @ cross(arm, f)
        turning = cross(omega, np.einsum("nab,nb->na", inertia, omega))
        K[self.at_turning] = 2 * inertia @ L[:n]
        K[self.at_norm] = q[:n, 3:]
        right = np.empty(7 * n + m)
        right[: 6 * n] = np.concatenate([force[:n], moment[:n] - turning], axis=1).ravel()
        right[6 * n : 7 * n] = -(p_rate * p_rate).sum(1)
        Phi, B = np.zeros((m, n + 1, 7)), np.zeros((m, n + 1, 6))
        first = 0
        for g, row in self.rows(q, u, G, Gd, Ld):
            k, c = row.gamma.shape
            at = first + np.arange(k * c).reshape(k, c)
            i, j = g.i[:, None], g.j[:, None]
            Phi[at, i, :3], Phi[at, i, 3:], B[at, i, :3] = row.r_i, row.p_i, row.r_i
            Phi[at, j, :3], Phi[at, j, 3:], B[at, j, :3] = row.r_j, row.p_j, row.r_j
            B[at, i, 3:] = 0.5 * row.p_i @ L[g.i].transpose(0, 2, 1)
            B[at, j, 3:] = 0.5 * row.p_j @ L[g.j].transpose(0, 2, 1)
            right[7 * n + first : 7 * n + first + k * c] = row.gamma.ravel()
            first += k * c
        K[7 * n :, : 7 * n] = Phi[:, :n].reshape(m, 7 * n)
        K[: 6 * n, 7 * n :] = B[:, :n].reshape(m, 6 * n).T
        if self.redundant:
            return np.linalg.lstsq(K, right, rcond=DEPENDENT)[0][: 7 * n]
        return np.linalg.solve(K, right)[: 7 * n]

    def rate(self, t: float, x: np.ndarray) -> np.ndarray:
        """dx/dt."""
        return np.concatenate([x[7 * self.model.n :], self.acceleration(t, x)])

    def gap(self, x: np.ndarray) -> float:
        """Largest residual of the rows that are lengths [m]."""
        n = self.model.n
        q = np.concatenate([x[: 7 * n].reshape(n, 7), np.eye(7)[3:4]])
        G, L = matrices(q[:, 3:])
        rows = self.rows(q, np.zeros_like(q), G, 0 * G, 0 * L)
        return max((float(np.abs(rows[k][1].value).max(initial=0)) for k in (0, 3)), default=0.0)


def _two(rows: Rows, axis: np.ndarray) -> Rows:
    """Two of three rows: without the one where the world axis is largest."""
    keep = _KEEP[np.abs(axis).argmax(axis=1)]
    at = np.arange(len(axis))[:, None]
    return Rows(*(x[at, keep] for x in vars(rows).values()))


class ScipyDense(Peer):
    """The report's method in NumPy and SciPy."""

    name = "NumPy, the report's dense system"
    packages = ("scipy",)
    how = (
        "One dense system per evaluation by numpy.linalg.solve; SciPy's solvers, "
        "rtol = atol = tolerance."
    )
    caveats = (
        "Planar loops of spatial joints, whose rows are dependent: least squares by numpy.linalg.lstsq.",
        "Not stabilised: violations of the constraints stay and grow.",
    )

    def missing(self) -> str:
        return "" if importlib.util.find_spec("scipy") else "The package scipy is not installed."

    def version(self) -> str:
        import scipy

        return f"NumPy {np.__version__}, SciPy {scipy.__version__}"

    def unsupported(self, scene: Scene) -> str:
        return why_not(scene)

    def settings(self) -> list[Setting]:
        return [
            *(Setting("RK45", tolerance=10.0**-k) for k in (4, 6, 8)),
            *(Setting("DOP853", tolerance=10.0**-k) for k in (4, 6, 8, 10, 12)),
        ]

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        dense, tolerance = Dense(scene), setting.tolerance or 1e-6
        n = dense.model.n

        def run() -> Outcome:
            path = follow(dense.rate, dense.x0, scene.t0, times, setting.solver, tolerance)
            finite = [x for x in path.states if np.all(np.isfinite(x))]
            return Outcome(
                path.states[:, : 7 * n].reshape(-1, n, 7)[..., :3],
                path.evaluations,
                path.accepted,
                path.rejected,
                residual=max((dense.gap(x) for x in finite), default=None),
                failure=path.failure,
            )

        return Prepared(run)

    def acceleration_seconds(self, scene: Scene) -> float | None:
        dense = Dense(scene)
        return loop_seconds(lambda: dense.acceleration(scene.t0, dense.x0), loops=200)

    def start_accelerations(self, scene: Scene) -> np.ndarray:
        """Of the centres of mass at the start, world (n, 3) [m/s^2]."""
        dense = Dense(scene)
        return dense.acceleration(scene.t0, dense.x0).reshape(-1, 7)[:, :3]
