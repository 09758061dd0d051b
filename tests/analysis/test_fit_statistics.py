"""Estimates of one quantity are compared as their covariance allows."""

import numpy as np
import pytest
from scipy import stats

from stmuav_jax.analysis.fit_statistics import compare_estimates


def test_estimates_that_agree_have_no_scatter():
    result = compare_estimates(np.array([1.0, 1.1, 0.9]), 0.01 * np.eye(3))
    assert result == (0.0, pytest.approx(0.368, abs=1e-3))
    scatter, p_value = compare_estimates(np.array([0.0, 4.0, -4.0]), 0.01 * np.eye(3))
    assert scatter == pytest.approx(4.0, rel=0.01)
    assert p_value < 1e-10


def test_what_estimates_share_does_not_make_them_disagree():
    """A common error is in no difference; a known covariance has infinite degrees of freedom."""
    values, own = np.array([1.0, 1.3, 0.8, 1.1]), np.diag([0.01, 0.04, 1e6, 0.02])
    alone, shared = compare_estimates(values, own), compare_estimates(values, own + 1e4)
    assert shared[1] == pytest.approx(alone[1], rel=1e-4)
    difference = values[:3] - values[3]
    Q = difference @ np.linalg.solve(own[:3, :3] + own[3, 3], difference)
    assert alone[1] == pytest.approx(stats.chi2.sf(Q, 3), rel=1e-9)
    assert compare_estimates(values, own, degrees=1e9)[1] == pytest.approx(alone[1], rel=1e-6)
    assert compare_estimates(values, own, degrees=4)[1] > alone[1]
