"""Robots in MJCF or URDF, read by MuJoCo's own parser and compiler, as scenes.

A body of MuJoCo may have several joints: here a link of nearly no mass is between each two of them.
Bodies without joints become part of the body that carries them. docs/models.md lists what is left
out; MuJoCo is an optional extra of the package.
"""

import dataclasses
import importlib
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..algebra.rotation import from_matrix_in, rotation_matrix_in
from ..checks.errors import ModelError, SettingError, StateError
from ..checks.numbers import floats
from ..dynamics.assembly.initial import assemble
from ..dynamics.scene import Scene
from ..mechanics import joint as joints
from ..mechanics.body import GROUND, Body
from ..mechanics.forces.applied import Gravity, JointDamping, TorsionalSpringDamper
from ..mechanics.forces.effort import JointEffort
from ..mechanics.forces.joint import JointServo
from ..mechanics.inputs import inputs_of
from ..mechanics.joint import Joint
from ..mechanics.load import AbstractForce
from ..mechanics.system import System
from .mujoco_left_out import LeftOut, every_left_out
from .netcdf import FileError

# Mass and inertia of the links between several joints of a body, as a share of the body's own.
LINK_SHARE = 1e-12
# Largest opening of a loop [m] or [1] at the reference posture that counts as closed.
_CLOSED = 1e-9
_FREE, _BALL, _SLIDE, _HINGE = range(4)
_CONNECT, _WELD = range(2)
_OF_SITES = 6


def load_robot(path: str | os.PathLike[str], *, link_share: float = LINK_SHARE) -> Scene:
    """Scene of a robot's MJCF or URDF file, at the posture of its `qpos0`, at rest.

    Args:
        link_share: mass and inertia of a link between two joints of one body, as a share of the
            body's own.

    Raises:
        FileError: MuJoCo is not installed, or it cannot read the file; or a body has no mass.
    """
    try:
        mujoco = _mujoco()
    except ImportError:
        raise FileError(
            f"{path}: reading MJCF and URDF needs MuJoCo: pip install 'stmuav-jax[exchange]'."
        ) from None
    source = Path(path)
    if not source.is_file():
        raise FileError(f"There is no file {source}.")
    try:
        spec = mujoco.MjSpec.from_file(str(source))
        try:
            model = spec.compile()
        except ValueError:
            # files of meshes are often absent, and matter only where a body has no inertia of its own
            model = _without_meshes(mujoco.MjSpec.from_file(str(source))).compile()
    except (ValueError, mujoco.FatalError, UserWarning) as error:
        # a warning of MuJoCo is raised where warnings are errors
        raise FileError(f"{source}: MuJoCo cannot read it: {error}") from error
    try:
        return scene_from_mujoco(model, source.stem, link_share=link_share)
    except (ModelError, SettingError, StateError) as error:
        raise FileError(f"{source}: {error}") from error


def _mujoco() -> Any:
    """MuJoCo's Python package: compiled, so that its names have no types."""
    return importlib.import_module("mujoco")


def _without_meshes(spec: Any) -> Any:
    """Specification without pictures, and without meshes of bodies that have an inertia."""
    mujoco = _mujoco()
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.parent.explicitinertial:
            spec.delete(geom)
        else:
            geom.material = ""
    used = {geom.meshname for geom in spec.geoms}
    loose = [mesh for mesh in spec.meshes if mesh.name not in used]
    for each in [*loose, *spec.skins, *spec.materials, *spec.textures]:
        spec.delete(each)
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


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    return np.asarray(rotation_matrix_in(np, quaternion))


