"""Compiled programs: a bounded number of them, the right ones, and a warning in time."""

import gc
import threading
import warnings
from collections import OrderedDict

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.math import compiler
from stmuav_jax.math.compiler import (
    check_maps,
    in_blocks,
    is_transformed,
    kept_jit,
    memory_maps,
    remember_results,
)
from stmuav_jax.math.native import llvm
from stmuav_jax.math.native.program import native

traced: list[str] = []


def scaled(x, name, factor=2.0):
    """A function of structure; notes when it is traced."""
    traced.append(name)
    return jnp.sin(x) @ x * len(name), (name, factor)


kept = kept_jit(scaled)
X = jnp.eye(3)


@pytest.fixture
def programs(monkeypatch):
    """A registry of its own for four programs."""
    found: OrderedDict = OrderedDict()
    monkeypatch.setattr(compiler, "_programs", found)
    monkeypatch.setattr(compiler, "MOST_PROGRAMS", 4)
    traced.clear()
    return found


def test_programs_are_kept_by_structure_and_shape(programs):
    for name in ("a", "bb", "a"):
        found, rest = kept(X, name)
        np.testing.assert_allclose(found, np.sin(np.eye(3)) @ np.eye(3) * len(name))
        assert rest == (name, 2.0)
    kept(np.ones((3, 3)), "a")
    # on the device that JAX chooses itself
    kept(jax.device_put(X, jax.devices()[0]), "a")
    assert traced == ["a", "bb"]
    kept(jnp.ones((2, 2)), "a")
    kept(X.astype(jnp.float32), "a")
    assert traced == ["a", "bb", "a", "a"]
    # the fifth takes the place of the one used longest ago
    kept(X, "ccc")
    assert len(programs) == 4
    kept(X, "bb")
    assert traced == ["a", "bb", "a", "a", "ccc", "bb"]


@pytest.mark.slow
def test_released_programs_give_their_memory_maps_back(programs):
    kept(X, "first")
    for k in range(4):
        kept(X, f"n{k}")
    gc.collect()
    maps = memory_maps()
    if maps is None:
        pytest.skip("This system does not count memory maps.")
    for k in range(4, 44):
        kept(X, f"n{k}")
    gc.collect()
    assert memory_maps()[0] < maps[0] + 20  # pyright: ignore[reportOptionalSubscript]


def test_within_a_transformation_it_is_part_of_the_larger_program(programs):
    loss = lambda x, name="abc": jnp.sum(kept(x, name)[0])
    assert not is_transformed((X,))
    for gradient in (jax.grad(loss)(X), jax.jit(jax.grad(loss))(X)):
        difference = float(loss(X + 1e-6) - loss(X - 1e-6)) / 2e-6
        assert float(jnp.sum(gradient)) == pytest.approx(difference, rel=1e-8)
    assert jax.vmap(loss)(jnp.stack([X, 2 * X])).shape == (2,)
    # arguments that are known, in a function that closes over what is differentiated
    closing = lambda a: jnp.sum(kept_jit(lambda x: a * x)(X))
    assert jax.grad(closing)(2.0) == 3.0


@pytest.mark.parametrize("jit", [compiler.quick_jit, compiler.outer_jit])
def test_options_are_those_of_the_call(monkeypatch, jit):
    """A function that was compiled before with other options is compiled with the new ones."""
    function = jit(lambda x: (traced.append("x"), 2 * x)[1])
    traced.clear()
    counts = []
    for level in (0, 1, 0, 1):
        options = {"xla_backend_optimization_level": level}
        monkeypatch.setattr(compiler, "compiler_options", lambda o=options, **_: o)
        assert function(3.0) == 6.0
        counts.append(len(traced))
    assert counts == [1, 2, 2, 2]


def test_machine_code_of_programs_that_run_seldom_is_not_optimised(
    programs, optimised, monkeypatch
):
    levels, compile_code = [], llvm._compile
    monkeypatch.setattr(llvm, "_object_folder", lambda: None)
    monkeypatch.setattr(
        llvm, "_compile", lambda *args: (levels.append(args[-1]), compile_code(*args))[1]
    )

    @native
    def equations(x):
        return jnp.sin(x) @ jnp.exp(x) / (1.25 + x[0] @ x[1]), jnp.cumsum(x, axis=1)

    seldom, often = (kept_jit(lambda x: equations(x), optimised=on) for on in (False, True))
    x = jnp.asarray(np.random.default_rng(0).standard_normal((3, 3)))
    jax.tree.map(np.testing.assert_array_equal, seldom(x), often(x))
    assert levels == [0, 1]


def test_without_jit_functions_run_themselves(programs):
    """`jax.disable_jit`, JAX's means of debugging, reaches what is compiled here: prints and breakpoints work."""
    with jax.disable_jit():
        sine, rest = kept(X, "plain")
        again, _ = kept(X, "plain")
        batch = compiler.compile_for_shapes(lambda x: 2 * x, X)
        np.testing.assert_array_equal(batch(X), 2 * X)
        np.testing.assert_allclose(compiler.quick_jit(jnp.sum)(X), 3.0)
    np.testing.assert_array_equal(sine, again)
    assert rest == ("plain", 2.0)
    assert traced == ["plain", "plain"]
    assert not programs


