"""Machine code of a scalar program: LLVM's intermediate representation, compiled by llvmlite.

A program becomes straight-line functions for a single evaluation, or for as many as the processor's
vectors hold, and a handler that XLA calls. Both do the same operations in the same order, with sums of
products fused where the graph says so and nowhere else, and sines and cosines by polynomials that are
part of the program. So a row's bits do not depend on the batch around it: a batch is done in whole
blocks, of which the last overlaps the one before, and batches smaller than a block row by row.

The handler reads XLA's call frame (xla/ffi/api/c_api.h, version 0.3) and says so when it is
registered; XLA refuses it where its own version differs.

Sources: sine and cosine, reduction by three parts of pi/2 and polynomials: fdlibm (Sun Microsystems).
"""

import contextlib
import ctypes
import ctypes.util
import hashlib
import math
import os
import struct
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, no_type_check

import jax
import numpy as np

from .graph import LEAVES, Graph, NotScalarError
from .schedule import Registers, Schedule

# Operations of one LLVM function: longer ones take more time to compile for each operation, shorter ones
# store more numbers.
CHUNK = 500
# Operations up to which code is optimised; beyond, LLVM would take longer than the code is worth.
MOST_OPTIMISED = 20_000
# Operations above which a program is left to XLA, and bytes of code of all programs of a process.
MOST_NODES, MOST_BYTES = 80_000, 400_000_000

_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_COMPARE = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_INTRINSICS = {
    "sqrt": "sqrt", "abs": "fabs", "floor": "floor", "ceil": "ceil", "round": "rint", "trunc": "trunc",
}  # fmt: skip
# functions of the C library, called number by number
_LIBRARY = {
    "tan": 1, "exp": 1, "log": 1, "asin": 1, "acos": 1, "atan": 1, "sinh": 1, "cosh": 1, "tanh": 1,
    "asinh": 1, "acosh": 1, "atanh": 1, "log1p": 1, "expm1": 1, "cbrt": 1, "erf": 1, "erfc": 1,
    "pow": 2, "atan2": 2, "fmod": 2,
}  # fmt: skip

_SINE = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06,
    -1.98412698298579493134e-04, 8.33333333332248946124e-03, -1.66666666666666324348e-01,
)  # fmt: skip
_COSINE = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07,
    2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
# Angles beyond which the reduction loses digits [rad], with fused operations and without.
# The parts of pi/2 have 33 bits, so that their products with fewer than 2^20 quarter turns are
# exact; fused operations round the difference alone, and reach further.
_FAR_FUSED, _FAR = 1e15, 1e6


@dataclass(frozen=True)
class Buffer:
    """An argument or result of a program.

    Attributes:
        size: entries of a row. dtype: "f8", "b1", "i4" or "i8". shared: one row for the whole batch.
    """

    size: int
    dtype: str
    shared: bool = False


@no_type_check
def _bits(value: float) -> str:
    return f"0x{struct.unpack('Q', struct.pack('d', value))[0]:016X}"


