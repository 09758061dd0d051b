"""Outputs of a mechanism by name: the coordinates of its joints and their rates.

`A.angle` is the angle of the joint A [rad], in (-pi, pi] except that of a screw, `A.angle_rate` its
rate; `A.displacement` and `A.displacement_rate` likewise [m], [m/s]. States of a `TreeSpace` have the
same names.
"""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Float

from ..checks.errors import SettingError, nearest_names
from ..mechanics.joint import Which
from ..mechanics.joint_coordinate import coordinate, free_coordinates
from ..mechanics.state import State
from ..mechanics.system import System


class Output(NamedTuple):
    """Scalar output of a mechanism: a function of (system, state), with its unit and words."""

    of: Callable[[System, State], Float[Array, ""]]
    unit: str
    words: str


def joint_outputs(system: System) -> dict[str, Output]:
    """Coordinates of all joints that leave an angle or a displacement free, and their rates, by name."""
    found: dict[str, Output] = {}
    for joint in system.joints:
        for which in free_coordinates(joint):
            unit = "rad" if which == "angle" else "m"
            name = f"{joint.name}.{which}"
            words = f"joint {joint.name}, {which}"
            found[name] = Output(_read(joint.name, which, "value"), unit, words)
            rate = _read(joint.name, which, "rate")
            found[f"{name}_rate"] = Output(rate, f"{unit}/s", f"{words}, rate")
    return found


def joint_output(system: System, name: str) -> Output:
    """Output of a system by its name; raises `SettingError` for an unknown one."""
    known = joint_outputs(system)
    if name not in known:
        raise SettingError(f"There is no output '{name[:80]}'.{nearest_names(name[:80], known)}")
    return known[name]


def _read(joint: str, which: Which, field: str) -> Callable[[System, State], Float[Array, ""]]:
    def of(system: System, state: State) -> Float[Array, ""]:
        kin = system.kinematics(state)
        return getattr(coordinate(kin, kin.joint(joint), which), field)

    return of
