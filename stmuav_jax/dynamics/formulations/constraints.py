"""All constraint rows of a system at once: residuals, Jacobian, acceleration terms.

Rows of one kind are evaluated together, so that the size of the compiled program grows with
the number of kinds of primitives, not with the number of joints.
"""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.numbers import as_numpy, stacked
from ...mechanics.constraint import ANGULAR, PRIMITIVES, ROWS, BodyKinematics, Data, Form, Row, side
from ...mechanics.joint import Motion
from ...mechanics.state import Kinematics
from ...mechanics.system import System

RowChoice = Literal["body", "report"]


class ConstraintGroup(eqx.Module):
    """Primitives of one kind: stacked parameters, and the bodies and joint of each."""

    kind: str = eqx.field(static=True)
    i: tuple[int, ...] = eqx.field(static=True)
    j: tuple[int, ...] = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    data: Data
    motions: tuple[Motion, ...]

    def rows(self, sides: BodyKinematics, t: Float[Array, "*s"], form: Form) -> Row:
        """Rows of the group: value, target, gamma (c, k, *s); J_i, J_j (c, 6 or 7, k, *s).

        Args:
            sides: kinematics of all bodies and ground, with the body axis behind the components.
            t: time [s]; the axes of a batch of states, if any, come last everywhere.
        """
        i, j = at_bodies(sides, self.i), at_bodies(sides, self.j)
        rows = PRIMITIVES[self.kind](i, j, self.data, form)
        return _driven(rows, self.motions, t, wrap=self.kind == "angle") if self.motions else rows


def at_bodies(sides: BodyKinematics, index: Sequence[int]) -> BodyKinematics:
    """Kinematics of the bodies with the given indices."""
    vectors, matrices = ("r", "v", "omega_w", "velocity"), ("R_wb", "turn", "rest")
    places = np.array(index)
    picked = {
        name: getattr(sides, name)
        .at[(slice(None),) * axis + (places,)]
        .get(mode="promise_in_bounds", wrap_negative_indices=False)
        for names, axis in ((vectors, 1), (matrices, 2))
        for name in names
    }
    return BodyKinematics(**picked)


def kinematic_sides(kin: Kinematics) -> BodyKinematics:
    """Kinematics of all bodies and ground for form "omega", with the body axis last."""
    R = jnp.moveaxis(kin.R_wb, 0, -1)
    velocity = jnp.concatenate([kin.v, kin.omega], axis=1).T
    return BodyKinematics(kin.r.T, kin.v.T, R, kin.omega_w.T, R, R, velocity)


def sides_in_p(kin: Kinematics, p: Float[Array, "n 4"]) -> BodyKinematics:
    """Kinematics of all bodies and ground for form "p", in the rates of the Euler parameters."""
    unit = jnp.array([[1.0, 0.0, 0.0, 0.0]], p.dtype)
    one = lambda r, v, p, omega: side(r, v, p, omega, "p")
    return jax.vmap(one, out_axes=-1)(kin.r, kin.v, jnp.concatenate([p, unit]), kin.omega)


def _driven(rows: Row, motions: tuple[Motion, ...], t: Float[Array, "*s"], *, wrap: bool) -> Row:
    """Subtract each row's prescribed motion, with its first and second derivatives."""

    def derivatives(motion: Motion, at: Array) -> tuple[Array, Array, Array]:
        f = lambda time: jnp.asarray(motion(time), dtype=time.dtype)
        first = lambda time: jax.jvp(f, (time,), (jnp.ones_like(time),))[1]
        return f(at), *jax.jvp(first, (at,), (jnp.ones_like(at),))

    def each(motion: Motion) -> tuple[Array, ...]:
        return jax.vmap(lambda at: derivatives(motion, at))(t) if t.ndim else derivatives(motion, t)

    value, rate, second = (jnp.stack(x)[None] for x in zip(*map(each, motions), strict=True))
    off = rows.value - value
    if wrap:
        off = jnp.arctan2(jnp.sin(off), jnp.cos(off))
    return Row(off, rows.target + rate, rows.J_i, rows.J_j, rows.gamma + second)


class Equations(eqx.Module):
    """Constraint equations of a system at one state and time, m rows.

    Attributes:
        value: constraint functions Phi (m,).
        target: right-hand side of J qdot = target (m,); zero except for drivers.
        J: Jacobian (m, n, 6) in (v, omega') for form "omega", (m, n, 7) in (v, pdot) for "p".
        gamma: right-hand side of J qddot = gamma (m,).
    """

    value: Float[Array, " m"]
    target: Float[Array, " m"]
    J: Float[Array, "m n w"]
    gamma: Float[Array, " m"]

    @property
    def matrix(self) -> Float[Array, "m nw"]:
        """Jacobian J as a matrix (m, n w)."""
        return self.J.reshape(self.J.shape[0], self.J.shape[1] * self.J.shape[2])


