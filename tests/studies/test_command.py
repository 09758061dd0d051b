"""`stmuav montecarlo` and `report` from a file of one's own."""

import json

import numpy as np
import pytest
import xarray as xr

from stmuav_jax.cli.main import main
from stmuav_jax.studies import StudyOutcome

STUDY = """
scene = "hexacopter"
t1 = 0.3
samples = 40
seed = 2
design = "sobol"
[factors]
"start.p" = {distribution = "normal", mean = 0.0, standard_deviation = 2.0}
"bare.mass" = {distribution = "normal", mean = 1.0, standard_deviation = 0.1, relative = true}
"start.q" = {file = "rates.csv", column = "q"}
[quantities]
tilt = {signal = "tilt", take = "largest"}
over = {signal = "tilt", take = "when_above", level = 0.4}
height = {signal = "z", take = "path"}
[failure]
quantity = "over"
below = 0.25
"""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "turning.toml"
    path.write_text(STUDY)
    (tmp_path / "rates.csv").write_text("t,q\n0,0.1\n1,-0.4\n2,0.9\n")
    return path


@pytest.mark.slow
def test_fly_report_extend(study, tmp_path, capsys):
    # no path is taken for markup or a picture
    out = tmp_path / "out[/b][v2] :x:"
    given = ["montecarlo", str(study), "--out", str(out), "--no-cache", "--devices", "1"]
    assert main(given) == 0
    said = capsys.readouterr().out
    assert str(out) in "".join(said.split("\n")).replace("  ", " ")
    store = xr.open_zarr(out / "study.zarr", consolidated=False).load()
    assert store.sizes["sample"] == 40
    assert np.all(store.status == 1)
    assert set(np.unique(store.start_q)) == {0.1, -0.4, 0.9}
    assert store.height.attrs["units"] == "m"
    assert (out / "figures" / "quantities.png").is_file()
    summary = json.loads((out / "summary.json").read_text())
    share = np.mean(store.over.values < 0.25)
    assert 0 < share < 1
    found = summary["failure"]
    assert found["probability"]["value"] == pytest.approx(share, abs=1e-15)
    assert found["label"] == "time at which base, tilt exceeds 0.4 rad below 0.25 s"
    assert "Probability of failure (time at which base, tilt exceeds 0.4 rad below 0.25 s)" in (
        " ".join(said.split())
    )
    assert "base, tilt, largest [rad]" in " ".join(said.split())
    assert list(summary["inputs"]) == ["start_p", "bare_mass", "start_q"]
    # another number of cores goes on with it, and ends with the same numbers
    # a finished store is not overwritten, but can be extended; what is there stays
    assert main(given) == 2
    assert "resume" in capsys.readouterr().err
    two = [*given[:-1], "3"]
    assert main([*two, "--resume", "--samples", "48", "--figures", "none"]) == 0
    longer = xr.open_zarr(out / "study.zarr", consolidated=False).load()
    assert longer.sizes["sample"] == 48
    assert np.array_equal(longer.tilt[:40], store.tilt)
    assert main([*given, "--resume", "--samples", "48", "--seed", "3"]) == 2
    assert "seed" in capsys.readouterr().err
    assert main([*given, "--resume", "--samples", "48", "--lanes", "8"]) == 2
    assert "lanes is 16 there and 8 here" in " ".join(capsys.readouterr().err.split())
    assert main(["view", str(out), "--report", str(tmp_path / "again" / "report.html")]) == 0
    assert "turning" in (tmp_path / "again" / "report.html").read_text()
    # a store that lacks numbers is not reported on
    (out / "study.zarr" / "tilt" / "c" / "0").unlink()
    assert main(["view", str(out), "--report", str(tmp_path / "third" / "report.html")]) == 2
    assert "tilt/c/0" in "".join(capsys.readouterr().err.split())
    assert not (tmp_path / "third").exists()


@pytest.mark.parametrize("name", ["--samples", "--chunk", "--devices", "--lanes", "--workers"])
def test_counts_are_not_defaults(study, tmp_path, name, capsys):
    out = tmp_path / "out"
    assert main(["montecarlo", str(study), "--out", str(out), name, "0"]) == 2
    assert name.strip("-") in capsys.readouterr().err
    assert not out.exists()


def test_an_interrupted_study_has_its_exit_code(study, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    stopped = StudyOutcome(out / "study.zarr", 10, 40, 10, 1.0, interrupted=True)
    monkeypatch.setattr("stmuav_jax.cli.montecarlo._run_with_progress", lambda *_: stopped)
    given = ["montecarlo", str(study), "--out", str(out), "--figures", "none", "--no-cache"]
    assert main(given) == 130
    said = " ".join(capsys.readouterr().out.split())
    assert "keeps 10 of 40 samples" in said
    assert "resume the study" in said


def test_errors_name_the_file(study, tmp_path, capsys):
    study.write_text(STUDY.replace('design = "sobol"', 'design = "sobl"'))
    assert main(["montecarlo", str(study), "--out", str(tmp_path / "x")]) == 2
    # a long path is broken anywhere, also before the colon
    said = "".join(capsys.readouterr().err.split())
    assert "turning.toml:'design'mustbe" in said
    assert "Didyoumean'sobol'" in said


def test_a_name_is_no_path(study, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    study.write_text('name = "../../EVIL"\n' + STUDY)
    assert main(["montecarlo", str(study)]) == 2
    assert "'name' must" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["montecarlo", "nowhere.toml"], "There is no file"),
        (["montecarlo", "hover", "--scheduler", "tcp://x:1", "--workers", "2"], "exclude each"),
        (["montecarlo", "estimate_1", "--params", "x.toml"], "has no scene"),
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
    study.write_text(STUDY)
    for entry in ("fast", "nan", "-inf"):
        (tmp_path / "rates.csv").write_text(f"t,q\n0,{entry}\n")
        assert main(["montecarlo", str(study), "--out", str(tmp_path / "x")]) == 2
        words = f"'{entry}' in column 'q' is not a finite number"
        assert words in " ".join(capsys.readouterr().err.split())
