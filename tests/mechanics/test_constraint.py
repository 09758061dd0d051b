"""Every constraint row: against the report's tables, and against automatic differentiation."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_l, random_quaternion, relative_error, unit
from report_tables import Numbers, Posture, table_omega, table_p, value

from stmuav_jax.algebra.rotation import angular_velocity, normalise
from stmuav_jax.mechanics import constraint

FORMS = ("omega", "p")
IN_TABLES = ("point", "n1", "n2", "p1", "p2", "distance", "displacement")
ALL_ROWS = {
    **{
        k: constraint.PRIMITIVES[k]
        for k in ("point", "n1", "n2", "distance", "angle", "displacement", "screw")
    },
    "p1": constraint.p1_all,
    "p2": constraint.p2_all,
}
SEEDS = range(4)
EXACT = 1e-12


@cache
def rows_of(kind, form, two_of_three=False):
    """The compiled primitive."""
    function = constraint.PRIMITIVES[kind] if two_of_three else ALL_ROWS[kind]
    return jax.jit(partial(function, form=form))


def random_numbers(rng):
    axis_i, other = unit(rng.normal(size=3)), rng.normal(size=3)
    return Numbers(
        axis_i, unit(rng.normal(size=3)), rng.normal(size=3), rng.normal(size=3), 0.7
    ), unit(np.cross(axis_i, other))


def data_of(numbers, side):
    return constraint.Data(
        point_i=jnp.asarray(numbers.point_i),
        point_j=jnp.asarray(numbers.point_j),
        axis_i=jnp.asarray(numbers.axis_i),
        axis_j=jnp.asarray(numbers.axis_j),
        side_i=jnp.asarray(side),
        length=jnp.asarray(numbers.length),
    )


def random_posture(rng):
    v, omega = rng.normal(size=(2, 3))
    return Posture(rng.normal(size=3), v, random_quaternion(rng), 2 * omega)


def side_of(r, v, p, omega, form):
    r, v, p, omega = (jnp.asarray(x) for x in (r, v, p, omega))
    return constraint.side(r, v, p, omega, form)


def fixed_in(posture, form):
    return side_of(posture.r, posture.v, posture.p, posture.omega, form)


# --- against the report's tables


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", IN_TABLES)
def test_rows_equal_the_corrected_tables(kind, form, seed):
    rng = np.random.default_rng(seed)
    numbers, side = random_numbers(rng)
    i, j = random_posture(rng), random_posture(rng)
    row = rows_of(kind, form)(fixed_in(i, form), fixed_in(j, form), data_of(numbers, side))
    table = table_omega if form == "omega" else table_p
    linear_i, angular_i, linear_j, angular_j, gamma = table(kind, i, j, numbers)
    assert relative_error(row.value, value(kind, i, j, numbers)) < EXACT
    assert relative_error(row.J_i, np.hstack([linear_i, angular_i])) < EXACT
    assert relative_error(row.J_j, np.hstack([linear_j, angular_j])) < EXACT
    assert relative_error(row.gamma, gamma) < EXACT
    assert not np.any(np.asarray(row.target))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", IN_TABLES)
def test_the_two_tables_agree(kind, seed):
    """b = Phi_p L^T / 2, gamma# = gamma^(m) + sum |w|^2 Phi_p p / 4 (transcription check)."""
    rng = np.random.default_rng(50 + seed)
    numbers, _ = random_numbers(rng)
    i, j = random_posture(rng), random_posture(rng)
    in_p, in_omega = table_p(kind, i, j, numbers), table_omega(kind, i, j, numbers)
    extra = np.zeros_like(in_p[4])
    for body, column in ((i, 1), (j, 3)):
        assert relative_error(in_omega[column], 0.5 * in_p[column] @ np_l(body.p).T) < EXACT
        extra += 0.25 * (body.omega @ body.omega) * in_p[column] @ body.p
    assert relative_error(in_omega[4], in_p[4] + extra) < EXACT


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["p1", "p2"])
def test_two_of_three_rows_by_the_reports_rule(kind, seed):
    """The row is dropped where the world component of s_i is largest, also at s_i = e_x."""
    rng = np.random.default_rng(70 + seed)
    numbers, side = random_numbers(rng)
    i, j = random_posture(rng), random_posture(rng)
    if seed < 3:
        i.p, numbers.axis_i = np.array([1.0, 0, 0, 0]), np.eye(3)[seed]
    data = data_of(numbers, side)
    drop = int(np.argmax(np.abs(i.s(numbers.axis_i))))
    keep = [k for k in range(3) if k != drop]
    for form in FORMS:
        sides = fixed_in(i, form), fixed_in(j, form), data
        whole, part = rows_of(kind, form)(*sides), rows_of(kind, form, True)(*sides)
        expected = jax.tree.map(lambda x, keep=keep: np.asarray(x)[keep], whole)
        assert relative_error(part, expected) < EXACT
        # the kept rows of a cross product are independent: singular values 1 and |s_k|
        moments = np.asarray(part.J_j) if form == "omega" else None
        if moments is not None and kind == "p2":
            values = np.linalg.svd(moments[:, :3], compute_uv=False)
            assert values[-1] > 1 / np.sqrt(3) - 1e-12