class Constraints(eqx.Module):
    """Constraint rows of a system, grouped by kind for evaluation.

    Attributes:
        groups: one group per kind of primitive that occurs.
        owner: index of the joint of every row, in the groups' order.
        n_bodies: number of moving bodies.
    """

    groups: tuple[ConstraintGroup, ...]
    owner: tuple[int, ...] = eqx.field(static=True)
    n_bodies: int = eqx.field(static=True)

    @property
    def n_rows(self) -> int:
        """Number of constraint rows m."""
        return len(self.owner)

    def scales(self) -> Float[Array, "m *s"]:
        """Factors that turn rows into lengths or angles: 1 / (2 l) for distances, else 1.

        The conversion holds near zero; rows that are cosines become angles [rad], see `angular`.
        """
        if not self.groups:
            return jnp.zeros((0,))
        lengths = [(g.kind, jnp.repeat(g.data.length, ROWS[g.kind], axis=0)) for g in self.groups]
        return jnp.concatenate(
            [0.5 / x if kind == "distance" else jnp.ones_like(x) for kind, x in lengths]
        )

    @property
    def angular(self) -> np.ndarray:
        """True for rows (m,) that are a cosine or an angle [rad], false for lengths [m]."""
        kinds = [np.full(len(g.i) * ROWS[g.kind], g.kind in ANGULAR) for g in self.groups]
        return np.concatenate([np.zeros(0, bool), *kinds])

    def equations(
        self, t: Float[Array, ""], kin: Kinematics, p: Float[Array, "n 4"] | None = None
    ) -> Equations:
        """Constraint functions, targets, Jacobian and gamma at time t [s].

        They are in form "omega", or in form "p" if the bodies' Euler parameters p are given.
        """
        n = self.n_bodies
        form: Form = "omega" if p is None else "p"
        sides = kinematic_sides(kin) if p is None else sides_in_p(kin, p)
        width = 6 if p is None else 7
        parts = [(group, group.rows(sides, t, form)) for group in self.groups]
        if not parts:
            none = jnp.zeros((0,), kin.r.dtype)
            return Equations(none, none, jnp.zeros((0, n, width), kin.r.dtype), none)

        def flat(name: str) -> Array:
            return jnp.concatenate([getattr(rows, name).T.reshape(-1) for _, rows in parts])

        blocks = []
        for group, rows in parts:
            # products with 0 and 1 fuse where a scatter would not; ground has no column
            at_i = np.eye(n + 1)[list(group.i)][:, None, :n, None]
            at_j = np.eye(n + 1)[list(group.j)][:, None, :n, None]
            J_i, J_j = (jnp.moveaxis(J, -1, 0)[:, :, None, :] for J in (rows.J_i, rows.J_j))
            block = at_i * J_i + at_j * J_j
            blocks.append(block.reshape(-1, n, width))
        return Equations(flat("value"), flat("target"), jnp.concatenate(blocks), flat("gamma"))


def constraints(
    system: System, rows: RowChoice = "body", joints: Sequence[int] | None = None
) -> Constraints:
    """Group the rows of all joints of a system, or of the joints with given indices, by kind.

    `rows="report"` expresses parallel axes by cross products with two of three rows kept by the
    report's rule; "body" by the equivalent perpendicularity to two axes fixed in body i.
    """
    ground = system.n_bodies
    place = {name: k for k, name in enumerate(system.names)}
    centres = as_numpy(system.bodies.com)
    com = [*centres, np.zeros(3, centres.dtype)]
    found: dict[str, list[tuple[int, int, int, Data, Motion | None]]] = {}
    for number, joint in enumerate(map(as_numpy, system.joints)):
        if joints is not None and number not in joints:
            continue
        i, j = place.get(joint.body_i, ground), place.get(joint.body_j, ground)
        for term in joint.terms(rows):
            entry = (i, j, number, joint.data(term, com[i], com[j]), joint.motion)
            found.setdefault(term.kind, []).append(entry)
    groups = []
    owner: list[int] = []
    for kind in (k for k in PRIMITIVES if k in found):
        i, j, numbers, data, motions = zip(*found[kind], strict=True)
        joined = jax.tree.map(lambda *x: stacked(x, axis=-1), *data)
        groups.append(
            ConstraintGroup(kind, i, j, numbers, joined, tuple(m for m in motions if m is not None))
        )
        owner += [number for number in numbers for _ in range(ROWS[kind])]
    return Constraints(tuple(groups), tuple(owner), system.n_bodies)
