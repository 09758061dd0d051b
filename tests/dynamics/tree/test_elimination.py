"""Branch by branch against the same equations solved as dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import forked

import stmuav_jax as stm
from stmuav_jax.dynamics.tree.coordinates import split_vector
from stmuav_jax.dynamics.tree.motion import (
    branch_columns,
    composite_inertia,
    compute_motion,
    eliminate_branches,
    first_solution,
    has_small_blocks,
    mass_matrix,
    right_inverse_branches,
    wrenches_by_frame,
)
from stmuav_jax.dynamics.tree.topology import find_supported, motion_columns
from stmuav_jax.math.linalg import right_inverse, solve_saddle


@pytest.mark.slow
@pytest.mark.parametrize("floating", [True, False])
def test_same_as_dense(floating):
    system = forked(floating)
    model = stm.Tree().prepare(system)
    parameters, tree = model.parameters, model.parameters.tree
    rng = np.random.default_rng(3)
    x = stm.Tree().to_vector(model, system.reference)
    x = x + 0.3 * rng.normal(size=x.shape)
    wide = len(motion_columns(tree).frame)
    J = jnp.asarray(rng.normal(size=(3, wide)))
    gamma = jnp.asarray(rng.normal(size=3))
    loads = jnp.asarray(rng.normal(size=(2, 3, system.n_bodies)))
    base = 6 * tree.floating
    h = jnp.asarray(rng.normal(size=base + wide))
    assert has_small_blocks(tree, 3)

    @jax.jit
    def both(x):
        moving = compute_motion(parameters, split_vector(tree, x))
        total = composite_inertia(parameters, moving, wrenches_by_frame(tree, moving, *loads))
        M = mass_matrix(tree, moving.S, total)
        all_J = jnp.concatenate([jnp.zeros((3, base)), J], axis=1)
        by_branch = lambda J, gamma: eliminate_branches(tree, moving.S, total, J, gamma, h)
        solved = lambda J, gamma: first_solution(tree, by_branch(J, gamma))
        ours = solved(J, gamma)
        dense = solve_saddle(M, all_J, -h, gamma, redundant=False)
        G = right_inverse_branches(tree, moving.S, total, J)
        free = solved(J[:0], gamma[:0])[0]
        return ours, dense, G, right_inverse(M, all_J, redundant=False)[base:], M @ free + h

    ours, dense, G, G_dense, left = both(x)
    for found, expected in zip(ours, dense, strict=True):
        np.testing.assert_allclose(
            found, expected, rtol=1e-10, atol=1e-10 * np.max(np.abs(expected))
        )
    np.testing.assert_allclose(G, G_dense, rtol=1e-10, atol=1e-10 * np.max(np.abs(G_dense)))
    np.testing.assert_allclose(left, 0, atol=1e-10 * np.max(np.abs(h)))


def test_branches_share_no_frame():
    tree = stm.Tree().prepare(forked(False)).parameters.tree
    frame, table, supported = motion_columns(tree).frame, branch_columns(tree), find_supported(tree)
    own = [{int(frame[k]) for k in row if k < len(frame)} for row in table]
    assert sorted(map(len, own)) == [1, 3]
    for f in own[0]:
        for g in own[1]:
            assert not supported[f, g]
            assert not supported[g, f]


def test_long_branches_are_left_to_a_library():
    system = stm.make_scene("uav_tracker", 2).system
    tree = stm.Tree().prepare(system).parameters.tree
    assert has_small_blocks(tree, 6)
    assert not has_small_blocks(tree, 7)
    bodies = [stm.Body(f"b{k}", 1.0, [0.1] * 3, position=[k, 0, 0]) for k in range(7)]
    names = [stm.GROUND, *(f"b{k}" for k in range(7))]
    joints = [
        stm.revolute(f"r{k}", names[k], names[k + 1], point=[k - 0.5, 0, 0], axis=[0, 0, 1])
        for k in range(7)
    ]
    parameters = stm.Tree().prepare(stm.System(bodies, joints)).parameters
    assert not has_small_blocks(parameters.tree, 0)
