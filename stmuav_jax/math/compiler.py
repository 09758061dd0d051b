"""Compiled programs: options for XLA, and a bound on the number that a process keeps.

JAX keeps every program that it compiles. On Linux each takes some hundred memory maps, and by
default the kernel allows a process 65,530; a process that needs more ends with a segmentation
fault. This package compiles its programs for systems of new structure by `kept_jit`, which keeps
the most recently used programs and releases the others.
"""

import contextlib
import itertools
import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.export
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state

from ..math import exported
from .native import llvm
from .native.program import is_native, is_on, targets_in
from .native.structure import Structure, choose_structure, find_structure, rely_on

Options = dict[str, str | bool | int | float]

# XLA's CPU compiler hands sums of products above some size to a library meant for large
# single-precision matrices. The sums of this package are over three to thirteen terms, many at
# once.
_NO_LIBRARY: Options = {"xla_cpu_experimental_ynn_fusion_type": ""}

# These options shorten compilation (a first `simulate` of uav_tracker: 10.9 instead of 13.5 s of CPU
# time) and leave a run as it is where LLVM compiles its equations. What XLA compiles runs longer: a
# simulation by 12 to 16 %, a batch half as long again or twice as long.
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
        quick: add options that shorten compilation and slow batches by XLA down, for programs
            that run for less time than they take to compile; `simulate` uses them.
    """
    if jax.default_backend() != "cpu":
        return {}
    # Options are tried before they are used, as an unknown one is an error of XLA and its versions
    # differ.
    options = _NO_LIBRARY | (_QUICK if quick else {})
    # all options at once first: every process waits for this test
    if _accepts_options(options):
        return options
    return {name: value for name, value in options.items() if _accepts_options({name: value})}


def _accepts_options(options: Options) -> bool:
    """Test whether this version of XLA accepts all of these options."""
    try:
        jax.jit(jnp.cos, compiler_options=dict(options)).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def outer_jit(function: Callable[..., Any]) -> Any:
    """`eqx.filter_jit` with `compiler_options`, for the outermost function of a program."""
    return _jit_with_options(function, quick=False)


def quick_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """`outer_jit` with `compiler_options(quick=True)`, for single flights and their gradients.

    XLA compiles in less time, and what machine code computes runs as fast; batches that XLA computes itself
    run more slowly. Within a transformation (`jit`, `grad`, `vmap`) it is `eqx.filter_jit(function)`, a part of a
    larger program.
    """
    return _jit_with_options(function, quick=True)


def _jit_with_options(function: Callable[..., Any], *, quick: bool) -> Callable[..., Any]:
    # Within a transformation the function is part of a larger program, whose options are those of the
    # outermost call.
    nested: Any = eqx.filter_jit(function)

    @cache
    def make_outermost(options: tuple[tuple[str, Any], ...], structure: Structure | None) -> Any:
        of = function if structure is None else rely_on(function, structure)
        return eqx.filter_jit(of, compiler_options=dict(options))  # pyright: ignore[reportCallIssue]

    first: dict[Any, Structure] = {}

    def outermost(args: Any) -> Any:
        options = tuple(compiler_options(quick=quick).items())
        if not is_on():
            return make_outermost(options, None)
        structure = find_structure(args)
        sizes = tuple((place, len(codes)) for place, codes in structure)
        form = jax.tree.structure(args), sizes
        return make_outermost(options, choose_structure(first, form, structure))

    @wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        _check_process()
        if is_transformed((args, keywords)):
            return nested(*args, **keywords)
        if quick and not keywords and _Command.programs is not None:
            # found before it is traced, if the same command has run before
            return cached_program(function, *args)(*args)
        return outermost((args, keywords))(*args, **keywords)

    call.lower = lambda *args, **keywords: outermost((args, keywords)).lower(*args, **keywords)  # pyright: ignore
    return call


_programs: OrderedDict[tuple[Any, Any, Structure], Callable[..., Any]] = OrderedDict()
# structure of the first program of a function and form of arguments
_structures: dict[Hashable, Structure] = {}
_lock = threading.Lock()


_processes: list[int] = []


def _check_process() -> None:
    """Refuse to compute in a fork of a process that has computed: without JAX's threads it would wait forever."""
    process = os.getpid()
    if not _processes:
        _processes.append(process)
    if _processes[0] != process:
        raise RuntimeError(
            f"This process ({process}) was forked from one in which JAX had already computed "
            f"({_processes[0]}), whose threads a fork does not have, so it would wait forever; start processes "
            "by multiprocessing.get_context('spawn') or 'forkserver'."
        )


def _argument_form(args: Any) -> tuple[Hashable, ...]:
    """Structure of arguments, kinds of their leaves and settings of JAX, on which a program depends."""
    leaves, structure = jax.tree.flatten(args)
    # JAX puts arrays there whose device it chooses itself
    default: Any = {jax.config.jax_default_device or jax.devices()[0]}  # pyright: ignore[reportAttributeAccessIssue]
    return structure, _read_setting(), tuple(_leaf_key(leaf, default) for leaf in leaves)


