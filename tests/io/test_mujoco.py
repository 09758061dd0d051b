"""Models of MuJoCo: accelerations of trees and loops as MuJoCo has them, and what is left out."""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import evaluated
from parallel_robots import three_rps

import stmuav_jax as stm
from stmuav_jax.cli.main import main
from stmuav_jax.dynamics import evaluate
from stmuav_jax.dynamics.simulation import Scene
from stmuav_jax.io import FileError, load_model, load_robot, save_mjcf, scene_from_mujoco
from stmuav_jax.mechanics import inputs_of, with_inputs

MODELS = Path(__file__).parents[2] / "docs" / "models"
SHAPE = '<geom type="box" size=".1 .05 .2" pos=".03 .02 .1" euler="10 20 30" mass="{}"/>'

# Several joints of one body, a ball, a part without joints, references, springs, dampers, actuators.
TREE = f"""<mujoco><option gravity="1 0 -9"><flag contact="disable"/></option><worldbody>
<body name="arm" pos=".1 .2 .3" euler="20 0 40">{SHAPE.format(2)}
  <joint name="a" axis="0 1 .2" pos="0 0 -.1" ref="30" stiffness="3" springref="50" damping=".2"/>
  <joint name="b" type="slide" axis="1 0 1" ref=".1" stiffness="40" springref=".3" damping="2"/>
  <joint name="c" axis="1 0 0" pos="0 .1 0" damping=".1"/>
  <body name="fixed" pos="0 .1 .2" euler="0 50 0">{SHAPE.format(0.5)}
    <body name="hand" pos="0 .1 .2" quat="1 2 3 4">{SHAPE.format(1)}
      <joint name="d" type="ball" damping=".05"/></body></body></body>
</worldbody><actuator>
  <motor name="push" joint="b" gear="3"/>
  <position name="hold" joint="a" kp="7" kv=".3" gear="2"/>
  <velocity name="brake" joint="c" kv=".4"/>
  <intvelocity name="odd" joint="c" kp="1" actrange="-1 1"/></actuator></mujoco>"""

LOOPS = f"""<mujoco><worldbody><body pos="0 0 1">{SHAPE.format(1)}
  <joint name="a" axis="0 1 0"/>
  <body pos=".4 0 0">{SHAPE.format(2)}<joint name="b" type="ball"/>
    <body name="end" pos=".3 0 .1">{SHAPE.format(3)}<joint name="c" axis="1 2 0"/></body></body>
</body><body pos="0 2 1">{SHAPE.format(1)}
  <joint name="e" axis="0 1 0"/>
  <body name="mid" pos=".4 0 0">{SHAPE.format(2)}<joint name="f" type="ball"/>
    <body name="tip" pos=".3 0 .1">{SHAPE.format(3)}<joint name="g" type="ball"/></body></body>
</body></worldbody><equality>
  <connect name="hung" body1="end" anchor=".1 .2 .3"/>
  <weld name="a" body1="tip" anchor=".1 0 0"/></equality></mujoco>"""


# one program for all states and values of a structure
accelerations = eqx.filter_jit(
    lambda system, state: evaluate(system, state, formulation=stm.Tree()).accelerations
)


@pytest.fixture(scope="module")
def tree() -> Scene:
    mujoco = pytest.importorskip("mujoco")
    return scene_from_mujoco(mujoco.MjModel.from_xml_string(TREE))


@pytest.fixture
def mujoco(tmp_path, monkeypatch) -> Any:
    # it writes its log into the present folder
    monkeypatch.chdir(tmp_path)
    return pytest.importorskip("mujoco")


def state_at(model, data, system):
    """State with the joint coordinates and rates of MuJoCo's."""
    from scipy.spatial.transform import Rotation

    q, u = {}, {}
    for j in range(model.njnt):
        name, a, d = model.joint(j).name, model.jnt_qposadr[j], model.jnt_dofadr[j]
        if model.jnt_type[j] == 1:
            turn = Rotation.from_quat(data.qpos[a : a + 4], scalar_first=True)
            q[name], u[name] = turn.as_rotvec(), turn.apply(data.qvel[d : d + 3])
        else:
            q[name], u[name] = data.qpos[a] - model.qpos0[a], data.qvel[d]
    return stm.state_from_joints(system, q, u)


