"""All constraint rows of a system at once: residuals, Jacobian, acceleration terms.

Rows of one kind are evaluated together, so that the size of the compiled program grows with
the number of kinds of primitives, not with the number of joints.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.numbers import array_module, as_numpy, stack_arrays
from ...math.stacked import gather_entries
from ...mechanics.constraint import (
    ANGULAR,
    COUPLINGS,
    PRIMITIVES,
    ROWS,
    BodyKinematics,
    Data,
    Form,
    Row,
    couple,
)
from ...mechanics.joint import CATALOGUE, READING, Joint, Motion
from ...mechanics.state import Kinematics
from ...mechanics.system import System


class Mates(eqx.Module):
    """Mates of a group of couplings: bodies, joints, stacked parameters, and numbers (k,) as in `Mate`."""

    i: tuple[int, ...] = eqx.field(static=True)
    j: tuple[int, ...] = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    data: Data
    ratio: Float[Array | np.ndarray, " k"]
    offset: Float[Array | np.ndarray, " k"]
    period: Float[Array | np.ndarray, " k"]


class ConstraintGroup(eqx.Module):
    """Primitives of one kind: stacked parameters, and the bodies and joint of each."""

    kind: str = eqx.field(static=True)
    i: tuple[int, ...] = eqx.field(static=True)
    j: tuple[int, ...] = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    data: Data
    motions: tuple[Motion, ...]
    mates: Mates | None = None

    @property
    def ends(self) -> tuple[tuple[int, ...], ...]:
        """Bodies i, bodies j, and those of the mates, as the blocks of a `Row`."""
        return (
            (self.i, self.j) if self.mates is None else (self.i, self.j, self.mates.i, self.mates.j)
        )

    def rows(self, sides: BodyKinematics, t: Float[Array, "*s"], form: Form) -> Row:
        """Rows of the group: value, target, gamma (c, k, *s); J_i, J_j (c, 6 or 7, k, *s).

        Args:
            sides: kinematics of all bodies and ground, with the body axis behind the components.
            t: time [s]; the axes of a batch of states, if any, come last everywhere.
        """
        i, j, *mate_ends = (at_bodies(sides, end) for end in self.ends)
        if self.mates is not None:
            dependent, mate = COUPLINGS[self.kind]
            batch = (1,) * (sides.r.ndim - 2)
            column = lambda x: jnp.asarray(x).reshape(-1, *batch)
            return couple(
                PRIMITIVES[dependent](i, j, self.data, form),
                PRIMITIVES[mate](mate_ends[0], mate_ends[1], self.mates.data, form),
                column(self.mates.ratio),
                column(self.mates.offset),
                column(self.mates.period),
            )
        rows = PRIMITIVES[self.kind](i, j, self.data, form)
        return (
            _subtract_motions(rows, self.motions, t, wrap=self.kind == "angle")
            if self.motions
            else rows
        )


def at_bodies(sides: BodyKinematics, index: Sequence[int]) -> BodyKinematics:
    """Kinematics of the bodies with the given indices."""
    r, v, omega_w, velocity = (
        gather_entries(x, index, 1) for x in (sides.r, sides.v, sides.omega_w, sides.velocity)
    )
    return BodyKinematics(r, v, gather_entries(sides.R_wb, index, 2), omega_w, velocity)


def kinematic_sides(kin: Kinematics) -> BodyKinematics:
    """Kinematics of all bodies and ground for form "omega", with the body axis last."""
    R = jnp.moveaxis(kin.R_wb, 0, -1)
    velocity = jnp.concatenate([kin.v, kin.omega], axis=1).T
    return BodyKinematics(kin.r.T, kin.v.T, R, kin.omega_w.T, velocity)


def _subtract_motions(
    rows: Row, motions: tuple[Motion, ...], t: Float[Array, "*s"], *, wrap: bool
) -> Row:
    """Subtract each row's prescribed motion, with its first and second derivatives."""

    def motion_derivatives(motion: Motion, at: Array) -> tuple[Array, Array, Array]:
        f = lambda time: jnp.asarray(motion(time), dtype=time.dtype)
        # Both derivatives of a driver's motion come from JAX, so that a user gives the motion alone and
        # cannot give inconsistent rates.
        first = lambda time: jax.jvp(f, (time,), (jnp.ones_like(time),))[1]
        return f(at), *jax.jvp(first, (at,), (jnp.ones_like(at),))

    def evaluate_motion(motion: Motion) -> tuple[Array, ...]:
        return (
            jax.vmap(lambda at: motion_derivatives(motion, at))(t)
            if t.ndim
            else motion_derivatives(motion, t)
        )

    value, rate, second = (
        jnp.stack(x)[None] for x in zip(*map(evaluate_motion, motions), strict=True)
    )
    deviation = rows.value - value
    if wrap:
        # A prescribed angle may run on beyond half a turn, while the angle between two bodies is known up to
        # whole turns only.
        deviation = jnp.arctan2(jnp.sin(deviation), jnp.cos(deviation))
    return Row(deviation, rows.target + rate, rows.J_i, rows.J_j, rows.gamma + second)


