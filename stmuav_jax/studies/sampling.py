"""Sampling of a study's uncertain parameters: sample i depends on the seed and on i alone.

Designs:
- random: independent samples, from a counter-based generator (Philox).
- latin: Latin hypercubes of a declared number of samples, one after the other.
- sobol: a scrambled Sobol sequence; best in powers of two.
- saltelli: base points, pairs of independent points A and B, simulated as A, B, and A with one
  factor after the other taken from B: d + 2 samples per base point, for Sobol indices
  (`sensitivity.sobol`).
- table: the rows of given columns, in order.

Correlated factors are joined by a Gaussian copula: the matrix is that of the normal variables
behind the factors. Factors keep their distributions; their rank correlation is
(6 / pi) asin(rho / 2). The copula makes a hypercube or Sobol sequence less even.

Source: Owen (2020) arXiv:2008.08051 (why the first Sobol point stays in); Saltelli et al. (2010),
Comput. Phys. Commun. 181, 259-270, the layout of A, B and AB.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np
from jaxtyping import Float

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import SHOWN, quote_name, validate_model
from .distribution import as_distribution
from .schema import Design, Drawing

DESIGNS = get_args(Design)

# SciPy can skip forward only in sequences of up to 32 bits.
SOBOL_BITS = 31
SOBOL_POINTS = 2**SOBOL_BITS

# Index of the random stream of each design.
_STREAM = {name: k for k, name in enumerate(DESIGNS)}


@dataclasses.dataclass(frozen=True)
class Sampling:
    """Sampling design of a study.

    Attributes:
        factors: distributions of the d factors by name: frozen ones of `scipy.stats`, numbers or
            plain forms, kept as `Distribution`s; in a table, empirical ones (its columns) or
            constants.
        seed: a whole number >= 0.
        design: one of `DESIGNS`.
        correlation: correlations of the normal variables behind the factors, (name, name, rho).
        stratum: number of samples of one Latin hypercube; only for that design.

    Raises:
        SettingError: no factors, an unknown design, a negative seed, a correlation that is not
            positive definite or that the design cannot have, a stratum where none belongs.
    """

    factors: Mapping[str, Any]
    seed: int
    design: str = "random"
    correlation: Sequence[tuple[str, str, float]] = ()
    stratum: int | None = None

    def __post_init__(self) -> None:
        distributions = {
            name: as_distribution(factor, name) for name, factor in self.factors.items()
        }
        object.__setattr__(self, "factors", distributions)
        object.__setattr__(self, "correlation", tuple(map(tuple, self.correlation)))
        _check_sampling(self)
        if self.correlation:
            self._correlation_root()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the factors, in the order of the sampled columns."""
        return tuple(self.factors)

    @property
    def limit(self) -> int | None:
        """Largest number of samples; None for an unlimited design."""
        if self.design == "table":
            return max(len(factor.parameters.get("values", ())) for factor in self.factors.values())
        rows = {"sobol": 1, "saltelli": len(self.factors) + 2}.get(self.design)
        return None if rows is None else SOBOL_POINTS * rows

    def draw(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """Values of the factors in samples first, ..., first + count - 1, in their own units.

        Raises:
            SettingError: a negative number, or samples beyond the design's end.
        """
        if first < 0 or count < 0:
            raise SettingError(f"Samples count from 0, but {count} from {first} on were requested.")
        if self.limit is not None and first + count > self.limit:
            limit_text = f"table has {self.limit} rows" if self.design == "table" else (
                f"design '{self.design}' has {self.limit} samples"
            )  # fmt: skip
            raise SettingError(
                f"The {limit_text}, but samples up to {first + count} were requested."
            )
        # Every design but a table gives uniform numbers in (0, 1) as a function of the sample's number alone,
        # so that any range of samples can be computed anywhere and in any order.
        is_table = self.design == "table"
        u = np.empty((count, 0)) if is_table else _UNIFORM[self.design](self, first, count)
        if self.correlation:
            # A Gaussian copula correlates the factors without a change of their own distributions.
            u = _join_copula(self._correlation_root(), u)
        columns = []
        for j, factor in enumerate(self.factors.values()):
            p = factor.parameters
            if factor.name == "counter":
                columns.append(p["first"] + np.arange(first, first + count))
            elif not is_table:
                columns.append(factor.quantile(np.ascontiguousarray(u[:, j])))
            elif factor.name == "constant":
                columns.append(np.full(count, p["value"]))
            else:
                columns.append(np.asarray(p["values"][first : first + count]))
        return np.stack(columns, axis=1)

    def plain(self) -> dict[str, Any]:
        """Plain form for JSON.

        Factors are a list, as the points of a Sobol sequence depend on their order.
        """
        factors = [
            {"name": name} | distribution.plain() for name, distribution in self.factors.items()
        ]
        result = {"design": self.design, "seed": self.seed, "factors": factors}
        if self.correlation:
            result["correlation"] = [list(triple) for triple in self.correlation]
        return result if self.stratum is None else result | {"stratum": self.stratum}

    def _correlation_root(self) -> np.ndarray:
        """Cholesky factor of the correlation matrix (d, d)."""
        matrix = np.eye(len(self.factors))
        for a, b, rho in self.correlation:
            i, k = self.names.index(a), self.names.index(b)
            matrix[i, k] = matrix[k, i] = rho
        least = float(np.linalg.eigvalsh(matrix)[0])
        # below this bound, round-off could hide a negative eigenvalue
        if least < len(matrix) * np.finfo(float).eps:
            raise SettingError(
                "The correlations must form a positive definite matrix, but its smallest eigenvalue is "
                f"{least:.3g}."
            )
        return np.linalg.cholesky(matrix)


# --- uniform numbers of each design, in (0, 1), as functions of the sampling and the numbers


def _draw_random(sampling: Sampling, first: int, count: int) -> np.ndarray:
    """Independent uniform numbers; Philox gives four a count, and each sample has own counts."""
    d = len(sampling.factors)
    # A counter-based generator needs no state from sample to sample: number i is computed directly (J. K.
    # Salmon et al. 2011).
    counts = -(-d // 4)
    seeds = np.random.SeedSequence([sampling.seed, _STREAM["random"]])
    key = seeds.generate_state(2, np.uint64)
    source = np.random.Philox(counter=first * counts, key=key)
    raw = source.random_raw(count * counts * 4).reshape(count, counts * 4)[:, :d]
    # centres of 2^52 cells, so that neither 0 nor 1 is among them
    return ((raw >> np.uint64(12)) + 0.5) * 2.0**-52


def _draw_latin(sampling: Sampling, first: int, count: int) -> np.ndarray:
    size, d = sampling.stratum or 1, len(sampling.factors)
    points = [np.empty((0, d))]
    for b in range(first // size, -(-(first + count) // size)):
        rows = slice(max(first - b * size, 0), first + count - b * size)
        points.append(_make_hypercube(sampling.seed, b, size, d)[rows])
    return np.concatenate(points)


@functools.lru_cache(maxsize=2)
def _make_hypercube(seed: int, b: int, size: int, d: int) -> np.ndarray:
    """Latin hypercube b (size, d), cached because its chunks are sampled one after the other."""
    from scipy.stats import qmc

    rng = np.random.default_rng([seed, _STREAM["latin"], b])
    points = qmc.LatinHypercube(d, rng=rng).random(size)
    # SciPy's numbers are in (0, 1]; at 1 quantiles may be infinite
    return np.minimum(points, np.nextafter(1.0, 0.0))


def _draw_sobol(sampling: Sampling, first: int, count: int, d: int = 0) -> np.ndarray:
    """Scrambled Sobol sequence in d dimensions, by default one for each factor."""
    from scipy.stats import qmc

    d = d or len(sampling.factors)
    rng = np.random.default_rng([sampling.seed, _STREAM[sampling.design]])
    engine = qmc.Sobol(d, scramble=True, bits=SOBOL_BITS, rng=rng)
    if count == 0:
        return np.empty((0, d))
    if first == 0:
        # the first point apart, as SciPy warns if the first call is not a power of two
        points = np.concatenate([engine.random(1), engine.random(count - 1)])
    else:
        points = engine.fast_forward(first).random(count)
    return points + 0.5 / SOBOL_POINTS  # centres of the cells


def _draw_saltelli(sampling: Sampling, first: int, count: int) -> np.ndarray:
    d = len(sampling.factors)
    k = first // (d + 2)
    points = -(-(first + count) // (d + 2)) - k
    base = _draw_sobol(sampling, k, points, 2 * d)
    a, b = base[:, :d], base[:, d:]
    rows = np.repeat(a[:, None], d + 2, axis=1)
    rows[:, 1] = b
    for j in range(d):
        rows[:, 2 + j, j] = b[:, j]
    start = first - k * (d + 2)
    return rows.reshape(-1, d)[start : start + count]


_UNIFORM = {
    "random": _draw_random,
    "latin": _draw_latin,
    "sobol": _draw_sobol,
    "saltelli": _draw_saltelli,
}


def _join_copula(root: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Uniform numbers (count, d) correlated by a Gaussian copula."""
    from scipy.special import ndtr, ndtri

    z = ndtri(u)
    joined = np.zeros_like(z)
    # term by term: a matrix product may round differently for another number of rows
    for j in range(len(root)):
        for k in range(j + 1):
            joined[:, j] += root[j, k] * z[:, k]
    # beyond 8 standard deviations doubles cannot tell the probabilities from 0 and 1
    return np.clip(ndtr(joined), np.nextafter(0.0, 1.0), np.nextafter(1.0, 0.0))


def _check_sampling(s: Sampling) -> None:
    validate_model(Drawing, {name: getattr(s, name) for name in Drawing.model_fields}, "A sampling")
    if not s.factors:
        raise SettingError("A sampling needs at least one factor.")
    if (s.stratum is not None) != (s.design == "latin"):
        raise SettingError(
            "A design 'latin', and no other, needs 'stratum', the number of samples of one hypercube; "
            f"here the design is '{s.design}' and the stratum {s.stratum}."
        )
    refusals = {"saltelli": "takes factors one by one", "table": "has its rows as they are"}
    if s.correlation and s.design in refusals:
        reason = refusals[s.design]
        raise SettingError(f"The design '{s.design}' {reason}: it cannot have correlations.")
    # correlations name two factors, each pair once
    pairs = set()
    for a, b, _ in s.correlation:
        for name in (a, b):
            if name not in s.names:
                raise SettingError(
                    f"A correlation names {quote_name(name)}, which is no factor."
                    f"{nearest_names(name[:SHOWN], [factor_name[:SHOWN] for factor_name in s.names])}"
                )
            if (kind := s.factors[name].name) in ("constant", "counter"):
                raise SettingError(f"Factor '{name}' is {kind}: it cannot be correlated.")
        if a == b or frozenset((a, b)) in pairs:
            raise SettingError(
                f"The correlation of {quote_name(a)} with {quote_name(b)} is given twice or with itself."
            )
        pairs.add(frozenset((a, b)))
    if s.design != "table":
        return
    for name, factor in s.factors.items():
        if factor.name not in ("empirical", "constant", "counter"):
            raise SettingError(
                f"Factor '{name}': in a table factors are columns ('empirical') or constants, but it is "
                f"'{factor.name}'."
            )
    columns = {name: factor for name, factor in s.factors.items() if factor.name == "empirical"}
    sizes = {name: len(factor.parameters["values"]) for name, factor in columns.items()}
    if not sizes:
        raise SettingError(
            "A table of samples needs a factor with a column of values ('empirical'), but all of its factors "
            "are constants."
        )
    if len(set(sizes.values())) != 1:
        raise SettingError(
            f"The columns of a table must be equally long, but they have {sizes} rows."
        )
