"""Order of a program's operations, its numbers in registers and in memory, and its bits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.math.native import llvm
from stmuav_jax.math.native.graph import LEAVES, Graph, make_graph
from stmuav_jax.math.native.program import native
from stmuav_jax.math.native.schedule import Registers, Schedule

pytestmark = pytest.mark.skipif(not llvm.available(), reason="llvmlite is not installed")


@pytest.fixture(autouse=True)
def code_on(machine_code):
    """Machine code for the time of a test, also where the environment turns it off."""
    machine_code(True)


MATRIX = np.random.default_rng(0).normal(size=(6, 6)) + 6.0 * np.eye(6)
VECTOR = np.linspace(-1.0, 1.0, 6)


def eliminated(A, b):
    """Results of an elimination, whose numbers live long; signs, truth values, sines with and without cosines."""
    b = jnp.sin(b) - jnp.where(b > 0, jnp.cos(b), -b)
    for k in range(len(b)):
        factor = jnp.where(jnp.arange(len(b)) > k, A[:, k] / A[k, k], 0.0)
        A, b = A - jnp.outer(factor, A[k]), b - factor * b[k]
    # an operand, numbers, and a sign alone as results
    return A, b, -b, A > 0.5, jnp.cos(A[0]), jnp.zeros(2), A[0, 0]


def scheduled():
    jaxpr = jax.make_jaxpr(eliminated)(MATRIX, VECTOR)
    graph, outputs = llvm.fuse(*flattened(make_graph(jaxpr, 10_000)))
    return graph, outputs, Schedule(graph, outputs)


def flattened(made):
    graph, outputs = made
    return graph, [n for out in outputs for n in out.ravel().tolist()]


def test_operations_come_once_and_after_their_arguments():
    graph, outputs, schedule = scheduled()
    place = {node: k for k, node in enumerate(schedule.steps)}
    wanted = {n for n in outputs if graph.ops[n] not in LEAVES}
    signs = {n for n in range(len(graph.ops)) if graph.ops[n] == "neg"} - wanted
    operations = {n for n in range(len(graph.ops)) if graph.ops[n] not in LEAVES} - signs
    assert len(place) == len(schedule.steps)
    assert set(place) == operations
    for k, reads in enumerate(schedule.reads):
        assert all(graph.ops[n] == "input" or place[n] < k for n in reads)


def chain_and_tree():
    """Two independent chains of eight sums, one made after the other, and their sum."""
    graph = Graph(1000)
    x, y, one = graph.node("input", 0, 0, "f"), graph.node("input", 0, 1, "f"), graph.constant(1.0)
    ends = []
    for start in (x, y):
        node = start
        for _ in range(8):
            node = graph.node("add", graph.node("mul", node, node), one)
        ends.append(node)
    return graph, [graph.node("add", *ends)]


def test_operations_that_would_wait_let_others_pass():
    graph, outputs = chain_and_tree()
    schedule = Schedule(graph, outputs)
    follows = lambda k: schedule.steps[k - 1] in schedule.reads[k]
    # the chains alternate: only the last sum needs the operation before it
    assert sum(follows(k) for k in range(1, len(schedule.steps))) == 1


@pytest.mark.parametrize("most", [3, 6, 100])
def test_as_few_numbers_are_stored_as_have_no_room(most):
    graph, _, schedule = scheduled()
    stored = []
    registers = Registers(
        schedule, most, lambda n: graph.ops[n] == "input", lambda n, *_: stored.append(n)
    )
    loads = 0
    for k, node in enumerate(schedule.steps):
        for n in schedule.reads[k]:
            if n not in registers.names:
                assert graph.ops[n] == "input" or n in registers.places
                loads += graph.ops[n] != "input"
                registers.put(n, "loaded")
        registers.put(node, "made")
        registers.finish(k)
        assert len(registers.names) <= most
    assert len(set(stored)) == len(stored)
    assert len(set(registers.places.values())) == len(registers.places)
    assert not registers.names
    assert not registers.places
    # all numbers that are alive at once fit into a hundred registers, and not into six
    assert (len(stored) == 0, loads == 0) == (most == 100, most == 100)
    assert registers.size <= len(stored)


@pytest.mark.parametrize(("registers", "chunk"), [(8, 500), (32, 7), (8, 7)])
@pytest.mark.parametrize("rows", [1, 11])
def test_bits_depend_neither_on_registers_nor_on_parts(monkeypatch, registers, chunk, rows):
    A = MATRIX + np.linspace(0.0, 1.0, rows)[:, None, None]
    b = VECTOR * np.linspace(1.0, 2.0, rows)[:, None]
    run = lambda: jax.jit(jax.vmap(native(lambda A, b: eliminated(A, b))))(A, b)
    expected = run()
    monkeypatch.setattr(llvm, "_registers", lambda: registers)
    monkeypatch.setattr(llvm, "CHUNK", chunk)
    before = len(llvm._targets)
    found = run()
    assert len(llvm._targets) == before + 1
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for ours, theirs in zip(found, jax.vmap(eliminated)(A, b), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-14)
