"""Evaluation of single states: accelerations, reactions, energy, momentum and residuals."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import in_blocks, kept_jit
from ..checks.numbers import as_jax
from ..checks.shapes import Numbers
from ..mechanics.internal import with_internal
from ..mechanics.load import Load, no_load
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .conserved import energy, momentum
from .formulations.augmented import Augmented, AugmentedModel
from .formulations.base import AbstractFormulation, Accelerations, Reactions
from .formulations.reactions import Frame, in_joint_axes
from .formulations.stabilisation import Unstabilised
from .integration.problem import at_internal


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

    residuals: Float[Array, " m"]
    rates: Float[Array, " m"]
    matrix: Float[Array, "m k"]
    gamma: Float[Array, " m"]
    finite_loads: Bool[Array, " forces"]
    wrenches: Float[Array, "n 6"]


class Saved(NamedTuple):
    """Times (k,) [s], states (k, n, .) and actuator states of the forces (k, m) of a run."""

    ts: Any
    states: State
    internal: Any


@kept_jit
def _dynamics(
    formulation: AbstractFormulation, model: Any, saved: Saved, reacting: bool
) -> tuple[Accelerations, Reactions | None]:
    def one(at: Saved) -> tuple[Accelerations, Reactions | None]:
        here = at_internal(model, at.internal) if at.internal.shape[0] else model
        found = formulation.accelerations(here, at.ts, at.states, Unstabilised())
        return found, formulation.reactions(here, at.ts, at.states, found) if reacting else None

    return jax.lax.map(one, saved)


@kept_jit
def _balances(system: System, saved: Saved) -> Balances:
    def one(at: Saved) -> Balances:
        here = with_internal(system, at.internal)
        now = energy(here, at.states, at.ts)
        return Balances(now.kinetic, now.potential, momentum(here, at.states))

    return jax.lax.map(one, saved)


@kept_jit
def _rows(model: AugmentedModel, saved: Saved) -> RowsAt:
    def one(at: Saved) -> RowsAt:
        system, state = with_internal(model.system, at.internal), at.states
        kin = system.kinematics(state)
        eq = model.constraints.equations(at.ts, kin)
        scale = model.constraints.scales()
        u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        loads = [force.load(at.ts, kin) for force in system.forces]
        finite = [jnp.all(jnp.isfinite(x.force)) & jnp.all(jnp.isfinite(x.moment)) for x in loads]
        fine = jnp.stack(finite) if finite else jnp.zeros((0,), bool)
        off = scale * (eq.matrix @ u - eq.target)
        total = sum(loads, start=no_load(kin))
        wrenches = jnp.concatenate([total.force, total.moment], axis=1)[:-1]
        return RowsAt(scale * eq.value, off, eq.matrix, eq.gamma, fine, wrenches)

    return jax.lax.map(one, saved)


# One block size for the initial state and for all saved states: one compilation serves both.
_BLOCK = 32


def _in_blocks(function: Callable[[Saved], Any], saved: Saved) -> Any:
    return in_blocks(lambda *at: function(Saved(*jax.tree.map(as_jax, at))), _BLOCK, *saved)


def snapshots(formulation: AbstractFormulation, model: Any, saved: Saved) -> Snapshot:
    """`Snapshot`s of saved states, as NumPy arrays stacked along the first axis.

    The accelerations are those of the formulation, without stabilisation.

    Args:
        model: system prepared for the formulation.
    """
    found = _in_blocks(lambda at: _dynamics(formulation, model, at, True), saved)
    now = balances(model.system, saved)
    return Snapshot(found[0], found[1], now.kinetic, now.potential, now.momentum)


def reactions(formulation: AbstractFormulation, model: Any, saved: Saved) -> Reactions:
    """Reactions of saved states, as those of `snapshots` and by their program."""
    return _in_blocks(lambda at: _dynamics(formulation, model, at, True), saved)[1]


def accelerations(formulation: AbstractFormulation, model: Any, saved: Saved) -> Accelerations:
    """Accelerations of saved states by a formulation, as those of `snapshots`."""
    return _in_blocks(lambda at: _dynamics(formulation, model, at, False), saved)[0]


def balances(system: System, saved: Saved) -> Balances:
    """`Balances` of saved states, as NumPy arrays stacked along the first axis."""
    return _in_blocks(lambda at: _balances(system, at), saved)


def rows_at(model: AugmentedModel, saved: Saved) -> RowsAt:
    """`RowsAt` of saved states, as NumPy arrays stacked along the first axis.

    Args:
        model: system prepared for maximal coordinates, with the rows of all joints.
    """
    return _in_blocks(lambda at: _rows(model, at), saved)


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
