"""JAX primitive whose definition is a function of small arrays, and whose lowering is machine code.

`native(function)` behaves as `eqx.filter_jit(function)` does within a larger program: it is traced
once for each structure of its arguments. On a CPU, where the function has a scalar program, XLA then
calls the machine code of it; everywhere else, and under transformations that are not known here, the
traced function itself is used. Its derivatives are programs of the same kind, made from the derivatives
of the traced function, so both modes and all orders exist.
"""

import math
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import cached_property, wraps
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core as jax_core
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import ad, batching, mlir, partial_eval
from jaxlib.mlir import ir
from jaxtyping import Array

from . import llvm
from .graph import NotScalarError, make_graph
from .transposition import transpose_graph

native_p = core.Primitive("native")
native_p.multiple_results = True

_DTYPES = {"float64": "f8", "bool": "b1", "int32": "i4", "int64": "i8"}


class Layout(NamedTuple):
    """Buffers in which machine code finds its operands.

    Attributes:
        packs: operands of each buffer; one alone has its own shape and type. places: buffer and first
            entry there, of every operand that is needed. buffers: kinds of the buffers.
    """

    packs: tuple[tuple[int, ...], ...]
    places: dict[int, tuple[int, int]]
    buffers: tuple[llvm.Buffer, ...]


