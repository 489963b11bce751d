"""Parameters of the power manager, and what the node builds from their values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from iwm_power_manager.control import settings
from iwm_power_manager.control.inputs import StampLimits, ValueLimits, WheelLimits
from iwm_power_manager.control.monitor import InputLimits
from iwm_power_manager.control.settings import Change
from iwm_power_manager.control.supervision import SupervisionLimits
from iwm_power_manager.ros import messages
from iwm_power_manager.ros.parameters import Spec, yaml_text
from iwm_power_manager.signals.mapping import DEFAULT_MAPPING

_INF = float("inf")


def _law_specs() -> list[Spec]:
    """A parameter for each setting of the control law."""
    return [
        Spec(
            name,
            settings.shown(name, getattr(settings.DEFAULTS, name)),
            f"Control law: {known.described()}.",
            known.low,
            known.high,
            choices=tuple(known.choices),
            change=known.change,
        )
        for name, known in settings.TABLE.items()
    ]


SPECS = (
    Spec(
        "vehicle_file", "config/vehicles/jalalmaab_2015.yaml", "Vehicle YAML: path, or name among the package's files."
    ),
    Spec(
        "idle_drive", "", "Overrides the vehicle's idle_drive; empty keeps it.", choices=("", "none", "drag", "enabled")
    ),
    Spec("policy_file", "policies", "Policy file, or folder with a bank of policies over friction; '' for none."),
    Spec(
        "rule",
        [0.0, 0.5, 0.0, 0.5],
        "Coefficients a, b, c, d of strategy rule: P_front = a + b * P_demand driving, c + d * P_demand braking; W, 1.",
        -1e5,
        1e5,
        length=4,
    ),
    Spec(
        "signals_file",
        DEFAULT_MAPPING,
        "Signals YAML: which topic and field is which input, in which unit; path, or name among the package's files.",
    ),
    Spec(
        "fallback",
        "none",
        "What to do when the policy is missing, unreadable or made for another car: none refuses "
        "to configure, equal runs equal split.",
        choices=("none", "equal"),
    ),
    Spec("autostart", True, "Configure and activate at start, without a lifecycle manager.", change=Change.NEVER),
    Spec(
        "lockstep",
        False,
        "One step for each set of inputs instead of a fixed rate (simulation only).",
        change=Change.NEVER,
    ),
    Spec("rate_hz", 100.0, "Control rate, Hz.", 10.0, 1000.0),
    Spec(
        "wheel_names",
        list(messages.WHEEL_NAMES),
        "Names of the wheels in JointState messages, in the order front left, front right, rear left, rear right.",
        length=4,
    ),
    *_law_specs(),
    Spec("friction", 0.9, "Peak friction coefficient the strategy assumes.", 0.05, 1.5, change=Change.ALWAYS),
    Spec(
        "friction_source",
        "parameter",
        "Where the friction comes from; road_friction falls back to the parameter when its topic is stale.",
        choices=("parameter", "road_friction"),
        change=Change.ALWAYS,
    ),
    Spec("friction_timeout_s", 2.0, "Age at which road_friction is stale, s.", 0.01, 3600.0, change=Change.ALWAYS),
    Spec("missed_periods", 3, "Periods without a good message after which an input is missing.", 1, 100),
    Spec("input_period_s.vehicle_speed", 0.01, "Period of vehicle_speed, s.", 0.0005, 10.0),
    Spec("input_period_s.wheel_states", 0.01, "Period of wheel_states, s.", 0.0005, 10.0),
    Spec("input_period_s.power_demand", 0.01, "Period of power_demand, s.", 0.0005, 10.0),
    Spec("input_period_s.battery_state", 0.1, "Period of battery_state, s.", 0.0005, 10.0),
    Spec("stamp_oldest_s", 0.1, "A message stamped longer ago than this is dropped, s.", 0.001, 60.0),
    Spec("stamp_future_s", 0.02, "A message stamped further ahead than this is dropped, s.", 0.0, 60.0),
    Spec("speed_max_mps", 60.0, "Largest believed vehicle speed, m/s.", 1.0, 150.0),
    Spec("speed_rate_mps2", 25.0, "Largest believed change of vehicle speed, m/s2.", 1.0, 1000.0),
    Spec("wheel_speed_max_radps", 300.0, "Largest believed wheel speed, rad/s.", 1.0, 2000.0),
    Spec("wheel_rate_radps2", 2000.0, "Largest believed change of a wheel speed, rad/s2.", 1.0, 1e5),
    Spec(
        "wheel_stuck_s",
        1.0,
        "A wheel speed that stays the same for longer while the car and the axle's other wheel change is stuck, s.",
        0.05,
        60.0,
    ),
    Spec(
        "wheel_stray_s",
        1.0,
        "A wheel speed far from both the axle's other wheel and the car for longer is lost, s.",
        0.05,
        60.0,
    ),
    Spec("wheel_stray_radps", 20.0, "How far is far, rad/s.", 1.0, 500.0),
    Spec("wheel_distrust_s", 0.5, "A lost wheel has to be good for this long before it is used again, s.", 0.0, 60.0),
    Spec("demand_max_w", 150e3, "Largest believed driving demand, W.", 100.0, 5e6),
    Spec("demand_min_w", -600e3, "Largest believed braking demand, W, negative.", -2e7, -100.0),
    Spec(
        "demand_rise_wps",
        5e6,
        "Largest believed rise of the demand, W/s; braking may come as fast as it likes.",
        1e3,
        1e9,
    ),
    Spec("fade_s", 0.3, "An input is missing: motor torque fades to zero in this time, s.", 0.01, 10.0),
    Spec(
        "brake_release_s",
        2.0,
        "power_demand is missing while braking: the braking force is released in this time, s.",
        0.01,
        30.0,
    ),
    Spec("recover_s", 0.5, "Inputs have to be good for this long before torque comes back, s.", 0.0, 60.0),
    Spec("resume_s", 0.5, "Torque comes back from zero to full in this time, s.", 0.01, 60.0),
    Spec(
        "clock_stopped_s",
        0.5,
        "Sim time that stands still for this long of real time commands zero torque, s.",
        0.05,
        60.0,
    ),
    Spec(
        "execution_warn_us",
        1000.0,
        "Execution time of a step above which diagnostics warn, us.",
        1.0,
        1e6,
        change=Change.ALWAYS,
    ),
    Spec(
        "execution_error_us",
        2000.0,
        "Execution time of a step above which diagnostics report an error, us.",
        1.0,
        1e6,
        change=Change.ALWAYS,
    ),
    Spec(
        "periodicity_warn_hz",
        5.0,
        "Deviation of the mean rate above which diagnostics warn, Hz.",
        0.1,
        1000.0,
        change=Change.ALWAYS,
    ),
    Spec(
        "periodicity_error_hz",
        10.0,
        "Deviation of the mean rate above which diagnostics report an error, Hz.",
        0.1,
        1000.0,
        change=Change.ALWAYS,
    ),
    Spec(
        "gc_off_path",
        True,
        "Freeze what exists after configuring and collect garbage once a second after a step, never inside one.",
        change=Change.NEVER,
    ),
    Spec(
        "demand_log",
        "",
        "File that counts the driver's demand for solve_policy --transitions; it goes on from one that exists; '' for "
        "none.",
    ),
    Spec(
        "demand_log_period_s",
        300.0,
        "The counts are written this often, and when commanding ends, s.",
        1.0,
        86400.0,
    ),
    Spec(
        "realtime_priority",
        0,
        "SCHED_FIFO priority of the control thread, and one less for those of DDS; 0 keeps the normal scheduler.",
        0,
        99,
        change=Change.NEVER,
    ),
    Spec(
        "cpu_affinity", "", "Processors the node may run on, such as '1' or '0,2'; empty is all.", change=Change.NEVER
    ),
    Spec("lock_memory", False, "Lock all memory (mlockall).", change=Change.NEVER),
)

BY_NAME = {spec.name: spec for spec in SPECS}
DEFAULTS: dict[str, Any] = {spec.name: spec.default for spec in SPECS}


def check_together(values: Mapping[str, Any]) -> str:
    """What is wrong with values that are right one by one; "" if nothing is."""
    for small, large in (
        *settings.ORDERED,
        ("execution_warn_us", "execution_error_us"),
        ("periodicity_warn_hz", "periodicity_error_hz"),
    ):
        if values[small] > values[large]:
            return f"{small}: {values[small]:g} is not allowed; allowed: at most {large} = {values[large]:g}"
    return ""


def law_settings(values: Mapping[str, Any], strategy: str) -> settings.Settings:
    """The law's settings."""
    return settings.Settings(**settings.from_shown({**values, "strategy": strategy}))


