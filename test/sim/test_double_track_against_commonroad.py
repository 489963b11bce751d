# SPDX-License-Identifier: Apache-2.0
"""The double track beside models that others wrote: CommonRoad's single track, with linear tyres and with Pacejka's.

Both describe a car by its wheelbase, mass, yaw inertia and tyres. Where they hold, at lateral accelerations that move
no wheel far from its linear or nearly linear range, the same car with the same steering has to turn alike within 5 %.
The side slip angle of this car passes through zero about 20 m/s: of nothing, 5 % say nothing, so 20 m/s is left out.
CommonRoad's Pacejka tyre is not symmetric (ply steer, conicity): left and right turns are averaged.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from vehiclemodels import vehicle_dynamics_st as single_track
from vehiclemodels import vehicle_dynamics_std as drift
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2

from iwm_power_manager.model.tyre import make
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.plant import Surroundings, advance, initial_plant

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none").params
THEIRS = parameters_vehicle2()  # a BMW 320i
FRICTION = THEIRS.tire.p_dy1
WITHIN = 0.05


def their_car(tyre):
    """CommonRoad's car with our kernels: without air and rolling resistance, its wheels ours."""
    chassis = CAR.chassis._replace(
        mass_kg=THEIRS.m,
        front_axle_to_cg_m=THEIRS.a,
        rear_axle_to_cg_m=THEIRS.b,
        cg_height_m=THEIRS.h_s,
        yaw_inertia_kgm2=THEIRS.I_z,
        drag_coefficient=0.0,
        rolling_resistance=0.0,
    )
    front = CAR.front._replace(tyre=tyre, track_width_m=THEIRS.T_f)
    rear = CAR.rear._replace(tyre=tyre, track_width_m=THEIRS.T_r)
    return CAR._replace(chassis=chassis, front=front, rear=rear)


def ours(car, speed, steer, seconds, every_s):
    """Yaw rate and side slip angle over time."""
    state, rows = initial_plant(car, 0.8, speed), []
    road = Surroundings((FRICTION,) * 4)
    for step in range(round(seconds / 0.005)):
        if step % round(every_s / 0.005) == 0:
            rows.append((state.yaw_rate_radps, math.atan2(state.lateral_speed_mps, state.speed_mps)))
        state = advance(state, (0.0,) * 4, (0.0,) * 4, steer, road, 0.005, 1, car)
    return np.array(rows)


def theirs(model, speed, steer, seconds, every_s):
    wheel = speed / THEIRS.R_w
    start = [0.0, 0.0, steer, speed, 0.0, 0.0, 0.0, wheel, wheel][
        : 7 if model is single_track.vehicle_dynamics_st else 9
    ]
    times = np.arange(0.0, seconds - 1e-9, every_s)
    solution = solve_ivp(
        lambda _, x: model(list(x), [0.0, 0.0], THEIRS),
        (0.0, seconds),
        start,
        t_eval=times,
        rtol=1e-7,
        atol=1e-8,
        method="LSODA",
    )
    return solution.y[5:7].T


def linear_tyre():
    """The stiffness of CommonRoad's linear tyre in a curve that is straight this far: 21.92 N a rad and a N of load."""
    return make("fiala", {"slip_stiffness": -THEIRS.tire.p_ky1, "sliding_factor": 1.0}, 0.5)


def pacejka_tyre():
    t = THEIRS.tire
    return make(
        "magic_formula",
        {
            "stiffness_factor": -t.p_ky1 / (t.p_cy1 * t.p_dy1),
            "shape_factor": t.p_cy1,
            "peak_factor": 1.0,
            "curvature_factor": t.p_ey1,
        },
        0.5,
    )


@pytest.mark.parametrize(("speed", "steer"), [(10.0, 0.005), (15.0, 0.003), (25.0, -0.0015), (30.0, 0.001)])
def test_a_step_of_steering_answers_like_the_linear_single_track(speed, steer):
    a = ours(their_car(linear_tyre()), speed, steer, 3.0, 0.1)
    b = theirs(single_track.vehicle_dynamics_st, speed, steer, 3.0, 0.1)
    scale = np.abs(b).max(axis=0)
    assert np.max(np.abs(a - b) / scale) < WITHIN
    assert a[-1] == pytest.approx(b[-1], rel=WITHIN)


@pytest.mark.parametrize(("speed", "steer"), [(10.0, 0.09), (15.0, 0.04), (20.0, 0.03)])
def test_a_steady_turn_at_three_to_five_metres_a_second_squared_is_the_drift_model_s(speed, steer):
    a = ours(their_car(pacejka_tyre()), speed, steer, 4.0, 0.1)
    left = theirs(drift.vehicle_dynamics_std, speed, steer, 4.0, 0.1)
    right = theirs(drift.vehicle_dynamics_std, speed, -steer, 4.0, 0.1)
    b = 0.5 * (left - right)
    assert 2.5 < speed * a[-1, 0] < 6.0
    assert a[-1, 0] == pytest.approx(b[-1, 0], rel=WITHIN)
    assert np.max(np.abs(a[:, 0] - b[:, 0])) < WITHIN * np.abs(b[:, 0]).max()
