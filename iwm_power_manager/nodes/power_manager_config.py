# SPDX-License-Identifier: Apache-2.0
"""Parameters of the power manager, and what the node builds from their values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from iwm_power_manager.control import settings, thresholds
from iwm_power_manager.control.monitor import BATTERY
from iwm_power_manager.control.settings import Change
from iwm_power_manager.control.supervision import STALE_NAMES
from iwm_power_manager.ros.specs import Spec
from iwm_power_manager.signals import contract
from iwm_power_manager.signals.mapping import DEFAULT_MAPPING

#: Values of `friction_source` beside "parameter".
ESTIMATED, TOPIC = "estimated", "topic"


def _specs(table: Mapping[str, settings.Setting], defaults: Mapping[str, Any], about: str = "") -> list[Spec]:
    """A parameter for each row of one of the law's tables."""
    specs = []
    for name, known in table.items():
        sentence = about + known.described()
        specs.append(
            Spec(
                name,
                next((text for text, code in known.choices.items() if code == defaults[name]), defaults[name]),
                f"{sentence[0].upper()}{sentence[1:]}.",
                known.low,
                known.high,
                choices=tuple(known.choices),
                change=known.change,
            )
        )
    return specs


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
    Spec(
        "lock_parameters",
        False,
        "While active, refuse every change of a parameter: whoever is on the domain could make it.",
        change=Change.NEVER,
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
        list(contract.WHEEL_NAMES),
        "Names of the wheels in JointState messages, in the order front left, front right, rear left, rear right.",
        length=4,
    ),
    *_specs(settings.TABLE, settings.DEFAULTS._asdict(), "Control law: "),
    Spec(
        "friction",
        0.9,
        "Peak friction coefficient the strategy assumes, with friction_source parameter.",
        0.05,
        1.5,
        change=Change.ALWAYS,
    ),
    Spec(
        "friction_source",
        ESTIMATED,
        "Where the friction that the strategy assumes comes from: estimated from slip and road force; topic "
        "(road_friction, and the parameter when that is stale); parameter.",
        choices=(ESTIMATED, TOPIC, "parameter"),
        change=Change.ALWAYS,
    ),
    Spec("friction_timeout_s", 2.0, "Age at which road_friction is stale, s.", 0.01, 3600.0, change=Change.ALWAYS),
    Spec("missed_periods", 3, "Periods without a good message after which an input is missing.", 1, 100),
    *(
        Spec(f"input_period_s.{name}", 0.1 if name == BATTERY else 0.01, f"Period of {name}, s.", 0.0005, 10.0)
        for name in STALE_NAMES.values()
    ),
    *_specs(thresholds.TABLE, dataclasses.asdict(thresholds.Thresholds())),
    Spec(
        "clock_stopped_s",
        0.5,
        "Sim time that stands still for this long of real time commands zero torque, s.",
        0.05,
        60.0,
    ),
    *(
        Spec(name, at, f"{what} above which diagnostics {do}, {unit}.", low, high, change=Change.ALWAYS)
        for name, at, what, do, unit, low, high in (
            ("execution_warn_us", 1000.0, "Execution time of a step", "warn", "us", 1.0, 1e6),
            ("execution_error_us", 2000.0, "Execution time of a step", "report an error", "us", 1.0, 1e6),
            ("periodicity_warn_hz", 5.0, "Deviation of the mean rate", "warn", "Hz", 0.1, 1000.0),
            ("periodicity_error_hz", 10.0, "Deviation of the mean rate", "report an error", "Hz", 0.1, 1000.0),
        )
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
    speed, wheels, demand, battery = (periods * values[f"input_period_s.{name}"] for name in STALE_NAMES.values())
    return speed, wheels, demand, battery


def thresholds_of(values: Mapping[str, Any]) -> thresholds.Thresholds:
    """What inputs are believed, and how the degraded state goes."""
    return thresholds.Thresholds(**{name: values[name] for name in thresholds.TABLE})
