# SPDX-License-Identifier: Apache-2.0
"""The running node and its inputs over DDS: bad ones are dropped and counted, missing ones degrade, all recovers."""

from __future__ import annotations

import itertools
import math
import re
import time

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import Float64

from iwm_power_manager.control.monitor import InputMonitor
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.control.thresholds import Thresholds, input_limits
from iwm_power_manager.nodes.power_manager_inputs import judge, rate_hz
from iwm_power_manager.ros import messages, qos
from iwm_power_manager.signals.readings import MotionReading

NAN = math.nan
#: A busy machine may keep a message for a while: a test of its content must not fail for its age.
OLDEST_S = 5.0


@pytest.fixture(scope="module")
def bench(start_pair):
    bench = start_pair({"rule": [0.0, 0.9, 0.0, 0.9], "stamp_oldest_s": OLDEST_S}).bench
    bench.connect()
    return bench


@pytest.fixture(autouse=True)
def normal(bench):
    """Every test starts from a node in normal operation."""
    bench.drive(lambda: bench.mode() == 1 and bench.last("stale") == 0, "normal operation")
    bench.diagnostics.clear()


def counter(bench, key: str) -> int:
    bench.diagnostics.clear()
    bench.drive(lambda: bench.status("inputs"), "a report")
    return reported(bench, key)


def reported(bench, key: str) -> int:
    """A counter in the last report that has come; 0 without one."""
    status = bench.status("inputs")
    return int({entry.key: entry.value for entry in status.values}.get(key, "0")) if status else 0


def send_alone(bench, **inputs) -> None:
    """Send a set and wait for its step: of a queue of one, the next set would overwrite it.

    A state may have been on its way for long when it is heard: what counts is when its step was.
    """

    def steps_after(time_ns: int, count: int) -> None:
        bench.spin_until(lambda: sum(ns > time_ns for ns in bench.state_stamps[-100:]) >= count, "steps")

    bench.drive(lambda: bench.last("stale") == 0, "a step")
    steps_after(bench.stamp(), 1)
    bench.send(**inputs)
    steps_after(bench.stamp(), 3)


@pytest.mark.parametrize(
    ("bad", "key"),
    [
        ({"speed": NAN, "wheels": (30.3,) * 4}, "vehicle_speed: dropped, not finite"),
        ({"speed": 500.0, "wheels": (30.3,) * 4}, "vehicle_speed: dropped, out of range"),
        ({"speed": 30.0, "wheels": (30.3,) * 4}, "vehicle_speed: dropped, too fast"),
        ({"demand": math.inf}, "power_demand: dropped, out of range"),
        ({"demand": 1e7}, "power_demand: dropped, out of range"),
        ({"soc": NAN}, "battery_state: dropped, not finite"),
        ({"temperature": 1000.0}, "battery_state: dropped, out of range"),
        ({"wheels": (30.3,) * 3}, "wheel_states: dropped, length"),
        (
            {"wheels": (30.3,) * 4, "names": ("front_left", "front_left", "rear_left", "rear_right")},
            "wheel_states: dropped, name twice",
        ),
        ({"wheels": (NAN, NAN, 30.3, 30.3)}, "wheel_states: dropped, axle lost"),
        ({"wheels": (), "names": ()}, "wheel_states: dropped, axle lost"),
    ],
)
def test_one_bad_message_is_dropped_and_counted_and_changes_nothing(bench, bad, key) -> None:
    before = counter(bench, key)
    start = len(bench.states)
    send_alone(bench, **bad)
    assert counter(bench, key) > before
    assert all(math.isfinite(value) for state in bench.states[start:] for value in state.values())
    # The speed itself, or, where it is missing for too long, what the wheels tell.
    assert all(state["speed_mps"] == pytest.approx(10.0, rel=0.01) for state in bench.states[start:])


