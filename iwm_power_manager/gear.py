# SPDX-License-Identifier: Apache-2.0
"""A reduction gear between motor and wheel: the motor's numbers as the wheel has them."""

from __future__ import annotations

import numpy as np

from iwm_power_manager.model.parameters import FloatArray, Motor, Wheel

#: A gear that loses power makes a map of loss coefficients: its speeds reach to this, its points are this many.
MAP_TOP_SPEED_MPS = 80.0
MAP_SPEEDS, MAP_TORQUES = 81, 81


def behind_gear(
    motor: Motor, wheel: Wheel, ratio: float, efficiency: float, rotor_inertia_kgm2: float
) -> tuple[Motor, Wheel]:
    """Motor and wheel with a gear between them, both as seen from the wheel.

    Torque grows with the ratio, speed falls with it, inertia grows with its square. The gear's efficiency takes its
    part of the power in the direction in which it flows; peak and continuous torque and the power limit are what comes
    out at the wheel, the regeneration torque is what the motor can hold against.

    Parameters
    ----------
    motor : with the numbers of its own shaft
    ratio : turns of the motor for one of the wheel
    efficiency : power behind over power before the gear, 0..1
    rotor_inertia_kgm2 : at the motor's shaft
    """
    speed, torque, loss = motor.map_speed_radps, motor.map_torque_nm, motor.map_loss_w
    if efficiency < 1.0 and torque.size == 0:
        speed, torque, loss = _sampled(motor, ratio * MAP_TOP_SPEED_MPS / wheel.radius_m)
        motor = motor._replace(
            loss_constant_w=0.0,
            loss_linear_speed=0.0,
            loss_quadratic_speed=0.0,
            loss_linear_torque=0.0,
            loss_quadratic_torque=0.0,
        )
    if torque.size:
        # Power that goes into the gear: the motor's when driving, the wheel's when regenerating.
        into = np.abs(np.outer(speed, torque)) / np.where(torque < 0.0, efficiency, 1.0)
        loss = loss + ((1.0 - efficiency) * into).reshape(-1)
    geared = motor._replace(
        max_power_w=motor.max_power_w * efficiency,
        peak_torque_nm=motor.peak_torque_nm * ratio * efficiency,
        continuous_torque_nm=motor.continuous_torque_nm * ratio * efficiency,
        regeneration_torque_nm=motor.regeneration_torque_nm * ratio / efficiency,
        loss_linear_speed=motor.loss_linear_speed * ratio,
        loss_quadratic_speed=motor.loss_quadratic_speed * ratio * ratio,
        loss_linear_torque=motor.loss_linear_torque / ratio,
        loss_quadratic_torque=motor.loss_quadratic_torque / (ratio * ratio),
        idle_drag_constant_nm=motor.idle_drag_constant_nm * ratio / efficiency,
        idle_drag_linear_nm_per_radps=motor.idle_drag_linear_nm_per_radps * ratio * ratio / efficiency,
        map_speed_radps=speed / ratio,
        map_torque_nm=torque * ratio * np.where(torque < 0.0, 1.0 / efficiency, efficiency),
        map_loss_w=loss,
    )
    return geared, wheel._replace(inertia_kgm2=wheel.inertia_kgm2 + rotor_inertia_kgm2 * ratio * ratio)


def _sampled(motor: Motor, top_speed_radps: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The loss coefficients as a map: speeds (n,), torques (m,), losses (n * m,)."""
    speed = np.linspace(0.0, top_speed_radps, MAP_SPEEDS)
    torque = np.linspace(-motor.peak_torque_nm, motor.peak_torque_nm, MAP_TORQUES)
    of_speed = motor.loss_constant_w + (motor.loss_linear_speed + motor.loss_quadratic_speed * speed) * speed
    size = np.abs(torque)
    of_torque = (motor.loss_linear_torque + motor.loss_quadratic_torque * size) * size
    return speed, torque, np.add.outer(of_speed, of_torque).reshape(-1)
