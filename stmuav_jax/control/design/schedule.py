"""Linear-quadratic regulators with gains scheduled over a posture, such as a panel's orientation.

    u = u_0(s) - K(s) v,   v the error from the reference to the estimate, s = s(reference)

At the nodes of a grid of scheduling variables s the mechanism is linearised in its trim, and the gains
are those of `regulator`; between the nodes gains and trimmed inputs are interpolated linearly. The
variables are those of the reference, so that s adds no feedback of its own.

Source: W. J. Rugh, J. S. Shamma, Research on gain scheduling, Automatica 36 (2000) 1401-1425.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.interpolate import RegularGridInterpolator
from jaxtyping import Array, Float

from ...algebra.space import Point
from ...checks.errors import ModelError, SettingError
from ...checks.numbers import numbers
from ...checks.shapes import Numbers
from ...dynamics.statespace.base import AbstractStateSpace
from ...flight.linear import linearize
from ...mechanics.inputs import Inputs
from ..quadratic import StateFeedback, regulator


@dataclass(frozen=True)
class GainSchedule:
    """Gains and trimmed inputs on a grid of scheduling variables.

    Attributes:
        axes: values of each variable at the nodes (n_1,), (n_2,), ...
        K: gains (n_1, n_2, ..., m, n). inputs: trimmed inputs (n_1, n_2, ..., m).
        poles: closed-loop eigenvalues at each node (n_1, n_2, ..., n), as those of `Regulator`.
    """

    axes: tuple[np.ndarray, ...]
    K: np.ndarray
    inputs: np.ndarray
    poles: np.ndarray


def schedule_regulator(
    space: AbstractStateSpace,
    trimmed: Callable[[np.ndarray], tuple[Point, Numbers]],
    axes: Sequence[Numbers],
    Q: Numbers,
    R: Numbers,
    *,
    rate: float | None = None,
    inputs: Inputs | None = None,
) -> GainSchedule:
    """Gains of linear-quadratic regulators at all nodes of a grid.

    Args:
        trimmed: function of the scheduling variables (d,) that returns the trimmed point of the
            space and the inputs there, for instance by `stmuav_jax.trim`.
        axes: rising values of each variable, two or more.
        Q, R, rate: as in `regulator`.
        inputs: see `linearize`.

    Raises:
        SettingError: axes that do not rise, or with fewer than two values.
        ModelError: as `regulator`, with the node at which it could not be found.
        StateError: see `linearize`.
    """
    grid = tuple(np.atleast_1d(np.asarray(axis, dtype=float)) for axis in axes)
    for k, axis in enumerate(grid):
        if axis.ndim != 1 or len(axis) < 2 or not np.all(np.diff(axis) > 0):
            raise SettingError(
                f"The values of scheduling variable {k + 1} must rise, and be two or more, but they "
                f"are {axis.tolist()}."
            )
    if not grid:
        raise SettingError("A schedule needs the values of one scheduling variable or more.")
    found, values = [], []
    for node in product(*grid):
        point, held = trimmed(np.array(node))
        linear = linearize(space, point, inputs, held)
        try:
            found.append(regulator(linear, Q, R, rate=rate))
        except ModelError as error:
            at = ", ".join(f"{x:.6g}" for x in node)
            raise ModelError(f"Where the scheduling variables are ({at}): {error}") from error
        values.append(np.asarray(held, dtype=float))
    shape = tuple(len(axis) for axis in grid)
    stack = lambda rows: np.stack(rows).reshape(*shape, *np.shape(rows[0]))
    return GainSchedule(
        grid, stack([one.K for one in found]), stack(values), stack([one.poles for one in found])
    )


class ScheduledFeedback(eqx.Module):
    """Controller u = u_0(s) - K(s) v with the gains of a `GainSchedule`.

    The reference is a point of the space. Outside of the grid the gains are those at its edge.

    Args:
        space: state space of the linearisations.
        schedule: gains and trimmed inputs.
        variables: function of a point that returns its scheduling variables (d,).

    Raises:
        ModelError: gains or inputs that do not fit the space.
    """

    space: AbstractStateSpace
    axes: tuple[Float[Array, " n"], ...]
    K: Float[Array, "*grid m n"]
    inputs: Float[Array, "*grid m"]
    variables: Callable[[Point], Any]

    def __init__(
        self,
        space: AbstractStateSpace,
        schedule: GainSchedule,
        variables: Callable[[Point], Any],
    ) -> None:
        shape = tuple(len(axis) for axis in schedule.axes)
        count = np.shape(schedule.inputs)[-1]
        self.space, self.variables = space, variables
        self.axes = tuple(jnp.asarray(axis) for axis in schedule.axes)
        what = "of a gain schedule"
        self.K = numbers(schedule.K, (*shape, count, space.size), f"The gains {what}", "")
        self.inputs = numbers(schedule.inputs, (*shape, count), f"The inputs {what}", "")

    def __call__(self, estimate: Any, reference: Any, memory: Any) -> tuple[Array, Any]:
        """Inputs (m,) and the unchanged memory."""
        if reference is None:
            raise ModelError("A scheduled feedback needs a reference: a point of its space.")
        s = jnp.asarray(self.variables(reference), dtype=float)
        if s.shape != (len(self.axes),):
            raise ModelError(
                f"The scheduling variables must have shape ({len(self.axes)},), as the grid has axes, "
                f"but their shape is {s.shape}."
            )
        s = jnp.stack([jnp.clip(x, a[0], a[-1]) for x, a in zip(s, self.axes, strict=True)])
        at = lambda table: RegularGridInterpolator(self.axes, table)(s[None])[0]
        held = StateFeedback(self.space, reference, at(self.inputs), at(self.K))
        return held(estimate, reference, memory)
