"""Monte Carlo study of a mission: it is flown by many machines, each in its own gusts and noise.

The truth is drawn: parameters of the machine, gusts, noise of the sensors. What controller and
estimator believe stays that of the mission's file. Flights go side by side in one compiled program,
which keeps of each its largest errors and smallest margins.
"""

import hashlib
import json
from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import program_of_shapes
from ..checks.errors import SettingError
from ..checks.schema import SHOWN, checked, named
from ..control.plant import Plant, PlantState
from ..control.rolling import LoopReason, Rollout, rollout
from ..dynamics.scene import Scene
from ..montecarlo.factors import alike, drawn_table, possible_tables, table_entry
from ..montecarlo.sampling import Sampling
from ..montecarlo.schema import Drawing
from ..montecarlo.study import factors_of
from ..montecarlo.work import FINE, AbstractWork, Axis, Column, column_name
from .gauges import Gauges
from .machine import Machine, input_names, scene_of
from .mission import Mission, load_mission, make_mission
from .outcome import AT_LIMIT, AT_ONCE
from .schema import MissionStudyFile

# Flights side by side in one program, of which a sample always has the same place.
LANES = 16
# Time of flight after which maxima are joined and samples let go [s].
CHUNK = 1.0
NOT_PHYSICAL = 2 + len(LoopReason)
_DEGREE = np.pi / 180
# Factors of these would be lengths on which loops, limits of strokes and controller agree.
_FIXED = ("geometry.", "posture.", "mount.", "workspace.", "stop.", "spin.", "case_")
_FREE = ("geometry.panel_com", "geometry.post_com", "geometry.rod_com")

_QUANTITIES: dict[str, tuple[str, str]] = {
    "position_error": ("m", "largest position error"),
    "tilt_error": ("rad", "largest tilt error"),
    "panel_error": ("rad", "largest panel error"),
    "rotor_margin": ("1", "smallest margin of the rotor speeds, share of the range"),
    "stroke_margin": ("1", "smallest margin of the strokes, share of the range"),
    "force_margin": ("1", "smallest margin of the actuators' forces, share of the range"),
    "energy": ("J", "electrical energy used"),
    "kept": ("1", "whether all tolerances and limits were kept"),
}


class _Nominal(NamedTuple):
    """Parts of the mission that all of its flights have, whose arrays are arguments of the program."""

    plant: Plant
    controller: Any
    references: Any
    gauges: Gauges
    speeds: Any
    limits: Any


class Worst(NamedTuple):
    """Largest errors and smallest margins of a flight so far.

    Attributes:
        position [m], tilt, panel [rad]: largest errors from the times of the tolerances on.
        rotors, strokes, forces: smallest distances from the limits, as shares of the range.
        energy: electrical energy used [J].
        reason: code of `LoopReason`. end: time of the last valid sample [s].
    """

    position: Float[Array, ""]
    tilt: Float[Array, ""]
    panel: Float[Array, ""]
    rotors: Float[Array, ""]
    strokes: Float[Array, ""]
    forces: Float[Array, ""]
    energy: Float[Array, ""]
    reason: Array
    end: Float[Array, ""]


