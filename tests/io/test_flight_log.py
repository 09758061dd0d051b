"""Flight logs of four formats give the same SI channels in forward-left-up axes; bad logs say why."""

import csv
import json
import re
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.constants import degree, g
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import stmuav_jax as stm
from stmuav_jax.checks.errors import SettingError
from stmuav_jax.io import FileError, read_flight_log
from stmuav_jax.math.rotation import rotation_matrix_in

FLIGHTS = Path(__file__).parents[2].parent / "shared" / "flights"
real = pytest.mark.skipif(
    not FLIGHTS.is_dir(), reason="the real flights are not beside the checkout"
)

RATE, LENGTH, TAKE_OFF, LANDING = 200, 8.0, 2.0, 6.0
AXES = "xyz"


def flight(**changes):
    """Channels of a flight from 2 to 6 s in forward-left-up axes: times [s], then SI arrays."""
    ts = np.arange(int(RATE * LENGTH)) / RATE
    flying = (ts >= TAKE_OFF) & (ts < LANDING)
    wave = np.where(flying, np.sin(3 * ts), 0.0)
    parts = {
        "t": ts,
        "accelerometer": np.stack([0.3 * wave, -0.2 * wave, 9.81 + wave], axis=1),
        "gyroscope": np.stack([0.5 * wave, 0.4 * wave, -0.3 * wave], axis=1),
        "motor_commands": np.where(flying, 0.6 + 0.1 * wave, 0.0)[:, None] + np.zeros(4),
    }
    return parts | changes


def csv_file(path, parts, units=("s", "m/s^2", "rad/s", "1"), separator=",", comma=False):
    """A CSV file with this package's names."""
    names = ["accelerometer", "gyroscope", "motor_commands"]
    heads, columns = [f"t [{units[0]}]"], [parts["t"]]
    for name, unit in zip(names, units[1:], strict=True):
        ends = AXES if name != "motor_commands" else "1234"
        heads += [f"{name}.{end} [{unit}]" for end in ends]
        columns += list(parts[name].T)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, delimiter=separator)
        writer.writerow(heads)
        for row in zip(*columns, strict=True):
            cells = ["" if np.isnan(x) else repr(float(x)) for x in row]
            writer.writerow([cell.replace(".", ",") for cell in cells] if comma else cells)
    return path


def card_file(path, parts, start=5.0):
    """A micro-SD log of Crazyflie."""
    names = [f"{k}.{a}(f)" for k in ("acc", "gyro") for a in AXES]
    names += [f"motor.m{k}(I)" for k in (1, 2, 3, 4)]
    head = struct.pack("<BHHH", 0xBC, 2, 1, 0xFFFF) + b"fixedFrequency\0" + struct.pack("<H", 10)
    head += b"".join(name.encode() + b"\0" for name in names)
    rows = zip(
        parts["t"], parts["accelerometer"] / g, parts["gyroscope"] / degree,
        np.round(parts["motor_commands"] * 65535).astype(int), strict=True,
    )  # fmt: skip
    body = b"".join(
        struct.pack("<HQ6f4I", 0xFFFF, round(1e6 * (start + t)), *force, *rates, *motors)
        for t, force, rates, motors in rows
    )
    path.write_bytes(head + body + struct.pack("<I", zlib.crc32(head + body)))
    return path


