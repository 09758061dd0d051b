"""Inputs tuned by gradients through the motion of any mechanism.

`tune_inputs` looks for constant inputs, or for histories that are cubic splines through a few knots,
such that residuals of the motion are small: departures from a point (`departures`), the distance from
a target at the end (`end_at`), `roughness` of the histories, and limits, kept by residuals that are
zero inside (`Limit`). It is a least-squares problem by direct multiple shooting (`Shooting`).

Source: J. T. Betts, Practical Methods for Optimal Control (2010), ch. 3 (direct shooting).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from ..algebra.least_squares import Method as SearchMethod, Search, search
from ..algebra.sampled import Sampled
from ..algebra.space import Point
from ..checks.errors import ModelError, SettingError, check_finite
from ..checks.numbers import numbers
from ..checks.shapes import Numbers
from ..dynamics.formulations.reactions import in_joint_axes
from ..dynamics.formulations.stabilisation import Unstabilised
from ..dynamics.method import Method
from ..dynamics.statespace.base import AbstractStateSpace, places_of
from ..dynamics.tree.formulation import Tree
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.system import System
from .multiple_shooting import Shooting, fly, shooting


class TunedMotion(NamedTuple):
    """A motion under inputs that are tuned, as residuals see it.

    Attributes:
        ts: (m,) [s]. points: of the state space (m, .). inputs: at these times (m, k).
        values: what is searched for, inputs in units of their sizes: (k,), or (knots, k).
        space: the mechanism's state space. system: with these inputs.
    """

    ts: Float[Array, " m"]
    points: Point
    inputs: Float[Array, "m k"]
    values: Float[Array, "*n k"]
    space: AbstractStateSpace
    system: System


Residual = Callable[[TunedMotion], Any]


class Departure(eqx.Module):
    """Errors seen from a point in their sizes: as root mean squares over the motion, or at its end.

    Attributes:
        point: of the state space. sizes: what counts as one (n,). places: of the errors.
    """

    point: Point
    sizes: Float[Array, " n"]
    places: tuple[int, ...] = eqx.field(static=True)
    at_end: bool = eqx.field(static=True)

    def __call__(self, motion: TunedMotion) -> Float[Array, "m n"]:
        found, count = motion.points, len(motion.ts)
        if self.at_end:
            found, count = jax.tree.map(lambda x: x[-1:], found), 1
        x = jax.vmap(lambda now: motion.space.difference(now, self.point))(found)
        return x[:, np.array(self.places, dtype=int)] / self.sizes / jnp.sqrt(count)


def departures(
    space: AbstractStateSpace, point: Point, sizes: Mapping[str, float] | None = None
) -> Departure:
    """Residuals that keep a motion near a point.

    Args:
        sizes: what counts as one, by the name of a state; others do not count. Default: all, with
            one in their units.
    """
    return _departure(space, point, sizes, at_end=False)


def end_at(
    space: AbstractStateSpace, point: Point, sizes: Mapping[str, float] | None = None
) -> Departure:
    """Residuals that bring a motion to a point at its end; see `departures`."""
    return _departure(space, point, sizes, at_end=True)


def _departure(
    space: AbstractStateSpace, point: Point, sizes: Mapping[str, float] | None, *, at_end: bool
) -> Departure:
    sizes = dict.fromkeys([name for name, _ in space.names], 1.0) if sizes is None else sizes
    places = places_of(space, list(sizes), "The departures")
    return Departure(point, jnp.asarray(list(sizes.values()), dtype=float), places, at_end)


def roughness(motion: TunedMotion) -> Float[Array, "m k"]:
    """Second differences of the histories at their knots, in the inputs' sizes."""
    return jnp.diff(motion.values, 2, axis=0)


class Limit(eqx.Module):
    """Penalty residuals: zero where a limit is kept, else proportional to the excess over it.

    A penalty is no guarantee: where a limit conflicts with the other residuals, or a search ends
    early, the solution may still pass it. `excess` of the solution's motion says by how much.

    Attributes:
        excess: motion -> excess over the limit, negative inside, as a share of some size.
        weight: weight of these shares.
    """

    excess: Callable[[TunedMotion], Array]
    weight: float = 100.0

    def __call__(self, motion: TunedMotion) -> Array:
        over = jnp.maximum(self.excess(motion), 0.0)
        return self.weight / jnp.sqrt(len(motion.ts)) * over


class _Signals(eqx.Module):
    """Inputs from values of order one: constants, or splines through knots at given times."""

    sizes: Float[Array, " k"]
    ts: tuple[float, ...] | None = eqx.field(static=True)

    def __call__(self, values: Float[Array, "*n k"]) -> Any:
        scaled = values * self.sizes
        return scaled if self.ts is None else Sampled(np.array(self.ts), scaled, 3)


class _Driven(eqx.Module):
    """The system with inputs that follow from the values of a search."""

    space: AbstractStateSpace
    inputs: Inputs
    signals: _Signals

    def __call__(self, values: Any) -> System:
        return self.inputs.applied(self.space.system, self.signals(values))


class _Cost(eqx.Module):
    """All residuals of a motion."""

    driven: _Driven
    residuals: tuple[Residual, ...]

    def __call__(self, values: Any, ts: Array, path: Point, system: System) -> Any:
        motion = self.seen(values, ts, path, system)
        return [residual(motion) for residual in self.residuals]

    def seen(self, values: Any, ts: Array, path: Point, system: System) -> TunedMotion:
        signals = self.driven.signals
        given: Any = signals(values)
        constant = lambda t: given
        inputs = jax.vmap(constant if signals.ts is None else given)(ts)
        return TunedMotion(ts, path, inputs, values, self.driven.space, system)


