# SPDX-License-Identifier: Apache-2.0
"""Four wheels, each its own: what is wrong with one shows on that one, and a mirrored car gets mirrored commands."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager.control import law
from iwm_power_manager.control.direction import MOVING_MPS
from iwm_power_manager.control.settings import GATE_MODE_OFF, default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import (
    LIMIT_FRICTION_BRAKE,
    LIMIT_MOTOR,
    LIMIT_REGENERATION,
    LIMIT_SLEW,
    LIMIT_SLIP,
    LIMIT_THERMAL,
    ControllerState,
    Measurement,
    initial_state,
)
from iwm_power_manager.control.yaw import GROWTH_FRICTION, REAR_PART, no_yaw
from iwm_power_manager.model.chassis import aerodynamic_force_n, rolling_force_n
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

PAPER = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
#: Front and rear are nowhere alike.
CAR = PAPER._replace(
    rear=PAPER.rear._replace(
        motor=PAPER.rear.motor._replace(max_power_w=6000.0, peak_torque_nm=150.0, regeneration_torque_nm=60.0),
        wheel=PAPER.rear.wheel._replace(radius_m=0.3, inertia_kgm2=0.8),
        friction_brake=PAPER.rear.friction_brake._replace(max_torque_nm=400.0),
    )
)
RADII = (CAR.front.wheel.radius_m,) * 2 + (CAR.rear.wheel.radius_m,) * 2
SPEED = 15.0
WHEELS = pytest.mark.parametrize("wheel", range(4))
TABLE = empty_table()
#: Left and right may differ as much as they like, so that what limits one wheel does not show on the other.
LIMITER = default_settings("equal")._replace(
    front_yaw_nm=20e3, front_yaw_most_nm=20e3, rear_yaw_nm=20e3, rear_yaw_most_nm=20e3
)
OFF = LIMITER._replace(gate_mode=GATE_MODE_OFF)


def one(wheel, value, others):
    return tuple(value if i == wheel else other for i, other in enumerate(others))


def rolling(speed=SPEED):
    return tuple(speed / radius for radius in RADII)


def measured(demand, wheels=None, speed=SPEED, gain=(1.0,) * 4):
    return Measurement(
        speed_mps=speed,
        wheel_speed_radps=rolling(speed) if wheels is None else wheels,
        power_demand_w=demand,
        dt_s=0.01,
        friction=0.9,
        discharge_limit_w=47500.0,
        charge_limit_w=47500.0,
        soc=0.6,
        motor_gain=gain,
    )


def remembered(speed=SPEED, **parts) -> ControllerState:
    """The second step of a car that rolls; `parts` : four values of a field of `WheelState`."""
    start = initial_state()
    parts = {"speed_radps": rolling(speed)} | parts
    wheels = tuple(
        state._replace(**{name: values[i] for name, values in parts.items()}) for i, state in enumerate(start.wheels)
    )
    motion = start.motion._replace(speed_mps=speed, shown_mps=speed)
    return start._replace(steps=1, wheels=wheels, motion=motion)


def step(measurement, state=None, tuned=LIMITER):
    return law.step(measurement, initial_state() if state is None else state, tuned, CAR, TABLE)


@WHEELS
@pytest.mark.parametrize(("demand", "rim"), [(-12e3, 0.6 * SPEED), (12e3, 1.6 * SPEED)])
def test_only_the_wheel_that_skids_is_gated(wheel, demand, rim):
    wheels = one(wheel, rim / RADII[wheel], rolling())
    command, after = step(measured(demand, wheels), tuned=LIMITER._replace(gate_driving=True))
    assert command.gated_wheels == 1 << wheel
    assert [state.gated for state in after.wheels] == [i == wheel for i in range(4)]
    assert command.motor_torque_nm[wheel] == command.friction_torque_nm[wheel] == 0.0
    assert all(command.motor_torque_nm[i] != 0.0 for i in range(4) if i != wheel)


@WHEELS
def test_each_wheel_s_slip_is_its_own_and_an_axle_s_is_its_worse_wheel_s(wheel):
    wheels = one(wheel, 0.9 * rolling()[wheel], rolling())
    command, after = step(measured(-3e3, wheels))
    assert [state.slip == pytest.approx(-0.1, abs=1e-3) for state in after.wheels] == [i == wheel for i in range(4)]
    assert (command.front_slip < -0.05) == (wheel < 2)
    assert (command.rear_slip < -0.05) == (wheel >= 2)


@WHEELS
def test_a_hot_motor_is_held_to_its_continuous_torque_and_the_others_are_not(wheel):
    # Slow, so that torque and not power is the limit; and enough for all of it.
    before = remembered(2.0, heat=one(wheel, 1.0, (0.0,) * 4), motor_nm=(100.0, 100.0, 100.0, 100.0))
    cold, _ = step(measured(60e3, speed=2.0), remembered(2.0, motor_nm=(100.0,) * 4), OFF)
    hot, _ = step(measured(60e3, speed=2.0), before, OFF)
    lower = [h < c - 1.0 for h, c in zip(hot.motor_torque_nm, cold.motor_torque_nm, strict=True)]
    assert lower[wheel]
    assert not any(lower[2:] if wheel < 2 else lower[:2])


@WHEELS
def test_a_motor_that_gives_nothing_is_asked_for_nothing(wheel):
    command, _ = step(measured(12e3, gain=one(wheel, 0.0, (1.0,) * 4)), tuned=LIMITER)
    assert [torque == 0.0 for torque in command.motor_torque_nm] == [i == wheel for i in range(4)]


@WHEELS
def test_each_motor_s_way_goes_on_from_its_own_torque(wheel):
    before = remembered(motor_nm=one(wheel, 40.0, (0.0,) * 4))
    command, _ = step(measured(20e3), before, OFF._replace(slew_up_nmps=100.0))
    assert command.motor_torque_nm == pytest.approx(one(wheel, 41.0, (1.0,) * 4))


@WHEELS
def test_what_the_road_took_is_reckoned_from_the_wheel_s_own_torque_and_change(wheel):
    # One that turns as its neighbour does shares with it what both seem to take: so it stands apart, then and now.
    apart = one(wheel, rolling()[wheel] - 2.0, rolling())
    before = remembered(total_nm=one(wheel, -120.0, (0.0,) * 4), speed_radps=apart)
    _, after = step(measured(-3e3, apart), before)
    assert [state.road_nm < -1.0 for state in after.wheels] == [i == wheel for i in range(4)]
    gained = one(wheel, rolling()[wheel] + 5.0, rolling())
    _, after = step(measured(-3e3, gained), remembered())
    assert [state.road_nm < -1.0 for state in after.wheels] == [i == wheel for i in range(4)]


@WHEELS
@pytest.mark.parametrize("demand", [-8e3, 8e3])
def test_what_a_stuck_motor_does_is_done_by_that_wheel(wheel, demand):
    stuck = one(wheel, 25.0, (0.0,) * 4)
    command, after = step(measured(demand)._replace(motor_stuck_nm=stuck), remembered(), OFF)
    commanded = zip(command.motor_torque_nm, command.friction_torque_nm, strict=True)
    left = [state.total_nm - motor - friction for state, (motor, friction) in zip(after.wheels, commanded, strict=True)]
    assert left == pytest.approx(stuck)


def stuck_driving(wheel, demand, nm=25.0, wheels=None, before=None):
    """A car one of whose motors is stuck at a torque that drives: what arrives at each wheel, and the friction."""
    m = measured(demand, wheels, gain=one(wheel, 0.0, (1.0,) * 4))
    command, after = step(m._replace(motor_stuck_nm=one(wheel, nm, (0.0,) * 4)), before or remembered(), LIMITER)
    return [state.total_nm for state in after.wheels], command.friction_torque_nm


@WHEELS
@pytest.mark.parametrize("slip", [0.0, 0.01, 0.5])
def test_a_motor_that_is_stuck_driving_is_held_by_its_brake_while_nothing_is_asked_for(wheel, slip):
    """Also one that spins and would be gated: without torque from the road it would go on."""
    arrived, friction = stuck_driving(wheel, 0.0, wheels=one(wheel, rolling()[wheel] / (1.0 - slip), rolling()))
    assert arrived == [0.0] * 4
    assert friction == pytest.approx(one(wheel, -25.0, (0.0,) * 4))


@WHEELS
def test_it_drives_by_as_much_as_the_other_wheel_of_its_axle_and_no_more_than_it_has(wheel):
    before = remembered(motor_nm=(10.0,) * 4)
    arrived, friction = stuck_driving(wheel, 600.0, before=before)
    assert arrived[wheel] == pytest.approx(arrived[wheel ^ 1])
    assert 0.0 < arrived[wheel] == pytest.approx(25.0 + friction[wheel])
    arrived, friction = stuck_driving(wheel, 30e3, before=before)
    assert (arrived[wheel], friction) == (25.0, (0.0,) * 4)


@WHEELS
@pytest.mark.parametrize("demand", [0.0, 600.0])
def test_a_motor_that_is_stuck_braking_is_helped_by_no_brake(wheel, demand):
    assert stuck_driving(wheel, demand, -25.0)[1] == (0.0,) * 4


@WHEELS
@pytest.mark.parametrize("demand", [0.0, 600.0])
def test_a_brake_that_makes_its_wheel_lag_holds_no_more(wheel, demand):
    """The torque is in the report only: the brake would drag."""
    for lag_mps, holds in ((0.29, True), (0.31, False)):
        lagging = one(wheel, (SPEED - lag_mps) / RADII[wheel], rolling())
        assert any(stuck_driving(wheel, demand, wheels=lagging)[1]) == holds


@WHEELS
def test_the_power_of_an_axle_is_that_of_its_two_wheels(wheel):
    wheels = one(wheel, 1.03 * rolling()[wheel], rolling())
    before = remembered(speed_radps=wheels, motor_nm=(60.0,) * 4)
    gain = one(wheel, 0.5, (1.0,) * 4)
    command, after = step(measured(12e3, wheels, gain=gain), before, OFF)
    arrived = [part * torque for part, torque in zip(gain, command.motor_torque_nm, strict=True)]
    assert [state.total_nm for state in after.wheels] == pytest.approx(arrived)
    power = [state.total_nm * rim for state, rim in zip(after.wheels, wheels, strict=True)]
    assert power[wheel] != pytest.approx(power[wheel ^ 1], rel=1e-3)
    assert tuple(state.motor_nm for state in after.wheels) == command.motor_torque_nm
    assert (command.front_power_w, command.rear_power_w) == pytest.approx((sum(power[:2]), sum(power[2:])))


@WHEELS
def test_a_car_that_turns_round_remembers_each_wheel_as_itself(wheel):
    before = remembered(-2.0, heat=one(wheel, 1.0, (0.0,) * 4))
    measurement = measured(-500.0, rolling(-2.0), speed=-2.0)._replace(direction=-1.0)
    _, after = step(measurement, before)
    assert (before.travel, after.travel) == (1.0, -1.0)
    assert [state.heat > 0.5 for state in after.wheels] == [i == wheel for i in range(4)]


@WHEELS
@pytest.mark.parametrize("demand", [-12e3, 12e3])
def test_each_axle_remembers_how_long_its_own_wheels_braked_unequally(wheel, demand):
    apart = tuple((1.0 if i % 2 else 0.9999) * speed for i, speed in enumerate(rolling()))
    wheels = one(wheel, 0.75 * rolling()[wheel], apart)
    before = remembered(speed_radps=wheels)._replace(front_unequal_s=0.5, rear_unequal_s=-0.2)
    _, after = step(measured(demand, wheels), before)
    more = 0.01 if wheel % 2 else -0.01
    braked = demand < 0.0
    assert after.front_unequal_s == pytest.approx(0.5 + (more if braked and wheel < 2 else -0.01))
    assert after.rear_unequal_s == pytest.approx(-0.2 + (more if braked and wheel >= 2 else 0.01))


@pytest.mark.parametrize("axle", ["front", "rear"])
def test_where_one_wheel_stands_in_for_the_other_an_axle_has_braked_unequally_for_no_time(axle):
    other = "rear" if axle == "front" else "front"
    apart = tuple((1.0 if i % 2 else 0.9999) * speed for i, speed in enumerate(rolling()))
    wheels = (*apart[:2], *rolling()[2:]) if axle == "rear" else (*rolling()[:2], *apart[2:])
    before = remembered(speed_radps=wheels)._replace(front_unequal_s=0.5, rear_unequal_s=0.5)
    _, after = step(measured(-12e3, wheels), before)
    assert getattr(after, f"{axle}_unequal_s") == 0.0
    assert getattr(after, f"{other}_unequal_s") == pytest.approx(0.49)


def test_each_axle_has_its_own_brakes_motors_and_radius():
    command, after = step(measured(-200e3), remembered(), OFF)
    motor, friction = command.motor_torque_nm, command.friction_torque_nm
    assert friction[0] == friction[1] == pytest.approx(-CAR.front.friction_brake.max_torque_nm - motor[0], abs=1e-6)
    assert friction[2] == friction[3] == pytest.approx(-CAR.rear.friction_brake.max_torque_nm - motor[2], abs=1e-6)
    assert [state.motor_nm for state in after.wheels] == list(motor)
    command, _ = step(measured(100e3), remembered(motor_nm=(150.0, 150.0, 150.0, 150.0)), OFF)
    given_w = [torque * wheel for torque, wheel in zip(command.motor_torque_nm, rolling(), strict=True)]
    assert given_w == pytest.approx([CAR.front.motor.max_power_w] * 2 + [CAR.rear.motor.max_power_w] * 2)


@WHEELS
def test_what_keeps_one_wheel_from_its_part_is_said_of_that_wheel(wheel):
    # It skids a little and its neighbour takes what it leaves: grip is its limit, and nothing is the neighbour's.
    wheels = one(wheel, 0.83 * rolling()[wheel], rolling())
    weak = CAR.rear.friction_brake._replace(max_torque_nm=100.0)
    car = CAR._replace(**{name: getattr(CAR, name)._replace(friction_brake=weak) for name in ("front", "rear")})
    taken = (-60.0,) * 4
    before = remembered(speed_radps=wheels, total_nm=taken, road_nm=taken)
    command, after = law.step(measured(-12e3, wheels), before, LIMITER, car, TABLE)
    assert abs(after.wheels[wheel].total_nm) < abs(after.wheels[wheel ^ 1].total_nm) - 1.0
    assert command.limits & LIMIT_SLIP
    assert not command.limits & LIMIT_FRICTION_BRAKE


@WHEELS
def test_a_motor_on_its_way_is_said_whichever_it_is(wheel):
    tuned = OFF._replace(slew_up_nmps=100.0)
    there, _ = step(measured(6e3), remembered(motor_nm=(100.0,) * 4), tuned)
    assert not there.limits & LIMIT_SLEW
    behind = one(wheel, there.motor_torque_nm[wheel] - 20.0, there.motor_torque_nm)
    command, _ = step(measured(6e3), remembered(motor_nm=behind), tuned)
    assert command.limits & LIMIT_SLEW


def held(car, before, demand=1500.0, gain=(1.0,) * 4):
    """The next step of a car at rest that is held on a slope."""
    state = remembered(0.0, motor_nm=before)._replace(hold_nm=150.0)
    return law.step(measured(demand, speed=0.0, gain=gain), state, OFF, car, TABLE)[0]


@pytest.mark.parametrize("weak", ["front", "rear"])
def test_each_axle_is_held_by_its_own_brakes(weak):
    axle = getattr(CAR, weak)
    car = CAR._replace(**{weak: axle._replace(friction_brake=axle.friction_brake._replace(max_torque_nm=40.0))})
    both = (-150.0, -150.0)
    few = (-40.0, -40.0)
    command = held(car, (0.0,) * 4, demand=0.0)
    assert command.friction_torque_nm == (few + both if weak == "front" else both + few)


@WHEELS
def test_the_hold_waits_for_each_motor_to_come_to_what_is_asked_for(wheel):
    gain = one(wheel, 0.0, (1.0,) * 4)
    steady = (0.0,) * 4
    for _ in range(50):
        command = held(CAR, steady, gain=gain)
        steady = command.motor_torque_nm
    assert steady[wheel] == 0.0 < steady[wheel ^ 1]
    assert command.hold_nm < 150.0
    steady = held(CAR, (60.0,) * 4).motor_torque_nm
    assert held(CAR, one(wheel, steady[wheel] - 4.0, steady)).hold_nm == 150.0


@WHEELS
def test_a_wheel_that_spins_is_not_held(wheel):
    back = remembered(-1.0)
    spinning = one(wheel, 2.0 / RADII[wheel], rolling(-1.0))
    command, _ = step(measured(1500.0, spinning, speed=-1.0), back, LIMITER._replace(gate_driving=True))
    assert command.hold_nm > 0.0
    assert [torque == 0.0 for torque in command.friction_torque_nm] == [i == wheel for i in range(4)]


def mirrored(values):
    a, b, c, d = values
    return b, a, d, c


@settings(max_examples=100)
@given(
    st.tuples(*[st.floats(0.5, 1.4)] * 4),
    st.floats(-60e3, 60e3),
    st.tuples(*[st.floats(-60.0, 60.0)] * 4),
    st.tuples(*[st.floats(0.0, 1.0)] * 4),
    st.tuples(*[st.sampled_from([0.0, 0.5, 1.0])] * 4),
)
def test_a_mirrored_car_gets_mirrored_commands(rims, demand, torques, heats, gains):
    wheels = tuple(rim * rolls for rim, rolls in zip(rims, rolling(), strict=True))
    one_way = step(measured(demand, wheels, gain=gains), remembered(motor_nm=torques, total_nm=torques, heat=heats))
    before = remembered(motor_nm=mirrored(torques), total_nm=mirrored(torques), heat=mirrored(heats))
    other_way = step(measured(demand, mirrored(wheels), gain=mirrored(gains)), before)
    for name in ("motor_torque_nm", "friction_torque_nm"):
        assert getattr(one_way[0], name) == pytest.approx(mirrored(getattr(other_way[0], name)), rel=1e-9, abs=1e-6)
    for here, there in zip(one_way[1].wheels, mirrored(other_way[1].wheels), strict=True):
        assert here == pytest.approx(there, rel=1e-9, abs=1e-6)


# --- an axle has its own settings, brakes, motors and memory ---------------------------------------------------------

AXLES = pytest.mark.parametrize("axle", ["front", "rear"])
FRONT, REAR = slice(0, 2), slice(2, 4)


def of(axle, values):
    return values[FRONT if axle == "front" else REAR]


def changed(axle, part, **numbers):
    """The car with other numbers of a part of one axle."""
    own = getattr(CAR, axle)
    return CAR._replace(**{axle: own._replace(**{part: getattr(own, part)._replace(**numbers)})})


@pytest.mark.parametrize("longer", [1.0, -1.0])
def test_while_the_front_brakes_unequally_each_wheel_is_held_at_the_slip_meant_for_it(longer):
    tuned = LIMITER._replace(
        slip_target=0.12, unequal_slip_target=0.03, unequal_low_slip_target=0.08, unequal_rear_slip_target=0.05
    )
    wheels = tuple(0.98 * rolls for rolls in rolling())
    before = remembered(speed_radps=wheels)._replace(front_unequal_s=longer, rear_unequal_s=0.0)

    def given(state, settings):
        _, after = step(measured(-300e3, wheels), state, settings)
        return [abs(wheel.total_nm) for wheel in after.wheels]

    alone = {
        target: given(before._replace(front_unequal_s=0.0), tuned._replace(slip_target=target))
        for target in (0.03, 0.08, 0.05)
    }
    front = (0.03, 0.08) if longer > 0.0 else (0.08, 0.03)
    expected = [alone[target][i] for i, target in enumerate((*front, 0.05, 0.05))]
    assert given(before, tuned) == pytest.approx(expected)
    assert len({round(total) for total in (alone[0.03][0], alone[0.08][0], alone[0.05][0])}) == 3
    rear_only = before._replace(front_unequal_s=0.0, rear_unequal_s=longer)
    assert given(rear_only, tuned) == pytest.approx(given(before._replace(front_unequal_s=0.0), tuned))


@AXLES
@pytest.mark.parametrize(
    ("now_nm", "growth_nmps", "most_nm", "moment_nm"),
    [(240.0, 0.0, 5e3, 240.0), (0.0, 100.0, 5e3, 200.0), (1e3, 0.0, 250.0, 250.0)],
)
def test_an_axle_s_yaw_budget_is_its_own(axle, now_nm, growth_nmps, most_nm, moment_nm):
    other = "rear" if axle == "front" else "front"
    own = {"yaw_nm": now_nm, "yaw_growth_nmps": growth_nmps, "yaw_most_nm": most_nm}
    none = dict.fromkeys(own, 0.0)
    budgets = {f"{axle}_{name}": value for name, value in own.items()}
    budgets |= {f"{other}_{name}": value for name, value in none.items()}
    tuned = LIMITER._replace(**budgets, yaw_speed_mps=SPEED)
    # The right wheels skid and get nothing: the left ones may have what the budget allows.
    wheels = tuple(rolls * (0.5 if i % 2 else 1.0) for i, rolls in enumerate(rolling()))
    before = remembered(speed_radps=wheels)._replace(**{f"{axle}_unequal_s": 2.0, f"{other}_unequal_s": 0.0})
    _, after = step(measured(-300e3, wheels), before, tuned)
    left_nm, right_nm = of(axle, [abs(wheel.total_nm) for wheel in after.wheels])
    part = getattr(CAR, axle)
    assert (left_nm - right_nm) * part.track_width_m / 2.0 / part.wheel.radius_m == pytest.approx(moment_nm)
    assert of(other, [wheel.total_nm for wheel in after.wheels]) == [0.0, 0.0]


@pytest.mark.parametrize("front_s", [2.0, -2.0])
@pytest.mark.parametrize("rear_s", [2.0, -2.0, 0.0])
def test_a_gyroscope_adds_to_both_yaw_budgets_on_the_side_that_the_front_wheels_brake_more(front_s, rear_s):
    none = {f"{axle}_{name}": 0.0 for axle in ("front", "rear") for name in ("yaw_nm", "yaw_growth_nmps")}
    tuned = LIMITER._replace(**none, yaw_rate_growth_nmps=600.0, yaw_speed_mps=SPEED)
    more = 0 if front_s > 0.0 else 1
    wheels = tuple(rolls * (1.0 if i % 2 == more else 0.5) for i, rolls in enumerate(rolling()))
    seen = no_yaw(400.0)._replace(known_s=0.5, turned_rad=0.01, believed=True)
    before = remembered(speed_radps=wheels)._replace(front_unequal_s=front_s, rear_unequal_s=rear_s, yaw=seen)
    m = measured(-300e3, wheels)._replace(yaw_rate_radps=1e-6, lateral_mps2=SPEED * 1e-6)
    _, after = step(m, before, tuned)
    extra_nm = 400.0 + before.friction.left.friction / GROWTH_FRICTION * 600.0 * 0.01
    for first, axle, moment_nm in ((0, CAR.front, extra_nm), (2, CAR.rear, REAR_PART * extra_nm)):
        apart_nm = abs(after.wheels[first + more].total_nm) - abs(after.wheels[first + 1 - more].total_nm)
        assert apart_nm * axle.track_width_m / 2.0 / axle.wheel.radius_m == pytest.approx(moment_nm, rel=1e-3)


@AXLES
def test_an_axle_without_brakes_says_so_and_the_other_speaks_of_its_brakes(axle):
    command, _ = law.step(
        measured(-300e3), remembered(), OFF, changed(axle, "friction_brake", max_torque_nm=0.0), TABLE
    )
    assert command.limits & LIMIT_FRICTION_BRAKE
    assert command.limits & LIMIT_REGENERATION


@AXLES
def test_an_axle_that_falls_short_alone_says_what_keeps_it(axle):
    car = changed(axle, "friction_brake", max_torque_nm=0.0)
    motor = getattr(car, axle).motor
    car = car._replace(**{axle: getattr(car, axle)._replace(motor=motor._replace(regeneration_torque_nm=5.0))})
    command, after = law.step(measured(-8e3), remembered(), OFF, car, TABLE)
    given_w = sum(wheel.total_nm * rolls for wheel, rolls in zip(after.wheels, rolling(), strict=True))
    assert given_w == pytest.approx(-8e3)
    assert command.limits & LIMIT_REGENERATION


@AXLES
def test_friction_that_holds_against_motors_on_their_way_down_ends_at_the_axle_s_own_brakes(axle):
    command, _ = step(measured(-300e3), remembered(motor_nm=(120.0,) * 4), OFF._replace(slew_down_nmps=100.0))
    assert min(command.motor_torque_nm) > 0.0
    most = getattr(CAR, axle).friction_brake.max_torque_nm
    assert of(axle, command.friction_torque_nm) == pytest.approx((-most, -most))


@AXLES
def test_a_motor_warms_up_as_its_own_axle_s_motors_do(axle):
    car = changed(axle, "motor", thermal_time_constant_s=1e9)
    _, after = law.step(measured(20e3), remembered(motor_nm=(80.0,) * 4), OFF, car, TABLE)
    heats = [wheel.heat for wheel in after.wheels]
    assert max(of(axle, heats)) < 1e-9 < min(of("rear" if axle == "front" else "front", heats))


@AXLES
@pytest.mark.parametrize("side", [0, 1])
def test_an_axle_counts_as_unequal_where_its_own_wheels_brake_unequally_or_would(axle, side):
    other = "rear" if axle == "front" else "front"
    none = {name: getattr(CAR, name).friction_brake._replace(max_torque_nm=0.0) for name in ("front", "rear")}
    car = CAR._replace(**{name: getattr(CAR, name)._replace(friction_brake=brake) for name, brake in none.items()})
    # Half of a motor is gone: an axle's wheels brake alike as long as little is asked of them.
    gain = one(2 * (axle == "rear") + side, 0.5, (1.0,) * 4)

    at_once = OFF._replace(slew_regeneration_nmps=1e6)

    def unequal_s(demand, tuned):
        _, after = law.step(measured(demand, gain=gain), remembered(), tuned, car, TABLE)
        left, right = of(axle, [wheel.total_nm for wheel in after.wheels])
        assert getattr(after, f"{other}_unequal_s") == 0.0
        return left == right, getattr(after, f"{axle}_unequal_s")

    more = 0.01 if side else -0.01
    assert unequal_s(-1e3, at_once) == (True, 0.0)
    assert unequal_s(-8e3, at_once) == (False, more)
    select_low = at_once._replace(**{f"{axle}_yaw_nm": 0.0, f"{axle}_yaw_most_nm": 0.0})
    assert unequal_s(-8e3, select_low) == (True, more)
    # The other axle falls short, and this one does not.
    weak = getattr(car, other).motor._replace(regeneration_torque_nm=1.0)
    car = car._replace(**{other: getattr(car, other)._replace(motor=weak)})
    assert unequal_s(-1e3, at_once) == (True, 0.0)


@pytest.mark.parametrize("side", [0, 1])
def test_rooms_that_differ_by_a_fifth_of_the_larger_one_are_alike(side):
    brakes = CAR.front.friction_brake._replace(max_torque_nm=0.0)
    car = CAR._replace(front=CAR.front._replace(friction_brake=brakes))
    for gain, more in ((0.81, 0.0), (0.79, 0.01 if side else -0.01)):
        gains = one(side, gain, (1.0,) * 4)
        _, after = law.step(measured(-300e3, gain=gains), remembered(), OFF, car, TABLE)
        assert after.front_unequal_s == more


def test_the_friction_of_each_side_is_shown_as_that_side_s():
    start = remembered()
    grip = start.friction
    known = grip._replace(
        left=grip.left._replace(friction=0.3, confidence=0.9), right=grip.right._replace(friction=0.7, confidence=0.5)
    )
    command, after = step(measured(1e3), start._replace(friction=known))
    found = after.friction
    assert (command.left_friction, command.left_confidence) == (found.left.friction, found.left.confidence)
    assert (command.right_friction, command.right_confidence) == (found.right.friction, found.right.confidence)
    assert command.left_friction < 0.5 < command.right_friction
    assert command.left_confidence > command.right_confidence


def test_a_car_that_rolls_back_is_held_at_the_rim_of_its_front_wheels():
    command, _ = step(measured(1500.0, rolling(-0.5), speed=-0.5), remembered(-0.5), OFF)
    assert command.hold_nm == pytest.approx(
        0.25 * 0.25 * CAR.chassis.mass_kg * 9.81 * CAR.front.wheel.radius_m, rel=1e-3
    )


@pytest.mark.parametrize("force_n", [2000.0, -2000.0])
def test_wheels_of_two_sizes_are_believed_and_lead_the_speed_alike(force_n):
    """A second of driving or braking, with and without the speed sensor."""
    for sensor in (True, False):
        state, speed = remembered(), SPEED
        resisting_n = rolling_force_n(0.0, CAR.chassis) + aerodynamic_force_n(SPEED, CAR.chassis)
        acceleration = (force_n - resisting_n) / CAR.chassis.mass_kg
        axles = (CAR.front, CAR.front, CAR.rear, CAR.rear)
        torques = tuple(
            0.25 * force_n * a.wheel.radius_m + a.wheel.inertia_kgm2 * acceleration / a.wheel.radius_m for a in axles
        )
        for _ in range(100):
            speed += 0.01 * acceleration
            wheels = tuple(w._replace(total_nm=torque) for w, torque in zip(state.wheels, torques, strict=True))
            shown = measured(0.0, rolling(speed), speed=speed if sensor else float("nan"))
            command, state = step(shown, state._replace(wheels=wheels))
            assert command.doubted == (0 if sensor else 16)
            assert command.speed_mps == pytest.approx(speed, abs=0.15)


def doubted_after(state, wheels, **every_step):
    """What is doubted after a tenth of a second with these wheel speeds; `every_step` : of each wheel's memory."""
    for _ in range(10):
        remembered_wheels = tuple(
            wheel._replace(**{name: values[i] for name, values in every_step.items()})
            for i, wheel in enumerate(state.wheels)
        )
        command, state = step(measured(0.0, wheels), state._replace(wheels=remembered_wheels), OFF)
    return command.doubted


