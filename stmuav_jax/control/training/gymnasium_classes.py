"""Gymnasium's classes over an `Environment`: one episode, or many side by side.

Source: M. Towers et al., Gymnasium, https://gymnasium.farama.org.
"""

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...algebra.compiler import outer_jit
from ...checks.errors import SettingError
from .environment import Environment, Episode

# An optional package, looked for by name: type checkers need not have it.
gymnasium: Any = importlib.import_module("gymnasium")
_vector: Any = importlib.import_module("gymnasium.vector")


class SampledEnv(gymnasium.Env):
    """One episode after the other; the seed of `reset` is that of JAX's random key."""

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own attribute)

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        low, high = (np.asarray(x) for x in environment.bounds)
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        count = len(environment.plant.inputs)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (count,), dtype=np.float64)
        self._episode: Episode | None = None
        self._reset = outer_jit(lambda env, key: env.reset(key))
        self._step = outer_jit(lambda env, now, action: env.step(now, _inputs(env, action)))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        """Observation at a start, and an empty dictionary."""
        super().reset(seed=seed)
        key = _next_key(seed, None if self._episode is None else self._episode.key)
        now = self._episode = self._reset(self.environment, key)
        return np.asarray(now.observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Observation, reward, terminated, truncated, and a dictionary with `broken`."""
        if self._episode is None:
            raise SettingError("The environment has no episode yet: call reset first.")
        action = _within(action, self.action_space.shape)
        now = self._episode = self._step(self.environment, self._episode, action)
        observation, reward = np.asarray(now.observation), float(now.reward)
        ended = bool(now.terminated), bool(now.truncated)
        return observation, reward, *ended, {"broken": bool(now.broken)}


class SampledVectorEnv(_vector.VectorEnv):
    """Episodes side by side in one compiled program; each begins anew after its end."""

    metadata = {  # noqa: RUF012 (Gymnasium's own attribute)
        "render_modes": [],
        "autoreset_mode": _vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(self, environment: Environment, count: int) -> None:
        one = SampledEnv(environment)
        batched = gymnasium.vector.utils.batch_space
        self.environment, self.num_envs = environment, count
        self.single_observation_space = one.observation_space
        self.single_action_space = one.action_space
        self.observation_space = batched(one.observation_space, count)
        self.action_space = batched(one.action_space, count)
        self._episodes: Episode | None = None
        self._reset = outer_jit(lambda env, keys: jax.vmap(env.reset)(keys))
        self._step = outer_jit(
            lambda env, now, actions: jax.vmap(
                lambda e, a: env.step_or_reset(e, _inputs(env, a))
            )(now, actions)
        )  # fmt: skip

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        """Observations at the starts (n, o), and an empty dictionary."""
        super().reset(seed=seed)
        before = None if self._episodes is None else self._episodes.key[0]
        keys = jax.random.split(_next_key(seed, before), self.num_envs)
        now = self._episodes = self._reset(self.environment, keys)
        return np.asarray(now.observation), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Observations (n, o), rewards, terminations, truncations (n,), a dictionary with `broken`."""
        if self._episodes is None:
            raise SettingError("The environments have no episodes yet: call reset first.")
        actions = _within(actions, self.action_space.shape)
        now = self._episodes = self._step(self.environment, self._episodes, actions)
        rows = (now.observation, now.reward, now.terminated, now.truncated)
        observations, rewards, terminated, truncated = (np.asarray(x) for x in rows)
        return observations, rewards, terminated, truncated, {"broken": np.asarray(now.broken)}


def _inputs(environment: Environment, action: Any) -> Any:
    """Inputs of a plant for an action (m,) from -1 to 1."""
    span = environment.highest - environment.lowest
    return environment.lowest + 0.5 * (action + 1.0) * span


def _within(action: Any, shape: tuple[int, ...]) -> Any:
    """Action as an array; `SettingError` for another shape, or a value beyond -1 to 1."""
    found = np.asarray(action, dtype=float)
    if found.shape != shape:
        raise SettingError(f"An action must have shape {shape}, but it has {found.shape}.")
    if not np.all(np.abs(found) <= 1.0):
        k = np.unravel_index(np.argmax(~(np.abs(found) <= 1.0)), shape)
        raise SettingError(
            f"Actions lie between -1 and 1, but element {tuple(int(i) for i in k)} is {found[k]:g}: "
            "gymnasium.wrappers.ClipAction clips them."
        )
    return jnp.asarray(found)


def _next_key(seed: int | None, before: Any) -> Any:
    """Random key of a seed; without one the key that follows the last, or one by chance."""
    if seed is not None:
        return jax.random.key(seed)
    if before is not None:
        return jax.random.fold_in(before, 1)
    return jax.random.key(int(np.random.default_rng().integers(2**31)))
