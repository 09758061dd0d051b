"""Robots in MJCF or URDF, read by MuJoCo's own parser and compiler, as scenes.

A body of MuJoCo may have several joints: here a link of nearly no mass is between each two of them.
Bodies without joints become part of the body that carries them. docs/models.md lists what is left
out; MuJoCo is an optional extra of the package.
"""

import contextlib
import dataclasses
import importlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..checks.errors import ModelError, SettingError, StateError, nearest_names
from ..checks.numbers import as_floats
from ..dynamics.assembly.initial import assemble
from ..dynamics.simulation import Frame, Scene
from ..math.rotation import from_matrix_in, rotation_matrix_in
from ..mechanics import joint as joints
from ..mechanics.body import GROUND, Body
from ..mechanics.forces import Gravity, JointDamping, TorsionalSpringDamper
from ..mechanics.inputs import inputs_of
from ..mechanics.joint import Joint
from ..mechanics.joint_forces import JointEffort, JointServo
from ..mechanics.load import AbstractForce
from ..mechanics.system import System
from ..uav.allocation import RotorLimits
from ..uav.motor import MotorRotors
from ..uav.rotor import Rotors
from .mujoco_export import LeftOut
from .netcdf import FileError, regular_file
from .urdf_source import LoopJoint, Mimic, UrdfSource, massless_body, parse_xml, read_urdf

# Mass and inertia of the links between several joints of a body, as a share of the body's own.
LINK_SHARE = 1e-12
# Largest opening of a loop [m] or [1] at the reference posture that counts as closed.
_CLOSED = 1e-9
_FREE, _BALL, _SLIDE, _HINGE = range(4)
_CONNECT, _WELD = range(2)
_OF_JOINTS, _OF_TENDONS, _WRAPS_JOINT = 2, 3, 1
_OF_SITES = 6
_AT_SITE = 4
# Largest part of a thrust across the body's z axis, and difference between thrusts, that count as none.
_UPRIGHT = 1e-6
# Radius of gyration of a link without mass that gets a share of the robot's [m].
_SHARE_RADIUS = 0.1


def load_robot(
    path: str | os.PathLike[str],
    *,
    link_share: float | None = None,
    floating: bool | None = None,
    loops: Mapping[tuple[str, str], str] | None = None,
) -> Scene:
    """Scene of a robot's MJCF or URDF file, at the posture of its `qpos0`, at rest.

    A URDF's `loop_joint` (Drake, RigidBodyDynamics.jl) closes its loop. Losses that change the motion, such as
    an incomplete loop, are in `scene.warnings`, all else that is left out in `scene.notes`.

    Args:
        link_share: mass and inertia of a link between two joints of one body, as a share of the
            body's own; by default 1e-12. If it is given, links without mass that move get this share of
            the robot's mass, and its moment at 0.1 m.
        floating: of a URDF, True lets its root link float, False fixes it to ground; by default it is
            fixed, with a note. In MJCF its joints determine this.
        loops: kind of joint ("spherical", "weld", "revolute" or "translational", about or along z) that holds
            each pair of links or bodies together by their frames, which closes loops that the file leaves open.

    Raises:
        FileError: MuJoCo is not installed, or it cannot read the file; a body has no mass; or a loop names
            an unknown link or kind.
    """
    try:
        mujoco = _import_mujoco()
    except ImportError:
        raise FileError(
            f"{path}: reading MJCF and URDF needs MuJoCo: pip install '.[exchange]' in a checkout."
        ) from None
    source = regular_file(path)
    try:
        # MuJoCo's reader drops elements of a URDF that it does not know, loops and mimics among
        # them: the text is read beside it, so that nothing is lost without a word.
        robot = parse_xml(source.read_bytes())
        urdf = read_urdf(robot) if robot.tag == "robot" else None
        if urdf is None and floating is not None:
            raise SettingError(
                "'floating' is for the root link of a URDF; a body of MJCF floats by its <freejoint/>."
            )
        massless: dict[str, float] = {}
        # Warnings of the compiler are about the file and belong to its scene: printed by MuJoCo
        # they would be lost, or written to a file in the user's folder.
        with _collected_warnings(mujoco) as warned:
            try:
                spec = _read_specification(source, urdf, floating)
                model = _compile_model(spec, source, urdf, floating, link_share, massless)
            except (ValueError, mujoco.FatalError, UserWarning) as error:
                # a warning of MuJoCo is raised where warnings are errors
                advice = _advise_error(source, str(error))
                raise FileError(f"{source}: MuJoCo cannot read it: {error}{advice}") from error
        if nans := [warning_text for warning_text in warned if "NaN" in warning_text]:
            # MuJoCo goes on with a default in its place, such as the mass of the body's shape
            raise FileError(
                f"{source}: a number is NaN; write the number that is meant. MuJoCo: {nans[0]}"
            )
        # A link between two hinges of one body has no mass in MuJoCo. A share that is far below
        # round-off of the motion lets each joint have two bodies, as joints have here.
        share = LINK_SHARE if link_share is None else link_share
        closures = _closures_of_frames(loops or {}, model)
        if urdf is not None:
            # what such a link weighs is its share, not that of its shapes
            shaped = tuple(link for link in urdf.without_inertial if link not in massless)
            urdf = urdf._replace(without_inertial=shaped)
        scene = _make_scene(model, source.stem, share, urdf, floating, closures)
    except (ModelError, SettingError, StateError) as error:
        raise FileError(f"{source}: {error}") from error
    notes = (*scene.notes, *(f"MuJoCo: {warning_text}" for warning_text in warned))
    scene = dataclasses.replace(scene, notes=notes)
    if not massless:
        return scene
    sentences = [
        f"Links without {lack} {share:g} of the robot's mass (link_share){place}: {', '.join(names)}."
        for lack, place, names in (
            ("mass have", "", [name for name, mass in massless.items() if not mass]),
            ("inertia have the moment of", f" at {_SHARE_RADIUS:g} m", [n for n, m in massless.items() if m]),
        ) if names
    ]  # fmt: skip
    links_between = (*scene.links_between, *massless)
    return dataclasses.replace(scene, notes=(*scene.notes, *sentences), links_between=links_between)


