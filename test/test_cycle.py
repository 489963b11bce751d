# SPDX-License-Identifier: Apache-2.0
"""Cycles: what is read, what is refused, and with which words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.cycle import load_cycle, make_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import sha256_of
from iwm_power_manager.share import share_path


@pytest.fixture
def write(tmp_path):
    def to_file(text, name="trip.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return to_file


@pytest.mark.parametrize(
    ("name", "duration_s", "distance_km", "top_mps"),
    [
        ("ftp75", 1874, 17.769, 25.347),
        ("hwfet", 765, 16.507, 26.778),
        ("nycc", 598, 1.898, 12.383),
        ("udds", 1369, 11.990, 25.347),
    ],
)
def test_the_shipped_cycles_have_the_published_length(name, duration_s, distance_km, top_mps):
    cycle = load_cycle(share_path(f"config/cycles/{name}.csv"))
    assert cycle.name == name
    assert cycle.duration_s == duration_s
    assert cycle.distance_m / 1000.0 == pytest.approx(distance_km, abs=0.001)
    assert cycle.speed_mps.max() == pytest.approx(top_mps, abs=0.001)


def test_columns_may_come_in_any_order_with_comments_gaps_and_uneven_steps(write):
    path = write("# my trip\nspeed_mps, grade, time_s\n1,0.01,10\n\n3,0.02,12\n# gap\n2,-0.01,100.5\n")
    cycle = load_cycle(path)
    assert cycle.time_s.tolist() == [10.0, 12.0, 100.5]
    assert cycle.speed_mps.tolist() == [1.0, 3.0, 2.0]
    assert cycle.grade.tolist() == [0.01, 0.02, -0.01]
    assert cycle.sha256 == sha256_of(path)
    assert cycle.path == str(path)


def gap_of(write, steps, speeds=None):
    rows = zip(np.cumsum([0, *steps]), speeds or [10.0] * (len(steps) + 1), strict=True)
    return load_cycle(write("time_s,speed_mps\n" + "".join(f"{t},{v}\n" for t, v in rows))).gap


def test_the_longest_step_that_nobody_recorded_is_named_with_its_line(write):
    gap = gap_of(write, [1, 1, 20, 1, 1, 501, 1])
    assert "trip.csv: line 8: is 501 s after the one before, and 1 more such, where 1 s is usual" in gap
    assert "import_cycle --gaps cut" in gap
    assert "10 s after the one before, where 1 s" in gap_of(write, [1, 1, 10, 1])
    assert "line 4: is 5.1 s" in gap_of(write, [0.1, 5.1, 0.1, 0.1])


@pytest.mark.parametrize(
    ("steps", "speeds"),
    [
        ([500], None),  # two points are a cycle
        ([10, 60, 10], None),
        ([1, 1, 9.9, 1], None),
        ([0.1, 0.1, 5, 0.1], None),
        ([1, 600, 1, 1], [1, 0, 0, 1, 1]),  # standing is a straight line, whoever looks
    ],
)
def test_a_step_of_a_traces_own_or_a_rest_is_no_gap(write, steps, speeds):
    assert gap_of(write, steps, speeds) == ""


def test_windows_line_ends_and_a_byte_order_mark_are_read(write):
    assert load_cycle(write(b"\xef\xbb\xbftime_s,speed_mps\r\n0,0\r\n1,1\r\n")).speed_mps.tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("# nothing\n\n", "is empty"),
        ("time_s,speed_mps\n", "has 0 row(s)"),
        ("time_s,speed_mps\n0,1\n", "has 1 row(s)"),
        ("0,1\n1,2\n", "column 'time_s' is missing"),
        ("unix_time,km/h\n0,1\n", "column 'time_s' is missing: import_cycle reads a log; allowed: time_s,speed_mps"),
        ("time_s\n0\n1\n", "line 1: column 'speed_mps' is missing"),
        ("time_s,speed_mps,slope\n0,1,0\n1,1,0\n", "column 'slope' is unknown; allowed: time_s,speed_mps[,grade]"),
        ("time_s,speed_mps,time_s\n0,1,0\n1,1,1\n", "column 'time_s' stands twice"),
        ("time_s,speed_mps\n0,1\n1\n", "line 3: has 1 values; allowed: 2"),
        ("time_s,speed_mps\n0,1\n1,fast\n", "line 3, speed_mps: 'fast' is no number"),
        ("time_s,speed_mps\n0,1\n1,nan\n", "line 3: speed_mps nan is not finite"),
        ("time_s,speed_mps\n0,1\ninf,1\n", "line 3: time_s inf is not finite"),
        ("time_s,speed_mps\n0,1\n1,-0.5\n", "line 3: speed_mps -0.5 is out of range; allowed: 0 to 70"),
        ("time_s,speed_mps\n0,0\n1_0,1_2\n", "line 3, time_s: '1_0' is no number: write it without separators"),
        ("time_s,speed_mps\n0,0\n\u0661,1\n", "line 3, time_s: '\u0661' is no number: write the digits 0 to 9"),
        ("time_s,speed_mps\n0,0\n1,\u22125\n", "speed_mps: '\u22125' is no number: its sign is a dash; write -"),
        ("time_s,speed_mps\n0,0\n1,50 km/h\n", "is no number: write it without a unit"),
        ("time_s,speed_mps\n0,0,1,5\n1,0,1,5\n", "line 2: has 4 values: decimal commas? import_cycle reads them"),
        ("time_s;speed_mps\n0;0\n1;1\n", "line 1: is separated by ';': import_cycle reads that"),
        ("time_s\tspeed_mps\n0\t0\n1\t1\n", "line 1: is separated by tabs"),
        ("time_s,speed_mps\n0,0\n1," + "1" * 400 + "\n", "is no number: it has 400 characters, more than 40"),
        ("time_s,speed_mps\n0,0\n1," + "1" * 5000 + "\n", "line 3: has 5002 characters; allowed: <= 4096"),
        ("time_s,speed_mps\n0," + '"' * 200_001 + "\n", "line 2: has 200003 characters"),
        ("time_s,speed_mps\n0,1\n1,71\n", "line 3: speed_mps 71 is out of range"),
        (
            "time_s,speed_mps,grade\n0,1,0\n1,1,0.6\n",
            "line 3: grade 0.6 is out of range: percent or degrees? it is rise over run; allowed: -0.5 to 0.5",
        ),
        ("time_s,speed_mps\n# pause\n0,1\n2,1\n\n2,1\n", "line 6: time_s 2 does not increase; allowed: > 2 s"),
        ("time_s,speed_mps\n5,1\n2,1\n", "line 3: time_s 2 does not increase"),
        (b"time_s,speed_mps\n0,\xff\n", "is not UTF-8 text"),
        ("time_s,speed_mps\n0,1\n1,1\n".encode("utf-16"), "looks like UTF-16; save it as UTF-8"),
        ("time_s,speed_mps\n0,1\n1,1\n".encode("utf-16-le"), "looks like UTF-16; save it as UTF-8"),
        ("time_s,speed_mps\n0,1\n017,1\n", "line 3, time_s: '017' is no number: write it in decimal digits"),
        ('time_s,speed_mps\n0,"1\n1,1\n', "line 2: is no table"),
    ],
)
def test_a_bad_file_is_refused_with_its_line(write, text, words):
    path = write(text)
    with pytest.raises(ConfigError) as caught:
        load_cycle(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message


def test_a_missing_file_is_a_clear_error(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        load_cycle(tmp_path / "none.csv")


def test_arrays_are_checked_like_files():
    cycle = make_cycle("made", [0, 1, 3], [0.0, 2.0, 2.0])
    assert cycle.distance_m == pytest.approx(5.0)
    assert make_cycle("made", [0, 1, 3], [0.0, 2.0, 2.0]).sha256 == cycle.sha256
    assert make_cycle("made", [0, 1, 3], [0.0, 2.0, 2.1]).sha256 != cycle.sha256
    with pytest.raises(ConfigError, match="sample 1: speed_mps -2 is out of range"):
        make_cycle("made", [0, 1], [0.0, -2.0])
    with pytest.raises(ConfigError, match="different lengths"):
        make_cycle("made", [0, 1], [0.0, 1.0, 2.0])


def test_resampling_is_linear_and_starts_at_zero():
    cycle = make_cycle("made", [10.0, 11.0, 13.0], [0.0, 2.0, 0.0], [0.0, 0.1, 0.1]).resample(0.5)
    assert cycle.time_s.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    assert cycle.speed_mps.tolist() == [0.0, 1.0, 2.0, 1.5, 1.0, 0.5, 0.0]
    assert cycle.grade.tolist() == pytest.approx([0.0, 0.05, 0.1, 0.1, 0.1, 0.1, 0.1])


def test_a_gap_is_known_of_the_same_trace_at_another_step(write):
    cycle = load_cycle(write("time_s,speed_mps\n0,5\n1,5\n2,5\n60,5\n61,5\n"))
    assert cycle.gap
    assert cycle.resample(0.1).gap == cycle.gap


@given(st.integers(1, 400), st.sampled_from([0.01, 0.02, 0.05, 0.1, 0.25]))
def test_resampling_loses_no_whole_step_to_rounding(steps, dt_s):
    assert make_cycle("made", [0.0, steps * dt_s], [1.0, 1.0]).resample(dt_s).time_s.size == steps + 1


@pytest.mark.parametrize("dt_s", [0.0, -0.1, np.nan, np.inf])
def test_a_step_that_is_no_step_is_refused(dt_s):
    with pytest.raises(ConfigError, match="dt_s"):
        make_cycle("made", [0, 1], [0.0, 1.0]).resample(dt_s)


def test_a_cycle_shorter_or_far_longer_than_the_step_is_refused():
    with pytest.raises(ConfigError, match="shorter than a step"):
        make_cycle("made", [0.0, 0.05], [0.0, 1.0]).resample(0.1)
    with pytest.raises(ConfigError, match="too long for steps"):
        make_cycle("made", [0.0, 9e4], [0.0, 1.0]).resample(0.01)


# --- Units -----------------------------------------------------------------------------------------------------------


def scaled(name, time=1.0, speed=1.0, every=1):
    """A shipped cycle with its columns in other units."""
    cycle = load_cycle(share_path(f"config/cycles/{name}.csv"))
    rows = zip(cycle.time_s[::every] * time, cycle.speed_mps[::every] * speed, strict=True)
    return "time_s,speed_mps\n" + "".join(f"{t:.6f},{v:.6f}\n" for t, v in rows)


@pytest.mark.parametrize("name", ["ftp75", "hwfet", "nycc", "udds"])
@pytest.mark.parametrize(
    ("time", "speed", "words"),
    [
        (1.0, 3.6, "looks like km/h in the m/s column"),
        (1e3, 1.0, "looks like ms in the s column"),
        (1e9, 1.0, "looks like ns in the s column"),
        (1.0 / 60.0, 1.0, "looks like"),
        (1e3, 3.6, "in the m/s column"),
    ],
)
def test_a_cycle_in_other_units_is_refused_with_the_likely_one(write, name, time, speed, words):
    with pytest.raises(ConfigError) as caught:
        load_cycle(write(scaled(name, time, speed)))
    assert words in str(caught.value)
    assert "import_cycle converts" in str(caught.value)


def test_the_line_of_an_impossible_acceleration_is_named(write):
    text = "time_s,speed_mps\n" + "".join(f"{t},{min(10 * t, 60)}\n" for t in range(60))
    with pytest.raises(ConfigError, match=r"line 2: speed_mps gains 10 m/s in a second, .*: looks like km/h"):
        load_cycle(write(text))
    text = "time_s,speed_mps\n0,20\n1,20\n2,5\n3,5\n"
    with pytest.raises(ConfigError, match=r"line 3: speed_mps loses 15 m/s in a second, and no car does"):
        load_cycle(write(text))


def test_hard_driving_slow_driving_and_noise_are_no_mistake(write):
    load_cycle(write("time_s,speed_mps\n0,0\n5,40\n20,40\n24,0\n"))
    load_cycle(write("time_s,speed_mps\n0,0\n1000,20\n"))
    load_cycle(write("time_s,speed_mps\n" + "".join(f"{t},13.9\n" for t in range(100))))
    rng = np.random.default_rng(3)
    trace = load_cycle(share_path("config/cycles/nycc.csv")).resample(0.1)
    noisy = np.maximum(trace.speed_mps + rng.normal(0.0, 0.2 / 3.6, trace.time_s.size), 0.0)
    load_cycle(write("time_s,speed_mps\n" + "".join(f"{t},{v}\n" for t, v in zip(trace.time_s, noisy, strict=True))))


def test_noise_of_a_sensor_at_rest_is_rest(write):
    assert load_cycle(write("time_s,speed_mps\n0,-0.001\n1,1\n")).speed_mps.tolist() == [0.0, 1.0]
    assert make_cycle("made", [0, 1], [-0.05, 1.0]).speed_mps.tolist() == [0.0, 1.0]
    at_rest = np.random.default_rng(4).normal(0.0, 0.2 / 3.6, 2000)
    assert make_cycle("made", np.arange(2000.0), at_rest).speed_mps.min() == 0.0


@pytest.mark.parametrize("end", ["1.7e9", "1e12", "100002"])
def test_a_drive_of_days_is_refused_before_it_is_sampled(tmp_path: Path, end: str) -> None:
    path = tmp_path / "date.csv"
    path.write_text(f"time_s,speed_mps\n0,1\n1,2\n{end},1\n")
    with pytest.raises(ConfigError, match=r"line 4: time_s .* s after the first; allowed: a drive in seconds"):
        load_cycle(path)
