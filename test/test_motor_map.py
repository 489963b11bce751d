# SPDX-License-Identifier: Apache-2.0
"""Motor maps: what is read, what is refused, and what of a motor a map has to cover."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager import files
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.motor import enabled_loss_w
from iwm_power_manager.motor_map import (
    MotorMap,
    Reach,
    extended,
    filled,
    fit_loss,
    mirrored,
    missing,
    read_map,
)
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = share_path("config/vehicles/jalalmaab_2015_map.yaml")
MAP = share_path("config/motors/siemens_pm_7500w.csv")
COEFFICIENTS = (46.0, 0.69, 0.0151, 2.03, 0.0685)


def load_efficiency_map(path, mirror=None):
    """Losses on a full grid, as a vehicle file asks for them."""
    return filled(mirrored(path, read_map(path), mirror))


def write(folder: Path, *rows: str, header: str = "speed_rad_s,torque_nm,efficiency") -> Path:
    path = folder / "map.csv"
    path.write_text("\n".join((header, *rows)) + "\n")
    return path


def test_a_map_of_both_signs_is_taken_as_it_is(tmp_path):
    path = write(tmp_path, "10,-20,0.5", "10,20,0.8", "50,-20,0.7", "50,20,0.9")
    speed, torque, loss = load_efficiency_map(path)
    assert (speed.tolist(), torque.tolist()) == ([10.0, 50.0], [-20.0, 20.0])
    # 200 W mechanical: half of it is lost; 200 / 0.8 - 200 W; and so on.
    assert loss == pytest.approx(np.array([[100.0, 50.0], [300.0, 1000.0 / 0.9 - 1000.0]]))


def test_a_map_without_negative_torque_is_mirrored(tmp_path):
    path = write(tmp_path, "10,20,0.8", "10,40,0.5", "50,20,0.9", "50,40,0.9")
    _, torque, loss = load_efficiency_map(path)
    assert torque.tolist() == [-40.0, -20.0, 20.0, 40.0]
    assert np.array_equal(loss, loss[:, ::-1])


def test_at_zero_speed_or_torque_the_loss_is_continued_from_the_neighbours(tmp_path):
    path = write(tmp_path, *(f"{w},{t},{0 if w * t == 0 else 0.8}" for w in (0, 10, 20) for t in (-20, 0, 40)))
    _, _, loss = load_efficiency_map(path)
    # Braking loses 0.2 * 200 W, driving 400 W / 0.8 - 400 W; torque 0 lies a third of the way.
    assert loss[1] == pytest.approx([40.0, 40.0 + (100.0 - 40.0) / 3.0, 100.0])
    assert loss[0] == pytest.approx(loss[1])


def test_spaces_blank_lines_and_the_order_of_rows_do_not_matter(tmp_path):
    rows = ("10,20,0.8", "10,40,0.5", "50,20,0.9", "50,40,0.85")
    tidy = load_efficiency_map(write(tmp_path, *rows))
    messy = load_efficiency_map(
        write(
            tmp_path,
            rows[3],
            "",
            f" {rows[0]} ".replace(",", " , "),
            rows[2],
            rows[1],
            header="speed_rad_s, torque_nm ,efficiency",
        )
    )
    assert all(np.array_equal(a, b) for a, b in zip(tidy, messy, strict=True))


GOOD = ("10,20,0.8", "10,40,0.5", "50,20,0.9", "50,40,0.85")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ((*GOOD, "60,20"), "line 6: has 2 values; allowed: 3"),
        ((*GOOD, "60,20,0.5,1"), "line 6: has 4 values: decimal commas? import_motor reads them; allowed: 3"),
        ((*GOOD, "fast,20,0.5"), "line 6, speed_rad_s: 'fast' is no number; allowed: 0 to 20000"),
        ((*GOOD, "60,,0.5"), "line 6, torque_nm: '' is no number; allowed: -20000 to 20000"),
        ((*GOOD, "60,20,inf"), "line 6, efficiency: inf is not finite; allowed: 0 to 1"),
        ((*GOOD, "60,nan,0.5"), "line 6, torque_nm: nan is not finite"),
        ((*GOOD, "6_0,20,0.5"), "line 6, speed_rad_s: '6_0' is no number: write it without separators"),
        ((*GOOD, '60,"20,5",0.5'), "a decimal comma? write a point"),
        ((*GOOD, "inf,20,0.5"), "line 6, speed_rad_s: inf is not finite; allowed: 0 to 20000"),
        ((*GOOD, "-1,20,0.5"), "line 6, speed_rad_s: -1.0 is out of range; allowed: 0 to 20000"),
        ((*GOOD, "20001,20,0.5"), "line 6, speed_rad_s: 20001.0 is out of range; allowed: 0 to 20000"),
        ((*GOOD, "60,30000,0.5"), "line 6, torque_nm: 30000.0 is out of range; allowed: -20000 to 20000"),
        ((*GOOD, "60,20,85"), "line 6, efficiency: 85 is out of range: in percent? import_motor reads that"),
        ((*GOOD, "60,20,850"), "line 6, efficiency: 850 is out of range: a loss in W? import_motor --quantity loss"),
        ((*GOOD, "60,20,-0.1"), "line 6, efficiency: -0.1 is out of range; allowed: 0 to 1"),
        ((*GOOD, "50,40,0.85"), "line 6: repeats speed 50, torque 40"),
        (GOOD[:2], "has 1 speeds and 2 torques; allowed: 2 or more of each"),
        (GOOD[::2], "has 2 speeds and 1 torques; allowed: 2 or more of each"),
        ((), "has 0 speeds and 0 torques; allowed: 2 or more of each"),
        (("0,0,0", "0,20,0", "10,0,0", "10,-20,nan", "0,-20,0"), "has no efficiency above 0"),
        (("1" * 400 + ",1,1",), "characters, more than 40"),
        (("1," + "x" * 200_000 + ",1",), "line 2: has 200004 characters"),
        (("0,0,0", "0,20,0", "0,-20,0", "0,40,0"), "has 1 speeds"),
    ],
)
def test_a_bad_row_is_named(tmp_path, rows, words):
    with pytest.raises(ConfigError) as caught:
        load_efficiency_map(write(tmp_path, *rows))
    assert words in str(caught.value)


@pytest.mark.parametrize("header", ["", "speed,torque,efficiency", "torque_nm,speed_rad_s,efficiency"])
def test_a_wrong_header_is_named(tmp_path, header):
    with pytest.raises(
        ConfigError, match=r"map\.csv: line [12]: .* is no header; allowed: speed_rad_s,torque_nm,efficiency"
    ):
        load_efficiency_map(write(tmp_path, *GOOD, header=header))


def test_an_empty_or_absent_file_is_named(tmp_path):
    path = tmp_path / "map.csv"
    with pytest.raises(ConfigError, match=r"map\.csv: cannot be read"):
        load_efficiency_map(path)
    path.write_text("")
    with pytest.raises(ConfigError, match=r"map\.csv: is empty"):
        load_efficiency_map(path)


# --- What stands where a motor cannot be -----------------------------------------------------------------------------

KNOWN = ("10,5,0.7095", "10,50,0.7667", "10,100,0.8", "50,5,0.74", "50,50,0.8429", "50,100,0.8667", "100,5,0.7667")


@pytest.mark.parametrize("text", ["", "nan", "0", " ", "whatever", "-3", "1e999"])
def test_what_stands_at_zero_torque_or_speed_is_ignored(tmp_path, text):
    rows = (*KNOWN, "100,50,0.8667", "100,100,0.8818")
    plain = load_efficiency_map(write(tmp_path, *rows))
    zeros = [f"{w},0,{text}" for w in (10, 50, 100)] + [f"0,{t},{text}" for t in (0, 5, 50, 100)]
    speed, torque, loss = load_efficiency_map(write(tmp_path, *rows, *zeros))
    assert (speed.tolist(), torque.tolist()) == ([0, 10, 50, 100], [-100, -50, -5, 0, 5, 50, 100])
    assert np.array_equal(np.delete(loss[1:], 3, axis=1), plain[2])


@pytest.mark.parametrize("eta", ["1e-320", "1e-300", "1e-9"])
@pytest.mark.filterwarnings("error")
def test_an_efficiency_whose_loss_no_motor_has_is_named(tmp_path, eta):
    path = write(tmp_path, "10,-20,0.5", "10,20,0.8", "50,-20,0.7", f"50,20,{eta}")
    with pytest.raises(ConfigError, match=r"map\.csv: speed 50 rad/s, torque 20 N m: efficiency .* means a loss of"):
        read_map(path)


@pytest.mark.parametrize("outside", [(), ("100,100,",), ("100,100,nan",), ("100,100,0",)])
def test_points_a_motor_cannot_reach_may_be_missing_empty_nan_or_zero(tmp_path, outside):
    path = write(tmp_path, *KNOWN, "100,50,0.8667", *outside)
    speed, _, loss = load_efficiency_map(path)
    assert loss.shape == (3, 6)
    # The corner that nobody reaches goes on along the line of the two torques before it.
    at_5, at_50 = 500 / 0.7667 - 500, 5000 / 0.8667 - 5000
    assert loss[2, -1] == pytest.approx(at_50 + (at_50 - at_5) / 45 * 50)
    weak = Reach(peak_torque_nm=100.0, regeneration_torque_nm=80.0, max_power_w=7500.0, top_speed_radps=100.0)
    both = MotorMap(speed, np.array([-100.0, -50, -5, 5, 50, 100]), np.where(loss > 1400.0, np.nan, loss))
    assert missing(both, weak) == []
    strong = weak._replace(max_power_w=12_000.0)
    assert missing(both, strong) == ["1 point inside the motor's limits, as speed 100, torque 100"]


def test_an_efficiency_of_zero_is_a_regeneration_that_brings_nothing_where_harder_braking_brings_something(tmp_path):
    row = ("-40,0.6", "-5,0", "20,0.8", "40,0.8")
    path = write(tmp_path, *(f"{speed},{point}" for speed in (10, 20) for point in row))
    assert read_map(path).loss_w[0, 1] == 50.0


def test_slow_braking_that_brings_nothing_at_any_torque_is_read_as_that_and_what_no_torque_reaches_is_not(tmp_path):
    rows = {10: ("0", "0"), 20: ("0", "0.3"), 40: ("0.5", "0.6"), 80: ("0", "0.7")}  # at 80 rad/s -40 N m is too much
    points = [
        f"{w},{t},{e}" for w, pair in rows.items() for t, e in zip((-40, -5, 5, 40), (*pair, "0.8", "0.8"), strict=True)
    ]
    found = read_map(write(tmp_path, *points)).loss_w
    assert found[:2, :2].tolist() == [[400.0, 50.0], [800.0, 0.7 * 100.0]]  # all that comes in, and no more is known
    assert np.isnan(found[3, 0])


BRAKING = ("10,-5,0.7", "10,-50,0.8", "20,-5,0.7", "20,-50,0.8")


@pytest.mark.parametrize(("rows", "have"), [(BRAKING, "braking"), (GOOD, "driving")])
def test_a_map_of_one_sign_is_refused_or_mirrored_as_asked(tmp_path, rows, have):
    path = write(tmp_path, *rows)
    with pytest.raises(ConfigError, match=f"holds {have} torques only: .* or mirror: true"):
        load_efficiency_map(path, mirror=False)
    _, torque, loss = load_efficiency_map(path, mirror=True)
    assert np.array_equal(torque, -torque[::-1])
    assert np.array_equal(loss, loss[:, ::-1])


def test_a_map_of_braking_torques_is_refused_unless_asked_and_one_of_both_signs_is_not_mirrored(tmp_path):
    with pytest.raises(ConfigError, match="holds braking torques only"):
        load_efficiency_map(write(tmp_path, *BRAKING))
    with pytest.raises(ConfigError, match="nothing to mirror"):
        load_efficiency_map(write(tmp_path, "10,-5,0.7", "10,5,0.8", "20,-5,0.7", "20,5,0.8"), mirror=True)


# --- What a car asks of its map --------------------------------------------------------------------------------------


def cut(folder: Path, keep) -> Path:
    """The shipped map with only some of its points."""
    lines = MAP.read_text().splitlines()
    path = folder / "cut.csv"
    path.write_text("\n".join([lines[0], *(x for x in lines[1:] if keep(*map(float, x.split(","))))]) + "\n")
    return path


def car_with(folder: Path, path: Path, **motor) -> Path:
    """The shipped car of a map with another map, in format 2."""
    content = files.read_yaml(CAR)
    content["format"] = 2
    content["motor"] |= {"efficiency_map": str(path), "mirror": True, **motor}
    car = folder / "car.yaml"
    car.write_text(yaml.safe_dump(content))
    return car


@pytest.mark.parametrize(
    ("keep", "words"),
    [
        (lambda w, t, _: t <= 160, "torques from 160 to the peak torque, 200 N m"),
        (lambda w, t, _: t <= 60, "torques from 60 to the regeneration torque, 80 N m"),
        (lambda w, t, _: w <= 105, "speeds from 105 to the 129.8 rad/s of the car's top speed"),
        (lambda w, t, _: (w, t) != (30, 120), "1 point inside the motor's limits, as speed 30, torque 120"),
    ],
)
def test_a_map_that_does_not_reach_what_the_car_can_do_is_refused_with_what_is_missing(tmp_path, keep, words):
    with pytest.raises(ConfigError) as caught:
        load_vehicle(car_with(tmp_path, cut(tmp_path, keep)))
    assert words in str(caught.value)
    assert "extrapolate: loss_model" in str(caught.value)


def test_points_beyond_the_power_limit_are_not_asked_for(tmp_path):
    path = cut(tmp_path, lambda w, t, _: w * t <= 7500.0)
    ours, whole = load_vehicle(car_with(tmp_path, path)), load_vehicle(CAR)
    assert ours.notes == ()
    motor, reference = ours.params.front.motor, whole.params.front.motor
    for w in (10.0, 40.0, 80.0, 120.0):
        for t in np.linspace(-min(80.0, 7400 / w), min(200.0, 7400 / w), 9):
            assert enabled_loss_w(float(t), w, motor) == pytest.approx(enabled_loss_w(float(t), w, reference), rel=0.04)


def test_a_loss_model_fills_what_is_missing_and_says_its_error(tmp_path):
    path = cut(tmp_path, lambda w, t, _: t <= 100 and w <= 90)
    car = load_vehicle(car_with(tmp_path, path, extrapolate="loss_model"))
    (note,) = car.notes
    assert "torques from 100 to the peak torque" in note
    assert "0.000 rms, 0.000 at most" in note
    motor, whole = car.params.front.motor, load_vehicle(CAR).params.front.motor
    for w, t in ((20.0, 190.0), (125.0, 50.0), (40.0, -75.0)):
        assert enabled_loss_w(t, w, motor) == pytest.approx(enabled_loss_w(t, w, whole), rel=0.02)


def test_format_2_mirrors_a_map_only_if_asked(tmp_path):
    with pytest.raises(ConfigError, match="holds driving torques only"):
        load_vehicle(car_with(tmp_path, MAP, mirror=False))
    with pytest.raises(ConfigError, match=r"motor\.extrapolate: 'guess' is unknown"):
        load_vehicle(car_with(tmp_path, cut(tmp_path, lambda w, t, _: t < 100), extrapolate="guess"))


def test_rpm_in_a_column_of_rad_s_are_noticed(tmp_path):
    path = tmp_path / "rpm.csv"
    lines = [line.split(",") for line in MAP.read_text().splitlines()]
    path.write_text("\n".join([",".join(lines[0]), *(f"{float(w) * 9.5493},{t},{e}" for w, t, e in lines[1:])]))
    with pytest.raises(ConfigError, match=r"reaches 1432\.39 rad/s, .*: rpm in a rad/s column"):
        load_vehicle(car_with(tmp_path, path))


@given(st.lists(st.floats(0.01, 10.0), min_size=5, max_size=5))
def test_the_fit_finds_the_polynomial_a_map_was_made_of(scales):
    coefficients = [c * scale for c, scale in zip(COEFFICIENTS, scales, strict=True)]
    speed, torque = np.array([1.0, 5, 20, 60, 120]), np.array([-150.0, -40, -5, 5, 40, 150])
    w, t = np.meshgrid(speed, np.abs(torque), indexing="ij")
    loss = sum(c * term for c, term in zip(coefficients, (w**0, w, w**2, t, t**2), strict=True))
    fit = fit_loss(MotorMap(speed, torque, loss))
    assert fit.loss_w(w, t) == pytest.approx(loss, rel=1e-6)
    assert fit.worst_error < 1e-6


@given(st.data())
def test_what_is_filled_or_extended_is_complete_keeps_what_is_known_and_never_gains(data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    speed = np.cumsum(rng.uniform(1.0, 30.0, data.draw(st.integers(2, 6))))
    torque = np.concatenate((-np.cumsum(rng.uniform(1.0, 40.0, 3))[::-1], np.cumsum(rng.uniform(1.0, 40.0, 3))))
    loss = rng.uniform(1.0, 500.0, (speed.size, torque.size))
    loss[rng.random(loss.shape) < 0.4] = np.nan
    loss[0, 0] = 100.0
    given_map = MotorMap(speed, torque, loss)
    reach = Reach(300.0, 200.0, 9000.0, 250.0)
    for result in (filled(given_map), filled(extended(given_map, reach, fit_loss(given_map)))):
        assert np.all(np.isfinite(result.loss_w))
        assert np.all(result.loss_w >= 0.0)
        rows, columns = np.searchsorted(result.speed_radps, speed), np.searchsorted(result.torque_nm, torque)
        known = ~np.isnan(loss)
        assert np.array_equal(result.loss_w[np.ix_(rows, columns)][known], loss[known])
    assert missing(extended(given_map, reach, fit_loss(given_map)), reach) == []
