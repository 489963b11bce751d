# SPDX-License-Identifier: Apache-2.0
"""When the simulator steps: answers by stamp, repetitions, giving up; and steps due on a clock."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_sim.pacing import FRICTION, MOTOR, Exchange, NoAnswerError, Pacer

MOTORS = (1.0, 2.0, 3.0, 4.0)
BRAKES = (-1.0, -2.0, -3.0, -4.0)


def asked(stamp_ns=10, now_s=0.0):
    exchange = Exchange(resend_after_s=0.5, give_up_after_s=2.0)
    exchange.ask(stamp_ns, now_s)
    return exchange


@pytest.mark.parametrize("kinds", [(MOTOR, FRICTION), (FRICTION, MOTOR)])
def test_both_commands_make_an_answer_in_either_order(kinds):
    exchange = asked()
    torques = {MOTOR: MOTORS, FRICTION: BRAKES}
    assert exchange.answer(kinds[0], 10, torques[kinds[0]]) is None
    assert exchange.answer(kinds[1], 10, torques[kinds[1]]) == (MOTORS, BRAKES)


def test_a_command_with_another_stamp_is_counted_and_left_alone():
    exchange = asked(stamp_ns=20)
    exchange.answer(MOTOR, 10, MOTORS)
    assert exchange.answer(FRICTION, 20, BRAKES) is None
    assert exchange.unrelated == 1


def test_an_answer_is_given_once():
    exchange = asked()
    exchange.answer(MOTOR, 10, MOTORS)
    exchange.answer(FRICTION, 10, BRAKES)
    assert exchange.answer(FRICTION, 10, BRAKES) is None
    assert exchange.unrelated == 1


def test_commands_of_an_earlier_set_do_not_complete_the_next():
    exchange = asked()
    exchange.answer(MOTOR, 10, MOTORS)
    exchange.ask(20, 1.0)
    assert exchange.answer(FRICTION, 20, BRAKES) is None


def test_a_set_is_sent_again_at_each_interval_until_it_is_answered():
    exchange = asked()
    assert [exchange.overdue(now) for now in (0.4, 0.5, 0.6, 1.0)] == [False, True, False, True]
    exchange.answer(MOTOR, 10, MOTORS)
    exchange.answer(FRICTION, 10, BRAKES)
    assert not exchange.overdue(1.6)
    assert exchange.resent == 2


def test_it_gives_up_and_says_what_is_missing():
    exchange = asked(stamp_ns=1_230_000_000)
    exchange.answer(MOTOR, 1_230_000_000, MOTORS)
    with pytest.raises(NoAnswerError, match=r"^no friction_brake_command with stamp 1\.230 s within 2 s"):
        exchange.overdue(2.0)


def test_nothing_is_overdue_before_the_first_set():
    assert not Exchange(0.5, 2.0).overdue(100.0)


def test_a_timer_that_fires_in_time_takes_every_step():
    pacer = Pacer(0.01, 1.0)
    pacer.start(5.0)
    assert [pacer.due(5.0 + 0.01 * (k + 1)) for k in range(200)] == [1] * 200


def test_a_faster_clock_has_a_shorter_wall_period():
    assert Pacer(0.01, 10.0).wall_period_s == pytest.approx(0.001)


def test_a_short_stall_is_caught_up():
    pacer = Pacer(0.01, 1.0, catch_up=5)
    pacer.start(0.0)
    assert pacer.due(0.04) == 4
    assert pacer.stalls == 0


def test_a_long_stall_is_not():
    pacer = Pacer(0.01, 1.0, catch_up=5)
    pacer.start(0.0)
    assert pacer.due(1.0) == 5
    assert pacer.stalls == 1
    assert pacer.late_s == pytest.approx(0.95)
    assert pacer.due(1.01) == 1


@given(gaps=st.lists(st.floats(0.0, 0.2), max_size=60))
def test_simulated_time_never_runs_ahead_and_never_takes_more_than_the_catch_up(gaps):
    pacer = Pacer(0.01, 1.0, catch_up=5)
    pacer.start(0.0)
    now, taken = 0.0, 0
    for gap in gaps:
        now += gap
        steps = pacer.due(now)
        assert 0 <= steps <= 5
        taken += steps
        assert taken <= now / 0.01 + 0.011
