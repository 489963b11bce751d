# SPDX-License-Identifier: Apache-2.0
"""Motion in the plane: against SciPy, against closed forms, at rest, and against the straight line it contains."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.tyre import make
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.double_track import loads_n
from iwm_sim.plant import Surroundings, advance, initial_plant
from oracles import plane

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none").params
NOTHING = (0.0, 0.0, 0.0, 0.0)
DRY = (0.9, 0.9, 0.9, 0.9)
RADIUS = CAR.front.wheel.radius_m
#: Without air, rolling resistance and driven wheels: what is left is cornering.
FREE = CAR._replace(chassis=CAR.chassis._replace(drag_coefficient=0.0, rolling_resistance=0.0))


def four(x):
    return (x, x, x, x)


def drive(state, seconds, dt=0.01, motor=NOTHING, brake=NOTHING, steer=0.0, road=DRY, grade=0.0, wind=0.0, car=CAR):
    for _ in range(round(seconds / dt)):
        state = advance(state, motor, brake, steer, Surroundings(road, grade, wind), dt, 1, car)
    return state


def state_of(car):
    return [
        car.speed_mps,
        car.lateral_speed_mps,
        car.yaw_rate_radps,
        *car.wheel_speed_radps,
        car.x_m,
        car.y_m,
        car.heading_rad,
    ]


# --- against SciPy ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("motors", "steer", "road"),
    [
        (NOTHING, 0.03, DRY),
        ((40.0, 40.0, 40.0, 40.0), -0.05, DRY),
        ((-60.0, -20.0, -60.0, -20.0), 0.0, DRY),
        ((-60.0, -60.0, -40.0, -40.0), 0.04, (0.2, 0.9, 0.2, 0.9)),
        ((80.0, 10.0, 0.0, 0.0), 0.02, (0.5, 0.9, 0.9, 0.5)),
    ],
)
def test_it_moves_as_scipy_says(motors, steer, road):
    expected = plane.after(15.0, motors, steer, road, 1.0, CAR)
    found = drive(initial_plant(CAR, 0.8, 15.0), 1.0, 0.0005, motors, steer=steer, road=road)
    assert state_of(found) == pytest.approx(list(expected), abs=5e-3, rel=2e-3)


def test_a_step_of_ten_milliseconds_is_close_to_the_limit():
    fine = drive(initial_plant(CAR, 0.8, 15.0), 2.0, 0.0005, steer=0.04)
    coarse = drive(initial_plant(CAR, 0.8, 15.0), 2.0, 0.01, steer=0.04)
    assert state_of(coarse)[:7] == pytest.approx(state_of(fine)[:7], rel=0.02, abs=0.01)


# --- closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [10.0, 20.0, 30.0])
@pytest.mark.parametrize("front_to_cg", [0.8, 0.92, 1.04])
def test_a_steady_turn_has_the_understeer_gradient_of_its_tyres(speed, front_to_cg):
    """yaw rate = v delta / (L + K v^2), K = m (b / C_f - a / C_r) / L; at small slip, where the tyres are linear."""
    length = 1.84
    chassis = FREE.chassis._replace(front_axle_to_cg_m=front_to_cg, rear_axle_to_cg_m=length - front_to_cg)
    stiff = make("fiala", {"slip_stiffness": 20.0, "sliding_factor": 1.0}, 0.5)
    soft = make("fiala", {"slip_stiffness": 14.0, "sliding_factor": 1.0}, 0.5)
    car = FREE._replace(chassis=chassis, front=FREE.front._replace(tyre=soft), rear=FREE.rear._replace(tyre=stiff))
    weight = chassis.mass_kg * GRAVITY_MPS2
    front = 14.0 * weight * (length - front_to_cg) / length
    rear = 20.0 * weight * front_to_cg / length
    gradient = chassis.mass_kg * ((length - front_to_cg) / front - front_to_cg / rear) / length
    steer = 0.002 if speed < 25.0 else 0.0005
    turned = drive(initial_plant(car, 0.8, speed), 4.0, steer=steer, car=car)
    expected = turned.speed_mps * steer / (length + gradient * turned.speed_mps**2)
    assert turned.yaw_rate_radps == pytest.approx(expected, rel=0.01)
    assert turned.lateral_acceleration_mps2 == pytest.approx(turned.speed_mps * turned.yaw_rate_radps, rel=0.01)


def test_a_slow_turn_follows_its_circle():
    """Ackermann: radius L / delta about the rear axle, whose track is the car's path."""
    turned = drive(initial_plant(FREE, 0.8, 2.0), 5.0, steer=0.1, car=FREE)
    radius = 1.84 / math.tan(0.1)
    assert turned.speed_mps / turned.yaw_rate_radps == pytest.approx(radius, rel=0.01)
    angle = turned.heading_rad
    start = np.array([-0.92, 0.0])
    rear = np.array([turned.x_m - 0.92 * math.cos(angle), turned.y_m - 0.92 * math.sin(angle)]) - start
    assert rear == pytest.approx([radius * math.sin(angle), radius * (1.0 - math.cos(angle))], rel=0.02)


