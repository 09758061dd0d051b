"""Numbers that the figures of a run show: texts and arrays, of a run in memory or of a saved one."""

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

    from ..dynamics.run import Run

# Arguments of the functions that draw, by the figures' names.
Numbers = Mapping[str, tuple[Any, ...]]

# Loads below this are round-off of joints without such a load; tables show them as 0 [N, N m].
NOTHING = 1e-9

# Largest number of curves in a panel: each has a style of its own.
_MOST = 4
_SLIDING = ("translational", "cylindrical", "screw")
_TURNING = ("revolute", "cylindrical")


class PlacedJoint(NamedTuple):
    """Joint of a saved run: its name, kind and bodies, and its point (3,) [m] and axes (3, 3) on each."""

    name: str
    kind: str
    body_i: str
    body_j: str
    point_i: np.ndarray
    point_j: np.ndarray
    frame_i: np.ndarray
    frame_j: np.ndarray


class Motion(NamedTuple):
    """Motion of all bodies of a mechanism over time.

    Attributes:
        title: title of the run. ts: times (k,) [s]. names: names of the n bodies.
        base: name of the body with rotors, or else of the last watched body.
        r, p, omega: positions of the centres of mass (k, n, 3) [m], Euler parameters (k, n, 4), and
            angular velocities in body axes (k, n, 3) [rad/s].
        com: centres of mass in the bodies' reference frames (n, 3) [m].
        joints: joints, with the attributes of `PlacedJoint`.
    """

    title: str
    ts: np.ndarray
    names: tuple[str, ...]
    base: str
    r: np.ndarray
    p: np.ndarray
    omega: np.ndarray
    com: np.ndarray
    joints: Sequence[Any]


def motion_of(run: "Run") -> Motion:
    """Motion of a run in memory."""
    system, states = run.scene.system, run.states
    com = np.asarray(system.bodies.com)
    return Motion(
        run.scene.title, run.ts, tuple(system.names), _base(run), np.asarray(states.r),
        np.asarray(states.p), np.asarray(states.omega), com, system.joints,
    )  # fmt: skip


def saved_motion(data: "xr.Dataset") -> Motion:
    """Motion of a saved run, of a scene or of a closed loop."""
    names = tuple(map(str, data["body"].values))
    watched = json.loads(data.attrs.get("watch", "[]")) or names
    base = str(data["rotor_body"].values[0]) if "rotor_body" in data.coords else watched[-1]
    texts = ("joint", "joint_kind", "joint_body_i", "joint_body_j")
    arrays = ("joint_point_i", "joint_point_j", "joint_frame_i", "joint_frame_j")
    joints: list[Any] = []
    for k in range(data.sizes.get("joint", 0)):
        name, kind, body_i, body_j = (str(data[text].values[k]) for text in texts)
        numbers = (data[array].values[k] for array in arrays)
        joints.append(PlacedJoint(name, kind, body_i, body_j, *numbers))
    return Motion(
        data.attrs.get("title", ""), data["time"].values, names, base, data["position"].values,
        data["euler_parameters"].values, data["angular_velocity"].values,
        data["centre_of_mass"].values, joints,
    )  # fmt: skip


def pose_of(motion: Motion) -> tuple[Any, ...]:
    """Title, name of the base, times [s], its positions (k, 3) [m], tilts (k,) [degrees] and
    angular velocities (k, 3) [rad/s].
    """
    at = motion.names.index(motion.base)
    z = _rotations(motion.p[:, at])[:, 2, 2]
    # the cosine of two unit vectors may exceed 1 by round-off
    tilt = np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
    return motion.title, motion.base, motion.ts, motion.r[:, at], tilt, motion.omega[:, at]


