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
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import ModelError, SettingError, has_values, named_places
from ...math import lapack
from ...math.compiler import kept_jit
from ...math.linalg import Factor, factor_cholesky
from ...math.native.program import native
from ...math.rotation import (
    conjugate,
    from_rotation_vector,
    product,
    rotation_matrix,
    to_rotation_vector,
)
from ...math.stacked import apply_matrix, apply_transposed
from ...mechanics.internal import (
    actuator_mask,
    counted_hinges,
    internal_names,
    internal_rates,
    internal_starts,
    internal_states,
    with_internal,
)
from ...mechanics.load import total_load
from ...mechanics.motions import REVOLUTE
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..tree.closures import TreeModel, closure_rows, in_world, make_kinematics
from ..tree.coordinates import TreeCoordinates, join_coordinates, retract_coordinates
from ..tree.formulation import Tree
from ..tree.motion import (
    bias_force,
    composite_inertia,
    compute_motion,
    mass_matrix,
    wrenches_by_frame,
)
from ..tree.parameters import by_group, from_groups
from ..tree.topology import SpanningTree, align_axes, motion_columns, motion_groups
from .base import AbstractStateSpace, Time
from .selection import (
    BASE,
    Selection,
    approach_closed,
    choose_velocities,
    compiled_read,
    refine_closing,
    search_closed,
    signs_of,
    velocity_names,
)


class TreePoint(NamedTuple):
    """Point of a `TreeSpace`: coordinates of the spanning tree, and independent velocities.

    Attributes:
        r, p: centre of mass of the base, world (3,) [m], and its Euler parameters (4,); empty
            for a system with a fixed base.
        q: positions of the tree's steps: one array of all angles [rad] and displacements [m], and
            one for each translation (3,) [m] and each spherical joint (4,).
        v: velocity of the base, world (3,) [m/s]. omega: angular velocity, base axes [rad/s].
        u: other independent velocities (k,). internal: actuator states of forces, and angles of
            hinges whose turns forces count (m,); `TreeSpace.internal_at` recomputes the latter.
        displacement: displacement of the independent coordinates since the loops were closed (k,).
    """

    r: Float[Array, "b3 *s"]
    p: Float[Array, "b4 *s"]
    q: tuple[Float[Array, "a *s"], ...]
    v: Float[Array, "b3 *s"]
    omega: Float[Array, "b3 *s"]
    u: Float[Array, "k *s"]
    internal: Float[Array, "m *s"]
    displacement: Float[Array, "k *s"]


class _Counted(NamedTuple):
    """Place among the internal states of a counted angle that is a coordinate of the tree.

    Attributes:
        place: index among the internal states. group, member: place of the coordinate among those of
            `TreeCoordinates`. sign: -1 where the tree passes the joint from j to i.
    """

    place: int
    group: int
    member: int
    sign: float


class _Terms(NamedTuple):
    """Terms of the equations M du/dt + h = forces of the loops, and J du/dt = gamma.

    Attributes:
        mass_matrix: M (l, l). bias: h (l,), with the loads.
        J, gamma: closing rows that determine the dependent velocities (k, n), (k,).
        internal_rates: rates of the forces' states (m,).
    """

    mass_matrix: Float[Array, "l l"]
    bias: Float[Array, " l"]
    J: Float[Array, "k n"]
    gamma: Float[Array, " k"]
    internal_rates: Float[Array, " m"]