def ulog_file(path, parts, start=5.0, parameters=(), info=(), landed=()):
    """A log of PX4, whose axes are forward-right-down."""
    down = np.array([1, -1, -1])
    message = lambda kind, body: struct.pack("<HB", len(body), ord(kind)) + body
    keyed = lambda kind, key, value: message(kind, bytes([len(key)]) + key.encode() + value)
    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", round(1e6 * start))]
    formats = {
        "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
        "actuator_motors": "uint64_t timestamp;uint64_t timestamp_sample;float[5] control;",
        "vehicle_attitude": "uint64_t timestamp;float[4] q;",
        "vehicle_land_detected": "uint64_t timestamp;uint8_t landed;",
    }
    out += [message("F", f"{name}:{fields}".encode()) for name, fields in formats.items()]
    for name, value in (("ver_hw", "PX4_FMU"), *info):
        out.append(keyed("I", f"char[{len(value)}] {name}", value.encode()))
    for name, value in (
        ("MAV_TYPE", 2),
        ("IMU_GYRO_CUTOFF", 40.0),
        ("THR_MDL_FAC", 0.3),
        *parameters,
    ):
        is_whole = isinstance(value, int)
        bits = struct.pack("<i" if is_whole else "<f", value)
        out.append(keyed("P", f"{'int32_t' if is_whole else 'float'} {name}", bits))
    out += [
        message("A", struct.pack("<BH", 0, k) + name.encode()) for k, name in enumerate(formats)
    ]
    data = lambda k, form, *values: message("D", struct.pack("<H" + form, k, *values))
    for t, state in landed:
        out.append(data(3, "QB", round(1e6 * (start + t)), state))
    rows = zip(
        *(parts[n] for n in ("t", "accelerometer", "gyroscope", "motor_commands")), strict=True
    )
    for t, force, rates, motors in rows:
        us = round(1e6 * (start + t))
        out.append(data(0, "Q6f", us, *(rates * down), *(force * down)))
        out.append(data(1, "QQ5f", us, us, *motors, np.nan))
        # a quarter turn to the right about down
        out.append(data(2, "Q4f", us, np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    path.write_bytes(b"".join(out))
    return path


def bin_file(path, parts, start=5.0, parameters=(), texts=("ArduCopter V4.5.1",), armed=(), turn=0):
    """A log of ArduPilot, whose axes are forward-right-down and whose commands are pulses."""
    down = np.array([1, -1, -1])
    kinds = {
        "FMT": (128, "BBnNZ", "BB4s16s64s", "Type,Length,Name,Format,Columns"),
        "PARM": (64, "QNf", "Q16sf", "TimeUS,Name,Value"),
        "MSG": (65, "QZ", "Q64s", "TimeUS,Message"),
        "IMU": (66, "QBffffff", "QB6f", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
        "RCOU": (67, "QHHHH", "Q4H", "TimeUS,C1,C2,C3,C4"),
        "ATT": (68, "Qfff", "Q3f", "TimeUS,Roll,Pitch,Yaw"),
        "ESC": (69, "QBi", "QBi", "TimeUS,Instance,RPM"),
        "ARM": (70, "QB", "QB", "TimeUS,ArmState"),
    }

    def message(name, *values):
        number, _, form, _ = kinds[name]
        return struct.pack("<BBB" + form, 0xA3, 0x95, number, *values)

    out = []
    for name, (number, letters, form, columns) in kinds.items():
        size = 3 + struct.calcsize("<" + form)
        out.append(message("FMT", number, size, name.encode(), letters.encode(), columns.encode()))
    given = [
        *((f"SERVO{k}_FUNCTION", 32 + k) for k in (1, 2, 3, 4)),
        ("INS_GYRO_FILTER", 40),
        *parameters,
    ]
    out += [message("PARM", 1, name.encode(), value) for name, value in given]
    out += [message("MSG", 1, text.encode()) for text in texts]
    out += [message("ARM", round(1e6 * (start + t)), state) for t, state in armed]
    rows = zip(
        *(parts[n] for n in ("t", "accelerometer", "gyroscope", "motor_commands")), strict=True
    )
    for t, force, rates, motors in rows:
        us = round(1e6 * (start + t))
        out.append(message("IMU", us, 0, *(rates * down), *(force * down)))
        out.append(message("IMU", us, 1, *(9 * rates), *(9 * force)))
        out.append(message("RCOU", us, *(round(1000 + 1000 * x) for x in motors)))
        out.append(message("ATT", us, 0.0, 0.0, 90.0))
        # the speed controllers answer one after the other
        out += [message("ESC", us + 100 * k, k, turn * (k + 1)) for k in range(4) if turn]
    path.write_bytes(b"".join(out))
    return path


FORMATS = {"csv": csv_file, "card": card_file, "ulog": ulog_file, "bin": bin_file}
NEEDS = {"ulog": "pyulog", "bin": "pymavlink"}


def written(kind, path, parts, **options):
    if kind in NEEDS:
        pytest.importorskip(NEEDS[kind])
    return FORMATS[kind](path / "log", parts, **options)


@pytest.mark.parametrize("kind", FORMATS)
def test_each_format_gives_the_same_channels(kind, tmp_path):
    parts = flight()
    log = read_flight_log(written(kind, tmp_path, parts))
    assert log.start == (0.0 if kind == "csv" else 5.0)
    assert log.duration == pytest.approx(LENGTH - 1 / RATE)
    for name, bound in (("accelerometer", 1e-5), ("gyroscope", 1e-6), ("motor_commands", 6e-4)):
        channel = log[name]
        # single precision of the files, and pulses in whole microseconds
        # PX4 logs what its outputs solve f u^2 + (1 - f) u for
        value = channel.values
        if (kind, name) == ("ulog", "motor_commands"):
            value = 0.3 * value**2 + 0.7 * value
        np.testing.assert_allclose(value, parts[name], rtol=0, atol=bound)
        np.testing.assert_allclose(channel.ts, parts["t"], rtol=0, atol=1e-9)
        assert channel.rate == pytest.approx(RATE)
        assert channel.unit == {"accelerometer": "m/s^2", "gyroscope": "rad/s"}.get(name, "1")
    assert log["accelerometer"].clock == log["gyroscope"].clock
    np.testing.assert_allclose(log.flights, [[TAKE_OFF, LANDING]], atol=1 / RATE)
    # what the file does not say is assumed, and said
    assumed = {
        "csv": ["went through no low-pass filter", "voltage is constant"],
        "card": ["voltage is constant"],
        "ulog": ["voltage is constant"],
        "bin": ["1000 to 2000 us", "accelerometer went through no", "voltage is constant"],
    }[kind]
    assert len(log.notes) == len(assumed)
    for note, words in zip(log.notes, assumed, strict=True):
        assert re.match(rf"Assumed: .*{words}.*, because the log has no .*; .*\.", note)
    assert log.refusals == ()
    assert not log.is_simulated
    assert log.flight().duration == log.duration


@pytest.mark.parametrize("kind", ["ulog", "bin"])
def test_a_turn_to_the_right_is_negative_about_up(kind, tmp_path):
    attitude = read_flight_log(written(kind, tmp_path, flight()))["attitude"]
    q = attitude.values[0]
    np.testing.assert_allclose(q, [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)], atol=1e-7)
    # a nose to the east is, in a world with x north and y west, along -y
    ahead = rotation_matrix_in(np, q) @ np.array([1.0, 0, 0])
    np.testing.assert_allclose(ahead, [0, -1, 0], atol=1e-7)


def test_settings_of_px4_have_their_parameters(tmp_path):
    rotors = [(0.1, 0.2, 0.05), (-0.1, -0.2, 0.05), (0.1, -0.2, -0.05), (-0.1, 0.2, -0.05)]
    parameters = [("CA_ROTOR_COUNT", 4)]
    for k, (x, y, turn) in enumerate(rotors):
        parameters += [(f"CA_ROTOR{k}_PX", x), (f"CA_ROTOR{k}_PY", y), (f"CA_ROTOR{k}_KM", turn)]
    settings = read_flight_log(written("ulog", tmp_path, flight(), parameters=parameters)).settings
    places = np.array([(x, -y, 0) for x, y, _ in rotors])
    np.testing.assert_allclose(settings["rotor_positions"].value, places, atol=1e-7)
    np.testing.assert_array_equal(settings["rotor_spin"].value, [1, 1, -1, -1])
    assert settings["thrust_model_factor"].value == pytest.approx(0.3)
    assert settings["thrust_model_factor"].source == "THR_MDL_FAC"
    # sensor_combined is not low-pass filtered
    assert "gyroscope_cutoff" not in settings


def test_settings_of_the_other_formats_have_their_sources(tmp_path):
    card = read_flight_log(written("card", tmp_path, flight())).settings
    assert card["gyroscope_cutoff"][:2] == (80.0, "Hz")
    assert "not the log" in card["accelerometer_cutoff"].source
    pilot = read_flight_log(written("bin", tmp_path, flight())).settings
    assert pilot["gyroscope_cutoff"] == (40.0, "Hz", "INS_GYRO_FILTER")


def test_commands_of_ardupilot_are_those_of_its_thrust_curve(tmp_path):
    """ArduPilot's curve begins at MOT_SPIN_MIN; PX4's is above."""
    T = flight()["motor_commands"]
    spins = [("MOT_SPIN_MIN", 0.15), ("MOT_SPIN_MAX", 0.95), ("MOT_PWM_MIN", 1000.0)]
    log = read_flight_log(written("bin", tmp_path, flight(), parameters=spins))
    expected = np.maximum((T - 0.15) / 0.8, 0.0)
    np.testing.assert_allclose(log["motor_commands"].values, expected, atol=1e-3)
    assert not any("1000 to 2000" in note for note in log.notes)


def test_landed_states_end_a_flight_whose_motors_turn(tmp_path):
    landed = [(0.0, 1), (2.5, 0), (5.0, 1)]
    log = read_flight_log(written("ulog", tmp_path, flight(), landed=landed))
    np.testing.assert_allclose(log.flights, [[2.5, 5.0]], atol=1e-9)


def test_ardupilot_s_arming_and_rotor_speeds_are_read(tmp_path):
    armed = [(0.0, 0), (3.0, 1), (5.0, 0)]
    log = read_flight_log(written("bin", tmp_path, flight(), armed=armed, turn=600))
    np.testing.assert_allclose(log.flights, [[3.0, 5.0]], atol=1e-9)
    np.testing.assert_allclose(
        log["rotor_speeds"].values[10], 2 * np.pi * np.array([10, 20, 30, 40])
    )


def test_csv_with_a_map_semicolons_and_decimal_commas(tmp_path):
    parts = flight()
    heads = ["time (ms)", "ax [g]", "ay [g]", "az [g]", "p", "q", "r", "m1", "m2", "m3", "m4"]
    table = np.column_stack([
        1e3 * parts["t"], parts["accelerometer"] * [1, -1, -1] / g,
        parts["gyroscope"] * [1, -1, -1] / degree, 1000 + 1000 * parts["motor_commands"],
    ])  # fmt: skip
    lines = [";".join(f"{x:.9f}" for x in row).replace(".", ",") for row in table]
    path = tmp_path / "log.csv"
    path.write_bytes("\n".join([";".join(heads), *lines, ""]).encode("utf-8-sig"))
    (tmp_path / "map.toml").write_text(
        """
        axes = "forward-right-down"
        time = {column = "time"}
        accelerometer = {columns = ["ax [g]", "ay", "az"]}
        gyroscope = {columns = ["p", "q", "r"], unit = "deg/s"}
        motor_commands = {columns = ["m1", "m2", "m3", "m4"], range = [1000, 2000]}
        settings = {gyroscope_cutoff = 80, rotor_positions = [[0.1, 0.1, 0], [-0.1, 0.1, 0]]}
        """
    )
    log = read_flight_log(path, tmp_path / "map.toml")
    for name in ("accelerometer", "gyroscope", "motor_commands"):
        np.testing.assert_allclose(log[name].values, parts[name], rtol=0, atol=1e-7)
    np.testing.assert_allclose(log["gyroscope"].ts, parts["t"], rtol=0, atol=1e-9)
    assert log.settings["gyroscope_cutoff"] == (80.0, "Hz", "map")
    np.testing.assert_allclose(
        log.settings["rotor_positions"].value, [[0.1, -0.1, 0], [-0.1, -0.1, 0]]
    )
    assert log["accelerometer"].source == "CSV: ax [g], ay, az"


def test_blank_cells_give_each_channel_its_own_clock(tmp_path):
    parts = flight()
    parts["motor_commands"][1::2] = np.nan
    log = read_flight_log(csv_file(tmp_path / "log", parts))
    assert len(log["motor_commands"].ts) == len(parts["t"]) // 2
    assert log["motor_commands"].clock != log["gyroscope"].clock
    assert log["accelerometer"].clock == log["gyroscope"].clock


def test_a_grid_on_the_samples_keeps_them_exactly(tmp_path):
    log = read_flight_log(csv_file(tmp_path / "log", flight())).resample(RATE)
    whole = read_flight_log(tmp_path / "log")
    for name in whole.channels:
        np.testing.assert_array_equal(log[name].values, whole[name].values)
        assert log[name].ts is log["gyroscope"].ts


def test_a_finer_grid_interpolates_sensors_and_holds_commands(tmp_path):
    log = read_flight_log(csv_file(tmp_path / "log", flight()))
    fine = log.resample(4 * RATE)
    t, k = log["gyroscope"].ts, int(3.0 * RATE)
    j = 4 * k + 1
    gyro, command = log["gyroscope"].values, log["motor_commands"].values
    assert fine["gyroscope"].ts[j] == pytest.approx(t[k] + 0.25 / RATE)
    np.testing.assert_allclose(fine["gyroscope"].values[j], 0.75 * gyro[k] + 0.25 * gyro[k + 1])
    np.testing.assert_array_equal(fine["motor_commands"].values[j : j + 3], command[[k, k, k]])


def test_a_coarser_grid_takes_means_that_keep_the_phase(tmp_path):
    """The mean of a sine over a step is the sine at the step's middle times sinc."""
    ts = np.arange(2000) / 1000
    wave = np.sin(2 * np.pi * 5 * ts)
    parts = flight(t=ts, gyroscope=wave[:, None] + np.zeros(3))
    parts |= {"accelerometer": np.full((2000, 3), 5.7), "motor_commands": np.full((2000, 4), 0.5)}
    log = read_flight_log(csv_file(tmp_path / "log", parts)).resample(50)
    inside = np.isfinite(log["gyroscope"].values[:, 0])
    expected = np.sinc(5 / 50) * np.sin(2 * np.pi * 5 * log["gyroscope"].ts)
    # linear interpolation between 200 samples a period
    np.testing.assert_allclose(
        log["gyroscope"].values[inside, 0], expected[inside], rtol=0, atol=2e-4
    )
    np.testing.assert_array_equal(inside, np.arange(len(inside)) % len(inside) > 0)


def test_attitudes_are_interpolated_across_their_jumps(tmp_path):
    """A full turn in yaw, as quaternions with signs at random and as Euler angles within half a turn."""
    ts = np.arange(100) / 10
    yaw = 0.4 * ts + 2.0
    signs = np.where(np.random.default_rng(0).random(100) < 0.5, -1.0, 1.0)
    rows = np.column_stack([ts, signs * np.cos(yaw / 2), 0 * ts, 0 * ts, signs * np.sin(yaw / 2)])
    text = "t [s],attitude.w,attitude.x,attitude.y,attitude.z\n"
    (tmp_path / "q").write_text(
        text + "\n".join(",".join(map(repr, row.tolist())) for row in rows) + "\n"
    )
    log = read_flight_log(tmp_path / "q").resample(30)["attitude"]
    w, _, _, z = log.values.T
    turned = 2 * np.unwrap(np.arctan2(z, w))
    # chords of 0.04 rad, and a start within a full turn
    np.testing.assert_allclose(turned - turned[0], 0.4 * (log.ts - log.ts[0]), atol=1e-5)
    np.testing.assert_allclose(np.exp(1j * turned[0]), np.exp(1j * yaw[0]), atol=1e-9)
    names = ("stateEstimate.roll", "stateEstimate.yaw")
    head = struct.pack("<BHHH", 0xBC, 2, 1, 7) + b"all\0" + struct.pack("<H", 2)
    head += b"".join(f"{name}(f)".encode() + b"\0" for name in names)
    wrapped = (np.degrees(yaw) + 180) % 360 - 180
    head += b"".join(
        struct.pack("<HQff", 7, round(1e6 * t), 0.0, angle)
        for t, angle in zip(ts, wrapped, strict=True)
    )
    (tmp_path / "card").write_bytes(head + struct.pack("<I", zlib.crc32(head)))
    angles = read_flight_log(tmp_path / "card").resample(30)["euler_angles"]
    np.testing.assert_allclose(angles.values[:, 1], 0.4 * angles.ts + 2.0, atol=1e-5)


def test_a_gap_is_noted_and_missing_on_the_grid(tmp_path):
    parts = flight()
    kept = (parts["t"] < 3.0) | (parts["t"] > 3.1)
    log = read_flight_log(csv_file(tmp_path / "log", {k: v[kept] for k, v in parts.items()}))
    assert {gap.channel for gap in log.gaps} == {"accelerometer", "gyroscope", "motor_commands"}
    assert "missing once, at 3.00 s for 0.11 s: motor_commands" in log.notes[0]
    grid = log.resample(RATE)["gyroscope"]
    np.testing.assert_array_equal(np.isnan(grid.values[:, 0]), ~kept)
    # a window keeps the gap that it cuts
    assert np.any(np.isnan(log.window(2.5, 4.0).resample(RATE)["gyroscope"].values))


def test_a_gap_of_more_than_a_second_ends_a_flight(tmp_path):
    parts = flight()
    kept = (parts["t"] < 3.2) | (parts["t"] > 4.5)
    log = read_flight_log(csv_file(tmp_path / "log", {k: v[kept] for k, v in parts.items()}))
    np.testing.assert_allclose(log.flights, [[2.0, 3.195], [4.505, 6.0]], atol=1e-5)


def test_gaps_that_leave_too_little_of_a_flight_are_named(tmp_path):
    ts = np.arange(20 * RATE) / RATE
    values = np.sin(ts)[:, None] + np.zeros(4)
    parts = {"t": ts, "accelerometer": values[:, :3] + [0, 0, g], "gyroscope": values[:, :3]}
    parts["motor_commands"] = 0.5 + 0.1 * values
    kept = (ts + 1) % 2 > 0.1
    log = read_flight_log(csv_file(tmp_path / "log", {k: v[kept] for k, v in parts.items()}))
    with pytest.raises(
        SettingError, match=r"Gaps of more than 0\.05 s leave at most 1\.9 s of the flight"
    ):
        log.to_record()


def test_slow_commands_in_the_rows_of_a_fast_logger_are_refused(tmp_path):
    parts = flight()
    commands = parts["motor_commands"][np.arange(len(parts["t"])) // 8 * 8]
    log = read_flight_log(csv_file(tmp_path / "log", parts | {"motor_commands": commands}))
    with pytest.raises(SettingError, match="change at 25 Hz, which is slower than the lag"):
        log.to_record()


def test_windows_keep_the_log_s_times(tmp_path):
    log = read_flight_log(csv_file(tmp_path / "log", flight()))
    part = log.window(1.0, 3.0)
    assert part["gyroscope"].ts[[0, -1]].tolist() == [1.0, 3.0]
    np.testing.assert_allclose(part.flights, [[2.0, 3.0]])
    np.testing.assert_allclose(log.flight()["gyroscope"].ts[[0, -1]], [2.0, 6.0])
    for call, words in (
        (lambda: log.window(3.0, 1.0), "must end after its start"),
        (lambda: log.window(100.0, 101.0), "has no samples"),
        (lambda: log.resample(0.0), "must be between"),
        (lambda: log.flight(1), "has 1 flight segments"),
        (lambda: log["gyroscop"], "Did you mean 'gyroscope'?"),
    ):
        with pytest.raises(SettingError, match=words.replace("?", r"\?")):
            call()


@pytest.mark.parametrize("kind", FORMATS)
def test_what_is_before_a_cut_is_kept(kind, tmp_path):
    path = written(kind, tmp_path, flight())
    data = path.read_bytes()
    path.write_bytes(data[: int(0.9 * len(data)) + 7])
    log = read_flight_log(path)
    # rows of rest are shorter in a CSV
    assert 5.9 < log.duration < 7.5
    assert any("truncated" in note for note in log.notes)


@pytest.mark.parametrize("kind", ["card", "ulog", "bin"])
def test_damage_is_said(kind, tmp_path):
    path = written(kind, tmp_path, flight())
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 300] = bytes(300)
    path.write_bytes(data)
    log = read_flight_log(path)
    assert len(log["gyroscope"].ts) > 700
    assert any("damaged" in note for note in log.notes)


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("bin", lambda data: data[:3], "has no message; a whole file would be valid"),
        # the quaternion of one row is all zeros
        (
            "ulog",
            lambda data: data.replace(struct.pack("<4f", 0.5**0.5, 0, 0, 0.5**0.5), bytes(16), 1),
            "quaternions have lengths of 0 to 1",
        ),
        ("csv", lambda data: data.rstrip(), "no end of line"),
    ],
    ids=["head only", "no length", "no end of line"],
)
def test_small_damage_is_named(kind, change, words, tmp_path):
    """A flight of 16 s, whose channels are compared."""
    path = written(kind, tmp_path, flight(t=4 * flight()["t"]))
    path.write_bytes(change(path.read_bytes()))
    try:
        said = " ".join(read_flight_log(path).notes)
    except FileError as error:
        said = str(error)
    assert words in said


