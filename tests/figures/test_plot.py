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
from stmuav_jax.figures.plot import figure_content, grid
from stmuav_jax.figures.run import (
    Motion,
    balances,
    joints,
    joints_of,
    motion_of,
    pose,
)
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


def test_joints_shows_strokes_and_panel_angles(short_run):
    figure = joints(short_run)
    assert figure is not None
    strokes, angles = figure.axes
    for line, name in zip(strokes.lines, ("T12", "T13"), strict=True):
        moved = short_run.joint(name).displacement
        assert np.asarray(line.get_ydata()) == pytest.approx(1e3 * (moved - moved[0]), abs=1e-9)
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


def test_balances_show_energies_and_violations(short_run):
    figure = balances(short_run)
    assert figure is not None
    kinetic = np.asarray(figure.axes[0].lines[0].get_ydata())
    assert kinetic == pytest.approx(np.asarray(short_run.snapshot.kinetic))
    violation = np.asarray(figure.axes[1].lines[1].get_ydata())
    worst = np.asarray(short_run.trajectory.worst.position)
    # zeros are left out and are not a floor
    assert np.array_equal(np.isnan(violation), worst == 0)
    assert violation[worst > 0] == pytest.approx(worst[worst > 0], abs=0)


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