def joints_of(motion: Motion) -> tuple[Any, ...]:
    """Title, times [s], and panels: words of the axis, labels, and curves (k, labels).

    Panels are, as far as the machine has them: displacements of sliding joints since the start; the
    panel's angles; and without a panel the angles of joints that turn.
    """
    panels = []
    joints = motion.joints
    sliding = [joint for joint in joints if joint.kind in _SLIDING][:_MOST]
    if sliding:
        moved = np.stack([_displacement(motion, joint) for joint in sliding], axis=1)
        moved = moved - moved[0]
        unit, scale = ("mm", 1e3) if np.nanmax(np.abs(moved)) < 1 else ("m", 1.0)
        labels = tuple(f"{joint.name}, {_other(joint)}" for joint in sliding)
        panels.append((f"stroke from the start [{unit}]", labels, scale * moved))
    name = next((name for name in motion.names if "panel" in name.lower()), None)
    turning = [joint for joint in joints if joint.kind in _TURNING][:_MOST]
    if name is not None:
        angles = np.degrees(_panel_angles(motion, name))
        panels.append(("panel angles [degrees]", (r"$\varphi$", r"$\theta$"), angles))
    elif turning:
        angles = np.degrees(np.stack([_angle(motion, joint) for joint in turning], axis=1))
        panels.append(("joint angle [degrees]", tuple(joint.name for joint in turning), angles))
    return motion.title, motion.ts, panels


def balances_of(run: "Run") -> tuple[Any, ...]:
    """Title, times [s], energies (k, 3) [J], and errors and violations so far (k, 4)."""
    view, trajectory = run.snapshot, run.trajectory
    return _balances(
        run.scene.title, run.ts, view.kinetic, view.potential, trajectory.work,
        run.errors.position, trajectory.worst.position, trajectory.worst.velocity,
    )  # fmt: skip


def saved_balances(data: "xr.Dataset") -> tuple[Any, ...] | None:
    """Numbers of `balances_of` of a saved run; None for one that was saved without its analysis.

    Violations are NaN in files of versions that did not save them.
    """
    if "kinetic_energy" not in data:
        return None
    none = np.full(data.sizes["time"], np.nan)
    names = ("kinetic_energy", "potential_energy", "work", "position_error")
    names += ("position_violation", "velocity_violation")
    parts = [data[name].values if name in data else none for name in names]
    return _balances(data.attrs.get("title", ""), data["time"].values, *parts)


def _balances(
    title: str, ts: np.ndarray, kinetic: Any, potential: Any, work: Any, error: Any,
    position: Any, velocity: Any,
) -> tuple[Any, ...]:  # fmt: skip
    energies = np.stack([kinetic, potential - potential[0], work], axis=1)
    total = kinetic + potential
    drift = np.maximum.accumulate(np.abs(total - total[0] - work))
    errors = np.stack([np.max(error, axis=1), drift, position, velocity], axis=1)
    return title, ts, energies, errors


def numbers_of(run: "Run") -> Numbers:
    """Numbers of all figures of a run by the figures' names; joints only where one is free."""
    motion = motion_of(run)
    found = {"pose": pose_of(motion), "joints": joints_of(motion), "balances": balances_of(run)}
    return {name: each for name, each in found.items() if name != "joints" or each[-1]}


def saved_numbers(data: "xr.Dataset") -> Numbers:
    """Numbers of `numbers_of` of a saved run, as far as its file has them."""
    motion = saved_motion(data)
    found = {"pose": pose_of(motion), "joints": joints_of(motion), "balances": saved_balances(data)}
    drawn = {name: each for name, each in found.items() if each is not None}
    return {name: each for name, each in drawn.items() if name != "joints" or each[-1]}


class SavedLoads(NamedTuple):
    """Reaction loads in NumPy arrays, as in `JointLoads`: times (k,), force and moment (k, joints, 3)."""

    ts: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    joints: tuple[str, ...]

    @property
    def components(self) -> np.ndarray:
        """Force and its magnitude [N], moment and its magnitude [N m] (k, joints, 8)."""
        parts = [
            part
            for vector in (self.force, self.moment)
            for part in (vector, np.linalg.norm(vector, axis=-1)[..., None])
        ]
        return np.concatenate(parts, axis=-1)


