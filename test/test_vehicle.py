# SPDX-License-Identifier: Apache-2.0
"""Vehicle files: every key with every kind of bad value, curves and maps, and the identity of a car."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import numpy as np
import pytest

from iwm_power_manager import files, vehicle, vehicle_table
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.motor import electrical_power_w, enabled_loss_w, idle_drag_nm
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle, with_params
from oracles.step import loss_w

FOLDER = share_path("config/vehicles")
PAPER = FOLDER / "jalalmaab_2015.yaml"
MAP = share_path("config/motors/siemens_pm_7500w.csv")
CONTENT = files.read_yaml(PAPER)
PAPER_CAR = load_vehicle(PAPER)


def _numbers(content, path=()):
    """Every key of the file that holds one number."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _numbers(value, (*path, key))
        elif isinstance(value, float | int) and path:
            yield (*path, key)


NUMBERS = list(_numbers(CONTENT))
SECTIONS = [key for key, value in CONTENT.items() if isinstance(value, dict)]


def changed(path, value=None, *, drop=False, content=CONTENT):
    """The file's content with one key replaced or dropped."""
    content = copy.deepcopy(content)
    parent = content
    for key in path[:-1]:
        parent = parent[key]
    if drop:
        del parent[path[-1]]
    else:
        parent[path[-1]] = value
    return content


@pytest.fixture
def refused(monkeypatch):
    """The error a content is refused with; what YAML makes of a file is tested with `files`."""

    def load(content):
        monkeypatch.setattr(vehicle.files, "read_yaml", lambda path: content)
        with pytest.raises(ConfigError) as caught:
            load_vehicle(PAPER)
        error = caught.value
        assert error.file == str(PAPER)
        assert str(error).startswith(f"{PAPER}: {error.key}: ")
        assert "\n" not in str(error)
        return error

    return load


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
def test_every_number_is_checked(path, refused):
    key = ".".join(path)
    for value, words in (
        ("80.0", "'80.0' is no number"),
        (None, "None is no number"),
        (True, "True is no number"),
        ([1.0], "[1.0] is no number"),
        (math.nan, "nan is not finite"),
        (math.inf, "inf is not finite"),
        (-math.inf, "-inf is not finite"),
        (1e9, "1000000000.0 is out of range"),
        (-1e9, "-1000000000.0 is out of range"),
    ):
        error = refused(changed(path, value))
        assert (error.key, error.problem) == (key, words)
        assert error.allowed
    missing = refused(changed(path, drop=True))
    assert (missing.key, missing.problem) == (key, "is missing")


@pytest.mark.parametrize("section", SECTIONS)
def test_unknown_keys_and_sections_that_are_none_are_refused(section, refused):
    error = refused(changed((section, "mass"), 1.0))
    assert (error.key, error.problem) == (f"{section}.mass", "is an unknown key")
    assert error.allowed
    for value in (None, 3.0, [1.0], "text"):
        error = refused(changed((section,), value))
        assert (error.key, error.problem) == (section, f"{value!r} is no mapping")
    assert refused(changed((section,), drop=True)).problem == "is missing"


def test_the_motor_s_loss_section_is_checked_too(refused):
    assert refused(changed(("motor", "loss", "x"), 1.0)).key == "motor.loss.x"
    assert refused(changed(("motor", "loss"), 5.0)).key == "motor.loss"


@pytest.mark.parametrize(
    ("path", "value", "key", "allowed"),
    [
        (("format",), 3, "format", "1 | 2"),
        (("format",), "1", "format", "1 | 2"),
        (("format",), True, "format", "1 | 2"),
        (("front",), {}, "front", "format: 2"),
        (("gear",), {"ratio": 2.0}, "gear", "format: 2"),
        (("name",), "", "name", "a printable text that is not empty, 100 characters at most"),
        (("name",), "  ", "name", "a printable text that is not empty, 100 characters at most"),
        (("name",), 5, "name", "a printable text that is not empty, 100 characters at most"),
        (("name",), "\x1b[2Jcar", "name", "a printable text that is not empty, 100 characters at most"),
        (("name",), "two\nlines", "name", "a printable text that is not empty, 100 characters at most"),
        (("name",), "x" * 101, "name", "a printable text that is not empty, 100 characters at most"),
        (("idle_drive",), "off", "idle_drive", "none | drag | enabled"),
        (("idle_drive",), None, "idle_drive", "none | drag | enabled"),
        (("extra",), 1, "extra", None),
        (("chassis", "cg_height_m"), 0.92, "chassis.cg_height_m", "below 0.92 m"),
        (("motor", "efficiency_map"), "a.csv", "motor", "loss | efficiency_map"),
    ],
)
def test_single_rules_are_named(path, value, key, allowed, refused):
    error = refused(changed(path, value))
    assert error.key == key
    assert allowed is None or error.allowed == allowed


