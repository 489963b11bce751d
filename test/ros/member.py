# SPDX-License-Identifier: Apache-2.0
"""Nodes of the test process: they come and go, the participant of DDS that carries them stays until the run ends."""

from __future__ import annotations

import os
from functools import cache
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from iwm_power_manager.ros import ending


def domain() -> int:
    """That of this test run."""
    return int(os.environ["ROS_DOMAIN_ID"])


def anchor(context: rclpy.Context | None = None) -> Node:
    """A node that only keeps the participant of its context, which rmw destroys with the last node."""
    return Node("anchor", context=context, enable_rosout=False, start_parameter_services=False)


@cache
def anchored() -> tuple[rclpy.Context, Node]:
    """The one context of all members, and its anchor."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain(), args=[])
    return context, anchor(context)


def leave() -> None:
    """Leave DDS, if anybody has been there; to be called when all other processes have ended."""
    if anchored.cache_info().currsize:
        context, node = anchored()
        with ending.one_processor():
            node.destroy_node()
            rclpy.shutdown(context=context)


class Member:
    """A node in the test process, and the executor that serves it."""

    def __init__(self, name: str, namespace: str = "", **options: Any) -> None:
        context, _ = anchored()
        self.node = Node(name, context=context, namespace=namespace, enable_rosout=False, **options)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)

    def close(self) -> None:
        """Destroy the node, and what waits for it before."""
        self.executor.shutdown()
        self.node.destroy_node()
