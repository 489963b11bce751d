# SPDX-License-Identifier: Apache-2.0
"""Ask other nodes: who is there, and again what has not been answered, for an answer may be lost."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rclpy.client import Client
    from rclpy.node import Node
    from rclpy.task import Future

AGAIN_S = 5.0


def others_there(node: Node, name: str) -> str:
    """The end of a message that there is no power manager `name`: those that `node` has found under other names."""
    found = (f"{space.rstrip('/')}/{own}" for own, space in node.get_node_names_and_namespaces())
    others = ", ".join(sorted({full for full in found if full.endswith("/power_manager")} - {name}))
    return f"; there is {others}: name it with --node" if others else ""


class Question:
    """A request that may be made twice; somebody has to spin the client's node.

    Parameters
    ----------
    client : of the service; nothing is asked before that is there
    request : what is asked
    again_s : and so long after that asked again, as often as it takes
    """

    def __init__(self, client: Client, request: Any, again_s: float = AGAIN_S) -> None:
        self._client = client
        self._request = request
        self._again_s = again_s
        self._due_s = 0.0
        self._asked: list[Future] = []

    def answer(self) -> Any:
        """The first answer; None as long as there is none."""
        if time.monotonic() >= self._due_s and self._client.service_is_ready():
            self._due_s = time.monotonic() + self._again_s
            self._asked.append(self._client.call_async(self._request))
        return next((future.result() for future in self._asked if future.done()), None)
