"""Robots of URDF: loops and mimics that MuJoCo's reader drops, floating roots, names of fixed links, masses."""

from typing import Any

import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.cli.main import main
from stmuav_jax.io import FileError, load_robot
from stmuav_jax.io.urdf_source import parse_xml, read_urdf


@pytest.fixture(autouse=True)
def mujoco(tmp_path, monkeypatch):
    # it writes its log into the present folder
    monkeypatch.chdir(tmp_path)
    return pytest.importorskip("mujoco")


def link(name, mass=0.3, place="0 0 .05", shapes=""):
    inertia = 'ixx="2e-4" iyy="3e-4" izz="2e-4" ixy="0" ixz="0" iyz="0"'
    inside = (
        f'<inertial><origin xyz="{place}"/><mass value="{mass}"/><inertia {inertia}/></inertial>'
    )
    return f'<link name="{name}">{inside if mass else ""}{shapes}</link>'


def pin(name, parent, child, place="0 0 0", more="", kind="continuous", axis="0 1 0"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def loop(tag="loop_joint", kind="continuous", second='link="rocker" xyz="0 0 .2"'):
    return (
        f'<{tag} name="shut" type="{kind}"><axis xyz="0 1 0"/>'
        f'<link1 link="rod" xyz=".4 0 0" rpy="0 0 0"/><link2 {second}/></{tag}>'
    )


def four_bar(*more):
    """Four-bar with its last pin left to `more`, on a plate that is fixed to the root."""
    return (
        '<robot name="bars"><link name="root"/>'
        + link("plate", 0.0) + pin("bolt", "root", "plate", "0 0 1", kind="fixed")
        + link("crank") + link("rod", 0.5, ".2 0 0") + link("rocker")
        + pin("a", "plate", "crank") + pin("b", "crank", "rod", "0 0 .1")
        + pin("d", "plate", "rocker", ".4 0 -.1") + "".join(more) + "</robot>"
    )  # fmt: skip


def robot(tmp_path, text, **options):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    return load_robot(path, **options)


@pytest.mark.parametrize("tag", ["loop_joint", "drake:loop_joint"])
def test_a_loop_joint_closes_its_loop(tmp_path, tag):
    """By hand: three moving bars on four pins have one degree of freedom; the crank's turn decides."""
    scene = robot(tmp_path, four_bar(loop(tag)))
    assert scene.warnings == ()
    joint = scene.system.joints[-1]
    assert (joint.name, joint.kind, joint.body_i, joint.body_j) == (
        "shut",
        "revolute",
        "rod",
        "rocker",
    )
    assert stm.dynamics.rank(scene.system, scene.state0).dof == 1
    # the pin is where both links have it, about their common axis
    kin = scene.system.kinematics(scene.state0)
    for body, point in ((joint.body_i, joint.point_i), (joint.body_j, joint.point_j)):
        np.testing.assert_allclose(kin.point(body, point)[0], [0.4, 0.0, 1.1], atol=1e-12)
    motion = stm.mechanics.joint_motion(scene.system, scene.state0, "shut")
    assert float(motion.angle) == pytest.approx(0.0, abs=1e-12)


def test_a_loop_that_is_open_at_the_start_is_assembled(tmp_path):
    scene = robot(tmp_path, four_bar(loop(second='link="rocker" xyz="0.01 0 .2"')))
    joint, kin = scene.system.joints[-1], scene.system.kinematics(scene.state0)
    ends = [kin.point(joint.body_i, joint.point_i)[0], kin.point(joint.body_j, joint.point_j)[0]]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
    assert any(
        "The start is not at qpos0, where loops are open by 0.01 m" in note for note in scene.notes
    )


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (loop(kind="planar"), "its type is 'planar'"),
        (loop(second='link="nobody"'), "its <link2> names no link"),
        (loop(second='link="rocker" xyz="0 0"'), "'0 0' are not three finite numbers"),
        (loop(second='link="rod" xyz="0 0 .2"'), "joins two parts of 'rod'"),
    ],
)
def test_an_incomplete_loop_joint_is_a_warning_by_its_name(tmp_path, broken, reason):
    scene = robot(tmp_path, four_bar(broken))
    (warning,) = scene.warnings
    assert "'shut'" in warning
    assert reason in warning
    assert len(scene.system.joints) == 3


def dial(more, kind="continuous"):
    return four_bar(link("dial") + pin("g", "plate", "dial", "0 .1 0", more, kind))


@pytest.mark.slow
def test_a_mimic_couples_both_joints(tmp_path):
    """Of the four joints of the open chains one follows another, from a start that fulfils it."""
    scene = robot(tmp_path, dial('<mimic joint="a" multiplier="-0.5" offset="0.3"/>'))
    assert scene.warnings == ()
    joint = scene.system.joints[-1]
    assert (joint.name, joint.kind) == ("g_mimic", "mimic_angle_by_angle")
    assert stm.dynamics.rank(scene.system, scene.state0).dof == 3
    a, g = (
        float(stm.mechanics.joint_motion(scene.system, scene.state0, name).angle) for name in "ag"
    )
    assert g == pytest.approx(-0.5 * a + 0.3, abs=1e-9)


