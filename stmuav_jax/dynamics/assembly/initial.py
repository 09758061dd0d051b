"""Consistent initial conditions: assembly of positions, projection of velocities."""

from collections.abc import Mapping
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ...checks.errors import ModelError, StateError, closest_name, has_values
from ...checks.numbers import array_module, as_floats, as_jax, as_numpy
from ...checks.shapes import Numbers
from ...math import lapack
from ...math.compiler import is_transformed, kept_jit
from ...mechanics.joint import CATALOGUE, drive, free_coordinates
from ...mechanics.joint_states import evaluate_coordinate
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..formulations.augmented import AugmentedModel, evaluate_equations, move_bodies, prepare_rows
from .closing import UniformMotion, close_loops, displacement_between, nearest_step

Held = Literal["position", "orientation", "all"]


class Assembly(eqx.Module):
    """Result of the assembly of a mechanism by `assemble`.

    Attributes:
        state: positions on the constraints, and velocities compatible with them.
        converged: true if the residuals are below the tolerance.
        residuals: largest absolute position residual of each joint (joints,) [m] or [rad].
        largest_displacement: largest displacement of a centre of mass [m].
    """

    state: State
    converged: Bool[Array, ""]
    residuals: Float[Array, " joints"]
    largest_displacement: Float[Array, ""]


def assemble(
    system: System,
    guess: State,
    t: Numbers = 0.0,
    *,
    hold: Mapping[str, Held] | None = None,
    hold_joints: tuple[str, ...] = (),
    tolerance: float = 1e-11,
    start: State | None = None,
    max_steps: int = 64,
    throw: bool = True,
) -> Assembly:
    """Nearest state to a guess that satisfies the constraints.

    Positions minimise the mass-weighted displacement from the guess,

        sum_i m_i |dr_i|^2 + dtheta_i . J'_i dtheta_i,   subject to Phi = 0,

    by Newton's method on the Lagrange conditions; the velocities with J qdot = target are the
    nearest in the mass metric. Euler parameters of the guess are first divided by their norms.
    The function may be jitted, vmapped and differentiated (implicit function theorem).

    Args:
        guess: state near the solution sought.
        t: time of the drivers [s].
        hold: fixed coordinates by body: its "position", its "orientation" or "all".
        hold_joints: joints whose angle or displacement keeps its value; both of a cylindrical one.
        tolerance: bound of the position residuals [m].
        start: posture at which the method starts, if several close; by default the guess.
        throw: raise an error without convergence, if values are concrete (not inside `jit`).

    Raises:
        StateError: there is no convergence; the message names the joint with the largest residual.
            Or the guess is not finite, or has Euler parameters that are all zero.
        ModelError: a name is unknown.
    """
    check_state(system, guess)
    _check_guess(system, guess)
    free = _free_coordinates(system, hold or {})
    p = as_numpy(guess.p)
    p = as_jax(p / array_module(p).linalg.norm(p, axis=1, keepdims=True))
    normal = State(guess.r, p, guess.v, guess.omega)
    # A held joint becomes a driven one, and the equations need no case for it.
    locked = _lock_joints(system, normal, hold_joints)
    time = as_floats(t).astype(guess.r.dtype)
    start = normal if start is None else start
    state, residuals = _solve(locked, time, normal, start, as_jax(free), max_steps, tolerance)
    r, guessed_r, residuals = as_numpy((jax.lax.stop_gradient(state.r), guess.r, residuals))
    xp = array_module(r, guessed_r, residuals)
    worst = xp.max(residuals, initial=0.0)
    displacement = xp.max(xp.linalg.norm(r - guessed_r, axis=1))
    result = Assembly(
        state,
        as_jax(xp.asarray(xp.isfinite(worst) & (worst <= tolerance))),
        as_jax(residuals[: len(system.joints)]),
        as_jax(xp.asarray(displacement)),
    )
    if throw and has_values(result) and not bool(result.converged):
        names = [joint.name for joint in locked.joints]
        k = int(np.nanargmax(np.where(np.isfinite(residuals), residuals, np.inf)))
        raise StateError(
            f"The mechanism could not be assembled from this guess: after {max_steps} steps at the "
            f"most, joint '{names[k]}' has a residual of {float(residuals[k]):.3g} m, or rad "
            f"in its angles (tolerance {tolerance:.3g}). Start nearer to a posture "
            "that closes, hold fewer coordinates, or check the lengths."
        )
    return result


def _solve(
    system: System,
    t: Float[Array, ""],
    guess: State,
    start_posture: State,
    free: Bool[Array, " k"],
    max_steps: int,
    tolerance: float,
) -> tuple[State, Float[Array, " joints"]]:
    """Assembled state and residuals as of `_assemble_state`."""
    arguments = (system, t, guess, start_posture, free, max_steps)
    if system.joints and not is_transformed(arguments):
        # The method of Gauss and Newton needs no second derivatives, which take most of the time of
        # compiling.
        closing = close_loops(system, guess, start_posture, {}, {}, t, free, max_steps)
        if bool(closing.is_nearest) and bool(np.all(np.asarray(closing.residuals) <= tolerance)):
            return closing.state, closing.residuals
    return _assemble_state(*arguments)


@kept_jit
def _assemble_state(
    system: System,
    t: Float[Array, ""],
    guess: State,
    start_posture: State,
    free: Bool[Array, " k"],
    max_steps: int,
) -> tuple[State, Float[Array, " joints"]]:
    """Assembled state and the largest position residual of each joint."""
    model = prepare_rows(system)
    state = project_velocities(
        model, t, _solve_positions(model, t, guess, start_posture, free, max_steps), free
    )
    value = jnp.abs(model.constraints.scales() * evaluate_equations(model, t, state).value)
    owner = np.array(model.constraints.owner, dtype=int)
    belongs = np.eye(len(system.joints))[owner].reshape(owner.size, len(system.joints))
    return state, jnp.max(value[:, None] * belongs, axis=0, initial=0.0)


