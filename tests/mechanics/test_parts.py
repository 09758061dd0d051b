"""Bodies made of parts, against closed forms, integrals by sampling, and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation, turn

import stmuav_jax as stm

TURN = turn([1.0, -2.0, 0.7], 0.9)


def test_rod_and_point_mass_of_a_governor():
    """A ball of 5 kg at the end of a rod of 1 kg and 0.6 m, about the rod's other end."""
    body = stm.mechanics.compound(
        "arm",
        stm.mechanics.rod(1.0, [0.0] * 3, [0.6, 0, 0]),
        stm.mechanics.sphere(0.05, [0.6, 0, 0], mass=5.0),
    )
    assert float(body.mass) == pytest.approx(6.0, rel=1e-15)
    np.testing.assert_allclose(body.com, [(0.3 + 5 * 0.6) / 6, 0, 0], rtol=1e-15)
    about_end = body.inertia[1, 1] + body.mass * body.com[0] ** 2
    assert float(about_end) == pytest.approx(0.36 / 3 + 5 * 0.36 + 0.4 * 5 * 0.05**2, rel=1e-14)
    assert float(body.inertia[0, 0]) == pytest.approx(0.4 * 5 * 0.05**2, rel=1e-14)


def points(count=22):
    """Midpoints of a fine grid over the cube [-1, 1]^3."""
    x = (np.arange(count) + 0.5) / count * 2 - 1
    return np.stack(np.meshgrid(x, x, x), axis=-1).reshape(-1, 3)


def integrated(inside, at, R, scale):
    """Volume, centre and tensor of unit density over the points that are inside."""
    cube = points(60)
    kept = cube[inside(cube)] * scale
    cell = np.prod(scale) * (2 / 60) ** 3
    world = at + kept @ R.T
    centre = world.mean(axis=0)
    arm = world - centre
    tensor = cell * (np.sum(arm**2) * np.eye(3) - arm.T @ arm)
    return cell * len(kept), centre, tensor


AT = np.array([0.3, -0.2, 0.5])


@pytest.mark.parametrize("shape", ["box", "sphere", "cylinder", "tube"])
def test_shapes_against_integrals(shape):
    R = np_rotation(TURN)
    if shape == "box":
        found = stm.mechanics.box([0.4, 0.6, 1.0], AT, TURN, density=1.0)
        expected = integrated(lambda x: x[:, 0] < 2, AT, R, np.array([0.2, 0.3, 0.5]))
        np.testing.assert_allclose(found.mass, 0.24, rtol=1e-15)
    elif shape == "sphere":
        found = stm.mechanics.sphere(0.7, AT, density=1.0)
        expected = integrated(lambda x: np.sum(x**2, 1) < 1, AT, R, np.full(3, 0.7))
    else:
        inner = 0.6 if shape == "tube" else 0.0
        ends = AT - R @ [0, 0, 0.9], AT + R @ [0, 0, 0.9]
        found = stm.mechanics.cylinder(*ends, 0.5, inner_radius=0.5 * inner, density=1.0)
        flat = lambda x: np.sum(x[:, :2] ** 2, 1)
        expected = integrated(
            lambda x: (flat(x) < 1) & (flat(x) > inner**2), AT, R, np.array([0.5, 0.5, 0.9])
        )
    volume, centre, tensor = expected
    np.testing.assert_allclose(found.mass, volume, rtol=5e-3)
    np.testing.assert_allclose(found.com, centre, atol=1e-12)
    np.testing.assert_allclose(found.inertia, tensor, atol=1e-2 * np.abs(tensor).max())


def test_a_box_of_two_halves_is_the_whole():
    """Bodies as parts, turned and moved; and mass instead of density."""
    R = np_rotation(TURN)
    half = lambda side: stm.mechanics.compound(
        side, stm.mechanics.box([0.2, 0.6, 1.0], mass=1.5),
        position=AT + R @ [0.1 if side == "right" else -0.1, 0, 0], orientation=TURN,
    )  # fmt: skip
    both = stm.mechanics.compound("both", half("left"), half("right"))
    whole = stm.mechanics.compound("whole", stm.mechanics.box([0.4, 0.6, 1.0], AT, TURN, mass=3.0))
    for name in ("mass", "com", "inertia"):
        np.testing.assert_allclose(getattr(both, name), getattr(whole, name), atol=1e-15)


def test_derivatives_by_numbers_of_the_parts():
    def tensor(x):
        parts = (
            stm.mechanics.rod(x[0], [0.0] * 3, [x[1], 0, 0]),
            stm.mechanics.point_mass(x[2], [0.1, x[3], 0.2]),
        )
        return stm.mechanics.compound("arm", *parts).inertia

    x, h = jnp.array([1.0, 0.6, 0.3, 0.2]), 1e-5
    J = jax.jit(jax.jacfwd(tensor))(x)
    at = jax.jit(tensor)
    for k, step in enumerate(h * np.eye(4)):
        np.testing.assert_allclose(J[..., k], (at(x + step) - at(x - step)) / (2 * h), atol=1e-10)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: stm.mechanics.compound("arm"), "'arm' needs at least one part"),
        (
            lambda: stm.mechanics.compound("arm", stm.mechanics.rod(1.0, [0.0] * 3, [1.0, 0, 0])),
            "rod without thickness",
        ),
        (lambda: stm.mechanics.rod(1.0, [1.0, 0, 0], [1.0, 0, 0]), "two ends of a rod must differ"),
        (lambda: stm.mechanics.sphere(0.1), "A sphere needs either a mass or a density"),
        (lambda: stm.mechanics.box([1.0, 0, 1], mass=1.0), "sizes of a box must be positive"),
        (lambda: stm.mechanics.point_mass(-1.0), "mass of a point mass must be positive"),
        (
            lambda: stm.mechanics.cylinder([0.0] * 3, [0, 0, 1.0], 0.1, inner_radius=0.2, mass=1.0),
            "inner radius of a cylinder must be less",
        ),
    ],
)
def test_senseless_parts_are_refused(build, words):
    with pytest.raises(stm.ModelError, match=words):
        build()
