"""Systems as models of MuJoCo: MJCF text with the spanning tree as bodies and loops as equalities.

MuJoCo itself is not needed. Its loops are soft constraints, which hold within what their `solref`
and `solimp` allow; here they are its defaults.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax
import numpy as np

from ..algebra.rotation import from_matrix
from ..checks.errors import SettingError
from ..checks.numbers import floats
from ..dynamics.scene import Scene
from ..dynamics.tree.topology import Link, spanning_tree
from ..mechanics.body import GROUND
from ..mechanics.forces.applied import (
    Gravity,
    JointDamping,
    LinearSpringDamper,
    TorsionalSpringDamper,
)
from ..mechanics.forces.effort import JointEffort
from ..mechanics.forces.joint import JointServo
from ..mechanics.joint import CATALOGUE, Joint
from ..mechanics.joint_states import joint_motion
from ..mechanics.state import State
from ..mechanics.system import System
from .mujoco_left_out import LeftOut
from .netcdf import write_atomically

Element = ElementTree.Element

# Distance of the two points that hold the axis of a revolute joint in a loop [m].
_APART = 0.1
# Largest difference from the reference posture, at rest, that is no start of its own.
_SAME = 1e-15
_TREE = ("weld", "revolute", "translational", "cylindrical", "spherical", "universal")
_LOOPS = ("spherical", "weld", "revolute")


class _Draft(NamedTuple):
    """Parts of the document while it is written."""

    system: System
    bodies: dict[str, Element]
    axes: dict[str, Element]
    tendons: Element
    equalities: Element
    actuators: Element
    left_out: LeftOut

    def site(self, body: str, name: str, pos: Any, frame: Any = None) -> str:
        """Name of a new site at a point of a body, with the axes of a frame."""
        site = ElementTree.SubElement(self.bodies[body], "site", name=name, pos=xml_numbers(pos))
        if frame is not None:
            site.set("quat", xml_numbers(from_matrix(frame)))
        return name


def save_mjcf(scene: Scene, path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write a scene's system as an MJCF file; the sentences on what is left out.

    MuJoCo's `qpos0` has all joint coordinates of the spanning tree at zero. Joints keep their names;
    a universal or a cylindrical joint becomes two, with _1 and _2. Efforts and servos are actuators.
    A start that is not the reference posture at rest is the keyframe "start".

    Raises:
        SettingError: a joint has no counterpart: a driver, a screw, or a loop that is closed by
            another joint than a spherical or revolute one or a weld.
    """
    text, left_out = _document(scene)
    write_atomically(Path(path), text.encode())
    return left_out


def _document(scene: Scene) -> tuple[str, tuple[str, ...]]:
    system, tree = scene.system, spanning_tree(scene.system)
    cut = [system.joints[k] for k in tree.cut]
    kept = [system.joints[link.joint] for link in tree.links if link.joint is not None]
    for joints, kinds, where in ((cut, _LOOPS, "that closes a loop"), (kept, _TREE, "of a tree")):
        for joint in joints:
            if joint.kind not in kinds:
                raise SettingError(
                    f"MJCF has no counterpart of joint '{joint.name}', a {joint.kind} joint {where}; "
                    f"there it has: {', '.join(kinds)}."
                )
    root = Element("mujoco", model=scene.name)
    ElementTree.SubElement(root, "compiler", angle="radian")
    gravity = sum((f.acceleration for f in system.forces if isinstance(f, Gravity)), np.zeros(3))
    ElementTree.SubElement(root, "option", gravity=xml_numbers(gravity))
    world = ElementTree.SubElement(root, "worldbody")
    tendons, equalities, actuators = (
        ElementTree.SubElement(root, name) for name in ("tendon", "equality", "actuator")
    )
    draft = _Draft(system, {GROUND: world}, {}, tendons, equalities, actuators, LeftOut({}))
    if tree.floating:
        _free(draft, tree.root)
    for link in tree.links:
        if link.joint is None:
            _free(draft, link.child)
        else:
            _linked(draft, link)
    for joint in cut:
        _loop(draft, joint)
    for force in system.forces:
        write = _WRITERS.get(type(force))
        if not isinstance(force, Gravity) and not (write and write(draft, force)):
            what = f"{type(force).__name__} on {force.acts_on()}"
            draft.left_out.add("force elements", what)
    _keyframe(root, scene)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n", draft.left_out.sentences()


def xml_numbers(numbers: Any) -> str:
    """Text of numbers in an attribute, each with all its digits."""
    return " ".join(repr(x) for x in np.atleast_1d(np.asarray(numbers, float)).tolist())