@pytest.mark.parametrize("key", ["format", "name", "idle_drive"])
def test_every_top_key_is_needed(key, refused):
    assert refused(changed((key,), drop=True)).key == key


def test_a_motor_needs_one_kind_of_loss(refused):
    assert refused(changed(("motor", "loss"), drop=True)).allowed == "loss | efficiency_map"
    error = refused(changed(("motor",), {**changed(("motor", "loss"), drop=True)["motor"], "efficiency_map": 5}))
    assert (error.key, error.problem) == ("motor.efficiency_map", "5 is no file name")


@pytest.mark.parametrize(
    ("section", "small", "large", "may_equal"),
    [
        ("motor", "regeneration_zero_below_mps", "regeneration_full_above_mps", False),
        ("motor", "continuous_torque_nm", "peak_torque_nm", True),
        ("battery", "charge_full_below_soc", "charge_zero_above_soc", False),
        ("battery", "discharge_zero_below_soc", "discharge_full_above_soc", False),
        ("battery", "charge_zero_below_degc", "charge_full_above_degc", False),
        ("battery", "power_full_below_degc", "power_zero_above_degc", False),
    ],
)
def test_pairs_have_to_be_in_order(section, small, large, may_equal, refused, monkeypatch):
    low, high = CONTENT[section][small], CONTENT[section][large]
    swapped = changed((section, small), high, content=changed((section, large), low))
    assert refused(swapped).key == f"{section}.{large}"
    same = changed((section, large), low)
    if may_equal:
        monkeypatch.setattr(vehicle.files, "read_yaml", lambda path: same)
        load_vehicle(PAPER)
    else:
        error = refused(same)
        assert (error.key, error.allowed) == (f"{section}.{large}", f"more than {small} = {low}")


@pytest.mark.parametrize(
    ("key", "value", "where", "words"),
    [
        ("ocv_soc", None, "ocv_soc", "None is no list"),
        ("ocv_soc", 0.5, "ocv_soc", "0.5 is no list"),
        ("ocv_soc", [0.0], "ocv_soc", "[0.0] is no list"),
        ("ocv_soc", [0.0, "a"], "ocv_soc[1]", "'a' is no number"),
        ("ocv_soc", [0.0, math.nan], "ocv_soc[1]", "nan is not finite"),
        ("ocv_soc", [0.0, 1.1], "ocv_soc[1]", "1.1 is out of range"),
        ("ocv_soc", [0.0, 1.0], "ocv_cell_v", "has 11 values"),
        ("ocv_soc", [i / 11 for i in range(11)], "ocv_soc", "out of order"),
        ("ocv_soc", [(i + 1) / 11 for i in range(11)], "ocv_soc", "out of order"),
        ("ocv_soc", [0.0, 0.2, 0.1, *(i / 10 for i in range(3, 11))], "ocv_soc", "out of order"),
        ("ocv_soc", [0.0, 0.1, 0.1, *(i / 10 for i in range(3, 11))], "ocv_soc", "out of order"),
        ("ocv_cell_v", [3.3] * 10, "ocv_cell_v", "has 10 values"),
        ("ocv_cell_v", [3.3] * 10 + [3.2], "ocv_cell_v", "falls"),
        ("ocv_cell_v", [0.1] * 11, "ocv_cell_v[0]", "0.1 is out of range"),
    ],
)
def test_the_cell_s_curve_is_checked(key, value, where, words, refused):
    error = refused(changed(("battery", key), value))
    assert error.key == f"battery.{where}"
    assert words in error.problem


def test_a_missing_curve_is_missing(refused):
    error = refused(changed(("battery", "ocv_soc"), drop=True))
    assert (error.key, error.problem) == ("battery.ocv_soc", "is missing")


def test_a_flat_curve_is_allowed(monkeypatch):
    content = changed(("battery", "ocv_cell_v"), [3.3] * 11)
    monkeypatch.setattr(vehicle.files, "read_yaml", lambda path: content)
    assert load_vehicle(PAPER).params.battery.ocv_cell_v.tolist() == [3.3] * 11


