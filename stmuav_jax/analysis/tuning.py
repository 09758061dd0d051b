"""Inputs tuned by gradients through the motion of any mechanism.

`tune_inputs` looks for constant inputs, or for histories that are cubic splines through a few knots,
such that residuals of the motion are small: departures from a point (`departures`), the distance from
a target at the end (`end_at`), `roughness` of the histories, and limits, kept by residuals that are
zero inside (`Limit`). It is a least-squares problem by direct multiple shooting (`Shooting`).

Source: J. T. Betts, Practical Methods for Optimal Control (2010), ch. 3 (direct shooting).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, SettingError, check_finite
from ..checks.numbers import array_module, as_floats, as_numpy, check_numbers
from ..checks.shapes import Numbers
from ..dynamics.formulations.base import in_joint_axes
from ..dynamics.formulations.stabilisation import Unstabilised
from ..dynamics.method import Method
from ..dynamics.statespace.base import AbstractStateSpace, places_of
from ..dynamics.tree.formulation import Tree
from ..math.compiler import quick_jit
from ..math.least_squares import (
    CorrectedLevenbergMarquardt,
    Method as SearchMethod,
    Search,
    SearchReason,
    search,
)
from ..math.sampled import Sampled
from ..math.space import Point
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.system import System
from .multiple_shooting import Shooting, make_shooting


class TunedMotion(NamedTuple):
    """A motion under tuned inputs, the argument of residuals.

    Attributes:
        ts: times after the start (m,) [s].
        points: points of the state space at these times (m, .).
        inputs: inputs at these times (m, k).
        extremes: inputs where their splines' pieces meet and where their slopes vanish (e, k): at
            no time are they smaller or larger than the extremes.
        values: unknowns of the search, inputs in units of their sizes: (k,), or (knots, k).
        space: state space of the mechanism. system: system with these inputs.
    """

    ts: Float[Array, " m"]
    points: Point
    inputs: Float[Array, "m k"]
    extremes: Float[Array, "e k"]
    values: Float[Array, "*n k"]
    space: AbstractStateSpace
    system: System


Residual = Callable[[TunedMotion], Any]


class Departure(eqx.Module):
    """Errors relative to a point in units of their sizes, over the motion or at its end.

    Attributes:
        point: point of the state space. sizes: errors that count as one (n,).
        places: places of these errors in an error of the state space.
        at_end: true for the end alone, else root mean squares over the motion.
    """

    point: Point
    sizes: Float[Array, " n"]
    places: tuple[int, ...] = eqx.field(static=True)
    at_end: bool = eqx.field(static=True)

    def __call__(self, motion: TunedMotion) -> Float[Array, "m n"]:
        # Divided by the root of the count, residuals are a mean over the motion: more output times
        # do not weigh it more.
        points, count = motion.points, len(motion.ts)
        if self.at_end:
            points, count = jax.tree.map(lambda x: x[-1:], points), 1
        x = jax.vmap(lambda now: motion.space.difference(now, self.point))(points)
        return x[:, np.array(self.places, dtype=int)] / self.sizes / jnp.sqrt(count)


def departures(
    space: AbstractStateSpace, point: Point, sizes: Mapping[str, float] | None = None
) -> Departure:
    """Residuals that keep a motion near a point.

    Args:
        sizes: errors that count as one, by the name of a state; others do not count. Default: all,
            with one in their units.
    """
    sizes = dict.fromkeys([name for name, _ in space.names], 1.0) if sizes is None else sizes
    places = places_of(space, list(sizes), "The departures")
    return Departure(point, as_floats(list(sizes.values())), places, at_end=False)


def end_at(
    space: AbstractStateSpace, point: Point, sizes: Mapping[str, float] | None = None
) -> Departure:
    """Residuals that bring a motion to a point at its end; see `departures`."""
    return replace(departures(space, point, sizes), at_end=True)


def roughness(motion: TunedMotion) -> Float[Array, "m k"]:
    """Second differences of the histories at their knots, in the inputs' sizes."""
    return jnp.diff(motion.values, 2, axis=0)


