"""A film has the frames that were asked for, and each shows the run at its time."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PIL import Image, ImageSequence
from scipy.spatial.transform import Rotation, Slerp

import stmuav_jax as stm
from stmuav_jax import cli
from stmuav_jax.files.machine import posture
from stmuav_jax.files.netcdf import FileError, save, to_dataset
from stmuav_jax.viewer import filming
from stmuav_jax.viewer.filming import film, frame_times
from stmuav_jax.viewer.shapes import body_shapes
from stmuav_jax.viewer.stage import Stage
from stmuav_jax.viewer.surfaces import JOINT, PANEL, joint_shapes, quads, rgb, surface_of

SIZE = (160, 120)


@pytest.fixture(scope="module")
def data(short_run):
    return to_dataset(short_run)


def stage_of(data, view, size=SIZE):
    return Stage(data, size, view, (float(data.time[0]), float(data.time[-1])))


def vertices(stage):
    return np.concatenate([np.asarray(path.vertices) for path in stage.solids.get_paths()])


def missed(stage, points):
    """Largest distance [m] in the picture of points from the nearest corner that is drawn."""
    places = stage.camera.project(points)
    gaps = np.linalg.norm(vertices(stage)[None] - places[:, None], axis=2)
    return float(np.max(np.min(gaps, axis=1)))


def panel_corners(data, r, R):
    """World points of the corners of the panel's upper side for a pose of its body."""
    (shape, *_) = body_shapes(data, "panel_7")
    a, b, c = shape.size
    local = 0.5 * np.array([[a, b, c], [-a, b, c], [-a, -b, c], [a, -b, c]])
    own = Rotation.from_quat(np.roll(shape.orientation, -1)).as_matrix()
    return r + (shape.position + local @ own.T) @ R.T


def test_gif_has_its_frames_and_its_duration(short_run, tmp_path):
    done = []
    path = film(short_run, tmp_path / "run.gif", fps=30, speed=0.3, size=SIZE, progress=done.append)
    with Image.open(path) as picture:
        delays = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
        frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(picture)]
        assert picture.info["loop"] == 0
    # 0.01 s of the motion in each of six frames; hundredths of a second add up without an error
    assert delays == [30, 40, 30, 30, 40, 30]
    assert all(frame.shape == (120, 160, 3) for frame in frames)
    assert all(np.any(a != b) for a, b in pairwise(frames))
    assert done == pytest.approx(np.arange(1, 7) / 6)
    # the palette of the file changes no colour by much
    stage = Stage(to_dataset(short_run), SIZE, (24.0, -53.0), (0.0, 0.05), "speed 0.3")
    stage.draw(0.03)
    assert np.mean(np.abs(frames[3].astype(float) - stage.pixels())) < 2.0


@pytest.mark.parametrize("view", [(90.0, -90.0), (35.0, 20.0)])
def test_drawn_points_are_those_of_the_run(data, short_run, view):
    stage = stage_of(data, view)
    stage.draw(0.03)
    panel, base = short_run.body("panel_7"), short_run.body("hexacopter_1")
    R = np.asarray(stm.rotation.rotation_matrix(panel.p[3]))
    assert missed(stage, panel_corners(data, panel.r[3], R)) < 1e-9
    end = np.array(stage.trail.get_data())[:, -1]
    assert end == pytest.approx(stage.camera.project(base.r[3]), abs=1e-12)
    # from above, right is x and up is y
    if view[0] == 90:
        assert end == pytest.approx(base.r[3, :2], abs=1e-12)


def test_between_saved_times_the_way_is_linear_and_the_turn_shortest(data, short_run):
    stage, t = stage_of(data, (60.0, 10.0)), 0.0325
    stage.draw(t)
    panel = short_run.body("panel_7")
    turn = Slerp([0.03, 0.04], Rotation.from_quat(panel.p[3:5][:, [1, 2, 3, 0]]))
    r = 0.75 * panel.r[3] + 0.25 * panel.r[4]
    corners = panel_corners(data, r, turn(t).as_matrix())
    assert missed(stage, corners) < 1e-9
    # Euler parameters of either sign are the same orientation
    p = data["euler_parameters"].copy(deep=True)
    p[4] *= -1
    flipped = stage_of(data.assign(euler_parameters=p), (60.0, 10.0))
    flipped.draw(t)
    assert missed(flipped, corners) < 1e-9


def test_the_panel_has_its_colour_where_it_is(data, short_run):
    stage = stage_of(data, (60.0, -90.0), (480, 360))
    stage.draw(0.02)
    panel = short_run.body("panel_7")
    R = np.asarray(stm.rotation.rotation_matrix(panel.p[2]))
    corners = panel_corners(data, panel.r[2], R)
    # the middle of a corner's solar cell, an eighth of the side from both edges
    cell = (49 * corners[0] + 7 * (corners[1] + corners[3]) + corners[2]) / 64
    x, y = stage.figure.axes[0].transData.transform(stage.camera.project(cell))
    found = stage.pixels()[359 - int(y), int(x)] / 255
    shade = found / rgb(PANEL)
    assert np.ptp(shade) < 0.1
    assert 0.6 < np.mean(shade) < 1.15
    sky = stage.pixels()[5, 475] / 255
    assert np.min(sky) > 0.9


