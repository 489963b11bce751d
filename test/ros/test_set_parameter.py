# SPDX-License-Identifier: Apache-2.0
"""Reading and setting a running node's parameters, and moving it through its lifecycle, without `ros2`."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import rclpy
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future

from iwm_power_manager.exit_codes import BAD_INPUT, FAILED
from iwm_power_manager.ros.spinning import in_thread
from iwm_power_manager.tools import set_parameter


@pytest.fixture(scope="module")
def pair(start_pair):
    return start_pair({"autostart": False})


def run(pair, *arguments: str) -> subprocess.CompletedProcess[str]:
    name = f"{pair.bench.node.get_namespace()}/power_manager"
    return subprocess.run(
        [sys.executable, "-m", "iwm_power_manager.tools.set_parameter", "--node", name, "--patience", "30", *arguments],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
        env=dict(os.environ),
    )


def test_values_are_read_and_set_and_a_transition_is_made(pair) -> None:
    assert run(pair, "friction", "strategy").stdout == "friction: 0.9\nstrategy: equal\n"
    done = run(pair, "friction=1", "friction=0.4", "strategy=rule", "--transition", "configure")
    assert (done.returncode, done.stdout) == (0, "friction: 0.9 -> 0.4\nstrategy: equal -> rule\n")
    done = run(pair, "friction=1")
    assert (done.returncode, done.stdout) == (0, "friction: 0.4 -> 1.0\n")
    assert pair.bench.lifecycle_state() == "inactive"


@pytest.mark.parametrize(
    ("argument", "code", "problem"),
    [
        ("friction=7.0", FAILED, "/power_manager: friction: 7.0 is out of range; allowed: 0.05 to 1.5"),
        ("friction=half", BAD_INPUT, "friction: 'half' is no number"),
        ("strategy=eqaul", FAILED, "/power_manager: strategy: 'eqaul' is not allowed; allowed: "),
        ("strategy=eqaul", FAILED, "; did you mean equal?"),
        ("=3", BAD_INPUT, "'=3' is not allowed; allowed: NAME=VALUE"),
        ("frictoin=0.3", FAILED, "frictoin: no such parameter; did you mean friction"),
    ],
)
def test_what_is_refused_is_one_line(pair, argument: str, code: int, problem: str) -> None:
    done = run(pair, argument)
    assert done.returncode == code
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("set_parameter: ")
    assert problem in line


def test_a_node_that_is_not_there_is_one_line_which_names_those_that_are(pair) -> None:
    done = run(pair, "--node", "/nobody/here", "--patience", "10")
    there = f"{pair.bench.node.get_namespace()}/power_manager"
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("set_parameter: /nobody/here: no such node on this domain within 10 s; there is ")
    assert there in done.stderr


@pytest.fixture
def deaf_at_first():
    """A node whose every service loses its first answer, as the middleware may; counts what it was asked."""
    context = rclpy.Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node(
        f"deaf_{os.getpid()}", context=context, start_parameter_services=False, enable_rosout=False
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    group = ReentrantCallbackGroup()  # one that waits shall not keep the others waiting
    asked: dict[str, int] = {}
    state = {"friction": 0.9, "lifecycle": "active"}

    def list_parameters(_, answer):
        answer.result.names = ["friction"]

    def get_parameters(_, answer):
        answer.values = [rclpy.parameter.Parameter("friction", value=state["friction"]).get_parameter_value()]

    def set_parameters(request, answer):
        state["friction"] = request.parameters[0].value.double_value
        answer.results = [SetParametersResult(successful=True)]

    def get_state(_, answer):
        answer.current_state.label = state["lifecycle"]

    def change_state(_, answer):
        state["lifecycle"] = "inactive"
        answer.success = True

    def losing(work):
        async def serve(request, answer):
            asked[work.__name__] = asked.get(work.__name__, 0) + 1
            work(request, answer)
            if asked[work.__name__] == 1:
                await Future(executor=executor)  # for ever
            return answer

        return serve

    for kind, work in (
        (ListParameters, list_parameters),
        (GetParameters, get_parameters),
        (SetParameters, set_parameters),
        (GetState, get_state),
        (ChangeState, change_state),
    ):
        node.create_service(kind, f"{node.get_name()}/{work.__name__}", losing(work), callback_group=group)
    with in_thread(executor, "deaf"):
        yield node, asked, state
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_a_lost_answer_is_asked_for_again_but_a_transition_is_made_once(deaf_at_first, capsys) -> None:
    node, asked, state = deaf_at_first
    given = ["--node", f"/{node.get_name()}", "--patience", "8", "friction=0.5", "--transition", "deactivate"]
    assert set_parameter.main(given) == 0
    assert capsys.readouterr().out == "friction: 0.9 -> 0.5\n"
    assert state == {"friction": 0.5, "lifecycle": "inactive"}
    assert asked["change_state"] == 1
    assert all(asked[name] > 1 for name in ("list_parameters", "get_parameters", "set_parameters", "get_state"))
