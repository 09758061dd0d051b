"""Robots that ship inside packages (the extra `robots`), in MuJoCo and as systems; the peers' accelerations."""

import importlib
import importlib.metadata
import importlib.util
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.io import scene_from_mujoco

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
            pytest.skip("gymnasium (extra robots) is not installed")
        return Path(spec.origin).parent / "envs" / "mujoco" / "assets" / f"{name}.xml"
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("example-robot-data (extra robots) is not installed")
    return Path(str(next(f for f in files if str(f).endswith(f"robots/{name}")).locate()))


class Loop(NamedTuple):
    """Equality of MuJoCo between two bodies that carry a loop's ends, and where it is."""

    kind: str
    bodies: tuple[str, str]
    # in the first body; the second one's point is there in the posture of the file
    point: tuple[float, float, float] = (0.05, 0.02, 0.1)


class Robot(NamedTuple):
    """A robot in MuJoCo and as a system in the coordinates of its tree, all loops open."""

    mujoco: Any
    model: Any
    scene: stm.Scene
    space: stm.TreeSpace
    start: Any
    loop: Loop | None = None


def bent(mujoco: Any, spec: Any, rng: np.random.Generator) -> None:
    """Turn every only hinge of a body, and say that its angle is now that: the same robot, its
    file's posture another."""
    for body in spec.bodies:
        hinges = [j for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
        if len(hinges) == len(body.joints) == 1:
            (joint,), quaternion = hinges, np.zeros(4)
            assert not np.any(joint.pos)
            joint.ref = rng.uniform(0.6, 1.2) * rng.choice((-1, 1))
            mujoco.mju_axisAngle2Quat(
                quaternion, joint.axis / np.linalg.norm(joint.axis), joint.ref
            )
            mujoco.mju_mulQuat(quaternion, np.array(body.quat), quaternion)
            body.quat = quaternion


def tied(mujoco: Any, spec: Any, loop: Loop) -> None:
    """Add a loop to a specification."""
    weld = loop.kind == "weld"
    tie = spec.add_equality(name="loop", objtype=mujoco.mjtObj.mjOBJ_BODY)
    tie.type = mujoco.mjtEq.mjEQ_WELD if weld else mujoco.mjtEq.mjEQ_CONNECT
    tie.name1, tie.name2 = loop.bodies
    # a weld has its point in the second body, and where none is given the posture of the file
    data = np.zeros(len(tie.data))
    data[:3] = 0.0 if weld else loop.point
    tie.data = data


def robot(name: str, loop: Loop | None = None) -> Robot:
    """Robot of a file; with a loop the file's posture is another, that it is not singular."""
    mujoco: Any = pytest.importorskip("mujoco")
    path = path_of(name)
    importer = importlib.import_module("stmuav_jax.io.mujoco_import")
    spec = importer._without_meshes(mujoco.MjSpec.from_file(str(path)))
    # MuJoCo keeps the inertia of bodies that only slide from when it compiles, armature included
    for joint in spec.joints:
        joint.armature = 0.0
    if loop is not None:
        bent(mujoco, spec, np.random.default_rng(3))
        tied(mujoco, spec, loop)
    model = spec.compile()
    flags = mujoco.mjtDisableBit
    off = [flags.mjDSBL_CONTACT, flags.mjDSBL_LIMIT, flags.mjDSBL_ACTUATION]
    off += [flags.mjDSBL_EQUALITY] * (loop is None)
    model.opt.disableflags |= sum(map(int, off))
    model.opt.density = model.opt.viscosity = 0.0
    model.jnt_limited[:], model.dof_frictionloss[:] = 0, 0.0
    model.tendon_stiffness[:], model.tendon_damping[:] = 0.0, 0.0
    # of floating bases
    for j in np.flatnonzero(model.jnt_type == 0):
        model.dof_damping[model.jnt_dofadr[j] : model.jnt_dofadr[j] + 6] = 0.0
        model.jnt_stiffness[j] = 0.0
    scene = scene_from_mujoco(model, path.stem)
    joints = tuple(joint for joint in scene.system.joints if joint.name != "loop")
    assert len(scene.system.joints) - len(joints) == (loop is not None)
    space = stm.TreeSpace(eqx.tree_at(lambda s: s.joints, scene.system, joints))
    return Robot(mujoco, model, scene, space, space.from_state(scene.state0), loop)


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


def by_pinocchio(robot: Robot, path: Path, vs: np.ndarray) -> np.ndarray:
    """Accelerations of Pinocchio at points of the space of a robot with a fixed base (count, dof).

    A loop is one of its rigid constraints, without a corrector; that it is closed is asserted.
    """
    pin: Any = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(path))
    data, dof = model.createData(), robot.space.dof
    names = [name.rpartition(".")[0] for name, _ in robot.space.names[:dof]]
    ids = [model.getJointId(name) for name in names]
    zero = [robot.model.joint(name).qpos0[0] for name in names]

    def given(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, u = pin.neutral(model), np.zeros(model.nv)
        for k, joint in enumerate(ids):
            own, value = model.joints[joint], v[k] + zero[k]
            full = [np.cos(value), np.sin(value)] if own.nq == 2 else [value]
            q[own.idx_q : own.idx_q + own.nq], u[own.idx_v] = full, v[dof + k]
        return q, u

    damping, found = np.asarray(model.damping), []
    loops, closed = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    if robot.loop is not None:
        pin.forwardKinematics(model, data, given(np.zeros(2 * dof))[0])
        loops.append(rigid(pin, robot, robot.loop, model, data))
        closed.append(loops[0].createData())
        pin.initConstraintDynamics(model, data, loops, closed)
    for v in vs:
        q, u = given(v)
        if robot.loop is None:
            a = pin.aba(model, data, q, u, -damping * u)
        else:
            # no regularisation
            exactly = pin.ProximalSettings(1e-14, 0.0, 1)
            a = pin.constraintDynamics(model, data, q, u, -damping * u, loops, closed, exactly)
            error, speed = closed[0].c1Mc2, closed[0].contact_velocity_error
            turned = robot.loop.kind == "weld"
            assert np.abs(pin.log6(error).vector if turned else error.translation).max() < 1e-11
            assert np.abs(speed.vector if turned else speed.linear).max() < 1e-11
        found.append([a[model.joints[joint].idx_v] for joint in ids])
    return np.array(found)


def rigid(pin: Any, robot: Robot, loop: Loop, model: Any, data: Any) -> Any:
    """Constraint of Pinocchio that holds the loop's ends as they are in the posture of its data."""
    kinds = {"connect": pin.ContactType.CONTACT_3D, "weld": pin.ContactType.CONTACT_6D}
    first, second = (
        0
        if name == "world"
        else model.getJointId(robot.model.joint(robot.model.body(name).jntadr[0]).name)
        for name in loop.bodies
    )
    here = pin.SE3(np.eye(3), np.array(loop.point))
    there = data.oMi[second].actInv(data.oMi[first].act(here))
    kind, frame = kinds[loop.kind], pin.ReferenceFrame.LOCAL
    return pin.RigidConstraintModel(kind, model, first, here, second, there, frame)


def ends(robot: Robot, loop: Loop, data: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance of the loop's ends (3,) [m], the rows of their velocities and the rows' rates (n, dof).

    Rows of a weld are those of the angular velocities too.
    """
    model, mujoco, at = robot.model, robot.mujoco, robot.model.eq_data[0]
    # the data of a weld begin with its point on the second body
    points = (at[3:6], at[:3]) if loop.kind == "weld" else (at[:3], at[3:6])
    places, rows = [], np.zeros((2, 2, 6, model.nv))
    for k, (name, point) in enumerate(zip(loop.bodies, points, strict=True)):
        b = model.body(name).id
        places.append(data.xpos[b] + data.xmat[b].reshape(3, 3) @ point)
        for found, read in zip(rows[k], (mujoco.mj_jac, mujoco.mj_jacDot), strict=True):
            read(model, data, found[:3], found[3:], places[-1], b)
    J, J_rate = (rows[0] - rows[1])[:, : 6 if loop.kind == "weld" else 3]
    return places[0] - places[1], J, J_rate


def by_mujocos_matrices(robot: Robot, vs: np.ndarray) -> np.ndarray:
    """Accelerations at points of the space of a robot with a fixed base and a loop (count, dof).

    Its own loops are soft; the exact ones follow from its mass matrix, bias and Jacobians. Rows that
    depend on each other are met together.
    """
    loop, at, dof = robot.loop, places(robot), robot.space.dof
    assert loop is not None
    model, mujoco = robot.model, robot.mujoco
    data, M, found = mujoco.MjData(model), np.zeros((model.nv, model.nv)), []
    for v in vs:
        data.qpos[:], data.qvel[:] = model.qpos0 + v[:dof][at], v[dof:][at]
        mujoco.mj_forward(model, data)
        off, J, J_rate = ends(robot, loop, data)
        assert np.abs(off).max() < 1e-11
        assert np.abs(J @ data.qvel).max() < 1e-11
        mujoco.mj_fullM(model, data, M)
        free = np.linalg.solve(M, data.qfrc_passive - data.qfrc_bias)
        metric, wanted = J @ np.linalg.solve(M, J.T), -J_rate @ data.qvel - J @ free
        pull = np.linalg.lstsq(metric, wanted, rcond=1e-12)[0]
        a = np.zeros(dof)
        a[at] = free + np.linalg.solve(M, J.T @ pull)
        found.append(a)
    return np.array(found)
