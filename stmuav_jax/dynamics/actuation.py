"""Actuation of a mechanism in a posture: what its inputs do to its motions, on a scale of weight and size.

Motions y are independent body velocities of unit size: the root of the sum over bodies of
|v|^2 + L^2 |omega|^2 is one, with the size L of the mechanism. The generalised forces of the inputs u on
them are

    T = N^T (d wrenches / d u) S / W    (dof, m),

with the bodies' velocities N in the unit motions, the weight W, and S of W for inputs in N and of W L for
those in N m. A singular value sigma of T means that it takes inputs of 1 / sigma weights to push with one
weight along the weakest motion. Two kinds of singular postures follow:

    direct, type 2     the rank of T drops: a motion is left that the inputs do not hold
    inverse, type 1    the rank of a body's velocities in N drops: inputs move without it

Source: C. Gosselin, J. Angeles, Singularity analysis of closed-loop kinematic chains, IEEE Trans. Robotics
and Automation 6 (1990) 281-290.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..math import lapack
from ..math.compiler import kept_jit
from ..math.native.program import native
from ..math.space import Point
from ..mechanics.body import GROUND
from ..mechanics.inputs import Inputs
from ..mechanics.internal import with_internal
from ..mechanics.joint_states import coordinates_of
from ..mechanics.load import total_load
from ..mechanics.size import mechanism_size, mechanism_weight
from ..mechanics.state import State
from ..mechanics.system import System
from .statespace.base import AbstractStateSpace, Time
from .statespace.tree import TreePoint

# Smallest singular value of T below which inputs count as without hold: a hundred weights for one.
WEAK = 1e-2
# Share of the largest component above which joints and inputs are named, and their largest number.
_NAMED, _MOST_NAMES = 0.3, 8


class Actuation(NamedTuple):
    """Effect of the inputs on the unit motions of a mechanism, at one posture or stacked.

    Attributes:
        forces: T, generalised forces of inputs of one weight, in weights (dof, m); see this module.
        load: generalised forces of everything else and of the inputs' present values, in weights (dof,).
        motions: N, velocities (v world, omega in body axes) of all bodies in the unit motions (6 n, dof).
        velocities: the same by the space's independent velocities (6 n, dof).
        weight: weight [N], of all bodies. size: size of the mechanism [m].
        scales: inputs that count as one (m,): W in N, W L in N m; one of its unit for any other.
    """

    forces: Float[Array, "*s dof m"]
    load: Float[Array, "*s dof"]
    motions: Float[Array, "*s k dof"]
    velocities: Float[Array, "*s k dof"]
    weight: Float[Array, "*s"]
    size: Float[Array, "*s"]
    scales: Float[Array, "*s m"]


def effort_unit(system: System, joint_name: str, coordinate: str | None) -> str:
    """Unit of an effort on a joint's coordinate, or on its only one: "N" or "N m"."""
    coordinates = dict(coordinates_of(system.joints[system.joint_index(joint_name)].kind))
    chosen = coordinates.get(coordinate or "", next(iter(coordinates.values()), ""))
    return "N" if chosen == "m" else "N m"


def force_units(system: System, inputs: Inputs) -> tuple[str, ...]:
    """Unit of each input: "N", "N m", or "" for another one, such as a servo's target."""
    units = []
    for entry in inputs.entries:
        unit = entry.unit
        for name, coordinate in system.forces[entry.force].acts_on().coordinates:
            if unit == "N or N m":
                unit = effort_unit(system, name, coordinate)
        units.append(unit if unit in ("N", "N m") else "")
    return tuple(units)


def input_scales(
    system: System, inputs: Inputs, weight: Float[Array, ""], size: Float[Array, ""]
) -> Float[Array, " m"]:
    """Inputs that count as one (m,): the weight [N], weight times size [N m], one of any other unit."""
    scale = {"N": weight, "N m": weight * size, "": jnp.ones_like(weight)}
    units = force_units(system, inputs)
    return jnp.stack([scale[unit] for unit in units]) if units else jnp.zeros((0,))


