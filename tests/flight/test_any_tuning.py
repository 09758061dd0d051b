"""Tuned inputs, identification and flight conditions of mechanisms that are not the UAV."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from mechanisms import cart_pole, four_bar, ground_tracker

import stmuav_jax as stm
from stmuav_jax.algebra.least_squares import evaluated, value_and_columns
from stmuav_jax.algebra.sampled import Sampled
from stmuav_jax.flight.identification import Misfit, predicted, residuals_and_jacobian
from stmuav_jax.rotorcraft.rotor import hover_speed_squared


@pytest.fixture(scope="module")
def cart():
    space = stm.TreeSpace(cart_pole())
    return space, space.from_state(space.system.reference)


class Most(eqx.Module):
    """How far an effort is beyond what a motor has."""

    effort: Array

    def __call__(self, motion):
        return jnp.abs(motion.extremes) / self.effort - 1


@pytest.fixture(scope="module")
def pushed(cart):
    """A problem in two segments, and unknowns that are not those of its start."""
    space, x = cart
    tuning = stm.flight.tune_inputs(
        space, [stm.flight.end_at(space, x)], start=x, duration=0.2, inputs=["effort"],
        sizes=[10.0], knots=8, segments=2,
    )  # fmt: skip
    return tuning, jax.tree.map(lambda v: v + 0.1, tuning.start)


def test_columns_in_groups_and_values_alone(pushed):
    """Derivatives against differences; values without them come from one program, and are the same."""
    tuning, start = pushed
    function = tuning.residuals
    value, columns = evaluated(function, start)
    flat, unravel = ravel_pytree(start)
    whole = lambda y: ravel_pytree(evaluated(function, unravel(y), columns=False)[0])[0]
    np.testing.assert_array_equal(whole(flat), ravel_pytree(value)[0])
    J = np.concatenate([c.reshape(-1, len(flat)) for c in jax.tree.leaves(columns)])
    h = 1e-5
    differences = [(whole(flat + h * e) - whole(flat - h * e)) / (2 * h) for e in np.eye(len(flat))]
    np.testing.assert_allclose(J, np.stack(differences, axis=1), atol=1e-7 * np.max(np.abs(J)))


def test_residuals_within_a_program_are_the_same(pushed):
    """Traced by JAX, residuals and derivatives are those that a search evaluates in parts."""
    tuning, start = pushed
    value, columns = evaluated(tuning.residuals, start)
    traced, J = value_and_columns(tuning.residuals, start)
    for found, wanted in ((traced, value), (J, columns)):
        found, wanted = (ravel_pytree(x)[0] for x in (found, wanted))
        np.testing.assert_allclose(found, wanted, atol=1e-8 * np.max(np.abs(wanted)))


def test_a_motion_in_parts_is_that_in_one_piece(cart, pushed):
    """23 output times, not a multiple of a call's, and two: the motion by `integrate`, to 1e-8."""
    space, x = cart
    tuning, start = pushed
    problem = tuning.residuals
    system = problem.system(start["values"])
    for count in (23, 2):
        motion = tuning.motion(start, count)
        ts = jnp.linspace(0.0, 0.2, count)
        run = stm.dynamics.integrate(system, space.to_state(x), ts, problem.method)
        off = jax.vmap(space.difference)(motion.points, jax.vmap(space.from_state)(run.states))
        assert float(jnp.max(jnp.abs(off))) < 1e-8
        assert tuning.motion(start, count) is motion


@pytest.mark.slow
def test_a_cart_is_moved_with_its_pole_upright(cart):
    """A force history after which the cart rests half a metre further on, to 1e-8."""
    space, x = cart
    target = space.retract(x, jnp.array([0.5, 0.0, 0.0, 0.0]))
    tuning = stm.flight.tune_inputs(
        space, [stm.flight.end_at(space, target)], start=x, duration=1.5, inputs=["effort"],
        sizes=[10.0], knots=8,
    )  # fmt: skip
    found = tuning.search()
    motion = tuning.motion(found.values)
    end = jax.tree.map(lambda leaf: leaf[-1], motion.points)
    assert float(jnp.max(jnp.abs(space.difference(end, target)))) < 1e-8
    assert motion.inputs.shape == (200, 1)
    assert tuning.inputs(found.values)(jnp.asarray(0.3)).shape == (1,)


