"""Consistent initial conditions: assembly of positions, projection of velocities, rank of rows."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ...algebra import lapack
from ...algebra.compiler import kept_jit
from ...algebra.rotation import conjugate, normalise, product, to_rotation_vector
from ...checks.errors import ModelError, StateError, concrete
from ...checks.shapes import Numbers
from ...mechanics.joint import CATALOGUE, drive
from ...mechanics.joint_coordinate import coordinate, free_coordinates
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..formulations.augmented import Augmented, AugmentedModel, displace
from ..formulations.constraints import Equations
from .joint_drivers import UniformMotion

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
    near: State | None = None,
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
        guess: state near the wanted one.
        t: time of the drivers [s].
        hold: fixed coordinates by body: its "position", its "orientation" or "all".
        hold_joints: joints whose angle or displacement keeps its value; both of a cylindrical one.
        tolerance: bound of the position residuals [m].
        near: posture at which the method starts, if several close; by default the guess.
        throw: raise an error without convergence, if values are concrete (not inside `jit`).

    Raises:
        StateError: there is no convergence; the message names the joint with the largest residual.
            Or the guess is not finite, or has Euler parameters that are all zero.
        ModelError: a name is unknown.
    """
    check_state(system, guess)
    _check_guess(system, guess)
    free = _free_coordinates(system, hold or {})
    normal = State(guess.r, jax.vmap(normalise)(guess.p), guess.v, guess.omega)
    locked = _lock(system, normal, hold_joints)
    time = jnp.asarray(t, dtype=guess.r.dtype)
    near = normal if near is None else near
    state, residuals = _assembled(locked, time, normal, near, jnp.asarray(free), max_steps)
    worst = jnp.max(residuals, initial=0.0)
    converged = jnp.isfinite(worst) & (worst <= tolerance)
    moved = jnp.max(jnp.sqrt(jnp.sum((jax.lax.stop_gradient(state.r) - guess.r) ** 2, axis=1)))
    result = Assembly(state, converged, residuals[: len(system.joints)], moved)
    if throw and concrete(result) and not bool(converged):
        names = [joint.name for joint in locked.joints]
        k = int(np.nanargmax(np.where(np.isfinite(residuals), residuals, np.inf)))
        raise StateError(
            f"The mechanism could not be assembled from this guess: after {max_steps} steps at the "
            f"most, joint '{names[k]}' is still open by {float(residuals[k]):.3g} m, or rad "
            f"in its angles (tolerance {tolerance:.3g}). Start nearer to a posture "
            "that closes, hold less, or check the lengths."
        )
    return result


@kept_jit
def _assembled(
    system: System,
    t: Float[Array, ""],
    guess: State,
    near: State,
    free: Bool[Array, " k"],
    max_steps: int,
) -> tuple[State, Float[Array, " joints"]]:
    """Assembled state and the largest position residual of each joint."""
    model = Augmented().prepare(system)
    state = velocities(model, t, _positions(model, t, guess, near, free, max_steps), free)
    kin = system.kinematics(state)
    value = jnp.abs(model.constraints.scales() * model.constraints.equations(t, kin).value)
    owner = np.array(model.constraints.owner, dtype=int)
    belongs = np.eye(len(system.joints))[owner].reshape(owner.size, len(system.joints))
    return state, jnp.max(value[:, None] * belongs, axis=0, initial=0.0)


def _check_guess(system: System, guess: State) -> None:
    if not concrete(guess):
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
    for name, what in hold.items():
        if what not in columns:
            raise ModelError(
                f"What to hold of body '{name}' must be one of {', '.join(columns)}, not '{what}'."
            )
        free[system.index(name), columns[what]] = False
    return free.reshape(-1)


def _lock(system: System, state: State, names: tuple[str, ...]) -> System:
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
        for which in free[-max(len(motions), 1) :]:
            value = coordinate(kin, joint, which).value
            locks.append(
                drive(f"hold {name}", joint, UniformMotion(value, zero, zero), coordinate=which)
            )
    return eqx.tree_at(lambda s: s.joints, system, (*system.joints, *locks))


def _positions(
    model: AugmentedModel,
    t: Float[Array, ""],
    guess: State,
    near: State,
    free: Bool[Array, " k"],
    max_steps: int,
) -> State:
    """Newton's method on M step - J^T multipliers = 0, Phi = 0 for the step from the guess."""
    m = model.constraints.n_rows
    if not m:
        return guess
    bodies = model.system.bodies

    def moved(step: Array, base: State) -> State:
        r, p = displace(base.r, base.p, step.reshape(-1, 6))
        return State(r, p, guess.v, guess.omega)

    def residual(unknown: Array, args: tuple[AugmentedModel, State]) -> Array:
        step, multipliers = unknown[:-m], unknown[-m:]
        within, base = args
        phi = lambda s: (
            within.constraints.equations(t, within.system.kinematics(moved(s, base))).value
        )
        value, pull = jax.vjp(phi, step)
        by_body = step.reshape(-1, 6)
        mass = within.system.bodies
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
    turned = jax.vmap(lambda a, b: to_rotation_vector(product(conjugate(b), a)))
    away = lambda a, b: jnp.concatenate([a.r - b.r, turned(a.p, b.p)], axis=1).reshape(-1)
    start = jnp.concatenate(
        [away(*jax.lax.stop_gradient((near, guess))), jnp.zeros(m, guess.r.dtype)]
    )
    solver = optx.Newton(rtol=1e-12, atol=1e-13, linear_solver=lapack.PseudoinverseSolver(1e-11))
    adjoint = optx.ImplicitAdjoint(linear_solver=lapack.PseudoinverseSolver(1e-11))
    how: Any = {"adjoint": adjoint, "max_steps": max_steps, "throw": False}
    solution = optx.root_find(residual, solver, start, args=(model, guess), **how)
    return moved(solution.value[:-m], guess)


