"""Online estimation of a payload, and a controller that adapts to it.

About the base's centre of mass O, in the base's axes, the mass m, first moment p, inertia J and momentum H of
the moving parts of a machine are linear in a payload's mass dm and first moment mu; what is left out is the
payload's inertia dm |mu / dm|^2. With the rotors' moment tau and the accelerometer's reading f,

    dL/dt = tau - p x f - W x L,      L = J W + H,      f_z = T / (m_0 + dm),

whatever moves inside the machine. An extended Kalman filter of z = (L, dm, mu, shares of the inertia) (10,)
measures W = J^-1 (L - H) and f_z each period. Its derivatives by the payload are taken at smoothed earlier readings:
the noise of present ones is that of the innovation, and a machine at rest would seem to tell its payload.
docs/control_and_missions.md says what is taken for known.

Source: J. L. Crassidis, J. L. Junkins, Optimal Estimation of Dynamic Systems (2011), ch. 3.6;
R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2.13 (momentum about a moving point).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..analysis.mass_properties import Moments, mass_moments
from ..analysis.sensors import gravity_of
from ..checks.errors import SettingError
from ..checks.numbers import check_nonnegative, check_positive
from ..checks.shapes import Numbers
from ..control.instruments import whole_periods
from ..estimation.inertial import update_sequentially
from ..math.rotation import rotation_matrix, skew
from ..mechanics.state import State
from ..mechanics.system import System
from .flight_controller import FlightController, FlightMemory, UavController, central_properties
from .motion_estimator import MotionEstimate
from .motor import MotorRotors, only_rotors
from .panel_servo import PanelBodies
from .rotor import Rotors


class Carrier(NamedTuple):
    """Motion of the body that carries a payload, against the base and in its axes.

    Attributes:
        r: its centre of mass (3,) [m]. r_rate: velocity (3,) [m/s].
        R: its axes (3, 3). turning: its angular velocity against the base (3,) [rad/s].
    """

    r: Float[Array, "3"]
    r_rate: Float[Array, "3"]
    R: Float[Array, "3 3"]
    turning: Float[Array, "3"]


class Payload(NamedTuple):
    """Payload as a change of the machine in a controller's model.

    Attributes:
        mass: dm [kg].
        moment: first moment mu about the carrier's centre of mass, its axes (3,) [kg m].
        inertia: changes of the machine's moments of inertia about the base's axes, as shares of them
            (3,) [1].
    """

    mass: Float[Array, ""]
    moment: Float[Array, "3"]
    inertia: Float[Array, "3"]


def payload_of(numbers: Float[Array, "7"]) -> Payload:
    """Payload from its mass, moment and inertia in one vector."""
    return Payload(numbers[0], numbers[1:4], numbers[4:])


def find_carrier_motion(state: State) -> Carrier:
    """Motion of the last body of a state against the first."""
    R_0w = rotation_matrix(state.p[0]).T
    r = R_0w @ (state.r[-1] - state.r[0])
    r_rate = R_0w @ (state.v[-1] - state.v[0]) - jnp.cross(state.omega[0], r)
    R = R_0w @ rotation_matrix(state.p[-1])
    return Carrier(r, r_rate, R, R @ state.omega[-1] - state.omega[0])


def add_payload(about: Moments, on: Carrier, payload: Payload) -> Moments:
    """Moments of a machine with a payload, linear in the payload's numbers."""
    m, r, v = payload.mass, on.r, on.r_rate
    # Mass, first moment and inertia enter linearly: the filter's derivatives by the payload are exact.
    s = on.R @ payload.moment
    s_rate = jnp.cross(on.turning, s)
    identity = jnp.eye(3)
    inertia = m * (r @ r * identity - jnp.outer(r, r))
    inertia = inertia + 2 * (r @ s) * identity - jnp.outer(r, s) - jnp.outer(s, r)
    inertia = inertia + jnp.diag(payload.inertia * jnp.diagonal(about.inertia))
    momentum = m * jnp.cross(r, v) + jnp.cross(r, s_rate) + jnp.cross(s, v)
    return Moments(
        about.mass + m,
        about.first + m * r + s,
        about.first_rate + m * v + s_rate,
        about.inertia + inertia,
        about.momentum + momentum,
    )


