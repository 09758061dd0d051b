"""Which rows count as dependent: the same for every unit, size and mass, and looked at again after a run."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import four_bar, turn
from scipy.spatial.transform import Rotation

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.base import count_left_out
from stmuav_jax.dynamics.formulations.independence import find_independent_rows

Z, X, Y = (0, 0, 1), (1, 0, 0), np.array([0.0, 1.0, 0.0])
R, L, PHI = 0.1, 0.3, 0.7


def slider_crank(
    length=1.0, time=1.0, masses=(0.1, 0.3, 0.5), inertia=1e-3, axial=1e-3, across=False
):
    """A planar slider-crank of hinges (20 rows of rank 17), scaled in length and time.

    Args:
        masses: of crank, rod and slider. inertia: of the slider, per mass. axial: that of the rods about
            their axes, per mass and squared length.
    """
    rod = np.arcsin(R * np.sin(PHI) / L)
    A = np.array([R * np.cos(PHI), R * np.sin(PHI), 0.0])
    x = R * np.cos(PHI) + L * np.cos(rod)
    end = np.array([x, 0.0, 0.0])

    def moments(mass, size):
        return mass * (size * length) ** 2 * np.array([axial, 1 / 12, 1 / 12])

    crank, coupler, slider = masses
    bodies = [
        stm.Body("crank", crank, moments(crank, R), position=length * A / 2, orientation=turn(Z, PHI)),
        stm.Body(
            "rod", coupler, moments(coupler, L), position=length * (A + end) / 2,
            orientation=turn(Z, -rod),
        ),
        stm.Body("slider", slider, [slider * inertia * length**2] * 3, position=length * end),
    ]  # fmt: skip
    joints = [
        stm.revolute("O", "ground", "crank", point=np.zeros(3), axis=Z),
        stm.revolute("A", "crank", "rod", point=length * A, axis=Z),
        stm.revolute("B", "rod", "slider", point=length * end, axis=Z),
        stm.translational("guide", "ground", "slider", axis=X),
    ]
    pull = np.array([0.0, -9.81, 0.0] if across else [3.0, -9.81, 0.0])
    return stm.System(bodies, joints, [stm.Gravity(pull * length / time**2)])


def scaled(scale, bodies, joints, pull, floating=()):
    """Mechanism with lengths, times and masses times those of `scale`.

    Args:
        bodies: name, mass, principal moments, centre of mass. joints: kind, bodies, point, axes.
        pull: acceleration of free fall. floating: names of bodies that move freely.
    """
    length, time, mass = scale
    of_joints = []
    for k, (kind, i, j, point, *axes) in enumerate(joints):
        names = ("axis_i", "axis_j") if len(axes) == 2 else ("axis",)
        where = {"point": length * np.asarray(point)} if kind is not stm.translational else {}
        named = dict(zip(names, axes, strict=False))
        of_joints.append(kind(f"J{k}", i, j, **where, **named))
    return stm.System(
        [
            stm.Body(name, mass * m, mass * length**2 * np.asarray(moments), free=name in floating,
                     position=length * np.asarray(position))
            for name, m, moments, position in bodies
        ],
        of_joints,
        [stm.Gravity(np.asarray(pull) * length / time**2)],
    )  # fmt: skip


def bennett(off=0.0, scale=(1.0, 1.0, 1.0)):
    """A Bennett linkage (20 rows of rank 17), one axis off by an angle [rad]: then it is a structure."""
    alpha, ratio = np.radians(40.0), 0.7
    beta = np.arcsin(ratio * np.sin(alpha))
    first = 0.9
    share = np.sin((alpha + beta) / 2) / np.sin((beta - alpha) / 2)
    second = 2 * np.arctan(share / np.tan(first / 2))

    def link(angle, length, twist):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
        rows = [[c, -s * ca, s * sa, length * c], [s, c * ca, -c * sa, length * s], [0, sa, ca, 0]]
        return np.array([*rows, [0, 0, 0, 1]])

    sides = [(1.0, alpha), (ratio, beta), (1.0, alpha), (ratio, beta)]
    frames = [np.eye(4)]
    for angle, side in zip((first, second, -first, -second), sides, strict=True):
        frames.append(frames[-1] @ link(angle, *side))
    assert np.max(np.abs(frames[-1] - np.eye(4))) < 1e-14
    axes = [frame[:3, 2] for frame in frames[:4]]
    points = [frame[:3, 3] for frame in frames[:4]]
    side = np.cross(axes[2], Z)
    axes[2] = axes[2] * np.cos(off) + side / np.linalg.norm(side) * np.sin(off)
    names = ["ground", "one", "two", "three", "ground"]
    bodies = [
        (names[k], 1.0, [0.02, 0.03, 0.04], (points[k - 1] + points[k]) / 2) for k in (1, 2, 3)
    ]
    joints = [(stm.revolute, names[k], names[k + 1], points[k], axes[k]) for k in range(4)]
    return scaled(scale, bodies, joints, [0.5, 1.0, -9.81])


FOUR = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.25], [0.6, 0.0, 0.45], [0.7, 0.0, 0.0]])
LINKS = ((0.8, [4e-3, 5e-3, 3e-3]), (1.5, [2e-2, 3e-2, 2e-2]), (1.1, [1e-2, 9e-3, 5e-3]))


def chain_of_four(points, axis, base="ground"):
    """Bodies and hinges of a crank, a coupler and a rocker on a base."""
    names = ("crank", "coupler", "rocker")
    bodies = [
        (name, *link, (points[k] + points[k + 1]) / 2)
        for k, (name, link) in enumerate(zip(names, LINKS, strict=True))
    ]
    ends = (
        (base, "crank", 0),
        (base, "rocker", 3),
        ("crank", "coupler", 1),
        ("coupler", "rocker", 2),
    )
    return bodies, [(stm.revolute, i, j, points[k], axis) for i, j, k in ends]


def oblique_four_bar(scale):
    """In a plane that is along no axis, pulled across it too."""
    R = Rotation.from_rotvec([0.4, 0.7, -0.3]).as_matrix()
    return scaled(scale, *chain_of_four(FOUR @ R.T, R @ Y), (1.0, 2.0, -9.81))


def floating_four_bar(scale):
    """Carried by a free body."""
    bodies, joints = chain_of_four(FOUR, Y, "base")
    bodies = [("base", 2.0, [0.1, 0.2, 0.15], (0.3, 0.1, -0.1)), *bodies]
    # it falls freely but for a spin, which is given below
    return scaled(scale, bodies, joints, (0, 0, -9.81), floating=("base",))


def parallelogram(scale):
    """Three parallel cranks, one more than the plane needs."""
    arm, y = 0.3 * np.array([np.sin(0.6), 0.0, np.cos(0.6)]), Y
    feet = [np.array([0.5 * k, 0.0, 0.0]) for k in range(3)]
    bodies = [(f"c{k}", 0.4, [1e-3] * 3, foot + arm / 2) for k, foot in enumerate(feet)]
    bodies.append(("bar", 1.2, [0.01, 0.05, 0.05], feet[1] + arm))
    joints = [(stm.revolute, "ground", f"c{k}", foot, y) for k, foot in enumerate(feet)]
    joints += [(stm.revolute, f"c{k}", "bar", foot + arm, y) for k, foot in enumerate(feet)]
    return scaled(scale, bodies, joints, (0, 0, -9.81))


def spatial_slider(scale):
    """Crank, rod with a ball and a universal joint, and a slider on a rail across the crank's plane."""
    a, b, c = np.array([[0, 0, 0], [0.0, 0.06, 0.08], [0.35, 0.1, 0.05]], float)
    bodies = [
        ("crank", *LINKS[0], (a + b) / 2), ("rod", *LINKS[1], (b + c) / 2), ("slider", *LINKS[2], c)
    ]  # fmt: skip
    joints = [
        (stm.revolute, "ground", "crank", a, (1, 0, 0)), (stm.spherical, "crank", "rod", b),
        (stm.universal, "rod", "slider", c, np.cross(c - b, Y), Y),
        (stm.translational, "ground", "slider", c, (1, 0, 0.2)),
    ]  # fmt: skip
    return scaled(scale, bodies, joints, (0.5, 0, -9.81))


