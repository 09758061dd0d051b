"""Scalar program of a JAX function: a graph of operations on single numbers.

The equations of a mechanism are some thousand operations on arrays of a few entries, many of which
are zeros and ones by construction. `scalarise` follows a jaxpr entry by entry: operations on known
numbers are done at once, products with 0 and 1 vanish, equal operations become one node, and what
no output needs is never made. A jaxpr with an operation that has no scalar form, such as a loop with an
unknown number of passes, raises `NotScalarError`, and is left to XLA. An index that is computed reads
operands and known arrays as tables; of other arrays it chooses among a few entries.

Only numbers that stand in the jaxpr itself are known; all arguments are inputs. A product 0 * x is
0 here even where x is not finite; `Graph.dropped` holds such x, and the program adds 0 * x of the
inputs behind them to its outputs, so that NaN and infinities come through.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, no_type_check

import numpy as np
from jax.extend import core

# What is called for each number of a program is not type-checked as it runs (`no_type_check`), which the
# tests do everywhere else: that takes longer than the work itself.

# Operations on single numbers by the names that they have in a graph.
BINARY = ("add", "sub", "mul", "div", "max", "min", "pow", "atan2", "rem")
COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")
TRUTHS = {*COMPARISONS, "and", "or", "xor", "not", "is_finite"}
UNARY = (
    "neg", "abs", "sign", "floor", "ceil", "round", "sqrt", "sin", "cos", "tan", "exp", "log",
    "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "log1p", "expm1",
    "cbrt", "erf", "erfc", "trunc",
)  # fmt: skip

_NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "max": np.maximum,
    "min": np.minimum, "pow": np.power, "atan2": np.arctan2, "rem": np.fmod, "eq": np.equal,
    "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "and": np.logical_and, "or": np.logical_or, "xor": np.logical_xor, "not": np.logical_not,
    "neg": np.negative, "abs": np.abs, "sign": np.sign, "floor": np.floor, "ceil": np.ceil,
    "round": np.rint, "sqrt": np.sqrt, "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp,
    "log": np.log, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "sinh": np.sinh,
    "cosh": np.cosh, "tanh": np.tanh, "asinh": np.arcsinh, "acosh": np.arccosh,
    "atanh": np.arctanh, "log1p": np.log1p, "expm1": np.expm1, "cbrt": np.cbrt, "trunc": np.trunc,
    "erf": np.vectorize(math.erf), "erfc": np.vectorize(math.erfc),
    "is_finite": np.isfinite,
}  # fmt: skip


# Operations with rules of their own, which are methods of the graph.
_ARITHMETIC = ("add", "sub", "mul", "div", "neg")

# Nodes without arguments that are nodes.
LEAVES = ("input", "constant", "table")

# Entries of an array that is no table among which a computed index chooses, at most.
MOST_CHOICES = 16


class NotScalarError(Exception):
    """A function has no scalar program; the message names the operation."""


@no_type_check
class Graph:
    """Operations on single numbers, each once.

    Attributes:
        ops, args: operation and arguments (nodes) of each node; an input's arguments are its operand
            and its place in it, a constant's is its value.
        values: known number of each node; None where it is computed.
        is_truth: whether the value of each node is a truth value; known ones are numbers.
        dropped: nodes x of products 0 * x that were taken for 0.
        tables: known arrays that are read by a computed index.
        order_tests: nodes that tell NaN from other numbers only in order to sort it.
    """

    def __init__(self, most_nodes: int) -> None:
        self.ops: list[str] = []
        self.args: list[tuple[Any, ...]] = []
        self.values: list[float | None] = []
        self.is_truth: list[bool] = []
        self.dropped: set[int] = set()
        self.tables: list[np.ndarray] = []
        self.order_tests: set[int] = set()
        self._most, self._inputs = most_nodes, 0
        self._known: dict[Any, int] = {}

    def node(self, op: str, *args: Any) -> int:
        """Node of an operation, the same for the same arguments."""
        # One table of all operations makes common subexpressions one node: the equations of a
        # mechanism compute the same products of rotations in many places, and a node that exists
        # is not made again.
        key = (op, *args)
        number = self._known.get(key)
        if number is None:
            number = self._known[key] = len(self.ops)
            if number - self._inputs >= self._most:
                raise NotScalarError(f"more than {self._most} operations")
            self.append(op, args)
        return number

    def append(self, op: str, args: tuple[Any, ...]) -> None:
        self.ops.append(op)
        self.args.append(args)
        self.values.append(args[0] if op == "constant" else None)
        if op in ("select", "lookup"):
            self.is_truth.append(self.is_truth[args[1]])
        else:
            self.is_truth.append(op in TRUTHS or (op in ("input", "table") and args[2] == "b"))

    def add_inputs(self, number: int, count: int, kind: str) -> np.ndarray:
        """Nodes of the entries of an operand, which are no operations: a table may have many."""
        first = len(self.ops)
        for k in range(count):
            self.append("input", (number, k, kind))
        self._inputs += count
        return np.arange(first, first + count)

    def constant(self, value: float) -> int:
        """Node of a known number; NaN, which equals nothing, is one too."""
        value = float(value)
        if value == 0.0:
            # Both zeros are one constant: they compare equal as keys, and the node would otherwise
            # have the sign of the one that came first.
            value = 0.0  # -0.0
        key = ("constant", "nan") if value != value else ("constant", value)
        number = self._known.get(key)
        if number is None:
            number = self._known[key] = len(self.ops)
            self.append("constant", (value,))
        return number

    # A negation is moved outwards, out of products and into sums, where it turns an addition into
    # a subtraction and costs nothing; two of them cancel on the way.
    # Each operation on nodes; the order of two arguments that commute is that of their numbers.

    def add(self, a: int, b: int) -> int:
        u, v = self.values[a], self.values[b]
        if u is not None and v is not None:
            return self.constant(u + v)
        if u == 0.0:
            return b
        if v == 0.0:
            return a
        if self.ops[b] == "neg":
            return self.sub(a, self.args[b][0])
        if self.ops[a] == "neg":
            return self.sub(b, self.args[a][0])
        return self.node("add", *sorted((a, b)))

    def sub(self, a: int, b: int) -> int:
        u, v = self.values[a], self.values[b]
        if u is not None and v is not None:
            return self.constant(u - v)
        if u == 0.0:
            return self.neg(b)
        if v == 0.0:
            return a
        if self.ops[b] == "neg":
            return self.add(a, self.args[b][0])
        if self.ops[a] == "neg":
            return self.neg(self.add(self.args[a][0], b))
        return self.node("sub", a, b)

    def neg(self, a: int) -> int:
        value = self.values[a]
        if value is not None:
            return self.constant(-value)
        if self.ops[a] == "neg":
            return self.args[a][0]
        if self.ops[a] == "sub":
            return self.node("sub", *reversed(self.args[a]))
        return self.node("neg", a)

    def mul(self, a: int, b: int) -> int:
        u, v = self.values[a], self.values[b]
        if u is not None and v is not None:
            return self.constant(u * v)
        if u is not None:
            a, b, v = b, a, u
        if v == 0.0:
            # The product is 0 whatever x is, except for NaN and infinities: those are remembered
            # here, and come through by a sum at the end.
            self.dropped.add(a)
            return b
        if v == 1.0:
            return a
        if v == -1.0:
            return self.neg(a)
        # The sign is taken out of the product, so that (-a) b, a (-b) and -(a b) become one node.
        negative = (self.ops[a] == "neg") != (self.ops[b] == "neg")
        a, b = (self.args[n][0] if self.ops[n] == "neg" else n for n in (a, b))
        if v is not None and negative:
            return self.mul(a, self.constant(-v))
        product = self.node("mul", *sorted((a, b)))
        return self.neg(product) if negative else product

    def div(self, a: int, b: int) -> int:
        u, v = self.values[a], self.values[b]
        if u is not None and v is not None:
            with np.errstate(all="ignore"):
                return self.constant(float(np.divide(u, v)))
        if v == 1.0:
            return a
        if u == 0.0:
            # 0 / x is NaN at x = 0 and x = NaN
            return self.node("div", a, b)
        # vectors are often divided by one number, and a division takes as long as ten products
        return self.node("div", a, b) if u == 1.0 else self.mul(a, self.div(self.constant(1.0), b))

    def select(self, condition: int, on_false: int, on_true: int) -> int:
        truth = self.values[condition]
        if truth is not None:
            return on_true if truth else on_false
        # Both branches of a choice are computed, as they are by XLA: only a choice between equal
        # nodes, or by a known condition, is none.
        if on_false == on_true:
            return on_false
        if self.is_truth[on_false] != self.is_truth[on_true]:
            # One of the two truth values is known: c ? 1 : x is c or x, c ? 0 : x is not c and x.
            if self.is_truth[on_true]:
                condition, on_false, on_true = self.logical_not(condition), on_true, on_false
            if self.values[on_true]:
                return self.logical("or", condition, on_false)
            return self.logical("and", self.logical_not(condition), on_false)
        return self.node("select", condition, on_false, on_true)

    def logical(self, op: str, a: int, b: int) -> int:
        """And, or, and exclusive or of two truth values."""
        u, v = self.values[a], self.values[b]
        if u is not None:
            a, b, u, v = b, a, v, u
        if v is None:
            return a if a == b and op != "xor" else self.node(op, *sorted((a, b)))
        if u is not None:
            return self.constant(float(_NUMPY[op](bool(u), bool(v))))
        if op == "xor":
            return self.logical_not(a) if v else a
        return b if (op == "and") != bool(v) else a

    def logical_not(self, a: int) -> int:
        value = self.values[a]
        if value is not None:
            return self.constant(float(not value))
        return self.args[a][0] if self.ops[a] == "not" else self.node("not", a)

    def operation(self, op: str) -> Callable[..., int]:
        """Function of nodes for the node of this operation on them."""
        return getattr(self, op) if op in _ARITHMETIC else partial(self.apply, op)

    def apply(self, op: str, *args: int) -> int:
        """Any operation by its name."""
        if op in _ARITHMETIC:
            return getattr(self, op)(*args)
        if op in ("and", "or", "xor"):
            return self.logical(op, *args)
        if op == "not":
            return self.logical_not(*args)
        if op in ("eq", "ne") and any(self.is_truth[a] for a in args):
            other = self.logical("xor", *args)
            return other if op == "ne" else self.logical_not(other)
        values = [self.values[a] for a in args]
        if None not in values:
            with np.errstate(all="ignore"):
                return self.constant(float(_NUMPY[op](*values)))
        # truth values as numbers, whose largest or order is asked for
        unit, zero = self.constant(1.0), self.constant(0.0)
        args = tuple(self.select(a, zero, unit) if self.is_truth[a] else a for a in args)
        if op in ("max", "min") and args[0] == args[1]:
            return args[0]
        return self.node(op, *args)

    def less(self, a: int, b: int, *, or_equal: bool) -> int:
        """a < b or a <= b in the order in which NaN is the largest number."""
        a, b = self._without_nan_sign(a), self._without_nan_sign(b)
        tests = [self.apply("ne", n, n) for n in (a, b)]
        self.order_tests.update(tests)
        is_last = tests[1]
        if not or_equal:
            is_last = self.logical("and", is_last, self.logical_not(tests[0]))
        return self.logical("or", self.apply("le" if or_equal else "lt", a, b), is_last)

    def _without_nan_sign(self, n: int) -> int:
        """x of the choice x != x ? NaN : x, by which JAX gives all NaN one sign before it sorts."""
        if self.ops[n] != "select":
            return n
        condition, on_false, on_true = self.args[n]
        is_test = self.ops[condition] == "ne" and len(set(self.args[condition])) == 1
        value = self.values[on_true]
        return on_false if is_test and value is not None and value != value else n

    def sees_nan(self, live: set[int]) -> bool:
        """True if one of these nodes tells NaN from other numbers."""
        is_test = lambda n: self.ops[n] in ("eq", "ne") and len(set(self.args[n])) == 1
        return any(
            self.ops[n] == "is_finite" or (n not in self.order_tests and is_test(n)) for n in live
        )

    def needed(self, outputs: Sequence[int]) -> list[int]:
        """Nodes that the outputs need, each after its arguments, depth first."""
        ops, args = self.ops, self.args
        order: list[int] = []
        visited = bytearray(len(ops))
        for output in outputs:
            # A stack of its own instead of recursion: chains of sums are longer than Python's
            # limit of calls. A node that waits for its arguments stands there as its complement.
            stack = [output]
            while stack:
                node = stack.pop()
                if node < 0:
                    order.append(~node)
                elif not visited[node]:
                    visited[node] = True
                    if ops[node] in LEAVES:
                        order.append(node)
                    else:
                        stack.append(~node)
                        stack += [arg for arg in reversed(args[node]) if not visited[arg]]
        return order


@no_type_check
class Nodes:
    """Array whose entries are nodes of a graph; known arrays are NumPy's."""

    def __init__(self, ids: Any) -> None:
        self.ids = np.asarray(ids)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.ids.shape


