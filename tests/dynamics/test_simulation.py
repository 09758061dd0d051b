"""`simulate`: bad settings and starts, failures on the way, and what a run holds."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    four_bar,
    four_bar_state,
    pendulum,
    relative_error,
    scene_of,
    state_of,
    swung,
    turn,
)

import stmuav_jax as stm
from stmuav_jax.dynamics import diagnostics
from stmuav_jax.dynamics.assembly.singular import describe_driver_jump
from stmuav_jax.dynamics.simulation import check_method

SYSTEM = pendulum()
START = swung(SYSTEM, 1.0, 0.5)
SCENE = scene_of(SYSTEM, START, t1=0.4, save_every=0.02)
# --- settings: refused before anything is compiled


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"t1": -0.1}, r"t1 = -0.1 s must be finite and not before t0 = 0.0 s"),
        ({"t1": np.nan}, "must be finite"),
        ({"save_every": 0.0}, "save_every must be finite and positive"),
        ({"ts": [0.0, 0.2, 0.1]}, r"must increase, but ts\[2\] = 0.1 s follows ts\[1\] = 0.2 s"),
        ({"ts": [0.1, 0.2]}, "first output time must be the scene's t0 = 0.0 s, not 0.1 s"),
        ({"ts": []}, "list of finite numbers"),
        ({"ts": [0.0, np.nan]}, "list of finite numbers"),
        ({"state": START}, "A scene has its own initial state"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    with pytest.raises(stm.SettingError, match=words):
        stm.simulate(SCENE, **settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"rtol": -1e-6}, "rtol must be finite and at least 1e-15.*-1e-06"),
        ({"rtol": np.nan}, "rtol must be finite"),
        ({"atol": 0.0}, "atol must be finite and at least 1e-15"),
        ({"solver": diffrax.Euler()}, "Euler has no error estimate.*Dopri8"),
        ({"max_steps": 0}, "max_steps"),
        ({"first_step": 0.0}, "first_step"),
        (
            {"solver": "Kvaerno5"},
            r"solver must be an object.*the text 'Kvaerno5': write kvaerno5\(\)",
        ),
        ({"solver": diffrax.Tsit5}, r"solver must.*the class Tsit5: write Tsit5\(\)"),
        (
            {"formulation": "tree"},
            r"formulation must be an object such as Tree\(\).*text 'tree': write Tree",
        ),
        ({"stabilisation": "none"}, r"stabilisation must be an object such as Projection\(\)"),
    ],
)
def test_bad_methods_are_refused(settings, words):
    with pytest.raises(stm.SettingError, match=words):
        stm.simulate(SCENE, method=stm.Method(**settings))


@pytest.mark.parametrize(
    ("given", "words"),
    [(diffrax.Dopri8(), "Dopri8"), (stm.Method, "the class Method")],
)
def test_nothing_but_a_method_says_how_to_integrate(given, words):
    with pytest.raises(stm.SettingError, match=rf"must be a Method\(\.\.\.\), but it is {words}"):
        check_method(given)


def test_a_solver_to_be_chosen_needs_simulate():
    """The pure function cannot look at the values of the start."""
    with pytest.raises(stm.SettingError, match=r"Method\(solver=choose_solver\(system, state\)\)"):
        stm.integrate(SYSTEM, START, jnp.array([0.0, 0.1]), stm.Method(solver="auto"))


def simulated(system=SYSTEM, state=START, **settings):
    return stm.simulate(system, state, **settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, r"give the end t1 \[s\], or the saved times"),
        ({"t1": 1.0, "state": None}, r"give its initial State.*given: none"),
    ],
)
def test_a_system_needs_a_state_and_an_end(settings, words):
    with pytest.raises(stm.SettingError, match=words):
        simulated(**settings)


def test_a_system_from_a_state(run):
    found = simulated(method=stm.Method(rtol=1e-10, atol=1e-10), t1=0.4, save_every=0.02)
    np.testing.assert_array_equal(found.states.r, run[0].states.r)
    assert found.scene.name == "system"
    later = simulated(ts=[1.0, 1.1])
    assert (later.scene.t0, later.certificate.t_end) == (1.0, 1.1)
    assert len(simulated(t1=0.4).ts) == 101


def test_a_traced_start_is_refused_by_the_name_of_what_serves():
    """Not as an array that JAX cannot convert."""
    height = lambda angle: simulated(state=swung(SYSTEM, angle, 0.5), t1=0.1).states.r[-1, 0, 2]
    for through in (jax.grad, jax.jit, lambda f: lambda x: jax.vmap(f)(jnp.asarray([x]))):
        with pytest.raises(stm.SettingError, match=r"Use stmuav_jax\.integrate"):
            through(height)(1.0)


# --- starts


def with_start(**changes):
    parts = {name: getattr(START, name) for name in ("r", "p", "v", "omega")} | changes
    return scene_of(SYSTEM, stm.State(**parts), t1=0.1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"r": START.r * jnp.nan}, "initial position of body 'bob' must be finite"),
        ({"p": START.p * 0.9}, "body 'bob' in the initial state must have norm 1.*has norm 0.9"),
        ({"p": START.p * 0.0}, "body 'bob' in the initial state are all zero"),
        (
            {"r": START.r + 1e-5},
            "initial positions do not fit the joints: joint 'hinge' is off by 1e-05.*assemble",
        ),
        ({"r": START.r.at[0, 1].add(2e-8)}, "positions do not fit the joints: joint 'hinge'"),
        (
            {"v": START.v + 1e-3},
            r"initial velocities do not fit the joints: joint 'hinge' is off by 0.001 m/s.*assemble",
        ),
    ],
)
def test_bad_starts_are_refused(changes, words):
    with pytest.raises(stm.StateError, match=words):
        stm.simulate(with_start(**changes))


def test_a_wrong_angle_and_a_wrong_distance_have_their_own_units():
    bodies = [stm.Body("bar", 1.0, (0.1, 0.1, 0.1), position=(0, 0, -1.0))]
    hinge = stm.revolute("hinge", "ground", "bar", point=(0, 0, 0), axis=(0, 1, 0))
    tilted = stm.System(bodies, [hinge], [])
    turned = state_of([[0, 0, -1.0]], [turn((0, 0, 1), 0.25)])
    with pytest.raises(stm.StateError, match=r"'hinge' is off by 0.247 \(a cosine") as error:
        simulated(tilted, turned, t1=0.1, analysis=False)
    assert " m (" not in str(error.value)
    rod = stm.distance("rod", "ground", "bar", point_i=(0, 0, 0), point_j=(0, 0, -1.0))
    tied = stm.System(bodies, [rod], [])
    with pytest.raises(stm.StateError, match=r"joint 'rod' is off by 1 m \("):
        simulated(tied, state_of([[0, 0, 0.0]], [[1.0, 0, 0, 0]]), t1=0.1, analysis=False)


def test_a_load_that_is_not_finite_at_the_start():
    bad = stm.AppliedMoment("bob", lambda t, kin: jnp.asarray([jnp.nan, 0.0, 0.0]) * (1 + t))
    system = pendulum(forces=(stm.JointDamping("hinge", turning=0.1), bad))
    with pytest.raises(stm.ModelError, match="load of AppliedMoment on bob is not finite at t = 0"):
        stm.simulate(scene_of(system, START))


# --- runs


@pytest.fixture(scope="module")
def run():
    """A plain run, with its progress."""
    seen = []
    found = stm.simulate(SCENE, method=stm.Method(rtol=1e-10, atol=1e-10), progress=seen.append)
    return found, seen


def test_a_joint_of_a_run(run):
    """Its angle from the body's own turn, its rate from the body's angular velocity."""
    found, _ = run
    joint = found.scene.system.joints[0]
    motion = found.joint(joint.name)
    p = found.body(joint.body_j).p
    np.testing.assert_allclose(np.cos(motion.angle / 2), np.abs(p[:, 0]), atol=1e-12)
    rates = np.linalg.norm(found.body(joint.body_j).omega, axis=1)
    np.testing.assert_allclose(np.abs(motion.angle_rate), rates, atol=1e-9)


def test_a_run_and_its_certificate(run):
    found, seen = run
    c = found.certificate
    assert found.successful
    assert c.result == "successful"
    assert c.t_end == 0.4
    np.testing.assert_allclose(found.ts, np.linspace(0, 0.4, 21), atol=1e-15)
    assert found.ts[-1] == 0.4
    assert c.position_violation < 1e-14
    assert c.velocity_violation < 1e-13
    assert c.norm_violation < 1e-15
    assert c.relative_energy_error < 1e-9
    assert (c.rows, c.rank, c.redundant) == (5, 5, ())
    assert c.momentum_error is None
    assert c.angular_momentum_error is None
    assert 0.1 < c.smallest_singular_value < 10
    assert c.accepted_steps > 20
    assert seen[-1] == 1.0
    assert seen == sorted(seen)
    assert c.compile_seconds > 0
    assert set(c.to_dict()) >= {"result", "energy_error", "rank"}


def test_what_a_run_holds(run):
    found, _ = run
    assert found.states.r.shape == (21, 1, 3)
    assert relative_error([x[0] for x in (found.states.r, found.states.p)], [START.r, START.p]) == 0
    bob = found.body("bob")
    np.testing.assert_array_equal(bob.r, found.states.r[:, 0])
    with pytest.raises(stm.ModelError, match="Did you mean 'bob'"):
        found.body("bobb")
    snapshot = found.snapshot
    total = snapshot.kinetic + snapshot.potential
    assert np.max(np.abs(total - total[0])) < 1e-9 * np.max(np.abs(total))
    # the hinge's force is m (a - g) at every saved time
    a = snapshot.accelerations.v_rate[:, 0]
    expected = 2.0 * (a + np.array([0, 0, 9.81]))
    np.testing.assert_allclose(snapshot.reactions.force[:, 0], expected, atol=1e-9)


@pytest.mark.slow
def test_states_between_saved_times_are_as_accurate_as_on_them(run):
    """A run saved rarely, between its times, against the one that saves there."""
    rare = stm.simulate(SCENE, method=stm.Method(rtol=1e-10, atol=1e-10), ts=[0.0, 0.16, 0.4])
    found = stm.dynamics.states_at(rare, run[0].ts)
    for name in ("r", "p", "v", "omega"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(run[0].states, name), rtol=0, atol=1e-8
        )
    np.testing.assert_array_equal(found.r[8], np.asarray(rare.states.r)[1])
    with pytest.raises(stm.SettingError, match=r"covers 0 s to 0\.4 s, but a state at 0\.6 s"):
        stm.dynamics.states_at(rare, [0.2, 0.6])


@pytest.mark.slow
def test_loads_between_saved_times_of_a_planar_loop():
    """A four-bar of hinges, three of whose rows depend on others: stored rarely, and at every time."""
    system = four_bar()
    scene = stm.Scene("four-bar", "Four-bar", system, four_bar_state(system, 2.0), t1=0.04)
    rare, dense = (stm.simulate(scene, ts=np.linspace(0, 0.04, count)) for count in (3, 9))
    between = stm.dynamics.states_at(rare, dense.ts)
    np.testing.assert_allclose(between.r, dense.states.r, atol=1e-9)
    resolved, loads = stm.dynamics.resolved_loads(rare, 0.5), stm.dynamics.run_loads(dense)
    at = np.searchsorted(resolved.ts, np.asarray(dense.ts) - 1e-9)
    largest = np.max(np.abs(loads.force))
    np.testing.assert_allclose(resolved.force[at], loads.force, atol=1e-6 * largest)
    assert np.all(np.isfinite(resolved.force))


def test_ctrl_c_keeps_what_was_reached(run):
    def stop(fraction):
        raise KeyboardInterrupt

    found = stm.simulate(SCENE, method=stm.Method(rtol=1e-10, atol=1e-10), progress=stop)
    assert found.certificate.result == "interrupted"
    assert not found.successful
    count = len(found.ts)
    assert 1 < count < 21
    assert found.certificate.t_end == found.ts[-1] < 0.4
    assert found.errors.estimated_count == count
    assert found.certificate.position_error > 0
    full = run[0].states.r[:count]
    np.testing.assert_allclose(found.states.r, full, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_load_that_turns_bad_is_named_and_the_run_before_it_is_kept():
    burst = lambda t, kin: jnp.where(t < 0.3, 1.0, jnp.nan) * jnp.asarray([0.0, 0.0, 1.0])
    system = pendulum(forces=(stm.AppliedForce("bob", burst),))
    with pytest.raises(stm.SimulationError) as error:
        stm.simulate(scene_of(system, START, t1=0.5, save_every=0.1))
    assert "load of AppliedForce on bob is not finite" in str(error.value)
    assert "stopped at t = 0.3" in str(error.value)
    run = error.value.run
    assert isinstance(run, stm.Run)
    assert not run.successful
    assert run.certificate.t_end == pytest.approx(0.3, abs=1e-6)
    np.testing.assert_allclose(run.ts[:3], [0, 0.1, 0.2])
    assert len(run.ts) == len(run.states.r) == 4
    assert np.all(np.isfinite(run.states.r))
    assert np.isfinite(run.certificate.energy_error)


def test_without_analysis_there_is_no_snapshot(run):
    found = stm.simulate(SCENE, method=stm.Method(rtol=1e-10, atol=1e-10), analysis=False)
    np.testing.assert_allclose(found.states.r, run[0].states.r, rtol=0, atol=1e-12)
    assert np.isnan(found.certificate.energy_error)
    assert found.certificate.rank == 5
    with pytest.raises(stm.SettingError, match="analysis=True"):
        _ = found.snapshot
    with pytest.raises(stm.StateError, match="positions do not fit"):
        stm.simulate(with_start(r=START.r + 1e-5), analysis=False)


@pytest.mark.slow
def test_a_full_certificate_compares_two_formulations(run):
    assert run[0].certificate.formulation_difference is None
    method = stm.Method(rtol=1e-10, atol=1e-10, formulation=stm.Augmented())
    found = stm.simulate(SCENE, method=method, error_estimate=False, certificate="full").certificate
    assert found.formulation_difference is not None
    assert found.formulation_difference < 1e-12
    assert found.smallest_singular_value == pytest.approx(
        run[0].certificate.smallest_singular_value
    )


def test_a_full_certificate_sees_a_wrong_formulation(run, monkeypatch):
    """Accelerations that are a millionth too large are found by the other formulation."""
    right = diagnostics.evaluate_accelerations
    wrong = lambda how, *at: jax.tree.map(
        lambda x: x * (1 + 1e-6 * isinstance(how, stm.Tree)), right(how, *at)
    )
    monkeypatch.setattr(diagnostics, "evaluate_accelerations", wrong)
    method = stm.Method(rtol=1e-10, atol=1e-10)
    found = stm.simulate(SCENE, method=method, error_estimate=False, certificate="full").certificate
    assert found.formulation_difference == pytest.approx(1e-6, rel=1e-3)


def test_a_full_certificate_needs_the_analysis():
    with pytest.raises(stm.SettingError, match="certificate='full' and analysis=False"):
        stm.simulate(SCENE, analysis=False, certificate="full")


@pytest.mark.slow
def test_too_few_steps():
    run = stm.simulate(SCENE, method=stm.Method(max_steps=2, rtol=1e-12, atol=1e-12), throw=False)
    assert run.certificate.result == "max_steps reached"
    assert "s of 0.4 s:" in run.failure
    assert not run.successful
    assert run.certificate.t_end < 0.4
    assert np.all(np.isfinite(run.states.r))


@pytest.mark.slow
def test_an_event_that_is_no_number_is_named():
    """With a direction, and a jump before it; what was reached is kept."""
    lost = lambda t, state: jnp.where(t > 0.11, jnp.nan, -1.0)
    with pytest.raises(stm.SimulationError, match="value of its event is not a number") as error:
        stm.simulate(
            SCENE,
            method=stm.Method(event=lost, direction=True, jump_ts=[0.05]),
            error_estimate=False,
        )
    run = error.value.run
    assert isinstance(run, stm.Run)
    assert 0.1 <= run.certificate.t_end < 0.4
    assert np.all(np.isfinite(run.states.r[:5]))


def test_a_span_of_no_length_gives_the_start():
    run = stm.simulate(SCENE, t1=0.0)
    assert run.successful
    np.testing.assert_array_equal(run.ts, [0.0])
    np.testing.assert_array_equal(run.states.r[0], START.r)


# --- drivers that jump


def driven(motion):
    """A body on a rail, moved by a driver."""
    body = stm.Body("car", 1.0, [0.1, 0.1, 0.1])
    rail = stm.translational("rail", "ground", "car", point=[0, 0, 0], axis=[1, 0, 0])
    push = stm.drive("push", rail, motion, coordinate="displacement")
    return stm.System([body], [rail, push], [])


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (lambda t: jnp.where(t > 0.3, 0.1, 0.0), "the position of the driver 'push' jumps there, from 0 to 0.1 m,"),
        (lambda t: jnp.where(t > 0.3, 1e-6 * (t - 0.3), 0.0), "the velocity of the driver 'push' jumps there"),
        (lambda t: jnp.where(t > 0.3, (t - 0.3) ** 2, 0.0), ""),
        (lambda t: 0.3 * jnp.sin(50 * t) + t**2, ""),
    ],
)  # fmt: skip
def test_a_driver_that_jumps_is_named(motion, words):
    for t in (0.3, 0.3 - 1e-15, 0.3 + 1e-15):
        found = describe_driver_jump(driven(motion), t)
        assert found.startswith(words)
        assert bool(found) == bool(words)


@pytest.mark.slow
def test_a_run_that_a_driver_stops_says_so():
    """The message names driver and time, and what would be valid."""
    system = driven(lambda t: jnp.where(t > 0.3, t - 0.3, 0.0))
    words = (
        r"stopped at t = 0\.3 s of 0\.5 s: the velocity of the driver 'push' jumps there, "
        "from 0 to 1 m/s.*over a finite time"
    )
    with pytest.raises(stm.SimulationError, match=words):
        stm.simulate(system, system.reference, t1=0.5)
