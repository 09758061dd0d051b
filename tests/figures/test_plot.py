"""Figures show what the run holds, in units, with a legend."""

import io
import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import stmuav_jax as stm
from stmuav_jax.figures import drawing
from stmuav_jax.figures.numbers import joints_of, motion_of, numbers_of
from stmuav_jax.figures.plot import (
    FIGURES,
    STYLES,
    balances,
    content,
    grid,
    joints,
    look,
    pose,
    save_figures,
)
from stmuav_jax.figures.report import certificate_rows
from stmuav_jax.mechanics.joint_states import joint_motion
from stmuav_jax.tracker.kinematics import panel_angles


def test_pose_shows_the_base(short_run):
    position, tilt, turning = pose(short_run).axes
    base = short_run.body("hexacopter_1")
    for k, line in enumerate(position.lines):
        assert np.asarray(line.get_ydata()) == pytest.approx(np.asarray(base.r[:, k]))
    R = np.asarray(jax.vmap(stm.rotation.rotation_matrix)(base.p))
    wanted = np.degrees(np.arctan2(np.hypot(R[:, 0, 2], R[:, 1, 2]), R[:, 2, 2]))
    assert np.asarray(tilt.lines[0].get_ydata()) == pytest.approx(wanted, abs=1e-5)
    assert np.asarray(turning.lines[1].get_ydata()) == pytest.approx(np.asarray(base.omega[:, 1]))
    labels = [ax.get_ylabel() for ax in (position, tilt, turning)]
    assert all(
        unit in label for unit, label in zip(("[m]", "[degrees]", "[rad/s]"), labels, strict=True)
    )
    assert len({line.get_linestyle() for line in position.lines}) == 3


def test_many_curves_stay_apart_in_print():
    """By colour and marker up to 104; without colours by the marker up to 13, by the dash up to 8."""
    looks = [look(k) for k in range(104)]
    assert [(each["color"], each["linestyle"]) for each in looks[:4]] == list(STYLES)
    assert len({(each["color"], each["marker"]) for each in looks}) == 104
    assert len({each["marker"] for each in looks[:13]}) == 13
    assert len({each["linestyle"] for each in looks[:8]}) == 8


def test_joints_shows_strokes_and_panel_angles(short_run):
    figure = joints(short_run)
    assert figure is not None
    strokes, angles = figure.axes
    for line, name in zip(strokes.lines, ("T12", "T13"), strict=True):
        moved = short_run.joint(name).displacement
        assert np.asarray(line.get_ydata()) == pytest.approx(1e3 * (moved - moved[0]), abs=1e-9)
        assert str(line.get_label()).startswith(name)
    assert "[mm]" in strokes.get_ylabel()
    R, R_base = (
        np.asarray(jax.vmap(stm.rotation.rotation_matrix)(short_run.body(name).p))
        for name in ("panel_7", "hexacopter_1")
    )
    wanted = np.degrees(panel_angles(np.einsum("kji,kj->ik", R_base, R[:, :, 2])))
    for line, each in zip(angles.lines, wanted, strict=True):
        assert np.asarray(line.get_ydata()) == pytest.approx(each, abs=1e-9)


def test_angles_of_a_machine_without_a_panel_are_continuous():
    """A pendulum that turns over: 1.75 turns, against the package's own reading of the joint."""
    bar = stm.Body("bar", 1.0, np.eye(3), position=(0.0, 0.0, -1.0))
    hinge = stm.revolute("hinge", "ground", "bar", point=(0, 0, 0), axis=(0, 1.0, 0))
    system = stm.System([bar], joints=[hinge])
    angles = np.linspace(0.1, 3.5 * np.pi, 40)
    p = np.zeros((40, 1, 4))
    p[:, 0, 0], p[:, 0, 2] = np.cos(angles / 2), np.sin(angles / 2)
    r = np.stack([-np.sin(angles), 0 * angles, -np.cos(angles)], axis=1)[:, None]
    states = stm.State(*map(jnp.asarray, (r, p, 0 * r, 0 * r)))
    scene = SimpleNamespace(system=system, title="bar", watch=())
    body = lambda name: jax.tree.map(lambda x: x[:, 0], states)
    run: Any = SimpleNamespace(scene=scene, ts=np.arange(40.0), states=states, body=body)
    ((words, labels, found),) = joints_of(motion_of(run))[2]
    assert (words, labels) == ("joint angle [degrees]", ("hinge",))
    wanted = np.degrees(np.asarray(joint_motion(system, states, "hinge").coordinates))
    assert found == pytest.approx(wanted)
    assert np.ptp(found) == pytest.approx(630 - np.degrees(0.1))


