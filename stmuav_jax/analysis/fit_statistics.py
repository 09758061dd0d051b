"""Statistics of a least-squares fit to a record in time: deviations for correlated residuals, and a verdict.

With whitened residuals r (k rows in time, m columns) and their Jacobian J, errors of the estimates
have the covariance A^-1, A = J^T J, if r is white with deviations of one. If r is correlated, sums of the
scores J_i^T r_i over blocks of rows longer than the correlation take its place,

    A^-1 B A^-1,    B = sum over overlapping blocks (sum of scores) (sum of scores)^T / length.

Windows of the record, each with its own parameters, show whether the parameters are constant at all.

Source: W. K. Newey, K. D. West, Econometrica 55 (1987) 703-708 (covariance by overlapping blocks);
G. M. Ljung, G. E. P. Box, Biometrika 65 (1978) 297-303 (whiteness); R. DerSimonian, N. Laird,
Controlled Clinical Trials 7 (1986) 177-188 (scatter between windows).
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Status = Literal["consistent", "inconsistent", "undecided", "failed"]

# Tests of a verdict; each is made at the level over their number.
TESTS = ("size", "whiteness", "drift", "outliers", "windows", "start")
# Probability that a right model and right deviations are called inconsistent.
LEVEL = 0.01
# Lags of the test for whiteness [rows].
_LAGS = 10
# Stretches of a record whose means the test for drift compares.
_STRETCHES = 16
# Fewest numbers beyond the parameters for a verdict.
_FEWEST = 20
# Length of a block in reaches of the correlation.
_REACHES = 4
# Fewest blocks for a covariance; more where there are many unknowns.
_FEWEST_BLOCKS = 12
# Condition number of the windows' equations from which they do not determine their parameters.
_SINGULAR = 1e10
# Fewest blocks, or rows per parameter, in a window, and most windows.
_WINDOW_BLOCKS, _WINDOW_ROWS, _MOST_WINDOWS = 6, 10, 5
# Step to the minimum that counts as none, in standard deviations.
_AT_MINIMUM = 0.1


class Fit(NamedTuple):
    """Residuals and derivatives at the end of a fit.

    Attributes:
        residuals: residuals over their deviations, zero where missing (k, m).
        measured: False where a number of the record is missing (k, m).
        slopes: derivatives of the residuals by n unknowns (k, m, n): the p parameters, in units of
            their sizes, then the errors of the start in units of its prior.
        start: errors of the start (n - p,), a priori independent with deviations of one.
    """

    residuals: Float[np.ndarray, "k m"]
    measured: Bool[np.ndarray, "k m"]
    slopes: Float[np.ndarray, "k m n"]
    start: Float[np.ndarray, " s"]

    @property
    def parameters(self) -> int:
        """Number of parameters p."""
        return self.slopes.shape[2] - len(self.start)

    @property
    def information(self) -> Float[np.ndarray, "n n"]:
        """Matrix A with that of the prior of the start."""
        J = self.slopes.reshape(-1, self.slopes.shape[2])
        return J.T @ J + self.prior

    @property
    def scores(self) -> Float[np.ndarray, "k n"]:
        """Scores J_i^T r_i of the rows."""
        return np.einsum("kmn,km->kn", self.slopes, self.residuals)

    @property
    def gradient(self) -> Float[np.ndarray, " n"]:
        """Half the derivative of the sum of squares by the unknowns."""
        prior = np.append(np.zeros(self.parameters), self.start)
        return np.sum(self.scores, axis=0) + prior

    @property
    def projected(self) -> Float[np.ndarray, "r p"]:
        """Jacobian by the parameters, less what the unknown start can take on."""
        p, s = self.parameters, len(self.start)
        J = self.slopes.reshape(-1, p + s)
        J = np.concatenate([J, np.eye(p + s)[p:]])
        if not s:
            return J
        Q, _ = np.linalg.qr(J[:, p:])
        return J[:, :p] - Q @ (Q.T @ J[:, :p])

    @property
    def prior(self) -> Float[np.ndarray, "n n"]:
        """Information of the prior of the start."""
        return np.diag(np.arange(self.slopes.shape[2]) >= self.parameters).astype(float)


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of the estimates, with their parts.

    The combination is scale * white where the residuals are white, else blocks; the scatter of the
    windows is added to it as an independent error.

    Attributes:
        white: those of white residuals with the given deviations (p,).
        scale: square root of the reduced chi-squared where that is larger than chance allows, else 1.
        blocks: those from blocks of correlated residuals (p,); None where the residuals are white.
        block_rows: rows of a block. correlation_rows: rows over which residuals are correlated.
        windows: scatter of the parameters between windows beyond their deviations (p,); zero where the
            windows agree.
        window_values: estimates in each window (w, p); None for a record that is too short.
        window_deviations: their standard deviations (w, p).
    """

    white: Float[np.ndarray, " p"]
    scale: float
    blocks: Float[np.ndarray, " p"] | None
    block_rows: int
    correlation_rows: int
    windows: Float[np.ndarray, " p"]
    window_values: Float[np.ndarray, "w p"] | None
    window_deviations: Float[np.ndarray, "w p"] | None

    def scaled(self, sizes: Float[np.ndarray, " p"]) -> "Deviations":
        """Deviations in the parameters' units, from those over their sizes."""
        of = lambda x: None if x is None else x * sizes
        return replace(
            self, white=self.white * sizes, blocks=of(self.blocks), windows=self.windows * sizes,
            window_values=of(self.window_values), window_deviations=of(self.window_deviations),
        )  # fmt: skip


