"""The N-four-bar mechanism, problem A02 of the IFToMM library of computational benchmarks.

The mechanism and its closed form are those of `benchmarks/problems/four_bar.py`. As spatial revolute
joints the loops have dependent rows: three per loop.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import scene, turned_about_z
from problems.four_bar import (
    GRAVITY,
    LONG,
    ROD,
    SPEED,
    THIN,
    TOLERANCES,
    Z,
    closed_form,
    course,
    four_bar,
    kinetic_and_potential,
    missing,
    start,
)

import stmuav_jax as stm

# Closed form for N = 2 by independent code: t [s]; B_0 [m]; its velocity [m/s].
EXACT = {
    1.0: (-0.1950203019494351, -0.9807992056621738, -6.676678036881158, 1.327578325160487),
    4.0: (0.1176161023768086, 0.9930591384513251, 1.069039265028969, -0.1266150491667203),
    10.0: (0.3284581115408154, 0.944518538178601, 1.423051470206944, -0.494868845487043),
}
# EXUDYN's published end of the same run at h = 1.25e-4 s, and how far it is from the closed
# form: 7.3e-7 m and 1.8e-6 m/s, to which the error of our own run comes.
EXUDYN = (0.3284573768, 0.9445187937, 1.423050003, -0.4948670827)
EXUDYN_ERROR = 3e-6
# N = 2: d Bx / d (g, v0), derivatives of the closed form by independent code.
GRADIENT = {
    1.0: (-0.237574240038805, -2.01547144731981),
    4.0: (0.146324848076562, 1.40526354085372),
    10.0: (0.490718878224859, 4.60261031129772),
}


def tip(run: stm.Run) -> np.ndarray:
    """B_0 [m] and its velocity [m/s]: twice those of the first crank's centre (A_0 = 0)."""
    return 2 * np.concatenate([run.states.r[:, 0, :2], run.states.v[:, 0, :2]], axis=1)


@pytest.fixture(scope="module")
def run() -> stm.Run:
    """Two loops for 10 s at tolerances of 1e-9; `simulate` finds the dependent rows itself."""
    system = four_bar(2)
    how = {"t1": 10.0, "save_every": 0.125}
    return stm.simulate(
        scene(system, start(system), **how),
        method=stm.Method(rtol=1e-9, atol=1e-9),
        error_estimate=False,
    )


@pytest.mark.slow
def test_rank_and_redundant_joints(run: stm.Run) -> None:
    """Exact class: 5 rows a revolute, rank 6 n - 1, and joints named that own dependent rows."""
    system = run.scene.system
    found = stm.dynamics.rank(system, run.scene.state0)
    assert (found.rows, found.rank, found.dof) == (35, 29, 1)
    assert found.smallest_singular_value > 0.1
    assert found.redundant
    assert set(found.redundant) <= {joint.name for joint in system.joints}
    certificate = run.certificate
    assert (certificate.rows, certificate.rank) == (found.rows, found.rank)
    assert certificate.redundant == found.redundant


