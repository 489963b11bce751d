# SPDX-License-Identifier: Apache-2.0
"""Node `simulator`: a driver and a car on a drive cycle, as the rest of the vehicle would show itself on DDS.

The car is `drive.Drive`, the same code and the same numbers as the closed loop in one process. This module gives it
topics and time: in real time (or faster, with /clock) it steps on a timer and applies the latest commands; in lock-step
it sends a set of inputs, waits for the commands with that stamp, steps, and sends the next.
"""

from __future__ import annotations

import dataclasses
import enum
import gc
import math
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, cast

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from iwm_power_manager.control.types import Wheels
from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.errors import ConfigError, IwmError, of_parameter
from iwm_power_manager.exit_codes import DONE, FAILED
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.ros import ending, qos
from iwm_power_manager.ros import messages as m
from iwm_power_manager.ros.arguments import check_arguments, check_parameter_files
from iwm_power_manager.ros.intake import Intake
from iwm_power_manager.ros.interruption import Interruption
from iwm_power_manager.ros.parameters import Change, Spec, declare
from iwm_power_manager.share import resolve
from iwm_power_manager.tools.progress import show_compiling
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.drive import Drive, save_run
from iwm_sim.pacing import FRICTION, MOTOR, Exchange, NoAnswerError, Pacer
from iwm_sim.scenario import Scenario, load_scenario, on_cycle

_NO_TORQUE: Wheels = (0.0, 0.0, 0.0, 0.0)
#: Partners must have been seen for this long: the other side learns of a match a little later than this one.
_SETTLE_S = 0.3
_POLL_S = 0.05
#: What it waits for is told this often.
_TELL_S = 5.0
_PROGRESS_S = 0.2
_LAST_WORDS_S = 5.0
#: How often, and how far apart, the other command is looked for once one is there; later the timer looks.
_PATIENCE = 20
_PATIENCE_S = 0.0002

_spec = partial(Spec, change=Change.NEVER)

PARAMETERS = (
    _spec("vehicle_file", "config/vehicles/jalalmaab_2015.yaml", "Vehicle file of the car that is driven."),
    _spec("idle_drive", "", "Replaces the vehicle's idle_drive; empty: as in its file.", choices=("", *IDLE_DRIVES)),
    _spec("cycle_file", "config/cycles/nycc.csv", "Drive cycle, a CSV file with time_s,speed_mps[,grade]."),
    _spec(
        "scenario_file",
        "",
        "Scenario: file, or name of one of config/scenarios; it replaces vehicle, cycle, friction and charge.",
    ),
    _spec("until_s", 0.0, "End after this much of the cycle, s; 0: at its end.", 0.0, 1e6),
    _spec("friction", 0.9, "Peak friction coefficient of the road.", 0.05, 1.5),
    _spec("initial_soc", 0.8, "State of charge at the start, 0..1.", 0.0, 1.0),
    _spec("rate_hz", 100.0, "Steps a simulated second, Hz.", 10.0, 1000.0),
    _spec("lockstep", False, "One step for each pair of commands, as fast as they come, instead of a fixed rate."),
    _spec(
        "speed_factor", 1.0, "Not in lock-step: simulated seconds a second; other than 1 gives /clock.", 0.01, 1000.0
    ),
    _spec(
        "command_timeout_s", 0.1, "Not in lock-step: age at which the motors drop a command, simulated s.", 0.001, 10.0
    ),
    _spec("resend_after_s", 0.5, "In lock-step: a set without an answer is sent again this often, s.", 0.01, 60.0),
    _spec(
        "answer_timeout_s",
        10.0,
        "In lock-step: end with an error when a set has no answer for this long, s.",
        0.1,
        3600.0,
    ),
    _spec("partner_timeout_s", 60.0, "End with an error when partners are not there by then, s.", 0.1, 3600.0),
    _spec("wait_for_recorder", False, "Start only when the recorder says on recorder/ready that it misses nothing."),
    _spec(
        "pedal_rate_hz", 10.0, "Rate of accelerator_pedal and brake_pedal, Hz; nothing depends on them.", 0.1, 1000.0
    ),
    _spec("wheel_names", list(m.WHEEL_NAMES), "Names of the wheels, front left to rear right.", length=4),
    _spec("result_file", "", "Time series of the drive, an .npz; empty: none."),
    _spec("progress", False, "Write lines 'progress <simulated s> <whole s>' to standard output."),
)


