"""Scenes and runs: `integrate`, the pure function, and `simulate`, which checks and certifies a `Run`."""

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import nondifferentiable_backward
from jaxtyping import Array, Float

from ..checks.errors import ModelError, SettingError, SimulationError, has_values, nearest_names
from ..checks.numbers import as_jax, increasing_times
from ..checks.shapes import Numbers
from ..math.compiler import kept_jit
from ..math.native.program import describe_code
from ..mechanics.body import check_bodies
from ..mechanics.internal import counted_hinges, with_internal
from ..mechanics.joint_states import JointMotion, coordinates_of, joint_motion
from ..mechanics.state import State
from ..mechanics.system import System, check_state, moved_centres
from .assembly.singular import describe_driver_jump, describe_half_turn, singular_posture
from .diagnostics import (
    LOOSER,
    Certificate,
    Checked,
    ErrorEstimate,
    SecondRun,
    Seconds,
    Start,
    check_saved,
    check_start,
    describe_open_joints,
    empty_estimate,
    estimate_error,
    inspect_start,
    largest_violations,
    make_certificate,
    saved_states,
)
from .evaluation import Snapshot, evaluate_accelerations, evaluate_snapshots
from .formulations.base import AbstractModel, count_left_out
from .formulations.independence import compare_clearance, find_extreme_bodies
from .integration.advance import CHUNK, March, Trajectory, integrate_path, same_result
from .integration.problem import (
    MASSES_REFUSED,
    Problem,
    at_internal,
    begin_integration,
    fit_first_step,
    prepare_problem,
)
from .method import Method, choose_solver, describe_part