# --- against automatic differentiation along smooth curves


def random_coefficients(rng):
    """Of r(t) and of p(t) before it is normalised."""
    position, turning = rng.normal(size=(4, 3)), 0.5 * rng.normal(size=(4, 4))
    turning[0] = random_quaternion(rng)
    return jnp.asarray(position), jnp.asarray(turning)


def curve(coefficients):
    """r(t), unit p(t): smooth functions with random coefficients."""
    position, turning = coefficients
    powers = lambda t: jnp.stack([jnp.ones_like(t), t, t**2, jnp.sin(3 * t)])
    return lambda t: (powers(t) @ position, normalise(powers(t) @ turning))


def twice(f, t):
    """f, df/dt, d2f/dt2 by forward mode, twice."""
    first = lambda s: jax.jvp(f, (s,), (jnp.ones_like(s),))[1]
    rate, second = jax.jvp(first, (t,), (jnp.ones_like(t),))
    return f(t), rate, second


def still(r, p):
    zero = jnp.zeros(3)
    return side_of(r, zero, p, zero, "omega")


@jax.jit
def along_curves(coefficients, data, t):
    """By kind: d Phi/dt, d2 Phi/dt2; and by form J u, J udot - gamma, gamma; on two curves."""
    paths = tuple(map(curve, coefficients))

    def phi(t):
        sides = [still(*path(t)) for path in paths]
        return {k: rows(*sides, data, form="omega").value for k, rows in ALL_ROWS.items()}

    def body(path, form):
        (r, p), (v, p_rate), (a, p_second) = twice(path, t)
        turning = p_second if form == "p" else angular_velocity(p, p_second)
        side = side_of(r, v, p, angular_velocity(p, p_rate), form)
        return side, jnp.concatenate([a, turning])

    def left(kind, form):
        (i, i_rate), (j, j_rate) = (body(path, form) for path in paths)
        row = ALL_ROWS[kind](i, j, data, form=form)
        speed = row.J_i @ i.velocity + row.J_j @ j.velocity
        return speed, row.J_i @ i_rate + row.J_j @ j_rate - row.gamma, row.gamma

    _, rate, second = twice(phi, t)
    return rate, second, {(k, form): left(k, form) for k in ALL_ROWS for form in FORMS}


@cache
def compared(seed):
    """`along_curves` for one set of random numbers."""
    rng = np.random.default_rng(200 + seed)
    data = data_of(*random_numbers(rng))
    coefficients = random_coefficients(rng), random_coefficients(rng)
    return jax.tree.map(np.asarray, along_curves(coefficients, data, jnp.asarray(0.3)))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ALL_ROWS)
def test_rows_are_the_derivatives_of_the_constraint(kind, form, seed):
    rate, second, left = compared(seed)
    speed, minus_gamma, gamma = left[kind, form]
    assert relative_error(speed, rate[kind]) < EXACT
    size = np.max(np.abs(second[kind])) + np.max(np.abs(gamma))
    assert np.max(np.abs(minus_gamma - second[kind])) < EXACT * size
    assert np.max(np.abs(gamma)) > 1e-3  # the comparison would not notice a missing gamma else


# --- drivers


@pytest.mark.parametrize("seed", SEEDS)
def test_angle_between_frames_that_share_their_axis(seed):
    """On a revolute joint the angle's rate is the relative angular velocity along the axis."""
    rng = np.random.default_rng(300 + seed)
    phi = (2 * rng.random() - 1) * 3.1
    i, j = random_posture(rng), random_posture(rng)
    x, y, z = np.eye(3)
    j.p = np.asarray(_product(i.p, np.array([np.cos(phi / 2), 0, 0, np.sin(phi / 2)])))
    data = data_of(Numbers(x, x, z, z, 1.0), y)
    row = rows_of("angle", "omega")(fixed_in(i, "omega"), fixed_in(j, "omega"), data)
    assert float(row.value[0]) == pytest.approx(phi, abs=1e-14)
    np.testing.assert_allclose(row.J_i, [[0, 0, 0, 0, 0, -1]], atol=1e-14)
    np.testing.assert_allclose(row.J_j, [[0, 0, 0, 0, 0, 1]], atol=1e-14)


def _product(p, q):
    return np.concatenate(
        [[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])]
    )


def test_every_primitive_says_how_many_rows_it_has():
    rng = np.random.default_rng(5)
    numbers, side = random_numbers(rng)
    bodies = [fixed_in(random_posture(rng), "omega") for _ in range(2)]
    sides = *bodies, data_of(numbers, side)
    assert set(constraint.ROWS) == set(constraint.PRIMITIVES)
    for kind, count in constraint.ROWS.items():
        row = rows_of(kind, "omega", kind in ("p1", "p2"))(*sides)
        assert row.value.shape == row.gamma.shape == row.target.shape == (count,)
        assert row.J_i.shape == row.J_j.shape == (count, 6)
