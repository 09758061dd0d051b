"""Linearisation of any mechanism in independent coordinates.

About a point (x, u), with errors v of the state space and du of the inputs,

    v' = A v + B du,   y = C v + D du.

If the point moves, v is the departure from its motion.

Source: B. L. Stevens, F. L. Lewis, E. N. Johnson, Aircraft Control and Simulation (2016),
ch. 3.7 (linearisation), 1.2 (modes, controllability).
"""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError, StateError, named_places
from ..checks.numbers import check_numbers
from ..checks.shapes import Numbers
from ..dynamics.statespace.base import AbstractStateSpace, Time, check_regular, error_rate_columns
from ..math.compiler import kept_jit
from ..math.space import Point
from ..mechanics.inputs import Inputs, inputs_of

# Size of an eigenvalue below which it is that of a free rigid body, with round-off [1/s], and share of
# its size below which a real part is none.
AT_ZERO = 1e-3
_EPS = float(np.finfo(float).eps)
# Uncertainty of the shares of a mode beyond which they are refused: by round-off of every number of A in
# itself, and by round-off of the largest number of its row, which is what cancellation leaves where an
# exact derivative is zero.
_SHARES_EXACT, _SHARES_NOISE = 1e-6, 1e-3
# Circles around an eigenvalue on which its round-off is looked for: radii over its real part, and points.
_RADII = (0.5, 0.25, 0.75, 0.1, 0.9)
_CIRCLE = np.exp(2j * np.pi * (np.arange(16) + 0.5) / 16)


@dataclass(frozen=True)
class Mode:
    """Mode of the linear system; rigid-body modes have eigenvalues of zero but for round-off.

    Attributes:
        eigenvalue: eigenvalue of A [1/s].
        frequency: undamped frequency |s| / 2 pi [Hz].
        damping: damping ratio -Re s / |s| [1].
        doubling_time: time to double the amplitude [s], negative for the time to halve it, infinite
            where the real part is zero within round-off.
        states: states of largest participation (name, share); empty where `refusal` says why.
        refusal: reason why the shares are not determined; empty if they are.
    """

    eigenvalue: complex
    frequency: float
    damping: float
    doubling_time: float
    states: tuple[tuple[str, float], ...]
    refusal: str = ""


