"""Linear-quadratic regulators from the linearisation of any mechanism.

    u = u_0 - K v,   v the error of the state space between the estimate and the reference

minimises the sum, or the integral, of v^T Q v + du^T R du for the linear system.

Source: B. D. O. Anderson, J. B. Moore, Optimal Control: Linear Quadratic Methods (1990), ch. 2 to 4;
B. L. Stevens, F. L. Lewis, E. N. Johnson, Aircraft Control and Simulation (2016), ch. 5.3.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from ..analysis.linear import Linear
from ..checks.errors import ModelError
from ..checks.numbers import check_numbers
from ..checks.shapes import Numbers
from ..dynamics.statespace.base import AbstractStateSpace
from ..math.space import Point
from ..mechanics.state import State

# A singular value of the Hautus matrix below this fraction of the largest counts as zero.
_HAUTUS = 1e-9
# A mode counts as stable on its own if it decays by more than this share of its frequency.
_DECAYS = 1e-9
# Largest number of states that are named of a mode.
_NAMED = 6


@dataclass(frozen=True)
class Regulator:
    """Gains of a linear-quadratic regulator.

    Attributes:
        K: gains (m, n): du = -K v.
        S: solution of the Riccati equation (n, n): the cost from an error v is v^T S v.
        poles: closed-loop eigenvalues, of the continuous system [1/s] or, with a rate, of the
            sampled one [1].
        rate: control rate [Hz], or None for the continuous regulator.
    """

    K: np.ndarray
    S: np.ndarray
    poles: np.ndarray
    rate: float | None


def held_matrices(A: np.ndarray, B: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of x_k+1 = A_d x_k + B_d u_k for inputs held over a period [s]: exact, by an
    exponential of the block matrix (A, B; 0, 0).

    Source: C. F. Van Loan, IEEE Trans. Automatic Control 23 (1978) 395-404.
    """
    n, m = B.shape
    exponential = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * period)
    return exponential[:n, :n], exponential[:n, n:]


def regulator(linear: Linear, Q: Numbers, R: Numbers, *, rate: float | None = None) -> Regulator:
    """Linear-quadratic regulator of a linear system.

    Args:
        linear: matrices of `stmuav_jax.linearize`.
        Q: weights of the errors, positive semidefinite (n, n), or its diagonal (n,).
        R: weights of the inputs, positive definite (m, m), or its diagonal (m,).
        rate: control rate [Hz], for gains of the system with held inputs; None for continuous ones.

    Raises:
        ModelError: Q or R of another shape or sign; a mode that does not decay and is uncontrollable, or not
            penalised by Q (the message names the mode); a Riccati equation
            without solution.
    """
    A, B = linear.A, linear.B
    n, m = B.shape
    Q, R = _check_weights(Q, n, "Q", "semidefinite"), _check_weights(R, m, "R", "definite")
    _check_modes(linear, B, "The inputs cannot stabilise", "they do not move it")
    # Q sees what its square root sees
    _check_modes(linear, Q, "The weights Q do not determine", "they do not see it", transposed=True)
    solve = scipy.linalg.solve_continuous_are
    if rate is not None:
        if not 0 < rate < np.inf:
            raise ModelError(f"The rate of a regulator must be positive and finite, not {rate} Hz.")
        A, B = held_matrices(A, B, 1 / rate)
        Q, R = Q / rate, R / rate
        solve = scipy.linalg.solve_discrete_are
    try:
        S = solve(A, B, Q, R)
        if rate is None:
            K = np.linalg.solve(R, B.T @ S)
        else:
            K = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
        if not np.all(np.isfinite(K)):
            raise ValueError("the gains are not finite")
        poles = np.linalg.eigvals(A - B @ K)
        # SciPy returns some matrices that are no stabilising solution without a word
        growth = poles.real if rate is None else np.abs(poles) - 1
        if np.max(growth) >= 0:
            pole = poles[np.argmax(growth)]
            raise ValueError(f"the closed loop of the solution has a pole at {pole:.4g}")
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(
            f"The Riccati equation of the regulator has no stabilising solution ({error}). Weights of "
            "very different sizes can be the reason: scale errors by the sizes that they may have."
        ) from error
    return Regulator(K, S, poles, rate)


