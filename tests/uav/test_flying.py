"""Geometric control of a plain hexacopter: decay of its errors, feedforward, limits of its rotors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit

control = stm.control

LIMITS = stm.uav.RotorLimits(200.0, 1900.0)
START = stm.uav.BaseStart(x=0.3, y=-0.2, z=0.1, roll=0.9, pitch=-0.6, yaw=1.0, p=1.0, q=2.0)


def rotation(p):
    """Rotation matrices of Euler parameters (k, 4)."""
    return np.asarray(jax.vmap(stm.rotation.rotation_matrix)(jnp.asarray(p)))


@pytest.fixture(scope="module")
def tumbling():
    """A hexacopter thrown in a steep attitude, that flies to a point within its rotors' limits."""
    scene = stm.make_scene("hexacopter", start=START)
    plant = control.Plant(scene)
    pilot = stm.uav.FlightController(plant.system, plant.rate, limits=LIMITS)
    goal = control.at_point([0.5, 0.0, 1.0], heading=0.3)
    return control.close_loop(plant, pilot, 5.0, reference=goal, memory=pilot.start())


def test_a_hexacopter_comes_to_rest_where_it_is_sent(tumbling):
    """From 60 degrees of tilt, within the limits; at rest to a tenth of a millimetre after 5 s."""
    base, squared = tumbling.body("hexacopter"), tumbling.input("speed_squared")
    np.testing.assert_allclose(base.r[-1], [0.5, 0.0, 1.0], atol=1e-4)
    np.testing.assert_allclose(
        rotation(base.p[-1:])[0, :2, 0], [np.cos(0.3), np.sin(0.3)], atol=1e-4
    )
    assert np.all(squared > 200.0**2 * (1 - 1e-12))
    assert np.all(squared < 1900.0**2 * (1 + 1e-12))
    # the limits were met on the way
    assert np.any(np.isclose(squared, 200.0**2) | np.isclose(squared, 1900.0**2))
    assert tumbling.certificate.relative_energy_error < 1e-6


def test_the_attitude_error_decays_as_lee_proves():
    """dV/dt = -k_W |e_W|^2 for V = |e_W|^2 / 2 + k_R tr(I - R_d^T R) / 2, from 70 degrees."""
    start = stm.uav.BaseStart(roll=1.2, p=0.5, q=-1.0)
    plant = control.Plant(stm.make_scene("hexacopter", start=start), rate=2000.0)
    # so small gains of the position that the wanted attitude stays level
    gains = stm.uav.FlightGains(1e-12, 1e-12)
    pilot = stm.uav.FlightController(plant.system, plant.rate, gains=gains)
    found = quick_jit(
        lambda p, c: control.rollout(p, c, 801, reference=control.at_point(np.zeros(3)), memory=c.start())
    )(plant, pilot)  # fmt: skip
    R, omega = rotation(found.states.p[:, 0]), np.asarray(found.states.omega[:, 0])
    k_R, k_W = 200.0, 25.0
    size = np.sum(omega**2, axis=1)
    V = size / 2 + k_R * (3 - np.trace(R, axis1=1, axis2=2)) / 2
    # the last digits aside, V falls at every sample
    assert np.all(np.diff(V) < 1e-9)
    lost = k_W * np.sum((size[1:] + size[:-1]) / 2) / plant.rate
    assert V[0] - V[-1] == pytest.approx(lost, rel=0.01)
    assert V[-1] < 1e-2 * V[0]


