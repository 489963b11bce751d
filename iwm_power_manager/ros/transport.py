# SPDX-License-Identifier: Apache-2.0
"""What Fast DDS carries a node's messages by: the network, and no memory shared with others.

A process that is held up for seconds may be given up by those that share memory with it, and hears nothing more until
it is started again; one that loses its processor while it holds a lock in that memory holds up the others. A car can
live with neither (docs/safety.md, duty 7).
"""

from __future__ import annotations

from collections.abc import MutableMapping

from iwm_power_manager.share import share_path

_PROFILE = "config/dds/without_shared_memory.xml"
_FILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")  # the latter from Fast DDS 3 on
_TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
_RANGE, _LOCALHOST_ONLY = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"


def leave_shared_memory(environment: MutableMapping[str, str]) -> None:
    """Have Fast DDS share no memory, unless the environment says which transports or profiles it wants.

    Parameters
    ----------
    environment : of the process, before rclpy is initialised; changed
    """
    chosen = any(environment.get(name) for name in (*_FILES, _TRANSPORTS))
    if chosen or not environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp").startswith("rmw_fastrtps"):
        return
    if environment.get(_LOCALHOST_ONLY) != "1" and environment.get(_RANGE) != "LOCALHOST":
        environment[_TRANSPORTS] = "UDPv4"
    elif not environment.get("ROS_STATIC_PEERS"):  # with LOCALHOST rmw brings transports of its own
        environment.pop(_LOCALHOST_ONLY, None)
        environment.update(dict.fromkeys(_FILES, str(share_path(_PROFILE))) | {_RANGE: "SYSTEM_DEFAULT"})
