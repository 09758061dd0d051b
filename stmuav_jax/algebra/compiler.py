"""Compiled programs: options for XLA, and a bound on the number that a process keeps.

JAX keeps every program that it compiles. On Linux each takes some hundred memory maps, and by
default the kernel allows a process 65,530; a process that needs more ends with a segmentation
fault. This package compiles its programs for systems of new structure by `kept_jit`, which keeps
the most recently used programs and releases the others.
"""

import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import cache, partial, wraps
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state

from ..checks.numbers import as_jax
from . import kept

Options = dict[str, str | bool | int | float]

# XLA's CPU compiler hands sums of products above some size to a library meant for large
# single-precision matrices. The sums of this package are over three to thirteen terms, many at
# once.
_NO_LIBRARY: Options = {"xla_cpu_experimental_ynn_fusion_type": ""}

# These options halve the time of compilation (one second of uav_tracker: 5.7 instead of 12.0 s of
# CPU time) and lengthen a single simulation by 12 to 16 %. A batch of simulations or a bank of
# filters would take half as long again or twice as long.
_QUICK: Options = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_llvm_disable_expensive_passes": True,
    "xla_backend_optimization_level": 1,
}

# Programs that `kept_jit` keeps: enough for some twelve structures of systems.
MOST_PROGRAMS = 48

# Fraction of the kernel's limit of memory maps above which `check_maps` warns.
_WARNING_SHARE = 0.5

_MAPS, _MOST_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")

with jax.ensure_compile_time_eval():
    _NO_TRANSFORMATION = get_opaque_trace_state()


@cache
def compiler_options(*, quick: bool = False) -> Options:
    """Options of XLA for `jax.jit(..., compiler_options=...)` of the outermost function.

    On a CPU they make a batch of right-hand sides faster and leave a single one unchanged. The
    dictionary is empty on other devices and omits options that this version of XLA does not know. A
    program of your own uses `outer_jit`, or sets
    XLA_FLAGS=--xla_cpu_experimental_ynn_fusion_type= before JAX is imported. `eqx.filter_jit`
    accepts the same argument.

    Args:
        quick: add options that halve the time of compilation and slow batches down, for programs
            that run for less time than they take to compile; `simulate` uses them.
    """
    if jax.default_backend() != "cpu":
        return {}
    options = _NO_LIBRARY | (_QUICK if quick else {})
    # all options at once first: every process waits for this test
    if _known(options):
        return options
    return {name: value for name, value in options.items() if _known({name: value})}


def _known(options: Options) -> bool:
    """Test whether this version of XLA accepts all of these options."""
    try:
        jax.jit(jnp.cos, compiler_options=dict(options)).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def outer_jit(function: Callable[..., Any]) -> Any:
    """`eqx.filter_jit` with `compiler_options`, for the outermost function of a program.

    Where programs are kept for later processes (`keep_programs`), this one is too.
    """
    return _stored_jit(function, quick=False)


def quick_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """`outer_jit` with `compiler_options(quick=True)`, which are looked up at every call.

    Within a transformation (`jit`, `grad`, `vmap`) it is `eqx.filter_jit(function)`, a part of a
    larger program.

    Args:
        function: function of positional arguments.
    """
    return _stored_jit(function, quick=True)


def _stored_jit(function: Callable[..., Any], *, quick: bool) -> Callable[..., Any]:
    within: Any = eqx.filter_jit(function)

    @cache
    def made_with(options: tuple[tuple[str, Any], ...]) -> Any:
        return eqx.filter_jit(function, compiler_options=dict(options))  # pyright: ignore[reportCallIssue]

    def made() -> Any:
        return made_with(tuple(compiler_options(quick=quick).items()))

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        if transformed((args, named)):
            return within(*args, **named)
        if named:
            return made()(*args, **named)
        # NumPy's arrays are arguments here, while kept programs take those of JAX only
        given = jax.tree.map(lambda x: as_jax(x) if isinstance(x, np.ndarray) else x, args)
        key = _key_once(function, given, quick)
        return made()(*args) if key is None else _by_key(key, function, given, quick)(*given)

    call.lower = lambda *args, **named: made().lower(*args, **named)  # pyright: ignore
    return call


