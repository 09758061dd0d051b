"""Banks of filters that run side by side: seeds of a Monte Carlo study, priors, tunings.

The axis of the bank is the last of every array, as in the rest of the package. Filters run in
groups of equal size whose numbers fit into the processor's nearest cache: larger ones are up to twice
as slow.
"""

import math
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..algebra.compiler import outer_jit
from ..checks.errors import ModelError, SettingError, concrete
from .check import check_filter
from .filter import Filtered, kalman_filter, step_lengths
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel
from .update import DEFAULT, AbstractFilter


def filter_bank(
    model: StateSpaceModel,
    priors: Gaussian,
    y: Array,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    method: AbstractFilter = DEFAULT,
    group: int = 64,
) -> Filtered:
    """Run s filters, each on its own measurements; a failed one is flagged in `ok`.

    A call from plain Python compiles with `compiler_options()`. Inside a user's `jax.jit` the
    options of that compilation apply: use `outer_jit`, or pass them to it.

    Args:
        priors: priors with mean (n, s) and factor (n, n, s), or one Gaussian for all.
        y: measurements (T, m, s).
        u: inputs with leaves (T, k), the same for all filters, or (T, k, s).
        dt, t, method: as in `kalman_filter`.
        group: largest number of filters that run at once; all groups have the same size.

    Raises:
        ModelError: shapes do not fit.
        SettingError: `group` is less than one; otherwise as in `kalman_filter`.
    """
    if y.ndim != 3:
        raise ModelError(f"Measurements of a bank must have shape (T, m, s), not {y.shape}.")
    if group < 1:
        raise SettingError(f"A group has at least one filter, not {group}.")
    y, count = jnp.asarray(y), y.shape[2]
    if priors.factor.ndim == 2:
        priors = jax.tree.map(lambda a: jnp.broadcast_to(a[..., None], (*a.shape, count)), priors)
    if priors.factor.shape[2:] != (count,):
        raise ModelError(
            f"The priors have stack axes {priors.factor.shape[2:]}, but there are {count} records."
        )
    check_filter(model, priors, y, u, method.rule)
    steps = step_lengths(dt, t, y.shape[0], priors.factor.dtype)
    # inside a jit of the caller the zeros are a tracer
    outermost = concrete(model, priors, y, u, steps, jnp.zeros(()))
    run = _compiled() if outermost else _in_groups
    # no group is larger than it has to be: the last one is filled up with copies, which cost as much
    size = math.ceil(count / math.ceil(count / group))
    return run(model, priors, y, u, steps, method, size)


@cache
def _compiled() -> Any:
    return outer_jit(_in_groups)


def _in_groups(
    model: StateSpaceModel,
    priors: Gaussian,
    y: Array,
    u: Inputs,
    steps: Array,
    method: AbstractFilter,
    group: int,
) -> Filtered:
    """Run the bank, one group after the other."""
    count = y.shape[2]
    own = jax.tree.map(lambda a: jnp.ndim(a) == 3, u)

    def run(now: tuple) -> Filtered:
        prior, measured, mine = now
        inputs = jax.tree.map(lambda a, b, is_own: b if is_own else a, u, mine, own)
        return kalman_filter(model, prior, measured, u=inputs, dt=steps, method=method)

    def grouped(a: Array) -> Array:
        """Array with the groups first, the last one padded with copies of the last filter."""
        more = -a.shape[-1] % group
        a = jnp.concatenate([a, jnp.repeat(a[..., -1:], more, axis=-1)], axis=-1)
        return jnp.moveaxis(a.reshape(*a.shape[:-1], a.shape[-1] // group, group), -2, 0)

    shared = jax.tree.map(lambda a, is_own: a if is_own else jnp.zeros((1, 1, count)), u, own)
    parts = jax.tree.map(grouped, (priors, y, shared))
    out = jax.lax.map(run, parts)

    def together(a: Array) -> Array:
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], a.shape[-2] * a.shape[-1])[..., :count]

    return Filtered(
        *(jax.tree.map(together, part) for part in (out.mean, out.factor, out.innovations, out.ok)),
        u=u,
        dt=steps,
        prior=priors,
        method=method,
    )
