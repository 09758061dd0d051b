"""`uav_tracker` case 2: two solvers at 1 s, and the report's dense system in NumPy at 0.5 s, one answer."""

from typing import Any

import diffrax
import numpy as np
import pytest
from dense.steps import Scheme
from dense.system import attempt

from stmuav_jax import Augmented, Method, make_scene, simulate

# Accuracy asked of all of them: the motion is chaotic, errors grow fast after 0.5 s.
TIGHT: Any = {"rtol": 1e-12, "atol": 1e-12}
SPAN: Any = {"t1": 1.0, "save_every": 0.5}
AGREEMENT = 1e-9  # [m]


@pytest.fixture(scope="module")
def reference():
    return simulate(make_scene("uav_tracker", 2), method=Method(**TIGHT), **SPAN)


@pytest.mark.slow
def test_tsit5_in_maximal_coordinates_agrees_with_dopri8_in_relative_ones(reference):
    method = Method(solver=diffrax.Tsit5(), formulation=Augmented(), **TIGHT)
    run = simulate(make_scene("uav_tracker", 2), method=method, **SPAN)
    assert np.abs(run.states.r[-1] - reference.states.r[-1]).max() <= AGREEMENT


@pytest.mark.slow
def test_the_reports_dense_system_agrees(reference):
    times = np.array([0.0, 0.25, 0.5])
    model, history = attempt(make_scene("uav_tracker", 2), times, Scheme("ode45", 1e-12, 1e-12))
    assert not history.failure
    apart = model.positions(history.states[-1]) - reference.states.r[1]
    assert np.abs(apart).max() <= AGREEMENT
