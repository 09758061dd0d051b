"""Closed loop of a plant and a controller: as one pure function of JAX, and as a run with its certificate.

At each sample the controller reads the estimate and the reference and sets the inputs, which are
held until the next. A controller is any function

    (estimate, reference, memory) -> (inputs, memory).
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..checks.errors import (
    AbstractReason,
    SettingError,
    SimulationError,
    first_reason,
    nearest_names,
)
from ..checks.numbers import check_numbers
from ..dynamics.diagnostics import check_start, inspect_start, relative_error
from ..dynamics.evaluation import energy
from ..dynamics.formulations.base import Residuals
from ..dynamics.integration.problem import Counts
from ..math.compiler import cached_program
from ..math.native.program import evaluate
from ..math.rotation import conjugate, product, to_rotation_vector
from ..mechanics.state import State
from .instruments import whole_periods
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
        estimate, reference, memory: arguments of the controller, and its memory afterwards. inputs: its result
        (m,). applied, held_inputs: inputs that are held until this sample and from it
            on (m,), late by the plant's delay.
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
    held_inputs: Float[Array, " m"]
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

    The function is pure: it may be jitted, vmapped and differentiated; reverse derivatives store the state at
    each sample and recompute its steps. It raises no error for values: `Rollout.reason`
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
    initial_state = plant.reset() if start is None else start
    initial_memory = jax.tree.map(jnp.asarray, memory)
    # A constant reference is a function of time too, so that the loop has one form and compiles
    # once for both.
    reference_at = reference if callable(reference) else lambda t: reference

    def sample_loop(carry: tuple[PlantState, Any, Any, Any], _: None) -> tuple[Any, Any]:
        now, controller_memory, reason, element = carry
        setpoint = reference_at(now.t)
        returned = evaluate(controller, now.estimate, setpoint, controller_memory)
        inputs, next_memory = _check_returned(plant, returned, controller_memory)
        reason_code, place = _check_sample(now, inputs)
        # The first reason stays: later samples of a broken loop are left out and cannot replace it.
        valid = reason == LoopReason.VALID
        sample = Sample(
            now.t, now.state, now.internal, now.estimate, setpoint, next_memory, inputs, now.applied,
            now.pending[0] if plant.late else inputs, now.readings,
        )  # fmt: skip
        signal_values = {name: signal(sample) for name, signal in (signals or {}).items()}
        numbers = (now.state, now.internal, inputs, signal_values, plant.motion.work(now.motion.y))
        # After an invalid sample rows are NaN and not left as they are: a mean or a gradient over
        # a batch of loops cannot take them for results.
        is_number = lambda x: jnp.issubdtype(jnp.asarray(x).dtype, jnp.inexact)
        or_nan = lambda x: jnp.where(valid, x, jnp.nan) if is_number(x) else jnp.asarray(x)
        row = (
            now.t, jax.tree.map(or_nan, numbers), now.motion.counts,
            now.motion.worst, jnp.where(valid, reason_code, reason), jnp.where(valid, place, element),
        )  # fmt: skip
        return (plant.step(now, inputs), next_memory, row[-2], row[-1]), row

    carry = (initial_state, initial_memory, jnp.zeros((), jnp.int8), jnp.full((), -1))
    # Reverse mode keeps the carry of each sample and computes the rest again: memory grows with samples
    # and not with stages.
    body = jax.checkpoint(sample_loop, prevent_cse=False)  # pyright: ignore[reportPrivateImportUsage]
    # The loop runs to its end even after a failure: a batch of loops has one length, and those
    # that go on must not be ended by one that does not.
    (end, final_memory, *_), rows = jax.lax.scan(body, carry, length=samples)
    ts, (states, internal, inputs, signal_values, work), *rest = rows
    numbers = states, internal, inputs, signal_values, work, *rest
    return Rollout(ts, *numbers, end=end, memory=final_memory)


def _check_returned(plant: Plant, returned: Any, before: Any) -> tuple[Float[Array, " m"], Any]:
    """Inputs and memory that a controller returned, in the types that the loop carries on."""
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise SettingError(
            "A controller must return a pair (inputs, memory), but it returned "
            f"{type(returned).__name__}."
        )
    returned_inputs, next_memory = returned
    # Shapes are checked while the loop is traced: JAX's own error for a scan whose carry changes
    # its shape names neither the controller nor the input.
    names = [name for name, _ in plant.inputs.names]
    inputs = jnp.asarray(returned_inputs, plant.before.dtype)
    if inputs.shape != (len(names),):
        raise SettingError(
            f"The controller must return {len(names)} inputs, an array of shape ({len(names)},) for "
            f"{', '.join(names)}, but it returned shape {inputs.shape}. Where it sets only some of "
            "them, name these in Plant(..., inputs=[...]): the others keep their values."
        )
    # A loop of JAX carries arrays of fixed shapes; a mistake is told here in the user's words.
    return inputs, same_kind(next_memory, before, "The controller's memory")


def _check_sample(now: PlantState, inputs: Array) -> tuple[Array, Array]:
    """Code of `LoopReason` at a sample, and the place of the first number that is not finite."""
    # The order of the checks is that of cause and effect: a state that is not finite makes
    # estimate and inputs so, and the message is about the first of them.
    places = [_first_bad(part) for part in ((now.state, now.internal), now.estimate, inputs)]
    is_bad_state, is_bad_estimate, is_bad_input = (place >= 0 for place in places)
    # A state that is not finite is the cause and a failed step the consequence.
    is_step_failure = (now.motion.result != diffrax.RESULTS.successful) & ~is_bad_state
    reason = first_reason(
        (is_step_failure, LoopReason.STEP_FAILED),
        (is_bad_state, LoopReason.STATE_NOT_FINITE),
        (is_bad_estimate, LoopReason.ESTIMATE_NOT_FINITE),
        (is_bad_input, LoopReason.INPUTS_NOT_FINITE),
    )
    place = jnp.where(is_bad_state, places[0], jnp.where(is_bad_estimate, places[1], places[2]))
    return reason, jnp.where(is_step_failure, -1, place)


def _first_bad(part: Any) -> Int[Array, ""]:
    """Index of the first number of a pytree that is not finite, through all leaves; -1 if none."""
    leaves = [x for x in jax.tree.leaves(part) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    if not leaves:
        return jnp.full((), -1)
    bad_mask = ~jnp.isfinite(jnp.concatenate([jnp.ravel(x) for x in leaves]))
    return jnp.where(jnp.any(bad_mask), jnp.argmax(bad_mask), -1)


@dataclass(frozen=True)
class LoopCertificate:
    """Quality of a closed loop's run.

    Attributes:
        result: "successful", or the reason for the end. t_end: last time with valid numbers [s].
        position_violation, angle_violation: largest residual of constraints that are lengths [m],
            and of those that are cosines or angles [rad], over all steps.
        velocity_violation, angular_velocity_violation: those of their rates [m/s], [rad/s].
        norm_violation: largest | |p|^2 - 1 |.
        energy_error, relative_energy_error: largest |T + V - work - initial| [J], with the inputs'
            work, and its ratio to the largest energy; None where it was not computed.
        position_difference, angle_difference: largest difference over all bodies and samples from
            a second run with half as long steps [m], [rad]; None where there was none. The
            steps' own error is about 16/15 of it for a method of order 4.
        steps: number of steps that were taken. rejected_steps: of adaptive ones.
        compile_seconds, run_seconds: times of the loop.
        speed: simulated time divided by run time.
    """

    result: str
    t_end: float
    position_violation: float
    angle_violation: float
    velocity_violation: float
    angular_velocity_violation: float
    norm_violation: float
    energy_error: float | None
    relative_energy_error: float | None
    position_difference: float | None = field(default=None, kw_only=True)
    angle_difference: float | None = field(default=None, kw_only=True)
    steps: int
    rejected_steps: int
    compile_seconds: float
    run_seconds: float
    speed: float

    def to_dict(self) -> dict[str, Any]:
        """Certificate as plain numbers and strings, for JSON; NaN becomes None."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