class Program:
    """A traced function of arrays, its machine code, and its derivatives.

    Attributes:
        jaxpr: traced function, whose constants are known. groups: number of the argument to which each
            operand belongs. known_entries: entries of operands that machine code may rely on, those of the others
            NaN; None where there are none. See `structure`. inputs, outputs: shapes and types.
    """

    def __init__(
        self,
        jaxpr: Any,
        groups: Sequence[int] | None = None,
        known_entries: Sequence[np.ndarray | None] = (),
    ) -> None:
        self.jaxpr = jaxpr
        groups = groups or [0] * len(jaxpr.in_avals)
        self._begin(jaxpr.in_avals, jaxpr.out_avals, groups, known_entries)

    def _begin(self, inputs: Any, outputs: Any, groups: Sequence[int], known_entries: Any) -> None:
        self.inputs, self.outputs, self.known_entries = inputs, outputs, known_entries
        self.groups = tuple(groups)
        self._derived: dict[Any, Program] = {}
        self._lock = threading.RLock()
        self._graph: Any = None
        self._reason: str | None = None

    def evaluate(self, *args: Any) -> list[Any]:
        """The function itself."""
        return jax_core.eval_jaxpr(self.jaxpr.jaxpr, self.jaxpr.consts, *args)

    def graph(self) -> Any:
        """Scalar program and its outputs, or None where there is none."""
        with self._lock:
            # A program without a graph is tried once: its reason is remembered, since tracing the
            # attempt takes as long as a success.
            if self._graph is None and self._reason is None:
                try:
                    self._graph = self._make_graph()
                except NotScalarError as error:
                    self._reason = str(error)
            return self._graph

    def _make_graph(self) -> Any:
        return make_graph(self.jaxpr, llvm.MOST_NODES, self.known_entries)

    def write(
        self, shared: tuple[bool, ...], rows: int, loop: llvm.Loop | None = None
    ) -> llvm.Code:
        """Machine code for a batch of this size.

        Raises:
            NotScalarError: an operation has none.
        """
        graph: Any = self.graph()
        # fewer rows than a vector holds are done one by one
        layout, width = self.layout(shared, rows), llvm.vector_width()
        width = width if rows >= width else 1
        results = [llvm.Buffer(math.prod(a.shape), _DTYPES[str(a.dtype)]) for a in self.outputs]
        return llvm.write(graph[0], graph[1], layout.buffers, results, width, layout.places, loop)

    def layout(self, shared: tuple[bool, ...], rows: int) -> Layout:
        """Buffers of operands for a batch of this size; none of them is shared where it is 1."""
        make: Any = lambda: self._make_layout(shared, rows)
        layout: Any = self.derived(("layout", shared, rows > 1), make)
        return layout

    def _make_layout(self, shared: tuple[bool, ...], rows: int) -> Layout:
        graph: Any = self.graph()
        nodes = graph[0].needed([n for out in graph[1] for n in out.ravel().tolist()])
        named = {
            op: {graph[0].args[n][0] for n in nodes if graph[0].ops[n] == op}
            for op in ("input", "table")
        }
        tables = {k for k in named["table"] if k >= 0}
        used = named["input"] | tables
        # XLA takes time to hand over an operand, and a model has dozens of them. Numbers of one argument go
        # together: where a loop does not change them, XLA joins them once.
        members: dict[Any, list[int]] = {}
        for k in sorted(used):
            joined = str(self.inputs[k].dtype) == "float64" and (shared[k] or rows == 1)
            # a table may be long, and would be copied
            joined = joined and k not in tables
            members.setdefault(("joined", self.groups[k]) if joined else k, []).append(k)
        packs = tuple(tuple(pack) for pack in members.values())
        places: dict[int, tuple[int, int]] = {}
        buffers = []
        for number, pack in enumerate(packs):
            size = 0
            for k in pack:
                places[k] = (number, size)
                size += math.prod(self.inputs[k].shape)
            dtype = _DTYPES[str(self.inputs[pack[0]].dtype)]
            buffers.append(llvm.Buffer(size, dtype, shared[pack[0]]))
        return Layout(packs, places, tuple(buffers))

    def derived(self, key: Any, make: Callable[[], "Program"]) -> "Program":
        with self._lock:
            if key not in self._derived:
                self._derived[key] = make()
            return self._derived[key]

    def fold(self, known_entries: Sequence[np.ndarray | None]) -> "Program":
        """Program for operands some of whose entries are known."""
        key = tuple(None if x is None else x.tobytes() for x in known_entries)
        return self.derived(("known", key), lambda: self._with_known(known_entries))

    def _with_known(self, known_entries: Sequence[np.ndarray | None]) -> "Program":
        return Program(self.jaxpr, self.groups, known_entries)

    def push_forward(self, tangent_mask: tuple[bool, ...]) -> "Program":
        """Program of (arguments, tangents of those that move) for the tangents of the results."""

        def make() -> Program:
            count = len(self.inputs)

            # The derivative is taken of the traced function and traced itself, and then made a
            # program like any other: rules of machine code for derivatives are not needed, and
            # zeros of tangents vanish in its graph.
            def tangents(*args: Any) -> list[Any]:
                primals, rest = args[:count], iter(args[count:])
                seeds = [
                    next(rest) if move else _zero_tangent(aval)
                    for move, aval in zip(tangent_mask, self.inputs, strict=True)
                ]
                _, out = jax.jvp(lambda *x: self.evaluate(*x), primals, tuple(seeds))
                return [t for t in out if t.dtype != jax.dtypes.float0]

            avals = [
                *self.inputs,
                *(a for a, move in zip(self.inputs, tangent_mask, strict=True) if move),
            ]
            moving = [max(self.groups, default=0) + 1] * (len(avals) - count)
            return Program(_trace(tangents, avals), [*self.groups, *moving])

        return self.derived(("forward", tangent_mask), make)

    def pull_back(
        self, known_mask: tuple[bool, ...], cotangent_mask: tuple[bool, ...]
    ) -> "Program":
        """Program of (known arguments, cotangents of wanted results) for those of the unknown ones."""
        make = lambda: Transpose(self, known_mask, cotangent_mask)
        return self.derived(("back", known_mask, cotangent_mask), make)


