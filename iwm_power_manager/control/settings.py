# SPDX-License-Identifier: Apache-2.0
"""The control law's settings: the one table of their names, defaults, ranges, units and meanings.

`Settings` is that table and the NamedTuple the kernels take. ROS parameters, command-line options, replay's `--set`,
parameter files and their documentation are made from it, and all of them judge a value by `problem_with`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, get_type_hints

from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES
from iwm_power_manager.errors import ConfigError

#: Gate modes: no skid avoidance; Table 2 as printed (on/off, braking only unless `gate_driving`); a slip limiter in
#: front of Table 2, which holds the wheel short of the critical slip so that the on/off gate is the last resort.
GATE_MODE_OFF, GATE_MODE_TABLE2, GATE_MODE_LIMITER = range(3)
GATE_MODES: dict[str, int] = {"off": GATE_MODE_OFF, "table2": GATE_MODE_TABLE2, "limiter": GATE_MODE_LIMITER}

_DRIVABLE = {name: strategy.code for name, strategy in STRATEGIES.items() if not strategy.knows_future}


class Change(enum.Enum):
    """When a value may change."""

    NEVER = "at start only"
    UNCONFIGURED = "while unconfigured"
    ALWAYS = "at any time"


class Setting(NamedTuple):
    """What is known of one value beside its name, its type and its default.

    Attributes
    ----------
    meaning : half a sentence, without the unit
    unit : "" for a number without one, a flag or a choice
    low, high : inclusive range of a number
    choices : for a value that people give by name: its number by name
    change : when it may change
    """

    meaning: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: Mapping[str, int] = {}
    change: Change = Change.ALWAYS

    def described(self) -> str:
        """Meaning and unit."""
        return f"{self.meaning}, {self.unit}" if self.unit else self.meaning

    @property
    def is_flag(self) -> bool:
        """It is true or false."""
        return not self.choices and math.isinf(self.low) and math.isinf(self.high)

    def allowed(self) -> str:
        """What a value may be, for messages and documentation."""
        if self.choices:
            return " | ".join(self.choices)
        return "true | false" if self.is_flag else f"{self.low:g} to {self.high:g}"


class Settings(NamedTuple):
    """Tuning of the law: each with its type, what is known of it, and its default with the reason for it."""

    strategy: Annotated[int, Setting("strategy that splits the demand between the axles", choices=_DRIVABLE)] = (
        STRATEGIES[DEFAULT_STRATEGY].code
    )
    # A change of demand met 0.1 s late costs more than a tenth of the possible saving.
    decision_period_s: Annotated[float, Setting("the split is decided this often", "s", 0.001, 10.0)] = 0.02
    # All the power changes axle in 0.05 s; the sum of the torques stays, so nothing is felt.
    share_rate_per_s: Annotated[float, Setting("fastest change of the applied front share", "1/s", 0.01, 1000.0)] = 20.0
    gate_mode: Annotated[
        int,
        Setting(
            "skid avoidance: off, table2 (on/off gate of the paper), limiter (holds the wheel short of the critical "
            "slip, the gate is the last resort)",
            choices=GATE_MODES,
        ),
    ] = GATE_MODE_LIMITER
    critical_slip: Annotated[float, Setting("slip beyond which an axle is gated (Table 2)", "", 0.02, 0.9)] = (
        0.2  # paper
    )
    gate_hysteresis: Annotated[
        float, Setting("a gated axle is freed when its slip is this far inside again", "", 0.0, 0.5)
    ] = 0.05
    gate_driving: Annotated[bool, Setting("also gate driving slip")] = True
    # 99.8 % of the peak friction of the paper's tyre, and a margin to the critical slip.
    slip_target: Annotated[float, Setting("slip the limiter holds, below critical_slip", "", 0.01, 0.9)] = 0.16
    # Two thirds of the peak friction, and as much to steer with.
    unequal_slip_target: Annotated[
        float,
        Setting(
            "slip the limiter holds, while left and right brake unequally, on the side with more grip", "", 0.01, 0.9
        ),
    ] = 0.06
    # Nearly all the braking, and half as much to steer with again as at slip_target.
    unequal_low_slip_target: Annotated[
        float, Setting("the same on the other side of the front axle", "", 0.01, 0.9)
    ] = 0.1
    # Nine tenths of the stiffness across: with less, a car on a split road turns round at high speed. Braked gently on
    # 0.2, from 10 to 35 m/s, a turn takes a second or more to grow by e with it; with slip_target, 0.3 to 0.6 s.
    unequal_rear_slip_target: Annotated[
        float,
        Setting(
            "the same on both rear wheels; from yaw_speed_mps up, and below with one over the speed, also what they "
            "may slip while the front ones slip less",
            "",
            0.01,
            0.9,
        ),
    ] = 0.03
    # Stops within 5 % of the shortest way at every friction; faster shakes the car more.
    slip_limiter_s: Annotated[float, Setting("time constant of the slip limiter", "s", 0.001, 1.0)] = 0.025
    slip_filter_s: Annotated[
        float, Setting("low-pass filter of the slip and of the estimated road torque; 0 is none", "s", 0.0, 1.0)
    ] = 0.0
    # Measured slip says nothing at rest.
    slip_speed_floor_mps: Annotated[float, Setting("denominator of slip is at least this", "m/s", 0.01, 10.0)] = 1.0
    # Left and right at unequal torques turn the car. At once only as much as a driver hardly feels; then it grows at
    # the rate at which he can steer against it.
    front_yaw_nm: Annotated[
        float, Setting("yaw moment that unequal torques of the front wheels may have at once", "N m", 0.0, 1e5)
    ] = 50.0
    yaw_speed_mps: Annotated[
        float,
        Setting(
            "speed at which the yaw budgets are what they say; they go with one over its square", "m/s", 1.0, 100.0
        ),
    ] = 20.0
    front_yaw_growth_nmps: Annotated[float, Setting("growth of it while it is used", "N m/s", 0.0, 1e6)] = 150.0
    front_yaw_most_nm: Annotated[float, Setting("what it grows to", "N m", 0.0, 1e5)] = 600.0
    # A driver half as fast again as most keeps his lane with it.
    yaw_rate_growth_nmps: Annotated[
        float,
        Setting(
            "further growth, up to 1500 N m, while a yaw rate shows that the car hardly turns; 0: none is used",
            "N m/s",
            0.0,
            1e6,
        ),
    ] = 600.0
    # The rear wheels keep the car straight: both get what the one with less grip can take (select-low).
    rear_yaw_nm: Annotated[
        float,
        Setting(
            "yaw moment that unequal torques of the rear wheels may have at once; 0 is select-low", "N m", 0.0, 1e5
        ),
    ] = 0.0
    rear_yaw_growth_nmps: Annotated[float, Setting("growth of it while it is used", "N m/s", 0.0, 1e6)] = 0.0
    rear_yaw_most_nm: Annotated[float, Setting("what it grows to", "N m", 0.0, 1e5)] = 0.0
    # Dry asphalt: where nothing is felt of the road, nothing is near its limit, and on a road of less the first wheels
    # to slip tell it within a tenth of a second.
    friction_prior: Annotated[
        float, Setting("peak friction of a road of which nothing is known yet, or any more", "", 0.05, 1.5)
    ] = 0.9
    # A mile of town.
    friction_memory_s: Annotated[
        float, Setting("time over which rolling wheels are listened to for the friction", "s", 0.5, 600.0)
    ] = 10.0
    friction_return_s: Annotated[
        float, Setting("time in which an estimated friction goes back to the prior", "s", 1.0, 3600.0)
    ] = 60.0
    # From ice to asphalt in 0.35 s; one wrong point of a slipping wheel raises it by 0.02.
    friction_rise_per_s: Annotated[float, Setting("fastest growth of the estimated friction", "1/s", 0.01, 100.0)] = 2.0
    reverse_speed_mps: Annotated[float, Setting("fastest reverse the motors drive to", "m/s", 0.5, 20.0)] = 5.0
    # From rest to the peak torque in 0.125 s; from there to zero in one step of 10 ms (gates and limits may be faster);
    # to full regeneration in 0.02 s.
    slew_up_nmps: Annotated[float, Setting("fastest growth of a driving motor torque", "N m/s", 10.0, 1e6)] = 1600.0
    slew_down_nmps: Annotated[float, Setting("fastest way of a motor torque to zero", "N m/s", 100.0, 1e6)] = 20000.0
    slew_regeneration_nmps: Annotated[
        float, Setting("fastest growth of a regenerative torque; friction fills in", "N m/s", 10.0, 1e6)
    ] = 4000.0
    # At this price it changes the share about as often as sdp_lookahead does: its strongest rival at the same effort.
    switching_power_w: Annotated[
        float, Setting("instantaneous_slip: a change of the share has to save this much", "W", 0.0, 1e5)
    ] = 60.0


def table_of(values: type[Any]) -> dict[str, Setting]:
    """What is known of each value of such a NamedTuple, by name."""
    hints = get_type_hints(values, include_extras=True)
    return {name: hints[name].__metadata__[0] for name in values._fields}


#: What is known of each setting, by name.
TABLE = table_of(Settings)
DEFAULTS = Settings()
#: Settings whose values depend on each other: the first is at most the second.
ORDERED = (("slip_target", "critical_slip"), ("gate_hysteresis", "critical_slip"))


def default_settings(strategy: str = DEFAULT_STRATEGY) -> Settings:
    """Settings every tool and node starts from."""
    return DEFAULTS._replace(strategy=STRATEGIES[strategy].code)


def problem_with(setting: Setting, value: Any) -> str:
    """What is wrong with a value as people give it (a choice by its name); "" if nothing is."""
    if setting.choices:
        wrong = value not in setting.choices
    elif setting.is_flag:
        wrong = not isinstance(value, bool)
    else:
        # Written so that NaN is refused.
        wrong = isinstance(value, bool | str) or not setting.low <= value <= setting.high
    return f"{value!r} is not allowed; allowed: {setting.allowed()}" if wrong else ""


def shown(name: str, value: Any) -> Any:
    """A setting's value as people give it: a choice by its name."""
    return next((key for key, code in TABLE[name].choices.items() if code == value), value)