def _check_weights(weights: Numbers, size: int, name: str, kind: str) -> np.ndarray:
    """Weights as a symmetric matrix, positive "definite" or "semidefinite"."""
    shape = (size,) if np.ndim(weights) == 1 else (size, size)
    matrix = np.asarray(check_numbers(weights, shape, f"The weights {name} of the regulator", ""))
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    if not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0):
        raise ModelError(f"The weights {name} of the regulator must be a symmetric matrix.")
    values = np.linalg.eigvalsh(matrix)
    rounding = 1e-12 * max(values[-1], 0.0)
    if not (values[0] > 0 if kind == "definite" else values[0] >= -rounding):
        raise ModelError(
            f"The weights {name} of the regulator must be positive {kind}, but the smallest "
            f"eigenvalue is {values[0]:.3g}."
        )
    return matrix


def check_observable(linear: Linear) -> None:
    """Check that each mode of a linear system that does not decay by itself is observable by the outputs.

    An estimator cannot determine an unobservable mode.

    Args:
        linear: matrices of `stmuav_jax.linearize`, with the measured `outputs`.

    Raises:
        ModelError: an unobservable mode that does not decay; the message names the states in it.

    Source: M. L. J. Hautus, Controllability and observability conditions of linear autonomous systems,
    Indagationes Mathematicae 31 (1969) 443-448.
    """
    claim = "The outputs do not observe"
    _check_modes(linear, linear.C.T, claim, "they do not see it", transposed=True)


def _check_modes(
    linear: Linear, columns: np.ndarray, claim: str, cause: str, *, transposed: bool = False
) -> None:
    """Test of Popov, Belevitch and Hautus: raise `ModelError` for a mode that stays as it is."""
    A = linear.A.T if transposed else linear.A
    scale = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(scale > 0, scale, 1.0)
    size = np.linalg.norm(A, 2)
    for s in np.linalg.eigvals(A):
        if s.real < -_DECAYS * max(abs(s), 1.0):
            continue
        matrix = np.hstack([(s * np.eye(len(A)) - A) / max(size, 1.0), unit])
        left_vectors, values, _ = np.linalg.svd(matrix)
        if values[-1] < _HAUTUS:
            # all modes of this eigenvalue
            fixed = left_vectors[:, values < _HAUTUS]
            share = np.mean(np.abs(fixed) ** 2, axis=1)
            parts = ", ".join(
                f"{linear.states[k][0]} ({share[k]:.0%})"
                for k in np.argsort(-share, stable=True)[:_NAMED]
                if share[k] > 0.05
            )
            raise ModelError(
                f"{claim} the mode with eigenvalue {s:.4g} 1/s in {parts}: {cause} (smallest singular "
                f"value {values[-1]:.1e} in the test of Popov, Belevitch and Hautus), and it does not "
                "decay by itself."
            )


class StateFeedback(eqx.Module):
    """Controller u = u_0 - K v, with the error v from the reference to the estimate.

    The reference is a point of the space, or None for the point of the linearisation. The estimate
    is a point of the space or, where forces have no states, a `State` of all bodies.

    Args:
        space: state space of the linearisation.
        point: reference where none is given.
        inputs: u_0, inputs at the reference (m,).
        K: gains (m, n), or a `Regulator`.

    Raises:
        ModelError: inputs or gains that do not fit the space.
    """

    space: AbstractStateSpace
    point: Point
    inputs: Float[Array, " m"]
    K: Float[Array, "m n"]

    def __init__(
        self, space: AbstractStateSpace, point: Point, inputs: Numbers, K: Numbers | Regulator
    ) -> None:
        gains = K.K if isinstance(K, Regulator) else K
        count = np.shape(inputs)[0] if np.ndim(inputs) == 1 else 0
        self.space, self.point = space, point
        self.inputs = check_numbers(inputs, (count,), "The inputs of a state feedback", "")
        self.K = check_numbers(gains, (count, space.size), "The gains of a state feedback", "")

    def __call__(self, estimate: Any, reference: Any, memory: Any) -> tuple[Array, Any]:
        """Inputs (m,) and the unchanged memory."""
        space = self.space
        target = self.point if reference is None else reference
        if isinstance(estimate, State):
            if space.size != 2 * space.dof:
                raise ModelError(
                    "A state feedback of a system whose forces have states needs them in its "
                    "estimate: give the plant an estimator, or observe=point_of(space)."
                )
            # a state gives angles up to whole turns: those nearest to the target
            estimate = space.from_state(estimate, space.internal_at(target))
        return self.inputs - self.K @ space.difference(estimate, target), memory


def point_of(space: AbstractStateSpace) -> Any:
    """Function for `observe` of a plant: the true point of a space, with states of forces and turns."""

    def observe_point(t: Array, state: State, internal: Array) -> Point:
        del t
        return space.from_state(state, internal)

    return observe_point