def test_a_stamp_from_the_future_or_from_long_ago_is_dropped(bench) -> None:
    for offset_ns, key in ((10**9, "stamp in future"), (-(10**10), "stamp too old")):
        before = counter(bench, f"vehicle_speed: dropped, {key}")
        send_alone(bench, stamp_ns=bench.stamp() + offset_ns)
        assert counter(bench, f"vehicle_speed: dropped, {key}") > before


@pytest.mark.parametrize(
    ("without", "bit"), [("vehicle_speed", 1), ("wheel_states", 2), ("power_demand", 4), ("battery_state", 8)]
)
def test_a_missing_input_degrades_to_zero_torque_and_recovers(bench, without, bit) -> None:
    start = len(bench.states)
    bench.drive(lambda: bench.last("motor_factor") == 0.0, "zero torque", without=(without,))
    degraded = [state for state in bench.states[start:] if state["mode"] == 2]
    # A busy machine may hold up another input for a moment before this one is missed.
    missed = list(itertools.dropwhile(lambda state: not int(state["stale"]) & bit, degraded))
    assert missed
    assert all(int(state["stale"]) & bit for state in missed)
    torques = [state["front_left_motor_torque_nm"] for state in degraded]
    assert all(b <= a + 1e-9 for a, b in itertools.pairwise(torques))
    bench.spin_until(lambda: bench.torques[-1].effort[0] == 0.0, "the last torque")
    bench.drive(
        lambda: bench.status("control") and without in bench.status("control").message, "the report", without=(without,)
    )
    assert bench.status("control").level == DiagnosticStatus.ERROR
    bench.drive(lambda: bench.mode() == 1, "recovery")


def test_an_input_that_repeats_its_stamp_counts_as_missing(bench) -> None:
    frozen = bench.stamp()
    bench.drive(lambda: reported(bench, "vehicle_speed: dropped, stamp not newer"), "the count", stamp_ns=frozen)
    bench.drive(lambda: int(bench.last("stale")) & 3 == 3, "degraded", stamp_ns=frozen)


def test_wheels_are_matched_by_name(bench) -> None:
    names = ("rear_right", "front_left", "rear_left", "front_right")
    bench.drive(
        lambda: bench.last("front_left_speed_radps") == 30.1 and bench.last("rear_right_speed_radps") == 30.4,
        "matched wheels",
        wheels=(30.4, 30.1, 30.3, 30.2),
        names=names,
    )
    assert bench.last("front_right_speed_radps") == 30.2
    assert bench.last("rear_left_speed_radps") == 30.3


def test_with_one_wheel_missing_it_works_on_and_warns(bench) -> None:
    def drive(condition, what):
        bench.drive(condition, what, wheels=(30.3,) * 3, names=messages.WHEEL_NAMES[:3])

    drive(lambda: bench.last("wheels_lost") == 8, "a lost wheel")
    drive(lambda: bench.status("inputs") and "rear_right" in bench.status("inputs").message, "the warning")
    assert bench.status("inputs").level == DiagnosticStatus.WARN
    assert bench.mode() == 1
    assert bench.last("rear_right_motor_torque_nm") > 0.0
    bench.drive(lambda: bench.last("wheels_lost") == 0, "the wheel again")


def test_the_command_is_named_stamped_and_split_left_and_right_alike(bench) -> None:
    bench.drive(lambda: bench.last("front_left_motor_torque_nm") > 40.0, "torque")
    torque, friction = bench.torques[-1], bench.frictions[-1]
    assert tuple(torque.name) == tuple(friction.name) == messages.WHEEL_NAMES
    assert torque.effort[0] == torque.effort[1]
    assert torque.effort[2] == torque.effort[3]
    assert all(effort <= 0.0 for effort in friction.effort)
    stamps = [messages.stamp_to_ns(m.header.stamp) for m in bench.torques]
    assert stamps == sorted(set(stamps))
    assert len(torque.position) == len(torque.velocity) == 0


def test_the_state_carries_every_documented_signal(bench) -> None:
    assert list(bench.states[-1]) == SIGNAL_NAMES


