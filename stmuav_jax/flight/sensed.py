"""Simulated flight of the seven-body UAV with moving tracker, as its own sensors measure it.

The full dynamics are integrated from one sample to the next. At each sample a controller reads
attitude and body rates (the true ones) and sets rotor speeds, which hold until the next:

    thrust = m g / cos(tilt),    moment = J (-k_tilt turn - k_rate omega) about the centre of mass

at the start: the controller does not know how the moving tracker changes the centre of mass. The
sensors are at the base's origin: a gyroscope (omega) and an accelerometer (R_wb^T (a - g)).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..checks.errors import ModelError, SettingError
from ..dynamics.evaluation import evaluate
from ..dynamics.method import Method
from ..dynamics.trajectory import integrate
from ..dynamics.tree.formulation import Tree
from ..mechanics.forces.applied import Gravity
from ..mechanics.state import State
from ..mechanics.system import System
from ..rotorcraft.allocation import minimum_norm, wrench_map
from ..rotorcraft.rotor import Rotors


class SensedFlight(eqx.Module):
    """Record of a flight of T steps; arrays of T + 1 rows begin with the start.

    Attributes:
        t: times (T + 1,) [s].
        speed_squared: squared rotor speeds, held over the steps (T, k) [rad^2/s^2].
        p: attitude of the base, Euler parameters (T + 1, 4).
        omega: body rates of the base (T + 1, 3) [rad/s].
        force: specific force at the base's origin at the end of each step (T, 3) [m/s^2].
        centre_of_mass: centre of mass of the system in the base's frame (T + 1, 3) [m].
        J: inertia of the system about its centre of mass, base axes (T + 1, 3, 3) [kg m^2].
        h: angular momentum of the parts relative to the base, about the centre of mass, base axes
            (T + 1, 3) [N m s].
        residual: largest position residual of the constraints [m].
    """

    t: Float[Array, " t"]
    speed_squared: Float[Array, "T k"]
    p: Float[Array, "t 4"]
    omega: Float[Array, "t 3"]
    force: Float[Array, "T 3"]
    centre_of_mass: Float[Array, "t 3"]
    J: Float[Array, "t 3 3"]
    h: Float[Array, "t 3"]
    residual: Float[Array, ""]


class Gains(eqx.Module):
    """Gains `tilt` [1/s^2] and `rate` [1/s] of the attitude controller; yaw is held like tilt."""

    tilt: float = 40.0
    rate: float = 12.0


def centre_of_mass(system: System, state: State) -> Float[Array, "3"]:
    """Centre of mass of all bodies, from the first one's origin in its axes [m]."""
    return rotation_matrix(state.p[0]).T @ (system.com(state) - state.r[0])


def inertia_about_centre(system: System, state: State) -> Float[Array, "3 3"]:
    """Inertia of all bodies together about their centre of mass, axes of the first one [kg m^2]."""
    mass = system.bodies.mass
    R_0w = rotation_matrix(state.p[0]).T
    arms = (state.r - system.com(state)) @ R_0w.T
    R = jnp.einsum("ij,njk->nik", R_0w, jax.vmap(rotation_matrix)(state.p))
    own = jnp.einsum("nij,njk,nlk->il", R, system.bodies.inertia, R)
    square = jnp.sum(mass * jnp.sum(arms**2, axis=1))
    return own + square * jnp.eye(3) - jnp.einsum("n,ni,nj->ij", mass, arms, arms)


def inner_momentum(system: System, state: State) -> Float[Array, "3"]:
    """Angular momentum of the bodies relative to the first one, in its axes [N m s].

    The reference point is the centre of mass.
    """
    mass = system.bodies.mass
    R_0w = rotation_matrix(state.p[0]).T
    arms = (state.r - system.com(state)) @ R_0w.T
    from_base = (state.r - state.r[0]) @ R_0w.T
    v = (state.v - state.v[0]) @ R_0w.T - jnp.cross(state.omega[0], from_base)
    R = jnp.einsum("ij,njk->nik", R_0w, jax.vmap(rotation_matrix)(state.p))
    spin = jnp.einsum("nij,nj->ni", R, state.omega) - state.omega[0]
    own = jnp.einsum("nij,njk,nlk,nl->i", R, system.bodies.inertia, R, spin)
    return own + jnp.einsum("n,ni->i", mass, jnp.cross(arms, v))