def test_a_limit_counts_only_beyond(cart):
    """A hundredfold share of what is passed, as a root mean square over the motion."""
    space, x = cart
    inputs = jnp.array([[8.0], [-12.0], [10.0], [15.0]])
    motion = stm.flight.TunedMotion(jnp.arange(4.0), x, inputs, inputs, inputs, space, space.system)
    found = stm.flight.Limit(Most(jnp.asarray(10.0)))(motion)
    np.testing.assert_allclose(found, [[0.0], [10.0], [0.0], [25.0]], rtol=1e-12)
    np.testing.assert_allclose(stm.flight.roughness(motion), [[42.0], [-17.0]])


def test_extremes_of_a_history(cart):
    """Those of the spline at 20,001 times, to the square of their spacing; and so its derivative."""
    space, x = cart
    near = [stm.flight.departures(space, x)]
    tuning = stm.flight.tune_inputs(
        space, near, start=x, duration=1.5, inputs=["effort"], sizes=[10.0], knots=8
    )
    cost: Any = tuning.residuals.cost
    signals = cost.driven.signals
    values = np.random.default_rng(0).normal(size=(3, 8, 1))
    values[2] = np.array([0, 0, 1, 1, 1, 1, 0, 0.0])[:, None]  # pieces without a cubic part
    ts = jnp.linspace(0.0, 1.5, 20_001)
    most = jax.jit(lambda v: jnp.max(signals.extremes(v)))
    dense = jax.jit(lambda v: jnp.max(jax.vmap(signals(v))(ts)))
    for v in values:
        assert 0 <= float(most(v) - dense(v)) < 1e-5
        np.testing.assert_allclose(jax.grad(most)(v), jax.grad(dense)(v), atol=2e-3)


@pytest.mark.slow
def test_a_limit_is_kept_or_said_to_be_passed(cart):
    """A force within its limit at all times; told so where the limit leaves too little of it."""
    space, x = cart
    target = space.retract(x, jnp.array([0.5, 0.0, 0.0, 0.0]))

    def made(effort, weight=100.0):
        limit = stm.flight.Limit(Most(jnp.asarray(effort)), jnp.asarray(weight))
        return stm.flight.tune_inputs(
            space, [stm.flight.end_at(space, target), limit], start=x, duration=1.5,
            inputs=["effort"], sizes=[10.0], knots=8,
        )  # fmt: skip

    tuning = made(12.0)  # 14.6 N without a limit
    found = tuning.search(steps=60, patience=20)
    force = np.asarray(tuning.motion(found.values, 2000).inputs)
    assert 11.9 < np.max(np.abs(force)) < 12.0 * (1 + 1e-4)
    assert tuning.excess(found.values)[0] < 1e-4
    # a limit that weighs next to nothing against the target is passed, and the search says so
    weak = made(6.0, weight=1e-6)
    found = weak.search(steps=60, patience=10)
    assert weak.excess(found.values)[0] > 0.01
    assert found.reason is stm.algebra.SearchReason.LIMIT_PASSED
    assert "passes a limit" in found.words()


@pytest.mark.slow
def test_a_torque_that_holds_a_four_bar():
    """A constant found by the motion alone is that of the trim."""
    space = stm.TreeSpace(four_bar(), independent=["A.angle"])
    x = space.from_state(space.system.reference)
    near = [stm.flight.departures(space, x)]
    tuning = stm.flight.tune_inputs(space, near, start=x, duration=0.3, sizes=[5.0], weight=10.0)
    found = tuning.search()
    held = stm.trim(space, at=x).values
    np.testing.assert_allclose(tuning.inputs(found.values), held, rtol=1e-8)


def test_what_tuning_refuses(cart):
    space, x = cart
    near = [stm.flight.departures(space, x)]
    with pytest.raises(stm.SettingError, match="at least one residual"):
        stm.flight.tune_inputs(space, [], start=x, duration=1.0)
    with pytest.raises(stm.SettingError, match="name 'force', which is no input"):
        stm.flight.tune_inputs(space, near, start=x, duration=1.0, inputs=["force"])
    with pytest.raises(stm.ModelError, match=r"must have shape \(5, 1\), not \(4, 1\)"):
        stm.flight.tune_inputs(space, near, start=x, duration=1.0, knots=5, values=np.zeros((4, 1)))
    with pytest.raises(stm.SettingError, match="name 'hinge', which is no state"):
        stm.flight.departures(space, x, {"hinge": 1.0})


