"""Scene of a user's own, `swing`: a rod that swings about a fixed axis."""

import stmuav_jax as stm
from stmuav_jax import PART_I
from stmuav_jax.mechanics import Parameters


def swing(parameters: Parameters = PART_I, *, length: float = 1.0) -> stm.Scene:
    """Scene of a rod hung from one end, 2 s long.

    Args:
        parameters: table; none of its numbers is used.
        length: length of the rod [m].
    """
    rod = stm.Body(
        "rod", 1.0, [length**2 / 12, 1e-3, length**2 / 12], position=[0.0, length / 2, 0.0]
    )
    hinge = stm.revolute("hinge", "ground", "rod", point=[0.0, 0.0, 0.0], axis=[1.0, 0.0, 0.0])
    system = stm.System([rod], [hinge], [stm.Gravity(), stm.JointEffort("hinge", 0.1)])
    return stm.Scene(
        name="swing",
        title="A rod swings",
        system=system,
        state0=system.reference,
        t1=2.0,
        save_every=0.02,
    )
