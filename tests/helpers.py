"""Shared builders of the tests: small mechanisms, random numbers, NumPy rotations.

The rotations here are written out in NumPy on purpose: they are the independent side of
the comparisons.
"""

from collections.abc import Callable, Mapping
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.problem import begin_integration, prepare_problem
from stmuav_jax.math.compiler import quick_jit

GRAVITY = 9.81

# Called as it is, the public function compiles one operation at a time.
evaluated = quick_jit(stm.dynamics.evaluate)


def np_skew(a: Any) -> np.ndarray:
    """Cross-product matrix."""
    x, y, z = a
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=float)


def np_g(p: Any) -> np.ndarray:
    """G = [-e, e~ + e0 I]."""
    e = np.asarray(p)[1:]
    return np.hstack([-e[:, None], np_skew(e) + p[0] * np.eye(3)])


def np_l(p: Any) -> np.ndarray:
    """L = [-e, -e~ + e0 I]."""
    e = np.asarray(p)[1:]
    return np.hstack([-e[:, None], -np_skew(e) + p[0] * np.eye(3)])


def np_bar(a: Any) -> np.ndarray:
    """[[0, -a^T], [a, -a~]]."""
    a = np.asarray(a, dtype=float)
    return np.block([[np.zeros((1, 1)), -a[None, :]], [a[:, None], -np_skew(a)]])


def np_rotation(p: Any) -> np.ndarray:
    """A by Rodrigues' formula, (2 e0^2 - 1) I + 2 (e e^T + e0 e~), for unit p."""
    e = np.asarray(p)[1:]
    return (2 * p[0] ** 2 - 1) * np.eye(3) + 2 * (np.outer(e, e) + p[0] * np_skew(e))


def unit(v: Any) -> np.ndarray:
    """v / |v|."""
    v = np.asarray(v, dtype=float)
    return v / np.linalg.norm(v)


def turn(axis: Any, angle: float) -> np.ndarray:
    """Euler parameters of a rotation by `angle` [rad] about `axis`."""
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * unit(axis)])


def random_quaternion(rng: np.random.Generator) -> np.ndarray:
    """Unit Euler parameters, uniform over rotations."""
    return unit(rng.normal(size=4))


def inertia_of(rng: np.random.Generator, size: float = 0.02) -> np.ndarray:
    """A full tensor that a body can have: that of a few random point masses."""
    points = rng.normal(size=(6, 3)) * np.sqrt(size)
    return np.eye(3) * np.sum(points**2) / 6 - points.T @ points / 6


def state_of(r: Any, p: Any, v: Any = None, omega: Any = None) -> stm.State:
    """A `State` from arrays or lists; velocities are zero by default."""
    r = jnp.asarray(r, dtype=float)
    none = jnp.zeros_like(r)
    return stm.State(
        r,
        jnp.asarray(p, dtype=float),
        none if v is None else jnp.asarray(v, dtype=float),
        none if omega is None else jnp.asarray(omega, dtype=float),
    )


def moving(system: stm.System, v: Any, omega: Any) -> stm.State:
    """The reference posture with given velocities."""
    return state_of(system.reference.r, system.reference.p, v, omega)


def scene_of(system: stm.System, state: stm.State | None = None, **more: Any) -> stm.Scene:
    """A scene for tests."""
    state = system.reference if state is None else state
    return stm.Scene("test", "A test", system, state, **more)


def relative_error(got: Any, expected: Any) -> float:
    """Largest |difference| over the largest |expected| of a whole pytree."""
    leaves = zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True)
    worst, size = 0.0, 0.0
    for a, b in leaves:
        worst = max(worst, float(np.max(np.abs(np.asarray(a) - np.asarray(b)), initial=0.0)))
        size = max(size, float(np.max(np.abs(np.asarray(b)), initial=0.0)))
    assert np.isfinite(worst)
    return worst / size if size else worst


def derivative_size(system: stm.System) -> tuple[int, int]:
    """Equations of one derivative, those inside others included; size of what is integrated."""

    def count(jaxpr: Any) -> int:
        total = len(jaxpr.eqns)
        for eqn in jaxpr.eqns:
            for value in eqn.params.values():
                if hasattr(value, "jaxpr") or hasattr(value, "eqns"):
                    total += count(getattr(value, "jaxpr", value))
        return total

    problem = prepare_problem(system, stm.Method())
    y = begin_integration(problem, jnp.zeros(()), system.reference).y
    found = jax.make_jaxpr(lambda t, y: problem.field(t, y, problem.model))(0.0, y)
    return count(found.jaxpr), y.shape[0]