# --- identification


def fitted(predict, truth, sizes, sigma, labels):
    """From a start that is off by half of the sizes: without noise, and with it."""
    # predictions by the program that identification compiles anyway
    shape = eqx.filter_eval_shape(predicted, predict, jnp.asarray(truth)).shape
    zero, one = jnp.zeros(len(truth)), jnp.ones(len(truth))
    none = Misfit(predict, jnp.zeros(shape), jnp.ones(shape[1]), jnp.asarray(truth), one)
    clean = np.asarray(residuals_and_jacobian(none, zero)[0]).reshape(shape)
    start = truth + 0.5 * sizes * (-1.0) ** np.arange(len(truth))
    rng = np.random.default_rng(7)
    noisy = clean + sigma * rng.normal(size=clean.shape)
    return [
        stm.flight.identify(predict, record, sigma, start, sizes, labels=labels)
        for record in (clean, noisy)
    ]


@pytest.mark.slow
def test_a_cart_pole_is_identified(cart):
    """Bob, length and damping from the cart's place, the pole's angle and its gyroscope."""
    space = stm.TreeSpace(cart_pole(damping=0.05))
    x = space.from_state(space.system.reference)
    knots = np.linspace(0.0, 0.8, 7)
    push = Sampled(knots, 6.0 * np.random.default_rng(1).normal(size=7), 3)
    predict = stm.flight.motion_model(
        lambda q: cart_pole(bob=q[0], length=q[1], damping=q[2]),
        space.retract(x, jnp.array([0.0, 0.05, 0.0, 0.0])),
        np.linspace(0.0, 0.8, 33),
        ["rail.displacement", "hinge.angle", stm.sensing.Gyroscope("pole")],
        inputs={"effort": push},
        space=space,
    )
    truth, sizes = np.array([0.5, 0.8, 0.05]), np.array([0.1, 0.1, 0.05])
    sigma = np.array([1e-3, 2e-3, 5e-3, 5e-3, 5e-3])
    exact, found = fitted(predict, truth, sizes, sigma, ["bob", "length", "damping"])
    np.testing.assert_allclose(exact.values, truth, rtol=1e-8)
    assert found.within(truth, 4.0)
    assert 0.6 < found.reduced_chi_square < 1.4


@pytest.mark.slow
def test_a_four_bar_is_identified():
    """A mass and a damper in a closed loop, from one encoder and one rate."""
    space = stm.TreeSpace(four_bar(damping=0.3), independent=["A.angle"])
    x = space.from_state(space.system.reference)
    predict = stm.flight.motion_model(
        lambda q: four_bar(masses=(1.0, 2.0, q[0]), damping=q[1]),
        x, np.linspace(0.0, 0.8, 33), ["A.angle", "A.angle_rate"],
        inputs={"effort": 8.0}, space=space,
    )  # fmt: skip
    truth, sizes = np.array([1.5, 0.3]), np.array([0.3, 0.1])
    sigma = np.array([1e-4, 1e-3])
    exact, found = fitted(predict, truth, sizes, sigma, ["rocker", "damping"])
    np.testing.assert_allclose(exact.values, truth, rtol=1e-8)
    assert found.within(truth, 4.0)


@pytest.mark.slow
def test_the_tracker_on_ground_is_identified():
    """The panel's mass and the sliders' friction, from both strokes in the report's first case."""
    friction = stm.tracker.Friction(coulomb=0.0)
    table = stm.PART_I.replaced({"friction.viscous": 2.0})
    made = lambda table: stm.make_scene("tracker", 1, table, friction=friction).system
    unknowns = [
        stm.flight.Unknown("mass.panel_7", 0.2),
        stm.flight.Unknown("friction.viscous", 1.0),
    ]
    space = stm.TreeSpace(made(table))
    predict = stm.flight.motion_model(
        stm.flight.from_table(made, table, unknowns), space.from_state(space.system.reference),
        np.linspace(0.0, 0.3, 16), [stm.sensing.Encoder(name) for name in ("T12", "T13")], space=space,
    )  # fmt: skip
    truth, sizes = np.array([table.value("mass.panel_7"), 2.0]), np.array([0.2, 1.0])
    exact, found = fitted(
        predict, truth, sizes, np.full(2, 1e-4), [unknown.label for unknown in unknowns]
    )
    np.testing.assert_allclose(exact.values, truth, rtol=1e-8)
    assert found.within(truth, 4.0)
    assert 0.6 < found.reduced_chi_square < 1.4


