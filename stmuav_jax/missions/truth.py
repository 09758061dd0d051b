"""Truth of a mission: parameters of the true machine, unknown to its controller and estimator."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..checks.numbers import as_floats
from ..checks.schema import SHOWN, quote_name
from ..control.plant import Plant
from ..dynamics.simulation import Scene
from ..mechanics.parameters import Parameter, Parameters
from ..studies.disturbed_flights import (
    FactorTarget,
    drawn_table,
    suggest_names,
    table_entry,
)
from ..uav.allocation import RotorLimits
from ..uav.battery import Battery
from ..uav.motor import only_rotors
from .machine import Machine, input_names, scene_of
from .schema import MissionFile
from .signals import Gauges

# Numbers of these would be lengths on which loops, limits of strokes and controller agree.
_FIXED = ("geometry.", "posture.", "mount.", "workspace.", "stop.", "spin.", "case_")
_FREE = ("geometry.panel_com", "geometry.post_com", "geometry.rod_com")


class FlightBattery(NamedTuple):
    """Battery of a flight, and its state of charge at the start [1]."""

    battery: Battery
    charge: Float[Array, ""]


class Truth(NamedTuple):
    """Parts of a mission that depend on the true numbers.

    Attributes:
        plant: sampled plant. gauges: function of a `Sample` that returns the signals.
        speeds: limits of the rotor speeds, or None. battery: with its charge, or None.
    """

    plant: Plant
    gauges: Gauges
    speeds: RotorLimits | None
    battery: FlightBattery | None


def list_truth_parameters(
    entries: MissionFile, machine: Machine, battery: FlightBattery | None
) -> Parameters:
    """Parameters of a mission's machine, of its payloads and its battery, as the controller has them."""
    source = "the mission's"
    extra = {
        f"payload_{k}.mass": Parameter(payload.mass, "kg", source)
        for k, payload in enumerate(entries.payloads, 1)
    }
    if battery is not None:
        extra |= {
            "battery.capacity": Parameter(float(battery.battery.capacity), "C", source),
            "battery.resistance": Parameter(float(battery.battery.resistance), "ohm", source),
            "battery.state_of_charge": Parameter(float(battery.charge), "1", source),
        }
    table = machine.table
    return Parameters(table.name, {name: table[name] for name in table} | extra)


def apply_truth(entries: MissionFile, machine: Machine, table: Parameters) -> Parameters:
    """Table with the mission's `truth`.

    Raises:
        SettingError: names that are unknown or of no effect. ModelError: masses and inertias that no body has.
    """
    for name in entries.truth:
        find_target(table, machine, name, relative=False)
    values = {name: as_floats(value) for name, value in entries.truth.items()}
    return drawn_table(table, values, frozenset())


def make_truth(
    entries: MissionFile,
    machine: Machine,
    believed: Truth,
    table: Parameters,
    gusts: Any = None,
) -> Truth:
    """Parts of a mission with the numbers of a table, which may be traced.

    Args:
        believed: parts with the numbers that the controller has. gusts: seed in place of the mission's.
    """
    scene = scene_of(entries, table, gusts, machine.model)
    rotors = only_rotors(scene.system, "A mission").rotors
    nominal, gauges, payloads = believed.plant, believed.gauges, believed.gauges.payloads
    # another scene with the instruments, estimator and inputs of the mission's plant
    loaded, changes = scene, ()
    if payloads is not None:
        masses = [table.value(f"payload_{k + 1}.mass") for k in range(len(payloads.bodies))]
        payloads = eqx.tree_at(lambda p: p.mass, payloads, as_floats(masses))
        loaded = payloads.load(scene)
        changes = payloads.changes(loaded.system)
    plant = Plant(
        loaded, rate=nominal.rate, changes=changes, observe=nominal.observe, inputs=input_names(machine),
        before=nominal.before, delay=nominal.late / nominal.rate, standing=nominal.stood / nominal.rate,
        sensors=nominal.bench.instruments, estimator=nominal.estimator, memory=nominal.memory,
        steps=nominal.motion.steps,
    )  # fmt: skip
    formulation = nominal.motion.problem.method.formulation
    plant = plant.with_motions(lambda motion: motion.with_method(formulation=formulation))
    gauges = eqx.tree_at(
        lambda g: (g.rotors, g.payloads, g.jointed),
        gauges,
        (rotors, payloads, None if gauges.jointed is None else plant.system),
        is_leaf=lambda x: x is None,
    )
    battery = believed.battery
    if battery is not None:
        names = ("capacity", "resistance", "state_of_charge")
        numbers = [as_floats(table.value(f"battery.{name}")) for name in names]
        where = lambda b: (b.battery.capacity, b.battery.resistance, b.charge)
        battery = eqx.tree_at(where, battery, numbers)
    return Truth(plant, gauges, narrow_limits(believed.speeds, scene), battery)


def find_target(table: Parameters, machine: Machine, name: str, relative: bool) -> FactorTarget:
    """Target of a name of the truth, which the mission's machine uses.

    Raises:
        SettingError: a name that is unknown, or of no effect.
    """

    def unknown() -> str:
        names = [key for key in table if not _describe_fault(machine, key, key)]
        hint = suggest_names(name.partition("[")[0][:SHOWN], names)
        return f"is no parameter of {machine.scene.name}.{hint}"

    target = table_entry(table, name, relative, unknown)
    if fault := _describe_fault(machine, name, target.name):
        raise SettingError(fault)
    return target


def _describe_fault(machine: Machine, factor: str, name: str) -> str:
    """Why no flight of the machine would have a number, or not rightly; empty if it would."""
    scene, model = machine.scene, machine.model
    if name not in machine.table:
        return ""
    if model is None and name.startswith(_FIXED) and name not in _FREE:
        return (
            f"{quote_name(factor)} cannot be a factor of a mission's study or part of its truth: loops and limits "
            "of strokes are those of the mission's machine. Masses, inertias, centres of mass, rotors, "
            "drag and motors can be."
        )
    line: Mapping[str, Any] | None = scene.parameters.get(name)
    if (line is None) if model is None else (name not in model.used_parameters()):
        return f"{quote_name(factor)} has no effect on this mission: its machine does not use it."
    if model is None and line != machine.table[name].plain():
        return (
            f"'{name}' is set by the mission's options: it cannot be a factor or part of the truth."
        )
    return ""


def narrow_limits(speeds: RotorLimits | None, scene: Scene) -> RotorLimits | None:
    """Limits of the rotor speeds within those of a scene's motors."""
    motors = getattr(only_rotors(scene.system, "A mission"), "limits", None)
    if speeds is None or motors is None:
        return speeds
    return RotorLimits(
        jnp.maximum(as_floats(speeds.lowest), as_floats(motors.lowest)),
        jnp.minimum(as_floats(speeds.highest), as_floats(motors.highest)),
    )
