"""Reports of runs and filters: they show what the files hold, and nothing else is read."""

import csv
import json

import numpy as np
import pytest
import xarray as xr
from html_pages import read
from matplotlib.figure import Figure

import stmuav_jax as stm
from stmuav_jax.cli.main import main
from stmuav_jax.dynamics import envelope
from stmuav_jax.dynamics.loads import COMPONENTS, run_loads
from stmuav_jax.figures import report
from stmuav_jax.figures.filter_record import record_content
from stmuav_jax.figures.run import FIGURES, HEADER, save_loads, saved_loads
from stmuav_jax.io.netcdf import _SEAL_LENGTH

# --- runs


@pytest.fixture(scope="module")
def saved(short_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    stm.save(short_run, folder / "run.nc")
    return folder


def lines_of(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(line.get_xydata()) for ax in figure.axes for line in ax.lines]


def test_figures_of_a_saved_run_are_those_of_the_run(short_run, saved):
    data = stm.load(saved / "run.nc")
    for draw in FIGURES.values():
        for one, other in zip(lines_of(draw(data)), lines_of(draw(short_run)), strict=True):
            np.testing.assert_array_equal(one, other)
    # the loads by another route: the package's own turning of the reactions
    loads, exact = saved_loads(data), run_loads(short_run)
    assert loads is not None
    assert loads.joints == exact.joints
    size = np.max(np.abs(exact.force))
    np.testing.assert_allclose(loads.force, exact.force, atol=1e-13 * size)
    np.testing.assert_allclose(loads.moment, exact.moment, atol=1e-13 * size)


def test_csv_holds_every_component_of_every_joint(short_run, tmp_path):
    loads = run_loads(short_run)
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


@pytest.mark.slow
def test_report_of_a_run(short_run, saved):
    path = saved / "page" / "report.html"
    assert main(["view", str(saved), "--report", str(path)]) == 0
    page, text = read(path)
    # the mechanism; pose, joints, balances, loads
    assert len(page.sources) == 5
    assert "The mechanism at t = 0.05 s" in text
    c = short_run.certificate
    assert f"ended at t = {c.t_end:g} s: successful" in text
    assert f"estimated as at most {c.position_error:.2g} m" in text
    assert f"relative energy error {c.relative_energy_error:.6g}" in text
    for words in ("uav_tracker_2", "solver Dopri8", "jax"):
        assert words in text
    assert "Parameters that were changed" not in text


def test_changed_parameters_and_an_early_end_are_said(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "FIGURES", {})
    monkeypatch.setattr(report, "saved_loads", lambda _: None)
    data = stm.load(saved / "run.nc")
    given = json.loads(data.attrs["parameters"])
    given["mass.panel_7"] |= {"value": 0.95, "source": "given in <mine>.toml"}
    certificate = json.loads(data.attrs["certificate"])
    certificate |= {"result": "step size fell below its limit", "position_error": None}
    data.attrs |= {"parameters": json.dumps(given), "certificate": json.dumps(certificate)}
    stm.figures.write_report(data, tmp_path / "page.html")
    _, text = read(tmp_path / "page.html")
    assert "There is nothing to draw." in text
    changed = text.partition("Parameters that were changed")[2].partition("Versions")[0]
    assert "mass.panel_7 0.95 kg given in <mine>.toml" in changed
    assert "rotor.k_f" not in changed
    assert "ended at t = 0.05 s: step size fell" in text
    assert "estimated as at most" not in text


# --- filters


def record(biased=False):
    """Errors and innovations that are consistent by construction, of 3 states and 2 readings."""
    rng = np.random.default_rng(3)
    deviation = np.tile(np.array([0.1, 2.0, 5.0])[:, None], (60, 1, 25))
    scaled, innovation = rng.standard_normal((60, 3, 25)), rng.standard_normal((60, 2, 25))
    innovation[1::2, 1] = np.nan
    scaled *= 3.0 if biased else 1.0
    return {
        "t": 0.01 * np.arange(1, 61), "error": scaled * deviation, "deviation": deviation,
        "nees": np.sum(scaled**2, axis=1), "nis": np.nansum(innovation**2, axis=1),
        "degrees": np.isfinite(innovation[..., 0]).sum(axis=1), "ok": np.ones(25, bool),
        "innovation": innovation,
    }  # fmt: skip


@pytest.mark.parametrize("biased", [False, True])
def test_report_of_a_filter_on_a_model(tmp_path, biased, monkeypatch):
    if biased:
        monkeypatch.setattr(report, "_STATES", 10**9)
    arrays = record(biased)
    names = [("hinge.angle", "rad"), ("rail.displacement", "m"), ("rail.displacement_rate", "m/s")]
    path, page_path = tmp_path / "estimate.npz", tmp_path / "report.html"
    path.write_bytes(
        record_content("Cart & pole", names, arrays, {"scene": "cart.toml", "seeds": 25})
    )
    assert main(["view", str(path), "--report", str(page_path)]) == 0
    page, text = read(page_path)
    assert len(page.sources) == 1
    assert "Cart & pole" in text
    assert "scene cart.toml" in text
    nees = np.mean(arrays["nees"][-1])
    assert f"NEES at the end: {nees:.4g}, consistent within" in text
    assert ("Inconsistent" in text) == biased
    error = np.sqrt(np.mean(arrays["error"][-1, 0] ** 2))
    assert f"hinge.angle [rad], filter {error:.4g} 0.1" in text


# --- what is no result


def test_files_that_have_no_report_are_told_apart(saved, tmp_path, capsys):
    target = tmp_path / "page" / "report.html"

    def said(path):
        assert main(["view", str(path), "--report", str(target)]) == 2
        return " ".join(capsys.readouterr().err.split())

    assert "There is no file or folder" in said(tmp_path / "nope")
    assert "contains no result. A report needs run.nc (of stmuav simulate)" in said(tmp_path)
    (tmp_path / "notes.txt").write_text("hello there")
    assert "damaged or no result" in said(tmp_path / "notes.txt")
    np.savez(tmp_path / "linear.npz", A=np.eye(2))
    assert "it holds A, and lacks states, t" in said(tmp_path / "linear.npz")
    xr.Dataset({"rain": ("day", [1.0])}).to_netcdf(tmp_path / "w.nc", engine="h5netcdf")
    assert "from another program" in said(tmp_path / "w.nc")
    whole = (saved / "run.nc").read_bytes()
    (tmp_path / "run.nc").write_bytes(whole[:-_SEAL_LENGTH])
    assert "is damaged, truncated" in said(tmp_path / "run.nc")
    (tmp_path / "run.nc").write_bytes(whole[:5000] + b"x" + whole[5001:])
    assert "damaged" in said(tmp_path / "run.nc")
    (tmp_path / "flight.nc").write_bytes(b"")
    assert "holds several results: run.nc, flight.nc. Name one" in said(tmp_path)
    assert not target.exists()