@no_type_check
class _Block:
    """Instructions for `width` evaluations at once."""

    def __init__(self, width: int, names: "set[str]") -> None:
        self.width, self.lines, self.count, self.names = width, [], 0, names
        self._addresses: dict[tuple[str, str, int], str] = {}
        self._negatives: dict[str, str] = {}
        vector = lambda kind: kind if width == 1 else f"<{width} x {kind}>"
        self.real, self.truth, self.whole = vector("double"), vector("i1"), vector("i64")
        self.suffix = "f64" if width == 1 else f"v{width}f64"

    def new(self, expression: str) -> str:
        self.count += 1
        self.lines.append(f"  %v{self.count} = {expression}")
        return f"%v{self.count}"

    def address(self, kind: str, start: str, entry: int) -> str:
        """Address of an entry of an array."""
        key = (kind, start, entry)
        if key not in self._addresses:
            self._addresses[key] = self.new(f"getelementptr {kind}, ptr {start}, i64 {entry}")
        return self._addresses[key]

    def spread(self, kind: str, text: str) -> str:
        return text if self.width == 1 else "<" + ", ".join([f"{kind} {text}"] * self.width) + ">"

    def number(self, value: float) -> str:
        return self.spread("double", _bits(value))

    def op(self, name: str, a: str, b: str) -> str:
        return self.new(f"{name} {self.real} {a}, {b}")

    def intrinsic(self, name: str, *args: str) -> str:
        full = f"llvm.{name}.{self.suffix}"
        self.names.add(f"declare {self.real} @{full}({', '.join([self.real] * len(args))})")
        return self.new(f"call {self.real} @{full}({', '.join(f'{self.real} {a}' for a in args)})")

    def fused(self, a: str, b: str, c: str) -> str:
        """a * b + c: one rounding, or two where the processor has no such instruction."""
        if not has_fused():
            return self.op("fadd", self.op("fmul", a, b), c)
        return self.intrinsic("fma", a, b, c)

    def neg(self, a: str) -> str:
        if a not in self._negatives:
            self._negatives[a] = self.new(f"fneg {self.real} {a}")
        return self._negatives[a]

    def select(self, condition: str, on_true: str, on_false: str, kind: str | None = None) -> str:
        kind = kind or self.real
        return self.new(f"select {self.truth} {condition}, {kind} {on_true}, {kind} {on_false}")

    def compare(self, predicate: str, a: str, b: str) -> str:
        return self.new(f"fcmp {predicate} {self.real} {a}, {b}")

    def join(self, kind: str, lanes: Sequence[str]) -> str:
        """Vector of the lanes' values, or the one value."""
        if self.width == 1:
            return lanes[0]
        form, vector = f"<{self.width} x {kind}>", "poison"
        for k, lane in enumerate(lanes):
            vector = self.new(f"insertelement {form} {vector}, {kind} {lane}, i64 {k}")
        return vector

    def repeat(self, kind: str, value: str) -> str:
        """Vector of one value in all lanes, or the value."""
        if self.width == 1:
            return value
        form, zeros = f"<{self.width} x {kind}>", f"<{self.width} x i32> zeroinitializer"
        vector = self.new(f"insertelement {form} poison, {kind} {value}, i64 0")
        return self.new(f"shufflevector {form} {vector}, {form} poison, {zeros}")

    def library(self, name: str, *args: str) -> str:
        """Function of the C library, number by number."""
        arguments = ", ".join(["double"] * len(args))
        self.names.add(f"declare double @{name}({arguments}) #1")
        call = lambda parts: f"call double @{name}({', '.join(f'double {p}' for p in parts)})"
        if self.width == 1:
            return self.new(call(args))
        # Not every C library has functions of vectors: lanes are taken apart and put together.
        # Such functions are rare in equations of motion, whose angles need sines and cosines only.
        lanes = []
        for k in range(self.width):
            parts = [self.new(f"extractelement {self.real} {a}, i64 {k}") for a in args]
            lanes.append(self.new(call(parts)))
        return self.join("double", lanes)

    def extreme(self, a: str, b: str, *, largest: bool) -> str:
        """Larger or smaller of two, NaN if either is."""
        # The processor's own maximum may drop a NaN of one argument; JAX's keeps it, and so must
        # this.
        picked = self.select(self.compare("ogt" if largest else "olt", a, b), a, b)
        return self.select(self.compare("uno", a, a), a, picked)

    def polynomial(self, coefficients: Sequence[float], z: str) -> str:
        total = self.number(coefficients[0])
        for c in coefficients[1:]:
            total = self.fused(total, z, self.number(c))
        return total

    def sine_and_cosine(self, x: str) -> tuple[str, str]:
        """Sine and cosine of angles; NaN beyond `_FAR`, where they would be wrong."""
        # A library falls back on a slow exact reduction for large angles. A branch would stop
        # vectors, and no angle of a mechanism in use comes near the limit: there the result is
        # NaN, which is seen, instead of digits that are wrong.
        limit = self.number(_FAR_FUSED if has_fused() else _FAR)
        is_near = self.compare("ole", self.intrinsic("fabs", x), limit)
        x = self.select(is_near, x, self.number(math.nan))
        quarter = self.intrinsic("rint", self.op("fmul", x, self.number(2 / math.pi)))
        r = x
        for part in _HALF_PI:
            r = self.fused(self.neg(quarter), self.number(part), r)
        z = self.op("fmul", r, r)
        sine = self.fused(self.op("fmul", z, r), self.polynomial(_SINE, z), r)
        half = self.fused(z, self.number(-0.5), self.number(1.0))
        cosine = self.fused(self.op("fmul", z, z), self.polynomial(_COSINE, z), half)
        n = self.new(f"fptosi {self.real} {quarter} to {self.whole}")

        def bit(m: str, k: int) -> str:
            masked = self.new(f"and {self.whole} {m}, {self.spread('i64', str(k))}")
            return self.new(f"icmp ne {self.whole} {masked}, {self.spread('i64', '0')}")

        # The two lowest bits of the number of quarter turns say which of the two polynomials a
        # sine is, and its sign; all lanes compute both and choose, so that no lane waits for
        # another.
        odd = bit(n, 1)
        s, c = self.select(odd, cosine, sine), self.select(odd, sine, cosine)
        s = self.select(bit(n, 2), self.neg(s), s)
        following = self.new(f"add {self.whole} {n}, {self.spread('i64', '1')}")
        c = self.select(bit(following, 2), self.neg(c), c)
        return s, c


