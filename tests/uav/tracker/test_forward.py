"""From strokes back to angles: accuracy, derivatives, branches, paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_I
from stmuav_jax.uav import tracker_geometry
from stmuav_jax.uav.tracker.kinematics import (
    PairMotion,
    Reason,
    angles_from_strokes,
    follow,
    solve_2x2,
    stroke_jacobian,
    stroke_motion,
    strokes,
)
from stmuav_jax.uav.tracker.workspace import survey, tracker_limits

G, LIMITS = tracker_geometry(PART_I), tracker_limits(PART_I)
ROUND_TRIP = 1e-12  # [rad]

_solve = jax.jit(angles_from_strokes)


def solve(g, q, start=(0.0, 0.0)):
    """One compilation for each number of strokes."""
    start = jnp.asarray(start)
    return _solve(g, q, jnp.broadcast_to(start.reshape(2, -1), q.shape))


@pytest.fixture(scope="module")
def inside():
    """10,000 random postures in the workspace (2, 10000) [rad]."""
    x = np.random.default_rng(12).uniform(-1.05, 1.05, (2, 30000))
    x = x[:, np.asarray(survey(G, x, LIMITS).reason) == Reason.VALID]
    assert x.shape[1] >= 10000
    return jnp.asarray(x[:, :10000])


@pytest.mark.slow
def test_inverse_then_forward(inside):
    found = solve(G, strokes(G, inside))
    assert np.all(np.asarray(found.reason) == Reason.VALID)
    assert np.max(np.abs(found.angles - inside)) < ROUND_TRIP
    assert np.min(found.margin) > float(LIMITS.margin) - 1e-12


def test_any_start_in_the_workspace_gives_the_same(inside):
    """No second posture of the same strokes on this side, up to the tilt limit."""
    others = jnp.roll(inside, 4321, axis=1)
    found = solve(G, strokes(G, inside), others)
    good = np.asarray(survey(G, found.angles, LIMITS).reason) == Reason.VALID
    assert np.mean(good) > 0.95
    assert np.max(np.abs(found.angles - inside)[:, good]) < ROUND_TRIP


@pytest.mark.slow
def test_derivatives_in_strokes(inside):
    """Along a path of strokes q + q' t + q'' t^2 / 2, differentiated twice."""
    x = inside[:, :50]
    q = strokes(G, x)
    rate, acceleration = jnp.asarray(np.random.default_rng(13).normal(size=(2, 2, 50)) / 100)

    @jax.jit
    def twice(q):
        path = lambda t: angles_from_strokes(G, q + rate * t + acceleration * t**2 / 2).angles
        first = lambda t: jax.jvp(path, (t,), (1.0,))[1]
        return jax.jvp(first, (0.0,), (1.0,))

    first, second = twice(q)
    back_rate = solve_2x2(stroke_jacobian(G, x), rate)
    assert np.max(np.abs(first - back_rate)) < 1e-11
    J, product = stroke_jacobian(G, x), np.empty((2, 50))
    for k in range(50):
        product[:, k] = np.asarray(J[:, :, k]) @ np.asarray(first[:, k])
    assert product == pytest.approx(np.asarray(rate), abs=1e-13)
    again = stroke_motion(G, PairMotion(x, first, second))
    assert np.max(np.abs(again.acceleration - acceleration)) < 1e-12


@pytest.mark.slow
def test_derivative_in_lengths(inside):
    """Held strokes: J dx = -dq, by reverse mode."""
    x = inside[:, 0]
    q = strokes(G, x)
    got = jax.jit(jax.grad(lambda g: jnp.sum(angles_from_strokes(g, q).angles)))(G)
    weights = np.linalg.solve(np.asarray(stroke_jacobian(G, x)).T, np.ones(2))
    expected = jax.jit(jax.grad(lambda g: -jnp.sum(weights * strokes(g, x))))(G)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert np.asarray(a) == pytest.approx(np.asarray(b), abs=1e-11)
    assert float(jnp.max(jnp.abs(got.rods))) > 1.0


def test_strokes_that_no_posture_has():
    q = np.array([[0.04, 0.5, np.nan, 0.04], [0.04, 0.04, 0.04, -np.inf]])
    found = solve(G, q)
    assert found.reason.tolist() == [
        Reason.VALID, Reason.NOT_CONVERGED, Reason.NOT_FINITE, Reason.NOT_FINITE,
    ]  # fmt: skip
    assert np.isfinite(found.angles).all(axis=0).tolist() == [True, False, False, False]


def test_the_other_side_of_the_singularity_is_another_posture():
    """phi = -53 degrees and its twin beyond -56.7: the same strokes, the other sign."""
    near = jnp.radians(jnp.broadcast_to(jnp.array([[-53.0], [0.0]]), (2, 4)))
    q = strokes(G, near)
    twin = solve(G, q, jnp.radians(jnp.array([-60.0, 0.0])))
    assert int(twin.reason[0]) == Reason.VALID
    assert float(twin.margin[0]) < -0.02
    assert np.max(np.abs(twin.angles - near)) > 0.1
    assert np.max(np.abs(strokes(G, twin.angles) - q)) < 1e-15
    assert np.max(np.abs(solve(G, q).angles - near)) < ROUND_TRIP


def path(start, end, count=60):
    """Angles along a straight line (2, count) [rad]."""
    return jnp.radians(jnp.linspace(jnp.asarray(start), jnp.asarray(end), count).T)


along = jax.jit(follow)


def test_a_path_never_goes_to_the_other_side():
    """Strokes of angles that pass the singularity, at -56.7 degrees, do not lead past it."""
    x = path([-40.0, 0.0], [-70.0, 0.0])
    q = strokes(G, x)
    found = along(G, q, x[:, 0])
    good = np.asarray(found.reason) == Reason.VALID
    passed = np.degrees(np.asarray(x[0])) < -57
    assert good[:30].all()
    assert np.max(np.abs(found.angles - x)[:, :30]) < ROUND_TRIP
    assert np.min(np.asarray(found.margin)[good]) > 0
    assert np.all(~good[passed] | (np.abs(found.angles - x)[0, passed] > 0.02))
    assert np.max(np.abs(strokes(G, found.angles) - q)[:, good]) < 1e-14


def test_a_path_ends_where_it_cannot_go_on():
    x = path([0.0, 0.0], [20.0, 20.0])
    q = np.array(strokes(G, x))
    q[:, 20] = 0.5
    found = along(G, q, np.zeros(2))
    assert found.reason.tolist() == [0] * 20 + [Reason.NOT_CONVERGED] + [Reason.BRANCH] * 39
    jump = np.array(strokes(G, jnp.where(jnp.arange(60) < 25, 0.5, 2.0) * path([20, 20], [20, 20])))
    found = along(G, jump, np.radians([10.0, 10.0]))
    assert found.reason.tolist() == [0] * 25 + [Reason.BRANCH] * 35
    assert not np.any(np.isfinite(np.asarray(found.angles)[:, 25:]))
