"""Multiple shooting, and the growth of sensitivities along a trajectory.

An uncontrolled motion amplifies small differences, by a factor e in every 0.09 s for the report's
UAV: over long times neither its end nor the derivatives of its end are of use. Multiple shooting
divides the path at times t_k. The points there are unknowns like all others, and the defect
between the end of one segment and the start of the next is to vanish:

    x(t_k+1; x_k, q) - x_k+1 = 0.

Differences are then amplified over one segment only. One segment is single shooting.

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
from jaxtyping import Array, Bool, Float, PyTree

from ..algebra.derivative import value_and_slopes
from ..algebra.space import Point
from ..checks.errors import SettingError
from ..checks.numbers import as_jax, floats, stacked
from ..dynamics.method import Method
from ..dynamics.statespace.base import AbstractStateSpace
from ..dynamics.statespace.tree import TreeSpace
from ..dynamics.trajectory import integrate
from ..mechanics.internal import internal_states, with_internal
from ..mechanics.system import System

# Directions of a segment's derivatives that are computed together where it has few unknowns. Values
# alone then cost one group, and need no program of their own; with many unknowns, as in the slew of the
# UAV, whose search needs many values, the time of the groups would exceed that of compiling one.
_GROUP, _FEW = 8, 32


def fly(
    space: AbstractStateSpace, system: System, start: Point, ts: Float[Array, " k"], method: Method
) -> Point:
    """The points of a motion at times ts [s], the first that of the start; a stack (k, .)."""
    state, inside = space.to_state(start, ts[0]), 2 * space.dof
    if isinstance(space, TreeSpace) and space.has_dependent_rows:
        allowing = method.formulation.allowing_dependent_rows()
        method = method if allowing is None else replace(method, formulation=allowing)
    if space.size == inside:
        run = integrate(system, state, ts, method)
        return jax.vmap(space.from_state)(run.states)
    # a state of all bodies has no states of forces: those of the point are set, and read, apart
    own = internal_states(space.system)
    first = own + space.difference(start, space.from_state(state))[inside:]
    run = integrate(with_internal(system, first), state, ts, method)
    v = jnp.pad(run.internal - own, ((0, 0), (inside, 0)))
    return jax.vmap(space.retract)(jax.vmap(space.from_state)(run.states), v)


@eqx.filter_jit
def transition(
    space: AbstractStateSpace, system: System, start: Point, ts: Float[Array, " k"], method: Method
) -> Float[Array, "k n n"]:
    """Transition matrices: derivatives of the errors (n,) at times ts by those at the start."""
    method = replace(method, adjoint=diffrax.ForwardMode())
    path = jax.lax.stop_gradient(fly(space, system, start, ts, method))

    def moved(v: Float[Array, " n"]) -> Float[Array, "k n"]:
        found = fly(space, system, space.retract(start, v), ts, method)
        return jax.vmap(space.difference)(found, path)

    return jax.jacfwd(moved)(jnp.zeros(space.size))


class Growth(NamedTuple):
    """Growth of initial differences along a path.

    Attributes:
        ts: times (k,) [s].
        factor: largest singular value of the transition matrix, in m, rad, m/s and rad/s (k,).
        rate: slope of the logarithm of `factor` over the second half (finite-time Lyapunov
            exponent) [1/s].
        useful_until: last time before `factor` times the relative tolerance of a step reaches 1 % [s].
    """

    ts: Float[np.ndarray, " k"]
    factor: Float[np.ndarray, " k"]
    rate: float
    useful_until: float


def growth(
    space: AbstractStateSpace,
    system: System,
    start: Point,
    ts: Float[np.ndarray, " k"],
    method: Method | None = None,
) -> Growth:
    """Growth of sensitivities along a path, and the time for which derivatives are of use.

    Args:
        system: system of the space with its inputs set.
        ts: increasing times (k,), k >= 3 [s].

    Raises:
        SettingError: fewer than three times.
    """
    if len(ts) < 3:
        raise SettingError(f"The growth along a path needs three times or more, not {len(ts)}.")
    method = Method() if method is None else method
    Phi = np.asarray(transition(space, system, start, jnp.asarray(ts), method))
    factor = np.linalg.svd(Phi, compute_uv=False)[:, 0]
    late = slice(len(ts) // 2, None)
    rate = float(np.polyfit(ts[late], np.log(factor[late]), 1)[0])
    fine = factor * float(method.rtol) < 0.01
    last = len(ts) - 1 if np.all(fine) else max(int(np.argmin(fine)) - 1, 0)
    return Growth(np.asarray(ts), factor, rate, float(ts[last]))


class _Piece(NamedTuple):
    """Data of one segment without its unknowns, and whether its derivatives are wanted."""

    space: AbstractStateSpace
    system: Callable[[Any], System]
    origin: Point
    ts: Float[Array, " m"]
    method: Method
    wanted: Bool[Array, ""] | bool


def _segment(
    unknowns: tuple[Any, Float[Array, " n"]], how: _Piece, flown: Bool[Array, ""] | bool = True
) -> Point:
    """Points of one segment as a function of the values and of the error at its start.

    A segment that is not flown stays at its start, which costs no steps.
    """
    values, step = unknowns
    start = how.space.retract(how.origin, step)
    ts = how.ts if flown is True else jnp.where(flown, how.ts, how.ts[0])
    return fly(how.space, how.system(values), start, ts, how.method)


@eqx.filter_custom_jvp
def _flown(unknowns: tuple[Any, Float[Array, " n"]], how: _Piece) -> Point:
    """Points of one segment (`_segment`), differentiated by way of its whole Jacobian."""
    return _segment(unknowns, how)


@_flown.def_jvp
def _flown_jvp(primals: Any, tangents: Any) -> tuple[Point, Point]:
    # A segment depends only on its own start. By way of its own Jacobian, the derivatives by the
    # starts of all n segments cost as much as those by one.
    (unknowns, how), (moves, _) = primals, tangents
    flat, unravel = ravel_pytree(unknowns)
    points, columns = _in_groups(lambda u, on: _segment(unravel(u), how, on), flat, how.wanted)
    given = lambda x, move: jnp.zeros_like(x) if move is None else move
    along = ravel_pytree(jax.tree.map(given, unknowns, moves, is_leaf=lambda x: x is None))[0]
    return points, jax.tree.map(lambda J: J @ along, columns)


def _in_groups(
    function: Callable[[Float[Array, " n"], Any], Any], x: Float[Array, " n"], wanted: Any
) -> tuple[Any, Any]:
    """Value of a function of a vector, and its Jacobian with the columns last, a group at a time.

    Args:
        function: function of the vector and of a truth value, false where the result is not needed.
        wanted: false if the columns are not needed; only the first group is evaluated then.
    """
    n = x.shape[0]
    count = -(-n // _GROUP) if 0 < n <= _FEW else 1
    size = -(-n // count)
    directions = np.concatenate([np.eye(n), np.zeros((count * size - n, n))])

    def group(_: None, given: tuple[Any, Any]) -> tuple[None, tuple[Any, Any]]:
        k, directions = given
        return None, value_and_slopes(lambda x: function(x, wanted | (k == 0)), x, directions)

    each = jnp.arange(count), jnp.asarray(directions.reshape(count, size, n), x.dtype)
    _, (values, columns) = jax.lax.scan(group, None, each)
    whole = lambda J: jnp.moveaxis(J, 0, -2).reshape(*J.shape[1:-1], count * size)[..., :n]
    return jax.tree.map(lambda v: v[0], values), jax.tree.map(whole, columns)


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
        wanted: false where derivatives are not needed: they are wrong then, and cost little.
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
    wanted: Bool[Array, ""] | bool = True

    def without_columns(self, unknowns: PyTree[Any]) -> "Shooting | None":
        """These residuals without derivatives, for the program with them; None where that costs more."""
        count = sum(np.size(x) for x in jax.tree.leaves(unknowns["values"])) + self.space.size
        return replace(self, wanted=as_jax(np.zeros((), bool))) if count <= _FEW else None

    def unknowns(self, values: PyTree[Any]) -> dict[str, Any]:
        """Initial unknowns of a search: the given values, and the guess at the nodes."""
        nodes = floats(np.zeros((len(self.edges) - 2, self.space.size)))
        return {"values": values, "nodes": nodes}

    def path(self, unknowns: Any) -> tuple[Float[Array, " m"], Point, Float[Array, "n k"]]:
        """Output times, points at these times, and the defects at the nodes."""
        nodes = jax.vmap(self.space.retract)(self.guess, unknowns["nodes"])
        joined = lambda a, b: jnp.concatenate([a[None], b])
        origins = jax.tree.map(joined, self.start, self.guess)
        steps = joined(jnp.zeros(self.space.size), unknowns["nodes"])
        share = jnp.linspace(0.0, 1.0, self.outputs_per_segment + 1)
        first, last = self.edges[:-1, None], self.edges[1:, None]
        ts = first + share * (last - first)

        def one(step: Array, origin: Point, ts: Array) -> Point:
            how = _Piece(self.space, self.system, origin, ts, self.method, self.wanted)
            return _flown((unknowns["values"], step), how)

        found = jax.vmap(one)(steps, origins, ts)
        ends = jax.tree.map(lambda x: x[:-1, -1], found)
        gaps = jax.vmap(self.space.difference)(ends, nodes)
        # shapes are given explicitly, since a point may have parts of size zero
        flat = lambda x: x[:, 1:].reshape(x.shape[0] * (x.shape[1] - 1), *x.shape[2:])
        return flat(ts), jax.tree.map(flat, found), gaps

    def __call__(self, unknowns: Any) -> Any:
        """Residuals of the cost, and weighted defects at the nodes."""
        ts, found, gaps = self.path(unknowns)
        system = self.system(unknowns["values"])
        return self.cost(unknowns["values"], ts, found, system), self.weight * gaps


def shooting(
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
    points = [guess(float(t)) for t in edges[:-1]]
    start = points[0]
    if len(points) > 1:
        nodes = jax.tree.map(lambda *x: stacked(x), *points[1:])
    else:
        nodes = jax.tree.map(lambda x: floats(np.zeros((0, *x.shape))), start)
    return Shooting(
        space, system, cost, start, nodes, floats(edges), method, outputs_per_segment, weight,
        wanted=as_jax(np.ones((), bool)),
    )  # fmt: skip
