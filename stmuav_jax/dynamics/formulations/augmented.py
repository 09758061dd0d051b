"""Maximal coordinates with Lagrange multipliers, solved as one dense system or by structure.

Source: report Part I, Eq. 4.19 (Part II, Eq. 4.23 and 4.27), corrected: with b bodies and m
rows, unknowns qddot (7 b) and -lambda (m),

    [ M      B^T ] [ qddot   ]   [ g - c1  ]
    [ P      0   ] [ -lambda ] = [   -c2   ]        solve="dense"
    [ Phi_q  0   ]               [ gamma^m ]

or, with W = diag(1/m_i, J'_i^-1) and g6 = (f_i, n'_i - omega' x J' omega'),

    (B W B^T) lambda = gamma# - B W g6,  (vdot, omega'dot) = W (g6 + B^T lambda)
                                                          solve="structured"
"""

import dataclasses
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra import lapack
from ...algebra.linalg import Factor, MinimumNorm, factorise, product_transposed, solve_general
from ...algebra.rotation import (
    euler_parameter_rate,
    from_rotation_vector,
    matrix_l,
    normalise,
    product,
)
from ...checks.numbers import as_jax, as_numpy
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
    residuals_of,
)
from .constraints import Constraints, Equations, RowChoice, constraints
from .reactions import joint_reactions
from .stabilisation import AbstractStabilisation


class AugmentedModel(AbstractModel):
    """System prepared for maximal coordinates."""

    system: System
    constraints: Constraints
    inverse_inertia: Float[Array, "n 3 3"]

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        """Sum of the loads of all force elements."""
        return total_load(self.system.forces, t, kin)

    def weigh(self, rows: Float[Array, "m n 6"]) -> Float[Array, "m n 6"]:
        """Product rows @ W, with W the inverse of the block-diagonal mass matrix."""
        linear = rows[..., :3] / self.system.bodies.mass[:, None]
        angular = jnp.einsum("mna,nab->mnb", rows[..., 3:], self.inverse_inertia)
        return jnp.concatenate([linear, angular], axis=-1)


