"""Mechanisms in minimal coordinates, by Lagrange's equations and SciPy, as an oracle."""

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


def numeric_lagrange(kinetic_matrix, potential, torque):
    """x'' of M(q) q'' + dM/dt q' - dT/dq + dV/dq = torque(q, q'), slopes by complex step."""

    def slope(g, q, k):
        step = np.array(q, dtype=complex)
        step[k] += 1e-30j
        return np.imag(g(step)) / 1e-30

    def f(t, x):
        n = len(x) // 2
        q, u = x[:n], x[n:]
        M = np.real(kinetic_matrix(q.astype(complex)))
        dM = [slope(kinetic_matrix, q, k) for k in range(n)]
        dV = np.array([slope(potential, q, k) for k in range(n)])
        rate = sum(dM[k] * u[k] for k in range(n))
        dT = np.array([0.5 * u @ dM[k] @ u for k in range(n)])
        return np.concatenate([u, np.linalg.solve(M, torque(q, u) - rate @ u + dT - dV)])

    return f


# --- a double pendulum with a damper and a coil spring in its elbow


@pytest.mark.slow
def test_double_pendulum():
    """Angles from -z about y, absolute: r1 = -c1 (sin a, 0, cos a), elbow at l1."""
    m1, m2, J1, J2, l1, c1, c2 = 1.3, 0.9, 0.03, 0.02, 0.5, 0.2, 0.3
    stiffness, damping, rest = 4.0, 0.3, 0.2

    def kinetic_matrix(q):
        cross = m2 * l1 * c2 * np.cos(q[0] - q[1])
        return np.array([[m1 * c1**2 + m2 * l1**2 + J1, cross], [cross, m2 * c2**2 + J2]])

    def potential(q):
        height = -(m1 * c1 + m2 * l1) * np.cos(q[0]) - m2 * c2 * np.cos(q[1])
        return GRAVITY * height + 0.5 * stiffness * (q[1] - q[0] - rest) ** 2

    drag = lambda q, u: damping * np.array([u[1] - u[0], u[0] - u[1]])
    a0, u0 = np.array([0.9, -0.4]), np.array([1.5, -2.0])
    x = solved(numeric_lagrange(kinetic_matrix, potential, drag), [*a0, *u0])

    def bodies_at(a, u):
        out = [np.array([-np.sin(b), 0, -np.cos(b)]) for b in a]
        w = [np.array([0, b, 0]) for b in u]
        r = np.array([c1 * out[0], l1 * out[0] + c2 * out[1]])
        elbow = np.cross(w[0], l1 * out[0])
        v = np.array([np.cross(w[0], r[0]), elbow + np.cross(w[1], c2 * out[1])])
        return r, np.array([turn([0, 1, 0], b) for b in a]), v, np.array(w)

    system = stm.System(
        [
            stm.Body("upper", m1, [J1, J1, J1], position=[0, 0, -c1]),
            stm.Body("lower", m2, [J2, J2, J2], position=[0, 0, -l1 - c2]),
        ],
        [
            stm.revolute("shoulder", "ground", "upper", point=[0, 0, 0], axis=[0, 1, 0]),
            stm.revolute("elbow", "upper", "lower", point=[0, 0, -l1], axis=[0, 1, 0]),
        ],
        [
            stm.Gravity(),
            stm.TorsionalSpringDamper("elbow", stiffness=stiffness, damping=damping, angle=rest),
        ],
    )
    found = integrated(system, state_of(*bodies_at(a0, u0)))
    for k in range(len(TS)):
        r, p, v, w = bodies_at(x[k, :2], x[k, 2:])
        close(found.r[k], r)
        close(found.v[k], v)
        close(found.omega[k], w)
        close(np.abs(np.sum(found.p[k] * p, axis=1)), 1.0)


# --- a slider-crank: a closed loop with one coordinate