def test_what_a_motion_model_refuses(cart):
    space, x = cart
    model = lambda make, outputs, **more: stm.flight.motion_model(
        make, x, [0.0, 0.1], outputs, **more
    )(jnp.array([0.5]))
    make = lambda q: cart_pole(bob=q[0])
    with pytest.raises(stm.SettingError, match="needs the state space that has its coordinates"):
        model(make, ["rail.displacement"])
    with pytest.raises(stm.SettingError, match="name 'rail', which is no state"):
        model(make, ["rail"], space=space)
    with pytest.raises(stm.SettingError, match="are no vector"):
        model(make, [stm.sensing.AttitudeFix("pole")], space=space)
    with pytest.raises(stm.SettingError, match="name 'force', which is no input"):
        model(make, ["rail.displacement"], space=space, inputs={"force": 1.0})


# --- flight conditions


@pytest.fixture(scope="module")
def hexacopter():
    scene = stm.make_scene("hexacopter")
    space = stm.TreeSpace(scene.system)
    return space, space.from_state(scene.state0)


def test_a_hexacopter_hovers_climbs_and_turns(hexacopter):
    """The thrust is the weight, over the cosine of the bank; heading and turn are those wanted."""
    space, x = hexacopter
    mass, speed, rate = float(space.system.bodies.mass[0]), 3.0, 0.8
    k_f = space.system.forces[1].k_f
    conditions = {
        "hover": stm.flight.hover(yaw=0.3),
        "climb": stm.flight.climb(2.0, yaw=0.3),
        "turn": stm.flight.steady_turn(speed, rate, yaw=0.3),
    }
    for name, condition in conditions.items():
        found = stm.flight.trim_condition(space, condition, at=x)
        bank = np.arctan(speed * rate / 9.81) if name == "turn" else 0.0
        R = np.asarray(stm.rotation.rotation_matrix(found.point.p))
        assert np.arccos(min(R[2, 2], 1.0)) == pytest.approx(bank, rel=0.02, abs=1e-7)
        lift = float(k_f * jnp.sum(found.values))
        assert lift == pytest.approx(mass * 9.81 / np.cos(bank), rel=1e-3 if bank else 1e-12)
        assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(0.3, abs=1e-12)
        np.testing.assert_allclose(found.point.omega, condition.rate * R[2], atol=1e-12)
    # by six rotors with two dimensions of choice: those that differ least
    equal = hover_speed_squared(mass, [0.0, 0.0, 9.81], k_f, 6)
    hover = stm.flight.trim_condition(space, conditions["hover"], at=x, values=equal)
    again = stm.flight.trim_condition(space, conditions["hover"], at=x)
    np.testing.assert_allclose(hover.values, again.values, rtol=1e-12)


@pytest.mark.slow
def test_derivative_of_the_nearest_trim(hexacopter):
    """With more unknowns than equations too: the lift m (g + a) by the acceleration a is m."""
    space, x = hexacopter
    k_f, mass = space.system.forces[1].k_f, float(space.system.bodies.mass[0])

    def lift(a):
        up = stm.flight.hover()._replace(acceleration=a * jnp.array([0.0, 0.0, 1.0]))
        return k_f * jnp.sum(stm.flight.trim_condition(space, up, at=x, throw=False).values)

    assert float(jax.jacfwd(lift)(jnp.asarray(0.5))) == pytest.approx(mass, rel=1e-10)


def test_what_a_flight_condition_refuses(hexacopter, cart):
    space, x = hexacopter
    trim = stm.flight.trim_condition
    with pytest.raises(stm.SettingError, match="floating base flies"):
        trim(cart[0], stm.flight.hover(), at=cart[1])
    with pytest.raises(stm.SettingError, match="not as angles of a panel"):
        trim(space, stm.flight.hover([0.1, 0.1]), at=x)
    with pytest.raises(stm.SettingError, match="Pointing at the sun needs"):
        trim(space, stm.flight.hover(sun=[0, 0, 1.0]), at=x)
    with pytest.raises(stm.ModelError, match="no body 'panel'"):
        trim(space, stm.flight.hover(sun=[0, 0, 1.0]), at=x, pointing="panel")


