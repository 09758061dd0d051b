"""Rigid bodies: mass, centre of mass, inertia tensor, and where they stand at first."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..algebra.shapes import Numbers
from .errors import ModelError, check_finite, check_shape, concrete

GROUND = "ground"

# |p| may differ from 1 by this much in what a user gives; beyond it the user has to decide.
UNIT_TOLERANCE = 1e-9

# Relative slack of the two exact physical checks, for round-off in rotated tensors.
_ROUND_OFF = 1e-12

# A principal moment below this part of the largest is zero to round-off.
_SINGULAR = 1e-15


class Body(eqx.Module):
    """One rigid body, as the user describes it.

    Args:
        name: how joints and forces refer to it.
        mass: [kg].
        inertia: inertia tensor about the centre of mass in body axes, (3, 3) or its
            diagonal (3,) [kg m^2]; off-diagonal entries are -int xy dm. Where JAX traces it,
            its numbers cannot be looked at, and its symmetric part is what counts: the
            derivative with respect to one of two opposite entries is then half of that with
            respect to both.
        com: centre of mass in the body's reference frame (3,) [m].
        position: origin of the body's reference frame in the world, at the reference
            posture (3,) [m]; with `com` zero it is the centre of mass.
        orientation: unit Euler parameters of the reference posture (4,).
        free: the body, and what is joined to it, may float; without it a body that no
            chain of joints ties to ground is an error.
        triangle_tolerance: relative excess of the largest principal moment over the sum of
            the other two that is admitted (for printed, rounded tensors); default none.

    Raises:
        ModelError: a mass that is not finite and positive; a tensor that is not finite,
            symmetric, positive definite, or that no mass distribution can have; Euler
            parameters that are not unit. The message names the body.
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
        self.mass = jnp.asarray(mass, dtype=float)
        tensor = jnp.asarray(inertia, dtype=float)
        self.inertia = jnp.diag(tensor) if tensor.ndim == 1 else tensor
        if tensor.shape == (3, 3) and not concrete(tensor):
            self.inertia = 0.5 * (tensor + tensor.T)
        self.com = jnp.asarray(com, dtype=float)
        self.position = jnp.asarray(position, dtype=float)
        self.orientation = jnp.asarray(orientation, dtype=float)
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
    def com_position(self) -> Float[Array, "3"]:
        """World position of the centre of mass at the reference posture (3,) [m]."""
        return self.position + rotation_matrix(self.orientation) @ self.com


def check_mass(mass: Numbers, what: str) -> None:
    """Raise `ModelError` unless the mass [kg] is finite and positive."""
    if concrete(mass) and not (np.isfinite(mass) and float(mass) > 0):  # pyright: ignore
        raise ModelError(f"The mass of {what} must be finite and positive, but it is {mass} kg.")


def check_inertia(inertia: Numbers, what: str, tolerance: float) -> None:
    """Raise `ModelError` unless the tensor (3, 3) [kg m^2] is one that a rigid body can have."""
    if not concrete(inertia):
        return
    tensor = np.asarray(inertia, dtype=float)
    if not np.all(np.isfinite(tensor)):
        raise ModelError(
            f"The inertia tensor of {what} must be finite, but it is {tensor.tolist()}."
        )
    size = np.abs(tensor).max()
    if np.abs(tensor - tensor.T).max() > _ROUND_OFF * size:
        raise ModelError(
            f"The inertia tensor of {what} must be symmetric, but it is {tensor.tolist()}."
        )
    moments = np.linalg.eigvalsh(tensor)
    listed = ", ".join(f"{m:.6g}" for m in moments)
    if moments[0] <= _SINGULAR * moments[2]:
        raise ModelError(
            f"The inertia tensor of {what} must be positive definite, but its principal moments "
            f"are {listed} kg m^2.{_advice(moments)}"
        )
    excess = moments[2] / (moments[0] + moments[1]) - 1
    if excess > max(tolerance, _ROUND_OFF):
        raise ModelError(
            f"No body has the inertia tensor of {what}: its principal moments {listed} kg m^2 "
            f"break the triangle inequality, the largest exceeds the sum of the other two by "
            f"{100 * excess:.3g} %. Correct the entry, or admit a rounded table by "
            f"triangle_tolerance={excess * 1.01:.2g}."
        )


def _advice(moments: np.ndarray) -> str:
    """What a body with such principal moments (ascending) may have been meant to be."""
    size = np.abs(moments).max()
    if size == 0:
        return (
            " A point mass has no inertia to turn: give it that of a small sphere, 2 m r^2 / 5 "
            "(stmuav_jax.sphere); where nothing turns it, the value does not matter."
        )
    if abs(moments[0]) <= _SINGULAR * size and moments[1] > _SINGULAR * size:
        return (
            " A rod without thickness has no inertia about its own axis, so that nothing would "
            "resist a turn about it: give it the moment that its thickness gives, m r^2 / 2 for "
            "the radius r (stmuav_jax.cylinder); where joints keep it from that turn, the value does "
            "not matter."
        )
    return ""


def check_unit(p: Numbers, what: str, error: type[Exception]) -> None:
    """Raise `error` unless p (4,) is finite and |p| = 1 within `UNIT_TOLERANCE`."""
    if not concrete(p):
        return
    values = np.asarray(p, dtype=float)
    if not np.all(np.isfinite(values)):
        raise error(
            f"The Euler parameters of {what} must be finite, but they are {values.tolist()}."
        )
    norm = float(np.sqrt(values @ values))
    if abs(norm - 1) <= UNIT_TOLERANCE:
        return
    if norm == 0:
        raise error(f"The Euler parameters of {what} are all zero, which is no rotation at all.")
    raise error(
        f"The Euler parameters of {what} must have norm 1, but {values.tolist()} has norm "
        f"{norm:.6g}. If they are right up to scale, divide them by their norm "
        "(stmuav_jax.normalise); if they were printed with few digits, find the nearest posture "
        "that the joints allow with stmuav_jax.assemble."
    )


class Bodies(eqx.Module):
    """The moving bodies of a system, stacked: mass (n,), com (n, 3), inertia (n, 3, 3)."""

    names: tuple[str, ...] = eqx.field(static=True)
    mass: Float[Array, " n"]
    com: Float[Array, "n 3"]
    inertia: Float[Array, "n 3 3"]


def stack_bodies(bodies: tuple[Body, ...]) -> Bodies:
    """Stack user bodies into arrays, in their order."""
    return Bodies(
        names=tuple(b.name for b in bodies),
        mass=jnp.stack([b.mass for b in bodies]),
        com=jnp.stack([b.com for b in bodies]),
        inertia=jnp.stack([b.inertia for b in bodies]),
    )
