"""Odd command lines: a message and an exit code for each, no traceback."""

import random
import signal
import subprocess
import sys

import pytest

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.cli import identify, main as cli, simulate, trim, tune
from stmuav_jax.cli.output import INTERRUPTED

NUMBERS = (
    "0", "-1", "1e-300", "5e-324", "1e308", "1e400", "nan", "-inf", "inf", "hello", "", " ",
    "9" * 40, "9" * 400, "1.5", "0x10", "1_000", "None", "[b]", "[/b]", ":x:", "--", "-", "1,2",
)  # fmt: skip
NAMES = ("", "[/b]", "a b", "../..", "\n", "none.toml", "é", "x" * 3000, "nan", "/", "~", "-q")
OPTIONS = {
    "list": (),
    "simulate": ("--case", "--t1", "--rtol", "--atol", "--save-every", "--max-steps", "--solver",
                 "--first-step", "--max-step", "--jump-times", "--baumgarte-gains",
                 "--params", "--actuators", "--out", "--figures", "--loads", "--no-error-estimate",
                 "--nope", "--servo", "--servo.stiffness", "--stops.lower", "--strokes.to",
                 "--start.phi", "--start.phi-rate", "--start.nope", "--wind.mean"),
    "sun": ("--lat", "--lon", "--date", "--timezone", "--altitude", "--roll", "--pitch", "--yaw",
            "--step", "--stroke-step", "--turbidity", "--attitude-error", "--attitude"),
    "trim": ("--phi", "--theta", "--sun", "--climb", "--speed", "--course", "--turn", "--yaw",
             "--highest", "--lowest", "--force", "--by", "--params", "--linear", "--outputs"),
    "tune": ("--to", "--t1", "--limit", "--reaction", "--segments", "--knots", "--inputs", "--steps"),
    "identify": ("--record", "--parameters", "--sigma", "--start-deviations", "--bounds", "--steps"),
    "estimate": ("--case", "--tuning", "--model", "--seeds", "--seed", "--t1"),
    "fly": ("--t1", "--true-states", "--figures", "--out"),
    "montecarlo": ("--samples", "--seed", "--chunk", "--devices", "--lanes", "--workers"),
    "view": ("--beside", "--html", "--sun", "--report", "--case", "--out", "--figures", "--servo.stiffness", "--nope"),
    "check": ("--case", "--params", "--stops.lower", "--start.phi-rate", "--wind.mean", "--figures"),
}  # fmt: skip
FIRST = {
    "simulate": ("spin", "tracker", "uav", "", "[b]"), "tune": ("hold", "slew", "fly", "0"),
    "identify": ("spin", "tracker", "none.toml", "[b]"),
    "fly": ("hover", "case-9", "", "a/[/b].toml"),
    "montecarlo": ("collapse", "nope", "", "a/[/b].toml"),
    "view": ("nope", "", "[/b]", "run.nc", "spin", "tracker", "uav", "none.toml"),
    "check": ("spin", "tracker", "", "none.toml", "a/[/b].toml"),
}  # fmt: skip


def odd_line(rng):
    name = rng.choice([*OPTIONS, "nope", "--help", "--version", ""])
    words = [name]
    if name in FIRST and rng.random() < 0.95:
        words.append(rng.choice(FIRST[name]))
    if name == "sun" and rng.random() < 0.8:
        words += ["--lat", "11.5", "--lon", "104.9"]
        words += ["--date", rng.choice(("2024-03-21", "2024-02-30", "0001-01-01", "20240321", "x"))]
    for option in rng.choices(OPTIONS.get(name) or ("--x",), k=rng.randint(0, 3)):
        words.append(option)
        words += [rng.choice(NUMBERS if rng.random() < 0.7 else NAMES)] * rng.choice(
            (0, 1, 1, 1, 2, 3)
        )
    return words


