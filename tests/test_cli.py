"""The command line as a user meets it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from html_pages import read

import stmuav_jax as stm
from stmuav_jax.cli import main as cli
from stmuav_jax.cli.main import main
from stmuav_jax.io.netcdf import load


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setenv("COLUMNS", "120")


def run(*arguments):
    cached = arguments[0] in ("simulate", "sun", "estimate")
    return main([*arguments, "--no-cache"] if cached else list(arguments))


def test_list_names_every_scene_and_case(capsys):
    assert run("list") == 0
    out = capsys.readouterr().out
    for words in ("spin", "uav_tracker", "1, 2, 3", "Part II, 5.1", "end [s]"):
        assert words in out


def test_importing_and_starting_set_nothing_but_threads_of_factorisations():
    """OpenBLAS reads the variable when NumPy is imported, which must be later."""
    words = (
        "import os, sys, stmuav_jax, tyro, rich.console; assert 'numpy' not in sys.modules; "
        "import stmuav_jax.cli.main; "
        "import jax; assert not jax.config.jax_enable_x64; print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    own = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    own.pop("JAX_ENABLE_X64", None)
    done = subprocess.run(
        [sys.executable, "-c", words], env=own, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "1"


def test_version_and_help(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.split()[-1] == stm.__version__
    assert main(["--help"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "Simulate, trim, tune and estimate a UAV that carries" in words


@pytest.mark.slow
def test_simulate_writes_results_and_prints_the_certificate(tmp_path, capsys):
    out = tmp_path / "results"
    assert run("simulate", "hexacopter", "--t1", "0.1", "--out", str(out)) == 0
    names = {"run.nc", "certificate.json", "pose.png", "balances.png"}
    assert {p.name for p in out.iterdir()} == names
    assert load(out / "run.nc").attrs["scene"] == "hexacopter"
    assert json.loads((out / "certificate.json").read_text())["certificate"]["t_end"] == 0.1
    printed = capsys.readouterr().out
    assert "Relative energy error" in printed
    assert "successful at t = 0.1 s" in printed


@pytest.mark.slow
def test_loads_are_written_if_asked_for(tmp_path, capsys):
    arguments = ("simulate", "spin", "--t1", "0.1", "--loads", "--out", str(tmp_path))
    assert run(*arguments) == 0
    assert {"loads.csv", "loads.png"} <= {p.name for p in tmp_path.iterdir()}
    assert "peak force [N]" in capsys.readouterr().out


def test_parameters_and_solver_reach_the_run(tmp_path, capsys):
    table = tmp_path / "p.toml"
    table.write_text("[bare]\nlift_factor = 1.2\n")
    code = run(
        "simulate", "hexacopter", "--t1", "0.05", "--params", str(table), "--solver", "tsit5",
        "--rtol", "1e-9", "--no-error-estimate", "--figures", "none", "--out", str(tmp_path),
    )  # fmt: skip
    assert code == 0
    certificate = json.loads((tmp_path / "certificate.json").read_text())["certificate"]
    assert certificate["position_error"] is None
    assert certificate["estimate_seconds"] == 0.0
    assert "There is no error estimate: none was requested." in capsys.readouterr().out
    data = load(tmp_path / "run.nc")
    assert json.loads(data.attrs["parameters"])["bare.lift_factor"]["value"] == 1.2
    assert json.loads(data.attrs["settings"])["solver"] == "Tsit5"
    assert json.loads(data.attrs["settings"])["rtol"] == 1e-9


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("tracker", "--case", "7"), "no case 7"),
        (("tracker", "--rtol", "0"), "relative tolerance must be above 0"),
        (("tracker", "--params", "/none.toml"), "There is no file '/none.toml'"),
        (("hexacopter", "--loads"), "hexacopter has none"),
        (("hexacopter", "--jump-times", "99"), "must lie within the run, between 0 and"),
        (("hexacopter", "--baumgarte-gains", "1", "1", "1"), "but it is projection"),
    ],
)
def test_bad_input_is_one_paragraph_and_exit_code_two(arguments, words, capsys, tmp_path):
    assert run("simulate", *arguments, "--out", str(tmp_path)) == 2
    error = capsys.readouterr().err
    assert words in error.replace("\n", " ")
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_run_that_cannot_go_on_keeps_what_was_reached(tmp_path, capsys):
    code = run(
        "simulate", "hexacopter", "--t1", "0.1", "--max-steps", "2", "--figures", "none",
        "--out", str(tmp_path),
    )  # fmt: skip
    assert code == 1
    assert "2 steps did not reach" in capsys.readouterr().err.replace("\n", " ")
    assert load(tmp_path / "run.nc").sizes["time"] >= 1


SUN = ("sun", "--lat", "11.55", "--lon", "104.92", "--date", "2024-03-21")


@pytest.mark.slow
def test_sun_prints_draws_and_saves_a_day(tmp_path, capsys):
    """With an attitude from a file that is the one of the options."""
    code = run(*SUN, "--step", "900", "--yaw", "90", "--out", str(tmp_path / "a"))
    assert code == 0
    names = {"day.nc", "tracking.png", "sky.png", "light.png"}
    assert {p.name for p in (tmp_path / "a").iterdir()} == names
    printed = capsys.readouterr().out
    for words in ("11.55° N, 104.92° E, 2024-03-21 (UTC+07:00)", "06:0", "tracker on the UAV",
                  "more than level"):  # fmt: skip
        assert words in printed
    attitude = tmp_path / "attitude.csv"
    attitude.write_text("t,roll,pitch,yaw\n0,0,0,90\n")
    code = run(
        *SUN, "--step", "900", "--attitude", str(attitude), "--figures", "none", "--timezone",
        "Asia/Phnom_Penh", "--out", str(tmp_path / "b"),
    )  # fmt: skip
    assert code == 0
    assert {p.name for p in (tmp_path / "b").iterdir()} == {"day.nc"}
    days = [xr.load_dataset(tmp_path / k / "day.nc", engine="h5netcdf") for k in "ab"]
    np.testing.assert_array_equal(days[0]["panel_angles"], days[1]["panel_angles"])
    assert float(days[0]["energy"].sel(panel="tracker")) > 1.3 * float(
        days[0]["energy"].sel(panel="flat")
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--lat", "91"), "latitude must lie within"),
        (("--date", "yesterday"), "The date must be like 2024-03-21, not 'yesterday'"),
        (("--altitude", "60000"), "altitude must lie within -500 and 11000 m, but it is 60000"),
        (("--roll", "nan"), "angle must be finite, but it is nan degrees (--roll)"),
        (("--date", "2024-12-21", "--lat", "80"), "The sun does not rise at 80 degrees north"),
        (("--timezone", "Asia/Pnom_Penh"), "Did you mean 'Asia/Phnom_Penh'"),
        (("--attitude", "/none.csv"), "There is no file '/none.csv'"),
        (("--attitude", "/none.csv", "--yaw", "3"), "excludes"),
    ],
)
def test_sun_bad_input_is_one_paragraph_and_exit_code_two(arguments, words, capsys, tmp_path):
    given = dict(zip(SUN[1::2], SUN[2::2], strict=True))
    given |= dict(zip(arguments[::2], arguments[1::2], strict=True)) | {"--out": str(tmp_path)}
    assert run("sun", *(word for pair in given.items() for word in pair)) == 2
    error = capsys.readouterr().err
    assert words in error.replace("\n", " ")
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_command_that_was_run_before_compiles_nothing(tmp_path, monkeypatch):
    """Nor does it import what is slow to import and not needed; its numbers are the same."""
    words = ["simulate", "spin", "--t1", "0.01", "--figures", "none", "--out", str(tmp_path)]
    code = (
        "import sys; from stmuav_jax.cli.main import main; assert main(sys.argv[1:]) == 0; "
        "assert not {'xarray', 'pandas', 'scipy', 'matplotlib', 'dask'} & set(sys.modules)"
    )
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_EXPLAIN_CACHE_MISSES", "1")
    misses, ends = [], []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", code, *words],
            check=True, timeout=600, capture_output=True, text=True,
        )  # fmt: skip
        misses.append(done.stderr.count("PERSISTENT COMPILATION CACHE MISS"))
        with xr.open_dataset(tmp_path / "run.nc") as run:
            ends.append(run.position.values)
    assert misses[0] > 3
    assert misses[1] == 0
    np.testing.assert_array_equal(ends[1], ends[0])


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners of files here")
def test_a_cache_folder_that_others_may_exchange_is_not_used(tmp_path, monkeypatch):
    """JAX reads compiled code from there, which becomes part of the process."""
    parent = tmp_path / "parent"
    parent.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(parent))
    folder = parent / "stmuav_jax"
    assert cli.cache_folder() == folder

    def used():
        done: dict[str, object] = {}
        with monkeypatch.context() as changed:
            changed.setattr("jax.config.update", done.__setitem__)
            cli._configure_cache(True)
        return done.get("jax_compilation_cache_dir")

    assert used() == str(folder)
    for shared in (folder, parent):
        shared.chmod(0o777)
        assert used() is None
        shared.chmod(0o700)
    # as in /tmp, nobody else may rename what is in a folder with the sticky bit
    parent.chmod(0o1777)
    assert used() == str(folder)
    # a link is followed once: what is checked is what is used
    link = tmp_path / "link"
    link.symlink_to(parent)
    monkeypatch.setenv("XDG_CACHE_HOME", str(link))
    assert used() == str(folder)
    with monkeypatch.context() as changed:
        changed.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
        assert used() is None
    monkeypatch.setenv("XDG_CACHE_HOME", str(parent / "file"))
    (parent / "file").write_text("")
    assert used() is None


def test_a_cache_folder_needs_an_absolute_path_or_a_home(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", "/of/the/user")
    assert cli.cache_folder() == Path("/of/the/user/.cache/stmuav_jax")

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    assert cli.cache_folder() is None
    cli._configure_cache(True)


@pytest.mark.slow
def test_trim_command(tmp_path, capsys):
    """At the sun, with a sensitivity; then limits that cannot carry the weight."""
    given = ["trim", "--sun", "150", "70", "--out", str(tmp_path), "--no-cache"]
    assert main([*given, "--by", "mass.panel_7"]) == 0
    found = json.loads((tmp_path / "trim.json").read_text())
    assert max(found["residuals"].values()) < 1e-10
    assert found["units"]["speed_1"] == "rad/s"
    slopes = dict(zip(found["values"], found["sensitivities"]["mass.panel_7"], strict=True))
    # more panel, more thrust
    assert slopes["speed_1"] > 0
    output = capsys.readouterr().out
    assert "Trim" in output
    assert "per minute" in output
    assert " or rad/s^2" not in output
    assert set(found["residuals"]) == {"m/s^2", "rad/s^2", "1"}
    assert found["rotors"]["speed_squared_1"]["speed"] == found["values"]["speed_1"]
    assert main([*given, "--highest", "1300"]) == 2
    assert "N are required" in " ".join(capsys.readouterr().err.split())
    assert main([*given, "--phi", "3"]) == 2
    assert "--sun excludes --phi" in capsys.readouterr().err
    assert main(["trim", "--phi", "70", "--no-cache"]) == 2
    assert "70.98 degrees from the base's z axis, 11 more" in " ".join(
        capsys.readouterr().err.split()
    )
    assert main([*given, "--turn", "10"]) == 2
    assert "--sun is for straight flights" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_trim_with_its_linear_model(tmp_path, capsys):
    given = ["trim", "--linear", "trim", "--outputs", "U47.angle_1", "--no-cache"]
    assert main([*given, "--out", str(tmp_path)]) == 0
    with np.load(tmp_path / "linear.npz") as found:
        assert found["A"].shape == (16, 16)
        assert list(found["outputs"]) == ["U47.angle_1 [rad]"]
        assert found["C"].shape == (1, 16)
    assert {path.name for path in tmp_path.iterdir()} == {"trim.json", "linear.npz"}
    printed = capsys.readouterr().out
    assert "Modes" in printed
    assert "doubles or halves in [s]" in printed
    assert "halves in 0.08" in printed
    assert "0j" not in printed
    assert main([*given, "--turn", "3"]) == 2
    assert "straight flight" in capsys.readouterr().err


@pytest.mark.slow
def test_tune_commands(tmp_path, capsys):
    """Hold, cut short and gone on with; another problem's checkpoint is refused."""
    given = [
        "tune",
        "hold",
        "uav_tracker",
        "--t1",
        "0.3",
        "--segments",
        "6",
        "--out",
        str(tmp_path),
    ]
    given += ["--inputs", "speed_squared", "force_slider_2", "force_slider_3", "--no-cache"]
    assert main([*given, "--steps", "2"]) == 1
    printed = capsys.readouterr()
    assert "2 steps allowed" in printed.out
    assert "NOT CONVERGED: the best of 2 steps" in printed.out
    assert main([*given, "--resume"]) == 0
    printed = capsys.readouterr().out
    assert "Converged" in printed
    assert "NOT CONVERGED" not in printed
    # those of the trim
    assert "5.47804" in printed
    assert (tmp_path / "loss.png").stat().st_size > 5000
    assert (tmp_path / "motion.png").stat().st_size > 5000
    assert main(["tune", "slew", *given[2:], "--to", "U47.angle_1=0.1", "--resume"]) == 2
    assert "search of another problem" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_estimate_prints_draws_and_saves_a_case(tmp_path, capsys):
    code = run("estimate", "--case", "4", "--seeds", "3", "--t1", "0.05", "--out", str(tmp_path))
    # done, but the report's tuning cannot be trusted
    assert code == 3
    names = {"estimate.nc", "offset.png", "rates.png", "errors.png", "consistency.png"}
    assert {p.name for p in tmp_path.iterdir()} == names
    printed = capsys.readouterr().out
    words = " ".join(printed.split())
    assert "Case 4, consistent tuning: consistent. - 0 of 3 runs are inconsistent" in words
    assert "Case 4, report tuning: inconsistent. - 3 of 3 runs are inconsistent" in words
    data = xr.load_dataset(tmp_path / "estimate.nc", engine="h5netcdf")
    assert data["estimate"].dims == ("tuning", "time", "component", "seed")
    assert all(data[name].attrs["units"] for name in data.data_vars)
    error = data["estimate"] - data["truth"]
    last = error.sel(tuning="consistent", component="offset_x").isel(time=-1)
    assert float(abs(last).max()) < 0.01
    rows = json.loads(data.attrs["summaries"])
    assert rows["report"]["case"] == 4
    assert rows["report"]["verdict"]["status"] == "inconsistent"
    assert main(["view", str(tmp_path), "--report", str(tmp_path / "page" / "report.html")]) == 0
    page, text = read(tmp_path / "page" / "report.html")
    assert len(page.sources) == 1
    assert "Report tuning: inconsistent. 3 of 3 runs are inconsistent" in text
    off = np.sqrt(np.mean(error.sel(component="offset_x").isel(time=-1) ** 2, axis=-1))
    assert f"offset_x [m], report {float(off[0]):.4g} " in text
    given = "--case", "4", "--seeds", "3", "--t1", "0.05", "--tuning", "consistent"
    assert run("estimate", *given, "--figures", "none", "--out", str(tmp_path)) == 0
    # a mismatch: the filter alone believes in a better gyroscope
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("true = {R = [1e-5, 2e-5, 1e-5]}\n")
    given += "--filter-params", str(wrong)
    assert run("estimate", *given, "--figures", "none", "--out", str(tmp_path)) == 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--case", "9"), "number of the case must lie within 1 and 8"),
        (("--case", "1", "--t1", "1e-4"), "between one step of 0.001 s"),
        (("--params", "/none.toml"), "There is no file '/none.toml'"),
    ],
)
def test_estimate_bad_input_is_one_paragraph_and_exit_code_two(arguments, words, capsys, tmp_path):
    assert run("estimate", *arguments, "--out", str(tmp_path)) == 2
    error = capsys.readouterr().err
    assert words in error.replace("\n", " ")
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())
