"""Rigid bodies: mass, centre of mass, inertia tensor, and pose at the reference posture."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix_in
from ..checks.errors import ModelError, check_finite, check_shape, concrete
from ..checks.numbers import array_module, as_numpy, floats, stacked
from ..checks.physical import check_inertia, check_mass, check_unit
from ..checks.shapes import Numbers

GROUND = "ground"


class Body(eqx.Module):
    """One rigid body, as the user describes it.

    Args:
        name: name by which joints and forces refer to the body.
        mass: mass [kg].
        inertia: inertia tensor about the centre of mass in body axes, (3, 3) or its
            diagonal (3,) [kg m^2]; off-diagonal entries are -int xy dm. A traced tensor is not
            checked, and its symmetric part counts: the derivative with respect to one of two
            opposite entries is then half of that with respect to both.
        com: centre of mass in the body's reference frame (3,) [m].
        position: origin of the body's reference frame in the world, at the reference
            posture (3,) [m]; with `com` zero it is the centre of mass.
        orientation: unit Euler parameters of the reference posture (4,).
        free: permission for the body and all bodies joined to it to float; without it a body that
            no chain of joints connects to ground is an error.
        triangle_tolerance: admitted relative excess of the largest principal moment over the sum
            of the other two, for printed, rounded tensors; zero by default.

    Raises:
        ModelError: the mass is not finite and positive; the tensor is not finite, symmetric or
            positive definite, or no mass distribution can have it; the Euler parameters are not
            unit. The message names the body.
    """

    name: str = eqx.field(static=True)
    mass: Float[Array, ""]
    inertia: Float[Array, "3 3"]
    com: Float[Array, "3"]
    position: Float[Array, "3"]
    orientation: Float[Array, "4"]
    free: bool = eqx.field(static=True)
    triangle_tolerance: float = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        mass: Numbers,
        inertia: Numbers,
        *,
        com: Numbers = (0.0, 0.0, 0.0),
        position: Numbers = (0.0, 0.0, 0.0),
        orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
        free: bool = False,
        triangle_tolerance: float = 0.0,
    ) -> None:
        self.name = name
        self.free = free
        self.triangle_tolerance = triangle_tolerance
        self.mass = floats(mass)
        tensor = floats(inertia)
        if tensor.ndim == 1:
            tensor = floats(array_module(tensor).diag(tensor))
        self.inertia = tensor
        if tensor.shape == (3, 3) and not concrete(tensor):
            self.inertia = 0.5 * (tensor + tensor.T)
        self.com = floats(com)
        self.position = floats(position)
        self.orientation = floats(orientation)
        if not name or name == GROUND:
            raise ModelError(f"A body cannot be named '{name}': '{GROUND}' is the fixed world.")
        check_shape(self.mass, (), f"The mass of body '{name}'")
        check_shape(self.inertia, (3, 3), f"The inertia tensor of body '{name}'")
        check_shape(self.com, (3,), f"The centre of mass of body '{name}'")
        check_shape(self.position, (3,), f"The position of body '{name}'")
        check_shape(self.orientation, (4,), f"The Euler parameters of body '{name}'")
        check_mass(self.mass, f"body '{name}'")
        check_inertia(self.inertia, f"body '{name}'", triangle_tolerance)
        check_finite(self.com, f"The centre of mass of body '{name}'", "m")
        check_finite(self.position, f"The position of body '{name}'", "m")
        check_unit(self.orientation, f"body '{name}'", ModelError)

    @property
    def com_position(self) -> Float[Array | np.ndarray, "3"]:
        """World position of the centre of mass at the reference posture (3,) [m]."""
        position, p, com = as_numpy((self.position, self.orientation, self.com))
        return position + rotation_matrix_in(array_module(p, position, com), p) @ com


class Bodies(eqx.Module):
    """Moving bodies of a system, stacked: mass (n,), com (n, 3), inertia (n, 3, 3)."""

    names: tuple[str, ...] = eqx.field(static=True)
    mass: Float[Array, " n"]
    com: Float[Array, "n 3"]
    inertia: Float[Array, "n 3 3"]


def stack_bodies(bodies: tuple[Body, ...]) -> Bodies:
    """Stack a user's bodies into arrays, in their order."""
    return Bodies(
        names=tuple(b.name for b in bodies),
        mass=stacked([b.mass for b in bodies]),
        com=stacked([b.com for b in bodies]),
        inertia=stacked([b.inertia for b in bodies]),
    )
