"""Bad inputs and numerical faults that no other test covers; docs/validation.md lists them all.

Each fault is refused by name, or ends as data that says what it is; nothing near it is spoilt.
"""

import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers import GRAVITY, np_rotation, pendulum, state_of, swung, unit

import stmuav_jax as stm
from stmuav_jax.cli.identify import read_record
from stmuav_jax.dynamics.choices import solver_named
from stmuav_jax.figures.day import load_attitude

LENGTH, MASS, INERTIA = 0.5, 2.0, 0.02
SYSTEM = pendulum()
TS = jnp.array([0.0, 0.7, 1.5])
AHEAD = stm.Method(adjoint=diffrax.ForwardMode())


@cache
def moved() -> Any:
    """Motion of the pendulum from a state, one compiled program."""
    return jax.jit(lambda state: stm.integrate(SYSTEM, state, TS, AHEAD))


def turned(p: Any) -> np.ndarray:
    """Rotation matrices of the pendulum at the saved times."""
    return np.array([np_rotation(q) for q in np.asarray(p)[:, 0]])


@pytest.mark.slow
def test_p_and_minus_p_are_one_rotation():
    start = swung(SYSTEM, 1.2, 2.0)
    other = stm.State(start.r, -start.p, start.v, start.omega)
    one, two = moved()(start).states, moved()(other).states
    for name in ("r", "v", "omega"):
        np.testing.assert_allclose(getattr(two, name), getattr(one, name), rtol=0, atol=1e-12)
    np.testing.assert_allclose(turned(two.p), turned(one.p), rtol=0, atol=1e-12)


@pytest.mark.parametrize("share", [1.01, 0.5, 0.0, np.nan])
def test_p_of_another_norm_is_refused_by_the_body(share):
    """Never normalised: scaled by its user it is the same motion, and a zero has no direction."""
    start = swung(SYSTEM, 1.2, 2.0)
    odd = stm.State(start.r, share * start.p, start.v, start.omega)
    with pytest.raises(stm.StateError, match="body 'bob' in the initial state"):
        stm.simulate(SYSTEM, odd, t1=0.1)
    with pytest.raises(stm.ModelError, match="'bob'"):
        stm.Body("bob", 1.0, (1.0, 1.0, 1.0), orientation=share * np.array([1.0, 0, 0, 0]))


@pytest.mark.parametrize("pitch", [-np.pi / 2, 0.3, np.pi / 2])
def test_nothing_happens_at_a_pitch_of_ninety_degrees(pitch):
    """Roll, pitch and yaw are singular there, Euler parameters are not: energy as elsewhere.

    Released at that pitch, and at full speed through it; J = I + m L^2 about the hinge.
    """
    inertia = INERTIA + MASS * LENGTH**2
    for rate in (0.0, 3.0):
        path = moved()(swung(SYSTEM, pitch, rate)).states
        height, omega = np.asarray(path.r)[:, 0, 2], np.asarray(path.omega)[:, 0, 1]
        energy = MASS * GRAVITY * height + inertia * omega**2 / 2
        assert np.all(np.isfinite(np.asarray(path.p)))
        np.testing.assert_allclose(energy, energy[0], rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [-np.pi / 2, np.pi / 2])
def test_rotations_at_a_pitch_of_ninety_degrees(pitch):
    """Rotation matrix -> Euler parameters -> rotation matrix, to round-off, and its derivative."""
    R = np.asarray(stm.uav.attitude(0.4, pitch, -1.1))
    back = lambda R: stm.rotation.rotation_matrix(stm.rotation.from_matrix(R))
    np.testing.assert_allclose(back(jnp.asarray(R)), R, rtol=0, atol=1e-14)
    vector = stm.rotation.to_rotation_vector(stm.rotation.from_matrix(jnp.asarray(R)))
    assert np.all(np.isfinite(np.asarray(vector)))
    assert np.all(np.isfinite(np.asarray(jax.jacfwd(back)(jnp.asarray(R)))))