class FitVerdict(NamedTuple):
    """Verdict on a fit.

    Attributes:
        status: "consistent"; "inconsistent": a test or a physical bound rejects the model or the
            deviations of the record; "undecided": too few numbers; "failed": not at a minimum.
        p_values: p-value of every test that was made, by its name.
        chi_square_interval: interval of the reduced chi-squared at the level of its test.
        level: probability with which a correct model is called inconsistent.
        explanation: sentences on the findings and their usual causes.
    """

    status: Status
    p_values: dict[str, float]
    chi_square_interval: tuple[float, float]
    level: float
    explanation: str

    @property
    def significant_tests(self) -> tuple[str, ...]:
        """Names of the tests that were significant."""
        return tuple(name for name, p in self.p_values.items() if p < self.level / len(TESTS))


def compute_autocorrelation(
    r: Float[np.ndarray, "k m"], measured: Bool[np.ndarray, "k m"], lags: int
) -> Float[np.ndarray, "l m"]:
    """Autocorrelation of each column at lags from one, over the root of the number of pairs.

    For white residuals each is a standard normal number.
    """
    correlations = np.zeros((lags, r.shape[1]))
    power = np.sum(r**2, axis=0) / np.maximum(np.sum(measured, axis=0), 1)
    for lag in range(1, lags + 1):
        pairs = np.sum(measured[lag:] & measured[:-lag], axis=0)
        products = np.sum(r[lag:] * r[:-lag], axis=0)
        correlations[lag - 1] = (
            products / np.sqrt(np.maximum(pairs, 1)) / np.where(power > 0, power, 1.0)
        )
    return correlations


