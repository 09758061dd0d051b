"""Disturbed systems and initial states of a study of a model from a file.

Factors are the model's own parameters, such as "length" or "inertia[0]", and

    start.STATE   added to an independent coordinate or velocity of the start, such as
        start.A.angle [rad] or start.A.angle_rate [rad/s]; loops are closed from there;
    input.NAME    added to a constant input, such as input.effort [N].

A relative factor multiplies the parameter's value.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.errors import SettingError
from ..checks.schema import SHOWN
from ..dynamics.scene import Scene
from ..dynamics.statespace.names import BASE
from ..dynamics.statespace.tree import TreePoint, TreeSpace
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.state import State
from ..mechanics.system import System
from ..parameters.table import Parameters
from .disturbed_flights import Drawn, trim_inputs
from .factors import FactorTarget, alike, drawn_table, faced, possible_tables, table_entry


@runtime_checkable
class ModelSource(Protocol):
    """Model as a study needs it: `stmuav_jax.files.read_model` makes one.

    Attributes:
        scene: scene with the parameters' own values. table: its parameters.
        digest: text that tells models with other numbers apart.
    """

    @property
    def scene(self) -> Scene: ...
    @property
    def table(self) -> Parameters: ...
    @property
    def digest(self) -> str: ...

    def system(self, table: Parameters) -> System:
        """System with the values of a table, which may be traced."""
        ...

    def of_start(self) -> frozenset[str]:
        """Names of the parameters to which the start refers."""
        ...


@dataclass(frozen=True)
class ModelFlights:
    """Settings that all runs of a study of a model have in common, see `Flights`.

    Attributes:
        model: the model. relative: names of factors that multiply a parameter's value.
        inputs: "case" for the model's own; "trim" for those that hold it at its start.
        independent: coordinates that must be independent, since factors are added to them.
        gusts: False; models have no wind.
    """

    model: ModelSource
    relative: frozenset[str] = frozenset()
    inputs: Literal["case", "trim"] = "case"
    independent: tuple[str, ...] = ()
    gusts: bool = field(default=False, init=False)

    @property
    def scene(self) -> str:
        """Name of the model."""
        return self.model.scene.name

    @property
    def table(self) -> Parameters:
        """Parameters of the model."""
        return self.model.table

    def __getstate__(self) -> dict[str, Any]:
        """State without what is found again from the rest."""
        names = ("model", "relative", "inputs", "independent")
        return {name: self.__dict__[name] for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    @cached_property
    def _space(self) -> tuple[TreeSpace, TreePoint]:
        """Independent coordinates, and the point at the model's start."""
        scene = self.model.scene
        # the first to ask may be a program that is being traced
        with jax.ensure_compile_time_eval():
            space = TreeSpace(scene.system, scene.state0, independent=self.independent, t=scene.t0)
            return space, space.from_state(scene.state0)

    @property
    def dependent_rows(self) -> bool:
        """True if closed loops have constraint rows that follow from others at the start."""
        return self._space[0].has_dependent_rows

    @cached_property
    def _held(self) -> Float[np.ndarray, " m"] | None:
        if self.inputs == "case":
            return None
        with jax.ensure_compile_time_eval():
            return trim_inputs(self.scene, self.model.scene)

    @cached_property
    def _inputs(self) -> Inputs:
        system = self.model.scene.system
        return inputs_of(system).constant(system)

    @cached_property
    def own(self) -> dict[str, str]:
        """Factors beside the parameters, with their units."""
        space, _ = self._space
        found = {f"start.{name}": unit for name, unit in space.names[: 2 * space.dof]}
        return found | {f"input.{name}": unit for name, unit in self._inputs.names}

    def entry(self, factor: str) -> FactorTarget:
        """Target of a factor.

        Raises:
            SettingError: an unknown name, a place that the parameter does not have, a relative
                factor of no parameter, a parameter that sets the start.
        """
        if factor in self.own:
            if factor in self.relative:
                raise SettingError(
                    f"'{factor}' is no parameter of the model that it could multiply."
                )
            return FactorTarget(factor, (), self.own[factor])
        unknown = lambda: (
            f"is neither a parameter of {self.scene} nor part of its start or inputs."
            f"{alike(factor[:SHOWN], [*self.own, *self.table])}"
        )
        found = table_entry(self.table, factor, factor in self.relative, unknown)
        if found.name in self.model.of_start():
            raise SettingError(
                f"The parameter '{found.name}' sets the model's start, which factors start.STATE change: "
                f"{', '.join(name for name in self.own if name.startswith('start.'))}."
            )
        return found

    def possible(
        self, names: tuple[str, ...], drawn: Float[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """True for samples with masses and inertia tensors that bodies can have (n,)."""
        places = [k for k, name in enumerate(names) if name not in self.own]
        factors = tuple(names[k] for k in places)
        return possible_tables(self.table, factors, drawn[:, places], self.relative)

    def build(self, names: tuple[str, ...], drawn: Drawn) -> tuple[System, State]:
        """System and initial state of one run, NaN for an impossible start; may be traced."""
        values = dict(zip(names, drawn.values, strict=True)) if names else {}
        scene, (space, x) = self.model.scene, self._space
        numbers = {name: value for name, value in values.items() if name not in self.own}
        system = scene.system
        if numbers:
            system = self.model.system(drawn_table(self.table, numbers, self.relative))
        system = self._driven(system, values)
        if not values:
            return system, scene.state0
        labels = [f"start.{name}" for name, _ in space.names[: 2 * space.dof]]
        moved = [jnp.asarray(values.get(name, 0.0), dtype=float) for name in labels]
        moved += [jnp.zeros(())] * (space.size - len(moved))
        own = space.with_system(system)
        return system, own.to_state(own.retract(x, jnp.stack(moved)), scene.t0)

    def _driven(self, system: System, values: Mapping[str, Array]) -> System:
        """System with the inputs of the trim, and their changes by the factors."""
        if self._held is not None:
            system = inputs_of(system).applied(system, jnp.asarray(self._held))
        labels = [f"input.{name}" for name, _ in self._inputs.names]
        if not any(name in values for name in labels):
            return system
        more = jnp.stack([jnp.asarray(values.get(name, 0.0), dtype=float) for name in labels])
        return self._inputs.applied(system, self._inputs.values(system) + more)

    def nominal(self) -> tuple[System, State]:
        """System and initial state without any disturbance."""
        return self.build((), Drawn(jnp.zeros(0), jnp.zeros((), jnp.uint32)))

    def facing(self) -> np.ndarray:
        """The world direction of the last body's z axis at the start (3,)."""
        return faced(self.model.scene.state0)

    def plain(self) -> dict[str, Any]:
        """Plain data of what tells the model from others."""
        return {"model": self.scene, "digest": self.model.digest, "inputs": self.inputs}


def started(factors: Iterable[str]) -> tuple[str, ...]:
    """Names of the coordinates to which factors start.STATE are added, without those of a floating base."""
    given = [name[6:] for name in factors if name.startswith("start.")]
    names = dict.fromkeys(name.removesuffix("_rate") for name in given)
    return tuple(name for name in names if name not in dict(BASE))
