"""Models as files: the gallery's numbers, a round trip to the last bit, errors that name the place."""

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import evaluated
from scipy.optimize import brentq
from scipy.special import ellipk

import stmuav_jax as stm
from stmuav_jax.cli.main import main
from stmuav_jax.dynamics import rank
from stmuav_jax.io import FileError, load_model, model_to_text, save_model
from stmuav_jax.io.model_schema import (
    BODY,
    DATASHEET,
    FORCES,
    IN_BODIES,
    INSTRUMENTS,
    JOINTS,
    START_BODY,
    model_json_schema,
)
from stmuav_jax.mechanics import (
    EndStop,
    GroundContact,
    JointFriction,
    JointServo,
    SineMotion,
    joint_motion,
)
from stmuav_jax.mechanics.joint import CATALOGUE
from stmuav_jax.uav import AirframeDrag, MotorRotors, RotorLimits, Rotors

DOCS = Path(__file__).parents[2] / "docs"
GALLERY = sorted((DOCS / "models").glob("*.toml"))


@pytest.fixture(scope="module")
def gallery():
    return {path.stem: load_model(path) for path in GALLERY}


def bits(scene):
    trees = scene.system, scene.state0
    return jax.tree.structure(trees), [np.asarray(x).tobytes() for x in jax.tree.leaves(trees)]


# --- the gallery's numbers, which docs/models.md shows


