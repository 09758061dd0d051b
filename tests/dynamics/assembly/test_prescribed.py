"""Prescribed motion: the generic solver against the tracker's closed form, efforts fed back."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parallel_robots import slider_crank

import stmuav_jax as stm

SLIDERS: list[str] = ["T12", "T13"]


def angles(t):
    """Panel angles that start at rest in the initial posture and turn far."""
    start = stm.uav.initial_angles(stm.PART_I)
    return start + jnp.stack([0.4 * jnp.sin(t) ** 2, 0.5 * jnp.sin(1.3 * t) ** 2])


def shifts(geometry):
    """Both sliders' displacements from the initial posture, functions of t."""
    home = stm.uav.strokes(geometry, stm.uav.initial_angles(stm.PART_I))
    return tuple(lambda t, k=k: (stm.uav.strokes(geometry, angles(t)) - home)[k] for k in (0, 1))


@pytest.fixture(scope="module")
def tracker():
    scene = stm.make_scene("tracker", 1)
    motions = dict(zip(SLIDERS, shifts(stm.uav.tracker_geometry(stm.PART_I)), strict=True))
    return stm.dynamics.add_drivers(scene.system, motions), scene.state0


@pytest.fixture(scope="module")
def path(tracker):
    system, state = tracker
    return stm.dynamics.kinematic_path(system, state, jnp.linspace(0, 2, 41))


def exact(t, geometry=None):
    """State and its rates at t by the closed form, twice differentiated by JAX."""
    geometry = stm.uav.tracker_geometry(stm.PART_I) if geometry is None else geometry

    def state(t):
        at, rate = jax.jvp(angles, (t,), (jnp.ones_like(t),))
        return stm.uav.posture(geometry, at, rate)

    return jax.jvp(state, (t,), (jnp.ones_like(t),))


@pytest.mark.slow
def test_positions_rates_and_accelerations_as_in_closed_form(path):
    expected, rates = jax.vmap(exact)(path.ts)
    np.testing.assert_allclose(path.states.r, expected.r, atol=1e-14)
    np.testing.assert_allclose(path.states.p, expected.p, atol=1e-13)
    assert np.max(path.residual) < 1e-15
    # far: the panel turns by half a radian
    assert np.ptp(np.asarray(jax.vmap(angles)(path.ts)), axis=0).min() > 0.3
    for found, right in (
        (path.states.v, expected.v),
        (path.states.omega, expected.omega),
        (path.v_rate, rates.v),
        (path.omega_rate, rates.omega),
    ):
        assert np.max(np.abs(right)) > 0.01
        np.testing.assert_allclose(found, right, atol=1e-11)


@pytest.mark.slow
def test_derivative_by_a_length():
    """Of the whole path by a rod's length: the implicit function against the closed form."""
    scene = stm.make_scene("tracker", 1)
    base = stm.uav.tracker_geometry(stm.PART_I)
    t = jnp.asarray([0.0, 0.4])

    def geometry(change):
        return eqx.tree_at(lambda g: g.rods, base, base.rods + jnp.array([change, 0.0]))

    def found(change):
        # the joints keep their places on the bodies; only the drivers know of the change
        motions = dict(zip(SLIDERS, shifts(geometry(change)), strict=True))
        system = stm.dynamics.add_drivers(scene.system, motions)
        got = stm.dynamics.kinematic_path(system, scene.state0, t, throw=False)
        return got.states.r[-1, -1]

    def right(change):
        home = stm.uav.strokes(base, stm.uav.initial_angles(stm.PART_I))
        q = jnp.stack([f(t[-1]) for f in shifts(geometry(change))]) + home
        at = stm.uav.angles_from_strokes(base, q, angles(t[-1])).angles
        return stm.uav.posture(base, at).r[-1]

    one = (jnp.zeros(()),), (jnp.ones(()),)
    np.testing.assert_allclose(jax.jvp(found, *one)[1], jax.jvp(right, *one)[1], rtol=1e-8)


def test_too_few_drivers():
    bodies = [stm.Body(name, 1.0, [0.1] * 3) for name in ("cart", "bob")]
    joints = [
        stm.translational("rail", "ground", "cart", axis=[1, 0, 0]),
        stm.revolute("pin", "cart", "bob", point=[0, 0, 0], axis=[0, 1, 0]),
        stm.spherical("ball", "bob", "end", point=[0, 0, 1]),
    ]
    system = stm.System(bodies, joints[:2])
    one = stm.dynamics.add_drivers(system, {"rail": lambda t: 0.0 * t})
    with pytest.raises(stm.ModelError, match=r"1 degree\(s\) of freedom"):
        stm.dynamics.kinematic_path(one, system.reference, jnp.zeros(1))
    with_ball = stm.System([*bodies, stm.Body("end", 1.0, [0.1] * 3)], joints)
    with pytest.raises(stm.ModelError, match="ball"):
        stm.dynamics.add_drivers(with_ball, {"ball": lambda t: t})
    states = jax.tree.map(lambda x: x[None], system.reference)
    with pytest.raises(stm.ModelError, match="no drivers"):
        stm.dynamics.driver_efforts(system, states, jnp.zeros(1))


def test_a_path_that_leaves_the_reach_ends_there():
    scene = stm.make_scene("tracker", 1)
    away = stm.dynamics.add_drivers(
        scene.system, {"T12": lambda t: 0.0 * t, "T13": lambda t: -0.2 * t}
    )
    ts = jnp.linspace(0, 1, 41)
    path = stm.dynamics.kinematic_path(away, scene.state0, ts, throw=False)
    bad = np.flatnonzero(path.reason)
    assert 2 < bad[0] < 40
    assert path.reason[bad[0]] in (
        stm.dynamics.PathReason.NOT_CONVERGED,
        stm.dynamics.PathReason.SINGULAR,
        stm.dynamics.PathReason.BRANCH,
    )
    assert np.all(path.reason[bad[0] + 1 :] == stm.dynamics.PathReason.AFTER_FAILURE)
    assert np.all(np.isnan(path.states.r[bad[0] :]))
    assert np.all(np.isfinite(path.states.r[: bad[0]]))
    with pytest.raises(stm.StateError, match=f"stops at t = {float(ts[bad[0]]):.6g} s"):
        stm.dynamics.kinematic_path(away, scene.state0, ts)


@pytest.mark.slow
def test_efforts_fed_back():
    """A crank's angle prescribed, and the efforts that this took given back: the same motion of the loop."""
    system = slider_crank(0.8, "O")
    driven = stm.dynamics.add_drivers(system, {"O": lambda t: 0.6 * jnp.sin(1.2 * t) ** 4})
    ts = jnp.linspace(0, 1.0, 201)
    method = stm.Method(rtol=1e-13, atol=1e-14, adjoint=diffrax.ForwardMode())
    one = jax.jit(lambda s: stm.integrate(driven, s, ts, method))(driven.reference)
    efforts = jax.jit(lambda s: stm.dynamics.driver_efforts(driven, s, ts))(one.states)["drive O"]
    motor = stm.JointEffort("O", stm.math.Sampled(ts, efforts))
    pushed = dataclasses.replace(system, forces=(system.forces[0], motor))
    two = jax.jit(lambda s: stm.integrate(pushed, s, ts[::20], method))(pushed.reference)
    assert np.max(np.abs(two.states.r - one.states.r[::20])) < 1e-9
    assert np.max(np.abs(one.states.r - one.states.r[0])) > 0.01
    assert np.ptp(efforts) > 0.1