class Transpose(Program):
    """Transpose of a program that is linear in its unknown operands, from whose graph its own follows.

    Its function is traced only where it is asked for: by XLA, by further derivatives, and where the graph has
    an operation that is not linear.

    Attributes:
        source: the program. known_mask: its operands that are known. cotangent_mask: its results whose
            cotangents are operands.
    """

    def __init__(
        self,
        source: Program,
        known_mask: tuple[bool, ...],
        cotangent_mask: tuple[bool, ...],
        known_entries: Sequence[np.ndarray | None] = (),
    ) -> None:
        self.source, self.known_mask, self.cotangent_mask = source, known_mask, cotangent_mask
        pairs = list(zip(source.inputs, known_mask, strict=True))
        fixed, moving = ([a for a, k in pairs if k == is_known] for is_known in (True, False))
        results = [a for a, w in zip(source.outputs, cotangent_mask, strict=True) if w]
        groups = [g for g, k in zip(source.groups, known_mask, strict=True) if k]
        groups += [max(source.groups, default=0) + 1] * len(results)
        self._begin([*fixed, *results], moving, groups, known_entries)

    @cached_property
    def jaxpr(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        whole = self.source.pull_back(self.known_mask, self.cotangent_mask)
        return _trace(self._transpose, self.inputs) if whole is self else whole.jaxpr

    def _transpose(self, *args: Any) -> list[Any]:
        count = sum(self.known_mask)
        fixed, seeds = args[:count], iter(args[count:])

        # JAX transposes only programs that are linear in the unknown operands; those that
        # are known are closed over, and become inputs of the transposed program.
        def linear(*moving: Any) -> list[Any]:
            values, moves = iter(fixed), iter(moving)
            whole = [next(values) if k else next(moves) for k in self.known_mask]
            return self.source.evaluate(*whole)

        shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in self.outputs]
        full = [
            next(seeds) if w else jnp.zeros(a.shape, a.dtype)
            for w, a in zip(self.cotangent_mask, self.source.outputs, strict=True)
        ]
        return list(jax.linear_transpose(linear, *shapes)(full))

    def _with_known(self, known_entries: Sequence[np.ndarray | None]) -> Program:
        return Transpose(self.source, self.known_mask, self.cotangent_mask, known_entries)

    def _make_graph(self) -> Any:
        program, masks = self.source.graph(), (self.known_mask, self.cotangent_mask)
        if program is not None:
            try:
                return transpose_graph(
                    program, *masks, self.inputs, self.outputs, llvm.MOST_NODES, self.known_entries
                )
            except NotScalarError:
                pass
        return super()._make_graph()


class Recursion(Program):
    """A traced loop over rows of tables, each pass of which adds a row to the last operand.

    Machine code has the loop, too. A batch, and derivatives, are those of the loop itself.

    Attributes:
        body: one pass; its last operands are the weighted sum of the rows so far, which takes the place of
            the last operand, and rows of all tables but the first. tables: the tables, first the weights.
    """

    def __init__(
        self, jaxpr: Any, groups: Sequence[int], body: Program, tables: Sequence[np.ndarray]
    ) -> None:
        super().__init__(jaxpr, groups)
        self.body, self.tables = body, tables

    def graph(self) -> Any:
        return self.body.graph()

    def fold_loop(self, known_entries: Sequence[np.ndarray | None], jaxpr: Any) -> "Recursion":
        """Loop for operands some of whose entries are known, with the traced loop for batches."""
        body = self.body.fold([*known_entries[:-1], *[None] * len(self.tables)])
        return Recursion(jaxpr, self.groups, body, self.tables)

    def layout(self, shared: tuple[bool, ...], rows: int) -> Layout:
        del shared, rows
        return self.body.layout((False,) * len(self.body.inputs), 1)

    def write(
        self, shared: tuple[bool, ...], rows: int, loop: llvm.Loop | None = None
    ) -> llvm.Code:
        del shared, rows, loop
        alone, first = (False,) * len(self.body.inputs), len(self.inputs)
        buffers = {k: number for k, (number, _) in self.body.layout(alone, 1).places.items()}
        weights, *others = self.tables
        tables = {
            buffers[first + k]: table for k, table in enumerate(others) if first + k in buffers
        }
        if first - 1 not in buffers:
            raise NotScalarError("a loop whose passes do not depend on each other")
        return self.body.write(alone, 1, llvm.Loop(buffers[first - 1], weights, tables))