def _asked(quick: bool) -> Options:
    """Options that are asked for, by which kept programs are found without a test of XLA."""
    return _NO_LIBRARY | (_QUICK if quick else {})


_programs: OrderedDict[Hashable, Callable[..., Any]] = OrderedDict()
_keys: OrderedDict[Hashable, str | None] = OrderedDict()
_lock = threading.Lock()


def _key_once(function: Callable[..., Any], args: tuple[Any, ...], quick: bool) -> str | None:
    """Key of a kept program; its text is made once for arguments of the same form."""
    if not kept.keeps():
        return None
    options = _asked(quick)
    brief = (function, quick, kept.keeps(), tuple(kept.settings()), *_form(args))
    try:
        if brief in _keys:
            return _keys[brief]
    except TypeError:
        # what cannot be hashed may still have a text
        return kept.key_of(function, args, options)
    key = kept.key_of(function, args, options)
    with _lock:
        _keys[brief] = key
        while len(_keys) > 4 * MOST_PROGRAMS:
            _keys.popitem(last=False)
    return key


def _form(args: Any) -> tuple[Hashable, ...]:
    """Structure of arguments, kinds of their leaves and settings of JAX, on which a program depends."""
    leaves, structure = jax.tree.flatten(args)
    setting = (jax.config.jax_enable_x64, jax.config.jax_default_device)  # pyright: ignore[reportAttributeAccessIssue]
    return structure, setting, tuple(map(_kind, leaves))


def kept_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """`eqx.filter_jit` of a function of arrays and structure, with a bounded number of programs.

    Programs are kept by function, structure, and shapes of the arguments, at most `MOST_PROGRAMS`
    of all functions together; the least recently used are released. Within a transformation
    (`jit`, `grad`, `vmap`) it is `eqx.filter_jit(function)`, a part of a larger program.

    Args:
        function: function of positional arguments; arrays are traced, all else must be hashable.
    """
    within: Any = eqx.filter_jit(function)

    @wraps(function)
    def call(*args: Any) -> Any:
        if transformed(args):
            return within(*args)
        return program(function, *args)(*args)

    return call


def in_blocks(function: Callable[..., Any], size: int, *arguments: Any) -> Any:
    """Results of a function for k >= 1 rows, as NumPy arrays stacked along the first axis.

    The function is called with blocks of `size` rows, so that it is compiled once; copies of the
    last row fill up the last block.

    Args:
        function: function of pytrees with `size` rows.
        arguments: pytrees with k rows.
    """
    count, found = len(jax.tree.leaves(arguments)[0]), []
    for start in range(0, count, size):
        pick = np.minimum(np.arange(start, start + size), count - 1)
        block = function(*jax.tree.map(lambda x, pick=pick: np.asarray(x)[pick], arguments))
        keep = min(size, count - start)
        found.append(jax.tree.map(lambda x, keep=keep: np.asarray(x)[:keep], block))
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


def program(function: Callable[..., Any], *args: Any) -> Callable[..., Any]:
    """Compiled program of a function for arguments of this structure, kept for later calls.

    The program accepts arguments of the same structure, shapes and data types. It is compiled with
    the quick options of `compiler_options`; `kept_jit` describes which programs are kept.
    """
    return _by_key((function, *_form(args)), function, args)


def program_of_shapes(
    function: Callable[..., Any], *args: Any, parts: tuple[Any, ...]
) -> Callable[..., Any]:
    """Compiled program of a function for arrays of these shapes, optimised as by `outer_jit`.

    Where programs are kept for later processes (`keep_programs`), this one is too.

    Args:
        function: function of positional arguments. args: pytrees, which may have a
            `jax.ShapeDtypeStruct` in the place of an array; the program accepts the same pytrees
            with arrays.
        parts: all numbers and structure that the function takes from elsewhere. A kept program is
            found by them and by the function's name, not by what the function holds.
    """
    name = f"{function.__module__}.{function.__qualname__}"
    key = kept.key_of(partial(_described, name, parts), args, _asked(quick=False))
    return _compiled(function, args, quick=False, key=key)


def _described(name: str, parts: tuple[Any, ...]) -> None:
    """Stand for a function of this name that depends on these parts."""


