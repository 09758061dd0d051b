"""Report pages of runs and filters: what they show is what the files hold, and nothing else is read."""

import json
import re

import numpy as np
import pytest
import xarray as xr
from html_pages import read

import stmuav_jax as stm
from stmuav_jax.cli import main
from stmuav_jax.dynamics.loads import run_loads
from stmuav_jax.figures import filter_report, run_report
from stmuav_jax.figures.filter_record import (
    FORMAT,
    FORMAT_VERSION,
    record_content,
    record_of_dataset,
    record_of_file,
)
from stmuav_jax.figures.numbers import numbers_of, saved_loads, saved_numbers
from stmuav_jax.figures.report import certificate_rows
from stmuav_jax.files.netcdf import _SEAL_LENGTH, labelled, save_labelled

# --- runs


@pytest.fixture(scope="module")
def saved(short_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    stm.save(short_run, folder / "run.nc")
    return folder


def test_figures_of_a_saved_run_are_those_of_the_run(short_run, saved):
    found, wanted = saved_numbers(stm.load(saved / "run.nc")), numbers_of(short_run)
    assert found.keys() == wanted.keys() == {"pose", "joints", "balances"}
    flat = lambda each: [x for part in each for x in (part if isinstance(part, list) else [part])]
    for name in wanted:
        for one, other in zip(flat(found[name]), flat(wanted[name]), strict=True):
            for a, b in zip(
                *((x if isinstance(x, tuple) else (x,)) for x in (one, other)), strict=True
            ):
                if isinstance(a, np.ndarray):
                    np.testing.assert_array_equal(a, b)
                else:
                    assert a == b
    # the loads by another route: the package's own turning of the reactions
    loads, exact = saved_loads(stm.load(saved / "run.nc")), run_loads(short_run)
    assert loads is not None
    assert loads.joints == exact.joints
    size = np.max(np.abs(exact.force))
    np.testing.assert_allclose(loads.components, exact.components, atol=1e-13 * size)


def test_page_of_a_run(short_run, saved, capsys):
    assert main(["report", str(saved)]) == 0
    assert "Run: " in capsys.readouterr().out
    assert {path.name for path in saved.iterdir()} == {"run.nc", "report.html"}
    page, text = read(saved / "report.html")
    # the mechanism; pose, joints, balances, loads, rotors
    assert len(page.sources) == 6
    assert "The mechanism at t = 0.05 s" in text
    c = short_run.certificate
    assert f"reached its end at t = {c.t_end:g} s" in text
    assert f"estimated as at most {c.position_error:.2g} m" in text
    for row in certificate_rows(short_run):
        assert " ".join(" ".join(row).split()) in text
    base = short_run.body("hexacopter_1")
    off = np.max(np.linalg.norm(base.r - base.r[0], axis=1))
    assert (
        f"Largest distance of hexacopter 1 from its start {off:.4g} m".replace("-", "\u2212")
        in text
    )
    force = np.max(np.linalg.norm(run_loads(short_run).force, axis=-1))
    assert re.search(
        rf"Largest reaction force at a saved time, at \w+, t = [\d.]+ s {force:.4g} N", text
    )
    for words in ("uav_tracker_2", "Method: solver Dopri8", "jax", "None: all have the values"):
        assert words in text


def test_changed_parameters_and_an_early_end_are_said(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(run_report, "run_pictures", lambda *_: iter(()))
    data = stm.load(saved / "run.nc")
    given = json.loads(data.attrs["parameters"])
    given["mass.panel_7"] |= {"value": 0.95, "source": "given in <mine>.toml"}
    certificate = json.loads(data.attrs["certificate"])
    certificate |= {"result": "step size fell below its limit", "position_error": None}
    data.attrs |= {"parameters": json.dumps(given), "certificate": json.dumps(certificate)}
    stm.figures.write_run_report(data, tmp_path / "page.html")
    _, text = read(tmp_path / "page.html")
    assert "There is nothing to draw." in text
    changed = text.partition("Parameters that were changed")[2].partition("The other")[0]
    assert "mass.panel_7 0.95 kg given in <mine>.toml" in changed
    assert "rotor.k_f" not in changed
    assert "did not reach its end: it stopped at t = 0.05 s, step size fell" in text
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
def test_page_of_a_filter_on_a_model(tmp_path, biased, monkeypatch):
    if biased:
        monkeypatch.setattr(filter_report, "_pictures", lambda _: iter(()))
    arrays = record(biased)
    names = [("hinge.angle", "rad"), ("rail.displacement", "m"), ("rail.displacement_rate", "m/s")]
    path = tmp_path / "estimate.npz"
    path.write_bytes(
        record_content("Cart & pole", names, arrays, {"scene": "cart.toml", "seeds": 25})
    )
    assert main(["report", str(path)]) == 0
    page, text = read(tmp_path / "report.html")
    assert len(page.sources) == (0 if biased else 3)
    assert "Cart & pole" in text
    assert "scene cart.toml" in text
    nees = np.mean(arrays["nees"][-1])
    assert f"NEES at the end: {nees:.4g}, consistent within" in text
    assert ("Inconsistent" in text) == biased
    error = np.sqrt(np.mean(arrays["error"][-1, 0] ** 2))
    assert f"hinge.angle {error:.4g} 0.1 rad" in text
    found = record_of_file(path)
    figure = filter_report.consistency_figure(found)
    (line,) = figure.axes[1].lines
    assert np.asarray(line.get_ydata()) == pytest.approx(
        np.mean(arrays["nis"], axis=1) / arrays["degrees"]
    )


def case(hover=False):
    """Dataset with the layout of estimate.nc or hover.nc, of two tunings."""
    rng = np.random.default_rng(4)
    truth = rng.standard_normal((40, 5, 6))
    error = np.stack([np.full((40, 5, 6), 0.1), 0.01 * rng.standard_normal((40, 5, 6))])
    path = ("time", "component", "seed")
    each, scalar = ("tuning", *path), ("tuning", "time", "seed")
    chi = lambda n: np.sum(rng.standard_normal((2, 40, n, 6)) ** 2, axis=2)
    table = {
        "truth": (path, truth, "rad/s, m", "truth"),
        "estimate": (each, truth + error, "rad/s, m", "means"),
        "standard_deviation": (each, np.full(error.shape, 0.01), "rad/s, m", "own"),
        "nees": (scalar, chi(14 if hover else 5), "1", "NEES"),
        "nis": (scalar, chi(6 if hover else 3), "1", "NIS"),
        "ok": (scalar, np.ones((2, 40, 6), bool), "1", "ok"),
    }
    if hover:
        table["position"] = (("tuning", "time", "axis", "seed"), np.zeros((2, 40, 3, 6)), "m", "")
        table["truth"] = (each, np.stack([truth, truth]), "rad/s, m", "truth")
    names = ["Omega_x", "Omega_y", "Omega_z", "offset_x", "offset_y"]
    verdict = {"status": "inconsistent", "words": "6 of 6 runs are inconsistent."}
    summaries = {
        "report": {"verdict": verdict, "rmse": [0.001, 0.002], "nees": 80.0, "to_2cm": np.nan}
    }
    return labelled(
        table, {"time": 0.02 * np.arange(1, 41), "tuning": ["report", "consistent"], "component": names},
        format=FORMAT, format_version=FORMAT_VERSION, title="Report Part III, case 4", summaries=summaries,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["estimate.nc", "hover.nc"])
def test_page_of_the_filters_of_a_case(tmp_path, name, monkeypatch):
    if "hover" in name:
        monkeypatch.setattr(filter_report, "_pictures", lambda _: iter(()))
    save_labelled(case("hover" in name), tmp_path / name)
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "page")]) == 0
    page, text = read(tmp_path / "page" / "report.html")
    assert len(page.sources) == (0 if "hover" in name else 3)
    assert "Report tuning: inconsistent. 6 of 6 runs are inconsistent." in text
    assert "Consistent tuning: consistent. NEES at the end" in text
    assert "RMSE of the centre of mass, x and y, when settled 1, 2 mm" in text
    assert "below 2 cm never s" in text
    assert "Omega_x, report 0.1 0.01 rad/s" in text
    found = record_of_dataset(case("hover" in name).dataset())
    assert (found.size, set(found.degrees.ravel())) == ((14, {6}) if "hover" in name else (5, {3}))


