"""Dryden gusts: exact covariances, spectrum by Welch, reproducible paths, smooth in time."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central
from scipy.signal import welch

from stmuav_jax import Body, ModelError, SimulationError, System, simulate
from stmuav_jax.dynamics.simulation import Scene
from stmuav_jax.uav import AirframeDrag
from stmuav_jax.uav.environment.wind import (
    OUTPUT,
    Turbulence,
    dryden,
    low_altitude,
    shaping_matrices,
)

AIR = Turbulence(jnp.array([40.0, 30.0, 10.0]), jnp.array([1.5, 1.2, 0.8]))
V, DT = 8.0, 0.02
TIMES = np.asarray(AIR.lengths) / V


def density(omega):
    """One-sided spectra |H(j omega)|^2 per rad/s (k, 3), from the transfer functions."""
    s = 1j * np.asarray(omega)[:, None]
    T, sigma = TIMES, np.asarray(AIR.intensities)
    along = sigma * np.sqrt(2 * T / np.pi) / (1 + T * s)
    across = sigma * np.sqrt(T / np.pi) * (1 + np.sqrt(3) * T * s) / (1 + T * s) ** 2
    return np.abs(np.where(np.arange(3) == 0, along, across)) ** 2


def test_low_altitude_numbers():
    """At 100 ft and 20 knots: L_u = 491.2 ft, sigma_w = 2 knots, sigma_u = 3.42 knots."""
    knot = 0.514444
    found = low_altitude(30.48, 20 * knot)
    spread = 0.177 + 0.0823
    np.testing.assert_allclose(
        np.asarray(found.lengths) / 0.3048, [100 / spread**1.2, 100 / spread**1.2, 100]
    )
    np.testing.assert_allclose(
        np.asarray(found.intensities) / knot, [2 / spread**0.4, 2 / spread**0.4, 2]
    )
    # the formulas meet the medium-altitude model at 1000 ft: L = 1000 ft, equal intensities
    top = low_altitude(304.8, 20 * knot)
    np.testing.assert_allclose(np.asarray(top.lengths) / 0.3048, 1000)
    np.testing.assert_allclose(np.asarray(top.intensities) / knot, 2)


@pytest.mark.parametrize("r", [1e-4, 0.02, 0.3, 1.0])
def test_discretisation_keeps_covariances_at_any_step(r):
    """R_u = exp(-x), R_v = exp(-x) (1 - x / 2), x = tau / T: those of the spectra."""
    step, spread = (np.asarray(x) for x in shaping_matrices(jnp.asarray(r)))
    stationary = np.array([[0.5, 0.25], [0.25, 0.25]])
    kept = step @ stationary @ step.T + spread @ spread.T
    np.testing.assert_allclose(kept, stationary, rtol=0, atol=1e-15)
    covariance, lag = stationary, 0.0
    for _ in range(4):
        found = np.einsum("ai,ij,aj->a", OUTPUT, covariance, OUTPUT)
        expected = np.exp(-lag) * np.array([1.0, 1 - lag / 2, 1 - lag / 2])
        np.testing.assert_allclose(found, expected, atol=1e-14)
        covariance, lag = step @ covariance, lag + r


@pytest.fixture(scope="module")
def long_path():
    """4000 s: 800 to 3200 correlation times."""
    return np.asarray(dryden(3, AIR, airspeed=V, duration=4000.0, dt=DT).values)


def test_sampled_variances(long_path):
    """Within 5 standard errors, for some T / (4000 s) independent samples."""
    variance = long_path.var(axis=0)
    error = np.sqrt(2 * 2 * TIMES / 4000.0)
    assert np.all(np.abs(variance / np.asarray(AIR.intensities) ** 2 - 1) < 5 * error)
    across = np.corrcoef(long_path.T)[np.triu_indices(3, 1)]
    assert np.max(np.abs(across)) < 5 * np.sqrt(2 * TIMES.max() / 4000.0)


def test_spectrum_is_that_of_the_transfer_functions(long_path):
    """Welch's estimate in bands of a third of a decade, folding at the sampling rate included."""
    frequency, found = welch(long_path, 1 / DT, nperseg=8192, axis=0)
    folds = np.arange(-200, 201) / DT
    each = [density(2 * np.pi * np.abs(frequency + fold)) for fold in folds]
    expected = 2 * np.pi * np.sum(each, axis=0)
    edges = np.geomspace(0.02, 24.0, 10)
    for low, high in pairwise(edges):
        band = (frequency >= low) & (frequency < high)
        segments = 2 * 4000.0 / DT / 8192 * 0.7
        error = 1 / np.sqrt(segments * band.sum())
        ratio = np.mean(found[band] / expected[band], axis=0)
        assert np.all(np.abs(ratio - 1) < 5 * error + 0.01)


