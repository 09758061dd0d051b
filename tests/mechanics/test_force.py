"""Force elements: loads against hand formulas, potentials, balances, gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation, random_quaternion, state_of, unit

import stmuav_jax as stm
from stmuav_jax.mechanics.forces import _check_frame
from stmuav_jax.mechanics.load import AbstractForce, ActsOn, total_load

COM = {"a": np.array([0.1, -0.2, 0.05]), "b": np.array([-0.3, 0.1, 0.2])}
POINT_A, POINT_B = np.array([0.3, 0.1, -0.4]), np.array([0.2, -0.5, 0.6])
HINGE = np.array([0.2, 0.3, -0.1])
AXIS = np.array([1.0, 1.0, 0.5]) / 1.5


def system_with(*forces, joint=None):
    bodies = [
        stm.Body(n, m, [0.1, 0.1, 0.1], com=COM[n], free=True) for n, m in (("a", 2), ("b", 3))
    ]
    joint = stm.revolute("J", "a", "b", point=HINGE, axis=AXIS) if joint is None else joint
    return stm.System(bodies, [joint], forces)


@pytest.fixture(scope="module")
def state():
    """Random places and velocities; the joint is not closed, which forces must not mind."""
    rng = np.random.default_rng(3)
    p = [random_quaternion(rng) for _ in range(2)]
    return state_of(rng.normal(size=(2, 3)), p, rng.normal(size=(2, 3)), rng.normal(size=(2, 3)))


@eqx.filter_jit
def _load(system, t, state):
    return system.forces[0].load(t, system.kinematics(state))


def load_of(force, state, t=0.0, **more):
    return _load(system_with(force, **more), jnp.asarray(t), state)


class World:
    """World quantities of a state, in NumPy: R, r, w, points and their velocities."""

    def __init__(self, state):
        self.R = [np_rotation(p) for p in np.asarray(state.p)]
        self.r, self.v = np.asarray(state.r), np.asarray(state.v)
        self.w = [R @ o for R, o in zip(self.R, np.asarray(state.omega), strict=True)]

    def arm(self, name, point):
        k = "ab".index(name)
        return self.R[k] @ (point - COM[name])

    def point(self, name, point):
        k, s = "ab".index(name), self.arm(name, point)
        return self.r[k] + s, self.v[k] + np.cross(self.w[k], s)


def check(load, force, moment, potential, power):
    """Compare with world forces and world moments on a and b, given as (2, 3)."""
    np.testing.assert_allclose(load.force[:2], force, rtol=0, atol=1e-13)
    np.testing.assert_allclose(load.moment[:2], moment, rtol=0, atol=1e-13)
    np.testing.assert_allclose(load.potential, potential, rtol=1e-13)
    np.testing.assert_allclose(load.power, power, rtol=1e-12, atol=1e-14)


def test_gravity(state):
    a = np.array([0.5, -1.0, -9.0])
    load = load_of(stm.Gravity(a), state)
    check(load, [2 * a, 3 * a], np.zeros((2, 3)), -(2 * state.r[0] + 3 * state.r[1]) @ a, 0)
    assert not np.any(load.force[2])


@pytest.mark.parametrize("point", [None, POINT_A])
@pytest.mark.parametrize("frame", ["world", "body"])
def test_applied_force(state, frame, point):
    world, value = World(state), np.array([1.0, -2.0, 0.5])
    load = load_of(stm.AppliedForce("a", value, frame=frame, point=point), state)
    force = world.R[0] @ value if frame == "body" else value
    arm = np.zeros(3) if point is None else world.arm("a", point)
    at = world.r[0] + arm
    speed = world.v[0] + np.cross(world.w[0], at - world.r[0])
    check(
        load, [force, 0 * force], [world.R[0].T @ np.cross(arm, force), 0 * arm], 0, force @ speed
    )


@pytest.mark.parametrize("frame", ["world", "body"])
def test_applied_moment(state, frame):
    world, value = World(state), np.array([1.0, -2.0, 0.5])
    load = load_of(stm.AppliedMoment("b", value, frame=frame), state)
    inside = value if frame == "body" else world.R[1].T @ value
    check(load, np.zeros((2, 3)), [0 * value, inside], 0, inside @ state.omega[1])


def test_signals_see_time_and_kinematics(state):
    value = lambda t, kin: t * kin.v[kin.index("b")]
    load = load_of(stm.AppliedForce("a", value), state, t=2.5)
    np.testing.assert_allclose(load.force[0], 2.5 * state.v[1])
    moment = load_of(
        stm.AppliedMoment("a", lambda t, kin: [t, 0.0, 2 * t], frame="body"), state, 3.0
    )
    np.testing.assert_allclose(moment.moment[0], [3, 0, 6], atol=1e-14)


@pytest.mark.parametrize("damping", [0.0, 7.0])
def test_spring_between_bodies(state, damping):
    world = World(state)
    (A, A1), (B, B1) = world.point("a", POINT_A), world.point("b", POINT_B)
    spring = stm.LinearSpringDamper(
        "a", "b", point_i=POINT_A, point_j=POINT_B, stiffness=50.0, damping=damping, length=0.4
    )
    load = load_of(spring, state)
    length = np.linalg.norm(B - A)
    u = (B - A) / length
    rate = u @ (B1 - A1)
    pull = (50 * (length - 0.4) + damping * rate) * u
    moments = [
        world.R[0].T @ np.cross(A - world.r[0], pull),
        world.R[1].T @ np.cross(B - world.r[1], -pull),
    ]
    check(load, [pull, -pull], moments, 25 * (length - 0.4) ** 2, -damping * rate**2)


def test_spring_to_ground(state):
    world, anchor = World(state), np.array([1.0, 2.0, 3.0])
    spring = stm.LinearSpringDamper("ground", "b", point_i=anchor, point_j=POINT_B, stiffness=9.0)
    load = load_of(spring, state)
    B = world.point("b", POINT_B)[0]
    np.testing.assert_allclose(load.force[1], -9 * (B - anchor), atol=1e-13)
    np.testing.assert_allclose(load.force[2], 9 * (B - anchor), atol=1e-13)
    assert not np.any(load.force[0])


def test_torsional_spring(state):
    """On a closed joint: the moment on a is k (phi - phi_0) + c rate about the common axis."""
    phi, rate = 2.0, -3.0
    quarter = np.concatenate([[np.cos(phi / 2)], np.sin(phi / 2) * AXIS])
    p = np.asarray(stm.rotation.product(state.p[0], jnp.asarray(quarter)))
    R = np_rotation(p)
    R_a = np_rotation(np.asarray(state.p[0]))
    w_a = R_a @ np.asarray(state.omega[0])
    closed = state_of(
        state.r, [state.p[0], p], state.v, [state.omega[0], R.T @ (w_a + rate * R_a @ AXIS)]
    )
    spring = stm.TorsionalSpringDamper("J", stiffness=5.0, damping=0.3, angle=0.5)
    load = load_of(spring, closed)
    moment = (5 * (phi - 0.5) + 0.3 * rate) * (R_a @ AXIS)
    check(
        load, np.zeros((2, 3)), [R_a.T @ moment, -R.T @ moment], 2.5 * (phi - 0.5) ** 2, -0.3 * rate**2
    )  # fmt: skip


def test_joint_damping(state):
    """Sliding acts on the velocity of b's point relative to a, along a's axis; turning on all."""
    joint = stm.cylindrical("J", "a", "b", axis=AXIS, point=HINGE)
    load = load_of(stm.JointDamping("J", turning=0.7, sliding=4.0), state, joint=joint)
    world = World(state)
    z = world.R[0] @ AXIS
    (A, A1), (B, B1) = world.point("a", HINGE), world.point("b", HINGE)
    slip = z @ (B1 - A1 - np.cross(world.w[0], B - A))
    drag, spin = 4 * slip * z, 0.7 * (world.w[1] - world.w[0])
    moments = [
        world.R[0].T @ (np.cross(B - world.r[0], drag) + spin),
        world.R[1].T @ (np.cross(B - world.r[1], -drag) - spin),
    ]
    loss = -4 * slip**2 - 0.7 * np.sum((world.w[1] - world.w[0]) ** 2)
    check(load, [drag, -drag], moments, 0, loss)


SAME = [[1.0, 0, 0, 0]] * 2


def pull_on_a(x, length, damping=0.0, stiffness=50.0):
    """Force on a [N] and potential [J] of a spring between centres of mass b - a = x[:3]."""
    spring = stm.LinearSpringDamper(
        "a", "b", point_i=COM["a"], point_j=COM["b"],
        stiffness=stiffness, damping=damping, length=length,
    )  # fmt: skip
    none = jnp.zeros(3)
    state = stm.State(
        jnp.stack([none, x[:3]]), jnp.asarray(SAME), jnp.stack([none, x[3:]]), jnp.zeros((2, 3))
    )
    load = spring.load(jnp.zeros(()), system_with(spring).kinematics(state))
    return load.force[0], load.potential, load.power


of_spring = jax.jit(lambda x, *numbers: pull_on_a(x, *numbers)[0])
# forward and reverse mode; and the potential's two derivatives
ahead, back = jax.jit(jax.jacfwd(of_spring)), jax.jit(jax.jacrev(of_spring))
slope = jax.jit(jax.grad(lambda x, *numbers: pull_on_a(x, *numbers)[1]))
curvature = jax.jit(jax.hessian(lambda x, *numbers: pull_on_a(x, *numbers)[1]))


@pytest.mark.parametrize("size", [0.0, 1e-120, 1e-9, 0.3])
def test_a_spring_without_a_length_is_linear(size):
    x = jnp.array([size, -2 * size, 0.5 * size, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(of_spring(x, 0.0), 50 * x[:3], rtol=1e-15)
    for J in (ahead(x, 0.0), back(x, 0.0)):
        np.testing.assert_allclose(J, np.hstack([50 * np.eye(3), np.zeros((3, 3))]), atol=1e-13)
    np.testing.assert_allclose(slope(x, 0.0)[:3], 50 * x[:3], rtol=1e-14)
    np.testing.assert_allclose(curvature(x, 0.0)[:3, :3], 50 * np.eye(3), atol=1e-12)


@pytest.mark.parametrize("size", [1e-120, 1e-9, 0.3, 2.0])
def test_derivatives_of_a_spring_with_a_length(size):
    """k (I - l (I - u u^T) / |d|), and c u u^T of the damper."""
    u = unit([1.0, -2.0, 0.5])
    x = jnp.concatenate([size * u, jnp.zeros(3)])
    stiff = 50 * (np.eye(3) - 0.4 * (np.eye(3) - np.outer(u, u)) / size)
    expected = np.hstack([stiff, 3 * np.outer(u, u)])
    for J in (ahead(x, 0.4, 3.0), back(x, 0.4, 3.0)):
        np.testing.assert_allclose(J, expected, rtol=1e-12, atol=1e-12 * np.abs(stiff).max())


@pytest.mark.parametrize("length", [0.0, 0.3])
def test_a_damper_where_its_ends_meet(length):
    """Straight through the point: the force before, there and after is c times the velocity."""
    v = np.array([0.3, -1.0, 2.0])
    at = lambda t: pull_on_a(jnp.asarray([*(t * v), *v]), length, 3.0, 0.0)
    for t in (-1e-3, 0.0, 1e-3):
        force, potential, power = at(t)
        np.testing.assert_allclose(force, 3 * v, rtol=1e-14)
        np.testing.assert_allclose([potential, power], [0.0, float(-3 * v @ v)], atol=1e-13)
    if length == 0:
        J = np.asarray(ahead(jnp.zeros(6), 0.0, 3.0))
        np.testing.assert_allclose(J, np.hstack([50 * np.eye(3), 3 * np.eye(3)]))


def test_a_spring_with_a_length_has_no_derivative_where_its_ends_meet():
    """The force jumps there: NaN, not a number made up; its value is left out, not NaN."""
    force, potential, _ = pull_on_a(jnp.zeros(6), 0.3)
    assert not np.any(force)
    assert float(potential) == pytest.approx(25 * 0.3**2)
    assert np.all(np.isnan(np.diagonal(ahead(jnp.zeros(6), 0.3)[:, :3])))
    assert np.all(np.isnan(np.diagonal(back(jnp.zeros(6), 0.3)[:, :3])))
    # with respect to numbers of the spring it has
    stiffness = jax.grad(lambda k: pull_on_a(jnp.zeros(6), 0.3, 0.0, k)[1])(50.0)
    assert float(stiffness) == pytest.approx(0.5 * 0.3**2)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: stm.Gravity([0, 0, np.nan]), "gravity must be finite"),
        (lambda: stm.AppliedMoment("a", [0, np.nan, 0]), "moment on body 'a' must be finite"),
        # by itself: the type check that the tests switch on refuses the word earlier
        (lambda: _check_frame("tool"), "must be 'world' or 'body', not 'tool'"),
        (lambda: stm.LinearSpringDamper("a", "a", stiffness=1.0), "joins body 'a' to itself"),
        (lambda: stm.LinearSpringDamper("a", "", stiffness=1.0), "needs two bodies"),
        (lambda: stm.LinearSpringDamper("a", "b", stiffness=1.0, length=np.inf), "length of the"),
        (
            lambda: stm.LinearSpringDamper("a", "b", stiffness=-1.0),
            "stiffness .*'a' and 'b' must not",
        ),
        (lambda: stm.TorsionalSpringDamper("J", stiffness=np.nan), "torsional spring in joint 'J'"),
        (
            lambda: stm.TorsionalSpringDamper("J", stiffness=1.0, damping=-1.0),
            "must not be negative",
        ),
        (lambda: stm.JointDamping("J", sliding=-1.0), "joint 'J' must not be negative"),
    ],
)
def test_bad_input_is_refused(build, words):
    with pytest.raises(stm.ModelError, match=words):
        build()


@pytest.mark.parametrize(
    "build",
    [
        lambda: stm.AppliedForce("a", [0, 0, 1], point=[0, np.nan, 0]),
        lambda: stm.AppliedForce("a", [0, 0, 1], point=[0, 1]),
        lambda: stm.Gravity([0, -9.81]),
        lambda: stm.LinearSpringDamper("a", "b", point_i=[0, 1], stiffness=1.0),
        lambda: stm.LinearSpringDamper("a", "b", stiffness=[1.0, 2.0]),
    ],
)
def test_bad_shapes_and_points_are_refused_in_the_users_words(build):
    with pytest.raises(stm.ModelError, match=r"must (be finite|have shape)"):
        build()


# --- functions that a user writes, and forces of a user's own


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (
            lambda: stm.AppliedForce("a", lambda t: jnp.zeros(3)),
            r"AppliedForce: the force on body 'a' .* two arguments, .*lambda t, kin",
        ),
        (
            lambda: stm.uav.AirframeDrag("a", linear=[1.0] * 3, wind=lambda: 0.0),
            "wind on body 'a'",
        ),
    ],
)
def test_functions_of_other_arguments_are_refused_as_they_are_given(build, words):
    with pytest.raises(stm.ModelError, match=words):
        build()


class Crooked(AbstractForce):
    """A user's force that forgets ground."""

    rows: int = eqx.field(static=True)

    def acts_on(self):
        return ActsOn(bodies=("a",))

    def load(self, t, kin):  # pyright: ignore[reportIncompatibleMethodOverride]
        if not self.rows:
            return None
        force = jnp.zeros((self.rows, 3))
        return stm.mechanics.Load(force, force, jnp.zeros(()), jnp.zeros(()))