def _body(draft: _Draft, k: int, parent: str, pos: Any, quat: Any) -> Element:
    name, bodies = draft.system.names[k], draft.system.bodies
    place = {"name": name, "pos": xml_numbers(pos), "quat": xml_numbers(quat)}
    body = ElementTree.SubElement(draft.bodies[parent], "body", place)
    J = np.asarray(bodies.inertia[k])
    full = xml_numbers([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]])
    inertial = {
        "pos": xml_numbers(bodies.com[k]),
        "mass": xml_numbers(bodies.mass[k]),
        "fullinertia": full,
    }
    ElementTree.SubElement(body, "inertial", inertial)
    draft.bodies[name] = body
    return body


def _free(draft: _Draft, k: int) -> None:
    """Add a body that floats, at its reference posture."""
    system = draft.system
    kin = system.kinematics(system.reference)
    place = kin.point(system.names[k], floats((0.0, 0.0, 0.0)))[0]
    body = _body(draft, k, GROUND, place, system.reference.p[k])
    ElementTree.SubElement(body, "freejoint", name=f"{system.names[k]}_free")


def _linked(draft: _Draft, link: Link) -> None:
    """Add the body behind a joint of the tree, whose frames coincide where it is zero."""
    system = draft.system
    names = (*system.names, GROUND)
    joint = system.joints[link.joint or 0]
    sides = [(joint.point_i, joint.frame_i), (joint.point_j, joint.frame_j)]
    (point, frame), (own, axes) = (
        [np.asarray(x) for x in side] for side in (sides if link.forward else sides[::-1])
    )
    turn = frame @ axes.T
    body = _body(draft, link.child, names[link.parent], point - turn @ own, from_matrix(turn))
    if joint.kind == "spherical":
        ball = {"name": joint.name, "type": "ball", "pos": xml_numbers(own)}
        draft.axes[joint.name] = ElementTree.SubElement(body, "joint", ball)
        return
    freedoms = CATALOGUE[joint.kind].motion or ()
    sign = 1.0 if link.forward else -1.0
    for number, freedom in enumerate(freedoms if link.forward else freedoms[::-1]):
        turns = freedom.motion.columns[0].angular
        mine = ElementTree.SubElement(body, "joint", {
            "name": joint.name if len(freedoms) == 1 else f"{joint.name}_{number + 1}",
            "type": "hinge" if turns else "slide",
            "pos": xml_numbers(own),
            "axis": xml_numbers(sign * axes[:, freedom.axis]),
        })  # fmt: skip
        which = "" if len(freedoms) == 1 else " angle" if turns else " displacement"
        draft.axes.setdefault(joint.name + which, mine)


def _keyframe(root: Element, scene: Scene) -> None:
    """Add the start as a keyframe, in MuJoCo's order of the joints, unless it is the reference at rest."""
    system, state, rest = scene.system, scene.state0, scene.system.reference
    same = jax.tree.map(lambda a, b: bool(np.all(np.abs(a - b) <= _SAME)), state, rest)
    if all(jax.tree.leaves(same)):
        return
    place: list[float] = []
    speed: list[float] = []
    body = GROUND
    for element in root.iter():
        if element.tag == "body":
            body = str(element.get("name"))
        if element.tag == "freejoint":
            kin = system.kinematics(state)
            r, v = kin.point(body, floats((0.0, 0.0, 0.0)))
            k = system.index(body)
            place += [*r.tolist(), *state.p[k].tolist()]
            speed += [*v.tolist(), *state.omega[k].tolist()]
        elif element.tag == "joint" and element.get("type") == "ball":
            q, u = _turned(system, state, str(element.get("name")), body)
            place += q
            speed += u
        elif element.tag == "joint" and element.get("type") in ("hinge", "slide"):
            name = str(element.get("name"))
            known = {joint.name for joint in system.joints}
            number = 0 if name in known else int(name[-1]) - 1
            name = name if name in known else name[:-2]
            found = joint_motion(system, state, name)
            if body == system.joints[system.joint_index(name)].body_i:
                number = found.coordinates.shape[0] - 1 - number
            place.append(float(found.coordinates[number]))
            speed.append(float(found.rates[number]))
    frame = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(
        frame, "key", name="start", qpos=xml_numbers(place), qvel=xml_numbers(speed)
    )


def _turned(system: System, state: State, name: str, child: str) -> tuple[list[float], list[float]]:
    """Quaternion (4,) and angular velocity (3,) of the body behind a ball, in its own axes."""
    joint = system.joints[system.joint_index(name)]
    ends = {joint.body_i: joint.frame_i, joint.body_j: joint.frame_j}
    parent = joint.body_i if child == joint.body_j else joint.body_j
    kin = system.kinematics(state)
    R, R_parent = (np.asarray(kin.R_wb[kin.index(one)]) for one in (child, parent))
    first = np.asarray(ends[parent]) @ np.asarray(ends[child]).T
    turn = from_matrix(first.T @ R_parent.T @ R)
    omega = R.T @ np.asarray(kin.omega_w[kin.index(child)] - kin.omega_w[kin.index(parent)])
    return np.asarray(turn).tolist(), omega.tolist()


