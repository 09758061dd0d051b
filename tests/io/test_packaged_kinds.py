"""Self-made files of the kinds that robot packages have: loops closed by frames, drones with thrust sites."""

import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.io import FileError, load_robot


@pytest.fixture(autouse=True)
def mujoco(tmp_path, monkeypatch):
    # it writes its log into the present folder
    monkeypatch.chdir(tmp_path)
    return pytest.importorskip("mujoco")


def link(name, mass=0.3):
    inertia = 'ixx="2e-4" iyy="3e-4" izz="2.5e-4" ixy="0" ixz="0" iyz="0"'
    inside = f'<inertial><mass value="{mass}"/><inertia {inertia}/></inertial>'
    return f'<link name="{name}">{inside if mass else ""}</link>'


def joint(name, kind, parent, child, place=(0, 0, 0), axis="0 1 0", yaw=0.0):
    xyz = " ".join(map(repr, map(float, place)))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="0 0 {yaw!r}"/><axis xyz="{axis}"/></joint>'
    )


AXES = {
    "R": ("continuous", "0 1 0"),
    "Z": ("continuous", "0 0 1"),
    "X": ("continuous", "1 0 0"),
    "P": ("prismatic", "0 0 1"),
}


def legged(legs, feet, heads, *, height=0.6, turned=True):
    """Platform carried by the first leg; the other legs end in frames that coincide with frames of it.

    A leg is a row of joints, R about y, X about x, Z about z, P along z, with equal links up from its foot, the last
    joint at its head; the frames "tip_k" and "seat_k" are at the heads of all legs but the first.
    """
    parts = [link("base", 0.0), link("platform", 1.0)]
    for k, (leg, foot, head) in enumerate(zip(legs, feet, heads, strict=True)):
        yaw = float(np.arctan2(foot[1], foot[0])) if turned else 0.0
        c, s = np.cos(yaw), np.sin(yaw)
        way = np.array([*head, height]) - np.array([*foot, 0.0])
        way = np.array([c * way[0] + s * way[1], c * way[1] - s * way[0], way[2]])
        before, place, angle = "base", np.array([*foot, 0.0]), yaw
        # joints at one point are three of a ball or two of a cross
        points = np.linspace(0.0, 1.0, len(leg)) if isinstance(leg, str) else np.array(leg[1])
        leg = leg if isinstance(leg, str) else leg[0]
        last = 0.0
        for n, (kind, share) in enumerate(zip(leg, points, strict=True)):
            name = f"leg_{k}_{n}"
            if n:
                place, angle = (share - last) * way, 0.0
            parts += [
                link(name),
                joint(f"j_{k}_{n}", AXES[kind][0], before, name, place, AXES[kind][1], angle),
            ]
            before, last = name, share
        rest = (1.0 - last) * way
        if k == 0:
            back = np.array([c * -head[0] + s * -head[1], c * -head[1] - s * -head[0], 0.0])
            parts.append(joint("carry", "fixed", before, "platform", rest + back, yaw=-yaw))
        else:
            parts += [
                link(f"tip_{k}", 0.0),
                joint(f"t_{k}", "fixed", before, f"tip_{k}", rest, yaw=-yaw),
            ]
            parts += [
                link(f"seat_{k}", 0.0),
                joint(f"s_{k}", "fixed", "platform", f"seat_{k}", (*head, 0.0)),
            ]
    return f'<robot name="legged">{"".join(parts)}</robot>'


def ring(radius, count=3, start=0.0):
    angles = start + 2 * np.pi * np.arange(count) / count
    return [(radius * np.cos(a), radius * np.sin(a)) for a in angles]


