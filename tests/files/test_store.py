"""A study's store: the same files whatever the way, and nothing taken on trust."""

import dataclasses
import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
import zarr.storage
from jobs.toy import Toy, contents

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.files import chunks as chunks_module, layout as layout_module, store as store_module
from stmuav_jax.files.netcdf import FileError
from stmuav_jax.files.store import create, open_store, resume_store
from stmuav_jax.montecarlo.work import AbstractWork, Axis, Column

WORK = Toy(seed=3)


def fill(store, *, order=None):
    for chunk in store.pending if order is None else order:
        store.write(chunk, WORK.run(*store.todo(chunk)))


def made(path, total=1000, chunk=300, order=None):
    with create(path, WORK, total, chunk) as store:
        fill(store, order=order)
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A complete store: 1000 samples in chunks of 300."""
    return made(tmp_path_factory.mktemp("whole") / "study.zarr")


@pytest.fixture
def copy(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "copy.zarr"))


def test_xarray_reads_it(tmp_path):
    path = made(tmp_path / "part.zarr", order=(0, 2))
    found = xr.open_zarr(path, consolidated=False)
    assert dict(found.sizes) == {"sample": 1000, "time": 5}
    truth = WORK.run(0, 1000)
    there = np.r_[0:300, 600:900]
    missing = np.setdiff1d(np.arange(1000), there)
    for name, values in truth.items():
        np.testing.assert_array_equal(found[name].values[there], values[there], strict=True)
    for name in ("x", "y", "path"):
        assert np.isnan(found[name].values[missing]).all()
    assert (found["status"].values[missing] == 0).all()
    assert (found["steps"].values[missing] == np.iinfo(np.int32).min).all()
    attributes = found["y"].attrs
    assert attributes == {"units": "m^2", "long_name": "its square", "role": "quantity"}
    codes = json.loads(found["status"].attrs["meanings"])
    assert codes == {"0": "missing", "1": "fine", "2": "too near to zero"}
    np.testing.assert_array_equal(found["time"].values, np.linspace(0, 1, 5))
    assert json.loads(found.attrs["identity"])["law"] == {"power": 2, "limit": 0.1}
    assert {"jax", "numpy", "stmuav-jax", "device"} <= set(json.loads(found.attrs["versions"]))


def test_chunks_are_plain_numbers(whole):
    """Read without Zarr: little-endian, a CRC-32C behind, the last chunk filled up with NaN."""
    raw = (whole / "y" / "c" / "3").read_bytes()
    assert len(raw) == 300 * 8 + 4
    numbers = np.frombuffer(raw[:-4], "<f8")
    np.testing.assert_array_equal(numbers[:100], WORK.run(900, 100)["y"])
    assert np.isnan(numbers[100:]).all()
    record = json.loads((whole / "records" / "3" / "zarr.json").read_text())["attributes"]
    assert record["samples"] == 100
    assert record["sha256"]["y"] == hashlib.sha256(raw[:800]).hexdigest()


def test_finished_samples_by_number(tmp_path):
    path = made(tmp_path / "part.zarr", order=(3, 1))
    store = open_store(path)
    assert (store.total, store.finished, store.pending) == (1000, 400, (0, 2))
    found = store.dataset(["y", "status"])
    assert set(found.data_vars) == {"y", "status"}
    numbers = np.r_[300:600, 900:1000]
    np.testing.assert_array_equal(found["sample"].values, numbers)
    np.testing.assert_array_equal(found["y"].values, WORK.run(0, 1000)["y"][numbers])
    assert (found.attrs["total"], found.attrs["finished"]) == (1000, 400)
    assert found["sample"].attrs["units"] == "1"
    xr.testing.assert_identical(store.load(["y", "status"]), found.load())
    with pytest.raises(SettingError, match=r"no column 'statu'.* Did you mean 'status'"):
        store.dataset(["statu"])


def test_nothing_is_read_early(copy):
    shutil.rmtree(copy / "path" / "c")
    store = open_store(copy)
    assert store.dataset().sizes["sample"] == 1000
    assert np.isfinite(store.dataset()["x"].values).all()
    assert np.isfinite(store.load(["x"])["x"].values).all()
    with pytest.raises(FileError, match=r"no file .*path/c/0/0"):
        store.load()


def test_the_same_files_in_any_order_and_from_any_stage(whole, tmp_path, monkeypatch):
    want = contents(whole)
    assert contents(made(tmp_path / "order.zarr", order=(2, 0, 3, 1))) == want
    grown = made(tmp_path / "grown.zarr", total=450)
    with resume_store(grown, WORK) as store:
        store.extend(650)
        fill(store)
        store.extend(1000)
        assert store.todo(2) == (650, 250)
        fill(store)
    assert contents(grown) == want
    # broken off between files and record: the chunk counts as missing, and is written again
    broken = tmp_path / "broken.zarr"
    with create(broken, WORK, 1000, 300) as store:
        fill(store, order=(0,))
        with monkeypatch.context() as patch:
            patch.setattr(store_module, "write_record", lambda *_: None)
            store.write(3, WORK.run(900, 100))
    (broken / "y" / "c" / "3").write_bytes(b"torn")
    (broken / "x" / "c" / "1.0123.partial").write_bytes(b"left over")
    (broken / "records" / "0" / ".zarr.json.x1").write_bytes(b"left over")
    with resume_store(broken, WORK) as store:
        assert store.pending == (1, 2, 3)
        fill(store)
    assert contents(broken) == want


def test_an_extension_that_is_broken_off(whole, tmp_path, monkeypatch):
    path = made(tmp_path / "study.zarr", total=400)

    class TornError(RuntimeError):
        pass

    def flush(files):
        raise TornError

    # in the middle of the arrays, as a kill would
    with resume_store(path, WORK) as store:
        torn = _torn_after(2, store_module.lengthen, TornError)
        monkeypatch.setattr(store_module, "lengthen", torn)
        with pytest.raises(TornError):
            store.extend(1000)
        monkeypatch.undo()
    with pytest.raises(FileError, match="being extended to 1000 samples"):
        open_store(path)
    with resume_store(path, WORK) as store:
        assert (store.total, store.finished) == (1000, 400)
        # and then while the chunk that was the last is filled up: what it had stays
        monkeypatch.setattr(store_module, "flush", flush)
        with pytest.raises(TornError):
            fill(store, order=(1,))
        monkeypatch.undo()
    with resume_store(path, WORK) as store:
        assert store.finished == 400
        np.testing.assert_array_equal(store.load()["x"].values, WORK.run(0, 400)["x"])
        fill(store)
    assert contents(path) == contents(whole)


def _torn_after(count, function, error):
    calls = []

    def torn(*arguments):
        calls.append(1)
        if len(calls) > count:
            raise error
        return function(*arguments)

    return torn


def test_chunks_without_a_number_have_files(tmp_path):
    """All missing looks like what Zarr leaves out; a record must find its files."""

    with create(tmp_path / "nan.zarr", WORK, 10, 5) as store:
        arrays = WORK.run(0, 5)
        arrays["y"][:] = np.nan
        arrays["path"][:] = np.nan
        store.write(0, arrays)
        store.verify()
        assert np.isnan(store.load()["y"].values).all()


@dataclasses.dataclass(frozen=True)
class Every(AbstractWork):
    """A column of each type, on two axes."""

    named: Mapping[str, Column] = dataclasses.field(default_factory=dict)
    lines: Mapping[str, Axis] = dataclasses.field(default_factory=dict)
    facts: Mapping[str, object] = dataclasses.field(default_factory=dict)

    @property
    def identity(self):
        return self.facts

    @property
    def columns(self):
        return self.named

    @property
    def axes(self):
        return self.lines

    @property
    def reasons(self):
        return {}

    @property
    def unit(self):
        return 1

    def run(self, first, count):
        rng = np.random.default_rng(first)
        shape = lambda c: (count, *(len(self.lines[d].values) for d in c.dims))
        return {
            name: rng.integers(0, 2, shape(column)).astype(column.dtype)
            for name, column in self.named.items()
        }


STATUS = {"status": Column("int8", "1", "how it ended", "status")}
AXES = {"leg": Axis(np.arange(3), "1"), "time": Axis(np.array([0.0, 0.5]), "s")}
TYPES = ("bool", "int8", "uint16", "int64", "uint64", "float32", "float64", "complex128")


def test_every_type_and_axes(tmp_path):
    named = {f"a_{t}": Column(t, "1", t, dims=("leg", "time")) for t in TYPES} | STATUS
    work = Every(named, AXES, {"limit": float("inf"), "at": [1.5, None], "nan": float("nan")})
    with create(tmp_path / "s.zarr", work, 7, 4) as store:
        for chunk in store.pending:
            store.write(chunk, work.run(*store.todo(chunk)))
    with resume_store(tmp_path / "s.zarr", work) as store:
        assert not store.pending
        found = store.load()
    for name, values in work.run(4, 3).items():
        np.testing.assert_array_equal(found[name].values[4:], values, strict=True)
    assert dict(found.sizes) == {"sample": 7, "leg": 3, "time": 2}
    assert open_store(tmp_path / "s.zarr").layout.columns == named
    assert open_store(tmp_path / "s.zarr").layout.sample_bytes == 6 * 48 + 1


@pytest.mark.parametrize(
    ("columns", "axes", "words"),
    [
        ({}, {}, "needs a column 'status'"),
        ({"status": Column("int32", "1", "", "status")}, {}, "needs a column 'status'"),
        (STATUS | {"../x": Column("float64", "m", "")}, {}, "'../x' cannot name"),
        (STATUS | {"sample": Column("float64", "m", "")}, {}, "'sample' cannot name"),
        (STATUS | {"leg": Column("float64", "m", "")}, AXES, "'leg' cannot name"),
        (STATUS | {"x": Column("object", "m", "")}, {}, "'x' has type object"),
        (STATUS | {"x": Column("float64", "m", "", dims=("arm",))}, AXES, r"not given: \['arm'\]"),
        (STATUS, {"leg": Axis(np.array(["a"]), "1")}, "Axis 'leg' needs numbers"),
    ],
)
def test_columns_that_cannot_be_stored(columns, axes, words, tmp_path):
    with pytest.raises(SettingError, match=words):
        create(tmp_path / "s.zarr", Every(columns, axes), 10, 5)
    assert list(tmp_path.iterdir()) == []


def test_settings_that_cannot_be(copy, tmp_path):
    with pytest.raises(SettingError, match="samples must be 1 or more, not 0"):
        create(tmp_path / "s.zarr", WORK, 0, 5)
    with pytest.raises(SettingError, match="identity must be plain data"):
        create(tmp_path / "s.zarr", Every(STATUS, {}, {"f": np.sin}), 1, 5)
    with pytest.raises(FileError, match=r"copy\.zarr exists; go on"):
        create(copy, WORK, 1000, 300)
    with pytest.raises(SettingError, match="opened to read"):
        open_store(copy).extend(2000)
    with resume_store(copy, WORK) as store:
        with pytest.raises(SettingError, match="can grow, not shrink to 10"):
            store.extend(10)
        with pytest.raises(SettingError, match="is complete"):
            store.write(0, WORK.run(0, 300))
        with pytest.raises(SettingError, match="no chunk 4 among 4"):
            store.todo(4)
        store.extend(1300)
        good = WORK.run(1000, 200)
        for bad, words in (
            ({**good, "z": good["x"]}, "gave columns"),
            ({**good, "x": good["x"][1:]}, r"'x' is float64 \(199,\) where .* float64 \(200,\)"),
            ({**good, "x": good["x"].astype("f4")}, "Samples 1000 to 1199: column 'x' is float32"),
        ):
            with pytest.raises(SettingError, match=words):
                store.write(3, bad)
        assert store.finished == 1000


def test_one_writer(copy):
    with resume_store(copy, WORK):
        assert open_store(copy).finished == 1000
        with pytest.raises(FileError, match="being written by another run"):
            resume_store(copy, WORK)
    resume_store(copy, WORK).close()


def edit(file, change):
    node = json.loads(file.read_text())
    change(node)
    file.write_text(json.dumps(node))


def test_stores_of_other_studies(copy, monkeypatch):
    other = Toy(seed=4)
    with pytest.raises(FileError, match=r"another study: seed is 3 there and 4 here\.$"):
        resume_store(copy, other)
    with pytest.raises(FileError, match=r"column\.z0\.dtype is not given there and"):
        resume_store(copy, Toy(seed=3, more=1))
    versions = open_store(copy).layout.versions
    with pytest.raises(FileError, match=r'version\.jax is "[0-9.]+" there and "9\.9" here'):
        resume_store(copy, WORK, {**versions, "jax": "9.9"})
    edit(copy / "zarr.json", lambda node: node["attributes"].update(format_version=2))
    for opened in (lambda: open_store(copy), lambda: resume_store(copy, WORK)):
        with pytest.raises(FileError, match="has format version 2; this package reads version 1"):
            opened()
    edit(copy / "zarr.json", lambda node: node["attributes"].pop("format"))
    with pytest.raises(FileError, match="not a study's store"):
        open_store(copy)


def test_folders_that_are_no_stores(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        open_store(tmp_path / "none")
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(FileError, match="holds no store"):
        resume_store(tmp_path, WORK)
    with pytest.raises(FileError, match="exists"):
        create(tmp_path, WORK, 10, 5)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]
    zarr.create_group(str(tmp_path / "foreign"), zarr_format=3)
    with pytest.raises(FileError, match="not a study's store"):
        open_store(tmp_path / "foreign")


def test_every_truncated_file_is_found(whole, tmp_path):
    """Each file of a store, cut in half or gone; the message names it, or its folder."""
    for name in contents(whole):
        for gone in (False, True):
            path = Path(shutil.copytree(whole, tmp_path / "cut.zarr"))
            file = path / name
            raw = file.read_bytes()
            file.unlink() if gone else file.write_bytes(raw[: len(raw) // 2])
            if gone and name.startswith("records/") and name != "records/zarr.json":
                # a chunk without a record is one to compute
                with resume_store(path, WORK) as store:
                    assert store.pending == (int(file.parent.name),)
            else:
                with pytest.raises(FileError) as caught:
                    resume_store(path, WORK)
                assert any(
                    str(p) in str(caught.value) for p in (file, file.parent, file.parents[1])
                )
            shutil.rmtree(path)


def test_every_altered_chunk_is_found(whole, tmp_path):
    """A bit anywhere in numbers, in what fills up the last chunk, or in the sums."""
    rng = np.random.default_rng(5)
    for name, raw in contents(whole).items():
        if "/c/" not in name:
            continue
        path = Path(shutil.copytree(whole, tmp_path / "bit.zarr"))
        for place in (*rng.integers(0, len(raw), 3), len(raw) - 1):
            altered = bytearray(raw)
            altered[place] ^= 1 << int(rng.integers(8))
            (path / name).write_bytes(altered)
            with pytest.raises(FileError, match="altered") as caught:
                resume_store(path, WORK)
            assert str(path / name.split("/c/")[0]) in str(caught.value)
        shutil.rmtree(path)


def test_altered_records_and_forged_chunks(copy):
    record = copy / "records" / "1" / "zarr.json"
    good = record.read_text()
    for change in (
        lambda a: a.update(samples=299),
        lambda a: a.update(samples=301),
        lambda a: a.update(samples="300"),
        lambda a: a["sha256"].update(x="0" * 64),
        lambda a: a["sha256"].pop("x"),
    ):
        edit(record, lambda node, change=change: change(node["attributes"]))
        with pytest.raises(FileError, match=r"records/1.*go on with the study"):
            resume_store(copy, WORK)
        record.write_text(good)
    # a whole chunk of another place has a right CRC, and the wrong sum
    shutil.copy(copy / "x" / "c" / "0", copy / "x" / "c" / "1")
    with pytest.raises(FileError, match=r"x/c/1 or .*SHA-256 differs"):
        resume_store(copy, WORK)
    # as the message says
    shutil.rmtree(record.parent)
    with resume_store(copy, WORK) as store:
        fill(store)
        store.verify()


@pytest.mark.parametrize(
    "change",
    [
        {"data_type": "object"},
        {"data_type": {"name": "variable_length_bytes"}},
        {"codecs": [{"name": "numcodecs.pickle"}]},
        {"codecs": [{"name": "bytes", "configuration": {"endian": "big"}}, {"name": "crc32c"}]},
    ],
)
def test_nothing_but_plain_numbers_is_opened(copy, change, monkeypatch):
    monkeypatch.setattr(zarr, "open_array", lambda *_, **__: pytest.fail("opened"))
    edit(copy / "x" / "zarr.json", lambda node: node.update(change))
    with pytest.raises(FileError, match=r"x/zarr\.json describes .* nothing of it was read"):
        open_store(copy)


def test_a_full_disk_is_said_and_survived(whole, tmp_path, monkeypatch):
    """The disk is full at each of the steps of a write in turn."""
    path = tmp_path / "study.zarr"
    create(path, WORK, 1000, 300).close()
    places = (
        (store_module, "flush"),
        (store_module, "write_record"),
        (zarr.storage.LocalStore, "set"),
        (chunks_module.os, "fsync"),
    )
    for module, name in places:
        with resume_store(path, WORK) as store:
            chunk = store.pending[0]
            with monkeypatch.context() as patch:
                patch.setattr(module, name, _full)
                words = rf"disk is full: .* keeps {300 * chunk} of 1000 samples"
                with pytest.raises(FileError, match=words):
                    store.write(chunk, WORK.run(*store.todo(chunk)))
            fill(store, order=(chunk,))
    assert contents(path) == contents(whole)


def test_a_store_that_cannot_be_made(tmp_path, monkeypatch):
    def interrupted(folder, layout):
        layout_module.write_layout(folder, layout)
        raise KeyboardInterrupt

    cases = (
        (zarr.storage.LocalStore, "set", _full, FileError),
        (store_module, "write_layout", interrupted, KeyboardInterrupt),
    )
    for where, name, what, seen in cases:
        with monkeypatch.context() as patch:
            patch.setattr(where, name, what)
            with pytest.raises(seen):
                create(tmp_path / "study.zarr", WORK, 10, 5)
        assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(FileError, match=r"file/study\.zarr cannot be made"):
        create(tmp_path / "file" / "study.zarr", WORK, 10, 5)


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EROFS, "may not be written .* Have it made writable"),
        (errno.EIO, "disk fails .* Repair"),
    ],
)
def test_other_faults_of_a_disk_have_their_own_advice(tmp_path, monkeypatch, number, words):
    path = tmp_path / "study.zarr"
    create(path, WORK, 1000, 300).close()

    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    with resume_store(path, WORK) as store:
        monkeypatch.setattr(store_module, "flush", fail)
        with pytest.raises(FileError, match=rf"{words} .*go on with the study") as error:
            store.write(0, WORK.run(*store.todo(0)))
    assert "keeps 0 of 1000 samples" in str(error.value)


def test_a_file_in_place_of_a_store(tmp_path):
    """It is not said to be missing."""
    (tmp_path / "study.zarr").write_text("x")
    for use in (open_store, lambda path: resume_store(path, WORK)):
        with pytest.raises(FileError, match="is no folder, as a study's store is"):
            use(tmp_path / "study.zarr")
    with pytest.raises(FileError, match="does not exist"):
        open_store(tmp_path / "none.zarr")


def _full(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


SMALL_DISK = """
import subprocess, sys
sys.path.insert(0, {tests!r})
from jobs.toy import Toy
from stmuav_jax.files.netcdf import FileError
from stmuav_jax.files.store import create, resume_store
subprocess.run(["mount", "-t", "tmpfs", "-o", "size={size}k", "tmpfs", {disk!r}], check=True)
work = Toy(seed=3)
store = create({disk!r} + "/study.zarr", work, 100000, 1000)
try:
    for chunk in store.pending:
        store.write(chunk, work.run(*store.todo(chunk)))
