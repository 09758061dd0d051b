"""Sampled plant: a mechanism whose inputs are constant between samples, for controllers.

    x_k+1 = motion over a period 1/rate from x_k with inputs u_(k-d) held,   d samples of delay

Between the samples the motion is continuous and integrated by the steps of a `Method`, which end at
the samples. `Plant.reset` and `Plant.step` are pure: they may be jitted, vmapped and
differentiated, by whoever closes the loop; `rollout` closes it with a controller."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..analysis.sensors import SensedMotion, gravity_of
from ..checks.errors import SettingError, has_values
from ..checks.numbers import check_numbers
from ..checks.shapes import Numbers
from ..dynamics.formulations.base import Accelerations
from ..dynamics.formulations.stabilisation import Unstabilised
from ..dynamics.integration.adjoint import DiscreteAdjoint
from ..dynamics.integration.problem import (
    IntegrationState,
    Problem,
    at_internal,
    begin_integration,
    continue_from,
    prepare_problem,
    read_end,
)
from ..dynamics.integration.solvers import RungeKutta4
from ..dynamics.method import Method
from ..dynamics.simulation import Scene
from ..math.native.program import evaluate
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .instruments import Bench, Reading, whole_periods


class HeldMotion(eqx.Module):
    """Motion over one control period.

    Attributes:
        problem: prepared problem of the integration, with plain numbers for the inputs.
        inputs: inputs that are held.
        steps: steps in a period; None for steps whose length the method's tolerances choose.
    """

    problem: Problem
    inputs: Inputs
    steps: int | None = eqx.field(static=True)

    def with_method(self, **changes: Any) -> "HeldMotion":
        """Motion by a method with other fields."""
        method = dataclasses.replace(self.problem.method, **changes)
        return dataclasses.replace(self, problem=dataclasses.replace(self.problem, method=method))

    def advance_to(
        self, now: IntegrationState, values: Float[Array, " m"], t1: Float[Array, ""]
    ) -> IntegrationState:
        """State of the integration at t1 [s], the inputs held at values (m,)."""
        problem = self._hold_inputs(values)
        # Steps of a fixed length have no loop of unknown length: they can be differentiated in
        # reverse and batched without waiting for the slowest.
        if self.steps is None:
            # A plant that has failed integrates over no time: the loop around it goes on, and each further
            # period costs nothing.
            is_running = now.result == diffrax.RESULTS.successful
            end = jnp.where(is_running, t1, now.t)
            return continue_from(now, read_end(problem.solve(now, end, problem.method.adjoint)))
        h, steps = (t1 - now.t) / self.steps, self.steps

        def step_once(carry: Any, j: Any) -> tuple[Any, None]:
            y, state, result = carry
            a, b = now.t + j * h, now.t + (j + 1) * h
            step_output = problem.take_step(a, b, y, state)
            # The first failure of a step is kept: a later step that happens to succeed starts from
            # numbers that mean nothing.
            is_successful = result == diffrax.RESULTS.successful
            result = diffrax.RESULTS.where(is_successful, step_output[4], result)
            return (step_output[0], step_output[3], result), None

        carry = (now.y, now.solver_state, now.result)
        if steps == 1:
            carry, _ = step_once(carry, 0)
        else:
            carry, _ = jax.lax.scan(step_once, carry, jnp.arange(steps))
        y, state, result = carry
        counts = dataclasses.replace(now.counts, accepted=now.counts.accepted + steps)
        return dataclasses.replace(now, t=t1, y=y, solver_state=state, counts=counts, result=result)

    def state(self, y: Float[Array, " n"]) -> tuple[State, Float[Array, " z"]]:
        """State of all bodies, and states of force elements."""
        problem = self.problem
        n, z = problem.n_state, problem.n_internal
        return evaluate(problem.method.formulation.to_state, problem.model, y[:n]), y[n : n + z]

    def work(self, y: Float[Array, " n"]) -> Float[Array, ""]:
        """Work of forces without potential since the start [J]; zero without `balances`."""
        problem = self.problem
        if not problem.method.balances:
            return jnp.zeros((), y.dtype)
        return y[problem.n_state + problem.n_internal]

    def accelerations(
        self, t: Array, state: State, internal: Array, values: Float[Array, " m"]
    ) -> Accelerations:
        """Accelerations of all bodies at values of the inputs (m,)."""
        problem = self._hold_inputs(values)
        model = at_internal(problem.model, internal) if problem.n_internal else problem.model
        return evaluate(problem.method.formulation.accelerations, model, t, state, Unstabilised())

    def _hold_inputs(self, values: Float[Array, " m"]) -> Problem:
        # Inputs are leaves of the prepared model: they are exchanged without preparing it again,
        # which is what makes a period cheap.
        system = self.inputs.applied(self.problem.model.system, values)
        return eqx.tree_at(lambda p: p.model.system, self.problem, system)


# Number that is folded into a key for the noise while standing; no sample of a run has it.
_STANDING = np.uint32(2**32 - 1)

Observe = Callable[[Float[Array, ""], State, Float[Array, " m"]], Any]
Estimator = Callable[[dict[str, Reading], Float[Array, " m"], Any], tuple[Any, Any]]


class PlantState(eqx.Module):
    """State of a plant at a sample; see `Plant.reset`.

    Attributes:
        k: number of the sample. t: its time [s]. t0: time of the first sample [s].
        state: true state of all bodies. internal: true states of force elements (z,).
        estimate: argument of a controller. applied: inputs that were held until this sample (m,).
        readings: readings by the sensor's name.
        motion: state of the integration.
        pending: delayed inputs, the next first (d, m).
        queues: delayed readings, by instrument.
        memory: memory of the estimator.
        key: random key of the noise.
    """

    k: Int[Array, ""]
    t: Float[Array, ""]
    t0: Float[Array, ""]
    state: State
    internal: Float[Array, " z"]
    estimate: Any
    applied: Float[Array, " m"]
    readings: dict[str, Reading]
    motion: IntegrationState
    pending: Float[Array, "d m"]
    queues: tuple[Any, ...]
    memory: Any
    key: Any


class Plant(eqx.Module):
    """Mechanism with held inputs, instruments and an estimator, sampled at the control rate.

    Its numbers are prepared once, when it is made: a plant with another mass is another `Plant`,
    which may be made inside `jax.jit`, `jax.vmap` or `jax.grad`.

    Args:
        scene: a scene; or a system, which then takes `state`.
        state: state at the start, on the joints; by default the scene's.
        rate: control periods per second [Hz].
        inputs: names of the inputs that the controller sets, see `stmuav_jax.inputs_of`; by default
            all of the system's.
        before: inputs that are held until the first command arrives (m,); by default the
            system's own values.
        delay: time from a sample to the effect of its command [s], whole periods.
        standing: time [s], whole periods, for which the instruments read before the first sample, while
            the machine is held at its start. The estimator thus estimates biases and pose before the loop is
            closed.
        sensors: sensors, or `Instrument`s with rates and noise.
        estimator: function (readings by name, inputs held until now, memory) -> (estimate,
            memory). Without one the estimate is the readings by name; without sensors either, it is `observe`
            of the true state.
        memory: first memory of the estimator, any pytree of arrays.
        observe: function (t, state, internal states) -> estimate; by default the `State`.
        method: method of integration; by default the classical Runge-Kutta method of order 4 for
            fixed steps, Dopri8 for others. Its `steps` count where their length is not fixed.
        steps: steps in a period; None for steps whose length the method's tolerances choose.
        changes: increasing times [s], and systems with other parameters that replace it from the first sample
            at each time on, such as the machine without a payload that it drops.

    Raises:
        SettingError: rates or delays that do not divide; a rate or a number of steps that is not
            positive; times of changes that do not increase; fixed steps together with "auto" or an event;
            names of inputs that are unknown;
            a time of standing that is negative, without sensors, or of a machine whose start moves.
        ModelError: values before the first command that do not fit the inputs.
    """

    motion: HeldMotion
    state0: State
    before: Float[Array, " m"]
    bench: Bench
    estimator: Estimator | None
    memory: Any
    observe: Observe | None
    rate: float = eqx.field(static=True)
    changed: tuple[HeldMotion, ...]
    late: int = eqx.field(static=True)
    stood: int = eqx.field(static=True)
    starts: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene | System,
        state: State | None = None,
        *,
        rate: float = 400.0,
        inputs: Sequence[str] | None = None,
        before: Numbers | None = None,
        delay: float = 0.0,
        standing: float = 0.0,
        sensors: Sequence[Any] = (),
        estimator: Estimator | None = None,
        memory: Any = None,
        observe: Observe | None = None,
        method: Method | None = None,
        steps: int | None = 1,
        changes: Sequence[tuple[float, System]] = (),
    ) -> None:
        system = scene.system if isinstance(scene, Scene) else scene
        start = scene.state0 if isinstance(scene, Scene) and state is None else state
        self.state0 = system.reference if start is None else start
        check_state(system, self.state0)
        if not 0 < rate < float("inf"):
            raise SettingError(
                f"The control rate must be positive and finite, but it is {rate} Hz."
            )
        if steps is not None and (isinstance(steps, bool) or steps != int(steps) or steps < 1):
            raise SettingError(
                f"The number of steps in a period must be a whole number from 1, or None for steps that "
                f"the method's tolerances choose, but it is {steps}."
            )
        self.rate = float(rate)
        # Delays in whole periods leave the inputs constant within a period, so that steps need no break in
        # between.
        self.late = whole_periods(delay, rate, "The delay of the inputs")
        # A plant is made for a set of inputs; all others keep the values of the system, and a
        # controller's vector has the order of these.
        plant_inputs = inputs_of(system, inputs)
        if not len(plant_inputs):
            raise SettingError("The system has no inputs that a controller could set.")
        if before is None:
            self.before = plant_inputs.values(system)
        else:
            quantity = "The vector of the inputs before the first command"
            self.before = check_numbers(before, (len(plant_inputs),), quantity, "")
        if method is None:
            method = Method(solver=diffrax.Dopri8() if steps is None else RungeKutta4())
        if method.event is not None or method.jump_ts is not None:
            raise SettingError("A plant's method can have neither an event nor times of jumps.")
        if isinstance(method.adjoint, DiscreteAdjoint):
            # The discrete adjoint records steps in arrays of a known length, which a loop over samples does not
            # have.
            adjoint = diffrax.RecursiveCheckpointAdjoint()
            method = dataclasses.replace(method, adjoint=adjoint)
        if steps is not None:
            # The bound on steps for derivatives acts on the control of step sizes, which fixed steps do
            # not have.
            method = dataclasses.replace(method, steps="state")
        # The system is prepared once, and a period only exchanges the inputs' numbers.
        prepared = lambda system: HeldMotion(
            prepare_problem(plant_inputs.applied(system, self.before), method), plant_inputs, steps
        )
        self.motion = prepared(system)
        self.starts = tuple(math.ceil(at * rate * (1 - 1e-12)) for at, _ in changes)
        if any(after <= first for first, after in itertools.pairwise((0, *self.starts))):
            raise SettingError(
                "The times of a plant's changes must increase by whole control periods from the start on, but they are "
                f"{[float(at) for at, _ in changes]} s."
            )
        # Each change is prepared like the first system: they share a structure, so that a sample
        # picks numbers and no branch is compiled.
        self.changed = tuple(prepared(other) for _, other in changes)
        self.bench = Bench(tuple(sensors), system, self.rate)
        if not 0 <= standing < float("inf"):
            raise SettingError(
                f"The time of standing must be finite and not negative, but it is {standing} s."
            )
        self.stood = whole_periods(standing, rate, "The time of standing")
        if self.stood:
            if not self.bench.instruments:
                raise SettingError(
                    "'standing' must be 0 for a plant without sensors, because it has no readings to align with."
                )
            _check_rest(self.state0)
        self.estimator, self.observe = estimator, observe
        self.memory = jax.tree.map(jnp.asarray, memory)

    @property
    def system(self) -> System:
        """System as it was prepared, with the inputs before the first command."""
        return self.motion.problem.model.system

    @property
    def inputs(self) -> Inputs:
        """Inputs that the controller sets, in the order of its vector."""
        return self.motion.inputs

    def with_motions(self, change: Callable[[HeldMotion], HeldMotion]) -> "Plant":
        """Plant whose motion is integrated in another way."""
        motions = change(self.motion), tuple(map(change, self.changed))
        return eqx.tree_at(lambda plant: (plant.motion, plant.changed), self, motions)

    def motion_at(self, k: Int[Array, ""]) -> HeldMotion:
        """Motion from sample k on, with the numbers of the last change."""
        motion = self.motion
        for start, other in zip(self.starts, self.changed, strict=True):
            pick = lambda old, new, late=k >= start: (
                jnp.where(late, new, old) if eqx.is_array(new) else old
            )
            # A choice between numbers and not between programs: systems before and after a change
            # have the same joints and forces with other masses.
            motion = jax.tree.map(pick, motion, other)
        return motion

    def reset(self, key: Any = None, state0: State | None = None, t0: Numbers = 0.0) -> PlantState:
        """State of the plant at its first sample.

        Args:
            key: random key of the sensors' noise; by default that of seed 0.
            state0: another start than the plant's own, on the joints. t0: its time [s].

        Raises:
            SettingError: a plant that stands first, and another start that moves.
        """
        key = jax.random.key(0) if key is None else key
        t = jnp.asarray(t0, dtype=float)
        start = self.state0 if state0 is None else state0
        motion = begin_integration(self.motion.problem, t, start)
        state, internal = self.motion.state(motion.y)
        # The first sample is complete, with readings and an estimate: a controller acts at t = 0,
        # and not one period later.
        k = jnp.zeros((), int)
        # Until the first command arrives, the inputs are those before the flight.
        pending = jnp.tile(self.before, (self.late, 1))
        sensed_motion = self._sense_motion(self.motion, t, state, internal, self.before)
        if self.stood:
            assert sensed_motion is not None
            if state0 is not None:
                _check_rest(state0)
            queues, estimate, memory = self._after_standing(t, state, internal, sensed_motion, key)
            readings = self.bench.oldest_readings(queues)
        else:
            fill = self.bench.fill_queues
            queues = () if sensed_motion is None else fill(sensed_motion, self.system, key)
            readings = self.bench.oldest_readings(queues)
            estimate, memory = self._estimate_state(
                t, state, internal, readings, self.before, self.memory
            )
        return PlantState(
            k, t, t, state, internal, estimate, self.before, readings, motion, pending, queues,
            memory, key,
        )  # fmt: skip

    def step(self, now: PlantState, inputs: Float[Array, " m"]) -> PlantState:
        """State of the plant one period later, after a command (m,) at this sample."""
        queue = jnp.concatenate([now.pending, jnp.asarray(inputs, self.before.dtype)[None]])
        # A delay of whole periods is a queue: commands wait in it, and the oldest one acts.
        held_inputs, pending = queue[0], queue[1:]
        k = now.k + 1
        # times are counted in whole periods, so that round-off does not add up
        t = now.t0 + k / self.rate
        held_motion = self.motion_at(now.k)
        motion = held_motion.advance_to(now.motion, held_inputs, t)
        state, internal = held_motion.state(motion.y)
        sensed_motion = self._sense_motion(held_motion, t, state, internal, held_inputs)
        queues = now.queues
        if sensed_motion is not None:
            # The noise of a sample depends on the key and the sample's number alone: a loop that
            # is run again, or taken in parts, has the same readings.
            queues = self.bench.advance_queues(queues, sensed_motion, self.system, k, now.key)
        readings = self.bench.oldest_readings(queues)
        estimate, memory = self._estimate_state(
            t, state, internal, readings, held_inputs, now.memory
        )
        return PlantState(
            k, t, now.t0, state, internal, estimate, held_inputs, readings, motion, pending, queues, memory,
            now.key,
        )  # fmt: skip

    def _after_standing(
        self, t: Array, state: State, internal: Array, sensed_motion: SensedMotion, key: Any
    ) -> tuple[tuple[Any, ...], Any, Any]:
        """Queues, estimate and memory at the first sample, after the samples of standing before it.

        At the first sample the machine is still held, and let go of right after it: its readings
        tell of the period before.
        """
        # A key of its own: the noise of the flight is the same with and without a time of standing.
        standing_key, zero = jax.random.fold_in(key, _STANDING), jnp.zeros_like(state.v)
        # While it is held, the machine does not accelerate, although its forces would: the
        # accelerometer reads gravity alone.
        rest_motion = sensed_motion._replace(v_rate=zero, omega_rate=zero)
        # a reading is fresh only where it is due, and so that those of sample 0 are
        queues = tuple(
            Reading(queue.value, jnp.zeros_like(queue.fresh))
            for queue in self.bench.fill_queues(rest_motion, self.system, key)
        )

        def sample_once(carry: Any, k: Array) -> tuple[Any, None]:
            queues, _, memory = carry
            queues = self.bench.advance_queues(queues, rest_motion, self.system, k, standing_key)
            readings = self.bench.oldest_readings(queues)
            return (
                queues,
                *self._estimate_state(t, state, internal, readings, self.before, memory),
            ), None

        none = (queues, None, self.memory)
        # A scan needs the shapes of an estimate before there is one; they are found without
        # computing it.
        kind = jax.eval_shape(lambda: sample_once(none, jnp.zeros((), int))[0][1])
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), kind)
        ks = jnp.arange(-self.stood, 1)
        return jax.lax.scan(sample_once, (queues, blank, self.memory), ks)[0]

    def _sense_motion(
        self, motion: HeldMotion, t: Array, state: State, internal: Array, held_inputs: Array
    ) -> SensedMotion | None:
        """Motion for the sensors; accelerations are those just before the next command acts."""
        if not self.bench.instruments:
            return None
        system = self.system
        gravity, none = gravity_of(system), jnp.full_like(state.v, jnp.nan)
        kin = system.kinematics(state)
        # Accelerations cost one evaluation of the equations of motion in every period; most
        # sensors read positions and velocities only.
        if not self.bench.feels:
            # Accelerations that no sensor reads are NaN: one that should have asked for them shows it at once.
            return SensedMotion(kin, state.p, none, none, gravity)
        accelerations = motion.accelerations(t, state, internal, held_inputs)
        return SensedMotion(kin, state.p, accelerations.v_rate, accelerations.omega_rate, gravity)

    def _estimate_state(
        self,
        t: Array,
        state: State,
        internal: Array,
        readings: Any,
        held_inputs: Array,
        memory: Any,
    ) -> tuple[Any, Any]:
        if self.estimator is not None:
            estimate, next_memory = evaluate(self.estimator, readings, held_inputs, memory)
            return estimate, same_kind(next_memory, memory, "The estimator's memory")
        if readings:
            # Without an estimator the controller sees the readings; without sensors, the true state.
            return {name: reading.value for name, reading in readings.items()}, memory
        return (state if self.observe is None else self.observe(t, state, internal)), memory


def _check_rest(start: State) -> None:
    """Raise `SettingError` for a start that moves before its first sample; a traced one is not checked."""
    if not has_values(start.v, start.omega):
        return
    # NumPy's, which stays concrete where something else is traced
    fastest = max(float(np.max(np.abs(np.asarray(x)), initial=0.0)) for x in (start.v, start.omega))
    if fastest > 0:
        raise SettingError(
            "The plant cannot be held before its first sample, because its start moves, with up to "
            f"{fastest:.4g} m/s or rad/s: set 'standing' to 0."
        )


def same_kind(after: Any, before: Any, subject: str) -> Any:
    """New memory as arrays of the old one's types; `SettingError` for another structure or shape."""
    old_structure, structure = jax.tree.structure(before), jax.tree.structure(after)
    if structure != old_structure:
        raise SettingError(
            f"{subject} must keep its structure from sample to sample: it was {old_structure}, and "
            f"{structure} was returned."
        )
    for new, old in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        if jnp.shape(new) != jnp.shape(old):
            raise SettingError(
                f"{subject} must keep the shapes of its arrays from sample to sample, but one of "
                f"shape {jnp.shape(old)} became {jnp.shape(new)}."
            )
    return jax.tree.map(lambda new, old: jnp.asarray(new, jnp.result_type(old)), after, before)