@pytest.mark.slow
def test_feedforward_leaves_an_error_of_the_sampling_alone():
    """On a curve, the error is proportional to the period of control: it vanishes with it."""
    path = control.follow_path(
        lambda t: jnp.stack([jnp.cos(2 * t) - 1, jnp.sin(2 * t), 0.3 * t]), lambda t: 0.5 * t
    )
    worst = []
    for rate in (200.0, 400.0):
        plant = control.Plant(stm.make_scene("hexacopter"), rate=rate)
        pilot = stm.uav.FlightController(plant.system, rate)
        count = int(12 * rate)
        found = quick_jit(
            lambda p, c, n=count: control.rollout(p, c, n, reference=path, memory=c.start())
        )(plant, pilot)
        off = found.states.r[:, 0] - jax.vmap(lambda t: path(t).r)(found.ts)
        worst.append(float(jnp.max(jnp.linalg.norm(off[-count // 4 :], axis=1))))
    assert worst[0] < 0.03
    assert worst[1] / worst[0] == pytest.approx(0.5, abs=0.1)


def test_speeds_within_limits_keep_what_matters_most():
    """Against linear programmes: most of the tilting moment, then of thrust, then of yaw."""
    plant = control.Plant(stm.make_scene("hexacopter"))
    pilot = stm.uav.FlightController(plant.system, 400.0, limits=LIMITS)
    lower, upper = LIMITS.squared(6)
    B, inverse = np.asarray(pilot.wrenches), np.asarray(pilot.inverse)
    rng = np.random.default_rng(4)
    found = quick_jit(lambda w: stm.uav.within_limits(pilot.inverse, w, lower, upper))
    held = 0
    for scale in [0.3, 1.0, 3.0, 10.0] * 6:
        wrench = np.array([55.0, 0.0, 0.0, 0.0]) + scale * rng.normal(size=4) * [5, 4, 4, 0.5]
        u, given = found(jnp.asarray(wrench))
        assert np.all((u > lower * (1 - 1e-9)) & (u < upper * (1 + 1e-9)))
        assert bool(given) == bool(np.allclose(B @ u, wrench, rtol=1e-9, atol=1e-9))
        held += not given
        # the largest a with T lift + a tilt within the limits
        lift, tilt = inverse[:, 0], inverse[:, 1:3] @ wrench[1:3]
        rows = np.stack([lift, tilt], axis=1)
        best = scipy.optimize.linprog(
            [0.0, -1.0], np.vstack([rows, -rows]), np.concatenate([upper, -np.asarray(lower)]),
            bounds=[(None, None), (0.0, 1.0)],
        )  # fmt: skip
        np.testing.assert_allclose((B @ u)[1:3], best.x[1] * wrench[1:3], rtol=1e-6, atol=1e-8)
    assert 3 < held < 24


def test_machines_that_the_controller_cannot_fly_are_refused():
    scene = stm.make_scene("hexacopter")
    weak = stm.uav.RotorLimits(10.0, 100.0)
    with pytest.raises(stm.ModelError, match="cannot carry the weight"):
        stm.uav.FlightController(scene.system, 400.0, limits=weak)
    # motors of 200 to 1900 rad/s
    driven = stm.make_scene("hexacopter", motor=stm.uav.Motor()).system
    for limits in ((200.0, 2500.0), (100.0, 1900.0)):
        with pytest.raises(stm.ModelError, match="within those of the motors, 200 to 1900 rad/s"):
            stm.uav.FlightController(driven, 400.0, limits=stm.uav.RotorLimits(*limits))
    within = stm.uav.RotorLimits(300.0, 1800.0)
    assert stm.uav.FlightController(driven, 400.0, limits=within).limits == within
    tracker = stm.make_scene("tracker", 1)
    with pytest.raises(
        stm.ModelError, match="A flight controller needs one set of rotors, but the system has 0"
    ):
        stm.uav.FlightController(tracker.system, 400.0)
    with pytest.raises(stm.ModelError, match=r"position gain .* must be positive"):
        stm.uav.FlightGains(position=-1.0)
    with pytest.raises(stm.ModelError, match="position of a waypoint"):
        control.at_point([0.0, 1.0])


@pytest.mark.slow
def test_the_integral_stands_still_on_the_ground():
    """A foot at the ground's height counts by the attitude; without a gear nothing does."""
    tilted = [np.cos(0.1), np.sin(0.1), 0.0, 0.0]
    for gear, height, p, moves in (
        (stm.uav.Gear(), 0.001, [1.0, 0.0, 0.0, 0.0], True),
        (stm.uav.Gear(), -0.001, [1.0, 0.0, 0.0, 0.0], False),
        (stm.uav.Gear(), 0.001, tilted, False),
        (None, -0.001, [1.0, 0.0, 0.0, 0.0], True),
    ):
        system = stm.make_scene("hexacopter", gear=gear).system
        pilot = stm.uav.FlightController(system, 400.0, limits=LIMITS)
        state = stm.State(
            jnp.array([[0.1, 0.0, height]]), jnp.array([p]), jnp.zeros((1, 3)), jnp.zeros((1, 3))
        )
        _, memory = pilot(state, control.at_point([0.0, 0.0, -0.2]), pilot.start())
        wanted = [0.1 / 400, 0.0, (height + 0.2) / 400] if moves else np.zeros(3)
        np.testing.assert_allclose(memory.integral, wanted, rtol=1e-12)


def test_every_slew_begins_and_ends_at_rest():
    """By hand: the polynomials and their derivatives, of two values with three coefficients."""
    c = [0.05, -0.3, 0.1]
    slew = control.Slew([0.1, -0.3], [0.5, 0.4], 0.8, c, at=0.2)
    way, z = np.array([0.4, 0.7]), np.polynomial.Polynomial([-1.0, 2.0])
    s = np.polynomial.Polynomial([0.0, 1.0])
    rise = s**3 * (10 - 15 * s + 6 * s**2) + 64 * s**3 * (1 - s) ** 3 * (
        c[0] + c[1] * z + c[2] * z**2
    )
    for t in (0.0, 0.2, 0.3, 0.6, 0.95, 1.0, 1.4):
        x, inside = np.clip((t - 0.2) / 0.8, 0.0, 1.0), 0.2 < t < 1.0
        found = slew(jnp.asarray(t))
        np.testing.assert_allclose(found[0], [0.1, -0.3] + way * rise(x), atol=1e-13)
        np.testing.assert_allclose(found[1], inside * way * rise.deriv()(x) / 0.8, atol=1e-12)
        np.testing.assert_allclose(found[2], inside * way * rise.deriv(2)(x) / 0.64, atol=1e-11)
    for k in (0, 1, 2):
        at_ends = rise.deriv(k) if k else rise
        np.testing.assert_allclose(at_ends(np.array([0.0, 1.0])), [0.0, float(k == 0)], atol=1e-12)
    with pytest.raises(stm.ModelError, match="duration of a slew must be positive"):
        control.Slew([0.0], [1.0], 0.0)
    with pytest.raises(stm.ModelError, match="goal of a slew"):
        control.Slew([0.0], [1.0, 2.0], 1.0)


@pytest.fixture(scope="module")
def hexacopter():
    """A hexacopter's scene aslant, its controller, and the cost of a second's flight."""
    start = stm.uav.BaseStart(x=0.3, y=-0.2, roll=0.4, pitch=-0.2, p=0.5)
    scene = stm.make_scene("hexacopter", start=start)
    pilot = stm.uav.FlightController(scene.system, 400.0)

    def cost(gains, mass):
        system = eqx.tree_at(lambda s: s.bodies.mass, scene.system, jnp.reshape(mass, (1,)))
        plant = control.Plant(system, scene.state0)
        own = eqx.tree_at(lambda p: p.gains, pilot, gains)
        found = control.rollout(
            plant, own, 201, reference=control.at_point([0.0, 0.0, 0.2]), memory=own.start()
        )
        off = found.states.r[:, 0] - jnp.array([0.0, 0.0, 0.2])
        return jnp.mean(jnp.sum(off**2, axis=1)) + 1e-3 * jnp.mean(found.states.omega[:, 0] ** 2)

    return cost, stm.uav.FlightGains(integral=0.5), float(scene.system.bodies.mass[0])


@pytest.mark.slow
def test_gradients_of_a_hexacopters_loop(hexacopter):
    """Along a direction of all five gains and the mass, through 0.5 s at 400 Hz: 1e-5 of differences."""
    cost, gains, mass = hexacopter
    at = quick_jit(cost)
    by_gains, by_mass = quick_jit(jax.grad(cost, argnums=(0, 1)))(gains, jnp.asarray(mass))

    def difference(f, h):
        return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    names = ("position", "velocity", "integral", "attitude", "rate")
    of = lambda gains: [getattr(gains, name) for name in names]
    shares = np.array([1.0, -0.7, 0.4, 0.9, -0.5])
    moved = lambda h: float(
        at(eqx.tree_at(of, gains, [jnp.asarray(x * (1 + h * s)) for x, s in zip(of(gains), shares, strict=True)]),
           jnp.asarray(mass * (1 + 0.6 * h)))
    )  # fmt: skip
    wide, narrow = difference(moved, 2e-3), difference(moved, 1e-3)
    # the differences have converged
    assert wide == pytest.approx(narrow, rel=1e-6)
    slope = sum(s * float(x * g) for s, x, g in zip(shares, of(gains), of(by_gains), strict=True))
    assert slope + 0.6 * mass * float(by_mass) == pytest.approx(narrow, rel=1e-5)
