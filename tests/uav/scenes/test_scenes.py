"""The report's scenes against the figures they must reach."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import (
    SCENES,
    Augmented,
    Method,
    ModelError,
    SettingError,
    State,
    StateError,
    Unstabilised,
    assemble,
    make_scene,
    simulate,
)
from stmuav_jax.dynamics import rank
from stmuav_jax.math.rotation import normalise
from stmuav_jax.uav import PRINTED_ORIENTATIONS


@pytest.mark.slow
def test_spin_against_closed_form():
    """Report Part I, Eq. 4.28: 1e-12 in every Euler parameter at every saved time, 5 s, 60.2 rad."""
    spin_run = simulate(make_scene("spin"), method=Method(rtol=1e-13, atol=1e-13))
    half = 0.25 * 1e-4 / 20756.82e-9 * spin_run.ts**2
    assert 2 * half[-1] == pytest.approx(60.2, abs=0.05)
    exact = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    assert len(spin_run.ts) == 501
    assert np.abs(spin_run.states.p[:, 0] - exact).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(("name", "case"), [("tracker", 3), ("uav_tracker", 2)])
def test_energy_balance(name, case):
    """At rtol 1e-10: at most 1e-8 of the largest energy, work of rotors and actuators counted."""
    c = simulate(make_scene(name, case), method=Method(rtol=1e-10, atol=1e-10)).certificate
    assert c.relative_energy_error <= 1e-8
    if name == "uav_tracker":
        assert c.momentum_error is not None
        assert c.angular_momentum_error is not None
        assert c.momentum_error <= 1e-10
        assert c.angular_momentum_error <= 1e-10


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_a_minute_with_default_settings():
    c = simulate(make_scene("uav_tracker", 1), t1=60.0, save_every=0.1).certificate
    assert c.result == "successful"
    assert c.position_violation <= 1e-10
    assert c.velocity_violation <= 1e-9
    assert c.norm_violation <= 1e-12


@pytest.mark.parametrize(
    ("name", "case", "expected"),
    [("tracker", 1, (34, 34, 2)), ("uav_tracker", 2, (34, 34, 8)), ("hexacopter", None, (0, 0, 6))],
)
def test_rank_and_degrees_of_freedom(name, case, expected):
    scene = make_scene(name, case)
    found = rank(scene.system, scene.state0)
    assert (found.rows, found.rank, found.dof) == expected
    if found.rows:
        assert 0.03 < found.smallest_singular_value < 0.045


def test_hexacopter_has_no_constraint_code():
    """One free body: no rows, and nothing that factorises or solves in what is compiled."""
    scene = make_scene("hexacopter")
    formulation = Augmented()
    model = formulation.prepare(scene.system)
    assert model.constraints.n_rows == 0
    x = formulation.to_vector(model, scene.state0)
    rate = lambda y: formulation.derivative(model, jnp.asarray(0.0), y, Unstabilised())[0]
    text = jax.jit(rate).lower(x).as_text()
    assert "potrf" not in text
    assert "triangular_solve" not in text
    seven = make_scene("uav_tracker", 1)
    whole = formulation.prepare(seven.system)
    y = formulation.to_vector(whole, seven.state0)
    rate = lambda y: formulation.derivative(whole, jnp.asarray(0.0), y, Unstabilised())[0]
    assert "potrf" in jax.jit(rate).lower(y).as_text()


def printed_state(scene):
    """The scene's state with the Euler parameters of Table 6.1 as they are printed."""
    p = [PRINTED_ORIENTATIONS.get(name, (1.0, 0.0, 0.0, 0.0)) for name in scene.system.names]
    s = scene.state0
    return State(s.r, jnp.asarray(p), s.v, s.omega)


def test_printed_euler_parameters_are_refused_with_the_cure():
    scene = make_scene("tracker", 1)
    printed = dataclasses.replace(scene, state0=printed_state(scene))
    with pytest.raises(StateError, match=r"post_4.*norm 1\.0000.*stmuav_jax\.assemble"):
        simulate(printed)


def test_printed_euler_parameters_do_not_close_once_normalised_either():
    scene = make_scene("tracker", 1)
    s = printed_state(scene)
    unit = State(s.r, jax.vmap(normalise)(s.p), s.v, s.omega)
    with pytest.raises(StateError, match=r"do not fit the joints: joint '\w+' is off.*assemble"):
        simulate(dataclasses.replace(scene, state0=unit))


def test_the_cure_works():
    """The nearest posture that closes lies within millimetres of the printed centres of mass."""
    scene = make_scene("tracker", 1)
    found = assemble(scene.system, printed_state(scene))
    assert bool(found.converged)
    assert float(found.largest_displacement) < 5e-3


@pytest.mark.parametrize("name", ["tracker", "uav_tracker"])
def test_lengths_that_cannot_be_assembled_name_the_leg(name):
    table = SCENES[name].parameters.replaced({"geometry.rods": (0.095, 0.01)})
    with pytest.raises(ModelError, match=r"Leg 3 cannot be assembled.*rod is 10 mm long.*arms"):
        make_scene(name, 1, table)


def test_unknown_scenes_and_cases_are_refused():
    with pytest.raises(SettingError, match="Did you mean 'uav_tracker'"):
        make_scene("uav_traker")
    with pytest.raises(SettingError, match="no case 4; its cases: 1, 2, 3"):
        make_scene("tracker", 4)
    with pytest.raises(SettingError, match="its cases: none"):
        make_scene("spin", 1)


def test_registry_builds_every_case():
    for name, entry in SCENES.items():
        for case in entry.cases or (None,):
            scene = make_scene(name, case)
            assert scene.title
            assert scene.notes
            assert set(scene.watch) <= set(scene.system.names)