def _check_guess(system: System, guess: State) -> None:
    if not has_values(guess):
        return
    for k, name in enumerate(system.names):
        parts = [np.asarray(x)[k] for x in (guess.r, guess.p, guess.v, guess.omega)]
        if not all(np.all(np.isfinite(part)) for part in parts):
            raise StateError(f"The guess for body '{name}' must be finite.")
        if not np.any(parts[1]):
            raise StateError(f"The Euler parameters of body '{name}' are all zero.")


def _free_coordinates(system: System, hold: Mapping[str, Held]) -> np.ndarray:
    """Mask of the 6 n coordinates that may move."""
    free = np.ones((system.n_bodies, 6), dtype=bool)
    columns = {"position": slice(0, 3), "orientation": slice(3, 6), "all": slice(0, 6)}
    for name, held_part in hold.items():
        if held_part not in columns:
            raise ModelError(
                f"The fixed coordinates of body '{name}' must be one of {', '.join(columns)}, not '{held_part}'."
                f"{closest_name(str(held_part), columns)}"
            )
        free[system.index(name), columns[held_part]] = False
    return free.reshape(-1)


def _lock_joints(system: System, state: State, names: tuple[str, ...]) -> System:
    """System with the coordinates of the named joints locked at their present values."""
    if not names:
        return system
    kin, zero = system.kinematics(state), jnp.zeros(())
    locks = []
    for name in names:
        joint = system.joints[system.joint_index(name)]
        free = free_coordinates(joint) or ["angle"]
        # a screw's angle and displacement are one freedom; the driver refuses a joint that
        # leaves none free
        motions = CATALOGUE[joint.kind].motion or ()
        if len(motions) > len(free):
            raise ModelError(
                f"Joint '{name}' cannot be held: no drivers prescribe all coordinates of a {joint.kind} "
                "joint. Hold its bodies, or other joints."
            )
        for coordinate_name in free[-max(len(motions), 1) :]:
            value = evaluate_coordinate(kin, joint, coordinate_name).value
            locks.append(
                drive(
                    f"hold {name}",
                    joint,
                    UniformMotion(value, zero, zero),
                    coordinate=coordinate_name,
                )
            )
    return eqx.tree_at(lambda s: s.joints, system, (*system.joints, *locks))


def _solve_positions(
    model: AugmentedModel,
    t: Float[Array, ""],
    guess: State,
    start_posture: State,
    free: Bool[Array, " k"],
    max_steps: int,
) -> State:
    """Newton's method on M step - J^T multipliers = 0, Phi = 0 for the step from the guess."""
    m = model.constraints.n_rows
    if not m:
        return guess
    bodies = model.system.bodies

    def displace_bodies(step: Array, base: State) -> State:
        r, p = move_bodies(base.r, base.p, step.reshape(-1, 6))
        return State(r, p, guess.v, guess.omega)

    def stationarity_residual(unknown: Array, args: tuple[AugmentedModel, State]) -> Array:
        step, multipliers = unknown[:-m], unknown[-m:]
        within, base = args
        phi = lambda s: evaluate_equations(within, t, displace_bodies(s, base)).value
        value, pull = jax.vjp(phi, step)
        by_body = step.reshape(-1, 6)
        mass = within.system.bodies
        # Nearest in the mass metric: the result does not depend on units, and heavy bodies move least.
        weighed = jnp.concatenate(
            [
                mass.mass[:, None] * by_body[:, :3],
                jnp.einsum("nab,nb->na", mass.inertia, by_body[:, 3:]),
            ],
            axis=1,
        ).reshape(-1)
        gradient = (weighed - pull(multipliers)[0]) / size
        return jnp.concatenate([jnp.where(free, gradient, step), value])

    # one scale for the gradient rows gives both parts the unit of a length
    size = jnp.sum(bodies.mass)
    start = jnp.concatenate(
        [
            # Start of the iteration only: of several branches Newton's method finds the one nearby.
            displacement_between(*jax.lax.stop_gradient((start_posture, guess))),
            jnp.zeros(m, guess.r.dtype),
        ]
    )
    solver = optx.Newton(rtol=1e-12, atol=1e-13, linear_solver=lapack.PseudoinverseSolver(1e-11))
    # Derivatives of the solution by the implicit function theorem, not through the iterations.
    adjoint = optx.ImplicitAdjoint(linear_solver=lapack.PseudoinverseSolver(1e-11))
    solver_options: Any = {"adjoint": adjoint, "max_steps": max_steps, "throw": False}
    solution = optx.root_find(
        stationarity_residual, solver, start, args=(model, guess), **solver_options
    )
    return displace_bodies(solution.value[:-m], guess)


def project_velocities(
    model: AugmentedModel, t: Float[Array, ""], state: State, free: Bool[Array, " k"]
) -> State:
    """Velocities with J qdot = target that are nearest in the mass metric."""
    if not model.constraints.n_rows:
        return state
    eq = evaluate_equations(model, t, state)
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    step = nearest_step(model, eq, free)
    # the second pass removes the round-off of the first
    for _ in range(2):
        u = u + step(eq.target - eq.matrix @ u)
    u = u.reshape(-1, 6)
    return State(state.r, state.p, u[:, :3], u[:, 3:])