@dataclass(frozen=True)
class LoopRun:
    """Run of a closed loop.

    Attributes:
        plant: plant. rollout: samples, NumPy arrays. certificate: summary of the run's quality.
        failure: reason for an early end, in one paragraph; empty if there was none.
    """

    plant: Plant
    rollout: Rollout
    certificate: LoopCertificate
    failure: str = ""

    @property
    def ts(self) -> np.ndarray:
        """Times of the samples (k,) [s]."""
        return np.asarray(self.rollout.ts)

    @property
    def states(self) -> State:
        """True states at the samples, arrays (k, n, .)."""
        return self.rollout.states

    @property
    def successful(self) -> bool:
        """True if all numbers are finite to the end."""
        return not self.failure

    def body(self, name: str) -> State:
        """States of one body, arrays (k, .)."""
        k = self.plant.system.index(name)
        return jax.tree.map(lambda x: np.asarray(x)[:, k], self.states)

    def input(self, name: str) -> np.ndarray:
        """Commands of one input, or of all numbers of a vector: (k,) or (k, numbers)."""
        inputs = self.plant.inputs
        names = [entry.name for entry in inputs.entries]
        places = [names.index(entry.name) for entry in inputs.chosen([name]).entries]
        commands = np.asarray(self.rollout.inputs)[:, places]
        return commands[:, 0] if name in names else commands

    def signal(self, name: str) -> Any:
        """Saved signal (k, ...); raises `SettingError` if there is none of that name."""
        if name not in self.rollout.signals:
            hint = nearest_names(name, self.rollout.signals)
            raise SettingError(f"The loop saved no signal '{name}'.{hint}")
        return self.rollout.signals[name]


