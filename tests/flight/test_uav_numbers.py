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
from stmuav_jax.dynamics.evaluation import Saved, accelerations
from stmuav_jax.flight.flight_trim import hover
from stmuav_jax.flight.flyer import FlyerPoint
from stmuav_jax.flight.slopes import trim_slopes
from stmuav_jax.scenes.uav_tracker import uav_flyer

START = stm.tracker.initial_angles(stm.PART_II)
PARTS = ("r", "p", "v", "omega")


@pytest.fixture(scope="module")
def states():
    """Stored states, stacked."""
    return stm.State(*(jnp.array([s[part] for s in STORED["states"]]) for part in PARTS))


def test_states(states):
    """Postures and velocities of all bodies from the base's motion and the panel's angles."""
    points = [
        FlyerPoint(
            jnp.array(x["r"], float), stm.rotation.from_rotation_vector(jnp.array(x["rotation_vector"], float)),
            START + jnp.array(x["angles"], float), *(jnp.array(x[k], float) for k in ("v", "omega", "rates")),
        )
        for x in STORED["points"]
    ]  # fmt: skip
    flyer = uav_flyer()
    together = jax.tree.map(lambda *x: jnp.stack(x), *points)
    found = jax.jit(jax.vmap(flyer.to_state))(together)
    for part in PARTS:
        same(getattr(found, part), getattr(states, part))


@pytest.mark.parametrize("case", [1, 2, 3])
def test_accelerations(case, states):
    system = stm.make_scene("uav_tracker", case).system
    tree = stm.dynamics.Tree()
    at = Saved(np.array(STORED["times"]), states, np.zeros((3, 0)))
    found = accelerations(tree, tree.prepare(system), at)
    stored = STORED["accelerations"][str(case)]
    for name in ("v_rate", "omega_rate"):
        same(getattr(found, name), [each[name] for each in stored])


@pytest.mark.slow
def test_derivatives_of_a_trim():
    stored = STORED["slopes"]
    values = {name: jnp.asarray(stm.PART_II.value(name), dtype=float) for name in stored}
    build = lambda values: uav_flyer(stm.PART_II.replaced(values))
    found, slopes = trim_slopes(build, values, hover(START))
    places = [k for k, (name, _) in enumerate(found.names) if name.startswith(("speed", "force"))]
    for name, numbers in stored.items():
        same(np.asarray(slopes[name])[places], numbers)


@pytest.mark.slow
def test_derivatives_of_a_flight():
    """Reverse mode through 0.2 s of case 2, to the panel's place and its turning."""
    stored = STORED["flight"]
    names = tuple(stored["gradient"])
    values = {name: jnp.asarray(stm.PART_II.value(name), dtype=float) for name in names}

    def end(values):
        scene = stm.make_scene("uav_tracker", 2, stm.PART_II.replaced(values))
        method = stm.Method(rtol=1e-12, atol=1e-12)
        last = stm.integrate(scene.system, scene.state0, jnp.array([0.0, 0.2]), method).states
        place, turning = jnp.array([1.0, -2.0, 0.5]), jnp.array([0.1, 0.2, -0.1])
        return place @ last.r[-1, 6] + turning @ last.omega[-1, 6]

    value, gradient = jax.jit(jax.value_and_grad(end))(values)
    same(value, stored["value"])
    for name in names:
        same(gradient[name], stored["gradient"][name])
