# SPDX-License-Identifier: Apache-2.0
"""The fault campaign's own parts: each fault does to a message what its name says, and a row tells the truth."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from rclpy.serialization import serialize_message

from bags_helpers import TWIST, topic, twist
from campaigns import fault_relay as relay
from campaigns import faults, soak
from campaigns.witness import Look, Witness
from iwm_power_manager.bags.writer import BagWriter
from iwm_power_manager.ros import messages as m
from iwm_sim.dds_drive import node_command
from oracles import readings

WHEELS = m.wheel_states_message(5, m.WHEEL_NAMES, (1.0, 2.0, 3.0, 4.0), (5.0, 6.0, 7.0, 8.0))


def speed(stamp_ns: int, value: float):
    return m.vehicle_speed_message(stamp_ns, value)


class TestTransforms:
    def test_stopped_and_passed_on(self) -> None:
        message = speed(1, 2.0)
        assert list(relay.stop(message, 0.0)) == []
        assert list(relay.pass_on(message, 0.0)) == [message]

    def test_delayed_messages_come_later_and_in_order(self) -> None:
        delay = relay.delay(1.0)
        assert list(delay("a", 0.0)) == []
        assert list(delay("b", 0.5)) == []
        assert list(delay("c", 1.5)) == ["a", "b"]
        assert list(delay("d", 2.5)) == ["c"]

    def test_frozen_messages_keep_their_value_and_perhaps_their_stamp(self) -> None:
        whole, restamped = relay.freeze(restamp=False), relay.freeze(restamp=True)
        for freeze, stamp in ((whole, 1), (restamped, 2)):
            list(freeze(speed(1, 7.0), 0.0))
            (frozen,) = freeze(speed(2, 8.0), 0.1)
            assert readings.vehicle_speed(frozen) == (stamp, 7.0)

    def test_a_tenfold_rate_sends_ten_with_rising_stamps(self) -> None:
        sent = list(relay.repeat(10)(speed(100, 7.0), 0.0))
        stamps = [readings.vehicle_speed(message).stamp_ns for message in sent]
        assert len(set(stamps)) == 10
        assert stamps == sorted(stamps)
        assert [message.data for message in relay.repeat(3)(m.number_message(1.0), 0.0)] == [1.0] * 3

    def test_a_tenth_of_the_rate_sends_every_tenth(self) -> None:
        thin = relay.thin(10)
        assert sum(len(list(thin("x", 0.0))) for _ in range(100)) == 10

    def test_losing_loses_about_its_share_and_always_the_same(self) -> None:
        counts = [
            sum(len(list(lose("x", 0.0))) for _ in range(1000)) for lose in (relay.lose(0.3, 1), relay.lose(0.3, 1))
        ]
        assert counts[0] == counts[1]
        assert 600 < counts[0] < 800

    def test_stamps_shift(self) -> None:
        (shifted,) = relay.restamp(-1.0)(speed(3 * 10**9, 7.0), 0.0)
        assert readings.vehicle_speed(shifted).stamp_ns == 2 * 10**9
        (clock,) = relay.restamp(5.0)(m.clock_message(10**9), 0.0)
        assert m.stamp_to_ns(clock.clock) == 6 * 10**9

    @pytest.mark.parametrize("value", [math.inf, 1e7])
    def test_values_are_replaced_in_every_kind_of_message(self, value) -> None:
        battery = m.battery_state_message(0, soc=0.5, voltage_v=1.0, discharge_current_a=0.0)
        for message, read in (
            (speed(0, 1.0), lambda x: x.twist.linear.x),
            (m.wheel_states_message(0, m.WHEEL_NAMES, (0.0,) * 4, (0.0,) * 4), lambda x: x.velocity[3]),
            (battery, lambda x: x.percentage),
            (m.number_message(0.0), lambda x: x.data),
        ):
            (replaced,) = relay.replace(value)(message, 0.0)
            assert read(replaced) == value

    def test_wheels_are_shuffled_with_their_values_or_left_out(self) -> None:
        (shuffled,) = relay.wheels((2, 0, 3, 1))(WHEELS, 0.0)
        assert m.select_by_name(readings.wheel_speeds(shuffled), m.WHEEL_NAMES) == (1.0, 2.0, 3.0, 4.0)
        assert shuffled.name[0] == "rear_left"
        (three,) = relay.wheels((0, 1, 2))(WHEELS, 0.0)
        assert list(three.velocity) == [1.0, 2.0, 3.0]
        assert list(three.effort) == [5.0, 6.0, 7.0]


class TestCampaign:
    def test_every_fault_has_a_name_of_its_own_and_a_known_expectation(self) -> None:
        cases = [*faults.input_cases(), *faults.system_cases(), *faults.clock_cases()]
        assert len({case.name for case in cases}) == len(cases)
        assert {case.expect for case in cases} <= {faults.ZERO, faults.RIDE, faults.LIMITS}
        assert all(case.remark for case in cases if case.expect == faults.LIMITS)

    def test_the_promised_time_is_the_sum_of_its_parts(self) -> None:
        assert faults.promised_s(3) == pytest.approx(0.3 + 0.3 + 0.02)

    def test_a_row_names_what_must_not_have_happened(self) -> None:
        row = faults.show(
            faults.Result("x", faults.ZERO, 0.31, 0.0, math.nan, 0.02, 9, "inputs: y", ["did not recover"])
        )
        assert "0.31" in row
        assert row.endswith("did not recover  [inputs: y]")

    def test_one_fault_from_beginning_to_end(self, tmp_path) -> None:
        results = tmp_path / "faults.json"
        # A busy machine may lose a period; that it is noticed at all is what counts here.
        assert faults.main(["--only", "power_demand NaN", "--missed-periods", "10", "--json", str(results)]) == 0
        (row,) = json.loads(results.read_text())
        assert row["problems"] == []
        assert row["largest_nm"] == 0.0
        assert row["said"]


class TestSoak:
    def test_growth_is_told_between_the_settled_ends(self) -> None:
        assert soak.growth_percent([50, 80, *([100] * 8), *([110] * 2)]) == pytest.approx(10.0)
        assert soak.growth_percent([100] * 20) == 0.0

    def test_a_late_step_is_the_machines_when_it_had_been_in_time_without(self) -> None:
        stamps = [ms * 1_000_000 for ms in range(5000, 7000, 10) if ms not in (5030, 6500)]
        asked = []

        def machine_s(begin_s: float, end_s: float) -> float:
            asked.append((begin_s, end_s))
            return 0.006 if begin_s < 6.0 else 0.004

        first, second = soak.late_steps(stamps, machine_s)
        assert asked == [(5.02, 5.04), (6.49, 6.51)]
        assert first == pytest.approx((0.04, 0.02, 0.006)) and not first.own
        assert second == pytest.approx((1.51, 0.02, 0.004)) and second.own

    def test_what_a_step_cost_minute_by_minute(self) -> None:
        step_ns = [i * 500_000_000 for i in range(361)]
        witness = Witness(0)
        witness.looks = [
            Look(time_s, 0.1 * min(time_s, 60.0) + 0.4 * max(time_s - 60.0, 0.0), 0, 1) for time_s in range(181)
        ]
        assert soak.cost_by_minute_s(step_ns, witness) == pytest.approx([0.05, 0.2], rel=0.02)
        assert soak.cost_by_minute_s(step_ns[:50], witness) == []
        assert soak.cost_by_minute_s([], witness) == []
        witness.looks = []
        assert soak.cost_by_minute_s(step_ns, witness) == []

    def test_a_command_counts_as_lost_from_the_first_input_on(self, tmp_path: Path) -> None:
        topics = (m.POWER_MANAGER_STATE, m.WHEEL_TORQUE_COMMAND, m.FRICTION_BRAKE_COMMAND)
        with BagWriter(tmp_path / "bag") as writer:
            numbers = {name: writer.add_topic(topic(f"/{name}", "sensor_msgs/msg/JointState")) for name in topics}
            speed = writer.add_topic(topic("/vehicle_speed", TWIST))
            for step in range(1, 7):
                stamp_ns = step * 10_000_000
                if step >= 3:
                    writer.write(speed, stamp_ns, twist(stamp_ns, 1.0), stamp_ns, step)
                torque = m.joint_message(stamp_ns, m.WHEEL_NAMES, effort=(0.0,) * 4)
                state = m.joint_message(stamp_ns, ("step", "mode"), position=(float(step), 1.0))
                for name in topics:
                    # The recorder met the publisher of this one last; and one was lost.
                    if name != m.WHEEL_TORQUE_COMMAND or step not in (1, 5):
                        content = serialize_message(state if name == m.POWER_MANAGER_STATE else torque)
                        writer.write(numbers[name], stamp_ns + 1000, content, stamp_ns + 1000, step)
        recorded = soak.read_bag(tmp_path / "bag")
        assert (recorded.skipped, recorded.uncommanded, recorded.degraded) == (0, 1, 0)
        assert len(recorded.step_ns) == 6
        assert recorded.counts == {m.POWER_MANAGER_STATE: 6, m.WHEEL_TORQUE_COMMAND: 4} | {
            m.FRICTION_BRAKE_COMMAND: 6,
            m.VEHICLE_SPEED: 4,
        }

    def test_a_processor_is_left_to_others_unless_it_is_the_only_one(self) -> None:
        allowed = os.sched_getaffinity(0)
        one = min(allowed)
        with soak.kept_off(one):
            assert os.sched_getaffinity(0) == (allowed - {one} or allowed)
        with soak.kept_off(None):
            assert os.sched_getaffinity(0) == allowed
        assert os.sched_getaffinity(0) == allowed

    def test_six_seconds_of_it(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        asked: dict[str, dict[str, Any]] = {}

        def noted(name: str, parameters: dict[str, Any]) -> list[str]:
            asked[name] = parameters
            return node_command(name, parameters)

        monkeypatch.setattr(soak, "node_command", noted)
        monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "")  # as users have it: the node shares no memory
        numbers = tmp_path / "soak.json"
        processor = min(os.sched_getaffinity(0))
        arguments = f"--minutes 0.1 --priority 7 --processor {processor} --growth 1e6 --json".split()
        code = soak.main([*arguments, str(numbers)])
        found = json.loads(numbers.read_text())
        # Six seconds of starting up say nothing about memory, and how busy the machine is while tests run is not for
        # them to say; that nothing was lost is.
        assert [problem for problem in found["problems"] if "late steps" not in problem] == []
        assert code == bool(found["problems"])
        assert found["late_by_itself"] <= found["late"] < found["steps"]
        assert found["steps"] >= 590
        assert found["growth_percent"].keys() == {"recorder", "power manager", "simulator"}
        manager = asked["power_manager"]
        assert manager["realtime_priority"] == 7 and manager["lock_memory"] is True
        assert manager["cpu_affinity"] == str(processor)
