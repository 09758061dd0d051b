"""Relative coordinates: the same motion as maximal coordinates, on every kind of joint."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    four_bar,
    four_bar_state,
    inertia_of,
    random_quaternion,
    relative_error,
    unit,
)

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.stabilisation import Unstabilised
from stmuav_jax.dynamics.tree import formulation
from stmuav_jax.dynamics.tree.closures import choose_order

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


def zoo(*, floating=False):
    """One chain with every kind of joint, its bodies and joints at random places.

    The one that floats has its joints written from the ends inwards; beside it are another free body and
    a pendulum.
    """
    rng = np.random.default_rng(5)
    kinds = list(KINDS)
    bodies = [
        stm.Body(
            f"b{k}", 1 + rng.random(), inertia_of(rng), com=0.05 * rng.normal(size=3),
            position=[0.4 * k, 0.1 * rng.normal(), 0.1 * rng.normal()],
            orientation=random_quaternion(rng), free=floating and k == 0,
        )
        for k in range(len(kinds) + 1)
    ]  # fmt: skip
    joints = []
    for k, kind in enumerate(kinds):
        ends = (f"b{k}", f"b{k + 1}")
        at = np.array([0.4 * k + 0.2, 0.05, 0.02])
        joints.append(KINDS[kind](kind, *(ends[::-1] if floating else ends), at=at))
    if floating:
        bodies += [
            stm.Body(name, 1.0, [0.1, 0.2, 0.15], com=[0.1, 0, 0], position=[0, 0, 1], free=free)
            for name, free in (("thrown", True), ("bob", False))
        ]
        joints.append(stm.spherical("pin", "ground", "bob", point=[0, 0, 2]))
    else:
        joints = [stm.universal("root", "ground", "b0", point=0.1 * Y, axis_i=X, axis_j=Z), *joints]
    wind = stm.AppliedForce("b3", (1.0, 2.0, 3.0), point=(0.1, 0.0, 0.2))
    return stm.System(bodies, joints, [stm.Gravity(), wind])


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(True, id="floating"),
        pytest.param(False, id="on ground", marks=pytest.mark.slow),
    ],
)
def both(request):
    """A random consistent state, its evaluations by maximal and by relative coordinates, and it back."""
    system = zoo(floating=request.param)
    rows, tree, t = stm.Augmented(), stm.Tree(), jnp.asarray(0.1)
    model, rng = tree.prepare(system), np.random.default_rng(3)
    x = jax.jit(lambda: tree.to_vector(model, system.reference))()
    assert x.shape == (tree.vector_size(model),)
    move = rng.normal(size=x.shape)
    move[: -model.parameters.tree.n_velocities] *= 0.03

    @jax.jit
    def look(x):
        x = jax.lax.fori_loop(0, 8, lambda _, x: tree.project(model, t, x, 1)[0], x)
        state = tree.to_state(model, x)
        found = [stm.dynamics.evaluate(system, state, t, formulation=f) for f in (rows, tree)]
        x = tree.to_vector(model, state)
        rate, _ = tree.derivative(model, t, x, Unstabilised())
        back, slope = jax.jvp(lambda x: tree.to_state(model, x), (x,), (rate,))
        other = rows.prepare(system)
        off = rows.residuals(other, t, rows.to_vector(other, state))
        return state, found, back, slope, off

    *found, off = look(x + move)
    assert max(off.position, off.norm) < 1e-14
    assert off.velocity < 1e-13
    return found


def test_the_state_comes_back(both):
    state, _, back, _ = both
    for name in ("r", "v", "omega"):
        assert relative_error(getattr(back, name), getattr(state, name)) < SAME
    sign = np.sign(np.sum(np.asarray(back.p * state.p), axis=1))
    np.testing.assert_array_equal(sign, 1.0)
    np.testing.assert_allclose(back.p, state.p, atol=1e-13)


def test_accelerations_and_reactions_at_every_joint(both):
    """Multipliers differ, being those of other rows; the wrenches do not."""
    one, other = both[1]
    for name in ("v_rate", "omega_rate"):
        first, second = (getattr(found.accelerations, name) for found in (one, other))
        assert relative_error(second, first) < SAME
    one, other = one.reactions, other.reactions
    size = 1 + np.max(np.abs(one.force), initial=0.0)
    assert np.max(np.abs(one.force - other.force), initial=0.0) < SAME * size
    assert np.max(np.abs(one.moment - other.moment), initial=0.0) < SAME * size


def test_rates_of_coordinates_move_the_bodies(both):
    """Along the rates of the coordinates the state moves by velocities and accelerations."""
    state, found, _, slope = both
    p_rate = jax.jit(jax.vmap(stm.rotation.euler_parameter_rate))(state.p, state.omega)
    rates = found[0].accelerations
    assert relative_error(slope.r, state.v) < SAME
    assert relative_error(slope.p, p_rate) < SAME
    assert relative_error(slope.v, rates.v_rate) < SAME
    assert relative_error(slope.omega, rates.omega_rate) < SAME


def test_the_uavs_tree():
    system = stm.make_scene("uav_tracker", 2).system
    tree = stm.dynamics.spanning_tree(system)
    assert tree.floating
    assert tree.n_velocities == 14
    assert {tree.joints[k] for k in tree.cut} == {"S57", "S67"}
    assert sum(system.joints[k].n_rows for k in tree.cut) == 6
    assert "cut: S57, S67" in str(tree)
    assert "hexacopter_1 (floats)" in str(tree)


@pytest.mark.parametrize("free", ["frame", "camera"])
def test_the_base_of_a_floating_machine_is_the_body_declared_free(free):
    """Not the yoke, which has the most joints: a joint's coordinate leaves the free body where it is."""
    names = ("frame", "yoke", "camera")
    bodies = [stm.Body(name, 1.0, [0.02, 0.03, 0.04], free=name == free) for name in names]
    joints = [stm.revolute("roll", "frame", "yoke", point=-0.1 * Z, axis=X)]
    joints.append(stm.revolute("pitch", "yoke", "camera", point=-0.2 * Z, axis=Y))
    system = stm.System(bodies, joints, [stm.Gravity()]).with_forces()
    tree, k = stm.dynamics.spanning_tree(system), names.index(free)
    assert tree.bodies[tree.root] == free
    assert stm.dynamics.spanning_tree(system, base="yoke").root == 1
    state = stm.state_from_joints(system, {"roll": 0.3, "pitch": -0.4})
    assert jnp.array_equal(state.p[k], system.reference.p[k])
    assert float(jnp.abs(state.p[1, 1:]).max()) > 0.1
    point = stm.TreeSpace(system).from_state(state)
    assert jnp.allclose(point.r, state.r[k])
    text = stm.io.model_to_text(stm.Scene("gimbal", "Gimbal", system, state))
    assert text.count("free = true") == 1
    assert text.split("free = true")[0].rpartition("[bodies.")[2].startswith(free)


