"""Checks of the shapes and precisions of a filter's parts, before anything runs.

Functions are traced with `jax.eval_shape`, which computes nothing. Arrays that would fit only
after broadcasting are refused, since a filter that compares a measurement with the wrong
component may converge without any sign of it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..checks.errors import ModelError, SettingError, check_finite
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel, widened
from .sigma import AbstractRule


def check_filter(
    model: StateSpaceModel, prior: Gaussian, y: Array, u: Inputs, rule: AbstractRule
) -> None:
    """Refuse a prior, a record, inputs or functions that do not belong together.

    Args:
        y: measurements (T, m, *s).
        u: inputs, a pytree of arrays (T, k) or (T, k, *s).

    Raises:
        ModelError: the size of a part or of a function's result does not fit.
        SettingError: parts have different precision, or the rule cannot be used for them.
    """
    check_prior(model, prior, rule)
    lanes = prior.factor.shape[2:]
    check_record(model, y, u, lanes)
    now = jax.tree.map(lambda leaf: _like(leaf, jnp.shape(leaf)[1:]), u)
    check_functions(model, prior, now, y.shape[1])
    if y.dtype != prior.factor.dtype:
        raise SettingError(_precisions("The measurements are", y, prior))


def check_prior(model: StateSpaceModel, prior: Gaussian, rule: AbstractRule) -> None:
    """Refuse a prior or covariances that do not belong to the model, as `check_filter` does."""
    n = model.space.size
    if prior.factor.ndim < 2 or prior.factor.shape[:2] != (n, n):
        size = " x ".join(str(length) for length in prior.factor.shape[:2])
        raise ModelError(
            f"The prior's covariance is {size}, but the model's state has {n} components "
            f"({', '.join(model.names)})."
        )
    model.space.check(prior.mean, "The prior's mean")
    check_finite(prior.mean, "The prior's mean", "")
    lanes = prior.factor.shape[2:]
    for leaf in jax.tree.leaves(prior.mean):
        if leaf.shape[1:] != lanes:
            raise ModelError(
                f"The prior's mean has stack axes {leaf.shape[1:]}, its covariance {lanes}."
            )
        if leaf.dtype != prior.factor.dtype:
            raise SettingError(_precisions("The prior's mean is", leaf, prior))
    rule.check(n, prior.factor.dtype)
    for matrix, name in ((model.noise, "Q"), (model.sensor.noise, "R")):
        if matrix.dtype != prior.factor.dtype:
            raise SettingError(_precisions(f"{name} is", matrix, prior))
        if matrix.shape[2:] not in ((), lanes):
            raise ModelError(f"{name} has stack axes {matrix.shape[2:]}, the prior {lanes}.")


def check_record(model: StateSpaceModel, y: Array, u: Inputs, lanes: tuple[int, ...]) -> None:
    """Refuse measurements or inputs of the wrong shape, as `check_filter` does."""
    m = model.sensor.space.size
    shape = ", ".join(["T", str(m), *map(str, lanes)])
    if y.ndim < 2 or y.shape[2:] not in ((), lanes):
        single = " A record of one component is y[:, None]." if y.ndim == 1 and m == 1 else ""
        raise ModelError(f"Measurements must have shape ({shape}), but it is {y.shape}.{single}")
    if not y.shape[0]:
        raise ModelError(f"The record has no measurements: its shape is {y.shape}.")
    # times become the last axis of a stack
    model.sensor.space.check(jnp.moveaxis(y, 0, -1), "A measurement")
    for leaf in jax.tree.leaves(u):
        given = jnp.shape(leaf)
        if len(given) < 2 or given[0] != y.shape[0] or given[2:] not in ((), lanes):
            bank = f" or (T, k, {', '.join(map(str, lanes))})" if lanes else ""
            raise ModelError(
                f"Inputs must have shape (T, k){bank} with T = {y.shape[0]} as the measurements, "
                f"but it is {given}."
            )


def check_functions(
    model: StateSpaceModel, prior: Gaussian, u: Inputs, m: int | None = None
) -> None:
    """Refuse functions f or h whose results have the wrong shape or precision.

    Args:
        u: shapes of the inputs of one step.
        m: number of components of a measurement; None leaves h out.
    """
    dtype, lanes = prior.factor.dtype, prior.factor.shape[2:]
    dt = jax.ShapeDtypeStruct((), dtype)
    for part, name, words in (
        (model, "f(x, u, dt)", "The model's function"),
        (model.sensor, "h(x, u)", "The sensor's function"),
    ):
        if part is model.sensor and m is None:
            return
        # the axes that the filter will use: sigma points, and filters of a bank
        stack = (2 * model.space.size + 1, *lanes) if part.stacked else ()
        x = jax.tree.map(lambda leaf, s=stack: _like(leaf, (leaf.shape[0], *s)), prior.mean)
        now = u
        if part.stacked:
            now = jax.tree.map(lambda leaf, s=stack: _with_axes(leaf, 1 + len(s)), u)
        elif lanes:
            now = jax.tree.map(lambda leaf: _like(leaf, leaf.shape[:1]), u)
        arguments = (x, now, dt) if part is model else (x, now)
        out = _traced(part.function, arguments, f"{words} {name}", part.stacked)
        expected = x if part is model else jax.ShapeDtypeStruct((m, *stack), dtype)
        _compare(out, expected, x, f"{words} {name}")


def _like(leaf: Any, shape: tuple[int, ...]) -> jax.ShapeDtypeStruct:
    """Placeholder with a shape and the precision of an array."""
    return jax.ShapeDtypeStruct(shape, jnp.result_type(leaf))


def _with_axes(leaf: jax.ShapeDtypeStruct, ndim: int) -> jax.ShapeDtypeStruct:
    """Placeholder of an input with `ndim` axes, as `widened` makes it for stacks of states."""
    return jax.eval_shape(lambda a: widened(a, ndim), leaf)


def _traced(function: Callable[..., Any], arguments: tuple, words: str, stacked: bool) -> Any:
    """Shapes of a function's result; an exception in it becomes a `ModelError` with a hint."""
    try:
        return jax.eval_shape(function, *arguments)
    except (ModelError, SettingError):
        raise
    except Exception as error:
        hints = " No inputs were given: pass u if the function uses them." * (
            not jax.tree.leaves(arguments[1])
        )
        if stacked:
            hints += (
                " stacked=True says that the function takes stacks of states, components first "
                "and further axes last; leave it out where it does not."
            )
        first = str(error).strip().splitlines() or [""]
        raise ModelError(
            f"{words} failed for a state {_shown(arguments[0])} and inputs {_shown(arguments[1])}: "
            f"{type(error).__name__}: {first[0]}{'' if first[0].endswith('.') else '.'}{hints}"
        ) from error