@pytest.mark.parametrize("text", ["chassis:\n  mass_kg: 1\n  mass_kg: 2\n", "- 1\n", "a: [\n", "", "5"])
def test_what_is_no_vehicle_file_is_refused_with_its_name(tmp_path, text):
    path = tmp_path / "car.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"car\.yaml"):
        load_vehicle(path)
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be read"):
        load_vehicle(tmp_path / "nowhere.yaml")


# --- Front and rear --------------------------------------------------------------------------------------------------

PARTS = ("wheel", "tyre", "motor", "friction_brake")


def per_axle(**changes):
    """The car in format 2 with a section for each axle; changes as `rear={"motor": {...}}`."""
    content = {key: copy.deepcopy(value) for key, value in CONTENT.items() if key not in PARTS}
    content["format"] = 2
    for axle in ("front", "rear"):
        content[axle] = {part: copy.deepcopy(CONTENT[part]) for part in PARTS}
        content[axle].update(changes.get(axle, {}))
    return content


@pytest.fixture
def loaded(monkeypatch):
    """The car a content describes."""

    def load(content):
        monkeypatch.setattr(vehicle.files, "read_yaml", lambda path: content)
        return load_vehicle(PAPER)

    return load


def same(one, two):
    """Equal to the last bit, arrays included."""
    if isinstance(one, np.ndarray):
        return np.array_equal(one, two)
    if isinstance(one, tuple):
        return all(same(a, b) for a, b in zip(one, two, strict=True))
    return one == two


def test_equal_sections_are_the_car_with_one_section_for_both(loaded):
    one = PAPER_CAR
    for content in (per_axle(), {**CONTENT, "format": 2}, {**CONTENT, "format": 2, "gear": {"ratio": 1.0}}):
        other = loaded(content)
        assert same(one.params, other.params)
        assert one.hash == other.hash


def test_each_axle_takes_its_own_section(loaded):
    wide = {**CONTENT["motor"], "peak_torque_nm": 300.0}
    car = loaded(per_axle(rear={"motor": wide, "track_width_m": 1.6})).params
    assert (car.front.motor.peak_torque_nm, car.rear.motor.peak_torque_nm) == (200.0, 300.0)
    assert car.rear.track_width_m == 1.6
    assert car.front.wheel == car.rear.wheel
    mixed = {
        **changed(("motor",), drop=True),
        "format": 2,
        "front": {"motor": CONTENT["motor"]},
        "rear": {"motor": wide},
    }
    assert loaded(mixed).params.rear.motor.peak_torque_nm == 300.0
    assert loaded(mixed).hash != PAPER_CAR.hash


def test_a_part_stands_once_for_each_axle(refused):
    missing = per_axle()
    del missing["rear"]["motor"]
    assert (refused(missing).key, refused(missing).problem) == ("rear.motor", "is missing")
    assert refused({**CONTENT, "format": 2, "front": {"motor": CONTENT["motor"]}}).key == "front.motor"
    assert (
        refused({**per_axle(), "gear": {"ratio": 2.0}, "front": {**per_axle()["front"], "gear": {"ratio": 2.0}}}).key
        == "front.gear"
    )
    wrong = per_axle(rear={"wheel": {"radius_m": 0.33, "inertia_kgm2": -1.0}})
    assert refused(wrong).key == "rear.wheel.inertia_kgm2"
    assert refused(per_axle(front={"track_width_m": 0.1})).key == "front.track_width_m"
    assert refused(per_axle(front={"wing": 1})).key == "front.wing"
    assert refused({**per_axle(), "rear": 5}).problem == "5 is no mapping"


def test_what_the_two_track_plant_needs_is_derived_where_it_is_not_given(loaded):
    car = PAPER_CAR.params
    assert car.chassis.yaw_inertia_kgm2 == pytest.approx(800.0 * 0.92 * 0.92)
    assert (car.chassis.front_roll_share, car.chassis.steering_ratio) == (0.5, 15.0)
    assert car.front.track_width_m == car.rear.track_width_m == pytest.approx(2.4 * 0.6)
    low = loaded(changed(("chassis", "cg_height_m"), 0.3)).params
    assert low.front.track_width_m == pytest.approx(0.56 * 1.84)
    given = loaded(changed(("chassis", "yaw_inertia_kgm2"), 900.0))
    assert given.params.chassis.yaw_inertia_kgm2 == 900.0
    assert given.hash == PAPER_CAR.hash