@pytest.mark.parametrize("kind", FORMATS)
def test_any_damage_ends_in_a_log_or_in_words(kind, tmp_path):
    path = written(kind, tmp_path, flight())
    data, rng, sentences = path.read_bytes(), np.random.default_rng(0), []
    for _ in range(8):
        wrong = bytearray(data)
        for place in rng.integers(0, len(data) if rng.random() < 0.5 else 600, 20):
            wrong[place] = rng.integers(256)
        path.write_bytes(wrong[: rng.integers(1, len(data))])
        try:
            read_flight_log(path).resample(50.0)
        except (FileError, SettingError) as error:
            sentences.append(str(error))
    assert all(sentence.endswith(".") for sentence in sentences)


def at_end(parts, name, value, count=5):
    """Channels whose one channel has a value just before the motors stop."""
    parts[name][int(LANDING * RATE) - count : int(LANDING * RATE)] = value
    return parts


def backwards(parts):
    """Channels whose clock jumps back by a second, in flight."""
    parts["t"] = np.where(parts["t"] > 4, parts["t"] - 1, parts["t"])
    return parts


NOTED = {
    "disarmed": (
        lambda: flight(motor_commands=np.zeros((1600, 4))), "is disarmed throughout; a log with a flight", True,
    ),
    "9.18": (lambda: flight(accelerometer=flight()["accelerometer"] * 9.18 / 9.81),
             "9.18 m/s^2 at rest where 9.5 to 10.1 m/s^2 would be valid: its scale", True),
    "g": (lambda: flight(accelerometer=flight()["accelerometer"] / g), "is its unit g?", True),
    "down": (lambda: flight(accelerometer=flight()["accelerometer"] * [1, -1, -1]),
             "on average in flight, where thrust along +z would be valid", True),
    "degrees": (lambda: flight(gyroscope=flight()["gyroscope"] * 100 / degree), "is its unit deg/s?", True),
    "clock": (lambda: backwards(flight()), "goes backwards near", True),
    "crash": (lambda: at_end(flight(), "accelerometer", 80.0), "ends in a crash at 5.97 s", False),
    "impact": (lambda: at_end(flight(accelerometer=np.where(flight()["t"][:, None] == 2.5, 90, [0, 0, 9.81])),
                              "gyroscope", 0.0), "exceeds 49 m/s^2 in flight, first at 2.50 s", False),
    "saturated": (lambda: at_end(flight(), "motor_commands", [0.6, 0.6, 1.0, 0.6], 200),
                  "motor 3 is at its upper limit of 1 in 25 % of the flight", False),
    "limited": (lambda: flight(motor_commands=np.minimum(flight()["motor_commands"], 0.65)),
                "motor 1 is at its upper limit of 0.65 in", False),
    "slow": (lambda: {k: v[::10] for k, v in flight().items()}, "motor_commands come at 20 Hz", False),
}  # fmt: skip


