"""Laws that hold for every mechanism, tried on random ones: trees and loops of all joints.

Hypothesis draws the structure (bodies, joints, loops) and prints the one that fails; the numbers of
each structure are drawn by NumPy, several sets for one compilation. What is compared shares no
code: the minimal coordinates of the spanning tree, the maximal coordinates with a multiplier for
every row, and sums over the bodies in NumPy.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import inertia_of, np_rotation, random_quaternion, unit
from hypothesis import HealthCheck, Phase, given, settings, strategies as st

import stmuav_jax as stm
from stmuav_jax.dynamics.diagnostics import inspect_start
from stmuav_jax.dynamics.tree.closures import rows_after
from stmuav_jax.dynamics.tree.coordinates import read_coordinates

SETS = 25  # of numbers, for each structure
SAME, ROUND_OFF = 1e-9, 1e-15
# Rows that depend on each other to this are a singular posture, of which there may be few. The closures
# of loops in the tree's coordinates depend on each other to within this factor of it.
SINGULAR, FEW, FACTOR = 1e-5, 0.1, 1000.0
# Degrees of freedom that a joint takes.
TREE = {
    "spherical": 3,
    "universal": 4,
    "revolute": 5,
    "translational": 5,
    "cylindrical": 4,
    "screw": 5,
}
LOOPS = {"distance": 1, "revolute_spherical": 2, "spherical": 3, "universal": 4}


class Link(NamedTuple):
    """A joint between a body and an earlier one, or ground (-1)."""

    kind: str
    i: int
    j: int


class Structure(NamedTuple):
    """Number of bodies, the joints between them, those that close loops last; whether it floats."""

    bodies: int
    links: tuple[Link, ...]
    floating: bool = False


@st.composite
def floating_trees(draw: Any) -> Structure:
    """Two or three bodies, the first of them free."""
    count = draw(st.integers(2, 3))
    kinds = [draw(st.sampled_from(sorted(TREE))) for _ in range(1, count)]
    links = [Link(kind, draw(st.integers(0, k)), k + 1) for k, kind in enumerate(kinds)]
    return Structure(count, tuple(links), floating=True)


@st.composite
def structures(draw: Any) -> Structure:
    """Two to five bodies, each hung on an earlier one or on ground, and up to two loops."""
    count = draw(st.integers(2, 5))
    links = [
        Link(draw(st.sampled_from(sorted(TREE))), draw(st.integers(-1, k - 1)), k)
        for k in range(count)
    ]
    free = sum(6 - TREE[link.kind] for link in links)
    for _ in range(draw(st.integers(0, 2))):
        kind, j = draw(st.sampled_from(sorted(LOOPS))), draw(st.integers(1, count - 1))
        i = draw(st.integers(-1, j - 1))
        # what the loop may move, also if all loops so far lie on its way
        within = sum(6 - TREE[link.kind] for link in links[:count] if link.j in around(links, i, j))
        closed = sum(LOOPS[link.kind] for link in links[count:]) + LOOPS[kind]
        twice = any({i, j} == {link.i, link.j} for link in links)
        if min(free, within) > closed and not twice:
            links.append(Link(kind, i, j))
    return Structure(count, tuple(links))


def around(links: list[Link], i: int, j: int) -> set[int]:
    """Bodies whose tree joints lie between two bodies."""

    def up(k: int) -> set[int]:
        return {k, *up(links[k].i)} if k >= 0 else set()

    return up(i) ^ up(j)


def joint(
    name: str, kind: str, ends: tuple[str, str], at: dict[str, np.ndarray], swap: bool
) -> Any:
    """One joint; with `swap` its bodies change places."""
    i, j = ends[::-1] if swap else ends
    a, b = ("q", "p") if swap else ("p", "q")
    if kind == "spherical":
        return stm.spherical(name, i, j, point=at["p"])
    if kind == "universal":
        axes = (at["across"], at["axis"]) if swap else (at["axis"], at["across"])
        return stm.universal(name, i, j, point=at["p"], axis_i=axes[0], axis_j=axes[1])
    if kind == "distance":
        return stm.distance(name, i, j, point_i=at[a], point_j=at[b])
    if kind == "revolute_spherical":
        # it has no other direction: its axis is fixed in body i
        return stm.revolute_spherical(
            name,
            *ends,
            point_i=at["p"],
            axis=at["axis"],
            point_j=at["p"] + 0.3 * at["metre"] * at["across"],
        )
    if kind == "screw":
        return stm.screw(name, i, j, point=at["p"], axis=at["axis"], pitch=0.1 * at["metre"])
    make = {"revolute": stm.revolute, "translational": stm.translational,
            "cylindrical": stm.cylindrical}[kind]  # fmt: skip
    return make(name, i, j, point=at["p"], axis=at["axis"])


def built(
    structure: Structure,
    seed: int,
    *,
    turn: Any = None,
    shift: Any = 0.0,
    backwards: bool = False,
    units: tuple[float, float] = (1.0, 1.0),
) -> tuple[stm.System, jax.Array]:
    """The system with one set of numbers, and random velocities (n, 6) of its bodies.

    Args:
        turn: Euler parameters of a rotation of the whole world. shift: of its origin [m].
        backwards: bodies and joints in the opposite order, joints in the other direction.
        units: numbers of the metre and of the kilogram in the units of length and mass.
    """
    rng = np.random.default_rng(seed)
    metre, kilogram = units
    p_world = np.array([1.0, 0, 0, 0]) if turn is None else turn
    R = np_rotation(p_world)
    bodies, joints = [], []
    for k in range(structure.bodies):
        p = np.asarray(
            stm.rotation.product(jnp.asarray(p_world), jnp.asarray(random_quaternion(rng)))
        )
        where = metre * (R @ rng.normal(size=3) + shift)
        mass, inertia = kilogram * (0.5 + rng.random()), kilogram * metre**2 * inertia_of(rng)
        free = structure.floating and k == 0
        bodies.append(stm.Body(f"b{k}", mass, inertia, position=where, orientation=p, free=free))
    name = lambda k: "ground" if k < 0 else f"b{k}"
    for number, link in enumerate(structure.links):
        axis = unit(rng.normal(size=3))
        across = unit(np.cross(axis, rng.normal(size=3)))
        at = {
            "p": metre * (R @ rng.normal(size=3) + shift),
            "q": metre * (R @ rng.normal(size=3) + shift),
            "axis": R @ axis, "across": R @ across, "metre": np.asarray(metre),
        }  # fmt: skip
        joints.append(joint(f"j{number}", link.kind, (name(link.i), name(link.j)), at, backwards))
    forces = [
        stm.Gravity(metre * (R @ rng.normal(size=3)) * 9.81),
        stm.AppliedForce("b0", kilogram * metre * (R @ rng.normal(size=3)), frame="world"),
    ]
    velocity = rng.normal(size=(structure.bodies, 6))
    velocity[:, :3] = metre * (velocity[:, :3] @ R.T)
    if backwards:
        bodies, joints, velocity = bodies[::-1], joints[::-1], velocity[::-1]
    return stm.System(bodies, joints, forces), jnp.asarray(velocity)


class Found(NamedTuple):
    """Velocities and accelerations by both formulations, and their smallest singular values.

    Both are relative to the largest one of all rows in the velocities of the bodies: `ratio` is the
    smallest of the same rows, `closing` that of the closures of the loops in the velocities of the
    tree; it is one if there are no loops.
    """

    v: Any
    omega: Any
    tree: Any
    augmented: Any
    ratio: Any
    closing: Any


@eqx.filter_jit
def looked(system: stm.System, velocity: Any, both: bool = True) -> Found:
    """Everything at the reference posture, with the velocity nearest to the given one."""
    model = stm.Augmented().prepare(system)
    rest = system.reference
    J = model.constraints.equations(jnp.zeros(()), system.kinematics(rest)).matrix
    u = velocity.reshape(-1)
    left, sizes, right = jnp.linalg.svd(J, full_matrices=False)
    u = u - right.T @ ((left.T @ (J @ u)) / sizes)
    v, omega = jnp.split(u.reshape(velocity.shape), 2, axis=1)
    state = stm.State(rest.r, rest.p, v, omega)

    def rates(formulation: Any) -> Any:
        found = stm.dynamics.evaluate(system, state, formulation=formulation).accelerations
        return found.v_rate, found.omega_rate

    one = rates(stm.Tree())
    other = rates(stm.Augmented()) if both else one
    closing = (
        closing_value(system, rest) / sizes[0]
        if both and stm.dynamics.spanning_tree(system).cut
        else 1.0
    )
    return Found(v, omega, one, other, sizes[-1] / sizes[0], closing)


def closing_value(system: stm.System, rest: stm.State) -> jax.Array:
    """Smallest singular value of the loops' closures in the velocities of the tree."""
    model = stm.Tree().prepare(system)
    at = read_coordinates(model.parameters, rest)
    J = rows_after(model, jnp.zeros(()), at, jnp.zeros_like(at.u))
    return jnp.linalg.svd(J, compute_uv=False)[-1]