def make_equal_steps(
    system: stm.System, start: stm.State, solver: Any, formulation: Any
) -> Callable[[float, int], np.ndarray]:
    """(t1 [s], count) -> positions (n, 3) [m] at t1 by that many equal steps, from one program.

    Stages of implicit solvers are solved to 1e-13.
    """
    method = stm.Method(
        formulation=formulation, solver=solver, rtol=1e-13, atol=1e-13,
        adjoint=diffrax.ForwardMode(), steps="state",
    )  # fmt: skip
    problem = prepare_problem(system, method)
    y0 = begin_integration(problem, jnp.zeros(()), start).y

    @jax.jit
    def end(t1: Any, step: Any) -> Any:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(problem.field), problem.solver(), 0.0, t1, step, y0, problem.model,
            stepsize_controller=diffrax.ConstantStepSize(), adjoint=method.adjoint, max_steps=1024,
        )  # fmt: skip
        assert solution.ys is not None
        return formulation.to_state(problem.model, solution.ys[0][: problem.n_state]).r

    # a last step of round-off's length would be one more
    return lambda t1, count: np.asarray(end(t1, t1 / count * (1 + 1e-14)))


def central(f: Callable[[float], Any], step: float) -> np.ndarray:
    """Fourth-order central difference of f at 0."""
    a, b, c, d = (np.asarray(f(k * step)) for k in (-2.0, -1.0, 1.0, 2.0))
    return (a - 8 * b + 8 * c - d) / (12 * step)


def pendulum(
    *, length: Any = 0.5, mass: Any = 2.0, gravity: Any = GRAVITY, forces: tuple[Any, ...] = ()
) -> stm.System:
    """A rod-like body that hangs in -z from a revolute joint (axis y) at the origin.

    Moment of inertia about the joint: mass length^2 + 0.02.
    """
    body = stm.Body("bob", mass, [0.02, 0.02, 0.01], position=[0.0, 0.0, -length])
    hinge = stm.revolute("hinge", "ground", "bob", point=[0.0, 0.0, 0.0], axis=[0, 1, 0])
    pull = stm.Gravity(jnp.stack([jnp.zeros(()), jnp.zeros(()), -jnp.asarray(gravity, float)]))
    return stm.System([body], [hinge], [pull, *forces])


def swung(system: stm.System, angle: Any, rate: Any = 0.0, length: Any = 0.5) -> stm.State:
    """The pendulum at `angle` [rad] from hanging about y, turning at `rate` [rad/s]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero = jnp.zeros_like(s)
    omega = jnp.stack([zero, jnp.asarray(rate, dtype=float) + zero, zero])
    r = length * jnp.stack([-s, zero, -c])
    p = jnp.stack([jnp.cos(angle / 2), zero, jnp.sin(angle / 2), zero])
    assert system.n_bodies == 1
    return stm.State(r[None], p[None], jnp.cross(omega, r)[None], omega[None])


FOUR_BAR_POINTS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.25], [0.6, 0.0, 0.45], [0.7, 0.0, 0.0]])


def four_bar(
    *, redundant: bool = True, axes: tuple[float, float, float] = (0.0, 1.0, 0.0), **more: Any
) -> stm.System:
    """A planar four-bar in the xz plane: crank, coupler, rocker.

    With four revolutes (20 rows, rank 17), or with a ball and a universal joint at the
    coupler's ends (17 rows, the same motion).
    """
    A, B, C, D = FOUR_BAR_POINTS
    bodies = [
        stm.Body("crank", 0.8, [4e-3, 5e-3, 3e-3], position=(A + B) / 2),
        stm.Body("coupler", 1.5, [2e-2, 3e-2, 2e-2], position=(B + C) / 2 + [0, 0, 0.05]),
        stm.Body("rocker", 1.1, [1e-2, 9e-3, 5e-3], position=(C + D) / 2),
    ]
    joints = [
        stm.revolute("A", "ground", "crank", point=A, axis=axes),
        stm.revolute("D", "ground", "rocker", point=D, axis=axes),
    ]
    if redundant:
        joints += [
            stm.revolute("B", "crank", "coupler", point=B, axis=axes),
            stm.revolute("C", "coupler", "rocker", point=C, axis=axes),
        ]
    else:
        across = np.cross(C - B, axes)
        joints += [
            stm.spherical("B", "crank", "coupler", point=B),
            stm.universal("C", "coupler", "rocker", point=C, axis_i=across, axis_j=axes),
        ]
    joints += more.pop("joints", [])
    forces = [stm.Gravity(), *more.pop("forces", [])]
    return stm.System(bodies, joints, forces, **more)


@quick_jit
def rows_of(model: Any, state: stm.State) -> Any:
    """Constraint functions, targets and Jacobian of a prepared system in maximal coordinates."""
    return model.constraints.equations(jnp.zeros(()), model.system.kinematics(state))


def four_bar_state(system: stm.System, rate: float) -> stm.State:
    """The four-bar's reference posture, its crank turning at `rate` [rad/s]."""
    omega = np.zeros((3, 3))
    omega[0, 1] = rate
    v = np.zeros((3, 3))
    v[0] = np.cross(omega[0], FOUR_BAR_POINTS[1] / 2)
    hold = system.reference
    J = np.asarray(rows_of(stm.Augmented().prepare(system), hold).matrix)
    u0 = np.concatenate([v, omega], axis=1).reshape(-1)
    mine = np.zeros(18, dtype=bool)
    mine[:6] = True
    rest = np.linalg.lstsq(J[:, ~mine], -J[:, mine] @ u0[mine])[0]
    u0[~mine] = rest
    assert np.max(np.abs(J @ u0)) < 1e-12
    u = u0.reshape(3, 6)
    return state_of(hold.r, hold.p, u[:, :3], u[:, 3:])