@pytest.mark.parametrize("speed", [20.0, -20.0])
def test_coasting_down_follows_its_closed_form(speed):
    """v(t) = sqrt(b / a) tan(atan(v0 sqrt(a / b)) - t sqrt(a b)), with a v^2 of air and b of rolling; both ways."""
    chassis = CAR.chassis
    mass = chassis.mass_kg + 4.0 * CAR.front.wheel.inertia_kgm2 / RADIUS**2
    a = 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient / mass
    b = chassis.rolling_resistance * chassis.mass_kg * GRAVITY_MPS2 / mass
    state = drive(initial_plant(CAR, 0.8, speed), 30.0)
    expected = math.sqrt(b / a) * math.tan(math.atan(abs(speed) * math.sqrt(a / b)) - 30.0 * math.sqrt(a * b))
    assert state.speed_mps == pytest.approx(math.copysign(expected, speed), rel=1e-3)


@pytest.mark.parametrize("wind", [10.0, -10.0])
def test_wind_pushes_with_the_square_of_the_air_speed(wind):
    state = drive(initial_plant(CAR, 0.8, 20.0), 0.01, wind=wind)
    calm = drive(initial_plant(CAR, 0.8, 20.0), 0.01)
    chassis = CAR.chassis
    more = 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient
    more *= (20.0 + wind) ** 2 - 20.0**2
    assert chassis.mass_kg * (calm.acceleration_mps2 - state.acceleration_mps2) == pytest.approx(more, rel=0.07)


@pytest.mark.parametrize(("friction", "speed"), [(0.9, 25.0), (0.2, 25.0), (0.5, -10.0)])
def test_locked_wheels_stop_the_car_within_the_distance_of_their_friction(friction, speed):
    state = initial_plant(FREE, 0.8, speed)._replace(wheel_speed_radps=NOTHING)
    seconds = 0.0
    while abs(state.speed_mps) > 0.0 and seconds < 30.0:
        state = drive(state, 0.01, brake=four(-900.0), road=four(friction), car=FREE)
        seconds += 0.01
    sliding = friction * math.sin(1.9 * math.atan(10.0 - 0.97 * (10.0 - math.atan(10.0))))
    assert abs(state.distance_m) == pytest.approx(speed**2 / (2.0 * sliding * GRAVITY_MPS2), rel=0.02)


def test_the_right_wheels_brake_a_car_to_the_right():
    state = drive(initial_plant(CAR, 0.8, 20.0), 0.5, brake=(0.0, -150.0, 0.0, -150.0))
    assert state.heading_rad < -0.01


# --- loads -----------------------------------------------------------------------------------------------------------


@given(st.floats(-9.0, 9.0), st.floats(-6.0, 6.0), st.floats(-0.3, 0.3))
def test_the_loads_carry_the_weight_and_lean_to_the_outside(along, across, grade):
    load = loads_n(along, across, 20.0, grade, CAR)
    weight = CAR.chassis.mass_kg * GRAVITY_MPS2 / math.sqrt(1.0 + grade * grade)
    assert sum(load) == pytest.approx(weight)
    assert min(load) >= 0.0
    if across > 0.0:  # to the left: the right wheels carry more
        assert load[1] >= load[0]
        assert load[3] >= load[2]


def test_the_roll_share_says_which_axle_leans():
    car = CAR._replace(
        chassis=CAR.chassis._replace(front_roll_share=0.75),
        front=CAR.front._replace(track_width_m=1.2),
        rear=CAR.rear._replace(track_width_m=1.4),
    )
    load = loads_n(0.0, 3.0, 0.0, 0.0, car)
    moved = CAR.chassis.mass_kg * 3.0 * CAR.chassis.cg_height_m
    assert load[1] - load[0] == pytest.approx(2.0 * 0.75 * moved / 1.2)
    assert load[3] - load[2] == pytest.approx(2.0 * 0.25 * moved / 1.4)


# --- at rest and through it ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grade", [0.2, -0.2, 0.05])
def test_brakes_hold_the_car_on_a_slope_for_good(grade):
    state = drive(initial_plant(CAR), 60.0, 0.02, brake=four(-200.0), grade=grade)
    assert (state.speed_mps, state.distance_m, state.wheel_speed_radps) == (0.0, 0.0, NOTHING)
    assert sum(state.friction_torque_nm) == pytest.approx(
        CAR.chassis.mass_kg * GRAVITY_MPS2 * grade / math.sqrt(1.0 + grade**2) * RADIUS, rel=1e-6
    )


