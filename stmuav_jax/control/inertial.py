"""Kinematics of a base that gyroscope and accelerometer drive, with their errors, and its fixes.

The errors are those of attitude (a rotation vector in the base's axes), position, velocity, and the
biases of gyroscope and accelerometer, 15 in this order.

Source: J. Sola, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508 (2017),
ch. 5 and 6.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import quick_jit
from ..algebra.rotation import from_rotation_vector, normalise, product, rotation_matrix, skew
from ..algebra.space import Point

# Names of the errors.
ERRORS = tuple(
    f"{name} {axis}"
    for name in ("attitude", "position", "velocity", "gyroscope bias", "accelerometer bias")
    for axis in "xyz"
)


def _turn(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    return rotation_matrix(from_rotation_vector(v))


def strapdown(
    x: Point,
    turning: Float[Array, "3"],
    force: Float[Array, "3"],
    gravity: Float[Array, "3"],
    h: Float[Array, ""],
) -> tuple[Point, Float[Array, "15 15"]]:
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
    moved = {"p": normalise(product(middle, half)), "v": x["v"] + h * a}
    moved = {**x, **moved, "r": x["r"] + h * x["v"] + h**2 / 2 * a}
    back = rotation_matrix(half).T
    by_attitude = -R @ skew(felt) @ back
    one, none = jnp.eye(3), jnp.zeros((3, 3))
    errors = jnp.block(
        [
            [back @ back, none, none, -h * one, none],
            [h**2 / 2 * by_attitude, one, h * one, none, -(h**2) / 2 * R],
            [h * by_attitude, none, one, none, -h * R],
            [none, none, none, one, none],
            [none, none, none, none, one],
        ]
    )
    return moved, errors


def one_by_one(
    P: Float[Array, "n n"],
    H: Float[Array, "m n"],
    variance: Float[Array, " m"],
    error: Float[Array, " m"],
    fresh: Bool[Array, " m"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, ""]]:
    """Move of the mean, covariance and NIS after the fresh components, one after the other."""
    move, nis = jnp.zeros(P.shape[0]), jnp.zeros(())
    for row, r, nu, new in zip(H, variance, error, fresh, strict=True):
        along = P @ row
        weight = jnp.where(new, 1 / (row @ along + r), 0.0)
        left = nu - row @ move
        move = move + weight * left * along
        P = P - weight * along[:, None] * along[None, :]
        nis = nis + weight * left**2
    return move, P, nis


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
    one, none = jnp.eye(3), jnp.zeros((3, 3))
    return jnp.block(
        [
            [-R @ skew(arm) @ _turn(late[0] * omega), one, -late[0] * one, none, none],
            [_turn(late[1] * omega), none, none, late[1] * one, none],
        ]
    )


@quick_jit
def walks(
    h: Float[Array, ""],
    gyroscope: Float[Array, "3"],
    accelerometer: Float[Array, "3"],
    gyroscope_drift: Float[Array, ""],
    accelerometer_drift: Float[Array, ""],
    panel: Float[Array, ""],
) -> tuple[Float[Array, "15 15"], Float[Array, "4 4"]]:
    """Covariances that a period h [s] adds to those of the base and of the panel."""
    drift = [x * jnp.sqrt(h) * jnp.ones(3) for x in (gyroscope_drift, accelerometer_drift)]
    steps = [h * gyroscope, h**2 / 2 * accelerometer, h * accelerometer, *drift]
    Q = jnp.diag(jnp.concatenate(steps) ** 2)
    # errors of position and velocity come from one reading of the accelerometer
    k, cross = jnp.arange(3), h**3 / 2 * accelerometer**2
    Q = Q.at[3 + k, 6 + k].set(cross).at[6 + k, 3 + k].set(cross)
    one = panel**2 * jnp.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    return Q, jnp.kron(one, jnp.eye(2))


def panel_step(h: Float[Array, ""]) -> Float[Array, "4 4"]:
    """Matrix of the panel's angles and rates over a step h [s]."""
    return jnp.eye(4).at[:2, 2:].add(h * jnp.eye(2))
