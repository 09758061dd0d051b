"""A film has the frames that were asked for, and each shows the run at its time."""

import sys
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import xarray as xr
from PIL import Image, ImageSequence
from scipy.spatial.transform import Rotation

import stmuav_jax as stm
from stmuav_jax.cli import main as cli
from stmuav_jax.figures.films import draw_mechanism, film, frame_times, make_faces
from stmuav_jax.figures.page import interpolate_poses
from stmuav_jax.figures.shapes import body_shapes
from stmuav_jax.io import FileError, save, to_dataset

SIZE = (160, 120)
VIEW = (24.0, -53.0)


@pytest.fixture(scope="module")
def data(short_run):
    return to_dataset(short_run)


def drawn_corners(data, t, size=SIZE):
    """Corners of all faces that the picture at a time shows (f, 4, 3), and the axes."""
    figure, draw = draw_mechanism(data, np.array([0.0, t]), size, VIEW)
    draw(1)
    axes: Any = figure.axes[0]
    return np.asarray(axes.collections[0]._faces), axes


@pytest.mark.slow
def test_gif_has_its_frames_and_its_duration(short_run, tmp_path):
    shares = []
    path = film(
        short_run, tmp_path / "run.gif", fps=20, speed=0.2, size=SIZE, progress=shares.append
    )
    with Image.open(path) as picture:
        delays = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
        frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(picture)]
        assert picture.info["loop"] == 0
    # 0.01 s of the motion in each of six frames
    assert delays == [50] * 6
    assert all(frame.shape == (120, 160, 3) for frame in frames)
    assert all(np.any(a != b) for a, b in pairwise(frames))
    assert shares == pytest.approx(np.arange(1, 7) / 6)


def test_the_panel_is_drawn_where_the_run_has_it(data, short_run):
    corners, axes = drawn_corners(data, 0.03)
    panel = short_run.body("panel_7")
    R_wb = np.asarray(stm.rotation.rotation_matrix(panel.p[3]))
    (shape, *_) = body_shapes(data, "panel_7")
    a, b, c = shape.size
    local = 0.5 * np.array([[a, b, c], [-a, b, c], [-a, -b, c], [a, -b, c]])
    turn = Rotation.from_quat(np.roll(shape.orientation, -1)).as_matrix()
    world = panel.r[3] + (shape.position + local @ turn.T) @ R_wb.T
    gaps = np.linalg.norm(corners.reshape(-1, 1, 3) - world, axis=2).min(axis=0)
    assert np.max(gaps) < 1e-9
    low, high = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()]).T
    # one scale for all axes, along which the box may differ
    assert np.ptp((high - low) / axes.get_box_aspect()) < 1e-9
    assert np.all(low < corners.min(axis=(0, 1)))
    assert np.all(corners.max(axis=(0, 1)) < high)


def test_between_saved_times_the_path_is_linear_and_the_turn_shortest(data, short_run):
    r, R_wb = interpolate_poses(data, np.array([0.0325]))
    k = list(data["body"].values).index("panel_7")
    panel = short_run.body("panel_7")
    assert r[0, k] == pytest.approx(0.75 * panel.r[3] + 0.25 * panel.r[4], abs=1e-12)
    start, end = Rotation.from_quat(panel.p[3:5][:, [1, 2, 3, 0]])
    turned = start * Rotation.from_rotvec(0.25 * (start.inv() * end).as_rotvec())
    assert R_wb[0, k] == pytest.approx(turned.as_matrix(), abs=1e-12)
    # Euler parameters of either sign are the same orientation
    p = data["euler_parameters"].copy(deep=True)
    p[4] *= -1
    again = interpolate_poses(data.assign(euler_parameters=p), np.array([0.0325]))
    assert again[1] == pytest.approx(R_wb, abs=1e-12)


def test_a_machine_that_travels_is_followed(data):
    shift = 60 * data["time"] * xr.DataArray([1.0, 2.0, 0.5], dims="axis")
    moved = data.assign(position=(data["position"] + shift).transpose("time", "body", "axis"))
    corners, axes = drawn_corners(moved, 0.05)
    low, high = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()]).T
    middle = 0.5 * (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1)))
    assert np.all(low < middle)
    assert np.all(middle < high)
    still = drawn_corners(data, 0.05)[1].get_xlim()
    assert np.ptp(axes.get_xlim()) == pytest.approx(np.ptp(still), rel=0.02)


def test_surfaces_are_closed_and_face_outwards(data):
    names = [*(str(name) for name in data["body"].values), "ground"]
    body, corners, normals, _ = make_faces(data, names)
    a, b, c, d = np.moveaxis(corners, 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(c - a, d - b), axis=1)
    # the outward areas of a closed surface sum to zero, and its volume is positive
    for k in np.unique(body):
        outward = (normals * area[:, None])[body == k]
        assert np.linalg.norm(outward.sum(axis=0)) < 1e-12
        assert np.sum(outward * corners[body == k].mean(axis=1)) / 3 > 0


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"fps": 0}, r"rate of a film \[frames/s\] must be positive and at most 50 in run.gif, but it is 0"),
        ({"fps": 1.0}, "there is one at 1 frames per second"),
        ({"span": (0.0, 0.2)}, "within those of the run, 0 to 0.05 s, but it is 0 to 0.2 s"),
        ({"path": "run.avi"}, "ends with .gif or .mp4, but this one is 'run.avi'"),
        ({"path": "run.mp4", "size": (641, 480)}, "two even whole numbers of pixels"),
    ],
)  # fmt: skip
def test_errors_say_what_is_wrong(data, tmp_path, wrong, words):
    path = tmp_path / wrong.pop("path", "run.gif")
    with pytest.raises(stm.SettingError, match=words):
        film(data, path, **wrong)
    assert not path.exists()


def test_a_run_without_motion_is_an_error(data, tmp_path):
    with pytest.raises(FileError, match="a motion needs two"):
        interpolate_poses(data.isel(time=[0]), np.array([0.0]))
    with pytest.raises(FileError, match="cannot be drawn, because it was saved without inertia"):
        film(data.drop_vars("inertia"), tmp_path / "run.gif")


def test_frames_end_with_the_span():
    saved = np.array([0.0, 2.0])
    assert frame_times(saved, None, 25.0, 1.0) == pytest.approx(np.arange(51) / 25)
    assert frame_times(saved, (0.1, 0.4), 10.0, 1.0) == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert frame_times(saved, (0.0, 0.35), 10.0, 0.5) == pytest.approx(0.05 * np.arange(8))


@pytest.mark.slow
def test_mp4_has_its_frames(data, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = film(data, tmp_path / "run.mp4", fps=25.0, speed=0.25, size=(320, 240))
    count, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert count == 6
    assert seconds == pytest.approx(6 / 25, abs=0.01)


def test_mp4_without_ffmpeg_names_the_package(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(stm.SettingError, match="pip install imageio-ffmpeg"):
        film(data, tmp_path / "run.mp4")


def test_a_failing_ffmpeg_leaves_no_film(data, tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho no such encoder >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    with pytest.raises(FileError, match="The film could not be written"):
        film(data, tmp_path / "run.mp4", speed=0.25, size=SIZE)
    assert not (tmp_path / "run.mp4").exists()


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
    output = capsys.readouterr().err.replace("\n", " ")
    assert "must end with .gif, but it is 'a.mp4'" in output
    assert "--sun is for the page" in output
    assert "number of frames per second must be above 0" in output