@WHEELS
def test_a_gated_wheel_should_be_back_and_one_that_is_not_may_be_a_little_away(wheel):
    wheels = one(wheel, (SPEED - 1.0) / RADII[wheel], rolling())
    start = remembered(speed_radps=wheels)
    nothing = (0.0,) * 4
    gated = one(wheel, True, (False,) * 4)
    assert doubted_after(start, wheels, gated=gated, total_nm=nothing) == 1 << wheel
    assert doubted_after(start, wheels, gated=tuple(not g for g in gated), total_nm=nothing) == 0


@WHEELS
def test_a_wheel_is_free_below_a_twentieth_of_its_own_axle_s_load(wheel):
    chassis = CAR.chassis
    a, b = chassis.front_axle_to_cg_m, chassis.rear_axle_to_cg_m
    load_n = 0.5 * chassis.mass_kg * 9.81 * (b if wheel < 2 else a) / (a + b)
    free_nm = 0.05 * load_n * RADII[wheel]
    wheels = one(wheel, (SPEED - 2.5) / RADII[wheel], rolling())
    start = remembered(speed_radps=wheels)
    for part, doubted in ((0.97, 1 << wheel), (1.03, 0)):
        torques = one(wheel, -part * free_nm, (0.0,) * 4)
        assert doubted_after(start, wheels, gated=(False,) * 4, total_nm=torques) == doubted


