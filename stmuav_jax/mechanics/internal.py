"""Forces with states of their own: motors that lag, and elements that count turns of a hinge.

Such a force holds its actuator states z as a leaf: the initial values when it is made, and the
present values that an integrator sets during a run (`with_internal`). The states are integrated with those of
the bodies and count in the error that controls the step size; the constraints do
not depend on them. A system without such forces has none, at no cost.

A posture determines the angle of a hinge up to whole turns. An element whose law depends on that angle
therefore has the angle itself as a state, which counts the turns: its rate is the hinge's, and the law
takes the angle of the posture with the whole turns of the state. The state need only stay within half
a turn of the truth, and every integration reads it anew at its start.
"""

from abc import abstractmethod
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.errors import ModelError
from ..checks.numbers import as_floats, check_scalar
from ..checks.shapes import Numbers, Scalar
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
    def internal_rate(self, t: Scalar, kin: Kinematics) -> Float[Array, " m"]:
        """Rate dz/dt of the actuator states at time t [s]."""

    @abstractmethod
    def internal_names(self) -> tuple[str, ...]:
        """Name of each actuator state, with its unit in brackets."""


class AbstractTurnCounter(AbstractInternalForce):
    """Force element whose only state, if it needs one, is the angle of a hinge, to count turns."""

    @abstractmethod
    def counted_hinge(self) -> str:
        """Joint whose angle is the state."""

    @abstractmethod
    def counted_angle(self, kin: Kinematics) -> Float[Array, " m"]:
        """Angle of a posture with the whole turns of the state (1,) [rad]."""


def _internal_owners(system: System) -> list[tuple[int, AbstractInternalForce]]:
    """Force elements that have actuator states, with their indices."""
    return [
        (k, force)
        for k, force in enumerate(system.forces)
        if isinstance(force, AbstractInternalForce)
        and force.internal is not None
        and force.internal.shape[-1]
    ]


def internal_count(system: System) -> int:
    """Number of actuator states of all forces of a system."""
    return sum(force.internal.shape[-1] for _, force in _internal_owners(system))


def internal_names(system: System) -> tuple[str, ...]:
    """Names of the actuator states of a system, with units in brackets."""
    return tuple(name for _, force in _internal_owners(system) for name in force.internal_names())


def internal_states(system: System) -> Float[Array, " m"]:
    """Actuator states (m,) of a system, as its forces hold them."""
    return _join_states([force.internal for _, force in _internal_owners(system)])


def with_internal(system: System, z: Float[Array, " m"]) -> System:
    """System whose forces have the actuator states z (m,)."""
    # All states of a system are one vector for the integration; each force gets its part back, in
    # the order in which they were joined.
    forces, start = list(system.forces), 0
    for k, force in _internal_owners(system):
        count = force.internal.shape[-1]
        forces[k] = eqx.tree_at(lambda f: f.internal, force, z[start : start + count])
        start += count
    return eqx.tree_at(lambda s: s.forces, system, tuple(forces)) if start else system


def internal_rates(system: System, t: Scalar, kin: Kinematics) -> Float[Array, " m"]:
    """Rates dz/dt of the actuator states of a system (m,), in their order."""
    return _join_states([force.internal_rate(t, kin) for _, force in _internal_owners(system)])


def internal_starts(system: System, kin: Kinematics) -> Float[Array, " m"]:
    """Internal states of a system at the start of an integration (m,), in their order."""
    # A counter starts from the posture, with the turns that it holds, since a state of the bodies
    # is what a run starts from; an actuator starts from its own number.
    counts = lambda force: isinstance(force, AbstractTurnCounter)
    start = lambda force: force.counted_angle(kin) if counts(force) else force.internal
    return _join_states([start(force) for _, force in _internal_owners(system)])


def counted_hinges(system: System) -> tuple[str | None, ...]:
    """Joint whose angle each internal state of a system counts, None for an actuator state (m,)."""
    owners = (force for _, force in _internal_owners(system))
    hinge = lambda force: force.counted_hinge() if isinstance(force, AbstractTurnCounter) else None
    return tuple(hinge(force) for force in owners for _ in range(force.internal.shape[-1]))


def actuator_mask(system: System) -> Bool[np.ndarray, " m"]:
    """Mask of the internal states of a system that are states of actuators (m,), not counted angles."""
    return np.array([hinge is None for hinge in counted_hinges(system)], dtype=bool)


def with_start_angles(system: System, angles: Mapping[str, Numbers]) -> System:
    """System whose springs, servos and end stops count the turns of hinges from other angles.

    A state of the bodies gives a hinge's angle in (-pi, pi], and elements that depend on it start from
    there. Give the total angle of a hinge that has turned further, such as that of a wound clock spring; only
    its whole turns count, and the state determines the remainder.

    Args:
        angles: angle at the start by joint [rad].

    Raises:
        ModelError: a joint is unknown, an angle is not finite, or no force depends on the joint's angle.
    """
    hinges = counted_hinges(system)
    z = internal_states(system)
    for name, angle in angles.items():
        system.joint_index(name)
        # Several forces may count the turns of one hinge, such as a spring and its end stops: all
        # of them start alike.
        places = [k for k, hinge in enumerate(hinges) if hinge == name]
        if not places:
            raise ModelError(
                f"The turns of joint '{name}' have no effect: no spring, servo or end stop of the system "
                "depends on its angle, and a state gives the angle in (-pi, pi]. Leave it out."
            )
        start = check_scalar(angle, f"The start angle of joint '{name}'", "rad")
        z = z.at[np.array(places)].set(start)
    return with_internal(system, z) if angles else system


def _join_states(parts: list[Array]) -> Float[Array, " m"]:
    return jnp.concatenate(parts) if parts else as_floats(())
