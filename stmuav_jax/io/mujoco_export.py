"""Systems as models of MuJoCo: MJCF text with the spanning tree as bodies and loops as equalities.

MuJoCo itself is not needed. Its loops are soft constraints, which hold within what their `solref`
and `solimp` allow: the file has hard ones, with the Runge-Kutta method and a step at which they are stable, so
that its motion is that of the system without options of the reader. (At a longer step MuJoCo takes a `solref` of
two steps.)
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax
import numpy as np

from ..checks.errors import SettingError
from ..checks.numbers import as_floats
from ..dynamics.simulation import Scene
from ..dynamics.tree.topology import Link, spanning_tree
from ..math.rotation import from_matrix
from ..mechanics.body import GROUND
from ..mechanics.forces import Gravity, JointDamping, LinearSpringDamper, TorsionalSpringDamper
from ..mechanics.joint import CATALOGUE, Joint
from ..mechanics.joint_forces import JointEffort, JointServo
from ..mechanics.joint_states import joint_motion
from ..mechanics.state import State
from ..mechanics.system import System
from ..uav.motor import MotorRotors
from ..uav.rotor import Rotors
from .netcdf import write_atomically

Element = ElementTree.Element

# Distance of the two points that hold the axis of a revolute joint in a loop [m].
_APART = 0.1
# Largest number of names in one sentence.
_SHOWN = 12
# Step [s] and integrator of the file, and time constant [s], damping ratio and impedance of its loops.
_OPTIONS = {"timestep": "1e-4", "integrator": "RK4"}
_HARD = {"solref": "2e-4 1", "solimp": "0.9999 0.9999 0.001"}
# Largest difference from the reference posture, at rest, that is no start of its own.
_SAME = 1e-15
_TREE = ("weld", "revolute", "translational", "cylindrical", "spherical", "universal")
_LOOPS = ("spherical", "weld", "revolute", *(k for k in CATALOGUE if k.startswith("mimic")))


class LeftOut(NamedTuple):
    """Names of things that were left out, by what they are; and sentences on lost constraints.

    A lost constraint is more than a note: the degrees of freedom are not those of the model.
    """

    names: dict[str, list[str]]
    lost: list[str]

    def add(self, kind: str, name: str) -> None:
        """Add one name, or "" for a thing without one."""
        self.names.setdefault(kind, []).append(name)

    def sentences(self) -> tuple[str, ...]:
        """One sentence for each kind of thing."""
        lines = []
        for feature, names in self.names.items():
            nonempty_names = [name for name in names if name]
            more = (
                f" and {len(nonempty_names) - _SHOWN} more" if len(nonempty_names) > _SHOWN else ""
            )
            listed = f": {', '.join(nonempty_names[:_SHOWN])}{more}" if nonempty_names else ""
            lines.append(f"Left out, {feature}{listed}.")
        return tuple(lines)


class _Draft(NamedTuple):
    """Parts of the document while it is written."""

    system: System
    bodies: dict[str, Element]
    axes: dict[str, Element]
    tendons: Element
    equalities: Element
    actuators: Element
    controls: list[float]
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
    a universal or a cylindrical joint becomes two, with _1 and _2. Efforts, servos and rotors are actuators,
    whose controls are the inputs. A start that is not the reference posture at rest, with inputs of zero,
    is the keyframe "start".

    Raises:
        SettingError: a joint has no counterpart: a driver, a screw, or a loop that is closed by
            another joint than a spherical or revolute one, a weld or a coupling.
    """
    text, left_out = _write_document(scene)
    write_atomically(Path(path), text.encode())
    return left_out


