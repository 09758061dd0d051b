"""Two elementary examples of the Modelica Standard Library (MultiBody.Examples.Elementary).

Reference results of the library's FreeBody example (Dymola, DASSL), and converged values for
its DoublePendulum. The world's gravity is 9.81 m/s^2 along -y.
"""

import numpy as np
import pytest
from closed_forms import attitude, scene, turned_about_z
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import stmuav_jax as stm

GRAVITY = 9.81  # m/s^2
DOWN = (0.0, -GRAVITY, 0.0)

# FreeBody at t = 10 s: origin of frame a [m], angular velocity in body axes [rad/s].
FRAME_A = (0.19609362402887717, -0.46257038346386253, 0.080609909659227)
OMEGA = (0.0, 0.2678625470622612, 0.263793112797443)
# How far that file is from converged integrations: the error of its DASSL run.
DASSL_ERROR = 1.7e-4

# DoublePendulum, converged: phi1 [rad] and its rate [rad/s] at two times [s].
JOINT_1 = {1.0: (-2.9151613579320483, 2.947065631986064),
           3.0: (-2.3158147126247908, 4.100899424399497)}  # fmt: skip
LENGTH, WIDTH, DENSITY = 0.5, 0.06, 7700.0  # m, m, kg/m^3
BOX = DENSITY * LENGTH * WIDTH**2  # kg
ALONG = BOX * 2 * WIDTH**2 / 12  # kg m^2
ACROSS = BOX * (LENGTH**2 + WIDTH**2) / 12
DAMPING = 0.1  # N m s/rad, in joint 1


@pytest.fixture(scope="module")
def free_body() -> stm.Run:
    """A body of 1 kg and 1 kg m^2 hung on two springs of 20 N/m and no length, for 10 s."""
    tilt = Rotation.from_euler("XYZ", [10, 10, 10], degrees=True)
    body = stm.Body(
        "body", 1.0, (1.0, 1.0, 1.0), com=(0.2, 0.0, 0.0), position=(0.2, -0.5, 0.1),
        orientation=tilt.as_quat(scalar_first=True), free=True,
    )  # fmt: skip
    springs = [
        stm.LinearSpringDamper(
            "ground", "body", point_i=(fixed, 0.0, 0.0), point_j=(end, 0.0, 0.0), stiffness=20.0
        )
        for fixed, end in ((0.0, 0.0), (0.8, 0.4))
    ]
    system = stm.System([body], [], [stm.Gravity(DOWN), *springs])
    return stm.simulate(scene(system, t1=10.0, save_every=1.0))


@pytest.mark.slow
def test_free_body(free_body: stm.Run) -> None:
    """Published class: the file's own error of 1.7e-4 in metres and rad/s."""
    frame = free_body.states.r[-1, 0] - attitude(free_body, 0)[-1].apply([0.2, 0.0, 0.0])
    np.testing.assert_allclose(frame, FRAME_A, rtol=0, atol=DASSL_ERROR)
    np.testing.assert_allclose(free_body.states.omega[-1, 0], OMEGA, rtol=0, atol=DASSL_ERROR)


def test_free_body_balances(free_body: stm.Run) -> None:
    """Energy to 1e-6 J of some 5 J; no turning about the line of the springs' ends."""
    assert free_body.certificate.energy_error <= 1e-6
    assert free_body.certificate.momentum_error is not None
    assert free_body.certificate.momentum_error <= 1e-10
    np.testing.assert_allclose(free_body.states.omega[:, 0, 0], 0, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def double_pendulum() -> stm.Run:
    """Two boxes in line, horizontal and at rest, for 3 s."""
    boxes = [
        stm.Body(f"box{k}", BOX, (ALONG, ACROSS, ACROSS), com=(LENGTH / 2, 0.0, 0.0),
                position=(LENGTH * (k - 1), 0.0, 0.0))
        for k in (1, 2)
    ]  # fmt: skip
    axis = (0.0, 0.0, 1.0)
    joints = [
        stm.revolute("joint1", "ground", "box1", point=(0.0, 0.0, 0.0), axis=axis),
        stm.revolute("joint2", "box1", "box2", point=(LENGTH, 0.0, 0.0), axis=axis),
    ]
    forces = [stm.Gravity(DOWN), stm.JointDamping("joint1", turning=DAMPING)]
    return stm.simulate(scene(stm.System(boxes, joints, forces), t1=3.0, save_every=0.1))


def minimal(t: float, y: np.ndarray) -> np.ndarray:
    """The double pendulum in its two angles from the x axis: y = (a, b, a', b')."""
    del t
    a, b, a_rate, b_rate = y
    half = LENGTH / 2
    mixed = BOX * LENGTH * half
    mass = np.array(
        [
            [ACROSS + BOX * (half**2 + LENGTH**2), mixed * np.cos(a - b)],
            [mixed * np.cos(a - b), ACROSS + BOX * half**2],
        ]
    )
    weight = BOX * GRAVITY
    force = [
        -mixed * np.sin(a - b) * b_rate**2
        - weight * (half + LENGTH) * np.cos(a)
        - DAMPING * a_rate,
        mixed * np.sin(a - b) * a_rate**2 - weight * half * np.cos(b),
    ]
    return np.array([a_rate, b_rate, *np.linalg.solve(mass, force)])


@pytest.mark.slow
def test_double_pendulum(double_pendulum: stm.Run) -> None:
    """Solver class, 1e-6: converged values of joint 1, and both angles by SciPy's DOP853.

    The second code works in minimal coordinates at 1e-12 and shares nothing with the package.
    """
    run = double_pendulum
    angles, rates = turned_about_z(run), run.states.omega[:, :, 2]
    for t, row in JOINT_1.items():
        k = int(np.argmin(np.abs(run.ts - t)))
        got = (angles[k, 0], rates[k, 0])
        np.testing.assert_allclose(got, row, rtol=0, atol=1e-6, err_msg=f"t = {t} s")
    other = solve_ivp(minimal, (0.0, 3.0), np.zeros(4), "DOP853", run.ts, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(angles, other.y[:2].T, rtol=0, atol=1e-6)
    np.testing.assert_allclose(rates, other.y[2:].T, rtol=0, atol=1e-5)


def test_double_pendulum_balances(double_pendulum: stm.Run) -> None:
    """Energy with the damper's work to 1e-8 relative; the damper takes what its torque does."""
    assert double_pendulum.certificate.relative_energy_error <= 1e-8
    assert double_pendulum.certificate.position_violation <= 1e-8
    total = double_pendulum.snapshot.kinetic + double_pendulum.snapshot.potential
    lost = total[0] - total
    assert np.all(np.diff(lost) >= 0)
    np.testing.assert_allclose(double_pendulum.trajectory.work, -lost, rtol=0, atol=1e-5)
