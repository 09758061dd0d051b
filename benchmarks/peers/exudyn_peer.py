"""Exudyn: rigid bodies in redundant coordinates, joints, implicit generalised-alpha.

Explicit methods refuse joints there, so the implicit one of second order is its only choice.
"""

import math
from typing import Any

import numpy as np
from problems.plain import Plain, PlainJoint, Sinus, axes, plain, start, why_not
from problems.tree import in_plane, span

from peers.adapter import Outcome, Peer, Prepared, Setting, steps
from peers.mujoco_c import whole_steps
from stmuav_jax import Scene, State

# Constrained axes (x, y, z, about x, about y, about z) of its generic joint.
_AXES = {
    "spherical": [1, 1, 1, 0, 0, 0],
    "universal": [1, 1, 1, 0, 0, 1],
    "revolute": [1, 1, 1, 1, 1, 0],
    "translational": [1, 1, 0, 1, 1, 1],
}


class Mechanism:
    """Exudyn's model of a scene."""

    def __init__(self, scene: Scene) -> None:
        import exudyn  # pyright: ignore[reportMissingImports]
        from exudyn import itemInterface  # pyright: ignore[reportMissingImports]

        self.exu: Any = exudyn
        self.items: Any = itemInterface
        self.model, self.first = plain(scene), start(scene)
        self.container = self.exu.SystemContainer()
        self.mbs = self.container.AddSystem()
        self.bodies = [self._body(k) for k in range(self.model.n)]
        self.bodies.append(self.mbs.CreateGround())
        # a planar loop is closed in the plane, or its rows would be dependent
        plane = in_plane(self.model)
        cut = span(scene, self.model).cuts if plane is not None else ()
        for joint in self.model.joints:
            axes = [1, 1, 0, 0, 0, 0] if joint in cut else _AXES[joint.kind]
            ends = self._ends(joint)
            self.mbs.AddObject(self.items.GenericJoint(markerNumbers=ends, constrainedAxes=axes))
        self._loads(self.model, self.first)
        self.sensors = self.sense(self.exu.OutputVariableType.Position)
        self.mbs.Assemble()

    def _body(self, k: int) -> Any:
        from exudyn import rigidBodyUtilities  # pyright: ignore[reportMissingImports]

        s, R = self.first, axes(self.first.p[k])
        return self.mbs.CreateRigidBody(
            inertia=rigidBodyUtilities.RigidBodyInertia(self.model.mass[k], self.model.inertia[k]),
            referencePosition=s.r[k], referenceRotationMatrix=R, initialVelocity=s.v[k],
            initialAngularVelocity=R @ s.omega[k], gravity=self.model.gravity, show=False,
        )  # fmt: skip

    def _marker(self, body: int, point: np.ndarray, frame: np.ndarray | None = None) -> Any:
        place = self.exu.HT(rotation=np.eye(3) if frame is None else frame, translation=point)
        return self.mbs.AddMarker(
            self.items.MarkerBodyRigid(bodyNumber=self.bodies[body], localHT=place)
        )

    def _ends(self, joint: PlainJoint) -> list[Any]:
        """Markers on both bodies of a joint."""
        ends = (joint.i, joint.point_i, joint.frame_i), (joint.j, joint.point_j, joint.frame_j)
        return [self._marker(*end) for end in ends]

    def sense(self, quantity: Any) -> list[Any]:
        """Sensors of a quantity of all bodies."""
        make, how = self.items.SensorBody, {"outputVariableType": quantity, "storeInternal": True}
        return [self.mbs.AddSensor(make(bodyNumber=b, **how)) for b in self.bodies[:-1]]

    def _loads(self, model: Plain, first: State) -> None:
        R = axes(first.p)
        zero = np.zeros(3)
        for k, force, moment in model.wrenches:
            at = self._marker(k, zero)
            for make, vector in ((self.items.Force, force), (self.items.Torque, moment)):
                self.mbs.AddLoad(make(markerNumber=at, loadVector=vector, bodyFixed=True))
        for act in model.actuators:
            b, s = act.base, act.slider
            along = act.force.amplitude * np.eye(3)[2]
            # the slider cannot turn on the base, so the actuator's axis is fixed in it as well
            arm = R[s].T @ (first.r[b] + R[b] @ act.arm - first.r[s])
            on_slider = R[s].T @ R[b] @ along
            for body, point, force in ((b, act.arm, -along), (s, arm, on_slider)):
                at = self._marker(body, point)
                self._wave(at, force, act.force, body_fixed=True)
        for k, force in model.forces:
            at = self._marker(k, zero)
            self._wave(at, force.amplitude, force, body_fixed=False)
        for k, moment in model.moments:
            torque = self.items.Torque
            self.mbs.AddLoad(torque(markerNumber=self._marker(k, zero), loadVector=moment))
        self._springs(model)

    def _springs(self, model: Plain) -> None:
        """Exudyn's own connectors, whose laws are compiled."""
        for s in model.springs:
            ends = [self._marker(s.i, s.point_i), self._marker(s.j, s.point_j)]
            law = {"stiffness": s.stiffness, "damping": s.damping, "referenceLength": s.length}
            self.mbs.AddObject(self.items.SpringDamper(markerNumbers=ends, **law))
        for servo in model.servos:
            ends = self._ends(model.joints[servo.joint])
            law = {"stiffness": servo.stiffness, "damping": servo.damping, "offset": servo.target}
            spring = self.items.LinearSpringDamper
            self.mbs.AddObject(spring(markerNumbers=ends, axisMarker0=[0, 0, 1], **law))

    def _wave(self, marker: Any, amplitude: np.ndarray, wave: Sinus, *, body_fixed: bool) -> None:
        (x, y, z), rate, phase = map(float, amplitude), wave.rate, wave.phase

        def value(mbs: Any, t: float, load: Any) -> list[float]:
            now = math.sin(rate * t + phase)
            return [x * now, y * now, z * now]

        how = {"markerNumber": marker, "loadVector": amplitude, "bodyFixed": body_fixed}
        self.mbs.AddLoad(self.items.Force(**how, loadVectorUserFunction=value))

    def settings(self, t0: float, end: float, steps: int, write_period: float) -> Any:
        """Fixed steps, files and messages off."""
        s = self.exu.SimulationSettings()
        s.timeIntegration.startTime, s.timeIntegration.endTime = t0, end
        s.timeIntegration.numberOfSteps = steps
        # where Newton's method fails, shorter steps for a while; otherwise the step is fixed
        s.timeIntegration.adaptiveStep = True
        s.timeIntegration.verboseMode = 0
        s.solution.file.write = False
        s.solution.sensors.writePeriod = write_period
        s.linearSolver.solverType = self.exu.LinearSolverType.EigenSparse
        s.show.computationTime = s.show.statistics = False
        return s

    def solve(self, settings: Any) -> bool:
        """One run from the start; whether it reached the end."""
        try:
            kind, quiet = self.exu.DynamicSolverType.GeneralizedAlpha, ("Hints", "CausingItems")
            silence = {f"show{name}": False for name in quiet}
            return bool(self.mbs.SolveDynamic(settings, solverType=kind, **silence))
        except (ValueError, RuntimeError):
            return False

    def stored(self, sensors: list[Any]) -> np.ndarray:
        """Times and values of sensors (n, k, 4)."""
        return np.stack([self.mbs.GetSensorStoredData(sensor) for sensor in sensors])


