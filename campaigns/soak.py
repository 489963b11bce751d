# SPDX-License-Identifier: Apache-2.0
"""`python -m campaigns.soak`: half an hour in real time at 100 Hz; memory, deadlines and counts.

Simulator, power manager and recorder run as in a car. Meanwhile this process samples the memory of each, and a witness
notes when the machine stood still or let the power manager wait: a late step that would have been in time without that
was the machine's. At the end the bag has to hold exactly what each topic's publisher says it published.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from campaigns.witness import Witness
from iwm_power_manager import files
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.errors import IwmError
from iwm_power_manager.ros import messages as m
from iwm_sim.dds_drive import environment, node_command
from iwm_sim.domains import claimed_domain
from iwm_sim.drive import load_run
from iwm_sim.processes import Child, ChildError, Children

_RATE_HZ = 100.0
_PERIOD_S = 1.0 / _RATE_HZ
_SAMPLE_S = 5.0
#: How Fast DDS begins the names of memory that processes share.
_SHARED = "/fastrtps_"
#: Memory is compared from here on: until then caches fill.
_SETTLED = 0.2
#: A step is late when it comes this many periods after the previous one.
_LATE_PERIODS = 1.5
#: So many times longer than usual is worth saying.
_SLOW = 5.0
_SIMULATED = (m.VEHICLE_SPEED, m.WHEEL_STATES, m.BATTERY_STATE, m.POWER_DEMAND, m.ACCELERATOR_PEDAL, m.BRAKE_PEDAL)


class Recorded(NamedTuple):
    """What the bag holds.

    Attributes
    ----------
    counts : messages by topic
    step_ns : stamps of the power manager's steps
    skipped : steps whose state is not in the bag
    uncommanded : steps without one of the two commands, from the first input on
    degraded : steps in another mode than normal, after the first normal one and while there were inputs
    """

    counts: dict[str, int]
    step_ns: list[int]
    skipped: int
    uncommanded: int
    degraded: int


def read_bag(path: Path) -> Recorded:
    """Count, and follow the power manager's steps."""
    counts: Counter[str] = Counter()
    commands: dict[str, set[int]] = {m.WHEEL_TORQUE_COMMAND: set(), m.FRICTION_BRAKE_COMMAND: set()}
    step_ns: list[int] = []
    skipped, previous, normal = 0, -1, False
    degraded_ns: list[int] = []
    first_input_ns, last_input_ns = 0, 0
    with BagReader(path) as bag:
        for message in bag.messages():
            topic = message.topic.lstrip("/")
            counts[topic] += 1
            if topic in _SIMULATED:
                last_input_ns = message.log_time_ns
                first_input_ns = first_input_ns or last_input_ns
            if topic not in commands and topic != m.POWER_MANAGER_STATE:
                continue
            content = deserialize_message(message.data, JointState)
            stamp_ns = m.stamp_to_ns(content.header.stamp)
            if topic in commands:
                commands[topic].add(stamp_ns)
                continue
            signals = m.read_named_numbers(content)[1]
            step = int(signals["step"])
            skipped += step - previous - 1 if previous >= 0 else 0
            previous = step
            normal = normal or signals["mode"] == 1
            if normal and signals["mode"] != 1:
                degraded_ns.append(message.log_time_ns)
            step_ns.append(stamp_ns)
    last = step_ns[-1] if step_ns else 0
    # The recorder meets one publisher after the other, and only then lets the simulator begin.
    expected = {stamp_ns for stamp_ns in step_ns if stamp_ns >= first_input_ns}
    uncommanded = sum(len(expected - {s for s in stamps if s <= last}) for stamps in commands.values())
    degraded = sum(time_ns <= last_input_ns for time_ns in degraded_ns)
    return Recorded(dict(counts), step_ns, skipped, uncommanded, degraded)


class Driven(NamedTuple):
    """What is left of a drive.

    Attributes
    ----------
    memory_kb : samples by process
    witness : of what the machine did
    recorded : what the bag holds
    published : messages by topic, as the simulator counted them
    ends : what was wrong with how power manager and recorder ended
    shared : the power manager had memory in common with other processes through DDS
    """

    memory_kb: dict[str, list[int]]
    witness: Witness
    recorded: Recorded
    published: Mapping[str, int]
    ends: list[str]
    shared: bool


class LateStep(NamedTuple):
    """A step that came too late: seconds since the first step, since the previous one, and what the machine took."""

    time_s: float
    gap_s: float
    machine_s: float

    @property
    def own(self) -> bool:
        """It would have been late without the machine's part, too."""
        return self.gap_s - self.machine_s > _LATE_PERIODS * _PERIOD_S