class _Reader(NamedTuple):
    """Model of MuJoCo, with the poses of its bodies at qpos0 and their names in here."""

    model: Any
    poses: list[_Pose]
    names: list[str]

    def root(self, number: int) -> int:
        """Number of the body of which a body is part; 0, for ground, if it cannot move."""
        root = int(self.model.body_weldid[number])
        return 0 if self.model.body_mocapid[root] >= 0 else root

    def body(self, number: int) -> str:
        """Name of the body of which a body is part, or ground."""
        return self.names[self.root(number)]

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
    for kind, names, each in (("body", of_body, model.body), ("joint", of_joint, model.joint)):
        for name, words in names.items():
            rows = np.asarray(getattr(model, name))
            bad = (~np.isfinite(rows)).any(axis=tuple(range(1, rows.ndim)))
            if np.any(bad):
                k = int(np.argmax(bad))
                raise ModelError(
                    f"The {words} of the {kind} '{each(k).name or k}' must be finite, but it is "
                    f"{rows[k].tolist()}."
                )


# what overflows is refused by the body or the joint that it is part of
@np.errstate(over="ignore", invalid="ignore")
def scene_from_mujoco(model: Any, name: str = "robot", *, link_share: float = LINK_SHARE) -> Scene:
    """Scene of a compiled `mujoco.MjModel`; what cannot be carried over is in its notes.

    Actuators with a fixed gain on a hinge or slide are inputs: efforts, or targets of position
    servos. The notes say which input is which actuator, and in which units of its control.

    Args:
        name: name of the scene. link_share: see `load_robot`.

    Raises:
        ModelError: no body moves, or the masses and inertias are not those of rigid bodies.
        StateError: the loops cannot be closed near qpos0.
    """
    _check_finite(model)
    poses = [_Pose(np.zeros(3), np.eye(3))]
    for b in range(1, model.nbody):
        parent = poses[model.body_parentid[b]]
        poses.append(parent.of(model.body_pos[b], _matrix(model.body_quat[b])))
    names = [GROUND, *(model.body(b).name or f"body_{b}" for b in range(1, model.nbody))]
    names = [f"{each}_body" if k and each == GROUND else each for k, each in enumerate(names)]
    reader, left_out, off = _Reader(model, poses, names), LeftOut({}), _switched_off(model)
    every_left_out(model, left_out, off)
    bodies: list[Body] = []
    found: dict[int, Joint] = {}
    between: list[str] = []
    for b in range(1, model.nbody):
        if reader.root(b) == b:
            own, links = _body(reader, b, link_share)
            bodies += own
            between += [each.name for each in own[:-1]]
            found |= links
    loops = [loop for k in range(model.neq) if (loop := _loop(reader, k, left_out))]
    loops = [] if off & {"EQUALITY", "CONSTRAINT"} else loops
    forces: list[AbstractForce] = [] if "GRAVITY" in off else [Gravity(model.opt.gravity)]
    for number, joint in found.items():
        forces += _passive(model, number, joint, off)
    passive, every = len(forces), range(0 if "ACTUATION" in off else model.nu)
    actuators = [_actuator(model, a, found, left_out) for a in every]
    driven = [(a, each) for a, each in enumerate(actuators) if each is not None]
    forces += [force for _, each in driven for force in each.forces]
    if not bodies:
        raise ModelError("No body of this model can move.")
    system = System(bodies, [*found.values(), *_renamed(loops, found)], forces)
    state, open_by = system.reference, max((_opening(system, loop) for loop in loops), default=0.0)
    if open_by > _CLOSED:
        state = assemble(system, state).state
    return Scene(
        name=name,
        title=f"{name}, from MuJoCo's model",
        system=system,
        state0=state,
        links_between=tuple(between),
        notes=(*_inputs(system, model, driven, passive), *left_out.sentences()),
    )


def _switched_off(model: Any) -> set[str]:
    """Names of what the model's own options switch off, such as "GRAVITY"."""
    bits = _mujoco().mjtDisableBit.__members__
    flags = int(model.opt.disableflags)
    return {name.removeprefix("mjDSBL_") for name, bit in bits.items() if flags & int(bit)}


