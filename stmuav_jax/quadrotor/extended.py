"""Quadrotor model with additional states: a load that moves, the inertia matrix, drag.

    J' Omega' = tau - Omega x (J Omega + k c x c') - (dJ/dt) Omega - k c x c'' - d Omega

about the centre of mass of the whole, at c = (offset_x, offset_y, 0) from the epicentre. With
a point load of mass m_p within the total m, k = m (m - m_p) / m_p, and

    J = J_0 + k (|c|^2 I - c c^T),    dJ/dt = k (2 c . c' I - c' c^T - c c'^T)

The report keeps J constant and leaves out all terms with k, which is correct only for a load
without mass.

A swinging load has c = centre + s, s' = w q, q' = -w s, of known angular frequency w and
unknown centre, amplitudes and phases. The inertia has six states, J_0 = D (I + P) D with
D = diag(exp(ln J / 2)) and P the normalised products of inertia off the diagonal.

`stm.sensing.system_model` does not replace it: the inertia as a state in logarithms and correlations,
the swing of known period and the terms with k are no mechanism of bodies and joints, and its position
would be one more state that no sensor here sees.

Source: report Part III, Eq. 2.2.4 and 2.2.9; angular momentum of a body and a moving point mass
about their common centre of mass, as in R. N. Jazar, Advanced dynamics (2011), ch. 10.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import cross
from ..algebra.small import inverse
from ..algebra.space import AbstractSpace, Vector
from ..algebra.stacked import apply, dot
from ..checks.errors import SettingError, concrete
from ..estimation.model import Sensor, StateSpaceModel
from ..estimation.propagate import rk4
from ..parameters.table import Parameters
from .model import (
    NAMES,
    OBSERVABLE,
    PART_III,
    BodyRates,
    matrix,
    specific_force,
    torque,
)

# Standard deviations per step of the random walks by which the filter models constants [ln J, P,
# N m s, m]: estimates made at a wrong inertia are inexact and must not be kept for ever.
WANDER = {"inertia": 1e-4, "products": 2e-5, "drag": 1e-6, "swing": 2e-4}

SWING_NAMES = ("swing_x [m]", "swing_y [m]", "swing rate_x [m]", "swing rate_y [m]")
INERTIA_NAMES = ("ln J_xx", "ln J_yy", "ln J_zz", "P_xy", "P_xz", "P_yz")
DRAG_NAMES = ("d (rotational drag)",)
_PAIRS = ((0, 1), (0, 2), (1, 2))


class SwingMotion(NamedTuple):
    """Centre of mass relative to the epicentre, its rate and acceleration, body axes (3, *s)."""

    c: Float[Array, "3 *s"]
    rate: Float[Array, "3 *s"]
    acceleration: Float[Array, "3 *s"]


def motion(c: Array, rate: Array, acceleration: Array) -> SwingMotion:
    """Motion of a centre of mass in the plane of the rotors, from two components (2, *s) each."""
    flat = lambda a: jnp.concatenate([a, jnp.zeros_like(a[:1])])
    return SwingMotion(flat(c), flat(rate), flat(acceleration))


def load_factor(mass: Any, load: Any) -> Any:
    """Factor k = m (m - m_p) / m_p [kg] of the total mass and the load's mass [kg].

    Raises:
        SettingError: the load's mass is not between zero and the total.
    """
    if concrete(mass, load) and not 0 < load < mass:
        raise SettingError(
            f"The load's mass must lie between 0 and the total of {mass:g} kg, but it is {load:g} kg."
        )
    return mass * (mass - load) / load


def spun(
    omega: Float[Array, "3 *s"],
    moment: Float[Array, "3 *s"],
    J: Float[Array, "3 3 *#s"],
    path: SwingMotion,
    k: Any,
) -> Float[Array, "3 *s"]:
    """Angular acceleration [rad/s^2] with a moving load; J of the rest is about its own centre."""
    c, c1, c2 = path
    unit = jnp.eye(3, dtype=omega.dtype).reshape(3, 3, *(1,) * (omega.ndim - 1))
    full = J + k * (dot(c, c) * unit - c[:, None] * c[None])
    momentum = apply(full, omega) + k * cross(c, c1)
    change = k * (2 * dot(c, c1) * omega - c1 * dot(c, omega) - c * dot(c1, omega))
    return apply(inverse(full), moment - cross(omega, momentum) - change - k * cross(c, c2))


class Scaling(AbstractSpace):
    """Space of states with an inertia, whose errors keep torque and inertia in proportion.

    With s the mean of the errors v of ln J_xx, ln J_yy, ln J_zz, lengths and drag (`lengths`)
    become y = (x + v) exp(s), all other states y = x + v.

    A gyroscope under equal thrusts cannot distinguish (J, c, d) from (exp(s) J, exp(s) c,
    exp(s) d). In these errors that direction is the same everywhere, so that a filter whose
    estimate moves does not take an unobservable direction for known, as with plain differences.

    Source: A. Barrau, S. Bonnabel, The invariant extended Kalman filter as a stable observer,
    IEEE TAC 62 (2017), for the group of scalings.
    """

    size: int = eqx.field(static=True)
    lengths: tuple[int, ...] = eqx.field(static=True)
    inertia: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True, default=False)

    def _factor(self, v: Array) -> Array:
        """Factor exp(s) for lengths and drag, and one for the others (size, *s)."""
        s = jnp.mean(v[self.inertia : self.inertia + 3], axis=0)
        scaled = jnp.zeros(self.size, v.dtype).at[jnp.array(self.lengths)].set(1.0)
        return jnp.exp(scaled.reshape(-1, *(1,) * (v.ndim - 1)) * s)

    def retract(self, x: Array, v: Array) -> Array:
        return (x + v) * self._factor(v)

    def difference(self, y: Array, x: Array) -> Array:
        return y / self._factor(y - x) - x

    def check(self, x: Array, what: str) -> None:
        Vector(self.size).check(x, what)


class Extended(eqx.Module):
    """Equations of motion of the chosen states; see the module.

    Attributes:
        J: inertia (3, 3) [kg m^2], used if it is not estimated.
        arm, moments: arm [m] and drag moments (4,) [N m] of the rotors.
        frequency, k: angular frequency w of a swinging load [rad/s] and factor of a load with
            mass [kg], or None.
        mass: total mass [kg].
        inertia, drag: True if they are states.
    """

    J: Float[Array, "3 3"]
    arm: Any
    moments: Any
    frequency: Any
    k: Any
    mass: Any
    inertia: bool = eqx.field(static=True)
    drag: bool = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states, in their order."""
        found = NAMES[OBSERVABLE]
        if self.frequency is not None:
            found += SWING_NAMES
        return found + INERTIA_NAMES * self.inertia + DRAG_NAMES * self.drag

    @property
    def space(self) -> AbstractSpace:
        """Space of the states: `Scaling` if the inertia is among them, else a `Vector`."""
        n = len(self.names)
        if not self.inertia:
            return Vector(n)
        at = self.place(INERTIA_NAMES[0])
        lengths = tuple(k for k in range(3, n) if not at <= k < at + 6)
        return Scaling(size=n, lengths=lengths, inertia=at)

    def place(self, first: str) -> int:
        """Index of the first state of a group, by its name."""
        return self.names.index(first)

    def motion(self, x: Float[Array, "n *s"]) -> SwingMotion:
        """Motion of the centre of mass."""
        centre = x[3:5]
        if self.frequency is None:
            return motion(centre, jnp.zeros_like(centre), jnp.zeros_like(centre))
        s, q, w = x[5:7], x[7:9], self.frequency
        return motion(centre + s, w * q, -(w**2) * s)

    def tensor(self, x: Float[Array, "n *s"]) -> Float[Array, "3 3 *#s"]:
        """Inertia J_0 without the load [kg m^2]."""
        if not self.inertia:
            return self.J.reshape(3, 3, *(1,) * (x.ndim - 1))
        at = self.place(INERTIA_NAMES[0])
        return inertia_matrix(x[at : at + 6])

    def turning(self, x: Float[Array, "n *s"], u: Float[Array, "4 *#s"]) -> Float[Array, "3 *s"]:
        """Angular acceleration [rad/s^2] under thrusts u [N]."""
        omega, path, J = x[:3], self.motion(x), self.tensor(x)
        moment = torque(path.c[:2], u, self.arm, self.moments)
        if self.drag:
            at = self.place(DRAG_NAMES[0])
            moment = moment - x[at : at + 1] * omega
        if self.k is not None:
            return spun(omega, moment, J, path, self.k)
        J_inverse = inverse(J)
        return apply(J_inverse, moment - cross(omega, apply(J, omega)))

    def rates(self, x: Float[Array, "n *s"], u: Float[Array, "4 *#s"]) -> Float[Array, "n *s"]:
        """Rates of all states under thrusts u [N]."""
        slope = self.turning(x, u)
        rest = jnp.zeros_like(x[3:])
        if self.frequency is not None:
            swing = self.frequency * jnp.concatenate([x[7:9], -x[5:7]])
            rest = jnp.concatenate([rest[:2], swing, rest[6:]])
        return jnp.concatenate([slope, rest])

    def specific_force(
        self, x: Float[Array, "n *s"], u: Float[Array, "4 *#s"]
    ) -> Float[Array, "3 *s"]:
        """Reading of an accelerometer at the epicentre in body axes [m/s^2]."""
        path, lift = self.motion(x), jnp.sum(u, axis=0) / self.mass
        moving = path.rate, path.acceleration
        return specific_force(x[:3], self.turning(x, u), path.c, lift, moving)

    def inertial(self, x: Float[Array, "n *s"], u: Float[Array, "4 *#s"]) -> Float[Array, "6 *s"]:
        """Readings of a gyroscope [rad/s] and of the accelerometer at the epicentre [m/s^2]."""
        return jnp.concatenate([x[:3], self.specific_force(x, u)])