class TestDiagnostics:
    def test_a_healthy_node_is_ok_everywhere(self, bench) -> None:
        full_name = f"{bench.node.get_namespace()}/power_manager"
        names = {
            f"{full_name}: {name}"
            for name in (
                "control",
                "inputs",
                "sensors",
                "motors",
                "brakes",
                "control loop",
                "law",
                "policy",
                "command topics",
            )
        }

        def shown() -> set[str]:
            return {status.name for array in bench.diagnostics[-1:] for status in array.status}

        bench.drive(lambda: len(bench.diagnostics) >= 2 and shown() == names, "a report of these and no others")
        assert {status.hardware_id for status in bench.diagnostics[-1].status} == {full_name}
        for name in ("control", "inputs", "law", "policy", "command topics"):
            bench.drive(lambda name=name: bench.status(name).level == DiagnosticStatus.OK, f"{name} to be ok")

    def test_it_tells_ages_rates_and_times(self, bench) -> None:
        bench.drive(lambda: len(bench.diagnostics) >= 3, "reports")

        def value(status: str, key: str) -> float:
            return float({entry.key: entry.value for entry in bench.status(status).values}[key])

        bench.drive(lambda: value("inputs", "vehicle_speed: age (s)") < 1.0, "an age")
        bench.drive(lambda: 10.0 < value("inputs", "wheel_states: rate (Hz)") < 200.0, "a rate")
        bench.drive(lambda: value("control loop", "rate, mean (Hz)") > 10.0, "the loop's rate")
        assert value("control loop", "execution time, mean (us)") > 0.0

    def test_a_second_publisher_on_a_command_topic_is_an_error(self, bench) -> None:
        intruder = bench.node.create_publisher(
            messages.TOPIC_TYPES[messages.WHEEL_TORQUE_COMMAND],
            messages.WHEEL_TORQUE_COMMAND,
            qos.profile(lockstep=False),
        )
        bench.drive(
            lambda: bench.status("command topics") and bench.status("command topics").level == DiagnosticStatus.ERROR,
            "the error",
        )
        full = bench.node.get_fully_qualified_name()
        both = f"{full}, {bench.node.get_namespace().rstrip('/')}/power_manager"
        assert f"wheel_torque_command has 2 publishers: {both}" in bench.status("command topics").message
        bench.node.destroy_publisher(intruder)
        bench.drive(lambda: bench.status("command topics").level == DiagnosticStatus.OK, "quiet again")

    def test_a_second_publisher_of_an_input_is_warned_of(self, bench) -> None:
        kind = messages.TOPIC_TYPES[messages.POWER_DEMAND]
        intruder = bench.node.create_publisher(kind, messages.POWER_DEMAND, qos.profile(lockstep=False))
        found = bench.drive(lambda: bench.status("input topics"), "the warning")
        full = bench.node.get_fully_qualified_name()
        said = f"power_demand has 2 publishers: {full}, {full}"
        assert (found.level, said in found.message) == (DiagnosticStatus.WARN, True)
        bench.node.destroy_publisher(intruder)

    def test_a_publisher_with_weaker_quality_of_service_is_named(self, start_pair) -> None:
        pair = start_pair({"qos_overrides.{namespace}/power_demand.subscription.reliability": "reliable"})
        bench = pair.bench
        strong = bench.publishers.pop(messages.POWER_DEMAND)
        bench.node.destroy_publisher(strong)
        weak = bench.node.create_publisher(
            Float64, messages.POWER_DEMAND, qos.profile(lockstep=False, reliability="best_effort")
        )
        bench.spin_until(
            lambda: bench.status("input topics") and "power_demand" in bench.status("input topics").message, "the error"
        )
        bench.node.destroy_publisher(weak)


