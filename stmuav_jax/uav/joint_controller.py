"""Controller of a flying machine with joints: rotors hold its base, servos and efforts move named joints.

For joint coordinates x and the efforts Q in them, the forward dynamics of the machine are affine in Q,

    x'' = f + G Q.

By computed torque Q = G^-1 (a - f), with f at the rotors' own command, and

    a = x_d'' + 2 d W (x_d' - x') + W^2 (x_d - x),

where W is a natural frequency and d a damping ratio; by proportional and derivative control
Q = k (x_d - x) + c (x_d' - x'). A joint with a servo of its own (`JointServo`) has x_d for its target. The
moment M_s that these accelerations take from the base is fed forward to the rotors: it is the rate of the
angular momentum of the moving parts under the efforts G^-1 a.

Source: B. Siciliano, L. Sciavicco, L. Villani, G. Oriolo, Robotics: Modelling, Planning and Control
(2009), ch. 8.5 (inverse dynamics control).
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, SettingError, nearest_names
from ..checks.numbers import as_floats
from ..control.references import Waypoint
from ..dynamics.formulations.stabilisation import Unstabilised
from ..dynamics.tree.closures import TreeModel
from ..dynamics.tree.formulation import Tree
from ..math.derivative import value_and_jacobian
from ..math.linalg import factor_cholesky, solve_lower
from ..math.rotation import euler_parameter_rate
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.joint import Which, choose_coordinate
from ..mechanics.joint_forces import JointEffort, JointServo
from ..mechanics.joint_states import evaluate_coordinate
from ..mechanics.state import State
from ..mechanics.system import System
from .drag import AirframeDrag
from .flight_controller import FlightController, FlightMemory, MassProperties, mass_properties
from .inner_motion import shorten_turns
from .motion_estimator import MotionEstimate, state_of
from .motor import MotorRotors


class DrivenJoint(NamedTuple):
    """Joint coordinate that an effort or a servo of a system drives.

    Attributes:
        name: that of the joint, with its coordinate where two of them are driven ("J.angle").
        joint: name of the joint. kind: "angle" or "displacement".
        force: place of the force among those of the system. input: name of its input.
        is_effort: False for a servo, whose input is its target.
    """

    name: str
    joint: str
    kind: Which
    force: int
    input: str
    is_effort: bool

    @property
    def unit(self) -> str:
        """Unit of the coordinate."""
        return "rad" if self.kind == "angle" else "m"


def driven_joints(system: System) -> tuple[DrivenJoint, ...]:
    """Joint coordinates with an effort or a servo whose input is a number.

    Raises:
        ModelError: two of them drive one coordinate.
    """
    driven = []
    names = {entry.force: entry.name for entry in inputs_of(system).entries}
    for k, force in enumerate(system.forces):
        is_effort = isinstance(force, JointEffort)
        # A prescribed history is part of the machine and no input: a controller can neither read
        # nor set it.
        if not isinstance(force, JointEffort | JointServo) or callable(
            force.effort if isinstance(force, JointEffort) else force.target
        ):
            continue
        joint = system.joints[system.joint_index(force.joint)]
        kind = choose_coordinate(joint, force.coordinate, type(force).__name__)
        driven.append(DrivenJoint(joint.name, joint.name, kind, k, names[k], is_effort))
    for (joint_name, kind), count in Counter((drive.joint, drive.kind) for drive in driven).items():
        if count > 1:
            raise ModelError(
                f"The {kind} of joint '{joint_name}' has several efforts or servos: a controller needs one."
            )
    count = Counter(drive.joint for drive in driven)
    return tuple(
        drive._replace(name=f"{drive.joint}.{drive.kind}") if count[drive.joint] > 1 else drive
        for drive in driven
    )


class JointMotions(NamedTuple):
    """Values, rates and accelerations of joint coordinates, each (n,) [rad] or [m] and per second."""

    value: Float[Array, " n"]
    rate: Float[Array, " n"]
    acceleration: Float[Array, " n"]


def read_joints(
    system: System, joints: tuple[DrivenJoint, ...], state: State
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Values and rates of joint coordinates at a state, each (n,); angles are in (-pi, pi]."""
    kin = system.kinematics(state)
    coordinates = [evaluate_coordinate(kin, kin.joint(drive.joint), drive.kind) for drive in joints]
    if not coordinates:
        return jnp.zeros(0), jnp.zeros(0)
    return jnp.stack([x.value for x in coordinates]), jnp.stack([x.rate for x in coordinates])


