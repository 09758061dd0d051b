"""The command line as a user meets it."""

import json
import subprocess
import sys

import pytest

from stmuav_jax.cli import main
from stmuav_jax.view.io import load


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setenv("COLUMNS", "120")


def run(*arguments):
    return main([*arguments, "--no-cache"] if arguments[0] == "simulate" else list(arguments))


def test_list_names_every_scene_and_case(capsys):
    assert run("list") == 0
    out = capsys.readouterr().out
    for words in ("spin", "uav_tracker", "1, 2, 3", "Part II, 5.1"):
        assert words in out


def test_simulate_writes_results_and_prints_the_certificate(tmp_path, capsys):
    out = tmp_path / "results"
    assert run("simulate", "hexacopter", "--t1", "0.1", "--out", str(out)) == 0
    names = {"run.nc", "certificate.json", "positions.png", "euler_parameters.png", "balances.png"}
    assert {p.name for p in out.iterdir()} == names
    assert load(out / "run.nc").attrs["scene"] == "hexacopter"
    assert json.loads((out / "certificate.json").read_text())["certificate"]["t_end"] == 0.1
    printed = capsys.readouterr().out
    assert "Energy balance" in printed
    assert "successful at t = 0.1 s" in printed


def test_parameters_and_solver_reach_the_run(tmp_path):
    table = tmp_path / "p.toml"
    table.write_text("[bare]\nlift_factor = 1.2\n")
    code = run(
        "simulate", "hexacopter", "--t1", "0.05", "--params", str(table), "--solver", "tsit5",
        "--rtol", "1e-9", "--figures", "none", "--out", str(tmp_path),
    )  # fmt: skip
    assert code == 0
    data = load(tmp_path / "run.nc")
    assert json.loads(data.attrs["parameters"])["bare.lift_factor"]["value"] == 1.2
    assert json.loads(data.attrs["settings"])["solver"] == "Tsit5"
    assert json.loads(data.attrs["settings"])["rtol"] == 1e-9


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("tracker", "--case", "7"), "no case 7"),
        (("tracker", "--t1", "-1"), "t1 = -1.0 s"),
        (("tracker", "--rtol", "0"), "rtol must be"),
        (("tracker", "--actuators", "printed"), "tracker has no actuators"),
        (("tracker", "--params", "/none.toml"), "There is no file /none.toml"),
    ],
)
def test_bad_input_is_one_paragraph_and_exit_code_two(arguments, words, capsys, tmp_path):
    assert run("simulate", *arguments, "--out", str(tmp_path)) == 2
    error = capsys.readouterr().err
    assert words in error.replace("\n", " ")
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_a_run_that_cannot_go_on_keeps_what_was_reached(tmp_path, capsys):
    code = run(
        "simulate", "hexacopter", "--t1", "0.1", "--max-steps", "2", "--figures", "none",
        "--out", str(tmp_path),
    )  # fmt: skip
    assert code == 1
    assert "2 steps did not reach" in capsys.readouterr().err.replace("\n", " ")
    assert load(tmp_path / "run.nc").sizes["time"] >= 1


def test_installed_command_and_import_leave_jax_alone():
    """Importing the package sets no global configuration; the entry point exists."""
    code = "import stmuav_jax, jax; assert not jax.config.jax_enable_x64"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
    code = "from importlib.metadata import entry_points as e; e(name='stmuav')['stmuav'].load()"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
