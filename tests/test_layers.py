"""The architecture, read from the source: imports downward, no cycles, final classes, no set-up."""

import ast
import graphlib
from pathlib import Path

import stmuav_jax

ROOT = Path(stmuav_jax.__file__).parent
# Each folder may import those before it.
FOLDERS = [
    "checks", "math", "mechanics", "estimation", "dynamics", "analysis", "control", "uav", "io",
    "studies", "figures", "missions", "cli",
]  # fmt: skip
# `python -m stmuav_jax` starts the command line, and nothing imports it.
STARTER = ROOT / "__main__.py"
TREES = {path: ast.parse(path.read_text()) for path in sorted(set(ROOT.rglob("*.py")) - {STARTER})}


def dotted(path: Path) -> tuple[str, ...]:
    """Name of a module below the package; that of the folder for its __init__."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


MODULES = {dotted(path): path for path in TREES}


def imports(path: Path) -> set[tuple[str, ...]]:
    """Modules of the package that a module imports, but for those under `if TYPE_CHECKING:`."""
    package = path.relative_to(ROOT).parts[:-1]
    skipped = {
        inner
        for node in ast.walk(TREES[path])
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    modules = set()
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.ImportFrom) and node.level and node not in skipped:
            source = (*package[: len(package) - node.level + 1], *(node.module or "").split("."))
            source = tuple(filter(None, source))
            inner = {(*source, alias.name) for alias in node.names}
            modules |= {name if name in MODULES else source for name in inner}
    return modules


def test_the_reader_of_imports_sees_them():
    """The other tests could not fail if this one did not hold."""
    modules = imports(ROOT / "dynamics" / "formulations" / "augmented.py")
    assert ("math", "linalg") in modules
    assert ("dynamics", "formulations", "constraints") in modules
    assert ("mechanics", "joint") not in imports(ROOT / "mechanics" / "state.py")
    assert {name[0] for name in MODULES if name} == set(FOLDERS)


def test_imports_go_down():
    upward = []
    for path in TREES:
        folder = (dotted(path) or ("",))[0]
        for name in imports(path):
            # the root's names are those of the folders, and the command line shows its version
            if folder and name and FOLDERS.index(name[0]) > FOLDERS.index(folder):
                upward.append((str(path.relative_to(ROOT)), ".".join(name)))
    assert not upward


def test_no_cycles():
    graph = {name: imports(path) - {name, ()} for name, path in MODULES.items() if name}
    assert len(list(graphlib.TopologicalSorter(graph).static_order())) == len(graph)


def test_no_global_configuration():
    """Only the command line decides on precision; importing the package changes nothing."""
    for path, tree in TREES.items():
        calls = [ast.unparse(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)]
        assert path == ROOT / "cli" / "main.py" or not [c for c in calls if "config.update" in c], (
            path
        )


def test_every_module_says_what_it_is():
    assert not [path for path, tree in TREES.items() if not ast.get_docstring(tree)]


# --- classes are abstract or final


def classes() -> dict[str, tuple[Path, ast.ClassDef]]:
    """All classes by name; of two of one name the last, since names are unique in a namespace only."""
    nodes = [(path, node) for path, tree in TREES.items() for node in ast.walk(tree)]
    return {node.name: (path, node) for path, node in nodes if isinstance(node, ast.ClassDef)}


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
    modules = [name for name in known if is_module(name, known)]
    assert len(modules) > 20
    for name in modules:
        path, node = known[name]
        for base in set(base_names(node)) & set(known):
            assert base.startswith("Abstract"), f"{path.name}: {name} subclasses concrete {base}"
            concrete = {m for m, abstract in methods(known[base][1]).items() if not abstract}
            again = concrete & set(methods(node))
            assert not again, f"{path.name}: {name} overrides {sorted(again)} of {base}"


def test_abstract_classes_are_named_so():
    for name, (path, node) in classes().items():
        if any(methods(node).values()):
            assert name.startswith("Abstract"), f"{path.name}: {name} has abstract methods"
