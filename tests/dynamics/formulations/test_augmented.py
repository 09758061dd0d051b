"""The report's formulation: one dense system, or its structure; both kinds of rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum, relative_error, swung

import stmuav_jax as stm

COUNT = 6
ROWS = ("body", "report")
SOLVES = ("structured", "dense")


@pytest.fixture(scope="module")
def loads():
    """Random loads on the seven bodies and ground, stacked."""
    rng = np.random.default_rng(12)
    scale = np.array([10, 0.5, 0.5, 0.1, 0.1, 0.1, 1.0, 0.0])[:, None]
    made = [
        stm.mechanics.Load(
            force=jnp.asarray(scale * rng.normal(size=(8, 3))),
            moment=jnp.asarray(0.02 * scale * rng.normal(size=(8, 3))),
            potential=jnp.zeros(()),
            power=jnp.zeros(()),
        )
        for _ in range(COUNT)
    ]
    return jax.tree.map(lambda *x: jnp.stack(x), *made)


@pytest.fixture(scope="module")
def solved(seven, loads):
    """Evaluations by (solve, rows), for all states."""
    system, states = seven

    def run(solve, rows):
        formulation = stm.Augmented(solve=solve, rows=rows)
        one = lambda s, f: stm.dynamics.evaluate(system, s, load=f, formulation=formulation)
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(states, loads))

    return {(solve, rows): run(solve, rows) for solve in SOLVES for rows in ROWS}


@pytest.fixture(scope="module")
def equations(seven):
    """J, gamma and velocities in (v, omega'), "body" rows."""
    system, states = seven
    model = stm.Augmented().prepare(system)

    def at(state):
        eq = model.constraints.equations(jnp.zeros(()), system.kinematics(state))
        return eq, jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(at))(states))


def test_the_system_is_the_reports_size(seven, equations):
    system = seven[0]
    J = equations[0].J
    assert J.shape == (COUNT, 34, 7, 6)
    assert 7 * system.n_bodies + J.shape[1] == 83
    assert stm.dynamics.rank(system, system.reference)[:3] == (34, 34, 8)


@pytest.mark.parametrize("rows", ROWS)
def test_dense_equals_structured(solved, rows):
    dense, structured = solved["dense", rows], solved["structured", rows]
    assert relative_error(dense.accelerations.v_rate, structured.accelerations.v_rate) < 1e-11
    assert (
        relative_error(dense.accelerations.omega_rate, structured.accelerations.omega_rate) < 1e-11
    )
    assert (
        relative_error(dense.accelerations.multipliers, structured.accelerations.multipliers)
        < 1e-11
    )


@pytest.mark.parametrize("solve", SOLVES)
def test_both_kinds_of_rows_move_alike(solved, solve):
    body, report = solved[solve, "body"], solved[solve, "report"]
    assert relative_error(body.accelerations.v_rate, report.accelerations.v_rate) < 1e-11
    assert relative_error(body.accelerations.omega_rate, report.accelerations.omega_rate) < 1e-11
    assert relative_error(body.reactions.force, report.reactions.force) < 1e-10
    assert relative_error(body.reactions.moment, report.reactions.moment) < 1e-10


def test_multipliers_of_equal_rows_are_equal(seven, solved):
    """The ball and pin rows (s,3) are the same in both choices of rows, and come first."""
    joints = seven[0].joints
    points = sum(3 for j in joints if any(t.kind == "point" for t in j.terms("body")))
    assert points == 18
    one, two = (solved["structured", rows].accelerations.multipliers for rows in ROWS)
    assert one.shape == two.shape == (COUNT, 34)
    assert relative_error(one[:, :points], two[:, :points]) < 1e-10
    assert relative_error(one[:, points:], two[:, points:]) > 1e-3


@pytest.mark.parametrize("solve", SOLVES)
def test_accelerations_satisfy_the_constraints_and_newton(seven, loads, solved, equations, solve):
    system, states = seven
    eq, _ = equations
    result = solved[solve, "body"].accelerations
    u_rate = np.concatenate([result.v_rate, result.omega_rate], axis=2).reshape(COUNT, -1)
    J = eq.J.reshape(COUNT, 34, 42)
    size = np.max(np.abs(J) @ np.abs(u_rate)[..., None])
    assert np.max(np.abs(np.einsum("bmk,bk->bm", J, u_rate) - eq.gamma)) < 1e-10 * size
    # mass times acceleration = loads + J^T multipliers - gyroscopic moments
    mass, inertia = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)
    joint = np.einsum("bmk,bm->bk", J, result.multipliers).reshape(COUNT, 7, 6)
    omega = np.asarray(states.omega)
    spin = np.cross(omega, np.einsum("nij,bnj->bni", inertia, omega))
    force = np.asarray(loads.force)[:, :7] + joint[..., :3]
    moment = np.asarray(loads.moment)[:, :7] + joint[..., 3:] - spin
    assert relative_error(mass[:, None] * result.v_rate, force) < 1e-11
    turned = np.einsum("nij,bnj->bni", inertia, result.omega_rate)
    assert relative_error(turned, moment) < 1e-11


