"""Ready studies and those of estimation."""

import numpy as np
import pytest

from stmuav_jax import SettingError
from stmuav_jax.montecarlo.estimates import BLOCK, EstimationStudy, EstimationWork
from stmuav_jax.montecarlo.examples import READY, make_work, ready
from stmuav_jax.quadrotor import consistent_tuning, study_case


@pytest.mark.parametrize("name", READY)
def test_every_ready_study_is_a_study(name):
    plain = ready(name)
    work = make_work(plain)
    assert work.identity["name"] == name
    roles = [column.role for column in work.columns.values()]
    assert roles.count("status") == 1
    assert all(axis in work.axes for c in work.columns.values() for axis in c.dims)
    assert plain["samples"] >= 1000


def test_estimation_is_that_of_the_case_study():
    work = EstimationWork(EstimationStudy("few", 3, t1=0.6, seed=11))
    found = work.run(5, 8)
    assert np.all(found["seed"] == 16 + np.arange(8))
    tuning = consistent_tuning(3)
    study = study_case(3, [tuning], seeds=BLOCK, t1=0.6, seed=11)
    error = np.asarray(study.estimates["consistent"].error)[:, 3:, 5:13]
    assert found["error_x"][:, -1] == pytest.approx(error[19::20, 0][-1], abs=0)
    # 60 % of a run that ends before 2 s
    settled = np.asarray(study.record.t)[1:] > 0.36
    assert found["rmse_y"] == pytest.approx(np.sqrt(np.mean(error[settled, 1] ** 2, axis=0)))
    again = work.run(7, 2)
    for name, values in again.items():
        assert np.array_equal(values, found[name][2:4]), name


def test_refusals():
    with pytest.raises(SettingError, match="Did you mean 'collapse'"):
        ready("colapse")
    with pytest.raises(SettingError, match="'case' must be at most 8, but it is 9"):
        EstimationStudy("x", 9)
    with pytest.raises(SettingError, match="no entry 'tunning'"):
        make_work({"kind": "estimation", "case": 1, "tunning": "report"})
    with pytest.raises(SettingError, match="flights or estimation"):
        make_work({"kind": "walks"})
