"""Disturbed systems and initial states from a study's sampled factors.

Factors are the names of the parameter table of a scene or of a model's file, such as
"mass.panel_7", "inertia.hexacopter_1[0, 1]" or "length"; of a scene also those of these that it has,

    start.NAME  the fields of the scene's option `start`, such as start.roll [rad] of a base or
        start.phi [rad] of the panel;
    input.rotor_1, ... [1]   shares of the rotors' squared speeds of the scene;
    input.actuator_2, input.actuator_3 [N]   added to the forces of the sliders' actuators;
    wind.x, y, z [m/s]   steady, acting through the airframe's drag;

and of a model

    start.STATE   added to an independent coordinate or velocity of the start, such as
        start.A.angle [rad] or start.A.angle_rate [rad/s]; loops are closed from there;
    input.NAME    added to a constant input, such as input.effort [N].

A relative factor multiplies the table's value.
"""

import abc
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..analysis.equilibrium import hover, trim, trim_condition
from ..checks.errors import SettingError, StateError, closest_name
from ..checks.schema import SHOWN, format_value, quantity_fields, quote_name
from ..dynamics.simulation import Scene
from ..dynamics.statespace.selection import BASE
from ..dynamics.statespace.tree import TreePoint, TreeSpace
from ..dynamics.tree.topology import spanning_tree
from ..io.model_file import ParametricModel, Robot
from ..math.compiler import compute_untraced, quick_jit
from ..math.rotation import rotation_matrix
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.parameters import Parameters
from ..mechanics.state import State
from ..mechanics.system import System
from ..uav.environment.wind import dryden, low_altitude
from ..uav.flight import TrimReason, trim_flight
from ..uav.rotor import Rotors
from ..uav.scenes.flight_options import Drag, Wind
from ..uav.scenes.registry import SCENES, entry_of, make_scene, options_from_plain
from ..uav.scenes.uav_tracker import make_uav
from ..uav.tracker.bodies import LinearActuator
from ..uav.tracker.geometry import initial_angles
from .columns import Column

# Relative tolerance for round-off in the check of sampled inertia tensors.
ROUND_OFF = 1e-12

_WIND = {"wind.x": "m/s", "wind.y": "m/s", "wind.z": "m/s"}

# --- factors that are numbers of a parameter table


class FactorTarget(NamedTuple):
    """Target of a factor: a parameter and places in its value, or a number not in the table."""

    name: str
    places: tuple[tuple[int, ...], ...]
    unit: str


def table_entry(
    table: Parameters,
    factor: str,
    relative: bool,
    unknown: Callable[[], str] = lambda: "is unknown.",
) -> FactorTarget:
    """Target of a factor that is a parameter of a table, or one entry of it.

    Args:
        relative: True for a factor that multiplies the value. unknown: function that makes the end of
            the message on a name that the table does not have.

    Raises:
        SettingError: an unknown name, or a place that the parameter does not have.
    """
    match = re.fullmatch(r"([\w.]+)(?:\[([\d, ]+)\])?", factor)
    if match is None or match[1] not in set(table):
        raise SettingError(f"{quote_name(factor)} {unknown()}")
    name = match[1]
    try:
        place = tuple(int(k) for k in match[2].split(",")) if match[2] else ()
    except ValueError:
        raise SettingError(
            f"{quote_name(factor)} must name one entry, such as {name}[0, 1]."
        ) from None
    shape = np.shape(table.value(name))
    if place and (
        len(place) != len(shape) or any(k >= n for k, n in zip(place, shape, strict=True))
    ):
        raise SettingError(f"'{name}' has shape {shape}; it has no entry {list(place)}.")
    if not place and shape and not relative:
        raise SettingError(
            f"'{name}' has shape {shape}: name one entry, such as {name}[{', '.join('0' * len(shape))}], "
            "or make the factor relative."
        )
    # an inertia tensor stays symmetric, "bare.inertia" of the hexacopter too
    is_tensor = table[name].unit == "kg m^2" and len(place) == 2
    places = dict.fromkeys((place, place[::-1]) if is_tensor else (place,) if place else ())
    return FactorTarget(name, tuple(places), "1" if relative else table[name].unit)