@contextlib.contextmanager
def _collected_warnings(mujoco: Any) -> Iterator[list[str]]:
    """List of what MuJoCo warns of within the context.

    By itself MuJoCo prints warnings, and writes them to MUJOCO_LOG.TXT in the current folder.
    """
    warned: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: warned.append(" ".join(str(message).split())))
    try:
        yield warned
    finally:
        mujoco.set_mju_user_warning(before)


def _read_specification(source: Path, urdf: UrdfSource | None, floating: bool | None) -> Any:
    """Specification of a file; of a URDF with its fixed links, and with a root that floats if asked for."""
    spec = _import_mujoco().MjSpec.from_file(str(source))
    if urdf is not None:
        # links that are fused lose their names, but a free joint needs its parent fused with the world
        spec.compiler.fusestatic = urdf.has_floating_joint
        if floating:
            spec.body(urdf.root).add_freejoint()
    return spec


def _compile_model(
    spec: Any,
    source: Path,
    urdf: UrdfSource | None,
    floating: bool | None,
    share: float | None,
    massless: dict[str, float],
) -> Any:
    """Compiled model: without files that do not matter where they are absent, with shares of mass.

    Args:
        massless: mapping to which the names of the bodies are added that get a share of mass, or of
            inertia beside the mass that they have [kg].
    """
    reduced = False
    while True:
        try:
            # Relative to the whole robot: a given mass would be heavy for a gripper and lost beside an
            # excavator.
            stated = [b.mass for b in spec.bodies if b.explicitinertial and b.mass > 0]
            added = (share or 0.0) * (sum(stated) or 1.0)
            for name, mass in massless.items():
                body = spec.body(name)
                body.explicitinertial, body.mass = True, mass or added
                body.inertia = [added * _SHARE_RADIUS**2] * 3
                body.fullinertia = [np.nan] * 6
            return spec.compile()
        except ValueError as error:
            name = massless_body(str(error))
            mass = _stated_mass(spec, name) if name else 0.0
            if share is not None and name and name not in massless and mass >= 0:
                massless[name] = mass
            elif name is None and not reduced:
                # files of meshes are often absent, and matter only where they give a body its inertia
                reduced = True
            else:
                raise
            spec = _read_specification(source, urdf, floating)
            spec = _without_meshes(spec) if reduced else spec


def _stated_mass(spec: Any, name: str) -> float:
    """Mass [kg] that a file states of a body; zero where it states none."""
    body = None if spec is None else spec.body(name)
    return float(body.mass) if body is not None and body.explicitinertial else 0.0


def _advise_error(source: Path, message: str) -> str:
    """Sentence on what to do about an error of MuJoCo's compiler; empty if there is none."""
    spec, name = None, massless_body(message)
    with contextlib.suppress(ValueError, UserWarning):
        spec = _import_mujoco().MjSpec.from_file(str(source))
    if name:
        mass = _stated_mass(spec, name)
        if mass < 0:
            return f" The mass of the link '{name}' must not be negative, but it is {mass:g} kg."
        lack = "has a mass, but no inertia" if mass else "moves between joints without mass"
        return (
            f" The link '{name}' {lack}: give it a mass and an inertia, or load_robot(path, "
            "link_share=1e-9), which gives such links this share of the robot's mass."
        )
    if spec is not None and "Error opening file" in message:
        needed = dict.fromkeys(
            geom.parent.name for geom in spec.geoms if _is_needed_mesh(spec, geom)
        )
        if needed:
            return (
                f" The meshes of {', '.join(map(repr, needed))} are needed, because these bodies have no "
                "<inertial>: give them one, or the files."
            )
    return ""


def _import_mujoco() -> Any:
    """MuJoCo's Python package: compiled, so that its names have no types."""
    return importlib.import_module("mujoco")


def _is_needed_mesh(spec: Any, geom: Any) -> bool:
    """True if a body takes mass or inertia from a shape of a mesh's or a height field's file."""
    mujoco = _import_mujoco()
    if geom.type not in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD):
        return False
    # MuJoCo's own rule decides which bodies take their inertia from shapes; only the meshes of those are
    # needed.
    rule = spec.compiler.inertiafromgeom
    by_shapes = rule == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    never = rule == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    first, last = spec.compiler.inertiagrouprange
    weighs = geom.density != 0 if np.isnan(geom.mass) else geom.mass != 0
    weighs = weighs and first <= geom.group <= last and geom.parent.name != "world"
    return bool(weighs and not never and (by_shapes or not geom.parent.explicitinertial))


