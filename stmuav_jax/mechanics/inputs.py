"""Named inputs of a system: the numbers of its forces that a user or controller may choose.

A force lists in `inputs` which of its fields are inputs, such as the squared speeds of rotors or
the effort in a joint. `Inputs` gathers the inputs of a system as one vector with names and units,
and makes the system in which they have other values or histories.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cache, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, named_places
from ..checks.numbers import as_floats, as_numpy, check_numbers
from .joint import choose_coordinate
from .load import AbstractForce
from .state import State
from .system import System


class NamedInput(NamedTuple):
    """Description of one scalar input.

    Attributes:
        name, unit: name and unit of the input.
        force: index of its force in the system's forces.
        field: field of the force, with points between nested parts.
        place: index within the field's value; () for a plain number.
    """

    name: str
    unit: str
    force: int
    field: str
    place: tuple[int, ...]


class Components(eqx.Module):
    """Field value that selects some components from a history of all inputs, which may be a plain number."""

    whole: Any
    places: tuple[int, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: Any, kin: Any = None) -> Array:
        values = jnp.asarray(self.whole(t, kin)).reshape(-1)
        return values[np.array(self.places, dtype=int)].reshape(self.shape)


class Inputs(eqx.Module):
    """Inputs of a system in a fixed order; made by `inputs_of`.

    Attributes:
        entries: description of each scalar input.
    """

    entries: tuple[NamedInput, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of every input."""
        return tuple((entry.name, entry.unit) for entry in self.entries)

    def values(self, system: System) -> Float[Array, " m"]:
        """Present values of the inputs in a system (m,).

        Raises:
            ModelError: an input is a function of time and has no single value.
        """
        numbers = present_values(system, self)
        for entry, value in zip(self.entries, numbers, strict=True):
            if callable(value):
                raise ModelError(
                    f"The input '{entry.name}' is a function of time in this system: give its value."
                )
        return jnp.stack(numbers) if numbers else jnp.zeros((0,))

    def values_at(
        self, system: System, state: State, t: Float[Array, ""] | float
    ) -> Float[Array, " m"]:
        """Values of the inputs (m,) at a state and time [s], at which functions of time are evaluated."""
        time, kin = jnp.asarray(t, dtype=float), system.kinematics(state)
        numbers = []
        for entry, value in zip(self.entries, present_values(system, self), strict=True):
            if callable(value):
                count = len(inspect.signature(value).parameters)
                value = jnp.asarray(value(*(time, kin)[:count]), dtype=float)[entry.place]
            numbers.append(value)
        return jnp.stack(numbers) if numbers else jnp.zeros((0,))

    def applied(self, system: System, values: Any) -> System:
        """System whose inputs are set to values or to a history.

        Args:
            values: (m,), or a function of (t, kinematics) that returns them, such as `Sampled`.

        Raises:
            ModelError: only some numbers of a field are set, and field or values are functions of
                time.
        """
        # Inputs of one field are set together, since each replacement copies the pytree.
        fields: dict[tuple[int, str], list[int]] = {}
        for k, entry in enumerate(self.entries):
            fields.setdefault((entry.force, entry.field), []).append(k)
        kinematics = _find_kinematics_shape(system)
        for (force, field), places in fields.items():
            old = _read_field(system, self.entries[places[0]])
            shape = _value_shape(old, kinematics)
            whole = len(places) == int(np.prod(shape))
            # A function returns a whole field: some of its numbers cannot be replaced from outside
            # without calling it in the middle of another one.
            if not whole and (callable(old) or callable(values)):
                raise ModelError(
                    f"All numbers of '{field}' must be inputs together where it is a function of "
                    f"time, but only {len(places)} of {int(np.prod(shape))} are."
                )
            if callable(values):
                new: Any = Components(values, tuple(places), shape)
            # The usual case, all speeds of all rotors, goes through NumPy where values are known:
            # setting one number after the other would be as many operations of JAX.
            elif whole:
                new = as_floats(as_numpy(as_floats(values))[np.array(places)].reshape(shape))
            else:
                new = jnp.asarray(old)
                for k in places:
                    new = new.at[self.entries[k].place].set(values[k])
            where = lambda s, force=force, field=field: _walk_fields(s.forces[force], field)
            system = eqx.tree_at(where, system, new)
        return system

    def chosen(self, names: Sequence[str]) -> "Inputs":
        """These inputs alone, in this order; raises `SettingError` for an unknown name.

        The name of a vector without a number, such as `speed_squared`, stands for all of its.
        """
        input_names = [entry.name for entry in self.entries]
        if not isinstance(names, str) and all(isinstance(name, str) for name in names):
            names = [
                entry_name for name in names for entry_name in self._numbered_names(name) or (name,)
            ]
        places = named_places(names, input_names, "The chosen inputs", "input")
        return Inputs(tuple(self.entries[k] for k in places))

    def constant(self, system: System) -> "Inputs":
        """These inputs without those that are functions of time."""
        return Inputs(tuple(e for e in self.entries if not callable(_read_field(system, e))))

    def _numbered_names(self, stem: str) -> tuple[str, ...]:
        """The names of the numbers of a vector."""
        return tuple(
            e.name for e in self.entries if e.place and e.name == stem + _number_suffix(e.place)
        )


