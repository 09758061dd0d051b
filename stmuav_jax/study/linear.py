"""Linearisation of the UAV with its tracker in independent coordinates: 16 states, 8 inputs.

About a point (coordinates, inputs), with small displacements of the base in the world, a
small turn in the base's axes, p = p0 (1, dtheta / 2), and the panel's angles:

    x = (dr, dtheta, d(phi, theta), dv, domega, d(rates)),   x' = A x + B du,   y = C x + D du.

Motors that lag add the rotors' speeds: k more states.

Source: B. L. Stevens, F. L. Lewis, E. N. Johnson, Aircraft Control and Simulation (2016),
ch. 3.7 (linearisation), 1.2 (modes, controllability).
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..algebra.rotation import from_rotation_vector, rotation_matrix
from ..dynamics.tree import TreeModel
from ..mechanics.errors import SettingError, nearest_names
from ..vehicle.flyer import Coordinates, Flyer, Inputs, shifted
from ..vehicle.motor import MotorRotors

_XYZ = ("x", "y", "z")
STATES = (
    *((f"r_{k}", "m") for k in _XYZ),
    *((f"theta_{k}", "rad") for k in _XYZ),
    ("phi", "rad"),
    ("theta", "rad"),
    *((f"v_{k}", "m/s") for k in _XYZ),
    *((f"omega_{k}", "rad/s") for k in _XYZ),
    ("phi_rate", "rad/s"),
    ("theta_rate", "rad/s"),
)


@dataclass(frozen=True)
class Mode:
    """One eigenvalue s [1/s] of A, with the states that take part most (name, share).

    Attributes:
        frequency: |s| / 2 pi [Hz]. damping: -Re s / |s|. doubling: time to double [s],
            negative where it is the time to halve, infinite where neither.
        Rigid-body modes are zero but for round-off.
    """

    s: complex
    frequency: float
    damping: float
    doubling: float
    states: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Linear:
    """x' = A x + B u, y = C x + D u, as NumPy arrays that python-control takes as they are.

    Attributes:
        A: (n, n), n = 16 or, with motors that lag, 16 + k. B: (n, m). C: (p, n). D: (p, m).
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
        """Eigenvalues by falling real part; shares are the participation factors' sizes."""
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
        """Smallest singular value of (s I - A, B) at each eigenvalue of A (16,), zero where a
        mode cannot be moved (Popov, Belevitch, Hautus); inputs scaled to unit size."""
        return _hautus(self.A, self.B)

    def observability(self) -> np.ndarray:
        """The same for what the outputs cannot see."""
        return _hautus(self.A.T, self.C.T)


def _hautus(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    sizes = np.linalg.norm(B, axis=0)
    unit = B / np.where(sizes > 0, sizes, 1.0)
    found = []
    for s in np.linalg.eigvals(A):
        matrix = np.hstack([s * np.eye(len(A)) - A, unit])
        found.append(np.linalg.svd(matrix, compute_uv=False)[-1])
    return np.array(found)


def rates(
    flyer: Flyer,
    at: Coordinates,
    inputs: Inputs,
    x: Float[Array, " n"],
    du: Float[Array, " m"],
    model: TreeModel | None = None,
) -> Float[Array, " n"]:
    """x' at a small x: what the linear equations approximate, to second order in x and du.

    The turn obeys dtheta' = omega - R(dtheta)^T omega0 up to second order.
    """
    now = shifted(at, x[:16])
    count = inputs.squared.shape[0]
    push = Inputs(inputs.squared + du[:count], inputs.forces + du[count:])
    own, speeds, lag = flyer.propulsion, None, []
    if isinstance(own, MotorRotors) and own.time_constant is not None:
        speeds = own.speeds_of(inputs.squared) + x[16:]
        lag = [(own.speeds_of(push.squared) - speeds) / own.time_constant]
    found = flyer.accelerations(now, push, model=model, speeds=speeds)
    turned = rotation_matrix(from_rotation_vector(x[3:6])).T @ at.omega
    return jnp.concatenate(
        [now.v - at.v, now.omega - turned, now.rates, found.v, found.omega, found.angles, *lag]
    )


def _states(flyer: Flyer) -> tuple[tuple[str, str], ...]:
    count = flyer.propellers.spin.shape[0] if flyer.lagging else 0
    return (*STATES, *((f"speed_{k + 1}", "rad/s") for k in range(count)))


def matrices(
    flyer: Flyer, at: Coordinates, inputs: Inputs
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
    """A and B by forward derivatives; may be differentiated and vmapped."""
    return _matrices(flyer, flyer.model(), at, inputs)


@kept_jit
def _matrices(
    flyer: Flyer, model: TreeModel, at: Coordinates, inputs: Inputs
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
    count, n = inputs.squared.shape[0] + 2, len(_states(flyer))
    both = lambda z: rates(flyer, at, inputs, z[:n], z[n:], model)
    J = jax.jacfwd(both)(jnp.zeros(n + count))
    return J[:, :n], J[:, n:]


def linearize(flyer: Flyer, at: Coordinates, inputs: Inputs, outputs: Any = None) -> Linear:
    """Linearise about a trim, or about any point of a trajectory (the x' there left out).

    Args:
        outputs: names of states that are measured, one or more; default all.

    Raises:
        SettingError: an unknown name, none, or something else than names.
    """
    if outputs is not None and (
        isinstance(outputs, str)
        or not all(isinstance(name, str) for name in outputs)
        or not len(outputs)
    ):
        raise SettingError(
            f"The outputs must be a list of names of states, such as ['omega_x'], not {outputs!r}."
        )
    A, B = (np.asarray(m) for m in matrices(flyer, at, inputs))
    states = _states(flyer)
    names = [name for name, _ in states]
    chosen = names if outputs is None else list(outputs)
    for name in chosen:
        if name not in names:
            raise SettingError(
                f"There is no state '{name}' to measure.{nearest_names(name, names)}"
            )
    C = np.eye(len(names))[[names.index(name) for name in chosen]]
    count = inputs.squared.shape[0]
    given = [(f"speed_squared_{k + 1}", "rad^2/s^2") for k in range(count)]
    given += [("force_2", "N"), ("force_3", "N")]
    return Linear(
        A, B, C, np.zeros((len(chosen), B.shape[1])), states, tuple(given),
        tuple(states[names.index(name)] for name in chosen),
    )  # fmt: skip
