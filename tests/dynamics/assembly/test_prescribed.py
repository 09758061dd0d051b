"""Prescribed motion: the generic solver against the tracker's closed form, efforts fed back."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm

SLIDERS: list[str] = ["T12", "T13"]


def angles(t):
    """Panel angles that start at rest in the initial posture and turn far."""
    start = stm.tracker.initial_angles(stm.PART_I)
    return start + jnp.stack([0.4 * jnp.sin(t) ** 2, 0.5 * jnp.sin(1.3 * t) ** 2])


def shifts(geometry, of=angles):
    """Both sliders' displacements from the initial posture, functions of t."""
    home = stm.tracker.strokes(geometry, stm.tracker.initial_angles(stm.PART_I))
    return tuple(lambda t, k=k: (stm.tracker.strokes(geometry, of(t)) - home)[k] for k in (0, 1))


@pytest.fixture(scope="module")
def tracker():
    scene = stm.make_scene("tracker", 1)
    motions = dict(zip(SLIDERS, shifts(stm.tracker.tracker_geometry(stm.PART_I)), strict=True))
    return stm.dynamics.driven(scene.system, motions), scene.state0


@pytest.fixture(scope="module")
def path(tracker):
    system, state = tracker
    return stm.dynamics.kinematic_path(system, state, jnp.linspace(0, 2, 41))


def exact(t, geometry=None):
    """State and its rates at t by the closed form, twice differentiated by JAX."""
    geometry = stm.tracker.tracker_geometry(stm.PART_I) if geometry is None else geometry

    def state(t):
        at, rate = jax.jvp(angles, (t,), (jnp.ones_like(t),))
        return stm.tracker.posture(geometry, at, rate)

    return jax.jvp(state, (t,), (jnp.ones_like(t),))


def test_positions_as_in_closed_form(path):
    expected, _ = jax.vmap(exact)(path.ts)
    np.testing.assert_allclose(path.states.r, expected.r, atol=1e-14)
    np.testing.assert_allclose(path.states.p, expected.p, atol=1e-13)
    assert np.max(path.residual) < 1e-15
    # far: the panel turns by half a radian
    assert np.ptp(np.asarray(jax.vmap(angles)(path.ts)), axis=0).min() > 0.3


def test_rates_and_accelerations_as_in_closed_form(path):
    expected, rates = jax.vmap(exact)(path.ts)
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
    base = stm.tracker.tracker_geometry(stm.PART_I)
    t = jnp.asarray([0.0, 0.4])

    def geometry(change):
        return eqx.tree_at(lambda g: g.rods, base, base.rods + jnp.array([change, 0.0]))

    def found(change):
        # the joints keep their places on the bodies; only the drivers know of the change
        motions = dict(zip(SLIDERS, shifts(geometry(change)), strict=True))
        system = stm.dynamics.driven(scene.system, motions)
        got = stm.dynamics.kinematic_path(system, scene.state0, t, throw=False)
        return got.states.r[-1, -1]

    def right(change):
        home = stm.tracker.strokes(base, stm.tracker.initial_angles(stm.PART_I))
        q = jnp.stack([f(t[-1]) for f in shifts(geometry(change))]) + home
        at = stm.tracker.angles_from_strokes(base, q, angles(t[-1])).angles
        return stm.tracker.posture(base, at).r[-1]

    one = (jnp.zeros(()),), (jnp.ones(()),)
    np.testing.assert_allclose(jax.jvp(found, *one)[1], jax.jvp(right, *one)[1], rtol=1e-8)


def test_too_few_drivers(tracker):
    state = tracker[1]
    scene = stm.make_scene("tracker", 1)
    one = stm.dynamics.driven(scene.system, {"T12": lambda t: 0.0 * t})
    with pytest.raises(stm.ModelError, match=r"1 degree\(s\) of freedom"):
        stm.dynamics.kinematic_path(one, state, jnp.zeros(1))
    with pytest.raises(stm.ModelError, match="S57"):
        stm.dynamics.driven(scene.system, {"S57": lambda t: t})
    with pytest.raises(stm.ModelError, match="no drivers"):
        stm.dynamics.driver_efforts(
            scene.system, jax.tree.map(lambda x: x[None], state), jnp.zeros(1)
        )