def sarrus(scale):
    """Two chains of three hinges each, with crossed axes: the top moves along a line."""
    rise = 0.8 * np.sin(0.8) * np.array([0.0, 0.0, 1.0])
    bodies, joints = [("top", 1.0, [0.02] * 3, rise)], []
    for name, out, axis in (("x", np.array([1.0, 0, 0]), Y), ("y", Y, np.array([1.0, 0, 0]))):
        low = 0.3 * out
        knee = low + 0.4 * (out * np.cos(0.8) + np.sin(0.8) * np.array([0.0, 0.0, 1.0]))
        points = (low, knee, low + rise)
        bodies += [
            (f"{name}{k + 1}", 0.5, [0.01] * 3, (points[k] + points[k + 1]) / 2) for k in (0, 1)
        ]
        ends = ("ground", f"{name}1", f"{name}2", "top")
        joints += [(stm.revolute, ends[k], ends[k + 1], points[k], axis) for k in range(3)]
    return scaled(scale, bodies, joints, (0, 0, -9.81))


MECHANISMS = {
    "slider crank": lambda scale: slider_crank(*scale[:2], masses=np.multiply((0.1, 0.3, 0.5), scale[2])),
    "oblique four-bar": oblique_four_bar,
    "floating four-bar": floating_four_bar,
    "parallelogram": parallelogram,
    "Bennett": lambda scale: bennett(scale=scale),
    "Sarrus": sarrus,
    "spatial slider": spatial_slider,
}  # fmt: skip
# Length, time and mass: each alone, and together.
SCALES = [
    (1e-9, 1.0, 1.0), (1e9, 1.0, 1.0), (1.0, 1e-9, 1.0), (1.0, 1e9, 1.0), (1.0, 1.0, 1e-9), (1.0, 1.0, 1e9),
    (1e-9, 1e-9, 1e9), (1e9, 1e9, 1e-9), (1e-3, 1.0, 1.0), (1e-6, 1e-3, 1e-6),
]  # fmt: skip


