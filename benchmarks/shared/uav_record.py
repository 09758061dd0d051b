"""Simulated flight with noise that excites the UAV's parameters: a case for `identify`.

Rotor speeds and actuator forces vary about those of hover, by splines with fixed random knots, for
0.4 s, in which the panel swings and the UAV turns about all axes. Without control the UAV would
fall in a longer flight.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import stmuav_jax as stm
from stmuav_jax.analysis import Unknown, from_table, hover, motion_model
from stmuav_jax.analysis.identification import Misfit, numbers_of, residuals_and_jacobian
from stmuav_jax.math import Sampled
from stmuav_jax.uav import Friction, initial_angles, trim_flight

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
# position [m], attitude [rad] and angular velocity [rad/s] of the base, displacements of the sliders [m],
# with standard deviations of 1 mm, 2 mrad, 5 mrad/s, 0.2 mm
OUTPUTS = [f"{name}_{k}" for name in ("r", "theta", "omega") for k in "xyz"]
ENCODERS = [stm.analysis.Encoder("T12"), stm.analysis.Encoder("T13")]
SIGMA = np.array([1e-3] * 3 + [2e-3] * 3 + [5e-3] * 3 + [2e-4] * 2)


class Case(NamedTuple):
    """Simulated record, and the parameters and predictions behind it.

    Attributes:
        labels, truth, sizes: names, true values and typical sizes of the parameters (p,).
        start: parameters at the start of the search (p,).
        predict: predictions of `motion_model`. clean: predictions at the truth (k, 11).
        record: predictions with noise (k, 11). sigma: standard deviations of the noise (11,).
    """

    labels: tuple[str, ...]
    truth: np.ndarray
    sizes: np.ndarray
    start: np.ndarray
    predict: Any
    clean: np.ndarray
    record: np.ndarray
    sigma: np.ndarray


def simulate_record(*, seed: int = 0, duration: float = 0.4) -> Case:
    """Simulate the flight and add noise.

    Args:
        seed: seed of the noise and of the search's start; the inputs are always the same.
        duration: duration of the flight [s].
    """
    chosen = {"friction.viscous": VISCOUS}
    table = stm.PART_II.replaced(chosen, source="chosen for the experiment")
    make = lambda table: stm.uav.make_uav(table, friction=Friction())
    uav, angles = make(table), initial_angles(table)
    values = np.asarray(trim_flight(uav, hover(angles)).values)
    fixed = np.random.default_rng(2026)
    knots = np.linspace(0.0, duration, 9)
    speeds = values[:6] * (0.92 + 0.075 * fixed.normal(size=(9, 6)))
    forces = values[6:] + 2.0 * fixed.normal(size=(9, 2))
    inputs = {
        "speed_squared": Sampled(knots, speeds, 3),
        "force_slider_2": Sampled(knots, forces[:, 0], 3),
        "force_slider_3": Sampled(knots, forces[:, 1], 3),
    }
    ts = np.linspace(0.0, duration, 41)
    made = from_table(lambda table: make(table).space, table, UNKNOWNS)
    predict = motion_model(made, uav.point(angles), ts, [*OUTPUTS, *ENCODERS], inputs=inputs)
    truth = numbers_of(table, UNKNOWNS)
    sizes = np.array([unknown.size for unknown in UNKNOWNS])
    # residuals of a record of zeros, by the program of the search that follows: a flight of its
    # own would have to be compiled too
    zeros = jnp.zeros((len(ts), len(SIGMA)))
    misfit = Misfit(predict, zeros, jnp.ones(len(SIGMA)), jnp.asarray(truth), jnp.asarray(sizes))
    residuals, _ = residuals_and_jacobian(misfit, jnp.zeros(len(truth)))
    clean = np.asarray(residuals).reshape(zeros.shape)
    rng = np.random.default_rng(seed)
    record = clean + SIGMA * rng.normal(size=clean.shape)
    # masses, inertias and friction stay positive
    start = truth + 0.5 * sizes * rng.uniform(-1.0, 1.0, len(truth))
    labels = tuple(unknown.label for unknown in UNKNOWNS)
    return Case(labels, truth, sizes, start, predict, clean, record, SIGMA)
