# SPDX-License-Identifier: Apache-2.0
"""Parameters and lifecycle of a running node, for whoever has no `ros2` command: list, read, set, activate."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.errors import FailedError, IwmError, did_you_mean, spelled_like
from iwm_power_manager.exit_codes import DONE, FAILED
from iwm_power_manager.ros.asking import AGAIN_S, Question, others_there
from iwm_power_manager.ros.specs import ParameterError
from iwm_power_manager.tools.options import number

#: Lifecycle transitions, and the state that each ends in.
_TRANSITIONS = {
    "configure": "inactive",
    "activate": "active",
    "deactivate": "inactive",
    "cleanup": "unconfigured",
    "shutdown": "finalized",
}
_LOOK_S = 0.05
_OUT_OF_RANGE = r"\3 is out of range; allowed: \1 to \2"


class _Remote:
    """A node that is asked for parameters and transitions; every answer is waited for, within limits."""

    def __init__(self, node: Any, name: str, patience_s: float) -> None:
        self._node = node
        self._name = name
        self._patience_s = patience_s
        self._again_s = min(AGAIN_S, patience_s / 8.0)
        self._clients: dict[str, Any] = {}

    def _client(self, kind: Any, service: str) -> Any:
        """Client of one of its services, once that is there."""
        if service not in self._clients:
            self._clients[service] = self._node.create_client(kind, f"{self._name}/{service}")
        if not self._clients[service].wait_for_service(self._patience_s):
            what = "no such node" if "parameters" in service else "no such node with a lifecycle"
            there = others_there(self._node, self._name)
            raise FailedError(f"{self._name}: {what} on this domain within {self._patience_s:g} s{there}")
        return self._clients[service]

    def _until(self, look: Callable[[], Any]) -> Any:
        """Serve callbacks until `look` finds something."""
        import rclpy

        due_s = time.monotonic() + self._patience_s
        while (found := look()) is None:
            if time.monotonic() > due_s:
                raise FailedError(f"{self._name}: does not answer within {self._patience_s:g} s")
            rclpy.spin_once(self._node, timeout_sec=_LOOK_S)
        return found

    def _ask(self, kind: Any, service: str, **request: Any) -> Any:
        """Answer to a request that may be made twice."""
        return self._until(Question(self._client(kind, service), kind.Request(**request), self._again_s).answer)

    def values(self, names: Sequence[str]) -> dict[str, Any]:
        """Values of parameters; of all for no name."""
        from rcl_interfaces.srv import GetParameters, ListParameters
        from rclpy.parameter import parameter_value_to_python

        known = sorted(self._ask(ListParameters, "list_parameters").result.names)
        for name in names:
            if name not in known:
                near = did_you_mean(spelled_like(name, known))
                raise FailedError(f"{self._name}: {name}: no such parameter{near}")
        wanted = list(names) or known
        values = self._ask(GetParameters, "get_parameters", names=wanted).values
        return {name: parameter_value_to_python(value) for name, value in zip(wanted, values, strict=True)}

    def set(self, assignments: Sequence[str]) -> None:
        """Set parameters, each NAME=VALUE in YAML; print what they were and are, or `IwmError` with the reason."""
        from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import get_parameter_value, parameter_value_to_python

        given = {}
        for assignment in assignments:
            name, equals, text = assignment.partition("=")
            if not (name and equals):
                raise ParameterError(f"{assignment!r} is not allowed; allowed: NAME=VALUE")
            given[name] = text
        now = self.values(list(given))
        parameters = []
        for name, text in given.items():
            value = get_parameter_value(text)
            if type(now[name]) in (int, float) and not isinstance(parameter_value_to_python(value), int | float):
                raise ParameterError(f"{name}: {text!r} is no number")
            if isinstance(now[name], float) and value.type == ParameterType.PARAMETER_INTEGER:
                value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float(value.integer_value))
            parameters.append(Parameter(name=name, value=value))
        results = self._ask(SetParameters, "set_parameters", parameters=parameters).results
        for parameter, result in zip(parameters, results, strict=True):
            if not result.successful:
                reason = result.reason.removeprefix(f"{parameter.name}: ") or "refused"
                # As rclpy says it of a range that it checks itself.
                reason = re.sub(r".* out of range Min: (.*), Max: (.*), value: (.*)", _OUT_OF_RANGE, reason)
                raise FailedError(f"{self._name}: {parameter.name}: {reason}")
        for name, value in self.values(list(given)).items():
            print(f"{name}: {now[name]} -> {value}")

    def change(self, transition: str) -> None:
        """Ask for a lifecycle transition; `IwmError` if it is refused.

        It is asked for once: by then somebody else may have made another. Where the answer stays away, the state tells.
        """
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState, GetState

        request = ChangeState.Request(transition=Transition(label=transition))
        asked = self._client(ChangeState, "change_state").call_async(request)
        states = self._client(GetState, "get_state")
        look_s = time.monotonic() + self._again_s
        state: Question | None = None

        def outcome() -> bool | None:
            nonlocal look_s, state
            if asked.done():
                return bool(asked.result().success)
            if time.monotonic() > look_s:
                look_s = time.monotonic() + self._again_s
                state = Question(states, GetState.Request(), self._again_s)
            found = state and state.answer()
            return True if found and found.current_state.label == _TRANSITIONS[transition] else None

        if not self._until(outcome):
            raise FailedError(f"{self._name}: {transition} was refused; its log says why")


_EXAMPLES = """\
examples:
  All parameters, one of them, and other values:
    set_parameter
    set_parameter friction
    set_parameter strategy=equal
    set_parameter friction_source=parameter friction=0.5
  A node in a namespace shall command nothing any more:
    set_parameter --node /car_1/power_manager --transition deactivate

exit codes: 0 done, 1 no such node or parameter, no answer, or refused by the node, 2 bad arguments
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
        "--patience",
        type=number(0.1, 3600.0),
        default=10.0,
        metavar="S",
        help="wait so long for each answer, s (default: 10)",
    )
    options = parser.parse_args(args)
    import rclpy

    from iwm_power_manager.ros import ending

    rclpy.init(args=[])
    node = rclpy.create_node(
        f"set_parameter_{time.monotonic_ns()}", enable_rosout=False, start_parameter_services=False
    )
    code = FAILED
    try:
        remote = _Remote(node, options.node, options.patience)
        assignments = [text for text in options.parameters if "=" in text]
        names = [text for text in options.parameters if "=" not in text]
        if assignments:
            remote.set(assignments)
        if names or not (assignments or options.transition):
            for name, value in remote.values(names).items():
                print(f"{name}: {value}")
        if options.transition:
            remote.change(options.transition)
        code = DONE
    except IwmError as error:
        code = error.exit_code
        print(f"set_parameter: {error}", file=sys.stderr)
    finally:
        with ending.bounded(code):
            node.destroy_node()
    return code


if __name__ == "__main__":
    sys.exit(main())