def compare(mujoco, model, data, system, found):
    """Compare accelerations of the bodies with those of MuJoCo's data.qacc."""
    mujoco.mj_rnePostConstraint(model, data)
    six, kind = np.zeros(6), mujoco.mjtObj.mjOBJ_BODY
    for name in ("hand", "end", "mid", "tip"):
        if name in system.names:
            b, k = model.body(name).id, system.index(name)
            mujoco.mj_objectAcceleration(model, data, kind, b, six, 0)
            R = data.xmat[b].reshape(3, 3)
            wanted = np.array([six[3:] + model.opt.gravity, R.T @ six[:3]])
            given = np.array([found.v_rate[k], found.omega_rate[k]])
            # all accelerations here are of the order of one to a hundred
            np.testing.assert_allclose(given, wanted, rtol=1e-9, atol=1e-9)
            assert name == "tip" or np.abs(wanted).max() > 1


def test_a_wound_spring_pulls_as_in_mujoco(mujoco):
    """A hinge turned by 10 rad against a spring with its free angle at -7 rad."""
    text = f"""<mujoco><compiler angle="radian"/><worldbody><body>{SHAPE.format(1)}
      <joint name="a" axis="0 1 0" stiffness="3" springref="-7"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:] = 10.0
    mujoco.mj_forward(model, data)
    scene = scene_from_mujoco(model)
    assert not any("spring" in note for note in scene.notes)
    system = stm.mechanics.with_start_angles(scene.system, {"a": 10.0})
    state = stm.state_from_joints(system, {"a": 10.0})
    spring = next(f for f in system.forces if isinstance(f, stm.TorsionalSpringDamper))
    moment = spring.load(jnp.zeros(()), system.kinematics(state)).moment[0, 1]
    assert float(moment) == pytest.approx(data.qfrc_passive[0], rel=1e-12)
    assert data.qfrc_passive[0] == pytest.approx(-51.0)


@pytest.mark.slow
def test_a_tree_moves_as_in_mujoco(mujoco, tree):
    model, scene = mujoco.MjModel.from_xml_string(TREE), tree
    assert scene.system.names == ("arm_link_1", "arm_link_2", "arm", "hand")
    assert scene.notes == (
        "The input effort_b [N] is 3 times the control of the actuator 'push'.",
        "The input target_a [rad] is 0.5 times the control of the actuator 'hold' - 0.523598776.",
        "The input effort_c [N m] is 0.4 times the control of the actuator 'brake'.",
        "Left out, actuators: odd.",
    )
    # what was left out acts in MuJoCo
    model.actuator_gainprm[3] = model.actuator_biasprm[3] = 0
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    for _ in range(3):
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.7)
        data.qvel[:], data.ctrl[:3] = rng.normal(size=model.nv), rng.normal(size=3)
        mujoco.mj_forward(model, data)
        push, hold, brake = data.ctrl[:3]
        given = {"effort_b": 3 * push, "target_a": hold / 2 - np.pi / 6, "effort_c": 0.4 * brake}
        system = with_inputs(scene.system, given)
        compare(mujoco, model, data, system, accelerations(system, state_at(model, data, system)))


def closing(mujoco, model, data):
    """Residual, rows and their rates of the loops of LOOPS, from MuJoCo's Jacobians."""
    parts = []
    for k, name in ((0, "end"), (1, "tip")):
        b, at = model.body(name).id, model.eq_data[k]
        # the data of a weld begin with its point on the second body
        here, there = (at[3:6], at[:3]) if k else (at[:3], at[3:6])
        point = data.xpos[b] + data.xmat[b].reshape(3, 3) @ here
        J, J_rate = np.zeros((2, 3, model.nv)), np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, J[0], J[1], point, b)
        mujoco.mj_jacDot(model, data, J_rate[0], J_rate[1], point, b)
        turned = np.zeros(3)
        if k == 1:
            # they hold the orientation of the world in the tip
            mujoco.mju_subQuat(turned, data.xquat[b], at[6:10] * [1, -1, -1, -1])
            turned = data.xmat[b].reshape(3, 3) @ turned
        parts.append((point - there, J[0], J_rate[0]))
        parts += [(turned, J[1], J_rate[1])] * k
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


