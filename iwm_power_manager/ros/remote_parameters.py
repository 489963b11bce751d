# SPDX-License-Identifier: Apache-2.0
"""Ask other nodes for their parameters, without waiting for any of them."""

from __future__ import annotations

import json
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from iwm_power_manager.ros.asking import Question


class RemoteParameters:
    """Fetches the parameters of nodes, once each.

    An executor has to spin `node` meanwhile. A node that never answers is asked for ever, which costs nothing.

    Parameters
    ----------
    node : the node that asks
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._known: set[str] = set()
        self._questions: list[_Question] = []

    def ask(self, name: str) -> None:
        """Want the parameters of the node with this full name."""
        if name not in self._known:
            self._known.add(name)
            self._questions.append(_Question(self._node, name))

    def answers(self) -> dict[str, str]:
        """Parameters that have arrived since the last call: JSON text by node name."""
        found = {}
        for question in list(self._questions):
            text = question.advance()
            if text is not None:
                found[question.name] = text
                question.destroy()
                self._questions.remove(question)
        return found


class _Question:
    """List the names, then get the values."""

    def __init__(self, node: Node, name: str) -> None:
        self.name = name
        self._node = node
        self._lister = node.create_client(ListParameters, f"{name}/list_parameters")
        self._getter = node.create_client(GetParameters, f"{name}/get_parameters")
        self._listing = Question(self._lister, ListParameters.Request())
        self._names: list[str] = []
        self._getting: Question | None = None

    def advance(self) -> str | None:
        """Do the next step that is due; the answer once it is there."""
        if self._getting is None:
            if (listed := self._listing.answer()) is None:
                return None
            self._names = sorted(listed.result.names)
            self._getting = Question(self._getter, GetParameters.Request(names=self._names))
        if (got := self._getting.answer()) is None:
            return None
        values = [_plain(parameter_value_to_python(value)) for value in got.values]
        return json.dumps(dict(zip(self._names, values, strict=False)))

    def destroy(self) -> None:
        self._node.destroy_client(self._lister)
        self._node.destroy_client(self._getter)


def _plain(value: Any) -> Any:
    """What JSON can say: arrays become lists, bytes become numbers."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return [_plain(item) if not isinstance(item, bytes) else item[0] for item in value]
