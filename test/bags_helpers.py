"""Small messages and topics for the tests of bags."""

from __future__ import annotations

import struct

from iwm_power_manager.bags.definitions import definition_of
from iwm_power_manager.bags.metadata import Qos, Topic

FLOAT64 = "std_msgs/msg/Float64"


def float64(value: float) -> bytes:
    """CDR of a Float64 message."""
    return b"\0\1\0\0" + struct.pack("<d", value)


def topic(name: str, msgtype: str = FLOAT64) -> Topic:
    """A topic with its true definition and hash."""
    return Topic(name, msgtype, *definition_of(msgtype), (Qos(),))
