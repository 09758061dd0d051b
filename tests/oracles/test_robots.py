"""Robots that ship inside packages (the extra `robots`), against MuJoCo and Pinocchio.

Accelerations at 100 random states, and the motion over a second. What the import leaves out is switched
off in MuJoCo too; what is left are masses, inertias, joints, springs and dampers.
"""

import importlib
import importlib.metadata
import importlib.util
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.algebra.compiler import quick_jit
from stmuav_jax.files import scene_from_mujoco

# of MuJoCo's, about files of the packages
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute")

STATES = 100
GYMNASIUM = (
    "ant", "half_cheetah", "hopper", "humanoid", "inverted_double_pendulum", "pusher_v5", "reacher",
    "swimmer", "walker2d_v5",
)  # fmt: skip
ROBOTS = (
    "double_pendulum_description/urdf/double_pendulum.urdf", "panda_description/urdf/panda.urdf",
    "ur_description/urdf/ur5_robot.urdf", "kinova_description/robots/kinova.urdf",
    "z1_description/urdf/z1.urdf", "so_arm_description/urdf/so100.urdf",
    "solo_description/robots/solo12.urdf", "xarm_description/urdf/xarm7.urdf",
)  # fmt: skip


def path_of(name: str) -> Path:
    """File of a model; the test is skipped where its package is not installed."""
    if name in GYMNASIUM:
        spec = importlib.util.find_spec("gymnasium")
        if spec is None or spec.origin is None:
            pytest.skip("gymnasium is not installed")
        return Path(spec.origin).parent / "envs" / "mujoco" / "assets" / f"{name}.xml"
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("example-robot-data is not installed")
    return Path(str(next(f for f in files if str(f).endswith(f"robots/{name}")).locate()))


class Robot(NamedTuple):
    """A robot in MuJoCo and as a system in the coordinates of its tree."""

    mujoco: Any
    model: Any
    scene: stm.Scene
    space: stm.TreeSpace
    start: Any


def robot(name: str) -> Robot:
    mujoco: Any = pytest.importorskip("mujoco")
    path = path_of(name)
    importer = importlib.import_module("stmuav_jax.files.mujoco_import")
    spec = importer._without_meshes(mujoco.MjSpec.from_file(str(path)))
    # MuJoCo keeps the inertia of bodies that only slide from when it compiles, armature included
    for joint in spec.joints:
        joint.armature = 0.0
    model = spec.compile()
    flags = mujoco.mjtDisableBit
    off = (flags.mjDSBL_CONTACT, flags.mjDSBL_LIMIT, flags.mjDSBL_ACTUATION, flags.mjDSBL_EQUALITY)
    model.opt.disableflags |= sum(map(int, off))
    model.opt.density = model.opt.viscosity = 0.0
    model.jnt_limited[:], model.dof_frictionloss[:] = 0, 0.0
    model.tendon_stiffness[:], model.tendon_damping[:] = 0.0, 0.0
    # of floating bases
    for j in np.flatnonzero(model.jnt_type == 0):
        model.dof_damping[model.jnt_dofadr[j] : model.jnt_dofadr[j] + 6] = 0.0
        model.jnt_stiffness[j] = 0.0
    scene = scene_from_mujoco(model, path.stem)
    space = stm.TreeSpace(scene.system)
    return Robot(mujoco, model, scene, space, space.from_state(scene.state0))


def places(robot: Robot) -> np.ndarray:
    """Place in the space's velocities of every velocity of MuJoCo's hinges, slides and floating base."""
    model, names = robot.model, [name for name, _ in robot.space.names[: robot.space.dof]]
    found = []
    for j in range(model.njnt):
        kind, name = model.jnt_type[j], model.joint(j).name
        assert kind != 1, "no model has ball joints"
        if kind == 0:
            found += range(6)
        else:
            which = "angle" if kind == 3 else "displacement"
            numbered = [k for k, own in enumerate(names) if own == f"{name}.{which}"]
            found += numbered
    assert sorted(found) == list(range(robot.space.dof))
    return np.array(found)


