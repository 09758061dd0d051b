"""Systems: bodies, joints and forces, connected by name and checked as a graph."""

import dataclasses
import functools
import inspect
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, SettingError, nearest_names
from ..checks.numbers import stack_arrays
from ..checks.shapes import Vec3
from ..math.rotation import rotation_matrix
from .body import GROUND, Bodies, Body, stack_bodies
from .joint import Joint, choose_coordinate, resolve_joint
from .load import AbstractForce
from .state import Kinematics, State, compute_kinematics, find_place


class System(eqx.Module):
    """Multibody system of bodies, joints and forces.

    Args:
        bodies: moving bodies; "ground" exists without being listed. The stacked bodies of a system
            that exists are taken too, with its joints and its reference: so
            `dataclasses.replace(system, forces=...)` is the same system with other forces.
        joints: see `stmuav_jax.mechanics.joint`; geometry in the world at the bodies'
            reference posture.
        forces: see `stmuav_jax.mechanics.forces` and `stmuav_jax.mechanics.joint_forces`.
        reference: reference posture of stacked bodies; `Body` objects contain theirs.
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
        bodies: Sequence[Body] | Bodies,
        joints: Sequence[Joint] = (),
        forces: Sequence[Any] = (),
        *,
        reference: State | None = None,
        allow_float32: bool = False,
    ) -> None:
        # `dataclasses.replace` calls the constructor with the fields of a system that exists: its
        # joints are in body frames already and must not be resolved again.
        if isinstance(bodies, Bodies):
            self.bodies, self.joints = bodies, tuple(joints)
            self.reference = _check_stacked(bodies, joints, reference)
            names: Sequence[str] = bodies.names
        else:
            if reference is not None:
                raise ModelError(
                    "The reference posture of Body objects is in them (position, orientation): leave "
                    "reference= out."
                )
            by_name = {b.name: b for b in bodies}
            _check_names(bodies, joints)
            _check_joints(list(by_name), joints)
            # A body without a joint is more often a wrong name than a free body; a free one must be declared.
            _check_connected(bodies, joints)
            self.bodies = stack_bodies(tuple(bodies))
            self.joints = tuple(resolve_joint(j, by_name) for j in joints)
            zero = stack_arrays([np.zeros(3, self.bodies.com.dtype)] * len(bodies))
            r = stack_arrays([b.com_position for b in bodies])
            self.reference = State(r, stack_arrays([b.orientation for b in bodies]), zero, zero)
            names = list(by_name)
        _check_forces(names, self.joints, forces)
        # A force in a joint may need the joint's kind and frames, which are known from here on.
        self.forces = tuple(force.resolve(self.joints) for force in forces)
        self.allow_float32 = allow_float32
        # Single precision is the default of JAX and a common oversight: closed loops then drift by
        # what looks like a modelling error, so that it has to be asked for.
        check_precision(self.bodies.mass, allow_float32)

    def with_forces(self, *forces: Any) -> "System":
        """System with forces added to those of this one, which stay first.

        To exchange its forces, use `dataclasses.replace(system, forces=(...))`.

        Raises:
            ModelError: a force acts on a body, joint or coordinate that the system does not have.
        """
        return dataclasses.replace(self, forces=(*self.forces, *forces))

    def with_parameters(self, values: Mapping[str, Any]) -> "System":
        """System with other parameters, by names such as "camera.mass", "pitch.stiffness" or "frame.k_f".

        A name is OWNER.FIELD: mass, com or inertia of a body, or a field of the force that acts on this body or
        in this joint; "Gravity.acceleration" names a force by its class. Values are checked as in the
        constructors. The frames of bodies stay where they are at the reference posture.

        Raises:
            ModelError: an unknown or ambiguous name, or an invalid value.
        """
        system = self
        for name, value in values.items():
            system = _with_parameter(system, name, value)
        return system

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

    @property
    def base(self) -> int:
        """Row of the base: the first body that is declared free, else the first body."""
        free = self.bodies.free
        return next((k for k, name in enumerate(self.names) if name in free), 0)

    def index(self, name: str) -> int:
        """Row of the named moving body in a state; raises `ModelError` if unknown."""
        return find_place(name, self.names, "body")

    def joint_index(self, name: str) -> int:
        """Index of the named joint; raises `ModelError` if unknown."""
        return find_place(name, [joint.name for joint in self.joints], "joint")

    def kinematics(self, state: State) -> Kinematics:
        """Positions, rotations and velocities of all bodies and ground, for one state."""
        mass, com = self.bodies.mass, self.bodies.com
        return compute_kinematics(state, mass=mass, com=com, names=self.names, joints=self.joints)

    def com(self, state: State) -> Vec3:
        """Centre of mass of the whole system in the world (3,) [m]."""
        mass = self.bodies.mass
        return mass @ state.r / jnp.sum(mass)


def moved_centres(state: State, before: System, after: System) -> State:
    """State with the same motion of the bodies' frames, where the centres of mass in them have changed."""
    shift = after.bodies.com - before.bodies.com
    R = jax.vmap(rotation_matrix)(state.p)
    to_world = lambda x: jnp.einsum("nij,nj->ni", R, x)
    r, v = state.r + to_world(shift), state.v + to_world(jnp.cross(state.omega, shift))
    return State(r, state.p, v, state.omega)


