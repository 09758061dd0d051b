"""Interface of a formulation of the equations of motion, its results and reactions.

Source: report Part I, Eq. 4.10 to 4.12, corrected: the joints of body i exert the world
force Phi_r^T lambda and the body-frame moment L Phi_p^T lambda / 2 on it.
"""

from abc import abstractmethod
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import ModelError
from ...mechanics.constraint import ROWS
from ...mechanics.state import Kinematics, State
from ...mechanics.system import System
from .constraints import Constraints, kinematic_sides
from .stabilisation import AbstractStabilisation


class Accelerations(eqx.Module):
    """Solution of the equations of motion at one state.

    Attributes:
        v_rate: accelerations of the centres of mass, world (n, 3) [m/s^2].
        omega_rate: angular accelerations, body axes (n, 3) [rad/s^2].
        multipliers: Lagrange multipliers, one per constraint row in the rows' order (m,);
            the joint force on body i is +Phi_r^T lambda.
    """

    v_rate: Float[Array, "n 3"]
    omega_rate: Float[Array, "n 3"]
    multipliers: Float[Array, " m"]


class Flows(eqx.Module):
    """Rates at which energy and momentum enter a system, for the balances of both.

    Attributes:
        power: power of drivers and of forces without potential [W].
        force: sum of all forces except the joints', world (3,) [N].
        moment: moment of these forces about the world's origin (3,) [N m].
    """

    power: Float[Array, ""]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]


class Residuals(eqx.Module):
    """Constraint residuals of a state, each the largest absolute value over the rows.

    Attributes:
        position: residual of rows that are lengths [m].
        angle: residual of rows that are cosines or angles [rad].
        velocity: residual of the rates of lengths [m/s].
        angular_velocity: residual of the rates of cosines and angles [rad/s].
        norm: residual |p|^2 - 1 of the Euler parameters.
    """

    position: Float[Array, ""]
    angle: Float[Array, ""]
    velocity: Float[Array, ""]
    angular_velocity: Float[Array, ""]
    norm: Float[Array, ""]


def residuals_of(
    constraints: Constraints,
    value: Float[Array, "m *s"],
    rate: Float[Array, "m *s"],
    norm: Float[Array, "*s"],
) -> Residuals:
    """Largest residuals of positions and velocities, with lengths and angles apart.

    Args:
        value: Phi of every row. rate: J qdot - target of every row. norm: largest | |p|^2 - 1 |.
    """
    if not constraints.n_rows:
        none = jnp.zeros_like(norm)
        return Residuals(none, none, none, none, norm)
    scale = constraints.scales()
    angular = constraints.angular.reshape(-1, *(1,) * (value.ndim - 1))
    largest = lambda x, rows: jnp.max(jnp.abs(scale * x) * rows, axis=0)
    return Residuals(
        # Metres and radians are reported apart; a common largest value would have no unit.
        position=largest(value, ~angular),
        angle=largest(value, angular),
        velocity=largest(rate, ~angular),
        angular_velocity=largest(rate, angular),
        norm=norm,
    )


class Reactions(eqx.Module):
    """Load of body i on body j at each joint, about j's joint point.

    Attributes:
        force: force (joints, 3) [N].
        moment: moment (joints, 3) [N m].
    """

    force: Float[Array, "joints 3"]
    moment: Float[Array, "joints 3"]


class AbstractModel(eqx.Module):
    """System prepared for a formulation, with all numbers that do not depend on the state.

    Attributes:
        system: the system itself; during a run its forces hold their present actuator states.
    """

    system: eqx.AbstractVar[System]


def count_left_out(model: AbstractModel) -> int:
    """Number of constraint rows that depend on others in every posture and are left out of a model."""
    row_mask = getattr(model, "row_mask", None)
    return 0 if row_mask is None else int(np.sum(~np.asarray(row_mask)))


