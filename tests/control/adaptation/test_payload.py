"""Payload filter: its equations against the simulator's, its derivatives, its consistency."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.algebra.compiler import quick_jit
from stmuav_jax.control.adaptation.moments import carrier, carrying, moments, properties
from stmuav_jax.missions.payload import table_carrying, tracker_carrying
from stmuav_jax.missions.schema import PayloadEntry

control, tracker = stm.control, stm.tracker
TABLE = stm.PART_II
MASS, PLACE = 0.3, np.array([0.04, 0.01, 0.03])


@pytest.fixture(scope="module")
def machines():
    """The UAV without and with a point mass on its panel."""
    empty = stm.scenes.uav_flyer(TABLE)
    geometry, shift = tracker.tracker_geometry(TABLE), TABLE.value("mount.shift")
    bodies = control.panel_bodies(empty.system, geometry, shift)
    load = PayloadEntry(mass=MASS, position=tuple(PLACE))
    return empty, stm.scenes.uav_flyer(table_carrying(TABLE, tracker_carrying(bodies, load)))


@pytest.fixture(scope="module")
def tumbling():
    """A point of the UAV's motion with everything moving."""
    return stm.flight.FlyerPoint(
        jnp.array([0.3, -0.2, 1.0]), stm.rotation.normalise(jnp.array([0.9, 0.2, -0.3, 0.1])),
        jnp.array([0.1, -0.2]), jnp.array([1.0, 2.0, -0.5]), jnp.array([0.8, -1.1, 0.6]),
        jnp.array([1.7, -1.3]),
    )  # fmt: skip


def test_the_moments_of_a_payload_are_those_of_the_loaded_machine(machines, tumbling):
    """Against functions that know no payload; what the filter leaves out is added by hand."""
    empty, loaded = machines
    state, heavier = empty.to_state(tumbling), loaded.to_state(tumbling)
    on, payload = carrier(state), control.Payload(MASS, jnp.asarray(MASS * PLACE), jnp.zeros(3))
    found = carrying(moments(empty.system, state), on, payload)
    own = on.R @ (MASS * (PLACE @ PLACE * np.eye(3) - np.outer(PLACE, PLACE))) @ on.R.T
    assert np.linalg.norm(own) < 0.02 * np.linalg.norm(found.inertia)
    found = found._replace(inertia=found.inertia + own, momentum=found.momentum + own @ on.turning)
    close = lambda x, y: np.testing.assert_allclose(x, y, atol=1e-14)
    jax.tree.map(close, found, moments(loaded.system, heavier))
    direct = control.mass_properties(loaded.system, heavier)
    jax.tree.map(close, properties(found), direct)
    assert np.linalg.norm(direct.h) > 1e-3


@pytest.mark.slow
def test_the_angular_momentum_obeys_the_filters_equation(machines, tumbling):
    """dL/dt = tau - p x f - W x L along the simulator's accelerations, rotors and sliders at work."""
    flyer = machines[1]
    squared = 1e6 * jnp.array([1.4, 1.9, 1.6, 1.2, 2.0, 1.5])
    inputs = stm.flight.RotorsAndForces(squared, jnp.array([12.0, -7.0]))
    rates = quick_jit(lambda f, x: f.rates(x, 0.0, f.with_inputs(inputs)))(flyer, tumbling)

    def momentum(s):
        about = moments(flyer.system, flyer.to_state(flyer.retract(tumbling, s * rates)))
        omega = tumbling.omega + s * rates[11:14]
        return about.inertia @ omega + about.momentum

    L, L_rate = jax.jvp(momentum, (0.0,), (1.0,))
    R = stm.rotation.rotation_matrix(tumbling.p)
    felt = R.T @ (rates[8:11] - jnp.array([0.0, 0.0, -9.81]))
    torque = (control.PayloadFilter(flyer.system, 400.0).wrenches @ squared)[1:]
    p = moments(flyer.system, flyer.to_state(tumbling)).first
    expected = torque - jnp.cross(p, felt) - jnp.cross(tumbling.omega, L)
    assert np.linalg.norm(L_rate) > 0.1
    np.testing.assert_allclose(L_rate, expected, atol=1e-9)


def test_the_filters_derivatives(machines, tumbling):
    """The matrices of errors and of readings against automatic derivatives, the panel at rest."""
    empty = machines[0]
    found = control.PayloadFilter(empty.system, 400.0)
    state = empty.to_state(tumbling._replace(rates=jnp.zeros(2)))
    about, on = moments(empty.system, state), carrier(state)
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
    L = about.inertia @ tumbling.omega + about.momentum
    W = read(jnp.zeros(10).at[:3].set(L), turning)[0][:3]
    np.testing.assert_allclose(W, tumbling.omega, atol=1e-12)
