"""Rotors driven by motors: first-order lag, rotor inertia, and speed limits."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, check_finite, has_values
from ..checks.shapes import Numbers
from ..math.derivative import without_derivative
from ..math.rotation import cross
from ..math.stacked import apply_matrix
from ..mechanics.internal import AbstractInternalForce
from ..mechanics.load import ActsOn, Load, push
from ..mechanics.state import Kinematics
from ..mechanics.system import System
from .allocation import RotorLimits
from .rotor import Rotors


class MotorRotors(AbstractInternalForce):
    """Rotors whose speeds omega follow their commands; each part is optional.

        omega_c = sqrt(u), u within the limits                          limits
        T d(omega)/dt = omega_c - omega                                 time_constant
        tau = ... - W x (h z) - dh/dt z,  h = sum_k J_k s_k omega_k     inertia

    with thrust and drag torque of `Rotors` at omega^2, and the body's angular velocity W in
    its own axes. omega and h are relative to the body, whose inertia tensor includes the rotors'
    masses and inertias as if they stood still. A command beyond the limits is not reached, and
    the derivative by it is zero; at a limit the derivative is that of the inside. The square root
    has no derivative at u = 0: the derivative of omega is NaN there, while thrust and drag torque
    of rotors without lag, which need omega^2 = u, keep theirs.

    Args:
        rotors: arms, spins and coefficients; its `speed_squared` are the commands.
        time_constant: T > 0 [s], one or one per rotor (k,); default none: omega = omega_c.
        inertia: J >= 0 of each rotor about its axis [kg m^2], one or one per rotor (k,); default
            none. Without a time constant the commands must be constant.
        limits: limits of the speeds; default none.
        start: omega at the start (k,) [rad/s]; by default the commands, where these are constant.

    Raises:
        ModelError: numbers out of range, or parts that do not fit together.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("rotors.speed_squared", "rad^2/s^2"),)
    rotors: Rotors
    time_constant: Float[Array, " k"] | None
    inertia: Float[Array, " k"] | None
    squared_limits: tuple[Float[Array, " k"], Float[Array, " k"]] | None
    internal: Float[Array, " m"]

    def __init__(
        self,
        rotors: Rotors,
        *,
        time_constant: Numbers | None = None,
        inertia: Numbers | None = None,
        limits: RotorLimits | None = None,
        start: Numbers | None = None,
    ) -> None:
        owner_text = f"of the rotors of body '{rotors.body}'"
        constant = not callable(rotors.speed_squared)
        self.rotors = rotors
        self.time_constant = self.inertia = self.squared_limits = None
        if time_constant is not None:
            self.time_constant = _per_rotor(time_constant, rotors, "time constant", "s", "positive")
        if inertia is not None:
            if time_constant is None and not constant:
                raise ModelError(
                    f"The inertia {owner_text} needs their time constant, because their commands are a "
                    "function: without lag their acceleration is not known."
                )
            self.inertia = _per_rotor(inertia, rotors, "inertia", "kg m^2", "not negative")
        if limits is not None:
            self.squared_limits = limits.squared(rotors.spin.shape[0])
            _check_rising(rotors, self.squared_limits[0])
        self.internal = jnp.zeros((0,))
        if time_constant is None:
            if start is not None:
                raise ModelError(f"The starting speeds {owner_text} need their time constant.")
        elif start is not None:
            self.internal = _per_rotor(start, rotors, "starting speeds", "rad/s")
        elif constant:
            self.internal = self.speeds_of(jnp.asarray(rotors.speed_squared))
        else:
            raise ModelError(
                f"The starting speeds {owner_text} must be given, because their commands are a function."
            )

    def steady(self) -> "Rotors | MotorRotors":
        """Rotors at steady speeds without lag and limits; plain `Rotors` if without inertia."""
        if self.inertia is None:
            return self.rotors
        return MotorRotors(self.rotors, inertia=self.inertia)

    @property
    def limits(self) -> RotorLimits | None:
        """Limits of the speeds [rad/s], or None."""
        if self.squared_limits is None:
            return None
        lowest, highest = self.squared_limits
        return RotorLimits(jnp.sqrt(lowest), jnp.sqrt(highest))

    @property
    def start(self) -> Float[Array, " k"] | None:
        """Speeds at the start (k,) [rad/s]; None without lag."""
        return None if self.time_constant is None else self.internal

    def acts_on(self) -> ActsOn:
        return self.rotors.acts_on()

    def internal_names(self) -> tuple[str, ...]:
        count = self.internal.shape[0]
        return tuple(f"{self.rotors.body}: speed of rotor {k + 1} [rad/s]" for k in range(count))

    def speeds_of(self, squared: Float[Array, " k"]) -> Float[Array, " k"]:
        """Commanded speeds omega_c [rad/s] of squares u; NaN for u < 0 without limits."""
        squared = self.clip_squares(squared)
        turning = squared != 0
        root = jnp.sqrt(jnp.where(turning, squared, 1.0))
        return jnp.where(turning, root, without_derivative(squared, ~turning))

    def clip_squares(self, squared: Float[Array, " k"]) -> Float[Array, " k"]:
        """Squares u clipped to the limits [rad^2/s^2]; NaN for a negative square without limits."""
        if self.squared_limits is None:
            return squared * jnp.where(squared < 0, jnp.nan, 1.0)
        lowest, highest = self.squared_limits
        return jnp.where(squared < lowest, lowest, jnp.where(squared > highest, highest, squared))

    def command(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " k"]:
        """Commanded speeds omega_c at time t [s] (k,) [rad/s]."""
        return self.speeds_of(self.rotors.commands(t, kin))

    def speeds(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " k"]:
        """Rotor speeds omega at time t [s] (k,) [rad/s]."""
        return self.command(t, kin) if self.time_constant is None else self.internal

    def internal_rate(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " m"]:
        if self.time_constant is None:
            return self.internal
        return (self.command(t, kin) - self.internal) / self.time_constant

    def spin(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, ""]:
        """Angular momentum h of the rotors relative to the body, along its z axis [N m s]."""
        if self.inertia is None:
            return jnp.zeros_like(t)
        return jnp.sum(self.inertia * self.rotors.spin * self.speeds(t, kin))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        k = kin.index(self.rotors.body)
        if self.time_constant is None:
            # the squares are used directly, because roots have no derivative at zero
            squared = self.clip_squares(self.rotors.commands(t, kin))
        else:
            squared = self.internal**2
        wrench = self.rotors.wrench(squared, kin.com[k])
        moment = wrench[3:]
        if self.inertia is not None:
            z = jnp.array([0.0, 0.0, 1.0])
            # Gyroscopic moment: the rotors' angular momentum turns with the base.
            moment = moment - cross(kin.omega[k], self.spin(t, kin) * z)
            if self.time_constant is not None:
                # A rotor that gains speed turns the base against it; only with a lag does its speed have a rate.
                faster = self.inertia * self.rotors.spin * self.internal_rate(t, kin)
                moment = moment - jnp.sum(faster) * z
        force_w, moment_w = (apply_matrix(kin.R_wb[k], part) for part in (wrench[:3], moment))
        return push(kin, self.rotors.body, force_w, moment_w=moment_w)


