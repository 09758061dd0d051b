"""Forces in joint coordinates: laws, loads, balances, smoothness."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central, np_rotation, random_quaternion, state_of, turn

import stmuav_jax as stm
from stmuav_jax.mechanics.joint_forces import ramp_area, ramp_slope, smooth_ramp

COM = {"a": np.array([0.1, -0.2, 0.05]), "b": np.array([-0.3, 0.1, 0.2])}
POINT = np.array([0.2, 0.3, -0.1])
AXIS = np.array([1.0, 1.0, 0.5]) / 1.5
T = jnp.asarray(0.3)

STOP: dict[str, Any] = {"stiffness": 50.0, "damping": 8.0, "width": 0.3}


def swing(t):
    """A moving target."""
    return 0.2 * jnp.sin(3 * t)


# on a displacement; the numbers make each of them act at the states below
FORCES = {
    "servo": stm.mechanics.JointServo(
        "J", stiffness=40.0, damping=3.0, target=0.1, coordinate="displacement"
    ),
    "led servo": stm.mechanics.JointServo(
        "J", stiffness=40.0, damping=3.0, target=swing, coordinate="displacement"
    ),
    "upper stop": stm.mechanics.EndStop("J", upper=-4.0, coordinate="displacement", **STOP),
    "lower stop": stm.mechanics.EndStop("J", lower=4.0, coordinate="displacement", **STOP),
    "friction": stm.mechanics.JointFriction(
        "J", coulomb=2.0, viscous=0.5, speed=0.7, coordinate="displacement"
    ),
}
ANGULAR = {
    "servo": stm.mechanics.JointServo(
        "J", stiffness=40.0, damping=3.0, target=swing, coordinate="angle"
    ),
    "stop": stm.mechanics.EndStop("J", lower=0.1, upper=0.5, coordinate="angle", **STOP),
    "friction": stm.mechanics.JointFriction("J", coulomb=2.0, speed=0.7, coordinate="angle"),
    "spring": stm.TorsionalSpringDamper("J", stiffness=5.0, damping=0.3, angle=0.5),
}


def system_with(force):
    bodies = [
        stm.Body(n, m, [0.1, 0.1, 0.1], com=COM[n], free=True) for n, m in (("a", 2), ("b", 3))
    ]
    joint = stm.cylindrical("J", "a", "b", point=POINT, axis=AXIS)
    return stm.System(bodies, [joint], [force])


@eqx.filter_jit
def _load(system, t, state):
    return system.forces[0].load(t, system.kinematics(state))


def load_of(force, state, t=T):
    return _load(system_with(force), jnp.asarray(t), state)


@pytest.fixture(scope="module")
def state():
    """Random places and velocities; the joint is not closed, which a displacement must not mind."""
    rng = np.random.default_rng(5)
    p = [random_quaternion(rng) for _ in range(2)]
    return state_of(rng.normal(size=(2, 3)), p, rng.normal(size=(2, 3)), rng.normal(size=(2, 3)))


def turned(angle, rate):
    """The joint closed, b turned about its axis by `angle` [rad] at `rate` [rad/s]."""
    p = turn(AXIS, angle)
    r = POINT + np_rotation(p) @ (COM["b"] - POINT)
    v = rate * np.cross(AXIS, r - POINT)
    return state_of([COM["a"], r], [[1, 0, 0, 0], p], [[0, 0, 0], v], [[0, 0, 0], rate * AXIS])


def world(state):
    R = [np_rotation(p) for p in np.asarray(state.p)]
    return R, [A @ o for A, o in zip(R, np.asarray(state.omega), strict=True)]


def shift_of(state):
    """x, its rate, the axis and b's point in the world, written out."""
    R, w = world(state)
    r, v = np.asarray(state.r), np.asarray(state.v)
    arms = [A @ (POINT - COM[n]) for A, n in zip(R, "ab", strict=True)]
    a, b = r[0] + arms[0], r[1] + arms[1]
    rates = [v[k] + np.cross(w[k], arms[k]) for k in (0, 1)]
    z = R[0] @ AXIS
    return z @ (b - a), z @ (rates[1] - rates[0] - np.cross(w[0], b - a)), z, b


def work_rate(state, load):
    force, moment = np.asarray(load.force)[:2], np.asarray(load.moment)[:2]
    return np.sum(force * np.asarray(state.v)) + np.sum(moment * np.asarray(state.omega))


