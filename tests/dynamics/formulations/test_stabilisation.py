"""What holds the constraints: a stabilisation of one's own is one class, for every formulation."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import four_bar, four_bar_state, pendulum, relative_error, scene_of, swung

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.stabilisation import AbstractStabilisation

BARE: Any = {"error_estimate": False, "analysis": False}


class Damped(AbstractStabilisation):
    """Velocities of the rows are damped at a rate [1/s], and every step is projected as well."""

    rate: float = 8.0

    def add_row_feedback(self, gamma, value, rate):
        return gamma - self.rate * rate

    def add_norm_feedback(self, rate, p):
        return rate + self.rate * (1 - jnp.sum(p**2, axis=0)) * p

    def iterations_after_step(self):
        return 2


@pytest.mark.parametrize("formulation", [stm.Tree(), stm.Augmented()], ids=["tree", "augmented"])
def test_a_users_stabilisation_acts_in_every_formulation(formulation):
    """Off the constraints J a = gamma - 8 (J u - target)."""
    system = four_bar(redundant=False)
    state = four_bar_state(system, 2.0)
    model, rows = formulation.prepare(system), stm.Augmented().prepare(system)

    @jax.jit
    def off(x):
        at = formulation.to_state(model, x)
        eq = rows.constraints.equations(jnp.zeros(()), system.kinematics(at))
        found = formulation.accelerations(model, jnp.zeros(()), at, Damped())
        u = jnp.concatenate([at.v, at.omega], axis=1).reshape(-1)
        u_rate = jnp.concatenate([found.v_rate, found.omega_rate], axis=1).reshape(-1)
        return eq.matrix @ u_rate - eq.gamma, -8.0 * (eq.matrix @ u - eq.target)

    x = formulation.to_vector(model, state)
    # the last entries are velocities in both
    miss, feedback = off(x.at[-2:].add(0.1))
    assert np.max(np.abs(feedback)) > 0.1
    assert relative_error(miss, feedback) < 1e-9


def test_the_three_that_there_are():
    """Feedback of Baumgarte's gains alone; projections of steps alone; neither."""
    gamma, value, rate = (jnp.asarray([x]) for x in (1.0, 0.1, 0.01))
    p = jnp.array([[1.1, 0.0, 0.0, 0.0]]).T
    fed = stm.Baumgarte(alpha=2.0, beta=3.0, norm=5.0)
    np.testing.assert_allclose(fed.add_row_feedback(gamma, value, rate), 1 - 0.04 - 0.9, rtol=1e-14)
    np.testing.assert_allclose(fed.add_norm_feedback(0 * p, p)[0], 5 * (1 - 1.21) * 1.1, rtol=1e-14)
    for how in (stm.Unstabilised(), stm.Projection(iterations=4)):
        assert how.add_row_feedback(gamma, value, rate) is gamma
        assert how.add_norm_feedback(p, p) is p
    ways = (stm.Unstabilised(), fed, stm.Projection(iterations=4))
    assert [how.iterations_after_step() for how in ways] == [0, 0, 4]


@pytest.mark.slow
def test_steps_end_on_the_constraints_with_projection_alone():
    system = pendulum()
    scene = scene_of(system, swung(system, 1.0, 0.5), t1=0.2, save_every=0.1)
    how = stm.Method(formulation=stm.Augmented(), stabilisation=stm.Unstabilised(), rtol=1e-5)
    left = stm.simulate(scene, method=how, **BARE).certificate
    assert left.position_violation > 1e-12
    run = stm.simulate(scene, method=dataclasses.replace(how, stabilisation=Damped()), **BARE)
    assert run.settings["stabilisation"] == "Damped"
    assert run.certificate.position_violation < 1e-13
