"""Flights as functions of what is to be chosen: sensitivities along a path, multiple shooting.

A flight that is not held by a controller multiplies small differences, by e in every 0.09 s for
the report's UAV: over long times neither its end nor the derivatives of its end are of use.
Multiple shooting cuts the path at times t_k. The coordinates there are unknowns like all others,
and what is left between the end of one segment and the start of the next is to vanish:

    x(t_k+1; x_k, q) - x_k+1 = 0.

Nothing is then multiplied by more than one segment does. One segment is single shooting.

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

from ..dynamics.integrate import integrate
from ..dynamics.problem import Method
from ..mechanics.errors import SettingError
from ..mechanics.system import System
from ..vehicle.flyer import Coordinates, Flyer, displacement, shifted


def fly(
    flyer: Flyer, system: System, start: Coordinates, ts: Float[Array, " k"], method: Method
) -> Coordinates:
    """The coordinates at times ts [s], the first that of the start; a stack (k, .)."""
    run = integrate(system, flyer.state(start), ts, method)
    return jax.vmap(flyer.coordinates)(run.states)


@eqx.filter_jit
def transition(
    flyer: Flyer, system: System, start: Coordinates, ts: Float[Array, " k"], method: Method
) -> Float[Array, "k 16 16"]:
    """Derivatives of the displacement at times ts by that at the start."""
    method = replace(method, adjoint=diffrax.ForwardMode())
    path = jax.lax.stop_gradient(fly(flyer, system, start, ts, method))

    def moved(x: Float[Array, "16"]) -> Float[Array, "k 16"]:
        found = fly(flyer, system, shifted(start, x), ts, method)
        return jax.vmap(displacement)(found, path)

    return jax.jacfwd(moved)(jnp.zeros(16))


class Growth(NamedTuple):
    """How differences at the start grow along a path.

    Attributes:
        ts: (k,) [s]. factor: largest singular value of the derivative by the start, in m, rad,
            m/s and rad/s alike (k,). rate: of its logarithm over the second half [1/s].
        useful: last time at which `factor` times the error of a step stays below 1 % [s].
    """

    ts: Float[np.ndarray, " k"]
    factor: Float[np.ndarray, " k"]
    rate: float
    useful: float


def growth(
    flyer: Flyer,
    system: System,
    start: Coordinates,
    ts: Float[np.ndarray, " k"],
    method: Method | None = None,
) -> Growth:
    """Growth of sensitivities, and until when derivatives of the path are of use.

    Args:
        system: the flyer's with inputs, see `Flyer.with_inputs`. ts: increasing (k,), k >= 3 [s].
    """
    if len(ts) < 3:
        raise SettingError(f"The growth along a path needs three times or more, not {len(ts)}.")
    method = Method() if method is None else method
    Phi = np.asarray(transition(flyer, system, start, jnp.asarray(ts), method))
    factor = np.linalg.svd(Phi, compute_uv=False)[:, 0]
    late = slice(len(ts) // 2, None)
    rate = float(np.polyfit(ts[late], np.log(factor[late]), 1)[0])
    fine = factor * float(method.rtol) < 0.01
    last = len(ts) - 1 if np.all(fine) else max(int(np.argmin(fine)) - 1, 0)
    return Growth(np.asarray(ts), factor, rate, float(ts[last]))


class _Piece(NamedTuple):
    """Of one segment, what is not looked for."""

    flyer: Flyer
    inputs: Callable[[Any], Any]
    origin: Coordinates
    ts: Float[Array, " m"]
    method: Method


def _segment(unknowns: tuple[Any, Float[Array, "16"]], how: _Piece) -> Coordinates:
    """One segment, as a function of its values and its start's displacement."""
    values, step = unknowns
    system = how.flyer.with_inputs(how.inputs(values))
    return fly(how.flyer, system, shifted(how.origin, step), how.ts, how.method)


@eqx.filter_custom_jvp
def _flown(unknowns: tuple[Any, Float[Array, "16"]], how: _Piece) -> Coordinates:
    """`_segment` with derivatives by way of its whole Jacobian."""
    return _segment(unknowns, how)


