# SPDX-License-Identifier: Apache-2.0
"""Parameters and lifecycle of a running node, for whoever has no `ros2` command: list, read, set, activate."""

from __future__ import annotations

import difflib
import sys
import time
from collections.abc import Sequence
from typing import Any

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.errors import IwmError

_TRANSITIONS = ("configure", "activate", "deactivate", "cleanup", "shutdown")


class _Remote:
    """A node that is asked for parameters and transitions; every answer is waited for, within limits."""

    def __init__(self, node: Any, name: str, patience_s: float) -> None:
        from lifecycle_msgs.srv import ChangeState
        from rclpy.parameter_client import AsyncParameterClient

        self._node = node
        self._name = name
        self._patience_s = patience_s
        self._parameters = AsyncParameterClient(node, name)
        self._lifecycle = node.create_client(ChangeState, f"{name}/change_state")

    def _answer(self, future: Any) -> Any:
        import rclpy

        rclpy.spin_until_future_complete(self._node, future, timeout_sec=self._patience_s)
        if not future.done():
            raise IwmError(f"{self._name}: does not answer within {self._patience_s:g} s")
        return future.result()

    def find(self) -> None:
        """Wait until it is there."""
        if not self._parameters.wait_for_services(self._patience_s):
            raise IwmError(f"{self._name}: no such node on this domain within {self._patience_s:g} s")

    def values(self, names: Sequence[str]) -> dict[str, Any]:
        """Values of parameters; of all for no name."""
        from rclpy.parameter import parameter_value_to_python

        known = sorted(self._answer(self._parameters.list_parameters()).result.names)
        for name in names:
            if name not in known:
                near = difflib.get_close_matches(name, known)
                hint = f"; did you mean {' or '.join(near)}?" if near else ""
                raise IwmError(f"{self._name}: {name}: no such parameter{hint}")
        wanted = list(names) or known
        values = self._answer(self._parameters.get_parameters(wanted)).values
        return {name: parameter_value_to_python(value) for name, value in zip(wanted, values, strict=True)}

    def set(self, assignments: Sequence[str]) -> None:
        """Set parameters, each NAME=VALUE in YAML; print what they were and are, or `IwmError` with the reason."""
        from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
        from rclpy.parameter import get_parameter_value

        given = {}
        for assignment in assignments:
            name, equals, text = assignment.partition("=")
            if not (name and equals):
                raise IwmError(f"{assignment!r} is not allowed; allowed: NAME=VALUE")
            given[name] = text
        now = self.values(list(given))
        parameters = []
        for name, text in given.items():
            value = get_parameter_value(text)
            if isinstance(now[name], float) and value.type == ParameterType.PARAMETER_INTEGER:
                value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float(value.integer_value))
            parameters.append(Parameter(name=name, value=value))
        for parameter, result in zip(
            parameters, self._answer(self._parameters.set_parameters(parameters)).results, strict=True
        ):
            if not result.successful:
                raise IwmError(f"{self._name}: {parameter.name}: {result.reason or 'refused'}")
        for name, value in self.values(list(given)).items():
            print(f"{name}: {now[name]} -> {value}")

    def change(self, transition: str) -> None:
        """Ask for a lifecycle transition; `IwmError` if it is refused."""
        from lifecycle_msgs.srv import ChangeState

        if not self._lifecycle.wait_for_service(self._patience_s):
            raise IwmError(f"{self._name}: has no lifecycle")
        request = ChangeState.Request()
        request.transition.label = transition
        if not self._answer(self._lifecycle.call_async(request)).success:
            raise IwmError(f"{self._name}: {transition} was refused; its log says why")


_EXAMPLES = """\
examples:
  All parameters, one of them, and other values:
    set_parameter
    set_parameter friction
    set_parameter strategy=equal
    set_parameter friction_source=parameter friction=0.5
  A node in a namespace shall command nothing any more:
    set_parameter --node /car_1/power_manager --transition deactivate

exit codes: 0 done, 1 no such node or parameter, or refused, 2 bad arguments
"""


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = CommandParser(
        "set_parameter",
        description="List, read and set a running node's parameters, or ask for a lifecycle transition, without ros2.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("parameters", metavar="NAME[=VALUE]", nargs="*", help="read these, or set them; none: all")
    parser.add_argument("--node", default="/power_manager", help="full name of the node (default /power_manager)")
    parser.add_argument("--transition", choices=_TRANSITIONS, help="ask for this transition afterwards")
    parser.add_argument(
        "--patience", type=float, default=10.0, metavar="S", help="wait so long for each answer, s (default: 10)"
    )
    options = parser.parse_args(args)
    import rclpy

    from iwm_power_manager.ros import ending

    rclpy.init(args=[])
    node = rclpy.create_node(
        f"set_parameter_{time.monotonic_ns()}", enable_rosout=False, start_parameter_services=False
    )
    code = 1
    try:
        remote = _Remote(node, options.node, options.patience)
        remote.find()
        assignments = [text for text in options.parameters if "=" in text]
        names = [text for text in options.parameters if "=" not in text]
        if assignments:
            remote.set(assignments)
        if names or not (assignments or options.transition):
            for name, value in remote.values(names).items():
                print(f"{name}: {value}")
        if options.transition:
            remote.change(options.transition)
        code = 0
    except IwmError as error:
        print(f"set_parameter: {error}", file=sys.stderr)
    finally:
        with ending.bounded(code):
            node.destroy_node()
    return code


if __name__ == "__main__":
    sys.exit(main())
