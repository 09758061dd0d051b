"""Figures show what the run holds, in units, with a legend."""

import sys

import numpy as np
import pytest

from stmuav_jax.figures import drawing
from stmuav_jax.figures.numbers import numbers_of
from stmuav_jax.figures.plot import FIGURES, content, euler_parameters, positions, save_figures
from stmuav_jax.figures.report import certificate_rows


def test_positions_has_a_panel_for_each_watched_body(short_run):
    axes = positions(short_run).axes
    assert [ax.get_title() for ax in axes] == ["hexacopter 1", "slider 2", "slider 3", "panel 7"]
    line = axes[3].lines[2]
    assert line.get_label() == "z"
    assert np.asarray(line.get_ydata()) == pytest.approx(
        np.asarray(short_run.body("panel_7").r[:, 2])
    )
    assert all("[m]" in ax.get_ylabel() for ax in axes)


def test_euler_parameters_shows_the_panel(short_run):
    (ax,) = euler_parameters(short_run).axes
    assert len(ax.lines) == 4
    assert np.asarray(ax.lines[0].get_ydata()) == pytest.approx(
        np.asarray(short_run.body("panel_7").p[:, 0])
    )
    assert len({line.get_linestyle() for line in ax.lines}) == 4


@pytest.mark.parametrize("suffix", ["png", "pdf"])
def test_saved_figures(short_run, tmp_path, suffix):
    paths = save_figures(FIGURES, tmp_path, suffix, short_run)
    assert [p.stem for p in paths] == list(FIGURES)
    magic = {"png": b"\x89PNG", "pdf": b"%PDF"}[suffix]
    assert all(p.read_bytes().startswith(magic) for p in paths)


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
    numbers = {"positions": numbers_of(short_run)["positions"]}
    with drawing.drawing(True) as drawer:
        if ends_early:
            assert drawer.process is not None
            drawer.process.kill()
        drawer.ask(numbers, "png")
        assert drawer.files() == {"positions": content(positions(short_run), "png")}
    assert drawer.process is None or drawer.process.returncode is not None


def test_no_process_is_started_without_need(monkeypatch):
    for wanted, processors in ((False, 2), (True, 1), (True, 2)):
        # the last time matplotlib is here already
        monkeypatch.setattr(drawing, "_processors", lambda count=processors: count)
        with drawing.drawing(wanted) as drawer:
            assert drawer.process is None
