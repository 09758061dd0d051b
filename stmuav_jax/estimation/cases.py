"""The report's eight cases: what really happens, and what a gyroscope sees of it.

The truth keeps its attitude on SO(3), takes body rates by RK4 in several substeps of each step
and moves the centre of mass within it; noise of Table 2.4.1 is added at the end of each step
(to the attitude as a rotation vector), and the body rates are measured there. The lost histories
of thrust and centre of mass are those chosen in `quadrotor.py`. By the table the centre of mass
also wanders by 0.1 mm a step, in the "fixed" cases too.

Nothing balances the thrust's moment about the centre of mass: in all eight cases the quadrotor
spins up, to 90 to 240 rad/s after 2 s. `hover.py` has the flight that a controller keeps.

Source: report Part III, Eq. 2.3.3, 2.4.1, Tables 2.4.1, 3.1.1 and 3.1.2.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import cross, from_rotation_vector, product
from ..algebra.small import inverse
from ..algebra.stacked import apply
from ..mechanics.errors import SettingError
from ..vehicle.parameters import Parameters
from .attitude import turned
from .extended import Motion, load_factor, motion, spun
from .quadrotor import PART_III, offsets, thrusts, torque

CASES = tuple(range(1, 9))


class Record(eqx.Module):
    """One case, T steps, s seeds.

    Attributes:
        t: times (T + 1,) [s]. u: thrusts held over the steps (T, 4) [N], or (T, 4, s).
        p: true attitude (T + 1, 4, s). omega: true body rates (T + 1, 3, s) [rad/s].
        offset: true centre of mass (T + 1, 2, s) [m].
        y: measured at the end of each step (T, m, s): body rates, specific force after them.
        case: its number.
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
        """How many runs."""
        return self.y.shape[2]

    @property
    def step(self) -> Float[Array, ""]:
        """[s]"""
        return self.t[1] - self.t[0]


class World(eqx.Module):
    """What the truth consists of, beyond the case.

    Attributes:
        load: mass of the moving load [kg], or None for the report's without inertia.
        damping: d of a rotational drag -d Omega [N m s].
        walk: whether the centre of mass wanders (true.Q of the table).
        accelerometer: standard deviation of one at the epicentre [m/s^2], or None.
        substeps: of each step.
    """

    load: float | None = None
    damping: float = 0.0
    walk: bool = eqx.field(static=True, default=True)
    accelerometer: float | None = None
    substeps: int = eqx.field(static=True, default=4)


# Runs times steps that are kept at most: 12 GB of truth and measurements.
MOST = 1e8


def check_seeds(seeds: int, seed: int) -> None:
    """Raise `SettingError` unless there are runs, and their seeds are whole numbers of 63 bits."""
    if seeds < 1:
        raise SettingError(f"At least one seed is needed, not {seeds}.")
    if not 0 <= seed < 2**62:
        raise SettingError(f"The first seed must lie between 0 and 2^62, but it is {seed}.")


def check_room(seeds: int, steps: float) -> None:
    """Raise `SettingError` where runs times steps are more than are kept."""
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
) -> Record:
    """Truth and measurements of one case for several seeds of the noise.

    Args:
        seeds: how many. t1: end [s]. seed: of the first; run i is that of seed + i.

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
    return Record(jnp.asarray(t), u, p, omega, offset, y, case)


_USED = ("arm", "drag", "inertia", "mass", "true.start", "true.Q", "true.R")


@eqx.filter_jit
def _flown(moves: bool, t: Array, u: Array, keys: Array, table: dict, world: World) -> Any:
    """Attitude, rates, centre of mass with the first time, and measurements."""
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
    """The true equations of motion."""

    moves: bool = eqx.field(static=True)
    table: dict
    world: World

    def path(self, t: Array, walk: Array) -> Motion:
        """Of the centre of mass: the case's, and how far it has wandered."""
        case = 5 if self.moves else 1
        along = lambda f, t: jax.jvp(f, (t,), (jnp.ones_like(t),))
        place = lambda t: offsets(case, t)
        rate = lambda t: along(place, t)[1]
        c, c1 = along(place, t)
        c2 = along(rate, t)[1]
        zero = jnp.zeros_like(walk)
        return motion(c[:, None] + walk, c1[:, None] + zero, c2[:, None] + zero)

    def turning(self, omega: Array, thrust: Array, path: Motion) -> Array:
        table, world = self.table, self.world
        J = table["inertia"][..., None]
        moment = torque(path.c[:2], thrust, table["arm"], table["drag"]) - world.damping * omega
        if world.load is None:
            return apply(inverse(J), moment - cross(omega, apply(J, omega)))
        return spun(omega, moment, J, path, load_factor(table["mass"], world.load))

    def specific_force(self, omega: Array, thrust: Array, path: Motion) -> Array:
        """At the epicentre, body axes: (R_wb^T (a - g)) of the point -c from the centre of mass."""
        rate = self.turning(omega, thrust, path)
        out = cross(rate, path.c) + cross(omega, cross(omega, path.c))
        out = out + 2 * cross(omega, path.rate) + path.acceleration
        lift = jnp.sum(thrust, axis=0)[None] / self.table["mass"]
        return jnp.concatenate([-out[:2], lift - out[2:]])

    def over(
        self, p: Array, omega: Array, walk: Array, t: Array, dt: Array, thrust: Array
    ) -> tuple[Array, Array]:
        """Attitude and body rates after one step, by substeps of RK4."""
        h = dt / self.world.substeps
        f = lambda w, t: self.turning(w, thrust, self.path(t, walk))
        for k in range(self.world.substeps):
            now = t + k * h
            k1 = f(omega, now)
            k2 = f(omega + h / 2 * k1, now + h / 2)
            k3 = f(omega + h / 2 * k2, now + h / 2)
            k4 = f(omega + h * k3, now + h)
            end = omega + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            p = turned(p, omega, end, k1, f(end, now + h), h)
            omega = end
        return p, omega
