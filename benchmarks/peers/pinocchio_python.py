"""Pinocchio from Python: a tree with cut joints, `constraintDynamics`, SciPy's DOP853."""

import math
from typing import Any

import numpy as np
from problems.plain import start

from peers.adapter import Outcome, Peer, Prepared, Setting, looked_at, tolerances
from peers.pinocchio_model import generalised, linked, start_vectors, why_no_joint_forces
from peers.scipy_dense import follow
from stmuav_jax import Scene


class Dynamics:
    """Pinocchio's model of a scene, with its loads as forces in joint coordinates."""

    def __init__(self, scene: Scene) -> None:
        import pinocchio as pin  # pyright: ignore[reportMissingImports]

        self.pin: Any = pin
        tree, self.links = linked(scene)
        self.q0, self.v0 = start_vectors(tree, start(scene))
        self.model = self._tree()
        self.data = self.model.createData()
        self._close()
        joints = self.model.joints
        self.servos = [
            (joints[k + 1].idx_q, joints[k + 1].idx_v, *numbers)
            for k, *numbers in self.links.servos
        ]
        self.constant, self.waves = generalised(self.links)

    def _tree(self) -> Any:
        """Links in depth-first order: in any other, the mass matrix is silently wrong."""
        pin, model = self.pin, self.pin.Model()
        model.gravity = pin.Motion(self.links.gravity, np.zeros(3))
        joints = {
            "free": pin.JointModelFreeFlyer,
            "ball": pin.JointModelSpherical,
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
        if len(self.links.closed) == 3:
            # no proximal term: the rows are independent, so one exact solve is enough
            self.solve = pin.ProximalSettings(1e-12, 0.0, 1)
        else:
            # of three rows a cut, that across the plane is dependent
            self.solve = pin.ProximalSettings(1e-14, 1e-9, 20)

    def _by_posture(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> None:
        """Add joint forces that depend on the state: servos, world moments, springs."""
        for at_q, at_v, stiffness, damping, target in self.servos:
            tau[at_v] -= stiffness * (q[at_q] - target) + damping * v[at_v]
        if not (self.links.moments or self.links.springs):
            return
        pin, model, data = self.pin, self.model, self.data
        pin.computeJointJacobians(model, data, q)
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = lambda link: pin.getJointJacobian(model, data, link + 1, frame)
        for link, moment in self.links.moments:
            tau += jacobian(link)[3:].T @ moment
        for a, x, b, y, stiffness, damping, length in self.links.springs:
            ends, movers = [], []
            for link, point in ((a, x), (b, y)):
                ends.append(point if link < 0 else data.oMi[link + 1].act(point))
                J = np.zeros((6, model.nv)) if link < 0 else jacobian(link)
                arm = ends[-1] - (0 if link < 0 else data.oMi[link + 1].translation)
                movers.append(J[:3] - pin.skew(arm) @ J[3:])
            d, mover = ends[1] - ends[0], movers[1] - movers[0]
            now = math.sqrt(d @ d)
            rate = d @ (mover @ v) / now
            tau -= (stiffness * (now - length) + damping * rate) / now * (mover.T @ d)

    def acceleration(self, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Joint accelerations at q with unit quaternions."""
        tau = self.constant.copy()
        for column, force in self.waves:
            tau += math.sin(force.rate * t + force.phase) * column
        self._by_posture(q, v, tau)
        if not len(self.cuts[0]):
            return self.pin.aba(self.model, self.data, q, v, tau)
        return self.pin.constraintDynamics(self.model, self.data, q, v, tau, *self.cuts, self.solve)

    def rate(self, t: float, x: np.ndarray) -> np.ndarray:
        """dx/dt of x = (q, v); quaternions are normalised where they are used, not in x."""
        q, v = self.pin.normalize(self.model, x[: self.model.nq]), x[self.model.nq :]
        q_rate = self.pin.tangentMapProduct(self.model, q, v).ravel()
        return np.concatenate([q_rate, self.acceleration(t, q, v)])

    def positions(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Centres of mass (n, 3) and the largest gap of a cut joint [m]."""
        q = self.pin.normalize(self.model, x[: self.model.nq])
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
    packages = (("pinocchio", "pin"), ("scipy", "scipy"))
    caveats = ("Loads are applied as joint forces, spring forces through joint Jacobians.",)
    how = (
        "ABA, or constraintDynamics with rigid 3-D point constraints without proximal term (in "
        "planar mechanisms, where a third of the rows is dependent, with mu = 1e-9), called from "
        "Python; SciPy's DOP853, rtol = atol = tolerance."
    )

    def unsupported(self, scene: Scene) -> str:
        return why_no_joint_forces(scene)

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        return tolerances("DOP853")

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        dynamics = Dynamics(scene)
        x0, tolerance = np.concatenate([dynamics.q0, dynamics.v0]), setting.tolerance or 1e-6

        def run() -> Outcome:
            states, counts, failure = follow(
                dynamics.rate, x0, scene.t0, times, setting.solver, tolerance
            )
            n = len(dynamics.links.bodies)
            return looked_at(states, dynamics.positions, n, counts, failure)

        return Prepared(run)