def _read_setting() -> tuple[Hashable, ...]:
    """Settings of JAX on which a program depends.

    A program compiled in one precision must not be found in the other, though its arguments have the same
    shapes.
    """
    config: Any = jax.config
    return config.jax_enable_x64, config.jax_default_device, is_on()


def kept_jit(function: Callable[..., Any], *, optimised: bool = False) -> Callable[..., Any]:
    """`eqx.filter_jit` of a function of arrays and structure, with a bounded number of programs.

    Programs are kept by function, structure, and shapes of the arguments, at most `MOST_PROGRAMS`
    of all functions together; the least recently used are released. Within a transformation
    (`jit`, `grad`, `vmap`) the function is a part of a larger program.

    Args:
        function: function of positional arguments; arrays are traced, all else must be hashable.
        optimised: see `cached_program`.
    """
    # Machine code is a single operation already; JAX would keep the program around it as long as the function.
    within: Any = function if is_native(function) else eqx.filter_jit(function)

    @wraps(function)
    def call(*args: Any) -> Any:
        if is_transformed(args):
            return within(*args)
        return cached_program(function, *args, optimised=optimised)(*args)

    return call


def in_blocks(function: Callable[..., Any], size: int, *arguments: Any) -> Any:
    """Results of a function for k >= 1 rows, as NumPy arrays stacked along the first axis.

    The function is called with blocks of `size` rows, so that it is compiled once; copies of the
    last row fill up the last block.

    Args:
        function: function of pytrees with `size` rows.
        arguments: pytrees with k rows.
    """
    count, blocks = len(jax.tree.leaves(arguments)[0]), []
    for start in range(0, count, size):
        # Copies of the last row fill the last block up: they cost no more than an idle part of the block.
        pick = np.minimum(np.arange(start, start + size), count - 1)
        block = function(*jax.tree.map(lambda x, pick=pick: np.asarray(x)[pick], arguments))
        keep = min(size, count - start)
        blocks.append(jax.tree.map(lambda x, keep=keep: np.asarray(x)[:keep], block))
    return jax.tree.map(lambda *x: np.concatenate(x), *blocks)


def cached_program(
    function: Callable[..., Any], *args: Any, optimised: bool = True
) -> Callable[..., Any]:
    """Compiled program of a function for arguments of this structure, kept for later calls.

    The program accepts arguments of the same structure, shapes and data types. It is compiled with
    the quick options of `compiler_options`; `kept_jit` describes which programs are kept. Under
    `jax.disable_jit` it is the function itself.

    Args:
        optimised: machine code is optimised, for equations that are evaluated thousands of times; without, it
            takes less time to compile and more to run, and has the same bits.
    """
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return function
    _check_process()
    form, structure = _argument_form(args), find_structure(args)
    with _lock:
        structure = choose_structure(_structures, (function, form), structure)
        key = (function, form, structure)
        entry = _programs.get(key)
        if entry is not None:
            _programs.move_to_end(key)
            return entry
    # A process that runs out of memory maps dies without a message; the warning comes while there is
    # still time.
    check_maps()
    # Compiled outside of the lock, so that threads with other programs do not wait; the same program
    # compiled twice does no harm.
    context = contextlib.nullcontext() if optimised else llvm.without_optimisation()
    with context:
        compiled = compile_for_shapes(function, *args, quick=True, structure=structure)
    with _lock:
        _programs[key] = compiled
        while len(_programs) > MOST_PROGRAMS:
            (function, form, structure), _ = _programs.popitem(last=False)
            if not any(key[:2] == (function, form) for key in _programs):
                _structures.pop((function, form), None)
    return compiled


