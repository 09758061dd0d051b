"""Shapes in which the bodies of a run are drawn, derived from its dimensions.

    with rotors              hub, and an arm and a motor for every rotor
    two joints apart         a rod between their points, as thick as its inertia tensor says
    any other                the solid of uniform density that has its mass and inertia tensor,
                             and a strut to every joint outside of it

The solid is a sphere where the three principal moments are equal, a cylinder where two are, and
else a box. A body whose name contains "panel" is a box with solar cells on its upper side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from ..mechanics.body import GROUND
from .run import SLIDING, displacement_of, motion_of

# Colours of bodies; those of a base with rotors, panels, joints and rotors.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#F0E442")
_BASE, _PANEL, JOINT_COLOUR, _ROTOR = "#8b929c", "#1d3f72", "#69717d", "#c3c8d0"
# Relative difference below which two principal moments count as equal; products of inertia below
# this part of the largest moment leave the solid along the body's own axes.
_EQUAL = 0.05
# Radius of a rod relative to its length: least and largest that is drawn.
_SLENDER = (0.012, 0.12)

Points = Float[np.ndarray, "k 3"]


@dataclass(frozen=True)
class Shape:
    """Solid fixed in a body.

    Attributes:
        kind: "box" or "panel" with size (x, y, z) [m]; "cylinder" with (radius, length along z) [m];
            "sphere" with (radius,) [m].
        size: see kind.
        position: centre of the solid from the body's centre of mass, body axes (3,) [m].
        orientation: unit Euler parameters from the solid's axes to the body's (4,).
    """

    kind: Literal["box", "panel", "cylinder", "sphere"]
    size: tuple[float, ...]
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    orientation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Shape as plain numbers and texts."""
        numbers = lambda x: [float(f"{float(value):.6g}") for value in x]
        return {
            "kind": self.kind, "size": numbers(self.size), "position": numbers(self.position),
            "orientation": numbers(self.orientation),
        }  # fmt: skip


def body_shapes(run: xr.Dataset, body: str) -> tuple[Shape, ...]:
    """Shapes of one body of a saved run, by the rules at the head of this module."""
    k = list(run["body"].values).index(body)
    mass, inertia = float(run["mass"][k]), run["inertia"].values[k]
    rotors = rotor_points(run, body)
    if len(rotors):
        return _rotorcraft_shapes(rotors)
    points, sliding = joint_points(run, body)
    distinct_points = _distinct_points(points)
    # Two joints are the ends of a rod; a slider's point moves along it and is no end.
    if len(distinct_points) == 2 and not sliding:
        length = float(np.linalg.norm(distinct_points[1] - distinct_points[0]))
        # Radius of a cylinder with this moment about its axis.
        thin = float(np.sqrt(2 * np.linalg.eigvalsh(inertia)[0] / mass))
        least, most = (length * part for part in _SLENDER)
        return (rod(distinct_points[0], distinct_points[1], min(max(thin, least), most)),)
    solid = inertia_solid(mass, inertia, kind="panel" if "panel" in body.lower() else None)
    halves = [0.5 * x for x in solid.size]
    if solid.kind in ("sphere", "cylinder"):
        halves[0] = solid.size[0]
    ends = [(point, float(np.linalg.norm(point))) for point in distinct_points]
    struts = [rod(np.zeros(3), end, 0.02 * d) for end, d in ends if d > 1.05 * max(halves)]
    return (solid, *struts)


def joint_points(run: xr.Dataset, body: str) -> tuple[Points, bool]:
    """Points of all joints on a body from its centre of mass (k, 3) [m], and whether it slides.

    A body slides if it is the second of a joint that slides.
    """
    com = body_centre(run, body)
    points, sliding = [], False
    for k in range(run.sizes.get("joint", 0)):
        for side in ("i", "j"):
            if str(run[f"joint_body_{side}"].values[k]) == body:
                points.append(run[f"joint_point_{side}"].values[k] - com)
                sliding |= side == "j" and str(run["joint_kind"].values[k]) in SLIDING
    return np.array(points).reshape(-1, 3), sliding


def rotor_points(run: xr.Dataset, body: str) -> Points:
    """Positions of the rotors on a body from its centre of mass (k, 3) [m]."""
    if "rotor_position" not in run:
        return np.zeros((0, 3))
    mine = run["rotor_body"].values == body
    return run["rotor_position"].values[mine] - body_centre(run, body)


def body_centre(run: xr.Dataset, body: str) -> Float[np.ndarray, "3"]:
    """Centre of mass of a body in its reference frame (3,) [m]; zero for ground."""
    if body == GROUND:
        return np.zeros(3)
    return run["centre_of_mass"].values[list(run["body"].values).index(body)]