def _body(reader: _Reader, b: int, share: float) -> tuple[list[Body], dict[int, Joint]]:
    """Body with its links and joints; those of bodies without joints on it are part of it."""
    model, pose = reader.model, reader.poses[b]
    parts = [k for k in range(model.nbody) if reader.root(k) == b]
    mass = model.body_mass[parts]
    frames = [
        pose.inside(reader.poses[k].of(model.body_ipos[k], _matrix(model.body_iquat[k])))
        for k in parts
    ]
    com = mass @ np.array([frame.r for frame in frames]) / np.sum(mass)
    inertia = np.zeros((3, 3))
    for k, m, frame in zip(parts, mass, frames, strict=True):
        arm = frame.r - com
        inertia += frame.R @ np.diag(model.body_inertia[k]) @ frame.R.T
        inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
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
    before, bodies, links = reader.body(int(model.body_parentid[b])), [], {}
    for j in () if free else numbers:
        last = j == numbers[-1]
        after = name if last else f"{name}_link_{j - numbers[0] + 1}"
        if not last:
            bodies.append(Body(after, share * np.sum(mass), share * inertia, **place))
        links[j] = _joint(reader, j, pose, before, after)
        before = after
    bodies.append(Body(name, np.sum(mass), inertia, free=free, **place))
    return bodies, links


def _joint(reader: _Reader, j: int, pose: _Pose, before: str, after: str) -> Joint:
    model = reader.model
    kind, name = model.jnt_type[j], model.joint(j).name or f"{after}_joint"
    at = pose.of(model.jnt_pos[j], np.eye(3))
    if kind == _BALL:
        # rotation vectors in the axes of the body, as MuJoCo's quaternions have them
        ball = joints.spherical(name, before, after, point=at.r)
        return dataclasses.replace(ball, frame_i=floats(pose.R), frame_j=floats(pose.R))
    make = joints.revolute if kind == _HINGE else joints.translational
    return make(name, before, after, point=at.r, axis=pose.R @ model.jnt_axis[j])


# --- loops


def _loop(reader: _Reader, k: int, left_out: LeftOut) -> Joint | None:
    """Joint of an equality constraint; None, with a note, if there is none like it."""
    model = reader.model
    name, kind, data = model.equality(k).name or f"equality_{k}", model.eq_type[k], model.eq_data[k]
    if kind not in (_CONNECT, _WELD) or not model.eq_active0[k]:
        left_out.add("equality constraints", name)
        return None
    ends = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    if model.eq_objtype[k] == _OF_SITES:
        sites = [(model.site_pos[s], _matrix(model.site_quat[s])) for s in ends]
        ends = tuple(int(model.site_bodyid[s]) for s in ends)
    elif kind == _CONNECT:
        sites = [(data[:3], np.eye(3)), (data[3:6], np.eye(3))]
    else:
        sites = [(data[3:6], _matrix(data[6:10])), (data[:3], np.eye(3))]
    i, j = (reader.inside(b, *site) for b, site in zip(ends, sites, strict=True))
    names = reader.body(ends[0]), reader.body(ends[1])
    if names[0] == names[1]:
        left_out.add("equality constraints", name)
        return None
    turned = (i.R, j.R) if kind == _WELD else (np.eye(3), np.eye(3))
    return Joint(
        name=name, kind="weld" if kind == _WELD else "spherical",
        body_i=names[0], body_j=names[1], in_world=False,
        point_i=floats(i.r), point_j=floats(j.r),
        frame_i=floats(turned[0]), frame_j=floats(turned[1]), length=floats(0.0),
    )  # fmt: skip


def _renamed(loops: list[Joint], found: dict[int, Joint]) -> list[Joint]:
    """Loops with names that no joint has."""
    taken = {joint.name for joint in found.values()}
    rename = lambda loop: f"{loop.name}_loop" if loop.name in taken else loop.name
    return [dataclasses.replace(loop, name=rename(loop)) for loop in loops]