def advanced(state, h):
    """The state after a time h at its velocities."""
    omega = np.asarray(state.omega)
    turns = [turn(o if np.any(o) else AXIS, np.linalg.norm(o) * h) for o in omega]
    p = [stm.rotation.product(q, jnp.asarray(d)) for q, d in zip(state.p, turns, strict=True)]
    return stm.State(state.r + h * state.v, jnp.stack(p), state.v, state.omega)


@pytest.mark.parametrize("name", FORCES)
def test_load_on_a_shift(state, name):
    """+Q on b at its point along a's axis, -Q on a on the same line; nothing on ground."""
    force, (x, rate, z, b) = FORCES[name], shift_of(state)
    load = load_of(force, state)
    Q = float(force.law(jnp.asarray(x), jnp.asarray(rate), T))
    assert abs(Q) > 0.1
    R, _ = world(state)
    at = [b - np.asarray(state.r)[k] for k in (0, 1)]
    np.testing.assert_allclose(load.force, [-Q * z, Q * z, 0 * z], atol=1e-13 * abs(Q))
    moments = [R[0].T @ np.cross(at[0], -Q * z), R[1].T @ np.cross(at[1], Q * z)]
    np.testing.assert_allclose(load.moment[:2], moments, atol=1e-12 * abs(Q))


@pytest.mark.parametrize("name", ANGULAR)
def test_load_on_an_angle(name):
    force, load = ANGULAR[name], load_of(ANGULAR[name], turned(0.9, -1.7))
    Q = float(force.law(jnp.asarray(0.9), jnp.asarray(-1.7), T))
    assert abs(Q) > 0.1
    assert not np.any(load.force)
    R = np_rotation(turn(AXIS, 0.9))
    np.testing.assert_allclose(load.moment, [-Q * AXIS, Q * R.T @ AXIS, 0 * AXIS], atol=1e-13)


@pytest.mark.parametrize("name", [*FORCES, *(f"{n} on an angle" for n in ANGULAR)])
def test_work_is_minus_the_rate_of_the_potential_plus_the_power(state, name):
    """Also where a target moves: the bodies' work is what V loses and the motor gives."""
    inside = name.removesuffix(" on an angle")
    force, now = FORCES.get(name), state
    if force is None:
        force, now = ANGULAR[inside], turned(0.9, -1.7)
    load = load_of(force, now)
    rate = central(lambda h: load_of(force, advanced(now, h), T + h).potential, 1e-4)
    work = work_rate(now, load)
    assert work == pytest.approx(float(load.power - rate), rel=1e-8)
    assert abs(work) > 0.05
    if "friction" not in name:
        assert abs(rate) > 0.05


@pytest.mark.parametrize(
    ("force", "law"),
    [
        (stm.mechanics.JointServo("J", stiffness=40.0, damping=3.0, target=0.1, limit=2.0),
         lambda x, rate: -40 * (x - 0.1) - 3 * rate),
        (stm.JointEffort("J", -3.0, limit=2.0), lambda x, rate: -3.0),
        (stm.JointEffort("J", 1.5, limit=2.0), lambda x, rate: 1.5),
    ],
    ids=("servo", "effort", "effort within"),
)  # fmt: skip
def test_a_limit_cuts_the_effort_off_and_the_balance_of_energy_stays(force, law):
    for x, rate in ((0.5, -0.4), (0.11, 0.2), (0.0, 0.1), (-2.0, 0.0)):
        found = float(force.law(jnp.asarray(x), jnp.asarray(rate), T))
        assert found == pytest.approx(np.clip(law(x, rate), -2.0, 2.0), rel=1e-13)
        power = jax.jvp(lambda y: force.potential_energy(y, T), (x,), (rate,))[1]
        system = stm.System(
            [stm.Body("rod", 1.0, (1.0, 1.0, 1.0))],
            [stm.revolute("J", "ground", "rod", point=[0, 0, 0], axis=[0, 0, 1])],
            [force],
        )
        now = stm.state_from_joints(system, {"J": x}, {"J": rate})
        load = system.forces[0].load(T, system.kinematics(now))
        assert float(load.power) == pytest.approx(found * rate + float(power), abs=1e-12)
    with pytest.raises(stm.ModelError, match="limit"):
        stm.JointEffort("J", 1.0, limit=0.0)