@no_type_check
def _emit(block: _Block, graph: Graph, node: int, a: Sequence[str]) -> str:
    """Name of an operation's result, after the instructions that make it from those of its arguments."""
    op, args = graph.ops[node], graph.args[node]
    if op == "fma":
        return block.fused(*a)
    if op in _ARITHMETIC:
        return block.op(_ARITHMETIC[op], *a)
    if op == "neg":
        return block.neg(*a)
    if op in _COMPARE:
        return block.compare(_COMPARE[op], *a)
    if op in ("and", "or", "xor"):
        return block.new(f"{op} {block.truth} {a[0]}, {a[1]}")
    if op == "not":
        return block.new(f"xor {block.truth} {a[0]}, {block.spread('i1', 'true')}")
    if op == "select":
        kind = block.truth if graph.is_truth[args[1]] else block.real
        return block.select(a[0], a[2], a[1], kind)
    if op in ("max", "min"):
        return block.extreme(*a, largest=op == "max")
    if op == "sign":
        zero = block.number(0.0)
        below = block.select(block.compare("olt", a[0], zero), block.number(-1.0), a[0])
        return block.select(block.compare("ogt", a[0], zero), block.number(1.0), below)
    if op == "is_finite":
        size = block.intrinsic("fabs", a[0])
        return block.compare("olt", size, block.number(math.inf))
    if op in _INTRINSICS:
        return block.intrinsic(_INTRINSICS[op], *a)
    if op == "rem":
        return block.library("fmod", *a)
    if op in _LIBRARY:
        return block.library(op, *a)
    raise NotScalarError(op)


def fuse(graph: Graph, outputs: Sequence[int]) -> tuple[Graph, list[int]]:
    """Program with products that one sum alone needs fused into it, without what is not needed."""
    order = graph.needed(outputs)
    # A product may be fused into a sum only if nothing else reads it: another reader would see a
    # value that was rounded once more, and results would depend on what else a program computes.
    uses: dict[int, int] = {}
    for node in order:
        for arg in graph.args[node] if graph.ops[node] not in LEAVES else ():
            uses[arg] = uses.get(arg, 0) + 1
    for node in outputs:
        uses[node] = uses.get(node, 0) + 1
    new = Graph(10**9)
    new.tables = graph.tables
    place: dict[int, int] = {}

    def put(op: str, *args: Any) -> int:
        new.append(op, args)
        return len(new.ops) - 1

    # Vectors that are divided by one number are multiplied by its inverse (`Graph.div`); where it has one
    # use only, a division is as fast, and rounded once.
    def is_inverse(n: int) -> bool:
        return graph.ops[n] == "div" and graph.values[graph.args[n][0]] == 1.0 and uses[n] == 1

    quotients: dict[int, int] = {}
    for node in order:
        if graph.ops[node] == "mul":
            inverse = next((n for n in graph.args[node] if is_inverse(n)), None)
            if inverse is not None:
                quotients[node] = inverse

    # products that a sum takes up
    absorbed: dict[int, int] = {}
    absorbed_products = set(quotients.values())
    for node in order:
        if graph.ops[node] in ("add", "sub"):
            a, b = graph.args[node]
            # One product of a sum at most: of a b + c d only one can be fused, always the same
            # one, so that both widths round alike.
            for arg in (b, a):
                is_product = graph.ops[arg] == "mul" and arg not in quotients
                if is_product and uses[arg] == 1 and arg not in absorbed_products:
                    absorbed[node] = arg
                    absorbed_products.add(arg)
                    break
    for node in order:
        op, args = graph.ops[node], graph.args[node]
        if node in absorbed_products:
            continue
        if op in LEAVES:
            place[node] = put(op, *args)
        elif node in quotients:
            a, b = args
            numerator = a if b == quotients[node] else b
            place[node] = put("div", place[numerator], place[graph.args[quotients[node]][1]])
        elif node in absorbed:
            product = absorbed[node]
            x, y = (place[n] for n in graph.args[product])
            other = place[args[0] if args[1] == product else args[1]]
            if op == "sub" and args[1] == product:
                x = put("neg", x)
            elif op == "sub":
                other = put("neg", other)
            place[node] = put("fma", x, y, other)
        else:
            place[node] = put(op, *(place[n] for n in args))
    return new, [place[n] for n in outputs]


@dataclass(frozen=True)
class Loop:
    """Passes of a program, each of which makes a row of an array and reads a weighted sum of its rows.

    Attributes:
        rows: argument that is the sum, and is the array where XLA calls; the result begins as it.
        weights: weights of the rows in each pass (s, s). tables: arguments by number, and their values
            in each pass.
    """

    rows: int
    weights: np.ndarray
    tables: dict[int, np.ndarray]


@dataclass(frozen=True)
class Code:
    """Text of a program in LLVM's language, and its number of operations."""

    text: str
    operations: int


