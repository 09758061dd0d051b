"""Ground contact: loads by hand, closed forms at rest, creeping and sliding, impacts by quadrature."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central, np_rotation, state_of, turn
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import stmuav_jax as stm
from stmuav_jax.io import model_to_text, save_mjcf
from stmuav_jax.mechanics import GroundContact

G, COM = 9.81, np.array([0.02, -0.01, 0.05])
FEET = np.array([[0.3, 0.2, -0.1], [-0.3, 0.25, -0.15], [0.1, -0.4, -0.1], [0.0, 0.1, 0.9]])
NUMBERS: dict[str, Any] = {
    "height": 0.05, "stiffness": 4e3, "damping": 60.0, "width": 0.05, "friction": 0.7, "slip_speed": 0.3,
}  # fmt: skip


def np_ramp(d, w):
    """Ramp, its slope and its area, written out."""
    u = np.clip(d / w, 0.0, 1.0)
    value = np.where(d < w, w * u**4 * (2.5 - 3 * u + u * u), d - w / 2)
    area = np.where(
        d < w, w * w * u**5 * (0.5 - 0.5 * u + u * u / 7), (d - w / 2) ** 2 / 2 + w * w / 56
    )
    return value, u**3 * (10 - 15 * u + 6 * u * u), area


def np_push(d, rate, k, c, w):
    """Push of one foot [N]."""
    value, slope, _ = np_ramp(d, w)
    E, D = k * value, c * slope * rate
    return np.where(E > 0, E / 2 + np_ramp(E + D, np.where(E > 0, E, 1.0))[0], 0.0)


def system_with(**numbers):
    body = stm.Body("craft", 2.0, [0.1, 0.12, 0.15], com=COM, free=True)
    return stm.System([body], forces=[GroundContact("craft", feet=FEET, **NUMBERS | numbers)])


@eqx.filter_jit
def _load(system, state):
    gear, kin = system.forces[0], system.kinematics(state)
    return gear.load(jnp.zeros(()), kin), gear.depths(kin), gear.normal_forces(kin)


@pytest.fixture(scope="module")
def state():
    """Low, tilted and moving: three feet are in the ground, of which one rises."""
    p = turn([1.0, -0.5, 2.0], 0.15)
    return state_of([[0.4, -0.3, 0.12]], [p], [[0.6, -0.4, -0.1]], [[1.5, -2.0, 0.7]])


def feet_of(state):
    """Places and velocities of the feet, and their arms, in NumPy."""
    R = np_rotation(np.asarray(state.p[0]))
    arms = (FEET - COM) @ R.T
    w = R @ np.asarray(state.omega[0])
    return np.asarray(state.r[0]) + arms, np.asarray(state.v[0]) + np.cross(w, arms), arms, R


def test_the_load_by_hand(state):
    place, v, arms, R = feet_of(state)
    n = NUMBERS
    depth = n["height"] - place[:, 2]
    assert (depth > 0).tolist() == [True, True, True, False]
    assert {bool(x) for x in v[:3, 2] > 0} == {True, False}
    N = np_push(depth, -v[:, 2], n["stiffness"], n["damping"], n["width"])
    slip = np.sqrt(np.sum(v[:, :2] ** 2, axis=1) + n["slip_speed"] ** 2)
    force = np.concatenate([-(n["friction"] * N / slip)[:, None] * v[:, :2], N[:, None]], axis=1)
    load, depths, normal = _load(system_with(), state)
    np.testing.assert_allclose(load.force, [force.sum(0), -force.sum(0)], rtol=1e-12)
    np.testing.assert_allclose(load.moment[0], R.T @ np.cross(arms, force).sum(0), rtol=1e-12)
    np.testing.assert_allclose(load.moment[1], -np.cross(place, force).sum(0), rtol=1e-12)
    _, _, area = np_ramp(depth, n["width"])
    assert float(load.potential) == pytest.approx(n["stiffness"] * area.sum(), rel=1e-12)
    E = n["stiffness"] * np_ramp(depth, n["width"])[0]
    lost = np.sum((N - E) * v[:, 2]) + np.sum(force[:, :2] * v[:, :2])
    assert float(load.power) == pytest.approx(lost, rel=1e-12)
    assert lost < 0
    np.testing.assert_allclose(depths, depth, rtol=1e-12)
    np.testing.assert_allclose(normal, N, rtol=1e-12)


def test_derivatives_forward_reverse_and_by_differences(state):
    """Of the load, with respect to its numbers and the state."""
    system = system_with()
    gear, rest = eqx.partition((system.forces[0], state), eqx.is_inexact_array)
    rng = np.random.default_rng(7)
    leaves, tree = jax.tree.flatten(gear)
    way = tree.unflatten(
        [jnp.asarray(rng.normal(size=x.shape) * 0.01 * (1 + abs(x))) for x in leaves]
    )

    def total(numbers):
        force, at = eqx.combine(numbers, rest)
        load = force.load(jnp.zeros(()), system.kinematics(at))
        weights = jnp.array([1.0, -0.5, 2.0])
        both = jnp.sum(load.force[0] * weights) + jnp.sum(load.moment[0] * weights)
        return both + load.potential + load.power

    along = jax.jit(lambda h: total(jax.tree.map(lambda x, d: x + h * d, gear, way)))
    _, forward = jax.jit(lambda d: jax.jvp(total, (gear,), (d,)))(way)
    slopes = jax.jit(jax.grad(total))
    gradient = slopes(gear)
    reverse = sum(
        float(jnp.vdot(a, b)) for a, b in zip(*map(jax.tree.leaves, (gradient, way)), strict=True)
    )
    assert reverse == pytest.approx(float(forward), rel=1e-12)
    assert float(forward) == pytest.approx(
        float(central(lambda h: float(along(h)), 1e-3)), rel=1e-7
    )
    # two feet at the ground's height, within round-off: no 0 / 0 in the derivatives
    for height in (0.2, np.nextafter(0.2, 0), 0.2 - 1e-9):
        touching = state_of([[0.0, 0.0, height]], [[1.0, 0, 0, 0]], [[1.0, 0, -0.5]], [[0.0, 0, 0]])
        at = eqx.partition((system.forces[0], touching), eqx.is_inexact_array)[0]
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes(at)))


# --- runs: free bodies on feet, one compilation

MASS, FOOT = 2.0, {"stiffness": 5e3, "width": 2e-3, "slip_speed": 0.02}
CORNERS = np.array([[0.2, 0.2, 0.0], [-0.2, 0.2, 0.0], [-0.2, -0.2, 0.0], [0.2, -0.2, 0.0]])
K, WIDTH, DROP, MU, FAST, TAN = 4 * 5e3, 2e-3, 0.05, 0.5, 1.5, 0.3
REST = MASS * G / K + WIDTH / 2
NAMES = ("bounced", "damped", "slid", "crept")
TS = np.linspace(0.0, 0.6, 121)


def landed():
    """Bodies whose feet lie at the height of their centres, so that friction does not tip them."""
    bodies = [stm.Body(n, MASS, [0.1, 0.1, 0.1], free=True) for n in NAMES]
    grip = {"bounced": 0.0, "damped": MU, "slid": MU, "crept": MU}
    forces = [
        GroundContact(
            n, feet=CORNERS, damping=0.0 if n == "bounced" else 60.0, friction=grip[n], **FOOT
        )
        for n in NAMES
    ]
    push = stm.AppliedForce("crept", [TAN * MASS * G, 0.0, 0.0])
    system = stm.System(bodies, forces=[stm.Gravity(), push, *forces])
    r, v = np.zeros((4, 3)), np.zeros((4, 3))
    r[:2, 2], r[2:, 2] = DROP, -REST
    v[2, 1] = FAST
    return system, state_of(r, np.tile([1.0, 0, 0, 0], (4, 1)), v)


@pytest.fixture(scope="module")
def run():
    system, start = landed()
    method = stm.Method(
        formulation=stm.Augmented(), solver=diffrax.Dopri8(), rtol=1e-11, atol=1e-11,
        adjoint=diffrax.ForwardMode(), stabilisation=stm.Unstabilised(), balances=True,
    )  # fmt: skip
    found = jax.jit(lambda s: stm.integrate(system, s, jnp.asarray(TS), method))(start)
    assert found.result == diffrax.RESULTS.successful
    return system, found


@pytest.mark.slow
def test_energy_balance_of_a_run(run):
    z = np.asarray(run[1].states.r)[:, :, 2]
    found, speed = run[1], np.asarray(run[1].states.v)
    assert np.max(np.abs(found.states.omega)) < 1e-9
    kinetic = MASS / 2 * np.sum(speed**2, axis=(1, 2))
    stored = np.sum(MASS * G * z + K * np_ramp(-z, WIDTH)[2], axis=1)
    total = kinetic + stored
    size = MASS * G * DROP
    assert np.max(np.abs(total - total[0] - found.work)) < 1e-8 * size
    assert np.min(found.work) < -0.5 * size


def test_a_body_comes_to_rest_at_the_closed_forms_depth(run):
    """m g = k (d - w/2); the way there is that of SciPy with the same law written out."""
    z = np.asarray(run[1].states.r)[:, 1, 2]
    rate = lambda _, y: [y[1], 4 * np_push(-y[0], -y[1], 5e3, 60.0, WIDTH) / MASS - G]
    how: dict[str, Any] = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-13, "max_step": 1e-3}
    exact = solve_ivp(rate, (0.0, TS[-1]), [DROP, 0.0], t_eval=TS, **how).y[0]
    np.testing.assert_allclose(z, exact, atol=1e-9)
    assert z[-1] == pytest.approx(-REST, rel=1e-3)
    standing = np.asarray(run[1].states.r)[:, 2:, 2]
    np.testing.assert_allclose(standing, -REST, atol=1e-12)


def test_a_bounce_without_damping_takes_the_time_of_the_quadrature(run):
    """From the height of the drop back to it: the fall twice, and the contact by its energy."""
    speed = np.sqrt(2 * G * DROP)
    work = lambda d: K * float(np_ramp(d, WIDTH)[2]) - MASS * G * d
    deepest = float(brentq(lambda d: work(d) - MASS * speed**2 / 2, WIDTH, 1.0, xtol=1e-15))  # pyright: ignore[reportArgumentType]
    # d = deepest sin(a) takes the root's zero at the turning point away
    pace = lambda a: deepest * np.cos(a) / np.sqrt(speed**2 - 2 * work(deepest * np.sin(a)) / MASS)
    edge = np.arcsin(WIDTH / deepest)
    contact = 2 * quad(pace, 0, np.pi / 2 * (1 - 1e-7), points=[edge], epsrel=1e-10)[0]
    cycle = 2 * speed / G + contact
    since = np.mod(TS, cycle)
    back = np.minimum(since, cycle - since)
    free = back < speed / G
    z = np.asarray(run[1].states.r)[:, 0, 2]
    np.testing.assert_allclose(z[free], (DROP - G * back**2 / 2)[free], atol=1e-6)
    assert TS[-1] > 2 * cycle
    assert np.min(z) > -deepest - 1e-9


def test_a_sliding_body_loses_mu_g(run):
    """s - v0 artanh(v0 / s) falls at the rate mu g, with s^2 = v^2 + v0^2."""
    v = np.asarray(run[1].states.v)[:, 2, 1]
    v0 = FOOT["slip_speed"]
    moving = v > 1e-3
    s = np.hypot(v[moving], v0)
    level = s - v0 * np.arctanh(v0 / s)
    assert 50 < len(level) < 100
    np.testing.assert_allclose(level, level[0] - MU * G * TS[moving], atol=1e-8)
    fast = v > 0.5
    slope = np.diff(v[fast]) / np.diff(TS[fast])
    np.testing.assert_allclose(slope, -MU * G, rtol=2e-3)
    assert 0 < v[-1] < 1e-9


def test_a_pushed_body_creeps_at_the_closed_forms_speed(run):
    """As on a slope of this tangent; it does not stick."""
    v = float(run[1].states.v[-1, 3, 0])
    assert v == pytest.approx(FOOT["slip_speed"] * TAN / np.sqrt(MU**2 - TAN**2), rel=1e-9)


@pytest.mark.slow
def test_a_landing_differentiated_forward_reverse_and_by_differences():
    """Through touchdown and rebound, tilted, to the body's place, velocity and turning."""
    keys = ("height", "stiffness", "damping", "friction", "slip_speed", "width")
    values = jnp.array([0.0, 2e3, 20.0, 0.4, 0.05, 0.01])
    ways = jnp.asarray(np.random.default_rng(3).normal(size=6)) * 0.01 * (0.1 + values)
    body = stm.Body("craft", 2.0, [0.1, 0.12, 0.15], position=[0.0, 0.0, 0.15], free=True)
    start = state_of(
        [[0.0, 0.0, 0.15]], [turn([1.0, 2.0, 0.0], 0.1)], [[0.5, 0.2, -0.5]], [[0.1, 0.0, 0.3]]
    )

    def end(x, adjoint):
        numbers: Any = dict(zip(keys, x, strict=True))
        gear = GroundContact("craft", feet=CORNERS - np.array([0.0, 0.0, 0.1]), **numbers)
        system = stm.System([body], forces=[stm.Gravity(), gear])
        method = stm.Method(solver=diffrax.Dopri8(), rtol=1e-13, atol=1e-13, adjoint=adjoint)
        at = stm.integrate(system, start, jnp.array([0.0, 0.25]), method).states
        weights = jnp.array([1.0, -2.0, 0.5])
        return weights @ at.r[-1, 0] + 0.1 * weights @ at.v[-1, 0] + 0.1 * weights @ at.omega[-1, 0]

    ahead = jax.jit(
        lambda h: jax.jvp(
            lambda s: end(values + s * ways, diffrax.ForwardMode()), (h,), (jnp.ones(()),)
        )
    )
    forward = float(ahead(jnp.zeros(()))[1])
    reverse = jax.jit(jax.grad(lambda x: end(x, stm.dynamics.DiscreteAdjoint())))(values) @ ways
    # the step's lengths move with the numbers in one and stand in the other, which differ by what the
    # tolerance leaves of forces that are smooth twice: 2e-8 at 1e-11, 2e-9 to 1.2e-8 at 1e-13
    assert float(reverse) == pytest.approx(forward, rel=3e-8)
    differences = central(lambda h: float(ahead(jnp.asarray(h))[0]), 0.02)
    assert forward == pytest.approx(float(differences), rel=1e-6)
    assert abs(forward) > 1e-6


