"""Trim and linearisation of mechanisms that are not the report's: against closed forms and twins."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import (
    BASE,
    COUPLER,
    CRANK,
    INERTIAS,
    MASSES,
    ROCKER,
    G,
    cart_pole,
    four_bar,
    stewart,
)

import stmuav_jax as stm


@pytest.fixture(scope="module")
def cart():
    space = stm.TreeSpace(cart_pole())
    return space, space.from_state(space.system.reference)


def test_stacked_points_differ_as_single_ones_do(cart):
    """A stack of errors along the last axis, with an angle beyond half a turn; of a free body too."""
    space, x = cart
    back = jax.jit(lambda v: space.difference(space.retract(x, v), x))
    v = 0.3 * np.random.default_rng(1).normal(size=(4, 2, 3))
    v[1, 0, 0] = 3.0
    turned = v.copy()
    turned[1, 0, 0] += 2 * np.pi
    x = jax.tree.map(lambda leaf: leaf[:, None, None], x)
    for given in (v, turned):
        np.testing.assert_allclose(back(given), v, atol=1e-14)
    space = stm.TreeSpace(stm.make_scene("hexacopter").system)
    x = jax.tree.map(lambda leaf: leaf[:, None], space.from_state(space.system.reference))
    v = 0.3 * np.random.default_rng(1).normal(size=(12, 3))
    back = jax.jit(lambda v: space.difference(space.retract(x, v), x))
    np.testing.assert_allclose(back(v), v, atol=1e-14)


def test_matrices_of_a_cart_pole_in_closed_form(cart):
    """Upright at rest: (M + m) x'' + m l a'' = F, m l x'' + (J + m l^2) a'' = m g l a."""
    space, x = cart
    found = stm.linearize(space, x, outputs=["hinge.angle"])
    M, m, length, J = 2.0, 0.5, 0.8, 0.02
    mass = np.array([[M + m, m * length], [m * length, J + m * length**2]])
    A, B = np.zeros((4, 4)), np.zeros((4, 1))
    A[:2, 2:] = np.eye(2)
    A[2:, 1] = np.linalg.solve(mass, [0.0, m * G * length])
    B[2:, 0] = np.linalg.solve(mass, [1.0, 0.0])
    np.testing.assert_allclose(found.A, A, atol=1e-12)
    np.testing.assert_allclose(found.B, B, atol=1e-12)
    np.testing.assert_array_equal(found.C, [[0, 1, 0, 0]])
    assert found.inputs == (("effort", "N"),)
    assert np.min(found.controllability()) > 1e-2


@pytest.mark.slow
def test_trim_of_an_accelerating_cart(cart):
    """A pole that leans into a constant acceleration a: tan(angle) = a / g, F = (M + m) a."""
    space, x = cart
    a = 2.0
    found = stm.trim(space, at=x, free=["hinge.angle"], accelerations=[a, 0.0])
    angle = float(space.difference(found.point, x)[1])
    assert np.tan(angle) == pytest.approx(a / G, rel=1e-12)
    assert float(found.values[0]) == pytest.approx(2.5 * a, rel=1e-12)
    # by the implicit function: d tan(angle) / da = 1 / g
    of = lambda a: space.difference(
        stm.trim(space, at=x, free=["hinge.angle"], accelerations=jnp.stack([a, 0 * a])).point, x
    )[1]
    exact = 1 / G / (1 + (a / G) ** 2)
    assert float(jax.grad(of)(jnp.asarray(a))) == pytest.approx(exact, rel=1e-10)


@pytest.mark.parametrize("kind", ["revolute", "spherical"])
def test_a_load_that_hangs_from_a_machine_in_hover(kind):
    """Its equations repeat those of the machine: a hinge has no angle to find, a ball turns about the cable."""
    bodies = [
        stm.Body("frame", 1.2, [0.012, 0.012, 0.022], free=True),
        stm.Body("load", 0.4, [3e-4] * 3, position=[0.05, 0.0, -0.1], com=[0, 0, -0.8]),
    ]
    point = {"point": [0.05, 0.0, -0.1]}
    cable = (
        stm.revolute("cable", "frame", "load", axis=[0, 1, 0], **point)
        if kind == "revolute"
        else stm.spherical("cable", "frame", "load", **point)
    )
    count = 6 if kind == "revolute" else 4
    arms, spin = stm.uav.rotor_layout(count, 0.2)
    rotors = stm.uav.Rotors(
        "frame", arms=arms, spin=spin, k_f=1e-5, k_tau=2e-7, speed_squared=[3e5] * count
    )
    space = stm.TreeSpace(stm.System(bodies, [cable], [stm.Gravity(), rotors]))
    x, free = space.from_state(space.system.reference), []
    if kind == "spherical":
        free = [f"cable.rotation_{axis}" for axis in "xyz"]
        x = space.retract(x, jnp.zeros(space.size).at[7].set(0.2))
        with pytest.raises(stm.SettingError, match=f"No input acts in the joint of {free[0]}, "):
            stm.analysis.trim_condition(space, stm.analysis.hover(), at=x)
    trim = stm.analysis.trim_condition(space, stm.analysis.hover(), at=x, free=free)
    assert bool(trim.converged)
    assert float(jnp.sum(trim.values)) * 1e-5 == pytest.approx(1.6 * 9.81, rel=1e-12)
    # the load pulls at its hinge, 5 cm in front of the frame's centre of mass
    moment = -jnp.sum(trim.values * 1e-5 * arms[:, 0])
    assert float(moment) == pytest.approx(-0.05 * 0.4 * 9.81, rel=1e-9)
    assert space.to_state(trim.point).r[1] == pytest.approx([0.05, 0.0, -0.9], abs=1e-9)


def test_what_a_trim_refuses(cart):
    space, x = cart
    words = r"2 equations here.* only 1 unknowns \(effort\).* in the joint of hinge.angle: "
    with pytest.raises(stm.SettingError, match=words):
        stm.trim(space, at=x)
    with pytest.raises(stm.SettingError, match=r"name 'hinge', .*Did you mean 'hinge.angle'"):
        stm.trim(space, at=x, free=["hinge"])
    with pytest.raises(stm.StateError, match=r"No trim was found near the start"):
        stm.trim(space, at=x, free=["rail.displacement"], accelerations=[0.0, 1.0])
    none = stm.trim(space, at=x, free=["rail.displacement"], accelerations=[0.0, 1.0], throw=False)
    assert not bool(none.converged)
    assert np.isnan(none.values).all()
    with pytest.raises(stm.ModelError, match="target accelerations must be numbers of shape"):
        stm.trim(space, at=x, free=["hinge.angle"], accelerations=[0.0])


# --- a four-bar with a torque on its crank, against a twin with one coordinate


def _energies(angle):
    """Generalised mass and potential of the twin in its crank angle, by its own geometry."""

    def places(angle):
        a = jnp.stack([CRANK * jnp.cos(angle), CRANK * jnp.sin(angle)])
        b = jnp.array([BASE, 0.0])
        d = b - a
        r = jnp.sqrt(d @ d)
        along = (COUPLER**2 - ROCKER**2 + r**2) / (2 * r)
        up = jnp.sqrt(COUPLER**2 - along**2)
        c = a + (along * d + up * jnp.stack([-d[1], d[0]])) / r
        turned = jnp.stack([angle, jnp.arctan2(*(c - a)[::-1]), jnp.arctan2(*(c - b)[::-1])])
        return jnp.stack([a / 2, (a + c) / 2, (b + c) / 2]), turned

    middle, _ = places(angle)
    v, w = jax.jacfwd(places)(angle)
    mass = jnp.sum(jnp.array(MASSES)[:, None] * v**2) + jnp.sum(jnp.array(INERTIAS) * w**2)
    return mass, G * jnp.sum(jnp.array(MASSES) * middle[:, 1])


def twin_rate(angle, rate, torque):
    """M a'' + M' a'^2 / 2 + V' = torque."""
    mass, slope = _energies(angle)[0], jax.jacfwd(_energies)(angle)
    return (torque - slope[0] * rate**2 / 2 - slope[1]) / mass


