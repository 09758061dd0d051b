"""Regulators against python-control, which has its own program around the equation, and without solution."""

import sys
from pathlib import Path

import numpy as np
import pytest

import stmuav_jax as stm

sys.path.insert(0, str(Path(__file__).parents[1] / "analysis"))
from mechanisms import cart_pole  # pyright: ignore[reportMissingImports]

control = stm.control

RATE = 50.0


def linear_of(A, B):
    """Linear system with all states as outputs."""
    n, m = np.shape(B)
    states, inputs = (
        tuple((f"{name}{k}", "") for k in range(size)) for name, size in (("x", n), ("u", m))
    )
    return stm.analysis.Linear(
        np.asarray(A), np.asarray(B), np.eye(n), np.zeros((n, m)), states, inputs, states
    )


def test_the_double_integrators_regulator_in_closed_form():
    """K = (1, sqrt 3) for unit weights."""
    linear = linear_of([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    found = control.regulator(linear, [1.0, 1.0], [1.0])
    np.testing.assert_allclose(found.K, [[1.0, np.sqrt(3.0)]], rtol=1e-12)
    assert np.all(np.real(found.poles) < 0)


def test_modes_that_nothing_moves_are_named():
    """Two masses, one of them without a force; a weight that sees one only."""
    A = np.eye(4, k=2)
    with pytest.raises(stm.ModelError, match=r"cannot stabilise .* x[13].*they do not move it"):
        control.regulator(linear_of(A, np.eye(4)[:, 2:3]), np.ones(4), [1.0])
    both = linear_of(A, np.eye(4)[:, 2:])
    with pytest.raises(stm.ModelError, match=r"do not determine .* x[13].*they do not see it"):
        control.regulator(both, [1.0, 0.0, 1.0, 0.0], [1.0, 1.0])
    with pytest.raises(stm.ModelError, match="R of the regulator must be positive definite"):
        control.regulator(both, np.ones(4), [1.0, 0.0])


@pytest.fixture(scope="module")
def systems():
    """A cart-pole about its upright posture, and one drawn with two inputs."""
    space = stm.TreeSpace(cart_pole())
    upright = space.from_state(space.system.reference)
    drawn = np.random.default_rng(7).normal(size=(5, 7))
    return stm.linearize(space, upright), linear_of(drawn[:, :5], drawn[:, 5:])


def test_gains_are_those_of_python_control(systems):
    """Gains, costs and poles of continuous and of held inputs; it reads our matrices as they are."""
    other = pytest.importorskip("control")
    for linear in systems:
        n, m = linear.B.shape
        Q, R = np.diag(np.linspace(1.0, 5.0, n)), np.diag(np.linspace(0.1, 0.3, m))
        system = other.ss(linear.A, linear.B, linear.C, linear.D)
        K, S, poles = other.lqr(system, Q, R)
        found = control.regulator(linear, Q, R)
        np.testing.assert_allclose(found.K, K, rtol=1e-9, atol=1e-9 * np.max(np.abs(K)))
        np.testing.assert_allclose(found.S, S, rtol=1e-9, atol=1e-9 * np.max(np.abs(S)))
        assert_same(found.poles, poles)
        held = other.sample_system(system, 1 / RATE, "zoh")
        ours = control.held_matrices(linear.A, linear.B, 1 / RATE)
        for own, its in zip(ours, (held.A, held.B), strict=True):
            np.testing.assert_allclose(own, its, atol=1e-12)
        K, S, poles = other.dlqr(held, Q / RATE, R / RATE)
        found = control.regulator(linear, Q, R, rate=RATE)
        np.testing.assert_allclose(found.K, K, rtol=1e-8, atol=1e-8 * np.max(np.abs(K)))
        np.testing.assert_allclose(found.S, S, rtol=1e-8, atol=1e-8 * np.max(np.abs(S)))
        assert_same(found.poles, poles)


def assert_same(one, other):
    np.testing.assert_allclose(np.sort_complex(one), np.sort_complex(other), rtol=1e-7)


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")  # SciPy's, of its scaling
@pytest.mark.parametrize(
    ("Q", "R", "rate", "words"),
    [
        ([1.0, 1.0], 1e-30, None, "imaginary axis"),
        ([1.0, 1.0], 1e300, 50.0, "finite solution"),
        # what SciPy returns here without a word
        ([1e60, 1.0], 1.0, None, "a pole at"),
    ],
)  # fmt: skip
def test_weights_without_a_solution_are_refused(Q, R, rate, words):
    double_integrator = linear_of([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    match = rf"has no stabilising solution \(.*{words}.*Weights of very different sizes"
    with pytest.raises(stm.ModelError, match=match):
        control.regulator(double_integrator, Q, [R], rate=rate)