# A run of these times by these numbers is one program for all scales of a mechanism.
TS = np.array([0.0, 0.15, 0.3])
BARE: Any = {"error_estimate": False, "analysis": False}
FORMULATIONS = {"tree": stm.Tree(), "augmented": stm.Augmented()}


def method(formulation):
    return stm.Method(formulation=FORMULATIONS[formulation], rtol=1e-9, atol=1e-9, max_steps=1000)


@pytest.mark.slow
@pytest.mark.parametrize("name", MECHANISMS)
def test_units_and_sizes_do_not_matter(name):
    """The same motion relative to size and time to 1e-7, or a run that says that it failed.

    `Augmented` holds coordinates that are zero. Where a unit of velocity is 1e9 times too large, their
    round-off exceeds the absolute tolerance, and the steps that are allowed do not suffice.
    """

    def start(scale):
        system, time = MECHANISMS[name](scale), scale[1]
        state = system.reference
        if name == "floating four-bar":
            # turning as one body, about the base's centre of mass
            omega = np.array([0.3, 1.0, -0.5]) / time
            arms = np.asarray(state.r - state.r[0])
            state = stm.State(state.r, state.p, jnp.asarray(np.cross(omega, arms)),
                              jnp.tile(omega, (system.n_bodies, 1)))  # fmt: skip
        return system, state

    def move(scale, system, state, formulation):
        run = stm.simulate(
            system, state, ts=TS * scale[1], method=method(formulation), throw=False, **BARE
        )
        return run, np.asarray(run.states.r)[-1] / scale[0], run.states.p[-1]

    one = (1.0, 1.0, 1.0)
    system, state = start(one)
    rank = stm.dynamics.rank(system, state)[:3]
    runs = {how: move(one, system, state, how) for how in FORMULATIONS}
    for run, r, _ in runs.values():
        assert run.successful
        assert np.max(np.abs(r - run.states.r[0])) > 0.01
    failed = {how: set() for how in FORMULATIONS}
    for scale in SCALES:
        system, state = start(scale)
        assert stm.dynamics.rank(system, state)[:3] == rank, scale
        for how, (_, r, p) in runs.items():
            run, scaled_r, scaled_p = move(scale, system, state, how)
            if not run.successful:
                assert run.failure
                failed[how].add(scale)
                continue
            # a free fall of metres counts as its size
            np.testing.assert_allclose(scaled_r, r, rtol=0, atol=1e-7, err_msg=str(scale))
            np.testing.assert_allclose(scaled_p, p, rtol=0, atol=1e-7, err_msg=str(scale))
    assert failed["tree"] <= {(1e9, 1e9, 1e-9)}
    assert {(1.0, 1.0, 1e-9), (1.0, 1.0, 1e9), (1e-3, 1.0, 1.0)}.isdisjoint(failed["augmented"])


