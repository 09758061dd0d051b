"""Prediction-error fit of a regression in time whose noise is coloured and fed back.

The model of each channel c is

    y_k = X_k(eta) theta + v_k,   A(z) v_k = e_k

with parameters theta, which the channels may share, lags eta, and white e. A(z), of high order, describes
coloured disturbances and sensor noise of any spectrum, as the innovations of a filter with states for
them do. The fit minimises the sum of squares of e / sigma_c over theta and eta, and estimates A and
sigma_c from v in turn. In closed loop the commands follow earlier disturbances, which biases a
regression with white v; e is independent of every earlier command, so this fit has no such bias. For the
same reason the regressors correlate with earlier v, so errors of A(z) add to those of theta: slopes are
those that remain beside the earlier v.

Source: L. Ljung, System Identification (1999), ch. 7.2 and 13.4; D. W. Clarke, IFAC Symposium on
Identification (1967), paper 3.17 (generalised least squares).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy import linalg, stats
from scipy.signal import oaconvolve

from ...analysis.fit_statistics import compute_block_covariance

# Most iterations, and step in deviations that ends them.
_ITERATIONS, _CONVERGED = 40, 0.01
# Share of the expected decrease that a step must have, and shortest share of a step.
_DECREASE, _SHORTEST = 0.1, 1 / 64
# Relative step of a difference quotient by a lag, and largest relative change of one in an iteration.
_DIFFERENCE, _LARGEST_CHANGE = 1e-4, 0.3


class Regression(NamedTuple):
    """Outputs and regressors at times of one grid.

    Attributes:
        y: outputs (k, c). X: regressors (k, c, p). dt: step of the grid [s].
    """

    y: Float[np.ndarray, "k c"]
    X: Float[np.ndarray, "k c p"]
    dt: float


class PredictionErrorFit(NamedTuple):
    """Fit at its minimum, and its linear model.

    Attributes:
        values: theta, then eta (n,). lag_count: number of eta.
        errors: prediction errors over their deviations (k, c).
        slopes: derivatives of the predictions by the values, whitened in the same way, less their part that
            A(z) can take on (k, c, n).
        noise: v (k + order, c).
        denominators: A(z) of each channel (c, order + 1). sigma: deviations of the errors (c,).
        dt: step of the grid [s].
        free: False for lags that ended at a bound (n,).
        is_converged: True if the last step was small.
    """

    values: Float[np.ndarray, " n"]
    lag_count: int
    errors: Float[np.ndarray, "k c"]
    slopes: Float[np.ndarray, "k c n"]
    noise: Float[np.ndarray, "j c"]
    denominators: Float[np.ndarray, "c o"]
    sigma: Float[np.ndarray, " c"]
    dt: float
    free: Bool[np.ndarray, " n"]
    is_converged: bool

    @property
    def lags(self) -> Float[np.ndarray, " l"]:
        """Lags eta."""
        return self.values[len(self.values) - self.lag_count :]

    def whiten(self, values: Float[np.ndarray, "k c m"]) -> Float[np.ndarray, "j c m"]:
        """Further columns in the same way as the slopes."""
        columns = _whiten_columns(self.denominators, values) / self.sigma[:, None]
        order = self.denominators.shape[1] - 1
        return _project_columns([_Past(v, order) for v in self.noise.T], columns)

    @property
    def white_covariance(self) -> Float[np.ndarray, "n n"]:
        """Covariance of the values if e is white; zero for lags at a bound."""
        J = self.slopes.reshape(-1, len(self.values))
        return _invert_information((J.T @ J)[np.ix_(self.free, self.free)], self.free)

    def compute_covariance(self, block: float) -> Float[np.ndarray, "n n"]:
        """Covariance of the values by sums of scores over blocks [s]."""
        scores = np.einsum("kcn,kc->kn", self.slopes, self.errors)
        rows = max(round(block / self.dt), 1)
        C = self.white_covariance
        return compute_block_covariance(C, scores, np.zeros_like(C), rows, 1)

    def fit_windows(
        self, count: int, covariance: Float[np.ndarray, "n n"], *, common_lags: bool = False
    ) -> tuple[Float[np.ndarray, "w n"], Float[np.ndarray, "w n n"]]:
        """Changes of the values in equal windows of the record, and their covariances.

        The errors of a window are as much larger than those of white e as those of the whole record,
        whose covariance is given.

        Args:
            common_lags: the lags are those of the whole record, whose error all windows share.
        """
        C = self.white_covariance
        size = np.sqrt(np.where(np.diag(C) > 0, np.diag(C), 1.0))
        ratio = np.maximum(np.sqrt(np.maximum(np.diag(covariance), 0.0)) / size, 1.0)
        free = self.free & ~(common_lags & (np.arange(len(C)) >= len(C) - self.lag_count))
        changes, covariances = [], []
        for rows in np.array_split(np.arange(len(self.errors)), count):
            J = self.slopes[rows].reshape(-1, len(size))[:, free]
            V = _invert_information(J.T @ J, free)
            changes.append(V[:, free] @ (J.T @ self.errors[rows].ravel()))
            covariances.append(V * ratio[:, None] * ratio)
        return np.array(changes), np.array(covariances)

    def test_columns(
        self, columns: Float[np.ndarray, "k c m"], block: float
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"], float]:
        """Coefficients of further columns, their covariance and the p-value that all are zero."""
        Z = self.whiten(columns)
        m = Z.shape[2]
        J, z = self.slopes[:, :, self.free].reshape(self.errors.size, -1), Z.reshape(-1, m)
        # Only what the fitted values cannot explain is new: their errors would otherwise show as
        # coefficients.
        z = z - J @ solve_columns(J, z)
        information = z.T @ z
        coefficients = linalg.solve(information, z.T @ self.errors.ravel(), assume_a="pos")
        scores = np.einsum("kcm,kc->km", z.reshape(Z.shape), self.errors)
        rows = max(round(block / self.dt), 1)
        C = np.linalg.inv(information)
        V = compute_block_covariance(C, scores, np.zeros_like(C), rows, 1)
        Q = float(coefficients @ np.linalg.solve(V, coefficients))
        # the widening of the covariance is that of Student's t, so Q is compared with a normal's
        return coefficients, V, float(stats.chi2.sf(Q, m))


def fit_prediction_error(
    build: Callable[[Float[np.ndarray, " l"]], Regression],
    lags: Float[np.ndarray, " l"],
    bounds: Sequence[tuple[float, float]],
    memory: float,
) -> PredictionErrorFit:
    """Fit theta and eta by prediction errors.

    Args:
        build: regression for lags eta. lags: start of eta (l,). bounds: lowest and highest of each.
        memory: length of A(z) [s].
    """
    eta = np.array(lags, float)
    regression = build(eta)
    y, X, dt = regression
    order = max(round(memory / dt), 2)
    p = X.shape[2]
    # a regression with white noise starts the search
    scale = np.std(y, axis=0)
    theta = solve_columns((X / scale[:, None]).reshape(-1, p), (y / scale).ravel())
    low, high = np.array(bounds, float).reshape(-1, 2).T
    iteration = 0
    state = _compute_errors(y, X, theta, order)
    while True:
        error, pasts, A, e, sigma = state
        # derivatives of the predictions by theta and by eta
        slopes = np.concatenate([X, np.zeros((*X.shape[:2], len(eta)))], axis=2)
        for j in range(len(eta)):
            h = _DIFFERENCE * max(eta[j], 0.005)
            h = -h if eta[j] + h > high[j] else h
            changed = eta + h * (np.arange(len(eta)) == j)
            slopes[:, :, p + j] = (build(changed).X - X) @ theta / h
        J = _project_columns(pasts, _whiten_columns(A, slopes) / sigma[:, None])
        free = np.ones(p + len(eta), bool)
        step = np.zeros(p + len(eta))
        while True:
            columns = J[:, :, free].reshape(-1, int(np.sum(free)))
            step[:] = 0.0
            step[free] = solve_columns(columns, (e / sigma).ravel())
            # A lag at a bound that would leave it is held, and the step is solved again: a step
            # that was merely clipped would leave theta at values that belong to other lags.
            stuck = ((eta <= low) & (step[p:] < 0)) | ((eta >= high) & (step[p:] > 0))
            if not np.any(stuck & free[p:]):
                break
            free[p:] &= ~stuck
        V = np.diag(_invert_information(columns.T @ columns, free))
        size = np.abs(step[free]) / np.sqrt(V[free])
        is_converged = iteration > 2 and bool(np.all(size < _CONVERGED))
        if not is_converged and iteration < _ITERATIONS:
            iteration += 1
            # Predictions are far from linear in a lag, so that a full step may overshoot. All values
            # take the same share of it, since the step of theta goes with that of eta.
            limit = _LARGEST_CHANGE * np.maximum(eta, 0.005)
            share = np.min(limit / np.maximum(np.abs(step[p:]), limit), initial=1.0)
            # The least sum of squares depends on A(z) too, which bends it more than the slopes tell: a
            # step that overshoots is halved.
            expected = float((e / sigma).ravel() @ (J @ step).ravel()) / len(e)
            while True:
                new_theta = theta + share * step[:p]
                new_eta = np.clip(eta + share * step[p:], low, high)
                new_X = build(new_eta).X if len(eta) else X
                state = _compute_errors(y, new_X, new_theta, order)
                decrease = -float(np.sum(np.log(state[-1] / sigma)))
                if decrease >= _DECREASE * share * expected:
                    break
                share = 0.5 * share
                if share < _SHORTEST:
                    # Where the delay passes a sample of the commands the slope by it jumps, and no share
                    # of a step of less than a deviation has a smaller sum.
                    is_converged = len(e) * expected < 1
                    iteration = _ITERATIONS
                    break
            if iteration < _ITERATIONS:
                theta, eta, X = new_theta, new_eta, new_X
                continue
        values = np.append(theta, eta)
        return PredictionErrorFit(
            values, len(eta), e / sigma, J, error, A, sigma, dt, free, is_converged
        )


def _compute_errors(y: np.ndarray, X: np.ndarray, theta: np.ndarray, order: int) -> tuple[Any, ...]:
    """Prediction errors of theta with the A(z) that makes them smallest.

    Returns:
        noise v (k + o, c), its earlier values, A(z) (c, o + 1), errors e (k, c) and their deviations (c,).
    """
    v = y - X @ theta
    pasts = [_Past(column, order) for column in v.T]
    A = np.array([
        np.append(1.0, -past.regress(column[order:]))
        for past, column in zip(pasts, v.T, strict=True)
    ])  # fmt: skip
    e = _whiten_columns(A, v[:, :, None])[:, :, 0]
    return v, pasts, A, e, np.sqrt(np.mean(e**2, axis=0))


class _Past:
    """Earlier values v_(k-1), ..., v_(k-order) of a channel as regressors."""

    def __init__(self, v: np.ndarray, order: int) -> None:
        self.rows = sliding_window_view(v, order)[:-1, ::-1]
        R = np.empty((order, order))
        R[0] = R[:, 0] = self.rows.T @ self.rows[:, 0]
        # a product of columns differs from that of their neighbours by what comes in and what goes out
        first, last = v[: order - 1][::-1], v[-order:-1][::-1]
        for k in range(order - 1):
            R[k + 1, 1:] = R[k, :-1] + first[k] * first - last[k] * last
        self.factor = linalg.cho_factor(R)

    def regress(self, values: np.ndarray) -> np.ndarray:
        """Coefficients of least squares."""
        return linalg.cho_solve(self.factor, self.rows.T @ values)


def _project_columns(pasts: Sequence[_Past], J: np.ndarray) -> np.ndarray:
    """Columns (k, c, n) less their regression on the earlier v of their channel."""
    parts = [J[:, j] - past.rows @ past.regress(J[:, j]) for j, past in enumerate(pasts)]
    return np.stack(parts, axis=1)


def _whiten_columns(A: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Columns (k, c, m) through A(z) of their channel, without the rows at the start."""
    return oaconvolve(values, A.T[:, :, None], mode="valid", axes=0)


def solve_columns(J: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Least-squares solution; columns of zeros have none."""
    scale = np.linalg.norm(J, axis=0)
    # With columns of one length the rank that least squares sees does not depend on units.
    scale = np.where(scale > 0, scale, 1.0)
    return (np.linalg.lstsq(J / scale, r, rcond=None)[0].T / scale).T


def _invert_information(M: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Inverse of the free values' information, with rows and columns of zeros for the others.

    What it does not determine has a very large variance.
    """
    size = np.sqrt(np.diag(M))
    size = np.where(size > 0, size, 1.0)
    # On a diagonal of ones the floor of the eigenvalues does not depend on units.
    values, vectors = np.linalg.eigh(M / size[:, None] / size)
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    whole = np.zeros((len(free), len(free)))
    whole[np.ix_(free, free)] = inverse / size[:, None] / size
    return whole
