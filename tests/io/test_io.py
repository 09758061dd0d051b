"""Results on disk: labelled, whole or absent, and never another program's file."""

import dataclasses
import errno
import io
import json
import os

import numpy as np
import pytest
import xarray as xr

from stmuav_jax import PART_II, ModelError
from stmuav_jax.cli.view import _write_report
from stmuav_jax.dynamics.diagnostics import empty_estimate
from stmuav_jax.figures.day import load_attitude
from stmuav_jax.figures.filter_record import load_record
from stmuav_jax.io.model_file import load_model
from stmuav_jax.io.netcdf import (
    LOOP_FORMAT,
    LOOP_VERSION,
    FileError,
    Labelled,
    _make_seal,
    load,
    load_checkpoint,
    load_parameters,
    save_sealed,
    write_atomically,
)
from stmuav_jax.io.run_file import save, save_certificate, to_dataset
from stmuav_jax.studies.study_file import column, load_study


def test_dataset_is_labelled(short_run):
    data = to_dataset(short_run)
    for name, variable in data.data_vars.items():
        assert variable.attrs["units"], name
        assert variable.attrs["description"], name
    z = data["position"].sel(body="panel_7", axis="z").values
    assert z == pytest.approx(np.asarray(short_run.body("panel_7").r[:, 2]))
    assert data["position_error"].dims == ("time", "body")
    assert data["position_error"].attrs["units"] == "m"
    assert np.all(data["position_error"] < 1e-6)
    assert data["joint_body_j"].sel(joint="S57").item() == "panel_7"


def test_saved_and_loaded_runs_are_equal(short_run, tmp_path):
    path = save(short_run, tmp_path / "deep" / "run.nc")
    found = load(path)
    xr.testing.assert_identical(found.drop_attrs(), to_dataset(short_run).drop_attrs())
    assert found.attrs["scene"] == "uav_tracker_2"
    assert json.loads(found.attrs["parameters"])["mass.panel_7"]["value"] == 0.89085
    assert json.loads(found.attrs["settings"])["solver"] == "Dopri8"
    assert "jax" in json.loads(found.attrs["versions"])
    assert json.loads(found.attrs["certificate"])["result"] == "successful"
    assert [p.name for p in path.parent.iterdir()] == ["run.nc"]


@pytest.mark.parametrize("checksums", [False, True])
def test_xarray_reads_what_labelled_arrays_hold(checksums):
    variables = {
        "x": (("t", "name"), np.arange(6.0).reshape(3, 2), {"units": "m"}),
        "ok": (("t",), np.array([True, False, True]), {}),
        "none": (("joint", "t"), np.zeros((0, 3)), {}),
        "alone": ((), np.float64(3.0), {}),
        "small": (("t",), np.arange(3, dtype=np.int8), {"description": "m²"}),
    }
    coordinates = {
        "t": (("t",), np.arange(3.0), {"units": "s"}),
        "name": (("name",), ["p", "qü"], {}),
        "joint": (("joint",), [], {}),
        "who": (("name",), ["1", "2"], {}),
    }
    arrays = Labelled(variables, coordinates, {"format": "ä", "version": 2})
    with xr.open_dataset(
        io.BytesIO(arrays.netcdf(checksums=checksums)), engine="h5netcdf"
    ) as found:
        xr.testing.assert_identical(found.load(), arrays.dataset())


def test_signals_of_an_older_flight_have_the_present_names(tmp_path):
    signals = {"wanted_force": (("time",), np.arange(3.0), {"units": "N"})}
    about = {"format": LOOP_FORMAT, "format_version": LOOP_VERSION}
    path = save_sealed(Labelled(signals, {}, about), tmp_path / "flight.nc")
    assert load(path).commanded_force.values.tolist() == [0.0, 1.0, 2.0]


