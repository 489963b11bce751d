# SPDX-License-Identifier: Apache-2.0
"""What a run amounts to, on series made by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.closed_loop import COLUMNS, Run
from iwm_sim.metrics import longest_s, measure, share_changes, share_swings, trace_excess_mps
from iwm_sim.plant import initial_plant

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
BAND = 2 * 0.44704
SPEEDS = st.lists(st.floats(0.0, 30.0), min_size=1, max_size=40)


def excess_slowly(trace, speed, dt):
    """40 CFR 1066.425: between the lowest and the highest trace point within a second, 2 mph wider."""
    reach, worst = round(1.0 / dt), 0.0
    for k, v in enumerate(speed):
        near = trace[max(k - reach, 0) : k + reach + 1]
        worst = max(worst, min(near) - BAND - v, v - max(near) - BAND)
    return worst


@given(SPEEDS, st.integers(0, 1000), st.sampled_from([0.1, 0.25, 0.5, 1.0]))
def test_the_trace_s_band_is_the_epa_s(trace, seed, dt):
    speed = np.array(trace) + np.random.default_rng(seed).normal(0.0, 1.5, len(trace))
    assert trace_excess_mps(np.array(trace), speed, dt) == pytest.approx(excess_slowly(trace, speed, dt), abs=1e-12)


def test_a_car_a_second_late_or_two_miles_an_hour_off_holds_the_trace():
    trace = np.concatenate((np.zeros(20), np.linspace(0.0, 20.0, 101), np.full(20, 20.0)))
    late = np.concatenate((np.zeros(10), trace[:-10]))
    assert trace_excess_mps(trace, late, 0.1) == 0.0
    assert trace_excess_mps(trace, trace + BAND, 0.1) == pytest.approx(0.0, abs=1e-12)
    assert trace_excess_mps(np.full(9, 10.0), np.full(9, 10.0 + BAND + 0.1), 0.1) == pytest.approx(0.1)
    assert trace_excess_mps(np.full(9, 10.0), np.full(9, 10.0 - BAND - 0.2), 0.1) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("share", "count"),
    [
        ([], 0),
        ([0.5], 0),
        ([0.5, 0.75], 0),  # exactly the threshold
        ([0.5, 0.7501], 1),
        ([0.5, 1.0, 1.0, 0.5], 2),
        ([0.5, 0.6, 0.7, 0.8, 0.9, 1.0], 1),  # counted at 0.8, from there to 1.0 is too little
        ([0.0, 0.2, 0.0, 0.2, 0.0], 0),
        ([1.0, 0.0, 1.0, 0.0], 3),
        ([0.25, 0.0, 0.5, 0.0, 0.5], 0),  # around where it last counted
    ],
)
def test_a_share_change_is_a_move_by_more_than_a_quarter_from_where_it_last_counted(share, count):
    assert share_changes(np.array(share)) == count


@given(st.lists(st.integers(0, 20), min_size=1, max_size=12), st.integers(0, 12))
def test_swings_are_the_fewest_places_that_leave_no_swing_wider_than_a_quarter(steps, least):
    """Against all ways to cut the shares into pieces, the fewest first."""
    cuts = range(1, len(steps))

    def calm(chosen):
        edges = [0, *chosen, len(steps)]
        return all(max(steps[a:b]) - min(steps[a:b]) <= least for a, b in itertools.pairwise(edges))

    fewest = next(n for n in range(len(steps)) if any(map(calm, itertools.combinations(cuts, n))))
    share, width = np.array(steps) / 20.0, least / 20.0
    assert share_swings(share, width) == fewest >= share_changes(share, width)


def test_a_share_that_swings_around_where_it_last_counted_is_seen_by_its_swings_alone():
    share = np.array([0.25, 0.0, 0.5, 0.0, 0.5])
    assert (share_changes(share), share_swings(share), share_swings(np.array([]))) == (0, 3, 0)


@given(st.lists(st.booleans(), max_size=30))
def test_the_longest_stretch_is_found(flags):
    longest = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        longest = max(longest, run)
    assert longest_s(np.array(flags, dtype=bool), 0.5) == pytest.approx(0.5 * longest)


def made(steps, dt=0.1, **columns):
    series = np.zeros((steps, len(COLUMNS)))
    for name, values in columns.items():
        series[:, COLUMNS.index(name)] = values
    start = initial_plant(CAR, 0.8)
    books = start.energies._replace(chemical_j=7200.0)
    return Run(dt, series, start._replace(soc=0.79, distance_m=50.0, energies=books))


def test_energy_is_what_the_cells_gave():
    found = measure(made(10, soc=0.8), CAR)
    assert found.energy_wh == pytest.approx(2.0)
    assert found.wh_per_km == pytest.approx(40.0)
    assert found.delta_soc_percent == pytest.approx(1.0)
    assert (found.final_soc, found.distance_m) == (0.79, 50.0)


def test_errors_of_speed():
    speed = np.array([10.0, 11.0, 9.0, 10.0])
    found = measure(made(4, trace_mps=10.0, speed_mps=speed), CAR)
    assert found.rms_speed_error_mps == pytest.approx(np.sqrt(0.5))
    assert found.max_speed_error_mps == pytest.approx(1.0)
    assert not found.trace_held
    assert found.trace_excess_mps == pytest.approx(1.0 - BAND)
    assert measure(made(4, trace_mps=10.0, speed_mps=10.5), CAR).trace_held


def test_slip_counts_while_the_car_moves():
    speed = np.array([5.0, 5.0, 5.0, 5.0, 0.9, 5.0])
    front = np.array([0.1, -0.3, -0.25, 0.0, -1.0, -0.21])
    rear = np.array([-0.1, 0.0, -0.2, -0.2, 1.0, 0.05])
    found = measure(made(6, speed_mps=speed, trace_mps=speed, front_slip=front, rear_slip=rear), CAR)
    assert (found.min_slip, found.max_slip) == (-0.3, 0.1)
    assert found.locked_s == pytest.approx(0.3)
    assert found.longest_locked_s == pytest.approx(0.2)


def test_drivability():
    share = np.array([0.5, 1.0, 1.0, 0.0, 0.0, 0.0])
    found = measure(
        made(
            6,
            decided_share=share,
            acceleration_mps2=[0.0, 0.1, 0.0, 0.1, 0.0, 0.1],
            front_motor_nm=[0, 5, 5, 5, 5, 5],
            rear_motor_nm=[0, 0, -20, 0, 0, 0],
        ),
        CAR,
    )
    assert found.share_changes_per_min == pytest.approx(2 / (0.6 / 60))
    assert found.share_travel_per_min == pytest.approx(1.5 / (0.6 / 60))
    assert found.rms_jerk_mps3 == pytest.approx(1.0)
    assert found.max_torque_rate_nmps == pytest.approx(200.0)


def test_a_car_that_never_moved_has_no_consumption_per_kilometre():
    run = made(1)
    found = measure(Run(run.dt_s, run.series, run.final._replace(distance_m=0.0)), CAR)
    assert np.isnan(found.wh_per_km)
    assert (found.min_slip, found.max_slip, found.rms_jerk_mps3, found.max_torque_rate_nmps) == (0.0, 0.0, 0.0, 0.0)