class AbstractFormulation(eqx.Module):
    """Equations of motion of a `System` as an ordinary differential equation x' = f(t, x).

    `prepare` gathers, once, all numbers that do not depend on the state; the other methods take
    them as `model`. All are pure functions. The text of a formulation, `str(formulation)`, is kept
    with the results of a run.
    """

    @abstractmethod
    def prepare(self, system: System) -> AbstractModel:
        """Model of the system that the other methods take."""

    @abstractmethod
    def allowing_dependent_rows(self) -> "AbstractFormulation | None":
        """Formulation for systems whose constraint rows depend on each other, or None.

        It takes the models that this one prepares. It is this formulation itself if that allows for
        dependent rows already, and None if no such formulation exists.
        """

    @abstractmethod
    def to_vector(self, model: Any, state: State) -> Float[Array, " k"]:
        """Flat vector x of the integrated variables."""

    @abstractmethod
    def vector_size(self, model: Any) -> int:
        """Number of entries of x."""

    @abstractmethod
    def to_state(self, model: Any, x: Float[Array, " k"]) -> State:
        """State of all bodies at x."""

    @abstractmethod
    def accelerations(
        self, model: Any, t: Float[Array, ""], state: State, stabilisation: AbstractStabilisation
    ) -> Accelerations:
        """Accelerations and multipliers at one state and time t [s]."""

    @abstractmethod
    def reactions(
        self, model: Any, t: Float[Array, ""], state: State, result: Accelerations
    ) -> Reactions:
        """Reactions at all joints, world axes, from the accelerations at this state."""

    @abstractmethod
    def derivative(
        self,
        model: Any,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Float[Array, " k"], Flows]:
        """Derivative x', and the flows of energy and momentum at x."""

    @abstractmethod
    def at_step(self, model: Any, t: Float[Array, ""], x: Float[Array, " k"]) -> Any:
        """Model with the choices that hold for one step from x; they have no derivative."""

    @abstractmethod
    def project(
        self, model: Any, t: Float[Array, ""], x: Float[Array, " k"], iterations: int
    ) -> tuple[Float[Array, " k"], Residuals]:
        """Nearest x that satisfies the constraints at both levels, and its remaining residuals."""

    @abstractmethod
    def residuals(self, model: Any, t: Float[Array, ""], x: Float[Array, " k"]) -> Residuals:
        """Constraint residuals at x."""


Frame = Literal["world", "joint"]


def joint_reactions(
    system: System,
    constraints: Constraints,
    t: Float[Array, ""],
    state: State,
    multipliers: Float[Array, " m"],
) -> Reactions:
    """Reaction force and moment at every joint in world axes, in the order of `system.joints`.

    They are zero for joints that own none of the rows.
    """
    kin = system.kinematics(state)
    sides = kinematic_sides(kin)
    names = list(kin.names)
    i = np.array([names.index(joint.body_i) for joint in system.joints], dtype=int)
    wrench_i = jnp.zeros((len(system.joints), 6), state.r.dtype)
    start = 0
    for group in constraints.groups:
        rows = group.rows(sides, t, "omega")
        count = ROWS[group.kind] * len(group.i)
        share = multipliers[start : start + count].reshape(-1, ROWS[group.kind])
        owners = [group.joints] if group.mates is None else [group.joints, group.mates.joints]
        # Reactions are J^T times the multipliers, summed over the rows of each joint; the other half of a
        # coupling is borne by its mate.
        for owner, J_i in zip(owners, rows.blocks[::2], strict=True):
            belongs = np.eye(len(system.joints))[list(owner)]
            wrench_i = wrench_i + belongs.T @ jnp.einsum("kc,cwk->kw", share, J_i)
        start += count
    force = wrench_i[:, :3]
    moment = jnp.einsum("kab,kb->ka", kin.R_wb[i], wrench_i[:, 3:])
    # Moved from the centre of mass to the joint's point, where a bearing carries it.
    moment = moment + jnp.cross(kin.r[i] - joint_points(system, kin)[0], force)
    return Reactions(-force, -moment)


def in_joint_axes(system: System, state: State, reactions: Reactions) -> Reactions:
    """Reactions in the axes of every joint's frame fixed in body i."""
    axes = joint_points(system, system.kinematics(state))[1]
    turn = lambda x: jnp.einsum("kba,kb->ka", axes, x)
    return Reactions(turn(reactions.force), turn(reactions.moment))


def reaction_on(
    system: System, reactions: Reactions, joint: str, body: str
) -> tuple[Float[Array | np.ndarray, "... 3"], Float[Array | np.ndarray, "... 3"]]:
    """Force [N] and moment [N m] that a joint exerts on one of its two bodies, (..., 3) each.

    The moment is about the joint's point on body j, where the force acts, for either body; the axes
    are those of the given reactions. `Reactions` hold the load of body i on body j; the opposite
    load acts on body i.

    Args:
        reactions: reactions at all joints, at one time or along a run (..., joints, 3).
        joint: name of the joint. body: name of one of its bodies, which may be "ground".

    Raises:
        ModelError: the joint is unknown, or does not join the body.
    """
    k = system.joint_index(joint)
    ends = (system.joints[k].body_i, system.joints[k].body_j)
    if body not in ends:
        raise ModelError(
            f"Joint '{joint}' joins '{ends[0]}' and '{ends[1]}', and not '{body}': name one of them."
        )
    # Action and reaction: one load is stored for both bodies.
    sign = 1.0 if body == ends[1] else -1.0
    return sign * reactions.force[..., k, :], sign * reactions.moment[..., k, :]


def joint_points(system: System, kin: Kinematics) -> tuple[Array, Array]:
    """World position of every joint's point on body j, and axes of its frame on body i."""
    points = [kin.point(joint.body_j, joint.point_j)[0] for joint in system.joints]
    axes = [kin.R_wb[kin.index(joint.body_i)] @ joint.frame_i for joint in system.joints]
    if not points:
        return jnp.zeros((0, 3), kin.r.dtype), jnp.zeros((0, 3, 3), kin.r.dtype)
    return jnp.stack(points), jnp.stack(axes)
