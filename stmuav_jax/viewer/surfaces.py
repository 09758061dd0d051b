"""Surfaces of a mechanism as coloured quadrilaterals, for films that are drawn without a browser.

Shapes and colours are those of the viewer's page (`machine.js`): bodies, joints with rails and
plates, links without mass, and rotors with turning blades.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from ..mechanics.body import GROUND
from .content import joint_of, machine_size
from .shapes import Shape, body_shapes, centre, rod, rotor_points, towards

PALETTE = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7", "#f0e442")
BASE, PANEL, CELLS, JOINT, PLATE, ROTOR = (
    "#8b929c", "#1d3f72", "#8fb4e8", "#69717d", "#7a7f87", "#5b626c",
)  # fmt: skip
# Rotors are drawn turning so many times slower, as neither eye nor screen could follow.
ROTOR_SLOWNESS = 40.0
_AROUND = 16

Quads = Float[np.ndarray, "f 4 3"]
Colours = Float[np.ndarray, "f 3"]


class Surface(NamedTuple):
    """Quadrilaterals fixed in bodies.

    Attributes:
        body: index of the body of each in the run's order, the number of bodies for ground (f,).
        corners: body axes, from the centre of mass (f, 4, 3) [m].
        normals: pointing out of the solid, body axes (f, 3).
        colours, edges: of the face and of its edges, red, green, blue from 0 to 1 (f, 3).
    """

    body: Int[np.ndarray, " f"]
    corners: Quads
    normals: Float[np.ndarray, "f 3"]
    colours: Colours
    edges: Colours


@dataclass(frozen=True)
class Rotor:
    """Disc and blade of a rotor.

    Attributes:
        body: index of its body.
        place: centre from the body's centre of mass, body axes (3,) [m].
        radius: of the disc that is drawn [m].
        angles: of the drawn blade about the body's z axis at the saved times (k,) [rad].
    """

    body: int
    place: Float[np.ndarray, "3"]
    radius: float
    angles: Float[np.ndarray, " k"]


def rgb(colour: str) -> Float[np.ndarray, "3"]:
    """Red, green and blue from 0 to 1 of a colour such as "#0072b2"."""
    return np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])


def surface_of(run: xr.Dataset) -> Surface:
    """Surface of all bodies and joints of a saved run."""
    names = [str(name) for name in run["body"].values]
    place = {name: k for k, name in enumerate([*names, GROUND])}
    found = []
    for name, colour in body_colours(run).items():
        for shape in body_shapes(run, name):
            found.append(_coloured(place[name], shape, rgb(colour)))
    size = machine_size(run)
    for k in range(run.sizes.get("joint", 0)):
        for name, shape, colour in joint_shapes(joint_of(run, k), size):
            found.append(_coloured(place[name], shape, rgb(colour)))
    return Surface(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def body_colours(run: xr.Dataset) -> dict[str, str]:
    """Colours of the bodies by name, as on the viewer's page."""
    found: dict[str, str] = {}
    for name in (str(name) for name in run["body"].values):
        others = sum(colour in PALETTE for colour in found.values())
        if len(rotor_points(run, name)):
            found[name] = BASE
        elif "panel" in name.lower():
            found[name] = PANEL
        else:
            found[name] = PALETTE[others % len(PALETTE)]
    return found


def joint_shapes(joint: Mapping[str, Any], size: float) -> list[tuple[str, Shape, str]]:
    """Body, shape and colour of the parts of a joint, as the viewer's page draws them.

    Args:
        joint: plain data of a joint, from `joint_of`.
        size: size of the mechanism [m].
    """
    radius = 0.008 * size
    length, kind = 4.5 * radius, joint["kind"]
    points = {side: np.array(joint[f"point_{side}"], float) for side in "ij"}
    axes = {side: np.array(joint[f"frame_{side}"]).T for side in "ij"}
    found: list[tuple[str, Shape, str]] = []

    def pin(side: str, thick: float, axis: Any) -> None:
        shape = Shape("cylinder", (thick, length), tuple(points[side]), towards(axis))
        found.append((joint[f"body_{side}"], shape, JOINT))

    if kind == "revolute":
        pin("j", radius, axes["j"][2])
    elif kind == "universal":
        pin("i", 0.8 * radius, axes["i"][0])
        pin("j", 0.8 * radius, axes["j"][1])
    elif kind == "weld":
        edge = 2 * radius
        found.append((joint["body_j"], Shape("box", (edge,) * 3, tuple(points["j"])), JOINT))
    elif "slide" in joint:
        low, high = (
            points["i"] + axes["i"][2] * end
            for end in (joint["slide"][0] - length, joint["slide"][1] + length)
        )
        found.append((joint["body_i"], rod(low, high, 0.4 * radius), PLATE))
    else:
        ball = Shape("sphere", (1.25 * radius,), tuple(points["j"]))
        found.append((joint["body_j"], ball, JOINT))
    for side in "ij":
        if joint[f"body_{side}"] == GROUND:
            below = tuple(points[side] - [0.0, 0.0, 1.6 * radius])
            plate = Shape("box", (5 * radius, 5 * radius, 0.8 * radius), below)
            found.append((GROUND, plate, PLATE))
    return found


