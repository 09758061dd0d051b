"""Singular postures of actuated mechanisms: warned of by joints and inputs, surveyed over coordinates."""

import jax.numpy as jnp
import numpy as np
import pytest
from parallel_robots import BASE, HEAVY, LIGHT, TOP, G, slider_crank, three_rps

import stmuav_jax as stm
from stmuav_jax.dynamics.actuation import force_units, input_scales
from stmuav_jax.mechanics.size import mechanism_size

LEGS = {"effort_P0", "effort_P1", "effort_P2"}


def by_name(found):
    return {each.quantity: each for each in found.findings}


def leg_force(height):
    """Push of each leg of the level 3-RPS at rest, by virtual work of a platform that rises by dz."""
    length = np.hypot(BASE - TOP, height)
    # the platform rises by dz, a leg's barrel by a quarter of the turn of its leg, its rod the rest
    lean, slope = (BASE - TOP) / length, height / length
    turning = lean / length
    rise = HEAVY / 3 + LIGHT * (
        0.25 * length * turning * lean + slope * slope + 0.75 * length * turning * lean
    )
    return G * rise / slope


def test_inputs_have_the_scales_of_weight_and_size():
    system = slider_crank(0.8, "O")
    inputs = stm.inputs_of(system)
    assert force_units(system, inputs) == ("N m",)
    sliding = slider_crank(0.8, "slide")
    assert force_units(sliding, stm.inputs_of(sliding)) == ("N",)
    assert float(input_scales(system, inputs, jnp.asarray(3.0), jnp.asarray(0.5))[0]) == 1.5
    # a body alone has its radius of gyration for a size
    alone = stm.System([stm.Body("b", 2.0, np.diag([0.5, 0.5, 1.0]), free=True)])
    assert float(mechanism_size(alone, alone.reference)) == pytest.approx(2 * np.sqrt(2.0 / 4.0))


@pytest.mark.slow
def test_a_platform_in_the_plane_of_its_base_is_a_direct_singularity():
    """At 1e-6 m the forces are right, and said to be large; at 0 and at 1e-6 m check names the joints."""
    for height in (0.0, 1e-6):
        warning = by_name(stm.check(three_rps(height)))["actuation singularity"]
        assert warning.severity == "warning"
        assert "direct singularity (type 2)" in warning.valid
        words = warning.valid.split("the inputs ")[1]
        assert set(words.split(" hardly hold")[0].split(", ")) >= LEGS
        assert {"S0", "S1", "S2"} <= set(words.split("of the joints ")[1].split(", "))
        moved = float(warning.value.split()[4])
        # turns of the legs of 0.2 m by the height, to within the extrapolation and an angle's round-off
        assert moved <= 3 * height / (BASE - TOP) + np.finfo(float).eps
    system = three_rps(1e-6)
    space = stm.TreeSpace(system)
    trim = stm.trim(space, at=space.from_state(system.reference))
    np.testing.assert_allclose(trim.values, leg_force(1e-6), rtol=1e-6)
    assert sum("times the mechanism's weight" in note for note in trim.notes) == 3
    assert "direct singularity (type 2) is near" in trim.notes[-1]
    assert all(leg in trim.notes[-1] for leg in LEGS)


@pytest.mark.slow
def test_a_platform_above_its_base_has_no_warning():
    system = three_rps(0.45)
    report = stm.check(system)
    assert report.worst == "note"
    found = by_name(report)
    assert found["distance to an actuation singularity"].severity == "note"
    # the level platform moves its heads straight up to first order: no dead centre of the platform
    assert "dead centre" not in found
    space = stm.TreeSpace(system)
    trim = stm.trim(space, at=space.from_state(system.reference))
    np.testing.assert_allclose(trim.values, leg_force(0.45), rtol=1e-9)
    assert trim.notes == ()


@pytest.mark.slow
def test_a_slider_crank_in_line_is_a_dead_centre_for_one_input_and_singular_for_the_other():
    found = by_name(stm.check(slider_crank(0.0, "O")))
    assert "actuation singularity" not in found
    assert found["dead centre"].value.endswith("of slider")
    assert "inverse singularity (type 1)" in found["dead centre"].valid
    assert "effort (O)" in found["dead centre"].valid
    found = by_name(stm.check(slider_crank(0.0, "slide")))
    assert "dead centre" not in found
    assert "effort (slide) hardly hold the motion of the joints" in (
        found["actuation singularity"].valid
    )
    found = by_name(stm.check(slider_crank(0.8, "slide")))
    assert not {"dead centre", "actuation singularity"} & set(found)
