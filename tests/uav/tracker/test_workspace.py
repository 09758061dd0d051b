"""The workspace: its limits, both singularities, and the map, against independent routes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_I, Augmented, ModelError, make_scene
from stmuav_jax.uav import tracker_geometry
from stmuav_jax.uav.tracker.bodies import posture
from stmuav_jax.uav.tracker.geometry import initial_angles
from stmuav_jax.uav.tracker.kinematics import (
    Reason,
    panel_angles,
    stroke_jacobian,
    strokes,
)
from stmuav_jax.uav.tracker.workspace import Limits, direction_grid, survey, tracker_limits

G, LIMITS = tracker_geometry(PART_I), tracker_limits(PART_I)
HOME = initial_angles(PART_I)
FREE = Limits(home=(0.0, 0.0), tilt=np.pi)
look = jax.jit(survey)


@jax.jit
def margin(phi, theta):
    """The parallel margin at angles in degrees."""
    angles = jnp.radians(jnp.stack([jnp.asarray(phi), jnp.asarray(theta)]))
    return survey(G, angles, FREE).margins.parallel


def zero(f, low, high):
    """A root by bisection."""
    sign = np.sign(f(low))
    for _ in range(52):
        middle = (low + high) / 2
        low, high = (middle, high) if np.sign(f(middle)) == sign else (low, middle)
    return low


def test_zero_of_the_shifts_is_the_initial_posture():
    at = look(G, HOME, LIMITS)
    assert np.max(np.abs(at.displacements)) < 1e-16
    assert np.asarray(at.strokes) == pytest.approx([0.02206362, 0.02143280], abs=1e-8)
    assert int(at.reason) == Reason.VALID
    assert np.asarray(at.margins.lower) == pytest.approx([0.012, 0.035], abs=1e-15)


def test_figures_of_the_reconstruction():
    """Singular at phi = -56.7 and theta = -45.1 degrees along the axes; strokes within 45."""
    assert zero(lambda x: margin(x, 0.0), 0.0, -80.0) == pytest.approx(-56.7, abs=0.05)
    assert zero(lambda x: margin(0.0, x), 0.0, -60.0) == pytest.approx(-45.1, abs=0.05)
    side = jnp.radians(jnp.linspace(-45, 45, 91))
    q = 1e3 * np.asarray(strokes(G, jnp.stack(jnp.meshgrid(side, side))))
    assert [q[0].min(), q[0].max()] == pytest.approx([7, 97], abs=0.6)
    assert [q[1].min(), q[1].max()] == pytest.approx([-16, 124], abs=0.6)


def test_imaginary_roots():
    """Leg 2 outside theta in (-80.8, 103.9) degrees whatever phi; leg 3 outside +-92.4 at 0."""
    rods = lambda phi, theta: look(G, jnp.radians(jnp.array([phi, theta])), FREE).margins.rods
    for phi in (0.0, 40.0):
        assert zero(lambda x, phi=phi: rods(phi, x)[0], 0.0, -100.0) == pytest.approx(
            -80.8, abs=0.05
        )
    assert zero(lambda x: rods(0.0, x)[0], 0.0, 120.0) == pytest.approx(103.9, abs=0.05)
    assert zero(lambda x: rods(x, 0.0)[1], 0.0, 100.0) == pytest.approx(92.4, abs=0.05)
    assert zero(lambda x: rods(x, 30.0)[1], 0.0, -100.0) == pytest.approx(-65.4, abs=0.05)


@pytest.fixture(scope="module")
def matrices():
    """For angles (2,): the scene's 34 rows, and the same with both sliders locked (36 x 36)."""
    scene = make_scene("tracker", 2)
    model = Augmented().prepare(scene.system)
    locked = np.zeros((2, 36))
    locked[0, 2] = locked[1, 8] = 1.0

    @jax.jit
    def of(angles):
        kin = scene.system.kinematics(posture(G, angles))
        rows = model.constraints.equations(jnp.zeros(()), kin).matrix
        both = jnp.concatenate([rows, jnp.asarray(locked)])
        values = lambda m: jnp.linalg.svd(m, compute_uv=False)
        return values(rows), values(both)

    return of


def test_parallel_singularity_is_that_of_the_locked_mechanism(matrices):
    """There the 34 constraints with both sliders locked lose rank; the 34 alone never do."""
    phi = zero(lambda x: margin(x, 10.0), 0.0, -80.0)
    at = jnp.radians(jnp.array([phi, 10.0]))
    rows, both = matrices(at)
    assert both[-1] < 1e-12
    assert rows[-1] > 0.02
    off = matrices(at + jnp.array([0.01, 0.0]))[1][-1]
    assert off > 1e-5


