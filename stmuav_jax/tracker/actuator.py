"""Linear actuators that push the tracker's sliders along the base's z axis."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..checks.numbers import floats
from ..checks.shapes import Numbers
from ..mechanics.load import AbstractForce, ActsOn, Load, Signal, evaluate, push, signal
from ..mechanics.state import Kinematics


class LinearActuator(AbstractForce):
    """Force u between a base and a slider, along the base's z axis through one point.

    The slider gets +u, the base -u, both on the line through `axis_point`, so that the pair
    conserves momentum. `couple="printed"` follows the report: the slider's force acts at its
    centre of mass without a moment, which adds a net couple of about 8 mN m per newton.

    Args:
        base, slider: names of the bodies.
        axis_point: point of the actuator's axis in the base's reference frame (3,) [m].
        force: u [N], or a function of (t, kinematics).
        couple: "consistent" or "printed".

    Source: report Part II, Eq. 4.25 and 4.26; the slider's moment is added here.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("force", "N"),)
    base: str = eqx.field(static=True)
    slider: str = eqx.field(static=True)
    axis_point: Float[Array, "3"]
    force: Signal
    couple: str = eqx.field(static=True)

    def __init__(
        self,
        base: str,
        slider: str,
        *,
        axis_point: Numbers,
        force: Numbers | Callable[..., object],
        couple: str = "consistent",
    ) -> None:
        if couple not in ("consistent", "printed"):
            raise SettingError(
                f"The actuators' couple must be 'consistent' or 'printed', not '{couple}'."
            )
        self.base, self.slider, self.couple = base, slider, couple
        self.axis_point = floats(axis_point)
        self.force = signal(force, f"The actuator force on body '{slider}'", (), "N")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.base, self.slider))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        what = f"LinearActuator: the force on body '{self.slider}'"
        u = evaluate(self.force, t, kin, what, ())
        base, slider = kin.index(self.base), kin.index(self.slider)
        arm = kin.arm(self.base, self.axis_point)
        along = u * kin.R_wb[base][:, 2]
        on_base = push(kin, self.base, -along, arm)
        if self.couple == "printed":
            return on_base + push(kin, self.slider, u * kin.R_wb[slider][:, 2])
        return on_base + push(kin, self.slider, along, kin.r[base] + arm - kin.r[slider])
