"""Payload filter: its equations against the simulator's, its derivatives, its consistency."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.analysis import mass_moments
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.missions.machine import table_carrying, tracker_carrying
from stmuav_jax.missions.schema import PayloadEntry
from stmuav_jax.uav.adaptation import add_payload, find_carrier_motion
from stmuav_jax.uav.flight_controller import central_properties

control, tracker = stm.control, stm.uav
TABLE = stm.PART_II
MASS, PLACE = 0.3, np.array([0.04, 0.01, 0.03])


@pytest.fixture(scope="module")
def machines():
    """The UAV without and with a point mass on its panel."""
    empty = stm.uav.make_uav(TABLE)
    geometry, shift = tracker.tracker_geometry(TABLE), TABLE.value("mount.shift")
    bodies = stm.uav.panel_bodies(empty.system, geometry, shift)
    load = PayloadEntry(mass=MASS, position=tuple(PLACE))
    return empty, stm.uav.make_uav(table_carrying(TABLE, tracker_carrying(bodies, load)))


@pytest.fixture(scope="module")
def tumbling():
    """Motion of the UAV in which everything moves, but for the panel's rates."""
    return {
        "r": [0.3, -0.2, 1.0], "p": stm.rotation.normalise(jnp.array([0.9, 0.2, -0.3, 0.1])),
        "angles": [0.1, -0.2], "v": [1.0, 2.0, -0.5], "omega": jnp.array([0.8, -1.1, 0.6]),
    }  # fmt: skip


RATES = (1.7, -1.3)


@pytest.mark.slow
def test_the_moments_of_a_payload_are_those_of_the_loaded_machine(machines, tumbling):
    """Against functions that know no payload; what the filter leaves out is added by hand."""
    empty, loaded = machines
    state, heavier = (uav.state(rates=RATES, **tumbling) for uav in machines)
    on, payload = (
        find_carrier_motion(state),
        stm.uav.Payload(jnp.asarray(MASS), jnp.asarray(MASS * PLACE), jnp.zeros(3)),
    )
    found = add_payload(mass_moments(empty.system, state), on, payload)
    own = on.R @ (MASS * (PLACE @ PLACE * np.eye(3) - np.outer(PLACE, PLACE))) @ on.R.T
    assert np.linalg.norm(own) < 0.02 * np.linalg.norm(found.inertia)
    found = found._replace(inertia=found.inertia + own, momentum=found.momentum + own @ on.turning)
    close = lambda x, y: np.testing.assert_allclose(x, y, atol=1e-14)
    jax.tree.map(close, found, mass_moments(loaded.system, heavier))
    direct = stm.uav.mass_properties(loaded.system, heavier)
    jax.tree.map(close, central_properties(found), direct)
    assert np.linalg.norm(direct.h) > 1e-3


@pytest.mark.slow
def test_the_angular_momentum_obeys_the_filters_equation(machines, tumbling):
    """dL/dt = tau - p x f - W x L along the simulator's accelerations, rotors and sliders at work."""
    uav = machines[1]
    squared = 1e6 * jnp.array([1.4, 1.9, 1.6, 1.2, 2.0, 1.5])
    system = uav.inputs.applied(uav.system, jnp.concatenate([squared, jnp.array([12.0, -7.0])]))
    at = uav.point(rates=RATES, **tumbling)
    rates = quick_jit(lambda space, x, s: space.rates(x, 0.0, s))(uav.space, at, system)

    def momentum(s):
        about = mass_moments(uav.system, uav.space.to_state(uav.space.retract(at, s * rates)))
        omega = at.omega + s * rates[11:14]
        return about.inertia @ omega + about.momentum

    L, L_rate = jax.jvp(momentum, (0.0,), (1.0,))
    R = stm.rotation.rotation_matrix(at.p)
    felt = R.T @ (rates[8:11] - jnp.array([0.0, 0.0, -9.81]))
    torque = stm.uav.PayloadFilter(uav.system, 400.0).wrench_of(squared)[1:]
    p = mass_moments(uav.system, uav.state(rates=RATES, **tumbling)).first
    expected = torque - jnp.cross(p, felt) - jnp.cross(at.omega, L)
    assert np.linalg.norm(L_rate) > 0.1
    np.testing.assert_allclose(L_rate, expected, atol=1e-9)


@pytest.mark.slow
def test_the_filters_derivatives(machines, tumbling):
    """The matrices of errors and of readings against automatic derivatives, the panel at rest."""
    empty = machines[0]
    found = stm.uav.PayloadFilter(empty.system, 400.0)
    state = empty.state(**tumbling)
    about, on = mass_moments(empty.system, state), find_carrier_motion(state)
    rng = np.random.default_rng(3)
    z = jnp.asarray(rng.normal(size=10) * ([0.1] * 3 + [0.2] + [0.02] * 3 + [0.05] * 3))
    torque, turning, felt = (jnp.asarray(rng.normal(size=3)) for _ in range(3))

    def ahead(z):
        L, F = found.onwards(z, about, on, torque, turning, felt, felt)
        return z.at[:3].set(L), F

    def read(z, turning):
        return found.expected(z, about, on, turning, jnp.asarray(70.0))

    def both(z):
        W = read(z, turning)[0][:3]
        exact = jax.jacfwd(lambda z: ahead(z)[0])(z), jax.jacfwd(lambda z: read(z, W)[0])(z)
        return exact, (ahead(z)[1], read(z, W)[1])

    exact, own = quick_jit(both)(z)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(y, x, atol=1e-12), exact, own)
    # the reading itself is the machine's angular velocity
    L = about.inertia @ tumbling["omega"] + about.momentum
    W = read(jnp.zeros(10).at[:3].set(L), turning)[0][:3]
    np.testing.assert_allclose(W, tumbling["omega"], atol=1e-12)
