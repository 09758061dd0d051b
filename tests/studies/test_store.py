"""A study's store: the same files whatever the way, and nothing taken on trust."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from studies.toy import Toy, contents

from stmuav_jax import Study
from stmuav_jax.checks.errors import SettingError
from stmuav_jax.io.netcdf import FileError
from stmuav_jax.studies import Axis, Column
from stmuav_jax.studies.store import _list_differences, create_store, open_store, resume_store

WORK = Toy(seed=3)


def write_pending(store, work: Study = WORK, *, order=None) -> None:
    pieces = list(store.pending())
    for k in range(len(pieces)) if order is None else order:
        first, count = pieces[k]
        store.write(first, work.compute(first, count))


def make_store(path: Path, total=1000, order=None) -> Path:
    with create_store(path, WORK, total, 300) as store:
        write_pending(store, order=order)
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A complete store: 1000 samples in chunks of 300."""
    return make_store(tmp_path_factory.mktemp("whole") / "study.zarr")


@pytest.fixture
def copy(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "copy.zarr"))


def test_xarray_reads_a_store_with_missing_samples(tmp_path):
    path = make_store(tmp_path / "part.zarr", order=(0, 2))
    found = xr.open_zarr(path, consolidated=False)
    assert dict(found.sizes) == {"sample": 1000, "time": 5}
    assert found.y.attrs["units"] == "m^2"
    assert json.loads(found.status.attrs["meanings"])["2"] == "too near to zero"
    np.testing.assert_array_equal(np.flatnonzero(found.status.values == 0)[[0, -1]], [300, 999])
    assert np.all(np.isnan(found.x.values[300:600]))
    store = open_store(path)
    assert (store.total, store.finished) == (1000, 600)
    assert list(store.pending()) == [(300, 300), (900, 100)]
    data = store.load()
    assert set(data.data_vars) == {"x", "y", "path", "steps", "status"}
    np.testing.assert_array_equal(data["sample"], [*range(300), *range(600, 900)])
    np.testing.assert_array_equal(data["x"][300:], WORK.compute(600, 300)["x"])


def test_the_same_files_in_any_order_and_from_any_stage(whole, tmp_path):
    expected = contents(whole)
    assert contents(make_store(tmp_path / "order.zarr", order=(2, 0, 3, 1))) == expected
    grown = make_store(tmp_path / "grown.zarr", total=450)
    with resume_store(grown, WORK) as store:
        store.extend(1000)
        write_pending(store)
    assert contents(grown) == expected


def test_an_extension_that_is_broken_off_is_completed(whole, tmp_path, monkeypatch):
    path = make_store(tmp_path / "study.zarr", total=450)
    with resume_store(path, WORK) as store:
        resized = store._arrays["path"]
        monkeypatch.setattr(store, "_arrays", {"path": resized})
        store.extend(1000)
    with pytest.raises(FileError, match="is being extended to 1000 samples"):
        open_store(path)
    with resume_store(path, WORK) as store:
        write_pending(store)
    assert contents(path) == contents(whole)


def test_a_chunk_that_was_not_completed_is_computed_again(whole, tmp_path):
    """The status is written last: a killed process leaves columns without it."""
    path = make_store(tmp_path / "study.zarr")
    (path / "status" / "c" / "1").unlink()
    (path / "x" / "c" / "1.leftover.partial").write_bytes(b"half")
    with resume_store(path, WORK) as store:
        assert list(store.pending()) == [(300, 300)]
        write_pending(store)
    assert contents(path) == contents(whole)


class Every(Study):
    """Columns and axes as they are given, filled with small integers."""

    columns, axes, identity, reasons, unit = {}, {}, {}, {}, 1  # pyright: ignore

    def __init__(self, columns, axes=None, identity=None):
        vars(self).update(columns=columns, axes=axes or {}, identity=identity or {})

    def compute(self, first, count):
        rng = np.random.default_rng(first)
        shape = lambda c: (count, *(len(self.axes[d].values) for d in c.dims))
        return {
            name: rng.integers(0, 2, shape(column)).astype(column.dtype)
            for name, column in self.columns.items()
        }


STATUS = {"status": Column("int8", "1", "how it ended", "status")}
AXES = {"leg": Axis(np.arange(3), "1"), "time": Axis(np.array([0.0, 0.5]), "s")}
TYPES = ("bool", "int8", "uint16", "int64", "uint64", "float32", "float64", "complex128")


def test_every_type_and_axes(tmp_path):
    columns = {f"a_{t}": Column(t, "1", t, dims=("leg", "time")) for t in TYPES} | STATUS
    work = Every(columns, AXES, {"limit": float("inf"), "at": [1.5, None], "nan": float("nan")})
    with create_store(tmp_path / "s.zarr", work, 7, 4) as store:
        for first, count in list(store.pending()):
            store.write(first, work.compute(first, count) | {"status": np.ones(count, np.int8)})
    with resume_store(tmp_path / "s.zarr", work) as store:
        assert not list(store.pending())
        found = store.load()
    for name, values in work.compute(4, 3).items():
        if name != "status":
            np.testing.assert_array_equal(found[name].values[4:], values, strict=True)
    assert dict(found.sizes) == {"sample": 7, "leg": 3, "time": 2}