def test_a_path_that_leaves_the_reach_ends_there():
    scene = stm.make_scene("tracker", 1)
    away = stm.dynamics.driven(scene.system, {"T12": lambda t: 0.0 * t, "T13": lambda t: -0.2 * t})
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


def fed_back(make, count, span):
    """Largest difference of two runs: strokes prescribed, and the efforts this took given back."""
    slow = lambda t: (
        stm.tracker.initial_angles(stm.PART_I)
        + jnp.stack([0.3 * jnp.sin(1.2 * t) ** 4, 0.4 * jnp.sin(t) ** 4])
    )
    driven = make(strokes=shifts(stm.tracker.tracker_geometry(stm.PART_I), slow))
    ts = jnp.linspace(0, span, count)
    method = stm.Method(rtol=1e-13, atol=1e-14, adjoint=diffrax.ForwardMode())
    one = stm.algebra.outer_jit(lambda s: stm.integrate(driven.system, s, ts, method))(
        driven.state0
    )
    efforts = jax.jit(lambda s: stm.dynamics.driver_efforts(driven.system, s, ts))(one.states)
    plain = make()
    motors = [stm.JointEffort(j, stm.algebra.Sampled(ts, efforts[f"drive {j}"])) for j in SLIDERS]
    system = eqx.tree_at(lambda s: s.forces, plain.system, (*plain.system.forces, *motors))
    few = ts[:: (count - 1) // 10]
    two = stm.algebra.outer_jit(lambda s: stm.integrate(system, s, few, method))(plain.state0)
    moved = np.max(np.abs(one.states.r - one.states.r[0]))
    off = np.max(np.abs(two.states.r - one.states.r[:: (count - 1) // 10]))
    return off, moved, efforts


@pytest.mark.slow
def test_efforts_fed_back_on_the_ground():
    off, moved, efforts = fed_back(lambda **kw: stm.make_scene("tracker", 2, **kw), 201, 1.0)
    assert off < 1e-9
    assert moved > 0.01
    assert all(np.ptp(e) > 0.1 for e in efforts.values())


@pytest.mark.slow
def test_efforts_fed_back_on_the_vehicle():
    """2 s of flight, in which the vehicle tips over and the open loop multiplies errors.

    To 1e-8 of the distance flown. Absolutely 0.7e-8 to 1.4e-8 m are left, whatever the samples
    and tolerances: round-off times growth (11 1/s at the start's posture).
    """
    off, moved, _ = fed_back(lambda **kw: stm.make_scene("uav_tracker", 1, **kw), 801, 2.0)
    assert off < 1e-8 * moved
    assert 0.02 < moved < 10


@pytest.mark.slow
def test_efforts_do_the_drivers_work():
    """Effort times speed is the power that the integrated work grows by."""
    scene = stm.make_scene("tracker", 2, strokes=shifts(stm.tracker.tracker_geometry(stm.PART_I)))
    ts = jnp.linspace(0, 0.5, 101)
    run = stm.simulate(scene, method=stm.Method(rtol=1e-11, atol=1e-11), ts=np.asarray(ts))
    efforts = stm.dynamics.driver_efforts(scene.system, run.states, ts)
    speeds = run.states.v[:, :2, 2]
    power = sum(np.asarray(efforts[f"drive {j}"]) * speeds[:, k] for k, j in enumerate(SLIDERS))
    push = np.asarray(stm.PART_I.value("case_2.force"))
    power = power + run.states.v[:, -1] @ push
    weights = np.full(101, 2.0)
    weights[1::2], weights[0], weights[-1] = 4.0, 1.0, 1.0
    work = weights @ power * (0.5 / 300)
    assert work == pytest.approx(run.trajectory.work[-1], rel=1e-6)
