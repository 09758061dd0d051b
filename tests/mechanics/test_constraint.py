"""Every constraint row, and the rows of benchmarks/dense: against the report's tables, and against automatic
differentiation."""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense.tables import COUNTS, KINDS, Tables, Variant, g_and_l
from helpers import random_quaternion, relative_error, unit
from problems.plain import PlainJoint
from report_tables import Numbers, Posture, table_omega, table_p, value

from stmuav_jax.math.rotation import angular_velocity, normalise, rotation_matrix
from stmuav_jax.mechanics import constraint

PRIMITIVES: Any = constraint.PRIMITIVES

IN_TABLES = ("point", "n1", "n2", "distance", "displacement")
SEEDS = range(2)
EXACT = 1e-12


@cache
def rows_of(kind) -> Any:
    """The compiled primitive."""
    return jax.jit(partial(PRIMITIVES[kind], form="omega"))


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


def side_of(r, v, p, omega):
    r, v, p, omega = (jnp.asarray(x) for x in (r, v, p, omega))
    R = rotation_matrix(p)
    return constraint.BodyKinematics(r, v, R, R @ omega, jnp.concatenate([v, omega]))


def fixed_in(posture):
    return side_of(posture.r, posture.v, posture.p, posture.omega)


# --- against the report's tables


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", IN_TABLES)
def test_rows_equal_the_corrected_tables(kind, seed):
    rng = np.random.default_rng(seed)
    numbers, side = random_numbers(rng)
    i, j = random_posture(rng), random_posture(rng)
    row = rows_of(kind)(fixed_in(i), fixed_in(j), data_of(numbers, side))
    linear_i, angular_i, linear_j, angular_j, gamma = table_omega(kind, i, j, numbers)
    assert relative_error(row.value, value(kind, i, j, numbers)) < EXACT
    assert relative_error(row.J_i, np.hstack([linear_i, angular_i])) < EXACT
    assert relative_error(row.J_j, np.hstack([linear_j, angular_j])) < EXACT
    assert relative_error(row.gamma, gamma) < EXACT
    assert not np.any(np.asarray(row.target))


@pytest.mark.parametrize("seed", range(4))
def test_rows_of_the_dense_system_equal_the_corrected_tables(seed):
    """Those of benchmarks/dense in pdot, all three of cross products, and the two kept by the report's rule."""
    rng = np.random.default_rng(seed)
    i, j = random_posture(rng), random_posture(rng)
    if seed:
        i.p = np.array([1.0, 0, 0, 0])
    frames = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)]
    if seed:
        # the dropped row is that of the largest world component, also at s_i = e_x, e_y, e_z
        frames[0] = np.roll(np.eye(3), seed, axis=1)
    points = rng.normal(size=(2, 3))
    joints = [
        PlainJoint(kind, kind, 0, 1, *points, *frames) for kind in ("revolute", "translational")
    ]
    tables = Tables(tuple(joints))
    q = np.array([np.r_[b.r, b.p] for b in (i, j)])
    u = np.array([np.r_[b.v, b.p_rate] for b in (i, j)])
    G, L = g_and_l(q[:, 3:])
    found = tables.rows(q, u, G, g_and_l(u[:, 3:]), Variant())
    kept = tables.chosen(G @ L.transpose(0, 2, 1))
    axes = {"point": (2, 2), "n1": (0, 1), "p1": (2, 2), "p2": (2, 2)}
    for kind, count in zip(KINDS, COUNTS, strict=True):
        a, b = axes[kind]
        parts: Any = (frames[0][:, a], frames[1][:, b], *points, 1.0)
        numbers = Numbers(*parts)
        expected = table_p(kind, i, j, numbers)
        got = [part[0] for part in found[kind]]
        for mine, theirs in zip(got[:5], expected, strict=True):
            assert relative_error(mine, theirs) < EXACT
        assert relative_error(got[5], value(kind, i, j, numbers)) < EXACT
        if kind in kept:
            drop = int(np.argmax(np.abs(i.s(numbers.axis_i))))
            assert list(kept[kind][0]) == [k for k in range(3) if k != drop]
            assert len(kept[kind][0]) == count


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
    return side_of(r, zero, p, zero)


@jax.jit
def along_curves(coefficients, data, t):
    """By kind: d Phi/dt, d2 Phi/dt2; J u, J udot - gamma, gamma; on two curves."""
    paths = tuple(map(curve, coefficients))

    def phi(t):
        sides = [still(*path(t)) for path in paths]
        return {k: rows(*sides, data, "omega").value for k, rows in PRIMITIVES.items()}

    def body(path):
        (r, p), (v, p_rate), (a, p_second) = twice(path, t)
        side = side_of(r, v, p, angular_velocity(p, p_rate))
        return side, jnp.concatenate([a, angular_velocity(p, p_second)])

    def left(kind):
        (i, i_rate), (j, j_rate) = map(body, paths)
        row = constraint.PRIMITIVES[kind](i, j, data, "omega")
        speed = row.J_i @ i.velocity + row.J_j @ j.velocity
        return speed, row.J_i @ i_rate + row.J_j @ j_rate - row.gamma, row.gamma

    _, rate, second = twice(phi, t)
    return rate, second, {k: left(k) for k in constraint.PRIMITIVES}


@cache
def compared(seed):
    """`along_curves` for one set of random numbers."""
    rng = np.random.default_rng(200 + seed)
    data = data_of(*random_numbers(rng))
    coefficients = random_coefficients(rng), random_coefficients(rng)
    return jax.tree.map(np.asarray, along_curves(coefficients, data, jnp.asarray(0.3)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", constraint.PRIMITIVES)
def test_rows_are_the_derivatives_of_the_constraint(kind, seed):
    rate, second, left = compared(seed)
    speed, minus_gamma, gamma = left[kind]
    assert relative_error(speed, rate[kind]) < EXACT
    size = np.max(np.abs(second[kind])) + np.max(np.abs(gamma))
    assert np.max(np.abs(minus_gamma - second[kind])) < EXACT * size
    assert np.max(np.abs(gamma)) > 1e-3  # the comparison would not notice a missing gamma else
