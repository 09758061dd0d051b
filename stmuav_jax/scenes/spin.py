"""Scene `spin`: a body on a ball joint, spun by a constant moment (report Part I, section 4.3).

The closed-form solution, Eq. 4.28, is phi = n t^2 / (2 J_zz), p = (cos phi/2, 0, 0, sin phi/2).
It holds where the ball joint lies on the body's zeta axis and there is no gravity.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.numbers import as_numpy, floats
from ..dynamics.scene import Scene
from ..mechanics.body import GROUND, Body
from ..mechanics.forces.applied import AppliedMoment
from ..mechanics.joint import spherical
from ..mechanics.system import System
from ..parameters.airframe import PART_I
from ..parameters.table import Parameters


def spin(parameters: Parameters = PART_I) -> Scene:
    """Scene of the report's verification problem, 5 s long."""
    ball = as_numpy(floats(parameters.value("spin.joint")))
    body = Body(
        "top", parameters.value("spin.mass"), parameters.value("spin.inertia"), position=-ball
    )
    moment = np.array([0.0, 0.0, 1.0]) * as_numpy(floats(parameters.value("spin.moment")))
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
        parameters=_only(parameters, "spin."),
        notes=("J_xx, J_yy, mass and the ball's place on the axis are chosen: they drop out.",),
        watch=("top",),
    )


def spin_exact(t: Float[Array, ""], parameters: Parameters = PART_I) -> Float[Array, "4"]:
    """Euler parameters of the closed-form solution at t [s], shape (4,). Source: Eq. 4.28."""
    inertia = jnp.asarray(parameters.value("spin.inertia"), dtype=float)[2]
    half = 0.25 * parameters.value("spin.moment") / inertia * t**2
    zero = jnp.zeros_like(half)
    return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])


def _only(parameters: Parameters, prefix: str) -> dict[str, dict[str, object]]:
    return {k: v for k, v in parameters.to_dict().items() if k.startswith(prefix)}
