# SPDX-License-Identifier: Apache-2.0
"""import_cycle: logs in any unit, with gaps and noise, become a cycle; what was guessed is said."""

from __future__ import annotations

import datetime
import json

import numpy as np
import pytest

from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.share import share_path
from iwm_power_manager.tools.import_cycle import main
from iwm_power_manager.trace_units import SPEED_UNITS

NYCC = load_cycle(share_path("config/cycles/nycc.csv"))


def log_of(path, header, rows, separator=",", comma=False):
    """A table; numbers with a decimal comma where asked."""
    lines = [separator.join(header)]
    lines += [separator.join(str(x).replace(".", ",") if comma else str(x) for x in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def run(capsys, *arguments):
    """Exit code, stdout and stderr of the command."""
    code = main([str(x) for x in arguments])
    return code, *capsys.readouterr()


@pytest.mark.parametrize(
    ("header", "factors", "words"),
    [
        (("time_s", "v [km/h]"), (1.0, 3.6), "speed in km/h, as the column's name says"),
        (("time", "speed"), (1.0, 3.6), "speed in km/h: guessed from the accelerations"),
        (("Time [ms]", "Speed (mph)"), (1e3, 1 / 0.44704), "speed in mph, as the column's name says"),
        (("stamp_ns", "velocity m/s"), (1e9, 1.0), "time in ns, as the column's name says"),
        (("t", "speed"), (1e3, 1.0), "time in ms: guessed"),
        (("time", "v [m/s]"), (1.0 / 86400.0, 1.0), "time in d: guessed"),
    ],
)
def test_units_are_named_or_guessed_and_the_same_cycle_comes_out(tmp_path, capsys, header, factors, words):
    rows = zip(NYCC.time_s * factors[0], NYCC.speed_mps * factors[1], strict=True)
    log = log_of(tmp_path / "log.csv", header, rows)
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv")
    assert code == 0
    assert words in out
    found = load_cycle(tmp_path / "trip.csv")
    np.testing.assert_allclose(found.time_s, NYCC.time_s, atol=1e-6)
    np.testing.assert_allclose(found.speed_mps, NYCC.speed_mps, atol=1e-6)


def test_semicolons_decimal_commas_clocks_and_empty_cells_are_read(tmp_path, capsys):
    rows = [(f"12:00:{t:02d},5", 3.6 * t, "x") for t in range(10)]
    rows[4] = (rows[4][0], "", "x")
    log = log_of(tmp_path / "log.csv", ("Zeit", "Geschwindigkeit km/h", "note"), rows, ";", comma=True)
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv", "--json", tmp_path / "n.json")
    assert code == 0
    assert "decimal commas" in out
    assert "1 rows without a value left out" in out
    assert load_cycle(tmp_path / "trip.csv").speed_mps.tolist() == pytest.approx([0, 1, 2, 3, 5, 6, 7, 8, 9])
    assert json.loads((tmp_path / "n.json").read_text())["speed_unit"] == "km/h"
    out = run(capsys, log, "--output", tmp_path / "trip.csv", "--json", "-")[1]
    assert json.loads(out) == json.loads((tmp_path / "n.json").read_text())


@pytest.mark.parametrize("units", ["s;km/h", "[s];[km/h]", "(s);(km/h)"])
def test_units_in_a_line_of_their_own_and_a_stated_separator_are_read(tmp_path, capsys, units):
    log = tmp_path / "log.csv"
    log.write_text(f"sep=;\nzeit;v\n{units}\n" + "".join(f"{t},5;{3.6 * t:.1f}\n".replace(".", ",") for t in range(10)))
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv")
    assert code == 0
    assert "speed in km/h, as the column's name says" in out
    assert "time in s, as the column's name says" in out
    np.testing.assert_allclose(load_cycle(tmp_path / "trip.csv").speed_mps, np.arange(10.0), atol=0.03)


@pytest.mark.parametrize("nothing", ["#N/A", "#NV", "#DIV/0!", "n.a.", "--", "NA", "NaN", ""])
def test_what_says_that_there_is_no_value_leaves_its_row_out(tmp_path, capsys, nothing):
    rows = [(t, 3.6 * t) for t in range(10)]
    rows[4] = (4, nothing)
    log = log_of(tmp_path / "log.csv", ("t [s]", "v [km/h]"), rows)
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv")
    assert code == 0
    assert "1 rows without a value left out" in out


def test_a_column_of_time_that_is_empty_is_the_last_choice(tmp_path, capsys):
    rows = [("-", t, 3.6 * t) for t in range(10)]
    log = log_of(tmp_path / "log.csv", ("GPS Time", "Device Time", "Speed (km/h)"), rows)
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv", "--time-unit", "s")
    assert code == 0
    assert "time is 'Device Time'" in out
    error = run(capsys, log, "--output", tmp_path / "trip.csv", "--time", "GPS Time")[2]
    assert "has 0 usable rows: columns: time is 'GPS Time', speed is 'Speed (km/h)'; 10 rows without a value" in error


def test_a_column_of_grade_is_taken_and_one_that_looks_like_it_is_said(tmp_path, capsys):
    rows = [(t, t, 0.02 * (t > 4)) for t in range(10)]
    for column, words in (("Grade", "grade is 'Grade'"), ("slope %", "'slope %' is left out: --grade takes it")):
        log = log_of(tmp_path / "log.csv", ("time_s", "speed_mps", column), rows)
        code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv")
        assert code == 0
        assert words in out
        assert load_cycle(tmp_path / "trip.csv").grade.max() == pytest.approx(0.02 if column == "Grade" else 0.0)


def test_two_hundred_samples_in_a_fifth_of_a_second_are_no_drive_of_any_unit(tmp_path, capsys):
    log = log_of(tmp_path / "log.csv", ("time_ms", "speed"), enumerate(NYCC.speed_mps[30:230]))
    code, _, err = run(capsys, log, "--output", tmp_path / "trip.csv")
    assert code == 2
    assert "its speed looks like driving in no unit; allowed: name the unit" in err


@pytest.mark.parametrize(
    ("first", "clock", "words"),
    [
        (0, lambda t: f"{t // 60:02d}:{t % 60:02d}", "time in minutes:seconds: guessed; --time-unit clock says"),
        (0, lambda t: f"{t // 60}:{t % 60:02d}.0", "time in minutes:seconds"),
        (3540, lambda t: f"{t // 60 % 60:02d}:{t % 60:02d}.0", "the clock passes the hour"),
        (3540, lambda t: f"{t // 3600}:{t // 60 % 60:02d}:{t % 60:02d}".removeprefix("0:"), "minutes:seconds"),
    ],
)
def test_a_stopwatchs_minutes_and_seconds_are_no_hours_and_minutes(tmp_path, capsys, first, clock, words):
    clocks = [clock(int(t) + first) for t in NYCC.time_s]
    log = log_of(tmp_path / "log.csv", ("time", "v [m/s]"), zip(clocks, NYCC.speed_mps, strict=True))
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv")
    assert code == 0
    assert words in out
    assert np.array_equal(load_cycle(tmp_path / "trip.csv").time_s, NYCC.time_s)


@pytest.mark.parametrize(("header", "unit"), [("time (hh:mm)", "auto"), ("time", "clock")])
def test_hours_and_minutes_are_read_where_they_are_named(tmp_path, capsys, header, unit):
    log = log_of(tmp_path / "log.csv", (header, "v [m/s]"), [("09:00", 10.0), ("09:01", 12.0), ("09:02", 10.0)])
    code, _, err = run(capsys, log, "--output", tmp_path / "trip.csv", "--time-unit", unit)
    assert code == 2
    assert "the longest of 60 s" in err


def test_a_gap_is_bridged_or_cut_by_choice_and_never_in_silence(tmp_path, capsys):
    keep = (NYCC.time_s < 200) | (NYCC.time_s > 250)
    log = log_of(
        tmp_path / "log.csv", ("time_s", "speed m/s"), zip(NYCC.time_s[keep], NYCC.speed_mps[keep], strict=True)
    )
    output = tmp_path / "trip.csv"
    code, _, err = run(capsys, log, "--output", output)
    assert code == 2
    assert "has 1 gap, the longest of 52 s from 199 s; allowed: --gaps bridge, --gaps cut" in err
    assert not output.exists()
    assert err.startswith(f"import_cycle: error: {log}: ")
    svg = tmp_path / "trip.svg"
    code, out, _ = run(capsys, log, "--output", output, "--gaps", "bridge", "--plot", svg)
    assert "<!-- bridged -->" in svg.read_text()
    assert "<!-- cut out -->" not in svg.read_text()
    assert "gap of 52 s from 199 s bridged by a straight line" in out
    assert load_cycle(output).duration_s == NYCC.duration_s
    code, out, _ = run(capsys, log, "--output", output, "--gaps", "cut", "--plot", svg)
    assert "<!-- cut out -->" in svg.read_text()
    assert "<!-- bridged -->" not in svg.read_text()
    assert "cut out" in out
    assert NYCC.duration_s - 52 < load_cycle(output).duration_s < NYCC.duration_s - 40
    times, speeds = np.concatenate((NYCC.time_s, NYCC.time_s + 1200.0)), np.tile(NYCC.speed_mps, 2)
    moving = (times < 180.0) | (times > 1200.0)
    longer = log_of(tmp_path / "longer.csv", ("time_s", "speed m/s"), zip(times[moving], speeds[moving], strict=True))
    warning = "km are straight lines over gaps that nobody drove"
    assert warning in run(capsys, longer, "--output", output, "--gaps", "bridge")[2]
    assert warning not in run(capsys, longer, "--output", output, "--gaps", "cut")[2]
    code, out, _ = run(capsys, log, "--output", output, "--max-gap", "60")
    assert "1 gap of up to 52 s bridged (--max-gap)" in out


@pytest.mark.parametrize(
    ("speed", "unit", "time", "seconds"),
    [
        ("v_kmph", "km/h", "time_s", 1.0),
        ("speed km_h", "km/h", "t [s]", 1.0),
        ("speed_kn", "kn", "time (msec)", 1e-3),
        ("SOG [kts]", "kn", "time_h", 3600.0),
        ("speed_fps", "ft/s", "time_min", 60.0),
        ("v_m_s", "m/s", "stamp_usec", 1e-6),
    ],
)
def test_units_are_known_by_what_people_call_them(tmp_path, capsys, speed, unit, time, seconds):
    scaled = zip(NYCC.time_s / seconds, NYCC.speed_mps / SPEED_UNITS[unit], strict=True)
    log = log_of(tmp_path / "log.csv", (time, "v_batt", speed), [(t, 350.0, v) for t, v in scaled])
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv", "--speed", speed)
    assert code == 0
    assert f"speed in {unit}, as the column's name says" in out
    assert load_cycle(tmp_path / "trip.csv").distance_m == pytest.approx(NYCC.distance_m, rel=1e-6)
    assert load_cycle(tmp_path / "trip.csv").duration_s == pytest.approx(NYCC.duration_s, rel=1e-6)


def test_of_columns_that_look_like_speed_the_one_with_a_unit_is_taken(tmp_path, capsys):
    rows = [(t, 350.0, 3.6 * v) for t, v in zip(NYCC.time_s, NYCC.speed_mps, strict=True)]
    log = log_of(tmp_path / "log.csv", ("time_s", "v_batt", "speed_kmh"), rows)
    _, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv")
    assert "speed is 'speed_kmh'" in out


@pytest.mark.parametrize("other", ["Speed limit (km/h)", "target_speed_kmh", "avg speed [km/h]"])
def test_a_speed_that_is_not_the_cars_is_not_taken_and_others_are_said(tmp_path, capsys, other):
    log = log_of(tmp_path / "log.csv", ("time_s", other, "Speed"), [(t, 50.0, 3.6 * t) for t in range(10)])
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv", "--speed-unit", "km/h")
    assert code == 0
    assert f"speed is 'Speed'\n{log}: {other!r} looks like speed, too: --speed takes another column" in out
    assert "looks like" not in run(capsys, log, "--output", tmp_path / "trip.csv", "--speed", "Speed")[1]


def test_a_clock_that_passes_midnight_goes_on_and_one_set_back_is_refused(tmp_path, capsys):
    start = datetime.datetime(2024, 5, 1, 23, 55)
    clocks = [(start + datetime.timedelta(seconds=t)).strftime("%H:%M:%S") for t in NYCC.time_s]
    log = log_of(tmp_path / "log.csv", ("time", "v [m/s]"), zip(clocks, NYCC.speed_mps, strict=True))
    _, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv")
    assert "the clock passes midnight" in out
    assert load_cycle(tmp_path / "trip.csv").duration_s == NYCC.duration_s
    back = np.where(NYCC.time_s < 300, NYCC.time_s, NYCC.time_s - 300)
    log = log_of(tmp_path / "set_back.csv", ("time_s", "v [m/s]"), zip(back, NYCC.speed_mps, strict=True))
    code, _, err = run(capsys, log, "--output", tmp_path / "other.csv")
    assert code == 2
    assert "its time falls from 299 to 0, and 299 rows lie behind; allowed: rows in the order of time" in err
    assert not (tmp_path / "other.csv").exists()


def test_a_unit_that_overrules_the_columns_name_is_said(tmp_path, capsys):
    log = log_of(tmp_path / "log.csv", ("time_s", "v [km/h]"), zip(NYCC.time_s, NYCC.speed_mps, strict=True))
    code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv", "--speed-unit", "m/s")
    assert code == 0
    assert "speed in m/s, as --speed-unit says, although the column's name says km/h" in out


def test_smoothing_takes_noise_away_and_says_what_it_does_to_the_energy(tmp_path, capsys):
    trace = NYCC.resample(0.1)
    noise = np.random.default_rng(2).normal(0.0, 0.1 / 3.6, trace.time_s.size)
    rows = zip(trace.time_s, trace.speed_mps + noise, strict=True)
    log = log_of(tmp_path / "log.csv", ("time_s", "speed m/s"), rows)
    numbers = {}
    for smooth in (0, 0.5):
        options = ("--smooth", smooth, "--json", tmp_path / "n.json", "--plot", tmp_path / "trip.png")
        code, out, _ = run(capsys, log, "--output", tmp_path / "trip.csv", *options)
        assert code == 0
        numbers[smooth] = json.loads((tmp_path / "n.json").read_text())
    assert (tmp_path / "trip.png").read_bytes().startswith(b"\x89PNG")
    assert numbers[0]["noise_mps"] == pytest.approx(0.1 / 3.6, rel=0.15)
    assert "as logged (-" in out
    clean = np.interp(load_cycle(tmp_path / "trip.csv").time_s, NYCC.time_s, NYCC.speed_mps)
    assert np.std(load_cycle(tmp_path / "trip.csv").speed_mps - clean) < 0.5 * np.std(noise) + 0.05
    assert numbers[0.5]["traction_wh_per_km"] < 0.97 * numbers[0]["traction_wh_per_km"]


def test_a_trace_the_car_cannot_follow_is_warned_of(tmp_path, capsys):
    log = log_of(tmp_path / "log.csv", ("time_s", "speed m/s"), [(t, min(6.0 * t, 60.0)) for t in range(30)])
    code, _, err = run(capsys, log, "--output", tmp_path / "trip.csv", "--friction", 0.5)
    assert code == 0
    assert "jalalmaab_2015: log: asks" in err
    assert "the motors give" in err
    assert "the tyres carry at friction 0.5 3924 N" in err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("time,speed\n0,0\n", "has 1 usable rows"),
        ("0,0\n1,1\n2,1\n", "line 1: has no header; allowed: a first line that names the columns"),
        (
            "time_s,speed_mps\n" + "".join(f"{t},{min(5 * t, 90)}\n" for t in range(40)),
            "looks like km/h in the m/s column (--speed",
        ),
        ("time_ms,speed m/s\n5000,0\n6000,3\n7000,60\n8000,60\n", "log.csv: 6 s: speed gains 57 m/s in a second"),
        ("a,b\n0,0\n1,1\n", "has no column that looks like time: name it with --time; allowed: a, b"),
        ("Zeit_s;w\n0;0\n1;1\n", "has no column that looks like speed: name it with --speed; allowed: Zeit_s, w"),
        ("time_s,speed m/s\n0,0\n1,fast\n", "line 3, speed m/s: 'fast' is no number"),
        ("time_s,speed m/s\n0,0\n1,-9\n", "driving backwards is no cycle"),
        ("time_s,speed m/s\n0,0,25\n1,0,75\n", "line 2: has 3 values: decimal commas between commas?; allowed: 2"),
        ('time_s,speed m/s\n0,0\n1,"1,234.5"\n', "'1,234.5' is no number: write it without separators"),
        ("time_s,speed m/s\n0,0\n1,60\n", "no car does"),
        ("time,speed_kmh\n" + "".join(f"{t},50\n" for t in range(20)), "its time looks like driving in no unit"),
        ("time_s,speed m/s\n0,6\n0.1,0\n0.2,9\n1,9\n", "jumps by 9 m/s from one sample to the next"),
        ("time,speed\n0,0\n1,1e9\n", "look like driving in no unit"),
        ("time clock,speed m/s\n12:00:00,1\nlater,2\n", "'later' is no time"),
        ("time clock,speed m/s\n12:00:00,1\n12:75:00,2\n", "'12:75:00' is no time"),
        ("time_s,speed m/s\n0," + "1" * 5000 + "\n", "has 5002 characters"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_nothing_is_written(tmp_path, capsys, text, words):
    (tmp_path / "log.csv").write_text(text)
    code, out, err = run(capsys, tmp_path / "log.csv", "--output", tmp_path / "trip.csv")
    assert (code, out) == (2, "")
    assert err.startswith("import_cycle: error: ")
    assert err.count("\n") == 1
    assert words in err
    assert not (tmp_path / "trip.csv").exists()
