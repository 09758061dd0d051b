"""Signals of a flight by name: numbers of time and state that quantities are made from."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..dynamics.energy import energy
from ..dynamics.formulation import Reactions
from ..dynamics.problem import Problem, at_internal
from ..mechanics.errors import SettingError, nearest_names
from ..mechanics.schema import SHOWN, named
from ..mechanics.state import State
from ..mechanics.system import System
from ..vehicle.kinematics import panel_angles

PANEL, SLIDERS = "panel_7", ("slider_2", "slider_3")


class View:
    """A flight at one time, as signals see it; what several need is found once.

    Args:
        problem: prepared. t: [s]. y: the integrated vector (n,).
        direction: that the panel should face, world (3,), a unit vector.
    """

    def __init__(self, problem: Problem, t: Array, y: Array, direction: Array) -> None:
        self.problem, self.t, self.y, self.direction = problem, t, y, direction

    @cached_property
    def model(self) -> Any:
        """With the states of forces that have some."""
        problem = self.problem
        if not problem.n_internal:
            return problem.model
        own = self.y[problem.n_state : problem.n_state + problem.n_internal]
        return at_internal(problem.model, own)

    @property
    def system(self) -> System:
        return self.model.system

    @cached_property
    def state(self) -> State:
        """Of all bodies."""
        x = self.y[: self.problem.n_state]
        return self.problem.method.formulation.to_state(self.model, x)

    @cached_property
    def R_wb(self) -> Float[Array, "3 3"]:
        """Of the base; the world's axes where the mechanism stands on the ground."""
        return rotation_matrix(self.state.p[0]) if self.system.floating else jnp.eye(3)

    @cached_property
    def normal_w(self) -> Float[Array, "3"]:
        """The panel's, world."""
        return rotation_matrix(self.state.p[self.system.index(PANEL)])[:, 2]

    @cached_property
    def angles(self) -> Float[Array, "2"]:
        """Of the panel in the base (phi, theta)."""
        return panel_angles(self.R_wb.T @ self.normal_w)

    @cached_property
    def reactions(self) -> Reactions:
        """At all joints."""
        method = self.problem.method
        found = method.formulation.accelerations(
            self.model, self.t, self.state, method.stabilisation
        )
        return method.formulation.reactions(self.model, self.t, self.state, found)

    def stroke(self, name: str) -> Float[Array, ""]:
        """How far a slider is above its place in the reference posture."""
        k, now, then = self.system.index(name), self.state, self.system.reference
        base = (now.r[0], then.r[0]) if self.system.floating else (jnp.zeros(3), jnp.zeros(3))
        return (self.R_wb.T @ (now.r[k] - base[0]))[2] - (then.r[k] - base[1])[2]


@dataclass(frozen=True)
class Signal:
    """One number of a flight's view.

    Attributes:
        of: what it is. unit: SI. words: for tables and figures.
        smooth: whether its rate is worth its cost; reactions are evaluated within steps instead.
    """

    of: Callable[[View], Array]
    unit: str
    words: str
    smooth: bool = True


def length(x: Float[Array, " k"]) -> Float[Array, ""]:
    """Of a vector; at zero, the tip of a cone, its derivative is taken as zero."""
    square = jnp.sum(x * x)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def angle_between(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    """Of two vectors [rad]; exact for small angles and near pi, derivatives of zero at both."""
    return jnp.arctan2(length(jnp.cross(a, b)), a @ b)


_UP = (0.0, 0.0, 1.0)

_BASE = {
    "x": Signal(lambda v: v.state.r[0, 0], "m", "base, x"),
    "y": Signal(lambda v: v.state.r[0, 1], "m", "base, y"),
    "z": Signal(lambda v: v.state.r[0, 2], "m", "base, height"),
    "distance": Signal(lambda v: length(v.state.r[0]), "m", "base, distance from the origin"),
    "speed": Signal(lambda v: length(v.state.v[0]), "m/s", "base, speed"),
    "spin": Signal(lambda v: length(v.state.omega[0]), "rad/s", "base, angular velocity"),
    "tilt": Signal(
        lambda v: angle_between(v.R_wb[:, 2], jnp.array(_UP, v.y.dtype)), "rad", "base, tilt"
    ),
}
_PANEL = {
    "phi": Signal(lambda v: v.angles[0], "rad", "panel, phi in the base"),
    "theta": Signal(lambda v: v.angles[1], "rad", "panel, theta in the base"),
    "panel_tilt": Signal(
        lambda v: angle_between(v.normal_w, jnp.array(_UP, v.y.dtype)), "rad", "panel, tilt"
    ),
    "pointing": Signal(
        lambda v: angle_between(v.normal_w, v.direction), "rad", "panel, pointing error"
    ),
    "panel_spin": Signal(
        lambda v: length(v.state.omega[v.system.index(PANEL)]), "rad/s", "panel, angular velocity"
    ),
    "stroke_2": Signal(lambda v: v.stroke(SLIDERS[0]), "m", "slider 2, stroke"),
    "stroke_3": Signal(lambda v: v.stroke(SLIDERS[1]), "m", "slider 3, stroke"),
}
_ANY = {
    "energy": Signal(lambda v: energy(v.system, v.state, v.t).total, "J", "energy"),
    "kinetic": Signal(lambda v: energy(v.system, v.state, v.t).kinetic, "J", "kinetic energy"),
}


def _at_joint(kind: str, k: int) -> Callable[[View], Array]:
    return lambda v: length(getattr(v.reactions, kind)[k])


def signals(system: System) -> dict[str, Signal]:
    """The signals that a system has, by name."""
    found = dict(_ANY)
    if system.floating:
        found |= _BASE
    if PANEL in system.names:
        found |= _PANEL
    for k, joint in enumerate(system.joints):
        name = joint.name
        found[f"force.{name}"] = Signal(
            _at_joint("force", k), "N", f"joint {name}, reaction force", smooth=False
        )
        found[f"moment.{name}"] = Signal(
            _at_joint("moment", k), "N m", f"joint {name}, reaction moment", smooth=False
        )
    return found


def signal(system: System, name: str) -> Signal:
    """The named signal of a system.

    Raises:
        SettingError: it has no such signal.
    """
    known = signals(system)
    if name not in known:
        raise SettingError(f"There is no signal {named(name)}.{nearest_names(name[:SHOWN], known)}")
    return known[name]
