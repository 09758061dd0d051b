"""Flight with a rotor lost and known to be lost: thrust and tilt are held, yaw is given up."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit

control = stm.control
LIMITS = stm.uav.RotorLimits(200.0, 1900.0)


@pytest.fixture(scope="module")
def plant():
    return control.Plant(stm.make_scene("hexacopter"))


def test_speeds_without_a_rotor_keep_thrust_and_tilt(plant):
    """The allocation gives thrust and tilt, and turns towards the wanted yaw up to a limit."""
    pilot = stm.uav.FlightController(plant.system, plant.rate, limits=LIMITS, lost=[3])
    B, low, high = np.asarray(pilot.wrenches), 200.0**2, 1900.0**2
    found = quick_jit(lambda w: pilot._allocate(w))
    rng = np.random.default_rng(7)
    weight = 9.81 * float(plant.system.bodies.mass[0])
    kept = 0
    for scale in [0.1, 1.0, 8.0] * 8:
        wrench = np.array([weight, 0.0, 0.0, 0.0]) + scale * rng.normal(size=4) * [2, 1, 1, 0.1]
        u, given = found(jnp.asarray(wrench))
        others = np.delete(np.asarray(u), 2)
        assert u[2] == 0.0
        assert np.all((others > low * (1 - 1e-9)) & (others < high * (1 + 1e-9)))
        got = B @ np.asarray(u)
        if given:
            kept += 1
            np.testing.assert_allclose(got[:3], wrench[:3], rtol=1e-9, atol=1e-9)
            # a limit is met where the yaw is not
            missed = abs(got[3] - wrench[3]) > 1e-9
            assert not missed or np.min(np.abs(np.subtract.outer(others, [low, high]))) < 1.0
        # the tilting moment is a share of the wanted one
        across = got[1] * wrench[2] - got[2] * wrench[1]
        assert abs(across) < 1e-9 * (1 + np.hypot(*wrench[1:3]) ** 2)
    assert 12 <= kept < 24


@pytest.mark.parametrize("rotor", range(6))
def test_no_hover_without_a_rotor_holds_the_yaw(plant, rotor):
    """Docs/control_and_missions.md, by linear programmes: within the limits only without the yaw moment's equation."""
    wrenches = stm.uav.wrench_map(plant.system.forces[1], plant.system.bodies.com[0])
    B = np.delete(np.asarray(wrenches), rotor, axis=1)
    hover = np.array([9.81 * float(plant.system.bodies.mass[0]), 0.0, 0.0, 0.0])
    for rows, is_possible in ((4, False), (3, True)):
        found = scipy.optimize.linprog(
            np.zeros(5), A_eq=B[:rows], b_eq=hover[:rows], bounds=(200.0**2, 1900.0**2)
        )
        assert found.success == is_possible


def test_a_hexacopter_follows_a_path_without_a_rotor(plant):
    """It starts 30 degrees aslant and spinning, and comes to its circle without rotor 5."""
    pilot = stm.uav.FlightController(plant.system, plant.rate, limits=LIMITS, lost=[5])
    circle = control.follow_path(lambda t: jnp.stack([jnp.cos(t) - 1.0, jnp.sin(t), 0.1 * t]))
    start = stm.uav.BaseStart(roll=0.5, r=2.0)
    tilted = stm.make_scene("hexacopter", start=start).state0
    found = quick_jit(
        lambda p, c, x: control.rollout(
            p, c, 1601, reference=circle, memory=c.start(), start=p.reset(state0=x)
        )
    )(plant, pilot, tilted)
    assert np.all(np.asarray(found.reason) == 0)
    off = np.asarray(found.states.r[-1, 0]) - np.array([np.cos(4.0) - 1.0, np.sin(4.0), 0.4])
    assert np.linalg.norm(off) < 0.01
    assert np.all(np.asarray(found.inputs[:, 4]) == 0.0)


def test_outages_that_cannot_be_flown_are_refused(plant):
    make = lambda **more: stm.uav.FlightController(plant.system, 400.0, **more)
    with pytest.raises(stm.ModelError, match="no rotor 7 to be lost"):
        make(limits=LIMITS, lost=[7])
    with pytest.raises(stm.ModelError, match="without rotor 1 needs limits"):
        make(lost=[1])
    with pytest.raises(stm.ModelError, match="cannot be held without rotors 1, 2, 3"):
        make(limits=LIMITS, lost=[1, 2, 3])
    with pytest.raises(stm.ModelError, match="cannot be held without rotor 1: the hover"):
        make(limits=stm.uav.RotorLimits(200.0, 1300.0), lost=[1])
