# SPDX-License-Identifier: Apache-2.0
"""`python -m campaigns.faults`: break one thing after the other in a simulated drive, and see what happens.

Simulator and power manager run as processes of their own, in real time, over DDS. Between them stands a relay that can
spoil every input (`fault_relay`). For each fault the table says how long it took to zero torque, the largest torque
after the time docs/safety.md promises, how long recovery took after the fault was gone, and what was lost.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import rclpy

from campaigns import fault_relay as relay
from campaigns.fault_relay import FaultRelay
from iwm_power_manager import files
from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.control.supervision import MODE_NORMAL
from iwm_power_manager.errors import IwmError
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.ros import ending
from iwm_power_manager.ros import messages as m
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.domains import claimed_domain
from iwm_sim.processes import Child, Children

_NAMESPACE = "/car"
_NODE_START_S = 300.0
_FAULT_S = 2.5
_RECOVER_S = 20.0
#: Normal operation for this long, with torque, before a fault begins.
_SETTLE_S = 0.5
_DRIVING_NM = 10.0
#: Beyond the promised time: transport both ways, and the slice a busy machine may take.
_MARGIN_S = 0.15
#: A steady climb: torque is needed all the time.
_SPEED_MPS, _GRADE, _LENGTH_S = 12.0, 0.03, 4000.0

#: A load of ordinary priority, whatever the campaign itself runs at.
_BUSY = "import os\nos.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\nwhile True: pass"

#: What has to happen: torque to zero, no effect at all, or anything inside the limits (with a reason in the table).
ZERO, RIDE, LIMITS = "zero torque", "rides through", "within limits"


class Case(NamedTuple):
    """One fault.

    Attributes
    ----------
    name : in the table
    expect : ZERO, RIDE or LIMITS
    begin, end : what breaks it and what mends it
    remark : what to know about it
    allowed_s : promised time to zero torque; 0: the rule for the four inputs
    """

    name: str
    expect: str
    begin: Callable[[Session], None]
    end: Callable[[Session], None] = lambda session: session.relay.heal()
    remark: str = ""
    allowed_s: float = 0.0


class Result(NamedTuple):
    """What happened in one case.

    Attributes
    ----------
    to_zero_s : time to zero motor torque that lasted as long as the fault; NaN: there was torque all the time
    largest_nm : largest motor torque later than the promised time
    recovery_s : time from the end of the fault to normal operation; NaN: not within the patience
    longest_gap_s : longest time between two commands
    commands : commands seen
    problems : what must not have happened; empty: passed
    """

    name: str
    expect: str
    to_zero_s: float
    largest_nm: float
    recovery_s: float
    longest_gap_s: float
    commands: int
    said: str
    problems: list[str]


class Session:
    """Simulator, relay and power manager, and what a case may do to them."""

    def __init__(self, folder: Path, children: Children, node: FaultRelay, sim_time: bool, plan: Plan) -> None:
        self.folder = folder
        self.relay: FaultRelay = node
        self.policy = folder / "policies"
        self._children = children
        self._sim_time = sim_time
        self._plan = plan
        self._starts = 0
        self._extra: list[Any] = []
        self.simulator = self.start_simulator()
        self.power_manager = self.start_power_manager()

    def _start(self, module: str, parameters: dict[str, Any], remaps: dict[str, str]) -> Child:
        self._starts += 1
        command = [sys.executable, "-m", module, "--ros-args", "-r", f"__ns:={_NAMESPACE}"]
        for name, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else f"'{value}'" if value == "" else str(value)
            command += ["-p", f"{name}:={text}"]
        for source, target in remaps.items():
            command += ["-r", f"{source}:={target}"]
        return self._children.start(f"{module.rsplit('.', 1)[1]}_{self._starts}", command)

    def start_simulator(self) -> Child:
        """Start the car at the foot of the climb."""
        cycle = self.folder / "climb.csv"
        rows = [(0.0, 0.0), (8.0, _SPEED_MPS), (_LENGTH_S, _SPEED_MPS)]
        files.atomic_write(
            cycle,
            ("time_s,speed_mps,grade\n" + "".join(f"{t},{v},{_GRADE}\n" for t, v in rows)).encode(),
        )
        parameters = {
            "cycle_file": cycle,
            "speed_factor": 2.0 if self._sim_time else 1.0,
            "partner_timeout_s": _NODE_START_S,
        }
        remaps = {topic: f"{relay.RAW}/{topic}" for topic in relay.INPUTS}
        self.simulator = self._start("iwm_sim.simulator", parameters, remaps | {"/clock": f"{_NAMESPACE}/raw/clock"})
        return self.simulator

    def start_power_manager(self) -> Child:
        """Start the node under test."""
        parameters = {
            "strategy": self._plan.strategy,
            "policy_file": self.policy,
            "missed_periods": self._plan.missed_periods,
            "use_sim_time": self._sim_time,
        }
        remaps = {"/clock": f"{_NAMESPACE}/clock", "/diagnostics": f"{_NAMESPACE}/{relay.DIAGNOSTICS}"}
        self.power_manager = self._start("iwm_power_manager.nodes.power_manager", parameters, remaps)
        return self.power_manager

    def wait_for_torque(self, patience_s: float) -> bool:
        """Normal operation with torque, for a while."""
        since: float | None = None

        def settled() -> bool:
            nonlocal since
            driving = self.relay.commands and max(self.relay.commands[-1].motor_nm, default=0.0) > _DRIVING_NM
            if self.relay.mode != MODE_NORMAL or not driving:
                since = None
            elif since is None:
                since = time.monotonic()
            return since is not None and time.monotonic() - since > _SETTLE_S

        return self.relay.run(patience_s, settled)

    def spoil(self, topic: str, transform: relay.Transform) -> None:
        """Put a fault on an input."""
        self.relay.transforms[topic] = transform

    def intrude(self) -> None:
        """Publish motor torques beside the power manager."""
        publisher = self.relay.intruder()
        self._extra.append(publisher)
        publisher.publish(m.joint_message(0, m.WHEEL_NAMES, effort=(50.0,) * 4))

    def load_processors(self) -> None:
        """Two busy processes for each processor."""
        for _ in range(2 * (os.cpu_count() or 1)):
            self._extra.append(subprocess.Popen([sys.executable, "-c", _BUSY]))

    def relieve(self) -> None:
        """Undo `intrude` and `load_processors`."""
        for extra in self._extra:
            if isinstance(extra, subprocess.Popen):
                extra.kill()
                extra.wait()
            else:
                self.relay.dismiss(extra)
        self._extra.clear()

    def swap_policy(self) -> None:
        """Overwrite every policy file with something that is none."""
        for file in self.policy.glob("*.npz"):
            file.write_bytes(b"this is no policy")

    def restore_policy(self) -> None:
        """Bring the shipped policies back."""
        copy_policies(self.policy)


class Plan(NamedTuple):
    """What is asked for on the command line."""

    strategy: str
    missed_periods: int
    pattern: str


def on(topic: str, make: Callable[[], relay.Transform]) -> Callable[[Session], None]:
    """What puts a new fault on a topic."""
    return lambda session: session.spoil(topic, make())


def input_cases() -> Iterator[Case]:
    """Every input, broken in every way."""
    for topic in relay.INPUTS:
        stamped = topic != m.POWER_DEMAND
        slow = topic == m.BATTERY_STATE
        yield Case(f"{topic} stopped", ZERO, on(topic, lambda: relay.stop))
        if stamped:
            yield Case(f"{topic} delayed 1 s", ZERO, on(topic, lambda: relay.delay(1.0)))
            yield Case(f"{topic} frozen, stamp and all", ZERO, on(topic, lambda: relay.freeze(restamp=False)))
            if not slow:
                remark = "with fresh stamps only a change of the others tells"
                yield Case(
                    f"{topic} frozen, stamp runs on",
                    LIMITS,
                    on(topic, lambda: relay.freeze(restamp=True)),
                    remark=remark,
                )
        else:
            remark = "Float64 has no stamp: not to be told from the driver"
            yield Case(f"{topic} delayed 1 s", LIMITS, on(topic, lambda: relay.delay(1.0)), remark=remark)
            yield Case(f"{topic} frozen", LIMITS, on(topic, lambda: relay.freeze(restamp=False)), remark=remark)
        yield Case(f"{topic} NaN", ZERO, on(topic, lambda: relay.replace(math.nan)))
        yield Case(f"{topic} out of range", ZERO, on(topic, lambda: relay.replace(1e7)))
        yield Case(f"{topic} at 10x rate", RIDE, on(topic, lambda: relay.repeat(10)))
        expect = RIDE if slow else LIMITS
        remark = "" if slow else "one message in 0.1 s: in and out of degraded"
        yield Case(f"{topic} at 0.1x rate", expect, on(topic, lambda: relay.thin(10)), remark=remark)
        if stamped:
            yield Case(f"{topic} stamps jump 1 s back", ZERO, on(topic, lambda: relay.restamp(-1.0)))
            yield Case(f"{topic} stamps jump 1 s ahead", ZERO, on(topic, lambda: relay.restamp(1.0)))
    yield Case("wheel order shuffled", RIDE, on(m.WHEEL_STATES, lambda: relay.wheels((2, 0, 3, 1))))
    yield Case("one wheel missing", RIDE, on(m.WHEEL_STATES, lambda: relay.wheels((0, 1, 2))))
    yield Case("an axle's wheels missing", ZERO, on(m.WHEEL_STATES, lambda: relay.wheels((0, 1))))


def system_cases() -> Iterator[Case]:
    """What happens around the inputs."""

    def every(make: Callable[[int], relay.Transform]) -> Callable[[Session], None]:
        def begin(session: Session) -> None:
            for seed, topic in enumerate(relay.INPUTS):
                session.spoil(topic, make(seed))

        return begin

    def braking_then(transform: relay.Transform) -> Callable[[Session], None]:
        def begin(session: Session) -> None:
            session.spoil(m.POWER_DEMAND, relay.replace(-8000.0))
            session.relay.run(1.0)
            session.relay.forget()
            session.spoil(m.POWER_DEMAND, transform)

        return begin

    brake_s = config.DEFAULTS["brake_release_s"]
    yield Case("all inputs stopped", ZERO, every(lambda _: relay.stop))
    yield Case("30 % message loss", LIMITS, every(lambda seed: relay.lose(0.3, seed)),
               remark="three in a row are lost some three times a second: in and out of degraded")  # fmt: skip
    yield Case("brake demand stopped", ZERO, braking_then(relay.stop), allowed_s=float(brake_s),
               remark="friction brakes let go as slowly as docs/safety.md says")  # fmt: skip
    yield Case("second publisher of commands", LIMITS, Session.intrude, Session.relieve,
               remark="reported; the motor controllers must not listen to it")  # fmt: skip
    yield Case("policy file overwritten", RIDE, Session.swap_policy, Session.restore_policy,
               remark="reported; the loaded policy stays")  # fmt: skip
    yield Case("both processors loaded", LIMITS, Session.load_processors, Session.relieve,
               remark="what the machine's scheduler leaves")  # fmt: skip
    yield Case("simulator killed", ZERO, lambda s: s.simulator.process.kill(), _restart_simulator)
    yield Case("power manager killed", ZERO, lambda s: s.power_manager.process.kill(), _restart_power_manager,
               remark="by the motors' own time-out", allowed_s=0.1)  # fmt: skip


def clock_cases() -> Iterator[Case]:
    """What simulated time can do."""
    for shift_s, text in ((5.0, "5 s ahead"), (-5.0, "5 s back")):
        yield Case(f"clock jumps {text}", ZERO, on("clock", partial(relay.restamp, shift_s)))
    yield Case("clock stops", ZERO, on("clock", lambda: relay.stop),
               allowed_s=float(config.DEFAULTS["clock_stopped_s"]) + 0.1)  # fmt: skip


def _restart_simulator(session: Session) -> None:
    session.simulator.process.wait()
    session.start_simulator()


def _restart_power_manager(session: Session) -> None:
    session.power_manager.process.wait()
    session.start_power_manager()


def promised_s(missed_periods: int) -> float:
    """Time from the last good message to zero motor torque, as docs/safety.md states it, for the slowest input."""
    period = float(config.DEFAULTS["input_period_s.battery_state"])
    step = 1.0 / float(config.DEFAULTS["rate_hz"])
    return missed_periods * period + float(config.DEFAULTS["fade_s"]) + 2.0 * step


def run_case(session: Session, case: Case, plan: Plan) -> Result:
    """Break it, watch, mend it, watch."""
    node = session.relay
    if not session.wait_for_torque(_NODE_START_S):
        raise IwmError(f"{case.name}: no normal operation before it; last mode {node.mode}, {list(node.reports)[-3:]}")
    node.forget()
    started = time.monotonic()
    case.begin(session)
    if case.name.startswith("brake"):
        started = time.monotonic()
    node.run(_FAULT_S)
    ended = time.monotonic()
    commands, reports = node.commands, node.reports
    modes = [mode for _, mode, _ in node.modes]
    torques = [(command.time_s, max(map(abs, command.motor_nm))) for command in commands]
    killed = "power manager killed" in case.name
    if killed:
        torques = node.applied
    case.end(session)
    node.forget()
    session.wait_for_torque(_NODE_START_S if "killed" in case.name else _RECOVER_S)
    recovered = [at for at, mode, _ in node.modes if mode == MODE_NORMAL]
    recovery_s = recovered[0] - ended if recovered and node.mode == MODE_NORMAL else math.nan

    allowed = (case.allowed_s or promised_s(plan.missed_periods)) + _MARGIN_S
    last_torque = max((at for at, torque in torques if torque > 0.0), default=started)
    to_zero_s = last_torque - started if last_torque < ended - 0.1 and torques else math.nan
    late = [torque for at, torque in torques if at > started + allowed]
    largest = max(late, default=0.0)
    times = [command.time_s for command in commands]
    gaps = [b - a for a, b in itertools.pairwise(times)]
    problems = list(_problems(session, case, commands))
    if case.expect == ZERO and (math.isnan(to_zero_s) or largest > 0.0):
        problems.append(f"torque of {largest:.1f} N m later than {allowed:.2f} s")
    if case.expect == RIDE and any(mode != MODE_NORMAL for mode in modes):
        problems.append("left normal operation")
    if math.isnan(recovery_s):
        problems.append("did not recover")
    said = next((text for text in reports if _tells(text)), "")
    gap_s = max(gaps, default=math.nan)
    return Result(case.name, case.expect, to_zero_s, largest, recovery_s, gap_s, len(commands), said, problems)


def _problems(session: Session, case: Case, commands: Sequence[relay.Observation]) -> Iterator[str]:
    """What no command may ever be."""
    vehicle = load_vehicle(resolve(config.DEFAULTS["vehicle_file"])).params
    for command in commands:
        torques = command.motor_nm + command.friction_nm
        if not all(map(math.isfinite, torques)):
            yield "a command that is not finite"
            return
        if max(map(abs, command.motor_nm)) > vehicle.front.motor.peak_torque_nm + 1e-6:
            yield "a motor torque beyond the limit"
            return
        if not all(-vehicle.front.friction_brake.max_torque_nm - 1e-6 <= t <= 0.0 for t in command.friction_nm):
            yield "a friction torque beyond the limit"
            return
        if "brake" in case.name and max(command.motor_nm) > 0.0:
            yield "driving torque without a demand"
            return
    if not session.power_manager.running and "power manager killed" not in case.name:
        yield "the power manager ended"


def _tells(report: str) -> bool:
    return report.startswith(("inputs:", "command topics:", "policy:", "fault:"))


def copy_policies(folder: Path) -> None:
    """Put the shipped policies into a folder where they may be spoilt."""
    shutil.copytree(resolve("policies"), folder, dirs_exist_ok=True)


@contextmanager
def session_of(folder: Path, sim_time: bool, plan: Plan) -> Iterator[Session]:
    """A simulated car under way, on a DDS domain of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    copy_policies(folder / "policies")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with claimed_domain() as domain:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder / "ros")}
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain, args=[])
        node = FaultRelay(context, _NAMESPACE)
        try:
            with Children(environment, folder) as children:
                session = Session(folder, children, node, sim_time, plan)
                try:
                    yield session
                finally:
                    session.relieve()
        finally:
            with ending.one_processor():
                node.close()
                rclpy.shutdown(context=context)


