"""Prescribed motion of mechanisms: kinematics on three levels, and the efforts of the drivers.

With as many drivers as there are degrees of freedom, positions follow from Phi(q, t) = 0
by Newton's method, velocities and accelerations from J qdot = target and J qddot = gamma.
The multiplier of a driver's row is the effort that its motor needs.

Source: report Part I, Eq. 4.1 to 4.6; P. E. Nikravesh, Computer-Aided Analysis of
Mechanical Systems (1988), ch. 5 (kinematic) and 11 (inverse dynamic analysis).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...checks.errors import AbstractReason, ModelError, StateError, first_reason, has_values
from ...math import lapack
from ...math.compiler import kept_jit
from ...math.derivative import held_constant
from ...mechanics.joint import Motion, choose_coordinate, drive
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..formulations.augmented import (
    Augmented,
    AugmentedModel,
    evaluate_equations,
    move_bodies,
    prepare_rows,
)
from ..formulations.independence import check_inertias
from ..formulations.stabilisation import Unstabilised

_MOST_STEPS = 30
# Largest distance of a posture from its extrapolation, beyond which it is one of another branch [m] or [rad].
_MOST_CHANGE = 0.2
# Newton's steps are limited to this displacement [m] or rotation [rad].
_LONGEST_STEP = 0.1
# Singular values below this fraction of the largest count as zero.
_SINGULAR = 1e-8


class PathReason(AbstractReason):
    """Reason why a path of prescribed motion stops; the first that applies."""

    VALID = 0
    NOT_CONVERGED = 1
    SINGULAR = 2
    BRANCH = 3
    AFTER_FAILURE = 4


class KinematicPath(eqx.Module):
    """Positions, velocities and accelerations of all bodies under prescribed motion.

    Attributes:
        ts: times (k,) [s]. states: states (k, n, .), NaN after a failure.
        v_rate: accelerations, world (k, n, 3) [m/s^2]. omega_rate: body axes [rad/s^2].
        reason: codes of `PathReason` (k,).
        residual: largest constraint residual (k,).
        singular_value_ratio: ratio of the smallest to the largest singular value of the Jacobian in
            (v, omega') (k,), zero at a singularity.
    """

    ts: Float[Array, " k"]
    states: State
    v_rate: Float[Array, "k n 3"]
    omega_rate: Float[Array, "k n 3"]
    reason: Int[Array, " k"]
    residual: Float[Array, " k"]
    singular_value_ratio: Float[Array, " k"]


def add_drivers(system: System, motions: Mapping[str, Motion]) -> System:
    """System with a driver in each of the named joints, called "drive <joint>".

    Args:
        motions: functions by joint, from t [s] to its angle [rad] or displacement [m], which is
            zero at the system's reference posture.

    Raises:
        ModelError: a joint is unknown, or leaves no coordinate free, or two.
    """
    drivers = []
    for name, motion in motions.items():
        joint = system.joints[system.joint_index(name)]
        coordinate = choose_coordinate(joint, None, f"The driver in joint '{name}'")
        drivers.append(drive(f"drive {name}", joint, motion, coordinate=coordinate))
    return eqx.tree_at(lambda s: s.joints, system, (*system.joints, *drivers))


def kinematic_path(
    system: System,
    guess: State,
    ts: Float[Array, " k"],
    *,
    hold: tuple[str, ...] = (),
    tolerance: float = 1e-12,
    throw: bool = True,
) -> KinematicPath:
    """Motion that a system's drivers determine, continued along the times ts.

    Newton's method computes every posture from the one before, extrapolated by its velocities and
    accelerations. The result is accepted only if it is no further than 0.2 m or rad from the
    extrapolation and, for equal numbers of rows and unknowns, the determinant of the Jacobian
    keeps its sign: a path ends where that fails and never continues on another branch. The path
    is differentiable (implicit function theorem), and the function may be jitted.

    Args:
        guess: state near the posture at ts[0]; it determines the branch.
        hold: bodies that keep their pose of the guess.
        tolerance: bound of the residuals [m].
        throw: raise an error if the path stops, for concrete values.

    Raises:
        ModelError: the motion is not determined; says how many degrees of freedom are left.
        StateError: the path stops; says at which time and why.
    """
    check_state(system, guess)
    held_bodies = {system.index(name) for name in hold}
    free = tuple(
        6 * b + k for b in range(system.n_bodies) if b not in held_bodies for k in range(6)
    )
    times = jnp.asarray(ts, dtype=guess.r.dtype)
    path = _follow_path(system, guess, times, free, jnp.asarray(tolerance))
    if throw and has_values(path):
        _check_path(system, path, guess, free)
    return path


def _check_path(system: System, path: KinematicPath, guess: State, free: tuple[int, ...]) -> None:
    bad = np.flatnonzero(np.asarray(path.reason))
    if not len(bad):
        return
    k, code = int(bad[0]), PathReason(int(path.reason[bad[0]]))
    if code is PathReason.SINGULAR and k == 0:
        model = prepare_rows(system)
        J = evaluate_equations(model, path.ts[0], guess).matrix[:, np.array(free)]
        rank = int(np.linalg.matrix_rank(np.asarray(J), tol=_SINGULAR))
        freedom_count = len(free) - rank
        raise ModelError(
            f"The motion is not determined: {freedom_count} degree(s) of freedom are left. Give as many "
            "drivers as there are (stmuav_jax.dynamics.add_drivers), or hold a body."
        )
    explanation = {
        PathReason.NOT_CONVERGED: "no posture satisfies the joints and drivers near the one before",
        PathReason.SINGULAR: "the mechanism is in a singular posture",
        PathReason.BRANCH: "the posture belongs to another branch",
    }[code]
    raise StateError(
        f"The path stops at t = {float(path.ts[k]):.6g} s: {explanation} (largest residual "
        f"{float(path.residual[k]):.3g}, smallest singular value {float(path.singular_value_ratio[k]):.3g} of the "
        "largest). Take closer times, another path, or throw=False to keep the part before it."
    )


class _At(NamedTuple):
    """Posture on the path, with its rates and the sign of the determinant."""

    state: State
    rate: Float[Array, "n 6"]
    acceleration: Float[Array, "n 6"]
    t: Float[Array, ""]
    sign: Float[Array, ""]
    lost: Bool[Array, ""]


@kept_jit
def _follow_path(
    system: System, guess: State, ts: Any, free: tuple[int, ...], tolerance: Any
) -> KinematicPath:
    model = prepare_rows(system)
    n = system.n_bodies
    columns = np.array(free)

    def spread_columns(x: Array) -> Array:
        return jnp.zeros(6 * n, x.dtype).at[columns].set(x).reshape(n, 6)

    def next_one(at: _At, t: Array) -> tuple[_At, Any]:
        h = t - at.t
        # Extrapolation by the known rates keeps the start of Newton's method on the branch, with an error of
        # third order.
        extrapolation = h * at.rate + 0.5 * h**2 * at.acceleration
        r, p = move_bodies(at.state.r, at.state.p, extrapolation)
        posture, largest_change, residual = _close_posture(
            model, t, State(r, p, at.rate[:, :3], at.rate[:, 3:]), columns, tolerance
        )
        now, smallest, sign = _solve_rates(model, t, posture, columns, spread_columns)
        reason = first_reason(
            (at.lost, PathReason.AFTER_FAILURE),
            (~(residual <= tolerance), PathReason.NOT_CONVERGED),
            (~(smallest > _SINGULAR), PathReason.SINGULAR),
            # Branches meet where the determinant changes its sign; a change between two times is a step across.
            ((largest_change > _MOST_CHANGE) | (sign * at.sign < 0), PathReason.BRANCH),
        )
        is_accepted = reason == 0
        keep = lambda x, y: jax.tree.map(lambda a, b: jnp.where(is_accepted, a, b), x, y)
        state, rate, acceleration = keep(now, (at.state, at.rate, at.acceleration))
        hide = lambda x: jnp.where(is_accepted, x, jnp.nan)
        out = (jax.tree.map(hide, (now[0], now[2])), reason, residual, smallest)
        after = _At(
            state, rate, acceleration, t, jnp.where(is_accepted, sign, at.sign), ~is_accepted
        )
        return after, out

    none = jnp.zeros((n, 6), guess.r.dtype)
    first = _At(guess, none, none, ts[0], jnp.zeros(()), jnp.asarray(False))
    _, (path_motion, reason, residual, smallest) = jax.lax.scan(next_one, first, ts)
    states, rates = path_motion
    return KinematicPath(ts, states, rates[..., :3], rates[..., 3:], reason, residual, smallest)


def _close_posture(
    model: AugmentedModel, t: Array, start: State, columns: np.ndarray, tolerance: Any
) -> tuple[State, Array, Array]:
    """Nearest posture that satisfies all rows, the largest displacement, the largest residual."""
    n = start.r.shape[0]

    def evaluate_rows(model: AugmentedModel, t: Array, state: State) -> tuple[Array, Array]:
        eq = evaluate_equations(model, t, state)
        return eq.value, eq.matrix[:, columns]

    def solve_step(value: Array, J: Array) -> Array:
        return jnp.zeros(6 * n, value.dtype).at[columns].set(_solve_rows(J, -value)).reshape(n, 6)

    def move_posture(state: State, by: Array) -> State:
        r, p = move_bodies(state.r, state.p, by)
        return State(r, p, state.v, state.omega)

    def largest_residual(model: AugmentedModel, value: Array) -> Array:
        return jnp.max(jnp.abs(model.constraints.scales() * value), initial=0.0)

    fixed, t_fixed, begin = held_constant((model, t, start))
    # stopped once more on the results: a driver's function may hold traced numbers of its own
    constant_rows = lambda state: jax.lax.stop_gradient(evaluate_rows(fixed, t_fixed, state))

    def is_open(now: tuple[State, Array, Array]) -> Array:
        return (now[2] < _MOST_STEPS) & (now[1] > tolerance)

    def newton_step(now: tuple[State, Array, Array]) -> tuple[State, Array, Array]:
        by = solve_step(*constant_rows(now[0]))
        by = by * jnp.minimum(1.0, _LONGEST_STEP / jnp.maximum(jnp.max(jnp.abs(by)), 1e-300))
        new = move_posture(now[0], by)
        return new, largest_residual(fixed, constant_rows(new)[0]), now[2] + 1

    worst = largest_residual(fixed, constant_rows(begin)[0])
    state, _, _ = jax.lax.while_loop(is_open, newton_step, (begin, worst, jnp.asarray(0)))
    # one more step, with the derivatives that the iteration does not propagate
    value, J = evaluate_rows(model, t, state)
    state = move_posture(state, solve_step(value, jax.lax.stop_gradient(J)))
    residual = largest_residual(model, evaluate_rows(model, t, state)[0])
    translations = jnp.abs(state.r - start.r)
    rotation_angles = 2 * jnp.sqrt(
        jnp.maximum(0.0, 2 * (1 - jnp.abs(jnp.sum(state.p * start.p, axis=1))))
    )
    largest_change = jnp.maximum(jnp.max(translations), jnp.max(rotation_angles))
    return state, largest_change, residual


def _solve_rows(J: Float[Array, "m k"], b: Float[Array, " m"]) -> Float[Array, " k"]:
    """Least-squares solution of J x = b, of minimum norm if J does not determine it."""
    return lapack.pseudoinverse(J, 1e-12) @ b


def _solve_rates(
    model: AugmentedModel, t: Array, state: State, columns: np.ndarray, spread: Any
) -> tuple[tuple[State, Array, Array], Array, Array]:
    """State with velocities, rates and accelerations; smallest singular value; sign of det J."""

    def evaluate_level(state: State) -> Any:
        eq = evaluate_equations(model, t, state)
        return eq, eq.matrix[:, columns]

    eq, J = evaluate_level(state)
    # Positions, velocities and accelerations share one Jacobian: J u = target, J a = gamma.
    u = spread(_solve_rows(J, eq.target))
    moving = State(state.r, state.p, u[:, :3], u[:, 3:])
    a = spread(_solve_rows(J, evaluate_level(moving)[0].gamma))
    # A check needs no derivative, and that of equal singular values does not exist.
    values = lapack.singular_values(jax.lax.stop_gradient(J))
    enough = J.shape[0] >= J.shape[1]
    smallest = values[-1] / values[0] if enough else jnp.zeros(())
    square = J.shape[0] == J.shape[1]
    sign = lapack.sign_of_determinant(J) if square else jnp.zeros(())
    return (moving, u, a), smallest, sign


def driver_efforts(system: System, states: State, ts: Float[Array, " k"]) -> dict[str, Array]:
    """Effort of every driver along a motion, by the driver's name: (k,) [N] or [N m].

    It acts on body j of the driven joint and with the opposite sign on body i, in the direction
    of the coordinate, like that of `JointEffort`. The function is pure: it may be jitted and
    differentiated.

    Args:
        states: states that satisfy joints and drivers (k, n, .), from `simulate`, `integrate` or
            `kinematic_path`. ts: their times [s].

    Raises:
        ModelError: the system has no drivers, or its inertias are too far apart.
    """
    drivers = {j.name: k for k, j in enumerate(system.joints) if j.kind.startswith("drive_")}
    if not drivers:
        raise ModelError(
            "The system has no drivers: add them with stmuav_jax.dynamics.add_drivers."
        )
    # Efforts of drivers are multipliers, which the joint-coordinate formulation eliminates.
    formulation = Augmented()
    check_inertias(system, jax.tree.map(lambda x: x[0], states))
    model = formulation.prepare(system)
    owner = list(model.constraints.owner)

    def multipliers_at(state: State, t: Array) -> Array:
        return formulation.accelerations(model, t, state, Unstabilised()).multipliers

    multipliers = jax.vmap(multipliers_at)(states, jnp.asarray(ts, dtype=states.r.dtype))
    return {name: multipliers[:, owner.index(k)] for name, k in drivers.items()}