def _scenario(values: Mapping[str, Any]) -> Scenario:
    """What is driven, by the parameters: a scenario's file, or a cycle on a uniform road."""
    idle_drive = values["idle_drive"] or None
    until_s = values["until_s"] or math.inf
    if values["scenario_file"]:
        with of_parameter("scenario_file"):
            scenario = load_scenario(values["scenario_file"], idle_drive)
        if values["lockstep"] and any(fault.message for fault in scenario.faults):
            wrong = "has faults of messages, and lock-step waits for each as it is measured"
            raise ConfigError(scenario.path, "faults", wrong, "lockstep: false")
        return dataclasses.replace(scenario, duration_s=min(scenario.duration_s, until_s))
    with of_parameter("vehicle_file"):
        vehicle = load_vehicle(resolve(values["vehicle_file"]), idle_drive)
    with of_parameter("cycle_file"):
        cycle = load_cycle(resolve(values["cycle_file"]))
    return on_cycle(vehicle, cycle, values["friction"], values["initial_soc"], until_s)


class _Phase(enum.Enum):
    WAITING = enum.auto()
    DRIVING = enum.auto()
    DONE = enum.auto()


class Simulator(Node):
    """The node around a `Drive`.

    Attributes
    ----------
    done : completes when the drive is over; carries the exception if it failed

    Raises
    ------
    IwmError
        A parameter, the vehicle or the cycle is wrong.
    """

    def __init__(self) -> None:
        super().__init__("simulator")
        values = declare(self, PARAMETERS)
        self.done: Future = Future()
        self._lockstep: bool = values["lockstep"]
        self._wheel_names: list[str] = values["wheel_names"]
        self._result_file: str = values["result_file"]
        self._progress: bool = values["progress"]
        self._partner_timeout_s: float = values["partner_timeout_s"]
        speed_factor: float = values["speed_factor"]
        self._period_ns = round(1e9 / values["rate_hz"])
        period_s = self._period_ns / 1e9
        scenario = _scenario(values)
        if scenario.cycle and scenario.cycle.gap:
            self.get_logger().warning(scenario.cycle.gap)
        self._drive = Drive(scenario, dt_s=period_s)
        self._pedal_steps = max(1, round(values["rate_hz"] / values["pedal_rate_hz"]))
        self._exchange = Exchange(values["resend_after_s"], values["answer_timeout_s"])
        self._pacer = Pacer(period_s, speed_factor)
        self._command_timeout_s = values["command_timeout_s"] / speed_factor
        self._command: list[Wheels] = [_NO_TORQUE, _NO_TORQUE]
        self._received_ns = [0, 0]
        self._timeouts = 0
        self._timed_out = False
        self._phase = _Phase.WAITING
        self._recorder_ready = not values["wait_for_recorder"]
        self._begun_s = self._partners_since_s = self._progress_s = -math.inf

        self._simulated_time = self._lockstep or speed_factor != 1.0
        profile = qos.profile(lockstep=self._lockstep)
        topics = [m.VEHICLE_SPEED, m.WHEEL_STATES, m.BATTERY_STATE, m.POWER_DEMAND]
        # On a drive cycle the car goes straight ahead.
        self._moves_in_the_plane = bool(values["scenario_file"])
        optional = [m.ACCELERATOR_PEDAL, m.BRAKE_PEDAL] + ([m.CLOCK] if self._simulated_time else [])
        optional += [m.DIRECTION, m.IMU] if self._moves_in_the_plane else []
        # Handlers of unmet quality of service would be waited for at every step; a missing match is told at the start.
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        self._outputs: dict[str, Publisher] = {
            topic: self.create_publisher(m.TOPIC_TYPES[topic], topic, profile, event_callbacks=silent)
            for topic in (*topics, *optional)
        }
        self._published = Counter[str]()
        self._listeners = dict.fromkeys(topics, 1)
        if values["wait_for_recorder"]:
            self._listeners = {topic: self._listeners.get(topic, 0) + 1 for topic in self._outputs}
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.create_subscription(Bool, m.RECORDER_READY, self._on_recorder, latched)
        self._intake = Intake(self)
        self._intake.subscribe(JointState, m.WHEEL_TORQUE_COMMAND, profile)
        if self._lockstep:
            # The power manager publishes this one last: one wake-up a step is enough.
            self.create_subscription(
                JointState,
                m.FRICTION_BRAKE_COMMAND,
                self._on_friction_command,
                profile,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )
        else:
            self._intake.subscribe(JointState, m.FRICTION_BRAKE_COMMAND, profile)
        # Wall time in every mode: this node is where simulated time comes from.
        self._wall = Clock(clock_type=ClockType.STEADY_TIME)
        self._start_s = self._told_s = time.monotonic()
        self._timer = self.create_timer(_POLL_S, self._look_for_partners, clock=self._wall)
        self.get_logger().info(f"{self._drive.description}; waiting for the power manager")

    # --- before the drive -------------------------------------------------------------------------------------------

    def _on_recorder(self, message: Bool) -> None:
        self._recorder_ready = message.data

    def _missing_partners(self) -> list[str]:
        missing = [
            f"{'second ' if count > 1 else ''}subscription of {self._outputs[topic].topic_name}"
            for topic, count in self._listeners.items()
            if self._outputs[topic].get_subscription_count() < count
        ]
        missing += [
            f"publisher of {self.resolve_topic_name(topic)}"
            for topic in (m.WHEEL_TORQUE_COMMAND, m.FRICTION_BRAKE_COMMAND)
            if self.count_publishers(topic) < 1
        ]
        if not self._recorder_ready:
            missing.append("word from the recorder that it is ready")
        return missing

    def _look_for_partners(self) -> None:
        now = time.monotonic()
        missing = self._missing_partners()
        if missing:
            self._partners_since_s = math.inf
            words = f"there is still no {'; no '.join(missing)}"
            if now - self._start_s >= self._partner_timeout_s:
                self._fail(NoAnswerError(f"after {self._partner_timeout_s:g} s {words}"))
            elif now - self._told_s >= _TELL_S:
                self._told_s = now
                self.get_logger().info(f"waits: {words}")
            return
        if math.isinf(self._partners_since_s):
            self._partners_since_s = now
        if now - self._partners_since_s >= _SETTLE_S:
            self._begin()

    def _begin(self) -> None:
        self.destroy_timer(self._timer)
        # What exists now lives to the end; without it, a collection takes no noticeable time.
        gc.collect()
        gc.freeze()
        self._phase = _Phase.DRIVING
        self._begun_s = time.monotonic()
        self._first_stamp_ns = self._period_ns if self._simulated_time else self.get_clock().now().nanoseconds
        self.get_logger().info("driving")
        self._intake.drop_all()
        if self._lockstep:
            self._timer = self.create_timer(_POLL_S, self._look_for_answer, clock=self._wall)
            self._ask()
        else:
            self._pacer.start(self._begun_s)
            self._publish_set()
            self._timer = self.create_timer(self._pacer.wall_period_s, self._on_period, clock=self._wall)

    # --- lock-step --------------------------------------------------------------------------------------------------

    def _ask(self) -> None:
        self._exchange.ask(self._stamp_ns, time.monotonic())
        self._publish_set()

    def _on_friction_command(self, message: JointState) -> None:
        if self._phase is not _Phase.DRIVING:
            return
        self._answer(FRICTION, message)
        stamp_ns = m.stamp_to_ns(message.header.stamp)
        for _ in range(_PATIENCE):
            self._take_motor_commands()
            if self._exchange.awaited_ns != stamp_ns:
                return
            time.sleep(_PATIENCE_S)

    def _take_motor_commands(self) -> None:
        for message, _ in self._intake.take(m.WHEEL_TORQUE_COMMAND):
            self._answer(MOTOR, message)

    def _answer(self, kind: int, message: JointState) -> None:
        torque = self._read(message)
        if torque is None:
            return
        commands = self._exchange.answer(kind, m.stamp_to_ns(message.header.stamp), torque)
        if commands is not None:
            self._drive.advance(*commands)
            if self._continue():
                self._ask()

    def _look_for_answer(self) -> None:
        self._take_motor_commands()
        try:
            if self._phase is _Phase.DRIVING and self._exchange.overdue(time.monotonic()):
                self.get_logger().warning(f"no answer at {self._drive.time_s:.2f} s, sending the set again")
                self._publish_set()
        except NoAnswerError as error:
            self._fail(error)

    # --- real time --------------------------------------------------------------------------------------------------

    def _on_period(self) -> None:
        for _ in range(self._pacer.due(time.monotonic())):
            self._drive.advance(*self._fresh_command())
            if not self._continue():
                return
            self._publish_set()

    def _fresh_command(self) -> tuple[Wheels, Wheels]:
        """The latest command, unless it is too old.

        Then the motor controllers give no torque, and the friction brakes follow the pedal by themselves.
        """
        for kind, topic in ((MOTOR, m.WHEEL_TORQUE_COMMAND), (FRICTION, m.FRICTION_BRAKE_COMMAND)):
            for message, info in self._intake.take(topic):
                torque = self._read(message)
                if torque is not None:
                    self._command[kind] = torque
                    self._received_ns[kind] = info["received_timestamp"]
        age_s = (time.time_ns() - min(self._received_ns)) / 1e9
        timed_out = age_s > self._command_timeout_s
        if timed_out and not self._timed_out:
            self._timeouts += 1
            since = f"no command for {age_s:.3f} s" if min(self._received_ns) else "no command yet"
            self.get_logger().warning(f"{since}: motors off, brakes follow the pedal")
        elif self._timed_out and not timed_out:
            self.get_logger().info("commands are back")
        self._timed_out = timed_out
        if timed_out:
            return _NO_TORQUE, self._drive.pedal_brake_torque_nm()
        return self._command[MOTOR], self._command[FRICTION]

    # --- both -------------------------------------------------------------------------------------------------------

    @property
    def _stamp_ns(self) -> int:
        # Where simulated time is /clock, it may be late; where it is everybody's clock, stamps have to keep up with it.
        late_ns = 0 if self._simulated_time else round(self._pacer.late_s * 1e9)
        return self._first_stamp_ns + self._drive.step * self._period_ns + late_ns

    def _publish_set(self) -> None:
        """Everything the car shows of itself at this step; `power_demand` closes the set."""
        now_ns = self._stamp_ns
        if self._simulated_time:
            self._publish(m.CLOCK, m.clock_message(now_ns))
        sensors = self._drive.sense()
        if self._drive.step % self._pedal_steps == 0:
            self._publish(m.ACCELERATOR_PEDAL, m.number_message(sensors.accelerator))
            self._publish(m.BRAKE_PEDAL, m.number_message(sensors.brake))
        for stamp_ns, shown in self._drive.arriving(m.VEHICLE_SPEED, sensors, now_ns):
            self._publish(m.VEHICLE_SPEED, m.vehicle_speed_message(stamp_ns, shown.speed_mps))
        for stamp_ns, shown in self._drive.arriving(m.WHEEL_STATES, sensors, now_ns):
            speeds, torques = shown.wheel_speed_radps, shown.motor_torque_nm
            self._publish(m.WHEEL_STATES, m.wheel_states_message(stamp_ns, self._wheel_names, speeds, torques))
        for stamp_ns, shown in self._drive.arriving(m.BATTERY_STATE, sensors, now_ns):
            self._publish(
                m.BATTERY_STATE,
                m.battery_state_message(
                    stamp_ns,
                    soc=shown.soc,
                    voltage_v=shown.battery_voltage_v,
                    discharge_current_a=shown.battery_current_a,
                    capacity_ah=self._drive.capacity_ah,
                ),
            )
        if self._moves_in_the_plane:
            for stamp_ns, shown in self._drive.arriving(m.IMU, sensors, now_ns):
                forward, left = shown.acceleration_mps2, shown.lateral_acceleration_mps2
                self._publish(m.IMU, m.imu_message(stamp_ns, shown.yaw_rate_radps, forward, left))
            self._publish(m.DIRECTION, m.number_message(float(sensors.direction)))
        for _, shown in self._drive.arriving(m.POWER_DEMAND, sensors, now_ns):
            self._publish(m.POWER_DEMAND, m.number_message(shown.power_demand_w))

    def _publish(self, topic: str, message: Any) -> None:
        self._outputs[topic].publish(message)
        self._published[topic] += 1

    def _read(self, message: JointState) -> Wheels | None:
        """Torques of a command in the order of the wheels; None if one is missing or not finite."""
        torque = cast(Wheels, m.select_by_name(m.read_torques(message), self._wheel_names))
        if all(map(math.isfinite, torque)):
            return torque
        self.get_logger().warning(
            f"a command without a finite torque for each of {', '.join(self._wheel_names)} was dropped",
            throttle_duration_sec=1.0,
        )
        return None

    def _continue(self) -> bool:
        """Report progress; False, once, at the end of the cycle."""
        now = time.monotonic()
        if self._progress and (now - self._progress_s >= _PROGRESS_S or self._drive.finished):
            self._progress_s = now
            print(f"progress {self._drive.time_s:.3f} {self._drive.duration_s:.3f}", flush=True)
        if not self._drive.finished:
            return True
        self._finish(now)
        return False

    def _finish(self, now: float) -> None:
        self._phase = _Phase.DONE
        self.destroy_timer(self._timer)
        lasted_s = now - self._begun_s
        if self._lockstep:
            remark = f"{self._exchange.resent} sets sent twice"
        else:
            remark = f"{self._timeouts} command time-outs, {self._pacer.stalls} stalls"
        self.get_logger().info(
            f"end of the cycle: {self._drive.step} steps in {lasted_s:.1f} s "
            f"({self._drive.time_s / lasted_s:.1f} x real time), {remark}; {self._drive.summary()}"
        )
        try:
            if self._result_file:
                save_run(self._result_file, self._drive.run(), self._notes(lasted_s))
        except IwmError as error:
            self._fail(error)
            return
        # Leaving closes DDS: what a slow subscriber has not acknowledged by then would be lost.
        deadline = time.monotonic() + _LAST_WORDS_S
        for publisher in self._outputs.values():
            left_s = max(deadline - time.monotonic(), 0.0)
            publisher.wait_for_all_acked(Duration(nanoseconds=int(left_s * 1e9)))
        self.done.set_result(None)

    def _notes(self, lasted_s: float) -> dict[str, Any]:
        """What happened around the drive, for the result file."""
        return {
            "first_stamp_ns": self._first_stamp_ns,
            "period_ns": self._period_ns,
            "wall_s": lasted_s,
            "published": dict(self._published),
            "resent": self._exchange.resent,
            "command_timeouts": self._timeouts,
            "stalls": self._pacer.stalls,
        }

    def _fail(self, error: IwmError) -> None:
        self._phase = _Phase.DONE
        self.destroy_timer(self._timer)
        self.done.set_exception(error)


