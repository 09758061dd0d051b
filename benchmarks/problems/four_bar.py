"""The N-four-bar mechanism, problem A02 of the IFToMM library of computational benchmarks.

2 N + 1 uniform rods of 1 m and 1 kg: N + 1 cranks from A_i = (i, 0) to B_i = (i, 1) and N
couplers between the B_i. All cranks start upright with B_0 moving at 1 m/s in x;
g = 9.81 m/s^2 along -y. One degree of freedom, but N + 1 whenever the rods lie in line.
While the cranks stay parallel, with theta from upright,

    theta'' = c sin(theta),  c = g [(N + 1) / 2 + N] / [(N + 1) / 3 + N],
    theta(0) = 0,  theta'(0) = v0,  B_0 = (sin(theta), cos(theta)),
    theta / 2 = am(v0 t / 2 | -4 c / v0^2).

As spatial revolute joints the loops have dependent rows: three per loop.
"""

from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import ellipj

import stmuav_jax as stm

GRAVITY = 9.81  # m/s^2
SPEED = 1.0  # m/s, of B_0 at the start
ROD = 1 / 12  # kg m^2, across a rod of 1 m and 1 kg
THIN = 1e-3  # kg m^2, along it; plays no part in the plane
Z = (0.0, 0.0, 1.0)
LONG = np.linspace(0.0, 20.0, 81)  # s
TOLERANCES = (1e-6, 1e-7, 1e-8, 1e-9, 1e-10)


def four_bar(loops: int, gravity: Any = GRAVITY, coupler: float = 1.0) -> stm.System:
    """The mechanism with N loops of spatial revolute joints and couplers of so many kg."""
    upright, lying = (ROD, THIN, ROD), (coupler * THIN, coupler * ROD, coupler * ROD)
    cranks = [
        stm.Body(f"crank{i}", 1.0, upright, position=(float(i), 0.5, 0.0)) for i in range(loops + 1)
    ]
    couplers = [
        stm.Body(f"coupler{i}", coupler, lying, position=(i + 0.5, 1.0, 0.0)) for i in range(loops)
    ]
    pull = stm.Gravity(jnp.asarray([0.0, -1.0, 0.0]) * jnp.asarray(gravity))
    return stm.System([*cranks, *couplers], hinges(range(loops + 1)), [pull])


def hinges(feet: Sequence[float]) -> list[stm.Joint]:
    """All hinges of cranks that stand at some places [m] and end above 0, 1, 2, ..."""
    joints = [
        stm.revolute(f"A{i}", "ground", f"crank{i}", point=(float(x), 0.0, 0.0), axis=Z)
        for i, x in enumerate(feet)
    ]
    for i in range(len(feet) - 1):
        for side, k in (("left", i), ("right", i + 1)):
            ends, point = (f"crank{k}", f"coupler{i}"), (float(k), 1.0, 0.0)
            joints.append(stm.revolute(f"B{i} {side}", *ends, point=point, axis=Z))
    return joints


def start(system: stm.System, speed: Any = SPEED) -> stm.State:
    """Upright, with B_0 moving at `speed` [m/s] in x."""
    rest = system.reference
    crank = np.array([name.startswith("crank") for name in system.names])[:, None]
    v = jnp.where(crank, 0.5 * speed, 1.0 * speed) * jnp.array([1.0, 0.0, 0.0])
    omega = jnp.where(crank, -1.0 * speed, 0.0) * jnp.array([0.0, 0.0, 1.0])
    return stm.State(rest.r, rest.p, v, omega)


def missing(by: float) -> tuple[stm.System, stm.State]:
    """One loop whose last crank stands `by` [m] farther away and is longer by by^2 / 2.

    With its rods nearly in line it comes within some sqrt(by) of a singular posture, and folds or
    unfolds there: it has no parallel branch. The system is of the same structure as `four_bar(1)`.
    """
    length, lean = np.hypot(1.0, by), np.arctan(by)
    turned = (np.cos(lean / 2), 0.0, 0.0, np.sin(lean / 2))
    inertia = (ROD * length**2, THIN, ROD * length**2)
    bodies = [
        stm.Body("crank0", 1.0, (ROD, THIN, ROD), position=(0.0, 0.5, 0.0)),
        stm.Body("crank1", 1.0, inertia, position=(1 + by / 2, 0.5, 0.0), orientation=turned),
        stm.Body("coupler0", 1.0, (THIN, ROD, ROD), position=(0.5, 1.0, 0.0)),
    ]
    system = stm.System(bodies, hinges((0.0, 1 + by)), [stm.Gravity((0.0, -GRAVITY, 0.0))])
    rest = system.reference
    # the end of the longer crank moves across it, (1, by), and the coupler makes up for that
    v = SPEED * jnp.array([[0.5, 0.0, 0.0], [0.5, by / 2, 0.0], [1.0, by / 2, 0.0]])
    omega = SPEED * jnp.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, by]])
    return system, stm.State(rest.r, rest.p, v, omega)


def jacobi_negative(u: np.ndarray, n: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sn, cn, dn of the negative parameter m = -n, n > 0 (Abramowitz & Stegun 16.10)."""
    sn, cn, dn, _ = ellipj(u * np.sqrt(1 + n), n / (1 + n))
    return sn / dn / np.sqrt(1 + n), cn / dn, 1 / dn


def closed_form(loops: int, t: np.ndarray, coupler: float = 1.0) -> np.ndarray:
    """B_0 [m] and its velocity [m/s] at times t [s], (k, 4)."""
    couplers = loops * coupler
    c = GRAVITY * ((loops + 1) / 2 + couplers) / ((loops + 1) / 3 + couplers)
    sn, cn, dn = jacobi_negative(0.5 * SPEED * t, 4 * c / SPEED**2)
    x, y, rate = 2 * sn * cn, 1 - 2 * sn**2, SPEED * dn
    return np.stack([x, y, rate * y, -rate * x], axis=1)


def kinetic_and_potential(system: stm.System, states: stm.State) -> np.ndarray:
    """Energy of bodies that move in the plane [J], (k,)."""
    r, v, omega = (np.asarray(x) for x in (states.r, states.v, states.omega))
    mass, inertia = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)[:, 2, 2]
    each = mass * (0.5 * np.sum(v**2, axis=2) + GRAVITY * r[:, :, 1])
    return np.sum(each + 0.5 * inertia * omega[:, :, 2] ** 2, axis=1)


@eqx.filter_jit
def course(system: stm.System, state: stm.State, rtol: Any) -> stm.dynamics.Trajectory:
    """20 s, at tolerances that are data: a program for each N."""
    how = {"adjoint": diffrax.ForwardMode(), "steps": "state", "max_steps": 3000}
    method = stm.Method(formulation=stm.Tree(redundant=True), rtol=rtol, atol=rtol, **how)
    return stm.integrate(system, state, jnp.asarray(LONG), method)