@pytest.fixture(scope="module")
def bars():
    space = stm.TreeSpace(four_bar(), independent=["A.angle"])
    return space, space.from_state(space.system.reference)


@pytest.mark.slow
def test_four_bar_against_its_twin(bars):
    """Acceleration, A and B at moving points, and the torque that holds it: to 1e-9."""
    space, x = bars
    rate, torque = 1.3, 2.0
    system = stm.inputs_of(space.system).applied(space.system, jnp.array([torque]))
    twin = lambda z: twin_rate(z[0], z[1], z[2])
    for angle in (0.4, 1.0, 2.5):
        at = space.retract(x, jnp.array([angle - 1.0, rate]))
        z = jnp.array([angle, rate, torque])
        np.testing.assert_allclose(space.rates(at, 0.0, system), [rate, twin(z)], rtol=1e-9)
        by = jax.jacfwd(twin)(z)
        linear = stm.linearize(space, at, values=[torque])
        np.testing.assert_allclose(linear.A, np.array([[0, 1], by[:2]]), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(linear.B[1], by[2:], rtol=1e-9)
        held = stm.trim(space, at=space.retract(x, jnp.array([angle - 1.0, 0.0])))
        # the static torque: dV / d(angle)
        slope = jax.jacfwd(lambda a: _energies(a)[1])(angle)
        assert float(held.values[0]) == pytest.approx(float(slope), rel=1e-9)


@pytest.mark.slow
def test_loops_that_do_not_close_give_no_numbers():
    """A rocker turned beyond its reach: no accelerations, and words instead of a linearisation."""
    space = stm.TreeSpace(four_bar(), independent=["D.angle"])
    x = space.from_state(space.system.reference)
    near, far = (space.retract(x, jnp.array([turn, 0.0])) for turn in (0.1, 2.5))
    assert np.isfinite(space.rates(near)).all()
    assert np.isnan(space.rates(far)[1])
    with pytest.raises(stm.StateError, match=r"independent coordinates D\.angle"):
        stm.linearize(space, far)


def test_a_singular_posture_is_reported():
    """Crank and coupler of a change-point four-bar in line: two motions instead of one."""
    bars = [(0, 1.0), (1.0, 3.0), (2.0, 3.0)]
    bodies = [
        stm.Body(name, 1.0, np.eye(3) * 0.1, position=[(a + b) / 2, 0.0, 0.0])
        for name, (a, b) in zip(("a", "b", "c"), bars, strict=True)
    ]
    pins = [
        ("A", "ground", "a", 0.0),
        ("B", "a", "b", 1.0),
        ("C", "b", "c", 3.0),
        ("D", "ground", "c", 2.0),
    ]
    joints = [
        stm.revolute(n, i, j, point=[x, 0.0, 0.0], axis=[0.0, 1.0, 0.0]) for n, i, j, x in pins
    ]
    with pytest.raises(
        stm.ModelError, match=r"posture is singular: .* leave 2 independent .* but 1"
    ):
        stm.TreeSpace(stm.System(bodies, joints))


# --- the hexacopter in hover, against the rigid body's closed form


@pytest.mark.slow
def test_matrices_of_a_hexacopter_in_closed_form():
    """Level, with errors (r, turn in body axes, v, omega): v' = g turn x z + lift z / m, J omega' = M u."""
    scene = stm.make_scene("hexacopter")
    space = stm.TreeSpace(scene.system)
    x = space.from_state(scene.system.reference)
    rotors: Any = scene.system.forces[1]
    held = stm.analysis.trim_condition(space, stm.analysis.hover(), at=x)
    found = stm.linearize(space, held.point, values=held.values)
    mass, J = float(scene.system.bodies.mass[0]), np.asarray(scene.system.bodies.inertia[0])
    arms, spin = np.asarray(rotors.arms) - np.asarray(scene.system.bodies.com[0]), rotors.spin
    k_f, up = float(rotors.k_f), np.array([0.0, 0.0, 1.0])
    A, B = np.zeros((12, 12)), np.zeros((12, 6))
    A[:6, 6:] = np.eye(6)
    A[6, 4], A[7, 3] = G, -G
    B[8] = k_f / mass
    moments = k_f * np.cross(arms, up) - float(rotors.k_tau) * np.outer(spin, up)
    B[9:] = np.linalg.solve(J, moments.T)
    np.testing.assert_allclose(found.A, A, atol=1e-12 * G)
    np.testing.assert_allclose(found.B, B, atol=1e-12 * np.max(np.abs(B)))


# --- the tracker on the ground, against its _energies


# --- a Stewart platform: six legs, six degrees of freedom


@pytest.fixture(scope="module")
def platform():
    system, feet, heads = stewart()
    space = stm.TreeSpace(system, independent=[f"T{k}.displacement" for k in range(6)])
    return space, space.from_state(system.reference), feet, heads


@pytest.mark.slow
def test_stewart_platform(platform):
    """Six degrees of freedom; its legs' forces are those of static equilibrium, to 1e-9."""
    space, x, feet, heads = platform
    assert space.dof == 6
    assert [name for name, _ in space.names[:6]] == [f"T{k}.displacement" for k in range(6)]
    found = stm.trim(space, at=x)
    exact = static_forces(feet, heads)
    np.testing.assert_allclose(found.values, exact, rtol=1e-9)
    linear = stm.linearize(space, found.point, values=found.values)
    assert linear.A.shape == (12, 12)
    np.testing.assert_allclose(linear.A[:6, 6:], np.eye(6), atol=1e-12)
    exact = np.linalg.inv(mass_by_lengths(feet, heads))
    np.testing.assert_allclose(linear.B[6:], exact, atol=1e-9 * np.max(np.abs(exact)))


def mass_by_lengths(feet, heads):
    """Mass matrix in the legs' lengths (6, 6), from the velocities of all bodies written out.

    A leg turns about the two axes of its universal joint, which are across it here.
    """
    legs, centre = heads - feet, np.array([0.0, 0.0, 1.25])
    length = np.linalg.norm(legs, axis=1)
    axes = legs / length[:, None]
    arms = heads - centre
    twist = np.linalg.inv(np.concatenate([axes, np.cross(arms, axes)], axis=1))
    # columns: what a unit rate of each length does
    v, omega = twist[:3], twist[3:]
    M = 20.0 * v.T @ v + omega.T @ np.diag([1.0, 1.2, 1.8]) @ omega
    for k in range(6):
        head = v + np.cross(omega, arms[k], axis=0)
        turning = np.cross(axes[k], head, axis=0) / length[k]
        barrel = np.cross(turning, 0.25 * legs[k], axis=0)
        rod = np.cross(turning, 0.75 * legs[k], axis=0)
        rod[:, k] += axes[k]
        M += 0.8 * barrel.T @ barrel + 0.5 * rod.T @ rod + 0.02 * turning.T @ turning
    return M


def static_forces(feet, heads):
    """Forces along the legs from free bodies: legs by moments about their feet, then the platform."""
    axes = (heads - feet) / np.linalg.norm(heads - feet, axis=1)[:, None]
    # at every head: along the axis f, and across it what the leg's weight needs about the foot
    down, length = np.array([0.0, 0.0, -G]), np.linalg.norm(heads - feet, axis=1)
    wrench, columns = np.zeros(6), []
    centre = np.array([0.0, 0.0, 1.25])
    wrench[:3] = 20.0 * down
    for k in range(6):
        arm = heads[k] - centre
        moment = (0.25 * 0.8 + 0.75 * 0.5) * length[k] * np.cross(axes[k], down)
        # the platform pushes the head by h with length axis x h + moment = 0, h across the axis
        across = np.cross(axes[k], moment) / length[k]
        wrench[:3] -= across
        wrench[3:] -= np.cross(arm, across)
        columns.append(np.concatenate([axes[k], np.cross(arm, axes[k])]))
    push = np.linalg.solve(np.array(columns).T, -wrench)
    # the effort carries the rod's own weight along the axis too
    return push - 0.5 * axes @ down


@pytest.mark.parametrize("kind", ["effort", "servo"])
def test_a_trim_begins_beyond_a_limit_and_keeps_it(kind):
    """A weight of 19.62 N on a slide: the start asks for 100 N, where the force has no slope."""

    def hold(limit, **options):
        force = (
            stm.JointEffort("slide", 100.0, limit=limit)
            if kind == "effort"
            else stm.mechanics.JointServo(
                "slide", stiffness=100.0, damping=1.0, target=1.0, limit=limit
            )
        )
        block = stm.Body("block", 2.0, [0.1] * 3)
        slide = stm.translational("slide", "ground", "block", axis=[0.0, 0.0, 1.0])
        space = stm.TreeSpace(stm.System([block], [slide], [stm.Gravity(), force]))
        return stm.trim(space, at=space.from_state(space.system.reference), **options)

    exact = 19.62 if kind == "effort" else 0.1962
    assert float(hold(25.0).values[0]) == pytest.approx(exact, rel=1e-12)
    words = r"needs an effort of 19.62 N of the .* in joint 'slide', but its limit is 5"
    with pytest.raises(stm.StateError, match=words):
        hold(5.0)
    refused = hold(5.0, throw=False)
    assert not bool(refused.converged)
    assert np.all(np.isnan(refused.values))
