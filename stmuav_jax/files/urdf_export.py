"""Systems as robots in URDF, which has trees of links alone: hinges, slides, welds and floating bodies.

A link's frame lies at the joint that carries it, with the axes of the body's reference frame.
"""

import os
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jax
import numpy as np

from ..checks.errors import SettingError
from ..checks.numbers import floats
from ..dynamics.scene import Scene
from ..dynamics.tree.topology import Link, spanning_tree
from ..mechanics.body import GROUND
from ..mechanics.forces.applied import Gravity, JointDamping
from ..mechanics.joint import Joint
from ..mechanics.system import System
from .mujoco_export import xml_numbers
from .mujoco_left_out import LeftOut
from .netcdf import write_atomically

Element = ElementTree.Element

_TYPES = {"revolute": "continuous", "translational": "prismatic", "weld": "fixed"}
# Gravity that readers of URDF take [m/s^2], and ends of a slide that has none, which URDF asks for [m].
_USUAL, _FAR = (0.0, 0.0, -9.81), 1e6
_SAME = 1e-15


def save_urdf(scene: Scene, path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write a scene's system as a URDF file; the sentences on what is left out.

    Bodies are links of the same names, ground is the root. All joint coordinates are zero at the
    reference posture. Dampers of joints are kept, all other force elements are left out.

    Raises:
        SettingError: a joint closes a loop, or is none of a hinge, a slide and a weld.
    """
    system, tree = scene.system, spanning_tree(scene.system)
    if tree.cut:
        closing = ", ".join(f"'{system.joints[k].name}'" for k in tree.cut)
        raise SettingError(
            f"URDF has trees alone, but this system has loops, which these joints close: {closing}. "
            "MJCF holds them: stmuav_jax.files.save_mjcf."
        )
    for link in tree.links:
        joint = None if link.joint is None else system.joints[link.joint]
        if joint is not None and joint.kind not in _TYPES:
            raise SettingError(
                f"URDF has no counterpart of joint '{joint.name}', a {joint.kind} joint; it has: "
                f"{', '.join(_TYPES)}."
            )
    root = Element("robot", name=scene.name)
    ElementTree.SubElement(root, "link", name=GROUND)
    names, shifts = (*system.names, GROUND), {GROUND: np.zeros(3)}
    axes: dict[str, Element] = {}
    if tree.floating:
        _floating(root, system, tree.root, shifts)
    for link in tree.links:
        if link.joint is None:
            _floating(root, system, link.child, shifts)
        else:
            _linked(root, system, link, names, shifts, axes)
    left_out = _left_out(scene, axes)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode") + "\n"
    write_atomically(Path(path), text.encode())
    return left_out.sentences()


def _angles(R: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw about fixed axes (3,) [rad] of a rotation matrix."""
    flat = np.hypot(R[0, 0], R[1, 0])
    pitch = np.arctan2(-R[2, 0], flat)
    if flat > 1e-12:
        return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])
    # the x axis points up or down: only roll and yaw together are determined
    return np.array([0.0, pitch, np.arctan2(-R[0, 1], R[1, 1])])


def _link(root: Element, system: System, k: int, shift: np.ndarray) -> None:
    """Add the link of a body, whose frame is shifted in the body's reference frame."""
    bodies = system.bodies
    inertial = ElementTree.SubElement(
        ElementTree.SubElement(root, "link", name=system.names[k]), "inertial"
    )
    place = {"xyz": xml_numbers(np.asarray(bodies.com[k]) - shift), "rpy": "0 0 0"}
    ElementTree.SubElement(inertial, "origin", place)
    ElementTree.SubElement(inertial, "mass", value=xml_numbers(bodies.mass[k]))
    J = np.asarray(bodies.inertia[k])
    parts = {f"i{a}{b}": xml_numbers(J["xyz".index(a), "xyz".index(b)]) for a, b in _PAIRS}
    ElementTree.SubElement(inertial, "inertia", parts)


_PAIRS = ("xx", "yy", "zz", "xy", "xz", "yz")


def _joint(
    root: Element, name: str, kind: str, parent: str, child: str, pose: tuple[Any, Any]
) -> Element:
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    place = {"xyz": xml_numbers(pose[0]), "rpy": xml_numbers(_angles(np.asarray(pose[1])))}
    ElementTree.SubElement(joint, "origin", place)
    return joint


def _floating(root: Element, system: System, k: int, shifts: dict[str, np.ndarray]) -> None:
    """Add a body that floats, at its reference posture."""
    name = system.names[k]
    kin = system.kinematics(system.reference)
    shifts[name] = np.zeros(3)
    _link(root, system, k, shifts[name])
    pose = kin.point(name, floats((0.0, 0.0, 0.0)))[0], kin.R_wb[k]
    _joint(root, f"{name}_free", "floating", GROUND, name, pose)


def _linked(
    root: Element,
    system: System,
    link: Link,
    names: tuple[str, ...],
    shifts: dict[str, np.ndarray],
    axes: dict[str, Element],
) -> None:
    """Add the body behind a joint of the tree, whose frames coincide where it is zero."""
    joint: Joint = system.joints[link.joint or 0]
    sides = [(joint.point_i, joint.frame_i), (joint.point_j, joint.frame_j)]
    (point, frame), (own, mine) = (
        [np.asarray(x) for x in side] for side in (sides if link.forward else sides[::-1])
    )
    parent, child = names[link.parent], names[link.child]
    shifts[child] = own
    _link(root, system, link.child, own)
    pose = point - shifts[parent], frame @ mine.T
    made = _joint(root, joint.name, _TYPES[joint.kind], parent, child, pose)
    if joint.kind == "weld":
        return
    sign = 1.0 if link.forward else -1.0
    ElementTree.SubElement(made, "axis", xyz=xml_numbers(sign * mine[:, 2]))
    if joint.kind == "translational":
        ends = {
            "lower": xml_numbers(-_FAR),
            "upper": xml_numbers(_FAR),
            "effort": "0",
            "velocity": "0",
        }
        ElementTree.SubElement(made, "limit", ends)
    axes[joint.name] = made


def _left_out(scene: Scene, axes: dict[str, Element]) -> LeftOut:
    """List of what URDF does not hold; dampers of joints are written."""
    system, left_out = scene.system, LeftOut({})
    damping: dict[str, float] = {}
    for force in system.forces:
        if isinstance(force, JointDamping) and force.joint in axes:
            slides = axes[force.joint].get("type") == "prismatic"
            more = float(force.sliding if slides else force.turning)
            damping[force.joint] = damping.get(force.joint, 0.0) + more
        elif not isinstance(force, Gravity):
            what = f"{type(force).__name__} on {force.acts_on()}"
            left_out.add("force elements", what)
    for name, value in damping.items():
        ElementTree.SubElement(axes[name], "dynamics", damping=xml_numbers(value), friction="0")
    gravity = sum((f.acceleration for f in system.forces if isinstance(f, Gravity)), np.zeros(3))
    if not np.array_equal(gravity, _USUAL):
        left_out.add("gravity, which readers take as 9.81 m/s^2 down", xml_numbers(gravity))
    apart = lambda a, b: bool(np.any(np.abs(a - b) > _SAME))
    if any(jax.tree.leaves(jax.tree.map(apart, scene.state0, system.reference))):
        left_out.add("the start, which is not the reference posture at rest", "")
    return left_out
