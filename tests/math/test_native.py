"""Machine code of small functions against XLA's, in values, derivatives, batches and bits."""

import re
import threading
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from stmuav_jax.math import lapack
from stmuav_jax.math.native import llvm
from stmuav_jax.math.native.graph import NotScalarError, make_graph
from stmuav_jax.math.native.program import Transpose, evaluate, native, use_native_code

pytestmark = pytest.mark.skipif(not llvm.available(), reason="llvmlite is not installed")


@pytest.fixture(autouse=True)
def code_on(machine_code):
    """Machine code for the time of a test, also where the environment turns it off."""
    machine_code(True)


X = np.linspace(0.2, 0.9, 6).reshape(2, 3)
SPD = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]])


def elementary(x):
    """Every function of numbers, each where it is smooth."""
    angle = jnp.concatenate([x, 40.0 * x, -7.0 * x])
    return (
        jnp.sin(angle) + jnp.cos(angle) * jnp.tan(0.1 * angle),
        jnp.exp(x) + jnp.log(x) + jnp.log1p(x) + jnp.expm1(x) + x**2.5 + x**-3 + jnp.cbrt(x),
        jnp.arcsin(x) + jnp.arccos(x) + jnp.arctan(x) + jnp.arctan2(x, 1.0 - x),
        jnp.sinh(x) + jnp.cosh(x) + jnp.tanh(x) + jax.nn.sigmoid(x) + jax.lax.rsqrt(x),
        jnp.abs(x - 0.5) + jnp.sign(x - 0.5) + jnp.maximum(x, 0.4) + jnp.minimum(x, x[0, 0]),
        jnp.floor(3 * x) + jnp.ceil(3 * x) + jnp.round(3 * x) + jnp.clip(x, 0.3, 0.7) + x % 0.3,
        jax.scipy.special.erf(x),
    )


def indexed(x):
    """Entries that move: slices, gathers, scatters, pads, sums."""
    order = jnp.array([2, 0, 1])
    y = jnp.pad(x[:, order], ((1, 0), (0, 2))).at[0, 1].add(x[1, 2]).at[:, 4].set(x[0, 0])
    rolled = jnp.roll(y, 1, axis=1)[::-1]
    return (
        y @ rolled.T,
        jnp.cumsum(x, axis=1),
        jnp.einsum("ij,kj->ik", x, x),
        y.max(axis=0),
        jnp.diag(x[0]),
    )


def solved(x):
    """Linear solves by Cholesky's and triangular factors, and of a general matrix."""
    matrix = jnp.asarray(SPD) + jnp.outer(x[0], x[0])
    factor = jnp.linalg.cholesky(matrix)
    inner = jax.scipy.linalg.solve_triangular(factor, x.T, lower=True)
    general = matrix + jnp.asarray([[0.0, 2.0, 0.0], [0.0, 0.0, -1.0], [1.5, 0.0, 0.0]])
    return (
        jax.scipy.linalg.solve_triangular(factor.T, inner),
        jax.scipy.linalg.cho_solve((factor, True), x[1]),
        lapack.solve(general, jnp.asarray(x.T)),
    )


def chosen(x):
    """Choices that are known and choices that are computed, and a loop of known length."""
    large = x.sum() > 2.0
    either = jax.lax.cond(large, jnp.sin, jnp.cos, x)
    step = lambda c, row: (c + row, jnp.where(row > 0.5, c, row))
    return (
        either,
        jax.lax.scan(step, jnp.zeros(3), x),
        large,
        jnp.sum(x > 0.5),
        jnp.isfinite(x).all(),
    )


FUNCTIONS = (elementary, indexed, solved, chosen)


@cache
def compiled(function):
    return jax.jit(native(function)), jax.jit(function)


@pytest.mark.slow
@pytest.mark.parametrize("function", FUNCTIONS)
def test_values_and_derivatives_are_those_of_xla(function):
    ours, theirs = compiled(function)
    for x in (X, X[::-1] * 0.7):
        for a, b in zip(jax.tree.leaves(ours(x)), jax.tree.leaves(theirs(x)), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)
    total = lambda f: (
        lambda x: sum(jnp.sum(jnp.cos(v)) for v in jax.tree.leaves(f(x)) if v.dtype == float)
    )
    for derivative in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f))):
        a = jax.jit(derivative(total(native(function))))(X)
        b = jax.jit(derivative(total(function)))(X)
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


