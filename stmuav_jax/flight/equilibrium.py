"""Trim of any mechanism: inputs and states of a steady motion.

The unknowns z are the inputs that may be chosen, the states that may differ from those given,
and the internal states of force elements. The equations are

    du/dt (z) = a,   dz_f/dt (z) = 0,   g(z) = 0,

with the wanted accelerations a of the independent velocities, zero for an equilibrium, and further
conditions g on the motion of the bodies, such as the heading of a steady flight. Where there
are more unknowns than equations, the solution is the one nearest to the start, in the unknowns'
sizes; it satisfies z - z_0 = J^T lambda beside the equations.

Derivatives are those of the implicit function: with r(z, q) = 0, dz/dq = -r_z^-1 r_q.

Source: B. L. Stevens, F. L. Lewis, E. N. Johnson, Aircraft Control and Simulation (2016), ch. 3.6.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..algebra import lapack
from ..algebra.compiler import kept_jit
from ..algebra.newton import Implicit, NearestNewton, Newton
from ..algebra.space import Point
from ..checks.errors import SettingError, StateError, concrete
from ..checks.numbers import numbers
from ..checks.shapes import Numbers
from ..dynamics.statespace.base import AbstractStateSpace, Time, check_regular, places_of
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.state import State

Conditions = Callable[[State], Float[Array, " c"]]

# Largest residual that counts as a trim [m/s^2], [rad/s^2].
TOLERANCE = 1e-10
_MOST_STEPS = 50


class Trim(eqx.Module):
    """Result of a trim calculation: a steady motion, or NaN where none was found.

    Attributes:
        point: point of the state space.
        values: values of the inputs (m,).
        residual: largest difference from the wanted accelerations [m/s^2] or [rad/s^2].
        conditioning: smallest over largest singular value of the Jacobian with scaled unknowns;
            near zero, other trims lie near.
        converged: true if the residual is below `TOLERANCE`; point and values are NaN otherwise.
        steps: number of steps of Newton's method.
        inputs: names and units of the values.
    """

    point: Point
    values: Float[Array, " m"]
    residual: Float[Array, ""]
    conditioning: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    inputs: Inputs


class _Problem(eqx.Module):
    """Data of the equations of a trim; `free` holds the places of the unknown error components."""

    space: AbstractStateSpace
    start: Point
    inputs: Inputs
    values: Float[Array, " m"]
    wanted: Float[Array, " dof"]
    sizes: Float[Array, " k"]
    t: Float[Array, ""]
    conditions: Conditions | None
    free: tuple[int, ...] = eqx.field(static=True)

    def at(self, z: Float[Array, " k"]) -> tuple[Point, Float[Array, " m"]]:
        """Point and inputs at unknowns z, which are zero at the start."""
        moved, count = self.sizes * z, len(self.free)
        v = jnp.zeros(self.space.size, z.dtype)
        v = v.at[np.array(self.free, dtype=int)].set(moved[:count])
        return self.space.retract(self.start, v), self.values + moved[count:]

    def equations(self, z: Float[Array, " k"]) -> Float[Array, " e"]:
        """Accelerations less those wanted, the rates of the forces' states, and the conditions."""
        x, values = self.at(z)
        system = self.inputs.applied(self.space.system, values)
        rates = self.space.rates(x, self.t, system)[self.space.dof :]
        left = rates - jnp.concatenate([self.wanted, jnp.zeros(len(rates) - self.space.dof)])
        if self.conditions is None:
            return left
        return jnp.concatenate([left, self.conditions(self.space.to_state(x, self.t))])

    def count(self) -> int:
        """The number of equations."""
        return eqx.filter_eval_shape(self.equations, jnp.zeros(len(self.sizes))).shape[0]


def _square(z: Float[Array, " k"], problem: _Problem) -> Float[Array, " e"]:
    return problem.equations(z)


def _nearest(both: Float[Array, " k"], problem: _Problem) -> Float[Array, " k"]:
    """Equations of the nearest trim: those of the trim, and z along the rows of their Jacobian."""
    count = problem.sizes.shape[0]
    z, multipliers = both[:count], both[count:]
    left, pull = jax.vjp(problem.equations, z)
    return jnp.concatenate([z - pull(multipliers)[0], left])