def late_steps(step_ns: Sequence[int], machine_s: Callable[[float, float], float]) -> list[LateStep]:
    """Late steps; `machine_s` tells what the machine took between two wall-clock times, s."""
    return [
        LateStep(
            (after_ns - step_ns[0]) / 1e9, (after_ns - before_ns) / 1e9, machine_s(before_ns / 1e9, after_ns / 1e9)
        )
        for before_ns, after_ns in itertools.pairwise(step_ns)
        if after_ns - before_ns > _LATE_PERIODS * _PERIOD_S * 1e9
    ]


def resident_kb(child: Child) -> int:
    """Resident memory of a process, kB; 0 once it has ended."""
    try:
        lines = Path(f"/proc/{child.process.pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmRSS:")), 0)


def shares_memory(pid: int) -> bool:
    """Whether Fast DDS shares memory between a process and others; False once it has ended."""
    try:
        return _SHARED in Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return False


def growth_percent(samples_kb: Sequence[int]) -> float:
    """Growth from the median of the first settled fifth to that of the last, %."""
    settled = samples_kb[int(len(samples_kb) * _SETTLED) :]
    fifth = max(len(settled) // 5, 1)
    first, last = np.median(settled[:fifth]), np.median(settled[-fifth:])
    return float(100.0 * (last / first - 1.0))


def slow_memory(witness: Witness, step: LateStep, first_s: float) -> str:
    """What the witness's own work says of the time before a late step; "" if nothing."""
    end_s = first_s + step.time_s
    longest_s, usual_s = witness.slowest_work_s(end_s - step.gap_s, end_s)
    if longest_s <= _SLOW * usual_s:
        return ""
    return f"; the witness's own work took up to {1e6 * longest_s:.0f} us ({1e6 * usual_s:.0f} us usually)"


def cost_by_minute_s(step_ns: Sequence[int], witness: Witness) -> list[float]:
    """Processor time that a step took on average, minute by minute: the same work, so what varies is the machine."""
    if len(step_ns) < 2 or len(witness.looks) < 2:
        return []
    looks = np.array([(look.time_s, look.used_s) for look in witness.looks])
    steps_s = np.array(step_ns) / 1e9
    edges_s = np.arange(max(steps_s[0], looks[0, 0]), min(steps_s[-1], looks[-1, 0]), 60.0)
    used_s = np.diff(np.interp(edges_s, looks[:, 0], looks[:, 1]))
    steps = np.histogram(steps_s, edges_s)[0] if edges_s.size > 1 else np.empty(0)
    return [float(used / count) for used, count in zip(used_s, steps, strict=True) if count]


@contextmanager
def kept_off(processor: int | None) -> Iterator[None]:
    """The calling thread, and the processes it starts, leave a processor to others, unless it is the only one."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, allowed - {processor} or allowed)
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def drive(minutes: float, priority: int, processor: int | None, folder: Path) -> Driven:
    """Drive for some minutes.

    With a real-time priority the power manager's memory is locked, too. On the processor it is given, if any, nothing
    else of the soak runs but the witness, which then watches that one only. The nodes share no memory, so that none
    waits for a lock that another one holds.
    """
    cycle = folder / "soak.csv"
    # Up and down between 5 and 15 m/s: drive and brake all the time.
    turns = int(minutes * 2) + 2
    rows = [f"{30.0 * i:.1f},{5.0 if i % 2 else 15.0}" for i in range(1, 2 * turns)]
    files.atomic_write(cycle, ("time_s,speed_mps\n0.0,0.0\n" + "\n".join(rows) + "\n").encode())
    memory: dict[str, list[int]] = {}
    ends = []
    shared = False
    with (
        kept_off(processor),
        claimed_domain() as domain,
        Children(environment(folder, domain), folder) as children,
    ):
        bag, result = folder / "bag", folder / "drive.npz"
        recorder = children.start("recorder", node_command("recorder", {"output": str(bag)}))
        manager = children.start(
            "power manager",
            node_command(
                "power_manager",
                {
                    "strategy": "equal",
                    "policy_file": "",
                    "input_period_s.battery_state": _PERIOD_S,
                    "realtime_priority": priority,
                    "lock_memory": priority > 0,
                    "cpu_affinity": "" if processor is None else str(processor),
                },
            ),
        )
        simulator = children.start(
            "simulator",
            node_command(
                "simulator",
                {
                    "cycle_file": str(cycle),
                    "until_s": 60.0 * minutes,
                    "rate_hz": _RATE_HZ,
                    "wait_for_recorder": True,
                    "partner_timeout_s": 300.0,
                    "result_file": str(result),
                },
            ),
        )
        watched = {"recorder": recorder, "power manager": manager, "simulator": simulator}
        with Witness(manager.process.pid, None if processor is None else {processor}) as witness:
            while simulator.running:
                for name, child in watched.items():
                    if resident := resident_kb(child):
                        memory.setdefault(name, []).append(resident)
                shared |= shares_memory(manager.process.pid)
                for child in (recorder, manager):
                    child.check_running()
                time.sleep(_SAMPLE_S)
            simulator.check()
            for child in (manager, recorder):
                try:
                    child.interrupt(60.0)
                except ChildError as error:  # half an hour is not thrown away for that
                    ends.append(str(error))
    notes = load_run(result)[1]
    return Driven(memory, witness, read_bag(bag), notes["published"], ends, shared)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the soak; exit code 1 if anything grew, was lost, or was late by itself."""
    parser = CommandParser("soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="how long (30)")
    parser.add_argument(
        "--priority",
        type=int,
        default=50,
        help="real-time priority (SCHED_FIFO) of the power manager, whose memory is locked then; 0: neither (50)",
    )
    processors = sorted(os.sched_getaffinity(0))
    parser.add_argument(
        "--processor",
        type=int,
        choices=[*processors, -1],
        default=processors[-1],
        help=f"processor the power manager has for itself; -1: none ({processors[-1]})",
    )
    parser.add_argument("--growth", type=float, default=5.0, help="growth of memory that passes, %% (5)")
    parser.add_argument("--json", type=Path, help="write the numbers there too")
    chosen = parser.parse_args(arguments)
    processor = None if chosen.processor < 0 else chosen.processor
    try:
        with tempfile.TemporaryDirectory(prefix="iwm-soak-") as folder:
            driven = drive(chosen.minutes, chosen.priority, processor, Path(folder))
    except IwmError as error:
        print(f"soak: {error}", file=sys.stderr)
        return 1
    memory, witness, recorded, published, ends, shared = driven
    problems = [*ends]
    if shared:
        problems.append("the power manager shared memory with other processes")
    growth = {name: growth_percent(samples) for name, samples in memory.items()}
    for name, percent in growth.items():
        print(f"memory of the {name:14} {memory[name][-1] / 1024:7.1f} MB, growth {percent:+.1f} %")
        if percent > chosen.growth:
            problems.append(f"the {name} grew by {percent:.1f} %")
    late = late_steps(recorded.step_ns, witness.machine_s)
    own = [step for step in late if step.own]
    steps = len(recorded.step_ns)
    print(f"{steps} steps; {len(late)} late, {len(own)} of them without the machine")
    for step in own:
        print(
            f"  at {step.time_s:.2f} s, {1000 * step.gap_s:.1f} ms after the previous one; "
            f"the machine took {1000 * step.machine_s:.1f} ms" + slow_memory(witness, step, recorded.step_ns[0] / 1e9)
        )
    print(witness.summary())
    if costs_s := cost_by_minute_s(recorded.step_ns, witness):
        least, most = 1000 * min(costs_s), 1000 * max(costs_s)
        print(f"a step took {least:.2f} to {most:.2f} ms of processor time, averaged over a minute")
    print(f"{recorded.degraded} steps in another mode than normal while there were inputs")
    if own:
        problems.append(f"{len(own)} late steps that the machine does not explain")
    for topic in _SIMULATED:
        count = recorded.counts.get(topic, 0)
        print(f"{topic:22} published {published.get(topic, 0):7}, recorded {count:7}")
        if count != published.get(topic, 0):
            problems.append(f"{topic}: {published.get(topic, 0)} published, {count} recorded")
    for topic in (m.WHEEL_TORQUE_COMMAND, m.FRICTION_BRAKE_COMMAND, m.POWER_MANAGER_STATE):
        print(f"{topic:22} recorded {recorded.counts.get(topic, 0):7}")
    if recorded.skipped or recorded.uncommanded:
        problems.append(
            f"{recorded.skipped} steps without a state, {recorded.uncommanded} without a command in the bag"
        )
    print("; ".join(problems) or "nothing grew, nothing was lost, nothing was late by itself")
    if chosen.json:
        numbers = {
            "growth_percent": growth,
            "steps": steps,
            "late": len(late),
            "late_by_itself": len(own),
            "problems": problems,
        }
        files.atomic_write(chosen.json, json.dumps(numbers, indent=1).encode())
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