_OF_BODY = ("mass", "com", "inertia")


def _with_parameter(system: System, name: str, value: Any) -> System:
    owner, _, field = name.partition(".")
    if owner in system.names and field in _OF_BODY:
        k = system.index(owner)
        # A body is made anew with the other number, by its own constructor: the checks of masses
        # and inertia tensors are those of the first one.
        numbers = {key: getattr(system.bodies, key)[k] for key in _OF_BODY} | {field: value}
        body = Body(owner, numbers["mass"], numbers["inertia"], com=numbers["com"])
        bodies = eqx.tree_at(
            lambda b: getattr(b, field), system.bodies, getattr(system.bodies, field).at[k].set(getattr(body, field))
        )  # fmt: skip
        changed = eqx.tree_at(lambda s: s.bodies, system, bodies)
        reference = moved_centres(system.reference, system, changed)
        return eqx.tree_at(lambda s: s.reference, changed, reference)
    places = [
        (k, path)
        for k, force in enumerate(system.forces)
        if owner in _force_owners(force) and (path := _field_path(force, field))
    ]
    # Two springs in one joint have the same name: guessing which is meant would change the wrong
    # one without a word.
    if len(places) != 1:
        fields = [(_force_owners(force), _constructor_fields(force)) for force in system.forces]
        fields.append((set(system.names), list(_OF_BODY)))
        names = {f"{n}.{key}" for owners, keys in fields for n in owners for key in keys}
        wrong = f"there is none of this name.{nearest_names(name, sorted(names))}"
        if places:
            wrong = "several forces have it: exchange them by dataclasses.replace(system, forces=(...))."
        raise ModelError(f"The parameter '{name}' cannot be set: {wrong}")
    k, path = places[0]
    walk = lambda part: functools.reduce(getattr, path, part)
    checked_value = walk(_rebuild_part(system.forces[k], path, value))
    is_none = lambda x: x is None
    force = eqx.tree_at(walk, system.forces[k], checked_value, is_leaf=is_none)
    forces = (*system.forces[:k], force, *system.forces[k + 1 :])
    return eqx.tree_at(lambda s: s.forces, system, forces)


def _force_owners(force: AbstractForce) -> set[str]:
    """Bodies and joints of a force, and its class."""
    of = force.acts_on()
    return {*of.bodies, *of.joints, *(joint for joint, _ in of.coordinates), type(force).__name__}


def _constructor_fields(part: Any) -> list[str]:
    """Numbers that the constructor of a force, or of a part of it, takes."""
    names = (n for n in inspect.signature(type(part)).parameters if n != "internal")
    return [n for n in names if not isinstance(getattr(part, n, ""), str | eqx.Module)]


def _field_path(force: AbstractForce, field: str) -> tuple[str, ...]:
    """Path to a field of a force, or of a part of it; () if there is none."""
    if field in _constructor_fields(force):
        return (field,)
    parts = ((n, getattr(force, n, None)) for n in inspect.signature(type(force)).parameters)
    has_field = lambda part: isinstance(part, eqx.Module) and field in _constructor_fields(part)
    inner = [n for n, part in parts if has_field(part)]
    return (inner[0], field) if len(inner) == 1 else ()


def _rebuild_part(part: Any, path: tuple[str, ...], value: Any) -> Any:
    """Part constructed again, and so checked, with another value of a field."""
    arguments = {n: getattr(part, n, None) for n in inspect.signature(type(part)).parameters}
    # States of actuators are no parameters: a new part starts with its own.
    arguments.pop("internal", None)
    head, *rest = path
    arguments[head] = _rebuild_part(arguments[head], tuple(rest), value) if rest else value
    return type(part)(**arguments)


def check_precision(array: Float[Array | np.ndarray, "..."], allow_float32: bool) -> None:
    """Raise `SettingError` for single precision that is not allowed."""
    if jnp.result_type(array) != jnp.float64 and not allow_float32:
        raise SettingError(
            "Mechanism dynamics need double precision, but this array is "
            f"{jnp.result_type(array)}. Call jax.config.update('jax_enable_x64', True) before "
            "making arrays, or pass allow_float32=True to System to accept the loss of digits."
        )


