"""Tuned inputs, identification and flight conditions of mechanisms that are not the UAV."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from mechanisms import cart_pole, four_bar, pendulum

import stmuav_jax as stm
from stmuav_jax.analysis.identification import Misfit, predict_columns, residuals_and_jacobian
from stmuav_jax.analysis.multiple_shooting import integrate_points
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.math.least_squares import evaluate_columns
from stmuav_jax.math.sampled import Sampled
from stmuav_jax.uav.rotor import hover_speed_squared


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
def pushed():
    """A pendulum's problem in two segments, and unknowns that are not those of its start."""
    space = stm.TreeSpace(pendulum())
    x = space.from_state(space.system.reference)
    tuning = stm.analysis.tune_inputs(
        space, [stm.analysis.end_at(space, x)], start=x, duration=0.2, inputs=["effort"],
        sizes=[1.0], knots=4, segments=2, outputs_per_segment=4,
    )  # fmt: skip
    return tuning, jax.tree.map(lambda v: v + 0.1, tuning.start)


@pytest.mark.slow
def test_columns_in_groups_and_values_alone(pushed):
    """Derivatives against differences; values without them, and gradients within a program."""
    tuning, start = pushed
    function = tuning.residuals
    value, columns = evaluate_columns(function, start)
    flat, unravel = ravel_pytree(start)
    whole = lambda y: ravel_pytree(evaluate_columns(function, unravel(y), columns=False)[0])[0]
    np.testing.assert_array_equal(whole(flat), ravel_pytree(value)[0])
    J = np.concatenate([c.reshape(-1, len(flat)) for c in jax.tree.leaves(columns)])
    h = 1e-5
    differences = [(whole(flat + h * e) - whole(flat - h * e)) / (2 * h) for e in np.eye(len(flat))]
    np.testing.assert_allclose(J, np.stack(differences, axis=1), atol=1e-7 * np.max(np.abs(J)))
    half_square = lambda y: 0.5 * jnp.sum(ravel_pytree(function(unravel(y)))[0] ** 2)
    found, slope = jax.jit(jax.value_and_grad(half_square))(flat)
    r = np.asarray(ravel_pytree(value)[0])
    np.testing.assert_allclose(found, 0.5 * r @ r, rtol=1e-8)
    np.testing.assert_allclose(slope, J.T @ r, atol=1e-8 * np.max(np.abs(J.T @ r)))


@pytest.mark.slow
def test_a_motion_in_parts_is_that_in_one_piece(pushed):
    """23 output times, not a multiple of a call's: the motion by `integrate`, to 1e-8."""
    tuning, start = pushed
    problem = tuning.residuals
    space, system = problem.space, problem.system(start["values"])
    motion = tuning.motion(start, 23)
    run = stm.dynamics.integrate(system, space.to_state(problem.start), motion.ts, problem.method)
    off = jax.vmap(space.difference)(motion.points, jax.vmap(space.from_state)(run.states))
    assert float(jnp.max(jnp.abs(off))) < 1e-8
    assert tuning.motion(start, 23) is motion
    two = tuning.motion(start, 2)
    np.testing.assert_allclose(two.points.u[-1], motion.points.u[-1], atol=1e-8)
    # reaction forces along the motion, by another formulation
    loads = quick_jit(stm.dynamics.joint_loads)(system, motion.ts, run.states, stm.Augmented())
    forces = np.linalg.norm(loads.force, axis=2)
    np.testing.assert_allclose(quick_jit(stm.analysis.joint_forces)(motion), forces, rtol=1e-6)


@pytest.mark.slow
def test_a_motion_in_parts_keeps_the_speeds_of_its_motors():
    """With motors that lag, the rotors' speeds go on from one call of the program to the next, to 1e-8."""
    motor = stm.uav.Motor(time_constant=0.05)
    space = stm.TreeSpace(stm.make_scene("hexacopter", motor=motor).system)
    start = space.from_state(space.system.reference)
    tuning = stm.analysis.tune_inputs(
        space, [stm.analysis.departures(space, start)], start=start, duration=0.1,
        values=np.full(6, 1.4e6), sizes=[1.4e6] * 6, segments=2,
    )  # fmt: skip
    values = jax.tree.map(lambda x: 1.2 * x, tuning.start)
    motion = tuning.motion(values, 12)
    problem, ts = tuning.residuals, jnp.linspace(0.0, 0.1, 12)
    system = problem.system(values["values"])
    whole = jax.jit(lambda at: integrate_points(space, system, at, ts, problem.method))(
        problem.start
    )
    off = np.asarray(jax.vmap(space.difference)(motion.points, whole))
    scale = np.where(np.arange(off.shape[1]) < 12, 1.0, 1e3)
    assert np.max(np.abs(off) / scale) < 1e-8
    assert np.ptp(np.asarray(whole.internal)[:, 0]) > 10.0