def bodies_carrying(
    bodies: PanelBodies, payload: Payload, inertia: Float[Array, "3 3"] | None = None
) -> PanelBodies:
    """The tracker's bodies with a payload on the panel; its `inertia` as a share is not used.

    Args:
        inertia: of the payload about the panel's centre of mass, panel axes (3, 3) [kg m^2]; by
            default it is left out.
    """
    m = bodies.mass[-1] + payload.mass
    d = payload.moment / m
    about = bodies.inertia[-1] if inertia is None else bodies.inertia[-1] + inertia
    panel_inertia = about - m * (d @ d * jnp.eye(3) - jnp.outer(d, d))
    com = bodies.geometry.panel_com + d
    return PanelBodies(
        eqx.tree_at(lambda g: g.panel_com, bodies.geometry, com),
        bodies.shift,
        bodies.mass.at[-1].set(m),
        bodies.inertia.at[-1].set(panel_inertia),
    )


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

    It needs a `MotionEstimate` at each period, and the commands of the rotors. It models the lag of the
    system's motors, but not their inertia.

    Args:
        system: machine without the payload, with one set of rotors on its first body.
        rate: control rate [Hz]. delay: from a sample to the effect of its command [s].
        mass, moment, inertia: prior standard deviations of the payload [kg], [kg m], [1].
        mass_drift, moment_drift: their random walks [kg/sqrt(s)], [kg m/sqrt(s)].
        torque: density of unknown moments [N m/sqrt(Hz)].
        thrust: density of unknown forces along the base's z axis [N/sqrt(Hz)].
        gyroscope: standard deviation of a reading's noise [rad/s].
        momentum: standard deviation of H by the estimated rates of the moving parts [N m s]; by default
            1e-3, and zero for a machine of one body.
        bound: largest payload that is fed forward, in prior standard deviations.

    Raises:
        ModelError: not one set of rotors on the first body, or a number that is negative, or a noise
            of zero. SettingError: a delay that is not a whole number of periods.
    """

    system: System
    rotors: Rotors
    centre: Float[Array, "3"]
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
        self.system, motors = system, only_rotors(system, "A payload's filter")
        rotors = motors.rotors
        # moments about the base's centre of mass, which is O
        self.rotors, self.centre = rotors, system.bodies.com[0]
        # Commands that are on their way at the start are those of a hover, which the first periods then use.
        total_mass = jnp.sum(system.bodies.mass)
        self.before = rotors.hover(total_mass, gravity_of(system))
        self.late = whole_periods(delay, rate, "The delay of the inputs")
        self.period = h = jnp.asarray(1.0 / rate)
        constant = motors.time_constant if isinstance(motors, MotorRotors) else None
        self.lag = None if constant is None else jnp.exp(-h / constant)
        subject = "The {} of the payload's filter"
        repeat = lambda count, value, name, unit: jnp.full(
            count, check_nonnegative(value, subject.format(name), unit)
        )
        positive = lambda value, name, unit: check_positive(value, subject.format(name), unit)
        spread = [
            repeat(1, mass, "mass", "kg"),
            repeat(3, moment, "moment", "kg m"),
            repeat(3, inertia, "inertia", "1"),
        ]
        self.prior = jnp.concatenate(spread)
        densities = [
            repeat(3, torque, "torque", "N m/sqrt(Hz)"),
            repeat(1, mass_drift, "mass's drift", "kg/sqrt(s)"),
            repeat(3, moment_drift, "moment's drift", "kg m/sqrt(s)"),
            jnp.zeros(3),
        ]
        # Densities are per root of a hertz, so that another control rate gives the same spread after a
        # second.
        self.walk = h * jnp.concatenate(densities) ** 2
        self.thrust = positive(thrust, "thrust", "N/sqrt(Hz)")
        self.gyroscope = positive(gyroscope, "gyroscope's noise", "rad/s")
        if momentum is None:
            momentum = 0.0 if len(system.names) == 1 else 1e-3
        self.momentum = repeat((), momentum, "momentum", "N m s")
        self.bound = positive(bound, "bound", "1")

    def start(self) -> PayloadMemory:
        """First memory: no payload, with the prior standard deviations."""
        covariance = jnp.diag(jnp.concatenate([jnp.full(3, _UNKNOWN), self.prior]) ** 2)
        # a machine that hovers
        felt = jnp.zeros(3).at[2].set(jnp.linalg.norm(gravity_of(self.system)))
        sent = jnp.tile(self.before, (self.late + 1, 1))
        return PayloadMemory(
            jnp.zeros(10), covariance, jnp.zeros(3), felt, jnp.sqrt(self.before), sent
        )

    def payload(self, memory: PayloadMemory) -> Payload:
        """Payload that is fed forward: the mean within `bound`."""
        # The feedforward is bounded by the deviations before the flight: an estimate that diverges can then
        # mistrim the machine, but not overturn it.
        largest_payload = self.bound * self.prior
        return payload_of(jnp.clip(memory.mean[3:], -largest_payload, largest_payload))

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

        Where the estimate has an angular velocity or a force of NaN, there is no measurement, and the smoothed
        values propagate the motion.

        Args:
            about: moments of the machine without payload. on: motion of its last body.
        """
        # The wrench is that of the commands that reach the rotors in this period, which are late by the delay
        # and lag by the motors' time constant.
        speeds, squared = memory.speeds, memory.sent[0]
        if self.lag is not None:
            goal = jnp.sqrt(squared)
            # The first-order lag of the motors is integrated exactly over a period with a held command.
            speeds = goal + self.lag * (memory.speeds - goal)
            squared = ((memory.speeds + speeds) / 2) ** 2
        wrench = self.wrench_of(squared)
        turning, felt = estimate.state.omega[0], estimate.force
        # Without a reading the momentum is integrated on with the smoothed ones, and the update is skipped.
        has_reading = jnp.all(jnp.isfinite(turning)) & jnp.all(jnp.isfinite(felt))
        turning = jnp.where(has_reading, turning, memory.turning)
        felt = jnp.where(has_reading, felt, memory.felt)
        L, F = self.onwards(memory.mean, about, on, wrench[1:], turning, felt, memory.felt)
        # F is taken at smoothed readings: their noise would otherwise correlate with the innovation and find
        # payloads in noise.
        P = F @ memory.covariance @ F.T + jnp.diag(self.walk)
        z = memory.mean.at[:3].set(L)
        expected, H = self.expected(z, about, on, memory.turning, wrench[0])
        # The angular momentum of the moving parts is known to the accuracy of their estimated rates only.
        rate_noise = self.gyroscope**2 + (self.momentum / jnp.diagonal(about.inertia)) ** 2
        felt_noise = (self.thrust / (about.mass + z[3])) ** 2 / self.period
        noise = jnp.append(rate_noise, felt_noise)
        error = jnp.append(turning, felt[2]) - expected
        move, P, _ = update_sequentially(0.5 * (P + P.T), H, noise, error, jnp.full(4, has_reading))
        share = 1 - jnp.exp(-_SMOOTHING * self.period)
        smooth = lambda old, new: old + share * (new - old)
        readings = smooth(memory.turning, turning), smooth(memory.felt, felt)
        return PayloadMemory(z + move, P, *readings, speeds, memory.sent)

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
        # Euler's law about a moving point of the machine: internal forces drop out, and the accelerometer
        # measures the point's acceleration without gravity.
        h, p = self.period, add_payload(about, on, payload_of(z[3:])).first
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
        whole = lambda numbers: add_payload(about, on, payload_of(numbers))
        total_moments = whole(z[3:])
        inertia_derivative = jax.jacfwd(lambda numbers: whole(numbers).inertia)(z[3:])
        # The rate follows from the momentum by the inertia, which the payload changes: that makes its mass
        # visible to the gyroscope.
        # Cofactors are a dozen products that fuse with their neighbours; a library call for three rows costs
        # more.
        a, b, c = total_moments.inertia
        cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
        inverse_inertia = cofactors / (a @ cofactors[:, 0])
        W = inverse_inertia @ (z[:3] - total_moments.momentum)
        by_payload = -inverse_inertia @ jnp.einsum("ijk,j->ik", inertia_derivative, turning)
        rates = jnp.concatenate([inverse_inertia, by_payload], axis=1)
        # Along the thrust the accelerometer reads thrust over mass, whatever the motion: the direct
        # measurement of the total mass.
        lift = thrust / total_moments.mass
        by_mass = jnp.zeros(10).at[3].set(-lift / total_moments.mass)
        return jnp.append(W, lift), jnp.concatenate([rates, by_mass[None]])

    def wrench_of(self, squared: Float[Array, " k"]) -> Float[Array, "4"]:
        """Thrust [N] and moments about O [N m] of squared rotor speeds [rad^2/s^2]."""
        return self.rotors.wrench(squared, self.centre)[2:]