def test_a_transpose_follows_from_the_graph_of_the_derivative():
    """Without tracing, with the numbers and the entries that are not finite of the traced transpose."""
    known, table = jnp.asarray([0.0, 1.0, -2.0]), jnp.asarray([3.0, 0.5, 7.0, 1.5])

    def function(place, x, y):
        looked = table[jnp.clip(place, 0, 3)]
        either = jnp.where(x > 0.5, x * y, looked * x - y)
        return jnp.sum(either * known), (x / (1.0 + y**2), x[1] * looked)

    def pull(x, y):
        _, back = jax.vjp(partial(native(function), 2), x, y)
        return back((1.5, (x, 0.3 * y[0])))

    x, y = jnp.asarray([0.2, 0.6, 0.9]), jnp.asarray([1.1, -0.4, 0.3])
    traced = jax.make_jaxpr(pull)(x, y)
    (program,) = [
        e.params["program"] for e in traced.eqns if isinstance(e.params.get("program"), Transpose)
    ]
    assert program.graph() is not None
    assert "jaxpr" not in vars(program)  # nothing was traced for it
    expected = jax.vjp(partial(function, 2), x, y)[1]((1.5, (x, 0.3 * y[0])))
    np.testing.assert_allclose(jax.jit(pull)(x, y), expected, rtol=1e-14)
    np.testing.assert_allclose(
        program.evaluate(*_operands(traced, program, x, y)), expected, rtol=1e-14
    )
    for k in range(3):
        bad = y.at[k].set(jnp.nan)
        theirs = jax.vjp(partial(function, 2), x, bad)[1]((1.5, (x, 0.3 * bad[0])))
        for a, b in zip(jax.jit(pull)(x, bad), theirs, strict=True):
            assert np.all(np.isnan(a) | ~np.isnan(b))


def _operands(traced, program, *args):
    """Operands of the program within a traced function of these arguments."""
    (place,) = [k for k, e in enumerate(traced.eqns) if e.params.get("program") is program]
    before = traced.jaxpr.replace(
        eqns=traced.eqns[:place], outvars=[v for v in traced.eqns[place].invars]
    )
    return jaxpr_as_fun(traced.replace(jaxpr=before))(*args)


def test_a_rows_bits_do_not_depend_on_its_batch():
    """Alone, in batches of any size and place, and in batches of batches."""
    function = lambda x, y: native(lambda a, b: elementary(a * b)[0] / (1.0 + a.sum()))(x, y)
    rows = X + np.linspace(0.0, 0.05, 21)[:, None, None]
    shared = X.T[:1, :1]
    every = np.asarray(jax.jit(jax.vmap(function, (0, None)))(rows, shared))
    for start, stop in ((0, 1), (3, 8), (5, 21), (20, 21), (0, 9)):
        part = jax.jit(jax.vmap(function, (0, None)))(rows[start:stop], shared)
        np.testing.assert_array_equal(part, every[start:stop])
    np.testing.assert_array_equal(jax.jit(function)(rows[7], shared), every[7])
    nested = jax.vmap(jax.vmap(function, (0, None)), (0, None))
    np.testing.assert_array_equal(
        jax.jit(nested)(rows.reshape(3, 7, 2, 3), shared), every.reshape(3, 7, 6, 3)
    )
    both = jax.vmap(jax.vmap(function, (0, None)), (None, 0))
    grid = jax.jit(both)(rows, np.stack([shared, 1.1 * shared]))
    np.testing.assert_array_equal(grid[0], every)


def test_a_number_that_is_not_finite_comes_through_products_with_zero():
    weights = jnp.array([0.0, 1.0, 2.0])

    def function(x):
        return jnp.sum(x[0] * weights), x[1, 1] * x[1, 2]

    ours = jax.jit(native(function))
    for k in np.ndindex(2, 3):
        for bad in (np.nan, np.inf):
            x = X.copy()
            x[k] = bad
            for a, b in zip(ours(x), function(x), strict=True):
                assert np.isfinite(b) or not np.isfinite(a)
    assert np.isfinite(ours(X)[0])
    # a function that looks for them keeps its own answer
    guarded = lambda x: jnp.where(jnp.isfinite(x), x, 0.0) @ weights
    assert jax.jit(native(guarded))(np.array([np.nan, 1.0, 2.0])) == 5.0


