"""All constraint rows of a system at once: residual, Jacobian, acceleration terms.

Rows of a kind are evaluated together (`jax.vmap`), so that what is compiled grows with the
number of kinds of primitive, not with the number of joints.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..mechanics.constraint import PRIMITIVES, ROWS, Data, Form, Row, Side, side
from ..mechanics.joint import Motion
from ..mechanics.state import Kinematics
from ..mechanics.system import System

RowChoice = Literal["body", "report"]


class Group(eqx.Module):
    """Primitives of one kind: stacked numbers, and which bodies and joint each belongs to."""

    kind: str = eqx.field(static=True)
    i: tuple[int, ...] = eqx.field(static=True)
    j: tuple[int, ...] = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    data: Data
    motions: tuple[Motion, ...]

    def rows(self, sides: Side, t: Float[Array, ""], form: Form) -> Row:
        """Rows of the group: value, target, gamma (k, c); J_i, J_j (k, c, 6 or 7)."""
        # one gather for all that is known of a body
        shape = jax.tree.map(lambda x: x[0], sides)
        unpack = ravel_pytree(shape)[1]
        table = jax.vmap(lambda body: ravel_pytree(body)[0])(sides)

        def one(i: Array, j: Array, data: Data) -> Row:
            return PRIMITIVES[self.kind](unpack(i), unpack(j), data, form)

        rows = jax.vmap(one)(_pick(table, self.i), _pick(table, self.j), self.data)
        if not self.motions:
            return rows
        return _driven(rows, self.motions, t, wrap=self.kind == "angle")


def _pick(table: Float[Array, "N w"], index: tuple[int, ...]) -> Float[Array, "k w"]:
    """The rows `index` of a table; they are known to lie inside it."""
    rows = table.at[np.array(index)]
    return rows.get(mode="promise_in_bounds", wrap_negative_indices=False)


def kinematic_sides(kin: Kinematics, form: Form) -> Side:
    """The sides of all bodies and ground, stacked."""
    return jax.vmap(lambda r, v, p, omega: side(r, v, p, omega, form))(
        kin.r, kin.v, kin.p, kin.omega
    )


def _driven(rows: Row, motions: tuple[Motion, ...], t: Float[Array, ""], *, wrap: bool) -> Row:
    """Subtract each row's prescribed motion, with its first and second derivatives."""

    def derivatives(motion: Motion) -> tuple[Array, Array, Array]:
        f = lambda time: jnp.asarray(motion(time), dtype=time.dtype)
        first = lambda time: jax.jvp(f, (time,), (jnp.ones_like(time),))[1]
        return f(t), *jax.jvp(first, (t,), (jnp.ones_like(t),))

    value, rate, second = (
        jnp.stack(x)[:, None] for x in zip(*map(derivatives, motions), strict=True)
    )
    off = rows.value - value
    if wrap:
        off = jnp.arctan2(jnp.sin(off), jnp.cos(off))
    return Row(off, rows.target + rate, rows.J_i, rows.J_j, rows.gamma + second)


class Equations(eqx.Module):
    """The constraint equations of a system at one state and time, m rows.

    Attributes:
        value: Phi (m,).
        target: J qdot = target (m,); zero but for drivers.
        J: (m, n, 6) for form "omega", in (v, omega'); (m, n, 7) for "p", in (v, pdot).
        gamma: J qddot = gamma (m,).
    """

    value: Float[Array, " m"]
    target: Float[Array, " m"]
    J: Float[Array, "m n w"]
    gamma: Float[Array, " m"]

    @property
    def matrix(self) -> Float[Array, "m nw"]:
        """J as a matrix (m, n w)."""
        return self.J.reshape(self.J.shape[0], self.J.shape[1] * self.J.shape[2])


class Constraints(eqx.Module):
    """The constraint rows of a system, grouped by kind for evaluation.

    Attributes:
        groups: one per kind of primitive that occurs.
        owner: for every row, in the groups' order, the place of its joint.
        n_bodies: moving bodies.
    """

    groups: tuple[Group, ...]
    owner: tuple[int, ...] = eqx.field(static=True)
    n_bodies: int = eqx.field(static=True)

    @property
    def n_rows(self) -> int:
        """Number of constraint rows m."""
        return len(self.owner)

    def scales(self) -> Float[Array, " m"]:
        """Factors that turn row residuals into metres: 1 / (2 l) for distances, else 1."""
        if not self.groups:
            return jnp.zeros((0,))
        ones = [jnp.ones(len(g.i) * ROWS[g.kind]) for g in self.groups]
        return jnp.concatenate(
            [
                0.5 / g.data.length if g.kind == "distance" else one
                for g, one in zip(self.groups, ones, strict=True)
            ]
        )

    def equations(self, t: Float[Array, ""], kin: Kinematics, form: Form = "omega") -> Equations:
        """Phi, targets, Jacobian and gamma at time t [s]."""
        n = self.n_bodies
        sides = kinematic_sides(kin, form)
        width = 6 if form == "omega" else 7
        parts = [(group, group.rows(sides, t, form)) for group in self.groups]
        if not parts:
            none = jnp.zeros((0,), kin.r.dtype)
            return Equations(none, none, jnp.zeros((0, n, width), kin.r.dtype), none)

        def flat(pick: str) -> Array:
            return jnp.concatenate([getattr(rows, pick).reshape(-1) for _, rows in parts])

        blocks = []
        for group, rows in parts:
            # one-hot products fuse where a scatter would not; ground has no column
            at_i = np.eye(n + 1)[list(group.i)][:, None, :n, None]
            at_j = np.eye(n + 1)[list(group.j)][:, None, :n, None]
            block = at_i * rows.J_i[:, :, None, :] + at_j * rows.J_j[:, :, None, :]
            blocks.append(block.reshape(-1, n, width))
        return Equations(flat("value"), flat("target"), jnp.concatenate(blocks), flat("gamma"))


def constraints(system: System, rows: RowChoice = "body") -> Constraints:
    """Group the rows of all joints of a system by kind.

    `rows="report"` takes parallel axes as cross products with two of three rows kept by the
    report's rule; "body" the equivalent perpendicularity to two axes fixed in body i.
    """
    ground = system.n_bodies
    place = {name: k for k, name in enumerate(system.names)}
    com = jnp.concatenate([system.bodies.com, jnp.zeros((1, 3), system.bodies.com.dtype)])
    found: dict[str, list[tuple[int, int, int, Data, Motion | None]]] = {}
    for number, joint in enumerate(system.joints):
        i, j = place.get(joint.body_i, ground), place.get(joint.body_j, ground)
        for term in joint.terms(rows):
            entry = (i, j, number, joint.data(term, com[i], com[j]), joint.motion)
            found.setdefault(term.kind, []).append(entry)
    groups = []
    owner: list[int] = []
    for kind in (k for k in PRIMITIVES if k in found):
        i, j, numbers, data, motions = zip(*found[kind], strict=True)
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *data)
        groups.append(
            Group(kind, i, j, numbers, stacked, tuple(m for m in motions if m is not None))
        )
        owner += [number for number in numbers for _ in range(ROWS[kind])]
    return Constraints(tuple(groups), tuple(owner), system.n_bodies)
