"""`simulate`: a scene in, a `Run` with its certificate out."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..algebra.compiler import outer_jit
from ..mechanics.body import check_unit
from ..mechanics.errors import (
    ModelError,
    SettingError,
    SimulationError,
    StateError,
    concrete,
)
from ..mechanics.internal import internal_states, with_internal
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .analysis import Snapshot, snapshots
from .augmented import Augmented, Model
from .certify import certify
from .formulation import AbstractFormulation
from .initial import Rank, rank_of
from .integrate import Trajectory, advance
from .problem import Event, Method, begin, prepare
from .run import Run
from .scene import Scene
from .stabilisation import AbstractStabilisation, Projection
from .stiffness import choose_solver
from .tree import Tree

Progress = Callable[[float], None]

# Initial residuals above these are refused: not round-off, and never repaired silently.
POSITION_TOLERANCE = 1e-8
VELOCITY_TOLERANCE = 1e-7

# Output times reached by one call of the compiled function, between two progress reports.
_CHUNK = 16


def simulate(
    scene: Scene,
    *,
    formulation: AbstractFormulation | None = None,
    solver: diffrax.AbstractSolver | Literal["auto"] | None = None,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    stabilisation: AbstractStabilisation | None = None,
    t1: float | None = None,
    save_every: float | None = None,
    ts: Sequence[float] | np.ndarray | None = None,
    event: Event | None = None,
    direction: bool | None = None,
    jump_ts: Sequence[float] | np.ndarray | None = None,
    max_steps: int = 100_000,
    first_step: float = 1e-4,
    max_step: float = float("inf"),
    throw: bool = True,
    progress: Progress | None = None,
) -> Run:
    """Integrate a scene and certify the result.

    Args:
        formulation: default `Tree()`; dependent rows are found and allowed for.
        solver: a diffrax solver with an error estimate; default `Dopri8()`. `Rodas5P()` is
            for stiff scenes; "auto" chooses between these two by `choose_solver`.
        rtol, atol: tolerances of a step.
        stabilisation: default `Projection()`.
        t1: end [s]; default the scene's.
        save_every: spacing of the saved times [s]; default the scene's. Or `ts`: the saved
            times themselves, the first at the scene's t0.
        event: (t, state) -> a number whose change of sign ends the run, or a truth value.
        direction: of the change of sign: True upwards, False downwards, None both.
        jump_ts: times at which forces jump [s].
        max_steps: between two saved times.
        first_step: the first step tried [s]. max_step: no step is longer [s].
        throw: raise if the end was not reached; otherwise the run's certificate says so.
        progress: called with the fraction done.

    Returns:
        A `Run`. Ctrl-C ends it early with what was reached.

    Raises:
        SettingError: impossible tolerances, span or saved times.
        StateError: a start that is not finite, not unit or not consistent.
        ModelError: contradictory constraints, or a load that is not finite at the start.
        SimulationError: the end was not reached (with `throw`); its `run` holds the rest.
    """
    formulation = formulation if formulation is not None else Tree()
    if solver == "auto":
        _check_start(scene.system, scene.state0)
        solver = choose_solver(scene.system, scene.state0, scene.t0, formulation=formulation)
    method = Method(
        formulation=formulation,
        solver=solver if solver is not None else diffrax.Dopri8(),
        rtol=rtol,
        atol=atol,
        stabilisation=stabilisation if stabilisation is not None else Projection(),
        first_step=first_step,
        max_steps=max_steps,
        adjoint=diffrax.ForwardMode(),
        event=event,
        direction=direction,
        jump_ts=None if jump_ts is None else jnp.asarray(jump_ts, dtype=float),
        balances=True,
        steps="state",
        max_step=max_step,
    )
    times = _output_times(scene, t1, save_every, ts)
    _check_settings(method)
    _check_start(scene.system, scene.state0)
    started = time.perf_counter()
    method, models, rank = _inspect(scene, method)
    looked = time.perf_counter() - started
    trajectory, seconds, stopped = _run(scene, method, times, progress)
    started = time.perf_counter()
    saved = (np.asarray(trajectory.ts), trajectory.states, np.asarray(trajectory.internal))
    view = snapshots(method.formulation, *models, *saved)
    looked += time.perf_counter() - started
    result = stopped or _words(trajectory)
    certificate = certify(scene.system, trajectory, view, rank, result, (*seconds, looked))
    run = Run(scene, method, trajectory, view, certificate, _settings(scene.system, method))
    if run.successful or result == "interrupted":
        return run
    run = dataclasses.replace(run, failure=_failure(run))
    if throw:
        raise SimulationError(run.failure, run)
    return run


def _output_times(scene: Scene, t1: float | None, save_every: float | None, ts: Any) -> np.ndarray:
    if ts is not None:
        times = np.asarray(ts, dtype=float)
        if times.ndim != 1 or times.size < 1 or not np.all(np.isfinite(times)):
            raise SettingError("The output times ts must be a list of finite numbers.")
        if times[0] != scene.t0:
            raise SettingError(
                f"The first output time must be the scene's t0 = {scene.t0} s, not {times[0]} s."
            )
        if np.any(np.diff(times) <= 0):
            k = int(np.argmax(np.diff(times) <= 0))
            raise SettingError(
                f"Output times must increase, but ts[{k + 1}] = {times[k + 1]} s follows ts[{k}] = {times[k]} s."
            )
        return times
    end = scene.t1 if t1 is None else float(t1)
    every = scene.save_every if save_every is None else float(save_every)
    if not np.isfinite(end) or end < scene.t0:
        raise SettingError(f"The end t1 = {end} s must be finite and not before t0 = {scene.t0} s.")
    if not np.isfinite(every) or every <= 0:
        raise SettingError(f"save_every must be finite and positive, but it is {every} s.")
    count = int(np.floor((end - scene.t0) / every * (1 + 1e-12)))
    times = scene.t0 + every * np.arange(count + 1)
    if end - times[-1] > 1e-9 * every:
        times = np.append(times, end)
    times[-1] = end if count else times[-1]
    return times


def _check_settings(method: Method) -> None:
    first = float(method.first_step)
    if not (np.isfinite(first) and first > 0):
        raise SettingError(f"first_step must be finite and positive, but it is {first} s.")
    if not float(method.max_step) > 0:
        raise SettingError(f"max_step must be positive, but it is {method.max_step} s.")
    if method.max_steps < 1:
        raise SettingError(f"max_steps must be at least 1, but it is {method.max_steps}.")
    for name in ("rtol", "atol"):
        value = float(getattr(method, name))
        if not (np.isfinite(value) and value >= 1e-15):
            raise SettingError(
                f"{name} must be finite and at least 1e-15 (the round-off of double precision), "
                f"but it is {value}."
            )
    if not isinstance(method.solver, diffrax.AbstractAdaptiveSolver):
        raise SettingError(
            f"{type(method.solver).__name__} has no error estimate and cannot adapt its steps; "
            "choose Dopri8, Tsit5 or Rodas5P, or wrap it in diffrax.HalfSolver."
        )


def _check_start(system: System, state: State) -> None:
    if not concrete(system, state):
        raise SettingError(
            "simulate looks at values and cannot be differentiated, batched or compiled by JAX: "
            "its scene holds traced numbers. Use stmuav_jax.integrate(system, state, ts, method)."
        )
    check_state(system, state)
    units = (
        ("r", "position", "m"),
        ("v", "velocity", "m/s"),
        ("omega", "angular velocity", "rad/s"),
    )
    for k, name in enumerate(system.names):
        check_unit(state.p[k], f"body '{name}' in the initial state", StateError)
        for field, words, unit in units:
            value = np.asarray(getattr(state, field)[k])
            if not np.all(np.isfinite(value)):
                raise StateError(
                    f"The initial {words} of body '{name}' must be finite, but it is {value.tolist()} {unit}."
                )


def _inspect(scene: Scene, method: Method) -> tuple[Method, tuple[Any, Model], Rank]:
    """Look at the start: consistent, finite, of which rank; allow for dependent rows."""
    system, formulation = scene.system, method.formulation
    rows = Augmented().prepare(system)
    model = formulation.prepare(system)
    start = _one(scene)
    first = snapshots(formulation, model, rows, *start)
    _check_loads(system, np.asarray(first.finite_loads[0]), scene.t0)
    _check_consistent(system, rows, first)
    rank = rank_of(system, rows, scene.state0, scene.t0, np.asarray(first.singular_values[0]))
    if rank.rank < rank.rows:
        if not isinstance(formulation, Augmented | Tree):
            raise ModelError(f"Dependent constraint rows in {', '.join(rank.redundant)}.")
        if not formulation.redundant:
            formulation = dataclasses.replace(formulation, redundant=True)
            method = dataclasses.replace(method, formulation=formulation)
            first = snapshots(formulation, model, rows, *start)
        size = 1 + np.max(np.abs(first.accelerations.v_rate), initial=0.0)
        if not first.acceleration_misfit[0] <= 1e-6 * size:
            raise ModelError(
                "The constraints contradict each other: no accelerations satisfy all of them "
                f"(misfit {first.acceleration_misfit[0]:.3g}). Among the dependent rows are those of "
                f"{', '.join(rank.redundant)}."
            )
    return method, (model, rows), rank


def _one(scene: Scene) -> tuple[np.ndarray, State, np.ndarray]:
    row = lambda x: np.asarray(x)[None]
    own = row(internal_states(scene.system))
    return np.array([scene.t0]), jax.tree.map(row, scene.state0), own


def _check_loads(system: System, finite: np.ndarray, t: float) -> None:
    for force, fine in zip(system.forces, finite, strict=True):
        if not fine:
            where = ", ".join((*force.bodies(), *force.joint_names())) or "all bodies"
            raise ModelError(
                f"The load of {type(force).__name__} on {where} is not finite at t = {t:.9g} s."
            )


def _check_consistent(system: System, model: Model, first: Snapshot) -> None:
    owner = model.constraints.owner
    checks = (
        (first.residuals[0], POSITION_TOLERANCE, "positions", "m"),
        (first.rates[0], VELOCITY_TOLERANCE, "velocities", "m/s"),
    )
    for values, tolerance, words, unit in checks:
        if not values.size or np.max(np.abs(values)) <= tolerance:
            continue
        k = int(np.argmax(np.abs(values)))
        raise StateError(
            f"The initial {words} do not fit the joints: joint '{system.joints[owner[k]].name}' is off "
            f"by {abs(values[k]):.3g} {unit} (tolerance {tolerance:.0e}). Find the nearest consistent "
            "state with stmuav_jax.assemble(system, state)."
        )


_begin: Any = eqx.filter_jit(begin)


@cache
def _advance() -> Any:
    return outer_jit(advance)


def _run(
    scene: Scene, method: Method, times: np.ndarray, progress: Progress | None
) -> tuple[Trajectory, tuple[float, float], str]:
    """Integrate in chunks; seconds to compile and to run; a word if it was interrupted."""
    problem = prepare(scene.system, method)
    clock = time.perf_counter()
    carry = _begin(problem, jnp.asarray(times[0]), scene.state0)
    chunk = np.full(_CHUNK, times[0])
    compiled = _advance().lower(problem, carry, jnp.asarray(chunk)).compile()
    compiling = time.perf_counter() - clock
    clock = time.perf_counter()
    parts: list[Trajectory] = []
    stopped = ""
    try:
        for start in range(0, len(times), _CHUNK):
            part = times[start : start + _CHUNK]
            chunk = np.append(part, np.full(_CHUNK - len(part), part[-1]))
            carry, trajectory = compiled(problem, carry, jnp.asarray(chunk))
            parts.append(_shorten(trajectory, len(part)))
            if progress is not None:
                progress((start + len(part)) / len(times))
            if parts[-1].result != diffrax.RESULTS.successful:
                break
    except KeyboardInterrupt:
        stopped = "interrupted"
    if not parts:
        raise KeyboardInterrupt
    joined = jax.tree.map(
        lambda *x: np.concatenate(x), *(eqx.tree_at(_result, p, None) for p in parts)
    )
    joined = eqx.tree_at(_result, joined, parts[-1].result, is_leaf=lambda x: x is None)
    # the start as given, not by way of the formulation's coordinates
    first = jax.tree.map(
        lambda x, y: np.r_[np.asarray(y)[None], x[1:]], joined.states, scene.state0
    )
    joined = eqx.tree_at(lambda found: found.states, joined, first)
    return _until_stop(joined), (compiling, time.perf_counter() - clock), stopped


def _result(trajectory: Trajectory) -> Any:
    return trajectory.result


def _shorten(trajectory: Trajectory, count: int) -> Trajectory:
    jax.block_until_ready(trajectory)
    bare = eqx.tree_at(_result, trajectory, None)
    bare = jax.tree.map(lambda x: np.asarray(x)[:count], bare)
    return eqx.tree_at(_result, bare, trajectory.result, is_leaf=lambda x: x is None)


def _until_stop(trajectory: Trajectory) -> Trajectory:
    """Drop the repeats of the last state after an event or a failure."""
    ts = trajectory.ts
    fresh = np.append(True, np.diff(ts) > 0)
    count = len(ts) if np.all(fresh) else int(np.argmin(fresh))
    return _shorten(trajectory, max(count, 1))


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


def _failure(run: Run) -> str:
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
    kin = system.kinematics(state)
    for force in system.forces:
        # a load may turn bad right after the last state that was still good
        for later in (0.0, 1e-12, 1e-9, 1e-6, 1e-4):
            load = force.load(jnp.asarray(t + later), kin)
            if not bool(jnp.all(jnp.isfinite(load.force)) & jnp.all(jnp.isfinite(load.moment))):
                where = ", ".join((*force.bodies(), *force.joint_names())) or "all bodies"
                reason = f"the load of {type(force).__name__} on {where} is not finite there"
    return (
        f"The simulation of {run.scene.name} stopped at t = {t:.9g} s of {run.scene.t1:.9g} s: {reason}. "
        f"{run.certificate.accepted_steps} steps were accepted, {run.certificate.rejected_steps} "
        "rejected."
    )