def check_state(system: System, state: State, *, batched: bool = False) -> None:
    """Raise `SettingError` if the shapes or the precision of a state, or of states in a batch, do not fit."""
    n = system.n_bodies
    axes = "..., " if batched else ""
    for name, width in (("r", 3), ("p", 4), ("v", 3), ("omega", 3)):
        array = getattr(state, name)
        if not isinstance(array, jax.Array | np.ndarray):
            raise SettingError(
                f"State.{name} must be an array of shape ({axes}{n}, {width}), but it is of type "
                f"{type(array).__name__}: write jnp.asarray(...) around the numbers."
            )
        # JAX would broadcast one row to all bodies, and find an error many operations later, in
        # names of its own.
        shape = jnp.shape(array)
        if shape[-2:] != (n, width) or (len(shape) > 2 and not batched):
            advice = "" if batched or len(shape) < 3 else " For many states use jax.vmap."
            raise SettingError(
                f"State.{name} must have shape ({axes}{n}, {width}) for bodies "
                f"{', '.join(system.names)}, but it has {shape}.{advice}"
            )
        check_precision(array, system.allow_float32)


def _check_names(bodies: Sequence[Body], joints: Sequence[Joint]) -> None:
    if not bodies:
        raise ModelError("A system needs at least one body.")
    for kind, names in (("Body", [b.name for b in bodies]), ("Joint", [j.name for j in joints])):
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            said = f"{kind} names must be unique, but these occur twice: {', '.join(twice)}."
            raise ModelError(said)


def _check_stacked(bodies: Bodies, joints: Sequence[Joint], reference: State | None) -> State:
    """Reference posture of stacked bodies, checked to be that of a system with these joints."""
    if reference is None or any(joint.in_world for joint in joints):
        raise ModelError(
            "The bodies of a system that exists (system.bodies) come with its joints and its "
            "reference posture. To add forces, use system.with_forces(...); to exchange them, "
            "dataclasses.replace(system, forces=(...)); for other joints, make a System of Body "
            "objects."
        )
    if reference.r.shape[-2:] != (len(bodies.names), 3):
        raise ModelError(
            f"The reference posture must have one row for each of the {len(bodies.names)} bodies, "
            f"but its r has shape {reference.r.shape}."
        )
    _check_joints(bodies.names, joints)
    return reference


def _check_joints(names: Sequence[str], joints: Sequence[Joint]) -> None:
    body_names, joint_names = [*names, GROUND], [joint.name for joint in joints]
    for joint in joints:
        # Couplings name other joints and not bodies, and are checked against those.
        coupled = () if joint.mate is None else (joint.mate.dependent, joint.mate.joint.name)
        for name in coupled:
            subject = f"The coupling '{joint.name}' names the unknown"
            find_place(name, joint_names, "joint", subject)
        for name in (joint.body_i, joint.body_j):
            find_place(name, body_names, "body", f"Joint '{joint.name}' names the unknown")


def _check_forces(names: Sequence[str], joints: Sequence[Joint], forces: Sequence[Any]) -> None:
    body_names, joint_names = [*names, GROUND], [j.name for j in joints]
    for force in forces:
        if not isinstance(force, AbstractForce):
            raise ModelError(
                "The forces of a system must be forces, such as Gravity(...), but one is of type "
                f"{type(force).__name__}."
            )
        kind, named = type(force).__name__, force.acts_on()
        subject = f"A {kind} names the unknown"
        for name in named.bodies:
            find_place(name, body_names, "body", subject)
        for name in named.joints:
            find_place(name, joint_names, "joint", subject)
        for name, coordinate in named.coordinates:
            joint = joints[find_place(name, joint_names, "joint", subject)]
            choose_coordinate(joint, coordinate, f"{kind} in joint '{name}'")


def _check_connected(bodies: Sequence[Body], joints: Sequence[Joint]) -> None:
    """Raise `ModelError` for bodies that no joints connect to ground or to a body declared free."""
    neighbours: dict[str, set[str]] = {b.name: set() for b in bodies} | {GROUND: set()}
    for joint in joints:
        neighbours[joint.body_i].add(joint.body_j)
        neighbours[joint.body_j].add(joint.body_i)
    attached_names = {GROUND, *(b.name for b in bodies if b.free)}
    # A search over the graph from ground and from all free bodies.
    todo = list(attached_names)
    while todo:
        for name in neighbours[todo.pop()] - attached_names:
            attached_names.add(name)
            todo.append(name)
    loose = [b.name for b in bodies if b.name not in attached_names]
    if loose:
        raise ModelError(
            f"Bodies without a path of joints to '{GROUND}' or to a free body: {', '.join(loose)}. Join "
            f"each to '{GROUND}' or to a body that "
            "is, or declare the body that may float with Body(..., free=True)."
        )
