"""Motion of a chain of joints on a moving base, from its encoders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_joint_controller import machine, moving

import stmuav_jax as stm
from stmuav_jax.uav.inner_motion import BasePose, JointChain, set_on_base


@pytest.mark.slow
def test_a_chain_is_placed_where_it_was_read():
    system = machine()
    state = moving(system)
    chain = JointChain(system)
    x, rates = chain.read(state)
    assert set(chain.names) == {"shoulder", "elbow"}
    for name, value, rate in zip(chain.names, x, rates, strict=True):
        motion = stm.mechanics.joint_motion(system, state, name)
        assert float(value) == pytest.approx(float(motion.angle), abs=1e-12)
        assert float(rate) == pytest.approx(float(motion.angle_rate), abs=1e-12)
    base = BasePose(state.r[0], state.p[0], state.v[0], state.omega[0])
    again = chain.place(base, x, rates)
    sign = jnp.sign(jnp.sum(again.p * state.p, axis=1, keepdims=True))
    for a, b in zip(
        (again.r, sign * again.p, again.v, again.omega), jax.tree.leaves(state), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.slow
def test_a_machine_that_is_set_on_a_base_has_velocities_that_are_rates_of_its_poses():
    state = moving(machine())
    turn = jnp.array([0.3, -0.2, 0.5])
    pose = lambda t: stm.rotation.from_rotation_vector(t * turn)

    def place(t):
        """The base moves by itself; the rest is carried along with its own motion."""
        p = stm.rotation.product(state.p[0], pose(t))
        base = BasePose(jnp.array([t, -2 * t, 0.1]), p, jnp.array([1.0, -2.0, 0.0]), turn)
        return set_on_base(stm.State(state.r, state.p, 0 * state.v, 0 * state.omega), base)

    now = place(jnp.zeros(()))
    rate = jax.jvp(place, (jnp.zeros(()),), (jnp.ones(()),))[1]
    np.testing.assert_allclose(rate.r, now.v, atol=1e-12)
    p_rate = stm.rotation.euler_parameter_rate(now.p.T, now.omega.T).T
    np.testing.assert_allclose(rate.p, p_rate, atol=1e-12)


def test_encoders_read_angles_up_to_whole_turns():
    chain = JointChain(machine())
    found = chain.innovation(jnp.array([3.1, 0.2]), jnp.array([-3.1, 0.1]))
    np.testing.assert_allclose(found, [6.2 - 2 * np.pi, 0.1], atol=1e-12)


def test_closed_loops_are_refused():
    with pytest.raises(stm.SettingError, match="open chain of revolute and translational joints"):
        JointChain(machine(closed=True))