def factor_columns(
    factors: Iterable[str],
    find_target: Callable[[str], FactorTarget],
    relative: frozenset[str],
    others: Mapping[str, Column],
) -> dict[str, Column]:
    """Columns of factors by their names, each of which has a target of its own, and other columns.

    Args:
        find_target: function of a name. relative: factors that multiply a value.

    Raises:
        SettingError: two factors of one number, or a factor with the name of another column.
    """
    places: dict[Any, str] = {}
    columns = dict(others)
    for name in factors:
        target = find_target(name)
        # a factor of a whole array and one of its entries would both set the entry
        for place in target.places or ((),):
            if (other := places.get((target.name, place))) is not None:
                raise SettingError(f"'{other}' and '{name}' are the same number; give one of them.")
            places[target.name, place] = name
        if name in others:
            raise SettingError(f"'{name}' and '{name}' would share the column '{name}'.")
        label = f"{name}, share of the table's" if name in relative else name
        columns[name] = Column("float64", target.unit, label, "input")
    return columns


def digest_table(table: Parameters, more: str = "") -> str:
    """Digest of a table's numbers and of a text: a store is only resumed with those that it began with."""
    numbers = {name: np.asarray(table.value(name)).tolist() for name in table}
    text = json.dumps(numbers, sort_keys=True) + more
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def drawn_table(
    table: Parameters, values: Mapping[str, Array], relative: frozenset[str]
) -> Parameters:
    """Table with drawn values, which may be traced, of factors that are its parameters.

    Args:
        relative: factors that multiply the table's value.
    """
    new: dict[str, Array] = {}
    for factor, value in values.items():
        name, places, _ = table_entry(table, factor, factor in relative)
        now = jnp.asarray(new.get(name, table.value(name)), dtype=float)
        if factor in relative and not places:
            # A relative factor multiplies a whole array by one number, such as all rotors' coefficients.
            new[name] = now * value
            continue
        if factor in relative:
            value = jnp.asarray(np.asarray(table.value(name))[places[0]], dtype=float) * value
        for place in places or ((),):
            now = now.at[place].set(value)
        new[name] = now
    return table.replaced(new, source="drawn") if new else table


def is_possible(
    table: Parameters, values: Mapping[str, Array], relative: frozenset[str]
) -> Bool[Array, ""]:
    """True if bodies can have the masses and inertia tensors of a table with drawn values; may be traced.

    The checks are those of `Body`, which does not check traced numbers: masses are positive,
    tensors positive definite, and no principal moment exceeds the sum of the other two.
    """
    sampled_table = drawn_table(table, values, relative)
    possible = jnp.ones((), bool)
    for name in {table_entry(table, factor, factor in relative).name for factor in values}:
        value, unit = jnp.asarray(sampled_table.value(name), dtype=float), table[name].unit
        if unit == "kg" or (unit == "kg m^2" and value.ndim == 0):
            possible &= jnp.all(jnp.isfinite(value) & (value > 0))
        elif unit == "kg m^2" and value.shape in ((3,), (3, 3)):
            # three moments are those of a model's body
            tensor = jnp.diag(value) if value.ndim == 1 else value
            possible &= _is_tensor(tensor, table[name].tolerance)
    return possible


def suggest_names(name: str, known_names: list[str]) -> str:
    """Hint with the nearest of very many names, and some similar ones."""
    return f"{closest_name(name, known_names, count=8)} docs/studies.md says which there are."


def _is_tensor(inertia: Float[Array, "3 3"], tolerance: float) -> Bool[Array, ""]:
    """True if a body can have an inertia tensor, with a relative tolerance of the moments.

    Signs of minors take the place of the moments themselves: of J, which must be positive definite, and
    of c tr(J) - J with c = (1 + tolerance) / (2 + tolerance), which has no negative eigenvalue if the
    largest moment is at most (1 + tolerance) times the sum of the other two.
    """
    trace = jnp.trace(inertia)
    J = inertia / jnp.where(trace > 0, trace, 1.0)
    share = (1 + max(tolerance, ROUND_OFF)) / (2 + max(tolerance, ROUND_OFF))
    rest = share * jnp.eye(3) - J
    minor = lambda m, i, k: m[i, i] * m[k, k] - m[i, k] * m[k, i]
    determinant = lambda m: m[0] @ jnp.cross(m[1], m[2])
    positive = jnp.stack([trace, J[0, 0], minor(J, 0, 1), determinant(J)]) > 0
    pairs = [minor(rest, *pair) for pair in ((0, 1), (0, 2), (1, 2))]
    not_negative = jnp.stack([*jnp.diagonal(rest), *pairs, determinant(rest)]) >= 0
    return jnp.all(jnp.isfinite(inertia)) & jnp.all(positive) & jnp.all(not_negative)


