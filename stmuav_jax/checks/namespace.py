"""Public names of the package's folders, imported when they are first used.

Each folder's names stand in its `__init__.pyi`. A name that is misspelt, or that another folder has,
is answered with where it is.
"""

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import lazy_loader

_ROOT = Path(__file__).parent.parent


def attach_names(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a folder, from the `__init__.pyi` beside its file."""
    load, list_names, names = lazy_loader.attach_stub(package, file)

    def find_name(name: str) -> Any:
        if name in names or name.startswith("_"):
            return load(name)
        raise AttributeError(f"{package} has no '{name}'.{_suggest_name(name, names)}")

    return find_name, list_names, names


@cache
def _public_names() -> dict[str, str]:
    """Public names of the root and of each folder by their full dotted names, such as "files.load"."""
    stubs = [_ROOT / "__init__.pyi", *sorted(_ROOT.glob("*/__init__.pyi"))]
    return {
        f"{_ROOT.name}{'' if stub.parent == _ROOT else '.' + stub.parent.name}.{name}": name
        for stub in stubs
        for name in re.findall(r" as (\w+)", stub.read_text(encoding="utf-8"))
    }


def _suggest_name(name: str, names: list[str]) -> str:
    """Hint for a name that a folder lacks: the folder that has it, or the nearest name of any."""
    from .errors import closest_name  # imports JAX

    places = [full.rpartition(".")[0] for full, entry in _public_names().items() if entry == name]
    if places:
        return f" It is in {' and in '.join(places)}."
    if hint := closest_name(name, names):
        return hint
    closest = closest_name(name, _public_names().values()).removeprefix(" Did you mean '")[:-2]
    return next(
        (f" Did you mean {full}?" for full, entry in _public_names().items() if entry == closest),
        "",
    )