def _write_document(scene: Scene) -> tuple[str, tuple[str, ...]]:
    system = scene.system
    # MuJoCo's free body comes first when the file is read, where missions look for the rotors
    carriers = [f.rotors.body for f in system.forces if isinstance(f, Rotors | MotorRotors)]
    tree = spanning_tree(system, base=next(iter(carriers), None))
    cut = [system.joints[k] for k in tree.cut]
    tree_joints = [system.joints[link.joint] for link in tree.links if link.joint is not None]
    rules = ((cut, _LOOPS, "that closes a loop"), (tree_joints, _TREE, "of a tree"))
    for joints, kinds, where in rules:
        for joint in joints:
            if joint.kind not in kinds:
                raise SettingError(
                    f"MJCF has no counterpart of joint '{joint.name}', a {joint.kind} joint {where}; "
                    f"there it has: {', '.join(kinds)}."
                )
    root = Element("mujoco", model=scene.name)
    ElementTree.SubElement(root, "compiler", angle="radian")
    # MuJoCo has one gravity for the world, to which several elements add up.
    gravity = sum((f.acceleration for f in system.forces if isinstance(f, Gravity)), np.zeros(3))
    ElementTree.SubElement(root, "option", {"gravity": xml_numbers(gravity)} | _OPTIONS)
    world = ElementTree.SubElement(root, "worldbody")
    tendons, equalities, actuators = (
        ElementTree.SubElement(root, name) for name in ("tendon", "equality", "actuator")
    )
    draft = _Draft(system, {GROUND: world}, {}, tendons, equalities, actuators, [], LeftOut({}, []))
    if tree.floating:
        _add_free(draft, tree.root)
    for link in tree.links:
        if link.joint is None:
            _add_free(draft, link.child)
        else:
            _add_linked(draft, link)
    for joint in cut:
        _add_loop(draft, joint)
    for force in system.forces:
        write = _WRITERS.get(type(force))
        if not isinstance(force, Gravity) and not (write and write(draft, force)):
            force_name = f"{type(force).__name__} on {force.acts_on()}"
            draft.left_out.add("force elements", force_name)
    _add_keyframe(root, scene, draft.controls)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n", draft.left_out.sentences()


def xml_numbers(numbers: Any) -> str:
    """Text of numbers in an attribute, each with all its digits."""
    return " ".join(repr(x) for x in np.atleast_1d(np.asarray(numbers, float)).tolist())


def _add_body(draft: _Draft, k: int, parent: str, pos: Any, quat: Any) -> Element:
    name, bodies = draft.system.names[k], draft.system.bodies
    place = {"name": name, "pos": xml_numbers(pos), "quat": xml_numbers(quat)}
    body = ElementTree.SubElement(draft.bodies[parent], "body", place)
    J = np.asarray(bodies.inertia[k])
    # The full tensor avoids a principal-axes rotation, whose order is not unique for symmetric bodies.
    full = xml_numbers([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]])
    inertial = {"pos": xml_numbers(bodies.com[k]), "mass": xml_numbers(bodies.mass[k])}
    ElementTree.SubElement(body, "inertial", inertial | {"fullinertia": full})
    draft.bodies[name] = body
    return body


def _add_free(draft: _Draft, k: int) -> None:
    """Add a body that floats, at its reference posture."""
    system = draft.system
    kin = system.kinematics(system.reference)
    place = kin.point(system.names[k], as_floats((0.0, 0.0, 0.0)))[0]
    body = _add_body(draft, k, GROUND, place, system.reference.p[k])
    ElementTree.SubElement(body, "freejoint", name=f"{system.names[k]}_free")


def _add_linked(draft: _Draft, link: Link) -> None:
    """Add the body behind a joint of the tree, whose frames coincide where it is zero."""
    system = draft.system
    names = (*system.names, GROUND)
    joint = system.joints[link.joint or 0]
    sides = [(joint.point_i, joint.frame_i), (joint.point_j, joint.frame_j)]
    (point, frame), (child_point, axes) = (
        [np.asarray(x) for x in side] for side in (sides if link.forward else sides[::-1])
    )
    # At zero of the joint the frames on both bodies coincide, which is MuJoCo's convention for qpos0.
    turn = frame @ axes.T
    body = _add_body(
        draft, link.child, names[link.parent], point - turn @ child_point, from_matrix(turn)
    )
    if joint.kind == "spherical":
        ball = {"name": joint.name, "type": "ball", "pos": xml_numbers(child_point)}
        draft.axes[joint.name] = ElementTree.SubElement(body, "joint", ball)
        return
    freedoms = CATALOGUE[joint.kind].motion or ()
    # A joint that the tree passes from body j to body i turns in the opposite sense.
    sign = 1.0 if link.forward else -1.0
    for number, freedom in enumerate(freedoms if link.forward else freedoms[::-1]):
        turns = freedom.motion.columns[0].angular
        joint_element = ElementTree.SubElement(body, "joint", {
            "name": joint.name if len(freedoms) == 1 else f"{joint.name}_{number + 1}",
            "type": "hinge" if turns else "slide",
            "pos": xml_numbers(child_point),
            "axis": xml_numbers(sign * axes[:, freedom.axis]),
        })  # fmt: skip
        coordinate_suffix = "" if len(freedoms) == 1 else " angle" if turns else " displacement"
        draft.axes.setdefault(joint.name + coordinate_suffix, joint_element)


