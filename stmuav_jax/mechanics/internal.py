"""Forces with states of their own, the actuator states, such as motors that lag.

Such a force holds its actuator states z as a leaf: the initial values when it is made, and the
present values that an integrator sets during a run (`with_internal`). The states are integrated
beside those of the bodies and count in the error that controls the step size; the constraints do
not depend on them. A system without such forces has none, at no cost.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.numbers import floats
from .load import AbstractForce
from .state import Kinematics
from .system import System


class AbstractInternalForce(AbstractForce):
    """Force element with actuator states z; its load may depend on them through `internal`.

    Attributes:
        internal: actuator states z (m,).
    """

    internal: eqx.AbstractVar[Float[Array, " m"]]

    @abstractmethod
    def internal_rate(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " m"]:
        """Rate dz/dt of the actuator states at time t [s]."""

    @abstractmethod
    def internal_names(self) -> tuple[str, ...]:
        """Name of each actuator state, with its unit in brackets."""


def _owners(system: System) -> list[tuple[int, AbstractInternalForce]]:
    """Force elements that have actuator states, with their indices."""
    return [
        (k, force)
        for k, force in enumerate(system.forces)
        if isinstance(force, AbstractInternalForce) and force.internal.shape[-1]
    ]


def internal_count(system: System) -> int:
    """Number of actuator states of all forces of a system."""
    return sum(force.internal.shape[-1] for _, force in _owners(system))


def internal_names(system: System) -> tuple[str, ...]:
    """Names of the actuator states of a system, with units in brackets."""
    return tuple(name for _, force in _owners(system) for name in force.internal_names())


def internal_states(system: System) -> Float[Array, " m"]:
    """Actuator states (m,) of a system, as its forces hold them."""
    return _joined([force.internal for _, force in _owners(system)])


def with_internal(system: System, z: Float[Array, " m"]) -> System:
    """System whose forces have the actuator states z (m,)."""
    forces, start = list(system.forces), 0
    for k, force in _owners(system):
        count = force.internal.shape[-1]
        forces[k] = eqx.tree_at(lambda f: f.internal, force, z[start : start + count])
        start += count
    return eqx.tree_at(lambda s: s.forces, system, tuple(forces)) if start else system


def internal_rates(system: System, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " m"]:
    """Rates dz/dt of the actuator states of a system (m,), in their order."""
    return _joined([force.internal_rate(t, kin) for _, force in _owners(system)])


def _joined(parts: list[Array]) -> Float[Array, " m"]:
    return jnp.concatenate(parts) if parts else floats(())
