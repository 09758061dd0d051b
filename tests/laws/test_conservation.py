"""What physics conserves, whatever the joints; and what keeps the constraints from drifting."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    inertia_of,
    np_rotation,
    pendulum,
    random_quaternion,
    rows_of,
    scene_of,
    swung,
    unit,
)

import stmuav_jax as stm

TOLERANCE = 1e-10
X, Y, Z = np.eye(3)
MIDDLE, FAR = np.array([0.0, 0.0, 0.2]), np.array([0.1, 0.3, 0.4])

# joint between "a" at the origin and "b" near (0, 0, 0.4); names filled in below
PAIRS = {
    "weld": lambda *n, at: stm.weld(*n, point=at + MIDDLE),
    "spherical": lambda *n, at: stm.spherical(*n, point=at + MIDDLE),
    "universal": lambda *n, at: stm.universal(*n, point=at + MIDDLE, axis_i=X, axis_j=Y + Z),
    "revolute": lambda *n, at: stm.revolute(*n, point=at + MIDDLE, axis=X + Y),
    "translational": lambda *n, at: stm.translational(*n, point=at + MIDDLE, axis=X + 2 * Z),
    "cylindrical": lambda *n, at: stm.cylindrical(*n, point=at + MIDDLE, axis=X + 2 * Z),
    "distance": lambda *n, at: stm.distance(*n, point_i=at + MIDDLE, point_j=at + FAR),
    "revolute_spherical": lambda *n, at: stm.revolute_spherical(
        *n, point_i=at, axis=Z, point_j=at + 0.3 * unit(X - Y)
    ),
    "free": None,
}
KINDS = list(PAIRS)


def pairs():
    """One floating pair of bodies for every joint, all in one system (one compilation)."""
    rng = np.random.default_rng(21)
    bodies, joints = [], []
    for k, (kind, build) in enumerate(PAIRS.items()):
        at = np.array([2.0 * k, 0, 0])
        for letter, place in (("a", at), ("b", at + 0.4 * Z)):
            bodies.append(
                stm.Body(
                    letter + kind,
                    1 + rng.random(),
                    inertia_of(rng),
                    com=0.05 * rng.normal(size=3),
                    position=place,
                    orientation=random_quaternion(rng),
                    free=True,
                )
            )
        if build is not None:
            joints.append(build(kind, "a" + kind, "b" + kind, at=at))
    system = stm.System(bodies, joints)
    return system, consistent(system, rng)


def consistent(system, rng):
    """Random velocities, projected onto the joints in the mass metric."""
    n = system.n_bodies
    u = np.concatenate([rng.normal(size=(n, 3)), 4 * rng.normal(size=(n, 3))], axis=1).reshape(-1)
    model = stm.Augmented().prepare(system)
    eq = rows_of(model, system.reference)
    J = np.asarray(eq.matrix)
    W = np.asarray(model.weigh(eq.J)).reshape(J.shape)
    for _ in range(3):
        u = u - W.T @ np.linalg.solve(W @ J.T, J @ u)
    u = jnp.asarray(u.reshape(n, 6))
    return stm.State(system.reference.r, system.reference.p, u[:, :3], u[:, 3:])


def accounts(system, states):
    """Momentum, angular momentum and kinetic energy of every body, in NumPy: (k, n, .)."""
    r, p, v, omega = (np.asarray(x) for x in (states.r, states.p, states.v, states.omega))
    mass, inertia = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)
    spin = np.einsum("nij,knj->kni", inertia, omega)
    turned = np.array(
        [
            [np_rotation(q) @ s for q, s in zip(*both, strict=True)]
            for both in zip(p, spin, strict=True)
        ]
    )
    linear = mass[:, None] * v
    kinetic = 0.5 * (mass * np.sum(v * v, axis=2) + np.sum(omega * spin, axis=2))
    return linear, np.cross(r, linear) + turned, kinetic


@pytest.fixture(scope="module")
def floating():
    """Per pair and saved time: momentum (k, pair, 3), angular momentum, kinetic energy."""
    system, start = pairs()
    method = stm.Method(rtol=TOLERANCE, atol=TOLERANCE, adjoint=diffrax.ForwardMode())
    ts = jnp.linspace(0.0, 1.0, 5)
    found = jax.jit(lambda s: stm.integrate(system, s, ts, method))(start)
    assert found.result == diffrax.RESULTS.successful
    assert float(found.worst.position[-1]) < 1e-13
    per_body = accounts(system, found.states)
    summed = [x.reshape(5, len(PAIRS), 2, *x.shape[2:]).sum(axis=2) for x in per_body]
    moved = np.asarray(found.states.r)[-1] - np.asarray(start.r)
    return summed, per_body, moved


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_momentum_and_energy_of_a_floating_pair(floating, kind):
    (linear, angular, kinetic), (each, _, _), moved = floating
    k = KINDS.index(kind)
    assert np.max(np.abs(kinetic[:, k] - kinetic[0, k])) < 1e-8 * kinetic[0, k]
    assert np.max(np.abs(linear[:, k] - linear[0, k])) < 1e-10 * np.max(np.abs(linear[0, k]))
    assert np.max(np.abs(angular[:, k] - angular[0, k])) < 1e-10 * np.max(np.abs(angular[0, k]))
    assert np.linalg.norm(moved[2 * k]) > 0.1
    exchanged = np.max(np.abs(each[:, 2 * k] - each[0, 2 * k]))
    assert (exchanged > 1e-2) == (kind != "free")


@pytest.mark.slow
def test_a_chain_under_gravity_with_a_spring():
    """Three bodies on revolute, universal and ball joints: energy 1e-8; its certificate agrees."""
    rng = np.random.default_rng(31)
    bodies = [
        stm.Body(f"b{k}", 1.0 + k, inertia_of(rng), position=[0.15 + 0.3 * k, 0, 0])
        for k in range(3)
    ]
    joints = [
        stm.revolute("A", "ground", "b0", point=[0, 0, 0], axis=[0, 1, 1]),
        stm.universal("B", "b0", "b1", point=[0.3, 0, 0], axis_i=Y, axis_j=Z),
        stm.spherical("C", "b1", "b2", point=[0.6, 0, 0]),
    ]
    spring = stm.LinearSpringDamper(
        "ground", "b2", point_i=[0.5, 0.5, 0], stiffness=40.0, length=0.1
    )
    coil = stm.TorsionalSpringDamper("A", stiffness=3.0)
    system = stm.System(bodies, joints, [stm.Gravity(), spring, coil])
    run = stm.simulate(
        scene_of(system, consistent(system, rng)),
        method=stm.Method(rtol=TOLERANCE, atol=TOLERANCE),
        ts=np.linspace(0, 1, 9),
    )
    kinetic = accounts(system, run.states)[2].sum(axis=1)
    np.testing.assert_allclose(kinetic, run.snapshot.kinetic, rtol=1e-12)
    total = kinetic + run.snapshot.potential
    size = np.max(np.abs(kinetic))
    assert np.max(np.abs(total - total[0])) < 1e-8 * size
    assert np.ptp(kinetic) > 0.1 * size
    assert run.certificate.relative_energy_error < 1e-8


@pytest.mark.slow
def test_a_motor_pays_for_the_energy():
    """Work of a driver and of dampers: T + V - work is constant; the motor's moment does it."""
    body = stm.Body("bob", 2.0, [0.02, 0.02, 0.01], position=[0, 0, -0.5])
    hinge = stm.revolute("hinge", "ground", "bob", point=[0, 0, 0], axis=Y)
    swing = lambda t: 0.8 * t**2 * jnp.sin(3 * t)
    motor = stm.drive("motor", hinge, swing, coordinate="angle")
    drag = stm.JointDamping("hinge", turning=0.5)
    system = stm.System([body], [hinge, motor], [stm.Gravity(), drag])
    ts = np.linspace(0, 1, 201)
    run = stm.simulate(scene_of(system), method=stm.Method(rtol=TOLERANCE, atol=TOLERANCE), ts=ts)
    total = run.snapshot.kinetic + run.snapshot.potential
    work = np.asarray(run.trajectory.work)
    size = np.max(np.abs(run.snapshot.kinetic))
    assert np.max(np.abs(total - total[0] - work)) < 1e-8 * size
    assert np.ptp(work) > 0.5 * size
    # by hand: the work of the motor's moment less that of the damper (Simpson's rule)
    rate = np.asarray(run.states.omega)[:, 0, 1]
    angle = jax.vmap(swing)(jnp.asarray(ts))
    np.testing.assert_allclose(rate[-1], jax.grad(swing)(1.0), atol=1e-9)
    np.testing.assert_allclose(run.states.r[:, 0, 0], -0.5 * np.sin(angle), atol=1e-9)
    power = run.snapshot.reactions.moment[:, 1, 1] * rate - 0.5 * rate**2
    weights = np.full(201, 2.0)
    weights[1::2], weights[0], weights[-1] = 4.0, 1.0, 1.0
    assert weights @ power / 600 == pytest.approx(work[-1], rel=1e-6)