@pytest.mark.parametrize(
    ("more", "kind"),
    [('<mimic joint="nobody"/>', "continuous"), ('<mimic joint="a"/>', "floating")],
)
def test_a_mimic_that_couples_nothing_is_a_warning_with_both_joints(tmp_path, more, kind):
    (warning,) = robot(tmp_path, dial(more, kind)).warnings
    assert "joint 'g' mimics joint" in warning


def test_equalities_of_mjcf_are_couplings_or_warnings_with_their_joints(tmp_path):
    shape = '<geom type="box" size=".1 .05 .2" mass="1"/>'
    bodies = "".join(
        f'<body pos="{k} 0 0">{shape}<joint name="{n}"/></body>' for k, n in enumerate("abc")
    )
    text = (
        f"<mujoco><worldbody>{bodies}</worldbody>"
        '<tendon><fixed name="t"><joint joint="b" coef="1"/><joint joint="c" coef="2"/></fixed></tendon>'
        '<equality><joint name="gear" joint1="a" joint2="b" polycoef="0 3 0 0 0"/><tendon name="rope" tendon1="t"/>'
        '<joint name="curved" joint1="c" joint2="b" polycoef="0 1 2 0 0"/>'
        '<joint name="off" joint1="a" joint2="c" active="false"/></equality></mujoco>'
    )
    path = tmp_path / "robot.xml"
    path.write_text(text)
    scene = load_robot(path)
    rope, curved = scene.warnings
    gear: Any = scene.system.joints[-1]
    assert (gear.name, gear.mate.joint.name, float(gear.mate.ratio)) == ("gear", "b", 3.0)
    assert "the equality 'curved' that couples joint 'c' and joint 'b'" in curved
    assert "the equality 'rope' that couples joint 'b' and joint 'c'" in rope
    assert "Left out, equality constraints that are switched off: off." in scene.notes


def test_unknown_elements_are_named_with_their_owners(tmp_path):
    more = "<transmission name='drive'/><spring_joint name='s'/>"
    text = four_bar(loop(), more).replace(
        '<axis xyz="0 1 0"/></joint>', '<axis xyz="0 1 0"/><gear/></joint>', 1
    )
    scene = robot(tmp_path, text)
    assert "Left out, elements <transmission>: drive." in scene.notes
    assert set(scene.warnings) == {
        "Lost, unknown elements <spring_joint>: s.", "Lost, unknown elements <gear>: bolt.",
    }  # fmt: skip


def test_a_link_without_inertial_has_the_mass_of_its_shapes_said(tmp_path):
    box = '<collision><geometry><box size=".1 .1 .2"/></geometry></collision>'
    scene = robot(
        tmp_path, four_bar(loop(), link("tool", 0.0, shapes=box), pin("t", "rod", "tool"))
    )
    (warning,) = scene.warnings
    assert warning.startswith("The link 'tool' has no <inertial>: its mass of 2 kg is that of its")


