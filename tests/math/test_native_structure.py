"""Zeros and ones of frames and axes in compiled programs: values, derivatives, loops, other numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.math.compiler import kept_jit, outer_jit
from stmuav_jax.math.native import llvm
from stmuav_jax.math.native.program import native
from stmuav_jax.math.native.structure import find_structure, has_structure

pytestmark = pytest.mark.skipif(not llvm.available(), reason="llvmlite is not installed")


@has_structure(zero=("arm",), unit=("axes",))
class Frame(eqx.Module):
    """Numbers with structure, and a mass, which has none though it is 1."""

    axes: jax.Array
    arm: jax.Array
    mass: jax.Array


def make_frame(axes=((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), arm=(0.0, 1.0, 0.0)):
    return Frame(jnp.array(axes), jnp.array(arm), jnp.array(1.0))


@native
def turn(frame, x):
    """Sines make operations that are not folded."""
    return frame.axes @ jnp.sin(x) + frame.mass * frame.arm * jnp.cos(x)


X = jnp.array([0.3, -0.4, 0.7])


@pytest.fixture
def operations(machine_code, monkeypatch):
    """Numbers of operations of the programs that LLVM compiles."""
    machine_code(True)
    # the interface to XLA is tried by a program of its own
    assert llvm.available()
    counts = []
    register = llvm.register
    monkeypatch.setattr(
        llvm, "register", lambda code: counts.append(code.operations) or register(code)
    )
    return counts


def test_the_structure_of_arguments_is_their_zeros_and_units_in_marked_fields():
    ((axes, first), (arm, second)) = find_structure((X, make_frame()))
    assert (axes, arm) == (1, 2)
    assert np.frombuffer(first, np.int8).tolist() == [1, 0, 0, 0, 0, -1, 0, 1, 0]
    assert np.frombuffer(second, np.int8).tolist() == [0, 2, 0]
    assert find_structure((X, {"a": X})) == ()


@pytest.mark.parametrize("jit", [kept_jit, outer_jit])
def test_arrays_of_other_shapes_have_programs_of_their_own(jit, machine_code):
    machine_code(True)
    program = jit(jax.vmap(turn, in_axes=(0, None)))
    for count in (2, 3):
        frames = jax.tree.map(lambda x, n=count: jnp.stack([x] * n), make_frame())
        expected = jnp.stack([turn(make_frame(), X)] * count)
        np.testing.assert_allclose(program(frames, X), expected, rtol=1e-15)


def test_arrays_without_entries_have_no_structure(operations):
    empty = eqx.tree_at(lambda f: f.axes, make_frame(), jnp.zeros((3, 0)))
    assert [place for place, _ in find_structure(empty)] == [1]
    total = native(lambda frame, x: jnp.sum(frame.axes) + jnp.sum(jnp.sin(frame.arm * x)))
    for jit in (kept_jit, outer_jit):
        np.testing.assert_allclose(jit(total)(empty, X), np.sin(X[1]), rtol=1e-15)
    np.testing.assert_allclose(outer_jit(lambda x: total(empty, x))(X), np.sin(X[1]), rtol=1e-15)


@pytest.mark.parametrize("jit", [kept_jit, outer_jit])
def test_other_numbers_with_the_same_structure_share_a_program_and_all_others_a_second_one(
    jit, operations
):
    new_turn = native(lambda frame, x: turn(frame, x))
    program = jit(lambda frame, x: new_turn(frame, x))
    other = eqx.tree_at(lambda f: f.arm, make_frame(), jnp.array([0.0, 0.2, 0.0]))
    tilted = [make_frame(arm=(a, 1.0, 0.0)) for a in (0.5, 0.0)]
    tilted[1] = eqx.tree_at(lambda f: f.axes, tilted[1], jnp.array(np.full((3, 3), 0.1)))
    for frame in (make_frame(), other, *tilted):
        expected = frame.axes @ np.sin(X) + frame.arm * np.cos(X)
        np.testing.assert_allclose(program(frame, X), expected, rtol=1e-15)
    few, all_operations = operations
    assert few < 0.7 * all_operations


def test_more_zeros_than_those_of_a_program_use_it(operations):
    program = kept_jit(lambda frame, x: turn(frame, x) + 0.0)
    zero = make_frame(arm=(0.0, 0.0, 0.0))
    assert jnp.array_equal(program(make_frame(), X), turn(make_frame(), X))
    assert jnp.array_equal(program(zero, X), turn(zero, X))
    assert len(operations) <= 3


def test_derivatives_by_entries_that_are_structure_are_not_lost(operations):
    # derivatives are taken within the program, where the frame's zeros and ones are known
    slopes = kept_jit(lambda frame, x: (
        jax.jacfwd(turn)(frame, x), jax.jacrev(turn)(frame, x), jax.jvp(turn, (frame, x), (frame, x))
    ))  # fmt: skip
    frame = make_frame()
    forward, reverse, (value, tangent) = slopes(frame, X)
    exact = jnp.einsum("ij,k->ijk", jnp.eye(3), jnp.sin(X))
    for found in (forward, reverse):
        np.testing.assert_allclose(found.axes, exact, atol=1e-15)
        np.testing.assert_allclose(found.arm, jnp.diag(jnp.cos(X)), atol=1e-15)
        np.testing.assert_allclose(found.mass, frame.arm * jnp.cos(X), atol=1e-15)
    np.testing.assert_allclose(value, turn(frame, X), rtol=1e-15)
    step = 1e-6
    ahead, behind = (
        turn(*jax.tree.map(lambda a, s=s: a * (1 + s), (frame, X))) for s in (step, -step)
    )
    np.testing.assert_allclose(tangent, (ahead - behind) / (2 * step), atol=1e-9)


def loops(frame, x):
    """A frame that loops close over, that they hand on as it is, and that they change."""
    scanned, _ = jax.lax.scan(lambda c, _: (turn(frame, c), None), x, None, length=3)
    _, carried = jax.lax.while_loop(
        lambda c: c[1][0] < 2.0, lambda c: (c[0], jnp.abs(turn(c[0], c[1])) + c[1]), (frame, x)
    )
    # the zeros of the first pass are not those of the second
    shift = lambda f: eqx.tree_at(lambda f: f.arm, f, f.arm + 0.5)
    _, changed = jax.lax.fori_loop(0, 3, lambda _, c: (shift(c[0]), turn(c[0], c[1])), (frame, x))
    chosen = jax.lax.cond(x[0] > 0, lambda f: turn(f, x), lambda f: turn(shift(f), x), frame)
    rows = jax.vmap(lambda f, y: turn(f, y), in_axes=(None, 0))(frame, jnp.stack([x, 2 * x]))
    frames = jax.tree.map(lambda *a: jnp.stack(a), frame, shift(frame))
    both = jax.vmap(turn, in_axes=(0, None))(frames, x)
    return scanned, carried, changed, chosen, rows, both, jax.checkpoint(turn)(frame, x)


@pytest.mark.parametrize("jit", [kept_jit, outer_jit])
def test_structure_passes_through_loops_choices_and_batches(jit, machine_code):
    frame, x = make_frame(), X + 0.1
    machine_code(True)
    with_code = jit(loops)(frame, x)
    closed_over = jit(lambda x: loops(frame, x))(x)
    machine_code(False)
    without = jax.jit(loops)(frame, x)
    for ours in (with_code, closed_over):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15), ours, without
        )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_come_through(bad, operations):
    program = kept_jit(lambda frame, x: turn(frame, x))
    program(make_frame(), X)
    for k in range(3):
        assert not jnp.isfinite(program(make_frame(), X.at[k].set(bad))).any()
    no_mass = eqx.tree_at(lambda f: f.mass, make_frame(), jnp.array(bad))
    assert not jnp.isfinite(program(no_mass, X)).any()


@pytest.mark.parametrize("value", [True, 1.0, 2, np.float64(1.5), jnp.arange(2)])
def test_results_that_are_constants_stay_arrays_of_their_types(value, machine_code):
    machine_code(True)
    of = lambda frame, x: (turn(frame, x), jnp.asarray(value))
    result, expected = outer_jit(of)(make_frame(), X)[1], jax.jit(of)(make_frame(), X)[1]
    assert jnp.array_equal(result, expected)
    assert (result.dtype, result.weak_type) == (expected.dtype, expected.weak_type)
