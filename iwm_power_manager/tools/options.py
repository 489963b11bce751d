# SPDX-License-Identifier: Apache-2.0
"""Command-line values with a range, as every command takes them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from iwm_power_manager.control import settings as law_settings
from iwm_power_manager.errors import ConfigError

#: An option that takes several values, however they are given: `--cycle A B` or `--cycle A --cycle B`. Nothing is [].
several: Any = {"action": "extend", "nargs": "+", "default": []}


def number(low: float, high: float) -> Callable[[str], float]:
    """Argument type of a number in a range."""
    return _in_range(float, "number", low, high)


def whole(low: int, high: int) -> Callable[[str], int]:
    """Argument type of an integer in a range."""
    return _in_range(int, "integer", low, high)


def _in_range[N: (int, float)](kind: Callable[[str], N], name: str, low: N, high: N) -> Callable[[str], N]:
    allowed = f"allowed: {low:.10g} to {high:.10g}"

    def parsed(text: str) -> N:
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"'{text}' is no {name}; {allowed}") from None
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is out of range; {allowed}")
        return value

    return parsed


def add_setting(group: argparse._ActionsContainer, name: str) -> None:
    """Add the option of a setting of the law, made from the law's own table."""
    known, default = law_settings.TABLE[name], getattr(law_settings.DEFAULTS, name)
    option = "--" + name.removesuffix("_w").removesuffix("_s").replace("_", "-")
    help_text = f"{known.described()} (default: {law_settings.shown(name, default)})"
    if isinstance(default, bool):
        group.add_argument(option, action=argparse.BooleanOptionalAction, default=default, help=known.meaning)
        return

    def value(text: str) -> Any:
        try:
            return law_settings.parse(option, name, text)
        except ConfigError as error:
            raise argparse.ArgumentTypeError(f"{error.problem}; allowed: {error.allowed}") from None

    metavar = "NAME" if known.choices else known.unit.upper() or "X"
    group.add_argument(option, dest=name, type=value, default=default, metavar=metavar, help=help_text)
