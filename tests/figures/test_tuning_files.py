"""Searches as files: what comes back is what was saved, and nothing else is taken for it."""

import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.algebra.least_squares import Search, SearchReason
from stmuav_jax.figures.tuning import load_search, loss_history, save_search
from stmuav_jax.files.netcdf import FileError


@pytest.fixture
def found():
    values = {"a": jnp.arange(3.0), "b": jnp.asarray(2.0)}
    return Search(values, 0.5, (2.0, 0.5, float("nan")), 1, SearchReason.NOT_FINITE)


def test_there_and_back(found, tmp_path):
    path = save_search(found, "a problem", tmp_path / "search.npz")
    back = load_search(path, "a problem", found.values)
    assert (back.loss, back.best, back.reason) == (0.5, 1, SearchReason.NOT_FINITE)
    np.testing.assert_array_equal(back.history, found.history)
    np.testing.assert_array_equal(back.values["a"], found.values["a"])
    assert loss_history(found.history).axes[0].get_xlabel() == "step"


def test_refused(found, tmp_path):
    path = save_search(found, "a problem", tmp_path / "search.npz")
    with pytest.raises(FileError, match="another problem: 'a problem', not 'another'"):
        load_search(path, "another", found.values)
    with pytest.raises(FileError, match=r"where .* are wanted"):
        load_search(path, "a problem", {"a": jnp.zeros(2), "b": jnp.zeros(())})
    with pytest.raises(FileError, match="no file"):
        load_search(tmp_path / "none.npz", "a problem", found.values)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(FileError, match="not a search, or it is damaged"):
        load_search(path, "a problem", found.values)
