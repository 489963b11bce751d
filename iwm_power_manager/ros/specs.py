# SPDX-License-Identifier: Apache-2.0
"""What is known of a node's parameters, without ROS: for `--help` and documentation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from iwm_power_manager.control.settings import Change
from iwm_power_manager.errors import IwmError, did_you_mean, spelled_like

Value = bool | int | float | str | list[str] | list[float]


class ParameterError(IwmError):
    """A parameter given at start is wrong."""


class Spec(NamedTuple):
    """One parameter.

    Attributes
    ----------
    name : dotted name
    default : its type is the parameter's type
    description : one sentence, with the unit where there is one
    low, high : range of a number; of a list of numbers, of each element
    choices : allowed texts
    length : exact length of a list, whose texts have to differ; 0 for any length
    change : when it may change
    """

    name: str
    default: Value
    description: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    length: int = 0
    change: Change = Change.UNCONFIGURED

    @property
    def holds_texts(self) -> bool:
        """The parameter is a list of texts."""
        return isinstance(self.default, list) and isinstance(self.default[0], str)

    def allowed(self) -> str:
        """What the value may be, for messages and documentation."""
        if self.choices:
            return " | ".join(self.choices)
        if isinstance(self.default, bool):
            return "true | false"
        if self.holds_texts:
            return f"{self.length} different names" if self.length else "a list of texts"
        if isinstance(self.default, list):
            return f"{self.length or 'any number of'} numbers from {self.low:g} to {self.high:g}"
        return "text" if isinstance(self.default, str) else f"{self.low:g} to {self.high:g}"

    def problem(self, value: Any) -> str:
        """What is wrong with a value of the right type; "" if nothing is."""
        # Ranges are written so that NaN, which rclpy's own range check lets through, is refused.
        if self.choices:
            wrong = value not in self.choices
        elif isinstance(self.default, bool | str):
            wrong = False
        elif not isinstance(self.default, list):
            wrong = not self.low <= value <= self.high
        elif self.length and len(value) != self.length:
            wrong = True
        elif self.holds_texts:
            wrong = self.length > 0 and not (all(value) and len(set(value)) == self.length)
        else:
            wrong = not all(self.low <= item <= self.high for item in value)
        near = did_you_mean(spelled_like(str(value), self.choices))
        return f"{self.name}: {value!r} is not allowed; allowed: {self.allowed()}{near}" if wrong else ""
