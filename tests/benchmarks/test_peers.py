"""Every competing program solves the same problem as we do: accelerations and motion.

Programs that are not installed are skipped. The C++ program is tested once it has been
compiled (two minutes, at its first use), MJX's motion among the slow tests.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense.system import Dense
from helpers import evaluated
from peers import (
    PEERS,
    HeyokaTaylor,
    MujocoC,
    MujocoMjx,
    PinocchioCpp,
    exudyn_peer,
    heyoka_taylor,
    mujoco_c,
    pinocchio_cpp,
    pinocchio_python,
)
from peers.adapter import Setting
from problems import compared
from problems.plain import start
from problems.tree import coordinates, span

import stmuav_jax as stm

TIMES = np.array([0.02, 0.04])

# Solver and its setting in runs of the UAV.
SETTINGS = {
    "PinocchioCpp": Setting("rkf78", tolerance=1e-10),
    "MujocoC": Setting("RK4", step=1e-4),
    "MujocoMjx": Setting("RK4", step=1e-3),
    "HeyokaTaylor": Setting("taylor", tolerance=1e-12),
}
# peers whose models take long to compile
SLOW = ("MujocoMjx", "HeyokaTaylor")


def of_pinocchio_cpp(scene):
    program, _ = pinocchio_cpp.compile_program()
    words = pinocchio_cpp.Texts(scene).call(program, "cost", 1)
    return np.reshape(words["accelerations"][0], (-1, 3))


def of_pinocchio(scene):
    dynamics = pinocchio_python.Dynamics(scene)
    pin, model, data = dynamics.pin, dynamics.model, dynamics.data
    a = dynamics.acceleration(scene.t0, dynamics.q0, dynamics.v0)
    pin.forwardKinematics(model, data, dynamics.q0, dynamics.v0, a)
    result = []
    for k, x in dynamics.links.bodies:
        w = data.v[k + 1].angular
        origin = pin.getClassicalAcceleration(model, data, k + 1, pin.LOCAL).linear
        local = origin + np.cross(data.a[k + 1].angular, x) + np.cross(w, np.cross(w, x))
        result.append(data.oMi[k + 1].rotation @ local)
    return np.stack(result)


def of_dense(scene):
    dense = Dense(scene)
    return dense.accelerations(scene.t0, dense.start(scene))[:, :3]


def of_mujoco(scene):
    world = mujoco_c.World(scene, 1e-5)
    world.begin(start(scene))
    mujoco, model, data = world.mujoco, world.model, world.data
    # forces at the very start, not their mean over the first step
    waves = [np.sin(s.rate * scene.t0 + s.phase) for s in world.waves()]
    data.ctrl[:] = [1.0] * world.constant + waves
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    result, six = [], np.empty(6)
    for body in world.order:
        mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, body, six, 0)
        result.append(six[3:] + world.links.gravity)
    return np.stack(result)


def of_exudyn(scene):
    mechanism = exudyn_peer.Mechanism(scene)
    sensors = mechanism.sense(mechanism.exu.OutputVariableType.Acceleration)
    mechanism.mbs.Assemble()
    step = 1e-6
    mechanism.solve(mechanism.settings(scene.t0, scene.t0 + step, 1, step))
    return mechanism.stored(sensors)[:, 0, 1:]


def of_heyoka(scene):
    equations = heyoka_taylor.Equations(scene)
    variables, rates = zip(*equations.system(), strict=True)
    a = np.array(rates[-equations.first[-1] :])
    points = []
    for k, x in equations.links.bodies:
        columns = equations.motions[k].jacobians(x).items()
        points += list(
            sum((moved * a[i] for i, (moved, _) in columns), equations.motions[k].point_bias(x))
        )
    program = equations.hy.cfunc(points, variables, compact_mode=True)
    return program(equations.start(start(scene)), time=scene.t0).reshape(-1, 3)


# Each program's accelerations of the centres of mass at the start, world (n, 3) [m/s^2].
ACCELERATIONS = {
    "PinocchioCpp": of_pinocchio_cpp, "PinocchioPython": of_pinocchio, "ScipyDense": of_dense,
    "MujocoC": of_mujoco, "ExudynPeer": of_exudyn, "HeyokaTaylor": of_heyoka,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    return stm.make_scene("uav_tracker", 2)


def ready(peer):
    """A peer, or a skipped test."""
    one = peer()
    if reason := one.missing():
        pytest.skip(reason)
    if peer is PinocchioCpp and not pinocchio_cpp.program_path().exists():
        pytest.skip("The C++ program is not compiled yet: benchmarks/peers/pinocchio_cpp.py.")
    return one


def some(peers=PEERS):
    """Peers as parameters; those that are slow only with -m slow."""
    return [
        pytest.param(p, id=p.__name__, marks=[pytest.mark.slow] if p.__name__ in SLOW else [])
        for p in peers
    ]


TOLD = [p for p in PEERS if p.__name__ != "MujocoMjx"]


def test_every_peer_has_settings_from_coarse_to_fine_and_tells_how_it_is_run():
    for peer in (p() for p in PEERS):
        assert peer.how.endswith(".")
        for solver in {s.solver for s in peer.settings()}:
            size = [s.tolerance or s.step or 0.0 for s in peer.settings() if s.solver == solver]
            assert size == sorted(size, reverse=True)


@pytest.mark.slow
def test_motion_of_mjx(scene):
    """The others' motion is compared below, for more joints and forces."""
    outcome = ready(MujocoMjx).prepare(scene, TIMES, SETTINGS["MujocoMjx"]).run()
    method = stm.Method(rtol=1e-12, atol=1e-12)
    ours = np.asarray(stm.simulate(scene, method=method, ts=[0.0, *TIMES]).states.r)[1:]
    assert outcome.failure == ""
    assert np.abs(outcome.positions - ours).max() <= 1e-3
    if outcome.residual is not None:
        assert outcome.residual <= 1e-3


