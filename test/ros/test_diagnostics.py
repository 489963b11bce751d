# SPDX-License-Identifier: Apache-2.0
"""What diagnostics say, from plain numbers."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from iwm_power_manager.control.actuators import ActuatorState, Evidence, MotorVerdict
from iwm_power_manager.control.inputs import Violation, WheelVerdict
from iwm_power_manager.control.monitor import Tally
from iwm_power_manager.control.motion import DOUBT_SPEED
from iwm_power_manager.control.record import DECIDED_NAMES, command_of
from iwm_power_manager.control.supervision import (
    MODE_DEGRADED,
    MODE_NORMAL,
    MODE_RECOVERING,
    STALE_DEMAND,
    STALE_SPEED,
    STALE_WHEELS,
    Supervision,
)
from iwm_power_manager.nodes.power_manager_report import (
    ChangeDetector,
    PowerManagerReport,
    is_against,
    is_cut,
    is_stuck,
)
from iwm_power_manager.ros.diagnostics import (
    ERROR,
    OK,
    WARN,
    InputReport,
    LoopStatistics,
    Status,
    brakes_status,
    control_status,
    motors_status,
    sensors_status,
    to_message,
)

LIMITS = {
    "execution_warn_us": 1000.0,
    "execution_error_us": 2000.0,
    "periodicity_warn_hz": 5.0,
    "periodicity_error_hz": 10.0,
}
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
GOOD = (WheelVerdict.GOOD,) * 4
NONE_NM = (0.0,) * 4
SECOND = 10**9


class TestLoop:
    @pytest.mark.parametrize(("execution_us", "level"), [(999.0, OK), (1001.0, WARN), (1999.0, WARN), (2001.0, ERROR)])
    def test_execution_time_is_judged_by_its_mean(self, execution_us, level) -> None:
        loop = LoopStatistics()
        for offset in (-500.0, 500.0):
            loop.add(0.01, (execution_us + offset) * 1e-6)
        status = loop.report(100.0, LIMITS)
        assert status.level == level
        assert status.values["execution time, max (us)"] == f"{execution_us + 500.0:.0f}"

    @pytest.mark.parametrize(
        ("rate_hz", "level"), [(100.0, OK), (95.1, OK), (94.9, WARN), (105.1, WARN), (89.9, ERROR), (111.0, ERROR)]
    )
    def test_the_rate_is_judged_by_its_deviation(self, rate_hz, level) -> None:
        loop = LoopStatistics()
        for _ in range(10):
            loop.add(1.0 / rate_hz, 1e-4)
        status = loop.report(100.0, LIMITS)
        assert status.level == level
        assert level == OK or " Hz is above " in status.message

    def test_a_report_starts_counting_anew_but_keeps_the_total(self) -> None:
        loop = LoopStatistics()
        loop.add(None, 0.5)
        loop.add(0.02, 1e-4)
        loop.report(100.0, LIMITS)
        loop.add(0.01, 1e-4)
        status = loop.report(100.0, LIMITS)
        assert status.level == OK
        assert status.values["steps"] == "3"
        assert status.values["steps since the last report"] == "1"
        assert status.values["period, max (ms)"] == status.values["period, min (ms)"] == "10.000"

    def test_without_a_step_a_loop_with_a_rate_is_in_error_and_lockstep_is_not(self) -> None:
        assert LoopStatistics().report(100.0, LIMITS).level == ERROR
        assert LoopStatistics().report(None, LIMITS).level == OK

    def test_in_lockstep_the_rate_is_told_and_not_judged(self) -> None:
        loop = LoopStatistics()
        loop.add(0.5, 1e-4)
        status = loop.report(None, LIMITS)
        assert status.level == OK
        assert status.values["rate, mean (Hz)"] == "2.00"


class TestInputs:
    def tallies(self) -> dict[str, Tally]:
        return {"vehicle_speed": Tally(), "power_demand": Tally()}

    def test_rates_are_counted_between_reports(self) -> None:
        tallies, report = self.tallies(), InputReport()
        report.report(0, tallies, 0, GOOD, WHEELS, {})
        for i in range(50):
            tallies["vehicle_speed"].note(Violation.NONE, i)
        status = report.report(SECOND // 2, tallies, 0, GOOD, WHEELS, {})
        assert status.values["vehicle_speed: rate (Hz)"] == "100.0"
        assert status.values["power_demand: rate (Hz)"] == "0.0"
        assert status.values["power_demand: age (s)"] == "inf"
        assert status.level == OK

    def test_a_missing_input_is_an_error_with_its_reason(self) -> None:
        tallies = self.tallies()
        tallies["vehicle_speed"].note(Violation.STAMP_TOO_OLD, 0)
        status = InputReport().report(0, tallies, STALE_SPEED | STALE_DEMAND, GOOD, WHEELS, {})
        assert status.level == ERROR
        assert status.message == "vehicle_speed is missing (stamp too old); power_demand is missing"

    def test_of_a_missing_input_the_silent_topic_is_named_where_its_own_name_is_another(self) -> None:
        silent = {"vehicle_speed": (["/car/vehicle_speed"], ""), "power_demand": (["/pedals/brake"], "no publisher")}
        status = InputReport().report(0, self.tallies(), STALE_SPEED | STALE_DEMAND, GOOD, WHEELS, silent)
        assert status.message == "vehicle_speed is missing; power_demand is missing on /pedals/brake (no publisher)"

    def test_a_refused_demand_that_names_its_topic_is_told_without_the_others(self) -> None:
        tallies = self.tallies()
        tallies["power_demand"].describe = lambda: "brake_pedal on /brake: 250 %"
        tallies["power_demand"].note(Violation.OUT_OF_RANGE, 0)
        silent = {"power_demand": (["/accelerator", "/brake"], "")}
        message = InputReport().report(0, tallies, STALE_DEMAND, GOOD, WHEELS, silent).message
        assert message == "power_demand is missing (out of range: brake_pedal on /brake: 250 %)"

    def test_a_dropped_message_is_a_warning_once(self) -> None:
        tallies, report = self.tallies(), InputReport()
        tallies["vehicle_speed"].note(Violation.NOT_FINITE, 0)
        first = report.report(0, tallies, 0, GOOD, WHEELS, {})
        assert (first.level, first.message) == (WARN, "vehicle_speed: not finite")
        assert first.values["vehicle_speed: dropped, not finite"] == "1"
        assert report.report(SECOND, tallies, 0, GOOD, WHEELS, {}).level == OK

    def test_a_message_dropped_before_a_good_one_is_still_told(self) -> None:
        tallies = self.tallies()
        tallies["vehicle_speed"].note(Violation.NOT_FINITE, 0)
        tallies["vehicle_speed"].note(Violation.NONE, 0)
        assert InputReport().report(0, tallies, 0, GOOD, WHEELS, {}).message == "vehicle_speed: dropped"

    def test_a_lost_wheel_is_a_warning(self) -> None:
        verdicts = (WheelVerdict.GOOD, WheelVerdict.STUCK, WheelVerdict.GOOD, WheelVerdict.GOOD)
        status = InputReport().report(0, self.tallies(), 0, verdicts, WHEELS, {})
        assert (status.level, status.message) == (WARN, "wheel front_right is not believed (stuck)")
        assert status.values["wheel front_right"] == "stuck"


CAR = {"vehicle": "van"}


class TestControl:
    def test_normal_operation_is_ok_and_tells_what_binds(self) -> None:
        supervision = Supervision(MODE_NORMAL, 0, 1.0, 1.0, 1.0)
        status = control_status("active", supervision, 2, 2 | 32, {"gate": 7}, "sdp", CAR)
        assert (status.level, status.message) == (OK, "normal")
        assert status.values["gate"] == "rear"
        assert status.values["limits that bind"] == "regeneration, slew"
        assert status.values["gate: steps since the last report"] == "7"
        assert status.values["degraded reason"] == "none"
        assert status.values["vehicle"] == "van"

    def test_a_demand_of_which_limits_leave_nothing_is_a_warning(self) -> None:
        normal = Supervision(MODE_NORMAL, 0, 1.0, 1.0, 1.0)
        status = control_status("active", normal, 0, 4, {}, "sdp", CAR, "asked for 20 kW, gets as good as none")
        assert (status.level, status.message) == (WARN, "asked for 20 kW, gets as good as none")

    def test_a_faded_motor_is_not_put_down_to_the_battery(self) -> None:
        for factor, words in ((0.0, "motor, motors faded out"), (0.5, "motor, battery_discharge")):
            supervision = Supervision(MODE_DEGRADED, STALE_DEMAND, factor, 1.0, 0.0)
            status = control_status("active", supervision, 0, 1 | 4, {}, "sdp", CAR)
            assert status.values["limits that bind"] == words

    def test_degraded_is_an_error_with_its_reason(self) -> None:
        supervision = Supervision(MODE_DEGRADED, STALE_DEMAND, 0.25, 1.0, 0.0)
        status = control_status("active", supervision, 0, 0, {}, "sdp", CAR)
        assert (status.level, status.message) == (ERROR, "degraded: power_demand missing")
        assert status.values["motor torque allowed (%)"] == "25"

    def test_recovering_is_a_warning(self) -> None:
        status = control_status("active", Supervision(MODE_RECOVERING, 0, 0.5, 1.0, 1.0), 0, 0, {}, "sdp", CAR)
        assert (status.level, status.message) == (WARN, "recovering")

    def test_a_node_that_is_not_active_is_ok_and_says_what_it_is(self) -> None:
        status = control_status("inactive", Supervision(), 0, 0, {}, "sdp", CAR)
        assert (status.level, status.message) == (OK, "inactive")


def test_sensors_that_agree_with_each_other_alone_are_not_put_down_to_a_unit() -> None:
    wheels = ("fl", "fr", "rl", "rr")
    all_five = dict.fromkeys(range(5), 100)
    assert "started over? then deactivate" in sensors_status(all_five, 100, wheels, agree=True).message
    for doubted, agree in ((all_five, False), (dict.fromkeys(range(4), 100), True)):
        assert "right unit, sign and scale?" in sensors_status(doubted, 100, wheels, agree=agree).message


def test_the_message_carries_stamp_names_levels_and_values() -> None:
    message = to_message(3 * SECOND + 5, "node", [Status("part", ERROR, "broken", {"key": "value"})])
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 5)
    status = message.status[0]
    assert (status.name, status.level, status.message) == ("node: part", DiagnosticStatus.ERROR, "broken")
    assert (status.values[0].key, status.values[0].value) == ("key", "value")


def test_a_change_is_told_once_and_not_too_often() -> None:
    changes = ChangeDetector(0.1)
    assert changes.changed("a", 0.0)
    assert not changes.changed("a", 1.0)
    assert changes.changed("b", 1.0)
    assert not changes.changed("c", 1.05)
    assert changes.changed("c", 1.2)


def test_a_motor_that_does_not_follow_is_named():
    motors = (Evidence(), Evidence(MotorVerdict.DEAD, 0.0), Evidence(MotorVerdict.WEAK, 0.5), Evidence())
    status = motors_status(ActuatorState(motors=motors, reporting=True), NONE_NM, ("fl", "fr", "rl", "rr"))
    assert (status.level, status.message) == (ERROR, "motor fr is dead; motor rl is weak")
    assert status.values["motor rl: counted on (%)"] == "50"
    assert status.values["motor fl"] == "good"
    quiet = motors_status(ActuatorState(), NONE_NM, ("fl", "fr", "rl", "rr"))
    assert (quiet.level, quiet.values["reported torque"]) == (OK, "none that follows the commands")


@pytest.mark.parametrize(
    ("later_s", "level", "words"),
    [(0.0, OK, ""), (0.0025, OK, ""), (0.0125, WARN, "12.5 ms later"), (-0.01, WARN, "10 ms sooner")],
)
def test_torques_that_act_at_another_time_than_is_told_are_said(later_s, level, words):
    status = motors_status(ActuatorState(), NONE_NM, ("fl", "fr", "rl", "rr"), later_s)
    assert (status.level, words in status.message) == (level, True)
    assert float(status.values["torques act later than told (ms)"]) == pytest.approx(1e3 * later_s)


@pytest.mark.parametrize(("brake_nm", "more"), [(0.0, ""), (-60.0, " at 60 N m, held by its brake")])
def test_a_brake_that_holds_a_stuck_motor_is_said(brake_nm, more):
    motors = (Evidence(), Evidence(), Evidence(), Evidence(MotorVerdict.STUCK, 0.0, 60.0))
    status = motors_status(
        ActuatorState(motors=motors, reporting=True), (-200.0, 0.0, 0.0, brake_nm), ("fl", "fr", "rl", "rr")
    )
    assert (status.level, status.message) == (ERROR, f"motor rr is stuck{more}")


def test_a_brake_that_gives_less_than_it_is_told_is_named():
    status = brakes_status((1.0, 0.0, 0.4, 1.0), ("fl", "fr", "rl", "rr"))
    assert (status.level, status.message) == (ERROR, "brake fr is dead; brake rl is weak")
    assert status.values["brake rl: counted on (%)"] == "40"
    assert brakes_status((1.0,) * 4, ("fl", "fr", "rl", "rr")).level == OK


@pytest.mark.parametrize(
    ("given_w", "motor_factor", "asked_w", "cut"),
    [
        (100.0, 1.0, 9e3, True),
        (9e3, 1.0, 9e3, False),
        (0.0, 0.5, 9e3, False),  # an input is missing, and that is what is said
        (0.0, 1.0, -9e3, False),  # braking is another matter
        (0.0, 1.0, 300.0, False),  # creeping
    ],
)
def test_only_driving_asked_for_in_earnest_and_with_all_inputs_there_counts_as_cut(given_w, motor_factor, asked_w, cut):
    command = command_of((0.0,) * len(DECIDED_NAMES))._replace(front_power_w=0.5 * given_w, rear_power_w=0.5 * given_w)
    assert is_cut(command, motor_factor, asked_w) is cut


@pytest.mark.parametrize(("speed_mps", "cut"), [(0.0, True), (1.2, True), (5.0, False)])
def test_near_standstill_a_force_is_asked_for_and_the_power_is_small(speed_mps, cut):
    """800 N at rest are 800 W."""
    assert is_cut(command_of((0.0,) * len(DECIDED_NAMES))._replace(speed_mps=speed_mps), 1.0, 800.0) is cut


@pytest.mark.parametrize(
    ("speed_mps", "motor_nm", "asked_w", "against"),
    [
        (-3.0, 50.0, 5e3, True),
        (3.0, -50.0, 5e3, True),  # in reverse
        (3.0, 50.0, 5e3, False),
        (-1.0, 50.0, 5e3, False),  # may roll back on a slope
        (3.0, -50.0, -5e3, False),  # brakes
    ],
)
def test_a_car_that_moves_against_motors_that_drive_it(speed_mps, motor_nm, asked_w, against):
    command = command_of((0.0,) * len(DECIDED_NAMES))._replace(speed_mps=speed_mps, motor_torque_nm=(motor_nm,) * 4)
    assert is_against(command, asked_w) is against


@pytest.mark.parametrize(
    ("speed_mps", "motor_nm", "given_w", "motor_factor", "asked_w", "stuck"),
    [
        (0.0, 220.0, 2600.0, 1.0, 2600.0, True),
        (-0.1, 220.0, 2600.0, 1.0, 2600.0, True),  # held by its own brakes again and again
        (0.1, -220.0, 2600.0, 1.0, 2600.0, True),  # in reverse
        (0.2, 220.0, 2600.0, 1.0, 2600.0, False),  # moves off
        (-0.2, -220.0, 2600.0, 1.0, 2600.0, False),
        (-2.0, 220.0, 2600.0, 1.0, 2600.0, False),  # goes against its motors, which is another fault
        (0.0, 220.0, 2600.0, 0.9, 2600.0, False),  # an input is missing
        (0.0, 30.0, 400.0, 1.0, 400.0, False),  # creeps at most
        (0.0, 0.0, 0.0, 1.0, 2600.0, False),  # a limit leaves nothing
        (0.0, 0.0, -2600.0, 1.0, -2600.0, False),  # brakes
    ],
)
def test_a_car_that_is_to_drive_off_and_does_not(speed_mps, motor_nm, given_w, motor_factor, asked_w, stuck):
    command = command_of((0.0,) * len(DECIDED_NAMES))._replace(
        speed_mps=speed_mps, motor_torque_nm=(motor_nm,) * 4, front_power_w=0.5 * given_w, rear_power_w=0.5 * given_w
    )
    assert is_stuck(command, motor_factor, asked_w) is stuck


@pytest.mark.parametrize(
    ("stale", "named"),
    [(0, "wheel fl, vehicle_speed"), (STALE_SPEED, "wheel fl"), (STALE_WHEELS, "vehicle_speed"), (3, "")],
)
def test_an_input_that_does_not_come_is_missing_and_not_doubted(stale, named):
    report = PowerManagerReport("/pm", ("fl", "fr", "rl", "rr"), None, {})
    command = command_of((0.0,) * len(DECIDED_NAMES))._replace(doubted=1 | DOUBT_SPEED)
    controller = SimpleNamespace(
        supervision=Supervision(stale=stale),
        command=command,
        monitor=SimpleNamespace(tallies={}, verdicts=(WheelVerdict.GOOD,) * 4, agree=False, apart=""),
        actuators=ActuatorState(),
        brake_gain=(1.0,) * 4,
        torques_later_s=0.0,
    )
    for _ in range(5):
        report.note_step(command, controller.supervision, 0.0, 0.01, 1e-4)
    report.message(0, "active", controller, LIMITS | {"strategy": "equal"}, [], {})
    assert [line.partition(" not believed")[0] for line in report.doubts] == ([named] if named else [])
