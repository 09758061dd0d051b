"""Rotors: thrust along the body's z axis and drag torque, both proportional to speed squared."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.stacked import apply
from ..checks.errors import ModelError, check_finite
from ..checks.numbers import array_module, as_numpy, floats, nonnegative
from ..checks.shapes import Numbers
from ..mechanics.load import AbstractForce, ActsOn, Load, Signal, evaluate, push, signal
from ..mechanics.state import Kinematics


class Rotors(AbstractForce):
    """The k rotors of a multicopter.

        f = sum_k k_f u_k z,   tau = sum_k (k_f a_k x z - k_tau s_k z) u_k,   u_k = omega_k^2

    Args:
        body: name of the body that carries the rotors.
        arms: positions a_k of the rotors in the body's reference frame (k, 3) [m].
        spin: +1 or -1 for every rotor (k,); u = omega^2 has lost the sign.
        k_f: thrust coefficient [N s^2/rad^2].
        k_tau: drag torque coefficient [N m s^2/rad^2].
        speed_squared: u (k,) [rad^2/s^2], or a function of (t, kinematics).

    Raises:
        ModelError: a number that is not finite, a coefficient below zero (the sense of turning is
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

    def __init__(
        self,
        body: str,
        *,
        arms: Numbers,
        spin: Numbers,
        k_f: Numbers,
        k_tau: Numbers,
        speed_squared: Numbers | Callable[..., object],
    ) -> None:
        self.body = body
        self.arms = floats(arms)
        self.spin = floats(spin)
        of = f"of the rotors of body '{body}'"
        self.k_f = nonnegative(k_f, f"The thrust coefficient k_f {of}", "N s^2/rad^2")
        self.k_tau = nonnegative(k_tau, f"The torque coefficient k_tau {of}", "N m s^2/rad^2")
        count = self.spin.shape[0]
        what = f"The squared rotor speeds of body '{body}'"
        self.speed_squared = signal(speed_squared, what, (count,), "rad^2/s^2")
        if self.arms.shape != (count, 3):
            raise ModelError(
                f"The rotors of body '{body}' need one arm (3,) per spin sign, but arms has shape "
                f"{self.arms.shape} and spin {self.spin.shape}."
            )
        check_finite(self.arms, f"The arms {of}", "m")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def wrench(self, u: Float[Array, " k"], com: Float[Array, "3"]) -> Float[Array, "6"]:
        """Body-frame force [N] and moment about `com` [N m] at squared speeds u, shape (6,)."""
        thrust = self.k_f * u
        zero = jnp.zeros_like(thrust)
        forces = jnp.stack([zero, zero, thrust], axis=1)
        drag = jnp.stack([zero, zero, -self.k_tau * self.spin * u], axis=1)
        moment = jnp.cross(self.arms - com, forces) + drag
        return jnp.concatenate([jnp.sum(forces, axis=0), jnp.sum(moment, axis=0)])

    def commands(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, " k"]:
        """Commanded squared speeds at time t [s] (k,) [rad^2/s^2]."""
        what = f"Rotors: the squared speeds of the rotors of body '{self.body}'"
        return evaluate(self.speed_squared, t, kin, what, self.spin.shape)

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        k = kin.index(self.body)
        wrench = self.wrench(self.commands(t, kin), kin.com[k])
        R_wb = kin.R_wb[k]
        return push(kin, self.body, apply(R_wb, wrench[:3]), moment_w=apply(R_wb, wrench[3:]))


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
    m, g, k = as_numpy((floats(mass), floats(gravity), floats(k_f)))
    module = array_module(m, g, k)
    return floats(module.full(count, 1.0) * (m * module.sqrt(g @ g)) / (count * k))
