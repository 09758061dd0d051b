"""Study files with odd entries: one clear error in the user's words, never a traceback or a wait."""

import copy
import re
import shutil
import time
from pathlib import Path

import pytest

from stmuav_jax.checks.errors import ModelError, SettingError
from stmuav_jax.checks.schema import name_fault
from stmuav_jax.io.netcdf import FileError
from stmuav_jax.studies import Quantity, disturbed_flights
from stmuav_jax.studies.study_file import load_study, make_study
from stmuav_jax.uav import make_scene

NORMAL = {"distribution": "normal", "mean": 0.0, "standard_deviation": 0.3}
BASE = {
    "name": "odd", "scene": "hexacopter", "t1": 0.1, "every": 0.05, "rtol": 1e-8, "atol": 1e-8,
    "samples": 8, "chunk": 4, "lanes": 8, "seed": 4, "design": "random", "solver": "dopri8",
    "max_steps": 100, "inputs": "case", "drag": True, "gusts": False,
    "direction": [0.0, 0.0, 1.0], "correlation": [["start.p", "start.q", 0.5]],
    "factors": {
        "start.p": NORMAL,
        "start.q": {"distribution": "uniform", "low": -1.0, "high": 1.0},
        "bare.mass": {"distribution": "triangular", "low": 0.9, "mode": 1.0, "high": 1.1,
                      "relative": True},
        "bare.inertia[0, 0]": 0.05,
    },
    "quantities": {
        "tilt": {"signal": "tilt", "take": "largest"},
        "over": {"signal": "tilt", "take": "when_above", "level": 0.5, "stop": True},
        "path": {"signal": "z", "take": "path"},
    },
    "failure": {"quantity": "over"},
}  # fmt: skip

MODELS = Path(__file__).parents[2] / "docs" / "models"

DEEP: list = []
for _ in range(3000):
    DEEP = [DEEP]
VALUES = (
    0, -1, 1, 3, 1.5, -0.0, float("nan"), float("inf"), -float("inf"), 1e-320, 1e-300, 1e-12, 1e300,
    1e308, 10**31, 10**400, -(10**400), True, False, "", "x", "yes", "no", "4", "nope", "Case",
    "\0", "x" * 5000, "../../up", "[bold]", [], [1], [1, 2, 3], ["a"], [[1, 2], [3]], DEEP, {},
    {"a": 1}, {"distribution": 3}, {"distribution": "norml"}, None,
)  # fmt: skip


def places(of, path=()):
    """Where a value can be changed: all entries of all tables and lists."""
    found = []
    keys = of.keys() if isinstance(of, dict) else range(len(of)) if isinstance(of, list) else ()
    for key in keys:
        found += [(*path, key), *places(of[key], (*path, key))]
    return found


def changed(path, value, *, rename=None):
    """The study with one entry replaced, or with another name."""
    plain = copy.deepcopy(BASE)
    table = plain
    for key in path[:-1]:
        table = table[key]
    if rename is None:
        table[path[-1]] = value
    else:
        table[rename] = table.pop(path[-1])
    return plain


def odd_studies():
    """Every value in every place, and names that are misspelt."""
    everywhere = places(BASE)
    for path in everywhere:
        for value in VALUES:
            yield path, changed(path, value)
        if isinstance(path[-1], str):
            for name in (path[-1][:-1] + "q", "x" * 5000, "", "a/b", "\n"):
                yield path, changed(path, None, rename=name)


def judged(plain):
    """The error's words, or None where the study is taken."""
    try:
        make_study(plain)
    except (SettingError, ModelError) as error:
        return str(error)
    return None


@pytest.fixture
def scenes_made_once(monkeypatch):
    """A scene of the same case and options is the same scene, whatever else is odd in a study."""
    made = {}

    def make(name, case, table, **options):
        key = name, case, repr(options)
        if key not in made:
            made[key] = make_scene(name, case, table, **options)
        return made[key]

    monkeypatch.setattr(disturbed_flights, "make_scene", make)