def rotors_of(run: xr.Dataset) -> list[Rotor]:
    """Rotors of a saved run; their blades turn slower than in the run, by `ROTOR_SLOWNESS`."""
    if "rotor_position" not in run:
        return []
    names = [str(name) for name in run["body"].values]
    bodies = [str(name) for name in run["rotor_body"].values]
    places = [
        point - centre(run, body)
        for point, body in zip(run["rotor_position"].values, bodies, strict=True)
    ]
    gaps = [
        float(np.linalg.norm(a - b)) for k, a in enumerate(places) for b in places[k + 1 :]
    ]  # fmt: skip
    radius = 0.45 * min(gaps) if gaps else 0.2 * machine_size(run)
    speed, ts = run["rotor_speed"].values, run["time"].values
    steps = 0.5 * np.diff(ts)[:, None] * (speed[1:] + speed[:-1])
    angles = np.concatenate([np.zeros((1, len(places))), np.cumsum(steps, axis=0)])
    angles *= run["rotor_spin"].values / ROTOR_SLOWNESS
    return [
        Rotor(names.index(body), place, radius, angles[:, k])
        for k, (body, place) in enumerate(zip(bodies, places, strict=True))
    ]


# --- quadrilaterals of a shape


def _coloured(body: int, shape: Shape, colour: Float[np.ndarray, "3"]) -> Surface:
    corners, cells = quads(shape)
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # all shapes are convex: a normal points away from the middle
    outwards = np.sum(normals * (corners.mean(axis=1) - np.array(shape.position)), axis=1)
    normals *= np.sign(outwards)[:, None]
    colours = np.broadcast_to(colour, (len(corners), 3))
    edges = np.where(cells[:, None], rgb(CELLS), colours)
    return Surface(np.full(len(corners), body), corners, normals, colours, edges)


def quads(shape: Shape) -> tuple[Quads, Bool[np.ndarray, " f"]]:
    """Quadrilaterals of a shape's surface, body axes (f, 4, 3) [m], and which are solar cells (f,).

    Long sides are in several pieces, so that each piece has nearly one distance from the eye.
    """
    if shape.kind in ("box", "panel"):
        local, cells = _box(np.array(shape.size), shape.kind == "panel")
    else:
        local = _revolved(shape)
        cells = np.zeros(len(local), bool)
    w, *v = shape.orientation
    R = Rotation.from_quat([*v, w]).as_matrix()
    return np.asarray(shape.position) + local @ R.T, cells


def _box(size: Float[np.ndarray, "3"], panel: bool) -> tuple[Quads, Bool[np.ndarray, " f"]]:
    pieces = np.clip(np.ceil(4 * size / np.max(size)), 1, 4).astype(int)
    found, cells = [], []
    for k in range(3):
        across = [(k + 1) % 3, (k + 2) % 3]
        a, b = (np.linspace(-0.5, 0.5, pieces[n] + 1) for n in across)
        low = np.stack(np.meshgrid(a[:-1], b[:-1], indexing="ij"), axis=-1).reshape(-1, 2)
        step = np.array([a[1] - a[0], b[1] - b[0]])
        flat = np.stack([low, low + step * [1, 0], low + step, low + step * [0, 1]], axis=1)
        for end in (-0.5, 0.5):
            face = np.full((len(flat), 4, 3), end)
            face[..., across] = flat
            found.append(face * size)
            cells.append(np.full(len(flat), panel and k == 2 and end > 0))
    return np.concatenate(found), np.concatenate(cells)


def _revolved(shape: Shape) -> Quads:
    """Quadrilaterals of a sphere or a cylinder about z; those at its ends are triangles."""
    radius = shape.size[0]
    if shape.kind == "sphere":
        polar = np.linspace(np.pi, 0.0, 9)
        radii, heights = radius * np.sin(polar), radius * np.cos(polar)
    else:
        length = shape.size[1]
        count = int(np.clip(round(length / (6 * radius)), 1, 8))
        heights = length * np.linspace(-0.5, 0.5, count + 1)
        radii = np.concatenate([[0.0], np.full(count + 1, radius), [0.0]])
        heights = np.concatenate([heights[:1], heights, heights[-1:]])
    angle = np.linspace(0.0, 2 * np.pi, _AROUND + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.concatenate(
        [
            radii[:, None, None] * circle,
            np.broadcast_to(heights[:, None, None], (len(radii), _AROUND + 1, 1)),
        ],
        axis=2,
    )
    low, high = rings[:-1], rings[1:]
    found = np.stack([low[:, :-1], low[:, 1:], high[:, 1:], high[:, :-1]], axis=2)
    return found.reshape(-1, 4, 3)