# Seven bodies in closed loops, like the UAV with its tracker: mass [kg], centre of mass [m],
# Euler parameters (normalised when used), inertia tensor [kg m^2].
_SEVEN: Mapping[str, tuple[float, list[float], list[float], list[float]]] = {
    "uav": (5.88, [-0.064, 0.064, 0.030], [1, 0, 0, 0], [0.0625, 0.0628, 0.0893]),
    "slider2": (0.1897, [-0.124, 0.015, 0.0249], [1, 0, 0, 0], [2.8e-5, 2.0e-5, 2.0e-5]),
    "slider3": (0.1897, [-0.015, 0.124, 0.0242], [1, 0, 0, 0], [2.0e-5, 2.8e-5, 2.0e-5]),
    "post": (0.1045, [-0.0115, 0.019, 0.0991], [0.9984, -0.0557, 0, 0], [1.2e-4, 1.2e-4, 5.4e-6]),
    "rod5": (
        0.0533, [-0.0128, 0.0980, 0.0680], [0.9952, 0.0947, 0.0235, -0.0022], [5.9e-5, 5.9e-5, 6e-7],
    ),
    "rod6": (0.0544, [-0.0926, 0.015, 0.0673], [0.9881, 0, 0.1537, 0], [6.2e-5, 6.2e-5, 6e-7]),
    "platform": (
        0.8909, [-0.0346, 0.0425, 0.1365], [0.9793, -0.1317, -0.1524, 0.0205],
        [1.23e-3, 1.22e-3, 2.43e-3],
    ),
}  # fmt: skip


def parallelogram(
    angle: float,
    *,
    size: float = 1.0,
    gravity: Any = (0, 0, -GRAVITY),
    forces: tuple[Any, ...] = (),
) -> stm.System:
    """Two cranks of 1 m and a coupler of 2 m, with the cranks at an angle; all lie flat at zero."""
    B = size * np.array([np.cos(angle), 0.0, np.sin(angle)])
    D = size * np.array([2.0, 0.0, 0.0])
    p = (np.cos(angle / 2), 0.0, -np.sin(angle / 2), 0.0)
    inertia, axis = size**2 * np.array([1e-3, 0.1, 0.1]), (0, -1, 0)
    bodies = [
        stm.Body("crank", 1.0, inertia, position=B / 2, orientation=p),
        stm.Body("coupler", 2.0, inertia, position=B + D / 2),
        stm.Body("rocker", 1.0, inertia, position=D + B / 2, orientation=p),
    ]
    joints = [
        stm.revolute("A", "ground", "crank", point=(0, 0, 0), axis=axis),
        stm.revolute("B", "crank", "coupler", point=B, axis=axis),
        stm.revolute("C", "coupler", "rocker", point=B + D, axis=axis),
        stm.revolute("D", "ground", "rocker", point=D, axis=axis),
    ]
    return stm.System(bodies, joints, [stm.Gravity(gravity), *forces])


