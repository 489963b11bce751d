# SPDX-License-Identifier: Apache-2.0
"""What the road takes at least from a wheel that slips, if it is the one that the other wheels run over.

A wheel whose sensor shows a slip that it does not have looks like one on a slippery road. But the wheel before or
behind it runs over the same road, and where those two of the other axle show no difference, so does the one beside it.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.motion_vote import BEST_ROAD
from iwm_power_manager.control.types import FourWheels, Wheels, WheelState
from iwm_power_manager.control.wheel_doubt import FREE_PART
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.tyre import friction_coefficient

#: Torques that are less than this part of the load apart are of one road: be the centre of gravity a little elsewhere.
UNEQUAL_PART = 0.2
#: A wheel tells how slippery its side is if it uses at least this part of what the one in question does.
TELLING_PART = 0.5


class _Taken(NamedTuple):
    """What the road took from a wheel, as part of its load, at which slip, and whether it was gated; of their sizes.

    `curve` is what its tyre has at that slip, where the road's peak is 1.
    """

    slip: float
    used: float
    gated: bool
    curve: float


@kernel
def _taken(before: WheelState, load_nm: float, axle: Axle) -> _Taken:
    """Of a wheel with its last command; a brake that gives nothing counts for no more than a road takes at the slip."""
    slip = abs(before.slip)
    curve = friction_coefficient(slip, 1.0, axle.tyre)
    return _Taken(slip, min(abs(before.road_nm) / load_nm, BEST_ROAD * curve), before.gated, curve)


@kernel
def _grip_part(own: _Taken, other: _Taken) -> float:
    """Part of another wheel's grip that a wheel on the same road has at least.

    The curve of a tyre is hollow towards the slip: half of the slip has more than half of the force. Beyond its peak it
    falls.
    """
    if own.slip < other.slip:
        return own.slip / other.slip
    return min(own.curve / other.curve, 1.0) if other.curve > 0.0 else 1.0


@kernel
def _least_used(own: _Taken, other: _Taken, along: _Taken, across: _Taken) -> float:
    """What the road takes at least from a wheel; `other` is its axle's, `along` its side's, `across` the last.

    Where the wheel of its side takes no less than the one across and slips no more, both sides run over one road.
    """
    even = 1.0 - UNEQUAL_PART
    # One that is gated for it comes back all the way: it would be given its torque again, and have it taken again.
    margin = 1.0 if own.gated else even
    least = margin * _grip_part(own, along) * along.used
    tells = along.used > TELLING_PART * own.used
    if tells and along.used >= even * across.used and even * along.slip <= across.slip:
        part = even * _grip_part(across, other)
        least = max(least, margin * min(other.used, across.used / part if part > 0.0 else 0.0))
    return least


@kernel
def least_road_nm(before: FourWheels, vehicle: VehicleParams) -> Wheels:
    """Torque that the road takes at least from each wheel, if it is the one that the others run over."""
    chassis, front, rear = vehicle.chassis, vehicle.front.wheel.radius_m, vehicle.rear.wheel.radius_m
    w, x, y, z = before
    wheelbase = chassis.front_axle_to_cg_m + chassis.rear_axle_to_cg_m
    weight = chassis.mass_kg * GRAVITY_MPS2
    pitch = chassis.cg_height_m * ((w.road_nm + x.road_nm) / front + (y.road_nm + z.road_nm) / rear)
    front_n = max(0.5 * (weight * chassis.rear_axle_to_cg_m - pitch) / wheelbase, FREE_PART * weight)
    rear_n = max(0.5 * (weight * chassis.front_axle_to_cg_m + pitch) / wheelbase, FREE_PART * weight)
    front_nm, rear_nm = front_n * front, rear_n * rear
    a, b = _taken(w, front_nm, vehicle.front), _taken(x, front_nm, vehicle.front)
    c, d = _taken(y, rear_nm, vehicle.rear), _taken(z, rear_nm, vehicle.rear)
    return (
        front_nm * _least_used(a, b, c, d),
        front_nm * _least_used(b, a, d, c),
        rear_nm * _least_used(c, d, a, b),
        rear_nm * _least_used(d, c, b, a),
    )