except FileError as error:
    print(error)
    print(store.finished)
store.close()
# make room
subprocess.run(["mount", "-o", "remount,size=100m", {disk!r}], check=True)
with resume_store({disk!r} + "/study.zarr", work) as store:
    print(store.finished)
    for chunk in store.pending[:3]:
        store.write(chunk, work.run(*store.todo(chunk)))
    store.verify()
print([p for p in __import__("pathlib").Path({disk!r}).rglob("*.partial")])
"""


def test_a_disk_that_is_full(tmp_path):
    """A real one of 1 MB, where the system lets us mount it."""
    if shutil.which("unshare") is None or subprocess.run(
        ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", str(tmp_path)],
        capture_output=True, check=False,
    ).returncode:  # fmt: skip
        pytest.skip("no disks can be mounted here")
    (tmp_path / "disk").mkdir()
    code = SMALL_DISK.format(
        tests=str(Path(__file__).parents[1]), disk=str(tmp_path / "disk"), size=1000
    )
    done = subprocess.run(
        ["unshare", "-rm", sys.executable, "-W", "error", "-c", code],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    words, kept, resumed, left = done.stdout.splitlines()
    assert f"disk is full: {tmp_path}/disk/study.zarr keeps {kept} of 100000 samples" in words
    assert 1000 <= int(kept) == int(resumed)
    assert left == "[]"


def test_files_are_flushed_before_the_record(tmp_path, monkeypatch):
    seen = []
    real = os.fsync

    def fsync(handle):
        seen.append(os.readlink(f"/proc/self/fd/{handle}"))
        real(handle)

    with create(tmp_path / "s.zarr", WORK, 10, 10) as store:
        monkeypatch.setattr(os, "fsync", fsync)
        fill(store)
    assert len(seen) == 6
    assert ".zarr.json" in seen[-1]
    assert {Path(name).parts[-3] for name in seen[:-1]} >= {"x", "y", "steps", "status"}


MAKERS = """
import sys
import time
sys.path.insert(0, {tests!r})
from jobs.toy import Toy
from stmuav_jax.checks.errors import SettingError
from stmuav_jax.files.netcdf import FileError
from stmuav_jax.files.store import create
import os
import time
versions = {{"what": "toy"}}
for k in range({times}):
    # both wait for the same instant
    time.sleep(max({begin} + 0.1 * k - 0.005 - time.time(), 0))
    while time.time() < {begin} + 0.1 * k:
        pass
    try:
        store = create({folder!r} + f"/{{k}}.zarr", Toy(seed=3), 1000, 300, versions)
        print("made", flush=True)
        store.close()
    except FileError as error:
        print(str(error).replace("\\n", " "), flush=True)
