"""A formulation of a user's own, of free bodies alone, through `simulate`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import four_bar, four_bar_state, scene_of, state_of

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.base import (
    AbstractFormulation,
    AbstractModel,
    Accelerations,
    Flows,
    Reactions,
    Residuals,
)
from stmuav_jax.math.rotation import euler_parameter_rate
from stmuav_jax.mechanics.load import total_load


class Bare(AbstractModel):
    """Nothing but the system."""

    system: stm.System


class NewtonEuler(AbstractFormulation):
    """m dv/dt = f and J domega/dt = n - omega x J omega of every body, as if it had no joints."""

    def __str__(self):
        return "NewtonEuler(free bodies)"

    def allowing_dependent_rows(self):
        return None

    def prepare(self, system):
        return Bare(system)

    def vector_size(self, model):
        return 13 * model.system.n_bodies

    def to_vector(self, model, state):
        return jnp.concatenate([x.reshape(-1) for x in (state.r, state.p, state.v, state.omega)])

    def to_state(self, model, x):
        n = model.system.n_bodies
        cuts = np.cumsum([3 * n, 4 * n, 3 * n])
        return stm.State(*(part.reshape(n, -1) for part in jnp.split(x, cuts)))

    def accelerations(self, model, t, state, stabilisation):
        bodies, kin = model.system.bodies, model.system.kinematics(state)
        load = total_load(model.system.forces, t, kin)
        spin = jax.vmap(jnp.matmul)(bodies.inertia, state.omega)
        moment = load.moment[:-1] - jnp.cross(state.omega, spin)
        turned = jax.vmap(jnp.linalg.solve)(bodies.inertia, moment)
        return Accelerations(load.force[:-1] / bodies.mass[:, None], turned, jnp.zeros(0))

    def reactions(self, model, t, state, result):
        none = jnp.zeros((len(model.system.joints), 3))
        return Reactions(none, none)

    def derivative(self, model, t, x, stabilisation):
        state = self.to_state(model, x)
        found = self.accelerations(model, t, state, stabilisation)
        turning = jax.vmap(euler_parameter_rate)(state.p, state.omega)
        rate = stm.State(state.v, turning, found.v_rate, found.omega_rate)
        kin = model.system.kinematics(state)
        load = total_load(model.system.forces, t, kin)
        moment = jnp.cross(kin.r, load.force) + jnp.einsum("nab,nb->na", kin.R_wb, load.moment)
        total = lambda x: jnp.sum(x[:-1], axis=0)
        return self.to_vector(model, rate), Flows(load.power, total(load.force), total(moment))

    def at_step(self, model, t, x):
        return model

    def project(self, model, t, x, iterations):
        state = self.to_state(model, x)
        p = state.p / jnp.linalg.norm(state.p, axis=1, keepdims=True)
        x = self.to_vector(model, stm.State(state.r, p, state.v, state.omega))
        return x, self.residuals(model, t, x)

    def residuals(self, model, t, x):
        off = jnp.max(jnp.abs(jnp.sum(self.to_state(model, x).p ** 2, axis=1) - 1))
        none = jnp.zeros(())
        return Residuals(none, none, none, none, off)


@pytest.mark.slow
def test_a_users_formulation_passes_through_simulate():
    """A top thrown: the trees' motion, balances and error estimate, by equations of one's own."""
    body = stm.Body("top", 0.4, (1e-3, 2e-3, 3e-3), free=True)
    wrench = stm.AppliedForce("top", [0.0, 0.1, 0.0], point=[0.02, 0.0, 0.0])
    system = stm.System([body], [], [stm.Gravity(), wrench])
    start = state_of([[0.0, 0, 0]], [[1.0, 0, 0, 0]], [[1.0, 0, 2.0]], [[3.0, 1.0, 0.5]])
    scene = scene_of(system, start, t1=0.5, save_every=0.1)
    own = stm.simulate(scene, method=stm.Method(formulation=NewtonEuler(), rtol=1e-10, atol=1e-10))
    method = stm.Method(rtol=1e-10, atol=1e-10)
    tree = stm.simulate(scene, method=method, error_estimate=False, analysis=False)
    assert own.successful
    assert own.settings["formulation"] == "NewtonEuler(free bodies)"
    assert tree.settings["formulation"] == "Tree(cut=chosen, redundant=False)"
    np.testing.assert_allclose(own.states.r, tree.states.r, rtol=0, atol=1e-8)
    np.testing.assert_allclose(own.states.omega, tree.states.omega, rtol=0, atol=1e-8)
    assert own.certificate.relative_energy_error < 1e-8
    assert own.certificate.position_error < 1e-8


@pytest.mark.slow
def test_one_that_cannot_allow_for_dependent_rows_is_refused_where_there_are():
    system = four_bar()
    scene = scene_of(system, four_bar_state(system, 2.0))
    method = stm.Method(formulation=NewtonEuler())
    with pytest.raises(
        stm.ModelError, match=r"have dependent constraint rows, which NewtonEuler does not support"
    ):
        stm.simulate(scene, method=method, ts=[0.0, 0.1], analysis=False)


def test_a_vector_of_another_size_is_refused():
    """Further entries would count as states of forces."""

    class Short(NewtonEuler):
        def vector_size(self, model):
            return 12

    system = stm.System([stm.Body("top", 0.4, (1e-3, 2e-3, 3e-3), free=True)])
    with pytest.raises(stm.SettingError, match=r"vector_size says, 12, but it has 13"):
        stm.integrate(
            system, system.reference, jnp.array([0.0, 0.1]), stm.Method(formulation=Short())
        )
