"""Stability of sampled loops: inputs held over a period, and late by whole periods.

    x' = A x + B u,   u_k = -K x_k held from sample k + d to k + d + 1

is stable where all eigenvalues of the map from sample to sample lie inside of the unit circle. For a
flying machine A and B are those of its linearisation about hover, with all its joints and the lag of its
motors, and K is the derivative of its controller. Drag, friction and contact are left out, as is the estimator.

Source: G. F. Franklin, J. D. Powell, M. Workman, Digital Control of Dynamic Systems (1998), ch. 4.3
(hold) and 8.7 (delay).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..analysis.linear import linearize
from ..checks.numbers import as_numpy
from ..control.plant import Observe
from ..control.quadratic import held_matrices
from ..control.references import at_point
from ..dynamics.statespace.tree import TreePoint, TreeSpace
from ..math.compiler import kept_jit
from ..math.derivative import value_and_jacobian
from ..math.native.program import evaluate
from ..mechanics.forces import GroundContact
from ..mechanics.inputs import inputs_of
from ..mechanics.internal import internal_states
from ..mechanics.joint_forces import JointFriction
from ..mechanics.state import State
from ..mechanics.system import System
from .drag import AirframeDrag
from .flight_controller import FlightController, FlightGains, UavController, UavReference
from .inner_motion import BasePose, set_on_base
from .joint_controller import JointController, JointMotions, JointReference, read_joints
from .motor import MotorRotors
from .panel_servo import PanelServo, StrokeServo, panel_motion

Matrix = Float[np.ndarray, "..."]

# Excess of the spectral radius over 1 that is round-off: an integral that nothing reads has a 1.
MARGINAL = 1e-6
# Most periods of delay that are told apart; a longer delay is sampled more coarsely.
_MOST_LATE = 40
# Share of the mean squared speed at which slower rotors are linearised: a speed is the root of its command,
# which has no derivative at rest. The thrust's own derivative does not depend on it.
_SLOWEST_SHARE = 1e-6


class SampledLoop(NamedTuple):
    """Loop of a linear system with a controller of held, delayed inputs.

    Attributes:
        A, B: matrices of x' = A x + B u (n, n), (n, m). K: gains, u = -K x (m, n).
        rate: control rate [Hz]. delay: periods from a sample to the effect of its command.
        joints: true for the states of joints (n,).
    """

    A: Matrix
    B: Matrix
    K: Matrix
    rate: float
    delay: int
    joints: Bool[np.ndarray, " n"]

    def make_period_map(self) -> Matrix:
        """Matrix of the map over a period, of the states and of the commands on their way."""
        # Each period of delay adds states, and the cost of eigenvalues grows with their third power.
        coarse = max(1, -(-self.delay // _MOST_LATE))
        rate, delay = self.rate / coarse, round(self.delay / coarse)
        F, G = held_matrices(self.A, self.B, 1 / rate)
        (n, m), size = self.B.shape, self.A.shape[0] + delay * self.B.shape[1]
        period_map = np.zeros((size, size))
        # With the commands on their way as states, the delayed loop is a map without delay, and its
        # eigenvalues decide.
        period_map[:n, :n] = F
        if delay:
            # the commands on their way, the next first
            period_map[:n, n : n + m] = G
            period_map[n:-m, n + m :] = np.eye(size - n - m)
            period_map[-m:, :n] = -self.K
        else:
            period_map -= G @ self.K
        return period_map

    def compute_spectral_radius(self) -> float:
        """Largest size of the eigenvalues of the map over a period; below 1 for a stable loop."""
        return float(np.max(np.abs(np.linalg.eigvals(self.make_period_map()))))

    def compute_joint_share(self) -> float:
        """Participation of the joints' states in the mode of the largest eigenvalue, from 0 to 1."""
        from scipy.linalg import eig  # slow to import

        values, rows, columns = eig(self.make_period_map(), left=True, right=True)  # pyright: ignore[reportAssignmentType]
        slowest = int(np.argmax(np.abs(values)))
        shares = np.abs(rows[:, slowest] * columns[:, slowest])[: len(self.joints)]
        return float(np.sum(shares[self.joints]) / np.sum(shares))


class Hover(NamedTuple):
    """Small motions of a machine about level hover at a posture of its joints.

    Attributes:
        space: independent coordinates. point: the hover in them.
        reference: reference of the controller there.
        A, B: matrices of x' = A x + B u (n, n), (n, m). rate: control rate [Hz].
        observe: what the controller sees of the true motion, see `Plant`; None for the true state.
    """

    space: TreeSpace
    point: TreePoint
    reference: Any
    A: Matrix
    B: Matrix
    rate: float
    observe: Observe | None

    def close(self, pilot: Any, delay: int) -> SampledLoop:
        """Loop with a controller whose inputs act late by a number of periods.

        A controller for lost rotors gives up yaw: its angle and its rate are no states of the loop.
        """
        n, dof = self.space.size, self.space.dof
        response = _respond(pilot, self.space, self.point, self.reference, self.observe)
        K, memory = as_numpy((response.K, response.memory))
        stored = len(memory)
        A, B = np.zeros((n + stored,) * 2), np.zeros((n + stored, self.B.shape[1]))
        A[:n, :n], B[:n] = self.A, self.B
        # An integral is a sum over samples; the linear system has its mean rate.
        A[n:] = (memory - np.eye(stored, n + stored, n)) * self.rate
        joints = np.zeros(n + stored, bool)
        joints[6:dof] = joints[dof + 6 : 2 * dof] = True
        if flight_of(pilot).working is not None:
            keep = np.delete(np.arange(n + stored), [5, dof + 5])
            A, B, K, joints = A[np.ix_(keep, keep)], B[keep], K[:, keep], joints[keep]
        return SampledLoop(A, B, -K, self.rate, delay, joints)


