"""Gains tuned by gradients through closed loops of uncertain machines.

The mean cost over samples of what is uncertain falls along its gradient by an optimiser of optax; the
gains found are judged by samples that the search has never seen.

Source: optax, https://optax.readthedocs.io; for gradients through steps as they were taken see
`stmuav_jax.control.rollout`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ...algebra.compiler import quick_jit
from ...checks.errors import SettingError, SimulationError


@dataclass(frozen=True)
class TunedGains:
    """Gains found by `tune_gains`.

    Attributes:
        gains: gains of the smallest mean cost over the samples, in the structure of the start.
        costs: mean cost over the samples before each step, and after the last (steps + 1,).
        before, after: costs of the held-out samples with the start and with the gains found (h,).
        ended: reason for an early end; empty if all steps were taken.
    """

    gains: Any
    costs: np.ndarray
    before: np.ndarray
    after: np.ndarray
    ended: str

    @property
    def improvement(self) -> float:
        """Fall of the mean cost of the held-out samples, as a share of that of the start."""
        return 1.0 - float(np.mean(self.after) / np.mean(self.before))


def tune_gains(
    cost: Callable[[Any, Any], Any],
    start: Any,
    samples: Any,
    held_out: Any,
    *,
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 40,
    positive: bool = False,
    progress: Callable[[int, float], object] | None = None,
) -> TunedGains:
    """Gains of small mean cost over samples of uncertain parameters, validated on others.

    The search is for changes of the gains relative to their start: an array of gains moves in units
    of its largest absolute value, or of one where that is zero.

    Args:
        cost: pure function (gains, sample) -> cost of one closed loop (), such as an integral of
            errors along a `rollout`.
        start: gains at the start, any pytree of arrays.
        samples: parameters of the samples, any pytree of arrays with the samples first (s, ...).
        held_out: others of the same structure, for the validation alone (h, ...).
        optimiser: optimiser of optax; by default Adam with steps of 5 % of the gains' size.
        steps: number of steps.
        positive: each gain stays positive; its logarithm is searched for.
        progress: function that is called with the number of steps done and the mean cost.

    Raises:
        SettingError: fewer than one step, samples that do not agree in their number, gains that are
            not positive though they are to stay so, a cost that is not one number.
        SimulationError: the cost or its gradient is not finite at the start.
    """
    if steps < 1:
        raise SettingError(f"At least one step is needed to tune gains, not {steps}.")
    for what, given in (("samples", samples), ("held-out samples", held_out)):
        _check_samples(what, given)
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), start)
    if positive and any(np.any(np.asarray(leaf) <= 0) for leaf in jax.tree.leaves(first)):
        raise SettingError(
            "Gains that are to stay positive must be so at the start, but one is "
            f"{min(float(np.min(leaf)) for leaf in jax.tree.leaves(first)):g}."
        )
    each = jax.vmap(_one_number(cost), (None, 0))

    def gains_at(moves: Any, first: Any) -> Any:
        if positive:
            return jax.tree.map(lambda x, z: x * jnp.exp(z), first, moves)
        return jax.tree.map(lambda x, z: x + _size(x) * z, first, moves)

    search = optax.adam(0.05) if optimiser is None else optimiser

    def step(moves: Any, state: Any, first: Any, samples: Any) -> Any:
        mean = lambda z: jnp.mean(each(gains_at(z, first), samples))
        value, slope = jax.value_and_grad(mean)(moves)
        change, state = search.update(slope, state, moves)
        return optax.apply_updates(moves, change), state, value, optax.tree.norm(slope)

    zero = jax.tree.map(jnp.zeros_like, first)
    best, costs, ended = _descended(
        quick_jit(step), zero, search.init(zero), (first, samples), steps, progress
    )
    # those that the search has not seen
    judge = quick_jit(lambda gains, given: each(gains, given))
    gains = gains_at(best, first)
    before, after = (np.asarray(judge(g, held_out)) for g in (first, gains))
    return TunedGains(jax.tree.map(np.asarray, gains), np.array(costs), before, after, ended)


def _descended(
    step: Any, moves: Any, state: Any, given: Any, steps: int, progress: Any
) -> tuple[Any, list[float], str]:
    """Best of the moves that were judged, mean costs of all of them, and why the search ended."""
    best, costs = moves, []
    for k in range(steps + 1):
        after, state, value, slope = step(moves, state, *given)
        value, slope = float(value), float(slope)
        if not (np.isfinite(value) and np.isfinite(slope)):
            words = f"the mean cost is {value:g} and its gradient's norm {slope:g}"
            if k == 0:
                raise SimulationError(
                    f"Gains cannot be tuned from this start: {words}. Does each loop stay finite?"
                )
            return best, costs, f"after {k} steps {words}; shorter steps may help"
        if not costs or value < min(costs):
            best = moves
        costs.append(value)
        if progress is not None:
            progress(k, value)
        moves = after
    return best, costs, ""


def _one_number(cost: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    def checked(gains: Any, sample: Any) -> Any:
        value = jnp.asarray(cost(gains, sample))
        if value.shape != ():
            raise SettingError(
                f"The cost of a closed loop must be one number, but its shape is {value.shape}."
            )
        return value

    return checked


def _check_samples(what: str, given: Any) -> None:
    sizes = {np.shape(leaf)[0] if np.ndim(leaf) else 0 for leaf in jax.tree.leaves(given)}
    if len(sizes) != 1 or 0 in sizes:
        raise SettingError(
            f"The {what} must be arrays with the same number of samples first, one or more, but "
            f"their first sizes are {sorted(sizes)}."
        )


def _size(x: Any) -> Any:
    """Largest absolute value of an array, or one where it is zero."""
    most = jnp.max(jnp.abs(x))
    return jnp.where(most > 0, most, 1.0)
