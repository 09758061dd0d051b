"""Parameter tables: complete, sourced, replaceable, and strict about what replaces what."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_I, PART_II, ModelError, make_scene


@pytest.mark.parametrize("table", [PART_I, PART_II], ids=lambda t: t.name)
def test_every_line_has_value_unit_and_source(table):
    for key in table:
        line = table[key]
        assert np.all(np.isfinite(np.asarray(line.value, dtype=float))), key
        assert line.unit, key
        assert len(line.source) > 3, key


def test_replaced_keeps_units_and_says_who_gave_the_value():
    table = PART_II.replaced({"mass.panel_7": 0.95})
    assert table.value("mass.panel_7") == 0.95
    assert table["mass.panel_7"].unit == "kg"
    assert table["mass.panel_7"].source == "given by the user"
    assert PART_II.value("mass.panel_7") == 0.89085


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"mass.panel_8": 1.0}, "Did you mean 'mass.panel_7'"),
        ({"mass.panel_7": (1.0, 2.0)}, r"shape \(\)"),
        ({"mass.panel_7": float("nan")}, "finite"),
        ({"mass.panel_7": -1.0}, "is a mass and must be positive"),
        ({"mass.panel_7": 10**400}, "not a whole number of about 401 digits"),
        ({"inertia.panel_7": -np.eye(3)}, "'inertia.panel_7' must be positive definite"),
        ({"inertia.panel_7": np.diag([1.0, 1.0, 3.0])}, "triangle inequality"),
    ],
)
def test_bad_replacements_are_refused(values, words):
    with pytest.raises(ModelError, match=words):
        PART_II.replaced(values)


def test_a_scene_is_differentiable_in_its_parameters():
    def total_mass(m):
        scene = make_scene("uav_tracker", 1, PART_II.replaced({"mass.panel_7": m}))
        return jnp.sum(scene.system.bodies.mass)

    assert jax.grad(total_mass)(0.9) == 1.0


def test_printed_inertia_of_part_one_needs_its_stated_tolerance():
    """J'_7 of Table 6.2 violates the triangle inequality by 0.7 %; only the table admits it."""
    same = {"inertia.panel_7": PART_I.value("inertia.panel_7")}
    with pytest.raises(ModelError, match=r"panel_7.*triangle inequality.*0\.6"):
        make_scene("tracker", 1, PART_I.replaced(same))