# --- what all runs have in common


_rotation = quick_jit(rotation_matrix)


class AbstractFlights(abc.ABC):
    """Settings that all runs of a study have in common.

    Attributes:
        scene: name. table: parameters. own_factors: factors beside the table's, with their units.
        relative: names of factors that multiply the table's value. unused_names: of the table, of no effect.
        inputs: "case" for the scene's own; "trim" for constant ones that hold it at its start.
    """

    scene: str
    table: Parameters
    own_factors: Mapping[str, str]
    relative: frozenset[str]
    unused_names: frozenset[str]
    inputs: Literal["case", "trim"]

    def __getstate__(self) -> dict[str, Any]:
        """State without what is found again from the rest."""
        return {part.name: vars(self)[part.name] for part in fields(self)}  # pyright: ignore[reportArgumentType]

    @property
    def dependent_rows(self) -> bool:
        """True if some constraint rows follow from others at the start."""
        return False

    @property
    @abc.abstractmethod
    def system(self) -> System:
        """System without any disturbance, whose bodies, joints and names are those of all runs."""

    @abc.abstractmethod
    def build(self, sample: Mapping[str, Any], seed: Any = 0) -> tuple[System, State]:
        """System and initial state of one run, NaN for an impossible start; may be traced.

        Args:
            sample: values by factor. seed: of the run's own noise.
        """

    @abc.abstractmethod
    def plain(self) -> dict[str, Any]:
        """Plain data that identify the scene, without its table."""

    @abc.abstractmethod
    def _check_parameter(self, name: str) -> None:
        """Raise `SettingError` for a parameter that cannot be a factor."""

    def entry(self, factor: str) -> FactorTarget:
        """Target of a factor.

        Raises:
            SettingError: an unknown name, a place that the parameter does not have, a relative
                factor without a value in the table, a parameter that other entries set.
        """
        if factor in self.own_factors:
            if factor in self.relative:
                raise SettingError(
                    f"'{factor}' has no default value in the table to multiply: leave 'relative' out."
                )
            return FactorTarget(factor, (), self.own_factors[factor])
        suggest = lambda: suggest_names(
            factor.partition("[")[0][:SHOWN],
            [*self.own_factors, *(name for name in self.table if name not in self.unused_names)],
        )
        unknown = lambda: (
            f"is neither a parameter of {self.scene} nor part of its start or inputs.{suggest()}"
        )
        target = table_entry(self.table, factor, factor in self.relative, unknown)
        if target.name in self.unused_names:
            raise SettingError(
                f"{quote_name(factor)} has no effect on {self.scene}, which does not use it.{suggest()}"
            )
        self._check_parameter(target.name)
        return target

    def is_possible(self, sample: Mapping[str, Any]) -> Bool[Array, ""]:
        """True if bodies can have a sample's masses and inertia tensors; may be traced."""
        return is_possible(self.table, self._table_factors(sample), self.relative)

    def facing(self) -> np.ndarray:
        """The world direction of the last body's z axis at the start (3,); a panel faces it."""
        return np.asarray(_rotation(self.build({})[1].p[-1]))[:, 2]

    def _table_factors(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in sample.items() if name not in self.own_factors}

    def _draw_table(self, sample: Mapping[str, Any]) -> Parameters:
        return drawn_table(self.table, self._table_factors(sample), self.relative)


def _with_inputs(system: System, values: Mapping[str, Any], inputs: Inputs) -> System:
    """System with the values of the factors input.NAME added to its inputs."""
    labels = [f"input.{name}" for name, _ in inputs.names]
    if not any(label in values for label in labels):
        return system
    more = jnp.stack([jnp.asarray(values.get(label, 0.0), dtype=float) for label in labels])
    return inputs.applied(system, inputs.values(system) + more)


# --- scenes


