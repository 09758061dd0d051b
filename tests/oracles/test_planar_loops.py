"""Planar loops of hinges in one angle, by Lagrange's equation, as an oracle of motion and gradients.

Closures are intersections of circles; the equation is integrated in 200 steps of the classical
Runge-Kutta method for each interval, whose own error is below 1e-9 m.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.mechanics import JointServo

TS = np.array([0.0, 0.1, 0.2, 0.3])
GRAVITY = np.array([3.0, -9.81])


def meet(B, D, b, d, side):
    """Point at distances b from B and d from D, on the left of B to D for the side 1."""
    size = jnp.hypot(*(D - B))
    e = (D - B) / size
    along = (b**2 - d**2 + size**2) / (2 * size)
    return B + along * e + side * jnp.sqrt(b**2 - along**2) * jnp.array([-e[1], e[0]])


def link(start, end, *more):
    """Centre of the points of a link, and its direction."""
    points = jnp.stack([start, end, *more])
    return jnp.mean(points, axis=0), (end - start) / jnp.hypot(*(end - start))


def length(a, b):
    return float(np.hypot(*np.subtract(b, a)))


A, B, C, D = np.array([[0.0, 0.0], [0.1, 0.25], [0.6, 0.45], [0.7, 0.0]])
E, F, G = np.array([[0.9, 0.3], [1.3, 0.5], [1.4, 0.0]])


def four_bar_points(q):
    crank = length(A, B) * jnp.array([jnp.cos(q), jnp.sin(q)])
    return crank, meet(crank, D, length(B, C), length(C, D), 1)


def four_bar(q):
    b, c = four_bar_points(q)
    return link(A, b), link(b, c), link(D, c)


def six_bar(q):
    """Four-bar whose rocker carries a dyad."""
    b, c = four_bar_points(q)
    u, along = (C - D) / length(C, D), E - D
    own = along @ u, u[0] * along[1] - u[1] * along[0]
    v = (c - D) / length(C, D)
    e = D + own[0] * v + own[1] * jnp.array([-v[1], v[0]])
    f = meet(e, G, length(E, F), length(F, G), 1)
    return link(A, b), link(b, c), link(D, c, e), link(e, f), link(G, f)


def slider_crank(q):
    crank = 0.1 * jnp.array([jnp.cos(q), jnp.sin(q)])
    pin = jnp.array([crank[0] + jnp.sqrt(0.09 - crank[1] ** 2), 0.0])
    return link(A, crank), link(crank, pin), (pin, jnp.array([1.0, 0.0]))


# Closure, angle at the start, and masses; hinges as bodies and a point, from the closure at the start.
START = {"four_bar": np.arctan2(B[1], B[0]), "six_bar": np.arctan2(B[1], B[0]), "slider_crank": 0.7}
MASSES = {
    "four_bar": [0.8, 1.5, 1.1],
    "six_bar": [0.8, 1.5, 1.1, 0.9, 0.7],
    "slider_crank": [0.1, 0.3, 0.5],
}
CLOSURES = {"four_bar": four_bar, "six_bar": six_bar, "slider_crank": slider_crank}
FOUR_HINGES = [("ground", "1", A), ("1", "2", B), ("2", "3", C), ("ground", "3", D)]
SLIDER_PIN = np.array([0.1 * np.cos(0.7), 0.1 * np.sin(0.7)])
SLIDER_END = np.array([SLIDER_PIN[0] + np.sqrt(0.09 - SLIDER_PIN[1] ** 2), 0.0])
HINGES = {
    "four_bar": FOUR_HINGES,
    "six_bar": [*FOUR_HINGES, ("3", "4", E), ("4", "5", F), ("ground", "5", G)],
    "slider_crank": [("ground", "1", A), ("1", "2", SLIDER_PIN), ("2", "3", SLIDER_END)],
}


def inertia(name):
    return 0.01 * np.array(MASSES[name])


def make_system(name, *forces):
    places = CLOSURES[name](START[name])
    bodies = [
        stm.Body(str(k + 1), m, np.full(3, J), position=[*np.asarray(place[0]), 0.0])
        for k, (m, J, place) in enumerate(zip(MASSES[name], inertia(name), places, strict=True))
    ]
    joints = [
        stm.revolute(f"hinge_{k}", i, j, point=[*point, 0.0], axis=(0, 0, 1))
        for k, (i, j, point) in enumerate(HINGES[name])
    ]
    if name == "slider_crank":
        joints.append(stm.translational("guide", "ground", "3", axis=(1, 0, 0)))
    return stm.System(bodies, joints, [stm.Gravity([*GRAVITY, 0.0]), *forces])


def twin(name, factors, ts, stiffness=0.0, target=0.0, steps=200):
    """Centres of the bodies (k, n, 2) at times ts, masses and inertias times factors (n,)."""
    closure, start = CLOSURES[name], START[name]
    masses, inertias = (jnp.asarray(x) * factors for x in (MASSES[name], inertia(name)))
    centres = lambda q: jnp.stack([place[0] for place in closure(q)])
    directions = lambda q: jnp.stack([place[1] for place in closure(q)])

    def mass(q):
        slope, turn = jax.jacfwd(centres)(q), jax.jacfwd(directions)(q)
        return jnp.sum(masses * jnp.sum(slope**2, axis=1) + inertias * jnp.sum(turn**2, axis=1))

    def potential(q):
        weight = -jnp.sum(masses * (centres(q) @ jnp.asarray(GRAVITY)))
        return weight + 0.5 * stiffness * (q - start - target) ** 2

    def rate(x):
        q, u = x
        acceleration = -(0.5 * jax.grad(mass)(q) * u**2 + jax.grad(potential)(q)) / mass(q)
        return jnp.stack([u, acceleration])

    def to_next(x, h):
        def step(x, _):
            a = rate(x)
            b = rate(x + h / 2 * a)
            c = rate(x + h / 2 * b)
            return x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c)), None

        x, _ = jax.lax.scan(step, x, length=steps)
        return x, centres(x[0])

    x = jnp.array([start, 0.0])
    _, found = jax.lax.scan(to_next, x, jnp.diff(ts) / steps)
    return jnp.concatenate([centres(start)[None], found])


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CLOSURES))
def test_planar_loops_and_their_gradients_by_default(name):
    """`integrate` with the default method, and the place of the last body by each mass."""
    system, ts = make_system(name), jnp.asarray(TS)

    def end(factors):
        bodies = system.bodies
        changed = eqx.tree_at(
            lambda s: (s.bodies.mass, s.bodies.inertia), system,
            (bodies.mass * factors, bodies.inertia * factors[:, None, None]),
        )  # fmt: skip
        r = stm.integrate(changed, system.reference, ts).states.r[..., :2]
        return r[-1, -1, 0], r

    count = len(MASSES[name])
    places = jax.jit(lambda factors: twin(name, factors, ts))
    step, ones = 1e-4, jnp.ones(count)
    ends = [[float(places(ones + h * e)[-1, -1, 0]) for h in (-step, step)] for e in jnp.eye(count)]
    right_slope = np.diff(ends)[:, 0] / (2 * step)
    (_, r), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(ones)
    # solver class: tolerances of 1e-8
    np.testing.assert_allclose(r, places(ones), rtol=0, atol=1e-7)
    np.testing.assert_allclose(slope, right_slope, rtol=0, atol=1e-6 * np.max(np.abs(right_slope)))


@pytest.mark.slow
def test_auto_solver_on_a_planar_loop_with_a_stiff_servo():
    """Slider-crank whose crank a servo of 1e4 N m/rad pulls by 0.05 radians: "auto" is chosen and right."""
    ts = np.array([0.0, 0.01, 0.02])
    servo = JointServo("hinge_0", stiffness=1e4, damping=0.0, target=0.05)
    system = make_system("slider_crank", servo)
    method = stm.Method(solver="auto")
    run = stm.simulate(
        system, system.reference, ts=ts, method=method, error_estimate=False, analysis=False
    )
    assert run.successful
    assert not isinstance(run.method.solver, str)
    right = jax.jit(lambda factors: twin("slider_crank", factors, ts, 1e4, 0.05, 4000))(jnp.ones(3))
    np.testing.assert_allclose(run.states.r[..., :2], right, rtol=0, atol=1e-6)