def write(
    graph: Graph,
    outputs: Sequence[np.ndarray],
    arguments: Sequence[Buffer],
    results: Sequence[Buffer],
    width: int,
    places: dict[int, tuple[int, int]] | None = None,
    loop: Loop | None = None,
) -> Code:
    """Program of a graph for buffers of these kinds.

    Args:
        width: rows that are done at once; batches have as many or more.
        places: buffer and first entry there of each operand; by default each has its own.
        loop: loop around the program, for a width of 1.
    """
    flat = [n for out in outputs for n in out.ravel().tolist()]
    # Fusion is decided here, in the graph, and not by LLVM's fast-math flags, which would choose
    # differently for one row and for a vector of rows: a row's bits would depend on its batch.
    graph, flat = fuse(graph, flat)
    if places is not None:
        for node in range(len(graph.ops)):
            if graph.ops[node] in ("input", "table") and graph.args[node][0] >= 0:
                number, entry, kind = graph.args[node]
                buffer, first = places[number]
                graph.args[node] = (buffer, first + entry, kind)
    schedule = Schedule(graph, flat)
    names: set[str] = set()
    parts = [_functions(graph, schedule, flat, arguments, results, width, names)]
    if loop is None:
        body = _repeat_rows(arguments, results, width)
    else:
        names.update(_tables(loop))
        parts.append(_sum_rows(results[0].size, loop.weights, names))
        body = _repeat_passes(arguments, results, loop)
    handler = _handler(body)
    attributes = (
        'attributes #0 = { nounwind "prefer-vector-width"="512" "min-legal-vector-width"="512" }\n'
        "attributes #1 = { nounwind willreturn memory(none) }\n"
    )
    text = "\n".join([*sorted(names), *parts, handler, attributes])
    return Code(text, len(schedule.steps))


_TYPES = {"f8": "double", "b1": "i8", "i4": "i32", "i8": "i64"}


@no_type_check
def _load(block: _Block, buffer: Buffer, number: int, entry: int) -> str:
    """Entry of an argument's rows."""
    kind = _TYPES[buffer.dtype]

    def load_lane(lane: int) -> str:
        start = f"%x{number}" if not lane or buffer.shared else f"%x{number}l{lane}"
        return block.new(f"load {kind}, ptr {block.address(kind, start, entry)}")

    if buffer.shared and block.width > 1:
        vector = block.repeat(kind, load_lane(0))
    else:
        vector = block.join(kind, [load_lane(k) for k in range(block.width)])
    return _read_as_number(block, buffer.dtype, vector)


@no_type_check
def _read_as_number(block: _Block, dtype: str, vector: str) -> str:
    """Numbers or truth values of what an argument of a data type holds."""
    kind = _TYPES[dtype]
    form = kind if block.width == 1 else f"<{block.width} x {kind}>"
    if dtype == "f8":
        return vector
    if dtype == "b1":
        zero = "0" if block.width == 1 else "zeroinitializer"
        return block.new(f"icmp ne {form} {vector}, {zero}")
    return block.new(f"sitofp {form} {vector} to {block.real}")


@no_type_check
def _look_up(
    block: _Block, graph: Graph, arguments: Sequence[Buffer], table: int, place: str
) -> str:
    """Entry of a table at a computed place, which lies within it; NaN where the place is NaN."""
    number, first, kind_of_value = graph.args[table]
    is_number = block.compare("ord", place, place)
    # a place that is NaN would be any address
    within = block.select(is_number, place, block.number(0.0))
    if number < 0:
        buffer = Buffer(len(graph.tables[-1 - number]), "f8", shared=True)
        values = ", ".join(f"double {_bits(v)}" for v in graph.tables[-1 - number].tolist())
        block.names.add(
            f"@known{-1 - number} = private constant [{buffer.size} x double] [{values}]"
        )
    else:
        buffer = arguments[number]
    kind, lanes = _TYPES[buffer.dtype], []
    for lane in range(block.width):
        at = within
        if block.width > 1:
            at = block.new(f"extractelement {block.real} {within}, i64 {lane}")
        at = block.new(f"fptosi double {at} to i64")
        start = f"@known{-1 - number}" if number < 0 else f"%x{number}"
        start += f"l{lane}" if lane and not buffer.shared else ""
        at = block.new(f"add i64 {at}, {first}")
        at = block.new(f"getelementptr {kind}, ptr {start}, i64 {at}")
        lanes.append(block.new(f"load {kind}, ptr {at}"))
    value = _read_as_number(block, buffer.dtype, block.join(kind, lanes))
    if kind_of_value == "b":
        return value if buffer.dtype == "b1" else block.compare("une", value, block.number(0.0))
    return block.select(is_number, value, block.number(math.nan))


@no_type_check
def _store(block: _Block, buffer: Buffer, number: int, entry: int, value: str) -> None:
    kind, form = _TYPES[buffer.dtype], block.real
    if buffer.dtype == "b1":
        form = kind if block.width == 1 else f"<{block.width} x {kind}>"
        value = block.new(f"zext {block.truth} {value} to {form}")
    elif buffer.dtype != "f8":
        form = kind if block.width == 1 else f"<{block.width} x {kind}>"
        value = block.new(f"fptosi {block.real} {value} to {form}")
    for lane in range(block.width):
        scalar = (
            value if block.width == 1 else block.new(f"extractelement {form} {value}, i64 {lane}")
        )
        start = f"%y{number}" if not lane else f"%y{number}l{lane}"
        block.lines.append(f"  store {kind} {scalar}, ptr {block.address(kind, start, entry)}")


def _signature(arguments: Sequence[Buffer], results: Sequence[Buffer], *, typed: bool) -> str:
    form = "ptr noalias readonly" if typed else "ptr"
    parts = [f"{form} %x{k}" for k in range(len(arguments))]
    parts += [f"{'ptr noalias' if typed else 'ptr'} %y{k}" for k in range(len(results))]
    return ", ".join(parts)