@pytest.mark.slow
def test_loops_move_as_by_mujocos_matrices(mujoco):
    """Its own loops are soft; the exact ones follow from its mass matrix, bias and Jacobians."""
    model = mujoco.MjModel.from_xml_string(LOOPS)
    scene = scene_from_mujoco(model)
    assert [joint.kind for joint in scene.system.joints[-2:]] == ["spherical", "weld"]
    tree = eqx.tree_at(lambda s: s.joints, scene.system, scene.system.joints[:-2])
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.1)
    for _ in range(8):
        mujoco.mj_fwdPosition(model, data)
        off, J, _ = closing(mujoco, model, data)
        mujoco.mj_integratePos(model, data.qpos, -np.linalg.pinv(J) @ off, 1.0)
    mujoco.mj_fwdPosition(model, data)
    _, J, _ = closing(mujoco, model, data)
    data.qvel[:] = 3 * rng.normal(size=model.nv)
    data.qvel[:] -= np.linalg.pinv(J) @ J @ data.qvel
    mujoco.mj_forward(model, data)
    off, J, J_rate = closing(mujoco, model, data)
    assert np.abs(off).max() < 1e-12
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    free = np.linalg.solve(M, -data.qfrc_bias)
    gamma = -J_rate @ data.qvel
    pull = np.linalg.solve(J @ np.linalg.solve(M, J.T), gamma - J @ free)
    data.qacc[:] = free + np.linalg.solve(M, J.T @ pull)
    found = evaluated(scene.system, state_at(model, data, tree)).accelerations
    compare(mujoco, model, data, scene.system, found)


URDF = """<robot name="r"><link name="base"/>
<link name="post"><inertial><origin xyz="0 0 .1"/><mass value="2"/>
  <inertia ixx=".1" iyy=".1" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><geometry><mesh filename="package://none/post.dae"/></geometry></visual>
  <collision><geometry><mesh filename="package://none/post.stl"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="post"/><origin xyz="0 0 1"/>
  <axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
  <dynamics damping=".3" friction=".1"/></joint></robot>"""
MIMIC = """<link name="dial"><inertial><mass value="1"/>
  <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="g" type="continuous"><parent link="base"/><child link="dial"/><axis xyz="0 1 0"/>
  <mimic joint="turn" multiplier="2"/></joint></robot>"""


@pytest.mark.slow
def test_a_urdf_without_its_meshes_is_checked_by_the_command_line(mujoco, tmp_path, capsys):
    path = tmp_path / "r.urdf"
    path.write_text(URDF)
    system = load_robot(path).system
    assert [(joint.name, joint.kind) for joint in system.joints] == [("turn", "revolute")]
    np.testing.assert_allclose(system.reference.r, [[0, 0, 1.1]])
    damping: Any = system.forces[1]
    assert float(damping.turning) == 0.3
    path.write_text(URDF.replace("</robot>", MIMIC))
    assert main(["check", str(path), "--no-cache"]) == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Left out, limits of joints: turn." in shown
    assert "Left out, dry friction in joints: turn." in shown
    assert "degrees of freedom" in shown