@pytest.mark.parametrize("peer", some(TOLD))
def test_scene_without_joints(peer):
    scene = stm.make_scene("hexacopter")
    one, expected = (
        ready(peer),
        evaluated(scene.system, scene.state0).accelerations.v_rate,
    )
    assert one.unsupported(scene) == ""
    np.testing.assert_allclose(ACCELERATIONS[peer.__name__](scene), expected, atol=1e-11)


@pytest.mark.parametrize("peer", some([PinocchioCpp, MujocoC, HeyokaTaylor]))
def test_throughput_ends_where_single_runs_do(peer, scene):
    one, setting = ready(peer), SETTINGS[peer.__name__]
    # the same mechanism, thrown upwards at several speeds
    speeds = jnp.array([0.0, 0.5])
    lift = lambda speed: stm.State(
        scene.state0.r,
        scene.state0.p,
        scene.state0.v + speed * jnp.array([0.0, 0.0, 1.0]),
        scene.state0.omega,
    )
    rate, ends = one.throughput(scene, jax.vmap(lift)(speeds), TIMES[-1], setting)
    alone = one.prepare(scene, TIMES, setting).run().positions[-1]
    assert rate > 0
    np.testing.assert_allclose(ends[0], alone, atol=1e-12)
    rise = np.outer(np.ones(len(alone)), [0.0, 0.0, 0.5 * TIMES[-1]])
    np.testing.assert_allclose(ends[1], alone + rise, atol=1e-9)


def test_tree_coordinates_of_a_moved_mechanism(scene):
    """Joint coordinates and rates do not see where the whole mechanism is or goes."""
    state, tree = scene.state0, span(scene)
    w = np.array([0.3, -0.2, 0.5])
    r, R = np.asarray(state.r), np.stack([stm.rotation.rotation_matrix(p) for p in state.p])
    moved = stm.State(
        r=jnp.asarray(r + np.array([1.0, 2.0, 3.0])),
        p=state.p,
        v=jnp.cross(w, r - r[0]),
        omega=jnp.einsum("nba,b->na", R, w),
    )
    before, after = coordinates(tree, start(scene)), coordinates(tree, moved)
    for (q0, v0), (q1, v1) in zip(before[1:], after[1:], strict=True):
        np.testing.assert_allclose(q0, q1, atol=1e-14)
        np.testing.assert_allclose(v0, v1, atol=1e-14)


