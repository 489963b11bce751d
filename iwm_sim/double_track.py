# SPDX-License-Identifier: Apache-2.0
"""Motion of car and wheels in the plane: the double-track model, one implicit step.

Seven degrees of freedom: forward and lateral speed of the centre of gravity (body axes: x forward, y to the left), yaw
rate, four wheels. The loads of the wheels follow grade, forward and lateral acceleration; the front wheels steer, both
by the same angle. Each tyre slides over the road with the velocity

    s = (r w - u, -v)        u, v: velocity of its contact point along and across the wheel

and its force points along s, with the size of the tyre model at the slip |s| / max(|r w|, |(u, v)|, floor): the
similarity method (Pacejka, Tire and Vehicle Dynamics, 4.3.2) for a tyre that is as stiff across as along. Without
lateral motion that is eq. 10 in both directions of travel.

The step is backward Euler, as in `model.longitudinal`, which is this model on a straight, uniform road going forwards:
each wheel's speed is solved for at the car's motion at the end of the step, and the car's motion by Newton's method
with the tyres' stiffnesses. The velocity turns with the body by an exact rotation, so that the books stay exact:
forces that hold through the step, times the mean of the motion before and after, are the energy that flowed.

Brakes and bearing drag are Coulomb friction at the wheel, rolling resistance is Coulomb friction on the car: they hold
or slow down in both directions and never push. A car that is all but at rest, whose brakes and tyres can hold what
pulls at it, rests (`_holds`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import aerodynamic_force_n, grade_force_n, normal_forces_n, rolling_force_n
from iwm_power_manager.model.parameters import Tyre, VehicleParams, Wheel
from iwm_power_manager.model.tyre import friction_and_slope, peak_ratio

Four = tuple[float, float, float, float]  # front_left, front_right, rear_left, rear_right

#: Below this speed of car and rims, m/s, a car that can be held is at rest.
REST_MPS = 0.02

#: What counts as no sliding at all, m/s.
_STICKING_MPS = 1e-12

_MOST_ITERATIONS = 40
_TOLERANCE = 1e-9


class PlaneMotion(NamedTuple):
    """Motion at the end of a step, and what acted during it.

    Attributes
    ----------
    speed_mps, lateral_speed_mps, yaw_rate_radps : of the centre of gravity, in body axes
    wheel_speed_radps : negative when rolling backwards
    acceleration_mps2, lateral_acceleration_mps2 : of the centre of gravity, as an accelerometer without tilt shows them
    normal_force_n : of each wheel
    holding_torque_nm : what brake and drag exerted against the wheel's turning, in the direction of the axle, N m
    turned_rad : angle by which the body turned
    mean_speed_mps : mean forward speed before and after, in the body axes after the step
    mean_lateral_mps : the same across
    rolling_force_n, air_force_n : against forward motion
    slip_work_w : power that the tyres turned into heat
    """

    speed_mps: float
    lateral_speed_mps: float
    yaw_rate_radps: float
    wheel_speed_radps: Four
    acceleration_mps2: float
    lateral_acceleration_mps2: float
    normal_force_n: Four
    holding_torque_nm: Four
    turned_rad: float
    mean_speed_mps: float
    mean_lateral_mps: float
    rolling_force_n: float
    air_force_n: float
    slip_work_w: float


@kernel
def tyre_force_n(
    rim_mps: float, along_mps: float, across_mps: float, normal_n: float, friction: float, tyre: Tyre
) -> tuple[float, float, float, float, float, float]:
    """Force of a tyre on its wheel, and how it follows the sliding velocity.

    Parameters
    ----------
    rim_mps : r w
    along_mps, across_mps : velocity of the contact point over ground, in the wheel's axes

    Returns
    -------
    force along and across (N), its derivatives with respect to the sliding velocity: along-along, along-across and
    across-across (N s/m, the slip's denominator taken as constant), and along-along with respect to the rim's speed,
    exactly
    """
    slide_x = rim_mps - along_mps
    slide_y = -across_mps
    slide = math.sqrt(slide_x * slide_x + slide_y * slide_y)
    over_ground = math.sqrt(along_mps * along_mps + across_mps * across_mps)
    denominator = max(abs(rim_mps), over_ground, tyre.slip_speed_floor_mps)
    mu, slope = friction_and_slope(slide / denominator, friction, tyre)
    if slide <= _STICKING_MPS:
        stiffness = normal_n * slope / denominator
        return stiffness * slide_x, stiffness * slide_y, stiffness, 0.0, stiffness, stiffness
    x = slide_x / slide
    y = slide_y / slide
    secant = normal_n * mu / slide
    tangent = normal_n * slope / denominator
    exact = tangent * x
    if denominator == abs(rim_mps):
        exact -= tangent * slide / denominator * math.copysign(1.0, rim_mps)
    return (
        normal_n * mu * x,
        normal_n * mu * y,
        tangent * x * x + secant * y * y,
        (tangent - secant) * x * y,
        tangent * y * y + secant * x * x,
        exact * x + secant * y * y,
    )


@kernel
def _residual(
    speed: float,
    before: float,
    torque: float,
    along: float,
    across: float,
    normal: float,
    friction: float,
    inertia_rate: float,
    wheel: Wheel,
    tyre: Tyre,
) -> tuple[float, float]:
    """Torque that is missing for the wheel to have this speed after the step (eq. 11), and its slope."""
    radius = wheel.radius_m
    force, _, _, _, _, slope = tyre_force_n(radius * speed, along, across, normal, friction, tyre)
    return inertia_rate * (speed - before) + radius * force - torque, inertia_rate + radius * radius * slope


@kernel
def wheel_after(
    before: float,
    torque: float,
    resisting: float,
    along: float,
    across: float,
    normal: float,
    friction: float,
    dt_s: float,
    wheel: Wheel,
    tyre: Tyre,
) -> float:
    """Speed of one wheel after a step, rad/s.

    Parameters
    ----------
    before : speed before the step, rad/s
    torque : of the motor, N m
    resisting : most that brake and drag exert, N m, >= 0
    along, across : velocity of the contact point after the step, m/s
    """
    rate = wheel.inertia_kgm2 / dt_s
    locked, _ = _residual(0.0, before, torque, along, across, normal, friction, rate, wheel, tyre)
    if abs(locked) <= resisting:
        return 0.0
    # What the brake cannot hold turns: forwards if torque is left over at rest, backwards if it is missing.
    holding = -resisting if locked < 0.0 else resisting
    driving = torque + holding
    free = before + driving / rate
    reach = wheel.radius_m * friction * peak_ratio(tyre) * normal / rate
    low = free - reach
    high = free + reach
    if locked < 0.0:
        low = max(low, 0.0)
    else:
        high = min(high, 0.0)
    speed = min(max(before, low), high)
    change = high - low
    for _ in range(100):
        missing, slope = _residual(speed, before, driving, along, across, normal, friction, rate, wheel, tyre)
        if missing > 0.0:
            high = speed
        else:
            low = speed
        after = speed - missing / slope if slope > 0.0 else low - 1.0
        # The tyre's S-shaped curve can send Newton to and fro: halve where the steps do not shrink.
        if not low <= after <= high or abs(after - speed) > 0.5 * abs(change):
            after = 0.5 * (low + high)
        change = after - speed
        speed = after
        if abs(change) <= 1e-11 * (1.0 + abs(speed)):
            break
    return speed


@kernel
def loads_n(
    acceleration_mps2: float, lateral_mps2: float, air_speed_mps: float, grade: float, vehicle: VehicleParams
) -> Four:
    """Normal force of each wheel, N: eq. 7 and 8, and what lateral acceleration moves from one side to the other."""
    chassis = vehicle.chassis
    front, rear = normal_forces_n(acceleration_mps2, air_speed_mps, grade, chassis)
    rolling = chassis.mass_kg * lateral_mps2 * chassis.cg_height_m
    to_front = rolling * chassis.front_roll_share / vehicle.front.track_width_m
    to_rear = rolling * (1.0 - chassis.front_roll_share) / vehicle.rear.track_width_m
    to_front = min(max(to_front, -front), front)
    to_rear = min(max(to_rear, -rear), rear)
    return front - to_front, front + to_front, rear - to_rear, rear + to_rear


@kernel
def wheel_places_m(vehicle: VehicleParams) -> tuple[Four, Four]:
    """Where the wheels stand, forward and to the left of the centre of gravity, m."""
    a = vehicle.chassis.front_axle_to_cg_m
    b = -vehicle.chassis.rear_axle_to_cg_m
    front = 0.5 * vehicle.front.track_width_m
    rear = 0.5 * vehicle.rear.track_width_m
    return (a, a, b, b), (front, -front, rear, -rear)


@kernel
def _solve3(a, b):
    """Solution of a symmetric, positive definite 3 x 3 system (Cholesky), in place of `b`."""
    l00 = math.sqrt(a[0, 0])
    l10 = a[1, 0] / l00
    l20 = a[2, 0] / l00
    l11 = math.sqrt(a[1, 1] - l10 * l10)
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(a[2, 2] - l20 * l20 - l21 * l21)
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    b[2] = y2 / l22
    b[1] = (y1 - l21 * b[2]) / l11
    b[0] = (y0 - l10 * b[1] - l20 * b[2]) / l00


@kernel
def _add_stiffness(matrix, x, y, cosine, sine, reduced, k_xx, k_xy, k_yy):
    """Add how a tyre's force follows the car's motion: its stiffness, turned into body axes, at its place."""
    along = k_xx * reduced
    both = k_xy * reduced
    across = k_yy
    b_xx = cosine * cosine * along - 2.0 * cosine * sine * both + sine * sine * across
    b_xy = cosine * sine * (along - across) + (cosine * cosine - sine * sine) * both
    b_yy = sine * sine * along + 2.0 * cosine * sine * both + cosine * cosine * across
    matrix[0, 0] += b_xx
    matrix[1, 0] += b_xy
    matrix[1, 1] += b_yy
    matrix[2, 0] += x * b_xy - y * b_xx
    matrix[2, 1] += x * b_yy - y * b_xy
    matrix[2, 2] += x * x * b_yy - 2.0 * x * y * b_xy + y * y * b_xx


class _Surface(NamedTuple):
    """What a step is taken with: torques at the wheels, steering, friction, and where each wheel stands."""

    motor_nm: Four
    resisting_nm: Four
    cosine: Four
    sine: Four
    x_m: Four
    y_m: Four
    friction: Four


@kernel
def _surface(motors: Four, resisting: Four, steer_rad: float, friction: Four, vehicle: VehicleParams) -> _Surface:
    x, y = wheel_places_m(vehicle)
    c = math.cos(steer_rad)
    s = math.sin(steer_rad)
    return _Surface(motors, resisting, (c, c, 1.0, 1.0), (s, s, 0.0, 0.0), x, y, friction)


@kernel
def _over_ground(i: int, v_x: float, v_y: float, rate: float, on: _Surface) -> tuple[float, float]:
    """Velocity of a wheel's contact point along and across the wheel."""
    ground_x = v_x - rate * on.y_m[i]
    ground_y = v_y + rate * on.x_m[i]
    return on.cosine[i] * ground_x + on.sine[i] * ground_y, on.cosine[i] * ground_y - on.sine[i] * ground_x


@kernel
def _holds(
    speed_mps: float,
    lateral_mps: float,
    yaw_rate_radps: float,
    wheels: Four,
    on: _Surface,
    pull_n: float,
    load: Four,
    vehicle: VehicleParams,
) -> bool:
    """Whether the car is all but at rest and its brakes and tyres can hold it there.

    Parameters
    ----------
    pull_n : what pulls at the car down the road (slope, wind), N
    """
    if max(abs(speed_mps), abs(lateral_mps), abs(yaw_rate_radps)) > REST_MPS:
        return False
    capacity = rolling_force_n(0.0, vehicle.chassis)
    driving = -pull_n
    for i in range(4):
        axle = vehicle.front if i < 2 else vehicle.rear
        radius = axle.wheel.radius_m
        grip = on.friction[i] * peak_ratio(axle.tyre) * load[i]
        if radius * abs(wheels[i]) > REST_MPS or abs(on.motor_nm[i]) > on.resisting_nm[i] + radius * grip:
            return False
        driving += on.motor_nm[i] / radius
        capacity += min(grip, on.resisting_nm[i] / radius)
    return abs(driving) <= capacity


@kernel
def _at_rest(
    speed_mps: float,
    lateral_mps: float,
    yaw_rate_radps: float,
    wheels: Four,
    on: _Surface,
    pull_n: float,
    load: Four,
    dt_s: float,
    vehicle: VehicleParams,
) -> PlaneMotion:
    """The step in which everything stops: the tyres take what is left of the motion, the brakes hold the wheels."""
    chassis = vehicle.chassis
    mass = chassis.mass_kg
    braked = pull_n - mass * speed_mps / dt_s  # of all tyres, forward positive
    left = braked
    whole = 0.0
    held = np.zeros(4)
    for i in range(4):
        axle = vehicle.front if i < 2 else vehicle.rear
        held[i] = min(on.friction[i] * peak_ratio(axle.tyre) * load[i], on.resisting_nm[i] / axle.wheel.radius_m)
        whole += held[i]
        left -= on.motor_nm[i] / axle.wheel.radius_m
    work = -0.5 * braked * speed_mps
    work += 0.5 * (mass * lateral_mps * lateral_mps + chassis.yaw_inertia_kgm2 * yaw_rate_radps**2) / dt_s
    for i in range(4):
        wheel = (vehicle.front if i < 2 else vehicle.rear).wheel
        share = held[i] / whole if whole > 0.0 else 0.25
        force = on.motor_nm[i] / wheel.radius_m + share * left
        held[i] = wheel.radius_m * force - on.motor_nm[i] - wheel.inertia_kgm2 * wheels[i] / dt_s
        work += 0.5 * force * wheel.radius_m * wheels[i]
    return PlaneMotion(
        speed_mps=0.0,
        lateral_speed_mps=0.0,
        yaw_rate_radps=0.0,
        wheel_speed_radps=(0.0, 0.0, 0.0, 0.0),
        acceleration_mps2=-speed_mps / dt_s,
        lateral_acceleration_mps2=-lateral_mps / dt_s,
        normal_force_n=load,
        holding_torque_nm=(held[0], held[1], held[2], held[3]),
        turned_rad=0.0,
        mean_speed_mps=0.5 * speed_mps,
        mean_lateral_mps=0.5 * lateral_mps,
        rolling_force_n=0.0,
        air_force_n=0.0,
        slip_work_w=work,
    )


@kernel
def _tyres(before: Four, v_x, v_y, rate, load: Four, on: _Surface, dt_s, vehicle, wheels, force, matrix):
    """Solve each wheel at a motion of the car; its force and its stiffness on the car.

    Parameters
    ----------
    before : wheel speeds before the step
    wheels, force : float64[4], float64[4, 2], output: speeds after the step, forces along and across the wheels
    matrix : float64[3, 3], in and output: the tyres' stiffnesses are added

    Returns
    -------
    sum of the forces forward and to the left (N), their moment (N m)
    """
    total_x = 0.0
    total_y = 0.0
    moment = 0.0
    for i in range(4):
        axle = vehicle.front if i < 2 else vehicle.rear
        radius = axle.wheel.radius_m
        c = on.cosine[i]
        s = on.sine[i]
        along, across = _over_ground(i, v_x, v_y, rate, on)
        wheels[i] = wheel_after(
            before[i],
            on.motor_nm[i],
            on.resisting_nm[i],
            along,
            across,
            load[i],
            on.friction[i],
            dt_s,
            axle.wheel,
            axle.tyre,
        )
        f_x, f_y, k_xx, k_xy, k_yy, _ = tyre_force_n(
            radius * wheels[i], along, across, load[i], on.friction[i], axle.tyre
        )
        force[i, 0] = f_x
        force[i, 1] = f_y
        body_x = c * f_x - s * f_y
        body_y = s * f_x + c * f_y
        total_x += body_x
        total_y += body_y
        moment += on.x_m[i] * body_y - on.y_m[i] * body_x
        # Beyond the peak the force falls with slip: as a stiffness that would lead the iteration astray.
        k_xx = max(k_xx, 0.0)
        k_yy = max(k_yy, 0.0)
        most = math.sqrt(k_xx * k_yy)
        k_xy = min(max(k_xy, -most), most)
        reduced = 1.0
        if wheels[i] != 0.0:
            # A wheel that turns gives way: its inertia and the tyre's stiffness in series.
            turning = axle.wheel.inertia_kgm2 / (dt_s * radius * radius)
            reduced = turning / (turning + k_xx)
            k_yy -= k_xy * k_xy / (turning + k_xx)
        _add_stiffness(matrix, on.x_m[i], on.y_m[i], c, s, reduced, k_xx, k_xy, k_yy)
    return total_x, total_y, moment


@kernel
def _slip_work_w(before: Four, mean_x, mean_y, mean_rate, on: _Surface, vehicle, wheels, force):
    """Power that the tyres turned into heat: forces times the mean sliding before and after."""
    work = 0.0
    for i in range(4):
        along, across = _over_ground(i, mean_x, mean_y, mean_rate, on)
        rim = (vehicle.front if i < 2 else vehicle.rear).wheel.radius_m * 0.5 * (before[i] + wheels[i])
        work += force[i, 0] * (rim - along) - force[i, 1] * across
    return work


@kernel
def _held_nm(i: int, before: Four, on: _Surface, dt_s, vehicle, wheels, force):
    """What brake and drag exerted on a wheel: with this torque eq. 11 holds exactly, whatever the iteration left."""
    wheel = (vehicle.front if i < 2 else vehicle.rear).wheel
    turning = wheel.inertia_kgm2 * (wheels[i] - before[i]) / dt_s
    return turning + wheel.radius_m * force[i, 0] - on.motor_nm[i]


@kernel
def step(
    speed_mps: float,
    lateral_mps: float,
    yaw_rate_radps: float,
    wheel_speed_radps: Four,
    acceleration_mps2: float,
    lateral_acceleration_mps2: float,
    motor_torque_nm: Four,
    resisting_torque_nm: Four,
    steer_rad: float,
    grade: float,
    headwind_mps: float,
    friction: Four,
    dt_s: float,
    vehicle: VehicleParams,
) -> PlaneMotion:
    """Advance car and wheels by one implicit step.

    Parameters
    ----------
    speed_mps, lateral_mps, yaw_rate_radps, wheel_speed_radps : before the step
    acceleration_mps2, lateral_acceleration_mps2 : of the previous step; only a first guess
    motor_torque_nm : at each wheel, forward positive
    resisting_torque_nm : friction brake plus idle drag at each wheel, >= 0
    steer_rad : of the front wheels, positive to the left
    grade : rise over run in the direction of the car
    headwind_mps : air speed at rest
    friction : peak friction coefficient under each wheel
    dt_s : step, > 0
    """
    load = loads_n(acceleration_mps2, lateral_acceleration_mps2, speed_mps + headwind_mps, grade, vehicle)
    on = _surface(motor_torque_nm, resisting_torque_nm, steer_rad, friction, vehicle)
    slope = grade_force_n(grade, vehicle.chassis)
    # At rest the wind is held like the slope; its work is nothing.
    pull = slope + math.copysign(aerodynamic_force_n(headwind_mps, vehicle.chassis), headwind_mps)
    before = wheel_speed_radps
    if _holds(speed_mps, lateral_mps, yaw_rate_radps, before, on, pull, load, vehicle):
        return _at_rest(speed_mps, lateral_mps, yaw_rate_radps, before, on, slope, load, dt_s, vehicle)
    return _moving(
        speed_mps,
        lateral_mps,
        yaw_rate_radps,
        before,
        acceleration_mps2,
        lateral_acceleration_mps2,
        on,
        grade,
        headwind_mps,
        dt_s,
        vehicle,
    )


@kernel
def _moving(
    speed_mps: float,
    lateral_mps: float,
    yaw_rate_radps: float,
    before: Four,
    acceleration_mps2: float,
    lateral_acceleration_mps2: float,
    on: _Surface,
    grade: float,
    headwind_mps: float,
    dt_s: float,
    vehicle: VehicleParams,
) -> PlaneMotion:
    """The step of a car that nothing holds: Newton's method on its motion at the end of the step."""
    chassis = vehicle.chassis
    mass_rate = chassis.mass_kg / dt_s
    yaw_inertia_rate = chassis.yaw_inertia_kgm2 / dt_s
    slope = grade_force_n(grade, chassis)
    drop = rolling_force_n(grade, chassis) / mass_rate
    turned = yaw_rate_radps * dt_s
    # The same velocity over ground, in the axes of the body as it points after the step.
    start_x = math.cos(turned) * speed_mps + math.sin(turned) * lateral_mps
    start_y = -math.sin(turned) * speed_mps + math.cos(turned) * lateral_mps
    v_x = start_x + acceleration_mps2 * dt_s
    v_y = start_y + lateral_acceleration_mps2 * dt_s
    rate = yaw_rate_radps
    wheels = np.zeros(4)
    force = np.zeros((4, 2))
    matrix = np.zeros((3, 3))
    change = np.zeros(3)
    load = (0.0, 0.0, 0.0, 0.0)
    after_x, after_y, after_rate, coasting, air = v_x, v_y, rate, v_x, 0.0
    last, damping = math.inf, 1.0
    for _ in range(_MOST_ITERATIONS):
        load = loads_n((v_x - start_x) / dt_s, (v_y - start_y) / dt_s, v_x + headwind_mps, grade, vehicle)
        matrix[:] = 0.0
        matrix[0, 0] = matrix[1, 1] = mass_rate
        matrix[2, 2] = yaw_inertia_rate
        total_x, total_y, moment = _tyres(before, v_x, v_y, rate, load, on, dt_s, vehicle, wheels, force, matrix)
        air = math.copysign(aerodynamic_force_n(v_x + headwind_mps, chassis), v_x + headwind_mps)
        coasting = start_x + (total_x - air - slope) / mass_rate
        after_x = coasting - min(max(coasting, -drop), drop)
        after_y = start_y + total_y / mass_rate
        after_rate = yaw_rate_radps + moment / yaw_inertia_rate
        off = max(abs(after_x - v_x), abs(after_y - v_y), abs(after_rate - rate))
        if off <= _TOLERANCE * (1.0 + abs(after_x)):
            break
        damping = max(0.5 * damping, 0.05) if off > last else min(1.2 * damping, 1.0)
        last = off
        change[0] = (after_x - v_x) * mass_rate
        change[1] = (after_y - v_y) * mass_rate
        change[2] = (after_rate - rate) * yaw_inertia_rate
        _solve3(matrix, change)
        v_x += damping * change[0]
        v_y += damping * change[1]
        rate += damping * change[2]
    mean_x = 0.5 * (start_x + after_x)
    mean_y = 0.5 * (start_y + after_y)
    mean_rate = 0.5 * (yaw_rate_radps + after_rate)
    return PlaneMotion(
        speed_mps=after_x,
        lateral_speed_mps=after_y,
        yaw_rate_radps=after_rate,
        wheel_speed_radps=(wheels[0], wheels[1], wheels[2], wheels[3]),
        acceleration_mps2=(after_x - start_x) / dt_s,
        lateral_acceleration_mps2=(after_y - start_y) / dt_s,
        normal_force_n=load,
        holding_torque_nm=(
            _held_nm(0, before, on, dt_s, vehicle, wheels, force),
            _held_nm(1, before, on, dt_s, vehicle, wheels, force),
            _held_nm(2, before, on, dt_s, vehicle, wheels, force),
            _held_nm(3, before, on, dt_s, vehicle, wheels, force),
        ),
        turned_rad=turned,
        mean_speed_mps=mean_x,
        mean_lateral_mps=mean_y,
        rolling_force_n=(coasting - after_x) * mass_rate,
        air_force_n=air,
        slip_work_w=_slip_work_w(before, mean_x, mean_y, mean_rate, on, vehicle, wheels, force),
    )