class MissionWork(AbstractWork):
    """Work of a study of a mission: its flights by sample number.

    Args:
        mission: the mission, of a scene, without a battery.
        sampling: factors, lines of the scene's parameter table, with their design.
        relative: names of factors that multiply the mission's value.
        name: short name for files.

    Raises:
        SettingError: a model's mission, one with a battery, factors that are unknown, lengths, or of
            no effect.
    """

    def __init__(
        self,
        mission: Mission,
        sampling: Sampling,
        *,
        relative: frozenset[str] = frozenset(),
        name: str = "mission",
    ) -> None:
        if mission.machine.table is None:
            raise SettingError("A study of a mission needs one whose machine is a scene.")
        if mission.battery is not None:
            raise SettingError("A study of a mission has no battery: leave [battery] out.")
        self.mission, self.sampling = mission, sampling
        self.relative, self.name = relative, name
        self._check_factors()

    def __getstate__(self) -> dict[str, Any]:
        """State as entries of the mission's file, from which it is made again."""
        keep = {"sampling": self.sampling, "relative": self.relative, "name": self.name}
        return {**keep, "file": self.mission.file.model_dump()}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name in ("sampling", "relative", "name"):
            setattr(self, name, state[name])
        with jax.enable_x64(True):
            self.mission = make_mission(state["file"])

    @property
    def identity(self) -> Mapping[str, Any]:
        """Plain data of the mission, the parameters and the sampling."""
        text = json.dumps(self._numbers, sort_keys=True)
        return {
            "kind": "missions", "name": self.name, "lanes": LANES,
            "mission": json.loads(self.mission.file.model_dump_json(exclude={"title"})),
            "parameters": hashlib.sha256(text.encode()).hexdigest()[:16],
            "relative": sorted(self.relative), "sampling": self.sampling.plain(),
            "failure": {"quantity": "kept", "below": 0.5},
        }  # fmt: skip

    @property
    def unit(self) -> int:
        """Number of flights side by side."""
        return LANES

    @property
    def columns(self) -> Mapping[str, Column]:
        """Columns of factors, largest errors, smallest margins, energy, end, and status."""
        found = {}
        for name in self.sampling.names:
            unit = table_entry(self._table, name, name in self.relative).unit
            words = f"{name}, share of the mission's" if name in self.relative else name
            found[column_name(name)] = Column("float64", unit, words, "input")
        for name in self._quantities:
            unit, words = _QUANTITIES[name]
            found[name] = Column("int8" if name == "kept" else "float64", unit, words)
        found["end"] = Column("float64", "s", "last time with valid numbers", "diagnostic")
        return found | {"status": Column("int8", "1", "how the flight ended", "status")}

    @property
    def axes(self) -> Mapping[str, Axis]:
        """No axes: each quantity is one number."""
        return {}

    @property
    def reasons(self) -> Mapping[int, str]:
        """Reasons of flights whose numbers did not stay finite, by code."""
        found = {1 + int(one): one.words for one in LoopReason if one != LoopReason.VALID}
        return found | {NOT_PHYSICAL: "masses or inertias that no body can have"}

    def run(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns of the samples first, first + 1, ..."""
        if not count:
            return {name: np.zeros(0, column.dtype) for name, column in self.columns.items()}
        blocks = range(first // LANES, (first + count - 1) // LANES + 1)
        with jax.enable_x64(True):
            parts = [self._block(number) for number in blocks]
        skip = first - blocks[0] * LANES
        joined = {k: np.concatenate([part[k] for part in parts]) for k in parts[0]}
        return {k: joined[k][skip : skip + count].astype(c.dtype) for k, c in self.columns.items()}

    @property
    def _table(self) -> Any:
        table = self.mission.machine.table
        assert table is not None
        return table

    @property
    def _numbers(self) -> dict[str, Any]:
        return {name: np.asarray(self._table.value(name)).tolist() for name in self._table}

    @property
    def _quantities(self) -> list[str]:
        machine, none = self.mission.machine, set()
        if machine.bodies is None:
            none |= {"panel_error", "stroke_margin"}
        if machine.speeds is None:
            none |= {"rotor_margin"}
        if machine.force is None:
            none |= {"force_margin"}
        return [name for name in _QUANTITIES if name not in none]

    def _check_factors(self) -> None:
        table, scene = self._table, self.mission.machine.scene
        unknown = lambda name: (
            lambda: (
                f"is no parameter of {scene.name}.{alike(name.partition('[')[0][:SHOWN], list(table))}"
            )
        )
        columns: dict[str, str] = {}
        for factor in self.sampling.names:
            name = table_entry(table, factor, factor in self.relative, unknown(factor)).name
            if name.startswith(_FIXED) and name not in _FREE:
                raise SettingError(
                    f"{named(factor)} can be no factor of a mission's study: loops and limits of strokes "
                    "are those of the mission's machine. Masses, inertias, centres of mass, rotors, "
                    "drag and motors can be."
                )
            line = scene.parameters.get(name)
            if line is None:
                raise SettingError(
                    f"{named(factor)} has no effect on this mission: its machine does not use it."
                )
            if line != table[name].plain():
                raise SettingError(
                    f"'{name}' is given by the mission's options: it can be no factor."
                )
            column = column_name(factor)
            if column in columns or column in {*_QUANTITIES, "end", "status", "sample"}:
                raise SettingError(f"The column '{column}' of {named(factor)} is there already.")
            columns[column] = factor

    def _block(self, number: int) -> dict[str, np.ndarray]:
        """Columns of all flights of a block."""
        first, names = number * LANES, self.sampling.names
        drawn = self._drawn(first)
        possible = possible_tables(self._table, names, drawn, self.relative)
        # impossible samples fly as the first possible one does, and are left out
        flown = np.where(possible[:, None], drawn, drawn[np.argmax(possible)])
        worst: Any = Worst(*(np.zeros(LANES) for _ in Worst._fields))  # pyright: ignore[reportArgumentType]
        if np.any(possible):
            worst = jax.tree.map(np.asarray, self._program(flown, self._seeds(first)))
        status = np.where(possible, FINE + worst.reason, NOT_PHYSICAL)
        fine = status == FINE
        found = {column_name(name): drawn[:, k] for k, name in enumerate(names)}
        own = {
            "position_error": worst.position, "tilt_error": worst.tilt,
            "panel_error": worst.panel, "rotor_margin": worst.rotors,
            "stroke_margin": worst.strokes, "force_margin": worst.forces, "energy": worst.energy,
        }  # fmt: skip
        found |= {k: np.where(fine, v, np.nan) for k, v in own.items()}
        kept = fine & self._kept(worst)
        return found | {"kept": kept, "end": np.where(possible, worst.end, 0.0), "status": status}

    def _drawn(self, first: int) -> np.ndarray:
        """Values of a block (lanes, d); beyond the design's end, those of its last sample again."""
        limit = self.sampling.limit
        count = LANES if limit is None else min(LANES, limit - first)
        drawn = self.sampling.draw(first, count)
        return np.concatenate([drawn, np.repeat(drawn[-1:], LANES - count, axis=0)])

    def _seeds(self, first: int) -> np.ndarray:
        """Seeds of gusts and of noise (lanes, 2)."""
        own = lambda k: np.random.SeedSequence((self.sampling.seed, k)).generate_state(2)
        return np.stack([own(first + k) for k in range(LANES)]).astype(np.uint32)

    def _kept(self, worst: Any) -> np.ndarray:
        """Test whether flights kept the tolerances and limits of the mission (lanes,)."""
        wanted = self.mission.file.tolerances
        fine = np.minimum(np.minimum(worst.rotors, worst.strokes), worst.forces) >= -AT_LIMIT
        turned = (worst.tilt / _DEGREE, wanted.tilt), (worst.panel / _DEGREE, wanted.panel)
        for value, most in ((worst.position, wanted.position), *turned):
            fine &= np.asarray(most is None) | (value <= (np.inf if most is None else most))
        return fine

    @cached_property
    def _program(self) -> Any:
        """Compiled function of values (lanes, d) and seeds (lanes, 2) that returns a `Worst`."""
        of, machine = self.mission, self.mission.machine
        pilot = of.controller, of.references, of.gauges
        nominal = _Nominal(of.plant, *pilot, machine.speeds, machine.limits)
        flights = lambda of, *each: jax.vmap(partial(self._flown, of))(*each)
        values = jax.ShapeDtypeStruct((LANES, len(self.sampling.names)), jnp.float64)
        seeds = jax.ShapeDtypeStruct((LANES, 2), jnp.uint32)
        made = program_of_shapes(flights, nominal, values, seeds, parts=self._parts)
        return partial(made, nominal)

    @property
    def _parts(self) -> tuple[Any, ...]:
        """All that the compiled program depends on: not how many samples are drawn, nor from what."""
        names = tuple(self.sampling.names)
        return self.mission.file.model_dump(), self._numbers, names, self.relative

    def _flown(self, of: _Nominal, values: Float[Array, " d"], seeds: Array) -> Worst:
        """Largest errors and smallest margins of one flight; traced."""
        mission = self.mission
        own = dict(zip(self.sampling.names, values, strict=True))
        table = drawn_table(self._table, own, self.relative)
        plant = _plant_of(of.plant, mission.machine, scene_of(mission.file, table, seeds[0]))
        gauges = eqx.tree_at(lambda g: g.k_tau, of.gauges, table.value("rotor.k_tau"))
        chunks = -(-mission.samples // max(round(CHUNK * plant.rate), 2))
        samples = -(-mission.samples // chunks)

        def chunk(now: tuple[PlantState, Any, Worst], _: None) -> tuple[Any, None]:
            start, memory, worst = now
            found = rollout(
                plant, of.controller, samples, reference=of.references, memory=memory,
                signals={"gauges": gauges}, start=start,
            )  # fmt: skip
            return (found.end, found.memory, _joined(mission, of, worst, found)), None

        zero, one = jnp.zeros(()), jnp.ones(())
        reason = jnp.zeros((), jnp.int8)
        begun = Worst(zero, zero, zero, one, one, one, zero, reason, zero)
        start = plant.reset(jax.random.key(seeds[1]))
        first = (start, jax.tree.map(jnp.asarray, of.controller.start()), begun)
        (_, _, worst), _ = jax.lax.scan(chunk, first, length=chunks)
        return worst


def _plant_of(nominal: Plant, machine: Machine, scene: Scene) -> Plant:
    """Plant of another scene with the instruments, estimator and inputs of a mission's plant."""
    rate, method = nominal.rate, nominal.motion.problem.method
    made = Plant(
        scene, rate=rate, inputs=input_names(machine), before=nominal.before,
        delay=nominal.late / rate, standing=nominal.stood / rate,
        sensors=nominal.bench.instruments, estimator=nominal.estimator, memory=nominal.memory,
        steps=nominal.motion.steps,
    )  # fmt: skip
    return made.with_motion(made.motion.with_method(formulation=method.formulation))


def _joined(mission: Mission, of: _Nominal, worst: Worst, found: Rollout) -> Worst:
    """Largest errors and smallest margins after further samples."""
    given, own, ts = mission.file, found.signals["gauges"], found.ts
    wanted = given.tolerances
    flown = ts <= given.t1 + AT_ONCE
    base = flown & (ts >= wanted.after - AT_ONCE)
    later = wanted.after if wanted.panel_after is None else wanted.panel_after
    panel = flown & (ts >= later - AT_ONCE)
    most = lambda values, of: jnp.max(jnp.where(of, values, 0.0))
    off = jnp.sqrt(jnp.sum(own["position_error"] ** 2, axis=1))
    # a reason stays for the rest of a chunk
    now = jnp.max(jnp.where(flown, found.reason, 0))
    reason = jnp.where(worst.reason == LoopReason.VALID, now, worst.reason)
    valid = flown & (found.reason == LoopReason.VALID) & (worst.reason == LoopReason.VALID)
    last = mission.samples - 1
    power = jnp.where(flown & (ts < (last - 0.5) / mission.plant.rate), own["electric_power"], 0.0)
    rotors, strokes, forces = worst.rotors, worst.strokes, worst.forces
    if of.speeds is not None:
        low, high = (jnp.sqrt(x) for x in of.speeds.squared(mission.machine.rotors.spin.shape[0]))
        # a rotor that has failed is within no limits
        counted = flown[:, None] & (ts[:, None] < of.controller.lost)
        rotors = jnp.minimum(rotors, _margin(own["rotor_speed"], low, high, counted))
    if of.limits is not None:
        low, high = of.limits.lower, of.limits.upper
        strokes = jnp.minimum(strokes, _margin(own["displacement"], low, high, flown[:, None]))
    if mission.machine.force is not None:
        top, jam = of.controller.force, of.controller.jam
        counted = flown[:, None] & (True if jam is None else ts[:, None] < jam.at)
        forces = jnp.minimum(forces, _margin(own["wanted_force"], -top, top, counted))
    turned = worst.panel
    if "panel_error" in own:
        turned = jnp.maximum(turned, most(own["panel_error"], panel))
    return Worst(
        jnp.maximum(worst.position, most(off, base)),
        jnp.maximum(worst.tilt, most(own["tilt_error"], base)),
        turned, rotors, strokes, forces, worst.energy + jnp.sum(power) / mission.plant.rate, reason,
        jnp.maximum(worst.end, jnp.max(jnp.where(valid, ts, 0.0))),
    )  # fmt: skip


def _margin(values: Array, low: Array, high: Array, counted: Array) -> Float[Array, ""]:
    """Smallest distance from limits as a share of the range, of those values that count."""
    left = jnp.minimum(values - low, high - values) / (high - low)
    return jnp.min(jnp.where(counted, left, 1.0))


def mission_work(plain: Mapping[str, Any], folder: Path | str = ".") -> MissionWork:
    """Work of a study of a mission from its plain data, in the form of its TOML file.

    Args:
        folder: folder from which a mission's file is sought.

    Raises:
        SettingError: entries that are unknown, missing or out of range; also as for `MissionWork`.
        FileError: see `load_mission`.
    """
    given = checked(MissionStudyFile, plain, "A study of a mission")
    factors, relative = factors_of(given.factors)
    source = given.mission
    path = Path(folder) / source if source.endswith(".toml") else source
    mission = load_mission(path, t1=given.t1)
    drawing = given.model_dump(include=set(Drawing.model_fields))
    return MissionWork(mission, Sampling(factors, **drawing), relative=relative, name=given.name)