# --- what is no result


def test_files_that_have_no_report_are_told_apart(saved, tmp_path, capsys):
    def said(path):
        assert main(["report", str(path)]) == 2
        return " ".join(capsys.readouterr().err.split())

    assert "There is no file or folder" in said(tmp_path / "nope")
    assert "holds nothing. A report is made of run.nc (of stmuav simulate)" in said(tmp_path)
    (tmp_path / "notes.txt").write_text("hello there")
    assert "begins with b'hello th'" in said(tmp_path / "notes.txt")
    assert "holds notes.txt. A report is made of" in said(tmp_path)
    (tmp_path / "empty").write_bytes(b"")
    assert "it is empty" in said(tmp_path / "empty")
    np.savez(tmp_path / "linear.npz", A=np.eye(2))
    assert "it holds A, and lacks states, t" in said(tmp_path / "linear.npz")
    xr.Dataset({"rain": ("day", [1.0])}).to_netcdf(tmp_path / "w.nc", engine="h5netcdf")
    assert "of another program: it has the variables rain" in said(tmp_path / "w.nc")
    whole = (saved / "run.nc").read_bytes()
    (tmp_path / "run.nc").write_bytes(whole[:-_SEAL_LENGTH])
    assert "was cut, or changed since it was saved" in said(tmp_path / "run.nc")
    (tmp_path / "run.nc").write_bytes(whole[:-5000])
    assert "it is damaged" in said(tmp_path / "run.nc")
    (tmp_path / "run.nc").write_bytes(whole[:5000] + b"x" + whole[5001:])
    assert "damaged" in said(tmp_path / "run.nc")
    (tmp_path / "flight.nc").write_bytes(b"")
    assert "holds several results: run.nc, flight.nc. Name one" in said(tmp_path)
    assert not (tmp_path / "report.html").exists()