def _without_meshes(spec: Any) -> Any:
    """Specification without pictures, and without meshes that give no body its inertia."""
    mujoco = _import_mujoco()
    files = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)
    for geom in list(spec.geoms):
        if geom.type in files and not _is_needed_mesh(spec, geom):
            spec.delete(geom)
        else:
            geom.material = ""
    used = {geom.meshname for geom in spec.geoms}
    loose = [mesh for mesh in spec.meshes if mesh.name not in used]
    for element in [*loose, *spec.hfields, *spec.skins, *spec.materials, *spec.textures]:
        spec.delete(element)
    return spec


class _Pose(NamedTuple):
    """Position (3,) [m] and rotation matrix (3, 3) of a frame in the world."""

    r: np.ndarray
    R: np.ndarray

    def of(self, r: np.ndarray, R: np.ndarray) -> "_Pose":
        """Pose in the world of a frame with this pose in here."""
        return _Pose(self.r + self.R @ r, self.R @ R)

    def inside(self, other: "_Pose") -> "_Pose":
        """Pose of another frame in this one."""
        return _Pose(self.R.T @ (other.r - self.r), self.R.T @ other.R)


def _quaternion_matrix(quaternion: np.ndarray) -> np.ndarray:
    return np.asarray(rotation_matrix_in(np, quaternion))


_WORLD = _Pose(np.zeros(3), np.eye(3))


class _Reader(NamedTuple):
    """Model of MuJoCo, with the poses of its bodies at qpos0 and their names in here."""

    model: Any
    poses: list[_Pose]
    names: list[str]

    def root(self, number: int) -> int:
        """Number of the body of which a body is part; 0, for ground, if it cannot move."""
        # MuJoCo's bodies without joints are welded to their parents; here they are parts of one
        # body, since a weld of its own would be a constraint to solve.
        root = int(self.model.body_weldid[number])
        return 0 if self.model.body_mocapid[root] >= 0 else root

    def body(self, number: int) -> str:
        """Name of the body of which a body is part, or ground."""
        return self.names[self.root(number)]

    def joint(self, name: str, kind: str, bodies: Sequence[str], i: _Pose, j: _Pose) -> Joint:
        """Joint between two bodies, by its poses in their frames."""
        return Joint(
            name=name, kind=kind, body_i=bodies[0], body_j=bodies[1], in_world=False,
            point_i=as_floats(i.r), point_j=as_floats(j.r),
            frame_i=as_floats(i.R), frame_j=as_floats(j.R), length=as_floats(0.0),
        )  # fmt: skip

    def inside(self, number: int, r: np.ndarray, R: np.ndarray) -> _Pose:
        """Pose, in the frame of the body of which a body is part, of a frame on the latter."""
        return self.poses[self.root(number)].inside(self.poses[number].of(r, R))


def _check_finite(model: Any) -> None:
    """Raise `ModelError` where MuJoCo's parser has let a place or a mass pass that is not finite."""
    of_body = {
        "body_pos": "position", "body_quat": "orientation", "body_ipos": "centre of mass",
        "body_iquat": "principal axes", "body_mass": "mass", "body_inertia": "inertia",
    }  # fmt: skip
    of_joint = {"jnt_pos": "position", "jnt_axis": "axis"}
    for kind, names, accessor in (("body", of_body, model.body), ("joint", of_joint, model.joint)):
        for name, quantity_name in names.items():
            rows = np.asarray(getattr(model, name))
            bad = (~np.isfinite(rows)).any(axis=tuple(range(1, rows.ndim)))
            if np.any(bad):
                k = int(np.argmax(bad))
                raise ModelError(
                    f"The {quantity_name} of the {kind} '{accessor(k).name or k}' must be finite, but it is "
                    f"{rows[k].tolist()}."
                )


def scene_from_mujoco(model: Any, name: str = "robot", *, link_share: float = LINK_SHARE) -> Scene:
    """Scene of a compiled `mujoco.MjModel`; what cannot be carried over is in its notes.

    Actuators with a fixed gain on a hinge or slide are inputs: efforts, or targets of position
    servos. The notes list the actuator of each input, and the unit of its control.

    Args:
        name: name of the scene. link_share: see `load_robot`.

    Raises:
        ModelError: no body moves, or the masses and inertias are not those of rigid bodies.
        StateError: the loops cannot be closed near qpos0.
    """
    return _make_scene(model, name, link_share, None, None, ())


