# SPDX-License-Identifier: Apache-2.0
"""The numbers of a car as the kernels take them.

NamedTuples are the whole interface between a vehicle file and the numerics: numba takes them as arguments, so that no
parameter ever becomes a compiled-in constant. Field names carry their units; the file has the same names.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: What a motor at zero torque costs (docs/model.md, "Idle axle").
IDLE_NONE, IDLE_DRAG, IDLE_ENABLED = range(3)
IDLE_DRIVES: dict[str, int] = {"none": IDLE_NONE, "drag": IDLE_DRAG, "enabled": IDLE_ENABLED}


class Chassis(NamedTuple):
    """Body: road load (eq. 3-5), load transfer (eq. 7, 8), and what only a plant with two tracks reads."""

    mass_kg: float
    frontal_area_m2: float
    drag_coefficient: float
    rolling_resistance: float
    air_density_kgpm3: float
    front_axle_to_cg_m: float
    rear_axle_to_cg_m: float
    cg_height_m: float
    yaw_inertia_kgm2: float
    front_roll_share: float
    steering_ratio: float


class Wheel(NamedTuple):
    """One wheel with its rotor (eq. 11)."""

    radius_m: float
    inertia_kgm2: float


#: As many numbers as any tyre model has; what they mean only its module in `model/tyre/` knows.
TyreCoefficients = tuple[float, float, float, float]


class Tyre(NamedTuple):
    """A tyre model with its numbers (`model.tyre`), and the regularisation of slip at rest (eq. 10)."""

    model: int
    coefficients: TyreCoefficients
    slip_speed_floor_mps: float


class Motor(NamedTuple):
    """One motor with its inverter, as the wheel has it (eq. 14-16, 19, 42): a gear between them is reckoned in.

    Losses come from the five coefficients, or, where `map_loss_w` is not empty, from the map: loss in W over
    `map_speed_radps` (rows) and `map_torque_nm` (columns, from generating to driving).
    """

    max_power_w: float
    peak_torque_nm: float
    continuous_torque_nm: float
    thermal_time_constant_s: float
    regeneration_torque_nm: float
    regeneration_full_above_mps: float
    regeneration_zero_below_mps: float
    loss_constant_w: float
    loss_linear_speed: float
    loss_quadratic_speed: float
    loss_linear_torque: float
    loss_quadratic_torque: float
    idle_drive: int
    idle_standby_w: float
    idle_drag_constant_nm: float
    idle_drag_linear_nm_per_radps: float
    map_speed_radps: FloatArray
    map_torque_nm: FloatArray
    map_loss_w: FloatArray


class FrictionBrake(NamedTuple):
    """One friction brake (eq. 20, 41)."""

    max_torque_nm: float


class Battery(NamedTuple):
    """Pack: the control model's static circuit (eq. 21-24) and the plant's richer one."""

    cells_in_series: float
    capacity_ah: float
    nominal_cell_voltage_v: float
    resistance_ohm: float
    discharge_limit_w: float
    charge_limit_w: float
    charge_full_below_soc: float
    charge_zero_above_soc: float
    discharge_full_above_soc: float
    discharge_zero_below_soc: float
    charge_full_above_degc: float
    charge_zero_below_degc: float
    power_full_below_degc: float
    power_zero_above_degc: float
    ocv_soc: FloatArray
    ocv_cell_v: FloatArray
    ohmic_resistance_ohm: float
    ohmic_factor_at_10_percent: float
    polarisation_resistance_ohm: float
    polarisation_time_constant_s: float


class Driver(NamedTuple):
    """The simulated driver and the meaning of the pedals."""

    preview_s: float
    proportional_n_per_mps: float
    integral_n_per_m: float
    full_brake_g: float
    power_speed_floor_mps: float


class Axle(NamedTuple):
    """What the two wheels of an axle have in common: each has its own motor, tyre and friction brake of this kind."""

    wheel: Wheel
    tyre: Tyre
    motor: Motor
    friction_brake: FrictionBrake
    track_width_m: float


class VehicleParams(NamedTuple):
    """The whole car as the kernels take it."""

    chassis: Chassis
    front: Axle
    rear: Axle
    battery: Battery
    driver: Driver

    def with_axles(self, **parts: Any) -> VehicleParams:
        """The same car with these parts (`motor`, `wheel`, `tyre`, `friction_brake`) replaced on both axles."""
        return self._replace(front=self.front._replace(**parts), rear=self.rear._replace(**parts))
