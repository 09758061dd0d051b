"""Environment for training a policy: episodes on a sampled plant as pure functions of JAX.

    episode = environment.reset(key)
    episode = environment.step(episode, inputs)

Both may be jitted, vmapped over keys and inputs, scanned, and differentiated.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...checks.errors import SettingError
from ...checks.numbers import numbers
from ...checks.shapes import Numbers
from ...mechanics.state import State
from ..plant import Plant, PlantState

Observe = Callable[[PlantState], Any]
Reward = Callable[[PlantState, Array, PlantState], Any]


class Episode(eqx.Module):
    """Episode of an `Environment` at a sample.

    Attributes:
        now: state of the plant; `now.k` counts the steps.
        observation: what a policy sees (o,). reward: that of the last step ().
        terminated: true from the sample at which `failed` holds or the motion broke off.
        truncated: true at the last sample of the longest episode.
        broken: true where the numbers of the last step were not finite; the observation is then
            that before the step, and the reward is zero.
        key: random key of the next start.
    """

    now: PlantState
    observation: Float[Array, " o"]
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    broken: Bool[Array, ""]
    key: Any

    @property
    def over(self) -> Bool[Array, ""]:
        """True once the episode is terminated or truncated."""
        return self.terminated | self.truncated


class Environment(eqx.Module):
    """Plant with an observation, a reward and an end, for people who train policies.

    Args:
        plant: sampled plant; each step is one of its periods.
        observe: function of a `PlantState` that returns the observation (o,).
        reward: function (state before, inputs, state after) of a step that returns a number.
        lowest, highest: limits of the inputs (m,), in the plant's order.
        samples: steps of the longest episode.
        start: function of a random key that returns the `State` at the start, on the joints; by
            default always the plant's own.
        failed: function of a `PlantState` that is true where an episode is to end; by default never.
        bounds: least and largest observations, each () or (o,), for the spaces of Gymnasium alone.

    Raises:
        SettingError: fewer than one step, limits of the inputs that are not finite or not in order,
            an observation that is not a vector, a reward or failure that is not one value.
    """

    plant: Plant
    observe: Observe
    reward: Reward
    lowest: Float[Array, " m"]
    highest: Float[Array, " m"]
    start: Callable[[Any], State] | None
    failed: Callable[[PlantState], Any] | None
    bounds: tuple[Float[Array, " o"], Float[Array, " o"]]
    samples: int = eqx.field(static=True)
    size: int = eqx.field(static=True)

    def __init__(
        self,
        plant: Plant,
        observe: Observe,
        reward: Reward,
        *,
        lowest: Numbers,
        highest: Numbers,
        samples: int,
        start: Callable[[Any], State] | None = None,
        failed: Callable[[PlantState], Any] | None = None,
        bounds: tuple[Numbers, Numbers] = (-jnp.inf, jnp.inf),
    ) -> None:
        if isinstance(samples, bool) or samples != int(samples) or samples < 1:
            raise SettingError(
                f"The longest episode must have a whole number of steps from 1, not {samples}."
            )
        self.plant, self.observe, self.reward = plant, observe, reward
        self.start, self.failed, self.samples = start, failed, int(samples)
        count = len(plant.inputs)
        limits = [
            numbers(x, (count,), f"The {name} inputs of an environment", "", SettingError)
            for name, x in (("lowest", lowest), ("highest", highest))
        ]
        self.lowest, self.highest = limits
        if not bool(jnp.all(self.lowest < self.highest)):
            k = int(jnp.argmin(self.lowest < self.highest))
            raise SettingError(
                f"The limits of the input '{plant.inputs.names[k][0]}' are {float(limits[0][k]):g} to "
                f"{float(limits[1][k]):g}: the lowest must be below the highest."
            )
        self.size = self._checked_size()
        self.bounds = tuple(  # pyright: ignore[reportAttributeAccessIssue]
            jnp.broadcast_to(jnp.asarray(x, dtype=float), (self.size,)) for x in bounds
        )

    def reset(self, key: Any) -> Episode:
        """Episode at its start, from a random key."""
        own, noise, later = jax.random.split(key, 3)
        now = self.plant.reset(noise, None if self.start is None else self.start(own))
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        seen = jnp.asarray(self.observe(now), dtype=float)
        return Episode(now, seen, zero, self._has_failed(now), no, no, later)

    def step(self, episode: Episode, inputs: Float[Array, " m"]) -> Episode:
        """Episode one period later; what happens after its end is the same motion, continued."""
        before = episode.now
        now = self.plant.step(before, inputs)
        seen = jnp.asarray(self.observe(now), dtype=float)
        earned = jnp.asarray(self.reward(before, jnp.asarray(inputs), now), dtype=float)
        leaves = [seen, earned, *jax.tree.leaves(now.state)]
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]))
        broken = ~finite | (now.motion.result != diffrax.RESULTS.successful)
        return Episode(
            now,
            jnp.where(broken, episode.observation, seen),
            jnp.where(broken, 0.0, earned),
            episode.terminated | broken | self._has_failed(now),
            now.k >= self.samples,
            broken,
            episode.key,
        )

    def step_or_reset(self, episode: Episode, inputs: Float[Array, " m"]) -> Episode:
        """Episode one period later, or the start of the next one where this one is over.

        The inputs of a step that begins an episode are not used, and its reward is zero.
        """
        fresh, onwards = self.reset(episode.key), self.step(episode, inputs)
        return jax.tree.map(lambda a, b: jnp.where(episode.over, a, b), fresh, onwards)

    def _has_failed(self, now: PlantState) -> Array:
        return jnp.zeros((), bool) if self.failed is None else jnp.asarray(self.failed(now), bool)

    def _checked_size(self) -> int:
        """Size of an observation, found without computing one."""

        def shown(key: Any) -> Any:
            now = self.plant.reset(key)
            values = self.reward(now, self.lowest, now), self._has_failed(now)
            return jnp.asarray(self.observe(now)), *(jnp.asarray(x) for x in values)

        seen, *values = jax.eval_shape(shown, jax.random.key(0))
        if len(seen.shape) != 1:
            raise SettingError(
                f"An observation must be a vector, but `observe` returned shape {seen.shape}."
            )
        for name, value in zip(("reward", "failed"), values, strict=True):
            if value.shape != ():
                raise SettingError(
                    f"`{name}` must return one value, but its shape is {value.shape}."
                )
        return seen.shape[0]