# --- smoothness


def test_the_ramp_is_a_line_that_starts_smoothly():
    w = jnp.asarray(0.3)
    d = jnp.linspace(-0.2, 0.6, 81)
    over = lambda f: jax.jit(jax.vmap(f, (0, None)))(d, w)
    value = over(smooth_ramp)
    assert np.all(value[d <= 0] == 0)
    np.testing.assert_allclose(value[d >= w], d[d >= w] - 0.15, atol=1e-16)
    np.testing.assert_allclose(over(jax.grad(smooth_ramp)), over(ramp_slope), atol=1e-14)
    np.testing.assert_allclose(over(jax.grad(ramp_area)), value, atol=1e-15)


STIFF = stm.mechanics.EndStop(
    "J", upper=0.0, stiffness=1e5, damping=100.0, width=2e-4, coordinate="displacement"
)
_hessians = jax.jit(jax.vmap(jax.hessian(lambda y: STIFF.law(y[0], y[1], jnp.zeros(())))))


@pytest.mark.parametrize("rate", [-0.5, -0.05, 0.0, 0.05, 0.5])
def test_a_stop_is_twice_continuously_differentiable(rate):
    """Along a line into the stop no second derivative jumps: steps shrink with the spacing.

    The line passes the limit, the release (D = -E, rate < 0) and the full width.
    """
    w = 2e-4
    x = jnp.linspace(-0.1 * w, 1.5 * w, 16001)
    H = np.asarray(_hessians(jnp.stack([x, jnp.full_like(x, rate)], axis=1))).reshape(-1, 4)
    assert np.all(np.isfinite(H))
    size = np.max(np.abs(H), axis=0)
    largest_step = lambda H: np.max(np.abs(np.diff(H, axis=0)), axis=0)
    assert np.all(largest_step(H) <= 0.2 * largest_step(H[::8]) + 1e-12 * size)


def test_a_stop_never_pulls_and_only_takes_energy_out():
    stop, w = STIFF, 2e-4
    x = jnp.linspace(-w, 4 * w, 101)[:, None]
    v = jnp.asarray([-10.0, -1.0, -0.1, -1e-3, 0.0, 1e-3, 0.1, 1.0, 10.0])[None]
    parts = lambda x, v: (
        stop.law(x, v, x),
        1e5 * smooth_ramp(x, x * 0 + w),
        100 * ramp_slope(x, x * 0 + w) * v,
    )
    force, spring, damper = jax.jit(jnp.vectorize(parts))(x, v)
    push, spring, damper = -np.asarray(force), np.asarray(spring), np.asarray(damper)
    assert np.all(push >= 0)
    assert np.all(push[(x <= 0)[:, 0]] == 0)
    np.testing.assert_allclose(push, np.where(v >= 0, spring + damper, push), rtol=1e-12)
    assert np.all((push - spring) * np.asarray(v) >= 0)
    gone = damper <= -spring
    np.testing.assert_allclose(push[gone], spring[gone] / 2, rtol=1e-14)
    assert np.any(gone & (push > 0))
    assert np.any((damper < 0) & ~gone)


def _whole(y, force):
    return force.law(y[0], y[1], y[2]) + force.potential_energy(y[0], y[2])


@eqx.filter_jit
def _derivatives(y, force):
    numbers, rest = eqx.partition(force, eqx.is_array)
    first = jax.grad(lambda n, y: _whole(y, eqx.combine(n, rest)))
    return jax.vmap(lambda y: (first(numbers, y), jax.hessian(_whole)(y, force)))(y)


def test_gradients_are_finite_everywhere():
    """At rest, at the limit, at depths whose powers underflow: all of them, up to the second."""
    x = [0.0, 5e-324, 1e-200, 1e-60, 1e-20, -1.0, 2e-4, 1.0]
    y = jnp.asarray([[d, v, 0.3] for d in x for v in (0.0, 1.0, -1.0)])
    friction = stm.mechanics.JointFriction("J", coulomb=2.0, speed=1e-3, coordinate="displacement")
    for force in (STIFF, friction, FORCES["led servo"]):
        for leaf in jax.tree.leaves(_derivatives(y, force)):
            assert np.all(np.isfinite(leaf))


# --- runs: five sliders on ground, one element each, one compilation

