"""Filter that estimates a payload from the rotors' commands, the gyroscope and the accelerometer.

With p, J, H, L of `moments.py`, the moment tau of the rotors about the base's centre of mass O and the
accelerometer's reading f = R^T (a_O - g) there, the angular momentum about O obeys

    dL/dt = tau - p x f - W x L,        L = J W + H,

whatever moves inside the machine: forces between its bodies drop out. Because f is measured, neither
the thrust nor the whole mass enters, and p is linear in the payload: it is told from an unknown moment
by how the machine turns. The mass itself is seen in what the thrust T along the base's z axis does,

    f_z = T / (m_0 + dm).

The state is z = (L, dm, mu, inertia) (10,), an extended Kalman filter's: L moves by the first equation
with an unknown moment of white noise, the payload by a slow random walk, and each period measures W by
the gyroscope, W = J^-1 (L - H), and f_z. In the derivatives by the payload stand smoothed earlier
readings of gyroscope and accelerometer, and the moving parts are taken to be at rest. Present ones are
tied to the present noise: an unknown moment also accelerates O, and the noise of a rate looks like turning,
so that a machine at rest would seem to say something about its inertia and its payload.

A steady moment of the air about O cannot be told from a centre of mass, and is taken for one; a thrust
coefficient that is wrong is taken for a mass, the one for which the believed rotors carry the machine.

Source: J. L. Crassidis, J. L. Junkins, Optimal Estimation of Dynamic Systems (2011), ch. 3.6;
R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2.13 (momentum about a moving point).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra.rotation import skew
from ...checks.errors import ModelError
from ...checks.numbers import nonnegative, positive
from ...checks.shapes import Numbers
from ...mechanics.system import System
from ...rotorcraft.allocation import wrench_map
from ...rotorcraft.motor import MotorRotors
from ...rotorcraft.rotor import Rotors, hover_speed_squared
from ...sensing.sensors import gravity_of
from ..estimator import MotionEstimate
from ..inertial import one_by_one
from ..instruments import whole_periods
from .moments import Carrier, Moments, Payload, carrying, payload_of

# Standard deviation of the angular momentum before the first sample [N m s], as good as unknown.
_UNKNOWN = 10.0
# Bandwidth of the smoothed readings [rad/s], beyond that of a flight controller's motion.
_SMOOTHING = 50.0


class PayloadMemory(NamedTuple):
    """Memory of a `PayloadFilter`.

    Attributes:
        mean: L (3,) [N m s], mass [kg], moment (3,) [kg m] and inertia (3,) [1] in one vector (10,).
        covariance: of their errors (10, 10).
        turning, felt: smoothed W (3,) [rad/s] and f (3,) [m/s^2] until the last sample.
        speeds: speeds of the rotors (k,) [rad/s].
        sent: commands on their way, the next first (d, k) [rad^2/s^2].
    """

    mean: Float[Array, "10"]
    covariance: Float[Array, "10 10"]
    turning: Float[Array, "3"]
    felt: Float[Array, "3"]
    speeds: Float[Array, " k"]
    sent: Float[Array, "d k"]


class PayloadFilter(eqx.Module):
    """Estimator of a payload that is fixed to a machine's last body; the module has its equations.

    It needs a `MotionEstimate` at each period, and the commands of the rotors. It knows the lag of the
    system's motors, but not their inertia.

    Args:
        system: machine without the payload, with one set of rotors on its first body.
        rate: control rate [Hz]. delay: from a sample to the effect of its command [s].
        mass, moment, inertia: standard deviations of the payload before the flight [kg], [kg m], [1].
        mass_drift, moment_drift: their random walks [kg/sqrt(s)], [kg m/sqrt(s)].
        torque: density of unknown moments [N m/sqrt(Hz)].
        thrust: density of unknown forces along the base's z axis [N/sqrt(Hz)].
        gyroscope: standard deviation of a reading's noise [rad/s].
        momentum: standard deviation of H by the estimated rates of the moving parts [N m s]; by default
            1e-3, and zero for a machine of one body.
        bound: how much of the payload is fed forward at most, in standard deviations before the flight.

    Raises:
        ModelError: not one set of rotors on the first body, or a number that is negative, or a noise
            of zero. SettingError: a delay that is not a whole number of periods.
    """

    system: System
    wrenches: Float[Array, "4 k"]
    before: Float[Array, " k"]
    lag: Float[Array, " k"] | None
    period: Float[Array, ""]
    prior: Float[Array, "7"]
    walk: Float[Array, "10"]
    thrust: Float[Array, ""]
    gyroscope: Float[Array, ""]
    momentum: Float[Array, ""]
    bound: Float[Array, ""]
    late: int = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        rate: float,
        *,
        delay: float = 0.0,
        mass: Numbers = 0.3,
        moment: Numbers = 0.02,
        inertia: Numbers = 0.1,
        mass_drift: Numbers = 0.01,
        moment_drift: Numbers = 5e-4,
        torque: Numbers = 0.02,
        thrust: Numbers = 0.3,
        gyroscope: Numbers = 1.75e-3,
        momentum: Numbers | None = None,
        bound: Numbers = 3.0,
    ) -> None:
        self.system, motors = system, _motors(system)
        rotors = motors.rotors if isinstance(motors, MotorRotors) else motors
        # moments about the base's centre of mass, which is O
        self.wrenches = wrench_map(rotors, system.bodies.com[0])
        count = rotors.spin.shape[0]
        weighed = jnp.sum(system.bodies.mass)
        self.before = hover_speed_squared(weighed, gravity_of(system), rotors.k_f, count)
        self.late = whole_periods(delay, rate, "The delay of the inputs")
        self.period = h = jnp.asarray(1.0 / rate)
        constant = motors.time_constant if isinstance(motors, MotorRotors) else None
        self.lag = None if constant is None else jnp.exp(-h / constant)
        of = "of the payload's filter"
        spread = (
            nonnegative(mass, f"The mass {of}", "kg"),
            nonnegative(moment, f"The moment {of}", "kg m") * jnp.ones(3),
            nonnegative(inertia, f"The inertia {of}", "1") * jnp.ones(3),
        )
        self.prior = jnp.concatenate([jnp.atleast_1d(x) for x in spread])
        densities = (
            nonnegative(torque, f"The torque {of}", "N m/sqrt(Hz)") * jnp.ones(3),
            nonnegative(mass_drift, f"The mass's drift {of}", "kg/sqrt(s)"),
            nonnegative(moment_drift, f"The moment's drift {of}", "kg m/sqrt(s)") * jnp.ones(3),
            jnp.zeros(3),
        )
        self.walk = h * jnp.concatenate([jnp.atleast_1d(x) for x in densities]) ** 2
        self.thrust = positive(thrust, f"The thrust {of}", "N/sqrt(Hz)")
        self.gyroscope = positive(gyroscope, f"The gyroscope's noise {of}", "rad/s")
        if momentum is None:
            momentum = 0.0 if len(system.names) == 1 else 1e-3
        self.momentum = nonnegative(momentum, f"The momentum {of}", "N m s")
        self.bound = positive(bound, f"The bound {of}", "1")

    def start(self) -> PayloadMemory:
        """First memory: no payload, as the standard deviations before the flight have it."""
        spread = jnp.concatenate([jnp.full(3, _UNKNOWN), self.prior])
        sent = jnp.tile(self.before, (self.late + 1, 1))
        # a machine that hovers
        felt = jnp.zeros(3).at[2].set(jnp.linalg.norm(gravity_of(self.system)))
        still, speeds = (jnp.zeros(10), jnp.diag(spread**2), jnp.zeros(3)), jnp.sqrt(self.before)
        return PayloadMemory(*still, felt, speeds, sent)

    def payload(self, memory: PayloadMemory) -> Payload:
        """Payload that is fed forward: the mean within `bound`."""
        most = self.bound * self.prior
        return payload_of(jnp.clip(memory.mean[3:], -most, most))

    def deviation(self, memory: PayloadMemory) -> Payload:
        """Standard deviations of the payload."""
        return payload_of(jnp.sqrt(jnp.diagonal(memory.covariance)[3:]))

    def sent(self, memory: PayloadMemory, squared: Float[Array, " k"]) -> PayloadMemory:
        """Memory after a command of squared rotor speeds (k,) [rad^2/s^2]."""
        return memory._replace(sent=jnp.concatenate([memory.sent[1:], squared[None]]))

    def updated(
        self, estimate: MotionEstimate, about: Moments, on: Carrier, memory: PayloadMemory
    ) -> PayloadMemory:
        """Memory after the period that ends now.

        Args:
            about: moments of the machine without payload. on: motion of its last body.
        """
        speeds, wrench = self._acted(memory)
        turning, felt = estimate.state.omega[0], estimate.force
        L, F = self.onwards(memory.mean, about, on, wrench[1:], turning, felt, memory.felt)
        P = F @ memory.covariance @ F.T + jnp.diag(self.walk)
        z = memory.mean.at[:3].set(L)
        expected, H = self.expected(z, about, on, memory.turning, wrench[0])
        rate_noise = self.gyroscope**2 + (self.momentum / jnp.diagonal(about.inertia)) ** 2
        felt_noise = (self.thrust / (about.mass + z[3])) ** 2 / self.period
        noise = jnp.append(rate_noise, felt_noise)
        error = jnp.append(turning, felt[2]) - expected
        move, P, _ = one_by_one(0.5 * (P + P.T), H, noise, error, jnp.ones(4, bool))
        share = 1 - jnp.exp(-_SMOOTHING * self.period)
        smooth = lambda old, new: old + share * (new - old)
        before = smooth(memory.turning, turning), smooth(memory.felt, felt)
        return PayloadMemory(z + move, P, before[0], before[1], speeds, memory.sent)

    def onwards(
        self,
        z: Float[Array, "10"],
        about: Moments,
        on: Carrier,
        torque: Float[Array, "3"],
        turning: Float[Array, "3"],
        felt: Float[Array, "3"],
        before: Float[Array, "3"],
    ) -> tuple[Float[Array, "3"], Float[Array, "10 10"]]:
        """Angular momentum L at the end of a period (3,), and the matrix of errors of z there.

        Args:
            z: state before. torque: tau (3,) [N m]. turning: W (3,) [rad/s].
            felt: f (3,) [m/s^2]. before: smoothed f (3,) [m/s^2].
        """
        h, p = self.period, carrying(about, on, payload_of(z[3:])).first
        L = z[:3] + h * (torque - jnp.cross(p, felt) - jnp.cross(turning, z[:3]))
        by_payload = h * skew(before) @ jnp.concatenate([on.r[:, None], on.R], axis=1)
        F = jnp.eye(10).at[:3, :3].add(-h * skew(turning)).at[:3, 3:7].set(by_payload)
        return L, F

    def expected(
        self,
        z: Float[Array, "10"],
        about: Moments,
        on: Carrier,
        turning: Float[Array, "3"],
        thrust: Float[Array, ""],
    ) -> tuple[Float[Array, "4"], Float[Array, "4 10"]]:
        """Expected readings of W (3,) [rad/s] and f_z [m/s^2], and their derivatives by z.

        Args:
            turning: smoothed W (3,) [rad/s]. thrust: T [N].
        """
        whole = lambda numbers: carrying(about, on, payload_of(numbers))
        now, by = whole(z[3:]), jax.jacfwd(lambda numbers: whole(numbers).inertia)(z[3:])
        back = _inverse(now.inertia)
        W = back @ (z[:3] - now.momentum)
        by_payload = -back @ jnp.einsum("ijk,j->ik", by, turning)
        rates = jnp.concatenate([back, by_payload], axis=1)
        lift = thrust / now.mass
        by_mass = jnp.zeros(10).at[3].set(-lift / now.mass)
        return jnp.append(W, lift), jnp.concatenate([rates, by_mass[None]])

    def _acted(self, memory: PayloadMemory) -> tuple[Float[Array, " k"], Float[Array, "4"]]:
        """Speeds of the rotors at the end of the period, and their mean wrench in it."""
        wanted = memory.sent[0]
        if self.lag is None:
            return memory.speeds, self.wrenches @ wanted
        goal = jnp.sqrt(wanted)
        after = goal + self.lag * (memory.speeds - goal)
        return after, self.wrenches @ ((memory.speeds + after) / 2) ** 2


def _motors(system: System) -> Rotors | MotorRotors:
    found = [f for f in system.forces if isinstance(f, Rotors | MotorRotors)]
    if len(found) != 1:
        raise ModelError(
            f"A payload's filter needs one set of rotors, but the system has {len(found)}."
        )
    motors = found[0]
    rotors = motors.rotors if isinstance(motors, MotorRotors) else motors
    if system.index(rotors.body) != 0:
        raise ModelError(
            f"A payload's filter needs its rotors on the first body, '{system.names[0]}', but they are "
            f"on '{rotors.body}'."
        )
    return motors


def _inverse(J: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse by cofactors."""
    a, b, c = J
    across = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return across / (a @ across[:, 0])
