"""Compiled programs kept in a folder, so that a later process neither traces nor compiles them.

JAX's own cache saves the compiling only: a program has to be traced and lowered before JAX can look
for it. Here a program is found by a text that describes all that it depends on: the function, the
structure, shapes and data types of its arguments, the package's source, versions, settings,
options of the compiler and the processor. Arguments without such a text, such as a user's own
function, and programs that call back into Python, are never kept.

The files hold pickles, which are safe only as long as nobody else can write them. A folder that
belongs to another user, or that others may write to, is therefore not used.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import os
import pickle
import platform
import re
import secrets
import stat
import sys
import tempfile
import types
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.experimental import serialize_executable
from jaxlib import lapack

# Bytes that the files of a folder may take together; the ones used longest ago go first.
MOST_BYTES = 300_000_000

# Packages whose functions and classes are described by their names, because the text has their
# versions; of this package it has the source.
_PACKAGES = (
    "stmuav_jax", "jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "optax", "numpy",
)  # fmt: skip
_OF_PYTHON = ("builtins", "operator", "functools", "math")

_SUFFIX = ".program"
_LAPACK = "lapack_"
_DIGEST = 32

Call = Callable[[list[Any]], list[Any]]


class _NoTextError(Exception):
    """Error of an object that no text describes in a way that other processes share."""


class ArrayIndex(int):
    """Place of an array in a list, which stands for it in a pytree without arrays."""


class _Keeping:
    folder: Path | None = None


def keep_programs(folder: Path | str | None) -> None:
    """Keep the compiled programs of this process in a folder, and use those that are there.

    The folder is made if it is missing. One that others may write to, or that is not the user's
    own, is not used; nor is one that cannot be written. None ends the keeping.
    """
    _Keeping.folder = None
    if folder is None:
        return
    if own_folder(Path(folder)):
        _Keeping.folder = Path(folder)


def keeps() -> Path | None:
    """Folder in which programs are kept, or None."""
    return _Keeping.folder


def own_folder(path: Path) -> bool:
    """True if a folder, which is made if it is missing, is the user's and nobody else may write to it."""
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        return _is_own(path)
    except OSError:
        return False


def _is_own(path: Path) -> bool:
    """Test whether a file or folder is the user's, and nobody else may write to it."""
    if not hasattr(os, "getuid"):
        return True
    found = path.stat()
    return found.st_uid == os.getuid() and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def key_of(function: Callable[..., Any], args: tuple[Any, ...], options: Any) -> str | None:
    """Name of a program among the kept ones; None if it cannot be kept, or none are.

    Args:
        function: function that is compiled. args: its arguments; of arrays only shapes and data
            types count. options: of the compiler.
    """
    if _Keeping.folder is None:
        return None
    try:
        text = _text((function, args, options))
    except (_NoTextError, RecursionError, ValueError):
        return None
    whole = repr((text, _platform(), settings()))
    return hashlib.sha256(whole.encode()).hexdigest()


def settings() -> list[tuple[str, str]]:
    """JAX's settings; those of its cache and of its messages make no difference to a program."""
    others = ("cache", "log", "traceback")
    values = {k: v for k, v in jax.config.values.items() if not any(x in k for x in others)}
    return sorted((name, repr(value)) for name, value in values.items())


def load(key: str | None) -> tuple[Call, Any] | None:
    """Kept program and the structure of its result; None if there is no sound one.

    Returns:
        function from a list of arrays to a list of arrays, and the pytree of the result with an
        `ArrayIndex` in the place of each array.
    """
    if key is None or _Keeping.folder is None:
        return None
    path = _Keeping.folder / (key + _SUFFIX)
    try:
        if not _is_own(path):
            return None
        content = path.read_bytes()
    except OSError:
        return None
    try:
        if hashlib.sha256(key.encode() + content[_DIGEST:]).digest() != content[:_DIGEST]:
            raise ValueError("damaged")
        count, calls, result, program = pickle.loads(content[_DIGEST:])
        if calls:
            # lowering does this otherwise; without it a call of LAPACK ends the process
            lapack.prepare_lapack_call("getrf_ffi", np.dtype(float))
        slots = [x for x in jax.tree.leaves(result) if isinstance(x, ArrayIndex)]
        trees = (jax.tree.structure((([0] * count,), {})), jax.tree.structure([0] * len(slots)))
        call = serialize_executable.deserialize_and_load(program, *trees)
    except Exception:
        # whatever is wrong with it: it is compiled again, and replaced
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return call, result


def new_name(name: str) -> str:
    """Name for a program that is to be kept, which JAX's own cache has never seen.

    XLA serialises a program that came out of that cache without its code: it can be loaded, but
    not run.
    """
    return f"{name}_{secrets.token_hex(8)}"


def store(key: str | None, lowered: Any, compiled: Any, count: int, result: Any) -> None:
    """Keep a compiled program; nothing happens if that is not possible.

    Args:
        lowered, compiled: the program, as `jax.jit(...).lower(...)` and its `compile()` return it.
        count: number of its arguments' arrays. result: as `load` returns it.
    """
    folder = _Keeping.folder
    if key is None or folder is None:
        return
    calls = set(re.findall(r"custom_call @(\w+)", lowered.as_text()))
    # addresses of other functions, such as callbacks into Python, are no other process's
    if not all(name.startswith(_LAPACK) for name in calls):
        return
    # JAX raises errors of many classes for programs that it cannot serialise
    with contextlib.suppress(Exception):
        program, *_ = serialize_executable.serialize(compiled)
        content = pickle.dumps((count, bool(calls), result, program))
        digest = hashlib.sha256(key.encode() + content).digest()
        _write(folder / (key + _SUFFIX), digest + content)
        _trim(folder)


