"""Evaluation of single states: accelerations, reactions, energy, momentum and residuals."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.numbers import as_jax
from ..checks.shapes import Numbers
from ..math.compiler import in_blocks, kept_jit
from ..math.native.program import native
from ..mechanics.body import check_bodies
from ..mechanics.internal import internal_states, with_internal
from ..mechanics.load import Load, no_load
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .formulations.augmented import Augmented, AugmentedModel
from .formulations.base import (
    AbstractFormulation,
    Accelerations,
    Frame,
    Reactions,
    in_joint_axes,
)
from .formulations.independence import check_inertias
from .formulations.stabilisation import Unstabilised
from .integration.problem import at_internal


class Energy(eqx.Module):
    """Kinetic and potential energy [J], each of shape ()."""

    kinetic: Float[Array, ""]
    potential: Float[Array, ""]

    @property
    def total(self) -> Float[Array, ""]:
        """Total energy, kinetic plus potential [J]."""
        return self.kinetic + self.potential


def energy(system: System, state: State, t: Float[Array, ""]) -> Energy:
    """Energy at one state, with the potential of conservative forces (gravity, springs)."""
    kin = system.kinematics(state)
    bodies = system.bodies
    # In body axes, in which inertia tensors are constant: no rotation is needed.
    spin = jnp.einsum("na,nab,nb->", state.omega, bodies.inertia, state.omega)
    kinetic = 0.5 * (jnp.sum(bodies.mass[:, None] * state.v**2) + spin)
    loads = [force.load(t, kin).potential for force in system.forces]
    return Energy(kinetic, sum(loads, start=jnp.zeros_like(kinetic)))


def momentum(system: System, state: State) -> Float[Array, "6"]:
    """Linear momentum [N s], then angular momentum about the world's origin [N m s], (6,)."""
    kin = system.kinematics(state)
    linear = system.bodies.mass[:, None] * state.v
    spin = jnp.einsum("nab,nbc,nc->na", kin.R_wb[:-1], system.bodies.inertia, state.omega)
    angular = jnp.cross(state.r, linear) + spin
    return jnp.concatenate([jnp.sum(linear, axis=0), jnp.sum(angular, axis=0)])


class Snapshot(eqx.Module):
    """Quantities of a system at one state and time, or stacked along leading axes.

    Attributes:
        accelerations: accelerations and Lagrange multipliers.
        reactions: reactions at every joint, world axes.
        kinetic, potential: energies [J].
        momentum: linear and angular momentum about the world's origin (6,).
    """

    accelerations: Accelerations
    reactions: Reactions
    kinetic: Float[Array | np.ndarray, "*k"]
    potential: Float[Array | np.ndarray, "*k"]
    momentum: Float[Array | np.ndarray, "*k 6"]


class Balances(NamedTuple):
    """Energies [J] and momentum (6,) at one state; see `Snapshot`."""

    kinetic: Float[Array, ""]
    potential: Float[Array, ""]
    momentum: Float[Array, "6"]


class RowsAt(NamedTuple):
    """Constraint rows of all joints and loads of all force elements at one state.

    Attributes:
        residuals: scaled position residual of every row (m,) [m], or [rad] for cosines and angles.
        rates: scaled velocity residual of every row (m,) [m/s] or [rad/s].
        matrix: constraint Jacobian in (v, omega') (m, 6 n). gamma: right-hand side of its
            rows for accelerations (m,).
        finite_loads: true for each force element whose load is finite.
        wrenches: sum of all loads on every body (n, 6), force [N] in world axes at the mass centre and
            moment [N m] in body axes.
    """

    residuals: Any
    rates: Any
    matrix: Any
    gamma: Any
    finite_loads: Any
    wrenches: Any


class Saved(NamedTuple):
    """Times (k,) [s], states (k, n, .) and actuator states of the forces (k, m) of a run."""

    ts: Any
    states: State
    internal: Any


@kept_jit
def _evaluate_dynamics(
    formulation: AbstractFormulation, model: Any, saved: Saved, reacting: bool
) -> tuple[Accelerations, Reactions | None]:
    # One state after the other and not all at once: saved states are many, and a batch of all
    # would take memory in proportion.
    return jax.lax.map(lambda at: _get_dynamics(formulation, model, at, reacting), saved)


@native
def _get_dynamics(
    formulation: AbstractFormulation, model: Any, at: Saved, reacting: bool
) -> tuple[Accelerations, Reactions | None]:
    current_model = at_internal(model, at.internal) if at.internal.shape[0] else model
    accelerations = formulation.accelerations(current_model, at.ts, at.states, Unstabilised())
    if not reacting:
        return accelerations, None
    return accelerations, formulation.reactions(current_model, at.ts, at.states, accelerations)


@kept_jit
def _evaluate_balances(system: System, saved: Saved) -> Balances:
    def balances_at(at: Saved) -> Balances:
        current_system = with_internal(system, at.internal)
        now = energy(current_system, at.states, at.ts)
        return Balances(now.kinetic, now.potential, momentum(current_system, at.states))

    return jax.lax.map(balances_at, saved)


@kept_jit
def _evaluate_rows(model: AugmentedModel, saved: Saved) -> RowsAt:
    return jax.lax.map(lambda at: _get_rows(model, at), saved)


