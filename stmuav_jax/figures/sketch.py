"""Labelled sketch of a mechanism, and the graph of its joints with their spanning tree."""

from collections import Counter
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial.transform import Rotation

from ..dynamics.simulation import Scene
from ..dynamics.tree.topology import SpanningTree, spanning_tree
from ..io.run_file import posture
from ..mechanics.body import GROUND
from ..mechanics.state import State
from ..mechanics.system import System
from .shapes import COLOURS, body_centre, body_shapes, make_quads, rotor_points

_AXES = ("#D55E00", "#009E73", "#0072B2")
# Names are in front of all solids, whose order matplotlib computes.
_ON_TOP: dict[str, Any] = {
    "zorder": 1000, "bbox": {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
}  # fmt: skip
# Distances of a name from its point that are tried in turn, and directions [points, degrees]. The first
# directions are to the right, as names are read.
_RADII = (3.0, 12.0, 22.0, 34.0, 48.0)
_DIRECTIONS = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])


def draw(
    machine: System | Scene,
    state: State | None = None,
    *,
    view: tuple[float, float] = (22.0, -55.0),
) -> Figure:
    """Figure of a mechanism: sketch with bodies, joints and frames, and graph of the joints.

    The sketch has a frame (x, y, z) at every centre of mass and the shapes of the viewer. In the
    graph, joints of the spanning tree are solid lines from the root down, and joints that
    close loops are dashed.

    Args:
        machine: system, or scene.
        state: posture that is shown; default the scene's start, or the system's reference.
        view: elevation and azimuth from which the sketch is seen [degrees].
    """
    system = machine.system if isinstance(machine, Scene) else machine
    if state is None:
        state = machine.state0 if isinstance(machine, Scene) else system.reference
    figure = _SketchFigure(figsize=(10.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    _draw_sketch(figure.add_subplot(1, 2, 1, projection="3d"), posture(system, state), view)
    _draw_graph(figure.add_subplot(1, 2, 2), system)
    if isinstance(machine, Scene):
        figure.suptitle(machine.title)
    return figure


# --- sketch


class _SketchFigure(Figure):
    """Figure whose names are placed at every drawing, when its size and layout are known."""

    def draw(self, renderer: Any) -> None:
        engine = self.get_layout_engine()
        if engine is not None:
            engine.execute(self)
        self.axes[0].apply_aspect()
        _place_labels(self)
        super().draw(renderer)


def _draw_sketch(ax: Any, run: xr.Dataset, view: tuple[float, float]) -> None:
    places, point_sets = {GROUND: (np.zeros(3), np.eye(3))}, [run["position"].values[0]]
    labels: list[tuple[str, np.ndarray, str]] = []
    # Largest distance between centres of mass, or the radius of gyration of a single body.
    gyration = np.sqrt(np.max(run["inertia"].values / run["mass"].values[:, None, None]))
    size = max(np.max(np.ptp(point_sets[0], axis=0)), 3 * gyration)
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
            faces = list(r + make_quads(shape) @ R.T)
            style = {"facecolor": colour, "edgecolor": colour, "linewidth": 0.3, "alpha": 0.3}
            ax.add_collection3d(Poly3DCollection(faces, **style), autolim=False)
            point_sets += faces
        for axis, tint in zip(R.T, _AXES, strict=True):
            ax.plot(*np.stack([r, r + 0.07 * size * axis], axis=1), color=tint, linewidth=1.2)
        labels.append((name, r, colour))
    for k in range(run.sizes["joint"]):
        ends = []
        for side in ("i", "j"):
            body = str(run[f"joint_body_{side}"].values[k])
            r, R = places[body]
            ends.append(r + R @ (run[f"joint_point_{side}"].values[k] - body_centre(run, body)))
        point_sets.append(np.array(ends))
        ax.plot(*np.transpose(ends), color="black", linewidth=1.2, marker="o", markersize=3)
        # of a distance, whose points are apart, the middle; of the other joints their point
        labels.append((str(run["joint"].values[k]), np.mean(ends, axis=0), "black"))
    every = np.concatenate(point_sets)
    middle = 0.5 * (every.max(axis=0) + every.min(axis=0))
    half = 0.5 * float(np.max(np.ptp(every, axis=0)))
    ax.set(**{f"{name}lim": (m - half, m + half) for name, m in zip("xyz", middle, strict=True)})
    ax.set_box_aspect((1, 1, 1))
    ax.view_init(*view)
    ax.tick_params(labelsize=7)
    ax.locator_params(nbins=5)
    for name in "xyz":
        getattr(ax, f"set_{name}label")(f"{name} [m]", fontsize=8)
    ax.set_title("frames of the bodies: x red, y green, z blue", fontsize=9)
    # Points in the picture are known only with view and limits.
    projection = ax.get_proj()
    line = {"arrowstyle": "-", "color": "0.5", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 1}
    for name, (x, y, z), colour in labels:
        label = ax.annotate(
            name, proj3d.proj_transform(x, y, z, projection)[:2], (0, 0), textcoords="offset points",
            fontsize=8, color=_darken(colour), va="bottom", arrowprops=line,
            fontweight="normal" if colour == "black" else "bold", **_ON_TOP,
        )  # fmt: skip
        label.set_in_layout(False)


def _darken(colour: str) -> Any:
    """Colour dark enough for text on white: its luminance is at most 0.4."""
    rgb = np.array(to_rgb(colour))
    return tuple(rgb * min(1.0, 0.4 / max(float(rgb @ (0.299, 0.587, 0.114)), 1e-9)))


def _place_labels(figure: Figure) -> None:
    """Move the names of a sketch next to their points, without overlap as far as there is space.

    Each name takes the nearest free place among a few directions and distances (greedy point-feature labelling);
    a line leads to its point from farther ones. Where no place is free, it takes the one with the least overlap.

    Source: J. Christensen, J. Marks, S. Shieber, ACM Trans. Graphics 14 (1995) 203-232.
    """
    per_pixel = 72.0 / figure.dpi
    labels: Any = figure.axes[0].texts
    anchors = figure.axes[0].transData.transform([label.xy for label in labels]) * per_pixel
    points = [np.concatenate([anchor - 2.0, anchor + 2.0]) for anchor in anchors]
    boxes: list[np.ndarray] = []
    for k, (label, anchor) in enumerate(zip(labels, anchors, strict=True)):
        # without the line to the point, which the extent of an annotation includes
        extent = Text.get_window_extent(label)
        # A name covers no other name, and no point of another name.
        obstacles = [*boxes, *points[:k], *points[k + 1 :]]
        size = np.array([extent.width, extent.height]) * per_pixel
        best, best_box, best_overlap = np.zeros(2), np.zeros(4), np.inf
        for radius in _RADII:
            for angle in _DIRECTIONS:
                direction = np.array([np.cos(angle), np.sin(angle)])
                # the name's nearest side, or its middle above and below, faces the point
                corner = anchor + radius * direction - size * 0.5 * (1 - direction)
                box = np.concatenate([corner - 1.5, corner + size + 1.5])
                overlap = sum(_overlap_area(box, other) for other in obstacles)
                if overlap < best_overlap:
                    best, best_box, best_overlap = corner - anchor, box, overlap
            if best_overlap == 0:
                break
        boxes.append(best_box)
        label.set_position(best)
        is_far = np.linalg.norm(best + 0.5 * size) > 0.5 * size[0] + _RADII[1]
        label.arrow_patch.set_visible(bool(is_far))


def _overlap_area(a: np.ndarray, b: np.ndarray) -> float:
    """Area of the intersection of two boxes (left, bottom, right, top)."""
    size = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    return float(np.prod(np.maximum(size, 0.0)))


# --- graph


def _draw_graph(ax: Axes, system: System) -> None:
    tree = spanning_tree(system)
    at = _place_bodies(tree)
    between: Counter[tuple[int, ...]] = Counter()
    # sizes of a character and of two lines of text, in the units of the layout
    width, height = (max(np.ptp([place[axis] for place in at.values()]), 1.0) for axis in (0, 1))
    text_size = np.array([0.02 * width, 0.12 * height])
    boxes: list[np.ndarray] = []
    for link in tree.links:
        edge_label = "free" if link.joint is None else _joint_label(system, link.joint)
        between[tuple(sorted((link.parent, link.child)))] += 1
        _draw_edge(ax, at[link.parent], at[link.child], edge_label, "0.25", boxes, text_size)
    for k in tree.cut:
        joint = system.joints[k]
        ends = sorted(tree.bodies.index(name) for name in (joint.body_i, joint.body_j))
        # each further joint of the same two bodies is bent further, to one side and the other
        between[tuple(ends)] += 1
        number = between[tuple(ends)]
        bend = 0.2 * ((number + 1) // 2) * (-1) ** (number + 1)
        left_body, right_body = sorted(ends, key=lambda end: at[end])
        _draw_edge(
            ax, at[left_body], at[right_body], _joint_label(system, k), "#D55E00", boxes, text_size,
            bend=bend, dashed=True,
        )  # fmt: skip
    for k, (x, y) in at.items():
        colour = "0.6" if tree.bodies[k] == GROUND else COLOURS[k % len(COLOURS)]
        box = {"boxstyle": "round", "facecolor": "white", "edgecolor": colour, "linewidth": 1.6}
        ax.text(x, y, tree.bodies[k], ha="center", va="center", fontsize=8, bbox=box)
    ax.margins(0.18, 0.12)
    ax.set_axis_off()
    loops = "solid: spanning tree; dashed: closes a loop" if tree.cut else "spanning tree"
    ax.set_title(f"joints; {loops}", fontsize=9)


def _joint_label(system: System, k: int) -> str:
    joint = system.joints[k]
    return f"{joint.name}\n{joint.kind.replace('_', ' ')}"


def _draw_edge(
    ax: Axes, start: tuple[float, float], end: tuple[float, float], label: str, colour: str,
    boxes: list[np.ndarray], text_size: np.ndarray, *, bend: float = 0.0, dashed: bool = False,
) -> None:  # fmt: skip
    """Line, or arc bent to the side, with words on it where they overlap the fewest of the boxes."""
    a, b = np.array(start), np.array(end)
    control = 0.5 * (a + b) + 2 * bend * np.array([b[1] - a[1], a[0] - b[0]])
    at = lambda s: (1 - s) ** 2 * a + 2 * s * (1 - s) * control + s**2 * b
    path = np.array([at(s) for s in np.linspace(0, 1, 33)])
    ax.plot(*path.T, color=colour, linewidth=1.6, linestyle="--" if dashed else "-", zorder=1)
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    half = 0.5 * text_size * np.array([max(map(len, label.split("\n"))), 1.0])
    candidates = [at(share) for share in (0.5, 0.4, 0.6, 0.3, 0.7, 0.22, 0.78)]
    around = [np.concatenate([middle - half, middle + half]) for middle in candidates]
    overlaps = [sum(_overlap_area(box, other) for other in boxes) for box in around]
    # The middle of a line comes first among equals.
    best = int(np.argmin(overlaps))
    boxes.append(around[best])
    x, y = candidates[best]
    ax.text(x, y, label, ha="center", va="center", fontsize=7, color=colour, bbox=box)


def _place_bodies(tree: SpanningTree) -> dict[int, tuple[float, float]]:
    """Places of the bodies: the depth in the tree downwards, leaves side by side."""
    children: dict[int, list[int]] = {}
    for link in tree.links:
        children.setdefault(link.parent, []).append(link.child)
    at: dict[int, tuple[float, float]] = {}
    leaves = 0

    def place_subtree(body: int, depth: int) -> float:
        nonlocal leaves
        below = [place_subtree(child, depth + 1) for child in children.get(body, ())]
        x = sum(below) / len(below) if below else float(leaves)
        leaves += not below
        at[body] = (x, -float(depth))
        return x

    # Leaves are numbered in the order of a walk through the tree, so that no two branches cross.
    place_subtree(tree.root, 0)
    return at
