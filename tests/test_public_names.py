"""The front door: few names at the root, everything else in a room, nothing found only in depth."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import stmuav_jax as stm

REPOSITORY = Path(__file__).parents[1]
ROOT = Path(stm.__file__).parent
ROOMS = sorted(stub.parent.name for stub in ROOT.glob("*/__init__.pyi"))
PAGES = [
    *(REPOSITORY / "notebooks").glob("*.ipynb"),
    *(REPOSITORY / "notebooks").glob("*.py"),
    *(REPOSITORY / "docs").rglob("*.md"),
    *(REPOSITORY / "docs").rglob("*.py"),
    REPOSITORY / "README.md",
]


def text(page: Path) -> str:
    """A page's text; of a notebook, the sources of its cells."""
    if page.suffix != ".ipynb":
        return page.read_text()
    cells = json.loads(page.read_text())["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells)


@pytest.mark.parametrize("room", ["", *ROOMS])
def test_every_public_name_is_there(room):
    namespace = getattr(stm, room) if room else stm
    for name in dir(namespace):
        found = getattr(namespace, name)
        assert isinstance(found, ModuleType) == (name in (*ROOMS, "rotation")), name


@pytest.mark.parametrize("room", ROOMS)
def test_no_public_name_is_that_of_a_module(room):
    """An import of the module would otherwise hide the name."""
    modules = {path.stem for path in (ROOT / room).iterdir()} - {"rotation"}
    assert not modules & set(dir(getattr(stm, room)))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_use_public_names(page):
    found = text(page)
    for source, names in re.findall(r"from stmuav_jax([\w.]*) import (\([^)]*\)|[^\n]+)", found):
        assert source.count(".") <= 1, f"{page.name} imports from stmuav_jax{source}."
        namespace = getattr(stm, source[1:]) if source else stm
        for name in re.findall(r"\w+(?: as \w+)?", names):
            assert name.split(" as ")[0] in dir(namespace)
    for room, name in re.findall(r"(?<![\w.])stm\.([a-z]\w*)\.([A-Za-z]\w*)", found):
        assert room not in ROOMS or name in dir(getattr(stm, room)), f"stm.{room}.{name}"
    for name in re.findall(r"(?<![\w.])stm\.([A-Za-z]\w*)", found):
        assert name in dir(stm), f"{page.name} uses stm.{name}."
    for place in re.findall(r"(?<![\w./])stmuav_jax\.([A-Za-z]\w*(?:\.\w+)*)", found):
        room, *names = place.split(".")
        assert room in dir(stm), f"{page.name} speaks of stmuav_jax.{place}."
        known = set() if room not in ROOMS else set(dir(getattr(stm, room)))
        assert not names or names[0] in known, f"{page.name} speaks of stmuav_jax.{place}."


def test_one_alias_is_used_everywhere():
    for folder in ("tests", "benchmarks", "docs", "notebooks"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    used = {a.asname for a in node.names if a.name == "stmuav_jax"}
                    assert used <= {"stm", None}, f"{path.name}: {used}"


def test_rooms_are_empty_until_they_are_used():
    code = (
        "import sys, stmuav_jax as stm; stm.analysis, stm.estimation, stm.uav; "
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("space", "name", "words"),
    [
        (
            "control",
            "dryden",
            "stmuav_jax.control has no 'dryden'. It is in stmuav_jax.uav.",
        ),
        ("uav", "AirframDrag", "Did you mean 'AirframeDrag'?"),
        ("io", "MotorRotor", "Did you mean stmuav_jax.uav.MotorRotors?"),
        ("", "OnlineFilter", "stmuav_jax has no 'OnlineFilter'. It is in stmuav_jax.estimation."),
        ("", "Simulate", "Did you mean 'simulate'?"),
        ("analysis", "xyzzy", "stmuav_jax.analysis has no 'xyzzy'."),
    ],
)
def test_a_name_that_is_elsewhere_or_misspelt_is_answered(space, name, words):
    with pytest.raises(AttributeError, match=re.escape(words)):
        getattr(getattr(stm, space) if space else stm, name)


def test_no_page_installs_from_an_index():
    """The package is on none; extras are installed as docs/index.md says, in one place."""
    for page in PAGES:
        assert "stmuav-jax[" not in text(page), page
        if page.suffix == ".md" and page.name not in ("README.md", "index.md"):
            assert not re.search(r"pip install '?\.\[", text(page)), page