@pytest.mark.slow
def test_a_cart_is_moved_with_its_pole_upright(cart):
    """A force history after which the cart rests half a metre further on.

    To the error of the integration: flights of the same history with and without derivatives, whose steps
    differ, end up to 2e-8 apart, since differences grow as the pole falls.
    """
    space, x = cart
    target = space.retract(x, jnp.array([0.5, 0.0, 0.0, 0.0]))
    tuning = stm.analysis.tune_inputs(
        space, [stm.analysis.end_at(space, target)], start=x, duration=1.5, inputs=["effort"],
        sizes=[10.0], knots=8,
    )  # fmt: skip
    found = tuning.search()
    motion = tuning.motion(found.values)
    end = jax.tree.map(lambda leaf: leaf[-1], motion.points)
    assert float(jnp.max(jnp.abs(space.difference(end, target)))) < 4e-8
    assert motion.inputs.shape == (200, 1)
    assert tuning.inputs(found.values)(jnp.asarray(0.3)).shape == (1,)


def test_a_limit_counts_only_beyond(cart):
    """A hundredfold share of what is passed, as a root mean square over the motion."""
    space, x = cart
    inputs = jnp.array([[8.0], [-12.0], [10.0], [15.0]])
    motion = stm.analysis.TunedMotion(
        jnp.arange(4.0), x, inputs, inputs, inputs, space, space.system
    )
    found = stm.analysis.Limit(Most(jnp.asarray(10.0)))(motion)
    np.testing.assert_allclose(found, [[0.0], [10.0], [0.0], [25.0]], rtol=1e-12)
    np.testing.assert_allclose(stm.analysis.roughness(motion), [[42.0], [-17.0]])