class TreeSpace(AbstractStateSpace):
    """State space of any system in independent coordinates of its spanning tree.

    Args:
        system: bodies, joints and forces.
        state: posture on the joints, at which the independent coordinates are selected; default
            the reference posture. Its numbers must be concrete, not traced.
        independent: names of coordinates that must be independent; the others are selected.
        selection: that of another space of the same bodies and joints, instead of one at a posture.
        t: time of the drivers [s].

    Raises:
        ModelError: the posture is singular, or the chosen coordinates are not independent there.
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
        selection: Selection | None = None,
        t: float = 0.0,
    ) -> None:
        self.system, self.model = system, Tree().prepare(system)
        tree = self.model.parameters.tree
        labels = velocity_names(tree)
        if selection is None:
            state = system.reference if state is None else state
            check_state(system, state)
            if not has_values(state):
                raise SettingError(
                    "The posture at which coordinates are chosen must be known numbers."
                )
            names = [name for name, _ in labels]
            # Names that a user gives stay independent whatever their conditioning is, unless the
            # posture makes it impossible; the rest is chosen by pivoting.
            independent_places = named_places(independent, names, "The independent names", "state")
            # The choice of coordinates needs a posture with known numbers; afterwards it is structure, and other
            # numbers compile nothing.
            selection = choose_velocities(self.model, state, t, independent_places, tuple(names))
        self.selection = selection
        base = 6 * tree.floating
        self.dof = base + len(self.selection.independent)
        # Counted turns of hinges are no states of their own here: they follow from the
        # coordinates, which count turns themselves. States of actuators, such as rotor speeds,
        # are.
        actuators = actuator_mask(system)
        self.size = 2 * self.dof + int(np.sum(actuators))
        self.is_flat = False
        signs = signs_of(tree)
        # The tree may pass a joint from j to i; a user's coordinate is always that from i to j.
        self.signs = tuple(signs[k] for k in self.selection.independent)
        independent_labels = [labels[k] for k in self.selection.independent]
        self.names = (
            # Positions come first and velocities after them, each with the base in front, so that
            # A has the blocks of a second-order system.
            *(BASE[:6] if base else ()),
            *independent_labels,
            *(BASE[6:] if base else ()),
            *((f"{name}_rate", f"{unit}/s") for name, unit in independent_labels),
            *(_with_unit(internal_names(system)[k]) for k in np.flatnonzero(actuators)),
        )

    def with_system(self, system: System) -> "TreeSpace":
        """Space with these coordinates for a system that differs in its numbers or forces only."""
        return TreeSpace(system, selection=self.selection)

    @property
    def counted(self) -> tuple[_Counted, ...]:
        """Indices of the counted angles that are coordinates of the tree."""
        return _counted_angles(self.system, self.model.parameters.tree)

    @property
    def has_dependent_rows(self) -> bool:
        """True if the rows of the loops depend on each other, as those of planar loops do."""
        return self.model.constraints.n_rows > len(self.selection.rows)

    def retract(self, x: TreePoint, v: Float[Array, "n *s"]) -> TreePoint:
        # machine code is for one point: that of a stack would do each of its points apart
        return _retract_point(self, x, v) if v.ndim == 1 else self._retract_points(x, v)

    def _retract_points(self, x: TreePoint, v: Float[Array, "n *s"]) -> TreePoint:
        tree = self.model.parameters.tree
        b, dof = 6 * tree.floating, self.dof
        dq, du, dz = v[:dof], v[dof : 2 * dof], v[2 * dof :]
        # A step is given in independent coordinates; the dependent ones follow when the loops are closed.
        steps = by_group(tree, self._spread_velocities(dq[b:]))
        x = _broadcast_leaves(x, v.shape[1:])
        parts = zip(motion_groups(tree), self._group_positions(x.q), steps, strict=True)
        return TreePoint(
            x.r + dq[:3] if b else x.r,
            # The error of the base's attitude is in body axes, multiplied from the right, as are
            # angular velocities: both parts of an error then have the same axes.
            product(x.p, from_rotation_vector(dq[3:6])) if b else x.p,
            self._single_positions(
                tuple(group.motion.retract(q, step) for group, q, step in parts)
            ),
            x.v + du[:3] if b else x.v,
            x.omega + du[3:6] if b else x.omega,
            x.u + du[b:],
            x.internal.at[self._actuator_places()].add(dz) if dz.shape[0] else x.internal,
            # How far the independent coordinates have gone since the loops were closed is
            # remembered: closing them follows that way in steps, on the branch of the start,
            # instead of jumping to the nearest solution.
            x.displacement + dq[b:],
        )

    def difference(self, y: TreePoint, x: TreePoint) -> Float[Array, "n *s"]:
        is_single = y.u.ndim == x.u.ndim == 1
        return _subtract_points(self, y, x) if is_single else self._subtract_points(y, x)

    def _subtract_points(self, y: TreePoint, x: TreePoint) -> Float[Array, "n *s"]:
        tree = self.model.parameters.tree
        batch = jnp.broadcast_shapes(y.u.shape[1:], x.u.shape[1:])
        y, x = _broadcast_leaves(y, batch), _broadcast_leaves(x, batch)
        groups = zip(
            motion_groups(tree), self._group_positions(y.q), self._group_positions(x.q), strict=True
        )
        full = from_groups(tree, tuple(group.motion.difference(b, a) for group, b, a in groups))
        # a free body alone has no steps, and of those nothing that has the stack's axes
        coordinate_difference = self._pick_free(full).reshape(len(self.signs), *batch)
        # angles of revolute joints are periodic, unless a force counts their turns
        # Differences of hinges are brought within half a turn, unless a force counts the turns: then 0 and 2
        # pi are different states.
        turning = np.array(self._periodic_flags(), dtype=bool)
        turns = jnp.round(coordinate_difference / (2 * jnp.pi))
        coordinate_difference = coordinate_difference - 2 * jnp.pi * jnp.where(
            align_axes(turning, coordinate_difference.ndim), turns, 0.0
        )
        base = (
            [y.r - x.r, to_rotation_vector(product(conjugate(x.p), y.p))] if tree.floating else []
        )
        speed = [y.v - x.v, y.omega - x.omega] if tree.floating else []
        inside = (y.internal - x.internal)[self._actuator_places()]
        return jnp.concatenate([*base, coordinate_difference, *speed, y.u - x.u, inside])

    def _actuator_places(self) -> np.ndarray:
        """Places of the actuator states among the internal states."""
        return np.flatnonzero(actuator_mask(self.system))

    def half_turns(self, v: Float[Array, "n *s"]) -> Float[Array, "*s"]:
        b = 6 * self.model.parameters.tree.floating
        angles = jnp.abs(v[b : self.dof][np.array(self._periodic_flags(), dtype=bool)])
        base = jnp.sqrt(jnp.sum(v[3:6] ** 2, axis=0)) if b else jnp.zeros(v.shape[1:], v.dtype)
        return jnp.maximum(jnp.max(angles, axis=0, initial=0.0), base) / np.pi

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Flags of the components of an error (size,) that are angles, the same after a turn."""
        base = 6 * self.model.parameters.tree.floating
        flags = [False] * base + self._periodic_flags()
        return (*flags, *[False] * (self.size - len(flags)))

    def _periodic_flags(self) -> list[bool]:
        """Flags of the independent coordinates that are angles whose turns no force counts."""
        tree = self.model.parameters.tree
        frame, groups = motion_columns(tree).frame, motion_groups(tree)
        counted = {groups[c.group].steps[c.member] for c in self.counted}
        steps = [frame[k] - 1 for k in self.selection.independent]
        return [tree.steps[f].motion == REVOLUTE and f not in counted for f in steps]

    def _group_positions(self, q: tuple[Array, ...]) -> tuple[Array, ...]:
        """Positions grouped by class of motion, as in `TreeCoordinates`."""
        group_positions, parts = [], list(q)
        for group in motion_groups(self.model.parameters.tree):
            if group.motion.positions:
                step_positions = [parts.pop(0) for _ in group.steps]
                group_positions.append(jnp.stack(step_positions, axis=1))
            else:
                group_positions.append(parts.pop(0))
        return tuple(group_positions)

    def _single_positions(self, groups: tuple[Array, ...]) -> tuple[Array, ...]:
        """Positions of single steps from those grouped by `_grouped`."""
        step_positions: list[Array] = []
        for group, q in zip(motion_groups(self.model.parameters.tree), groups, strict=True):
            step_positions += (
                [q[:, k] for k in range(len(group.steps))] if group.motion.positions else [q]
            )
        return tuple(step_positions)

    def check(self, x: Any, subject: str) -> None:
        if not isinstance(x, TreePoint):
            raise ModelError(f"{subject} must be a TreePoint, not {type(x).__name__}.")
        if jnp.shape(x.u)[:1] != (len(self.signs),):
            raise ModelError(
                f"{subject} must have {len(self.signs)} independent velocities first, but their shape "
                f"is {jnp.shape(x.u)}."
            )

    def from_state(self, state: State, internal: Float[Array, " m"] | None = None) -> TreePoint:
        at = compiled_read(self.model.parameters, state)
        # A state of the bodies has angles in (-pi, pi] only; whole turns come from the forces that
        # count them.
        z = internal_states(self.system) if internal is None else jnp.asarray(internal)
        if any(counted_hinges(self.system)):
            kin = self.system.kinematics(state)
            z = internal_starts(with_internal(self.system, z), kin)
            at = at._replace(q=self._count_turns(at.q, z))
        flat = lambda part: part.reshape(-1)
        return TreePoint(
            flat(at.r), flat(at.p), self._single_positions(at.q), flat(at.v), flat(at.omega), self._pick_free(at.u),
            z,
            jnp.zeros(len(self.signs), state.r.dtype),
        )  # fmt: skip

    def _count_turns(self, q: tuple[Array, ...], z: Float[Array, " m"]) -> tuple[Array, ...]:
        """Positions of the tree with the whole turns of the counted angles z."""
        groups = list(q)
        for place, group, member, sign in self.counted:
            positions = groups[group]
            turns = jnp.round((sign * z[place] - positions[member]) / (2 * jnp.pi))
            groups[group] = positions.at[member].add(2 * jnp.pi * turns)
        return tuple(groups)

    def internal_at(self, x: TreePoint) -> Float[Array, " m"]:
        return self._internal_states(self._group_positions(x.q), x.internal)

    def _internal_states(
        self, q: tuple[Array, ...], z: Float[Array, "m *s"]
    ) -> Float[Array, "m *s"]:
        """Internal states z, with the counted angles that are coordinates of the tree from these."""
        for place, group, member, sign in self.counted:
            z = z.at[place].set(sign * q[group][member])
        return z

    def to_state(self, x: TreePoint, t: Time = 0.0) -> State:
        return _compute_state(self, *_as_arrays(x, t))

    def state_and_rate(
        self, x: TreePoint, t: Time = 0.0, system: System | None = None
    ) -> tuple[State, State]:
        return _compute_state_and_rate(
            self, *_as_arrays(x, t), self.system if system is None else system
        )

    def with_closed_loops(self, x: TreePoint, t: Time = 0.0) -> TreePoint:
        if not self.selection.rows:
            return x._replace(
                internal=self.internal_at(x), displacement=jnp.zeros_like(x.displacement)
            )
        return _close_loops(self, *_as_arrays(x, t))

    def conditioning(self, x: TreePoint, t: Time = 0.0) -> Float[Array, ""]:
        if not self.selection.rows:
            return jnp.ones_like(x.u, shape=())
        return _compute_conditioning(self, *_as_arrays(x, t))

    def rates(
        self, x: TreePoint, t: Time = 0.0, system: System | None = None
    ) -> Float[Array, " size"]:
        return _compute_rates(self, *_as_arrays(x, t), self.system if system is None else system)

    def _project_accelerations(self, terms: _Terms) -> Float[Array, " l"]:
        """Accelerations du/dt of all velocities, the base's first, projected to the free motions.

        With u = N u_i + c on the constraints, N^T M N du_i/dt = -N^T (h + M c).
        """
        M, h = terms.mass_matrix, terms.bias
        b, (independent, dependent, row_indices) = (
            6 * self.model.parameters.tree.floating,
            self._selection_places(),
        )
        # N is known but for the dependent rows: written as constants, its zeros and ones vanish
        # from the machine code.
        free = np.zeros((len(h), self.dof))
        free[:b, :b] = np.eye(b)
        free[b + independent, np.arange(b, self.dof)] = 1.0
        N, c = jnp.asarray(free, h.dtype), jnp.zeros_like(h)
        if len(row_indices):
            J, gamma = terms.J, terms.gamma[:, None]
            # One factorisation serves for the velocities' dependence and for the accelerations
            # that the loops demand.
            right_sides = jnp.concatenate([J[:, independent], gamma], axis=1)
            by = lapack.solve(J[:, dependent], right_sides)
            N = N.at[b + dependent, b:].set(-by[:, :-1])
            c = c.at[b + dependent].set(by[:, -1])
        factor = Factor(factor_cholesky(N.T @ M @ N))
        return N @ factor.solve(-N.T @ (h + M @ c)) + c

    def _selection_places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Selection as arrays of indices."""
        return tuple(np.array(part, dtype=int) for part in self.selection)  # pyright: ignore

    def _search(self, x: TreePoint, t: Float[Array, ""]) -> TreeCoordinates:
        """Coordinates of the tree with closed loops, without derivatives."""
        return _search_closed(self, x, t) if self.selection.rows else self._open_coordinates(x)

    def _closed(
        self, x: TreePoint, posture: TreeCoordinates, t: Float[Array, ""]
    ) -> TreeCoordinates:
        """All coordinates and velocities of the tree, with the dependent ones from the loops."""
        if not self.selection.rows:
            return self._open_coordinates(x)
        at = self._closed_positions(x, posture, t)
        _, target, J = _evaluate_rows(self, at, t)
        # The open velocities have zeros for the dependent ones, so that the residual of the rate
        # equations gives these at once: they are linear.
        dependent = self._selection_places()[1]
        by = lapack.solve(J[:, dependent], target - J @ at.u)
        return at._replace(u=at.u.at[dependent].add(by))

    def _closed_positions(
        self, x: TreePoint, posture: TreeCoordinates, t: Float[Array, ""]
    ) -> TreeCoordinates:
        """Coordinates with the dependent ones by Newton's method; the others stay unchanged."""
        if not self.selection.rows:
            return self._open_coordinates(x)
        return refine_closing(
            self._open_coordinates(x), posture, lambda now: self._newton_step(now, t)
        )

    def _open_coordinates(self, x: TreePoint) -> TreeCoordinates:
        """Coordinates of the tree as stored in the point, with zero dependent velocities."""
        b = int(self.model.parameters.tree.floating)
        column = lambda part, n: part.reshape(n, b)
        base, speed = (column(x.r, 3), column(x.p, 4)), (column(x.v, 3), column(x.omega, 3))
        return TreeCoordinates(
            *base, self._group_positions(x.q), *speed, self._spread_velocities(x.u)
        )

    def _newton_step(
        self, now: TreeCoordinates, t: Float[Array, ""]
    ) -> tuple[TreeCoordinates, Array]:
        """Coordinates after a step of Newton's method, and its largest component."""
        dependent = self._selection_places()[1]
        value, _, J = _evaluate_rows(self, now, t)
        by = lapack.solve(J[:, dependent], value)
        # Newton moves the dependent coordinates alone: the independent ones are what the point
        # says, and a least-squares step would change them.
        full = jnp.zeros(J.shape[1], J.dtype).at[dependent].set(-by)
        return retract_coordinates(self.model.parameters.tree, now, full), jnp.max(jnp.abs(by))

    def _spread_velocities(self, independent_values: Float[Array, "k *s"]) -> Float[Array, "n *s"]:
        """Velocities of the tree's steps from the independent ones, with the others zero."""
        signs = np.array(self.signs).reshape(-1, *(1,) * (independent_values.ndim - 1))
        none = jnp.zeros(
            (len(motion_columns(self.model.parameters.tree).frame), *independent_values.shape[1:]),
            independent_values.dtype,
        )
        return none.at[self._selection_places()[0]].set(signs * independent_values)

    def _pick_free(self, full: Float[Array, "n *s"]) -> Float[Array, "k *s"]:
        """Independent ones among the velocities of the tree's steps."""
        signs = np.array(self.signs).reshape(-1, *(1,) * (full.ndim - 1))
        return jnp.asarray(signs) * full[self._selection_places()[0]]


