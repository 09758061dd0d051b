"""Sampled plant: a mechanism whose inputs are held from sample to sample, as a controller sees it.

    x_k+1 = motion over a period 1/rate from x_k with inputs u_(k-d) held,   d samples of delay

Between the samples the motion is continuous and integrated by the steps of a `Method`, which end at
the samples. `Plant.reset` and `Plant.step` are pure: they may be jitted, vmapped and
differentiated, by whoever closes the loop; `rollout` closes it with a controller.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..checks.errors import SettingError, concrete
from ..checks.numbers import numbers
from ..checks.shapes import Numbers
from ..dynamics.integration.problem import IntegrationState, begin, prepare
from ..dynamics.method import Method
from ..dynamics.scene import Scene
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from ..sensing.sensors import SensedMotion, gravity_of
from .held import HeldMotion, check_steps, usable_method
from .instruments import Bench, Reading, whole_periods

# Number that is folded into a key for the noise while standing; no sample of a run has it.
_STANDING = np.uint32(2**32 - 1)

Observe = Callable[[Float[Array, ""], State, Float[Array, " m"]], Any]
Estimator = Callable[[dict[str, Reading], Float[Array, " m"], Any], tuple[Any, Any]]


class PlantState(eqx.Module):
    """State of a plant at a sample; see `Plant.reset`.

    Attributes:
        k: number of the sample. t: its time [s]. t0: time of the first sample [s].
        state: true state of all bodies. internal: true states of force elements (z,).
        estimate: what a controller sees.
        applied: inputs that were held until this sample (m,).
        readings: readings by the sensor's name.
        motion: state of the integration.
        pending: inputs on their way, the next first (d, m).
        queues: readings on their way, by instrument.
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
            the machine is held at its start. The estimator so finds biases and pose before the
            loop is closed.
        sensors: sensors, or `Instrument`s with rates and noise.
        estimator: function (readings by name, inputs held until now, memory) -> (estimate,
            memory). Without one the estimate is the readings by name; without sensors either, it is
            what `observe` makes of the truth.
        memory: first memory of the estimator, any pytree of arrays.
        observe: function (t, state, internal states) -> estimate; by default the `State`.
        method: method of integration; by default the classical Runge-Kutta method of order 4 for
            fixed steps, Dopri8 for others. Its `steps` count where their length is not fixed.
        steps: steps in a period; None for steps whose length the method's tolerances choose.

    Raises:
        SettingError: rates or delays that do not divide; a rate or a number of steps that is not
            positive; fixed steps together with "auto" or an event; names of inputs that are unknown;
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
    late: int = eqx.field(static=True)
    stood: int = eqx.field(static=True)

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
    ) -> None:
        system = scene.system if isinstance(scene, Scene) else scene
        start = scene.state0 if isinstance(scene, Scene) and state is None else state
        self.state0 = system.reference if start is None else start
        check_state(system, self.state0)
        if not 0 < rate < float("inf"):
            raise SettingError(
                f"The control rate must be positive and finite, but it is {rate} Hz."
            )
        check_steps(steps)
        self.rate = float(rate)
        self.late = whole_periods(delay, rate, "The delay of the inputs")
        own = inputs_of(system, inputs)
        if not len(own):
            raise SettingError("The system has no inputs that a controller could set.")
        if before is None:
            self.before = own.values(system)
        else:
            what = "The vector of the inputs before the first command"
            self.before = numbers(before, (len(own),), what, "")
        problem = prepare(own.applied(system, self.before), usable_method(method, steps))
        self.motion = HeldMotion(problem, own, steps)
        self.bench = Bench(tuple(sensors), system, self.rate)
        if not 0 <= standing < float("inf"):
            raise SettingError(
                f"The time of standing must be finite and not negative, but it is {standing} s."
            )
        self.stood = whole_periods(standing, rate, "The time of standing")
        if self.stood:
            _check_standing(self.bench, self.state0)
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

    def with_motion(self, motion: HeldMotion) -> "Plant":
        """Plant whose motion is integrated in another way."""
        return eqx.tree_at(lambda plant: plant.motion, self, motion)

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
        motion = begin(self.motion.problem, t, self.state0 if state0 is None else state0)
        state, internal = self.motion.state(motion.y)
        k = jnp.zeros((), int)
        pending = jnp.tile(self.before, (self.late, 1))
        seen = self._seen(t, state, internal, self.before)
        if self.stood:
            assert seen is not None
            if state0 is not None:
                _check_standing(self.bench, state0)
            queues, estimate, memory = self._after_standing(t, state, internal, seen, key)
            readings = self.bench.arrived(queues)
        else:
            queues = self.bench.first(seen, self.system, key) if seen is not None else ()
            readings = self.bench.arrived(queues)
            estimate, memory = self._estimated(
                t, state, internal, readings, self.before, self.memory
            )
        return PlantState(
            k, t, t, state, internal, estimate, self.before, readings, motion, pending, queues,
            memory, key,
        )  # fmt: skip

    def step(self, now: PlantState, inputs: Float[Array, " m"]) -> PlantState:
        """State of the plant one period later, after a command (m,) at this sample."""
        queue = jnp.concatenate([now.pending, jnp.asarray(inputs, self.before.dtype)[None]])
        held, pending = queue[0], queue[1:]
        k = now.k + 1
        # times are counted in whole periods, so that round-off does not add up
        t = now.t0 + k / self.rate
        motion = self.motion.moved(now.motion, held, t)
        state, internal = self.motion.state(motion.y)
        seen = self._seen(t, state, internal, held)
        queues = now.queues
        if seen is not None:
            queues = self.bench.later(queues, seen, self.system, k, now.key)
        readings = self.bench.arrived(queues)
        estimate, memory = self._estimated(t, state, internal, readings, held, now.memory)
        return PlantState(
            k, t, now.t0, state, internal, estimate, held, readings, motion, pending, queues, memory,
            now.key,
        )  # fmt: skip

    def _after_standing(
        self, t: Array, state: State, internal: Array, seen: SensedMotion, key: Any
    ) -> tuple[tuple[Any, ...], Any, Any]:
        """Queues, estimate and memory at the first sample, after the samples of standing before it.

        At the first sample the machine is still held, and let go of right after it: its readings
        tell of the period before.
        """
        own, zero = jax.random.fold_in(key, _STANDING), jnp.zeros_like(state.v)
        still = seen._replace(v_rate=zero, omega_rate=zero)
        # a reading is fresh only where it is due, and so that those of sample 0 are
        queues = tuple(
            Reading(queue.value, jnp.zeros_like(queue.fresh))
            for queue in self.bench.first(still, self.system, key)
        )

        def one(carry: Any, k: Array) -> tuple[Any, None]:
            queues, _, memory = carry
            queues = self.bench.later(queues, still, self.system, k, own)
            readings = self.bench.arrived(queues)
            return (
                queues,
                *self._estimated(t, state, internal, readings, self.before, memory),
            ), None

        none = (queues, None, self.memory)
        kind = jax.eval_shape(lambda: one(none, jnp.zeros((), int))[0][1])
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), kind)
        ks = jnp.arange(-self.stood, 1)
        return jax.lax.scan(one, (queues, blank, self.memory), ks)[0]

    def _seen(
        self, t: Array, state: State, internal: Array, held: Float[Array, " m"]
    ) -> SensedMotion | None:
        """Motion for the sensors; accelerations are those just before the next command acts."""
        if not self.bench.instruments:
            return None
        system = self.system
        gravity, none = gravity_of(system), jnp.full_like(state.v, jnp.nan)
        kin = system.kinematics(state)
        if not self.bench.feels:
            return SensedMotion(kin, state.p, none, none, gravity)
        found = self.motion.accelerations(t, state, internal, held)
        return SensedMotion(kin, state.p, found.v_rate, found.omega_rate, gravity)

    def _estimated(
        self, t: Array, state: State, internal: Array, readings: Any, held: Array, memory: Any
    ) -> tuple[Any, Any]:
        if self.estimator is not None:
            estimate, after = self.estimator(readings, held, memory)
            return estimate, same_kind(after, memory, "The estimator's memory")
        if readings:
            return {name: reading.value for name, reading in readings.items()}, memory
        return (state if self.observe is None else self.observe(t, state, internal)), memory


