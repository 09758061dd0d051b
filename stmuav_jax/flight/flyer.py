"""State space of the UAV with its tracker: 8 degrees of freedom, 8 inputs.

Positions are the base's r_w [m] and attitude (Euler parameters), and the panel angles
(phi, theta) [rad]; velocities are the base's v_w [m/s] and omega (its axes) [rad/s], and the
angles' rates. Inputs are the squared speeds of the rotors [rad^2/s^2] and the forces of
the two actuators [N]. Loops are closed by the tracker's closed form, so that no projection is
needed and everything is differentiable.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra import lapack
from ..algebra.compiler import kept_jit, quick_jit
from ..algebra.rotation import (
    conjugate,
    from_rotation_vector,
    product,
    rotation_matrix,
    to_rotation_vector,
)
from ..algebra.sampled import Sampled
from ..checks.errors import ModelError
from ..checks.numbers import floats
from ..dynamics.formulations.stabilisation import Unstabilised
from ..dynamics.statespace.base import AbstractStateSpace, Time
from ..dynamics.statespace.names import BASE
from ..dynamics.tree.coordinates import join, split
from ..dynamics.tree.formulation import Tree, TreeModel
from ..mechanics.inputs import Components, Inputs, inputs_of
from ..mechanics.internal import internal_count, internal_rates, internal_states, with_internal
from ..mechanics.state import State
from ..mechanics.system import System
from ..rotorcraft.motor import MotorRotors
from ..rotorcraft.rotor import Rotors
from ..tracker.actuator import LinearActuator
from ..tracker.drive import SLIDER_JOINTS
from ..tracker.geometry import TrackerGeometry
from ..tracker.kinematics import angle_accelerations, panel_angles, stroke_jacobian
from ..tracker.placement import posture
from ..tracker.workspace import Limits

STATES = (
    *BASE[:6],
    ("phi", "rad"),
    ("theta", "rad"),
    *BASE[6:],
    ("phi_rate", "rad/s"),
    ("theta_rate", "rad/s"),
)

# Euler parameters of a base aligned with the world's axes.
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class FlyerPoint(NamedTuple):
    """Independent coordinates and velocities of the UAV; the axes of a stack come last.

    Attributes:
        r: position of the base, world (3,) [m].
        p: Euler parameters of the base (4,).
        angles: panel angles (phi, theta) (2,) [rad].
        v: velocity of the base, world (3,) [m/s].
        omega: angular velocity of the base in its axes (3,) [rad/s].
        rates: rates of the panel angles (2,) [rad/s].
        internal: internal states of forces (m,), such as the speeds of motors with lag [rad/s];
            None where no force has states.
    """

    r: Float[Array, "3 *s"]
    p: Float[Array, "4 *s"]
    angles: Float[Array, "2 *s"]
    v: Float[Array, "3 *s"]
    omega: Float[Array, "3 *s"]
    rates: Float[Array, "2 *s"]
    internal: Float[Array, "m *s"] | None = None


class RotorsAndForces(NamedTuple):
    """Inputs of the UAV, numbers or histories: functions of (t, kinematics) such as `Sampled`.

    Attributes:
        speed_squared: squared rotor speeds (k,) [rad^2/s^2].
        forces: actuator forces (2,) [N].
    """

    speed_squared: Any
    forces: Any


def rotors_and_forces(values: Any) -> RotorsAndForces:
    """The parts of one vector, or history, of all inputs: rotors first, then the two actuators (k + 2,)."""
    if not callable(values):
        return RotorsAndForces(values[:-2], values[-2:])
    count = eqx.filter_eval_shape(values, jnp.zeros(())).shape[0]
    part = lambda *places: Components(values, places, (len(places),))
    return RotorsAndForces(part(*range(count - 2)), part(count - 2, count - 1))


class FlyerAccelerations(NamedTuple):
    """Accelerations of the independent coordinates of the UAV.

    Attributes:
        v: acceleration of the base, world (3,) [m/s^2].
        omega: angular acceleration of the base in its axes (3,) [rad/s^2].
        angles: accelerations of the panel angles (2,) [rad/s^2].
    """

    v: Float[Array, "3"]
    omega: Float[Array, "3"]
    angles: Float[Array, "2"]


@kept_jit
def _conditioning(geometry: TrackerGeometry, angles: Float[Array, "2"]) -> Float[Array, ""]:
    values = lapack.singular_values(stroke_jacobian(geometry, angles))
    return values[-1] / values[0]


class Flyer(AbstractStateSpace):
    """Reduced-coordinate model of base and tracker, with rotors and actuators.

    Args:
        system: the seven bodies, base first, with one `Rotors` or `MotorRotors` and one
            `LinearActuator` for each slider. Other forces stay as they are.
        geometry: lengths of the tracker.
        displacement: displacement of the tracker in the base's frame (3,) [m].
        limits: limits of the tracker's workspace (`tracker_limits`), which a trim observes;
            None for all that its rods reach.

    Raises:
        ModelError: no rotors, or not two actuators.
    """

    system: System
    geometry: TrackerGeometry
    displacement: Float[Array, "3"]
    limits: Limits | None
    rotors: int = eqx.field(static=True)
    actuators: tuple[int, int] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True)
    names: tuple[tuple[str, str], ...] = eqx.field(static=True)
    dof: int = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        geometry: TrackerGeometry,
        displacement: Any,
        limits: Limits | None = None,
    ) -> None:
        rotors = [k for k, f in enumerate(system.forces) if isinstance(f, Rotors | MotorRotors)]
        pushers = {
            f.slider: k for k, f in enumerate(system.forces) if isinstance(f, LinearActuator)
        }
        if len(rotors) != 1 or set(pushers) != {"slider_2", "slider_3"}:
            raise ModelError(
                "A flyer needs one set of rotors and one LinearActuator for each slider, but the "
                f"system has {len(rotors)} and those for {', '.join(sorted(pushers)) or 'none'}."
            )
        self.system, self.geometry = system, geometry
        self.displacement, self.limits = floats(displacement), limits
        self.rotors = rotors[0]
        self.actuators = (pushers["slider_2"], pushers["slider_3"])
        self.dof, self.is_flat = 8, False
        self.size = 16 + internal_count(system)
        own = tuple((f"speed_{k + 1}", "rad/s") for k in range(self.size - 16))
        self.names = (*STATES, *own)

    @property
    def propulsion(self) -> Rotors | MotorRotors:
        """Force element of the rotors, with their motors if they have any."""
        return self.system.forces[self.rotors]  # pyright: ignore[reportReturnType]

    @property
    def propellers(self) -> Rotors:
        """Rotors without their motors."""
        own = self.propulsion
        return own.rotors if isinstance(own, MotorRotors) else own

    @property
    def lagging(self) -> bool:
        """True if the rotors' speeds are internal states: motors with a time constant."""
        own = self.propulsion
        return isinstance(own, MotorRotors) and own.time_constant is not None

    def steady(self) -> "Flyer":
        """Flyer with its motors at steady speeds, see `MotorRotors.steady`."""
        own = self.propulsion
        if isinstance(own, Rotors):
            return self
        forces = list(self.system.forces)
        forces[self.rotors] = own.steady()
        system = eqx.tree_at(lambda s: s.forces, self.system, tuple(forces))
        return Flyer(system, self.geometry, self.displacement, self.limits)

    def with_inputs(
        self, inputs: RotorsAndForces, speeds: Float[Array, " k"] | None = None
    ) -> System:
        """System with its rotors and actuators set to numbers or to histories.

        Args:
            speeds: initial speeds of rotors with lag [rad/s]; by default the commands, where these
                are numbers or a `Sampled` history, and else the present ones.
        """
        rotors, actuators = self.inputs
        system = rotors.applied(self.system, inputs.speed_squared)
        system = actuators.applied(system, inputs.forces)
        if not self.lagging:
            return system
        if speeds is None:
            first = inputs.speed_squared
            first = first(first.breaks[0]) if isinstance(first, Sampled) else first
            if callable(first):
                return system
            own: Any = self.propulsion
            speeds = own.speeds_of(jnp.asarray(first, dtype=float))
        return eqx.tree_at(lambda s: s.forces[self.rotors].internal, system, speeds)

    @property
    def inputs(self) -> tuple[Inputs, Inputs]:
        """The inputs of the rotors, and those of the two actuators."""
        entries = inputs_of(self.system).entries
        own = lambda *forces: Inputs(tuple(e for k in forces for e in entries if e.force == k))
        return own(self.rotors), own(*self.actuators)

    def to_state(self, x: FlyerPoint, t: Time = 0.0) -> State:
        del t
        return whole_state(self.geometry, self.displacement, x)

    def from_state(self, state: State) -> FlyerPoint:
        panel = self.system.index("panel_7")
        R_wb, R_wp = rotation_matrix(state.p[0]), rotation_matrix(state.p[panel])
        n = R_wb.T @ R_wp[:, 2]
        turning = R_wb.T @ (R_wp @ state.omega[panel]) - state.omega[0]
        angles, rates = jax.jvp(panel_angles, (n,), (jnp.cross(turning, n),))
        own = internal_states(self.system) if self.size > 16 else None
        return FlyerPoint(state.r[0], state.p[0], angles, state.v[0], state.omega[0], rates, own)

    def retract(self, x: FlyerPoint, v: Float[Array, "size *s"]) -> FlyerPoint:
        return FlyerPoint(
            x.r + v[:3],
            product(x.p, from_rotation_vector(v[3:6])),
            x.angles + v[6:8],
            x.v + v[8:11],
            x.omega + v[11:14],
            x.rates + v[14:16],
            None if x.internal is None else x.internal + v[16:],
        )

    def difference(self, y: FlyerPoint, x: FlyerPoint) -> Float[Array, "size *s"]:
        turned = to_rotation_vector(product(conjugate(x.p), y.p))
        both = zip(x[2:], y[2:], strict=True)
        moved = [b - a for a, b in both if a is not None and b is not None]
        return jnp.concatenate([y.r - x.r, turned, *moved])

    def check(self, x: Any, what: str) -> None:
        if not isinstance(x, FlyerPoint):
            raise ModelError(f"{what} must be a FlyerPoint, not {type(x).__name__}.")
        has, needs = 0 if x.internal is None else len(x.internal), self.size - 16
        if has != needs:
            raise ModelError(
                f"{what} has {has} states of forces in `internal`, but this flyer's forces have "
                f"{needs}."
            )

    def rates(
        self, x: FlyerPoint, t: Time = 0.0, system: System | None = None
    ) -> Float[Array, " size"]:
        system = self.system if system is None else system
        if x.internal is not None:
            system = with_internal(system, x.internal)
        time = jnp.asarray(t, x.r.dtype)
        found = self._moving(x, replace(self.model(), system=system), time, x.rates)
        parts = [x.v, x.omega, x.rates, found.v, found.omega, found.angles]
        if self.size > 16:
            kin = system.kinematics(self.to_state(x))
            parts.append(internal_rates(system, time, kin))
        return jnp.concatenate(parts)

    def with_closed_loops(self, x: FlyerPoint, t: Time = 0.0) -> FlyerPoint:
        del t
        return x

    def conditioning(self, x: FlyerPoint, t: Time = 0.0) -> Float[Array, ""]:
        del t
        return _conditioning(self.geometry, x.angles)

    def model(self) -> TreeModel:
        """Parameters of the spanning tree, which do not depend on the inputs."""
        return Tree().prepare(self.system)

    def accelerations(
        self,
        at: FlyerPoint,
        inputs: RotorsAndForces,
        t: Float[Array, ""] | float = 0.0,
        model: TreeModel | None = None,
        speeds: Float[Array, " k"] | None = None,
        *,
        resting: bool = False,
    ) -> FlyerAccelerations:
        """Accelerations of the independent coordinates, by the equations of the spanning tree.

        Args:
            model: result of `model`, if it is known already.
            speeds: speeds of rotors with lag [rad/s]; by default those commanded.
            resting: take the rates of the panel angles as zero, which needs a smaller program.
        """
        model = self.model() if model is None else model
        model = replace(model, system=self.with_inputs(inputs, speeds))
        return self._moving(at, model, jnp.asarray(t, at.r.dtype), None if resting else at.rates)

    def level_state(self, angles: Float[Array, "2"], rates: Float[Array, "2"] | None) -> State:
        """State with the base at the origin, level and at rest; rates None for a panel at rest."""
        inside = posture(self.geometry, angles, rates)
        none = jnp.zeros(3)
        r, p = inside.r + self.displacement, inside.p
        return State(
            _first(none, r), _first(_LEVEL, p), _first(none, inside.v), _first(none, inside.omega)
        )

    def _moving(
        self,
        at: FlyerPoint,
        model: TreeModel,
        t: Float[Array, ""],
        rates: Float[Array, "2"] | None,
    ) -> FlyerAccelerations:
        """Accelerations of a model whose forces are set."""
        tree, spanned = Tree(), model.parameters.tree
        # the joints' coordinates do not depend on the base's position and motion
        still = self.level_state(at.angles, rates)
        inside = split(spanned, tree.to_vector(model, still))
        column = lambda x: x[:, None]
        own = {name: column(getattr(at, name)) for name in ("r", "p", "v", "omega")}
        x = join(inside._replace(**own))
        rate, _ = tree.derivative(model, t, x, Unstabilised())
        found = split(spanned, rate)
        joints = [self.system.joint_index(name) for name in SLIDER_JOINTS]
        place = {s.joint: k for k, s in enumerate(spanned.steps)}
        slides = jnp.stack([found.u[place[j]] for j in joints])
        angles = angle_accelerations(self.geometry, at.angles, rates, slides)
        return FlyerAccelerations(found.v[:, 0], found.omega[:, 0], angles)


def _first(x: Any, others: Array) -> Array:
    return jnp.concatenate([jnp.asarray(x)[None], others])


@quick_jit
def whole_state(
    geometry: TrackerGeometry, displacement: Float[Array, "3"], at: FlyerPoint
) -> State:
    """State of the seven bodies, base first, from independent coordinates.

    Args:
        displacement: displacement of the tracker in the base's frame (3,) [m].
    """
    inside = posture(geometry, at.angles, at.rates)
    R = rotation_matrix(at.p)
    arms = inside.r + displacement
    turning = jax.vmap(rotation_matrix)(inside.p)
    r = at.r + arms @ R.T
    v = at.v + (inside.v + jnp.cross(at.omega, arms)) @ R.T
    p = jax.vmap(product, in_axes=(None, 0))(at.p, inside.p)
    omega = inside.omega + jnp.einsum("nji,j->ni", turning, at.omega)
    return State(_first(at.r, r), _first(at.p, p), _first(at.v, v), _first(at.omega, omega))
