# SPDX-License-Identifier: Apache-2.0
"""A driver who keeps the lane: the crossover model of steering, with one preview point.

The driver looks a time ahead, sees how far beside the middle of the lane the car will be there, and turns the wheel so
that a car without slip angles would pass through that point (pure pursuit), with an integral for what a lasting
disturbance asks for:

    e = y + Lp sin(psi + T_lead r),   Lp = max(T_p v, L_min)
    angle of the front wheels wanted = -2 L / Lp^2 (e + 1 / T_i integral e dt)

What is seen takes the reaction time to act; arms follow with a lag, no faster than they can. Times and rates are those
of attentive people: McRuer et al., "New results in driver steering control models", Human Factors 19 (1977), for the
crossover frequency they lead to (2 to 3 rad/s); Mitschke & Wallentowitz, Dynamik der Kraftfahrzeuge, for reaction, lag
and rate. Preview and lead were chosen for two tasks that no scenario has, a car one metre beside the middle at 10 to
35 m/s, and a yaw rate of 0.2 rad/s out of nothing while braking on a uniform road: the least deviation of twelve
choices that still come to rest with half the lead or half the preview more. No braking on a split road was looked at.
"""

from __future__ import annotations

import math
from collections import deque

from iwm_power_manager.model.parameters import VehicleParams
from iwm_sim.plant import PlantState

PREVIEW_S = 0.8
LEAST_PREVIEW_M = 5.0
LEAD_S = 0.4
INTEGRAL_S = 2.0
REACTION_S = 0.2
ARMS_S = 0.1
MOST_RATE_RADPS = math.radians(800.0)
MOST_ANGLE_RAD = math.radians(540.0)


class LaneKeeper:
    """The driver's hands.

    Attributes
    ----------
    angle_rad : of the steering wheel now, positive to the left
    """

    def __init__(self, vehicle: VehicleParams, dt_s: float) -> None:
        chassis = vehicle.chassis
        self._wheelbase_m = chassis.front_axle_to_cg_m + chassis.rear_axle_to_cg_m
        self._ratio = chassis.steering_ratio
        self._dt_s = dt_s
        self._seen = deque([0.0] * max(round(REACTION_S / dt_s), 1))
        self._integral_ms = 0.0
        self.angle_rad = 0.0

    def steer(self, car: PlantState) -> float:
        """Angle of the steering wheel, rad, for the next step."""
        ahead_m = max(PREVIEW_S * abs(car.speed_mps), LEAST_PREVIEW_M)
        self._seen.append(car.y_m + ahead_m * math.sin(car.heading_rad + LEAD_S * car.yaw_rate_radps))
        error = self._seen.popleft()
        most = MOST_ANGLE_RAD / self._ratio
        gain = 2.0 * self._wheelbase_m / (ahead_m * ahead_m)
        wanted = -gain * (error + self._integral_ms / INTEGRAL_S)
        if abs(wanted) < most and abs(car.speed_mps) > 0.5:
            self._integral_ms += error * self._dt_s
        wanted = min(max(wanted, -most), most) * self._ratio
        step = (wanted - self.angle_rad) * self._dt_s / (ARMS_S + self._dt_s)
        most_step = MOST_RATE_RADPS * self._dt_s
        self.angle_rad += min(max(step, -most_step), most_step)
        return self.angle_rad