def _zero_tangent(aval: Any) -> Any:
    if jnp.issubdtype(aval.dtype, jnp.floating):
        return jnp.zeros(aval.shape, aval.dtype)
    return np.zeros(aval.shape, jax.dtypes.float0)


def _trace(function: Callable[..., Any], avals: Sequence[Any]) -> Any:
    """Jaxpr of a function of arrays."""
    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals]
    return jax.make_jaxpr(function)(*shapes)


# --- the primitive: operands and results have `lead` dimensions of a batch in front, those of an
# operand all 1 or all those of the batch


@native_p.def_abstract_eval
def _abstract(*avals: Any, program: Program, lead: tuple[int, ...]) -> Any:
    return [jax_core.ShapedArray((*lead, *out.shape), out.dtype) for out in program.outputs]


def _apply(*operands: Any, program: Program, lead: tuple[int, ...]) -> list[Any]:
    """The function itself over the batch."""
    function: Any = program.evaluate
    # An operand that is the same for the whole batch, such as masses in a batch over states, has
    # batch dimensions of 1: it is neither copied into rows nor batched over.
    shared = [math.prod(x.shape[: len(lead)]) == 1 and math.prod(lead) != 1 for x in operands]
    operands = tuple(
        x.reshape(x.shape[len(lead) :]) if s else x for x, s in zip(operands, shared, strict=True)
    )
    axes = [None if s else 0 for s in shared]
    # XLA's version is batched once for each dimension of the batch, which gives the shapes that
    # machine code has by counting rows.
    for _ in lead:
        function = jax.vmap(function, in_axes=axes) if any(a == 0 for a in axes) else function
    if lead and not any(a == 0 for a in axes):
        return [jnp.broadcast_to(x, (*lead, *x.shape)) for x in function(*operands)]
    return function(*operands)


@native_p.def_impl
def _run(*operands: Any, program: Program, lead: tuple[int, ...]) -> Any:
    return _jitted(program, lead)(*operands)


def _jitted(program: Program, lead: tuple[int, ...]) -> Any:
    def make() -> Any:
        return jax.jit(lambda *x: native_p.bind(*x, program=program, lead=lead))

    return program.derived(("jit", lead), make)  # pyright: ignore[reportArgumentType]


def _batched(operands: Any, dims: Any, *, program: Program, lead: tuple[int, ...]) -> Any:
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    whole = (size, *lead)
    batched_operands = []
    for x, d in zip(operands, dims, strict=True):
        if d is None:
            # An operand without the new dimension stays shared if it was, else it is spread: rows
            # of one operand have one stride.
            full = math.prod(x.shape[: len(lead)]) != 1
            x = jnp.broadcast_to(x, (size, *x.shape)) if full else x[None]
        else:
            x = jnp.moveaxis(x, d, 0)
            core_shape = x.shape[1 + len(lead) :]
            x = jnp.broadcast_to(x, (*whole, *core_shape))
        batched_operands.append(x)
    results = native_p.bind(*batched_operands, program=program, lead=whole)
    return results, [0] * len(results)


batching.primitive_batchers[native_p] = _batched


def _jvp(primals: Any, tangents: Any, *, program: Program, lead: tuple[int, ...]) -> Any:
    if isinstance(program, Recursion):
        tangents = [ad.instantiate_zeros(t) for t in tangents]
        of = lambda *operands: _apply(*operands, program=program, lead=lead)
        return jax.jvp(of, tuple(primals), tuple(tangents))
    results = native_p.bind(*primals, program=program, lead=lead)
    # A program for each set of operands that move: zero tangents are known, and a derivative with
    # respect to a state alone does not compute those by masses.
    tangent_mask = tuple(not isinstance(t, ad.Zero) for t in tangents)
    forward = program.push_forward(tangent_mask)
    tangent_operands = [
        jnp.broadcast_to(t, x.shape)
        for t, x, m in zip(tangents, primals, tangent_mask, strict=True)
        if m
    ]
    moves = iter(native_p.bind(*primals, *tangent_operands, program=forward, lead=lead))
    out = [
        next(moves)
        if jnp.issubdtype(aval.dtype, jnp.floating)
        else ad.Zero(jax.typeof(result).to_tangent_aval())
        for aval, result in zip(program.outputs, results, strict=True)
    ]
    return results, out


