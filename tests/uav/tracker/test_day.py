"""A day of pointing: against NumPy, pvlib's own calls, brute force, and as files and figures."""

import inspect
import json
import math
from datetime import UTC, date, datetime, timedelta, timezone
from types import SimpleNamespace
from typing import Any
from zoneinfo import ZoneInfo

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pvlib
import pytest
import xarray as xr
from helpers import np_rotation, turn
from vectors import np_panel, np_strokes

import stmuav_jax as stm
from stmuav_jax.figures.day import (
    day_rows,
    labelled_day,
    load_attitude,
)
from stmuav_jax.io.netcdf import FileError, save_labelled
from stmuav_jax.uav.environment.calendar import day_zone, local_time, parse_date
from stmuav_jax.uav.environment.ephemeris import Air, Place, sun_direction
from stmuav_jax.uav.environment.irradiance import clear_sky, single_axis_normals
from stmuav_jax.uav.environment.sun import attitude, sun_position
from stmuav_jax.uav.tracker import day as day_module
from stmuav_jax.uav.tracker.day import Imperfections, attitude_history, day_times, track_day
from stmuav_jax.uav.tracker.kinematics import Reason, panel_normal, stroke_jacobian
from stmuav_jax.uav.tracker.workspace import survey

PHNOM_PENH = Place.degrees(11.55, 104.92, 12.0)
ZONE = timezone(timedelta(hours=7))
EQUINOX = date(2024, 3, 21)
NORTHWARD = np.asarray(attitude(yaw=np.pi / 2))  # the UAV's x axis points north


def phnom_penh(R_wb: Any = NORTHWARD, **more):
    return track_day(PHNOM_PENH, EQUINOX, ZONE, R_wb, **{"step": 900.0, **more})


@pytest.fixture(scope="module")
def day():
    return phnom_penh()


# --- pointing


@pytest.mark.slow
def test_panel_faces_the_sun_within_reach(day):
    """R_x(phi) R_y(theta) e_z in NumPy, turned by the attitude, is the sun's direction."""
    assert 5 < day.hours_of(day.facing) < 10
    s_w = np.asarray(day.sun.s_w)
    for k in np.flatnonzero(day.facing):
        normal = np_panel(day.angles[:, k])[:, 2]
        np.testing.assert_allclose(NORTHWARD @ normal, s_w[:, k], atol=1e-12)
        expected = np_strokes(day.geometry, day.angles[:, k])
        np.testing.assert_allclose(expected, day.strokes[:, k], atol=1e-14)
    assert np.max(day.pointing_error[day.facing]) < 1e-12
    np.testing.assert_allclose(day.incidence_cosine[day.facing], 1.0, atol=1e-14)


def test_reasons_say_why_not(day):
    """Night, or a limit that a survey of the sun's posture names; angles are NaN at night only."""
    assert np.all((day.reason == Reason.BELOW_HORIZON) == ~day.is_up)
    out = day.is_up & ~day.facing
    assert np.sum(out) > 5
    assert set(day.reason[out].tolist()) <= {int(r) for r in Reason}
    assert np.all(np.isnan(day.angles[:, ~day.is_up]))
    assert np.all(np.isfinite(day.angles[:, day.is_up]))
    assert np.all(np.degrees(day.pointing_error[out]) > 0.01)
    np.testing.assert_allclose(day.incidence_cosine[out], np.cos(day.pointing_error[out]))


def test_out_of_reach_the_panel_is_as_near_as_it_can_be(day):
    """No posture of 100,000 random ones in the workspace is nearer to the sun."""
    rng = np.random.default_rng(3)
    angles = rng.uniform(-np.pi / 3, np.pi / 3, (2, 100_000))
    reason = jax.jit(lambda x: survey(day.geometry, x, day.limits).reason)
    inside = np.asarray(reason(angles)) == Reason.VALID
    assert np.sum(inside) > 30_000
    normals = np.asarray(panel_normal(jnp.asarray(angles[:, inside])))
    out = day.is_up & ~day.facing
    best = np.arccos(np.clip(np.max(day.s_b[:, out].T @ normals, axis=1), -1, 1))
    assert np.all(day.pointing_error[out] <= best + np.radians(0.001))
    assert np.all(day.pointing_error[out] >= best - np.radians(0.5))  # the sampling's spacing
    assert np.all(np.asarray(reason(day.angles))[out] == Reason.VALID)


