# SPDX-License-Identifier: Apache-2.0
"""Node `power_manager`: between the driver's demand and four motors.

A managed node. Configure loads and verifies vehicle and policy and warms the compiled law; activate starts commanding;
deactivate commands zero torque first. Everything it decides, it decides in `control.controller`; here are DDS, the
clock, the lifecycle and nothing else. See docs/interface.md for topics and parameters, docs/safety.md for the reasons.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from iwm_power_manager.control.controller import Controller
from iwm_power_manager.control.lockstep import BATTERY, SPEED, WHEELS
from iwm_power_manager.control.monitor import BatteryReading, InputMonitor, JointReading, SpeedReading
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.control.stepping import Lockstep, RealTime, Taken
from iwm_power_manager.errors import IwmError
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.nodes.announcements import Announcements, input_topics
from iwm_power_manager.nodes.demand_log import DemandLog
from iwm_power_manager.nodes.policy_choice import Policies
from iwm_power_manager.nodes.power_manager_report import ChangeDetector, PowerManagerReport
from iwm_power_manager.nodes.preparation import Preparation, Prepared
from iwm_power_manager.ros import diagnostics, ending, messages, qos, realtime
from iwm_power_manager.ros.arguments import check_arguments, check_parameter_files
from iwm_power_manager.ros.intake import Intake
from iwm_power_manager.ros.interruption import Interruption
from iwm_power_manager.ros.matching import mismatched_publishers, mismatched_subscribers
from iwm_power_manager.ros.parameters import KeepsItsValues, ParameterError, check_change, declare
from iwm_power_manager.signals.cdr import MessageWriter
from iwm_power_manager.signals.commands import FRICTION, MOTOR, CommandWriter
from iwm_power_manager.signals.contract import JOINT_STATE, NODE_STATE
from iwm_power_manager.signals.mapping import DEMANDS, PEDALS
from iwm_power_manager.signals.readings import (
    DemandReading,
    DirectionReading,
    FrictionReading,
    TopicReader,
    TorqueReading,
    joint_state_writer,
)

#: The queue of each stamped input of a lock-step set.
_QUEUES: dict[type, int] = {SpeedReading: SPEED, JointReading: WHEELS, BatteryReading: BATTERY}
#: How often, and how far apart, the rest of a set is looked for once its demand is there; later the watchdog looks.
_SET_PATIENCE = 20
_SET_POLL_S = 0.0002
_ZERO = (0.0, 0.0, 0.0, 0.0)
_NS_PER_S = 1_000_000_000
#: The watchdog also wakes the executor often enough for signals to be noticed.
_WATCHDOG_PERIOD_S = 0.1
_REPORT_PERIOD_S = 1.0
#: Diagnostics on change come no faster than this: a gate may open and close at the control rate.
_CHANGE_PERIOD_S = 0.1
_ACKNOWLEDGE_S = 0.2


class PowerManager(KeepsItsValues, LifecycleNode):
    """The managed node.

    Raises
    ------
    ParameterError
        A parameter given at start is wrong.
    """

    def __init__(self) -> None:
        super().__init__("power_manager")
        self._values: dict[str, Any] = declare(self, config.SPECS)
        problem = config.check_together(self._values)
        try:
            self._processors = realtime.parse_affinity(self._values["cpu_affinity"])
        except ValueError as error:
            problem = f"cpu_affinity: {error}"
        if problem:
            raise ParameterError(f"parameter {problem}")
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._lockstep: bool = self._values["lockstep"]
        self._controller: Controller | None = None
        self._stepper: Lockstep | RealTime | None = None
        self._restarts = 0
        self._policies: Policies | None = None
        self._demand_log: DemandLog | None = None
        self._intake = Intake(self)
        self._demand_subscription: Any = None
        self._publishers_made: dict[str, Any] = {}
        self._step_timer: Any = None
        self._active = False
        self._fault = ""
        self._wheel_names: tuple[str, ...] = tuple(self._values["wheel_names"])
        self._period_s = 1.0 / self._values["rate_hz"]
        self._last_step_steady_s = 0.0
        self._answer: list[tuple[str, bytes]] | None = None
        self._readers: dict[str, TopicReader] = {}
        self._demand_reader: TopicReader | None = None
        self._commands: dict[str, CommandWriter] = {}
        self._command_topics: list[str] = []
        self._write_state: MessageWriter | None = None
        self._topics: dict[str, tuple[str, ...]] = {}
        self._msgtypes: dict[str, str] = {}
        self._unheard: dict[str, str] = {}
        self._preparation: Preparation | None = None
        self._prepared: Future | None = None
        self._starting = False
        self.start_failed = False
        self._says = Announcements(self.get_logger())
        # rclpy ends a transition that the present state does not have in an exception; its client would wait forever.
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._change_state_if_possible
        # It waits for what is prepared; in the node's own group everything else would wait with it.
        self._service_change_state.callback_group = MutuallyExclusiveCallbackGroup()
        self._service_change_state.callback_group.add_entity(self._service_change_state)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._report = PowerManagerReport(self.get_fully_qualified_name(), self._wheel_names, None)
        self._report_due = False
        self._changes = ChangeDetector(_CHANGE_PERIOD_S)
        self.create_timer(_REPORT_PERIOD_S, self._on_report_timer)
        self.create_timer(_WATCHDOG_PERIOD_S, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take over what was prepared (or prepare it now), then appear on the topics."""
        self._values = self._present_values()
        self._fault = ""
        try:
            self._adopt(self._take_preparation())
        except IwmError as error:
            self._fault = str(error)
            self.get_logger().error(self._fault)
            self._release()
            return TransitionCallbackReturn.FAILURE
        self._create_entities()
        refused = realtime.request(self._values["realtime_priority"], self._processors, self._values["lock_memory"])
        for what in refused:
            self.get_logger().warning(f"the system refused {what}")
        if self._values["gc_off_path"]:
            realtime.stop_automatic_collection()
        rate = "in lock-step" if self._lockstep else f"{self._values['rate_hz']:g} Hz"
        resolved = [self.resolve_topic_name(topic) for topic in self._command_topics]
        self._says.interface(self._topics, resolved, rate)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start commanding, from the law's initial state."""
        self._fault = ""
        self._intake.drop_all()
        if isinstance(self._stepper, Lockstep):
            self._stepper.queue.clear()
        self._start_over()
        result = super().on_activate(state)
        self._active = True
        self._says.activated()
        self.get_logger().info("active")
        self._last_step_steady_s = time.monotonic()
        if not self._lockstep:
            self._step_timer = self.create_timer(self._period_s, self._on_step_timer)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Command zero torque, then stop commanding."""
        self._stop_commanding()
        self.get_logger().info("inactive: zero torque was commanded")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of vehicle, policy, publishers and subscriptions."""
        result = super().on_cleanup(state)
        self._release()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Command zero torque if active, then let go of everything."""
        self._stop_commanding()
        result = super().on_shutdown(state)
        self._release()
        return result

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Command zero torque and go back to unconfigured: a transition raised what nobody expected."""
        self._stop_commanding()
        self._release()
        self.get_logger().error("a transition failed; the node is unconfigured again")
        return TransitionCallbackReturn.SUCCESS

    def start(self) -> bool:
        """Configure and activate, and wait for it; False if that was refused."""
        return (
            self.trigger_configure() == TransitionCallbackReturn.SUCCESS
            and self.trigger_activate() == TransitionCallbackReturn.SUCCESS
        )

    def start_when_prepared(self) -> None:
        """Begin to prepare; the executor then configures and activates. `start_failed` if that is refused."""
        self._starting = True
        self._prepare()

    def _go_on_starting(self) -> None:
        """The next step on the way to active, once it is possible."""
        if not self.preparing:
            self._starting = False
            self.start_failed = not self.start()

    @property
    def preparing(self) -> bool:
        """A thread is loading and compiling."""
        return self._preparation is not None and self._preparation.running

    def _present_values(self) -> dict[str, Any]:
        return {name: self.get_parameter(name).value for name in config.BY_NAME}

    def _prepare(self) -> Future:
        """Begin to prepare, unless that is going on; what is returned is done when it is over."""
        if self._prepared is None:
            done = self._prepared = Future(executor=self.executor)
            self._preparation = Preparation(self._present_values(), lambda: done.set_result(None))
        return self._prepared

    def _take_preparation(self) -> Prepared:
        """What was prepared, of the parameters as they are now."""
        preparation, self._preparation, self._prepared = self._preparation, None, None
        if preparation is None or preparation.values != self._values:
            preparation = Preparation(self._values, lambda: None)
        return preparation.result()

    def stop(self) -> None:
        """Deactivate, if active."""
        if self._active:
            self.trigger_deactivate()

    def fail(self, problem: str) -> None:
        """Zero torque, inactive, and the reason on `/diagnostics`: the state every unexpected error leads to."""
        self._fault = problem
        self.get_logger().fatal(f"zero torque and inactive: {problem}")
        self.stop()

    async def _change_state_if_possible(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        wanted = request.transition
        configure = wanted.label == "configure" if wanted.label else wanted.id == Transition.TRANSITION_CONFIGURE
        if configure and self._is_possible(wanted):
            await self._prepare()  # other services are answered meanwhile
        if not self._is_possible(wanted):
            name = wanted.label or wanted.id
            self.get_logger().warning(f"there is no transition {name} from state {self._lifecycle_state()}")
            response.success = False
            return response
        return self._change_state(request, response)

    def _is_possible(self, wanted: Transition) -> bool:
        possible = {(found[0], found[1]) for found in self._state_machine.available_transitions}
        return any(wanted.label == label if wanted.label else wanted.id == number for number, label in possible)

    def _adopt(self, prepared: Prepared) -> None:
        """Drive with what was prepared."""
        self._says.prepared(prepared)
        values, signals = self._values, prepared.mapping
        self._wheel_names = tuple(values["wheel_names"])
        self._period_s = 1.0 / values["rate_hz"]
        self._controller, self._policies = prepared.controller, prepared.policies
        self._readers, self._commands = prepared.readers, prepared.commands
        sinks = [sink for found in signals.commands.values() for sink in found]
        self._command_topics = [sink.topic for sink in sinks]
        self._write_state = joint_state_writer(SIGNAL_NAMES, "position")
        resolve_name = self.resolve_topic_name
        self._topics = {name: tuple(map(resolve_name, topics)) for name, topics in input_topics(signals).items()}
        self._msgtypes = {resolve_name(topic): reader.read.types.name for topic, reader in self._readers.items()}
        self._msgtypes |= {resolve_name(sink.topic): sink.type for sink in sinks}
        self._msgtypes[resolve_name(NODE_STATE)] = JOINT_STATE
        self._stepper = (
            Lockstep(self._controller, self._period_s)
            if self._lockstep
            else RealTime(self._controller, self._period_s, config.thresholds_of(values))
        )
        if values["demand_log"]:
            path, period_s = Path(values["demand_log"]), values["demand_log_period_s"]
            self._demand_log = DemandLog(path, period_s, self._controller.policy, prepared.vehicle.params)
        rate_hz = None if self._lockstep else values["rate_hz"]
        self._report = PowerManagerReport(self.get_fully_qualified_name(), self._wheel_names, rate_hz)

    def _create_entities(self) -> None:
        """Publishers and subscriptions of everything the signals file names, and of the state."""
        profile = qos.profile(lockstep=self._lockstep)
        overrides = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
        # What cannot be met is told in the diagnostics; an event handler would be waited for at each step.
        silent = {"event_callbacks": PublisherEventCallbacks(use_default_callbacks=False)}
        offered = qos.command_profile(None if self._lockstep else self._period_s)
        for topic, offer in (*((topic, offered) for topic in self._command_topics), (NODE_STATE, profile)):
            kind = messages.message_class(self._msgtypes[self.resolve_topic_name(topic)])
            self._publishers_made[topic] = self.create_lifecycle_publisher(kind, topic, offer, **overrides, **silent)
        for topic, reader in self._readers.items():
            kind = messages.message_class(reader.read.types.name)
            reliability = "reliable" if "reliable" in {source.qos for source in reader.sources} else "best_effort"
            asked = (
                profile
                if self._lockstep
                else qos.profile(lockstep=False, depth=qos.INPUT_DEPTH, reliability=reliability)
            )
            if self._lockstep and set(reader.signals).intersection((*DEMANDS, *PEDALS)):
                self._demand_reader = reader
                self._demand_subscription = self.create_subscription(
                    kind,
                    topic,
                    self._on_demand,
                    asked,
                    event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                    raw=True,
                    **overrides,
                )
            else:
                self._intake.subscribe(kind, topic, asked, raw=True)

    def _release(self) -> None:
        self._intake.close()
        if self._demand_subscription is not None:
            self.destroy_subscription(self._demand_subscription)
        for publisher in self._publishers_made.values():
            self.destroy_lifecycle_publisher(publisher)
        self._demand_subscription = None
        self._publishers_made = {}
        self._readers = {}
        self._demand_reader = None
        self._commands = {}
        self._command_topics = []
        self._unheard = {}
        self._controller = None
        self._stepper = None
        self._policies = None
        if self._demand_log:
            self._demand_log.close()
            self._demand_log = None
        if self._values["gc_off_path"]:
            realtime.resume_automatic_collection()

    def _stop_commanding(self) -> None:
        if not self._active:
            return
        self._active = False
        if self._step_timer is not None:
            self.destroy_timer(self._step_timer)
            self._step_timer = None
        self._command_zero()
        for topic in self._command_topics:
            self._publishers_made[topic].wait_for_all_acked(Duration(seconds=_ACKNOWLEDGE_S))
        if self._demand_log and (problem := self._demand_log.write()):
            self.get_logger().error(problem)

    def _start_over(self) -> None:
        assert self._stepper is not None
        self._stepper.start_over()
        self._began_anew()

    def _began_anew(self) -> None:
        """A run begins: what was before it does not go on."""
        assert self._stepper is not None
        self._restarts = self._stepper.restarts
        if self._demand_log:
            self._demand_log.pause()
        self._answer = None

    # Inputs

    def _take_inputs(self) -> None:
        """Real time: judge the newest message of every topic."""
        assert self._controller is not None
        monitor, now_ns = self._controller.monitor, self._now_ns()
        ahead_ns = now_ns - time.time_ns()  # of DDS, which tells when an unstamped message was sent
        for topic, reader in self._readers.items():
            for data, info in self._intake.take(topic):
                for reading in reader(data, info["source_timestamp"] + ahead_ns):
                    self._judge(monitor, reading, now_ns)

    def _judge(self, monitor: InputMonitor, reading: Any, now_ns: int) -> None:
        kind = type(reading)
        if kind is SpeedReading:
            monitor.take_speed(reading, now_ns)
        elif kind is JointReading:
            monitor.take_wheels(reading, now_ns)
        elif kind is BatteryReading:
            monitor.take_battery(reading, now_ns)
        elif kind is DemandReading:
            monitor.take_demand(reading.power_w, (now_ns - reading.stamp_ns) / _NS_PER_S, now_ns)
        elif kind is FrictionReading:
            monitor.take_friction(reading.friction, now_ns)
        elif kind is TorqueReading:
            monitor.take_torques(reading)
        elif kind is DirectionReading:
            monitor.direction = reading.direction

    def _on_demand(self, data: bytes, info: dict[str, Any]) -> None:
        """Lock-step: the demand closes a set."""
        if self._active and self._demand_reader is not None:
            assert isinstance(self._stepper, Lockstep)
            sent_ns = info["source_timestamp"]
            for reading in self._demand_reader(data, sent_ns):
                if isinstance(reading, DemandReading):
                    self._stepper.queue.push_demand(sent_ns, reading.power_w)
            # Topics are not ordered among each other: what was sent before may still be a moment away.
            for _ in range(_SET_PATIENCE):
                self._collect_sets()
                if self._stepper is None or not self._stepper.queue.waiting:
                    break
                time.sleep(_SET_POLL_S)

    def _collect_sets(self) -> None:
        if not isinstance(self._stepper, Lockstep):
            return
        monitor, queues = self._stepper.controller.monitor, self._stepper.queue
        for topic, reader in self._readers.items():
            for data, info in self._intake.take(topic):
                for reading in reader(data, info["source_timestamp"]):
                    queue = _QUEUES.get(type(reading))
                    if queue is not None:
                        queues.push(queue, reading.stamp_ns, info["source_timestamp"], reading)
                    else:
                        self._judge(monitor, reading, self._now_ns())
        self._step_complete_sets()

    # Steps

    def step_when_due(self) -> bool:
        """Sleep until the next control step is due, then take it, ahead of any executor.

        An executor that wakes for a timer first goes through all that it serves, some 200 us, before it calls it. Those
        are better spent after the step. The timer stays an ordinary one: in another executor the node steps as well.

        Returns
        -------
        whether there was a step to wait for: not in lock-step, on simulated time, or while inactive
        """
        timer = self._step_timer
        if timer is None or self.get_clock().ros_time_is_active:
            return False
        left_ns = timer.time_until_next_call()
        if left_ns is None or left_ns > timer.timer_period_ns:
            return False  # the system's clock was set back: services and watchdog must not wait for it to catch up
        time.sleep(max(left_ns, 0) / _NS_PER_S)
        with timer.handle:
            timer.handle.call_timer()
        self._on_step_timer()
        return True

    def _on_step_timer(self) -> None:
        assert isinstance(self._stepper, RealTime)
        self._stepper.begin(None if self.get_clock().ros_time_is_active else time.monotonic())
        self._take_inputs()
        started_s = time.perf_counter()
        self._take(self._stepper.step(self._now_ns()), started_s)
        if self._report_due:
            # Right after a step there is the most time until the next.
            self._publish_report()

    def _step_complete_sets(self) -> None:
        if not self._active or not isinstance(self._stepper, Lockstep):
            return
        started_s = time.perf_counter()
        for taken in self._stepper.steps():
            self._take(taken, started_s)
            started_s = time.perf_counter()
            if not self._active:
                break

    def _take(self, taken: Taken, started_s: float) -> None:
        """Send what came of a step."""
        assert self._stepper is not None
        self._last_step_steady_s = time.monotonic()
        if taken.fault:
            self.fail(taken.fault)
            return
        if self._stepper.restarts != self._restarts:
            self._began_anew()
        if taken.step is None:
            if self._answer is not None:
                self._publish(self._answer)
            return
        command, numbers = taken.step
        stamp_ns = taken.stamp_ns
        assert self._write_state is not None
        self._answer = [
            *self._commands[MOTOR](stamp_ns, command.motor_torque_nm),
            *self._commands[FRICTION](stamp_ns, command.friction_torque_nm),
            (NODE_STATE, self._write_state(stamp_ns, numbers)),
        ]
        if not self._publish_in_time(self._answer):
            return
        if self._demand_log:
            self._demand_log.note(taken.stamp_ns, numbers)
        self._report.note_step(command, taken.since_s, time.perf_counter() - started_s)

    def _publish_in_time(self, answer: list[tuple[str, bytes]]) -> bool:
        """Publish what came of a step; each message only if the process was not held up before it."""
        for topic, data in answer:
            if isinstance(self._stepper, RealTime) and not self._stepper.may_send(time.monotonic()):
                return False
            self._publishers_made[topic].publish(data)
        return True

    def _publish(self, answer: list[tuple[str, bytes]]) -> None:
        for topic, data in answer:
            self._publishers_made[topic].publish(data)

    def _command_zero(self) -> None:
        now_ns = self._now_ns()
        for write in self._commands.values():
            self._publish(write(now_ns, _ZERO))

    # Parameters

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        if self._active and self._values["lock_parameters"]:
            return SetParametersResult(successful=False, reason="lock_parameters: nothing changes while active")

        def together(new: dict[str, Any]) -> str:
            problem = config.check_together(self._values | new)
            if not problem and self._policies and "strategy" in new:
                problem = self._policies.problem_with(new["strategy"])
            return problem

        return check_change(config.BY_NAME, parameters, configured=self._controller is not None, together=together)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Hand changed values to the controller; torque follows within the law's own rate limits."""
        new = {parameter.name: parameter.value for parameter in parameters if parameter.name in config.BY_NAME}
        self._values |= new
        if new and self._controller and self._policies:
            if "strategy" in new:
                self._policies.strategy = new["strategy"]
            self._controller.settings = config.law_settings(self._values, self._policies.strategy)
            self._choose_friction()

    def _choose_friction(self) -> None:
        assert self._controller is not None
        assert self._policies is not None
        source = self._values["friction_source"]
        self._controller.table_of = self._policies.table if source == config.ESTIMATED else None
        if source == config.ESTIMATED:
            return
        friction: float = self._values["friction"]
        monitor = self._controller.monitor
        if source == config.TOPIC:
            age_s = monitor.tallies[messages.ROAD_FRICTION].age_s(self._now_ns())
            if age_s <= self._values["friction_timeout_s"]:
                friction = monitor.friction
        if friction != self._controller.friction:
            self._controller.policy = self._policies.table(friction)
            self._controller.friction = friction

    # Off the control path

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _lifecycle_state(self) -> str:
        return str(self._state_machine.current_state[1])

    def _watch(self) -> None:
        """Ten times a second of real time: friction, a clock that stands still, reports on change.

        It also wakes the executor often enough for a signal to be noticed, and goes on with the start.
        """
        if self._preparation is not None:
            self._says.preparing(self._preparation.elapsed_s)
        if self._starting:
            self._go_on_starting()
        controller = self._controller
        stepping = self._active and not self._lockstep
        if self._active and controller:
            if self._lockstep:
                self._collect_sets()
            self._choose_friction()
            standing_s = time.monotonic() - self._last_step_steady_s
            if stepping and standing_s > self._values["clock_stopped_s"]:
                stepping = False
                self._fault = "the clock stands still"
                self._start_over()
                self._command_zero()
            elif self._fault and self._stepper is not None and self._stepper.last_ns is not None:
                self._fault = ""
            self._says.stepped(controller, self._topics, self._unheard)
        shown = controller and (
            controller.supervision.mode,
            controller.supervision.stale,
            controller.wheels_lost,
            controller.actuators.gains,
        )
        gate = controller and controller.command and controller.command.gate
        if self._changes.changed((self._active, self._fault, shown, gate), time.monotonic()):
            self._report_soon(stepping)

    def _on_report_timer(self) -> None:
        self._report_soon(self._active and not self._lockstep)

    def _report_soon(self, stepping: bool) -> None:
        """Report at once, or, while there are control steps at a rate, right after the next one."""
        if stepping:
            self._report_due = True
        else:
            self._publish_report()

    def _publish_report(self) -> None:
        self._report_due = False
        now_ns = self._now_ns()
        message = self._report.message(
            now_ns, self._lifecycle_state(), self._controller, self._values, self._own_statuses()
        )
        self._diagnostics.publish(message)
        if self._demand_log:
            self._demand_log.write_if_due()
        if self._controller and self._values["gc_off_path"]:
            realtime.collect()

    def _own_statuses(self) -> list[diagnostics.Status]:
        statuses = []
        if self._fault:
            statuses.append(diagnostics.Status("fault", diagnostics.ERROR, self._fault, {}))
        if self._policies:
            statuses.append(self._policies.status())
        if self._demand_log:
            statuses.append(self._demand_log.status())
        if self._active:
            statuses += self._topic_statuses()
        return statuses

    def _topic_statuses(self) -> list[diagnostics.Status]:
        """Who else is on the topics: other commanders, and whoever cannot be connected with."""
        counts = {topic: self.count_publishers(topic) for topic in self._command_topics}
        others = [f"{topic} has {count} publishers" for topic, count in counts.items() if count > 1]
        deaf = mismatched_subscribers(self, self._publishers_made.values(), self._msgtypes)
        problems = [*others, *(f"{topic}: {why}" for topic, why in deaf.items())]
        values = {f"{topic}: publishers": str(count) for topic, count in counts.items()}
        level = diagnostics.ERROR if problems else diagnostics.OK
        statuses = [diagnostics.Status("command topics", level, "; ".join(problems) or "ok", values)]
        of_demand = [self._demand_subscription] if self._demand_subscription else []  # in lock-step
        subscriptions = [*self._intake.subscriptions(), *of_demand]
        mismatches = mismatched_publishers(self, subscriptions, self._msgtypes)
        unheard = [f"{topic}: {why}" for topic, why in mismatches.items()]
        senders = {found.topic_name: self.count_publishers(found.topic_name) for found in subscriptions}
        self._unheard = {topic: "no publisher" for topic, count in senders.items() if not count} | mismatches
        several = [f"{topic} has {count} publishers" for topic, count in senders.items() if count > 1]
        if unheard or several:
            level = diagnostics.ERROR if unheard else diagnostics.WARN
            statuses.append(diagnostics.Status("input topics", level, "; ".join([*unheard, *several]), {}))
        self._says.problems([*problems, *unheard, *several])
        return statuses


_EXAMPLES = """\
  The car of the paper, its inputs on the package's own topics:
    power_manager
  Your car, its policies and its topics:
    power_manager --ros-args -p vehicle_file:=my_car.yaml -p policy_file:=my_policies -p signals_file:=my_signals.yaml
  Everything from one file, in a namespace:
    power_manager --ros-args --params-file config/nodes/power_manager.yaml -r __ns:=/car_1
"""


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; exit code 1 and one line if it cannot start."""
    # rclpy's own handlers would shut the context down before zero torque could be commanded.
    interruption = Interruption()
    interruption.install()
    node: PowerManager | None = None
    code = 1
    try:
        check_parameter_files(sys.argv if args is None else args)
        check_arguments(
            "power_manager",
            "Splits the driver's power demand between four motors, until Ctrl-C.",
            config.SPECS,
            args,
            examples=_EXAMPLES,
        )
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = PowerManager()
        interruption.started = True
        if node.get_parameter("autostart").value:
            node.start_when_prepared()
        _spin(node, interruption)
        code = 1 if node.start_failed and not interruption.requested else 0
    except KeyboardInterrupt:
        code = 0  # ended before it had begun
    except (IwmError, RuntimeError) as error:
        print(f"power_manager: {str(error).splitlines()[0]}", file=sys.stderr)
    finally:
        compiling = node is not None and node.preparing
        with ending.bounded(code):
            if node is not None:
                node.stop()
                node.destroy_node()
                node = None
        if compiling:  # its thread would be waited for
            os._exit(code)
    return code


def _spin(node: PowerManager, interruption: Interruption) -> None:
    """Step in time and serve callbacks, until a signal asks to end."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not interruption.requested and not node.start_failed:
        try:
            # What else is ready follows each step; where there are none the executor waits.
            executor.spin_once(timeout_sec=0.0 if node.step_when_due() else None)
        except Exception as error:  # noqa: BLE001 - whatever it is, the motors must not be left with a command
            node.fail(f"{type(error).__name__}: {error}")
    node.stop()
    executor.shutdown()


if __name__ == "__main__":
    sys.exit(main())
