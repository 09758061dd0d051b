"""The joint catalogue: rows, rank, the freedom that each joint leaves, drivers, bad input."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation, random_quaternion, state_of, turn, unit

import stmuav_jax as stm

POINT, OTHER = np.array([0.3, -0.2, 0.5]), np.array([0.7, 0.4, 0.1])
Z = unit([1.0, 2.0, -1.0])
X = unit(np.cross(Z, [0.0, 0.0, 1.0]))
LINK = POINT + 0.4 * X  # in the plane through POINT perpendicular to Z

# joint, rows, and the motions of j relative to i that it leaves: (angular velocity, velocity
# of j's point relative to i), world axes.
NONE = np.zeros(3)
ROLL = [(a, NONE) for a in np.eye(3)]
REVOLVE, SLIDE = [(Z, NONE)], [(NONE, Z)]


def across(axis):
    """Two velocities perpendicular to an axis."""
    return [(NONE, np.cross(axis, a)) for a in ([0.1, 0.2, 0.7], [0.8, -0.1, 0.2])]


JOINTS = {
    "weld": (lambda i, j: stm.weld("J", i, j, point=POINT), 6, []),
    "spherical": (lambda i, j: stm.spherical("J", i, j, point=POINT), 3, ROLL),
    "universal": (
        lambda i, j: stm.universal("J", i, j, point=POINT, axis_i=2 * X, axis_j=3 * Z),
        4,
        [(X, NONE), (Z, NONE)],
    ),
    "revolute": (lambda i, j: stm.revolute("J", i, j, point=POINT, axis=5 * Z), 5, REVOLVE),
    "translational": (lambda i, j: stm.translational("J", i, j, axis=Z, point=POINT), 5, SLIDE),
    "cylindrical": (
        lambda i, j: stm.cylindrical("J", i, j, axis=Z, point=POINT),
        4,
        REVOLVE + SLIDE,
    ),
    "screw": (
        lambda i, j: stm.screw("J", i, j, point=POINT, axis=2 * Z, pitch=0.3),
        5,
        [(Z, 0.3 * Z)],
    ),
    "distance": (
        lambda i, j: stm.distance("J", i, j, point_i=POINT, point_j=OTHER),
        1,
        ROLL + across(OTHER - POINT),
    ),
    "revolute_spherical": (
        lambda i, j: stm.revolute_spherical("J", i, j, point_i=POINT, axis=Z, point_j=LINK),
        2,
        [*ROLL, (NONE, np.cross(Z, X))],
    ),
}
MOVING_POINT = {"distance": OTHER, "revolute_spherical": LINK}


def bodies_at_random(rng):
    return [
        stm.Body(
            name,
            1.0,
            [0.1, 0.1, 0.1],
            com=rng.normal(size=3),
            position=rng.normal(size=3),
            orientation=random_quaternion(rng),
            free=True,
        )
        for name in ("one", "two")
    ]


@eqx.filter_jit
def _equations(system, state, t):
    model = stm.Augmented().prepare(system)
    return model.constraints.equations(t, system.kinematics(state))


def equations_of(system, state=None, t=0.0):
    return _equations(system, system.reference if state is None else state, jnp.asarray(t))


@pytest.mark.parametrize("kind", JOINTS)
def test_rows_rank_and_freedom(kind):
    build, count, free = JOINTS[kind]
    grounded = kind in ("revolute", "distance")
    rng = np.random.default_rng(len(kind))
    bodies = bodies_at_random(rng)
    joint = build("ground" if grounded else "one", "two")
    assert joint.n_rows == count
    system = stm.System(bodies, [joint])
    eq = equations_of(system)
    J = np.asarray(eq.matrix)
    assert J.shape == (count, 12)
    np.testing.assert_allclose(eq.value, 0, atol=1e-14)
    assert np.linalg.matrix_rank(J, tol=1e-6) == count
    found = stm.dynamics.rank(system, system.reference)
    assert (found.rows, found.rank, found.dof, found.redundant) == (count, count, 12 - count, ())
    # the motions that the joint leaves: i moves at random (not ground), j with it and relative
    R = [np_rotation(p) for p in np.asarray(system.reference.p)]
    r = np.asarray(system.reference.r)
    point = MOVING_POINT.get(kind, POINT)
    motions = []
    carried = [] if grounded else [*((a, NONE) for a in np.eye(3)), *((NONE, a) for a in np.eye(3))]
    for w_i, v_i in [*carried, (NONE, NONE)]:
        for w, v in free if not np.any([w_i, v_i]) else [(NONE, NONE)]:
            w_j, at_point = w_i + w, v_i + np.cross(w_i, point - r[0]) + v
            v_j = at_point + np.cross(w_j, r[1] - point)
            motions.append(np.concatenate([v_i, R[0].T @ w_i, v_j, R[1].T @ w_j]))
    motions = np.array(motions).reshape(-1, 12)
    np.testing.assert_allclose(J @ motions.T, 0, atol=1e-12)
    assert np.linalg.matrix_rank(motions, tol=1e-6) == (6 if grounded else 12) - count


class Quadratic(eqx.Module):
    """Motion a t^2."""

    a: Any

    def __call__(self, t):
        return self.a * t**2


def one_joint(joint, *more):
    body = stm.Body("b", 1.0, [0.1, 0.1, 0.1])
    return stm.System([body], [joint, *more])


def hinge(**more):
    return stm.revolute("hinge", "ground", "b", point=NONE, axis=[0, 0, 1], **more)


def rail():
    return stm.translational("rail", "ground", "b", axis=[0, 0, 2])


def test_driven_angle():
    """Positive from body i to body j about z, and any number of turns."""
    for angle in (0.4, -2.0, np.pi, 4.0, 25.0):
        joint, motion = hinge(), Quadratic(jnp.asarray(angle))
        system = one_joint(joint, stm.drive("motor", joint, motion, coordinate="angle"))
        state = state_of([[0, 0, 0]], [turn([0, 0, 1], angle)], None, [[0, 0, 2 * angle]])
        eq = equations_of(system, state, 1.0)
        np.testing.assert_allclose(eq.value, 0, atol=1e-14)
        u = np.concatenate([state.v, state.omega], axis=1).reshape(-1)
        np.testing.assert_allclose(eq.matrix @ u, eq.target, atol=1e-13)
        rate = np.array([0, 0, 0, 0, 0, 2 * angle])
        np.testing.assert_allclose(eq.target, rate)
        # J qddot = gamma for the angular acceleration of the motion
        np.testing.assert_allclose(eq.matrix @ rate, eq.gamma, atol=1e-12)


def test_driven_shift():
    joint = rail()
    system = one_joint(joint, stm.drive("jack", joint, jnp.sin, coordinate="displacement"))
    state = state_of([[0, 0, np.sin(0.3)]], [[1, 0, 0, 0]], [[0, 0, np.cos(0.3)]])
    eq = equations_of(system, state, 0.3)
    np.testing.assert_allclose(eq.value, 0, atol=1e-15)
    np.testing.assert_allclose(eq.target[-1], np.cos(0.3))
    u_rate = np.array([0, 0, -np.sin(0.3), 0, 0, 0])
    np.testing.assert_allclose(eq.matrix @ u_rate, eq.gamma, atol=1e-15)


@pytest.mark.parametrize(
    ("joint", "coordinate", "words"),
    [
        (
            hinge(),
            "displacement",
            "'motor' prescribes the displacement of joint 'hinge', but a revolute",
        ),
        (rail(), "angle", "but a translational joint does not leave it free"),
        (stm.spherical("ball", "ground", "b", point=NONE), "angle", "revolute, cylindrical"),
    ],
)
def test_a_driver_needs_a_free_coordinate(joint, coordinate, words):
    with pytest.raises(stm.ModelError, match=words):
        stm.drive("motor", joint, lambda t: t, coordinate=coordinate)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: stm.revolute("J", "a", "b", point=NONE, axis=NONE), "'J' has zero length"),
        (lambda: stm.cylindrical("J", "a", "b", axis=[0, np.nan, 1]), "'J' must be finite"),
        (lambda: stm.revolute("J", "a", "b", point=NONE, axis=[0, 1]), r"'J' must have shape \(3,\)"),
        (
            lambda: stm.universal("J", "a", "b", point=NONE, axis_i=NONE, axis_j=Z),
            "axis_i of joint 'J' has zero length",
        ),
        (
            lambda: stm.universal("J", "a", "b", point=NONE, axis_i=[1, 0, 0], axis_j=[1, 1, 0]),
            "'J' must be perpendicular, but they are 45 degrees",
        ),
        (
            lambda: stm.screw("J", "a", "b", point=NONE, axis=Z, pitch=0.0),
            "pitch of joint 'J' must not be zero; a joint without one is revolute",
        ),
        (lambda: stm.spherical("J", "a", "a", point=NONE), "'J' joins body 'a' to itself"),
        (lambda: stm.spherical("J", "a", "b", point=[0, np.inf, 0]), "point of joint 'J' must be fin"),
        (
            lambda: stm.distance("J", "a", "b", point_i=POINT, point_j=POINT),
            "length of joint 'J' must be positive",
        ),
        (
            lambda: stm.distance("J", "a", "b", point_i=POINT, point_j=OTHER, length=np.nan),
            "length of joint 'J' must be positive",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_refused(build, words):
    with pytest.raises(stm.ModelError, match=words):
        build()
