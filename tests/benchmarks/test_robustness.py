"""The benchmark of a mission's robustness: what it draws, and how its share is counted."""

import missions
import numpy as np
import pytest


@pytest.mark.slow
def test_its_study_draws_every_mass_and_inertia_and_its_flights_are_counted():
    study = missions.make_study(0.1)
    assert {"mass.panel_7", "inertia.hexacopter_1", "rotor.k_f"} <= set(study.sampling.names)
    drawn = study.sampling.draw(0, 4000)
    assert drawn.shape == (4000, len(missions.FACTORS))
    # a normal variable truncated at four standard deviations keeps 99.9 % of its own
    assert np.std(drawn) == pytest.approx(0.05, rel=0.01)
    assert np.max(np.abs(drawn - 1.0)) <= 0.2
    given = study.evaluate.mission.file
    assert (given.tolerances.position, given.tolerances.tilt) == (0.5, 15.0)
    assert given.sensors is not None
    assert given.sensors.standing == 3.0
    columns = {name: np.full(100, 0.1) for name in study.columns}
    columns["status"] = np.where(np.arange(100) < 98, 1, 3)
    columns["met"] = np.where(np.arange(100) < 97, 1, 0)
    found = missions.share(columns)
    assert (found["kept"], found["not_finite"], found["share"]) == (97, 2, 0.97)
    # Wilson (1927), by hand: (p + z^2 / 2n -+ z sqrt(p q / n + z^2 / 4n^2)) / (1 + z^2 / n)
    assert found["share_low"] == pytest.approx(0.9155, abs=1e-4)
    assert found["share_high"] == pytest.approx(0.9897, abs=1e-4)