def test_extremes_of_a_history(cart):
    """Those of the spline at 20,001 times, to the square of their spacing; and so its derivative."""
    space, x = cart
    near = [stm.analysis.departures(space, x)]
    tuning = stm.analysis.tune_inputs(
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
        limit = stm.analysis.Limit(Most(jnp.asarray(effort)), jnp.asarray(weight))
        return stm.analysis.tune_inputs(
            space, [stm.analysis.end_at(space, target), limit], start=x, duration=1.5,
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
    assert found.reason is stm.math.SearchReason.LIMIT_PASSED
    assert "violates a limit" in found.describe()


def test_what_tuning_refuses(cart):
    space, x = cart
    near = [stm.analysis.departures(space, x)]
    with pytest.raises(stm.SettingError, match="at least one residual"):
        stm.analysis.tune_inputs(space, [], start=x, duration=1.0)
    with pytest.raises(stm.SettingError, match="name 'force', which is no input"):
        stm.analysis.tune_inputs(space, near, start=x, duration=1.0, inputs=["force"])
    with pytest.raises(stm.ModelError, match=r"must have shape \(5, 1\), not \(4, 1\)"):
        stm.analysis.tune_inputs(
            space, near, start=x, duration=1.0, knots=5, values=np.zeros((4, 1))
        )
    with pytest.raises(stm.SettingError, match="name 'hinge', which is no state"):
        stm.analysis.departures(space, x, {"hinge": 1.0})
    slew = lambda *arguments, **options: stm.analysis.tune_slew(
        space, x, x, *arguments, values=np.ones(1), **options
    )
    with pytest.raises(stm.SettingError, match="must be positive, not -1 s"):
        slew(-1.0)
    with pytest.raises(stm.SettingError, match="four knots or more"):
        slew(1.0, knots=3)
    with pytest.raises(stm.SettingError, match="two or more increasing times"):
        stm.analysis.make_shooting(
            space, lambda v: v, lambda *a: a, lambda t: x, np.array([0.0, 0.0])
        )


# --- identification


def fitted(predict, truth, sizes, sigma, labels):
    """From a start that is off by half of the sizes: without noise, and with it."""
    # predictions by the program that identification compiles anyway
    shape = eqx.filter_eval_shape(predict_columns, predict, jnp.asarray(truth)).shape
    zero, one = jnp.zeros(len(truth)), jnp.ones(len(truth))
    none = Misfit(predict, jnp.zeros(shape), jnp.ones(shape[1]), jnp.asarray(truth), one)
    clean = np.asarray(residuals_and_jacobian(none, zero)[0]).reshape(shape)
    start = truth + 0.5 * sizes * (-1.0) ** np.arange(len(truth))
    rng = np.random.default_rng(7)
    noisy = clean + sigma * rng.normal(size=clean.shape)
    return [
        stm.analysis.identify(predict, record, sigma, start, sizes, labels=labels)
        for record in (clean, noisy)
    ]


@pytest.mark.slow
def test_a_cart_pole_is_identified(cart):
    """Bob, length and damping from the cart's place, the pole's angle and its gyroscope: without noise, and with it."""
    space = stm.TreeSpace(cart_pole(damping=0.05))
    x = space.from_state(space.system.reference)
    knots = np.linspace(0.0, 0.8, 7)
    push = Sampled(knots, 6.0 * np.random.default_rng(1).normal(size=7), 3)
    predict = stm.analysis.motion_model(
        lambda q: cart_pole(bob=q[0], length=q[1], damping=q[2]),
        space.retract(x, jnp.array([0.0, 0.05, 0.0, 0.0])),
        np.linspace(0.0, 0.8, 33),
        ["rail.displacement", "hinge.angle", stm.analysis.Gyroscope("pole")],
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
    predict = stm.analysis.motion_model(
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
def test_what_a_motion_model_refuses():
    space = stm.TreeSpace(pendulum())
    x = space.from_state(space.system.reference)
    model = lambda outputs, start=x, make=lambda q: pendulum(q[0]), **more: (
        stm.analysis.motion_model(make, start, [0.0, 0.1], outputs, **more)(jnp.array([0.5]))
    )
    with pytest.raises(stm.SettingError, match="needs the state space that has its coordinates"):
        model(["hinge.angle"])
    with pytest.raises(stm.SettingError, match="name 'hinge', which is no state"):
        model(["hinge"], space=space)
    floating = stm.TreeSpace(stm.System([stm.Body("box", 1.0, np.eye(3), free=True)]))
    at = floating.from_state(floating.system.reference)
    with pytest.raises(stm.SettingError, match="rotation vector, which whole turns change"):
        model(["theta_x"], at, lambda q: floating)
    with pytest.raises(
        stm.SettingError, match="The start's deviations name 'hinge', which is no state"
    ):
        model(["hinge.angle"], space=space, start_deviations={"hinge": 0.1})
    with pytest.raises(stm.SettingError, match="deviations must be finite and not negative"):
        model(["hinge.angle"], space=space, start_deviations={"hinge.angle": -0.1})
    with pytest.raises(stm.SettingError, match="name 'force', which is no input"):
        model(["hinge.angle"], space=space, inputs={"force": 1.0})


def test_what_cannot_be_told_is_named():
    J = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 5.0]])
    with pytest.raises(
        stm.analysis.IdentifiabilityError, match=r"[+-]0\.71 (a|b), [+-]0\.71 (a|b) \(singular"
    ):
        stm.analysis.check_identifiable(J, ["a", "b", "c"])
    assert stm.analysis.check_identifiable(J[:, 1:], ["b", "c"])[0] == pytest.approx(5.0)
    line = lambda q: (q[0] + q[1]) * jnp.linspace(0, 1, 5)[:, None]
    with pytest.raises(stm.analysis.IdentifiabilityError, match="leave one of the parameters out"):
        stm.analysis.identify(line, np.ones((5, 1)), [0.1], [0.0, 0.0], [1.0, 1.0])


def test_records_refused():
    line = lambda q: q[0] * jnp.ones((5, 1))
    with pytest.raises(stm.ModelError, match=r"record has shape \(4, 1\), but predictions"):
        stm.analysis.identify(line, np.ones((4, 1)), [0.1], [0.0], [1.0])
    with pytest.raises(stm.ModelError, match="record"):
        stm.analysis.identify(line, np.full((5, 1), np.nan), [0.1], [0.0], [1.0])
    with pytest.raises(stm.SettingError, match="1 positive deviations"):
        stm.analysis.identify(line, np.ones((5, 1)), [0.0], [0.0], [1.0])
    with pytest.raises(stm.SettingError, match="1 positive sizes"):
        stm.analysis.identify(line, np.ones((5, 1)), [0.1], [0.0], [-1.0])
    # not as parameters that the record leaves open
    heavy = lambda q: jnp.sqrt(q[0]) * jnp.ones((5, 1)) + q[1] * jnp.linspace(0, 1, 5)[:, None]
    with pytest.raises(stm.SettingError, match=r"predictions at the start .* mass = -1, slope = 0"):
        stm.analysis.identify(
            heavy, np.ones((5, 1)), [0.1], {"mass": -1.0, "slope": 0.0}, [1.0, 1.0]
        )
    with pytest.raises(stm.SettingError, match="derivatives of the predictions at the start"):
        stm.analysis.identify(
            heavy, np.ones((5, 1)), [0.1], {"mass": 0.0, "slope": 0.0}, [1.0, 1.0]
        )
    with pytest.raises(stm.ModelError, match="has no entry"):
        stm.analysis.from_table(
            lambda table: stm.uav.make_uav(table).space,
            stm.PART_II,
            [stm.analysis.Unknown("mass.panel_7", 0.1, ((0,),))],
        )


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
        "hover": stm.analysis.hover(yaw=0.3),
        "climb": stm.analysis.climb(2.0, yaw=0.3),
        "turn": stm.analysis.steady_turn(speed, rate, yaw=0.3),
    }
    for name, condition in conditions.items():
        found = stm.analysis.trim_condition(space, condition, at=x)
        bank = np.arctan(speed * rate / 9.81) if name == "turn" else 0.0
        R = np.asarray(stm.rotation.rotation_matrix(found.point.p))
        assert np.arccos(min(R[2, 2], 1.0)) == pytest.approx(bank, rel=0.02, abs=1e-7)
        lift = float(k_f * jnp.sum(found.values))
        assert lift == pytest.approx(mass * 9.81 / np.cos(bank), rel=1e-3 if bank else 1e-12)
        assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(0.3, abs=1e-12)
        np.testing.assert_allclose(found.point.omega, condition.rate * R[2], atol=1e-12)
    # by six rotors with two dimensions of choice: those that differ least
    equal = hover_speed_squared(mass, [0.0, 0.0, 9.81], k_f, 6)
    hover = stm.analysis.trim_condition(space, conditions["hover"], at=x, values=equal)
    again = stm.analysis.trim_condition(space, conditions["hover"], at=x)
    np.testing.assert_allclose(hover.values, again.values, rtol=1e-12)


