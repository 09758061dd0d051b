"""Zeros and ones of a model that its compiled programs take for structure.

Most numbers of a model's frames and axes are 0, 1 or -1, which makes up to half of its operations
needless. Which they are is read from the arguments of a program (`find_structure`) and is a part of what
the program is found by, as shapes are; numbers that JAX traces have no structure. `fold_structure`
hands it on through the traced program to the machine code that the program calls. By then all
derivatives and batches have been taken, with every entry a variable: none is lost.
"""

import math
import weakref
from collections.abc import Callable, Sequence
from functools import cache, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun

from .graph import Graph, NotScalarError, count_carried, is_scalar, make_operands, translate
from .program import Recursion, is_on, native_p

# Values of the entries of an array that are known, those of the others NaN; None where none is known.
Known = np.ndarray | None

# Entries of the operands and results of an operation that is done with known entries.
MOST_ENTRIES = 4096

# Leaves of arguments by number, with the codes of all their entries: their value, or 2 for any.
Structure = tuple[tuple[int, bytes], ...]

Kind = TypeVar("Kind", bound=type)

# Fields of classes by the values that are structure in them.
_FIELDS: dict[type, dict[str, tuple[float, ...]]] = {}

_ZERO, _UNIT = (0.0,), (0.0, 1.0, -1.0)
_NUMBER = 2


def has_structure(*, zero: Sequence[str] = (), unit: Sequence[str] = ()) -> Callable[[Kind], Kind]:
    """Decorator of a class of pytrees whose arrays in the fields have structure.

    Args:
        zero: fields whose zeros are structure. unit: those of frames and axes, whose 1 and -1 are, too.
    """

    def mark(kind: Kind) -> Kind:
        _FIELDS[kind] = dict.fromkeys(zero, _ZERO) | dict.fromkeys(unit, _UNIT)
        return kind

    return mark


@cache
def _find_places(tree: Any) -> dict[int, tuple[float, ...]]:
    """Numbers of the leaves that have structure, with its values."""
    numbered = jax.tree.unflatten(tree, list(range(tree.num_leaves)))
    nodes = jax.tree.leaves(numbered, is_leaf=lambda node: type(node) in _FIELDS)
    places = {
        leaf: values
        for node in nodes
        for field, values in _FIELDS.get(type(node), {}).items()
        for leaf in jax.tree.leaves(getattr(node, field))
    }
    return dict(sorted(places.items()))


def find_structure(args: Any) -> Structure:
    """Entries of arguments' arrays that are structure; none where machine code is turned off."""
    if not is_on():
        return ()
    leaves, tree = jax.tree.flatten(args)
    places = _find_places(tree).items()
    codes = ((place, _encode(leaves[place], values)) for place, values in places)
    return tuple((place, code) for place, code in codes if code)


# Codes of JAX's arrays, which do not change, by identity and values: the same model comes with every call.
_codes: dict[tuple[int, tuple[float, ...]], tuple[weakref.ref[Any], bytes]] = {}


def _encode(leaf: Any, values: tuple[float, ...]) -> bytes:
    """Codes of an array's entries; empty for a leaf without structure."""
    key = (id(leaf), values)
    entry = _codes.get(key)
    if entry is not None and entry[0]() is leaf:
        return entry[1]
    if not eqx.is_array(leaf) or leaf.dtype != np.float64:
        return b""
    array = np.asarray(leaf)
    codes = np.full(array.shape, _NUMBER, np.int8)
    for value in values:
        codes[array == value] = value
    if isinstance(leaf, jax.Array):
        _codes[key] = weakref.ref(leaf, lambda _: _codes.pop(key, None)), codes.tobytes()
    return codes.tobytes()


def choose_structure(first: dict[Any, Structure], key: Any, structure: Structure) -> Structure:
    """Structure of the program for these numbers: that of the first ones, or none where they differ.

    So there are two programs for a form of arguments at most.

    Args:
        first: structures of the first numbers by key. key: what has the same leaves and sizes of arrays.
    """
    chosen = first.setdefault(key, structure)
    return chosen if _agrees(structure, chosen) else ()


def _agrees(structure: Structure, other: Structure) -> bool:
    """True if what is made for the other structure holds for numbers of this one."""
    if structure == other:
        return True
    pairs = zip(structure, other, strict=True)
    codes = [[np.frombuffer(codes, np.int8) for _, codes in pair] for pair in pairs]
    return all(((b == _NUMBER) | (a == b)).all() for a, b in codes)


def read_structure(structure: Structure, args: Any) -> list[Known]:
    """Known entries of the arrays among arguments."""
    codes, known_entries = dict(structure), []
    for place, leaf in enumerate(jax.tree.leaves(args)):
        if place in codes:
            code = np.frombuffer(codes[place], np.int8).reshape(leaf.shape)
            known_entries.append(np.where(code == _NUMBER, np.nan, code))
        elif eqx.is_array(leaf):
            known_entries.append(None)
    return known_entries


