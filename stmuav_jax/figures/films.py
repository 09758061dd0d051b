"""Film of the moving mechanism of a saved run, as GIF or MP4, by Matplotlib's 3-D axes and writers.

Bodies have the shapes of the viewer's page, joints are balls, rotors discs; the axes are in metres.
"""

import contextlib
import importlib
import itertools
import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from ..checks.errors import SettingError
from ..checks.numbers import check_numbers
from ..checks.shapes import Numbers
from ..control.closed_loop import LoopRun
from ..dynamics.simulation import Run
from ..io.netcdf import FileError, write_atomically
from ..mechanics.body import GROUND
from .page import (
    check_viewable,
    dataset_of,
    finite_times,
    interpolate_poses,
    watched_bodies,
)
from .shapes import COLOURS, JOINT_COLOUR, joint_of, machine_size, make_faces

# Browsers show a frame of a GIF for at least 0.02 s.
_FASTEST = {".gif": 50.0, ".mp4": 240.0}
# Size of the box of a film by that of the motion, and its smallest edge by the largest.
_MARGIN, _FLATTEST = 1.05, 0.4
# Width and height of a picture for the title and the labels of the axes [pixels].
_LABELS = np.array([110.0, 85.0])
# Distance by its size from which on a machine is followed.
_FAR = 1.5

Times = Float[np.ndarray, " k"]


