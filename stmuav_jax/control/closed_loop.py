"""Run of a closed loop with its certificate."""

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import program
from ..algebra.rotation import conjugate, product, to_rotation_vector
from ..checks.errors import SettingError, SimulationError
from ..checks.numbers import numbers
from ..dynamics.certify import inspect_start
from ..dynamics.checks import check_start
from ..dynamics.conserved import energy
from ..dynamics.run import relative
from ..mechanics.state import State
from .instruments import whole_periods
from .plant import Plant
from .rolling import Controller, LoopReason, Rollout, Signals, rollout


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
        speed: time simulated per time of computing.
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
    position_difference: float | None
    angle_difference: float | None
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
        own = self.plant.inputs.chosen([name]).entries
        known = [entry.name for entry in self.plant.inputs.entries]
        found = np.asarray(self.rollout.inputs)[:, [known.index(entry.name) for entry in own]]
        return found[:, 0] if known.count(name) else found

    def signal(self, name: str) -> Any:
        """Saved signal (k, ...); raises `SettingError` if there is none of that name."""
        if name not in self.rollout.signals:
            known = ", ".join(self.rollout.signals) or "(none)"
            raise SettingError(f"There is no signal '{name}'. Saved signals: {known}.")
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
    end = numbers(t1, (), "The end of the run", "s", SettingError)
    samples = whole_periods(float(end), plant.rate, "The time of the run") + 1
    plant = inspected(plant)
    if balances:
        plant = plant.with_motion(plant.motion.with_method(balances=True))
    run = _Loop(controller, reference, memory, signals, samples)
    (found, total), *times = _carried_out(run, plant, key)
    compiling, running = times
    difference = _difference(run, plant, key, found) if check_steps else (None, None)
    certificate, failure = _certified(plant, found, total, (compiling, running), difference)
    result = LoopRun(plant, found, certificate, failure)
    if failure and throw:
        raise SimulationError(failure, result)
    return result


def run_of(plant: Plant, found: Rollout, seconds: tuple[float, float]) -> LoopRun:
    """Run with its certificate, from a plant and the samples of its loop, without energy balance.

    Args:
        plant: as `inspected` returns it. seconds: times of compiling and running [s].
    """
    certificate, failure = _certified(plant, found, np.zeros(0), seconds, (None, None))
    return LoopRun(plant, found, certificate, failure)


class _Loop(eqx.Module):
    """Parts of a closed loop other than its plant."""

    controller: Any
    reference: Any
    memory: Any
    signals: Mapping[str, Any] | None
    samples: int = eqx.field(static=True)


def _rolled(run: _Loop, plant: Plant, key: Any) -> tuple[Rollout, Float[Array, " k"]]:
    """Closed loop and its total energies (k,) [J]."""
    found = rollout(
        plant, run.controller, run.samples, reference=run.reference, memory=run.memory,
        signals=run.signals, start=plant.reset(key),
    )  # fmt: skip
    total = jnp.zeros_like(found.ts)
    if plant.motion.problem.method.balances:
        total = jax.vmap(lambda x, t: energy(plant.system, x, t).total)(found.states, found.ts)
    return found, total


def _carried_out(run: _Loop, plant: Plant, key: Any) -> tuple[Any, float, float]:
    """Result as NumPy arrays, and the times of compiling and running [s]."""
    clock = time.perf_counter()
    made = program(_rolled, run, plant, key)
    compiled = time.perf_counter()
    found = made(run, plant, key)
    taken = time.perf_counter() - compiled
    is_key = lambda x: jnp.issubdtype(getattr(x, "dtype", float), jax.dtypes.prng_key)
    found = jax.tree.map(lambda x: x if is_key(x) else np.asarray(x), found)
    return found, compiled - clock, taken


def inspected(plant: Plant) -> Plant:
    """Plant with a checked start, and a formulation that allows for rows that depend on others."""
    check_start(plant.system, plant.state0)
    own = plant.motion.problem.method.formulation
    formulation, *_ = inspect_start(plant.system, plant.state0, 0.0, own)
    if formulation is own:
        return plant
    return plant.with_motion(plant.motion.with_method(formulation=formulation))


def _difference(run: _Loop, plant: Plant, key: Any, first: Rollout) -> tuple[float, float]:
    """Largest differences in position [m] and attitude [rad] from a run with steps half as long."""
    if plant.motion.steps is None:
        raise SettingError("check_steps halves fixed steps; this plant's steps are adaptive.")
    finer = dataclasses.replace(plant.motion, steps=2 * plant.motion.steps)
    (again, _), *_ = _carried_out(run, plant.with_motion(finer), key)
    apart = jax.vmap(jax.vmap(lambda p, q: to_rotation_vector(product(conjugate(p), q))))
    turned = apart(jnp.asarray(first.states.p), jnp.asarray(again.states.p))
    largest = lambda x: float(np.max(np.linalg.norm(np.asarray(x), axis=-1)))
    return largest(first.states.r - again.states.r), largest(turned)


def _certified(
    plant: Plant,
    found: Rollout,
    total: np.ndarray,
    seconds: tuple[float, float],
    difference: tuple[float | None, float | None],
) -> tuple[LoopCertificate, str]:
    reason = np.asarray(found.reason)
    valid = int(np.argmax(reason != 0)) if np.any(reason) else len(reason)
    last = max(valid - 1, 0)
    failure = "" if valid == len(reason) else _failure(plant, found, valid)
    errors: tuple[float | None, float | None] = (None, None)
    if plant.motion.problem.method.balances:
        work = found.work[:valid]
        drift = total[:valid] - total[0] - work
        errors = float(np.max(np.abs(drift), initial=0.0)), relative(drift, total[:valid], work)
    worst, t_end = found.worst, float(found.ts[last])
    return LoopCertificate(
        result=LoopReason(int(reason[-1])).words if failure else "successful",
        t_end=t_end,
        position_violation=float(worst.position[last]),
        angle_violation=float(worst.angle[last]),
        velocity_violation=float(worst.velocity[last]),
        angular_velocity_violation=float(worst.angular_velocity[last]),
        norm_violation=float(worst.norm[last]),
        energy_error=errors[0],
        relative_energy_error=errors[1],
        position_difference=difference[0],
        angle_difference=difference[1],
        steps=int(found.counts.accepted[last]),
        rejected_steps=int(found.counts.rejected[last]),
        compile_seconds=seconds[0],
        run_seconds=seconds[1],
        speed=float(found.ts[-1] - found.ts[0]) / seconds[1],
    ), failure


def _failure(plant: Plant, found: Rollout, at: int) -> str:
    """Paragraph that says when and why a loop failed."""
    t, reason = float(found.ts[at]), LoopReason(int(found.reason[at]))
    k = int(found.element[at])
    when = f"at t = {t:.6g} s (sample {at})"
    if reason == LoopReason.INPUTS_NOT_FINITE:
        name, unit = plant.inputs.names[k]
        value = float(found.inputs[at, k])
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
