# SPDX-License-Identifier: Apache-2.0
"""Lock-step and simulated time: every set answered once, the same bits as without ROS, and a clock that misbehaves."""

from __future__ import annotations

import math
import random
import time
from pathlib import Path

import pytest
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile

from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.thresholds import actuator_limits, input_limits, supervision_limits
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.ros import messages
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle
from oracles import readings

PERIOD_NS = 20_000_000


@pytest.fixture(scope="module")
def lockstep_bench(start_pair):
    bench = start_pair({"lockstep": True, "rate_hz": 50.0, "strategy": "instantaneous_slip"}).bench
    bench.connect()
    return bench


@pytest.fixture(scope="module")
def sim_bench(start_pair):
    bench = start_pair(sim_time=True).bench
    bench.connect()
    return bench


class TestLockstep:
    @pytest.fixture
    def bench(self, lockstep_bench):
        return lockstep_bench

    @pytest.fixture(autouse=True)
    def fresh(self, bench):
        assert bench.change_state("deactivate")
        assert bench.change_state("activate")
        bench.states.clear()
        bench.state_stamps.clear()
        bench.torques.clear()
        bench.frictions.clear()

    def ask(self, bench, stamp, **inputs):
        bench.send(stamp_ns=stamp, **inputs)
        return bench.answer_to(stamp)

    def test_each_set_is_answered_with_its_stamp_and_dt_is_their_difference(self, bench) -> None:
        for stamp in (100, 100 + PERIOD_NS, 100 + 3 * PERIOD_NS):
            self.ask(bench, stamp)
        bench.spin_until(lambda: len(bench.states) == 3, "three states")
        assert [state["dt_s"] for state in bench.states] == [0.02, 0.02, 0.04]
        assert [state["step"] for state in bench.states] == [0, 1, 2]
        assert bench.state_stamps == [100, 100 + PERIOD_NS, 100 + 3 * PERIOD_NS]

    def test_a_repeated_set_gets_the_same_answer_and_no_step(self, bench) -> None:
        first = self.ask(bench, 100, demand=9000.0)
        bench.torques.clear()
        bench.frictions.clear()
        again = self.ask(bench, 100, demand=9000.0)
        assert again[0].effort == first[0].effort
        self.ask(bench, 100 + PERIOD_NS)
        bench.spin_until(lambda: bench.states and bench.states[-1]["step"] == 1, "the second step")

    @pytest.mark.parametrize("missing", ["vehicle_speed", "wheel_states", "battery_state", "power_demand"])
    def test_an_incomplete_set_is_not_answered_and_does_not_shift_the_next(self, bench, missing) -> None:
        self.ask(bench, 100, demand=1000.0)
        bench.send(stamp_ns=100 + PERIOD_NS, demand=2000.0, without=(missing,))
        self.ask(bench, 100 + 2 * PERIOD_NS, demand=3000.0)
        bench.spin_until(lambda: len(bench.states) == 2, "the second step")
        assert bench.states[-1]["requested_power_w"] == 3000.0
        assert all(messages.stamp_to_ns(m.header.stamp) != 100 + PERIOD_NS for m in bench.torques)

    def test_a_stamp_that_goes_back_starts_a_new_run(self, bench) -> None:
        self.ask(bench, 10**10)
        self.ask(bench, 10**10 + PERIOD_NS)
        self.ask(bench, 50)
        bench.spin_until(lambda: len(bench.states) == 3, "three states")
        assert bench.states[-1]["step"] == 0.0
        assert bench.states[-1]["dt_s"] == 0.02

    def test_it_is_in_normal_operation_from_the_first_step(self, bench) -> None:
        self.ask(bench, 100)
        bench.spin_until(lambda: bench.states, "a state")
        assert bench.states[0]["mode"] == 1
        assert bench.states[0]["motor_factor"] == 1.0

    def test_it_computes_the_same_bits_as_the_controller_without_ros(self, bench) -> None:
        vehicle = load_vehicle(resolve(Path("config/vehicles/jalalmaab_2015.yaml"))).params
        values = {spec.name: spec.default for spec in config.SPECS} | {"lockstep": True}
        radius = vehicle.front.wheel.radius_m
        thresholds = config.thresholds_of(values)
        limits = ControllerLimits(
            input_limits(thresholds, radius, by_clock=False),
            None,
            supervision_limits(thresholds),
            actuator_limits(thresholds),
        )
        twin = Controller(
            vehicle, messages.WHEEL_NAMES, limits, config.law_settings(values, "instantaneous_slip"), empty_table(), 0.9
        )
        twin.table_of = lambda friction: empty_table()  # as the node without policies, whose friction is estimated
        source = random.Random(1)
        speed, expected = 10.0, []
        for i in range(150):
            stamp = (i + 1) * PERIOD_NS
            speed = max(speed + source.uniform(-0.2, 0.2), 0.0)
            wheels = tuple(speed / radius * source.uniform(0.9, 1.1) for _ in range(4))
            if i % 40 == 39:
                wheels = (math.nan, *wheels[1:])
            demand, soc = source.uniform(-2e4, 2e4), 0.5 - 1e-5 * i
            torque, _ = self.ask(bench, stamp, speed=speed, wheels=wheels, demand=demand, soc=soc)
            monitor = twin.monitor
            monitor.take_speed(SpeedReading(stamp, speed), stamp)
            monitor.take_wheels(JointReading(stamp, messages.WHEEL_NAMES, wheels), stamp)
            sent = messages.battery_state_message(stamp, soc=soc, voltage_v=1.0, discharge_current_a=0.0)
            monitor.take_battery(BatteryReading(stamp, readings.battery_state(single(sent)).soc, 25.0, 0.0, 0.0), stamp)
            monitor.take_demand(demand, 0.0, stamp)
            command, numbers = twin.step(stamp, 0.02)
            assert tuple(torque.effort) == command.motor_torque_nm
            expected.append(dict(zip(SIGNAL_NAMES, map(float, numbers), strict=True)))
        bench.spin_until(lambda: len(bench.states) == 150, "all states")
        assert bench.states == expected


