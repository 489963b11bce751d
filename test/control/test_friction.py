# SPDX-License-Identifier: Apache-2.0
"""The friction estimate: on roads whose friction is known, with sensors that are not perfect."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control import law
from iwm_power_manager.control.friction import estimate
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import FrictionState, Measurement, SideGrip, initial_state
from iwm_power_manager.model.tyre import slip_at_friction
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import friction as oracle
from oracles.physics import slip
from oracles.step import friction_coefficient

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS, MASS = CAR.front.wheel.radius_m, CAR.chassis.mass_kg
_STIFFNESS, *_SHAPE = CAR.rear.tyre.coefficients
#: Front and rear wheels and tyres are not alike, nor what stands on them.
UNLIKE = CAR._replace(
    rear=CAR.rear._replace(
        wheel=CAR.rear.wheel._replace(radius_m=0.4, inertia_kgm2=2.0),
        tyre=CAR.rear.tyre._replace(coefficients=(1.5 * _STIFFNESS, *_SHAPE)),
    ),
    chassis=CAR.chassis._replace(front_axle_to_cg_m=0.8, rear_axle_to_cg_m=1.6),
)
SETTINGS = default_settings()
TABLE = empty_table()
DT = 0.01


class Drive:
    """Wheels on roads of known friction, as the law remembers and sees them; `error` spoils what is seen."""

    def __init__(self, settings=SETTINGS, speed=15.0, car=CAR):
        self.settings, self.car = settings, car
        self.axles = (car.front, car.front, car.rear, car.rear)
        self.state = initial_state()
        self.speed = speed
        self.rows = []
        self.step((0.9,) * 4, 0.0)

    def load(self, i, accel):
        c = self.car.chassis
        arm = c.rear_axle_to_cg_m if i < 2 else c.front_axle_to_cg_m
        pitch = MASS * accel * c.cg_height_m * (-1.0 if i < 2 else 1.0)
        return (MASS * 9.81 * arm + pitch) / (2.0 * (c.front_axle_to_cg_m + c.rear_axle_to_cg_m))

    def step(self, friction, used, error=lambda: 0.0, offset=0.0, believed=True):
        """One step in which each wheel's road force is `used` of its load, or all the road gives."""
        accel = used * 9.81
        wheels = []
        for mu, axle in zip(friction, self.axles, strict=True):
            most = math.copysign(min(abs(used), mu), used)
            s = slip_at_friction(most, mu, axle.tyre)
            rim = self.speed * (1.0 + s) if s < 0.0 else self.speed / (1.0 - s)
            wheels.append(rim / axle.wheel.radius_m * (1.0 + offset) + error())
        loads = [self.load(i, accel) for i in range(4)]
        roads = [
            math.copysign(min(abs(used), mu), used) * load * axle.wheel.radius_m
            for mu, load, axle in zip(friction, loads, self.axles, strict=True)
        ]
        old = self.state.wheels
        # The torque that, with the spin of the wheel, leaves the road its part.
        totals = [
            road + (axle.wheel.inertia_kgm2 * (w - before.speed_radps) / DT if self.rows else 0.0)
            for road, w, before, axle in zip(roads, wheels, old, self.axles, strict=True)
        ]
        noisy = error() != 0.0
        before = tuple(
            b._replace(total_nm=road if noisy else total, road_nm=road)
            for b, total, road in zip(old, totals, roads, strict=True)
        )
        self.rows.append((self.speed, wheels, [b.total_nm for b in before], roads, DT))
        grip = estimate(
            self.state.friction,
            before,
            tuple(wheels),
            self.speed,
            believed,
            len(self.rows) == 1,
            DT,
            self.settings,
            self.car,
        )
        after = tuple(b._replace(speed_radps=w) for b, w in zip(before, wheels, strict=True))
        self.state = self.state._replace(wheels=after, friction=grip)
        return grip

    def gently(self, friction, steps, **errors):
        """Town: power and brake in turn, no more than a tenth of the weight."""
        for k in range(steps):
            self.step((friction,) * 4, 0.08 * math.sin(k / 40.0), **errors)
        return self.state.friction


