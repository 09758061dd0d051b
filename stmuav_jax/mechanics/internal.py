"""Forces with states of their own: motors that lag, for example.

Such a force holds its states z as a leaf: where a run starts as it is made, the states of
the moment as an integrator sets them (`with_internal`). They are integrated beside those of
the bodies and steer the step size alike; the constraints do not see them. A system without
such forces has none and pays nothing.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .load import AbstractForce
from .state import Kinematics
from .system import System


class AbstractInternalForce(AbstractForce):
    """A force with states z; its load may depend on them through `internal`.

    Attributes:
        internal: z (m,).
    """

    internal: eqx.AbstractVar[Float[Array, " m"]]

    @abstractmethod
    def internal_rate(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " m"]:
        """dz/dt at time t [s]."""

    @abstractmethod
    def internal_names(self) -> tuple[str, ...]:
        """What each state is, with its unit in brackets."""


def _owners(system: System) -> list[tuple[int, AbstractInternalForce]]:
    """The forces that have states, and their numbers."""
    return [
        (k, force)
        for k, force in enumerate(system.forces)
        if isinstance(force, AbstractInternalForce) and force.internal.shape[-1]
    ]


def internal_count(system: System) -> int:
    """How many states the forces of a system have in all."""
    return sum(force.internal.shape[-1] for _, force in _owners(system))


def internal_names(system: System) -> tuple[str, ...]:
    """What they are."""
    return tuple(name for _, force in _owners(system) for name in force.internal_names())


def internal_states(system: System) -> Float[Array, " m"]:
    """All of them, as the forces hold them."""
    return _joined([force.internal for _, force in _owners(system)])


def with_internal(system: System, z: Float[Array, " m"]) -> System:
    """The system with the states of its forces set to z (m,)."""
    forces, start = list(system.forces), 0
    for k, force in _owners(system):
        count = force.internal.shape[-1]
        forces[k] = eqx.tree_at(lambda f: f.internal, force, z[start : start + count])
        start += count
    return eqx.tree_at(lambda s: s.forces, system, tuple(forces)) if start else system


def internal_rates(system: System, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " m"]:
    """Their rates, in the same order."""
    return _joined([force.internal_rate(t, kin) for _, force in _owners(system)])


def _joined(parts: list[Array]) -> Float[Array, " m"]:
    return jnp.concatenate(parts) if parts else jnp.zeros((0,))