def test_simulated_time_that_nobody_tells_is_named_and_no_input_is_blamed(start_own) -> None:
    pair = start_own(sim_time=True)
    bench = pair.bench
    bench.node.destroy_publisher(bench.publishers.pop(messages.CLOCK))
    clock = f"{bench.node.get_namespace()}/clock"
    said = f"the clock stands still (use_sim_time is true, {clock} has no publisher): zero torque"
    bench.spin_until(lambda: bench.send() and said in pair.running.text(), "the reason")
    until_s = time.monotonic() + 2.0
    bench.spin_until(lambda: bench.send() and time.monotonic() > until_s, "time for more words")
    assert "waits for" not in pair.running.text()


def single(message):
    """The message as it is after the journey: single precision where the type says so."""
    from rclpy.serialization import deserialize_message, serialize_message

    return deserialize_message(serialize_message(message), type(message))


class TestSimulatedTime:
    @pytest.fixture
    def bench(self, sim_bench):
        return sim_bench

    @pytest.fixture(autouse=True)
    def normal(self, bench):
        bench.drive(lambda: bench.mode() == 1 and bench.last("stale") == 0, "normal operation")
        bench.diagnostics.clear()

    def test_it_steps_and_stamps_by_the_simulated_clock(self, bench) -> None:
        start = len(bench.states)
        bench.drive(lambda: len(bench.states) >= start + 20, "steps")
        assert all(0 < stamp <= bench.now_ns for stamp in bench.state_stamps[start:])
        steps = [b - a for a, b in zip(bench.state_stamps[start:], bench.state_stamps[start + 1 :], strict=False)]
        assert all(step % 10_000_000 == 0 for step in steps)

    def test_diagnostics_come_once_a_simulated_second_and_carry_its_stamps(self, bench) -> None:
        start = bench.now_ns
        bench.drive(lambda: bench.now_ns > start + 4 * 10**9, "four seconds", period_s=0.01)
        stamps = [messages.stamp_to_ns(m.header.stamp) for m in bench.diagnostics]
        assert all(start <= stamp <= bench.now_ns for stamp in stamps)
        assert len(stamps) >= 3

    def test_a_clock_that_stands_still_commands_zero_torque(self, bench) -> None:
        said: list[str] = []
        late_too = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        bench.node.create_subscription(Log, "/rosout", lambda message: said.append(message.msg), late_too)
        bench.drive(lambda: bench.last("front_left_motor_torque_nm") > 30.0, "torque")
        bench.spin_until(lambda: list(bench.torques[-1].effort) == [0.0] * 4, "zero torque")
        bench.spin_until(lambda: bench.status("fault"), "the reason")
        bench.spin_until(lambda: "the clock stands still: zero torque" in said, "the reason in the log")
        assert "clock stands still" in bench.status("fault").message
        bench.drive(lambda: bench.mode() == 1, "recovery")
        bench.diagnostics.clear()
        bench.drive(lambda: bench.diagnostics and not bench.status("fault"), "a report without the fault")

    @pytest.mark.parametrize("jump_s", [-0.5, 3.0, 3600.0])
    def test_a_clock_that_jumps_never_leaves_torque_without_fresh_inputs(self, bench, jump_s) -> None:
        bench.drive(lambda: bench.last("front_left_motor_torque_nm") > 30.0, "torque")
        bench.now_ns += int(jump_s * 1e9)
        start = len(bench.states)
        every = ("vehicle_speed", "wheel_states", "power_demand", "battery_state")
        bench.drive(lambda: len(bench.states) > start and bench.last("stale") == 15, "degraded", without=every)
        bench.drive(lambda: bench.last("front_left_motor_torque_nm") == 0.0, "zero torque", without=every)
        bench.drive(lambda: bench.mode() == 1, "recovery")
        assert all(math.isfinite(s["front_left_motor_torque_nm"]) for s in bench.states[start:])

    @pytest.mark.parametrize("back_s", [0.05, 0.5, 5.0])
    def test_a_clock_set_back_holds_the_braking(self, bench, back_s) -> None:
        def braking() -> float:
            return sum(bench.torques[-1].effort) + sum(bench.frictions[-1].effort)

        asked = -8000.0 / 10.0 * 0.33
        bench.now_ns += int(back_s * 1e9)  # so that the clock never goes below zero
        sent = bench.now_ns
        bench.drive(
            lambda: bench.state_stamps[-1] > sent + 10**9 and bench.mode() == 1 and braking() < 0.95 * asked,
            "braking",
            demand=-8000.0,
        )
        bench.now_ns -= int(back_s * 1e9)
        start = len(bench.states)
        every = ("vehicle_speed", "wheel_states", "power_demand", "battery_state")
        found: list[float] = []

        def noting(steps: int) -> bool:
            found.append(braking())
            return len(bench.states) >= start + steps

        bench.drive(lambda: noting(5), "steps without an input of the new time", without=every, demand=-8000.0)
        bench.drive(lambda: noting(60), "steps", demand=-8000.0)
        assert max(found) < 0.85 * asked
        bench.drive(lambda: bench.mode() == 1, "recovery")
