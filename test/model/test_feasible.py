# SPDX-License-Identifier: Apache-2.0
"""What a car cannot follow is said; what it can is not."""

from __future__ import annotations

import pytest

from iwm_power_manager.cycle import load_cycle, make_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.feasible import trace_warnings, traction_wh_per_km
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.study.generate import cycle as drawn
from iwm_sim.study.generate import logged

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params


@pytest.mark.parametrize("name", ["ftp75", "hwfet", "nycc", "udds"])
def test_the_paper_s_car_can_follow_the_paper_s_cycles_on_a_dry_road(name):
    assert trace_warnings(load_cycle(share_path(f"config/cycles/{name}.csv")), CAR, 0.9) == []


def test_a_calm_trace_in_kmh_is_noticed_and_no_cycle_or_drive_gives_a_false_alarm():
    car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    cycles = [load_cycle(share_path(f"config/cycles/{name}.csv")) for name in ("nycc", "udds", "hwfet", "ftp75")]
    cycles += [made for seed in range(0, 60, 3) for made in (drawn(seed), logged(drawn(seed), 0.5, seed))]
    for cycle in cycles:
        assert not any("km/h?" in line for line in trace_warnings(cycle, car, 0.9))
    slow = [cycle for cycle in cycles if 3.6 * cycle.speed_mps.max() < 70.0]  # the others are refused
    assert len(slow) > 5
    for cycle in slow:
        try:
            in_kmh = make_cycle(cycle.name, cycle.time_s, 3.6 * cycle.speed_mps)
        except ConfigError as error:
            assert "looks like km/h" in str(error)  # noqa: PT017
        else:
            assert trace_warnings(in_kmh, car, 0.9)[-1].endswith("is it in km/h?")


def test_nycc_cannot_be_driven_at_friction_0_2():
    lines = trace_warnings(load_cycle(share_path("config/cycles/nycc.csv")), CAR, 0.2)
    assert any("the tyres carry at friction 0.2 1570 N" in line for line in lines)
    assert any("in braking at friction 0.2" in line for line in lines)


def test_each_limit_is_named_with_its_place():
    steep = make_cycle("steep", [0.0, 10.0, 20.0], [0.0, 20.0, 20.0], [0.0, 0.0, 0.4])
    weak = CAR._replace(battery=CAR.battery._replace(discharge_limit_w=5000.0))
    lines = trace_warnings(steep, weak, 1.5)
    assert any("the motors give" in line for line in lines)
    assert any("the battery gives" in line for line in lines)
    brakeless = CAR.with_axles(friction_brake=CAR.front.friction_brake._replace(max_torque_nm=10.0))
    (line,) = trace_warnings(make_cycle("stop", [0.0, 5.0, 10.0], [20.0, 10.0, 10.0]), brakeless, 0.9)
    assert "steep" not in line
    assert "the friction brakes give" in line


@pytest.mark.parametrize(("grade", "doubted"), [(0.3, True), (-0.3, True), (0.18, False)])
def test_a_grade_that_few_roads_have_may_be_in_percent(grade, doubted):
    lines = trace_warnings(make_cycle("hill", [0.0, 10.0, 20.0], [1.0, 1.0, 1.0], [0.0, grade, 0.0]), CAR, 0.9)
    assert [line.endswith("a slope of 30 %, as few roads have: is it in percent or degrees?") for line in lines] == [
        True
    ] * doubted


def test_each_axle_counts_with_its_own_motors():
    idle = CAR.rear.motor._replace(max_power_w=1.0, peak_torque_nm=1.0)
    one = CAR._replace(rear=CAR.rear._replace(motor=idle))
    trace = make_cycle("launch", [0.0, 4.0, 8.0], [0.0, 8.0, 8.0])
    assert trace_warnings(trace, CAR, 0.9) == []
    assert trace_warnings(trace, one, 0.9) != []


def test_the_energy_of_constant_speed_is_the_road_load():
    steady = make_cycle("steady", [0.0, 100.0], [20.0, 20.0])
    newton = 0.5 * 1.2 * 1.66 * 0.34 * 400.0 + 0.01 * 800.0 * 9.81
    assert traction_wh_per_km(steady, CAR) == pytest.approx(newton / 3.6)