@pytest.mark.parametrize(
    "what",
    [
        "cart_pole",
        pytest.param("tree", marks=pytest.mark.slow),
        pytest.param("loops", marks=pytest.mark.slow),
    ],
)
def test_what_is_saved_moves_alike_when_it_is_loaded(mujoco, tmp_path, what, tree):
    scene = tree
    if what == "cart_pole":
        scene = load_model(MODELS / "cart_pole.toml")
    if what == "loops":
        scene = scene_from_mujoco(mujoco.MjModel.from_xml_string(LOOPS))
    path = tmp_path / "saved.xml"
    left_out = save_mjcf(scene, path)
    system, other = scene.system, load_robot(path).system
    # a body that is welded to ground is a part of it
    gone = {"a_loop"} if what == "loops" else set()
    assert {joint.name for joint in other.joints} == {j.name for j in system.joints} - gone
    mine, theirs = (
        [k for k, name in enumerate(one.names) if name in two.names]
        for one, two in ((system, other), (other, system))
    )
    theirs.sort(key=lambda k: system.index(other.names[k]))
    state, inputs = scene.state0, inputs_of(system)
    if what == "tree":
        rng = np.random.default_rng(3)
        shape = lambda joint: 3 if joint.kind == "spherical" else ()
        q = {joint.name: rng.normal(size=shape(joint)) for joint in system.joints}
        state = stm.state_from_joints(system, q, q)
    values = {e.name: float(x) for e, x in zip(inputs.entries, inputs.values(system), strict=True)}
    assert left_out == ()
    if any(values.values()):
        keys = mujoco.MjModel.from_xml_path(str(path)).key_ctrl
        np.testing.assert_array_equal(keys, [list(values.values())])
    other = with_inputs(other, values)
    moved = jax.tree.map(
        lambda x, y: x.at[np.array(theirs)].set(y[np.array(mine)]), other.reference, state
    )
    rows = lambda each, k: (np.asarray(each.v_rate)[k], np.asarray(each.omega_rate)[k])
    found, again = (
        rows(accelerations(system, state), mine),
        rows(accelerations(other, moved), theirs),
    )
    assert np.abs(found[0]).max() > 1
    np.testing.assert_allclose(again[0], found[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again[1], found[1], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_what_the_import_made_is_not_held_against_the_user(mujoco, tmp_path):
    """Its links of nearly no mass are a note; a mass that the user wrote so is a warning."""
    text = f"""<mujoco><worldbody><body name="arm">{SHAPE.format(2.5)}<joint axis="0 1 0"/>
      <joint axis="1 0 0"/></body></worldbody></mujoco>"""
    scene = scene_from_mujoco(mujoco.MjModel.from_xml_string(text))
    assert scene.links_between == ("arm_link_1",)
    by_name = {each.quantity: each for each in stm.check(scene).findings}
    assert by_name["links between several joints of a body"].severity == "note"
    assert by_name["links between several joints of a body"].value == "1, of at most 2.5e-12 kg"
    assert "ratio of masses" not in by_name
    # the mark is kept in the file of the model
    path = stm.io.save_model(dataclasses.replace(scene, notes=()), tmp_path / "arm.toml")
    assert "format = 2" in path.read_text()
    assert load_model(path).links_between == scene.links_between
    plain = dataclasses.replace(scene, links_between=())
    by_name = {each.quantity: each for each in stm.check(plain).findings}
    assert by_name["ratio of masses"].severity == "warning"


def test_limits_of_efforts_come_back_and_cut_off_as_here(mujoco, tmp_path):
    """Beyond their limits servo and motor give what MuJoCo's actuators give."""
    bodies = [
        stm.Body(n, 1.0, [0.1, 0.1, 0.1], position=[k, 0.0, 0.0], com=[0.0, 0.0, -0.3])
        for k, n in enumerate("ab")
    ]
    joints = [
        stm.revolute("A", "ground", "a", point=[0, 0, 0], axis=[0, 1, 0]),
        stm.revolute("B", "ground", "b", point=[1, 0, 0], axis=[0, 1, 0]),
    ]
    servo = stm.mechanics.JointServo("A", stiffness=50.0, damping=2.0, target=0.0, limit=1.5)
    system = stm.System(
        bodies, joints, [stm.Gravity(), servo, stm.JointEffort("B", 0.0, limit=0.7)]
    )
    state = stm.state_from_joints(system, {"A": 0.4, "B": 0.2}, {"A": 1.0})
    assert save_mjcf(Scene("two", "", system, system.reference), tmp_path / "two.xml") == ()
    again = load_robot(tmp_path / "two.xml")
    forces: Any = again.system.forces
    assert {type(f).__name__: float(f.limit) for f in forces if hasattr(f, "limit")} == {
        "JointServo": 1.5, "JointEffort": 0.7,
    }  # fmt: skip
    assert not any("limits of actuators" in note for note in again.notes)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "two.xml"))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = [0.4, 0.2], [1.0, 0.0], [0.0, 2.0]
    mujoco.mj_forward(model, data)
    pushed = with_inputs(system, {"effort": 2.0})
    found = np.asarray(evaluated(pushed, state).accelerations.omega_rate)[:, 1]
    np.testing.assert_allclose(found, data.qacc, rtol=1e-9)
    assert data.actuator_force.tolist() == [-1.5, 0.7]