MASS, DROP = 2.0, 0.05


def sliders():
    """Sliders along x (held, led, rubbed) and z (bounced, damped), the last two under gravity."""
    along = {"held": [1, 0, 0], "led": [1, 0, 0], "rubbed": [1, 0, 0]}
    along |= {"bounced": [0, 0, 1], "damped": [0, 0, 1]}
    bodies = [
        stm.Body(name, MASS, [0.1, 0.1, 0.1], position=[0, k, 0]) for k, name in enumerate(along)
    ]
    joints = [
        stm.translational(f"J_{name}", "ground", name, axis=axis, point=[0, k, 0])
        for k, (name, axis) in enumerate(along.items())
    ]
    stop: dict[str, Any] = {"lower": -DROP, "stiffness": 5e4, "width": 1e-3}
    forces = [
        stm.Gravity(),
        stm.mechanics.JointServo("J_held", stiffness=500.0, damping=12.0, target=0.1),
        stm.mechanics.JointServo("J_led", stiffness=500.0, damping=12.0, target=swing),
        stm.mechanics.JointFriction("J_rubbed", coulomb=3.0, speed=0.5),
        stm.mechanics.EndStop("J_bounced", damping=0.0, **stop),
        stm.mechanics.EndStop("J_damped", damping=200.0, **stop),
    ]
    system = stm.System(bodies, joints, forces)
    v = np.zeros((5, 3))
    v[2, 0] = 2.0
    reference = system.reference
    return system, state_of(reference.r, reference.p, v)


@pytest.fixture(scope="module")
def run():
    system, start = sliders()
    # nothing drifts along fixed axes, and projections take long to compile
    method = stm.Method(
        formulation=stm.Augmented(), solver=diffrax.Tsit5(), rtol=1e-11, atol=1e-11,
        adjoint=diffrax.ForwardMode(), stabilisation=stm.Unstabilised(), balances=True,
    )  # fmt: skip
    ts = jnp.linspace(0, 0.5, 101)
    found = jax.jit(lambda s: stm.integrate(system, s, ts, method))(start)
    assert found.result == diffrax.RESULTS.successful
    return system, found


@pytest.mark.slow
def test_energy_balance_of_a_run(run):
    """Motor, dampers, friction and stops: what they give and take is all that changes."""
    system, found = run
    kinetic = 0.5 * MASS * np.sum(np.asarray(found.states.v) ** 2, axis=(1, 2))
    potential = jax.jit(jax.vmap(lambda s, t: stm.dynamics.energy(system, s, t).potential))
    total = kinetic + potential(found.states, found.ts)
    size = np.max(kinetic)
    assert np.max(np.abs(total - total[0] - found.work)) < 1e-8 * size
    assert np.max(np.abs(found.work)) > 0.1 * size


def test_a_servo_on_a_slider_is_a_damped_oscillator(run):
    t, w, d = np.asarray(run[1].ts), np.sqrt(250), 12 / 4
    own = np.sqrt(w * w - d * d)
    exact = 0.1 - 0.1 * np.exp(-d * t) * (np.cos(own * t) + d / own * np.sin(own * t))
    np.testing.assert_allclose(run[1].states.r[:, 0, 0], exact, atol=1e-9)


def test_a_led_servo_is_a_driven_oscillator(run):
    """x - x_ref obeys m e'' + c e' + k e = -m x_ref''; particular solution by phasors."""
    t, w, d, W = np.asarray(run[1].ts), np.sqrt(250), 12 / 4, 3.0
    own = np.sqrt(w * w - d * d)
    gain = 0.2 * W**2 / (w * w - W * W + 2j * d * W)
    held = lambda s: np.imag(gain * np.exp(1j * W * s))
    held_rate = lambda s: np.imag(1j * W * gain * np.exp(1j * W * s))
    A = -held(0.0)
    B = (-0.6 - held_rate(0.0) + d * A) / own
    free = np.exp(-d * t) * (A * np.cos(own * t) + B * np.sin(own * t))
    np.testing.assert_allclose(
        run[1].states.r[:, 1, 0], 0.2 * np.sin(W * t) + held(t) + free, atol=1e-9
    )