@pytest.mark.parametrize("case", NOTED)
def test_doubtful_logs_say_what_would_be_valid(case, tmp_path):
    make, words, is_refused = NOTED[case]
    log = read_flight_log(csv_file(tmp_path / "log", make()))
    notes = [note for note in log.notes if words in note]
    assert notes, log.notes
    assert (notes[0] in log.refusals) == is_refused
    if is_refused:
        with pytest.raises(SettingError, match=r"valid|increase"):
            log.flight()
    if case == "crash":
        np.testing.assert_allclose(log.flights, [[2.0, 5.475]], atol=0.01)


@pytest.fixture(scope="module")
def motion():
    """Channels whose motion, forces and commands agree, made of random splines; in flight from 2 to 22 s."""
    rng, ts = np.random.default_rng(1), np.arange(0, 24, 0.01)
    knots = np.arange(0, 24.5, 0.5)
    shares = np.clip(np.minimum(knots - 2, 22 - knots) / 2, 0, 1)[:, None]
    angles = CubicSpline(knots, shares * [0.3, 0.3, 0.5] * rng.normal(size=(len(knots), 3)))
    places = CubicSpline(knots, shares * [0.5, 0.5, 0.1] * rng.normal(size=(len(knots), 3)))
    turn = lambda t: Rotation.from_euler("ZYX", angles(t)[:, ::-1])
    rates = (turn(ts - 1e-4).inv() * turn(ts + 1e-4)).as_rotvec() / 2e-4
    force = turn(ts).inv().apply(places(ts, 2) + g * np.eye(3)[2])
    spins = np.array([[-1, -1, 1], [-1, 1, -1], [1, 1, 1], [1, -1, -1]])
    commands = 0.5 + 0.02 * (force[:, 2:] - g) + 2e-3 * np.gradient(rates, 0.01, axis=0) @ spins.T
    flying = ((ts > 2) & (ts < 22))[:, None]
    return {
        "t": ts, "accelerometer": force, "gyroscope": rates, "motor_commands": commands * flying,
        "attitude": turn(ts).as_quat(scalar_first=True), "euler_angles": angles(ts),
        "position": places(ts), "velocity": places(ts, 1),
    }  # fmt: skip


