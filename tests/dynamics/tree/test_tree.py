"""Relative coordinates: the same motion as maximal coordinates, on every kind of joint."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import inertia_of, random_quaternion, relative_error, unit

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.stabilisation import Unstabilised

X, Y, Z = np.eye(3)
SAME = 1e-11  # round-off of two formulations, relative to the largest entry

KINDS = {
    "weld": lambda *n, at: stm.weld(*n, point=at),
    "spherical": lambda *n, at: stm.spherical(*n, point=at),
    "universal": lambda *n, at: stm.universal(
        *n, point=at, axis_i=unit(X + Y), axis_j=unit(X - Y + Z)
    ),
    "revolute": lambda *n, at: stm.revolute(*n, point=at, axis=X + 2 * Y),
    "translational": lambda *n, at: stm.translational(*n, axis=Y - Z, point=at),
    "cylindrical": lambda *n, at: stm.cylindrical(*n, axis=X - Z, point=at),
    "distance": lambda *n, at: stm.distance(*n, point_i=at, point_j=at + 0.3 * Z),
    "revolute_spherical": lambda *n, at: stm.revolute_spherical(
        *n, point_i=at, axis=Z, point_j=at + 0.3 * unit(X - Y)
    ),
    "screw": lambda *n, at: stm.screw(*n, point=at, axis=X + Y - Z, pitch=-0.07),
}


def zoo(*, backwards=False, grounded=True):
    """One chain with every kind of joint, its bodies and joints at random places."""
    rng = np.random.default_rng(5)
    kinds = list(KINDS)
    bodies = [
        stm.Body(
            f"b{k}",
            1 + rng.random(),
            inertia_of(rng),
            com=0.05 * rng.normal(size=3),
            position=[0.4 * k, 0.1 * rng.normal(), 0.1 * rng.normal()],
            orientation=random_quaternion(rng),
            free=not grounded and k == 0,
        )
        for k in range(len(kinds) + 1)
    ]
    joints = [stm.universal("root", "ground", "b0", point=0.1 * Y, axis_i=X, axis_j=Z)]
    for k, kind in enumerate(kinds):
        ends = (f"b{k}", f"b{k + 1}")
        at = np.array([0.4 * k + 0.2, 0.05, 0.02])
        joints.append(KINDS[kind](kind, *(ends[::-1] if backwards else ends), at=at))
    joints = joints if grounded else joints[1:]
    wind = stm.AppliedForce("b3", (1.0, 2.0, 3.0), point=(0.1, 0.0, 0.2))
    return stm.System(bodies, joints, [stm.Gravity(), wind])


def at_random(system, seed):
    """A random consistent state away from the reference posture."""
    rng = np.random.default_rng(seed)
    n, rest = system.n_bodies, system.reference
    turned = jax.vmap(stm.rotation.product)(
        rest.p,
        jax.vmap(stm.rotation.from_rotation_vector)(jnp.asarray(0.1 * rng.normal(size=(n, 3)))),
    )
    v, omega = jnp.asarray(rng.normal(size=(n, 3))), jnp.asarray(3 * rng.normal(size=(n, 3)))
    r = rest.r + 0.02 * rng.normal(size=(n, 3))
    return stm.assemble(system, stm.State(r, turned, v, omega)).state


def swarm():
    """Two free bodies without any joint, and a pendulum."""
    bodies = [
        stm.Body(name, 1.0, [0.1, 0.2, 0.15], com=[0.1, 0, 0], position=[k, 0, 0], free=k < 2)
        for k, name in enumerate(("one", "two", "bob"))
    ]
    return stm.System(
        bodies, [stm.spherical("pin", "ground", "bob", point=[2, 0, 1])], [stm.Gravity()]
    )


SYSTEMS = {
    "zoo": zoo,
    "floating zoo backwards": lambda: zoo(grounded=False, backwards=True),
    "swarm": swarm,
    "uav_tracker": lambda: stm.make_scene("uav_tracker", 2).system,
    "tracker": lambda: stm.make_scene("tracker", 1).system,
}


@pytest.fixture(scope="module", params=list(SYSTEMS))
def both(request):
    """System, state, evaluations by maximal and by relative coordinates, and the state back."""
    system = SYSTEMS[request.param]()
    state = at_random(system, 3)
    t = jnp.asarray(0.1)

    @jax.jit
    def look(state):
        found = [
            stm.dynamics.evaluate(system, state, t, formulation=f)
            for f in (stm.Augmented(), stm.Tree())
        ]
        tree = stm.Tree()
        model = tree.prepare(system)
        x = tree.to_vector(model, state)
        rate, _ = tree.derivative(model, t, x, Unstabilised())
        return found, tree.to_state(model, x), x, rate

    return system, state, *look(state)


def test_the_state_comes_back(both):
    _, state, _, back, _, _ = both
    for name in ("r", "v", "omega"):
        assert relative_error(getattr(back, name), getattr(state, name)) < SAME
    sign = np.sign(np.sum(np.asarray(back.p * state.p), axis=1))
    np.testing.assert_array_equal(sign, 1.0)
    np.testing.assert_allclose(back.p, state.p, atol=1e-13)


def test_accelerations(both):
    one, other = (found.accelerations for found in both[2])
    assert relative_error(other.v_rate, one.v_rate) < SAME
    assert relative_error(other.omega_rate, one.omega_rate) < SAME


def test_reactions_at_every_joint(both):
    """Multipliers differ, being those of other rows; the wrenches do not."""
    one, other = (found.reactions for found in both[2])
    size = 1 + np.max(np.abs(one.force), initial=0.0)
    assert np.max(np.abs(one.force - other.force), initial=0.0) < SAME * size
    assert np.max(np.abs(one.moment - other.moment), initial=0.0) < SAME * size


def test_rates_of_coordinates_move_the_bodies(both):
    """A small step of the coordinates moves the state by velocities and accelerations."""
    system, state, found, _, x, rate = both
    tree = stm.Tree()
    model = tree.prepare(system)
    h = 1e-6
    to_state = jax.jit(lambda x: tree.to_state(model, x))
    before, after = (to_state(x + s * h * rate) for s in (-1, 1))
    slope = jax.tree.map(lambda a, b: np.asarray(a - b) / (2 * h), after, before)
    p_rate = jax.jit(jax.vmap(stm.rotation.euler_parameter_rate))(state.p, state.omega)
    v_rate, omega_rate = found[0].accelerations.v_rate, found[0].accelerations.omega_rate
    for got, expected in (
        (slope.r, state.v),
        (slope.p, p_rate),
        (slope.v, v_rate),
        (slope.omega, omega_rate),
    ):
        assert relative_error(got, expected) < 1e-7


@pytest.mark.parametrize("name", ["zoo", "uav_tracker"])
def test_projection_leaves_nothing(name):
    system = SYSTEMS[name]()
    tree = stm.Tree()
    model = tree.prepare(system)
    t = jnp.zeros(())
    residuals = jax.jit(lambda x: tree.residuals(model, t, x))
    x = jax.jit(lambda state: tree.to_vector(model, state))(at_random(system, 4))
    off = x + 1e-5 * np.random.default_rng(1).normal(size=x.shape)
    before = residuals(off)
    end, left = jax.jit(lambda x: tree.project(model, t, x, 3))(off)
    assert before.position > 1e-7
    assert left.position < 1e-14
    assert left.velocity < 1e-12
    assert left.norm < 1e-14
    again = residuals(end)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(left), strict=True):
        assert abs(a - b) < 1e-13
    # it is near: not further than the disturbance
    assert float(jnp.max(jnp.abs(end - x))) < 1e-3


def test_the_uavs_tree():
    system = stm.make_scene("uav_tracker", 2).system
    tree = stm.dynamics.spanning_tree(system)
    assert tree.floating
    assert tree.n_velocities == 14
    assert {tree.joints[k] for k in tree.cut} == {"S57", "S67"}
    assert sum(system.joints[k].n_rows for k in tree.cut) == 6
    assert "cut: S57, S67" in str(tree)
    assert "hexacopter_1 (floats)" in str(tree)


@pytest.mark.parametrize(
    ("name", "case", "velocities", "rows"),
    [("tracker", 1, 8, 6), ("hexacopter", None, 6, 0), ("spin", None, 3, 0)],
)
def test_sizes(name, case, velocities, rows):
    system = stm.make_scene(name, case).system
    tree = stm.dynamics.spanning_tree(system)
    assert tree.n_velocities == velocities
    assert sum(system.joints[k].n_rows for k in tree.cut) == rows


@pytest.mark.parametrize("cut", [("R26", "U47"), ("T12",), ("S57", "U35", "R14")])
def test_another_tree_moves_alike(cut):
    system = stm.make_scene("uav_tracker", 2).system
    state = at_random(system, 8)
    first, second = (
        jax.jit(lambda s, f=f: stm.dynamics.evaluate(system, s, formulation=f))(state)
        for f in (stm.Tree(), stm.Tree(cut=cut))
    )
    chosen = stm.dynamics.spanning_tree(system, cut)
    assert set(cut) <= {chosen.joints[k] for k in chosen.cut}
    assert relative_error(second.accelerations.v_rate, first.accelerations.v_rate) < 1e-10
    assert relative_error(second.reactions.force, first.reactions.force) < 1e-10


def test_an_unknown_joint_cannot_be_cut():
    system = stm.make_scene("tracker", 1).system
    with pytest.raises(stm.ModelError, match=r"no joint 'S75' to cut.*S57"):
        stm.Tree(cut=("S75",)).prepare(system)


@pytest.mark.slow
def test_gradients_of_lengths_and_masses_agree():
    """Forward, reverse and by maximal coordinates: through joint places and inertia."""
    state = at_random(zoo(), 3)

    def bent(numbers, formulation):
        system = zoo()
        joint = system.joints[4]
        moved = joint.point_i + numbers[0] * jnp.asarray(X)
        system_new = jax.tree.map(lambda x: x, system)
        import equinox as eqx

        system_new = eqx.tree_at(
            lambda s: (s.joints[4].point_i, s.bodies.mass),
            system_new,
            (moved, system.bodies.mass * (1 + numbers[1])),
        )
        found = stm.dynamics.evaluate(system_new, state, formulation=formulation)
        return jnp.sum(jnp.sin(found.accelerations.v_rate))

    # a mass scales alike in both; a moved point would open the joint in the one, and not in
    # the other, whose coordinates close it: so only the mass is compared between them
    zero = jnp.zeros(2)
    forward = jax.jit(jax.jacfwd(lambda q: bent(q, stm.Tree())))(zero)
    reverse = jax.jit(jax.grad(lambda q: bent(q, stm.Tree())))(zero)
    maximal = jax.jit(jax.jacfwd(lambda q: bent(q, stm.Augmented())))(zero)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(forward[1], maximal[1], rtol=1e-9)


@pytest.mark.parametrize("distance", [1e4, 1e7])
def test_a_mechanism_on_ground_far_from_the_origin(distance):
    """A double pendulum moves as at the origin, in as many steps, to the round-off of its positions."""

    def run_at(foot):
        size = (0.05, 0.1, 0.1)
        bodies = [
            stm.Body("upper", 1.0, size, position=foot + np.array([-0.5, 0.0, 0.0])),
            stm.Body("lower", 1.0, size, position=foot + np.array([-1.5, 0.0, 0.0])),
        ]
        joints = [
            stm.revolute("foot", "ground", "upper", point=foot, axis=(0.0, 0.0, 1.0)),
            stm.revolute("knee", "upper", "lower", point=foot - np.eye(3)[0], axis=(0.0, 0.0, 1.0)),
        ]
        system = stm.System(bodies, joints, [stm.Gravity((0.0, -9.81, 0.0))])
        return stm.simulate(system, system.reference, t1=1.0, save_every=0.1)

    foot = distance * np.array([1.0, -2.0, 1.0])
    near, far = run_at(np.zeros(3)), run_at(foot)
    off = np.max(np.abs(far.states.r - foot - near.states.r))
    assert off < 1e-10 + 4 * np.spacing(2 * distance)
    assert far.certificate.accepted_steps == near.certificate.accepted_steps