@_flown.def_jvp
def _flown_jvp(primals: Any, tangents: Any) -> tuple[Coordinates, Coordinates]:
    # A segment knows only its own start. By way of its own Jacobian, the derivatives by the starts
    # of all n segments cost as much as those by one.
    (unknowns, how), (moves, _) = primals, tangents
    flat, unravel = ravel_pytree(unknowns)
    push = lambda e: jax.jvp(lambda u: _segment(u, how), (unknowns,), (unravel(e),))
    out, columns = jax.vmap(push, out_axes=(0, -1))(jnp.eye(flat.shape[0], dtype=flat.dtype))
    given = lambda x, move: jnp.zeros_like(x) if move is None else move
    along = ravel_pytree(jax.tree.map(given, unknowns, moves, is_leaf=lambda x: x is None))[0]
    first = jax.tree.map(lambda x: x[0], out)
    return first, jax.tree.map(lambda J: J @ along, columns)


class Shooting(eqx.Module):
    """A flight in segments, as residuals for `search`.

    Attributes:
        flyer: the UAV. inputs: values -> `Inputs`, numbers or histories.
        cost: (values, times (m,), coordinates (m, .), flyer's system) -> residuals, any pytree.
        start: coordinates at the first time. guess: at the cuts between segments (n - 1, .).
        edges: times of the start, the cuts and the end (n + 1,) [s].
        inside: output times per segment. weight: of what is left at the cuts.
    """

    flyer: Flyer
    inputs: Callable[[Any], Any]
    cost: Callable[..., Any]
    start: Coordinates
    guess: Coordinates
    edges: Float[Array, " e"]
    method: Method
    inside: int = eqx.field(static=True, default=10)
    weight: float | Float[Array, ""] = 1e3

    def unknowns(self, values: PyTree[Any]) -> dict[str, Any]:
        """Where a search starts: these values, and the guess at the cuts."""
        return {"values": values, "nodes": jnp.zeros((len(self.edges) - 2, 16))}

    def path(self, unknowns: Any) -> tuple[Float[Array, " m"], Coordinates, Float[Array, "n 16"]]:
        """Output times, coordinates there, and what is left at the cuts."""
        nodes = jax.vmap(shifted)(self.guess, unknowns["nodes"])
        joined = lambda a, b: jnp.concatenate([a[None], b])
        origins = jax.tree.map(joined, self.start, self.guess)
        steps = joined(jnp.zeros(16), unknowns["nodes"])
        share = jnp.linspace(0.0, 1.0, self.inside + 1)
        first, last = self.edges[:-1, None], self.edges[1:, None]
        ts = first + share * (last - first)

        def one(step: Array, origin: Coordinates, ts: Array) -> Coordinates:
            how = _Piece(self.flyer, self.inputs, origin, ts, self.method)
            return _flown((unknowns["values"], step), how)

        found = jax.vmap(one)(steps, origins, ts)
        ends = jax.tree.map(lambda x: x[:-1, -1], found)
        gaps = jax.vmap(displacement)(ends, nodes)
        flat = lambda x: x[:, 1:].reshape(-1, *x.shape[2:])
        return flat(ts), jax.tree.map(flat, found), gaps

    def __call__(self, unknowns: Any) -> Any:
        """Residuals: of the cost, and of the cuts."""
        ts, found, gaps = self.path(unknowns)
        system = self.flyer.with_inputs(self.inputs(unknowns["values"]))
        return self.cost(unknowns["values"], ts, found, system), self.weight * gaps


def shooting(
    flyer: Flyer,
    inputs: Callable[[Any], Any],
    cost: Callable[..., Any],
    guess: Callable[[float], Coordinates],
    edges: Float[np.ndarray, " e"],
    method: Method | None = None,
    *,
    inside: int = 10,
    weight: float = 1e3,
) -> Shooting:
    """A `Shooting` with its guess as a function of time [s]; see there.

    Raises:
        SettingError: times that do not increase, or no output times inside a segment.
    """
    edges = np.asarray(edges, dtype=float)
    if len(edges) < 2 or np.any(np.diff(edges) <= 0):
        raise SettingError(f"The edges of segments must be two or more increasing times: {edges}.")
    if inside < 1:
        raise SettingError(f"A segment needs at least one output time, not {inside}.")
    method = Method(rtol=1e-9, atol=1e-9) if method is None else method
    method = replace(method, adjoint=diffrax.ForwardMode())
    points = [guess(float(t)) for t in edges[:-1]]
    start = points[0]
    if len(points) > 1:
        nodes = jax.tree.map(lambda *x: jnp.stack(x), *points[1:])
    else:
        nodes = jax.tree.map(lambda x: jnp.zeros((0, *x.shape)), start)
    return Shooting(flyer, inputs, cost, start, nodes, jnp.asarray(edges), method, inside, weight)