def inertia_matrix(states: Float[Array, "6 *s"]) -> Float[Array, "3 3 *s"]:
    """Inertia J_0 from its six states [kg m^2]."""
    root, P = jnp.exp(states[:3] / 2), states[3:]
    one = jnp.ones_like(root[0])
    unit = jnp.stack([one, P[0], P[1], P[0], one, P[2], P[1], P[2], one])
    return unit.reshape(3, 3, *one.shape) * root[:, None] * root[None]


def inertia_states(J: Any) -> np.ndarray:
    """Six states of an inertia tensor (3, 3) [kg m^2]."""
    J = np.asarray(J, dtype=float)
    root = np.sqrt(np.diag(J))
    return np.array([*np.log(np.diag(J)), *(J[i, j] / root[i] / root[j] for i, j in _PAIRS)])


def extended_noise(
    *,
    period: float | None = None,
    load: float | None = None,
    inertia: bool = False,
    drag: bool = False,
    parameters: Parameters = PART_III,
) -> np.ndarray:
    """Diagonal of Q (n,) for `extended_model`, from the table's true one and `WANDER`."""
    Q = [*np.array(parameters.value("true.Q"))[OBSERVABLE]]
    if period is not None:
        Q += [0.0 if load is None else WANDER["swing"] ** 2] * 4
    if inertia:
        Q += [WANDER["inertia"] ** 2] * 3 + [WANDER["products"] ** 2] * 3
    return np.array(Q + [WANDER["drag"] ** 2] * drag)


