"""Evaluation of single states: accelerations, reactions, energy, momentum and residuals."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import in_blocks, kept_jit
from ..checks.numbers import as_jax
from ..checks.shapes import Numbers
from ..mechanics.load import Load
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .conserved import energy, momentum
from .formulations.augmented import Augmented, Model
from .formulations.base import AbstractFormulation, Accelerations, Reactions
from .formulations.reactions import Frame, in_joint_axes
from .formulations.stabilisation import Unstabilised
from .integration.problem import at_internal


class Snapshot(eqx.Module):
    """Quantities of a system at one state and time.

    Attributes:
        accelerations: accelerations and Lagrange multipliers.
        reactions: reactions at every joint, world axes.
        kinetic, potential: energies [J].
        momentum: linear and angular momentum about the world's origin (6,).
        residuals: scaled position residual of every row (m,) [m], or [rad] for cosines and angles.
        rates: scaled velocity residual of every row (m,) [m/s] or [rad/s].
        singular_values: those of the constraint Jacobian in (v, omega'), descending.
        acceleration_residual: largest |J qddot - gamma|; non-zero for contradictory rows.
        finite_loads: true for each force element whose load is finite.
    """

    accelerations: Accelerations
    reactions: Reactions
    kinetic: Float[Array, ""]
    potential: Float[Array, ""]
    momentum: Float[Array, "6"]
    residuals: Float[Array, " m"]
    rates: Float[Array, " m"]
    singular_values: Float[Array, " s"]
    acceleration_residual: Float[Array, ""]
    finite_loads: Bool[Array, " forces"]


def snapshot(
    formulation: AbstractFormulation, model: Any, rows: Model, t: Float[Array, ""], state: State
) -> Snapshot:
    """Evaluate one state through a formulation, without stabilisation.

    Args:
        model: system prepared for the formulation. rows: system prepared for maximal
            coordinates, with the rows of all joints.
    """
    system = rows.system
    result = formulation.accelerations(model, t, state, Unstabilised())
    kin = system.kinematics(state)
    eq = rows.constraints.equations(t, kin)
    scale = rows.constraints.scales()
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    u_rate = jnp.concatenate([result.v_rate, result.omega_rate], axis=1).reshape(-1)
    loads = [force.load(t, kin) for force in system.forces]
    finite = [jnp.all(jnp.isfinite(x.force)) & jnp.all(jnp.isfinite(x.moment)) for x in loads]
    values = jnp.linalg.svd(eq.matrix, compute_uv=False) if eq.gamma.size else eq.gamma
    now = energy(system, state, t)
    return Snapshot(
        accelerations=result,
        reactions=formulation.reactions(model, t, state, result),
        kinetic=now.kinetic,
        potential=now.potential,
        momentum=momentum(system, state),
        residuals=scale * eq.value,
        rates=scale * (eq.matrix @ u - eq.target),
        singular_values=values,
        acceleration_residual=jnp.max(jnp.abs(eq.matrix @ u_rate - eq.gamma), initial=0.0),
        finite_loads=jnp.stack(finite) if finite else jnp.zeros((0,), bool),
    )


@kept_jit
def _snapshots(
    formulation: AbstractFormulation, model: Any, rows: Model, ts: Any, states: State, own: Any
) -> Snapshot:
    def one(at: tuple[Array, State, Array]) -> Snapshot:
        t, state, z = at
        if not z.shape[0]:
            return snapshot(formulation, model, rows, t, state)
        return snapshot(formulation, at_internal(model, z), at_internal(rows, z), t, state)

    return jax.lax.map(one, (ts, states, own))


# One block size for the initial state and for all saved states: one compilation serves both.
_BLOCK = 32


def snapshots(
    formulation: AbstractFormulation,
    model: Any,
    rows: Model,
    ts: np.ndarray,
    states: State,
    internal: np.ndarray,
) -> Snapshot:
    """`snapshot` of k states, as NumPy arrays stacked along the first axis.

    Args:
        internal: actuator states of the forces (k, m).
    """

    def block(*at: Any) -> Snapshot:
        return _snapshots(formulation, model, rows, *jax.tree.map(as_jax, at))

    return in_blocks(block, _BLOCK, ts, states, internal)


class StartCheck(NamedTuple):
    """Quantities of the initial state that `simulate` checks; `Snapshot` describes each."""

    residuals: np.ndarray
    rates: np.ndarray
    singular_values: np.ndarray
    finite_loads: np.ndarray
    norm: float


def first_look(view: Snapshot, state: State) -> StartCheck:
    """Checked quantities from the first of stacked snapshots."""
    parts = (view.residuals, view.rates, view.singular_values, view.finite_loads)
    residuals, rates, values, finite = (np.asarray(part)[0] for part in parts)
    return StartCheck(residuals, rates, values, finite, _off_unit(state))


def look(rows: Model, state: State, t: float) -> StartCheck:
    """Checked quantities at one state, without accelerations: less to compile than a snapshot."""
    *parts, matrix = _rows_and_loads(rows, state, jnp.asarray(t, dtype=state.r.dtype))
    residuals, rates, finite = map(np.asarray, parts)
    values = np.linalg.svd(matrix, compute_uv=False) if residuals.size else residuals
    return StartCheck(residuals, rates, values, finite, _off_unit(state))


def _off_unit(state: State) -> float:
    return float(np.max(np.abs(np.sum(np.asarray(state.p) ** 2, axis=-1) - 1)))


@kept_jit
def _rows_and_loads(rows: Model, state: State, t: Any) -> tuple[Array, Array, Array, Array]:
    kin = rows.system.kinematics(state)
    eq = rows.constraints.equations(t, kin)
    scale = rows.constraints.scales()
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    loads = [force.load(t, kin) for force in rows.system.forces]
    finite = [jnp.all(jnp.isfinite(x.force)) & jnp.all(jnp.isfinite(x.moment)) for x in loads]
    fine = jnp.stack(finite) if finite else jnp.zeros((0,), bool)
    return scale * eq.value, scale * (eq.matrix @ u - eq.target), fine, eq.matrix


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
        load: load that is added to the system's own forces; see `stmuav_jax.Load`.
        frame: axes of the reactions: "world", or "joint" for the joint's frame in body i.

    Raises:
        SettingError: shapes or precision of the state do not fit the system.
    """
    check_state(system, state)
    if load is not None:
        system = eqx.tree_at(lambda s: s.forces, system, (*system.forces, _Given(load)))
    formulation = formulation if formulation is not None else Augmented()
    model: Any = formulation.prepare(system)
    time = jnp.asarray(t, dtype=state.r.dtype)
    result = formulation.accelerations(model, time, state, Unstabilised())
    reactions = formulation.reactions(model, time, state, result)
    if frame == "joint":
        reactions = in_joint_axes(system, state, reactions)
    return Evaluation(result, reactions)


class _Given(eqx.Module):
    """Force element with a given load."""

    given: Load

    def load(self, t: Array, kin: Any) -> Load:
        del t, kin
        return self.given
