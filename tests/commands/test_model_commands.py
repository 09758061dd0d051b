"""Every command on a model's file: trim, linearisation, tuning, identification, estimation, studies."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from html_pages import read

import stmuav_jax as stm
from stmuav_jax.cli import main

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "docs" / "models"


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setenv("COLUMNS", "120")


def said(capsys):
    shown = capsys.readouterr()
    return " ".join((shown.out + shown.err).split())


def test_trim_of_a_cart_that_accelerates(tmp_path, capsys):
    """The pole leans forward by tan(angle) = a / g, and the force moves both masses."""
    words = ["trim", str(MODELS / "cart_pole.toml"), "--coordinates", "hinge=0.1", "rail=0"]
    words += ["--rates", "hinge=0", "rail=0", "--free", "hinge.angle"]
    words += ["--accelerations", "rail.displacement_rate=2.0", "--out", str(tmp_path)]
    assert main(words) == 0
    found = json.loads((tmp_path / "trim.json").read_text())
    assert found["inputs"]["effort"] == pytest.approx(1.1 * 2.0, rel=1e-9)
    assert found["changes"] == {"hinge.angle": pytest.approx(np.arctan2(2.0, 9.8) - 0.1, rel=1e-9)}
    assert found["units"] == {"effort": "N or N m", "hinge.angle": "rad"}
    assert "input effort" in said(capsys)


@pytest.mark.slow
def test_linearisation_of_a_four_bar_is_that_of_the_library(tmp_path, capsys):
    path = str(MODELS / "four_bar.toml")
    words = ["linearize", path, "--independent", "A.angle", "--outputs", "A.angle"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    scene = stm.files.load_model(path)
    space = stm.TreeSpace(scene.system, scene.state0, independent=["A.angle"])
    exact = stm.linearize(space, space.from_state(scene.state0))
    with np.load(tmp_path / "linear.npz") as found:
        np.testing.assert_array_equal(found["A"], exact.A)
        np.testing.assert_array_equal(found["B"], exact.B)
        assert list(found["inputs"]) == ["effort [N or N m]"]
        assert list(found["outputs"]) == ["A.angle [rad]"]
    assert "A.angle_rate [rad/s]" in said(capsys)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("trim", "four_bar", "--inputs", "torque"), "name 'torque', which is no input"),
        (("trim", "pendulum"), "no inputs that a trim could choose: name states that it may"),
        (("trim", "cart_pole", "--coordinates", "hinge"), "names with numbers, such as A=0.3, not 'hinge'"),
        (("trim", "cart_pole", "--climb", "1"), "are for a floating base"),
        (("trim", "cart_pole", "--accelerations", "rail=1"), "name 'rail', which is no velocity"),
        (("linearize", "four_bar", "--outputs", "A.angel", "--independent", "A.angle"), "Did you mean 'A.angle'"),
        (("tune", "slew", "cart_pole"), "tune slew needs --to"),
        (("tune", "hold", "cart_pole", "--to", "rail=1"), "--to is for tune slew"),
        (("estimate", "cart_pole"), "has no sensors to estimate from"),
        (("estimate", "four_bar", "--sensors", "A"), "name 'A', which is no sensor"),
        (("fly", "quadrotor_slung_load"), "is a model, not a mission"),
        (("montecarlo", "four_bar"), "is a model, not a study"),
    ],
)  # fmt: skip
def test_what_a_model_cannot_is_one_sentence(words, message, capsys):
    named = [str(MODELS / f"{w}.toml") if (MODELS / f"{w}.toml").is_file() else w for w in words]
    assert main(named) == 2
    shown = said(capsys)
    assert message in shown
    assert "Traceback" not in shown


QUADROTOR = """format = 1
forces.weight.kind = "gravity"
[bodies.frame]
mass = 1.2
inertia = [0.01, 0.012, 0.02]
free = true
[forces.rotors]
kind = "rotors"
body = "frame"
arms = [[0.2, 0, 0], [0, 0.2, 0], [-0.2, 0, 0], [0, -0.2, 0]]
spin = [1.0, -1.0, 1.0, -1.0]
k_f = 1e-5
k_tau = 2e-7
speed_squared = [3e5, 3e5, 3e5, 3e5]
"""


@pytest.mark.slow
def test_a_quadrotor_turns_banked(tmp_path):
    """A floating base is trimmed as a flight: the rotors carry the weight over the cosine of the bank."""
    path = tmp_path / "quadrotor.toml"
    path.write_text(QUADROTOR)
    words = ["trim", str(path), "--speed", "3", "--turn", "45", "--climb", "1"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "trim.json").read_text())
    bank = np.arctan(3.0 * np.radians(45) / 9.81)
    assert 1e-5 * sum(found["inputs"].values()) == pytest.approx(
        1.2 * 9.81 / np.cos(bank), rel=1e-9
    )


@pytest.mark.slow
def test_a_mass_of_a_cart_is_identified_from_a_file(tmp_path, capsys):
    """The record is the motion of a cart of 1.3 kg; the search starts at 1 kg."""
    path = tmp_path / "cart.toml"
    text = (MODELS / "cart_pole.toml").read_text()
    path.write_text(text.replace("cart = {value = 1.0", "cart = {value = 1.3"))
    run = stm.simulate(stm.files.load_model(path), save_every=0.05, error_estimate=False)
    place = np.asarray(run.joint("rail").displacement)
    place = place + 1e-4 * np.random.default_rng(1).normal(size=len(run.ts))
    rows = "".join(f"{t!r},{x!r}\n" for t, x in zip(run.ts.tolist(), place.tolist(), strict=True))
    (tmp_path / "record.csv").write_text(f"t,rail.displacement\n{rows}")
    words = ["tune", "identify", str(path), "--record", str(tmp_path / "record.csv")]
    words += ["--parameters", "cart=1", "--sigma", "rail.displacement=1e-4", "--figures", "none"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    found = re.search(r"cart │ +1 │ ([\d.]+) │ ([\d.e-]+)", said(capsys))
    assert found is not None
    assert abs(float(found[1]) - 1.3) < 4 * float(found[2])
    assert float(found[2]) < 0.02


@pytest.mark.slow
def test_a_four_bar_is_estimated_from_its_encoder(tmp_path, capsys):
    words = ["estimate", str(MODELS / "four_bar.toml"), "--independent", "A.angle", "--t1", "0.2"]
    words += ["--seeds", "40", "--out", str(tmp_path)]
    assert main([*words, "--process", "0.05"]) == 0
    shown = said(capsys)
    assert "NEES at the end" in shown
    with np.load(tmp_path / "estimate.npz") as found:
        assert found["error"].shape == (20, 2, 40)
        assert np.std(found["error"][-1, 0]) < 0.3 * 1e-2
        assert found["ok"].all()
        # of innovations that were kept, NIS by hand
        np.testing.assert_allclose(
            np.nansum(found["innovation"] ** 2, axis=1), found["nis"], rtol=1e-9
        )
        assert (
            np.isfinite(found["innovation"]).sum(axis=1)[:, 0].tolist() == found["degrees"].tolist()
        )
    # the page says what the command said
    (nees,) = re.findall(r"NEES at the end: [\d.]+, consistent within", shown)
    assert main(["report", str(tmp_path)]) == 0
    page, text = read(tmp_path / "report.html")
    assert len(page.sources) == 3
    assert nees in text
    assert "independent A.angle" in text
    assert "process 0.05" in text


# --- the path of a newcomer, as docs/models.md has it


def blocks(heading):
    """Blocks of code below a heading of docs/models.md."""
    text = (ROOT / "docs" / "models.md").read_text().partition(f"## {heading}\n")[2]
    text = text.partition("\n## ")[0]
    return re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL)


@pytest.mark.slow
def test_a_newcomer_with_a_four_bar(tmp_path, monkeypatch, capsys):
    """Simulated, linearised and studied in fewer than ten commands and lines."""
    (kind, study), (shell, commands) = blocks("Your first mechanism")
    assert (kind, shell) == ("toml", "sh")
    lines = [line for line in (study + commands).splitlines() if line.strip()]
    assert len(lines) < 10
    monkeypatch.chdir(tmp_path)
    (tmp_path / "four_bar.toml").write_text((MODELS / "four_bar.toml").read_text())
    (tmp_path / "study.toml").write_text(study)
    for line in commands.splitlines():
        words = shlex.split(line)
        assert words[0] == "stmuav"
        assert main(words[1:]) == 0
    assert stm.load("runs/four_bar/run.nc").attrs["scene"] == "four_bar"
    with np.load("runs/linearize_four_bar/linear.npz") as linear:
        assert linear["A"].shape == (2, 2)
    store = xr.open_zarr("runs/study/study.zarr", consolidated=False)
    assert store.sizes["sample"] == 256
    assert bool((store["status"] == 1).all())
    # at the nominal numbers the rocker is where a simulation has it
    scene = stm.files.load_model("four_bar.toml")
    end = stm.simulate(scene, t1=0.5, error_estimate=False).joint("D").angle[-1]
    assert float(store["rocker"].mean()) == pytest.approx(float(end), abs=0.05)
    assert 0.001 < float(store["rocker"].std()) < 0.1
    capsys.readouterr()