def rely_on(function: Callable[..., Any], structure: Structure) -> Callable[..., Any]:
    """Function to be compiled, for arguments of this structure and with that of its constants."""

    @wraps(function)
    def run(*args: Any, **keywords: Any) -> Any:
        traced, shapes, static = eqx.filter_make_jaxpr(function)(*args, **keywords)
        folded = fold_structure(traced, read_structure(structure, (args, keywords)))
        values = jaxpr_as_fun(folded)(*filter(eqx.is_array, jax.tree.leaves((args, keywords))))
        outputs = [_as_array(*of) for of in zip(values, traced.out_avals, strict=True)]
        return eqx.combine(jax.tree.unflatten(jax.tree.structure(shapes), outputs), static)

    return run


def _as_array(value: Any, aval: Any) -> Any:
    """Result of a jaxpr as an array; one that is a constant comes as a number."""
    if eqx.is_array(value):
        return value
    kind = {"b": bool, "i": int, "f": float}.get(aval.dtype.kind)
    return jnp.asarray(kind(value)) if aval.weak_type and kind else jnp.asarray(value, aval.dtype)


def fold_structure(jaxpr: Any, known_entries: Sequence[Known]) -> Any:
    """Closed jaxpr whose machine code is made for the known entries of its arguments."""
    return _Fold().fold_closed(jaxpr, known_entries)[0]


class _Fold:
    """Pass through a jaxpr and those within it; each is done once for the same known entries."""

    def __init__(self) -> None:
        self._folded: dict[Any, tuple[Any, list[Known], Any]] = {}

    def fold_closed(self, closed: Any, known_entries: Sequence[Known]) -> tuple[Any, list[Known]]:
        """Closed jaxpr made for its known arguments, and what is known of its results."""
        jaxpr, results = self.fold(
            closed.jaxpr, [_read_units(c) for c in closed.consts], known_entries
        )
        return (closed if jaxpr is closed.jaxpr else closed.replace(jaxpr=jaxpr)), results

    def fold(
        self, jaxpr: Any, constants: Sequence[Known], known_entries: Sequence[Known]
    ) -> tuple[Any, list[Known]]:
        """Jaxpr made for its known constants and arguments, and what is known of its results."""
        entries = [*constants, *known_entries]
        if all(x is None for x in entries):
            return jaxpr, [None] * len(jaxpr.outvars)
        key = (id(jaxpr), tuple(None if x is None else x.tobytes() for x in entries))
        if key not in self._folded:
            # the jaxpr is kept with its result, so that no other gets its identity
            self._folded[key] = (*self._fold_equations(jaxpr, entries), jaxpr)
        return self._folded[key][:2]

    def _fold_equations(self, jaxpr: Any, entries: Sequence[Known]) -> tuple[Any, list[Known]]:
        values = {
            variable: x
            for variable, x in zip([*jaxpr.constvars, *jaxpr.invars], entries, strict=True)
            if x is not None
        }

        def read(atom: Any) -> Known:
            return _read_units(atom.val) if hasattr(atom, "val") else values.get(atom)

        equations, has_changed = [], False
        for equation in jaxpr.eqns:
            inputs = [read(atom) for atom in equation.invars]
            params, results = self._fold_equation(equation, inputs)
            if params is not equation.params:
                has_changed = True
                equation = equation.replace(params=params)
            equations.append(equation)
            values.update(
                (v, x) for v, x in zip(equation.outvars, results, strict=True) if x is not None
            )
        results = [read(atom) for atom in jaxpr.outvars]
        return (jaxpr.replace(eqns=equations) if has_changed else jaxpr), results

    def _fold_equation(self, equation: Any, known_entries: list[Known]) -> tuple[Any, list[Known]]:
        """Parameters of an equation made for its known operands, and what is known of its results."""
        params, name = equation.params, equation.primitive.name
        unknown: list[Known] = [None] * len(equation.outvars)
        if all(x is None for x in known_entries):
            return params, unknown
        if equation.primitive is native_p:
            params = _fold_native(params, known_entries)
            return params, _read_results(params)
        if name == "while":
            return self._fold_while(params, known_entries)
        if name == "scan":
            return self._fold_scan(params, known_entries)
        if name == "cond":
            branches = [
                self.fold_closed(branch, known_entries[1:]) for branch in params["branches"]
            ]
            results = [_meet(xs) for xs in zip(*(results for _, results in branches), strict=True)]
            return {**params, "branches": tuple(branch for branch, _ in branches)}, results
        for key in ("jaxpr", "call_jaxpr"):
            inner = params.get(key)
            if hasattr(inner, "consts") and len(inner.jaxpr.invars) == len(known_entries):
                folded, results = self.fold_closed(inner, known_entries)
            elif hasattr(inner, "eqns") and len(inner.invars) == len(known_entries):
                folded, results = self.fold(inner, [], known_entries)
            else:
                continue
            return (params if folded is inner else {**params, key: folded}), results
        return params, _evaluate(equation, known_entries) or unknown

    def _fold_body(
        self, body: Any, fixed: list[Known], start: list[Known], rows: list[Known]
    ) -> tuple[Any, list[Known], list[Known]]:
        """Pass of a loop, what is known of its carry in every pass, and of its other results."""
        # of a carry, what every pass hands on as it is
        inputs, outputs = body.jaxpr.invars[len(fixed) :], body.jaxpr.outvars
        carried = [x if a is b else None for x, a, b in zip(start, inputs, outputs, strict=False)]
        folded, results = self.fold_closed(body, [*fixed, *carried, *rows])
        return folded, carried, results[len(start) :]

    def _fold_while(self, params: Any, known_entries: list[Known]) -> tuple[Any, list[Known]]:
        conditions, fixed = params["cond_nconsts"], params["body_nconsts"]
        first, middle = known_entries[:conditions], known_entries[conditions : conditions + fixed]
        start = known_entries[conditions + fixed :]
        body, carried, _ = self._fold_body(params["body_jaxpr"], middle, start, [])
        condition, _ = self.fold_closed(params["cond_jaxpr"], [*first, *carried])
        return {**params, "body_jaxpr": body, "cond_jaxpr": condition}, carried

    def _fold_scan(self, params: Any, known_entries: list[Known]) -> tuple[Any, list[Known]]:
        fixed, carried = count_carried(params, known_entries)
        rows = [_meet_rows(x, 1) for x in known_entries[fixed + carried :]]
        start = known_entries[fixed : fixed + carried]
        body, carry, results = self._fold_body(params["jaxpr"], known_entries[:fixed], start, rows)
        length = params["length"]
        stacked: list[Known] = [
            None if x is None else np.broadcast_to(x, (length, *x.shape)) for x in results
        ]
        return {**params, "jaxpr": body}, [*carry, *stacked]