def scalarise(graph: Graph, jaxpr: Any, operands: Sequence[Any]) -> list[np.ndarray]:
    """Nodes of a jaxpr's outputs.

    Args:
        jaxpr: `core.ClosedJaxpr` whose constants are known numbers.
        operands: `Nodes` or NumPy arrays, one for each of its inputs.

    Raises:
        NotScalarError: an operation has no scalar form.
    """
    translator = _Translator(graph)
    constants = [np.asarray(c) for c in jaxpr.consts]
    return [translator.ids(x) for x in translator.run(jaxpr.jaxpr, constants, operands)]


def translate(graph: Graph, equation: Any, operands: Sequence[Any]) -> list[np.ndarray]:
    """Nodes of the results of one equation, see `scalarise`."""
    translator = _Translator(graph)
    return [translator.ids(x) for x in translator.equation(equation, list(operands))]


@no_type_check
class _Translator:
    """Translation of jaxprs, equation by equation."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph

    def ids(self, x: Any) -> np.ndarray:
        """Nodes of an array, known or not."""
        if isinstance(x, Nodes):
            return x.ids
        x = np.asarray(x)
        flat = [self.graph.constant(v) for v in x.astype(float).ravel()]
        return np.array(flat, dtype=np.int64).reshape(x.shape)

    def run(self, jaxpr: Any, constants: Sequence[Any], operands: Sequence[Any]) -> list[Any]:
        values: dict[Any, Any] = dict(zip(jaxpr.constvars, constants, strict=True))
        values.update(zip(jaxpr.invars, operands, strict=True))
        read = lambda v: np.asarray(v.val) if isinstance(v, core.Literal) else values[v]
        if jaxpr.effects:
            raise NotScalarError(f"effects {jaxpr.effects}")
        for equation in jaxpr.eqns:
            inputs = [read(v) for v in equation.invars]
            results = self.equation(equation, inputs)
            for variable, result in zip(equation.outvars, results, strict=True):
                # An operation may give numbers where JAX has truth values, as a maximum of two of
                # them does; machine code keeps the two kinds apart.
                if variable.aval.dtype == np.bool_ and isinstance(result, Nodes):
                    result = self.truth(result)
                assert result.shape == variable.aval.shape, equation
                values[variable] = result
        return [read(v) for v in jaxpr.outvars]

    def equation(self, equation: Any, inputs: list[Any]) -> list[Any]:
        name, params = equation.primitive.name, equation.params
        if name == "convert_element_type":
            params = {**params, "old_dtype": np.dtype(equation.invars[0].aval.dtype)}
        # a loop with an unknown number of passes has no handler, and no scalar form
        handler = getattr(self, "_" + name.replace("-", "_"), None)
        if name == "while":
            raise NotScalarError(name)
        if name in MOVES:
            return [self.move(name, params, inputs)]
        if name in _ELEMENTWISE:
            # numbers of a graph are in double precision: bits of integers would be wrong
            is_whole = np.dtype(equation.outvars[0].aval.dtype).kind in "iu"
            if is_whole and name == "div":
                return [self.divide_integers(*inputs)]
            if is_whole and name not in _WHOLE and any(isinstance(x, Nodes) for x in inputs):
                raise NotScalarError(f"{name} of integers")
            return [self.elementwise(_ELEMENTWISE[name], *inputs)]
        if handler is not None:
            result = handler(params, *inputs)
            return result if isinstance(result, list) else [result]
        for key in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
            inner: Any = params.get(key)
            if hasattr(inner, "consts"):
                return self.run(inner.jaxpr, [np.asarray(c) for c in inner.consts], inputs)
            if hasattr(inner, "eqns"):
                return self.run(inner, [], inputs)
        raise NotScalarError(name)

    def truth(self, x: Nodes) -> Nodes:
        """Truth values: true where an entry is not zero."""
        zero = self.graph.constant(0.0)
        test = lambda n: n if self.graph.is_truth[n] else self.graph.apply("ne", n, zero)
        return Nodes(
            np.reshape([test(n) for n in x.ids.ravel().tolist()], x.shape).astype(np.int64)
        )

    # --- entry by entry

    def elementwise(self, op: str, *inputs: Any) -> Any:
        if not any(isinstance(x, Nodes) for x in inputs):
            with np.errstate(all="ignore"):
                result = _NUMPY[op](*inputs)
            if op not in (*COMPARISONS, "is_finite", "and", "or", "xor", "not"):
                result = np.asarray(result).astype(np.result_type(*inputs))
            return np.asarray(result)
        # Python goes through the entries: arrays here have a few entries, and a program is made
        # once for a structure.
        arrays = np.broadcast_arrays(*(self.ids(x) for x in inputs))
        result = list(map(self.graph.operation(op), *(a.ravel().tolist() for a in arrays)))
        return Nodes(np.array(result, dtype=np.int64).reshape(arrays[0].shape))

    def _select_n(self, params: Any, condition: Any, *cases: Any) -> Any:
        if not isinstance(condition, Nodes):
            if not any(isinstance(c, Nodes) for c in cases):
                return np.choose(np.broadcast_to(condition, cases[0].shape).astype(int), cases)
            chosen = np.choose(
                np.broadcast_to(condition, cases[0].shape).astype(int), [self.ids(c) for c in cases]
            )
            return Nodes(chosen)
        if len(cases) != 2:
            raise NotScalarError("select_n of more than two cases")
        a, b = (self.ids(c) for c in cases)
        picks = np.broadcast_to(self.truth(condition).ids, a.shape).ravel().tolist()
        select = self.graph.select
        triples = zip(picks, a.ravel().tolist(), b.ravel().tolist(), strict=True)
        return Nodes(np.array([select(*e) for e in triples], dtype=np.int64).reshape(a.shape))

    def _convert_element_type(self, params: Any, x: Any) -> Any:
        new = np.dtype(params["new_dtype"])
        if not isinstance(x, Nodes):
            return x.astype(new)
        if new.kind not in "fbiu" or new == np.float32:
            raise NotScalarError(f"conversion to {new}")
        if new.kind == "b":
            return self.truth(x)
        if params["old_dtype"].kind == "b":
            unit, zero = self.graph.constant(1.0), self.graph.constant(0.0)
            is_known = lambda n: self.graph.values[n] is not None
            flat = [
                n if is_known(n) else self.graph.select(n, zero, unit)
                for n in x.ids.ravel().tolist()
            ]
            return Nodes(np.array(flat, dtype=np.int64).reshape(x.shape))
        if new.kind in "iu" and params["old_dtype"].kind == "f":
            x = self.elementwise("trunc", x)
        if new.kind == "u" and params["old_dtype"].kind != "u":
            # an integer without a sign would have other bits
            is_negative = self.elementwise("lt", x, np.zeros(()))
            x = self._select_n({}, is_negative, x, np.full(x.shape, np.nan))
        return x

    def divide_integers(self, x: Any, y: Any) -> Any:
        """Quotient of integers, rounded to zero; that of numbers below 2^52 is exact."""
        if not isinstance(x, Nodes) and not isinstance(y, Nodes):
            return np.trunc(np.divide(x, y)).astype(np.result_type(x, y))
        pairs = np.broadcast_arrays(self.ids(x), self.ids(y))
        flat = zip(*(a.ravel().tolist() for a in pairs), strict=True)
        quotients = [self.graph.node("div", *e) for e in flat]
        whole = self.elementwise("trunc", Nodes(np.reshape(quotients, pairs[0].shape)))
        # XLA's quotient by 0 is -1
        is_zero = self.elementwise("eq", Nodes(pairs[1]), np.zeros(()))
        return self._select_n({}, is_zero, whole, np.full(whole.shape, -1.0))

    def _lt_to(self, params: Any, x: Any, y: Any) -> Any:
        return self.in_order(x, y, or_equal=False)

    def _le_to(self, params: Any, x: Any, y: Any) -> Any:
        return self.in_order(x, y, or_equal=True)

    def in_order(self, x: Any, y: Any, *, or_equal: bool) -> Any:
        pairs = np.broadcast_arrays(self.ids(x), self.ids(y))
        flat = zip(*(a.ravel().tolist() for a in pairs), strict=True)
        tests = [self.graph.less(*e, or_equal=or_equal) for e in flat]
        return Nodes(np.reshape(tests, pairs[0].shape).astype(np.int64))

    def _integer_pow(self, params: Any, x: Any) -> Any:
        return self._power(x, params["y"])

    def _power(self, x: Any, exponent: int) -> Any:
        if exponent < 0:
            return self.elementwise("div", np.ones(()), self._power(x, -exponent))
        if exponent == 0:
            return np.ones(x.shape)
        half = self._power(x, exponent // 2) if exponent > 1 else None
        square = x if half is None else self.elementwise("mul", half, half)
        return square if half is None or exponent % 2 == 0 else self.elementwise("mul", square, x)

    def _square(self, params: Any, x: Any) -> Any:
        return self.elementwise("mul", x, x)

    def _rsqrt(self, params: Any, x: Any) -> Any:
        return self.elementwise("div", np.ones(()), self.elementwise("sqrt", x))

    def _round(self, params: Any, x: Any) -> Any:
        if int(params["rounding_method"]) != 1:
            raise NotScalarError("rounding away from zero")
        return self.elementwise("round", x)

    def _logistic(self, params: Any, x: Any) -> Any:
        tail = self.elementwise("exp", self.elementwise("neg", x))
        return self.elementwise("div", np.ones(()), self.elementwise("add", np.ones(()), tail))

    def _clamp(self, params: Any, low: Any, x: Any, high: Any) -> Any:
        return self.elementwise("min", self.elementwise("max", x, low), high)

    def _optimization_barrier(self, params: Any, *inputs: Any) -> list[Any]:
        return list(inputs)

    # --- sums and products

    def fold(self, op: str, x: Any, axes: Sequence[int], start: float) -> Any:
        front = np.moveaxis(self.ids(x), axes, range(len(axes)))
        count = math.prod(front.shape[: len(axes)])
        rows = front.reshape(count, *front.shape[len(axes) :])
        if not count:
            return np.full(rows.shape[1:], start)
        total: Any = Nodes(rows[0])
        for row in rows[1:]:
            total = self.elementwise(op, total, Nodes(row))
        return total

    def _reduce_sum(self, params: Any, x: Any) -> Any:
        return self.fold("add", x, params["axes"], 0.0)

    def _reduce_prod(self, params: Any, x: Any) -> Any:
        return self.fold("mul", x, params["axes"], 1.0)

    def _reduce_max(self, params: Any, x: Any) -> Any:
        return self.fold("max", x, params["axes"], -np.inf)

    def _reduce_min(self, params: Any, x: Any) -> Any:
        return self.fold("min", x, params["axes"], np.inf)

    def _reduce_and(self, params: Any, x: Any) -> Any:
        return self.fold("and", x, params["axes"], 1.0)

    def _reduce_or(self, params: Any, x: Any) -> Any:
        return self.fold("or", x, params["axes"], 0.0)

    def _cumsum(self, params: Any, x: Any) -> Any:
        axis, order = params["axis"], slice(None, None, -1 if params["reverse"] else 1)
        rows = list(np.moveaxis(self.ids(x), axis, 0)[order])
        sums: list[Any] = [Nodes(row) for row in rows[:1]]
        for row in rows[1:]:
            sums.append(self.elementwise("add", sums[-1], Nodes(row)))
        return Nodes(np.moveaxis(np.stack([s.ids for s in sums])[order], 0, axis))

    def _dot_general(self, params: Any, a: Any, b: Any) -> Any:
        (left_axes, right_axes), (left_batch, right_batch) = params["dimension_numbers"]
        if not isinstance(a, Nodes) and not isinstance(b, Nodes):
            a, b = Nodes(self.ids(a)), Nodes(self.ids(b))
        u, v = self.ids(a), self.ids(b)
        free = lambda x, *used: [
            k for k in range(x.ndim) if k not in {j for us in used for j in us}
        ]
        rows, columns = free(u, left_axes, left_batch), free(v, right_axes, right_batch)
        batch = [u.shape[k] for k in left_batch]
        shape = (*batch, *(u.shape[k] for k in rows), *(v.shape[k] for k in columns))
        u = u.transpose(*left_batch, *rows, *left_axes)
        v = v.transpose(*right_batch, *columns, *right_axes)
        depth = math.prod(u.shape[u.ndim - len(left_axes) :])
        if depth == 0 or 0 in shape:
            return np.zeros(shape)
        stack = math.prod(batch)
        row_count = math.prod(shape[len(batch) : len(batch) + len(rows)])
        u = u.reshape(stack, row_count, 1, depth)
        v = v.reshape(stack, 1, math.prod(shape[len(batch) + len(rows) :]), depth)
        total = self.elementwise("mul", Nodes(u[..., 0]), Nodes(v[..., 0]))
        for k in range(1, depth):
            product = self.elementwise("mul", Nodes(u[..., k]), Nodes(v[..., k]))
            total = self.elementwise("add", total, product)
        return Nodes(total.ids.reshape(shape))

    # --- small linear algebra

    def _cholesky(self, params: Any, x: Any) -> Any:
        matrix = self.ids(x)
        flat = [
            self.cholesky_of(m)
            for m in matrix.reshape(math.prod(matrix.shape[:-2]), *matrix.shape[-2:])
        ]
        return Nodes(np.array(flat, dtype=np.int64).reshape(matrix.shape))

    def cholesky_of(self, matrix: np.ndarray) -> np.ndarray:
        g, n = self.graph, len(matrix)
        factor, inverse = np.full((n, n), g.constant(0.0), dtype=np.int64), 0
        for j in range(n):
            for i in range(j, n):
                rest = int(matrix[i, j])
                for k in range(j):
                    rest = g.sub(rest, g.mul(int(factor[i, k]), int(factor[j, k])))
                if i == j:
                    factor[j, j] = g.apply("sqrt", rest)
                    inverse = g.div(g.constant(1.0), int(factor[j, j]))
                else:
                    factor[i, j] = g.mul(rest, inverse)
        return factor

    def _triangular_solve(self, params: Any, a: Any, b: Any) -> Any:
        u, v = self.ids(a), self.ids(b)
        if params["conjugate_a"] and np.iscomplexobj(u):
            raise NotScalarError("complex numbers")
        if not params["left_side"]:
            # x a = b: a' x' = b'
            u, v = np.swapaxes(u, -1, -2), np.swapaxes(v, -1, -2)
        lower = params["lower"] == params["left_side"]
        if params["transpose_a"]:
            u, lower = np.swapaxes(u, -1, -2), not lower
        flat = [
            self.solve_triangle(m, w, lower=lower, unit=params["unit_diagonal"])
            for m, w in zip(
                u.reshape(math.prod(u.shape[:-2]), *u.shape[-2:]),
                v.reshape(math.prod(v.shape[:-2]), *v.shape[-2:]),
                strict=True,
            )
        ]
        x = np.array(flat, dtype=np.int64).reshape(v.shape)
        return Nodes(x if params["left_side"] else np.swapaxes(x, -1, -2))

    def solve_triangle(
        self, a: np.ndarray, b: np.ndarray, *, lower: bool, unit: bool
    ) -> np.ndarray:
        g, n = self.graph, len(a)
        x = np.array(b)
        order = range(n) if lower else range(n - 1, -1, -1)
        for i in order:
            inverse = None if unit else g.div(g.constant(1.0), int(a[i, i]))
            for c in range(x.shape[1]):
                rest = int(x[i, c])
                for k in range(i) if lower else range(n - 1, i, -1):
                    rest = g.sub(rest, g.mul(int(a[i, k]), int(x[k, c])))
                x[i, c] = rest if inverse is None else g.mul(rest, inverse)
        return x

    # --- places

    def move(self, name: str, params: Any, inputs: list[Any]) -> Any:
        """Operation that only moves entries."""
        if any(isinstance(x, Nodes) for x in inputs):
            return Nodes(np.asarray(MOVES[name](params, *map(self.ids, inputs))))
        return np.asarray(MOVES[name](params, *inputs))

    def _split(self, params: Any, x: Any) -> list[Any]:
        cuts = np.cumsum(params["sizes"])[:-1]
        if isinstance(x, Nodes):
            return [Nodes(p) for p in np.split(x.ids, cuts, params["axis"])]
        return list(np.split(x, cuts, params["axis"]))

    def _unstack(self, params: Any, x: Any) -> list[Any]:
        is_known = not isinstance(x, Nodes)
        rows = np.moveaxis(x if is_known else x.ids, params["axis"], 0)
        return [row if is_known else Nodes(row) for row in rows]

    def _iota(self, params: Any) -> Any:
        shape, dimension = params["shape"], params["dimension"]
        line = np.arange(shape[dimension], dtype=params["dtype"])
        spread = line.reshape([-1 if k == dimension else 1 for k in range(len(shape))])
        return np.broadcast_to(spread, shape)

    def _empty2(self, params: Any, *_: Any) -> Any:
        # numbers that a loop overwrites before anything reads them
        return np.zeros((), params["dtype"])

    def _pad(self, params: Any, x: Any, value: Any) -> Any:
        is_known = not isinstance(x, Nodes) and not isinstance(value, Nodes)
        array: Any = x if is_known else self.ids(x)
        fill: Any = value if is_known else self.ids(value)
        for axis, (low, high, inner) in enumerate(params["padding_config"]):
            size = array.shape[axis]
            length = size + max(size - 1, 0) * inner
            line = np.full(
                (*array.shape[:axis], length, *array.shape[axis + 1 :]), fill, dtype=array.dtype
            )
            line[(slice(None),) * axis + (slice(None, None, inner + 1),)] = array
            widths = [(0, 0)] * array.ndim
            widths[axis] = (max(low, 0), max(high, 0))
            line = np.pad(line, widths, constant_values=fill)
            end = line.shape[axis] + min(high, 0)
            array = line[(slice(None),) * axis + (slice(-min(low, 0), end),)]
        return array if is_known else Nodes(array)

    def known_index(self, index: Any) -> np.ndarray:
        if isinstance(index, Nodes):
            values = [self.graph.values[n] for n in index.ids.ravel().tolist()]
            if None in values:
                raise NotScalarError("an index that is computed")
            index = np.array(values).reshape(index.shape)
        return np.asarray(index).astype(int)

    def _dynamic_slice(self, params: Any, x: Any, *starts: Any) -> Any:
        if all(not isinstance(s, Nodes) for s in starts) and not isinstance(x, Nodes):
            sizes = params["slice_sizes"]
            at = [
                min(max(int(s), 0), n - m) for s, n, m in zip(starts, x.shape, sizes, strict=True)
            ]
            return x[tuple(slice(s, s + m) for s, m in zip(at, sizes, strict=True))]
        return Nodes(self.read_window(x, [int(self.ids(s)) for s in starts], params["slice_sizes"]))

    def read_window(self, x: Any, starts: Sequence[int], sizes: Sequence[int]) -> np.ndarray:
        """Nodes of a window of an array that starts at these nodes, moved so that it lies within."""
        graph, limits = self.graph, [n - m for n, m in zip(x.shape, sizes, strict=True)]
        limited = [self.limit_place(s, limit) for s, limit in zip(starts, limits, strict=True)]
        values = [graph.values[s] for s in limited]
        begin = [0 if k is None else int(k) for k in values]
        moving = [d for d, k in enumerate(values) if k is None]
        table = self.find_table(x) if moving else None
        if table is not None:
            number, first, strides, kind = table
            place = graph.constant(0.0)
            for d in moving:
                place = graph.add(place, graph.mul(limited[d], graph.constant(strides[d])))
            grid = np.indices(sizes).reshape(len(sizes), -1)
            offsets = first + np.asarray(strides, int) @ (grid + np.array(begin, int)[:, None])
            flat = [
                graph.node("lookup", place, graph.node("table", number, k, kind))
                for k in offsets.tolist()
            ]
            return np.array(flat, np.int64).reshape(sizes)
        array = self.ids(x)
        pick = lambda at: array[tuple(slice(s, s + m) for s, m in zip(at, sizes, strict=True))]
        if not moving:
            return pick(begin)
        if len(moving) > 1 or limits[moving[0]] >= MOST_CHOICES:
            raise NotScalarError("an index that is computed, of an array that is")
        (d,) = moving
        return self.choose(
            limited[d],
            [pick([*begin[:d], k, *begin[d + 1 :]]) for k in range(limits[d] + 1)],
        )

    def limit_place(self, start: int, limit: int) -> int:
        """Node of a start that is moved to 0 to `limit`."""
        graph = self.graph
        zero = graph.constant(0.0)
        if not limit:
            return zero
        return graph.apply("max", zero, graph.apply("min", graph.constant(limit), start))

    def choose(self, place: int, cases: Sequence[np.ndarray]) -> np.ndarray:
        """Nodes of the case with the number that a node has."""
        result = Nodes(cases[0])
        for k, case in enumerate(cases[1:], start=1):
            is_here = self.graph.apply("eq", place, self.graph.constant(k))
            result = self._select_n(
                {}, Nodes(np.broadcast_to(is_here, case.shape)), result, Nodes(case)
            )
        return result.ids

    def find_table(self, x: Any) -> tuple[int, int, list[int], str] | None:
        """Operand, or known array as -1 and less, first entry, strides and kind; None if it is neither."""
        graph = self.graph
        if not isinstance(x, Nodes):
            values = np.ascontiguousarray(x, float)
            same = (k for k, t in enumerate(graph.tables) if np.array_equal(t, values.ravel()))
            number = next(same, len(graph.tables))
            if number == len(graph.tables):
                graph.tables.append(values.ravel())
            kind = "b" if np.asarray(x).dtype == bool else "f"
            return -1 - number, 0, [k // 8 for k in values.strides], kind
        # The nodes of an operand's entries follow each other: a part of it is a table if its nodes have
        # equal distances along every axis.
        first, ends = int(x.ids.flat[0]), (int(x.ids.min()), int(x.ids.max()))
        if {graph.ops[n] for n in ends} != {"input"} or len({graph.args[n][0] for n in ends}) > 1:
            return None
        number, entry, kind = graph.args[first]
        strides = [
            int(np.take(x.ids, 1, d).flat[0]) - first if n > 1 else 0 for d, n in enumerate(x.shape)
        ]
        regular = first + np.tensordot(strides, np.indices(x.shape), 1)
        return (number, entry, strides, kind) if np.array_equal(regular, x.ids) else None

    def _dynamic_update_slice(self, params: Any, x: Any, update: Any, *starts: Any) -> Any:
        is_known = not isinstance(x, Nodes) and not isinstance(update, Nodes)
        array, part = (x, update) if is_known else (self.ids(x), self.ids(update))
        limits = [n - m for n, m in zip(array.shape, part.shape, strict=True)]
        values = [self.graph.values[int(self.ids(s))] for s in starts]
        moving = [
            d
            for d, (v, limit) in enumerate(zip(values, limits, strict=True))
            if v is None and limit
        ]

        def put(at: Sequence[int]) -> np.ndarray:
            new = np.array(array)
            new[tuple(slice(s, s + m) for s, m in zip(at, part.shape, strict=True))] = part
            return new

        at = [min(max(int(v or 0), 0), limit) for v, limit in zip(values, limits, strict=True)]
        if not moving:
            return put(at) if is_known else Nodes(put(at))
        d, *more = moving
        if more or limits[d] >= MOST_CHOICES:
            raise NotScalarError("a place that is computed, of many")
        place = self.limit_place(int(self.ids(starts[d])), limits[d])
        array, part = self.ids(x), self.ids(update)
        cases = [put([*at[:d], k, *at[d + 1 :]]) for k in range(limits[d] + 1)]
        return Nodes(self.choose(place, cases))

    def _gather_computed(self, params: Any, x: Any, index: Nodes) -> Nodes:
        """Windows of an array that start at computed places."""
        graph, numbers, sizes = self.graph, params["dimension_numbers"], params["slice_sizes"]
        dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
        inner = [m for d, m in enumerate(sizes) if d not in dropped]
        batch = index.shape[:-1]
        result = np.zeros((*batch, *inner), np.int64)
        for at in np.ndindex(*batch):
            starts = [graph.constant(0.0)] * len(sizes)
            for d, n in zip(numbers.start_index_map, index.ids[at].tolist(), strict=True):
                starts[d] = n
            for d, k in zip(
                numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True
            ):
                starts[d] = graph.constant(at[k])
            window = self.read_window(x, starts, sizes).reshape(inner)
            if _fills(params["mode"]):
                window = self.fill_outside(params["fill_value"], x, starts, sizes, window)
            result[at] = window
        offset = numbers.offset_dims
        order = np.argsort([*(d for d in range(result.ndim) if d not in offset), *offset])
        return Nodes(result.transpose(*order))

    def fill_outside(
        self, value: Any, x: Any, starts: Sequence[int], sizes: Sequence[int], window: np.ndarray
    ) -> np.ndarray:
        """Window, or the value (NaN by default) where it would start outside of the array."""
        graph, inside = self.graph, self.graph.constant(1.0)
        for s, n, m in zip(starts, x.shape, sizes, strict=True):
            for op, limit in (("ge", 0.0), ("le", float(n - m))):
                inside = graph.logical("and", inside, graph.apply(op, s, graph.constant(limit)))
        is_inside = Nodes(np.broadcast_to(inside, window.shape))
        value = np.full(window.shape, np.nan if value is None else value)
        return self.ids(self._select_n({}, is_inside, value, Nodes(window)))

    def _gather(self, params: Any, x: Any, index: Any) -> Any:
        if isinstance(index, Nodes) and any(
            self.graph.values[n] is None for n in index.ids.ravel().tolist()
        ):
            return self._gather_computed(params, x, index)
        is_known, index = not isinstance(x, Nodes), self.known_index(index)
        array = x if is_known else x.ids
        numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
        places, outside = _gather_places(
            array.shape, index, numbers.start_index_map, numbers.collapsed_slice_dims,
            numbers.operand_batching_dims, numbers.start_indices_batching_dims, sizes,
            fill=_fills(params["mode"]),
        )  # fmt: skip
        batch = index.ndim - 1
        window = len(numbers.offset_dims)
        order = np.argsort(
            [
                *(d for d in range(batch + window) if d not in numbers.offset_dims),
                *numbers.offset_dims,
            ]
        )
        result = array.reshape(-1)[places] if array.size else np.zeros(places.shape, array.dtype)
        if outside.any():
            fill = params["fill_value"]
            fill = (
                (np.nan if array.dtype.kind == "f" or not is_known else 0) if fill is None else fill
            )
            result[outside] = fill if is_known else self.graph.constant(fill)
        result = result.transpose(*order)
        return result if is_known else Nodes(result)

    def _scatter_with(self, op: str | None, params: Any, x: Any, index: Any, updates: Any) -> Any:
        index = self.known_index(index)
        array, new = np.array(self.ids(x)).reshape(-1), self.ids(updates)
        numbers = params["dimension_numbers"]
        window = list(numbers.update_window_dims)
        rest = [d for d in range(new.ndim) if d not in window]
        sizes, inside = [], iter(window)
        for d in range(len(x.shape)):
            is_dropped = d in numbers.inserted_window_dims or d in numbers.operand_batching_dims
            sizes.append(1 if is_dropped else new.shape[next(inside)])
        places, outside = _gather_places(
            x.shape, index, numbers.scatter_dims_to_operand_dims, numbers.inserted_window_dims,
            numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, sizes, fill=True,
        )  # fmt: skip
        new = new.transpose(*rest, *window)
        for place, is_dropped, update in zip(
            places.ravel().tolist(), outside.ravel().tolist(), new.ravel().tolist(), strict=True
        ):
            if not is_dropped:
                array[place] = (
                    update if op is None else self.graph.apply(op, int(array[place]), update)
                )
        return Nodes(array.reshape(x.shape))

    def _scatter(self, params: Any, *inputs: Any) -> Any:
        return self._scatter_with(None, params, *inputs)

    def _scatter_add(self, params: Any, *inputs: Any) -> Any:
        return self._scatter_with("add", params, *inputs)

    def _scatter_mul(self, params: Any, *inputs: Any) -> Any:
        return self._scatter_with("mul", params, *inputs)

    # --- control flow

    def _native(self, params: Any, *inputs: Any) -> list[Any]:
        jaxpr, rank = params["program"].jaxpr, len(params["lead"])
        constants = [np.asarray(c) for c in jaxpr.consts]

        def run(at: tuple[int, ...]) -> list[Any]:
            # an operand that all rows share has one
            row = lambda x: tuple(min(k, n - 1) for k, n in zip(at, x.shape[:rank], strict=True))
            operands = [Nodes(x.ids[row(x)]) if isinstance(x, Nodes) else x[row(x)] for x in inputs]
            return [self.ids(x) for x in self.run(jaxpr.jaxpr, constants, operands)]

        rows = zip(*map(run, np.ndindex(params["lead"])), strict=True)
        return [Nodes(np.reshape(np.stack(x), (*params["lead"], *x[0].shape))) for x in rows]

    def _cond(self, params: Any, index: Any, *inputs: Any) -> list[Any]:
        branches = params["branches"]
        run = lambda b: self.run(b.jaxpr, [np.asarray(c) for c in b.consts], inputs)
        is_known = index if not isinstance(index, Nodes) else self.graph.values[int(index.ids)]
        if is_known is not None:
            return run(branches[min(max(int(is_known), 0), len(branches) - 1)])
        if len(branches) != 2:
            raise NotScalarError("a choice between more than two")
        truth = self.truth(index)
        pairs = zip(run(branches[0]), run(branches[1]), strict=True)
        return [self._select_n({}, truth, a, b) for a, b in pairs]

    def _custom_linear_solve(self, params: Any, *inputs: Any) -> list[Any]:
        counts, solver = params["const_lengths"], params["jaxprs"].solve
        first = counts.matvec + counts.vecmat
        right_sides = inputs[sum(counts) :]
        constants = [np.asarray(c) for c in solver.consts]
        return self.run(
            solver.jaxpr, constants, [*inputs[first : first + counts.solve], *right_sides]
        )

    def _platform_index(self, params: Any) -> Any:
        # what is chosen by the platform, and this program is for CPUs
        platforms = params["platforms"]
        return np.array(next(k for k, names in enumerate(platforms) if not names or "cpu" in names))

    def _scan(self, params: Any, *inputs: Any) -> list[Any]:
        body = params["jaxpr"]
        fixed, carried = count_carried(params, inputs)
        constants = [np.asarray(c) for c in body.consts]
        carry = list(inputs[fixed : fixed + carried])
        rows = inputs[fixed + carried :]
        row = lambda x, k: Nodes(x.ids[k]) if isinstance(x, Nodes) else x[k]
        passes = range(params["length"])
        outputs: list[list[Any]] = []
        for k in reversed(passes) if params["reverse"] else passes:
            operands = [*inputs[:fixed], *carry, *(row(x, k) for x in rows)]
            results = self.run(body.jaxpr, constants, operands)
            carry = results[:carried]
            outputs.append(results[carried:])
        if params["reverse"]:
            outputs.reverse()
        empty = [np.zeros((0, *v.aval.shape), v.aval.dtype) for v in body.jaxpr.outvars[carried:]]
        stacked = [
            Nodes(np.stack([self.ids(x) for x in operands]))
            for operands in zip(*outputs, strict=True)
        ]
        return [*carry, *(stacked or empty)]


def count_carried(params: Any, inputs: Sequence[Any]) -> tuple[int, int]:
    """Numbers of a scan's operands that are the same in all passes, and that a pass hands on."""
    if "ft_in" in params:  # JAX 0.11
        fixed, carried = (len(list(part)) for part in params["ft_in"].update(inputs).unpack()[:2])
        return fixed, carried
    return params["num_consts"], params["num_carry"]