@pytest.mark.slow
def test_a_hexacopter_is_held_and_identified(hexacopter):
    """Speeds that hold it, by the motion alone, carry its weight; a flight tells mass and inertia."""
    space, x = hexacopter
    near = [stm.flight.departures(space, x)]
    tuning = stm.flight.tune_inputs(space, near, start=x, duration=0.2, weight=10.0)
    values = tuning.inputs(tuning.search().values)
    held = stm.flight.trim_condition(space, stm.flight.hover(), at=x).values
    rotors = space.system.forces[1]
    com = jnp.zeros(3)
    wrench = rotors.wrench(held, com)
    np.testing.assert_allclose(rotors.wrench(values, com), wrench, atol=1e-7)

    bodies = lambda s: (s.system.bodies.mass, s.system.bodies.inertia)
    inertia = space.system.bodies.inertia
    made = lambda q: space.with_system(
        eqx.tree_at(bodies, space, (q[:1], inertia.at[0, 0, 0].set(q[1]))).system
    )
    knots = np.linspace(0.0, 0.5, 6)
    speeds = np.asarray(held) * (1 + 0.05 * np.random.default_rng(2).normal(size=(6, 6)))
    predict = stm.flight.motion_model(
        made, x, np.linspace(0.0, 0.5, 26),
        [stm.sensing.PositionFix("hexacopter"), "omega_x", stm.sensing.Accelerometer("hexacopter")],
        inputs={"speed_squared": Sampled(knots, speeds, 3)},
    )  # fmt: skip
    truth = np.array([float(space.system.bodies.mass[0]), float(inertia[0, 0, 0])])
    sizes, sigma = 0.1 * truth, np.array([1e-3] * 3 + [5e-3] + [5e-2] * 3)
    exact, found = fitted(predict, truth, sizes, sigma, ["mass", "J_xx"])
    np.testing.assert_allclose(exact.values, truth, rtol=1e-8)
    assert found.within(truth, 4.0)


# --- the report's mechanisms

PANEL = stm.tracker.initial_angles(stm.PART_II)


@pytest.fixture(scope="module")
def flyer():
    return stm.scenes.uav_flyer()


@pytest.mark.slow
def test_the_uav_by_the_general_route(flyer):
    """Its own trim and that of any mechanism agree, in cruise and in a turn."""
    space = stm.TreeSpace(flyer.system)
    at = space.from_state(flyer.to_state(stm.flight.at_rest(PANEL)))
    start = np.concatenate([np.full(6, 1.8e6), np.zeros(2)])
    for condition in (
        stm.flight.cruise(4.0, 0.7, yaw=0.3),
        stm.flight.steady_turn(3.0, 0.8),
    ):
        found = stm.flight.trim_condition(space, condition, at=at, values=start)
        own = stm.flight.trim_flight(flyer, condition._replace(angles=jnp.asarray(PANEL)))
        np.testing.assert_allclose(found.values, jnp.concatenate(own.inputs), rtol=1e-9)
        state, exact = space.to_state(found.point), flyer.to_state(own.coordinates)
        np.testing.assert_allclose(state.p, exact.p, atol=1e-9)
        np.testing.assert_allclose(state.omega, exact.omega, atol=1e-9)


@pytest.fixture(scope="module")
def tracker():
    space = stm.TreeSpace(ground_tracker())
    return space, space.from_state(space.system.reference)


@pytest.mark.slow
def test_the_tracker_on_ground(tracker):
    """Forces that hold it are those of virtual work; the motion finds them too."""
    space, x = tracker
    assert space.dof == 2
    held = stm.trim(space, at=x)

    def heights(v):
        state = space.to_state(space.retract(x, jnp.concatenate([v, jnp.zeros(2)])))
        sliders = [state.r[space.system.index(name), 2] for name in ("slider_2", "slider_3")]
        return jnp.stack(sliders), 9.81 * (space.system.bodies.mass @ state.r[:, 2])

    moved, lifted = jax.jit(jax.jacfwd(heights))(jnp.zeros(2))
    np.testing.assert_allclose(held.values, np.linalg.solve(moved.T, lifted), rtol=1e-8)
    near = [stm.flight.departures(space, x)]
    tuning = stm.flight.tune_inputs(
        space, near, start=x, duration=0.1, sizes=[5.0, 5.0], weight=10.0
    )
    values = tuning.inputs(tuning.search().values)
    np.testing.assert_allclose(values, held.values, rtol=1e-6)
