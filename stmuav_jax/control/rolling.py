"""Closed loop of a plant and a controller as one pure function of JAX.

At each sample the controller reads the estimate and the reference and sets the inputs, which are
held until the next. A controller is any function

    (estimate, reference, memory) -> (inputs, memory).
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..checks.errors import SettingError
from ..checks.reason import AbstractReason, first_reason
from ..dynamics.formulations.base import Residuals
from ..dynamics.integration.problem import Counts
from ..mechanics.state import State
from .plant import Plant, PlantState, same_kind

Controller = Callable[[Any, Any, Any], tuple[Any, Any]]


class LoopReason(AbstractReason):
    """Outcome of a closed loop at a sample."""

    VALID = 0
    """Everything is finite so far."""
    STEP_FAILED = 1
    """The integration ended before the sample."""
    STATE_NOT_FINITE = 2
    """A number of the true state is NaN or infinite."""
    ESTIMATE_NOT_FINITE = 3
    """A number of the estimate is NaN or infinite."""
    INPUTS_NOT_FINITE = 4
    """The controller returned an input that is NaN or infinite."""


class Sample(NamedTuple):
    """Sample of a closed loop, for the signals that are saved.

    Attributes:
        t: time [s]. state: true state. internal: true states of force elements (z,).
        estimate, reference, memory: what the controller had, and its memory afterwards.
        inputs: what it returned (m,). applied: inputs that were held until this sample (m,).
        readings: readings by the sensor's name.
    """

    t: Float[Array, ""]
    state: State
    internal: Float[Array, " z"]
    estimate: Any
    reference: Any
    memory: Any
    inputs: Float[Array, " m"]
    applied: Float[Array, " m"]
    readings: dict[str, Any]


Signals = Mapping[str, Callable[[Sample], Any]]


class Rollout(eqx.Module):
    """Closed loop at its samples (k,), the first of which is the start.

    After a sample that is not valid, all numbers are NaN.

    Attributes:
        ts: times (k,) [s].
        states: true states of all bodies (k, n, .). internal: those of force elements (k, z).
        inputs: commands of the controller at each sample (k, m).
        signals: saved signals by name (k, ...).
        work: work of forces without potential since the start, inputs included (k,) [J]; zero for
            a method without `balances`.
        counts: numbers of steps so far, each (k,).
        worst: largest constraint residuals at any step so far, each (k,).
        reason: codes of `LoopReason` (k,); the first that is not zero stays.
        element: index of the first number that was not finite in state, estimate or inputs,
            counted through the whole of it (k,); -1 where there is none.
        end: state of the plant one period after the last sample. memory: the controller's.
    """

    ts: Float[Array, " k"]
    states: State
    internal: Float[Array, "k z"]
    inputs: Float[Array, "k m"]
    signals: dict[str, Any]
    work: Float[Array, " k"]
    counts: Counts
    worst: Residuals
    reason: Int[Array, " k"]
    element: Int[Array, " k"]
    end: PlantState
    memory: Any


def rollout(
    plant: Plant,
    controller: Controller,
    samples: int,
    *,
    reference: Any = None,
    memory: Any = None,
    signals: Signals | None = None,
    start: PlantState | None = None,
) -> Rollout:
    """Close the loop for a number of samples.

    The function is pure: it may be jitted, vmapped and differentiated; reverse derivatives keep the
    state at each sample and take its steps again. It raises no error for values: `Rollout.reason`
    says whether, when and why numbers stopped being finite.

    Args:
        samples: number of samples, the start included.
        reference: function of t [s] that returns what the controller reads as its reference, or
            that value itself.
        memory: the controller's first memory, any pytree of arrays.
        signals: functions of a `Sample` by the name under which their values are saved.
        start: state of the plant at the first sample; by default `plant.reset()`.

    Raises:
        SettingError: the controller returns another number of inputs, or its memory changes its
            structure or shapes; fewer than two samples.
    """
    if samples < 2:
        raise SettingError(f"A closed loop needs two samples or more, not {samples}.")
    begun = plant.reset() if start is None else start
    first = jax.tree.map(jnp.asarray, memory)
    at = reference if callable(reference) else lambda t: reference

    def one(carry: tuple[PlantState, Any, Any, Any], _: None) -> tuple[Any, Any]:
        now, kept, reason, element = carry
        wanted = at(now.t)
        returned = controller(now.estimate, wanted, kept)
        inputs, after = _checked(plant, returned, kept)
        found, place = _outcome(now, inputs)
        valid = reason == LoopReason.VALID
        seen = Sample(
            now.t, now.state, now.internal, now.estimate, wanted, after, inputs, now.applied,
            now.readings,
        )  # fmt: skip
        own = {name: signal(seen) for name, signal in (signals or {}).items()}
        numbers = (now.state, now.internal, inputs, own, plant.motion.work(now.motion.y))
        row = (
            now.t, jax.tree.map(lambda x: _or_nan(valid, x), numbers), now.motion.counts,
            now.motion.worst, jnp.where(valid, found, reason), jnp.where(valid, place, element),
        )  # fmt: skip
        return (plant.step(now, inputs), after, row[-2], row[-1]), row

    carry = (begun, first, jnp.zeros((), jnp.int8), jnp.full((), -1))
    body = jax.checkpoint(one, prevent_cse=False)  # pyright: ignore[reportPrivateImportUsage]
    (end, kept, *_), rows = jax.lax.scan(body, carry, length=samples)
    ts, (states, internal, inputs, own, work), counts, worst, reason, element = rows
    return Rollout(
        ts, states, internal, inputs, own, work, counts, worst, reason, element, end, kept
    )


def _checked(plant: Plant, returned: Any, before: Any) -> tuple[Float[Array, " m"], Any]:
    """Inputs and memory that a controller returned, in the types that the loop carries on."""
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise SettingError(
            "A controller must return a pair (inputs, memory), but it returned "
            f"{type(returned).__name__}."
        )
    given, after = returned
    names = [name for name, _ in plant.inputs.names]
    inputs = jnp.asarray(given, plant.before.dtype)
    if inputs.shape != (len(names),):
        raise SettingError(
            f"The controller must return {len(names)} inputs, an array of shape ({len(names)},) for "
            f"{', '.join(names)}, but it returned shape {inputs.shape}."
        )
    return inputs, same_kind(after, before, "The controller's memory")


def _outcome(now: PlantState, inputs: Array) -> tuple[Array, Array]:
    """Code of `LoopReason` at a sample, and the place of the first number that is not finite."""
    places = [_first_bad(part) for part in ((now.state, now.internal), now.estimate, inputs)]
    state, estimate, sent = (place >= 0 for place in places)
    ended = (now.motion.result != diffrax.RESULTS.successful) & ~state
    reason = first_reason(
        (ended, LoopReason.STEP_FAILED),
        (state, LoopReason.STATE_NOT_FINITE),
        (estimate, LoopReason.ESTIMATE_NOT_FINITE),
        (sent, LoopReason.INPUTS_NOT_FINITE),
    )
    place = jnp.where(state, places[0], jnp.where(estimate, places[1], places[2]))
    return reason, jnp.where(ended, -1, place)


def _first_bad(part: Any) -> Int[Array, ""]:
    """Index of the first number of a pytree that is not finite, through all leaves; -1 if none."""
    leaves = [x for x in jax.tree.leaves(part) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    if not leaves:
        return jnp.full((), -1)
    bad = ~jnp.isfinite(jnp.concatenate([jnp.ravel(x) for x in leaves]))
    return jnp.where(jnp.any(bad), jnp.argmax(bad), -1)


def _or_nan(valid: Array, x: Any) -> Any:
    """Value where the loop is still valid; NaN for a number and the value itself for others."""
    x = jnp.asarray(x)
    return jnp.where(valid, x, jnp.nan) if jnp.issubdtype(x.dtype, jnp.inexact) else x