def test_paths_repeat_and_longer_ones_begin_alike():
    short, again, long = (
        dryden(seed, AIR, airspeed=V, duration=d, dt=DT)
        for seed, d in ((5, 2.0), (5, 2.0), (5, 6.0))
    )
    np.testing.assert_array_equal(short.values, again.values)
    np.testing.assert_array_equal(short.values, long.values[: short.values.shape[0]])
    other = dryden(6, AIR, airspeed=V, duration=2.0, dt=DT)
    assert np.max(np.abs(np.asarray(other.values - short.values))) > 0.1


@pytest.mark.slow
def test_smooth_in_time_and_exact_at_samples():
    gusts = dryden(1, AIR, airspeed=V, duration=1.0, dt=DT, mean=[0.0, 5.0, 0.0])
    times = DT * np.arange(51)
    at = jax.vmap(gusts)(jnp.asarray(times))
    # along y, across -x, up z
    turned = np.asarray(gusts.values) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(at, turned + np.array([0, 5, 0]), atol=1e-12)
    slope = jax.jit(jax.jacfwd(gusts))
    for k in (1, 17, 49):
        before, after = slope(times[k] - 1e-9), slope(times[k] + 1e-9)
        np.testing.assert_allclose(before, after, atol=1e-4)
        np.testing.assert_allclose(
            after, central(lambda h, k=k: gusts(jnp.asarray(times[k] + h)), 1e-7), atol=1e-3
        )
    assert np.all(np.isnan(gusts(jnp.asarray(-0.001))))
    assert np.all(np.isnan(gusts(jnp.asarray(1.001))))


def test_derivatives_by_airspeed_and_intensity():
    @jax.jit
    def value(v, scale):
        air = Turbulence(AIR.lengths, scale * AIR.intensities)
        return dryden(2, air, airspeed=v, duration=1.0, dt=DT)(jnp.asarray(0.713))

    by_speed, by_scale = jax.jacfwd(value, argnums=(0, 1))(V, 1.0)
    np.testing.assert_allclose(by_scale, value(V, 1.0), rtol=1e-12)
    np.testing.assert_allclose(by_speed, central(lambda h: value(V + h, 1.0), 1e-2), rtol=1e-7)


@pytest.mark.slow
def test_a_run_past_the_path_says_so():
    body = Body("hull", 1.0, [0.01] * 3, free=True)
    gusts = dryden(1, AIR, airspeed=V, duration=0.1, dt=DT)
    system = System([body], forces=[AirframeDrag("hull", linear=[0.1] * 3, wind=gusts)])
    scene = Scene("gusty", "A body in gusts", system, system.reference, t1=0.3)
    with pytest.raises(SimulationError, match="AirframeDrag on hull is not finite there"):
        simulate(scene, error_estimate=False)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"airspeed": 0.0}, "airspeed of gusts must be positive"),
        ({"duration": -1.0}, "duration of gusts must be positive"),
        ({"dt": 3.0}, "cannot resolve gusts that last 1.25 s"),
        ({"mean": [1.0, np.inf, 0.0]}, "mean wind must be finite"),
        ({"turbulence": Turbulence(-AIR.lengths, AIR.intensities)}, "must be positive"),
    ],
)
def test_senseless_numbers_are_refused(numbers, words):
    given = {"turbulence": AIR, "airspeed": V, "duration": 1.0} | numbers
    with pytest.raises(ModelError, match=words):
        dryden(0, **given)


def test_heights_outside_the_formulas_are_refused():
    with pytest.raises(ModelError, match=r"3.048 to 304.8 m .*height is 500 m"):
        low_altitude(500.0, 10.0)


def test_without_a_wind_the_way_its_axes_turn_is_not_known():
    """Gusts along x, and a derivative by the wind that is NaN, not one without the turning."""
    t = jnp.asarray(0.2)
    at = jax.jit(lambda mean: dryden(3, AIR, airspeed=V, duration=0.4, dt=DT, mean=mean)(t))
    calm, none = np.array([0.0, 0.0, 0.7]), np.array([1e-9, 0.0, 0.7])
    np.testing.assert_allclose(at(jnp.asarray(calm)), at(jnp.asarray(none)), atol=1e-8)
    assert np.all(np.isnan(jax.jacfwd(at)(jnp.asarray(calm))[:2, :2]))
    blowing = jnp.array([2.0, -1.0, 0.7])
    expected = np.stack([central(lambda h, d=d: at(blowing + h * d), 1e-4) for d in np.eye(3)], 1)
    np.testing.assert_allclose(jax.jacfwd(at)(blowing), expected, atol=1e-7)
