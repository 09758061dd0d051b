"""MuJoCo: a tree with `connect` constraints, fourth-order Runge-Kutta at a fixed step.

MuJoCo's constraints are soft. The hardest that it admits are used: impedance 0.9999 and a
time constant of two steps. Whole runs go through `mujoco.rollout`, without Python in between.
"""

import importlib
from typing import Any

import numpy as np
from problems.plain import Sinus, UnsupportedError, loop_seconds, plain, start, starts
from problems.tree import coordinates
from scipy.spatial.transform import Rotation

from peers.adapter import Outcome, Peer, Prepared, Setting, looked_at, steps
from peers.pinocchio_model import LinkModel, linked, why_no_joint_forces
from stmuav_jax import Scene, State

# A link's joints in MuJoCo: kind, and the letters of their axes.
_AXES = {
    "free": ("mjJNT_FREE", "z"), "ball": ("mjJNT_BALL", "z"), "turn": ("mjJNT_HINGE", "z"),
    "slide": ("mjJNT_SLIDE", "z"), "universal": ("mjJNT_HINGE", "xy"),
}  # fmt: skip
_UNIT = dict(zip("xyz", np.eye(3), strict=True))


def build(links: LinkModel, step: float, integrator: str) -> Any:
    """The model in MuJoCo, every body's frame being its link's."""
    mujoco: Any = importlib.import_module("mujoco")
    spec = mujoco.MjSpec()
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    how, off = spec.option, mujoco.mjtDisableBit
    how.timestep, how.gravity = step, links.gravity
    how.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    how.tolerance, how.jacobian = 1e-14, mujoco.mjtJacobian.mjJAC_DENSE
    how.disableflags = off.mjDSBL_CONTACT | off.mjDSBL_AUTORESET | off.mjDSBL_WARMSTART
    bodies = {-1: spec.worldbody}
    held = {link: numbers for link, *numbers in links.servos}
    for k, link in enumerate(links.links):
        turned = Rotation.from_matrix(link.placement.R).as_quat(scalar_first=True)
        J, place = link.inertia, {"pos": link.placement.x, "quat": turned}
        body = bodies[k] = bodies[link.parent].add_body(name=f"link{k}", **place)
        body.mass, body.ipos, body.explicitinertial = link.mass, link.com, True
        body.fullinertia = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
        kind, axes = _AXES[link.kind]
        for axis in axes:
            joint = body.add_joint(name=f"joint{k}{axis}", type=getattr(mujoco.mjtJoint, kind))
            joint.axis = _UNIT[axis]
            # a servo with a fixed target is a joint's own spring and damper
            if k in held:
                joint.stiffness[0], joint.damping[0], joint.springref = held[k]
    between = {"cut": links.cuts, "spring": links.springs}
    for name, pairs in between.items():
        for k, (a, x, b, y, *_) in enumerate(pairs):
            bodies[a].add_site(name=f"{name}{k}a", pos=x)
            bodies[b].add_site(name=f"{name}{k}b", pos=y)
    for k in range(len(links.cuts)):
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, name1=f"cut{k}a",
            name2=f"cut{k}b", solref=[2 * step, 1], solimp=[0.9999, 0.9999, 0.001, 0.5, 2],
        )  # fmt: skip
    for k, (*_, stiffness, damping, length) in enumerate(links.springs):
        tendon = spec.add_tendon(springlength=[length, length])
        tendon.stiffness[0], tendon.damping[0] = stiffness, damping
        tendon.wrap_site(f"spring{k}a")
        tendon.wrap_site(f"spring{k}b")
    site, joint = mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_JOINT
    for k, (at, force, moment) in enumerate(links.wrenches):
        bodies[at].add_site(name=f"wrench{k}")
        spec.add_actuator(trntype=site, target=f"wrench{k}", gear=[*force, *moment])
    for link, gain in (*_torques(links), *_pushes(links)):
        spec.add_actuator(trntype=joint, target=f"joint{link}z", gear=[gain, 0, 0, 0, 0, 0])
    return spec.compile()


def _torques(links: LinkModel) -> list[tuple[int, float]]:
    """Hinges on ground that a world moment drives, with its part along their axis [N m].

    Raises:
        UnsupportedError: a moment elsewhere, or across the hinge.
    """
    found = []
    for k, moment in links.moments:
        link = links.links[k]
        along, whole = float(link.placement.R[:, 2] @ moment), np.linalg.norm(moment)
        if (link.kind, link.parent) != ("turn", -1) or abs(along) < 0.999999 * whole:
            raise UnsupportedError("A world moment that is not along a hinge on ground")
        found.append((k, along))
    return found


def _pushes(links: LinkModel) -> list[tuple[int, float]]:
    """Slides that are pushed, with the amplitude [N]; actuators first, then forces."""
    axis = lambda link: links.links[link].placement.R[:, 2]
    actuators = [(k, float(axis(k) @ a * f.amplitude)) for _, k, _, a, f in links.actuators]
    return actuators + [(k, float(axis(k) @ f.amplitude)) for k, _, f in links.forces]


def why_no_mujoco(scene: Scene) -> str:
    """What the models made here lack for a scene; empty if they lack nothing."""
    # motors act in joint coordinates too
    if reason := why_no_joint_forces(scene):
        return reason
    try:
        World(scene, 1e-3)
    except (UnsupportedError, ValueError) as error:
        return " ".join(str(error).split())
    return ""


