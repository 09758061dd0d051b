"""A top by its rotation matrix and SciPy, and a body on a screw in closed form, as oracles."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import GRAVITY, np_rotation, np_skew, state_of, turn
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import stmuav_jax as stm

TS = np.linspace(0.0, 1.0, 5)
TOLERANCE = 1e-8


def solved(f, x0):
    found = solve_ivp(f, (0, 1), x0, method="DOP853", t_eval=TS, rtol=1e-13, atol=1e-14)
    assert found.success
    return found.y.T


def integrated(system, state):
    method = stm.Method(rtol=1e-11, atol=1e-11, adjoint=diffrax.ForwardMode())
    found = jax.jit(lambda s: stm.integrate(system, s, jnp.asarray(TS), method))(state)
    assert found.result == diffrax.RESULTS.successful
    return jax.tree.map(np.asarray, found.states)


def close(got, expected):
    np.testing.assert_allclose(got, expected, rtol=0, atol=TOLERANCE)


# --- a heavy top on a ball joint: rotation in space, by the rotation matrix alone


@pytest.mark.slow
def test_heavy_top():
    """J w' + w x J w = moment of weight about the tip; R' = R w~ (no Euler parameters)."""
    mass, arm = 1.2, np.array([0.02, -0.01, 0.3])
    inertia = np.diag([0.03, 0.04, 0.02])
    about_tip = inertia + mass * (np.eye(3) * (arm @ arm) - np.outer(arm, arm))

    def f(t, x):
        R, w = x[:9].reshape(3, 3), x[9:]
        moment = np.cross(arm, R.T @ [0, 0, -mass * GRAVITY])
        w_rate = np.linalg.solve(about_tip, moment - np.cross(w, about_tip @ w))
        return np.concatenate([(R @ np_skew(w)).reshape(-1), w_rate])

    p0, w0 = turn([1, 0.3, 0], 0.5), np.array([0.5, -1.0, 25.0])
    R0 = np_rotation(p0)
    x = solved(f, np.concatenate([R0.reshape(-1), w0]))
    body = stm.Body("top", mass, inertia, com=arm)
    ball = stm.spherical("tip", "ground", "top", point=[0, 0, 0])
    system = stm.System([body], [ball], [stm.Gravity()])
    found = integrated(system, state_of([R0 @ arm], [p0], [R0 @ np.cross(w0, arm)], [w0]))
    for k in range(len(TS)):
        R = x[k, :9].reshape(3, 3)
        close(np_rotation(found.p[k, 0]), R)
        close(found.omega[k, 0], x[k, 9:])
        close(found.r[k, 0], R @ arm)
    turned = R0.T @ x[-1, :9].reshape(3, 3)
    assert Rotation.from_matrix(turned).magnitude() > 0.5


# --- a body on a screw, whose axis is vertical and does not go through its centre of mass


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [stm.Tree(), stm.Augmented()], ids=["tree", "augmented"])
def test_screw(formulation):
    """Falling over six turns: z'' = -m g h^2 / (I + m e^2 + m h^2), and energy is kept."""
    mass, inertia, offset, pitch = 1.3, 0.01, 0.03, -0.02
    body = stm.Body("nut", mass, [0.02, 0.015, inertia], position=[offset, 0, 0])
    screw = stm.screw("S", "ground", "nut", point=np.zeros(3), axis=[0, 0, 1], pitch=pitch)
    system = stm.System([body], [screw], [stm.Gravity()])
    about = inertia + mass * offset**2
    a = -mass * GRAVITY * pitch**2 / (about + mass * pitch**2)
    ts = np.linspace(0.0, 2.0, 9)
    method = stm.Method(
        formulation=formulation, rtol=1e-11, atol=1e-11, adjoint=diffrax.ForwardMode()
    )

    @jax.jit
    def run(state):
        found = stm.dynamics.evaluate(system, state, jnp.zeros(()), formulation=formulation)
        return found.accelerations, stm.integrate(system, state, jnp.asarray(ts), method)

    rates, found = run(system.reference)
    start = np.array([[0.0, offset * a / pitch, a]])
    np.testing.assert_allclose(rates.v_rate, start, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(rates.omega_rate, [[0, 0, a / pitch]], rtol=1e-13, atol=1e-13)
    assert found.result == diffrax.RESULTS.successful
    z, turned = 0.5 * a * ts**2, 0.5 * a * ts**2 / pitch
    assert abs(turned[-1]) > 12 * np.pi
    expected = np.stack([offset * np.cos(turned), offset * np.sin(turned), z], axis=1)
    close(found.states.r[:, 0], expected)
    motion = stm.mechanics.joint_motion(system, found.states, "S")
    close(motion.angle, turned)
    close(motion.rates[:, 0], a * ts / pitch)
    omega, v = np.asarray(found.states.omega[:, 0, 2]), np.asarray(found.states.v[:, 0])
    energy = 0.5 * inertia * omega**2 + 0.5 * mass * np.sum(v**2, axis=1) + mass * GRAVITY * z
    np.testing.assert_allclose(energy, 0, atol=1e-8)