class Frame(NamedTuple):
    """Frame of a link that is part of a body: position (3,) [m] and axes (3, 3) in the body's frame.

    Attributes:
        body: name of the body, or "ground".
    """

    body: str
    position: np.ndarray
    axes: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Complete description of a simulation's subject: system, initial state, span and notes.

    Attributes:
        name: short name, for files. title: one line, for people.
        system: bodies, joints, forces.
        state0: state at t0 that satisfies the joints (see `assemble`).
        t0, t1: time span [s]. save_every: spacing of the saved times [s].
        parameters: numbers from which the scene was built, by name: each a mapping with "value",
            "unit" and "source"; kept with the results.
        notes: facts that affect the interpretation of results, one sentence each.
        warnings: differences that change the motion from that of the source, such as a constraint that an
            import lost; `check` lists them as warnings.
        watch: names of the bodies that figures show.
        links_between: names of nearly massless bodies that an import placed between several joints of one body.
        sensors: instruments of the mechanism (`stmuav_jax.control.Instrument`) by name.
        frames: links without joints by name, with the body of which each is a part.
    """

    name: str
    title: str
    system: System
    state0: State
    t0: float = 0.0
    t1: float = 2.0
    save_every: float = 0.01
    parameters: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    watch: tuple[str, ...] = ()
    links_between: tuple[str, ...] = ()
    sensors: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    frames: Mapping[str, Frame] = field(default_factory=dict)

    def with_(
        self, *forces: Any, parameters: Mapping[str, Any] | None = None, **fields: Any
    ) -> "Scene":
        """Scene with additional forces, other parameters of its system, or other fields such as t1.

        Args:
            forces: as of `System.with_forces`. parameters: as of `System.with_parameters`; the frames of the
                bodies start as before. fields: fields of the scene.

        Raises:
            SettingError: an unknown field. ModelError: see `System.with_forces` and `System.with_parameters`.
        """
        # `dataclasses.replace` would raise a TypeError of Python for an unknown field, without the
        # nearest name.
        names = [entry.name for entry in dataclasses.fields(self)]
        for name in fields:
            if name not in names:
                raise SettingError(f"A scene has no field '{name}'.{nearest_names(name, names)}")
        scene = dataclasses.replace(self, **fields)
        system = scene.system.with_forces(*forces).with_parameters(parameters or {})
        # States hold centres of mass: with another centre the bodies' frames, and with them the
        # joints, would be displaced if the start stayed as it is.
        state0 = moved_centres(scene.state0, scene.system, system)
        return dataclasses.replace(scene, system=system, state0=state0)


# --- the pure function

AHEAD = (
    "A run with Method(adjoint=diffrax.ForwardMode()) cannot be differentiated in reverse mode: leave "
    "`adjoint` out for jax.grad, or use jax.jacfwd, also for derivatives of its own derivatives."
)


def integrate(
    system: System, state0: State, ts: Float[Array, " k"], method: Method | None = None
) -> Trajectory:
    """Integrate a system from state0 at ts[0] through the output times ts.

    The function is pure: it may be jitted, vmapped and differentiated. It assumes a consistent
    start (see `assemble`) and raises no error for values: `Trajectory.result` holds the outcome.
    `simulate` adds checks, progress and a certificate. Times that a failed run did not reach have
    NaN states and derivatives, so that a sum over runs reveals it. A run that ended at an event
    keeps the state there. With a mass or a principal moment of inertia that is not positive the motion
    does not start; `describe_result` gives the reason. A run whose joints separate by more than its tolerances
    and the size of the mechanism allow has the result
    `diffrax.RESULTS.nonlinear_divergence` and NaN from then on.

    Rows of closed loops that depend on others in every posture, as those of planar loops of hinges do,
    are left out, if the joints' geometry is known; masses, loads and the state may be traced.
    With traced geometry such a loop takes `Tree(redundant=True)`, which chooses rows in every step.

    Args:
        system: bodies, joints, forces.
        state0: state at ts[0], unbatched.
        ts: output times (k,) [s], beginning with the start. The motion goes from each to the next, also
            back in time; with the method's `jump_ts` or an event they must increase.
        method: method of integration; default `Method()`.

    Raises:
        SettingError: shapes or precision of the state do not fit the system, or known times are not
            finite or do not increase where they must.
    """
    check_state(system, state0)
    problem = prepare_problem(system, method if method is not None else Method())
    # Times may run backwards, as for the motion before a given state; jumps and events are sought
    # forwards only.
    ordered = problem.method.jump_ts is not None or problem.method.event is not None
    if has_values(ts) and not np.all(np.isfinite(np.asarray(ts, dtype=float))):
        raise SettingError("The output times ts must be a list of finite numbers.")
    if ordered and has_values(ts) and np.any(np.diff(np.asarray(ts)) < 0):
        raise SettingError(
            "The output times must increase with a method that has an event or times of jumps, but "
            f"they are {np.asarray(ts).tolist()} s."
        )
    ts = jnp.asarray(ts, dtype=state0.r.dtype)
    trajectory = _compiled_path(problem, state0, ts)
    # Reverse mode through a loop for forward mode fails deep inside of JAX; marked here, it fails
    # with a sentence that says what to do.
    if isinstance(problem.method.adjoint, diffrax.ForwardMode):
        return nondifferentiable_backward(trajectory, msg=AHEAD)
    return trajectory


def describe_result(system: System, path: Trajectory) -> str:
    """Outcome of one run of `integrate` as text: "successful" or the reason why it ended.

    Args:
        system: system of the run. path: its trajectory; of a batch, that of one member.
    """
    if same_result(path.result, MASSES_REFUSED):
        try:
            check_bodies(system.bodies)
        except ModelError as error:
            return str(error)
        return "A mass or a principal moment of inertia of the system is not positive."
    stopped = same_result(path.result, diffrax.RESULTS.dt_min_reached)
    jump = describe_driver_jump(system, float(path.ts[-1])) if stopped else ""
    if jump:
        return jump
    reasons = {
        "successful": "successful",
        "event_occurred": "event occurred",
        "max_steps_reached": "max_steps steps did not reach the next output time, or in reverse "
        "mode the last one",
        "dt_min_reached": "the step size fell to round-off",
        "nonfinite": "the value of the event is not a number",
        "nonlinear_divergence": "the joints have come open",
    }
    return _name_result(path, reasons)


def _name_result(path: Trajectory, names: Mapping[str, str]) -> str:
    """Text of a trajectory's result, by the name of the result in diffrax, or diffrax's own."""
    for name, text in names.items():
        if same_result(path.result, getattr(diffrax.RESULTS, name)):
            return text
    return diffrax.RESULTS[path.result].splitlines()[0]


def _mark_unreached(problem: Problem, trajectory: Trajectory, ts: Float[Array, " k"]) -> Trajectory:
    """Trajectory with NaN values and derivatives at times that a failed run did not reach."""
    is_successful = trajectory.result == diffrax.RESULTS.successful
    is_successful = is_successful | (trajectory.result == diffrax.RESULTS.event_occurred)
    # Decisions on values have no derivative: without the stop JAX would trace derivatives of all
    # residuals for them.
    missed = ~is_successful & (jax.lax.stop_gradient(trajectory.ts) != ts)
    # a traced time may be no number: nothing was reached there or after
    missed = missed | (jnp.cumsum(jnp.isnan(ts)) > 0)
    open_mask = problem.is_open(jax.lax.stop_gradient(trajectory.worst))
    missed = missed | open_mask
    diverged: Any = diffrax.RESULTS.nonlinear_divergence
    result = diffrax.RESULTS.where(is_successful & jnp.any(open_mask), diverged, trajectory.result)
    trajectory = eqx.tree_at(lambda path: path.result, trajectory, result)
    # multiplication also marks the derivatives
    factor = jnp.where(missed, jnp.nan, 1.0)
    mark = lambda x: x * factor.reshape(-1, *(1,) * (x.ndim - 1)).astype(x.dtype)
    where = lambda path: (path.states, path.work, path.impulse, path.internal)
    return eqx.tree_at(where, trajectory, jax.tree.map(mark, where(trajectory)))


def _integrate_path(problem: Problem, state0: State, ts: Float[Array, " k"]) -> Trajectory:
    # The default first step is made for seconds: a run of microseconds would step over its whole
    # span.
    problem = fit_first_step(problem, ts[-1] - ts[0])
    start = begin_integration(problem, ts[0], state0)
    return _mark_unreached(problem, integrate_path(problem, start, ts), ts)


# An eager call does not compile again for a system of the same structure.
_compiled_path = kept_jit(_integrate_path, optimised=True)


# --- runs

# Results of a run that reached the end of its span or an event, with closed joints.
SUCCESSFUL = ("successful", "event occurred")
_OUTCOMES = {
    "successful": "successful",
    "event_occurred": "event occurred",
    "max_steps_reached": "max_steps reached",
    "dt_min_reached": "the step size fell to round-off",
}


@dataclass(frozen=True)
class Run:
    """Simulated scene: its saved states, their analysis, and the certificate.

    Attributes:
        scene: simulated scene. method: method of the integration.
        trajectory: saved times, states, work, impulse (NumPy arrays).
        model: system prepared for the method's formulation, for the analysis of the saved states;
            None if it was left out.
        errors: estimated errors at the saved times.
        certificate: summary of the run's quality.
        settings: text that describes the method, saved with the results.
        failure: reason why the end was not reached, in one paragraph; empty if it was.
    """

    scene: Scene
    method: Method
    trajectory: Trajectory
    model: AbstractModel | None
    errors: ErrorEstimate
    certificate: Certificate
    settings: dict[str, Any]
    failure: str = ""

    @functools.cached_property
    def snapshot(self) -> Snapshot:
        """Accelerations, reactions, energies at the saved times, computed at first use.

        Raises:
            SettingError: the run was made with analysis=False.
        """
        if self.model is None:
            raise SettingError(
                "This run has no accelerations, reactions or energies: simulate it with analysis=True."
            )
        return evaluate_snapshots(
            self.method.formulation, self.model, saved_states(self.trajectory)
        )

    @property
    def ts(self) -> np.ndarray:
        """Saved times (k,) [s]."""
        return np.asarray(self.trajectory.ts)

    @property
    def states(self) -> State:
        """Saved states, arrays (k, n, .)."""
        return self.trajectory.states

    @property
    def successful(self) -> bool:
        """True if the end of the span, or an event, was reached, and the joints are closed."""
        return self.certificate.result in SUCCESSFUL

    def body(self, name: str) -> State:
        """Saved states of one body, arrays (k, .)."""
        k = self.scene.system.index(name)
        return jax.tree.map(lambda x: np.asarray(x)[:, k], self.states)

    def joint(self, name: str) -> JointMotion:
        """Coordinates and rates of one joint at the saved times, with continuous angles: `.angle`,
        `.displacement`, or `.coordinates` (k, c).

        The angle of a hinge starts in (-pi, pi], or from that of `with_start_angles`. Where a force
        depends on the angle, the run itself has counted its turns; see `joint_motion` for others.
        """
        system = self.scene.system
        motion = jax.tree.map(np.asarray, joint_motion(system, self.states, name, self.ts))
        # Turns that a force has integrated are exact even if two saved times are more than half a turn apart,
        # where unwrapping of saved angles would be ambiguous.
        hinges = counted_hinges(system)
        if name not in hinges:
            return motion
        counted = np.asarray(self.trajectory.internal)[:, hinges.index(name)]
        column = [word for word, _ in coordinates_of(motion.kind)].index("angle")
        values = np.array(motion.coordinates)
        values[:, column] += 2 * np.pi * np.round((counted - values[:, column]) / (2 * np.pi))
        return dataclasses.replace(motion, coordinates=values)


def states_at(run: Run, times: Numbers) -> State:
    """States of a run at any times within it, arrays (k, n, .).

    Each state is integrated from the last saved state before it with the run's own method; a
    polynomial between steps would be of lower order than the steps.

    Args:
        times: times (k,) [s], in any order.

    Raises:
        SettingError: a time is not finite or outside the run.
    """
    return interpolate_states(run, times)[0]


def interpolate_states(run: Run, times: Numbers) -> tuple[State, np.ndarray]:
    """States at any times as in `states_at`, and the actuator states of the forces (k, m)."""
    ts = np.atleast_1d(np.asarray(times, dtype=float))
    first, last = run.ts[0], run.ts[-1]
    inside = np.isfinite(ts) & (ts >= first) & (ts <= last)
    if not np.all(inside):
        raise SettingError(
            f"The run covers {first:g} s to {last:g} s, but a state at {ts[~inside][0]:g} s was requested."
        )
    # Starting from the last saved state keeps the accuracy of the run; a polynomial between steps is of
    # lower order, and of none where the step was cut short.
    before = np.searchsorted(run.ts, ts, side="right") - 1
    starts = jax.tree.map(
        lambda x: as_jax(np.asarray(x)[before]), (run.states, run.trajectory.internal)
    )
    method = dataclasses.replace(run.method, event=None)
    spans = as_jax(np.stack([run.ts[before], ts], axis=1))
    # Prepared outside the program: dependent rows of loops are found from known numbers alone.
    end_values = _end_states(prepare_problem(run.scene.system, method), starts, spans)
    return jax.tree.map(np.asarray, end_values)


@functools.partial(kept_jit, optimised=True)
def _end_states(
    problem: Problem, starts: tuple[State, Array], spans: Float[Array, "k 2"]
) -> tuple[State, Float[Array, "k m"]]:
    def end_state(start: tuple[tuple[State, Array], Array]) -> tuple[State, Array]:
        (state, z), span = start
        model = at_internal(problem.model, z)
        path = _integrate_path(eqx.tree_at(lambda p: p.model, problem, model), state, span)
        # a saved state is returned unchanged, not by way of the formulation's coordinates
        same = span[0] == span[1]
        path_values = (path.states, path.internal)
        return jax.tree.map(lambda x, y: jnp.where(same, y, x[-1]), path_values, (state, z))

    return jax.lax.map(end_state, (starts, spans))


# --- simulation

Progress = Callable[[float], None]

# A run ended where the rows that its equations hold become dependent if their smallest singular value is
# below this part of that at its start.
_LOST = 1e-2
# A run that stops names the bodies whose inertias differ by more than this.
_UNEQUAL = 1e8


# Number of intervals between saved times of a run that is given by its end alone.
_INTERVALS = 100
# More saved times than a machine's memory holds are a slip of units.
_MOST_TIMES = 1e7


def scene_of(
    mechanism: Scene | System, state: State | None, t1: float | None, every: float | None, ts: Any
) -> Scene:
    """Scene as given, or made of a system, its state and the given times."""
    if isinstance(mechanism, Scene):
        if state is not None:
            raise SettingError(
                "A scene has its own initial state: give a scene, or a system and a state."
            )
        return mechanism
    if not isinstance(mechanism, System):
        raise SettingError(
            f"simulate takes a Scene, or a System and a State, but it was given a {type(mechanism).__name__}."
        )
    if not isinstance(state, State):
        type_text = "none" if state is None else f"a {type(state).__name__}"
        raise SettingError(
            f"To simulate a system give its initial State, such as system.reference (given: {type_text})."
        )
    title = "System of " + ", ".join(mechanism.names)
    if ts is not None:
        times = increasing_times(ts, "The output times ts")
        return Scene("system", title, mechanism, state, times[0], times[-1])
    if t1 is None:
        raise SettingError("To simulate a system give the end t1 [s], or the saved times ts [s].")
    every = abs(float(t1)) / _INTERVALS if every is None else every
    return Scene("system", title, mechanism, state, 0.0, float(t1), every or 1.0)


def output_times(
    scene: Scene, t1: float | None, save_every: float | None, ts: Sequence[float] | Any
) -> np.ndarray:
    """Saved times (k,) [s], beginning with the scene's t0."""
    if ts is not None:
        times = increasing_times(ts, "The output times ts")
        if times[0] != scene.t0:
            raise SettingError(
                f"The first output time must be the scene's t0 = {scene.t0} s, not {times[0]} s."
            )
        return times
    end = float(scene.t1 if t1 is None else t1)
    every = float(scene.save_every if save_every is None else save_every)
    if not np.isfinite(end) or end < scene.t0:
        raise SettingError(f"The end t1 = {end} s must be finite and not before t0 = {scene.t0} s.")
    if not np.isfinite(every) or every <= 0:
        raise SettingError(f"save_every must be finite and positive, but it is {every} s.")
    if (end - scene.t0) / every > _MOST_TIMES:
        raise SettingError(
            f"save_every = {every:g} s gives {(end - scene.t0) / every:.3g} saved times from t0 = "
            f"{scene.t0:g} s to t1 = {end:g} s, but a run can have {_MOST_TIMES:.0e} of them."
        )
    # Round-off of a quotient such as 2 / 0.01 must not lose the last interval or add one of length zero.
    count = int(np.floor((end - scene.t0) / every * (1 + 1e-12)))
    times = scene.t0 + every * np.arange(count + 1)
    if end - times[-1] > 1e-9 * every:
        times = np.append(times, end)
    times[-1] = end if count else times[-1]
    return times