def _write(path: Path, content: bytes) -> None:
    """Write a file that other processes see whole or not at all."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".new-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def _trim(folder: Path) -> None:
    """Remove the files used longest ago, until the rest is within the bound."""
    found = sorted(
        ((x.stat().st_mtime, x.stat().st_size, x) for x in folder.glob("*" + _SUFFIX)), reverse=True
    )
    total = 0
    for _, size, path in found:
        total += size
        if total > MOST_BYTES:
            with contextlib.suppress(OSError):
                path.unlink()


# --- texts


@functools.cache
def _platform() -> str:
    """Text of versions, source, processor and devices, all that programs depend on."""
    device = jax.devices()[0]
    environment = sorted(
        (name, value) for name, value in os.environ.items() if name.startswith(("XLA_", "EQX_"))
    )
    own = (sys.version, platform.platform(), _processor(), device.platform, device.device_kind)
    return repr((own, len(jax.devices()), _versions(), _source(), environment))


def _versions() -> list[tuple[str, str]]:
    found = []
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found.append((name, version(name)))
    return found


def _source() -> str:
    """Digest of this package's source."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


def _processor() -> tuple[str, ...]:
    """Name and instruction sets of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n", 1)[0].splitlines()
    except OSError:
        return (platform.machine(), platform.processor())
    wanted = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU ")
    return (platform.machine(), *(line for line in lines if line.startswith(wanted)))


def _text(x: Any, constant: bool = False) -> Any:
    """Nested tuples of texts that describe an object without its arrays' numbers.

    Args:
        constant: the numbers too, because they are part of the program: those of objects that JAX
            does not look into, such as static fields and what a function closes over.

    Raises:
        _NoTextError: the object, or a part of it, has no such text.
    """
    if x is None or isinstance(x, bool | int | float | complex | str | bytes) or x is Ellipsis:
        return type(x).__name__, repr(x)
    if isinstance(x, jax.Array):
        kind = (x.shape, str(x.dtype), getattr(x, "weak_type", False))
        return "array", kind, _digest(np.asarray(x)) if constant else ""
    if isinstance(x, jax.ShapeDtypeStruct) and x.sharding is None:
        return "shape", x.shape, str(x.dtype), getattr(x, "weak_type", False)
    if isinstance(x, np.ndarray | np.generic):
        return "numpy", x.shape, str(x.dtype), _digest(x)
    if isinstance(x, np.dtype):
        return "dtype", str(x)
    if isinstance(x, type):
        return "class", _name(x)
    if isinstance(x, enum.Enum):
        return _name(type(x)), x.name
    if isinstance(x, Mapping):
        own = constant or type(x) is not dict
        return _name(type(x)), tuple((_text(k, True), _text(v, own)) for k, v in x.items())
    if isinstance(x, tuple | list):
        own = constant or not (type(x) in (tuple, list) or hasattr(x, "_fields"))
        return _name(type(x)), tuple(_text(part, own) for part in x)
    if isinstance(x, frozenset | set):
        return _name(type(x)), tuple(sorted(repr(_text(part, True)) for part in x))
    return _text_of_call(x) or _text_of_fields(x, constant)


def _text_of_call(x: Any) -> Any:
    """Text of a function; None for other objects."""
    if isinstance(x, functools.partial):
        return "partial", _name(type(x)), _text((x.func, x.args, x.keywords), True)
    if isinstance(x, types.MethodType):
        return "method", _text((x.__func__, x.__self__), True)
    if isinstance(x, types.FunctionType):
        cells = tuple(cell.cell_contents for cell in x.__closure__ or ())
        own = (x.__code__, cells, x.__defaults__, x.__kwdefaults__)
        return "function", _name(x), _text(own, True)
    if isinstance(x, types.CodeType):
        # a function within a function has no name of its own; its code tells it from others
        parts = (x.co_code, x.co_consts, x.co_names, x.co_varnames, x.co_freevars)
        return "code", _text(parts, True)
    if isinstance(x, types.BuiltinFunctionType | np.ufunc):
        return "function", _name(x)
    if hasattr(x, "__wrapped__") and not isinstance(x, eqx.Module):
        return "wrapper", _name(type(x)), _text(x.__wrapped__, True)
    return None


def _text_of_fields(x: Any, constant: bool) -> Any:
    """Text of an instance of a dataclass."""
    if not dataclasses.is_dataclass(x):
        raise _NoTextError
    own = constant or not isinstance(x, eqx.Module)
    values = tuple(
        (field.name, _text(getattr(x, field.name), own or bool(field.metadata.get("static"))))
        for field in dataclasses.fields(x)
        if hasattr(x, field.name)
    )
    return _name(type(x)), values


def _digest(array: Any) -> str:
    if array.dtype.hasobject:
        raise _NoTextError
    return hashlib.sha256(array.tobytes()).hexdigest()


def _name(x: Any) -> str:
    """Name of a function or class of a package whose version or source is known."""
    module = getattr(x, "__module__", None) or "builtins"
    if module.partition(".")[0] not in (*_PACKAGES, *_OF_PYTHON):
        raise _NoTextError
    return f"{module}.{getattr(x, '__qualname__', None) or x.__name__}"
