"""Named inputs of a system: the numbers of its forces that a user or controller may choose.

A force lists in `inputs` which of its fields are inputs, such as the squared speeds of rotors or
the effort in a joint. `Inputs` gathers the inputs of a system as one vector with names and units,
and makes the system in which they have other values or histories.
"""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, named_places
from ..checks.numbers import as_numpy, floats, numbers
from .load import AbstractForce
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
    """Field value that selects some components from a history of all inputs."""

    whole: Any
    places: tuple[int, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: Any, kin: Any = None) -> Array:
        values = jnp.asarray(self.whole(t, kin))
        return values[np.array(self.places, dtype=int)].reshape(self.shape)


class _Vector(eqx.Module):
    """A function of time whose value is one vector, also where it returns a plain number."""

    whole: Any

    def __call__(self, t: Any, kin: Any = None) -> Array:
        return jnp.asarray(self.whole(t, kin)).reshape(-1)


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
        found = []
        for entry in self.entries:
            value = _field(system, entry)
            if callable(value):
                raise ModelError(
                    f"The input '{entry.name}' is a function of time in this system: give its value."
                )
            found.append(jnp.asarray(value, dtype=float)[entry.place])
        return jnp.stack(found) if found else jnp.zeros((0,))

    def applied(self, system: System, values: Any) -> System:
        """System whose inputs are set to values or to a history.

        Args:
            values: (m,), or a function of (t, kinematics) that returns them, such as `Sampled`.

        Raises:
            ModelError: only some numbers of a field are set, and field or values are functions of
                time.
        """
        fields: dict[tuple[int, str], list[int]] = {}
        for k, entry in enumerate(self.entries):
            fields.setdefault((entry.force, entry.field), []).append(k)
        for (force, field), places in fields.items():
            old = _field(system, self.entries[places[0]])
            shape = _shape(system, old)
            whole = len(places) == int(np.prod(shape))
            if not whole and (callable(old) or callable(values)):
                raise ModelError(
                    f"All numbers of '{field}' must be inputs together where it is a function of "
                    f"time, but only {len(places)} of {int(np.prod(shape))} are."
                )
            if callable(values):
                new: Any = Components(values, tuple(places), shape)
            elif whole:
                new = floats(as_numpy(floats(values))[np.array(places)].reshape(shape))
            else:
                new = jnp.asarray(old)
                for k in places:
                    new = new.at[self.entries[k].place].set(values[k])
            where = lambda s, force=force, field=field: _walk(s.forces[force], field)
            system = eqx.tree_at(where, system, new)
        return system

    def chosen(self, names: Sequence[str]) -> "Inputs":
        """These inputs alone, in this order; raises `SettingError` for an unknown name.

        The name of a vector without a number, such as `speed_squared`, stands for all of its.
        """
        known = [entry.name for entry in self.entries]
        if not isinstance(names, str) and all(isinstance(name, str) for name in names):
            names = [one for name in names for one in self._numbered(name) or (name,)]
        places = named_places(names, known, "The chosen inputs", "input")
        return Inputs(tuple(self.entries[k] for k in places))

    def constant(self, system: System) -> "Inputs":
        """These inputs without those that are functions of time."""
        return Inputs(tuple(e for e in self.entries if not callable(_field(system, e))))

    def _numbered(self, stem: str) -> tuple[str, ...]:
        """The names of the numbers of a vector."""
        return tuple(e.name for e in self.entries if e.place and e.name == stem + _number(e.place))


def with_inputs(system: System, given: Mapping[str, Any]) -> System:
    """The system with some inputs set by name, see `inputs_of`; the others stay as they are.

    Args:
        given: by the name of an input, or of a vector without its number: its value, or a function of
            (t, kinematics) that returns it, such as `Sampled`.

    Raises:
        SettingError: an unknown name. ModelError: another number of values, numbers that are not
            finite, or a function for a part of a vector.
    """
    every = inputs_of(system)
    for name, value in given.items():
        own = every.chosen([name])
        if callable(value):
            system = own.applied(system, _Vector(value))
        else:
            shape = (len(own),) if np.ndim(value) or len(own) > 1 else ()
            found = numbers(value, shape, f"The input '{name}'", own.entries[0].unit)
            system = own.applied(system, found.reshape(-1))
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
        (k, force, field, unit)
        for k, force in enumerate(system.forces)
        for field, unit in force.inputs
    ]
    entries: list[NamedInput] = []
    for k, force, field, unit in raw:
        last = field.split(".")[-1]
        alone = sum(other.split(".")[-1] == last for _, _, other, _ in raw) == 1
        names_of = force.acts_on()
        owner = [*names_of.bodies[-1:], *names_of.joints, *(j for j, _ in names_of.coordinates)]
        stem = last if alone else "_".join([last, *owner])
        shape = _shape(system, _walk(force, field))
        for place in np.ndindex(*shape):
            entries.append(NamedInput(stem + _number(place), unit, k, field, place))
    taken: dict[str, int] = {}
    for i, entry in enumerate(entries):
        taken[entry.name] = taken.get(entry.name, 0) + 1
        if taken[entry.name] > 1:
            entries[i] = entry._replace(name=f"{entry.name}.{taken[entry.name]}")
    found = Inputs(tuple(entries))
    return found if names is None else found.chosen(names)


def _number(place: tuple[int, ...]) -> str:
    """The end of a name that says which number of a vector it is."""
    return "".join(f"_{i + 1}" for i in place)


def _walk(force: AbstractForce, field: str) -> Any:
    value: Any = force
    for part in field.split("."):
        value = getattr(value, part)
    return value


def _field(system: System, entry: NamedInput) -> Any:
    return _walk(system.forces[entry.force], entry.field)


def _shape(system: System, value: Any) -> tuple[int, ...]:
    """Shape of a field's value, or of the result of its function."""
    if not callable(value):
        return jnp.shape(value)
    # loads take (t, kinematics), motions along a joint's coordinate t alone
    count = len(inspect.signature(value).parameters)

    def called() -> Array:
        kin = system.kinematics(system.reference)
        return jnp.asarray(value(*(jnp.zeros(()), kin)[: min(count, 2)]))

    return eqx.filter_eval_shape(called).shape