def only_rotors(system: System, owner: str) -> Rotors | MotorRotors:
    """The set of rotors of a machine, on its first body.

    Args:
        owner: what needs them, for the message.

    Raises:
        ModelError: none, several, or on another body.
    """
    rotor_sets = [force for force in system.forces if isinstance(force, Rotors | MotorRotors)]
    if len(rotor_sets) != 1:
        raise ModelError(f"{owner} needs one set of rotors, but the system has {len(rotor_sets)}.")
    body = rotor_sets[0].rotors.body
    if system.index(body) != 0:
        raise ModelError(
            f"{owner} needs its rotors on the first body, '{system.names[0]}', but they are on '{body}': "
            f"list '{body}' first."
        )
    return rotor_sets[0]


def _per_rotor(
    value: Numbers, rotors: Rotors, name: str, unit: str, requirement: str = "finite"
) -> Float[Array, " k"]:
    """Numbers of the rotors (k,) that are finite, "positive" or "not negative"; one number is that of each."""
    quantity, count = f"The {name} of the rotors of body '{rotors.body}'", rotors.spin.shape[0]
    check_finite(value, quantity, unit)
    values = jnp.asarray(value, dtype=float)
    if values.shape not in ((), (count,)):
        raise ModelError(
            f"{quantity} must be one number or one for each of {count} rotors, but the shape is {values.shape}."
        )
    if has_values(values) and requirement != "finite":
        # NumPy: inside of a traced function an operation of JAX is traced, though its numbers are known.
        numbers = np.atleast_1d(values)
        wrong = numbers[numbers <= 0 if requirement == "positive" else numbers < 0]
        if wrong.size:
            raise ModelError(f"{quantity} must be {requirement}, but it is {wrong[0]:g} {unit}.")
    return jnp.broadcast_to(values, (count,))


def _check_rising(rotors: Rotors, lowest: Float[Array, " k"]) -> None:
    """Raise `ModelError` for a thrust that falls as a rotor turns faster than its lowest squared speed."""
    linear = rotors.thrust_linear
    if linear is None or not has_values(rotors.k_f, linear, lowest) or float(linear) >= 0:
        return
    k_f, slowest = float(rotors.k_f), float(np.sqrt(np.min(np.asarray(lowest))))
    if 2 * k_f * slowest + float(linear) < 0:
        turning_point = f"{-float(linear) / (2 * k_f):.4g} rad/s" if k_f else "any speed"
        raise ModelError(
            f"The thrust of the rotors of body '{rotors.body}' falls with their speed below {turning_point}, but "
            f"their lowest speed is {slowest:g} rad/s: the lowest speed must be where the thrust rises."
        )
