"""Figures and tables of a run: pose, positions, joints, balances and reaction loads, in memory or saved.

Each function takes a `Run` or the dataset of a saved one. Coordinates are computed in NumPy: a saved run is drawn
without compilation.
"""

import csv
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..checks.errors import StateError
from ..dynamics.loads import COMPONENTS, UNITS, JointLoads, envelope
from ..dynamics.simulation import Scene
from ..io.netcdf import write_atomically
from ..math.rotation import rotation_matrix_in
from ..uav.motor import MotorRotors
from ..uav.rotor import Rotors
from .plot import draw_histories, draw_legend_beside, grid, look, plot_histories
from .terminal import NOTHING

if TYPE_CHECKING:
    import xarray as xr

    from ..dynamics.simulation import Run

# Largest number of curves in a panel: each has a style of its own.
_MOST = 4
# Kinds of joints along whose axis the bodies slide, and those that turn about it.
SLIDING = ("translational", "cylindrical", "screw")
_TURNING = ("revolute", "cylindrical")
# Largest number of joints in the figure of loads: more curves cannot be told apart at page width.
_LOADED = 8
# Off-diagonal entry of R_x(phi) R_y(theta) up to which a panel's rotation counts as one of that form [1].
_GIMBAL = 1e-6
HEADER = (
    "joint", "type", "body_i", "body_j", "component", "unit", "min", "t_min_s", "max", "t_max_s",
)  # fmt: skip


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


def motion_of(run: "Run | xr.Dataset") -> Motion:
    """Motion of a run in memory, or of the dataset of a saved run or closed loop."""
    data: Any = run
    if not hasattr(data, "data_vars"):
        scene, system, states = data.scene, data.scene.system, data.states
        # of motors with their rotors, these have the body
        sets = [f.rotors for f in system.forces if isinstance(f, Rotors | MotorRotors)]
        base = sets[0].body if sets else (scene.watch or system.names)[-1]
        r, p, omega = (np.asarray(x) for x in (states.r, states.p, states.omega))
        com, names = np.asarray(system.bodies.com), tuple(system.names)
        return Motion(scene.title, data.ts, names, base, r, p, omega, com, system.joints)
    names = tuple(map(str, data["body"].values))
    watched = json.loads(data.attrs.get("watch", "[]")) or names
    base = str(data["rotor_body"].values[0]) if "rotor_body" in data.coords else watched[-1]
    texts = ("joint", "joint_kind", "joint_body_i", "joint_body_j")
    arrays = ("joint_point_i", "joint_point_j", "joint_frame_i", "joint_frame_j")
    joints: list[Any] = []
    if data.sizes.get("joint", 0):
        columns = [data[name].values.astype(str).tolist() for name in texts]
        columns += [data[name].values for name in arrays]
        joints = [PlacedJoint(*row) for row in zip(*columns, strict=True)]
    return Motion(
        data.attrs.get("title", ""), data["time"].values, names, base, data["position"].values,
        data["euler_parameters"].values, data["angular_velocity"].values,
        data["centre_of_mass"].values, joints,
    )  # fmt: skip


# --- figures


def pose(run: "Run | xr.Dataset") -> Figure:
    """Figure of the base's position, tilt and angular velocity.

    The base is the body with rotors, or else the last watched body; tilt is the angle of its z axis
    from the vertical.
    """
    motion = motion_of(run)
    k = motion.names.index(motion.base)
    z = _rotation_matrices(motion.p[:, k])[:, 2, 2]
    # the cosine of two unit vectors may exceed 1 by round-off
    tilt = np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
    panels = [
        ("position [m]", ("x", "y", "z"), motion.r[:, k]),
        ("tilt [degrees]", ("tilt",), tilt[:, None]),
        ("angular velocity,\nbody axes [rad/s]", ("x", "y", "z"), motion.omega[:, k]),
    ]
    title = f"{motion.title}\n{motion.base.replace('_', ' ')}"
    figure = draw_histories(title, motion.ts, panels, height=5.6)
    figure.axes[1].set_ylim(bottom=0.0)
    return figure