def height(push: Any, adjoint: Any) -> tuple[Any, Any]:
    """Height and speed at the end under a constant force, summed, and the outcome."""
    force = jnp.stack([push, jnp.zeros(()), jnp.zeros(())])
    system = pendulum(forces=(stm.AppliedForce("bob", force, frame="world"),))
    path = stm.integrate(system, swung(SYSTEM, 0.5), TS, stm.Method(adjoint=adjoint))
    good = path.result == diffrax.RESULTS.successful
    return path.states.r[-1, 0, 2] + 0.1 * path.states.v[-1, 0, 0], (good, path.states.r)


@pytest.mark.slow
def test_a_bad_lane_leaves_the_others_alone():
    """Numbers, steps and derivatives of clean lanes are those without the bad ones, which are told."""
    adjoint = stm.dynamics.DiscreteAdjoint()
    lanes = jax.jit(jax.vmap(jax.value_and_grad(lambda u: height(u, adjoint), has_aux=True)))
    (values, (good, places)), slopes = lanes(jnp.array([1.0, np.nan, -2.0, np.inf]))
    (clean, (fine, expected)), gradients = lanes(jnp.array([1.0, 0.5, -2.0, 0.5]))
    assert np.asarray(fine).all()
    assert np.asarray(good).tolist() == [True, False, True, False]
    for found, wanted in ((values, clean), (slopes, gradients), (places, expected)):
        found, wanted = np.asarray(found)[[0, 2]], np.asarray(wanted)[[0, 2]]
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
    assert not np.any(np.isfinite(np.asarray(values)[[1, 3]]))
    # the gradient is that of differences, to the tolerance of the values, 1e-8, over the step
    step = 1e-2
    (beside, _), _ = lanes(jnp.array([1.0 + step, np.nan, 1.0 - step, np.inf]))
    slope = (float(beside[0]) - float(beside[2])) / (2 * step)
    assert float(slopes[0]) == pytest.approx(slope, rel=0, abs=1e-6)


