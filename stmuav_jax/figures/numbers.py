"""Numbers that the figures of a run show: texts and arrays, without the run's model."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..dynamics.run import Run
    from ..mechanics.joint import Joint

# Arguments of the functions that draw, by the figures' names.
Numbers = Mapping[str, tuple[Any, ...]]

# Largest number of curves in a panel: each has a style of its own.
_MOST = 4
_SLIDING = ("translational", "cylindrical", "screw")
_TURNING = ("revolute", "cylindrical")


def pose_of(run: "Run") -> tuple[Any, ...]:
    """Title, name of the base, times [s], its positions (k, 3) [m], tilts (k,) [degrees] and
    angular velocities (k, 3) [rad/s].

    The base is the body with rotors, or else the last watched body.
    """
    name = _base(run)
    found = run.body(name)
    z = _rotations(found.p)[:, 2, 2]
    # the cosine of two unit vectors may exceed 1 by round-off
    tilt = np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
    return run.scene.title, name, run.ts, np.asarray(found.r), tilt, np.asarray(found.omega)


def joints_of(run: "Run") -> tuple[Any, ...]:
    """Title, times [s], and panels: words of the axis, labels, and curves (k, labels).

    Panels are, as far as the machine has them: displacements of sliding joints since the start; the
    panel's angles; and without a panel the angles of joints that turn.
    """
    panels = []
    joints = run.scene.system.joints
    sliding = [joint for joint in joints if joint.kind in _SLIDING][:_MOST]
    if sliding:
        moved = np.stack([_displacement(run, joint) for joint in sliding], axis=1)
        moved = moved - moved[0]
        unit, scale = ("mm", 1e3) if np.nanmax(np.abs(moved)) < 1 else ("m", 1.0)
        labels = tuple(f"{joint.name}, {_other(joint)}" for joint in sliding)
        panels.append((f"stroke from the start [{unit}]", labels, scale * moved))
    name = next((name for name in run.scene.system.names if "panel" in name.lower()), None)
    turning = [joint for joint in joints if joint.kind in _TURNING][:_MOST]
    if name is not None:
        angles = np.degrees(_panel_angles(run, name))
        panels.append(("panel angles [degrees]", (r"$\varphi$", r"$\theta$"), angles))
    elif turning:
        angles = np.degrees(np.stack([_angle(run, joint) for joint in turning], axis=1))
        panels.append(("joint angle [degrees]", tuple(joint.name for joint in turning), angles))
    return run.scene.title, run.ts, panels


def balances_of(run: "Run") -> tuple[Any, ...]:
    """Title, times [s], energies (k, 3) [J], and errors and violations so far (k, 4)."""
    view, trajectory = run.snapshot, run.trajectory
    energies = np.stack([view.kinetic, view.potential - view.potential[0], trajectory.work], axis=1)
    total = view.kinetic + view.potential
    drift = np.maximum.accumulate(np.abs(total - total[0] - trajectory.work))
    position = np.max(run.errors.position, axis=1)
    worst = trajectory.worst
    errors = np.stack([position, drift, worst.position, worst.velocity], axis=1)
    return run.scene.title, run.ts, energies, errors


def numbers_of(run: "Run") -> Numbers:
    """Numbers of all figures of a run by the figures' names; joints only where one is free."""
    found = {"pose": pose_of(run), "joints": joints_of(run), "balances": balances_of(run)}
    return {name: each for name, each in found.items() if name != "joints" or each[-1]}


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


def _other(joint: "Joint") -> str:
    return joint.body_j.replace("_", " ")


def _rotations(p: Any) -> np.ndarray:
    """Rotation matrices (k, 3, 3) of Euler parameters (k, 4); no number stays none."""
    from ..algebra.rotation import rotation_matrix_in

    return np.moveaxis(np.asarray(rotation_matrix_in(np, np.asarray(p).T)), -1, 0)


def _side(run: "Run", joint: "Joint", side: str) -> tuple[np.ndarray, np.ndarray]:
    """World point (k, 3) [m] and axes (k, 3, 3) of a joint on one of its bodies."""
    own = lambda name: np.asarray(getattr(joint, f"{name}_{side}"))
    body = joint.body_i if side == "i" else joint.body_j
    if body not in run.scene.system.names:
        count = len(run.ts)
        return np.tile(own("point"), (count, 1)), np.tile(own("frame"), (count, 1, 1))
    found, R = run.body(body), _rotations(run.body(body).p)
    com = np.asarray(run.scene.system.bodies.com)[run.scene.system.index(body)]
    return np.asarray(found.r) + R @ (own("point") - com), R @ own("frame")


def _displacement(run: "Run", joint: "Joint") -> np.ndarray:
    """Displacement of the joint's point on body j along the joint's z axis on body i (k,) [m]."""
    (start, F), (end, _) = _side(run, joint, "i"), _side(run, joint, "j")
    return np.sum((end - start) * F[:, :, 2], axis=1)


def _angle(run: "Run", joint: "Joint") -> np.ndarray:
    """Angle from body i to body j about the joint's z axis, continuous (k,) [rad]."""
    (_, F_i), (_, F_j) = _side(run, joint, "i"), _side(run, joint, "j")
    x = F_j[:, :, 0]
    sine, cosine = (np.sum(F_i[:, :, k] * x, axis=1) for k in (1, 0))
    return _continuous(np.arctan2(sine, cosine))


def _continuous(angles: np.ndarray) -> np.ndarray:
    """Angles (k,) [rad] without jumps of a turn; times without a number stay as they are."""
    fine = np.isfinite(angles)
    found = angles.copy()
    found[fine] = np.unwrap(angles[fine])
    return found


def _panel_angles(run: "Run", name: str) -> np.ndarray:
    """Angles phi and theta of a panel in the base's axes, or in the world's (k, 2) [rad].

    n = R_x(phi) R_y(theta) e_z = (sin theta, -sin phi cos theta, cos phi cos theta)
    """
    n = _rotations(run.body(name).p)[:, :, 2]
    base = _base(run)
    if base != name:
        n = np.einsum("kji,kj->ki", _rotations(run.body(base).p), n)
    theta = np.arcsin(np.clip(n[:, 0], -1.0, 1.0))
    phi = np.arctan2(-n[:, 1], n[:, 2])
    # a line from half a turn to minus half a turn, or across the flip at theta = 90 degrees, would be no motion
    phi[1:][np.abs(np.diff(phi)) > np.pi / 2] = np.nan
    return np.stack([phi, theta], axis=1)
