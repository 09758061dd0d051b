"""Coordinates and rates of any joint of the catalogue, computed from states of all bodies.

Coordinates are zero at the reference posture and give the rotation R of frame j in frame i:

    revolute        angle about z                              R = R_z(angle)
    screw           angle about z, with its whole turns        R = R_z(angle)
    translational   displacement along z
    cylindrical     displacement along z, angle about z
    universal       angle about axis_i, angle about axis_j     R = R_x(first) R_y(second)
    spherical       rotation vector in the axes of frame i     R = exp(vector~)

A driver has the coordinate that it prescribes. Rates of a spherical joint are the angular
velocity of body j relative to body i in the axes of frame i; all others are derivatives of
the coordinates.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import from_matrix, to_rotation_vector
from ..algebra.stacked import apply_transposed, dot, multiply
from ..checks.errors import ModelError, SettingError
from ..checks.shapes import Numbers
from .joint import CATALOGUE, Joint
from .joint_coordinate import coordinate
from .motions.axial import PRISMATIC, REVOLUTE
from .state import Kinematics, State
from .system import System, check_state

# Coordinates that each kind of joint leaves free, in their order, with units.
COORDINATES: dict[str, tuple[tuple[str, str], ...]] = {
    kind: tuple(
        (name + freedom.place, unit)
        for freedom in entry.motion
        for name, unit in freedom.motion.coordinates
    )
    for kind, entry in CATALOGUE.items()
    if entry.motion
} | {"drive_angle": REVOLUTE.coordinates, "drive_displacement": PRISMATIC.coordinates}


class JointMotion(eqx.Module):
    """Coordinates and rates of one joint, at one state or at every state of a run.

    Attributes:
        name, kind: name and kind of the joint.
        coordinates: (..., c) [rad] or [m], in the order of this module's table. Angles are
            continuous along a run; a rotation vector is the shortest one.
        rates: rates (..., c) [rad/s] or [m/s].
    """

    name: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    coordinates: Float[Array | np.ndarray, "*s c"]
    rates: Float[Array | np.ndarray, "*s c"]

    @property
    def angle(self) -> Float[Array | np.ndarray, "*s"]:
        """Angle about z from body i to body j (...,) [rad]; revolute, cylindrical, screw."""
        return self.coordinates[..., self._place("angle")]

    @property
    def angle_rate(self) -> Float[Array | np.ndarray, "*s"]:
        """Rate of `angle` (...,) [rad/s]."""
        return self.rates[..., self._place("angle")]

    @property
    def displacement(self) -> Float[Array | np.ndarray, "*s"]:
        """Displacement of j's point along z from i's (...,) [m]; translational and cylindrical."""
        return self.coordinates[..., self._place("displacement")]

    @property
    def displacement_rate(self) -> Float[Array | np.ndarray, "*s"]:
        """Rate of `displacement` (...,) [m/s]."""
        return self.rates[..., self._place("displacement")]

    def _place(self, name: str) -> int:
        names = [found for found, _ in COORDINATES[self.kind]]
        if name not in names:
            raise ModelError(
                f"Joint '{self.name}' is {self.kind} and has no {name} of its own; its coordinates "
                f"are: {', '.join(names)} (in this order in `coordinates`)."
            )
        return names.index(name)


def joint_motion(
    system: System, states: State, name: str, ts: Numbers | None = None
) -> JointMotion:
    """Coordinates and rates of a joint at one state or along a series of states.

    The function is differentiable and may be jitted. With a first axis of time, angles are
    continued from one state to the next, from (-pi, pi] at the first: without `ts` a joint must
    turn by less than half a turn between two states; with `ts` this holds for the difference to the
    turn predicted by its rates, so that fast rotors may be saved rarely.

    Args:
        states: states at one time (n, .), or at k times (k, n, .), that satisfy the joints.
        name: name of the joint. ts: times (k,) [s].

    Raises:
        ModelError: the joint is unknown or has none of these coordinates.
        SettingError: the states do not fit the system, or the times do not fit the states.
    """
    joint = system.joints[system.joint_index(name)]
    coordinate_count(joint)
    states = jax.tree.map(jnp.asarray, states)  # those of a run are NumPy arrays
    check_state(system, states)
    if states.r.ndim == 2:
        return JointMotion(joint.name, joint.kind, *_read(system, states, joint))
    if states.r.ndim != 3:
        raise SettingError(
            f"States along a run have shape (k, n, .), but State.r has shape {states.r.shape}: use "
            "jax.vmap for further axes."
        )
    times = None if ts is None else jnp.asarray(ts, dtype=float)
    if times is not None and times.shape != states.r.shape[:1]:
        raise SettingError(
            f"There are {states.r.shape[0]} states, but the times have shape {times.shape}."
        )
    return JointMotion(joint.name, joint.kind, *_along(system, states, joint, times))


def coordinate_count(joint: Joint) -> int:
    """Number of coordinates of a joint; raises `ModelError` for a joint without any."""
    if joint.kind not in COORDINATES:
        raise ModelError(
            f"Joint '{joint.name}' is a {joint.kind} joint, which has no joint coordinates; these "
            f"have: {', '.join(COORDINATES)}."
        )
    return len(COORDINATES[joint.kind])


def relative(kin: Kinematics, joint: Joint) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Coordinates and rates of a joint at one state; angles in (-pi, pi] except those of screws."""
    if joint.kind in ("universal", "spherical"):
        return _of_axes(kin, joint)
    found = [coordinate(kin, joint, which) for which, _ in COORDINATES[joint.kind]]  # pyright: ignore[reportArgumentType]
    return jnp.stack([c.value for c in found]), jnp.stack([c.rate for c in found])


def _of_axes(kin: Kinematics, joint: Joint) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    i, j = kin.index(joint.body_i), kin.index(joint.body_j)
    F_i, F_j = multiply(kin.R_wb[i], joint.frame_i), multiply(kin.R_wb[j], joint.frame_j)
    turning = kin.omega_w[j] - kin.omega_w[i]
    R = multiply(F_i.T, F_j)
    if joint.kind == "spherical":
        return to_rotation_vector(from_matrix(R)), apply_transposed(F_i, turning)
    angles = jnp.stack([jnp.arctan2(R[2, 1], R[1, 1]), jnp.arctan2(R[0, 2], R[0, 0])])
    return angles, jnp.stack([dot(F_i[:, 0], turning), dot(F_j[:, 1], turning)])


@eqx.filter_jit
def _read(
    system: System, state: State, joint: Joint
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    return relative(system.kinematics(state), joint)


@eqx.filter_jit
def _along(
    system: System, states: State, joint: Joint, ts: Float[Array, " k"] | None
) -> tuple[Float[Array, "k c"], Float[Array, "k c"]]:
    values, rates = jax.vmap(lambda state: relative(system.kinematics(state), joint))(states)
    if joint.kind == "spherical" or joint.pitched:
        return values, rates
    turns = np.array([unit == "rad" for _, unit in COORDINATES[joint.kind]])
    return jnp.where(turns, _unwrapped(values, rates, ts), values), rates


def _unwrapped(
    values: Float[Array, "k c"], rates: Float[Array, "k c"], ts: Float[Array, " k"] | None
) -> Float[Array, "k c"]:
    """Angles made continuous by multiples of whole turns."""
    steps = jnp.diff(values, axis=0)
    if ts is not None:
        steps = steps - 0.5 * jnp.diff(ts)[:, None] * (rates[1:] + rates[:-1])
    turns = jnp.cumsum(jnp.round(steps / (2 * jnp.pi)), axis=0)
    return values.at[1:].add(-2 * jnp.pi * turns)
