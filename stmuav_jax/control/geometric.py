"""Geometric control of position and attitude for flying machines with parallel rotors.

With errors e_x, e_v of position and velocity, and R_d the attitude whose z axis is along F and whose
x axis is nearest to the wanted heading,

    F   = -k_x e_x - k_v e_v - k_i q - m g + m a_d,       f = F . R e_z
    e_R = vee(R_d^T R - R^T R_d) / 2,                   e_W = W - R^T R_d W_d
    M   = -k_R e_R - k_W e_W + W x (J W + h) + M_s - J (W x R^T R_d W_d - R^T R_d dW_d/dt)

where g is the acceleration of free fall, q the integral of e_x, h the angular momentum of parts that
move against the base, and M_s the moment that accelerates them. W_d and its rate follow from the
controller's own F along the motion that it asks for. The attitude error decays from all attitudes less
than half a turn away.

Source: T. Lee, M. Leok, N. H. McClamroch, Geometric tracking control of a quadrotor UAV on SE(3),
49th IEEE Conference on Decision and Control (2010), Eq. 10 to 23 (z axis down there, up here).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..checks.numbers import nonnegative, numbers, positive
from ..checks.shapes import Numbers
from ..mechanics.state import State


class Waypoint(NamedTuple):
    """Wanted motion of a flying machine at one time.

    Attributes:
        r, v, a: position, velocity, acceleration of the base, world (3,) [m], [m/s], [m/s^2].
        jerk, snap: first and second rate of the acceleration (3,) [m/s^3], [m/s^4].
        heading: yaw of the base's x axis [rad]. turning, turning_rate: its first and second rate
            [rad/s], [rad/s^2].
    """

    r: Float[Array, "3"]
    v: Float[Array, "3"]
    a: Float[Array, "3"]
    jerk: Float[Array, "3"]
    snap: Float[Array, "3"]
    heading: Float[Array, ""]
    turning: Float[Array, ""]
    turning_rate: Float[Array, ""]


def at_point(r: Numbers, heading: Numbers = 0.0) -> Waypoint:
    """Waypoint at rest at a position (3,) [m] with a yaw [rad]."""
    place = numbers(r, (3,), "The position of a waypoint", "m")
    yaw = numbers(heading, (), "The heading of a waypoint", "rad")
    zero = jnp.zeros(3)
    return Waypoint(place, zero, zero, zero, zero, yaw, jnp.zeros(()), jnp.zeros(()))


def along(path: Callable[[Array], Any], heading: Callable[[Array], Any] | None = None) -> Any:
    """Reference function t -> `Waypoint` from a smooth path t [s] -> (3,) [m], by derivatives.

    Args:
        heading: function of t to the yaw [rad]; by default zero.
    """

    def rate(f: Callable[[Array], Any]) -> Callable[[Array], Any]:
        return lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]

    yaw = (lambda t: jnp.zeros_like(t)) if heading is None else heading
    place = lambda t: jnp.asarray(path(t))
    v = rate(place)
    a = rate(v)
    jerk = rate(a)
    snap = rate(jerk)
    turning = rate(yaw)

    def at(t: Array) -> Waypoint:
        t = jnp.asarray(t, dtype=float)
        return Waypoint(
            place(t), v(t), a(t), jerk(t), snap(t), yaw(t), turning(t), rate(turning)(t)
        )

    return at


class MassProperties(NamedTuple):
    """Mass properties of a machine, all bodies together.

    Attributes:
        mass: [kg]. centre: centre of mass from the base's, its axes (3,) [m].
        J: inertia about it, base axes (3, 3) [kg m^2].
        h: angular momentum of parts that move against the base (3,) [N m s].
        moment: moment M_s that accelerates these parts (3,) [N m].
    """

    mass: Float[Array, ""]
    centre: Float[Array, "3"]
    J: Float[Array, "3 3"]
    h: Float[Array, "3"]
    moment: Float[Array, "3"]


class FlightGains(eqx.Module):
    """Gains of `wrench_for`, per unit of mass and inertia.

    With equal gains about all axes the errors of small motions obey e'' + k_v e' + k_x e = 0.

    Attributes:
        position: k_x / m [1/s^2]. velocity: k_v / m [1/s]. integral: k_i / m [1/s^3].
        attitude: k_R / J [1/s^2]. rate: k_W / J [1/s].
    """

    position: Float[Array, ""]
    velocity: Float[Array, ""]
    integral: Float[Array, ""]
    attitude: Float[Array, ""]
    rate: Float[Array, ""]

    def __init__(
        self,
        position: Numbers = 9.0,
        velocity: Numbers = 5.0,
        integral: Numbers = 0.0,
        attitude: Numbers = 200.0,
        rate: Numbers = 25.0,
    ) -> None:
        what = "gain of the flight controller"
        self.position = positive(position, f"The position {what}", "1/s^2")
        self.velocity = positive(velocity, f"The velocity {what}", "1/s")
        self.integral = nonnegative(integral, f"The integral {what}", "1/s^3")
        self.attitude = positive(attitude, f"The attitude {what}", "1/s^2")
        self.rate = positive(rate, f"The rate {what}", "1/s")


class BaseMotion(NamedTuple):
    """Motion of a machine's base: position, rotation, velocity (world), angular velocity (base)."""

    r: Float[Array, "3"]
    R: Float[Array, "3 3"]
    v: Float[Array, "3"]
    omega: Float[Array, "3"]


