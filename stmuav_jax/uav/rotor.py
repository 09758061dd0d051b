"""Rotors: thrust along the body's z axis and drag torque, by curves of their speed; their power.

Rotors that hover with equal speeds need a power that grows with the mass to the power of 1.5.

Source of the power: J. G. Leishman, Principles of Helicopter Aerodynamics (2006), ch. 2.2 to 2.8.
"""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, check_finite, has_values
from ..checks.numbers import array_module, as_floats, as_numpy, check_nonnegative, check_positive
from ..checks.shapes import Numbers
from ..math.derivative import safe_sqrt, sharp_sqrt
from ..math.stacked import apply_matrix
from ..mechanics.load import AbstractForce, ActsOn, Load, Signal, check_signal, evaluate, push
from ..mechanics.state import Kinematics


class Rotors(AbstractForce):
    """The k rotors of a multicopter.

        f = sum_k T_k z,   tau = sum_k (T_k a_k x z - Q_k s_k z),   u_k = omega_k^2
        T_k = k_f u_k + thrust_linear omega_k + thrust_offset,   T_k = 0 where omega_k = 0
        Q_k = k_tau u_k + torque_linear omega_k + torque_offset,  Q_k = 0 where omega_k = 0

    For u < 0, which no rotor has, both curves continue oddly, so that a search may pass there.

    Args:
        body: name of the body that carries the rotors.
        arms: positions a_k of the rotors in the body's reference frame (k, 3) [m].
        spin: +1 or -1 for every rotor (k,); u = omega^2 has lost the sign.
        k_f: thrust coefficient [N s^2/rad^2].
        k_tau: drag torque coefficient [N m s^2/rad^2].
        speed_squared: u (k,) [rad^2/s^2], or a function of (t, kinematics).
        thrust_linear, torque_linear: coefficients of the speed [N s/rad], [N m s/rad]; by default none.
        thrust_offset, torque_offset: constant parts of a rotor that turns [N], [N m]; by default none.

    Raises:
        ModelError: a number that is not finite, a k_f or k_tau below zero (the sense of turning is
            `spin`'s), or another number of arms than of rotors.

    Source: report Part II, Eq. 4.4, 4.6, 4.24, corrected (no gravity in f).
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("speed_squared", "rad^2/s^2"),)
    body: str = eqx.field(static=True)
    arms: Float[Array, "k 3"]
    spin: Float[Array, " k"]
    k_f: Float[Array, ""]
    k_tau: Float[Array, ""]
    speed_squared: Signal
    thrust_linear: Float[Array, ""] | None
    thrust_offset: Float[Array, ""] | None
    torque_linear: Float[Array, ""] | None
    torque_offset: Float[Array, ""] | None

    def __init__(
        self,
        body: str,
        *,
        arms: Numbers,
        spin: Numbers,
        k_f: Numbers,
        k_tau: Numbers,
        speed_squared: Numbers | Callable[..., object],
        thrust_linear: Numbers | None = None,
        thrust_offset: Numbers | None = None,
        torque_linear: Numbers | None = None,
        torque_offset: Numbers | None = None,
    ) -> None:
        self.body = body
        self.arms = as_floats(arms)
        self.spin = as_floats(spin)
        owner_text = f"of the rotors of body '{body}'"
        self.k_f = check_nonnegative(k_f, f"The thrust coefficient k_f {owner_text}", "N s^2/rad^2")
        quantity = f"The torque coefficient k_tau {owner_text}"
        self.k_tau = check_nonnegative(k_tau, quantity, "N m s^2/rad^2")
        parts = (thrust_linear, thrust_offset, torque_linear, torque_offset)
        check_finite(parts, f"The thrust and torque curves {owner_text}", "")
        self.thrust_linear, self.thrust_offset, self.torque_linear, self.torque_offset = (
            None if part is None else as_floats(part) for part in parts
        )
        count = self.spin.shape[0]
        quantity = f"The squared rotor speeds of body '{body}'"
        self.speed_squared = check_signal(speed_squared, quantity, (count,), "rad^2/s^2")
        if self.arms.shape != (count, 3):
            raise ModelError(
                f"The rotors of body '{body}' need one arm (3,) per spin sign, but arms has shape "
                f"{self.arms.shape} and spin {self.spin.shape}."
            )
        check_finite(self.arms, f"The arms {owner_text}", "m")

    @property
    def rotors(self) -> "Rotors":
        """Rotors without motors, as of `MotorRotors`."""
        return self

    @property
    def has_curves(self) -> bool:
        """False where thrust and torque are proportional to the squared speed."""
        parts = (self.thrust_linear, self.thrust_offset, self.torque_linear, self.torque_offset)
        return any(part is not None for part in parts)

    def thrusts(self, u: Numbers) -> Float[Array, "*s"]:
        """Thrusts T [N] at squared speeds u [rad^2/s^2]."""
        return _evaluate_curve(as_floats(u), self.k_f, self.thrust_linear, self.thrust_offset)

    def torques(self, u: Numbers) -> Float[Array, "*s"]:
        """Drag torques Q [N m] at squared speeds u [rad^2/s^2]."""
        return _evaluate_curve(as_floats(u), self.k_tau, self.torque_linear, self.torque_offset)

    def power(self, u: Numbers) -> Float[Array, "*s"]:
        """Mechanical power Q omega that the air takes [W]; NaN comes of a square below zero."""
        return self.torques(u) * jnp.sqrt(as_floats(u))

    def squared_speeds(self, thrusts: Numbers) -> Float[Array, "*s"]:
        """Squared speeds u [rad^2/s^2] that give thrusts [N], on the rising branch of the curve.

        They are zero for thrusts that lie below the branch.
        """
        thrusts = as_floats(thrusts)
        if self.thrust_linear is None and self.thrust_offset is None:
            return thrusts / self.k_f
        linear = jnp.zeros(()) if self.thrust_linear is None else self.thrust_linear
        offset = jnp.zeros(()) if self.thrust_offset is None else self.thrust_offset
        # k_f w^2 + c w = T - T_0 has the root 2 (T - T_0) / (c + s), which exists for k_f = 0 as well; with
        # c < 0 its denominator is zero at T = T_0, where (s - c) / (2 k_f) has no such place.
        excess = jnp.abs(thrusts) - offset
        square = linear**2 + 4 * self.k_f * excess
        root = safe_sqrt(square)
        is_falling = linear < 0
        top = jnp.where(is_falling, root - linear, 2 * jnp.maximum(excess, 0.0))
        bottom = jnp.where(is_falling, 2 * self.k_f, linear + root)
        is_turning = (bottom > 0) & (square >= 0) & (thrusts != 0)
        speeds = jnp.where(is_turning, top / jnp.where(is_turning, bottom, 1.0), 0.0)
        return jnp.sign(thrusts) * speeds**2

    def hover(self, mass: Numbers, gravity: Numbers) -> Float[Array, " k"]:
        """Equal squared speeds whose thrust carries a mass [kg] in a gravity (3,) [m/s^2]."""
        count = self.spin.shape[0]
        if not self.has_curves:
            return hover_speed_squared(mass, gravity, self.k_f, count)
        weight = as_floats(mass) * jnp.linalg.norm(as_floats(gravity))
        return jnp.full(count, self.squared_speeds(weight / count))

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def wrench(self, u: Float[Array, " k"], com: Float[Array, "3"]) -> Float[Array, "6"]:
        """Body-frame force [N] and moment about `com` [N m] at squared speeds u, shape (6,)."""
        # Squared speeds are the input: without curves thrust, moments and accelerations are linear in
        # them, which makes allocation a linear problem.
        thrust = self.thrusts(u)
        zero = jnp.zeros_like(thrust)
        forces = jnp.stack([zero, zero, thrust], axis=1)
        drag = jnp.stack([zero, zero, -self.spin * self.torques(u)], axis=1)
        # About the centre of mass and not the frame's origin, to which the arms are given: a
        # rotor's thrust at an offset turns the body.
        moment = jnp.cross(self.arms - com[None], forces) + drag
        return jnp.concatenate([jnp.sum(forces, axis=0), jnp.sum(moment, axis=0)])

    def commands(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " k"]:
        """Commanded squared speeds at time t [s] (k,) [rad^2/s^2]."""
        quantity = f"Rotors: the squared speeds of the rotors of body '{self.body}'"
        return evaluate(self.speed_squared, t, kin, quantity, self.spin.shape)

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        k = kin.index(self.body)
        wrench = self.wrench(self.commands(t, kin), kin.com[k])
        force_w, moment_w = (apply_matrix(kin.R_wb[k], part) for part in (wrench[:3], wrench[3:]))
        return push(kin, self.body, force_w, moment_w=moment_w)


def _evaluate_curve(
    u: Float[Array, "*s"], quadratic: Array, linear: Array | None, offset: Array | None
) -> Float[Array, "*s"]:
    """Quadratic curve of the speed at squared speeds u, zero at u = 0 and odd in u."""
    value = quadratic * u
    if linear is not None:
        value = value + linear * jnp.sign(u) * sharp_sqrt(jnp.abs(u))
    if offset is not None:
        value = value + offset * jnp.sign(u)
    return value


def rotor_layout(
    number: int,
    radius: Numbers,
    *,
    layout: str = "x",
    coaxial: Numbers | None = None,
    height: Numbers = 0.0,
) -> tuple[Float[Array, "k 3"], Float[Array, " k"]]:
    """Positions (k, 3) [m] and directions of rotation (k,) of rotors on equal arms, for `Rotors`.

    Arms are numbered anticlockwise seen from above, from the x axis on, which points forward.

    Args:
        number: number of arms; an even one, at least 4, unless rotors are coaxial (then at least 3).
        radius: length of the arms from the z axis [m].
        layout: "plus" has an arm along the x axis, "x" has that axis between two arms.
        coaxial: distance of a second rotor below the one of each arm, which turns the other way [m]; by
            default there is one rotor an arm. Rotors are counted arm by arm, the upper one first.
        height: height of the (upper) rotors in the body's frame [m].

    Raises:
        ModelError: numbers that are not finite or not positive, or arms on which no rotors balance.
    """
    smallest = 4 if coaxial is None else 3
    if number != int(number) or number < smallest or (coaxial is None and number % 2):
        requirement = "even, and at least 4" if coaxial is None else "at least 3 of coaxial rotors"
        raise ModelError(
            f"The number of arms must be {requirement}, so that drag torques balance, but it is {number}."
        )
    if layout not in ("x", "plus"):
        raise ModelError(f"The layout of rotors must be 'x' or 'plus', not '{layout}'.")
    length, z = as_numpy(
        (check_positive(radius, "The radius of the rotors' arms", "m"), as_floats(height))
    )
    check_finite(z, "The height of the rotors", "m")
    angles = 2 * np.pi / number * (np.arange(number) + (0.5 if layout == "x" else 0.0))
    xp = array_module(length, z)
    ones = np.ones(number)
    arms = xp.stack([length * np.cos(angles), length * np.sin(angles), z * ones], axis=1)
    # Neighbours turn against each other, so that drag torques cancel in hover and yaw is
    # controlled by their difference.
    spin = np.where(np.arange(number) % 2, -1.0, 1.0) if number % 2 == 0 else ones
    if coaxial is None:
        return as_floats(arms), as_floats(spin)
    # A pair balances its own drag torques: any number of arms will do.
    below = as_numpy(check_positive(coaxial, "The distance between coaxial rotors", "m"))
    lower = arms - xp.stack([0.0 * ones, 0.0 * ones, below * ones], axis=1)
    pairs = xp.stack([arms, lower], axis=1).reshape(2 * number, 3)
    return as_floats(pairs), as_floats(np.stack([spin, -spin], axis=1).ravel())


def hover_speed_squared(
    mass: Numbers, gravity: Numbers, k_f: Numbers, count: int
) -> Float[Array, " k"]:
    """Equal squared speeds whose thrust carries the weight: m |g| / (k k_f), (k,) [rad^2/s^2].

    Args:
        mass: total mass m [kg].
        gravity: acceleration of gravity g (3,) [m/s^2].
        k_f: thrust coefficient [N s^2/rad^2].
        count: number k of rotors.
    """
    m, g, k = as_numpy((as_floats(mass), as_floats(gravity), as_floats(k_f)))
    module = array_module(m, g, k)
    return as_floats(module.full(count, 1.0) * (m * module.sqrt(g @ g)) / (count * k))


# Largest deviation of a test stand's points from their curve, as a share of the largest reading.
_MISFIT = 0.05


def fit_rotor_curves(points: Numbers) -> dict[str, float]:
    """Coefficients of `Rotors` that fit the points of a test stand best, by least squares.

    Args:
        points: speed [rad/s], thrust [N] and drag torque [N m] of each (n, 3), at three speeds or more.

    Raises:
        ModelError: numbers that are not finite, fewer than three speeds, or a point that is further from
            its curve than a twentieth of the largest reading.
    """
    check_finite(points, "The points of a rotor's test stand", "")
    table = np.asarray(points, dtype=float)
    if table.ndim != 2 or table.shape[1] != 3 or len(np.unique(table[:, 0])) < 3:
        raise ModelError(
            "The points of a rotor's test stand are rows of speed [rad/s], thrust [N] and torque [N m], at three "
            f"speeds or more, but they are {table.tolist()}."
        )
    speeds, result = table[:, 0], {}
    # in units of the highest speed, so that the columns are of one size
    highest = np.max(np.abs(speeds))
    rows = (speeds / highest)[:, None] ** np.arange(3)
    names = {"thrust": "k_f", "torque": "k_tau"}
    for readings, (quantity, name) in zip(table[:, 1:].T, names.items(), strict=True):
        curve = np.linalg.lstsq(rows, readings, rcond=None)[0]
        misfit = np.abs(rows @ curve - readings)
        if np.max(misfit) > _MISFIT * np.max(np.abs(readings)):
            k = int(np.argmax(misfit))
            raise ModelError(
                f"No quadratic curve of the speed fits the {quantity}s of a rotor's test stand: at "
                f"{speeds[k]:g} rad/s the best one is {misfit[k]:.3g} off, of {readings[k]:g}."
            )
        offset, linear, quadratic = curve / highest ** np.arange(3)
        result |= {name: quadratic, f"{quantity}_linear": linear, f"{quantity}_offset": offset}
    return {name: float(value) for name, value in result.items()}


# --- power


def drag_power(speed_squared: Numbers, k_tau: Numbers) -> Float[Array, "*s"]:
    """Mechanical power k_tau u^1.5 that the air takes from rotors of u = omega^2 (...) [W].

    Args:
        speed_squared: u (...) [rad^2/s^2]; NaN comes of a square below zero.
        k_tau: drag torque coefficient [N m s^2/rad^2].
    """
    return as_floats(k_tau) * as_floats(speed_squared) ** 1.5


def hover_power(
    mass: Numbers, *, gravity: Numbers, k_f: Numbers, k_tau: Numbers, count: int
) -> Float[Array, "*s"]:
    """Mechanical power of `count` equal rotors that carry a mass (...), in all [W].

        P = n k_tau (m g / (n k_f))^1.5,   dP/dm = 1.5 P / m

    Args:
        mass: mass m (...) [kg].
        gravity: acceleration of gravity (3,) [m/s^2].
        k_f: thrust coefficient [N s^2/rad^2].
        k_tau: drag torque coefficient [N m s^2/rad^2].
        count: number n of rotors.

    Raises:
        ModelError: a mass that is not finite or is negative.
    """
    check_finite(mass, "The mass that rotors carry", "kg")
    if has_values(mass) and np.any(np.asarray(mass) < 0):
        raise ModelError(
            f"The mass that rotors carry must not be negative, but it is {np.min(np.asarray(mass)):g} kg."
        )
    weight = as_floats(mass) * jnp.linalg.norm(as_floats(gravity))
    # Equal rotors share the weight equally, and w^2 = thrust / k_f for each.
    return count * drag_power(weight / (count * as_floats(k_f)), k_tau)
