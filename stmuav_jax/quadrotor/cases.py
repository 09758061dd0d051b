"""Simulation of the report's eight cases: the true motion, and the sensors' measurements.

The true attitude is on SO(3); body rates are integrated by RK4 in several substeps of each step,
in which the centre of mass moves. Noise of Table 2.4.1 is added at the end of each step (to the
attitude as a rotation vector), where the body rates are measured. The lost histories of thrust and
centre of mass are those chosen in `model.py`. By the table the centre of mass also performs a
random walk of 0.1 mm a step, even in the "fixed" cases.

Nothing balances the thrust's moment about the centre of mass: in all eight cases the quadrotor
spins up to 90 to 240 rad/s in 2 s. `hover.py` has a flight that a controller stabilises.

Source: report Part III, Eq. 2.3.3, 2.4.1, Tables 2.4.1, 3.1.1 and 3.1.2.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import outer_jit
from ..algebra.rotation import cross, from_rotation_vector, product
from ..algebra.small import inverse
from ..algebra.stacked import apply
from ..checks.errors import SettingError
from ..estimation.propagate import rk4_step
from ..parameters.table import Parameters
from .attitude import turned
from .extended import SwingMotion, load_factor, motion, spun
from .model import PART_III, offsets, specific_force, thrusts, torque

CASES = tuple(range(1, 9))


class CaseRecord(eqx.Module):
    """Record of one case over T steps for s seeds.

    Attributes:
        t: times (T + 1,) [s].
        u: thrusts held over the steps (T, 4) [N], or (T, 4, s).
        p: true attitude, Euler parameters (T + 1, 4, s).
        omega: true body rates (T + 1, 3, s) [rad/s].
        offset: true centre of mass (T + 1, 2, s) [m].
        y: measurements at the ends of the steps (T, m, s): body rates, then specific force if
            there is an accelerometer.
        case: number of the case.
    """

    t: Float[Array, " t"]
    u: Float[Array, "T 4 *s"]
    p: Float[Array, "t 4 s"]
    omega: Float[Array, "t 3 s"]
    offset: Float[Array, "t 2 s"]
    y: Float[Array, "T m s"]
    case: int = eqx.field(static=True)

    @property
    def seeds(self) -> int:
        """Number of runs."""
        return self.y.shape[2]

    @property
    def step(self) -> Float[Array, ""]:
        """Length of the steps [s]."""
        return self.t[1] - self.t[0]


class World(eqx.Module):
    """Settings of the true motion, in addition to the case.

    Attributes:
        load: mass of the moving load [kg], or None for the report's load without inertia.
        damping: coefficient d of a rotational drag -d Omega [N m s].
        walk: True for a random walk of the centre of mass (true.Q of the table).
        accelerometer: standard deviation of an accelerometer at the epicentre [m/s^2], or None.
        substeps: number of substeps of each step.
    """

    load: float | None = None
    damping: float = 0.0
    walk: bool = eqx.field(static=True, default=True)
    accelerometer: float | None = None
    substeps: int = eqx.field(static=True, default=4)


# Largest number of runs times steps, which needs 12 GB for truth and measurements.
MOST = 1e8


def check_seeds(seeds: int, seed: int) -> None:
    """Raise `SettingError` unless there are runs, and the first seed is from 0 to 2^62."""
    if seeds < 1:
        raise SettingError(f"At least one seed is needed, not {seeds}.")
    if not 0 <= seed < 2**62:
        raise SettingError(f"The first seed must lie between 0 and 2^62, but it is {seed}.")


def check_room(seeds: int, steps: float) -> None:
    """Raise `SettingError` if the number of runs times steps exceeds `MOST`."""
    if seeds * steps > MOST:
        raise SettingError(
            f"{seeds} runs of {steps:.0f} steps are too many to keep at once: at most {MOST:g} in all. "
            "Take fewer seeds or an earlier end."
        )


def simulate_case(
    case: int,
    *,
    seeds: int = 50,
    t1: float = 2.0,
    seed: int = 0,
    world: World | None = None,
    parameters: Parameters = PART_III,
) -> CaseRecord:
    """Simulate truth and measurements of one case for several seeds of the noise.

    Args:
        seeds: number of runs.
        t1: final time [s].
        seed: seed of the first run; run i has seed + i.
        world: settings of the true motion; by default `World()`.

    Raises:
        SettingError: a case that is not 1 to 8, no seeds, a seed that is negative, an end before
            the first step, or more than fits into memory.
    """
    dt = float(parameters.value("step"))
    if case not in CASES:
        raise SettingError(f"The report has cases 1 to 8, not {case}.")
    check_seeds(seeds, seed)
    if not dt <= t1 < 1e4:
        raise SettingError(
            f"The end must lie between one step of {dt:g} s and 1e4 s, not {t1:g} s."
        )
    check_room(seeds, t1 / dt)
    world = World() if world is None else world
    if world.load is not None:
        load_factor(parameters.value("mass"), world.load)
    t = dt * np.arange(round(t1 / dt) + 1)
    u = thrusts(case, t[:-1]).T
    keys = jax.vmap(jax.random.key)(jnp.arange(seed, seed + seeds))
    tables = {k: jnp.asarray(parameters.value(k)) for k in _USED}
    p, omega, offset, y = _flown(case > 4, jnp.asarray(t), u, keys, tables, world)
    return CaseRecord(jnp.asarray(t), u, p, omega, offset, y, case)


_USED = ("arm", "drag", "inertia", "mass", "true.start", "true.Q", "true.R")


@outer_jit
def _flown(moves: bool, t: Array, u: Array, keys: Array, table: dict, world: World) -> Any:
    """Attitude, rates and centre of mass at all times, and measurements at all but the first."""
    count, s = t.shape[0] - 1, keys.shape[0]
    normal = lambda salt, n: jnp.moveaxis(
        jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, salt), (count, n)))(keys),
        0,
        -1,
    )
    kicks = normal(0, 8) * jnp.sqrt(table["true.Q"])[:, None]
    kicks = kicks if world.walk else kicks.at[:, 6:].set(0.0)
    q0 = table["true.start"]
    wide = lambda a: jnp.broadcast_to(a[:, None], (a.shape[0], s))
    fly = _Flight(moves, table, world)

    def step(carry: tuple, now: tuple) -> tuple:
        p, omega, walk = carry
        t0, thrust, kick = now
        p, omega = fly.over(p, omega, walk, t0, t[1] - t[0], thrust[:, None])
        p = product(p, from_rotation_vector(kick[:3]))
        omega, walk = omega + kick[3:6], walk + kick[6:]
        path = fly.path(t0 + (t[1] - t[0]), walk)
        force = fly.specific_force(omega, thrust[:, None], path)
        return (p, omega, walk), (p, omega, path.c[:2], force)

    # the angles of the table's start are zero
    p0 = wide(jnp.array([1.0, 0.0, 0.0, 0.0]))
    start = (p0, wide(q0[3:6]), jnp.zeros((2, s)))
    _, (p, omega, offset, force) = jax.lax.scan(step, start, (t[:-1], u, kicks))
    first = fly.path(t[0], start[2]).c[:2]
    joined = [
        jnp.concatenate([a[None], b])
        for a, b in ((start[0], p), (start[1], omega), (first, offset))
    ]
    y = omega + normal(1, 3) * jnp.sqrt(table["true.R"])[:, None]
    if world.accelerometer is not None:
        y = jnp.concatenate([y, force + normal(2, 3) * world.accelerometer], axis=1)
    return *joined, y


class _Flight(eqx.Module):
    """Equations of the true motion."""

    moves: bool = eqx.field(static=True)
    table: dict
    world: World

    def path(self, t: Array, walk: Array) -> SwingMotion:
        """Motion of the centre of mass: that of the case plus the random walk's displacement."""
        case = 5 if self.moves else 1
        along = lambda f, t: jax.jvp(f, (t,), (jnp.ones_like(t),))
        place = lambda t: offsets(case, t)
        rate = lambda t: along(place, t)[1]
        c, c1 = along(place, t)
        c2 = along(rate, t)[1]
        zero = jnp.zeros_like(walk)
        return motion(c[:, None] + walk, c1[:, None] + zero, c2[:, None] + zero)

    def turning(self, omega: Array, thrust: Array, path: SwingMotion) -> Array:
        table, world = self.table, self.world
        J = table["inertia"][..., None]
        moment = torque(path.c[:2], thrust, table["arm"], table["drag"]) - world.damping * omega
        if world.load is None:
            return apply(inverse(J), moment - cross(omega, apply(J, omega)))
        return spun(omega, moment, J, path, load_factor(table["mass"], world.load))

    def specific_force(self, omega: Array, thrust: Array, path: SwingMotion) -> Array:
        """Reading of an accelerometer at the epicentre (3, *s) [m/s^2]."""
        lift = jnp.sum(thrust, axis=0) / self.table["mass"]
        moving = path.rate, path.acceleration
        return specific_force(omega, self.turning(omega, thrust, path), path.c, lift, moving)

    def over(
        self, p: Array, omega: Array, walk: Array, t: Array, dt: Array, thrust: Array
    ) -> tuple[Array, Array]:
        """Attitude and body rates after one step, by substeps of RK4."""
        h = dt / self.world.substeps
        f = lambda w, t: self.turning(w, thrust, self.path(t, walk))

        # written out, one substep after the other, the compiler computes each again for those after it,
        # which takes six times as long
        def substep(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            p, omega = carry
            now = t + k * h
            end = rk4_step(lambda w, s: f(w, now + s), omega, h)
            return turned(p, omega, end, f(omega, now), f(end, now + h), h), end

        return jax.lax.fori_loop(0, self.world.substeps, substep, (p, omega))
