"""Problems of the suite: the report's scenes, published problems, stiff variants, chains."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from problems import four_bar
from problems.conservative import FAST, top
from problems.squeezer import squeezer

import stmuav_jax as stm
from stmuav_jax.dynamics.tree.coordinates import join_coordinates, split_vector

TRACKER_CASE = 2


@dataclass(frozen=True)
class Problem:
    """A scene, and where its error is looked at.

    Attributes:
        key: short, for files. horizons: ends of the runs, each a run of its own [s].
        redundant: whether its joints have dependent rows.
        stiff: whether implicit methods are compared on it.
        exact: centres of mass (n, 3) [m] at a time [s] in closed form, where there is one.
    """

    key: str
    title: str
    scene: stm.Scene
    horizons: tuple[float, ...]
    redundant: bool = False
    stiff: bool = False
    exact: Callable[[float], np.ndarray] | None = None


def tracker(horizons: tuple[float, ...]) -> Problem:
    """The seven-body UAV with actuator forces, the report's case 2."""
    scene = stm.make_scene("uav_tracker", TRACKER_CASE)
    return Problem("uav_tracker_2", scene.title, scene, horizons)


def stiff(horizon: float) -> Problem:
    """The same with both sliders held by stiff servos."""
    servo = stm.uav.Servo(stiffness=1e7, damping=6e4)
    scene = stm.make_scene("uav_tracker", TRACKER_CASE, servo=servo)
    title = "uav_tracker case 2, sliders held at 1e7 N/m and 6e4 N s/m"
    return Problem("uav_tracker_2_stiff_servo", title, scene, (horizon,), stiff=True)


def chain(loops: int) -> Problem:
    """The N-four-bar mechanism: N closed loops with three dependent rows each."""
    system = four_bar.four_bar(loops)
    scene = stm.Scene(f"four_bar_{loops}", "N-four-bar mechanism", system, four_bar.start(system))
    title = f"N-four-bar mechanism, N = {loops} (IFToMM A02)"

    def exact(t: float) -> np.ndarray:
        # all cranks stay parallel, so that B_0 gives every place
        tip = np.append(four_bar.closed_form(loops, np.array([t]))[0, :2], 0.0)
        feet = np.zeros((2 * loops + 1, 3))
        feet[:, 0] = [*range(loops + 1), *(k + 0.5 for k in range(loops))]
        share = np.array([0.5] * (loops + 1) + [1.0] * loops)
        return feet + share[:, None] * tip

    return Problem(scene.name, title, scene, (1.0,), redundant=True, exact=exact)


def published() -> list[Problem]:
    """Heavy top, squeezing mechanism, one four-bar loop."""
    spun = stm.Scene("heavy_top", "Heavy top, 150 rad/s", *top(FAST))
    system = squeezer()
    squeezed = stm.Scene("squeezer", "Andrews' squeezing mechanism", system, system.reference)
    return [
        Problem(spun.name, spun.title, spun, (0.2,)),
        Problem(squeezed.name, squeezed.title, squeezed, (0.03,), redundant=True),
        chain(1),
    ]


def disturbed(scene: stm.Scene, count: int, seed: int = 0) -> stm.State:
    """Starts that differ in the base's velocities, arrays (count, n, .).

    Normal, 0.1 m/s and 0.1 rad/s; projected, so that all are consistent with the joints.
    """
    tree = stm.Tree()
    model = tree.prepare(scene.system)
    x0 = tree.to_vector(model, scene.state0)
    noise = 0.1 * np.random.default_rng(seed).normal(size=(count, 6))

    def one(change: Any) -> stm.State:
        moved = moving_base(model, x0, change[:3], change[3:])
        x, _ = tree.project(model, jnp.asarray(scene.t0), moved, 3)
        return tree.to_state(model, x)

    return jax.jit(jax.vmap(one))(jnp.asarray(noise))


def moving_base(model: Any, x: Any, v: Any, omega: Any) -> Any:
    """Tree coordinates x with v [m/s] and omega [rad/s] added to the base's velocities.

    The joints' own velocities stay, so a consistent state stays consistent.
    """
    at = split_vector(model.parameters.tree, x)
    return join_coordinates(at._replace(v=at.v + v[:, None], omega=at.omega + omega[:, None]))
