"""Trim and linearisation of the UAV: published figures, another formulation, differences."""

import inspect
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.linalg import expm
from uav_numbers import STORED, same

import stmuav_jax as stm
from stmuav_jax.dynamics.statespace.base import error_rates
from stmuav_jax.flight.flight_trim import (
    TrimLimits,
    TrimReason,
    climb,
    cruise,
    hover,
    steady_turn,
    trim_flight,
)
from stmuav_jax.flight.flyer import STATES, Flyer
from stmuav_jax.flight.linear import linearize
from stmuav_jax.mechanics.inputs import inputs_of
from stmuav_jax.rotorcraft.allocation import RotorLimits, minimum_norm, wrench_map
from stmuav_jax.scenes.uav_tracker import uav_flyer
from stmuav_jax.tracker.kinematics import Reason

START = stm.tracker.initial_angles(stm.PART_II)


# phi, theta in degrees and the limit of the table that each breaks
OUTSIDE = {
    TrimReason.VALID: (10.0, 10.0),
    TrimReason.TILT: (20.0, 62.0),
    TrimReason.SINGULAR: (-55.0, 0.0),
    TrimReason.STROKE_2: (0.0, -36.0),
    TrimReason.STROKE_3: (55.0, -12.0),
    TrimReason.POSTURE: (0.0, -60.0),
}


@pytest.fixture(scope="module")
def flyer():
    return uav_flyer()


@pytest.fixture(scope="module")
def many(flyer):
    """Trims at several panel angles, the first the initial ones; the 16th out of reach.

    Then one for each of OUTSIDE.
    """
    angles = np.random.default_rng(5).uniform(-0.5, 0.5, (16, 2))
    angles[0] = START
    angles[-1] = [0.2, -1.5]
    angles = np.concatenate([angles, np.radians(list(OUTSIDE.values()))])
    both = jax.vmap(lambda a: trim_flight(flyer, hover(a), throw=False))
    return angles, stm.algebra.outer_jit(both)(jnp.asarray(angles))


@pytest.fixture(scope="module")
def start(many):
    return jax.tree.map(lambda x: x[0], many[1])


def test_hover_speeds(many):
    """The trimmed speeds at the initial posture, by a program written apart from this one."""
    angles, found = many
    expected = [1361.0, 1359.7, 1355.0, 1351.7, 1353.0, 1357.6]
    np.testing.assert_allclose(found.speeds[0], expected, atol=0.05)
    assert list(np.asarray(found.reason)) == [0] * 15 + [TrimReason.POSTURE, *OUTSIDE]
    assert np.max(found.residual[:15]) < 1e-10
    assert np.all(np.isnan(found.speeds[15]))
    assert np.ptp(np.asarray(found.inputs.forces[:15]), axis=0).min() > 1e-3
    assert len(angles) == 22


def test_trims_of_an_earlier_commit(many):
    """Before the package was rebuilt, at the first six of the panel's angles."""
    found = many[1]
    for k, stored in enumerate(STORED["trims"]):
        same(found.speeds[k], stored["speeds"])
        same(found.inputs.forces[k], stored["forces"])


def test_thrust_carries_the_weight(flyer, start):
    k_f = flyer.system.forces[flyer.rotors].k_f
    weight = 9.81 * float(np.sum(flyer.system.bodies.mass))
    assert float(k_f * jnp.sum(start.speeds**2)) == pytest.approx(weight, rel=1e-12)
    np.testing.assert_allclose(start.coordinates.p, [1, 0, 0, 0], atol=1e-12)


def test_nothing_accelerates_in_maximal_coordinates(flyer, start):
    state = flyer.to_state(start.coordinates)
    found = jax.jit(lambda s, i: stm.dynamics.evaluate(flyer.with_inputs(i), s))(
        state, start.inputs
    )
    assert np.max(np.abs(found.accelerations.v_rate)) < 1e-10
    assert np.max(np.abs(found.accelerations.omega_rate)) < 1e-8


