"""Maximal coordinates, against the report's dense system and against Newton's laws."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense.system import Dense
from dense.tables import g_and_l
from helpers import pendulum, relative_error, swung

import stmuav_jax as stm

COUNT = 6


@pytest.fixture(scope="module")
def loads():
    """Random loads on the seven bodies and ground, stacked."""
    rng = np.random.default_rng(12)
    scale = np.array([10, 0.5, 0.5, 0.1, 0.1, 0.1, 1.0, 0.0])[:, None]
    made = [
        stm.mechanics.Load(
            force=jnp.asarray(scale * rng.normal(size=(8, 3))),
            moment=jnp.asarray(0.02 * scale * rng.normal(size=(8, 3))),
            potential=jnp.zeros(()),
            power=jnp.zeros(()),
        )
        for _ in range(COUNT)
    ]
    return jax.tree.map(lambda *x: jnp.stack(x), *made)


@pytest.fixture(scope="module")
def solved(seven, loads):
    """Accelerations and reactions of all states."""
    system, states = seven
    one = lambda s, f: stm.dynamics.evaluate(system, s, load=f, formulation=stm.Augmented())
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(states, loads))


@pytest.fixture(scope="module")
def equations(seven):
    """J, gamma and velocities in (v, omega'), "body" rows."""
    system, states = seven
    model = stm.Augmented().prepare(system)

    def at(state):
        eq = model.constraints.equations(jnp.zeros(()), system.kinematics(state))
        return eq, jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(at))(states))


def test_the_system_is_the_reports_size(seven, equations):
    system = seven[0]
    J = equations[0].J
    assert J.shape == (COUNT, 34, 7, 6)
    assert 7 * system.n_bodies + J.shape[1] == 83
    assert stm.dynamics.rank(system, system.reference)[:3] == (34, 34, 8)


def test_accelerations_are_those_of_the_reports_dense_system():
    """One system of 83 unknowns in NumPy, `benchmarks/dense`, at random states of case 2."""
    scene = stm.make_scene("uav_tracker", 2)
    start, rng = scene.state0, np.random.default_rng(5)
    model = stm.Augmented().prepare(scene.system)

    @jax.jit
    def look(state):
        how = stm.Unstabilised()
        return stm.Augmented().accelerations(model, jnp.asarray(0.1), state, how)

    for _ in range(3):
        # sliders off their zero: there the rows of displacements lose their arms
        r = start.r.at[1:3, 2].add(jnp.asarray(4e-3 * rng.normal(size=2)))
        v, omega = jnp.asarray(rng.normal(size=(2, 7, 3)))
        state = stm.assemble(scene.system, stm.State(r, start.p, v, omega)).state
        dense = Dense(dataclasses.replace(scene, state0=state))
        q = dense.accelerations(0.1, dense.start(dataclasses.replace(scene, state0=state)))
        turning = 2 * np.einsum("nap,np->na", g_and_l(np.asarray(state.p))[1], q[:, 3:])
        found = look(state)
        assert relative_error(found.v_rate, q[:, :3]) < 1e-11
        assert relative_error(found.omega_rate, turning) < 1e-11


def test_accelerations_satisfy_the_constraints_and_newton(seven, loads, solved, equations):
    system, states = seven
    eq, _ = equations
    result = solved.accelerations
    u_rate = np.concatenate([result.v_rate, result.omega_rate], axis=2).reshape(COUNT, -1)
    J = eq.J.reshape(COUNT, 34, 42)
    size = np.max(np.abs(J) @ np.abs(u_rate)[..., None])
    assert np.max(np.abs(np.einsum("bmk,bk->bm", J, u_rate) - eq.gamma)) < 1e-10 * size
    # mass times acceleration = loads + J^T multipliers - gyroscopic moments
    mass, inertia = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)
    joint = np.einsum("bmk,bm->bk", J, result.multipliers).reshape(COUNT, 7, 6)
    omega = np.asarray(states.omega)
    spin = np.cross(omega, np.einsum("nij,bnj->bni", inertia, omega))
    force = np.asarray(loads.force)[:, :7] + joint[..., :3]
    moment = np.asarray(loads.moment)[:, :7] + joint[..., 3:] - spin
    assert relative_error(mass[:, None] * result.v_rate, force) < 1e-11
    turned = np.einsum("nij,bnj->bni", inertia, result.omega_rate)
    assert relative_error(turned, moment) < 1e-11