def check_method(method: Any) -> None:
    """Raise `SettingError` unless the method is a `Method` with an adaptive or automatic solver."""
    if not isinstance(method, Method):
        method_text = f"the class {method.__name__}" if isinstance(method, type) else repr(method)
        raise SettingError(f"method must be a Method(...), but it is {method_text:.80}.")
    if not isinstance(method.solver, str | diffrax.AbstractAdaptiveSolver):
        raise SettingError(
            f"{type(method.solver).__name__} has no error estimate and cannot adapt its steps; "
            "choose Dopri8, Tsit5 or kvaerno5, or wrap it in diffrax.HalfSolver."
        )


def simulate(
    scene: Scene | System,
    state: State | None = None,
    *,
    method: Method | None = None,
    t1: float | None = None,
    save_every: float | None = None,
    ts: Sequence[float] | np.ndarray | None = None,
    error_estimate: bool = True,
    analysis: bool = True,
    certificate: Literal["standard", "full"] = "standard",
    throw: bool = True,
    progress: Progress | None = None,
) -> Run:
    """Integrate a scene, or a system from a state, and certify the result.

    Args:
        scene: a scene; or a system, which then takes `state` and `t1` or `ts`.
        state: initial state of the system, at t = 0 or at ts[0].
        method: method of integration; default `Method()`. If constraint rows become dependent in the
            posture of the start, or in one that the run reaches and cannot pass, the formulation is
            replaced by one that allows for them. The solver "auto" is chosen at the start. Three
            fields are for `integrate` alone, because a `Run` has no derivatives: here `adjoint` is always
            `diffrax.ForwardMode()`, `steps` always "state", and `balances` is `analysis`.
        t1: end [s]; default the scene's.
        save_every: spacing of the saved times [s]; default the scene's, or a hundredth of the span
            for a system. No step is longer than the spacing, as a saved time ends a step.
        ts: saved times themselves instead of `save_every`, the first at the scene's t0.
        error_estimate: estimate the global error at every saved time by a second run at smaller
            tolerances, see `ErrorEstimate`. The second run takes 1.1 to 2 times as long as the
            first; it needs no further compilation.
        analysis: check energies, momenta and ranks at the saved times, and let the run compute its
            `snapshot`. Without it there is less to compile.
        certificate: "full" also checks the rows of all joints at every saved time, and compares
            the accelerations with those by another formulation, which has to be compiled.
        throw: raise an error if the end was not reached; otherwise the run's certificate says so.
        progress: function that is called with the completed fraction.

    Returns:
        A `Run`. Ctrl-C ends it early with the results so far.

    Raises:
        SettingError: tolerances, span, saved times or kinds of arguments are invalid, or a full certificate is
            requested without the analysis.
        StateError: the initial state is not finite, not unit or not consistent, or a singular posture
            at rest from which loads set the system in motion: its branch is not determined.
        ModelError: constraints are contradictory, or a load is not finite at the start.
        SimulationError: the end was not reached (with `throw`); its `run` holds the result so far.
    """
    if certificate not in ("standard", "full") or (certificate == "full" and not analysis):
        raise SettingError(
            'The certificate is "standard", or "full" with analysis=True, '
            f"but certificate={certificate!r} and analysis={analysis!r} were given."
        )
    scene = scene_of(scene, state, t1, save_every, ts)
    times = output_times(scene, t1, save_every, ts)
    method = Method() if method is None else method
    check_method(method)
    check_start(scene.system, scene.state0)
    # Derivatives of a run are for `integrate`: steps that are safe for them would cost a run that nobody
    # differentiates.
    method = dataclasses.replace(
        method,
        adjoint=diffrax.ForwardMode(),
        steps="state",
        balances=analysis,
    )
    run_options = _Wanted(error_estimate, analysis, certificate == "full")
    # Dependent rows are rarely known beforehand: the cheaper equations are tried first, and those that
    # choose rows anew only if the run stops at such a posture.
    outcome = _carried_out(scene, method, times, progress, run_options)
    if not outcome.run.successful and _selected_rows_fail(outcome):
        allowing = method.formulation.allowing_dependent_rows()
        changed = dataclasses.replace(method, formulation=allowing)
        second = _carried_out(scene, changed, times, progress, run_options)
        # A second attempt counts only if it came further; otherwise the first failure has the clearer reason.
        if second.run.successful or second.run.certificate.t_end > outcome.run.certificate.t_end:
            outcome = second
    run = outcome.run
    if run.successful or run.certificate.result == "interrupted":
        return run
    failure = _describe_failure(run, float(times[-1]), outcome.start, outcome.opened)
    run = dataclasses.replace(run, failure=failure)
    if throw:
        raise SimulationError(run.failure, run)
    return run


