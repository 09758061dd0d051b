"""Scene `spin`: a body on a ball joint, spun by a constant moment (report Part I, section 4.3).

The closed-form solution, Eq. 4.28, is phi = n t^2 / (2 J_zz), p = (cos phi/2, 0, 0, sin phi/2).
It holds where the ball joint lies on the body's zeta axis and there is no gravity.
"""

import numpy as np

from ...checks.numbers import as_floats, as_numpy
from ...dynamics.simulation import Scene
from ...mechanics.body import GROUND, Body
from ...mechanics.forces import AppliedMoment
from ...mechanics.joint import spherical
from ...mechanics.parameters import Parameters
from ...mechanics.system import System
from ..airframe import PART_I


def spin(parameters: Parameters = PART_I) -> Scene:
    """Scene of the report's verification problem, 5 s long."""
    ball = as_numpy(as_floats(parameters.value("spin.joint")))
    body = Body(
        "top", parameters.value("spin.mass"), parameters.value("spin.inertia"), position=-ball
    )
    moment = np.array([0.0, 0.0, 1.0]) * as_numpy(as_floats(parameters.value("spin.moment")))
    system = System(
        [body],
        [spherical("ball", GROUND, "top", point=(0.0, 0.0, 0.0))],
        [AppliedMoment("top", moment, frame="body")],
    )
    return Scene(
        name="spin",
        title="A body on a ball joint, spun by a constant moment",
        system=system,
        state0=system.reference,
        t1=5.0,
        save_every=0.01,
        parameters={k: v for k, v in parameters.to_dict().items() if k.startswith("spin.")},
        notes=("J_xx, J_yy, mass and the ball's place on the axis are chosen: they drop out.",),
        watch=("top",),
    )