# what overflows is refused by the body or the joint that it is part of
@np.errstate(over="ignore", invalid="ignore")
def _make_scene(
    model: Any,
    name: str,
    link_share: float,
    urdf: UrdfSource | None,
    floating: bool | None,
    closures: tuple[LoopJoint, ...],
) -> Scene:
    """Scene of a compiled model, of what its URDF says beyond that, and of further closures of loops."""
    _check_finite(model)
    # Poses at qpos0 are composed from the root outwards, as MuJoCo stores them relative to the parent.
    poses = [_WORLD]
    for b in range(1, model.nbody):
        parent = poses[model.body_parentid[b]]
        poses.append(parent.of(model.body_pos[b], _quaternion_matrix(model.body_quat[b])))
    names = [GROUND, *(model.body(b).name or f"body_{b}" for b in range(1, model.nbody))]
    names = [f"{entry}_body" if k and entry == GROUND else entry for k, entry in enumerate(names)]
    reader, left_out = _Reader(model, poses, names), LeftOut({}, [])
    # What the model's own options switch off, such as "GRAVITY".
    bits, flags = _import_mujoco().mjtDisableBit.__members__, int(model.opt.disableflags)
    disabled_flags = {k.removeprefix("mjDSBL_") for k, bit in bits.items() if flags & int(bit)}
    _add_left_out(model, left_out, disabled_flags)
    # MuJoCo has an equality for a mimic, which is soft; the URDF's own numbers make an exact one.
    mimics = {} if urdf is None else {(m.joint, m.leader): m for m in urdf.mimics}
    bodies: list[Body] = []
    joints_by_number: dict[int, Joint] = {}
    between: list[str] = []
    for b in range(1, model.nbody):
        if reader.root(b) == b:
            chain_bodies, links = _make_body(reader, b, link_share)
            bodies += chain_bodies
            between += [entry.name for entry in chain_bodies[:-1]]
            joints_by_number |= links
    equalities = range(0 if disabled_flags & {"EQUALITY", "CONSTRAINT"} else model.neq)
    built = [_make_loop(reader, k, left_out, joints_by_number, mimics) for k in equalities]
    built += [_mimic(m, joints_by_number, left_out) for m in mimics.values()]
    closures = (*(() if urdf is None else urdf.loops), *closures)
    built += [_loop_of_urdf(reader, closure, left_out) for closure in closures]
    loops = [loop for loop in built if loop is not None]
    # Gravity is an option of MuJoCo's model and a force here, so that a system without it has
    # none.
    forces: list[AbstractForce] = (
        [] if "GRAVITY" in disabled_flags else [Gravity(model.opt.gravity)]
    )
    for number, joint in joints_by_number.items():
        forces += _passive_forces(model, number, joint, disabled_flags)
    passive, every = len(forces), range(0 if "ACTUATION" in disabled_flags else model.nu)
    actuators = [_make_actuator(model, a, joints_by_number, left_out) for a in every]
    driven = [(a, entry) for a, entry in enumerate(actuators) if entry is not None]
    forces += [force for _, entry in driven for force in entry.forces]
    weight = sum(body.mass for body in bodies) * np.linalg.norm(
        [0.0, 0.0, 0.0] if "GRAVITY" in disabled_flags else model.opt.gravity
    )
    thrusters, thruster_notes = _thrusters(reader, every, float(weight), left_out)
    forces += thrusters
    fixed = sum(float(model.body_mass[b]) for b in range(1, model.nbody) if reader.root(b) == 0)
    if not bodies:
        option = (
            f" Its root link '{urdf.root}' is fixed to ground: load_robot(path, floating=True), in "
            "commands --floating, lets it float."
            if urdf is not None and fixed > 0 and not floating
            else ""
        )
        raise ModelError(f"The model has no body that can move.{option}")
    notes = thruster_notes
    if urdf is not None:
        if floating is None and fixed > 0:
            notes.append(
                f"The root link '{urdf.root}' is fixed to ground, with {fixed:.6g} kg: "
                "load_robot(path, floating=True), in commands --floating, lets it float."
            )
        notes += urdf.notes
        left_out.lost.extend(urdf.lost)
        # MuJoCo gives these links the mass of their collision shapes.
        shape_masses = {model.body(b).name: float(model.body_mass[b]) for b in range(model.nbody)}
        left_out.lost.extend(
            f"The link '{name}' has no <inertial>: its mass of {shape_masses[name]:.6g} kg is "
            "that of its collision shapes at 1000 kg/m^3."
            for name in urdf.without_inertial
            if shape_masses.get(name, 0.0) > 0
        )
    # Loops get names that no joint has.
    joint_names = {joint.name for joint in joints_by_number.values()}
    loops = [
        dataclasses.replace(x, name=f"{x.name}_loop") if x.name in joint_names else x for x in loops
    ]
    system = System(bodies, [*joints_by_number.values(), *loops], forces)
    # Loops that the file leaves open by rounding are closed at the start: soft equalities tolerate
    # a gap, rigid joints do not.
    state = system.reference
    open_by = max((_measure_opening(system, loop) for loop in loops), default=0.0)
    if open_by > _CLOSED:
        state = assemble(system, state).state
        distances = np.linalg.norm(np.asarray(state.r) - np.asarray(system.reference.r), axis=1)
        farthest = int(np.argmax(distances))
        notes.append(
            f"The start is not at qpos0, where loops are open by {open_by:.2g} m or rad: closing them moves "
            f"the body '{system.names[farthest]}' by {distances[farthest]:.2g} m."
        )
    # Bodies without joints are frames in the bodies that they are part of.
    merged = [b for b in range(1, model.nbody) if reader.root(b) != b]
    merged_poses = [reader.inside(b, np.zeros(3), np.eye(3)) for b in merged]
    return Scene(
        name=name, title=f"{name}, from MuJoCo's model", system=system, state0=state,
        links_between=tuple(between),
        notes=(*_describe_inputs(system, model, driven, passive), *notes, *left_out.sentences()),
        warnings=tuple(left_out.lost),
        frames={
            names[b]: Frame(reader.body(b), pose.r, pose.R)
            for b, pose in zip(merged, merged_poses, strict=True)
        },
    )  # fmt: skip


def _describe_loss(constraint: str) -> str:
    return (
        f"Lost, a constraint: {constraint} has no counterpart here, and the mechanism has more degrees "
        "of freedom than the file's."
    )


