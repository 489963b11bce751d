# SPDX-License-Identifier: Apache-2.0
"""The last look at a command: every bound is seen when it is crossed, and only then."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from iwm_power_manager.control.guard import violated_bound
from iwm_power_manager.control.types import GATE_BOTH, GATE_FRONT, GATE_NONE, GATE_REAR, Command
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle

PEAK, BRAKE = 200.0, 900.0


@pytest.fixture(scope="module")
def vehicle() -> VehicleParams:
    params = load_vehicle(resolve(Path("config/vehicles/jalalmaab_2015.yaml"))).params
    return params.with_axles(
        motor=params.front.motor._replace(peak_torque_nm=PEAK),
        friction_brake=params.front.friction_brake._replace(max_torque_nm=BRAKE),
    )


def command(motor=(0.0,) * 4, friction=(0.0,) * 4, gated_wheels=0, gate=None) -> Command:
    if gate is None:
        gate = (gated_wheels & 3 == 3) + 2 * (gated_wheels & 12 == 12)
    return Command(
        motor_torque_nm=tuple(motor),
        friction_torque_nm=tuple(friction),
        brake_gain=(1.0,) * 4,
        front_share=0.5,
        decided_share=0.5,
        gate=gate,
        limits=0,
        front_power_w=0.0,
        rear_power_w=0.0,
        front_slip=0.0,
        rear_slip=0.0,
        gated_wheels=gated_wheels,
        speed_mps=0.0,
        doubted=0,
        hold_nm=0.0,
        left_friction=0.9,
        right_friction=0.9,
        left_confidence=0.0,
        right_confidence=0.0,
    )


def one(index: int, value: float) -> tuple[float, ...]:
    return tuple(value if i == index else 0.0 for i in range(4))


@pytest.mark.parametrize("wheel", range(4))
class TestEveryWheel:
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_a_torque_that_is_not_finite_is_seen(self, vehicle, wheel, value) -> None:
        assert f"wheel {wheel} is not finite" in violated_bound(command(one(wheel, value)), vehicle)
        assert f"wheel {wheel} is not finite" in violated_bound(command(friction=one(wheel, value)), vehicle)

    def test_a_motor_torque_may_reach_the_peak_either_way(self, vehicle, wheel) -> None:
        assert violated_bound(command(one(wheel, PEAK)), vehicle) == ""
        assert violated_bound(command(one(wheel, -PEAK)), vehicle) == ""
        assert violated_bound(command(one(wheel, PEAK + 1e-6)), vehicle) == ""
        assert f"motor torque of wheel {wheel}" in violated_bound(command(one(wheel, PEAK + 2e-6)), vehicle)
        assert f"motor torque of wheel {wheel}" in violated_bound(command(one(wheel, -PEAK - 2e-6)), vehicle)

    def test_a_friction_brake_only_brakes_and_no_more_than_it_can(self, vehicle, wheel) -> None:
        assert violated_bound(command(friction=one(wheel, -BRAKE)), vehicle) == ""
        assert violated_bound(command(friction=one(wheel, -BRAKE - 1e-6)), vehicle) == ""
        assert f"friction torque of wheel {wheel}" in violated_bound(
            command(friction=one(wheel, -BRAKE - 2e-6)), vehicle
        )
        assert violated_bound(command(friction=one(wheel, 1e-12)), vehicle) == (
            f"friction torque of wheel {wheel} is 1e-12 N m, outside -900..0"
        )

    @pytest.mark.parametrize("gated_wheels", [1, 2, 4, 8, 3, 12, 6, 15])
    def test_a_gated_wheel_has_no_torque_at_all(self, vehicle, wheel, gated_wheels) -> None:
        gated = bool(gated_wheels & (1, 2, 4, 8)[wheel])
        expected = f"wheel {wheel} is gated" if gated else ""
        for torque in (1e-9, -1e-9):
            assert violated_bound(command(one(wheel, torque), gated_wheels=gated_wheels), vehicle).startswith(expected)
        held = violated_bound(command(friction=one(wheel, -1e-9), gated_wheels=gated_wheels), vehicle)
        assert held.startswith(expected)
        assert bool(violated_bound(command(one(wheel, 1.0), gated_wheels=gated_wheels), vehicle)) == gated


def test_each_axle_has_its_own_bounds(vehicle) -> None:
    weaker = vehicle._replace(
        rear=vehicle.rear._replace(
            motor=vehicle.rear.motor._replace(peak_torque_nm=PEAK / 2),
            friction_brake=vehicle.rear.friction_brake._replace(max_torque_nm=BRAKE / 2),
        )
    )
    for wheel in range(4):
        assert bool(violated_bound(command(one(wheel, 0.6 * PEAK)), weaker)) == (wheel >= 2)
        assert bool(violated_bound(command(friction=one(wheel, -0.6 * BRAKE)), weaker)) == (wheel >= 2)


@pytest.mark.parametrize("gate", [-1, 4])
def test_a_gate_that_does_not_exist_is_seen(vehicle, gate) -> None:
    assert violated_bound(command(gate=gate), vehicle) == f"gate {gate} does not exist"


@pytest.mark.parametrize(("gate", "gated_wheels"), [(GATE_FRONT, 1), (GATE_NONE, 3), (GATE_BOTH, 12), (GATE_REAR, 3)])
def test_a_gate_that_is_not_that_of_its_wheels_is_seen(vehicle, gate, gated_wheels) -> None:
    assert "is not that of the gated wheels" in violated_bound(command(gate=gate, gated_wheels=gated_wheels), vehicle)


@pytest.mark.parametrize("gated_wheels", range(16))
def test_zero_torque_is_always_allowed(vehicle, gated_wheels) -> None:
    assert violated_bound(command(gated_wheels=gated_wheels), vehicle) == ""