def late(parts, seconds, *names):
    """Channels of which some come later."""
    return parts | {name: np.roll(parts[name], round(100 * seconds), axis=0) for name in names}


def scaled(name, factor):
    return lambda parts: parts | {name: parts[name] * factor}


FAULTS = {
    "right": (lambda parts: parts, None, False),
    "gyroscope by 3": (
        scaled("gyroscope", 3), "attitude turns about x, y, z 0.333 times as much as the gyroscope", True,
    ),
    "gyroscope in degrees": (scaled("gyroscope", 1 / degree), "as if one were in deg/s", True),
    "gyroscope of other axes": (
        lambda parts: parts | {"gyroscope": parts["gyroscope"][:, [1, 0, 2]]},
        "about x, y, z as the gyroscope measures y, x, z", True,
    ),
    "attitude from degrees": (
        lambda parts: {k: v for k, v in parts.items() if k != "attitude"}
        | {"euler_angles": parts["euler_angles"] / degree},
        "not as the gyroscope measures", True,
    ),
    "attitude of another clock": (
        lambda parts: late(parts, 2.0, "attitude"), "2.0 s after the gyroscope measures it", True,
    ),
    "position in centimetres": (
        scaled("position", 100), "position moves along x, y, z 100 times as much as the velocity measures, as if one "
        "were in cm", False,
    ),
    "accelerometer in g": (
        lambda parts: scaled("accelerometer", 0.6)({k: v for k, v in parts.items() if k != "position"}),
        "velocity changes along x, y, z 1.6", False,
    ),
    "position alone in centimetres": (
        lambda parts: scaled("position", 100)({k: v for k, v in parts.items() if k != "velocity"}),
        "times as much as the accelerometer measures", False,
    ),
    "commands of another clock": (
        lambda parts: late(parts, 8.0, "gyroscope", "accelerometer", "attitude"),
        "The IMU feels motor_commands 8.0 s after their time stamps", True,
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_channels_that_contradict_each_other_are_named(fault, motion, tmp_path):
    change, words, is_refused = FAULTS[fault]
    parts = dict(change(motion))
    if "attitude" in parts:
        parts.pop("euler_angles")
    ts = parts.pop("t")
    units = {
        "accelerometer": "m/s^2",
        "gyroscope": "rad/s",
        "euler_angles": "rad",
        "position": "m",
        "velocity": "m/s",
    }
    ends = {"attitude": "wxyz", "motor_commands": "1234", "euler_angles": ("roll", "pitch", "yaw")}
    heads = [f"{k}.{end} [{units.get(k, '1')}]" for k in parts for end in ends.get(k, AXES)]
    table = np.column_stack([ts, *parts.values()])
    path = tmp_path / "log"
    np.savetxt(path, table, delimiter=",", header=",".join(["t [s]", *heads]), comments="")
    log = read_flight_log(path)
    notes = [note for note in log.notes if not note.startswith("Assumed")]
    if words is None:
        assert not notes
    else:
        assert any(words in note for note in (log.refusals if is_refused else notes)), notes
    assert bool(log.refusals) == is_refused or fault == "accelerometer in g"


def test_a_single_wrong_stamp_costs_one_sample(tmp_path):
    parts = flight()
    parts["t"][700] = 1e9
    log = read_flight_log(csv_file(tmp_path / "log", parts))
    assert log.duration < LENGTH
    assert len(log["gyroscope"].ts) == len(parts["t"]) - 1
    assert log.refusals == ()


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        ("ulog", {"parameters": [("MAV_TYPE", 22)]}, "of a VTOL aircraft"),
        ("bin", {"texts": ["ArduPlane V4.5"]}, "the firmware ArduPlane"),
        ("ulog", {"parameters": [("MAV_TYPE", 0), ("CA_AIRFRAME", 11)]}, "of a helicopter"),
        ("bin", {"parameters": [("FRAME_CLASS", 6.0)]}, "of a helicopter"),
        ("bin", {"texts": (), "parameters": [("SERVO1_FUNCTION", 4.0)]}, "of an aircraft with control surfaces"),
        ("ulog", {"parameters": [("CA_AIRFRAME", 8)]}, "of a multirotor with tilting rotors"),
        ("ulog", {"parameters": [("CA_ROTOR_COUNT", 1), ("CA_ROTOR0_PX", 0.1), ("CA_ROTOR0_AY", -0.5)]},
         "Rotor 1 is tilted by 26.6 degrees"),
    ],
)  # fmt: skip
def test_vehicles_that_are_no_multirotors_are_refused(kind, options, words, tmp_path):
    log = read_flight_log(written(kind, tmp_path, flight(), **options))
    assert words in log.refusals[0]