def make_hover(
    system: System,
    state: State,
    inputs: Sequence[str],
    pilot: Any,
    rate: float,
    observe: Observe | None = None,
) -> Hover:
    """Small motions about level hover, with the inputs that a controller sets there.

    Args:
        system: the true machine, whose first body carries the rotors.
        state: posture of the joints; place, attitude and velocities are those of the hover.
        inputs: names of the inputs that the controller sets, in its order.
        pilot: `FlightController`, `UavController` or `JointController`. rate: control rate [Hz].
        observe: what the controller sees of the true motion, see `Plant`; None for the true state.

    Raises:
        ModelError, StateError: see `TreeSpace` and `linearize`.
    """
    left_out = AirframeDrag | GroundContact | JointFriction
    forces = tuple(force for force in system.forces if not isinstance(force, left_out))
    system = dataclasses.replace(system, forces=forces)
    hover = _level(state)
    space, named = TreeSpace(system, hover), inputs_of(system, inputs)
    point = space.from_state(hover)
    reference = _reference(pilot, hover)
    values = np.array(_respond(pilot, space, point, reference, observe).inputs)
    count = flight_of(pilot).wrenches.shape[1]
    values[:count] = np.maximum(values[:count], _SLOWEST_SHARE * np.mean(values[:count]))
    point = space.from_state(hover, internal_states(_with_speeds(system, values[:count])))
    linear = linearize(space, point, named, values)
    return Hover(space, point, reference, linear.A, linear.B, rate, observe)


def _with_speeds(system: System, squared: Matrix) -> System:
    """System whose motors turn with the squared speeds (k,) that they are commanded."""
    forces = list(system.forces)
    for k, force in enumerate(forces):
        if isinstance(force, MotorRotors) and force.time_constant is not None:
            speeds = force.speeds_of(jnp.asarray(squared))
            forces[k] = eqx.tree_at(lambda f: f.internal, force, speeds)
    return eqx.tree_at(lambda s: s.forces, system, tuple(forces))


def _level(state: State) -> State:
    """State at rest with the base level, 1 km above the origin and any ground, in the same posture."""
    rest, none = State(state.r, state.p, 0 * state.v, 0 * state.omega), jnp.zeros(3)
    return set_on_base(rest, BasePose(jnp.array([0.0, 0.0, 1e3]), jnp.eye(4)[0], none, none))


def _reference(pilot: Any, hover: State) -> Any:
    """Reference of a controller that holds a hover."""
    waypoint = at_point(hover.r[0])
    if isinstance(pilot, UavController):
        return UavReference(waypoint, panel_motion(hover))
    if isinstance(pilot, JointController):
        values, rates = read_joints(pilot.model.system, pilot.joints, hover)
        return JointReference(waypoint, JointMotions(values, rates, rates))
    return waypoint


class _Response(NamedTuple):
    """Inputs of a controller at a hover (m,), and derivatives of inputs and next memory by states and memory."""

    inputs: Float[Array, " m"]
    K: Float[Array, "m s"]
    memory: Float[Array, "i s"]


@kept_jit
def _respond(
    pilot: Any, space: TreeSpace, point: TreePoint, reference: Any, observe: Any
) -> _Response:
    """Response of a controller to small motions about a point."""
    memory, unravel = ravel_pytree(pilot.start())

    def command(z: Array) -> tuple[Array, Array]:
        state = space.to_state(space.retract(point, z[: space.size]))
        observed = state if observe is None else observe(jnp.zeros(()), state, point.internal)
        inputs, after = evaluate(pilot, observed, reference, unravel(z[space.size :]))
        return inputs, ravel_pytree(after)[0]

    start = jnp.concatenate([jnp.zeros(space.size), memory])
    (inputs, _), (K, stored) = value_and_jacobian(command, start)
    return _Response(inputs, K, stored)


def flight_of(pilot: Any) -> FlightController:
    """Controller of the rotors in a controller of a machine."""
    return pilot if isinstance(pilot, FlightController) else pilot.flight


# Powers of a frequency of the closed loop that gains are; those of joints have rows.
_POWERS = {
    PanelServo: {"frequency": 1},
    StrokeServo: {"stiffness": 2, "damping": 1},
    FlightGains: {"position": 2, "velocity": 1, "integral": 3, "attitude": 2, "rate": 1},
    JointController: {"gains": np.array([[1], [0], [2], [1]])},
}
Gains = TypeVar("Gains", PanelServo, StrokeServo, FlightGains, JointController)


def scale_frequency(gains: Gains, factor: float) -> Gains:
    """Gains of a closed loop that is faster by a factor, of the same shape."""
    powers = _POWERS[type(gains)]
    where = lambda g: [getattr(g, name) for name in powers]
    scaled_gains = [getattr(gains, name) * factor**power for name, power in powers.items()]
    return eqx.tree_at(where, gains, scaled_gains)


def scale_pilot(pilot: Any, factor: float, of_joints: bool) -> Any:
    """Controller whose loop of the joints, or else of position and attitude, is faster by a factor."""
    if of_joints and isinstance(pilot, JointController):
        return scale_frequency(pilot, factor)
    if of_joints:
        return eqx.tree_at(lambda p: p.servo, pilot, scale_frequency(pilot.servo, factor))
    gains = scale_frequency(flight_of(pilot).gains, factor)
    return eqx.tree_at(lambda p: flight_of(p).gains, pilot, gains)
