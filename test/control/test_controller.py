# SPDX-License-Identifier: Apache-2.0
"""The power manager without ROS: whatever comes in, what goes out is finite, limited, slew-limited and explained."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core import config as numba_config

from iwm_power_manager.control import law
from iwm_power_manager.control.controller import ControlFaultError, Controller, ControllerLimits
from iwm_power_manager.control.execution import COMPILED, plain_python
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.control.record import SIGNAL_NAMES, SIGNALS, completed, from_numbers, step_of
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.supervision import (
    MODE_DEGRADED,
    MODE_NORMAL,
    MODE_RECOVERING,
    MODE_WAITING,
    STALE_BATTERY,
    STALE_DEMAND,
    STALE_SPEED,
    STALE_WHEELS,
    SupervisionLimits,
)
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.thresholds import Thresholds, actuator_limits, input_limits
from iwm_power_manager.control.types import GATE_BOTH, GATE_FRONT, GATE_REAR, initial_state
from iwm_power_manager.model.limits import wheels_power_w
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle

NAMES = ("front_left", "front_right", "rear_left", "rear_right")
VEHICLE = load_vehicle(resolve(Path("config/vehicles/jalalmaab_2015.yaml"))).params
RADIUS = VEHICLE.front.wheel.radius_m
MS = 1_000_000
DT = 0.01
VALUES: dict[str, Any] = {spec.name: spec.default for spec in config.SPECS}
LIMITS = ControllerLimits(
    input_limits(Thresholds(), RADIUS, by_clock=True),
    config.age_limits_s(VALUES),
    SupervisionLimits(0.3, 2.0, 0.1, 0.2),
    actuator_limits(Thresholds()),
)
#: For coverage and mutation the law runs as plain Python.
EXAMPLES = 60 if numba_config.DISABLE_JIT else max(settings().max_examples, 500)
STALE_ALL = STALE_SPEED | STALE_WHEELS | STALE_DEMAND | STALE_BATTERY


class Drive:
    """A controller and its clock."""

    def __init__(self, limits: ControllerLimits = LIMITS, strategy: str = "equal", vehicle: Any = VEHICLE) -> None:
        self.controller = Controller(vehicle, NAMES, limits, default_settings(strategy), empty_table(), 0.9)
        self.now_ns = 1000 * MS
        self.steps: list[dict[str, float]] = []
        self.commands: list[Any] = []

    def step(self, elapsed_s: float | None = None) -> dict[str, float]:
        self.now_ns += 10 * MS if elapsed_s is None else round(elapsed_s * 1e9)
        command, numbers = self.controller.step(self.now_ns, DT, elapsed_s)
        self.commands.append(command)
        self.steps.append(dict(zip(SIGNAL_NAMES, numbers, strict=True)))
        return self.steps[-1]

    def send(self, speed=10.0, wheels=None, demand=5000.0, soc=0.5, temperature=25.0, without=()) -> None:
        monitor, now = self.controller.monitor, self.now_ns
        wheels = (speed / RADIUS,) * 4 if wheels is None else wheels
        if "speed" not in without:
            monitor.take_speed(SpeedReading(now, speed), now)
        if "wheels" not in without:
            monitor.take_wheels(JointReading(now, NAMES, tuple(wheels)), now)
        if "battery" not in without:
            monitor.take_battery(BatteryReading(now, soc, temperature, 237.0, 0.0), now)
        if "demand" not in without:
            monitor.take_demand(demand, 0.0, now)

    def run(self, steps: int, **inputs: Any) -> dict[str, float]:
        for _ in range(steps):
            self.send(**inputs)
            last = self.step()
        return last


def motor(values: dict[str, float]) -> list[float]:
    return [values[f"{wheel}_motor_torque_nm"] for wheel in NAMES]


def friction(values: dict[str, float]) -> list[float]:
    return [values[f"{wheel}_friction_torque_nm"] for wheel in NAMES]


@pytest.fixture
def drive() -> Drive:
    return Drive()


class TestStart:
    def test_before_any_input_it_waits_with_zero_torque(self, drive) -> None:
        for _ in range(10):
            values = drive.step()
        assert values["mode"] == MODE_WAITING
        assert values["stale"] == STALE_ALL
        assert motor(values) == [0.0] * 4
        assert friction(values) == [0.0] * 4

    def test_torque_comes_once_all_inputs_have_been_good_for_a_while(self, drive) -> None:
        modes = [drive.run(1)["mode"] for _ in range(60)]
        assert modes[0] == MODE_WAITING
        assert MODE_RECOVERING in modes
        assert modes[-1] == MODE_NORMAL
        assert sum(motor(drive.steps[-1])) * 10.0 / RADIUS == pytest.approx(5000.0)

    def test_in_lockstep_the_first_step_drives(self) -> None:
        drive = Drive(LIMITS._replace(age_s=None))
        values = drive.run(1)
        assert values["mode"] == MODE_NORMAL
        assert values["power_demand_w"] == 5000.0
        assert values["stale"] == 0


class TestMissingInputs:
    LIMIT_STEPS = 3

    @pytest.mark.parametrize(
        ("without", "bit"),
        [("speed", STALE_SPEED), ("wheels", STALE_WHEELS), ("demand", STALE_DEMAND), ("battery", STALE_BATTERY)],
    )
    def test_any_missing_input_takes_the_drive_torque_away_in_the_stated_time(self, drive, without, bit) -> None:
        drive.run(60)
        fade_steps = 30
        after = [drive.run(1, without=(without,)) for _ in range(90)]
        first = next(i for i, values in enumerate(after) if values["stale"])
        # battery_state comes ten times more slowly.
        assert first <= (32 if without == "battery" else self.LIMIT_STEPS)
        assert after[first]["stale"] == bit
        assert after[first]["mode"] == MODE_DEGRADED
        torques = [max(motor(values)) for values in after[first:]]
        assert all(b <= a for a, b in itertools.pairwise(torques))
        assert torques[fade_steps] == 0.0
        assert all(max(motor(values)) == 0.0 == min(motor(values)) for values in after[first + fade_steps :])

    def test_a_loop_that_is_held_up_fades_by_the_clock_and_not_by_its_steps(self, drive) -> None:
        drive.run(60)
        assert drive.step(0.15)["motor_factor"] == pytest.approx(0.5)
        values = drive.step(0.2)
        assert values["motor_factor"] == 0.0
        assert values["dt_s"] == DT
        assert motor(values) == [0.0] * 4

    def test_time_that_was_not_seen_does_not_count_as_good(self, drive) -> None:
        drive.run(60)
        drive.run(60, without=("speed", "wheels", "demand", "battery"))
        drive.now_ns += 10_000 * MS
        drive.send()
        _, numbers = drive.controller.step(drive.now_ns, DT, 10.0)
        values = dict(zip(SIGNAL_NAMES, numbers, strict=True))
        assert values["stale"] == 0
        assert values["motor_factor"] == 0.0
        assert drive.controller.supervision.healthy_s == DT

    def test_it_recovers_by_itself(self, drive) -> None:
        drive.run(60)
        drive.run(60, without=("speed", "wheels", "demand", "battery"))
        assert motor(drive.steps[-1]) == [0.0] * 4
        back = [drive.run(1) for _ in range(60)]
        assert [values["mode"] for values in back].index(MODE_RECOVERING) == pytest.approx(10, abs=1)
        assert back[-1]["mode"] == MODE_NORMAL
        torques = [max(motor(values)) for values in back]
        assert max(b - a for a, b in itertools.pairwise(torques)) <= 16.0 + 1e-9

    def test_a_live_brake_demand_moves_from_the_motors_to_the_friction_brakes(self, drive) -> None:
        drive.run(60, demand=-4000.0)
        assert sum(motor(drive.steps[-1])) < -100.0
        for without in (("wheels",), ("battery",)):
            values = drive.run(90, demand=-4000.0, without=without)
            assert motor(values) == [0.0] * 4
            assert sum(friction(values)) * 10.0 / RADIUS == pytest.approx(-4000.0)

    def test_with_the_speed_lost_the_wheels_tell_it(self, drive) -> None:
        drive.run(60, demand=-4000.0)
        wheels = (20.0, 21.0, 22.0, 23.0)
        values = drive.run(20, demand=-4000.0, wheels=wheels, without=("speed",))
        assert values["speed_mps"] == pytest.approx(23.0 * RADIUS)
        values = drive.run(1, demand=4000.0, wheels=wheels, without=("speed",))
        assert values["speed_mps"] == pytest.approx(20.0 * RADIUS)

    def test_with_the_wheels_lost_the_speed_tells_theirs(self, drive) -> None:
        drive.run(60)
        values = drive.run(40, speed=10.2, without=("wheels",))
        assert values["speed_mps"] == 10.2
        assert [values[f"{wheel}_speed_radps"] for wheel in NAMES] == [10.2 / RADIUS] * 4

    def test_with_both_lost_the_last_ones_are_held(self, drive) -> None:
        drive.run(60)
        values = drive.run(40, without=("wheels", "speed"))
        assert values["speed_mps"] == 10.0
        assert [values[f"{wheel}_speed_radps"] for wheel in NAMES] == [10.0 / RADIUS] * 4

    @pytest.mark.parametrize("part", [0.6, 0.8, 0.9])
    def test_with_both_lost_in_a_skid_slip_soon_limits_no_braking(self, drive, part) -> None:
        """What is held is a skid of which nobody can say whether it has ended."""
        drive.run(60)
        drive.run(5, demand=-20e3, wheels=(part * 10.0 / RADIUS,) * 4)
        values = drive.run(40, demand=-20e3, without=("wheels", "speed"))
        assert values["gated_wheels"] == 0
        assert sum(friction(values)) * 10.0 / RADIUS <= -19e3

    def test_a_stale_brake_demand_is_let_go_slowly_and_never_drives(self, drive) -> None:
        drive.run(60, demand=-8000.0)
        after = [drive.run(1, without=("demand",)) for _ in range(230)]
        total = [sum(motor(values)) + sum(friction(values)) for values in after]
        assert all(torque <= 0.0 for torque in total)
        assert all(max(motor(values)) <= 0.0 for values in after)
        held = total[:3]
        assert total[100] == pytest.approx(0.5 * held[0], rel=0.05)
        assert total[-1] == 0.0

    def test_the_record_tells_the_ages_and_the_request(self, drive) -> None:
        drive.run(60)
        values = drive.run(5, demand=7000.0, without=("speed",))
        assert values["vehicle_speed_age_s"] == pytest.approx(0.06)
        assert values["power_demand_age_s"] == pytest.approx(0.01)
        assert values["requested_power_w"] == 7000.0
        assert values["power_demand_w"] < 7000.0


class TestStandIns:
    HELD = (30.0, 30.1, 30.2, 30.3)
    WHEELS = (30.4, 30.5, 30.6, 30.7)

    @pytest.mark.parametrize("stale", range(16))
    def test_speed_and_wheels_stand_in_for_each_other_and_for_nothing_else(self, drive, stale) -> None:
        drive.run(60, wheels=self.HELD)
        bits = {"speed": STALE_SPEED, "wheels": STALE_WHEELS, "demand": STALE_DEMAND, "battery": STALE_BATTERY}
        without = tuple(name for name, bit in bits.items() if stale & bit)
        values = drive.run(40, speed=10.2, wheels=self.WHEELS, without=without)
        assert values["stale"] == stale
        speed = 10.0 if stale & STALE_SPEED else 10.2
        wheels = self.HELD if stale & STALE_WHEELS else self.WHEELS
        if stale & STALE_SPEED and not stale & STALE_WHEELS:
            speed = RADIUS * 30.4
        if stale & STALE_WHEELS and not stale & STALE_SPEED:
            wheels = (10.2 / RADIUS,) * 4
        assert values["speed_mps"] == speed
        assert tuple(values[f"{wheel}_speed_radps"] for wheel in NAMES) == wheels

    @pytest.mark.parametrize(("demand", "wheel"), [(0.5, 30.4), (0.0, 30.4), (-0.5, 30.7)])
    def test_the_wheel_that_slips_least_tells_the_speed(self, drive, demand, wheel) -> None:
        drive.run(60, demand=0.0)
        values = drive.run(10, wheels=self.WHEELS, demand=demand, without=("speed",))
        assert values["speed_mps"] == RADIUS * wheel

    @pytest.mark.parametrize(("every", "held_s"), [(5, 0.1), (10, 0.2), (15, 0.3), (16, 0.0), (2, 0.04)])
    def test_a_speed_that_comes_rarely_is_the_last_one_in_between(self, drive, every, held_s) -> None:
        """It is missing, and lost after twice as long as it took before; beyond 0.15 s at once."""
        for _ in range(6):
            drive.run(1, demand=-4000.0)
            drive.run(every - 1, demand=-4000.0, wheels=(30.0,) * 4, without=("speed",))
        drive.run(1, demand=-4000.0)
        for _ in range(40):
            values = drive.run(1, demand=-4000.0, wheels=(30.0,) * 4, without=("speed",))
            age_s = values["vehicle_speed_age_s"]
            assert (values["stale"] == STALE_SPEED) == (age_s > 0.03)
            assert values["speed_mps"] == (10.0 if age_s <= max(held_s, 0.03) else RADIUS * 30.0), age_s

    @pytest.mark.parametrize(("wheel", "speed"), [(0.5, 0.5 * RADIUS), (-0.5, -0.5 * RADIUS)])
    def test_a_car_that_stands_or_rolls_back_a_little_is_seen_as_it_is(self, drive, wheel, speed) -> None:
        drive.run(60, speed=0.0)
        assert drive.run(10, wheels=(wheel,) * 4, without=("speed",))["speed_mps"] == speed


class TestLateWheels:
    def test_the_limiter_is_slower_by_the_age_of_the_wheel_speeds_alone(self, drive) -> None:
        drive.run(60)
        drive.run(1, without=("wheels",))
        values = drive.run(1, without=("wheels", "battery"))
        ages = [values[f"{name}_age_s"] for name in ("vehicle_speed", "wheel_states", "battery_state")]
        assert ages == pytest.approx([0.01, 0.03, 0.02])
        assert values["setting.slip_limiter_s"] == default_settings("equal").slip_limiter_s + ages[1]

    def test_it_is_slower_by_what_smoothing_takes(self, drive) -> None:
        """Wheels that count teeth: one or two of them more or less in each message."""
        step = 2.0 * math.pi / 48 / DT
        for k in range(60):
            values = drive.run(1, wheels=tuple(step * (2 + (k * 0.7 + 0.3 * i) % 1.0 // 0.6) for i in range(4)))
        count = len(drive.controller.monitor.coarse.weights)
        assert count > 1
        base_s = default_settings("equal").slip_limiter_s + values["wheel_states_age_s"]
        assert values["setting.slip_limiter_s"] == pytest.approx(base_s + 0.5 * count * DT)

    def test_what_the_road_takes_is_told_by_each_wheels_own_inertia(self) -> None:
        """Without torque, wheels that lose a radian a second in each step are braked by the road."""
        axles = [
            axle._replace(wheel=axle.wheel._replace(inertia_kgm2=i))
            for axle, i in zip(VEHICLE[1:3], (1.0, 2.0), strict=True)
        ]
        drive = Drive(vehicle=VEHICLE._replace(front=axles[0], rear=axles[1]))
        for k in range(40):
            drive.run(1, demand=0.0, wheels=(10.0 / RADIUS - 0.1 * k,) * 4)
        values = drive.run(1, demand=0.0, without=("wheels",))
        assert motor(values) == [0.0] * 4
        shifts = [values[f"{wheel}_torque_shift_nm"] for wheel in NAMES]
        assert shifts == pytest.approx([10.0, 10.0, 20.0, 20.0], abs=0.1)


class TestLostWheel:
    def test_the_other_wheel_of_the_axle_stands_in_and_slip_is_judged_more_strictly(self, drive) -> None:
        drive.run(60)
        values = drive.run(2, wheels=(math.nan, 30.0, 30.5, 30.5))
        assert values["wheels_lost"] == 1
        assert values["front_left_speed_radps"] == 30.0
        assert values["setting.critical_slip"] == default_settings("equal").critical_slip * 0.75
        assert values["setting.slip_target"] == default_settings("equal").slip_target * 0.75
        assert values["setting.gate_hysteresis"] == default_settings("equal").gate_hysteresis * 0.75
        slower = default_settings("equal").slip_limiter_s + values["wheel_states_age_s"]  # by the delay of its loop
        assert values["setting.slip_limiter_s"] == slower * 0.75
        assert values["mode"] == MODE_NORMAL
        assert min(motor(values)) > 0.0
        values = drive.run(100)
        assert values["wheels_lost"] == 0
        assert values["setting.critical_slip"] == default_settings("equal").critical_slip

    def test_each_wheel_has_its_bit(self, drive) -> None:
        drive.run(60)
        assert drive.run(1, wheels=(30.0, math.nan, math.nan, 30.0))["wheels_lost"] == 6

    def test_an_axle_without_wheels_counts_as_missing_wheels(self, drive) -> None:
        drive.run(60)
        values = drive.run(5, wheels=(math.nan, math.nan, 30.0, 30.0))
        assert values["stale"] == STALE_WHEELS


class TestBattery:
    def test_a_full_battery_takes_nothing_and_friction_brakes(self) -> None:
        drive = Drive()
        values = drive.run(60, demand=-4000.0, soc=1.0)
        assert values["charge_limit_w"] == 0.0
        # A little braking torque is left to the motors: what their own losses eat up.
        assert wheels_power_w(tuple(motor(values)), (10.0 / RADIUS,) * 4, 1.0, VEHICLE) >= -1e-6
        assert (sum(friction(values)) + sum(motor(values))) * 10.0 / RADIUS == pytest.approx(-4000.0)
        assert sum(friction(values)) < 10.0 * sum(motor(values))

    def test_a_hot_battery_gives_and_takes_less(self) -> None:
        values = Drive().run(60, temperature=52.5)
        assert values["discharge_limit_w"] == pytest.approx(0.5 * VEHICLE.battery.discharge_limit_w)
        assert values["charge_limit_w"] == pytest.approx(0.5 * VEHICLE.battery.charge_limit_w)

    def test_an_empty_battery_gives_nothing(self) -> None:
        values = Drive().run(60, soc=0.02)
        assert values["discharge_limit_w"] == 0.0
        assert max(motor(values)) == 0.0


class TestMotorReports:
    def test_a_motor_that_reports_no_torque_is_asked_for_none(self, drive) -> None:
        drive.run(60, demand=9000.0)
        for _ in range(60):
            torques = [0.0 if i == 1 else torque for i, torque in enumerate(motor(drive.steps[-1]))]
            drive.controller.monitor.take_torques(JointReading(drive.now_ns, NAMES, tuple(torques)), drive.now_ns)
            values = drive.run(1, demand=9000.0)
        assert motor(values)[1] == 0.0
        assert motor(values)[0] > 1.0

    def reported(self, drive, factor, steps, **inputs) -> list[float]:
        for _ in range(steps):
            torques = tuple(factor * torque for torque in motor(drive.steps[-1]))
            drive.controller.monitor.take_torques(JointReading(drive.now_ns, NAMES, torques), drive.now_ns)
            values = drive.run(1, **inputs)
        return motor(values)

    @pytest.mark.parametrize(("direction", "speed", "least_mps2"), [(1, 0.0, 0.2), (-1, -1.0, 0.55), (1, 10.0, 0.59)])
    def test_four_motors_that_seem_dead_drive_gently_brake_not_and_are_whole_once_one_follows(
        self, drive, direction, speed, least_mps2
    ) -> None:
        drive.controller.monitor.direction = float(direction)
        driving, braking = {"speed": speed, "demand": 15000.0}, {"speed": speed, "demand": -3000.0}
        drive.run(60, **driving)
        whole = sum(self.reported(drive, 1.0, 60, **driving))
        for _ in range(2):
            tried = self.reported(drive, 0.0, 60, **driving)
            assert least_mps2 <= direction * sum(tried) / RADIUS / VEHICLE.chassis.mass_kg <= 0.61
            assert self.reported(drive, 0.0, 60, **braking) == [0.0] * 4
            assert min(map(abs, friction(drive.steps[-1]))) > 1.0
        assert sum(self.reported(drive, 0.0, 30, speed=speed, demand=4.0)) < 0.1 * abs(sum(tried))
        assert sum(self.reported(drive, 1.0, 120, **driving)) == pytest.approx(whole, rel=0.1)


class TestRecord:
    def test_signals_have_unique_names_and_meanings(self) -> None:
        assert len(set(SIGNAL_NAMES)) == len(SIGNAL_NAMES)
        assert all(signal.meaning for signal in SIGNALS)

    def test_a_recorded_run_can_be_repeated_bit_for_bit(self) -> None:
        drive = Drive(strategy="instantaneous_slip")
        drive.run(70, demand=9000.0)
        drive.run(20, demand=-9000.0)
        drive.run(20, demand=9000.0, without=("wheels",))
        drive.run(30, demand=-3000.0, wheels=(5.0, math.nan, 20.0, 20.0))
        drive.controller.reset()
        drive.run(50, demand=-3000.0)
        state = initial_state()
        for values, command in zip(drive.steps, drive.commands, strict=True):
            recorded = from_numbers(list(values.values()))
            if recorded.first:
                state = initial_state()
            again, state = law.step(recorded.measurement, state, recorded.settings, VEHICLE, empty_table())
            assert again == command
        assert sum(from_numbers(list(values.values())).first for values in drive.steps) == 2

    def test_what_an_imu_shows_is_recorded_and_so_is_its_silence(self, drive) -> None:
        drive.run(60, demand=9000.0)
        drive.controller.monitor.take_motion("longitudinal_acceleration", -3.5, drive.now_ns)
        drive.controller.monitor.take_motion("yaw_rate", 0.2, drive.now_ns)
        drive.controller.monitor.take_motion("yaw_rate", -10.1, drive.now_ns)  # no car's
        drive.controller.monitor.take_motion("lateral_acceleration", -1.5, drive.now_ns)
        drive.controller.monitor.take_motion("lateral_acceleration", 1e3, drive.now_ns)  # no car's
        heard, *_, silent = [drive.step() for _ in range(40)]
        measured = [from_numbers(list(values.values())).measurement for values in (heard, silent)]
        nothing = pytest.approx(math.nan, nan_ok=True)
        assert [m.acceleration_mps2 for m in measured] == [-3.5, nothing]
        assert [m.yaw_rate_radps for m in measured] == [0.2, nothing]
        assert [m.lateral_mps2 for m in measured] == [-1.5, nothing]

    def test_reset_forgets_inputs_and_memory(self, drive) -> None:
        drive.run(60, demand=9000.0)
        drive.controller.reset()
        monitor = drive.controller.monitor
        assert not monitor.driven
        assert (monitor.speed_mps, monitor.demand_w, monitor.wheel_speed_radps) == (0.0, 0.0, (0.0,) * 4)
        assert drive.controller.state == initial_state()
        assert drive.step()["stale"] != 0

    def test_reset_forgets_the_friction_that_was_estimated(self, drive) -> None:
        controller = drive.controller
        controller.table_of = lambda _friction: empty_table()
        controller.settings = controller.settings._replace(friction_prior=0.5)
        assert drive.run(3)["friction"] == 0.5
        controller.settings = controller.settings._replace(friction_prior=0.8)
        assert drive.run(1)["friction"] == 0.5
        controller.reset()
        assert drive.run(1)["friction"] == 0.8

    def test_settings_come_back_with_the_types_the_law_was_compiled_for(self, drive) -> None:
        values = drive.run(1)
        settings_again = from_numbers(list(values.values())).settings
        slower = default_settings("equal").slip_limiter_s + values["wheel_states_age_s"]
        assert settings_again == default_settings("equal")._replace(slip_limiter_s=slower)
        assert [type(a) for a in settings_again] == [type(b) for b in default_settings("equal")]

    def test_a_record_that_lacks_a_signal_is_refused(self, drive) -> None:
        values = drive.run(1)
        del values["dt_s"]
        with pytest.raises(KeyError):
            completed(list(values), list(values.values()))

    @pytest.mark.parametrize("number", [math.nan, math.inf, -1.0, 1e300])
    @pytest.mark.parametrize("name", ["step", "setting.strategy"])
    def test_what_counts_or_chooses_nothing_is_refused(self, drive, name: str, number: float) -> None:
        values = drive.run(1) | {name: number}
        with pytest.raises(ValueError):
            step_of(list(values.values()))
            from_numbers(list(values.values()))

    def test_an_unknown_strategy_is_refused(self, drive) -> None:
        with pytest.raises(ValueError, match="strategy 99 does not exist"):
            from_numbers(list((drive.run(1) | {"setting.strategy": 99.0}).values()))


def test_until_something_is_commanded_every_brake_counts_in_full(drive) -> None:
    assert drive.controller.brake_gain == (1.0,) * 4
    drive.run(1)
    assert drive.controller.brake_gain == drive.controller.state.motion.brake_gain


class TestFriction:
    @staticmethod
    def slipping(drive: Drive, steps: int) -> list[float]:
        """Friction of each step while the wheels slip with hardly any torque, as on ice."""
        return [drive.run(1, speed=15.0, wheels=(13.2 / RADIUS,) * 4, demand=-6000.0)["friction"] for _ in range(steps)]

    def test_the_policy_is_that_of_the_friction_that_was_estimated_in_the_step_before(self, drive) -> None:
        controller, asked = drive.controller, []
        controller.table_of = lambda friction: asked.append(friction) or empty_table(rule=(friction, 0.5, 0.0, 0.5))
        controller.settings = controller.settings._replace(friction_prior=0.8)
        drive.run(60, speed=15.0)
        for _ in range(100):
            assumed = controller.state.friction.assumed
            [used] = self.slipping(drive, 1)
            assert used == controller.friction == assumed
            assert controller.policy.rule[0] == used
        assert used < 0.4
        assert len(asked) < 60, "a policy is only asked for when the friction is another"

    def test_without_policies_of_other_frictions_the_one_given_stays(self, drive) -> None:
        drive.run(60, speed=15.0)
        assert set(self.slipping(drive, 100)) == {0.9}
        assert drive.controller.state.friction.assumed < 0.4


class TestFaultOfTheLaw:
    @pytest.mark.parametrize("torque", [math.nan, 1e6])
    def test_what_no_motor_may_be_given_never_leaves(self, drive, torque) -> None:
        drive.run(60)
        good = drive.controller.command

        def broken(*arguments: Any) -> Any:
            command, *rest = COMPILED.advance(*arguments)
            return command._replace(motor_torque_nm=(torque, 0.0, 0.0, 0.0)), *rest

        drive.controller.run_by(COMPILED._replace(advance=broken))
        state = drive.controller.state
        with pytest.raises(ControlFaultError, match="wheel 0"):
            drive.controller.step(drive.now_ns, DT)
        assert drive.controller.command is good
        assert drive.controller.state == state


class TestGoingOver:
    def test_from_plain_python_to_the_compiled_law_every_number_stays_what_it_was(self) -> None:
        """Three drives, which are the same: compiled, in plain Python, and from one to the other on the way."""
        compiled, plain, over = Drive(), Drive(), Drive()
        plain.controller.run_by(plain_python())
        over.controller.run_by(plain_python())
        for k in range(400):
            speed = 12.0 * math.cos(0.02 * k)
            rims = tuple(speed / RADIUS * (1.0 + 0.1 * math.sin(0.7 * k + i)) for i in range(4))
            lost = [name for name, since in (("speed", 60), ("wheels", 160), ("demand", 260)) if since < k < since + 30]
            if k == 200:
                over.controller.run_by(COMPILED)
            for drive in (compiled, plain, over):
                drive.send(speed=speed, wheels=rims, demand=2e4 * math.sin(0.1 * k), without=lost)
                drive.step()
        assert repr(plain.steps) == repr(compiled.steps)
        assert repr(over.steps) == repr(compiled.steps)
        assert repr(plain.controller.state) == repr(over.controller.state) == repr(compiled.controller.state)
        assert not plain.controller.execution.faults

    def test_until_then_the_split_is_equal_whatever_strategy_is_chosen(self) -> None:
        chosen, equal = Drive(strategy="rule"), Drive()
        chosen.controller.run_by(plain_python())
        assert chosen.run(100) == equal.run(100)
        chosen.controller.run_by(COMPILED)
        equal.controller.settings = default_settings("rule")
        assert chosen.run(100) == equal.run(100)
        assert chosen.steps[-1]["setting.strategy"] == default_settings("rule").strategy

    def test_what_cannot_be_gone_over_to_leaves_all_as_it_was(self, drive) -> None:
        def refused(_: Any) -> Any:
            raise TypeError("of other types")

        drive.controller.run_by(plain_python())
        drive.run(60)
        with pytest.raises(TypeError):
            drive.controller.run_by(COMPILED._replace(hold=refused))
        assert drive.run(1)["mode"] == MODE_NORMAL


# What a broken network, a broken sensor or a broken program may send.
numbers = st.one_of(st.floats(), st.floats(-100.0, 100.0), st.sampled_from([math.nan, math.inf, -math.inf, 1e308, 0.0]))
names = st.one_of(
    st.just(NAMES),
    st.permutations(NAMES).map(tuple),
    st.lists(st.sampled_from((*NAMES, "other", "")), max_size=6).map(tuple),
)
stamps = st.one_of(st.integers(-40, 5), st.integers(-10_000, 10_000))
messages = st.one_of(
    st.tuples(st.just("speed"), stamps, st.one_of(numbers, st.floats(0.0, 40.0))),
    st.tuples(st.just("wheels"), stamps, names, st.lists(st.one_of(numbers, st.floats(0.0, 120.0)), max_size=6)),
    st.tuples(st.just("demand"), st.floats(0.0, 0.3), st.one_of(numbers, st.floats(-2e5, 1e5))),
    st.tuples(st.just("battery"), stamps, st.one_of(numbers, st.floats(0.0, 1.0)), numbers),
    st.tuples(st.just("friction"), st.just(0), numbers),
    st.tuples(st.just("good"), st.floats(0.0, 40.0), st.floats(-3e4, 3e4)),
    st.tuples(st.just("good"), st.just(10.0), st.floats(-3e4, 3e4)),
)
sequences = st.lists(st.lists(messages, max_size=4), min_size=1, max_size=30)


def feed(drive: Drive, message: tuple[Any, ...]) -> None:
    monitor, now = drive.controller.monitor, drive.now_ns
    kind = message[0]
    if kind == "good":
        drive.send(speed=message[1], demand=message[2])
    elif kind == "demand":
        monitor.take_demand(message[2], message[1], now)
    elif kind == "friction":
        monitor.take_friction(message[2], now)
    else:
        stamp = now + message[1] * MS
        if kind == "speed":
            monitor.take_speed(SpeedReading(stamp, message[2]), now)
        elif kind == "wheels":
            monitor.take_wheels(JointReading(stamp, message[2], tuple(message[3])), now)
        else:
            monitor.take_battery(BatteryReading(stamp, message[2], message[3], 237.0, 0.0), now)


@settings(max_examples=EXAMPLES)
@given(sequences, st.sampled_from(["equal", "instantaneous", "instantaneous_slip"]), st.booleans())
def test_whatever_comes_in_every_command_is_finite_limited_and_slew_limited(sequence, strategy, healthy_first) -> None:
    drive = Drive(strategy=strategy)
    if healthy_first:
        drive.run(35)
    up = drive.controller.settings.slew_up_nmps * DT
    before = drive.commands[-1].motor_torque_nm if drive.commands else (0.0,) * 4
    peak, power = VEHICLE.front.motor.peak_torque_nm, VEHICLE.front.motor.max_power_w
    for batch in sequence:
        for message in batch:
            feed(drive, message)
        values = drive.step()
        command = drive.commands[-1]
        assert all(math.isfinite(number) or name.endswith("age_s") for name, number in values.items())
        for i, wheel in enumerate(NAMES):
            torque, brake = command.motor_torque_nm[i], command.friction_torque_nm[i]
            assert abs(torque) <= peak + 1e-6
            believed = not int(values["doubted"]) >> i & 1  # a wheel speed that is not believed limits nothing
            assert not believed or torque * values[f"{wheel}_speed_radps"] <= power * (1.0 + 1e-9)
            assert -VEHICLE.front.friction_brake.max_torque_nm - 1e-6 <= brake <= 0.0
            assert torque <= max(before[i], 0.0) + up + 1e-9
            gated = (GATE_FRONT, GATE_BOTH) if i < 2 else (GATE_REAR, GATE_BOTH)
            if command.gate in gated:
                assert torque == 0.0
                assert brake == 0.0
        if values["power_demand_w"] <= 0.0 and max(before) <= 0.0:
            assert max(command.motor_torque_nm) <= 0.0
        if values["motor_factor"] == 0.0:
            assert command.motor_torque_nm == (0.0,) * 4
        assert drive.controller.state.steps == len(drive.steps)
        before = command.motor_torque_nm


@settings(max_examples=min(settings().max_examples, EXAMPLES))
@given(st.floats(3.0, 30.0), st.floats(-20000.0, 20000.0))
def test_the_torques_sum_to_the_demand_whenever_no_limit_and_no_gate_binds(speed, demand) -> None:
    drive = Drive()
    values = drive.run(60, speed=speed, demand=demand)
    if values["limits"] == 0 and values["gate"] == 0:
        total = sum(t * values[f"{w}_speed_radps"] for t, w in zip(motor(values), NAMES, strict=True))
        assert total == pytest.approx(demand, abs=1e-3)


def test_torques_that_act_20_ms_after_the_command_are_found_to_act_18_later_than_told(drive) -> None:
    """The road takes the same from every wheel all the time, so that wheels turn as their torques say."""
    drive.run(100, speed=25.0, demand=0.0)
    assert drive.controller.torques_later_s == 0.0
    speed, wheels = 25.0, [25.0 / RADIUS] * 4
    inertia = [axle.wheel.inertia_kgm2 for axle in (VEHICLE.front, VEHICLE.front, VEHICLE.rear, VEHICLE.rear)]
    for step in range(40):
        acting = drive.commands[-3]
        torques = [a + b for a, b in zip(acting.motor_torque_nm, acting.friction_torque_nm, strict=True)]
        drive.run(1, speed=speed, wheels=wheels, demand=-60e3 if step * step % 7 in (1, 2) else 0.0)
        wheels = [w + (t + 100.0) * DT / i for w, t, i in zip(wheels, torques, inertia, strict=True)]
        speed -= 100.0 * 4.0 / RADIUS / VEHICLE.chassis.mass_kg * DT
    assert drive.controller.torques_later_s == pytest.approx(0.018, abs=0.005)


def test_the_speed_it_believes_is_the_sensors_until_that_contradicts_the_wheels(drive) -> None:
    assert drive.controller.believed_speed_mps == 0.0
    drive.run(100, speed=10.0, demand=0.0)
    drive.send(speed=10.01, demand=0.0)
    assert drive.controller.believed_speed_mps == 10.01
    drive.run(300, speed=15.0, wheels=(10.0 / RADIUS,) * 4, demand=0.0)
    assert drive.commands[-1].doubted == 16
    assert drive.controller.believed_speed_mps == pytest.approx(10.0, abs=0.5)


@pytest.mark.parametrize("demand", [-8000.0, 0.0])
def test_with_the_speed_missing_it_believes_what_the_wheels_say(drive, demand) -> None:
    """A pedal's force becomes power at this speed: at one that is held, braking would grow as the car slows down."""
    drive.run(60, speed=10.0, demand=demand)
    for step in range(150):
        speed = 10.0 - 0.04 * step
        drive.run(1, wheels=(speed / RADIUS,) * 4, demand=demand, without=("speed",))
    assert drive.controller.supervision.stale == STALE_SPEED
    assert drive.controller.believed_speed_mps == pytest.approx(speed, abs=0.1)
    drive.run(60, speed=speed, demand=demand)
    drive.send(speed=speed + 0.01, demand=demand)
    assert drive.controller.believed_speed_mps == speed + 0.01