def _as_arrays(x: TreePoint, t: Time) -> tuple[TreePoint, Array]:
    """Point and time [s] as arrays of JAX, on whose numbers no compiled program depends."""
    x = jax.tree.map(jnp.asarray, x)
    return x, jnp.asarray(t, x.u.dtype)


# Newton's method for the loops is a loop of JAX, which is compiled for every new function object: each public
# method has one function here, so that it is compiled once for a structure.


@kept_jit
def _compute_state(space: TreeSpace, x: TreePoint, t: Float[Array, ""]) -> State:
    return _read_state(space, x, space._search(x, t), t)


@kept_jit
def _close_loops(space: TreeSpace, x: TreePoint, t: Float[Array, ""]) -> TreePoint:
    return _settle_point(space, x, space._search(x, t), t)


@kept_jit
def _compute_conditioning(space: TreeSpace, x: TreePoint, t: Float[Array, ""]) -> Float[Array, ""]:
    J = _evaluate_columns(space, x, space._search(x, t), t)
    values = lapack.singular_values(J[:, space._selection_places()[1]])
    # Relative to the whole Jacobian, not to its dependent columns: those may be small all
    # together, near a posture where the choice fails.
    return values[-1] / lapack.singular_values(J)[0]


@kept_jit
def _compute_rates(
    space: TreeSpace, x: TreePoint, t: Float[Array, ""], system: System
) -> Float[Array, " size"]:
    """Rates of `TreeSpace.rates`, with the forces of a system."""
    return _evaluate_rates(space, x, space._search(x, t), t, system)


