# SPDX-License-Identifier: Apache-2.0
"""Parameters declared from one table: type, default, range, unit, description, and when each may change.

rclpy checks types and numeric ranges against the descriptors; what it cannot check (choices, NaN, lengths, the state of
the node) is checked here, when a parameter is set, so that a bad value never reaches the control loop. The table is
also what `docs/interface.md` is tested against.
"""

from __future__ import annotations

import difflib
import json
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from iwm_power_manager.control.settings import Change as Change  # part of this interface
from iwm_power_manager.errors import IwmError

Value = bool | int | float | str | list[str] | list[float]


_WIDTH = 118
#: Parameters that rclpy declares itself, some of them later.
_ROS_PREFIXES = ("qos_overrides.", "start_type_description_service", "use_sim_time")


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
        return f"{self.name}: {value!r} is not allowed; allowed: {self.allowed()}" if wrong else ""

    def descriptor(self) -> ParameterDescriptor:
        """What tools like `ros2 param describe` show, and what rclpy enforces."""
        descriptor = ParameterDescriptor(
            name=self.name,
            description=f"{self.description} Changes {self.change.value}.",
            additional_constraints=self.allowed() if self.choices or self.length else "",
            read_only=self.change is Change.NEVER,
        )
        if isinstance(self.default, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=self.low, to_value=self.high)]
        elif isinstance(self.default, int) and not isinstance(self.default, bool):
            descriptor.integer_range = [IntegerRange(from_value=int(self.low), to_value=int(self.high))]
        return descriptor


def declare(node: Node, specs: Sequence[Spec]) -> dict[str, Any]:
    """Declare all parameters and return their values at start.

    Raises
    ------
    ParameterError
        A parameter given at start does not exist, has the wrong type or a value that is not allowed.
    """
    values = {}
    for spec in specs:
        try:
            value = node.declare_parameter(spec.name, spec.default, spec.descriptor()).value
        except (InvalidParameterTypeException, InvalidParameterValueException, ParameterUninitializedException):
            given = node._parameter_overrides.get(spec.name)  # the exceptions do not all carry the value
            raise ParameterError(
                f"parameter {spec.name}: {given.value if given else None!r} is not allowed; "
                f"allowed: {spec.allowed()} ({_type_name(spec)})"
            ) from None
        problem = spec.problem(value)
        if problem:
            raise ParameterError(f"parameter {problem}")
        values[spec.name] = _plain(value)
    _refuse_unknown(node, specs)
    return values


def _refuse_unknown(node: Node, specs: Sequence[Spec]) -> None:
    """A parameter that has no effect was meant to have one: a node does not drive with half of what it was given."""
    known = [spec.name for spec in specs]
    for name in sorted(set(node._parameter_overrides) - set(known)):
        if not node.has_parameter(name) and not name.startswith(_ROS_PREFIXES):
            near = difflib.get_close_matches(name, known, 1)
            raise ParameterError(f"parameter {name} is unknown" + (f"; is {near[0]} meant?" if near else ""))


class KeepsItsValues:
    """Mixin of a node: a parameter that is set to the value it has is no change, even of one that may not change.

    So that a node can load what it has dumped, or a file that it was started with.
    """

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set what differs."""
        node: Any = super()
        new = [
            parameter
            for parameter in parameter_list
            if not (node.has_parameter(parameter.name) and _same(node.get_parameter(parameter.name), parameter))
        ]
        return node.set_parameters_atomically(new) if new else SetParametersResult(successful=True)


def _same(present: Parameter, new: Parameter) -> bool:
    return present.type_ == new.type_ and bool(_plain(present.value) == _plain(new.value))


def check_change(
    specs: Mapping[str, Spec],
    parameters: Sequence[Parameter],
    configured: bool,
    together: Callable[[dict[str, Any]], str] = lambda _: "",
) -> SetParametersResult:
    """Accept or refuse a change of parameters, as a callback of `add_on_set_parameters_callback` must.

    Parameters
    ----------
    specs : all parameters of the node by name
    parameters : the new ones
    configured : the node has left the unconfigured state
    together : says what is wrong with the new values taken together, "" if nothing is
    """
    new = {}
    for parameter in parameters:
        spec = specs.get(parameter.name)
        if spec is None:  # one of rclpy's own, such as use_sim_time
            continue
        if configured and spec.change is not Change.ALWAYS:
            return SetParametersResult(successful=False, reason=f"{spec.name} changes only {spec.change.value}")
        problem = spec.problem(parameter.value)
        if problem:
            return SetParametersResult(successful=False, reason=problem)
        new[spec.name] = _plain(parameter.value)
    problem = together(new)
    return SetParametersResult(successful=not problem, reason=problem)


def yaml_text(specs: Iterable[Spec], introduction: str) -> str:
    """A parameter file with every parameter at its default, each below its description.

    Parameters
    ----------
    specs : the parameters of a node, whatever its name; those with a dot in their names have to stand together
    introduction : first lines, without the comment signs
    """
    lines = [f"# {line}" for line in textwrap.wrap(introduction, _WIDTH)]
    lines += ["/**:", "  ros__parameters:"]
    group = ""
    for spec in specs:
        parent, _, name = spec.name.rpartition(".")
        if parent and parent != group:
            lines.append(f"    {parent}:")
        group = parent
        indent = "      " if parent else "    "
        lines += [f"{indent}# {line}" for line in textwrap.wrap(spec.description, _WIDTH - len(indent))]
        lines.append(f"{indent}{name}: {_yaml_value(spec.default)}")
    return "\n".join(lines) + "\n"


def markdown_table(specs: Iterable[Spec]) -> str:
    """All parameters as a table for the documentation."""
    lines = ["| parameter | default | allowed | changes | meaning |", "|---|---|---|---|---|"]
    for spec in specs:
        allowed = spec.allowed().replace("|", "\\|")
        default = _yaml_value(spec.default)
        lines.append(f"| `{spec.name}` | `{default}` | {allowed} | {spec.change.value} | {spec.description} |")
    return "\n".join(lines) + "\n"


def _yaml_value(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(_yaml_value(item) for item in value)}]"
    if isinstance(value, float):
        # YAML takes 1e6 for a text: a number needs its point.
        mantissa, _, exponent = repr(value).partition("e")
        return (mantissa if "." in mantissa else f"{mantissa}.0") + (f"e{exponent}" if exponent else "")
    return json.dumps(value) if value in ("", "none") else str(value)


def _plain(value: Any) -> Any:
    """Lists of numbers come as arrays; everything else is plain already."""
    return list(value) if not isinstance(value, bool | int | float | str) else value


def _type_name(spec: Spec) -> str:
    return Parameter.Type.from_parameter_value(spec.default).name.lower()