def _fills(mode: Any) -> bool:
    return "FILL" in str(mode).upper()


def _gather_places(
    shape: Sequence[Any], index: np.ndarray, start_map: Sequence[Any], collapsed: Sequence[Any],
    batched: Sequence[Any], index_batched: Sequence[Any], sizes: Sequence[Any], *, fill: bool,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Flat places that a gather reads or a scatter writes, and whether they are outside.

    Both have the index's batch dimensions, then those of the window that stay.
    """
    rank, rows = len(shape), index.shape[:-1]
    window_axes = [d for d in range(rank) if d not in collapsed and d not in batched]
    grids = (
        np.meshgrid(*(np.arange(sizes[d]) for d in window_axes), indexing="ij")
        if window_axes
        else []
    )
    window = tuple(sizes[d] for d in window_axes)
    places, outside = np.zeros((*rows, *window), int), np.zeros((*rows, *window), bool)
    strides = [math.prod(shape[d + 1 :]) for d in range(rank)]
    for at in np.ndindex(*rows):
        start = [0] * rank
        for d, i in zip(start_map, index[at].tolist(), strict=True):
            start[d] = i
        for d, k in zip(batched, index_batched, strict=True):
            start[d] = at[k]
        out = any(not 0 <= start[d] <= shape[d] - sizes[d] for d in range(rank))
        start = [min(max(s, 0), max(shape[d] - sizes[d], 0)) for d, s in enumerate(start)]
        flat = sum(s * stride for s, stride in zip(start, strides, strict=True))
        places[at] = flat + sum(
            (g * strides[d] for g, d in zip(grids, window_axes, strict=True)), np.zeros(window, int)
        )
        outside[at] = out and fill
    return places, outside


_ELEMENTWISE = {name: name for name in (*BINARY, *COMPARISONS, *UNARY) if name != "round"} | {
    "and": "and", "or": "or", "xor": "xor", "not": "not", "is_finite": "is_finite", "add_any": "add",
}  # fmt: skip

# Operations on integers that are exact in double precision.
_WHOLE = {"add", "sub", "neg", "max", "min", "abs", "sign", "rem", "add_any"}

MOVES: dict[str, Callable[..., np.ndarray]] = {
    "reshape": lambda p, x: x.reshape(p["new_sizes"]),
    "squeeze": lambda p, x: np.squeeze(x, tuple(p["dimensions"])),
    "expand_dims": lambda p, x: np.expand_dims(x, tuple(p["dimensions"])),
    "transpose": lambda p, x: np.transpose(x, p["permutation"]),
    "rev": lambda p, x: np.flip(x, p["dimensions"]),
    "concatenate": lambda p, *xs: np.concatenate(xs, p["dimension"]),
    "stack": lambda p, *xs: np.stack(xs, p.get("axis", 0)),
    "copy": lambda p, x: x,
    "copy_p": lambda p, x: x,
    "stop_gradient": lambda p, x: x,
    "slice": lambda p, x: x[
        tuple(
            slice(a, b, c)
            for a, b, c in zip(
                p["start_indices"], p["limit_indices"], p["strides"] or (1,) * x.ndim, strict=True
            )
        )
    ],
    "broadcast_in_dim": lambda p, x: np.broadcast_to(
        x.reshape(
            [
                x.shape[p["broadcast_dimensions"].index(k)] if k in p["broadcast_dimensions"] else 1
                for k in range(len(p["shape"]))
            ]
        ),
        p["shape"],
    ),
}


def is_scalar(aval: Any) -> bool:
    """True for arrays whose entries a graph can hold."""
    return aval.dtype in (np.float64, np.bool_, np.int32, np.int64)


def make_operands(
    graph: Graph, avals: Sequence[Any], known_entries: Sequence[np.ndarray | None] = ()
) -> list[Nodes]:
    """Inputs of a graph for arguments of these shapes; `NotScalarError` for types without scalar form.

    Args:
        known_entries: values of entries that are known, those of the others NaN; None for none.
    """
    operands = []
    for number, aval in enumerate(avals):
        if not is_scalar(aval):
            raise NotScalarError(f"an argument of type {aval.dtype}")
        kind = "b" if aval.dtype == np.bool_ else "f"
        nodes = graph.add_inputs(number, math.prod(aval.shape), kind).reshape(aval.shape)
        values = known_entries[number] if number < len(known_entries) else None
        if values is not None:
            for place in map(tuple, np.argwhere(~np.isnan(values))):
                nodes[place] = graph.constant(float(values[place]))
        operands.append(Nodes(nodes))
    return operands


# Sums in which the inputs behind products with 0 are collected.
_SUMS = 8


def make_graph(
    jaxpr: Any, most_nodes: int, known_entries: Sequence[np.ndarray | None] = ()
) -> tuple[Graph, list[np.ndarray]]:
    """Scalar program of a closed jaxpr: its graph, and the nodes of its outputs.

    Args:
        known_entries: see `make_operands`.

    Where NaN and infinities of inputs could be lost in products with 0, and the function itself does
    not look for them, 0 times those inputs is added to all outputs that are numbers.
    """
    graph = Graph(most_nodes)
    operands = make_operands(graph, [v.aval for v in jaxpr.jaxpr.invars], known_entries)
    outputs = scalarise(graph, jaxpr, operands)
    for aval in jaxpr.out_avals:
        if not is_scalar(aval):
            raise NotScalarError(f"a result of type {aval.dtype}")
    return graph, add_dropped(graph, outputs, jaxpr.out_avals)


@no_type_check
def add_dropped(
    graph: Graph, outputs: Sequence[np.ndarray], avals: Sequence[Any]
) -> list[np.ndarray]:
    """Outputs plus 0 times the inputs that were lost in products with 0; the graph is then complete.

    Args:
        avals: types of the outputs.
    """
    live = set(graph.needed([n for out in outputs for n in out.ravel().tolist()]))
    leaves = [n for n in graph.needed(sorted(graph.dropped)) if graph.ops[n] == "input"]
    leaves = [n for n in leaves if graph.args[n][2] == "f"]
    if leaves and live and not graph.sees_nan(live):
        zero = graph.constant(0.0)
        # some sums side by side, as each addition waits for the one before
        sums = [graph.node("mul", leaf, zero) for leaf in leaves[:_SUMS]]
        for k, leaf in enumerate(leaves[_SUMS:]):
            sums[k % _SUMS] = graph.node("add", graph.node("mul", leaf, zero), sums[k % _SUMS])
        poison = sums[0]
        for other in sums[1:]:
            poison = graph.node("add", poison, other)
        numbers = [np.dtype(a.dtype) == np.float64 for a in avals]
        outputs = [
            np.array(
                [graph.node("add", n, poison) for n in out.ravel().tolist()], np.int64
            ).reshape(out.shape)
            if number
            else out
            for out, number in zip(outputs, numbers, strict=True)
        ]
    # most of the memory, which only making it needs
    graph._known.clear()
    return list(outputs)
