"""Gains scheduled over a posture: of a pendulum by closed forms, and over a panel's orientation."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import pendulum, swung

import stmuav_jax as stm
from stmuav_jax.algebra.compiler import quick_jit

sys.path.insert(0, str(Path(__file__).parents[2] / "flight"))
from mechanisms import ground_tracker  # pyright: ignore[reportMissingImports]

control = stm.control
LENGTH, MASS = 0.5, 2.0
INERTIA, PULL = MASS * LENGTH**2 + 0.02, MASS * 9.81 * LENGTH
NODES = np.linspace(0.0, 2.0, 5)
Q, R = [100.0, 1.0], [0.1]


@pytest.fixture(scope="module")
def bob():
    """A pendulum that its hinge turns: space, point at an angle, and the schedule over the angle."""
    system = pendulum(forces=(stm.JointEffort("hinge", 0.0),))
    space = stm.TreeSpace(system)
    point = lambda angle: space.from_state(swung(system, jnp.asarray(angle)))

    def trimmed(s):
        return point(s[0]), [PULL * np.sin(s[0])]

    return space, point, control.schedule_regulator(space, trimmed, [NODES], Q, R)


def test_gains_at_the_nodes_are_those_of_the_riccati_equation(bob):
    """A = (0, 1; -m g l cos / J, 0), B = (0; 1 / J) at each angle."""
    _, _, found = bob
    for k, angle in enumerate(NODES):
        A = np.array([[0.0, 1.0], [-PULL * np.cos(angle) / INERTIA, 0.0]])
        B = np.array([[0.0], [1 / INERTIA]])
        S = scipy.linalg.solve_continuous_are(A, B, np.diag(Q), np.diag(R))
        np.testing.assert_allclose(found.K[k], B.T @ S / R[0], rtol=1e-8)
        np.testing.assert_allclose(
            np.sort_complex(found.poles[k]), np.sort_complex(np.linalg.eigvals(A - B @ found.K[k]))
        )


def test_gains_and_inputs_are_interpolated(bob):
    """Linearly between the nodes, and at the edge beyond it; at no error the inputs are the trim's."""
    space, point, schedule = bob
    feedback = control.ScheduledFeedback(space, schedule, lambda x: x.q[0])
    call = quick_jit(lambda f, x, r: f(x, r, None)[0])
    away = jnp.array([0.1, -0.2])
    for angle in (0.0, 0.7, 1.5, 1.9, 2.3):
        held = point(angle)
        clipped = np.clip(angle, 0.0, 2.0)
        u0 = np.interp(clipped, NODES, PULL * np.sin(NODES))
        np.testing.assert_allclose(call(feedback, held, held), [u0], rtol=1e-12, atol=1e-12)
        K = [np.interp(clipped, NODES, schedule.K[:, 0, j]) for j in range(2)]
        moved = call(feedback, space.retract(held, away), held)
        np.testing.assert_allclose(moved, [u0 - np.dot(K, away)], rtol=1e-9)


def test_schedules_that_make_no_sense_are_refused(bob):
    space, point, schedule = bob
    trimmed = lambda s: (point(s[0]), [0.0])
    with pytest.raises(stm.SettingError, match="variable 1 must rise, and be two or more"):
        control.schedule_regulator(space, trimmed, [[0.0, 0.0]], Q, R)
    with pytest.raises(stm.ModelError, match=r"variables are \(0\): The weights R"):
        control.schedule_regulator(space, trimmed, [NODES], Q, [-1.0])
    wrong = control.ScheduledFeedback(space, schedule, lambda x: x.q[:0])
    with pytest.raises(stm.ModelError, match=r"must have shape \(1,\)"):
        wrong(point(0.0), point(0.0), None)
    with pytest.raises(stm.ModelError, match="needs a reference"):
        wrong(point(0.0), None, None)


def test_a_mode_that_cannot_be_moved_is_named_with_its_node():
    """A pendulum beside another one that no input moves, hanging over at the second node alone."""
    bodies = [
        stm.Body(name, MASS, [0.02, 0.02, 0.01], position=[0.0, y, -LENGTH])
        for name, y in (("bob", 0.0), ("idle", 1.0))
    ]
    joints = [
        stm.revolute(f"hinge_{name}", "ground", name, point=[0.0, y, 0.0], axis=[0, 1, 0])
        for name, y in (("bob", 0.0), ("idle", 1.0))
    ]
    forces = [stm.Gravity(), stm.JointEffort("hinge_bob", 0.0)]
    forces.append(stm.mechanics.JointDamping("hinge_idle", turning=0.5))
    space = stm.TreeSpace(stm.System(bodies, joints, forces))
    hanging = space.from_state(space.system.reference)

    def trimmed(s):
        idle = jnp.array([0.0, s[0], 0.0, 0.0])
        return space.retract(hanging, idle), [0.0]

    words = r"\(3\.14\): The inputs cannot stabilise the mode .* hinge_idle"
    with pytest.raises(stm.ModelError, match=words):
        control.schedule_regulator(space, trimmed, [[0.0, 3.14]], np.ones(4), [1.0])


@pytest.mark.slow
def test_a_panel_is_turned_by_scheduled_gains():
    """The tracker on the ground, slewed between orientations off the nodes, by its sliders."""
    space = stm.TreeSpace(ground_tracker())
    home = space.from_state(space.system.reference)
    point = lambda s: space.retract(home, jnp.concatenate([jnp.asarray(s), jnp.zeros(2)]))
    trim = quick_jit(lambda x: stm.trim(space, at=x, throw=False).values)
    nodes = np.radians([-12.0, 0.0, 12.0])
    Q, R = [4e5, 4e5, 4e2, 4e2], [1.0, 1.0]
    schedule = control.schedule_regulator(
        space, lambda s: (point(s), trim(point(s))), [nodes, nodes], Q, R, rate=400.0
    )
    # the gains are not the same everywhere
    assert np.ptp(schedule.K[..., 0, 0]) > 0.03 * np.max(np.abs(schedule.K[..., 0, 0]))
    feedback = control.ScheduledFeedback(
        space, schedule, lambda x: space.difference(x, home)[: space.dof]
    )
    ends = np.radians([[-9.0, 5.0], [8.0, -7.0]])

    def wanted(t):
        x = jnp.clip(t / 0.5, 0.0, 1.0)
        return point(ends[0] + (ends[1] - ends[0]) * x**3 * (10 - 15 * x + 6 * x**2))

    plant = control.Plant(space.system, space.to_state(point(ends[0])))
    run = control.close_loop(plant, feedback, 1.0, reference=wanted, balances=False)
    end = space.from_state(stm.State(*(jnp.asarray(x[-1]) for x in (
        run.states.r, run.states.p, run.states.v, run.states.omega))))  # fmt: skip
    off = np.asarray(space.difference(end, wanted(jnp.asarray(1.0))))
    assert np.max(np.abs(off[:2])) < np.radians(0.4)