def inertia_solid(mass: float, inertia: Float[np.ndarray, "3 3"], kind: str | None = None) -> Shape:
    """Solid of uniform density with a given mass [kg] and inertia tensor (3, 3) [kg m^2].

        box with edges a:  m (a_y^2 + a_z^2) / 12 = J_x;  cylinder: m r^2 / 2 = J_z;  sphere: 2 m r^2 / 5

    An edge whose square would be negative, since a printed tensor was rounded, is a hundredth of
    the longest.

    Args:
        kind: "panel" for a box with solar cells; default as the tensor says.
    """
    moments, R = np.diag(inertia), np.eye(3)
    # Nearly diagonal tensors keep the body's axes, as eigenvectors of almost equal moments have no
    # direction of their own.
    if np.max(np.abs(inertia - np.diag(moments))) > _EQUAL * np.max(moments):
        moments, R = np.linalg.eigh(inertia)
        # Eigenvectors may be a reflection, which no orientation is.
        R = R * np.sign(np.linalg.det(R))
    gaps = np.abs(np.roll(moments, -1) - np.roll(moments, -2))
    equal = (gaps <= _EQUAL * np.max(moments)).tolist()
    if kind is None and all(equal):
        return Shape("sphere", (float(np.sqrt(2.5 * np.mean(moments) / mass)),))
    # From m (b^2 + c^2) / 12 about each axis: the edges of a uniform box follow from three moments.
    squares = 6 * (np.sum(moments) - 2 * moments) / mass
    edges = np.sqrt(np.maximum(squares, 1e-4 * np.max(squares)))
    if kind is None and any(equal):
        symmetry_axis = equal.index(True)
        turn = turn_towards(R[:, symmetry_axis])
        radius, length = np.sqrt(2 * moments[symmetry_axis] / mass), edges[symmetry_axis]
        return Shape("cylinder", (float(radius), float(length)), orientation=turn)
    size = tuple(float(edge) for edge in edges)
    x, y, z, w = map(float, Rotation.from_matrix(R).as_quat())
    return Shape("panel" if kind == "panel" else "box", size, orientation=(w, x, y, z))


def make_quads(shape: Shape) -> Float[np.ndarray, "f 4 3"]:
    """Quadrilaterals of a shape's surface, body axes (f, 4, 3) [m]; those at a pole are triangles."""
    if shape.kind in ("box", "panel"):
        face = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) / 2
        pairs = [
            (np.roll(face, k, axis=1), np.roll(face * [1, 1, -1], k, axis=1)) for k in range(3)
        ]
        local = np.concatenate(pairs) * np.array(shape.size)
    else:
        if shape.kind == "sphere":
            polar = np.linspace(np.pi, 0.0, 7)
            radii, heights = shape.size[0] * np.sin(polar), shape.size[0] * np.cos(polar)
        else:
            # Matplotlib sorts faces by their distance from the eye: long ones are in several pieces
            count = int(np.clip(round(shape.size[1] / (6 * shape.size[0])), 1, 8)) + 1
            radii = shape.size[0] * np.concatenate([[0.0], np.ones(count), [0.0]])
            heights = shape.size[1] * np.pad(np.linspace(-0.5, 0.5, count), 1, mode="edge")
        angle = np.linspace(0.0, 2 * np.pi, 17)
        x, y = radii[:, None] * np.cos(angle), radii[:, None] * np.sin(angle)
        rings = np.stack([x, y, np.broadcast_to(heights[:, None], x.shape)], axis=2)
        low, high = rings[:-1], rings[1:]
        quads = [low[:, :-1], low[:, 1:], high[:, 1:], high[:, :-1]]
        local = np.stack(quads, axis=2).reshape(-1, 4, 3)
    w, *v = shape.orientation
    return np.asarray(shape.position) + local @ Rotation.from_quat([*v, w]).as_matrix().T


def _rotorcraft_shapes(rotors: Points) -> tuple[Shape, ...]:
    """Hub below the middle of the rotors, and an arm with a motor for each of them."""
    middle = np.mean(rotors, axis=0)
    reach = float(np.mean(np.linalg.norm(rotors - middle, axis=1)))
    thick = 0.028 * reach if reach else 0.02
    hub = middle - np.array([0.0, 0.0, 1.6 * thick])
    shapes = [Shape("cylinder", (0.3 * reach, 2.6 * thick), tuple(hub))] if reach else []
    for rotor in rotors:
        under = rotor - np.array([0.0, 0.0, 2 * thick])
        motor = tuple(rotor - [0, 0, 1.7 * thick])
        shapes.append(Shape("cylinder", (1.6 * thick, 3 * thick), motor))
        if reach:
            shapes.append(rod(hub, under, thick))
    return tuple(shapes)


def rod(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radius: float) -> Shape:
    """Cylinder from one point to another, with a radius [m]; points (3,) in body axes [m]."""
    axis_vector = end - start
    middle = tuple(float(x) for x in 0.5 * (start + end))
    size = (radius, float(np.linalg.norm(axis_vector)))
    return Shape("cylinder", size, middle, turn_towards(axis_vector))


def turn_towards(axis: Float[np.ndarray, "3"]) -> tuple[float, ...]:
    """Euler parameters of a rotation that turns z towards an axis."""
    z = axis / np.linalg.norm(axis)
    half = np.array([-z[1], z[0], 0.0])
    if z[2] < -1 + 1e-12:
        return (0.0, 1.0, 0.0, 0.0)
    e = np.array([1 + z[2], *half])
    return tuple(float(x) for x in e / np.linalg.norm(e))


