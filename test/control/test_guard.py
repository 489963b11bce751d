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


def command(motor=(0.0,) * 4, friction=(0.0,) * 4, gate=GATE_NONE) -> Command:
    return Command(tuple(motor), tuple(friction), 0.5, 0.5, gate, 0, 0.0, 0.0, 0.0, 0.0)


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

    @pytest.mark.parametrize("gate", [GATE_FRONT, GATE_REAR, GATE_BOTH])
    def test_a_gated_axle_has_no_torque_at_all(self, vehicle, wheel, gate) -> None:
        gated = gate == GATE_BOTH or (gate == GATE_FRONT) == (wheel < 2)
        expected = f"wheel {wheel} is gated" if gated else ""
        for torque in (1e-9, -1e-9):
            assert violated_bound(command(one(wheel, torque), gate=gate), vehicle).startswith(expected)
        assert violated_bound(command(friction=one(wheel, -1e-9), gate=gate), vehicle).startswith(expected)
        assert bool(violated_bound(command(one(wheel, 1.0), gate=gate), vehicle)) == gated


@pytest.mark.parametrize("gate", [-1, 4])
def test_a_gate_that_does_not_exist_is_seen(vehicle, gate) -> None:
    assert violated_bound(command(gate=gate), vehicle) == f"gate {gate} does not exist"


@pytest.mark.parametrize("gate", [GATE_NONE, GATE_FRONT, GATE_REAR, GATE_BOTH])
def test_zero_torque_is_always_allowed(vehicle, gate) -> None:
    assert violated_bound(command(gate=gate), vehicle) == ""