def present_values(system: System, inputs: Inputs) -> tuple[Any, ...]:
    """Value of each input in a system: a number, or the function of time that its field has."""
    fields = [_read_field(system, entry) for entry in inputs.entries]
    return tuple(
        value if callable(value) else jnp.asarray(value, dtype=float)[entry.place]
        for value, entry in zip(fields, inputs.entries, strict=True)
    )


def with_inputs(system: System, values: Mapping[str, Any]) -> System:
    """The system with some inputs set by name, see `inputs_of`; the others stay as they are.

    Args:
        values: by the name of an input, or of a vector without its number: its value, or a function of
            (t, kinematics) that returns it, such as `Sampled`.

    Raises:
        SettingError: an unknown name. ModelError: another number of values, numbers that are not
            finite, or a function for a part of a vector.
    """
    every = inputs_of(system)
    for name, value in values.items():
        chosen_inputs = every.chosen([name])
        if callable(value):
            system = chosen_inputs.applied(system, value)
        else:
            shape = (len(chosen_inputs),) if np.ndim(value) or len(chosen_inputs) > 1 else ()
            input_values = check_numbers(
                value, shape, f"The input '{name}'", chosen_inputs.entries[0].unit
            )
            system = chosen_inputs.applied(system, input_values.reshape(-1))
    return system


def inputs_of(system: System, names: Sequence[str] | None = None) -> Inputs:
    """Inputs of a system's forces: all of them, or the named ones.

    An input is named after its field and the object of its force, with the component of a vector
    counted from 1: `effort_hinge`, `force_slider_2`, `speed_squared_3`. A field that occurs once,
    such as the rotor speeds of the only body with rotors, is named without its object.

    Raises:
        SettingError: a name is unknown.
    """
    raw = [
        (k, force, field, _input_unit(system, force, unit))
        for k, force in enumerate(system.forces)
        for field, unit in force.inputs
    ]
    entries: list[NamedInput] = []
    kinematics = _find_kinematics_shape(system)
    for k, force, field, unit in raw:
        last = field.split(".")[-1]
        # Short names where they are unambiguous: a second force with the same field makes both longer.
        alone = sum(other.split(".")[-1] == last for _, _, other, _ in raw) == 1
        names_of = force.acts_on()
        owner = [*names_of.bodies[-1:], *names_of.joints, *(j for j, _ in names_of.coordinates)]
        stem = last if alone else "_".join([last, *owner])
        shape = _value_shape(_walk_fields(force, field), kinematics)
        # Each number of a vector is an input of its own: a linear model has a column for each, and
        # a study a factor.
        for place in np.ndindex(*shape):
            entries.append(NamedInput(stem + _number_suffix(place), unit, k, field, place))
    # Two forces of one kind on one body have the same name; numbers in the order of the forces
    # keep them apart, and the first keeps the short name.
    name_counts: dict[str, int] = {}
    for i, entry in enumerate(entries):
        name_counts[entry.name] = name_counts.get(entry.name, 0) + 1
        if name_counts[entry.name] > 1:
            entries[i] = entry._replace(name=f"{entry.name}.{name_counts[entry.name]}")
    system_inputs = Inputs(tuple(entries))
    return system_inputs if names is None else system_inputs.chosen(names)


def _input_unit(system: System, force: AbstractForce, unit: str) -> str:
    """Unit of an input; of "N or N m" and its like, the one of the coordinate that the force acts on."""
    sliding, _, turning = unit.partition(" or ")
    coordinates = force.acts_on().coordinates
    if not turning or len(coordinates) != 1:
        return unit
    name, coordinate = coordinates[0]
    chosen = choose_coordinate(
        system.joints[system.joint_index(name)], coordinate, type(force).__name__
    )
    return turning if chosen == "angle" else sliding


def _number_suffix(place: tuple[int, ...]) -> str:
    """The end of a name that says which number of a vector it is."""
    return "".join(f"_{i + 1}" for i in place)


def _walk_fields(force: AbstractForce, field: str) -> Any:
    return reduce(getattr, field.split("."), force)


def _read_field(system: System, entry: NamedInput) -> Any:
    return _walk_fields(system.forces[entry.force], entry.field)


def _find_kinematics_shape(system: System) -> Callable[[], Any]:
    """Function that returns shapes of a system's kinematics, found once asked for: a trace takes 0.05 s."""
    return cache(lambda: eqx.filter_eval_shape(system.kinematics, system.reference))


def _value_shape(value: Any, kinematics: Callable[[], Any]) -> tuple[int, ...]:
    """Shape of a field's value, or of the result of its function."""
    if not callable(value):
        return jnp.shape(value)
    # loads take (t, kinematics), motions along a joint's coordinate t alone
    count = len(inspect.signature(value).parameters)
    arguments = (jnp.zeros(()),) if count < 2 else (jnp.zeros(()), kinematics())
    return eqx.filter_eval_shape(lambda *a: jnp.asarray(value(*a)), *arguments).shape
