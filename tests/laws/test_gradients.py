"""Gradients through a quarter of a second of the seven-body UAV, by every kind of number.

Forward mode, reverse mode and differences are three routes; each group of numbers is moved
along one random direction.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.uav.rotor import Rotors

END = 0.25
GROUPS = ("start", "inputs", "masses", "inertias", "lengths", "joints", "rotors")


def numbers(scene):
    """The numbers of each group."""
    system = scene.system
    of = lambda kind: next(f for f in system.forces if isinstance(f, kind))
    return {
        "start": jnp.zeros(6),
        "inputs": (of(Rotors).speed_squared, jnp.asarray(stm.PART_II.value("actuator.force"))),
        "masses": system.bodies.mass,
        "inertias": system.bodies.inertia,
        "lengths": jnp.asarray(stm.PART_II.value("geometry.rods")),
        "joints": [j.point_j for j in system.joints],
        "rotors": (of(Rotors).k_f, of(Rotors).k_tau, of(Rotors).arms),
    }


def flight(values, adjoint):
    """Position and angular velocity of the panel at the end, weighted to one number."""
    amplitude = values["inputs"][1]
    table = {"actuator.force": amplitude, "geometry.rods": values["lengths"]}
    scene = stm.make_scene("uav_tracker", 2, stm.PART_II.replaced(table))
    system = scene.system
    place = next(k for k, f in enumerate(system.forces) if isinstance(f, Rotors))
    where = lambda s: (
        s.forces[place].speed_squared,
        s.bodies.mass,
        s.bodies.inertia,
        s.forces[place].k_f,
        s.forces[place].k_tau,
        s.forces[place].arms,
        *(j.point_j for j in s.joints),
    )
    # points of joints move by as much as they were moved from the table's
    change = [p - q for p, q in zip(values["joints"], POINTS, strict=True)]
    points = [j.point_j + d for j, d in zip(system.joints, change, strict=True)]
    new = (values["inputs"][0], values["masses"], values["inertias"], *values["rotors"], *points)
    system = eqx.tree_at(where, system, new)
    v, omega = values["start"][:3], values["start"][3:]
    arms = scene.state0.r - scene.state0.r[0]
    turned = jax.vmap(lambda p: stm.rotation.rotation_matrix(p).T @ omega)(scene.state0.p)
    state = scene.state0
    moved = stm.State(state.r, state.p, state.v + v + jnp.cross(omega, arms), state.omega + turned)
    # other joints need another start
    start = stm.assemble(system, moved, throw=False).state
    method = stm.Method(solver=diffrax.Dopri8(), rtol=1e-11, atol=1e-11, adjoint=adjoint)
    end = stm.integrate(system, start, jnp.array([0.0, END]), method).states
    return (
        jnp.array([1.0, -2.0, 0.5]) @ end.r[-1, 6] + jnp.array([0.1, 0.2, -0.1]) @ end.omega[-1, 6]
    )


POINTS = [j.point_j for j in stm.make_scene("uav_tracker", 2).system.joints]


def directions(values):
    """For each group one direction, of about a hundredth of the numbers' sizes; zero elsewhere."""
    rng = np.random.default_rng(5)

    def step(name, leaf):
        size = 0.01 * (float(jnp.mean(jnp.abs(leaf))) if name != "start" else 1.0)
        size = 1e-4 if name == "joints" else size
        if name == "inertias":
            # in proportion to each body's own moments, so that its tensor stays positive definite
            roots = np.sqrt(np.einsum("nii->ni", np.asarray(leaf)))
            size = 0.01 * roots[:, :, None] * roots[:, None, :]
        d = size * rng.normal(size=leaf.shape)
        return jnp.asarray(d + np.swapaxes(d, -1, -2) if name == "inertias" else d)

    own = {k: jax.tree.map(lambda leaf, k=k: step(k, leaf), v) for k, v in values.items()}
    zero = jax.tree.map(jnp.zeros_like, values)
    rows = [zero | {name: own[name]} for name in GROUPS]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


def along(values, directions, h):
    return jax.tree.map(lambda v, d: v + h * d, values, directions)


@pytest.mark.slow
def test_forward_reverse_differences():
    """By Dopri8; through an implicit solver a pendulum's are tested, in test_adjoint.py."""
    values = numbers(stm.make_scene("uav_tracker", 2))
    ways = directions(values)
    of = lambda v: flight(v, diffrax.ForwardMode())
    moved = lambda d, h: jax.jvp(of, (along(values, d, h),), (d,))
    run = jax.jit(jax.vmap(moved, in_axes=(0, None)))
    forward = run(ways, 0.0)[1]
    back = lambda v: flight(v, stm.dynamics.DiscreteAdjoint())
    gradient = jax.jit(jax.grad(back))(values)
    reverse = [
        sum(float(jnp.vdot(g, d[k])) for g, d in zip(*map(jax.tree.leaves, (gradient, ways)), strict=True))
        for k in range(len(GROUPS))
    ]  # fmt: skip
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    h = 0.02
    values_at = {k: np.asarray(run(ways, k * h)[0]) for k in (-2, -1, 1, 2)}
    expected = (8 * (values_at[1] - values_at[-1]) - (values_at[2] - values_at[-2])) / (12 * h)
    for name, found, right in zip(GROUPS, np.asarray(forward), expected, strict=True):
        assert found == pytest.approx(right, rel=1e-6), name