ad.primitive_jvps[native_p] = _jvp


def _transpose(cotangents: Any, *operands: Any, program: Program, lead: tuple[int, ...]) -> Any:
    known_mask = tuple(not ad.is_undefined_primal(x) for x in operands)
    cotangent_mask = tuple(not isinstance(c, ad.Zero) for c in cotangents)
    back = program.pull_back(known_mask, cotangent_mask)
    known_operands = [x for x, k in zip(operands, known_mask, strict=True) if k]
    seeds = [c for c, w in zip(cotangents, cotangent_mask, strict=True) if w]
    # the batch may be that of an unknown operand or of the cotangents
    results = iter(native_p.bind(*known_operands, *seeds, program=back, lead=lead))
    out = []
    for x, k in zip(operands, known_mask, strict=True):
        if k:
            out.append(None)
            continue
        result = next(results)
        if math.prod(x.aval.shape[: len(lead)]) == 1 and math.prod(lead) != 1:
            result = result.sum(tuple(range(len(lead)))).reshape(x.aval.shape)
        out.append(result)
    return out


ad.primitive_transposes[native_p] = _transpose


_lower_function = mlir.lower_fun(_apply, multiple_results=True)
mlir.register_lowering(native_p, _lower_function)


def _lower_native(context: Any, *operands: Any, program: Program, lead: tuple[int, ...]) -> Any:
    # Whether there is machine code is decided when a program is lowered for a platform, not when
    # it is traced: one traced program may go to a CPU and to a GPU.
    name = _target(program, lead, context.avals_in) if is_on() else None
    if name is None:
        return _lower_function(context, *operands, program=program, lead=lead)
    layout = program.layout(_find_shared(lead, context.avals_in), math.prod(lead))
    join = lambda *xs: [
        xs[pack[0]] if len(pack) == 1 else jnp.concatenate([xs[k].reshape(-1) for k in pack])
        for pack in layout.packs
        if pack[0] < len(xs)
    ]
    avals = [
        jax_core.ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(join, *context.avals_in)
    ]
    joined = mlir.lower_fun(join)(context.replace(avals_out=avals), *operands)
    results: Any = jax.ffi.ffi_lowering(name)(context.replace(avals_in=avals), *joined)
    # JAX marks the typed interface by an attribute that StableHLO does not know, and which is lost where an
    # operation stands in a function of its own, as within jax.checkpoint: StableHLO's own mark stays.
    operation = results[0].owner
    attributes = operation.attributes
    if "mhlo.backend_config" in attributes:
        attributes["api_version"] = ir.IntegerAttr.get(ir.IntegerType.get_signless(32), 4)
        attributes["backend_config"] = attributes["mhlo.backend_config"]
        del attributes["mhlo.backend_config"]
    return results


mlir.register_lowering(native_p, _lower_native, platform="cpu")


def _find_shared(lead: tuple[int, ...], avals: Sequence[Any]) -> tuple[bool, ...]:
    """True for operands that are the same for a whole batch of several rows."""
    return tuple(math.prod(lead) != 1 and math.prod(a.shape[: len(lead)]) == 1 for a in avals)