def test_a_motor_behind_a_gear_is_what_the_wheel_sees(loaded):
    ratio = 4.0
    geared = loaded({**CONTENT, "format": 2, "gear": {"ratio": ratio, "rotor_inertia_kgm2": 0.01}}).params.front
    motor, wheel = PAPER_CAR.params.front.motor, PAPER_CAR.params.front.wheel
    assert geared.motor.peak_torque_nm == ratio * motor.peak_torque_nm
    assert geared.motor.max_power_w == motor.max_power_w
    assert geared.wheel.inertia_kgm2 == pytest.approx(wheel.inertia_kgm2 + 0.16)
    for torque, speed in ((30.0, 20.0), (-30.0, 20.0), (5.0, 90.0)):
        at_wheel = electrical_power_w(ratio * torque, speed / ratio, geared.motor)
        assert at_wheel == pytest.approx(electrical_power_w(torque, speed, motor))
    assert idle_drag_nm(0.0, 10.0, geared.motor) == pytest.approx(ratio * idle_drag_nm(0.0, 10.0 * ratio, motor))


@pytest.mark.parametrize("torque", [-150.0, -40.0, -3.0, 3.0, 40.0, 150.0])
@pytest.mark.parametrize("content", [CONTENT, files.read_yaml(FOLDER / "jalalmaab_2015_map.yaml")], ids=["loss", "map"])
def test_a_gear_takes_its_part_of_the_power_in_the_direction_it_flows(torque, content, loaded):
    ratio, efficiency, speed = 4.0, 0.95, 40.0
    if "efficiency_map" in content["motor"]:
        content = {**content, "motor": {**content["motor"], "mirror": True, "extrapolate": "loss_model"}}
    plain = loaded({**content, "format": 2}).params.front.motor
    geared = loaded({**content, "format": 2, "gear": {"ratio": ratio, "efficiency": efficiency}}).params.front.motor
    at_wheel = torque * ratio * (efficiency if torque > 0.0 else 1.0 / efficiency)
    expected = electrical_power_w(torque, speed, plain)
    assert electrical_power_w(at_wheel, speed / ratio, geared) == pytest.approx(expected, rel=2e-3, abs=1.0)


# --- What comes out --------------------------------------------------------------------------------------------------


def test_the_paper_s_car_has_the_paper_s_numbers():
    params = load_vehicle(PAPER).params
    chassis, motor, battery = params.chassis, params.front.motor, params.battery
    assert (chassis.mass_kg, chassis.frontal_area_m2, chassis.air_density_kgpm3) == (800.0, 1.66, 1.2)
    assert (chassis.front_axle_to_cg_m, chassis.rear_axle_to_cg_m, chassis.cg_height_m) == (0.92, 0.92, 0.6)
    assert (params.front.wheel.radius_m, motor.max_power_w, motor.regeneration_torque_nm) == (0.33, 7500.0, 80.0)
    assert (battery.cells_in_series, battery.nominal_cell_voltage_v, battery.capacity_ah) == (72.0, 3.3, 200.0)
    assert battery.resistance_ohm == 0.063
    assert battery.ohmic_resistance_ohm + battery.polarisation_resistance_ohm == pytest.approx(0.063)


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
def test_every_number_of_the_file_arrives_in_the_parameters(path, monkeypatch):
    section, key = path[0], path[-1]
    before = load_vehicle(PAPER)
    value = CONTENT[section]["loss"][key] if "loss" in path else CONTENT[section][key]
    content = changed(path, value * (1.0 - 1e-9) if value else 1e-9)
    monkeypatch.setattr(vehicle.files, "read_yaml", lambda _: content)
    after = load_vehicle(PAPER)
    holders = [car.params.front if section in car.params.front._fields else car.params for car in (before, after)]
    old, new = (getattr(holder, section)._asdict() for holder in holders)
    # Yaw inertia is derived from mass and distances.
    different = [name for name, x in old.items() if not np.array_equal(x, new[name]) and name != "yaw_inertia_kgm2"]
    assert len(different) == 1
    field = "coefficients" if section == "tyre" and key != "slip_speed_floor_mps" else key
    assert different[0] == field or "loss" in path


def test_idle_drive_can_be_replaced():
    assert load_vehicle(PAPER).idle_drive == "drag"
    for name in ("none", "drag", "enabled"):
        other = load_vehicle(PAPER, name)
        assert other.idle_drive == name
        assert other.params.front.motor.idle_drive == other.params.rear.motor.idle_drive == IDLE_DRIVES[name]
    assert len({load_vehicle(PAPER, name).hash for name in ("none", "drag", "enabled")}) == 3
    with pytest.raises(ConfigError, match=r"idle_drive: 'off' is unknown; allowed: none \| drag \| enabled"):
        load_vehicle(PAPER, "off")