def _lanes(block: _Block, arguments: Sequence[Buffer], results: Sequence[Buffer]) -> None:
    """Addresses of the rows of all lanes."""
    for letter, buffers in (("x", arguments), ("y", results)):
        for number, buffer in enumerate(buffers):
            for lane in range(1, block.width):
                if not buffer.shared:
                    kind = _TYPES[buffer.dtype]
                    at = f"getelementptr {kind}, ptr %{letter}{number}, i64 {lane * buffer.size}"
                    block.lines.append(f"  %{letter}{number}l{lane} = {at}")


@no_type_check
def _functions(
    graph: Graph, schedule: Schedule, outputs: list[int], arguments: Sequence[Buffer],
    results: Sequence[Buffer], width: int, names: "set[str]",
) -> str:  # fmt: skip
    """Function of `width` evaluations, in parts that hand numbers on through memory."""
    places_of_outputs: dict[int, list[tuple[int, int]]] = {}
    entries = [(k, entry) for k, buffer in enumerate(results) for entry in range(buffer.size)]
    for node, place in zip(outputs, entries, strict=True):
        places_of_outputs.setdefault(node, []).append(place)
    form_of = lambda node: block.truth if graph.is_truth[node] else block.real

    def is_free(node: int) -> bool:
        return graph.ops[node] == "input" and (width == 1 or arguments[graph.args[node][0]].shared)

    def store(node: int, name: str, place: int) -> None:
        at = block.address(block.real, "%memory", place)
        block.lines.append(f"  store {form_of(node)} {name}, ptr {at}")

    def find(node: int) -> str:
        """Name of a node's number."""
        op, args = graph.ops[node], graph.args[node]
        if op == "constant":
            return block.number(args[0])
        if op == "neg":
            return block.neg(find(args[0]))
        if node not in registers.names:
            if node in registers.places:
                at = block.address(block.real, "%memory", registers.places[node])
                name = block.new(f"load {form_of(node)}, ptr {at}")
            else:
                name = _load(block, arguments[args[0]], *args[:2])
            registers.put(node, name)
            return name
        return registers.names[node]

    def compute(node: int) -> dict[int, str]:
        """Results of an operation; a sine and the cosine of the same angle come together."""
        op, args = graph.ops[node], graph.args[node]
        if op == "lookup":
            return {node: _look_up(block, graph, arguments, args[1], find(args[0]))}
        values = [find(n) for n in args]
        if op not in ("sin", "cos"):
            return {node: _emit(block, graph, node, values)}
        both = zip(("sin", "cos"), block.sine_and_cosine(*values), strict=True)
        return {twins[name, args[0]]: value for name, value in both if (name, args[0]) in twins}

    def store_outputs(node: int, value: str) -> None:
        for number, entry in places_of_outputs.get(node, ()):
            is_number = results[number].dtype == "b1" and not graph.is_truth[node]
            output = block.compare("une", value, block.number(0.0)) if is_number else value
            _store(block, results[number], number, entry, output)

    steps = schedule.steps
    twins = {(graph.ops[n], graph.args[n][0]): n for n in steps if graph.ops[n] in ("sin", "cos")}
    registers = Registers(schedule, _registers() - _SPARE, is_free, store)
    computed: set[int] = set()
    signature = _signature(arguments, results, typed=True)
    texts = []
    for first in range(0, max(len(steps), 1), CHUNK):
        block = _Block(width, names)
        _lanes(block, arguments, results)
        if first == 0:
            for node in places_of_outputs:
                if graph.ops[node] in LEAVES:
                    store_outputs(node, find(node))
        for k, node in enumerate(steps[first : first + CHUNK], start=first):
            if node not in computed:
                for result, value in compute(node).items():
                    computed.add(result)
                    # Outputs are stored as soon as they are known, which frees their registers.
                    store_outputs(result, value)
                    registers.put(result, value)
            registers.finish(k)
        registers.leave()
        lines = "\n".join(block.lines)
        texts.append(
            f"define internal void @part{width}_{len(texts)}({signature}, ptr %memory) noinline #0 {{\n"
            f"{lines}\n  ret void\n}}\n"
        )
    call = _signature(arguments, results, typed=False)
    real = "double" if width == 1 else f"<{width} x double>"
    body = "".join(
        f"  call void @part{width}_{k}({call}, ptr %memory)\n" for k in range(len(texts))
    )
    texts.append(
        f"define internal void @rows{width}({signature}) #0 {{\n"
        f"  %memory = alloca {real}, i64 {max(registers.size, 1)}\n{body}  ret void\n}}\n"
    )
    return "\n".join(texts)


# Offsets in bytes of what the handler reads: see c_api.h of XLA's FFI, version 0.3.
_EXTENSIONS, _ARGUMENTS, _RESULTS, _DATA, _RANK, _DIMENSIONS = 8, 72, 112, 24, 32, 40
_METADATA_TYPE, _METADATA, _VERSION, _TRAITS = 8, 24, 24, 32
API_VERSION = (0, 3)