def close_loop(
    plant: Plant,
    controller: Controller,
    t1: float,
    *,
    reference: Any = None,
    memory: Any = None,
    signals: Signals | None = None,
    key: Any = None,
    balances: bool = True,
    check_steps: bool = False,
    throw: bool = True,
) -> LoopRun:
    """Run a plant under a controller from its start at t = 0 to t1, and certify the run.

    Args:
        controller: function (estimate, reference, memory) -> (inputs, memory).
        t1: end [s], a whole number of control periods.
        reference, memory, signals: see `rollout`.
        key: random key of the sensors' noise; by default that of seed 0.
        balances: count the work of forces, for the energy balance; it lengthens the run by about
            half.
        check_steps: run a second time with half as long steps, for the differences in the
            certificate; for fixed steps alone.
        throw: raise an error if numbers stop being finite; otherwise the run says so.

    Raises:
        SettingError: a t1 that is not a whole number of periods, or see `rollout`.
        StateError: the plant's start is not finite or not consistent with its joints.
        SimulationError: the loop failed (with `throw`); the message says when and which number,
            and the error's `run` holds the result so far.
    """
    # A run ends with a sample: a part of a period would need a program of its own.
    end = check_numbers(t1, (), "The end of the run", "s", SettingError)
    samples = whole_periods(float(end), plant.rate, "The time of the run") + 1
    # The start is checked once on concrete values, outside the compiled loop, where an error can
    # name joints and residuals.
    plant = inspect_plant(plant)
    if balances:
        if plant.changed:
            raise SettingError(
                "The energy balance needs constant parameters: set balances=False for a plant with 'changes'."
            )
        # Work is one more state of the integration; a loop that is not certified does not pay for
        # it.
        plant = plant.with_motions(lambda motion: motion.with_method(balances=True))
    run = _Loop(controller, reference, memory, signals, samples)
    # Compilation is timed apart, as speed against real time is a figure of the running loop.
    (loop_rollout, total), *seconds = _carried_out(run, plant, key)
    result = run_of(plant, loop_rollout, seconds, total)
    if check_steps:
        if plant.motion.steps is None:
            raise SettingError("check_steps halves fixed steps; this plant's steps are adaptive.")
        # Fixed steps have no error estimate; a run with half the step tells what they cost.
        finer = lambda motion: dataclasses.replace(motion, steps=2 * motion.steps)
        (finer_rollout, _), *_ = _carried_out(run, plant.with_motions(finer), key)
        states, others = (
            jax.tree.map(jnp.asarray, x.states) for x in (loop_rollout, finer_rollout)
        )
        turn = lambda p, q: to_rotation_vector(product(conjugate(p), q))
        turns = jax.vmap(jax.vmap(turn))(states.p, others.p)
        position, angle = (
            float(np.max(np.linalg.norm(np.asarray(x), axis=-1)))
            for x in (states.r - others.r, turns)
        )
        certificate = dataclasses.replace(
            result.certificate, position_difference=position, angle_difference=angle
        )
        result = dataclasses.replace(result, certificate=certificate)
    if result.failure and throw:
        raise SimulationError(result.failure, result)
    return result


