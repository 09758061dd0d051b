"""From a study's drawn numbers to a system and its start.

Factors are the names of a scene's parameter table, such as "mass.panel_7" or
"inertia.hexacopter_1[0, 1]", and these:

    start.x, y, z [m], start.roll, pitch, yaw [rad], start.vx, vy, vz [m/s], start.p, q, r [rad/s]
        of the base, angular velocity in its axes (hexacopter, uav_tracker);
    start.phi, theta [rad], start.phi_rate, theta_rate [rad/s]  of the panel in the base;
    input.rotor_1 ... input.rotor_6 [1]   of the rotors' squared speeds, as a share of the scene's;
    input.actuator_2, input.actuator_3 [N]   added to the actuators' forces (uav_tracker 2 and 3);
    wind.x, y, z [m/s]   steady, acting through the airframe's drag.

A relative factor multiplies the table's value.
"""

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.rotation import product, rotation_matrix
from ..mechanics.errors import SettingError
from ..mechanics.schema import SHOWN, named, shown
from ..mechanics.state import State
from ..mechanics.system import System
from ..scenes.registry import SCENES, make_scene
from ..scenes.uav_tracker import uav_flyer
from ..study.trim import TrimReason, hover, trim
from ..vehicle.actuator import LinearActuator
from ..vehicle.flight import Drag, Wind
from ..vehicle.flyer import Coordinates, Inputs, whole_state
from ..vehicle.geometry import initial_angles, tracker_geometry
from ..vehicle.gust import dryden, low_altitude
from ..vehicle.parameters import Parameters
from ..vehicle.placement import posture, turn_about
from ..vehicle.rotor import Rotors

# Relative slack of the check of sampled inertia tensors, for round-off.
ROUND_OFF = 1e-12

SceneName = Literal["tracker", "hexacopter", "uav_tracker"]

_BASE = {
    "start.x": "m", "start.y": "m", "start.z": "m",
    "start.roll": "rad", "start.pitch": "rad", "start.yaw": "rad",
    "start.vx": "m/s", "start.vy": "m/s", "start.vz": "m/s",
    "start.p": "rad/s", "start.q": "rad/s", "start.r": "rad/s",
}  # fmt: skip
_PANEL = {
    "start.phi": "rad", "start.theta": "rad",
    "start.phi_rate": "rad/s", "start.theta_rate": "rad/s",
}  # fmt: skip
_ROTORS = {f"input.rotor_{k}": "1" for k in range(1, 7)}
_ACTUATORS = {"input.actuator_2": "N", "input.actuator_3": "N"}
_WIND = {"wind.x": "m/s", "wind.y": "m/s", "wind.z": "m/s"}


class Drawn(NamedTuple):
    """One sample: its factors' values (d,), and a number for its own noise."""

    values: Float[Array, " d"]
    seed: Array


class Entry(NamedTuple):
    """Where a factor goes: a line of the table and places in it, or a number of its own."""

    name: str
    places: tuple[tuple[int, ...], ...]
    unit: str


class _Shift(eqx.Module):
    """A history with a number added."""

    of: Any
    more: Array

    def __call__(self, t: Any, kin: Any) -> Array:
        first: Any = self.of(t, kin) if callable(self.of) else self.of
        return first + self.more


