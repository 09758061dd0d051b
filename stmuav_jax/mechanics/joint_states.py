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

from ..checks.errors import ModelError, SettingError
from ..checks.shapes import Numbers, Scalar, Vec3
from ..math import lapack
from ..math.rotation import cross, from_matrix, from_rotation_vector, product, rotation_matrix
from ..math.stacked import apply_matrix, apply_transposed, dot_product, multiply_matrices
from .joint import CATALOGUE, Freedom, Joint, Which, Z
from .load import Load, couple_load, push
from .motions import (
    PRISMATIC,
    REVOLUTE,
    AbstractRelativeMotion,
    ColumnParts,
    RelativeFrames,
    RelativePose,
    frame_columns,
    reference_directions,
    whole_turns,
)
from .state import Kinematics, State
from .system import System, check_state


class JointCoordinate(eqx.Module):
    """Angle or displacement of a joint at one state.

    Attributes:
        kind: "angle" or "displacement". body_i, body_j: the joint's bodies.
        value: angle about z from body i to body j [rad], in (-pi, pi] except that of a screw, whose
            displacement determines the whole turns; or displacement of j's point along z from i's
            [m]. rate: its time derivative [rad/s] or [m/s].
        axis: z axis of the joint on body i, world (3,). point: j's point, world (3,) [m].
    """

    kind: Which = eqx.field(static=True)
    body_i: str = eqx.field(static=True)
    body_j: str = eqx.field(static=True)
    value: Scalar
    rate: Scalar
    axis: Vec3
    point: Vec3

    def load(self, kin: Kinematics, effort: Scalar) -> Load:
        """Load of an effort ([N m] or [N] on the coordinate) on body j, and its opposite on body i.

        Its power is effort times rate. Both forces act at j's point, so that they have no
        net moment.
        """
        effort_vector = effort * self.axis
        if self.kind == "angle":
            return couple_load(kin, self.body_j, self.body_i, effort_vector)
        arm_i = self.point - kin.r[kin.index(self.body_i)]
        arm_j = self.point - kin.r[kin.index(self.body_j)]
        return push(kin, self.body_j, effort_vector, arm_j) + push(
            kin, self.body_i, -effort_vector, arm_i
        )


def evaluate_coordinate(kin: Kinematics, joint: Joint, kind: Which) -> JointCoordinate:
    """Coordinate of a joint (resolved in a system) at a state."""
    i, j = kin.index(joint.body_i), kin.index(joint.body_j)
    F_i = multiply_matrices(kin.R_wb[i], joint.frame_i)
    axis = F_i[:, 2]
    a, a_rate = kin.point(joint.body_i, joint.point_i)
    b, b_rate = kin.point(joint.body_j, joint.point_j)
    if kind == "angle":
        x_j = apply_matrix(kin.R_wb[j], joint.frame_j[:, 0])
        # Both components are used: an arc cosine has no sign, and no derivative at its ends.
        value = jnp.arctan2(dot_product(F_i[:, 1], x_j), dot_product(F_i[:, 0], x_j))
        if joint.pitched:
            # The displacement of a screw counts the turns that an angle cannot.
            value = value + whole_turns(value, dot_product(axis, b - a), joint.length)
        rate = dot_product(axis, kin.omega_w[j] - kin.omega_w[i])
    else:
        value = dot_product(axis, b - a)
        # Velocity relative to the frame of body i: the part of its rotation is subtracted.
        rate = dot_product(axis, b_rate - a_rate - cross(kin.omega_w[i], b - a))
    return JointCoordinate(kind, joint.body_i, joint.body_j, value, rate, axis, b)


_DRIVERS = {"drive_angle": REVOLUTE.coordinates, "drive_displacement": PRISMATIC.coordinates}


