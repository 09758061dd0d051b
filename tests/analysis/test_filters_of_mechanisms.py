"""Filters on mechanisms: the simulator as process model, consistent over a hundred seeds."""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import stmuav_jax as stm
from stmuav_jax.analysis.sensors import moved_over
from stmuav_jax.math.compiler import quick_jit

sys.path.insert(0, str(Path(__file__).parents[1] / "analysis"))
from mechanisms import G, cart_pole, pendulum  # pyright: ignore[reportMissingImports]
from test_any_mechanism import four_bar, twin_rate  # pyright: ignore[reportMissingImports]

estimation, sensing = stm.estimation, stm.analysis

SEEDS, DT = 100, 0.02
# angle of the crank at which the four-bar is assembled; the encoder reads zero there [rad]
ASSEMBLED = 1.0
# angle [rad], rate [rad/s]: of the start, of a step's noise, and of the encoder
START, WANDER, ENCODER = np.array([0.1, 0.5]), np.array([0.0, 0.05]), 5e-3


@pytest.fixture(scope="module")
def bars():
    """A four-bar's model, seen by the encoder of its crank, and a posture at rest."""
    space = stm.TreeSpace(four_bar(), independent=["A.angle"])
    model = sensing.system_model(
        space,
        [sensing.Encoder("A")],
        Q=WANDER**2,
        R=[ENCODER**2],
        inputs=stm.inputs_of(space.system),
    )
    return space, model, space.from_state(space.system.reference)


def twin_step(z, torque, dt):
    """A step of the twin's own equation in its one coordinate."""
    rates = lambda z, u: jnp.stack([z[1], twin_rate(z[0], z[1], u[0])])
    return estimation.rk4(rates)(z, torque, dt)


@pytest.mark.slow
def test_a_filter_of_a_four_bar_is_that_of_its_twin(bars):
    """Mean and covariance after four readings, from the simulator and by hand: to 1e-9."""
    space, model, x = bars
    y = np.array([[0.03], [0.02], [0.05], [0.01]])
    torque = np.array([[2.0], [1.0], [0.0], [-1.0]])
    filtered = quick_jit(lambda m, p: estimation.kalman_filter(m, p, y, u=torque, dt=DT))
    found = filtered(model, estimation.gaussian(x, np.diag(START**2)))
    by_hand = estimation.StateSpaceModel(
        twin_step,
        np.diag(WANDER**2),
        estimation.Sensor(lambda z, u: z[:1] - ASSEMBLED, [[ENCODER**2]]),
    )
    exact = filtered(by_hand, estimation.gaussian([ASSEMBLED, 0.0], np.diag(START**2)))
    moved = jax.vmap(lambda mean: space.difference(mean, x))(found.mean)
    np.testing.assert_allclose(moved + jnp.array([ASSEMBLED, 0.0]), exact.mean, atol=1e-9)
    np.testing.assert_allclose(found.covariance, exact.covariance, rtol=1e-8, atol=1e-12)
    assert model.names == ("A.angle", "A.angle_rate")
    assert model.sensor.names == ("encoder A",)


# --- a pendulum whose centre of mass and inertia are states too, against its equation by hand


@pytest.mark.slow
def test_centre_of_mass_and_inertia_of_a_pendulum():
    """States beside the motion: the filter is that of (J + m c^2) a'' = torque - m g c sin(a)."""
    mass, true = 1.2, np.array([0.35, 0.03])
    # angle [rad], rate [rad/s], centre of mass [m], inertia [kg m^2]
    prior, noise, encoder = np.array([0.05, 0.2, 0.04, 0.01]), np.array([0, 1e-3, 0, 0]), 2e-3
    space = stm.TreeSpace(pendulum(mass))
    model = sensing.system_model(
        space, [sensing.Encoder("hinge")], Q=noise**2, R=[encoder**2],
        inputs=stm.inputs_of(space.system), parameters=("com", "inertia"),
        adapt=lambda space, own: space.with_system(pendulum(mass, own[0], own[1])),
    )  # fmt: skip

    def rate(z, u):
        angle, speed, com, inertia = z
        moment = u[0] - mass * G * com * jnp.sin(angle)
        none = jnp.zeros_like(angle)
        return jnp.stack([speed, moment / (inertia + mass * com**2), none, none])

    step = estimation.rk4(rate)
    torque = 1.5 * np.sin(0.45 * np.arange(60))[:, None]
    onwards = lambda z, u: (step(z, u, DT),) * 2
    begun = jnp.array([0.04, -0.1, *true])
    path = jax.jit(lambda z: jax.lax.scan(onwards, z, torque)[1])(begun)
    y = path[:, :1] + encoder * np.random.default_rng(5).standard_normal((len(torque), 1))

    filtered = quick_jit(lambda m, p: estimation.kalman_filter(m, p, y, u=torque, dt=DT))
    guess, x = np.array([0.3, 0.02]), space.from_state(space.system.reference)
    start = {"motion": x, "parameters": jnp.asarray(guess)}
    found = filtered(model, estimation.gaussian(start, np.diag(prior**2)))
    hand = estimation.StateSpaceModel(
        step, np.diag(noise**2), estimation.Sensor(lambda z, u: z[:1], [[encoder**2]])
    )
    exact = filtered(hand, estimation.gaussian(np.array([0, 0, *guess]), np.diag(prior**2)))
    moved = jax.vmap(lambda mean: space.difference(mean["motion"], x))(found.mean)
    np.testing.assert_allclose(moved, exact.mean[:, :2], atol=1e-9)
    own = found.mean["parameters"]
    np.testing.assert_allclose(own, exact.mean[:, 2:], atol=1e-9)
    np.testing.assert_allclose(found.covariance, exact.covariance, rtol=1e-7, atol=1e-12)
    # both are found: within three of their deviations, which are less than half of those at the start
    deviation = np.sqrt(np.diagonal(found.covariance[-1]))[2:]
    assert np.all(np.abs(own[-1] - true) < 3 * deviation)
    assert np.all(deviation < prior[2:] / 2)
    assert model.names == ("hinge.angle", "hinge.angle_rate", "com", "inertia")


