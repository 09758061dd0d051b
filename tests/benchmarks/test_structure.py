"""The benchmarks' folders: imports only go down and never into the tests."""

import ast
from pathlib import Path

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


def test_imports_go_down():
    """Of folders of one floor none sees another, and nobody sees the tests."""
    for path in MODULES:
        for name in imported(path):
            first = name.split(".")[0]
            assert first not in TESTS - set(FLOORS), f"{path.name} imports {name}"
            if first in FLOORS and first != room(path):
                assert FLOORS[first] < FLOORS[room(path)], f"{path.name} imports {name}"