def test_five_speeds_that_agree_are_right_also_where_front_and_rear_wheels_differ_in_size():
    """A reference that the forces led astray is given up: rims are compared, each wheel's by its own radius."""
    state = remembered(12.0, speed_radps=rolling(20.0))
    state = state._replace(
        motion=state.motion._replace(speed_mps=12.0, shown_mps=20.0, wheel_doubt_s=(0.5,) * 4, doubt_s=0.5)
    )
    for k in range(130):
        speed = 20.0 + 0.001 * k
        command, state = step(measured(0.0, rolling(speed), speed=speed), state, OFF)
    assert command.doubted == 0
    assert command.speed_mps == pytest.approx(speed, abs=0.2)


@WHEELS
@pytest.mark.parametrize("part", [0.97, 1.03])
def test_wheels_that_turn_end_the_hold_by_the_rim_of_the_front_wheels(wheel, part):
    """Held on a slope, while the speed sensor shows nothing yet: of the four it is the mean, whichever turns."""
    wheels = one(wheel, 4.0 * part * MOVING_MPS / CAR.front.wheel.radius_m, (0.0,) * 4)
    state = remembered(0.0, speed_radps=wheels)._replace(hold_nm=100.0)
    command, _ = step(measured(0.0, wheels, speed=0.0), state, OFF)
    assert command.hold_nm == (0.0 if part > 1.0 else 100.0)


