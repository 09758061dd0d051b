"""Controllability of a linear system whose inputs have limits.

For v' = A v + B du with du in a box that allows v' = 0 somewhere inside, v is controllable near zero
if and only if (A, B) is controllable and no real left eigenvector w of A, w^T A = s w^T, has a
w^T B du that keeps one sign over the box. With limits of one-sided inputs, such as rotors that
cannot push down, this is more than the rank of a matrix.

Source: R. F. Brammer, Controllability in linear autonomous systems with positive controllers, SIAM
Journal on Control 10 (1972) 339-353; for multicopters G.-X. Du, Q. Quan, B. Yang, K.-Y. Cai,
Controllability analysis for multirotor helicopter rotor degradation and failure, Journal of
Guidance, Control, and Dynamics 38 (2015) 978-985.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from ...checks.errors import ModelError, SettingError
from ...checks.numbers import numbers
from ...checks.shapes import Numbers
from ...flight.linear import Linear

# Eigenvalues and singular values below this fraction of the largest count as zero.
_ZERO = 1e-7
# Influence of states that are left out on others, as a fraction of the largest number of A.
_INFLUENCE = 1e-9
# A margin below this counts as none: round-off of the linear programmes.
_NONE = 1e-9


@dataclass(frozen=True)
class InputMargin:
    """Margin of the inputs of a linear system within their limits.

    Attributes:
        margin: largest share of each input's range [1] that can be kept from both of its limits
            while no mode is pushed. Above zero, the limits leave the system controllable; below,
            the point itself can be held only with inputs beyond their limits by this share.
        controllable: true for a controllable system whose margin is above zero.
        inputs: inputs at this margin (m,), as departures from those of the linearisation.
        eigenvalue: of the modes that leave this margin [1/s].
        direction: combination of states (name, share of its square) that can be pushed in one
            direction alone, the largest first; empty for a controllable system.
    """

    margin: float
    controllable: bool
    inputs: np.ndarray
    eigenvalue: float
    direction: tuple[tuple[str, float], ...]


def without_states(linear: Linear, names: Sequence[str]) -> Linear:
    """Linear system without some states, such as an angle and its rate that are given up.

    Raises:
        SettingError: names that are no states, or states that the others depend on.
    """
    known = [name for name, _ in linear.states]
    for name in names:
        if name not in known:
            raise SettingError(f"There is no state '{name}'. States: {', '.join(known)}.")
    gone = [known.index(name) for name in names]
    kept = [k for k in range(len(known)) if k not in gone]
    influence = np.abs(linear.A[np.ix_(kept, gone)])
    if np.any(influence > _INFLUENCE * np.max(np.abs(linear.A))):
        row, column = divmod(int(np.argmax(influence)), len(gone))
        raise SettingError(
            f"The state '{names[column]}' cannot be left out: '{known[kept[row]]}' depends on it."
        )
    return replace(
        linear,
        A=linear.A[np.ix_(kept, kept)],
        B=linear.B[kept],
        C=linear.C[:, kept],
        states=tuple(linear.states[k] for k in kept),
    )


def input_margin(linear: Linear, lower: Numbers, upper: Numbers) -> InputMargin:
    """Controllability of a linear system within limits of its inputs, about its own point.

    For each real eigenvalue the left eigenvectors W give a linear programme: the largest s with
    W^T B du = 0 and lower + s range <= du <= upper - s range. Where s is zero or less, the
    programme's multipliers combine the eigenvectors to one that is pushed to one side alone. An
    input without a range, lower = upper, is held there.

    Args:
        linear: matrices of `stmuav_jax.linearize`.
        lower, upper: limits of the inputs (m,), as departures from those of the linearisation.

    Raises:
        ModelError: limits of another shape, or a lower one above an upper one.
    """
    count = linear.B.shape[1]
    low, high = (
        np.asarray(numbers(x, (count,), f"The {name} limits of the inputs", ""))
        for name, x in (("lower", lower), ("upper", upper))
    )
    if np.any(low > high):
        k = int(np.argmax(low > high))
        raise ModelError(
            f"The limits of the input '{linear.inputs[k][0]}' are {low[k]:g} to {high[k]:g}: the "
            "lower one is above the upper one."
        )
    found = [_margin(linear, s, W, low, high) for s, W in _left_eigenvectors(linear.A)]
    free = replace(linear, B=linear.B[:, low < high])
    moved = bool(np.all(free.controllability() > _ZERO)) if free.B.shape[1] else False
    if not found:
        half = InputMargin(0.5, moved, (low + high) / 2, float("nan"), ())
        return half
    least = min(found, key=lambda one: one.margin)
    return replace(least, controllable=least.controllable and moved)


def _left_eigenvectors(A: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Real eigenvalues of A, each once, with bases (n, k) of their left eigenvectors."""
    size = max(float(np.linalg.norm(A, 2)), 1e-300)
    values = np.linalg.eigvals(A)
    # eigenvalues of one Jordan block at zero are apart by a root of the round-off
    near = np.finfo(float).eps ** 0.25 * size
    kinds = [0.0] if np.linalg.svd(A, compute_uv=False)[-1] < _ZERO * size else []
    for s in sorted(x.real for x in values if abs(x) > near and abs(x.imag) < _ZERO * size):
        if not kinds or all(abs(s - other) > near for other in kinds):
            kinds.append(float(s))
    found = []
    for s in kinds:
        left, singular, _ = np.linalg.svd(A - s * np.eye(len(A)))
        found.append((s, left[:, singular < _ZERO * size]))
    return [(s, W) for s, W in found if W.shape[1]]


