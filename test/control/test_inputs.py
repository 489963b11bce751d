# SPDX-License-Identifier: Apache-2.0
"""Input checks: what is believed, what is not, and what a lost wheel is replaced by."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.inputs import (
    NEW_WHEELS,
    Rival,
    StampLimits,
    ValueLimits,
    Violation,
    WheelLimits,
    WheelMemory,
    WheelVerdict,
    check_names,
    check_stamp,
    check_value,
    follow_rival,
    judge_wheels,
)

NAN = math.nan
LIMITS = ValueLimits(minimum=-1.0, maximum=60.0, rise_per_s=10.0, fall_per_s=20.0, tolerance=0.5)
STAMPS = StampLimits(oldest_s=0.1, future_s=0.02)
NAMES = ("front_left", "front_right", "rear_left", "rear_right")
SECOND_NS = 1_000_000_000


def test_every_reason_has_a_code_of_its_own() -> None:
    assert [violation.value for violation in Violation] == list(range(12))
    assert [verdict.value for verdict in WheelVerdict] == list(range(8))


class TestRival:
    LIMITS = ValueLimits(-1.0, 60.0, 10.0, 20.0, 0.0)

    def follow(self, value: float, after_s: float) -> Rival:
        return follow_rival(Rival(5.0, 0, SECOND_NS), value, SECOND_NS + int(after_s * 1e9), self.LIMITS, 0.25)

    def test_the_first_message_begins_it(self) -> None:
        found = follow_rival(None, 3.0, 7, self.LIMITS, 0.25)
        assert found == Rival(3.0, 7, 7)
        assert found.lasted_s == 0.0

    @pytest.mark.parametrize(("value", "after_s"), [(5.0, 0.001), (7.5, 0.25), (0.0, 0.25)])
    def test_a_message_that_follows_goes_on_with_it(self, value: float, after_s: float) -> None:
        found = self.follow(value, after_s)
        assert found == Rival(value, 0, SECOND_NS + int(after_s * 1e9))
        assert found.lasted_s == pytest.approx(1.0 + after_s)

    @pytest.mark.parametrize(("value", "after_s"), [(5.0, 0.0), (5.0, -0.1), (5.0, 0.251), (7.51, 0.25), (-0.1, 0.25)])
    def test_one_that_does_not_begins_another(self, value: float, after_s: float) -> None:
        assert self.follow(value, after_s).lasted_s == 0.0


class TestValues:
    @pytest.mark.parametrize("value", [NAN, math.inf, -math.inf])
    def test_what_is_not_finite_is_refused(self, value: float) -> None:
        assert check_value(value, NAN, 0.0, LIMITS) is Violation.NOT_FINITE

    @pytest.mark.parametrize("value", [-1.0000001, 60.0000001, 1e308])
    def test_what_is_out_of_range_is_refused(self, value: float) -> None:
        assert check_value(value, NAN, 0.0, LIMITS) is Violation.OUT_OF_RANGE

    @pytest.mark.parametrize("value", [-1.0, 0.0, 60.0])
    def test_the_ends_of_the_range_belong_to_it(self, value: float) -> None:
        assert check_value(value, NAN, 0.0, LIMITS) is Violation.NONE

    def test_the_first_value_may_be_anything_in_range(self) -> None:
        assert check_value(59.0, NAN, 0.0, LIMITS) is Violation.NONE

    @pytest.mark.parametrize(
        ("change", "verdict"),
        [
            (1.5, Violation.NONE),  # 10 / s * 0.1 s + 0.5
            (1.5000001, Violation.TOO_FAST),
            (-2.5, Violation.NONE),  # 20 / s * 0.1 s + 0.5
            (-2.5000001, Violation.TOO_FAST),
        ],
    )
    def test_rise_and_fall_have_limits_of_their_own(self, change: float, verdict: Violation) -> None:
        assert check_value(32.0 + change, 32.0, 0.1, LIMITS) is verdict

    def test_the_longer_ago_the_last_value_the_larger_a_change_is_believed(self) -> None:
        assert check_value(40.0, 20.0, 1.9, LIMITS) is Violation.TOO_FAST
        assert check_value(40.0, 20.0, 2.0, LIMITS) is Violation.NONE

    def test_noise_is_believed_even_when_no_time_has_passed(self) -> None:
        assert check_value(20.5, 20.0, 0.0, LIMITS) is Violation.NONE
        assert check_value(19.5, 20.0, 0.0, LIMITS) is Violation.NONE

    def test_an_infinite_rate_allows_any_change(self) -> None:
        limits = LIMITS._replace(fall_per_s=math.inf)
        assert check_value(-1.0, 60.0, 1e-9, limits) is Violation.NONE


class TestStamps:
    NOW = 100 * SECOND_NS

    @pytest.mark.parametrize(
        ("ahead_ns", "verdict"),
        [
            (20_000_001, Violation.STAMP_IN_FUTURE),
            (20_000_000, Violation.NONE),
            (0, Violation.NONE),
            (-100_000_000, Violation.NONE),
            (-100_000_001, Violation.STAMP_TOO_OLD),
        ],
    )
    def test_a_stamp_may_lie_neither_far_ahead_nor_far_back(self, ahead_ns: int, verdict: Violation) -> None:
        assert check_stamp(self.NOW + ahead_ns, None, self.NOW, STAMPS) is verdict

    @pytest.mark.parametrize(
        ("step_ns", "verdict"), [(1, Violation.NONE), (0, Violation.STAMP_NOT_NEWER), (-1, Violation.STAMP_NOT_NEWER)]
    )
    def test_a_stamp_has_to_be_newer_than_the_last(self, step_ns: int, verdict: Violation) -> None:
        assert check_stamp(self.NOW + step_ns, self.NOW, self.NOW, STAMPS) is verdict

    def test_a_last_stamp_of_zero_counts_too(self) -> None:
        assert check_stamp(0, 0, 0, STAMPS) is Violation.STAMP_NOT_NEWER


class TestNames:
    def test_all_wheels_in_any_order_are_good(self) -> None:
        assert check_names(tuple(reversed(NAMES)), 4, NAMES) is Violation.NONE

    def test_other_joints_do_no_harm(self) -> None:
        assert check_names((*NAMES, "steering", "steering"), 6, NAMES) is Violation.NONE

    @pytest.mark.parametrize("count", [0, 3, 5])
    def test_as_many_values_as_names_are_needed(self, count: int) -> None:
        assert check_names(NAMES, count, NAMES) is Violation.LENGTH

    def test_a_wheel_that_is_missing_is_named_so(self) -> None:
        assert check_names(NAMES[:3], 3, NAMES) is Violation.NAME_MISSING

    def test_a_wheel_that_stands_twice_is_worse_than_one_missing(self) -> None:
        assert check_names(("front_left", "front_left", "rear_left", "rear_right"), 4, NAMES) is Violation.NAME_TWICE

    def test_an_empty_message_lacks_every_wheel(self) -> None:
        assert check_names((), 0, NAMES) is Violation.NAME_MISSING


WHEELS = WheelLimits(
    value=ValueLimits(-200.0, 200.0, 1000.0, 1000.0, 2.0),
    opposite_radps=2.0,
    moving_mps=1.0,
    stuck_s=0.5,
    stuck_change_radps=1.0,
    stray_s=0.25,
    stray_radps=10.0,
    distrust_s=0.125,
)
RADIUS = 0.5
GOOD = WheelVerdict.GOOD


def judge(received, car=30.0, dt=0.01, memory=NEW_WHEELS, limits=WHEELS):
    return judge_wheels(received, car, dt, memory, limits, RADIUS)


#: A power of two, so that sums of steps are exact.
DT = 1.0 / 128.0


def follow(steps, dt=DT, limits=WHEELS):
    """Judge one (received, car) after the other; returns the last reading."""
    reading, memory = None, NEW_WHEELS
    for received, car in steps:
        reading = judge(received, car, dt, memory, limits)
        memory = reading.memory
    return reading


class TestWheels:
    def test_four_good_wheels_pass_through_unchanged(self) -> None:
        received = (30.0, 30.1, 29.9, 30.2)
        reading = judge(received)
        assert reading.speed_radps == received
        assert reading.verdicts == (GOOD,) * 4

    @pytest.mark.parametrize("lost", range(4))
    @pytest.mark.parametrize(
        ("value", "verdict"),
        [
            (NAN, WheelVerdict.ABSENT),
            (math.inf, WheelVerdict.ABSENT),
            (201.0, WheelVerdict.OUT_OF_RANGE),
            (-201.0, WheelVerdict.OUT_OF_RANGE),
        ],
    )
    def test_a_lost_wheel_has_the_speed_of_the_other_wheel_of_its_axle(self, lost, value, verdict) -> None:
        received = [10.0, 11.0, 12.0, 13.0]
        partner = {0: 11.0, 1: 10.0, 2: 13.0, 3: 12.0}[lost]
        received[lost] = value
        reading = judge(received)
        assert reading.speed_radps[lost] == partner
        assert reading.verdicts[lost] is verdict
        assert sum(v is GOOD for v in reading.verdicts) == 3
        assert all(reading.speed_radps[i] == received[i] for i in range(4) if i != lost)

    @pytest.mark.parametrize(("lost", "axle"), [((0, 1), (0, 1)), ((2, 3), (2, 3))])
    def test_an_axle_without_a_good_wheel_is_lost(self, lost, axle) -> None:
        received = [NAN if i in lost else 20.0 for i in range(4)]
        speeds = judge(received).speed_radps
        assert all(math.isnan(speeds[i]) == (i in axle) for i in range(4))

    def test_one_wheel_of_each_axle_may_be_lost(self) -> None:
        assert judge((NAN, 20.0, 21.0, NAN)).speed_radps == (20.0, 20.0, 21.0, 21.0)

    def test_a_jump_is_not_believed_but_the_largest_plausible_change_is(self) -> None:
        first = judge((30.0, 30.0, 30.0, 30.0), dt=0.0)
        assert judge((42.0, 30.0, 30.0, 30.0), memory=first.memory).verdicts[0] is GOOD  # 1000 * 0.01 + 2
        jumped = judge((42.01, 30.0, 30.0, 30.0), memory=first.memory)
        assert jumped.verdicts[0] is WheelVerdict.JUMPED
        assert jumped.speed_radps[0] == 30.0

    def test_a_refused_jump_is_measured_from_the_last_accepted_speed(self) -> None:
        wheels = (30.0,) * 4
        jumped = (50.0, 30.0, 30.0, 30.0)
        one = follow([(wheels, 30.0), (jumped, 30.0)])
        assert one.verdicts[0] is WheelVerdict.JUMPED
        assert one.memory[0].speed_radps == 30.0
        assert one.memory[0].elapsed_s == DT
        # Two more steps after the accepted speed 25 rad/s are plausible: believed, though not trusted yet.
        two = judge(jumped, dt=2 * DT, memory=one.memory)
        assert two.verdicts[0] is WheelVerdict.DISTRUSTED
        assert two.memory[0].speed_radps == 50.0
        assert two.memory[0].elapsed_s == 0.0

    @pytest.mark.parametrize(
        ("wheel", "car", "verdict"),
        [
            (-2.01, 2.01, WheelVerdict.OPPOSITE),
            (-2.0, 2.01, GOOD),
            (-2.01, 2.0, GOOD),  # 1 m/s over 0.5 m: not yet driving
            (-50.0, 30.0, WheelVerdict.OPPOSITE),
            (50.0, 30.0, GOOD),
        ],
    )
    def test_a_wheel_that_turns_backwards_under_a_driving_car_is_not_believed(self, wheel, car, verdict) -> None:
        assert judge((wheel, 30.0, 30.0, 30.0), car=car).verdicts[0] is verdict

    def test_a_lost_wheel_is_used_again_once_it_has_been_good_for_long_enough(self) -> None:
        steps = [((NAN, 30.0, 30.0, 30.0), 30.0)] + [((30.0, 30.0, 30.0, 30.0), 30.0)] * 15
        assert follow(steps).verdicts[0] is WheelVerdict.DISTRUSTED
        assert follow(steps).speed_radps[0] == 30.0
        assert follow([*steps, steps[-1]]).verdicts[0] is GOOD

    def test_without_distrust_a_good_wheel_counts_at_once(self) -> None:
        limits = WHEELS._replace(distrust_s=0.0)
        reading = follow([((NAN, 30.0, 30.0, 30.0), 30.0), ((31.0, 30.0, 30.0, 30.0), 30.0)], limits=limits)
        assert reading.verdicts[0] is GOOD
        assert reading.speed_radps[0] == 31.0


class TestStuckWheels:
    @staticmethod
    def braking(frozen_at: float, steps: int, other_falls=True, car_falls=True):
        """The car slows down at 10 rad/s2 while the front left wheel keeps sending the same number."""
        found = []
        for i in range(steps):
            now = 30.0 - 0.1 * i
            other = now if other_falls else 30.0
            # Every message brings a number of its own, though it is the same.
            found.append(((float(str(frozen_at)), other, other, other), now if car_falls else 30.0))
        return found

    def test_a_frozen_number_is_stuck_when_car_and_partner_change(self) -> None:
        reading = follow(self.braking(30.0, 66))
        assert reading.verdicts[0] is WheelVerdict.STUCK
        assert reading.speed_radps[0] == reading.speed_radps[1]
        assert reading.verdicts[1:] == (GOOD,) * 3

    def test_it_is_not_stuck_before_its_time(self) -> None:
        # Unchanged for 0.5 s exactly, and the others have changed by 6.4 rad/s.
        assert follow(self.braking(30.0, 65)).verdicts[0] is GOOD

    def test_a_constant_speed_is_not_a_stuck_wheel(self) -> None:
        assert follow([((30.0,) * 4, 30.0)] * 200).verdicts == (GOOD,) * 4

    def test_a_wheel_is_not_stuck_when_only_one_of_car_and_partner_changes(self) -> None:
        assert follow(self.braking(30.0, 100, other_falls=False)).verdicts[0] is GOOD
        limits = WHEELS._replace(stray_s=10.0)
        assert follow(self.braking(30.0, 100, car_falls=False), limits=limits).verdicts[0] is GOOD

    def test_a_change_within_the_threshold_is_none(self) -> None:
        limits = WHEELS._replace(stuck_change_radps=7.05)
        assert follow(self.braking(30.0, 71), limits=limits).verdicts[0] is GOOD
        assert follow(self.braking(30.0, 72), limits=limits).verdicts[0] is WheelVerdict.STUCK

    @pytest.mark.parametrize(("other", "car"), [(29.5, 25.0), (25.0, 29.5)])
    def test_it_is_not_stuck_while_one_of_car_and_partner_changes_too_little(self, other, car) -> None:
        steps = [((30.0,) * 4, 30.0), *[((30.0, other, other, other), car)] * 100]
        assert follow(steps).verdicts[0] is GOOD

    def test_a_number_that_changes_is_alive_again(self) -> None:
        limits = WHEELS._replace(distrust_s=0.0)
        stuck = follow(self.braking(30.0, 67), limits=limits)
        assert stuck.verdicts[0] is WheelVerdict.STUCK
        alive = judge((24.0, 24.0, 24.0, 24.0), car=24.0, memory=stuck.memory, limits=limits)
        assert alive.verdicts[0] is GOOD
        assert alive.memory[0].unchanged_s == 0.0

    def test_what_the_others_did_before_the_number_froze_does_not_count(self) -> None:
        # Everything moves for long; then one wheel freezes, and nothing changes any more.
        moving = [((30.0 - 0.1 * i,) * 4, 30.0 - 0.1 * i) for i in range(100)]
        standing = [((20.0, 20.0, 20.0, 20.0), 20.0)] * 100
        assert follow(moving + standing).verdicts == (GOOD,) * 4


def test_whether_the_car_drives_is_judged_by_its_speed_over_the_radius() -> None:
    wheels = (-2.1, 2.4, 2.4, 2.4)
    assert judge_wheels(wheels, 2.4, 0.01, NEW_WHEELS, WHEELS, 0.4).verdicts[0] is GOOD  # 1 m/s is 2.5 rad/s here
    assert judge_wheels(wheels, 2.6, 0.01, NEW_WHEELS, WHEELS, 0.4).verdicts[0] is WheelVerdict.OPPOSITE


class TestStrayedWheels:
    def test_of_two_wheels_equally_far_from_the_car_neither_has_strayed(self) -> None:
        steps = [((42.0, 18.0, 30.0, 30.0), 30.0)] * 40
        assert follow(steps).verdicts == (GOOD,) * 4

    def test_a_wheel_far_from_partner_and_car_for_long_is_lost(self) -> None:
        steps = [((42.0 + 0.001 * i, 30.0, 30.0, 30.0), 30.0) for i in range(33)]
        assert follow(steps).verdicts == (WheelVerdict.STRAYED, GOOD, GOOD, GOOD)
        assert follow(steps).speed_radps[0] == 30.0

    def test_not_before_its_time(self) -> None:
        steps = [((42.0 + 0.001 * i, 30.0, 30.0, 30.0), 30.0) for i in range(32)]
        assert follow(steps).verdicts == (GOOD,) * 4

    def test_a_spell_near_the_partner_starts_the_time_anew(self) -> None:
        far = [((42.0, 30.0, 30.0, 30.0), 30.0)] * 25
        near = [((39.0, 30.0, 30.0, 30.0), 30.0)]
        assert follow(far + near + far).verdicts[0] is GOOD
        assert follow(near + [((42.0 + 0.001 * i, 30.0, 30.0, 30.0), 30.0) for i in range(33)]).verdicts[0] is (
            WheelVerdict.STRAYED
        )

    def test_of_two_that_disagree_the_one_nearer_to_the_car_is_believed(self) -> None:
        steps = [((42.0, 30.0, 30.0, 30.0), 41.0)] * 40
        assert follow(steps).verdicts == (GOOD, WheelVerdict.STRAYED, GOOD, GOOD)

    def test_an_axle_that_slips_as_a_whole_is_believed(self) -> None:
        # Both front wheels spin: that is slip, and the gate's business.
        assert follow([((60.0, 60.0, 30.0, 30.0), 30.0)] * 100).verdicts == (GOOD,) * 4

    def test_a_difference_at_the_threshold_is_allowed(self) -> None:
        assert follow([((40.0, 30.0, 30.0, 30.0), 30.0)] * 100).verdicts[0] is GOOD


class TestMemory:
    def test_time_without_an_accepted_speed_adds_up(self) -> None:
        reading = follow([((30.0,) * 4, 30.0)] + [((NAN, 30.0, 30.0, 30.0), 30.0)] * 5)
        assert reading.memory[0].elapsed_s == 5 * DT
        assert reading.memory[1].elapsed_s == 0.0

    def test_distrust_runs_down_to_zero_and_no_further(self) -> None:
        reading = follow([((NAN, 30.0, 30.0, 30.0), 30.0)] + [((30.0,) * 4, 30.0)] * 50)
        assert reading.memory[0].distrust_s == 0.0
        assert follow([((NAN, 30.0, 30.0, 30.0), 30.0)]).memory[0].distrust_s == WHEELS.distrust_s

    def test_a_new_wheel_remembers_nothing(self) -> None:
        assert (WheelMemory(),) * 4 == NEW_WHEELS
        assert math.isnan(NEW_WHEELS[0].speed_radps)
        assert math.isnan(NEW_WHEELS[0].received_radps)
        assert NEW_WHEELS[0][1:3] == (0.0, 0.0)
        assert NEW_WHEELS[0][6:] == (0.0, 0.0)

    def test_the_clock_of_a_frozen_number_counts_seconds(self) -> None:
        reading = follow([((30.0,) * 4, 30.0)] * 5, dt=0.25)
        assert reading.memory[0].unchanged_s == pytest.approx(1.0)


any_number = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.lists(st.tuples(st.tuples(any_number, any_number, any_number, any_number), st.floats(0.0, 100.0)), min_size=1)
)
def test_whatever_comes_in_the_speeds_that_come_out_are_believable_or_declared_lost(steps) -> None:
    memory = NEW_WHEELS
    for received, car in steps:
        reading = judge(received, car, 0.01, memory)
        memory = reading.memory
        for i, speed in enumerate(reading.speed_radps):
            if math.isnan(speed):
                partner = (1, 0, 3, 2)[i]
                assert reading.verdicts[i] is not GOOD
                assert reading.verdicts[partner] is not GOOD
            else:
                assert -200.0 <= speed <= 200.0
            if reading.verdicts[i] is GOOD:
                assert speed == received[i]


@given(any_number, any_number, st.floats(0.0, 10.0))
def test_an_accepted_value_is_finite_and_in_range(value, last, elapsed) -> None:
    if check_value(value, last, elapsed, LIMITS) is Violation.NONE:
        assert math.isfinite(value)
        assert LIMITS.minimum <= value <= LIMITS.maximum
