# SPDX-License-Identifier: Apache-2.0
"""The paper's sensitivity analysis (Fig. 8 to 10): depletion of one step over the front axle's power.

Speed, demand and the slips of both axles are given; each axle's motors turn at the speed the slip says and give the
power they are told (eq. 10, 16), and the battery gives what they take (eq. 21-23). A split that a motor cannot drive
has no depletion. One thing is not a matter of taste: what an axle at zero power costs (`idle_drive`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from iwm_power_manager.model.battery import chemical_power_w, depletion_per_joule
from iwm_power_manager.model.motor import electrical_power_w, torque_limit_nm
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.tyre import wheel_speed_at_slip
from iwm_sim.study.figures import Curve

FloatArray = npt.NDArray[np.float64]

STEP_S = 0.1
_POINTS = 101
#: A part of the demand that is next to nothing.
_HARDLY = 1e-9

#: Figure 8: speeds, m/s, at one demand; Figure 9: front slips at one speed and demand; Figure 10: demands. The demand
#: of Figure 8 and the speed of Figure 10 are not in the text.
SPEEDS_MPS = (5.0, 10.0, 20.0)
FIG_8_DEMAND_W = 5000.0
FRONT_SLIPS = (0.01, 0.2, 0.5)
FIG_9_SPEED_MPS, FIG_9_DEMAND_W = 10.0, 10000.0
DEMANDS_W = (1000.0, 5000.0, 10000.0)
FIG_10_SPEED_MPS = 10.0


def depletion_percent(
    front_power_w: float, demand_w: float, speed_mps: float, front_slip: float, rear_slip: float, vehicle: VehicleParams
) -> float:
    """ΔSoC of one step, %; NaN where a motor cannot give its part."""
    total = 0.0
    for power, slip in ((front_power_w, front_slip), (demand_w - front_power_w, rear_slip)):
        wheel_speed = wheel_speed_at_slip(slip, speed_mps, vehicle.front.wheel.radius_m)
        torque = power / (2.0 * wheel_speed)
        if torque > torque_limit_nm(wheel_speed, 0.0, vehicle.front.motor) * (1.0 + 1e-9):
            return float("nan")
        total += 2.0 * electrical_power_w(torque, wheel_speed, vehicle.front.motor)
    chemical_j = chemical_power_w(total, vehicle.battery) * STEP_S
    return float(100.0 * chemical_j * depletion_per_joule(vehicle.battery))


def curve(label: str, demand_w: float, speed_mps: float, front_slip: float, vehicle: VehicleParams) -> Curve:
    """Depletion over all front powers from nothing to the whole demand, the rear slip at 0.01.

    An axle that rests takes another power than one that hardly works: both ends stand twice, alone and as limits.
    """
    inner = np.linspace(0.0, 1.0, _POINTS)[1:-1]
    power: FloatArray = demand_w * np.array([0.0, _HARDLY, *inner, 1.0 - _HARDLY, 1.0])
    depletion = [depletion_percent(float(p), demand_w, speed_mps, front_slip, 0.01, vehicle) for p in power]
    return Curve(label, power, depletion)


def figure_8(vehicle: VehicleParams) -> list[Curve]:
    """Depletion for several speeds."""
    return [curve(f"{v:g} m/s", FIG_8_DEMAND_W, v, 0.01, vehicle) for v in SPEEDS_MPS]


def figure_9(vehicle: VehicleParams) -> list[Curve]:
    """Depletion for several slips of the front axle."""
    return [curve(f"slip {s:g}", FIG_9_DEMAND_W, FIG_9_SPEED_MPS, s, vehicle) for s in FRONT_SLIPS]


def figure_10(vehicle: VehicleParams) -> list[tuple[str, list[Curve]]]:
    """Depletion for several demands, a panel each."""
    return [
        (f"Demand {p / 1000:g} kW", [curve(f"{p / 1000:g} kW", p, FIG_10_SPEED_MPS, 0.01, vehicle)]) for p in DEMANDS_W
    ]


def best_front_share(made: Curve) -> float:
    """Front share of a curve's least depletion (the smaller one of two that tie)."""
    power = np.asarray(made.front_power_w, dtype=np.float64)
    depletion = np.asarray(made.delta_soc_percent, dtype=np.float64)
    if not np.isfinite(depletion).any():
        return float("nan")
    return float(power[int(np.nanargmin(np.round(depletion, 12)))] / power[-1])