def test_a_warning_comes_once_and_long_before_the_limit(monkeypatch):
    counts = iter([(30_000, 65_530), (33_000, 65_530), (40_000, 65_530)])
    monkeypatch.setattr(compiler, "memory_maps", lambda: next(counts))
    compiler._warned.clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_maps()
    with pytest.warns(RuntimeWarning, match=r"33000 memory maps of the 65530.*clear_caches"):
        check_maps()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_maps()
    compiler._warned.clear()
    monkeypatch.setattr(compiler, "memory_maps", lambda: None)
    check_maps()


def simulated(name, **settings):
    """A falling body: the cheapest system; its name is its structure."""
    system = stm.System([stm.Body(name, 1.0, (1e-3,) * 3, free=True)], [], [stm.Gravity()])
    method = stm.Method(solver=diffrax.Heun(), rtol=1e-3, atol=1e-3, **settings)
    return stm.simulate(
        system, system.reference, method=method, ts=[0.0, 0.1], error_estimate=False, analysis=False
    ).states.r[-1, 0, 2]


def test_machine_code_within_a_transformation_is_one_operation():
    """JAX would keep a program around it for as long as the process lives, for every structure."""
    doubled = kept_jit(native(lambda x: 2.0 * x))
    equations = jax.make_jaxpr(jax.vmap(doubled))(np.eye(3)).eqns
    assert [str(equation.primitive) for equation in equations] == ["native"]
    np.testing.assert_array_equal(jax.vmap(doubled)(np.eye(3)), 2.0 * np.eye(3))


@pytest.mark.slow
def test_thirty_systems_of_different_structure_leave_nothing_behind(monkeypatch):
    """Each needs some 150 to 220 memory maps while its programs are kept."""
    monkeypatch.setattr(compiler, "MOST_PROGRAMS", 8)
    # every tenth as by default, the others with fewer programs to trace
    quick = {"formulation": stm.Augmented(), "stabilisation": stm.Unstabilised()}
    counts = []
    for k in range(30):
        height = simulated(f"body {k}", **({} if k % 10 == 0 else quick))
        assert height == pytest.approx(-0.5 * 9.81 * 0.01, rel=1e-6)
        # not before as many are kept as ever will be
        if k % 10 == 9:
            gc.collect()
            counts.append((memory_maps() or (0, 0))[0])
    assert max(counts) < min(counts) + 60
    # a structure seen a moment ago compiles nothing
    before = list(compiler._programs)
    simulated("body 29", **quick)
    assert list(compiler._programs) == before


@pytest.mark.parametrize("count", [1, 4, 9])
def test_blocks_have_one_size(count):
    """The last one is filled up, and what that adds is left out of the result."""
    sizes = []

    def function(x, tree):
        sizes.append(len(x))
        return {"sum": x[:, 0] + tree["y"], "double": 2 * jnp.asarray(x)}

    x, y = np.arange(2.0 * count).reshape(count, 2), np.arange(count)
    found = in_blocks(function, 4, x, {"y": y})
    assert set(sizes) == {4}
    np.testing.assert_array_equal(found["sum"], x[:, 0] + y)
    np.testing.assert_array_equal(found["double"], 2 * x)


def test_results_are_remembered_for_the_same_arrays_only():
    calls = []

    @remember_results
    def double(x, factor):
        calls.append(factor)
        return factor * x

    x, changing = jnp.arange(3.0), np.arange(3.0)
    assert double(x, 2.0) is double(x, 2.0)
    assert len(calls) == 1
    np.testing.assert_array_equal(double(x, 3.0), [0.0, 3.0, 6.0])
    np.testing.assert_array_equal(double(jnp.ones(3), 2.0), [2.0, 2.0, 2.0])
    # NumPy's array may have other numbers at the next call, and a traced result is not kept
    np.testing.assert_array_equal(double(changing, 2.0), [0.0, 2.0, 4.0])
    changing[:] = 1.0
    np.testing.assert_array_equal(double(changing, 2.0), [2.0, 2.0, 2.0])
    np.testing.assert_array_equal(jax.jit(lambda: double(x, 4.0))(), [0.0, 4.0, 8.0])
    np.testing.assert_array_equal(double(x, 4.0), [0.0, 4.0, 8.0])


def test_known_numbers_are_computed_outside_of_a_trace():
    threads = []

    def compute(x):
        threads.append(threading.get_ident())
        return float(jnp.sum(kept_jit(scaled)(x, "untraced")[0]))

    outside = compiler.compute_untraced(compute, X)
    inside = jax.jit(lambda y: y + compiler.compute_untraced(compute, X))(1.0)
    assert float(inside) == pytest.approx(1.0 + outside)
    assert threads[0] == threading.get_ident() != threads[1]


def test_compiler_options_compile():
    options = stm.math.compiler_options()
    f = jax.jit(lambda x: jnp.sum(x[:, :, None] * x[:, None], axis=1), compiler_options=options)
    x = jnp.ones((512, 8))
    assert "__ynn_fusion" not in str(f.lower(x).compile().as_text())
    np.testing.assert_array_equal(f(x), np.full((512, 8), 8.0))
