"""Order of the operations of a scalar program, and which of its numbers are in registers.

A processor begins several operations in each cycle, those whose arguments are ready. In the order in
which a program was made, depth first, most operations read the result of one just before, which takes four
cycles, and the processor waits. Here an operation comes when its arguments are ready; of several such the
first in the old order, so that numbers are read soon after they were made (list scheduling).

A program has many more numbers than a processor has registers. The one that gives way is the one that is
read last, which takes the fewest accesses to memory (Belady). LLVM makes worse choices for thousands of
instructions without a branch, and takes longer for them. Operands are not kept: they are in memory anyway.

Sources: K. D. Cooper, L. Torczon, Engineering a Compiler (2012), sections 12.3 (list scheduling) and 13.3
(allocation of registers in straight-line code); L. A. Belady, A study of replacement algorithms for a
virtual-storage computer, IBM Systems Journal 5 (1966).
"""

import heapq
from collections.abc import Callable, Sequence
from typing import no_type_check

from .graph import LEAVES, Graph

# Cycles until the result of an operation is ready, on processors of the last ten years; others take as long
# as a sum.
_LATENCY = {"div": 13, "sqrt": 20, "sin": 60, "cos": 60}
_SUM = 4
# Cycles in which a processor begins one operation, as measured on programs of mechanisms.
_CYCLES = 0.8


@no_type_check
class Schedule:
    """Operations of a program in an order in which few wait for their arguments.

    Attributes:
        steps: the operations. A change of sign is one only where it is an output: otherwise it is part of
            the operations that read it. reads: nodes whose numbers each of them reads.
    """

    def __init__(self, graph: Graph, outputs: Sequence[int]) -> None:
        results = set(outputs)
        is_step = lambda n: graph.ops[n] not in LEAVES and (graph.ops[n] != "neg" or n in results)
        steps = [n for n in range(len(graph.ops)) if is_step(n)]
        reads = [_find_reads(graph, node) for node in steps]
        order = _arrange(graph, steps, reads)
        self.steps = [steps[k] for k in order]
        self.reads = [reads[k] for k in order]


@no_type_check
def _find_reads(graph: Graph, node: int) -> list[int]:
    nodes: list[int] = []
    for arg in graph.args[node]:
        while graph.ops[arg] == "neg":
            arg = graph.args[arg][0]
        if graph.ops[arg] not in ("constant", "table") and arg not in nodes:
            nodes.append(arg)
    return nodes


@no_type_check
def _arrange(graph: Graph, steps: Sequence[int], reads: Sequence[Sequence[int]]) -> list[int]:
    """Order of operations, by their numbers in a list in which each stands after its arguments."""
    place = {node: k for k, node in enumerate(steps)}
    readers: list[list[int]] = [[] for _ in steps]
    missing = [0] * len(steps)
    for k, nodes in enumerate(reads):
        for node in nodes:
            # operands are there from the start
            if node in place:
                readers[place[node]].append(k)
                missing[k] += 1
    ready = [k for k, count in enumerate(missing) if not count]
    waiting: list[tuple[float, int]] = []
    begin = [0.0] * len(steps)
    order, now = [], 0.0
    while ready or waiting:
        while waiting and (not ready or waiting[0][0] <= now):
            start, k = heapq.heappop(waiting)
            now = max(now, start)
            heapq.heappush(ready, k)
        k = heapq.heappop(ready)
        order.append(k)
        finish = now + _LATENCY.get(graph.ops[steps[k]], _SUM)
        now += _CYCLES
        for reader in readers[k]:
            begin[reader] = max(begin[reader], finish)
            missing[reader] -= 1
            if not missing[reader]:
                heapq.heappush(waiting, (begin[reader], reader))
    return order


@no_type_check
class Registers:
    """Names of the numbers that are in registers while a program is written.

    Args:
        schedule: the program.
        most: numbers that are in registers between two operations.
        is_free: whether a node can be had again without having been stored, as operands in memory.
        store: writes the instruction that stores a number at a place in memory, (node, name, place).

    Attributes:
        names: names of numbers in registers. places: places in memory of those that were stored.
        size: number of places.
    """

    def __init__(
        self,
        schedule: Schedule,
        most: int,
        is_free: Callable[[int], bool],
        store: Callable[[int, str, int], None],
    ) -> None:
        self.names: dict[int, str] = {}
        self.places: dict[int, int] = {}
        self.size = 0
        self._schedule, self._most, self._is_free, self._store = schedule, most, is_free, store
        self._unused: list[int] = []
        # operations that are to read a node, the next one last
        self._readers: dict[int, list[int]] = {}
        for k in range(len(schedule.reads) - 1, -1, -1):
            for node in schedule.reads[k]:
                self._readers.setdefault(node, []).append(k)

    def put(self, node: int, name: str) -> None:
        """Remember the name of a number, if it is to be read."""
        if node in self._readers:
            self.names[node] = name

    def finish(self, k: int) -> None:
        """Forget what no operation after number k reads, and store what has no room."""
        for node in self._schedule.reads[k]:
            self._readers[node].pop()
            if self._readers[node]:
                continue
            del self._readers[node]
            self.names.pop(node, None)
            # the same few places again and again are near at hand
            if node in self.places:
                self._unused.append(self.places.pop(node))
        while len(self.names) > self._most:
            last = max(self.names, key=lambda node: self._readers[node][-1])
            self._keep(last)
            del self.names[last]

    def leave(self) -> None:
        """Store all numbers, at the end of a function that others follow."""
        for node in self.names:
            self._keep(node)
        self.names.clear()

    def _keep(self, node: int) -> None:
        if self._is_free(node) or node in self.places:
            return
        if not self._unused:
            self._unused.append(self.size)
            self.size += 1
        self.places[node] = self._unused.pop()
        self._store(node, self.names[node], self.places[node])