def _check_standing(bench: Bench, start: State) -> None:
    """Raise `SettingError` for a plant that cannot stand before its first sample.

    A traced start is not checked.
    """
    if not bench.instruments:
        raise SettingError(
            "Nothing reads while the plant is standing, since it has no sensors: set 'standing' to 0."
        )
    if not concrete(start.v, start.omega):
        return
    # NumPy's, which stays concrete where something else is traced
    fastest = max(float(np.max(np.abs(np.asarray(x)), initial=0.0)) for x in (start.v, start.omega))
    if fastest > 0:
        raise SettingError(
            "The plant cannot stand before its first sample, because its start moves, with up to "
            f"{fastest:.4g} m/s or rad/s: set 'standing' to 0."
        )


def same_kind(after: Any, before: Any, what: str) -> Any:
    """New memory as arrays of the old one's types; `SettingError` for another structure or shape."""
    if jax.tree.structure(after) != jax.tree.structure(before):
        raise SettingError(
            f"{what} must keep its structure from sample to sample: it was "
            f"{jax.tree.structure(before)}, and {jax.tree.structure(after)} was returned."
        )
    for new, old in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        if jnp.shape(new) != jnp.shape(old):
            raise SettingError(
                f"{what} must keep the shapes of its arrays from sample to sample, but one of "
                f"shape {jnp.shape(old)} became {jnp.shape(new)}."
            )
    return jax.tree.map(lambda new, old: jnp.asarray(new, jnp.result_type(old)), after, before)