@WHEELS
@pytest.mark.parametrize("error", [-3.0, 3.0])
def test_a_run_without_a_sensor_starts_with_the_mean_of_the_two_middle_rims(wheel, error):
    rims = [14.9, 15.1, 14.9, 15.1]
    rims[wheel] = SPEED + error
    wheels = tuple(rim / radius for rim, radius in zip(rims, RADII, strict=True))
    command, _ = step(measured(0.0, wheels, speed=float("nan")), None, OFF)
    assert command.speed_mps == pytest.approx(sum(sorted(rims)[1:3]) / 2.0, abs=0.02)


@WHEELS
@pytest.mark.parametrize("demand", [-1e3, 0.0, 1e3])
def test_a_wheel_that_is_not_believed_does_not_lead_the_speed(wheel, demand):
    """Without a sensor, three wheels lead it; the fourth shows a fifth less, or more."""
    for part in (0.8, 1.2):
        wheels = one(wheel, part * SPEED / RADII[wheel], rolling())
        start = remembered(speed_radps=wheels)
        doubts = one(wheel, 0.5, (0.0,) * 4)
        state = start._replace(motion=start.motion._replace(wheel_doubt_s=doubts, shown_mps=float("nan")))
        for _ in range(20):
            command, state = step(measured(demand, wheels, speed=float("nan")), state, OFF)
            state = state._replace(wheels=start.wheels)
        assert command.doubted == 16 | 1 << wheel
        assert command.speed_mps == pytest.approx(SPEED, abs=0.05)


