"""What a formulation of the equations of motion offers to the rest of the package."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics.state import State
from ..mechanics.system import System
from .differential import Constraints
from .stabilisation import AbstractStabilisation


class Accelerations(eqx.Module):
    """The solution of the equations of motion at one state.

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
    """What enters the system per unit of time, for its energy and momentum balance.

    Attributes:
        power: of forces without potential and of drivers [W].
        force: sum of all forces but the joints', world (3,) [N].
        moment: their moment about the world's origin (3,) [N m].
    """

    power: Float[Array, ""]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]


class Residuals(eqx.Module):
    """How well a state satisfies its constraints; each is the largest absolute value.

    Attributes:
        position: of rows that are lengths [m]. angle: of rows that are cosines or angles [rad].
        velocity: of the rates of lengths [m/s]. angular_velocity: of those of cosines and
            angles [rad/s].
        norm: of |p|^2 - 1.
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
    """The largest residuals of positions and velocities, lengths apart from angles.

    Args:
        value: Phi of every row. rate: J qdot - target of every row. norm: the largest of |p|^2 - 1.
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
    """What body i of each joint exerts on its body j, about j's joint point.

    Attributes:
        force: (joints, 3) [N].
        moment: (joints, 3) [N m].
    """

    force: Float[Array, "joints 3"]
    moment: Float[Array, "joints 3"]


class AbstractFormulation(eqx.Module):
    """Equations of motion of a `System` as an ordinary differential equation x' = f(t, x).

    `prepare` gathers, once, what does not change with the state; the other methods take it
    as `model`. All are pure functions.
    """

    @abstractmethod
    def prepare(self, system: System) -> Any:
        """What the other methods need of the system, with the system itself as `.system`."""

    @abstractmethod
    def to_vector(self, model: Any, state: State) -> Float[Array, " k"]:
        """The flat vector x that is integrated."""

    @abstractmethod
    def to_state(self, model: Any, x: Float[Array, " k"]) -> State:
        """The state of all bodies at x."""

    @abstractmethod
    def accelerations(
        self, model: Any, t: Float[Array, ""], state: State, stabilisation: AbstractStabilisation
    ) -> Accelerations:
        """Accelerations and multipliers at one state and time [s]."""

    @abstractmethod
    def reactions(
        self, model: Any, t: Float[Array, ""], state: State, result: Accelerations
    ) -> Reactions:
        """Reactions at all joints, world axes, from the accelerations at that state."""

    @abstractmethod
    def derivative(
        self,
        model: Any,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Float[Array, " k"], Flows]:
        """x' and the flows of energy and momentum at x."""

    @abstractmethod
    def at_step(self, model: Any, t: Float[Array, ""], x: Float[Array, " k"]) -> Any:
        """The model with what is chosen once for a step that starts at x; no derivative."""

    @abstractmethod
    def project(
        self, model: Any, t: Float[Array, ""], x: Float[Array, " k"], iterations: int
    ) -> tuple[Float[Array, " k"], Residuals]:
        """The nearest x that satisfies the constraints at both levels, and what is left."""

    @abstractmethod
    def residuals(self, model: Any, t: Float[Array, ""], x: Float[Array, " k"]) -> Residuals:
        """How far x is from satisfying the constraints."""