@dataclass(frozen=True)
class InputTuning:
    """A least-squares problem whose values are inputs; see `tune_inputs`.

    Attributes:
        name: name that tells the problem from others in files.
        residuals: residuals for `search`.
        start: initial unknowns of the search.
    """

    name: str
    residuals: Shooting
    start: Any

    def inputs(self, values: Any) -> Any:
        """The inputs that the values of a search stand for: numbers (k,), or a history of them."""
        return self.residuals.cost.driven.signals(values["values"])  # pyright: ignore

    def search(self, method: SearchMethod | None = None, **options: Any) -> Search:
        """Solve it; see `search` for the options. Default: Levenberg-Marquardt."""
        method = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8) if method is None else method
        return search(self.residuals, self.start, method, **options)

    def motion(self, values: Any, samples: int = 200) -> TunedMotion:
        """The motion under the inputs of a search, from its start in one piece."""
        ts = jnp.linspace(self.residuals.edges[0], self.residuals.edges[-1], samples)
        return _in_one_piece(self.residuals, values["values"], ts)


@quick_jit
def _in_one_piece(problem: Shooting, values: Any, ts: Float[Array, " m"]) -> TunedMotion:
    system = problem.system(values)
    path = fly(problem.space, system, problem.start, ts, problem.method)
    return problem.cost.seen(values, ts, path, system)  # pyright: ignore


def tune_inputs(
    space: AbstractStateSpace,
    residuals: Sequence[Residual],
    *,
    start: Point,
    duration: float,
    inputs: Inputs | Sequence[str] | None = None,
    values: Numbers | None = None,
    sizes: Numbers | None = None,
    knots: int | None = None,
    segments: int = 1,
    outputs_per_segment: int = 10,
    guess: Callable[[float], Point] | None = None,
    weight: float = 1e3,
    method: Method | None = None,
    name: str = "tuned inputs",
) -> InputTuning:
    """The search for inputs under which residuals of a motion are small.

    Args:
        space: the mechanism's state space. start: where the motion starts.
        residuals: motion (`TunedMotion`) -> any pytree of numbers that are to be small.
        duration: of the motion [s].
        inputs: those that are tuned, or their names; default all of the system.
        values: of the inputs at the start of the search (k,), or with knots also (knots, k); default
            those that the system has.
        sizes: of the inputs (k,): what counts as a change of one; default the largest of their
            values, or one where these are zero.
        knots: of the splines, evenly spaced in time; default none: the inputs are constant.
        segments: number of segments of multiple shooting. outputs_per_segment: output times in each.
            weight: weight of the gaps between them.
        guess: time [s] -> point, where segments start in the search; default the start.
        name: of the problem, for files.

    Raises:
        SettingError: a time that is not positive, too few knots or segments, no residuals, or an
            unknown input. ModelError: numbers of another shape.
    """
    check_span(duration, segments)
    if knots is not None and knots < 4:
        raise SettingError(f"Cubic splines need four knots or more, not {knots}.")
    if not residuals:
        raise SettingError("Tuned inputs need at least one residual of the motion.")
    space.check(start, "The start of the motion")
    if not isinstance(inputs, Inputs):
        inputs = inputs_of(space.system, inputs)
    if not len(inputs):
        raise SettingError("The system has no inputs that could be tuned.")
    given = jnp.asarray(inputs.values(space.system) if values is None else values, dtype=float)
    shape = (len(inputs),) if knots is None else (knots, len(inputs))
    if given.shape not in ((len(inputs),), shape):
        raise ModelError(f"The start of the inputs must have shape {shape}, not {given.shape}.")
    check_finite(given, "The start of the inputs", "")
    if sizes is None:
        largest = jnp.max(jnp.abs(given.reshape(-1, len(inputs))), axis=0)
        sizes = jnp.where(largest == 0, 1.0, largest)
    sizes = numbers(sizes, (len(inputs),), "The vector of the inputs' sizes", "")
    times = None if knots is None else tuple(float(t) for t in np.linspace(0.0, duration, knots))
    driven = _Driven(space, inputs, _Signals(sizes, times))
    problem = shooting(
        space, driven, _Cost(driven, tuple(residuals)), guess or (lambda _: start),
        np.linspace(0.0, duration, segments + 1), method, outputs_per_segment=outputs_per_segment, weight=weight,
    )  # fmt: skip
    return InputTuning(name, problem, problem.unknowns(jnp.broadcast_to(given, shape) / sizes))


def check_span(span: float, segments: int) -> None:
    """Raise `SettingError` for a time that is not positive or less than one segment."""
    check_finite(span, "The time", "s")
    if not span > 0:
        raise SettingError(f"The time must be positive, not {span:g} s.")
    if segments < 1:
        raise SettingError(f"There must be at least one segment, not {segments}.")


def joint_forces(motion: TunedMotion) -> Float[Array, "m joints"]:
    """Size of the reaction force in every joint along a motion [N]."""
    tree, space, system = Tree(), motion.space, motion.system
    model = tree.prepare(system)

    def at(t: Array, now: Point) -> Array:
        state = space.to_state(now, t)
        found = tree.accelerations(model, t, state, Unstabilised())
        force = in_joint_axes(system, state, tree.reactions(model, t, state, found)).force
        return jnp.sqrt(jnp.sum(force**2, axis=1))

    return jax.vmap(at)(motion.ts, motion.points)