def test_a_car_with_other_numbers_is_another_car():
    car = load_vehicle(PAPER)
    heavy = with_params(car, "heavy", car.params._replace(chassis=car.params.chassis._replace(mass_kg=900.0)))
    assert (heavy.name, heavy.idle_drive, heavy.path) == ("heavy", "drag", car.path)
    assert heavy.hash != car.hash
    assert with_params(heavy, "light again", car.params).hash == car.hash
    assert len(car.hash) == 16


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_vehicle_we_ship_loads_under_its_own_name(path):
    car = load_vehicle(path)
    assert car.name == path.stem
    assert all(isinstance(x, float) for x in car.params.chassis)


def test_shipped_vehicles_differ_from_the_paper_s_car_in_the_motor_only():
    car = load_vehicle(PAPER).params
    for name in ("direct_drive_hub", "jalalmaab_2015_map"):
        other = load_vehicle(FOLDER / f"{name}.yaml").params
        for axle in ("front", "rear"):
            mine = getattr(car, axle)._replace(motor=None)
            assert same(mine, getattr(other, axle)._replace(motor=None))
        assert same(car._replace(front=(), rear=()), other._replace(front=(), rear=()))


def test_the_hub_motor_has_its_own_losses():
    motor = load_vehicle(FOLDER / "direct_drive_hub.yaml").params.front.motor
    w, t = 50.0, 60.0
    assert enabled_loss_w(t, w, motor) == pytest.approx(40 + 1.57 * w + 0.0166 * w**2 + 1.50 * t + 0.045 * t**2)


# --- Motor maps ------------------------------------------------------------------------------------------------------


def test_the_shipped_map_is_that_of_the_loss_coefficients():
    motor = load_vehicle(PAPER).params.front.motor
    rows = np.genfromtxt(MAP, delimiter=",", names=True)
    for w, t, efficiency in zip(rows["speed_rad_s"], rows["torque_nm"], rows["efficiency"], strict=True):
        assert efficiency == pytest.approx(w * t / (w * t + loss_w(t, w, motor)), abs=6e-9)


def test_a_map_gives_back_its_efficiencies_driving_and_regenerating():
    motor = load_vehicle(FOLDER / "jalalmaab_2015_map.yaml").params.front.motor
    rows = np.genfromtxt(MAP, delimiter=",", names=True)
    for w, t, efficiency in zip(rows["speed_rad_s"], rows["torque_nm"], rows["efficiency"], strict=True):
        w, t = float(w), float(t)
        assert w * t / electrical_power_w(t, w, motor) == pytest.approx(efficiency, rel=1e-9)
        assert enabled_loss_w(-t, w, motor) == pytest.approx(enabled_loss_w(t, w, motor))


def test_between_its_points_the_map_is_close_to_the_coefficients():
    mapped = load_vehicle(FOLDER / "jalalmaab_2015_map.yaml").params.front.motor
    motor = load_vehicle(PAPER).params.front.motor
    for w in np.linspace(3.0, 100.0, 23):
        for t in np.linspace(-80.0, 150.0, 24):
            ours, theirs = enabled_loss_w(float(t), float(w), mapped), enabled_loss_w(float(t), float(w), motor)
            assert ours == pytest.approx(theirs, rel=0.03)


def test_a_map_s_path_is_seen_from_the_vehicle_file(tmp_path):
    (tmp_path / "cars").mkdir()
    (tmp_path / "map.csv").write_text(MAP.read_text())
    text = (FOLDER / "jalalmaab_2015_map.yaml").read_text().replace("../motors/siemens_pm_7500w.csv", "../map.csv")
    (tmp_path / "cars" / "car.yaml").write_text(text)
    assert load_vehicle(tmp_path / "cars" / "car.yaml").params.front.motor.map_torque_nm[-1] == 200.0
    (tmp_path / "map.csv").unlink()
    with pytest.raises(ConfigError, match=r"map\.csv: cannot be read"):
        load_vehicle(tmp_path / "cars" / "car.yaml")


def test_the_page_has_the_table():
    page = (Path(__file__).resolve().parents[1] / "docs" / "vehicle.md").read_text()
    table = page.split("<!-- table -->\n")[1].split("<!-- end -->")[0]
    assert table == vehicle_table.markdown(), "write vehicle_table.markdown() to docs/vehicle.md"


