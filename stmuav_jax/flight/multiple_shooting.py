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

from ..algebra.compiler import quick_jit
from ..algebra.derivative import value_and_jacobian
from ..algebra.space import Point
from ..checks.errors import SettingError
from ..checks.numbers import as_jax, as_numpy, floats, stacked
from ..dynamics.method import Method
from ..dynamics.statespace.base import AbstractStateSpace
from ..mechanics.system import System
from .segments import Legs, fly, legs_begun, legs_flown


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


@quick_jit
def _assembled(problem: "Shooting", unknowns: Any, flown: Any) -> tuple[Any, Any]:
    """Residuals and the columns of their Jacobian, from the segments and their derivatives."""
    flat, unravel = ravel_pytree(unknowns)
    return value_and_jacobian(lambda x: problem.residuals(unravel(x), flown), flat)


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
        nodes = floats(np.zeros((len(self.edges) - 2, self.space.size)))
        return {"values": values, "nodes": nodes}

    def _parts(self, unknowns: Any, xp: Any) -> tuple[Point, Any, Legs]:
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
        self, unknowns: Any, flown: Any = None
    ) -> tuple[Float[Array, " m"], Point, Float[Array, "n k"]]:
        """Output times, points at these times, and the defects at the nodes.

        Args:
            flown: points and derivatives of all segments where these are known.
        """
        nodes = jax.vmap(self.space.retract)(self.guess, unknowns["nodes"])
        origins, steps, legs = self._parts(unknowns, jnp)
        found = legs.flown(unknowns["values"], origins, steps, flown)
        ends = jax.tree.map(lambda x: x[:-1, -1], found)
        gaps = jax.vmap(self.space.difference)(ends, nodes)
        # shapes are given explicitly, since a point may have parts of size zero
        flat = lambda x: x[:, 1:].reshape(x.shape[0] * (x.shape[1] - 1), *x.shape[2:])
        return flat(legs.ts), jax.tree.map(flat, found), gaps

    def residuals(self, unknowns: Any, flown: Any = None) -> Any:
        """Residuals of the cost, and weighted defects at the nodes; see `path`."""
        ts, found, gaps = self.path(unknowns, flown)
        system = self.system(unknowns["values"])
        return self.cost(unknowns["values"], ts, found, system), self.weight * gaps

    def __call__(self, unknowns: Any) -> Any:
        """Residuals of the cost, and weighted defects at the nodes."""
        return self.residuals(unknowns)

    def evaluated(self, unknowns: Any, *, columns: bool = True) -> tuple[Any, Any]:
        """Residuals, and the columns of their Jacobian, which are wrong where they are not wanted.

        All segments of all motions of a search are flown by one program, with and without derivatives.
        """
        origins, steps, legs = self._parts(as_numpy(unknowns), np)
        begun, slopes = legs_begun(legs, origins, steps)
        flown, _ = legs_flown(legs, unknowns["values"], begun, slopes, _truth(columns))
        return _assembled(self, unknowns, flown)

    def motion(self, values: Any, ts: Float[np.ndarray, " m"]) -> Point:
        """Points (m, .) at increasing times of the motion from its start, without gaps.

        The program of the search flies it, a few output times at a time. Points that an integration
        does not reach are NaN.
        """
        origins, steps, legs = self._parts(as_numpy(self.unknowns(values)), np)
        every, slopes = legs_begun(legs, origins, 0 * steps)
        count, size = len(steps), self.outputs_per_segment
        now = jax.tree.map(lambda x: x[0], every)
        found = [jax.tree.map(lambda x: np.asarray(x)[None], self.start)]
        for k in range(0, len(ts) - 1, size):
            part = np.full(size + 1, ts[min(k + size, len(ts) - 1)])
            part[: len(ts) - k] = ts[k : k + size + 1]
            # the first segment flies, and the others stay where they are
            times = np.concatenate([part[None], np.full((count - 1, size + 1), ts[k])])
            begun = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape)), as_numpy(now))
            here = replace(legs, ts=times)
            (points, _), ends = legs_flown(here, values, begun, slopes, _truth(False))
            found.append(jax.tree.map(lambda x: np.asarray(x)[0, 1:], points))
            now = jax.tree.map(lambda x: x[0], ends)
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(ts)], *found)


def _truth(value: bool) -> Bool[Array, ""]:
    return as_jax(np.asarray(value))


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
        space, system, cost, start, nodes, floats(edges), method, outputs_per_segment, weight
    )
