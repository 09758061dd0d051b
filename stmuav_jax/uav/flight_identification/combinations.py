"""Combinations of quantities that a record determines where it determines none of them alone.

In natural units, in which a deviation of one is the largest of a quantity that counts as determined, the singular
vectors of the information are those of the covariance. One with a deviation below one is a determined combination.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Weights of a combination below this are not named.
_NAMED = 0.05


class Combination(NamedTuple):
    """Weighted sum of quantities, the largest weight in natural units being one.

    Attributes:
        weights: of the quantities (n,). value, deviation: of the sum, in the unit of its largest term.
    """

    weights: Float[np.ndarray, " n"]
    value: float
    deviation: float


def find_combinations(
    values: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
    largest: Float[np.ndarray, " n"],
) -> list[Combination]:
    """Determined combinations of the quantities that are not determined themselves, the best one first.

    Args:
        values: estimates. covariance: of them. largest: deviations up to which they are determined.
    """
    loose = np.sqrt(np.diag(covariance)) > largest
    V = (covariance / largest / largest[:, None])[np.ix_(loose, loose)]
    variances, vectors = np.linalg.eigh(V)
    combinations = []
    for variance, vector in zip(variances, vectors.T, strict=True):
        if variance < 1:
            weights = np.zeros(len(values))
            weights[loose] = vector / largest[loose]
            weights /= weights[np.argmax(np.abs(weights * largest))]
            deviation = np.sqrt(max(weights @ covariance @ weights, 0.0))
            combinations.append(Combination(weights, float(weights @ values), float(deviation)))
    return combinations


def describe_combinations(
    names: Sequence[str],
    unit: str,
    values: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
    largest: Float[np.ndarray, " n"],
) -> str:
    """Sentence after a blank on the combinations of undetermined quantities of one unit; empty for fewer than two.

    Without a unit it names no values.
    """
    sums = []
    for weights, value, deviation in find_combinations(values, covariance, largest):
        terms = [
            f"{'-' if w < 0 else '+'} {'' if abs(abs(w) - 1) < _NAMED else f'{abs(w):.2g} '}{name}"
            for w, name in zip(weights, names, strict=True)
            if abs(w) > _NAMED
        ]
        text = " ".join(terms).removeprefix("+ ")
        sums.append(f"{text} = {value:.3g} +- {deviation:.2g} {unit}" if unit else text)
    if np.sum(np.sqrt(np.diag(covariance)) > largest) < 2:
        return ""
    if not sums:
        return " No combination of them is determined either."
    return f" Only {'; '.join(sums)} {'is' if len(sums) == 1 else 'are'} determined."
