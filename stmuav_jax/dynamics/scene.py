"""Scenes: a system, its initial state, and the time span of interest."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..mechanics.state import State
from ..mechanics.system import System


@dataclass(frozen=True)
class Scene:
    """Complete description of a simulation's subject: system, initial state, span and notes.

    Attributes:
        name: short name, for files. title: one line, for people.
        system: bodies, joints, forces.
        state0: state at t0 that satisfies the joints (see `assemble`).
        t0, t1: time span [s]. save_every: spacing of the saved times [s].
        parameters: numbers from which the scene was built, by name: each a mapping with "value",
            "unit" and "source"; kept with the results.
        notes: facts that the reader of a result must know, one sentence each.
        watch: names of the bodies that figures show.
        links_between: names of the bodies of nearly no mass that an import put between several
            joints of one body.
        sensors: instruments of the mechanism (`stmuav_jax.control.Instrument`) by name.
    """

    name: str
    title: str
    system: System
    state0: State
    t0: float = 0.0
    t1: float = 2.0
    save_every: float = 0.01
    parameters: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    watch: tuple[str, ...] = ()
    links_between: tuple[str, ...] = ()
    sensors: Mapping[str, Any] = field(default_factory=dict)
