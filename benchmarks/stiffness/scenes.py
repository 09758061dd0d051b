"""Scenes of the stiff benchmark: the seven-body UAV with its sliders held in several ways.

All scenes hold the same force elements and differ in numbers only, so that one compilation per
solver serves them all: a servo that is not there has no stiffness and no damping, friction that
is not there no force, and end stops that are not there are 100 m away. Every scene therefore pays
for all elements, in every solver alike.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import stmuav_jax as stm

FAR = 100.0  # m


@dataclass(frozen=True)
class StiffScene:
    """What holds the sliders: servo stiffness [N/m] and damping [N s/m], stops, friction."""

    name: str
    stiffness: float = 0.0
    damping: float = 0.0
    stops: bool = False
    friction: bool = False

    def uav(self) -> stm.Scene:
        """uav_tracker, case 2."""
        away = stm.tracker.Stops() if self.stops else stm.tracker.Stops(lower=-FAR, upper=FAR)
        rubbing = stm.tracker.Friction() if self.friction else stm.tracker.Friction(coulomb=0.0)
        servo = stm.tracker.Servo(self.stiffness, self.damping)
        return stm.make_scene("uav_tracker", 2, servo=servo, stops=away, friction=rubbing)

    def slider(self) -> stm.Scene:
        """One body on a guide with a servo: a stand-in for the smoke test."""
        body = stm.Body("slider", 1.0, (1e-2, 1e-2, 1e-2))
        guide = stm.translational("guide", "ground", "slider", axis=(0.0, 0.0, 1.0))
        servo = stm.mechanics.JointServo(
            "guide", stiffness=self.stiffness, damping=self.damping, target=1e-3
        )
        system = stm.System([body], [guide], [stm.Gravity(), servo])
        return stm.Scene(self.name, "A slider with a servo", system, system.reference)


FREE = StiffScene("free")
SERVOS = tuple(StiffScene(f"servo {k:.0e}", k, 9e-4 * k) for k in (1e4, 1e5, 1e6, 1e7))
STIFFEST = StiffScene("stiffest servo", 1e7, 6e4)
STOPS = replace(FREE, name="end stops", stops=True)
FRICTION = replace(FREE, name="friction", friction=True)
SCENES = (FREE, *SERVOS, STIFFEST, STOPS, FRICTION)

Build = Callable[[StiffScene], stm.Scene]
