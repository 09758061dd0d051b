"""Dependent and contradictory rows: a planar four-bar of four spatial revolutes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FOUR_BAR_POINTS, four_bar, four_bar_state, relative_error, rows_of, scene_of

import stmuav_jax as stm

RATE = 3.0
PUSH = stm.AppliedForce("coupler", [2.0, 0.0, -5.0], point=[0.1, 0.0, 0.0])
JOINTS = ("A", "B", "C", "D")


@pytest.fixture(scope="module")
def bars():
    """The four-bar and the same motion without dependent rows, moving."""
    system = four_bar(forces=[PUSH])
    other = four_bar(redundant=False, forces=[PUSH])
    return system, other, four_bar_state(system, RATE)


@pytest.fixture(scope="module")
def solved(bars):
    """Evaluation of the redundant model."""
    system, _, state = bars
    how = stm.Augmented(redundant=True)
    run = jax.jit(lambda s: stm.dynamics.evaluate(system, s, formulation=how))
    return jax.tree.map(np.asarray, run(state))


def test_rank_and_names(bars):
    system, other, state = bars
    found = stm.dynamics.rank(system, state)
    assert (found.rows, found.rank, found.dof) == (20, 17, 1)
    assert 1 <= len(found.redundant) <= 3
    assert set(found.redundant) <= set(JOINTS)
    assert found.smallest_singular_value > 1e-3
    many, smallest = stm.dynamics.ranks(system, jax.tree.map(lambda x: jnp.stack([x, x]), state))
    assert list(many) == [17, 17]
    np.testing.assert_allclose(smallest, found.smallest_singular_value, rtol=1e-9)
    assert stm.dynamics.rank(other, state)[:3] == (17, 17, 1)
    assert stm.dynamics.rank(other, state).redundant == ()


def test_the_named_joints_own_the_dependent_rows(bars):
    """The last revolute of the loop adds two rows to the other fifteen, not five."""
    system, _, state = bars
    model = stm.Augmented().prepare(system)
    owner = np.array(model.constraints.owner)
    J = rows_of(model, state).matrix
    for name in stm.dynamics.rank(system, state).redundant:
        others = owner != system.joint_index(name)
        assert np.linalg.matrix_rank(np.asarray(J)[others], tol=1e-9) == 15


def test_multipliers_have_minimum_norm(bars, solved):
    """lambda = (J W J^T)^+ (gamma - J W g), in NumPy from J, gamma and the loads."""
    system, _, state = bars
    model = stm.Augmented().prepare(system)
    eq = rows_of(model, state)
    load = model.load(jnp.zeros(()), system.kinematics(state))
    J, gamma = np.asarray(eq.matrix), np.asarray(eq.gamma)
    W = np.zeros((18, 18))
    g = np.zeros(18)
    for k in range(3):
        a, omega = 6 * k, np.asarray(state.omega[k])
        inertia = np.asarray(system.bodies.inertia[k])
        W[a : a + 3, a : a + 3] = np.eye(3) / float(system.bodies.mass[k])
        W[a + 3 : a + 6, a + 3 : a + 6] = np.linalg.inv(inertia)
        g[a : a + 3] = load.force[k]
        g[a + 3 : a + 6] = np.asarray(load.moment[k]) - np.cross(omega, inertia @ omega)
    expected = np.linalg.pinv(J @ W @ J.T, rcond=1e-11) @ (gamma - J @ W @ g)
    accelerations = (W @ (g + J.T @ expected)).reshape(3, 6)
    now = solved.accelerations
    u_rate = np.concatenate([now.v_rate, now.omega_rate], axis=1)
    assert relative_error(u_rate, accelerations) < 1e-9
    assert relative_error(now.multipliers, expected) < 1e-9


# --- contradictions


def driven(first, second):
    """The four-bar with two drivers on its crank."""
    crank = stm.revolute("A", "ground", "crank", point=FOUR_BAR_POINTS[0], axis=[0, 1, 0])
    return four_bar(
        joints=[
            stm.drive("motor", crank, first, coordinate="angle"),
            stm.drive("second", crank, second, coordinate="angle"),
        ]
    )


@pytest.mark.slow
def test_simulate_finds_and_allows_for_dependent_rows():
    """Those of the loop are left out at preparation; two drivers that agree are not."""
    system = driven(lambda t: t**2, lambda t: t * t)
    run = stm.simulate(scene_of(system, system.reference), ts=[0.0, 0.05, 0.1])
    c = run.certificate
    assert run.successful
    assert (c.rows, c.rank) == (22, 18)
    assert c.redundant == stm.dynamics.rank(system, system.reference).redundant
    assert c.position_violation < 1e-12


def test_drivers_of_different_acceleration_contradict_each_other():
    system = driven(lambda t: t**2, lambda t: 3 * t**2)
    with pytest.raises(stm.ModelError, match="constraints contradict each other") as error:
        stm.simulate(scene_of(system), ts=[0.0, 0.1])
    assert "motor" in str(error.value) or "second" in str(error.value)
    # the joints need not contradict each other
    assert "the initial velocities are inconsistent with it" in str(error.value)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (lambda t: 3 * t, r"velocities do not fit the joints: joint '(motor|second)'"),
        (lambda t: 0.3 + 0.0 * t, "positions do not fit the joints: joint 'second'"),
    ],
)
def test_drivers_of_different_speed_or_angle_contradict_each_other(second, words):
    with pytest.raises(stm.StateError, match=words):
        stm.simulate(scene_of(driven(lambda t: 0.0 * t, second)), ts=[0.0, 0.1])


def test_a_rod_of_the_wrong_length_is_found_before_the_first_step():
    A, _, C, _ = FOUR_BAR_POINTS
    rod = stm.distance("rod", "ground", "coupler", point_i=A, point_j=C, length=3.0)
    system = four_bar(redundant=False, joints=[rod])
    with pytest.raises(stm.StateError, match="positions do not fit the joints: joint 'rod'"):
        stm.simulate(scene_of(system), ts=[0.0, 0.1])