@pytest.mark.slow
def test_a_thousand_odd_studies(scenes_made_once):
    """No exception but the package's, no wait, no value at length; and the name of what is odd."""
    cases = list(odd_studies())
    assert len(cases) > 1000
    taken = 0
    for path, plain in cases:
        begin = time.process_time()
        words = judged(plain)
        assert time.process_time() - begin < 5.0, path
        if words is None:
            taken += 1
            continue
        assert len(words) < 900, path
        assert "\0" not in words
        assert not re.search(r"x{200}|\d{100}", words), path
    # most are refused; some values fit where they were put
    assert taken < 0.2 * len(cases)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inputs": "nope"}, "'inputs' must be 'case' or 'trim', but it is 'nope'"),
        ({"inputs": "Case"}, "Did you mean 'case'"),
        ({"gusts": 1}, "'gusts' must be true or false"),
        ({"samples": True}, "'samples' must be a whole number, but it is True"),
        ({"samples": 10**31}, "'samples' must be at most 1000000000000"),
        ({"max_steps": float("nan")}, "'max_steps' must be a whole number"),
        ({"every": 1e-300}, "more than 100,000"),
        ({"direction": [0, 1]}, "'direction' must have more entries"),
        ({"name": "../../up"}, "'name' must begin with neither a dot"),
        ({"lanes": 12}, "'lanes' must be a multiple of 8"),
        ({"failure": {"quantity": "ovr"}}, "Did you mean 'over'"),
        ({"failure": {"quantity": "tilt"}}, "needs a limit"),
        ({"failure": {"quantity": "path", "above": 1.0}}, "no quantity with one number"),
        ({"quantities": {"a b": {"signal": "tilt", "take": "final"}}}, "letters, digits and _"),
        ({"quantities": {"a": {"signal": "tilt"}}}, "'quantities.a' needs 'take'"),
        ({"quantities": {"a": {"signal": "tilt", "take": "final", "levl": 1}}},
         "'quantities.a' has no entry 'levl'. Did you mean 'level'"),
        ({"factors": {"start.p": NORMAL | {"relative": "yes"}}}, "'relative', which must be true"),
        ({"factors": {"start.p": NORMAL | {"standard_deviation": 10**400}}}, "of about 401 digits"),
        ({"factors": {"start.p": {"distribution": "uniform", "low": -1e308, "high": 1e308}}},
         "draws that are not finite"),
        ({"factors": {"bare.inertia[0,]": 1.0}, "correlation": []}, "must name one entry"),
        ({"factors": {"bare.inertia[0, 1]": 0.0, "bare.inertia[0,1]": 0.0}, "correlation": []},
         "are the same number"),
    ],
)  # fmt: skip
def test_words(change, words):
    with pytest.raises(SettingError) as caught:
        make_study(BASE | change)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"take": "finl"}, "'take' must be 'final'"),
        (
            {"take": "when_above"},
            "A quantity is wrong: 'when_above' of signal 'tilt' needs a level",
        ),
        ({"take": "final", "stop": True}, "A quantity has 'stop', which needs take"),
        ({"take": "final", "levl": 1.0}, "A quantity has no entry 'levl'. Did you mean 'level'"),
    ],
)
def test_words_for_a_quantity_made_in_python(entries, words):
    with pytest.raises(SettingError) as caught:
        Quantity(signal="tilt", **entries)
    assert words in str(caught.value)
    assert Quantity(signal="tilt", take="when_above", level=0.5).is_crossing


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".x", " x", "a/b", "a\\b", "x\ny", "\0", "x" * 101]
)
def test_names_that_are_paths(name):
    assert name_fault(name)
    with pytest.raises(SettingError, match="name"):
        make_study(BASE | {"name": name})
    with pytest.raises(SettingError, match="name"):
        make_study({"kind": "estimation", "case": 1, "name": name})


def test_names_that_are_fine():
    for name in ("turning", "a-b c_2", "run[v2]", "Wind 5 m", "größe"):
        assert name_fault(name) is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("x = " + "[" * 3000 + "]" * 3000, "nested too deeply"),
        ("x = " + "1" * 5000, "readable TOML"),
        ("[" + ".".join("a" * 3000) + "]\nb = 1", "."),
        ("x = [" + "1," * 3_000_000 + "]", "larger than"),
        ("\x00", "readable TOML"),
    ],
)
def test_files_that_cannot_be_read(tmp_path, content, words):
    path = tmp_path / "study.toml"
    path.write_text(content)
    with pytest.raises((FileError, SettingError), match=words):
        make_study(load_study(path))


FLIGHTS = """
model = "pendulum.toml"
[factors]
"start.hinge.angle" = {distribution = "lognormal", median = 1.0, log_standard_deviation = 0.1}
[quantities]
fall = {signal = "tilt", take = "when_above", level = 0.5}
"""
MISSIONS = """
kind = "missions"
mission = "hover"
[factors]
"mass.panel_7" = {distribution = "normal", mean = 1.0, standard_deviation = 0.05}
"""


@pytest.mark.parametrize(
    ("content", "old", "new", "words"),
    [
        (FLIGHTS, "log_standard_deviation", "standard_deviation", "no entry .standard_deviation."),
        (FLIGHTS, "median = 1.0", "median = -1.0", "'median' must be"),
        (FLIGHTS, ", level = 0.5", "", "'when_above' of signal 'tilt' needs a level"),
        (FLIGHTS, "[factors]", 'design = "latin"\nstratum = 0\n[factors]', "'stratum' must be"),
        (FLIGHTS, "[factors]", 'kind = "flight"\n[factors]', "kind is flights, estimation, or"),
        (MISSIONS, "mission =", "missions =", "no entry .missions."),
    ],
)
def test_a_study_is_checked_whole_when_it_is_loaded(tmp_path, content, old, new, words):
    """Nothing is built for it; the message begins with the file."""
    shutil.copy(MODELS / "pendulum.toml", tmp_path)
    path = tmp_path / "study.toml"
    path.write_text(content)
    load_study(path)
    path.write_text(content.replace(old, new))
    with pytest.raises(SettingError, match=rf"study\.toml: .*{words}"):
        load_study(path)