def test_a_motor_that_reports_no_torque_is_found_and_left_out(start_own) -> None:
    bench = start_own().bench
    dead: set[int] = set()

    def commanded() -> tuple[float, ...]:
        return tuple(bench.torques[-1].effort) if bench.torques else (0.0,) * 4

    bench.reported = lambda: tuple(0.0 if i in dead else torque for i, torque in enumerate(commanded()))
    bench.connect()
    bench.drive(
        lambda: min(commanded()) > 30.0 and bench.mode() == 1 and bench.status("motors").level == DiagnosticStatus.OK,
        "torque that all motors report",
    )
    dead.add(2)
    bench.drive(lambda: commanded()[2] == 0.0, "the end of the dead motor's command")
    bench.drive(lambda: bench.status("motors").level != DiagnosticStatus.OK, "the reason")
    assert "rear_left" in bench.status("motors").message
    values = {entry.key: entry.value for entry in bench.status("motors").values}
    assert values["torques act later than told (ms)"] == "0"


def test_wheel_speeds_in_another_unit_are_named(start_own) -> None:
    pair = start_own()
    bench = pair.bench
    bench.connect()
    bench.drive(lambda: bench.mode() == 1 and bench.status("sensors").level == DiagnosticStatus.OK, "believed sensors")
    rpm_as_radps = (10.0 / 0.33 * 9.55,) * 4
    bench.drive(lambda: bench.status("sensors").level != DiagnosticStatus.OK, "the reason", wheels=rpm_as_radps)
    assert "not believed: " in bench.status("sensors").message
    said = "not believed: speed is 0.105 times what wheel_speed and a radius of 0.33 m give: wheel_speed in rpm?"
    log = pair.running.text
    bench.drive(lambda: said in log(), "the same in the log", wheels=rpm_as_radps)
    bench.drive(lambda: any("over: " in line and said in line for line in log().splitlines()), "that it is over")


def test_a_bench_that_was_started_over_is_no_wrong_unit(start_own) -> None:
    bench = start_own().bench
    bench.connect()
    bench.drive(lambda: bench.mode() == 1, "normal operation", demand=0.0)

    def sensors() -> str:
        return bench.status("sensors").message if bench.status("sensors") else ""

    bench.drive(lambda: "started over? then deactivate" in sensors(), "the reason", speed=0.0, demand=0.0)
    for transition in ("deactivate", "activate"):
        assert bench.change_state(transition)
    bench.diagnostics.clear()
    bench.drive(lambda: bench.mode() == 1 and sensors() == "ok", "belief", speed=0.0, demand=0.0)


def test_a_bench_that_was_away_and_stands_is_believed_without_a_new_activation(start_own) -> None:
    # A node that was held up itself starts over anyhow, and an input that comes late begins the second of rest anew.
    pair = start_own({"missed_periods": 20, "own_gap_s": 10.0})
    bench = pair.bench
    bench.connect()
    bench.drive(lambda: bench.mode() == 1 and bench.last("doubted") == 0, "normal operation", demand=0.0)
    # By the node's own steps: it may hear of the last input later than the bench has sent it.
    bench.spin_until(lambda: sum(state["stale"] == 15 for state in bench.states[-200:]) > 80, "its absence")
    bench.drive(lambda: bench.last("doubted") == 31, "doubt", speed=0.0, demand=0.0)
    bench.drive(lambda: bench.last("doubted") == 0 and bench.mode() == 1, "belief", speed=0.0, demand=0.0)
    assert "the car was started over: it starts over, as after activation" in pair.running.text()
    bench.drive(lambda: bench.last("front_left_motor_torque_nm") > 30.0, "torque", speed=0.0, demand=500.0)


def test_inputs_that_come_too_slowly_are_named_with_their_rate(start_own) -> None:
    """Their periods were not said: the node that never starts to drive says why, again and again."""
    pair = start_own()
    bench = pair.bench
    bench.connect()
    comes = r"comes at [\d.]+ Hz, not at 100: input_period_s.vehicle_speed is 0.01"
    for found in (rf"waits for .*/vehicle_speed \({comes}\)", rf"WARN.*/vehicle_speed: {comes}"):
        bench.drive(lambda found=found: re.search(found, pair.running.text()), found, period_s=0.08)
    said = bench.drive(lambda: bench.status("input topics"), "the rate in the diagnostics", period_s=0.08).message
    assert re.search(f"/vehicle_speed: {comes}", said)