def run_of(
    plant: Plant, samples: Rollout, seconds: Sequence[float], total: np.ndarray | None = None
) -> LoopRun:
    """Run with its certificate, from a plant and the samples of its loop.

    Args:
        plant: as `inspect_plant` returns it. seconds: times of compiling and running [s].
        total: total energies (k,) [J], for a plant with `balances`.
    """
    reason = np.asarray(samples.reason)
    # Only samples before the first failure count: residuals, steps and the time of the end are
    # those of the last valid one.
    valid = int(np.argmax(reason != 0)) if np.any(reason) else len(reason)
    last = max(valid - 1, 0)
    failure = "" if valid == len(reason) else _describe_failure(plant, samples, valid)
    energy_error, relative_energy_error = None, None
    if total is not None and plant.motion.problem.method.balances:
        work = samples.work[:valid]
        # Energy of a loop is not constant; its change must equal the work of all inputs.
        drift = total[:valid] - total[0] - work
        energy_error = float(np.max(np.abs(drift), initial=0.0))
        relative_energy_error = relative_error(drift, total[:valid], work)
    certificate = LoopCertificate(
        result=LoopReason(int(reason[-1])).label if failure else "successful",
        t_end=float(samples.ts[last]),
        **{f"{name}_violation": float(x[last]) for name, x in vars(samples.worst).items()},
        energy_error=energy_error,
        relative_energy_error=relative_energy_error,
        steps=int(samples.counts.accepted[last]),
        rejected_steps=int(samples.counts.rejected[last]),
        compile_seconds=seconds[0],
        run_seconds=seconds[1],
        speed=float(samples.ts[-1] - samples.ts[0]) / seconds[1],
    )
    return LoopRun(plant, samples, certificate, failure)


class _Loop(eqx.Module):
    """Parts of a closed loop other than its plant."""

    controller: Any
    reference: Any
    memory: Any
    signals: Mapping[str, Any] | None
    samples: int = eqx.field(static=True)


def _roll_out(run: _Loop, plant: Plant, key: Any) -> tuple[Rollout, Float[Array, " k"]]:
    """Closed loop and its total energies (k,) [J]."""
    loop_rollout = rollout(
        plant, run.controller, run.samples, reference=run.reference, memory=run.memory,
        signals=run.signals, start=plant.reset(key),
    )  # fmt: skip
    total_energy = lambda x, t: energy(plant.system, x, t).total
    if not plant.motion.problem.method.balances:
        return loop_rollout, jnp.zeros_like(loop_rollout.ts)
    return loop_rollout, jax.vmap(total_energy)(loop_rollout.states, loop_rollout.ts)


def _carried_out(run: _Loop, plant: Plant, key: Any) -> tuple[Any, float, float]:
    """Result as NumPy arrays, and the times of compiling and running [s]."""
    clock = time.perf_counter()
    # The compiled program is called directly, so that the second time is that of running alone;
    # `jax.jit` would count its dispatch and, at the first call, its compilation.
    executable = cached_program(_roll_out, run, plant, key)
    compiled = time.perf_counter()
    loop_output = executable(run, plant, key)
    run_seconds = time.perf_counter() - compiled
    is_key = lambda x: jnp.issubdtype(getattr(x, "dtype", float), jax.dtypes.prng_key)
    # Results become NumPy arrays here: the timer then includes the wait for JAX's asynchronous
    # computation, and what reads the run compiles nothing.
    loop_output = jax.tree.map(lambda x: x if is_key(x) else np.asarray(x), loop_output)
    return loop_output, compiled - clock, run_seconds


def inspect_plant(plant: Plant) -> Plant:
    """Plant with a checked start, and a formulation that allows for rows that depend on others."""
    check_start(plant.system, plant.state0)
    method_formulation = plant.motion.problem.method.formulation
    formulation, *_ = inspect_start(plant.system, plant.state0, 0.0, method_formulation)
    if formulation is method_formulation:
        return plant
    return plant.with_motions(lambda motion: motion.with_method(formulation=formulation))


def _describe_failure(plant: Plant, loop_rollout: Rollout, at: int) -> str:
    """Paragraph that says when and why a loop failed."""
    t, reason = float(loop_rollout.ts[at]), LoopReason(int(loop_rollout.reason[at]))
    k = int(loop_rollout.element[at])
    # The message says what was still finite, since that tells a user whether to look at the
    # controller, the estimator or the plant.
    when = f"at t = {t:.6g} s (sample {at})"
    if reason == LoopReason.INPUTS_NOT_FINITE:
        name, unit = plant.inputs.names[k]
        value = float(loop_rollout.inputs[at, k])
        return (
            f"The controller returned {value} for the input '{name}' [{unit}] (element {k}) {when}; "
            f"its estimate was finite."
        )
    if reason == LoopReason.ESTIMATE_NOT_FINITE:
        return (
            f"Number {k} of the estimate, counted through all of its arrays, was not finite {when}; "
            "the true state was finite."
        )
    if reason == LoopReason.STEP_FAILED:
        return (
            f"The integration ended before the sample {when}: no step was short enough for the "
            "method's tolerances, or its equations could not be solved."
        )
    return (
        f"The motion was no longer finite {when} (number {k} of the state), with finite inputs: the "
        "loop is unstable, or its steps are too long (see `steps` of the plant)."
    )
