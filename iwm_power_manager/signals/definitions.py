"""Message definitions and type hashes, from ROS's own `.msg` files or from the Jazzy types that rosbags carries."""

from __future__ import annotations

import os
import sys
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from iwm_power_manager.errors import BagError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """The types of ROS 2 Jazzy; types of other packages are added to it as they are met."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def definition_of(msgtype: str) -> tuple[str, str]:
    """Definition (`ros2msg` text with all dependencies) and RIHS01 hash of a type such as `std_msgs/msg/Float64`.

    Raises
    ------
    BagError
        The type is neither among Jazzy's own nor installed where AMENT_PREFIX_PATH or this Python can find it.
    """
    store = typestore()
    _learn(store, msgtype)
    text, _ = store.generate_msgdef(msgtype, ros_version=2)
    return text, store.hash_rihs01(msgtype)


def learn(store: Typestore, msgtype: str, definition: str = "", topic: str = "") -> None:
    """Make a type known to a store: from a definition, such as a bag carries, or from the installed `.msg` files.

    Raises
    ------
    BagError
        The definition cannot be read, or none is given and none installed; names the topic, if one is given.
    """
    if msgtype in store.fielddefs:
        return
    if not definition:
        _learn(store, msgtype)
        return
    from rosbags.typesys import TypesysError, get_types_from_msg

    try:
        types = get_types_from_msg(definition, msgtype)
        store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
    except TypesysError as error:
        raise BagError(f"{topic}: the definition of {msgtype} cannot be read: {error}") from None


def _learn(store: Typestore, msgtype: str) -> None:
    if msgtype in store.fielddefs:
        return
    from rosbags.typesys import TypesysError, get_types_from_msg

    path = _msg_file(msgtype)
    if path is None:
        raise BagError(f"message type {msgtype}: no definition found; install its package or source its workspace")
    try:
        types = get_types_from_msg(path.read_text(encoding="utf-8"), msgtype)
    except (TypesysError, OSError, UnicodeDecodeError) as error:
        raise BagError(f"message type {msgtype}: {path} cannot be read: {error}") from None
    for _, fields in types.values():
        for _, field in fields:
            for needed in _named_types(field):
                _learn(store, needed)
    store.register(types)


def _named_types(field: object) -> list[str]:
    """Names of message types inside a rosbags field description, a nested tuple (kind, argument)."""
    from rosbags.interfaces import Nodetype

    if not isinstance(field, tuple) or len(field) != 2:
        return []
    kind, argument = field
    if kind == Nodetype.NAME and isinstance(argument, str):
        return [argument]
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and isinstance(argument, tuple):
        return _named_types(argument[0])
    return []


def _msg_file(msgtype: str) -> Path | None:
    package, _, rest = msgtype.partition("/")
    name = rest.rpartition("/")[2]
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    for prefix in prefixes:
        path = Path(prefix) / "share" / package / "msg" / f"{name}.msg"
        if path.is_file():
            return path
    return None
