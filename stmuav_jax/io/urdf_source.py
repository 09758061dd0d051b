"""Content of a URDF file that MuJoCo's reader drops silently: loop joints, mimics, unknown elements.

The XML is read here by expat, which opens no other file; a file that declares entities is refused.
"""

import re
from typing import NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from ..checks.errors import ModelError

Element = ElementTree.Element

# Elements that MuJoCo reads, by what they are in; those of visual and collision are shapes.
_READ = {
    "robot": {"link", "joint", "material", "mujoco"},
    "link": {"inertial", "visual", "collision"},
    "inertial": {"origin", "mass", "inertia"},
    "joint": {"origin", "parent", "child", "axis", "dynamics", "limit", "mimic"},
}
# Elements without effect on the motion.
_HARMLESS = {
    "transmission", "gazebo", "sensor", "ros2_control", "calibration", "safety_controller", "verbose",
    "contact", "self_collision_checking", "drake:collision_filter_group",
}  # fmt: skip
_LOOPS = ("loop_joint", "drake:loop_joint")
_KINDS = {
    "continuous": "revolute", "revolute": "revolute", "prismatic": "translational", "fixed": "weld",
    "ball": "spherical", "spherical": "spherical",
}  # fmt: skip


class LoopJoint(NamedTuple):
    """Joint that closes a loop, with its points [m] and frames in its two links; z is its axis."""

    name: str
    kind: str
    links: tuple[str, str]
    points: tuple[np.ndarray, np.ndarray]
    frames: tuple[np.ndarray, np.ndarray]


class Mimic(NamedTuple):
    """Joint whose coordinate is multiplier times that of another one plus an offset."""

    joint: str
    leader: str
    multiplier: str
    offset: str

    def __str__(self) -> str:
        return (
            f"joint '{self.joint}' mimics joint '{self.leader}' (multiplier {self.multiplier}, offset "
            f"{self.offset})"
        )


class UrdfSource(NamedTuple):
    """Content of a URDF beyond what MuJoCo reads.

    Attributes:
        root: name of the link without a parent. loops: joints that close loops.
        mimics: joints that follow others. without_inertial: names of links without <inertial>.
        has_floating_joint: true if a joint of the file lets a link float.
        lost: sentences on constraints and unknown elements that are dropped. notes: others.
    """

    root: str
    loops: tuple[LoopJoint, ...]
    mimics: tuple[Mimic, ...]
    without_inertial: tuple[str, ...]
    has_floating_joint: bool
    lost: tuple[str, ...]
    notes: tuple[str, ...]


def parse_xml(text: bytes) -> Element:
    """Root element of an XML text, with prefixes of names as they are written.

    Raises:
        ModelError: the text is no XML, or declares entities.
    """
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()

    def refuse_entity(*declaration: object) -> None:
        raise ModelError(f"The XML declares the entity '{declaration[0]}': entities are not read.")

    parser.StartElementHandler = lambda tag, attributes: builder.start(tag, attributes)
    parser.EndElementHandler = builder.end
    parser.EntityDeclHandler = refuse_entity
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, ElementTree.ParseError, ValueError, AssertionError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"The XML cannot be read: {error}.") from error


def read_urdf(robot: Element) -> UrdfSource:
    """Content of the element <robot> that MuJoCo's reader drops."""
    links = [link.get("name", "") for link in robot.findall("link")]
    children = {
        child.get("link") for joint in robot.findall("joint") for child in joint.findall("child")
    }
    roots = [name for name in links if name not in children]
    loops, lost, notes = [], [], []
    for element in robot:
        if element.tag not in _LOOPS:
            continue
        try:
            loops.append(_loop_joint(element, set(links)))
        except (ValueError, KeyError) as error:
            lost.append(
                f"Lost, a constraint: the {element.tag} '{element.get('name', '')}' is left out: {error}."
            )
    for tag, owners in _unknown_elements(robot).items():
        owner_names = ", ".join(dict.fromkeys(owners))
        if tag in _HARMLESS:
            notes.append(f"Left out, elements <{tag}>: {owner_names}.")
        else:
            lost.append(f"Lost, unknown elements <{tag}>: {owner_names}.")
    for name in roots[1:]:
        # MuJoCo joins every link without a parent to the world
        lost.append(
            f"The link '{name}' is no joint's child, as the root link '{roots[0]}' is: it is fixed to ground."
        )
    return UrdfSource(
        roots[0] if roots else "",
        tuple(loops),
        tuple(
            Mimic(
                joint.get("name", ""), mimic.get("joint", ""), mimic.get("multiplier", "1"),
                mimic.get("offset", "0"),
            )
            for joint in robot.findall("joint")
            for mimic in joint.findall("mimic")
        ),
        tuple(
            link.get("name", "") for link in robot.findall("link") if link.find("inertial") is None
        ),
        any(joint.get("type") == "floating" for joint in robot.findall("joint")),
        tuple(lost),
        tuple(notes),
    )  # fmt: skip


def _unknown_elements(robot: Element) -> dict[str, list[str]]:
    """Names, or names of the owners, of the elements that are not read, by their tags."""
    unknown: dict[str, list[str]] = {}

    def search_element(element: Element, owner: str) -> None:
        for child in element:
            label = child.get("name") or owner
            if child.tag not in (*_READ[element.tag], *(_LOOPS if element is robot else ())):
                unknown.setdefault(child.tag, []).append(label)
            elif child.tag in _READ:
                search_element(child, label)

    search_element(robot, robot.get("name", "robot"))
    return unknown


def _read_numbers(text: str | None, usual: str) -> np.ndarray:
    """Three finite numbers of an attribute."""
    values = np.array([float(word) for word in (text or usual).split()])
    if values.shape != (3,) or not np.all(np.isfinite(values)):
        raise ValueError(f"'{text}' are not three finite numbers")
    return values


def _loop_joint(element: Element, links: set[str]) -> LoopJoint:
    """Joint of a complete definition; raises `ValueError` in words for another one."""
    name, kind = element.get("name", ""), element.get("type", "")
    if kind not in _KINDS:
        raise ValueError(f"its type is '{kind}', not one of {', '.join(_KINDS)}")
    axis_element = element.find("axis")
    axis = _read_numbers(axis_element.get("xyz") if axis_element is not None else None, "1 0 0")
    if not np.linalg.norm(axis) > 0:
        raise ValueError("its axis is zero")
    z = axis / np.linalg.norm(axis)
    # The coordinate axis that lies most across z gives a product far from zero.
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x = x / np.linalg.norm(x)
    own_frame = np.stack([x, np.cross(z, x), z], axis=1)
    ends = []
    for tag in ("link1", "link2"):
        end = element.find(tag)
        if end is None or end.get("link") not in links:
            raise ValueError(f"its <{tag}> names no link of the robot")
        turn = Rotation.from_euler("xyz", _read_numbers(end.get("rpy"), "0 0 0")).as_matrix()
        ends.append((end.get("link", ""), _read_numbers(end.get("xyz"), "0 0 0"), turn @ own_frame))
    (link_i, point_i, frame_i), (link_j, point_j, frame_j) = ends
    return LoopJoint(name, _KINDS[kind], (link_i, link_j), (point_i, point_j), (frame_i, frame_j))


def massless_body(message: str) -> str | None:
    """Name of the body of which a message of MuJoCo says that it moves without mass."""
    match = re.search(r"mjMINVAL.*?Element name '([^']*)'", message, re.DOTALL)
    return match.group(1) if match else None