class _Outcome(NamedTuple):
    """Run with its problem, the findings at its start, and a text on joints that have separated."""

    run: Run
    problem: Problem
    start: Start
    opened: str


def _selected_rows_fail(outcome: _Outcome) -> bool:
    """True if a run stopped where rows that its equations select for all times become dependent."""
    model: Any = outcome.problem.model
    row_mask, formulation = getattr(model, "row_mask", None), outcome.problem.method.formulation
    # A run that stops for another reason, such as stiffness, would stop with the dearer equations
    # too: rows are selected again only where the selected ones have become dependent.
    stopped = outcome.run.certificate.result != "interrupted"
    if row_mask is None or not stopped or formulation.allowing_dependent_rows() is formulation:
        return False
    joints = getattr(getattr(model, "parameters", None), "tree", None)
    joints = None if joints is None else joints.cut
    system, states = outcome.run.scene.system, outcome.run.states
    return not compare_clearance(system, np.asarray(row_mask), states, joints) > _LOST


class _Wanted(NamedTuple):
    """Parts of a run that may be left out: error estimate, analysis, full certificate."""

    estimate: bool
    analysis: bool
    full: bool


def _carried_out(
    scene: Scene,
    method: Method,
    times: np.ndarray,
    progress: Progress | None,
    run_options: _Wanted,
) -> _Outcome:
    """Run with its certificate, complete or not."""
    clock = time.perf_counter()
    method_formulation = method.formulation
    # The start is examined before the integration is compiled, which takes most of the time: a bad
    # input is answered first.
    left_out = count_left_out(method_formulation.prepare(scene.system))
    formulation, rows, start = inspect_start(
        scene.system, scene.state0, scene.t0, method_formulation, left_out
    )
    method = dataclasses.replace(method, formulation=formulation)
    inspection_seconds = time.perf_counter() - clock
    clock = time.perf_counter()
    if isinstance(method.solver, str):
        solver = choose_solver(scene.system, scene.state0, scene.t0, formulation=formulation)
        method = dataclasses.replace(method, solver=solver)
    problem = fit_first_step(prepare_problem(scene.system, method), times[-1] - times[0])
    prepared = time.perf_counter() - clock
    integration = _run_chunks(scene, problem, times, progress, run_options.estimate)
    clock = time.perf_counter()
    first = integration.trajectory
    if run_options.analysis:
        checked = check_saved(problem, rows, start, first, run_options.full)
    else:
        worst = largest_violations(rows.constraints, first, start.rows, start.norm)
        checked = Checked(None, None, None, worst, start.branches)
    errors = _estimate_errors(scene, problem, integration, run_options.analysis)
    seconds = dataclasses.replace(
        integration.seconds,
        compile=integration.seconds.compile + prepared,
        analysis=inspection_seconds + time.perf_counter() - clock,
    )
    result = integration.stopped or _name_result(first, _OUTCOMES)
    opened = describe_open_joints(problem, rows, first, checked.worst)
    if opened and result in SUCCESSFUL:
        result = "constraints violated"
    certificate = make_certificate(
        scene.system, first, checked, errors, start.rank, result, seconds
    )
    model = problem.model if run_options.analysis else None
    run = Run(scene, method, first, model, errors, certificate, _describe_method(method))
    return _Outcome(run, problem, start, opened)