def test_rotors_are_actuators_at_sites(mujoco, tmp_path):
    """Accelerations of MuJoCo at the start's controls; read again, the same rotors on the first body."""
    bodies = [
        stm.Body("frame", 3.2, [0.055, 0.055, 0.1], free=True),
        stm.Body("yoke", 0.15, [3e-4, 3e-4, 2e-4], position=[0, 0, -0.08]),
        stm.Body("camera", 0.45, [6e-4, 5e-4, 6e-4], position=[0, 0, -0.14], com=[0.01, 0, 0]),
    ]
    # two joints at the yoke, which would be the base of the tree
    joints = [
        stm.revolute("roll", "frame", "yoke", point=[0, 0, -0.08], axis=[1, 0, 0]),
        stm.revolute("pitch", "yoke", "camera", point=[0, 0, -0.14], axis=[0, 1, 0]),
    ]
    arms, spin = stm.uav.rotor_layout(4, 0.35, height=0.03)
    u = 1e5 * np.array([9.0, 10.0, 11.0, 12.5])
    make_rotors = lambda **curves: stm.uav.Rotors(
        "frame", arms=arms, spin=spin, k_f=8.5e-6, k_tau=1.4e-7, speed_squared=u, **curves
    )
    limits = stm.uav.RotorLimits(150.0, 1400.0)
    motors = stm.uav.MotorRotors(make_rotors(), time_constant=0.03, inertia=1e-5, limits=limits)
    forces = [stm.Gravity(), motors, stm.JointEffort("pitch", 0.02)]
    system = stm.System(bodies, joints, forces)
    path = tmp_path / "quadrotor.xml"
    left_out = save_mjcf(Scene("four", "", system, system.reference), path)
    assert left_out == ("Left out, lag and inertia of the motors of rotors: frame.",)

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    found = evaluated(system, system.reference).accelerations
    np.testing.assert_allclose(data.qacc[:3], found.v_rate[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(data.qacc[3:6], found.omega_rate[0], rtol=1e-9, atol=1e-9)

    again = load_robot(path)
    assert again.system.names[0] == "frame"
    read: Any = again.system.forces[-1]
    for name in ("arms", "spin", "k_f", "k_tau"):
        np.testing.assert_array_equal(getattr(read.rotors, name), getattr(motors.rotors, name))
    assert np.asarray(read.limits) == pytest.approx(np.asarray(motors.limits))
    hover = motors.rotors.hover(3.8, [0.0, 0.0, -9.81])
    np.testing.assert_allclose(read.rotors.speed_squared, hover, rtol=1e-12)
    assert not any("limits of actuators" in note for note in again.notes)

    forces = (stm.Gravity(), make_rotors(thrust_linear=1e-3))
    curved = dataclasses.replace(system, forces=forces)
    assert save_mjcf(Scene("four", "", curved, curved.reference), path) == (
        "Left out, rotors whose thrust or torque is not proportional to the squared speed: frame.",
    )


@pytest.mark.slow
def test_a_start_is_a_keyframe(mujoco, tmp_path, tree):
    """Positions and velocities of MuJoCo's bodies at the keyframe are those of the start."""
    rest = with_inputs(tree.system, {"target_a": 0.0, "target_b": 0.0})
    save_mjcf(dataclasses.replace(tree, system=rest), tmp_path / "rest.xml")
    assert "keyframe" not in (tmp_path / "rest.xml").read_text()
    rng, scene = np.random.default_rng(5), tree
    free = stm.Body("free", 1.0, np.diag([1.0, 1.1, 1.2]), com=[0.1, 0, 0], free=True)
    fork = stm.Body("fork", 1.0, np.diag([1.0, 1.1, 1.2]), position=[0.3, 0.1, 0.0])
    tip = stm.Body("tip", 1.0, np.diag([1.0, 1.1, 1.2]), position=[0.3, 0.4, 0.2])
    # one of them led from the child to its parent
    joints = [
        stm.universal("u", "fork", "ground", point=[0.2, 0, 0], axis_i=[1, 0, 0], axis_j=[0, 1, 0]),
        stm.cylindrical("c", "fork", "tip", point=[0.2, 0.2, 0.1], axis=[0.0, 0.6, 0.8]),
    ]
    own = stm.System([free, fork, tip], joints, [stm.Gravity()])
    start = stm.state_from_joints(
        own, {"u": [0.3, -0.5], "c": [0.2, 0.7]}, {"u": [0.4, 0.1], "c": [1.0, -2.0]}
    )
    p = rng.normal(size=4)
    start = dataclasses.replace(
        start,
        r=start.r.at[0].set(rng.normal(size=3)),
        p=start.p.at[0].set(p / np.linalg.norm(p)),
        v=start.v.at[0].set(rng.normal(size=3)),
        omega=start.omega.at[0].set(rng.normal(size=3)),
    )
    shape = lambda joint: 3 if joint.kind == "spherical" else ()
    q = {joint.name: rng.normal(size=shape(joint)) for joint in scene.system.joints}
    moved = dataclasses.replace(scene, state0=stm.state_from_joints(scene.system, q, q))
    for case in (moved, stm.Scene("own", "", own, start)):
        save_mjcf(case, tmp_path / "moved.xml")
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "moved.xml"))
        data, state, six = mujoco.MjData(model), case.state0, np.zeros(6)
        mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
        mujoco.mj_forward(model, data)
        for k, name in enumerate(case.system.names):
            b = model.body(name).id
            np.testing.assert_allclose(data.xipos[b], state.r[k], atol=1e-12)
            R = np.asarray(stm.rotation.rotation_matrix(state.p[k]))
            np.testing.assert_allclose(data.xmat[b].reshape(3, 3), R, atol=1e-12)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, six, 0)
            np.testing.assert_allclose(six[3:], state.v[k], atol=1e-12)
            np.testing.assert_allclose(R.T @ six[:3], state.omega[k], atol=1e-12)