def show(result: Result) -> str:
    """One row of the table."""

    def seconds(value: float) -> str:
        return "-" if math.isnan(value) else f"{value:.2f}"

    verdict = "; ".join(result.problems) or "ok"
    return (
        f"{result.name:38} {result.expect:14} {seconds(result.to_zero_s):>7} {result.largest_nm:>8.1f} "
        f"{seconds(result.recovery_s):>8} {seconds(result.longest_gap_s):>6} {result.commands:>5}  {verdict}"
        + (f"  [{result.said.split(';')[0]}]" if result.said else "")
    )


HEADER = (
    f"{'fault':38} {'must':14} {'zero, s':>7} {'later Nm':>8} {'back, s':>8} {'gap, s':>6} {'cmds':>5}  "
    "result  [reported]"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign; exit code 1 if a fault did what it must not do."""
    parser = CommandParser("faults", description=__doc__)
    parser.add_argument("--strategy", default="sdp", choices=config.BY_NAME["strategy"].choices)
    parser.add_argument(
        "--missed-periods",
        type=int,
        default=3,
        help="periods after which an input is missing (3; more on a busy machine)",
    )
    parser.add_argument("--only", default="", help="only faults whose names contain this")
    parser.add_argument("--json", type=Path, help="write the results there too")
    chosen = parser.parse_args(arguments)
    plan = Plan(chosen.strategy, chosen.missed_periods, chosen.only)
    results: list[Result] = []
    print(HEADER, flush=True)
    try:
        with tempfile.TemporaryDirectory(prefix="iwm-faults-") as folder:
            for sim_time, cases in ((False, (*input_cases(), *system_cases())), (True, tuple(clock_cases()))):
                wanted = [case for case in cases if plan.pattern in case.name]
                if not wanted:
                    continue
                with session_of(Path(folder) / ("sim" if sim_time else "real"), sim_time, plan) as session:
                    for case in wanted:
                        results.append(run_case(session, case, plan))
                        print(show(results[-1]), flush=True)
    except IwmError as error:
        print(f"faults: {error}", file=sys.stderr)
        return 1
    failed = [result for result in results if result.problems]
    print(f"{len(results)} faults, {len(failed)} with an effect they must not have")
    if chosen.json:
        rows = [result._asdict() for result in results]
        files.atomic_write(chosen.json, json.dumps(rows, indent=1).encode())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
