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

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.errors import SettingError, StateError
from ..checks.quantity import quantities
from ..checks.schema import SHOWN, shown
from ..dynamics.scene import Scene
from ..dynamics.statespace.tree import TreeSpace
from ..dynamics.tree.topology import spanning_tree
from ..environment.wind import dryden, low_altitude
from ..flight.equilibrium import trim
from ..flight.flight_trim import TrimReason, hover, trim_flight
from ..flight.steady import trim_condition
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.state import State
from ..mechanics.system import System
from ..parameters.table import Parameters
from ..rotorcraft.rotor import Rotors
from ..scenes.flight_options import Drag, Wind
from ..scenes.registry import SCENES, entry_of, make_scene, options_from_plain
from ..scenes.uav_tracker import uav_flyer
from ..tracker.actuator import LinearActuator
from ..tracker.geometry import initial_angles
from .factors import FactorTarget, alike, drawn_table, faced, possible_tables, table_entry

_WIND = {"wind.x": "m/s", "wind.y": "m/s", "wind.z": "m/s"}


class Drawn(NamedTuple):
    """Sample of a study: values of its factors (d,), and the seed of its own noise."""

    values: Float[Array, " d"]
    seed: Array


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
    def dependent_rows(self) -> bool:
        """False: the constraint rows of the report's machines are independent."""
        return False

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
        unknown = lambda: (
            f"is neither a parameter of {self.scene} nor part of its start."
            f"{alike(factor.partition('[')[0][:SHOWN], [*own, *self.table])}"
        )
        name = factor.partition("[")[0]
        if name in self.given and name in self.table:
            raise SettingError(f"'{name}' is given by the study's options: it can be no factor.")
        return table_entry(self.table, factor, factor in self.relative, unknown)

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
        own = {factor: value for factor, value in values.items() if factor not in self.own}
        return drawn_table(self.table, own, self.relative)

    def possible(
        self, names: tuple[str, ...], drawn: Float[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """True for samples with masses and inertia tensors that bodies can have (n,)."""
        places = [k for k, name in enumerate(names) if name not in self.own]
        factors = tuple(names[k] for k in places)
        return possible_tables(self.table, factors, drawn[:, places], self.relative)

    def plain(self) -> dict[str, Any]:
        """Plain data of what tells the scene from others, without its table."""
        names = ("scene", "case", "inputs", "drag", "gusts")
        options = {"options": self.options} if self.options else {}
        return {name: getattr(self, name) for name in names} | options

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
        system = eqx.tree_at(lambda s: s.forces, system, tuple(forces))
        own = _other_inputs(system)
        more = [values.get(f"input.{name}", 0.0) for name, _ in own.names]
        if not any(f"input.{name}" in values for name, _ in own.names):
            return system
        return own.applied(system, own.values(system) + jnp.stack([jnp.asarray(x) for x in more]))

    def nominal(self) -> tuple[System, State]:
        """System and initial state without any disturbance."""
        return self.build((), Drawn(jnp.zeros(0), jnp.zeros((), jnp.uint32)))

    def facing(self) -> np.ndarray:
        """The world direction of the last body's z axis at the start (3,); a panel faces it."""
        return faced(self.nominal()[1])


def _rotor_inputs(rotors: Rotors) -> list[str]:
    return [f"input.rotor_{k + 1}" for k in range(rotors.spin.shape[0])]


def _actuator_input(actuator: LinearActuator) -> str:
    return f"input.actuator_{actuator.slider.rpartition('_')[2]}"


def _other_inputs(system: System) -> Inputs:
    """Constant inputs of forces other than rotors and actuators, to which factors are added."""
    named_apart = [isinstance(f, (Rotors, LinearActuator)) for f in system.forces]
    every = inputs_of(system).entries
    return Inputs(tuple(e for e in every if not named_apart[e.force])).constant(system)


def _uav_hover(table: Parameters) -> Float[np.ndarray, " m"]:
    found = trim_flight(uav_flyer(table), hover(initial_angles(table)))
    if int(found.reason) != TrimReason.VALID:
        raise SettingError(
            "There is no hover at the initial posture of these parameters: "
            f"{TrimReason(int(found.reason)).name.lower().replace('_', ' ')}."
        )
    return np.concatenate([np.asarray(x) for x in found.inputs])


def trim_inputs(scene: str, built: Scene) -> Float[np.ndarray, " m"]:
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
    return replace(made, held=_uav_hover(table) if of_uav else trim_inputs(scene, built))


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
    found |= {f"input.{name}": unit for name, unit in _other_inputs(system).names}
    return found | _WIND if of.drag else found