def _compare(out: Any, expected: Any, x: Any, words: str) -> None:
    """Refuse a result of another structure, shape or precision than expected."""
    structure = jax.tree.structure(expected)
    if jax.tree.structure(out) == structure:
        pairs = list(zip(jax.tree.leaves(out), jax.tree.leaves(expected), strict=True))
        if all(a.shape == b.shape for a, b in pairs):
            for a, b in pairs:
                if a.dtype != b.dtype:
                    raise SettingError(
                        f"{words} returned {a.dtype} for a state of {b.dtype}: give inputs and "
                        "constants the precision of the prior."
                    )
            return
    raise ModelError(
        f"{words} must return {_shown(expected)} for a state {_shown(x)}, but it returned "
        f"{_shown(out)}."
    )


def _shown(tree: Any) -> str:
    """Description of a pytree's shapes for messages."""
    if tree is None:
        return "None"
    if isinstance(tree, jax.ShapeDtypeStruct):
        return f"an array of shape {tree.shape}"
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{name}: {_shown(part)}" for name, part in tree.items()) + "}"
    return f"a {type(tree).__name__} of {len(jax.tree.leaves(tree))} arrays"


def _precisions(words: str, array: Any, prior: Gaussian) -> str:
    """Message about two different precisions."""
    return (
        f"{words} {array.dtype}, but the prior's covariance {prior.factor.dtype}: "
        "use one precision."
    )