def age_limits_s(values: Mapping[str, Any]) -> tuple[float, float, float, float]:
    """Ages at which speed, wheels, demand and battery are missing."""
    periods = values["missed_periods"]
    return (
        periods * values["input_period_s.vehicle_speed"],
        periods * values["input_period_s.wheel_states"],
        periods * values["input_period_s.power_demand"],
        periods * values["input_period_s.battery_state"],
    )


def supervision_limits(values: Mapping[str, Any]) -> SupervisionLimits:
    """Times of the degraded state."""
    return SupervisionLimits(values["fade_s"], values["brake_release_s"], values["recover_s"], values["resume_s"])


def input_limits(values: Mapping[str, Any], radius_m: float) -> InputLimits:
    """What inputs are judged by."""
    wheel_rate = values["wheel_rate_radps2"]
    speed_rate = values["speed_rate_mps2"]
    return InputLimits(
        stamp=None if values["lockstep"] else StampLimits(values["stamp_oldest_s"], values["stamp_future_s"]),
        demand_delay_s=_INF if values["lockstep"] else values["stamp_oldest_s"],
        speed=ValueLimits(-1.0, values["speed_max_mps"], speed_rate, speed_rate, 0.6),
        demand=ValueLimits(values["demand_min_w"], values["demand_max_w"], values["demand_rise_wps"], _INF, 5e3),
        soc=ValueLimits(0.0, 1.0, 0.01, 0.01, 0.02),
        temperature=ValueLimits(-60.0, 150.0, 2.0, 2.0, 3.0),
        friction=ValueLimits(0.05, 1.5, _INF, _INF, 0.0),
        wheels=WheelLimits(
            value=ValueLimits(
                -values["wheel_speed_max_radps"], values["wheel_speed_max_radps"], wheel_rate, wheel_rate, 3.0
            ),
            opposite_radps=3.0,
            moving_mps=1.0,
            stuck_s=values["wheel_stuck_s"],
            stuck_change_radps=1.0,
            stray_s=values["wheel_stray_s"],
            stray_radps=values["wheel_stray_radps"],
            distrust_s=values["wheel_distrust_s"],
        ),
        radius_m=radius_m,
    )


def parameter_file() -> str:
    """Content of `config/nodes/power_manager.yaml`."""
    return yaml_text(
        "power_manager",
        SPECS,
        "Parameters of the power manager, all of them, with their defaults. Ranges: docs/interface.md, or "
        "`ros2 param describe`. Written by scripts/update_interface.",
    )
