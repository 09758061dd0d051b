"""Bricard's linkage, problem A04 of the IFToMM library of computational benchmarks.

Five uniform rods of 1 m and 1 kg lie along edges of a cube, from (0, 0, 0) by (1, 0, 0),
(1, -1, 0), (1, -1, 1), (0, -1, 1) to (0, 0, 1); the sixth edge is ground. Each of the six corners
is a revolute joint across its two edges; g = 9.81 m/s^2 along -y, from rest, 10 s. One of the
thirty rows depends on the others wherever the linkage closes, and nowhere else, so one degree of
freedom is left. With a cylindrical joint in the last corner the same motion has 29 rows.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import attitude, scene

import stmuav_jax as stm

CORNERS = np.array(
    [(0, 0, 0), (1, 0, 0), (1, -1, 0), (1, -1, 1), (0, -1, 1), (0, 0, 1)], dtype=float
)
AXES = [(0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)]
THIN = 1e-3  # kg m^2, along a rod
TIMES = np.linspace(0.0, 10.0, 21)


def bricard(last=stm.revolute) -> stm.System:
    """The linkage, with the joint of its last corner."""
    rods = np.diff(CORNERS, axis=0)
    bodies = [
        stm.Body(
            f"rod{k}",
            1.0,
            tuple((1 - np.abs(rod)) / 12 + THIN * np.abs(rod)),
            position=tuple(CORNERS[k] + rod / 2),
        )
        for k, rod in enumerate(rods)
    ]
    names = ["ground", *(body.name for body in bodies), "ground"]
    kinds = [stm.revolute] * 5 + [last]
    joints = [
        kind(f"R{k}", names[k], names[k + 1], point=tuple(CORNERS[k]), axis=AXES[k])
        for k, kind in enumerate(kinds)
    ]
    return stm.System(bodies, joints, [stm.Gravity((0.0, -9.81, 0.0))])


def corner(run: stm.Run) -> np.ndarray:
    """The fourth corner, at the end of the third rod (k, 3) [m]."""
    arm = (CORNERS[3] - CORNERS[2]) / 2
    return np.asarray(run.states.r)[:, 2] + attitude(run, 2).apply(arm)


@pytest.fixture(scope="module")
def run() -> stm.Run:
    """10 s with the default formulation and tolerances."""
    system = bricard()
    return stm.simulate(scene(system, t1=10.0, save_every=0.5), throw=False)


@pytest.fixture(scope="module")
def twin() -> stm.Run:
    """The same motion without a dependent row, at the tightest tolerance in use."""
    system = bricard(stm.cylindrical)
    return stm.simulate(
        scene(system, t1=10.0, save_every=0.5), method=stm.Method(rtol=1e-12, atol=1e-12)
    )


def test_one_row_depends_on_the_others(run: stm.Run, twin: stm.Run) -> None:
    """Exact class."""
    assert (run.certificate.rows, run.certificate.rank) == (30, 29)
    assert run.certificate.redundant
    assert (twin.certificate.rows, twin.certificate.rank) == (29, 29)


def test_the_dependent_row_costs_no_steps_and_no_energy(run: stm.Run) -> None:
    """Demanded: 300 attempts and 1e-7 J; with all rows at the stages it took 9,031 and 7e-5 J."""
    assert run.successful
    assert run.certificate.accepted_steps + run.certificate.rejected_steps <= 300
    assert run.certificate.energy_error <= 1e-7
    assert run.certificate.position_violation <= 1e-12


def test_it_moves_as_without_the_dependent_row(run: stm.Run, twin: stm.Run) -> None:
    """Solver class: the corner to 1e-7 m through all of 10 s."""
    assert np.ptp(corner(twin)[:, 1]) > 0.5
    np.testing.assert_allclose(corner(run), corner(twin), rtol=0, atol=1e-7)


def test_rows_are_chosen_by_data() -> None:
    """No row acts that depends on others, whichever it is, off the manifold too."""
    import jax

    system, how = bricard(), stm.Tree(redundant=True)
    model = how.prepare(system)
    x = how.to_vector(model, system.reference)
    at_step = jax.jit(lambda x: how.at_step(model, jnp.zeros(()), x).kept)
    kept = np.asarray(at_step(x))
    assert kept.sum() == len(kept) - 1