def test_smoothed_friction_stops_as_it_should(run):
    """m v' = -F tanh(v / v0): sinh(v / v0) decays exponentially."""
    exact = 0.5 * np.arcsinh(np.sinh(4.0) * np.exp(-3.0 / (MASS * 0.5) * np.asarray(run[1].ts)))
    np.testing.assert_allclose(run[1].states.v[:, 2, 0], exact, atol=1e-9)


def test_stops_bounce(run):
    """The one without damping comes back to where it fell from, the other much less high."""
    z = np.asarray(run[1].states.r)[:, 3:, 2]
    speed = np.asarray(run[1].states.v)[:, 3:, 2]
    hit = np.sqrt(2 * 9.81 * DROP)
    deepest = -DROP - 5e-4 - hit * np.sqrt(MASS / 5e4) * 1.2
    assert np.all(z.min(axis=0) > deepest)
    height = z + speed**2 / (2 * 9.81)
    free = z[:, 0] > -DROP
    np.testing.assert_allclose(height[free, 0], 0.0, atol=1e-8)
    assert np.max(speed[:, 0]) > 0.99 * hit
    assert 0.1 * hit < np.max(speed[:, 1]) < 0.7 * hit


# --- refusals


def build(joint, force):
    bodies = [stm.Body("a", 1.0, [0.1, 0.1, 0.1]), stm.Body("b", 1.0, [0.1, 0.1, 0.1])]
    return stm.System(bodies, [stm.weld("W", "ground", "a"), joint], [force])


UNIVERSAL = stm.universal("U", "a", "b", point=[0, 0, 0], axis_i=[1, 0, 0], axis_j=[0, 1, 0])
SLIDE = stm.translational("S", "a", "b", axis=[0, 0, 1])
SCREW = stm.cylindrical("C", "a", "b", axis=[0, 0, 1])
RUB: dict[str, Any] = {"coulomb": 1.0, "speed": 0.1}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: build(UNIVERSAL, stm.mechanics.JointFriction("U", **RUB)),
         r"JointFriction in joint 'U' acts on an angle or a displacement, but a universal joint"),
        (lambda: build(SLIDE, stm.mechanics.JointFriction("S", coordinate="angle", **RUB)),
         r"in joint 'S' acts on the angle, but a translational joint.*angle needs one of: revol"),
        (lambda: build(SCREW, stm.mechanics.EndStop("C", lower=0.0, **STOP)),
         r"EndStop in joint 'C': a cylindrical joint leaves both.*say which by coordinate="),
        (lambda: build(SLIDE, stm.mechanics.JointFriction("T", **RUB)), "JointFriction names the unknown joint"),
    ],
)  # fmt: skip
def test_joints_without_the_coordinate_are_refused(make, words):
    with pytest.raises(stm.ModelError, match=words):
        make()


def servo(**more: Any):
    return stm.mechanics.JointServo(
        "J", **{"stiffness": 1.0, "damping": 1.0, "target": 0.0, **more}
    )


def stop(**more: Any):
    return stm.mechanics.EndStop("J", **{"lower": 0.0, **STOP, **more})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: servo(stiffness=-3.0),
         r"stiffness of the servo in joint 'J' must not be negative, but it is -3 N/m or N m/rad"),
        (lambda: servo(damping=-1.0, coordinate="angle"), r"damping of.*it is -1 N m s/rad\."),
        (lambda: servo(target=np.inf), "target of the servo in joint 'J' must be finite"),
        (lambda: servo(target=stm.mechanics.Sine(0.1, 2.0)), "function of the time t .* alone .* calling it"),
        (lambda: servo(target=lambda t: jnp.stack([t, t])), r"returns an array of shape \(2,\)"),
        (lambda: stop(upper=-0.1), r"must be lower < upper, but they are 0\.0 and -0\.1 m or rad"),
        (lambda: stop(lower=None), "needs a lower or an upper limit"),
        (lambda: stop(width=0.0), "width of the end stop in joint 'J' must be positive"),
        (lambda: stm.mechanics.JointFriction("J", coulomb=1.0, speed=0.0), "speed .* must be positive"),
        (lambda: stm.mechanics.JointFriction("J", coulomb=1.0, viscous=np.nan, speed=1.0), "viscous .* finite"),
        (lambda: servo(stiffness=[1.0, 2.0]), r"must have shape \(\)"),
    ],
)  # fmt: skip
def test_bad_numbers_are_refused(make, words):
    with pytest.raises(stm.ModelError, match=words):
        make()
