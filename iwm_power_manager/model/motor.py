# SPDX-License-Identifier: Apache-2.0
"""In-wheel motor: losses, electrical power (eq. 14, 15, 23), torque limits (eq. 19, 42), heat.

A motor whose torque is exactly zero is idle. What that costs is the setting `idle_drive` (docs/model.md).
"""

from __future__ import annotations

from iwm_power_manager.grid import locate
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import IDLE_DRAG, IDLE_ENABLED, Motor


@kernel
def enabled_loss_w(torque_nm: float, wheel_speed_radps: float, motor: Motor) -> float:
    """Loss of an enabled motor and its inverter, W, from the coefficients or the map; the same form either way.

    Beyond the map's edges the loss at the edge holds.
    """
    columns = motor.map_torque_nm.shape[0]
    if columns == 0:
        w = wheel_speed_radps
        t = abs(torque_nm)
        return (
            motor.loss_constant_w
            + (motor.loss_linear_speed + motor.loss_quadratic_speed * w) * w
            + (motor.loss_linear_torque + motor.loss_quadratic_torque * t) * t
        )
    i, a = locate(motor.map_speed_radps, wheel_speed_radps)
    j, b = locate(motor.map_torque_nm, torque_nm)
    k = i * columns + j
    low = motor.map_loss_w[k] * (1.0 - b) + motor.map_loss_w[k + 1] * b
    high = motor.map_loss_w[k + columns] * (1.0 - b) + motor.map_loss_w[k + columns + 1] * b
    return low * (1.0 - a) + high * a


@kernel
def electrical_power_w(torque_nm: float, wheel_speed_radps: float, motor: Motor) -> float:
    """Power a motor draws from the battery, W (eq. 14, 15): T*w plus losses; negative when regenerating."""
    if torque_nm == 0.0:
        if motor.idle_drive == IDLE_ENABLED:
            return enabled_loss_w(0.0, wheel_speed_radps, motor)
        if motor.idle_drive == IDLE_DRAG:
            return motor.idle_standby_w
        return 0.0
    return torque_nm * wheel_speed_radps + enabled_loss_w(torque_nm, wheel_speed_radps, motor)


@kernel
def idle_drag_nm(torque_nm: float, wheel_speed_radps: float, motor: Motor) -> float:
    """Torque that drags at the wheel of an idle motor with blocked gates, N m, >= 0."""
    if torque_nm == 0.0 and motor.idle_drive == IDLE_DRAG:
        return motor.idle_drag_constant_nm + motor.idle_drag_linear_nm_per_radps * wheel_speed_radps
    return 0.0


@kernel
def torque_limit_nm(wheel_speed_radps: float, heat: float, motor: Motor) -> float:
    """Largest driving torque, N m (eq. 19, 40): peak when cold, continuous when hot, never beyond the power limit.

    Parameters
    ----------
    wheel_speed_radps : wheel speed, >= 0
    heat : heat index, 0 cold to 1 hot
    """
    thermal = motor.peak_torque_nm + (motor.continuous_torque_nm - motor.peak_torque_nm) * min(max(heat, 0.0), 1.0)
    if wheel_speed_radps * thermal > motor.max_power_w:
        return motor.max_power_w / wheel_speed_radps
    return thermal


@kernel
def regeneration_limit_nm(wheel_speed_radps: float, speed_mps: float, heat: float, motor: Motor) -> float:
    """Largest regenerative torque, N m, >= 0 (eq. 42): torque, power and heat limits, faded out towards standstill."""
    limit = min(motor.regeneration_torque_nm, torque_limit_nm(wheel_speed_radps, heat, motor))
    low = motor.regeneration_zero_below_mps
    fade = (speed_mps - low) / (motor.regeneration_full_above_mps - low)
    return limit * min(max(fade, 0.0), 1.0)


@kernel
def heat_after(heat: float, torque_nm: float, dt_s: float, motor: Motor) -> float:
    """Heat index after a time at a torque: a first-order lag towards (T / T_continuous)^2, stepped implicitly."""
    load = torque_nm / motor.continuous_torque_nm
    target = load * load  # not `** 2`, whose last bit plain Python leaves to the C library
    gain = dt_s / (motor.thermal_time_constant_s + dt_s)
    return heat + gain * (target - heat)