@pytest.mark.slow
def test_a_period_of_the_pendulum_by_the_command_line(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    path = str(DOCS / "models" / "pendulum.toml")
    words = ["--no-error-estimate", "--figures", "none", "--no-cache"]
    assert main(["simulate", path, *words, "--out", str(tmp_path)]) == 0
    run = stm.load(tmp_path / "run.nc")
    period = 4 * math.sqrt(2 / (3 * 9.81)) * ellipk(math.sin(math.pi / 6) ** 2)
    assert float(run["time"][-1]) == pytest.approx(period, rel=1e-14)
    r = run["position"].values[:, 0]
    assert r[-1] == pytest.approx(r[0], abs=1e-8)
    assert np.abs(r[len(r) // 2] - r[0]).max() > 0.8


@pytest.mark.slow
def test_the_cart_and_pole_accelerate_as_published(gallery):
    scene = gallery["cart_pole"]
    found = evaluated(scene.system, scene.state0).accelerations
    # Florian (2007), Eq. 23 and 24, without friction
    angle, rate, force, m, half, g = 0.2, 0.5, 10.0, 0.1, 0.5, 9.8
    push = (-force - m * half * rate**2 * math.sin(angle)) / 1.1
    own = half * (4 / 3 - m * math.cos(angle) ** 2 / 1.1)
    turning = (g * math.sin(angle) + math.cos(angle) * push) / own
    spin = rate**2 * math.sin(angle) - turning * math.cos(angle)
    cart = (force + m * half * spin) / 1.1
    assert found.omega_rate[1, 1] == pytest.approx(turning, rel=1e-12)
    assert found.v_rate[0] == pytest.approx([cart, 0, 0], rel=1e-12, abs=1e-12)
    assert (turning, cart) == pytest.approx((-11.1795829, 9.5912001), abs=1e-7)


def test_the_rocker_of_the_four_bar_obeys_freudenstein(gallery):
    scene = gallery["four_bar"]
    rocker = joint_motion(scene.system, scene.state0, "D")
    crank, coupler, length, ground, a = 1.0, 3.0, 2.5, 3.0, 0.5
    # ground/crank cos c - ground/length cos a + (...) = cos(a - c)
    k = (crank**2 - coupler**2 + length**2 + ground**2) / (2 * crank * length)
    one = lambda c: (
        ground / crank * math.cos(c) - ground / length * math.cos(a) + k - math.cos(a - c)
    )
    reference = math.atan2(2.4803918541230536, -0.3125)
    exact = float(brentq(one, 1.4, 2.5, xtol=1e-14))  # pyright: ignore[reportArgumentType]
    assert float(rocker.angle) + reference == pytest.approx(exact, abs=1e-9)
    # the links' velocities across the coupler: rate of the rocker by the law of instant centres
    coupling = math.atan2(
        length * math.sin(exact) - crank * math.sin(a),
        ground + length * math.cos(exact) - crank * math.cos(a),
    )
    rate = 2 * crank * math.sin(coupling - a) / (length * math.sin(coupling - exact))
    assert float(rocker.angle_rate) == pytest.approx(rate, rel=1e-9)
    assert (exact, rate) == pytest.approx((1.5320736, -0.2646124), abs=1e-7)


def test_the_slider_is_where_the_crank_puts_it(gallery):
    scene = gallery["slider_crank"]
    slider = joint_motion(scene.system, scene.state0, "guide")
    r, rod, a, rate = 0.3, 0.5, math.pi / 2 - 0.5, 10.0
    height, reach = r * math.sin(a), math.sqrt(rod**2 - (r * math.sin(a)) ** 2)
    x = r * math.cos(a) + reach
    assert float(slider.displacement) + 0.4 == pytest.approx(x, abs=1e-10)
    speed = -rate * (height + height * r * math.cos(a) / reach)
    assert float(slider.displacement_rate) == pytest.approx(speed, rel=1e-9)
    assert (x, speed) == pytest.approx((0.5688999, -3.5235656), abs=1e-7)


def test_the_gyroscope_precesses_steadily(gallery):
    scene = gallery["gyroscope"]
    found = evaluated(scene.system, scene.state0).accelerations
    precession = 1.0 * 9.81 * 0.1 / (0.002 * 300)
    # its centre of mass moves on a level circle
    assert scene.state0.v[0] == pytest.approx([0, 0.1 * precession, 0], abs=1e-14)
    assert found.v_rate[0] == pytest.approx([-(precession**2) * 0.1, 0, 0], abs=1e-11)


def test_the_legs_of_the_stewart_platform_share_its_weight(gallery):
    scene = gallery["stewart_platform"]
    found = evaluated(scene.system, scene.state0)
    leg = float(scene.system.joints[0].length)
    each = 12 * 9.81 * leg / 6
    assert np.linalg.norm(found.reactions.force, axis=1) == pytest.approx(np.full(6, each))
    assert each == pytest.approx(23.5501, abs=1e-4)
    assert found.accelerations.v_rate == pytest.approx(np.zeros((1, 3)), abs=1e-9)


@pytest.mark.slow
def test_the_arms_of_the_delta_robot_fall_together(gallery):
    scene = gallery["delta_robot"]
    found = evaluated(scene.system, scene.state0, formulation=stm.Tree()).accelerations
    arm, platform, length = 0.5, 0.8, 0.3
    moment = 0.00375 + arm * (length / 2) ** 2
    turning = (platform + 1.5 * arm) * length * 9.81 / (platform * length**2 + 3 * moment)
    assert found.omega_rate[:3, 1] == pytest.approx(np.full(3, turning), rel=1e-12)
    assert found.v_rate[3] == pytest.approx([0, 0, -length * turning], rel=1e-12, abs=1e-12)
    assert found.omega_rate[3] == pytest.approx(np.zeros(3), abs=1e-10)
    assert turning == pytest.approx(38.9884615, abs=1e-7)


@pytest.mark.slow
def test_the_linkage_of_bricard_moves_although_it_should_not(gallery):
    scene = gallery["bricard"]
    found = rank(scene.system, scene.state0)
    assert (found.rows, found.rank, found.dof) == (30, 29, 1)
    how = stm.Tree(redundant=True)
    spin = evaluated(scene.system, scene.state0, formulation=how).accelerations.omega_rate
    # all hinges turn alike: by the rods' velocities per rate, 4.5 + 0.5 + 3e-4 kg m^2 and 1 m of fall
    wanted = 9.81 / 5.0003
    pattern = [[0, -1, 0], [0, -1, -1], [1, -1, -1], [1, 0, -1], [1, 0, 0]]
    assert spin == pytest.approx(wanted * np.array(pattern), abs=1e-10)
    assert wanted == pytest.approx(1.9618823, abs=1e-7)


def test_the_slung_load_swings_below_a_quadrotor_that_gives_way(gallery):
    scene = gallery["quadrotor_slung_load"]
    found = evaluated(scene.system, scene.state0, formulation=stm.Tree()).accelerations
    M, m, length, J = 1.2, 0.4, 0.8, 2.56e-4
    swing = m * length**2 + J - (m * length) ** 2 / (M + m)
    wanted = -m * 9.81 * length * math.sin(0.2) / swing
    assert found.omega_rate[1] == pytest.approx([0, wanted, 0], rel=1e-10, abs=1e-12)
    assert found.omega_rate[0] == pytest.approx(np.zeros(3), abs=1e-12)
    assert wanted == pytest.approx(-3.2439183, abs=1e-7)


@pytest.mark.slow
def test_the_tracker_of_the_file_is_that_of_the_report(gallery):
    scene, own = gallery["tracker"], stm.make_scene("tracker", 2)
    found = evaluated(scene.system, scene.state0, formulation=stm.Tree()).accelerations
    wanted = evaluated(own.system, own.state0, formulation=stm.Tree()).accelerations
    assert found.v_rate == pytest.approx(np.asarray(wanted.v_rate), rel=1e-9, abs=1e-9)
    assert found.omega_rate == pytest.approx(np.asarray(wanted.omega_rate), rel=1e-9, abs=1e-9)
    assert found.v_rate[5, 2] == pytest.approx(-0.7907645, abs=1e-7)


# --- round trips


@pytest.mark.parametrize("path", GALLERY, ids=lambda p: p.stem)
def test_gallery_models_are_short_and_come_back_to_the_last_bit(path, gallery, tmp_path):
    assert len(path.read_text(encoding="utf-8").splitlines()) < 60
    scene = gallery[path.stem]
    again = load_model(save_model(scene, tmp_path / "any.toml"))
    assert bits(again) == bits(scene)
    for name in ("name", "title", "t0", "t1", "save_every", "parameters", "notes", "watch"):
        assert getattr(again, name) == getattr(scene, name), name


def everything():
    """Scene with every kind of joint and force element, odd numbers and odd names."""
    odd = np.array([0.1, -0.0, 1 / 3])
    tensor = np.array([[2.0, 0.1, 0.0], [0.1, 3.0, -0.2], [0.0, -0.2, 4.0]]) / 7
    turn = np.array([1.0, 2.0, -3.0, 0.5]) / np.sqrt(14.25)
    names = [f"b{k}" for k in range(9)]
    bodies = [
        stm.Body(n, 1 / 3 + k, tensor, com=odd, position=odd * k, orientation=turn)
        for k, n in enumerate(names)
    ]
    bodies.append(
        stm.Body('ä "b"\n', 5e-324, (1.0, 1.0, 2.0 + 1e-6), free=True, triangle_tolerance=1e-5)
    )
    axis = {"axis": [0, 1, 1.7]}
    at = {"point": odd}
    ends = {"point_i": odd, "point_j": [1.0, 2.0, 3.0]}
    given = {
        "weld": {}, "spherical": at, "universal": at | {"axis_i": [1, 0, 0], "axis_j": [0, 1, 0]},
        "revolute": at | axis, "translational": axis, "cylindrical": axis,
        "screw": at | axis | {"pitch": -0.01}, "distance": ends, "revolute_spherical": ends | axis,
    }  # fmt: skip
    joints = [
        getattr(stm, kind)(kind, "ground", body, **more)
        for body, (kind, more) in zip(names, given.items(), strict=True)
    ]
    which: dict[str, Any] = {"revolute": "angle", "translational": "displacement"}
    by_name = {joint.name: joint for joint in joints}
    joints += [
        stm.drive(f"drive {n}", by_name[n], SineMotion(0.1, 1 / 3, -0.0, 7.0, 1e-3), coordinate=c)
        for n, c in which.items()
    ]
    cylinder = by_name["cylindrical"]
    joints += [
        stm.mimic(
            f"{c} by {m}", cylinder, by_name[m], ratio=1 / 3, offset=0.1, coordinate=c
        )
        for c in which.values()
        for m in which
    ]  # fmt: skip
    forces = [
        stm.Gravity(),
        stm.LinearSpringDamper("b0", "ground", stiffness=1.1, length=0.3),
        stm.TorsionalSpringDamper("revolute", stiffness=1.0, angle=0.1),
        stm.JointDamping("revolute", turning=0.1),
        JointServo("cylindrical", stiffness=1, damping=2, target=0.1, coordinate="angle"),
        EndStop("translational", lower=-1 / 3, stiffness=1e9, damping=0, width=1e-3),
        JointFriction("revolute", coulomb=1, speed=1e-3),
        stm.JointEffort("translational", 3.0),
        GroundContact(
            "b1",
            feet=[odd, [1.0, 2.0, 3.0]],
            height=-0.1,
            stiffness=1e4,
            damping=1 / 3,
            width=1e-3,
            friction=0.6,
            slip_speed=0.02,
        ),
        stm.AppliedForce("b1", odd, frame="body", point=odd),
        stm.AppliedMoment("b1", odd),
        Rotors(
            "b2",
            arms=np.eye(3),
            spin=[1, -1, 1],
            k_f=1e-6,
            k_tau=1e-8,
            speed_squared=odd,
            thrust_linear=1 / 3,
            torque_offset=-0.7,
        ),
        MotorRotors(
            Rotors("b3", arms=np.eye(3), spin=[1, -1, 1], k_f=1e-6, k_tau=1e-8, speed_squared=odd),
            time_constant=0.1 / 3,
            inertia=[1e-5, 2e-5, 1 / 3],
            limits=RotorLimits(0.1, [1e3, 1e3 / 3, 7.7]),
            start=odd,
        ),
        AirframeDrag("b4", linear=[0.1, 0.2, 1 / 3], point=odd, wind=[3.0, 0.1, 0.0]),
        JointServo("screw", stiffness=1, damping=2, target=0.1, coordinate="angle", limit=1 / 3),
        stm.JointEffort("cylindrical", 3.0, coordinate="displacement", limit=0.7),
    ]
    system = stm.System(bodies, joints, forces)
    state = jax.tree.map(
        lambda x: x + 0.1 * jnp.sin(jnp.arange(x.size).reshape(x.shape)), system.reference
    )
    p = np.asarray(state.p) / np.linalg.norm(state.p, axis=1, keepdims=True)
    state = stm.State(state.r, jnp.asarray(p), state.v, state.omega)
    table = {"l.1": {"value": [1.0, 2.0], "unit": "m", "source": 'a "book" \\ p. 3'}}
    return stm.Scene(
        "all",
        "Every kind",
        system,
        state,
        t0=-1.0,
        notes=("One.",),
        watch=("b1",),
        parameters=table,
    )


def test_every_kind_comes_back_to_the_last_bit(tmp_path):
    scene = everything()
    assert {joint.kind for joint in scene.system.joints} == set(CATALOGUE)
    assert set(JOINTS) == {kind for kind in CATALOGUE if "mimic" not in kind} | {"mimic"}
    assert {type(force) for force in scene.system.forces} == {
        kind.makes for kind in FORCES.values()
    }
    path = save_model(scene, tmp_path / "all.toml")
    again = load_model(path)
    assert bits(again) == bits(scene)
    assert again.parameters == scene.parameters
    assert model_to_text(again) == path.read_text(encoding="utf-8")


def test_what_a_file_cannot_hold_is_refused(gallery):
    system = gallery["pendulum"].system
    pin = system.joints[0]
    cases = {
        "the motion of the driver 'd'": (
            [stm.drive("d", pin, lambda t: t, coordinate="angle")],
            [],
        ),
        "'effort' of the JointEffort on pin; set it": ([], [stm.JointEffort("pin", lambda t: t)]),
    }
    rod = stm.Body("rod", 1.0, (1.0, 1.0, 1.0))
    joint = stm.revolute("pin", "ground", "rod", point=[0, 0, 0], axis=[0, 1, 0])
    for words, (joints, forces) in cases.items():
        other = stm.System([rod], [joint, *joints], forces)
        with pytest.raises(stm.SettingError, match=words):
            model_to_text(stm.Scene("x", "", other, other.reference))


FLYING = """format = 2
[parameters]
mass = {value = 2.0, unit = "kg", source = "weighed"}
[bodies.frame]
mass = "mass"
inertia = [0.02, 0.02, 0.03]
free = true
[forces.motors]
kind = "motors"
body = "frame"
number = 4
radius = 0.25
k_f = 1e-5
k_tau = 2e-7
time_constant = 0.03
highest = 1200.0
[forces.air]
kind = "drag"
body = "frame"
linear = [0.2, 0.2, 0.3]
[forces.weight]
kind = "gravity"
[wind]
steady = [3.0, 0.0, 0.0]
[battery]
capacity = 18000.0
"""


def test_a_multirotor_of_a_file_hovers_in_its_wind(tmp_path):
    """Five lines make a multirotor; its rotors carry the weight of the masses that a table gives them."""
    path = tmp_path / "flying.toml"
    path.write_text(FLYING)
    model = stm.io.read_model(path)
    forces: Any = model.scene.system.forces
    motors, air, _ = forces
    thrust = float(motors.rotors.k_f) * np.asarray(motors.rotors.speed_squared)
    assert thrust == pytest.approx(np.full(4, 2.0 * 9.81 / 4))
    np.testing.assert_allclose(motors.internal**2, motors.rotors.speed_squared)
    heavier: Any = model.system(model.table.replaced({"mass": 3.0})).forces[0]
    np.testing.assert_allclose(heavier.rotors.speed_squared, 1.5 * motors.rotors.speed_squared)
    angles = np.degrees(np.arctan2(motors.rotors.arms[:, 1], motors.rotors.arms[:, 0]))
    assert angles == pytest.approx([45, 135, -135, -45])
    np.testing.assert_array_equal(air.wind, [3.0, 0.0, 0.0])
    again: Any = load_model(save_model(model.scene, tmp_path / "again.toml"))
    np.testing.assert_array_equal(again.system.forces[1].wind, [3.0, 0.0, 0.0])
    assert model.file.battery is not None
    # the drag of the air at rest relative to the wind: F = -c w
    run = evaluated(model.scene.system, model.scene.state0).accelerations
    assert run.v_rate[0] == pytest.approx([0.2 * 3.0 / 2.0, 0.0, 0.0], abs=1e-12)


BAD_FLYING = [
    ("number = 4\n", "", "Rotors need 'arms' and 'spin', or a layout by 'number' and 'radius'"),
    ("number = 4", "number = 5", "must be even, and at least 4, so that drag torques balance, but it is 5"),
    ("[forces.weight]", "[forces.more]\nkind = 'rotors'\nbody = 'frame'\nnumber = 4\nradius = 1\nk_f = 1\n"
     "k_tau = 0\n[forces.weight]", "[forces.more]: One of several sets of rotors needs 'speed_squared'"),
    ("[wind]", "[wind]\ngusts = {}\nsteaddy = 0", "'wind' has no entry 'steaddy'. Did you mean 'steady'?"),
    ("steady = [3.0, 0.0, 0.0]", "gusts = {}", "[wind]: Gusts pass at the speed of the steady wind"),
    ("format = 2", "format = 1", "'wind' needs format = 2"),
    ("highest = 1200.0", "lowest = 1300.0\nhighest = 1200.0", "must be 0 <= lowest < highest"),
    ("k_tau = 2e-7\n", "", "Rotors need 'k_f' and 'k_tau', or 'points' of a test stand"),
    ("k_tau = 2e-7", "k_tau = 2e-7\nthrust_linear = -1e-3", "falls with their speed below 50 rad/s, but "
     "their lowest speed is 0 rad/s"),
    ("k_f = 1e-5\nk_tau = 2e-7\n", "points = [[1, 0, 0], [2, 1, 1], [3, 0, 0], [4, 1, 1]]\n",
     "No quadratic curve of the speed fits the thrusts"),
]  # fmt: skip


CURVES = """k_f = 1e-5
k_tau = 2e-7
thrust_linear = -1e-3
thrust_offset = 0.2
torque_linear = 3e-5
"""


def test_rotors_of_a_file_have_curves_or_points(tmp_path):
    """The hover's speed solves k_f w^2 + c w + T_0 = m g / 4; points of a quadratic curve give its coefficients."""
    path = tmp_path / "flying.toml"
    path.write_text(FLYING.replace("k_f = 1e-5\nk_tau = 2e-7\n", CURVES))
    path.write_text(path.read_text().replace("highest", "lowest = 60.0\nhighest"))
    forces: Any = load_model(path).system.forces
    rotors = forces[0].rotors
    speed = (1e-3 + np.sqrt(1e-6 + 4e-5 * (2.0 * 9.81 / 4 - 0.2))) / 2e-5
    np.testing.assert_allclose(np.sqrt(rotors.speed_squared), speed, rtol=1e-14)
    w = np.array([100.0, 400.0, 700.0, 1000.0])
    points = np.stack([w, rotors.thrusts(w**2), rotors.torques(w**2)], axis=1).tolist()
    path.write_text(FLYING.replace("k_f = 1e-5\nk_tau = 2e-7\n", f"points = {points}\n"))
    path.write_text(path.read_text().replace("highest", "lowest = 60.0\nhighest"))
    again: Any = load_model(path).system.forces
    np.testing.assert_allclose(np.sqrt(again[0].rotors.speed_squared), speed, rtol=1e-12)
    for name in ("k_f", "thrust_linear", "thrust_offset", "k_tau", "torque_linear"):
        fitted, true = getattr(again[0].rotors, name), getattr(rotors, name)
        assert float(fitted) == pytest.approx(float(true), rel=1e-9), name


def test_wind_without_drag_and_gusts_are_refused(tmp_path):
    path = tmp_path / "bad.toml"
    start, end = FLYING.index("[forces.air]"), FLYING.index("[forces.weight]")
    path.write_text(FLYING[:start] + FLYING[end:])
    with pytest.raises(FileError, match="Wind acts through the drag of an airframe"):
        load_model(path)
    path.write_text(FLYING.replace("[battery]", "gusts = {seed = 3}\n[battery]"))
    with pytest.raises(stm.SettingError, match="cannot hold gusts"):
        model_to_text(load_model(path))


# --- errors

SMALL = """format = 1
[parameters]
mass = {value = 1.0, unit = "kg", source = "chosen"}
[bodies.rod]
mass = "mass"
inertia = [1, 1, 1]
[joints.pin]
kind = "revolute"
bodies = ["ground", "rod"]
point = [0, 0, 0]
axis = [0, 1, 0]
[forces.weight]
kind = "gravity"
[start.coordinates]
pin = 0.1
"""

BAD = [
    ("format = 1", "format = 3", "'format' is 3, but this version reads the formats 1 and 2"),
    ("format = 1", "format = 1\ntitel = 'x'", "no entry 'titel'. Did you mean 'title'?"),
    ("value = 1.0", "value = 'x'", "'parameters.mass.value' must be finite numbers, but it is 'x'"),
    (', source = "chosen"', "", "'parameters.mass' needs 'source'"),
    ('unit = "kg"', 'unit = "g"', "[bodies.rod]: 'mass' is a quantity in kg, but the parameter "
     "'mass' is in 'g'"),
    ('mass = "mass"', 'mass = "mas"', "[bodies.rod]: 'mass' must be numbers or the names of "
     "parameters, but there is no parameter 'mas'. Did you mean 'mass'?"),
    ('mass = "mass"', "mass = -1", "[bodies.rod]: The mass of body 'rod' must be finite and positive"),
    ("[1, 1, 1]", "[1, 1, 1]\nposition = [0, 0, 0]\ncom_position = [0, 0, 0]", "not both"),
    ("bodies.rod", "bodies.ground", "[bodies.ground]: A body cannot be named 'ground'"),
    ("revolute", "revolut", "[joints.pin]: A joint has the kind 'revolut'. Did you mean 'revolute'?"),
    ('"rod"]', '"rood"]', "Joint 'pin' names the unknown body 'rood'. Did you mean 'rod'?"),
    ("axis = [0, 1, 0]", "axis = [0, 0, 0]", "[joints.pin]: The axis of joint 'pin' has zero length"),
    ("axis = [0, 1, 0]", "axes = [0, 1, 0]", "A joint of kind revolute has no entry 'axes'. Did you "
     "mean 'axis'?"),
    ('kind = "gravity"', 'kind = "spring"\nbodies = ["rod", "ground"]\nstiffness = -1',
     "[forces.weight]: The stiffness of the spring between 'rod' and 'ground' must not be negative"),
    ('kind = "gravity"', 'kind = "effort"\njoint = "pin"\neffort = 1\ncoordinate = "angel"',
     "'coordinate' must be 'angle' or 'displacement', but it is 'angel'. Did you mean 'angle'?"),
    # units of a coordinate are those of its joint
    ("pin = 0.1", 'pin = "mass"', "'coordinates.pin' is a quantity in rad, but the parameter 'mass'"),
    ("[start.coordinates]\npin = 0.1", '[start.rates]\npin = "mass"',
     "'rates.pin' is a quantity in rad/s, but"),
    ('kind = "gravity"', 'kind = "effort"\njoint = "pin"\neffort = "mass"',
     "'effort' is a quantity in N m, but the parameter 'mass' is in 'kg'"),
    ("pin = 0.1", "pn = 0.1", "[start]: There is no joint 'pn'. Did you mean 'pin'?"),
    ("[joints.pin]", "[joints.pin]\nin_bodies = 3", "no entry 'point'"),
    ("[forces.weight]", "[joints.motor]\nkind = 'drive_angle'\njoint = 'pn'\n[forces.weight]",
     "[joints.motor]: 'joint' must be a joint of a table before this one, but it is 'pn'. Did you"),
    ("[forces.weight]", "[joints.motor]\nkind = 'drive_displacement'\njoint = 'pin'\n[forces.weight]",
     "[joints.motor]: Driver 'motor' prescribes the displacement of joint 'pin', but a revolute"),
]  # fmt: skip


def test_a_driver_moves_as_its_numbers_say(tmp_path):
    motor = """[joints.motor]
kind = "drive_angle"
joint = "pin"
start = 0.1
rate = 2
amplitude = 0.5
angular_frequency = 3
phase = 0.2
"""
    path = tmp_path / "driven.toml"
    path.write_text(
        SMALL.replace("[forces.weight]", motor + "[forces.weight]").partition("[start")[0]
    )
    motion = load_model(path).system.joints[1].motion
    assert motion is not None
    assert float(motion(jnp.asarray(0.7))) == pytest.approx(
        0.1 + 1.4 + 0.5 * math.sin(2.3), rel=1e-15
    )


WOUND = """format = 1
[bodies.disc]
mass = 1.0
inertia = [0.3, 0.3, 0.2]
[joints.hinge]
kind = "revolute"
bodies = ["ground", "disc"]
point = [0, 0, 0]
axis = [0, 0, 1]
[forces.clock]
kind = "torsional_spring"
joint = "hinge"
stiffness = 5.0
[start.coordinates]
hinge = 1000.0
"""


def test_a_file_starts_a_wound_spring(tmp_path):
    """k 1000 rad / I, also when the model is saved and read again."""
    path = tmp_path / "wound.toml"
    path.write_text(WOUND)
    scene = load_model(path)
    again = load_model(save_model(scene, tmp_path / "again.toml"))
    assert bits(again) == bits(scene)
    for each in (scene, again):
        found = evaluated(each.system, each.state0).accelerations.omega_rate[0, 2]
        assert float(found) == pytest.approx(-5.0 * 1000.0 / 0.2, rel=1e-12)
    path.write_text(
        WOUND.replace("[start.coordinates]", "[start.angles]").replace("hinge =", "hing =")
    )
    with pytest.raises(FileError, match=r"\[start\]: There is no joint 'hing'.*hinge"):
        load_model(path)


def test_frames_of_saved_joints_are_checked(tmp_path):
    text = model_to_text(everything())
    path = tmp_path / "bad.toml"
    other = "frame_i = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]"
    path.write_text(re.sub(r"frame_i = \[.*?\n\]", other, text, count=1, flags=re.DOTALL))
    with pytest.raises(FileError, match=r"\[joints.weld\]: 'frame_i' must be a rotation matrix"):
        load_model(path)


def test_the_file_of_a_robot_is_refused_with_the_way_to_a_model():
    with pytest.raises(FileError, match=r'save_model\(load_robot\("arm.urdf"\), "arm.toml"\)'):
        load_model("robots/arm.urdf")


def test_the_command_line_refuses_what_a_model_has_not(tmp_path, capsys):
    path = tmp_path / "bad.toml"
    assert main(["simulate", str(path), "--no-cache"]) == 2
    assert "There is no file" in capsys.readouterr().err
    path.write_text(SMALL)
    assert main(["simulate", str(path), "--case", "1", "--no-cache"]) == 2
    assert "--case is for the report's scenes" in capsys.readouterr().err


# --- the page


def test_the_page_lists_every_entry_with_its_unit():
    page = (DOCS / "models.md").read_text(encoding="utf-8")
    for kinds in (JOINTS, FORCES, INSTRUMENTS):
        for name, kind in kinds.items():
            row = next(line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
            for key, slot in kind.slots.items():
                if kinds is INSTRUMENTS and key in DATASHEET:
                    continue
                shown = f"`{key}`" if slot.needed else f"*`{key}`*"
                assert (f"{shown} [{slot.unit}]" if slot.unit else shown) in row, (name, key)
    for key in (*BODY.slots, *IN_BODIES, *START_BODY, *DATASHEET):
        assert f"`{key}`" in page, key
    for path in GALLERY:
        assert f"(models/{path.name})" in page


def test_the_schema_for_editors_admits_the_gallery_and_finds_mistakes(tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(json.loads(json.dumps(model_json_schema())))
    saved = save_model(everything(), tmp_path / "all.toml")
    contents = [tomllib.loads(path.read_text(encoding="utf-8")) for path in (*GALLERY, saved)]
    for content in (*contents, tomllib.loads(FLYING), tomllib.loads(SENSED)):
        validator.validate(content)
    for old, new in (
        ("number = 4", "numbr = 4"), ('"motors"', '"motor"'), ('mass = "mass"', 'mas = "mass"'),
        ("capacity = 18000.0", "capacity = -1"), ("time_constant = 0.03", "time_constant = true"),
    ):  # fmt: skip
        with pytest.raises(jsonschema.ValidationError):
            validator.validate(tomllib.loads(FLYING.replace(old, new, 1)))


# --- sensors

SENSED = """format = 2
t1 = 1.0
parameters.grass = {value = 0.02, unit = "rad/s", source = "datasheet"}
[bodies.rod]
mass = 1.0
inertia = [0.1, 0.1, 0.1]
com = [0.0, 0.0, -0.5]
[joints.pin]
kind = "revolute"
bodies = ["ground", "rod"]
point = [0, 0, 0]
axis = [0, 1, 0]
[sensors]
spin = {kind = "gyroscope", body = "rod", noise = "grass", bias = [0.01, 0, -0.01], rate = 200.0}
tip = {kind = "accelerometer", body = "rod", point = [0, 0, -1], axes = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}
foot = {kind = "accelerometer", body = "rod", noise = [0.1, 0.1, 0.2]}
angle = {kind = "encoder", joint = "pin", noise = 1e-3, delay = 0.01}
place = {kind = "position", body = "rod", point = [0, 0, -1]}
facing = {kind = "attitude", body = "rod", rate = 10}
"""


@pytest.mark.slow
def test_sensors_of_a_file_come_back(tmp_path):
    path = tmp_path / "sensed.toml"
    path.write_text(SENSED)
    scene = load_model(path)
    assert list(scene.sensors) == ["spin", "tip", "foot", "angle", "place", "facing"]
    spin, tip = scene.sensors["spin"], scene.sensors["tip"]
    assert (spin.name, spin.noise, spin.rate, spin.delay) == ("spin", 0.02, 200.0, 0.0)
    assert np.array_equal(spin.bias, [0.01, 0.0, -0.01])
    assert scene.sensors["angle"].delay == 0.01
    # what they read is what the sensors of the library read
    run = stm.simulate(scene, t1=0.1, error_estimate=False)
    axes = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    exact = stm.analysis.Accelerometer("rod", [0, 0, -1], axes)
    own, other = (stm.analysis.readings((one,), run) for one in (tip.sensor, exact))
    np.testing.assert_array_equal(own["tip"], other["accelerometer rod"])
    text = model_to_text(scene)
    assert text.startswith("format = 2\n")
    again = tmp_path / "again.toml"
    again.write_text(text)
    back = load_model(again)
    assert model_to_text(back).partition("title")[2] == text.partition("title")[2]
    assert list(back.sensors) == list(scene.sensors)
    assert [leaf.tobytes() for leaf in map(np.asarray, jax.tree.leaves(back.sensors))] == [
        leaf.tobytes() for leaf in map(np.asarray, jax.tree.leaves(scene.sensors))
    ]


BAD_SENSED = [
    ('joint = "pin"', 'joint = "pi"', "[sensors.angle]: There is no joint 'pi'"),
    ("[0.01, 0, -0.01]", "[0.01, 0]", "'bias' must have one number, or 3, but it has 2"),
    ("noise = 1e-3", "noise = -1e-3",
     "'angle' must not be negative, since it is a standard deviation, but it is -0.001"),
    ("rate = 10}", "rate = 0}", "'facing' must be positive and finite, but it is 0.0 Hz"),
    ('unit = "rad/s"', 'unit = "m/s"', "'noise' is a quantity in rad/s"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "old", "new", "words"),
    [
        *((SMALL, *each) for each in BAD),
        *((FLYING, *each) for each in BAD_FLYING),
        *((SENSED, *each) for each in BAD_SENSED),
    ],
)
def test_errors_name_file_table_entry_and_what_is_valid(text, old, new, words, tmp_path):
    path = tmp_path / "bad.toml"
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(FileError, match=re.escape(words)) as caught:
        load_model(path)
    assert str(caught.value).startswith(str(path))