@pytest.mark.parametrize("demand", [-8000.0, 5000.0])
@pytest.mark.parametrize("larger", ["front", "rear"])
def test_each_axle_s_own_wheels_tell_the_speed_and_are_told_by_it(larger, demand) -> None:
    axle = getattr(VEHICLE, larger)
    wheel = axle.wheel._replace(radius_m=1.2 * RADIUS)
    drive = Drive(vehicle=VEHICLE._replace(**{larger: axle._replace(wheel=wheel)}))
    turning = (10.0 / (1.2 * RADIUS),) * 2, (10.0 / RADIUS,) * 2
    wheels = sum(turning if larger == "front" else turning[::-1], ())
    drive.run(60, wheels=wheels, demand=demand)
    without_speed = drive.run(10, wheels=wheels, demand=demand, without=("speed",))
    assert without_speed["speed_mps"] == pytest.approx(10.0)
    drive.run(60, wheels=wheels, demand=demand)
    without_wheels = drive.run(10, demand=demand, without=("wheels",))
    assert [without_wheels[f"{name}_speed_radps"] for name in NAMES] == pytest.approx(wheels)


def test_with_speed_and_wheels_missing_it_believes_the_last_speed(drive) -> None:
    drive.run(60, speed=10.0, demand=-8000.0)
    drive.run(60, demand=-8000.0, without=("speed", "wheels"))
    assert drive.controller.believed_speed_mps == pytest.approx(10.0, abs=0.01)


def test_a_brake_demand_that_is_lost_after_the_speed_keeps_its_force(drive) -> None:
    """Its power was right at the speed that the wheels showed when it came, not at the last one of the sensor."""
    drive.run(60, speed=20.0, demand=-8000.0)
    for step in range(200):
        speed = 20.0 - 0.05 * step
        before = drive.run(1, wheels=(speed / RADIUS,) * 4, demand=-8000.0, without=("speed",))
    after = drive.run(4, wheels=(speed / RADIUS,) * 4, without=("speed", "demand"))
    assert after["stale"] == STALE_SPEED | STALE_DEMAND
    assert sum(motor(after)) + sum(friction(after)) == pytest.approx(
        sum(motor(before)) + sum(friction(before)), rel=0.03
    )
