"""Monte Carlo study of a mission: it is flown by many machines, each in its own gusts and noise.

The truth is drawn: parameters of the machine, gusts, noise of the sensors. Controller and
estimator use the numbers of the mission's file. Flights go side by side in one compiled program,
which keeps of each its largest errors and smallest margins.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..checks.numbers import as_floats
from ..checks.schema import validate_model
from ..control.closed_loop import LoopReason, Rollout, rollout
from ..control.plant import PlantState
from ..mechanics.parameters import Parameters
from ..studies.columns import FINE, Column, column_name
from ..studies.disturbed_flights import (
    digest_table,
    drawn_table,
    factor_columns,
    is_possible,
)
from ..studies.study import Study
from ..studies.study_file import check_study, factors_of, study_settings
from .controller import AT_ONCE
from .flight import drain_samples
from .mission import Mission, load_mission, make_mission
from .outcome import AT_LIMIT, list_unreached
from .schema import MissionFile, MissionStudyFile
from .truth import Truth, find_target, make_truth

# Flights side by side in one program, of which a sample always has the same place.
LANES = 16
# Time of flight after which maxima are joined and samples let go [s].
CHUNK = 1.0
NOT_PHYSICAL = 2 + len(LoopReason)
_DEGREE = np.pi / 180

_QUANTITIES: dict[str, tuple[str, str]] = {
    "position_error": ("m", "largest position error"),
    "tilt_error": ("rad", "largest tilt error"),
    "panel_error": ("rad", "largest panel error"),
    "rotor_margin": ("1", "smallest margin of the rotor speeds, share of the range"),
    "stroke_margin": ("1", "smallest margin of the strokes, share of the range"),
    "force_margin": ("1", "smallest margin of the actuators' forces, share of the range"),
    "effort_margin": ("1", "smallest margin of the joint efforts, share of the range"),
    "energy": ("J", "electrical energy used"),
    "state_of_charge": ("1", "state of charge of the battery at the end"),
    "met": ("1", "whether all tolerances and limits were met"),
}


class _Nominal(NamedTuple):
    """Parts of the mission that all of its flights have, whose arrays are arguments of the program."""

    truth: Truth
    controller: Any
    references: Any
    limits: Any


class Worst(NamedTuple):
    """Largest errors and smallest margins of a flight so far.

    Attributes:
        position [m], tilt, panel [rad]: largest errors from the times of the tolerances on.
        joints: largest errors of the driven joints (n,) [rad] or [m].
        rotors, strokes, forces, efforts: smallest distances from the limits, as shares of the range.
        energy: electrical energy used [J]. charge: state of charge at the last sample [1].
        next_charge: after it. is_drained: True once the battery is empty or the demand exceeds its power.
        reason: code of `LoopReason`. end: time of the last valid sample [s].
    """

    position: Float[Array, ""]
    tilt: Float[Array, ""]
    panel: Float[Array, ""]
    joints: Float[Array, " n"]
    rotors: Float[Array, ""]
    strokes: Float[Array, ""]
    forces: Float[Array, ""]
    efforts: Float[Array, ""]
    energy: Float[Array, ""]
    charge: Float[Array, ""]
    next_charge: Float[Array, ""]
    is_drained: Array
    reason: Array
    end: Float[Array, ""]


class MissionEvaluation(eqx.Module):
    """Function of a sample that flies a mission with its parameters and returns the worst values of the flight.

    The sample's key gives the seeds of gusts and of noise.

    Attributes:
        nominal: parts of the mission that all flights have, as arrays. mission: the mission.
        table: parameters that can be factors. relative: names of factors that multiply the mission's value.
    """

    nominal: _Nominal
    mission: Mission
    table: Parameters
    relative: frozenset[str] = eqx.field(static=True)

    def __init__(self, mission: Mission, relative: frozenset[str] = frozenset()) -> None:
        controller, limits = mission.controller, mission.machine.limits
        self.nominal = _Nominal(mission.truth, controller, mission.references, limits)
        self.mission, self.table, self.relative = mission, mission.table, relative

    def __reduce__(self) -> Any:
        """State as entries of the mission's file, from which it is made again."""
        mission = self.mission
        return _remake_evaluation, (mission.file.model_dump(), mission.folder, self.relative)

    def __call__(self, sample: Mapping[str, Array], key: Array) -> dict[str, Any]:
        """Outcomes of one flight by column."""
        possible = is_possible(self.table, sample, self.relative)
        sampled = drawn_table(self.table, sample, self.relative)
        # impossible samples fly as the mission's own machine does, and are left out
        changed = {
            name: sampled.value(name) for name in sampled if sampled[name] is not self.table[name]
        }
        choose = lambda name: jnp.where(possible, changed[name], as_floats(self.table.value(name)))
        worst = self._fly(self.table.replaced({name: choose(name) for name in changed}), key)
        valid = possible & (worst.reason == LoopReason.VALID)
        hide = lambda x: jnp.where(valid, x, jnp.nan)
        joints = self.mission.machine.joints
        values = worst.position, worst.tilt, worst.panel, *worst[4:10]
        measures = dict(zip(_QUANTITIES, values, strict=False))
        measures |= {
            f"{column_name(drive.name)}_error": worst.joints[k] for k, drive in enumerate(joints)
        }
        return {name: hide(x) for name, x in measures.items()} | {
            "met": valid & self._check_compliance(worst),
            "end": jnp.where(possible, worst.end, 0.0),
            "status": jnp.where(possible, FINE + worst.reason, NOT_PHYSICAL),
        }

    def _check_compliance(self, worst: Worst) -> Array:
        """True if a flight met the tolerances and limits of the mission."""
        target = self.mission.file.tolerances
        margins = (worst.rotors, worst.strokes, worst.forces, worst.efforts)
        is_compliant = (jnp.min(jnp.stack(margins)) >= -AT_LIMIT) & ~worst.is_drained
        for k, drive in enumerate(self.mission.machine.joints):
            most = target.joints.get(drive.name, np.inf) * (_DEGREE if drive.unit == "rad" else 1.0)
            is_compliant &= worst.joints[k] <= most
        angle_checks = (worst.tilt / _DEGREE, target.tilt), (worst.panel / _DEGREE, target.panel)
        for value, most in ((worst.position, target.position), *angle_checks):
            is_compliant &= True if most is None else value <= most
        return is_compliant

    def _fly(self, table: Parameters, key: Array) -> Worst:
        """Largest errors and smallest margins of one flight, by the numbers of a table."""
        mission, seeds = self.mission, jax.random.key_data(key)
        truth = make_truth(mission.file, mission.machine, self.nominal.truth, table, seeds[0])
        of = self.nominal._replace(truth=truth)
        plant, gauges = truth.plant, truth.gauges
        # Worst values are joined chunk by chunk: rows of whole flights, of all lanes, would not
        # fit in memory. The last chunk goes beyond the end by less than one sample per chunk.
        chunks = -(-mission.samples // max(round(CHUNK * plant.rate), 2))
        samples = -(-mission.samples // chunks)

        def fly_chunk(now: tuple[PlantState, Any, Worst], _: None) -> tuple[Any, None]:
            start, memory, worst = now
            rows = rollout(
                plant, of.controller, samples, reference=of.references, memory=memory,
                signals={"gauges": gauges}, start=start,
            )  # fmt: skip
            return (rows.end, rows.memory, _join_worst(mission, of, worst, rows)), None

        zero, top = jnp.zeros(()), jnp.ones(())
        reason = jnp.zeros((), jnp.int8)
        joints = jnp.zeros(len(mission.machine.joints))
        charge = top if truth.battery is None else truth.battery.charge
        initial_worst = Worst(
            zero, zero, zero, joints, top, top, top, top, zero, charge, charge, jnp.zeros((), bool), reason, zero
        )  # fmt: skip
        start = plant.reset(jax.random.key(seeds[1]))
        first = (start, jax.tree.map(jnp.asarray, of.controller.start()), initial_worst)
        (_, _, worst), _ = jax.lax.scan(fly_chunk, first, length=chunks)
        return worst


def _check_judged(mission_file: MissionFile) -> None:
    """Raise `SettingError` for entries of a mission that no flight of its study comes to."""
    tolerances, t1 = mission_file.tolerances, mission_file.t1
    for name in ("touchdown", "sink"):
        if getattr(tolerances, name) is not None:
            raise SettingError(
                f"A study of a mission does not support 'tolerances.{name}': leave it out."
            )
    late = list_unreached(json.loads(mission_file.model_dump_json()), t1)
    starts = {"position and tilt": tolerances.after, "the panel": tolerances.panel_after}
    late += [
        f"the tolerances of {subject}, which hold from t = {t:g} s on"
        for subject, t in starts.items()
        if t is not None and t > t1 + AT_ONCE
    ]
    if late:
        raise SettingError(
            f"The flights of a study end at t = {t1:g} s, before {', '.join(late)}: give the study a "
            "later 't1', or leave these entries out of its mission."
        )


def _join_worst(mission: Mission, of: _Nominal, worst: Worst, chunk_rollout: Rollout) -> Worst:
    """Largest errors and smallest margins after further samples."""
    entries, gauges, ts = mission.file, chunk_rollout.signals["gauges"], chunk_rollout.ts
    target, rate = entries.tolerances, mission.plant.rate
    flight_mask = ts <= entries.t1 + AT_ONCE
    ends_here = jnp.zeros_like(flight_mask)
    if of.truth.battery is not None:
        battery, demand = of.truth.battery.battery, gauges["electric_power"]
        charges, currents, _, next_charge = drain_samples(
            battery, worst.next_charge, demand, jnp.asarray(1.0 / rate)
        )
        is_over = (charges <= battery.reserve) | (jnp.isfinite(demand) & ~jnp.isfinite(currents))
        # the sample at which the battery ends is the last of the flight
        flight_mask &= (jnp.cumsum(is_over) - is_over == 0) & ~worst.is_drained
        ends_here = flight_mask & is_over
        worst = worst._replace(
            charge=jnp.minimum(worst.charge, jnp.min(jnp.where(flight_mask, charges, 1.0))),
            next_charge=next_charge,
            is_drained=worst.is_drained | jnp.any(ends_here),
        )
    base = flight_mask & (ts >= target.after - AT_ONCE)
    if "gear_load" in gauges:
        # as in a verdict, what the ground carries is not in flight
        base = base & (gauges["gear_load"] == 0.0)
    later = target.after if target.panel_after is None else target.panel_after
    panel = flight_mask & (ts >= later - AT_ONCE)

    # Samples that do not count become the value that changes nothing: shapes are fixed in a
    # compiled program.
    def join_largest(before: Array, values: Array, counted: Array) -> Array:
        return jnp.maximum(before, jnp.max(jnp.where(counted, values, 0.0), axis=0))

    def join_margin(before: Array, signal: str, low: Array, high: Array, counted: Array) -> Array:
        """Smallest distance from limits as a share of the range, of those values that count."""
        margins = jnp.minimum(gauges[signal] - low, high - gauges[signal]) / (high - low)
        return jnp.minimum(before, jnp.min(jnp.where(counted, margins, 1.0)))

    valid = flight_mask & (chunk_rollout.reason == LoopReason.VALID)
    valid &= worst.reason == LoopReason.VALID
    # Energy is a sum of rectangles, which begins at each sample: the last one begins none.
    used = flight_mask & ~ends_here & (ts < (mission.samples - 1.5) / rate)
    power = jnp.where(used, gauges["electric_power"], 0.0)
    distances = jnp.sqrt(jnp.sum(gauges["position_error"] ** 2, axis=1))
    # a reason stays for the rest of a chunk
    now = jnp.max(jnp.where(flight_mask, chunk_rollout.reason, 0))
    worst = worst._replace(
        position=join_largest(worst.position, distances, base),
        tilt=join_largest(worst.tilt, gauges["tilt_error"], base),
        energy=worst.energy + jnp.sum(power) / rate,
        reason=jnp.where(worst.reason == LoopReason.VALID, now, worst.reason),
        end=join_largest(worst.end, ts, valid),
    )
    if "panel_error" in gauges:
        worst = worst._replace(panel=join_largest(worst.panel, gauges["panel_error"], panel))
    if of.truth.speeds is not None:
        count = mission.machine.rotors.spin.shape[0]
        low, high = (jnp.sqrt(x) for x in of.truth.speeds.squared(count))
        # a rotor that has failed is within no limits
        counted = flight_mask[:, None] & (ts[:, None] < of.controller.lost[:, 0])
        rotors = join_margin(worst.rotors, "rotor_speed", low, high, counted)
        worst = worst._replace(rotors=rotors)
    if of.limits is not None:
        low, high, counted = of.limits.lower, of.limits.upper, flight_mask[:, None]
        strokes = join_margin(worst.strokes, "displacement", low, high, counted)
        worst = worst._replace(strokes=strokes)
    if mission.machine.force is not None:
        top, jam = of.controller.force, of.controller.jam
        counted = flight_mask[:, None] & (True if jam is None else ts[:, None] < jam.at)
        forces = join_margin(worst.forces, "commanded_force", -top, top, counted)
        worst = worst._replace(forces=forces)
    if "joint_error" in gauges:
        errors, top = jnp.abs(gauges["joint_error"]), of.truth.gauges.efforts
        counted = flight_mask[:, None] & np.isfinite(mission.machine.efforts)
        worst = worst._replace(
            joints=join_largest(worst.joints, errors, base[:, None]),
            efforts=join_margin(worst.efforts, "commanded_effort", -top, top, counted),
        )
    return worst


def _remake_evaluation(
    entries: Mapping[str, Any], folder: Path, relative: frozenset[str]
) -> MissionEvaluation:
    with jax.enable_x64(True):
        return MissionEvaluation(make_mission(entries, folder), relative)


def make_mission_study(
    mission: Mission,
    factors: Mapping[str, Any],
    *,
    relative: frozenset[str] = frozenset(),
    lanes: int | None = None,
    **settings: Any,
) -> Study:
    """Study of a mission, flown by many machines, each in its own gusts and noise.

    Args:
        mission: the mission.
        factors: distributions by name: of lines of the parameter table of the scene or of the model's file, and
            of the masses `payload_1.mass`, ... of the mission's payloads [kg], and of `battery.capacity` [C],
            `battery.resistance` [ohm] and `battery.state_of_charge` at the start [1].
        relative: names of factors that multiply the mission's value.
        lanes: flights computed together, default 16 on any device.
        settings: samples, seed, design, name and others of `stmuav_jax.Study`.

    Raises:
        SettingError: entries later than the end of its flights, or factors that are unknown, lengths, or
            without effect.
    """
    _check_judged(mission.file)
    evaluation = MissionEvaluation(mission, relative)
    model = mission.machine.model
    loop_reasons = {
        1 + int(reason): reason.label for reason in LoopReason if reason != LoopReason.VALID
    }
    quantities = _list_quantities(mission)
    target_of = lambda factor: find_target(
        evaluation.table, mission.machine, factor, factor in relative
    )
    columns = {
        name: Column("int8" if name == "met" else "float64", unit, description)
        for name, (unit, description) in quantities.items()
    }
    columns["end"] = Column("float64", "s", "last time with valid numbers", "diagnostic")
    columns["status"] = Column("int8", "1", "how the flight ended", "status")
    columns = factor_columns(factors, target_of, relative, columns)
    return Study(
        evaluation, factors, columns=columns,
        reasons=loop_reasons | {NOT_PHYSICAL: "masses or inertias that no body can have"},
        identity={
            "kind": "missions",
            "mission": json.loads(mission.file.model_dump_json(exclude={"title"})),
            "parameters": digest_table(evaluation.table, "" if model is None else model.digest),
            "relative": sorted(relative), "failure": {"quantity": "met", "below": 0.5},
        },
        lanes=LANES if lanes is None else lanes, **settings,
    )  # fmt: skip


def load_mission_study(
    plain: Mapping[str, Any], folder: Path | str = ".", **settings: Any
) -> Study:
    """Study of a mission from its plain data, in the form of its TOML file.

    Args:
        folder: folder from which a mission's file is sought.
        settings: `lanes` and `devices` of the `stmuav_jax.Study`.

    Raises:
        SettingError: entries that are unknown, missing or out of range; also as for `make_mission_study`.
        FileError: see `load_mission`.
    """
    entries = validate_model(MissionStudyFile, plain, "A study of a mission")
    factors, relative = factors_of(entries.factors)
    # the study's own entries first: a mission takes time to make
    check_study(plain)
    source = entries.mission
    path = Path(folder) / source if source.endswith(".toml") else source
    mission = load_mission(path, t1=entries.t1)
    return make_mission_study(
        mission, factors, relative=relative, **study_settings(entries), **settings
    )


def _list_quantities(mission: Mission) -> dict[str, tuple[str, str]]:
    """Units and descriptions of the quantities that a mission's flights have."""
    machine = mission.machine
    absent = {
        "state_of_charge": mission.battery is None,
        "panel_error": machine.bodies is None,
        "stroke_margin": machine.bodies is None,
        "rotor_margin": machine.speeds is None,
        "force_margin": machine.force is None,
        "effort_margin": not np.any(np.isfinite(machine.efforts)),
    }
    of_joints = {
        f"{column_name(drive.name)}_error": (drive.unit, f"largest error of joint {drive.name}")
        for drive in machine.joints
    }
    return {k: text for k, text in _QUANTITIES.items() if not absent.get(k)} | of_joints
