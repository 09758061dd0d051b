"""The sketch names all bodies and joints where they are; its graph has every joint once."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax import cli


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
    # a joint's name stands at its point on body j; the points on both bodies coincide at the start
    labels: Any = sketch.texts
    ends = {text.get_text().strip(): text.get_position_3d() for text in labels}
    kin = scene.system.kinematics(scene.state0)
    joint = kin.joint("S57")
    assert ends["S57"] == pytest.approx(np.asarray(kin.point("rod_5", joint.point_i)[0]))


def test_links_of_a_floating_platform_are_apart(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    models = Path(__file__).parents[2] / "docs" / "models"
    words = ["show", str(models / "stewart_platform.toml"), "--out", str(tmp_path), "--no-cache"]
    assert cli.main(words) == 0
    assert (tmp_path / "mechanism.png").stat().st_size > 10_000
    said = capsys.readouterr().out
    assert "mechanism.png" in said.replace("\n", "")
    # the platform floats: each of its six legs closes a loop
    assert said.count("closes a loop") == 6
    scene = stm.files.load_model(models / "stewart_platform.toml")
    labels = [text.get_position() for text in stm.draw(scene.system).axes[1].texts]
    # six legs and two bodies, no label on another
    assert len(labels) == 9
    assert len({(round(x, 3), round(y, 3)) for x, y in labels}) == 9