def _margin(
    linear: Linear, s: float, W: np.ndarray, low: np.ndarray, high: np.ndarray
) -> InputMargin:
    """Margin of the modes of one real eigenvalue."""
    span = high - low
    M = W.T @ linear.B
    scale = np.linalg.norm(M * np.where(span > 0, span, 1.0), axis=1)
    M = M / np.where(scale > 0, scale, 1.0)[:, None]
    count = len(low)
    # unknowns: shares of the ranges and the margin; sum of M du with du = low + span share
    unit = np.eye(count)
    free = (span > 0)[:, None] * np.ones((1, 1))
    result = scipy.optimize.linprog(
        np.append(np.zeros(count), -1.0),
        A_eq=np.hstack([M * span, np.zeros((len(M), 1))]),
        b_eq=-M @ low,
        A_ub=np.vstack([np.hstack([unit, free]), np.hstack([-unit, free])]),
        b_ub=np.append(np.ones(count), np.zeros(count)),
        bounds=[(None, None)] * count + [(None, 0.5)],
        method="highs",
    )
    if result.status != 0:
        # no speeds whatever hold the point: some mode is moved by inputs that have no range
        return InputMargin(-np.inf, False, np.full(count, np.nan), s, _shares(linear, W))
    margin, inputs = float(result.x[-1]), low + span * result.x[:-1]
    if margin > _NONE and np.linalg.matrix_rank(M * span, tol=_ZERO) == len(M):
        return InputMargin(margin, True, inputs, s, ())
    weights = np.asarray(result.eqlin.marginals) / np.where(scale > 0, scale, 1.0)
    if not np.any(weights):
        # rows that depend on each other: the combination that no input moves
        weights = np.linalg.svd(M * span)[0][:, -1] / np.where(scale > 0, scale, 1.0)
    return InputMargin(min(margin, 0.0), False, inputs, s, _shares(linear, W @ weights))


def _shares(linear: Linear, w: np.ndarray) -> tuple[tuple[str, float], ...]:
    """Largest states of a combination (n,) or of several (n, k), with shares of its square."""
    square = np.sum(w.reshape(len(w), -1) ** 2, axis=1)
    square = square / np.sum(square)
    order = np.argsort(-square)[:3]
    return tuple((linear.states[k][0], float(square[k])) for k in order if square[k] > 0.01)
