"""Simulation of a scene, which returns a `Run` with its certificate."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..checks.errors import SettingError, SimulationError
from ..mechanics.internal import with_internal
from ..mechanics.state import State
from ..mechanics.system import System
from .assembly.singular import singular_posture
from .certify import Checked, Start, certify, check_saved, inspect_start, violations
from .checks import check_method, check_start, output_times, scene_of
from .error_estimate import LOOSER, ErrorEstimate, SecondRun, estimated, without
from .evaluation import accelerations
from .integration.advance import Trajectory
from .integration.march import CHUNK, March, same_result
from .integration.problem import Problem, prepare
from .method import Method, described
from .run import Run, Seconds, saved
from .scene import Scene
from .stiffness import choose_solver

Progress = Callable[[float], None]


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
        method: method of integration; default `Method()`. If constraint rows depend on each other,
            the formulation is replaced by one that allows for them. The solver "auto" is chosen at
            the start. Three fields are for `integrate` alone, as nobody differentiates a `Run`:
            here `adjoint` is always `diffrax.ForwardMode()`, `steps` always "state", and
            `balances` is `analysis`.
        t1: end [s]; default the scene's.
        save_every: spacing of the saved times [s]; default the scene's, or a hundredth of the span
            for a system. No step is longer than the spacing, as a saved time ends a step.
        ts: saved times themselves instead of `save_every`, the first at the scene's t0.
        error_estimate: estimate the global error at every saved time by a second run at smaller
            tolerances, see `ErrorEstimate`. The second run takes 1.1 to 2 times as long as the
            first; it needs no further compilation.
        analysis: check energies, momenta and ranks at the saved times, and let the run compute its
            `snapshot`. Without it there is less to compile.
        certificate: "full" also looks at the rows of all joints at every saved time, and compares
            the accelerations with those by another formulation, which has to be compiled.
        throw: raise an error if the end was not reached; otherwise the run's certificate says so.
        progress: function that is called with the completed fraction.

    Returns:
        A `Run`. Ctrl-C ends it early with what was reached.

    Raises:
        SettingError: tolerances, span, saved times or kinds of arguments are invalid, or a full
            certificate is wanted without the analysis.
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
    method = dataclasses.replace(
        method,
        solver=_solver(scene, method),
        adjoint=diffrax.ForwardMode(),
        steps="state",
        balances=analysis,
    )
    wanted = _Wanted(error_estimate, analysis, certificate == "full")
    run, start = _carried_out(scene, method, times, progress, wanted)
    if run.successful or run.certificate.result == "interrupted":
        return run
    run = dataclasses.replace(run, failure=_failure(run, float(times[-1]), start))
    if throw:
        raise SimulationError(run.failure, run)
    return run


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
    wanted: _Wanted,
) -> tuple[Run, Start]:
    """Run with its certificate, complete or not, and what was found at its start."""
    clock = time.perf_counter()
    problem = prepare(scene.system, method)
    prepared = time.perf_counter() - clock
    how = method.formulation
    formulation, rows, start = inspect_start(scene.system, scene.state0, scene.t0, how)
    if formulation is not how:
        allowing = dataclasses.replace(problem.method, formulation=formulation)
        problem = dataclasses.replace(problem, method=allowing)
    looked = time.perf_counter() - clock - prepared
    done = _run(scene, problem, times, progress, wanted.estimate)
    clock = time.perf_counter()
    method = dataclasses.replace(method, formulation=problem.method.formulation)
    first = done.trajectory
    if wanted.analysis:
        checked = check_saved(problem, rows, start, first, wanted.full)
    else:
        worst = violations(rows.constraints, first, start.rows, start.norm)
        checked = Checked(None, None, None, worst, start.branches)
    errors = _errors(scene, problem, done, wanted.analysis)
    seconds = dataclasses.replace(
        done.seconds,
        compile=done.seconds.compile + prepared,
        analysis=looked + time.perf_counter() - clock,
    )
    result = done.stopped or _words(first)
    certificate = certify(scene.system, first, checked, errors, start.rank, result, seconds)
    model = problem.model if wanted.analysis else None
    run = Run(scene, method, first, model, errors, certificate, _settings(method))
    return run, start


def _solver(scene: Scene, method: Method) -> diffrax.AbstractSolver:
    """Solver of the method, or the choice of `choose_solver` at the start for "auto"."""
    if isinstance(method.solver, diffrax.AbstractSolver):
        return method.solver
    how = method.formulation
    return choose_solver(scene.system, scene.state0, scene.t0, formulation=how)


class _Done(NamedTuple):
    """Result of the integration: both runs, the times that they took, and the cause of a stop."""

    trajectory: Trajectory
    second: SecondRun | None
    seconds: Seconds
    stopped: str


def _run(
    scene: Scene, problem: Problem, times: np.ndarray, progress: Progress | None, estimate: bool
) -> _Done:
    """Integrate in chunks, with the second run following chunk by chunk."""
    clock = time.perf_counter()
    march = March(problem, times[0], scene.state0)
    second = SecondRun(problem, times[0], scene.state0) if estimate else None
    compiling = time.perf_counter() - clock
    running = [0.0, 0.0]
    stopped = ""
    try:
        for start in range(0, len(times), CHUNK):
            part = times[start : start + CHUNK]
            clock = time.perf_counter()
            reached = march.to(part)
            running[0] += time.perf_counter() - clock
            if second is not None:
                clock = time.perf_counter()
                second.follow(reached)
                running[1] += time.perf_counter() - clock
            if progress is not None:
                progress((start + len(part)) / len(times))
            if not march.going:
                break
    except KeyboardInterrupt:
        stopped = "interrupted"
    if not march.parts:
        raise KeyboardInterrupt
    joined = march.trajectory()
    # the initial state as given, not by way of the formulation's coordinates
    first = jax.tree.map(
        lambda x, y: np.r_[np.asarray(y)[None], x[1:]], joined.states, scene.state0
    )
    joined = eqx.tree_at(lambda found: found.states, joined, first)
    return _Done(joined, second, Seconds(compiling, *running), stopped)


def _errors(scene: Scene, problem: Problem, done: _Done, analysis: bool) -> ErrorEstimate:
    """Error estimate, by a run at larger tolerances if the second run has stopped early."""
    first, second = done.trajectory, done.second
    if second is None:
        return without(first, "none was asked for")
    rates = None
    happened = same_result(first.result, diffrax.RESULTS.event_occurred)
    if analysis and happened:
        # the second run's event is at another time, by which its end is moved
        last = jax.tree.map(lambda x: np.asarray(x)[-1:], saved(first))
        found = accelerations(problem.method.formulation, problem.model, last)
        rates = np.asarray(found.v_rate[0]), np.asarray(found.omega_rate[0])
    if done.stopped:
        return estimated(first, second, rates, "the run was interrupted")
    found = estimated(first, second, rates)
    if not found.note or happened:
        return found
    looser = SecondRun(second.first, float(first.ts[0]), scene.state0, factor=LOOSER)
    with contextlib.suppress(KeyboardInterrupt):
        looser.follow(first)
    again = estimated(first, looser, rates)
    return found if again.reached < found.reached else again


def _words(trajectory: Trajectory) -> str:
    names = (
        (diffrax.RESULTS.successful, "successful"),
        (diffrax.RESULTS.event_occurred, "event occurred"),
        (diffrax.RESULTS.max_steps_reached, "max_steps reached"),
        (diffrax.RESULTS.dt_min_reached, "step size collapsed"),
    )
    for code, words in names:
        if same_result(trajectory.result, code):
            return words
    return diffrax.RESULTS[trajectory.result].splitlines()[0]


def _settings(method: Method) -> dict[str, Any]:
    """Description of the method in words and numbers, as results keep it."""
    found = {
        "formulation": str(method.formulation),
        "solver": type(method.solver).__name__,
        "rtol": float(method.rtol),
        "atol": float(method.atol),
        "stabilisation": type(method.stabilisation).__name__,
        "max_steps_between_saved_times": method.max_steps,
    }
    usual = Method()
    if float(method.first_step) != float(usual.first_step):
        found["first_step"] = float(method.first_step)
    if np.isfinite(float(method.max_step)):
        found["max_step"] = float(method.max_step)
    if method.jump_ts is not None:
        found["jump_times"] = np.asarray(method.jump_ts).tolist()
    if not eqx.tree_equal(method.stabilisation, usual.stabilisation):
        found["stabilisation_settings"] = described(method.stabilisation)
    return found


def _failure(run: Run, end: float, start: Start) -> str:
    """Reason why a run stopped, in one paragraph."""
    t = run.certificate.t_end
    state = jax.tree.map(lambda x: jnp.asarray(x[-1]), run.states)
    reason = {
        "step size collapsed": (
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
    reason = start.branches or posture or reason
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