@pytest.mark.parametrize(
    ("force", "words"),
    [
        (
            stm.AppliedForce("a", lambda t, kin: jnp.zeros(2)),
            r"'a' must have shape \(3,\), .*\(2,\)",
        ),
        (stm.AppliedForce("b", lambda t, kin: None), "'b' must be numbers .* returns NoneType"),
        (stm.AppliedForce("b", lambda t, kin: [1.0, [2.0], 3.0]), "'b' must be numbers .* list"),
        (Crooked(2), r"load of Crooked on a must be .* shape \(3, 3\).* shape \(2, 3\)"),
        (Crooked(0), "load of Crooked on a must be a Load .* it is none"),
    ],
)
def test_loads_of_other_shapes_are_refused_where_they_are_traced(state, force, words):
    kin = system_with(force).kinematics(state)
    with pytest.raises(stm.ModelError, match=words):
        total_load((stm.Gravity(), force), jnp.zeros(()), kin)


def test_a_formulation_says_which_force_is_of_another_shape():
    bad = stm.System(
        [stm.Body("a", 1.0, [1.0] * 3, free=True)],
        forces=[stm.AppliedForce("a", lambda t, kin: jnp.zeros(2))],
    )
    with pytest.raises(stm.ModelError, match="AppliedForce: the force on body 'a' must have shape"):
        stm.dynamics.evaluate(bad, bad.reference, formulation=stm.Augmented())