@kept_jit
def _compute_state_and_rate(
    space: TreeSpace, x: TreePoint, t: Float[Array, ""], system: System
) -> tuple[State, State]:
    return _evaluate_state_and_rate(space, x, space._search(x, t), t, system)


# Machine code: a part of the search for closed loops, and all that follows it.


@eqx.filter_custom_jvp
def _search_closed(space: TreeSpace, x: TreePoint, t: Float[Array, ""]) -> TreeCoordinates:
    distance = space._spread_velocities(x.displacement)
    start = retract_coordinates(space.model.parameters.tree, space._open_coordinates(x), -distance)
    return search_closed(start, distance, lambda now, part: _approach_closed(space, now, part, t))


@_search_closed.def_jvp
def _search_jvp(primals: Any, tangents: Any) -> tuple[TreeCoordinates, TreeCoordinates]:
    # without this rule a loop's derivative would be computed, and left unused
    del tangents
    posture = _search_closed(*primals)
    zero = partial(jax.custom_derivatives.zero_from_primal, symbolic_zeros=True)
    return posture, jax.tree.map(zero, posture)


@native
def _evaluate_rows(
    space: TreeSpace, at: TreeCoordinates, t: Float[Array, ""]
) -> tuple[Array, Array, Array]:
    """Residuals, targets and J of the rows that determine the dependent velocities."""
    # a function of its own, as it is traced once for all places where it is a part of others
    parameters = space.model.parameters
    rows = closure_rows(parameters, space.model.constraints, t, compute_motion(parameters, at))
    row_indices = space._selection_places()[2]
    return rows.value[row_indices], rows.target[row_indices], rows.J[row_indices]


