"""State-space models: process model, sensor, and the covariances of their noise.

    x_k = f(x_(k-1), u_k, dt) + w_k,   w_k ~ N(0, Q)
    y_k = h(x_k, u_k) + v_k,           v_k ~ N(0, R)

The inputs u_k are held over the step to time t_k. On a manifold the noise is an error from f or h.
"""

import math
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.space import AbstractSpace, Point, Vector
from ..checks.errors import ModelError
from ..checks.shapes import Numbers
from .gaussians import root

Inputs = Any


class Sensor(eqx.Module):
    """Measurement model y = h(x, u) + v, v ~ N(0, R).

    Attributes:
        function: function h(x, u) of a state and the inputs.
        noise: lower triangular root of R (m, m).
        space: space of the measurements.
        names: names of the measurements, for messages.
        stacked: True if h takes stacks, components first and further axes last; otherwise it
            is vectorised.
    """

    function: Callable[[Point, Inputs], Point]
    noise: Float[Array, "m m *s"]
    space: AbstractSpace
    names: tuple[str, ...] = eqx.field(static=True)
    stacked: bool = eqx.field(static=True)

    def __init__(
        self,
        function: Callable[[Point, Inputs], Point],
        R: Numbers,
        *,
        space: AbstractSpace | None = None,
        names: tuple[str, ...] = (),
        stacked: bool = False,
    ) -> None:
        self.function = function
        self.noise = root(R, "R")
        m = self.noise.shape[0]
        self.space = Vector(m) if space is None else space
        self.names = names or tuple(f"y{i}" for i in range(m))
        self.stacked = stacked
        _check_size(self.space.size, m, "R", "the measurement")
        _check_size(len(self.names), m, "R", "the list of names")

    def __call__(self, x: Point, u: Inputs) -> Point:
        """Measurements h(x, u) for any stack of states."""
        return over_stack(lambda x, u: self.function(x, u), x, u, stacked=self.stacked)


class StateSpaceModel(eqx.Module):
    """State-space model: a process x_k = f(x_(k-1), u_k, dt) + w_k, measured by a sensor.

    Attributes:
        function: function f(x, u, dt) of a state, the inputs held over the step, and its
            length [s].
        noise: lower triangular root of Q (n, n).
        sensor: measurement model.
        space: space of the states.
        names: names of the n error components, for messages and `Observability.words`.
        noise_per: "step", or "second" if the noise of a step is N(0, Q dt).
        stacked: True if f takes stacks, as for `Sensor`.
    """

    function: Callable[[Point, Inputs, Any], Point]
    noise: Float[Array, "n n *s"]
    sensor: Sensor
    space: AbstractSpace
    names: tuple[str, ...] = eqx.field(static=True)
    noise_per: Literal["step", "second"] = eqx.field(static=True)
    stacked: bool = eqx.field(static=True)

    def __init__(
        self,
        function: Callable[[Point, Inputs, Any], Point],
        Q: Numbers,
        sensor: Sensor,
        *,
        space: AbstractSpace | None = None,
        names: tuple[str, ...] = (),
        noise_per: Literal["step", "second"] = "step",
        stacked: bool = False,
    ) -> None:
        self.function = function
        self.noise = root(Q, "Q")
        n = self.noise.shape[0]
        self.sensor = sensor
        self.space = Vector(n) if space is None else space
        self.names = names or tuple(f"x{i}" for i in range(n))
        self.noise_per = noise_per
        self.stacked = stacked
        _check_size(self.space.size, n, "Q", "the state's error")
        _check_size(len(self.names), n, "Q", "the list of names")

    def __call__(self, x: Point, u: Inputs, dt: Any) -> Point:
        """States f(x, u, dt) for any stack of states."""
        return over_stack(lambda x, u: self.function(x, u, dt), x, u, stacked=self.stacked)

    def step_noise(self, dt: Any, ndim: int) -> Float[Array, "n n *s"]:
        """Root of the covariance of one step's noise, with `ndim` axes."""
        noise = widened(self.noise, ndim, 2)
        return noise * jnp.sqrt(dt) if self.noise_per == "second" else noise


def _check_size(size: int, expected: int, matrix: str, what: str) -> None:
    if size != expected:
        raise ModelError(
            f"{matrix} has {expected} rows, but {what} has {size} components: they must agree."
        )


def widened(a: Array, ndim: int, leading: int = 1) -> Array:
    """Array with axes of length one inserted after its leading ones, up to `ndim` axes."""
    missing = ndim - a.ndim
    if missing <= 0:
        return a
    return a.reshape(*a.shape[:leading], *(1,) * missing, *a.shape[leading:])


def over_stack(
    function: Callable[[Point, Inputs], Point], x: Point, u: Inputs, *, stacked: bool
) -> Point:
    """Map function(x, u) over the axes of x after the first; u may lack the first of these.

    Inputs are arrays with their components first and the axes of a filter bank last.
    """
    ndim = jax.tree.leaves(x)[0].ndim
    u = jax.tree.map(lambda leaf: widened(jnp.asarray(leaf), ndim), u)
    if stacked or ndim == 1:
        return function(x, u)
    lanes = jax.tree.leaves(x)[0].shape[1:]

    def flat(leaf: Array) -> Array:
        wide = jnp.broadcast_to(leaf, (*leaf.shape[:1], *lanes))
        return wide.reshape(leaf.shape[0], math.prod(lanes))

    each = jax.vmap(function, in_axes=-1, out_axes=-1)
    out = each(jax.tree.map(flat, x), jax.tree.map(flat, u))
    return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], *lanes), out)