_EXAMPLES = """\
  UDDS on a wet road, in real time:
    simulator --ros-args -p cycle_file:=udds -p friction:=0.5
  As fast as it goes; the power manager has to be in lock-step, too:
    simulator --ros-args -p cycle_file:=my_commute.csv -p vehicle_file:=my_car.yaml -p lockstep:=true
"""


def main(args: Sequence[str] | None = None) -> int:
    """Drive the cycle; returns the exit code; one line on an error."""
    interruption = Interruption()
    interruption.install()
    node: Simulator | None = None
    code = FAILED
    try:
        check_parameter_files(sys.argv if args is None else list(args))
        check_arguments(
            "simulator",
            "A driver and a car on a drive cycle, seen through topics; ends with the cycle.",
            PARAMETERS,
            args,
            examples=_EXAMPLES,
        )
        # rclpy's own handlers would close DDS under a callback that is publishing.
        rclpy.init(args=list(args) if args is not None else None, signal_handler_options=SignalHandlerOptions.NO)
        show_compiling()
        node = Simulator()
        check_parameter_files(sys.argv if args is None else list(args), node.get_fully_qualified_name())
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        interruption.started = True
        # The node's timers wake the executor often enough for a signal to be noticed.
        while not node.done.done() and not interruption.requested:
            executor.spin_once()
        if node.done.done():
            node.done.result()
        executor.shutdown()
        code = DONE
    except KeyboardInterrupt:
        code = DONE
    except (IwmError, RuntimeError) as error:  # RuntimeError: rcl's only word for a wrong --ros-args
        code = getattr(error, "exit_code", FAILED)
        print(f"simulator: {' '.join(str(error).split())}", file=sys.stderr)
    finally:
        with ending.bounded(code):
            if node is not None:
                node.destroy_node()
                node = None
    return code


if __name__ == "__main__":
    sys.exit(ending.at_exit(main()))