def _loop(draft: _Draft, joint: Joint) -> None:
    """Add the equality constraints of a joint that closes a loop."""
    ends = (
        (joint.body_i, np.asarray(joint.point_i), np.asarray(joint.frame_i), "i"),
        (joint.body_j, np.asarray(joint.point_j), np.asarray(joint.frame_j), "j"),
    )
    shifts = (0.0, _APART) if joint.kind == "revolute" else (0.0,)
    for number, shift in enumerate(shifts):
        name = joint.name if not number else f"{joint.name}_axis"
        sites = [
            draft.site(body, f"{name}_{side}", point + shift * frame[:, 2], frame)
            for body, point, frame, side in ends
        ]
        tag = "weld" if joint.kind == "weld" else "connect"
        place = {"name": name, "site1": sites[0], "site2": sites[1]}
        ElementTree.SubElement(draft.equalities, tag, place)


# --- force elements: each writer returns False for what it cannot write


def _axis(draft: _Draft, name: str, which: str | None) -> Element | None:
    """Hinge or slide of a coordinate of a joint in the tree."""
    found = draft.axes.get(name)
    found = draft.axes.get(f"{name} {which}") if found is None else found
    return None if found is None or found.get("type") == "ball" else found


def _add_damping(axis: Element, damping: Any) -> None:
    axis.set("damping", xml_numbers(float(axis.get("damping", "0")) + float(damping)))


def _spring(draft: _Draft, force: TorsionalSpringDamper) -> bool:
    axis = _axis(draft, force.joint, "angle")
    if axis is None or axis.get("stiffness"):
        return False
    axis.set("stiffness", xml_numbers(force.stiffness))
    axis.set("springref", xml_numbers(force.angle))
    _add_damping(axis, force.damping)
    return True


def _damping(draft: _Draft, force: JointDamping) -> bool:
    axis = draft.axes.get(force.joint)
    if axis is None:
        return False
    slides = axis.get("type") == "slide"
    _add_damping(axis, force.sliding if slides else force.turning)
    return True


def _line(draft: _Draft, force: LinearSpringDamper) -> bool:
    name = f"spring_{len(draft.tendons) + 1}"
    ends = ((force.body_i, force.point_i, "i"), (force.body_j, force.point_j, "j"))
    tendon = ElementTree.SubElement(draft.tendons, "spatial", {
        "name": name, "stiffness": xml_numbers(force.stiffness), "damping": xml_numbers(force.damping),
        "springlength": xml_numbers(force.length),
    })  # fmt: skip
    for body, point, side in ends:
        site = draft.site(body, f"{name}_{side}", point)
        ElementTree.SubElement(tendon, "site", site=site)
    return True


def _effort(draft: _Draft, force: JointEffort) -> bool:
    return _actuator(draft, force, "motor", "effort", force.effort)


def _servo(draft: _Draft, force: JointServo) -> bool:
    numbers = {"kp": xml_numbers(force.stiffness), "kv": xml_numbers(force.damping)}
    return _actuator(draft, force, "position", "target", force.target, numbers)


def _actuator(
    draft: _Draft,
    force: JointEffort | JointServo,
    tag: str,
    what: str,
    value: Any,
    numbers: dict[str, str] | None = None,
) -> bool:
    """Write an actuator of a joint's axis, named by what its control is; false if there is no axis."""
    axis = _axis(draft, force.joint, force.coordinate)
    if axis is None:
        return False
    name = f"{what}_{axis.get('name')}"
    given = {"name": name, "joint": str(axis.get("name"))} | (numbers or {})
    ElementTree.SubElement(draft.actuators, tag, given)
    _value(draft, name, value)
    return True


def _value(draft: _Draft, name: str, value: Any) -> None:
    """Note the value of an input that is not zero: MJCF has none for an actuator's control."""
    if callable(value) or float(value) != 0:
        shown = "a function of time" if callable(value) else repr(float(value))
        draft.left_out.add("values of controls", f"{name} = {shown}")


_WRITERS: dict[type, Callable[[_Draft, Any], bool]] = {
    TorsionalSpringDamper: _spring,
    JointDamping: _damping,
    LinearSpringDamper: _line,
    JointEffort: _effort,
    JointServo: _servo,
}
