# SPDX-License-Identifier: Apache-2.0
"""No side of the car is preferred: a mirrored car, or one turned end for end, is judged and commanded the same.

The likeliest mistake in a law that counts wheels is one side's number in the place of the other's. It cannot hide here:
every number is drawn for each wheel by itself, axles have nothing in common, and the scenes reach what is rarely
reached: speeds that outvote the forces, brakes that are weak, wheels that all jump, or are all doubted.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numba.core import config as numba_config

from iwm_power_manager.control import friction, law, motion
from iwm_power_manager.control.settings import GATE_MODES, default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Agreed, Compared, ControllerState, Measurement, SideGrip, initial_state
from iwm_power_manager.model.parameters import FrictionBrake, Motor, VehicleParams
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

PAPER = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
WEAK: Motor = PAPER.rear.motor._replace(max_power_w=6000.0, peak_torque_nm=150.0, regeneration_torque_nm=60.0)
#: Axles that have nothing in common but their tyres; without height, since a load that moves to the rear knows which
#: end is which.
CAR = PAPER._replace(
    chassis=PAPER.chassis._replace(cg_height_m=0.0, front_axle_to_cg_m=0.9, rear_axle_to_cg_m=1.4),
    rear=PAPER.rear._replace(
        motor=WEAK,
        wheel=PAPER.rear.wheel._replace(radius_m=0.3, inertia_kgm2=0.8),
        friction_brake=PAPER.rear.friction_brake._replace(max_torque_nm=400.0),
        track_width_m=1.1,
    ),
)
FOREIGN = CAR.with_axles(friction_brake=FrictionBrake(0.0))
BRAKED_IN_FRONT = CAR._replace(rear=CAR.rear._replace(friction_brake=FrictionBrake(0.0)))
DT = 0.01
TABLE = empty_table()
#: For coverage and mutation the law runs as plain Python.
SCENES = range(600 if numba_config.DISABLE_JIT else 1500)


#: What is positive to the left, or for the left wheels.
SIDED = (
    *("front_unequal_s", "rear_unequal_s", "yaw_rate_radps", "straight_radps", "shown_radps"),
    *("lateral_mps2", "level_mps2", "aside_mps"),
)


class Turn:
    """A way of looking at a car from another side."""

    order: tuple[int, int, int, int]
    names: tuple[str, str]

    def name(self, field: str, fields: tuple[str, ...]) -> str:
        one, other = self.names
        for a, b in ((one, other), (other, one)):
            if a in field and field.replace(a, b) in fields:
                return field.replace(a, b)
        return field

    def of(self, value: Any) -> Any:
        """The same seen from there: four numbers are the wheels', and names tell whose the others are."""
        fields = getattr(value, "_fields", None)
        if fields is not None:
            parts = {self.name(field, fields): self.of(part) for field, part in zip(fields, value, strict=True)}
            return self.bits(type(value)(**parts))
        if isinstance(value, tuple) and len(value) == 4:
            return tuple(self.of(value[i]) for i in self.order)
        return value

    def bits(self, value: Any) -> Any:
        """Bits of wheels and axles, and what has a sign or a share for a side."""
        changed = {}
        for field in {"doubted", "gated_wheels"} & set(value._fields):
            old = getattr(value, field)
            changed[field] = old & ~15 | sum(1 << i for i in range(4) if old >> self.order[i] & 1)
        return value._replace(**changed)

    def car(self, vehicle: VehicleParams) -> VehicleParams:
        return vehicle


class Mirrored(Turn):
    """Left is right."""

    order, names = (1, 0, 3, 2), ("left", "right")

    def bits(self, value: Any) -> Any:
        value = super().bits(value)
        more = {name: -getattr(value, name) for name in SIDED if hasattr(value, name)}
        return value._replace(**more)