@pytest.mark.slow
def test_an_attitude_that_follows_the_sun_needs_no_tracker(day):
    """Body z at the sun: angles zero, always within reach, all the light that there is."""

    def along(t):
        s_w = sun_direction(day.unix[0] + t, PHNOM_PENH, air=Air.standard(12.0))
        x = jnp.cross(s_w, jnp.array([0.3, 1.0, 0.2]))
        x /= jnp.linalg.norm(x)
        return jnp.stack([x, jnp.cross(s_w, x), s_w], axis=1)

    followed = phnom_penh(along)
    assert np.array_equal(followed.facing, followed.is_up)
    assert np.nanmax(np.abs(followed.lit.angles)) < 1e-10  # 0.2 us of Unix time, 73 urad/s
    assert followed.energy["tracker"] == pytest.approx(followed.energy["two_axis"], rel=1e-12)
    assert followed.energy["airframe"] == pytest.approx(followed.energy["two_axis"], rel=1e-12)
    assert followed.energy["flat"] == day.energy["flat"]
    # as a history, rotation is steady between the samples: 900 s, 3.75 degrees of the sun, whose
    # chord leaves its circle by at most 0.03 degrees, a cosine of 1 - 2e-7
    s_w = np.asarray(day.sun.s_w)
    x = np.cross(s_w.T, [0.3, 1.0, 0.2])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    history = phnom_penh(np.stack([x.T, np.cross(s_w.T, x).T, s_w], axis=1))
    assert np.array_equal(history.facing, history.is_up)
    assert np.nanmax(np.abs(history.angles)) < 1e-12
    for panel in ("tracker", "airframe"):
        assert history.energy[panel] == pytest.approx(followed.energy["two_axis"], rel=1e-6)


def test_attitudes_as_constant_history_and_function(tmp_path):
    """Yaw in steady turn, 30 degrees of roll: by hand, as a function, and from a file."""
    start, unix = day_times(EQUINOX, ZONE, 3600.0)
    times = unix - unix[0]
    assert start.isoformat() == "2024-03-21T00:00:00+07:00"
    rate = 2 * np.pi / 86400 * 3
    expected = np.stack(
        [
            np_rotation(turn([0, 0, 1], rate * t)) @ np_rotation(turn([1, 0, 0], np.pi / 6))
            for t in times
        ],
        axis=-1,
    )
    made = attitude_history(lambda t: attitude(roll=np.pi / 6, yaw=rate * t), times)
    np.testing.assert_allclose(made, expected, atol=1e-12)
    file = tmp_path / "attitude.csv"
    lines = [f"{t},30,0,{np.degrees(rate * t) % 360}" for t in times[::3]]  # wraps at 360
    file.write_text("\n".join(["t,roll,pitch,yaw", *lines]) + "\n")
    np.testing.assert_allclose(attitude_history(load_attitude(file), times), expected, atol=1e-12)
    assert attitude_history(np.eye(3), times).shape == (3, 3, len(times))


def test_attitude_error_turns_the_panel_by_as_much():
    """The panel faces Exp(-e) s_b: less wrong than |e| by the part about the sun itself."""
    e = np.array([0.004, -0.002, 0.003])
    day = phnom_penh(flaws=Imperfections(attitude_error=tuple(e)))
    s_b = day.s_b[:, day.facing]
    across = np.linalg.norm(np.cross(e, s_b.T), axis=1)
    np.testing.assert_allclose(day.pointing_error[day.facing], across, rtol=1e-4)
    assert np.degrees(across.max()) > 0.2


@pytest.mark.slow
def test_actuator_steps_round_the_strokes(day):
    """Errors below what half a step does by the Jacobian; 0.5 mm make about half a degree."""
    step = 5e-4
    rough = phnom_penh(flaws=Imperfections(stroke_step=step))
    on = rough.facing
    steps = rough.strokes[:, on] / step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.max(np.abs(rough.strokes - day.strokes)[:, on]) <= step / 2 + 1e-12
    for k in np.flatnonzero(on):
        expected = np_strokes(day.geometry, rough.angles[:, k])
        np.testing.assert_allclose(expected, rough.strokes[:, k], atol=1e-12)
    jacobian = jax.jit(stroke_jacobian)(day.geometry, jnp.asarray(day.angles))
    jacobian = np.moveaxis(np.asarray(jacobian), -1, 0)[on]
    bound = np.linalg.norm(np.abs(np.linalg.inv(jacobian)).sum(axis=2), axis=1) * step / 2
    assert np.all(rough.pointing_error[on] < 1.05 * bound)
    assert 0.3 < np.degrees(rough.pointing_error[on].max()) < 0.6


