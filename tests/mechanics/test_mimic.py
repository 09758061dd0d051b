"""Mimic joints: a geared pair in closed form, rows of all combinations, whole turns, loads, and the formulations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import evaluated

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.constraints import group_constraints
from stmuav_jax.math.rotation import euler_parameter_rate, from_rotation_vector

RATIO, I_A, I_B, TORQUE = -0.5, 0.02, 0.05, 0.3


def wheels(*forces, drive=None, ratio=RATIO):
    """Two wheels on the ground, the second geared to the first."""
    z = [0.0, 0.0, 1.0]
    bodies = [
        stm.Body("a", 1.0, [0.01, 0.01, I_A]),
        stm.Body("b", 2.0, [0.03, 0.03, I_B], position=[0.3, 0.0, 0.0]),
    ]
    first = stm.revolute("A", "ground", "a", point=[0.0, 0.0, 0.0], axis=z)
    second = stm.revolute("B", "ground", "b", point=[0.3, 0.0, 0.0], axis=z)
    joints = [first, second, stm.mimic("gear", second, first, ratio=ratio)]
    if drive is not None:
        joints.append(stm.drive("motor", first, drive, coordinate="angle"))
    return stm.System(bodies, joints, forces)


@pytest.mark.slow
def test_a_geared_pair_turns_with_the_reduced_inertia_through_whole_turns():
    """x_a'' = T / (I_a + k^2 I_b), and the gear's effort on b is I_b k x_a''."""
    system = wheels(stm.JointEffort("A", TORQUE))
    expected = TORQUE / (I_A + RATIO**2 * I_B)
    ts = np.linspace(0.0, 1.5, 31)
    for formulation in (stm.Tree(), stm.Augmented()):
        method = stm.Method(formulation=formulation)
        run = stm.simulate(system, system.reference, ts=ts, method=method)
        a, b = run.joint("A"), run.joint("B")
        assert float(a.angle[-1]) > 2 * np.pi
        np.testing.assert_allclose(a.angle, expected * ts**2 / 2, atol=1e-7)
        np.testing.assert_allclose(b.angle, RATIO * np.asarray(a.angle), atol=1e-8)
        loads = stm.dynamics.run_loads(run)
        gear, mate = (loads.moment[:, system.joint_index(name), 2] for name in ("gear", "A"))
        # the load is that of body i on body j
        np.testing.assert_allclose(gear, I_B * RATIO * expected, rtol=1e-6)
        np.testing.assert_allclose(mate, -RATIO * I_B * RATIO * expected, rtol=1e-6)


@pytest.mark.slow
def test_a_ratio_without_whole_turns_stops_at_half_a_turn_and_says_so():
    system = wheels(stm.JointEffort("A", TORQUE), ratio=np.sqrt(2.0))
    words = "joint 'B' has come to half a turn, within which the coupling 'gear' holds: its ratio of 1.41421 is no"
    with pytest.raises(stm.SimulationError, match=words):
        stm.simulate(system, system.reference, ts=[0.0, 1.5])


def cylinders():
    """Two cylindrical joints, each coordinate of the second coupled to each of the first, one by one."""
    bodies = [
        stm.Body("base", 3.0, [0.1, 0.2, 0.25], free=True),
        stm.Body("a", 1.0, [0.02, 0.03, 0.04], position=[0.1, 0.2, 0.3], com=[0.02, 0.01, 0.03]),
        stm.Body("b", 2.0, [0.03, 0.05, 0.06], position=[0.4, -0.1, 0.0], com=[0.0, 0.05, 0.02]),
    ]
    first = stm.cylindrical("A", "base", "a", point=[0.1, 0.2, 0.3], axis=[0.3, 1.0, 0.2])
    second = stm.cylindrical("B", "base", "b", point=[0.4, -0.1, 0.0], axis=[1.0, 0.1, -0.4])
    couple = lambda x, y: stm.mimic(
        f"{x} by {y}", second, first, ratio=0.7, offset=0.05, coordinate=x, mate_coordinate=y
    )
    return bodies, first, second, couple