def joint_errors(
    joints: tuple[DrivenJoint, ...], values: Float[Array, " n"], targets: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Values less targets, angles by the nearer way round."""
    return shorten_turns(values - targets, [drive.kind == "angle" for drive in joints])


class JointGains(NamedTuple):
    """Gains of the servo of one joint: computed torque by its first two, or PD by its last two.

    Attributes:
        frequency: natural frequency of the errors [rad/s]. damping_ratio: [1].
        stiffness: [N/m] or [N m/rad]; None for computed torque. damping: [N s/m] or [N m s/rad].
    """

    frequency: float = 60.0
    damping_ratio: float = 1.0
    stiffness: float | None = None
    damping: float = 0.0


class JointReference(NamedTuple):
    """Reference of a `JointController`: motion of the base, and of the joints in their order."""

    waypoint: Waypoint
    joints: JointMotions


class JointController(eqx.Module):
    """Controller of the rotors, and of all driven joints of a machine (`driven_joints`).

    The estimate is the `State` of all bodies, or a `MotionEstimate`. Inputs are the squared speeds of the rotors
    first, then efforts and targets in the order of `joints`.

    Args:
        system: machine whose masses the controller uses; of its forces, drag and the lag of motors are
            left out.
        flight: controller of the rotors.
        gains: gains of joints with an effort, by name; of others `JointGains()`.
        feedforward: False for a controller that treats the joints as locked in the reference posture.

    Raises:
        SettingError: gains of a joint that has no effort. ModelError: see `driven_joints`.
    """

    flight: FlightController
    model: TreeModel
    inputs: Inputs
    gains: Float[Array, "4 n"]
    joints: tuple[DrivenJoint, ...] = eqx.field(static=True)
    is_direct: tuple[bool, ...] = eqx.field(static=True)
    feedforward: bool = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        flight: FlightController,
        gains: Mapping[str, JointGains] | None = None,
        *,
        feedforward: bool = True,
    ) -> None:
        self.flight, self.feedforward = flight, feedforward
        self.joints = joints = driven_joints(system)
        gains = {} if gains is None else gains
        efforts = [drive.name for drive in joints if drive.is_effort]
        for name in gains:
            if name not in efforts:
                raise SettingError(
                    f"There is no joint '{name}' with an effort to control.{nearest_names(name, efforts)}"
                )
        selected = [gains.get(drive.name, JointGains()) for drive in joints]
        # Which law a joint has is structure; its gains are numbers, so that tuning them compiles
        # nothing.
        self.is_direct = tuple(gains_of_joint.stiffness is not None for gains_of_joint in selected)
        rows = [[0.0 if x is None else x for x in gains_of_joint] for gains_of_joint in selected]
        self.gains = as_floats(np.reshape(rows, (len(rows), 4)).T)
        # of the machine without lag and drag, every driven joint has an effort without limit
        places = {drive.force for drive in joints if drive.is_effort}
        forces = [
            force.steady() if isinstance(force, MotorRotors) else force
            for k, force in enumerate(system.forces)
            if k not in places and not isinstance(force, AirframeDrag)
        ]
        forces += [JointEffort(drive.joint, 0.0, coordinate=drive.kind) for drive in joints]
        nominal = dataclasses.replace(system, forces=tuple(forces))
        self.model = Tree().prepare(nominal)
        count, rotors = len(joints), flight.wrenches.shape[1]
        every = inputs_of(nominal).entries
        squared = [entry for entry in every if entry.field.endswith("speed_squared")]
        last = [entry for entry in every if entry.force >= len(forces) - count]
        assert (len(squared), len(last)) == (rotors, count)
        servos = {drive.input for drive in joints if not drive.is_effort}
        targets = [entry for entry in every if entry.field == "target" and entry.name in servos]
        self.inputs = Inputs((*squared, *last, *targets))

    def start(self) -> FlightMemory:
        """First memory."""
        return self.flight.start()

    def __call__(
        self, estimate: State | MotionEstimate, reference: JointReference, memory: FlightMemory
    ) -> tuple[Float[Array, " m"], FlightMemory]:
        """Inputs (k + n,): squared rotor speeds [rad^2/s^2], efforts and targets; and the memory."""
        state: State = state_of(estimate)
        system, targets = self.model.system, reference.joints
        values, rates = read_joints(system, self.joints, state)
        # Errors of angles are by the nearer way round: an encoder does not know turns, and a
        # target beyond half a turn would drive the joint backwards.
        error, rate_error = -joint_errors(self.joints, values, targets.value), targets.rate - rates
        W, ratio, k, c = self.gains
        is_servo = np.array([not drive.is_effort for drive in self.joints], dtype=bool)
        is_direct = np.array(self.is_direct, dtype=bool)
        # Computed torque makes each joint's error a damped oscillator of its own, whatever else
        # moves.
        closed = targets.acceleration + 2 * ratio * W * rate_error + W**2 * error
        accelerations = jnp.where(is_servo | is_direct, targets.acceleration, closed)
        none, count = jnp.zeros(len(self.joints)), self.flight.wrenches.shape[1]
        servo_targets, hover = targets.value[is_servo], self.inputs.values(system)[:count]
        mass = self.flight.mass
        G, body_rates = jnp.eye(len(self.joints)), []
        if self.feedforward or not all(is_servo | is_direct):
            # Accelerations are linear in the efforts: one evaluation with its derivatives gives
            # the matrix from efforts to accelerations of the joints and of all bodies.
            of = lambda Q: self._solve_accelerations(state, hover, Q, servo_targets)
            _, (G, *body_rates) = value_and_jacobian(of, none)
        # The matrix is symmetric and positive definite, as efforts and accelerations are of the same joints.
        L = factor_cholesky(G)
        solve_joints = lambda b: solve_lower(L, solve_lower(L, b[:, None]), transpose=True)[:, 0]
        if self.feedforward:
            efforts = solve_joints(accelerations)
            v_rate, omega_rate = (x @ efforts for x in body_rates)
            # The rate of the inner momentum is the moment that moving joints exert on the base:
            # the rotors are told of it before it acts, and not by the error that it leaves.
            moment = mass_properties(system, State(state.r, state.p, v_rate, omega_rate)).h
            mass = mass_properties(system, state, moment)
        assert isinstance(mass, MassProperties)
        squared, next_memory = self.flight.command(state, reference.waypoint, memory, mass)
        efforts = k * error + c * rate_error
        if not all(is_servo | is_direct):
            # What the joints do by themselves at the thrust that is commanded now: the efforts
            # have to make up the difference alone.
            f = self._solve_accelerations(state, squared, none, servo_targets)[0]
            efforts = jnp.where(is_direct, efforts, solve_joints(accelerations - f))
        return jnp.concatenate([squared, jnp.where(is_servo, targets.value, efforts)]), next_memory

    def _solve_accelerations(
        self,
        state: State,
        squared: Float[Array, " k"],
        efforts: Float[Array, " n"],
        servo_targets: Float[Array, " s"],
    ) -> tuple[Array, Array, Array]:
        """Accelerations of the joint coordinates (n,), and of all bodies, at inputs of the model."""
        values = jnp.concatenate([squared, efforts, servo_targets])
        system = self.inputs.applied(self.model.system, values)
        model = eqx.tree_at(lambda m: m.system, self.model, system)
        accelerations = Tree().accelerations(model, jnp.zeros(()), state, Unstabilised())
        p_rate = euler_parameter_rate(state.p.T, state.omega.T).T
        rates = State(state.v, p_rate, accelerations.v_rate, accelerations.omega_rate)
        read = lambda state: read_joints(system, self.joints, state)[1]
        return jax.jvp(read, (state,), (rates,))[1], accelerations.v_rate, accelerations.omega_rate