@pytest.mark.parametrize(("best", "found"), [(64, 60), (44, 45), (-170, -165), (-179, 180)])
def test_the_best_multiple_of_fifteen_degrees(best, found, monkeypatch):
    """Of an energy with one maximum, in ten days or fewer."""
    tried = []

    def day(place, day, zone, R_wb, **options):
        assert options["step"] > 0
        tried.append(R_wb)
        return SimpleNamespace(energy={"tracker": math.cos(R_wb - math.radians(best))})

    monkeypatch.setattr(day_module, "track_day", day)
    search = inspect.unwrap(day_module.best_heading)
    yaw = search(PHNOM_PENH, EQUINOX, UTC, lambda yaw: yaw)
    assert math.degrees(math.remainder(yaw - math.radians(found), 2 * math.pi)) == pytest.approx(
        0.0, abs=1e-9
    )
    assert len(tried) <= 10


# --- light


def test_single_axis_is_the_projection_on_its_plane(day):
    """An axis to the north leaves (east, 0, up), at most 60 degrees from level."""
    s_w = np.asarray(day.sun.s_w)[:, day.is_up]
    lean = np.clip(np.arctan2(s_w[0], s_w[2]), -np.pi / 3, np.pi / 3)
    expected = np.stack([np.sin(lean), np.zeros_like(lean), np.cos(lean)])
    mine = single_axis_normals(day.sun)[:, day.is_up]
    np.testing.assert_allclose(mine, expected, atol=1e-7)


def test_days_of_other_lengths():
    """The change to summer time, and a sun that does not set."""
    _, unix = day_times(date(2024, 3, 31), ZoneInfo("Europe/Berlin"), 600.0)
    assert unix[-1] - unix[0] == 23 * 3600
    assert len(unix) == 139
    _, unix = day_times(EQUINOX, UTC, 7000.0)
    assert np.diff(unix).max() <= 7000
    arctic = track_day(Place.degrees(78.2, 15.6), date(2024, 6, 21), UTC, step=900.0)
    assert arctic.daylight == [(0.0, 24.0)]
    assert arctic.gain("two_axis") > 0.5


# --- bad input


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"step": 0.0}, stm.SettingError, "step must lie within"),
        ({"turbidity": np.inf}, stm.SettingError, "finite, but it is inf"),
        ({"albedo": 1.5}, stm.SettingError, "albedo must lie within 0 and 1, but it is 1.5"),
        ({"flaws": Imperfections(attitude_error=(np.nan, 0, 0))}, stm.SettingError, "attitude error"),
        ({"R_wb": 2 * np.eye(3)}, stm.StateError, "must be a rotation"),
        ({"R_wb": np.zeros((3, 3, 5))}, stm.StateError, r"for each of the 97 times"),
        ({"parameters": stm.PART_II.replaced({"stop.lower": (0.5, 0.5), "stop.upper": (0.6, 0.6)})},
         stm.ModelError, "reaches no posture with"),
    ],
)  # fmt: skip
def test_bad_input_is_named(change, error, words):
    with pytest.raises(error, match=words):
        phnom_penh(**change)


# --- the whole day, whatever the step