def test_lengths_are_equal_in_both_directions(data):
    for size in ((300, 120), (120, 300)):
        stage = stage_of(data, (20.0, 30.0), size)
        stage.draw(0.0)
        (ax,) = stage.figure.axes
        scale = [
            np.diff(lim)[0] / n for lim, n in zip((ax.get_xlim(), ax.get_ylim()), size, strict=True)
        ]
        assert scale[0] == pytest.approx(scale[1], rel=1e-4)
        # all of the machine is in the picture
        low, high = vertices(stage).min(axis=0), vertices(stage).max(axis=0)
        assert ax.get_xlim()[0] < low[0] < high[0] < ax.get_xlim()[1]
        assert ax.get_ylim()[0] < low[1] < high[1] < ax.get_ylim()[1]


def test_a_machine_that_travels_is_followed(data):
    away = data["position"] + 20 * data["time"] * xr.DataArray([1.0, 2.0, 0.5], dims="axis")
    stage = stage_of(data.assign(position=away.transpose("time", "body", "axis")), (24.0, -53.0))
    widths = []
    for t in (0.0, 0.05):
        stage.draw(t)
        (ax,) = stage.figure.axes
        x, y = np.array(stage.trail.get_data())[:, -1]
        assert ax.get_xlim()[0] < x < ax.get_xlim()[1]
        assert ax.get_ylim()[0] < y < ax.get_ylim()[1]
        widths.append(np.diff(ax.get_xlim())[0])
    assert widths[0] == pytest.approx(widths[1])
    assert widths[0] < 6


def test_surfaces_are_closed_and_face_outwards(data):
    surface = surface_of(data)
    a, b, c, d = np.moveaxis(surface.corners, 1, 0)
    area = 0.5 * np.cross(c - a, d - b)
    # the outward areas of a closed surface sum to zero, and its volume is positive
    for body in np.unique(surface.body):
        own = surface.body == body
        outward = surface.normals[own] * np.linalg.norm(area[own], axis=1, keepdims=True)
        assert np.linalg.norm(outward.sum(axis=0)) < 1e-12
        middle = surface.corners[own].mean(axis=1)
        assert np.sum(outward * middle) / 3 > 0
    (shape, *_) = body_shapes(data, "panel_7")
    corners, cells = quads(shape)
    assert np.sum(cells) == 16
    assert len(corners) == 48


def test_massless_rods_are_drawn_between_their_points():
    scene = stm.files.load_model(Path(__file__).parents[2] / "docs/models/delta_robot.toml")
    one = posture(scene.system, scene.state0)
    still = xr.concat([one, one], dim="time", data_vars="minimal").assign_coords(time=[0.0, 1.0])
    stage = stage_of(still, (30.0, -50.0))
    stage.draw(0.5)
    bodies = ["ground", *scene.system.names]
    r = np.concatenate([np.zeros((1, 3)), one.position.values[0]])
    p = np.concatenate([[[1.0, 0, 0, 0]], one.euler_parameters.values[0]])
    com = np.concatenate([np.zeros((1, 3)), one.centre_of_mass.values])
    R = Rotation.from_quat(p[:, [1, 2, 3, 0]]).as_matrix()
    rods = [joint for joint in scene.system.joints if joint.kind == "distance"]
    assert len(rods) == 6
    # faces with two sides have their colour without shade
    colours = np.asarray(stage.solids.get_facecolor())[:, :3]
    plain = np.all(colours == rgb(JOINT), axis=1)
    outlines = [np.asarray(path.vertices) for path in stage.solids.get_paths()]
    middles = np.array([outline[:4] for outline in outlines])[plain].mean(axis=1)
    for joint in rods:
        sides = ((joint.body_i, joint.point_i), (joint.body_j, joint.point_j))
        own = [(bodies.index(name), np.asarray(point)) for name, point in sides]
        ends = [r[b] + R[b] @ (point - com[b]) for b, point in own]
        gaps = middles - stage.camera.project(np.mean(ends, axis=0))
        assert np.min(np.linalg.norm(gaps, axis=1)) < 1e-9
    assert len(middles) == 6