@pytest.mark.slow
def test_another_tree_moves_alike():
    """The loop cut at a hinge, and at a universal joint."""
    system = four_bar(redundant=False)
    state = four_bar_state(system, 2.0)
    cuts = [("A",), ("C",)]
    for cut in cuts:
        tree = stm.dynamics.spanning_tree(system, cut)
        assert [tree.joints[k] for k in tree.cut] == [*cut]
    evaluate = lambda s, cut: stm.dynamics.evaluate(system, s, formulation=stm.Tree(cut=cut))
    first, other = jax.jit(lambda s: [evaluate(s, cut) for cut in cuts])(state)
    assert relative_error(other.accelerations.v_rate, first.accelerations.v_rate) < 1e-10
    assert relative_error(other.reactions.force, first.reactions.force) < 1e-10


def test_an_unknown_joint_cannot_be_cut():
    system = stm.make_scene("tracker", 1).system
    with pytest.raises(stm.ModelError, match=r"no joint 'S75' to cut.*S57"):
        stm.Tree(cut=("S75",)).prepare(system)


@pytest.mark.slow
def test_a_mechanism_on_ground_far_from_the_origin():
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
        return stm.simulate(
            system, system.reference, t1=1.0, save_every=0.1, error_estimate=False, analysis=False
        )

    near = run_at(np.zeros(3))
    for distance in (1e4, 1e7):
        foot = distance * np.array([1.0, -2.0, 1.0])
        far = run_at(foot)
        off = np.max(np.abs(far.states.r - foot - near.states.r))
        assert off < 1e-10 + 4 * np.spacing(2 * distance)
        assert far.certificate.accepted_steps == near.certificate.accepted_steps


def make_star(arms, rods):
    """A floating base with arms of rods, the ends of two of which a bar joins."""
    size = (0.1, 0.1, 0.1)
    way = [np.array([np.cos(a), np.sin(a), 0.0]) for a in 2 * np.pi * np.arange(arms) / arms]
    bodies, joints = [stm.Body("base", 2.0, size, free=True)], []
    for a, along in enumerate(way):
        for k in range(rods):
            name, before = f"rod {a} {k}", f"rod {a} {k - 1}" if k else "base"
            bodies.append(stm.Body(name, 1.0, size, position=(k + 0.5) * along))
            axis = (Y, Z)[k % 2]
            joints.append(stm.revolute(f"hinge {a} {k}", before, name, point=k * along, axis=axis))
    bodies.append(stm.Body("bar", 1.0, size, position=rods * (way[0] + way[1]) / 2))
    for a in (0, 1):
        end = f"rod {a} {rods - 1}"
        joints.append(stm.spherical(f"end {a}", end, "bar", point=rods * way[a]))
    return stm.System(bodies, joints, [stm.Gravity()])


def test_the_base_is_eliminated_first_where_that_takes_fewer_products():
    """In a machine whose loops take part in most of its joints, not in one of many branches."""
    for system, base_first in (
        (stm.make_scene("uav_tracker", 2).system, True), (make_star(4, 3), False),
        (stm.make_scene("tracker", 1).system, False),
    ):  # fmt: skip
        model = stm.Tree().prepare(system)
        order = choose_order(model.parameters.tree, model.constraints)
        assert sorted(order) == list(range(model.parameters.tree.n_velocities))
        assert (set(order[:6]) == set(range(6))) == base_first
        assert base_first or order == tuple(sorted(order))[::-1]


@pytest.mark.slow
def test_accelerations_do_not_depend_on_the_order_of_elimination(monkeypatch):
    scene = stm.make_scene("uav_tracker", 2)

    def evaluate():
        found = stm.dynamics.evaluate(scene.system, scene.state0, formulation=stm.Tree())
        return found.accelerations, found.reactions

    first = jax.jit(evaluate)()
    outermost = lambda tree, constraints: tuple(range(tree.n_velocities))[::-1]
    monkeypatch.setattr(formulation, "choose_order", outermost)
    other = jax.jit(lambda: evaluate())()
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(other), strict=True):
        assert relative_error(a, b) < 1e-10
