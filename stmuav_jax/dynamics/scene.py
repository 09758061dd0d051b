"""A scene: a system, where it starts, and for how long it is worth watching."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from ..mechanics.state import State
from ..mechanics.system import System


@dataclass(frozen=True)
class Scene:
    """Everything that `simulate` needs to know of what is simulated.

    Attributes:
        name: short, for files. title: one line, for people.
        system: bodies, joints, forces.
        state0: at t0, consistent with the joints (see `assemble`).
        t0, t1: the span [s]. save_every: spacing of the saved times [s].
        parameters: the numbers that the scene was built from, by name: each a mapping
            with "value", "unit" and "source"; kept with the results.
        notes: what the reader of a result must know, one sentence each.
        watch: names of the bodies that figures show.
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