def sensed_flight(
    system: System,
    state0: State,
    *,
    t1: float = 2.0,
    step: float = 5e-3,
    gains: Gains | None = None,
    method: Method | None = None,
) -> SensedFlight:
    """Simulate a flight from rest, with the rotors under control.

    Args:
        system: system whose first body carries the rotors; drivers may move its joints.
        t1: final time [s].
        step: time between samples [s].

    Raises:
        ModelError: not one set of rotors, rotors on another body than the first, or no gravity.
        SettingError: a final time before the first sample.
    """
    rotors = [k for k, f in enumerate(system.forces) if isinstance(f, Rotors)]
    pull = [f.acceleration for f in system.forces if isinstance(f, Gravity)]
    if len(rotors) != 1 or not pull:
        raise ModelError("A sensed flight needs one set of rotors and gravity.")
    carrier: Any = system.forces[rotors[0]]
    if carrier.body != system.names[0]:
        raise ModelError(
            f"The rotors are on body '{carrier.body}', but a sensed flight is controlled by the motion "
            f"of the first body, '{system.names[0]}': put the body with the rotors first."
        )
    if not 0 < step <= t1 < 1e4:
        raise SettingError(
            f"The end must lie between one step of {step:g} s and 1e4 s, not {t1:g} s."
        )
    t = step * np.arange(round(t1 / step) + 1)
    if method is None:
        method = Method(rtol=1e-9, atol=1e-9, first_step=step / 4, steps="state")
    gains = Gains() if gains is None else gains
    return eqx.filter_jit(_fly)(system, state0, jnp.asarray(t), gains, method, rotors[0], pull[0])


def _fly(
    system: System, state0: State, t: Array, gains: Gains, method: Method, at: int, pull: Array
) -> SensedFlight:
    rotors: Any = system.forces[at]
    weight = jnp.sum(system.bodies.mass) * jnp.linalg.norm(pull)
    B = wrench_map(rotors, centre_of_mass(system, state0))
    J = inertia_about_centre(system, state0)
    up = -pull / jnp.linalg.norm(pull)

    def commanded(state: State) -> Array:
        R = rotation_matrix(state.p[0])
        up_b, ahead_b = R.T @ up, R.T @ jnp.array([1.0, 0.0, 0.0])
        # sines of the rotations that bring z to the vertical, and x to the world's x
        turn = jnp.stack([up_b[1], -up_b[0], -ahead_b[1]])
        moment = J @ (-gains.tilt * turn - gains.rate * state.omega[0])
        return minimum_norm(B, jnp.concatenate([(weight / R[2, 2])[None], moment]))

    def step(state: State, span: tuple) -> tuple[State, tuple]:
        before, after = span
        squared = commanded(state)
        now = eqx.tree_at(lambda s: s.forces[at].speed_squared, system, squared)
        path = integrate(now, state, jnp.stack([before, after]), method)
        end = jax.tree.map(lambda a: a[-1], path.states)
        rate = evaluate(now, end, after, formulation=Tree()).accelerations.v_rate[0]
        force = rotation_matrix(end.p[0]).T @ (rate - pull)
        return end, (squared, force, _kept(system, end), path.worst.position[-1])

    _, (squared, force, kept, worst) = jax.lax.scan(step, state0, (t[:-1], t[1:]))
    start = _kept(system, state0)
    p, omega, centre, J, h = (
        jnp.concatenate([a[None], b]) for a, b in zip(start, kept, strict=True)
    )
    return SensedFlight(t, squared, p, omega, force, centre, J, h, jnp.max(worst))


def _kept(system: System, state: State) -> tuple[Array, ...]:
    """Attitude, body rates, centre of mass, inertia and relative angular momentum of a state."""
    return (
        state.p[0], state.omega[0], centre_of_mass(system, state),
        inertia_about_centre(system, state), inner_momentum(system, state),
    )  # fmt: skip