def test_a_spring_is_a_tendon_and_a_hinge_in_a_loop_two_points(mujoco, tmp_path):
    """A four-bar linkage with a spring, by MuJoCo's rows and its forces at qpos0."""
    scene = load_model(MODELS / "four_bar.toml")
    ends = {"point_i": (-1.0, 0.1, 0.3), "point_j": (0.2, 0.0, 0.1)}
    spring = stm.LinearSpringDamper(
        "ground", "crank", **ends, stiffness=50.0, damping=2.0, length=0.3
    )
    system = eqx.tree_at(lambda s: s.forces, scene.system, (*scene.system.forces, spring))
    scene = dataclasses.replace(scene, system=system, state0=system.reference)
    assert save_mjcf(scene, tmp_path / "saved.xml") == ()
    model = mujoco.MjModel.from_xml_path("saved.xml")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos[:6], np.zeros(6), atol=1e-12)
    J = data.efc_J.reshape(-1, model.nv)[:6]
    assert np.linalg.matrix_rank(J) == 2
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    free = np.linalg.solve(M, data.qfrc_passive - data.qfrc_bias)
    # at rest the rows hold the accelerations themselves
    pull = np.linalg.pinv(J @ np.linalg.solve(M, J.T), rcond=1e-9) @ (J @ free)
    wanted = (free - np.linalg.solve(M, J.T @ pull))[model.joint("A").dofadr[0]]
    found = evaluated(system, system.reference, formulation=stm.Tree(redundant=True)).accelerations
    # the crank turns about -y
    assert -found.omega_rate[0, 1] == pytest.approx(wanted, rel=1e-9)
    assert abs(wanted) > 1


def check_fall(mujoco, scene, path, *, least):
    """Compare places after a fall of 0.3 s, by the file alone, with those of a run here."""
    system = scene.system
    end = np.asarray(stm.simulate(scene).states.r)[-1]
    assert save_mjcf(scene, path) == ()
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    assert model.opt.timestep == 1e-4
    mujoco.mj_step(model, data, 3000)
    mujoco.mj_forward(model, data)
    assert np.abs(end - np.asarray(system.reference.r)).max() > least
    places = np.array([data.xipos[model.body(name).id] for name in system.names])
    # MuJoCo's own step leaves 2e-9 m
    np.testing.assert_allclose(places, end, atol=1e-7)


def test_joints_without_a_counterpart_are_refused(tmp_path):
    scene = load_model(MODELS / "stewart_platform.toml")
    with pytest.raises(
        stm.SettingError, match="joint 'leg_1', a distance joint that closes a loop"
    ):
        save_mjcf(scene, tmp_path / "never.xml")
    assert not list(tmp_path.iterdir())