@pytest.mark.slow
def test_derivative_by_every_parameter():
    """Of a turn through the air, where all of them count, against differences of trims.

    Derivatives are by relative changes, or by changes of a parameter's largest entry.
    """
    groups = (
        "mass.",
        "inertia.",
        "rotor.",
        "gravity",
        "mount.",
        "actuator.axis",
        "geometry.",
        "drag.",
    )
    names = [k for k in stm.PART_II if k.startswith(groups) and k != "rotor.spin"]
    table = {k: jnp.asarray(stm.PART_II.value(k), dtype=float) for k in names}
    sizes = jax.tree.map(lambda x: jnp.full_like(x, jnp.max(jnp.abs(x))), table)
    flat, unravel = ravel_pytree((table, START))
    scale, _ = ravel_pytree((sizes, jnp.full(2, 0.3)))

    def solved(change):
        values, angles = unravel(flat + scale * change)
        # tensors are symmetric, and are taken to be
        values = {k: (v + v.T) / 2 if k.startswith("inertia.") else v for k, v in values.items()}
        changed = uav_flyer(stm.PART_II.replaced(values), drag=stm.scenes.Drag())
        found = trim_flight(changed, steady_turn(3.0, 0.8, angles), throw=False)
        turned = stm.rotation.to_rotation_vector(found.coordinates.p)
        return jnp.concatenate([found.speeds / 1350.0, found.inputs.forces, turned])

    def by_all(h):
        """Second-order differences by every parameter, one column each."""
        steps = h * jnp.eye(len(flat))
        ahead, behind = run(jnp.concatenate([steps, -steps])).reshape(2, len(flat), -1)
        return np.asarray(ahead - behind).T / (2 * h)

    run = stm.algebra.outer_jit(lambda steps: jax.lax.map(solved, steps, batch_size=32))
    wide, narrow = by_all(2e-3), by_all(1e-3)
    expected = (4 * narrow - wide) / 3
    assert np.all(np.isfinite(expected))
    push = lambda e: jax.jvp(solved, (jnp.zeros_like(flat),), (e,))[1]
    ways = jnp.eye(len(flat))
    exact = np.asarray(stm.algebra.outer_jit(lambda e: jax.lax.map(push, e, batch_size=32))(ways)).T
    reached = np.max(np.abs(exact), axis=0)
    # products of inertia and the places of the actuators' couples hardly count
    assert np.sum(reached > 1e-4) > 0.5 * len(flat)
    for k, (column, right) in enumerate(zip(exact.T, expected.T, strict=True)):
        np.testing.assert_allclose(column, right, rtol=1e-7, atol=1e-7 * reached[k] + 1e-10)


def test_refused(flyer):
    slow = TrimLimits(RotorLimits(0.0, 1350.0))
    with pytest.raises(stm.ModelError, match=r"72\.25 N are required, but within .* 71\.58 N"):
        trim_flight(flyer, hover(START), slow)
    weak = TrimLimits(actuator=0.1)
    with pytest.raises(stm.StateError, match=r"N, but the limit is 0\.1 N"):
        trim_flight(flyer, hover(START), weak)
    with pytest.raises(stm.StateError, match="cannot take the panel angles"):
        trim_flight(flyer, hover([0.2, -1.5]))
    with pytest.raises(stm.ModelError, match="either the panel's angles or the direction"):
        hover(START, sun=[0, 0, 1.0])
    with pytest.raises(
        stm.ModelError, match=r"sun must be numbers of shape \(3,\), but its shape is \(2,\)"
    ):
        hover(sun=[0, 1.0])
    bare = eqx.tree_at(lambda s: s.forces, flyer.system, flyer.system.forces[:2])
    with pytest.raises(stm.ModelError, match="one LinearActuator for each slider"):
        Flyer(bare, flyer.geometry, flyer.displacement)