class Equations(eqx.Module):
    """Constraint equations of a system at one state and time, m rows.

    Attributes:
        value: constraint functions Phi (m,).
        target: right-hand side of J qdot = target (m,); zero except for drivers.
        J: Jacobian (m, n, 6) in (v, omega').
        gamma: right-hand side of J qddot = gamma (m,).
    """

    value: Float[Array, " m"]
    target: Float[Array, " m"]
    J: Float[Array, "m n 6"]
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

    def scales(self) -> Float[Array | np.ndarray, "m *s"]:
        """Factors that turn rows into lengths or angles: 1 / (2 l) for distances, else 1.

        The conversion holds near zero; rows that are cosines become angles [rad], see `angular`.
        """
        lengths = as_numpy([group.data.length for group in self.groups])
        xp = array_module(lengths)
        if not lengths:
            return xp.zeros(0)
        # A distance row is a difference of squares: its derivative by the length is 2 l, which turns its
        # residual into a length.
        factors = [
            0.5 / x if group.kind == "distance" else xp.ones_like(x)
            for group, x in zip(self.groups, lengths, strict=True)
        ]
        rows = [ROWS[group.kind] for group in self.groups]
        return xp.concatenate([xp.repeat(x, k, axis=0) for x, k in zip(factors, rows, strict=True)])

    @property
    def angular(self) -> np.ndarray:
        """True for rows (m,) that are a cosine or an angle [rad], false for lengths [m]."""
        kinds = [np.full(len(g.i) * ROWS[g.kind], g.kind in ANGULAR) for g in self.groups]
        return np.concatenate([np.zeros(0, bool), *kinds])

    def equations(self, t: Float[Array, ""], kin: Kinematics) -> Equations:
        """Constraint functions, targets, Jacobian and gamma at time t [s]."""
        n, sides = self.n_bodies, kinematic_sides(kin)
        parts = [(group, group.rows(sides, t, "omega")) for group in self.groups]
        if not parts:
            none = jnp.zeros((0,), kin.r.dtype)
            return Equations(none, none, jnp.zeros((0, n, 6), kin.r.dtype), none)

        def flatten_rows(name: str) -> Array:
            return jnp.concatenate([getattr(rows, name).T.reshape(-1) for _, rows in parts])

        blocks = []
        for group, rows in parts:
            # products with 0 and 1 fuse where a scatter would not; ground has no column
            at = [np.eye(n + 1)[list(end)][:, None, :n, None] for end in group.ends]
            J = [jnp.moveaxis(J, -1, 0)[:, :, None, :] for J in rows.blocks]
            block = sum(place * part for place, part in zip(at, J, strict=True))
            blocks.append(jnp.reshape(block, (-1, n, 6)))
        return Equations(
            flatten_rows("value"),
            flatten_rows("target"),
            jnp.concatenate(blocks),
            flatten_rows("gamma"),
        )


def group_constraints(system: System, joints: Sequence[int] | None = None) -> Constraints:
    """Group the rows of all joints of a system, or of the joints with given indices, by kind."""
    ground = system.n_bodies
    place = {name: k for k, name in enumerate(system.names)}
    centres = as_numpy(system.bodies.com)
    com = [*centres, np.zeros(3, centres.dtype)]
    # Rows are grouped by kind over all joints: a mechanism of any size compiles as many evaluations as
    # there are kinds.
    names = [joint.name for joint in system.joints]

    def entry_of(joint: Joint, term: Any) -> tuple[int, int, int, Data]:
        i, j = place.get(joint.body_i, ground), place.get(joint.body_j, ground)
        return i, j, names.index(joint.name), joint.data(term, com[i], com[j])

    entries_by_kind: dict[str, list[Any]] = {}
    for number, joint in enumerate(map(as_numpy, system.joints)):
        if joints is not None and number not in joints:
            continue
        for term in CATALOGUE[joint.kind].terms:
            entries_by_kind.setdefault(term.kind, []).append((*entry_of(joint, term), joint))
    groups = []
    owner: list[int] = []
    join = lambda data: jax.tree.map(lambda *x: stack_arrays(x, axis=-1), *data)
    for kind in (k for k in (*PRIMITIVES, *COUPLINGS) if k in entries_by_kind):
        i, j, numbers, data, joints_of_kind = zip(*entries_by_kind[kind], strict=True)
        motions = tuple(joint.motion for joint in joints_of_kind if joint.motion is not None)
        mates = None
        if kind in COUPLINGS:
            term = READING[COUPLINGS[kind][1]]
            of = [joint.mate for joint in joints_of_kind]
            first, second, places, mate_data = zip(
                *(entry_of(mate.joint, term) for mate in of), strict=True
            )
            column = lambda name, of=of: stack_arrays([getattr(mate, name) for mate in of])
            mates = Mates(
                first,
                second,
                places,
                join(mate_data),
                column("ratio"),
                column("offset"),
                column("period"),
            )
        groups.append(ConstraintGroup(kind, i, j, numbers, join(data), motions, mates))
        owner += [number for number in numbers for _ in range(ROWS[kind])]
    return Constraints(tuple(groups), tuple(owner), system.n_bodies)