def extended_model(
    *,
    Q: Any = None,
    R: Any = None,
    period: float | None = None,
    load: float | None = None,
    inertia: bool = False,
    drag: bool = False,
    accelerometer: bool = False,
    parameters: Parameters = PART_III,
) -> StateSpaceModel:
    """State-space model of body rates, centre of mass and other chosen states, with RK4 steps.

    Args:
        Q: covariance of the process noise (n,) or (n, n), per step, in the order of the model's
            `names`; by default `extended_noise`.
        R: covariance of the measurements' noise: (3,) for the gyroscope [rad^2/s^2], by default
            the table's true one; with an accelerometer (6,), its [m^2/s^4] last.
        period: period of a swinging load [s], which adds four states.
        load: mass of the load [kg], which changes J; None for the report's load without inertia.
        inertia: add six states of the inertia (`inertia_states`).
        drag: add a state, d in tau = -d Omega [N m s].
        accelerometer: add an accelerometer at the epicentre to the gyroscope.

    Raises:
        SettingError: a period that is not positive, or a load heavier than the whole.
    """
    if period is not None and not period > 0:
        raise SettingError(f"The period of the load must be positive, but it is {period:g} s.")
    mass = parameters.value("mass")
    equations = Extended(
        jnp.asarray(parameters.value("inertia")),
        parameters.value("arm"),
        parameters.value("drag"),
        None if period is None else 2 * math.pi / period,
        None if load is None else load_factor(mass, load),
        mass,
        inertia,
        drag,
    )
    if Q is None:
        Q = extended_noise(
            period=period, load=load, inertia=inertia, drag=drag, parameters=parameters
        )
    R = parameters.value("true.R") if R is None else R
    names = tuple(f"gyroscope {axis}" for axis in "xyz")
    if accelerometer:
        names += tuple(f"accelerometer {axis}" for axis in "xyz")

    seen = equations.inertial if accelerometer else BodyRates(0)
    sensor = Sensor(seen, matrix(R), names=names, stacked=True)
    step = rk4(equations.rates)
    return StateSpaceModel(
        step, matrix(Q), sensor, space=equations.space, names=equations.names, stacked=True
    )