def positions(
    run: "Run | xr.Dataset", bodies: Sequence[str], detail: float | None = None
) -> Figure:
    """Figure of the world positions of chosen bodies' centres of mass, with a row of panels per body.

    Args:
        run: run, or dataset of a saved run.
        bodies: names of the bodies, from top to bottom.
        detail: end of the interval that an additional left column shows [s]; default no such column.

    Raises:
        StateError: a name that no body of the run has.

    Source: in the style of report Part II, Fig. 5.2 to 5.5.
    """
    motion = motion_of(run)
    unknown = [name for name in bodies if name not in motion.names]
    if unknown:
        raise StateError(
            f"The bodies of the figure must be of the run ({', '.join(motion.names)}), but one is {unknown[0]!r}."
        )
    # A fast transient and a slow motion cannot be read on one axis of time.
    ends = [motion.ts[-1]] if detail is None else [detail, motion.ts[-1]]
    figure, axes = grid(len(bodies), len(ends), 0.9 + 1.5 * len(bodies), sharex="col")
    for row, name in enumerate(bodies):
        r = motion.r[:, motion.names.index(name)]
        for ax, end in zip(axes[row], ends, strict=True):
            part = motion.ts <= end
            plot_histories(ax, motion.ts[part], r[part], ("x", "y", "z"))
            ax.set_xlabel("time [s]" if row == len(bodies) - 1 else "", fontsize=9)
        axes[row, 0].set_ylabel(f"{name.replace('_', ' ')} [m]", fontsize=9, parse_math=False)
    figure.align_ylabels(axes[:, 0])
    draw_legend_beside(axes[0, -1])
    figure.suptitle(motion.title, fontsize=10, parse_math=False)
    return figure


def joints(run: "Run | xr.Dataset") -> Figure | None:
    """Figure of strokes and panel angles, or else of the angles of joints that turn.

    None for a run without such joints.
    """
    title, ts, panels = joints_of(motion_of(run))
    return draw_histories(title, ts, panels) if panels else None


def joints_of(motion: Motion) -> tuple[Any, ...]:
    """Title, times [s], and panels: words of the axis, labels, and curves (k, labels).

    Panels are, as far as the machine has them: displacements of sliding joints since the start; the
    panel's angles; and without a panel the angles of joints that turn.
    """
    panels = []
    joints = motion.joints
    sliding = [joint for joint in joints if joint.kind in SLIDING][:_MOST]
    if sliding:
        displacements = np.stack([displacement_of(motion, joint) for joint in sliding], axis=1)
        # Joints measure from different origins; strokes from the start are comparable.
        displacements = displacements - displacements[0]
        unit, scale = ("mm", 1e3) if np.nanmax(np.abs(displacements)) < 1 else ("m", 1.0)
        labels = tuple(f"{joint.name}, {joint.body_j.replace('_', ' ')}" for joint in sliding)
        panels.append((f"stroke from the start [{unit}]", labels, scale * displacements))
    name = next((name for name in motion.names if "panel" in name.lower()), None)
    turning = [joint for joint in joints if joint.kind in _TURNING][:_MOST]
    if name is not None:
        panels.append(_panel_attitude(motion, name))
    elif turning:
        angles = np.degrees(np.stack([_joint_angle(motion, joint) for joint in turning], axis=1))
        panels.append(("joint angle [degrees]", tuple(joint.name for joint in turning), angles))
    return motion.title, motion.ts, panels


