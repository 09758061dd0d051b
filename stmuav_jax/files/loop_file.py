"""Runs of closed loops as labelled datasets and NetCDF files, and back."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from ..control.closed_loop import LoopRun
from ..dynamics.evaluation import Saved
from ..mechanics.internal import internal_names
from .labelled import Labelled
from .machine import Held, machine_coordinates, machine_table, rotor_table
from .netcdf import LOOP_FORMAT, LOOP_VERSION, labelled, save_sealed

if TYPE_CHECKING:
    import xarray as xr

# Dimensions, unit and description of a saved signal.
Label = tuple[tuple[str, ...], str, str]


def loop_to_dataset(
    run: LoopRun, labels: Mapping[str, Label] | None = None, **attributes: Any
) -> "xr.Dataset":
    """Labelled dataset of a closed loop's run.

    Dimensions: time, body, axis (x, y, z), component (e0 to e3), joint, rotor, input. Every
    variable has `units` and `description`; the units of the inputs are those of the coordinate
    `input_unit`. `stmuav view` draws the mechanism. Saved signals are variables of their own names,
    and of a signal that is a pytree one for each leaf.

    Args:
        labels: dimensions, unit and description of signals; others have numbered dimensions and the
            unit "see description".
        attributes: texts and numbers that are kept with it; others as JSON.
    """
    return labelled_loop(run, labels, **attributes).dataset()


def labelled_loop(
    run: LoopRun, labels: Mapping[str, Label] | None = None, **attributes: Any
) -> Labelled:
    """Labelled arrays with the content of `loop_to_dataset`."""
    found, states = run.rollout, run.states
    vector = ("time", "body", "axis")
    table: dict[str, tuple[tuple[str, ...], Any, str, str]] = {
        "position": (vector, states.r, "m", "centre of mass, world axes"),
        "euler_parameters": (("time", "body", "component"), states.p, "1", "body to world"),
        "velocity": (vector, states.v, "m/s", "of the centre of mass, world axes"),
        "angular_velocity": (vector, states.omega, "rad/s", "body axes"),
        "command": (("time", "input"), found.inputs, "see input_unit", "inputs from the controller"),
        "work": (("time",), found.work, "J", "of forces without potential, zero if not computed"),
        "steps": (("time",), found.counts.accepted, "1", "steps taken so far"),
        "reason": (("time",), found.reason, "1", "code of LoopReason, zero if valid"),
    }  # fmt: skip
    names = internal_names(run.plant.system)
    if names:
        table["internal"] = (
            ("time", "internal_state"), found.internal, "see internal_state",
            "states of forces, units in their names",
        )  # fmt: skip
    system = run.plant.system
    past = Saved(run.ts, states, np.asarray(found.internal))
    held = Held(run.plant.inputs, np.asarray(found.inputs))
    table |= machine_table(system) | rotor_table(system, past, held)
    for name, values in _flat(found.signals).items():
        dims, unit, words = (labels or {}).get(name, _unlabelled(name, values))
        table[name] = (dims, values, unit, words)
    inputs = run.plant.inputs.names
    coordinates = {
        "time": (("time",), np.asarray(run.ts), {"units": "s", "description": "samples"}),
        **machine_coordinates(system),
        "component": ["e0", "e1", "e2", "e3"],
        "input": [name for name, _ in inputs],
        "input_unit": (("input",), [unit for _, unit in inputs], {}),
    } | ({"internal_state": list(names)} if names else {})
    return labelled(
        table, coordinates, format=LOOP_FORMAT, format_version=LOOP_VERSION,
        rate=run.plant.rate, certificate=run.certificate.to_dict(), failure=run.failure,
        **attributes,
    )  # fmt: skip


def _flat(signals: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Arrays of all signals by name; leaves of a pytree have its name and their own place."""
    found = {}
    for name, tree in signals.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            own = jax.tree_util.keystr(path, simple=True, separator=".")
            found[f"{name}.{own}" if own else name] = np.asarray(leaf)
    return found


def _unlabelled(name: str, values: np.ndarray) -> Label:
    dims = [f"{name}_{k}" for k in range(1, values.ndim)]
    return ("time", *dims), "see description", f"signal '{name}' of the loop"


def save_loop(
    run: LoopRun,
    path: str | os.PathLike[str],
    labels: Mapping[str, Label] | None = None,
    **attributes: Any,
) -> Path:
    """Save a closed loop's run as NetCDF (HDF5), atomically; return the path.

    `load` reads it back, and refuses a file that is damaged; for the arguments see
    `loop_to_dataset`.
    """
    return save_sealed(labelled_loop(run, labels, **attributes), path)