class AdaptiveMemory(NamedTuple):
    """Memory of an `AdaptiveController`.

    Attributes:
        flight: memory of the controller. payload: memory of the filter.
        centre: centre of mass that was fed forward, from the base's in its axes (3,) [m].
    """

    flight: FlightMemory
    payload: PayloadMemory
    centre: Float[Array, "3"]


class AdaptiveController(eqx.Module):
    """Controller whose mass, centre of mass and inertia are those of the machine with an estimated payload.

    At each sample the filter predicts with the last rotor commands. The mass properties with its payload, at
    the estimated posture, enter thrust and moments, the allocation, and the servo of a panel.

    Args:
        controller: controller of the rotors, or of a UAV with its tracker, for the machine without
            payload.
        filter: filter of the payload, for the same machine.

    Raises:
        SettingError: a `UavController` without feedforward; at the first call, an estimate that is no
            `MotionEstimate` of the filter's machine.
    """

    controller: FlightController | UavController
    filter: PayloadFilter

    def __check_init__(self) -> None:
        if isinstance(self.controller, UavController) and not self.controller.feedforward:
            raise SettingError(
                "A payload is fed forward with the moving tracker: it needs a UavController with its "
                "feedforward."
            )

    def start(self) -> AdaptiveMemory:
        """First memory."""
        return AdaptiveMemory(self.controller.start(), self.filter.start(), jnp.zeros(3))

    def __call__(
        self, estimate: Any, reference: Any, memory: AdaptiveMemory
    ) -> tuple[Float[Array, " m"], AdaptiveMemory]:
        """Inputs of the controller (m,), and the memory."""
        if not isinstance(estimate, MotionEstimate):
            raise SettingError(
                "A payload is estimated from a MotionEstimate, whose accelerometer and gyroscope it needs, "
                f"but the estimate is of the kind {type(estimate).__name__}."
            )
        state, controller, system = estimate.state, self.controller, self.filter.system
        if len(state.r) != len(system.names):
            raise SettingError(
                f"The payload's filter is of a machine of {len(system.names)} bodies, but the estimate has "
                f"{len(state.r)}."
            )
        moments, carrier = mass_moments(system, state), find_carrier_motion(state)
        filter_memory = self.filter.updated(estimate, moments, carrier, memory.payload)
        payload = self.filter.payload(filter_memory)
        mass, servo = central_properties(add_payload(moments, carrier, payload)), ()
        if isinstance(controller, UavController):
            bodies = bodies_carrying(controller.servo.bodies, payload)
            servo = (eqx.tree_at(lambda s: s.bodies, controller.servo, bodies),)
        inputs, flight = controller.command(state, reference, memory.flight, mass, *servo)
        payload_memory = self.filter.sent(filter_memory, inputs[: filter_memory.sent.shape[1]])
        return inputs, AdaptiveMemory(flight, payload_memory, mass.centre)
