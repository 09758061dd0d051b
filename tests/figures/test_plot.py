"""Figures show what the run holds, in units, with a legend."""

import io
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import stmuav_jax as stm
from stmuav_jax.figures.plot import STYLES, figure_content, grid, look, save_figures
from stmuav_jax.figures.run import (
    FIGURES,
    Motion,
    balances,
    joints,
    joints_of,
    motion_of,
    pose,
    positions,
)
from stmuav_jax.figures.terminal import certificate_rows, summary_rows
from stmuav_jax.mechanics.joint_states import joint_motion
from stmuav_jax.uav.tracker.kinematics import panel_angles


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
    assert figure is not None
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


def test_saved_figures(short_run, tmp_path):
    paths = save_figures(FIGURES, tmp_path, "png", short_run)
    assert [p.stem for p in paths] == list(FIGURES)
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in paths)


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
    assert figure_content(figure, "png", 150) == buffer.getvalue()
    assert len(count) == 2
    assert figure.get_layout_engine() is engine
    assert figure.dpi == dpi
    # one without a layout engine is saved as it stands
    plain = Figure(figsize=(1.0, 1.0))
    assert figure_content(plain, "png", 50).startswith(b"\x89PNG")
    assert plain.get_layout_engine() is None


def test_certificate_rows_name_quantity_and_unit(short_run):
    rows = dict(certificate_rows(short_run.certificate))
    assert rows["Rank of the constraint Jacobian"] == "34 of 34 rows"
    assert rows["Constraint violation, lengths"].endswith(" m")
    assert rows["Constraint violation, angles"].endswith(" rad")
    assert rows["Constraint violation, rates of angles"].endswith(" rad/s")
    assert " m, at the end " in rows["Estimated position error"]
    assert not any("residual" in name for name in rows)
    assert rows["Result"] == "successful at t = 0.05 s"
    assert len(summary_rows(short_run.certificate)) == 6


def test_positions_have_a_row_of_panels_for_each_body(short_run):
    names = ("slider_2", "panel_7")
    figure = positions(short_run, names, detail=0.02)
    axes = np.array(figure.axes).reshape(2, 2)
    for row, name in enumerate(names):
        r = np.asarray(short_run.body(name).r)
        start, whole = axes[row]
        assert np.asarray(whole.lines[2].get_ydata()) == pytest.approx(r[:, 2])
        assert np.asarray(start.lines[0].get_xdata())[-1] <= 0.02 + 1e-12
    with pytest.raises(stm.StateError, match="one is 'panel'"):
        positions(short_run, ["panel"])


def test_panel_angles_are_continuous_beyond_a_quarter_turn():
    """R_x(phi) R_y(theta) with theta up to 110 degrees, and a panel that also turns about its normal."""
    angles = np.radians(np.stack([np.linspace(0, 200, 41), np.linspace(0, 110, 41)], axis=1))
    zero = np.zeros((41, 1, 3))
    turn = lambda axes, values: Rotation.from_euler(axes, values).as_quat(scalar_first=True)[
        :, None
    ]
    motion_by = lambda p: Motion(
        "", np.arange(41.0), ("panel",), "panel", zero, p, zero, np.zeros((1, 3)), ()
    )
    ((words, _, found),) = joints_of(motion_by(turn("XY", angles)))[2]
    assert words == "panel angles [degrees]"
    assert found == pytest.approx(np.degrees(angles))
    turned = turn("XYZ", np.column_stack([angles, 0.3 * angles[:, 0]]))
    ((words, labels, found),) = joints_of(motion_by(turned))[2]
    assert (words, labels) == ("panel's normal [1]", ("x", "y", "z"))
    assert found[:, 0] == pytest.approx(np.sin(angles[:, 1]))
