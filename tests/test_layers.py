"""The architecture, read from the source: floors, cycles, sizes, final classes, no set-up."""

import ast
from functools import cache
from pathlib import Path

import pytest

import stmuav_jax

ROOT = Path(stmuav_jax.__file__).parent
MODULES = sorted(ROOT.rglob("*.py"))
# A room is a folder, or a folder within one that has a floor of its own.
FLOORS = {
    "checks": 0,
    "algebra": 1,
    "estimation": 2,
    "mechanics": 2,
    "parameters": 2,
    "mechanics.forces": 3,
    "dynamics.formulations": 4,
    "dynamics.tree": 5,
    "dynamics.integration": 5,
    "dynamics.assembly": 6,
    "dynamics.statespace": 6,
    "dynamics": 7,
    "environment": 7,
    "rotorcraft": 7,
    "tracker": 8,
    "sensing": 8,
    "flight": 9,
    "quadrotor": 9,
    "scenes": 10,
    "control": 11,
    "montecarlo": 12,
    "files": 13,
    "figures": 14,
    "jobs": 14,
    "viewer": 14,
    "missions": 15,
    "commands": 16,
    "cli": 17,
}
LINES, STEPS, IN_A_ROOM = 400, 60, 15


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def dotted(path: Path) -> str:
    """a.b.c of a file; the package itself for its __init__."""
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {dotted(path): path for path in MODULES}


def imports(path: Path, *, runtime_only: bool = False) -> set[str]:
    """Modules of the package that a module imports, as dotted names."""
    package = dotted(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    skipped = _type_checking(tree(path)) if runtime_only else set()
    found: set[str] = set()
    for node in ast.walk(tree(path)):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name.split(".")[0] == ROOT.name}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            if source.split(".")[0] != ROOT.name:
                continue
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                found.add(inner if inner in NAMES else source)
    return found


def _type_checking(module: ast.Module) -> set[ast.AST]:
    """Everything under `if TYPE_CHECKING:`, which never runs."""
    blocks = [
        node
        for node in ast.walk(module)
        if isinstance(node, ast.If)
        and isinstance(node.test, ast.Name)
        and node.test.id == "TYPE_CHECKING"
    ]
    return {inner for block in blocks for child in block.body for inner in ast.walk(child)}


def room(name: str) -> str:
    """The room of a module: the deepest folder around it that has a floor."""
    parts = name.split(".")[1:]
    inside = [".".join(parts[:k]) for k in range(len(parts), 0, -1)]
    return next((place for place in inside if place in FLOORS), parts[0] if parts else "")


each = pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))


def test_the_reader_of_imports_sees_them():
    """The other tests could not fail if this one did not hold."""
    seen = imports(ROOT / "dynamics" / "formulations" / "augmented.py")
    assert "stmuav_jax.algebra.linalg" in seen
    assert "stmuav_jax.dynamics.formulations.constraints" in seen
    assert "stmuav_jax.mechanics.joint" in imports(ROOT / "mechanics" / "state.py")
    assert "stmuav_jax.mechanics.joint" not in imports(
        ROOT / "mechanics" / "state.py", runtime_only=True
    )
    assert {room(name) for name in NAMES} - {""} <= set(FLOORS)


@each
def test_imports_go_down(path):
    """A room sees those on floors below; rooms of one floor do not see each other."""
    mine = room(dotted(path))
    if mine in ("", "__main__"):
        return
    for name in imports(path):
        other = room(name)
        assert other != "", f"{dotted(path)} imports the package's root"
        fine = other == mine or FLOORS[other] < FLOORS[mine]
        assert fine, f"{dotted(path)} ({mine}) imports {name} ({other})"


def test_rooms_can_be_taken_in_at_a_glance():
    """No folder has many modules."""
    for place in {path.parent for path in MODULES}:
        count = len([path for path in place.glob("*.py") if path.name != "__init__.py"])
        assert count <= IN_A_ROOM, f"{place.relative_to(ROOT.parent)} has {count} modules"


def test_no_cycles():
    """Over all imports that run."""
    graph = {name: imports(path, runtime_only=True) & set(NAMES) for name, path in NAMES.items()}
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, "cycle: " + " -> ".join([*path[path.index(name) :], name])
        if name in done:
            return
        for other in graph[name] - {name}:
            visit(other, (*path, name))
        done.add(name)

    for name in graph:
        visit(name, ())


def documented(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of the docstring."""
    first = node.body[0]
    is_text = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    return first.end_lineno - first.lineno + 1 if is_text and first.end_lineno else 0


@each
def test_sizes(path):
    """Modules of at most 400 lines, functions of at most 60 without their docstring."""
    count = len(path.read_text().splitlines())
    assert count <= LINES, f"{count} lines"
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            length = node.end_lineno - node.lineno + 1 - documented(node)
            assert length <= STEPS, f"{node.name}: {length} lines"


@each
def test_no_global_configuration(path):
    """Only the command line decides on precision; importing the package changes nothing."""
    if path.name == "cli.py":
        return
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            called = ast.unparse(node.func)
            assert not called.endswith("config.update"), f"line {node.lineno}: {called}"


@each
def test_every_module_says_what_it_is(path):
    assert ast.get_docstring(tree(path))


# --- classes are abstract or final


def classes() -> dict[str, tuple[Path, ast.ClassDef]]:
    """All classes of the package by name, which `test_class_names_are_unique` makes a key."""
    nodes = [(path, node) for path in MODULES for node in ast.walk(tree(path))]
    return {node.name: (path, node) for path, node in nodes if isinstance(node, ast.ClassDef)}


def test_class_names_are_unique():
    """One word, one meaning: a second class of a name has to be called something else."""
    places: dict[str, list[str]] = {}
    for path in MODULES:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(f"{dotted(path)}:{node.lineno}")
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert not twice, twice
    assert len(places) > 300


def base_names(node: ast.ClassDef) -> list[str]:
    return [ast.unparse(base).split("[")[0].split(".")[-1] for base in node.bases]


def is_module(name: str, known: dict[str, tuple[Path, ast.ClassDef]]) -> bool:
    """Whether a class derives from eqx.Module, through classes of the package or diffrax."""
    if name == "Module" or (name.startswith("Abstract") and name not in known):
        return True
    return name in known and any(is_module(base, known) for base in base_names(known[name][1]))


def methods(node: ast.ClassDef) -> dict[str, bool]:
    """Method names, and whether each is abstract."""
    return {
        f.name: any("abstractmethod" in ast.unparse(d) for d in f.decorator_list)
        for f in node.body
        if isinstance(f, ast.FunctionDef)
    }


def test_classes_are_abstract_or_final():
    """A module class is subclassed only if its name says Abstract; concrete methods stay."""
    known = classes()
    checked = 0
    for name, (path, node) in known.items():
        if not is_module(name, known):
            continue
        checked += 1
        for base in base_names(node):
            if base not in known:
                continue
            assert base.startswith("Abstract"), f"{path.name}: {name} subclasses concrete {base}"
            concrete = {m for m, abstract in methods(known[base][1]).items() if not abstract}
            again = concrete & set(methods(node))
            assert not again, f"{path.name}: {name} overrides {sorted(again)} of {base}"
    assert checked > 20


def test_abstract_classes_are_named_so():
    for name, (path, node) in classes().items():
        if any(methods(node).values()):
            assert name.startswith("Abstract"), f"{path.name}: {name} has abstract methods"