@AXLES
def test_an_axle_of_which_no_wheel_is_believed_is_taken_as_rolling_on_its_own_wheels(axle):
    doubts = (0.5, 0.5, 0.0, 0.0) if axle == "front" else (0.0, 0.0, 0.5, 0.5)
    wheels = tuple(0.5 * w if doubt else w for w, doubt in zip(rolling(), doubts, strict=True))
    start = remembered(speed_radps=wheels)
    command, _ = step(measured(0.0, wheels), start._replace(motion=start.motion._replace(wheel_doubt_s=doubts)), OFF)
    assert command.doubted == (3 if axle == "front" else 12)
    # What an axle's wheels do is told by its slip: none, though they seem to stand half still.
    assert (command.front_slip, command.rear_slip) == (pytest.approx(0.0, abs=1e-6), pytest.approx(0.0, abs=1e-6))


@WHEELS
def test_a_torque_moves_the_car_by_the_radius_of_its_own_wheel(wheel):
    """Without sensor and wheels that are believed, the torque of one wheel is all that the speed follows."""
    start = remembered()
    nobody = start.motion._replace(wheel_doubt_s=(0.5,) * 4, shown_mps=float("nan"), doubt_s=0.5)

    def speed(torque_nm):
        wheels = tuple(w._replace(total_nm=torque_nm if i == wheel else 0.0) for i, w in enumerate(start.wheels))
        _, after = step(measured(0.0, speed=float("nan")), start._replace(wheels=wheels, motion=nobody), OFF)
        return after.motion.speed_mps

    gained = speed(200.0) - speed(0.0)
    assert gained == pytest.approx(0.01 * 200.0 / RADII[wheel] / CAR.chassis.mass_kg, rel=1e-3)