class Limit(eqx.Module):
    """Penalty residuals: zero where a limit is met, else proportional to the excess over it.

    The limit is evaluated where the motion is known: its states at the output times, its inputs at all times
    through `TunedMotion.extremes`. A penalty is no guarantee: where a limit conflicts with the other
    residuals, the best motion exceeds it. `InputTuning.search` checks and reports this.

    Attributes:
        excess: function motion -> excess over the limit, negative inside, as a share of some size:
            any pytree of arrays.
        weight: weight of these shares.
        tolerance: share by which a solution may pass the limit.
    """

    excess: Callable[[TunedMotion], Any]
    weight: float | Float[Array, ""] = 100.0
    tolerance: float = 0.01

    def __call__(self, motion: TunedMotion) -> Any:
        # Zero inside the limit: a motion that keeps it is not pulled away from its boundary.
        over = lambda x: self.weight / jnp.sqrt(len(x)) * jnp.maximum(x, 0.0)
        return jax.tree.map(over, self.excess(motion))


class _Signals(eqx.Module):
    """Inputs from values of order one: constants, or splines through knots at given times."""

    sizes: Float[Array, " k"]
    ts: tuple[float, ...] | None = eqx.field(static=True)

    def __call__(self, values: Float[Array, "*n k"]) -> Any:
        scaled = values * self.sizes
        return scaled if self.ts is None else Sampled(np.array(self.ts), scaled, 3)

    def extremes(self, values: Float[Array, "*n k"]) -> Float[Array, "e k"]:
        """Inputs at the ends of all pieces and at their stationary points (e, k)."""
        history = self(values)
        if self.ts is None:
            return history[None]
        a, b, c, d = history.coefficients
        lengths = jnp.diff(history.breaks)[:, None]
        # A limit must hold between the knots as well, where a cubic may overshoot: its extremes are known in
        # closed form.
        root = jnp.sqrt(jnp.maximum(b**2 - 3 * a * c, 0.0))
        # of the two forms of each root the one without cancellation; one that is none becomes an end
        q = -(b + jnp.where(b < 0, -root, root))
        safe = lambda y: jnp.where(y == 0, 1.0, y)
        ratio = lambda x, y: jnp.clip(jnp.where(y == 0, 0.0, x / safe(y)), 0, lengths)
        # the slope is zero there, or the place is fixed: values do not depend on how it moves
        places = [0 * a, *jax.lax.stop_gradient((ratio(q, 3 * a), ratio(c, q))), lengths + 0 * a]
        return jnp.concatenate([((a * s + b) * s + c) * s + d for s in places])


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
        motion = self.motion(values, ts, path, system)
        return [residual(motion) for residual in self.residuals]

    def motion(self, values: Any, ts: Array, path: Point, system: System) -> TunedMotion:
        signals = self.driven.signals
        signal: Any = signals(values)
        constant = lambda t: signal
        inputs = jax.vmap(constant if signals.ts is None else signal)(ts)
        extremes = signals.extremes(values)
        return TunedMotion(ts, path, inputs, extremes, values, self.driven.space, system)


