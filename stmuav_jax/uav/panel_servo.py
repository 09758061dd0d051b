"""Servos of the panel: computed torque or PD on the tracker's sliders, and the forces that a motion needs.

The panel angles x = (phi, theta) are to follow x_d; strokes q(x) and their Jacobian J = dq/dx are those
of the inverse kinematics. By computed torque,

    x'' = x_d'' + k_v (x_d' - x') + k_p (x_d - x),       f = J^-T (M(x) x'' + c(x, x') + g(x)),

with the equations of motion of the tracker's six bodies on their base; by plain proportional and
derivative control of the strokes, f = k_p (q_d - q) + k_d (q_d' - q').

Source: B. Siciliano, L. Sciavicco, L. Villani, G. Oriolo, Robotics: Modelling, Planning and Control
(2009), ch. 8.5 (inverse dynamics control); report Part II, Eq. 3.9, for the strokes.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.numbers import as_floats, as_numpy, check_positive
from ..checks.shapes import Numbers
from ..math.compiler import quick_jit
from ..math.native.program import native
from ..math.rotation import rotation_matrix
from ..mechanics.state import State
from ..mechanics.system import System
from .tracker.bodies import TRACKER_BODIES, posture
from .tracker.geometry import TrackerGeometry
from .tracker.kinematics import PairMotion, panel_angles, solve_2x2, stroke_jacobian, stroke_motion


class PanelBodies(NamedTuple):
    """Lengths, masses and inertias of the tracker's six bodies, in the order of `TRACKER_BODIES`.

    Attributes:
        geometry: lengths. shift: tracker's frame in the base's (3,) [m].
        mass: (6,) [kg]. inertia: own axes (6, 3, 3) [kg m^2].
    """

    geometry: TrackerGeometry
    shift: Float[Array, "3"]
    mass: Float[Array, "6"]
    inertia: Float[Array, "6 3 3"]


def panel_bodies(system: System, geometry: TrackerGeometry, shift: Numbers) -> PanelBodies:
    """The tracker's bodies of a system; raises `ModelError` if one of them is missing."""
    rows = np.array([system.index(name) for name in TRACKER_BODIES])
    mass, inertia = as_numpy((system.bodies.mass, system.bodies.inertia))
    return PanelBodies(geometry, as_floats(shift), as_floats(mass[rows]), as_floats(inertia[rows]))


class PanelReaction(NamedTuple):
    """Forces that move the panel, and what they do to the base at rest.

    Attributes:
        forces: forces of the actuators (2,) [N].
        moment: rate of the moving parts' angular momentum about a point, base axes (3,) [N m].
    """

    forces: Float[Array, "2"]
    moment: Float[Array, "3"]


@quick_jit
@native
def panel_motion(state: State) -> PairMotion:
    """Panel angles and their rates, with accelerations of zero, from true states of base and panel.

    The base is the first body, the panel the last.
    """
    R = rotation_matrix(state.p[0])
    R_17 = R.T @ rotation_matrix(state.p[-1])
    normal = R_17[:, 2]
    turning = R_17 @ state.omega[-1] - state.omega[0]
    angles, rates = jax.jvp(panel_angles, (normal,), (jnp.cross(turning, normal),))
    return PairMotion(angles, rates, jnp.zeros_like(rates))


def facing(direction_w: Float[Array, "3"], state: State) -> PairMotion:
    """Panel angles that face a direction of the world, and the rates by which they do so as the base
    turns; their accelerations are left out."""
    R = rotation_matrix(state.p[0])
    direction_b = R.T @ direction_w
    direction_rate = -jnp.cross(state.omega[0], direction_b)
    angles, rates = jax.jvp(panel_angles, (direction_b,), (direction_rate,))
    return PairMotion(angles, rates, jnp.zeros_like(rates))


