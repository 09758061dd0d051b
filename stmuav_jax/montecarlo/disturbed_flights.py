"""Disturbed systems and initial states from a study's sampled factors.

Factors are the names of a scene's parameter table, such as "mass.panel_7" or
"inertia.hexacopter_1[0, 1]", and those of these that the scene has:

    start.NAME  the fields of the scene's option `start`, such as start.roll [rad] of a base or
        start.phi [rad] of the panel;
    input.rotor_1, ... [1]   shares of the rotors' squared speeds of the scene;
    input.actuator_2, input.actuator_3 [N]   added to the forces of the sliders' actuators;
    wind.x, y, z [m/s]   steady, acting through the airframe's drag.

A relative factor multiplies the table's value.
"""

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.rotation import rotation_matrix
from ..checks.errors import SettingError, StateError
from ..checks.quantity import quantities
from ..checks.schema import SHOWN, named, shown
from ..dynamics.scene import Scene
from ..dynamics.statespace.tree import TreeSpace
from ..dynamics.tree.topology import spanning_tree
from ..environment.wind import dryden, low_altitude
from ..flight.equilibrium import trim
from ..flight.flight_trim import TrimReason, hover, trim_flight
from ..flight.steady import trim_condition
from ..mechanics.inputs import inputs_of
from ..mechanics.state import State
from ..mechanics.system import System
from ..parameters.table import Parameters
from ..rotorcraft.rotor import Rotors
from ..scenes.flight_options import Drag, Wind
from ..scenes.registry import SCENES, entry_of, make_scene, options_from_plain
from ..scenes.uav_tracker import uav_flyer
from ..tracker.actuator import LinearActuator
from ..tracker.geometry import initial_angles

# Relative tolerance for round-off in the check of sampled inertia tensors.
ROUND_OFF = 1e-12

_WIND = {"wind.x": "m/s", "wind.y": "m/s", "wind.z": "m/s"}


class Drawn(NamedTuple):
    """Sample of a study: values of its factors (d,), and the seed of its own noise."""

    values: Float[Array, " d"]
    seed: Array


class FactorTarget(NamedTuple):
    """Target of a factor: a parameter and places in its value, or a number not in the table."""

    name: str
    places: tuple[tuple[int, ...], ...]
    unit: str


class _Shift(eqx.Module):
    """History of an input with a constant added."""

    of: Any
    more: Array

    def __call__(self, t: Any, kin: Any) -> Array:
        first: Any = self.of(t, kin) if callable(self.of) else self.of
        return first + self.more