def apart(one: Any, other: Any) -> float:
    """Largest difference of two sets of accelerations, relative to the largest acceleration."""
    size = max(float(np.max(np.abs(x))) for x in one)
    pairs = zip(one, other, strict=True)
    return max(float(np.max(np.abs(np.asarray(a) - np.asarray(b)))) for a, b in pairs) / size


def power_missing(system: stm.System, found: Found) -> float:
    """Rate of the kinetic energy less the power of gravity and force, relative to their size."""
    v, omega, (v_rate, omega_rate) = np.asarray(found.v), np.asarray(found.omega), found.tree
    mass, inertia = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)
    gained = mass[:, None] * v * np.asarray(v_rate)
    turned = omega * np.einsum("nij,nj->ni", inertia, np.asarray(omega_rate))
    gravity, push = system.forces
    assert isinstance(gravity, stm.Gravity)
    assert isinstance(push, stm.AppliedForce)
    given = mass[:, None] * v * np.asarray(gravity.acceleration)
    first = system.names.index("b0")
    force = v[first] @ np.asarray(push.force)
    sizes = np.sum(np.abs(gained)) + np.sum(np.abs(turned)) + np.sum(np.abs(given)) + abs(force)
    return abs(np.sum(gained) + np.sum(turned) - np.sum(given) - force) / sizes