@native
def _approach_closed(
    space: TreeSpace, at: TreeCoordinates, part: Float[Array, " n"], t: Float[Array, ""]
) -> Any:
    tree = space.model.parameters.tree
    return approach_closed(tree, at, part, lambda now: space._newton_step(now, t))


@native
def _read_state(
    space: TreeSpace, x: TreePoint, posture: TreeCoordinates, t: Float[Array, ""]
) -> State:
    return Tree().to_state(space.model, join_coordinates(space._closed(x, posture, t)))


@native
def _settle_point(
    space: TreeSpace, x: TreePoint, posture: TreeCoordinates, t: Float[Array, ""]
) -> TreePoint:
    parameters = space.model.parameters
    coordinates = space._closed_positions(x, posture, t)
    z = space._internal_states(coordinates.q, x.internal)
    if len(space.counted) < int(np.sum(~actuator_mask(space.system))):
        # the angle of a loop-closing hinge is no coordinate: its turns are counted from here to there
        placement = in_world(parameters, coordinates, compute_motion(parameters, coordinates))
        z = internal_starts(
            with_internal(space.system, z), make_kinematics(space.system, placement)
        )
    q = space._single_positions(coordinates.q)
    return x._replace(q=q, internal=z, displacement=jnp.zeros_like(x.displacement))


