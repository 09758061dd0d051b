"""Variables of a saved run that describe the mechanism: masses, joints, rotors and their thrust."""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..algebra.compiler import in_blocks, kept_jit
from ..checks.numbers import as_jax
from ..dynamics.evaluation import Saved
from ..mechanics.inputs import Inputs
from ..mechanics.internal import (
    AbstractInternalForce,
    internal_names,
    internal_states,
    with_internal,
)
from ..mechanics.state import State
from ..mechanics.system import System
from ..rotorcraft.motor import MotorRotors
from ..rotorcraft.rotor import Rotors

if TYPE_CHECKING:
    import xarray as xr

Table = dict[str, tuple[tuple[str, ...], Any, str, str]]


class Held(NamedTuple):
    """Inputs of a system and their values at the saved times (k, m)."""

    inputs: Inputs
    values: Float[np.ndarray, "k m"]


def machine_table(system: System) -> Table:
    """Dimensions, values, unit and description of a mechanism's constants, by name.

    Points and axes of a joint are in the reference frame of the body concerned, whose origin is
    `centre_of_mass` away from the centre of mass; those of ground are in the world.
    """
    bodies, joints = system.bodies, system.joints
    axes, point = ("axis", "axis_2"), ("joint", "axis")
    table: Table = {
        "mass": (("body",), bodies.mass, "kg", "of each body"),
        "centre_of_mass": (("body", "axis"), bodies.com, "m", "in the body's reference frame"),
        "inertia": (("body", *axes), bodies.inertia, "kg m^2", "about the centre, body axes"),
    }
    if joints:
        own = lambda name: np.stack([np.asarray(getattr(joint, name)) for joint in joints])
        table |= {
            "joint_point_i": (point, own("point_i"), "m", "of the joint on body i"),
            "joint_point_j": (point, own("point_j"), "m", "of the joint on body j"),
            "joint_frame_i": (("joint", *axes), own("frame_i"), "1", "axes as columns, on body i"),
            "joint_frame_j": (("joint", *axes), own("frame_j"), "1", "axes as columns, on body j"),
        }
    return table


def machine_coordinates(system: System) -> dict[str, Any]:
    """Coordinates of these variables: axes, joints with kinds and bodies, bodies of rotors."""
    joints = system.joints
    found: dict[str, Any] = {
        "body": list(system.names),
        "axis": ["x", "y", "z"],
        "joint": [joint.name for joint in joints],
        "joint_kind": (("joint",), [joint.kind for joint in joints], {}),
        "joint_body_i": (("joint",), [joint.body_i for joint in joints], {}),
        "joint_body_j": (("joint",), [joint.body_j for joint in joints], {}),
    }
    bodies = [rotors.body for _, rotors in _rotor_sets(system) for _ in rotors.spin]
    return found | ({"rotor_body": (("rotor",), bodies, {})} if bodies else {})


def rotor_table(system: System, saved: Saved, held: Held | None = None) -> Table:
    """Positions, spins, speeds and thrusts of all rotors along a motion; empty without rotors.

    Args:
        system: mechanism. saved: its times, states and states of force elements.
        held: inputs and their values at the saved times (k, m), for a closed loop.
    """
    sets = _rotor_sets(system)
    if not sets:
        return {}
    squared = [_squared_speeds(k, system, saved, held) for k in range(len(sets))]
    plain = [rotors for _, rotors in sets]
    thrust = [np.asarray(rotors.k_f) * u for rotors, u in zip(plain, squared, strict=True)]
    over_time = ("time", "rotor")
    joined = lambda parts, axis=0: np.concatenate([np.asarray(x) for x in parts], axis=axis)
    return {
        "rotor_position": (
            ("rotor", "axis"), joined([r.arms for r in plain]), "m", "in the body's reference frame",
        ),
        "rotor_spin": (("rotor",), joined([r.spin for r in plain]), "1", "sense of turning, about z"),
        "rotor_speed": (over_time, np.sqrt(joined(squared, 1)), "rad/s", "of each rotor"),
        "rotor_thrust": (over_time, joined(thrust, 1), "N", "along the body's z axis"),
    }  # fmt: skip


def _rotor_sets(system: System) -> list[tuple[Rotors | MotorRotors, Rotors]]:
    found = [force for force in system.forces if isinstance(force, Rotors | MotorRotors)]
    return [(f, f.rotors if isinstance(f, MotorRotors) else f) for f in found]


def _squared_speeds(
    which: int, system: System, saved: Saved, held: Held | None
) -> Float[np.ndarray, "k rotors"]:
    """Squared speeds (k, rotors) [rad^2/s^2] of one set of rotors along a motion."""
    force, plain = _rotor_sets(system)[which]
    if isinstance(force, AbstractInternalForce) and force.internal.shape[0]:
        own, names = force.internal_names(), internal_names(system)
        return np.asarray(saved.internal)[:, [names.index(name) for name in own]] ** 2
    if callable(plain.speed_squared) or held is not None:
        inputs = held.inputs if held is not None else Inputs(())
        values = held.values if held is not None else np.zeros((len(saved.ts), 0))
        function = lambda *at: _commanded(which, system, inputs, *jax.tree.map(as_jax, at))
        return in_blocks(function, 32, saved, values)
    constant = plain.speed_squared
    reached = force.reached(constant) if isinstance(force, MotorRotors) else constant
    return np.broadcast_to(np.asarray(reached), (len(saved.ts), *np.shape(reached)))


@kept_jit
def _commanded(which: int, system: System, inputs: Inputs, saved: Saved, values: Any) -> Any:
    def one(at: tuple[Saved, Any]) -> Any:
        (t, state, internal), value = at
        here = inputs.applied(with_internal(system, internal), value)
        force, plain = _rotor_sets(here)[which]
        found = plain.commands(t, here.kinematics(state))
        return force.reached(found) if isinstance(force, MotorRotors) else jnp.asarray(found)

    return jax.lax.map(one, (saved, values))


def posture(system: System, state: State) -> "xr.Dataset":
    """Dataset of a mechanism in one state, with the variables of a saved run that pictures need."""
    table = machine_table(system) | {
        "position": (("time", "body", "axis"), np.asarray(state.r)[None], "m", "centre of mass"),
        "euler_parameters": (
            ("time", "body", "component"), np.asarray(state.p)[None], "1", "body to world",
        ),
    }  # fmt: skip
    rows = jax.tree.map(lambda x: np.asarray(x)[None], (state, internal_states(system)))
    table |= rotor_table(system, Saved(np.zeros(1), *rows))
    import xarray as xr  # slow to import, and runs are saved without it

    data = {name: (dims, np.asarray(values)) for name, (dims, values, _, _) in table.items()}
    return xr.Dataset(data, {"time": [0.0], **machine_coordinates(system)})
