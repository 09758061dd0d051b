"""A user's setting `jax_numpy_rank_promotion="raise"` means his own arrays, not those of the package."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import four_bar, four_bar_state

import stmuav_jax as stm
from stmuav_jax.estimation import Sensor, StateSpaceModel, gaussian, kalman_filter, smooth


def spun() -> stm.System:
    """Pendulum with gravity and a servo in its hinge."""
    rod = stm.Body("rod", 1.0, [0.1, 0.1, 0.1], com=[0.0, 0.0, -0.5])
    hinge = stm.revolute("hinge", "ground", "rod", point=[0, 0, 0], axis=[0, 1, 0])
    servo = stm.mechanics.JointServo("hinge", stiffness=1.0, damping=0.1, target=0.3)
    return stm.System([rod], [hinge], [stm.Gravity(), servo])


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [stm.Tree(), stm.Augmented()], ids=str)
def test_motions_and_their_derivatives_are_traced(formulation):
    """Nothing is compiled: the option acts where JAX traces the equations."""
    ts = jnp.asarray([0.0, 0.1])
    with jax.numpy_rank_promotion("raise"):
        with pytest.raises(ValueError, match="rank_promotion"):
            jnp.add(jnp.ones((2, 3)), jnp.ones(3))
        system = spun()
        state = system.reference
        method = stm.Method(formulation=formulation)

        def end(v):
            moving = stm.State(state.r, state.p, v, state.omega)
            return jnp.sum(stm.integrate(system, moving, ts, method).states.r[-1])

        jax.eval_shape(jax.grad(end), state.v)
        if isinstance(formulation, stm.Augmented):
            return
        states = jax.tree.map(lambda x: x[None], state)
        jax.eval_shape(lambda: stm.dynamics.joint_loads(system, ts[:1], states))
        space = stm.TreeSpace(system)
        point = space.from_state(state)
        jax.eval_shape(lambda x: space.rates(x), point)


@pytest.mark.slow
def test_runs_filters_trims_and_flights():
    """What compiles, on a planar loop, a pendulum and a flying tracker with noisy sensors."""
    with jax.numpy_rank_promotion("raise"):
        system = four_bar()
        assert stm.simulate(system, four_bar_state(system, 3.0), ts=[0.0, 0.1]).successful
        model = StateSpaceModel(lambda x, u, dt: x, np.eye(2), Sensor(lambda x, u: x[:1], [[1.0]]))
        smooth(
            model, kalman_filter(model, gaussian(np.zeros(2), np.eye(2)), np.ones((5, 1)), dt=1.0)
        )
        arm = stm.Body("arm", 1.0, [0.1, 0.2, 0.3], position=[0.0, 0.0, -1.0])
        hinge = stm.revolute("hinge", "ground", "arm", point=[0, 0, 0], axis=[0, 1, 0])
        effort = stm.JointEffort("hinge", 0.0)
        space = stm.TreeSpace(stm.System([arm], [hinge], [stm.Gravity(), effort]))
        point = space.from_state(space.system.reference)
        assert stm.trim(space, at=point).converged
        stm.linearize(space, point)
        machine = {"scene": "uav_tracker", "options": {"drag": {}, "motor": {}}}
        entries = {"format": 1, "name": "short", "t1": 0.05, "machine": machine, "sensors": {}}
        flight = stm.missions.fly(stm.missions.make_mission(entries))
        assert flight.ending == ""
