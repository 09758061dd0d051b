"""The UAV's motion and derivatives against those of an earlier commit, before the package was rebuilt.

Arrays agree to 1e-10 of the largest number in them. `test_flight_trim.py` compares trims and the linear
model with the same commit's.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from uav_numbers import STORED, same

import stmuav_jax as stm
from stmuav_jax.analysis import hover
from stmuav_jax.dynamics.evaluation import Saved, evaluate_accelerations
from stmuav_jax.uav import trim_slopes
from stmuav_jax.uav.scenes.uav_tracker import make_uav

START = stm.uav.initial_angles(stm.PART_II)
PARTS = ("r", "p", "v", "omega")


@pytest.fixture(scope="module")
def states():
    """Stored states, stacked."""
    return stm.State(*(jnp.array([s[part] for s in STORED["states"]]) for part in PARTS))


def test_states(states):
    """Postures and velocities of all bodies from the base's motion and the panel's angles."""
    uav = make_uav()

    def placed(x):
        p = stm.rotation.from_rotation_vector(x["rotation_vector"])
        base = {"r": x["r"], "p": p, "v": x["v"], "omega": x["omega"]}
        # by the tracker's closed form, and through the loops closed by Newton's method
        state = uav.state(START + x["angles"], x["rates"], **base)
        return state, uav.space.to_state(uav.space.from_state(state))

    points = jax.tree.map(
        lambda *x: jnp.array(x, float), *STORED["points"], is_leaf=lambda x: isinstance(x, list)
    )
    found, closed = jax.jit(jax.vmap(placed))(points)
    for part in PARTS:
        same(getattr(found, part), getattr(states, part))
        same(getattr(closed, part), getattr(states, part))


def test_coordinates_are_those_that_the_loops_determine():
    """The selection that is made without numbers is the one at the reference posture."""
    uav = make_uav()
    assert stm.TreeSpace(uav.system).selection == uav.space.selection


@pytest.mark.parametrize("case", [1, 2, 3])
def test_accelerations(case, states):
    system = stm.make_scene("uav_tracker", case).system
    tree = stm.dynamics.Tree()
    at = Saved(np.array(STORED["times"]), states, np.zeros((3, 0)))
    found = evaluate_accelerations(tree, tree.prepare(system), at)
    stored = STORED["accelerations"][str(case)]
    for name in ("v_rate", "omega_rate"):
        same(getattr(found, name), [each[name] for each in stored])


@pytest.mark.slow
def test_derivatives_of_a_trim():
    stored = STORED["slopes"]
    values = {name: jnp.asarray(stm.PART_II.value(name), dtype=float) for name in stored}
    build = lambda values: make_uav(stm.PART_II.replaced(values))
    found, slopes = trim_slopes(build, values, hover(START))
    places = [k for k, (name, _) in enumerate(found.names) if name.startswith(("speed", "force"))]
    for name, numbers in stored.items():
        same(np.asarray(slopes[name])[places], numbers)
