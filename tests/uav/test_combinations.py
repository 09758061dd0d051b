"""What a record determines only together with something else is named."""

import numpy as np
import pytest

from stmuav_jax.uav.flight_identification.combinations import (
    describe_combinations,
    find_combinations,
)


def test_a_sum_that_is_known_better_than_its_terms_is_found():
    """Readings of a + 2 b with deviations of 0.1, and of a - b with 50; c is determined by itself."""
    rows = np.array([[1.0, 2.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]]) / [[0.1], [50.0], [0.2]]
    covariance = np.linalg.inv(rows.T @ rows)
    values = np.array([3.0, 4.0, 5.0])
    (only,) = find_combinations(values, covariance, np.ones(3))
    np.testing.assert_allclose(only.weights, [0.5, 1.0, 0.0], atol=1e-4)
    assert only.value == pytest.approx(5.5, abs=1e-3)
    assert only.deviation == pytest.approx(0.05, rel=1e-3)
    words = describe_combinations("abc", "N", values, covariance, np.ones(3))
    assert words == " Only 0.5 a + b = 5.5 +- 0.05 N is determined."


def test_units_do_not_matter():
    """The same with b in thousandths."""
    covariance = np.array([[4.0, -3.99], [-3.99, 4.0]])
    scale = np.array([1.0, 1000.0])
    (plain,) = find_combinations(np.array([1.0, 2.0]), covariance, np.ones(2))
    (scaled,) = find_combinations(scale * [1.0, 2.0], covariance * np.outer(scale, scale), scale)
    weights = scaled.weights * scale
    np.testing.assert_allclose(weights / np.max(weights), plain.weights / np.max(plain.weights))
    assert scaled.deviation / scaled.value == pytest.approx(plain.deviation / plain.value)


def test_nothing_is_named_where_nothing_is_known_together():
    wide, narrow = 9.0 * np.eye(2), 0.01 * np.eye(2)
    assert find_combinations(np.zeros(2), wide, np.ones(2)) == []
    words = "No combination of them is determined either."
    assert words in describe_combinations("ab", "N", np.zeros(2), wide, np.ones(2))
    assert describe_combinations("ab", "N", np.zeros(2), narrow, np.ones(2)) == ""
    assert describe_combinations("ab", "N", np.zeros(2), np.diag([9, 0.01]), np.ones(2)) == ""
