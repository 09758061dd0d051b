"""Every command on a model's file: trim, linearisation, tuning, identification, estimation, studies."""

import dataclasses
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from html_pages import read

import stmuav_jax as stm
from stmuav_jax.cli.main import main

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "docs" / "models"


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setenv("COLUMNS", "120")


def said(capsys):
    shown = capsys.readouterr()
    return " ".join((shown.out + shown.err).split())


@pytest.mark.slow
def test_trim_of_a_cart_that_accelerates(tmp_path, capsys):
    """The pole leans forward by tan(angle) = a / g, and the force moves both masses."""
    words = ["trim", str(MODELS / "cart_pole.toml"), "--coordinates", "hinge=0.1", "rail=0"]
    words += ["--rates", "hinge=0", "rail=0", "--free", "hinge.angle"]
    words += ["--accelerations", "rail.displacement_rate=2.0", "--out", str(tmp_path)]
    assert main(words) == 0
    found = json.loads((tmp_path / "trim.json").read_text())
    assert found["inputs"]["effort"] == pytest.approx(1.1 * 2.0, rel=1e-9)
    assert found["changes"] == {"hinge.angle": pytest.approx(np.arctan2(2.0, 9.8) - 0.1, rel=1e-9)}
    assert found["units"] == {"effort": "N", "hinge.angle": "rad"}
    assert "input effort" in said(capsys)


