# SPDX-License-Identifier: Apache-2.0
"""When the controller steps and how long a step counts, with a controller that only writes down what it is asked."""

from __future__ import annotations

import pytest

from iwm_power_manager.control.controller import ControlFaultError, Step
from iwm_power_manager.control.lockstep import BATTERY, SPEED, WHEELS
from iwm_power_manager.control.stepping import AsRecorded, Lockstep, RealTime
from iwm_power_manager.control.supervision import Supervision
from iwm_power_manager.control.thresholds import Thresholds

MS = 1_000_000
PERIOD_S = 0.01


class Monitor:
    def __init__(self, log):
        self._log = log
        self.driven = True
        self.believes = True

    def ages_s(self, now_ns):
        return (0.0, 0.0, 0.0, 0.0)

    def forget_times(self):
        self._log.append("forget times")

    def take_speed(self, reading, now_ns):
        self._log.append(("speed", reading, now_ns))

    def take_wheels(self, reading, now_ns):
        self._log.append(("wheels", reading, now_ns))
        return self.believes

    def take_battery(self, reading, now_ns):
        self._log.append(("battery", reading, now_ns))

    def take_demand(self, demand_w, delay_s, now_ns):
        self._log.append(("demand", demand_w, delay_s, now_ns))


class Controller:
    def __init__(self):
        self.log = []
        self.monitor = Monitor(self.log)
        self.fault = ""
        self.command = None
        self.wheels_lost = 0
        self.supervision = Supervision()

    def reset(self):
        self.log.append("reset")

    def step(self, now_ns, dt_s, elapsed_s):
        if self.fault:
            raise ControlFaultError(self.fault)
        self.log.append(("step", now_ns, dt_s, elapsed_s))
        return Step(None, [])

    def steps(self):
        return [entry[1:] for entry in self.log if entry[0] == "step"]


@pytest.fixture
def controller():
    return Controller()


class TestRealTime:
    @pytest.fixture
    def stepper(self, controller):
        return RealTime(controller, PERIOD_S, Thresholds())

    @pytest.mark.parametrize(
        ("later_ms", "dt_s"), [(10, 0.01), (12, 0.012), (1, 0.002), (30, 0.03), (31, 0.03), (90, 0.03)]
    )
    def test_a_step_counts_as_long_as_it_was_within_bounds(self, stepper, controller, later_ms, dt_s):
        stepper.step(0)
        taken = stepper.step(later_ms * MS)
        assert controller.steps() == [(0, PERIOD_S, None), (later_ms * MS, pytest.approx(dt_s), later_ms * 1e-3)]
        assert (taken.stamp_ns, taken.since_s) == (later_ms * MS, later_ms * 1e-3)

    @pytest.mark.parametrize("back_ms", [0, 1, 5000])
    def test_a_clock_set_back_forgets_the_times_before_the_step_and_keeps_the_run(self, stepper, controller, back_ms):
        stepper.step(10_000 * MS)
        controller.log.clear()
        stepper.step((10_000 - back_ms) * MS)
        assert controller.log == ["forget times", ("step", (10_000 - back_ms) * MS, PERIOD_S, None)]
        assert stepper.restarts == 0

    def test_a_process_held_up_for_longer_than_a_tenth_of_a_second_starts_over(self, stepper, controller):
        for at_s, resets in ((5.0, 0), (5.1, 0), (5.2001, 1), (5.21, 1)):
            stepper.begin(at_s)
            stepper.step(int(at_s * 1e9))
            assert controller.log.count("reset") == stepper.restarts == resets
        assert [step[2] is None for step in controller.steps()] == [True, False, True, False]

    def test_a_slow_loop_is_not_held_up_by_its_own_period(self, controller):
        stepper = RealTime(controller, 0.1, Thresholds())
        for i in range(5):
            stepper.begin(5.0 + 0.13 * i)
        assert stepper.restarts == 0
        stepper.begin(9.0)
        assert stepper.restarts == 1

    def test_on_simulated_time_the_process_s_own_clock_says_nothing(self, stepper, controller):
        for at_s in (None, None, 7.0, None, 99.0):
            stepper.begin(at_s)
        assert "reset" not in controller.log
        assert stepper.may_send(99.02)

    def test_an_old_command_is_not_sent_and_the_run_starts_over(self, stepper, controller):
        stepper.begin(5.0)
        stepper.step(0)
        assert stepper.may_send(5.025 - 1e-9)
        assert not stepper.may_send(5.0251)  # DDS may take the other half
        assert not stepper.may_send(5.05 - 1e-9)
        assert "reset" not in controller.log
        assert not stepper.may_send(5.0501)
        assert stepper.restarts == controller.log.count("reset") == 1
        stepper.begin(9.0)  # starting over it has not been held up again
        assert stepper.restarts == 1

    def test_a_new_run_has_no_step_before(self, stepper, controller):
        stepper.step(0)
        stepper.start_over()
        assert stepper.last_ns is None
        stepper.step(7 * MS)
        assert controller.steps()[-1] == (7 * MS, PERIOD_S, None)

    def test_a_fault_comes_without_a_command(self, stepper, controller):
        controller.fault = "beyond the peak"
        taken = stepper.step(3 * MS)
        assert (taken.step, taken.fault, taken.stamp_ns) == (None, "beyond the peak", 3 * MS)
        assert stepper.last_ns == 3 * MS


