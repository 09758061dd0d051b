"""Reaction loads on paper: every joint and component with its unit, nothing hidden."""

import csv
import io

import jax.numpy as jnp
import numpy as np
import pytest
from test_terminal import printed

from stmuav_jax.dynamics import envelope, run_loads
from stmuav_jax.dynamics.loads import COMPONENTS, JointLoads
from stmuav_jax.figures.plot import save_figures
from stmuav_jax.figures.run import HEADER, SavedLoads, draw_loads, loads_figure, save_loads
from stmuav_jax.figures.terminal import loads_table


@pytest.fixture(scope="module")
def loads(short_run):
    return run_loads(short_run)


def test_csv_holds_every_component_of_every_joint(short_run, loads, tmp_path):
    path = save_loads(short_run.scene, loads, tmp_path / "loads.csv")
    with open(path, newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == HEADER
    assert len(rows) == 8 * len(COMPONENTS)
    found = envelope(loads)
    k, c = loads.joints.index("R14"), COMPONENTS.index("M_y")
    row = next(r for r in rows if r[0] == "R14" and r[4] == "M_y")
    assert row[1:4] == ["revolute", "hexacopter_1", "post_4"]
    assert row[5] == "N m"
    assert float(row[6]) == pytest.approx(float(found.minimum[k, c]), rel=1e-5)
    assert float(row[8]) == pytest.approx(float(found.maximum[k, c]), rel=1e-5)
    assert float(row[9]) == pytest.approx(float(found.t_maximum[k, c]), rel=1e-5)


def test_terminal_table_has_a_row_for_each_joint(short_run, loads):
    table = loads_table(short_run.scene, loads)
    heads = ["peak force [N]", "at [s]", "peak moment [N m]", "at [s]"]
    assert [str(c.header) for c in table.columns][2:] == heads
    assert printed(table, 150).count("at [s]") == 2
    assert table.row_count == 8
    assert str(list(table.columns[4].cells)[-1]) == "0"  # a ball carries no moment


def test_figure_shows_magnitudes_with_units(short_run, loads, tmp_path):
    figure = loads_figure(short_run.scene, loads)
    force, moment = figure.axes
    assert [ax.get_ylabel() for ax in figure.axes] == ["force [N]", "moment [N m]"]
    lines = {str(line.get_label()): line for line in force.lines}
    assert list(lines) == list(loads.joints)
    np.testing.assert_allclose(
        np.asarray(lines["R14"].get_ydata()),
        np.linalg.norm(np.asarray(loads.force)[:, 2], axis=-1),
        rtol=1e-12,
    )
    # balls carry no moment and have no curve; a joint has one style in both panels
    assert [line.get_label() for line in moment.lines] == list(loads.joints)[:6]
    assert moment.lines[2].get_color() == lines["R14"].get_color()
    (path,) = save_figures({"loads": loads_figure}, tmp_path, "pdf", short_run.scene, loads)
    assert path.name == "loads.pdf"
    assert path.read_bytes().startswith(b"%PDF")


def test_figure_of_short_peaks_shows_four_decades(short_run):
    t, force = np.linspace(0, 1, 200), np.zeros((200, 8, 3))
    force[:, 0, 0] = 3 * np.sin(6 * t)
    force[100, 0, 0] = 500.0
    names = tuple(joint.name for joint in short_run.scene.system.joints)
    made = JointLoads(jnp.asarray(t), jnp.asarray(force), jnp.asarray(0 * force), names)
    figure = loads_figure(short_run.scene, made)
    assert figure.axes[0].get_ylim() == pytest.approx((0.1, 1000.0))
    assert [text.get_text() for text in figure.axes[1].texts] == ["zero at every joint"]
    figure.savefig(io.BytesIO(), format="png")


def test_figure_of_many_joints_has_those_with_the_largest_peaks():
    t, force = np.linspace(0, 1, 5), np.ones((5, 12, 3)) * np.arange(1, 13)[:, None]
    names = tuple(f"joint {k}" for k in range(12))
    ax = draw_loads("", SavedLoads(t, force, 0 * force, names)).axes[0]
    assert [line.get_label() for line in ax.lines] == list(names[4:])
    assert ax.get_title() == "8 of 12 joints: the largest peaks"
