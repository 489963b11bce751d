# SPDX-License-Identifier: Apache-2.0
"""The last look at a command before it leaves: independent of how it came about.

The law applies every limit itself, in its stated order. This check knows nothing of that order; it only knows what no
motor and no brake of this car may ever be asked for, so that a fault in the law ends in zero torque, not in the road.
"""

from __future__ import annotations

import math

from iwm_power_manager.control.types import GATE_BOTH, GATE_FRONT, GATE_NONE, GATE_REAR, Command
from iwm_power_manager.model.parameters import VehicleParams

#: Rounding may lift a torque this far above its limit.
_SLACK_NM = 1e-6


def violated_bound(command: Command, vehicle: VehicleParams) -> str:
    """Which bound a command violates; "" if none.

    Every number is finite, every motor torque within the peak torque, every friction torque between full braking and
    zero, and a gated wheel has no torque at all.
    """
    if command.gate not in (GATE_NONE, GATE_FRONT, GATE_REAR, GATE_BOTH):
        return f"gate {command.gate} does not exist"
    if command.gate != (command.gated_wheels & 3 == 3) + 2 * (command.gated_wheels & 12 == 12):
        return f"gate {command.gate} is not that of the gated wheels {command.gated_wheels}"
    for i, (motor, friction) in enumerate(zip(command.motor_torque_nm, command.friction_torque_nm, strict=True)):
        axle = vehicle.front if i < 2 else vehicle.rear
        peak, brake = axle.motor.peak_torque_nm, axle.friction_brake.max_torque_nm
        if not math.isfinite(motor) or not math.isfinite(friction):
            return f"torque of wheel {i} is not finite: motor {motor}, friction {friction}"
        if abs(motor) > peak + _SLACK_NM:
            return f"motor torque of wheel {i} is {motor:g} N m, beyond {peak:g}"
        if not -brake - _SLACK_NM <= friction <= 0.0:
            return f"friction torque of wheel {i} is {friction:g} N m, outside {-brake:g}..0"
        if command.gated_wheels >> i & 1 and (motor != 0.0 or friction != 0.0):
            return f"wheel {i} is gated and has {motor:g} + {friction:g} N m"
    return ""