@AXLES
def test_an_axle_that_has_all_it_was_asked_for_says_nothing_of_its_warm_motors(axle):
    """The other one is too weak for its half, and says that it is its motors."""
    heats = tuple(0.5 if (i < 2) == (axle == "rear") else 0.0 for i in range(4))
    weak = changed(axle, "motor", peak_torque_nm=20.0, continuous_torque_nm=20.0)
    command, _ = law.step(measured(5e3), remembered(heat=heats, motor_nm=(20.0,) * 4), OFF, weak, TABLE)
    assert command.limits & (LIMIT_MOTOR | LIMIT_THERMAL) == LIMIT_MOTOR


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_axles_that_have_all_they_were_asked_for_say_nothing_however_uneven_that_is(share):
    tuned = OFF._replace(strategy=default_settings("rule").strategy)
    table = empty_table(rule=(0.0, share, 0.0, share))
    state = remembered(heat=(0.5,) * 4)
    for _ in range(3):
        command, state = law.step(measured(3e3), state, tuned, CAR, table)
        state = state._replace(wheels=remembered(heat=(0.5,) * 4).wheels)
    assert (command.front_share - 0.5) * (share - 0.5) > 0.0
    assert command.limits & (LIMIT_MOTOR | LIMIT_THERMAL) == 0