@pytest.mark.slow
@settings(
    max_examples=6, derandomize=True, deadline=None, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large], phases=[Phase.generate],
)  # fmt: skip
@given(structures())
def test_laws_of_random_mechanisms(structure: Structure):
    """Both formulations agree, constraint forces do no work, and neither frame nor order matters."""
    singular = 0
    for seed in range(SETS):
        system, velocity = built(structure, seed)
        found = looked(system, velocity)
        if found.ratio < SINGULAR:
            assert found.closing < FACTOR * SINGULAR
            singular += 1
            continue
        assert found.closing > SINGULAR / FACTOR
        # multipliers follow from a matrix whose condition is the square of that of the rows
        same = SAME + ROUND_OFF / float(found.ratio) ** 2
        assert apart(found.tree, found.augmented) < same
        assert power_missing(system, found) < same
        # conservative but for given forces: on the way back the accelerations are the same
        there = looked(system, -velocity)
        assert apart(found.tree, there.tree) < same
        turn, shift = random_quaternion(np.random.default_rng(seed)), np.array([3.0, -2.0, 1.0])
        R = np_rotation(turn)
        moved = looked(*built(structure, seed, turn=turn, shift=shift))
        assert apart((np.asarray(found.tree[0]) @ R.T, found.tree[1]), moved.tree) < same
        if seed < SETS // 5:
            # in millimetres and grams, where another velocity would be the nearest to the random one
            speed = jnp.concatenate([1e3 * found.v, found.omega], axis=1)
            small = looked(built(structure, seed, units=(1e3, 1e3))[0], speed)
            assert apart((1e3 * np.asarray(found.tree[0]), found.tree[1]), small.tree) < same
            other = looked(*built(structure, seed, backwards=True), both=False)
            back = jax.tree.map(lambda x: np.asarray(x)[::-1], other.tree)
            assert apart(found.tree, back) < same
    assert singular <= FEW * SETS