@pytest.mark.slow
def test_tip_follows_the_closed_form(run: stm.Run) -> None:
    """Solver class: 1e-5 m for 10 s at rtol 1e-8; the library's "high precision" is 1e-3."""
    got, expected = tip(run), closed_form(2, run.ts)
    np.testing.assert_allclose(got[:, :2], expected[:, :2], rtol=0, atol=1e-5)
    # speeds are up to 9 times as large as lengths
    np.testing.assert_allclose(got[:, 2:], expected[:, 2:], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_tip_is_where_other_codes_put_it(run: stm.Run) -> None:
    """Published class: exact values to 1e-5 m, EXUDYN's end to its own distance from them."""
    got = tip(run)
    for t, row in EXACT.items():
        k = int(np.argmin(np.abs(run.ts - t)))
        np.testing.assert_allclose(got[k, :2], row[:2], rtol=0, atol=1e-5, err_msg=f"t = {t} s")
        np.testing.assert_allclose(closed_form(2, run.ts)[k], row, rtol=0, atol=1e-11)
    np.testing.assert_allclose(got[-1], EXUDYN, rtol=0, atol=EXUDYN_ERROR)


@pytest.mark.slow
def test_energy_is_kept(run: stm.Run) -> None:
    """1e-3 J; the published limit is 0.1 J, EXUDYN has 1.8e-5 J at h = 1.25e-4 s."""
    assert run.snapshot.kinetic[0] == pytest.approx(1.5, rel=1e-12)
    assert run.certificate.energy_error <= 1e-3
    assert run.certificate.position_violation <= 1e-8


@pytest.mark.slow
def test_cranks_stay_parallel(run: stm.Run) -> None:
    """Solver class: no branch is lost in the singular postures; all angles equal to 1e-6 rad."""
    turned = turned_about_z(run)
    cranks, couplers = turned[:, :3], turned[:, 3:]
    assert np.max(np.ptp(cranks, axis=1)) <= 1e-6
    assert np.max(np.abs(couplers)) <= 1e-6
    # it turned over and over, through many singular postures
    assert np.max(np.abs(cranks)) > 4 * np.pi
    assert np.all(np.isfinite(run.snapshot.accelerations.multipliers))


def passes(loops: int, rtol: float, coupler: float = 1.0) -> None:
    """Solver class: the end is reached, on the parallel branch, with errors as the tolerance."""
    system = four_bar(loops, coupler=coupler)
    path = course(system, start(system), jnp.asarray(rtol))
    assert path.result == diffrax.RESULTS.successful, rtol
    expected = closed_form(loops, LONG, coupler)[:, :2]
    error = np.max(np.abs(2 * path.states.r[:, 0, :2] - expected))
    assert error <= 1e4 * rtol, rtol
    rates = np.asarray(path.states.omega)[:, : loops + 1, 2]
    assert np.max(np.abs(rates - rates[:, :1])) <= 1e-8, rtol


@pytest.mark.slow
def test_every_tolerance_passes_the_singular_postures() -> None:
    """20 s, through some thirty singular postures; six loops are below."""
    for rtol in TOLERANCES:
        passes(1, rtol)


@pytest.mark.slow
def test_six_loops_pass_the_singular_postures() -> None:
    """At the default tolerance; benchmarks/singular.py goes up to forty, at all of them."""
    passes(6, 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("coupler", [1e-4, 1e6])
def test_light_and_heavy_couplers_pass_the_singular_postures(coupler: float) -> None:
    """Masses of bodies up to a million times those of others."""
    for rtol in TOLERANCES[::2]:
        passes(1, rtol, coupler)


@pytest.mark.slow
def test_a_linkage_that_misses_the_singular_posture_goes_on() -> None:
    """Solver class: energy. What is sharp there is not smooth enough to be interpolated."""
    system, state = missing(1e-4)
    for rtol in (TOLERANCES[0], TOLERANCES[-1]):
        path = course(system, state, jnp.asarray(rtol))
        assert path.result == diffrax.RESULTS.successful, rtol
        energy = kinetic_and_potential(system, path.states)
        assert np.max(np.abs(energy - energy[0])) <= 1e3 * rtol, rtol


@pytest.mark.slow
def test_a_posture_that_cannot_be_passed_is_named() -> None:
    """A crank driven beyond its reach: with 1 m of crank, coupler and rocker, 1.5 m of ground.

    Coupler and rocker are stretched where (cos a, sin a), a = pi / 2 + t, is 2 m from (1.5, 0):
    sin t = 1/4. There the driver demands infinite velocities.
    """
    d, end = 1.5, np.arcsin(0.25)
    across = np.array([d, -1.0])
    middle, out = np.array([d, 1.0]) / 2, np.array([1.0, d]) / np.hypot(1.0, d)
    knee = middle + np.sqrt(1 - across @ across / 4) * out
    rods = {"crank": ((0, 0), (0, 1)), "rocker": ((d, 0), knee), "coupler": ((0, 1), knee)}
    bodies = []
    for name, (a, b) in rods.items():
        (x, y), (i, j) = np.mean([a, b], axis=0), np.subtract(b, a)
        half = np.arctan2(j, i) / 2
        turned = (np.cos(half), 0.0, 0.0, np.sin(half))
        bodies.append(stm.Body(name, 1.0, (THIN, ROD, ROD), position=(x, y, 0), orientation=turned))
    ends = {
        "A": ("ground", "crank", (0.0, 0.0, 0.0)),
        "B": ("crank", "coupler", (0.0, 1.0, 0.0)),
        "C": ("rocker", "coupler", (*knee, 0.0)),
        "D": ("ground", "rocker", (d, 0.0, 0.0)),
    }
    joints = [stm.revolute(name, i, j, point=p, axis=Z) for name, (i, j, p) in ends.items()]
    system = stm.dynamics.add_drivers(stm.System(bodies, joints), {"A": lambda t: t})
    rest = system.reference
    guess = stm.State(rest.r, rest.p, rest.v, rest.omega.at[0, 2].set(1.0))
    moving = stm.assemble(system, guess).state
    with pytest.raises(stm.SimulationError, match="singular posture of drive A") as failed:
        stm.simulate(system, moving, t1=1.0, save_every=0.1, error_estimate=False, analysis=False)
    run = failed.value.run
    assert isinstance(run, stm.Run)
    # the rest of the way takes less time than round-off leaves of the velocities
    assert run.certificate.t_end == pytest.approx(end, abs=1e-6)
    words = str(failed.value)
    assert f"A (at {run.certificate.t_end:.6g} rad)" in words
    assert "plan the motion around" in words
    # what is kept is a motion: B moves at 1 m/s, and what leads to C moves as B does along BC
    r, v = run.states.r[-1], run.states.v[-1]
    speed = np.linalg.norm(v, axis=1)
    assert speed[0] == pytest.approx(0.5, rel=1e-9)
    left = np.sqrt(2 * (end - run.certificate.t_end))
    assert np.all(speed < 10 / left)
    assert np.all(np.isfinite(r))


def tip_x(parameters: Any, **how: Any) -> Any:
    """Bx (3,) [m] for N = 2 at the times of `GRADIENT`, by gravity and the speed at the start."""
    # steps are chosen for the state's error, not the sensitivities', hence the tighter steps
    method = stm.Method(formulation=stm.Tree(redundant=True), rtol=1e-10, atol=1e-10, **how)
    system = four_bar(2, parameters[0])
    ts = jnp.array([0.0, *GRADIENT])
    path = stm.integrate(system, start(system, parameters[1]), ts, method)
    return 2 * path.states.r[1:, 0, 0]


@pytest.mark.slow
def test_gradient_is_the_closed_forms() -> None:
    """Solver class: d Bx / d (g, v0) for N = 2 at 1 s, 4 s and 10 s to 1e-6 relative.

    Forward mode, through the dependent rows and the singular postures (where the derivative
    of `Augmented`'s singular value decomposition loses digits).
    """
    got = jax.jit(jax.jacfwd(lambda x: tip_x(x, adjoint=diffrax.ForwardMode())))(
        jnp.array([GRAVITY, SPEED])
    )
    np.testing.assert_allclose(got, list(GRADIENT.values()), rtol=1e-6)


@pytest.mark.slow
def test_gradient_in_reverse_mode_is_the_closed_forms() -> None:
    """Solver class: the same at 10 s, after some fifteen singular postures."""
    got = jax.jit(jax.grad(lambda x: tip_x(x)[-1]))(jnp.array([GRAVITY, SPEED]))
    np.testing.assert_allclose(got, GRADIENT[10.0], rtol=1e-6)