def test_outside_the_workspace(flyer, many):
    """Each limit has its reason; the values stay, and are those of a trim without the limit."""
    angles, found = many[0][16:], jax.tree.map(lambda x: x[16:], many[1])
    assert np.all(np.isfinite(found.speeds[:5]))
    assert np.all(np.isnan(found.speeds[5]))
    wide = TrimLimits(workspace=stm.tracker.Limits(home=(0.0, 0.0), tilt=np.pi))
    for at, speeds in zip(angles[:5], np.asarray(found.speeds), strict=False):
        free = trim_flight(flyer, hover(at), wide)
        np.testing.assert_allclose(free.speeds, speeds, rtol=1e-9)
    # the workspace's own map
    seen = stm.tracker.survey(flyer.geometry, angles[:5].T, flyer.limits).reason
    assert [Reason(int(k)).name for k in np.asarray(seen)] == [k.name for k in list(OUTSIDE)[:5]]


def test_words_for_what_is_outside(flyer):
    """As `aim` says it: the limit, and by how much it is passed."""
    with pytest.raises(stm.StateError, match=r"theta = 62 degrees .* the tilt limit of 60"):
        trim_flight(flyer, hover(np.radians([20.0, 62.0])))
    with pytest.raises(
        stm.StateError, match=r"slider 3 would have to stand at 102\.5 mm .* 100 mm"
    ):
        trim_flight(flyer, hover(np.radians([59.9, 0.0])))
    with pytest.raises(stm.StateError, match=r"too near the singularity .* at least 0\.05"):
        trim_flight(flyer, hover(np.radians([-55.0, 0.0])))


def test_other_things_in_place_of_a_flight(flyer):
    bare = inspect.unwrap(trim_flight)
    with pytest.raises(stm.ModelError, match=r"a steady flight, such as hover.* not 'hover'"):
        bare(flyer, "hover")
    with pytest.raises(stm.ModelError, match=r"must be a Flyer, .* not a System"):
        bare(flyer.system, hover(START))
    with pytest.raises(stm.ModelError, match="must be a TrimLimits, not a RotorLimits"):
        bare(flyer, hover(START), RotorLimits(0.0, 1e3))
    with pytest.raises(stm.ModelError, match="positive number of newtons, not nan"):
        trim_flight(flyer, hover(START), TrimLimits(actuator=np.nan))
    with pytest.raises(stm.ModelError, match=r"climb must be a number \[m/s\], but it is 'a'"):
        climb("a", START)
    with pytest.raises(stm.ModelError, match=r"level speed must be a number .* shape is \(2,\)"):
        cruise([1, 2], angles=START)
    with pytest.raises(stm.ModelError, match="rate of turn must be finite, but it is nan"):
        steady_turn(1.0, np.nan, START)


def test_within_rotor_limits(flyer, start):
    """Limits that the speeds of least norm break: others give the same wrench."""
    highest = 0.5 * float(start.speeds[0] + start.speeds[1])
    found = trim_flight(flyer, hover(START), TrimLimits(RotorLimits(0.0, highest)))
    assert np.max(found.speeds) <= highest * (1 + 1e-12)
    assert float(found.residual) < 1e-10
    assert found.null_space_dimension == 2
    B = wrench_map(flyer.system.forces[flyer.rotors], jnp.array([0.01, -0.02, 0.05]))
    np.testing.assert_allclose(
        B @ found.inputs.speed_squared, B @ start.inputs.speed_squared, rtol=1e-10, atol=1e-12
    )


def test_least_norm_allocation(flyer):
    rotors = flyer.system.forces[flyer.rotors]
    B = np.asarray(wrench_map(rotors, jnp.array([0.01, -0.02, 0.05])))
    wrench = np.array([70.0, 0.3, -0.2, 0.05])
    u = np.asarray(minimum_norm(jnp.asarray(B), jnp.asarray(wrench)))
    np.testing.assert_allclose(u, np.linalg.pinv(B) @ wrench, rtol=1e-10)
    full = np.asarray(rotors.wrench(jnp.asarray(u), jnp.array([0.01, -0.02, 0.05])))
    np.testing.assert_allclose(full, [0, 0, *wrench], atol=1e-12)


