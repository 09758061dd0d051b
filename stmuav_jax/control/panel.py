"""Servo of the tracker's sliders, which turns the panel.

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

from ..algebra.compiler import quick_jit
from ..algebra.rotation import rotation_matrix
from ..checks.numbers import as_numpy, floats, positive
from ..checks.shapes import Numbers
from ..mechanics.state import State
from ..mechanics.system import System
from ..tracker.geometry import TrackerGeometry
from ..tracker.kinematics import (
    PairMotion,
    panel_angles,
    solve_2x2,
    stroke_jacobian,
    stroke_motion,
)
from ..tracker.placement import TRACKER_BODIES, posture


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
    return PanelBodies(geometry, floats(shift), floats(mass[rows]), floats(inertia[rows]))


class PanelReaction(NamedTuple):
    """Forces that move the panel, and what they do to the base at rest.

    Attributes:
        forces: forces of the actuators (2,) [N].
        moment: rate of the moving parts' angular momentum about a point, base axes (3,) [N m].
    """

    forces: Float[Array, "2"]
    moment: Float[Array, "3"]


@quick_jit
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
    ahead = R.T @ direction_w
    angles, rates = jax.jvp(panel_angles, (ahead,), (-jnp.cross(state.omega[0], ahead),))
    return PairMotion(angles, rates, jnp.zeros_like(rates))


def inverse_dynamics(
    bodies: PanelBodies,
    angles: PairMotion,
    gravity_b: Float[Array, "3"],
    about: Float[Array, "3"],
) -> PanelReaction:
    """Actuator forces for a motion of the panel on a base at rest.

    Args:
        angles: angles, rates and wanted accelerations.
        gravity_b: acceleration of free fall, base axes (3,) [m/s^2]; less that of the base.
        about: point of the base for the moment (3,) [m].
    """
    geometry = bodies.geometry

    def speeds(x: Array, rates: Array) -> tuple[Array, Array, Array, Array]:
        at = posture(geometry, x, rates)
        return at.v, at.omega, at.r, jax.vmap(rotation_matrix)(at.p)

    first, rates = (angles.value, angles.rate), (angles.rate, angles.acceleration)
    (_, omega, r, R), (a, alpha, *_) = jax.jvp(speeds, first, rates)
    along, turns, *_ = jax.vmap(lambda e: speeds(angles.value, e))(jnp.eye(2))
    own = lambda x: jnp.einsum("nij,nj->ni", bodies.inertia, x)
    spin = own(alpha) + jnp.cross(omega, own(omega))
    inertial = bodies.mass[:, None] * a
    load = inertial - bodies.mass[:, None] * gravity_b
    needed = jnp.einsum("kni,ni->k", along, load) + jnp.einsum("kni,ni->k", turns, spin)
    J = stroke_jacobian(geometry, angles.value)
    arms = r + bodies.shift - about
    moment = jnp.sum(jnp.cross(arms, inertial), axis=0) + jnp.einsum("nij,nj->i", R, spin)
    return PanelReaction(solve_2x2(J.T, needed), moment)


class PanelServo(eqx.Module):
    """Servo of the panel angles by computed torque.

    Args:
        bodies: the tracker's bodies, see `panel_bodies`.
        frequency: natural frequency of the errors [rad/s]: k_p = frequency^2.
        damping: damping ratio [1]: k_v = 2 damping frequency.
    """

    bodies: PanelBodies
    frequency: Float[Array, ""]
    damping: Float[Array, ""]

    def __init__(
        self, bodies: PanelBodies, frequency: Numbers = 120.0, damping: Numbers = 1.0
    ) -> None:
        self.bodies = bodies
        self.frequency = positive(frequency, "The frequency of the panel's servo", "rad/s")
        self.damping = positive(damping, "The damping ratio of the panel's servo", "1")

    def command(
        self,
        angles: PairMotion,
        wanted: PairMotion,
        gravity_b: Float[Array, "3"],
        about: Float[Array, "3"],
    ) -> PanelReaction:
        """Actuator forces, and the moment that the motion takes; see `inverse_dynamics`."""
        w, d = self.frequency, self.damping
        onwards = (
            wanted.acceleration
            + 2 * d * w * (wanted.rate - angles.rate)
            + w**2 * (wanted.value - angles.value)
        )
        return inverse_dynamics(
            self.bodies, angles._replace(acceleration=onwards), gravity_b, about
        )


class StrokeServo(eqx.Module):
    """Servo of the strokes by proportional and derivative control, which knows no masses.

    Args:
        bodies: the tracker's bodies; only their lengths are used.
        stiffness: k_p [N/m]. damping: k_d [N s/m].
    """

    bodies: PanelBodies
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]

    def __init__(
        self, bodies: PanelBodies, stiffness: Numbers = 2e4, damping: Numbers = 200.0
    ) -> None:
        self.bodies = bodies
        self.stiffness = positive(stiffness, "The stiffness of the strokes' servo", "N/m")
        self.damping = positive(damping, "The damping of the strokes' servo", "N s/m")

    def command(
        self,
        angles: PairMotion,
        wanted: PairMotion,
        gravity_b: Float[Array, "3"],
        about: Float[Array, "3"],
    ) -> PanelReaction:
        """Actuator forces; the moment of the motion is not known, and zero."""
        del gravity_b, about
        now = stroke_motion(self.bodies.geometry, angles)
        goal = stroke_motion(self.bodies.geometry, wanted)
        forces = self.stiffness * (goal.value - now.value) + self.damping * (goal.rate - now.rate)
        return PanelReaction(forces, jnp.zeros(3))
