"""Consistent starts: assembled positions and velocities, what is held, and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    FOUR_BAR_POINTS,
    central,
    four_bar,
    four_bar_state,
    np_rotation,
    relative_error,
    rows_of,
    state_of,
    turn,
)

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.augmented import move_bodies


@pytest.fixture(scope="module")
def bars():
    """The four-bar without dependent rows, in motion."""
    system = four_bar(redundant=False)
    return system, four_bar_state(system, 2.0)


def shaken(state, size, seed=0):
    """A guess near a state: moved, turned, with other velocities."""
    rng = np.random.default_rng(seed)
    step = size * rng.normal(size=(3, 6))
    r, p = move_bodies(state.r, state.p, jnp.asarray(step))
    noise = lambda: jnp.asarray(rng.normal(size=(3, 3)))
    return stm.State(r, 1.5 * p, state.v + noise(), state.omega + noise())


@eqx.filter_jit
def _residuals(system, state, t):
    model = stm.Augmented().prepare(system)
    eq = model.constraints.equations(t, system.kinematics(state))
    u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
    return eq.value, eq.matrix @ u - eq.target


def residuals(system, state, t=0.0):
    return tuple(map(np.asarray, _residuals(system, state, jnp.asarray(t))))


@pytest.mark.slow
def test_a_consistent_state_is_left_alone(bars):
    system, state = bars
    found = stm.assemble(system, state)
    assert relative_error(found.state, state) < 1e-12
    assert bool(found.converged)
    assert float(found.largest_displacement) < 1e-12
    assert found.residuals.shape == (4,)


@pytest.fixture(scope="module")
def near(bars):
    system, state = bars
    guess = shaken(state, 0.03)
    return system, guess, stm.assemble(system, guess)


def test_a_guess_is_assembled(near):
    system, guess, found = near
    value, rate = residuals(system, found.state)
    assert np.max(np.abs(value)) < 1e-12
    assert np.max(np.abs(rate)) < 1e-12
    np.testing.assert_allclose(jnp.sum(found.state.p**2, axis=1), 1, atol=1e-15)
    distance = np.linalg.norm(found.state.r - guess.r, axis=1)
    assert float(found.largest_displacement) == pytest.approx(np.max(distance), rel=1e-12)
    assert float(found.largest_displacement) > 1e-3


def test_it_is_the_nearest_in_the_mass_metric(bars, near):
    """The step satisfies Lagrange's condition: M step is in the range of (dPhi/dstep)^T."""
    system, guess, found = near
    p = guess.p / jnp.linalg.norm(guess.p, axis=1, keepdims=True)
    turned = [
        stm.rotation.to_rotation_vector(stm.rotation.product(stm.rotation.conjugate(a), b))
        for a, b in zip(p, found.state.p, strict=True)
    ]
    step = np.concatenate([found.state.r - guess.r, jnp.stack(turned)], axis=1)
    r, q = move_bodies(guess.r, p, jnp.asarray(step))
    assert relative_error(r, found.state.r) < 1e-12
    assert np.max(np.abs(np.abs(np.sum(np.asarray(q * found.state.p), axis=1)) - 1)) < 1e-12
    model = stm.Augmented().prepare(system)

    @jax.jit
    def phi(step):
        at = stm.State(*move_bodies(guess.r, p, step.reshape(3, 6)), guess.v, guess.omega)
        return model.constraints.equations(jnp.zeros(()), system.kinematics(at)).value

    slope = np.asarray(jax.jacfwd(phi)(jnp.asarray(step.reshape(-1))))
    weighed = np.concatenate(
        [
            np.asarray(system.bodies.mass)[:, None] * step[:, :3],
            np.einsum("nab,nb->na", system.bodies.inertia, step[:, 3:]),
        ],
        axis=1,
    ).reshape(-1)
    left = weighed - slope.T @ np.linalg.lstsq(slope.T, weighed)[0]
    assert np.max(np.abs(left)) < 1e-11 * np.max(np.abs(weighed))


def test_velocities_are_the_nearest_in_the_mass_metric(near):
    """M (u - u_guess) is in the range of J^T."""
    system, guess, found = near
    model = stm.Augmented().prepare(system)
    eq = rows_of(model, found.state)
    v, omega = found.state.v - guess.v, found.state.omega - guess.omega
    weighed = np.concatenate(
        [system.bodies.mass[:, None] * v, jnp.einsum("nab,nb->na", system.bodies.inertia, omega)],
        axis=1,
    ).reshape(-1)
    J = np.asarray(eq.matrix)
    left = weighed - J.T @ np.linalg.lstsq(J.T, weighed)[0]
    assert np.max(np.abs(left)) < 1e-12 * np.max(np.abs(weighed))


