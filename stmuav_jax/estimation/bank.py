"""A bank of filters side by side: seeds of a Monte Carlo study, priors, tunings.

The stack's axis comes last everywhere, as in the rest of the package. Filters go through in
groups whose numbers fit into the processor's nearest cache: larger ones are up to twice as slow.
"""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..algebra.compiler import outer_jit
from ..mechanics.errors import ModelError, SettingError, concrete
from .check import check_filter
from .filter import Filtered, Points, check_choices, kalman_filter, step_lengths
from .gaussian import Gaussian
from .model import Inputs, StateSpaceModel
from .sigma import AbstractRule, Cubature
from .update import Form


def filter_bank(
    model: StateSpaceModel,
    priors: Gaussian,
    y: Array,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
    points: Points = "redraw",
    group: int = 32,
) -> Filtered:
    """Run s filters, each on its own measurements; a failed one is flagged in `ok`.

    Called from plain Python it compiles with `compiler_options()`; inside a `jax.jit` of yours those
    of that call count: use `outer_jit`, or pass them to it.

    Args:
        priors: mean (n, s) and factor (n, n, s), or one Gaussian for all.
        y: (T, m, s). u: leaves (T, k), the same for all, or (T, k, s).
        dt, t, rule, form, points: as `kalman_filter`. group: how many at once.

    Raises:
        ModelError: shapes that do not fit. SettingError: as `kalman_filter`.
    """
    if y.ndim != 3:
        raise ModelError(f"Measurements of a bank must have shape (T, m, s), not {y.shape}.")
    if group < 1:
        raise SettingError(f"A group has at least one filter, not {group}.")
    rule = Cubature() if rule is None else rule
    check_choices(form, points)
    y, count = jnp.asarray(y), y.shape[2]
    if priors.factor.ndim == 2:
        priors = jax.tree.map(lambda a: jnp.broadcast_to(a[..., None], (*a.shape, count)), priors)
    if priors.factor.shape[2:] != (count,):
        raise ModelError(
            f"The priors have stack axes {priors.factor.shape[2:]}, but there are {count} records."
        )
    check_filter(model, priors, y, u, rule)
    steps = step_lengths(dt, t, y.shape[0], priors.factor.dtype)
    # inside a jit of the caller this makes a tracer
    outermost = concrete(model, priors, y, u, steps, jnp.zeros(()))
    run = _compiled() if outermost else _in_groups
    return run(model, priors, y, u, steps, rule, form, points, min(group, count))


@cache
def _compiled() -> Any:
    return outer_jit(_in_groups)


def _in_groups(
    model: StateSpaceModel,
    priors: Gaussian,
    y: Array,
    u: Inputs,
    steps: Array,
    rule: AbstractRule,
    form: Form,
    points: Points,
    group: int,
) -> Filtered:
    """The bank, one group after the other."""
    count = y.shape[2]
    own = jax.tree.map(lambda a: jnp.ndim(a) == 3, u)

    def run(now: tuple) -> Filtered:
        prior, measured, mine = now
        inputs = jax.tree.map(lambda a, b, is_own: b if is_own else a, u, mine, own)
        return kalman_filter(
            model, prior, measured, u=inputs, dt=steps, rule=rule, form=form, points=points
        )

    def grouped(a: Array) -> Array:
        """Groups first; the last one is filled up with copies of the last filter."""
        more = -a.shape[-1] % group
        a = jnp.concatenate([a, jnp.repeat(a[..., -1:], more, axis=-1)], axis=-1)
        return jnp.moveaxis(a.reshape(*a.shape[:-1], -1, group), -2, 0)

    shared = jax.tree.map(lambda a, is_own: a if is_own else jnp.zeros((1, 1, count)), u, own)
    parts = jax.tree.map(grouped, (priors, y, shared))
    out = jax.lax.map(run, parts)

    def together(a: Array) -> Array:
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], -1)[..., :count]

    return Filtered(
        *(jax.tree.map(together, part) for part in (out.mean, out.factor, out.innovations, out.ok)),
        u=u,
        dt=steps,
        prior=priors,
    )