@native
def _evaluate_columns(
    space: TreeSpace, x: TreePoint, posture: TreeCoordinates, t: Float[Array, ""]
) -> Float[Array, "k n"]:
    """Columns J of the rows that determine the dependent velocities."""
    return _evaluate_rows(space, space._closed_positions(x, posture, t), t)[2]


@native
def _evaluate_rates(
    space: TreeSpace,
    x: TreePoint,
    posture: TreeCoordinates,
    t: Float[Array, ""],
    system: System,
) -> Float[Array, " size"]:
    coordinates = space._closed(x, posture, t)
    terms = _evaluate_terms(space, coordinates, x.internal, t, system)
    rate = space._project_accelerations(terms)
    b = 6 * space.model.parameters.tree.floating
    # the equations are in the base's axes, with the angular velocity first
    base = (
        [apply_matrix(rotation_matrix(coordinates.p), rate[3:6, None])[:, 0], rate[:3]] if b else []
    )
    parts = [x.v, x.omega, x.u, *base, space._pick_free(rate[b:])]
    if x.internal.shape[0]:
        parts.append(terms.internal_rates[space._actuator_places()])
    return jnp.concatenate(parts)


@native
def _evaluate_state_and_rate(
    space: TreeSpace,
    x: TreePoint,
    posture: TreeCoordinates,
    t: Float[Array, ""],
    system: System,
) -> tuple[State, State]:
    rates = _evaluate_rates(space, x, posture, t, system)
    # The tangent of the point's motion; the state's derivative along it holds the accelerations of all
    # bodies.
    unit, zero = jnp.ones_like(t), jnp.zeros_like(t)
    onwards = jax.jvp(lambda s: space.retract(x, s * rates), (zero,), (unit,))[1]
    state_of = lambda x, t: _read_state(space, x, posture, t)
    return jax.jvp(state_of, (x, t), (onwards, unit))


