"""Rosenbrock method for stiff systems, without iterations that might limit the step size.

With W = I / (h gamma) - df/dy, every stage is one linear solve with the same matrix,

    W k_i = f(t + c_i h, y + sum_j a_ij k_j) + sum_j C_ij k_j / h + h d_i df/dt,

with the exact derivatives of f at the start of the step, by automatic differentiation. The
method is of order 5, stiffly accurate and L-stable. On y' = -lambda (y - g) + g' with h lambda >> 1 its
error is proportional to h^3 / lambda: of order 3, but smaller the stiffer the problem.

Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II (1996), section
IV.7; G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical
benchmarks within the Julia differential equations package, BIT 63 (2023) 27 (coefficients).
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.linalg import inverted
from ...checks.shapes import StateVector

_GAMMA = 0.21193756319429014
_A = (
    (3.0,),
    (2.849394379747939, 0.45842242204463923),
    (-6.954028509809101, 2.489845061869568, -10.358996098473584),
    (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
    (
        -7.502846399306121,
        2.561846144803919,
        -11.627539656261098,
        -0.18268767659942256,
        0.030198172008377946,
    ),
)
_C = (
    (-14.155112264123755,),
    (-17.97296035885952, -2.859693295451294),
    (147.12150275711716, -1.41221402718213, 71.68940251302358),
    (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
    (
        24.854864614690072,
        -3.0009227002832186,
        47.4931110020768,
        5.5814197821558125,
        -0.6610691825249471,
    ),
    (
        30.91273214028599,
        -3.1208243349937974,
        77.79954646070892,
        34.28646028294783,
        -19.097331116725623,
        -28.087943162872662,
    ),
    (
        37.80277123390563,
        -3.2571969029072276,
        112.26918849496327,
        66.9347231244047,
        -40.06618937091002,
        -54.66780262877968,
        -9.48861652309627,
    ),
)
_POINTS = (0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664)
_D = (
    0.21193756319429014,
    -0.42387512638858027,
    -0.3384627126235924,
    1.8046452872882734,
    2.325825639765069,
)
_STAGES = 8


def _table(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    table = np.zeros((_STAGES, _STAGES))
    for i, row in enumerate(rows, start=1):
        table[i, : len(row)] = row
    return table


def _weights() -> np.ndarray:
    """Coefficients a_ij; each of the last two stages starts from the end of the stage before."""
    A = _table(_A)
    A[6] = A[5]
    A[6, 5] = 1.0
    A[7] = A[6]
    A[7, 6] = 1.0
    return A


class Rodas5P(diffrax.AbstractAdaptiveSolver):
    """Rosenbrock method Rodas5P for stiff systems: order 5, eight stages, one factorisation a step.

    Its interpolation within steps is linear, so steps must end at the output times.

    Args:
        size: number of the first entries of y on which alone the right-hand side depends; without it, all.
    """

    size: int | None = eqx.field(static=True, default=None)

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return diffrax.ODETerm

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int:
        return 5

    def error_order(self, terms: Any) -> int:
        return 5

    def init(self, terms: Any, t0: Any, t1: Any, y0: StateVector, args: Any) -> None:
        return None

    def func(self, terms: Any, t0: Any, y0: StateVector, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: StateVector,
        args: Any,
        solver_state: None,
        made_jump: Any,
    ) -> tuple[StateVector, StateVector, Any, None, diffrax.RESULTS]:
        del solver_state, made_jump
        h = t1 - t0
        field = lambda t, y: terms.vf(t, y, args)
        t0 = jnp.asarray(t0, y0.dtype)
        solve, by_time = _linear_solver(field, t0, y0, h, self.size or y0.shape[0])
        A, C = _weights(), _table(_C)
        c = np.array([0.0, *_POINTS, 1.0, 1.0, 1.0])
        d = np.array([*_D, 0.0, 0.0, 0.0])

        def stage(found: Float[Array, "s k"], at: Any) -> tuple[Any, None]:
            a, of_h, point, weight, number = at
            y = y0 + jnp.sum(a[:, None] * found, axis=0)
            right = field(t0 + point * h, y) + jnp.sum(of_h[:, None] * found, axis=0) / h
            k = solve(right + h * weight * by_time)
            return jax.lax.dynamic_update_index_in_dim(found, k, number, 0), None

        table = (*map(jnp.asarray, (A, C, c, d)), jnp.arange(_STAGES))
        found, _ = jax.lax.scan(stage, jnp.zeros((_STAGES, *y0.shape), y0.dtype), table)
        b = A[7].copy()
        b[7] = 1.0
        y1 = y0 + jnp.sum(b[:, None] * found, axis=0)
        return y1, found[7], {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


def stability(z: complex) -> complex:
    """Stability function R(z): a step of y' = lambda y multiplies y by R(h lambda)."""
    A, C, found = _weights(), _table(_C), np.zeros(_STAGES, complex)
    for i in range(_STAGES):
        right = z * (1 + A[i] @ found) + C[i] @ found
        found[i] = right / (1 / _GAMMA - z)
    b = A[7].copy()
    b[7] = 1.0
    return complex(1 + b @ found)


def _linear_solver(
    field: Any, t: Float[Array, ""], y: StateVector, h: Any, n: int
) -> tuple[Callable[[StateVector], StateVector], StateVector]:
    """Function b -> W^-1 b for a step of length h, and df/dt (k,); f depends on y_1, ..., y_n only."""
    J, by_time = _derivatives(field, t, y, n)
    W = inverted(jnp.eye(n, dtype=y.dtype) / (h * _GAMMA) - J[:n])

    def solve(b: StateVector) -> StateVector:
        k = W.solve(b[:n])
        # all other entries are integrals of functions of the first ones
        return jnp.concatenate([k, h * _GAMMA * (b[n:] + J[n:] @ k)]) if n < b.shape[0] else k

    return solve, by_time


def _derivatives(
    field: Any, t: Float[Array, ""], y: StateVector, n: int
) -> tuple[Float[Array, "k n"], StateVector]:
    """Derivatives df/dy by the first n entries (k, n), and df/dt (k,), by one batch of directions."""
    directions = jnp.eye(n + 1, dtype=y.dtype)
    push = lambda v: jax.jvp(field, (t, y), (v[n], jnp.zeros_like(y).at[:n].set(v[:n])))[1]
    columns = jax.vmap(push, out_axes=1)(directions)
    return columns[:, :n], columns[:, n]