class _Done(NamedTuple):
    """Result of the integration: both runs, the times that they took, and the cause of a stop."""

    trajectory: Trajectory
    second: SecondRun | None
    seconds: Seconds
    stopped: str


def _run_chunks(
    scene: Scene, problem: Problem, times: np.ndarray, progress: Progress | None, estimate: bool
) -> _Done:
    """Integrate in chunks, with the second run following chunk by chunk."""
    clock = time.perf_counter()
    # Both runs share one compiled program, since tolerances are numbers of the problem: the second
    # costs its steps alone.
    march = March(problem, times[0], scene.state0)
    second = SecondRun(problem, times[0], scene.state0) if estimate else None
    compiling = time.perf_counter() - clock
    running = [0.0, 0.0]
    stopped = ""
    try:
        # Chunk by chunk and not one run after the other: an interrupted simulation has an error
        # estimate as far as it came.
        for start in range(0, len(times), CHUNK):
            part = times[start : start + CHUNK]
            clock = time.perf_counter()
            part_trajectory = march.to(part)
            running[0] += time.perf_counter() - clock
            if second is not None:
                clock = time.perf_counter()
                second.follow(part_trajectory)
                running[1] += time.perf_counter() - clock
            if progress is not None:
                progress((start + len(part)) / len(times))
            if not march.going:
                break
    except KeyboardInterrupt:
        stopped = "interrupted"
    # Nothing was reached yet, so there is no run to return: the interruption goes on to the
    # caller.
    if not march.parts:
        raise KeyboardInterrupt
    joined = march.trajectory()
    # the initial state as given, not by way of the formulation's coordinates
    first = jax.tree.map(
        lambda x, y: np.r_[np.asarray(y)[None], x[1:]], joined.states, scene.state0
    )
    joined = eqx.tree_at(lambda path: path.states, joined, first)
    return _Done(joined, second, Seconds(compiling, *running), stopped)