KINDS = [(x, y) for x in ("angle", "displacement") for y in ("angle", "displacement")]


@pytest.mark.slow
def test_rows_are_derivatives_of_each_other():
    """Along a motion with constant velocities J u is the rate of Phi, and -gamma that of J u."""
    bodies, first, second, couple = cylinders()
    system = stm.System(bodies, [first, second, *(couple(*kinds) for kinds in KINDS)])
    rows = group_constraints(system)
    rng = np.random.default_rng(3)
    turn = lambda: np.asarray(from_rotation_vector(jnp.asarray(rng.normal(size=3))))
    state = stm.State(*map(jnp.asarray, (
        rng.normal(size=(3, 3)), np.stack([turn() for _ in range(3)]),
        rng.normal(size=(3, 3)), rng.normal(size=(3, 3)),
    )))  # fmt: skip
    p_rate = euler_parameter_rate(state.p.T, state.omega.T).T
    still = jnp.zeros_like(state.v)
    u = jnp.concatenate([state.v, state.omega], axis=1)

    @jax.jit
    def look(state):
        eq = rows.equations(jnp.zeros(()), system.kinematics(state))
        return eq.value, jnp.einsum("mnk,nk->m", eq.J, u), eq.gamma

    (_, speed, gamma), (rate, second_rate, _) = jax.jvp(
        look, (state,), (stm.State(state.v, p_rate, still, still),)
    )
    np.testing.assert_allclose(rate, speed, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(second_rate, -gamma, rtol=1e-10, atol=1e-10)
    coupled = [k for k, owner in enumerate(rows.owner) if owner >= 2]
    assert len(coupled) == 4
    assert np.all(np.abs(np.asarray(speed)[coupled]) > 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kinds", KINDS[1:3])
def test_both_formulations_agree_on_a_moving_floating_machine(kinds):
    bodies, first, second, couple = cylinders()
    system = stm.System(bodies, [first, second, couple(*kinds)], [stm.Gravity()])
    # a start that the coupling closes
    start = {("A", kinds[1]): 0.4, ("B", kinds[0]): 0.7 * 0.4 + 0.05}
    state = stm.state_from_joints(
        system,
        {name: [start.get((name, x), 0.2) for x in ("displacement", "angle")] for name in "AB"},
        {name: [3.0 if (name, x) == ("A", kinds[1]) else 0.7 * 3.0 if (name, x) == ("B", kinds[0]) else 0.5
                for x in ("displacement", "angle")] for name in "AB"},
    )  # fmt: skip
    tree, augmented = (
        evaluated(system, state, formulation=formulation)
        for formulation in (stm.Tree(), stm.Augmented())
    )
    for x in ("v_rate", "omega_rate"):
        of_tree, of_augmented = (getattr(r.accelerations, x) for r in (tree, augmented))
        np.testing.assert_allclose(of_tree, of_augmented, rtol=1e-9, atol=1e-9)
    for x in ("force", "moment"):
        loads = (getattr(r.reactions, x) for r in (tree, augmented))
        np.testing.assert_allclose(*loads, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_driven_wheel_takes_the_other_one_along():
    """The driver's moment is that of both inertias."""
    system = wheels(drive=lambda t: 2.0 * t**2)
    run = stm.simulate(system, system.reference, t1=0.5)
    np.testing.assert_allclose(
        run.joint("B").angle, RATIO * 2.0 * np.asarray(run.ts) ** 2, atol=1e-8
    )
    moment = stm.dynamics.run_loads(run).moment[:, 3, 2]
    np.testing.assert_allclose(moment, 4.0 * (I_A + RATIO**2 * I_B), rtol=1e-6)


def test_a_coupling_that_cannot_be_is_refused():
    bodies, first, second, couple = cylinders()
    with pytest.raises(stm.ModelError, match="say which by coordinate="):
        stm.mimic("m", second, first, ratio=1.0)
    with pytest.raises(stm.ModelError, match="names the unknown joint 'A'"):
        stm.System(bodies[:1] + bodies[2:], [second, couple("angle", "angle")])