def balances(run: "Run | xr.Dataset") -> Figure | None:
    """Figure of energies, and of the estimated error, energy drift and violations, with one axis per unit.

    None for a run that was saved without its analysis. Violations are NaN in files that lack them.
    """
    source: Any = run
    if hasattr(source, "data_vars"):
        if "kinetic_energy" not in source:
            return None
        names = ("kinetic_energy", "potential_energy", "work", "position_error")
        names += ("position_violation", "velocity_violation")
        none = np.full(source.sizes["time"], np.nan)
        parts = [source[name].values if name in source else none for name in names]
        title, ts = source.attrs.get("title", ""), source["time"].values
    else:
        view, trajectory, worst = source.snapshot, source.trajectory, source.trajectory.worst
        parts = [view.kinetic, view.potential, trajectory.work, source.errors.position]
        parts = [np.asarray(part) for part in (*parts, worst.position, worst.velocity)]
        title, ts = source.scene.title, source.ts
    kinetic, potential, work, error, lengths, rates = parts
    energies = np.stack([kinetic, potential - potential[0], work], axis=1)
    total = kinetic + potential
    # The largest so far, as for the violations: on a logarithmic axis a change of sign would be a spike.
    drift = np.maximum.accumulate(np.abs(total - total[0] - work))
    figure, axes = grid(2, 2, 5.2, sharex=True)
    plot_histories(axes[0, 0], ts, energies, ("kinetic", "potential", "work done"))
    axes[0, 0].set_ylabel("energy [J]", fontsize=9)
    both = np.stack([np.max(error, axis=1), lengths], axis=1)
    labels = ("estimated error of positions", "violation of lengths so far")
    _plot_logarithmic(axes[0, 1], ts, both, labels, "length [m]")
    _plot_logarithmic(axes[1, 0], ts, drift[:, None], ("energy drift so far",), "energy [J]")
    rate_labels = ("violation of the lengths' rates so far",)
    _plot_logarithmic(axes[1, 1], ts, rates[:, None], rate_labels, "speed [m/s]")
    for ax in axes.flat:
        ax.legend(fontsize=8, ncols=1, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    for ax in axes[0]:
        ax.set_xlabel("")
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


FIGURES = {"pose": pose, "joints": joints, "balances": balances}


def _plot_logarithmic(
    ax: Axes, ts: np.ndarray, values: np.ndarray, labels: tuple[str, ...], label_text: str
) -> None:
    """Plot the positive values on a logarithmic axis; zeros have no place on it."""
    positive = np.where(values > 0, values, np.nan)
    plot_histories(ax, ts, positive, labels)
    ax.set_ylabel(label_text, fontsize=9)
    if np.any(values > 0):
        ax.set_yscale("log")
    else:
        ax.set_yticks([])
        label_text = "zero throughout" if np.any(np.isfinite(values)) else "not known"
        ax.text(0.5, 0.5, label_text, transform=ax.transAxes, ha="center", fontsize=9)


# --- reaction loads


def saved_loads(data: "xr.Dataset") -> JointLoads | None:
    """Reaction loads at the saved times of a saved run; None where its file has none."""
    if "reaction_force" not in data or not data.sizes["joint"]:
        return None
    motion = motion_of(data)
    frames = np.stack([joint_side(motion, joint, "i")[1] for joint in motion.joints], axis=1)
    # components along the columns of each frame
    # Bearings are sized in their own axes, and files hold loads in those of the world.
    in_joint_axes = lambda name: np.einsum("kjab,kja->kjb", frames, data[name].values)
    force, moment = (in_joint_axes(f"reaction_{part}") for part in ("force", "moment"))
    names = tuple(joint.name for joint in motion.joints)
    return JointLoads(motion.ts, force, moment, names)


def loads_figure(scene: Scene, loads: JointLoads) -> Figure:
    """Figure of the magnitudes of force and moment at every joint over time."""
    return draw_loads(scene.title, loads)


def draw_loads(title: str, loads: JointLoads) -> Figure:
    """Figure of `loads_figure` of loads in memory or of `saved_loads`.

    The joints with the largest peaks are drawn, with a curve each. Impacts exceed the usual loads by orders
    of magnitude: axes are logarithmic, over at most four decades below the peak.
    """
    figure, axes = grid(2, 1, 5.6, sharex=True)
    labels = ("force [N]", "moment [N m]")
    for ax, parts, label in zip(axes[:, 0], (loads.force, loads.moment), labels, strict=True):
        ax.set_ylabel(label, fontsize=9)
        magnitude = np.linalg.norm(np.asarray(parts), axis=-1)
        peaks = np.nanmax(np.where(np.isfinite(magnitude), magnitude, 0.0), axis=0, initial=0.0)
        loaded = np.flatnonzero(peaks > NOTHING)
        drawn_joints = np.sort(loaded[np.argsort(-peaks[loaded], kind="stable")][:_LOADED])
        if not len(drawn_joints):
            ax.set_yticks([])
            middle: Any = {"transform": ax.transAxes, "ha": "center", "fontsize": 9}
            ax.text(0.5, 0.5, "zero at every joint", **middle)
            continue
        for k in drawn_joints:
            # a joint keeps its style in both panels; marks would hide the peaks
            style: Any = look(int(k)) | {"marker": ""}
            ax.plot(np.asarray(loads.ts), magnitude[:, k], label=loads.joints[k], **style)
        ax.set_yscale("log")
        top = 10 ** np.ceil(np.log10(peaks[drawn_joints].max()))
        ax.set_ylim(max(1e-4 * top, 0.5 * float(np.nanmin(magnitude[:, drawn_joints]))), top)
        draw_legend_beside(ax)
        if len(loaded) > len(drawn_joints):
            ax.set_title(
                f"{len(drawn_joints)} of {len(loaded)} joints: the largest peaks", fontsize=9
            )
    axes[1, 0].set_xlabel("time [s]", fontsize=9)
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(f"{title}\nmagnitudes of the joint reactions", fontsize=10, parse_math=False)
    return figure


def save_loads(scene: Scene, loads: JointLoads, path: str | os.PathLike[str]) -> Path:
    """Save the envelope of reaction loads as CSV, atomically; return the path.

    Loads act from body i on body j, about the joint's point on body j, in the axes of the
    joint's frame on body i.
    """
    text, extremes = io.StringIO(newline=""), envelope(loads)
    columns = ("minimum", "t_minimum", "maximum", "t_maximum")
    values = [np.asarray(getattr(extremes, column)) for column in columns]
    writer = csv.writer(text)
    writer.writerow(HEADER)
    for k, joint in enumerate(scene.system.joints):
        for c, component in enumerate(zip(COMPONENTS, UNITS, strict=True)):
            numbers = (f"{x[k, c]:.6g}" for x in values)
            writer.writerow(
                [joint.name, joint.kind, joint.body_i, joint.body_j, *component, *numbers]
            )
    return write_atomically(path, text.getvalue().encode())


# --- coordinates


def _rotation_matrices(p: Any) -> np.ndarray:
    """Rotation matrices (k, 3, 3) of Euler parameters (k, 4); no number stays none."""
    return np.moveaxis(np.asarray(rotation_matrix_in(np, np.asarray(p).T)), -1, 0)


def joint_side(motion: Motion, joint: Any, side: str) -> tuple[np.ndarray, np.ndarray]:
    """World point (k, 3) [m] and axes (k, 3, 3) of a joint on one of its bodies, "i" or "j"."""
    side_value = lambda name: np.asarray(getattr(joint, f"{name}_{side}"))
    body = joint.body_i if side == "i" else joint.body_j
    if body not in motion.names:
        count = len(motion.ts)
        return np.tile(side_value("point"), (count, 1)), np.tile(side_value("frame"), (count, 1, 1))
    at = motion.names.index(body)
    R = _rotation_matrices(motion.p[:, at])
    return motion.r[:, at] + R @ (side_value("point") - motion.com[at]), R @ side_value("frame")


def displacement_of(motion: Motion, joint: Any) -> np.ndarray:
    """Displacement of the joint's point on body j along the joint's z axis on body i (k,) [m]."""
    (start, F), (end, _) = joint_side(motion, joint, "i"), joint_side(motion, joint, "j")
    return np.sum((end - start) * F[:, :, 2], axis=1)


def _joint_angle(motion: Motion, joint: Any) -> np.ndarray:
    """Angle from body i to body j about the joint's z axis, continuous (k,) [rad]."""
    (_, F_i), (_, F_j) = joint_side(motion, joint, "i"), joint_side(motion, joint, "j")
    x = F_j[:, :, 0]
    sine, cosine = (np.sum(F_i[:, :, k] * x, axis=1) for k in (1, 0))
    return _unwrap_angles(np.arctan2(sine, cosine))


def _unwrap_angles(angles: np.ndarray) -> np.ndarray:
    """Angles (k,) [rad] without jumps of a turn; times without a number stay as they are."""
    is_finite = np.isfinite(angles)
    continuous_angles = angles.copy()
    continuous_angles[is_finite] = np.unwrap(angles[is_finite])
    return continuous_angles


def _panel_attitude(motion: Motion, name: str) -> tuple[str, tuple[str, ...], np.ndarray]:
    """Axis, labels and curves of a panel's attitude in the base's axes, or in the world's.

    A panel on a universal joint has the rotation R_x(phi) R_y(theta), whose matrix gives both angles
    without a singularity:

    R = [[c_theta, 0, s_theta], [s_phi s_theta, c_phi, -s_phi c_theta], [-c_phi s_theta, s_phi, c_phi c_theta]].

    The angles from its normal alone flip at theta = 90 degrees. Other panels have no such angles, and the
    components of their normal are drawn.
    """
    R = _rotation_matrices(motion.p[:, motion.names.index(name)])
    if motion.base != name:
        R = np.swapaxes(_rotation_matrices(motion.p[:, motion.names.index(motion.base)]), 1, 2) @ R
    if np.nanmax(np.abs(R[:, 0, 1])) > _GIMBAL:
        return "panel's normal [1]", ("x", "y", "z"), R[:, :, 2]
    phi, theta = np.arctan2(R[:, 2, 1], R[:, 1, 1]), np.arctan2(R[:, 0, 2], R[:, 0, 0])
    angles = np.degrees(np.stack([_unwrap_angles(phi), _unwrap_angles(theta)], axis=1))
    return "panel angles [degrees]", (r"$\varphi$", r"$\theta$"), angles