def test_files_that_cannot_be_read_are_named(mujoco, tmp_path):
    path = tmp_path / "odd.xml"
    with pytest.raises(FileError, match=r"There is no file .*odd.xml"):
        load_robot(path)
    path.write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(FileError, match=r"odd.xml: MuJoCo cannot read it: .*mass and inertia"):
        load_robot(path)
    path.write_text("<mujoco/>")
    with pytest.raises(FileError, match=r"odd.xml: The model has no body that can move"):
        load_robot(path)


def test_warnings_of_mujoco_reach_the_user_and_no_log(mujoco, tmp_path, capfd):
    """A NaN is refused, for which MuJoCo takes a default; it leaves no MUJOCO_LOG.TXT and prints nothing."""
    path = tmp_path / "odd.xml"
    path.write_text(TREE.replace('mass="2"', 'mass="nan"'))
    with pytest.raises(FileError, match=r"odd\.xml: a number is NaN"):
        load_robot(path)
    # what is no file for MuJoCo either is not said to be missing
    device = tmp_path / "device.xml"
    device.symlink_to("/dev/zero")
    with pytest.raises(FileError, match=r"device\.xml is no file but a folder, a pipe or a device"):
        load_robot(device)
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    assert capfd.readouterr() == ("", "")


def test_a_gear_whose_square_is_not_finite_is_named(mujoco, tmp_path):
    path = tmp_path / "odd.xml"
    path.write_text(TREE.replace('gear="3"', 'gear="1e308"'))
    with pytest.raises(FileError, match=r"odd.xml: The actuator 'push' has the gear 1e\+308"):
        load_robot(path)


def test_a_place_that_overflows_is_refused(mujoco, tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(URDF.replace("0 0 .1", "1e308 0 .1"))
    with pytest.raises(FileError, match=r"r.urdf: .*'post'.* finite"):
        load_robot(path)


def test_without_mujoco_its_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert main(["check", "robot.xml", "--no-cache"]) == 2
    assert "pip install '.[exchange]' in a checkout" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_a_parallel_robot_moves_in_mujoco_as_here_without_options(mujoco, tmp_path):
    """3-RPS that falls for 0.3 s, by the file alone; soft loops of MuJoCo's defaults are 3e-4 m off."""
    system = three_rps(0.45)
    scene = Scene("rps", "3-RPS", system, system.reference, t1=0.3, save_every=0.3)
    check_fall(mujoco, scene, tmp_path / "rps.xml", least=0.1)


@pytest.mark.slow
def test_coupled_joints_move_in_mujoco_as_here(mujoco, tmp_path):
    """A geared arm and a rack fall for 0.3 s, by the file alone; read again they are the same couplings."""
    bodies = [
        stm.Body("upper", 1.0, [0.01, 0.01, 0.002], com=[0.0, 0.0, -0.2]),
        stm.Body("lower", 0.7, [0.01, 0.01, 0.002], position=[0, 0, -0.4], com=[0.1, 0.0, -0.1]),
        stm.Body("rack", 0.5, [0.01, 0.01, 0.002], position=[0.5, 0, 0]),
    ]
    first = stm.revolute("A", "ground", "upper", point=[0, 0, 0], axis=[0, 1, 0])
    # the tree passes this one from its second body to its first
    second = stm.revolute("B", "lower", "upper", point=[0, 0, -0.4], axis=[0, 1, 0])
    slide = stm.translational("C", "ground", "rack", point=[0.5, 0, 0], axis=[0.6, 0, 0.8])
    gear = stm.mimic("gear", second, first, ratio=-1.5)
    rack = stm.mimic("track", slide, first, ratio=0.05)
    system = stm.System(bodies, [first, second, slide, gear, rack], [stm.Gravity()])
    scene = Scene("geared", "geared", system, system.reference, t1=0.3, save_every=0.3)
    check_fall(mujoco, scene, tmp_path / "geared.xml", least=0.05)
    again = load_robot(tmp_path / "geared.xml").system
    numbers = {joint.name: float(joint.mate.ratio) for joint in again.joints if joint.mate}
    assert numbers == {"gear": -1.5, "track": 0.05}