class _Shift(eqx.Module):
    """History of an input with a constant added."""

    of: Any
    more: Array

    def __call__(self, t: Any, kin: Any) -> Array:
        return self.of(t, kin) + self.more


@dataclass(frozen=True)
class Flights(AbstractFlights):
    """Settings that all runs of a study of a scene have in common.

    Attributes:
        scene, case: see `stmuav list`. table: of its parameters.
        own_factors: factors beside the table's, with their units.
        options: of the scene, plain data as `options_from_plain` takes. option_names: names of the table
            whose values the options replace, which cannot be factors. unused_names: of the table, that have no
            effect.
        relative: names of factors that multiply the table's value.
        inputs: "case" for the scene's own; "trim" for constant rotor speeds and actuator forces
            that hold the table's machine at its initial posture (uav_tracker, case 2).
        drag: add drag of the airframe.
        gusts: add Dryden gusts to the table's mean wind, different in each run; needs drag.
        duration: time for which gusts are sampled [s].
        held_inputs: all inputs of the scene at its trim (m,), where these are the inputs.
    """

    scene: str
    case: int | None
    table: Parameters
    own_factors: Mapping[str, str]
    options: Mapping[str, Any] = field(default_factory=dict)
    option_names: frozenset[str] = frozenset()
    unused_names: frozenset[str] = frozenset()
    relative: frozenset[str] = frozenset()
    inputs: Literal["case", "trim"] = "case"
    drag: bool = False
    gusts: bool = False
    duration: float = 1.0
    held_inputs: Float[np.ndarray, " m"] | None = None

    @cached_property
    def system(self) -> System:  # pyright: ignore[reportIncompatibleMethodOverride]
        """System of the scene with the table's numbers."""
        return self._make_scene(self.table, options_from_plain(self.scene, self.options)).system

    def _make_scene(self, table: Parameters, options: Mapping[str, Any]) -> Scene:
        # with a trim's inputs the case of the UAV is that whose inputs are constant
        case = 2 if self.inputs == "trim" and self.scene == "uav_tracker" else self.case
        return make_scene(self.scene, case, table, **options)

    def _check_parameter(self, name: str) -> None:
        if name in self.option_names:
            raise SettingError(f"'{name}' is set by the study's options: it cannot be a factor.")

    def build(self, sample: Mapping[str, Any], seed: Any = 0) -> tuple[System, State]:
        """System and initial state of one run, NaN for an impossible start; may be traced."""
        table = self._draw_table(sample)
        options = options_from_plain(self.scene, self.options)
        if self.drag:
            options = {"drag": Drag(), "wind": self._make_air(table, sample, seed)} | options
        scene_options = SCENES[self.scene].options
        if "start" in scene_options:
            drawn_start = {k[6:]: v for k, v in sample.items() if k.startswith("start.")}
            first = options.get("start", scene_options["start"].kind())
            options["start"] = replace(first, **drawn_start)
        scene = self._make_scene(table, options)
        return self._drive_inputs(scene.system, sample), scene.state0

    def plain(self) -> dict[str, Any]:
        """Plain data that identify the scene, without its table."""
        names = ("scene", "case", "inputs", "drag", "gusts")
        options = {"options": self.options} if self.options else {}
        return {name: getattr(self, name) for name in names} | options

    def _make_air(self, table: Parameters, values: Mapping[str, Any], seed: Any) -> Any:
        mean = jnp.asarray(table.value("wind.mean"), dtype=float)
        parts = [values.get(f"wind.{axis}", mean[k]) for k, axis in enumerate("xyz")]
        mean = jnp.stack([jnp.asarray(x, dtype=float) for x in parts])
        if not self.gusts:
            return mean
        kind = low_altitude(table.value("gust.height"), table.value("gust.speed_20ft"))
        speed, spacing = jnp.sqrt(jnp.sum(mean * mean)), Wind().spacing
        # One spacing more: the last step of a run may end beyond its last sample by round-off.
        duration = self.duration + spacing
        return dryden(seed, kind, airspeed=speed, duration=duration, dt=spacing, mean=mean)

    def _drive_inputs(self, system: System, values: Mapping[str, Any]) -> System:
        """System with the inputs of the trim, and their changes by the factors."""
        if self.held_inputs is not None:
            system = inputs_of(system).applied(system, jnp.asarray(self.held_inputs))
        forces = list(system.forces)
        for k, force in enumerate(forces):
            if isinstance(force, Rotors):
                # Factors of rotors multiply, as errors of thrust are in proportion to it; those of the
                # actuators add a force.
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
        return _with_inputs(system, values, _other_inputs(system))