# --- the UAV with its tracker: gyroscope, accelerometer, encoders of both sliders

# deviations of the start, of a step's noise: r, attitude, panel angles, v, omega, their rates, mass
ORDER = (3, 3, 2, 3, 3, 2, 1)
UAV_START = np.repeat([0.1, 0.005, 0.02, 0.1, 0.05, 0.05, 0.1], ORDER)
UAV_WANDER = np.repeat([0.0, 0.0, 0.0, 0.01, 0.02, 0.02, 0.0], ORDER)
# gyroscope [rad/s], accelerometer [m/s^2], encoders [m]
UAV_NOISE = np.repeat([0.01, 0.05, 5e-4], (3, 3, 2))
UAV_STEPS, UAV_DT = 10, 0.02


def balance(space, x, inputs):
    """Inputs of least norm at which a posture has no accelerations: they are linear in them."""
    scale = jnp.repeat(jnp.array([1e5, 1.0]), np.array([6, 2]))
    under = lambda w: space.rates(x, 0.0, inputs.applied(space.system, scale * w))[8:]
    found = quick_jit(jax.vmap(under))(jnp.concatenate([jnp.zeros((1, 8)), jnp.eye(8)]))
    return scale * np.linalg.lstsq((found[1:] - found[0]).T, -found[0], rcond=1e-9)[0]


@pytest.fixture(scope="module")
def uav():
    """The model, with one step and with four in each, a prior, and inputs that shake it (T, 8)."""
    uav = stm.uav.make_uav()
    system, inputs = uav.system, uav.inputs
    panel, base = system.index("panel_7"), "hexacopter_1"
    mass = system.bodies.mass

    def adapt(space, numbers):
        own = mass.at[panel].set(mass[panel] * numbers[0])
        return space.with_system(eqx.tree_at(lambda s: s.bodies.mass, space.system, own))

    model, fine = (
        sensing.system_model(
            uav.space,
            [
                sensing.Gyroscope(base),
                sensing.Accelerometer(base),
                sensing.Encoder("T12"),
                sensing.Encoder("T13"),
            ],
            Q=UAV_WANDER**2,
            R=UAV_NOISE**2,
            inputs=inputs,
            parameters=["mass of the panel over its own"],
            adapt=adapt,
            substeps=substeps,
        )
        for substeps in (1, 4)
    )
    x = uav.space.from_state(system.reference)
    prior = estimation.gaussian({"motion": x, "parameters": jnp.ones(1)}, np.diag(UAV_START**2))
    wave = np.sin(np.arange(UAV_STEPS)[:, None] * np.linspace(0.5, 2.0, 8))
    shake = np.repeat([2e4, 1.0], [6, 2])
    return model, fine, prior, jnp.asarray(balance(uav.space, x, inputs) + shake * wave)


def motions(fine, prior, start, wander, u, dt, seeds=SEEDS):
    """Motions of the simulator from random starts, with noise, and what its sensors read there.

    Args:
        fine: model of the truth. start, wander: deviations of the start, of a step's noise (n,).
    """
    rng = np.random.default_rng(7)
    drawn = lambda sizes, *count: jnp.asarray(
        sizes[:, None] * rng.standard_normal((*count, len(sizes), seeds))
    )
    first = fine.space.retract(jax.tree.map(lambda a: a[:, None], prior.mean), drawn(start))

    def onwards(x, now):
        u, w = now
        x = fine.space.retract(fine(x, u, dt), w)
        return x, (x, fine.sensor(x, u))

    fly = quick_jit(lambda start, u, w: jax.lax.scan(onwards, start, (u, w))[1])
    truth, seen = fly(first, u, drawn(wander, len(u)))
    noise = np.sqrt(np.diagonal(fine.sensor.noise @ fine.sensor.noise.T))
    return truth, jax.vmap(fine.sensor.space.retract)(seen, drawn(noise, len(u)))