def _make_body(reader: _Reader, b: int, share: float) -> tuple[list[Body], dict[int, Joint]]:
    """Body with its links and joints; those of bodies without joints on it are part of it."""
    model, pose = reader.model, reader.poses[b]
    parts = [k for k in range(model.nbody) if reader.root(k) == b]
    mass = model.body_mass[parts]
    frames = [
        pose.inside(reader.poses[k].of(model.body_ipos[k], _quaternion_matrix(model.body_iquat[k])))
        for k in parts
    ]
    # Bodies without joints are rigidly part of their parent: masses and inertias are combined by the
    # parallel axis theorem.
    com = mass @ np.array([frame.r for frame in frames]) / np.sum(mass)
    inertia = np.zeros((3, 3))
    for k, m, frame in zip(parts, mass, frames, strict=True):
        arm = frame.r - com
        inertia += frame.R @ np.diag(model.body_inertia[k]) @ frame.R.T
        inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    # Products of rotations leave an asymmetry of round-off, which the check of the tensor would report.
    inertia = 0.5 * (inertia + inertia.T)
    first, count = int(model.body_jntadr[b]), int(model.body_jntnum[b])
    numbers = range(first, first + count)
    free = any(model.jnt_type[j] == _FREE for j in numbers)
    place: dict[str, Any] = {
        "com": com,
        "position": pose.r,
        "orientation": from_matrix_in(np, pose.R),
    }
    name = reader.names[b]
    # Several joints of one body become a chain of links, in MuJoCo's order: from the parent
    # outwards.
    before, bodies, links = reader.body(int(model.body_parentid[b])), [], {}
    for j in () if free else numbers:
        last = j == numbers[-1]
        after = name if last else f"{name}_link_{j - numbers[0] + 1}"
        if not last:
            bodies.append(Body(after, share * np.sum(mass), share * inertia, **place))
        links[j] = _make_joint(reader, j, pose, before, after)
        before = after
    bodies.append(Body(name, np.sum(mass), inertia, free=free, **place))
    return bodies, links


def _make_joint(reader: _Reader, j: int, pose: _Pose, before: str, after: str) -> Joint:
    model = reader.model
    kind, name = model.jnt_type[j], model.joint(j).name or f"{after}_joint"
    at = pose.of(model.jnt_pos[j], np.eye(3))
    if kind == _BALL:
        # rotation vectors in the axes of the body, as MuJoCo's quaternions have them
        ball = joints.spherical(name, before, after, point=at.r)
        return dataclasses.replace(ball, frame_i=as_floats(pose.R), frame_j=as_floats(pose.R))
    make = joints.revolute if kind == _HINGE else joints.translational
    return make(name, before, after, point=at.r, axis=pose.R @ model.jnt_axis[j])


# --- what has no counterpart


def _add_left_out(model: Any, left_out: LeftOut, disabled_flags: set[str]) -> None:
    """Add everything of a compiled model that has no counterpart, but its loops and actuators.

    Args:
        off: names of what the model's own options switch off.
    """
    # What is left out is counted and named: a robot that stands by contact falls here, and the
    # notes give the reason.
    touching = int(np.sum((model.geom_contype != 0) | (model.geom_conaffinity != 0)))
    if touching and "CONTACT" not in disabled_flags:
        left_out.add(f"contacts between its {touching} shapes", "")
    # newer versions of MuJoCo have polynomial springs and dampers
    none = np.zeros((max(model.njnt, model.nv), 1))
    spring = getattr(model, "jnt_stiffnesspoly", none)
    yields = getattr(model, "jnt_springyield", none)
    damper = getattr(model, "dof_dampingpoly", none)
    for j in range(model.njnt):
        name, kind = model.joint(j).name or f"joint_{j}", model.jnt_type[j]
        dofs = slice(model.jnt_dofadr[j], model.jnt_dofadr[j] + {_FREE: 6, _BALL: 3}.get(kind, 1))
        checks = (
            ("limits of joints", model.jnt_limited[j]),
            ("dry friction in joints", np.any(model.dof_frictionloss[dofs])),
            ("armature of joints", np.any(model.dof_armature[dofs])),
            ("springs of ball and free joints", kind in (_FREE, _BALL) and model.jnt_stiffness[j]),
            ("damping of free joints", kind == _FREE and np.any(model.dof_damping[dofs])),
            ("nonlinear springs and dampers",
             np.any(spring[j]) or np.any(yields[j]) or np.any(damper[dofs])),
        )  # fmt: skip
        for feature, is_present in checks:
            if is_present:
                left_out.add(feature, name)
    for k in range(model.ntendon):
        left_out.add("tendons", model.tendon(k).name or f"tendon_{k}")
    for k in range(model.nbody):
        if model.body_gravcomp[k]:
            left_out.add("compensation of gravity", model.body(k).name)
        if model.body_mocapid[k] >= 0:
            left_out.add("motion capture, whose bodies stand still", model.body(k).name)
    for k in range(model.nu):
        is_damper = model.actuator_biasprm[k, 1] == 0 and model.actuator_biasprm[k, 2] != 0
        is_lost = model.actuator_forcelimited[k] and (is_damper or _effort_limit(model, k) is None)
        # those of a site are left to the rotors, which keep limits of their speeds
        if is_lost or (model.actuator_ctrllimited[k] and model.actuator_trntype[k] != _AT_SITE):
            left_out.add("limits of actuators", model.actuator(k).name)
    if model.opt.density or model.opt.viscosity:
        left_out.add("forces of the surrounding medium", "")
    for feature, count in (("flexible bodies", model.nflex), ("plugins", model.nplugin)):
        if count:
            left_out.add(feature, "")