class Augmented(AbstractFormulation):
    """Formulation of the report: coordinates of all bodies and one multiplier per constraint row.

    Args:
        solve: "structured" (default) or "dense", the report's single large system.
        rows: "body" (default) or "report", the report's cross products with two of three
            rows chosen at every evaluation.
        redundant: allow dependent rows; the multipliers then have minimum norm.
        rcond: with `redundant`, singular values below rcond times the largest count as zero.
    """

    solve: Literal["structured", "dense"] = eqx.field(static=True, default="structured")
    rows: RowChoice = eqx.field(static=True, default="body")
    redundant: bool = eqx.field(static=True, default=False)
    rcond: float = eqx.field(static=True, default=1e-11)

    def __str__(self) -> str:
        return f"Augmented(solve={self.solve}, rows={self.rows}, redundant={self.redundant})"

    def allowing_dependent_rows(self) -> "Augmented":
        return self if self.redundant else dataclasses.replace(self, redundant=True)

    def prepare(self, system: System) -> AugmentedModel:
        inertia = as_numpy(system.bodies.inertia)
        # NumPy's compiles nothing
        invert = np.linalg.inv if isinstance(inertia, np.ndarray) else lapack.inverse
        return AugmentedModel(system, constraints(system, self.rows), as_jax(invert(inertia)))

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
        return self._accelerate(model, t, state.p, kin, load, stabilisation)[0]

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
        result, target = self._accelerate(model, t, state.p, kin, load, stabilisation)
        p_rate = jax.vmap(euler_parameter_rate)(state.p, state.omega)
        p_rate = stabilisation.held_norms(p_rate.T, state.p.T).T
        rates = State(r=state.v, p=p_rate, v=result.v_rate, omega=result.omega_rate)
        moment = jnp.cross(kin.r, load.force) + jnp.einsum("nab,nb->na", kin.R_wb, load.moment)
        flows = Flows(
            power=load.power + result.multipliers @ target,
            force=jnp.sum(load.force[:-1], axis=0),
            moment=jnp.sum(moment[:-1], axis=0),
        )
        return self.to_vector(model, rates), flows

    def _accelerate(
        self,
        model: AugmentedModel,
        t: Float[Array, ""],
        p: Float[Array, "n 4"],
        kin: Kinematics,
        load: Load,
        stabilisation: AbstractStabilisation,
    ) -> tuple[Accelerations, Float[Array, " m"]]:
        inertia, omega = model.system.bodies.inertia, kin.omega[:-1]
        spin = jnp.einsum("nab,nb->na", inertia, omega)
        moment = load.moment[:-1] - jnp.cross(omega, spin)
        if self.solve == "dense":
            return self._dense(model, t, p, kin, load.force[:-1], moment, stabilisation)
        free_v = load.force[:-1] / model.system.bodies.mass[:, None]
        free_omega = jnp.einsum("nab,nb->na", model.inverse_inertia, moment)
        if not model.constraints.n_rows:
            none = jnp.zeros((0,), kin.r.dtype)
            return Accelerations(free_v, free_omega, none), none
        eq = model.constraints.equations(t, kin)
        velocity = jnp.concatenate([kin.v[:-1], omega], axis=1).reshape(-1)
        free = jnp.concatenate([free_v, free_omega], axis=1)
        weighed = model.weigh(eq.J).reshape(eq.matrix.shape)
        factor = self._factor(eq, weighed)
        gamma = _corrected(eq, velocity, stabilisation)
        multipliers = factor.solve(gamma - eq.matrix @ free.reshape(-1))
        total = free + (weighed.T @ multipliers).reshape(-1, 6)
        return Accelerations(total[:, :3], total[:, 3:], multipliers), eq.target

    def _factor(self, eq: Equations, weighed: Float[Array, "m k"]) -> Factor | MinimumNorm:
        S = product_transposed(weighed, eq.matrix)
        return factorise(S, redundant=self.redundant, rcond=self.rcond)

    def _dense(
        self,
        model: AugmentedModel,
        t: Float[Array, ""],
        p: Float[Array, "n 4"],
        kin: Kinematics,
        force: Float[Array, "n 3"],
        moment: Float[Array, "n 3"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Accelerations, Float[Array, " m"]]:
        """Accelerations and targets by the report's system, assembled and solved as a whole."""
        n, m = model.system.n_bodies, model.constraints.n_rows
        eq = model.constraints.equations(t, kin, p)
        omega = kin.omega[:-1]
        p_rate = jax.vmap(euler_parameter_rate)(p, omega)
        L = jax.vmap(matrix_l)(p)
        K = jnp.zeros((7 * n + m, 7 * n + m), kin.r.dtype)
        B = jnp.concatenate([eq.J[..., :3], 0.5 * jnp.einsum("mnp,nap->mna", eq.J[..., 3:], L)], -1)
        turning = 2 * jnp.einsum("nab,nbp->nap", model.system.bodies.inertia, L)
        for k in range(n):
            row, column = 6 * k, 7 * k
            K = K.at[row : row + 3, column : column + 3].set(
                model.system.bodies.mass[k] * jnp.eye(3)
            )
            K = K.at[row + 3 : row + 6, column + 3 : column + 7].set(turning[k])
            K = K.at[6 * n + k, column + 3 : column + 7].set(p[k])
        K = K.at[: 6 * n, 7 * n :].set(B.reshape(m, 6 * n).T)
        K = K.at[7 * n :, : 7 * n].set(eq.matrix)
        velocity = jnp.concatenate([kin.v[:-1], p_rate], axis=1).reshape(-1)
        right = [
            jnp.concatenate([force, moment], axis=1).reshape(-1),
            -jnp.sum(p_rate**2, axis=1),
            _corrected(eq, velocity, stabilisation),
        ]
        x = solve_general(K, jnp.concatenate(right), redundant=self.redundant, rcond=self.rcond)
        q = x[: 7 * n].reshape(n, 7)
        omega_rate = 2 * jnp.einsum("nap,np->na", L, q[:, 3:])
        return Accelerations(q[:, :3], omega_rate, -x[7 * n :]), eq.target

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
        first = model.constraints.equations(t, model.system.kinematics(state))
        weighed = model.weigh(first.J).reshape(first.matrix.shape)
        factor = self._factor(first, weighed)

        def closer(_: Any, posture: tuple[Array, Array]) -> tuple[Array, Array]:
            at = State(posture[0], posture[1], state.v, state.omega)
            value = model.constraints.equations(t, model.system.kinematics(at)).value
            step = -(weighed.T @ factor.solve(value)).reshape(-1, 6)
            return displace(posture[0], posture[1], step)

        r, p = jax.lax.fori_loop(0, iterations, closer, (state.r, state.p))
        at = State(r, p, state.v, state.omega)
        eq = model.constraints.equations(t, model.system.kinematics(at))
        u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        for _ in range(2):
            u = u - weighed.T @ factor.solve(eq.matrix @ u - eq.target)
        left = _left(model, eq, p, u)
        u = u.reshape(-1, 6)
        return self.to_vector(model, State(r, p, u[:, :3], u[:, 3:])), left

    def residuals(
        self, model: AugmentedModel, t: Float[Array, ""], x: Float[Array, " k"]
    ) -> Residuals:
        state = self.to_state(model, x)
        u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        eq = model.constraints.equations(t, model.system.kinematics(state))
        return _left(model, eq, state.p, u)


def _left(
    model: AugmentedModel, eq: Equations, p: Float[Array, "n 4"], u: Float[Array, " k"]
) -> Residuals:
    norm = jnp.max(jnp.abs(jnp.sum(p**2, axis=1) - 1))
    return residuals_of(model.constraints, eq.value, eq.matrix @ u - eq.target, norm)


def displace(
    r: Float[Array, "n 3"], p: Float[Array, "n 4"], step: Float[Array, "n 6"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 4"]]:
    """Displace bodies by world translations [m] and body-frame rotation vectors [rad]."""
    turned = jax.vmap(lambda a, s: normalise(product(a, from_rotation_vector(s))))(p, step[:, 3:])
    return r + step[:, :3], turned


def _corrected(
    eq: Equations, velocity: Float[Array, " k"], stabilisation: AbstractStabilisation
) -> Float[Array, " m"]:
    """Right-hand side gamma with the terms of the stabilisation."""
    return stabilisation.held_rows(eq.gamma, eq.value, eq.matrix @ velocity - eq.target)
