"""One pendulum on each kind of joint, against ADAMS.

Chrono's unit tests of joints (projectchrono/chrono, src/tests/unit_tests/joints) compare
with ADAMS data for 5 s: a body of 1 kg released from rest on one joint to ground,
g = 9.80665 m/s^2 along -z. `adams_joints.json` holds three rows of those data
(data/testing/joints). Velocities and reactions are in world axes; reactions act on the
ground at the joint's point of ground.

All pendulums swing in one system here, without touching each other: one compilation, and a
proof that independent mechanisms do not disturb one another.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_forms import attitude, scene
from scipy.spatial.transform import Rotation

import stmuav_jax as stm

GRAVITY = 9.80665  # m/s^2
TABLE = json.loads((Path(__file__).parent / "adams_joints.json").read_text())
ORIGIN, CORNER = np.zeros(3), np.array([1.0, 2.0, 3.0])  # m
X, Y, Z = np.eye(3)
LYING = (0.04, 0.1, 0.1)  # kg m^2, a rod along x
ALONG_Y = (0.1, 0.04, 0.1)
HANGING = (0.1, 0.1, 0.04)

# Printed with six digits at least.
LAST_DIGIT = 5e-6
POSITION, QUATERNION, RATE, FORCE = 2e-5, 2e-5, 1e-3, 1e-3  # m, -, rad/s, N
# ADAMS itself drifted there: its files are 8.4e-4 m from the equal case without drift.
DRIFTED = {"Spherical_Case01", "Universal_Case01", "Universal_Case02"}
DRIFT, DRIFTED_FORCE = 2e-3, 2e-2


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


ALIGNED = about("x", 0)
# Cases on one point: joint, its point, orientation of joint frame and body.
ON_A_POINT = {
    "Revolute_Case01": (stm.revolute, ORIGIN, about("x", -90)),
    "Revolute_Case02": (stm.revolute, CORNER, about("x", -45)),
    "Spherical_Case01": (stm.spherical, ORIGIN, ALIGNED),
    "Spherical_Case02": (stm.spherical, CORNER, about("x", -45)),
    "Prismatic_Case01": (stm.translational, ORIGIN, ALIGNED),
    "Prismatic_Case02": (stm.translational, CORNER, about("x", -45)),
    "Prismatic_Case03": (stm.translational, CORNER, about("x", -90)),
    "Cylindrical_Case01": (stm.cylindrical, ORIGIN, ALIGNED),
    "Cylindrical_Case02": (stm.cylindrical, ORIGIN, about("x", -90)),
    "Cylindrical_Case03": (stm.cylindrical, CORNER, about("x", -45)),
    "Universal_Case01": (stm.universal, ORIGIN, about("x", 90)),
    "Universal_Case02": (stm.universal, ORIGIN, about("y", 90)),
}
# Massless links from ground: joint, centre of mass, orientation and inertia of the body.
ON_A_LINK = {
    "Distance_Case01": ([0.0, 2.0, 0.0], ALIGNED, LYING),
    "Distance_Case03": ([0.0, 4.0, 0.0], about("z", -90), LYING),
    "RevSpherical_Case01": ([2.0, 2.0, 0.0], ALIGNED, ALONG_Y),
}
CASES = [*ON_A_POINT, *ON_A_LINK]


def on_a_point(name: str) -> tuple[stm.Body, stm.Joint]:
    """A body 2 m from its joint; the joint from body to ground, so it tells what acts there."""
    make, point, turned = ON_A_POINT[name]
    hangs = make is stm.universal
    arm, inertia = (-2.0 * Z, HANGING) if hangs else (2.0 * X, LYING)
    orientation = turned.as_quat(scalar_first=True)
    body = stm.Body(name, 1.0, inertia, position=point + turned.apply(arm), orientation=orientation)
    how: dict[str, Any] = {"point": point}
    if hangs:
        how |= {"axis_i": turned.apply(Y), "axis_j": turned.apply(X)}
    elif make is not stm.spherical:
        how |= {"axis": turned.apply(Z)}
    return body, make(name, name, "ground", **how)


def on_a_link(name: str) -> tuple[stm.Body, stm.Joint]:
    """A body on a massless link of 2 m from the origin; the joint from ground to body."""
    com, turned, inertia = ON_A_LINK[name]
    orientation = turned.as_quat(scalar_first=True)
    body = stm.Body(name, 1.0, inertia, position=com, orientation=orientation)
    if name.startswith("Distance"):
        return body, stm.distance(name, "ground", name, point_i=ORIGIN, point_j=2.0 * Y)
    link = stm.revolute_spherical(name, "ground", name, point_i=ORIGIN, axis=Z, point_j=2.0 * X)
    return body, link


@pytest.fixture(scope="module")
def run() -> stm.Run:
    """All cases for 5 s at 1e-9: a tenth of the default, as many bodies at rest share the norm."""
    pairs = [on_a_point(name) for name in ON_A_POINT] + [on_a_link(name) for name in ON_A_LINK]
    bodies, joints = zip(*pairs, strict=True)
    system = stm.System(bodies, joints, [stm.Gravity((0.0, 0.0, -GRAVITY))])
    return stm.simulate(
        scene(system, t1=5.0),
        method=stm.Method(rtol=1e-9, atol=1e-9),
        ts=np.array([0.0, *TABLE["times_s"]]),
        error_estimate=False,
    )


def rows(name: str, quantity: str) -> np.ndarray:
    """ADAMS's rows of one quantity (3, .)."""
    return np.array(TABLE["cases"][name][quantity])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_motion_is_that_of_adams(run: stm.Run, name: str) -> None:
    """Published class: 2e-5 m, 2e-5 and 1e-3 rad/s, and half of the last printed digit."""
    k = CASES.index(name)
    position, quaternion = (DRIFT, DRIFT) if name in DRIFTED else (POSITION, QUATERNION)
    rate = DRIFT if name in DRIFTED else RATE
    r, turned = run.states.r[1:, k], attitude(run, k)[1:]
    np.testing.assert_allclose(r, rows(name, "Pos"), rtol=LAST_DIGIT, atol=position)
    omega = turned.apply(run.states.omega[1:, k])
    np.testing.assert_allclose(omega, rows(name, "Avel"), rtol=LAST_DIGIT, atol=rate)
    p, adams = run.states.p[1:, k], rows(name, "Quat")
    sign = np.sign(np.sum(p * adams, axis=1, keepdims=True))
    np.testing.assert_allclose(sign * p, adams, rtol=LAST_DIGIT, atol=quaternion)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_reactions_are_those_of_adams(run: stm.Run, name: str) -> None:
    """Published class: 1e-3 N and N m, and half of the last printed digit.

    Moments are about the joint's point of ground, which a sliding body leaves by 123 m: they
    are as good as the force times that arm. Where ADAMS drifted, Chrono's own limit of
    0.02 N is taken.
    """
    k = CASES.index(name)
    force, moment = run.snapshot.reactions.force[1:, k], run.snapshot.reactions.moment[1:, k]
    if name in ON_A_LINK:
        # what ground does to the body about the link's far end, turned round and moved
        system, far = run.scene.system, np.asarray(run.scene.system.joints[k].point_j)
        arm = attitude(run, k)[1:].apply(far - np.asarray(system.bodies.com[k]))
        force, moment = -force, -moment - np.cross(run.states.r[1:, k] + arm, force)
    atol = DRIFTED_FORCE if name in DRIFTED else FORCE
    np.testing.assert_allclose(force, rows(name, "Rforce"), rtol=LAST_DIGIT, atol=atol)
    if not name.startswith("Distance"):
        atol *= max(1.0, float(np.max(np.abs(run.states.r[:, k]))))
        np.testing.assert_allclose(moment, rows(name, "Rtorque"), rtol=LAST_DIGIT, atol=atol)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_reactions_balance_the_motion(run: stm.Run, name: str) -> None:
    """Exact class: the joint's force on the body is m (a - g), to 1e-9 N of some 30 N."""
    k = CASES.index(name)
    needed = run.snapshot.accelerations.v_rate[:, k] + GRAVITY * Z
    on_body = 1 if name in ON_A_LINK else -1
    force = on_body * run.snapshot.reactions.force[:, k]
    np.testing.assert_allclose(force, needed, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_joints_and_energy_are_kept(run: stm.Run) -> None:
    """1e-8 m and 1e-7 m/s over all steps; energy to 1e-8 of the largest."""
    assert run.certificate.rank == run.certificate.rows
    assert run.certificate.position_violation <= 1e-8
    assert run.certificate.velocity_violation <= 1e-7
    assert run.certificate.relative_energy_error <= 1e-8
