"""Multiple shooting: a motion in segments as a least-squares problem.

An uncontrolled motion amplifies small differences, by a factor e in every 0.09 s for the report's
UAV: over long times neither its end nor the derivatives of its end are of use. Multiple shooting
divides the path at times t_k. The points there are unknowns like all others, and the defect
between the end of one segment and the start of the next is to vanish:

    x(t_k+1; x_k, q) - x_k+1 = 0.

Differences are then amplified over one segment only. One segment is single shooting. Derivatives of a
segment are computed a few directions at a time, so that one program gives the points alone, for the
time of one group of directions, and the derivatives too.

Source: H. G. Bock, K. J. Plitt, A multiple shooting algorithm for direct solution of optimal
control problems, IFAC (1984).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..checks.errors import SettingError
from ..checks.numbers import as_floats, as_jax, as_numpy, stack_arrays
from ..dynamics.method import Method
from ..dynamics.simulation import integrate
from ..dynamics.statespace.base import AbstractStateSpace
from ..dynamics.statespace.tree import TreeSpace
from ..math.compiler import quick_jit
from ..math.derivative import value_and_jacobian
from ..math.space import Point
from ..mechanics.internal import with_internal
from ..mechanics.state import State
from ..mechanics.system import System

# Directions of a segment's derivatives that are computed together. In larger groups a Jacobian costs less
# and values alone, which take one group, cost more.
_GROUP = 4


class SegmentStart(NamedTuple):
    """State of the bodies and actuators from which a flight continues.

    Attributes:
        state: state of all bodies.
        internal: actuator states (m,); none where the point of the space does not hold them.
    """

    state: State
    internal: Float[Array, " m"]


def go_on(
    space: AbstractStateSpace, system: System, origin_state: SegmentStart, ts: Float[Array, " k"],
    method: Method,
) -> tuple[Point, SegmentStart]:  # fmt: skip
    """The points of a motion at times ts [s], the first that of the start, and its end."""
    if isinstance(space, TreeSpace) and space.has_dependent_rows:
        # A segment may begin in a posture in which rows depend on each other, although the machine's
        # reference posture has none.
        allowing = method.formulation.allowing_dependent_rows()
        method = method if allowing is None else replace(method, formulation=allowing)
    if origin_state.internal.shape[0]:
        system = with_internal(system, origin_state.internal)
    run = integrate(system, origin_state.state, ts, method)
    points = jax.vmap(space.from_state)(run.states, run.internal)
    return points, SegmentStart(*jax.tree.map(lambda x: x[-1], (run.states, run.internal)))


def integrate_points(
    space: AbstractStateSpace, system: System, start: Point, ts: Float[Array, " k"], method: Method
) -> Point:
    """The points of a motion at times ts [s], the first that of the start; a stack (k, .)."""
    # a state of all bodies has no states of forces: those of the point are set, and read, apart
    origin_state = SegmentStart(space.to_state(start, ts[0]), space.internal_at(start))
    return go_on(space, system, origin_state, ts, method)[0]


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

    def _map_segments(self, function: Callable[..., Any], *stacks: Any) -> Any:
        """Stack of function(leg, ...) over the segments, the leg with its own times."""
        of = lambda ts, *one: function(replace(self, ts=ts), *one)
        return jax.vmap(of)(self.ts, *stacks)

    def compute_points(self, values: Any, origins: Point, steps: Any, segments: Any) -> Point:
        """Points (n, m, .) of all segments as a function of the values and the errors at the starts.

        Args:
            origins: points (n, .) relative to which the errors are measured.
            segments: points and derivatives by both where these have been computed; else None.
        """
        if segments is None:
            # A segment depends only on its own start. By way of its own Jacobian, the derivatives by
            # the starts of all n segments cost as much as those by one.
            # Points and derivatives are found at fixed unknowns and put together by a rule below; otherwise the
            # search would differentiate through the integration once more.
            fixed = jax.lax.stop_gradient((values, origins, steps))
            fly = lambda leg, *start: leg.with_columns(fixed[0], *leg.make_start(*start), True)[0]
            segments = self._map_segments(fly, *fixed[1:])
        return jax.vmap(lambda step, path: _segment_points((values, step), path))(steps, segments)

    def make_start(
        self, origin: Point, step: Float[Array, " k"]
    ) -> tuple[SegmentStart, SegmentStart]:
        """Start of a segment, and its derivatives by the error there with their axis last."""

        def begin_segment(step: Array) -> SegmentStart:
            start = self.space.retract(origin, step)
            return SegmentStart(
                self.space.to_state(start, self.ts[0]), self.space.internal_at(start)
            )

        return value_and_jacobian(begin_segment, step)

    def with_columns(
        self, values: Any, origin_state: SegmentStart, slopes: SegmentStart, has_columns: Any
    ) -> tuple[tuple[Point, Point], SegmentStart]:
        """Points of one segment, their derivatives by its unknowns with these last, and its end.

        Args:
            has_columns: false if the derivatives are not needed; only the first group is flown then. A
                segment that is not flown stays at its start, which costs no steps.
        """
        flat, unravel = ravel_pytree(values)

        def end_point(
            is_flown: Any, flat: Any, origin_state: SegmentStart
        ) -> tuple[Point, SegmentStart]:
            # A segment of equal times takes no steps: a condition on data would evaluate both branches under
            # vmap.
            ts = jnp.where(is_flown, self.ts, self.ts[0])
            return go_on(self.space, self.system(unravel(flat)), origin_state, ts, self.method)

        def push_group(_: None, direction_group: Any) -> tuple[None, Any]:
            k, tangents = direction_group
            fly = lambda *x: end_point(has_columns | (k == 0), *x)
            push = lambda *d: jax.jvp(fly, (flat, origin_state), d, has_aux=True)
            points, columns, end = jax.vmap(push, out_axes=(0, -1, 0))(*tangents)
            # points and end are the same along every direction
            return None, (*jax.tree.map(lambda x: x[0], (points, end)), columns)

        n, k = flat.shape[0], slopes.internal.shape[-1]
        # Directions go in groups of limited size: all at once, the integrator's state would no longer fit
        # into the processor's cache.
        groups = max(1, -(-(n + k) // _GROUP))
        size = -(-(n + k) // groups)

        def group_columns(first: Any, last: Any) -> Array:
            every = jnp.concatenate([first, last])
            none = jnp.zeros((groups * size - n - k, *every.shape[1:]), every.dtype)
            return jnp.concatenate([every, none]).reshape(groups, size, *every.shape[1:])

        zero_changes = lambda J: jnp.zeros((n, *J.shape[:-1]), J.dtype)
        tangents = (
            group_columns(jnp.eye(n, dtype=flat.dtype), jnp.zeros((k, n), flat.dtype)),
            jax.tree.map(lambda J: group_columns(zero_changes(J), jnp.moveaxis(J, -1, 0)), slopes),
        )
        _, (points, ends, columns) = jax.lax.scan(push_group, None, (jnp.arange(groups), tangents))
        # the length is given explicitly, since a point may have parts of size zero
        long = lambda J: jnp.moveaxis(J, 0, -2).reshape(*J.shape[1:-1], J.shape[0] * J.shape[-1])
        points, end = jax.tree.map(lambda x: x[0], (points, ends))
        return (points, jax.tree.map(lambda J: long(J)[..., : n + k], columns)), end


@eqx.filter_custom_jvp
def _segment_points(
    unknowns: tuple[Any, Float[Array, " k"]], segment: tuple[Point, Point]
) -> Point:
    """Points of one segment that has been flown, with the derivatives by its unknowns."""
    del unknowns
    return segment[0]


@_segment_points.def_jvp
def _segment_points_jvp(primals: Any, tangents: Any) -> tuple[Point, Point]:
    (unknowns, (points, columns)), (moves, _) = primals, tangents
    # the change is None where there is none
    change = lambda x, move: jnp.zeros_like(x) if move is None else move
    changes = jax.tree.map(change, unknowns, moves, is_leaf=lambda x: x is None)
    direction = ravel_pytree(changes)[0]
    return points, jax.tree.map(lambda J: J @ direction, columns)


@quick_jit
def start_legs(
    legs: Legs, origins: Point, steps: Float[Array | np.ndarray, "n k"]
) -> tuple[SegmentStart, SegmentStart]:
    """Starts of all segments (n, .), and their derivatives by the errors there."""
    return legs._map_segments(Legs.make_start, origins, steps)


@quick_jit
def fly_legs(
    legs: Legs, values: Any, origin_state: SegmentStart, slopes: SegmentStart, has_columns: Array
) -> tuple[tuple[Point, Point], SegmentStart]:
    """Points of all segments (n, m, .) and their derivatives by values and own start; their ends."""
    fly_leg = lambda leg, origin_state, slopes: leg.with_columns(
        values, origin_state, slopes, has_columns
    )
    return legs._map_segments(fly_leg, origin_state, slopes)


# --- the problem of multiple shooting


@quick_jit
def _assemble_jacobian(problem: "Shooting", unknowns: Any, segments: Any) -> tuple[Any, Any]:
    """Residuals and the columns of their Jacobian, from the segments and their derivatives."""
    flat, unravel = ravel_pytree(unknowns)
    return value_and_jacobian(lambda x: problem.residuals(unravel(x), segments), flat)


class Shooting(eqx.Module):
    """Multiple-shooting problem: a motion in segments, as residuals for `search`.

    Attributes:
        space: state space of the mechanism.
        system: function from values to the system with its inputs set to numbers or histories;
            see `Inputs.applied`.
        cost: function (values, times (m,), points (m, .), system) -> residuals, any pytree.
        start: point at the first time.
        guess: initial points at the nodes between segments (n - 1, .).
        edges: times of the start, the nodes and the end (n + 1,) [s].
        method: integration method of the segments.
        outputs_per_segment: number of output times per segment.
        weight: weight of the defects at the nodes.
    """

    space: AbstractStateSpace
    system: Callable[[Any], System]
    cost: Callable[..., Any]
    start: Point
    guess: Point
    edges: Float[Array, " e"]
    method: Method
    outputs_per_segment: int = eqx.field(static=True, default=10)
    weight: float | Float[Array, ""] = 1e3

    def unknowns(self, values: PyTree[Any]) -> dict[str, Any]:
        """Initial unknowns of a search: the given values, and the guess at the nodes."""
        nodes = as_floats(np.zeros((len(self.edges) - 2, self.space.size)))
        return {"values": values, "nodes": nodes}

    def _split_unknowns(self, unknowns: Any, xp: Any) -> tuple[Point, Any, Legs]:
        """Origins of the segments, the errors at their starts, and how they are flown.

        Args:
            xp: jax.numpy, or NumPy.
        """
        joined = lambda a, b: xp.concatenate([a[None], b])
        origins = jax.tree.map(joined, self.start, self.guess)
        steps = joined(xp.zeros(self.space.size), unknowns["nodes"])
        share = xp.linspace(0.0, 1.0, self.outputs_per_segment + 1)
        first, last = self.edges[:-1, None], self.edges[1:, None]
        ts = first + share * (last - first)
        return origins, steps, Legs(self.space, self.system, ts, self.method)

    def path(
        self, unknowns: Any, segments: Any = None
    ) -> tuple[Float[Array, " m"], Point, Float[Array, "n k"]]:
        """Output times, points at these times, and the defects at the nodes.

        Args:
            segments: points and derivatives of all segments where these are known.
        """
        nodes = jax.vmap(self.space.retract)(self.guess, unknowns["nodes"])
        origins, steps, legs = self._split_unknowns(unknowns, jnp)
        points = legs.compute_points(unknowns["values"], origins, steps, segments)
        ends = jax.tree.map(lambda x: x[:-1, -1], points)
        gaps = jax.vmap(self.space.difference)(ends, nodes)
        # shapes are given explicitly, since a point may have parts of size zero
        flat = lambda x: x[:, 1:].reshape(x.shape[0] * (x.shape[1] - 1), *x.shape[2:])
        return flat(legs.ts), jax.tree.map(flat, points), gaps

    def residuals(self, unknowns: Any, segments: Any = None) -> Any:
        """Residuals of the cost, and weighted defects at the nodes; see `path`."""
        ts, path, gaps = self.path(unknowns, segments)
        system = self.system(unknowns["values"])
        return self.cost(unknowns["values"], ts, path, system), self.weight * gaps

    def __call__(self, unknowns: Any) -> Any:
        """Residuals of the cost, and weighted defects at the nodes."""
        return self.residuals(unknowns)

    def evaluated(self, unknowns: Any, *, columns: bool = True) -> tuple[Any, Any]:
        """Residuals, and the columns of their Jacobian, which are valid only where they are requested.

        All segments of all motions of a search are flown by one program, with and without derivatives.
        """
        origins, steps, legs = self._split_unknowns(as_numpy(unknowns), np)
        origin_state, slopes = start_legs(legs, origins, steps)
        has_columns = as_jax(np.asarray(columns))
        segments, _ = fly_legs(legs, unknowns["values"], origin_state, slopes, has_columns)
        return _assemble_jacobian(self, unknowns, segments)

    def motion(self, values: Any, ts: Float[np.ndarray, " m"]) -> Point:
        """Points (m, .) at increasing times of the motion from its start, without gaps.

        The program of the search flies it, a few output times at a time. Points that an integration
        does not reach are NaN.
        """
        origins, steps, legs = self._split_unknowns(as_numpy(self.unknowns(values)), np)
        every, slopes = start_legs(legs, origins, 0 * steps)
        count, size, without = len(steps), self.outputs_per_segment, as_jax(np.asarray(False))
        now = jax.tree.map(lambda x: x[0], every)
        path = [jax.tree.map(lambda x: np.asarray(x)[None], self.start)]
        for k in range(0, len(ts) - 1, size):
            part = np.full(size + 1, ts[min(k + size, len(ts) - 1)])
            part[: len(ts) - k] = ts[k : k + size + 1]
            # the first segment flies, and the others stay where they are
            times = np.concatenate([part[None], np.full((count - 1, size + 1), ts[k])])
            every = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape)), as_numpy(now))
            (points, _), ends = fly_legs(replace(legs, ts=times), values, every, slopes, without)
            path.append(jax.tree.map(lambda x: np.asarray(x)[0, 1:], points))
            now = jax.tree.map(lambda x: x[0], ends)
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(ts)], *path)


def make_shooting(
    space: AbstractStateSpace,
    system: Callable[[Any], System],
    cost: Callable[..., Any],
    guess: Callable[[float], Point],
    edges: Float[np.ndarray, " e"],
    method: Method | None = None,
    *,
    outputs_per_segment: int = 10,
    weight: float = 1e3,
) -> Shooting:
    """Set up a `Shooting` problem with the guess as a function of time [s].

    Raises:
        SettingError: times that do not increase, or no output times inside a segment.
    """
    edges = np.asarray(edges, dtype=float)
    if len(edges) < 2 or np.any(np.diff(edges) <= 0):
        raise SettingError(f"The edges of segments must be two or more increasing times: {edges}.")
    if outputs_per_segment < 1:
        raise SettingError(f"A segment needs at least one output time, not {outputs_per_segment}.")
    method = Method(rtol=1e-9, atol=1e-9) if method is None else method
    method = replace(method, adjoint=diffrax.ForwardMode())
    start, *points = (guess(float(t)) for t in edges[:-1])
    nodes = jax.tree.map(lambda x: as_floats(np.zeros((0, *np.shape(x)))), start)
    if points:
        nodes = jax.tree.map(lambda *x: stack_arrays(x), *points)
    return Shooting(
        space, system, cost, start, nodes, as_floats(edges), method, outputs_per_segment, weight
    )