SHORT = {
    "Murmansk": (Place.degrees(68.97, 33.08), "2024-01-14", "Europe/Moscow"),
    "an evening and a morning": (Place.degrees(-43.5, 172.6), "2024-06-21", UTC),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
def test_what_is_said_of_a_day_does_not_depend_on_the_step(name):
    """Rows, energies and daylight at 2 hours and 15 minutes; the table alone has the step."""
    coarse, fine = (track_day(*SHORT[name], step=step) for step in (7200.0, 900.0))
    assert day_rows(coarse) == day_rows(fine)
    assert coarse.energy == fine.energy
    assert coarse.daylight == fine.daylight
    assert len(coarse.unix) == 13
    assert len(fine.unix) == 97


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear:DeprecationWarning")
@pytest.mark.parametrize("name", SHORT)
def test_energies_and_daylight_against_pvlib_every_four_seconds(name):
    """Of two axes and a level panel: NREL's SPA and pvlib's clear sky, summed over the day."""
    place, day_of, zone = SHORT[name]
    day = track_day(place, day_of, zone, step=7200.0, turbidity=3.0)
    begin = day.start.timestamp()
    unix = np.arange(begin + 2.0, begin + 86400.0, 4.0)
    index = pd.DatetimeIndex(pd.to_datetime(unix, unit="s", utc=True))
    latitude, longitude = (float(np.degrees(x)) for x in (place.latitude, place.longitude))
    spa = pvlib.solarposition.spa_python(index, latitude, longitude, pressure=101325.0)
    zenith = spa["apparent_zenith"].to_numpy()
    up = zenith < 90.0
    rises = begin + 3600.0 * np.array(day.daylight).ravel()
    # the SPA is within 0.0033 degrees: the sun climbs that in 10 s where its path is flat
    edges = unix[np.flatnonzero(np.diff(up.astype(int), prepend=0, append=0))[: len(rises)] - 1]
    edges = edges + 2.0
    inner = (rises > begin) & (rises < begin + 86400.0)
    assert np.abs(rises - edges)[inner].max() < 12.0
    mass = pvlib.atmosphere.get_absolute_airmass(pvlib.atmosphere.get_relative_airmass(zenith[up]))
    radiation: Any = pvlib.irradiance.get_extra_radiation(index[up])
    extra = radiation.to_numpy()
    clear_sky: Any = pvlib.clearsky.ineichen
    sky = clear_sky(zenith[up], mass, 3.0, 0.0, extra)
    around = spa["azimuth"].to_numpy()[up]
    for panel, tilt in (("flat", 0.0), ("two_axis", zenith[up])):
        light = pvlib.irradiance.get_total_irradiance(
            tilt, around, zenith[up], around, sky["dni"], sky["ghi"], sky["dhi"], dni_extra=extra,
            albedo=0.2, model="haydavies",
        )["poa_global"]  # fmt: skip
        # 12 s of a light of some 10 W/m^2 beside the energy of the shortest day
        assert day.energy[panel] == pytest.approx(4.0 * float(np.sum(light)), rel=2e-3)


@pytest.mark.slow
def test_the_minutes_in_which_the_sun_is_up_are_found():
    """A day whose sun stays up for less than a minute: no search by whole minutes may miss it."""
    best = lambda latitude: Place.degrees(latitude, 15.0)
    low, high = 67.0, 68.0
    seen = track_day(best(low), "2024-12-21", "UTC", step=7200.0, samples=3)
    for _ in range(40):
        middle = (low + high) / 2
        try:
            seen = track_day(best(middle), "2024-12-21", "UTC", step=7200.0, samples=3)
            low = middle
        except stm.StateError:
            high = middle
        if high - low < 1e-6:
            break
    ((rise, down),) = seen.daylight
    assert 0.0 < 3600.0 * (down - rise) < 240.0
    assert rise < seen.culmination < down
    with pytest.raises(stm.StateError, match=r"at best it stands [0-9.e-]+ degrees below"):
        track_day(best(high), "2024-12-21", "UTC")


@pytest.mark.slow
def test_longitudes_beyond_half_a_turn_are_places():
    """285 degrees are -75, as many data sets count them; the table of turbidity ends at 180."""
    expected = track_day(Place.degrees(40.0, -75.0), "2024-06-01", "-05:00", step=7200.0)
    day = track_day(Place.degrees(40.0, 285.0), "2024-06-01", "-05:00", step=7200.0)
    assert day.energy == pytest.approx(expected.energy, rel=1e-12)
    for latitude, longitude in ((90.0 + 9e-6, 360.0), (-90.0 - 9e-6, 180.0), (0.0, -180.0)):
        edge = Place.degrees(latitude, longitude)
        sun = sun_position(day.unix, edge, air=Air.standard(0.0))
        turbidity = clear_sky(day.unix, edge, sun, Air.standard(0.0)).turbidity
        assert np.all((turbidity > 1.0) & (turbidity < 10.0))
        assert np.any(np.asarray(sun.is_up)) == (latitude > -90.0)


def test_clock_times_are_those_that_a_clock_shows():
    """Clocks went on from 2 to 3 on this day: sunrise at 6:57 of summer time, 5:57 h after midnight."""
    day = track_day(Place.degrees(48.1, 11.6), "2024-03-31", "Europe/Berlin", step=7200.0)
    (rise, _), *_ = day.daylight
    assert 5.7 < rise < 6.0
    assert dict(day_rows(day))["Sun above the horizon"].startswith("06:")


@pytest.mark.parametrize(
    ("day", "zone", "words"),
    [
        ("2011-12-30", "Pacific/Apia", "There was no 2011-12-30 in Pacific/Apia: its calendar"),
        ("2024-02-30", UTC, "2024-02-30"),
        (EQUINOX, "Asia/Pnom_Penh", "Did you mean 'Asia/Phnom_Penh'"),
        (datetime(2024, 3, 21, 9), UTC, "must be a day without a time"),
        (1.7e9, UTC, r"a datetime.date or text like 2024-03-21, not 1700000000.0 \(float\)"),
        (EQUINOX, 7.0, r"The time zone must be a name.*not 7.0 \(float\)"),
        ("1949-12-31", UTC, "years 1950 to 2110, not for 1949-12-31"),
    ],
)
def test_days_that_are_none_are_named(day, zone, words):
    with pytest.raises(stm.SettingError, match=words):
        track_day(PHNOM_PENH, day, zone)


def test_days_and_zones_in_other_forms_are_the_same_day(day):
    for form in (
        "2024-03-21",
        np.datetime64("2024-03-21"),
        datetime(2024, 3, 21),
        pd.Timestamp(EQUINOX),
    ):
        assert parse_date(form) == EQUINOX
    for form in (ZONE, "+07:00", "Asia/Phnom_Penh", None):
        assert day_times(EQUINOX, day_zone(form, 104.92), 3600.0)[0].timestamp() == day.unix[0]
    noon = datetime(2024, 7, 1, 12)
    assert day_zone("-03:30", 0.0).utcoffset(noon) == timedelta(hours=-3.5)
    assert day_zone("Europe/Berlin", 0.0).utcoffset(noon) == timedelta(hours=2)
    assert day_zone(None, 350.0).utcoffset(noon) == timedelta(hours=-1)


def test_hours_that_clocks_skip_or_show_twice_are_named():
    berlin = ZoneInfo("Europe/Berlin")
    assert local_time(EQUINOX, 2.5, berlin).isoformat() == "2024-03-21T02:30:00+01:00"
    with pytest.raises(stm.SettingError, match="no time 2024-03-31 02:30:00 in Europe/Berlin"):
        local_time(date(2024, 3, 31), 2.5, berlin)
    with pytest.raises(
        stm.SettingError, match=r"twice in Europe/Berlin.*\+02:00 for the first or \+01"
    ):
        local_time(date(2024, 10, 27), 2.5, berlin)
    with pytest.raises(stm.SettingError, match="skipped that day"):
        local_time(date(2011, 12, 30), 9.0, ZoneInfo("Pacific/Apia"))


def test_polar_night_is_named():
    with pytest.raises(stm.StateError, match=r"does not rise at 78.2 degrees north on 2024-12-21"):
        track_day(Place.degrees(78.2, 15.6), date(2024, 12, 21), UTC, step=3600.0)


# --- files and figures


def test_day_as_a_file(day, tmp_path):
    """Everything comes back, with units; angles of the file give its normals."""
    with xr.open_dataset(
        save_labelled(labelled_day(day), tmp_path / "day.nc"), engine="h5netcdf"
    ) as file:
        data = file.load()
    assert all(v.attrs["units"] for v in data.data_vars.values())
    np.testing.assert_array_equal(data["panel_angles"].sel(angle="phi"), day.angles[0])
    np.testing.assert_array_equal(data["irradiance"].sel(panel="flat"), day.irradiance["flat"])
    assert float(data["energy"].sel(panel="tracker")) == day.energy["tracker"]
    assert json.loads(data.attrs["settings"])["clear sky"] == "Ineichen-Perez"
    reasons = json.loads(data.attrs["reasons"])
    assert reasons["20"] == "below horizon"
    assert reasons["3"] == "tilt"
    shift = data["displacements"] - data["strokes"]
    assert np.ptp(shift.sel(leg=2).to_numpy()[day.is_up]) < 1e-15
    assert labelled_day(day).dataset().attrs["start"] == "2024-03-21T00:00:00+07:00"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "There is no file"),
        ("t,roll,pitch,yaw\n0,1,2\n", "3 cells"),
        ("t,roll,pitch,yaw\n0,1,2,3\n0,1,2,3\n", "times that increase"),
    ],
)
def test_attitude_files_that_cannot_be_used(text, words, tmp_path):
    file = tmp_path / "attitude.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(FileError, match=words):
        load_attitude(file)