def as_shown(settings: Settings) -> dict[str, Any]:
    """All settings by name, choices by theirs."""
    return {name: shown(name, value) for name, value in settings._asdict().items()}


def from_shown(values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `values` that are settings, choices given by name, as `Settings` takes them."""
    return {
        name: TABLE[name].choices[values[name]] if TABLE[name].choices else type(getattr(DEFAULTS, name))(values[name])
        for name in Settings._fields
        if name in values
    }


def parse(source: str, name: str, text: str) -> Any:
    """Value of a setting given as text.

    Raises
    ------
    ConfigError
        There is no such setting, or it may not have that value.
    """
    if name not in TABLE:
        raise ConfigError(source, name, "is no setting of the law", ", ".join(TABLE))
    setting = TABLE[name]
    value: Any = text
    if setting.is_flag:
        value = {"true": True, "false": False}.get(text, text)
    elif not setting.choices:
        try:
            value = float(text)
        except ValueError:
            value = text
    if problem_with(setting, value):
        raise ConfigError(source, name, f"{text!r} is not allowed", setting.allowed())
    return setting.choices[text] if setting.choices else value


def check_together(values: Mapping[str, Any]) -> str:
    """What is wrong with values that are right one by one; "" if nothing is."""
    for small, large in ORDERED:
        if values[small] > values[large]:
            return f"{small}: {values[small]:g} is not allowed; allowed: at most {large} = {values[large]:g}"
    return ""
