# SPDX-License-Identifier: Apache-2.0
"""The power manager without ROS: inputs in, one step out.

Holds what lives from step to step (latest inputs, degraded state, the law's memory) and does one thing: turn them into
a command that is finite and inside every limit. The node adds DDS, the clock and the lifecycle; tests and replays use
this class as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from iwm_power_manager.control.actuators import ActuatorLimits, ActuatorState, commanded, judge
from iwm_power_manager.control.alignment import LATEST_S, NO_SHIFT, Alignment, arrived_nm
from iwm_power_manager.control.execution import COMPILED, Execution
from iwm_power_manager.control.guard import violated_bound
from iwm_power_manager.control.inputs import WheelVerdict
from iwm_power_manager.control.monitor import SPEED, WHEELS, InputLimits, InputMonitor
from iwm_power_manager.control.motion import DOUBT_SPEED
from iwm_power_manager.control.record import Watch, to_numbers
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.supervision import (
    LOCKSTEP_SUPERVISION,
    STALE_DEMAND,
    STALE_SPEED,
    STALE_WHEELS,
    Supervision,
    SupervisionLimits,
    shape_demand,
    stale_inputs,
    supervise,
)
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import Command, ControllerState, Measurement, Wheels, initial_state
from iwm_power_manager.model.parameters import VehicleParams

#: While a wheel is lost, slip is judged this much more strictly: its axle is watched through one wheel only. What the
#: car slows down within the limiter's time constant, by which this trails its target, is to be as much less.
LOST_WHEEL_SLIP_FACTOR = 0.75
#: A speed is overdue after so many of the times that were between its last two; beyond so many s nobody waits for it.
OVERDUE, LONGEST_WAIT_S = 2.0, 0.3
#: Acceleration that motors are asked for which all seem dead, m/s2: no jolt if they come back, on ice either.
TRIED_MPS2 = 0.6


class ControlFaultError(RuntimeError):
    """The law returned something no motor may be given."""


class ControllerLimits(NamedTuple):
    """What the controller judges by.

    Attributes
    ----------
    inputs : checks of every message
    age_s : ages at which speed, wheels, demand and battery are missing; None in lock-step, where nothing can be missing
    supervision : times of the degraded state
    actuators : what is believed of reported motor torques
    """

    inputs: InputLimits
    age_s: tuple[float, float, float, float] | None
    supervision: SupervisionLimits
    actuators: ActuatorLimits


class Step(NamedTuple):
    """One step: what to command, and the numbers of `record.SIGNALS`."""

    command: Command
    values: list[float]


class Controller:
    """Inputs in, one step out.

    Attributes
    ----------
    monitor : takes the readings
    supervision : degraded state after the last step
    actuators : what is known of the motors
    settings, policy, friction : may be replaced between steps; torque follows through the law's own rate limits
    table_of : the policy for a friction; with it, friction and policy follow the law's estimate (None: they stay)
    command : last command
    execution : how the law is run (`run_by` changes it)

    Parameters
    ----------
    execution : how the law is run at first
    """

    def __init__(
        self,
        vehicle: VehicleParams,
        wheel_names: tuple[str, ...],
        limits: ControllerLimits,
        settings: Settings,
        policy: PolicyTable,
        friction: float,
        execution: Execution = COMPILED,
    ) -> None:
        self._vehicle = vehicle
        self._run_by(execution, initial_state())
        self._limits = limits
        self.monitor = InputMonitor(wheel_names, limits.inputs)
        self.settings = settings
        self.policy = policy
        self.friction = friction
        self.table_of: Callable[[float], PolicyTable] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget inputs and memory, as at activation."""
        self.monitor.forget()
        self.supervision = Supervision() if self._limits.age_s else LOCKSTEP_SUPERVISION
        self.actuators = ActuatorState()
        self._unreported_s = 0.0
        self._before.value = initial_state()
        self._assumed_friction: float | None = None
        self.command: Command | None = None
        front, rear = self._vehicle.front.wheel.inertia_kgm2, self._vehicle.rear.wheel.inertia_kgm2
        self._alignment = Alignment((front, front, rear, rear), self._limits.actuators.delay_s)

    def _run_by(self, execution: Execution, state: ControllerState) -> None:
        vehicle, before, after = map(execution.hold, (self._vehicle, initial_state(), initial_state()))
        before.value = state  # of the same types, or it is refused and all stays as it was
        self.execution, self._held_vehicle, self._before, self._after = execution, vehicle, before, after

    def run_by(self, execution: Execution) -> None:
        """Go on in another way, from where the law is."""
        self._run_by(execution, self.state)

    @property
    def state(self) -> ControllerState:
        """What the law remembers; takes longer to read than a step takes."""
        return self._before.value

    @property
    def wheels_lost(self) -> int:
        """Bits of the wheels that are not believed."""
        return sum(1 << i for i, verdict in enumerate(self.monitor.verdicts) if verdict is not WheelVerdict.GOOD)

    @property
    def torques_later_s(self) -> float:
        """By how much torques were found to act later than stamps and `actuator_delay_s` say."""
        return self._alignment.found.beyond_ns / 1e9

    @property
    def believed_speed_mps(self) -> float:
        """Speed of the car: as its sensor shows it; as estimated while that is missing or not believed."""
        command = self.command
        estimated = command and (self.supervision.stale & STALE_SPEED or command.doubted & DOUBT_SPEED)
        return command.speed_mps if command and estimated else self.monitor.speed_mps

    def step(self, now_ns: int, dt_s: float, elapsed_s: float | None = None) -> Step:
        """One control step.

        Parameters
        ----------
        now_ns : time of the step, as inputs are stamped
        dt_s : step the law is to take
        elapsed_s : time that really has passed, where the loop was held up and `dt_s` is bounded; None: `dt_s`.
            Torque fades by the clock; it comes back by the steps in which inputs were seen to be good

        Raises
        ------
        ControlFaultError
            The law returned a command that is not finite or beyond what the motors and brakes can do. Nothing of it may
            be sent.
        """
        age_s = self.monitor.ages_s(now_ns)
        if self._limits.age_s:
            stale = stale_inputs(age_s, self._limits.age_s)
            passed_s = max(elapsed_s or dt_s, dt_s) if stale else dt_s
            self.supervision = supervise(self.supervision, stale, passed_s, self._limits.supervision)
        self._watch_motors(dt_s)
        self._follow_estimate()
        measurement = self._measurement(now_ns, dt_s)
        settings = self._settings(age_s[1] + self.monitor.wheels_behind_s)
        command, decided, assumed = self.execution.advance(
            measurement, self._before, self._after, settings, self._held_vehicle, self.policy
        )
        problem = violated_bound(command, self._vehicle)
        if problem:
            raise ControlFaultError(problem)
        watch = Watch(self.wheels_lost, self.monitor.demand_w, age_s)
        values = to_numbers(measurement, settings, decided, self.supervision, watch)
        self._before, self._after = self._after, self._before
        self._assumed_friction = assumed
        self.command = command
        if self._limits.age_s:
            self._alignment.applied(now_ns, arrived_nm(command, measurement))
        self.actuators = commanded(self.actuators, command.motor_torque_nm, dt_s, self._limits.actuators)
        return Step(command, values)

    def _follow_estimate(self) -> None:
        """The strategy assumes the friction that was estimated in the step before."""
        if self.table_of is None:
            return
        friction = self.settings.friction_prior if self._assumed_friction is None else self._assumed_friction
        if friction != self.friction:
            self.friction = friction
            self.policy = self.table_of(friction)

    def _watch_motors(self, dt_s: float) -> None:
        """Hold what the motors report against what they were told."""
        self._unreported_s += dt_s
        reported = self.monitor.collect_torques()
        if reported is not None:
            self.actuators = judge(self.actuators, reported, self._unreported_s, self._limits.actuators)
            self._unreported_s = 0.0

    @property
    def brake_gain(self) -> Wheels:
        """Part of its friction torque that each brake seems to give."""
        return self.command.brake_gain if self.command else (1.0, 1.0, 1.0, 1.0)

    def _is_due(self, now_ns: int) -> bool:
        """Whether a speed, even if it counts as missing, is no older than its messages let expect."""
        monitor = self.monitor
        return monitor.tallies[SPEED].age_s(now_ns) <= OVERDUE * monitor.speed_interval_s <= LONGEST_WAIT_S

    def _measurement(self, now_ns: int, dt_s: float) -> Measurement:
        monitor, supervision = self.monitor, self.supervision
        speed = monitor.speed_mps
        wheels = monitor.wheel_speed_radps
        front_m, rear_m = self._vehicle.front.wheel.radius_m, self._vehicle.rear.wheel.radius_m
        # One that comes more rarely than it should is the last one in between.
        lost = supervision.stale & STALE_SPEED and not self._is_due(now_ns)
        if lost and not supervision.stale & STALE_WHEELS:
            # The wheel that slips least tells the speed best.
            radii = front_m, front_m, rear_m, rear_m
            rims = [turning * radius_m for turning, radius_m in zip(wheels, radii, strict=True)]
            speed = max(rims, key=abs) if monitor.demand_w < 0.0 else min(rims, key=abs)
        elif supervision.stale & STALE_WHEELS and not supervision.stale & STALE_SPEED:
            wheels = speed / front_m, speed / front_m, speed / rear_m, speed / rear_m
        if lost and not supervision.stale & STALE_DEMAND:
            monitor.demand_speed_mps = speed  # the sensor's last one was not that of this demand
        demand = shape_demand(monitor.demand_w, monitor.demand_speed_mps, speed, supervision)
        gains, command = self.actuators.gains, self.command
        if demand > 0.0 and command and self.actuators.all_dead:
            # Perhaps only their reports are dead. Braking, nothing is lost by doing without them.
            chassis, floor_mps = self._vehicle.chassis, self._vehicle.driver.power_speed_floor_mps
            demand = min(demand, TRIED_MPS2 * chassis.mass_kg * max(abs(command.speed_mps), floor_mps))
            gains = (1.0, 1.0, 1.0, 1.0)
        wheels_ns = monitor.tallies[WHEELS].accepted_ns
        shift = NO_SHIFT
        if self._limits.age_s and wheels_ns is not None and wheels is monitor.wheel_speed_radps:
            shift = self._alignment.shift_nm(now_ns, dt_s, wheels_ns, wheels, monitor.coarse.weights)
        discharge, charge = self.execution.battery_limits(monitor.soc, monitor.temperature_c, self._held_vehicle)
        factor = supervision.motor_factor
        return Measurement(
            speed_mps=speed,
            wheel_speed_radps=wheels,
            power_demand_w=demand,
            dt_s=dt_s,
            friction=self.friction,
            discharge_limit_w=discharge * factor,
            charge_limit_w=charge * factor,
            soc=monitor.soc,
            motor_gain=gains,
            direction=monitor.direction,
            motor_stuck_nm=self.actuators.stuck_nm,
            acceleration_mps2=monitor.motion("longitudinal_acceleration", now_ns),
            yaw_rate_radps=monitor.motion("yaw_rate", now_ns),
            lateral_mps2=monitor.motion("lateral_acceleration", now_ns),
            torque_shift_nm=shift,
        )

    def _settings(self, wheels_age_s: float) -> Settings:
        settings, factor = self.settings, LOST_WHEEL_SLIP_FACTOR
        if wheels_age_s > 0.0:
            # A loop with a delay swings unless it is slower than that by as much.
            settings = settings._replace(slip_limiter_s=settings.slip_limiter_s + min(wheels_age_s, LATEST_S))
        if self.execution.strategy is not None:
            settings = settings._replace(strategy=self.execution.strategy)
        if not self.wheels_lost:
            return settings
        return settings._replace(
            critical_slip=settings.critical_slip * factor,
            slip_target=settings.slip_target * factor,
            slip_limiter_s=settings.slip_limiter_s * factor,
            gate_hysteresis=settings.gate_hysteresis * factor,
        )
