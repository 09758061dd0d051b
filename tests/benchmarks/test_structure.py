"""The benchmarks' folders: sizes, and imports that only go down and never into the tests."""

import ast
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
MODULES = sorted(FOLDER.rglob("*.py"))
# A folder sees those on floors below; the scripts, which lie in none, see all.
FLOORS = {
    "shared": 0,
    "problems": 0,
    "dense": 1,
    "peers": 2,
    "sections": 3,
    "": 4,
}
TESTS = {path.stem for path in FOLDER.parent.joinpath("tests").rglob("*.py")} | {"tests"}
# sixteen scripts are started
LINES, STEPS, IN_A_FOLDER, IN_ALL = 400, 60, 16, 8_650

each = pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(FOLDER)))


def room(path: Path) -> str:
    """The folder of a module; empty for a script."""
    return "" if path.parent == FOLDER else path.parent.name


def imported(path: Path) -> set[str]:
    """First part and whole name of all that a module imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert not node.level, f"{path.name} has a relative import"
            found.add(node.module)
    return found


def test_all_of_it_is_not_too_much():
    assert sum(len(path.read_text().splitlines()) for path in MODULES) <= IN_ALL


def test_folders_can_be_taken_in_at_a_glance():
    assert {room(path) for path in MODULES} == set(FLOORS)
    for place in {path.parent for path in MODULES}:
        assert len([p for p in place.glob("*.py") if p.name != "__init__.py"]) <= IN_A_FOLDER


@each
def test_imports_go_down(path):
    """Of folders of one floor none sees another, and nobody sees the tests."""
    for name in imported(path):
        first = name.split(".")[0]
        assert first not in TESTS - set(FLOORS), f"{path.name} imports {name}"
        if first in FLOORS and first != room(path):
            assert FLOORS[first] < FLOORS[room(path)], f"{path.name} imports {name}"


@each
def test_sizes(path):
    """Modules of at most 400 lines, functions of at most 60, and each module says what it is."""
    source = path.read_text()
    assert len(source.splitlines()) <= LINES
    module = ast.parse(source)
    assert ast.get_docstring(module)
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef):
            assert (node.end_lineno or 0) - node.lineno < STEPS, node.name