class ExudynPeer(Peer):
    """Exudyn with its default generalised-alpha (spectral radius 0.9, index 3)."""

    name = "Exudyn, generalised-alpha"
    packages = (("exudyn", "exudyn"),)
    caveats = (
        "Actuator forces are Python functions, called at every step.",
        "Joint residuals are not reported.",
        "Accelerations are not timed separately: an implicit step computes them.",
    )
    how = (
        "Redundant coordinates, index 3 (its default), spectral radius 0.9; modified Newton with its "
        "default tolerances (relative 1e-8, absolute 1e-10), EigenSparse; springs and dampers are "
        "its own connectors, user functions of forces are Python and not compiled."
    )

    def unsupported(self, scene: Scene) -> str:
        if reason := why_not(scene):
            return reason
        model = plain(scene)
        slides = {frozenset((j.i, j.j)) for j in model.joints if j.kind == "translational"}
        if any(frozenset((a.base, a.slider)) not in slides for a in model.actuators):
            return "An actuator on a body that does not slide on its base is not supported by our adapters."
        return ""

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        return steps("generalised-alpha", 1e-3, 5e-4, 2e-4, 1e-4, 5e-5)

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        mechanism, step = Mechanism(scene), setting.step or 1e-3
        counts = whole_steps(scene.t0, times, step)
        # sensors write with a period, so that of all wanted times
        stride = int(np.gcd.reduce(counts))
        end = float(times[-1])
        settings = mechanism.settings(scene.t0, end, int(counts[-1]), stride * step)

        def run() -> Outcome:
            done = mechanism.solve(settings)
            stored = mechanism.stored(mechanism.sensors)
            positions = np.full((len(times), mechanism.model.n, 3), np.nan)
            for k, t in enumerate(times):
                near = np.flatnonzero(np.abs(stored[0, :, 0] - t) < 0.1 * step)
                if len(near):
                    positions[k] = stored[:, near[0], 1:]
            failure = "" if done else "Newton's method did not converge."
            return Outcome(positions, None, int(counts[-1]) if done else None, 0, failure=failure)

        return Prepared(run)
