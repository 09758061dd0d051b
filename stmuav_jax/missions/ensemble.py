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
        machine = mission.machine
        self.nominal = _Nominal(
            mission.truth, mission.controller, mission.references, machine.limits
        )
        self.mission, self.relative = mission, relative
        self.table = mission.table

    def __reduce__(self) -> Any:
        """State as entries of the mission's file, from which it is made again."""
        return _remake_evaluation, (
            self.mission.file.model_dump(),
            self.mission.folder,
            self.relative,
        )

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
            chunk_rollout = rollout(
                plant, of.controller, samples, reference=of.references, memory=memory,
                signals={"gauges": gauges}, start=start,
            )  # fmt: skip
            return (
                chunk_rollout.end,
                chunk_rollout.memory,
                _join_worst(mission, of, worst, chunk_rollout),
            ), None

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
    tolerances = mission_file.tolerances
    for name in ("touchdown", "sink"):
        if getattr(tolerances, name) is not None:
            raise SettingError(
                f"A study of a mission does not support 'tolerances.{name}': leave it out."
            )
    late = list_unreached(json.loads(mission_file.model_dump_json()), mission_file.t1)
    late += [
        f"the tolerances of {subject}, which hold from t = {t:g} s on"
        for subject, t in (
            ("position and tilt", tolerances.after),
            ("the panel", tolerances.panel_after),
        )
        if t is not None and t > mission_file.t1 + AT_ONCE
    ]
    if late:
        raise SettingError(
            f"The flights of a study end at t = {mission_file.t1:g} s, before {', '.join(late)}: give the study a "
            "later 't1', or leave these entries out of its mission."
        )


def _join_worst(mission: Mission, of: _Nominal, worst: Worst, chunk_rollout: Rollout) -> Worst:
    """Largest errors and smallest margins after further samples."""
    entries, gauges, ts = mission.file, chunk_rollout.signals["gauges"], chunk_rollout.ts
    target = entries.tolerances
    flight_mask = ts <= entries.t1 + AT_ONCE
    charge, next_charge, is_drained = worst.charge, worst.next_charge, worst.is_drained
    ends_here = jnp.zeros_like(flight_mask)
    if of.truth.battery is not None:
        battery, demand = of.truth.battery.battery, gauges["electric_power"]
        charges, currents, _, next_charge = drain_samples(
            battery, next_charge, demand, jnp.asarray(1.0 / mission.plant.rate)
        )
        is_over = (charges <= battery.reserve) | (jnp.isfinite(demand) & ~jnp.isfinite(currents))
        # the sample at which the battery ends is the last of the flight
        flight_mask &= (jnp.cumsum(is_over) - is_over == 0) & ~is_drained
        ends_here = flight_mask & is_over
        is_drained = is_drained | jnp.any(ends_here)
        charge = jnp.minimum(charge, jnp.min(jnp.where(flight_mask, charges, 1.0)))
    base = flight_mask & (ts >= target.after - AT_ONCE)
    if "gear_load" in gauges:
        # as in a verdict, what the ground carries is not in flight
        base = base & (gauges["gear_load"] == 0.0)
    later = target.after if target.panel_after is None else target.panel_after
    panel = flight_mask & (ts >= later - AT_ONCE)
    # Samples that do not count become the value that changes nothing: shapes are fixed in a
    # compiled program.
    most = lambda values, of: jnp.max(jnp.where(of, values, 0.0))
    distances = jnp.sqrt(jnp.sum(gauges["position_error"] ** 2, axis=1))
    # a reason stays for the rest of a chunk
    now = jnp.max(jnp.where(flight_mask, chunk_rollout.reason, 0))
    reason = jnp.where(worst.reason == LoopReason.VALID, now, worst.reason)
    valid = (
        flight_mask
        & (chunk_rollout.reason == LoopReason.VALID)
        & (worst.reason == LoopReason.VALID)
    )
    last = mission.samples - 1
    # Energy is a sum of rectangles, which begins at each sample: the last one begins none.
    power = jnp.where(
        flight_mask & ~ends_here & (ts < (last - 0.5) / mission.plant.rate),
        gauges["electric_power"],
        0.0,
    )
    rotors, strokes, forces = worst.rotors, worst.strokes, worst.forces
    if of.truth.speeds is not None:
        low, high = (
            jnp.sqrt(x) for x in of.truth.speeds.squared(mission.machine.rotors.spin.shape[0])
        )
        # a rotor that has failed is within no limits
        counted = flight_mask[:, None] & (ts[:, None] < of.controller.lost[:, 0])
        rotors = jnp.minimum(rotors, _smallest_margin(gauges["rotor_speed"], low, high, counted))
    if of.limits is not None:
        low, high = of.limits.lower, of.limits.upper
        strokes = jnp.minimum(
            strokes, _smallest_margin(gauges["displacement"], low, high, flight_mask[:, None])
        )
    if mission.machine.force is not None:
        top, jam = of.controller.force, of.controller.jam
        counted = flight_mask[:, None] & (True if jam is None else ts[:, None] < jam.at)
        forces = jnp.minimum(
            forces, _smallest_margin(gauges["commanded_force"], -top, top, counted)
        )
    efforts, joints = worst.efforts, worst.joints
    if "joint_error" in gauges:
        counted = base[:, None]
        errors = jnp.where(counted, jnp.abs(gauges["joint_error"]), 0.0)
        joints = jnp.maximum(joints, jnp.max(errors, axis=0))
        top = of.truth.gauges.efforts
        is_limited = np.isfinite(mission.machine.efforts)
        counted = flight_mask[:, None] & is_limited
        efforts = jnp.minimum(
            efforts, _smallest_margin(gauges["commanded_effort"], -top, top, counted)
        )
    panel_error = worst.panel
    if "panel_error" in gauges:
        panel_error = jnp.maximum(panel_error, most(gauges["panel_error"], panel))
    return Worst(
        jnp.maximum(worst.position, most(distances, base)),
        jnp.maximum(worst.tilt, most(gauges["tilt_error"], base)),
        panel_error, joints, rotors, strokes, forces, efforts,
        worst.energy + jnp.sum(power) / mission.plant.rate, charge, next_charge, is_drained, reason,
        jnp.maximum(worst.end, jnp.max(jnp.where(valid, ts, 0.0))),
    )  # fmt: skip


def _smallest_margin(values: Array, low: Array, high: Array, counted: Array) -> Float[Array, ""]:
    """Smallest distance from limits as a share of the range, of those values that count."""
    margins = jnp.minimum(values - low, high - values) / (high - low)
    return jnp.min(jnp.where(counted, margins, 1.0))


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
    machine, none = mission.machine, set()
    if mission.battery is None:
        none |= {"state_of_charge"}
    if machine.bodies is None:
        none |= {"panel_error", "stroke_margin"}
    if machine.speeds is None:
        none |= {"rotor_margin"}
    if machine.force is None:
        none |= {"force_margin"}
    if not np.any(np.isfinite(machine.efforts)):
        none |= {"effort_margin"}
    of_joints = {
        f"{column_name(drive.name)}_error": (drive.unit, f"largest error of joint {drive.name}")
        for drive in machine.joints
    }
    return {name: _QUANTITIES[name] for name in _QUANTITIES if name not in none} | of_joints