def compile_for_shapes(
    function: Callable[..., Any], *args: Any, quick: bool = False, structure: Structure = ()
) -> Callable[..., Any]:
    """Compiled program of a function for arrays of these shapes, which this module does not keep.

    Args:
        function: function of positional arguments; under `jax.disable_jit` it is returned itself.
        args: pytrees, which may have a `jax.ShapeDtypeStruct` in the place of an array; the program
            accepts the same pytrees with arrays.
        quick: compile with the quick options of `compiler_options`.
        structure: entries of the arguments' arrays on which the program relies, see `find_structure`.
    """
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return function
    leaves, tree = jax.tree.flatten(args)
    # Only arrays become arguments of the program; everything else is structure and is compiled in.
    places = [k for k, leaf in enumerate(leaves) if _is_array_or_shape(leaf)]
    result_places: list[Any] = []
    name = getattr(function, "__name__", "run")
    function = rely_on(function, structure) if structure else function

    def run_arrays(arrays: list[Any]) -> list[Any]:
        filled = list(leaves)
        for k, array in zip(places, arrays, strict=True):
            filled[k] = array
        outputs, form = jax.tree.flatten(function(*jax.tree.unflatten(tree, filled)))
        count = itertools.count()
        marked = [exported.Place(next(count)) if eqx.is_array(x) else x for x in outputs]
        result_places[:] = [jax.tree.unflatten(form, marked)]
        return [x for x in outputs if eqx.is_array(x)]

    run_arrays.__name__ = run_arrays.__qualname__ = name
    options, arrays = compiler_options(quick=quick), [leaves[k] for k in places]
    outermost, result = run_arrays, None
    programs = _Command.programs
    if programs is not None:
        about = [sorted(options.items()), [(place, codes.hex()) for place, codes in structure]]
        if key := programs.next_key(name, args, about):
            outermost, result = programs.load(key) or _export_program(
                programs, key, run_arrays, arrays, result_places
            )
    compiled = jax.jit(outermost, compiler_options=options).lower(arrays).compile()
    result = result_places[0] if result is None else result

    def call(*args: Any) -> Any:
        arguments = jax.tree.leaves(args)
        outputs = jax.block_until_ready(compiled([arguments[k] for k in places]))
        put = lambda x: outputs[x] if isinstance(x, exported.Place) else x
        return jax.tree.map(put, result)

    return call


class _Command:
    """Kept programs of the command that this process runs; None in any other process."""

    programs: exported.Programs | None = None


def keep_command_programs(programs: exported.Programs | None) -> None:
    """Let this process, which runs one command and nothing else, keep the command's programs."""
    _Command.programs = programs


def _export_program(
    programs: exported.Programs, key: str, run: Callable[..., Any], arrays: list[Any],
    result_places: list[Any],
) -> tuple[Callable[..., Any], Any]:  # fmt: skip
    """Program to be compiled, kept if it can be, and the places of its result if they are known."""
    try:
        jitted = jax.jit(run)
        names = targets_in(jitted.trace(arrays).jaxpr.jaxpr) if is_on() else ()
        checks = [jax.export.DisabledSafetyCheck.custom_call(name) for name in names]
        program = jax.export.export(jitted, disabled_checks=checks)(arrays)
    # it calls back into Python, for example; an error of the function itself comes again without export
    except Exception:
        return run, None
    programs.store(key, program, result_places[0])
    return program.call, result_places[0]


def _is_array_or_shape(leaf: Any) -> bool:
    """Test whether a leaf is an array or the shape of one, and so an argument of a program."""
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _leaf_key(leaf: Any, default: set[Any]) -> Hashable:
    """Key of an argument's leaf: shape, data type and device (unless default) of an array, any other leaf itself."""
    if not eqx.is_array(leaf):
        return type(leaf), leaf
    where = leaf.sharding if getattr(leaf, "committed", False) else None
    where = None if where is None or where.device_set == default else where
    return leaf.shape, str(leaf.dtype), getattr(leaf, "weak_type", False), where


def is_transformed(args: Any) -> bool:
    """Test whether JAX is transforming the caller or one of the arguments."""
    tracers = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(args))
    return tracers or get_opaque_trace_state() != _NO_TRANSFORMATION


def compute_untraced(function: Callable[..., Any], *args: Any) -> Any:
    """Result of a function of known numbers, also where a program that needs it is being traced.

    There it runs in a thread of its own, which no trace reaches: `jax.ensure_compile_time_eval` would
    compile each of the operations alone, also those of programs that are compiled within.
    """
    if not is_transformed(args):
        return function(*args)
    x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]

    def compute_values() -> Any:
        with jax.enable_x64(x64):
            return function(*args)

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(compute_values).result()


# Results of `remember_results`, and how many are kept.
_results: OrderedDict[Hashable, tuple[Any, Any]] = OrderedDict()
MOST_RESULTS = 32


def remember_results(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function whose last results are returned again for the same arrays, structure and numbers.

    JAX's arrays do not change, so they are compared by identity. Arguments with other arrays, which may
    change, and calls within a transformation are computed each time.
    """

    @wraps(function)
    def call(*args: Any) -> Any:
        leaves, structure = jax.tree.flatten(args)
        is_fixed = all(isinstance(x, jax.Array | float | int) or callable(x) for x in leaves)
        if not is_fixed or is_transformed(args):
            return function(*args)
        keys = tuple(id(x) if isinstance(x, jax.Array) else (type(x), x) for x in leaves)
        key = (function, structure, _read_setting(), keys)
        with _lock:
            if entry := _results.get(key):
                _results.move_to_end(key)
                return entry[1]
        result = function(*args)
        with _lock:
            # The leaves are kept with the result, so that no later array has the identity of one of them.
            _results[key] = leaves, result
            while len(_results) > MOST_RESULTS:
                _results.popitem(last=False)
        return result

    return call


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
