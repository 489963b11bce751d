#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What a plant step costs: along a straight line beside the bare longitudinal step, and in the plane beside both.

All in one run, in turns, the fastest of several rounds each. Exit code 1 where the straight line, with battery, motors
and books, takes more than `--most` times the bare step of car and wheels.
"""

from __future__ import annotations

import argparse
import time

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.longitudinal import Speeds, Torques, step
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.plant import Surroundings, advance, initial_plant

STEPS = 50_000
ROUNDS = 7


@kernel
def bare(count, speeds, vehicle):
    """Car and wheels only, on the torques of `driven`."""
    acceleration = 0.0
    for k in range(count):
        torque = 30.0 if k % 200 < 100 else -30.0
        moved = step(speeds, Torques(torque, torque, 0.0, 0.0), acceleration, 0.0, (0.9, 0.9), 0.01, vehicle)
        acceleration = (moved.speeds.car_mps - speeds.car_mps) / 0.01
        speeds = moved.speeds
    return speeds.car_mps


@kernel
def driven(count, state, steer, vehicle):
    """The whole plant."""
    surroundings = Surroundings((0.9, 0.9, 0.9, 0.9), 0.0, 0.0)
    for k in range(count):
        torque = 30.0 if k % 200 < 100 else -30.0
        motors = (torque, torque, torque, torque)
        state = advance(state, motors, (0.0, 0.0, 0.0, 0.0), steer, surroundings, 0.01, 1, vehicle)
    return state.speed_mps


def main() -> int:
    """Time all three, print the ratios."""
    parser = argparse.ArgumentParser(description="Cost of a plant step.")
    parser.add_argument("--most", type=float, default=3.0, help="largest ratio of straight line to bare step")
    most = parser.parse_args().most
    car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none").params
    state = initial_plant(car, 0.8, 15.0)
    cases = {
        "car and wheels alone": lambda n: bare(n, Speeds(state.speed_mps, *state.wheel_speed_radps[::2]), car),
        "plant, straight line": lambda n: driven(n, state, 0.0, car),
        "plant, in the plane": lambda n: driven(n, state, 0.001, car),
    }
    best = dict.fromkeys(cases, float("inf"))
    for case in cases.values():
        case(1)
    for _ in range(ROUNDS):
        for name, case in cases.items():
            start = time.perf_counter()
            case(STEPS)
            best[name] = min(best[name], (time.perf_counter() - start) / STEPS)
    first = next(iter(best.values()))
    for name, seconds in best.items():
        print(f"{name:<22} {1e6 * seconds:6.2f} us a step   {seconds / first:5.2f} x")
    return int(best["plant, straight line"] / first > most)


if __name__ == "__main__":
    raise SystemExit(main())
