"""MJX: MuJoCo's model compiled by JAX, fourth-order Runge-Kutta at a fixed step, on this CPU."""

import importlib
import time
from typing import Any

import numpy as np
from problems.plain import start

from peers.adapter import Outcome, Peer, Prepared, Setting, looked_at, steps
from peers.mujoco_c import World, whole_steps, why_no_mujoco
from stmuav_jax import Scene


class MujocoMjx(Peer):
    """MJX with the same model as MuJoCo's C engine."""

    name = "MuJoCo MJX (CPU), RK4"
    packages = (("mujoco.mjx", "mujoco-mjx"),)
    caveats = (
        "The velocity term of loop constraints is missing.",
        "Loop constraints are soft; the hardest admitted setting is used.",
        "Actuator forces are held at their mean over each step.",
    )
    how = "The model of MuJoCo (C); one Newton iteration, enough for equalities alone."

    def __init__(self) -> None:
        self._programs: dict[str, tuple[Any, float]] = {}

    def unsupported(self, scene: Scene) -> str:
        return why_no_mujoco(scene)

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        return steps("RK4", 1e-3, 5e-4, 2e-4, 1e-4)

    def _model(self, scene: Scene, step: float) -> tuple[Any, World, Any, Any]:
        """MJX, the C engine's world, and MJX's model and data at the start."""
        mjx = importlib.import_module("mujoco.mjx")
        world = World(scene, step)
        # one Newton step solves a problem of equalities alone
        world.model.opt.iterations, world.model.opt.ls_iterations = 1, 4
        world.begin(start(scene))
        model = mjx.put_model(world.model)
        return mjx, world, model, mjx.put_data(world.model, world.data)

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        import jax

        mjx, world, model, first = self._model(scene, setting.step or 1e-3)
        counts = whole_steps(scene.t0, times, world.step)
        rate, phase = (np.array([getattr(s, x) for s in world.waves()]) for x in ("rate", "phase"))
        compiled, seconds = self._compiled(scene, mjx, model, first, rate, phase)

        def run() -> Outcome:
            data, done, physics = first, 0, []
            for count in counts:
                data = compiled(model, data, int(count) - done, rate, phase)
                done = int(count)
                physics.append((data.qpos, data.qvel))
            path = [np.concatenate([[0.0], q, v]) for q, v in jax.device_get(physics)]
            return looked_at(path, world.positions, len(world.order), (4 * done, done, 0))

        return Prepared(run, seconds)

    def _compiled(
        self, scene: Scene, mjx: Any, model: Any, first: Any, rate: np.ndarray, phase: np.ndarray
    ) -> tuple[Any, float]:
        """(model, data, steps, rate, phase) -> data, and the seconds that compiling it took.

        Once for all lengths of a step, which is a number in the model.
        """
        import jax
        import jax.numpy as jnp

        if scene.name in self._programs:
            return self._programs[scene.name]
        ones = jnp.ones(model.nu - len(rate))

        def advance(model: Any, data: Any, steps: Any, rate: Any, phase: Any) -> Any:
            def step(_: Any, now: Any) -> Any:
                h = model.opt.timestep
                # the mean over the step, as World.control has it
                mean = jnp.sinc(0.5 * rate * h / jnp.pi)
                swing = mean * jnp.sin(rate * (now.time + 0.5 * h) + phase)
                return mjx.step(model, now.replace(ctrl=jnp.concatenate([ones, swing])))

            return jax.lax.fori_loop(0, steps, step, data)

        clock = time.perf_counter()
        compiled = jax.jit(advance).lower(model, first, 1, rate, phase).compile()
        self._programs[scene.name] = compiled, time.perf_counter() - clock
        return self._programs[scene.name]
