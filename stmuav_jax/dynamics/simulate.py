"""`simulate`: a scene in, a `Run` with its certificate out."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..mechanics.errors import ModelError, SimulationError
from ..mechanics.internal import internal_states, with_internal
from ..mechanics.state import State
from ..mechanics.system import System
from .accuracy import LOOSER, ErrorEstimate, SecondRun, estimated, without
from .analysis import Look, Snapshot, first_look, look, snapshots
from .augmented import Augmented, Model
from .certify import certify, violations
from .checks import (
    check_consistent,
    check_loads,
    check_parts,
    check_settings,
    check_start,
    output_times,
    scene_of,
)
from .formulation import AbstractFormulation
from .initial import Rank, rank_of, singular_posture
from .integrate import Trajectory
from .march import CHUNK, March
from .problem import Event, Method, prepare
from .run import Run, Seconds
from .scene import Scene
from .stabilisation import AbstractStabilisation, Projection
from .stiffness import choose_solver
from .tree import Tree

Progress = Callable[[float], None]


def simulate(
    scene: Scene | System,
    state: State | None = None,
    *,
    formulation: AbstractFormulation | str | type | None = None,
    solver: diffrax.AbstractSolver | str | type | None = None,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    stabilisation: AbstractStabilisation | str | type | None = None,
    t1: float | None = None,
    save_every: float | None = None,
    ts: Sequence[float] | np.ndarray | None = None,
    event: Event | None = None,
    direction: bool | None = None,
    jump_ts: Sequence[float] | np.ndarray | None = None,
    max_steps: int = 100_000,
    first_step: float = 1e-4,
    max_step: float = float("inf"),
    error_estimate: bool = True,
    analysis: bool = True,
    throw: bool = True,
    progress: Progress | None = None,
) -> Run:
    """Integrate a scene, or a system from a state, and certify the result.

    Args:
        scene: a scene; or a system, which then takes `state` and `t1` or `ts`.
        state: the system's initial state, at t = 0 or at ts[0].
        formulation: default `Tree()`; dependent rows are found and allowed for.
        solver: a diffrax solver with an error estimate; default `Dopri8()`. `Rodas5P()` is
            for stiff scenes; the text "auto" chooses between these two by `choose_solver`.
        rtol, atol: tolerances of a step.
        stabilisation: default `Projection()`.
        t1: end [s]; default the scene's.
        save_every: spacing of the saved times [s]; default the scene's, a hundredth of the span
            for a system. Or `ts`: the saved times themselves, the first at the scene's t0. A saved
            time ends a step, so that no step is longer than the spacing.
        event: (t, state) -> a number whose change of sign ends the run, or a truth value.
        direction: of the change of sign: True upwards, False downwards, None both.
        jump_ts: times at which forces jump [s].
        max_steps: between two saved times.
        first_step: the first step tried [s]. max_step: no step is longer [s].
        error_estimate: estimate the global error at every saved time by a second run at smaller
            tolerances, see `ErrorEstimate`. The second run takes 1.1 to 2 times as long as the
            first; there is nothing more to compile.
        analysis: find accelerations, reactions, energies and balances at the saved times. Without
            it the run has no `snapshot`, and there is less to compile.
        throw: raise if the end was not reached; otherwise the run's certificate says so.
        progress: called with the fraction done.

    Returns:
        A `Run`. Ctrl-C ends it early with what was reached.

    Raises:
        SettingError: impossible tolerances, span, saved times, or kinds of arguments.
        StateError: a start that is not finite, not unit or not consistent.
        ModelError: contradictory constraints, or a load that is not finite at the start.
        SimulationError: the end was not reached (with `throw`); its `run` holds the rest.
    """
    scene = scene_of(scene, state, t1, save_every, ts)
    check_parts(solver=solver, formulation=formulation, stabilisation=stabilisation)
    method = Method(
        formulation=formulation if formulation is not None else Tree(),  # pyright: ignore
        solver=_solver(scene, solver, formulation),
        rtol=rtol,
        atol=atol,
        stabilisation=stabilisation if stabilisation is not None else Projection(),  # pyright: ignore
        first_step=first_step,
        max_steps=max_steps,
        adjoint=diffrax.ForwardMode(),
        event=event,
        direction=direction,
        jump_ts=None if jump_ts is None else jnp.asarray(jump_ts, dtype=float),
        balances=analysis,
        steps="state",
        max_step=max_step,
    )
    times = output_times(scene, t1, save_every, ts)
    check_settings(method)
    check_start(scene.system, scene.state0)
    run = _carried_out(scene, method, times, progress, error_estimate, analysis)
    if run.successful or run.certificate.result == "interrupted":
        return run
    run = dataclasses.replace(run, failure=_failure(run, float(times[-1])))
    if throw:
        raise SimulationError(run.failure, run)
    return run


def _carried_out(
    scene: Scene,
    method: Method,
    times: np.ndarray,
    progress: Progress | None,
    estimate: bool,
    analysis: bool,
) -> Run:
    """The run with its certificate, whether or not it came to its end."""
    clock = time.perf_counter()
    method, models, rank, seen = _inspect(scene, method, analysis)
    looked = time.perf_counter() - clock
    done = _run(scene, method, times, progress, estimate)
    clock = time.perf_counter()
    first = done.trajectory
    saved = (np.asarray(first.ts), first.states, np.asarray(first.internal))
    view = snapshots(method.formulation, *models, *saved) if analysis else None
    errors = _errors(scene, done, view)
    seconds = dataclasses.replace(done.seconds, analysis=looked + time.perf_counter() - clock)
    result = done.stopped or _words(first)
    worst = violations(models[1].constraints, first, seen)
    certificate = certify(scene.system, first, view, errors, rank, worst, result, seconds)
    settings = _settings(scene.system, method)
    return Run(scene, method, first, view, errors, certificate, settings)


def _solver(scene: Scene, solver: Any, formulation: Any) -> diffrax.AbstractSolver:
    if solver == "auto":
        check_start(scene.system, scene.state0)
        return choose_solver(scene.system, scene.state0, scene.t0, formulation=formulation)
    return solver if solver is not None else diffrax.Dopri8()


def _inspect(
    scene: Scene, method: Method, analysis: bool
) -> tuple[Method, tuple[Any, Model], Rank, Look]:
    """Look at the start: consistent, finite, of which rank; allow for dependent rows."""
    system, formulation = scene.system, method.formulation
    rows = Augmented().prepare(system)
    model = formulation.prepare(system)
    start = _one(scene)
    first = snapshots(formulation, model, rows, *start) if analysis else None
    seen = look(rows, scene.state0, scene.t0) if first is None else first_look(first, scene.state0)
    check_loads(system, seen.finite_loads, scene.t0)
    check_consistent(system, rows, seen.residuals, seen.rates)
    rank = rank_of(system, rows, scene.state0, scene.t0, seen.singular_values)
    if rank.rank < rank.rows:
        if not isinstance(formulation, Augmented | Tree):
            raise ModelError(f"Dependent constraint rows in {', '.join(rank.redundant)}.")
        if not formulation.redundant or first is None:
            formulation = dataclasses.replace(formulation, redundant=True)
            method = dataclasses.replace(method, formulation=formulation)
            first = snapshots(formulation, model, rows, *start)
        size = 1 + np.max(np.abs(first.accelerations.v_rate), initial=0.0)
        if not first.acceleration_misfit[0] <= 1e-6 * size:
            raise ModelError(
                "The constraints contradict each other: no accelerations satisfy all of them "
                f"(misfit {first.acceleration_misfit[0]:.3g}). Among the dependent rows are those of "
                f"{', '.join(rank.redundant)}. Where only this posture makes them dependent, it is "
                "the velocities that fit no motion through it."
            )
    return method, (model, rows), rank, seen


def _one(scene: Scene) -> tuple[np.ndarray, State, np.ndarray]:
    row = lambda x: np.asarray(x)[None]
    own = row(internal_states(scene.system))
    return np.array([scene.t0]), jax.tree.map(row, scene.state0), own


class _Done(NamedTuple):
    """What was integrated: the first run, the second (if any), times in seconds, what stopped it."""

    trajectory: Trajectory
    second: SecondRun | None
    seconds: Seconds
    stopped: str


def _run(
    scene: Scene, method: Method, times: np.ndarray, progress: Progress | None, estimate: bool
) -> _Done:
    """Integrate in chunks, with the second run close behind."""
    clock = time.perf_counter()
    march = March(prepare(scene.system, method), times[0], scene.state0)
    second = SecondRun(march.problem, times[0], scene.state0) if estimate else None
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
    # the start as given, not by way of the formulation's coordinates
    first = jax.tree.map(
        lambda x, y: np.r_[np.asarray(y)[None], x[1:]], joined.states, scene.state0
    )
    joined = eqx.tree_at(lambda found: found.states, joined, first)
    return _Done(joined, second, Seconds(compiling, *running), stopped)


def _errors(scene: Scene, done: _Done, view: Snapshot | None) -> ErrorEstimate:
    """The estimate; by a run at larger tolerances where the second run has stopped early."""
    first, second = done.trajectory, done.second
    if second is None:
        return without(first, "none was asked for")
    rates = None
    if view is not None:
        found = (view.accelerations.v_rate[-1], view.accelerations.omega_rate[-1])
        rates = np.asarray(found[0]), np.asarray(found[1])
    if done.stopped:
        return estimated(first, second, rates, "the run was interrupted")
    found = estimated(first, second, rates)
    if not found.note or first.result == diffrax.RESULTS.event_occurred:
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
        if trajectory.result == code:
            return words
    return diffrax.RESULTS[trajectory.result].splitlines()[0]


def _settings(system: System, method: Method) -> dict[str, Any]:
    formulation = method.formulation
    words = type(formulation).__name__
    if isinstance(formulation, Augmented):
        words += f"(solve={formulation.solve}, rows={formulation.rows}, redundant={formulation.redundant})"
    elif isinstance(formulation, Tree):
        words += (
            f"(cut={', '.join(formulation.cut) or 'chosen'}, redundant={formulation.redundant})"
        )
    return {
        "formulation": words,
        "solver": type(method.solver).__name__,
        "rtol": float(method.rtol),
        "atol": float(method.atol),
        "stabilisation": type(method.stabilisation).__name__,
        "max_steps_between_saved_times": method.max_steps,
    }


def _failure(run: Run, end: float) -> str:
    """Why a run stopped, in one paragraph."""
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
    reason = singular_posture(system, ends, t, run.certificate.rank) or reason
    kin = system.kinematics(state)
    for force in system.forces:
        # a load may turn bad right after the last state that was still good
        for later in (0.0, 1e-12, 1e-9, 1e-6, 1e-4):
            load = force.load(jnp.asarray(t + later), kin)
            if not bool(jnp.all(jnp.isfinite(load.force)) & jnp.all(jnp.isfinite(load.moment))):
                where = ", ".join((*force.bodies(), *force.joint_names())) or "all bodies"
                reason = f"the load of {type(force).__name__} on {where} is not finite there"
    return (
        f"The simulation of {run.scene.name} stopped at t = {t:.9g} s of {end:.9g} s: {reason}. "
        f"{run.certificate.accepted_steps} steps were accepted, {run.certificate.rejected_steps} "
        "rejected."
    )