def saved_loads(data: "xr.Dataset") -> SavedLoads | None:
    """Reaction loads at the saved times of a saved run; None where its file has none."""
    if "reaction_force" not in data or not data.sizes["joint"]:
        return None
    motion = saved_motion(data)
    frames = np.stack([joint_side(motion, joint, "i")[1] for joint in motion.joints], axis=1)
    # components along the columns of each frame
    own = lambda name: np.einsum("kjab,kja->kjb", frames, data[name].values)
    names = tuple(joint.name for joint in motion.joints)
    return SavedLoads(motion.ts, own("reaction_force"), own("reaction_moment"), names)


# --- coordinates by NumPy, for which nothing is compiled


def _base(run: "Run") -> str:
    from ..rotorcraft.motor import MotorRotors
    from ..rotorcraft.rotor import Rotors

    for force in run.scene.system.forces:
        if isinstance(force, MotorRotors):
            return force.rotors.body
        if isinstance(force, Rotors):
            return force.body
    return (run.scene.watch or run.scene.system.names)[-1]


def _other(joint: Any) -> str:
    return joint.body_j.replace("_", " ")


def _rotations(p: Any) -> np.ndarray:
    """Rotation matrices (k, 3, 3) of Euler parameters (k, 4); no number stays none."""
    from ..algebra.rotation import rotation_matrix_in

    return np.moveaxis(np.asarray(rotation_matrix_in(np, np.asarray(p).T)), -1, 0)


def joint_side(motion: Motion, joint: Any, side: str) -> tuple[np.ndarray, np.ndarray]:
    """World point (k, 3) [m] and axes (k, 3, 3) of a joint on one of its bodies, "i" or "j"."""
    own = lambda name: np.asarray(getattr(joint, f"{name}_{side}"))
    body = joint.body_i if side == "i" else joint.body_j
    if body not in motion.names:
        count = len(motion.ts)
        return np.tile(own("point"), (count, 1)), np.tile(own("frame"), (count, 1, 1))
    at = motion.names.index(body)
    R = _rotations(motion.p[:, at])
    return motion.r[:, at] + R @ (own("point") - motion.com[at]), R @ own("frame")


def _displacement(motion: Motion, joint: Any) -> np.ndarray:
    """Displacement of the joint's point on body j along the joint's z axis on body i (k,) [m]."""
    (start, F), (end, _) = joint_side(motion, joint, "i"), joint_side(motion, joint, "j")
    return np.sum((end - start) * F[:, :, 2], axis=1)


def _angle(motion: Motion, joint: Any) -> np.ndarray:
    """Angle from body i to body j about the joint's z axis, continuous (k,) [rad]."""
    (_, F_i), (_, F_j) = joint_side(motion, joint, "i"), joint_side(motion, joint, "j")
    x = F_j[:, :, 0]
    sine, cosine = (np.sum(F_i[:, :, k] * x, axis=1) for k in (1, 0))
    return _continuous(np.arctan2(sine, cosine))


def _continuous(angles: np.ndarray) -> np.ndarray:
    """Angles (k,) [rad] without jumps of a turn; times without a number stay as they are."""
    fine = np.isfinite(angles)
    found = angles.copy()
    found[fine] = np.unwrap(angles[fine])
    return found


def _panel_angles(motion: Motion, name: str) -> np.ndarray:
    """Angles phi and theta of a panel in the base's axes, or in the world's (k, 2) [rad].

    n = R_x(phi) R_y(theta) e_z = (sin theta, -sin phi cos theta, cos phi cos theta)
    """
    of_body = lambda body: _rotations(motion.p[:, motion.names.index(body)])
    n = of_body(name)[:, :, 2]
    if motion.base != name:
        n = np.einsum("kji,kj->ki", of_body(motion.base), n)
    theta = np.arcsin(np.clip(n[:, 0], -1.0, 1.0))
    phi = np.arctan2(-n[:, 1], n[:, 2])
    # a line from half a turn to minus half a turn, or across the flip at theta = 90 degrees, would be no motion
    phi[1:][np.abs(np.diff(phi)) > np.pi / 2] = np.nan
    return np.stack([phi, theta], axis=1)