# --- loops


def _make_loop(
    reader: _Reader,
    k: int,
    left_out: LeftOut,
    joints_by_number: dict[int, Joint],
    mimics: dict[tuple[str, str], Mimic],
) -> Joint | None:
    """Joint of an equality constraint; None, with a note or a lost constraint, if there is none like it.

    Args:
        mimics: those of a URDF, which are made from its text: an equality that stands for one makes none.
    """
    model = reader.model
    name, kind, data = model.equality(k).name or f"equality_{k}", model.eq_type[k], model.eq_data[k]
    if not model.eq_active0[k]:
        left_out.add("equality constraints that are switched off", name)
        return None
    # A polynomial between two joints is a constraint here if it is linear, which gears are.
    if kind not in (_CONNECT, _WELD):
        coupled = _coupled_joints(model, k)
        if len(coupled) == 2 and tuple(coupled) in mimics:
            return None
        text = " and ".join(f"joint '{joint}'" for joint in coupled) or "what it acts on"
        numbers = [int(x) for x in (model.eq_obj1id[k], model.eq_obj2id[k])]
        turning = all(
            j in joints_by_number and model.jnt_type[j] in (_SLIDE, _HINGE) for j in numbers
        )
        if kind == _OF_JOINTS and turning and not np.any(data[2:5]):
            # MuJoCo's polynomial is between the departures from qpos0, where coordinates are zero here
            pair = [joints_by_number[j] for j in numbers]
            return joints.mimic(name, *pair, ratio=float(data[1]), offset=float(data[0]))
        left_out.lost.append(_describe_loss(f"the equality '{name}' that couples {text}"))
        return None
    ends = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    if model.eq_objtype[k] == _OF_SITES:
        sites = [(model.site_pos[s], _quaternion_matrix(model.site_quat[s])) for s in ends]
        ends = tuple(int(model.site_bodyid[s]) for s in ends)
    elif kind == _CONNECT:
        sites = [(data[:3], np.eye(3)), (data[3:6], np.eye(3))]
    else:
        sites = [(data[3:6], _quaternion_matrix(data[6:10])), (data[:3], np.eye(3))]
    i, j = (reader.inside(b, *site) for b, site in zip(ends, sites, strict=True))
    names = reader.body(ends[0]), reader.body(ends[1])
    if names[0] == names[1]:
        left_out.add("equality constraints", name)
        return None
    if kind == _WELD:
        return reader.joint(name, "weld", names, i, j)
    return reader.joint(name, "spherical", names, _Pose(i.r, np.eye(3)), _Pose(j.r, np.eye(3)))


def _mimic(mimic: Mimic, joints_by_number: dict[int, Joint], left_out: LeftOut) -> Joint | None:
    """Coupling of a URDF's mimic; None, with a lost constraint, for joints that have no coordinate to couple."""
    by_name = {joint.name: joint for joint in joints_by_number.values()}
    dependent, mate = (by_name.get(name) for name in (mimic.joint, mimic.leader))
    try:
        if dependent is not None and mate is not None:
            ratio, offset = float(mimic.multiplier), float(mimic.offset)
            return joints.mimic(f"{mimic.joint}_mimic", dependent, mate, ratio=ratio, offset=offset)
    except (ModelError, ValueError):
        pass  # joints without one coordinate, or numbers that are none
    left_out.lost.append(_describe_loss(str(mimic)))
    return None


def _coupled_joints(model: Any, k: int) -> list[str]:
    """Names of the joints that an equality of joints or tendons couples."""
    ends = [int(end) for end in (model.eq_obj1id[k], model.eq_obj2id[k]) if end >= 0]
    label = lambda j: model.joint(j).name or f"joint_{j}"
    if model.eq_type[k] == _OF_JOINTS:
        return [label(j) for j in ends]
    if model.eq_type[k] != _OF_TENDONS:
        return []
    wraps = [
        w
        for t in ends
        for w in range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
    ]
    return [label(int(model.wrap_objid[w])) for w in wraps if model.wrap_type[w] == _WRAPS_JOINT]


def _closures_of_frames(loops: Mapping[tuple[str, str], str], model: Any) -> tuple[LoopJoint, ...]:
    """Joints that hold the frames of links or bodies together."""
    link_names = [model.body(b).name for b in range(1, model.nbody)]
    closures = []
    for links, kind in loops.items():
        unknown = [link for link in links if link not in link_names]
        if unknown or len(links) != 2:
            nearest = nearest_names(unknown[0], link_names) if unknown else ""
            raise SettingError(
                f"A loop is closed between two links of the robot, but not between {links}.{nearest}"
            )
        if kind not in ("spherical", "weld", "revolute", "translational"):
            raise SettingError(
                f"A loop is closed by a spherical, revolute or translational joint or a weld, not by '{kind}'."
            )
        zero, eye = np.zeros(3), np.eye(3)
        closures.append(
            LoopJoint("_".join(links), kind, (links[0], links[1]), (zero, zero), (eye, eye))
        )
    return tuple(closures)