LINE = [(-0.3, 0.0), (0.3, 0.0)], [(-0.2, 0.0), (0.2, 0.0)]
BALL = [0.0, 0.5, 1.0, 1.0, 1.0]
CROSS = [0.0, 0.0, 0.5, 1.0, 1.0, 1.0]
UPS = ("RXPRXZ", CROSS)
# legs, feet and heads, joint of the closures, degrees of freedom by the count of Chebychev, Gruebler and Kutzbach
KINDS = {
    "four-bar by a hinge": (["RR", "RR"], *LINE, "revolute", 1),
    "five-bar": (["RRR", "RR"], *LINE, "weld", 2),
    "slider-crank": (["RRR", "P"], *LINE, "weld", 1),
    "ankle with two rods": (["RX", UPS, UPS], [(0.0, 0.0), *ring(0.3, 2)], [(0.0, 0.0), *ring(0.2, 2)], "weld", 2),
    "3-RPS": ([("RPXRZ", BALL)] * 3, ring(0.4), ring(0.3), "weld", 3),
    "3-RRS by balls": (
        [("RRXRZ", BALL), ("RR", [0.0, 0.5]), ("RR", [0.0, 0.5])], ring(0.4), ring(0.3), "spherical", 3
    ),
    "3-UPS and a sliding post": (
        [("P", [0.0]), UPS, UPS, UPS], [(0.0, 0.0), *ring(0.4)], [(0.0, 0.0), *ring(0.3)], "weld", 1
    ),
    "6-UPS": ([UPS] * 6, ring(0.4, 6), ring(0.3, 6, 0.3), "weld", 6),
}  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    ["five-bar", *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != "five-bar")],
)
def test_parallel_robots_closed_by_frames_have_their_degrees_of_freedom(kind, tmp_path):
    legs, feet, heads, closure, dof = KINDS[kind]
    path = tmp_path / "robot.urdf"
    path.write_text(legged(legs, feet, heads))
    loops = {(f"seat_{k}", f"tip_{k}"): closure for k in range(1, len(legs))}
    scene = load_robot(path, loops=loops)
    assert scene.warnings == ()
    assert stm.dynamics.rank(scene.system, scene.state0).dof == dof


def test_loops_of_unknown_links_and_kinds_are_refused(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(legged(["RRR", "RR"], *LINE))
    for loops, words in (
        ({("seat_1", "tip_9"): "weld"}, "not between .*tip_1"),
        ({("seat_1", "tip_1"): "rope"}, "not by 'rope'"),
    ):
        with pytest.raises(FileError, match=words):
            load_robot(path, loops=loops)


DRONE = """<mujoco><worldbody><body name="cf2"><freejoint/>
  <inertial pos="0 0 0" mass="0.027" diaginertia="1.4e-5 1.4e-5 2.2e-5"/>
  <body name="mount" pos="0 0 0.01">{sites}</body></body></worldbody><actuator>{motors}</actuator></mujoco>"""


def drone():
    places = [(0.028, -0.028), (-0.028, -0.028), (-0.028, 0.028), (0.028, 0.028)]
    sites = "".join(f'<site name="s{k}" pos="{x} {y} 0"/>' for k, (x, y) in enumerate(places))
    motors = "".join(
        f'<motor name="m{k}" site="s{k}" gear="0 0 1 0 0 {0.006 * (-1) ** k}"/>' for k in range(4)
    )
    return DRONE.format(sites=sites, motors=motors)


def test_thrust_sites_are_rotors_that_move_the_body_as_in_mujoco(mujoco, tmp_path):
    """Accelerations with unequal controls; hover's controls are a quarter of the weight each."""
    path = tmp_path / "drone.xml"
    path.write_text(drone())
    scene = load_robot(path)
    rotors = scene.system.forces[-1]
    assert isinstance(rotors, stm.uav.Rotors)
    assert any("m0, m1, m2, m3 at sites of 'cf2' are its rotors" in note for note in scene.notes)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    controls = np.array([0.07, 0.06, 0.066, 0.071])
    data.ctrl[:] = controls
    mujoco.mj_forward(model, data)
    system = stm.mechanics.with_inputs(scene.system, {"speed_squared": controls})
    found = stm.dynamics.evaluate(system, system.reference).accelerations
    np.testing.assert_allclose(found.v_rate[0], data.qacc[:3], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.omega_rate[0], data.qacc[3:], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_drone_of_a_urdf_hovers_with_rotors_at_its_frames(tmp_path):
    """A free base, links without mass for the propellers, as of the Crazyflie in packages."""
    places = [(0.028, -0.028), (-0.028, -0.028), (-0.028, 0.028), (0.028, 0.028)]
    parts = [link("base_link", 0.027)]
    for k, (x, y) in enumerate(places):
        parts += [
            link(f"prop{k}_link", 0.0),
            joint(f"prop{k}", "fixed", "base_link", f"prop{k}_link", (x, y, 0.0)),
        ]
    path = tmp_path / "cf2x.urdf"
    path.write_text(f'<robot name="cf2">{"".join(parts)}</robot>')
    scene = load_robot(path, floating=True)
    arms = [scene.frames[f"prop{k}_link"].position for k in range(4)]
    rotors = stm.uav.Rotors(
        "base_link",
        arms=arms,
        spin=[1, -1, 1, -1],
        k_f=3.16e-10,
        k_tau=7.94e-12,
        speed_squared=[2e8] * 4,
    )
    flying = scene.with_(rotors)
    space = stm.TreeSpace(flying.system)
    trim = stm.analysis.trim_condition(
        space, stm.analysis.hover(), at=space.from_state(flying.state0)
    )
    expected = 0.027 * 9.81 / (4 * 3.16e-10)
    np.testing.assert_allclose(trim.values, expected, rtol=1e-9)
