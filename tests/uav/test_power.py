"""Power of rotors: the report's hover in plain numbers, derivative by the mass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.uav import drag_power, hover_power

VALUE = stm.uav.PART_II.value
K = {"k_f": VALUE("rotor.k_f"), "k_tau": VALUE("rotor.k_tau")}
FLOWN = {"gravity": VALUE("gravity"), "count": 6, **K}


def test_hover_of_the_report_takes_1926_watts():
    """Every rotor by itself: thrust, speed, drag torque, torque times speed."""
    parts = [*stm.uav.TRACKER_BODIES, "hexacopter_1"]
    mass = sum(VALUE(f"mass.{part}") for part in parts)
    assert mass == pytest.approx(7.3653, abs=1e-9)
    omega = np.sqrt(mass * 9.81 / 6 / 6.546e-6)
    torque = 1.2864e-7 * omega**2
    assert float(hover_power(mass, **FLOWN)) == pytest.approx(6 * torque * omega, rel=1e-13)
    assert 6 * torque * omega == pytest.approx(1925.8, abs=0.1)


def test_power_of_a_scene_that_hovers():
    """The torque that the rotors' wrench has, at equal speeds all turning one way."""
    u = np.full(6, 1.8e6)
    rotors = stm.uav.Rotors("hull", arms=np.zeros((6, 3)), spin=np.ones(6), speed_squared=u, **K)
    moment = float(rotors.wrench(jnp.asarray(u), jnp.zeros(3))[5])
    taken = float(jnp.sum(drag_power(u, K["k_tau"])))
    assert taken == pytest.approx(-moment * np.sqrt(1.8e6), rel=1e-13)


def test_power_grows_with_the_mass_to_one_and_a_half():
    power = lambda m: hover_power(m, **FLOWN)
    for slope in (jax.grad(power)(7.0), jax.jvp(power, (7.0,), (1.0,))[1]):
        assert float(slope) == pytest.approx(1.5 * float(power(7.0)) / 7.0, rel=1e-13)
    many = jax.vmap(power)(jnp.array([1.0, 4.0]))
    assert float(many[1] / many[0]) == pytest.approx(8.0, rel=1e-13)