@pytest.mark.parametrize("what", ["position", "orientation"])
def test_held_bodies_stay(bars, what):
    """The crank keeps what is held; the rest closes around it."""
    system, state = bars
    guess = shaken(state, 0.01, seed=3)
    posture = np.concatenate([[np.cos(0.01)], [0, np.sin(0.01), 0]])
    half = np_rotation(posture) @ (FOUR_BAR_POINTS[1] / 2)
    r = guess.r.at[0].set(half)
    p = guess.p.at[0].set(posture)
    found = stm.assemble(
        system, stm.State(r, p, guess.v * 0, guess.omega * 0), hold={"crank": what}
    )
    assert bool(found.converged)
    if what == "position":
        np.testing.assert_allclose(found.state.r[0], half, atol=1e-15)
    else:
        np.testing.assert_allclose(found.state.p[0], posture, atol=1e-15)
    assert np.max(np.abs(residuals(system, found.state)[0])) < 1e-12
    assert np.max(np.abs(found.state.r[1] - r[1])) > 1e-5


def test_held_velocities_stay(bars):
    system, state = bars
    v = state.v.at[1:].set(0.3)
    found = stm.assemble(system, stm.State(state.r, state.p, v, state.omega), hold={"crank": "all"})
    np.testing.assert_allclose(found.state.v[0], state.v[0], atol=1e-15)
    np.testing.assert_allclose(found.state.omega[0], state.omega[0], atol=1e-15)
    assert relative_error(found.state.v, state.v) < 1e-11
    assert relative_error(found.state.omega, state.omega) < 1e-11


def test_held_joints_keep_their_coordinates():
    """A slider on a rail along x, a pendulum on it about y, and a plunger whose joint holds angle and shift."""
    bodies = [
        stm.Body("slider", 2.0, [0.1, 0.1, 0.1]),
        stm.Body("rod", 1.0, [0.1, 0.1, 0.1], position=[0, 0, -0.5]),
        stm.Body("plunger", 1.0, [0.1, 0.1, 0.2], position=[0.5, 0, 0]),
    ]
    joints = [
        stm.translational("rail", "ground", "slider", axis=[1, 0, 0]),
        stm.revolute("hinge", "slider", "rod", point=[0, 0, 0], axis=[0, 1, 0]),
        stm.cylindrical("C", "ground", "plunger", point=[0, 0, 0], axis=[0, 0, 1]),
    ]
    system = stm.System(bodies, joints)
    upright = [1.0, 0, 0, 0]
    guess = state_of(
        [[0.3, 0.01, 0.02], [0.1, 0, -0.4], [0.5, 0.1, 0.3]],
        [upright, turn([0, 1, 0], 0.4), upright],
    )
    held = stm.assemble(system, guess, hold_joints=("rail", "hinge", "C")).state
    np.testing.assert_allclose(held.r[0], [0.3, 0, 0], atol=1e-12)
    np.testing.assert_allclose(abs(held.p[1] @ turn([0, 1, 0], 0.4)), 1, atol=1e-12)
    np.testing.assert_allclose(
        held.r[1], [0.3 - 0.5 * np.sin(0.4), 0, -0.5 * np.cos(0.4)], atol=1e-12
    )
    np.testing.assert_allclose(held.r[2], [0.5, 0, 0.3], atol=1e-12)
    np.testing.assert_allclose(held.p[2], upright, atol=1e-12)