@native
def _retract_point(space: TreeSpace, x: TreePoint, v: Float[Array, " n"]) -> TreePoint:
    return space._retract_points(x, v)


@native
def _subtract_points(space: TreeSpace, y: TreePoint, x: TreePoint) -> Float[Array, " n"]:
    return space._subtract_points(y, x)


def _evaluate_terms(
    space: TreeSpace,
    at: TreeCoordinates,
    z: Float[Array, " m"],
    t: Float[Array, ""],
    system: System,
) -> _Terms:
    """Terms of the equations of motion in a state of the tree, with the forces of a system."""
    parameters, tree = space.model.parameters, space.model.parameters.tree
    moving = compute_motion(parameters, at)
    current_system = with_internal(system, space._internal_states(at.q, z))
    kin = make_kinematics(current_system, in_world(parameters, at, moving))
    load = total_load(current_system.forces, t, kin)
    # The last row is ground, whose loads move nothing. Moments come in body axes and forces in the
    # world's; both are turned into those of frame 0, in which the tree's equations are written.
    force, moment = load.force.T[:, :-1], apply_matrix(moving.R[:, :, :-1], load.moment.T[:, :-1])
    if tree.floating:
        force = apply_transposed(rotation_matrix(at.p), force)
    total = composite_inertia(parameters, moving, wrenches_by_frame(tree, moving, force, moment))
    M, h = mass_matrix(tree, moving.S, total), bias_force(tree, moving.S, total)
    J, gamma = jnp.zeros((0, len(motion_columns(tree).frame)), h.dtype), jnp.zeros(0, h.dtype)
    row_indices = space._selection_places()[2]
    if len(row_indices):
        rows = closure_rows(parameters, space.model.constraints, t, moving)
        J, gamma = rows.J[row_indices], rows.gamma[row_indices]
    rates = internal_rates(current_system, t, kin) if z.shape[0] else z
    return _Terms(M, h, J, gamma, rates)


def _broadcast_leaves(x: TreePoint, batch: tuple[int, ...]) -> TreePoint:
    """Point with its leaves broadcast along the axes of a stack, such as those of sigma points."""
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (*part.shape[:1], *batch)), x)


def _counted_angles(system: System, tree: SpanningTree) -> tuple[_Counted, ...]:
    """Counted angles of a system that are coordinates of a tree."""
    backward = {link.joint for link in tree.links if not link.forward}
    places = []
    for place, hinge in enumerate(counted_hinges(system)):
        joint = None if hinge is None else tree.joints.index(hinge)
        for number, group in enumerate(motion_groups(tree)):
            for member, f in enumerate(group.steps):
                step = tree.steps[f]
                if joint is not None and step.joint == joint and step.motion == REVOLUTE:
                    sign = -1.0 if joint in backward else 1.0
                    places.append(_Counted(place, number, member, sign))
    return tuple(places)


def _with_unit(label: str) -> tuple[str, str]:
    """Name and unit of an actuator state from its label, "name [unit]"."""
    name, _, unit = label.removesuffix("]").partition(" [")
    return name, unit