@kept_jit
def _found(problem: _Problem) -> tuple[Any, ...]:
    """Solve for the unknowns; also the largest residual, the conditioning and the steps."""
    count = problem.sizes.shape[0]
    rows = problem.count()
    square = count == rows
    atol = 0.1 * TOLERANCE
    newton: Any = (
        Newton(atol)  # pyright: ignore[reportCallIssue]
        if square
        else NearestNewton(_square, count, atol)  # pyright: ignore[reportCallIssue]
    )
    solution = optx.root_find(
        _square if square else _nearest,
        newton,
        jnp.zeros(count if square else count + rows),
        args=problem,
        adjoint=Implicit(),
        max_steps=_MOST_STEPS,
        throw=False,
    )
    last = jax.lax.stop_gradient(solution.state)
    values = lapack.singular_values(last.J)
    left = jnp.max(jnp.abs(last.r))
    return solution.value[:count], left, values[-1] / values[0], solution.stats["num_steps"]


def trim(
    space: AbstractStateSpace,
    *,
    at: Point,
    free: Sequence[str] = (),
    inputs: Inputs | None = None,
    values: Numbers | None = None,
    accelerations: Numbers | None = None,
    conditions: Conditions | None = None,
    sizes: Numbers | None = None,
    t: Time = 0.0,
    throw: bool = True,
) -> Trim:
    """Inputs and free states at which a mechanism moves steadily.

    The function is pure: it may be jitted, vmapped, and differentiated in all arguments.

    Args:
        space: state space of the mechanism.
        at: point at which the search starts; its states are kept except the free ones.
        free: names of states that may be changed.
        inputs: inputs that may be chosen; default all of the system. Others stay as they are.
        values: inputs at the start of the search (m,); default those that the system has.
        accelerations: wanted rates of the independent velocities (dof,); default zero.
        conditions: function of positions and velocities of all bodies -> further residuals (c,), to
            be met by free states; a module or function made once, since it is compiled in.
        sizes: changes of the unknowns that count as equally far from the start, free states first,
            then inputs (k,); default one for states, and for inputs their starts or one.
        t: time [s], where forces or joints depend on it.
        throw: raise where there is no trim, if values are known.

    Raises:
        StateError: no trim was found, or the posture is singular for the independent coordinates.
        SettingError: an unknown name, or fewer unknowns than equations.
        ModelError: numbers of another shape, or not finite.
    """
    inputs = inputs_of(space.system) if inputs is None else inputs
    own = range(2 * space.dof, space.size)
    chosen = (*places_of(space, free, "The free states"), *own)
    if len(set(chosen)) < len(chosen):
        raise SettingError("The states of forces are free in any trim: do not name them.")
    m, k = len(inputs), len(chosen) + len(inputs)
    given = inputs.values(space.system) if values is None else values
    given = numbers(given, (m,), "The vector of the inputs to start from", "")
    wanted = jnp.zeros(space.dof) if accelerations is None else accelerations
    wanted = numbers(wanted, (space.dof,), "The vector of wanted accelerations", "")
    if sizes is None:
        of_inputs = jax.lax.stop_gradient(jnp.where(given == 0, 1.0, jnp.abs(given)))
        sizes = jnp.concatenate([jnp.ones(len(chosen)), of_inputs])
    sizes = numbers(sizes, (k,), "The vector of the unknowns' sizes", "")
    check_regular(space, at, t)
    time = jnp.asarray(t, dtype=float)
    problem = _Problem(space, at, inputs, given, wanted, sizes, time, conditions, chosen)
    _check_count(problem, free)
    z, left, conditioning, steps = _found(problem)
    fine = left <= TOLERANCE
    if throw and concrete(left) and not bool(fine):
        raise StateError(_words(space, float(left), free, inputs, float(conditioning)))
    keep = lambda tree: jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), tree)
    point, found = keep(problem.at(z))
    return Trim(point, found, left, conditioning, fine, steps, inputs)


def _check_count(problem: _Problem, free: Sequence[str]) -> None:
    equations, k, space = problem.count(), len(problem.sizes), problem.space
    if k < equations:
        names = ", ".join([*free, *(name for name, _ in problem.inputs.names)]) or "none"
        raise SettingError(
            f"A trim has {equations} equations here, one for every independent velocity, every state "
            f"of a force and every condition, but only {k} unknowns ({names}): let more inputs be "
            f"chosen, or name free states among "
            f"{', '.join(name for name, _ in space.names[: 2 * space.dof])}."
        )


def _words(
    space: AbstractStateSpace, left: float, free: Sequence[str], inputs: Inputs, conditioning: float
) -> str:
    names = ", ".join([*free, *(name for name, _ in inputs.names)])
    hint = ""
    if not conditioning > 1e-12:
        hint = " The equations are singular there: these unknowns do not reach all accelerations."
    return (
        f"There is no such trim near the start: Newton's method has stopped with accelerations of "
        f"{left:.3g} left (tolerance {TOLERANCE:.0e}) over the unknowns {names}.{hint}"
    )