def direction(link: Link, at: dict[str, np.ndarray], q: np.ndarray) -> np.ndarray:
    """Velocity of a point on the last body per velocity of a joint with one freedom."""
    turned = np.cross(at["axis"], q - at["p"])
    return {"revolute": turned, "translational": at["axis"],
            "screw": turned + 0.1 * at["axis"]}[link.kind]  # fmt: skip


def rod_across(first: str, second: str, seed: int) -> tuple[stm.System, float]:
    """Two bodies on joints of one freedom each, and a rod to ground that neither joint can lengthen.

    The number is the determinant of the rod's second derivatives by both joints: below zero two
    branches of the motion meet, above it none leads away.
    """
    rng = np.random.default_rng(seed)
    links = [Link(first, -1, 0), Link(second, 0, 1)]
    ats = [{"p": rng.normal(size=3), "axis": unit(rng.normal(size=3))} for _ in links]
    ats = [{**at, "metre": np.asarray(1.0)} for at in ats]
    q = rng.normal(size=3)
    d0, d1 = (direction(link, at, q) for link, at in zip(links, ats, strict=True))
    w0, w1 = (
        at["axis"] * (link.kind != "translational") for link, at in zip(links, ats, strict=True)
    )
    across, length = unit(np.cross(d0, d1)), 0.5 + rng.random()
    bent = lambda w, d, other: other @ d / length - across @ np.cross(w, d)
    curved = bent(w0, d0, d0) * bent(w1, d1, d1) - bent(w0, d1, d0) ** 2
    joints = [
        joint(name, link.kind, ends, at, swap=False)
        for name, link, ends, at in zip(
            ("j0", "j1"), links, (("ground", "b0"), ("b0", "b1")), ats, strict=True
        )
    ]
    rod = stm.distance("rod", "ground", "b1", point_i=q + length * across, point_j=q)
    bodies = [
        stm.Body(name, 0.5 + rng.random(), inertia_of(rng), position=rng.normal(size=3))
        for name in ("b0", "b1")
    ]
    gravity = stm.Gravity(9.81 * unit(rng.normal(size=3)))
    return stm.System(bodies, [*joints, rod], [gravity]), float(curved)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second"), [("revolute", "screw"), ("translational", "revolute")]
)
def test_both_formulations_report_the_same_singular_posture(first: str, second: str):
    """A rod across all that its end can do: two freedoms are left instead of one."""
    branches = []
    for seed in range(SETS // 5):
        system, curved = rod_across(first, second, seed)
        branches.append(curved < 0)
        rank = stm.dynamics.rank(system, system.reference)
        assert (rank.rows - rank.rank, rank.dof) == (1, 2)
        # by relative coordinates; the numbers are those of independent velocities
        words = r"loops closed by rod leave 2 independent velocities there, but 1"
        with pytest.raises(stm.ModelError, match=words):
            stm.TreeSpace(system)
        for how in (stm.Tree(), stm.Augmented()):
            with pytest.raises(stm.StateError, match=r"^The start is a singular posture of .*rod"):
                inspect_start(system, system.reference, 0.0, how)
    assert any(branches)


def momentum_missing(system: stm.System, found: Found) -> float:
    """Rates of both momenta about the origin less forces and moments, relative to their size."""
    mass, inertia = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)
    place, omega = np.asarray(system.reference.r), np.asarray(found.omega)
    v_rate, omega_rate = (np.asarray(a) for a in found.tree)
    gravity, push = system.forces
    assert isinstance(gravity, stm.Gravity)
    assert isinstance(push, stm.AppliedForce)
    given = mass[:, None] * np.asarray(gravity.acceleration)
    given[system.names.index("b0")] += np.asarray(push.force)
    spin = np.einsum("nij,nj->ni", inertia, omega)
    own = np.einsum("nij,nj->ni", inertia, omega_rate) + np.cross(omega, spin)
    turned = np.array([np_rotation(p) @ h for p, h in zip(system.reference.p, own, strict=True)])
    moved = mass[:, None] * v_rate
    linear = moved - given
    angular = np.cross(place, linear) + turned
    sizes = np.abs(moved).sum() + np.abs(np.cross(place, moved)).sum() + np.abs(turned).sum()
    return float(max(np.abs(linear.sum(axis=0)).max(), np.abs(angular.sum(axis=0)).max()) / sizes)