def rates(flyer, trimmed, v, du):
    """What the linear equations approximate."""
    inputs = inputs_of(flyer.system)
    held = jnp.concatenate(trimmed.inputs)
    moved, still = (inputs.applied(flyer.system, u) for u in (held + du, held))
    return error_rates(flyer, trimmed.coordinates, v, 0.0, moved, still)


@pytest.fixture(scope="module")
def linear(flyer, start):
    return linearize(flyer, start.coordinates, values=jnp.concatenate(start.inputs))


def test_linear_model_of_an_earlier_commit(linear):
    same(linear.A, STORED["linear"]["A"])
    # inputs are squared speeds and newtons
    same(linear.B, STORED["linear"]["B"], axis=0)


def test_linear_to_second_order(flyer, start, linear):
    """What the linear equations miss falls with the square of the displacement."""
    rng = np.random.default_rng(6)
    x, du = rng.normal(size=16) * 0.05, rng.normal(size=8) * np.array([*[2e3] * 6, 0.05, 0.05])
    of = jax.jit(lambda s: rates(flyer, start, s * x, s * du))
    missed = [np.asarray(of(s)) - s * (linear.A @ x + linear.B @ du) for s in (1.0, 0.5, 0.25)]
    sizes = [np.linalg.norm(m) for m in missed]
    assert 3.5 < sizes[0] / sizes[1] < 4.5
    assert 3.7 < sizes[1] / sizes[2] < 4.3


def test_matrices_against_differences(flyer, start, linear):
    """Of fourth order, of the nonlinear rates: every column of A and B."""
    sizes = np.array([1e-3] * 16 + [1e3] * 6 + [1e-2] * 2)
    of = lambda z: rates(flyer, start, z[:16], z[16:])
    run = jax.jit(jax.vmap(of))
    step = lambda k: np.asarray(run(jnp.asarray(k * np.diag(sizes))))
    J = ((8 * (step(1) - step(-1)) - (step(2) - step(-2))) / 12).T / sizes
    # columns of zeros carry round-off over the step
    floor = 1e-13 / sizes
    for found, right, rest in zip(np.hstack([linear.A, linear.B]).T, J.T, floor, strict=True):
        np.testing.assert_allclose(found, right, atol=1e-6 * np.max(np.abs(right)) + rest)


def test_linear_against_the_simulated_flight(flyer, start, linear):
    """A small displacement's path over 0.1 s, in maximal coordinates, against expm(A t) x."""
    x = np.zeros(16)
    x[3:8], x[14:] = [1e-6, -2e-6, 1e-6, 2e-6, -1e-6], [1e-5, 2e-5]
    system = flyer.with_inputs(start.inputs)
    ends = []
    run = jax.jit(
        lambda s: stm.integrate(
            system, s, jnp.array([0.0, 0.1]), stm.Method(rtol=1e-11, atol=1e-13)
        )
    )
    for sign in (1, -1):
        ends.append(
            run(flyer.to_state(flyer.retract(start.coordinates, jnp.asarray(sign * x)))).states
        )
    later = expm(linear.A * 0.1) @ x
    moved = (np.asarray(ends[0].r[-1, 0]) - np.asarray(ends[1].r[-1, 0])) / 2
    spun = (np.asarray(ends[0].omega[-1, 0]) - np.asarray(ends[1].omega[-1, 0])) / 2
    np.testing.assert_allclose(moved, later[:3], rtol=1e-6, atol=1e-6 * np.max(np.abs(later[:3])))
    np.testing.assert_allclose(spun, later[11:14], rtol=1e-5, atol=1e-5 * np.max(np.abs(spun)))


