"""Springs, servos and end stops on hinges that turn many times: closed forms, everywhere.

A disc of inertia INERTIA about z on a hinge; the tolerance 1e-9 rad of an amplitude A is 10 times the
solver's relative tolerance, 1e-13 A sqrt(steps), rounded up.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import evaluated

import stmuav_jax as stm
from stmuav_jax.analysis.multiple_shooting import integrate_points
from stmuav_jax.analysis.sensors import moved_over
from stmuav_jax.mechanics import EndStop, JointServo, with_start_angles

INERTIA = 0.2
STIFFNESS = 5.0
RATE = np.sqrt(STIFFNESS / INERTIA)


def disc(*forces: Any) -> stm.System:
    """Disc on a hinge."""
    return stm.System(
        [stm.Body("disc", 1.0, [0.3, 0.3, INERTIA])],
        [stm.revolute("hinge", "ground", "disc", point=[0, 0, 0], axis=[0, 0, 1])],
        forces,
    )


def spring(angle: Any = 0.0) -> stm.TorsionalSpringDamper:
    return stm.TorsionalSpringDamper("hinge", stiffness=STIFFNESS, angle=angle)


def sharp(**more: Any) -> stm.Method:
    return stm.Method(rtol=1e-12, atol=1e-12, **more)


def oscillation(ts, start, centre):
    """Angle of a disc released at rest [rad]."""
    return centre + (start - centre) * np.cos(RATE * np.asarray(ts))


TS = np.linspace(0.0, 12.0, 49)
# hinge by hinge: a spring wound by 1,000 rad, servos of a target that runs away, stops of a free disc
ENDS = {
    "wound": ("ground", "first"),
    "out": ("ground", "second"),
    "back": ("third", "ground"),
    "stopped": ("ground", "fourth"),
}


@pytest.fixture(scope="module")
def run():
    """Four discs side by side, over 12 s; the saved times are many turns apart."""
    servo = lambda name: JointServo(
        name, stiffness=STIFFNESS, damping=0.0, target=lambda t: 500.0 * t
    )
    system = stm.System(
        [stm.Body(name, 1.0, [0.3, 0.3, INERTIA]) for name in ("first", "second", "third", "fourth")],
        [stm.revolute(name, *at, point=[0, 0, 0], axis=[0, 0, 1]) for name, at in ENDS.items()],
        [
            stm.TorsionalSpringDamper("wound", stiffness=STIFFNESS, angle=1000.0),
            servo("out"), servo("back"),
            EndStop("stopped", lower=-20.0, upper=40.0, stiffness=5.0, damping=0.0, width=1e-3),
        ],
    )  # fmt: skip
    state = stm.state_from_joints(system, rates={"stopped": 10.0})
    method = sharp(max_steps=100_000)
    return stm.simulate(system, state, ts=TS, method=method, error_estimate=False)


@pytest.mark.slow
def test_a_spring_wound_by_a_thousand_radians_is_an_oscillator(run):
    exact = oscillation(TS, 0.0, 1000.0)
    np.testing.assert_allclose(run.joint("wound").angle, exact, atol=1e-6, rtol=1e-9)


def test_a_servo_leads_a_hinge_over_a_thousand_radians(run):
    """The target runs away and the disc swings about it; the tree passes one of the joints either way."""
    exact = 500.0 * TS - 500.0 / RATE * np.sin(RATE * TS)
    for name in ("out", "back"):
        np.testing.assert_allclose(run.joint(name).angle, exact, rtol=1e-9, atol=1e-9)


def test_end_stops_beyond_half_a_turn_stop(run):
    """The disc turns at 10 rad/s between stops at -20 and 40 rad: a spring of zero width beyond."""
    angle = run.joint("stopped").angle
    depth = 10.0 / RATE  # at which the spring has stopped the disc, but for its width
    assert 40.5 < np.max(angle) < 40.0 + depth + 1e-3
    assert -20.0 - depth - 1e-3 < np.min(angle) < -20.5
    free = (angle > -20.0) & (angle < 40.0)
    np.testing.assert_allclose(np.abs(run.joint("stopped").angle_rate[free]), 10.0, rtol=1e-8)


def test_energy_counts_all_turns(run):
    total = run.snapshot.kinetic + run.snapshot.potential - run.trajectory.work
    np.testing.assert_allclose(total, total[0], rtol=1e-8)


@pytest.mark.slow
def test_states_between_saved_times_and_files_keep_the_turns(run, tmp_path):
    times = np.array([0.3, 1.1])
    omega = stm.dynamics.states_at(run, times).omega[:, 0, 2]
    np.testing.assert_allclose(omega, 1000.0 * RATE * np.sin(RATE * times), rtol=1e-8)
    saved = stm.load(stm.save(run, tmp_path / "run.nc"))
    assert saved["internal_state"].values[0] == "TorsionalSpringDamper wound.angle [rad]"
    exact = oscillation(TS, 0.0, 1000.0)
    np.testing.assert_allclose(saved["internal"][:, 0], exact, rtol=1e-9, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [stm.Tree(), stm.Augmented()], ids=["tree", "augmented"])
def test_a_batch_of_starts_counts_its_own_turns(formulation):
    """`integrate` under vmap and jvp, from starts 0, 5 and 1,000 rad from the free angle."""
    method = sharp(formulation=formulation, solver=diffrax.Dopri8(), adjoint=diffrax.ForwardMode())

    def final(start):
        system = with_start_angles(disc(spring()), {"hinge": start})
        half, none = start / 2, jnp.zeros(())
        p = jnp.stack([jnp.cos(half), none, none, jnp.sin(half)])
        rest = system.reference
        state = stm.State(rest.r, p[None], rest.v, rest.omega)
        path = stm.integrate(system, state, jnp.asarray([0.0, 0.7]), method)
        return path.internal[-1, 0], path.result

    starts = jnp.asarray([0.0, 5.0, 1000.0])
    along = lambda start: jax.jvp(final, (start,), (jnp.ones(()),), has_aux=True)
    angles, slopes, results = jax.jit(jax.vmap(along))(starts)
    assert np.all(results == diffrax.RESULTS.successful)
    exact = oscillation(0.7, np.asarray(starts), 0.0)
    np.testing.assert_allclose(angles, exact, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slopes, np.cos(0.7 * RATE), rtol=0, atol=1e-9)


def test_a_start_says_its_turns():
    system = disc(spring())
    with pytest.raises(stm.ModelError, match=r"joint 'hinge' is to be 1000 rad.*with_start_angles"):
        stm.state_from_joints(system, {"hinge": 1000.0})
    with pytest.raises(stm.ModelError, match="turns of joint 'hinge' have no effect"):
        with_start_angles(disc(), {"hinge": 1000.0})
    wound = with_start_angles(system, {"hinge": 1000.0})
    state = stm.state_from_joints(wound, {"hinge": 1000.0})
    found = evaluated(wound, state).accelerations.omega_rate[0, 2]
    assert float(found) == pytest.approx(-STIFFNESS * 1000.0 / INERTIA, rel=1e-13)


@pytest.fixture(scope="module")
def preloaded():
    """Space of a disc with a spring at 10 rad and an effort, and its point at 1 rad."""
    system = disc(spring(10.0), stm.JointEffort("hinge", 0.0))
    space = stm.TreeSpace(system)
    return space, space.from_state(stm.state_from_joints(system, {"hinge": 1.0}))


@pytest.mark.slow
def test_trim_and_linearisation_count_turns(preloaded):
    """k (10 - x) + Q = 0 with Q = -15 N m: x = 7 rad, more than half a turn away; A = [0 1; -k/I 0]."""
    space, x = preloaded
    assert space.names == (("hinge.angle", "rad"), ("hinge.angle_rate", "rad/s"))
    none = stm.inputs_of(space.system).chosen([])
    held = stm.mechanics.with_inputs(space.system, {"effort": -15.0})
    found = stm.trim(space.with_system(held), at=x, free=["hinge.angle"], inputs=none)
    assert float(space.internal_at(found.point)[0]) == pytest.approx(7.0, abs=1e-9)
    # the same posture a turn less is another state
    nearest = space.from_state(space.to_state(found.point))
    away = space.difference(found.point, nearest)
    np.testing.assert_allclose(away, [2 * np.pi, 0.0], atol=1e-12)
    linear = stm.linearize(space, found.point)
    np.testing.assert_allclose(linear.A, [[0, 1], [-(RATE**2), 0]], atol=1e-12)


@pytest.mark.slow
def test_a_process_model_counts_turns(preloaded):
    """Runge-Kutta steps of 2 ms over 1 s, of order 4: (RATE 2 ms)^4 RATE / 120 of 9 rad is 4e-9 rad."""
    space, x = preloaded
    after = jax.jit(lambda x: moved_over(space, x, 1.0, space.system, 500))(x)
    exact = oscillation(1.0, 1.0, 10.0)
    assert float(space.internal_at(after)[0]) == pytest.approx(exact, abs=1e-8)
    flown = jax.jit(
        lambda x: integrate_points(space, space.system, x, jnp.asarray([0.0, 1.0]), sharp())
    )(x)
    assert float(flown.internal[-1, 0]) == pytest.approx(exact, abs=1e-9)


@pytest.mark.slow
def test_a_sampled_loop_counts_turns():
    """A held target that a controller moves by 40 rad at once: half an oscillation later it is at 80."""
    servo = JointServo("hinge", stiffness=STIFFNESS, damping=0.0, target=0.0)
    plant = stm.control.Plant(disc(servo), rate=200.0, inputs=["target"], steps=1)
    run = stm.control.close_loop(plant, lambda estimate, reference, memory: (reference, memory), 1.0,
                                 reference=jnp.asarray([40.0]))  # fmt: skip
    exact = oscillation(run.ts, 0.0, 40.0)
    assert np.max(exact) > 70.0
    # steps of order 4, 5 ms at 5 rad/s
    np.testing.assert_allclose(run.rollout.internal[:, 0], exact, atol=1e-6)


@pytest.mark.slow
def test_turns_of_a_loop_closing_hinge_are_counted():
    """Crank and rocker with springs in all hinges, one of which closes the loop; the crank turns twice.

    Back in the first posture, the crank has turned by 4 pi against ground, and the coupler by as much
    back against the crank; coupler and rocker have only swung.
    """
    # the rocker of 1.5 m meets the coupler of 2 m, from pins 2 m apart and a crank of 0.5 m
    between = np.array([2.0, -0.5])
    span = np.linalg.norm(between)
    along = (2.0**2 - 1.5**2 + span**2) / (2 * span)
    corner = along * between + np.sqrt(2.0**2 - along**2) * np.array([0.5, 2.0])
    corner = np.array([0.0, 0.5]) + corner / span
    pins = {"A": (0.0, 0.0), "B": (0.0, 0.5), "C": tuple(corner), "D": (2.0, 0.0)}
    at = lambda pin: np.array([pin[0], 0.0, pin[1]])
    ends = {"A": ("ground", "crank"), "B": ("crank", "coupler"), "C": ("coupler", "rocker"),
            "D": ("ground", "rocker")}  # fmt: skip
    bodies = [
        stm.Body(name, 1.0, [0.1, 0.1, 0.1], position=(at(pins[i]) + at(pins[j])) / 2)
        for name, i, j in (("crank", "A", "B"), ("coupler", "B", "C"), ("rocker", "C", "D"))
    ]
    hinge = lambda name: stm.revolute(name, *ends[name], point=at(pins[name]), axis=[0, 1, 0])
    springs = [stm.TorsionalSpringDamper(name, stiffness=1.0) for name in ends]
    system = stm.System(bodies, [hinge(name) for name in ends], springs)
    space = stm.TreeSpace(system, independent=["A.angle"])
    x = space.from_state(system.reference)
    move = jnp.asarray([4 * np.pi / 64, 0.0])
    step = jax.jit(lambda x: space.with_closed_loops(space.retract(x, move)))
    for _ in range(64):
        x = step(x)
    expected = 4 * np.pi * np.array([1.0, -1.0, 0.0, 0.0])
    np.testing.assert_allclose(space.internal_at(x), expected, atol=1e-9)