class EndForEnd(Turn):
    """Front is rear."""

    order, names = (2, 3, 0, 1), ("front", "rear")

    def bits(self, value: Any) -> Any:
        value = super().bits(value)
        more = {name: 1.0 - getattr(value, name) for name in ("front_share", "applied_share") if hasattr(value, name)}
        if hasattr(value, "gate"):
            more["gate"] = (0, 2, 1, 3)[value.gate]
        return value._replace(**more)

    def car(self, vehicle: VehicleParams) -> VehicleParams:
        a, b = vehicle.chassis.front_axle_to_cg_m, vehicle.chassis.rear_axle_to_cg_m
        chassis = vehicle.chassis._replace(front_axle_to_cg_m=b, rear_axle_to_cg_m=a)
        return vehicle._replace(front=vehicle.rear, rear=vehicle.front, chassis=chassis)


TURNS = pytest.mark.parametrize("turn", [Mirrored(), EndForEnd()], ids=["mirrored", "end for end"])


def alike(one: Any, other: Any) -> bool:
    """Equal but for the order of a sum."""
    if isinstance(one, tuple):
        return all(alike(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, float):
        return math.isclose(one, other, rel_tol=1e-7, abs_tol=1e-7) or (math.isnan(one) and math.isnan(other))
    return bool(one == other)


class Draw:
    """Numbers of a scene."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def of(self, *options: Any) -> Any:
        return options[self.rng.integers(len(options))]

    def near(self, value: float, part: float = 0.01) -> float:
        return value * float(self.rng.uniform(1.0 - part, 1.0 + part))

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def four(self, draw: Any) -> tuple[Any, Any, Any, Any]:
        return draw(), draw(), draw(), draw()

    def some_alike(self, values: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        return self.four(lambda: self.of(*values[:2]))


class Scene:
    """A car in one step: its speeds and torques, and what was remembered of the step before."""

    def __init__(self, seed: int) -> None:
        d = self.draw = Draw(seed)
        self.car = d.of(CAR, CAR, CAR, CAR, FOREIGN, BRAKED_IN_FRONT)
        self.radii = (self.car.front.wheel.radius_m,) * 2 + (self.car.rear.wheel.radius_m,) * 2
        self.inertias = (self.car.front.wheel.inertia_kgm2,) * 2 + (self.car.rear.wheel.inertia_kgm2,) * 2
        self.travel = d.of(1.0, 1.0, 1.0, -1.0)
        self.speed = self.travel * d.near(d.of(0.0, 0.05, 0.5, 2.5, 6.0, 13.0, 21.0, 34.0), 0.2)
        self.reference, self.shown = self.speed, self.speed
        self.doubt_s = self.doubts_s = None
        big = d.of(5.0, 50.0, 400.0)
        self.torques = d.four(lambda: d.between(-big, big))
        self.factor = d.of(1.0, 1.0, 1.0, d.between(0.7, 1.4))
        self.calm_s, self.agreed = d.between(0.0, 0.3), Agreed(0.0, 0.0, 0.0, 0.0)
        self.gains = d.of((1.0,) * 4, (1.0,) * 4, d.four(lambda: d.of(1.0, 0.0, d.between(0.0, 1.0))))
        d.of(self.anything, self.agreeing, self.weak_brakes, self.jumping, self.rolling, self.all_doubted)()

    def anything(self) -> None:
        d = self.draw
        self.reference = d.near(self.speed, 0.2) + d.of(0.0, d.between(-3.0, 3.0))
        self.shown = d.of(self.speed, math.nan, 0.8 * self.speed, d.near(self.speed, 0.3))
        self.rims = d.four(lambda: d.of(d.near(self.speed), d.near(self.speed, 0.4), 0.0))
        self.before_rims = tuple(rim + d.of(0.0, d.between(-3.0, 3.0)) for rim in self.rims)
        self.doubts_s = d.four(lambda: d.of(0.0, 0.0, d.between(0.0, 0.5)))

    def agreeing(self) -> None:
        """Sensor and some wheels against the forces; the others slip as their torques make them, or do not."""
        d = self.draw
        self.reference = self.speed + d.of(-1.0, 1.0) * d.between(0.5, 5.0)
        self.torques = tuple(d.of(1.0, 1.0, -1.0) * self.torques[0] * d.near(1.0, 0.5) for _ in range(4))
        slips = (d.of(0.0, d.of(0.0, 0.3), math.copysign(0.3, t * self.speed)) for t in self.torques)
        self.rims = tuple(self.speed * (1.0 + slip) * d.near(1.0, 0.005) for slip in slips)
        self.before_rims = tuple(rim + d.between(-0.1, 0.1) for rim in self.rims)
        lasted = d.of(0.0, 0.095, 0.2, 0.295, 0.5, 1.1)
        gone = self.travel * d.between(-12.0, 12.0) * lasted
        felt = d.of(math.nan, gone, 0.0, d.near(gone, 0.3))
        self.agreed = Agreed(lasted, self.speed - gone, gone + d.between(-12.0, 12.0) * lasted, felt)

    def weak_brakes(self) -> None:
        """All brake hard, some of them for nothing: speeds tell it that agree against the forces."""
        d = self.draw
        self.speed = self.shown = self.travel * d.between(8.0, 35.0)
        self.reference = self.speed - self.travel * d.between(2.0, 5.0)
        self.torques = d.four(lambda: d.between(-900.0, -200.0))
        self.rims = d.four(lambda: self.speed * (1.0 - d.of(d.between(0.0, 0.03), d.between(0.02, 0.12))))
        self.before_rims = tuple(rim + d.between(-0.1, 0.1) for rim in self.rims)
        gone = -self.travel * d.between(0.0, 4.0) * 0.295
        forces = gone - self.travel * d.between(2.0, 12.0) * 0.295
        self.doubt_s = 0.0
        self.gains = d.of((1.0,) * 4, d.four(lambda: d.between(0.3, 1.0)))
        self.agreed = Agreed(0.295, self.speed - gone, forces, d.of(math.nan, gone))

    def jumping(self) -> None:
        """All wheels by one factor, more or less, of which one may not have been believed."""
        d = self.draw
        self.speed = self.travel * d.between(5.0, 30.0)
        self.shown = self.reference = d.near(self.speed, 0.02)
        factor, apart = d.of(d.between(0.65, 0.9), d.between(1.1, 1.5)), d.of(0.001, 0.005, 0.1)
        self.before_rims = d.four(lambda: d.near(self.speed, 0.005))
        self.rims = tuple(factor * d.near(rim, apart) for rim in self.before_rims)
        self.factor, self.doubt_s = 1.0, d.of(0.0, 0.0, 0.0, 0.1)
        doubted = int(d.rng.integers(8))
        self.doubts_s = tuple(0.2 if i == doubted else 0.0 for i in range(4))

    def rolling(self) -> None:
        """Healthy but for a sensor or wheel that is not yet believed again."""
        d = self.draw
        self.shown = d.of(self.speed, 1.1 * self.speed + 0.6 * self.travel, math.nan)
        part = d.of(0.001, 0.01, 0.03)
        self.reference = d.near(self.speed, part)
        self.rims = d.four(lambda: d.near(self.speed, part))
        self.before_rims = tuple(rim + d.between(-0.05, 0.05) for rim in self.rims)
        self.doubts_s = d.of((0.0,) * 4, d.four(lambda: d.of(0.0, 0.0, d.between(0.0, 0.5))))
        self.torques = d.four(lambda: d.between(-1.0, 1.0) * d.of(0.0, 20.0, 150.0))

    def all_doubted(self) -> None:
        """Or all but one."""
        d = self.draw
        believed = int(d.rng.integers(8))
        self.doubts_s = tuple(0.0 if i == believed else d.between(0.02, 0.5) for i in range(4))
        self.shown = d.of(self.speed, math.nan)
        self.reference = self.speed + d.between(-2.0, 2.0)
        factor, part = d.of(1.0, 0.8, 1.3), d.of(0.01, 0.01, 0.3)
        self.rims = d.four(lambda: factor * d.near(self.speed, part))
        self.before_rims = tuple(d.near(rim, 0.01) for rim in self.rims)
        lasted = d.of(0.0, 0.095, 0.5, 1.1)
        self.agreed = Agreed(
            lasted, d.near(self.speed, 0.1), d.between(-3.0, 3.0), d.of(math.nan, d.between(-3.0, 3.0))
        )

    def measurement(self) -> Measurement:
        d = self.draw
        return Measurement(
            speed_mps=self.shown,
            wheel_speed_radps=tuple(rim / r for rim, r in zip(self.rims, self.radii, strict=True)),  # type: ignore[arg-type]
            power_demand_w=d.of(0.0, 1.0, -1.0, -1.0) * d.of(500.0, 8e3, 40e3, 200e3),
            dt_s=DT,
            friction=0.9,
            discharge_limit_w=d.of(47.5e3, 47.5e3, 5e3),
            charge_limit_w=d.of(47.5e3, 47.5e3, 2e3),
            soc=0.6,
            motor_gain=d.of((1.0,) * 4, d.four(lambda: d.of(1.0, 1.0, 0.5, 0.0))),
            motor_stuck_nm=d.of((0.0,) * 4, (0.0,) * 4, d.four(lambda: d.of(0.0, 20.0, -30.0))),
            acceleration_mps2=d.of(math.nan, d.between(-9.0, 9.0)),
            yaw_rate_radps=d.of(math.nan, d.between(-0.2, 0.2)),
            lateral_mps2=d.of(math.nan, d.between(-5.0, 5.0)),
        )

    def state(self) -> ControllerState:
        d, start = self.draw, initial_state()
        motor = tuple(max(min(torque, 100.0), -60.0) for torque in self.torques)
        wheels = tuple(
            wheel._replace(
                motor_nm=motor[i],
                total_nm=self.torques[i],
                speed_radps=self.travel * self.before_rims[i] / self.radii[i],
                road_nm=self.torques[i] + d.of(0.0, d.between(-40.0, 40.0)),
                slip=d.between(-0.05, 0.05),
                gated=bool(d.of(False, False, False, True)),
                heat=d.of(0.0, d.between(0.0, 1.0)),
            )
            for i, wheel in enumerate(start.wheels)
        )
        none = (0.0,) * 4
        moved = start.motion._replace(
            speed_mps=self.reference,
            bias_mps2=d.of(0.0, d.between(-3.0, 3.0)),
            shown_mps=d.of(self.shown, self.shown, d.near(self.speed)),
            shown_s=d.of(0.0, 0.06),
            moved_mps=d.between(-0.5, 0.5),
            apart_s=d.of(0.0, 0.095),
            doubt_s=d.of(0.0, d.between(0.0, 0.5)) if self.doubt_s is None else self.doubt_s,
            wheel_stray_s=d.of(none, d.four(lambda: d.between(0.0, 0.1))),
            wheel_doubt_s=none if self.doubts_s is None else self.doubts_s,
            least_nm=d.of(none, d.four(lambda: d.between(-900.0, 0.0))),
            most_nm=d.of(none, d.four(lambda: d.between(0.0, 200.0))),
            agreed=self.agreed,
            brake_gain=self.gains,
            wheels_factor=self.factor,
            compared=Compared(*d.of((1.0, 0.0), (1.0, 0.3), (d.between(0.75, 1.3), d.of(0.1, 0.195, 0.3)))),
            calm_s=self.calm_s,
        )
        return start._replace(
            steps=d.of(0, 7, 7, 7, 7, 7),
            wheels=wheels,
            motion=moved,
            travel=self.travel,
            friction=self.grip(start.friction),
            split=start.split._replace(applied_share=d.between(0.0, 1.0)),
            hold_nm=d.of(0.0, 0.0, 60.0),
        )

    def grip(self, start: friction.FrictionState) -> friction.FrictionState:
        d = self.draw
        wheels = d.four(
            lambda: start.wheels[0]._replace(
                slip=d.of(d.between(-0.01, 0.01), d.between(-0.3, 0.3)),
                used=d.between(-0.9, 0.9),
                weight=d.between(0.0, 50.0),
                torque=d.between(-0.1, 0.1),
                road=d.between(-0.1, 0.1),
                curve=d.between(-0.2, 0.2),
                torque_torque=d.between(0.0, 1.0),
                torque_road=d.between(-0.1, 1.0),
                torque_curve=d.between(-0.1, 2.0),
                curve_curve=d.between(0.0, 4.0),
            )
        )
        left, right = (SideGrip(d.between(0.1, 1.0), d.between(0.0, 1.0)) for _ in range(2))
        return friction.FrictionState(left=left, right=right, wheels=wheels, assumed=d.between(0.1, 1.0))


@TURNS
def test_what_is_known_of_the_motion_is_the_same_from_any_side(turn: Turn) -> None:
    for seed in SCENES:
        scene = Scene(seed)
        m, state = scene.measurement(), scene.state()
        first = state.steps == 0
        here = motion.estimate(m, state.motion, state.wheels, state.travel, first, scene.car)
        there = motion.estimate(
            turn.of(m), turn.of(state.motion), turn.of(state.wheels), state.travel, first, turn.car(scene.car)
        )
        assert alike(turn.of(here[0]), there[0]), seed
        assert alike(turn.of(here[1]), there[1]), seed


@TURNS
def test_the_road_s_friction_is_the_same_from_any_side(turn: Turn) -> None:
    tuned = default_settings("equal")
    for seed in SCENES:
        scene = Scene(seed)
        m, state = scene.measurement(), scene.state()
        speed, believed = abs(scene.speed), bool(scene.draw.of(True, True, True, False))
        w = tuple(abs(wheel) for wheel in m.wheel_speed_radps)
        grip, wheels = state.friction, state.wheels
        if seed % 2:  # some wheels are alike, in one thing or in all: a shortcut for those must not take in others
            grip = grip._replace(wheels=scene.draw.some_alike(grip.wheels), right=scene.draw.of(grip.left, grip.right))
            wheels, w = scene.draw.some_alike(wheels), scene.draw.some_alike(w)
        parts = speed, believed, state.steps == 0, DT, tuned
        here = friction.estimate(grip, wheels, w, *parts, scene.car)
        there = friction.estimate(turn.of(grip), turn.of(wheels), turn.of(w), *parts, turn.car(scene.car))
        assert alike(turn.of(here), there), seed


@TURNS
def test_the_commands_are_the_same_from_any_side(turn: Turn) -> None:
    """Of a car whose axles are tuned alike, where it is turned end for end."""
    for seed in SCENES:
        scene = Scene(seed)
        d = scene.draw
        m, state = scene.measurement(), scene.state()
        tuned = default_settings("equal")._replace(
            gate_mode=d.of(*GATE_MODES.values()), front_yaw_nm=d.of(50.0, 500.0), rear_yaw_nm=d.of(0.0, 300.0)
        )
        state = state._replace(front_unequal_s=d.of(0.0, d.between(-1.0, 1.0)), rear_unequal_s=d.between(-1.0, 1.0))
        if isinstance(turn, EndForEnd):
            # Steering against unequal brakes is the front wheels' matter.
            state = state._replace(front_unequal_s=0.0, rear_unequal_s=0.0)
            # And the rear wheels alone are held to the slip of the others.
            tuned = tuned._replace(unequal_rear_slip_target=0.9)
            if m.power_demand_w >= 0.0:
                # And a driven front wheel alone is held to the slip of one with less of its motor.
                m = m._replace(motor_gain=(m.motor_gain[0],) * 2 + (m.motor_gain[2],) * 2)
        command, after = law.step(m, state, tuned, scene.car, TABLE)
        other_command, other_after = law.step(turn.of(m), turn.of(state), turn.of(tuned), turn.car(scene.car), TABLE)
        if isinstance(turn, EndForEnd) and max(command.hold_nm, other_command.hold_nm) > 0.0:
            continue  # so is the radius by which a car is held
        assert alike(turn.of(command), other_command), seed
        assert alike(turn.of(after), other_after), seed
