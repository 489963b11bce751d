# SPDX-License-Identifier: Apache-2.0
"""A scenario driven with the power manager in one process: what `make roads`, `evaluate` and the tests call.

The power manager is `control.controller.Controller` as the node runs it in real time: its inputs are checked, aged and
supervised; only DDS and the clock are missing. It has been running for a while when a scenario begins, so that its
motors are released.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import numpy as np

from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.control.settings import Settings, default_settings
from iwm_power_manager.control.thresholds import Thresholds, actuator_limits, for_car, input_limits, supervision_limits
from iwm_power_manager.control.types import WHEEL_NAMES
from iwm_power_manager.policy import PolicyBank
from iwm_power_manager.vehicle import Vehicle
from iwm_sim.closed_loop import BATTERY_TEMPERATURE_DEGC, Run, decision_of
from iwm_sim.drive import Drive, Sensors
from iwm_sim.road_measures import OF_HEALTHY, driven, measured
from iwm_sim.scenario import Bound, Scenario

#: The power manager is given the start of the scenario for this long before the car is let go, s.
SETTLE_S = 1.5
#: Ages at which speed, wheels, demand and battery are missing: three periods of 100 Hz, of 10 Hz for the battery.
AGES_S = (0.03, 0.03, 0.03, 0.3)
_NS_PER_S = 1_000_000_000


class Checked(NamedTuple):
    """One requirement of a scenario and what was measured."""

    bound: Bound
    value: float

    @property
    def holds(self) -> bool:
        """Whether the requirement is met; a value that is not a number meets none."""
        return self.bound.at_least <= self.value <= self.bound.at_most


class RoadResult(NamedTuple):
    """A scenario that was driven."""

    scenario: Scenario
    run: Run
    checked: tuple[Checked, ...]

    @property
    def passed(self) -> bool:
        """Whether all requirements are met; aims do not count."""
        return all(check.holds for check in self.checked if not check.bound.aim)

    @property
    def values(self) -> dict[str, float | None]:
        """What was measured, by name; None for what never happened, since JSON knows no infinity."""
        return {check.bound.measure: check.value if math.isfinite(check.value) else None for check in self.checked}


def controller_of(scenario: Scenario, settings: Settings | None = None, policies: str = "policies") -> Controller:
    """The power manager as the node starts it, for the scenario's car, with the friction it is told as its prior."""
    vehicle: Vehicle = scenario.vehicle
    params = vehicle.params
    if scenario.foreign_brakes:
        params = params.with_axles(friction_brake=params.front.friction_brake._replace(max_torque_nm=0.0))
    thresholds = for_car(Thresholds(), params)
    prior = scenario.assumed_friction
    settings = (settings or default_settings())._replace(friction_prior=prior)
    limits = ControllerLimits(
        inputs=input_limits(thresholds, params.front.wheel.radius_m, by_clock=True),
        age_s=AGES_S,
        supervision=supervision_limits(thresholds),
        actuators=actuator_limits(thresholds),
    )
    bank = PolicyBank(policies, (0.0, 0.5, 0.0, 0.5), vehicle)
    controller = Controller(params, WHEEL_NAMES, limits, settings, bank.table(settings.strategy, prior), prior)
    controller.table_of = functools.partial(bank.table, settings.strategy)
    return controller


def give(controller: Controller, sensors: Sensors, drive: Drive, now_ns: int) -> None:
    """Hand the power manager everything that arrives in this step."""
    monitor = controller.monitor
    monitor.direction = float(sensors.direction)
    if drive.scenario.imu:
        for _, shown in drive.arriving("imu", sensors, now_ns):
            monitor.take_motion("longitudinal_acceleration", shown.acceleration_mps2, now_ns)
            monitor.take_motion("yaw_rate", shown.yaw_rate_radps, now_ns)
            monitor.take_motion("lateral_acceleration", shown.lateral_acceleration_mps2, now_ns)
    for stamp_ns, shown in drive.arriving("vehicle_speed", sensors, now_ns):
        if not math.isnan(shown.speed_mps):
            monitor.take_speed(SpeedReading(stamp_ns, shown.speed_mps), now_ns)
    for stamp_ns, shown in drive.arriving("wheel_states", sensors, now_ns):
        monitor.take_wheels(JointReading(stamp_ns, WHEEL_NAMES, shown.wheel_speed_radps), now_ns)
        monitor.take_torques(JointReading(stamp_ns, WHEEL_NAMES, shown.motor_torque_nm), now_ns)
    for stamp_ns, shown in drive.arriving("battery_state", sensors, now_ns):
        battery = BatteryReading(
            stamp_ns,
            float(np.float32(shown.soc)),
            BATTERY_TEMPERATURE_DEGC,
            shown.battery_voltage_v,
            shown.battery_current_a,
        )
        monitor.take_battery(battery, now_ns)
    for _, shown in drive.arriving("power_demand", sensors, now_ns):
        monitor.take_demand(shown.power_demand_w, 0.0, now_ns)


def drive_scenario(
    scenario: Scenario,
    controller: Controller | None = None,
    *,
    friction_known: bool = False,
    dt_s: float = 0.01,
    substeps: int = 2,
) -> Run:
    """Drive a scenario to its end.

    Parameters
    ----------
    controller : the power manager; None: as the node starts it
    friction_known : it estimates no friction, but knows the road's in each step
    dt_s, substeps : control step, and plant steps in each
    """
    manager = controller or controller_of(scenario)
    table_of = manager.table_of
    if friction_known:
        manager.table_of = None
    drive = Drive(scenario, dt_s=dt_s, substeps=substeps)
    period_ns = round(dt_s * _NS_PER_S)
    now_ns = _NS_PER_S
    start = drive.sense()._replace(power_demand_w=0.0, accelerator=0.0, brake=0.0)
    for _ in range(round(SETTLE_S / dt_s)):
        give(manager, start, drive, now_ns)
        manager.step(now_ns, dt_s)
        now_ns += period_ns
    while not drive.finished:
        give(manager, drive.sense(), drive, now_ns)
        if friction_known and table_of is not None and manager.friction != min(drive.friction):
            manager.friction = min(drive.friction)
            manager.policy = table_of(manager.friction)
        command = manager.step(now_ns, dt_s).command
        drive.advance(
            command.motor_torque_nm,
            command.friction_torque_nm,
            decision_of(command),
            float(manager.supervision.mode),
            float(manager.wheels_lost),
            float(command.doubted),
        )
        now_ns += period_ns
    return drive.run()


def check_scenario(scenario: Scenario, settings: Settings | None = None, policies: str = "policies") -> RoadResult:
    """Drive a scenario and compare what comes out with what it requires."""
    run = drive_scenario(scenario, controller_of(scenario, settings, policies))
    return checked_run(scenario, run, settings, policies)


def checked_run(
    scenario: Scenario, run: Run, settings: Settings | None = None, policies: str = "policies"
) -> RoadResult:
    """Compare a run of a scenario, wherever it was driven, with what the scenario requires."""
    names = [bound.measure for bound in scenario.require]
    healthy = None
    if not OF_HEALTHY.keys().isdisjoint(names):
        whole = dataclasses.replace(scenario, faults=())
        healthy = driven(drive_scenario(whole, controller_of(whole, settings, policies)), scenario.truth)
    values = measured(names, driven(run, scenario.truth), healthy)
    return RoadResult(scenario, run, tuple(Checked(bound, values[bound.measure]) for bound in scenario.require))