def test_links_of_ground_and_of_bodies_keep_their_names(tmp_path):
    tip = link("tip", 0.1) + pin("glue", "rod", "tip", ".4 0 0", kind="fixed")
    scene = robot(tmp_path, four_bar(tip))
    assert set(scene.frames) == {"root", "plate", "tip"}
    assert (scene.frames["plate"].body, scene.frames["tip"].body) == ("ground", "rod")
    np.testing.assert_allclose(scene.frames["plate"].position, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(scene.frames["tip"].position, [0.4, 0, 0], atol=1e-15)
    assert float(scene.system.bodies.mass[scene.system.index("rod")]) == pytest.approx(0.6)


LEGGED = (
    '<robot name="walker">'
    + link("torso", 5)
    + link("leg", 1)
    + pin("hip", "torso", "leg")
    + "</robot>"
)
DRONE = (
    '<robot name="drone">' + link("hull", 0.04) + link("prop", 0.0)
    + pin("p", "hull", "prop", ".03 0 0", kind="fixed") + "</robot>"
)  # fmt: skip


def test_a_root_on_ground_is_said_and_floats_if_asked_for(tmp_path):
    fixed = robot(tmp_path, LEGGED)
    assert fixed.system.names == ("leg",)
    assert any("root link 'torso' is fixed to ground, with 5 kg" in note for note in fixed.notes)
    assert not any("root link" in note for note in robot(tmp_path, LEGGED, floating=False).notes)
    free = robot(tmp_path, LEGGED, floating=True)
    assert free.system.names == ("torso", "leg")
    assert stm.dynamics.rank(free.system, free.state0).dof == 7
    assert not any("root link" in note for note in free.notes)
    second = robot(tmp_path, LEGGED.replace("</robot>", link("stray") + "</robot>"))
    assert any(text.startswith("The link 'stray' is no joint's child") for text in second.warnings)


def test_a_drone_floats_and_its_refusal_names_the_option(tmp_path, capsys):
    with pytest.raises(
        FileError,
        match=r"The model has no body that can move\. Its root link 'hull' .*floating=True",
    ):
        robot(tmp_path, DRONE)
    path = str(tmp_path / "robot.urdf")
    assert main(["check", path, "--no-cache"]) == 2
    assert "--floating" in capsys.readouterr().err
    assert main(["check", path, "--floating", "--no-cache"]) == 0
    drone = robot(tmp_path, DRONE, floating=True)
    assert drone.system.names == ("hull",)
    assert float(drone.system.bodies.mass[0]) == 0.04
    assert main(["check", "pendulum", "--floating", "--no-cache"]) == 2
    (tmp_path / "robot.xml").write_text("<mujoco/>")
    with pytest.raises(FileError, match="'floating' is for the root link of a URDF"):
        load_robot(tmp_path / "robot.xml", floating=True)


def test_a_link_without_mass_between_two_hinges_is_refused_or_gets_its_share(tmp_path):
    text = (
        '<robot name="arm">' + link("base") + link("cross", 0.0) + link("hand")
        + pin("first", "base", "cross", axis="1 0 0") + pin("second", "cross", "hand") + "</robot>"
    )  # fmt: skip
    with pytest.raises(
        FileError, match=r"link 'cross' moves between joints without mass.*link_share"
    ):
        robot(tmp_path, text)
    scene = robot(tmp_path, text, link_share=1e-9)
    assert scene.links_between == ("cross",)
    assert any("Links without mass" in note and "cross" in note for note in scene.notes)
    assert float(scene.system.bodies.mass[0]) == pytest.approx(0.6e-9)
    # a mass that the file states stays, whatever the share
    dense = text.replace(link("cross", 0.0), '<link name="cross"><inertial><mass value="{}"/><inertia ixx="0" '
                         'iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>')  # fmt: skip
    with pytest.raises(FileError, match=r"link 'cross' has a mass, but no inertia"):
        robot(tmp_path, dense.format(0.2))
    scene = robot(tmp_path, dense.format(0.2), link_share=1e-9)
    np.testing.assert_allclose(scene.system.bodies.mass, [0.2, 0.3])
    assert any("Links without inertia" in note and "cross" in note for note in scene.notes)
    with pytest.raises(
        FileError, match="mass of the link 'cross' must not be negative, but it is -1"
    ):
        robot(tmp_path, dense.format(-1), link_share=1e-9)
    floating = robot(
        tmp_path, text.replace(link("base"), link("base", 0.0)), link_share=1e-9, floating=True
    )
    assert not any("collision shapes" in warning for warning in floating.warnings)


def test_meshes_without_mass_may_be_absent(tmp_path):
    shape = '<geom type="mesh" mesh="shell" {}/><geom type="box" size=".1 .1 .02" mass="1.2"/>'
    text = (
        '<mujoco><compiler {}/><asset><mesh file="shell.obj"/></asset><worldbody>'
        '<body name="hull">{}<freejoint/>{}</body></worldbody></mujoco>'
    )
    path, inertial = tmp_path / "drone.xml", '<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>'
    for weightless in ('mass="0"', 'density="0"', 'group="4"'):
        compiler = 'inertiagrouprange="0 2"' if "group" in weightless else ""
        path.write_text(text.format(compiler, "", shape.format(weightless)))
        mass = load_robot(path).system.bodies
        assert float(mass.mass[0]) == pytest.approx(1.2)
        # a box of 0.2 x 0.2 x 0.04 m
        np.testing.assert_allclose(
            np.diag(mass.inertia[0]),
            [1.2 * 0.0416 / 12, 1.2 * 0.0416 / 12, 1.2 * 0.08 / 12],
            rtol=1e-9,
        )
    path.write_text(text.format("", "", shape.format("")))
    with pytest.raises(FileError, match=r"meshes of 'hull' are needed, because .* no <inertial>"):
        load_robot(path)
    # shapes that overrule <inertial> are needed too
    path.write_text(text.format('inertiafromgeom="true"', inertial, shape.format("")))
    with pytest.raises(FileError, match="Error opening file"):
        load_robot(path)


def test_a_floating_joint_of_the_file_floats(tmp_path):
    """MuJoCo wants its parent fused with the world, whose links then have no names for loops."""
    text = (
        '<robot name="r">' + link("world_frame", 0.0) + link("hull") + link("arm")
        + pin("float", "world_frame", "hull", kind="floating") + pin("turn", "hull", "arm")
        + loop(second='link="arm"').replace("rod", "world_frame") + "</robot>"
    )  # fmt: skip
    scene = robot(tmp_path, text)
    assert scene.system.names == ("hull", "arm")
    assert stm.dynamics.rank(scene.system, scene.state0).dof == 7
    (warning,) = scene.warnings
    assert "'shut' acts on the link 'world_frame', which MuJoCo's reader has fused" in warning


def test_entities_are_refused(tmp_path):
    secret = '<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    with pytest.raises(FileError, match="declares the entity 'x'"):
        robot(tmp_path, secret + LEGGED.replace("walker", "&x;"))
    with pytest.raises(stm.ModelError, match="XML cannot be read"):
        parse_xml(b"<robot><link></robot>")
    assert read_urdf(parse_xml(LEGGED.encode())).root == "torso"
