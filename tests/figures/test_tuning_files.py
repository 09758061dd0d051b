"""Searches as files: what comes back is what was saved, and nothing else is taken for it."""

import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.figures.tuning import load_search, loss_history, save_search
from stmuav_jax.io.netcdf import FileError, load_checkpoint, save_checkpoint
from stmuav_jax.math.least_squares import Search, SearchReason


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
    with pytest.raises(FileError, match=r"but .* are needed"):
        load_search(path, "a problem", {"a": jnp.zeros(2), "b": jnp.zeros(())})
    with pytest.raises(FileError, match="no file"):
        load_search(tmp_path / "none.npz", "a problem", found.values)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(FileError, match="cannot be read: it is truncated, damaged"):
        load_search(path, "a problem", found.values)


def test_heads_and_values_of_other_programs_are_refused(found, tmp_path):
    """A seal says that a file is as it was written, not that it was written by `save_search`."""
    path = save_search(found, "a problem", tmp_path / "search.npz")
    head, arrays = load_checkpoint(path, "a search")
    for changed, words in (
        ({"problem": None}, "needs 'problem'"),
        ({"reason": 99}, "'reason' must be at most 5, but it is 99"),
        ({"history": [1.0, None]}, "'history.1' must be a number"),
        ({"best": 3}, "a best step beyond its last"),
        ({"more": 1}, "no entry 'more'"),
    ):
        other = {name: value for name, value in (head | changed).items() if value is not None}
        save_checkpoint(path, other, arrays)
        with pytest.raises(FileError, match=words):
            load_search(path, "a problem", found.values)
    save_checkpoint(path, head, arrays[:1])
    with pytest.raises(FileError, match=r"but .* are needed"):
        load_search(path, "a problem", found.values)
    save_checkpoint(path, head, [arrays[0] * np.nan, arrays[1]])
    with pytest.raises(FileError, match="not finite"):
        load_search(path, "a problem", found.values)
