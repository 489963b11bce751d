# SPDX-License-Identifier: Apache-2.0
"""How the law is run: compiled or, until there is something compiled, as plain Python. Both give the same bits.

As plain Python a step takes some 0.1 ms. Only a strategy that compares many shares takes longer, 8 ms where the demand
is restless: until the law is compiled the power is split equally, whatever strategy was chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager.control import repeat
from iwm_power_manager.control.record import decided
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.types import GATE_NONE, Command, ControllerState, Measurement
from iwm_power_manager.held import Held
from iwm_power_manager.interpreted import interpreted
from iwm_power_manager.model.parameters import VehicleParams


class Execution(NamedTuple):
    """One way to run the law.

    Attributes
    ----------
    hold : makes of a value what the other two find it in, as `value`
    advance, battery_limits : as in `control.repeat`
    strategy : code of the only strategy that is fast enough; None: any is
    faults : what went wrong in steps, each once
    """

    hold: Callable[[Any], Any]
    advance: Callable[..., Any]
    battery_limits: Callable[..., tuple[float, float]]
    strategy: int | None
    faults: list[str]


COMPILED = Execution(Held, repeat.advance, repeat.battery_limits, None, [])


def plain_python() -> Execution:
    """The law as plain Python.

    No step of it may be lost: where one raises what compiled code does not, the friction brakes alone do what the
    driver asks for.
    """
    plain: Any = interpreted(repeat.advance)
    faults: list[str] = []

    def step(measurement: Measurement, before: Any, after: Any, settings: Any, vehicle: Any, policy: Any) -> Any:
        try:
            with np.errstate(all="ignore"):
                return plain(measurement, before, after, settings, vehicle, policy)
        except Exception as error:  # noqa: BLE001 - whatever it is, a demand to brake gets through
            fault = f"{type(error).__name__}: {error}"
            if fault not in faults:
                faults.append(fault)
            state: ControllerState = before.value
            after.value = state
            command = braked(measurement, vehicle.value)
            return command, decided(command, state, state), state.friction.assumed

    return Execution(_hold, step, interpreted(repeat.battery_limits), STRATEGIES["equal"].code, faults)


def _hold(value: Any) -> SimpleNamespace:
    return SimpleNamespace(value=value)


def braked(measurement: Measurement, vehicle: VehicleParams) -> Command:
    """A command without the law: no motor torque, and a demand to brake spread over the friction brakes."""
    asked_w = min(measurement.power_demand_w, 0.0)
    fastest = max(map(abs, measurement.wheel_speed_radps))
    torques = []
    for axle in (vehicle.front, vehicle.rear):
        speed = max(fastest, vehicle.driver.power_speed_floor_mps / axle.wheel.radius_m)
        torques.append(max(asked_w / (4.0 * speed), -axle.friction_brake.max_torque_nm))
    front, rear = torques
    return Command(
        motor_torque_nm=(0.0, 0.0, 0.0, 0.0),
        friction_torque_nm=(front, front, rear, rear),
        brake_gain=(1.0, 1.0, 1.0, 1.0),
        front_share=0.5,
        decided_share=0.5,
        gate=GATE_NONE,
        limits=0,
        front_power_w=2.0 * front * fastest,
        rear_power_w=2.0 * rear * fastest,
        front_slip=0.0,
        rear_slip=0.0,
        gated_wheels=0,
        speed_mps=0.0 if math.isnan(measurement.speed_mps) else measurement.speed_mps,
        doubted=0,
        hold_nm=0.0,
        left_friction=measurement.friction,
        right_friction=measurement.friction,
        left_confidence=0.0,
        right_confidence=0.0,
    )
