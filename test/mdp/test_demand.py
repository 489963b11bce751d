# SPDX-License-Identifier: Apache-2.0
"""The demand's Markov chain: power of a cycle, counting, rows without data, mixing."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.cycle import load_cycle, make_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.mdp.demand import (
    THIN_ROW_STEPS,
    Source,
    chain_of,
    count_steps,
    cycle_power_w,
    cycle_source,
    demand_chain,
    driven_source,
    nearest_bin,
    signal_source,
    source_of,
)
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles.driver import look
from oracles.physics import road_load

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
AXIS = np.array([-2000.0, -1000.0, 0.0, 1000.0, 2000.0])


def _source(*sequences, weight=1.0):
    return Source("test", "", weight, tuple(np.asarray(s, dtype=np.float64) for s in sequences))


def _count_slowly(axis, sequence):
    counts = np.zeros((axis.size, axis.size))
    for now, then in itertools.pairwise(sequence):
        counts[np.argmin(np.abs(axis - now)), np.argmin(np.abs(axis - then))] += 1
    return counts


@given(st.lists(st.floats(-4000, 4000), max_size=50))
def test_every_step_is_counted_in_the_nearest_bins(values):
    assert np.array_equal(count_steps(AXIS, np.array(values)), _count_slowly(AXIS, values))


def test_halfway_between_two_bins_the_lower_one_counts_and_the_ends_take_the_rest():
    assert nearest_bin(AXIS, np.array([-9000.0, -1500.0, -1499.0, 500.0, 9000.0])).tolist() == [0, 0, 1, 2, 4]
    assert nearest_bin(np.array([5.0]), np.array([-1.0, 7.0])).tolist() == [0, 0]


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(2, 60))
def test_rows_are_distributions(seed, points, samples):
    rng = np.random.default_rng(seed)
    axis = np.sort(rng.choice(np.arange(-20, 20), points, replace=False)) * 1000.0
    chain = demand_chain(axis, [_source(rng.normal(0.0, 8000.0, samples), weight=rng.uniform(0.1, 10.0))])
    assert np.all(chain.probability >= 0.0)
    assert chain.probability.sum(axis=1) == pytest.approx(np.ones(points), abs=1e-14)


def test_a_counted_row_holds_the_relative_frequencies():
    chain = demand_chain(AXIS, [_source([0, 0, 1000, 0, 0, -1000, 0])])
    assert chain.probability[2].tolist() == [0.0, 0.25, 0.5, 0.25, 0.0]
    assert chain.row_steps.tolist() == [0.0, 1.0, 4.0, 1.0, 0.0]


def test_a_row_without_data_returns_bin_by_bin_to_the_nearest_demand_with_data():
    chain = demand_chain(AXIS, [_source([-1000, -1000, 1000, -1000])])
    assert chain.unvisited_w.tolist() == [-2000.0, 0.0, 2000.0]
    assert chain.probability[0].tolist() == [0, 1, 0, 0, 0]
    assert chain.probability[4].tolist() == [0, 0, 0, 1, 0]
    # Two bins away on a longer axis: still one bin a step.
    far = demand_chain(np.array([0.0, 1000.0, 2000.0, 3000.0]), [_source([0, 0])])
    assert far.probability[3].tolist() == [0, 0, 1, 0]
    assert far.probability[1].tolist() == [1, 0, 0, 0]


def test_of_two_equally_near_demands_the_smaller_one_is_taken():
    chain = demand_chain(np.array([-2000.0, -1000.0, 0.0]), [_source([-2000, 0, -2000])])
    assert chain.probability[1].tolist() == [0, 0, 1]


def test_the_last_demand_of_a_recording_was_visited_but_never_left():
    chain = demand_chain(AXIS, [_source([0, 0, 2000])])
    assert chain.row_steps[4] == 0.0
    assert chain.probability[4].tolist() == [0, 0, 0, 1, 0]


def test_no_step_leads_from_one_sequence_to_the_next():
    apart = demand_chain(AXIS, [_source([0, 0], [2000, 2000])])
    assert apart.probability[2].tolist() == [0, 0, 1, 0, 0]
    assert demand_chain(AXIS, [_source([0, 0, 2000, 2000])]).probability[2, 4] == 0.5


def test_weights_say_how_much_a_step_of_a_source_counts():
    calm, wild = _source([0, 0]), _source([0, 1000], weight=3.0)
    chain = demand_chain(AXIS, [calm, wild])
    assert chain.probability[2].tolist() == [0, 0, 0.25, 0.75, 0]
    assert chain.row_steps[2] == 4.0


def test_thin_rows_and_clipped_demands_are_reported():
    chain = demand_chain(AXIS, [_source([0.0] * (THIN_ROW_STEPS + 1) + [5000.0, 0.0])])
    assert chain.thin_w.tolist() == [2000.0]
    assert chain.clipped == pytest.approx(1.0 / (THIN_ROW_STEPS + 3))


def test_sources_without_a_single_step_are_refused():
    with pytest.raises(ConfigError, match="test: holds no step of power demand"):
        demand_chain(AXIS, [_source([0.0])])
    with pytest.raises(ConfigError, match="demand: holds no step"):
        demand_chain(AXIS, [])


def test_power_of_a_constant_speed_is_road_load_times_speed():
    power = cycle_power_w(make_cycle("made", [0, 10], [20.0, 20.0]), 0.1, CAR)
    assert power == pytest.approx(np.full(100, (0.5 * 1.2 * 1.66 * 0.34 * 400.0 + 0.01 * 800.0 * 9.81) * 20.0))


def test_power_of_an_acceleration_moves_the_wheels_too():
    power = cycle_power_w(make_cycle("made", [0, 10], [0.0, 20.0]), 0.1, CAR)
    drag = 0.5 * 1.2 * 1.66 * 0.34
    time = 0.1 * np.arange(100) + 0.05
    force = (800.0 + 4.0 * 1.1 / 0.33**2) * 2.0 + drag * (2.0 * time) ** 2 + 0.01 * 800.0 * 9.81
    assert power == pytest.approx(force * 2.0 * time)


def test_a_grade_costs_its_weight_and_a_standing_car_nothing():
    uphill = cycle_power_w(make_cycle("made", [0, 1], [10.0, 10.0], [0.1, 0.1]), 0.1, CAR)
    level = cycle_power_w(make_cycle("made", [0, 1], [10.0, 10.0]), 0.1, CAR)
    cosine = 1.0 / np.sqrt(1.01)
    expected = 800.0 * 9.81 * 10.0 * (0.1 * cosine + 0.01 * (cosine - 1.0))
    assert uphill - level == pytest.approx(np.full(10, expected))
    assert np.all(cycle_power_w(make_cycle("made", [0, 1], [0.0, 0.0], [0.1, 0.1]), 0.1, CAR) == 0.0)


def test_a_driven_cycle_asks_for_what_the_plain_driver_asks_for_in_a_car_that_obeys():
    cycle = make_cycle("made", [0, 4, 6, 9, 12], [0.0, 8.0, 8.0, 0.0, 0.0], [0.0, 0.0, 0.05, 0.05, 0.0])
    source = driven_source(cycle, 0.1, CAR)
    dt, ahead_s, mass = (
        0.01,
        CAR.driver.preview_s,
        800.0 + 4.0 * CAR.front.wheel.inertia_kgm2 / CAR.front.wheel.radius_m**2,
    )

    def trace(time):
        return float(np.interp(time, cycle.time_s, cycle.speed_mps))

    speed, integral, powers, speeds = 0.0, 0.0, [], []
    for k in range(1200):
        now = k * dt
        slope = (trace(now + ahead_s + dt / 2) - trace(now + ahead_s - dt / 2)) / dt
        grade = float(np.interp(now, cycle.time_s, cycle.grade))
        *_, power, integral = look(integral, speed, trace(now), trace(now + ahead_s), slope, grade, dt, CAR)
        powers.append(power)
        speeds.append(speed)
        force = power / max(speed, CAR.driver.power_speed_floor_mps) - road_load(speed, grade, CAR.chassis)
        speed = max(speed + force / mass * dt, 0.0)
    assert source.sequences[0] == pytest.approx(powers[::10], rel=1e-6, abs=1e-3)
    assert source.speeds[0] == pytest.approx(speeds[::10], rel=1e-6, abs=1e-6)
    assert np.abs(source.speeds[0] - np.interp(0.1 * np.arange(120), cycle.time_s, cycle.speed_mps)).max() < 1.0


def test_a_problem_says_whose_demand_it_takes_of_a_cycle():
    cycle = load_cycle(share_path("config/cycles/nycc.csv"))
    exact = source_of(cycle, _by_speed(cycle_demand="exact", dt_s=0.5), CAR, 2.0)
    driven = source_of(cycle, _by_speed(cycle_demand="driven", dt_s=0.5), CAR, 2.0)
    assert exact.sequences[0].tolist() == cycle_power_w(cycle, 0.5, CAR).tolist()
    assert driven.sequences[0].tolist() == driven_source(cycle, 0.5, CAR).sequences[0].tolist()
    assert (
        (driven.name, driven.sha256, driven.weight)
        == (exact.name, exact.sha256, exact.weight)
        == (
            cycle.name,
            cycle.sha256,
            2.0,
        )
    )


def test_the_standard_cycles_visit_every_demand_of_the_paper_s_axis():
    sources = [
        cycle_source(load_cycle(share_path(f"config/cycles/{name}.csv")), 0.1, CAR)
        for name in ("ftp75", "hwfet", "nycc")
    ]
    chain = demand_chain(np.arange(-12, 20) * 1000.0, sources)
    assert chain.unvisited_w.size == 0
    assert chain.row_steps.sum() == sum(source.steps for source in sources) == 18740 + 7650 + 5980 - 3
    assert 0.0 < chain.clipped < 0.01


def test_a_recorded_signal_is_sampled_cut_at_gaps_and_cleaned():
    time = np.array([0.0, 0.05, 0.1, 0.15, 0.2, np.nan, 0.12, 5.0, 5.1, 5.2, 9.0])
    power = np.array([0.0, 50.0, 100.0, 150.0, 200.0, 1.0, 1e9, 7.0, np.inf, 9.0, 3.0])
    source = signal_source("bag", time, power, 0.1, 2.0)
    assert [s.tolist() for s in source.sequences] == [
        pytest.approx([0.0, 100.0, 200.0]),
        pytest.approx([7.0, 8.0, 9.0]),
    ]
    assert source.steps == 4
    assert source.weight == 2.0
    assert signal_source("other", time, power, 0.1).sha256 == source.sha256
    assert signal_source("bag", time, power + 1.0, 0.1).sha256 != source.sha256


def test_an_empty_signal_is_a_source_without_steps():
    assert signal_source("bag", np.array([]), np.array([]), 0.1).steps == 0


def test_a_recording_of_a_cycle_gives_the_cycle_s_chain():
    cycle = load_cycle(share_path("config/cycles/nycc.csv"))
    power = cycle_power_w(cycle, 0.1, CAR)
    recorded = signal_source("bag", 100.0 + 0.1 * np.arange(power.size), power, 0.1)
    axis = np.arange(-12, 20) * 1000.0
    from_bag = demand_chain(axis, [recorded])
    from_cycle = demand_chain(axis, [cycle_source(cycle, 0.1, CAR)])
    assert np.array_equal(from_bag.probability, from_cycle.probability)


def _by_speed(**changes):
    problem = load_problem(share_path("config/grids/coupled.yaml")).for_car(CAR)
    axes = {"power_w": AXIS, "speed_mps": np.array([0.0, 10.0, 20.0])}
    return dataclasses.replace(problem, **{**axes, **changes})


def test_a_chain_by_speed_tells_slow_from_fast():
    # At 0 m/s a demand of 1 kW is followed by 2 kW, at 20 m/s by 1 kW.
    slow = Source("slow", "0", 1.0, (np.array([1000.0, 2000.0] * 50),), (np.zeros(100),))
    fast = Source("fast", "1", 1.0, (np.full(100, 1000.0),), (np.full(100, 20.0),))
    chain = chain_of(_by_speed(prior_steps=1e-9), [slow, fast])
    one, two = np.searchsorted(AXIS, [1000.0, 2000.0])
    assert chain.by_speed[0, one, two] == pytest.approx(1.0)
    assert chain.by_speed[2, one, one] == pytest.approx(1.0)
    # Between them, without data of its own, the chain of all speeds holds.
    assert chain.by_speed[1] == pytest.approx(chain.probability)
    assert chain.matrix is chain.by_speed


def test_rows_by_speed_are_distributions_and_few_data_lean_on_the_chain_of_all_speeds():
    source = cycle_source(load_cycle(share_path("config/cycles/nycc.csv")), 0.1, CAR)
    for prior in (1e-6, 5.0, 1e12):
        chain = chain_of(_by_speed(prior_steps=prior), [source])
        assert chain.by_speed.sum(axis=2) == pytest.approx(np.ones((3, AXIS.size)), abs=1e-12)
    assert chain.by_speed[0] == pytest.approx(chain.probability, abs=1e-6)


def test_a_source_without_speed_is_refused_where_the_chain_depends_on_it():
    source = signal_source("bag", np.arange(10.0) * 0.1, np.ones(10), 0.1)
    with pytest.raises(ConfigError, match="bag: speed: is not known"):
        chain_of(_by_speed(), [source])


def test_the_paper_s_chain_does_not_depend_on_speed():
    source = cycle_source(load_cycle(share_path("config/cycles/nycc.csv")), 0.1, CAR)
    chain = chain_of(_by_speed(demand_by_speed=False), [source])
    assert chain.by_speed.shape[0] == 0
    assert chain.matrix.tolist() == [chain.probability.tolist()]
