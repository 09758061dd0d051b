"""Reaction loads on paper: every joint and component with its unit, nothing hidden."""

import csv
import io

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from stmuav_jax.dynamics import envelope, run_loads
from stmuav_jax.dynamics.loads import COMPONENTS, JointLoads
from stmuav_jax.figures.loads import HEADER, loads_figure, loads_table, save_loads
from stmuav_jax.figures.plot import save_figures


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
    console = Console(width=150, record=True, file=io.StringIO())
    console.print(table)
    # units are not markup
    assert console.export_text().count("at [s]") == 2
    assert table.row_count == 8
    assert str(list(table.columns[4].cells)[-1]) == "0"  # a ball carries no moment


def test_figure_shows_histories_with_units(short_run, loads, tmp_path):
    figure = loads_figure(short_run.scene, loads)
    axes = np.array(figure.axes).reshape(8, 2)
    assert [ax.get_title() for ax in axes[0]] == ["force [N]", "moment [N m]"]
    assert axes[2, 0].get_ylabel() == "R14"
    line = axes[2, 0].lines[3]
    assert line.get_label() == "magnitude"
    np.testing.assert_allclose(
        line.get_ydata(), np.linalg.norm(np.asarray(loads.force)[:, 2], axis=-1), rtol=1e-12
    )
    (path,) = save_figures({"loads": loads_figure}, tmp_path, "pdf", short_run.scene, loads)
    assert path.name == "loads.pdf"
    assert path.read_bytes().startswith(b"%PDF")


def test_short_peaks_do_not_hide_the_usual_loads(short_run):
    t, force = np.linspace(0, 1, 200), np.zeros((200, 8, 3))
    force[:, 0, 0] = 3 * np.sin(6 * t)
    names = tuple(joint.name for joint in short_run.scene.system.joints)
    made = lambda: JointLoads(jnp.asarray(t), jnp.asarray(force), jnp.asarray(0 * force), names)
    axes = np.array(loads_figure(short_run.scene, made()).axes).reshape(8, 2)
    assert axes[0, 0].get_yscale() == "linear"
    assert [text.get_text() for text in axes[0, 1].texts] == ["none"]
    force[100, 0, 0] = 500.0
    figure = loads_figure(short_run.scene, made())
    ax = figure.axes[0]
    assert ax.get_yscale() == "symlog"
    assert ax.get_yticks() == pytest.approx([-1000, -2, 0, 2, 1000])
    # the usual loads take a fifth of the axis instead of a hundredth
    low, high = (ax.transData.transform((0, y))[1] for y in (-2, 2))
    assert (high - low) / ax.bbox.height > 0.2
    figure.savefig(io.BytesIO(), format="png")
