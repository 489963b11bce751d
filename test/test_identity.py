# SPDX-License-Identifier: Apache-2.0
"""A policy belongs to what the decision model reads: each number is turned, and the solver's tables decide."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.mdp.transitions import build_model
from iwm_power_manager.model.parameters import IDLE_DRAG, IDLE_ENABLED, IDLE_NONE
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle, with_params

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"))
MAPPED = load_vehicle(share_path("config/vehicles/jalalmaab_2015_map.yaml"))


def _tight(params, idle_drive):
    """The car with motor, brake, battery and idle drag that all bind somewhere on the axes below."""
    motor = params.front.motor._replace(idle_drive=idle_drive, regeneration_torque_nm=70.0)
    params = params.with_axles(motor=motor, friction_brake=params.front.friction_brake._replace(max_torque_nm=150.0))
    return params._replace(
        battery=params.battery._replace(discharge_limit_w=13000.0, charge_limit_w=2000.0),
    )


def _problem(grid, **changes):
    return dataclasses.replace(
        load_problem(share_path(f"config/grids/{grid}.yaml")),
        power_of_car=np.zeros(0),
        speed_of_car=np.zeros(0),
        power_w=np.array([-40000.0, -12000.0, -3000.0, -500.0, 0.0, 500.0, 6000.0, 14000.0, 25000.0]),
        speed_mps=np.array([0.0, 0.4, 2.0, 6.0, 15.0, 30.0]),
        share=np.array([0.0, 0.3, 0.5, 1.0]),
        demand_by_speed=False,
        **changes,
    )


SLIPS = np.array([-0.3, 0.02])
PROBLEMS = (
    _problem("coupled"),
    _problem("fine", slip_front=SLIPS, slip_rear=SLIPS, power_error="road"),
    _problem("paper", slip_front=SLIPS, slip_rear=SLIPS, power_error="wheel"),
)


def _tables(params):
    """All that the solver learns of a car: cost and next state of every state and control."""
    chain = np.full((1, 9, 9), 1.0 / 9.0)
    return [
        table
        for problem in PROBLEMS
        for friction in (0.3, 0.9)
        for table in build_model(problem, params, friction, chain)
        if isinstance(table, np.ndarray)
    ]


def _same(one, two):
    return all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))


def _numbers(params):
    """(section, field) of every number of the car; of the axles once."""
    for section, values in (*params._asdict().items(), *params.front._asdict().items()):
        if section not in ("front", "rear"):
            yield from ((section, name) for name in getattr(values, "_fields", ("",)))


def _turned(values, name):
    """The section with one number a little different."""
    if not name:  # a number of the axle itself
        return values * 0.9
    value = getattr(values, name)
    if name == "model":
        return values._replace(model=1)
    if name == "coefficients":
        return values._replace(coefficients=tuple(0.9 * x for x in value))
    if name == "idle_drive":
        return values._replace(idle_drive=(value + 1) % 3)
    if isinstance(value, np.ndarray):
        return values._replace(**{name: value * 0.97})
    return values._replace(**{name: value * 0.9 if value else 1e-3})


@pytest.mark.parametrize(
    ("car", "idle_drive", "axles"),
    [
        (CAR, IDLE_NONE, "both"),
        (CAR, IDLE_DRAG, "both"),
        (CAR, IDLE_ENABLED, "both"),
        (MAPPED, IDLE_DRAG, "both"),
        (CAR, IDLE_DRAG, "front"),
        (CAR, IDLE_DRAG, "rear"),
    ],
    ids=["none", "drag", "enabled", "map", "front", "rear"],
)
def test_a_number_counts_for_a_policy_exactly_if_the_solver_s_tables_change_with_it(car, idle_drive, axles):
    base = _tight(car.params, idle_drive)
    identity = with_params(car, "tight", base).hash
    tables = _tables(base)
    wrong = []
    for section, name in _numbers(base):
        if section in base._fields:
            turned = base._replace(**{section: _turned(getattr(base, section), name)})
        elif axles == "both":
            turned = base.with_axles(**{section: _turned(getattr(base.front, section), name)})
        else:
            axle = getattr(base, axles)
            turned = base._replace(**{axles: axle._replace(**{section: _turned(getattr(axle, section), name)})})
        counts = with_params(car, "turned", turned).hash != identity
        if counts == _same(tables, _tables(turned)):
            wrong.append(f"{section}.{name} {'counts and is not read' if counts else 'is read and does not count'}")
    # Where a map stands, the coefficients are zero and stay so; where none stands, the map is empty and stays so.
    assert [line for line in wrong if not line.startswith(("motor.loss_", "motor.map_"))] == []
    assert not [line for line in wrong if "is read and does not count" in line]


@pytest.mark.parametrize("axle", ["front", "rear"])
def test_each_axle_counts_for_itself(axle):
    for section, values in getattr(CAR.params, axle)._asdict().items():
        for name in getattr(values, "_fields", ("",)):
            both = with_params(CAR, "both", CAR.params.with_axles(**{section: _turned(values, name)})).hash
            one = getattr(CAR.params, axle)._replace(**{section: _turned(values, name)})
            alone = with_params(CAR, "one", CAR.params._replace(**{axle: one})).hash
            assert (alone == CAR.hash) == (both == CAR.hash), f"{section}.{name}"
            assert alone == CAR.hash or alone != both, f"{section}.{name}"
