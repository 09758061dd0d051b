"""Programs of a command that are kept in a folder, so that the same command does not trace them again.

JAX's own cache finds a program only after tracing. Here the n-th program of a command is found by plain
data: the command's words, its files' content, the digest of the package's sources, versions, settings of
JAX, and the program's number, name, structure and shapes. The library itself keeps nothing.

A file holds a program as `jax.export` serialises it, and as JSON where its result has arrays. It is
read as data: no code of it runs in Python, and only classes of `_PACKAGES` are made. Beside it stands the
object code of the equations that it calls, in a folder that nobody else may write to.
"""

import base64
import contextlib
import hashlib
import importlib.metadata
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax import export
from jaxlib import lapack

from ..checks.sources import source_digest
from .native import llvm
from .native.program import is_on

# Bytes that the files of a folder may take together; the ones used longest ago go first.
MOST_BYTES = 50_000_000

_PACKAGES = ("stmuav_jax", "diffrax", "equinox", "optimistix", "lineax")
_SUFFIX = ".program"
_ADDRESS = re.compile(r" at 0x[0-9a-f]+|\b0x[0-9a-f]{6,}\b")

Call = Callable[..., Any]


class Place(int):
    """Place of an array in a list, which stands for it in the pytree of a program's result."""


class Programs:
    """Programs of one command, in the order in which it asks for them.

    Args:
        folder: folder that nobody else may write to.
        command: plain data for JSON of all on which the command's programs may depend.

    Raises:
        SettingError: the package's sources were changed after this process imported them.
    """

    def __init__(self, folder: Path, command: Mapping[str, Any]) -> None:
        self.folder = folder
        self.count = 0
        # Settings of JAX change what a program is; only places of caches do not.
        ambient = {
            name: value
            for name, value in os.environ.items()
            if name.startswith(("JAX_", "XLA_", "EQX_")) and "CACHE" not in name
        }
        devices = [f"{device} {device.device_kind}" for device in jax.devices()]
        packages = ("jax", "jaxlib", "numpy", *_PACKAGES[1:])
        versions = {name: importlib.metadata.version(name) for name in packages}
        versions |= {"python": sys.version, "devices": devices}
        code = llvm.describe_target() if is_on() else ()
        about = [dict(command), source_digest(), versions, ambient, code]
        self._about = json.dumps(about, sort_keys=True)

    def next_key(self, name: str, arguments: Any, options: Any) -> str | None:
        """Key of the command's next program; None for arrays on any but the first device."""
        self.count += 1
        leaves, structure = jax.tree.flatten(arguments)
        if any(
            leaf.devices() != {jax.devices()[0]} for leaf in leaves if isinstance(leaf, jax.Array)
        ):
            return None
        # Arrays enter by their shape alone, and other leaves by value: they are constants in a program.
        forms = [
            [list(x.shape), str(x.dtype)] if hasattr(x, "shape") else _static_text(x)
            for x in leaves
        ]
        described = [self.count, name, _static_text(structure), forms, options]
        return hashlib.sha256((self._about + json.dumps(described)).encode()).hexdigest()

    def load(self, key: str) -> tuple[Call, Any] | None:
        """Program of a key and the pytree of its result's places; None if there is none."""
        path = self.folder / (key + _SUFFIX)
        try:
            head, content = path.read_bytes().split(b"\n", 1)
            about = json.loads(head)
            if about["key"] != key or about["sha256"] != hashlib.sha256(content).hexdigest():
                return None
            for name, code in about["code"].items():
                llvm.load(name, base64.b64decode(code))
            program = export.deserialize(bytearray(content))
            result = _decode_tree(about["result"])
            # The time of the file is that of its last use, by which old programs are removed.
            os.utime(path)
        # whatever is wrong with a file: its program is made anew, and replaces it
        except Exception:
            return None
        # lowering does this otherwise; without it a call of LAPACK ends the process
        lapack.prepare_lapack_call("getrf_ffi", np.dtype(float))
        return program.call, result

    def store(self, key: str, program: export.Exported, result: Any) -> None:
        """Keep a program with its result's pytree of places; nothing happens if that is not possible."""
        # not all trees have a text, and not all programs can be serialised
        with contextlib.suppress(Exception):
            content = bytes(program.serialize())
            about: dict[str, Any] = {"key": key, "sha256": hashlib.sha256(content).hexdigest()}
            about["result"] = _encode_tree(result)
            text = program.mlir_module() if llvm.objects else ""
            names = set(re.findall(r"stmuav_[0-9a-f]{40}", text))
            code = {name: base64.b64encode(llvm.objects[name]).decode() for name in names}
            about["code"] = code
            # sources that were changed meanwhile may be what was traced
            source_digest()
            self.folder.mkdir(mode=0o700, exist_ok=True)
            # Written beside and then renamed: another process never reads half a file.
            handle, partial = tempfile.mkstemp(dir=self.folder)
            with os.fdopen(handle, "wb") as file:
                file.write(json.dumps(about).encode() + b"\n" + content)
            os.replace(partial, self.folder / (key + _SUFFIX))
            self._trim_folder()

    def _trim_folder(self) -> None:
        stats = [(path.stat(), path) for path in self.folder.iterdir()]
        total = 0
        for stat, path in sorted(stats, key=lambda entry: -entry[0].st_mtime):
            total += stat.st_size
            if total > MOST_BYTES:
                path.unlink()


