"""Runs of scenes and of closed loops as labelled datasets and NetCDF files."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..checks.numbers import as_jax
from ..dynamics.evaluation import Saved
from ..dynamics.simulation import Run, saved_states
from ..math.compiler import in_blocks, kept_jit
from ..mechanics.inputs import Inputs
from ..mechanics.internal import (
    AbstractInternalForce,
    internal_names,
    internal_states,
    with_internal,
)
from ..mechanics.state import State
from ..mechanics.system import System
from ..uav.motor import MotorRotors
from ..uav.rotor import Rotors
from .netcdf import (
    FORMAT,
    FORMAT_VERSION,
    LOOP_FORMAT,
    LOOP_VERSION,
    Labelled,
    label_table,
    list_versions,
    save_sealed,
    write_atomically,
)

if TYPE_CHECKING:
    import xarray as xr

    from ..control.closed_loop import LoopRun

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
    axes = ("axis", "axis_2")
    table: Table = {
        "mass": (("body",), bodies.mass, "kg", "of each body"),
        "centre_of_mass": (("body", "axis"), bodies.com, "m", "in the body's reference frame"),
        "inertia": (("body", *axes), bodies.inertia, "kg m^2", "about the centre, body axes"),
    }
    if joints:
        stack = lambda name: np.stack([np.asarray(getattr(joint, name)) for joint in joints])
        for part, dims, unit, description in (
            ("point", ("joint", "axis"), "m", "of the joint"),
            ("frame", ("joint", *axes), "1", "axes as columns,"),
        ):
            for side in "ij":
                description_of_side = f"{description} on body {side}"
                name = f"{part}_{side}"
                table[f"joint_{name}"] = (dims, stack(name), unit, description_of_side)
    return table


def machine_coordinates(system: System) -> dict[str, Any]:
    """Coordinates of these variables: axes, joints with kinds and bodies, bodies of rotors."""
    joints = system.joints
    coordinates: dict[str, Any] = {
        "body": list(system.names),
        "axis": ["x", "y", "z"],
        "joint": [joint.name for joint in joints],
        # A saved run holds its mechanism: a viewer needs neither the scene nor this package's version of it.
        "joint_kind": (("joint",), [joint.kind for joint in joints], {}),
        "joint_body_i": (("joint",), [joint.body_i for joint in joints], {}),
        "joint_body_j": (("joint",), [joint.body_j for joint in joints], {}),
    }
    bodies = [rotors.body for _, rotors in _rotor_sets(system) for _ in rotors.spin]
    return coordinates | ({"rotor_body": (("rotor",), bodies, {})} if bodies else {})


def _motion_table(system: System, states: State, internal: Any) -> Table:
    """States of bodies and of force elements along a motion."""
    vector, names = ("time", "body", "axis"), internal_names(system)
    table: Table = {
        "position": (vector, states.r, "m", "centre of mass, world axes"),
        "euler_parameters": (("time", "body", "component"), states.p, "1", "body to world"),
        "velocity": (vector, states.v, "m/s", "of the centre of mass, world axes"),
        "angular_velocity": (vector, states.omega, "rad/s", "body axes"),
    }
    description = "states of forces, units in their names"
    dims = ("time", "internal_state")
    return table | (
        {"internal": (dims, internal, "see internal_state", description)} if names else {}
    )


def _motion_coordinates(system: System, ts: Any, description: str) -> dict[str, Any]:
    """Coordinates of these variables at times with a description."""
    names = internal_names(system)
    return {
        "time": (("time",), np.asarray(ts), {"units": "s", "description": description}),
        "component": ["e0", "e1", "e2", "e3"],
        **machine_coordinates(system),
    } | ({"internal_state": list(names)} if names else {})


def rotor_table(system: System, saved: Saved, held_inputs: Held | None = None) -> Table:
    """Positions, spins, speeds and thrusts of all rotors along a motion; empty without rotors.

    Args:
        system: mechanism. saved: its times, states and states of force elements.
        held_inputs: inputs and their values at the saved times (k, m), for a closed loop.
    """
    sets = _rotor_sets(system)
    if not sets:
        return {}
    squared = [_squared_speeds(k, system, saved, held_inputs) for k in range(len(sets))]
    plain = [rotors for _, rotors in sets]
    thrust = [np.asarray(rotors.thrusts(u)) for rotors, u in zip(plain, squared, strict=True)]
    over_time = ("time", "rotor")
    joined = lambda parts, axis=0: np.concatenate([np.asarray(x) for x in parts], axis=axis)
    return {
        "rotor_position": (
            ("rotor", "axis"), joined([r.arms for r in plain]), "m", "in the body's reference frame",
        ),
        "rotor_spin": (("rotor",), joined([r.spin for r in plain]), "1", "sense of turning, about z"),
        # Speeds follow from commands after the run; integration with constant inputs does not compute them.
        "rotor_speed": (over_time, np.sqrt(joined(squared, 1)), "rad/s", "of each rotor"),
        "rotor_thrust": (over_time, joined(thrust, 1), "N", "along the body's z axis"),
    }  # fmt: skip


def _rotor_sets(system: System) -> list[tuple[Rotors | MotorRotors, Rotors]]:
    forces = [force for force in system.forces if isinstance(force, Rotors | MotorRotors)]
    return [(force, force.rotors) for force in forces]


def _squared_speeds(
    set_index: int, system: System, saved: Saved, input_history: Held | None
) -> Float[np.ndarray, "k rotors"]:
    """Squared speeds (k, rotors) [rad^2/s^2] of one set of rotors along a motion."""
    force, plain = _rotor_sets(system)[set_index]
    # Motors with a lag have their speeds as states, which the run has saved; only commands must be
    # evaluated anew.
    if isinstance(force, AbstractInternalForce) and force.internal.shape[0]:
        speed_names, names = force.internal_names(), internal_names(system)
        return np.asarray(saved.internal)[:, [names.index(name) for name in speed_names]] ** 2
    if callable(plain.speed_squared) or input_history is not None:
        no_inputs = Held(Inputs(()), np.zeros((len(saved.ts), 0)))
        inputs, values = no_inputs if input_history is None else input_history
        # Blocks of one size bound the memory and share one program.
        function = lambda *at: _commanded_speeds(
            set_index, system, inputs, *jax.tree.map(as_jax, at)
        )
        return in_blocks(function, 32, saved, values)
    constant = plain.speed_squared
    squared_speeds = force.clip_squares(constant) if isinstance(force, MotorRotors) else constant
    return np.broadcast_to(np.asarray(squared_speeds), (len(saved.ts), *np.shape(squared_speeds)))


@kept_jit
def _commanded_speeds(
    set_index: int, system: System, inputs: Inputs, saved: Saved, values: Any
) -> Any:
    def speeds_at(at: tuple[Saved, Any]) -> Any:
        (t, state, internal), value = at
        sampled_system = inputs.applied(with_internal(system, internal), value)
        force, plain = _rotor_sets(sampled_system)[set_index]
        squared = plain.commands(t, sampled_system.kinematics(state))
        return (
            force.clip_squares(squared) if isinstance(force, MotorRotors) else jnp.asarray(squared)
        )

    return jax.lax.map(speeds_at, (saved, values))


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
    import xarray as xr

    data = {name: (dims, np.asarray(values)) for name, (dims, values, _, _) in table.items()}
    return xr.Dataset(data, {"time": [0.0], **machine_coordinates(system)})


# --- runs of scenes


def to_dataset(run: Run) -> "xr.Dataset":
    """Labelled dataset of a run.

    Dimensions: time, body, axis (x, y, z), component (e0 to e3), joint, rotor. Every variable has
    `units` and `description`; attributes hold scene, parameters, settings, versions, date
    and certificate (the mappings as JSON). Estimated errors are NaN where there are none.
    """
    return _labelled_run(run).dataset()


def _labelled_run(run: Run) -> Labelled:
    """Content of a saved run; see `to_dataset`."""
    system, errors = run.scene.system, run.errors
    of_body = ("time", "body")
    exact = "estimated distance from the exact"
    table = _motion_table(system, run.states, run.trajectory.internal) | {
        "position_error": (of_body, errors.position, "m", f"{exact} position"),
        "angle_error": (of_body, errors.angle, "rad", f"{exact} orientation"),
        "velocity_error": (of_body, errors.velocity, "m/s", f"{exact} velocity"),
        "angular_velocity_error": (
            of_body, errors.angular_velocity, "rad/s", f"{exact} angular velocity",
        ),
    }  # fmt: skip
    table |= machine_table(system) | rotor_table(system, saved_states(run.trajectory))
    if run.model is not None:
        view, worst = run.snapshot, run.trajectory.worst
        vector, wrench = ("time", "body", "axis"), ("time", "joint", "axis")
        table |= {
            "acceleration": (vector, view.accelerations.v_rate, "m/s^2", "of the centre of mass"),
            "angular_acceleration": (vector, view.accelerations.omega_rate, "rad/s^2", "body axes"),
            "reaction_force": (wrench, view.reactions.force, "N", "of body i on body j, world axes"),
            "reaction_moment": (
                wrench, view.reactions.moment, "N m",
                "of body i on body j about the joint's point on body j, world axes",
            ),
            "kinetic_energy": (("time",), view.kinetic, "J", "of all bodies"),
            "potential_energy": (("time",), view.potential, "J", "of gravity and springs"),
            "work": (("time",), run.trajectory.work, "J", "done by forces without potential"),
            "position_violation": (("time",), worst.position, "m", "of lengths, the largest so far"),
            "velocity_violation": (("time",), worst.velocity, "m/s", "of their rates, the largest so far"),
        }  # fmt: skip
    coordinates = _motion_coordinates(system, run.ts, "saved times")
    return label_table(
        table, coordinates, format=FORMAT, format_version=FORMAT_VERSION, scene=run.scene.name,
        title=run.scene.title, notes=(*run.scene.warnings, *run.scene.notes), parameters=run.scene.parameters,
        settings=run.settings, certificate=run.certificate.to_dict(), watch=list(run.scene.watch),
    )  # fmt: skip


def save(run: Run, path: str | os.PathLike[str]) -> Path:
    """Save a run as NetCDF (HDF5), atomically; return the path.

    Numbers have Fletcher's checksum, which any reader of HDF5 verifies; a SHA-256 at the end of the
    file covers all content, and `load` verifies it.
    """
    return save_sealed(_labelled_run(run), path)


def save_certificate(run: Run, path: str | os.PathLike[str]) -> Path:
    """Save the certificate, settings and versions as JSON, atomically; return the path."""
    content = {
        "scene": run.scene.name,
        "settings": run.settings,
        "certificate": run.certificate.to_dict(),
        "versions": list_versions(),
    }
    return write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())


# --- closed loops

# Dimensions, unit and description of a saved signal.
Label = tuple[tuple[str, ...], str, str]


def loop_to_dataset(
    run: "LoopRun", labels: Mapping[str, Label] | None = None, **attributes: Any
) -> "xr.Dataset":
    """Labelled dataset of a closed loop's run.

    Dimensions: time, body, axis (x, y, z), component (e0 to e3), joint, rotor, input. Every
    variable has `units` and `description`; the units of the inputs are those of the coordinate
    `input_unit`. `stmuav view` draws the mechanism. Saved signals are variables of their own names,
    and of a signal that is a pytree one for each leaf.

    Args:
        labels: dimensions, unit and description of signals; others have numbered dimensions and the
            unit "see description".
        attributes: texts and numbers that are kept with it, others as JSON; `title` is the heading of
            its report and of the viewer.
    """
    return labelled_loop(run, labels, **attributes).dataset()


def labelled_loop(
    run: "LoopRun", labels: Mapping[str, Label] | None = None, **attributes: Any
) -> Labelled:
    """Labelled arrays with the content of `loop_to_dataset`."""
    rollout, system = run.rollout, run.plant.system
    internal = np.asarray(rollout.internal)
    table = _motion_table(system, run.states, internal) | {
        "command": (("time", "input"), rollout.inputs, "see input_unit", "inputs from the controller"),
        "work": (("time",), rollout.work, "J", "of forces without potential, zero if not computed"),
        "steps": (("time",), rollout.counts.accepted, "1", "steps taken so far"),
        "reason": (("time",), rollout.reason, "1", "code of LoopReason, zero if valid"),
    }  # fmt: skip
    past = Saved(run.ts, run.states, internal)
    input_history = Held(run.plant.inputs, np.asarray(rollout.inputs))
    table |= machine_table(system) | rotor_table(system, past, input_history)
    for signal, tree in rollout.signals.items():
        # leaves of a pytree have its name and their own place
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            leaf_path = jax.tree_util.keystr(path, simple=True, separator=".")
            name, values = f"{signal}.{leaf_path}" if leaf_path else signal, np.asarray(leaf)
            dims = ("time", *(f"{name}_{k}" for k in range(1, values.ndim)))
            label = (dims, "see description", f"signal '{name}' of the loop")
            dims, unit, description = (labels or {}).get(name, label)
            table[name] = (dims, values, unit, description)
    inputs = run.plant.inputs.names
    coordinates = _motion_coordinates(system, run.ts, "samples") | {
        "input": [name for name, _ in inputs],
        "input_unit": (("input",), [unit for _, unit in inputs], {}),
    }
    return label_table(
        table, coordinates, format=LOOP_FORMAT, format_version=LOOP_VERSION,
        rate=run.plant.rate, certificate=run.certificate.to_dict(), failure=run.failure,
        **attributes,
    )  # fmt: skip


def save_loop(
    run: "LoopRun",
    path: str | os.PathLike[str],
    labels: Mapping[str, Label] | None = None,
    **attributes: Any,
) -> Path:
    """Save a closed loop's run as NetCDF (HDF5), atomically; return the path.

    `load` reads it back, and refuses a file that is damaged; for the arguments see
    `loop_to_dataset`.
    """
    return save_sealed(labelled_loop(run, labels, **attributes), path)
