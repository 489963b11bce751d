# SPDX-License-Identifier: Apache-2.0
"""The motion estimate: which sensor is believed, on roads whose every force is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iwm_power_manager.control import law
from iwm_power_manager.control.motion import DOUBT_SPEED, estimate
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS, INERTIA, MASS = CAR.front.wheel.radius_m, CAR.front.wheel.inertia_kgm2, CAR.chassis.mass_kg
DT = 0.01
NAMES = ("front_left", "front_right", "rear_left", "rear_right")


def resistance(v):
    c = CAR.chassis
    drag = 0.5 * c.air_density_kgpm3 * c.drag_coefficient * c.frontal_area_m2 * v * v
    return drag / MASS + c.rolling_resistance * 9.81


class Car:
    """A car that rolls without slip under a torque at each wheel; a slope it is not told of; sensors one can spoil."""

    def __init__(self, speed=20.0, grade_mps2=0.0, mass_kg=MASS):
        self.v, self.grade, self.mass = speed, grade_mps2, mass_kg
        self.state = initial_state()
        self.rim = [speed / RADIUS] * 4
        self.motion = None

    def step(self, torque=0.0, spoil_speed=lambda v: v, spoil_wheels=lambda w: w, demand=None, wheels=None):
        """One step with this torque at each wheel; `wheels`: rim speeds of wheels that slip."""
        shown = tuple(spoil_wheels(self.rim))
        demand = torque if demand is None else demand
        m = Measurement(spoil_speed(self.v), shown, float(demand), DT, 0.9, 1e5, 1e5, 0.5)
        self.motion, after = estimate(m, self.state.motion, self.state.wheels, 1.0, self.state.steps == 0, CAR)
        memory = tuple(
            wheel._replace(
                total_nm=float(torque), speed_radps=w, road_nm=wheel.total_nm - INERTIA * (w - wheel.speed_radps) / DT
            )
            for wheel, w in zip(self.state.wheels, self.motion.wheel_speed_radps, strict=True)
        )
        self.state = self.state._replace(steps=self.state.steps + 1, motion=after, wheels=memory)
        self.v += DT * (
            4.0 * torque / RADIUS / (self.mass + 4.0 * INERTIA / RADIUS**2) - resistance(self.v) - self.grade
        )
        self.rim = [self.v / RADIUS] * 4 if wheels is None else list(wheels(self.v))
        return self.motion


@pytest.mark.parametrize("torque", [-600.0, -150.0, 0.0, 100.0, 200.0])
@pytest.mark.parametrize(("grade", "mass"), [(0.0, 800.0), (1.9, 800.0), (-1.9, 800.0), (0.0, 1100.0)])
def test_a_true_sensor_is_taken_as_it_is_on_any_slope_and_with_any_load(torque, grade, mass):
    car = Car(25.0, grade, mass)
    for _ in range(250):
        v = car.v
        if v < 2.0:
            break
        motion = car.step(torque)
        assert motion.speed_mps == v
        assert motion.doubted == 0
        assert motion.wheel_speed_radps == (v / RADIUS,) * 4
        assert motion.lower_part == 1.0


def test_noise_is_no_reason_to_doubt():
    rng = np.random.default_rng(1)
    car = Car(20.0)
    for k in range(1500):
        car.step(
            (100.0, -150.0)[k // 100 % 2],
            lambda v: v + 0.1 * float(rng.standard_normal()),
            lambda w: [x + 0.2 * float(rng.standard_normal()) for x in w],
        )
        assert car.motion.doubted == 0


SPOILT = {
    "half": lambda v, t: 0.5 * v,
    "double": lambda v, t: 2.0 * v,
    "high": lambda v, t: 1.2 * v,
    "offset": lambda v, t: v + 5.0,
    "walks up": lambda v, t: v + 5.0 * t,
    "walks down": lambda v, t: v - 5.0 * t,
    "stuck": lambda v, t: 20.0,
    "missing": lambda v, t: math.nan,
}


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.parametrize("torque", [-300.0, -150.0, 60.0])
def test_a_wrong_speed_sensor_is_named_and_the_speed_stays_right(name, torque):
    car = Car(20.0)
    for _ in range(50):
        car.step(0.0)
    start, found = car.v, None
    car.v = start if name != "stuck" else 20.0
    for k in range(150):
        v = car.v
        if v < 3.0:
            break
        motion = car.step(torque, lambda v, k=k: SPOILT[name](v, (k + 1) * DT))
        if motion.doubted & DOUBT_SPEED and found is None:
            found = k * DT
        assert motion.doubted & 15 == 0
        if found is not None:
            assert motion.speed_mps == pytest.approx(v, abs=0.06 * v + 0.7)
    assert found is not None
    assert found <= (1.2 if name == "stuck" else 0.6)


@pytest.mark.parametrize("factor", [0.5, 0.75, 1.25, 0.0])
@pytest.mark.parametrize("which", [(0,), (3,), (0, 1, 2, 3)])
def test_wheels_that_jump_are_not_believed_and_the_sensor_is(factor, which):
    car = Car(20.0)
    for _ in range(30):
        car.step(-100.0)
    for _ in range(60):
        v = car.v
        motion = car.step(-100.0, spoil_wheels=lambda w: [x * factor if i in which else x for i, x in enumerate(w)])
        assert motion.speed_mps == v
    assert motion.doubted == sum(1 << i for i in which)
    assert motion.wheel_speed_radps == pytest.approx((v / RADIUS,) * 4)
    for _ in range(70):
        motion = car.step(-100.0)
    assert motion.doubted == 0, "good again for long enough"


def test_a_wheel_that_was_wrong_all_along_is_found_when_nothing_holds_it():
    car = Car(20.0)
    for _ in range(30):
        motion = car.step(0.0, spoil_wheels=lambda w: [w[0], w[1], 0.6 * w[2], w[3]])
    assert motion.doubted == 4
    assert motion.wheel_speed_radps[2] == motion.wheel_speed_radps[3]


@pytest.mark.parametrize("friction", [0.1, 0.2])
def test_wheels_that_really_skid_are_believed(friction):
    # The brakes take what the road cannot give: each wheel slows down by the difference.
    car, rim = Car(15.0), [15.0 / RADIUS] * 4
    grip = friction * MASS * 9.81 / 4.0 * RADIUS
    for _ in range(20):
        car.step(0.0)
    rim = car.v / RADIUS
    for _ in range(25):
        rim = max(rim - DT * (250.0 - grip) / INERTIA, 0.0)
        v = car.v
        car.step(-250.0, wheels=lambda v, rim=rim: [rim] * 4)
        car.v = v - DT * friction * 9.81
        assert car.motion.doubted == 0
    assert car.motion.speed_mps == pytest.approx(car.v, abs=0.1)


def test_without_any_believable_wheel_all_roll():
    car = Car(20.0)
    for _ in range(30):
        car.step(-100.0)
    motion = car.step(-100.0, spoil_wheels=lambda w: [0.0] * 4)
    assert motion.wheel_speed_radps == pytest.approx((motion.speed_mps / RADIUS,) * 4)


def test_where_nothing_tells_sensor_from_wheels_the_lower_speed_weakens_no_brake():
    car = Car(20.0)
    for _ in range(40):
        motion = car.step(0.0, lambda v: 0.8 * v)
    assert motion.doubted == DOUBT_SPEED  # at this speed it may be off by 5 m/s
    assert motion.lower_part == pytest.approx(0.8, abs=0.01)
    assert all(car.step(0.0, lambda v: 0.5 * v).lower_part == 1.0 for _ in range(3))


def test_the_estimate_goes_into_the_law():
    state, s = initial_state(), default_settings("equal")
    rolling = (20.0 / RADIUS,) * 4
    for _ in range(30):
        m = Measurement(30.0, rolling, 0.0, DT, 0.9, 1e5, 1e5, 0.5)
        command, state = law.step(m, state, s, CAR, empty_table())
    assert command.doubted == DOUBT_SPEED
    assert command.speed_mps == pytest.approx(20.0, abs=0.5)


@pytest.mark.parametrize("wheel", range(4))
def test_a_braked_wheel_that_is_faster_than_the_car_is_not_believed(wheel):
    car = Car(12.0)
    for _ in range(20):
        car.step(0.0)
    stuck = car.rim[wheel]
    for _ in range(60):
        motion = car.step(-400.0, spoil_wheels=lambda w: [stuck if i == wheel else x for i, x in enumerate(w)])
    assert motion.doubted == 1 << wheel


def test_wheels_that_are_all_wrong_by_one_factor_still_tell_the_one_that_locks():
    car = Car(20.0)
    for _ in range(30):
        car.step(-100.0)
    for _ in range(60):
        motion = car.step(-100.0, spoil_wheels=lambda w: [0.8 * x for x in w])
    assert motion.doubted == 15
    assert motion.wheel_speed_radps == pytest.approx((motion.speed_mps / RADIUS,) * 4)
    for k in range(21):
        locking = 0.8 - 0.02 * k
        motion = car.step(-400.0, spoil_wheels=lambda w, part=locking: [part * w[0], *(0.8 * x for x in w[1:])])
    assert motion.wheel_speed_radps[0] == pytest.approx(0.5 * motion.speed_mps / RADIUS)
    assert motion.wheel_speed_radps[1:] == pytest.approx((motion.speed_mps / RADIUS,) * 3)


@pytest.mark.parametrize("torque", [-600.0, -100.0, 0.0, 150.0])
@pytest.mark.parametrize("factor", [0.78, 0.9, 1.1, 1.25])
def test_all_wheels_that_jump_by_one_factor_at_low_speed_are_corrected_until_they_jump_back(factor, torque):
    car = Car(9.0)
    for k in range(60):
        wrong = factor if 20 <= k < 40 else 1.0
        v = car.v
        motion = car.step(torque, spoil_wheels=lambda w, wrong=wrong: [wrong * x for x in w])
        assert motion.speed_mps == v
        assert motion.wheel_speed_radps == pytest.approx((v / RADIUS,) * 4, rel=0.02)
        assert motion.doubted == (15 if wrong != 1.0 else 0)
        assert motion.lower_part == 1.0


@pytest.mark.parametrize("factor", [0.76, 0.93, 1.07, 1.24])
@pytest.mark.parametrize("wrong", ["wheels", "speed"])
def test_where_sensor_and_wheels_differ_by_a_factor_from_the_start_on_slip_is_slip_and_the_lower_divides(factor, wrong):
    spoilt = {
        "wheels": {"spoil_wheels": lambda w: [factor * x for x in w]},
        "speed": {"spoil_speed": lambda v: v / factor},
    }[wrong]
    car = Car(9.0)
    for _ in range(40):
        motion = car.step(0.0, **spoilt)
    for torque, slip in ((-100.0, 0.0), (-250.0, 0.1)):
        for k in range(20):
            v, held = car.v, slip * min(k, 10) / 10.0
            motion = car.step(torque, wheels=lambda v, held=held: [(1.0 - held) * v / RADIUS] * 4, **spoilt)
        shown = v if wrong == "wheels" else v / factor
        assert motion.speed_mps == pytest.approx(shown)
        assert [RADIUS * x / motion.speed_mps for x in motion.wheel_speed_radps] == pytest.approx(
            [1.0 - slip] * 4, abs=0.01
        )
        assert motion.lower_part * motion.speed_mps == pytest.approx(min(shown, shown * factor), rel=0.01)
        assert motion.doubted == 15


@pytest.mark.parametrize("wrong", ["wheels", "speed"])
def test_what_was_wrong_by_a_factor_from_the_start_on_and_is_right_again_is_believed(wrong):
    car = Car(9.0)
    for k in range(100):
        spoilt = {}
        if k < 40:
            spoilt = {
                "wheels": {"spoil_wheels": lambda w: [0.8 * x for x in w]},
                "speed": {"spoil_speed": lambda v: 1.2 * v},
            }[wrong]
        v = car.v
        motion = car.step(0.0, **spoilt)
    assert motion.doubted == 0
    assert (motion.speed_mps, motion.lower_part) == (v, 1.0)


def test_a_sensor_that_is_off_by_no_factor_from_the_start_on_is_found_when_the_wheels_roll():
    car = Car(20.0)
    for torque in (0.0,) * 50 + (-200.0,) * 150 + (0.0,) * 50:
        v = car.v
        motion = car.step(torque, lambda v: v + 5.0)
    assert motion.doubted == DOUBT_SPEED
    assert motion.speed_mps == pytest.approx(v, abs=0.7)


@pytest.mark.parametrize(("torque", "part"), [(40.0, 1.09), (40.0, 1.3), (-40.0, 0.91), (-40.0, 0.8)])
def test_wheels_that_slip_together_on_the_smoothest_ice_contradict_no_sensor_and_are_no_factor_apart(torque, part):
    car = Car(6.0)
    slips = [1.0 + (part - 1.0) * min(i / 30.0, 1.0) for i in range(100)]
    slipping = [car.step(torque, wheels=lambda v, s=slip: (s * v / RADIUS,) * 4).doubted for slip in slips]
    assert max(slipping) == 0
    against = [car.step(-torque, wheels=lambda v: (part * v / RADIUS,) * 4).doubted for _ in range(60)]
    assert against[-1] != 0, "no torque makes them slip that way"


@pytest.mark.parametrize("factor", [0.6, 0.985, 1.015, 1.6])
def test_sensor_and_wheels_that_are_nearly_the_same_or_far_apart_are_no_factor_apart(factor):
    car = Car(20.0)
    for _ in range(100):
        v = car.v
        motion = car.step(0.0, lambda v: factor * v)
    near = abs(factor - 1.0) < 0.1
    assert motion.doubted == (0 if near else DOUBT_SPEED)
    assert motion.speed_mps == pytest.approx(factor * v if near else v, rel=0.01)
    assert motion.wheel_speed_radps == (v / RADIUS,) * 4


@pytest.mark.parametrize("factor", [0.955, 0.97, 1.03, 1.045])
@pytest.mark.parametrize("speed", [6.0, 20.0, -6.0])
def test_a_small_difference_of_sensor_and_rolling_wheels_is_no_slip(factor, speed):
    """Worn tyres, or a sensor that is off by little: it had to be told from slip when the brakes are at their limit."""
    car = Car(speed)
    for k in range(120):
        v = car.v
        motion = car.step(0.0, lambda v: factor * v)
        turned = motion.wheel_speed_radps[0] * RADIUS / v
        assert abs(turned - 1.0) <= abs(factor - 1.0)
        assert k > 20 or abs(turned - 1.0) < 0.012  # by no jump
    assert turned == pytest.approx(factor, abs=0.016 + 0.05 / abs(speed))
    assert motion.doubted == 0
    for _ in range(100):
        v = car.v
        motion = car.step(0.0)
    assert motion.wheel_speed_radps[0] * RADIUS / v == pytest.approx(1.0, abs=0.016 + 0.05 / abs(speed))


def test_a_difference_of_sensor_and_wheels_is_left_alone_where_slip_makes_it():
    car = Car(20.0)
    for _ in range(100):
        motion = car.step(40.0, spoil_wheels=lambda w: tuple(1.03 * x for x in w))
    assert motion.wheel_speed_radps[0] * RADIUS > 1.02 * car.v


@pytest.mark.parametrize("factor", [1.3, 1.7, 2.0])
def test_pulling_away_with_a_sensor_that_is_far_too_high_the_wheels_are_believed(factor):
    car = Car(0.0)
    for torque in (150.0,) * 300 + (-60.0,) * 50:
        v = car.v
        motion = car.step(torque, lambda v: factor * v)
    assert motion.lower_part * motion.speed_mps == pytest.approx(v, rel=0.05)
    assert [RADIUS * x / motion.speed_mps for x in motion.wheel_speed_radps] == pytest.approx([1.0] * 4, abs=0.05)


def test_wheels_that_come_late_have_not_jumped():
    car, shown = Car(7.0), None
    for k in range(50):
        shown = shown if k % 14 in (12, 13) else list(car.rim)
        motion = car.step(-600.0, spoil_wheels=lambda w, shown=shown: shown)
        assert motion.doubted == 0


def test_wheels_that_come_late_in_a_skid_and_grip_again_have_not_jumped():
    car = Car(15.0)
    for _ in range(20):
        car.step(0.0)
    rim = shown = car.rim[0]
    for k, turned in enumerate((-3.0, -3.0, -3.0, -3.0, 3.0, 3.0)):
        rim += turned
        shown = shown if k == 2 else rim
        car.step(0.0 if k >= 3 else -350.0, wheels=lambda v, shown=shown: [shown] * 4)
        assert car.state.motion.wheels_factor == 1.0


def test_wheels_that_jump_apart_are_not_corrected_by_one_factor():
    car = Car(9.0)
    for _ in range(20):
        car.step(0.0)
    motion = car.step(0.0, spoil_wheels=lambda w: [0.7 * w[0], 0.7 * w[1], 0.85 * w[2], 0.85 * w[3]])
    assert motion.doubted == 15
    assert car.state.motion.wheels_factor == 1.0


@pytest.mark.parametrize("sink", [2.0, 4.0])
def test_wheels_that_all_begin_to_lock_in_one_step_have_not_jumped(sink):
    """The brakes are pressed on ice: four alike lose what their torque takes, in every step."""
    car = Car(15.0)
    for _ in range(20):
        car.step(0.0)
    rim = car.rim[0]
    for _ in range(4):
        rim -= sink
        motion = car.step(-1.1 * sink * INERTIA / DT, wheels=lambda v, rim=rim: [rim] * 4)
    assert motion.doubted == 0
    assert motion.wheel_speed_radps[0] == pytest.approx(rim + sink)


@pytest.mark.parametrize("rate", [-5.0, 5.0])
def test_a_sensor_that_walked_away_leaves_no_wrong_speed_behind(rate):
    car, k = Car(12.0), 0
    for k in range(600):
        motion = car.step(-40.0, lambda v, k=k: v + rate * 0.01 * k)
        if car.v < 2.0:
            break
    assert motion.doubted == DOUBT_SPEED
    assert motion.speed_mps == pytest.approx(car.v, abs=0.15)


@pytest.mark.parametrize("torque", [-300.0, -100.0, -20.0, 0.0, 33.0, 200.0])
@pytest.mark.parametrize(("before", "after"), [(0.0, 20.0), (3.0, 14.0), (10.0, 0.6), (20.0, 12.0), (14.0, 30.0)])
def test_five_speeds_that_agree_after_a_gap_are_right_within_two_seconds(before, after, torque):
    car = Car(before)
    for _ in range(100):
        car.step(0.0)
    car.v, car.rim = after, [after / RADIUS] * 4
    for _ in range(165):
        motion = car.step(torque)
    assert motion.doubted == 0 or car.v < 1.0
    assert motion.speed_mps == pytest.approx(car.v, abs=0.3)


@pytest.mark.parametrize("torque", [-100.0, 33.0, 100.0, 200.0])
def test_a_car_held_at_its_speed_under_torque_is_believed(torque):
    car = Car(10.0)  # a dynamometer in speed control, a trailer, a steeper slope than any road
    speeds, doubted = [], 0
    for _ in range(1000):
        motion = car.step(torque)
        car.v, car.rim = 10.0, [10.0 / RADIUS] * 4
        speeds.append(motion.speed_mps)
        doubted = motion.doubted
    assert doubted == 0
    assert max(abs(v - 10.0) for v in speeds) < 2.0
    assert speeds[-1] == 10.0


@pytest.mark.parametrize("torque", [33.0, -33.0])
@pytest.mark.parametrize("shown", [lambda v: v, lambda v: math.nan])
def test_wheels_that_are_all_doubted_are_right_again_when_nothing_makes_them_slip(shown, torque):
    car = Car(10.0)
    car.step(0.0)
    car.state = car.state._replace(
        motion=car.state.motion._replace(speed_mps=14.0, wheel_doubt_s=(0.5,) * 4, doubt_s=0.5)
    )
    for _ in range(70):
        motion = car.step(torque, shown)
    assert motion.doubted in (0, DOUBT_SPEED)
    assert motion.speed_mps == pytest.approx(car.v, abs=0.2)


def test_the_slope_that_was_learned_outlasts_a_gap():
    car = Car(20.0, grade_mps2=1.9)
    for _ in range(300):
        car.step(150.0)
    learned = car.state.motion.bias_mps2
    assert learned < -1.0  # the pull of the sensor is the rest of it
    car.v, car.rim = 12.0, [12.0 / RADIUS] * 4
    for _ in range(15):
        car.step(150.0)
    assert car.motion.doubted == 0
    assert car.state.motion.bias_mps2 == pytest.approx(learned, abs=0.3)


def test_zeros_of_a_dead_control_unit_do_not_stop_the_car():
    car = Car(20.0)
    for _ in range(50):
        car.step(-50.0)
    for _ in range(300):
        motion = car.step(-50.0, lambda v: 0.0, lambda w: [0.0] * 4)
    assert motion.doubted == 31
    assert motion.speed_mps == pytest.approx(car.v, abs=1.0)


def test_wheels_that_skid_on_ice_are_not_right_because_the_sensor_repeats_them():
    """The speed of many stacks is made from the wheels: for a second that changes nothing."""
    car = Car(20.0)
    for _ in range(50):
        car.step(0.0)
    for k in range(90):
        skid = max(0.6, 1.0 - 0.02 * k)
        motion = car.step(-60.0, lambda v, k=skid: k * v, wheels=lambda v, k=skid: [k * v / RADIUS] * 4)
    assert motion.speed_mps > 0.9 * car.v


class Braked(Car):
    """A car whose friction brakes do not all give what is commanded; one that slips shows it by a part of its speed."""

    slips = (0.0,) * 4

    def brake(self, torques, given, slips=(0.0,) * 4, felt=False, **spoil):
        """One step with friction torques commanded, and those that really act."""
        self.slips = tuple(old + (new - old) / 6.0 for old, new in zip(self.slips, slips, strict=True))
        shown = tuple(w * (1.0 - slip) for w, slip in zip(self.rim, self.slips, strict=True))
        v = spoil.get("spoil_speed", lambda v: v)(self.v)
        rate = sum(given) / RADIUS / self.mass - resistance(self.v) - self.grade
        m = Measurement(
            v, shown, sum(torques) / RADIUS * v, DT, 0.9, 1e5, 1e5, 0.5, acceleration_mps2=rate if felt else math.nan
        )
        self.motion, after = estimate(m, self.state.motion, self.state.wheels, 1.0, self.state.steps == 0, CAR)
        memory = tuple(
            wheel._replace(total_nm=gain * torque, speed_radps=w)
            for wheel, torque, gain, w in zip(self.state.wheels, torques, after.brake_gain, shown, strict=True)
        )
        self.state = self.state._replace(steps=self.state.steps + 1, motion=after, wheels=memory)
        self.v += DT * rate
        self.rim = [self.v / RADIUS] * 4
        return self.motion


def slips_of(given):
    return tuple(-torque / 6000.0 for torque in given)


@pytest.mark.parametrize("dead", [(0, 1), (2, 3), (0, 3), (1, 2)])
def test_brakes_that_are_dead_are_found_and_no_sensor_is_doubted_for_long(dead):
    car = Braked(25.0)
    told = (-900.0,) * 4
    given = tuple(0.0 if i in dead else torque for i, torque in enumerate(told))
    for _ in range(20):
        car.brake((0.0,) * 4, (0.0,) * 4)
    doubted_s = 0.0
    for _ in range(150):
        v = car.v
        motion = car.brake(told, given, slips_of(given))
        doubted_s += DT * (motion.doubted != 0)
        assert motion.speed_mps == pytest.approx(v, abs=2.5)
    assert doubted_s <= 0.3
    assert motion.doubted == 0
    assert motion.speed_mps == v
    assert car.state.motion.brake_gain == tuple(0.0 if i in dead else 1.0 for i in range(4))


@pytest.mark.parametrize("rolls_s", [0.0, 0.3])
@pytest.mark.parametrize("torque", [-500.0, -900.0])
def test_brakes_that_come_back_are_counted_on_again(torque, rolls_s):
    """Found in the same braking, or in the next one: a sensor that is right must not be doubted as long as it lasts."""
    car = Braked(45.0)
    told, again, none = (-900.0,) * 4, (torque,) * 4, (0.0,) * 4
    for given, steps in ((none, 20), ((0.0, 0.0, -900.0, -900.0), 100)):
        for _ in range(steps):
            car.brake(none if given is none else told, given, slips_of(given))
    assert car.state.motion.brake_gain == (0.0, 0.0, 1.0, 1.0)
    for _ in range(int(rolls_s / DT)):
        car.brake(none, none)
    doubted_s = 0.0
    for _ in range(150):
        v = car.v
        motion = car.brake(again, again, slips_of(again))
        doubted_s += DT * (motion.doubted >= 16)
    assert doubted_s <= 0.5
    assert motion.doubted == 0
    assert motion.speed_mps == v
    assert car.state.motion.brake_gain == (1.0,) * 4


def test_a_sensor_and_a_single_wheel_that_agree_for_a_quarter_of_a_second_outvote_nothing():
    car = Braked(30.0)
    told, none = (-600.0,) * 4, (0.0,) * 4
    for _ in range(20):
        car.brake(none, none)
    for _ in range(60):
        car.brake(told, told, slips_of(told))
    for _ in range(26):
        v = car.v
        car.slips = (-0.3, *car.slips[1:])
        motion = car.brake(told, told, (-0.3, 0.1, 0.1, 0.1), spoil_speed=lambda v: 1.3 * v)
    assert motion.speed_mps == pytest.approx(v, abs=1.0)


@pytest.mark.parametrize("mass", [800.0, 1100.0])
def test_a_loaded_car_has_no_weak_brakes(mass):
    car = Braked(25.0)
    car.mass = mass
    for _ in range(200):
        motion = car.brake((-400.0,) * 4, (-400.0,) * 4, slips_of((-400.0,) * 4))
    assert motion.doubted == 0
    assert car.state.motion.brake_gain == (1.0,) * 4


@pytest.mark.parametrize("felt", [False, True])
def test_a_force_that_nobody_knows_of_is_felt_by_an_accelerometer_at_once(felt):
    car = Braked(30.0)
    doubted_s = 0.0
    for k in range(150):
        given = (-700.0,) * 4 if k >= 30 else (-70.0,) * 4
        motion = car.brake((-70.0,) * 4, given, (0.005,) * 4, felt)
        doubted_s += DT * (motion.doubted != 0)
    assert motion.doubted == 0
    assert (doubted_s < 0.3) == felt


def test_an_accelerometer_that_contradicts_four_skidding_wheels_and_their_sensor_is_believed():
    """The sensor repeats the wheels; without an accelerometer they would be right after a second."""
    car = Braked(30.0)
    for k in range(250):
        skid = max(0.5, 1.0 - 0.01 * max(k - 30, 0))
        given = (-60.0,) * 4
        motion = car.brake(given, given, (1.0 - skid,) * 4, True, spoil_speed=lambda v, skid=skid: skid * v)
    assert motion.speed_mps == pytest.approx(car.v, abs=0.15 * car.v)


@pytest.mark.parametrize(("torque", "slip"), [(60.0, 0.03), (-60.0, -0.03)])
def test_wheels_that_slip_a_little_do_not_pull_where_a_sensor_is_believed(torque, slip):
    car = Car(8.0)
    for k in range(100):
        shown = car.v
        car.step(torque, wheels=lambda v: [(1.0 + slip) * v / RADIUS] * 4)
        # In the first steps they do: the wheels jump to their slip.
        assert k < 5 or car.state.motion.speed_mps == pytest.approx(shown, abs=1e-9)
