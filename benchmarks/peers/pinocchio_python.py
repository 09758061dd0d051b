"""Pinocchio from Python: a tree with cut ball joints, `constraintDynamics`, SciPy's DOP853."""

import importlib.util
import math
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
from adapter import Outcome, Peer, Prepared, Setting

from stmuav_jax import Scene

from .pinocchio_model import generalised, link_model, start_vectors, why_no_joint_forces
from .plain import loop_seconds, plain, start
from .scipy_run import follow
from .tree import span


class Dynamics:
    """Pinocchio's model of a scene, with its loads as forces in joint coordinates."""

    def __init__(self, scene: Scene) -> None:
        import pinocchio as pin  # pyright: ignore[reportMissingImports]

        self.pin: Any = pin
        numbers = plain(scene)
        tree = span(numbers)
        self.links = link_model(numbers, tree)
        self.q0, self.v0 = start_vectors(tree, start(scene))
        self.model = self._tree()
        self.data = self.model.createData()
        self._close()
        self.free = self.links.links[0].kind == "free"
        self.constant, self.waves = generalised(self.links)

    def _tree(self) -> Any:
        """Links in depth-first order: in any other, the mass matrix is silently wrong."""
        pin, model = self.pin, self.pin.Model()
        model.gravity = pin.Motion(self.links.gravity, np.zeros(3))
        joints = {
            "free": pin.JointModelFreeFlyer,
            "turn": pin.JointModelRZ,
            "slide": pin.JointModelPZ,
            "universal": lambda: pin.JointModelUniversal(np.eye(3)[0], np.eye(3)[1]),
        }
        for k, link in enumerate(self.links.links):
            placement = pin.SE3(link.placement.R, link.placement.x)
            joint = model.addJoint(link.parent + 1, joints[link.kind](), placement, f"joint{k}")
            inertia = pin.Inertia(link.mass, link.com, link.inertia)
            model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
        return model

    def _close(self) -> None:
        pin = self.pin
        models, data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        for a, x, b, y in self.links.cuts:
            ends = (a + 1, pin.SE3(np.eye(3), x), b + 1, pin.SE3(np.eye(3), y))
            kind, frame = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
            one = pin.RigidConstraintModel(kind, self.model, *ends, frame)
            models.append(one)
            data.append(one.createData())
        self.cuts = models, data
        if len(models):
            pin.initConstraintDynamics(self.model, self.data, models, data)
        # no proximal term: the rows are independent, so one exact solve is enough
        self.solve = pin.ProximalSettings(1e-12, 0.0, 1)

    def acceleration(self, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Joint accelerations at q with unit quaternions."""
        tau = self.constant.copy()
        for column, force in self.waves:
            tau += math.sin(force[0] * t + force[1]) * column
        if not len(self.cuts[0]):
            return self.pin.aba(self.model, self.data, q, v, tau)
        return self.pin.constraintDynamics(self.model, self.data, q, v, tau, *self.cuts, self.solve)

    def rate(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """dx/dt of x = (q, v); quaternions are normalised where they are used, not in x."""
        nq, data, free = self.model.nq, self.data, self.free
        half = np.zeros((4, 4))

        def rate(t: float, x: np.ndarray) -> np.ndarray:
            q, v, out = x[:nq], x[nq:], np.empty_like(x)
            if not free:
                out[:nq] = v
                out[nq:] = self.acceleration(t, q, v)
                return out
            unit = q.copy()
            unit[3:7] /= math.sqrt(q[3:7] @ q[3:7])
            out[nq:] = self.acceleration(t, unit, v)
            # of the first joint, which aba leaves out of oMi
            out[:3] = data.liMi[1].rotation @ v[:3]
            a, b, c = 0.5 * v[3:6]
            half[0, 1:] = c, -b, a
            half[1, 0], half[1, 2:] = -c, (a, b)
            half[2, :2], half[2, 3] = (b, -a), c
            half[3, :3] = -a, -b, -c
            out[3:7] = half @ q[3:7]
            out[7:nq] = v[6:]
            return out

        return rate

    def positions(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Centres of mass (n, 3) and the largest gap of a cut joint [m]."""
        q = x[: self.model.nq].copy()
        if self.free:
            q[3:7] /= np.linalg.norm(q[3:7])
        self.pin.forwardKinematics(self.model, self.data, q)
        place = self.data.oMi
        gap = max(
            (np.linalg.norm(place[a + 1].act(x) - place[b + 1].act(y))
             for a, x, b, y in self.links.cuts), default=0.0,
        )  # fmt: skip
        return np.stack([place[k + 1].act(x) for k, x in self.links.bodies]), float(gap)


class PinocchioPython(Peer):
    """Pinocchio called from Python at every evaluation."""

    name = "Pinocchio (Python), SciPy DOP853"
    packages = ("pin", "scipy")
    caveats = (
        "Loads are written as constant or periodic joint forces, which is possible in these scenes.",
    )

    def missing(self) -> str:
        for package in ("pinocchio", "scipy"):
            if importlib.util.find_spec(package) is None:
                return f"The package {package} is not installed."
        return ""

    def version(self) -> str:
        import pinocchio as pin  # pyright: ignore[reportMissingImports]

        return f"{pin.__version__}, SciPy {metadata.version('scipy')}"

    def unsupported(self, scene: Scene) -> str:
        return why_no_joint_forces(scene)

    def settings(self) -> list[Setting]:
        return [Setting("DOP853", tolerance=10.0**-k) for k in (4, 5, 6, 7, 8, 9, 10, 11, 12)]

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        dynamics = Dynamics(scene)
        rate, x0 = dynamics.rate(), np.concatenate([dynamics.q0, dynamics.v0])
        tolerance = setting.tolerance or 1e-6

        def run() -> Outcome:
            path = follow(rate, x0, scene.t0, times, setting.solver, tolerance)
            n = len(dynamics.links.bodies)
            positions, worst = np.full((len(times), n, 3), np.nan), 0.0
            for k, x in enumerate(path.states):
                if np.all(np.isfinite(x)):
                    positions[k], gap = dynamics.positions(x)
                    worst = max(worst, gap)
            return Outcome(
                positions,
                path.evaluations,
                path.accepted,
                path.rejected,
                residual=worst,
                failure=path.failure,
            )

        return Prepared(run)

    def acceleration_seconds(self, scene: Scene) -> float | None:
        dynamics = Dynamics(scene)
        q, v, t = dynamics.q0, dynamics.v0, scene.t0
        return loop_seconds(lambda: dynamics.acceleration(t, q, v))

    def start_accelerations(self, scene: Scene) -> np.ndarray:
        """Of the centres of mass at the start, world (n, 3) [m/s^2]."""
        dynamics = Dynamics(scene)
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
