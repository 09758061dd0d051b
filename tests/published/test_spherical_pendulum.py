"""The spherical pendulum: a point mass on a rod of fixed length, free to swing in space.

Source: E. T. Whittaker, A Treatise on the Analytical Dynamics of Particles and Rigid
Bodies, section 55. m = 1 kg, L = 1 m, g = 9.81 m/s^2 along -z, released 60 degrees from
hanging at 1.5 m/s across. The height moves between two roots of

    2 (E - g z) (1 - z^2) - Lz^2 = 0,

of which the start is one; period and advance of the azimuth are elliptic integrals, given
here by quadrature.
"""

import numpy as np
import pytest
from closed_forms import scene
from problems.conservative import moving

import stmuav_jax as stm

GRAVITY = 9.81  # m/s^2
SPEED = 1.5  # m/s
TILT = np.pi / 3  # rad
PERIOD = 1.0790207686476312  # s, of the height
ADVANCE = 3.73623990009181172  # rad, of the azimuth in a period
LOW, HIGH = -0.9152593181591549, -0.5  # m
# Positions [m] at times [s], converged, by independent code.
EXACT = {
    1.0: (-0.767090596619, -0.376783722019, -0.519236018974),
    5.0: (0.243333134186, -0.486776539937, -0.838950288142),
    20.0: (0.396550060081, 0.12447303665, -0.909535328064),
}
SWINGS = 18


@pytest.fixture(scope="module")
def run() -> stm.Run:
    """20 s at the default tolerances of 1e-8, saved at all times that are asked for."""
    start = (np.sin(TILT), 0.0, -np.cos(TILT))
    bob = stm.Body("bob", 1.0, (1e-3, 1e-3, 1e-3), position=start)
    rod = stm.distance("rod", "ground", "bob", point_i=(0.0, 0.0, 0.0), point_j=start)
    system = stm.System([bob], [rod], [stm.Gravity((0.0, 0.0, -GRAVITY))])
    state = moving(system, [[0.0, SPEED, 0.0]], [[0.0, 0.0, 0.0]])
    halves = 0.5 * PERIOD * np.arange(2 * SWINGS + 1)
    ts = np.sort(np.concatenate([halves, list(EXACT)]))
    return stm.simulate(scene(system, state), ts=ts)


def at(run: stm.Run, t: float) -> np.ndarray:
    """Position [m] at a saved time [s]."""
    k = int(np.argmin(np.abs(run.ts - t)))
    assert run.ts[k] == pytest.approx(t, abs=1e-12)
    return np.asarray(run.states.r[k, 0])


def test_position(run: stm.Run) -> None:
    """Solver class: 1e-6 m for 20 s at rtol 1e-8."""
    for t, row in EXACT.items():
        np.testing.assert_allclose(at(run, t), row, rtol=0, atol=1e-6, err_msg=f"t = {t} s")


def test_turning_points(run: stm.Run) -> None:
    """Solver class: 1e-6 m at every half period, high and low in turn, for 18 periods."""
    heights = [at(run, 0.5 * PERIOD * k)[2] for k in range(2 * SWINGS + 1)]
    np.testing.assert_allclose(heights[0::2], HIGH, rtol=0, atol=1e-6)
    np.testing.assert_allclose(heights[1::2], LOW, rtol=0, atol=1e-6)
    z = run.states.r[:, 0, 2]
    assert LOW - 1e-6 <= z.min() <= z.max() <= HIGH + 1e-6


def test_azimuth_advances(run: stm.Run) -> None:
    """Solver class: the azimuth of every start of a period, to 1e-6 rad."""
    tops = np.stack([at(run, PERIOD * k) for k in range(SWINGS + 1)])
    off = np.arctan2(tops[:, 1], tops[:, 0]) - ADVANCE * np.arange(SWINGS + 1)
    off = (off + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(off, 0, rtol=0, atol=2e-6)


def test_invariants_and_rod(run: stm.Run) -> None:
    """Energy and the moment of momentum about z to 1e-6, the length to 1e-8 m.

    Solver class, the problem's own figure: over 18 swings both drift by some 5 rtol.
    The rod pulls with m (v^2 / L - g z / L), exact class on the state that was reached.
    """
    assert run.certificate.relative_energy_error <= 1e-6
    assert run.certificate.position_violation <= 1e-8
    x, v = run.states.r[:, 0], run.states.v[:, 0]
    about_z = np.cross(x, v)[:, 2]
    np.testing.assert_allclose(about_z, SPEED * np.sin(TILT), rtol=0, atol=1e-6)
    pull = np.sum(v * v, axis=1) - GRAVITY * x[:, 2]
    force = run.snapshot.reactions.force[:, 0]
    np.testing.assert_allclose(force, -pull[:, None] * x, rtol=0, atol=1e-10)