@dataclass(frozen=True)
class InputTuning:
    """A least-squares problem whose values are inputs; see `tune_inputs`.

    Attributes:
        name: name that identifies the problem in files.
        residuals: residuals for `search`.
        start: initial unknowns of the search.
    """

    name: str
    residuals: Shooting
    start: Any
    _motions: dict[Any, TunedMotion] = field(default_factory=dict, repr=False, compare=False)

    def inputs(self, values: Any) -> Any:
        """Inputs of the values of a search: numbers (k,), or a history of them."""
        return self.residuals.cost.driven.signals(values["values"])  # pyright: ignore

    def search(self, method: SearchMethod | None = None, **options: Any) -> Search:
        """Solve the problem; see `search` for the options. Default: `CorrectedLevenbergMarquardt`.

        A search that has ended with a motion that passes a limit by more than its tolerance has not
        succeeded: its reason is `SearchReason.LIMIT_PASSED`, and `excess` says by how much.
        """
        method = CorrectedLevenbergMarquardt() if method is None else method
        search_result = search(self.residuals, self.start, method, **options)
        # Limits are penalties, and a search may converge at a balance of penalty and aim beyond them.
        if search_result.reason in (SearchReason.CONVERGED, SearchReason.PATIENCE):
            over = zip(self.excess(search_result.values), self._list_limits(), strict=True)
            if not all(share <= limit.tolerance for share, limit in over):
                return replace(search_result, reason=SearchReason.LIMIT_PASSED)
        return search_result

    def excess(self, values: Any, samples: int = 200) -> tuple[float, ...]:
        """Largest excess of the motion over each `Limit`, in its shares; negative inside it."""
        if not (limits := self._list_limits()):
            return ()
        return tuple(map(float, _limit_excess(limits, self.motion(values, samples))))

    def _list_limits(self) -> tuple[Limit, ...]:
        every = self.residuals.cost.residuals  # pyright: ignore
        return tuple(residual for residual in every if isinstance(residual, Limit))

    def motion(self, values: Any, samples: int = 200) -> TunedMotion:
        """The motion under the inputs of a search, from its start without gaps."""
        edges, values = np.asarray(self.residuals.edges), values["values"]
        # the limits, the peaks and the figures of a solution ask for the same motion
        key = (samples, *(np.asarray(x).tobytes() for x in jax.tree.leaves(values)))
        if key not in self._motions:
            ts = np.linspace(edges[0], edges[-1], samples)
            path = self.residuals.motion(values, ts)
            # that of the start is compared with that of the solution: two are kept
            for oldest in list(self._motions)[:-1]:
                del self._motions[oldest]
            self._motions[key] = _observe_motion(self.residuals, values, as_floats(ts), path)
        return self._motions[key]


@quick_jit
def _observe_motion(
    problem: Shooting, values: Any, ts: Float[Array, " m"], path: Point
) -> TunedMotion:
    """The motion with all that residuals see of it."""
    return problem.cost.motion(values, ts, path, problem.system(values))  # pyright: ignore


@quick_jit
def _limit_excess(limits: tuple[Limit, ...], motion: TunedMotion) -> list[Array]:
    largest = lambda x: jnp.max(jnp.stack([jnp.max(leaf) for leaf in jax.tree.leaves(x)]))
    return [largest(limit.excess(motion)) for limit in limits]


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
    """Set up the search for inputs under which residuals of a motion are small.

    Args:
        space: state space of the mechanism. start: point at which the motion starts.
        residuals: functions of the motion (`TunedMotion`) -> numbers to be made small, any pytree.
        duration: length of the motion [s].
        inputs: inputs that are tuned, or their names; default all of the system.
        values: inputs at the start of the search (k,), or with knots also (knots, k); default those
            that the system has.
        sizes: changes of the inputs that count as one (k,); default the largest of their values, or
            one where these are zero.
        knots: number of knots of the splines, evenly spaced in time; None for constant inputs.
        segments: number of segments of multiple shooting. outputs_per_segment: output times in each.
        weight: weight of the gaps between segments.
        guess: function time [s] -> point at which a segment starts; default the start.
        name: name of the problem, for files.

    Raises:
        SettingError: a time that is not positive, too few knots or segments, no residuals, or an
            unknown input. ModelError: numbers of another shape.
    """
    check_finite(duration, "The time", "s")
    if not duration > 0:
        raise SettingError(f"The time must be positive, not {duration:g} s.")
    if segments < 1:
        raise SettingError(f"There must be at least one segment, not {segments}.")
    if knots is not None and knots < 4:
        raise SettingError(f"Cubic splines need four knots or more, not {knots}.")
    if not residuals:
        raise SettingError("Tuned inputs need at least one residual of the motion.")
    space.check(start, "The start of the motion")
    if not isinstance(inputs, Inputs):
        inputs = inputs_of(space.system, inputs)
    if not len(inputs):
        raise SettingError("The system has no inputs that could be tuned.")
    values = inputs.values(space.system) if values is None else values
    input_values: Any = as_numpy(as_floats(values))
    shape = (len(inputs),) if knots is None else (knots, len(inputs))
    if input_values.shape not in ((len(inputs),), shape):
        raise ModelError(
            f"The start of the inputs must have shape {shape}, not {input_values.shape}."
        )
    check_finite(input_values, "The start of the inputs", "")
    if sizes is None:
        xp = array_module(input_values)
        # Sizes bring forces and torques to order one, since a search takes steps of one size in all values.
        largest = xp.max(xp.abs(input_values.reshape(-1, len(inputs))), axis=0)
        sizes = xp.where(largest == 0, 1.0, largest)
    sizes = check_numbers(sizes, (len(inputs),), "The vector of the inputs' sizes", "")
    times = None if knots is None else tuple(float(t) for t in np.linspace(0.0, duration, knots))
    driven = _Driven(space, inputs, _Signals(sizes, times))
    problem = make_shooting(
        space, driven, _Cost(driven, tuple(residuals)), guess or (lambda _: start),
        np.linspace(0.0, duration, segments + 1), method, outputs_per_segment=outputs_per_segment, weight=weight,
    )  # fmt: skip
    xp, input_sizes = array_module(input_values, sizes), as_numpy(sizes)
    unknowns = as_floats(xp.broadcast_to(input_values, shape) / input_sizes)
    return InputTuning(name, problem, problem.unknowns(unknowns))


