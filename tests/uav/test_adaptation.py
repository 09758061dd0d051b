"""A hexacopter with a fixed load that it does not know: consistency of the filter, and what it is for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.analysis import mass_moments
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.uav.adaptation import find_carrier_motion

control, sensing = stm.control, stm.analysis
Instrument = control.Instrument

RATE, NAME = 400.0, "hexacopter"
# densities of the unknown moment [N m/sqrt(Hz)] and force [N/sqrt(Hz)], as the filter has them by default
TORQUE, THRUST = 0.02, 0.3
# standard deviation of the payload's first moment [kg m]
MOMENT = 0.02
FLIGHTS, SAMPLES = 48, 1201


def machine(mass, place):
    """The hexacopter with a small body welded to it, and with unknown moments and forces as inputs."""
    empty = stm.make_scene(NAME).system
    base = stm.Body(
        NAME, stm.PART_II.value("bare.mass"), stm.PART_II.value("bare.inertia"), free=True
    )
    load = stm.Body("load", mass, 1e-6 * jnp.ones(3), position=place)
    unknown = (
        stm.AppliedMoment(NAME, jnp.zeros(3), frame="body"),
        stm.AppliedForce(NAME, jnp.zeros(3), frame="body"),
    )
    weld = stm.weld("fixing", NAME, "load")
    return stm.System([base, load], [weld], (*empty.forces, *unknown))


def instruments():
    return [
        Instrument(sensing.Gyroscope(NAME), noise=1.75e-3),
        Instrument(sensing.Accelerometer(NAME), noise=0.02),
        Instrument(sensing.PositionFix(NAME), rate=50.0, noise=0.01, delay=0.02),
        Instrument(sensing.AttitudeFix(NAME), rate=100.0, noise=0.01, delay=0.01),
    ]


@pytest.fixture(scope="module")
def flights():
    """Hovers of 3 s: 48 with loads that are drawn, and one with a load of 1 mg."""
    scene = stm.make_scene(NAME)
    estimator = stm.uav.MotionEstimator(scene.system, RATE, instruments())
    # the loads do not change
    payload = stm.uav.PayloadFilter(scene.system, RATE, mass_drift=0.0, moment_drift=0.0)
    pilot = stm.uav.AdaptiveController(stm.uav.FlightController(scene.system, RATE), payload)
    # the biases are known, so that the errors of the motion's estimate are small
    memory = estimator.start(
        scene.state0, attitude=2e-3, position=2e-3, velocity=2e-3, gyroscope_bias=1e-6,
        accelerometer_bias=1e-6,
    )  # fmt: skip
    deviations = jnp.repeat(jnp.array([TORQUE, THRUST]), 3) * jnp.sqrt(RATE)
    deviations = deviations.at[3:5].set(0.0)

    def disturbed(estimate, reference, memory):
        key, own = memory
        inputs, own = pilot(estimate, reference, own)
        key, now = jax.random.split(key)
        drawn = deviations * jax.random.normal(now, (6,))
        return jnp.concatenate([inputs, drawn]), (key, own)

    def flown(seed, mass):
        keys = jax.random.split(jax.random.key(seed), 3)
        place = MOMENT / (mass + 0.01) * jax.random.normal(keys[0], (3,))
        plant = control.Plant(
            machine(mass, place), inputs=["speed_squared", "moment", "force"], rate=RATE,
            sensors=instruments(), estimator=estimator, memory=memory,
        )  # fmt: skip
        found = control.rollout(
            plant, disturbed, SAMPLES, reference=control.at_point(jnp.zeros(3)),
            memory=(keys[1], pilot.start()), start=plant.reset(keys[2]),
            signals={"own": lambda s: s.memory[1]},
        )  # fmt: skip
        own = found.signals["own"]
        truth = jnp.concatenate([mass[None], mass * place])
        height = found.states.r[:, 0, 2]
        return own.payload.mean[:, 3:], own.payload.covariance[:, 3:, 3:], truth, own.centre, height

    masses = jnp.append(jnp.linspace(0.3, 0.6, FLIGHTS), 1e-6)
    both = quick_jit(jax.vmap(flown))(jnp.arange(FLIGHTS + 1), masses)
    return jax.tree.map(np.asarray, both)


@pytest.mark.slow
@pytest.mark.parametrize("at", [400, 800, 1200])
def test_the_payload_is_as_good_as_the_filter_says(flights, at):
    """NEES of mass and moment over 48 flights, within its 95 % interval."""
    mean, P, truth, *_ = (x[:FLIGHTS] for x in flights)
    error, P = mean[:, at, :4] - truth, P[:, at, :4, :4]
    nees = np.einsum("si,si->s", error, np.linalg.solve(P, error[..., None])[..., 0])
    low, high = stm.estimation.mean_interval(4, FLIGHTS, 0.95)
    assert low < np.mean(nees) < high


@pytest.mark.slow
def test_the_machine_flies_by_what_is_found(flights):
    """Mass within 0.1 kg, centre of mass within 3 mm across the thrust, and the height comes back."""
    mean, _, truth, centre, height = (x[:FLIGHTS] for x in flights)
    total = stm.PART_II.value("bare.mass") + truth[:, :1]
    assert np.max(np.abs(mean[:, -1, 0] - truth[:, 0])) < 0.1
    assert np.max(np.abs(centre[:, -1, :2] - truth[:, 1:3] / total)) < 3e-3
    # with 0.3 kg that it does not know the machine sinks by 9.81 / 9 * 0.3 / 5.7 m
    assert np.max(np.abs(height[:, -1])) < 0.03


@pytest.mark.slow
def test_a_machine_without_payload_is_left_alone(flights):
    """Mass and moment stay within four deviations of zero all the time, and those shrink.

    One number of 16,000 is further off, and over all samples some forty are independent.
    """
    mean, P = flights[0][-1], flights[1][-1]
    spread = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert np.max(np.abs(mean[:, :4]) / spread[:, :4]) < 4
    assert np.all(spread[-1, :3] < np.array([0.3, 0.02, 0.02]) / 3)


def test_the_inertia_is_seen_only_where_the_machine_turns():
    """Deviations by the equations alone: as before a hover, and less after turning back and forth.

    Ten estimates of NaN are left out, and do not last.
    """
    found = stm.uav.PayloadFilter(stm.make_scene(NAME).system, RATE)
    state = found.system.reference
    about, on = mass_moments(found.system, state), find_carrier_motion(state)
    felt = jnp.array([0.0, 0.0, 9.81])

    def spread(size):
        def one(memory, k):
            omega = size * jnp.sin(6.0 * k / RATE + jnp.array([0.0, 1.0, 2.0]))
            still = stm.State(state.r, state.p, state.v, omega[None])
            lost = jnp.where((k >= 300) & (k < 310), jnp.nan, 0.0)
            seen = stm.uav.MotionEstimate(still, None, None, 0.0, 0.0, felt + lost)  # pyright: ignore[reportArgumentType]
            return found.updated(seen, about, on, memory), None

        end, _ = jax.lax.scan(one, found.start(), jnp.arange(800))
        return found.deviation(end).inertia

    still, turning = quick_jit(jax.vmap(spread))(jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(still, 0.1, rtol=1e-9)
    assert np.all(turning < 0.06)


def test_what_the_filter_cannot_do_is_refused():
    scene = stm.make_scene(NAME)
    pilot = stm.uav.FlightController(scene.system, RATE)
    adaptive = stm.uav.AdaptiveController(pilot, stm.uav.PayloadFilter(scene.system, RATE))
    reference = control.at_point(jnp.zeros(3))
    with pytest.raises(stm.SettingError, match="estimated from a MotionEstimate"):
        adaptive(scene.state0, reference, adaptive.start())
    with pytest.raises(stm.ModelError, match=r"torque .* must not be negative"):
        stm.uav.PayloadFilter(scene.system, RATE, torque=-1.0)
    with pytest.raises(stm.ModelError, match="one set of rotors"):
        stm.uav.PayloadFilter(stm.make_scene("tracker", 1).system, RATE)
    with pytest.raises(stm.SettingError, match="delay of the inputs"):
        stm.uav.PayloadFilter(scene.system, RATE, delay=0.001)
    uav = stm.make_scene("uav_tracker").system
    geometry, shift = stm.uav.tracker_geometry(stm.PART_II), stm.PART_II.value("mount.shift")
    servo = stm.uav.PanelServo(stm.uav.panel_bodies(uav, geometry, shift))
    plain = stm.uav.UavController(uav, stm.uav.FlightController(uav, RATE), servo, False)
    with pytest.raises(stm.SettingError, match="with its feedforward"):
        stm.uav.AdaptiveController(plain, stm.uav.PayloadFilter(uav, RATE))
