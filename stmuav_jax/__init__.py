"""Differentiable simulation of a UAV that carries a parallel-mechanism solar tracker.

Conventions (frames, Euler parameters, signs, units): docs/conventions.md.

Public names are listed in `__init__.pyi` and imported when they are first used: the command line
answers `--help` without loading JAX.
"""

import ast
from importlib import import_module
from pathlib import Path

__version__ = "0.1.0"


def _public_names() -> dict[str, tuple[str, str]]:
    """Module and name there of every public name, from the imports of the stub."""
    found = {}
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                found[alias.asname or alias.name] = (f".{node.module}", alias.name)
    return found


_NAMES = _public_names()
_FOLDERS = {module.split(".")[1] for module, _ in _NAMES.values()}

__all__ = list(_NAMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name in _NAMES:
        module, there = _NAMES[name]
        value = getattr(import_module(module, __name__), there)
        globals()[name] = value
        return value
    if name in _FOLDERS:
        return import_module(f".{name}", __name__)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
