"""State of a system of rigid bodies, and the kinematics of every body that follows from it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.errors import ModelError, nearest_names
from ..checks.shapes import Vec3
from ..math.rotation import cross, rotation_matrix
from ..math.stacked import apply_matrix
from .body import GROUND

if TYPE_CHECKING:
    from .joint import Joint


def find_place(name: str, names: Sequence[str], kind: str, subject: str = "There is no") -> int:
    """Place of the name of a body or joint among others.

    Raises:
        ModelError: an unknown name; the sentence is "SUBJECT KIND 'NAME'." and the nearest names.
    """
    if name not in names:
        raise ModelError(f"{subject} {kind} '{name}'.{nearest_names(name, names)}")
    return list(names).index(name)


class State(eqx.Module):
    """Positions and velocities of the n moving bodies of a system.

    Attributes:
        r: centres of mass in the world (..., n, 3) [m].
        p: Euler parameters, body to world (..., n, 4).
        v: velocities of the centres of mass in the world (..., n, 3) [m/s].
        omega: angular velocities in body axes (..., n, 3) [rad/s].
    """

    r: Float[Array, "*batch n 3"]
    p: Float[Array, "*batch n 4"]
    v: Float[Array, "*batch n 3"]
    omega: Float[Array, "*batch n 3"]

    @property
    def n_bodies(self) -> int:
        """Number of moving bodies."""
        return self.r.shape[-2]


class Kinematics(eqx.Module):
    """Kinematics of every body at one state, with ground as the last row.

    Attributes:
        r, v: centres of mass and their velocities, world (n + 1, 3) [m], [m/s].
        R_wb: body-to-world rotations (n + 1, 3, 3).
        omega: angular velocities in body axes (n + 1, 3) [rad/s].
        omega_w: angular velocities in world axes (n + 1, 3) [rad/s].
        mass: masses (n + 1,) [kg], zero for ground.
        com: centres of mass in the bodies' reference frames (n + 1, 3) [m].
        names: names of the bodies, "ground" last.
        joints: joints of the system, for forces that act in one.
    """

    r: Float[Array, "N 3"]
    v: Float[Array, "N 3"]
    omega: Float[Array, "N 3"]
    R_wb: Float[Array, "N 3 3"]
    omega_w: Float[Array, "N 3"]
    mass: Float[Array, " N"]
    com: Float[Array, "N 3"]
    names: tuple[str, ...] = eqx.field(static=True)
    joints: "tuple[Joint, ...]"

    def index(self, name: str) -> int:
        """Row of the named body; raises `ModelError` for an unknown name."""
        return find_place(name, self.names, "body")

    def joint(self, name: str) -> "Joint":
        """Joint of this name; raises `ModelError` for an unknown name."""
        return self.joints[find_place(name, [joint.name for joint in self.joints], "joint")]

    def arm(self, name: str, point: Vec3) -> Vec3:
        """World vector from the centre of mass to a point of the body's reference frame [m]."""
        k = self.index(name)
        return apply_matrix(self.R_wb[k], point - self.com[k])

    def point(self, name: str, point: Vec3) -> tuple[Vec3, Vec3]:
        """World position [m] and velocity [m/s] of a point of the body's reference frame."""
        k = self.index(name)
        s = self.arm(name, point)
        return self.r[k] + s, self.v[k] + cross(self.omega_w[k], s)


def compute_kinematics(
    state: State,
    *,
    mass: Float[Array, " n"],
    com: Float[Array, "n 3"],
    names: tuple[str, ...],
    joints: "tuple[Joint, ...]",
) -> Kinematics:
    """Kinematics of all bodies and of ground for one (unbatched) state."""
    zero = jnp.zeros((1, 3), state.r.dtype)
    unit = jnp.array([[1.0, 0.0, 0.0, 0.0]], state.p.dtype)
    p = jnp.concatenate([state.p, unit])
    omega = jnp.concatenate([state.omega, zero])
    R_wb = jax.vmap(rotation_matrix)(p)
    return Kinematics(
        r=jnp.concatenate([state.r, zero]),
        v=jnp.concatenate([state.v, zero]),
        omega=omega,
        R_wb=R_wb,
        omega_w=jnp.sum(R_wb * omega[:, None], axis=2),
        mass=jnp.concatenate([mass, jnp.zeros(1, mass.dtype)]),
        com=jnp.concatenate([com, zero]),
        names=(*names, GROUND),
        joints=joints,
    )
