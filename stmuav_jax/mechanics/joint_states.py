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

from ..algebra import lapack
from ..algebra.rotation import (
    cross,
    from_matrix,
    from_rotation_vector,
    product,
    rotation_matrix,
)
from ..algebra.stacked import apply_transposed, multiply
from ..checks.errors import ModelError, SettingError
from ..checks.shapes import Numbers
from .joint import CATALOGUE, Joint
from .joint_coordinate import coordinate
from .joint_kind import Freedom, Z
from .motions.axial import PRISMATIC, REVOLUTE
from .motions.base import AbstractRelativeMotion, ColumnParts, RelativeFrames, RelativePose
from .motions.sequence import frame_columns, references
from .state import Kinematics, State
from .system import System, check_state

_DRIVERS = {"drive_angle": REVOLUTE.coordinates, "drive_displacement": PRISMATIC.coordinates}


def coordinates_of(kind: str) -> tuple[tuple[str, str], ...]:
    """Names and units of the coordinates that a kind of joint leaves free, in their order."""
    motions = CATALOGUE[kind].motion or ()
    own = ((name + f.place, unit) for f in motions for name, unit in f.motion.coordinates)
    return _DRIVERS[kind] if kind in _DRIVERS else tuple(own)


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
        names = [found for found, _ in coordinates_of(self.kind)]
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
    count = len(coordinates_of(joint.kind))
    if not count:
        have = (kind for kind in CATALOGUE if coordinates_of(kind))
        raise ModelError(
            f"Joint '{joint.name}' is a {joint.kind} joint, which has no joint coordinates; these "
            f"have: {', '.join(have)}."
        )
    return count


def relative(kin: Kinematics, joint: Joint) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Coordinates and rates of a joint at one state; angles in (-pi, pi] except those of screws."""
    motions = CATALOGUE[joint.kind].motion or ()
    if any(axis != Z or len(motion.columns) > 1 for motion, axis, _ in motions):
        return _of_motions(kin, joint, motions)
    names = [motion.coordinates[0][0] for motion, *_ in motions] or [
        coordinates_of(joint.kind)[0][0]
    ]
    found = [coordinate(kin, joint, which) for which in names]  # pyright: ignore[reportArgumentType]
    return jnp.stack([c.value for c in found]), jnp.stack([c.rate for c in found])


def _of_motions(
    kin: Kinematics, joint: Joint, motions: tuple[Freedom, ...]
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Coordinates and rates of any sequence of motions, read one after the other."""
    i, j = kin.index(joint.body_i), kin.index(joint.body_j)
    F_i, F_j = multiply(kin.R_wb[i], joint.frame_i), multiply(kin.R_wb[j], joint.frame_j)
    (a, a_rate), (b, b_rate) = (
        kin.point(joint.body_i, joint.point_i),
        kin.point(joint.body_j, joint.point_j),
    )
    R, d = multiply(F_i.T, F_j), apply_transposed(F_i, b - a)
    behind, zero = references([f[:2] for f in motions], f"Joint '{joint.name}'")
    last = frame_columns(motions[-1].axis)
    E, o, found = jnp.eye(3, dtype=R.dtype), jnp.zeros_like(d), []
    for n, (motion, axis, _) in enumerate(motions):
        own = frame_columns(axis)
        G = E @ own
        seen = RelativeFrames(
            (G.T @ R @ last)[..., None],
            behind[:, [n]],
            zero[:, [n]],
            (G.T @ (d - o))[:, None],
            lambda G=G, own=own: from_matrix(G.T @ R @ own)[:, None],
        )
        q, X, along = motion.read(seen, _parts(joint, motion))
        at_zero = jnp.zeros_like(q).at[0].set(1.0) if motion.unit_norm else jnp.zeros_like(q)
        found.append(motion.difference(q, at_zero).reshape(-1))
        E, o = G @ X[..., 0] @ own.T, o + G @ along[:, 0]
    x = jnp.concatenate(found)
    twist = [kin.omega_w[j] - kin.omega_w[i], b_rate - a_rate - cross(kin.omega_w[i], b - a)]
    motion_of = lambda rate: jnp.concatenate(relative_pose(joint, x, rate)[2:])
    S = jax.vmap(motion_of, out_axes=1)(jnp.eye(len(x), dtype=x.dtype))
    seen_twist = jnp.concatenate([apply_transposed(F_i, part) for part in twist])
    return x, lapack.solve(S.T @ S, S.T @ seen_twist)


def _parts(joint: Joint, motion: AbstractRelativeMotion) -> ColumnParts:
    """Columns of one motion of a joint, as `AbstractRelativeMotion.read` takes them."""
    shape = (*motion.velocities, 1)
    angular = np.array([c.angular for c in motion.columns]).reshape(shape)
    pitched = np.array([float(c.linear is None) for c in motion.columns]).reshape(shape)
    linear = np.array([c.linear or 0.0 for c in motion.columns]).reshape(shape)
    return ColumnParts(
        angular, linear + pitched * joint.length if joint.pitched else linear, pitched
    )


def relative_pose(joint: Joint, q: Float[Array, " c"], u: Float[Array, " c"]) -> RelativePose:
    """Pose of frame j in frame i from a joint's coordinates and rates; a weld has no motion."""
    zero = jnp.zeros(3, q.dtype)
    found = RelativePose(from_rotation_vector(zero), zero, zero, zero)
    start = 0
    for number, freedom in enumerate(CATALOGUE[joint.kind].motion or ()):
        own = slice(start, start + len(freedom.motion.coordinates))
        step = freedom.motion.pose(q[own], u[own], freedom.axis, joint.length)
        found, start = step if number == 0 else _after(found, step), own.stop
    return found


def _after(first: RelativePose, then: RelativePose) -> RelativePose:
    """Pose of the child frame of two successive motions in the parent frame of the first."""
    R = rotation_matrix(first.p)
    d = R @ then.d
    return RelativePose(
        product(first.p, then.p),
        first.d + d,
        first.w + R @ then.w,
        first.v + R @ then.v + cross(first.w, d),
    )


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
    if joint.pitched:
        return values, rates
    # a rotation vector is the shortest one
    vectors = sum(3 * f.motion.unit_norm for f in CATALOGUE[joint.kind].motion or ())
    turns = np.array([unit == "rad" for _, unit in coordinates_of(joint.kind)])
    turns[len(turns) - vectors :] = False
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
