"""Signals of a run by name: scalar functions of time and state, from which quantities are made."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..analysis.sensors import joint_outputs
from ..checks.errors import SettingError, nearest_names
from ..checks.schema import SHOWN, quote_name
from ..dynamics.evaluation import energy
from ..dynamics.formulations.base import Reactions
from ..dynamics.integration.problem import Problem, at_internal
from ..math.derivative import safe_norm
from ..math.rotation import rotation_matrix
from ..mechanics.state import State
from ..mechanics.system import System
from ..uav.tracker.kinematics import panel_angles

PANEL = "panel_7"


class RunPoint:
    """State of a run at one time, with values that several signals need, each computed once.

    Args:
        problem: prepared problem.
        t: time [s].
        y: integrated vector (n,).
        direction: unit vector that the panel should face, world (3,).
    """

    def __init__(self, problem: Problem, t: Array, y: Array, direction: Array) -> None:
        self.problem, self.t, self.y, self.direction = problem, t, y, direction

    @cached_property
    def model(self) -> Any:
        """Model of the problem with the present internal states of forces."""
        problem = self.problem
        if not problem.n_internal:
            return problem.model
        internal = self.y[problem.n_state : problem.n_state + problem.n_internal]
        return at_internal(problem.model, internal)

    @property
    def system(self) -> System:
        return self.model.system

    @cached_property
    def state(self) -> State:
        """State of all bodies."""
        x = self.y[: self.problem.n_state]
        return self.problem.method.formulation.to_state(self.model, x)

    @property
    def base(self) -> int:
        """Row of the base."""
        return self.system.base

    @property
    def up(self) -> Float[Array, "3"]:
        """Unit vector upwards, world (3,)."""
        return jnp.array((0.0, 0.0, 1.0), self.y.dtype)

    @cached_property
    def R_wb(self) -> Float[Array, "3 3"]:
        """Attitude of the base; the world's axes where the mechanism stands on the ground."""
        return rotation_matrix(self.state.p[self.base]) if self.system.floating else jnp.eye(3)

    @cached_property
    def normal_w(self) -> Float[Array, "3"]:
        """Normal of the panel, world."""
        return rotation_matrix(self.state.p[self.system.index(PANEL)])[:, 2]

    @cached_property
    def angles(self) -> Float[Array, "2"]:
        """Panel angles (phi, theta) relative to the base [rad]."""
        return panel_angles(self.R_wb.T @ self.normal_w)

    @cached_property
    def reactions(self) -> Reactions:
        """Reactions at all joints."""
        method = self.problem.method
        result = method.formulation.accelerations(
            self.model, self.t, self.state, method.stabilisation
        )
        return method.formulation.reactions(self.model, self.t, self.state, result)

    def stroke(self, name: str) -> Float[Array, ""]:
        """Height of a slider above its place in the reference posture, base axes [m]."""
        k, now, reference = self.system.index(name), self.state, self.system.reference
        offset, reference_offset = now.r[k], reference.r[k]
        if self.system.floating:
            offset = offset - now.r[self.base]
            reference_offset = reference_offset - reference.r[self.base]
        return (self.R_wb.T @ offset)[2] - reference_offset[2]


@dataclass(frozen=True)
class Signal:
    """Scalar signal of a run.

    Attributes:
        of: function from a point of a run to the signal's value.
        unit: SI unit.
        label: description for tables and figures.
        smooth: true if its rate is computed too; reactions are evaluated within steps instead.
    """

    of: Callable[[RunPoint], Array]
    unit: str
    label: str
    smooth: bool = True


def angle_between(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    """Angle between two vectors [rad], exact near 0 and pi, with derivatives set to zero there."""
    return jnp.arctan2(safe_norm(jnp.cross(a, b)), a @ b)


_BASE = {
    "x": Signal(lambda v: v.state.r[v.base, 0], "m", "base, x"),
    "y": Signal(lambda v: v.state.r[v.base, 1], "m", "base, y"),
    "z": Signal(lambda v: v.state.r[v.base, 2], "m", "base, height"),
    "distance": Signal(lambda v: safe_norm(v.state.r[v.base]), "m", "base, distance from the origin"),
    "speed": Signal(lambda v: safe_norm(v.state.v[v.base]), "m/s", "base, speed"),
    "spin": Signal(lambda v: safe_norm(v.state.omega[v.base]), "rad/s", "base, angular velocity"),
    "tilt": Signal(lambda v: angle_between(v.R_wb[:, 2], v.up), "rad", "base, tilt"),
}  # fmt: skip
_PANEL = {
    "phi": Signal(lambda v: v.angles[0], "rad", "panel, phi in the base"),
    "theta": Signal(lambda v: v.angles[1], "rad", "panel, theta in the base"),
    "panel_tilt": Signal(lambda v: angle_between(v.normal_w, v.up), "rad", "panel, tilt"),
    "pointing": Signal(lambda v: angle_between(v.normal_w, v.direction), "rad", "panel, pointing error"),
    "panel_spin": Signal(
        lambda v: safe_norm(v.state.omega[v.system.index(PANEL)]), "rad/s", "panel, angular velocity"
    ),
    "stroke_2": Signal(lambda v: v.stroke("slider_2"), "m", "slider 2, stroke"),
    "stroke_3": Signal(lambda v: v.stroke("slider_3"), "m", "slider 3, stroke"),
}  # fmt: skip
_ANY = {
    "energy": Signal(lambda v: energy(v.system, v.state, v.t).total, "J", "energy"),
    "kinetic": Signal(lambda v: energy(v.system, v.state, v.t).kinetic, "J", "kinetic energy"),
}


def list_signals(system: System) -> dict[str, Signal]:
    """Signals of a system, by name."""
    result = dict(_ANY)
    for name, output in joint_outputs(system).items():
        value = lambda v, output=output: output.of(v.system, v.state)
        result[name] = Signal(value, output.unit, output.label)
    if system.floating:
        result |= _BASE
    if PANEL in system.names:
        result |= _PANEL
    for k, joint in enumerate(system.joints):
        for kind, unit in (("force", "N"), ("moment", "N m")):
            # A reaction depends on accelerations, whose rate would be a third derivative: its extremes are
            # found by samples.
            norm = lambda v, kind=kind, k=k: safe_norm(getattr(v.reactions, kind)[k])
            label = f"joint {joint.name}, reaction {kind}"
            result[f"{kind}.{joint.name}"] = Signal(norm, unit, label, smooth=False)
    return result


def find_signal(system: System, name: str) -> Signal:
    """Signal of a system by its name.

    Raises:
        SettingError: the system has no such signal.
    """
    signals = list_signals(system)
    if name not in signals:
        raise SettingError(
            f"There is no signal {quote_name(name)}.{nearest_names(name[:SHOWN], signals)}"
        )
    return signals[name]
