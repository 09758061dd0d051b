"""Interface of a formulation of the equations of motion, and its results."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...mechanics.state import State
from ...mechanics.system import System
from .constraints import Constraints
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