def inverse_dynamics(
    bodies: PanelBodies, angles: PairMotion, gravity_b: Float[Array, "3"], about: Float[Array, "3"]
) -> PanelReaction:
    """Actuator forces for a motion of the panel on a base at rest.

    Args:
        angles: angles, rates and target accelerations.
        gravity_b: acceleration of free fall, base axes (3,) [m/s^2]; less that of the base.
        about: point of the base for the moment (3,) [m].
    """
    geometry = bodies.geometry

    def body_speeds(x: Array, rates: Array) -> tuple[Array, Array, Array, Array]:
        state = posture(geometry, x, rates)
        return state.v, state.omega, state.r, jax.vmap(rotation_matrix)(state.p)

    primals, rates = (angles.value, angles.rate), (angles.rate, angles.acceleration)
    # One derivative along the motion gives accelerations with all terms of the rates squared.
    (_, omega, r, R), (a, alpha, *_) = jax.jvp(body_speeds, primals, rates)
    # Kane's method: speeds are linear in the rates, so that unit rates give the partial velocities.
    partial_velocities, turns, *_ = jax.vmap(lambda e: body_speeds(angles.value, e))(jnp.eye(2))
    angular_momenta = lambda x: jnp.einsum("nij,nj->ni", bodies.inertia, x)
    spin = angular_momenta(alpha) + jnp.cross(omega, angular_momenta(omega))
    inertial = bodies.mass[:, None] * a
    load = inertial - bodies.mass[:, None] * gravity_b[None]
    generalised_forces = jnp.einsum("kni,ni->k", partial_velocities, load)
    generalised_forces = generalised_forces + jnp.einsum("kni,ni->k", turns, spin)
    J = stroke_jacobian(geometry, angles.value)
    arms = r + (bodies.shift - about)[None]
    moment = jnp.sum(jnp.cross(arms, inertial), axis=0) + jnp.einsum("nij,nj->i", R, spin)
    # Power of the actuators equals that of the generalised forces; near a singular posture the forces
    # grow without bound.
    return PanelReaction(solve_2x2(J.T, generalised_forces), moment)


class PanelServo(eqx.Module):
    """Servo of the panel angles by computed torque.

    Args:
        bodies: the tracker's bodies, see `panel_bodies`.
        frequency: natural frequency of the errors [rad/s]: k_p = frequency^2.
        damping: damping ratio [1]: k_v = 2 damping frequency.
    """

    bodies: PanelBodies
    frequency: Float[Array, ""] = eqx.field(converter=as_floats, default=120.0)
    damping: Float[Array, ""] = eqx.field(converter=as_floats, default=1.0)

    def __check_init__(self) -> None:
        check_positive(self.frequency, "The frequency of the panel's servo", "rad/s")
        check_positive(self.damping, "The damping ratio of the panel's servo", "1")

    def command(
        self,
        angles: PairMotion,
        target: PairMotion,
        gravity_b: Float[Array, "3"],
        about: Float[Array, "3"],
    ) -> PanelReaction:
        """Actuator forces, and the moment that the motion takes; see `inverse_dynamics`."""
        w, d = self.frequency, self.damping
        acceleration = target.acceleration + 2 * d * w * (target.rate - angles.rate)
        acceleration = acceleration + w**2 * (target.value - angles.value)
        motion = angles._replace(acceleration=acceleration)
        return inverse_dynamics(self.bodies, motion, gravity_b, about)


class StrokeServo(eqx.Module):
    """Servo of the strokes by proportional and derivative control, without a model of masses.

    Args:
        bodies: the tracker's bodies; only their lengths are used.
        stiffness: k_p [N/m]. damping: k_d [N s/m].
    """

    bodies: PanelBodies
    stiffness: Float[Array, ""] = eqx.field(converter=as_floats, default=2e4)
    damping: Float[Array, ""] = eqx.field(converter=as_floats, default=200.0)

    def __check_init__(self) -> None:
        check_positive(self.stiffness, "The stiffness of the strokes' servo", "N/m")
        check_positive(self.damping, "The damping of the strokes' servo", "N s/m")

    def command(
        self,
        angles: PairMotion,
        target: PairMotion,
        gravity_b: Float[Array, "3"],
        about: Float[Array, "3"],
    ) -> PanelReaction:
        """Actuator forces; the moment of the motion is not known, and zero."""
        del gravity_b, about
        measured, desired = (stroke_motion(self.bodies.geometry, x) for x in (angles, target))
        forces = self.stiffness * (desired.value - measured.value)
        forces = forces + self.damping * (desired.rate - measured.rate)
        return PanelReaction(forces, jnp.zeros(3))