def test_baumgarte_feeds_the_residuals_back(seven):
    """J a = gamma - 2 alpha (J u - target) - beta^2 Phi, off the constraints too."""
    system, states = seven
    rng = np.random.default_rng(4)
    state = jax.tree.map(lambda x: x[0] + 1e-3 * jnp.asarray(rng.normal(size=x[0].shape)), states)
    p = state.p / jnp.linalg.norm(state.p, axis=1, keepdims=True)
    state = stm.State(state.r, p, state.v, state.omega)
    formulation = stm.Augmented()
    model = formulation.prepare(system)

    @jax.jit
    def look(state):
        kin = system.kinematics(state)
        how = stm.Baumgarte(alpha=20.0, beta=30.0)
        return (
            formulation.accelerations(model, jnp.zeros(()), state, how),
            model.constraints.equations(jnp.zeros(()), kin),
        )

    found, eq = look(state)
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    u_rate = jnp.concatenate([found.v_rate, found.omega_rate], axis=1).reshape(-1)
    feedback = -40 * (eq.matrix @ u - eq.target) - 900 * eq.value
    assert np.max(np.abs(feedback)) > 0.1
    assert relative_error(eq.matrix @ u_rate, eq.gamma + feedback) < 1e-10


@pytest.mark.slow
def test_baumgarte_pulls_the_norms_back():
    """pdot gets norm (1 - p . p) p, so that d(p . p)/dt = 2 norm (1 - p . p) p . p."""
    system = pendulum()
    state = swung(system, 0.4, 1.5)
    state = stm.State(state.r, 1.01 * state.p, state.v, state.omega)
    formulation = stm.Augmented()
    model = formulation.prepare(system)
    x = formulation.to_vector(model, state)
    rates = {}
    for how in (stm.Unstabilised(), stm.Baumgarte(norm=7.0)):
        rate, _ = formulation.derivative(model, jnp.zeros(()), x, how)
        p_rate = formulation.to_state(model, rate).p
        rates[type(how).__name__] = float(2 * state.p[0] @ p_rate[0])
    square = 1.01**2
    assert rates["Unstabilised"] == pytest.approx(0, abs=1e-15)
    assert rates["Baumgarte"] == pytest.approx(2 * 7 * (1 - square) * square, rel=1e-12)


def test_vector_and_state_are_inverse(seven):
    system, states = seven
    formulation = stm.Augmented()
    model = formulation.prepare(system)
    state = jax.tree.map(lambda x: x[0], states)
    back = formulation.to_state(model, formulation.to_vector(model, state))
    assert relative_error(back, state) == 0


def test_projection_of_a_vector(seven):
    """Back onto positions, norms and velocities; a consistent vector stays where it is."""
    system, states = seven
    formulation = stm.Augmented()
    model = formulation.prepare(system)
    zero = jnp.zeros(())
    project = jax.jit(lambda x: formulation.project(model, zero, x, 3)[0])
    residuals = jax.jit(lambda x: formulation.residuals(model, zero, x))
    x = project(formulation.to_vector(model, jax.tree.map(lambda x: x[0], states)))
    assert relative_error(project(x), x) < 1e-13
    off = x + 1e-6 * jnp.asarray(np.random.default_rng(2).normal(size=x.shape))
    before, after = residuals(off), residuals(project(off))
    assert min(float(before.position), float(before.velocity), float(before.norm)) > 1e-7
    assert float(after.position) < 1e-13
    assert float(after.velocity) < 1e-12
    assert float(after.norm) < 1e-15
    assert 1e-7 < float(jnp.max(jnp.abs(project(off) - off))) < 1e-3


def test_settings_that_make_no_sense_are_refused():
    for gain in ("alpha", "beta", "norm"):
        for value in (-1.0, np.nan, np.inf):
            with pytest.raises(stm.SettingError, match=f"gain {gain} must be finite and not neg"):
                stm.Baumgarte(**{gain: value})
    with pytest.raises(stm.SettingError, match="at least 1 iteration, not 0"):
        stm.Projection(iterations=0)


@pytest.mark.slow
def test_accelerations_that_masses_far_apart_leave_to_round_off_are_refused():
    """A link of 1e-12 kg between a hinge and a slide, as imports have them: right by `Tree`."""

    def evaluate(link, formulation=None):
        bodies = [
            stm.Body("link", link, [0.02 * link] * 3),
            stm.Body("load", 1.0, [0.02] * 3, com=[0.3, 0.0, -0.2]),
        ]
        joints = [
            stm.revolute("hinge", "ground", "link", point=[0.1, 0.2, 0.3], axis=[0.0, 1.0, 0.0]),
            stm.translational("slide", "link", "load", axis=[1.0, 1.0, 0.0]),
        ]
        system = stm.System(bodies, joints, [stm.Gravity()])
        result = stm.dynamics.evaluate(system, system.reference, formulation=formulation)
        return np.asarray(result.accelerations.v_rate)[1]

    exact = evaluate(1e-12, stm.Tree())
    # the link's mass itself changes the motion by its share
    np.testing.assert_allclose(evaluate(1e-6), exact, rtol=3e-6)
    with pytest.raises(stm.ModelError, match="bodies 'link' and 'load' are too far apart for Augm"):
        evaluate(1e-12)
