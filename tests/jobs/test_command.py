"""`stmuav montecarlo` and `report` from a file of one's own."""

import json

import numpy as np
import pytest
import xarray as xr

from stmuav_jax.cli import main

STUDY = """
scene = "hexacopter"
t1 = 0.3
samples = 40
seed = 2
design = "sobol"
[factors]
"start.p" = {distribution = "normal", mean = 0.0, deviation = 2.0}
"bare.mass" = {distribution = "normal", mean = 1.0, deviation = 0.1, relative = true}
"start.q" = {file = "rates.csv", column = "q"}
[quantities]
tilt = {signal = "tilt", take = "largest"}
over = {signal = "tilt", take = "when_above", level = 0.4}
height = {signal = "z", take = "path"}
"""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "turning.toml"
    path.write_text(STUDY)
    (tmp_path / "rates.csv").write_text("t,q\n0,0.1\n1,-0.4\n2,0.9\n")
    return path


def test_fly_report_extend(study, tmp_path, capsys):
    out = tmp_path / "out"
    given = ["montecarlo", str(study), "--out", str(out), "--no-cache", "--devices", "1"]
    assert main(given) == 0
    store = xr.open_zarr(out / "study.zarr", consolidated=False).load()
    assert store.sizes["sample"] == 40
    assert np.all(store.status == 1)
    assert set(np.unique(store.start_q)) == {0.1, -0.4, 0.9}
    assert store.height.attrs["units"] == "m"
    page = (out / "report.html").read_text()
    assert "turning" in page
    assert json.loads((out / "summary.json").read_text())
    # a finished store is not overwritten, but can be extended; what is there stays
    assert main(given) == 2
    assert "resume" in capsys.readouterr().err
    assert main([*given, "--resume", "--samples", "48", "--figures", "none"]) == 0
    longer = xr.open_zarr(out / "study.zarr", consolidated=False).load()
    assert longer.sizes["sample"] == 48
    assert np.array_equal(longer.tilt[:40], store.tilt)
    assert main([*given, "--resume", "--samples", "48", "--seed", "3"]) == 2
    assert "seed" in capsys.readouterr().err
    assert main(["report", str(out / "study.zarr"), "--out", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "report.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["montecarlo", "colapse"], "Did you mean 'collapse'"),
        (["montecarlo", "nowhere.toml"], "There is no file"),
        (["montecarlo", "hover", "--scheduler", "tcp://x:1", "--workers", "2"], "not both"),
        (["montecarlo", "estimate_1", "--params", "x.toml"], "has no scene"),
        (["report", "nowhere.zarr"], "nowhere.zarr"),
    ],
)
def test_bad_input(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_columns_of_files(study, tmp_path, capsys):
    study.write_text(STUDY.replace('column = "q"', 'column = "w"'))
    assert main(["montecarlo", str(study), "--out", str(tmp_path / "x")]) == 2
    assert "no column 'w'" in " ".join(capsys.readouterr().err.split())
    (tmp_path / "rates.csv").write_text("t,q\n0,fast\n")
    study.write_text(STUDY)
    assert main(["montecarlo", str(study), "--out", str(tmp_path / "x")]) == 2
    assert "'fast' in column 'q' is not a number" in " ".join(capsys.readouterr().err.split())
