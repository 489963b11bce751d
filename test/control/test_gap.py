# SPDX-License-Identifier: Apache-2.0
"""Where steps are missing in a record: what it shows of the law's memory is that memory, of each wheel and side."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control import law
from iwm_power_manager.control.gap import possible_memories
from iwm_power_manager.control.record import SIGNAL_NAMES, Watch, command_of, completed, decided, to_numbers
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.supervision import Supervision
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS = CAR.front.wheel.radius_m
TABLE = empty_table()
TUNED = default_settings("equal")


def driven(demand, speed, direction=1.0, steps=60):
    """A drive on wheels that are all unlike: its memory, its last command and the record of its last step."""
    state = initial_state()
    for k in range(steps):
        rims = [speed * (1.0 + part * math.sin(0.3 * k)) for part in (0.01, -0.02, 0.03, -0.04)]
        m = Measurement(
            speed_mps=speed,
            wheel_speed_radps=tuple(rim / RADIUS for rim in rims),
            power_demand_w=demand,
            dt_s=0.01,
            friction=0.6,
            discharge_limit_w=47.5e3,
            charge_limit_w=47.5e3,
            soc=0.5,
            motor_gain=(1.0, 0.5, 1.0, 0.8),
            direction=direction,
        )
        before = state
        command, state = law.step(m, before, TUNED, CAR, TABLE)
    watch = Watch(wheels_lost=0, requested_power_w=demand, age_s=(0.0,) * 4)
    return state, command, to_numbers(m, TUNED, decided(command, before, state), Supervision(), watch)


@pytest.mark.parametrize(("demand", "speed", "direction"), [(8e3, 12.0, 1.0), (-25e3, 20.0, 1.0), (3e3, -3.0, -1.0)])
def test_what_a_record_shows_is_what_the_law_remembers(demand, speed, direction):
    state, command, numbers = driven(demand, speed, direction)
    shown = possible_memories(initial_state(), 7, numbers, TABLE)[0]
    assert (shown.steps, shown.travel, shown.hold_nm) == (7, state.travel, state.hold_nm)
    for found, wheel in zip(shown.wheels, state.wheels, strict=True):
        assert found.motor_nm == pytest.approx(wheel.motor_nm)
        assert found.speed_radps == pytest.approx(wheel.speed_radps)
        assert found.gated == wheel.gated
    # Of heat and slip, an axle's worse wheel.
    for axle, slip in ((slice(0, 2), command.front_slip), (slice(2, 4), command.rear_slip)):
        assert [wheel.heat for wheel in shown.wheels[axle]] == [max(wheel.heat for wheel in state.wheels[axle])] * 2
        assert [wheel.slip for wheel in shown.wheels[axle]] == [slip] * 2
    told = [motor + brake for motor, brake in zip(command.motor_torque_nm, command.friction_torque_nm, strict=True)]
    assert [wheel.total_nm for wheel in shown.wheels] == pytest.approx([direction * nm for nm in told])
    assert shown.friction.left == state.friction.left
    assert shown.friction.right == state.friction.right
    assert (shown.split.decided_share, shown.split.applied_share) == (command.decided_share, command.front_share)
    assert shown.motion.speed_mps == command.speed_mps


def test_a_run_begins_with_nothing_and_goes_on_with_what_was_remembered_before_the_gap():
    state, _, numbers = driven(8e3, 12.0)
    assert possible_memories(state, 0, numbers, TABLE) == [initial_state()]
    first, uphill, downhill = possible_memories(state, 90, numbers, TABLE)
    assert first == state._replace(steps=90)
    assert uphill.motion.bias_mps2 < 0.0 < downhill.motion.bias_mps2
    assert min(downhill.front_unequal_s, downhill.rear_unequal_s) > 0.0 == uphill.front_unequal_s
    assert downhill.split.jitter.gain < uphill.split.jitter.gain == 1.0
    assert uphill.steps == downhill.steps == 90


def test_a_recorded_command_is_the_command():
    state, command, _ = driven(-25e3, 20.0)
    assert command_of(decided(command, state, state)) == command


def test_a_record_that_is_older_than_a_signal_is_completed_in_any_order():
    _, _, numbers = driven(8e3, 12.0)
    assert completed(SIGNAL_NAMES, numbers) == numbers
    recorded = dict(zip(SIGNAL_NAMES, numbers, strict=True))
    for young in ("hold_nm", "direction", "front_left_motor_gain", "setting.slip_target"):
        del recorded[young]
    names = sorted(recorded)
    found = dict(zip(SIGNAL_NAMES, completed(names, [recorded[name] for name in names]), strict=True))
    assert found == recorded | {
        "hold_nm": 0.0,
        "direction": 1.0,
        "front_left_motor_gain": 1.0,
        "setting.slip_target": TUNED.slip_target,
    }
