"""Maximal coordinates with Lagrange multipliers, solved by the structure of the equations.

With m constraint rows B in (v, omega'), W = diag(1/m_i, J'_i^-1) and g6 = (f_i, n'_i - omega' x J' omega'),

    (B W B^T) lambda = gamma# - B W g6,  (vdot, omega'dot) = W (g6 + B^T lambda).

Source: report Part I, Eq. 4.19 (Part II, Eq. 4.23 and 4.27), corrected, without its Euler parameters.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...checks.numbers import as_jax, as_numpy
from ...math import lapack
from ...math.compiler import remember_results
from ...math.linalg import (
    Factor,
    MinimumNorm,
    factor_cholesky,
    factor_minimum_norm,
    share_multipliers,
)
from ...math.native.program import native
from ...math.rotation import euler_parameter_rate, from_rotation_vector, normalise, product
from ...mechanics.load import Load, total_load
from ...mechanics.state import Kinematics, State
from ...mechanics.system import System
from .base import (
    AbstractFormulation,
    AbstractModel,
    Accelerations,
    Flows,
    Reactions,
    Residuals,
    joint_reactions,
    residuals_of,
)
from .constraints import Constraints, Equations, group_constraints
from .independence import find_independent_rows, turn_rows
from .stabilisation import AbstractStabilisation


class AugmentedModel(AbstractModel):
    """System prepared for maximal coordinates.

    Attributes:
        row_mask: mask of the rows that the equations hold, if others depend on them in every posture, with
            those of points in the axes of body i; else None. See `independence`.
    """

    system: System
    constraints: Constraints
    inverse_inertia: Float[Array, "n 3 3"]
    row_mask: Bool[Array, " m"] | None = None

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        """Sum of the loads of all force elements."""
        return total_load(self.system.forces, t, kin)

    def weigh(self, rows: Float[Array, "m n 6"]) -> Float[Array, "m n 6"]:
        """Product rows @ W, with W the inverse of the block-diagonal mass matrix."""
        # The mass matrix is block diagonal in (v, omega') with constant blocks: its inverse is found once and
        # applied body by body.
        linear = rows[..., :3] / self.system.bodies.mass[None, :, None]
        angular = jnp.einsum("mna,nab->mnb", rows[..., 3:], self.inverse_inertia)
        return jnp.concatenate([linear, angular], axis=-1)


class Augmented(AbstractFormulation):
    """Formulation of the report: coordinates of all bodies and one multiplier per constraint row.

    Args:
        redundant: allow rows to become dependent in some postures. Rows that depend on others in
            every posture are left out by `prepare` in any case. The multipliers of `accelerations`
            have minimum norm.
        rcond: with `redundant`, singular values of the scaled system below rcond times the largest
            count as zero.
    """

    redundant: bool = eqx.field(static=True, default=False)
    rcond: float = eqx.field(static=True, default=1e-11)

    def __str__(self) -> str:
        return f"Augmented(redundant={self.redundant})"

    def allowing_dependent_rows(self) -> "Augmented":
        return self if self.redundant else dataclasses.replace(self, redundant=True)

    @remember_results
    def prepare(self, system: System) -> AugmentedModel:
        row_mask = find_independent_rows(system).rows
        row_mask = None if row_mask is None else as_jax(row_mask)
        return dataclasses.replace(prepare_rows(system), row_mask=row_mask)

    def vector_size(self, model: AugmentedModel) -> int:
        return 13 * model.system.n_bodies

    def to_vector(self, model: AugmentedModel, state: State) -> Float[Array, " k"]:
        return jnp.concatenate([x.reshape(-1) for x in (state.r, state.p, state.v, state.omega)])

    def to_state(self, model: AugmentedModel, x: Float[Array, " k"]) -> State:
        n = model.system.n_bodies
        r, p, v, omega = (
            x[a * n : b * n].reshape(n, -1) for a, b in ((0, 3), (3, 7), (7, 10), (10, 13))
        )
        return State(r, p, v, omega)

    def accelerations(
        self,
        model: AugmentedModel,
        t: Float[Array, ""],
        state: State,
        stabilisation: AbstractStabilisation,
    ) -> Accelerations:
        kin = model.system.kinematics(state)
        load = model.load(t, kin)
        return self._solve_accelerations(model, t, kin, load, stabilisation, shared=True)[0]

    def reactions(
        self, model: AugmentedModel, t: Float[Array, ""], state: State, result: Accelerations
    ) -> Reactions:
        return joint_reactions(model.system, model.constraints, t, state, result.multipliers)

    def derivative(
        self,
        model: AugmentedModel,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Float[Array, " k"], Flows]:
        state = self.to_state(model, x)
        kin = model.system.kinematics(state)
        load = model.load(t, kin)
        result, target = self._solve_accelerations(model, t, kin, load, stabilisation)
        # Angular velocities are the velocities, and not the rates of Euler parameters: the norm constraint
        # then needs no multiplier, and the system has 34 rows instead of 83.
        p_rate = jax.vmap(euler_parameter_rate)(state.p, state.omega)
        p_rate = stabilisation.add_norm_feedback(p_rate.T, state.p.T).T
        rates = State(r=state.v, p=p_rate, v=result.v_rate, omega=result.omega_rate)
        moment = jnp.cross(kin.r, load.force) + jnp.einsum("nab,nb->na", kin.R_wb, load.moment)
        flows = Flows(
            power=load.power + result.multipliers @ target,
            force=jnp.sum(load.force[:-1], axis=0),
            moment=jnp.sum(moment[:-1], axis=0),
        )
        return self.to_vector(model, rates), flows

    def _solve_accelerations(
        self,
        model: AugmentedModel,
        t: Float[Array, ""],
        kin: Kinematics,
        load: Load,
        stabilisation: AbstractStabilisation,
        *,
        shared: bool = False,
    ) -> tuple[Accelerations, Float[Array, " m"]]:
        """Accelerations and targets; the multipliers are those of all rows if they are `shared`."""
        inertia, omega = model.system.bodies.inertia, kin.omega[:-1]
        spin = jnp.einsum("nab,nb->na", inertia, omega)
        moment = load.moment[:-1] - jnp.cross(omega, spin)
        # Accelerations without constraints plus a correction by the multipliers (Gauss's principle): only the
        # m x m system is solved.
        free_v = load.force[:-1] / model.system.bodies.mass[:, None]
        free_omega = jnp.einsum("nab,nb->na", model.inverse_inertia, moment)
        if not model.constraints.n_rows:
            none = jnp.zeros((0,), kin.r.dtype)
            return Accelerations(free_v, free_omega, none), none
        # All rows are evaluated even if some are left out, since their residuals are monitored along the run.
        every = model.constraints.equations(t, kin)
        eq = held_equations(model, every, kin)
        velocity = jnp.concatenate([kin.v[:-1], omega], axis=1).reshape(-1)
        free = jnp.concatenate([free_v, free_omega], axis=1)
        weighed = model.weigh(eq.J).reshape(eq.matrix.shape)
        factor = self._factor_rows(model, eq, weighed)
        gamma = stabilisation.add_row_feedback(eq.gamma, eq.value, eq.matrix @ velocity - eq.target)
        multipliers = factor.solve(gamma - eq.matrix @ free.reshape(-1))
        total = free + (weighed.T @ multipliers).reshape(-1, 6)
        accelerations = Accelerations(total[:, :3], total[:, 3:], multipliers)
        if shared and (self.redundant or model.row_mask is not None):
            accelerations = self._share_multipliers(
                model, every, kin, weighed, factor, accelerations
            )
        return accelerations, eq.target

    def _share_multipliers(
        self,
        model: AugmentedModel,
        every: Equations,
        kin: Kinematics,
        weighed: Float[Array, "m k"],
        factor: Factor | MinimumNorm,
        accelerations: Accelerations,
    ) -> Accelerations:
        """Accelerations with multipliers of minimum norm in all rows, from those of the rows held."""
        matrix = turned_equations(model, every, kin).matrix
        shares = share_multipliers(weighed @ matrix.T, factor, accelerations.multipliers)
        return dataclasses.replace(accelerations, multipliers=turned_back(model, shares, kin))

    def _factor_rows(
        self, model: AugmentedModel, eq: Equations, weighed: Float[Array, "m k"]
    ) -> Factor | MinimumNorm:
        # J M^-1 J^T is symmetric positive definite for independent rows, which Cholesky's method uses and
        # checks.
        S = weighed @ eq.matrix.T
        if model.row_mask is not None:
            S = S + jnp.diag(1.0 - model.row_mask)
        return factor_minimum_norm(S, self.rcond) if self.redundant else Factor(factor_cholesky(S))

    def at_step(
        self, model: AugmentedModel, t: Float[Array, ""], x: Float[Array, " k"]
    ) -> AugmentedModel:
        del t, x
        return model

    def project(
        self, model: AugmentedModel, t: Float[Array, ""], x: Float[Array, " k"], iterations: int
    ) -> tuple[Float[Array, " k"], Residuals]:
        state = self.to_state(model, x)
        p = jax.vmap(normalise)(state.p)
        state = State(state.r, p, state.v, state.omega)
        if not model.constraints.n_rows:
            x = self.to_vector(model, state)
            return x, self.residuals(model, t, x)
        equations = lambda at: model.constraints.equations(t, model.system.kinematics(at))
        held_at = lambda at: held_equations(model, equations(at), model.system.kinematics(at))
        # One factorisation at the unprojected state serves all iterations: after a step the violation is of
        # the size of the tolerance.
        first = held_at(state)
        weighed = model.weigh(first.J).reshape(first.matrix.shape)
        factor = self._factor_rows(model, first, weighed)

        def newton_step(_: Any, posture: tuple[Array, Array]) -> tuple[Array, Array]:
            at = State(posture[0], posture[1], state.v, state.omega)
            step = -(weighed.T @ factor.solve(held_at(at).value)).reshape(-1, 6)
            return move_bodies(posture[0], posture[1], step)

        r, p = jax.lax.fori_loop(0, iterations, newton_step, (state.r, state.p))
        at = State(r, p, state.v, state.omega)
        eq = equations(at)
        held_eq = held_equations(model, eq, model.system.kinematics(at))
        u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        # The velocity constraints are linear; the second pass removes the error of a factor that belongs to
        # the unprojected posture.
        for _ in range(2):
            u = u - weighed.T @ factor.solve(held_eq.matrix @ u - held_eq.target)
        residuals = _compute_residuals(model, eq, p, u)
        u = u.reshape(-1, 6)
        return self.to_vector(model, State(r, p, u[:, :3], u[:, 3:])), residuals

    def residuals(
        self, model: AugmentedModel, t: Float[Array, ""], x: Float[Array, " k"]
    ) -> Residuals:
        state = self.to_state(model, x)
        u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        eq = model.constraints.equations(t, model.system.kinematics(state))
        return _compute_residuals(model, eq, state.p, u)


def _compute_residuals(
    model: AugmentedModel, eq: Equations, p: Float[Array, "n 4"], u: Float[Array, " k"]
) -> Residuals:
    norm = jnp.max(jnp.abs(jnp.sum(p**2, axis=1) - 1))
    return residuals_of(model.constraints, eq.value, eq.matrix @ u - eq.target, norm)


@native
def evaluate_equations(model: AugmentedModel, t: Float[Array, ""], state: State) -> Equations:
    """Equations of all rows at a time [s] and state."""
    return model.constraints.equations(t, model.system.kinematics(state))


@remember_results
def prepare_rows(system: System) -> AugmentedModel:
    """System prepared for its constraint rows, of which none is left out of the equations."""
    inertia = as_numpy(system.bodies.inertia)
    # NumPy's compiles nothing
    invert: Any = np.linalg.inv if isinstance(inertia, np.ndarray) else lapack.inverse
    return AugmentedModel(system, group_constraints(system), as_jax(invert(inertia)))


def turned_equations(model: AugmentedModel, eq: Equations, kin: Kinematics) -> Equations:
    """Equations with the rows of points in the axes of body i, where some rows are left out."""
    if model.row_mask is None:
        return eq
    R = jnp.moveaxis(kin.R_wb, 0, -1)
    rotate_rows = lambda x: turn_rows(model.constraints, R, x)
    return Equations(rotate_rows(eq.value), eq.target, rotate_rows(eq.J), rotate_rows(eq.gamma))


def held_equations(model: AugmentedModel, eq: Equations, kin: Kinematics) -> Equations:
    """`turned_equations` with zeros in the place of rows that are left out."""
    row_mask = model.row_mask
    if row_mask is None:
        return eq
    mask_rows = lambda x: jnp.where(row_mask.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0)
    return jax.tree.map(mask_rows, turned_equations(model, eq, kin))


def turned_back(
    model: AugmentedModel, multipliers: Float[Array, " m"], kin: Kinematics
) -> Float[Array, " m"]:
    """Multipliers of the rows as they are, from those of `turned_equations`."""
    if model.row_mask is None:
        return multipliers
    return turn_rows(model.constraints, jnp.moveaxis(kin.R_wb, 0, -1), multipliers, back=True)


def move_bodies(
    r: Float[Array, "n 3"], p: Float[Array, "n 4"], step: Float[Array, "n 6"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 4"]]:
    """Displace bodies by world translations [m] and body-frame rotation vectors [rad]."""
    orientations = jax.vmap(lambda a, s: normalise(product(a, from_rotation_vector(s))))(
        p, step[:, 3:]
    )
    return r + step[:, :3], orientations