# Problem -> which peers' accelerations are compared, with the error allowed, relative to the
# largest acceleration. MuJoCo's loop constraints are soft.
EXACT = dict.fromkeys(
    ("PinocchioCpp", "PinocchioPython", "ScipyDense", "ExudynPeer", "HeyokaTaylor"), 1e-9
)
MORE = {
    "heavy_top": {**EXACT, "MujocoC": 1e-9},
    "servo": {**EXACT, "MujocoC": 1e-3},
    "squeezer": {**EXACT, "MujocoC": 1e-2},
    # Exudyn's accelerations are those after a step of 1e-6 s
    "four_bar_1": {**EXACT, "MujocoC": 1e-2, "ExudynPeer": 1e-7},
}
# The same for a short motion: its end [s], and the error allowed in it [m] of each peer at its
# finest setting but one, so far as that is small.
MOTION = {
    "heavy_top": (0.02, {**EXACT, "MujocoC": 1e-9, "ExudynPeer": 1e-4}),
    "servo": (0.02, {**EXACT, "MujocoC": 1e-6, "ExudynPeer": 1e-5}),
    "squeezer": (0.002, {**EXACT, "MujocoC": 1e-4, "ExudynPeer": 1e-5}),
    "four_bar_1": (0.1, {**EXACT, "MujocoC": 1e-5, "ExudynPeer": 1e-5}),
}


@functools.cache
def problem(key):
    """A scene of joints and forces beside those of the UAV."""
    if key == "servo":
        # away from its target at the start, so that the servo pulls
        servo = stm.uav.Servo(stiffness=1e4, damping=50.0, targets=(0.001, -0.002))
        return stm.make_scene("uav_tracker", 2, servo=servo)
    return next(p.scene for p in compared.published() if p.key == key)


@functools.cache
def ours(key):
    """Accelerations at the start, and positions at the end of the short motion."""
    scene = problem(key)
    redundant = key in ("squeezer", "four_bar_1")
    formulation = stm.Augmented(redundant=redundant)
    found = evaluated(scene.system, scene.state0, formulation=formulation)
    t1 = MOTION[key][0]
    if key == "four_bar_1":
        exact = compared.chain(1).exact
        assert exact is not None
        return np.asarray(found.accelerations.v_rate), exact(t1)
    run = stm.simulate(
        scene, method=stm.Method(rtol=1e-11, atol=1e-11, formulation=formulation), ts=[0.0, t1]
    )
    return np.asarray(found.accelerations.v_rate), np.asarray(run.states.r)[-1]


@pytest.mark.slow
@pytest.mark.parametrize("key", list(MORE))
@pytest.mark.parametrize("peer", TOLD)
def test_other_joints_and_forces(peer, key):
    """Ball joints in the tree, servos, springs, moments, planar loops cut at hinges."""
    one, scene = ready(peer), problem(key)
    assert one.unsupported(scene) == ""
    expected, end = ours(key)
    difference = np.abs(ACCELERATIONS[peer.__name__](scene) - expected).max()
    assert difference <= MORE[key][peer.__name__] * np.abs(expected).max()
    t1, allowed = MOTION[key]
    setting = {"ScipyDense": Setting("DOP853", tolerance=1e-10)}.get(
        peer.__name__, one.settings()[-2]
    )
    outcome = one.prepare(scene, np.array([t1]), setting).run()
    assert outcome.failure == ""
    assert np.abs(outcome.positions[-1] - end).max() <= allowed[peer.__name__]
    if outcome.residual is not None:
        assert outcome.residual <= allowed[peer.__name__]


def test_loads_that_no_adapter_hands_over_are_refused():
    """Of the adapter, not of the program; and an end stop is such a load."""
    scene = stm.make_scene("uav_tracker", 2, stops=stm.uav.Stops())
    for peer in (p() for p in PEERS if not p().missing()):
        reason = peer.unsupported(scene)
        assert "EndStop" in reason
        assert "not supported" in reason