def random_states(robot: Robot, count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Positions and velocities of MuJoCo, and those of the space from its start (count, 2 dof)."""
    model, mujoco, rng = robot.model, robot.mujoco, np.random.default_rng(seed)
    at, floating = places(robot), bool(np.any(robot.model.jnt_type == 0))
    com = np.asarray(robot.scene.system.bodies.com)[0]
    qs, us, own = [], [], []
    for _ in range(count):
        # three hinges of one body are singular where the middle one is at a right angle, and angles
        # of our springs lie in (-pi, pi], while those of MuJoCo's count on
        step, q = rng.uniform(-1.2, 1.2, size=model.nv), model.qpos0.copy()
        u = rng.normal(size=model.nv)
        mujoco.mj_integratePos(model, q, step, 1.0)
        v = np.zeros(2 * robot.space.dof)
        v[at], v[robot.space.dof + at] = step, u
        if floating:
            # theirs is the frame of the base, ours its centre of mass
            R0, R = rotation(model.qpos0[3:7]), rotation(q[3:7])
            v[:3] += (R - R0) @ com
            v[robot.space.dof : robot.space.dof + 3] += R @ np.cross(u[3:6], com)
        qs.append(q)
        us.append(u)
        own.append(v)
    return np.array(qs), np.array(us), np.array(own)


def rotation(p: np.ndarray) -> np.ndarray:
    return np.asarray(stm.rotation.rotation_matrix(jnp.asarray(p)))


@quick_jit
def accelerations(space: stm.TreeSpace, start: Any, v: jax.Array) -> jax.Array:
    """Rates of the velocities at points of the space (count, dof), one compiled program."""
    return jax.vmap(
        lambda each: space.rates(space.retract(start, each))[space.dof : 2 * space.dof]
    )(v)


def theirs(robot: Robot, qs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """Accelerations of MuJoCo (count, dof) in the order and the terms of the space."""
    data, found, at = robot.mujoco.MjData(robot.model), [], places(robot)
    com = np.asarray(robot.scene.system.bodies.com)[0]
    for q, u in zip(qs, us, strict=True):
        data.qpos[:], data.qvel[:] = q, u
        robot.mujoco.mj_forward(robot.model, data)
        a = np.zeros(robot.space.dof)
        a[at] = data.qacc
        if np.any(robot.model.jnt_type == 0):
            a[:3] += rotation(q[3:7]) @ (
                np.cross(a[3:6], com) + np.cross(u[3:6], np.cross(u[3:6], com))
            )
        found.append(a)
    return np.array(found)


def relative(ours: np.ndarray, exact: np.ndarray) -> float:
    """Largest difference over all states, each relative to its largest acceleration."""
    return float(np.max(np.max(np.abs(ours - exact), axis=1) / np.max(np.abs(exact), axis=1)))


def motion(robot: Robot) -> float:
    """Largest difference of the joints' coordinates from MuJoCo's after a second from rest [m, rad].

    MuJoCo takes its classical Runge-Kutta steps of 0.1 ms.
    """
    model, mujoco = robot.model, robot.mujoco
    data = mujoco.MjData(model)
    model.opt.integrator, model.opt.timestep = int(mujoco.mjtIntegrator.mjINT_RK4), 1e-4
    first = 0.2 * np.random.default_rng(1).normal(size=model.nv)
    joints = np.flatnonzero(model.jnt_type != 0)
    v, at = np.zeros(robot.space.size), places(robot)
    moved = model.jnt_dofadr[joints]
    data.qpos[model.jnt_qposadr[joints]] += first[moved]
    v[at[moved]] = first[moved]
    for _ in range(10_000):
        mujoco.mj_step(model, data)
    state = robot.space.to_state(robot.space.retract(robot.start, jnp.asarray(v)))
    ts = jnp.array([0.0, 1.0])
    path = stm.integrate(robot.scene.system, state, ts, stm.Method(rtol=1e-10, atol=1e-10))
    last = jax.tree.map(lambda a: a[-1], path.states)
    end = robot.space.difference(robot.space.from_state(last), robot.start)
    wanted = data.qpos[model.jnt_qposadr[joints]] - model.qpos0[model.jnt_qposadr[joints]]
    off = np.asarray(end)[at[moved]] - wanted
    hinges = model.jnt_type[joints] == 3
    off[hinges] -= 2 * np.pi * np.round(off[hinges] / (2 * np.pi))
    return float(np.max(np.abs(off)))


def by_pinocchio(robot: Robot, path: Path, vs: np.ndarray) -> np.ndarray:
    """Accelerations of Pinocchio at points of the space of a robot with a fixed base (count, dof)."""
    pin: Any = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(path))
    data, dof = model.createData(), robot.space.dof
    names = [name.rpartition(".")[0] for name, _ in robot.space.names[:dof]]
    ids = [model.getJointId(name) for name in names]
    damping = np.asarray(model.damping)
    found = []
    for v in vs:
        q, u = pin.neutral(model), np.zeros(model.nv)
        for k, joint in enumerate(ids):
            own = model.joints[joint]
            full = [np.cos(v[k]), np.sin(v[k])] if own.nq == 2 else [v[k]]
            q[own.idx_q : own.idx_q + own.nq], u[own.idx_v] = full, v[dof + k]
        a = pin.aba(model, data, q, u, -damping * u)
        found.append([a[model.joints[joint].idx_v] for joint in ids])
    return np.array(found)


def compared(name: str) -> tuple[Robot, float, np.ndarray, np.ndarray]:
    it = robot(name)
    qs, us, vs = random_states(it, STATES)
    whole = np.zeros((STATES, it.space.size))
    whole[:, : 2 * it.space.dof] = vs
    ours = np.asarray(accelerations(it.space, it.start, jnp.asarray(whole)))
    return it, relative(ours, theirs(it, qs, us)), vs, ours


@pytest.mark.slow
@pytest.mark.parametrize("name", [*GYMNASIUM, *ROBOTS])
def test_accelerations_of_a_robot_are_those_of_mujoco_and_pinocchio(name):
    it, error, vs, ours = compared(name)
    assert error < 1e-9
    if name in ROBOTS:
        pytest.importorskip("pinocchio")
        assert relative(ours, by_pinocchio(it, path_of(name), vs)) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hopper", "half_cheetah"])
def test_a_second_of_motion_is_that_of_mujoco(name):
    assert motion(robot(name)) < 1e-7