# --- files, exports, refusals


def test_exports_name_the_gear_as_left_out(tmp_path):
    system = system_with()
    scene = stm.Scene("craft", "Craft", system, system.reference)
    (words,) = save_mjcf(scene, tmp_path / "craft.xml")
    assert words == "Left out, force elements: GroundContact on craft."
    assert 'kind = "ground_contact"' in model_to_text(scene)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"stiffness": 0.0}, r"stiffness of the ground contact of body 'craft' must be positive, but it is 0 N/m"),
        ({"friction": -0.1}, "friction coefficient of .* must not be negative, but it is -0.1 1"),
        ({"height": np.nan}, "height of .* must be finite"),
        ({"friction": [0.1, 0.2]}, r"friction coefficient of .* must have shape \(\)"),
        ({"feet": [[0.0, np.inf, 0.0]]}, "feet of the ground contact of body 'craft' must be finite"),
        ({"feet": np.zeros((0, 3))}, r"at least one, but are of shape \(0, 3\)"),
        ({"feet": [[0.0], [0.0, 1.0]]}, "rows of unequal length"),
    ],
)  # fmt: skip
def test_bad_numbers_are_refused(numbers, words):
    with pytest.raises(stm.ModelError, match=words):
        GroundContact("craft", **{"feet": FEET, **NUMBERS, **numbers})


def test_the_ground_has_no_feet_and_the_body_must_exist():
    with pytest.raises(stm.ModelError, match="needs a body that moves, but it is given ground"):
        GroundContact("ground", feet=FEET, **NUMBERS)
    body = stm.Body("craft", 1.0, [1.0, 1.0, 1.0], free=True)
    with pytest.raises(stm.ModelError, match="craf"):
        stm.System([body], forces=[GroundContact("craf", feet=FEET, **NUMBERS)])