class World:
    """MuJoCo's model of a scene at one step."""

    def __init__(self, scene: Scene, step: float, integrator: str = "RK4") -> None:
        mujoco: Any = importlib.import_module("mujoco")
        # or failures would be written into a file in the working directory
        mujoco.set_mju_user_warning(lambda _: None)
        self.mujoco = mujoco
        self.tree, self.links = linked(scene)
        self.model = build(self.links, step, integrator)
        self.data = mujoco.MjData(self.model)
        self.step, self.t0 = step, scene.t0
        # controls that are always one, in front of those that swing
        self.constant = len(self.links.wrenches) + len(self.links.moments)
        self.order = [self.model.body(f"link{k}").id for k, _ in self.links.bodies]

    def begin(self, state: State) -> np.ndarray:
        """Put the data at a start; returns MuJoCo's physics state."""
        mujoco, steps = self.mujoco, coordinates(self.tree, state)
        mujoco.mj_resetData(self.model, self.data)
        self.data.time = self.t0
        # links are in depth-first order, and so are MuJoCo's joints
        self.data.qpos[:] = np.concatenate([q for q, _ in steps])
        self.data.qvel[:] = np.concatenate([v for _, v in steps])
        self.data.ctrl[:] = self.control(1)[0]
        mujoco.mj_forward(self.model, self.data)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        first = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data, first, kind)
        return first

    def waves(self) -> list[Sinus]:
        """The forces that swing in time, in the order of the controls."""
        return [force for *_, force in (*self.links.actuators, *self.links.forces)]

    def control(self, count: int) -> np.ndarray:
        """Controls of every step (count, m): the mean of each signal over the step."""
        h = self.step
        t = self.t0 + h * np.arange(count)
        columns = [np.ones(count)] * self.constant
        for s in self.waves():
            # sin(x) / x at half the angle of a step; NumPy's sinc has pi inside
            mean = np.sinc(0.5 * s.rate * h / np.pi)
            columns.append(mean * np.sin(s.rate * (t + 0.5 * h) + s.phase))
        return np.stack(columns, axis=1) if columns else np.zeros((count, 0))

    def positions(self, physics: np.ndarray) -> tuple[np.ndarray, float]:
        """Centres of mass (n, 3) and the largest gap of a cut joint [m]."""
        mujoco, model, data = self.mujoco, self.model, self.data
        mujoco.mj_setState(model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_kinematics(model, data)
        gaps = [
            np.linalg.norm(data.site(f"cut{k}a").xpos - data.site(f"cut{k}b").xpos)
            for k in range(len(self.links.cuts))
        ]
        return data.xipos[self.order].copy(), float(max(gaps, default=0.0))


def whole_steps(t0: float, times: np.ndarray, step: float) -> np.ndarray:
    """How many steps lead to each wanted time.

    Raises:
        ValueError: a time that the step does not divide.
    """
    counts = np.rint((np.asarray(times) - t0) / step).astype(int)
    if np.any(np.abs(t0 + counts * step - times) > 1e-9):
        raise ValueError(f"Steps of {step} s do not end at the wanted times {times} s.")
    return counts


class MujocoC(Peer):
    """MuJoCo's C engine through its Python bindings."""

    name = "MuJoCo (C), RK4"
    packages = (("mujoco", "mujoco"),)
    caveats = (
        "Loop constraints are soft; the hardest admitted setting is used.",
        "Actuator forces are held at their mean over each step.",
    )
    how = (
        "Newton solver, at most 100 iterations, tolerance 1e-14, dense Jacobian, contacts and warm "
        "start off; loops by `connect` with solref (2 h, 1) and solimp (0.9999, 0.9999); servos are "
        "joint springs and dampers; whole runs in `mujoco.rollout`."
    )

    def unsupported(self, scene: Scene) -> str:
        return why_no_mujoco(scene)

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        """RK4, and with servos also MuJoCo's integrator that takes damping implicitly."""
        lengths = (1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5)
        stiff = scene is not None and plain(scene).servos
        implicit = steps("implicitfast", *lengths, 1e-5) if stiff else []
        return [*steps("RK4", *lengths, 1.6e-5), *implicit]

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        rollout: Any = importlib.import_module("mujoco.rollout")

        world = World(scene, setting.step or 1e-3, setting.solver)
        counts = whole_steps(scene.t0, times, world.step)
        each = 4 if setting.solver == "RK4" else 1
        first, controls = world.begin(start(scene)), world.control(int(counts[-1]))

        def run() -> Outcome:
            states, _ = rollout.rollout(
                world.model, world.data, first[None], controls[None], nstep=len(controls)
            )
            path = np.concatenate([first[None], states[0]])[counts]
            taken = (each * len(controls), len(controls), 0)
            return looked_at(path, world.positions, len(world.order), taken)

        return Prepared(run)

    def throughput(
        self, scene: Scene, states: State, t1: float, setting: Setting
    ) -> tuple[float, np.ndarray]:
        rollout: Any = importlib.import_module("mujoco.rollout")

        world = World(scene, setting.step or 1e-3)
        count = int(whole_steps(scene.t0, np.array([t1]), world.step)[0])
        first = np.stack([world.begin(state) for state in starts(states)])
        controls = np.broadcast_to(world.control(count), (len(first), count, world.model.nu))
        with rollout.Rollout(nthread=0) as pool:
            call = lambda: pool.rollout(world.model, world.data, first, controls, nstep=count)[0]
            seconds, ends = loop_seconds(call, loops=1, repeats=3), call()[:, -1]
        return len(first) / seconds, np.stack([world.positions(end)[0] for end in ends])
