"""Gradients of final values, against differences of the flights themselves."""

import dataclasses

import numpy as np
import pytest
from test_batch import TURNING

from stmuav_jax import SettingError
from stmuav_jax.montecarlo.batch import FlightWork
from stmuav_jax.montecarlo.gradient import final_gradients
from stmuav_jax.montecarlo.sensitivity import derivative_measures
from stmuav_jax.montecarlo.study import study_from_plain

FINAL = TURNING | {"rtol": 1e-12, "atol": 1e-12, "quantities": {
    "x": {"signal": "x", "take": "final"}, "tilt": {"signal": "tilt", "take": "final"}}}  # fmt: skip


class Shifted:
    """A sampling whose draws are moved by a little."""

    def __init__(self, of, by):
        self.of, self.by, self.names, self.seed = of, by, of.names, of.seed

    def draw(self, first, count):
        return self.of.draw(first, count) + self.by


def test_against_differences():
    study = study_from_plain(FINAL)
    work = FlightWork(study, block=8, lanes=8)
    found = final_gradients(work, 2, 5)
    assert found["x"].shape == (5, 3)
    spread = float(np.var(work.run(0, 8)["tilt"]))
    for k, h in enumerate((1e-5, 1e-5, 1e-5)):
        ends = []
        for sign in (1, -1):
            by = np.zeros(3)
            by[k] = sign * h
            # the compiled program takes the draws as they come
            object.__setattr__(study, "sampling", Shifted(study_from_plain(FINAL).sampling, by))
            ends.append(work.run(2, 5))
        for name, gradient in found.items():
            slope = (ends[0][name] - ends[1][name]) / (2 * h)
            assert gradient[:, k] == pytest.approx(slope, rel=2e-6, abs=2e-7), (name, k)
    factors = [study_from_plain(FINAL).sampling.factors[n] for n in study.sampling.names]
    measures = derivative_measures(found["tilt"], factors, spread)
    assert np.sum(measures.share) == pytest.approx(1.0)


def test_refused():
    study = study_from_plain(TURNING | {"quantities": {"t": {"signal": "tilt", "take": "largest"}}})
    with pytest.raises(SettingError, match="no final values"):
        final_gradients(FlightWork(study), 0, 1)
    single = study_from_plain(FINAL | {"precision": "float32", "rtol": 1e-5, "atol": 1e-5})
    with pytest.raises(SettingError, match="double precision"):
        final_gradients(FlightWork(dataclasses.replace(single)), 0, 1)