@pytest.mark.parametrize("solve", SOLVES)
def test_baumgarte_feeds_the_residuals_back(seven, solve):
    """J a = gamma - 2 alpha (J u - target) - beta^2 Phi, off the constraints too."""
    system, states = seven
    rng = np.random.default_rng(4)
    state = jax.tree.map(lambda x: x[0] + 1e-3 * jnp.asarray(rng.normal(size=x[0].shape)), states)
    p = state.p / jnp.linalg.norm(state.p, axis=1, keepdims=True)
    state = stm.State(state.r, p, state.v, state.omega)
    formulation = stm.Augmented(solve=solve)
    model = formulation.prepare(system)

    @jax.jit
    def look(state):
        kin = system.kinematics(state)
        how = stm.Baumgarte(alpha=20.0, beta=30.0)
        return (
            formulation.accelerations(model, jnp.zeros(()), state, how),
            model.constraints.equations(jnp.zeros(()), kin),
        )

    found, eq = look(state)
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    u_rate = jnp.concatenate([found.v_rate, found.omega_rate], axis=1).reshape(-1)
    feedback = -40 * (eq.matrix @ u - eq.target) - 900 * eq.value
    assert np.max(np.abs(feedback)) > 0.1
    if solve == "structured":
        assert relative_error(eq.matrix @ u_rate, eq.gamma + feedback) < 1e-10
    else:
        # the "p" rows differ off the constraints only by the rate they are fed back with
        assert relative_error(eq.matrix @ u_rate, eq.gamma + feedback) < 1e-9


def test_baumgarte_pulls_the_norms_back():
    """pdot gets norm (1 - p . p) p, so that d(p . p)/dt = 2 norm (1 - p . p) p . p."""
    system = pendulum()
    state = swung(system, 0.4, 1.5)
    state = stm.State(state.r, 1.01 * state.p, state.v, state.omega)
    formulation = stm.Augmented()
    model = formulation.prepare(system)
    x = formulation.to_vector(model, state)
    rates = {}
    for how in (stm.Unstabilised(), stm.Baumgarte(norm=7.0)):
        rate, _ = formulation.derivative(model, jnp.zeros(()), x, how)
        p_rate = formulation.to_state(model, rate).p
        rates[type(how).__name__] = float(2 * state.p[0] @ p_rate[0])
    square = 1.01**2
    assert rates["Unstabilised"] == pytest.approx(0, abs=1e-15)
    assert rates["Baumgarte"] == pytest.approx(2 * 7 * (1 - square) * square, rel=1e-12)


def test_vector_and_state_are_inverse(seven):
    system, states = seven
    formulation = stm.Augmented()
    model = formulation.prepare(system)
    state = jax.tree.map(lambda x: x[0], states)
    back = formulation.to_state(model, formulation.to_vector(model, state))
    assert relative_error(back, state) == 0


def test_projection_of_a_vector(seven):
    """Back onto positions, norms and velocities; a consistent vector stays where it is."""
    system, states = seven
    formulation = stm.Augmented()
    model = formulation.prepare(system)
    zero = jnp.zeros(())
    project = jax.jit(lambda x: formulation.project(model, zero, x, 3)[0])
    residuals = jax.jit(lambda x: formulation.residuals(model, zero, x))
    x = project(formulation.to_vector(model, jax.tree.map(lambda x: x[0], states)))
    assert relative_error(project(x), x) < 1e-13
    off = x + 1e-6 * jnp.asarray(np.random.default_rng(2).normal(size=x.shape))
    before, after = residuals(off), residuals(project(off))
    assert min(float(before.position), float(before.velocity), float(before.norm)) > 1e-7
    assert float(after.position) < 1e-13
    assert float(after.velocity) < 1e-12
    assert float(after.norm) < 1e-15
    assert 1e-7 < float(jnp.max(jnp.abs(project(off) - off))) < 1e-3


@pytest.mark.parametrize("gain", ["alpha", "beta", "norm"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_bad_gains_are_refused(gain, value):
    with pytest.raises(stm.SettingError, match=f"gain {gain} must be finite and not negative"):
        stm.Baumgarte(**{gain: value})


def test_projection_needs_an_iteration():
    with pytest.raises(stm.SettingError, match="at least 1 iteration, not 0"):
        stm.Projection(iterations=0)