def _by_key(
    key: Hashable, function: Callable[..., Any], args: tuple[Any, ...], quick: bool = True
) -> Any:
    """Program of a key, compiled if there is none."""
    with _lock:
        found = _programs.get(key)
        if found is not None:
            _programs.move_to_end(key)
            return found
    check_maps()
    made = _compiled(function, args, quick, _key_once(function, args, quick))
    with _lock:
        _programs[key] = made
        while len(_programs) > MOST_PROGRAMS:
            _programs.popitem(last=False)
    return made


def _compiled(
    function: Callable[..., Any], args: tuple[Any, ...], quick: bool, key: str | None
) -> Callable[..., Any]:
    compiled, result = kept.load(key) or _compiled_now(function, args, key, quick)
    places = [k for k, leaf in enumerate(jax.tree.leaves(args)) if _is_given(leaf)]

    def call(*args: Any) -> Any:
        leaves = jax.tree.leaves(args)
        found = jax.block_until_ready(compiled([leaves[k] for k in places]))
        return jax.tree.map(lambda x: found[x] if isinstance(x, kept.ArrayIndex) else x, result)

    return call


def _compiled_now(
    function: Callable[..., Any], args: tuple[Any, ...], key: str | None, quick: bool
) -> tuple[Callable[[list[Any]], list[Any]], Any]:
    """Program of lists of arrays, and the result's pytree with an `ArrayIndex` for each of them."""
    leaves, structure = jax.tree.flatten(args)
    places = [k for k, leaf in enumerate(leaves) if _is_given(leaf)]
    arrays, result = [leaves[k] for k in places], []

    def run(arrays: list[Any]) -> list[Any]:
        given = list(leaves)
        for k, array in zip(places, arrays, strict=True):
            given[k] = array
        found, tree = jax.tree.flatten(function(*jax.tree.unflatten(structure, given)))
        numbers = [x for x in found if eqx.is_array(x)]
        count = iter(range(len(numbers)))
        marked = [kept.ArrayIndex(next(count)) if eqx.is_array(x) else x for x in found]
        result[:] = [jax.tree.unflatten(tree, marked)]
        return numbers

    name = getattr(function, "__name__", "run")
    run.__name__ = run.__qualname__ = name if key is None else kept.new_name(name)
    lowered = jax.jit(run, compiler_options=compiler_options(quick=quick)).lower(arrays)
    compiled = lowered.compile()
    kept.store(key, lowered, compiled, len(arrays), result[0])
    return compiled, result[0]


def _is_given(leaf: Any) -> bool:
    """Test whether a leaf is an array that the program is given, or the shape of one."""
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _kind(leaf: Any) -> Hashable:
    """Key of an argument's leaf: shape, data type and device of an array, any other leaf itself."""
    if not eqx.is_array(leaf):
        return type(leaf), leaf
    where = leaf.sharding if getattr(leaf, "committed", False) else None
    return leaf.shape, str(leaf.dtype), getattr(leaf, "weak_type", False), where


def transformed(args: Any) -> bool:
    """Test whether JAX is transforming the caller or one of the arguments."""
    tracers = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(args))
    return tracers or get_opaque_trace_state() != _NO_TRANSFORMATION


def memory_maps() -> tuple[int, int] | None:
    """Number of memory maps of this process and the kernel's limit; None if not available."""
    try:
        return _MAPS.read_bytes().count(b"\n"), int(_MOST_MAPS.read_text())
    except (OSError, ValueError):
        return None


_warned = threading.Event()


def check_maps() -> None:
    """Warn, once per process, if it has at least half of the memory maps that the kernel allows."""
    maps = memory_maps()
    if maps is None or maps[0] < _WARNING_SHARE * maps[1] or _warned.is_set():
        return
    _warned.set()
    warnings.warn(
        f"This process holds {maps[0]} memory maps of the {maps[1]} that the kernel allows "
        "(vm.max_map_count), most of them for programs that JAX has compiled and keeps; beyond the limit "
        "it ends with a segmentation fault. Put repeated work under jax.jit, make functions and systems "
        "once instead of in every pass of a loop, or call jax.clear_caches() now and then.",
        RuntimeWarning,
        stacklevel=3,
    )