def test_balances_have_one_unit_on_each_axis(short_run):
    figure = balances(short_run)
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "energy [J]", "length [m]", "energy [J]", "speed [m/s]",
    ]  # fmt: skip
    kinetic = np.asarray(figure.axes[0].lines[0].get_ydata())
    assert kinetic == pytest.approx(np.asarray(short_run.snapshot.kinetic))
    violation = np.asarray(figure.axes[1].lines[1].get_ydata())
    worst = np.asarray(short_run.trajectory.worst.position)
    # zeros are left out and are not a floor
    assert np.array_equal(np.isnan(violation), worst == 0)
    assert violation[worst > 0] == pytest.approx(worst[worst > 0], abs=0)


@pytest.mark.parametrize("suffix", ["png", "pdf"])
def test_saved_figures(short_run, tmp_path, suffix):
    paths = save_figures(FIGURES, tmp_path, suffix, short_run)
    assert [p.stem for p in paths] == list(FIGURES)
    magic = {"png": b"\x89PNG", "pdf": b"%PDF"}[suffix]
    assert all(p.read_bytes().startswith(magic) for p in paths)


def test_a_png_is_drawn_once(monkeypatch):
    """With the same bytes as by `savefig`, which draws it twice; the figure is left as it was."""

    def curve() -> Figure:
        figure, axes = grid(2, 1, 3.0)
        axes[0, 0].plot([0.0, 1.0], [2e-7, 3e-7], label="a curve")
        axes[0, 0].legend()
        axes[1, 0].set_ylabel("a long name\nof an axis")
        figure.suptitle("title")
        return figure

    buffer = io.BytesIO()
    curve().savefig(buffer, format="png", dpi=150)
    count, draw = [], Axes.draw
    monkeypatch.setattr(Axes, "draw", lambda ax, renderer: (count.append(ax), draw(ax, renderer)))
    figure = curve()
    engine, dpi = figure.get_layout_engine(), figure.dpi
    assert content(figure, "png", 150) == buffer.getvalue()
    assert len(count) == 2
    assert figure.get_layout_engine() is engine
    assert figure.dpi == dpi
    # one without a layout engine is saved as it stands
    plain = Figure(figsize=(1.0, 1.0))
    assert content(plain, "png", 50).startswith(b"\x89PNG")
    assert plain.get_layout_engine() is None


def test_certificate_rows_name_quantity_and_unit(short_run):
    rows = dict(certificate_rows(short_run))
    assert rows["Rank of the constraint Jacobian"] == "34 of 34 rows"
    assert rows["Constraint violation, lengths"].endswith(" m")
    assert rows["Constraint violation, angles"].endswith(" rad")
    assert rows["Violation of the angles' rates"].endswith(" rad/s")
    assert " m, at the end " in rows["Estimated position error"]
    assert not any("residual" in name for name in rows)
    assert rows["Result"] == "successful at t = 0.05 s"


@pytest.mark.parametrize("ends_early", [False, True])
def test_another_process_draws_the_same_figures(short_run, monkeypatch, ends_early):
    monkeypatch.setattr(drawing, "_processors", lambda: 2)
    monkeypatch.delitem(sys.modules, "matplotlib")
    numbers = {"pose": numbers_of(short_run)["pose"]}
    with drawing.drawing(True) as drawer:
        if ends_early:
            assert drawer.process is not None
            drawer.process.kill()
        drawer.ask(numbers, "png")
        assert drawer.files() == {"pose": content(pose(short_run), "png")}
    assert drawer.process is None or drawer.process.returncode is not None


def test_no_process_is_started_without_need(monkeypatch):
    for wanted, processors in ((False, 2), (True, 1), (True, 2)):
        # the last time matplotlib is here already
        monkeypatch.setattr(drawing, "_processors", lambda count=processors: count)
        with drawing.drawing(wanted) as drawer:
            assert drawer.process is None