def _loop_of_urdf(reader: _Reader, loop: LoopJoint, left_out: LeftOut) -> Joint | None:
    """Joint of a URDF's loop_joint; None, with a lost constraint, within one body."""
    known_names = [reader.model.body(b).name for b in range(reader.model.nbody)]
    lost_links = [link for link in loop.links if link not in known_names]
    if lost_links:
        left_out.lost.append(
            f"Lost, a constraint: the loop_joint '{loop.name}' acts on the link '{lost_links[0]}', which MuJoCo's "
            "reader has fused with its parent."
        )
        return None
    numbers = [known_names.index(link) for link in loop.links]
    i, j = (
        reader.inside(b, point, frame)
        for b, point, frame in zip(numbers, loop.points, loop.frames, strict=True)
    )
    names = [reader.body(b) for b in numbers]
    if names[0] == names[1]:
        left_out.lost.append(
            f"Lost, a constraint: the loop_joint '{loop.name}' joins two parts of '{names[0]}'."
        )
        return None
    if loop.kind == "revolute":
        # The file gives both frames of a loop without saying where its coordinate is zero: the start is taken
        # for that, as in every other joint, to which the second frame is turned about its own axis.
        R_i, R_j = (
            (np.eye(3) if b == 0 else reader.poses[b].R) @ pose.R
            for b, pose in zip(map(reader.root, numbers), (i, j), strict=True)
        )
        turn = R_j.T @ R_i
        angle = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        c, s = np.cos(angle), np.sin(angle)
        about_axis = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        j = _Pose(j.r, j.R @ about_axis)
    return reader.joint(loop.name, loop.kind, names, i, j)


def _measure_opening(system: System, loop: Joint) -> float:
    """Distance of the points of a loop, difference of its axes, or offset of a coupling, at the reference posture."""
    if loop.mate is not None:
        return abs(float(loop.mate.offset))
    r, p, com = (np.asarray(x) for x in (system.reference.r, system.reference.p, system.bodies.com))
    ends = []
    for name, point, frame in (
        (loop.body_i, loop.point_i, loop.frame_i), (loop.body_j, loop.point_j, loop.frame_j),
    ):  # fmt: skip
        pose = _WORLD
        if name != GROUND:
            k = system.index(name)
            pose = _Pose(r[k] - _quaternion_matrix(p[k]) @ com[k], _quaternion_matrix(p[k]))
        ends.append(pose.of(np.asarray(point), np.asarray(frame)))
    # of the frames all axes, the third alone, or none are held together
    axes = {"weld": slice(None), "translational": slice(None), "revolute": slice(2, 3)}
    turns = (ends[0].R - ends[1].R)[:, axes.get(loop.kind, slice(0))]
    gap = ends[1].r - ends[0].r
    if loop.kind == "translational":
        gap = (ends[0].R.T @ gap)[:2]
    return max(float(np.abs(gap).max()), float(np.abs(turns).max(initial=0.0)))


# --- forces


def _passive_forces(
    model: Any, j: int, joint: Joint, disabled_flags: set[str]
) -> list[AbstractForce]:
    """Spring and damper of a joint; those that `_add_left_out` names are not here."""
    address = model.jnt_qposadr[j]
    stiffness = 0.0 if disabled_flags & {"SPRING", "PASSIVE"} else model.jnt_stiffness[j]
    damping = (
        0.0 if disabled_flags & {"DAMPER", "PASSIVE"} else model.dof_damping[model.jnt_dofadr[j]]
    )
    # Coordinates count from qpos0 here, springs of MuJoCo from zero.
    rest = model.qpos_spring[address] - model.qpos0[address]
    if stiffness and model.jnt_type[j] == _HINGE:
        return [TorsionalSpringDamper(joint.name, stiffness=stiffness, damping=damping, angle=rest)]
    if stiffness and model.jnt_type[j] == _SLIDE:
        return [JointServo(joint.name, stiffness=stiffness, damping=damping, target=rest)]
    if not damping:
        return []
    slides = model.jnt_type[j] == _SLIDE
    return [JointDamping(joint.name, **{"sliding" if slides else "turning": damping})]


class _Actuator(NamedTuple):
    """Forces of an actuator, the first with its input: value = slope control + value at zero."""

    forces: list[AbstractForce]
    slope: float
    zero: float


def _make_actuator(
    model: Any, a: int, joints_by_number: dict[int, Joint], left_out: LeftOut
) -> _Actuator | None:
    """Actuator as an effort or a servo; None, with a note, if it is neither."""
    j, gear = int(model.actuator_trnid[a, 0]), float(model.actuator_gear[a, 0])
    bias = model.actuator_biasprm[a].tolist() if model.actuator_biastype[a] else [0.0] * 3
    stiffness, damping = -bias[1] * (gear * gear) + 0.0, -bias[2] * (gear * gear) + 0.0
    plain = model.actuator_gaintype[a] == 0 and model.actuator_biastype[a] in (0, 1)
    plain = plain and model.actuator_dyntype[a] == 0 and model.actuator_trntype[a] in (0, 1)
    plain = plain and j in joints_by_number and model.jnt_type[j] in (_SLIDE, _HINGE)
    if plain and not np.all(np.isfinite((gear, stiffness, damping))):
        raise ModelError(
            f"The actuator '{model.actuator(a).name or a}' has the gear {gear:g}, with which its "
            f"stiffness is {stiffness:g} and its damping {damping:g}: they must be finite."
        )
    if model.actuator_trntype[a] == _AT_SITE:
        return None
    if not (plain and stiffness >= 0 and damping >= 0):
        left_out.add("actuators", model.actuator(a).name or f"actuator_{a}")
        return None
    name, zero = joints_by_number[j].name, gear * bias[0]
    push = gear * float(model.actuator_gainprm[a, 0])
    if stiffness:
        # A position actuator is a spring to its control: its bias is the stiffness, and the gain
        # over it the scale of the target.
        zero = zero / stiffness - float(model.qpos0[model.jnt_qposadr[j]])
        limit = _effort_limit(model, a)
        servo = JointServo(name, stiffness=stiffness, damping=damping, target=zero, limit=limit)
        return _Actuator([servo], push / stiffness, zero)
    drag = "sliding" if model.jnt_type[j] == _SLIDE else "turning"
    damper = [JointDamping(name, **{drag: damping})] if damping else []
    # with a damper MuJoCo's limit is that of both together
    limit = None if damper else _effort_limit(model, a)
    return _Actuator([JointEffort(name, zero, limit=limit), *damper], push, zero)