def test_a_vehicle_of_the_map_that_is_no_multirotor_is_refused(tmp_path):
    (tmp_path / "log").write_text("t [s],volt [V]\n0,1\n1,1\n")
    table = {"time": {"column": "t"}, "battery_voltage": {"columns": ["volt"]}}
    log = read_flight_log(tmp_path / "log", {**table, "vehicle": "fixed-wing"})
    assert "of a fixed-wing (the map's vehicle)" in log.refusals[0]
    assert (
        "of a "
        not in read_flight_log(tmp_path / "log", {**table, "vehicle": "Crazyflie"}).refusals[0]
    )


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("ulog", {"info": [("ver_hw", "PX4_SITL")]}),
        ("bin", {"parameters": [("SIM_WIND_SPD", 0.0)]}),
    ],
)
def test_simulated_logs_are_noted(kind, options, tmp_path):
    log = read_flight_log(written(kind, tmp_path, flight(), **options))
    assert log.is_simulated
    assert "simulator" in log.notes[0]
    assert log.refusals == ()


@pytest.mark.parametrize("kind", NEEDS)
def test_a_missing_library_is_named(kind, tmp_path, monkeypatch):
    path = written(kind, tmp_path, flight())
    monkeypatch.setitem(sys.modules, NEEDS[kind], None)
    with pytest.raises(FileError, match=rf"needs {NEEDS[kind]}: pip install '\.\[logs\]'"):
        read_flight_log(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"\x89PNG\r\n\0\0", r"is no flight log, but PX4 ULog"),
        (b"t [s],battery_voltage [V]\n0,1\n\0,1\n", r"character 31 of"),
        (b"\xbc\x09\0\x01\0abc", "is no flight log: it begins as a micro-SD log"),
        (b"H Product:Blackbox flight data recorder", "a blackbox log of Betaflight"),
        (b"Dear reader,\nthis is a letter.\n", "is no flight log: its first line"),
        (b"t [s],gyroscope.x [rad/s],gyroscope.y [rad/s],gyroscope.z [rad/s]\n", "has no rows"),
        (b"t,battery_voltage [V]\n0,1\n1,1\n", "'t' has no unit; valid are s, sec, ms"),
        (b"t [s],battery_voltage [bar]\n0,1\n1,1\n", "has the unit 'bar'; valid are V, mV"),
        (b"t [s],motor_commands.1\n0,1000\n1,1500\n", "give their range"),
    ],
)  # fmt: skip
def test_other_files_are_refused_in_words(content, words, tmp_path):
    path = tmp_path / "log"
    path.write_bytes(content)
    with pytest.raises((FileError, SettingError)) as error:
        read_flight_log(path)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"accelerometer": {"columns": ["ax"], "unit": "g"}}, "but it has 3: x, y, z"),
        ({"battery_voltage": {"columns": ["volt"], "unit": "mV"}}, "in V by its header, but in mV"),
        ({"battery_voltage": {"columns": ["volts"]}}, "Did you mean 'volt [V]'?"),
        ({"batery_voltage": {"columns": ["volt"]}}, "battery_voltage"),
        ({"motor_commands": {"columns": ["m"], "range": [5, 5]}}, "two different ends"),
        ({"settings": {"gyroscope_cutof": 80}}, "gyroscope_cutoff"),
        ({"settings": {"gyroscope_cutoff": 0}}, "must be positive, but it is 0 Hz"),
    ],
)
def test_maps_that_do_not_fit_are_refused_in_words(change, words, tmp_path):
    (tmp_path / "log").write_text("t [s],volt [V],m,ax\n0,1,5,0\n1,1,5,0\n")
    table = {"time": {"column": "t"}, "battery_voltage": {"columns": ["volt"]}} | change
    with pytest.raises(SettingError) as error:
        read_flight_log(tmp_path / "log", table)
    assert words in str(error.value)


