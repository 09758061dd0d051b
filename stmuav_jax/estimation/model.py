"""State-space models: how the state moves, what a sensor sees, and how uncertain both are.

    x_k = f(x_(k-1), u_k, dt) + w_k,   w_k ~ N(0, Q)
    y_k = h(x_k, u_k) + v_k,           v_k ~ N(0, R)

u_k is held over the step to time t_k. On a manifold, noise is an error from f or h.
"""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.shapes import Numbers
from ..mechanics.errors import ModelError
from .gaussian import root
from .space import AbstractSpace, Point, Vector

Inputs = Any


class Sensor(eqx.Module):
    """y = h(x, u) + v, v ~ N(0, R).

    Attributes:
        function: h(x, u) of a state and the inputs.
        noise: the lower triangular root of R (m, m).
        space: of the measurements.
        names: of the measurements, for messages.
        stacked: whether h takes stacks, components first and further axes last; where it does
            not, it is vectorised.
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
        """h for any stack of states."""
        return over_stack(lambda x, u: self.function(x, u), x, u, stacked=self.stacked)


class StateSpaceModel(eqx.Module):
    """x_k = f(x_(k-1), u_k, dt) + w_k, seen by a sensor.

    Attributes:
        function: f(x, u, dt) of a state, the inputs held over the step, and its length [s].
        noise: the lower triangular root of Q (n, n).
        sensor: what is measured.
        space: of the states.
        names: of the n error components, for messages and observability in words.
        noise_per: "step", or "second": then the noise of a step is N(0, Q dt).
        stacked: as for `Sensor`.
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
        """f for any stack of states."""
        return over_stack(lambda x, u: self.function(x, u, dt), x, u, stacked=self.stacked)

    def step_noise(self, dt: Any, ndim: int) -> Float[Array, "n n *s"]:
        """The root of the noise of one step, with `ndim` axes."""
        noise = widened(self.noise, ndim, 2)
        return noise * jnp.sqrt(dt) if self.noise_per == "second" else noise


def _check_size(size: int, expected: int, matrix: str, what: str) -> None:
    if size != expected:
        raise ModelError(
            f"{matrix} has {expected} rows, but {what} has {size} components: they must agree."
        )


def widened(a: Array, ndim: int, leading: int = 1) -> Array:
    """An array with axes of length one after its leading ones, up to `ndim` axes."""
    missing = ndim - a.ndim
    if missing <= 0:
        return a
    return a.reshape(*a.shape[:leading], *(1,) * missing, *a.shape[leading:])


def over_stack(
    function: Callable[[Point, Inputs], Point], x: Point, u: Inputs, *, stacked: bool
) -> Point:
    """function(x, u) over the axes of x after the first; u may lack the first of these.

    Inputs are arrays with their components first, so that further axes are those of a bank.
    """
    ndim = jax.tree.leaves(x)[0].ndim
    u = jax.tree.map(lambda leaf: widened(jnp.asarray(leaf), ndim), u)
    if stacked or ndim == 1:
        return function(x, u)
    lanes = jax.tree.leaves(x)[0].shape[1:]

    def flat(leaf: Array) -> Array:
        wide = jnp.broadcast_to(leaf, (*leaf.shape[:1], *lanes))
        return wide.reshape(leaf.shape[0], -1)

    each = jax.vmap(function, in_axes=-1, out_axes=-1)
    out = each(jax.tree.map(flat, x), jax.tree.map(flat, u))
    return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], *lanes), out)
