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

from ..algebra.compiler import kept_jit
from ..algebra.space import Point
from ..checks.errors import SettingError, StateError, named_places
from ..checks.numbers import numbers
from ..checks.shapes import Numbers
from ..dynamics.statespace.base import AbstractStateSpace, Time, check_regular, error_rate_columns
from ..mechanics.inputs import Inputs, inputs_of

# Size of an eigenvalue below which it is that of a free rigid body, with round-off [1/s], and share of
# its size below which a real part is none.
AT_ZERO = 1e-3


@dataclass(frozen=True)
class Mode:
    """Mode of the linear system; rigid-body modes have eigenvalues of zero but for round-off.

    Attributes:
        eigenvalue: eigenvalue of A [1/s].
        frequency: undamped frequency |s| / 2 pi [Hz].
        damping: damping ratio -Re s / |s| [1].
        doubling_time: time to double the amplitude [s], negative for the time to halve it, infinite
            where the real part is zero.
        states: states of largest participation (name, share).
    """

    eigenvalue: complex
    frequency: float
    damping: float
    doubling_time: float
    states: tuple[tuple[str, float], ...]


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
        """Modes by falling real part; shares are absolute values of the participation factors."""
        values, right = np.linalg.eig(self.A)
        left = np.linalg.pinv(right)
        found = []
        for k in np.argsort(-np.real(values)):
            s, part = complex(values[k]), np.abs(right[:, k] * left[k])
            part = part / part.sum()
            top = [(self.states[j][0], float(part[j])) for j in np.argsort(-part)[:3]]
            size = abs(s)
            found.append(
                Mode(
                    s,
                    size / (2 * np.pi),
                    -s.real / size if size > 0 else 1.0,
                    float(np.log(2) / s.real) if s.real else float("inf"),
                    tuple(top),
                )
            )
        return found

    def controllability(self) -> np.ndarray:
        """Smallest singular value of (s I - A, B) at each eigenvalue s of A (n,).

        It is zero for an uncontrollable mode (Popov, Belevitch, Hautus). The columns of B are
        scaled to unit length.
        """
        return _hautus(self.A, self.B)

    def observability(self) -> np.ndarray:
        """Smallest singular value of (s I - A; C) at each eigenvalue s of A (n,).

        It is zero for an unobservable mode. The rows of C are scaled to unit length.
        """
        return _hautus(self.A.T, self.C.T)

    def step(
        self, duration: float | None = None, samples: int = 401
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k p m"]]:
        """Times [s], and responses of the p outputs to a unit step of each of the m inputs from rest.

        They are exact at their times: x_k+1 = F x_k + g with (F, g; 0, I) = exp((A, B; 0, 0) dt).

        Args:
            duration: end [s]; by default that of `settling_time`.
            samples: number of times, two or more.

        Raises:
            SettingError: a duration that is not positive and finite, or fewer than two samples.
        """
        from scipy.linalg import expm  # slow to import

        end = self.settling_time() if duration is None else duration
        if not 0 < end < np.inf or samples < 2:
            raise SettingError(
                f"A step response needs a positive, finite duration and at least 2 samples, not {end:g} s "
                f"and {samples}."
            )
        (n, m), dt = self.B.shape, end / (samples - 1)
        block = expm(np.block([[self.A, self.B], [np.zeros((m, n + m))]]) * dt)
        x, found = np.zeros((n, m)), []
        for _ in range(samples):
            found.append(self.C @ x + self.D)
            x = block[:n, :n] @ x + block[:n, n:]
        return np.linspace(0.0, end, samples), np.array(found)

    def settling_time(self) -> float:
        """Time that shows the modes [s]: 4 time constants of the slowest, or 3 of the fastest that grows.

        Of an undamped oscillation it is 4 periods. Modes at zero (`AT_ZERO`) count for nothing; 1 s if all are.
        """
        values = np.linalg.eigvals(self.A)
        values = values[np.abs(values) > AT_ZERO]
        growing = values.real > AT_ZERO * np.abs(values)
        if np.any(growing):
            return float(3.0 / np.max(values.real[growing]))
        undamped = np.abs(values.real) <= AT_ZERO * np.abs(values)
        times = [4 * 2 * np.pi / abs(s) if free else 4.0 / abs(s.real)
                 for s, free in zip(values, undamped, strict=True)]  # fmt: skip
        return float(max(times, default=1.0))


def _hautus(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    sizes = np.linalg.norm(B, axis=0)
    unit = B / np.where(sizes > 0, sizes, 1.0)
    found = []
    for s in np.linalg.eigvals(A):
        matrix = np.hstack([s * np.eye(len(A)) - A, unit])
        found.append(np.linalg.svd(matrix, compute_uv=False)[-1])
    return np.array(found)


def matrices(
    space: AbstractStateSpace,
    x: Point,
    inputs: Inputs,
    values: Float[Array, " m"],
    t: Time = 0.0,
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
    """Matrices A and B by forward derivatives; they may be differentiated and vmapped."""
    return _matrices(
        space, x, inputs, jnp.asarray(values, dtype=float), jnp.asarray(t, dtype=float)
    )


@kept_jit
def _matrices(
    space: AbstractStateSpace,
    x: Point,
    inputs: Inputs,
    values: Float[Array, " m"],
    t: Float[Array, ""],
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
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
    names = [name for name, _ in space.names]
    what = "The outputs"
    if outputs is not None and not isinstance(outputs, str) and not len(outputs):
        raise SettingError(
            f"{what} must be a list of names of states, such as ['{names[0]}'], not {outputs!r}."
        )
    chosen = range(len(names)) if outputs is None else named_places(outputs, names, what, "state")
    inputs = inputs_of(space.system) if inputs is None else inputs
    given = (
        inputs.values(space.system)
        if values is None
        else numbers(values, (len(inputs),), "The vector of the inputs", "")
    )
    check_regular(space, x, t)
    A, B = (np.asarray(matrix) for matrix in matrices(space, x, inputs, given, t))
    if not (np.all(np.isfinite(A)) and np.all(np.isfinite(B))):
        raise StateError(
            "The motion cannot be linearised at this point: the accelerations or their derivatives "
            "are not finite. Either the point is not, or a force jumps there."
        )
    C = np.eye(len(names))[list(chosen)]
    return Linear(
        A, B, C, np.zeros((len(C), B.shape[1])), space.names, inputs.names,
        tuple(space.names[k] for k in chosen),
    )  # fmt: skip