# --- Numbers that do not fit each other ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "value", "key", "words"),
    [
        (("motor", "max_power_w"), 15, "motor.max_power_w", "means 0.0187 W per kg of car and motor: kW in a W field?"),
        (("motor", "max_power_w"), 7.5, "motor.max_power_w", "kW in a W field?"),
        (
            ("motor", "peak_torque_nm"),
            20000.0,
            "motor.peak_torque_nm",
            "means 0.124 m/s at which peak torque takes all",
        ),
        (("battery", "discharge_limit_w"), 47.5, "battery.discharge_limit_w", "kW in a W field?"),
        (("battery", "charge_limit_w"), 47.5, "battery.charge_limit_w", "kW in a W field?"),
        (("motor", "regeneration_torque_nm"), 800.0, "motor.regeneration_torque_nm", "means 4 of peak_torque_nm"),
        (
            ("motor", "idle_drag_constant_nm"),
            69.0,
            "motor.idle_drag_constant_nm",
            "means 0.345 of peak_torque_nm",
        ),
        (
            ("battery", "nominal_cell_voltage_v"),
            5.5,
            "battery.nominal_cell_voltage_v",
            "means 1.67 of the open",
        ),
        (
            ("battery", "nominal_cell_voltage_v"),
            1.2,
            "battery.nominal_cell_voltage_v",
            "means 0.363 of the open",
        ),
        (("wheel", "inertia_kgm2"), 0.0011, "wheel.inertia_kgm2", "g m2, or kg cm2 in a kg m2 field?"),
        (("wheel", "inertia_kgm2"), 110.0, "wheel.inertia_kgm2", "kg cm2 in a kg m2 field"),
        (("chassis", "air_density_kgpm3"), 0.0012, "chassis.air_density_kgpm3", "g/cm3 in a kg/m3 field?"),
        (("battery", "cells_in_series"), 720, "battery.cells_in_series", "means 2.38e+03 V of the pack"),
        (("battery", "resistance_ohm"), 6.3, "battery.resistance_ohm", "milliohm in an ohm field"),
        (("battery", "ohmic_resistance_ohm"), 4.15, "battery.ohmic_resistance_ohm", "milliohm in an ohm field"),
        (("battery", "capacity_ah"), 9000.0, "battery.capacity_ah", "Wh or mAh in an Ah field?"),
        (("motor", "loss", "quadratic_torque_w_per_nm2"), 68.5, "motor.loss", "losses of all motors"),
        (("friction_brake", "max_torque_nm"), 0.9, "friction_brake.max_torque_nm", "means 0.00682 m/s2 of this axle's"),
        (("friction_brake", "max_torque_nm"), 9e4, "friction_brake.max_torque_nm", "N mm or a force in N?"),
    ],
)
def test_numbers_that_do_not_fit_each_other_are_refused_with_the_likely_unit(path, value, key, words, refused):
    error = refused(changed(path, value))
    assert error.key == key
    assert words in error.problem


@pytest.mark.parametrize(("value", "noted"), [(0.1, True), (0.0005, True), (0.04, False), (0.002, False), (0.0, False)])
def test_a_rolling_resistance_of_no_firm_road_is_noted(value, noted, loaded):
    notes = loaded(changed(("chassis", "rolling_resistance"), value)).notes
    assert [f"chassis.rolling_resistance: {value:g} is unusual" in note for note in notes] == [True] * noted


def test_a_torque_of_the_motor_s_shaft_without_a_gear_is_noticed(refused):
    content = changed(("motor", "continuous_torque_nm"), 5.0, content=changed(("motor", "peak_torque_nm"), 20.0))
    assert "a torque at the motor's shaft without gear?" in refused(content).problem


def test_the_axle_at_fault_is_named(refused):
    weak = {**CONTENT["motor"], "max_power_w": 7.5}
    assert refused(per_axle(rear={"motor": weak})).key == "rear.motor.max_power_w"


def test_losses_in_kilowatts_are_noticed(refused):
    loss = {key: value / 1000.0 for key, value in CONTENT["motor"]["loss"].items()}
    error = refused(changed(("motor", "loss"), loss))
    assert (error.key, "kW in a W field?" in error.problem) == ("motor.loss", True)


@pytest.mark.parametrize("charge", [0.0, 10e3])
def test_a_battery_may_be_small_or_take_nothing(charge, loaded):
    content = changed(("battery", "discharge_limit_w"), 8e3, content=changed(("battery", "charge_limit_w"), charge))
    assert loaded(content).params.battery.charge_limit_w == charge