def _target(program: Program, lead: tuple[int, ...], avals: Sequence[Any]) -> str | None:
    """Name of a program's machine code for operands of these shapes; None where there is none."""
    rows = math.prod(lead)
    if rows == 0 or not any(math.prod(a.shape) for a in program.outputs):
        return None
    if rows > 1 and isinstance(program, Recursion):
        return None
    shared = _find_shared(lead, avals)
    if program.graph() is None:
        return None

    def make() -> Any:
        try:
            return llvm.register(program.write(shared, rows))
        except NotScalarError:
            return None

    size = (rows > 1, rows >= llvm.vector_width())
    return program.derived(("target", shared, size, llvm.current_level()), make)  # pyright: ignore


class _Switch:
    on = os.environ.get("STMUAV_NATIVE_CODE", "1") != "0"


class _Tracing(threading.local):
    """Number of functions of the kind that are being traced, one within the other."""

    depth = 0


_tracing = _Tracing()


def use_native_code(on: bool) -> None:
    """Let programs that are traced from now on use machine code of their own (the default), or not.

    LLVM makes it on CPUs for functions of small arrays, such as the equations of a mechanism; where
    llvmlite is not installed, and on all other devices, XLA compiles them. The environment variable
    STMUAV_NATIVE_CODE=0 turns it off from the start.
    """
    _Switch.on = bool(on)


def is_on() -> bool:
    """True if programs that are lowered now get machine code of their own."""
    disabled = jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
    return _Switch.on and not disabled and llvm.available()


def describe_code() -> str:
    """Compiler of the equations: LLVM with its version for machine code, or XLA."""
    return f"LLVM {llvm.describe_target()[0]}" if is_on() else "XLA"


def targets_in(jaxpr: Any) -> set[str]:
    """Names of all machine code that a jaxpr calls on a CPU; what is missing of it is compiled."""
    names: set[str] = set()
    # what no result needs is not lowered either
    needed, _ = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    for equation in needed.eqns:
        if equation.primitive is native_p and is_on():
            avals = [v.aval for v in equation.invars]
            name = _target(equation.params["program"], equation.params["lead"], avals)
            names |= {name} if name else set()
        for inner in core.jaxprs_in_params(equation.params):
            names |= targets_in(inner)
    return names


class _Traced(NamedTuple):
    """A function of arguments of one structure.

    Attributes:
        program: None if all results are arguments.
        used: the arrays of the arguments that are operands.
        restore: result of the function from the program's results and the arrays.
        jitted: the function of the arrays, as XLA compiles it.
    """

    program: Program | None
    used: list[int]
    restore: Callable[[Sequence[Any], Sequence[Any]], Any]
    jitted: Callable[[Sequence[Any]], Any]


# Structures of arguments for which a function keeps its program.
MOST_PROGRAMS = 64

_ALLOWED = tuple(np.dtype(name) for name in _DTYPES)


