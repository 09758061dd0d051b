"""Inverse dynamics of any mechanism along a path, and the effect of joint clearances on its pose.

Along a path with known accelerations a, the inputs u balance the generalised forces on all independent motions N,

    N^T (d wrenches / d u) u = N^T (M a + h - wrenches at u = 0).

With its actuators locked, rows J of all joints and of the locked coordinates determine the posture; errors e
of the rows move the bodies by -J^+ e. Errors that contradict each other, as in planar loops, are shared.

Source: P. E. Nikravesh, Computer-Aided Analysis of Mechanical Systems (1988), ch. 11 (inverse dynamics); J.-P. Merlet,
Parallel Robots (2006), ch. 9 (errors of geometry).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..checks.numbers import check_numbers
from ..checks.shapes import Numbers
from ..dynamics.actuation import Actuation, compute_actuation
from ..dynamics.assembly.closing import UniformMotion
from ..dynamics.assembly.prescribed import add_drivers, kinematic_path
from ..dynamics.formulations.constraints import Constraints, group_constraints
from ..dynamics.formulations.independence import DEPENDENT
from ..dynamics.statespace.tree import TreeSpace
from ..math.compiler import kept_jit
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.joint import Motion
from ..mechanics.joint_states import joint_motion
from ..mechanics.state import State
from ..mechanics.system import System


class PathEfforts(NamedTuple):
    """Inputs that move a mechanism along a path.

    Attributes:
        ts: times (k,) [s]. states: states of all bodies (k, n, .).
        v_rate: accelerations, world (k, n, 3) [m/s^2]. omega_rate: body axes [rad/s^2].
        values: inputs, of minimum norm in weights where they are redundant (k, m).
        unbalanced: largest generalised force, in weights, that the inputs leave (k,).
        inputs: names and units of the inputs.
    """

    ts: Float[np.ndarray, " k"]
    states: State
    v_rate: Float[np.ndarray, "k n 3"]
    omega_rate: Float[np.ndarray, "k n 3"]
    values: Float[np.ndarray, "k m"]
    unbalanced: Float[np.ndarray, " k"]
    inputs: tuple[tuple[str, str], ...]


@kept_jit
def _actuations(
    space: TreeSpace, states: State, rates: tuple[Array, Array], inputs: Inputs, ts: Array
) -> tuple[Actuation, Float[Array, "k dof"]]:
    """Actuation at states, and the generalised forces that the accelerations need, in weights."""
    mass, inertia = space.system.bodies.mass, space.system.bodies.inertia

    def evaluate(
        state: State, v_rate: Array, omega_rate: Array, t: Array
    ) -> tuple[Actuation, Array]:
        x = space.from_state(state)
        actuation = compute_actuation(space, x, inputs, jnp.zeros(len(inputs)), t)
        # Newton's and Euler's equations of each body give what its acceleration needs; projected
        # to the free motions, reactions in joints drop out, and what is left is for the actuators
        # and other forces.
        momentum = lambda w: jnp.einsum("nij,nj->ni", inertia, w)
        moment = momentum(omega_rate) + jnp.cross(state.omega, momentum(state.omega))
        needed = jnp.concatenate([mass[:, None] * v_rate, moment], axis=1).reshape(-1)
        return actuation, actuation.motions.T @ needed / actuation.weight

    return jax.vmap(evaluate)(states, *rates, ts)


def inverse_dynamics(
    system: System,
    motions: Mapping[str, Motion],
    ts: Numbers,
    *,
    inputs: Inputs | None = None,
    state: State | None = None,
) -> PathEfforts:
    """Inputs of any mechanism that move its joints along a path, with loops, springs and redundant inputs.

    The joints that move need not be those of the actuators: a path of a passive joint has the actuators' efforts too.

    Args:
        motions: functions from t [s] to the coordinate of each named joint, as many as there are degrees of
            freedom, see `stmuav_jax.dynamics.add_drivers`. ts: times (k,) [s], rising, close enough for
            Newton's method.
        inputs: inputs of the actuators, see `inputs_of`; by default all of the system. Their present values do
            not count.
        state: posture near that at the first time; by default the reference posture.

    Raises:
        ModelError: the motion is not determined. StateError: the path stops, at a singular posture or elsewhere.
    """
    times = jnp.asarray(check_numbers(ts, np.shape(ts), "The times of a path", "s"))
    state = system.reference if state is None else state
    # Drivers determine the motion and are removed again: their own efforts would be those of
    # motors in these joints, where the actuators may be elsewhere.
    path = kinematic_path(add_drivers(system, motions), state, times)
    inputs = inputs_of(system) if inputs is None else inputs
    # Any independent coordinates will do for the projection; those of the start are good where the
    # path stays away from singular postures.
    space = TreeSpace(system, jax.tree.map(lambda x: x[0], path.states))
    actuations, needed = jax.tree.map(
        np.asarray, _actuations(space, path.states, (path.v_rate, path.omega_rate), inputs, times)
    )
    T, missing = actuations.forces, needed - actuations.load
    # Redundant actuators have many solutions: the smallest is taken, with all inputs on one scale
    # of weight and size.
    shares = np.einsum("kmd,kd->km", np.linalg.pinv(T, rcond=DEPENDENT**2), missing)
    # What the actuators cannot give is part of the result: the path may be impossible for them
    # even where it is determined.
    remainder = missing - np.einsum("kdm,km->kd", T, shares)
    states, v_rate, omega_rate = jax.tree.map(
        np.asarray, (path.states, path.v_rate, path.omega_rate)
    )
    return PathEfforts(
        np.asarray(times), states, v_rate, omega_rate, shares * actuations.scales,
        np.max(np.abs(remainder), axis=1, initial=0.0), inputs.names,
    )  # fmt: skip


class Clearance(NamedTuple):
    """Largest motion of a body for a clearance of one joint, with the actuators locked.

    Attributes:
        joint: name of the joint.
        translation: of the body's centre of mass, by errors of position [m/m] and of direction [m/rad].
        rotation: of the body, by errors of position [rad/m] and of direction [rad/rad].
    """

    joint: str
    translation: tuple[float, float]
    rotation: tuple[float, float]


@kept_jit
def _rows(system: System, rows: Constraints, state: State) -> Float[Array, "m k"]:
    return rows.equations(jnp.zeros(()), system.kinematics(state)).matrix


def compare_clearances(
    system: System, locked: Sequence[str], body: str, state: State | None = None
) -> tuple[Clearance, ...]:
    """Sensitivity of a body's pose to the clearance of each joint, the most sensitive first.

    Errors of all rows of a joint of any direction and of unit size are compared; locked joints have the errors of
    their drives too, listed as "drive JOINT".

    Args:
        locked: joints that actuators hold, as many as there are degrees of freedom.
        body: name of the body, such as a platform. state: posture; by default the reference posture.

    Raises:
        SettingError: the locked joints do not determine the posture. ModelError: an unknown name.
    """
    state = system.reference if state is None else state
    place = system.index(body)
    zero = jnp.zeros(())
    hold = lambda name: UniformMotion(
        jnp.asarray(joint_motion(system, state, name).coordinates[0]), zero, zero
    )
    # Actuators are locked by drivers at their present coordinates: the mechanism has no freedom
    # left, and every error of a row moves the bodies by a definite amount.
    locked_system = add_drivers(system, {name: hold(name) for name in locked})
    rows = group_constraints(locked_system)
    J = np.asarray(_rows(locked_system, rows, state)) * np.asarray(rows.scales())[:, None]
    left_vectors, values, right = np.linalg.svd(J, full_matrices=False)
    rank_mask = values > DEPENDENT * values[0]
    if np.sum(rank_mask) < J.shape[1]:
        raise SettingError(
            f"With {', '.join(locked) or 'nothing'} locked the mechanism keeps {J.shape[1] - int(np.sum(rank_mask))} "
            "degrees of freedom: lock one joint for each, away from singular postures."
        )
    # The pseudoinverse is taken from the singular values at hand; rows that repeat others share an
    # error, as in a real overconstrained mechanism.
    moves = ((right.T[:, rank_mask] / values[rank_mask]) @ left_vectors.T[rank_mask])[
        6 * place : 6 * place + 6
    ]
    owner, angular = np.array(rows.owner), rows.angular
    result = []
    for k, joint in enumerate(locked_system.joints):
        parts = [
            part[:, (owner == k) & kind]
            for part in (moves[:3], moves[3:])
            for kind in (~angular, angular)
        ]
        sizes = [float(np.linalg.norm(part, 2)) if part.size else 0.0 for part in parts]
        result.append(Clearance(joint.name, (sizes[0], sizes[1]), (sizes[2], sizes[3])))
    return tuple(sorted(result, key=lambda c: -max(*c.translation, *c.rotation)))