@pytest.fixture
def stubbed(monkeypatch):
    """What starts to compute says so instead; what comes before is the commands' own."""
    reached = []

    def stop(*_, **__):
        reached.append(1)
        raise SettingError("The work would begin.")

    for module, name in (
        (simulate, "run_scene"), (trim, "_solve_uav"), (tune, "_tune_inputs"),
        (identify, "_identify_parameters"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, stop)
    for name in ("montecarlo", "estimate", "fly"):
        monkeypatch.setitem(cli.COMMANDS, name, cli.COMMANDS[name]._replace(run=stop))
    for place in (
        "uav.tracker.day.best_heading", "uav.tracker.day.track_day", "dynamics.inspection.check",
        "figures.sketch.draw",
    ):  # fmt: skip
        monkeypatch.setattr(f"stmuav_jax.{place}", stop)
    monkeypatch.setattr(cli, "_configure_cache", lambda _: None)
    return reached


@pytest.mark.slow
def test_odd_lines(stubbed, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines, rng = 250, random.Random(250)
    codes = {0: 0, 1: 0, 2: 0}
    for _ in range(lines):
        words = odd_line(rng)
        code = cli.main(words)
        printed = capsys.readouterr()
        assert code in (0, 2), (words, printed.err)
        assert "Traceback" not in printed.err + printed.out, words
        assert "fault of the program" not in printed.err, (words, printed.err)
        assert code == 0 or len(printed.err) > 20, words
        codes[code] += 1
    # most are refused, some get as far as the work
    assert codes[2] > 0.8 * lines
    assert len(stubbed) > 0.02 * lines
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("columns", ["0", "20", "80"])
def test_any_width_of_the_terminal_shows_words_in_whole(columns, capsys, monkeypatch):
    """COLUMNS=0 is what shells give for an unknown width; messages stand in one line."""
    monkeypatch.setenv("COLUMNS", columns)
    assert cli.main(["list"]) == 0
    assert "hexacopter" in capsys.readouterr().out
    assert cli.main(["sun", "--lat", "1", "--lon", "2", "--date", "2024-02-30"]) == 2
    assert "stmuav: There is no day 2024-02-30 in the calendar.\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (ZeroDivisionError("division by zero"), 1, "a fault of the program"),
        (MemoryError(), 1, "not enough memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (OSError(28, "No space left on device", "a.nc"), 2, "No space left on device: a.nc"),
        (SettingError("[rad/s] of [/b] :x:"), 2, "[rad/s] of [/b] :x:"),
        (RecursionError("x" * 10_000), 1, "xx ... xx"),
    ],
)
def test_one_boundary(error, code, words, monkeypatch, capsys, tmp_path):
    """Whatever a command raises is one paragraph; the traceback comes with --debug or in a file."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)

    def run(name, given, keep_programs):
        raise error

    monkeypatch.setattr(cli, "_run_command", run)
    monkeypatch.setenv("COLUMNS", "100000")
    assert cli.main(["list"]) == code
    printed = capsys.readouterr().err
    assert words in printed
    assert "Traceback" not in printed
    logs = list(tmp_path.glob("stmuav-fault-*.log"))
    assert len(logs) == ("fault" in printed)
    assert all("Traceback" in log.read_text() for log in logs)
    assert cli.main(["list", "--debug"]) == code
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ("trim --speed 1e10", "speed must lie within"),
        ("trim --force nan", "limit of the force must be finite"),
        ("trim --by", "--by needs at least one value"),
        ("estimate --seed -1", "seed must lie within 0"),
        ("estimate --seeds 10000000000", "number of runs must lie within 1"),
        ("tune hold spin --segments 0", "number of segments must lie within 1"),
        ("tune hold spin --t1 nan", "end of the time span must be finite"),
        ("tune slew spin --reaction -5", "limit of the force must be above 0"),
        (f"simulate spin --max-steps {'9' * 23}", "max"),
        ("simulate spin --save-every 5e-324", "save"),
        ("simulate spin --max-step 0", "largest step must be above 1e-12"),
        ("simulate spin --first-step -1", "first step must be above 1e-12"),
        ("simulate spin --jump-times 0.1 inf", "time of a jump must be finite"),
        ("simulate spin --jump-times", "--jump-times needs at least one value"),
        (
            "simulate spin --baumgarte-gains 1 -1 1",
            "gain of Baumgarte's feedback must lie within 0",
        ),
        ("montecarlo collapse --samples 0", "number of samples must lie within 1"),
        ("sun --lat 0 --lon 0 --date 2024-03-21 --turbidity 1e300", "turbidity must lie within 1"),
        ("sun --lat 0 --lon 0 --date 2024-03-21 --attitude-error 1e300 0 0", "must lie within"),
    ],
)
def test_what_was_once_taken_in_silence_or_broke(words, what, stubbed, capsys, monkeypatch):
    """One line of an independent verification each: refused before anything is computed."""
    monkeypatch.setenv("COLUMNS", "1000")
    assert cli.main(words.split()) == 2
    assert what in capsys.readouterr().err
    assert not stubbed


@pytest.mark.slow
def test_an_interrupted_command_ends_with_its_code(tmp_path):
    """Ctrl-C while XLA compiles or runs: 130 or the code of a saved part, and never a signal's."""
    command = [sys.executable, "-P", "-m", "stmuav_jax", "simulate", "hexacopter"]
    for seconds in (1.0, 4.0):
        process = subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
        assert process.returncode in (0, 1, INTERRUPTED, -signal.SIGINT), (seconds, output)
        assert "Traceback" not in output or process.returncode == -signal.SIGINT
