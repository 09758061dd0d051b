"""Labelled sketch of a mechanism, and the graph of its joints with their spanning tree."""

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial.transform import Rotation

from ..dynamics.scene import Scene
from ..dynamics.tree.topology import SpanningTree, spanning_tree
from ..files.machine import posture
from ..mechanics.body import GROUND
from ..mechanics.state import State
from ..mechanics.system import System
from .shapes import Shape, body_shapes, centre, rotor_points

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#F0E442")
_AXES = ("#D55E00", "#009E73", "#0072B2")
# Names are in front of all solids, whose order matplotlib computes.
_ON_TOP: dict[str, Any] = {
    "zorder": 1000, "bbox": {"facecolor": "white", "edgecolor": "none", "alpha": 0.55, "pad": 0.5},
}  # fmt: skip
_AROUND = np.linspace(0.0, 2 * np.pi, 17)[:-1]

Points = Float[np.ndarray, "k 3"]


def draw(
    machine: System | Scene,
    state: State | None = None,
    *,
    view: tuple[float, float] = (22.0, -55.0),
) -> Figure:
    """Figure of a mechanism: sketch with bodies, joints and frames, and graph of the joints.

    The sketch has a frame (x, y, z) at every centre of mass and the shapes of the viewer. In the
    graph, joints of the spanning tree are full lines from the root down, and joints that
    close loops are dashed.

    Args:
        machine: system, or scene.
        state: posture that is shown; default the scene's start, or the system's reference.
        view: elevation and azimuth from which the sketch is seen [degrees].
    """
    system = machine.system if isinstance(machine, Scene) else machine
    if state is None:
        state = machine.state0 if isinstance(machine, Scene) else system.reference
    figure = Figure(figsize=(10.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    _sketch(figure.add_subplot(1, 2, 1, projection="3d"), posture(system, state), view)
    _graph(figure.add_subplot(1, 2, 2), system)
    if isinstance(machine, Scene):
        figure.suptitle(machine.title)
    return figure


# --- sketch


def _sketch(ax: Any, run: xr.Dataset, view: tuple[float, float]) -> None:
    places, drawn = {GROUND: (np.zeros(3), np.eye(3))}, [run["position"].values[0]]
    size = _size(run)
    for k, name in enumerate(str(name) for name in run["body"].values):
        r, e = run["position"].values[0, k], run["euler_parameters"].values[0, k]
        R = Rotation.from_quat(e[[1, 2, 3, 0]]).as_matrix()
        places[name] = (r, R)
        colour = COLOURS[k % len(COLOURS)]
        shapes = body_shapes(run, name)
        if len(rotor_points(run, name)) and run.sizes["body"] > 1:
            # the hub alone: with the arms the mechanism on it would be too small to see
            shapes = shapes[:1]
        for shape in shapes:
            faces = [r + face @ R.T for face in _faces(shape)]
            solid = Poly3DCollection(
                faces, facecolor=colour, edgecolor=colour, linewidth=0.3, alpha=0.3
            )
            ax.add_collection3d(solid, autolim=False)
            drawn += faces
        for axis, tint in zip(R.T, _AXES, strict=True):
            ax.plot(*np.stack([r, r + 0.07 * size * axis], axis=1), color=tint, linewidth=1.2)
        ax.text(*r, f" {name}", color=colour, fontsize=8, fontweight="bold", va="bottom", **_ON_TOP)
    for k in range(run.sizes["joint"]):
        ends = []
        for side in ("i", "j"):
            body = str(run[f"joint_body_{side}"].values[k])
            r, R = places[body]
            ends.append(r + R @ (run[f"joint_point_{side}"].values[k] - centre(run, body)))
        drawn.append(np.array(ends))
        ax.plot(*np.transpose(ends), color="black", linewidth=1.2, marker="o", markersize=3)
        ax.text(*ends[1], f" {run['joint'].values[k]}", fontsize=8, va="top", **_ON_TOP)
    every = np.concatenate(drawn)
    middle, half = (
        0.5 * (every.max(axis=0) + every.min(axis=0)),
        0.5 * float(np.max(np.ptp(every, axis=0))),
    )
    ax.set(**{f"{name}lim": (m - half, m + half) for name, m in zip("xyz", middle, strict=True)})
    ax.set_box_aspect((1, 1, 1))
    ax.view_init(*view)
    ax.tick_params(labelsize=7)
    for set_label, name in ((ax.set_xlabel, "x"), (ax.set_ylabel, "y"), (ax.set_zlabel, "z")):
        set_label(f"{name} [m]", fontsize=8)
    ax.set_title("frames of the bodies: x red, y green, z blue", fontsize=9)


def _size(run: xr.Dataset) -> float:
    """Largest distance [m] between centres of mass, or the radius of gyration of a single body."""
    r = run["position"].values[0]
    gyration = float(np.sqrt(np.max(run["inertia"].values / run["mass"].values[:, None, None])))
    return max(float(np.max(np.ptp(r, axis=0))), 3 * gyration)


def _faces(shape: Shape) -> list[Points]:
    """Polygons of a shape's surface, body axes from the centre of mass [m]."""
    ring = np.stack([np.cos(_AROUND), np.sin(_AROUND)], axis=1) * shape.size[0]
    if shape.kind == "sphere":
        polar = np.linspace(np.pi - 0.2, 0.2, 7)
        widths, heights = np.sin(polar), shape.size[0] * np.cos(polar)
    else:
        widths, heights = np.ones(2), 0.5 * shape.size[-1] * np.array([-1.0, 1.0])
        if shape.kind != "cylinder":
            corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
            ring = 0.5 * corners * np.array(shape.size[:2])
    rings = [
        np.column_stack([width * ring, np.full(len(ring), height)])
        for width, height in zip(widths, heights, strict=True)
    ]
    faces = [rings[0], rings[-1]]
    for low, high in pairwise(rings):
        sides = [low, np.roll(low, -1, axis=0), np.roll(high, -1, axis=0), high]
        faces += list(np.stack(sides, axis=1))
    w, *v = shape.orientation
    R = Rotation.from_quat([*v, w]).as_matrix()
    return [np.asarray(shape.position) + face @ R.T for face in faces]


# --- graph


def _graph(ax: Axes, system: System) -> None:
    tree = spanning_tree(system)
    at = _layout(tree)
    between: Counter[tuple[int, ...]] = Counter()
    for n, link in enumerate(tree.links):
        words = "free" if link.joint is None else _named(system, link.joint)
        between[tuple(sorted((link.parent, link.child)))] += 1
        # labels of neighbours are at different heights
        _edge(ax, at[link.parent], at[link.child], words, "0.25", share=0.45 + 0.15 * (n % 2))
    for k in tree.cut:
        joint = system.joints[k]
        ends = sorted(tree.bodies.index(name) for name in (joint.body_i, joint.body_j))
        # each further joint of the same two bodies is bent further, to one side and the other
        between[tuple(ends)] += 1
        number = between[tuple(ends)]
        bend = 0.2 * ((number + 1) // 2) * (-1) ** (number + 1)
        left, right = sorted(ends, key=lambda end: at[end])
        _edge(ax, at[left], at[right], _named(system, k), "#D55E00", bend=bend, dashed=True)
    for k, (x, y) in at.items():
        colour = "0.6" if tree.bodies[k] == GROUND else COLOURS[k % len(COLOURS)]
        box = {"boxstyle": "round", "facecolor": "white", "edgecolor": colour, "linewidth": 1.6}
        ax.text(x, y, tree.bodies[k], ha="center", va="center", fontsize=8, bbox=box)
    ax.margins(0.18, 0.12)
    ax.set_axis_off()
    loops = "full: spanning tree; dashed: closes a loop" if tree.cut else "spanning tree"
    ax.set_title(f"joints; {loops}", fontsize=9)


def _named(system: System, k: int) -> str:
    joint = system.joints[k]
    return f"{joint.name}\n{joint.kind.replace('_', ' ')}"


def _edge(
    ax: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    words: str,
    colour: str,
    *,
    bend: float = 0.0,
    share: float = 0.5,
    dashed: bool = False,
) -> None:
    """Line, or arc bent to the side, with words on it at a share of its length."""
    a, b = np.array(start), np.array(end)
    control = 0.5 * (a + b) + 2 * bend * np.array([b[1] - a[1], a[0] - b[0]])
    at = lambda s: (1 - s) ** 2 * a + 2 * s * (1 - s) * control + s**2 * b
    path = np.array([at(s) for s in np.linspace(0, 1, 33)])
    ax.plot(*path.T, color=colour, linewidth=1.6, linestyle="--" if dashed else "-", zorder=1)
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    x, y = at(share)
    ax.text(x, y, words, ha="center", va="center", fontsize=7, color=colour, bbox=box)


def _layout(tree: SpanningTree) -> dict[int, tuple[float, float]]:
    """Places of the bodies: the depth in the tree downwards, leaves side by side."""
    children: dict[int, list[int]] = {}
    for link in tree.links:
        children.setdefault(link.parent, []).append(link.child)
    at: dict[int, tuple[float, float]] = {}
    leaves = 0

    def place(body: int, depth: int) -> float:
        nonlocal leaves
        below = [place(child, depth + 1) for child in children.get(body, ())]
        x = sum(below) / len(below) if below else float(leaves)
        leaves += not below
        at[body] = (x, -float(depth))
        return x

    place(tree.root, 0)
    return at