ANSWERS = json.loads((FLIGHTS / "answers.json").read_text()) if FLIGHTS.is_dir() else {}


@real
@pytest.mark.parametrize(
    ("name", "count", "gaps", "begin", "end"),
    [("log10", 50496, 1, 31.4, 68.5), ("log15", 62774, 6, 50.7, 93.2)],
)
def test_flights_of_the_crazyflie(name, count, gaps, begin, end):
    log = stm.io.read_flight_log(FLIGHTS / "crazyflie" / name)
    assert len(log["gyroscope"].ts) == count
    assert sum(gap.channel == "gyroscope" for gap in log.gaps) == gaps
    assert log["gyroscope"].rate == pytest.approx(1010, abs=5)
    np.testing.assert_allclose(log.flights + log.start, [[begin, end]], atol=0.1)
    assert any("crash" in note for note in log.notes)
    assert not any("CRC" in note for note in log.notes)
    assert log.refusals == ()
    # before take-off: gravity, the tilt of the floor and no bias of the gyroscope
    rest = log.window(0.5, begin - log.start - 0.5)
    force = np.mean(rest["accelerometer"].values, axis=0)
    np.testing.assert_allclose(force, ANSWERS["accelerometer_at_rest_m_s2"][name], atol=0.01)
    bias = np.mean(rest["gyroscope"].values, axis=0)
    np.testing.assert_allclose(bias, ANSWERS["gyro_bias_rad_s"][name], atol=2e-4)
    # in flight the weight is carried on average
    assert np.mean(log.flight()["accelerometer"].values[:, 2]) == pytest.approx(g, rel=0.06)
    grid = log.flight().resample(1000)
    assert np.mean(np.isnan(grid["gyroscope"].values)) < 2e-3


