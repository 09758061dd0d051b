"""Simulation of the report's eight cases: the true motion, and the sensors' measurements.

The true attitude is on SO(3); body rates are integrated by RK4 in several substeps of each step,
in which the centre of mass moves. Noise of Table 2.4.1 is added at the end of each step (to the
attitude as a rotation vector), where the body rates are measured. By the table the centre of mass
also performs a random walk of 0.1 mm a step, even in the "fixed" cases.

Nothing balances the thrust's moment about the centre of mass: in all eight cases the quadrotor
spins up to 90 to 240 rad/s in 2 s.

Source: report Part III, Eq. 2.3.3, 2.4.1, Tables 2.4.1, 3.1.1 and 3.1.2.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...checks.errors import SettingError
from ...estimation.model import rk4_step
from ...math.compiler import quick_jit
from ...math.rotation import from_rotation_vector, product
from ...mechanics.parameters import Parameters
from .model import PART_III, Quadrotor, state_rates, thrust_moment, turn_attitude

CASES = tuple(range(1, 9))


def thrusts(case: int, t: Any) -> Float[Array, "4 *s"]:
    """Thrusts F_1 to F_4 [N] of cases 1 to 8 at times t [s].

    The histories of cases 3, 4, 7, 8 were in figures that are lost. Histories chosen instead are
    10 + 5 sin(2 pi t), all equal (3, 7), and 10 +- 2 sin(2 pi t), 10 +- 2 cos(2 pi t) (4, 8).

    Source: report Part III, Tables 3.1.1 and 3.1.2.
    """
    _check_case(case)
    t = jnp.asarray(t)
    ones, phase = jnp.ones_like(t), 2 * jnp.pi * t
    kind = (case - 1) % 4
    if kind <= 1:
        return jnp.stack([F * ones for F in ((10.0,) * 4, (7.0, 9.0, 11.0, 13.0))[kind]])
    if kind == 2:
        return jnp.stack([10 + 5 * jnp.sin(phase)] * 4)
    s, c = 2 * jnp.sin(phase), 2 * jnp.cos(phase)
    return jnp.stack([10 + s, 10 + c, 10 - s, 10 - c])


def case_offsets(case: int, t: Any) -> Float[Array, "2 *s"]:
    """Centre of mass (x, y) [m] of cases 1 to 8 at times t [s], without noise.

    It is (0.05, 0.1) in cases 1 to 4. Its motion in cases 5 to 8 is lost; the one chosen instead
    is 0.05 + 0.05 sin(pi t) and 0.1 + 0.05 (cos(pi t) - 1).
    """
    _check_case(case)
    t = jnp.asarray(t)
    if case <= 4:
        return jnp.stack([0.05 * jnp.ones_like(t), 0.1 * jnp.ones_like(t)])
    half = jnp.pi * t
    return jnp.stack([0.05 + 0.05 * jnp.sin(half), 0.1 + 0.05 * (jnp.cos(half) - 1)])


def _check_case(case: int) -> None:
    if case not in CASES:
        raise SettingError(f"The report has cases 1 to 8, not {case}.")


class CaseRecord(eqx.Module):
    """Record of one case over T steps for s seeds.

    Attributes:
        t: times (T + 1,) [s].
        u: thrusts held over the steps (T, 4) [N], or (T, 4, s).
        p: true attitude, Euler parameters (T + 1, 4, s).
        omega: true body rates (T + 1, 3, s) [rad/s].
        offset: true centre of mass (T + 1, 2, s) [m].
        y: measurements of the body rates at the ends of the steps (T, 3, s) [rad/s].
        case: number of the case.
    """

    t: Float[Array, " t"]
    u: Float[Array, "T 4 *s"]
    p: Float[Array, "t 4 s"]
    omega: Float[Array, "t 3 s"]
    offset: Float[Array, "t 2 s"]
    y: Float[Array, "T 3 s"]
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
        walk: True for a random walk of the centre of mass (true.Q of the table).
        substeps: number of substeps of each step.
    """

    walk: bool = eqx.field(static=True, default=True)
    substeps: int = eqx.field(static=True, default=4)


# Largest number of runs times steps, which needs 12 GB for truth and measurements.
MOST = 1e8


def record_times(t1: float, parameters: Parameters = PART_III) -> Float[np.ndarray, " t"]:
    """Times of a record that ends at t1 [s]."""
    dt = float(parameters.value("step"))
    return dt * np.arange(round(t1 / dt) + 1)


