"""Inertial navigation: a base that gyroscope and accelerometer drive, corrected by late fixes.

    p <- p exp(h (w_m - b_w)),   v <- v + h (R (f_m - b_f) + g),   r <- r + h v + h^2 / 2 (...),

with the biases b_w and b_f as further states; w_m is the mean of the readings at both ends of a step,
R f_m that of the forces, each in its own attitude. The errors are those of attitude (a rotation vector
in the base's axes), position, velocity, and the biases, 15 in this order. The filters of `GaussianFilter`
give the same numbers; here the derivatives have closed forms, and one component of a fix is taken after
the other, which needs no factorisations.

Source: J. Sola, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508 (2017),
ch. 5 and 6.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..checks.errors import SettingError
from ..checks.numbers import as_floats
from ..math.compiler import quick_jit
from ..math.rotation import (
    conjugate,
    from_rotation_vector,
    normalise,
    product,
    rotation_matrix,
    skew,
    to_rotation_vector,
)
from ..math.space import Composite, Point, Rotation, Vector

# Readings beyond the gate, one after the other, after which a reading is taken again.
MOST_GATED = 10

# Names of the errors.
ERRORS = tuple(
    f"{name} {axis}"
    for name in ("attitude", "position", "velocity", "gyroscope bias", "accelerometer bias")
    for axis in "xyz"
)


# Space of a base's points, whose errors are in the order of `ERRORS`.
BASE = Composite(
    p=Rotation(), r=Vector(3), v=Vector(3), gyroscope_bias=Vector(3), accelerometer_bias=Vector(3)
)


class Belief(NamedTuple):
    """Mean of an estimate, and the covariance of its errors.

    Attributes:
        mean: of a base, "p", "r", "v", "gyroscope_bias" [rad/s] and "accelerometer_bias" [m/s^2]; of a
            vector, the vector (n,).
        covariance: of a base's errors (15, 15), that of p in its own axes [rad]; of a vector's (n, n).
    """

    mean: Any
    covariance: Float[Array, "n n"]


def _turn_matrix(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    return rotation_matrix(from_rotation_vector(v))


def strapdown(
    x: Point, turning: Float[Array, "3"], force: Float[Array, "3"], gravity: Float[Array, "3"],
    h: Float[Array, ""],
) -> tuple[Point, Float[Array, "15 15"]]:  # fmt: skip
    """Motion of a base over a step h [s] by readings of gyroscope and accelerometer.

    Returns:
        point at its end, and the matrix of errors there by those before, to first order in h for
        the gyroscope's bias.
    """
    omega, felt = turning - x["gyroscope_bias"], force - x["accelerometer_bias"]
    half = from_rotation_vector(h / 2 * omega)
    middle = product(x["p"], half)
    R = rotation_matrix(middle)
    a = R @ felt + gravity
    next_point = {"p": normalise(product(middle, half)), "v": x["v"] + h * a}
    next_point = {**x, **next_point, "r": x["r"] + h * x["v"] + h**2 / 2 * a}
    back = rotation_matrix(half).T
    by_attitude = -R @ skew(felt) @ back
    unit, none = jnp.eye(3), jnp.zeros((3, 3))
    errors = [
        [back @ back, none, none, -h * unit, none],
        [h**2 / 2 * by_attitude, unit, h * unit, none, -(h**2) / 2 * R],
        [h * by_attitude, none, unit, none, -h * R],
        [none, none, none, unit, none],
        [none, none, none, none, unit],
    ]
    return next_point, jnp.block(errors)


def predict_base(
    belief: Belief,
    turning: tuple[Float[Array, "3"], Float[Array, "3"]],
    force: tuple[Float[Array, "3"], Float[Array, "3"]],
    gravity: Float[Array, "3"],
    h: Float[Array, ""],
    noise: Float[Array, "15 15"],
) -> Belief:
    """Belief about a base after a step h [s].

    Args:
        turning, force: readings of gyroscope and accelerometer at the step's start and end.
        noise: covariance that the step adds.
    """
    x, rate = belief.mean, (turning[0] + turning[1]) / 2
    # Both forces are turned to the middle of the step, where the trapezoidal mean is correct to second
    # order while the vehicle rotates; that of one end alone would be late by half a step.
    turn = _turn_matrix(h / 2 * (rate - x["gyroscope_bias"]))
    felt = (turn.T @ force[0] + turn @ force[1]) / 2
    x, F = strapdown(x, rate, felt, gravity, h)
    # A plain covariance serves here, because the position and attitude sensors bound the ratio of its
    # largest to its smallest variance; its symmetric part removes round-off.
    P = F @ belief.covariance @ F.T + noise
    return Belief(x, 0.5 * (P + P.T))


def update_sequentially(
    P: Float[Array, "n n"], H: Float[Array, "m n"], variance: Float[Array, " m"],
    error: Float[Array, " m"], fresh: Bool[Array, " m"], move: Float[Array, " n"] | None = None,
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, ""]]:  # fmt: skip
    """Move of the mean, covariance and NIS after the fresh components, one after the other.

    Args:
        error: readings less those expected; of components that are not fresh any number, also NaN.
        move: move of the mean by earlier components of the same time; none by default.
    """
    nis, mean_change = jnp.zeros(()), jnp.zeros(P.shape[0]) if move is None else move
    # Scalar updates need no inverse of an innovation covariance, and a component without a fresh reading
    # is left out by a weight of zero.
    for row, r, nu, new in zip(H, variance, error, fresh, strict=True):
        gain_row = P @ row
        weight = jnp.where(new, 1 / (row @ gain_row + r), 0.0)
        # The mean has moved by the earlier components of the same time, to which this row was not linearised
        # anew.
        innovation = jnp.where(new, nu, 0.0) - row @ mean_change
        mean_change = mean_change + weight * innovation * gain_row
        P = P - weight * gain_row[:, None] * gain_row[None, :]
        nis = nis + weight * innovation**2
    return mean_change, P, nis


class Gated(NamedTuple):
    """Result of readings that a gate has looked at.

    Attributes:
        move, covariance: of the mean and of its errors, after the readings that were taken.
        nis: normalised innovation squared of those (). components: their number ().
        gated: True for a reading that was left out (f,).
        streak: readings beyond the gate, one after the other, until now (f,).
    """

    move: Float[Array, " n"]
    covariance: Float[Array, "n n"]
    nis: Float[Array, ""]
    components: Float[Array, ""]
    gated: Bool[Array, " f"]
    streak: Int[Array, " f"]


def update_with_gate(
    P: Float[Array, "n n"], H: Sequence[Float[Array, "_ n"]], variance: Sequence[Float[Array, " _"]],
    error: Sequence[Float[Array, " _"]], fresh: Bool[Array, " f"], limits: Sequence[Float[Array, ""]],
    streak: Int[Array, " f"],
) -> Gated:  # fmt: skip
    """Update by f readings, one after the other, each of which a gate may leave out.

    The innovation of a reading given those before has a squared Mahalanobis distance that is chi-squared;
    beyond its limit a reading is left out, unless `MOST_GATED` before it, one after the other, were
    beyond too: then the estimate is at fault, and they are taken.
    """
    move, nis, count = jnp.zeros(P.shape[0]), jnp.zeros(()), jnp.zeros(())
    gated, streaks = [], []
    for k, (rows, noise, nu, limit) in enumerate(zip(H, variance, error, limits, strict=True)):
        new = jnp.broadcast_to(fresh[k], noise.shape)
        move_after, P_after, distance = update_sequentially(P, rows, noise, nu, new, move)
        # A distance of NaN counts as beyond the gate, hence the negated comparison.
        beyond = fresh[k] & ~(distance <= limit)
        refused = beyond & (streak[k] < MOST_GATED)
        streaks.append(jnp.where(fresh[k], jnp.where(beyond, streak[k] + 1, 0), streak[k]))
        move, P = jnp.where(refused, move, move_after), jnp.where(refused, P, P_after)
        nis = nis + jnp.where(refused, 0.0, distance)
        count = count + jnp.where(fresh[k] & ~refused, 1.0 * len(noise), 0.0)
        gated.append(refused)
    return Gated(move, P, nis, count, jnp.stack(gated), jnp.stack(streaks))


def fix_rows(
    R: Float[Array, "3 3"],
    arm: Float[Array, "3"],
    omega: Float[Array, "3"],
    late: Float[Array, "2"],
) -> Float[Array, "6 15"]:
    """Derivatives of a position and an attitude fix by the errors.

    Args:
        R: rotation of the base when its position was fixed. arm: point of the fix from the centre of mass,
            base axes (3,) [m].
        omega: angular velocity, base axes (3,) [rad/s]. late: delays of both fixes [s].
    """
    unit, none = jnp.eye(3), jnp.zeros((3, 3))
    return jnp.block(
        [
            [-R @ skew(arm) @ _turn_matrix(late[0] * omega), unit, -late[0] * unit, none, none],
            [_turn_matrix(late[1] * omega), none, none, late[1] * unit, none],
        ]
    )


def update_by_fixes(
    belief: Belief, turning: Float[Array, "3"], force: Float[Array, "3"], gravity: Float[Array, "3"],
    arm: Float[Array, "3"], late: Float[Array, "2"], variance: Float[Array, "6"],
    limit: Float[Array, ""], position: Float[Array, "3"], attitude: Float[Array, "4"],
    fresh: Bool[Array, "2"], streak: Int[Array, "2"],
) -> tuple[Belief, Gated]:  # fmt: skip
    """Belief after a position and an attitude fix, and what the gate did.

    Args:
        turning, force: present readings of gyroscope and accelerometer.
        arm: point of the position fix from the centre of mass, base axes [m].
        late: delays of both fixes [s]. variance: of their components. limit: that of the gate.
        position, attitude: the fixes; of one that is not fresh any numbers.
    """
    x = belief.mean
    # A delayed reading is compared with the state at its own time, found by integrating the present one
    # backwards: a delay is short against the dynamics, and no past states have to be kept.
    past_point, _ = strapdown(x, turning, force, gravity, -late[0])
    facing, _ = strapdown(x, turning, force, gravity, -late[1])
    R = rotation_matrix(past_point["p"])
    position_error = position - past_point["r"] - R @ arm
    rotation_error = to_rotation_vector(product(conjugate(facing["p"]), attitude))
    H = fix_rows(R, arm, turning - x["gyroscope_bias"], late)
    gate_result = update_with_gate(
        belief.covariance, (H[:3], H[3:]), (variance[:3], variance[3:]), (position_error, rotation_error), fresh,
        [limit] * 2, streak,
    )  # fmt: skip
    return Belief(BASE.retract(x, gate_result.move), gate_result.covariance), gate_result


def keep_covariance(P: Float[Array, "n n"], streak: Int[Array, " f"]) -> Gated:
    """Result where no reading has arrived."""
    zero = jnp.zeros((), P.dtype)
    return Gated(
        jnp.zeros(P.shape[0], P.dtype), P, zero, zero, jnp.zeros(len(streak), bool), streak
    )


def gate_limits(gate: float) -> Float[Array, "2"]:
    """Squared Mahalanobis distances that one and three components pass with a probability `gate` only.

    Raises:
        SettingError: the gate is not from 0 (no gate) to below 1.
    """
    from scipy.special import chdtri

    if not 0 <= gate < 1:
        raise SettingError(
            f"The gate is a probability from 0 (no gate) to below 1, but it is {gate}."
        )
    return as_floats(np.inf * np.ones(2) if gate == 0 else chdtri(np.array([1.0, 3.0]), gate))


@quick_jit
def step_noise(
    h: Float[Array, ""],
    gyroscope: Float[Array, "3"],
    accelerometer: Float[Array, "3"],
    gyroscope_drift: Float[Array, ""],
    accelerometer_drift: Float[Array, ""],
) -> Float[Array, "15 15"]:
    """Covariance that noise and drift of gyroscope and accelerometer add over a step h [s]."""
    drift = [x * jnp.sqrt(h) * jnp.ones(3) for x in (gyroscope_drift, accelerometer_drift)]
    Q = reading_noise(h, gyroscope, accelerometer)
    return Q + jnp.diag(jnp.concatenate([jnp.zeros(9), *drift]) ** 2)


def reading_noise(
    h: Float[Array, ""], gyroscope: Float[Array, "3"], accelerometer: Float[Array, "3"]
) -> Float[Array, "15 15"]:
    """Covariance that errors of one reading of gyroscope and accelerometer add over a step h [s]."""
    none = jnp.zeros(6)
    # An error of a reading acts over the whole step, so that its effect on a position is h^2 / 2 and not
    # a separate noise.
    steps = [h * gyroscope, h**2 / 2 * accelerometer, h * accelerometer, none]
    Q = jnp.diag(jnp.concatenate(steps) ** 2)
    # errors of position and velocity come from one reading of the accelerometer
    k, cross = jnp.arange(3), h**3 / 2 * accelerometer**2
    return Q.at[3 + k, 6 + k].set(cross).at[6 + k, 3 + k].set(cross)


def gap_noise(
    changes: Float[Array, "2"], h: Float[Array, ""], gaps: Int[Array, "2"]
) -> Float[Array, "15 15"]:
    """Covariance that a step adds where gyroscope or accelerometer have kept their last reading.

    A rate that changes steadily is off by the change times the gap. Errors of the steps of a gap are
    one error, not independent ones: with the root of their number their sum has its size.

    Args:
        changes: how fast angular velocity and force may change [rad/s^2], [m/s^3].
        gaps: steps since the last readings.
    """
    # The error of a kept reading grows in proportion to the gap, and the errors of one gap add
    # coherently.
    errors = changes * h * gaps * jnp.sqrt(gaps)
    return reading_noise(h, *(errors[:, None] * jnp.ones((1, 3))))
