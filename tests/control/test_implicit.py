"""Loops that are integrated implicitly, against exact ones and explicit ones."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm

control = stm.control

RATE, GAIN, START = 50.0, np.array([30.0, 6.0]), np.array([0.1, -0.2])
MASS, STIFFNESS = 2.0, 50.0
TOLERANCE = 1e-9


def loop(damping, method=None, steps=None):
    """A mass with a spring and a damper [N s/m] on a rail under a state feedback, for 0.6 s."""
    mass = stm.Body("mass", MASS, np.eye(3) * 0.1)
    rail = stm.translational("rail", "ground", "mass", point=[0.0] * 3, axis=[1.0, 0.0, 0.0])
    spring = stm.mechanics.JointServo("rail", target=0.0, stiffness=STIFFNESS, damping=damping)
    system = stm.System([mass], [rail], [spring, stm.JointEffort("rail", 0.0)])
    start = stm.state_from_joints(system, {"rail": START[0]}, {"rail": START[1]})
    plant = control.Plant(system, start, rate=RATE, inputs=["effort"], method=method, steps=steps)

    def feedback(estimate, reference, memory):
        x = jnp.stack([estimate.r[0, 0], estimate.v[0, 0]])
        return -jnp.asarray(GAIN) @ x[:, None], memory

    return control.close_loop(plant, feedback, 0.6, balances=False, throw=False)


def by_hand(damping, samples):
    """Positions and rates of the exact sampled system."""
    A = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -damping / MASS]])
    A_d, B_d = control.held_matrices(A, np.array([[0.0], [1 / MASS]]), 1 / RATE)
    rows = [START]
    for _ in range(samples - 1):
        rows.append((A_d - B_d @ GAIN[None]) @ rows[-1])
    return np.array(rows)


def test_an_implicit_loop_is_the_exact_sampled_system():
    """Of a stiff damper, 1e5 N s/m: its mode decays in 20 us, a thousandth of a period."""
    solver = stm.dynamics.kvaerno5()
    run = loop(1e5, stm.Method(solver=solver, rtol=TOLERANCE, atol=TOLERANCE, steps="state"))
    exact = by_hand(1e5, 31)
    assert run.successful
    np.testing.assert_allclose(run.states.r[:, 0, 0], exact[:, 0], atol=TOLERANCE)
    np.testing.assert_allclose(run.states.v[1:, 0, 0], exact[1:, 1], atol=TOLERANCE)


def test_fixed_steps_of_the_default_method_are_too_long_for_a_stiff_loop():
    """Four steps of order 4 in a period of 20 ms: the loop says that its motion is no longer finite."""
    run = loop(1e5, steps=4)
    assert not run.successful
    assert "its steps are too long" in run.failure


@pytest.mark.slow
def test_a_hexacopter_flies_the_same_way_implicitly():
    """Along a circle with a climb, by diffrax's Kvaerno5 and by the default fixed steps."""
    path = control.follow_path(lambda t: jnp.stack([jnp.cos(2 * t) - 1.0, jnp.sin(2 * t), 0.2 * t]))
    scene = stm.make_scene("hexacopter")
    pilot = stm.uav.FlightController(scene.system, 100.0)
    ends = {}
    tight = {"rtol": TOLERANCE, "atol": TOLERANCE, "steps": "state"}
    for name, method, steps in (
        ("implicit", stm.Method(solver=diffrax.Kvaerno5(), **tight), None),
        ("fixed", None, 2),
    ):
        plant = control.Plant(scene, rate=100.0, method=method, steps=steps)
        ends[name] = control.close_loop(
            plant, pilot, 1.0, reference=path, memory=pilot.start(), balances=False
        )
    for field in ("r", "p", "v", "omega"):
        one, other = (getattr(end.states, field) for end in ends.values())
        # two fixed steps of order 4 in 10 ms leave 3e-7 rad/s
        np.testing.assert_allclose(one, other, atol=1e-6)