def seven_bodies() -> stm.System:
    """A free base, two sliders, a post, two rods and a platform: 34 rows, 8 degrees of freedom.

    The joint graph of AFRL-AFOSR-JP-TR-2019-0058, Part II, section 3.1, with rounded
    dimensions and tensors made full by a small common rotation.
    """
    tilt = np_rotation(turn([1, 2, 3], 0.2))
    bodies = [
        stm.Body(
            name, mass, tilt @ np.diag(J) @ tilt.T, position=r, orientation=unit(p),
            free=name == "uav",
        )
        for name, (mass, r, p, J) in _SEVEN.items()
    ]  # fmt: skip
    x, y, z = np.eye(3)
    rod_axis = [0.9989, 0.0, -0.0472]
    platform_axis = np.cross([1, 0, 0], [0, 0.2642, 0.9645])
    joints = [
        stm.translational("T12", "uav", "slider2", axis=z),
        stm.translational("T13", "uav", "slider3", axis=z),
        stm.revolute("R14", "uav", "post", point=[-0.015, 0.015, 0.0632], axis=x),
        stm.revolute("R26", "slider2", "rod6", point=[-0.107, 0.015, 0.0221], axis=y),
        stm.universal(
            "U35", "slider3", "rod5", point=[-0.015, 0.107, 0.0214], axis_i=y, axis_j=rod_axis
        ),
        stm.universal(
            "U47", "post", "platform", point=[-0.015, 0.0243, 0.1467], axis_i=x,
            axis_j=platform_axis,
        ),
        stm.spherical("S57", "rod5", "platform", point=[-0.0106, 0.0891, 0.1146]),
        stm.spherical("S67", "rod6", "platform", point=[-0.0781, 0.015, 0.1126]),
    ]  # fmt: skip
    return stm.System(bodies, joints)


def random_seven(system: stm.System, rng: np.random.Generator) -> stm.State:
    """A random consistent state of `seven_bodies`: attitude, posture and rates all random."""
    q = random_quaternion(rng)
    R = np_rotation(q)
    shake = 0.1 * rng.normal(size=(7, 3))
    r = np.asarray(system.reference.r) + 0.003 * rng.normal(size=(7, 3))
    p = np.stack(
        [
            np.asarray(
                stm.rotation.product(stm.rotation.product(q, x), turn(s, float(np.linalg.norm(s))))
            )
            for x, s in zip(system.reference.p, shake, strict=True)
        ]
    )
    v = rng.normal(size=(7, 3))
    omega = 5 * rng.normal(size=(7, 3))
    guess = state_of(r @ R.T + rng.normal(size=3), p, v, omega)
    return stm.assemble(system, guess).state


def forked(floating, *more):
    """A body that carries two, one of them on a ball; another body on its own slide; more joints."""
    unit = [0.01, 0.02, 0.015]
    at = {"hub": [0, 0, 0], "a": [0, 0, 0.3], "b": [0.1, 0.2, 0.3], "c": [0.1, -0.2, 0.3]}
    at["d"] = [-0.3, 0, 0]
    bodies = [
        stm.Body(name, 1.0 + k, unit, position=r, free=name == "hub")
        for k, (name, r) in enumerate(at.items())
    ]
    hub = "hub" if floating else stm.GROUND
    joints = [
        stm.revolute("ra", hub, "a", point=[0, 0, 0.1], axis=[1, 0, 0]),
        stm.revolute("rb", "a", "b", point=[0, 0, 0.3], axis=[0, 1, 0]),
        stm.spherical("sc", "a", "c", point=[0, -0.1, 0.3]),
        stm.translational("td", hub, "d", point=[-0.3, 0, 0], axis=[0, 0, 1]),
        *more,
    ]
    return stm.System(bodies[0 if floating else 1 :], joints, [stm.Gravity()])


def check_same_types(first: Any, later: Any) -> None:
    """Check that two pytrees have one structure, and their arrays the same shapes and data types."""
    assert jax.tree.structure(first) == jax.tree.structure(later)
    kind = lambda x: (x.shape, x.dtype, x.weak_type)
    assert list(map(kind, jax.tree.leaves(first))) == list(map(kind, jax.tree.leaves(later)))
