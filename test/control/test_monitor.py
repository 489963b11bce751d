# SPDX-License-Identifier: Apache-2.0
"""The latest good input of each topic: what is kept, dropped, counted, and how old it is."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control.inputs import StampLimits, ValueLimits, Violation, WheelLimits, WheelVerdict
from iwm_power_manager.control.monitor import (
    BATTERY,
    DEMAND,
    FRICTION,
    SPEED,
    WHEELS,
    BatteryReading,
    InputLimits,
    InputMonitor,
    JointReading,
    SpeedReading,
    Tally,
    select_by_name,
)

NAMES = ("front_left", "front_right", "rear_left", "rear_right")
MS = 1_000_000
NOW = 5_000 * MS
LIMITS = InputLimits(
    stamp=StampLimits(0.1, 0.02),
    demand_delay_s=0.1,
    speed=ValueLimits(-1.0, 60.0, 20.0, 20.0, 0.5),
    demand=ValueLimits(-1e5, 5e4, 1e6, math.inf, 1e3),
    soc=ValueLimits(0.0, 1.0, 0.01, 0.01, 0.02),
    temperature=ValueLimits(-60.0, 150.0, 2.0, 2.0, 3.0),
    friction=ValueLimits(0.05, 1.5, math.inf, math.inf, 0.0),
    wheels=WheelLimits(ValueLimits(-200.0, 200.0, 1000.0, 1000.0, 2.0), 2.0, 1.0, 1.0, 1.0, 1.0, 20.0, 0.0),
    rival_s=0.3,
    radius_m=0.5,
)


@pytest.fixture
def monitor() -> InputMonitor:
    return InputMonitor(NAMES, LIMITS)


def wheels(stamp_ns: int, values=(20.0, 20.0, 20.0, 20.0), names=NAMES) -> JointReading:
    return JointReading(stamp_ns, tuple(names), tuple(values))


def battery(stamp_ns: int, soc=0.5, temperature=25.0) -> BatteryReading:
    return BatteryReading(stamp_ns, soc, temperature, 237.0, 10.0)


class TestSelectByName:
    def test_values_come_in_the_order_asked_for(self) -> None:
        assert select_by_name(wheels(0, (3.0, 1.0, 4.0, 2.0), ("c", "a", "d", "b")), ("a", "b", "c", "d")) == (
            1,
            2,
            3,
            4,
        )
        assert select_by_name(wheels(0, (1.0, 2.0), ("a", "b")), ("a", "b")) == (1.0, 2.0)

    def test_a_name_that_is_absent_or_doubled_has_no_value(self) -> None:
        found = select_by_name(wheels(0, (1.0, 2.0, 3.0), ("a", "b", "b")), ("a", "b", "c"))
        assert found[0] == 1.0
        assert math.isnan(found[1])
        assert math.isnan(found[2])

    @pytest.mark.parametrize("values", [(), (1.0,), (1.0, 2.0, 3.0)])
    def test_without_a_value_for_each_name_nothing_is_known(self, values) -> None:
        found = select_by_name(wheels(0, values, ("a", "b")), ("a", "b"))
        assert len(found) == 2
        assert all(math.isnan(value) for value in found)


class TestTally:
    def test_the_age_is_infinite_before_the_first_message_and_never_negative(self) -> None:
        tally = Tally()
        assert tally.age_s(NOW) == math.inf
        assert tally.note(Violation.NONE, NOW) is True
        assert tally.age_s(NOW + 250 * MS) == 0.25
        assert tally.age_s(NOW - 250 * MS) == 0.0

    def test_a_dropped_message_is_counted_and_does_not_make_the_input_younger(self) -> None:
        tally = Tally()
        tally.note(Violation.NONE, NOW)
        assert tally.note(Violation.NOT_FINITE, NOW + MS) is False
        assert tally.note(Violation.NOT_FINITE, NOW + MS) is False
        assert tally.accepted_ns == NOW
        assert tally.received == 3
        assert dict(tally.dropped) == {Violation.NOT_FINITE: 2}
        assert tally.violation is Violation.NOT_FINITE
        tally.note(Violation.NONE, NOW + 2 * MS)
        assert tally.violation is Violation.NONE


class TestSecondSource:
    """Two publishers of one topic: the one that was accepted last is not believed for ever."""

    @staticmethod
    def both(
        monitor: InputMonitor, ms: int, first: float, second: float, wheels_mps: float | None = None
    ) -> list[bool]:
        """A message of each, a little apart, at a time; whether they were accepted."""
        now = NOW + ms * MS
        if wheels_mps is not None:
            monitor.take_wheels(wheels(now, (wheels_mps / 0.5,) * 4), now)
        return [
            monitor.take_speed(SpeedReading(now + k * MS, speed), now + k * MS)
            for k, speed in ((0, first), (1, second))
        ]

    def test_whoever_agrees_with_the_wheels_is_believed_after_a_while_and_stays_so(self, monitor) -> None:
        found = [self.both(monitor, 10 * i, 10.0, 20.0, wheels_mps=20.0) for i in range(60)]
        assert found[0] == [True, False]
        changed = found.index([True, True])
        assert changed == 30
        assert found[:changed] == [[True, False]] * changed
        assert found[changed + 1 :] == [[False, True]] * (59 - changed)
        assert monitor.speed_mps == 20.0

    def test_who_is_farther_from_the_wheels_or_as_far_is_not(self, monitor) -> None:
        assert [self.both(monitor, 10 * i, 10.0, 20.0, wheels_mps=12.0)[1] for i in range(60)] == [False] * 60
        assert [self.both(monitor, 600 + 10 * i, 10.0, 14.0, wheels_mps=12.0)[1] for i in range(60)] == [False] * 60

    def test_the_two_middle_wheels_tell(self, monitor) -> None:
        for i in range(32):
            now = NOW + 10 * i * MS
            monitor.take_wheels(wheels(now, (0.0, 36.0, 40.0, 60.0)), now)
            self.both(monitor, 10 * i, 10.0, 19.0)
        assert monitor.speed_mps == 19.0

    def test_where_no_wheels_have_come_of_late_they_take_turns(self, monitor) -> None:
        monitor.take_wheels(wheels(NOW - 310 * MS), NOW - 310 * MS)
        assert self.both(monitor, 0, 10.0, 20.0) == [True, False]
        speeds = []
        for i in range(1, 100):
            self.both(monitor, 10 * i, 10.0, 20.0)
            speeds.append(monitor.speed_mps)
        assert speeds.index(20.0) == 29
        assert 10.0 in speeds[30:]

    def test_stamps_that_run_ahead_do_not_have_the_topic_for_themselves(self, monitor) -> None:
        for i in range(60):
            now = NOW + 10 * i * MS
            monitor.take_wheels(wheels(now, (20.0,) * 4), now)
            monitor.take_speed(SpeedReading(now + 15 * MS, 10.0 + 0.1 * i), now)
            monitor.take_speed(SpeedReading(now, 10.0), now)
            if i > 33:  # the walk is out of what is believed by now
                assert monitor.speed_mps == 10.0

    @pytest.mark.parametrize("gap_ms", [310, 10_000])
    def test_messages_too_far_apart_are_no_source(self, monitor, gap_ms: int) -> None:
        for i in range(12 * gap_ms // 10):
            second = [SpeedReading(NOW + 10 * i * MS + MS, 20.0)] if 10 * i % gap_ms < 10 else []
            monitor.take_speed(SpeedReading(NOW + 10 * i * MS, 10.0), NOW + 10 * i * MS)
            assert not any(monitor.take_speed(reading, reading.stamp_ns) for reading in second)

    @pytest.mark.parametrize("spoilt", [math.nan, 1000.0])
    def test_impossible_values_are_no_source(self, monitor, spoilt: float) -> None:
        assert [self.both(monitor, 10 * i, 10.0, spoilt)[1] for i in range(60)] == [False] * 60
        for i in range(60):  # nor with stamps that are not newer
            now = NOW + 600 * MS + 10 * i * MS
            monitor.take_speed(SpeedReading(now, 10.0), now)
            assert not monitor.take_speed(SpeedReading(now - MS, spoilt), now)

    def test_frozen_messages_are_no_source(self, monitor) -> None:
        for i in range(60):
            now = NOW + 10 * i * MS
            assert monitor.take_speed(SpeedReading(now, 10.0), now)
            assert not monitor.take_speed(SpeedReading(NOW - 10 * MS, 20.0), NOW)

    def test_a_source_alone_that_jumped_waits_as_long_as_the_rate_says(self, monitor) -> None:
        assert monitor.take_speed(SpeedReading(NOW, 10.0), NOW)
        accepted = [monitor.take_speed(SpeedReading(NOW + 10 * i * MS, 30.0), NOW + 10 * i * MS) for i in range(1, 110)]
        assert accepted.index(True) + 1 == 98  # 20 m/s less 0.5 at 20 m/s2

    def test_after_the_clock_was_set_back_nothing_is_remembered(self, monitor) -> None:
        for i in range(30):
            self.both(monitor, 10 * i, 10.0, 20.0)
        monitor.forget_times()
        assert self.both(monitor, 300, 10.0, 20.0) == [True, False]

    def test_two_batteries_take_turns_ten_times_as_slowly(self, monitor) -> None:
        charges = []
        for i in range(70):
            now = NOW + 100 * i * MS
            monitor.take_battery(battery(now, 0.5), now)
            monitor.take_battery(battery(now + MS, 0.9), now + MS)
            charges.append(monitor.soc)
        assert charges[:30] == [0.5] * 30
        assert 29 < charges.index(0.9) < 33
        assert 0.5 in charges[33:]


class TestSpeed:
    def test_a_good_speed_is_kept_with_its_stamp(self, monitor) -> None:
        assert monitor.take_speed(SpeedReading(NOW - 10 * MS, 12.5), NOW)
        assert monitor.speed_mps == 12.5
        assert monitor.ages_s(NOW)[0] == 0.01
        assert math.isinf(monitor.ages_s(NOW)[1])

    def test_a_speed_backwards_is_kept_as_it_is(self, monitor) -> None:
        assert monitor.take_speed(SpeedReading(NOW, -0.3), NOW)
        assert monitor.speed_mps == -0.3

    def test_the_first_speed_may_be_any(self, monitor) -> None:
        assert monitor.take_speed(SpeedReading(NOW, 59.0), NOW)

    @pytest.mark.parametrize(
        ("stamp_ms", "speed", "violation"),
        [
            (10, math.nan, Violation.NOT_FINITE),
            (10, 61.0, Violation.OUT_OF_RANGE),
            (10, 11.0, Violation.TOO_FAST),
            (31, 10.0, Violation.STAMP_IN_FUTURE),
            (-91, 10.0, Violation.STAMP_TOO_OLD),
            (0, 10.0, Violation.STAMP_NOT_NEWER),
        ],
    )
    def test_a_bad_speed_is_dropped_and_the_last_good_one_stays(self, monitor, stamp_ms, speed, violation) -> None:
        monitor.take_speed(SpeedReading(NOW, 10.0), NOW)
        assert not monitor.take_speed(SpeedReading(NOW + stamp_ms * MS, speed), NOW + 10 * MS)
        assert monitor.speed_mps == 10.0
        assert monitor.tallies[SPEED].violation is violation
        assert monitor.tallies[SPEED].dropped[violation] == 1

    def test_the_change_is_judged_over_the_time_between_the_stamps(self, monitor) -> None:
        monitor.take_speed(SpeedReading(NOW, 10.0), NOW)
        assert not monitor.take_speed(SpeedReading(NOW + 20 * MS, 10.95), NOW + 50 * MS)
        assert monitor.take_speed(SpeedReading(NOW + 50 * MS, 11.5), NOW + 50 * MS)

    def test_without_stamp_limits_any_stamp_will_do(self) -> None:
        monitor = InputMonitor(NAMES, LIMITS._replace(stamp=None))
        assert monitor.take_speed(SpeedReading(NOW, 10.0), 0)
        assert monitor.take_speed(SpeedReading(NOW, 10.0), 10**18)


class TestWheels:
    @pytest.mark.parametrize("by_clock", [True, False])
    def test_wheels_that_count_teeth_are_smoothed_where_stamps_say_when_and_not_in_lockstep(self, by_clock) -> None:
        monitor = InputMonitor(NAMES, LIMITS if by_clock else LIMITS._replace(stamp=None))
        for k in range(60):
            stamp, counted = NOW + 10 * k * MS, tuple(5.0 * (4 + (0.4 * k + 0.2 * i) % 1.0 // 0.6) for i in range(4))
            assert monitor.take_wheels(wheels(stamp, counted), stamp)
        assert (monitor.wheel_speed_radps == counted) == (not by_clock)
        assert monitor.wheels_behind_s == pytest.approx(0.005 * len(monitor.coarse.weights) if by_clock else 0.0)

    def test_wheels_are_matched_by_name(self, monitor) -> None:
        shuffled = ("rear_right", "front_left", "rear_left", "front_right")
        assert monitor.take_wheels(wheels(NOW, (4.0, 1.0, 3.0, 2.0), shuffled), NOW)
        assert monitor.wheel_speed_radps == (1.0, 2.0, 3.0, 4.0)
        assert monitor.verdicts == (WheelVerdict.GOOD,) * 4
        assert monitor.ages_s(NOW)[1] == 0.0
        assert not monitor.tallies[WHEELS].dropped

    def test_a_message_without_one_wheel_is_counted_and_its_other_wheels_are_used(self, monitor) -> None:
        assert monitor.take_wheels(wheels(NOW, (1.0, 2.0, 3.0), NAMES[:3]), NOW)
        assert monitor.wheel_speed_radps == (1.0, 2.0, 3.0, 3.0)
        assert monitor.verdicts[3] is WheelVerdict.ABSENT
        tally = monitor.tallies[WHEELS]
        assert (tally.received, tally.accepted_ns, tally.violation) == (1, NOW, Violation.NAME_MISSING)
        assert tally.dropped[Violation.NAME_MISSING] == 1

    @pytest.mark.parametrize(
        ("values", "names", "violation"),
        [
            ((1.0, 2.0, 3.0), NAMES, Violation.LENGTH),
            ((), NAMES, Violation.LENGTH),
            ((1.0, 2.0, 3.0, 4.0), ("front_left", "front_left", "rear_left", "rear_right"), Violation.NAME_TWICE),
            ((), (), Violation.AXLE_LOST),
            ((math.nan, math.nan, 20.0, 20.0), NAMES, Violation.AXLE_LOST),
            ((1.0, 2.0), ("front_left", "front_right"), Violation.AXLE_LOST),
        ],
    )
    def test_a_message_that_leaves_an_axle_unknown_is_dropped(self, monitor, values, names, violation) -> None:
        monitor.take_wheels(wheels(NOW), NOW)
        assert not monitor.take_wheels(wheels(NOW + 10 * MS, values, names), NOW + 10 * MS)
        assert monitor.wheel_speed_radps == (20.0,) * 4
        assert monitor.tallies[WHEELS].accepted_ns == NOW
        assert monitor.tallies[WHEELS].violation is violation

    def test_the_first_message_has_no_time_behind_it(self) -> None:
        limits = LIMITS._replace(wheels=LIMITS.wheels._replace(stray_s=0.5))
        monitor = InputMonitor(NAMES, limits)
        assert monitor.take_wheels(wheels(NOW, (60.0, 20.0, 20.0, 20.0)), NOW)
        assert monitor.verdicts == (WheelVerdict.GOOD,) * 4

    def test_a_bad_stamp_is_seen_before_anything_else(self, monitor) -> None:
        assert not monitor.take_wheels(wheels(NOW - 101 * MS, (), NAMES), NOW)
        assert monitor.tallies[WHEELS].violation is Violation.STAMP_TOO_OLD

    def test_a_wheel_that_jumps_is_judged_over_the_time_between_the_stamps(self, monitor) -> None:
        monitor.take_wheels(wheels(NOW), NOW)
        # 1000 rad/s2 over 10 ms, and 2 for noise.
        assert monitor.take_wheels(wheels(NOW + 10 * MS, (32.1, 20.0, 20.0, 20.0)), NOW + 10 * MS)
        assert monitor.verdicts[0] is WheelVerdict.JUMPED
        assert monitor.wheel_speed_radps == (20.0,) * 4
        assert monitor.take_wheels(wheels(NOW + 20 * MS, (31.9, 20.0, 20.0, 20.0)), NOW + 20 * MS)
        assert monitor.wheel_speed_radps[0] == 31.9

    def test_a_stamp_that_goes_back_has_no_time_behind_it(self) -> None:
        monitor = InputMonitor(NAMES, LIMITS._replace(stamp=None))
        monitor.take_wheels(wheels(NOW), NOW)
        monitor.take_wheels(wheels(NOW - 10 * MS, (22.1, 22.0, 20.0, 20.0)), NOW)
        assert monitor.verdicts == (WheelVerdict.JUMPED, WheelVerdict.GOOD, WheelVerdict.GOOD, WheelVerdict.GOOD)

    def test_time_of_dropped_messages_is_counted_once(self, monitor) -> None:
        monitor.take_wheels(wheels(NOW), NOW)
        for i in range(1, 4):
            monitor.take_wheels(wheels(NOW + 10 * i * MS, (math.nan,) * 4), NOW + 10 * i * MS)
        # 40 ms after the last good speed 42 rad/s more are the most that is believed.
        assert not monitor.take_wheels(wheels(NOW + 40 * MS, (62.5,) * 4), NOW + 40 * MS)
        assert monitor.take_wheels(wheels(NOW + 41 * MS, (62.5,) * 4), NOW + 41 * MS)

    def test_the_speed_of_the_car_is_seen_at_the_wheel(self, monitor) -> None:
        monitor.take_speed(SpeedReading(NOW, 0.9), NOW)
        monitor.take_wheels(wheels(NOW, (-5.0, 2.0, 2.0, 2.0)), NOW)
        assert monitor.verdicts[0] is WheelVerdict.GOOD
        monitor.take_speed(SpeedReading(NOW + 10 * MS, 1.1), NOW + 10 * MS)
        monitor.take_wheels(wheels(NOW + 10 * MS, (-5.0, 2.0, 2.0, 2.0)), NOW + 10 * MS)
        assert monitor.verdicts[0] is WheelVerdict.OPPOSITE


class TestDemand:
    def test_a_demand_is_kept_with_the_speed_of_its_moment(self, monitor) -> None:
        monitor.take_speed(SpeedReading(NOW, 12.0), NOW)
        assert monitor.take_demand(-5000.0, 0.001, NOW)
        monitor.take_speed(SpeedReading(NOW + 10 * MS, 11.9), NOW + 10 * MS)
        assert (monitor.demand_w, monitor.demand_speed_mps) == (-5000.0, 12.0)
        assert monitor.ages_s(NOW + 30 * MS)[2] == 0.03

    def test_a_late_demand_is_dropped(self, monitor) -> None:
        assert monitor.take_demand(1.0, 0.1, NOW)
        assert not monitor.take_demand(2.0, 0.1001, NOW + MS)
        assert monitor.demand_w == 1.0
        assert monitor.tallies[DEMAND].violation is Violation.LATE
        assert monitor.tallies[DEMAND].why() == "late: by 0.1 s; allowed: stamp_oldest_s 0.1"

    def test_where_no_stamps_are_judged_a_late_demand_says_only_how_late_it_is(self) -> None:
        monitor = InputMonitor(NAMES, LIMITS._replace(stamp=None))
        assert not monitor.take_demand(2.0, 0.35, NOW)
        assert monitor.tallies[DEMAND].why() == "late: by 0.35 s"

    def test_a_demand_may_fall_at_once_but_not_rise_at_once(self, monitor) -> None:
        assert monitor.take_demand(5e4, 0.0, NOW)
        assert monitor.take_demand(-1e5, 0.0, NOW + MS)
        assert not monitor.take_demand(-9e4, 0.0, NOW + 2 * MS)
        assert monitor.take_demand(-9e4, 0.0, NOW + 10 * MS)
        assert monitor.tallies[DEMAND].dropped == {Violation.TOO_FAST: 1}

    @pytest.mark.parametrize("demand", [math.nan, -math.inf, 5.1e4, -1.1e5])
    def test_an_impossible_demand_is_dropped(self, monitor, demand) -> None:
        assert not monitor.take_demand(demand, 0.0, NOW)
        assert monitor.demand_w == 0.0
        assert math.isinf(monitor.ages_s(NOW)[2])


class TestBattery:
    def test_charge_and_temperature_are_kept(self, monitor) -> None:
        assert monitor.take_battery(battery(NOW, 0.7, 31.0), NOW)
        assert (monitor.soc, monitor.temperature_c) == (0.7, 31.0)
        assert monitor.ages_s(NOW + 100 * MS)[3] == 0.1

    def test_a_temperature_that_is_not_measured_is_allowed(self, monitor) -> None:
        assert monitor.take_battery(battery(NOW, 0.7, math.nan), NOW)
        assert math.isnan(monitor.temperature_c)
        assert monitor.take_battery(battery(NOW + 10 * MS, 0.7, 60.0), NOW + 10 * MS)
        assert monitor.temperature_c == 60.0

    @pytest.mark.parametrize(
        ("soc", "temperature", "violation"),
        [
            (math.nan, 25.0, Violation.NOT_FINITE),
            (1.01, 25.0, Violation.OUT_OF_RANGE),
            (0.53, 25.0, Violation.TOO_FAST),
            (0.5, 29.0, Violation.TOO_FAST),
            (0.5, 151.0, Violation.OUT_OF_RANGE),
            (0.5, math.inf, Violation.NOT_FINITE),
        ],
    )
    def test_an_impossible_battery_is_dropped(self, monitor, soc, temperature, violation) -> None:
        monitor.take_battery(battery(NOW), NOW)
        assert not monitor.take_battery(battery(NOW + 10 * MS, soc, temperature), NOW + 10 * MS)
        assert (monitor.soc, monitor.temperature_c) == (0.5, 25.0)
        assert monitor.tallies[BATTERY].violation is violation

    def test_a_bad_stamp_is_seen(self, monitor) -> None:
        assert not monitor.take_battery(battery(NOW + 21 * MS), NOW)
        assert monitor.tallies[BATTERY].violation is Violation.STAMP_IN_FUTURE

    def test_a_slow_change_is_believed(self, monitor) -> None:
        monitor.take_battery(battery(NOW, 0.5, 25.0), NOW)
        later = NOW + 2_000 * MS
        assert monitor.take_battery(battery(later, 0.539, 31.9), later)


class TestFriction:
    def test_a_friction_in_range_is_kept(self, monitor) -> None:
        assert math.isnan(monitor.friction)
        assert monitor.take_friction(0.3, NOW)
        assert monitor.friction == 0.3
        assert monitor.tallies[FRICTION].age_s(NOW + 500 * MS) == 0.5

    @pytest.mark.parametrize("friction", [math.nan, 0.0, 2.0])
    def test_an_impossible_friction_is_dropped(self, monitor, friction) -> None:
        monitor.take_friction(0.3, NOW)
        assert not monitor.take_friction(friction, NOW + MS)
        assert monitor.friction == 0.3


class TestMotorTorques:
    def test_each_motor_has_the_torque_that_bears_its_name(self, monitor) -> None:
        monitor.take_torques(
            wheels(NOW, (3.0, 1.0, 4.0, 2.0), ("rear_left", "front_left", "rear_right", "front_right")), NOW
        )
        assert monitor.collect_torques() == (1.0, 2.0, 3.0, 4.0)

    def test_a_report_counts_once_and_a_motor_that_did_not_report_has_none(self, monitor) -> None:
        assert monitor.collect_torques() is None
        monitor.take_torques(wheels(NOW, (5.0, 6.0), ("front_left", "rear_right")), NOW)
        first, second, third, fourth = monitor.collect_torques()
        assert (first, fourth) == (5.0, 6.0)
        assert math.isnan(second)
        assert math.isnan(third)
        assert monitor.collect_torques() is None

    @pytest.mark.parametrize("late_ms", [-500, 500, 10_000])
    def test_a_report_of_another_time_is_none(self, monitor, late_ms) -> None:
        monitor.take_torques(wheels(NOW, (5.0, 6.0, 7.0, 8.0)), NOW + late_ms * MS)
        assert monitor.collect_torques() is None


class TestAccelerometer:
    def test_it_is_heard_for_a_tenth_of_a_second(self, monitor) -> None:
        assert math.isnan(monitor.motion("longitudinal_acceleration", NOW))
        monitor.take_motion("longitudinal_acceleration", -3.0, NOW)
        assert monitor.motion("longitudinal_acceleration", NOW + 90_000_000) == -3.0
        assert math.isnan(monitor.motion("longitudinal_acceleration", NOW + 110_000_000))

    @pytest.mark.parametrize("value", [math.nan, math.inf, 1e3])
    def test_what_no_car_does_is_not_believed(self, monitor, value) -> None:
        monitor.take_motion("longitudinal_acceleration", 2.0, NOW)
        monitor.take_motion("longitudinal_acceleration", value, NOW)
        assert monitor.motion("longitudinal_acceleration", NOW) == 2.0


class TestCompleteness:
    def test_it_can_drive_when_speed_and_demand_came_once(self, monitor) -> None:
        for take in (
            lambda: monitor.take_battery(battery(NOW), NOW),
            lambda: monitor.take_wheels(wheels(NOW), NOW),
            lambda: monitor.take_speed(SpeedReading(NOW, 10.0), NOW),
            lambda: monitor.take_demand(0.0, 0.0, NOW),
        ):
            assert not monitor.driven
            take()
        assert monitor.driven

    def test_a_demand_alone_does_not_drive(self, monitor) -> None:
        monitor.take_demand(0.0, 0.0, NOW)
        assert not monitor.driven

    def test_forgetting_the_times_keeps_the_values_and_believes_any_next_stamp(self, monitor) -> None:
        monitor.take_speed(SpeedReading(NOW, 30.0), NOW)
        monitor.take_wheels(wheels(NOW, (90.0,) * 4), NOW)
        monitor.take_demand(-9000.0, 0.0, NOW)
        monitor.take_battery(battery(NOW, 0.9, 40.0), NOW)
        monitor.forget_times()
        assert monitor.ages_s(NOW) == (math.inf,) * 4
        assert (monitor.speed_mps, monitor.demand_w, monitor.demand_speed_mps) == (30.0, -9000.0, 30.0)
        assert monitor.take_speed(SpeedReading(NOW - 50 * MS, 3.0), NOW - 50 * MS)
        assert monitor.take_wheels(wheels(NOW - 50 * MS, (90.0,) * 4), NOW - 50 * MS)

    def test_forgetting_keeps_the_counters_and_nothing_else(self, monitor) -> None:
        monitor.take_speed(SpeedReading(NOW, 30.0), NOW)
        monitor.take_wheels(wheels(NOW, (math.nan, 20.0, 20.0, 20.0)), NOW)
        monitor.take_demand(1000.0, 0.0, NOW)
        monitor.take_battery(battery(NOW, 0.9, 40.0), NOW)
        monitor.take_friction(0.4, NOW)
        monitor.forget()
        assert not monitor.driven
        assert monitor.ages_s(NOW) == (math.inf,) * 4
        assert (monitor.speed_mps, monitor.demand_w, monitor.demand_speed_mps, monitor.soc) == (0.0, 0.0, 0.0, 0.5)
        assert monitor.wheel_speed_radps == (0.0,) * 4
        assert monitor.verdicts == (WheelVerdict.GOOD,) * 4
        assert math.isnan(monitor.temperature_c)
        assert math.isnan(monitor.friction)
        assert [monitor.tallies[t].received for t in (SPEED, WHEELS, DEMAND, BATTERY, FRICTION)] == [1] * 5
        # A stamp of before is as good as any now: the clock may have been set back.
        assert monitor.take_speed(SpeedReading(NOW - 50 * MS, 3.0), NOW - 50 * MS)
        assert monitor.take_wheels(wheels(NOW - 50 * MS, (90.0,) * 4), NOW - 50 * MS)


class TestWhatIsRefusedSaysWhy:
    NOW = 1_800_000_000 * 1000 * MS

    @pytest.mark.parametrize(
        ("stamp_ns", "words"),
        [
            (NOW - 200 * MS, "stamp too old: by 0.2 s; allowed: stamp_oldest_s 0.1"),
            (NOW - 1000 * MS, "stamp too old: by 1 s; allowed: stamp_oldest_s 0.1"),
            (NOW + 50 * MS, "stamp in future: by 0.05 s; allowed: stamp_future_s 0.02"),
            (NOW - 5000 * MS, "stamp too old: by 5 s, another clock? then stamp: source"),
            (NOW + 5000 * MS, "stamp in future: by 5 s, another clock? then stamp: source"),
            (
                12_000 * MS,
                "stamp too old: by 1.8e+09 s, no stamp? then stamp: source; simulated time? then use_sim_time for both",
            ),
        ],
    )
    def test_a_stamp_by_how_far_it_is_off_and_what_that_may_mean(self, monitor, stamp_ns, words) -> None:
        monitor.take_speed(SpeedReading(stamp_ns, 10.0), self.NOW)
        assert monitor.tallies[SPEED].why() == words

    @pytest.mark.parametrize(
        ("delay_s", "words"),
        [
            (0.2, "late: by 0.2 s; allowed: stamp_oldest_s 0.1"),
            (5.0, "late: by 5 s, another clock? then stamp: source"),
        ],
    )
    def test_a_demand_that_comes_late_by_how_much(self, monitor, delay_s, words) -> None:
        monitor.take_demand(1.0, delay_s, NOW)
        assert monitor.tallies[DEMAND].why() == words

    def test_a_value_by_what_it_was_and_what_it_may_be(self, monitor) -> None:
        monitor.take_speed(SpeedReading(NOW, 61.0), NOW)
        monitor.take_battery(battery(NOW, soc=80.0), NOW)
        monitor.take_friction(math.nan, NOW)
        monitor.take_demand(1e6, 0.0, NOW)
        assert [monitor.tallies[topic].why() for topic in (SPEED, BATTERY, FRICTION, DEMAND)] == [
            "out of range: 61; allowed: -1 to 60",
            "out of range: 80; allowed: 0 to 1",
            "not finite: nan; allowed: 0.05 to 1.5",
            "out of range",  # the node knows who made it
        ]
        monitor.take_battery(battery(NOW, temperature=300.0), NOW)
        assert monitor.tallies[BATTERY].why() == "out of range: 300; allowed: -60 to 150"
        monitor.take_speed(SpeedReading(NOW, 1.0), NOW)
        assert monitor.tallies[SPEED].why() == ""

    @pytest.mark.parametrize(
        ("values", "names", "words"),
        [
            ((1.0, 2.0, 3.0), NAMES, "length: 3 values for 4 wheels"),
            (
                (1.0,) * 6,
                NAMES,
                "length: 6 values for 4 wheels; four sources, with an index each, take some of them",
            ),
            (
                (math.nan, math.nan, 1.0, 900.0),
                NAMES,
                "axle lost: front_left absent, front_right absent, rear_right out of range",
            ),
            (
                (1.0, 1.0),
                ("front_left", "x"),
                "axle lost: front_right absent, rear_left absent, rear_right absent; "
                "the message names 'front_left', 'x'",
            ),
            ((), (), "axle lost: " + ", ".join(f"{name} absent" for name in NAMES) + "; the message names nothing"),
        ],
    )
    def test_wheels_by_which_are_lost_and_how_those_that_came_are_called(self, monitor, values, names, words) -> None:
        monitor.take_wheels(wheels(NOW, values, names), NOW)
        assert monitor.tallies[WHEELS].why() == words

    @pytest.mark.parametrize("wheel", range(4))
    def test_only_the_wheel_that_is_not_believed_is_counted(self, monitor, wheel) -> None:
        for now in (NOW, NOW + 10 * MS):
            monitor.take_wheels(wheels(now, tuple(math.nan if i == wheel else 20.0 for i in range(4))), now)
        assert monitor.wheels_refused == {(NAMES[wheel], WheelVerdict.ABSENT): 2}


class TestApart:
    @pytest.mark.parametrize(
        ("speed", "rims", "words"),
        [
            (10.0, (20.0, 20.0, 20.0, 20.0), ""),
            (10.0, (19.0, 20.0, 21.0, 20.0), ""),
            (0.1, (3.0, 3.0, 3.0, 3.0), ""),
            (36.0, (20.0, 20.0, 20.0, 20.0), "speed is 3.6 times what wheel_speed"),
            (12.0, (20.0, 20.0, 20.0, 20.0), "speed is 1.2 times what wheel_speed"),
            (10.0, (0.0, 0.0, 0.0, 0.0), "speed is inf times what wheel_speed"),
        ],
    )
    def test_speed_and_wheels_that_contradict_each_other_in_motion(self, monitor, speed, rims, words) -> None:
        assert monitor.take_speed(SpeedReading(NOW, speed), NOW)
        assert monitor.take_wheels(wheels(NOW, rims), NOW)
        assert words in monitor.apart
        assert bool(words) == bool(monitor.apart)

    @pytest.mark.parametrize(("speed", "agree"), [(10.0, True), (11.4, True), (11.7, False), (9.0, True), (8.4, False)])
    def test_they_agree_within_half_a_metre_a_second_and_a_tenth(self, monitor, speed, agree) -> None:
        assert monitor.take_speed(SpeedReading(NOW, speed), NOW)
        assert monitor.take_wheels(wheels(NOW), NOW)
        assert monitor.agree is agree

    def test_what_is_too_fast_is_told_with_how_fast_it_may_change(self, monitor) -> None:
        assert monitor.take_speed(SpeedReading(NOW, 10.0), NOW)
        assert not monitor.take_speed(SpeedReading(NOW + 10 * MS, 12.0), NOW + 10 * MS)
        assert monitor.tallies[SPEED].why() == "too fast: 12; allowed: a change of 20 a second"
