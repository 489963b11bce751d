# SPDX-License-Identifier: Apache-2.0
"""Wheel speeds that come in coarse steps: which are found to, and what is left of the step in a smoothed one."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.coarse import FINE_RADPS, LEFT_RADPS, MOST_MESSAGES, Coarse, line_weights

DT = 0.01


class Counted:
    """Four wheels whose teeth are counted in each message, of speeds that are a function of time."""

    def __init__(self, speed, teeth, turned=(0.0, 0.3, 0.55, 0.8)):
        self.speed, self.pitch = speed, 2.0 * math.pi / teeth
        self.angles, self.time_s = [part * self.pitch for part in turned], 0.0

    def message(self):
        """Speeds by the teeth that passed, and the time it is sent."""
        before = [math.floor(angle / self.pitch) for angle in self.angles]
        self.time_s += DT
        self.angles = [angle + DT * self.speed(self.time_s) for angle in self.angles]
        passed = [math.floor(angle / self.pitch) - n for angle, n in zip(self.angles, before, strict=True)]
        return tuple(n * self.pitch / DT for n in passed)


@given(
    teeth=st.sampled_from([30, 48, 60, 96, 120]),
    start=st.floats(20.0, 90.0),
    rate=st.floats(-30.0, 30.0),
)
def test_a_wheel_that_counts_teeth_is_smoothed_to_near_its_speed_half_as_many_messages_ago(teeth, start, rate) -> None:
    def speed(t):
        return max(start + rate * t + 3.0 * math.sin(9.0 * t), 5.0)

    counted, coarse = Counted(speed, teeth), Coarse()
    for k in range(120):
        shown = coarse.smoothed(counted.message())
        if k < 60:
            continue
        count = len(coarse.weights)
        step = counted.pitch / DT
        assert count == min(math.ceil((step / LEFT_RADPS) ** (2.0 / 3.0)), MOST_MESSAGES)
        # The largest error of a slope by angles that are each off by up to a step.
        most = 1.5 * step / count
        then = speed(counted.time_s - 0.5 * (count - 1) * DT)
        assert shown == pytest.approx((then,) * 4, abs=most + 1.0)


def test_each_wheel_has_its_own_speed() -> None:
    coarse, counted = Coarse(), [Counted(lambda t, own=own: own, 48) for own in (30.0, 40.0, 50.0, 60.0)]
    for _ in range(60):
        messages = [one.message() for one in counted]
        shown = coarse.smoothed(tuple(message[i] for i, message in enumerate(messages)))
    assert len(coarse.weights) > 1
    assert shown == pytest.approx((30.0, 40.0, 50.0, 60.0), abs=2.0)


@pytest.mark.parametrize("step", [0.0, 0.01, 0.03, 0.9 * FINE_RADPS])
def test_wheels_with_steps_as_a_bus_has_are_taken_as_they_are(step) -> None:
    coarse = Coarse()
    for k in range(500):
        speed = 60.0 + 20.0 * math.sin(0.02 * k) + 2.0 * math.sin(0.7 * k)
        shown = tuple(round(s / step) * step if step else s for s in (speed, speed + 0.3, speed - 0.1, 0.99 * speed))
        assert coarse.smoothed(shown) is shown
    assert len(coarse.weights) == 1


@pytest.mark.parametrize("change", [-0.5, 0.4, 6.0])
def test_a_steady_ramp_is_no_step(change) -> None:
    """Wheels that spin up all alike change by the same each time."""
    coarse = Coarse()
    for k in range(100):
        shown = (100.0 + change * k,) * 4
        assert coarse.smoothed(shown) is shown


@pytest.mark.parametrize("odd", [math.inf, -math.inf, math.nan, 1e308, -1e308, 5e-324])
def test_no_number_is_too_odd(odd) -> None:
    coarse = Coarse()
    for k in range(50):
        shown = (odd if k % 2 else 0.0, 20.0 + k, odd, 20.0 - 0.1 * k)
        assert coarse.smoothed(shown) is shown


def test_one_odd_message_hides_no_teeth() -> None:
    counted, coarse = Counted(lambda t: 80.0, 48), Coarse()
    coarse.smoothed((80.123, 80.0, 79.9, 80.2))
    for _ in range(60):
        coarse.smoothed(counted.message())
    assert len(coarse.weights) > 1


def test_a_wheel_that_is_missing_takes_no_other_with_it() -> None:
    counted, coarse = Counted(lambda t: 80.0, 48), Coarse()
    for _ in range(60):
        coarse.smoothed(counted.message())
    a, b, _, d = counted.message()
    lost = [math.isnan(speed) for speed in coarse.smoothed((a, b, math.nan, d))]
    assert lost == [False, False, True, False]
    for _ in range(len(coarse.weights)):
        shown = coarse.smoothed(counted.message())
    assert shown == pytest.approx((80.0,) * 4, abs=1.0)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_weights_are_those_of_a_line_through_the_angles(count) -> None:
    times = [float(k) for k in range(count + 1)]
    middle = sum(times) / len(times)
    square = sum((t - middle) ** 2 for t in times)
    # Of a speed in one interval: all angles from its end on are one higher.
    slopes = [sum(t - middle for t in times[k + 1 :]) / square for k in range(count)]
    assert line_weights(count) == pytest.approx(slopes)