def test_rank_and_smallest_singular_value_over_the_workspace(matrices):
    """No redundant row, 2 degrees of freedom, smallest value 0.03 to 0.05."""
    x = np.random.default_rng(20).uniform(-0.6, 0.6, (2, 100))
    x = x[:, np.asarray(look(G, x, LIMITS).reason) == 0].T
    assert len(x) > 60
    smallest = np.array([matrices(jnp.asarray(one))[0][-1] for one in x])
    assert smallest.min() > 0.028
    assert smallest.max() < 0.05


def test_condition_is_numpys():
    x = np.random.default_rng(21).uniform(-0.6, 0.6, (2, 30))
    J = np.moveaxis(np.asarray(stroke_jacobian(G, jnp.asarray(x))), 2, 0)
    assert np.asarray(look(G, x, LIMITS).condition) == pytest.approx(np.linalg.cond(J), rel=1e-10)


def test_sign_of_the_margin_is_that_of_the_determinant():
    """Of the strokes' derivative by the angles, rows and columns in the report's order."""
    x = jnp.asarray(np.random.default_rng(22).uniform(-1.1, 1.1, (2, 300)))
    J = np.moveaxis(np.asarray(stroke_jacobian(G, x)), 2, 0)[:, ::-1]
    found = np.asarray(margin(*np.degrees(x)))
    real = np.isfinite(found)
    assert np.array_equal(np.sign(np.linalg.det(J[real])), np.sign(found[real]))
    assert (found[real] < 0).sum() > 20
    level = np.linalg.det(np.asarray(stroke_jacobian(G, jnp.zeros(2)))[::-1])
    assert level == pytest.approx(4.8e-3, abs=5e-5)


@pytest.mark.parametrize(
    ("degrees", "limits", "reason"),
    [
        ((0, 0), LIMITS, Reason.VALID),
        ((np.nan, 0), LIMITS, Reason.NOT_FINITE),
        ((61, 0), LIMITS, Reason.TILT),
        ((-50, -50), LIMITS, Reason.TILT),
        ((0, -85), FREE, Reason.ROD_2_ROOT),
        ((-100, 0), FREE, Reason.ROD_3_ROOT),
        ((-50, 30), LIMITS, Reason.SINGULAR),
        ((0, -38), LIMITS, Reason.STROKE_2),
        ((-51, -29), LIMITS, Reason.STROKE_3),
        ((45, -45), FREE, Reason.POST_ROOT),
    ],
)
def test_reasons(degrees, limits, reason):
    post = {"geometry.post": 0.02} if reason == Reason.POST_ROOT else {}
    at = look(tracker_geometry(PART_I.replaced(post)), np.radians(degrees), limits)
    assert Reason(int(at.reason)) == reason
    assert (float(at.margins.post) < 0) == bool(post)


def test_derivatives_stay_finite_outside():
    """Margins that exist differentiate to numbers, on both sides of a root."""
    x = np.radians([[0.0, 0.0], [0.0, -85.0]])

    def total(x):
        at = survey(G, x, FREE)
        return jnp.sum(jnp.where(at.reason == 0, at.strokes[0], 0.0)), jnp.sum(at.margins.rods)

    gradient, of_rods = jax.jit(jax.jacrev(total))(jnp.asarray(x))
    assert np.all(np.isfinite(of_rods))
    assert np.all(np.isfinite(gradient))
    assert np.max(np.abs(np.asarray(gradient)[:, 1])) == 0 < abs(float(gradient[1, 0]))


AZIMUTHS = np.radians(np.arange(0.0, 360.0, 3.0))


def test_singularity_bounds_the_cone_before_the_rods_do():
    """Without stops: 43 to 44 degrees of tilt in the worst azimuth, 67 for imaginary roots."""
    grid = direction_grid(AZIMUTHS, np.radians(np.arange(0, 90, 0.25)))
    reasons = np.asarray(look(G, panel_angles(grid), FREE).reason)
    outside = reasons != Reason.VALID
    ends = np.where(np.any(outside, axis=1), np.argmax(outside, axis=1), outside.shape[1])
    worst = int(np.argmin(ends))
    assert 0.25 * ends[worst] == pytest.approx(43.5, abs=0.5)
    assert reasons[worst, ends[worst]] == Reason.SINGULAR
    real = np.all(np.isfinite(np.asarray(strokes(G, panel_angles(grid)))), axis=(0, 1))
    assert 0.25 * np.argmin(real) == pytest.approx(67, abs=0.5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lower": (0.1, -1.0), "upper": (0.1, 1.0)}, "lower < upper"),
        ({"tilt": 0.0}, r"tilt limit must be in \(0, pi\]"),
        ({"home": (0.0, np.nan)}, "home of the workspace's limits must be finite"),
    ],
)
def test_bad_limits_are_refused(change, words):
    with pytest.raises(ModelError, match=words):
        Limits(**({"home": (0.0, 0.0)} | change))