def test_truncated_files_are_refused(short_run, tmp_path):
    whole = save(short_run, tmp_path / "run.nc").read_bytes()
    for part in range(1, 16):
        broken = tmp_path / "broken.nc"
        broken.write_bytes(whole[: len(whole) * part // 16])
        with pytest.raises(FileError, match=r"broken\.nc cannot be read"):
            load(broken)


def test_foreign_and_missing_files_are_refused(tmp_path):
    with pytest.raises(FileError, match="There is no file"):
        load(tmp_path / "none.nc")
    text = tmp_path / "text.nc"
    text.write_text("not a dataset")
    with pytest.raises(FileError, match="cannot be read"):
        load(text)
    foreign = tmp_path / "foreign.nc"
    xr.Dataset({"x": ("t", [1.0])}).to_netcdf(foreign, engine="h5netcdf")
    with pytest.raises(FileError, match="not a run saved by stmuav_jax"):
        load(foreign)
    other = xr.Dataset(attrs={"format": "stmuav_jax run", "format_version": 99})
    content = bytes(other.to_netcdf(engine="h5netcdf"))
    foreign.write_bytes(content + _make_seal(content))
    with pytest.raises(FileError, match="version 99"):
        load(foreign)


def test_other_readers_open_a_run_and_find_changed_numbers(short_run, tmp_path):
    path = save(short_run, tmp_path / "run.nc")
    with xr.open_dataset(path, engine="h5netcdf") as found:
        xr.testing.assert_identical(found.load().drop_attrs(), to_dataset(short_run).drop_attrs())
    numbers = np.asarray(short_run.states.r).tobytes()[-64:]
    whole = path.read_bytes()
    assert whole.count(numbers) == 1
    path.write_bytes(whole.replace(numbers, numbers[:-2] + b"ab"))
    with xr.open_dataset(path, engine="h5netcdf") as found, pytest.raises(OSError):
        found["position"].load()


def test_a_run_without_analysis_has_no_reactions_in_its_file(short_run, tmp_path):
    none = empty_estimate(short_run.trajectory, "none was requested")
    bare = dataclasses.replace(short_run, model=None, errors=none)
    found = load(save(bare, tmp_path / "run.nc"))
    assert "position" in found
    assert "reaction_force" not in found
    assert np.all(np.isnan(found["position_error"]))


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = write_atomically(tmp_path / "a.txt", b"old")

    def broken(source, target):
        raise OSError("no space left")

    monkeypatch.setattr("stmuav_jax.io.netcdf.os.replace", broken)
    with pytest.raises(OSError, match="no space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    """The operating system does not, where a write fails."""

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("stmuav_jax.io.netcdf.os.fsync", full)
    with pytest.raises(OSError, match=r"No space left on device.*run\.nc"):
        write_atomically(tmp_path / "run.nc", b"new")
    assert not list(tmp_path.iterdir())


def test_certificate_as_json(short_run, tmp_path):
    content = json.loads(save_certificate(short_run, tmp_path / "c.json").read_text())
    assert content["certificate"]["rank"] == 34
    assert content["settings"]["rtol"] == 1e-8


def test_parameters_from_toml(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        '[mass]\npanel_7 = 0.95\n[rotor]\nk_f = {value = 6.6e-6, unit = "N s^2/rad^2"}\n'
        "lift_factor = 1.3\n".replace("lift_factor", "k_tau = 1.3e-7\n[actuator]\nforce")
    )
    table = load_parameters(path, PART_II)
    assert table.value("mass.panel_7") == 0.95
    assert table.value("rotor.k_f") == 6.6e-6
    assert table.value("actuator.force") == 1.3
    assert table["mass.panel_7"].source == "given in mine.toml"


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("[mass\n", FileError, "not a readable TOML"),
        ("[mass]\npanel_9 = 1.0\n", ModelError, r"mine\.toml.*mass\.panel_9"),
        ('[mass]\npanel_7 = {value = 890, unit = "g"}\n', ModelError, "given in kg, not in .g."),
        ("[mass]\npanel_7 = {value = 1.0, units = 2}\n", ModelError, "no entry .units."),
        ("[mass]\npanel_7 = -1.0\n", ModelError, r"mine\.toml.*must be positive"),
        ("[mass]\npanel_7 = " + "9" * 400 + "\n", ModelError, "must be numbers"),
        ("x = " + "[" * 3000 + "]" * 3000, FileError, "nested too deeply"),
    ],
)
def test_bad_parameter_files(tmp_path, text, error, words):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(error, match=words):
        load_parameters(path, PART_II)
    with pytest.raises(FileError, match="There is no file"):
        load_parameters(tmp_path / "none.toml", PART_II)
    with pytest.raises(FileError, match="is no file but a folder, a pipe or a device"):
        load_parameters("", PART_II)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_named_pipes_are_refused_at_once(tmp_path):
    """Reading one waits until another process writes, which may be never."""
    pipe = tmp_path / "run.nc"
    os.mkfifo(pipe)
    report = lambda path: _write_report(path, tmp_path / "report.html")
    for read in (load, load_attitude, load_study, load_model, load_record, report):
        with pytest.raises(FileError, match=r"run\.nc is no file but a folder, a pipe or a device"):
            read(pipe)
    for read in (load_checkpoint, column):
        with pytest.raises(FileError, match=r"run\.nc is no file but"):
            read(pipe, "x")