def test_two_braked_wheels_hold_what_two_can_hold():
    held = drive(initial_plant(CAR), 5.0, brake=(0.0, 0.0, -300.0, -300.0), grade=0.15)
    assert held.distance_m == 0.0
    assert held.friction_torque_nm[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
    slid = drive(initial_plant(CAR), 2.0, brake=(0.0, 0.0, -300.0, -300.0), grade=0.15, road=four(0.15))
    assert slid.speed_mps < -0.5
    assert slid.wheel_speed_radps[2] == 0.0


def test_a_car_without_brakes_rolls_back_and_its_wheels_with_it():
    state = drive(initial_plant(FREE), 2.0, grade=0.1, car=FREE)
    mass = FREE.chassis.mass_kg + 4.0 * FREE.front.wheel.inertia_kgm2 / RADIUS**2
    pull = FREE.chassis.mass_kg * GRAVITY_MPS2 * 0.1 / math.sqrt(1.01)
    assert state.speed_mps == pytest.approx(-2.0 * pull / mass, rel=1e-3)
    assert state.wheel_speed_radps == pytest.approx(four(state.speed_mps / RADIUS), rel=0.01)
    assert state.lateral_speed_mps == pytest.approx(0.0, abs=1e-9)


def test_a_rolling_car_is_stopped_by_its_brakes_in_both_directions_and_stays():
    for speed in (3.0, -3.0):
        state = drive(initial_plant(CAR, 0.8, speed), 3.0, brake=four(-100.0), grade=0.05)
        assert (state.speed_mps, state.wheel_speed_radps) == (0.0, NOTHING)


def test_it_drives_off_backwards_and_comes_through_standstill_forwards():
    back = drive(initial_plant(CAR), 3.0, motor=four(-50.0))
    assert back.speed_mps < -1.0
    forth = drive(back, 6.0, motor=four(50.0))
    assert forth.speed_mps > 1.0


def test_rolling_resistance_holds_on_a_slope_that_is_less():
    assert drive(initial_plant(CAR), 5.0, grade=0.008).distance_m == 0.0
    assert drive(initial_plant(CAR), 5.0, grade=0.012).distance_m < 0.0


# --- the straight line it contains -----------------------------------------------------------------------------------


@settings(max_examples=30)
@given(
    st.floats(0.5, 35.0), st.floats(-70.0, 120.0), st.sampled_from([0.0, -60.0, -300.0]), st.sampled_from([0.9, 0.3])
)
def test_on_a_straight_uniform_road_it_is_the_longitudinal_model(speed, motor, brake, friction):
    """A breath of wind takes the straight line's own solution out of play."""
    assume(motor >= 0.0 or speed > 6.0)  # at rest, a torque backwards would be a drive backwards
    start = initial_plant(CAR, 0.8, speed)
    straight = plain = start
    for _ in range(40):
        straight = drive(straight, 0.01, motor=four(motor), brake=four(brake), road=four(friction))
        plain = drive(plain, 0.01, motor=four(motor), brake=four(brake), road=four(friction), wind=1e-300)
    assert plain.speed_mps == pytest.approx(straight.speed_mps, rel=1e-6, abs=0.03)
    assert plain.wheel_speed_radps == pytest.approx(straight.wheel_speed_radps, rel=1e-5, abs=0.1)
    assert plain.energies.chemical_j == pytest.approx(straight.energies.chemical_j, rel=1e-3, abs=1.0)
    assert plain.y_m == pytest.approx(0.0, abs=1e-6)


def test_mirrored_roads_give_mirrored_motion():
    left = drive(initial_plant(CAR, 0.8, 20.0), 1.0, brake=four(-150.0), road=(0.2, 0.9, 0.2, 0.9), steer=0.01)
    right = drive(initial_plant(CAR, 0.8, 20.0), 1.0, brake=four(-150.0), road=(0.9, 0.2, 0.9, 0.2), steer=-0.01)
    assert left.speed_mps == pytest.approx(right.speed_mps, rel=1e-9)
    assert left.heading_rad == pytest.approx(-right.heading_rad, rel=1e-6)
    assert left.y_m == pytest.approx(-right.y_m, rel=1e-6)
    assert left.wheel_speed_radps == pytest.approx(tuple(right.wheel_speed_radps[i] for i in (1, 0, 3, 2)), rel=1e-6)


def test_on_ice_a_hard_stop_of_one_side_spins_the_car_and_it_comes_to_rest():
    state = drive(initial_plant(CAR, 0.8, 25.0), 20.0, brake=(-400.0, 0.0, -400.0, 0.0), road=(0.9, 0.2, 0.9, 0.2))
    assert np.isfinite(state_of(state)).all()
    assert abs(state.heading_rad) > 0.5
