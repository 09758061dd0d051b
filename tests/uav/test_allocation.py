"""Rotor speeds and their wrench: the report's mixing corrected, limits, lift."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_II, ModelError
from stmuav_jax.uav import RotorLimits, Rotors
from stmuav_jax.uav.allocation import check_lift, minimum_norm, wrench_map

K_F, K_TAU = PART_II.value("rotor.k_f"), PART_II.value("rotor.k_tau")


def rotors(arms, spin):
    return Rotors("hull", arms=arms, spin=spin, k_f=K_F, k_tau=K_TAU, speed_squared=jnp.ones(6))


def hexagon(start, step, spin, length=0.35):
    """Rotors on a circle, the first at `start` degrees."""
    angle = np.radians(start + step * np.arange(6))
    arms = length * np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=1)
    return rotors(arms, spin)


ALTERNATE = [1.0, -1.0, 1.0, -1.0, 1.0, -1.0]
HALF, ROOT = 0.5, np.sqrt(3) / 2
# report Part II, Eq. 4.9, with the signs of rows 2 and 3 corrected
MIXING = np.array([
    [1, 1, 1, 1, 1, 1],
    [-HALF, -1, -HALF, HALF, 1, HALF],
    [-ROOT, 0, ROOT, ROOT, 0, -ROOT],
    [-1, 1, -1, 1, -1, 1],
])  # fmt: skip


def test_idealised_mixing_is_the_wrench_map_of_a_hexagon():
    """Eq. 4.9, corrected: rotors at -30 - 60 (i - 1) degrees, seen from above clockwise."""
    length = 0.35
    units = np.diag([K_F, K_F * length, K_F * length, K_TAU])
    B = wrench_map(hexagon(-30, -60, ALTERNATE, length), jnp.zeros(3))
    np.testing.assert_allclose(B, units @ MIXING, rtol=0, atol=1e-20)


def inverse_as_printed(length, k):
    """Eq. 4.10, with k = k_f l / k_tau."""
    r = np.sqrt(3)
    rows = np.array([
        [length, 2, 0, -k], [length, 1, -r, k], [length, -1, -r, -k],
        [length, -2, 0, k], [length, -1, r, -k], [length, 1, r, k],
    ])  # fmt: skip
    return rows / (6 * K_F * length)


def test_inverse_mixing_of_the_report_numbers_the_rotors_otherwise():
    """Eq. 4.10 is the least-norm inverse of rotors at 90, 30, ... degrees, not of Eq. 4.9's."""
    length = 0.35
    printed = inverse_as_printed(length, K_F * length / K_TAU)
    mine = wrench_map(hexagon(-30, -60, ALTERNATE, length), jnp.zeros(3))
    theirs = wrench_map(hexagon(90, -60, ALTERNATE, length), jnp.zeros(3))
    as_matrix = lambda B: np.asarray(jax.vmap(lambda w: minimum_norm(B, w))(jnp.eye(4))).T
    np.testing.assert_allclose(as_matrix(theirs), printed, rtol=1e-12, atol=1e-9)
    corrected = np.roll(printed, 4, axis=0)
    np.testing.assert_allclose(as_matrix(mine), corrected, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(
        as_matrix(mine), np.linalg.pinv(np.asarray(mine)), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ((1700.0, 300.0), "rotor 1 are 1700 and 300 rad/s"),
        ((-1.0, 300.0), "0 <= lowest < highest"),
        ((0.0, np.inf), "highest rotor speed must be finite"),
        (([0.0] * 5, 1000.0), r"shape is \(5,\)"),
        ((0.0, [1e3, 1e3, 1e3, 0.0, 1e3, 1e3]), "rotor 4"),
    ],
)
def test_senseless_limits_are_refused(limits, words):
    with pytest.raises(ModelError, match=words):
        RotorLimits(*limits).squared(6)


def test_lift_that_does_not_carry_says_required_and_available():
    hull = rotors(PART_II.value("rotor.arms"), PART_II.value("rotor.spin"))
    least_thrust, most = check_lift(hull, RotorLimits(0.0, 1400.0), 72.25)
    assert float(most) == pytest.approx(6 * K_F * 1400**2)
    assert float(least_thrust) == 0
    with pytest.raises(ModelError, match=r"72.25 N are required.* 0 to 39.28 N"):
        check_lift(hull, RotorLimits(0.0, 1000.0), 72.25)
    with pytest.raises(ModelError, match=r"weight is 72.25 N.* 76.98 to 157.1 N"):
        check_lift(hull, RotorLimits(1400.0, 2000.0), 72.25)