def _fold_native(params: Any, known_entries: list[Known]) -> Any:
    program, rank = params["program"], len(params["lead"])
    rows = [_meet_rows(x, rank) for x in known_entries]
    if isinstance(program, Recursion):
        # batches of a loop are XLA's, with the machine code that it calls
        jaxpr = fold_structure(program.jaxpr, rows)
        return {**params, "program": program.fold_loop(rows, jaxpr)}
    return {**params, "program": program.fold(rows)}


def _read_results(params: Any) -> list[Known]:
    """Entries of the results of machine code that are known."""
    program, lead = params["program"], params["lead"]
    graph = None if isinstance(program, Recursion) else program.graph()
    if graph is None:
        return [None] * len(program.outputs)
    rows = [
        _read_nodes(graph[0], nodes, a) for nodes, a in zip(graph[1], program.outputs, strict=True)
    ]
    return [None if x is None else np.broadcast_to(x, (*lead, *x.shape)) for x in rows]


def _evaluate(equation: Any, known_entries: list[Known]) -> list[Known] | None:
    """Entries of the results of a small operation that are known; None where it has no scalar form."""
    avals = [v.aval for v in (*equation.invars, *equation.outvars)]
    if sum(math.prod(a.shape) for a in avals) > MOST_ENTRIES or not all(map(is_scalar, avals)):
        return None
    graph = Graph(MOST_ENTRIES)
    operands: list[Any] = make_operands(graph, [v.aval for v in equation.invars], known_entries)
    for k, atom in enumerate(equation.invars):
        if hasattr(atom, "val"):
            operands[k] = np.asarray(atom.val)
    try:
        results = translate(graph, equation, operands)
    except NotScalarError:
        return None
    return [_read_nodes(graph, x, v.aval) for x, v in zip(results, equation.outvars, strict=True)]


def _read_nodes(graph: Graph, nodes: np.ndarray, aval: Any) -> Known:
    """Values of nodes that are known numbers."""
    if np.dtype(aval.dtype) != np.float64:
        return None
    values = [graph.values[n] for n in nodes.ravel().tolist()]
    if all(value is None for value in values):
        return None
    return np.array([np.nan if v is None else v for v in values]).reshape(nodes.shape)


def _read_units(value: Any) -> Known:
    """Known entries of a constant."""
    is_array = isinstance(value, np.ndarray | np.generic | float | jax.Array)
    if not is_array or getattr(value, "dtype", np.float64) != np.float64:
        return None
    array = np.asarray(value, float)
    is_unit = np.isin(array, _UNIT)
    return np.where(is_unit, array, np.nan) if is_unit.any() else None


def _meet_rows(x: Known, rank: int) -> Known:
    """Entries that are known and equal along the first `rank` dimensions."""
    if x is None or not x.size:
        return None
    return _meet([*map(np.asarray, x.reshape(-1, *x.shape[rank:]))])


def _meet(arrays: Sequence[Known]) -> Known:
    """Entries that are known and equal in all arrays."""
    first = arrays[0]
    for other in arrays[1:]:
        if first is None or other is None:
            return None
        first = np.where(first == other, first, np.nan)
    return None if first is None or np.isnan(first).all() else first