def _thrusters(
    reader: _Reader, actuators: range, weight: float, left_out: LeftOut
) -> tuple[list[AbstractForce], list[str]]:
    """Rotors of the actuators that push along z at sites of a body, with equal coefficients; and notes on them.

    As in a model's file they balance the weight [N] with equal thrusts, since a trim needs speeds to start from.
    """
    model = reader.model
    by_body: dict[str, list[tuple[int, np.ndarray, float, float]]] = {}
    for a in actuators:
        if model.actuator_trntype[a] != _AT_SITE:
            continue
        site, gain = int(model.actuator_trnid[a, 0]), float(model.actuator_gainprm[a, 0])
        owner, turn = int(model.site_bodyid[site]), _quaternion_matrix(model.site_quat[site])
        pose = reader.inside(owner, model.site_pos[site], turn)
        gear = np.asarray(model.actuator_gear[a])
        push = np.concatenate([pose.R @ gear[:3], pose.R @ gear[3:]]) * gain
        plain = model.actuator_gaintype[a] == 0 and not model.actuator_biastype[a]
        plain = plain and model.actuator_dyntype[a] == 0 and int(model.actuator_trnid[a, 1]) < 0
        across = np.abs(np.delete(push, [2, 5])).max()
        if not plain or push[2] <= 0 or across > _UPRIGHT * push[2]:
            left_out.add("actuators", model.actuator(a).name or f"actuator_{a}")
            continue
        entry = (a, pose.r, float(push[2]), float(push[5]))
        by_body.setdefault(reader.body(owner), []).append(entry)
    forces: list[AbstractForce] = []
    notes: list[str] = []
    count = sum(map(len, by_body.values()))
    for body, entries in by_body.items():
        numbers, arms, k_f, moments = zip(*entries, strict=True)
        names = ", ".join(model.actuator(a).name or f"actuator_{a}" for a in numbers)
        k_tau = np.abs(moments)
        if body == GROUND or np.ptp(k_f) > _UPRIGHT * k_f[0] or np.ptp(k_tau) > _UPRIGHT * k_f[0]:
            left_out.add("actuators", names)
            continue
        # A rotor that turns in the positive sense drags its body round in the negative one.
        spin = -np.sign(moments) if k_tau[0] else np.ones(len(entries))
        rotors = Rotors(
            body, arms=np.array(arms), spin=spin, k_f=k_f[0], k_tau=k_tau[0],
            speed_squared=np.full(len(entries), weight / (count * k_f[0])),
        )  # fmt: skip
        low, high = model.actuator_ctrlrange[list(numbers)].T
        is_limited = np.asarray(model.actuator_ctrllimited)[list(numbers)] != 0
        if np.all(is_limited & (low >= 0)):
            forces.append(MotorRotors(rotors, limits=RotorLimits(np.sqrt(low), np.sqrt(high))))
        else:
            forces.append(rotors)
            for a in np.array(numbers)[is_limited]:
                left_out.add("limits of actuators", model.actuator(a).name or f"actuator_{a}")
        notes.append(
            f"The actuators {names} at sites of '{body}' are its rotors: their controls are the inputs "
            f"speed_squared, each with a thrust of {k_f[0]:.6g} N and a moment of {k_tau[0]:.6g} N m per unit. "
            "At the start, equal thrusts of all rotors balance the weight."
        )
    return forces, notes


def _effort_limit(model: Any, a: int) -> float | None:
    """Limit of an actuator's effort in its joint, where it is the same in both directions; else None."""
    low, high = (float(x) for x in model.actuator_forcerange[a])
    if not model.actuator_forcelimited[a] or low != -high or high <= 0:
        return None
    return abs(float(model.actuator_gear[a, 0])) * high


def _describe_inputs(
    system: System, model: Any, driven: list[tuple[int, _Actuator]], first: int
) -> list[str]:
    """Sentences that give the actuator of each input."""
    names = {entry.force: (entry.name, entry.unit) for entry in inputs_of(system).entries}
    sentences = []
    for a, actuator in driven:
        name, unit = names[first]
        sign = "+" if actuator.zero >= 0 else "-"
        shift = f" {sign} {abs(actuator.zero):.9g}" if actuator.zero else ""
        sentences.append(
            f"The input {name} [{unit}] is {actuator.slope:.9g} times the control of the actuator "
            f"'{model.actuator(a).name or a}'{shift}."
        )
        first += len(actuator.forces)
    return sentences
