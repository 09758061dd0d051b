"""Our methods in a process whose loops XLA compiles into native functions."""

from functools import cache

import numpy as np
from peers.adapter import Outcome, Peer, Prepared, Setting
from problems.compared import tracker
from sections.ours import Ours, explicit
from shared.clock import measure
from shared.native import with_native_loops
from shared.pages import NATIVE

import stmuav_jax as stm


@cache
def _method(which: int) -> Ours:
    """One of our methods, with the programs that it has compiled, kept in the other process."""
    return explicit(())[which]


def _run(which: int, end: float, setting: Setting, repeats: int) -> tuple[float, Outcome]:
    """Seconds to compile, and one run of the UAV with the seconds of its repetitions."""
    scene = tracker((end,)).scene
    prepared = _method(which).prepare(scene, np.array([end]), setting)
    seconds: list[float] = []

    def once() -> Outcome:
        timing, outcome = measure(prepared.run, repeats=1, warm_up=0)
        seconds.append(timing.median)
        return outcome

    _, outcome = measure(once, repeats=repeats, warm_up=1)
    return prepared.compile_seconds, Outcome(**{**vars(outcome), "seconds": seconds[1:]})


class Native(Peer):
    """One of our explicit methods with native loops, for the seven-body UAV.

    Args:
        which: its place in `explicit`.
    """

    def __init__(self, which: int, like: Ours, repeats: int) -> None:
        self.which, self.like, self.repeats = which, like, repeats
        self.name = f"{like.name}{NATIVE}"

    def version(self) -> str:
        return self.like.version()

    def settings(self, scene: stm.Scene | None = None) -> list[Setting]:
        return self.like.settings(scene)

    def prepare(self, scene: stm.Scene, times: np.ndarray, setting: Setting) -> Prepared:
        given = self.which, float(times[-1]), setting, self.repeats
        seconds, outcome = with_native_loops(_run, *given)
        return Prepared(lambda: outcome, seconds)


def native(tolerances: tuple[float, ...], repeats: int) -> list[Native]:
    """Every explicit method of ours with native loops."""
    return [Native(k, like, repeats) for k, like in enumerate(explicit(tolerances))]
