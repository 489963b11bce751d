# SPDX-License-Identifier: Apache-2.0
"""Fiala's tyre against the bristles it is made of, its inverse, and a car on it."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model import tyre as model
from iwm_power_manager.model.longitudinal import Speeds, Torques, step
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

PAPER = share_path("config/vehicles/jalalmaab_2015.yaml")
SLIPS = st.floats(-1.0, 1.0)
PEAKS = st.floats(0.05, 1.2)
TYRES = st.builds(
    lambda stiffness, sliding: model.make("fiala", {"slip_stiffness": stiffness, "sliding_factor": sliding}, 0.5),
    st.floats(2.0, 60.0),
    st.floats(0.5, 1.0),
)


def brush(slip, peak, stiffness, bristles=4001):
    """Mean friction of bristles that deflect along the contact patch and slide where the load gives no more."""
    x = (np.arange(bristles) + 0.5) / bristles
    pressure = 6.0 * x * (1.0 - x)
    return float(np.mean(np.minimum(2.0 * stiffness * abs(slip) * x, peak * pressure))) * np.sign(slip)


@given(SLIPS, PEAKS, st.floats(2.0, 60.0))
def test_friction_is_the_mean_over_the_bristles_of_the_patch(slip, peak, stiffness):
    tyre = model.make("fiala", {"slip_stiffness": stiffness, "sliding_factor": 1.0}, 0.5)
    expected = brush(slip, peak, stiffness)
    assert model.friction_coefficient(slip, peak, tyre) == pytest.approx(expected, abs=1e-3 * peak)


@given(SLIPS, PEAKS, TYRES)
def test_the_slope_is_the_derivative_and_the_peak_is_the_road_s(slip, peak, tyre):
    h = 1e-7
    secant = model.friction_coefficient(slip + h, peak, tyre) - model.friction_coefficient(slip - h, peak, tyre)
    mu, slope = model.friction_and_slope(slip, peak, tyre)
    if abs(abs(slip) - model.peak_slip(tyre, peak)) > 1e-5:
        assert slope == pytest.approx(secant / (2.0 * h), rel=1e-3, abs=1e-3)
    assert abs(mu) <= peak * model.peak_ratio(tyre) * (1.0 + 1e-12)
    assert model.friction_coefficient(-slip, peak, tyre) == -mu


@given(st.floats(-1.5, 1.5), PEAKS, TYRES)
def test_the_inverse_is_the_slip_below_the_peak_or_the_peak(friction, peak, tyre):
    slip = model.slip_at_friction(friction, peak, tyre)
    assert model.friction_coefficient(slip, peak, tyre) == pytest.approx(min(max(friction, -peak), peak), abs=1e-9)
    assert abs(slip) <= model.peak_slip(tyre, peak) + 1e-12


def test_beyond_the_peak_friction_falls_to_the_sliding_factor():
    tyre = model.make("fiala", {"slip_stiffness": 30.0, "sliding_factor": 0.7}, 0.5)
    assert model.friction_coefficient(1.0, 0.2, tyre) == pytest.approx(0.14, abs=1e-6)
    assert model.friction_coefficient(model.peak_slip(tyre, 0.9), 0.9, tyre) == pytest.approx(0.9)


def test_without_grip_or_without_demand_there_is_no_slip_and_no_friction():
    tyre = model.make("fiala", {"slip_stiffness": 30.0, "sliding_factor": 0.7}, 0.5)
    assert model.slip_at_friction(0.3, 0.0, tyre) == model.slip_at_friction(0.0, 0.9, tyre) == 0.0
    assert model.friction_and_slope(0.1, 0.0, tyre) == (0.0, 0.0)


def with_tyre(tmp_path, section):
    content = yaml.safe_load(PAPER.read_text())
    content["tyre"] = section
    path = tmp_path / "car.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_vehicle_file_chooses_the_model_and_its_car_moves(tmp_path):
    section = {"model": "fiala", "slip_stiffness": 18.0, "sliding_factor": 0.9, "slip_speed_floor_mps": 0.5}
    fiala = load_vehicle(with_tyre(tmp_path, section))
    paper = load_vehicle(PAPER)
    assert model.numbers(fiala.params.front.tyre)[0] == "fiala"
    assert fiala.hash != paper.hash
    rolling = Speeds(20.0, 20.0 / 0.33, 20.0 / 0.33)
    for car in (fiala.params, paper.params):
        moved = step(rolling, Torques(50.0, 50.0, 0.0, 0.0), 0.0, 0.0, (0.9, 0.9), 0.01, car)
        assert moved.speeds.car_mps > 20.0


def test_the_same_numbers_with_the_model_s_name_are_the_same_car(tmp_path):
    named = load_vehicle(with_tyre(tmp_path, {"model": "magic_formula"} | yaml.safe_load(PAPER.read_text())["tyre"]))
    assert named.hash == load_vehicle(PAPER).hash


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"model": "rubber"}, "tyre.model.*rubber.*magic_formula | fiala"),
        ({"model": "fiala", "stiffness_factor": 10.0}, "tyre.stiffness_factor.*unknown.*slip_stiffness"),
        ({"model": "fiala", "slip_stiffness": 18.0, "slip_speed_floor_mps": 0.5}, "tyre.sliding_factor.*missing"),
        (
            {"model": "fiala", "slip_stiffness": 0.1, "sliding_factor": 1.0, "slip_speed_floor_mps": 0.5},
            "tyre.slip_stiffness.*1",
        ),
        ([], "tyre.*no mapping"),
    ],
)
def test_a_wrong_tyre_is_refused_with_its_key(tmp_path, section, message):
    with pytest.raises(ConfigError, match=message):
        load_vehicle(with_tyre(tmp_path, section))