def _add_keyframe(root: Element, scene: Scene, controls: list[float]) -> None:
    """Add start and controls as a keyframe, in MuJoCo's order, unless it is the reference at rest without them."""
    system, state, rest = scene.system, scene.state0, scene.system.reference
    same = jax.tree.map(lambda a, b: bool(np.all(np.abs(a - b) <= _SAME)), state, rest)
    if all(jax.tree.leaves(same)) and not any(controls):
        return
    place: list[float] = []
    speed: list[float] = []
    body = GROUND
    for element in root.iter():
        if element.tag == "body":
            body = str(element.get("name"))
        if element.tag == "freejoint":
            kin = system.kinematics(state)
            r, v = kin.point(body, as_floats((0.0, 0.0, 0.0)))
            k = system.index(body)
            place += [*r.tolist(), *state.p[k].tolist()]
            speed += [*v.tolist(), *state.omega[k].tolist()]
        elif element.tag == "joint" and element.get("type") == "ball":
            q, u = _relative_turn(system, state, str(element.get("name")), body)
            place += q
            speed += u
        elif element.tag == "joint" and element.get("type") in ("hinge", "slide"):
            name = str(element.get("name"))
            joint_names = {joint.name for joint in system.joints}
            number = 0 if name in joint_names else int(name[-1]) - 1
            name = name if name in joint_names else name[:-2]
            motion = joint_motion(system, state, name)
            if body == system.joints[system.joint_index(name)].body_i:
                number = motion.coordinates.shape[0] - 1 - number
            place.append(float(motion.coordinates[number]))
            speed.append(float(motion.rates[number]))
    key = {"name": "start", "qpos": xml_numbers(place), "qvel": xml_numbers(speed)}
    if any(controls):
        key["ctrl"] = xml_numbers(controls)
    frame = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(frame, "key", key)


def _relative_turn(
    system: System, state: State, name: str, child: str
) -> tuple[list[float], list[float]]:
    """Quaternion (4,) and angular velocity (3,) of the body behind a ball, in its own axes."""
    joint = system.joints[system.joint_index(name)]
    ends = {joint.body_i: joint.frame_i, joint.body_j: joint.frame_j}
    parent = joint.body_i if child == joint.body_j else joint.body_j
    kin = system.kinematics(state)
    R, R_parent = (np.asarray(kin.R_wb[kin.index(body)]) for body in (child, parent))
    first = np.asarray(ends[parent]) @ np.asarray(ends[child]).T
    turn = from_matrix(first.T @ R_parent.T @ R)
    omega = R.T @ np.asarray(kin.omega_w[kin.index(child)] - kin.omega_w[kin.index(parent)])
    return np.asarray(turn).tolist(), omega.tolist()


def _add_loop(draft: _Draft, joint: Joint) -> None:
    """Add the equality constraints of a joint that closes a loop, or of a coupling."""
    if joint.mate is not None:
        names = (joint.mate.dependent, joint.mate.joint.name)
        axes = [_add_axis(draft, *pair) for pair in zip(names, joint.mate.coordinates, strict=True)]
        if None in axes:
            raise SettingError(
                f"MJCF has no counterpart of the coupling '{joint.name}', because one of its joints closes a loop."
            )
        dependent, mate = (str(axis.get("name")) for axis in axes if axis is not None)
        polynomial = xml_numbers([joint.mate.offset, joint.mate.ratio, 0.0, 0.0, 0.0])
        ends = {"name": joint.name, "joint1": dependent, "joint2": mate, "polycoef": polynomial}
        ElementTree.SubElement(draft.equalities, "joint", ends | _HARD)
        return
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
        ElementTree.SubElement(draft.equalities, tag, place | _HARD)


# --- force elements: each writer returns False for what it cannot write


