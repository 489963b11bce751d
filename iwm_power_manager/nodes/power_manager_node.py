# SPDX-License-Identifier: Apache-2.0
"""The managed node `power_manager`: DDS, the clock, the lifecycle and nothing else.

Configure loads and verifies vehicle and policy and warms the compiled law; activate starts commanding; deactivate
commands zero torque first. Everything it decides, it decides in `control.controller`. What it hears is in
`power_manager_inputs`, what it sends in `power_manager_outputs`. See docs/interface.md for topics and parameters,
docs/safety.md for the reasons.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from iwm_power_manager.control.controller import Controller
from iwm_power_manager.control.execution import COMPILED
from iwm_power_manager.control.stepping import HELD_UP, Lockstep, RealTime, Taken
from iwm_power_manager.errors import IwmError, of_parameter, one_line
from iwm_power_manager.nodes import neighbours, pace
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.nodes.announcements import Announcements, input_topics, silent_topics
from iwm_power_manager.nodes.compiling import Compiling, law_status
from iwm_power_manager.nodes.demand_log import DemandLog
from iwm_power_manager.nodes.policy_choice import Policies
from iwm_power_manager.nodes.power_manager_inputs import Inputs
from iwm_power_manager.nodes.power_manager_outputs import Outputs
from iwm_power_manager.nodes.power_manager_report import ChangeDetector, PowerManagerReport
from iwm_power_manager.nodes.preparation import Prepared
from iwm_power_manager.nodes.starting import Starting
from iwm_power_manager.ros import diagnostics, messages, realtime
from iwm_power_manager.ros.parameters import ParameterError, check_change, declare
from iwm_power_manager.signals.commands import FRICTION
from iwm_power_manager.signals.contract import CLOCK, NODE_FRICTION, NODE_STATE

#: How often, and how far apart, the rest of a set is looked for once its demand is there; later the watchdog looks.
_SET_PATIENCE = 20
_SET_POLL_S = 0.0002
#: The watchdog also wakes the executor often enough for signals to be noticed.
_WATCHDOG_PERIOD_S = 0.1
_REPORT_PERIOD_S = 1.0
#: Diagnostics on change come no faster than this: a gate may open and close at the control rate.
_CHANGE_PERIOD_S = 0.1
_STANDS_STILL = "the clock stands still"


class PowerManager(Starting):
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
        self._compiling: Compiling | None = None
        self._demand_log: DemandLog | None = None
        self._inputs: Inputs | None = None
        self._outputs: Outputs | None = None
        self._step_timer: Any = None
        self._active = False
        self._fault = ""
        self._wheel_names: tuple[str, ...] = tuple(self._values["wheel_names"])
        self._period_s = 1.0 / self._values["rate_hz"]
        self._last_step_steady_s = 0.0
        self._answer: list[tuple[str, bytes]] | None = None
        self._topics: dict[str, tuple[str, ...]] = {}
        self._remarks: Callable[[], dict[str, tuple[bool, str]]] = dict
        self._unheard: dict[str, str] = {}
        self._says = Announcements(self.get_logger())
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._report = PowerManagerReport(self.get_fully_qualified_name(), self._wheel_names, None, {})
        self._report_due = False
        self._changes = ChangeDetector(_CHANGE_PERIOD_S)
        self.create_timer(_REPORT_PERIOD_S, self._on_report_timer)
        self.create_timer(_WATCHDOG_PERIOD_S, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take over what was prepared (or prepare it now), then appear on the topics."""
        self._values = self.present_values()
        self._fault = ""
        try:
            prepared = self.take_preparation(self._values)
            self._adopt(prepared)
            self._appear(prepared)
        except Exception as error:  # noqa: BLE001 - whatever stood behind it, the log and /diagnostics have the reason
            self._fault = str(error) if isinstance(error, IwmError) else one_line(f"{type(error).__name__}: {error}")
            self.get_logger().error(self._fault)
            self._release()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def _appear(self, prepared: Prepared) -> None:
        """Be on the topics, and as the system is asked to run the process."""
        # Publishers and subscriptions of everything the signals file names, and of the state.
        self._outputs = Outputs(self, prepared, None if self._lockstep else self._period_s)
        self._inputs = Inputs(self, prepared.readers, self._on_demand if self._lockstep else None)
        refused = realtime.request(self._values["realtime_priority"], self._processors, self._values["lock_memory"])
        for what in refused:
            self.get_logger().warning(f"the system refused {what}")
        if self._values["gc_off_path"]:
            realtime.stop_automatic_collection()
        rate = "in lock-step" if self._lockstep else f"{self._values['rate_hz']:g} Hz"
        resolved = [self.resolve_topic_name(topic) for topic in self._outputs.topics]
        self._says.interface(self._topics, resolved, rate)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start commanding, from the law's initial state."""
        self._fault = ""
        assert self._inputs is not None
        self._inputs.drop_all()
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

    def stop(self) -> None:
        """Deactivate, if active."""
        if self._active:
            self.trigger_deactivate()

    def fail(self, problem: str) -> None:
        """Zero torque, inactive, and the reason on `/diagnostics`: the state every unexpected error leads to."""
        self._fault = problem
        self.get_logger().fatal(f"zero torque and inactive: {problem}")
        self.stop()

    def _adopt(self, prepared: Prepared) -> None:
        """Drive with what was prepared; `ConfigError` if its topics get in each other's way."""
        own = [self.resolve_topic_name(topic) for topic in (NODE_STATE, NODE_FRICTION)]
        with of_parameter("signals_file"):
            prepared.mapping.check_topics(self.resolve_topic_name, own)
        self._says.prepared(prepared)
        values = self._values
        self._wheel_names = tuple(values["wheel_names"])
        self._period_s = 1.0 / values["rate_hz"]
        self._controller, self._policies, self._remarks = prepared.controller, prepared.policies, prepared.remarks
        self._topics = {
            name: tuple(map(self.resolve_topic_name, topics)) for name, topics in input_topics(prepared.mapping).items()
        }
        self._stepper = (
            Lockstep(self._controller, self._period_s)
            if self._lockstep
            else RealTime(self._controller, self._period_s, config.thresholds_of(values))
        )
        if prepared.load is not None:
            self._compiling = Compiling(values, prepared.load)
        if values["demand_log"]:
            path, period_s = Path(values["demand_log"]), values["demand_log_period_s"]
            with of_parameter("demand_log"):
                self._demand_log = DemandLog(path, period_s, self._controller.policy, prepared.vehicle.params)
        rate_hz = None if self._lockstep else values["rate_hz"]
        brakes = "commanded" if prepared.mapping.commands[FRICTION] else "another system"
        car = {"vehicle": prepared.vehicle.name, "friction brakes": brakes}
        self._report = PowerManagerReport(self.get_fully_qualified_name(), self._wheel_names, rate_hz, car)

    def _release(self) -> None:
        for entities in (self._inputs, self._outputs):
            if entities is not None:
                entities.close()
        self._inputs = self._outputs = None
        self._unheard = {}
        self._controller = None
        self._stepper = None
        self._policies = None
        if self._compiling:
            self._compiling.stop()
            self._compiling = None
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
        assert self._outputs is not None
        self._outputs.zero(self._now_ns())
        self._outputs.wait()
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

    # Lock-step

    def _on_demand(self, data: bytes, info: dict[str, Any]) -> None:
        """Take the demand, which closes a set."""
        if self._active and self._inputs is not None:
            assert isinstance(self._stepper, Lockstep)
            self._inputs.push_demand(self._stepper.queue, data, info)
            # Topics are not ordered among each other: what was sent before may still be a moment away.
            for _ in range(_SET_PATIENCE):
                self._collect_sets()
                if self._stepper is None or not self._stepper.queue.waiting:
                    break
                time.sleep(_SET_POLL_S)

    def _collect_sets(self) -> None:
        if not isinstance(self._stepper, Lockstep):
            return
        assert self._inputs is not None
        self._inputs.collect(self._stepper.queue, self._stepper.controller.monitor, self._now_ns())
        self._step_complete_sets()

    # Steps

    def step_when_due(self) -> bool:
        """Sleep until the next control step is due, then take it; whether there was one to wait for (`pace.wait`)."""
        due = self._step_timer is not None and not self.get_clock().ros_time_is_active and pace.wait(self._step_timer)
        if due:
            self._on_step_timer()
        return due

    def _on_step_timer(self) -> None:
        assert isinstance(self._stepper, RealTime)
        self._stepper.begin(None if self.get_clock().ros_time_is_active else time.monotonic())
        assert self._inputs is not None
        self._inputs.take(self._stepper.controller.monitor, self._now_ns())
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
        assert self._outputs is not None
        self._last_step_steady_s = time.monotonic()
        if taken.fault:
            self.fail(taken.fault)
            return
        if self._stepper.restarts != self._restarts:
            if isinstance(self._stepper, RealTime):
                self._says.started_over(self._stepper.reason)
            self._began_anew()
        if taken.step is None:
            if self._answer is not None:
                self._outputs.publish(self._answer)
            return
        assert self._controller is not None
        supervision = self._controller.supervision
        if stale := supervision.stale:
            self._says.late(stale, self._controller.monitor.ages_s(taken.stamp_ns))
        self._answer = self._outputs.answer(taken.stamp_ns, taken.step)
        if isinstance(self._stepper, RealTime):
            if not self._outputs.publish(self._answer, self._stepper.may_send):
                return
        else:
            self._outputs.publish(self._answer)
        if self._demand_log:
            self._demand_log.note(taken.stamp_ns, taken.step.values)
        elapsed_s = time.perf_counter() - started_s
        asked_w = self._controller.monitor.demand_w
        self._report.note_step(taken.step.command, supervision, asked_w, taken.since_s, elapsed_s)

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
        for name, value in new.items():
            idle = name == "friction" and self._values["friction_source"] != "parameter"
            remark = f" (no effect while friction_source is {self._values['friction_source']})" if idle else ""
            self.get_logger().info(f"parameter {name} is {value} now{remark}")
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

    def _watch(self) -> None:
        """Ten times a second of real time: friction, a clock that stands still, reports on change.

        It also wakes the executor often enough for a signal to be noticed, and goes on with the start.
        """
        if self.preparing_s is not None:
            self._says.preparing(self.preparing_s)
        self.go_on_starting()
        controller = self._controller
        if controller and self._compiling:
            self._go_over(controller, self._compiling)
        stepping = self._active and not self._lockstep
        if self._active and controller:
            if self._lockstep:
                self._collect_sets()
            self._choose_friction()
            standing_s = time.monotonic() - self._last_step_steady_s
            if stepping and standing_s > self._values["clock_stopped_s"]:
                stepping = False
                if not self.get_clock().ros_time_is_active:
                    self._says.started_over(HELD_UP)
                    self._fault = "no control step: this process was held up, or the system's clock was set back"
                elif not self._fault.startswith(_STANDS_STILL):
                    clock, self._fault = self.resolve_topic_name(CLOCK), _STANDS_STILL
                    if not self.count_publishers(clock):
                        self._fault += f" (use_sim_time is true, {clock} has no publisher)"
                    self.get_logger().warning(f"{self._fault}: zero torque")
                self._start_over()
                assert self._outputs is not None
                self._outputs.zero(self._now_ns())
            elif self._fault and self._stepper is not None and self._stepper.last_ns is not None:
                self._fault = ""
            self._says.pedals(self._remarks())
            heard_ns = self._inputs.heard_ns if self._inputs else {}
            if not self._fault.startswith(_STANDS_STILL):  # until it goes on nobody looks for messages
                self._says.stepped(controller, self._topics, self._unheard, self._wheel_names, self._now_ns(), heard_ns)
        shown = controller and (
            controller.supervision.mode,
            controller.supervision.stale,
            controller.wheels_lost,
            controller.actuators.gains,
            controller.brake_gain,
        )
        gate = controller and controller.command and controller.command.gate
        law = controller and law_status(controller.execution, self._compiling).message
        if self._changes.changed((self._active, self._fault, shown, gate, law), time.monotonic()):
            self._report_soon(stepping)

    def _go_over(self, controller: Controller, compiling: Compiling) -> None:
        """Go on with the compiled law, once it is there."""
        if compiling.ended and not compiling.problem and controller.execution is not COMPILED:
            try:
                controller.run_by(COMPILED)
            except Exception as error:  # noqa: BLE001 - it drives as it is
                compiling.problem = one_line(f"{type(error).__name__}: {error}")
            if self._values["gc_off_path"]:
                realtime.keep()
        self._says.law(law_status(controller.execution, compiling))

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
        extra = self.own_statuses()
        heard_ns = self._inputs.heard_ns if self._inputs else {}
        silent = {name: silent_topics(found, self._unheard, now_ns, heard_ns) for name, found in self._topics.items()}
        message = self._report.message(now_ns, self.lifecycle_state(), self._controller, self._values, extra, silent)
        self._diagnostics.publish(message)
        if self._demand_log:
            self._demand_log.write_if_due()
        if self._controller and self._values["gc_off_path"]:
            realtime.collect()

    def own_statuses(self) -> list[diagnostics.Status]:
        """What the node says of itself beside the controller's report: a fault, its policy, its log of demands."""
        statuses = []
        if self._fault:
            statuses.append(diagnostics.Status("fault", diagnostics.ERROR, self._fault, {}))
        if self._controller:
            statuses.append(law_status(self._controller.execution, self._compiling))
        if self._policies:
            statuses.append(self._policies.status())
        if self._demand_log:
            statuses.append(self._demand_log.status())
        if self._active and self._inputs is not None and self._outputs is not None:
            slow = {} if self._lockstep else self._inputs.slow(self._topics, self._values, self._now_ns())
            found = neighbours.look(self, self._inputs, self._outputs, slow)
            self._unheard = found.unheard
            self._says.commands(found.unobeyed)
            self._says.problems([*found.problems, *self._report.doubts])
            statuses += found.statuses
        return statuses
