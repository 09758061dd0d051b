"""Checks of `simulate` before it starts: settings, output times, initial states, loads."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import numpy as np

from ..checks.errors import ModelError, SettingError, StateError, concrete
from ..checks.numbers import as_numpy, increasing_times
from ..checks.physical import check_unit
from ..mechanics.constraint import ROWS
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .formulations.augmented import AugmentedModel
from .method import Method
from .scene import Scene

# Larger initial residuals are refused: they are not round-off, and are never repaired silently.
POSITION_TOLERANCE = 1e-8
VELOCITY_TOLERANCE = 1e-7

# Number of intervals between saved times of a run that is given by its end alone.
_INTERVALS = 100


def scene_of(
    what: Scene | System, state: State | None, t1: float | None, every: float | None, ts: Any
) -> Scene:
    """Scene as given, or made of a system, its state and the given times."""
    if isinstance(what, Scene):
        if state is not None:
            raise SettingError(
                "A scene has its own initial state: give a scene, or a system and a state."
            )
        return what
    if not isinstance(what, System):
        raise SettingError(
            f"simulate takes a Scene, or a System and a State, but it was given a {type(what).__name__}."
        )
    if not isinstance(state, State):
        given = "none" if state is None else f"a {type(state).__name__}"
        raise SettingError(
            f"To simulate a system give its initial State, such as system.reference (given: {given})."
        )
    title = "System of " + ", ".join(what.names)
    if ts is not None:
        times = increasing_times(ts, "The output times ts")
        return Scene("system", title, what, state, times[0], times[-1])
    if t1 is None:
        raise SettingError("To simulate a system give the end t1 [s], or the saved times ts [s].")
    every = abs(float(t1)) / _INTERVALS if every is None else every
    return Scene("system", title, what, state, 0.0, float(t1), every or 1.0)


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


def check_method(method: Any) -> None:
    """Raise `SettingError` unless the method is a `Method` with an adaptive or automatic solver."""
    if not isinstance(method, Method):
        given = f"the class {method.__name__}" if isinstance(method, type) else repr(method)
        raise SettingError(f"method must be a Method(...), but it is {given:.80}.")
    if not isinstance(method.solver, str | diffrax.AbstractAdaptiveSolver):
        raise SettingError(
            f"{type(method.solver).__name__} has no error estimate and cannot adapt its steps; "
            "choose Dopri8, Tsit5 or Rodas5P, or wrap it in diffrax.HalfSolver."
        )


def check_start(system: System, state: State) -> None:
    """Raise an error unless the state fits the system, is finite and has unit Euler parameters."""
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
    state = as_numpy(state)
    for k, name in enumerate(system.names):
        check_unit(state.p[k], f"body '{name}' in the initial state", StateError)
        for field, words, unit in units:
            value = np.asarray(getattr(state, field)[k])
            if not np.all(np.isfinite(value)):
                raise StateError(
                    f"The initial {words} of body '{name}' must be finite, but it is {value.tolist()} {unit}."
                )


def check_loads(system: System, finite: np.ndarray, t: float) -> None:
    """Raise `ModelError` unless the load of every force element is finite."""
    for force, fine in zip(system.forces, finite, strict=True):
        if not fine:
            raise ModelError(
                f"The load of {type(force).__name__} on {force.acts_on()} is not finite at t = {t:.9g} s."
            )


def check_consistent(
    system: System, model: AugmentedModel, residuals: np.ndarray, rates: np.ndarray
) -> None:
    """Raise `StateError` unless positions and velocities satisfy the joints.

    Args:
        residuals, rates: residuals and rates of every row (m,), scaled as those of `Snapshot`.
    """
    owner = model.constraints.owner
    checks: tuple[tuple[Any, float, str, Callable[..., str]], ...] = (
        (residuals, POSITION_TOLERANCE, "positions", _off),
        (rates, VELOCITY_TOLERANCE, "velocities", _off_rate),
    )
    for values, tolerance, words, shown in checks:
        # NaN is not within the tolerance either
        if np.all(np.abs(values) <= tolerance):
            continue
        k = int(np.argmax(np.where(np.isnan(values), np.inf, np.abs(values))))
        raise StateError(
            f"The initial {words} do not fit the joints: joint '{system.joints[owner[k]].name}' is off "
            f"by {shown(model, k, values[k])} (tolerance {tolerance:.0e}). Find the nearest consistent "
            "state with stmuav_jax.assemble(system, state)."
        )


def _off(model: AugmentedModel, k: int, value: float) -> str:
    """Text of the residual of row k: a length, a cosine or an angle."""
    kinds = [g.kind for g in model.constraints.groups for _ in range(len(g.i) * ROWS[g.kind])]
    if kinds[k] == "distance":
        # the row is (d^2 - l^2) / (2 l), which equals d - l for small residuals only
        length = 0.5 / float(np.asarray(model.constraints.scales())[k])
        return f"{abs(np.sqrt(max(length**2 + 2 * length * value, 0.0)) - length):.3g} m"
    if kinds[k] == "angle":
        return f"{abs(value):.3g} rad"
    if model.constraints.angular[k]:
        return f"{abs(value):.3g} (a cosine, zero where its axes are as they should be)"
    return f"{abs(value):.3g} m"


def _off_rate(model: AugmentedModel, k: int, value: float) -> str:
    unit = "rad/s" if model.constraints.angular[k] else "m/s"
    return f"{abs(value):.3g} {unit}"