def _estimate_errors(
    scene: Scene, problem: Problem, integration: _Done, analysis: bool
) -> ErrorEstimate:
    """Error estimate, by a run at larger tolerances if the second run has stopped early."""
    first, second = integration.trajectory, integration.second
    if second is None:
        return empty_estimate(first, "none was requested")
    rates = None
    happened = same_result(first.result, diffrax.RESULTS.event_occurred)
    if analysis and happened:
        # the second run's event is at another time, by which its end is moved
        last = jax.tree.map(lambda x: np.asarray(x)[-1:], saved_states(first))
        result = evaluate_accelerations(problem.method.formulation, problem.model, last)
        rates = np.asarray(result.v_rate[0]), np.asarray(result.omega_rate[0])
    if integration.stopped:
        return estimate_error(first, second, rates, "the run was interrupted")
    result = estimate_error(first, second, rates)
    # An estimate is wanted for all that was reached. A run at larger tolerances passes where one
    # at smaller ones has stopped; of two estimates the one that reaches further is kept.
    if not result.note or happened:
        return result
    looser = SecondRun(second.first, float(first.ts[0]), scene.state0, factor=LOOSER)
    with contextlib.suppress(KeyboardInterrupt):
        looser.follow(first)
    looser_estimate = estimate_error(first, looser, rates)
    return result if looser_estimate.estimated_count < result.estimated_count else looser_estimate