def tune_slew(
    space: AbstractStateSpace,
    start: Point,
    target: Point,
    duration: float,
    residuals: Sequence[Residual] = (),
    *,
    inputs: Inputs | Sequence[str] | None = None,
    values: Numbers | None = None,
    end_values: Numbers | None = None,
    path_sizes: Mapping[str, float] | None = None,
    end_sizes: Mapping[str, float] | None = None,
    knots: int = 8,
    **options: Any,
) -> InputTuning:
    """Set up the search for histories of inputs that move a mechanism from rest at a point to rest at another.

    They are cubic splines through knots. The search starts with inputs that go straight between those of
    the two points, and with segments on a smooth path between the points.

    Args:
        start, target: points of the state space. duration: length of the motion [s].
        residuals: further residuals, such as `roughness` and a `Limit`.
        values, end_values: inputs at start and target (k,), such as those of their trims; default those that
            the system has, and `values`.
        path_sizes: departures from the start that count as one, by the name of a state, root mean square over
            the motion; default none. end_sizes: errors at the end that count as one; default one in each unit.
        options: see `tune_inputs`.

    Raises:
        As `tune_inputs`.
    """
    if knots < 4:
        raise SettingError(f"Cubic splines need four knots or more, not {knots}.")
    inputs = inputs if isinstance(inputs, Inputs) else inputs_of(space.system, inputs)
    first = as_numpy(as_floats(inputs.values(space.system) if values is None else values))
    last = first if end_values is None else as_numpy(as_floats(end_values))
    share = np.linspace(0.0, 1.0, knots)[:, None]
    # The guess goes straight from start to target, on the space of the coordinates.
    way = space.difference(target, start)
    # places of the coordinates, whose rates follow them
    is_coordinate = np.arange(space.size) < space.dof

    def guess_point(t: float) -> Point:
        s = t / duration
        smooth = 10 * s**3 - 15 * s**4 + 6 * s**5
        rate = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
        v = jnp.where(is_coordinate, smooth * way, 0.0)
        moving = v.at[space.dof : 2 * space.dof].set(rate * way[: space.dof])
        return space.retract(start, moving)

    path_residuals = [] if path_sizes is None else [departures(space, start, path_sizes)]
    return tune_inputs(
        space, [*path_residuals, end_at(space, target, end_sizes), *residuals], start=start,
        duration=duration, inputs=inputs, values=(1 - share) * first + share * last, knots=knots,
        guess=guess_point, **options,
    )  # fmt: skip


def joint_forces(motion: TunedMotion) -> Float[Array, "m joints"]:
    """Size of the reaction force in every joint along a motion [N]."""
    tree, space, system = Tree(), motion.space, motion.system
    # Reactions need the multipliers, and a motion is computed without them: they are found afterwards.
    model = tree.prepare(system)

    def force_norms(t: Array, now: Point) -> Array:
        state = space.to_state(now, t)
        accelerations = tree.accelerations(model, t, state, Unstabilised())
        force = in_joint_axes(system, state, tree.reactions(model, t, state, accelerations)).force
        return jnp.sqrt(jnp.sum(force**2, axis=1))

    return jax.vmap(force_norms)(motion.ts, motion.points)