def native(
    function: Callable[..., Any],
    *,
    tables: Sequence[np.ndarray] | None = None,
    keeps_unused: bool = False,
) -> Callable[..., Any]:
    """Function that is one operation of the programs around it, as machine code where that exists.

    Args:
        function: pure function of pytrees; arrays are traced, all else must be hashable.
        tables: with arrays A (s, s), whose entries on and above the diagonal are zero, and others (s, .), the
            operation is a loop, x[i] = function(*args, A[i] @ x, *(table[i] for the others)) for all i, for an array
            x (s, k) of zeros that is the last argument. Batches of it are left to XLA.
        keeps_unused: arrays that the function does not use are operands too, as a loop and its passes need.
    """
    evaluate_pass: Any = None
    if tables is not None:
        keeps_unused = True
        evaluate_pass = native(function, keeps_unused=True)
        function = _make_loop(function, evaluate_pass, tables)
    jitted: Any = eqx.filter_jit(function)
    programs: OrderedDict[Any, _Traced | None] = OrderedDict()

    def look_up(args: Any) -> tuple[_Traced, list[Any]] | None:
        """Entry for such arguments, and their arrays; None if none can be kept."""
        if not is_on():
            return None
        leaves, structure = jax.tree.flatten(args)
        places = [k for k, leaf in enumerate(leaves) if eqx.is_array(leaf)]
        arrays = [leaves[k] for k in places]
        chosen = set(places)
        static = tuple((k, leaf) for k, leaf in enumerate(leaves) if k not in chosen)
        if not can_be_found(args) or any(a.dtype not in _ALLOWED for a in arrays):
            return None
        # The key holds the structure and what is not an array, by value; numbers in arrays are
        # operands, so that other numbers find the same program.
        key = (structure, static, tuple((a.shape, str(a.dtype)) for a in arrays))
        if key not in programs:
            owners = [k for k, arg in enumerate(args) for _ in jax.tree.leaves(arg)]
            groups = [owners[k] for k in places]
            entry = _make(function, structure, static, places, arrays, groups, keeps_unused)
            if tables is not None and entry is not None and entry.program is not None:
                body = evaluate_pass.find(_first_pass(args, tables))
                jaxpr = entry.program.jaxpr
                program = body and Recursion(jaxpr, groups, body[0].program, tables)
                entry = entry._replace(program=program)
            programs[key] = entry
            # A program holds its jaxpr, derivatives and graph. A process that makes many
            # structures, as a test suite does, would keep them all; the oldest go first.
            while len(programs) > MOST_PROGRAMS:
                programs.popitem(last=False)
        entry = programs[key]
        return entry and (entry, arrays)

    def find(args: Any) -> tuple[_Traced, list[Any]] | None:
        """Program and the arrays of the arguments; None where XLA compiles the function."""
        match = look_up(args)
        return match if match is not None and is_program(match[0]) else None

    def is_program(entry: _Traced) -> bool:
        # XLA compiles it as it would without this module; the graph is tried here, so that what
        # has none is not wrapped in a primitive that hides it from XLA's fusion. Within another
        # function of the kind it becomes a part of that one's graph, or is traced again where that
        # one has none.
        program = entry.program
        return program is not None and (_tracing.depth > 0 or program.graph() is not None)

    def can_be_found(args: Any) -> bool:
        """False for a function of the user's that is of a kind which no program is found by."""
        leaves = jax.tree.leaves(args)
        return all(eqx.is_array(leaf) or isinstance(leaf, Hashable) for leaf in leaves)

    @wraps(function)
    def call(*args: Any) -> Any:
        match = look_up(args)
        if match is None:
            return jitted(*args) if not is_on() or can_be_found(args) else function(*args)
        entry, arrays = match
        if not is_program(entry):
            # What JAX keeps of it goes with the entry.
            return entry.jitted(arrays)
        operands = [arrays[k] for k in entry.used]
        return entry.restore(native_p.bind(*operands, program=entry.program, lead=()), arrays)

    def has_code(*args: Any) -> bool:
        match = find(args)
        program = match and match[0].program
        return program is not None and program.graph() is not None

    call.find, call.has_code = find, has_code  # pyright: ignore[reportAttributeAccessIssue]
    return call


def is_native(function: Callable[..., Any]) -> bool:
    """True for a function made by `native`."""
    return hasattr(function, "has_code")


@native
def evaluate(function: Callable[..., Any], *args: Any) -> Any:
    """Value of a function that is itself a pytree, such as a controller, by `native`."""
    return function(*args)


def _first_pass(args: Any, tables: Sequence[np.ndarray]) -> Any:
    """Arguments of a pass of a loop that has these arguments."""
    *first, x = args
    return (*first, np.zeros(x.shape[1:], x.dtype), *(table[0] for table in tables[1:]))


