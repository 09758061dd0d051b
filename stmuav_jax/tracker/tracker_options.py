"""Options of scenes with the tracker: what holds or moves its sliders, and its panel's start.

Servos, end stops and friction are forces; strokes that are prescribed are drivers. Numbers left
out are those of the scene's parameter table ("servo.", "stop.", "friction."); numbers given go
into the table that is kept with the results. A stroke is the slider's displacement along its
joint's z axis from the initial posture, where it is zero. `drive.py` builds them; the command
line reads this module without JAX.
"""

from collections.abc import Callable
from dataclasses import dataclass

from ..checks.quantity import Numbers, quantity

Target = Numbers | Callable[..., object]


@dataclass(frozen=True)
class Servo:
    """Position servo in each slider joint, beside the forces that a scene has anyway.

    Attributes:
        stiffness: [N/m]. damping: [N s/m].
        targets: strokes to hold for sliders 2 and 3, numbers [m] or functions of t [s];
            by default the initial ones.
    """

    stiffness: Numbers | None = quantity("stiffness", "N/m")
    damping: Numbers | None = quantity("damping", "N s/m")
    targets: tuple[Target, Target] = quantity(
        "strokes to hold, of sliders 2 and 3", "m", 2, default=(0.0, 0.0)
    )


@dataclass(frozen=True)
class Stops:
    """End stops of both sliders' strokes.

    Attributes:
        lower, upper: strokes [m], one for both sliders or one for each.
        stiffness: [N/m]. damping: [N s/m]. width: of the smoothing [m].
    """

    lower: Numbers | None = quantity("lowest stroke, of both sliders or of each", "m", 1, 2)
    upper: Numbers | None = quantity("highest stroke, of both sliders or of each", "m", 1, 2)
    stiffness: Numbers | None = quantity("stiffness", "N/m")
    damping: Numbers | None = quantity("damping", "N s/m")
    width: Numbers | None = quantity("width of the smoothing", "m")


@dataclass(frozen=True)
class Friction:
    """Friction in each slider joint.

    Attributes:
        coulomb: [N]. viscous: [N s/m]. speed: of the smoothing [m/s].
    """

    coulomb: Numbers | None = quantity("Coulomb's part", "N")
    viscous: Numbers | None = quantity("viscous part", "N s/m")
    speed: Numbers | None = quantity("speed of the smoothing", "m/s")


@dataclass(frozen=True)
class Strokes:
    """Prescribed strokes of both sliders, which rise smoothly from zero.

    Attributes:
        to: strokes at the end, of sliders 2 and 3 (2,) [m]. duration: of the rise [s].
    """

    to: Numbers = quantity("strokes at the end, of sliders 2 and 3", "m", 2, default=(0.0, 0.0))
    duration: Numbers = quantity("duration of the rise", "s", default=1.0)


@dataclass(frozen=True)
class PanelStart:
    """Start of the tracker's panel; numbers left out are the initial posture's, at rest.

    Attributes:
        phi, theta: panel angles [rad]. phi_rate, theta_rate: theirs [rad/s].
    """

    phi: Numbers | None = quantity("first panel angle", "rad")
    theta: Numbers | None = quantity("second panel angle", "rad")
    phi_rate: Numbers = quantity("rate of the first panel angle", "rad/s", default=0.0)
    theta_rate: Numbers = quantity("rate of the second panel angle", "rad/s", default=0.0)