def _find_buffers(arguments: Sequence[int], results: int) -> list[str]:
    """Instructions that find the data of arguments, by the numbers that they have here, and of results."""
    lines = []
    for letter, offset, numbers in (("x", _ARGUMENTS, arguments), ("y", _RESULTS, range(results))):
        lines.append(f"  %{letter}list.at = getelementptr i8, ptr %frame, i64 {offset}")
        lines.append(f"  %{letter}list = load ptr, ptr %{letter}list.at")
        for place, k in enumerate(numbers):
            at = f"{letter}{k}"
            lines += [
                f"  %{at}.slot = getelementptr ptr, ptr %{letter}list, i64 {place}",
                f"  %{at}.buffer = load ptr, ptr %{at}.slot",
                f"  %{at}.data = getelementptr i8, ptr %{at}.buffer, i64 {_DATA}",
                f"  %{at}.base = load ptr, ptr %{at}.data",
            ]
    return lines


@no_type_check
def _sum_rows(size: int, weights: np.ndarray, names: "set[str]") -> str:
    """Function that adds the rows of an array times the weights of a pass, term by term."""
    width = min(2 ** int(math.log2(size)), vector_width())
    block = _Block(width, names)
    # in whole vectors, of which the last overlaps the one before
    starts = [*range(0, size - width, width), size - width]
    totals: dict[int, str] = {}
    for j in range(len(weights)):
        weight = block.new(f"load double, ptr {block.address('double', '%weights', j)}")
        weight = block.repeat("double", weight)
        for start in starts:
            at = block.address("double", "%rows", j * size + start)
            row = block.new(f"load {block.real}, ptr {at}, align 8")
            if j == 0:
                totals[start] = block.op("fmul", weight, row)
            else:
                totals[start] = block.fused(weight, row, totals[start])
    for start, total in totals.items():
        at = block.address("double", "%total", start)
        block.lines.append(f"  store {block.real} {total}, ptr {at}, align 8")
    lines = "\n".join(block.lines)
    return (
        f"define internal void @sum(ptr %weights, ptr %rows, ptr %total) noinline #0 {{\n"
        f"{lines}\n  ret void\n}}\n"
    )


def _repeat_passes(arguments: Sequence[Buffer], results: Sequence[Buffer], loop: Loop) -> str:
    """Instructions that go through the passes of a loop."""
    (row,) = results
    count = len(loop.weights)
    numbers = [k for k in range(len(arguments)) if k not in loop.tables]
    lines = _find_buffers(numbers, 1)
    names = {k: f"%x{k}.base" for k in numbers} | {k: f"%x{k}.row" for k in loop.tables}
    names[loop.rows] = "%total"
    args = ", ".join(f"ptr {names[k]}" for k in range(len(arguments)))
    at_row = "\n".join(
        f"  %x{k}.row = getelementptr [{arguments[k].size} x double], ptr @table{k}, i64 %pass"
        for k in loop.tables
    )
    load, total = "\n".join(lines), 8 * count * row.size
    return f"""
{load}
  %row = alloca double, i64 {row.size}
  %total = alloca double, i64 {row.size}
  call void @llvm.memcpy.p0.p0.i64(ptr %y0.base, ptr %x{loop.rows}.base, i64 {total}, i1 false)
  br label %again
again:
  %pass = phi i64 [0, %run], [%pass.next, %again]
  %weights = getelementptr [{count} x double], ptr @weights, i64 %pass
  call void @sum(ptr %weights, ptr %y0.base, ptr %total)
{at_row}
  call void @rows1({args}, ptr %row)
  %into = getelementptr [{row.size} x double], ptr %y0.base, i64 %pass
  call void @llvm.memcpy.p0.p0.i64(ptr %into, ptr %row, i64 {8 * row.size}, i1 false)
  %pass.next = add i64 %pass, 1
  %more = icmp slt i64 %pass.next, {count}
  br i1 %more, label %again, label %done
done:
  ret ptr null
"""


def _tables(loop: Loop) -> list[str]:
    """Constants of a loop, and the declaration of what copies its rows."""
    lines = ["declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)"]
    tables = {"weights": loop.weights} | {f"table{k}": table for k, table in loop.tables.items()}
    for name, table in tables.items():
        values = np.ravel(np.asarray(table, float)).tolist()
        numbers = ", ".join(f"double {_bits(value)}" for value in values)
        lines.append(f"@{name} = private constant [{len(values)} x double] [{numbers}]")
    return lines


