# SPDX-License-Identifier: Apache-2.0
"""Noise of the demand is told from what lasts, and only where there is some."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iwm_power_manager.control.persistence import (
    Jitter,
    carried_w,
    demand_ago,
    held_s,
    lasting_gain,
    no_jitter,
    observed,
    remembered_s,
)


def watched(demand_w: np.ndarray, step_s: float = 0.01, speed_mps: np.ndarray | float = 10.0) -> Jitter:
    jitter = no_jitter()
    for power, speed in zip(demand_w, np.broadcast_to(speed_mps, len(demand_w)), strict=True):
        jitter = observed(jitter, float(power), float(speed), step_s)
    return jitter


def kalman_gain(wander: float, noise: float) -> float:
    """Steady gain by iterating the filter's variance."""
    variance = 1.0
    for _ in range(10_000):
        predicted = variance + wander
        gain = predicted / (predicted + noise)
        variance = (1.0 - gain) * predicted
    return gain


@pytest.mark.parametrize(("wander", "noise"), [(1.0, 1.0), (0.5, 2.0), (3.0, 1.0)])
def test_the_gain_is_the_kalman_filter_s(wander, noise):
    assert lasting_gain(wander + 2.0 * noise, -noise) == pytest.approx(max(kalman_gain(wander, noise), 0.1), rel=1e-6)


def test_a_demand_that_wanders_or_ramps_is_taken_as_it_is():
    rng = np.random.default_rng(1)
    jitter, taken_as_it_is = no_jitter(), 0
    for power in np.cumsum(300.0 * rng.standard_normal(3000)):
        jitter = observed(jitter, float(power), 10.0, 0.1)
        taken_as_it_is += jitter.gain == 1.0
    assert taken_as_it_is > 0.85 * 3000  # two standard errors: by chance, a little of it looks like noise
    assert watched(np.linspace(0.0, 9000.0, 3000)).gain == 1.0
    assert watched(2000.0 * np.sin(np.arange(6000) * 0.01)).gain == 1.0


def test_white_noise_on_a_steady_demand_is_averaged_over_a_second():
    rng = np.random.default_rng(2)
    noisy = 3000.0 + np.repeat(800.0 * rng.standard_normal(600), 10)
    found = watched(noisy)
    assert found.gain < 0.35
    assert math.sqrt(-found.covariance_w2) == pytest.approx(800.0, rel=0.3)


def test_the_latest_second_is_remembered_newest_first():
    found = watched(np.arange(3000.0))
    assert found.samples_w == tuple(2990.0 - 10.0 * age for age in range(10))
    assert found.age_s == pytest.approx(0.09)


def test_the_brake_of_a_second_ago_is_the_same_force_now_and_the_accelerator_the_same_power():
    speed = np.linspace(8.0, 0.0, 160)  # to rest at 5 m/s2, with a foot that rests on the brake
    found = watched(-1500.0 * np.maximum(speed, 1.0), speed_mps=speed)
    for now in (6.0, 1.0, 0.2):
        carried = [carried_w(found, k, now, 1.0) for k in range(10)]
        assert carried == pytest.approx([-1500.0 * max(now, 1.0)] * 10)
    found = watched(1500.0 * speed, speed_mps=speed)
    assert tuple(carried_w(found, k, 6.0, 1.0) for k in range(10)) == found.samples_w


def test_the_demand_some_time_ago_is_that_between_two_samples_and_the_present_one_where_none_is_that_old():
    found = watched(np.arange(3000.0))  # 1 W each 0.01 s; the latest sample is 0.09 s old
    assert [demand_ago(found, 2999.0, seconds) for seconds in (0.09, 0.2, 0.95)] == pytest.approx([2990, 2979, 2904])
    assert demand_ago(found, 2999.0, 0.05) == demand_ago(found, 2999.0, 1.0) == 2999.0
    assert demand_ago(watched(np.arange(15.0)), 14.0, 0.2) == 14.0
    assert remembered_s(watched(np.arange(15.0))) == pytest.approx(0.14)


def test_without_noise_nothing_is_held_and_with_noise_until_the_signal_is_as_uncertain_as_the_estimate():
    assert held_s(1.0) == 0.0
    noise, gain = 1.0, 0.2
    wander = noise * gain**2 / (1.0 - gain)
    samples = held_s(gain) / 0.1
    assert wander * samples / 2.0 == pytest.approx(noise * gain)


def test_nothing_is_known_before_the_first_demand():
    assert no_jitter().gain == 1.0 and no_jitter().taken == 0
    assert observed(no_jitter(), 5.0, 10.0, 0.01).samples_w[0] == 5.0


def test_nothing_but_noise_is_averaged_over_all_that_is_remembered():
    assert lasting_gain(2.0, -1.0) == pytest.approx(0.1)
    assert lasting_gain(1.9, -1.0) == pytest.approx(0.1)
