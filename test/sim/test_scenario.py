# SPDX-License-Identifier: Apache-2.0
"""Scenario files: what a good one becomes, and the one line that a bad one gets."""

from __future__ import annotations

import math

import pytest
import yaml

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.share import share_path
from iwm_sim.faults import Fault
from iwm_sim.scenario import Bound, Demand, Friction, load_scenario

SHIPPED = sorted(share_path("config/scenarios").glob("*.yaml"))
GOOD = {
    "format": 1,
    "about": "A test.",
    "demand": [{"from_s": 0.5, "brake": 1.0}],
    "road": {"friction": 0.5},
    "until": {"time_s": 10.0, "standstill": True},
}


def write(tmp_path, content):
    path = tmp_path / "scenario.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_scenario_is_read_and_requires_something(path):
    scenario = load_scenario(path)
    assert scenario.name == path.stem
    assert scenario.require
    assert scenario.about.endswith(".")


def test_what_a_scenario_says_of_itself_steers_no_terminal(tmp_path):
    assert load_scenario(write(tmp_path, GOOD | {"about": "A\n \x1b[2Jtest."})).about == r"A \x1b[2Jtest."


def test_a_full_file_becomes_what_it_says(tmp_path):
    content = GOOD | {
        "load_kg": 80.0,
        "start": {"speed_mps": 20.0, "soc": 0.5},
        "steering": [{"from_s": 1.0, "wheel_deg": 90.0}],
        "direction": "reverse",
        "road": {
            "friction": [{"from_m": 0, "left": 0.2, "right": 0.9}, {"from_m": 50, "friction": 0.4}],
            "grade": [{"from_m": 0, "grade": 0.0}, {"from_m": 10, "grade": 0.1}],
            "headwind_mps": 5.0,
        },
        "faults": [
            {"sensor": "vehicle_speed", "factor": 1.2, "from_s": 1.0, "until_s": 2.0},
            {"actuator": "motor_rear_left", "dead": True},
            {"message": "vehicle_speed", "lost": True, "from_s": 3.0},
            {"message": "imu", "rate_hz": 50, "jitter_s": 0.01, "delay_s": 0.02, "stamp_error_s": 0.02, "until_s": 9.0},
            {"sensor": "wheels", "teeth": 48},
        ],
        "foreign_brakes": [{"from_s": 2.0, "braking_mps2": 4.0}],
        "imu": True,
        "aim": {"lane_m": {"at_most": 2.0}},
        "require": {"stopping_distance_m": {"at_most": 50.0}, "least_braking": {"at_least": 0.8, "at_most": 1.2}},
    }
    scenario = load_scenario(write(tmp_path, content))
    car, believed = scenario.truth.chassis, scenario.vehicle.params.chassis
    assert car.mass_kg == pytest.approx(believed.mass_kg + 80.0)
    assert car.yaw_inertia_kgm2 == pytest.approx(1.1 * believed.yaw_inertia_kgm2)
    assert (scenario.speed_mps, scenario.soc, scenario.direction, scenario.headwind_mps) == (20.0, 0.5, -1, 5.0)
    assert scenario.steering == ((1.0, math.pi / 2),)
    assert (scenario.foreign_brakes, scenario.imu) == (((2.0, 4.0),), True)
    assert scenario.friction == (Friction(0.0, 0.2, 0.9), Friction(50.0, 0.4, 0.4))
    assert scenario.grade == ((0.0, 0.0), (10.0, 0.1))
    assert scenario.assumed_friction == 0.2
    assert scenario.demand == (Demand(0.5, "brake", 1.0),)
    assert scenario.faults == (
        Fault("vehicle_speed", "factor", 1.2, 1.0, 2.0),
        Fault("motor_rear_left", "dead", 0.0, 0.0, math.inf),
        Fault("vehicle_speed", "lost", 0.0, 3.0, math.inf, True),
        Fault("imu", "delay_s", 0.02, 0.0, 9.0, True),
        Fault("imu", "jitter_s", 0.01, 0.0, 9.0, True),
        Fault("imu", "rate_hz", 50.0, 0.0, 9.0, True),
        Fault("imu", "stamp_error_s", 0.02, 0.0, 9.0, True),
        Fault("wheels", "teeth", 48.0, 0.0, math.inf),
    )
    assert scenario.require == (
        Bound("stopping_distance_m", -math.inf, 50.0),
        Bound("least_braking", 0.8, 1.2),
        Bound("lane_m", -math.inf, 2.0, aim=True),
    )