@dataclass(frozen=True)
class Linear:
    """Linear system x' = A x + B u, y = C x + D u, in NumPy arrays as python-control takes them.

    Attributes:
        A, B: state and input matrices (n, n), (n, m).
        C, D: output and feedthrough matrices (p, n), (p, m).
        states, inputs, outputs: (name, unit) of every row or column.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: tuple[tuple[str, str], ...]
    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[tuple[str, str], ...]

    def modes(self) -> list[Mode]:
        """Modes in order of decreasing real part, with the dominant states of each.

        The share of a state is |d s / d a_jj| over the sum of these, with the participation factors

            d s / d a_jj = conj(l_j) r_j / (l^H r),

        of left and right eigenvectors l, r. No matrix of eigenvectors is inverted: that of a machine with
        rigid-body modes is singular. The shares of an eigenvalue in a cluster, such as those at zero of a
        free body or those of two equal pendulums, are not determined; `refusal` gives the reason.

        Source: I. J. Perez-Arriaga, G. C. Verghese, F. C. Schweppe, Selective modal analysis, IEEE Trans.
        Power Apparatus and Systems 101 (1982) 3117-3125.
        """
        from scipy.linalg import eig  # slow to import

        # Left eigenvectors come from the same decomposition as the right ones: an inverse of the eigenvector
        # matrix does not exist for the Jordan blocks of a free body.
        A = _drop_round_off(self.A)
        values, rows, columns = eig(A, left=True, right=True)  # pyright: ignore[reportAssignmentType]
        modes = []
        for k in map(int, np.argsort(-np.real(values))):
            s = complex(values[k])
            shares, determined = _compute_participation(A, values, k, rows[:, k], columns[:, k])
            # equal shares, as of an angle and its rate, keep the order of the states
            order = np.argsort(-np.round(shares, 9), kind="stable")[:3]
            top = [(self.states[j][0], float(shares[j])) for j in order]
            size, refusal = abs(s), ""
            if not determined:
                gaps = np.abs(np.delete(values, k) - values[k])
                refusal = (
                    "shares are not determined: the eigenvalue is in a cluster, the next one is "
                    f"{float(np.min(gaps, initial=np.inf)):.1g} 1/s away"
                )
            modes.append(
                Mode(
                    s,
                    size / (2 * np.pi),
                    -s.real / size if size > 0 else 1.0,
                    float(np.log(2) / s.real) if _is_real_part_resolved(A, s) else float("inf"),
                    tuple(top) if determined else (),
                    refusal,
                )
            )
        return modes

    def controllability(self) -> np.ndarray:
        """Smallest singular value of (s I - A, B) at each eigenvalue s of A (n,).

        It is zero for an uncontrollable mode (Popov, Belevitch, Hautus). The columns of B are
        scaled to unit length.
        """
        return _hautus_distances(self.A, self.B)

    def observability(self) -> np.ndarray:
        """Smallest singular value of (s I - A; C) at each eigenvalue s of A (n,).

        It is zero for an unobservable mode. The rows of C are scaled to unit length.
        """
        return _hautus_distances(self.A.T, self.C.T)


def _drop_round_off(A: np.ndarray) -> np.ndarray:
    """Matrix whose numbers within round-off of the largest of their row are zero.

    LAPACK balances a matrix before it decomposes it: a number of 1e-15 that should be zero, as for the free
    fall of a base, then scales a row by orders of magnitude, and eigenvectors are wrong in every digit.

    Source: D. S. Watkins, A case where balancing is harmful, Electronic Trans. Numerical Analysis 23 (2006).
    """
    sizes = np.abs(A)
    largest = np.max(sizes, axis=1, keepdims=True, initial=0.0)
    return np.where(sizes <= len(A) * _EPS * largest, 0.0, A)


def _compute_participation(
    A: np.ndarray, values: np.ndarray, k: int, row: np.ndarray, column: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Shares (n,) of the states in mode k, and whether they hold.

    An error E of A changes the projector P = r l^H / (l^H r) by -(S E P + P E S), with the reduced
    resolvent S = sum P_i / (s_i - s) over the other modes, which is large where another eigenvalue is
    near. The bounds are taken component by component, so that they do not depend on units.

    Source: T. Kato, Perturbation Theory for Linear Operators (1980), ch. II.2.
    """
    n, s = len(A), values[k]
    size = float(np.max(np.abs(values))) or 1.0
    # Eigenvalues of a backward-stable method are exact for a matrix that differs from A by this much;
    # shares that such a difference changes are not determined.
    round_off = n * _EPS * np.abs(A)
    # what overflows belongs to a cluster
    with np.errstate(all="ignore"):
        P = np.outer(column, row.conj()) / (row.conj() @ column)
        noise = np.max(round_off, axis=1, keepdims=True) * np.ones(n)
        shares = np.abs(np.diag(P))
        shares = shares / np.sum(shares)
        try:
            S = np.linalg.inv(A - s * np.eye(n) + size * P) - P / size
        except np.linalg.LinAlgError:
            return shares, False
        P, S = np.abs(P), np.abs(S)
        # of a decoupled pair of equal eigenvalues only the numbers off the diagonal change to first order
        change = lambda C: np.sqrt(np.max(C * C.T))
        errors = [change(S @ E @ P + P @ E @ S) for E in (round_off, noise)]
        determined = errors[0] < _SHARES_EXACT and errors[1] < _SHARES_NOISE
    return shares, bool(determined)


