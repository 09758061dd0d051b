"""Flights of a multirotor in closed loop whose every parameter is known, for tests of identification.

A rigid body with lagging rotors, drag, gusts and filtered, noisy sensors flies under an attitude
controller that sees the sensors only, while a pilot commands manoeuvres.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import butter

from stmuav_jax.uav.flight_identification.record import FlightRecord, make_layout

GRAVITY = 9.80665
DT, EVERY = 1e-3, 2
ARM = 0.0283
POSITIONS = ARM * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0.0]])
SPIN = np.array([1, -1, 1, -1.0])
LAYOUT = make_layout(POSITIONS, SPIN, mass=0.027)


class Truth(NamedTuple):
    """Numbers of the vehicle and its flight, per mass and inertia where they are ratios."""

    thrust: float = 5.8  # of a rotor over mass by the square of its state [m/s^2]
    B: tuple = (245.0, 232.0, 30.0)  # [rad/s^2]
    spin_up: float = 5.0  # [rad/s]
    ratios: tuple = (-0.7, 0.7, -0.05)  # of q r, p r, p q
    tau: float = 0.06
    delay: float = 0.004
    centre: tuple = (-0.0009, 0.0004)
    imu: tuple = (0.0007, 0.0037, -0.0022)
    drag: tuple = (0.45, 0.51, 0.4)
    speed: tuple = (-6.0, 6.0)  # moment of v_y and v_x [rad/(m s)]
    gyroscopic: tuple = (
        8.3,
        7.9,
    )  # moment of the spins' sum and a rate about the other axis [rad/s]
    rate_force: tuple = (0.0036, 0.0041)  # of q and -p, by drag below the centre of mass [m/s]
    gyro_bias: tuple = (0.003, -0.002, 0.001)
    force_bias: tuple = (-0.16, -0.12, 0.05)
    gust_moment: tuple = (8.0, 8.0, 1.5)  # deviations [rad/s^2]
    gust_force: float = 0.07  # [m/s^2]
    gyro_noise: float = 0.02
    force_noise: float = 0.4
    strength: tuple = (1.0, 1.0, 1.0, 1.0)
    fade: float = 0.0  # share of the thrust that is lost through the flight
    sag: float = 0.0  # share of the thrust that is lost by the slow collective, relative
    second_lag: float = 0.0  # [s]
    discharge: float = 0.0  # share of the voltage that is lost through the flight
    dip: float = 0.0  # share of it that is lost by the slow collective, relative
    voltage_exponent: float = 1.0  # of the voltage that multiplies the command
    manoeuvres: tuple = (1.0, 1.0, 1.0, 1.0)  # sizes about roll, pitch, yaw and in thrust


TRUTH = Truth()
# True values of the estimates that ratios and the layout's mass determine.
VALUES = {
    "lag": TRUTH.tau, "delay": TRUTH.delay, "roll": TRUTH.B[0], "pitch": TRUTH.B[1], "yaw": TRUTH.B[2],
    "roll_over_lag": TRUTH.B[0] / TRUTH.tau, "pitch_over_lag": TRUTH.B[1] / TRUTH.tau,
    "yaw_over_lag": TRUTH.B[2] / TRUTH.tau, "spin_up": TRUTH.spin_up,
    "roll_speed": TRUTH.speed[0], "pitch_speed": TRUTH.speed[1],
    "centre_x": TRUTH.centre[0], "centre_y": TRUTH.centre[1],
    "free_centre_x": TRUTH.centre[0], "free_centre_y": TRUTH.centre[1],
    "inertia_ratio": TRUTH.B[0] / TRUTH.B[1], "thrust": TRUTH.thrust, "thrust_lag": TRUTH.tau,
    "thrust_slope": TRUTH.thrust, "thrust_linear": 0.0, "thrust_quadratic": TRUTH.thrust,
    "imu_x": TRUTH.imu[0], "imu_y": TRUTH.imu[1], "imu_z": TRUTH.imu[2],
    "drag_x": TRUTH.drag[0], "drag_y": TRUTH.drag[1], "drag_z": TRUTH.drag[2],
    "force": TRUTH.thrust * 0.027, "inertia_x": TRUTH.thrust * 0.027 * ARM / TRUTH.B[0],
    "inertia_y": TRUTH.thrust * 0.027 * ARM / TRUTH.B[1],
}  # fmt: skip


def simulate_flights(seeds, length=40.0, truth=None, settings=(80.0, 30.0)):
    """Records of one flight for each seed."""
    truth = truth or Truth()
    numbers = jax.tree.map(jnp.asarray, truth)
    keys = jax.vmap(jax.random.PRNGKey)(jnp.asarray(seeds))
    steps = round(length / DT)
    pilots = jnp.stack([_pilot(seed, steps) for seed in seeds])
    coefficients: Any = [butter(2, 2 * f * DT) for f in settings]
    filters = tuple(tuple(map(jnp.asarray, pair)) for pair in coefficients)
    fly: Any = jax.jit(jax.vmap(partial(_fly, truth=numbers, filters=filters)))
    u, w, f, ratio = fly(keys, pilots)
    pick = lambda x: np.asarray(x[:, ::EVERY], float)
    ts = np.arange(steps)[::EVERY] * DT
    has_voltage = truth.discharge > 0 or truth.dip > 0
    voltage = lambda volts: 4.0 * volts if has_voltage else None
    return [
        FlightRecord(ts, commands, gyro, accel, voltage(volts), settings, filter_rate=1 / DT)
        for commands, gyro, accel, volts in zip(*map(pick, (u, w, f, ratio)), strict=True)
    ]


def _pilot(seed, steps):
    """Commanded roll and pitch [rad], yaw rate [rad/s] and share of thrust (steps, 4): random steps."""
    rng = np.random.default_rng(seed)
    columns = []
    for size, hold in ((0.35, 0.25), (0.35, 0.25), (1.5, 0.5), (0.12, 0.4)):
        values = size * rng.choice([-1.0, 0.0, 1.0], steps)
        ends = np.cumsum(rng.exponential(hold, steps // 100) + 0.1)
        columns.append(values[np.searchsorted(ends, np.arange(steps) * DT)])
    return jnp.asarray(np.stack(columns, axis=1))


def _fly(key, pilot, truth, filters):
    n = len(SPIN)
    y, x = (jnp.asarray(POSITIONS[:, k]) for k in (1, 0))
    hover = jnp.sqrt(GRAVITY / (n * truth.thrust))
    B, ratios, drag = map(jnp.asarray, (truth.B, truth.ratios, truth.drag))
    cx, cy = truth.centre
    imu = jnp.asarray(truth.imu)
    steps = len(pilot)
    lag = round(0.004 / DT)
    noise = jax.random.normal(key, (steps, 12))
    wind_keep = jnp.exp(-DT / 0.3)

    def filtered(state, value, coefficients):
        b, a = coefficients
        z1, z2 = state
        out = b[0] * value + z1
        return (b[1] * value + z2 - a[1] * out, b[2] * value - a[2] * out), out

    def step(carry, now):
        s, s2, w, R, v, gust, pipe, gf, ff, integral, u, slow, k, dw = carry
        wish, e = now
        decay = jnp.exp(-DT / truth.tau)
        ratio = 1 - truth.discharge * (k / steps - 0.5) - truth.dip * (slow / (4 * hover**2) - 1)
        s_next = decay * s + (1 - decay) * pipe[1] * ratio**truth.voltage_exponent
        keep = jnp.exp(-DT / jnp.maximum(truth.second_lag, 1e-9))
        second = jnp.where(truth.second_lag > 0, keep, 0.0)
        s2_next = second * s2 + (1 - second) * s_next
        spun = jnp.array([0.0, 0.0, -truth.spin_up * jnp.sum(SPIN * (s2_next - s2))])
        # sensors at the beginning of the step
        fade = 1 - truth.fade * k / steps - truth.sag * (slow / (4 * hover**2) - 1)
        T = jnp.asarray(truth.strength) * s2**2 * fade
        moments = jnp.array([
            B[0] * jnp.sum((y - cy) * T) / ARM, -B[1] * jnp.sum((x - cx) * T) / ARM,
            -B[2] * jnp.sum(SPIN * T),
        ])  # fmt: skip
        vb = R.T @ v
        moments += jnp.array([truth.speed[0] * vb[1], truth.speed[1] * vb[0], 0.0])
        G, E, spin = truth.gyroscopic, truth.rate_force, jnp.sum(SPIN * s2)
        moments += spin * jnp.array([-G[0] * w[1], G[1] * w[0], 0.0])
        products = jnp.array([w[1] * w[2], w[0] * w[2], w[0] * w[1]])
        acceleration = moments + gust[:3] + ratios * products
        force = jnp.array([0.0, 0.0, truth.thrust * jnp.sum(T)]) - drag * vb + gust[3:]
        force += jnp.array([E[0] * w[1], -E[1] * w[0], 0.0])
        felt = force + jnp.cross(acceleration + spun / DT, imu) + jnp.cross(w, jnp.cross(w, imu))
        seen = w + jnp.asarray(truth.gyro_bias) + truth.gyro_noise * e[:3]
        gf, gyro = filtered(gf, seen, filters[0])
        felt = felt + jnp.asarray(truth.force_bias) + truth.force_noise * e[3:6]
        ff, accel = filtered(ff, felt, filters[1])
        # controller: tilt from an ideal attitude, rates from the gyroscope
        roll, pitch = jnp.arctan2(R[2, 1], R[2, 2]), -jnp.arcsin(jnp.clip(R[2, 0], -1, 1))
        M = jnp.asarray(truth.manoeuvres)
        tilts = 8 * (M[0] * wish[0] - roll), 8 * (M[1] * wish[1] - pitch)
        target = jnp.array([*tilts, M[2] * wish[2]])
        # a slow loop brings the vehicle back
        target += jnp.array([0.6 * vb[1], -0.6 * vb[0], 0.0])
        error = target - gyro
        integral = integral + DT * error
        demand = jnp.array([18.0, 18.0, 6.0]) * error + jnp.array([20.0, 20.0, 4.0]) * integral
        lift = hover**2 * (1 + M[3] * wish[3] - 0.15 * v[2]) / jnp.clip(R[2, 2], 0.5, 1)
        mix = (
            lift
            + y / ARM * demand[0] / (4 * B[0])
            - x / ARM * demand[1] / (4 * B[1])
            - SPIN * demand[2] / (4 * B[2])
        )
        new = jnp.sqrt(jnp.clip(mix, 0.01, 1.0))
        u = jnp.where(k % EVERY == 0, new, u)
        pipe = jnp.concatenate([pipe[1:], u[None]])
        slow = slow + DT / 2.0 * (jnp.sum(s2**2) - slow)
        w_next = w + DT * (1.5 * acceleration - 0.5 * dw) + spun
        turn = DT * _cross(w + 0.5 * DT * acceleration)
        R_next = R @ jax.scipy.linalg.expm(turn, max_squarings=1)
        v_next = v + DT * (R @ force - jnp.array([0, 0, GRAVITY]))
        scale = jnp.append(jnp.asarray(truth.gust_moment), jnp.full(3, truth.gust_force))
        gust = wind_keep * gust + jnp.sqrt(1 - wind_keep**2) * scale * e[6:]
        carry = (
            s_next, s2_next, w_next, R_next, v_next, gust, pipe, gf, ff, integral, u, slow, k + 1,
            acceleration,
        )  # fmt: skip
        return carry, (u, gyro, accel, ratio)

    start = jnp.full(n, hover)
    zeros = (jnp.zeros(3), jnp.zeros(3))
    level = jnp.array([0.0, 0.0, GRAVITY]) + jnp.asarray(truth.force_bias)
    b, a = filters[1]
    ff = ((1 - b[0]) * level, (b[2] - a[2]) * level)
    carry = (
        start, start, jnp.zeros(3), jnp.eye(3), jnp.zeros(3), jnp.zeros(6), jnp.tile(start, (lag + 1, 1)),
        zeros, ff, jnp.zeros(3), start, 4 * hover**2, 0, jnp.zeros(3),
    )  # fmt: skip
    return jax.lax.scan(step, carry, (pilot, noise))[1]


def _cross(w):
    return jnp.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0.0]])
