"""When a rod lines up with the first axis of its universal joint and spins about itself.

Rod 5 hangs in universal joint 3-5. In the slider's axes, with the joint's first axis e and the
rod's direction u, psi is the angle of u about e. The joint lets the rod turn by psi about e and
then across, so the rod's rate about itself is (e . u) dpsi/dt plus the slider's own part: near
u = e the smallest sideways motion of the rod is a fast spin.
"""

from dataclasses import dataclass
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from failing.geometry import varied_scene

from stmuav_jax import Method, State, System, integrate
from stmuav_jax.algebra.rotation import rotation_matrix

SPAN, EVERY = 1.0, 0.002


@dataclass(frozen=True)
class Approach:
    """Rod 5 of one run on a fine grid: times [s], angle to the axis [deg], axial rate [rad/s]."""

    times: np.ndarray
    angle: np.ndarray
    spin: np.ndarray
    finished: bool

    def closest(self, start: float = 0.0, end: float = np.inf) -> tuple[float, float, float]:
        """Time [s] and angle [deg] of the closest approach in a window, largest |spin| in it."""
        inside = (self.times >= start) & (self.times <= end)
        if not np.any(inside):
            return float(self.times[-1]), 90.0, 0.0
        k = int(np.argmin(np.where(inside, self.angle, np.inf)))
        fastest = float(np.max(np.abs(self.spin[inside])))
        return float(self.times[k]), float(self.angle[k]), fastest

    def first_within(self, angle: float) -> float | None:
        """Time [s] of the first local minimum of the angle below `angle` [deg], if any."""
        a = self.angle
        low = (a[1:-1] <= a[:-2]) & (a[1:-1] <= a[2:]) & (a[1:-1] < angle)
        return float(self.times[1:-1][np.argmax(low)]) if np.any(low) else None


def _look(system: System, state: State) -> jax.Array:
    """u and du/dt in the slider's joint axes (x is e), and the slider's rate along u: (7,)."""
    joint = system.joints[system.joint_index("U35")]
    slider, rod = system.index("slider_3"), system.index("rod_5")
    R_s, R_r = rotation_matrix(state.p[slider]), rotation_matrix(state.p[rod])
    along = R_r[:, 2]
    w_s, w_r = R_s @ state.omega[slider], R_r @ state.omega[rod]
    F = R_s @ joint.frame_i
    return jnp.concatenate([F.T @ along, F.T @ jnp.cross(w_r - w_s, along), (w_s @ along)[None]])


@eqx.filter_jit
def _run(name: str, case: int, design: Any, swapped: Any, ts: Any) -> tuple[Any, Any, Any]:
    def one(design: jax.Array, swapped: jax.Array) -> tuple[Any, Any, Any]:
        scene = varied_scene(name, case, design, swapped=swapped)
        method = Method(rtol=1e-7, atol=1e-7, adjoint=diffrax.ForwardMode(), steps="state")
        path = integrate(scene.system, scene.state0, ts, method)
        seen = jax.vmap(lambda state: _look(scene.system, state))(path.states)
        return path.ts, seen, path.result == diffrax.RESULTS.successful

    return jax.lax.map(lambda x: one(*x), (design, swapped))


def approaches(
    name: str, case: int, designs: np.ndarray, *, swapped: bool = False, span: float = SPAN
) -> list[Approach]:
    """Follow rod 5 for every design vector (k, 12)."""
    ts = jnp.asarray(EVERY * np.arange(round(span / EVERY) + 1))
    order = jnp.full(len(designs), swapped)
    times, seen, fine = _run(name, case, jnp.asarray(designs), order, ts)
    rows = zip(*map(np.asarray, (times, seen, fine)), strict=True)
    return [_refine(*row) for row in rows]


def _refine(times: np.ndarray, seen: np.ndarray, fine: np.ndarray, parts: int = 20) -> Approach:
    """Cubics through the rod's direction and its rate, `parts` points to an interval."""
    keep = np.append(True, np.diff(times) > 0)
    times, seen = times[keep], seen[keep]
    x = np.linspace(0, 1, parts, endpoint=False)[:, None]
    h = np.diff(times)[:, None, None]
    u0, u1 = seen[:-1, None, :3], seen[1:, None, :3]
    f0, f1 = seen[:-1, None, 3:6], seen[1:, None, 3:6]
    bend = (1 - 2 * x) * (u1 - u0) + h * ((x - 1) * f0 + x * f1)
    u = (1 - x) * u0 + x * u1 + x * (x - 1) * bend
    turn = (1 - 2 * x) * bend + x * (x - 1) * (-2 * (u1 - u0) + h * (f0 + f1))
    rate = (u1 - u0 + turn) / h
    own = (1 - x[:, 0]) * seen[:-1, None, 6] + x[:, 0] * seen[1:, None, 6]
    aside = u[..., 1] ** 2 + u[..., 2] ** 2
    spin = u[..., 0] * (u[..., 1] * rate[..., 2] - u[..., 2] * rate[..., 1]) / aside + own
    angle = np.degrees(np.arctan2(np.sqrt(aside), np.abs(u[..., 0])))
    grid = times[:-1, None] + h[:, :, 0] * x[:, 0]
    return Approach(grid.ravel(), angle.ravel(), spin.ravel(), bool(fine))
