# SPDX-License-Identifier: Apache-2.0
"""What the law may remember at a recorded step, where steps before it are missing in the record."""

from __future__ import annotations

from collections.abc import Sequence

from iwm_power_manager.control.budget import buckets
from iwm_power_manager.control.persistence import SAMPLE_S
from iwm_power_manager.control.record import DECIDED, command_of, measurement_of
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import ControllerState, SideGrip, WheelState, initial_state

#: A restless drive: how far its demand jumps, W, and how little of a jump lasts.
_RESTLESS_W = 3000.0
_LASTING = 0.1
#: The same for what a slope, or the car's load, does to it, m/s2, and for how long torques have been unequal.
_SLOPE_MPS2 = 3.0
_LONG_S = 10.0


def possible_memories(
    before: ControllerState, step: int, recorded: Sequence[float], table: PolicyTable
) -> list[ControllerState]:
    """What the law may remember at a step: all it does at the first of a run; what it may where steps are missing.

    The first is what a replay goes on with: the memory before the gap, or what the record shows of it. The others are
    extremes of what it does not show: uphill, and downhill with a restless demand and all changes of the split used up.
    """
    new = initial_state()
    if step == 0:
        return [new]
    m, command = measurement_of(recorded), command_of(recorded[DECIDED])
    heats = recorded[DECIDED][-2:]
    travel = -1.0 if m.speed_mps < 0.0 else 1.0

    def wheel(i: int) -> WheelState:
        torque_nm = travel * (command.motor_torque_nm[i] + command.brake_gain[i] * command.friction_torque_nm[i])
        slip = command.front_slip if i < 2 else command.rear_slip
        gated = bool(command.gated_wheels >> i & 1)
        motor_nm, speed_radps = travel * command.motor_torque_nm[i], travel * m.wheel_speed_radps[i]
        return WheelState(motor_nm, torque_nm, speed_radps, torque_nm, slip, gated, heats[i // 2])

    shown = new._replace(
        wheels=(wheel(0), wheel(1), wheel(2), wheel(3)),
        split=new.split._replace(
            decisions=step, age_s=m.dt_s, decided_share=command.decided_share, applied_share=command.front_share
        ),
        motion=new.motion._replace(speed_mps=command.speed_mps, shown_mps=m.speed_mps, brake_gain=command.brake_gain),
        travel=travel,
        hold_nm=command.hold_nm,
        friction=new.friction._replace(
            left=SideGrip(command.left_friction, command.left_confidence),
            right=SideGrip(command.right_friction, command.right_confidence),
            assumed=m.friction,
        ),
    )
    uphill = shown._replace(motion=shown.motion._replace(bias_mps2=-_SLOPE_MPS2))
    demand_w2 = m.power_demand_w**2 + _RESTLESS_W**2
    jitter = shown.split.jitter._replace(
        age_s=0.5 * SAMPLE_S, taken=step, variance_w2=demand_w2, covariance_w2=-0.4 * demand_w2, gain=_LASTING
    )
    downhill = shown._replace(
        split=shown.split._replace(
            age_s=0.0,
            changes_used=buckets(table.changes_per_min),
            decided_share=1.0 - command.decided_share,
            jitter=jitter,
        ),
        front_unequal_s=_LONG_S,
        rear_unequal_s=_LONG_S,
        motion=shown.motion._replace(bias_mps2=_SLOPE_MPS2),
    )
    first = before if before.steps else shown
    return [memory._replace(steps=step) for memory in (first, uphill, downhill)]