def test_sines_of_large_angles_are_right_and_beyond_the_range_of_the_reduction_nan(monkeypatch):
    for fused, far in ((llvm.has_fused(), None), (False, llvm._FAR)):
        monkeypatch.setattr(llvm, "has_fused", lambda fused=fused: fused)
        far = (llvm._FAR_FUSED if fused else llvm._FAR) if far is None else far
        x = far * np.array([0.9, -0.3, 1e-3, 1.1, -1e3])
        sine, cosine = jax.jit(native(lambda x: (jnp.sin(x), jnp.cos(x))))(x)
        np.testing.assert_allclose(sine[:3], np.sin(x[:3]), rtol=0, atol=1e-14)
        np.testing.assert_allclose(cosine[:3], np.cos(x[:3]), rtol=0, atol=1e-14)
        assert np.isnan(sine[3:]).all()
        assert np.isnan(cosine[3:]).all()


def test_derivatives_by_entries_that_are_zero_or_one_are_exact():
    matrix = np.eye(3)
    function = lambda m: jnp.sum(jnp.sin(m @ jnp.arange(3.0)))
    np.testing.assert_allclose(
        jax.grad(native(function))(matrix), jax.grad(function)(matrix), rtol=1e-14
    )


def test_what_has_no_scalar_form_is_left_to_xla():
    loop = lambda x: jax.lax.while_loop(
        lambda c: c[0] < x.sum(), lambda c: (c[0] + 1, c[1] * 1.1), (0.0, x)
    )
    picked = lambda x, k: jnp.sort(x)[k]
    np.testing.assert_array_equal(jax.jit(native(loop))(X)[1], loop(X)[1])
    np.testing.assert_array_equal(jax.jit(native(picked))(X, 1), np.sort(X)[1])
    trace = jax.make_jaxpr(picked)(X, 1)
    with pytest.raises(NotScalarError, match="sort"):
        make_graph(trace, 1000)
    with pytest.raises(NotScalarError, match="more than 10"):
        make_graph(jax.make_jaxpr(elementary)(X), 10)


def test_without_it_the_function_is_compiled_by_xla():
    use_native_code(False)
    try:
        text = jax.jit(native(elementary)).lower(X).as_text()
        assert "stmuav_" not in text
    finally:
        use_native_code(True)
    assert "stmuav_" in jax.jit(native(elementary)).lower(X).as_text()


