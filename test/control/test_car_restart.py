# SPDX-License-Identifier: Apache-2.0
"""A car that was started over is believed when it stands; a single wrong sensor, or locked wheels, are not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.car_restart import AWAY_S, STANDS_S, CarRestart
from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.stepping import CAR_STARTED_OVER, RealTime
from iwm_power_manager.control.supervision import STALE_SPEED, STALE_WHEELS, Supervision
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.thresholds import Thresholds, actuator_limits, input_limits, supervision_limits
from iwm_power_manager.share import resolve
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.vehicle import load_vehicle

BOTH = STALE_SPEED | STALE_WHEELS
MS = 1_000_000
VEHICLE = load_vehicle(resolve("jalalmaab_2015")).params
RADIUS = VEHICLE.front.wheel.radius_m
T = Thresholds()
LIMITS = ControllerLimits(
    input_limits(T, RADIUS, by_clock=True), (0.03, 0.03, 0.03, 0.3), supervision_limits(T), actuator_limits(T)
)


class Car:
    """Sensors of a car, and a real-time run of the law that hears them at 100 Hz."""

    def __init__(self) -> None:
        controller = Controller(VEHICLE, WHEEL_NAMES, LIMITS, default_settings("equal"), empty_table(), 0.9)
        self.stepper = RealTime(controller, 0.01, T)
        self.now_ns = 1000 * MS

    def run(self, seconds: float, speeds_mps: tuple[float, ...] | None, demand_w: float = 0.0) -> None:
        """Drive; the first of five speeds is `vehicle_speed`, None is silence."""
        monitor = self.stepper.controller.monitor
        for _ in range(round(seconds * 100)):
            self.now_ns += 10 * MS
            self.stepper.begin(self.now_ns * 1e-9)
            now = self.now_ns
            if speeds_mps is not None:
                monitor.take_speed(SpeedReading(now, speeds_mps[0]), now)
                monitor.take_wheels(JointReading(now, WHEEL_NAMES, tuple(v / RADIUS for v in speeds_mps[1:])), now)
            monitor.take_battery(BatteryReading(now, 0.5, 25.0, 237.0, 0.0), now)
            monitor.take_demand(demand_w, 0.0, now)
            self.stepper.step(now)

    def believed_mps(self) -> float:
        return self.stepper.controller.believed_speed_mps


@pytest.fixture
def car() -> Car:
    car = Car()
    car.run(1.0, (10.0,) * 5)
    assert (car.stepper.restarts, car.believed_mps()) == (0, 10.0)
    return car


def test_a_car_that_stands_after_silence_is_believed_a_second_later(car: Car) -> None:
    car.run(1.5 * AWAY_S, None)
    car.run(0.9 * STANDS_S, (0.0,) * 5)
    assert car.stepper.restarts == 0
    car.run(0.5 * STANDS_S, (0.0,) * 5)
    assert (car.stepper.restarts, car.stepper.reason) == (1, CAR_STARTED_OVER)
    car.run(0.5, (0.0,) * 5)
    assert car.believed_mps() == 0.0
    assert car.stepper.controller.command is not None
    assert car.stepper.controller.command.doubted == 0
    assert car.stepper.restarts == 1


def test_one_that_drives_off_again_gets_its_torque(car: Car) -> None:
    car.run(1.5, None)
    car.run(2.0, (0.0,) * 5)
    car.run(1.5, (0.0,) * 5, demand_w=500.0)  # 500 N at 1 m/s
    command = car.stepper.controller.command
    assert command is not None
    assert sum(command.motor_torque_nm) == pytest.approx(500.0 * RADIUS, rel=0.01)


@pytest.mark.parametrize("silent_s", [0.0, 0.8 * AWAY_S])
def test_zeros_without_silence_are_a_control_unit_that_died(car: Car, silent_s: float) -> None:
    car.run(silent_s, None)
    car.run(5.0, (0.0,) * 5)
    assert car.stepper.restarts == 0
    assert car.believed_mps() > 5.0


def test_who_asks_to_brake_may_have_locked_the_wheels(car: Car) -> None:
    car.run(1.5, None)
    car.run(3.0, (0.0,) * 5, demand_w=-20e3)
    assert car.stepper.restarts == 0
    car.run(1.5 * STANDS_S, (0.0,) * 5)
    assert car.stepper.restarts == 1


def test_a_clock_that_was_set_back_is_an_interruption_too(car: Car) -> None:
    car.now_ns -= 500 * MS
    car.run(2.0, (0.0,) * 5)
    assert car.stepper.restarts == 1


@given(
    honest_mps=st.floats(0.2, 40.0),
    wrong=st.integers(0, 4),
    shown_mps=st.floats(-40.0, 60.0),
    silent=st.booleans(),
    demand_w=st.floats(0.0, 6e4),
)
def test_a_single_wrong_sensor_never_makes_a_moving_car_stand(
    honest_mps: float, wrong: int, shown_mps: float, silent: bool, demand_w: float
) -> None:
    """Whatever else the law doubts."""
    shown = [honest_mps] * 5
    shown[wrong] = shown_mps
    assert not found(shown, silent=silent, demand_w=demand_w)


@given(
    shown=st.lists(st.floats(-0.1, 0.1), min_size=5, max_size=5), silent=st.booleans(), demand_w=st.floats(-6e4, 6e4)
)
def test_it_takes_silence_and_nobody_who_brakes(shown: list[float], silent: bool, demand_w: float) -> None:
    assert found(shown, silent=silent, demand_w=demand_w) == (silent and demand_w >= 0.0)


def found(shown_mps: list[float], *, silent: bool, demand_w: float) -> bool:
    """What is found of sensors of which the law believes none, after a silence or without one."""
    watch, monitor = CarRestart(), SimpleNamespace(demand_w=demand_w, shown_mps=shown_mps)
    monitor.ages_s = lambda _: (1.0, 1.0, 0.0, 0.0)
    controller: Any = SimpleNamespace(monitor=monitor, wheels_lost=0, command=SimpleNamespace(doubted=31))
    for i in range(400):
        controller.supervision = Supervision(stale=BOTH if silent and i < 100 else 0)
        watch.look(controller, i * 10 * MS)
    return watch.found
