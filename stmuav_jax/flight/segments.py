"""Segments of a motion: where they begin, their points, and the derivatives of both.

A segment begins at a point of a state space and is flown by `integrate`. Its derivatives by the numbers
that its system depends on and by the error at its start are computed a few directions at a time, so that
one program gives the points alone, for the time of one group of directions, and the derivatives too.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import quick_jit
from ..algebra.derivative import value_and_jacobian
from ..algebra.space import Point
from ..dynamics.method import Method
from ..dynamics.statespace.base import AbstractStateSpace
from ..dynamics.statespace.tree import TreeSpace
from ..dynamics.trajectory import integrate
from ..mechanics.internal import internal_states, with_internal
from ..mechanics.state import State
from ..mechanics.system import System

# Directions of a segment's derivatives that are computed together. In larger groups a Jacobian costs less
# and values alone, which take one group, cost more.
_GROUP = 4


class Begun(NamedTuple):
    """State of the bodies and actuators that a flight goes on from.

    Attributes:
        state: state of all bodies.
        internal: actuator states (m,); none where the point of the space does not hold them.
    """

    state: State
    internal: Float[Array, " m"]


def begin(space: AbstractStateSpace, start: Point, t: Float[Array, ""]) -> Begun:
    """Start of a flight at a point of a state space at time t [s]."""
    state, inside = space.to_state(start, t), 2 * space.dof
    if space.size == inside:
        return Begun(state, jnp.zeros(0, state.r.dtype))
    # a state of all bodies has no states of forces: those of the point are set, and read, apart
    own = internal_states(space.system)
    return Begun(state, own + space.difference(start, space.from_state(state))[inside:])


def go_on(
    space: AbstractStateSpace, system: System, begun: Begun, ts: Float[Array, " k"], method: Method
) -> tuple[Point, Begun]:
    """The points of a motion at times ts [s], the first that of the start, and its end."""
    if isinstance(space, TreeSpace) and space.has_dependent_rows:
        allowing = method.formulation.allowing_dependent_rows()
        method = method if allowing is None else replace(method, formulation=allowing)
    held = space.size > 2 * space.dof
    run = integrate(
        with_internal(system, begun.internal) if held else system, begun.state, ts, method
    )
    points = jax.vmap(space.from_state)(run.states)
    end = Begun(jax.tree.map(lambda x: x[-1], run.states), begun.internal)
    if held:
        v = jnp.pad(run.internal - internal_states(space.system), ((0, 0), (2 * space.dof, 0)))
        points, end = jax.vmap(space.retract)(points, v), end._replace(internal=run.internal[-1])
    return points, end


def fly(
    space: AbstractStateSpace, system: System, start: Point, ts: Float[Array, " k"], method: Method
) -> Point:
    """The points of a motion at times ts [s], the first that of the start; a stack (k, .)."""
    return go_on(space, system, begin(space, start, ts[0]), ts, method)[0]


class Legs(eqx.Module):
    """Segments of a motion, and all that flies them.

    Attributes:
        space: state space of the mechanism.
        system: function from values to the system with its inputs set.
        ts: output times of each segment (n, m) [s], the first that of its start.
        method: integration method.
    """

    space: AbstractStateSpace
    system: Callable[[Any], System]
    ts: Float[Array | np.ndarray, "*n m"]
    method: Method

    def _each(self, function: Callable[..., Any], *stacks: Any) -> Any:
        """Stack of function(leg, ...) over the segments, the leg with its own times."""
        of = lambda ts, *one: function(replace(self, ts=ts), *one)
        return jax.vmap(of)(self.ts, *stacks)

    def flown(self, values: Any, origins: Point, steps: Any, known: Any) -> Point:
        """Points (n, m, .) of all segments as a function of the values and the errors at the starts.

        Args:
            origins: points (n, .) relative to which the errors are measured.
            known: points and derivatives by both where these have been computed; else None.
        """
        if known is None:
            one = lambda leg, origin, step: _flown((values, step), leg, origin)
            return self._each(one, origins, steps)
        return jax.vmap(lambda step, found: _known((values, step), found))(steps, known)

    def begun(self, origin: Point, step: Float[Array, " k"]) -> tuple[Begun, Begun]:
        """Start of a segment, and its derivatives by the error there with their axis last."""
        at = lambda step: begin(self.space, self.space.retract(origin, step), self.ts[0])
        return value_and_jacobian(at, step)

    def with_columns(
        self, values: Any, begun: Begun, slopes: Begun, wanted: Any
    ) -> tuple[tuple[Point, Point], Begun]:
        """Points of one segment, their derivatives by its unknowns with these last, and its end.

        Args:
            wanted: false if the derivatives are not needed; only the first group is flown then. A
                segment that is not flown stays at its start, which costs no steps.
        """
        flat, unravel = ravel_pytree(values)

        def of(flown: Any, flat: Any, begun: Begun) -> tuple[Point, Begun]:
            ts = jnp.where(flown, self.ts, self.ts[0])
            return go_on(self.space, self.system(unravel(flat)), begun, ts, self.method)

        def group(_: None, given: Any) -> tuple[None, Any]:
            k, along = given
            fly = lambda *x: of(wanted | (k == 0), *x)
            push = lambda *d: jax.jvp(fly, (flat, begun), d, has_aux=True)
            points, columns, end = jax.vmap(push, out_axes=(0, -1, 0))(*along)
            # points and end are the same along every direction
            return None, (*jax.tree.map(lambda x: x[0], (points, end)), columns)

        count, groups = _directions(flat, slopes)
        _, (points, ends, columns) = jax.lax.scan(group, None, (jnp.arange(len(groups[0])), groups))
        # the length is given explicitly, since a point may have parts of size zero
        long = lambda J: jnp.moveaxis(J, 0, -2).reshape(*J.shape[1:-1], J.shape[0] * J.shape[-1])
        points, end = jax.tree.map(lambda x: x[0], (points, ends))
        return (points, jax.tree.map(lambda J: long(J)[..., :count], columns)), end


def _directions(values: Float[Array, " n"], slopes: Begun) -> tuple[int, tuple[Array, Begun]]:
    """Number of a segment's unknowns, and changes of values and start along them, in groups."""
    n, k = values.shape[0], slopes.internal.shape[-1]
    groups = max(1, -(-(n + k) // _GROUP))
    size = -(-(n + k) // groups)

    def grouped(first: Any, last: Any) -> Array:
        every = jnp.concatenate([first, last])
        none = jnp.zeros((groups * size - n - k, *every.shape[1:]), every.dtype)
        return jnp.concatenate([every, none]).reshape(groups, size, *every.shape[1:])

    still = lambda J: jnp.zeros((n, *J.shape[:-1]), J.dtype)
    along = grouped(jnp.eye(n, dtype=values.dtype), jnp.zeros((k, n), values.dtype))
    return n + k, (along, jax.tree.map(lambda J: grouped(still(J), jnp.moveaxis(J, -1, 0)), slopes))


def _along(columns: Point, unknowns: Any, moves: Any) -> Point:
    """Derivative of a segment's points along changes of its unknowns, None where there is no change."""
    given = lambda x, move: jnp.zeros_like(x) if move is None else move
    along = ravel_pytree(jax.tree.map(given, unknowns, moves, is_leaf=lambda x: x is None))[0]
    return jax.tree.map(lambda J: J @ along, columns)


@eqx.filter_custom_jvp
def _flown(unknowns: tuple[Any, Float[Array, " k"]], leg: Legs, origin: Point) -> Point:
    """Points of one segment, differentiated by way of its whole Jacobian."""
    values, step = unknowns
    start = leg.space.retract(origin, step)
    return fly(leg.space, leg.system(values), start, jnp.asarray(leg.ts), leg.method)


@_flown.def_jvp
def _flown_jvp(primals: Any, tangents: Any) -> tuple[Point, Point]:
    # A segment depends only on its own start. By way of its own Jacobian, the derivatives by the
    # starts of all n segments cost as much as those by one.
    (unknowns, leg, origin), (moves, *_) = primals, tangents
    values, step = unknowns
    (points, columns), _ = leg.with_columns(values, *leg.begun(origin, step), True)
    return points, _along(columns, unknowns, moves)


@eqx.filter_custom_jvp
def _known(unknowns: tuple[Any, Float[Array, " k"]], flown: tuple[Point, Point]) -> Point:
    """Points of one segment that has been flown, with the derivatives by its unknowns."""
    del unknowns
    return flown[0]


@_known.def_jvp
def _known_jvp(primals: Any, tangents: Any) -> tuple[Point, Point]:
    (unknowns, (points, columns)), (moves, _) = primals, tangents
    return points, _along(columns, unknowns, moves)


@quick_jit
def legs_begun(
    legs: Legs, origins: Point, steps: Float[Array | np.ndarray, "n k"]
) -> tuple[Begun, Begun]:
    """Starts of all segments (n, .), and their derivatives by the errors there."""
    return legs._each(Legs.begun, origins, steps)


@quick_jit
def legs_flown(
    legs: Legs, values: Any, begun: Begun, slopes: Begun, wanted: Bool[Array, ""]
) -> tuple[tuple[Point, Point], Begun]:
    """Points of all segments (n, m, .) and their derivatives by values and own start; their ends."""
    one = lambda leg, begun, slopes: leg.with_columns(values, begun, slopes, wanted)
    return legs._each(one, begun, slopes)