@pytest.mark.slow
def test_drivers_are_met_at_their_times_and_differentiated_by_them():
    """A crank that a motor turns by 0.3 + 2 t about y: under jit, vmap and jvp, in closed form."""
    body = stm.Body("crank", 1.0, [0.1, 0.1, 0.1], position=[0.2, 0, 0])
    joint = stm.revolute("J", "ground", "crank", point=[0, 0, 0], axis=[0, 1, 0])
    motor = stm.drive("motor", joint, lambda t: 0.3 + 2 * t, coordinate="angle")
    system = stm.System([body], [joint, motor])
    place = lambda t: stm.assemble(system, system.reference, t, throw=False).state
    times = np.array([0.0, 0.05, 0.1])
    along = jax.jit(jax.vmap(lambda t: jax.jvp(place, (t,), (jnp.ones(()),))))
    states, rates = along(jnp.asarray(times))
    half, none = 0.15 + times, 0 * times
    out = lambda angle: np.stack([np.cos(angle), none, -np.sin(angle)], axis=1)
    aside = lambda angle: np.stack([-np.sin(angle), none, -np.cos(angle)], axis=1)
    np.testing.assert_allclose(states.r[:, 0], 0.2 * out(2 * half), atol=1e-12)
    p = np.stack([np.cos(half), none, np.sin(half), none], axis=1)
    np.testing.assert_allclose(states.p[:, 0], p, atol=1e-12)
    np.testing.assert_allclose(states.v[:, 0], 0.4 * aside(2 * half), atol=1e-12)
    np.testing.assert_allclose(states.omega[:, 0], np.tile([0, 2.0, 0], (3, 1)), atol=1e-12)
    np.testing.assert_allclose(rates.r[:, 0], 0.4 * aside(2 * half), atol=1e-11)
    np.testing.assert_allclose(rates.v[:, 0], -0.8 * out(2 * half), atol=1e-11)
    p_rate = np.stack([-np.sin(half), none, np.cos(half), none], axis=1)
    np.testing.assert_allclose(rates.p[:, 0], p_rate, atol=1e-11)


@pytest.mark.slow
def test_derivatives_in_a_dimension_of_a_loop(bars):
    """The assembled four-bar by the position of a joint in its coupler."""
    system, state = bars
    guess = shaken(state, 0.01, seed=5)

    def total(h):
        joints = [*system.joints]
        place = [j.name for j in joints].index("C")
        moved = joints[place].point_i + h * jnp.asarray([1.0, 0.0, 0.5])
        changed = eqx.tree_at(lambda s: s.joints[place].point_i, system, moved)
        out = stm.assemble(changed, guess, throw=False).state
        return jnp.sum(jnp.sin(out.r)) + jnp.sum(out.p[:, 2]) + jnp.sum(out.v * out.omega)

    gradient = float(jax.jit(jax.grad(total))(0.0))
    along = jax.jit(lambda h: jax.jvp(total, (h,), (1.0,)))
    rate = float(along(0.0)[1])
    expected = float(central(lambda h: along(h)[0], 1e-4))
    assert abs(expected) > 0.1
    assert gradient == pytest.approx(expected, rel=1e-6)
    assert rate == pytest.approx(gradient, rel=1e-9)


# --- what cannot be assembled


def impossible():
    """A rod between two points of bodies that the joints keep apart."""
    body = stm.Body("b", 1.0, [1, 1, 1], position=[1, 0, 0])
    joints = [
        stm.revolute("J", "ground", "b", point=[0, 0, 0], axis=[0, 0, 1]),
        stm.distance("rod", "ground", "b", point_i=[3, 0, 0], point_j=[1, 0, 0], length=1.5),
    ]
    return stm.System([body], joints)


@pytest.mark.slow
def test_impossible_lengths_are_an_error_that_names_a_joint():
    system = impossible()
    with pytest.raises(stm.StateError, match=r"joint '(rod|J)' has a residual of .* m"):
        stm.assemble(system, system.reference)
    found = stm.assemble(system, system.reference, throw=False)
    assert not bool(found.converged)
    assert float(jnp.max(found.residuals)) > 1e-3


def test_bad_guesses_are_refused(bars):
    system, s = bars
    for guess, words in (
        (stm.State(s.r * jnp.nan, s.p, s.v, s.omega), "guess for body 'crank' must be finite"),
        (stm.State(s.r, s.p, s.v, s.omega.at[2].set(jnp.inf)), "body 'rocker' must be finite"),
        (stm.State(s.r, s.p.at[1].set(0.0), s.v, s.omega), "'coupler' are all zero"),
    ):
        with pytest.raises(stm.StateError, match=words):
            stm.assemble(system, guess)


def test_unknown_names_are_refused(bars):
    system, state = bars
    with pytest.raises(stm.ModelError, match="no body 'krank'"):
        stm.assemble(system, state, hold={"krank": "all"})
    with pytest.raises(stm.ModelError, match="no joint 'Z'"):
        stm.assemble(system, state, hold_joints=("Z",))
    with pytest.raises(stm.ModelError, match="a spherical joint does not leave it free"):
        stm.assemble(system, state, hold_joints=("B",))
