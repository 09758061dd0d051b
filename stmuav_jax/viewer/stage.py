"""Canvas on which the mechanism of a saved run is drawn at one time after another.

The projection is parallel, so that equal lengths are equal in the picture wherever they are.
"""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from ..mechanics.body import GROUND
from .content import joint_of, machine_size, watched
from .poses import Poses
from .surfaces import BASE, JOINT, ROTOR, Quads, body_colours, rgb, rotors_of, surface_of

# Resolution to which text and lines are scaled: a picture of this width has letters of 10 points.
_WIDTH, _DPI = 640.0, 100.0
_SKY, _GRID, _INK = "#f3f5f8", "#c9cfd8", "#2b3038"
# Part of the picture's width and height around the machine.
_MARGIN = 0.08
# A machine is followed if its way is so many times its size.
_TRAVELS = 3.0
# Largest number of grid lines in one direction.
_MOST_LINES = 60
_LINKS = ("distance", "revolute_spherical")


class Camera(NamedTuple):
    """Directions of a view, world axes (3,): to the right and up in the picture, and to the eye."""

    right: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    towards: Float[np.ndarray, "3"]

    def project(self, points: Any) -> Float[np.ndarray, "... 2"]:
        """Places in the picture [m] of points (..., 3) [m]."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


def camera(elevation: float, azimuth: float) -> Camera:
    """Camera that looks from an elevation and an azimuth [degrees], x towards azimuth 0."""
    el, az = np.radians(elevation), np.radians(azimuth)
    towards = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
    right = np.array([-np.sin(az), np.cos(az), 0.0])
    return Camera(right, np.cross(towards, right), towards)


class Stage:
    """Canvas with the mechanism of a saved run, drawn at any of its times.

    Attributes:
        poses: poses of the bodies. camera: directions of the view. size: width and height [pixels].
        spacing: of the ground grid [m].
        figure: figure whose artists `draw` moves.
        solids: polygons of the visible faces, the furthest first.
        trail: line of the way of the first watched body so far.
    """

    def __init__(
        self,
        run: xr.Dataset,
        size: tuple[int, int],
        view: tuple[float, float],
        span: tuple[float, float],
        caption: str = "",
    ) -> None:
        """Prepare the canvas.

        Args:
            run: saved run, as `load` reads it.
            size: width and height [pixels].
            view: elevation and azimuth of the eye [degrees].
            span: first and last time that will be drawn [s]; the frame shows all between.
            caption: words at the lower right.
        """
        self.poses, self.camera, self.size = Poses(run), camera(*view), size
        self._surface, self._rotors = surface_of(run), rotors_of(run)
        names = [str(name) for name in run["body"].values]
        self._base = names.index(watched(run)[0])
        self._links = [_ends(run, k, names) for k in range(run.sizes.get("joint", 0))]
        self._links = [link for link in self._links if link is not None]
        self._length = machine_size(run)
        c = self.camera
        light = c.towards + 0.55 * c.up - 0.4 * c.right + np.array([0.0, 0.0, 0.4])
        self._light = light / np.linalg.norm(light)
        way = np.ptp(self.poses.positions.reshape(-1, 3), axis=0)
        self._follows = bool(np.linalg.norm(way) > _TRAVELS * self._length)
        self._frame(size, span)
        self._artists(run, size, span, caption, body_colours(run)[names[self._base]])

    # --- what is in the picture

    def _frame(self, size: tuple[int, int], span: tuple[float, float]) -> None:
        """Find the middle and the half width of the picture, and the height of the ground."""
        at = np.linspace(*span, 80)
        seen = [self.camera.project(self._world(t)) - self._target(t) for t in at]
        low = np.min([points.min(axis=(0, 1)) for points in seen], axis=0)
        high = np.max([points.max(axis=(0, 1)) for points in seen], axis=0)
        self._middle = 0.5 * (low + high)
        width, height = 0.5 * (high - low) / (1 - 2 * _MARGIN)
        self._half = float(max(width, height * size[0] / size[1]))
        self._floor = float(np.min(self._world(span[0])[..., 2])) - 0.02 * self._length
        # a picture of constant scale has a grid of constant spacing
        rough = 2 * self._half / 7
        decade = 10 ** np.floor(np.log10(rough))
        self.spacing = float(decade * next(k for k in (1, 2, 5, 10) if k * decade >= 0.999 * rough))

    def _target(self, t: float) -> Float[np.ndarray, "2"]:
        """Place [m] that the picture follows."""
        path = self.poses.positions[:, self._base]
        moved = self.poses.mixed(path, t) if self._follows else path[0]
        return self.camera.project(moved)

    def _placed(self, t: float) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
        """Poses of all bodies at t [s], with the ground's after them."""
        r, R = self.poses.at(t)
        return np.concatenate([r, np.zeros((1, 3))]), np.concatenate([R, np.eye(3)[None]])

    def _world(self, t: float) -> Quads:
        """Corners of all faces, blades and links at t [s], world axes (f, 4, 3) [m]."""
        r, R = self._placed(t)
        own = self._surface.body
        faces = np.einsum("fij,fkj->fki", R[own], self._surface.corners) + r[own][:, None]
        return np.concatenate([faces, self._blades(t, r, R), self._bars(r, R)])

    def _blades(self, t: float, r: Any, R: Any) -> Quads:
        found = np.zeros((len(self._rotors), 4, 3))
        for k, rotor in enumerate(self._rotors):
            angle = float(self.poses.mixed(rotor.angles[self.poses.kept], t))
            along = rotor.radius * np.array([np.cos(angle), np.sin(angle), 0.0])
            across = 0.06 * np.array([-along[1], along[0], 0.0])
            corners = rotor.place + np.array(
                [along + across, along - across, -along - across, -along + across]
            )
            found[k] = r[rotor.body] + corners @ R[rotor.body].T
        return found

    def _bars(self, r: Any, R: Any) -> Quads:
        """Rods without mass between the points of a joint, turned towards the eye."""
        found = np.zeros((len(self._links), 4, 3))
        for k, ((i, p), (j, q)) in enumerate(self._links):
            a, b = r[i] + R[i] @ p, r[j] + R[j] @ q
            side = np.cross(b - a, self.camera.towards)
            length = float(np.linalg.norm(side))
            side *= 0.005 * self._length / length if length > 1e-9 * self._length else 0.0
            found[k] = [a + side, b + side, b - side, a - side]
        return found

    # --- artists

    def _artists(
        self, run: xr.Dataset, size: tuple[int, int], span: tuple[float, float], caption: str,
        colour: str,
    ) -> None:  # fmt: skip
        scale = max(size[0] / _WIDTH, 0.6)
        # a little more, as Agg cuts 114.99999 pixels to 114
        inches = ((size[0] + 1e-3) / _DPI, (size[1] + 1e-3) / _DPI)
        self.figure = Figure(figsize=inches, dpi=_DPI, facecolor=_SKY)
        self._canvas = FigureCanvasAgg(self.figure)
        self._ax = ax = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        ax.set_axis_off()
        self._grid = LineCollection([], colors=_GRID, linewidths=0.7 * scale, zorder=0)
        self._discs = PolyCollection([], facecolors=ROTOR, alpha=0.15, linewidths=0, zorder=3)
        self.solids = PolyCollection([], linewidths=0.5 * scale, zorder=2, joinstyle="round")
        for artist in (self._grid, self._discs, self.solids):
            ax.add_collection(artist, autolim=False)
        trail = "#0072b2" if colour == BASE else colour
        (self.trail,) = ax.plot([], [], color=trail, linewidth=1.3 * scale, zorder=1)
        words: dict[str, Any] = {
            "transform": ax.transAxes, "fontsize": 10 * scale * 0.72, "color": _INK, "zorder": 9,
            "bbox": {"facecolor": _SKY, "edgecolor": "none", "alpha": 0.7, "pad": 1.5},
            "parse_math": False,
        }  # fmt: skip
        title = str(run.attrs.get("title", "")) or str(run.attrs.get("scene", ""))
        ax.text(0.02, 0.97, title, ha="left", va="top", fontweight="bold", **words)
        self._clock = ax.text(0.02, 0.03, "", ha="left", va="bottom", **words | {
            "fontsize": 10 * scale, "fontfamily": "monospace",
        })  # fmt: skip
        self._digits = int(np.clip(3 - np.floor(np.log10(span[1] - span[0])), 1, 6))
        note = f"grid {self.spacing:g} m" + (f", {caption}" if caption else "")
        ax.text(0.98, 0.03, note, ha="right", va="bottom", **words)

    def draw(self, t: float) -> None:
        """Move all artists to their places at t [s]."""
        c, surface = self.camera, self._surface
        r, R = self._placed(t)
        world = self._world(t)
        extra = len(world) - len(surface.body)
        normals = np.einsum("fij,fj->fi", R[surface.body], surface.normals)
        # back faces are hidden by the solid's front; blades and links have two sides
        facing = np.concatenate([normals @ c.towards > 0, np.full(extra, True)])
        shade = 0.62 + 0.5 * np.clip(normals @ self._light, 0.0, 1.0)[:, None]
        two_sided = np.array([rgb(ROTOR)] * len(self._rotors) + [rgb(JOINT)] * len(self._links))
        two_sided = two_sided.reshape(-1, 3)
        colours = np.concatenate([np.clip(surface.colours * shade, 0, 1), two_sided])
        edges = np.concatenate([np.clip(surface.edges * shade, 0, 1), two_sided])
        order = np.argsort(world.mean(axis=1) @ c.towards, kind="stable")
        order = order[facing[order]]
        self.solids.set_verts(list(c.project(world[order])))
        self.solids.set_facecolor(list(colours[order]))
        self.solids.set_edgecolor(list(edges[order]))
        self._discs.set_verts(self._disc_outlines(r, R))
        k, _ = self.poses.between(t)
        path = self.poses.positions[:, self._base]
        so_far = np.concatenate([path[: k + 1], self.poses.mixed(path, t)[None]])
        self.trail.set_data(*c.project(so_far).T)
        self._aim(t)
        self._clock.set_text(f"t = {t:.{self._digits}f} s")

    def _disc_outlines(self, r: Any, R: Any) -> list[Float[np.ndarray, "m 2"]]:
        angle = np.linspace(0.0, 2 * np.pi, 37)[:-1]
        ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        return [
            self.camera.project(r[one.body] + (one.place + one.radius * ring) @ R[one.body].T)
            for one in self._rotors
        ]

    def _aim(self, t: float) -> None:
        """Move the picture with the machine, and lay the grid's lines under it."""
        c = self.camera
        middle = self._target(t) + self._middle
        width, height = self.figure.get_size_inches()
        half = np.array([self._half, self._half * height / width])
        self._ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
        self._ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
        if abs(c.towards[2]) < 0.02:
            # the ground is seen from its edge
            line = np.array([[middle[0] + x, self._floor] for x in (-half[0], half[0])])
            self._grid.set_segments([line])
            return
        # the point of the ground in the middle of the picture
        point = middle[0] * c.right + middle[1] * c.up
        point = point + c.towards * (self._floor - point[2]) / c.towards[2]
        reach = float(np.hypot(half[0], half[1] / abs(c.towards[2])))
        count = min(int(np.ceil(reach / self.spacing)) + 1, _MOST_LINES // 2)
        first = self.spacing * np.round(point[:2] / self.spacing)
        ends = count * self.spacing
        offsets = self.spacing * np.arange(-count, count + 1)
        segments = np.zeros((2, len(offsets), 2, 3))
        segments[..., 2] = self._floor
        segments[0, :, :, 0] = first[0] + offsets[:, None]
        segments[0, :, :, 1] = first[1] + np.array([-ends, ends])
        segments[1, :, :, 1] = first[1] + offsets[:, None]
        segments[1, :, :, 0] = first[0] + np.array([-ends, ends])
        self._grid.set_segments(list(c.project(segments.reshape(-1, 2, 3))))

    def pixels(self) -> np.ndarray:
        """Colours of the picture as it is drawn (height, width, 3), 8 bits each."""
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def _ends(run: xr.Dataset, k: int, names: list[str]) -> Any:
    """Body and point on it for both ends of a joint that is drawn as a rod; None for others."""
    joint = joint_of(run, k)
    if joint["kind"] not in _LINKS:
        return None
    place = {name: n for n, name in enumerate([*names, GROUND])}
    return [(place[joint[f"body_{side}"]], np.array(joint[f"point_{side}"])) for side in "ij"]
