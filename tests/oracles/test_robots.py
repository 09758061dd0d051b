"""Robots that ship inside packages (the extra `robots`), against MuJoCo and Pinocchio.

Accelerations at 100 random states, of trees and with a loop that is closed exactly, and the motion over
a second. What the import leaves out is switched off in MuJoCo too; what is left are masses, inertias,
joints, springs and dampers.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.packaged import (
    GYMNASIUM,
    ROBOTS,
    Loop,
    Robot,
    by_mujocos_matrices,
    by_pinocchio,
    path_of,
    places,
    random_states,
    relative,
    robot,
    theirs,
)

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit

# of MuJoCo's, about files of the packages
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute")

STATES = 100


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    # MuJoCo writes its log into the present folder
    monkeypatch.chdir(tmp_path)


@quick_jit
def accelerations(space: stm.TreeSpace, start: Any, v: jax.Array) -> jax.Array:
    """Rates of the velocities at points of the space (count, dof), one compiled program."""
    return jax.vmap(
        lambda each: space.rates(space.retract(start, each))[space.dof : 2 * space.dof]
    )(v)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*GYMNASIUM, *ROBOTS])
def test_accelerations_of_a_robot_are_those_of_mujoco_and_pinocchio(name):
    it = robot(name)
    qs, us, vs = random_states(it, STATES)
    whole = np.zeros((STATES, it.space.size))
    whole[:, : 2 * it.space.dof] = vs
    ours = np.asarray(accelerations(it.space, it.start, jnp.asarray(whole)))
    assert relative(ours, theirs(it, qs, us)) < 1e-9
    if name in ROBOTS:
        assert relative(ours, by_pinocchio(it, path_of(name), vs)) < 1e-9


# Files without loops, which are closed by an equality of MuJoCo and a constraint of Pinocchio.
LOOPS = {
    # a hand held in its place
    "xarm_description/urdf/xarm7.urdf": Loop("weld", ("link7", "world")),
    # two legs held together
    "solo_description/robots/solo12.urdf": Loop("connect", ("FL_LOWER_LEG", "FR_LOWER_LEG")),
    # planar: a row of the three depends on the others
    "half_cheetah": Loop("connect", ("bfoot", "world")),
}


@quick_jit
def on_loops(
    space: stm.TreeSpace, tree: stm.TreeSpace, start: Any, first: Any, v: jax.Array
) -> Any:
    """Rates of the independent velocities, and all coordinates and velocities of the open tree."""

    def one(each: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = space.retract(start, each)
        every = tree.difference(tree.from_state(space.to_state(x)), first)
        return space.rates(x)[space.dof : 2 * space.dof], every

    return jax.vmap(one)(v)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_accelerations_of_a_robot_with_a_loop_are_those_of_exact_constraints(name):
    it, rng = robot(name, LOOPS[name]), np.random.default_rng(4)
    space = stm.TreeSpace(it.scene.system, it.scene.state0)
    v = rng.uniform(-0.2, 0.2, size=(STATES, space.size))
    v[:, space.dof :] = rng.normal(size=(STATES, space.dof))
    ours, every = on_loops(
        space, it.space, space.from_state(it.scene.state0), it.start, jnp.asarray(v)
    )
    names = [name for name, _ in it.space.names]
    own = [names.index(name) for name, _ in space.names[: space.dof]]
    exact = by_mujocos_matrices(it, np.asarray(every))
    assert relative(np.asarray(ours), exact[:, own]) < 1e-9
    if name in ROBOTS:
        exact = by_pinocchio(it, path_of(name), np.asarray(every))
        assert relative(np.asarray(ours), exact[:, own]) < 1e-9


@quick_jit
def state_at(space: stm.TreeSpace, start: Any, v: jax.Array) -> stm.State:
    return space.to_state(space.retract(start, v))


@quick_jit
def coordinates(space: stm.TreeSpace, start: Any, state: stm.State) -> jax.Array:
    return space.difference(space.from_state(state), start)


def motion(robot: Robot) -> tuple[float, float]:
    """Largest difference of the joints' coordinates from MuJoCo's after a second, and largest way [m, rad].

    Joints start at random places and rates. MuJoCo takes its classical Runge-Kutta steps of 0.1 ms.
    """
    model, mujoco, rng = robot.model, robot.mujoco, np.random.default_rng(1)
    data = mujoco.MjData(model)
    model.opt.integrator, model.opt.timestep = int(mujoco.mjtIntegrator.mjINT_RK4), 1e-4
    joints = np.flatnonzero(model.jnt_type != 0)
    place, rate = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    own = places(robot)[rate]
    v = np.zeros(robot.space.size)
    v[own], v[robot.space.dof + own] = 0.2 * rng.normal(size=len(own)), rng.normal(size=len(own))
    data.qpos[place] += v[own]
    data.qvel[rate] = v[robot.space.dof + own]
    mujoco.mj_step(model, data, 10_000)
    state = state_at(robot.space, robot.start, jnp.asarray(v))
    ts = jnp.array([0.0, 1.0])
    path = stm.integrate(robot.scene.system, state, ts, stm.Method(rtol=1e-10, atol=1e-10))
    end = coordinates(robot.space, robot.start, jax.tree.map(lambda a: a[-1], path.states))
    wanted = data.qpos[place] - model.qpos0[place]
    off = np.asarray(end)[own] - wanted
    hinges = model.jnt_type[joints] == 3
    off[hinges] -= 2 * np.pi * np.round(off[hinges] / (2 * np.pi))
    return float(np.max(np.abs(off))), float(np.max(np.abs(wanted - v[own])))


MOVED = ("half_cheetah", "ur_description/urdf/ur5_robot.urdf")


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVED)
def test_a_second_of_motion_is_that_of_mujoco(name):
    error, way = motion(robot(name))
    assert way > 0.5
    assert error < 1e-7