def _is_real_part_resolved(A: np.ndarray, s: complex) -> bool:
    """True if no round-off of A moves the eigenvalue s, or one of its cluster, onto the imaginary axis.

    A matrix that differs from A by numbers up to E has no eigenvalue at z if the spectral radius of
    |(A - z)^-1| E is below one. Where that holds on a circle around s that does not reach the axis, eigenvalues
    stay inside. This holds for multiple ones too, such as those of critical damping, and not for the zeros
    of a free body, whatever their round-off is.

    Source: J. Demmel, The componentwise distance to the nearest singular matrix, SIAM J. Matrix
    Analysis 13 (1992) 10-19.
    """
    n = len(A)
    noise = n * _EPS * np.max(np.abs(A), axis=1, keepdims=True) * np.ones(n)

    def is_clear(z: complex) -> bool:
        with np.errstate(all="ignore"):
            try:
                growth = np.abs(np.linalg.inv(A - z * np.eye(n))) @ noise
            except np.linalg.LinAlgError:
                return False
        return bool(np.all(np.isfinite(growth)) and np.max(np.abs(np.linalg.eigvals(growth))) < 1)

    # other eigenvalues may lie on one circle, and not on all of them
    return s.real != 0 and any(
        all(is_clear(s + share * abs(s.real) * turn) for turn in _CIRCLE) for share in _RADII
    )


def _hautus_distances(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    # Inputs in rad^2/s^2 and in N differ by six orders: columns of unit length make the measure
    # independent of units.
    sizes = np.linalg.norm(B, axis=0)
    unit = B / np.where(sizes > 0, sizes, 1.0)
    pencils = [np.hstack([s * np.eye(len(A)) - A, unit]) for s in np.linalg.eigvals(A)]
    return np.array([np.linalg.svd(pencil, compute_uv=False)[-1] for pencil in pencils])


@kept_jit
def _compute_matrices(
    space: AbstractStateSpace, x: Point, inputs: Inputs, values: Array, t: Array
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
    """Matrices A and B at values of the inputs (m,) by forward derivatives."""
    # One forward pass over states and inputs together: both matrices come from the same evaluations of
    # the equations of motion.
    n = space.size
    system = lambda z: inputs.applied(space.system, values + z)
    J = error_rate_columns(space, x, t, system, len(inputs))
    return J[:, :n], J[:, n:]


def linearize(
    space: AbstractStateSpace,
    x: Point,
    inputs: Inputs | None = None,
    values: Numbers | None = None,
    *,
    outputs: Any = None,
    t: Time = 0.0,
) -> Linear:
    """Linearise about a trim, or about any point of a trajectory (without its own motion).

    Args:
        space: state space of the mechanism.
        x: point of the state space.
        inputs: see `inputs_of`; by default all inputs of the system.
        values: values of the inputs at the point (m,); by default those of the system.
        outputs: names of states that are measured, one or more; by default all.
        t: time [s], where forces or joints depend on it.

    Raises:
        SettingError: outputs that are unknown, an empty list, or not names.
        ModelError: another number of values than of inputs, or an input without a value.
        StateError: a posture that is singular for the independent coordinates, or derivatives that
            are not finite.
    """
    names, subject = [name for name, _ in space.names], "The outputs"
    if outputs is not None and not isinstance(outputs, str) and not len(outputs):
        raise SettingError(
            f"{subject} must be a list of names of states, such as ['{names[0]}'], not {outputs!r}."
        )
    chosen = named_places(names if outputs is None else outputs, names, subject, "state")
    inputs = inputs_of(space.system) if inputs is None else inputs
    values = inputs.values(space.system) if values is None else values
    input_values = check_numbers(values, (len(inputs),), "The vector of the inputs", "")
    check_regular(space, x, t)
    numbers = jnp.asarray(input_values, dtype=float), jnp.asarray(t, dtype=float)
    A, B = (np.asarray(matrix) for matrix in _compute_matrices(space, x, inputs, *numbers))
    if not (np.all(np.isfinite(A)) and np.all(np.isfinite(B))):
        raise StateError(
            "The motion cannot be linearised at this point: the accelerations or their derivatives "
            "are not finite. The point itself is not finite, or a force is discontinuous there."
        )
    C = np.eye(len(names))[list(chosen)]
    return Linear(
        A, B, C, np.zeros((len(C), B.shape[1])), space.names, inputs.names,
        tuple(space.names[k] for k in chosen),
    )  # fmt: skip