def runaway() -> tuple[stm.System, stm.State]:
    """A slide whose motion is x = tan(t), by a force 2 m x x': it has gone to infinity at pi / 2.

    The stages of an implicit step from x have no solution if the step is longer than about
    1 / (4 gamma x), whatever the iteration.
    """
    push = lambda t, kin: jnp.stack([2 * kin.r[0, 0] * kin.v[0, 0], 0.0 * t, 0.0 * t])
    body = stm.Body("bob", 1.0, (1.0, 1.0, 1.0))
    rail = stm.translational("rail", "ground", "bob", point=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))
    system = stm.System([body], [rail], [stm.AppliedForce("bob", push, frame="world")])
    return system, state_of([[0.0, 0.0, 0.0]], [[1.0, 0, 0, 0]], [[1.0, 0, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["kvaerno5", "dopri8"])
def test_steps_for_which_newton_fails_are_taken_again(solver):
    """A first step of 1 s that has no solution near the end; then the end itself, which is none."""
    system, start = runaway()
    method = stm.Method(
        solver=solver_named(solver), first_step=1.0, rtol=1e-6, atol=1e-6,
        adjoint=diffrax.ForwardMode(), max_steps=3000,
    )  # fmt: skip
    run = jax.jit(lambda ts: stm.integrate(system, start, ts, method))
    reached = run(jnp.array([0.0, 0.5, 1.5]))
    assert reached.result == diffrax.RESULTS.successful
    at = np.asarray(reached.states.r)[:, 0, 0]
    # x grows by 200 times from an error at the start to one at the end
    np.testing.assert_allclose(at, np.tan([0.0, 0.5, 1.5]), rtol=1e-3)
    lost = run(jnp.array([0.0, 0.5, 2.0]))
    assert lost.result != diffrax.RESULTS.successful
    assert not np.any(np.isfinite(np.asarray(lost.states.r)[-1]))
    assert int(np.asarray(lost.counts.accepted)[-1]) <= 6000
    with pytest.raises(stm.SimulationError, match=r"t = 1\.5\d* s") as error:
        stm.simulate(system, start, t1=2.0, save_every=0.5, method=method, analysis=False)
    kept: Any = error.value.run
    # 1e-3 of x at 1.5 s is 7e-5 s of time, by which the end may be another
    assert 1.5 < kept.certificate.t_end <= np.pi / 2 + 7e-5
    assert np.all(np.isfinite(np.asarray(kept.states.r)))


@pytest.mark.slow
@pytest.mark.parametrize("native", [True, False])
def test_accuracy_of_each_precision(native, machine_code):
    """First swing of a pendulum: 1e-8 m in double precision, 1e-6 m in single precision.

    docs/conventions.md has these figures: at the default tolerances of 1e-8 and of 1e-5.
    """
    machine_code(native)
    exact = {t: float(mp_angle(t, GRAVITY, LENGTH)) for t in (0.7, 1.5)}
    errors = {}
    for name, tolerance in (("double", 1e-8), ("single", 1e-5)):
        with jax.enable_x64(name == "double"):
            body = stm.Body("bob", MASS, (INERTIA, INERTIA, 0.01), position=(0.0, 0.0, -LENGTH))
            hinge = stm.revolute("hinge", "ground", "bob", point=(0.0, 0.0, 0.0), axis=(0, 1, 0))
            system = stm.System([body], [hinge], [stm.Gravity()], allow_float32=name == "single")
            start = stm.state_from_joints(system, {"hinge": 1.2})
            method = stm.Method(rtol=tolerance, atol=tolerance, adjoint=diffrax.ForwardMode())
            path = jax.jit(lambda s, m=method, of=system: stm.integrate(of, s, jnp.asarray(TS), m))(
                start
            )
            assert path.states.r.dtype == (jnp.float64 if name == "double" else jnp.float32)
            found = np.asarray(path.states.r, dtype=float)[1:, 0]
        wanted = [(-LENGTH * np.sin(a), -LENGTH * np.cos(a)) for a in exact.values()]
        errors[name] = np.max(np.abs(found[:, [0, 2]] - wanted))
    assert errors["double"] < 1e-8
    assert 1e-9 < errors["single"] < 1e-6


def mp_angle(t: Any, gravity: Any, length: Any, first: float = 1.2) -> Any:
    """Angle [rad] at t [s] after release at `first`, by Jacobi's elliptic functions (mpmath)."""
    inertia = INERTIA + MASS * mpmath.mpf(length) ** 2
    rate = mpmath.sqrt(MASS * gravity * length / inertia)
    k = mpmath.sin(mpmath.mpf(first) / 2)
    return 2 * mpmath.asin(k * mpmath.ellipfun("cd", rate * t, m=k**2))


@pytest.mark.slow
def test_second_derivatives_are_the_closed_forms():
    """d2 theta / d(g, L)2 at 0.7 and 1.5 s, forward over forward and forward over reverse."""
    with mpmath.workdps(30):
        of = lambda t: lambda g, L: mp_angle(t, g, L)
        exact = [
            [[mpmath.diff(of(t), (GRAVITY, LENGTH), order) for order in row] for row in
             (((2, 0), (1, 1)), ((1, 1), (0, 2)))] for t in (0.7, 1.5)
        ]  # fmt: skip

    def angles(q: Any, adjoint: Any) -> Any:
        system = pendulum(gravity=q[0], length=q[1])
        start = swung(system, 1.2, 0.0, q[1])
        method = stm.Method(rtol=1e-11, atol=1e-11, adjoint=adjoint)
        r = stm.integrate(system, start, TS, method).states.r[1:, 0]
        return jnp.arctan2(-r[:, 0], -r[:, 2])

    q, kept = jnp.array([GRAVITY, LENGTH]), stm.dynamics.DiscreteAdjoint()
    ahead = jax.jit(jax.jacfwd(jax.jacfwd(lambda q: angles(q, diffrax.ForwardMode()))))(q)
    np.testing.assert_allclose(ahead, np.array(exact, dtype=float), rtol=1e-6, atol=1e-7)
    back = jax.jit(jax.jacfwd(jax.grad(lambda q: angles(q, kept)[1])))(q)
    np.testing.assert_allclose(back, np.array(exact[1], dtype=float), rtol=1e-6, atol=1e-7)


def test_zero_vectors_have_no_direction():
    """An axis of zero length is refused by name; one of another length is the unit vector's."""
    with pytest.raises(stm.ModelError, match="'hinge'"):
        stm.revolute("hinge", "ground", "bob", point=(0, 0, 0), axis=(0.0, 0.0, 0.0))
    axis = np.array([1.0, 2.0, -0.5])
    one, same = (
        stm.System(
            [stm.Body("bob", 1.0, (1.0, 1.0, 1.0), position=(0.0, 0.0, -1.0))],
            [stm.revolute("hinge", "ground", "bob", point=(0, 0, 0), axis=a)],
            [stm.Gravity()],
        )
        for a in (axis, unit(axis))
    )
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,a,a\n0,1,2\n1,1,2\n", "has 2 columns 'a'"),
        ("t,a\n0,1\n0.5,1\n0.2,1\n", r"must increase, but ts\[2\] = 0.2 s follows ts\[1\] = 0.5 s"),
        ("t,a\n0,1\n,1\n", "line 3: '' in column 't' is not a finite number"),
        ("t,a\n0,1\n0.5,inf\n", "line 3: 'inf' in column 'a' is not a finite number"),
        ("t,a,u\n0,1,1\n1,1,\n", "line 3: '' in column 'u' is not a finite number"),
        ("t [ms],a\n0,1\n500,1\n", r"no column 't'"),
        ("t,a,u\n0,1,1\n1,1,1\n", "spline of degree 3 needs at least 4 times"),
    ],
)
def test_records_that_say_two_things_are_refused(text, words, tmp_path):
    """Records for `stmuav identify`, with the input u as a column."""
    (tmp_path / "record.csv").write_text(text)
    inputs: Any = SimpleNamespace(names=[("u", "N")])
    with pytest.raises((stm.SettingError, stm.ModelError, stm.io.FileError), match=words):
        read_record(tmp_path / "record.csv", ["a"], inputs)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("0,1,2,3,5,1,2,3\n", "line 2: 8 cells, but the header has 4"),
        ("0,1,2,3\n0,1,2,3\n", "times that increase"),
        ("0,1,2,inf\n", "line 2: 'inf' in column 'yaw' is not a finite number"),
        ("0,1,2,1e300\n", "angles beyond 1e.09 degrees"),
    ],
)
def test_attitudes_that_are_no_rows_of_four_are_refused(rows, words, tmp_path):
    """Also where all numbers would fill rows of four: a line of eight."""
    (tmp_path / "attitude.csv").write_text("t,roll,pitch,yaw\n" + rows)
    with pytest.raises(stm.io.FileError, match=words):
        load_attitude(tmp_path / "attitude.csv")


def test_times_of_a_record_must_increase():
    with pytest.raises(stm.SettingError, match="times of the record must increase"):
        stm.analysis.motion_model(lambda q: SYSTEM, lambda space: None, [0.0, 1.0, 0.5], [])  # pyright: ignore


def test_the_page_names_tests_that_exist():
    """docs/validation.md: 24 faults, each with tests among the evidence."""
    root = Path(__file__).parents[2]
    page = (
        (root / "docs" / "validation.md").read_text().partition("\n## Faults and bad inputs\n")[2]
    )
    faults, _, evidence = page.partition("\n## Evidence\n")
    names = re.findall(r"^\| (?!fault|---)([^|]+) \|", faults, re.M)
    assert len(names) == 24
    for name in names:
        (row,) = re.findall(rf"^\| {re.escape(name)} \| (.*) \|$", evidence, re.M)
        named = re.findall(r"`([\w/]+\.py)::(\w+)`", row)
        assert named, row
        for path, name in named:
            assert f"def {name}(" in (root / "tests" / path).read_text(), (path, name)