def _rotor_inputs(rotors: Rotors) -> list[str]:
    return [f"input.rotor_{k + 1}" for k in range(rotors.spin.shape[0])]


def _actuator_input(actuator: LinearActuator) -> str:
    return f"input.actuator_{actuator.slider.rpartition('_')[2]}"


def _other_inputs(system: System) -> Inputs:
    """Constant inputs of forces other than rotors and actuators, to which factors are added."""
    named_apart = [isinstance(f, (Rotors, LinearActuator)) for f in system.forces]
    every = inputs_of(system).entries
    return Inputs(tuple(e for e in every if not named_apart[e.force])).constant(system)


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
        result = trim_condition(space, hover(), at=start) if floats else trim(space, at=start)
    except (StateError, SettingError) as error:
        raise SettingError(f"The scene {scene} has no trim from its start: {error}") from None
    return np.asarray(result.values)


def make_flights(
    scene: str, case: int | None = None, table: Parameters | None = None, **options: Any
) -> Flights:
    """Checked settings of a study's runs, of a scene by name.

    Raises:
        SettingError: an unknown scene, case or option, gusts without drag, a scene without a trim.
    """
    if not isinstance(scene, str) or not (case is None or isinstance(case, int)):
        raise SettingError(
            f"A scene has a name and a case a number, not {format_value((scene, case))}."
        )
    entry = entry_of(scene)
    table = entry.parameters if table is None else table
    case = entry.default_case if case is None else case
    settings = Flights(scene, case, table, {}, **options)
    drag = settings.drag
    for is_wrong, message in (
        (settings.inputs == "trim" and "motor" in settings.options,
         "Inputs of a trim are steady speeds of the rotors: leave motor out."),
        (drag and "drag" not in entry.options, f"The scene {scene} has no airframe for drag: leave drag out."),
        (settings.gusts and not drag, "Gusts act through the airframe's drag: set drag too."),
        (drag and "wind" in settings.options, "A study with drag = true has the wind of the table, of its factors "
         "and of gusts: leave the option wind out."),
    ):  # fmt: skip
        if is_wrong:
            raise SettingError(message)
    built = settings._make_scene(table, options_from_plain(scene, settings.options))
    # A parameter that an option has set would silently override its factor.
    option_parameters = frozenset(
        name for name, line in built.parameters.items() if line != table[name].plain()
    )
    # A scene lists what it is built from; the study itself adds drag and its wind. One of a user may list nothing.
    of_air = (("drag.", "wind.") if drag else ()) + (("gust.",) if settings.gusts else ())
    unused = {
        name for name in table if name not in built.parameters and not name.startswith(of_air)
    }
    settings = replace(
        settings,
        own_factors=_list_own_factors(settings, built.system),
        option_names=option_parameters,
        unused_names=frozenset(unused if built.parameters else ()),
    )
    if settings.inputs == "trim":
        if scene == "uav_tracker":
            trim_result = trim_flight(make_uav(table), hover(initial_angles(table)))
            if (reason := TrimReason(int(trim_result.reason))) != TrimReason.VALID:
                raise SettingError(
                    f"There is no hover at the initial posture of these parameters: {reason.label}."
                )
            held_inputs = np.asarray(trim_result.values)
        else:
            held_inputs = trim_inputs(scene, built)
        settings = replace(settings, held_inputs=held_inputs)
    vars(settings)["system"] = built.system
    return settings


def _list_own_factors(of: Flights, system: System) -> dict[str, str]:
    """Factors beside the table's, with their units: those of the start, the inputs and the wind."""
    result: dict[str, str] = {}
    start = SCENES[of.scene].options.get("start")
    if start is not None:
        result |= {f"start.{k}": number.unit for k, number in quantity_fields(start.kind).items()}
    for force in system.forces:
        if isinstance(force, Rotors):
            result |= dict.fromkeys(_rotor_inputs(force), "1")
        elif isinstance(force, LinearActuator):
            result[_actuator_input(force)] = "N"
    result |= {f"input.{name}": unit for name, unit in _other_inputs(system).names}
    return result | _WIND if of.drag else result