def test_a_cycle_and_a_vehicle_may_stand_beside_the_file(tmp_path):
    (tmp_path / "hill.csv").write_text("time_s,speed_mps\n0,0\n5,6\n10,0\n")
    content = {key: value for key, value in GOOD.items() if key not in ("demand", "until")} | {"cycle": "hill.csv"}
    scenario = load_scenario(write(tmp_path, content), idle_drive="none")
    assert scenario.cycle is not None
    assert (scenario.duration_s, scenario.to_standstill, scenario.steering) == (10.0, False, ())
    assert scenario.vehicle.idle_drive == "none"
    assert load_scenario(write(tmp_path, content | {"until": {"time_s": 99.0}})).duration_s == 10.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format: 2 is unknown; allowed: 1"),
        ({"weather": "rain"}, "weather: is an unknown key"),
        ({"about": 3}, "about: 3 is no sentence"),
        ({"cycle": "udds"}, "needs exactly one of cycle, demand"),
        ({"vehicle": 7}, "vehicle: 7 is no file name"),
        (
            {"vehicle": "hidden/car.yaml"},
            r"vehicle: 'hidden/car.yaml' is no file; allowed: a file, or the name of one of",
        ),
        ({"vehicle": "jalalmaab_2016"}, "vehicle: jalalmaab_2016: cannot be read: .* did you mean jalalmaab_2015"),
        ({"vehicle": "scenario.yml"}, r"vehicle: 'scenario.yml' is no file; .* did you mean .*scenario.yaml"),
        ({"vehicle": "config/vehicles"}, "vehicle: 'config/vehicles' is no file"),
        ({"demand": None, "cycle": "no/such.csv"}, "cycle: 'no/such.csv' is no file"),
        (
            {"demand": None, "cycle": "nycc", "start": {"speed_mps": 5.0}},
            "start.speed_mps: stands beside a cycle, which begins at its own; allowed: cycle without it",
        ),
        ({"demand": []}, r"demand: \[\] is no list"),
        ({"demand": [{"brake": 1.0}]}, r"demand\[0\]: has no from_s"),
        ({"demand": [{"from_s": 0.0, "brake": 1.5}]}, r"demand\[0\].brake: 1.5 is out of range; allowed: 0 to 1"),
        ({"demand": [{"from_s": 0.0, "horn": 1.0}]}, r"demand\[0\]: asks for something else"),
        (
            {"demand": [{"from_s": 1.0, "brake": 1.0}, {"from_s": 1.0, "brake": 0.0}]},
            r"demand\[1\].from_s: 1 does not rise",
        ),
        (
            {"demand": [{"from_s": 0.0, "brake": 1.0}, {"from_s": 500.0, "brake": 0.0}], "until": {"time_s": 10.0}},
            r"demand\[1\].from_s: 500 is never reached; allowed: < 10 s",
        ),
        (
            {"faults": [{"message": "power_demand", "lost": True, "from_s": 1e4}]},
            r"faults\[0\].from_s: 10000 is never reached",
        ),
        (
            {"steering": [{"from_s": 10.0, "wheel_deg": 90.0}], "until": {"time_s": 10.0}},
            r"steering\[0\].from_s: 10 is never reached",
        ),
        (
            {"foreign_brakes": [{"from_s": 11.0, "braking_mps2": 4.0}], "until": {"time_s": 10.0}},
            r"foreign_brakes\[0\].from_s: 11 is never reached",
        ),
        ({"until": None}, "until: is missing"),
        ({"until": {"time_s": 0.0}}, "until.time_s"),
        ({"until": {"time_s": 5.0, "standstill": 1}}, "until.standstill: 1 is neither"),
        ({"foreign_brakes": [{"from_s": 0.0, "braking_mps2": -1.0}]}, r"foreign_brakes\[0\].braking_mps2: -1"),
        ({"imu": "yes"}, "imu"),
        ({"steering": "race"}, "steering: 'race' is unknown"),
        ({"steering": [{"from_s": 0.0, "wheel_deg": 9999.0}]}, r"steering\[0\].wheel_deg"),
        ({"direction": "sideways"}, "direction: 'sideways' is unknown; allowed: forward | reverse"),
        ({"road": {"friction": 3.0}}, "road.friction: 3.0 is out of range; allowed: 0.05 to 1.5"),
        ({"road": {"friction": [{"from_m": 0.0, "left": 0.5}]}}, r"road.friction\[0\].right: is missing"),
        (
            {"road": {"friction": [{"from_m": 30.0, "friction": 0.5}]}},
            r"road.friction\[0\].from_m: 30.0 is out of range; allowed: <= 0 m: the car starts at 0",
        ),
        ({"road": {"friction": 0.5, "grade": 2.0}}, "road.grade"),
        ({"assumed_friction": 0.0}, "assumed_friction"),
        ({"faults": {}}, r"faults: \{\} is no list"),
        ({"faults": [{"factor": 1.0}]}, r"faults\[0\]: names nothing that fails"),
        ({"faults": [{"sensor": "gps", "factor": 1.0}]}, r"faults\[0\].sensor: 'gps' is unknown"),
        ({"faults": [{"sensor": "vehicle_speed"}]}, r"faults\[0\]: does not say what is wrong"),
        ({"faults": [{"sensor": "vehicle_speed", "stuck": False}]}, r"faults\[0\].stuck: is false"),
        (
            {"faults": [{"sensor": "vehicle_speed", "stuck": True, "from_s": 2.0, "until_s": 1.0}]},
            r"faults\[0\].until_s: 1.0 is out of range",
        ),
        ({"faults": [{"message": "imu", "delay_s": -0.01}]}, r"faults\[0\].delay_s: -0.01 .* allowed: 0 to 10 s"),
        ({"faults": [{"message": "imu", "jitter_s": 11}]}, r"faults\[0\].jitter_s: 11 .* allowed: 0 to 10 s"),
        ({"faults": [{"message": "imu", "rate_hz": 0}]}, r"faults\[0\].rate_hz: 0 .* allowed: 0.1 to 1000 Hz"),
        (
            {"faults": [{"message": "wheel_states", "stamp_error_s": True}]},
            r"faults\[0\].stamp_error_s: True is no number; allowed: -10 to 10 s",
        ),
        (
            {"faults": [{"message": "power_demand", "stamp_error_s": 0.1}]},
            r"faults\[0\].stamp_error_s: is an unknown key; allowed: message, lost, delay_s, jitter_s, rate_hz, from_s",
        ),
        ({"faults": [{"message": "imu", "delay": 0.01}]}, r"faults\[0\].delay: is an unknown key; .*delay_s"),
        ({"faults": [{"sensor": "wheels", "teeth": 0}]}, r"faults\[0\].teeth: 0 .* allowed: 1 to 10000"),
        (
            {"faults": [{"sensor": "vehicle_speed", "teeth": 48}]},
            r"faults\[0\].teeth: is an unknown key; allowed: sensor, factor",
        ),
        ({"faults": [{"sensor": "wheels", "factor": 1.0, "offset": 1.0}]}, r"faults\[0\]: does not say what is wrong"),
        ({"require": {"beauty": {"at_most": 1.0}}}, "require.beauty: is an unknown key"),
        ({"aim": {"lane_m": 2.0}}, "aim.lane_m: 2.0 is no mapping"),
        ({"require": {"lane_m": {}}}, "require.lane_m: bounds nothing"),
        ({"require": {"lane_m": {"at_least": 2.0, "at_most": 1.0}}}, "require.lane_m.at_most"),
    ],
)
def test_a_bad_file_gets_one_line_that_names_file_and_key(tmp_path, change, message):
    content = {key: value for key, value in (GOOD | change).items() if value is not None}
    with pytest.raises(ConfigError, match=message) as caught:
        load_scenario(write(tmp_path, content))
    assert "\n" not in str(caught.value)
    assert "scenario.yaml" in str(caught.value)
