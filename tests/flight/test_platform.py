"""A Stewart platform moved to a pose by tuned forces, and its load identified from a record."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import G, stewart
from scipy.interpolate import CubicSpline
from scipy.optimize import root
from scipy.spatial.transform import Rotation
from test_any_mechanism import static_forces
from test_any_tuning import fitted

import stmuav_jax as stm

LENGTHS = [f"T{k}.displacement" for k in range(6)]


@pytest.fixture(scope="module")
def platform():
    system, feet, heads = stewart()
    space = stm.TreeSpace(system, independent=LENGTHS)
    return space, space.from_state(system.reference), feet, heads


def potential(feet, heads, longer):
    """Potential energy of all bodies with the legs longer by so much, by the platform's geometry."""
    centre, length = np.array([0.0, 0.0, 1.25]), np.linalg.norm(heads - feet, axis=1)
    ends = lambda pose: centre + pose[:3] + Rotation.from_rotvec(pose[3:]).apply(heads - centre)
    miss = lambda pose: np.linalg.norm(ends(pose) - feet, axis=1) - length - longer
    pose = root(miss, np.zeros(6), tol=1e-13).x
    legs = ends(pose) - feet
    # barrels a quarter of the first length above their feet, rods as far below their heads
    quarter = 0.25 * (legs[:, 2] / np.linalg.norm(legs, axis=1)) * length
    rods = ends(pose)[:, 2] - quarter
    return G * (20.0 * (1.25 + pose[2]) + 0.8 * np.sum(quarter) + 0.5 * np.sum(rods))


@pytest.mark.slow
def test_a_platform_is_moved_to_a_pose(platform):
    """Six forces after which it rests in another pose; their work has lifted all bodies."""
    space, x, feet, heads = platform
    longer = np.array([0.03, 0.01, -0.02, 0.0, 0.02, 0.04])
    target = space.retract(x, jnp.concatenate([jnp.asarray(longer), jnp.zeros(6)]))
    tuning = stm.flight.tune_inputs(
        space, [stm.flight.end_at(space, target)], start=x, duration=0.3,
        values=static_forces(feet, heads), knots=4, outputs_per_segment=1,
    )  # fmt: skip
    motion = tuning.motion(tuning.search().values)
    end = jax.tree.map(lambda leaf: leaf[-1], motion.points)
    np.testing.assert_allclose(space.difference(end, target), 0.0, atol=1e-8)
    power = np.sum(np.asarray(motion.inputs * motion.points.u), axis=1)
    work = CubicSpline(motion.ts, power).integrate(0.0, 0.3)
    lifted = potential(feet, heads, longer) - potential(feet, heads, np.zeros(6))
    assert work == pytest.approx(lifted, rel=1e-6)


@pytest.mark.slow
def test_a_load_on_the_platform_is_identified(platform):
    """Mass and centre of mass of the platform, from the lengths of its legs."""
    space, x, feet, heads = platform
    pushed = static_forces(feet, heads) * np.array([1.15, 0.95, 1.0, 1.1, 0.9, 1.05])
    names = [name for name, _ in stm.inputs_of(space.system).names]
    predict = stm.flight.motion_model(
        lambda q: stewart(mass=q[0], com=q[1:])[0], x, np.linspace(0.0, 0.4, 21), LENGTHS,
        inputs=dict(zip(names, pushed, strict=True)), space=space,
    )  # fmt: skip
    truth = np.array([20.0, 0.0, 0.0, 0.0])
    exact, found = fitted(
        predict, truth, np.array([2.0, 0.05, 0.05, 0.05]), np.full(6, 5e-4), ["mass", *"xyz"]
    )
    np.testing.assert_allclose(exact.values, truth, atol=1e-8)
    assert found.within(truth, 4.0)
    assert 0.6 < found.reduced_chi_square < 1.4