@pytest.mark.slow
def test_efforts_along_a_path_and_a_survey_of_postures(tmp_path, capsys, monkeypatch):
    """Files say what the library's functions give; what the inputs cannot hold is said."""
    monkeypatch.chdir(tmp_path)
    ts = np.linspace(0.0, 1.0, 21)
    motion = np.column_stack([ts, ts**3, np.zeros(21)])
    np.savetxt("motion.csv", motion, delimiter=",", header="t,rail,hinge", comments="")
    cart = str(MODELS / "cart_pole.toml")
    assert main(["trim", cart, "--path", "motion.csv", "--out", "efforts"]) == 0
    system = stm.io.load_model(cart).system
    exact = {"rail": lambda t: t**3, "hinge": lambda t: 0.0 * t}
    efforts = stm.analysis.inverse_dynamics(system, exact, ts)
    assert f"inputs leave: {np.max(efforts.unbalanced):.1e} of the weight" in said(capsys)
    found = np.genfromtxt("efforts/efforts.csv", delimiter=",", skip_header=1)
    np.testing.assert_allclose(found, np.column_stack([ts, efforts.values]), atol=1e-9)
    assert Path("efforts/efforts.png").stat().st_size > 1000
    words = ["--survey", "hinge.angle=-1,1", "rail.displacement=0,1", "--figures", "none"]
    assert main(["trim", cart, *words, "--out", "survey"]) == 0
    assert "441 of 441" in said(capsys)
    table = np.genfromtxt("survey/survey.csv", delimiter=",", names=True)
    ranges = [(-1, 1), (0, 1)]
    result = stm.analysis.survey(system, ["hinge.angle", "rail.displacement"], ranges)
    np.testing.assert_allclose(table["hold"], result.hold.ravel(), rtol=1e-12)
    np.testing.assert_allclose(table["hingeangle_rad"].reshape(21, 21)[:, 0], result.first)
    np.savetxt("short.csv", motion[:5], delimiter=",", header="t,rail,hinge", comments="")
    for path, message in (
        ("short.csv", "at least 6 times; short.csv has 5"),
        ("none.csv", "none.csv"),
    ):
        assert main(["trim", cart, "--path", path]) == 2
        assert message in said(capsys)
    assert main(["trim", cart, "--path", "motion.csv", "--climb", "1"]) == 2
    assert "--path and --survey exclude --linear" in said(capsys)
    assert main(["trim", cart, "--survey", "hinge.angle=1", "rail.displacement=0,1"]) == 2
    assert "two coordinates with two limits each" in said(capsys)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("trim", "four_bar", "--inputs", "torque"), "name 'torque', which is no input"),
        (("trim", "pendulum"), "no inputs that a trim could choose: name states that it may"),
        (("trim", "cart_pole", "--coordinates", "hinge"), "names with numbers, such as A=0.3, not 'hinge'"),
        (("trim", "cart_pole", "--climb", "1"), "are for a floating base"),
        (("trim", "four_bar", "--linear", "start", "--outputs", "A.angel", "--independent", "A.angle"),
         "Did you mean 'A.angle'"),
        (("tune", "slew", "cart_pole"), "tune slew needs --to"),
        (("estimate", "cart_pole"), "has no sensors to estimate from"),
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
kind = "motors"
highest = 1000.0
body = "frame"
arms = [[0.2, 0, 0], [0, 0.2, 0], [-0.2, 0, 0], [0, -0.2, 0]]
spin = [1.0, -1.0, 1.0, -1.0]
k_f = 1e-5
k_tau = 2e-7
speed_squared = [3e5, 3e5, 3e5, 3e5]
"""


@pytest.mark.slow
def test_a_quadrotor_turns_banked(tmp_path, capsys):
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
    # what a person reads: speeds, revolutions, thrusts and shares of the limit
    for name, squared in found["inputs"].items():
        rotor = found["rotors"][name]
        assert rotor["speed"] == pytest.approx(np.sqrt(squared))
        assert rotor["thrust"] == pytest.approx(1e-5 * squared)
        assert rotor["share"] == pytest.approx(np.sqrt(squared) / 1000.0)
    shown = said(capsys)
    first = found["rotors"]["speed_squared_1"]["speed"]
    assert f"{first:.6g}" in shown
    assert f"{first * 30 / np.pi:,.0f}" in shown
    assert "speed_squared" not in shown


@pytest.mark.parametrize("kind", ["model", "mission", "study"])
def test_schemas_of_files_are_printed(kind, capsys):
    assert main(["list", "--schema", kind]) == 0
    schema = json.loads(capsys.readouterr().out)
    content = {"model": "bodies", "mission": "machine", "study": "$defs"}[kind]
    assert content in schema or content in schema["properties"]


@pytest.mark.slow
def test_a_start_is_identified_from_a_file_with_blank_cells(tmp_path, capsys):
    """A pendulum that was let go at 1.2 rad, and not at rest, from a record in which every fifth cell is blank."""
    path = MODELS / "pendulum.toml"
    scene = stm.io.load_model(str(path))
    state = stm.state_from_joints(scene.system, {"pin": 1.2}, {"pin": 0.3}, start=scene.state0)
    run = stm.simulate(
        dataclasses.replace(scene, state0=state), save_every=0.02, error_estimate=False
    )
    angle = np.asarray(run.joint("pin").angle)
    angle = angle + 1e-3 * np.random.default_rng(2).normal(size=len(run.ts))
    cells = [("" if k % 5 == 3 else repr(a)) for k, a in enumerate(angle.tolist())]
    rows = "".join(f"{t!r},{a}\n" for t, a in zip(run.ts.tolist(), cells, strict=True))
    (tmp_path / "record.csv").write_text(f"t,pin.angle\n{rows}")
    words = ["identify", str(path), "--record", str(tmp_path / "record.csv")]
    words += ["--parameters", "release=1.05", "--sigma", "pin.angle=1e-3", "--figures", "none"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    shown = said(capsys)
    found = re.search(r"release │ +1\.05 │ ([\d.]+) │ ([\d.e-]+)", shown)
    assert found is not None
    assert abs(float(found[1]) - 1.2) < 4 * float(found[2])
    assert float(found[2]) < 1e-3
    assert "start estimated: pin.angle_rate" in shown
    assert "Consistent: none of" in shown
    assert "is missing and was left out" in shown
    # a start that is said to be exact, at rest, is none: the verdict and the exit code say so
    words += ["--start-deviations", "pin.angle_rate=0"]
    assert main([*words, "--out", str(tmp_path)]) == 3
    assert "Inconsistent" in said(capsys)


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
    assert main(["view", str(tmp_path), "--report", str(tmp_path / "report.html")]) == 0
    page, text = read(tmp_path / "report.html")
    assert len(page.sources) == 1
    assert nees in text
    assert "A.angle" in text
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
    scene = stm.io.load_model("four_bar.toml")
    space = stm.TreeSpace(scene.system, scene.state0, independent=["A.angle"])
    exact = stm.linearize(space, space.from_state(scene.state0))
    with np.load("runs/trim_four_bar/linear.npz") as linear:
        np.testing.assert_array_equal(linear["A"], exact.A)
        np.testing.assert_array_equal(linear["B"], exact.B)
        assert list(linear["inputs"]) == ["effort [N m]"]
    store = xr.open_zarr("runs/study/study.zarr", consolidated=False)
    assert store.sizes["sample"] == 256
    assert bool((store["status"] == 1).all())
    assert 0.001 < float(store["rocker"].std()) < 0.1
    capsys.readouterr()