def test_rows_left_out_are_the_same_number_for_any_formulation():
    """Three of the twenty rows of a planar loop of hinges, and of a Bennett linkage; none of others."""
    system = four_bar()
    tree, rows = (how().prepare(system) for how in (stm.Tree, stm.Augmented))
    assert (count_left_out(tree), count_left_out(rows)) == (3, 3)
    assert stm.Tree().prepare(four_bar(redundant=False)).row_mask is None
    assert count_left_out(stm.Augmented().prepare(bennett())) == 3


@pytest.mark.slow
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_heavy_slider_stays_on_its_guide(formulation):
    """Gravity pulls across the guide, rods of 1 g: round-off of 0.4 m, where free fall is 0.4 m."""
    system = slider_crank(masses=(1e-3, 1e-3, 1e3), axial=1e-4, across=True)
    run = stm.simulate(system, system.reference, ts=TS, method=method(formulation), **BARE)
    assert run.successful
    assert np.max(np.abs(run.body("slider").r[:, 1])) < 1e-12
    assert run.certificate.position_violation < 1e-12


@pytest.mark.slow
def test_a_run_whose_joints_come_open_is_not_successful(monkeypatch):
    """A row that is left out and ought not to be: `simulate` and `integrate` say so."""
    from stmuav_jax.dynamics.formulations import augmented

    system = slider_crank(across=True)
    true = find_independent_rows(system)
    owner = np.array(augmented.prepare_rows(system).constraints.owner)
    false = true.rows & (owner != 3)
    monkeypatch.setattr(augmented, "find_independent_rows", lambda _: true._replace(rows=false))
    method = stm.Method(formulation=stm.Augmented(), adjoint=diffrax.ForwardMode())
    with pytest.raises(stm.SimulationError, match="joint 'guide' has come open") as error:
        stm.simulate(system, system.reference, ts=[0.0, 0.1], method=method, **BARE)
    run: Any = error.value.run
    assert not run.successful
    assert run.certificate.result == "constraints violated"
    along = jax.jit(lambda ts: stm.integrate(system, system.reference, ts, method))
    found = along(jnp.array([0.0, 0.1]))
    assert found.result == diffrax.RESULTS.nonlinear_divergence
    assert np.all(np.isfinite(found.states.r[0]))
    assert np.all(np.isnan(found.states.r[1]))


@pytest.mark.slow
def test_a_linkage_is_movable_or_a_structure_by_one_threshold():
    """What is neither, but for rounded numbers, is refused by name before the first step."""
    for off, dof in ((0.0, 1), (1e-10, 1), (1e-7, 0), (1e-6, 0), (1e-2, 0)):
        system = bennett(off)
        assert stm.dynamics.rank(system, system.reference).dof == dof
        if off not in (1e-7, 1e-6):
            continue
        with pytest.raises(stm.ModelError, match=r"nearly overconstrained.*joints J\d"):
            stm.simulate(system, system.reference, ts=[0.0, 0.1])


def test_units_do_not_decide_which_start_is_consistent():
    """A rod that is 2 % off its pins is refused in a mechanism of a micrometre too."""
    for length in (1e-6, 1.0, 1e6):
        system = slider_crank(length)
        moved = system.reference.r.at[1, 0].add(0.02 * R * length)
        state = stm.State(moved, *(getattr(system.reference, k) for k in ("p", "v", "omega")))
        with pytest.raises(stm.StateError, match=r"positions do not fit the joints: joint '[AB]'"):
            stm.simulate(system, state, ts=[0.0, 0.1])