def _add_axis(draft: _Draft, name: str, coordinate: str | None) -> Element | None:
    """Hinge or slide of a coordinate of a joint in the tree."""
    element = draft.axes.get(name)
    element = draft.axes.get(f"{name} {coordinate}") if element is None else element
    return None if element is None or element.get("type") == "ball" else element


def _add_damping(axis: Element, damping: Any) -> None:
    axis.set("damping", xml_numbers(float(axis.get("damping", "0")) + float(damping)))


def _add_spring(draft: _Draft, force: TorsionalSpringDamper) -> bool:
    axis = _add_axis(draft, force.joint, "angle")
    if axis is None or axis.get("stiffness"):
        return False
    axis.set("stiffness", xml_numbers(force.stiffness))
    axis.set("springref", xml_numbers(force.angle))
    _add_damping(axis, force.damping)
    return True


def _add_joint_damping(draft: _Draft, force: JointDamping) -> bool:
    axis = draft.axes.get(force.joint)
    if axis is None:
        return False
    slides = axis.get("type") == "slide"
    _add_damping(axis, force.sliding if slides else force.turning)
    return True


def _add_line(draft: _Draft, force: LinearSpringDamper) -> bool:
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


def _add_actuator(draft: _Draft, force: JointEffort | JointServo) -> bool:
    """Write an actuator of a joint's axis, named by what its control is; false if there is no axis."""
    axis = _add_axis(draft, force.joint, force.coordinate)
    if axis is None:
        return False
    is_servo = isinstance(force, JointServo)
    name = f"{'target' if is_servo else 'effort'}_{axis.get('name')}"
    attributes = {"name": name, "joint": str(axis.get("name"))}
    if is_servo:
        attributes |= {"kp": xml_numbers(force.stiffness), "kv": xml_numbers(force.damping)}
    if force.limit is not None:
        limits = xml_numbers([-force.limit, force.limit])
        attributes |= {"forcelimited": "true", "forcerange": limits}
    ElementTree.SubElement(draft.actuators, "position" if is_servo else "motor", attributes)
    _set_control(draft, name, force.target if is_servo else force.effort)
    return True


def _set_control(draft: _Draft, name: str, value: Any) -> None:
    """Add the value of an actuator's control to the keyframe; note a function of time, which MJCF lacks."""
    if callable(value):
        draft.left_out.add("values of controls", f"{name} = a function of time")
    draft.controls.append(0.0 if callable(value) else float(value))


def _add_rotors(draft: _Draft, force: Rotors | MotorRotors) -> bool:
    """Write an actuator for each rotor, whose control is the squared speed, at a site of its body."""
    rotors = force.rotors
    if rotors.has_curves:
        # both parts of an actuator's wrench grow alike with its one control
        draft.left_out.add(
            "rotors whose thrust or torque is not proportional to the squared speed", rotors.body
        )
        return True
    limits = None
    if isinstance(force, MotorRotors):
        limits = force.squared_limits
        if force.time_constant is not None or force.inertia is not None:
            draft.left_out.add("lag and inertia of the motors of rotors", rotors.body)
    first = len(draft.bodies[rotors.body].findall("site"))
    for k, (arm, spin) in enumerate(zip(np.asarray(rotors.arms), rotors.spin, strict=True)):
        number = f"{rotors.body}_{first + k + 1}"
        u = rotors.speed_squared
        name = f"speed_squared_{number}"
        gear = [0.0, 0.0, float(rotors.k_f), 0.0, 0.0, float(-spin * rotors.k_tau)]
        attributes = {
            "name": name,
            "site": draft.site(rotors.body, f"rotor_{number}", arm),
            "gear": xml_numbers(gear),
        }
        if limits is not None:
            attributes["ctrllimited"] = "true"
            attributes["ctrlrange"] = xml_numbers([limits[0][k], limits[1][k]])
        ElementTree.SubElement(draft.actuators, "motor", attributes)
        _set_control(draft, name, u if callable(u) else np.asarray(u)[k])
    return True


_WRITERS: dict[type, Callable[[_Draft, Any], bool]] = {
    TorsionalSpringDamper: _add_spring,
    JointDamping: _add_joint_damping,
    LinearSpringDamper: _add_line,
    JointEffort: _add_actuator,
    JointServo: _add_actuator,
    Rotors: _add_rotors,
    MotorRotors: _add_rotors,
}