def _repeat_rows(arguments: Sequence[Buffer], results: Sequence[Buffer], width: int) -> str:
    """Instructions that go through the rows of a batch."""
    lines = _find_buffers(range(len(arguments)), len(results))
    # XLA gives sizes and not counts of rows: dimensions of a batch may be several, and their
    # product is what is needed, that of the first result with entries.
    first = next(k for k, b in enumerate(results) if b.size)
    lines += [
        f"  %entries = call i64 @entries(ptr %y{first}.buffer)",
        f"  %rows = sdiv i64 %entries, {results[first].size}",
    ]

    def call(row: str) -> str:
        offsets, args = [], []
        for letter, buffers in (("x", arguments), ("y", results)):
            for k, buffer in enumerate(buffers):
                name = f"%{letter}{k}.base"
                if not buffer.shared:
                    offset = f"%{letter}{k}.offset"
                    offsets.append(f"  {offset} = mul i64 {row}, {buffer.size}")
                    name = f"%{letter}{k}.at"
                    kind = _TYPES[buffer.dtype]
                    offsets.append(
                        f"  {name} = getelementptr {kind}, ptr %{letter}{k}.base, i64 {offset}"
                    )
                args.append(f"ptr {name}")
        offsets.append(f"  call void @rows{width}({', '.join(args)})")
        return "\n".join(offsets)

    load = "\n".join(lines)
    # Batches are done in whole vectors, of which they fill one at least. The last one is moved back to end
    # with the batch and does some rows twice, with equal bits, instead of a remainder row by row, whose
    # instructions would take longer and could round differently.
    return f"""
{load}
  %last = sub i64 %rows, {width}
  br label %block
block:
  %at = phi i64 [0, %run], [%next, %block]
  %ahead = icmp sgt i64 %at, %last
  %row = select i1 %ahead, i64 %last, i64 %at
{call("%row")}
  %next = add i64 %at, {width}
  %more = icmp slt i64 %next, %rows
  br i1 %more, label %block, label %done
done:
  ret ptr null
"""


def _handler(body: str) -> str:
    """Function that XLA calls: it tells its version, or goes on to what it is for."""
    version = API_VERSION[0] | API_VERSION[1] << 32
    return f"""
define internal i64 @entries(ptr %buffer) {{
  %rank.at = getelementptr i8, ptr %buffer, i64 {_RANK}
  %rank = load i64, ptr %rank.at
  %sizes.at = getelementptr i8, ptr %buffer, i64 {_DIMENSIONS}
  %sizes = load ptr, ptr %sizes.at
  br label %test
test:
  %k = phi i64 [0, %0], [%k.next, %each]
  %n = phi i64 [1, %0], [%n.next, %each]
  %go = icmp slt i64 %k, %rank
  br i1 %go, label %each, label %end
each:
  %size.at = getelementptr i64, ptr %sizes, i64 %k
  %size = load i64, ptr %size.at
  %n.next = mul i64 %n, %size
  %k.next = add i64 %k, 1
  br label %test
end:
  ret i64 %n
}}
define ptr @program(ptr %frame) #0 {{
  %extension.at = getelementptr i8, ptr %frame, i64 {_EXTENSIONS}
  %extension = load ptr, ptr %extension.at
  %none = icmp eq ptr %extension, null
  br i1 %none, label %run, label %asked
asked:
  %type.at = getelementptr i8, ptr %extension, i64 {_METADATA_TYPE}
  %type = load i32, ptr %type.at
  %about = icmp eq i32 %type, 1
  br i1 %about, label %tell, label %run
tell:
  %metadata.at = getelementptr i8, ptr %extension, i64 {_METADATA}
  %metadata = load ptr, ptr %metadata.at
  %version.at = getelementptr i8, ptr %metadata, i64 {_VERSION}
  store i64 {version}, ptr %version.at
  %traits.at = getelementptr i8, ptr %metadata, i64 {_TRAITS}
  store i32 0, ptr %traits.at
  ret ptr null
run:
{body}}}
"""


# --- compilation


@cache
def _binding() -> Any:
    """llvmlite's binding, or None where it is not installed."""
    try:
        import llvmlite.binding as llvm
    except ImportError:
        return None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # LLVM finds symbols of the process; functions of the C library that no loaded module uses have
    # to be named to it.
    missing = [name for name in _LIBRARY if llvm.address_of_symbol(name) is None]
    # looked for once: on Linux each search starts a process
    library = ctypes.CDLL(ctypes.util.find_library("m") or None) if missing else None
    for name in missing:
        llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)
    return llvm


@cache
def _features() -> Any:
    """Features of the processor, by LLVM's names."""
    return _binding().get_host_cpu_features()


def has_fused() -> bool:
    """True if the processor multiplies and adds in one instruction."""
    return bool(_features().get("fma")) or "aarch64" in _triple() or "arm64" in _triple()


@cache
def _triple() -> str:
    return _binding().get_process_triple()


@cache
def describe_target() -> tuple[str, ...]:
    """Versions of LLVM and of XLA's interface, and the processor: object code is valid for these alone."""
    llvm = _binding()
    version = ".".join(map(str, llvm.llvm_version_info))
    features = _features().flatten()
    interface = ".".join(map(str, API_VERSION))
    return version, interface, _triple(), llvm.get_host_cpu_name(), features


# Registers for what is at hand only within an operation.
_SPARE = 4


def _registers() -> int:
    """Registers of the processor for numbers in double precision."""
    has_many = _features().get("avx512f") or "aarch64" in _triple() or "arm64" in _triple()
    return 32 if has_many else 16


