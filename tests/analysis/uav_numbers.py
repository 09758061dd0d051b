"""Stored numbers of the UAV, computed by an earlier commit, and the comparison with them.

The package was rebuilt after commit c20d375: other rooms, other names, one state space for every
mechanism. `uav_numbers.json` has the numbers of that commit and says how they were made.
"""

import json
from pathlib import Path

import numpy as np

STORED = json.loads((Path(__file__).parent / "uav_numbers.json").read_text())
# of the largest number of an array
EQUAL = 1e-10


def same(found, stored, *, axis=None):
    """Assert that arrays agree, along an axis each with a largest number of its own."""
    found, stored = np.asarray(found), np.array(stored)
    size = np.max(np.abs(stored), axis=axis, keepdims=axis is not None)
    assert found.shape == stored.shape
    np.testing.assert_array_less(np.abs(found - stored) / np.where(size == 0, 1, size), EQUAL)
