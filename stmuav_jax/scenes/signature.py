"""Cases and options of a scene, read from the signature of the function that builds it.

The source is read without being run, as the command line names the options before JAX is there.
An option is a keyword-only argument whose annotation begins with what a text can give: a Literal,
float, int, bool, str, or a dataclass whose fields are made by `quantity`. So

    def swing(parameters=PART_I, *, length: float = 1.0, drag: Drag | None = None) -> Scene

has the options length and drag. Others, such as functions of time, are for Python alone.
"""

import ast
import re
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple, get_args, get_origin

from ..checks.quantity import quantities

_PLAIN: dict[str, type] = {"float": float, "int": int, "bool": bool, "str": str}


class SceneOption(NamedTuple):
    """One option of a scene.

    Attributes:
        name: of the argument. kind: a Literal, float, int, bool, str, or a dataclass of quantities.
        default: the argument's. words: from the docstring of the function.
    """

    name: str
    kind: Any
    default: Any
    words: str

    @property
    def is_group(self) -> bool:
        """True for an option with fields of its own."""
        return bool(quantities(self.kind))

    @property
    def choices(self) -> tuple[Any, ...]:
        """Values of a Literal; none of another kind."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()


class Signature(NamedTuple):
    """Cases, parameters and options of a scene's function.

    Attributes:
        cases: of its argument `case`, empty without one. default_case: of the argument.
        table: module and name of the default of its argument `parameters`.
        options: by name.
    """

    cases: tuple[int, ...]
    default_case: int | None
    table: tuple[str, str]
    options: Mapping[str, SceneOption]


@cache
def signature_of(module: str, function: str) -> Signature:
    """The signature of a function of a module that is not imported for it.

    Args:
        module: its dotted name.

    Raises:
        ImportError: there is no such module, or no such function in it.
    """
    tree = ast.parse(_source(module))
    found = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function]
    if not found:
        raise ImportError(f"Module {module} has no function {function}.")
    own = found[-1].args
    places = _places(tree, module)
    arguments = [*own.posonlyargs, *own.args]
    # defaults belong to the last of the arguments
    given = dict(zip(arguments[len(arguments) - len(own.defaults) :], own.defaults, strict=True))
    first = {each.arg: (each, given.get(each)) for each in arguments}
    cases, default_case = (), None
    if "case" in first:
        argument, default = first["case"]
        cases, default_case = get_args(_kind(argument.annotation, places)), _value(default)
    default = first["parameters"][1] if "parameters" in first else None
    table = places.get(default.id, ("", "")) if isinstance(default, ast.Name) else ("", "")
    words = _words(ast.get_docstring(found[-1]) or "", [each.arg for each in own.kwonlyargs])
    options = {}
    for argument, default in zip(own.kwonlyargs, own.kw_defaults, strict=True):
        kind = _kind(argument.annotation, places)
        if kind is not None:
            name = argument.arg
            options[name] = SceneOption(name, kind, _value(default), words.get(name, ""))
    return Signature(cases, default_case, table, options)


def _source(module: str) -> str:
    spec = find_spec(module)
    source = getattr(spec.loader, "get_source", None) if spec is not None else None
    text = source(module) if source is not None else None
    if text is None:
        raise ImportError(f"The source of module {module} cannot be read.")
    return text


def _places(tree: ast.Module, module: str) -> dict[str, tuple[str, str]]:
    """Module and name there of every name that a module imports or defines as a class."""
    package = module.split(".")[:-1]
    found = {n.name: (module, n.name) for n in tree.body if isinstance(n, ast.ClassDef)}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            found |= {alias.asname or alias.name: (source, alias.name) for alias in node.names}
    return found


def _kind(annotation: ast.expr | None, places: Mapping[str, tuple[str, str]]) -> Any:
    """The first type of an annotation, if a text can give its values; else None."""
    while isinstance(annotation, ast.BinOp):
        annotation = annotation.left
    if isinstance(annotation, ast.Subscript) and ast.unparse(annotation.value) == "Literal":
        values = _value(annotation.slice)
        return Literal[values if isinstance(values, tuple) else (values,)]  # pyright: ignore[reportInvalidTypeForm]
    if not isinstance(annotation, ast.Name):
        return None
    if annotation.id in _PLAIN:
        return _PLAIN[annotation.id]
    if annotation.id not in places:
        return None
    module, name = places[annotation.id]
    kind = getattr(import_module(module), name, None)
    return kind if isinstance(kind, type) and quantities(kind) else None


def _value(node: ast.expr | None) -> Any:
    """A constant of the source; None for anything else."""
    try:
        return ast.literal_eval(node) if node is not None else None
    except ValueError:
        return None


def _words(docstring: str, names: list[str]) -> dict[str, str]:
    """Text of a docstring's section `Args:` on each name."""
    section = docstring.partition("Args:")[2].partition("\n\n")[0]
    parts = re.split(rf"\b({'|'.join(names)}): ", " ".join(section.split())) if names else []
    return dict(zip(parts[1::2], (text.strip() for text in parts[2::2]), strict=True))