@pytest.mark.slow
def test_derivative_of_the_nearest_trim(hexacopter):
    """With more unknowns than equations too: the lift m (g + a) by the acceleration a is m."""
    space, x = hexacopter
    k_f, mass = space.system.forces[1].k_f, float(space.system.bodies.mass[0])

    def lift(a):
        up = stm.analysis.hover()._replace(acceleration=a * jnp.array([0.0, 0.0, 1.0]))
        return k_f * jnp.sum(stm.analysis.trim_condition(space, up, at=x, throw=False).values)

    assert float(jax.jacfwd(lift)(jnp.asarray(0.5))) == pytest.approx(mass, rel=1e-10)


def test_what_a_flight_condition_refuses(hexacopter, cart):
    space, x = hexacopter
    trim = stm.analysis.trim_condition
    with pytest.raises(stm.SettingError, match="needs a mechanism with a floating base"):
        trim(cart[0], stm.analysis.hover(), at=cart[1])
    with pytest.raises(stm.SettingError, match="Panel angles are for the tracker"):
        trim(space, stm.analysis.hover([0.1, 0.1]), at=x)
    with pytest.raises(stm.SettingError, match="Pointing at the sun needs"):
        trim(space, stm.analysis.hover(sun=[0, 0, 1.0]), at=x)
    with pytest.raises(stm.ModelError, match="no body 'panel'"):
        trim(space, stm.analysis.hover(sun=[0, 0, 1.0]), at=x, pointing="panel")
