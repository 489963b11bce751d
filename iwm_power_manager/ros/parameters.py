# SPDX-License-Identifier: Apache-2.0
"""Parameters declared from one table: type, default, range, unit, description, and when each may change.

rclpy checks types and numeric ranges against the descriptors; what it cannot check (choices, NaN, lengths, the state of
the node) is checked here, when a parameter is set, so that a bad value never reaches the control loop. The table is
also what `docs/interface.md` is tested against.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from iwm_power_manager.control.settings import Change as Change  # part of this interface
from iwm_power_manager.ros.specs import ParameterError as ParameterError
from iwm_power_manager.ros.specs import Spec as Spec

#: Parameters that rclpy declares itself, some of them later.
_ROS_PREFIXES = ("qos_overrides.", "start_type_description_service", "use_sim_time")


def descriptor(spec: Spec) -> ParameterDescriptor:
    """What tools like `ros2 param describe` show, and what rclpy enforces."""
    found = ParameterDescriptor(
        name=spec.name,
        description=f"{spec.description} Changes {spec.change.value}.",
        additional_constraints=spec.allowed() if spec.choices or spec.length else "",
        read_only=spec.change is Change.NEVER,
    )
    if isinstance(spec.default, float):
        found.floating_point_range = [FloatingPointRange(from_value=spec.low, to_value=spec.high)]
    elif isinstance(spec.default, int) and not isinstance(spec.default, bool):
        found.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high))]
    return found


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
            value = node.declare_parameter(spec.name, spec.default, descriptor(spec)).value
        except (InvalidParameterTypeException, InvalidParameterValueException, ParameterUninitializedException):
            override = node._parameter_overrides.get(spec.name)  # the exceptions do not all carry the value
            given = override.value if override else None
            raise ParameterError(
                f"parameter {spec.name}: {given!r} is not allowed; "
                f"allowed: {spec.allowed()} ({_type_name(spec)}{_with_points(spec, given)})"
            ) from None
        problem = spec.problem(value)
        if problem:
            raise ParameterError(f"parameter {problem}")
        values[spec.name] = _plain(value)
    _refuse_unknown(node, specs)
    return values


def _with_points(spec: Spec, given: Any) -> str:
    """How allowed whole numbers are written: ROS takes no 100 for 100.0."""
    several = isinstance(spec.default, list)
    ours: Any
    ours, theirs = (spec.default, given) if several and isinstance(given, Sequence) else ([spec.default], [given])
    if {*map(type, ours)} != {float} or {*map(type, theirs)} != {int}:
        return ""
    value = [float(number) for number in theirs] if several else float(given)
    return "" if spec.problem(value) else f": write {value}"


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


def _plain(value: Any) -> Any:
    """Lists of numbers come as arrays; everything else is plain already."""
    return list(value) if not isinstance(value, bool | int | float | str) else value


def _type_name(spec: Spec) -> str:
    return Parameter.Type.from_parameter_value(spec.default).name.lower()
