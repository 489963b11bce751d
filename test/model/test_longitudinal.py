# SPDX-License-Identifier: Apache-2.0
"""The implicit step: it solves the equations, agrees with SciPy, and is right where the answer is known."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model.longitudinal import Speeds, Torques, step, wheel_step
from iwm_power_manager.model.tyre import wheel_speed_at_slip
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import physics
from oracles.step import G, friction_coefficient

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS, INERTIA, MASS = CAR.front.wheel.radius_m, CAR.front.wheel.inertia_kgm2, CAR.chassis.mass_kg
NOTHING = (0.0, 0.0)
DRY = (0.9, 0.9)


def two(x):
    return (x, x)


def four(front_and_rear):
    """What the wheels of both axles have, for an oracle that knows left and right."""
    front, rear = front_and_rear
    return (front, front, rear, rear)


def rolling(speed):
    return two(speed / RADIUS)


def drive(speed, seconds, dt, motor=NOTHING, brake=NOTHING, grade=0.0, friction=DRY, car=CAR, wheels=None):
    """Speed, wheel speeds and distance after a time, and the largest slip on the way."""
    wheels, acceleration, distance, worst = wheels or rolling(speed), 0.0, 0.0, 0.0
    for _ in range(round(seconds / dt)):
        moved = step(Speeds(speed, *wheels), Torques(*motor, *brake), acceleration, grade, friction, dt, car)
        distance += 0.5 * (speed + moved.speeds.car_mps) * dt
        acceleration = (moved.speeds.car_mps - speed) / dt
        speed, *wheels = moved.speeds
        worst = max(worst, *(abs(physics.slip(w, speed, RADIUS, 0.5)) for w in wheels))
    return speed, wheels, distance, worst


def residuals(before, moved, motors, grade, friction, dt):
    """Eq. 1 and 11 at the end of the step: what is left over, as accelerations of car and rims, m/s2."""
    v, *wheels = moved.speeds
    forces = (moved.front_force_n, moved.rear_force_n)
    resisting = (moved.front_resisting_nm, moved.rear_resisting_nm)
    acceleration = (v - before.car_mps) / dt
    normal = physics.normal_forces(acceleration, v, grade, CAR.chassis)
    aero = physics.road_load(v, 0.0, CAR.chassis) - physics.road_load(0.0, 0.0, CAR.chassis)
    slope = MASS * G * math.sin(math.atan(grade))
    left = [acceleration - (2.0 * sum(forces) - aero - slope - moved.rolling_force_n) / MASS]
    for i in range(2):
        mu = friction_coefficient(physics.slip(wheels[i], v, RADIUS, 0.5), friction[i], CAR.front.tyre)
        left.append((forces[i] - normal[i] * mu) / MASS)
        torque = motors[i] - resisting[i] - RADIUS * forces[i]
        left.append(((wheels[i] - before[1 + i]) / dt - torque / INERTIA) * RADIUS)
    return left


TORQUES = st.tuples(*[st.floats(-80.0, 200.0)] * 2)
BRAKES = st.tuples(*[st.one_of(st.just(0.0), st.floats(0.0, 900.0))] * 2)
SLIPS = st.tuples(*[st.floats(-1.0, 0.9)] * 2)
FRICTIONS = st.tuples(*[st.sampled_from([0.9, 0.5, 0.2])] * 2)


@given(
    st.one_of(st.just(0.0), st.floats(0.0, 3.0), st.floats(0.0, 45.0)),
    SLIPS,
    TORQUES,
    BRAKES,
    st.sampled_from([0.0, 0.06, -0.06]),
    FRICTIONS,
    st.sampled_from([0.001, 0.002, 0.005]),
)
def test_any_step_solves_the_equations_of_car_and_wheels(speed, slips, motors, brakes, grade, friction, dt):
    before = Speeds(speed, *(wheel_speed_at_slip(s, speed, RADIUS) for s in slips))
    moved = step(before, Torques(*motors, *brakes), 0.0, grade, friction, dt, CAR)
    assert min(moved.speeds) >= 0.0
    assert max(map(abs, residuals(before, moved, motors, grade, friction, dt))) < 1e-4
    for wheel, brake, told in zip(moved.speeds[1:], moved[3:5], brakes, strict=True):
        # A brake that stops a wheel exerts what it takes; one that does not, all it was told.
        if wheel > 0.0:
            assert brake == told
    full = CAR.chassis.rolling_resistance * MASS * G * math.cos(math.atan(grade))
    if moved.speeds.car_mps > 0.0:
        assert moved.rolling_force_n == pytest.approx(full, rel=1e-6, abs=1e-4)


@pytest.mark.parametrize(
    ("speed", "motors", "brakes", "grade", "friction"),
    [
        (15.0, (60.0, 20.0), NOTHING, 0.0, DRY),
        (20.0, two(-50.0), (100.0, 50.0), 0.03, DRY),
        (12.0, (90.0, -20.0), (0.0, 40.0), -0.02, (0.9, 0.5)),
        (8.0, two(140.0), NOTHING, 0.0, two(0.2)),
    ],
)
def test_small_steps_agree_with_scipy(speed, motors, brakes, grade, friction):
    known, known_wheels = physics.dynamics(
        speed, four(rolling(speed)), four(motors), four(brakes), grade, four(friction), 0.4, CAR
    )
    ours, wheels, *_ = drive(speed, 0.4, 0.0005, motors, brakes, grade, friction)
    assert ours == pytest.approx(known, abs=2e-3)
    assert wheels == pytest.approx(known_wheels[::2], abs=0.02)
    # First order: half the step, half the error.
    errors = [abs(drive(speed, 0.4, dt, motors, brakes, grade, friction)[0] - known) for dt in (0.004, 0.002)]
    assert errors[1] < 0.65 * errors[0] + 1e-5


def test_a_rolling_car_slows_down_by_its_road_load():
    """Coast-down: (m + 4 I / r^2) dv/dt = -(A + B v^2) has v = sqrt(A/B) tan(...) in closed form."""
    a = CAR.chassis.rolling_resistance * MASS * G
    b = 0.5 * 1.2 * 1.66 * 0.34
    mass = MASS + 4.0 * INERTIA / RADIUS**2
    root = math.sqrt(a * b)
    known = math.sqrt(a / b) * math.tan(math.atan(30.0 * math.sqrt(b / a)) - root / mass * 20.0)
    speed, wheels, *_ = drive(30.0, 20.0, 0.01)
    assert speed == pytest.approx(known, abs=2e-3)
    assert wheels[0] * RADIUS == pytest.approx(speed, rel=1e-3)


@pytest.mark.parametrize("friction", [0.9, 0.5, 0.2])
def test_locked_wheels_stop_the_car_within_v_squared_over_two_mu_g(friction):
    car = CAR._replace(chassis=CAR.chassis._replace(drag_coefficient=0.0, rolling_resistance=0.0))
    sliding = abs(friction_coefficient(-1.0, friction, CAR.front.tyre))
    speed, _, distance, _ = drive(
        25.0, 25.0 / (sliding * G) + 2.0, 0.01, brake=two(900.0), friction=two(friction), car=car, wheels=NOTHING
    )
    assert speed < 1e-9
    # Below the floor speed the tyre gives way; that is the last 0.5 m/s.
    assert distance == pytest.approx(25.0**2 / (2.0 * sliding * G), rel=0.005)


def test_a_car_at_rest_stays_there():
    assert drive(0.0, 1.0, 0.01)[:3] == (0.0, [0.0, 0.0], 0.0)


@pytest.mark.parametrize("grade", [0.3, 0.05])
def test_a_car_that_would_roll_backwards_stands(grade):
    assert drive(0.0, 1.0, 0.01, grade=grade)[0] == 0.0


def test_brakes_hold_a_car_facing_downhill_and_without_them_it_rolls():
    assert drive(0.0, 1.0, 0.01, brake=two(200.0), grade=-0.2)[0] < 0.02
    speed, *_ = drive(0.0, 1.0, 0.01, grade=-0.2)
    net = MASS * G * (math.sin(math.atan(0.2)) - 0.01 * math.cos(math.atan(0.2)))
    assert speed == pytest.approx(net / (MASS + 4.0 * INERTIA / RADIUS**2), rel=0.01)


def test_a_brake_stops_a_free_wheel_within_a_step_and_exerts_only_what_that_takes():
    speed, force, brake = wheel_step(3.0, 0.0, 0.0, 900.0, 0.0, 0.9, 0.01, CAR.front.wheel, CAR.front.tyre)
    assert (speed, force) == (0.0, 0.0)
    assert brake == pytest.approx(INERTIA * 3.0 / 0.01)


def test_a_wheel_in_the_air_takes_all_the_torque():
    speed, force, brake = wheel_step(3.0, 10.0, 50.0, 10.0, 0.0, 0.9, 0.01, CAR.front.wheel, CAR.front.tyre)
    assert speed == pytest.approx(3.0 + 40.0 * 0.01 / INERTIA)
    assert (force, brake) == (pytest.approx(0.0, abs=1e-6), 10.0)


def test_each_axle_has_its_own_torques_and_its_own_road():
    whole = step(Speeds(15.0, *rolling(15.0)), Torques(100.0, 50.0, 0.0, 0.0), 0.0, 0.0, (0.9, 0.9), 0.01, CAR)
    icy = step(Speeds(15.0, *rolling(15.0)), Torques(100.0, 50.0, 0.0, 0.0), 0.0, 0.0, (0.05, 0.9), 0.01, CAR)
    assert whole.speeds.front_radps > whole.speeds.rear_radps
    assert whole.front_force_n > whole.rear_force_n
    assert icy.speeds.front_radps > whole.speeds.front_radps
    assert icy.front_force_n < whole.front_force_n
    assert icy.rear_force_n == pytest.approx(whole.rear_force_n, rel=0.1)


@pytest.mark.parametrize("dt", [0.1, 0.02, 0.001])
def test_from_standstill_to_40_m_s_it_is_stable_and_exact_at_any_step(dt):
    car = CAR._replace(chassis=CAR.chassis._replace(drag_coefficient=0.0))
    torque = two(150.0)
    mass = MASS + 4.0 * INERTIA / RADIUS**2
    force = 4.0 * 150.0 / RADIUS - CAR.chassis.rolling_resistance * MASS * G
    seconds = round(40.0 * mass / force, 1)
    speed, wheels, distance, worst = drive(0.0, seconds, dt, torque, car=car)
    # Slip makes the wheels a little faster than rolling, which costs a part in a thousand of the speed.
    assert speed == pytest.approx(force / mass * seconds, rel=2e-3)
    assert distance == pytest.approx(0.5 * force / mass * seconds**2, rel=5e-3)
    assert worst < 1.0
    assert wheels[0] * RADIUS == pytest.approx(speed, rel=0.05)


def test_a_wheel_driven_across_the_steep_part_of_the_tyre_s_curve_is_solved():
    # Braking slip before, driving torque beyond the grip: plain Newton goes to and fro between the curve's two ends.
    before = Speeds(1.0, wheel_speed_at_slip(-0.125, 1.0, RADIUS), wheel_speed_at_slip(0.0, 1.0, RADIUS))
    motors = (129.0, 0.0)
    moved = step(before, Torques(*motors, 0.0, 0.0), 0.0, 0.0, (0.2, 0.9), 0.005, CAR)
    assert max(map(abs, residuals(before, moved, motors, 0.0, (0.2, 0.9), 0.005))) < 1e-4
