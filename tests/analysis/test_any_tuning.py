"""Tuned inputs, identification and flight conditions of mechanisms that are not the UAV."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from mechanisms import G, cart_pole, four_bar, pendulum, stewart
from scipy.interpolate import CubicSpline
from scipy.optimize import root
from scipy.spatial.transform import Rotation
from test_any_mechanism import static_forces

import stmuav_jax as stm
from stmuav_jax.analysis.identification import Misfit, predict_columns, residuals_and_jacobian
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
    """Bob, length and damping from the cart's place, the pole's angle and its gyroscope."""
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


# --- a Stewart platform moved to a pose


def potential(feet, heads, longer):
    """Potential energy of all bodies with the legs longer by so much, by the platform's geometry."""
    centre, length = np.array([0.0, 0.0, 1.25]), np.linalg.norm(heads - feet, axis=1)
    ends = lambda pose: centre + pose[:3] + Rotation.from_rotvec(pose[3:]).apply(heads - centre)
    miss = lambda pose: np.linalg.norm(ends(pose) - feet, axis=1) - length - longer
    pose = root(miss, np.zeros(6), tol=1e-13).x
    legs = ends(pose) - feet
    # barrels a quarter of the first length above their feet, rods as far below their heads
    quarter = 0.25 * (legs[:, 2] / np.linalg.norm(legs, axis=1)) * length
    rods = ends(pose)[:, 2] - quarter
    return G * (20.0 * (1.25 + pose[2]) + 0.8 * np.sum(quarter) + 0.5 * np.sum(rods))


@pytest.mark.slow
def test_a_platform_is_moved_to_a_pose():
    """Six forces after which it rests in another pose; their work has lifted all bodies."""
    system, feet, heads = stewart()
    space = stm.TreeSpace(system, independent=[f"T{k}.displacement" for k in range(6)])
    x, longer = space.from_state(system.reference), np.array([0.03, 0.01, -0.02, 0.0, 0.02, 0.04])
    target = space.retract(x, jnp.concatenate([jnp.asarray(longer), jnp.zeros(6)]))
    tuning = stm.analysis.tune_inputs(
        space, [stm.analysis.end_at(space, target)], start=x, duration=0.3,
        values=static_forces(feet, heads), knots=4, outputs_per_segment=1,
    )  # fmt: skip
    motion = tuning.motion(tuning.search().values)
    end = jax.tree.map(lambda leaf: leaf[-1], motion.points)
    np.testing.assert_allclose(space.difference(end, target), 0.0, atol=1e-8)
    power = np.sum(np.asarray(motion.inputs * motion.points.u), axis=1)
    work = CubicSpline(motion.ts, power).integrate(0.0, 0.3)
    lifted = potential(feet, heads, longer) - potential(feet, heads, np.zeros(6))
    assert work == pytest.approx(lifted, rel=1e-6)