def _describe_method(method: Method) -> dict[str, Any]:
    """Description of the method as text, saved with results."""
    settings = {
        "formulation": str(method.formulation),
        "solver": type(method.solver).__name__,
        "rtol": float(method.rtol),
        "atol": float(method.atol),
        "stabilisation": type(method.stabilisation).__name__,
        "max_steps_between_saved_times": method.max_steps,
        "equations_compiled_by": describe_code(),
    }
    # Settings in the results name what differs from the defaults, so that a reader sees at once
    # what was chosen.
    usual = Method()
    if float(method.first_step) != float(usual.first_step):
        settings["first_step"] = float(method.first_step)
    if np.isfinite(float(method.max_step)):
        settings["max_step"] = float(method.max_step)
    if method.jump_ts is not None:
        settings["jump_times"] = np.asarray(method.jump_ts).tolist()
    if not eqx.tree_equal(method.stabilisation, usual.stabilisation):
        settings["stabilisation_settings"] = describe_part(method.stabilisation)
    return settings


def _describe_failure(run: Run, end: float, start: Start, opened: str) -> str:
    """Reason why a run stopped, or is none of the mechanism's, in one paragraph.

    Args:
        opened: text on joints that have come open.
    """
    t = run.certificate.t_end
    state = jax.tree.map(lambda x: jnp.asarray(x[-1]), run.states)
    reason = {
        "the step size fell to round-off": (
            "the step size fell to round-off: the motion cannot be followed with these tolerances"
        ),
        "max_steps reached": (
            f"{run.method.max_steps} steps did not reach the next saved time: allow more "
            "(max_steps), save more often, or loosen the tolerances"
        ),
    }.get(run.certificate.result, run.certificate.result)
    event = run.method.event
    if event is not None and bool(jnp.any(jnp.isnan(jnp.asarray(event(jnp.asarray(t), state))))):
        reason = "the value of its event is not a number there"
    system = with_internal(run.scene.system, jnp.asarray(run.trajectory.internal[-1]))
    ends = jax.tree.map(lambda x: jnp.asarray(x)[np.array([0, -1])], run.states)
    posture = singular_posture(system, ends, t, start.rank.rank, start.followed)
    light, heavy, ratio = find_extreme_bodies(system)
    if ratio > _UNEQUAL:
        reason += (
            f". The inertias of the bodies '{light}' and '{heavy}' differ by {ratio:.1g}, which round-off "
            "and the steps of this method may not tolerate"
        )
    reason = opened or start.branches or posture or reason
    reason = describe_driver_jump(system, t) or describe_half_turn(system, state) or reason
    kin = system.kinematics(state)
    for force in system.forces:
        # a load may cease to be finite right after the last state at which it was
        for later in (0.0, 1e-12, 1e-9, 1e-6, 1e-4):
            load = force.load(jnp.asarray(t + later), kin)
            if not bool(jnp.all(jnp.isfinite(load.force)) & jnp.all(jnp.isfinite(load.moment))):
                reason = (
                    f"the load of {type(force).__name__} on {force.acts_on()} is not finite there"
                )
    return (
        f"The simulation of {run.scene.name} stopped at t = {t:.9g} s of {end:.9g} s: {reason}. "
        f"{run.certificate.accepted_steps} steps were accepted, {run.certificate.rejected_steps} "
        "rejected."
    )