# --- drift


def drift(how, tolerance=1e-6):
    """Largest residuals of a fast pendulum in maximal coordinates, up to 2 s and from 6 to 8 s."""
    system = pendulum()
    start = swung(system, 2.5, 1.0)
    formulation = stm.Augmented()
    method = stm.Method(
        formulation=formulation,
        rtol=tolerance,
        atol=tolerance,
        stabilisation=how,
        adjoint=diffrax.ForwardMode(),
        # drift as the error estimate of the state alone lets it grow
        steps="state",
    )

    def run(state):
        # at many times: at one moment they depend on where in its swing the pendulum is
        found = stm.integrate(system, state, jnp.linspace(0.0, 8.0, 81), method)
        model = formulation.prepare(system)
        left = jax.vmap(
            lambda s: formulation.residuals(model, jnp.zeros(()), formulation.to_vector(model, s))
        )(found.states)
        spans = slice(0, 21), slice(60, 81)
        return [
            tuple(jnp.max(getattr(left, kind)[span]) for kind in ("position", "velocity", "norm"))
            for span in spans
        ]

    return jax.tree.map(float, jax.jit(run)(start))


@pytest.fixture(scope="module")
def drifts():
    return {
        "none": drift(stm.Unstabilised()),
        "feedback": drift(stm.Baumgarte(5.0, 5.0, 5.0)),
        "projection": drift(stm.Projection()),
    }


@pytest.mark.slow
def test_without_stabilisation_it_drifts(drifts):
    early, late = drifts["none"]
    assert late[0] > 3 * early[0] > 1e-8
    assert late[1] > 1e-8
    assert late[2] > 1e-8


@pytest.mark.slow
def test_feedback_keeps_it_bounded(drifts):
    early, late = drifts["feedback"]
    for kind in range(3):
        # it settles at the errors of a few steps, whose sizes vary with the phase of the swing
        assert 1e-13 < late[kind] < 2 * early[kind]
        assert drifts["none"][1][kind] > 2 * drifts["none"][0][kind]
    assert late[0] < 0.01 * drifts["none"][1][0]
    assert late[2] < 0.6 * drifts["none"][1][2]


@pytest.mark.slow
def test_projection_keeps_it_at_round_off(drifts):
    for position, velocity, norm in drifts["projection"]:
        assert position < 1e-14
        assert velocity < 1e-13
        assert norm < 1e-15
