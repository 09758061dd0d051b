"""Studies of a function of one's own: its outcomes, its failures, its identity and its store."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import stmuav_jax as stm
from stmuav_jax.io import FileError
from stmuav_jax.studies import FINE, Axis, Column, open_store

FACTORS = {"speed": scipy.stats.norm(10.0, 1.0), "angle": scipy.stats.uniform(-0.5, 1.5)}
G = 9.81
norm = scipy.stats.norm(0.0, 1.0)  # it is no part of a function that calls jnp.linalg.norm


class Throw(eqx.Module):
    """Range and path of a throw, with a random gust at its end; backwards there is none."""

    g: jax.Array

    def __call__(self, sample, key):
        v, angle = sample["speed"], sample["angle"]
        s = jnp.linspace(0.0, 1.0, 5)
        end = jnp.where(angle > 0, v**2 * jnp.sin(2 * angle) / self.g, jnp.nan)
        return {
            "end": {"x": end, "gust": jax.random.normal(key)},
            "path": s * end,
            "up": angle > 0.5,
        }


def make(seed=3, **settings):
    return stm.Study(Throw(jnp.asarray(G)), FACTORS, samples=100, seed=seed, **settings)


@pytest.fixture(scope="module")
def study():
    return make()


@pytest.fixture(scope="module")
def whole(study):
    return study.compute(0, 100)


def test_outcomes_are_columns_by_their_places(study, whole):
    """Against NumPy, sample by sample; an outcome that is not a number is a failure."""
    drawn = study.sampling.draw(0, 100)
    np.testing.assert_array_equal(whole["speed"], drawn[:, 0])
    exact = np.where(drawn[:, 1] > 0, drawn[:, 0] ** 2 * np.sin(2 * drawn[:, 1]) / G, np.nan)
    np.testing.assert_allclose(whole["end_x"], exact, rtol=1e-14)
    np.testing.assert_allclose(whole["path"], exact[:, None] * np.linspace(0, 1, 5), rtol=1e-14)
    np.testing.assert_array_equal(whole["up"], drawn[:, 1] > 0.5)
    np.testing.assert_array_equal(whole["status"], np.where(drawn[:, 1] > 0, FINE, 2))
    assert 0 < np.sum(whole["status"] == 2) < 100
    assert study.reasons == {2: "an outcome is not a number"}
    assert {name: (c.dtype, c.role) for name, c in study.columns.items()} == {
        "speed": ("float64", "input"), "angle": ("float64", "input"),
        "end_gust": ("float64", "quantity"), "end_x": ("float64", "quantity"),
        "path": ("float64", "quantity"), "up": ("bool", "quantity"), "status": ("int8", "status"),
    }  # fmt: skip
    assert study.axes["path_1"].values.tolist() == [0, 1, 2, 3, 4]


def test_a_sample_has_its_own_key(whole):
    """It is that of the seed and the sample's number alone."""
    data = jnp.asarray(np.random.SeedSequence((3, 41)).generate_state(2).astype(np.uint32))
    key = jax.random.wrap_key_data(data, impl="threefry2x32")
    assert whole["end_gust"][41] == float(jax.random.normal(key))
    assert len(set(whole["end_gust"])) == 100


def test_numbers_depend_on_neither_the_range_nor_devices_nor_workers(study, whole, tmp_path):
    others = [(first, study.compute(first, count)) for first, count in ((0, 1), (7, 20), (63, 37))]
    shared = make(devices=3)
    vars(shared)["_compiled"] = study._compiled
    for first, part in [*others, (0, shared.compute(0, 100))]:
        for name, values in part.items():
            np.testing.assert_array_equal(values, whole[name][first : first + len(values)])
    study.run(tmp_path / "study.zarr", 30, chunk=9)
    outcome = study.run(tmp_path / "study.zarr", resume=True)
    assert (outcome.computed, outcome.completed) == (70, 100)
    data = open_store(tmp_path / "study.zarr").load()
    for name, values in whole.items():
        np.testing.assert_array_equal(data[name].values, values)


def test_a_store_is_not_resumed_with_another_function(study, tmp_path):
    """Neither with other numbers in it nor with another source; the design and the lanes count, too."""
    study.run(tmp_path / "study.zarr", 16)
    assert make().identity == study.identity
    moon = stm.Study(Throw(jnp.asarray(1.62)), FACTORS, seed=3)
    other = stm.Study(lambda sample, key: {"end_x": sample["speed"]}, FACTORS, seed=3)
    for changed, words in (
        (moon, "evaluate is"), (other, "evaluate is"), (make(seed=4), "sampling.seed is 3 there and 4"),
        (make(lanes=8), "lanes is 16 there and 8 here"),
    ):  # fmt: skip
        with pytest.raises(FileError, match=words):
            changed.run(tmp_path / "study.zarr", 32, resume=True)


def test_a_function_can_name_units_axes_and_reasons():
    def evaluate(sample, key):
        too_fast = sample["speed"] > 10.0
        return {"path": sample["speed"] * jnp.arange(3.0), "status": jnp.where(too_fast, 7, FINE)}

    study = stm.Study(
        evaluate, {"speed": FACTORS["speed"], "seed": {"distribution": "counter", "first": 5}},
        columns={"path": Column("float64", "m", "where it goes", dims=("time",)),
                 "speed": Column("float64", "m/s", "speed at the start", "input")},
        axes={"time": Axis(np.arange(3.0), "s")}, reasons={7: "too fast"}, identity={"law": 1},
    )  # fmt: skip
    found = study.compute(2, 40)
    assert study.columns["speed"].unit == "m/s"
    assert study.columns["path"] == Column("float64", "m", "where it goes", dims=("time",))
    np.testing.assert_array_equal(found["seed"], 7.0 + np.arange(40))
    np.testing.assert_array_equal(found["status"], np.where(found["speed"] > 10.0, 7, FINE))
    assert study.identity["law"] == 1
    stm.Study(lambda sample, key: {"y": jnp.linalg.norm(sample["speed"])}, FACTORS)


def test_functions_that_cannot_be_studied_are_refused():
    file = open(__file__)  # noqa: SIM115
    with file, pytest.raises(stm.SettingError, match="content of a value of type _io"):
        stm.Study(lambda sample, key: {"y": sample["speed"] + file.fileno()}, FACTORS)
    with pytest.raises(stm.SettingError, match="'angle' is a factor and an outcome"):
        stm.Study(lambda sample, key: sample, FACTORS)
    with pytest.raises(stm.SettingError, match="would share the name 'a_b' of 'a_b'"):
        stm.Study(lambda sample, key: {"y": 1.0}, {"a.b": 1.0, "a_b": 2.0})