def weighed(system: stm.System, state: stm.State, q: Any) -> Any:
    """Weighted sum of accelerations with the first mass, the inertias and gravity scaled by 1 + q."""
    of = lambda s: (s.bodies.mass, s.bodies.inertia, s.forces[0].acceleration)
    mass, inertia, gravity = of(system)
    changed = (mass.at[0].multiply(1 + q[0]), inertia * (1 + q[1]), gravity * (1 + q[2]))
    system = eqx.tree_at(of, system, changed)
    found = stm.dynamics.evaluate(system, state, formulation=stm.Tree()).accelerations
    return jnp.sum(jnp.sin(found.v_rate)) + 0.1 * jnp.sum(found.omega_rate)


@eqx.filter_jit
def derived(system: stm.System, state: stm.State, q: Any, step: float) -> tuple[Any, ...]:
    """Derivatives by forward mode, by reverse mode of all q together and one by one, by differences."""
    f = lambda one: weighed(system, state, one)
    back = jax.grad(f)
    moves = step * jnp.eye(3)
    # fourth order
    values = jax.vmap(jax.vmap(f))(
        q[0] + jnp.array([-2.0, -1.0, 1.0, 2.0])[:, None, None] * moves[None]
    )
    slopes = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * step)
    return jax.jacfwd(f)(q[0]), jax.vmap(back)(q), jax.lax.map(back, q), slopes


@pytest.mark.slow
@settings(
    max_examples=2, derandomize=True, deadline=None, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large], phases=[Phase.generate],
)  # fmt: skip
@given(floating_trees())
def test_laws_of_random_floating_trees(structure: Structure):
    """Momentum; forward = reverse = differences of the accelerations; vmap of grad = loop of grads."""
    for seed in range(SETS // 5):
        system, velocity = built(structure, seed)
        found = looked(system, velocity, both=False)
        same = SAME + ROUND_OFF / float(found.ratio) ** 2
        assert momentum_missing(system, found) < same
        rest = system.reference
        state = stm.State(rest.r, rest.p, found.v, found.omega)
        q = jnp.asarray(0.1 * np.random.default_rng(seed).normal(size=(3, 3)))
        forward, together, alone, slopes = map(np.asarray, derived(system, state, q, 1e-3))
        size = np.max(np.abs(together))
        np.testing.assert_allclose(together[0], forward, rtol=0, atol=same * size)
        np.testing.assert_allclose(together, alone, rtol=0, atol=same * size)
        # differences of fourth order: of a sine of some tens, to 1e-6
        np.testing.assert_allclose(slopes, forward, rtol=0, atol=1e-5 * size)
