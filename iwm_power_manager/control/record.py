# SPDX-License-Identifier: Apache-2.0
"""One control step as a flat list of named numbers: what `power_manager/state` carries and a replay reads.

It holds everything the law took (measurement and settings) and decided, and why. A replay that feeds the recorded
measurement and settings to the law again, starting from the initial state wherever `step` is 0, gets the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import batched
from typing import Any, NamedTuple, get_type_hints

from iwm_power_manager.control.settings import DEFAULTS, Settings
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.supervision import Supervision
from iwm_power_manager.control.types import WHEEL_NAMES, Command, ControllerState, Measurement

_SETTING = "setting."


class Signal(NamedTuple):
    """One named number: its name, which ends in its unit, and what it means."""

    name: str
    meaning: str


_MEASUREMENT = (
    Signal("speed_mps", "vehicle speed the law used"),
    *(
        Signal(f"{wheel}_speed_radps", "wheel speed the law used; a lost wheel has its axle partner's")
        for wheel in WHEEL_NAMES
    ),
    Signal("power_demand_w", "power demand the law used: after the ramps of the degraded state"),
    Signal("dt_s", "time since the previous step"),
    Signal("friction", "peak friction coefficient the strategy assumed"),
    Signal("discharge_limit_w", "electrical power the battery may give"),
    Signal("charge_limit_w", "electrical power the battery may take"),
    Signal("soc", "state of charge, 0..1"),
    *(Signal(f"{wheel}_motor_gain", "part of a commanded torque the motor delivers, 0..1") for wheel in WHEEL_NAMES),
    Signal("direction", "direction the driver asks for: 1 forwards, -1 reverse"),
    *(Signal(f"{wheel}_motor_stuck_nm", "torque the motor has whatever it is commanded") for wheel in WHEEL_NAMES),
    Signal("acceleration_mps2", "forward, of an accelerometer, the slope's part included"),
    Signal("accelerometer", "1 where there is one, 0 where not"),
    Signal("yaw_rate_radps", "of a gyroscope, positive to the left"),
    Signal("gyroscope", "1 where there is one, 0 where not"),
    Signal("lateral_mps2", "of an accelerometer, positive to the left"),
    Signal("lateral_accelerometer", "1 where there is one, 0 where not"),
    *(
        Signal(f"{wheel}_torque_shift_nm", "torque while its speed changed, less the last command's (0 in lock-step)")
        for wheel in WHEEL_NAMES
    ),
)
_COMMAND = (
    *(Signal(f"{wheel}_motor_torque_nm", "commanded motor torque") for wheel in WHEEL_NAMES),
    *(Signal(f"{wheel}_friction_torque_nm", "commanded friction brake torque, <= 0") for wheel in WHEEL_NAMES),
    *(
        Signal(f"{wheel}_brake_gain", "part of its friction torque a brake seems to give, 0..1")
        for wheel in WHEEL_NAMES
    ),
    Signal("front_share", "front axle's part of the power demand as applied, 0..1"),
    Signal("decided_share", "front share the strategy decided on, 0..1"),
    Signal("gate", "axles held at zero torque: 0 none, 1 front, 2 rear, 3 both"),
    Signal(
        "limits",
        "bits of the limits that bind: 1 motor, 2 regeneration, 4 battery discharge, 8 battery charge, "
        "16 thermal, 32 slew, 64 slip limiter, 128 friction brake",
    ),
    Signal("front_power_w", "power of the front axle's command"),
    Signal("rear_power_w", "power of the rear axle's command"),
    Signal("front_slip", "filtered slip of the front axle"),
    Signal("rear_slip", "filtered slip of the rear axle"),
    Signal("gated_wheels", "bits of the wheels held at zero torque: 1, 2, 4, 8 in the order of the wheels"),
    Signal("estimated_speed_mps", "speed of the car as estimated, negative backwards"),
    Signal("doubted", "bits of the sensors that are not believed: 1, 2, 4, 8 the wheels, 16 vehicle_speed"),
    Signal("hold_nm", "friction torque of each wheel that holds the car on a slope"),
    Signal("left_friction", "peak friction of the road under the left wheels, as estimated"),
    Signal("right_friction", "peak friction of the road under the right wheels, as estimated"),
    Signal("left_friction_confidence", "how well it is known: 0 is the prior, 1 is felt"),
    Signal("right_friction_confidence", "how well it is known: 0 is the prior, 1 is felt"),
)
_CONTROLLER = (
    Signal("step", "steps since the law's initial state; 0 is the first"),
    Signal("front_heat", "heat index of the hotter front motor, 0 cold to 1 hot"),
    Signal("rear_heat", "heat index of the hotter rear motor, 0 cold to 1 hot"),
)
_SUPERVISION = (
    Signal("mode", "0 waiting, 1 normal, 2 degraded, 3 recovering"),
    Signal("stale", "bits of the missing inputs: 1 vehicle_speed, 2 wheel_states, 4 power_demand, 8 battery_state"),
    Signal("motor_factor", "part of the motor torque that is allowed, 0..1"),
    Signal("brake_factor", "part of a stale braking force that is still held, 0..1"),
    Signal("wheels_lost", "bits of the wheels that are not believed: 1, 2, 4, 8 in the order of the wheels"),
    Signal("requested_power_w", "last accepted power demand, before the ramps"),
    Signal("vehicle_speed_age_s", "age of the speed"),
    Signal("wheel_states_age_s", "age of the wheel speeds"),
    Signal("power_demand_age_s", "age of the power demand"),
    Signal("battery_state_age_s", "age of the battery's state"),
)
_SETTING_TYPES = tuple(map(type, DEFAULTS))
_SETTINGS = tuple(Signal(_SETTING + name, "the law's setting of that name") for name in Settings._fields)

#: All signals, in the order in which they are published.
SIGNALS = (*_MEASUREMENT, *_COMMAND, *_CONTROLLER, *_SUPERVISION, *_SETTINGS)
SIGNAL_NAMES = [signal.name for signal in SIGNALS]
_STEP = SIGNAL_NAMES.index("step")


class Watch(NamedTuple):
    """What the node knows beside the law's own numbers.

    Attributes
    ----------
    wheels_lost : bits of the wheels that are not believed
    requested_power_w : power demand before the ramps
    age_s : ages of speed, wheels, demand, battery
    """

    wheels_lost: int
    requested_power_w: float
    age_s: tuple[float, float, float, float]


def to_numbers(
    measurement: Measurement,
    settings: Settings,
    decided: Sequence[float],
    supervision: Supervision,
    watch: Watch,
) -> list[float]:
    """Values of `SIGNALS` for one step; `decided` those of `DECIDED_NAMES`."""
    return [
        measurement.speed_mps,
        *measurement.wheel_speed_radps,
        *measurement[2:8],
        *measurement.motor_gain,
        measurement.direction,
        *measurement.motor_stuck_nm,
        0.0 if math.isnan(measurement.acceleration_mps2) else measurement.acceleration_mps2,
        0.0 if math.isnan(measurement.acceleration_mps2) else 1.0,
        0.0 if math.isnan(measurement.yaw_rate_radps) else measurement.yaw_rate_radps,
        0.0 if math.isnan(measurement.yaw_rate_radps) else 1.0,
        0.0 if math.isnan(measurement.lateral_mps2) else measurement.lateral_mps2,
        0.0 if math.isnan(measurement.lateral_mps2) else 1.0,
        *measurement.torque_shift_nm,
        *decided,
        *supervision[:4],
        watch.wheels_lost,
        watch.requested_power_w,
        *watch.age_s,
        *settings,
    ]


#: What a record that is older than a signal would have said.
YOUNGER_SIGNALS = (
    {"gated_wheels": 0.0, "doubted": 0.0, "hold_nm": 0.0, "direction": 1.0}
    | {"acceleration_mps2": 0.0, "accelerometer": 0.0, "yaw_rate_radps": 0.0, "gyroscope": 0.0}
    | {"lateral_mps2": 0.0, "lateral_accelerometer": 0.0}
    | {f"{wheel}_brake_gain": 1.0 for wheel in WHEEL_NAMES}
    | {f"{wheel}_motor_gain": 1.0 for wheel in WHEEL_NAMES}
    | {f"{wheel}_motor_stuck_nm": 0.0 for wheel in WHEEL_NAMES}
    | {f"{wheel}_torque_shift_nm": 0.0 for wheel in WHEEL_NAMES}
    | {"left_friction": 0.0, "right_friction": 0.0, "left_friction_confidence": 0.0, "right_friction_confidence": 0.0}
)
_YOUNGER = YOUNGER_SIGNALS | {_SETTING + name: float(value) for name, value in DEFAULTS._asdict().items()}

#: The signals the law decides.
DECIDED_NAMES = tuple(signal.name for signal in (*_COMMAND, *_CONTROLLER))
#: Where they stand among `SIGNALS`, and where the settings do.
DECIDED = slice(len(_MEASUREMENT), len(_MEASUREMENT) + len(DECIDED_NAMES))
SETTINGS = slice(len(SIGNALS) - len(_SETTINGS), len(SIGNALS))
_COMMAND_TYPES = tuple(get_type_hints(Command).values())[3:]
#: No number of a record that counts something is larger: beyond, a double has no integers.
_LARGEST_COUNT = 2.0**53


def decided(command: Command, before: ControllerState, after: ControllerState) -> tuple[float, ...]:
    """Values of `DECIDED_NAMES`."""
    motor, friction, brakes = command.motor_torque_nm, command.friction_torque_nm, command.brake_gain
    wheels = after.wheels
    return (
        motor[0],
        motor[1],
        motor[2],
        motor[3],
        friction[0],
        friction[1],
        friction[2],
        friction[3],
        brakes[0],
        brakes[1],
        brakes[2],
        brakes[3],
        command.front_share,
        command.decided_share,
        float(command.gate),
        float(command.limits),
        command.front_power_w,
        command.rear_power_w,
        command.front_slip,
        command.rear_slip,
        float(command.gated_wheels),
        command.speed_mps,
        float(command.doubted),
        command.hold_nm,
        command.left_friction,
        command.right_friction,
        command.left_confidence,
        command.right_confidence,
        float(before.steps),
        max(wheels[0].heat, wheels[1].heat),
        max(wheels[2].heat, wheels[3].heat),
    )


def command_of(numbers: Sequence[float]) -> Command:
    """The command among values of `DECIDED_NAMES`."""
    motor, friction, brakes = ((a, b, c, d) for a, b, c, d in batched(numbers[:12], 4))
    rest: list[Any] = [kind(value) for kind, value in zip(_COMMAND_TYPES, numbers[12 : len(_COMMAND)], strict=True)]
    return Command(motor, friction, brakes, *rest)


def measurement_of(numbers: Sequence[float]) -> Measurement:
    """The measurement among values of `SIGNALS`."""
    n = numbers
    return Measurement(
        speed_mps=n[0],
        wheel_speed_radps=(n[1], n[2], n[3], n[4]),
        power_demand_w=n[5],
        dt_s=n[6],
        friction=n[7],
        discharge_limit_w=n[8],
        charge_limit_w=n[9],
        soc=n[10],
        motor_gain=(n[11], n[12], n[13], n[14]),
        direction=n[15],
        motor_stuck_nm=(n[16], n[17], n[18], n[19]),
        acceleration_mps2=n[20] if n[21] else math.nan,
        yaw_rate_radps=n[22] if n[23] else math.nan,
        lateral_mps2=n[24] if n[25] else math.nan,
        torque_shift_nm=(n[26], n[27], n[28], n[29]),
    )


def completed(names: Sequence[str], values: Sequence[float]) -> Sequence[float]:
    """A record's values in the order of `SIGNALS`; a signal or a setting that is younger than it has its default.

    Raises
    ------
    KeyError
        A signal is missing: the record was not made by this project, or by another version of it.
    ValueError
        There are more names than values, or fewer.
    """
    if list(names) == SIGNAL_NAMES:
        return values
    known = _YOUNGER | dict(zip(names, values, strict=True))
    return [known[name] for name in SIGNAL_NAMES]


def step_of(numbers: Sequence[float]) -> int:
    """Steps of the run before this one; `ValueError` if that is no number of steps."""
    return int(_typed(int, numbers[_STEP]))


class RecordedStep(NamedTuple):
    """What a replay needs of a recorded step."""

    first: bool
    measurement: Measurement
    settings: Settings


def from_numbers(numbers: Sequence[float]) -> RecordedStep:
    """The inverse of `to_numbers`, as far as the law's inputs go.

    Raises
    ------
    ValueError
        What counts something, or chooses, is no such number.
    """
    # Integers and flags travel as numbers; the law has to get back the types it was compiled for.
    settings = Settings(*(_typed(kind, value) for kind, value in zip(_SETTING_TYPES, numbers[SETTINGS], strict=True)))
    if all(strategy.code != settings.strategy for strategy in STRATEGIES.values()):
        raise ValueError(f"strategy {settings.strategy} does not exist")
    return RecordedStep(numbers[_STEP] == 0.0, measurement_of(numbers), settings)


def _typed(kind: type[Any], value: float) -> Any:
    if kind is not float and not 0.0 <= value < _LARGEST_COUNT:  # written so that NaN is refused
        raise ValueError(f"{value} counts nothing")
    return kind(value)
