"""Independent coordinates of any system, selected from those of its spanning tree.

The coordinates of an open tree are all independent. In a mechanism with loops the rows of the
loop-closing joints, J u = target, leave some free: the velocities are partitioned into
independent and dependent ones,

    J_d u_d = target - J_i u_i,

and the dependent coordinates follow from Newton's method on the same rows, with those stored in
the point as initial values. Retraction moves the independent coordinates alone, so that a point may
be differentiated and moved far; the dependent ones of a moved point are where Newton's method
starts. If the loops do not close, all results for a point are NaN.

Source: R. A. Wehage, E. J. Haug, J. Mechanical Design 104 (1982) 247-255 (partitioning).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra import lapack
from ...algebra.rotation import (
    conjugate,
    from_rotation_vector,
    product,
    rotation_matrix,
    to_rotation_vector,
)
from ...algebra.stacked import apply, apply_transposed
from ...checks.errors import ModelError, SettingError, concrete, named_places
from ...mechanics.internal import (
    internal_count,
    internal_names,
    internal_rates,
    internal_states,
    with_internal,
)
from ...mechanics.load import Load, total_load
from ...mechanics.motions.axial import REVOLUTE
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..tree.closures import closure_rows, in_world, kinematics
from ..tree.coordinates import TreeCoordinates, join, moved
from ..tree.formulation import Tree
from ..tree.frames import aligned, columns, motion_groups
from ..tree.motion import TreeMotion, bias, inertia, mass_matrix, motion, wrenches_by_frame
from ..tree.poses import by_group, from_groups
from ..tree.projection import TreeModel
from .base import AbstractStateSpace, Time
from .closing import closed_from
from .names import BASE, signs_of, velocity_names
from .selection import Selection, chosen, compiled_read


class TreePoint(NamedTuple):
    """Point of a `TreeSpace`: coordinates of the spanning tree, and independent velocities.

    Attributes:
        r, p: centre of mass of the base, world (3,) [m], and its Euler parameters (4,); empty
            for a system with a fixed base.
        q: positions of the tree's steps: one array of all angles [rad] and displacements [m], and
            one for each translation (3,) [m] and each spherical joint (4,).
        v: velocity of the base, world (3,) [m/s]. omega: angular velocity, base axes [rad/s].
        u: other independent velocities (k,). internal: actuator states of forces (m,).
        ahead: displacement of the independent coordinates since the loops were closed (k,).
    """

    r: Float[Array, "b3 *s"]
    p: Float[Array, "b4 *s"]
    q: tuple[Float[Array, "a *s"], ...]
    v: Float[Array, "b3 *s"]
    omega: Float[Array, "b3 *s"]
    u: Float[Array, "k *s"]
    internal: Float[Array, "m *s"]
    ahead: Float[Array, "k *s"]


class TreeSpace(AbstractStateSpace):
    """State space of any system in independent coordinates of its spanning tree.

    Args:
        system: bodies, joints and forces.
        state: posture on the joints, at which the independent coordinates are selected; default
            the reference posture. Its numbers must be concrete, not traced.
        independent: names of coordinates that must be independent; the others are selected.
        t: time of the drivers [s].

    Raises:
        ModelError: the posture is singular, or the wanted coordinates are not independent there.
        SettingError: the state does not fit the system, or a name is unknown.
    """

    system: System
    model: TreeModel
    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True)
    names: tuple[tuple[str, str], ...] = eqx.field(static=True)
    dof: int = eqx.field(static=True)
    selection: Selection = eqx.field(static=True)
    signs: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        state: State | None = None,
        *,
        independent: Sequence[str] = (),
        t: float = 0.0,
    ) -> None:
        state = system.reference if state is None else state
        check_state(system, state)
        if not concrete(state):
            raise SettingError("The posture at which coordinates are chosen must be known numbers.")
        self.system, self.model = system, Tree().prepare(system)
        tree = self.model.parameters.tree
        labels = velocity_names(tree)
        wanted = named_places(independent, [n for n, _ in labels], "The independent names", "state")
        self.selection = chosen(self.model, state, t, wanted, tuple(n for n, _ in labels))
        base = 6 * tree.floating
        self.dof = base + len(self.selection.independent)
        self.size = 2 * self.dof + internal_count(system)
        self.is_flat = False
        signs = signs_of(tree)
        self.signs = tuple(signs[k] for k in self.selection.independent)
        own = [labels[k] for k in self.selection.independent]
        self.names = (
            *(BASE[:6] if base else ()),
            *own,
            *(BASE[6:] if base else ()),
            *((f"{name}_rate", f"{unit}/s") for name, unit in own),
            *(_with_unit(name) for name in internal_names(system)),
        )

    def with_system(self, system: System) -> "TreeSpace":
        """Space with these coordinates for a system that differs in its numbers or forces only."""
        model = Tree().prepare(system)
        return eqx.tree_at(lambda s: (s.system, s.model), self, (system, model))

    @property
    def has_dependent_rows(self) -> bool:
        """True if the rows of the loops depend on each other, as those of planar loops do."""
        return self.model.constraints.n_rows > len(self.selection.rows)

    def retract(self, x: TreePoint, v: Float[Array, "n *s"]) -> TreePoint:
        tree = self.model.parameters.tree
        b, dof = 6 * tree.floating, self.dof
        dq, du, dz = v[:dof], v[dof : 2 * dof], v[2 * dof :]
        steps = by_group(tree, self._spread(dq[b:]))
        x = _stacked(x, v.shape[1:])
        parts = zip(motion_groups(tree), self._grouped(x.q), steps, strict=True)
        return TreePoint(
            x.r + dq[:3] if b else x.r,
            product(x.p, from_rotation_vector(dq[3:6])) if b else x.p,
            self._single(tuple(group.motion.retract(q, step) for group, q, step in parts)),
            x.v + du[:3] if b else x.v,
            x.omega + du[3:6] if b else x.omega,
            x.u + du[b:],
            x.internal + dz,
            x.ahead + dq[b:],
        )

    def difference(self, y: TreePoint, x: TreePoint) -> Float[Array, "n *s"]:
        tree = self.model.parameters.tree
        batch = jnp.broadcast_shapes(y.u.shape[1:], x.u.shape[1:])
        y, x = _stacked(y, batch), _stacked(x, batch)
        groups = zip(motion_groups(tree), self._grouped(y.q), self._grouped(x.q), strict=True)
        full = from_groups(tree, tuple(group.motion.difference(b, a) for group, b, a in groups))
        # a free body alone has no steps, and of those nothing that has the stack's axes
        own = self._picked(full).reshape(len(self.signs), *batch)
        # angles of revolute joints are periodic
        turning = np.array(self._periodic(), dtype=bool)
        turns = jnp.round(own / (2 * jnp.pi))
        own = own - 2 * jnp.pi * jnp.where(aligned(turning, own.ndim), turns, 0.0)
        base = (
            [y.r - x.r, to_rotation_vector(product(conjugate(x.p), y.p))] if tree.floating else []
        )
        speed = [y.v - x.v, y.omega - x.omega] if tree.floating else []
        return jnp.concatenate([*base, own, *speed, y.u - x.u, y.internal - x.internal])

    def _periodic(self) -> list[bool]:
        """Flags of the independent coordinates that are angles of revolute motions."""
        tree = self.model.parameters.tree
        frame = columns(tree).frame
        return [tree.steps[frame[k] - 1].motion == REVOLUTE for k in self.selection.independent]

    def _grouped(self, q: tuple[Array, ...]) -> tuple[Array, ...]:
        """Positions grouped by class of motion, as in `TreeCoordinates`."""
        found, parts = [], list(q)
        for group in motion_groups(self.model.parameters.tree):
            if group.motion.positions:
                own = [parts.pop(0) for _ in group.steps]
                found.append(jnp.stack(own, axis=1))
            else:
                found.append(parts.pop(0))
        return tuple(found)

    def _single(self, groups: tuple[Array, ...]) -> tuple[Array, ...]:
        """Positions of single steps from those grouped by `_grouped`."""
        found: list[Array] = []
        for group, q in zip(motion_groups(self.model.parameters.tree), groups, strict=True):
            found += [q[:, k] for k in range(len(group.steps))] if group.motion.positions else [q]
        return tuple(found)

    def check(self, x: Any, what: str) -> None:
        if not isinstance(x, TreePoint):
            raise ModelError(f"{what} must be a TreePoint, not {type(x).__name__}.")
        if jnp.shape(x.u)[:1] != (len(self.signs),):
            raise ModelError(
                f"{what} must have {len(self.signs)} independent velocities first, but their shape "
                f"is {jnp.shape(x.u)}."
            )

    def from_state(self, state: State) -> TreePoint:
        at = compiled_read(self.model.parameters, state)
        flat = lambda part: part.reshape(-1)
        return TreePoint(
            flat(at.r), flat(at.p), self._single(at.q), flat(at.v), flat(at.omega), self._picked(at.u),
            internal_states(self.system),
            jnp.zeros(len(self.signs), state.r.dtype),
        )  # fmt: skip

    def to_state(self, x: TreePoint, t: Time = 0.0) -> State:
        return Tree().to_state(self.model, join(self.closed(x, t)))

    def with_closed_loops(self, x: TreePoint, t: Time = 0.0) -> TreePoint:
        if not self.selection.rows:
            return x._replace(ahead=jnp.zeros_like(x.ahead))
        at = self._closed(x, t)
        return x._replace(q=self._single(at.q), ahead=jnp.zeros_like(x.ahead))

    def conditioning(self, x: TreePoint, t: Time = 0.0) -> Float[Array, ""]:
        if not self.selection.rows:
            return jnp.ones_like(x.u, shape=())
        _, J = self._rows(self._closed(x, t), t)
        values = lapack.singular_values(J[:, self._places()[1]])
        return values[-1] / lapack.singular_values(J)[0]

    def rates(
        self, x: TreePoint, t: Time = 0.0, system: System | None = None
    ) -> Float[Array, " size"]:
        tree = self.model.parameters.tree
        given = _with_internal(self.system if system is None else system, x.internal)
        at, time = self.closed(x, t), jnp.asarray(t, x.u.dtype)
        moving = motion(self.model.parameters, at)
        placed = in_world(self.model.parameters, at, moving)
        kin = kinematics(given, placed)
        rate = self._accelerations(at, moving, total_load(given.forces, time, kin), time)
        b = 6 * tree.floating
        # the equations are in the base's axes, with the angular velocity first
        base = lambda: [apply(rotation_matrix(at.p), rate[3:6, None])[:, 0], rate[:3]]
        parts = [x.v, x.omega, x.u, *(base() if b else []), self._picked(rate[b:])]
        if x.internal.shape[0]:
            parts.append(internal_rates(given, time, kin))
        return jnp.concatenate(parts)

    def _accelerations(
        self, at: TreeCoordinates, moving: TreeMotion, load: Load, t: Float[Array, ""]
    ) -> Float[Array, " l"]:
        """Accelerations du/dt of all velocities, the base's first, projected to the free motions.

        With u = N u_i + c on the constraints, N^T M N du_i/dt = -N^T (h + M c).
        """
        parameters, tree = self.model.parameters, self.model.parameters.tree
        b, (independent, dependent, kept) = 6 * tree.floating, self._places()
        force, moment = load.force.T[:, :-1], apply(moving.R[:, :, :-1], load.moment.T[:, :-1])
        if b:
            force = apply_transposed(rotation_matrix(at.p), force)
        total = inertia(parameters, moving, wrenches_by_frame(tree, moving, force, moment))
        M, h = mass_matrix(tree, moving.S, total), bias(tree, moving.S, total)
        free = np.zeros((len(h), self.dof))
        free[:b, :b] = np.eye(b)
        free[b + independent, np.arange(b, self.dof)] = 1.0
        N, c = jnp.asarray(free, h.dtype), jnp.zeros_like(h)
        if len(kept):
            rows = closure_rows(parameters, self.model.constraints, t, moving)
            J, gamma = rows.J[kept], rows.gamma[kept, None]
            known = jnp.concatenate([J[:, independent], gamma], axis=1)
            by = lapack.solve(J[:, dependent], known)
            N = N.at[b + dependent, b:].set(-by[:, :-1])
            c = c.at[b + dependent].set(by[:, -1])
        own = lapack.solve(N.T @ M @ N, -N.T @ (h + M @ c))
        return N @ own + c

    def _places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Selection as arrays of indices."""
        return tuple(np.array(part, dtype=int) for part in self.selection)  # pyright: ignore

    def closed(self, x: TreePoint, t: Time = 0.0) -> TreeCoordinates:
        """All coordinates and velocities of the tree, with the dependent ones from the loops."""
        if not self.selection.rows:
            return self._opened(x)
        at = self._closed(x, t)
        target, J = self._rows(at, t, target=True)
        J_d = J[:, self._places()[1]]
        by = lapack.solve(J_d, target - J @ at.u)
        return at._replace(u=at.u.at[self._places()[1]].add(by))

    def _opened(self, x: TreePoint) -> TreeCoordinates:
        """Coordinates of the tree as stored in the point, with zero dependent velocities."""
        b = int(self.model.parameters.tree.floating)
        column = lambda part, n: part.reshape(n, b)
        base, speed = (column(x.r, 3), column(x.p, 4)), (column(x.v, 3), column(x.omega, 3))
        return TreeCoordinates(*base, self._grouped(x.q), *speed, self._spread(x.u))

    def _closed(self, x: TreePoint, t: Time) -> TreeCoordinates:
        """Coordinates with the dependent ones by Newton's method; the others stay unchanged."""
        tree, dependent = self.model.parameters.tree, self._places()[1]

        def step(now: TreeCoordinates) -> tuple[TreeCoordinates, Array]:
            value, J = self._rows(now, t)
            by = lapack.solve(J[:, dependent], value)
            full = jnp.zeros(J.shape[1], J.dtype).at[dependent].set(-by)
            return moved(tree, now, full), jnp.max(jnp.abs(by))

        at, found = closed_from(tree, self._opened(x), self._spread(x.ahead), step)
        # loops that do not close at these coordinates have no motion
        mark = jnp.where(found, 1.0, jnp.nan)
        return at._replace(q=tuple(mark * q for q in at.q))

    def _rows(self, at: TreeCoordinates, t: Time, *, target: bool = False) -> tuple[Array, Array]:
        """Residuals or targets, and J, of the rows that determine the dependent velocities."""
        parameters = self.model.parameters
        rows = closure_rows(
            parameters, self.model.constraints, jnp.asarray(t, at.u.dtype), motion(parameters, at)
        )
        kept = self._places()[2]
        return (rows.target if target else rows.value)[kept], rows.J[kept]

    def _spread(self, own: Float[Array, "k *s"]) -> Float[Array, "n *s"]:
        """Velocities of the tree's steps from the independent ones, with the others zero."""
        signs = np.array(self.signs).reshape(-1, *(1,) * (own.ndim - 1))
        none = jnp.zeros(
            (len(columns(self.model.parameters.tree).frame), *own.shape[1:]), own.dtype
        )
        return none.at[self._places()[0]].set(signs * own)

    def _picked(self, full: Float[Array, "n *s"]) -> Float[Array, "k *s"]:
        """Independent ones among the velocities of the tree's steps."""
        signs = np.array(self.signs).reshape(-1, *(1,) * (full.ndim - 1))
        return jnp.asarray(signs) * full[self._places()[0]]


def _stacked(x: TreePoint, batch: tuple[int, ...]) -> TreePoint:
    """Point with its leaves broadcast along the axes of a stack, such as those of sigma points."""
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (*part.shape[:1], *batch)), x)


def _with_unit(label: str) -> tuple[str, str]:
    """Name and unit of an actuator state from its label, "name [unit]"."""
    name, _, unit = label.removesuffix("]").partition(" [")
    return name, unit


def _with_internal(system: System, z: Array) -> System:
    return with_internal(system, z) if z.shape[0] else system
