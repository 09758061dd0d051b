"""Stiffness of a system: eigenvalues of its linearised motion, and the choice of a solver."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..checks.errors import StateError
from ..checks.shapes import Numbers
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .formulations.base import AbstractFormulation
from .formulations.stabilisation import Unstabilised
from .integration.rosenbrock import Rodas5P
from .tree.formulation import Tree

# With servos explicit and implicit solvers take the same time near 430 1/s, and at 1400 1/s the
# implicit one is 1.9 times as fast: docs/stiff.md.
EXPLICIT_LIMIT = 1e3  # [1/s]


def spectrum(
    system: System,
    state: State,
    t: Numbers = 0.0,
    *,
    formulation: AbstractFormulation | None = None,
) -> np.ndarray:
    """Eigenvalues [1/s] of the motion linearised at a state, largest magnitude first, (k,).

    The coordinates are those of the formulation (default `Tree()`), so that constraints contribute
    zeros. Steps of an explicit method cannot be longer than a few divided by the first magnitude,
    whatever the tolerance; if that is far shorter than what the motion itself needs, the scene is
    stiff.

    Raises:
        SettingError: shapes or precision of the state do not fit the system.
        StateError: the derivatives are not finite at the state.
    """
    check_state(system, state)
    how = formulation if formulation is not None else Tree()
    matrix = np.asarray(_jacobian(how, system, state, jnp.asarray(t, float)))
    if not np.all(np.isfinite(matrix)):
        raise StateError(
            "The motion cannot be linearised at this state: the accelerations or their derivatives "
            "are not finite. Either the state is not, or a force jumps there, as that of a spring "
            "with a length does where its ends meet."
        )
    values = np.linalg.eigvals(matrix)
    return values[np.argsort(-np.abs(values))]


@kept_jit
def _jacobian(
    formulation: AbstractFormulation, system: System, state: State, t: Float[Array, ""]
) -> Float[Array, "k k"]:
    model = formulation.prepare(system)
    x = formulation.to_vector(model, state)
    return jax.jacfwd(lambda x: formulation.derivative(model, t, x, Unstabilised())[0])(x)


def choose_solver(
    system: System,
    state: State,
    t: Numbers = 0.0,
    *,
    formulation: AbstractFormulation | None = None,
) -> diffrax.AbstractSolver:
    """`Rodas5P` if the largest |eigenvalue| at the state exceeds `EXPLICIT_LIMIT`, else `Dopri8`.

    Only the given state counts, which misleads if a system is stiff for moments: a stop that is hit
    later is not seen, and friction is stiff at rest but not in motion.
    """
    fastest = np.abs(spectrum(system, state, t, formulation=formulation)[0])
    return Rodas5P() if fastest > EXPLICIT_LIMIT else diffrax.Dopri8()