@pytest.mark.slow
def test_slider_crank():
    """Crank about y at the origin, slider on the x axis, a spring on the slider; no dependent rows."""
    crank, rod = 0.15, 0.5
    m1, m2, m3, J1, J2 = 0.8, 1.1, 2.0, 0.004, 0.03
    k, rest = 60.0, 0.4

    def places(q):
        """Centres of crank and rod, slider position and rod angle; complex-step safe."""
        s = np.array([crank * np.cos(q), 0 * q, -crank * np.sin(q)])
        tilt = np.arcsin(-crank / rod * np.sin(q))
        x = crank * np.cos(q) + rod * np.cos(tilt)
        return s, tilt, x

    def velocity(q):
        """d(places)/dq, by hand: crank pin, rod angle, slider."""
        _, tilt, _ = places(q)
        tilt_rate = -crank * np.cos(q) / (rod * np.cos(tilt))
        pin = np.array([-crank * np.sin(q), 0 * q, -crank * np.cos(q)])
        x_rate = -crank * np.sin(q) - rod * np.sin(tilt) * tilt_rate
        return pin, tilt_rate, x_rate

    def kinetic_matrix(q):
        pin, tilt_rate, x_rate = velocity(q[0])
        middle = 0.5 * (pin + np.array([x_rate, 0, 0]))
        total = m1 * (crank / 2) ** 2 + J1 + m2 * (middle @ middle) + J2 * tilt_rate**2
        return np.array([[total + m3 * x_rate**2]])

    def potential(q):
        pin, _, x = places(q[0])
        return GRAVITY * (m1 + m2) * pin[2] / 2 + 0.5 * k * (x - rest) ** 2

    x = solved(numeric_lagrange(kinetic_matrix, potential, lambda q, u: 0 * u), [0.6, 5.0])

    def bodies_at(q, u):
        pin, tilt, slide = places(q)
        pin_rate, tilt_rate, slide_rate = velocity(q)
        end, end_rate = np.array([slide, 0, 0]), np.array([slide_rate, 0, 0])
        r = [pin / 2, (pin + end) / 2, end]
        v = [pin_rate * u / 2, (pin_rate + end_rate) * u / 2, end_rate * u]
        p = [turn([0, 1, 0], q), turn([0, 1, 0], tilt), [1, 0, 0, 0]]
        return r, p, v, [[0, u, 0], [0, tilt_rate * u, 0], [0, 0, 0]]

    r0, _, _, _ = bodies_at(0.0, 0.0)
    system = stm.System(
        [
            stm.Body("crank", m1, [J1, J1, J1], position=r0[0]),
            stm.Body("rod", m2, [J2, J2, J2], position=r0[1]),
            stm.Body("slider", m3, [0.01, 0.01, 0.01], position=r0[2]),
        ],
        [
            stm.revolute("A", "ground", "crank", point=[0, 0, 0], axis=[0, 1, 0]),
            stm.spherical("B", "crank", "rod", point=[crank, 0, 0]),
            stm.universal(
                "C", "rod", "slider", point=r0[2], axis_i=[0, 0, 1], axis_j=[0, 1, 0]
            ),
            stm.translational("D", "ground", "slider", axis=[1, 0, 0]),
        ],
        [
            stm.Gravity(),
            stm.LinearSpringDamper("ground", "slider", stiffness=k, length=rest),
        ],
    )  # fmt: skip
    start = state_of(*bodies_at(0.6, 5.0))
    assert stm.dynamics.rank(system, start)[:3] == (17, 17, 1)
    found = integrated(system, start)
    for n in range(len(TS)):
        r, _, v, w = bodies_at(*x[n])
        close(found.r[n], r)
        close(found.v[n], v)
        close(found.omega[n], w)
    assert abs(x[-1, 0] - 0.6) > 1


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


def test_complex_step_lagrange_against_a_known_equation():
    """The oracle itself: a pendulum's x'' = -(g / l) sin x."""
    f = numeric_lagrange(
        lambda q: np.array([[0.25 + 0 * q[0]]]), lambda q: -GRAVITY * 0.5 * np.cos(q[0]),
        lambda q, u: 0 * u,
    )  # fmt: skip
    rate = f(0.0, np.array([0.8, 2.0]))
    assert rate[1] == pytest.approx(-GRAVITY / 0.5 * np.sin(0.8), rel=1e-14)


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