def compute_actuation(
    space: AbstractStateSpace,
    x: Point,
    inputs: Inputs,
    values: Float[Array, " m"],
    t: Time = 0.0,
) -> Actuation:
    """Effect of the inputs on the motions of a mechanism at a point; NaN where loops do not close.

    The function is pure: it may be jitted and vmapped.
    """
    time, dof = jnp.asarray(t, float), space.dof
    # body velocities are affine in the independent ones; one stack, since closing the loops is what compiles
    unit = jnp.zeros((1 + dof, space.size)).at[1:, dof : 2 * dof].set(jnp.eye(dof))
    states = jax.vmap(lambda e: space.to_state(space.retract(x, e), t))(unit)
    state = jax.tree.map(lambda leaf: leaf[0], states)
    rows = jnp.concatenate([states.v, states.omega], axis=2).reshape(1 + dof, -1)
    columns = rows[1:] - rows[:1]

    total_wrenches = lambda values: _total_wrenches(space, x, inputs, values, time, state)
    weight, size = mechanism_weight(space.system), mechanism_size(space.system, state)
    metric = jnp.tile(
        jnp.repeat(jnp.stack([jnp.ones_like(size), size]), 3), len(space.system.names)
    )
    Q, _ = lapack.factor_qr(metric[:, None] * columns.T)
    motions = Q / metric[:, None]
    scales = input_scales(space.system, inputs, weight, size)
    by_inputs = jax.jacfwd(total_wrenches)(values) if len(inputs) else jnp.zeros((len(metric), 0))
    return Actuation(
        motions.T @ (by_inputs * scales[None]) / weight,
        motions.T @ total_wrenches(values) / weight,
        motions,
        columns.T,
        weight,
        size,
        scales,
    )


@native
def _total_wrenches(
    space: AbstractStateSpace, x: Point, inputs: Inputs, values: Array, t: Array, state: State
) -> Float[Array, " k"]:
    """Forces and moments on all bodies (6 n,), with the inputs at these values."""
    system = inputs.applied(space.system, values)
    if isinstance(x, TreePoint) and x.internal.shape[0]:
        system = with_internal(system, x.internal)
    total = total_load(system.forces, t, system.kinematics(state))
    return jnp.concatenate([total.force, total.moment], axis=1)[:-1].reshape(-1)


@kept_jit
def actuation_along(
    space: AbstractStateSpace,
    x: Point,
    steps: Float[Array, "k size"],
    inputs: Inputs,
    values: Float[Array, " m"],
    t: Float[Array, ""],
) -> Actuation:
    """Actuation at the points retract(x, step), stacked along the first axis."""
    return jax.vmap(
        lambda step: compute_actuation(space, space.retract(x, step), inputs, values, t)
    )(steps)


def joints_in_motion(
    system: System, state: State, motions: Float[np.ndarray, "k c"], size: float
) -> tuple[str, ...]:
    """Names of the joints that move most in some motions (6 n, c) of all bodies, the fastest first."""
    kin = system.kinematics(state)
    v, omega = np.split(motions.reshape(len(system.names), 6, -1), 2, axis=1)

    def end_velocity(name: str, point: Array) -> tuple[np.ndarray, np.ndarray]:
        if name == GROUND:
            return np.zeros(v.shape[1:]), np.zeros(v.shape[1:])
        k = system.index(name)
        omega_w = np.asarray(kin.R_wb[kin.index(name)]) @ omega[k]
        arm = np.asarray(kin.point(name, point)[0]) - np.asarray(state.r[k])
        return v[k] + np.cross(omega_w, arm[:, None], axis=0), omega_w

    speeds = []
    for joint in system.joints:
        v_i, omega_i = end_velocity(joint.body_i, joint.point_i)
        v_j, omega_j = end_velocity(joint.body_j, joint.point_j)
        speeds.append(np.hypot(np.linalg.norm(v_j - v_i), size * np.linalg.norm(omega_j - omega_i)))
    return names_of_largest([joint.name for joint in system.joints], np.array(speeds))


def input_labels(system: System, inputs: Inputs) -> list[str]:
    """Names of the inputs, with what they act on where the name does not say it."""
    labels = []
    for entry in inputs.entries:
        owner = str(system.forces[entry.force].acts_on())
        labels.append(entry.name if owner in entry.name else f"{entry.name} ({owner})")
    return labels


def names_of_largest(names: list[str], components: np.ndarray) -> tuple[str, ...]:
    """Names of the components (k,), or rows of them (k, c), that are not small compared with the largest."""
    sizes = np.linalg.norm(components.reshape(len(names), -1), axis=1)
    order = [k for k in np.argsort(-sizes, kind="stable") if sizes[k] > _NAMED * np.max(sizes)]
    return tuple(names[k] for k in order[:_MOST_NAMES])