def test_parts_of_joints_are_those_of_the_page():
    frame = np.eye(3).tolist()
    joint = {"point_i": [0, 0, 0], "point_j": [0, 0, 1], "frame_i": frame, "frame_j": frame,
             "body_i": "ground", "body_j": "a", "name": "j"}  # fmt: skip
    kinds = {
        kind: [(body, shape.kind) for body, shape, _ in joint_shapes(joint | more, 1.0)]
        for kind, more in {
            "revolute": {"kind": "revolute"}, "universal": {"kind": "universal"},
            "weld": {"kind": "weld"}, "spherical": {"kind": "spherical"},
            "translational": {"kind": "translational", "slide": [0.0, 0.5]},
        }.items()
    }  # fmt: skip
    plate = ("ground", "box")
    assert kinds["revolute"] == [("a", "cylinder"), plate]
    assert kinds["universal"] == [("ground", "cylinder"), ("a", "cylinder"), plate]
    assert kinds["weld"] == [("a", "box"), plate]
    assert kinds["spherical"] == [("a", "sphere"), plate]
    assert kinds["translational"] == [("ground", "cylinder"), plate]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"fps": 0}, "frames per second of a film must be positive, but it is 0"),
        ({"fps": float("nan")}, "must be positive, but it is nan"),
        ({"fps": 60.0}, "at most 50 frames per second, but 60"),
        ({"fps": 1.0}, "there is one frame at 1 frames per second"),
        ({"speed": -1.0}, "speed of a film must be positive, but it is -1"),
        ({"span": (0.0, 0.2)}, "within those of the run, 0 to 0.05 s, but it is 0 to 0.2 s"),
        ({"span": (0.03, 0.01)}, "the earlier first"),
        ({"span": (0.0, float("inf"))}, "The span of a film must be finite"),
        ({"view": (91.0, 0.0)}, "within -90 and 90 degrees, but it is 91"),
        ({"size": (640, 20)}, r"within 64 and 4096, but it is \(640, 20\)"),
        ({"path": "run.avi"}, "ends with .gif or .mp4, but this one is 'run.avi'"),
        ({"path": "run"}, "ends with .gif or .mp4"),
        ({"path": "run.mp4", "size": (641, 480)}, "two even whole numbers of pixels"),
    ],
)  # fmt: skip
def test_errors_say_what_is_wrong(data, tmp_path, wrong, words):
    path = tmp_path / wrong.pop("path", "run.gif")
    with pytest.raises(stm.SettingError, match=words):
        film(data, path, **wrong)
    assert not path.exists()


def test_a_run_without_motion_is_an_error(data, tmp_path):
    with pytest.raises(FileError, match="nothing moves at one time"):
        stage_of(data.isel(time=[0]), (0.0, 0.0))
    with pytest.raises(FileError, match="cannot be drawn, because it was saved without inertia"):
        film(data.drop_vars("inertia"), tmp_path / "run.gif")


def test_frames_end_with_the_span():
    assert frame_times((0.0, 2.0), 25.0) == pytest.approx(np.arange(51) / 25)
    assert frame_times((0.1, 0.4), 10.0) == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert frame_times((0.0, 0.35), 10.0, 0.5) == pytest.approx(0.05 * np.arange(8))


# --- MP4


def test_mp4_has_its_frames(data, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = film(data, tmp_path / "run.mp4", fps=25.0, speed=0.25, size=(320, 240))
    count, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert count == 6
    assert seconds == pytest.approx(6 / 25, abs=0.01)
    # not `read_frames`: it forks, of which JAX warns
    decode = [ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(decode, capture_output=True, check=True).stdout
    pictures = np.frombuffer(raw, np.uint8).reshape(6, 240, 320, 3)
    stage = Stage(data, (320, 240), (24.0, -53.0), (0.0, 0.05), "speed 0.25")
    stage.draw(0.03)
    assert np.mean(np.abs(pictures[3].astype(float) - stage.pixels())) < 4.0


def test_mp4_without_ffmpeg_names_the_extra(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(filming.shutil, "which", lambda name: None)
    with pytest.raises(stm.SettingError, match=r"pip install 'stmuav-jax\[film\]'"):
        film(data, tmp_path / "run.mp4")


def test_a_failing_ffmpeg_is_quoted(data, tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho no such encoder >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    with pytest.raises(FileError, match="could not write the film: no such encoder"):
        film(data, tmp_path / "run.mp4", speed=0.25, size=SIZE)
    assert not (tmp_path / "run.mp4").exists()


# --- the command


def test_command_writes_films(short_run, tmp_path, capsys):
    save(short_run, tmp_path / "run.nc")
    words = ["view", str(tmp_path), "--gif", str(tmp_path / "a.gif"), "--size", "160", "120"]
    assert cli.main([*words, "--playback", "0.5", "--span", "0", "0.04", "--eye", "90", "-90"]) == 0
    assert "a.gif" in capsys.readouterr().out.replace("\n", "")
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.size, picture.n_frames) == ((160, 120), 3)  # pyright: ignore[reportAttributeAccessIssue]
    assert cli.main(["view", str(tmp_path), "--gif", str(tmp_path / "a.mp4")]) == 2
    assert cli.main([*words, "--sun", "135", "50"]) == 2
    assert cli.main([*words, "--fps", "0"]) == 2
    said = capsys.readouterr().err.replace("\n", " ")
    assert "must end with .gif, but it is 'a.mp4'" in said
    assert "--sun is for the page" in said
    assert "number of frames per second must be above 0" in said