@real
def test_flights_with_weights():
    for path in sorted((FLIGHTS / "crazypad").glob("*/E*")):
        log = stm.io.read_flight_log(path)
        assert len(log.flights) == 2
        assert log["battery_voltage"].values.min() > 3.0
        duty = log.flight()["motor_commands"].values
        thrust = log.flight()["thrust_commands"].values
        # the firmware raises the duty as the battery's voltage falls
        assert 1.05 < np.mean(duty) / np.mean(thrust) < 1.15
        assert log["euler_angles"].columns == ("roll", "yaw")
        assert np.max(np.abs(log["euler_angles"].values)) < np.pi
        assert np.mean(log.flight()["position"].values[:, 2]) == pytest.approx(0.5, abs=0.15)


@real
def test_logs_of_px4():
    pytest.importorskip("pyulog")
    read = lambda name: stm.io.read_flight_log(FLIGHTS / "ulog" / f"{name}.ulg")
    disarmed, vtol, simulated = map(
        read, ("sample_appended_multiple", "sample_log_small", "sample_px4_events")
    )
    assert disarmed.refusals == (
        "The log is disarmed throughout; a log with a flight would be valid.",
    )
    assert np.median(disarmed["accelerometer"].values[:, 2]) == pytest.approx(g, abs=0.3)
    assert "VTOL" in vtol.refusals[0]
    assert max(gap.end - gap.start for gap in vtol.gaps) == pytest.approx(0.16, abs=0.01)
    assert simulated.is_simulated
    assert np.sum(np.diff(simulated.flights)) == pytest.approx(11.7, abs=1.5)
    places = simulated.settings["rotor_positions"].value
    np.testing.assert_allclose(places[0], [0.1515, -0.245, 0], atol=1e-6)
    speeds = simulated.flight()["rotor_speeds"].values
    assert 100 < np.median(speeds) < 2000
    assert np.max(simulated["position"].values[:, 2]) > 1.0
    # turned to the world, the mean specific force is gravity and the change of velocity
    hover = simulated.window(18.0, 24.0).resample(50)
    turns = [rotation_matrix_in(np, q) for q in hover["attitude"].values]
    force = np.nanmean(np.einsum("kij,kj->ki", turns, hover["accelerometer"].values), axis=0)
    change = np.nanmean(np.gradient(hover["velocity"].values, 1 / 50, axis=0), axis=0)
    np.testing.assert_allclose(force - change, [0, 0, g], atol=0.03)
    assert any("come at 10 Hz" in note for note in simulated.notes)