def test_modes_and_measures(linear):
    """Two falling panel modes in pairs, twelve of a rigid body; all inputs together move them."""
    modes = linear.modes()
    real = np.array([m.eigenvalue.real for m in modes])
    assert real[0] == pytest.approx(-real[-1], rel=1e-6)
    assert real[1] == pytest.approx(-real[-2], rel=1e-6)
    assert 5 < real[1] < real[0] < 15
    assert np.max(np.abs(real[2:-2])) < 1e-4
    assert {name for name, _ in modes[0].states[:2]} == {"theta", "theta_rate"}
    assert modes[0].doubling_time == pytest.approx(np.log(2) / real[0])
    assert np.min(linear.controllability()) > 1e-3
    deaf = replace(linear, B=np.zeros_like(linear.B))
    assert np.max(deaf.controllability()) < 1e-6
    assert len(linear.states) == len(STATES) == 16


def test_outputs_by_name(flyer, start):
    few = linearize(
        flyer, start.coordinates, values=jnp.concatenate(start.inputs), outputs=["phi", "r_z"]
    )
    assert few.C.shape == (2, 16)
    assert [name for name, _ in few.outputs] == ["phi", "r_z"]
    assert np.min(few.observability()) < 1e-6
    with pytest.raises(stm.SettingError, match="Did you mean 'omega_x'"):
        linearize(
            flyer, start.coordinates, values=jnp.concatenate(start.inputs), outputs=["omega_xx"]
        )
    for none in ([], "omega_x", ["omega_x", 3]):
        with pytest.raises(stm.SettingError, match=r"a list of names of states, such as .*, not "):
            linearize(flyer, start.coordinates, values=jnp.concatenate(start.inputs), outputs=none)


def test_acceleration_upwards(flyer):
    """Thrust is m (g + a)."""
    up = climb(2.0, START, 0.3)._replace(acceleration=jnp.array([0.0, 0.0, 1.5]))
    found = trim_flight(flyer, up)
    k_f, mass = flyer.system.forces[flyer.rotors].k_f, float(np.sum(flyer.system.bodies.mass))
    assert float(k_f * jnp.sum(found.speeds**2)) == pytest.approx(mass * 11.31, rel=1e-12)


@pytest.mark.slow
def test_panel_at_the_sun(flyer):
    """In level hover the panel's angles are those of the inverse kinematics in the yawed base."""
    s_w = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    found = trim_flight(flyer, hover(sun=s_w, yaw=0.4))
    c, s = np.cos(0.4), np.sin(0.4)
    s_b = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) @ s_w
    np.testing.assert_allclose(stm.tracker.panel_normal(found.coordinates.angles), s_b, atol=1e-12)
    with pytest.raises(stm.StateError, match=r"theta = 87\.\d+ degrees .* the tilt limit of 60"):
        trim_flight(flyer, hover(sun=[1.0, 0.0, 0.05]))


def test_steady_turn_stays_steady(flyer):
    """Flown for half a second, the base moves on its circle; its attitude turns with it."""
    speed, rate = 3.0, 0.8
    found = trim_flight(flyer, steady_turn(speed, rate, START))
    bank = np.arctan(speed * rate / 9.81)
    up = np.asarray(stm.rotation.rotation_matrix(found.coordinates.p))[:, 2]
    assert np.arccos(up[2]) == pytest.approx(bank, rel=0.02)
    system, state = flyer.with_inputs(found.inputs), flyer.to_state(found.coordinates)
    run = jax.jit(lambda s: stm.integrate(system, s, jnp.array([0.0, 0.5]), stm.Method(rtol=1e-11)))
    end = jax.tree.map(lambda x: np.asarray(x[-1, 0]), run(state).states)
    angle, radius = rate * 0.5, speed / rate
    # the centre of the circle lies to the left
    expected = radius * np.array([np.sin(angle), 1 - np.cos(angle), 0])
    np.testing.assert_allclose(end.r, expected, atol=1e-7)
    np.testing.assert_allclose(end.omega, found.coordinates.omega, atol=1e-6)


def test_cruise_without_drag_is_hover(flyer, start):
    found = trim_flight(flyer, cruise(4.0, 0.7, START))
    np.testing.assert_allclose(found.speeds, start.speeds, rtol=1e-10)
    assert 0 < float(found.conditioning) < 1
