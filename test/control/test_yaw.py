# SPDX-License-Identifier: Apache-2.0
"""What a yaw rate adds to the yaw budget, when it is believed, and that nothing changes without one."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control.yaw import (
    ASIDE_MPS,
    ASIDE_RAD,
    CALM_MPS2,
    CAUGHT,
    DAMPING_NMS,
    FELT_MPS2,
    LEAST_MPS,
    LOST_DAMPING_NMS,
    MOST_NM,
    NOT_YET_FELT_MPS2,
    no_yaw,
    with_yaw,
    yaw_step,
)

DT = 0.01
SPEED = 20.0
GROWTH = 600.0
SIDES = pytest.mark.parametrize("side", [1.0, -1.0], ids=["more left", "more right"])


def ahead(rate=0.0, time_s=1.0, slipping=0.0):
    """What is known after wheels that braked alike."""
    yaw = no_yaw()
    for _ in range(round(time_s / DT)):
        yaw = yaw_step(yaw, rate, SPEED * rate + slipping, SPEED, 0.0, GROWTH, False, DT)
    return yaw


def braked(yaw, rates, side=1.0, braking=True, growth=GROWTH, since_s=0.0, slipping=0.0, true=None):
    """What is known after unequal braking with these yaw rates towards the side with more grip.

    `slipping` is what an accelerometer feels beyond speed times the `true` rates (None: those that are shown).
    """
    for k, rate in enumerate(rates):
        felt = SPEED * (rate if true is None else true[k]) + slipping
        since = side * (since_s + 0.04 + k * DT)
        yaw = yaw_step(yaw, side * rate, side * felt, SPEED, since, growth, braking, DT)
    return yaw


def turning(time_s=0.5):
    """A car that is turned, and steered straight again; no two numbers are the same."""
    return [0.03 + 1e-6 * k for k in range(30)] + [0.001 + 1e-6 * k for k in range(round(time_s / DT))]


def believed(side=1.0):
    return braked(ahead(), turning(), side)


@SIDES
def test_while_the_car_hardly_turns_the_budget_grows_and_where_it_turns_it_is_less(side):
    yaw = believed(side)
    assert yaw.believed
    calm = braked(yaw, [0.001, 0.0011], side, since_s=1.0)
    assert calm.extra_nm == pytest.approx(yaw.extra_nm + 2 * GROWTH * DT, rel=0.05)
    away = braked(yaw, [-0.0001, -0.00011], side, since_s=1.0)
    assert away.extra_nm == pytest.approx(yaw.extra_nm + 2 * GROWTH * DT, rel=0.01)
    quick = braked(yaw, [0.06, 0.061], side, since_s=1.0)
    assert 0.0 < quick.extra_nm < yaw.extra_nm
    own = 0 if side > 0.0 else 1
    budgets = [with_yaw((100.0, 100.0), (0.0, 0.0), side, state) for state in (calm, away, quick)]
    front = [front[own] for front, _ in budgets]
    assert front[2] == 0.0 < front[0] < front[1] == 100.0 + away.extra_nm
    assert {front[1 - own] for front, _ in budgets} == {100.0}
    rear = [rear[own] for _, rear in budgets]
    assert rear[2] == 0.0 < rear[0] < rear[1] < front[1] - 100.0
    assert {rear[1 - own] for _, rear in budgets} == {0.0}


@SIDES
def test_it_grows_by_less_the_more_the_car_turns_to_either_side_but_falls_only_on_one(side):
    yaw = believed(side)
    grown = []
    for mps2 in (0.0, 0.5 * CALM_MPS2, CALM_MPS2, 2.0 * CALM_MPS2):
        turned = [
            yaw_step(yaw, side * way * mps2 / speed, side * way * mps2, speed, side, GROWTH, True, DT).extra_nm
            for speed, way in ((SPEED, 1.0), (2.0 * SPEED, 1.0), (SPEED, -CAUGHT))
        ]
        grown.append([(extra - yaw.extra_nm) / (GROWTH * DT) for extra in turned])
    assert grown == [pytest.approx(row) for row in ([1.0] * 3, [0.5] * 3, [0.0] * 3, [-1.0, -1.0, 0.0])]


@SIDES
@pytest.mark.parametrize("bias", [0.05, -0.05, 0.3])
def test_a_bias_or_a_bend_changes_nothing(side, bias):
    yaw = braked(ahead(bias), [rate + side * bias for rate in turning()], side)
    assert yaw.extra_nm == pytest.approx(believed(side).extra_nm)


@SIDES
@pytest.mark.parametrize(
    "rates",
    [[0.0] * 400, [-rate for rate in turning(4.0)], [-0.03 + 1e-6 * k for k in range(100)] + turning(4.0)],
    ids=["stuck", "wrong sign", "turned the other way first"],
)
def test_a_sensor_that_does_not_show_what_unequal_brakes_do_adds_nothing(side, rates):
    yaw = braked(ahead(), rates, side)
    assert (yaw.believed, yaw.extra_nm) == (False, 0.0)
    assert with_yaw((50.0, 60.0), (0.0, 1.0), side, yaw) == ((50.0, 60.0), (0.0, 1.0))


def test_a_sensor_that_is_heard_too_late_adds_nothing():
    assert braked(ahead(time_s=0.1), turning()).extra_nm == 0.0
    assert braked(no_yaw(), turning()).extra_nm == 0.0


@pytest.mark.parametrize(
    "rates",
    [[math.nan] * 100, [0.02] * 100, [-0.3 + 1e-6 * k for k in range(150)]],
    ids=["silent", "stuck", "turning off to the other side"],
)
def test_what_was_added_fades_where_the_sensor_fails_during_the_braking(rates):
    yaw = believed()
    states = [yaw]
    for k, rate in enumerate(rates):
        states.append(braked(states[-1], [rate], since_s=1.0 + k * DT))
    assert not states[-1].believed
    lost = next(k for k, state in enumerate(states) if not state.believed)
    assert lost * DT <= 0.55
    for before, after in zip(states[lost - 1 :], states[lost:], strict=False):
        damped = DAMPING_NMS * max(before.towards_radps, 0.0) if before.believed else 0.0
        assert after.extra_nm == pytest.approx(max(before.extra_nm - damped - GROWTH * DT, 0.0))
    again = braked(states[-1], turning(), since_s=2.5)
    assert not again.believed


def test_it_grows_to_its_most_only_while_the_car_brakes_and_goes_where_the_wheels_brake_alike():
    yaw = believed()
    assert braked(yaw, turning(10.0), since_s=1.0).extra_nm == MOST_NM
    rolling = braked(yaw, [0.001, 0.002], since_s=1.0, braking=False)
    turned = yaw.towards_radps + 0.001
    assert rolling.extra_nm == pytest.approx(yaw.extra_nm - DAMPING_NMS * turned - 2 * GROWTH * DT)
    alike = yaw_step(yaw, 0.001, SPEED * 0.001, SPEED, 0.0, GROWTH, True, DT)
    assert (alike.believed, alike.extra_nm, alike.turned_rad) == (False, 0.0, 0.0)
    assert yaw_step(yaw, math.nan, 0.0, SPEED, 0.0, GROWTH, True, DT) == no_yaw()


@SIDES
@pytest.mark.parametrize("level", [0.4, -0.4])
def test_a_bias_of_the_accelerometer_or_a_camber_changes_nothing(side, level):
    yaw = braked(ahead(slipping=side * level), turning(4.0), side, slipping=level)
    assert yaw.extra_nm == pytest.approx(braked(ahead(), turning(4.0), side).extra_nm)
    assert yaw.extra_nm > 1000.0


@SIDES
def test_the_yaw_rate_counts_within_what_is_felt(side):
    yaw, calm = believed(side), [0.001 + 1e-6 * k for k in range(10)]
    turns = [0.001 + (CALM_MPS2 + FELT_MPS2) / SPEED] * 10
    shown = braked(yaw, calm, side, since_s=1.0, true=turns)
    assert shown.extra_nm == pytest.approx(yaw.extra_nm, abs=5.0), "the budget grows no more"
    assert shown.towards_radps == pytest.approx(CALM_MPS2 / SPEED, abs=0.002)
    assert shown.believed
    grip = braked(yaw, calm, side, since_s=1.0)
    for slipping in (FELT_MPS2 - 0.01, 0.01 - NOT_YET_FELT_MPS2):
        within = braked(yaw, calm, side, since_s=1.0, slipping=slipping)
        assert (within.extra_nm, within.towards_radps) == (grip.extra_nm, grip.towards_radps)
    off = [0.08 + rate for rate in calm]
    away = braked(yaw, off, side, since_s=1.0, true=[-rate for rate in calm])
    assert away.towards_radps == pytest.approx(NOT_YET_FELT_MPS2 / SPEED - calm[-1], abs=1e-6), "not 0.08"


def test_at_walking_pace_what_is_felt_is_no_large_yaw_rate():
    slow = yaw_step(believed(), 0.001, FELT_MPS2 + 0.2, 0.1, 1.0, GROWTH, True, DT)
    assert slow.towards_radps == pytest.approx(0.001 + 0.2 / LEAST_MPS, abs=0.001)


@SIDES
@pytest.mark.parametrize("off", [0.08, -0.08, 0.4, -0.4])
def test_where_both_contradict_each_other_neither_is_believed(side, off):
    true = turning(3.0)
    shown = [rate + off for rate in true]
    states = [believed(side)]
    for k, (rate, real) in enumerate(zip(shown, true, strict=True)):
        states.append(braked(states[-1], [rate], side, since_s=1.0 + k * DT, true=[real]))
    lost = next(k for k, state in enumerate(states) if not state.believed)
    apart_s = ASIDE_MPS / SPEED / abs(off)
    assert apart_s <= lost * DT <= 1.4 * apart_s + DT
    assert states[-1].extra_nm == 0.0
    assert not braked(states[-1], turning(), side, since_s=5.0).believed, "not in this braking any more"


def test_a_car_that_slowly_slips_aside_is_believed():
    true = [0.001 + 1e-6 * k for k in range(300)]
    assert braked(believed(), true, since_s=1.0, slipping=0.7 * ASIDE_MPS).believed


@pytest.mark.parametrize(("speed", "most"), [(35.0, ASIDE_RAD * 35.0), (20.0, ASIDE_MPS)])
def test_the_faster_the_car_the_faster_it_may_slip_aside(speed, most):
    for part, still in ((0.98, True), (1.02, False)):
        aside = believed()._replace(aside_mps=part * most * (1.0 + DT))
        assert yaw_step(aside, 0.0, 0.0, speed, 1.0, GROWTH, True, DT).believed is still


@pytest.mark.parametrize(("rate", "felt"), [(0.0, math.nan), (math.nan, 0.0)], ids=["gyroscope", "accelerometer"])
def test_one_of_both_alone_adds_nothing(rate, felt):
    yaw = believed()
    for since in (1.0, 1.01):
        yaw = yaw_step(yaw, rate, felt, SPEED, since, GROWTH, True, DT)
    damped = DAMPING_NMS * believed().towards_radps
    assert yaw == no_yaw(believed().extra_nm - damped - GROWTH * DT - GROWTH * DT)


def test_without_growth_the_rate_is_not_used():
    assert braked(ahead(), turning(), growth=0.0) == no_yaw()
    yaw = ahead()
    assert with_yaw((1.0, 2.0), (3.0, 4.0), 0.0, yaw) == ((1.0, 2.0), (3.0, 4.0))


@SIDES
def test_where_the_rate_is_lost_a_car_that_turns_is_still_braked_less_unequally(side):
    lost = braked(believed(side), [0.5 + 1e-6 * k for k in range(30)], side, since_s=1.0, true=[0.0] * 30)
    assert (lost.believed, lost.lost) == (False, True)
    alike = yaw_step(lost, 0.0, 0.0, SPEED, 0.0, GROWTH, True, DT)
    assert not alike.lost
    own = 0 if side > 0.0 else 1
    budgets = [
        with_yaw((900.0, 900.0), (0.0, 0.0), side, lost._replace(towards_radps=x, extra_nm=0.0))[0]
        for x in (-0.1, 0.0, 0.05)
    ]
    assert [budget[own] for budget in budgets] == pytest.approx([900.0, 900.0, 900.0 - 0.05 * LOST_DAMPING_NMS])
    assert {budget[1 - own] for budget in budgets} == {900.0}
    never = no_yaw()._replace(towards_radps=0.05)
    assert with_yaw((900.0, 900.0), (0.0, 0.0), side, never) == ((900.0, 900.0), (0.0, 0.0))


@SIDES
@pytest.mark.parametrize("felt", [1.0, -1.0, 0.0], ids=["right", "wrong sign", "stuck"])
def test_where_the_rate_is_lost_only_a_turn_that_both_sensors_show_is_damped(side, felt):
    lost = believed(side)._replace(aside_mps=10.0)
    for turn in (0.1, -0.1):
        yaw = yaw_step(lost, side * turn, side * felt * SPEED * turn, SPEED, side, GROWTH, True, DT)
        assert yaw.lost
        assert yaw.towards_radps == pytest.approx(min(turn, felt * turn), abs=1e-6)