def _opening(system: System, loop: Joint) -> float:
    """Distance of the points of a loop, or difference of its axes, at the reference posture."""
    r, p, com = (np.asarray(x) for x in (system.reference.r, system.reference.p, system.bodies.com))
    ends = []
    for name, point, frame in (
        (loop.body_i, loop.point_i, loop.frame_i), (loop.body_j, loop.point_j, loop.frame_j),
    ):  # fmt: skip
        pose = _Pose(np.zeros(3), np.eye(3))
        if name != GROUND:
            k = system.index(name)
            pose = _Pose(r[k] - _matrix(p[k]) @ com[k], _matrix(p[k]))
        ends.append(pose.of(np.asarray(point), np.asarray(frame)))
    turned = np.abs(ends[0].R - ends[1].R).max() if loop.kind == "weld" else 0.0
    return max(float(np.abs(ends[0].r - ends[1].r).max()), float(turned))


# --- forces


def _passive(model: Any, j: int, joint: Joint, off: set[str]) -> list[AbstractForce]:
    """Spring and damper of a joint; those that `every_left_out` names are not here."""
    address = model.jnt_qposadr[j]
    stiffness = 0.0 if off & {"SPRING", "PASSIVE"} else model.jnt_stiffness[j]
    damping = 0.0 if off & {"DAMPER", "PASSIVE"} else model.dof_damping[model.jnt_dofadr[j]]
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


def _actuator(model: Any, a: int, found: dict[int, Joint], left_out: LeftOut) -> _Actuator | None:
    """Actuator as an effort or a servo; None, with a note, if it is neither."""
    j, gear = int(model.actuator_trnid[a, 0]), float(model.actuator_gear[a, 0])
    bias = model.actuator_biasprm[a].tolist() if model.actuator_biastype[a] else [0.0] * 3
    stiffness, damping = -bias[1] * (gear * gear) + 0.0, -bias[2] * (gear * gear) + 0.0
    plain = model.actuator_gaintype[a] == 0 and model.actuator_biastype[a] in (0, 1)
    plain = plain and model.actuator_dyntype[a] == 0 and model.actuator_trntype[a] in (0, 1)
    plain = plain and j in found and model.jnt_type[j] in (_SLIDE, _HINGE)
    if plain and not np.all(np.isfinite((gear, stiffness, damping))):
        raise ModelError(
            f"The actuator '{model.actuator(a).name or a}' has the gear {gear:g}, with which its "
            f"stiffness is {stiffness:g} and its damping {damping:g}: they must be finite."
        )
    if not (plain and stiffness >= 0 and damping >= 0):
        left_out.add("actuators", model.actuator(a).name or f"actuator_{a}")
        return None
    name, push, zero = found[j].name, gear * float(model.actuator_gainprm[a, 0]), gear * bias[0]
    if stiffness:
        zero = zero / stiffness - float(model.qpos0[model.jnt_qposadr[j]])
        servo = JointServo(name, stiffness=stiffness, damping=damping, target=zero)
        return _Actuator([servo], push / stiffness, zero)
    drag = "sliding" if model.jnt_type[j] == _SLIDE else "turning"
    damper = [JointDamping(name, **{drag: damping})] if damping else []
    return _Actuator([JointEffort(name, zero), *damper], push, zero)


def _inputs(
    system: System, model: Any, driven: list[tuple[int, _Actuator]], first: int
) -> list[str]:
    """Sentences that say which input is which actuator."""
    names = {entry.force: (entry.name, entry.unit) for entry in inputs_of(system).entries}
    sentences = []
    for a, each in driven:
        name, unit = names[first]
        shift = f" {'+' if each.zero >= 0 else '-'} {abs(each.zero):.9g}" if each.zero else ""
        sentences.append(
            f"The input {name} [{unit}] is {each.slope:.9g} times the control of the actuator "
            f"'{model.actuator(a).name or a}'{shift}."
        )
        first += len(each.forces)
    return sentences
