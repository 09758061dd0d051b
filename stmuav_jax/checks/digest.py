"""Digest of a function with all that it refers to, which identifies the function that a study evaluates."""

import dataclasses
import dis
import functools
import hashlib
import inspect
import itertools
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pydantic

from .errors import SettingError


def digest_value(value: Any) -> str:
    """Digest of a function or another value, with all that it refers to, from its source and its numbers.

    What belongs to this package or to an installed one enters by its name; its version is recorded apart.

    Raises:
        SettingError: a value whose content cannot be read, such as an open file.
    """
    digest = hashlib.sha256()
    _feed_value(digest.update, value, {})
    return digest.hexdigest()[:16]


def _feed_value(feed: Callable[[bytes], object], value: Any, visited: dict[int, Any]) -> None:
    """Feed the content of a value to a digest."""

    def feed_all(*values: Any) -> None:
        # A value may refer to itself, such as a function that calls itself; kept alive, so that no other has its id.
        visited[id(value)] = value
        for part in values:
            _feed_value(feed, part, visited)

    module = getattr(value, "__module__", None) or type(value).__module__
    feed(f"{type(value).__module__}.{type(value).__qualname__}\0".encode())
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | Path):
        feed(repr(value).encode())
    elif isinstance(value, types.ModuleType):
        feed(value.__name__.encode())
    elif (hasattr(value, "__qualname__") or hasattr(value, "__name__")) and _is_installed(module):
        feed(f"{module}.{getattr(value, '__qualname__', value.__name__)}".encode())
    elif id(value) in visited:
        return
    elif isinstance(value, Mapping):
        feed_all(*itertools.chain(*value.items()))
    elif isinstance(value, list | tuple):
        feed_all(len(value), *value)
    elif isinstance(value, set | frozenset):
        feed_all(*sorted(value, key=repr))
    elif isinstance(value, functools.partial):
        feed_all(value.func, value.args, value.keywords)
    elif isinstance(value, types.MethodType):
        feed_all(value.__func__, value.__self__)
    elif isinstance(value, types.FunctionType):
        feed_all(_source_text(value), value.__defaults__, value.__kwdefaults__)
        feed_all(*(cell.cell_contents for cell in value.__closure__ or ()))
        names = sorted(_names_in(value.__code__) & value.__globals__.keys())
        feed_all(*((name, value.__globals__[name]) for name in names))
    elif isinstance(value, type):
        parts = (
            getattr(x, "fget", None) or inspect.unwrap(getattr(x, "method", x))
            for x in vars(value).values()
        )
        feed_all(_source_text(value), *value.__bases__)
        methods = [part for part in parts if isinstance(part, types.FunctionType)]
        # those that a dataclass generates have no source and no content of their own
        feed_all(*(method for method in methods if method.__code__.co_filename != "<string>"))
    elif hasattr(value, "__wrapped__"):
        feed_all(value.__wrapped__)
    elif hasattr(value, "dtype") and hasattr(value, "__array__"):
        array = np.asarray(value)
        feed(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    elif isinstance(value, pydantic.BaseModel):
        feed_all(type(value), value.model_dump())
    elif dataclasses.is_dataclass(value):
        feed_all(
            type(value), *(getattr(value, field.name, None) for field in dataclasses.fields(value))
        )
    else:
        raise SettingError(
            f"The content of a value of type {module}.{type(value).__name__}, to which the function refers, "
            "cannot be read: give it as a number, an array or a dataclass of these, or state the identity."
        )


def _is_installed(module: str) -> bool:
    """Test whether a module belongs to this package, to Python or to an installed library."""
    root = module.partition(".")[0]
    if root == __name__.partition(".")[0] or root in sys.stdlib_module_names - {"__main__"}:
        return True
    file = getattr(sys.modules.get(root), "__file__", None)
    return file is not None and "-packages" in file


def _source_text(value: Any) -> str:
    try:
        return inspect.getsource(value)
    except (OSError, TypeError):
        raise SettingError(
            f"The source of {getattr(value, '__name__', value)} cannot be read: write it in a file or a notebook, "
            "or state the identity."
        ) from None


def _names_in(code: types.CodeType) -> set[str]:
    """Names of globals in a function's code, and in the functions that it makes.

    `co_names` would not do: it has names of attributes too, and `jnp.linalg.norm` does not refer to a global `norm`.
    """
    inner = (_names_in(part) for part in code.co_consts if isinstance(part, types.CodeType))
    loads = (x for x in dis.get_instructions(code) if x.opname in ("LOAD_GLOBAL", "LOAD_NAME"))
    return {load.argval for load in loads}.union(*inner)