def velocities(
    model: AugmentedModel, t: Float[Array, ""], state: State, free: Bool[Array, " k"]
) -> State:
    """Velocities with J qdot = target that are nearest in the mass metric."""
    if not model.constraints.n_rows:
        return state
    eq = model.constraints.equations(t, model.system.kinematics(state))
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    step = nearest_step(model, eq, free)
    # the second pass removes the round-off of the first
    for _ in range(2):
        u = u + step(eq.target - eq.matrix @ u)
    u = u.reshape(-1, 6)
    return State(state.r, state.p, u[:, :3], u[:, 3:])


def nearest_step(
    model: AugmentedModel, eq: Equations, free: Bool[Array, " k"]
) -> Callable[[Float[Array, " m"]], Float[Array, " k"]]:
    """Function of numbers b (m,) that returns the smallest x in the mass metric with J x = b."""
    weighed = model.weigh(eq.J * free.reshape(-1, 6)).reshape(eq.matrix.shape) * free
    inverse = lapack.pseudoinverse(weighed @ (eq.matrix * free).T, 1e-11)
    return lambda b: weighed.T @ (inverse @ b)


class Rank(NamedTuple):
    """Rank of the constraint Jacobian at one posture.

    Attributes:
        rows: number of constraint rows. rank: number of independent rows.
        dof: degrees of freedom, 6 n - rank.
        smallest_singular_value: smallest non-zero singular value of the velocity Jacobian.
        redundant: names of joints that own a dependent row, by pivoting.
    """

    rows: int
    rank: int
    dof: int
    smallest_singular_value: float
    redundant: tuple[str, ...]


def rank(system: System, state: State, t: float = 0.0) -> Rank:
    """Rank and redundant rows of the constraint Jacobian in (v, omega'), for concrete values."""
    return rank_of(system, Augmented().prepare(system), state, t)


def rank_of(
    system: System,
    model: AugmentedModel,
    state: State,
    t: float = 0.0,
    matrix: np.ndarray | None = None,
    *,
    tolerance: float = 1e-9,
) -> Rank:
    """Rank as by `rank`, for a prepared model and with the constraint Jacobian if it is known.

    Singular values below `tolerance` times the largest count as zero.
    """
    owner, columns = model.constraints.owner, 6 * system.n_bodies
    if not owner:
        return Rank(0, 0, columns, float("inf"), ())
    matrix = jacobian(model, state, t) if matrix is None else matrix
    values = np.linalg.svd(matrix, compute_uv=False)
    count = int(np.sum(values > tolerance * values[0]))
    names: tuple[str, ...] = ()
    if count < len(owner):
        dependent = _dependent_rows(matrix, count)
        names = tuple(dict.fromkeys(system.joints[owner[k]].name for k in dependent))
    return Rank(len(owner), count, columns - count, float(values[count - 1]), names)


def ranks(
    system: System, states: State, t: float = 0.0, *, tolerance: float = 1e-9
) -> tuple[np.ndarray, np.ndarray]:
    """Rank, and the smallest non-zero singular value, of the constraint Jacobian at k postures.

    Args:
        states: states (k, n, .). tolerance: values below it times the largest count as zero.

    Returns:
        Integers (k,) and values (k,), for the unscaled Jacobian in (v, omega').
    """
    model = Augmented().prepare(system)
    values = np.asarray(singular_values(model, states, jnp.asarray(t, dtype=states.r.dtype)))
    count = np.sum(values > tolerance * values[:, :1], axis=1)
    return count, np.take_along_axis(values, count[:, None] - 1, axis=1)[:, 0]


@kept_jit
def singular_values(
    model: AugmentedModel, states: State, t: Float[Array, ""]
) -> Float[Array, "k m"]:
    """Singular values of the unscaled constraint Jacobian at states (k, n, .), the largest first."""
    matrices = jax.vmap(lambda state: _jacobian(model, state, t))(states)
    return jax.vmap(lapack.singular_values)(matrices)


def _dependent_rows(J: np.ndarray, count: int) -> list[int]:
    """Rows that Gram-Schmidt orthogonalisation with row pivoting leaves after `count` rows."""
    rest = J.copy()
    order = list(range(len(J)))
    for k in range(count):
        sizes = np.linalg.norm(rest[order[k:]], axis=1)
        pick = k + int(np.argmax(sizes))
        order[k], order[pick] = order[pick], order[k]
        direction = rest[order[k]] / np.linalg.norm(rest[order[k]])
        rest = rest - np.outer(rest @ direction, direction)
    return sorted(order[count:])


def jacobian(model: AugmentedModel, state: State, t: float = 0.0) -> np.ndarray:
    """Constraint Jacobian in (v, omega') as a NumPy matrix (m, 6 n)."""
    return np.asarray(_jacobian(model, state, jnp.asarray(t, dtype=state.r.dtype)))


@kept_jit
def _jacobian(model: AugmentedModel, state: State, t: Float[Array, ""]) -> Float[Array, "m k"]:
    return model.constraints.equations(t, model.system.kinematics(state)).matrix