def _static_text(described: Any) -> str:
    """Text of a static value without the addresses of this process."""
    return _ADDRESS.sub("", repr(described))


def _encode_tree(tree: Any) -> Any:
    """Tree of places, plain values and classes as JSON; `TypeError` for anything else."""
    if isinstance(tree, Place):
        return {"place": int(tree)}
    if tree is None or isinstance(tree, bool | int | float | str):
        return {"value": tree}
    if isinstance(tree, type):
        return {"class": _class_name(tree)}
    if type(tree) is dict and all(isinstance(name, str) for name in tree):
        return {"dict": {name: _encode_tree(part) for name, part in tree.items()}}
    if type(tree) is list:
        return {"list": [_encode_tree(part) for part in tree]}
    if isinstance(tree, tuple):
        name = "" if type(tree) is tuple else _class_name(type(tree))
        return {"tuple": name, "parts": [_encode_tree(part) for part in tree]}
    if not isinstance(tree, eqx.Module):
        raise TypeError(type(tree))
    parts = {name: _encode_tree(value) for name, value in vars(tree).items()}
    return {"module": _class_name(type(tree)), "parts": parts}


def _decode_tree(encoded: Mapping[str, Any]) -> Any:
    """Tree that `_encode_tree` has made JSON of."""
    if "place" in encoded:
        return Place(encoded["place"])
    if "value" in encoded:
        return encoded["value"]
    if "class" in encoded:
        return _class_named(encoded["class"])
    if "dict" in encoded:
        return {name: _decode_tree(part) for name, part in encoded["dict"].items()}
    if "list" in encoded:
        return [_decode_tree(part) for part in encoded["list"]]
    if "tuple" in encoded:
        parts = map(_decode_tree, encoded["parts"])
        return _class_named(encoded["tuple"])(*parts) if encoded["tuple"] else tuple(parts)
    module = object.__new__(_class_named(encoded["module"]))
    for name, part in encoded["parts"].items():
        object.__setattr__(module, name, _decode_tree(part))
    return module


def _class_name(kind: type) -> str:
    name = f"{kind.__module__}:{kind.__qualname__}"
    if _class_named(name) is not kind:
        raise TypeError(name)
    return name


def _class_named(name: str) -> type:
    module, qualname = name.split(":")
    if module.partition(".")[0] not in _PACKAGES or not isinstance(
        kind := getattr(importlib.import_module(module), qualname), type
    ):
        raise TypeError(name)
    return kind