def _test_whiteness(fit: Fit) -> float | None:
    """P-value of Ljung and Box's test, of the column that is least white."""
    from scipy.stats import chi2

    # Ljung and Box's sum needs lags that are short against the record, else its distribution is not chi-
    # squared.
    lags = min(_LAGS, len(fit.residuals) // 5)
    if lags < 1:
        return None
    total = np.sum(compute_autocorrelation(fit.residuals, fit.measured, lags) ** 2, axis=0)
    return float(min(1.0, np.min(chi2.sf(total, lags)) * len(total)))


def _test_drift(fit: Fit) -> float | None:
    """P-value of the means of stretches, of the column in which they differ most from zero."""
    from scipy.stats import chi2

    r, measured = fit.residuals, fit.measured
    if len(r) < 5 * _STRETCHES:
        return None
    power = np.sum(r**2, axis=0) / np.maximum(np.sum(measured, axis=0), 1)
    # Slow errors of a model hide from short lags: their sign stays over a fifth of the record.
    begins = np.arange(_STRETCHES) * len(r) // _STRETCHES
    count = np.add.reduceat(measured.astype(float), begins, axis=0)
    square = np.add.reduceat(r, begins, axis=0) ** 2
    total = np.sum(square / np.maximum(count, 1), axis=0) / np.where(power > 0, power, 1.0)
    return float(min(1.0, np.min(chi2.sf(total, np.sum(count > 0, axis=0))) * r.shape[1]))


def _correlation_rows(fit: Fit) -> int:
    """Rows after which no column's autocorrelation differs from that of white residuals."""
    k = len(fit.residuals)
    count = np.maximum(np.sum(fit.measured, axis=0), 1)
    # circular sums by the fast Fourier transform, padded so that nothing wraps round
    spectrum = np.abs(np.fft.rfft(fit.residuals, 2 * k, axis=0)) ** 2
    products = np.fft.irfft(spectrum, 2 * k, axis=0)[: max(k // 2, 1)]
    share = products / np.where(products[0] > 0, products[0], 1.0)
    low = share < 2 / np.sqrt(count)
    first = np.where(np.any(low, axis=0), np.argmax(low, axis=0), len(low))
    return int(np.max(first))


def _moving_sums(scores: Float[np.ndarray, "k n"], length: int) -> Float[np.ndarray, "j n"]:
    """Sums of the rows of all overlapping blocks, those that reach over the ends included."""
    none = np.zeros((length, scores.shape[1]))
    # Differences of running sums give all overlapping blocks in one pass over the rows.
    total = np.cumsum(np.concatenate([none, scores, none[:-1]]), axis=0)
    return total[length:] - np.concatenate([none[:1], total[:-1]])[: len(total) - length]


def compute_block_covariance(
    C: Float[np.ndarray, "n n"],
    scores: Float[np.ndarray, "k n"],
    prior: Float[np.ndarray, "n n"],
    length: int,
    unknowns: int,
) -> Float[np.ndarray, "n n"]:
    """Covariance by blocks of scores; the prior's own scores have the covariance `prior`."""
    from scipy.stats import norm, t

    sums = _moving_sums(scores, length)
    count = len(scores) / length
    # Fitted residuals are smaller than the noise, by as many blocks as there are unknowns. Overlapping blocks
    # are worth half as many more; few of them do not tell the deviations well, which Student's quantile
    # for 95 % makes up for.
    widening = t.ppf(0.975, max(1.5 * count - unknowns, 1.0)) / norm.ppf(0.975)
    B = sums.T @ sums / length * count / max(count - unknowns, 1.0)
    return C @ (widening**2 * B + prior) @ C


def compute_deviations(
    fit: Fit, p_values: dict[str, float], chi_square: float, values: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "n n"], Deviations, float | None]:
    """Covariance of the unknowns (n, n), what it is made of, and the p-value of the windows.

    Args:
        p_values: those of whiteness, drift and size. values: parameters over their sizes (p,).
    """
    limit, p = LEVEL / len(TESTS), fit.parameters
    n, k = fit.slopes.shape[2], len(fit.residuals)
    # The Gauss-Newton matrix is the information of white residuals; its inverse is the first of the
    # deviations' parts.
    C = np.linalg.inv(fit.information)
    white = np.sqrt(np.diag(C)[:p])
    # Residuals below their stated size may be a pessimistic sigma, and never make deviations smaller.
    too_large = p_values.get("size", 1.0) < limit and chi_square > 1
    scale = float(np.sqrt(chi_square)) if too_large else 1.0
    whiteness, drift = (p_values.get(name, 1.0) < limit for name in ("whiteness", "drift"))
    reach, length, blocks, total = 1, 1, None, C * scale**2
    if whiteness or drift:
        # Blocks have to be long against the correlation of the residuals, and there have to be many of them:
        # the length is a compromise of bias and variance.
        reach = max(_correlation_rows(fit), 1)
        block_rows = max(_REACHES * reach, k // _STRETCHES if drift and not whiteness else 2)
        length = max(min(block_rows, k // max(_FEWEST_BLOCKS, 2 * p)), 1)
        total = compute_block_covariance(C, fit.scores, fit.prior, length, p)
        blocks = np.sqrt(np.diag(total)[:p])
    scatter, p_windows, estimates, spread = np.zeros(p), None, None, None
    windows = _fit_windows(fit)
    if windows is not None:
        change, covariance, degrees = windows
        estimates = values + change
        spread = np.sqrt(np.diag(covariance)).reshape(estimates.shape)
        of_parameter = [
            compare_estimates(change[:, j], covariance[j::p, j::p], limit / p, degrees)
            for j in range(p)
        ]
        scatter, p_each = np.array(of_parameter).T
        p_windows = min(1.0, float(np.min(p_each)) * p)
    total = total + np.diag(np.append(scatter**2, np.zeros(n - p)))
    deviations = Deviations(white, scale, blocks, length, reach, scatter, estimates, spread)
    return total, deviations, p_windows


def _fit_windows(
    fit: Fit,
) -> tuple[Float[np.ndarray, "w p"], Float[np.ndarray, "j j"], float | int] | None:
    """Fit in which every window of a record has parameters of its own; the start is common.

    There are as many windows as the record allows; the result is None if it is too short for two, else
    the change of the parameters from those of the whole record (w, p), the covariance of all these
    parameters (w p, w p), and the degrees of freedom behind it.

    The linear model at the minimum has residuals of its own: those of the whole record are correlated already
    if its parameters change.
    """
    p, k = fit.parameters, len(fit.residuals)
    for count in range(_MOST_WINDOWS, 1, -1):
        if k * fit.residuals.shape[1] < count * _WINDOW_ROWS * p or k < count * _WINDOW_ROWS:
            continue
        # Parameters of each window and a common start: if the model is right, the windows agree within their
        # deviations; what they differ by beyond is added as scatter.
        window = np.minimum(np.arange(k) * count // k, count - 1)
        X = np.zeros((*fit.residuals.shape, count * p + len(fit.start)))
        for w in range(count):
            X[window == w, :, w * p : (w + 1) * p] = fit.slopes[window == w, :, :p]
        X[:, :, count * p :] = fit.slopes[:, :, p:]
        joint_fit = Fit(fit.residuals, fit.measured, X, fit.start)
        M = joint_fit.information
        size = np.sqrt(np.diag(M))
        if np.any(size == 0) or np.linalg.cond(M / size[:, None] / size) > _SINGULAR:
            continue
        C = np.linalg.inv(M)
        # One Gauss-Newton step from the common minimum is enough, as the windows are a linear model about it.
        step = -C @ joint_fit.gradient
        residuals = np.where(fit.measured, fit.residuals + X @ step, 0.0)
        window_fit = joint_fit._replace(residuals=residuals, start=fit.start + step[count * p :])
        degrees = max(int(np.sum(fit.measured)) - count * p, 1)
        whiteness = _test_whiteness(window_fit)
        if whiteness is None or whiteness >= LEVEL / len(TESTS):
            V = C * max(np.sum(residuals**2) / degrees, 1.0)
        else:
            length = _REACHES * max(_correlation_rows(window_fit), 1)
            if k < count * _WINDOW_BLOCKS * length:
                continue
            V = compute_block_covariance(C, window_fit.scores, window_fit.prior, length, count * p)
            degrees = k / length
        places = slice(0, count * p)
        return step[places].reshape(count, p), V[places, places], degrees
    return None


def compare_estimates(
    values: Float[np.ndarray, " w"],
    covariance: Float[np.ndarray, "w w"],
    level: float = LEVEL,
    degrees: float | int = np.inf,
) -> tuple[float, float]:
    """Scatter of estimates of one quantity beyond their deviations, and the p-value that they agree.

    Args:
        covariance: of the values. level: p-value from which the scatter is zero. degrees: degrees of freedom
            behind the covariance; infinite for one that is known.
    """
    from scipy.stats import chi2, f

    count, weight = len(values), 1 / np.diag(covariance)
    # deviations of very different sizes: the inverse is that of the correlations
    size = np.sqrt(np.outer(weight, weight))
    W = np.linalg.inv(covariance * size) * size
    rest = values - np.sum(W @ values) / np.sum(W)
    Q = float(rest @ W @ rest)
    is_known = not np.isfinite(degrees)
    p_value = float(
        chi2.sf(Q, count - 1) if is_known else f.sf(Q / (count - 1), count - 1, degrees)
    )
    if p_value >= level:
        return 0.0, p_value
    excess = weight @ (values - weight @ values / np.sum(weight)) ** 2 - (count - 1)
    spare = np.sum(weight) - np.sum(weight**2) / np.sum(weight)
    return float(np.sqrt(max(excess / spare, 0.0))), p_value


def compute_p_values(fit: Fit) -> tuple[dict[str, float], float, tuple[float, float]]:
    """P-values of the tests of the residuals, reduced chi-squared and the interval of that."""
    from scipy.stats import chi2, norm

    numbers = int(np.sum(fit.measured))
    degrees = max(numbers - fit.parameters, 1)
    total = float(np.sum(fit.residuals**2) + fit.start @ fit.start)
    tails = chi2.cdf(total, degrees), chi2.sf(total, degrees)
    p_values = {"size": float(min(1.0, 2 * min(tails)))}
    for name, p_value in (("whiteness", _test_whiteness(fit)), ("drift", _test_drift(fit))):
        if p_value is not None:
            p_values[name] = p_value
    rms = np.sqrt(max(total / degrees, 1.0))
    largest = float(np.max(np.abs(fit.residuals), initial=0.0)) / rms
    p_values["outliers"] = float(
        -np.expm1(numbers * np.log1p(-min(2 * norm.sf(largest), 1 - 1e-16)))
    )
    if np.any(fit.start != 0):
        p_values["start"] = float(chi2.sf(fit.start @ fit.start, np.count_nonzero(fit.start)))
    tail = LEVEL / len(TESTS) / 2
    low, high = chi2.ppf([tail, 1 - tail], degrees) / degrees
    return p_values, total / degrees, (float(low), float(high))


def judge_fit(
    fit: Fit,
    p_values: dict[str, float],
    chi_square: float,
    interval: tuple[float, float],
    deviations: Deviations,
    covariance: Float[np.ndarray, "n n"],
    labels: tuple[str, ...],
    *,
    bound_labels: tuple[str, ...] = (),
    faults: tuple[str, ...] = (),
    is_start_exact: bool = False,
) -> FitVerdict:
    """Verdict on a fit, with its explanation.

    Args:
        bound_labels: parameters that ended at a bound. faults: sentences on physical bounds that the
            estimates break. is_start_exact: the motion's start was taken as exact.
    """
    significant = [name for name in TESTS if p_values.get(name, 1.0) < LEVEL / len(TESTS)]
    # the largest step to the minimum of the linear model, in deviations
    p, gradient = fit.parameters, fit.gradient
    free = np.array([k >= p or labels[k] not in bound_labels for k in range(len(gradient))])
    step = np.zeros(len(gradient))
    step[free] = np.linalg.solve(fit.information[np.ix_(free, free)], gradient[free])
    share = np.abs(step[:p]) / np.sqrt(np.diag(covariance)[:p])
    worst = int(np.argmax(share))
    missing, spare = 1 - np.mean(fit.measured), int(np.sum(fit.measured)) - p
    expected = f"expected {interval[0]:.3g} to {interval[1]:.3g}"
    status: Status
    if not share[worst] <= _AT_MINIMUM:  # a step that is not a number is no minimum
        status, sentence = "failed", (
            f"Failed: the search is not at a minimum; a step of the linear model moves {labels[worst]} by "
            f"{share[worst]:.2g} of its deviations: values and deviations mean little."
        )  # fmt: skip
    elif significant or faults:
        named = ", ".join(significant + ["physical bounds"] * bool(faults))
        status = "inconsistent"
        sentence = f"Inconsistent: {named} (family-wise level {LEVEL:g})."
    elif spare < _FEWEST:
        status, sentence = "undecided", (
            f"Undecided: the record has {spare} numbers beyond the parameters, and {_FEWEST} are needed."
        )  # fmt: skip
    else:
        status, sentence = "consistent", (
            f"Consistent: none of {len(p_values)} tests at a family-wise level of {LEVEL:g} rejects the "
            f"model; chi-squared per degree of freedom {chi_square:.3g}, {expected}."
        )  # fmt: skip
    sentences = [sentence, *faults]
    # what the significant tests point to
    causes = {
        ("size",): f"Chi-squared per degree of freedom is {chi_square:.3g}, {expected} (p = "
        f"{p_values['size']:.2g}): residuals are {'larger' if chi_square > 1 else 'smaller'} than the record's "
        "deviations say.",
        (
            "whiteness",
            "drift",
        ): "Residuals are correlated in time: the model leaves something out (a lag, a "
        "bias, a force), or the record's errors are not white; values may be off by more than their deviations.",
        (
            "windows",
        ): "Windows of the record disagree: the parameters are not constant, or the model is wrong.",
        (
            "outliers",
        ): "Single readings lie far out: mark them as missing (NaN) if they are faulty.",
        ("start",): "The start is further from its prior than its deviations allow.",
    }
    sentences += [text for tests, text in causes.items() if set(tests) & set(significant)]
    if significant and is_start_exact:
        sentences.append(
            "The start was taken as exact: if it is not, give its standard deviations (start_deviations)."
        )
    # how the standard deviations were made
    rows, reach = deviations.block_rows, deviations.correlation_rows
    if deviations.blocks is not None:
        ratio = deviations.blocks / deviations.white
        sentences.append(
            f"Standard deviations are by blocks of {rows} rows, since residuals are correlated over some "
            f"{reach} rows: they are {np.min(ratio):.3g} to {np.max(ratio):.3g} times those of white residuals."
        )
        if rows < _REACHES * reach:
            sentences.append(
                "The record has too few correlation times for blocks that are long enough: "
                "the deviations are lower bounds."
            )
    elif deviations.scale > 1:
        sentences.append(
            f"Standard deviations are {deviations.scale:.3g} times those of the given noise, as the "
            "residuals are."
        )
    if wide := [label for label, x in zip(labels, deviations.windows, strict=True) if x > 0]:
        sentences.append(
            f"The scatter between windows is added to the deviations of {', '.join(wide)}."
        )
    sentences += [
        f"The parameter {name} ended at its bound: its deviation is not that of a free one."
        for name in bound_labels
    ]
    if missing > 0:
        sentences.append(f"{missing:.1%} of the record is missing and was left out.")
    if p_values.get("windows") is None and status != "failed":
        sentences.append("The record is too short to compare windows of it.")
    return FitVerdict(status, p_values, interval, LEVEL, " ".join(sentences))