def coordinates_of(kind: str) -> tuple[tuple[str, str], ...]:
    """Names and units of the coordinates that a kind of joint leaves free, in their order."""
    motions = CATALOGUE[kind].motion or ()
    motion_coordinates = (
        (name + f.place, unit) for f in motions for name, unit in f.motion.coordinates
    )
    return _DRIVERS[kind] if kind in _DRIVERS else tuple(motion_coordinates)


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
        return self.coordinates[..., self._coordinate_place("angle")]

    @property
    def angle_rate(self) -> Float[Array | np.ndarray, "*s"]:
        """Rate of `angle` (...,) [rad/s]."""
        return self.rates[..., self._coordinate_place("angle")]

    @property
    def displacement(self) -> Float[Array | np.ndarray, "*s"]:
        """Displacement of j's point along z from i's (...,) [m]; translational and cylindrical."""
        return self.coordinates[..., self._coordinate_place("displacement")]

    @property
    def displacement_rate(self) -> Float[Array | np.ndarray, "*s"]:
        """Rate of `displacement` (...,) [m/s]."""
        return self.rates[..., self._coordinate_place("displacement")]

    def _coordinate_place(self, name: str) -> int:
        names = [coordinate_name for coordinate_name, _ in coordinates_of(self.kind)]
        if name not in names:
            raise ModelError(
                f"Joint '{self.name}' is {self.kind} and has no coordinate {name}; its coordinates "
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
    check_state(system, states, batched=True)
    if states.r.ndim == 2:
        return JointMotion(joint.name, joint.kind, *_read_joint(system, states, joint))
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
    return JointMotion(joint.name, joint.kind, *_evaluate_along(system, states, joint, times))


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


def relative_motion(kin: Kinematics, joint: Joint) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Coordinates and rates of a joint at one state; angles in (-pi, pi] except those of screws."""
    motions = CATALOGUE[joint.kind].motion or ()
    if any(axis != Z or len(motion.columns) > 1 for motion, axis, _ in motions):
        return _of_motions(kin, joint, motions)
    names = [motion.coordinates[0][0] for motion, *_ in motions] or [
        coordinates_of(joint.kind)[0][0]
    ]
    coordinates = [evaluate_coordinate(kin, joint, name) for name in names]  # pyright: ignore[reportArgumentType]
    return jnp.stack([c.value for c in coordinates]), jnp.stack([c.rate for c in coordinates])


def _of_motions(
    kin: Kinematics, joint: Joint, motions: tuple[Freedom, ...]
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Coordinates and rates of any sequence of motions, read one after the other."""
    i, j = kin.index(joint.body_i), kin.index(joint.body_j)
    F_i = multiply_matrices(kin.R_wb[i], joint.frame_i)
    F_j = multiply_matrices(kin.R_wb[j], joint.frame_j)
    a, a_rate = kin.point(joint.body_i, joint.point_i)
    b, b_rate = kin.point(joint.body_j, joint.point_j)
    R, d = multiply_matrices(F_i.T, F_j), apply_transposed(F_i, b - a)
    behind, zero = reference_directions([f[:2] for f in motions], f"Joint '{joint.name}'")
    last = frame_columns(motions[-1].axis)
    # Motions are read in order, each from what those before it leave.
    E, o, coordinate_blocks = jnp.eye(3, dtype=R.dtype), jnp.zeros_like(d), []
    for n, (motion, axis, _) in enumerate(motions):
        axis_frame = frame_columns(axis)
        G = E @ axis_frame
        relative_frames = RelativeFrames(
            (G.T @ R @ last)[..., None],
            behind[:, [n]],
            zero[:, [n]],
            (G.T @ (d - o))[:, None],
            lambda G=G, frame=axis_frame: from_matrix(G.T @ R @ frame)[:, None],
        )
        q, X, translation = motion.read(relative_frames, _motion_columns(joint, motion))
        at_zero = jnp.zeros_like(q).at[0].set(1.0) if motion.unit_norm else jnp.zeros_like(q)
        coordinate_blocks.append(motion.difference(q, at_zero).reshape(-1))
        E, o = G @ X[..., 0] @ axis_frame.T, o + G @ translation[:, 0]
    x = jnp.concatenate(coordinate_blocks)
    twist = [kin.omega_w[j] - kin.omega_w[i], b_rate - a_rate - cross(kin.omega_w[i], b - a)]
    motion_of = lambda rate: jnp.concatenate(relative_pose(joint, x, rate)[2:])
    S = jax.vmap(motion_of, out_axes=1)(jnp.eye(len(x), dtype=x.dtype))
    seen_twist = jnp.concatenate([apply_transposed(F_i, part) for part in twist])
    # Least squares: the twist lies in the span of the motions, up to the constraints' residual.
    return x, lapack.solve(S.T @ S, S.T @ seen_twist)


def _motion_columns(joint: Joint, motion: AbstractRelativeMotion) -> ColumnParts:
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
    total_pose = RelativePose(from_rotation_vector(zero), zero, zero, zero)
    start = 0
    for number, (motion, axis, _) in enumerate(CATALOGUE[joint.kind].motion or ()):
        columns = slice(start, start + len(motion.coordinates))
        step = motion.pose(q[columns], u[columns], axis, joint.length)
        total_pose = _compose_poses(total_pose, step) if number else step
        start = columns.stop
    return total_pose


def _compose_poses(first: RelativePose, second: RelativePose) -> RelativePose:
    """Pose of the child frame of two successive motions in the parent frame of the first."""
    R = rotation_matrix(first.p)
    d, w, v = R @ second.d, R @ second.w, R @ second.v
    p = product(first.p, second.p)
    return RelativePose(p, first.d + d, first.w + w, first.v + v + cross(first.w, d))


@eqx.filter_jit
def _read_joint(
    system: System, state: State, joint: Joint
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    return relative_motion(system.kinematics(state), joint)


@eqx.filter_jit
def _evaluate_along(
    system: System, states: State, joint: Joint, ts: Float[Array, " k"] | None
) -> tuple[Float[Array, "k c"], Float[Array, "k c"]]:
    values, rates = jax.vmap(lambda state: relative_motion(system.kinematics(state), joint))(states)
    if joint.pitched:
        return values, rates
    # a rotation vector is the shortest one
    vectors = sum(3 * f.motion.unit_norm for f in CATALOGUE[joint.kind].motion or ())
    turns = np.array([unit == "rad" for _, unit in coordinates_of(joint.kind)])
    turns[len(turns) - vectors :] = False
    return jnp.where(turns, _unwrap_angles(values, rates, ts), values), rates


def _unwrap_angles(
    values: Float[Array, "k c"], rates: Float[Array, "k c"], ts: Float[Array, " k"] | None
) -> Float[Array, "k c"]:
    """Angles made continuous by multiples of whole turns."""
    steps = jnp.diff(values, axis=0)
    if ts is not None:
        # With rates the expected change is known, so that more than half a turn between two saved times is
        # counted as well.
        steps = steps - 0.5 * jnp.diff(ts)[:, None] * (rates[1:] + rates[:-1])
    turns = jnp.cumsum(jnp.round(steps / (2 * jnp.pi)), axis=0)
    return values.at[1:].add(-2 * jnp.pi * turns)