class TestLockstep:
    @pytest.fixture
    def stepper(self, controller):
        return Lockstep(controller, PERIOD_S)

    def send(self, stepper, stamp_ns, sent_ns):
        for topic, value in ((SPEED, "v"), (WHEELS, "w"), (BATTERY, "b")):
            stepper.queue.push(topic, stamp_ns, sent_ns, value)
        stepper.queue.push_demand(sent_ns + 1, 7.0)
        return list(stepper.steps())

    def test_each_set_is_judged_at_its_stamp_and_takes_one_step(self, stepper, controller):
        assert self.send(stepper, 100, 1)[0].since_s is None
        assert controller.log == [
            ("speed", "v", 100), ("wheels", "w", 100), ("battery", "b", 100), ("demand", 7.0, 0.0, 100),
            ("step", 100, PERIOD_S, None),
        ]  # fmt: skip
        self.send(stepper, 100 + 25 * MS, 10)
        assert controller.steps()[-1] == (100 + 25 * MS, 0.025, 0.025)

    def test_a_repeated_set_asks_for_the_last_answer(self, stepper, controller):
        self.send(stepper, 100, 1)
        [taken] = self.send(stepper, 100, 5)
        assert taken.step is None
        assert not taken.fault
        assert len(controller.steps()) == 1

    def test_a_stamp_that_goes_back_starts_a_new_run_before_its_inputs_are_judged(self, stepper, controller):
        self.send(stepper, 100 * MS, 1)
        controller.log.clear()
        self.send(stepper, 50 * MS, 10)
        assert controller.log[0] == "reset"
        assert controller.log[-1] == ("step", 50 * MS, PERIOD_S, None)
        assert stepper.restarts == 1

    def test_after_a_fault_the_next_set_steps(self, stepper, controller):
        controller.fault = "no"
        assert self.send(stepper, 100, 1)[0].fault == "no"
        controller.fault = ""
        assert self.send(stepper, 200, 10)[0].step is not None


class TestRecorded:
    @pytest.fixture
    def stepper(self, controller):
        return AsRecorded(controller, PERIOD_S, longest_pause_s=1.0)

    def test_it_steps_with_each_new_time_of_the_wheel_speeds(self, stepper, controller):
        assert stepper.step("w", 0).since_s is None
        assert stepper.step("w", 0) is None
        assert stepper.step("w", 1000 * MS).since_s == 1.0
        assert controller.steps() == [(0, PERIOD_S, None), (1000 * MS, 1.0, 1.0)]

    @pytest.mark.parametrize("to_ms", [1001, -1])
    def test_after_a_pause_or_back_in_time_it_starts_over_and_waits(self, stepper, controller, to_ms):
        stepper.step("w", 0)
        assert stepper.step("w", to_ms * MS) is None
        assert controller.log[-1] == "reset"
        assert stepper.restarts == 1
        assert stepper.step("w", (to_ms + 10) * MS).since_s is None

    def test_it_waits_for_speed_and_demand_and_for_wheels_it_can_believe(self, stepper, controller):
        controller.monitor.driven = False
        assert stepper.step("w", 0) is None
        controller.monitor.driven, controller.monitor.believes = True, False
        assert stepper.step("w", 0) is None
        controller.monitor.believes = True
        assert stepper.step("w", 0) is not None