def test_power_that_a_limit_leaves_nothing_of_is_named_with_the_limit(start_own) -> None:
    """A charge of 0.8 in a unit of % is 0.008: a normal drive otherwise, in which the car never moves."""
    pair = start_own({"missed_periods": 10, "own_gap_s": 1.0})
    bench = pair.bench
    bench.connect()
    said = "asked for 20 kW, gets as good as none: battery_discharge (charge 0.8 %, 25 degC: right unit?)"
    empty = {"soc": 0.008, "demand": 20e3, "speed": 0.0}
    bench.drive(lambda: "WARN" in said_with(pair, said), "the reason in the log", **empty)
    assert bench.drive(lambda: bench.status("control").message == said, "and in the diagnostics", **empty)
    bench.drive(lambda: "over: " in said_with(pair, said), "that it is over", demand=0.0, soc=0.008, speed=0.0)


@pytest.mark.parametrize(("gains_mps2", "told"), [(-2.0, True), (2.0, False)])
def test_a_car_that_goes_faster_and_faster_against_its_motors_is_told(start_own, gains_mps2: float, told: bool) -> None:
    """Motors that turn the other way, or speed and wheels both of the wrong sign: what is asked for runs away."""
    pair = start_own({"missed_periods": 10, "own_gap_s": 1.0})
    bench = pair.bench
    bench.connect()
    bench.drive(lambda: bench.mode() == 1, "normal operation", speed=0.0, demand=0.0)
    said = "N m of its motors: right sign of the motor_torque command, of speed and wheel_speed?"
    step, period_s = 0, 0.01
    while step < 1000 and not said_with(pair, said):
        step += 1
        due_s = time.monotonic() + period_s
        bench.send(speed=gains_mps2 * step * period_s, demand=3000.0)
        while (left_s := due_s - time.monotonic()) > 0.0:
            bench.executor.spin_once(timeout_sec=left_s)
    assert bool(said_with(pair, said)) is told

    def diagnosed() -> bool:
        return any(said in status.message for array in bench.diagnostics for status in array.status)

    if told:  # the message that goes with the log may still be on its way
        bench.spin_until(diagnosed, "the same in the diagnostics")
    assert diagnosed() is told


def test_a_car_that_its_own_brakes_hold_against_its_motors_is_told(start_own) -> None:
    """Motors that turn the other way push it back, its hold brakes stop it: it would stand so for ever."""
    pair = start_own({"missed_periods": 10, "own_gap_s": 1.0})
    bench = pair.bench
    bench.connect()
    bench.drive(lambda: bench.mode() == 1, "normal operation", speed=0.0, demand=0.0)
    bench.drive(lambda: min(bench.frictions[-1].effort) < -100.0, "the hold", speed=-0.1, demand=3000.0)
    said = ": right sign of the motor_torque command? A brake that is on"
    bench.drive(lambda: "WARN" in said_with(pair, said), "the reason", speed=-0.1, demand=3000.0)
    assert "does not move off, -0.1 m/s at " in said_with(pair, said)
    assert "N m of its motors, its own brakes hold it: " in said_with(pair, said)
    bench.drive(lambda: said in bench.status("control").message, "and in the diagnostics", speed=-0.1, demand=3000.0)
    bench.drive(lambda: "over: " in said_with(pair, said), "that it is over", speed=2.0, demand=3000.0)


def said_with(pair, text: str) -> str:
    """Lines of the node's log with that text."""
    return "\n".join(line for line in pair.running.text().splitlines() if text in line)


