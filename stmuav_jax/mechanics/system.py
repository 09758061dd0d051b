"""Systems: bodies, joints and forces, connected by name and checked as a graph."""

from collections import Counter
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, SettingError, nearest_names
from ..checks.numbers import stacked
from .body import GROUND, Bodies, Body, stack_bodies
from .joint import Joint, resolve
from .joint_coordinate import choose
from .load import AbstractForce
from .state import Kinematics, State, kinematics


class System(eqx.Module):
    """Multibody system of bodies, joints and forces.

    Args:
        bodies: moving bodies; "ground" exists without being listed.
        joints: see `stmuav_jax.mechanics.joint`; geometry in the world at the bodies'
            reference posture.
        forces: see `stmuav_jax.mechanics.forces.applied` and `stmuav_jax.mechanics.forces.joint`.
        allow_float32: accept single precision, in which closed loops lose most digits.

    Attributes:
        bodies: stacked masses, centres of mass and inertia tensors.
        joints: joints with geometry in the bodies' reference frames.
        forces: force elements as given.
        reference: state of the reference posture, at rest.

    Raises:
        ModelError: a name is unknown or occurs twice, a body that is not declared free has no
            connection to ground, or a force acts on a coordinate that its joint does not leave
            free.
        SettingError: the numbers have single precision without `allow_float32`.
    """

    bodies: Bodies
    joints: tuple[Joint, ...]
    forces: tuple[AbstractForce, ...]
    reference: State
    allow_float32: bool = eqx.field(static=True)

    def __init__(
        self,
        bodies: Sequence[Body],
        joints: Sequence[Joint] = (),
        forces: Sequence[AbstractForce] = (),
        *,
        allow_float32: bool = False,
    ) -> None:
        by_name = {b.name: b for b in bodies}
        _check_names(bodies, joints)
        _check_references(by_name, joints, forces)
        _check_connected(bodies, joints)
        self.bodies = stack_bodies(tuple(bodies))
        self.joints = tuple(
            resolve(j, by_name.get(j.body_i), by_name.get(j.body_j)) for j in joints
        )
        self.forces = tuple(forces)
        zero = stacked([np.zeros(3, self.bodies.com.dtype)] * len(bodies))
        self.reference = State(
            r=stacked([b.com_position for b in bodies]),
            p=stacked([b.orientation for b in bodies]),
            v=zero,
            omega=zero,
        )
        self.allow_float32 = allow_float32
        check_precision(self.bodies.mass, allow_float32)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the moving bodies, in the order of the state's rows."""
        return self.bodies.names

    @property
    def n_bodies(self) -> int:
        """Number of moving bodies."""
        return len(self.bodies.names)

    @property
    def floating(self) -> bool:
        """True if no joint names ground, so that only forces change the total momentum."""
        return all(GROUND not in (j.body_i, j.body_j) for j in self.joints)

    def index(self, name: str) -> int:
        """Row of the named moving body in a state; raises `ModelError` if unknown."""
        if name not in self.names:
            raise ModelError(f"There is no body '{name}'.{nearest_names(name, self.names)}")
        return self.names.index(name)

    def joint_index(self, name: str) -> int:
        """Index of the named joint; raises `ModelError` if unknown."""
        names = [j.name for j in self.joints]
        if name not in names:
            raise ModelError(f"There is no joint '{name}'.{nearest_names(name, names)}")
        return names.index(name)

    def kinematics(self, state: State) -> Kinematics:
        """Positions, rotations and velocities of all bodies and ground, for one state."""
        return kinematics(
            state,
            mass=self.bodies.mass,
            com=self.bodies.com,
            names=self.names,
            joints=self.joints,
        )

    def com(self, state: State) -> Float[Array, "3"]:
        """Centre of mass of the whole system in the world (3,) [m]."""
        mass = self.bodies.mass
        return mass @ state.r / jnp.sum(mass)


def check_precision(array: Float[Array | np.ndarray, "..."], allow_float32: bool) -> None:
    """Raise `SettingError` for single precision that is not allowed."""
    if jnp.result_type(array) != jnp.float64 and not allow_float32:
        raise SettingError(
            "Mechanism dynamics need double precision, but this array is "
            f"{jnp.result_type(array)}. Call jax.config.update('jax_enable_x64', True) before "
            "making arrays, or pass allow_float32=True to System to accept the loss of digits."
        )


def check_state(system: System, state: State) -> None:
    """Raise `SettingError` if the state's shapes or precision do not fit (any batch axes)."""
    n = system.n_bodies
    for name, width in (("r", 3), ("p", 4), ("v", 3), ("omega", 3)):
        array = getattr(state, name)
        if not isinstance(array, jax.Array | np.ndarray):
            raise SettingError(
                f"State.{name} must be an array of shape (..., {n}, {width}), but it is of type "
                f"{type(array).__name__}: write jnp.asarray(...) around the numbers."
            )
        if jnp.shape(array)[-2:] != (n, width):
            raise SettingError(
                f"State.{name} must have shape (..., {n}, {width}) for bodies "
                f"{', '.join(system.names)}, but it has {jnp.shape(array)}."
            )
        check_precision(array, system.allow_float32)


def _check_names(bodies: Sequence[Body], joints: Sequence[Joint]) -> None:
    if not bodies:
        raise ModelError("A system needs at least one body.")
    for kind, names in (("Body", [b.name for b in bodies]), ("Joint", [j.name for j in joints])):
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise ModelError(
                f"{kind} names must be unique, but these occur twice: {', '.join(twice)}."
            )


def _check_references(
    by_name: dict[str, Body], joints: Sequence[Joint], forces: Sequence[AbstractForce]
) -> None:
    known = [*by_name, GROUND]
    joint_names = [j.name for j in joints]
    for joint in joints:
        for name in (joint.body_i, joint.body_j):
            if name not in known:
                raise ModelError(
                    f"Joint '{joint.name}' names the unknown body '{name}'.{nearest_names(name, known)}"
                )
    for force in forces:
        kind, named = type(force).__name__, force.acts_on()
        for name in named.bodies:
            if name not in known:
                raise ModelError(
                    f"A {kind} names the unknown body '{name}'.{nearest_names(name, known)}"
                )
        for name in (*named.joints, *(name for name, _ in named.coordinates)):
            if name not in joint_names:
                raise ModelError(
                    f"A {kind} names the unknown joint '{name}'.{nearest_names(name, joint_names)}"
                )
        for name, which in named.coordinates:
            choose(joints[joint_names.index(name)], which, f"{kind} in joint '{name}'")


def _check_connected(bodies: Sequence[Body], joints: Sequence[Joint]) -> None:
    """Raise `ModelError` for bodies that no joints connect to ground or to a body declared free."""
    neighbours: dict[str, set[str]] = {b.name: set() for b in bodies} | {GROUND: set()}
    for joint in joints:
        neighbours[joint.body_i].add(joint.body_j)
        neighbours[joint.body_j].add(joint.body_i)
    reached = {GROUND, *(b.name for b in bodies if b.free)}
    todo = list(reached)
    while todo:
        for name in neighbours[todo.pop()] - reached:
            reached.add(name)
            todo.append(name)
    loose = [b.name for b in bodies if b.name not in reached]
    if loose:
        raise ModelError(
            f"Attached to nothing: {', '.join(loose)}. Join each to '{GROUND}' or to a body that "
            "is, or declare the body that may float with Body(..., free=True)."
        )
