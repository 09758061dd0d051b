"""Maximal coordinates, against the report's dense system and against Newton's laws."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense.system import Dense
from dense.tables import g_and_l
from helpers import relative_error

import stmuav_jax as stm


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
