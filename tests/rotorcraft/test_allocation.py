"""Allocation: the report's mixing corrected, and bounded least squares against SciPy and KKT."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from active_sets import least_squares
from scipy.optimize import lsq_linear

from stmuav_jax import PART_II, ModelError
from stmuav_jax.rotorcraft import AllocationReason, RotorLimits, Rotors, allocate, allocation
from stmuav_jax.rotorcraft.allocation import check_lift, minimum_norm, wrench_map

K_F, K_TAU = PART_II.value("rotor.k_f"), PART_II.value("rotor.k_tau")
LOW, HIGH = 300.0, 1700.0
LIMITS = RotorLimits(LOW, HIGH)
# the largest numbers are squared speeds and their products: about 1e7 units of round-off
EXACT = 1e-9


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


def test_printed_moments_are_no_machines():
    """Rows of B_M as printed: equal speeds would roll and pitch."""
    printed = np.array([[HALF, -1, HALF, HALF, 1, HALF], [ROOT, 0, ROOT, ROOT, 0, -ROOT]])
    np.testing.assert_allclose(printed.sum(axis=1), [2, 2 * ROOT])
    np.testing.assert_allclose(MIXING[1:].sum(axis=1), 0, atol=1e-15)


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


TABLE = wrench_map(rotors(PART_II.value("rotor.arms"), PART_II.value("rotor.spin")), jnp.zeros(3))
IDEAL = wrench_map(hexagon(-30, -60, ALTERNATE), jnp.zeros(3))
SPAN = HIGH**2 - LOW**2


def wanted(B, count, seed):
    """Wrenches inside what is attainable, on its edge, and (mostly) outside."""
    rng = np.random.default_rng(seed)
    B = np.asarray(B)
    inside = LOW**2 + SPAN * rng.uniform(size=(count, 6))
    corners = LOW**2 + SPAN * rng.integers(0, 2, size=(count, 6))
    edge = np.where(rng.uniform(size=(count, 6)) < 0.3, inside, corners)
    reach = np.abs(B).sum(axis=1) * SPAN / 2
    middle = B.sum(axis=1) * (HIGH**2 + LOW**2) / 2
    outside = middle + reach * rng.uniform(-1.3, 1.3, size=(count, 4))
    return inside @ B.T, edge @ B.T, outside


COUNT = 150
EVEN, NONE = np.ones(4), np.zeros(6)
YAW_LAST = np.array([1.0, 1.0, 1.0, 0.01])


@pytest.fixture(scope="module")
def batched():
    """One compilation for every map, priority, preference and limit."""

    @jax.jit
    def many(B, wrenches, priority, preferred, limits):
        one = lambda w: allocate(B, w, RotorLimits(*limits), priority=priority, preferred=preferred)
        return jax.vmap(one)(wrenches)

    def run(B, wrenches, priority=EVEN, preferred=NONE, limits=(LOW, HIGH)):
        rows = np.resize(np.asarray(wrenches), (3 * COUNT, 4))
        return jax.tree.map(np.asarray, many(B, rows, priority, preferred, limits))

    return run


CASES = {
    "table": (TABLE, EVEN, 0.0),
    "regular": (IDEAL, EVEN, 0.0),
    "yaw last": (TABLE, YAW_LAST, 0.0),
    "near hover": (TABLE, EVEN, 1356.3**2),
}


@pytest.fixture(scope="module", params=list(CASES))
def allocated(request, batched):
    B, priority, preferred = CASES[request.param]
    w = np.concatenate(wanted(B, COUNT, seed=len(request.param)))
    start = np.full(6, preferred)
    return np.asarray(B), priority, start, w, batched(B, w, priority, start)


def test_speeds_are_within_limits_and_give_the_wrench_they_say(allocated):
    B, _, _, w, found = allocated
    assert np.all(found.speed_squared >= LOW**2 * (1 - EXACT))
    assert np.all(found.speed_squared <= HIGH**2 * (1 + EXACT))
    np.testing.assert_allclose(found.speeds, np.sqrt(found.speed_squared), rtol=1e-14)
    np.testing.assert_allclose(found.wrench, found.speed_squared @ B.T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.wrench + found.wrench_error, w, rtol=0, atol=1e-12)


def test_attainable_wrenches_are_given_exactly(allocated):
    """Those made from speeds within the limits, edge of the set included."""
    *_, found = allocated
    assert np.all(found.reason[: 2 * COUNT] == AllocationReason.VALID)
    assert np.max(np.abs(found.wrench_error[: 2 * COUNT])) < EXACT


def test_none_is_left_unfinished_and_unattainable_ones_are_told(allocated):
    *_, found = allocated
    assert np.all(found.reason != AllocationReason.NOT_CONVERGED)
    far = found.reason == AllocationReason.UNATTAINABLE
    assert 0.5 * COUNT < far.sum() <= COUNT
    assert np.all(np.max(np.abs(found.wrench_error[far]), axis=1) > 1e-6)


def test_misfit_is_scipys(allocated):
    """Bounded-variable least squares (BVLS), row by row."""
    B, priority, _, w, found = allocated
    W = priority / (np.abs(B).sum(axis=1) * SPAN)
    mine = np.linalg.norm(found.wrench_error * W, axis=1)
    A, limits = W[:, None] * B * SPAN, (LOW**2 / SPAN, HIGH**2 / SPAN)
    theirs = [
        np.sqrt(2 * lsq_linear(A, W * each, limits, method="bvls", tol=1e-14).cost) for each in w
    ]
    # SciPy may stop early on the edge; mine must never be worse
    assert np.max(mine - theirs) < 1e-10
    assert np.max(np.abs(mine - theirs)[2 * COUNT :]) < 1e-10


def test_unattainable_ones_satisfy_the_conditions_of_optimality(allocated):
    """No allowed change of a speed would lessen the weighted misfit."""
    B, priority, _, _, found = allocated
    W = priority / (np.abs(B).sum(axis=1) * SPAN)
    far = found.reason == AllocationReason.UNATTAINABLE
    slope = -(found.wrench_error[far] * W) @ (W[:, None] * B * SPAN)
    u = found.speed_squared[far]
    low, high = u < LOW**2 * (1 + 1e-9), u > HIGH**2 * (1 - 1e-9)
    assert np.all(slope[low] > -1e-9)
    assert np.all(slope[high] < 1e-9)
    assert np.max(np.abs(slope[~low & ~high])) < 1e-9


def test_attained_ones_deviate_least(allocated):
    """u - u_0 = B^T y + z, z >= 0 at the lowest speed, <= 0 at the highest, else 0 (KKT)."""
    B, _, start, _, found = allocated
    A = B / np.linalg.norm(B, axis=1)[:, None]
    for u in found.speed_squared[:COUNT]:
        low, high = u < LOW**2 * (1 + 1e-9), u > HIGH**2 * (1 - 1e-9)
        rows = np.concatenate([A.T, np.eye(6)[:, low], -np.eye(6)[:, high]], axis=1)
        bounds = np.zeros(rows.shape[1])
        bounds[:4] = -np.inf
        left = lsq_linear(rows, (u - start) / SPAN, (bounds, np.inf), method="bvls", tol=1e-14)
        assert np.sqrt(2 * left.cost) < 1e-9


def test_edges_against_every_active_set(batched):
    """Some thousand wrenches on the edge of what is attainable, where limits nearly coincide."""
    B, rng = np.asarray(TABLE), np.random.default_rng(7)
    many = 9 * COUNT
    corners = LOW**2 + SPAN * rng.integers(0, 2, size=(many, 6))
    loose = rng.uniform(size=(many, 6)) < rng.uniform(0.1, 0.6, size=(many, 1))
    w = np.where(loose, LOW**2 + SPAN * rng.uniform(size=(many, 6)), corners) @ B.T
    # at these, interior-point methods hold a rotor at a limit that should be free of it
    w[0] = [46.46127051074373, -1.8309029665440097, 4.53209735215301, 0.6364491758979717]
    w[1] = [61.73041336033286, 5.1890569454280415, 1.944752909428937, 0.7111826341989693]
    w[2] = [59.91159339990186, -3.1748450119483715, -11.966062841010555, 0.38751480191924464]
    w[3] = [24.724670250138225, 0.8415109867563909, 6.343915974655395, 0.364939590132125]
    for start in (0.0, 1356.3**2):
        for part in np.split(w, 3):
            found = batched(TABLE, part, EVEN, np.full(6, start))
            assert np.all(found.reason == AllocationReason.VALID)
            exact = least_squares(B, part, LOW, HIGH, start)
            # the twin may use its tolerance in limits and wrench where few sets are regular
            assert np.max(np.abs(found.speed_squared - exact)) < 1e-6 * SPAN


def test_without_active_limits_it_is_the_least_norm_inverse(batched):
    w = jnp.array([72.25, 0.05, -0.08, 0.01])
    found = batched(TABLE, w[None], limits=(0.0, 2000.0))
    np.testing.assert_allclose(found.speed_squared[0], minimum_norm(TABLE, w), rtol=1e-12)
    assert not np.any(found.at_limit)


def test_yaw_is_given_up_first(batched):
    """A yaw moment that is not to be had with the thrust: the priorities decide who yields."""
    w = np.array([[100.0, 0.0, 0.0, 2.5]])
    even, last = (batched(TABLE, w, each) for each in (EVEN, YAW_LAST))
    assert abs(even.wrench_error[0, 0]) > 0.5
    assert np.max(np.abs(last.wrench_error[0, :3])) < 0.05
    assert abs(last.wrench_error[0, 3]) > abs(even.wrench_error[0, 3])


UNITS = (np.array([10.0, 1.0, 1.0, 0.1]), np.array(0.1), (np.array(10.0), np.array(100.0)))
REGIMES = [
    ((72.0, 0.5, -0.3, 0.1), AllocationReason.VALID),  # no rotor at a limit
    ((72.0, 9.0, 3.0, 0.2), AllocationReason.VALID),  # some
    ((72.0, 14.0, 14.0, 1.0), AllocationReason.UNATTAINABLE),
]


@pytest.fixture(scope="module")
def derivatives():
    """u, its reason, derivative along a direction and gradient of c . u, many at once."""

    def allocated(w, scale, limits):
        found = allocate(TABLE * scale, w, RotorLimits(*limits))
        return found.speed_squared, found.reason

    @jax.jit
    @jax.vmap
    def many(at, along, c):
        (u, reason), (rate, _) = jax.jvp(allocated, at, along)
        _, back = jax.vjp(lambda *x: allocated(*x)[0], *at)
        return u, reason, rate, back(c)

    return many


def test_derivatives_are_those_of_differences(derivatives):
    """By wrench, map and limits; forward and reverse; in a batch."""
    rng = np.random.default_rng(2)
    c = rng.normal(size=6)
    toward = jax.tree.map(lambda x: x * rng.normal(size=x.shape), UNITS)
    step = 1e-4
    shifts = np.array([0.0, -2 * step, -step, step, 2 * step])
    for w, expected in REGIMES:
        at = (np.array(w), np.array(1.0), (np.array(LOW), np.array(HIGH)))
        spread = lambda x, v: x + shifts.reshape(5, *[1] * x.ndim) * v
        points = jax.tree.map(spread, at, toward)
        many = jax.tree.map(lambda x: np.broadcast_to(x, (5, *x.shape)), toward)
        u, reason, rate, back = derivatives(points, many, np.broadcast_to(c, (5, 6)))
        assert np.all(np.asarray(reason) == expected)
        u, rate = np.asarray(u), np.asarray(rate)
        differences = (u[1] - 8 * u[2] + 8 * u[3] - u[4]) / (12 * step)
        np.testing.assert_allclose(rate[0], differences, rtol=0, atol=1e-8 * np.max(np.abs(rate)))
        pairs = zip(jax.tree.leaves(back), jax.tree.leaves(toward), strict=True)
        by_reverse = sum(np.sum(np.asarray(g)[0] * v) for g, v in pairs)
        assert by_reverse == pytest.approx(c @ rate[0], rel=1e-10)


def test_a_rotor_at_rest_has_the_derivatives_of_one_held_there():
    """Limits from zero: speeds by the wrench and by the limits, against differences where it stays."""

    @jax.jit
    def speeds(w, low):
        found = allocate(TABLE, w, RotorLimits(low, HIGH))
        return found.speeds, found.reason

    w, low = jnp.array([46.3, 1.9, -4.2, 0.6]), jnp.zeros(6)
    found, reason = speeds(w, low)
    rests = np.asarray(found) == 0
    assert reason == AllocationReason.VALID
    assert rests.sum() == 1
    by_wrench, by_low = jax.jit(jax.jacfwd(lambda *x: speeds(*x)[0], argnums=(0, 1)))(w, low)
    h = 1e-4 * np.eye(4)
    differences = [(speeds(w + e, low)[0] - speeds(w - e, low)[0]) / 2e-4 for e in h]
    np.testing.assert_allclose(by_wrench, np.stack(differences, axis=1), rtol=1e-5, atol=1e-5)
    assert np.all(np.asarray(by_wrench)[rests] == 0)
    # speeds cannot be below zero: from one side
    one_sided = (speeds(w, low + 1e-3)[0] - found) / 1e-3
    np.testing.assert_allclose(by_low @ np.ones(6), one_sided, rtol=0, atol=1e-3)
    np.testing.assert_array_equal(np.asarray(by_low)[rests], np.eye(6)[rests])
    pull = jax.jit(jax.grad(lambda w: speeds(w, low)[0] @ jnp.arange(1.0, 7.0)))(w)
    np.testing.assert_allclose(pull, np.arange(1.0, 7.0) @ np.asarray(by_wrench), rtol=1e-10)


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
        allocate(TABLE, [70.0, 0, 0, 0], RotorLimits(*limits))


def test_senseless_wishes_are_refused():
    with pytest.raises(ModelError, match="four positive numbers"):
        allocate(TABLE, [70.0, 0, 0, 0], LIMITS, priority=(1, 1, 0, 1))
    with pytest.raises(ModelError, match="must be finite"):
        allocate(TABLE, [70.0, np.nan, 0, 0], LIMITS)
    wish = [70.0, 0, 0, 0]
    for preferred in (np.nan, [1e6, np.inf, 0, 0, 0, 0]):
        with pytest.raises(ModelError, match="preferred squares of the speeds must be finite"):
            allocate(TABLE, wish, LIMITS, preferred=preferred)
    with pytest.raises(ModelError, match=r"shape \(6,\) .* but its shape is \(5,\)"):
        allocate(TABLE, wish, LIMITS, preferred=np.zeros(5))
    with pytest.raises(ModelError, match=r"wrench must be numbers of shape \(4,\).* is \(3,\)"):
        allocate(TABLE, wish[:3], LIMITS)
    with pytest.raises(ModelError, match=r"wrench must be numbers .* but it is 'up'"):
        allocate(TABLE, "up", LIMITS)
    bare = inspect.unwrap(allocate)
    with pytest.raises(ModelError, match=r"has shape \(4, k\).* not \(3, 6\)"):
        bare(TABLE[:3], wish, LIMITS)
    with pytest.raises(ModelError, match="must be a RotorLimits, not None"):
        bare(TABLE, wish, None)


def test_a_result_off_the_optimum_is_flagged():
    """What the walk has found is not believed: each condition fails where it should."""
    box = allocation._Box(
        jnp.eye(4, 6) + jnp.eye(4, 6, 2), jnp.full(4, 0.8), jnp.ones(6), jnp.zeros(6)
    )
    none, best = jnp.zeros(6, int), jnp.linalg.pinv(box.A) @ box.b
    way = jnp.linalg.svd(box.A)[2][5]
    assert allocation._least_norm(box, best, none, none)
    assert not allocation._least_norm(box, best + 1e-5 * way, none, none)
    assert allocation._is_nearest(box, best)
    assert not allocation._is_nearest(box, best + 1e-5 * box.A[0])


def test_lift_that_does_not_carry_says_required_and_available():
    hull = rotors(PART_II.value("rotor.arms"), PART_II.value("rotor.spin"))
    least_thrust, most = check_lift(hull, RotorLimits(0.0, 1400.0), 72.25)
    assert float(most) == pytest.approx(6 * K_F * 1400**2)
    assert float(least_thrust) == 0
    with pytest.raises(ModelError, match=r"72.25 N are required.* 0 to 39.28 N"):
        check_lift(hull, RotorLimits(0.0, 1000.0), 72.25)
    with pytest.raises(ModelError, match=r"weight is 72.25 N.* 76.98 to 157.1 N"):
        check_lift(hull, RotorLimits(1400.0, 2000.0), 72.25)
