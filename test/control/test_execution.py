# SPDX-License-Identifier: Apache-2.0
"""The law as plain Python: bit for bit the compiled one whatever it is given, and no fault of it costs the brakes."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st

from control.test_law import CARS, EXAMPLES, MEMORIES, TABLE, TUNINGS, YAWS
from iwm_power_manager.control import repeat
from iwm_power_manager.control.execution import COMPILED, Execution, braked, plain_python
from iwm_power_manager.control.guard import violated_bound
from iwm_power_manager.control.record import DECIDED_NAMES
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.interpreted import interpreted
from iwm_power_manager.model.pedals import ACCELERATION, FORCE, PEDAL_TRAVEL, TORQUE, demand_power_w
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path

PLAIN = plain_python()
POLICY = load_policy(share_path("policies/jalalmaab_2015_drag_coupled_mu090.npz")).table()


def bits(value: Any) -> Any:
    """Numbers as their bytes, so that 0.0 is not -0.0; NaN is NaN, whatever its sign."""
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    if isinstance(value, float):
        return "nan" if math.isnan(value) else struct.pack("<d", value)
    return type(value) is int or "flag", int(value)


def any_of(low: float, high: float) -> st.SearchStrategy[float]:
    return st.one_of(st.floats(low, high), st.sampled_from((0.0, -0.0, low, high, 1e-300, 5e-324)))


def four(one: Any) -> Any:
    return st.one_of(st.tuples(one, one, one, one), one.map(lambda x: (x,) * 4))


#: Whatever the checks of the inputs let through, and more.
MEASURED = st.builds(
    Measurement,
    speed_mps=any_of(-80.0, 80.0) | st.just(math.nan),
    wheel_speed_radps=four(any_of(-260.0, 260.0)),
    power_demand_w=any_of(-2e5, 2e5),
    dt_s=st.floats(1e-3, 0.1),
    friction=st.floats(0.05, 1.2),
    discharge_limit_w=any_of(0.0, 1e5),
    charge_limit_w=any_of(0.0, 1e5),
    soc=any_of(0.0, 1.0),
    motor_gain=four(any_of(0.0, 1.0)),
    direction=st.sampled_from((-1.0, 1.0)),
    motor_stuck_nm=four(any_of(-500.0, 500.0) | st.just(0.0)),
    acceleration_mps2=any_of(-30.0, 30.0) | st.just(math.nan),
    yaw_rate_radps=any_of(-10.0, 10.0) | st.just(math.nan),
    lateral_mps2=any_of(-30.0, 30.0) | st.just(math.nan),
)
STATES = st.just(initial_state()) | st.builds(lambda state, yaw: state._replace(yaw=yaw), MEMORIES, YAWS)
CODES = st.sampled_from([strategy.code for strategy in STRATEGIES.values()])


def series(executions: list[Execution], measured: list[Measurement], state: Any, *rest: Any) -> list[Any]:
    """What comes of steps, each with an execution of its own: commands, numbers and memory."""
    settings, car, table = rest
    found = []
    for execution, m in zip(executions, measured, strict=True):
        before, after, held = execution.hold(state), execution.hold(state), execution.hold(car)
        found.append(bits(execution.advance(m, before, after, settings, held, table)))
        state = after.value
        found.append(bits(state))
    return found


@profile(max_examples=EXAMPLES)
@given(
    st.lists(st.tuples(MEASURED, st.booleans()), min_size=1, max_size=4),
    STATES,
    st.builds(lambda tuning, code: tuning._replace(strategy=code), TUNINGS, CODES),
    st.sampled_from(list(CARS.values())),
    st.sampled_from((TABLE, POLICY)),
)
def test_a_drive_is_bit_for_bit_the_same_compiled_and_in_plain_python_and_going_over_between(
    steps, state, settings, car, table
) -> None:
    measured = [m for m, _ in steps]
    rest = (measured, state, settings, car, table)
    compiled = series([COMPILED] * len(steps), *rest)
    assert series([PLAIN] * len(steps), *rest) == compiled
    assert series([COMPILED if chosen else PLAIN for _, chosen in steps], *rest) == compiled
    assert not PLAIN.faults


def test_a_flag_is_a_plain_integer_also_where_numpy_s_numbers_have_come_in() -> None:
    # The rule's thresholds stand in an array; a message takes no integer of numpy's.
    settings, car = default_settings("rule")._replace(gate_driving=True), CARS["drag"]
    before, after = PLAIN.hold(initial_state()), PLAIN.hold(None)
    for _ in range(3):
        m = Measurement(1.0, (60.0, 20.0, 45.0, 20.0), 2000.0, 0.05, 0.9, 1e4, 1e4, 0.5)
        command = PLAIN.advance(m, before, after, settings, PLAIN.hold(car), TABLE)[0]
        before = PLAIN.hold(after.value)
        assert [type(flags) for flags in (command.gate, command.gated_wheels, command.limits)] == [int, int, int]


@given(any_of(0.0, 1.0), any_of(-60.0, 120.0) | st.just(math.nan), st.sampled_from(list(CARS.values())))
def test_the_battery_s_limits_are_the_same(soc, temperature, car) -> None:
    found = [e.battery_limits(soc, temperature, e.hold(car)) for e in (COMPILED, PLAIN)]
    assert bits(found[0]) == bits(found[1])


@given(
    st.sampled_from((PEDAL_TRAVEL, FORCE, TORQUE, ACCELERATION)),
    st.floats(),
    st.floats(0.0, 1.0),
    st.floats(0.0, 1e3),
    st.sampled_from(list(CARS.values())),
)
def test_a_demand_is_the_same_power(kind, value, brake, speed, car) -> None:
    arguments = kind, value, brake, speed, car
    assert bits(interpreted(demand_power_w)(*arguments)) == bits(float(demand_power_w(*arguments)))


@given(MEASURED, st.sampled_from(list(CARS.values())))
def test_without_the_law_the_friction_brakes_do_what_is_asked_for_and_no_motor_drives(m, car) -> None:
    command = braked(m, car)
    assert violated_bound(command, car) == ""
    assert command.motor_torque_nm == (0.0, 0.0, 0.0, 0.0)
    fastest = max(map(abs, m.wheel_speed_radps))
    full = all(
        torque == -axle.friction_brake.max_torque_nm
        for torque, axle in zip(command.friction_torque_nm[::2], (car.front, car.rear), strict=True)
    )
    slow = fastest < car.driver.power_speed_floor_mps / min(car.front.wheel.radius_m, car.rear.wheel.radius_m)
    wanted = min(m.power_demand_w, 0.0)
    assert full or slow or -sum(command.friction_torque_nm) * fastest <= -wanted * (1.0 + 1e-9) + 1e-300
    if not -1e-300 < wanted < 0.0:  # of which no torque may be left
        brakes = car.front.friction_brake.max_torque_nm > 0.0
        assert (sum(command.friction_torque_nm) < 0.0) == (wanted < 0.0 and brakes)


@pytest.mark.parametrize(("front_nm", "rear_nm"), [(300.0, 100.0), (100.0, 300.0)])
def test_without_the_law_each_axle_brakes_with_what_its_own_brakes_can(front_nm, rear_nm) -> None:
    car = CARS["drag"]
    front, rear = (
        axle._replace(
            friction_brake=axle.friction_brake._replace(max_torque_nm=nm), wheel=axle.wheel._replace(radius_m=r)
        )
        for axle, nm, r in ((car.front, front_nm, 0.3), (car.rear, rear_nm, 0.4))
    )
    car = car._replace(front=front, rear=rear)
    m = Measurement(12.0, (40.0,) * 4, -60e3, 0.01, 0.9, 1e4, 1e4, 0.5)
    command = braked(m, car)
    assert command.friction_torque_nm == (-front_nm, -front_nm, -rear_nm, -rear_nm)
    assert (command.front_power_w, command.rear_power_w) == (-80.0 * front_nm, -80.0 * rear_nm)
    floor = car.driver.power_speed_floor_mps
    at_rest = braked(m._replace(wheel_speed_radps=(0.0,) * 4, power_demand_w=-400.0 * floor), car)
    assert at_rest.friction_torque_nm == pytest.approx((-30.0, -30.0, -40.0, -40.0))


@pytest.mark.parametrize("error", [ZeroDivisionError("float division by zero"), IndexError("out of bounds")])
def test_a_step_that_raises_brakes_as_asked_forgets_nothing_and_is_told(monkeypatch, error) -> None:
    def fails(*_: Any) -> Any:
        raise error

    monkeypatch.setattr(repeat, "advance", fails)
    broken = plain_python()
    car, state = CARS["drag"], initial_state()
    m = Measurement(10.0, (30.0,) * 4, -6000.0, 0.01, 0.9, 1e4, 1e4, 0.5)
    before, after = broken.hold(state), broken.hold(None)
    for _ in range(3):
        command, numbers, assumed = broken.advance(m, before, after, None, broken.hold(car), TABLE)
        assert command.friction_torque_nm == (-50.0,) * 4
        assert (after.value, assumed) == (state, state.friction.assumed)
        assert len(numbers) == len(DECIDED_NAMES)
    assert broken.faults == [f"{type(error).__name__}: {error}"]