def consistent(model, fine, prior, start, wander, u, dt, parts, level=0.95, seeds=SEEDS):
    """The filter's record, whose NEES of all parts is within its 95 % interval, and NIS at a level."""
    truth, y = motions(fine, prior, start, wander, u, dt, seeds)
    out = estimation.filter_bank(model, prior, y, u=u, dt=dt)
    assert bool(out.ok.all())
    last = jax.tree.map(lambda a: a[-1], (out.mean, out.factor, truth))
    for part, only in parts.items():
        found = float(jnp.mean(estimation.nees(*last, model.space, only=only)))
        low, high = estimation.mean_interval(only.stop - only.start, seeds, 0.95)
        assert low < found < high, f"{part}: {low:.3f} < {found:.3f} < {high:.3f}"
    low, high = estimation.mean_interval(model.sensor.space.size, seeds * len(u), level)
    assert low < np.asarray(out.nis).mean() < high
    return out


@pytest.mark.slow
def test_the_uav_from_its_own_sensors_over_a_hundred_seeds(uav):
    """NEES of attitude, panel angles and the panel's mass within its 95 % interval.

    The truth is the simulator's, with noise and with steps four times finer than the filter's.
    """
    model, fine, prior, u = uav
    parts = {
        "all": slice(0, 17),
        "attitude": slice(3, 6),
        "angles": slice(6, 8),
        "mass": slice(16, 17),
    }
    out = consistent(model, fine, prior, UAV_START, UAV_WANDER, u, UAV_DT, parts)
    # What was not known at the start is known now, but for the attitude: in free flight no sensor on
    # board feels where down is. The gyroscope keeps it from growing with the body rates' errors.
    deviation = np.asarray(jnp.mean(out.standard_deviation[-1], axis=-1))
    assert np.all(deviation[6:8] < 0.5 * UAV_START[6:8])
    assert deviation[16] < 0.25 * UAV_START[16]
    assert np.all(deviation[3:6] < 1.2 * UAV_START[3:6])
    assert np.all(UAV_STEPS * UAV_DT * UAV_START[11:14] > 1.5 * UAV_START[3:6])


# --- the hexacopter


@pytest.mark.slow
def test_a_hexacopter_over_many_seeds():
    """Gyroscope, and fixes of position and attitude: readings of ten numbers with errors of nine.

    NEES within its 95 % interval; NIS within 99.9 %, as it is looked at for each mechanism.
    """
    space = stm.TreeSpace(stm.make_scene("hexacopter").system)
    name = space.system.names[0]
    sensors = [sensing.Gyroscope(name), sensing.PositionFix(name), sensing.AttitudeFix(name)]
    start, wander = np.repeat([0.1, 0.05, 0.2, 0.2], 3), np.repeat([0.0, 0.0, 0.02, 0.02], 3)
    x = space.from_state(space.system.reference)
    held = stm.analysis.trim_condition(space, stm.analysis.hover(), at=x).values
    shake = 0.05 * np.sin(np.arange(10.0)[:, None] * np.linspace(0.5, 2.0, 6))
    noise, u, seeds = np.repeat([0.01, 0.05, 0.02], 3), held * (1 + shake), 40
    inputs = stm.inputs_of(space.system)
    model, fine = (
        sensing.system_model(
            space, sensors, Q=wander**2, R=noise**2, inputs=inputs, substeps=substeps
        )
        for substeps in (1, 4)
    )
    prior = estimation.gaussian(x, np.diag(start**2))
    parts = {"all": slice(0, space.size)}
    out = consistent(model, fine, prior, start, wander, jnp.asarray(u), 0.02, parts, 0.999, seeds)
    # what is known at the end is more than what was known at the start
    after = np.sum(np.log(np.asarray(jnp.mean(out.standard_deviation[-1], axis=-1)) / start))
    assert after < -1.0


def test_a_step_of_the_cart_pole_is_that_of_its_equations():
    """The process model against the cart-pole's two equations, by SciPy to round-off."""
    space = stm.TreeSpace(cart_pole())
    M, m, length, J = 2.0, 0.5, 0.8, 0.02
    first, push = np.array([0.1, 0.4, -0.3, 0.8]), 5.0

    def rate(_, z):
        c, s, turn = np.cos(z[1]), np.sin(z[1]), z[3]
        mass = [[M + m, m * length * c], [m * length * c, J + m * length**2]]
        pull = [push + m * length * s * turn**2, m * 9.81 * length * s]
        return np.concatenate([z[2:], np.linalg.solve(mass, pull)])

    exact = solve_ivp(rate, (0, 0.02), first, method="DOP853", rtol=3e-14, atol=1e-16).y[:, -1]
    x = space.from_state(space.system.reference)
    system = stm.inputs_of(space.system).applied(space.system, jnp.array([push]))
    start = space.retract(x, jnp.asarray(first))
    end = jax.jit(lambda x: moved_over(space, x, 0.02, system, 8))(start)
    np.testing.assert_allclose(space.difference(end, x), exact, atol=1e-12)