def _distinct_points(
    points: Sequence[Float[np.ndarray, "3"]] | Points,
) -> list[Float[np.ndarray, "3"]]:
    """Points without those that coincide with an earlier one."""
    unique_points: list[Float[np.ndarray, "3"]] = []
    size = float(np.max(np.abs(points), initial=0.0))
    for point in points:
        if all(np.linalg.norm(point - other) > 1e-6 * size for other in unique_points):
            unique_points.append(point)
    return unique_points


# --- poses, joints and faces of a run


def body_poses(run: xr.Dataset, body: str) -> tuple[Any, Any]:
    """Positions (k, 3) [m] and rotation matrices (k, 3, 3) of a body or ground at all times."""
    count = run.sizes["time"]
    if body == GROUND:
        return np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3))
    k = list(run["body"].values).index(body)
    R = Rotation.from_quat(run["euler_parameters"].values[:, k], scalar_first=True).as_matrix()
    return run["position"].values[:, k], R


def joint_of(run: xr.Dataset, k: int) -> dict[str, Any]:
    """Plain data of a joint, with points from the bodies' centres of mass."""
    i, j = (str(run[f"joint_body_{side}"].values[k]) for side in ("i", "j"))
    point_i = run["joint_point_i"].values[k] - body_centre(run, i)
    point_j = run["joint_point_j"].values[k] - body_centre(run, j)
    frame_i, kind = run["joint_frame_i"].values[k], str(run["joint_kind"].values[k])
    joint_data = {
        "name": str(run["joint"].values[k]), "kind": kind, "body_i": i, "body_j": j,
        "point_i": point_i.tolist(), "point_j": point_j.tolist(),
        "frame_i": frame_i.tolist(), "frame_j": run["joint_frame_j"].values[k].tolist(),
    }  # fmt: skip
    if kind in SLIDING:
        displacements = joint_displacement(run, k)
        joint_data["slide"] = [float(np.min(displacements)), float(np.max(displacements))]
    return joint_data


def joint_displacement(run: xr.Dataset, k: int) -> Float[np.ndarray, " t"]:
    """Displacement of a joint's point on body j along the axis on body i (t,) [m]."""
    motion = motion_of(run)
    return displacement_of(motion, motion.joints[k])


def machine_size(run: xr.Dataset) -> float:
    """Diagonal [m] of the box around all joints, rotors and centres of mass at the start."""
    point_sets = [run["position"].values[0]]
    for body in (str(name) for name in run["body"].values):
        r, R = body_poses(run, body)
        for points in (joint_points(run, body)[0], rotor_points(run, body)):
            point_sets.append(r[0] + points @ R[0].T)
    every = np.concatenate(point_sets)
    diagonal = float(np.linalg.norm(np.max(every, axis=0) - np.min(every, axis=0)))
    # A single body has no extent of points; its radius of gyration stands for its size.
    gyration = np.sqrt(
        np.max(np.linalg.eigvalsh(run["inertia"].values)[:, -1] / run["mass"].values)
    )
    return max(diagonal, 3 * float(gyration))


def make_faces(run: xr.Dataset, names: Sequence[str]) -> tuple[np.ndarray, ...]:
    """Quadrilaterals of all bodies, joints and rotors of a saved run.

    Returns:
        Index of the body in `names` (f,); corners from its centre of mass, body axes (f, 4, 3) [m]; normals out of
        the solid (f, 3); and red, green and blue from 0 to 1 (f, 3).
    """
    solids: list[tuple[str, Shape, str]] = []
    for n, name in enumerate(str(name) for name in run["body"].values):
        rotors = rotor_points(run, name)
        colour = _PANEL if "panel" in name.lower() else COLOURS[n % len(COLOURS)]
        solids += [(name, s, _BASE if len(rotors) else colour) for s in body_shapes(run, name)]
        gaps = np.linalg.norm(rotors[:, None] - rotors[None], axis=2)
        radius = 0.45 * float(np.min(gaps[gaps > 0], initial=0.5 * machine_size(run)))
        disc = (radius, 0.02 * radius)
        solids += [(name, Shape("cylinder", disc, tuple(point)), _ROTOR) for point in rotors]
    for joint in (joint_of(run, k) for k in range(run.sizes.get("joint", 0))):
        ball = Shape("sphere", (0.01 * machine_size(run),), tuple(joint["point_j"]))
        solids.append((joint["body_j"], ball, JOINT_COLOUR))
    parts: list[tuple[np.ndarray, ...]] = []
    for name, shape, colour in solids:
        quads = make_quads(shape)
        normals = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
        # all shapes are convex: a normal points away from the middle
        outward = np.sum(normals * (quads.mean(axis=1) - np.asarray(shape.position)), axis=1)
        normals *= (np.sign(outward) / np.linalg.norm(normals, axis=1))[:, None]
        indices = np.full(len(quads), names.index(name))
        parts.append((indices, quads, normals, np.tile(to_rgb(colour), (len(quads), 1))))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))