def vector_width() -> int:
    """Numbers in double precision that the processor's vectors hold."""
    features = _features()
    if features.get("avx512f"):
        return 8
    return 4 if features.get("avx2") else 2


@dataclass(frozen=True)
class Settings:
    """Settings of the compiler: LLVM's level of optimisation, 0 to 3."""

    level: int = 1


settings = Settings()
_in_haste = ContextVar("_in_haste", default=False)


@contextlib.contextmanager
def without_optimisation() -> Iterator[None]:
    """Compile machine code that is lowered within in less time; it has the same bits, and runs more slowly."""
    token = _in_haste.set(True)
    try:
        yield
    finally:
        _in_haste.reset(token)


def current_level() -> int:
    """Level of optimisation of programs that are lowered now."""
    return 0 if _in_haste.get() else settings.level


_lock = threading.Lock()
# names of the programs that XLA knows by their digests, and their object code
_targets: dict[str, str] = {}
objects: dict[str, bytes] = {}
_bytes = 0


def available() -> bool:
    """True if machine code can be made here and XLA takes it."""
    return jax.default_backend() == "cpu" and _binding() is not None and _is_taken()


@cache
def _is_taken() -> bool:
    """True if XLA registers a handler of this version and calls it as expected."""
    # The layout of XLA's call frame is not checked by any header at run time: a program of one
    # addition is called once, and if anything about it is not as expected, XLA compiles everything
    # itself.
    graph = Graph(100)
    node = graph.apply("add", graph.node("input", 0, 0, "f"), graph.constant(1.0))
    rows = np.arange(1.0 + vector_width())[:, None]
    try:
        code = write(
            graph, [np.array([node])], [Buffer(1, "f8")], [Buffer(1, "f8")], vector_width()
        )
        call = jax.ffi.ffi_call(register(code), jax.ShapeDtypeStruct(rows.shape, rows.dtype))
        with jax.enable_x64(True), jax.ensure_compile_time_eval():
            return bool((np.asarray(call(rows)) == rows + 1.0).all())
    # whatever is wrong with the library or with XLA's interface: XLA compiles all programs itself
    except Exception:
        return False


def register(code: Code) -> str:
    """Name under which XLA finds a program, which is compiled the first time.

    Raises:
        NotScalarError: the process holds as much code as it may.
    """
    level = current_level() if code.operations <= MOST_OPTIMISED else 0
    llvm = _binding()
    # The digest is over the text of the program and all that its object code depends on, so that
    # code of another processor or version is never loaded from a shared folder.
    about = [code.text, str(level), *describe_target()]
    digest = hashlib.sha256("\n".join(about).encode()).hexdigest()[:40]
    with _lock:
        if digest in _targets:
            return _targets[digest]
        if _bytes > MOST_BYTES:
            raise NotScalarError("the process holds as much machine code as it may")
        name = f"stmuav_{digest}"
        folder = _object_folder()
        path = None if folder is None else folder / f"{digest}.o"
        content = None if path is None else _read(path)
        if content is None:
            content = _compile(llvm, code.text.replace("@program(", f"@{name}("), level)
            if path is not None:
                _write(path, content)
        _register(name, content)
        _targets[digest] = name
        return name


def load(name: str, content: bytes) -> None:
    """Let XLA find the object code of a program that another process has made."""
    with _lock:
        if name.removeprefix("stmuav_") not in _targets:
            _register(name, content)
            _targets[name.removeprefix("stmuav_")] = name


@cache
def _engine() -> Any:
    """Owner of all code, which XLA may call for as long as the process lives."""
    llvm = _binding()
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(llvm, 0))


def _register(name: str, content: bytes) -> None:
    global _bytes
    # Code goes through an object file even where it was just compiled: the same bytes are kept on
    # disk, and are handed to other processes.
    engine = _engine()
    engine.add_object_file(_binding().ObjectFileRef.from_data(content))
    engine.finalize_object()
    address = engine.get_function_address(name)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
    objects[name] = content
    _bytes += len(content)


def _machine(llvm: Any, level: int) -> Any:
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features().flatten(), opt=level,
        jit=True, codemodel="jitdefault",
    )  # fmt: skip


def _compile(llvm: Any, text: str, level: int) -> bytes:
    """Object code of a program."""
    return _machine(llvm, level).emit_object(llvm.parse_assembly(text))


def _object_folder() -> Path | None:
    """Folder for code, within that of JAX's own cache; None where JAX keeps nothing."""
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    return Path(folder) / "stmuav_code" if folder else None


def _write(path: Path, content: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Another process may read or write the same file: it is written under another name and
        # then moved, which is atomic, and sealed by its digest, so that a damaged file counts as
        # absent.
        handle, partial = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
        # A full or read-only folder is no reason to fail: the code is in memory already.
        os.replace(partial, path)
    except OSError:
        return


def _read(path: Path) -> bytes | None:
    """Content of a file of code; None if it is absent or damaged."""
    try:
        whole = path.read_bytes()
    except OSError:
        return None
    seal, content = whole[:32], whole[32:]
    return content if hashlib.sha256(content).digest() == seal else None