# --- models from files


@dataclass(frozen=True)
class ModelFlights(AbstractFlights):
    """Settings that all runs of a study of a model have in common.

    Attributes:
        model: the model. relative: names of factors that multiply a parameter's value.
        inputs: "case" for the model's own; "trim" for those that hold it at its start.
        independent: coordinates that must be independent, since factors are added to them.
    """

    model: ParametricModel | Robot
    relative: frozenset[str] = frozenset()
    inputs: Literal["case", "trim"] = "case"
    independent: tuple[str, ...] = ()

    @property
    def scene(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Name of the model."""
        return self.model.scene.name

    @property
    def table(self) -> Parameters:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Parameters of the model."""
        return self.model.table

    @property
    def unused_names(self) -> frozenset[str]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Names of the parameters to which no entry of the model refers."""
        return frozenset(self.model.table) - self.model.used_parameters()

    @property
    def system(self) -> System:
        """System of the model with the parameters' own values."""
        return self.model.scene.system

    @cached_property
    def _space(self) -> tuple[TreeSpace, TreePoint]:
        """Independent coordinates, and the point at the model's start."""
        scene = self.model.scene

        def locate() -> tuple[TreeSpace, TreePoint]:
            space = TreeSpace(scene.system, scene.state0, independent=self.independent, t=scene.t0)
            return space, space.from_state(scene.state0)

        # the first to ask may be a program that is being traced
        return compute_untraced(locate)

    @property
    def dependent_rows(self) -> bool:
        """True if closed loops have constraint rows that follow from others at the start."""
        return self._space[0].has_dependent_rows

    @cached_property
    def _trim_inputs(self) -> Float[np.ndarray, " m"] | None:
        if self.inputs == "case":
            return None
        return compute_untraced(trim_inputs, self.scene, self.model.scene)

    @cached_property
    def _inputs(self) -> Inputs:
        system = self.model.scene.system
        return inputs_of(system).constant(system)

    @cached_property
    def own_factors(self) -> dict[str, str]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Factors beside the parameters, with their units."""
        space, _ = self._space
        result = {f"start.{name}": unit for name, unit in space.names[: 2 * space.dof]}
        return result | {f"input.{name}": unit for name, unit in self._inputs.names}

    def _check_parameter(self, name: str) -> None:
        if name in self.model.of_start():
            raise SettingError(
                f"The parameter '{name}' sets the model's start, which factors start.STATE change: "
                f"{', '.join(name for name in self.own_factors if name.startswith('start.'))}."
            )

    def build(self, sample: Mapping[str, Any], seed: Any = 0) -> tuple[System, State]:
        """System and initial state of one run, NaN for an impossible start; may be traced."""
        scene, (space, x) = self.model.scene, self._space
        system = scene.system
        # Without a factor of the table the model's system serves as it is, and is not built again in the
        # program.
        if self._table_factors(sample):
            system = self.model.system(self._draw_table(sample))
        if self._trim_inputs is not None:
            system = inputs_of(system).applied(system, jnp.asarray(self._trim_inputs))
        system = _with_inputs(system, sample, self._inputs)
        if not sample:
            return system, scene.state0
        labels = [f"start.{name}" for name, _ in space.names[: 2 * space.dof]]
        departure = [jnp.asarray(sample.get(name, 0.0), dtype=float) for name in labels]
        departure += [jnp.zeros(())] * (space.size - len(departure))
        # Departures from the start on the space of coordinates: loops stay closed, and rotations stay
        # rotations.
        space = space.with_system(system)
        return system, space.to_state(space.retract(x, jnp.stack(departure)), scene.t0)

    def plain(self) -> dict[str, Any]:
        """Plain data that identify the model."""
        return {"model": self.scene, "digest": self.model.digest, "inputs": self.inputs}


def start_states(factors: Iterable[str]) -> tuple[str, ...]:
    """Names of the coordinates to which factors start.STATE are added, without those of a floating base."""
    state_names = [name[6:] for name in factors if name.startswith("start.")]
    names = dict.fromkeys(name.removesuffix("_rate") for name in state_names)
    return tuple(name for name in names if name not in dict(BASE))