def base_motion(state: State) -> BaseMotion:
    """Motion of the first body of a state."""
    return BaseMotion(state.r[0], rotation_matrix(state.p[0]), state.v[0], state.omega[0])


class WantedWrench(NamedTuple):
    """Wrench that a flight controller asks for, and its errors.

    Attributes:
        wrench: thrust along the base's z axis [N] and moments about the centre of mass [N m] (4,).
        force: F, world (3,) [N].
        attitude_error: e_R (3,) [rad]. rate_error: e_W (3,) [rad/s].
    """

    wrench: Float[Array, "4"]
    force: Float[Array, "3"]
    attitude_error: Float[Array, "3"]
    rate_error: Float[Array, "3"]


def vee(M: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Vector of the antisymmetric part of a matrix."""
    return 0.5 * jnp.stack([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])


def attitude_of(force: Float[Array, "3"], heading: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Attitude R_d with z along a force and x nearest to a heading [rad]; NaN for a level heading
    along the force."""
    z = force / jnp.sqrt(jnp.sum(force * force))
    ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)])
    y = jnp.cross(z, ahead)
    y = y / jnp.sqrt(jnp.sum(y * y))
    return jnp.stack([jnp.cross(y, z), y, z], axis=1)


def wrench_for(
    base: BaseMotion,
    wanted: Waypoint,
    mass: MassProperties,
    gains: FlightGains,
    gravity: Float[Array, "3"],
    integral: Float[Array, "3"],
) -> WantedWrench:
    """Thrust and moments of the geometric controller; the module's docstring has its equations.

    Args:
        gravity: acceleration of free fall (3,) [m/s^2]. integral: q (3,) [m s].
    """
    m, R, W = mass.mass, base.R, base.omega

    def force(r: Array, v: Array, at: Waypoint, sum_of: Array) -> Array:
        pull = gains.position * (at.r - r) + gains.velocity * (at.v - v) - gains.integral * sum_of
        return m * (pull + at.a - gravity)

    F = force(base.r, base.v, wanted, integral)
    thrust = F @ R[:, 2]
    # the acceleration that the thrust gives, and its rate as the machine turns
    a = thrust / m * R[:, 2] + gravity
    F_rate = m * (
        gains.position * (wanted.v - base.v)
        + gains.velocity * (wanted.a - a)
        - gains.integral * (base.r - wanted.r)
        + wanted.jerk
    )
    turned = R @ jnp.cross(W, jnp.array([0.0, 0.0, 1.0]))
    a_rate = ((F_rate @ R[:, 2] + F @ turned) * R[:, 2] + thrust * turned) / m
    zero = jnp.zeros_like(thrust)

    def ahead(s: Array) -> Array:
        """F a time s later, along the motion with this acceleration's own rate."""
        step = wanted._replace(
            r=wanted.r + s * wanted.v + s**2 / 2 * wanted.a,
            v=wanted.v + s * wanted.a + s**2 / 2 * wanted.jerk,
            a=wanted.a + s * wanted.jerk + s**2 / 2 * wanted.snap,
        )
        r, v = base.r + s * base.v + s**2 / 2 * a, base.v + s * a + s**2 / 2 * a_rate
        return force(r, v, step, integral + s * (base.r - wanted.r))

    def turning(s: Array) -> tuple[Array, Array]:
        """R_d a time s later, and W_d."""
        yaw = lambda s: wanted.heading + s * wanted.turning + s**2 / 2 * wanted.turning_rate
        attitude = lambda s: attitude_of(ahead(s), yaw(s))
        R_d, rate = jax.jvp(attitude, (s,), (jnp.ones_like(s),))
        return R_d, vee(R_d.T @ rate)

    (R_d, W_d), (_, W_d_rate) = jax.jvp(turning, (zero,), (jnp.ones_like(zero),))
    e_R = vee(R_d.T @ R)
    back = R.T @ R_d
    e_W = W - back @ W_d
    J = mass.J
    moment = J @ (-gains.attitude * e_R - gains.rate * e_W + back @ W_d_rate)
    moment = moment - J @ jnp.cross(W, back @ W_d) + jnp.cross(W, J @ W + mass.h) + mass.moment
    return WantedWrench(jnp.concatenate([thrust[None], moment]), F, e_R, e_W)