@dataclass(frozen=True)
class Flights:
    """Settings that all runs of a study have in common.

    Attributes:
        scene, case: see `stmuav list`. table: of its parameters.
        own: factors beside the table's, with their units.
        options: of the scene, plain data as `options_from_plain` takes. given: names of the table
            whose values the options replace, which can be no factors.
        relative: names of factors that multiply the table's value.
        inputs: "case" for the scene's own; "trim" for constant rotor speeds and actuator forces
            that hold the table's machine at its initial posture (uav_tracker, case 2).
        drag: add drag of the airframe.
        gusts: add Dryden gusts to the table's mean wind, different in each run; needs drag.
        duration: time for which gusts are sampled [s].
        held: all inputs of the scene at its trim (m,), where these are the inputs.
    """

    scene: str
    case: int | None
    table: Parameters
    own: Mapping[str, str]
    options: Mapping[str, Any] = field(default_factory=dict)
    given: frozenset[str] = frozenset()
    relative: frozenset[str] = frozenset()
    inputs: Literal["case", "trim"] = "case"
    drag: bool = False
    gusts: bool = False
    duration: float = 1.0
    held: Float[np.ndarray, " m"] | None = None

    @property
    def trimmed_case(self) -> int | None:
        """Case of the scene: with a trim's inputs that of the UAV whose inputs are constant."""
        return 2 if self.inputs == "trim" and self.scene == "uav_tracker" else self.case

    def entry(self, factor: str) -> FactorTarget:
        """Target of a factor.

        Raises:
            SettingError: an unknown name, a place that the parameter does not have, a relative
                factor without a value in the table.
        """
        own = self.own
        if factor in own:
            if factor in self.relative:
                raise SettingError(f"'{factor}' has no value in the table that it could multiply.")
            return FactorTarget(factor, (), own[factor])
        match = re.fullmatch(r"([\w.]+)(?:\[([\d, ]+)\])?", factor)
        if match is None or match[1] not in set(self.table):
            hint = _alike((match[1] if match else factor)[:SHOWN], [*own, *self.table])
            raise SettingError(
                f"{named(factor)} is neither a parameter of {self.scene} nor part of its start.{hint}"
            )
        name = match[1]
        if name in self.given:
            raise SettingError(f"'{name}' is given by the study's options: it can be no factor.")
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
        # an inertia tensor stays symmetric, "bare.inertia" of the hexacopter too
        tensor = self.table[name].unit == "kg m^2" and len(place) == 2
        across = place[::-1]
        if tensor and place != across:
            places = (place, across)
        unit = "1" if factor in self.relative else self.table[name].unit
        return FactorTarget(name, places, unit)

    def build(self, names: tuple[str, ...], drawn: Drawn) -> tuple[System, State]:
        """System and initial state of one run, NaN for an impossible start; may be traced."""
        values = dict(zip(names, drawn.values, strict=True)) if names else {}
        table = self._table(values)
        options = options_from_plain(self.scene, self.options)
        if self.drag:
            options = {"drag": Drag(), "wind": self._air(table, values, drawn.seed)} | options
        known = SCENES[self.scene].options
        if "start" in known:
            drawn_start = {k[6:]: v for k, v in values.items() if k.startswith("start.")}
            first = options.get("start", known["start"].kind())
            options["start"] = replace(first, **drawn_start)
        scene = make_scene(self.scene, self.trimmed_case, table, **options)
        return self._driven(scene.system, values), scene.state0

    def _table(self, values: Mapping[str, Array]) -> Parameters:
        own, new = self.own, {}
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
        """True for samples with masses and inertia tensors that bodies can have (n,).

        The checks are those of `Body`, which does not check traced numbers: masses are positive,
        tensors positive definite, and no principal moment exceeds the sum of the other two.
        """
        fine = np.ones(len(drawn), bool)
        own = self.own
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
        """System with the inputs of the trim, and their changes by the factors."""
        if self.held is not None:
            system = inputs_of(system).applied(system, jnp.asarray(self.held))
        forces = list(system.forces)
        for k, force in enumerate(forces):
            if isinstance(force, Rotors):
                shares = [values.get(name) for name in _rotor_inputs(force)]
                if any(share is not None for share in shares):
                    ones = [jnp.asarray(1.0 if x is None else x, dtype=float) for x in shares]
                    squared: Any = force.speed_squared
                    squared = squared * jnp.stack(ones)
                    forces[k] = eqx.tree_at(lambda f: f.speed_squared, force, squared)
            elif isinstance(force, LinearActuator):
                push, more = force.force, values.get(_actuator_input(force))
                if more is not None:
                    push = _Shift(push, more) if callable(push) else push + more
                    forces[k] = eqx.tree_at(lambda f: f.force, force, push)
        return eqx.tree_at(lambda s: s.forces, system, tuple(forces))

    def nominal(self) -> tuple[System, State]:
        """System and initial state without any disturbance."""
        return self.build((), Drawn(jnp.zeros(0), jnp.zeros((), jnp.uint32)))

    def facing(self) -> np.ndarray:
        """The world direction of the last body's z axis at the start (3,); a panel faces it."""
        _, start = self.nominal()
        return np.asarray(rotation_matrix(start.p[-1])[:, 2])


def _rotor_inputs(rotors: Rotors) -> list[str]:
    return [f"input.rotor_{k + 1}" for k in range(rotors.spin.shape[0])]


def _actuator_input(actuator: LinearActuator) -> str:
    return f"input.actuator_{actuator.slider.rpartition('_')[2]}"


def _alike(name: str, known: list[str]) -> str:
    """Hint with the nearest of very many names, and some similar ones."""
    some = difflib.get_close_matches(name, known, n=8, cutoff=0.3)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    like = f" Names like it: {', '.join(some)}." if some else ""
    return f"{hint}{like} docs/studies.md says which there are."


