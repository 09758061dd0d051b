"""Transpose of a scalar program that is linear in some of its operands.

The derivative of a function is linear in the tangents. From its graph that for the other direction follows
without tracing: of each operation, from the last to the first, the cotangent of its result is passed on to
its arguments, by the rules for sums, products with numbers that do not move, and choices.
"""

import math
from collections.abc import Sequence
from typing import Any, no_type_check

import numpy as np

from .graph import Graph, NotScalarError, add_dropped, make_operands


@no_type_check
def transpose_graph(
    program: tuple[Graph, Sequence[np.ndarray]],
    known_mask: Sequence[bool],
    cotangent_mask: Sequence[bool],
    avals: Sequence[Any],
    result_avals: Sequence[Any],
    most_nodes: int,
    known_entries: Sequence[np.ndarray | None] = (),
) -> tuple[Graph, list[np.ndarray]]:
    """Graph of (known operands, cotangents of wanted results) for the cotangents of the other operands.

    Args:
        program: graph and outputs of a program that is linear in the operands that are not known.
        known_mask: operands that are known. cotangent_mask: results whose cotangents are given.
        avals: shapes and types of the operands of the transpose. result_avals: those of its results.
        known_entries: see `make_operands`, for the operands of the transpose.

    Raises:
        NotScalarError: an operation is not linear, or there are more than `most_nodes`.
    """
    source, results = program
    results = [
        x.ravel().tolist()
        for x, is_wanted in zip(results, cotangent_mask, strict=True)
        if is_wanted
    ]
    order = source.needed([n for result in results for n in result])
    graph = Graph(most_nodes)
    graph.tables = source.tables
    operands = [x.ids.ravel().tolist() for x in make_operands(graph, avals, known_entries)]
    copies, linear = _copy_known(graph, source, order, known_mask, operands)
    cotangents: dict[int, int] = {}

    def add(node: int, cotangent: int) -> None:
        if node in linear:
            before = cotangents.get(node)
            cotangents[node] = cotangent if before is None else graph.add(before, cotangent)
        elif graph.values[copies[node]] != 0.0:
            raise NotScalarError("a part that does not move")

    zero = graph.constant(0.0)
    for result, seeds in zip(results, operands[sum(known_mask) :], strict=True):
        for node, cotangent in zip(result, seeds, strict=True):
            add(node, cotangent)
    for node in reversed(order):
        op, args = source.ops[node], source.args[node]
        if node not in cotangents or op == "input":
            continue
        cotangent, (first, *others) = cotangents[node], args
        if op in ("add", "sub"):
            add(first, cotangent)
            add(others[0], cotangent if op == "add" else graph.neg(cotangent))
        elif op == "neg":
            add(first, graph.neg(cotangent))
        elif op == "mul":
            moving, factor = args if first in linear else reversed(args)
            add(moving, graph.mul(cotangent, copies[factor]))
        elif op == "div":
            add(first, graph.div(cotangent, copies[others[0]]))
        else:
            condition, (on_false, on_true) = copies[first], others
            add(on_false, graph.select(condition, cotangent, zero))
            add(on_true, graph.select(condition, zero, cotangent))
    entries = {
        source.args[n][:2]: cotangents.get(n, zero) for n in linear if source.ops[n] == "input"
    }
    outputs = []
    unknown = [k for k, is_known in enumerate(known_mask) if not is_known]
    for k, aval in zip(unknown, result_avals, strict=True):
        flat = [entries.get((k, place), zero) for place in range(math.prod(aval.shape))]
        outputs.append(np.array(flat, np.int64).reshape(aval.shape))
    return graph, add_dropped(graph, outputs, result_avals)


@no_type_check
def _copy_known(
    graph: Graph,
    source: Graph,
    order: Sequence[int],
    known_mask: Sequence[bool],
    operands: Sequence[Sequence[int]],
) -> tuple[dict[int, int], set[int]]:
    """Nodes of a graph for those of another that do not move, and those of the other that do."""
    numbers = [k for k, is_known in enumerate(known_mask) if is_known]
    places = {k: place for place, k in enumerate(numbers)}
    copies: dict[int, int] = {}
    linear: set[int] = set()
    for node in order:
        op, args = source.ops[node], source.args[node]
        if op == "input" and args[0] in places:
            copies[node] = operands[places[args[0]]][args[1]]
        elif op == "input":
            linear.add(node)
        elif op == "constant":
            copies[node] = graph.constant(*args)
        elif op == "table":
            if args[0] >= 0 and args[0] not in places:
                raise NotScalarError("a table that moves")
            copies[node] = graph.node(op, places.get(args[0], args[0]), *args[1:])
        elif any(arg in linear for arg in args):
            _check_linear(op, [arg in linear for arg in args])
            linear.add(node)
        else:
            same = [copies[arg] for arg in args]
            if op == "select":
                copies[node] = graph.select(*same)
            elif op == "lookup":
                copies[node] = graph.node(op, *same)
            else:
                copies[node] = graph.apply(op, *same)
            if node in source.order_tests:
                graph.order_tests.add(copies[node])
    return copies, linear


def _check_linear(op: str, moves: Sequence[bool]) -> None:
    """Raise `NotScalarError` if an operation is not linear in those of its arguments that move."""
    first, *others = moves
    is_linear = {
        "add": True,
        "sub": True,
        "neg": True,
        "mul": sum(moves) == 1,
        "div": not any(others),
        "select": not first,
    }
    if not is_linear.get(op, False):
        raise NotScalarError(f"{op} of numbers that move")