@pytest.mark.parametrize("friction", [0.2, 0.5, 0.9])
def test_gentle_driving_with_true_sensors_tells_the_friction_within_seconds(friction):
    grip = Drive().gently(friction, 600)
    assert grip.left.friction == pytest.approx(friction, rel=0.06)
    assert grip.right == grip.left
    assert grip.left.confidence > 0.9
    assert grip.assumed == pytest.approx(friction, abs=0.05)


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_what_is_known_of_the_slope_is_believed_within_a_third_of_a_second(friction):
    drive = Drive()
    known = [drive.step((friction,) * 4, 0.08 * math.sin(k / 40.0)) for k in range(300)]
    first = next(k for k, grip in enumerate(known) if grip.left.confidence > 0.5)
    assert known[first + 33].assumed == pytest.approx(friction, rel=0.2)


@pytest.mark.parametrize("friction", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("offset", [-0.01, 0.01])
def test_a_speed_sensor_that_is_wrong_by_a_hundredth_does_not_bias_it(friction, offset):
    grip = Drive().gently(friction, 1500, offset=offset)
    assert grip.left.friction == pytest.approx(friction, rel=0.3)


@pytest.mark.parametrize("friction", [0.2, 0.5, 0.9])
def test_noise_of_wheel_speeds_does_not_make_a_road_slippery(friction):
    rng = np.random.default_rng(3)
    grip = Drive().gently(friction, 3000, error=lambda: 0.3 * float(rng.standard_normal()))
    assert grip.assumed == pytest.approx(friction, rel=0.35)


def test_a_wheel_that_slips_tells_it_within_a_tenth_of_a_second_on_its_side_only():
    drive = Drive()
    drive.gently(0.9, 300)
    for _ in range(15):
        grip = drive.step((0.2, 0.9, 0.2, 0.9), -0.5)
    assert grip.left.friction == pytest.approx(0.2, abs=0.05)
    assert grip.left.confidence == 1.0
    assert grip.right.friction > 0.7
    assert grip.assumed == pytest.approx(grip.left.friction, abs=0.04)


@pytest.mark.parametrize("wheel", range(4))
def test_each_wheel_that_slips_tells_of_its_own_side(wheel):
    drive = Drive(car=UNLIKE)
    drive.gently(0.9, 300)
    for _ in range(15):
        grip = drive.step(tuple(0.2 if i == wheel else 0.9 for i in range(4)), -0.5)
    here, there = (grip.left, grip.right) if wheel % 2 == 0 else (grip.right, grip.left)
    # The forces of the others are reckoned with all the wheels, so it is a little off.
    assert here.friction == pytest.approx(0.2, abs=0.08)
    assert (here.confidence, there.friction > 0.7) == (1.0, True)
    assert grip.assumed == pytest.approx(here.friction, abs=0.04)


@pytest.mark.parametrize("friction", [(0.2, 0.2, 0.9, 0.9), (0.9, 0.9, 0.2, 0.2)])
def test_an_axle_that_slips_tells_it_of_both_sides(friction):
    drive = Drive()
    for _ in range(15):
        grip = drive.step(friction, -0.5)
    assert grip.left == grip.right
    assert grip.right.confidence == 1.0


@pytest.mark.parametrize("side", ["left", "right"])
def test_wheels_that_are_alike_make_no_sides_alike_that_are_not(side):
    drive = Drive()
    grip = drive.state.friction
    drive.state = drive.state._replace(friction=grip._replace(**{side: grip.left._replace(friction=0.2)}))
    after = drive.step((0.9,) * 4, 0.0)
    assert [getattr(after, name).friction < 0.3 for name in ("left", "right")] == [side == "left", side == "right"]


def test_it_rises_at_its_rate_and_no_single_point_raises_it_by_more():
    drive = Drive()
    for _ in range(50):
        drive.step((0.2,) * 4, -0.5)
    before = drive.state.friction.left.friction
    for k in range(60):
        now = drive.step((0.9,) * 4, -0.85).left.friction
        assert now - before <= SETTINGS.friction_rise_per_s * DT + 1e-12
        before = now
        if k == 50:
            assert now > 0.75, "on dry road again within half a second"


def test_friction_in_use_is_a_lower_bound():
    drive = Drive(SETTINGS._replace(friction_prior=0.1))
    for _ in range(100):
        grip = drive.step((0.9,) * 4, -0.25)
    assert grip.left.friction >= 0.24


@pytest.mark.parametrize("what", ["torque", "speed", "memory", "road force"])
@pytest.mark.parametrize("wheel", range(4))
def test_what_is_unlike_at_one_wheel_is_reckoned_for_that_wheel(wheel, what):
    drive = Drive()
    drive.gently(0.9, 3)
    state, radps = drive.state, [drive.speed / RADIUS] * 4

    def reckoned(**unlike):
        wheels, rims, grips = list(state.wheels), list(radps), list(state.friction.wheels)
        if unlike:
            wheels[wheel] = wheels[wheel]._replace(
                total_nm=wheels[wheel].total_nm + 20.0 * (what == "torque"),
                road_nm=wheels[wheel].road_nm + 200.0 * (what == "road force"),
            )
            rims[wheel] += 0.1 * (what == "speed")
            grips[wheel] = grips[wheel]._replace(used=grips[wheel].used + 0.1 * (what == "memory"))
        before = state.friction._replace(wheels=tuple(grips))
        return estimate(before, tuple(wheels), tuple(rims), drive.speed, True, False, DT, SETTINGS, CAR).wheels

    unlike = [a != b for a, b in zip(reckoned(), reckoned(unlike=True), strict=True)]
    # The loads go by the forces of all four.
    assert unlike == [i == wheel or what == "road force" for i in range(4)]


@pytest.mark.parametrize("wheel", range(4))
def test_friction_in_use_at_one_wheel_is_that_of_its_side(wheel):
    drive = Drive(SETTINGS._replace(friction_prior=0.1))
    grip = drive.state.friction
    wheels = tuple(one._replace(used=0.5 if i == wheel else 0.0) for i, one in enumerate(grip.wheels))
    drive.state = drive.state._replace(friction=grip._replace(wheels=wheels))
    after = drive.step((0.9,) * 4, 0.0)
    assert [after.left.friction > 0.1, after.right.friction > 0.1] == [wheel % 2 == 0, wheel % 2 == 1]


def test_at_rest_it_goes_back_to_the_prior_slowly():
    drive = Drive()
    for _ in range(50):
        drive.step((0.2,) * 4, -0.5)
    drive.speed = 0.0
    first = drive.state.friction.left.friction
    for _ in range(600):
        grip = drive.step((0.2,) * 4, 0.0)
    assert first < grip.left.friction < first + 0.2
    assert grip.left.confidence < 0.95
    drive.settings = SETTINGS._replace(friction_return_s=SETTINGS.friction_return_s / 20.0)
    for _ in range(1500):
        grip = drive.step((0.2,) * 4, 0.0)
    assert grip.left.friction == pytest.approx(SETTINGS.friction_prior, abs=0.02)
    assert grip.left.confidence < 0.05


def test_nothing_is_learned_while_a_sensor_is_doubted():
    drive = Drive()
    before = drive.state.friction.wheels
    assert drive.gently(0.2, 100, believed=False).wheels == before


def test_the_first_step_of_a_run_has_the_prior():
    grip = Drive(SETTINGS._replace(friction_prior=0.37)).state.friction
    assert (grip.left.friction, grip.right.confidence, grip.assumed) == (0.37, 0.0, 0.37)


@given(
    st.tuples(st.floats(0.15, 1.0), st.floats(0.15, 1.0)),
    st.lists(st.floats(-0.08, 0.08), min_size=3, max_size=25),
    st.floats(4.0, 35.0),
    st.sampled_from([CAR, UNLIKE]),
)
def test_the_slope_is_that_of_all_points_at_once(frictions, used, speed, car):
    """Recursion against the definition: means and products over all points, each with the weight it has by now."""
    drive = Drive(speed=speed, car=car)
    for part in used:
        before = drive.state.friction
        grip = drive.step(frictions * 2, part * min(frictions))
        for was, now, wheels in ((before.left, grip.left, (0, 2)), (before.right, grip.right, (1, 3))):
            side = [oracle.points(drive.rows, i, drive.settings, car) for i in wheels]
            if min(np.ptp([point[k] for point in wheel]) for wheel in side for k in (0, 1)) < 1e-3:
                continue  # rounding alone tells such points apart
            told, belief = oracle.slope(side, drive.settings, (car.front.tyre, car.rear.tyre), DT)
            prior, rise = drive.settings.friction_prior, drive.settings.friction_rise_per_s * DT
            change = belief * (told - was.friction) * DT / 0.1
            change += (1.0 - belief) * (prior - was.friction) * DT / drive.settings.friction_return_s
            assert now.friction == pytest.approx(was.friction + min(change, rise), rel=1e-6, abs=1e-7)
            faded = was.confidence * (1.0 - DT / (drive.settings.friction_return_s + DT))
            assert now.confidence == pytest.approx(max(belief, faded), rel=1e-5, abs=1e-6)


def test_the_oracles_slip_is_the_one_the_drive_is_made_of():
    drive = Drive()
    drive.step((0.5,) * 4, -0.2)
    speed, wheels, *_ = drive.rows[-1]
    assert friction_coefficient(slip(wheels[0], speed, RADIUS, 0.5), 0.5, CAR.front.tyre) == pytest.approx(
        -0.2, rel=1e-9
    )


@given(
    st.tuples(*[st.floats(0.05, 1.2)] * 4),
    st.floats(-60e3, 60e3),
    st.sampled_from([1.0, 5.0, 20.0]),
    st.tuples(*[st.floats(0.6, 1.4)] * 4),
)
def test_it_decides_which_policy_a_strategy_uses_and_nothing_else(frictions, demand, speed, rims):
    """Gate, slip limiter and brakes go by slip and road force alone: a strategy that asks for none gets the same."""
    left, right, assumed, told = frictions
    wheels = tuple(rim * speed / RADIUS for rim in rims)
    start = initial_state()._replace(steps=1)
    start = start._replace(motion=start.motion._replace(speed_mps=speed, shown_mps=speed))

    def torques(state, friction):
        m = Measurement(speed, wheels, demand, DT, friction, 47.5e3, 47.5e3, 0.6)
        command, _ = law.step(m, state, default_settings("equal"), CAR, TABLE)
        return command.motor_torque_nm, command.friction_torque_nm, command.gated_wheels, command.limits

    known = FrictionState(SideGrip(left, 1.0), SideGrip(right, 1.0), start.friction.wheels, assumed)
    assert torques(start._replace(friction=known), told) == torques(start, 0.9)


def test_a_strategy_is_given_it_to_the_nearest_hundredth():
    drive, changes = Drive(), 0
    for k in range(300):
        before = drive.state.friction.assumed
        grip = drive.step((0.3, 0.4, 0.3, 0.4), 0.08 * math.sin(k / 40.0))
        if grip.assumed != before:
            changes += 1
            assert grip.assumed == pytest.approx(min(grip.left.friction, grip.right.friction), abs=0.00501)
    assert changes > 3


def test_no_single_step_of_a_wheel_that_slips_takes_more_than_a_sixth():
    drive = Drive()
    drive.gently(0.9, 300)
    for _ in range(15):
        before = drive.state.friction.left.friction
        assert drive.step((0.2, 0.9, 0.2, 0.9), -0.5).left.friction > (1.0 - 1.0 / 6.0) * before
    assert drive.state.friction.left.friction < 0.25


def test_where_the_road_takes_less_the_more_torque_there_is_no_slope_is_told():
    """Not even where slip goes with the torque: as of a speed that comes before its torque."""
    start, friction = initial_state().wheels[0], initial_state().friction
    rolling, swing_nm = 15.0 / RADIUS, 20.0
    speed = rolling
    for k in range(1000):
        torque = swing_nm * (-1.0) ** k
        wheels = (start._replace(total_nm=torque, speed_radps=speed),) * 4
        speed = rolling + torque * DT / CAR.front.wheel.inertia_kgm2
        friction = estimate(friction, wheels, (speed,) * 4, 15.0, True, k == 0, DT, SETTINGS, CAR)
    assert friction.left == friction.right == SideGrip(SETTINGS.friction_prior, 0.0)