@pytest.mark.parametrize(
    ("columns", "axes", "words"),
    [
        ({}, {}, "needs a column 'status'"),
        ({"status": Column("int32", "1", "", "status")}, {}, "needs a column 'status'"),
        (STATUS | {"../x": Column("float64", "m", "")}, {}, "'../x' cannot name"),
        (STATUS | {"leg": Column("float64", "m", "")}, AXES, "'leg' cannot name"),
        (STATUS | {"x": Column("object", "m", "")}, {}, "'x' has type object"),
        (STATUS | {"x": Column("float64", "m", "", dims=("arm",))}, AXES, r"not given: \['arm'\]"),
        (STATUS, {"leg": Axis(np.array(["a"]), "1")}, "Axis 'leg' needs numbers"),
    ],
)
def test_columns_that_cannot_be_stored(columns, axes, words, tmp_path):
    with pytest.raises(SettingError, match=words):
        create_store(tmp_path / "s.zarr", Every(columns, axes), 10, 5)
    assert list(tmp_path.iterdir()) == []


def test_samples_other_than_the_study_says_are_refused(tmp_path):
    with create_store(tmp_path / "s.zarr", WORK, 10, 5) as store:
        arrays = WORK.compute(0, 5)
        with pytest.raises(SettingError, match="chunk has the columns"):
            store.write(0, {"x": arrays["x"]})
        with pytest.raises(
            SettingError, match=r"column 'y' is float32 \(5,\), but the study declares"
        ):
            store.write(0, arrays | {"y": arrays["y"].astype(np.float32)})
        assert store.finished == 0
    with pytest.raises(SettingError, match="open for reading only"):
        open_store(tmp_path / "s.zarr").write(0, arrays)
    with pytest.raises(SettingError, match="identity must be plain data"):
        create_store(tmp_path / "t.zarr", Every(STATUS, identity={"f": object()}), 10, 5)
    with pytest.raises(FileError, match=r"s\.zarr exists: resume it, or give another name"):
        create_store(tmp_path / "s.zarr", WORK, 10, 5)


def test_one_run_writes(copy):
    with resume_store(copy, WORK):
        assert open_store(copy).finished == 1000
        with pytest.raises(FileError, match="being written by another run"):
            resume_store(copy, WORK)
    resume_store(copy, WORK).close()


def test_stores_of_other_studies_are_refused(copy, monkeypatch):
    with pytest.raises(FileError, match=r"another study: seed is 3 there and 4 here\.$"):
        resume_store(copy, Toy(seed=4))
    with pytest.raises(FileError, match=r"another study: column\.z0 is not given there and"):
        resume_store(copy, Toy(seed=3, more=1))
    versions = open_store(copy).versions | {"jax": "0.0.1"}
    with pytest.raises(FileError, match=r"computed by other code.*versions\.jax is .*0\.0\.1"):
        resume_store(copy, WORK, versions)
    # all of these have let go of the store
    resume_store(copy, WORK).close()


@pytest.mark.parametrize("use", [open_store, lambda path: resume_store(path, WORK)])
def test_folders_that_are_no_stores(tmp_path, use):
    (tmp_path / "note.txt").write_text("mine")
    for path in (tmp_path / "none", tmp_path, tmp_path / "note.txt"):
        with pytest.raises(FileError, match=path.name):
            use(path)
    assert (tmp_path / "note.txt").read_text() == "mine"


@pytest.mark.slow
def test_damage_is_found_and_the_file_named(copy, tmp_path):
    for name in contents(copy):
        damaged = Path(shutil.copytree(copy, tmp_path / "damaged.zarr"))
        file = damaged / name
        os.truncate(file, file.stat().st_size // 2)
        with pytest.raises(FileError, match="zarr"):
            open_store(damaged).load()
        with pytest.raises(FileError, match="zarr"):
            resume_store(damaged, WORK)
        shutil.rmtree(damaged)
    file = copy / "y" / "c" / "1"
    content = bytearray(file.read_bytes())
    content[17] ^= 4
    file.write_bytes(bytes(content))
    with pytest.raises(FileError, match=r"y/c/1 was truncated or altered: .*Delete it and"):
        open_store(copy).load()
    file.unlink()
    with pytest.raises(FileError, match=r"There is no file .*y/c/1, though its chunk is complete"):
        open_store(copy).load()
    # the advice works
    (copy / "status" / "c" / "1").unlink()
    with resume_store(copy, WORK) as store:
        write_pending(store)
    assert open_store(copy).load().sizes["sample"] == 1000


@pytest.mark.parametrize(
    ("number", "advice"), [(28, "free space on the disk"), (30, "make the folder writable")]
)
def test_a_disk_that_fails_keeps_what_was_written(whole, tmp_path, monkeypatch, number, advice):
    import zarr

    path, original = tmp_path / "study.zarr", zarr.Array.__setitem__

    def fail(array, key, values):
        if array.name == "/steps" and key.start == 600:
            raise OSError(number, os.strerror(number))
        original(array, key, values)

    with create_store(path, WORK, 1000, 300) as store, monkeypatch.context() as patch:
        patch.setattr(zarr.Array, "__setitem__", fail)
        with pytest.raises(FileError, match=f"keeps 600 of 1000 samples. .*{advice} first"):
            write_pending(store)
    with resume_store(path, WORK) as store:
        write_pending(store)
    assert contents(path) == contents(whole)


def test_a_difference_far_into_a_long_value_is_shown():
    factors = [{"name": "F", "distribution": "uniform", "low": 1.0, "high": 2.0}]
    sides = []
    for high in (2.0, 3.0):
        identity = {"sampling": {"factors": [factors[0] | {"high": high, "note": "x" * 60}]}}
        empty = dict.fromkeys(("layout", "reasons", "versions"), "{}")
        sides.append({"identity": json.dumps(identity), **empty})
    (difference,) = _list_differences(*sides)
    there, here = difference.split(" there and ")
    assert '"high": 2.0' in there
    assert '"high": 3.0' in here
    assert len(difference) < 180