def rolling_torque_nm(axle):
    """Torque above which a wheel of this axle might slip: 0.08 of its load."""
    chassis = CAR.chassis
    a, b = chassis.front_axle_to_cg_m, chassis.rear_axle_to_cg_m
    load_n = 0.5 * chassis.mass_kg * 9.81 * (b if axle == "front" else a) / (a + b)
    return 0.08 * load_n * getattr(CAR, axle).wheel.radius_m


@WHEELS
@pytest.mark.parametrize(("part", "right"), [(0.96, True), (1.04, False)])
def test_five_speeds_that_agree_are_right_at_once_where_each_torque_is_small_for_the_wheel_s_own_load(
    wheel, part, right
):
    """More torque than a rolling wheel takes might be slip, which is waited for."""
    state = remembered(12.0, speed_radps=rolling(20.0))
    state = state._replace(
        motion=state.motion._replace(speed_mps=12.0, shown_mps=20.0, wheel_doubt_s=(0.5,) * 4, doubt_s=0.5)
    )
    torques = one(wheel, part * rolling_torque_nm("front" if wheel < 2 else "rear"), (0.0,) * 4)
    for k in range(60):
        speed = 20.0 + 0.001 * k
        wheels = tuple(w._replace(total_nm=torque) for w, torque in zip(state.wheels, torques, strict=True))
        command, state = step(measured(0.0, rolling(speed), speed=speed), state._replace(wheels=wheels), OFF)
    assert (command.doubted == 0) == right


@WHEELS
def test_a_brake_that_gives_less_counts_for_less_on_its_own_wheel(wheel):
    before = remembered()
    before = before._replace(motion=before.motion._replace(speed_mps=SPEED, brake_gain=one(wheel, 0.25, (1.0,) * 4)))
    command, after = law.step(measured(-60e3), before, OFF, CAR, TABLE)
    assert max(command.friction_torque_nm) < -10.0
    gave = [state.total_nm - motor for state, motor in zip(after.wheels, command.motor_torque_nm, strict=True)]
    part = [nm / told for nm, told in zip(gave, command.friction_torque_nm, strict=True)]
    assert part == pytest.approx(one(wheel, 0.25, (1.0,) * 4))
