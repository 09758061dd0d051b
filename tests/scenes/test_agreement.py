"""`uav_tracker` case 2 at 1 s: two solvers, both solves, one answer."""

from typing import Any

import diffrax
import numpy as np
import pytest

from stmuav_jax import Augmented, Method, make_scene, simulate

# Accuracy asked of all of them: the motion is chaotic, errors grow fast after 0.5 s.
TIGHT: Any = {"rtol": 1e-12, "atol": 1e-12}
SPAN: Any = {"t1": 1.0, "save_every": 0.5}
AGREEMENT = 1e-9  # [m]


@pytest.fixture(scope="module")
def reference():
    return simulate(make_scene("uav_tracker", 2), method=Method(**TIGHT), **SPAN)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "formulation"),
    [
        (diffrax.Tsit5(), Augmented()),
        (diffrax.Dopri8(), Augmented(solve="dense")),
        (diffrax.Dopri8(), Augmented(solve="dense", rows="report")),
    ],
    ids=["tsit5", "dense", "report"],
)
def test_agrees_with_dopri8_structured(reference, solver, formulation):
    method = Method(solver=solver, formulation=formulation, **TIGHT)
    run = simulate(make_scene("uav_tracker", 2), method=method, **SPAN)
    apart = np.abs(run.states.r[-1] - reference.states.r[-1]).max()
    assert apart <= AGREEMENT