def film(
    run: Run | LoopRun | xr.Dataset | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    fps: float | int = 25.0,
    size: Sequence[int] = (640, 480),
    span: Numbers | None = None,
    view: Numbers = (24.0, -53.0),
    speed: float | int = 1.0,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Film of the moving mechanism of a run, written atomically; return the file's path.

    Frame k shows the time t_first + k speed / fps. A GIF plays exactly at its speed if fps divides 100.

    Args:
        run: run or closed loop's run; or the dataset, file or folder of a saved one.
        path: file that ends with .gif or .mp4. MP4 needs ffmpeg, from the extra `film` or the PATH.
        fps: frames per second of the film [1/s], at most 240, in a GIF 50.
        size: width and height [pixels], from 64 to 4096, even numbers for MP4.
        span: first and last time that is shown [s]; default all.
        view: elevation and azimuth of the eye [degrees].
        speed: seconds of the motion in a second of the film; 0.1 is slow motion.
        progress: called with the completed share, from 0 to 1, after every frame.

    Raises:
        FileError: no saved run, one that lacks what is drawn, or ffmpeg fails.
        SettingError: another ending, a number out of its range, or MP4 without ffmpeg.
    """
    target, suffix = Path(path), Path(path).suffix.lower()
    if suffix not in _FASTEST:
        raise SettingError(
            f"A film is a file that ends with .gif or .mp4, but this one is '{target.name}'."
        )
    step, kind = (2, "even whole numbers") if suffix == ".mp4" else (1, "whole numbers")
    fits = lambda n: isinstance(n, int | np.integer) and 64 <= n <= 4096 and n % step == 0
    if len(size) != 2 or not all(map(fits, size)):
        raise SettingError(
            f"The size of the film must be two {kind} of pixels within 64 and 4096, but it is {tuple(size)}."
        )
    limits = (
        (fps, "rate of a film [frames/s]", _FASTEST[suffix]),
        (speed, "speed of a film", math.inf),
    )
    for value, quantity_name, most in limits:
        if not (math.isfinite(value) and 0 < value <= most):
            bound = "" if math.isinf(most) else f" and at most {most:g} in {target.name}"
            raise SettingError(f"The {quantity_name} must be positive{bound}, but it is {value:g}.")
    eye = check_numbers(view, (2,), "The elevation and azimuth of the eye", "degrees", SettingError)
    if abs(eye[0]) > 90:
        raise SettingError(
            f"The elevation of the eye must lie within -90 and 90 degrees, but it is {eye[0]:g}."
        )
    data = dataset_of(run)
    check_viewable(data)
    times = frame_times(data["time"].values[finite_times(data)], span, fps, speed)
    figure, draw = draw_mechanism(data, times, size, eye, "" if speed == 1 else f"speed {speed:g}")
    rate: Any = fps
    settings: Any = {}
    writer: Any = PillowWriter(fps=rate)
    if suffix == ".mp4":
        settings["animation.ffmpeg_path"] = _find_ffmpeg()
        # H.264 with 4:2:0 colours plays in every browser.
        extra = ["-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
        writer = FFMpegWriter(fps=rate, codec="libx264", extra_args=extra)
    # Drawn aside and moved at the end: an interrupted film leaves no half of a file.
    with matplotlib.rc_context(settings), tempfile.TemporaryDirectory() as folder:
        film_path = Path(folder) / f"film{suffix}"
        try:
            with writer.saving(figure, film_path, dpi=100):
                for k in range(len(times)):
                    draw(k)
                    writer.grab_frame()
                    if progress is not None:
                        progress((k + 1) / len(times))
        except (OSError, subprocess.CalledProcessError) as error:
            reason = " ".join(str(error).split())[:500]
            raise FileError(f"The film could not be written: {reason}") from error
        return write_atomically(target, film_path.read_bytes())


def frame_times(
    ts: Float[np.ndarray, " s"], span: Numbers | None, fps: float | int, speed: float | int
) -> Times:
    """Times that the frames of a film show (k,) [s], within the saved times `ts` [s]; see `film`."""
    first, last = start, end = float(ts[0]), float(ts[-1])
    if span is not None:
        first, last = map(float, check_numbers(span, (2,), "The span of a film", "s", SettingError))
    # saved times are decimal fractions only up to round-off
    slack = 1e-9 * max(abs(start), abs(end))
    if span is not None and not start - slack <= first < last <= end + slack:
        raise SettingError(
            f"The span of a film must be two times, the earlier first, within those of the run, {start:g} "
            f"to {end:g} s, but it is {first:g} to {last:g} s."
        )
    count = math.floor((last - first) * fps / speed * (1 + 1e-12) + 1e-9) + 1
    if count < 2:
        raise SettingError(
            f"A film needs at least two frames, but from {first:g} to {last:g} s there is one at {fps:g} "
            f"frames per second and a speed of {speed:g}: use more frames per second or a lower speed."
        )
    return np.clip(first + np.arange(count) * speed / fps, start, end)


def draw_mechanism(
    run: xr.Dataset, times: Times, size: Sequence[int], view: Any, caption: str = ""
) -> tuple[Figure, Callable[[int], None]]:
    """Figure of the mechanism of a saved run, and a function that moves it to the time of frame k; see `film`."""
    r, R_wb = interpolate_poses(run, times)
    # ground is the last body
    r = np.concatenate([r, np.zeros((len(times), 1, 3))], axis=1)
    R_wb = np.concatenate([R_wb, np.broadcast_to(np.eye(3), (len(times), 1, 3, 3))], axis=1)
    names = [*(str(name) for name in run["body"].values), GROUND]
    body, corners, normals, colours = make_faces(run, names)
    rods = [
        [(names.index(joint[f"body_{side}"]), np.array(joint[f"point_{side}"])) for side in "ij"]
        for joint in (joint_of(run, k) for k in range(run.sizes.get("joint", 0)))
        if joint["kind"] in ("distance", "revolute_spherical")
    ]
    # a little more, as Agg cuts 114.99999 pixels to 114
    width, height = ((n + 1e-3) / 100 for n in size)
    figure = Figure(figsize=(width, height), dpi=100)
    # Labels are on the right and below, the title above: only to the left is room.
    place = (-0.33 * _LABELS[0] / size[0], 0.0, 1.0, 1.0)
    axes: Any = figure.add_axes(place, projection="3d", proj_type="ortho")
    axes.view_init(*view)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=4)
    faces = axes.add_collection3d(Poly3DCollection(list(corners), linewidths=0.3), autolim=False)
    lines = Line3DCollection([], colors=JOINT_COLOUR, linewidths=1.5)
    axes.add_collection3d(lines, autolim=False)
    base = names.index(watched_bodies(run)[0])
    (trail,) = axes.plot([], [], [], color=COLOURS[0], linewidth=1.2)
    title = str(run.attrs.get("title", "")) or str(run.attrs.get("scene", ""))
    figure.text(0.02, 0.97, title, va="top", fontsize=9, parse_math=False)
    # Below, where a long title cannot push it out of the picture.
    clock = figure.text(0.02, 0.03, "", fontsize=9)
    length = machine_size(run)
    # the axes follow a machine that travels far
    follows = bool(np.linalg.norm(np.ptp(r[:, base], axis=0)) > _FAR * length)
    moved_by = r[:, base] if follows else np.zeros_like(r[:, base])

    def corners_at(k: int) -> np.ndarray:
        return np.einsum("fij,fkj->fki", R_wb[k, body], corners) + r[k, body][:, None]

    # One box for all frames, or else the picture would jump. It is as flat as the motion, with one scale
    # for all axes: a cube would leave most of the picture empty.
    frames = range(len(times))
    low = np.min([(corners_at(k) - moved_by[k]).min(axis=(0, 1)) for k in frames], axis=0)
    high = np.max([(corners_at(k) - moved_by[k]).max(axis=(0, 1)) for k in frames], axis=0)
    half = 0.5 * (high - low)
    half = _MARGIN * np.maximum(half, _FLATTEST * np.max(half))
    # The box is as large as a picture with labels allows. Matplotlib would scale an array in place.
    axes.set_box_aspect(half.tolist())
    axes.apply_aspect()
    box = np.array(list(itertools.product(axes.get_xlim3d(), axes.get_ylim3d(), axes.get_zlim3d())))
    x, y, _ = proj_transform(box[:, 0], box[:, 1], box[:, 2], axes.get_proj())
    extent = np.ptp(axes.transData.transform(np.column_stack([x, y])), axis=0)
    space = np.maximum(np.asarray(size) - _LABELS, 0.5 * np.asarray(size))
    axes.set_box_aspect(half.tolist(), zoom=float(np.min(space / extent)))
    azimuth = math.radians(float(view[1])) + 0.5
    # Light from beside the eye: faces of one body differ in shade from any direction.
    light = np.array([math.cos(azimuth), math.sin(azimuth), 1.0]) / math.sqrt(2.0)
    digits = int(np.clip(3 - np.floor(np.log10(times[-1] - times[0])), 1, 6))

    def draw_frame(k: int) -> None:
        world_normals = np.einsum("fij,fj->fi", R_wb[k, body], normals)
        shaded = np.clip(colours * (0.75 + 0.3 * (world_normals @ light)[:, None]), 0.0, 1.0)
        faces.set_verts(list(corners_at(k)))
        faces.set_facecolor(shaded)
        faces.set_edgecolor(shaded)
        lines.set_segments([[r[k, n] + R_wb[k, n] @ point for n, point in rod] for rod in rods])
        trail.set_data_3d(*r[: k + 1, base].T)
        middle = 0.5 * (low + high) + moved_by[k]
        ends = zip("xyz", middle - half, middle + half, strict=True)
        axes.set(**{f"{x}lim": (a, b) for x, a, b in ends})
        clock.set_text(f"t = {times[k]:.{digits}f} s   {caption}")

    return figure, draw_frame


def _find_ffmpeg() -> str:
    """Path of ffmpeg: of the package imageio-ffmpeg, or on the PATH."""
    with contextlib.suppress(ImportError, RuntimeError):
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    program = shutil.which("ffmpeg")
    if program is None:
        raise SettingError(
            "An MP4 needs ffmpeg: pip install imageio-ffmpeg, or put ffmpeg on the PATH. A GIF needs neither."
        )
    return program
