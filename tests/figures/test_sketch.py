"""The sketch names all bodies and joints where they are; its graph has every joint once."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d import proj3d

import stmuav_jax as stm
from stmuav_jax.cli import main as cli
from stmuav_jax.cli.view import View, view_options

MODELS = Path(__file__).parents[2] / "docs" / "models"


def texts(axes):
    return [text.get_text().strip() for text in axes.texts]


def test_sketch_and_graph_have_every_body_and_joint(short_run):
    scene = short_run.scene
    figure = stm.draw(scene)
    sketch, graph = figure.axes
    bodies, joints = scene.system.names, [joint.name for joint in scene.system.joints]
    assert sorted(texts(sketch)) == sorted([*bodies, *joints])
    assert sorted(text.split("\n")[0] for text in texts(graph)) == sorted([*bodies, *joints])
    # two joints close loops
    dashed = [line for line in graph.lines if line.get_linestyle() == "--"]
    assert len(dashed) == 2
    assert len(graph.lines) == len(joints)
    # a joint's name belongs to its point; the points on both bodies coincide at the start
    labels: Any = sketch.texts
    ends = {text.get_text().strip(): text.xy for text in labels}
    kin = scene.system.kinematics(scene.state0)
    x, y, z = np.asarray(kin.point("rod_5", kin.joint("S57").point_i)[0])
    sketch_axes: Any = sketch
    assert ends["S57"] == pytest.approx(
        proj3d.proj_transform(x, y, z, sketch_axes.get_proj())[:2], abs=1e-9
    )


@pytest.mark.parametrize(("model", "counts"), [("delta_robot", (13, 15)), ("tracker", (14, 15))])
def test_names_in_a_sketch_do_not_overlap(model, counts):
    """The delta robot has six rods that end at one platform; joints of the tracker are close."""
    figure = stm.draw(stm.io.load_model(MODELS / f"{model}.toml"))
    figure.draw_without_rendering()
    # names are dark enough to be read on white
    colours: Any = [to_rgb(text.get_color()) for text in figure.axes[0].texts]
    assert max(np.dot(colour, (0.299, 0.587, 0.114)) for colour in colours) < 0.41
    for axes, words in zip(figure.axes, counts, strict=True):
        boxes = [Text.get_window_extent(text) for text in axes.texts]
        assert len(boxes) == words
        pairs = [(a, b) for k, a in enumerate(boxes) for b in boxes[:k]]
        overlaps = [Bbox.intersection(a, b) for a, b in pairs]
        areas = [0.0 if box is None else box.width * box.height for box in overlaps]
        # a name has some 700 square pixels; boxes of text have a margin
        assert max(areas) < 1


def test_links_of_a_floating_platform_are_apart(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    words = ["view", str(MODELS / "stewart_platform.toml"), "--out", str(tmp_path), "--no-cache"]
    assert cli.main(words) == 0
    assert (tmp_path / "mechanism.png").stat().st_size > 10_000
    said = capsys.readouterr().out
    assert "mechanism.png" in said.replace("\n", "")
    # the platform floats: each of its six legs closes a loop
    assert said.count("closes a loop") == 6
    scene = stm.io.load_model(MODELS / "stewart_platform.toml")
    labels = [text.get_position() for text in stm.draw(scene.system).axes[1].texts]
    # six legs and two bodies, no label on another
    assert len(labels) == 9
    assert len({(round(x, 3), round(y, 3)) for x, y in labels}) == 9


def test_a_folder_of_results_with_the_name_of_a_scene_is_a_result(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert view_options(["spin"]) is not View
    (tmp_path / "spin").mkdir()
    assert view_options(["spin", "--html", "spin.html"]) is View