def _tensors(inertia: Float[np.ndarray, "n 3 3"], tolerance: float) -> Bool[np.ndarray, " n"]:
    """True for inertia tensors that a body can have, with a relative tolerance of the moments."""
    finite = np.all(np.isfinite(inertia), axis=(1, 2))
    moments = np.linalg.eigvalsh(np.where(finite[:, None, None], inertia, np.eye(3)))
    with np.errstate(over="ignore"):
        most = (moments[:, 0] + moments[:, 1]) * (1 + max(tolerance, ROUND_OFF))
    return finite & (moments[:, 0] > 0) & (moments[:, 2] <= most)


def _uav_hover(table: Parameters) -> Float[np.ndarray, " m"]:
    found = trim_flight(uav_flyer(table), hover(initial_angles(table)))
    if int(found.reason) != TrimReason.VALID:
        raise SettingError(
            "There is no hover at the initial posture of these parameters: "
            f"{TrimReason(int(found.reason)).name.lower().replace('_', ' ')}."
        )
    return np.concatenate([np.asarray(x) for x in found.inputs])


def _trim_inputs(scene: str, built: Scene) -> Float[np.ndarray, " m"]:
    """Inputs of a scene at which it hovers, or stands still at its start if its base is fixed (m,)."""
    if not len(inputs_of(built.system)):
        raise SettingError(
            f'The scene {scene} has no inputs that a trim could find: leave inputs = "trim" out.'
        )
    space = TreeSpace(built.system, built.state0)
    start = space.from_state(built.state0)
    try:
        floats = spanning_tree(built.system).floating
        found = trim_condition(space, hover(), at=start) if floats else trim(space, at=start)
    except (StateError, SettingError) as error:
        raise SettingError(f"The scene {scene} has no trim from its start: {error}") from None
    return np.asarray(found.values)


def flights(
    scene: str, case: int | None = None, table: Parameters | None = None, **options: Any
) -> Flights:
    """Checked settings of a study's runs, of a scene by name.

    Raises:
        SettingError: an unknown scene, case or option, gusts without drag, a scene without a trim.
    """
    if not isinstance(scene, str) or not (case is None or isinstance(case, int)):
        raise SettingError(f"A scene has a name and a case a number, not {shown((scene, case))}.")
    entry = entry_of(scene)
    table = entry.parameters if table is None else table
    case = entry.default_case if case is None else case
    made = Flights(scene, case, table, {}, **options)
    if made.inputs == "trim" and "motor" in made.options:
        raise SettingError("Inputs of a trim are steady speeds of the rotors: leave motor out.")
    if made.drag and "drag" not in entry.options:
        raise SettingError(f"The scene {scene} has no airframe to drag.")
    if made.gusts and not made.drag:
        raise SettingError("Gusts act through the airframe's drag: set drag too.")
    if made.drag and "wind" in made.options:
        raise SettingError(
            "A study with drag = true has the wind of the table, of its factors and of gusts: leave "
            "the option wind out."
        )
    built = make_scene(scene, made.trimmed_case, table, **options_from_plain(scene, made.options))
    given = frozenset(
        name for name, line in built.parameters.items() if line != table[name].plain()
    )
    made = replace(made, own=_own(made, built.system), given=given)
    if made.inputs == "case":
        return made
    of_uav = scene == "uav_tracker"
    return replace(made, held=_uav_hover(table) if of_uav else _trim_inputs(scene, built))


def _own(of: Flights, system: System) -> dict[str, str]:
    """Factors beside the table's, with their units: those of the start, the inputs and the wind."""
    found: dict[str, str] = {}
    start = SCENES[of.scene].options.get("start")
    if start is not None:
        found |= {f"start.{k}": number.unit for k, number in quantities(start.kind).items()}
    for force in system.forces:
        if isinstance(force, Rotors):
            found |= dict.fromkeys(_rotor_inputs(force), "1")
        elif isinstance(force, LinearActuator):
            found[_actuator_input(force)] = "N"
    return found | _WIND if of.drag else found