def test_equal_programs_are_compiled_once_and_called_from_any_thread():
    before = len(llvm._targets)
    functions = [jax.jit(native(lambda x: jnp.sin(x) @ x.T)) for _ in range(16)]
    results: list = []
    work = lambda f: results.extend(np.asarray(f(X)) for _ in range(20))
    threads = [threading.Thread(target=work, args=(f,)) for f in functions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all((r == results[0]).all() for r in results)
    assert len(results) == 320
    assert len(llvm._targets) - before == 1


def test_code_that_is_damaged_in_its_folder_is_made_again(tmp_path):
    path = tmp_path / "x.o"
    llvm._write(path, b"content")
    assert llvm._read(path) == b"content"
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    assert llvm._read(path) is None


def test_long_programs_are_cut_into_parts(monkeypatch):
    monkeypatch.setattr(llvm, "CHUNK", 7)
    a = jax.jit(native(lambda x: solved(x)))(X)
    for u, v in zip(a, solved(X), strict=True):
        np.testing.assert_allclose(u, v, rtol=1e-13)


def test_code_for_other_processors_can_be_made():
    """NEON's vectors of two, on a processor that is not this one; the code is not run."""
    import llvmlite.binding as binding

    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    graph, outputs = make_graph(jax.make_jaxpr(elementary)(X), 10_000)
    results = [llvm.Buffer(o.size, "f8") for o in outputs]
    code = llvm.write(graph, outputs, [llvm.Buffer(6, "f8")], results, 2)
    module = binding.parse_assembly(code.text)
    for triple, processor in (
        ("aarch64-unknown-linux-gnu", "neoverse-n1"),
        ("arm64-apple-darwin", "apple-m1"),
    ):
        module.triple = triple
        machine = binding.Target.from_triple(triple).create_target_machine(cpu=processor, opt=1)
        assert len(machine.emit_object(module)) > 1000


def test_one_known_number_is_a_truth_value_and_a_number():
    """The same zero as results of three kinds, whichever comes first."""
    kinds = (bool, bool, float, int, bool)
    function = lambda x: (*(jnp.zeros(2, kind) for kind in kinds), jnp.sin(x))
    *zeros, sine = jax.jit(native(function))(X[0])
    for found, kind in zip(zeros, kinds, strict=True):
        np.testing.assert_array_equal(found, jnp.zeros(2, kind))
        assert found.dtype == jnp.zeros(2, kind).dtype
    np.testing.assert_allclose(sine, np.sin(X[0]), rtol=1e-15)


def test_truth_values_and_integers():
    """Choices between known and computed truth values, their order, and sums of integers."""

    def function(x, y):
        large = x > 0.5
        return (
            jnp.where(large, y, False), jnp.where(large, True, y), jnp.where(large, y, True),
            jnp.where(large, False, y), jnp.where(large, True, False) & y, jnp.max(large), jnp.min(y),
            large < y, large == y, jnp.maximum(large, y), jnp.where(large, 1, 2) + jnp.int32(3),
        )  # fmt: skip

    x, y = np.array([0.1, 0.6, 0.9, 0.3]), np.array([True, False, True, False])
    ours = jax.jit(native(function))
    assert "stmuav_" in ours.lower(x, y).as_text()
    for a, b in zip(ours(x, y), function(x, y), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    # quotients of integers are exact, though numbers are in double precision
    quotient = lambda n, m: (
        n // m,
        n % m,
        jax.lax.div(n, m),
        (n.astype(jnp.uint32) // 7).astype(int),
    )
    n, m = np.array([[-7, 7, 98, 2**31 - 1], [5, 7, 49, 3]])
    divided = jax.jit(native(quotient))
    assert "stmuav_" in divided.lower(n, m).as_text()
    for a, b in zip(divided(np.abs(n), m), quotient(np.abs(n), m), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(divided(n, -m)[:3], quotient(n, -m)[:3], strict=True):
        np.testing.assert_array_equal(a, b)
    by_zero = jax.jit(native(jax.lax.div))
    np.testing.assert_array_equal(by_zero(n, 0 * m), jax.lax.div(n, 0 * m))


def test_a_quotient_is_rounded_once_where_its_divisor_has_one_use():
    a, b = np.arange(1.0, 7.0), np.array([3.0, 7.0, 49.0, 5.0, 6.0, 10.0])
    np.testing.assert_array_equal(jax.jit(native(lambda a, b: jnp.floor(a / b)))(a * b, b), a)


def test_functions_within_functions_are_one_program():
    inner = native(lambda a, b: jnp.sin(a) @ b)
    batched = lambda x, y: jnp.sum(jax.vmap(lambda row: inner(row, y))(x)) + inner(x[0], y[0])
    plain = lambda x, y: jnp.sum(jnp.sin(x) @ y) + jnp.sin(x[0]) @ y[0]
    y = np.linspace(0.2, 0.7, 9).reshape(3, 3)
    ours = jax.jit(native(batched))
    assert ours.lower(X, y).as_text().count("custom_call @stmuav_") == 1
    np.testing.assert_allclose(ours(X, y), plain(X, y), rtol=1e-14)
    np.testing.assert_allclose(jax.hessian(ours)(X, y), jax.hessian(plain)(X, y), atol=1e-14)


def test_a_function_that_cannot_be_found_again_is_evaluated_as_it_is():
    class Sine:
        __hash__ = None  # pyright: ignore[reportAssignmentType]

        def __call__(self, x):
            return jnp.sin(x)

    np.testing.assert_array_equal(jax.jit(lambda x: evaluate(Sine(), x))(X), jnp.sin(X))


def test_numbers_of_one_argument_are_handed_over_together():
    """Joined where a batch shares them; those that nothing reads, whole numbers and truths are apart."""
    numbers = {f"{k}": jnp.linspace(0.1, 1.0, k + 1) for k in range(8)}
    numbers |= {"whole": jnp.array([3, 4]), "truth": jnp.array(True), "unread": jnp.ones(50)}

    def function(numbers, x):
        total = sum(numbers[f"{k}"][-1] * numbers[f"{k}"][0] * x for k in range(8))
        return jnp.where(numbers["truth"], total + numbers["whole"][1], 0.0)

    ours, rows = jax.jit(native(function)), jnp.asarray(X)
    np.testing.assert_allclose(ours(numbers, X), function(numbers, rows), rtol=1e-14)
    call = re.findall(r"custom_call @stmuav_\w+\(([^)]*)\)", ours.lower(numbers, X).as_text())
    assert [len(operands.split(",")) for operands in call] == [4]
    each = ({**dict.fromkeys(numbers), "3": 0}, 0)
    batched = {**numbers, "3": numbers["3"] * jnp.ones((2, 1))}
    pairs = [jax.vmap(f, each)(batched, rows) for f in (native(function), function)]
    np.testing.assert_allclose(*pairs, rtol=1e-14)


def test_results_that_are_arguments_are_passed_on():
    """A model with other inputs is the same but for these: machine code copies nothing, a batch neither."""
    model = {"gusts": jnp.ones((200, 3)), "u": jnp.zeros(3), "w": jnp.asarray(X)}
    function = native(lambda model, u: (model | {"u": 2.0 * u}, jnp.sum(model["w"]) * u))
    axes = ({"gusts": None, "u": 0, "w": None}, 0)
    found, total = jax.vmap(function, (None, 0), axes)(model, model["w"])
    np.testing.assert_array_equal(found["u"], 2.0 * X)
    np.testing.assert_allclose(total, np.sum(X) * X, rtol=1e-14)
    assert (found["gusts"].shape, found["w"].shape) == ((200, 3), X.shape)
    text = jax.jit(function).lower(model, X[0]).as_text()
    (results,) = re.findall(r"custom_call @stmuav_.*-> (.*)", text)
    assert results.count("tensor") == 2
    slope = jax.jacobian(lambda w: function(model | {"w": w}, X[0])[0]["w"])(model["w"])
    np.testing.assert_array_equal(slope.reshape(6, 6), np.eye(6))


A, C = np.tril(np.arange(1.0, 17.0).reshape(4, 4), -1) / 40, np.linspace(0.0, 1.0, 4)


def stage(scale, t, y, total, node):
    """Row of a Runge-Kutta step."""
    return jnp.sin(scale["a"] * (y + total)) + (t + node) * scale["b"]


stages = native(stage, tables=(A, C))


@pytest.mark.parametrize("size", [1, 2, 7, 19])
def test_rows_of_loops_are_added_term_by_term(size):
    """In vectors that overlap, with the bits of one operation after the other."""
    y = jnp.asarray(np.random.default_rng(size).normal(size=size))
    scale = {"a": jnp.asarray(1.3), "b": y}
    found = np.asarray(jax.jit(stages)(scale, 0.3, y, jnp.zeros((4, size))))
    one = native(lambda x, w: jnp.sum(w[:, None] * x, axis=0))
    row = native(lambda scale, y, total, node: stage(scale, 0.3, y, total, node))
    for k in range(4):
        total = jax.jit(one)(np.where(np.arange(4)[:, None] < k, found, 0.0), A[k])
        np.testing.assert_array_equal(found[k], jax.jit(row)(scale, y, total, C[k]))


def test_loops_are_one_call():
    """Rows that follow from those before, their derivatives, and batches."""

    def by_rows(scale, t, y, x):
        for k in range(4):
            x = x.at[k].set(jnp.sin(scale["a"] * (y + A[k] @ x)) + (t + C[k]) * scale["b"])
        return x

    scale, y, x = {"a": 1.3, "b": jnp.array([0.1, 0.7])}, jnp.array([0.4, -2.0]), jnp.zeros((4, 2))
    scale = jax.tree.map(jnp.asarray, scale)
    arguments = scale, 0.3, y, x
    np.testing.assert_allclose(
        jax.jit(stages)(*arguments), jax.jit(by_rows)(*arguments), atol=1e-15
    )
    text = jax.jit(stages).lower(*arguments).as_text()
    assert (text.count("custom_call"), text.count("while")) == (1, 0)
    for derivative in (jax.jacfwd, jax.jacrev, lambda f, at: jax.jacfwd(jax.jacrev(f, at), at)):
        of = lambda f, d=derivative: jax.tree.leaves(jax.jit(d(f, (0, 2)))(*arguments))
        for ours, theirs in zip(of(stages), of(by_rows), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-14)
    many = (None, 0, 0, None)
    ts, ys = jnp.linspace(0, 1, 5), y + jnp.linspace(0, 1, 5)[:, None]
    ours, theirs = (jax.vmap(f, many)(scale, ts, ys, x) for f in (stages, by_rows))
    np.testing.assert_allclose(ours, theirs, atol=1e-15)


TABLE = np.sort(np.linspace(0.0, 1.0, 37) ** 1.3)
CURVES = np.stack([np.sin(7 * TABLE), TABLE**2, np.cos(3 * TABLE)], axis=1)
KNOWN = np.cos(np.arange(90.0)).reshape(30, 3)

LOOKUPS = {
    "interpolation": lambda t, x, y, k: jnp.interp(t, x, y[:, 0]),
    "piece": lambda t, x, y, k: y[jnp.searchsorted(x, t, side="right") - 1],
    "compare all": lambda t, x, y, k: y[jnp.searchsorted(x, t, method="compare_all") % 37, 1],
    "known table": lambda t, x, y, k: jnp.asarray(KNOWN)[(t * 20).astype(int) + x.astype(int)[0]],
    "column": lambda t, x, y, k: y.T[k[0], 3:6] * y[(t * 5).astype(int) // 2],
    "turned": lambda t, x, y, k: jax.lax.dynamic_slice(y[::2].T, (k[0], (t * 9).astype(int)), (2, 3)),
    "outside": lambda t, x, y, k: jnp.take(x, (100 * t).astype(int), mode="fill"),
    "several": lambda t, x, y, k: y[(t * jnp.arange(1, 4)).astype(int) + 3, k],
    "computed array": lambda t, x, y, k: jnp.cumsum(jnp.sin(x[:5] * t))[k[1]],
    "written": lambda t, x, y, k: jax.lax.dynamic_update_slice(x[:6] * t, t * x[2:4], (k[1],)),
}  # fmt: skip


@pytest.mark.parametrize("name", LOOKUPS)
def test_a_computed_index_reads_what_xla_reads(name):
    """Tables, known arrays and computed ones; one and many rows; derivatives in both modes."""
    function = LOOKUPS[name]
    ours = native(function)
    numbers = np.array([-0.3, 0.0, 0.123, 0.5, 0.77, 0.999, 1.0, 1.7, np.nan])
    indices = np.random.default_rng(3).integers(0, 3, (len(numbers), 3))
    tables = (jnp.asarray(TABLE), jnp.asarray(CURVES))
    assert ours.has_code(0.5 * jnp.ones(()), *tables, jnp.asarray(indices[0]))  # pyright: ignore
    over = (0, None, None, 0)
    singly = [jax.jit(ours)(t, *tables, k) for t, k in zip(numbers, indices, strict=True)]
    batch = jax.jit(jax.vmap(ours, in_axes=over))(numbers, *tables, indices)
    expected = jax.jit(jax.vmap(function, in_axes=over))(numbers, *tables, indices)
    np.testing.assert_array_equal(batch, np.stack(singly))
    np.testing.assert_allclose(batch[:-1], expected[:-1], rtol=1e-13, atol=1e-14)
    # NaN where XLA has it
    assert np.all(np.isnan(batch[-1]) | ~np.isnan(expected[-1]))
    spread = [jnp.tile(table, (len(numbers), *(1,) * table.ndim)) for table in tables]
    np.testing.assert_array_equal(jax.jit(jax.vmap(ours))(numbers, *spread, indices), batch)
    for mode in (jax.jacfwd, jax.jacrev):
        derivatives = [
            jax.jit(mode(f, argnums=(0, 1, 2)))(0.41, *tables, jnp.asarray(indices[3]))
            for f in (ours, function)
        ]
        for mine, theirs in zip(*derivatives, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-13)


def test_nan_beside_a_lookup_comes_through():
    """A lookup tells NaN apart to sort it, which must not hide that of another number."""
    function = native(lambda t, x, y, z: jnp.interp(t, x, y) + 0.0 * z)
    assert np.isnan(jax.jit(function)(0.3, jnp.asarray(TABLE), jnp.asarray(CURVES[:, 0]), jnp.nan))
