"""Simulated flight with noise that excites the UAV's parameters: the test case of `identify`.

Rotor speeds and actuator forces vary about those of hover, by splines with fixed random knots, for
0.4 s, in which the panel swings and the UAV turns about all axes. Without control the UAV would
fall in a longer flight.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import to_rotation_vector
from ..algebra.sampled import Sampled
from ..checks.numbers import floats
from ..parameters.table import Parameters
from ..tracker.geometry import initial_angles
from ..tracker.kinematics import strokes
from .flight_trim import hover, trim_flight
from .flyer import Flyer, FlyerPoint
from .identification import (
    Misfit,
    Predict,
    Unknown,
    from_table,
    motion_model,
    numbers_of,
    residuals_and_jacobian,
)
from .uav_tuning import at_rest

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
VISCOUS = 10.0  # viscous friction of the sliders in this experiment [N s/m]; the table's is zero

# Standard deviations of the record: 1 mm, 2 mrad, 5 mrad/s, 0.2 mm.
SIGMA = np.array([1e-3] * 3 + [2e-3] * 3 + [5e-3] * 3 + [2e-4] * 2)


def outputs(flyer: Flyer, at: FlyerPoint) -> Float[Array, "11"]:
    """Row of the record (11,): position [m] and attitude of the base, as a rotation vector from level
    [rad], its angular velocity in its own axes [rad/s], strokes of both sliders [m]."""
    turned = to_rotation_vector(at.p)
    return jnp.concatenate([at.r, turned, at.omega, strokes(flyer.geometry, at.angles)])


@dataclass(frozen=True)
class Experiment:
    """Simulated record, and the parameters and predictions behind it.

    Attributes:
        name: short name for files.
        labels, truth, sizes: names, true values and typical sizes of the parameters (p,).
        start: parameters at the start of the search (p,).
        predict: predictions of `motion_model`. clean: predictions at the truth (k, 11).
        record: predictions with noise (k, 11). sigma: standard deviations of the noise (11,).
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
    """Simulate the flight and add noise.

    Args:
        make: function from a table to the flyer, with friction in its sliders.
        seed: seed of the noise and of the search's start; the inputs are always the same.
        duration: duration of the flight [s].
    """
    table = table.replaced({"friction.viscous": VISCOUS}, source="chosen for the experiment")
    angles = initial_angles(table)
    held = trim_flight(make(table), hover(angles)).inputs
    fixed = np.random.default_rng(2026)
    knots = np.linspace(0.0, duration, 9)
    speeds = np.asarray(held.speed_squared) * (0.92 + 0.075 * fixed.normal(size=(9, 6)))
    forces = np.asarray(held.forces) + 2.0 * fixed.normal(size=(9, 2))
    inputs = {
        "speed_squared": Sampled(knots, speeds, 3),
        "force_slider_2": Sampled(knots, forces[:, 0], 3),
        "force_slider_3": Sampled(knots, forces[:, 1], 3),
    }
    ts = np.linspace(0.0, duration, 41)
    made = from_table(make, table, UNKNOWNS)
    predict = motion_model(made, at_rest(angles), ts, outputs, inputs=inputs)
    truth = numbers_of(table, UNKNOWNS)
    sizes = np.array([u.size for u in UNKNOWNS])
    # residuals of a record of zeros, by the program of the search that follows: a flight of its
    # own would have to be compiled too
    numbers = map(floats, (np.zeros((len(ts), len(SIGMA))), np.ones(len(SIGMA)), truth, sizes))
    flown, _ = residuals_and_jacobian(Misfit(predict, *numbers), floats(np.zeros(len(truth))))
    clean = flown.reshape(len(ts), len(SIGMA))
    rng = np.random.default_rng(seed)
    record = clean + SIGMA * rng.normal(size=clean.shape)
    # masses, inertias and friction stay positive
    start = truth + 0.5 * sizes * rng.uniform(-1.0, 1.0, len(truth))
    labels = tuple(u.label for u in UNKNOWNS)
    name = f"{duration:g} s, seed {seed}"
    return Experiment(name, labels, truth, sizes, start, predict, clean, record, SIGMA)