"""


@pytest.mark.slow
def test_two_processes_that_make_one_store(tmp_path):
    """Exactly one has it, the other says so; and what is there is a whole store."""
    times = 40
    begin = time.time() + 8.0
    code = MAKERS.format(
        tests=str(Path(__file__).parents[1]), times=times, begin=begin, folder=str(tmp_path)
    )
    started = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [process.communicate()[0].splitlines() for process in started]
    assert [process.returncode for process in started] == [0, 0]
    for k, two in enumerate(zip(*said, strict=True)):
        # one may be so late that the other has made its store and let go of it
        assert sorted(words == "made" for words in two) == [False, True], two
        other = next(words for words in two if words != "made")
        assert f"{k}.zarr exists" in other or "being written by another run" in other
        store = open_store(tmp_path / f"{k}.zarr")
        assert (store.total, store.finished) == (1000, 0)
    assert not list(tmp_path.glob(".*"))


def test_what_a_killed_maker_left_is_removed_when_it_is_old(tmp_path):
    old, new = (tmp_path / f".study.zarr.{name}.partial" for name in ("old", "new"))
    for folder in (old, new):
        folder.mkdir()
        (folder / "zarr.json").write_text("{}")
    os.utime(old, (0, 0))
    made(tmp_path / "study.zarr")
    assert not old.exists()
    assert new.exists()


def test_columns_come_in_the_studys_order(whole):
    assert list(open_store(whole).dataset().data_vars) == list(WORK.columns)
    assert list(open_store(whole).load(["y", "x"]).data_vars) == ["x", "y"]


def test_very_many_samples_answer_at_once(tmp_path):
    """Nothing goes through all chunks: making, opening, extending and asking what comes next."""
    begin = time.process_time()
    with create(tmp_path / "huge.zarr", WORK, 10**12, 100) as store:
        assert next(store.waiting()) == 0
        store.write(0, WORK.run(0, 100))
        assert next(store.waiting()) == 1
    made(tmp_path / "small.zarr")
    with resume_store(tmp_path / "small.zarr", WORK) as store:
        store.extend(10**12)
        assert next(store.waiting()) == 3
    opened = open_store(tmp_path / "huge.zarr")
    assert opened.load()["y"].size == 100
    assert time.process_time() - begin < 10.0
    with pytest.raises(SettingError, match="from 1 to 1,000,000,000,000"):
        create(tmp_path / "more.zarr", WORK, 10**31, 100)


def altered(path, change):
    """A description with something changed."""
    node = json.loads(path.read_text())
    change(node)
    path.write_text(json.dumps(node))


def put(*keys, value):
    def change(node):
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value

    return change


DEEP = '{"a":' * 5000 + "1" + "}" * 5000


def fifo(path):
    path.unlink()
    os.mkfifo(path)


def linked(path):
    path.rename(path.parent.parent / "elsewhere")
    path.symlink_to(path.parent.parent / "elsewhere")


def folder(path):
    path.unlink()
    path.mkdir()


TAMPERINGS = {
    "root total text": lambda p: altered(p / "zarr.json", put("attributes", "total", value="x")),
    "root total true": lambda p: altered(p / "zarr.json", put("attributes", "total", value=True)),
    "root total inf": lambda p: altered(p / "zarr.json", put("attributes", "total", value=1e400)),
    "root total 0": lambda p: altered(p / "zarr.json", put("attributes", "total", value=0)),
    "root total 2^70": lambda p: altered(p / "zarr.json", put("attributes", "total", value=2**70)),
    "root total 1e30": lambda p: altered(p / "zarr.json", put("attributes", "total", value=10**30)),
    "root chunk 0": lambda p: altered(p / "zarr.json", put("attributes", "chunk", value=0)),
    "root chunk 7": lambda p: altered(p / "zarr.json", put("attributes", "chunk", value=7)),
    "root columns": lambda p: altered(p / "zarr.json", put("attributes", "columns", value=3)),
    "root column of another folder": lambda p: altered(
        p / "zarr.json", put("attributes", "columns", value=["../../etc"])
    ),
    "root identity": lambda p: altered(p / "zarr.json", put("attributes", "identity", value="{")),
    "root reasons": lambda p: altered(p / "zarr.json", put("attributes", "reasons", value='{"a":1}')),
    "root deep": lambda p: (p / "zarr.json").write_text(DEEP),
    "root fifo": lambda p: fifo(p / "zarr.json"),
    "root empty": lambda p: (p / "zarr.json").write_text(""),
    "column deep": lambda p: (p / "y" / "zarr.json").write_text(DEEP),
    "column fifo": lambda p: fifo(p / "y" / "zarr.json"),
    "column shape": lambda p: altered(p / "y" / "zarr.json", put("shape", value=[])),
    "column shape 1e30": lambda p: altered(p / "y" / "zarr.json", put("shape", value=[10**30])),
    "column shape text": lambda p: altered(p / "y" / "zarr.json", put("shape", value=["1000"])),
    "column longer": lambda p: altered(p / "y" / "zarr.json", put("shape", value=[1001])),
    "column missing": lambda p: shutil.rmtree(p / "y"),
    "column linked": lambda p: linked(p / "y"),
    "chunks linked": lambda p: linked(p / "y" / "c"),
    "records linked": lambda p: linked(p / "records"),
    "record linked": lambda p: linked(p / "records" / "1"),
    "axis shape": lambda p: altered(p / "time" / "zarr.json", put("shape", value=[10**6])),
    "axis shape 1e10": lambda p: altered(p / "time" / "zarr.json", put("shape", value=[10**10])),
    "axis both shapes": lambda p: altered(
        p / "time" / "zarr.json",
        lambda node: (put("shape", value=[10**9])(node),
                      put("chunk_grid", "configuration", "chunk_shape", value=[10**9])(node)),
    ),
    "axis missing": lambda p: (p / "time" / "c" / "0").unlink(),
    "record samples": lambda p: altered(
        p / "records" / "1" / "zarr.json", put("attributes", "samples", value=10**40)
    ),
    "record sums": lambda p: altered(
        p / "records" / "1" / "zarr.json", put("attributes", "sha256", value=3)
    ),
    "record name": lambda p: (p / "records" / "1").rename(p / "records" / ("9" * 5000)[:200]),
    "record deep": lambda p: (p / "records" / "1" / "zarr.json").write_text(DEEP),
    "chunk missing": lambda p: (p / "y" / "c" / "1").unlink(),
    "status missing": lambda p: (p / "status" / "c" / "1").unlink(),
    "input missing": lambda p: (p / "x" / "c" / "1").unlink(),
    "chunk folder": lambda p: folder(p / "y" / "c" / "1"),
    "chunk fifo": lambda p: fifo(p / "y" / "c" / "1"),
    "chunk truncated": lambda p: os.truncate(p / "y" / "c" / "1", 100),
    "chunk byte": lambda p: _flip(p / "y" / "c" / "1"),
    "chunk forged": lambda p: _forge(p / "y" / "c" / "1"),
}  # fmt: skip


def _flip(path):
    content = bytearray(path.read_bytes())
    content[17] ^= 4
    path.write_bytes(bytes(content))


def _forge(path):
    """Other numbers with the right CRC-32C."""
    import google_crc32c

    content = bytearray(path.read_bytes()[:-4])
    content[17] ^= 4
    path.write_bytes(bytes(content) + google_crc32c.value(bytes(content)).to_bytes(4, "little"))


@pytest.mark.parametrize("how", TAMPERINGS)
def test_tampered_stores(copy, how, capsys, monkeypatch):
    """Loading, resuming and reporting say what is wrong, at once and without a traceback."""
    from stmuav_jax.cli import main

    TAMPERINGS[how](copy)
    before = contents(copy.parent) if "fifo" not in how else {}
    begin = time.process_time()
    with pytest.raises(FileError) as caught:
        open_store(copy).load()
    assert len(str(caught.value)) < 1200
    with pytest.raises(FileError):
        resume_store(copy, WORK)
    assert main(["report", str(copy), "--out", str(copy.parent / "report")]) == 2
    assert "copy.zarr" in "".join(capsys.readouterr().err.split())
    assert time.process_time() - begin < 20.0
    assert not (copy.parent / "report").exists()
    # nothing was repaired in silence
    if before:
        after = contents(copy.parent)
        assert all(
            after.get(name) == value for name, value in before.items() if "elsewhere" in name
        )
