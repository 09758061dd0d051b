"""Ready studies and those of estimation."""

import numpy as np
import pytest

from stmuav_jax import SettingError
from stmuav_jax.studies import READY, load_builtin_study, make_study
from stmuav_jax.studies.estimates import LANES
from stmuav_jax.studies.study_file import check_study
from stmuav_jax.uav import consistent_tuning, study_case


@pytest.mark.parametrize(
    "name", ["collapse", "estimate_5", pytest.param("hover", marks=pytest.mark.slow)]
)
def test_every_kind_of_ready_study_is_a_study(name):
    plain = load_builtin_study(name)
    study = make_study(plain)
    assert study.identity["name"] == name
    assert study.samples == plain["samples"]
    roles = [column.role for column in study.columns.values()]
    assert roles.count("status") == 1
    assert all(axis in study.axes for c in study.columns.values() for axis in c.dims)


def test_ready_studies_fit_the_schema():
    for name, entries in READY.items():
        check_study(load_builtin_study(name))
        assert entries["samples"] >= 1000


@pytest.mark.slow
def test_estimation_is_that_of_the_case_study():
    few = make_study({"kind": "estimation", "name": "few", "case": 3, "t1": 0.6, "seed": 11})
    assert few.identity["settled"] == 0.36
    found = few.compute(5, 8)
    assert np.all(found["seed"] == 16 + np.arange(8))
    tuning = consistent_tuning(3)
    study = study_case(3, [tuning], seeds=LANES, t1=0.6, seed=11)
    error = np.asarray(study.estimates["consistent"].error)[:, 3:, 5:13]
    # one program for truth and filter, which rounds otherwise than two
    assert found["error_x"][:, -1] == pytest.approx(error[19::20, 0][-1], rel=1e-9)
    # 60 % of a run that ends before 2 s
    settled = np.asarray(study.record.t)[1:] > 0.36
    assert found["rmse_y"] == pytest.approx(np.sqrt(np.mean(error[settled, 1] ** 2, axis=0)))
    again = few.compute(7, 2)
    for name, values in again.items():
        assert np.array_equal(values, found[name][2:4]), name


def test_refusals():
    with pytest.raises(SettingError, match="Did you mean 'collapse'"):
        load_builtin_study("colapse")
    with pytest.raises(SettingError, match="'case' must be at most 8, but it is 9"):
        make_study({"kind": "estimation", "case": 9})
    with pytest.raises(SettingError, match="no entry 'tunning'"):
        make_study({"kind": "estimation", "case": 1, "tunning": "report"})
    with pytest.raises(SettingError, match="kind is flights, estimation"):
        make_study({"kind": "walks"})
