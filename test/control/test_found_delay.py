# SPDX-License-Identifier: Apache-2.0
"""How much later torques act than is told: against wheels that turn as torque, road and the true delay say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.alignment import Alignment
from iwm_power_manager.control.coarse import line_weights
from iwm_power_manager.control.found_delay import FoundDelay

MS = 1_000_000
INERTIA = (0.8, 0.8, 1.3, 1.3)
PERIOD_MS = 10
STEPS = 40


class Wheels:
    """Wheels that a controller turns with torques that jump about, seen every 10 ms.

    Parameters
    ----------
    torques : commands of each step; every wheel has its own part of them
    delay_ms : after a command until it acts; below 0, stamps look older than they are
    later_ms : the same in the second half of the steps; None: as in the first
    stiff : part of a change of torque that the road takes at once
    """

    def __init__(self, torques, delay_ms, *, later_ms=None, stiff=0.0, start=900.0, noise=0.0, every_ms=PERIOD_MS):
        self.torques = [(t, 0.9 * t, 1.1 * t, t) for t in torques]
        random = np.random.default_rng(1)
        speed, self.shown = [start] * 4, []
        for ms in range(PERIOD_MS * len(torques) + 100):
            if ms % every_ms == 0:
                self.shown.append(tuple(w + noise * float(random.standard_normal()) for w in speed))
            changed = later_ms is not None and 2 * ms >= PERIOD_MS * len(torques)
            k = (ms - (later_ms if changed else delay_ms)) // PERIOD_MS
            acting = self.torques[min(max(k, 0), len(torques) - 1)]
            speed = [w + 1e-3 * (1.0 - stiff) * (t + 150.0) / i for w, t, i in zip(speed, acting, INERTIA, strict=True)]

    def found_ms(self, told_ms=0, change=lambda k, shown: shown, weights=(1.0,)):
        """What is found in each step; `change` is what sensors make of the speeds."""
        alignment, found = Alignment(INERTIA, told_ms / 1e3), []
        for k, torque in enumerate(self.torques):
            now = k * PERIOD_MS * MS
            alignment.shift_nm(now, PERIOD_MS / 1e3, now, change(k, self.shown[k]), weights)
            alignment.applied(now, torque)
            found.append(alignment.found.beyond_ns / MS)
        return found


def jumping(seed=0, least=150.0):
    """Torques that jump by at least so much, up and down by chance, about what the road takes."""
    random = np.random.default_rng(seed)
    return [-150.0 + float(random.choice((-1.0, 1.0)) * random.uniform(0.5, 1.5) * least) for _ in range(STEPS)]


@given(st.integers(0, 99), st.integers(0, 30), st.sampled_from((0, 2, 5, 10)))
def test_a_delay_that_nobody_tells_is_found_and_not_taken_for_much_longer(seed, true_ms, told_ms):
    """Too short by 8 ms is borne, too long by 3 is not."""
    found = Wheels(jumping(seed), true_ms).found_ms(told_ms)[-1] + told_ms
    assert -8 < found - true_ms < 2 or (found == told_ms - 20 and true_ms < found)


@given(st.integers(0, 99), st.sampled_from((5, 10, 15, 20, 25, 30)))
def test_it_is_found_within_few_steps_through_the_noise_of_wheel_speeds(seed, true_ms):
    found = Wheels(jumping(seed, 300.0), true_ms, noise=0.1).found_ms()
    assert all(abs(ms - true_ms) <= 5 for ms in found[15:])


def test_what_was_seen_long_ago_is_forgotten():
    """A delay that changes is found within `STEPS`, however long another was seen."""
    for seed in range(20):
        before = [torque for k in range(10) for torque in jumping(10 * seed + k, 300.0)]
        found = Wheels(before * 2, 0, later_ms=15).found_ms()
        assert not any(found[: len(before)])
        assert abs(found[len(before) + STEPS] - 15) <= 5


@given(st.integers(0, 99))
def test_one_that_is_told_too_long_is_found_to_be_shorter(seed):
    assert Wheels(jumping(seed), 2).found_ms(told_ms=12)[-1] == -10


def test_through_much_noise_a_shorter_delay_is_taken_and_a_longer_one_is_not():
    """2 ms too short are borne, and too long by 3 they are not: so the one asks for less evidence than the other."""
    for seed in range(10):
        assert Wheels(jumping(seed), 8, noise=0.3).found_ms(told_ms=10)[-1] < 0
        assert Wheels(jumping(seed), 10, noise=0.3).found_ms(told_ms=8)[-1] == 0


@given(st.integers(0, 99), st.floats(0.0, 0.2), st.integers(0, 20))
def test_what_is_told_right_stays(seed, noise, true_ms):
    assert not any(Wheels(jumping(seed), true_ms, noise=noise).found_ms(told_ms=true_ms))


def test_torques_that_hardly_change_tell_nothing():
    """What noise of 0.1 rad/s makes of them either: the command answers it, and seems to come before it."""
    torques = [-150.0 + 30.0 * (-1) ** (k // 3) for k in range(STEPS)]
    assert not any(Wheels(torques, 20, noise=0.1).found_ms())
    torques = [-150.0 + 44.0 * (-1) ** k for k in range(STEPS)]
    assert not any(Wheels(torques, 15).found_ms())


@pytest.mark.parametrize(("speed_radps", "found_ms"), [(4.0, 0), (-4.0, 0), (0.0, 0), (20.0, 20), (-20.0, 20)])
def test_wheels_that_nearly_stand_tell_nothing(speed_radps, found_ms):
    wheels, found = Wheels(jumping(), 20), FoundDelay()
    torques = [(k * PERIOD_MS * MS, torque) for k, torque in enumerate(wheels.torques)]
    for k in range(1, STEPS):
        pairs = zip(INERTIA, wheels.shown[k - 1], wheels.shown[k], strict=True)
        turned = tuple(inertia * (after - before) * 1e3 / PERIOD_MS for inertia, before, after in pairs)
        now_ns = k * PERIOD_MS * MS
        found.learn(torques[:k], now_ns - PERIOD_MS * MS, now_ns, turned, (speed_radps,) * 4)
    assert found.beyond_ns == found_ms * MS


def test_where_the_road_takes_all_that_a_torque_changes_no_delay_is_told():
    """As on a good road, far from its limit: it is no delay by which torques have yet to act."""
    for seed in range(20):
        found = Wheels(jumping(seed, 300.0), 0, stiff=0.9, noise=0.05).found_ms()
        assert not any(found)
    one = [-150.0] * 5 + [-650.0] * 35
    assert not any(Wheels(one, 0, stiff=0.8).found_ms())


@pytest.mark.parametrize("wheel", range(4))
def test_three_wheels_tell_it_beside_one_that_is_wrong(wheel):
    random = np.random.default_rng(2)

    def astray(k, shown):
        return tuple(60.0 + 5.0 * float(random.standard_normal()) if i == wheel else w for i, w in enumerate(shown))

    assert Wheels(jumping(), 15).found_ms(change=astray)[-1] == 15
    assert not any(Wheels(jumping(), 0).found_ms(change=astray))


@pytest.mark.parametrize("wheel", range(4))
def test_one_wheel_tells_it_whose_torque_alone_changes(wheel):
    wheels = Wheels(jumping(), 15)
    wheels.torques = [tuple(t if i == wheel else -150.0 for i, t in enumerate(torque)) for torque in wheels.torques]
    wheels.shown = [tuple(w if i == wheel else 900.0 for i, w in enumerate(shown)) for shown in wheels.shown]
    assert wheels.found_ms()[-1] == 15


def test_a_jump_of_all_wheels_is_no_delay():
    def jumped(k, shown):
        return tuple((0.75 if k >= 20 else 1.0) * w for w in shown)

    for seed in range(20):
        assert not any(Wheels(jumping(seed), 0).found_ms(change=jumped))


def test_the_first_jump_after_a_long_rest_tells_it():
    """A full stop begins like that."""
    torques = [-10.0] * 30 + [-500.0, -900.0, -700.0, -100.0, -300.0, -250.0]
    assert Wheels(torques, 10).found_ms()[30:] == [0, 0, 10, 10, 10, 10]


def test_it_is_forgotten_with_the_rest():
    wheels, alignment = Wheels(jumping(), 20), Alignment(INERTIA, 0.0)
    for k, torque in enumerate(wheels.torques):
        alignment.shift_nm(k * PERIOD_MS * MS, 0.01, k * PERIOD_MS * MS, wheels.shown[k])
        alignment.applied(k * PERIOD_MS * MS, torque)
    assert alignment.found.beyond_ns / MS == 20
    alignment.forget()
    assert alignment.found.beyond_ns / MS == 0


def test_wheels_that_count_teeth_tell_no_delay():
    """Their speeds are of several messages."""
    assert not any(Wheels(jumping(), 20).found_ms(weights=line_weights(5)))


def test_the_road_is_told_by_the_delay_that_was_found():
    wheels, alignment = Wheels(jumping(), 15), Alignment(INERTIA, 0.0)
    before = None
    for k, torque in enumerate(wheels.torques):
        shown, now = wheels.shown[k], k * PERIOD_MS * MS
        shift = alignment.shift_nm(now, 0.01, now, shown)
        if k > 30 and before is not None:
            last = wheels.torques[k - 1]
            road = [last[i] + shift[i] - INERTIA[i] * (shown[i] - before[i]) / 0.01 for i in range(4)]
            assert road == pytest.approx([-150.0] * 4, abs=1e-6)
        alignment.applied(now, torque)
        before = shown


def test_of_shorter_delays_that_explain_as_much_the_nearest_is_taken():
    """Told 8 ms too long, those shorter by 7.5 to 12.5 ms all do."""
    for seed in range(20):
        assert Wheels(jumping(seed), 2).found_ms(told_ms=10)[-1] == -7.5