@native
def _get_rows(model: AugmentedModel, at: Saved) -> RowsAt:
    system, state = with_internal(model.system, at.internal), at.states
    kin = system.kinematics(state)
    eq = model.constraints.equations(at.ts, kin)
    # Angles and lengths in one unit, so that one tolerance holds for all residuals.
    scale = model.constraints.scales()
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    loads = [force.load(at.ts, kin) for force in system.forces]
    finite = [jnp.all(jnp.isfinite(x.force)) & jnp.all(jnp.isfinite(x.moment)) for x in loads]
    finite_mask = jnp.stack(finite) if finite else jnp.zeros((0,), bool)
    rate_residuals = scale * (eq.matrix @ u - eq.target)
    # Loads are evaluated apart first: a message can name the force element that is not finite.
    total = sum(loads, start=no_load(kin))
    wrenches = jnp.concatenate([total.force, total.moment], axis=1)[:-1]
    return RowsAt(scale * eq.value, rate_residuals, eq.matrix, eq.gamma, finite_mask, wrenches)


# One block size for the initial state and for all saved states: one compilation serves both.
_BLOCK = 32


def _in_blocks(function: Callable[[Saved], Any], saved: Saved) -> Any:
    return in_blocks(lambda *at: function(Saved(*jax.tree.map(as_jax, at))), _BLOCK, *saved)


def evaluate_snapshots(formulation: AbstractFormulation, model: Any, saved: Saved) -> Snapshot:
    """`Snapshot`s of saved states, as NumPy arrays stacked along the first axis.

    The accelerations are those of the formulation, without stabilisation.

    Args:
        model: system prepared for the formulation.
    """
    dynamics = _in_blocks(lambda at: _evaluate_dynamics(formulation, model, at, True), saved)
    now = balances(model.system, saved)
    return Snapshot(dynamics[0], dynamics[1], now.kinetic, now.potential, now.momentum)


def evaluate_reactions(formulation: AbstractFormulation, model: Any, saved: Saved) -> Reactions:
    """Reactions of saved states, as those of `evaluate_snapshots` and by their program."""
    return _in_blocks(lambda at: _evaluate_dynamics(formulation, model, at, True), saved)[1]


def evaluate_accelerations(
    formulation: AbstractFormulation, model: Any, saved: Saved
) -> Accelerations:
    """Accelerations of saved states by a formulation, as those of `evaluate_snapshots`."""
    return _in_blocks(lambda at: _evaluate_dynamics(formulation, model, at, False), saved)[0]


def balances(system: System, saved: Saved) -> Balances:
    """`Balances` of saved states, as NumPy arrays stacked along the first axis."""
    return _in_blocks(lambda at: _evaluate_balances(system, at), saved)


def rows_at(model: AugmentedModel, saved: Saved) -> RowsAt:
    """`RowsAt` of saved states, as NumPy arrays stacked along the first axis.

    Args:
        model: system prepared for maximal coordinates, with the rows of all joints.
    """
    return _in_blocks(lambda at: _evaluate_rows(model, at), saved)


def rows_of(model: AugmentedModel, states: State, t: float) -> RowsAt:
    """`RowsAt` as of `rows_at`, at postures (k, n, .) of one time [s], with the forces' own states."""
    count, internal = len(states.r), np.asarray(internal_states(model.system))
    internal_by_posture = np.tile(internal, (count, 1))
    states = jax.tree.map(np.asarray, states)
    return jax.tree.map(
        np.asarray, rows_at(model, Saved(np.full(count, t), states, internal_by_posture))
    )


def singular_values(rows: RowsAt) -> Float[np.ndarray, "k s"]:
    """Singular values of the constraint Jacobians of stacked rows, descending."""
    if not rows.gamma.shape[-1]:
        return np.asarray(rows.gamma)
    return np.linalg.svd(rows.matrix, compute_uv=False)


class Evaluation(eqx.Module):
    """Accelerations, multipliers and joint reactions at one state; see `evaluate`."""

    accelerations: Accelerations
    reactions: Reactions


def evaluate(
    system: System,
    state: State,
    t: Numbers = 0.0,
    *,
    formulation: AbstractFormulation | None = None,
    load: Load | None = None,
    frame: Frame = "world",
) -> Evaluation:
    """Accelerations, Lagrange multipliers and joint reactions at one given state and load.

    The function is pure: it may be jitted, vmapped and differentiated.

    Args:
        state: state that satisfies the joints, unbatched.
        t: time [s].
        formulation: default `Augmented()`, which has a multiplier for every constraint row;
            `Tree()` has them for the loop-closing joints' rows only.
        load: load that is added to the system's own forces; see `stmuav_jax.mechanics.Load`.
        frame: axes of the reactions: "world", or "joint" for the joint's frame in body i.

    Raises:
        SettingError: shapes or precision of the state do not fit the system.
        ModelError: a mass or a tensor of inertia that no body can have, or inertias so far apart that
            `Augmented` would lose the accelerations to round-off.
    """
    check_state(system, state)
    check_bodies(system.bodies)
    if load is not None:
        # A given load joins the system as one more force element, and the equations need no case for it.
        system = eqx.tree_at(lambda s: s.forces, system, (*system.forces, _ConstantLoad(load)))
    formulation = formulation if formulation is not None else Augmented()
    if isinstance(formulation, Augmented):
        check_inertias(system, state)
    model: Any = formulation.prepare(system)
    time = jnp.asarray(t, dtype=state.r.dtype)
    result = formulation.accelerations(model, time, state, Unstabilised())
    reactions = formulation.reactions(model, time, state, result)
    if frame == "joint":
        reactions = in_joint_axes(system, state, reactions)
    return Evaluation(result, reactions)


class _ConstantLoad(eqx.Module):
    """Force element with a given load."""

    load_value: Load

    def load(self, t: Array, kin: Any) -> Load:
        del t, kin
        return self.load_value