@dataclass(frozen=True)
class Flights:
    """What all flights of a study have in common.

    Attributes:
        scene, case: see `stmuav list`. table: of its parameters.
        relative: names of factors that multiply the table's value.
        inputs: "case" for the scene's own; "trim" for constant rotor speeds and actuator forces
            that hold the table's machine at its initial posture (uav_tracker, case 2).
        drag: of the airframe. gusts: Dryden gusts about the table's mean wind, each flight with
            its own (needs drag). duration: for which they are drawn [s].
        float32: single precision.
        held: squared speeds and forces of the trim, where they are the inputs.
    """

    scene: SceneName
    case: int | None
    table: Parameters
    relative: frozenset[str] = frozenset()
    inputs: Literal["case", "trim"] = "case"
    drag: bool = False
    gusts: bool = False
    duration: float = 1.0
    float32: bool = False
    held: Inputs | None = None

    def own(self) -> dict[str, str]:
        """Factors beside the table's, with their units."""
        found: dict[str, str] = {}
        if self.scene != "tracker":
            found |= _BASE | _ROTORS
        if self.scene != "hexacopter":
            found |= _PANEL
        if self.scene == "uav_tracker" and (self.inputs == "trim" or self.case in (None, 2, 3)):
            found |= _ACTUATORS
        return found | _WIND if self.drag else found

    def entry(self, factor: str) -> Entry:
        """Where a factor goes.

        Raises:
            SettingError: an unknown name, a place that the parameter does not have, a relative
                factor without a value in the table.
        """
        own = self.own()
        if factor in own:
            if factor in self.relative:
                raise SettingError(f"'{factor}' has no value in the table that it could multiply.")
            return Entry(factor, (), own[factor])
        match = re.fullmatch(r"([\w.]+)(?:\[([\d, ]+)\])?", factor)
        if match is None or match[1] not in set(self.table):
            hint = _alike((match[1] if match else factor)[:SHOWN], [*own, *self.table])
            raise SettingError(
                f"{named(factor)} is neither a parameter of {self.scene} nor part of its start.{hint}"
            )
        name = match[1]
        try:
            place = tuple(int(k) for k in match[2].split(",")) if match[2] else ()
        except ValueError:
            raise SettingError(
                f"{named(factor)} names no entry; one is written such as {name}[0, 1]."
            ) from None
        value = np.asarray(self.table.value(name), dtype=float)
        if place and (
            len(place) != value.ndim or any(k >= n for k, n in zip(place, value.shape, strict=True))
        ):
            raise SettingError(f"'{name}' has shape {value.shape}; it has no entry {list(place)}.")
        if not place and value.ndim and factor not in self.relative:
            raise SettingError(
                f"'{name}' has shape {value.shape}: name one entry, such as "
                f"{name}[{', '.join('0' * value.ndim)}], or make the factor relative."
            )
        places = (place,) if place else ()
        # a tensor of inertia stays symmetric, "bare.inertia" of the hexacopter too
        tensor = self.table[name].unit == "kg m^2" and len(place) == 2
        across = place[::-1]
        if tensor and place != across:
            places = (place, across)
        unit = "1" if factor in self.relative else self.table[name].unit
        return Entry(name, places, unit)

    def build(self, names: tuple[str, ...], drawn: Drawn) -> tuple[System, State]:
        """System and start of one flight; may be traced. NaN where the start cannot be made."""
        values = dict(zip(names, drawn.values, strict=True)) if names else {}
        table = self._table(values)
        options: dict[str, Any] = {"allow_float32": True} if self.float32 else {}
        if self.drag:
            options |= {"drag": Drag(), "wind": self._air(table, values, drawn.seed)}
        case = 2 if self.inputs == "trim" else self.case
        system = make_scene(self.scene, case, table, **options).system
        return self._driven(system, values), self._start(table, values)

    def _table(self, values: Mapping[str, Array]) -> Parameters:
        own, new = self.own(), {}
        for factor, value in values.items():
            if factor in own:
                continue
            name, places, _ = self.entry(factor)
            now = new.get(name, self.table.value(name))
            if factor in self.relative:
                share = lambda x, value=value: jnp.asarray(x, dtype=float) * value
                if not places:
                    new[name] = share(now)
                    continue
                value = share(np.asarray(self.table.value(name))[places[0]])
            now = jnp.asarray(now, dtype=float)
            for place in places or ((),):
                now = now.at[place].set(value)
            new[name] = now
        return self.table.replaced(new, source="drawn") if new else self.table

    def possible(
        self, names: tuple[str, ...], drawn: Float[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether samples have only masses and inertia tensors that bodies can have (n,).

        The checks are those of `Body`, which looks at no number that is traced: masses are positive,
        tensors positive definite, and no principal moment exceeds the sum of the other two.
        """
        fine = np.ones(len(drawn), bool)
        own = self.own()
        places = [k for k, name in enumerate(names) if name not in own]
        chosen = {self.entry(names[k]).name: self.table[self.entry(names[k]).name] for k in places}
        if not {p.unit for p in chosen.values()} & {"kg", "kg m^2"}:
            return fine
        factors = [names[k] for k in places]
        table = lambda row: self._table(dict(zip(factors, row, strict=True)))
        sampled = lambda row: {name: jnp.asarray(table(row).value(name)) for name in chosen}
        values = jax.vmap(sampled)(jnp.asarray(drawn[:, places]))
        for name, parameter in chosen.items():
            value = np.asarray(values[name], dtype=float)
            if parameter.unit == "kg":
                fine &= (np.isfinite(value) & (value > 0)).reshape(len(drawn), -1).all(axis=1)
            elif parameter.unit == "kg m^2" and value.shape[1:] == (3, 3):
                fine &= _tensors(value, parameter.tolerance)
        return fine

    def _air(self, table: Parameters, values: Mapping[str, Array], seed: Array) -> Any:
        mean = jnp.asarray(table.value("wind.mean"), dtype=float)
        parts = [values.get(f"wind.{axis}", mean[k]) for k, axis in enumerate("xyz")]
        mean = jnp.stack([jnp.asarray(x, dtype=float) for x in parts])
        if not self.gusts:
            return mean
        kind = low_altitude(table.value("gust.height"), table.value("gust.speed_20ft"))
        speed = jnp.sqrt(jnp.sum(mean * mean))
        options = Wind()
        return dryden(
            seed, kind, airspeed=speed, duration=self.duration + options.spacing,
            dt=options.spacing, mean=mean,
        )  # fmt: skip

    def _driven(self, system: System, values: Mapping[str, Array]) -> System:
        """With the inputs of the trim, and what the factors change of them."""
        forces = list(system.forces)
        share = jnp.stack([jnp.asarray(values.get(name, 1.0), dtype=float) for name in _ROTORS])
        held = self.held
        for k, force in enumerate(forces):
            if isinstance(force, Rotors):
                squared: Any = force.speed_squared if held is None else held.squared
                if held is not None or any(name in values for name in _ROTORS):
                    forces[k] = eqx.tree_at(lambda f: f.speed_squared, force, squared * share)
            elif isinstance(force, LinearActuator):
                side = 0 if force.slider == "slider_2" else 1
                push = force.force if held is None else jnp.asarray(held.forces[side], dtype=float)
                more = values.get(f"input.actuator_{side + 2}")
                if more is not None:
                    push = _Shift(push, more) if callable(push) else push + more
                if held is not None or more is not None:
                    forces[k] = eqx.tree_at(lambda f: f.force, force, push)
        return eqx.tree_at(lambda s: s.forces, system, tuple(forces))

    def _start(self, table: Parameters, values: Mapping[str, Array]) -> State:
        def get(name: str, default: Any = 0.0) -> Array:
            return jnp.asarray(values.get(name, default), dtype=float)

        three = lambda *names: jnp.stack([get(f"start.{n}") for n in names])
        r, v, omega = three("x", "y", "z"), three("vx", "vy", "vz"), three("p", "q", "r")
        turns = [
            turn_about(get(f"start.{n}"), k) for k, n in ((2, "yaw"), (1, "pitch"), (0, "roll"))
        ]
        p = product(product(turns[0], turns[1]), turns[2])
        if self.scene == "hexacopter":
            return State(r[None], p[None], v[None], omega[None])
        usual = initial_angles(table)
        angles = jnp.stack([get("start.phi", usual[0]), get("start.theta", usual[1])])
        rates = three("phi_rate", "theta_rate")
        geometry = tracker_geometry(table)
        if self.scene == "tracker":
            return posture(geometry, angles, rates)
        shift = jnp.asarray(table.value("mount.shift"), dtype=float)
        return whole_state(geometry, shift, Coordinates(r, p, angles, v, omega, rates))

    def nominal(self) -> tuple[System, State]:
        """System and start without anything drawn."""
        return self.build((), Drawn(jnp.zeros(0), jnp.zeros((), jnp.uint32)))

    def facing(self) -> np.ndarray:
        """The world direction that the table's panel faces at its start (3,)."""
        if self.scene == "hexacopter":
            return np.array([0.0, 0.0, 1.0])
        start = posture(tracker_geometry(self.table), initial_angles(self.table))
        return np.asarray(rotation_matrix(start.p[-1])[:, 2])


def _alike(name: str, known: list[str]) -> str:
    """The nearest of very many names, and some that are like it."""
    some = difflib.get_close_matches(name, known, n=8, cutoff=0.3)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    like = f" Names like it: {', '.join(some)}." if some else ""
    return f"{hint}{like} docs/studies.md says which there are."


def _tensors(inertia: Float[np.ndarray, "n 3 3"], tolerance: float) -> Bool[np.ndarray, " n"]:
    """Whether a body can have each of these tensors, with a relative excess of its moments."""
    finite = np.all(np.isfinite(inertia), axis=(1, 2))
    moments = np.linalg.eigvalsh(np.where(finite[:, None, None], inertia, np.eye(3)))
    with np.errstate(over="ignore"):
        most = (moments[:, 0] + moments[:, 1]) * (1 + max(tolerance, ROUND_OFF))
    return finite & (moments[:, 0] > 0) & (moments[:, 2] <= most)


def _hover_inputs(table: Parameters) -> Inputs:
    found = trim(uav_flyer(table), hover(initial_angles(table)))
    if int(found.reason) != TrimReason.VALID:
        raise SettingError(
            "There is no hover at the initial posture of these parameters: "
            f"{TrimReason(int(found.reason)).name.lower().replace('_', ' ')}."
        )
    return Inputs(np.asarray(found.inputs.squared), np.asarray(found.inputs.forces))


def flights(
    scene: str, case: int | None = None, table: Parameters | None = None, **options: Any
) -> Flights:
    """Flights of a scene by name, checked.

    Raises:
        SettingError: an unknown scene or case, gusts without drag, trim of another scene.
    """
    if not isinstance(scene, str) or not (case is None or isinstance(case, int)):
        raise SettingError(f"A scene has a name and a case a number, not {shown((scene, case))}.")
    make_scene(scene, case, table)
    if scene == "spin":
        raise SettingError("Studies are of tracker, hexacopter and uav_tracker, not of spin.")
    entry = SCENES[scene]
    case = entry.default_case if case is None else case
    made = Flights(scene, case, entry.parameters if table is None else table, **options)  # pyright: ignore[reportArgumentType]
    if made.inputs == "trim" and scene != "uav_tracker":
        raise SettingError(f"Inputs of a trim are for uav_tracker, not for {scene}.")
    if made.drag and scene == "tracker":
        raise SettingError("The tracker on the ground has no airframe to drag.")
    if made.gusts and not made.drag:
        raise SettingError("Gusts act through the airframe's drag: set drag too.")
    return replace(made, held=_hover_inputs(made.table)) if made.inputs == "trim" else made