def test_what_an_imu_shows_reaches_the_law_each_number_its_own() -> None:
    monitor = InputMonitor(messages.WHEEL_NAMES, input_limits(Thresholds(), 0.33, by_clock=True))
    for signal, value in (("yaw_rate", 0.5), ("longitudinal_acceleration", -2.0), ("lateral_acceleration", 7.0)):
        judge(monitor, MotionReading(0, signal, value), 0)
    assert (
        monitor.motion("yaw_rate", 0),
        monitor.motion("longitudinal_acceleration", 0),
        monitor.motion("lateral_acceleration", 0),
    ) == (0.5, -2.0, 7.0)
    assert math.isnan(monitor.motion("yaw_rate", 200_000_000)), "silent for long"
    assert math.isnan(monitor.motion("lateral_acceleration", 200_000_000)), "silent for long"


def test_a_rate_is_told_whatever_pause_was_in_between() -> None:
    fifty = [int(20e6 * i + (5e9 if i > 7 else 0)) for i in range(10)]
    assert rate_hz(fifty) == pytest.approx(50.0)
    assert rate_hz(fifty[:4]) == math.inf
    assert rate_hz([1] * 9) == math.inf
    often = [int(20e6 * i + 5e8 * (i // 4)) for i in range(32)]  # the node was busy again and again
    assert rate_hz(often) == pytest.approx(50.0)


def test_a_wheel_that_never_comes_is_named_while_the_others_drive(start_own) -> None:
    pair = start_own()
    pair.bench.connect()
    three = (10.0 / 0.33, 10.0 / 0.33, NAN, 10.0 / 0.33)
    pair.bench.drive(lambda: pair.bench.mode() == 1, "normal operation", wheels=three)
    named = "wheel rear_left is not believed (absent)"
    pair.bench.drive(lambda: named in pair.running.text(), "its name in the log", wheels=three)
    assert "wheel rear_right" not in pair.running.text()


def test_wheels_of_other_names_are_told_with_the_names_that_came(start_own) -> None:
    pair = start_own()
    pair.bench.connect()
    said = r"waits for .*axle lost: front_left absent, .*; the message names 'fl', 'fr', 'rl', 'rr'\)"
    log = pair.running.text
    pair.bench.drive(lambda: re.search(said, log()), "the names", names=("fl", "fr", "rl", "rr"))
    pair.bench.drive(lambda: "length: 3 values for 4 wheels" in log(), "the shape", wheels=(1.0, 1.0, 1.0))


def test_a_charge_in_percent_is_told_with_its_number_and_what_is_allowed(start_own) -> None:
    pair = start_own()
    pair.bench.connect()
    said = "messages refused, out of range: 80; allowed: 0 to 1)"
    pair.bench.drive(lambda: "battery_state" in said_with(pair, said), "the number", soc=80.0)


class TestParameters:
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("friction", 0.0),
            ("friction", NAN),
            ("friction", "slippery"),
            ("strategy", "clever"),
            ("gate_mode", ""),
            ("critical_slip", 0.1),  # below slip_target
            ("slip_target", 0.3),
            ("rate_hz", 50.0),  # not while configured
            ("wheel_names", ["a", "b", "c", "d"]),
            ("lockstep", True),
            ("policy_file", "other"),
            ("rule", [1.0, 2.0]),
            ("strategy", "sdp"),  # there is no policy
        ],
    )
    def test_a_bad_value_is_refused_with_a_reason_and_changes_nothing(self, bench, name, value) -> None:
        before = bench.get_parameter(name)
        assert bench.set_parameter(name, value) != ""
        assert bench.get_parameter(name) == before

    def test_a_change_while_driving_takes_effect_without_a_jump(self, bench) -> None:
        bench.drive(lambda: bench.last("front_left_motor_torque_nm") > 40.0, "torque")
        start = len(bench.states)
        assert bench.set_parameter("strategy", "rule") == ""
        assert bench.set_parameter("friction_source", "parameter") == ""
        assert bench.set_parameter("friction", 0.4) == ""
        bench.drive(lambda: bench.last("setting.strategy") == 1 and bench.last("friction") == 0.4, "the change")
        bench.drive(lambda: bench.last("front_share") == pytest.approx(0.9), "another split")
        assert bench.set_parameter("strategy", "equal") == ""
        bench.drive(lambda: bench.last("front_share") == 0.5, "the old split")
        states, stamps = bench.states[start:], bench.state_stamps[start:]
        fastest = bench.last("setting.share_rate_per_s")
        # A slow reader of a queue of one misses states: what counts is the time between those that came.
        for (before, after), (then, now) in zip(itertools.pairwise(states), itertools.pairwise(stamps), strict=True):
            steps = after["step"] - before["step"]
            longest_s = (now - then) / 1e9 + steps * 0.2 * 0.01  # a step counts for a fifth of the period at least
            assert abs(after["front_share"] - before["front_share"]) <= fastest * longest_s + 1e-9

    def test_every_parameter_is_described(self, bench) -> None:
        friction = bench.describe("friction")
        assert friction.floating_point_range[0].from_value == 0.05
        assert friction.floating_point_range[0].to_value == 1.5
        assert "friction" in friction.description
        assert bench.describe("rate_hz").description.startswith("Control rate, Hz")
        assert bench.describe("lockstep").read_only


def test_friction_may_come_from_its_topic_and_falls_back_when_that_is_stale(bench) -> None:
    assert bench.set_parameter("friction", 0.9) == ""
    assert bench.set_parameter("friction_source", "topic") == ""
    assert bench.set_parameter("friction_timeout_s", 0.5) == ""
    sent = [0]

    def send_friction(value: float) -> None:
        sent[0] += 1
        if sent[0] % 10 == 0:
            bench.publish(messages.ROAD_FRICTION, messages.number_message(value))

    bench.drive(lambda: send_friction(0.31) or bench.last("friction") == 0.31, "the topic's friction")
    bench.drive(lambda: send_friction(NAN) or bench.last("friction") == 0.9, "the parameter's friction")
    assert bench.set_parameter("friction_source", "parameter") == ""


def test_the_friction_it_has_estimated_is_published_ten_times_a_second(bench) -> None:
    heard: dict[int, dict[str, float]] = {}
    kind, topic = messages.TOPIC_TYPES[messages.NODE_FRICTION], messages.NODE_FRICTION.replace("~", "power_manager")
    bench.node.create_subscription(kind, topic, lambda it: heard.update([messages.read_named_numbers(it)]), 10)
    bench.states.clear()
    bench.state_stamps.clear()
    bench.drive(lambda: len(heard) >= 5 and max(heard) <= bench.state_stamps[-1], "estimates of the friction")
    names = ["left_friction", "right_friction", "left_friction_confidence", "right_friction_confidence"]
    said = dict(zip(bench.state_stamps, bench.states, strict=True))
    assert heard == {stamp: {name: said[stamp][name] for name in names} for stamp in heard}
    assert len(bench.states) > 9 * (len(heard) - 1)


def test_what_came_before_activation_is_forgotten(bench) -> None:
    assert bench.set_parameter("friction", 0.9) == ""
    assert bench.set_parameter("friction_source", "topic") == ""
    assert bench.change_state("deactivate")
    bench.publish(messages.ROAD_FRICTION, messages.number_message(0.31))
    assert bench.publishers[messages.ROAD_FRICTION].wait_for_all_acked()
    bench.states.clear()
    assert bench.change_state("activate")
    bench.drive(lambda: len(bench.states) > 5, "steps")
    # Any change of a parameter makes the node choose its friction anew.
    assert bench.set_parameter("friction_timeout_s", 600.0) == ""
    bench.states.clear()
    bench.drive(lambda: len(bench.states) > 5, "more steps")
    assert {state["friction"] for state in bench.states} == {0.9}
    assert bench.set_parameter("friction_source", "parameter") == ""
    assert bench.set_parameter("friction_timeout_s", 2.0) == ""
