"""The report's dense system in NumPy, with switches for what is printed or done wrongly.

Part II, Eq. 4.23 and 4.27 with Table 4.1 of AFRL-AFOSR-JP-TR-2019-0058: 49 accelerations and
34 multipliers of the seven-body UAV from one 83 x 83 matrix. It takes its numbers from a
`Scene` and shares no equation with the package, so it is also a check of the package.

State: y = (r, p, rdot, pdot, work), all bodies' positions first; work in joules.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from failure_tables import (
    Array,
    Block,
    Bodies,
    Variant,
    bodies_at,
    collect_rows,
    cross,
    g_and_l,
    n1,
    p1,
    p2,
    point,
    stack_rows,
    times,
)

from stmuav_jax import Gravity, LinearActuator, Rotors, Scene

_KEEP = np.array([[1, 2], [0, 2], [0, 1]])
_UP = np.array([0.0, 0.0, 1.0])


class Dense:
    """The 83 x 83 system of one scene in one variant."""

    def __init__(self, scene: Scene, variant: Variant | None = None) -> None:
        system = scene.system
        self.variant = variant if variant is not None else Variant()
        unit = self.variant.metres
        self.n = system.n_bodies
        self.mass = np.asarray(system.bodies.mass)
        self.inertia = np.asarray(system.bodies.inertia) / unit**2
        self.rows = collect_rows(scene, unit)
        self.forces = _forces(scene, unit)
        self.keep: tuple[Array, Array] | None = None
        self.evaluations = 0
        if self.variant.frozen:
            start = bodies_at(self.start(scene), self.n)
            self.keep = self._choose(start)

    def start(self, scene: Scene, p: dict[str, Any] | None = None) -> Array:
        """The scene's initial state; `p` replaces Euler parameters by name, as they are."""
        state, names = scene.state0, scene.system.names
        turned = np.array(state.p)
        for name, value in (p or {}).items():
            turned[names.index(name)] = value
        L = g_and_l(turned)[1]
        p_rate = 0.5 * times(np.swapaxes(L, 1, 2), np.asarray(state.omega))
        unit = self.variant.metres
        parts = (np.asarray(state.r) / unit, turned, np.asarray(state.v) / unit, p_rate, [0.0])
        return np.concatenate([np.ravel(part) for part in parts])

    def positions(self, y: Array) -> Array:
        """Centres of mass (..., n, 3) [m] of one or many states."""
        return y[..., : 3 * self.n].reshape(*y.shape[:-1], self.n, 3) * self.variant.metres

    def _choose(self, b: Bodies) -> tuple[Array, Array]:
        """Rows kept of p1 and p2: without the one where s_i is largest in world axes."""
        return tuple(
            _KEEP[np.argmax(np.abs(times(b.A[q.i], q.axis_i)), axis=1)]
            for q in (self.rows["p1"], self.rows["p2"])
        )  # pyright: ignore[reportReturnType]

    def _blocks(self, b: Bodies, variant: Variant) -> tuple[Block, ...]:
        return (
            point(b, self.rows["point"], variant),
            n1(b, self.rows["n1"], variant),
            p1(b, self.rows["p1"], variant),
            p2(b, self.rows["p2"], variant),
        )

    def matrix(self, t: float, y: Array) -> tuple[Array, Array]:
        """The large matrix and its right-hand side."""
        n, b = self.n, bodies_at(y, self.n)
        keep = self.keep if self.keep is not None else self._choose(b)
        *whole, p1_all, p2_all = self._blocks(b, self.variant)
        blocks = (*whole, p1_all.kept(keep[0]), p2_all.kept(keep[1]))
        jacobian, gamma = stack_rows(blocks, n)
        m = len(gamma)
        K, right = np.zeros((7 * n + m, 7 * n + m)), np.zeros(7 * n + m)
        force, moment = self._loads(t, b)
        for k in range(n):
            row, column, L = 6 * k, 7 * k, b.L[k]
            columns = slice(column + 3, column + 7)
            K[row : row + 3, column : column + 3] = self.mass[k] * np.eye(3)
            K[row + 3 : row + 6, columns] = 2 * self.inertia[k] @ L
            K[6 * n + k, columns] = y[3 * n + 4 * k : 3 * n + 4 * k + 4]
            K[row : row + 3, 7 * n :] = jacobian[:, column : column + 3].T
            K[row + 3 : row + 6, 7 * n :] = 0.5 * L @ jacobian[:, columns].T
            H = 4 * b.L_rate[k].T @ self.inertia[k] @ L
            right[row : row + 3] = force[k]
            right[row + 3 : row + 6] = moment[k] - L @ H @ b.p_rate[k]
        K[7 * n :, : 7 * n] = jacobian
        right[6 * n : 7 * n] = -np.sum(b.p_rate**2, axis=1)
        right[7 * n :] = gamma
        return K, right

    def accelerations(self, t: float, y: Array) -> Array:
        """(rddot, pddot) of every body, (n, 7)."""
        K, right = self.matrix(t, y)
        x = np.linalg.inv(K) @ right if self.variant.inverse else np.linalg.solve(K, right)
        return x[: 7 * self.n].reshape(self.n, 7)

    def derivative(self, t: float, y: Array) -> Array:
        """y'. A state that is not finite gives one that is not, and no error."""
        self.evaluations += 1
        if not np.all(np.isfinite(y)):
            return np.full_like(y, np.nan)
        n = self.n
        try:
            q = self.accelerations(t, y)
        except np.linalg.LinAlgError:
            return np.full_like(y, np.nan)
        power = self._power(t, bodies_at(y, n))
        return np.concatenate([y[7 * n : 14 * n], q[:, :3].ravel(), q[:, 3:].ravel(), [power]])

    def _loads(self, t: float, b: Bodies, gravity: bool = True) -> tuple[Array, Array]:
        """World forces and body-frame moments (n, 3)."""
        f = self.forces
        force, moment = np.zeros((self.n, 3)), np.zeros((self.n, 3))
        if gravity:
            force += self.mass[:, None] * f.gravity
        force[0] += b.A[0] @ f.wrench[:3]
        moment[0] += f.wrench[3:]
        for slider, axis in f.actuators:
            u = f.amplitude * np.sin(f.frequency * t)
            along = u * b.A[0][:, 2]
            force[0] -= along
            force[slider] += along
            moment[0] -= cross(axis, u * _UP)
            if f.paired:
                arm = b.r[0] + b.A[0] @ axis - b.r[slider]
                moment[slider] += b.A[slider].T @ cross(arm, along)
        return force, moment

    def _power(self, t: float, b: Bodies) -> float:
        """Of rotors and actuators [W]."""
        force, moment = self._loads(t, b, gravity=False)
        omega = 2 * times(b.L, b.p_rate)
        return float(np.sum(force * b.v) + np.sum(moment * omega)) * self.variant.metres**2

    def energy(self, y: Array) -> float:
        """Kinetic and potential energy less the work done so far [J]."""
        b = bodies_at(y, self.n)
        omega = 2 * times(b.L, b.p_rate)
        kinetic = np.sum(self.mass * np.sum(b.v**2, 1)) + np.sum(omega * times(self.inertia, omega))
        potential = -np.sum(self.mass[:, None] * self.forces.gravity * b.r)
        return float(0.5 * kinetic + potential) * self.variant.metres**2 - float(y[-1])

    def violation(self, y: Array) -> float:
        """Largest residual, all three rows of cross products counted [m], axes' rows [1]."""
        blocks = self._blocks(bodies_at(y, self.n), Variant())
        units = (self.variant.metres, 1.0, 1.0, self.variant.metres)
        return max(u * float(np.max(np.abs(b.value))) for u, b in zip(units, blocks, strict=True))

    def norm_error(self, y: Array) -> float:
        """Largest | |p| - 1 |."""
        p = y[3 * self.n : 7 * self.n].reshape(self.n, 4)
        return float(np.max(np.abs(np.sqrt(np.sum(p**2, axis=1)) - 1)))

    def turning(self, y: Array) -> Array:
        """Angular rates in body axes (n, 3) [rad/s]."""
        b = bodies_at(y, self.n)
        return 2 * times(b.L, b.p_rate)

    def condition(self, t: float, y: Array) -> float:
        """2-norm condition number of the large matrix."""
        return float(np.linalg.cond(self.matrix(t, y)[0]))


@dataclass(frozen=True)
class Forces:
    """The scene's loads in the model's unit of length."""

    gravity: Array
    wrench: Array
    actuators: tuple[tuple[int, Array], ...] = ()
    amplitude: float = 0.0
    frequency: float = 0.0
    paired: bool = True


def _forces(scene: Scene, unit: float) -> Forces:
    system = scene.system
    found = Forces(np.zeros(3), np.zeros(6))
    for force in system.forces:
        if isinstance(force, Gravity):
            found = replace(found, gravity=np.asarray(force.acceleration) / unit)
        elif isinstance(force, Rotors):
            wrench = np.array(force.wrench(force.speed_squared, jnp.zeros(3)))  # pyright: ignore
            wrench[:3] /= unit
            wrench[3:] /= unit**2
            found = replace(found, wrench=wrench)
        elif isinstance(force, LinearActuator):
            sine: Any = force.force
            entry = (system.index(force.slider), np.asarray(force.axis_point) / unit)
            found = replace(
                found,
                actuators=(*found.actuators, entry),
                amplitude=float(sine.amplitude) / unit,
                frequency=float(sine.angular_frequency),
                paired=force.couple == "consistent",
            )
        else:
            raise TypeError(f"No load of type {type(force).__name__} here.")
    return found