def simulate_case(
    case: int,
    *,
    seeds: int | Int[Array, " s"] = 50,
    t1: float = 2.0,
    seed: int = 0,
    world: World | None = None,
    parameters: Parameters = PART_III,
) -> CaseRecord:
    """Simulate truth and measurements of one case for several seeds of the noise.

    Args:
        seeds: number of runs, of which run i has seed + i; or their own seeds (s,), which may be traced.
        t1: final time [s].
        seed: seed of the first run.
        world: settings of the true motion; by default `World()`.

    Raises:
        SettingError: a case that is not 1 to 8, no seeds, a seed that is negative, an end before
            the first step, or more than fits into memory.
    """
    dt = float(parameters.value("step"))
    _check_case(case)
    count = seeds if isinstance(seeds, int) else seeds.shape[0]
    if count < 1:
        raise SettingError(f"At least one seed is needed, not {count}.")
    if not 0 <= seed < 2**62:
        raise SettingError(f"The first seed must lie between 0 and 2^62, but it is {seed}.")
    if not dt <= t1 < 1e4:
        raise SettingError(
            f"The end must lie between one step of {dt:g} s and 1e4 s, not {t1:g} s."
        )
    if count * t1 / dt > MOST:
        raise SettingError(
            f"{count} runs of {t1 / dt:.0f} steps are too many to keep at once: at most {MOST:g} in "
            "all. Take fewer seeds or an earlier end."
        )
    world = World() if world is None else world
    equations = jax.tree.map(jnp.asarray, state_rates(parameters, None))
    t = record_times(t1, parameters)
    u = thrusts(case, t[:-1]).T
    seeds = jnp.arange(seed, seed + seeds) if isinstance(seeds, int) else seeds
    keys = jax.vmap(jax.random.key)(seeds)
    table = {k: jnp.asarray(parameters.value(k)) for k in ("true.start", "true.Q", "true.R")}
    p, omega, offset, y = _simulate_case(case > 4, jnp.asarray(t), u, keys, table, equations, world)
    return CaseRecord(jnp.asarray(t), u, p, omega, offset, y, case)


@quick_jit
def _simulate_case(
    moves: bool, t: Array, u: Array, keys: Array, table: dict, equations: Quadrotor, world: World
) -> Any:
    """Attitude, rates and centre of mass at all times, and measurements at all but the first."""
    count, s = t.shape[0] - 1, keys.shape[0]
    draw = lambda key, salt, n: jax.random.normal(jax.random.fold_in(key, salt), (count, n))
    normal = lambda salt, n: jnp.moveaxis(jax.vmap(lambda key: draw(key, salt, n))(keys), 0, -1)
    kicks = normal(0, 8) * jnp.sqrt(table["true.Q"])[:, None]
    kicks = kicks if world.walk else kicks.at[:, 6:].set(0.0)
    dt = t[1] - t[0]

    h = dt / world.substeps

    def simulate_step(carry: tuple, now: tuple) -> tuple:
        p, omega, walk = carry
        t0, thrust, kick = now
        thrust = thrust[:, None]

        def turn(w: Array, t: Array) -> Array:
            offset = _centre_path(moves, t, walk)
            moment = thrust_moment(offset, thrust, equations.arm, equations.moments)
            return equations.spin(w, moment)

        # written out, one substep after the other, the compiler computes each again for those after it,
        # which takes six times as long
        def integrate_substep(k: Array, motion: tuple[Array, Array]) -> tuple[Array, Array]:
            p, omega = motion
            now = t0 + k * h
            end = rk4_step(lambda w, s: turn(w, now + s), omega, h)
            return turn_attitude(p, omega, end, turn(omega, now), turn(end, now + h), h), end

        p, omega = jax.lax.fori_loop(0, world.substeps, integrate_substep, (p, omega))
        p = product(p, from_rotation_vector(kick[:3]))
        omega, walk = omega + kick[3:6], walk + kick[6:]
        offset = _centre_path(moves, t0 + dt, walk)
        return (p, omega, walk), (p, omega, offset)

    # the angles of the table's start are zero
    wide = lambda a: jnp.broadcast_to(a[:, None], (a.shape[0], s))
    p0 = wide(jnp.array([1.0, 0.0, 0.0, 0.0]))
    start = (p0, wide(table["true.start"][3:6]), jnp.zeros((2, s)))
    _, (p, omega, offset) = jax.lax.scan(simulate_step, start, (t[:-1], u, kicks))
    first = _centre_path(moves, t[0], start[2])
    pairs = ((start[0], p), (start[1], omega), (first, offset))
    y = omega + normal(1, 3) * jnp.sqrt(table["true.R"])[:, None]
    return *(jnp.concatenate([a[None], b]) for a, b in pairs), y


def _centre_path(moves: bool, t: Array, walk: Array) -> Float[Array, "2 s"]:
    """Centre of mass [m]: that of the case plus the random walk's displacement."""
    return case_offsets(5 if moves else 1, t)[:, None] + walk