def _make_loop(
    function: Callable[..., Any], evaluate_pass: Any, tables: Sequence[np.ndarray]
) -> Callable[..., Any]:
    """Loop over rows of tables in which a function makes one row after the other."""
    weights, *others = tables

    def fill_rows(*args: Any) -> Array:
        *first, x = args
        # Machine code is compiled once however often it is called, and a batch need not copy all rows to
        # change one. XLA would compile a copy of the function for every pass.
        if not evaluate_pass.has_code(*_first_pass(args, tables)):

            def add_row(x: Array, at: tuple[Any, ...]) -> tuple[Array, None]:
                number, row, *rest = at
                value = evaluate_pass(*first, jnp.sum(row[:, None] * x, axis=0), *rest)
                return jax.lax.dynamic_update_index_in_dim(x, value, number, 0), None

            # JAX remembers a NumPy array by its identity, with the precision that it once had
            numbers = (jnp.arange(len(weights)), *(jnp.asarray(table, x.dtype) for table in tables))
            return jax.lax.scan(add_row, x, numbers)[0]
        rows: list[Array] = []
        for i, row in enumerate(weights):
            terms = [float(row[j]) * rows[j] for j in range(i) if row[j] != 0]
            total = sum(terms[1:], terms[0]) if terms else jnp.zeros_like(x[0])
            rows.append(function(*first, total, *(table[i] for table in others)))
        return jnp.stack(rows)

    return fill_rows


def _make(
    function: Any,
    structure: Any,
    static: Any,
    places: Any,
    arrays: Any,
    groups: Any,
    keeps_unused: bool,
) -> _Traced | None:
    """Program of a function for arguments of one structure."""
    form: list[Any] = []

    def flat(*traced_arrays: Any) -> list[Any]:
        leaves: list[Any] = [None] * (len(static) + len(traced_arrays))
        for k, leaf in static:
            leaves[k] = leaf
        for k, array in zip(places, traced_arrays, strict=True):
            leaves[k] = array
        out = function(*jax.tree.unflatten(structure, leaves))
        # Results may have leaves that are no arrays, such as None or a name: these are known when
        # the function is traced, and are put back in their places afterwards.
        outputs, tree = jax.tree.flatten(out)
        traced = [k for k, x in enumerate(outputs) if eqx.is_array(x)]
        form[:] = [tree, traced, [None if eqx.is_array(x) else x for x in outputs]]
        return [outputs[k] for k in traced]

    _tracing.depth += 1
    try:
        jaxpr = _trace(flat, [jax.typeof(a) for a in arrays])
    finally:
        _tracing.depth -= 1
    if any(isinstance(c, jax_core.Tracer) for c in jaxpr.consts):
        # a number that the function closes over is being traced, and may be another one next time
        return None
    # Results that are arguments, such as the masses and gusts of a model that gets other inputs, are
    # passed on: machine code would be thousands of instructions that copy them.
    arguments = {id(v): k for k, v in enumerate(jaxpr.jaxpr.invars)}
    origins = [arguments.get(id(v)) for v in jaxpr.jaxpr.outvars]
    computed_mask = [origin is None for origin in origins]
    # A model has some hundred numbers, of which a function may need a few: each operand takes time in every
    # transformation of JAX.
    needed, used = partial_eval.dce_jaxpr(jaxpr.jaxpr, computed_mask, instantiate=keeps_unused)
    places_used = [k for k, is_used in enumerate(used) if is_used]
    program = Program(jaxpr.replace(jaxpr=needed), [groups[k] for k in places_used])
    tree, traced, rest = form

    def restore(values: Sequence[Any], arrays: Sequence[Any]) -> Any:
        whole, values_left = list(rest), iter(values)
        for k, origin in zip(traced, origins, strict=True):
            whole[k] = next(values_left) if origin is None else arrays[origin]
        return jax.tree.unflatten(tree, whole)

    def run_jitted(arrays: Sequence[Any]) -> Any:
        whole = list(rest)
        for k, value in zip(traced, jitted(*arrays), strict=True):
            whole[k] = value
        return jax.tree.unflatten(tree, whole)

    flat.__name__ = flat.__qualname__ = getattr(function, "__name__", "run")
    jitted = jax.jit(flat)
    return _Traced(program if any(computed_mask) else None, places_used, restore, run_jitted)
