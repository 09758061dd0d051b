"""A flight that shows the UAV's parameters, simulated with noise: the test bed of `identify`.

Rotor speeds and actuator forces vary about those of hover, by splines with fixed random knots, for
0.4 s, in which the panel swings and the UAV turns on all axes; a longer open loop would fall.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..mechanics.sampled import Sampled
from ..vehicle.flyer import Flyer, Inputs
from ..vehicle.geometry import initial_angles
from ..vehicle.parameters import Parameters
from .identify import Predict, Unknown, flight_model, numbers_of
from .trim import hover, trim
from .tuning import at_rest

UNKNOWNS = (
    Unknown("mass.hexacopter_1", 0.5),
    Unknown("mass.panel_7", 0.1),
    Unknown("inertia.hexacopter_1", 0.01, ((0, 0),)),
    Unknown("inertia.hexacopter_1", 0.01, ((1, 1),)),
    Unknown("inertia.hexacopter_1", 0.01, ((2, 2),)),
    Unknown("friction.coulomb", 0.3),
    Unknown("friction.viscous", 5.0),
    Unknown("geometry.panel_com", 0.005, ((0,),)),
    Unknown("geometry.panel_com", 0.005, ((1,),)),
    Unknown("geometry.panel_com", 0.005, ((2,),)),
)
VISCOUS = 10.0  # of the sliders of this experiment [N s/m]; the table's is zero

# Standard deviations of the record: 1 mm, 2 mrad, 5 mrad/s, 0.2 mm.
SIGMA = np.array([1e-3] * 3 + [2e-3] * 3 + [5e-3] * 3 + [2e-4] * 2)


@dataclass(frozen=True)
class Experiment:
    """A record and what made it.

    Attributes:
        name: short. labels, truth, sizes: of the parameters (p,). start: where to search from.
        predict: see `flight_model`. clean: its predictions at the truth (k, 11).
        record: with noise. sigma: the noise's deviations (11,).
    """

    name: str
    labels: tuple[str, ...]
    truth: Float[np.ndarray, " p"]
    sizes: Float[np.ndarray, " p"]
    start: Float[np.ndarray, " p"]
    predict: Predict
    clean: Float[np.ndarray, "k m"]
    record: Float[np.ndarray, "k m"]
    sigma: Float[np.ndarray, " m"]


def experiment(
    make: Callable[[Parameters], Flyer], table: Parameters, *, seed: int = 0, duration: float = 0.4
) -> Experiment:
    """Fly it, and add noise.

    Args:
        make: a table -> the flyer, with friction in its sliders.
        seed: of the noise and of the search's start; the inputs are always the same.
    """
    table = table.replaced({"friction.viscous": VISCOUS}, source="chosen for the experiment")
    angles = initial_angles(table)
    held = trim(make(table), hover(angles)).inputs
    fixed = np.random.default_rng(2026)
    knots = np.linspace(0.0, duration, 9)
    speeds = np.asarray(held.squared) * (0.92 + 0.075 * fixed.normal(size=(9, 6)))
    forces = np.asarray(held.forces) + 2.0 * fixed.normal(size=(9, 2))
    inputs = Inputs(Sampled(knots, speeds, 3), Sampled(knots, forces, 3))
    ts = np.linspace(0.0, duration, 41)
    predict = flight_model(make, table, UNKNOWNS, at_rest(angles), inputs, ts)
    truth = numbers_of(table, UNKNOWNS)
    sizes = np.array([u.size for u in UNKNOWNS])
    clean = np.asarray(jax.jit(predict)(jnp.asarray(truth)))
    rng = np.random.default_rng(seed)
    record = clean + SIGMA * rng.normal(size=clean.shape)
    # masses, inertias and friction stay positive
    start = truth + 0.5 * sizes * rng.uniform(-1.0, 1.0, len(truth))
    labels = tuple(u.label for u in UNKNOWNS)
    name = f"{duration:g} s, seed {seed}"
    return Experiment(name, labels, truth, sizes, start, predict, clean, record, SIGMA)
