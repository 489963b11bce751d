# SPDX-License-Identifier: Apache-2.0
"""Message types by their definitions: what stands in a bag wins, then what is installed, then ROS 2 Jazzy's own.

A definition from outside is parsed and compiled by rosbags. Before that it is measured here, because rosbags unrolls
nested types and fixed arrays into code (`rosbags.serde.cdr`): a text of a kilobyte can ask for a program of gigabytes.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from iwm_power_manager.errors import BagError

if TYPE_CHECKING:
    from rosbags.typesys.idl import IDLParser
    from rosbags.typesys.msg import MSGParser
    from rosbags.typesys.store import Typestore

MSG, IDL = "ros2msg", "ros2idl"
#: What recorders call them, in small letters.
_ENCODINGS = {MSG: MSG, "": MSG, IDL: IDL, "omgidl": IDL}
#: The name of a type as DDS has it.
_DDS_NAME = re.compile(r"::dds_::(\w+)_$", re.ASCII)

#: Largest definition that is read, its deepest nesting, and the numbers and texts it may unroll to.
MAX_TEXT_BYTES = 256 * 1024
MAX_DEPTH = 32
MAX_FIELDS = 20_000

_ENCAPSULATION = 4
#: Bytes at the end of a message that may be padding.
_MAX_PADDING = 16

_SEPARATOR = "=" * 80
_UNION = re.compile(r"\bunion\s+(\w+)\s+switch\b")
_ENUMERATION = re.compile(r"\benum\s+(\w+)\s*\{[^{}]*\}")
#: How a text of wide characters may lie in CDR: DDS vendors and versions differ in the width and in what they count.
_WIDE = ("uint16", "uint32", "uint8")


class Types(NamedTuple):
    """A type with all it depends on.

    Attributes
    ----------
    store : rosbags type store that holds these types and no others
    name : the type's name there, such as `std_msgs/msg/Float64`
    """

    store: Typestore
    name: str

    def deserialize(self, data: bytes) -> Any:
        """Message from its CDR bytes; raises whatever a generated decoder makes of bytes that are no message.

        What `rclpy.serialization` makes ends in some bytes of padding for each empty list (rmw_fastrtps takes the size
        from an estimate that aligns them); rosbags allows three bytes too many.
        """
        for padding in range(0, min(_MAX_PADDING, len(data) - _ENCAPSULATION) + 1, 4):
            with suppress(Exception):
                return self.store.deserialize_cdr(data[: len(data) - padding], self.name)
        return self.store.deserialize_cdr(data, self.name)

    def fits(self, data: bytes) -> bool:
        """Whether these bytes are a message of this type, to the last byte."""
        try:
            self.store.deserialize_cdr(data, self.name)
        except Exception:  # noqa: BLE001 - see `deserialize`
            return False
        return True


def types_of(msgtype: str, encoding: str = "", text: str = "", sample: bytes = b"") -> Types:
    """A type and those it is made of.

    Parameters
    ----------
    msgtype : name, `pkg/msg/Type` or `pkg/Type`, or as IDL has it: `pkg::msg::Type`
    encoding : of `text`: "ros2msg", "ros2idl"; a text in any other is not read
    text : definition with all it depends on; "" for the installed one
    sample : a message of this type: decides how wide characters are stored, in a type that has any

    Raises
    ------
    BagError
        No definition is found, or it cannot be read, or is too large.
    """
    found = _types_of(msgtype, encoding, text, _WIDE[0])
    if not sample or "wstring" not in text:
        return found
    candidates = (_types_of(msgtype, encoding, text, width) for width in _WIDE)
    return next((candidate for candidate in candidates if candidate.fits(sample)), found)


@lru_cache(maxsize=512)
def definition_of(msgtype: str) -> tuple[str, str]:
    """Definition (`ros2msg` text with all dependencies) and RIHS01 hash of an installed type.

    Raises
    ------
    BagError
        The type is neither among Jazzy's own nor installed where AMENT_PREFIX_PATH or this Python can find it.
    """
    store, name = types_of(msgtype)
    text, _ = store.generate_msgdef(name, ros_version=2)
    return text, store.hash_rihs01(name)


@lru_cache(maxsize=512)
def _types_of(msgtype: str, encoding: str, text: str, wide: str) -> Types:
    from rosbags.typesys.store import Typestore

    try:
        encoding = _ENCODINGS.get(encoding.lower(), encoding)
        name = msgtype.replace("::", "/") if encoding == IDL and text else full_name(msgtype)
        known: dict[str, Any] = _parsed(name, encoding, text) if text and encoding in (MSG, IDL) else {}
        name = name if name in known else full_name(msgtype)
        if text and name not in known and encoding not in (MSG, IDL):
            raise BagError(f"its definition is written in {encoding!r}; allowed: {MSG}, {IDL}")
        given = _needed(name, known, wide)
        _measure(name, given)
        store = Typestore()
        jazzy = standard_types()
        for part, definition in given.items():
            if part not in known:
                store.fielddefs[part], store.types[part] = definition, jazzy.types[part]
        store.register({part: definition for part, definition in given.items() if part in known})
        store.get_msgdef(name)
    except BagError as error:
        raise BagError(f"type {msgtype}: {error}") from None
    except Exception as error:  # noqa: BLE001 - parser and code generator raise anything at a text that is none
        raise BagError(f"type {msgtype}: its definition cannot be read{_problem(error)}") from None
    return Types(store, name)


@lru_cache(maxsize=1)
def standard_types() -> Typestore:
    """All types of ROS 2 Jazzy, as rosbags carries them."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def full_name(msgtype: str) -> str:
    """`package/msg/Type` of `package/Type` or of a name as DDS has it; raises `BagError` for what is none of a type."""
    package, _, rest = _DDS_NAME.sub(r"/\1", msgtype).replace("::", "/").partition("/")
    kind, _, name = rest.rpartition("/")
    full = f"{package}/{kind or 'msg'}/{name}"
    if not re.fullmatch(r"[A-Za-z]\w*(/[A-Za-z]\w*){2,3}", full, re.ASCII):
        raise BagError("is no name of a message type; allowed: package/msg/Type")
    return full


def _parsed(name: str, encoding: str, text: str) -> dict[str, Any]:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg
    from rosbags.typesys.idl import IDLParser
    from rosbags.typesys.msg import MSGParser

    if len(text) > MAX_TEXT_BYTES:
        raise BagError(f"its definition has {len(text)} characters; allowed: <= {MAX_TEXT_BYTES}")
    text = re.sub("[\t\u00a0]", " ", text.lstrip("\ufeff"))
    lines = (line.strip() for line in re.split("[\r\n\f\v\0]+", text))
    # The grammar of IDL knows no directives, with which each text of rosidl begins.
    text = "\n".join(line for line in lines if line and not (encoding == IDL and line.startswith("#")))
    text = re.sub("^={40,}$", _SEPARATOR, text, flags=re.MULTILINE)
    if encoding == MSG:
        text = re.sub("^MSG: *", "MSG: ", text, flags=re.MULTILINE)
        # The grammar knows no bounded wstring, and a constant in small letters as one with a default: neither the bound
        # nor a constant is in the bytes.
        text = re.sub(r"^(wstring)<=\d+", r"\1", text, flags=re.MULTILINE)
        text = re.sub(r"^[\w<=]+ +[a-z]\w* *=.*\n?", "", text, flags=re.MULTILINE)
        with _saying_where(MSGParser, f"MSG: {name}\n{text}"):
            return dict(get_types_from_msg(text, name))
    parts = [part.split("\n", 1)[1] for part in text.split(_SEPARATOR + "\n")[1:]] if _SEPARATOR in text else [text]
    # What a part names stands behind it, and has to be known before. Of an enumeration, CDR has its number.
    text = _ENUMERATION.sub(r"typedef unsigned long \1", "\n".join(reversed(parts)))
    with _saying_where(IDLParser, text):
        return dict(get_types_from_idl(text))


@contextmanager
def _saying_where(kind: type[IDLParser | MSGParser], text: str) -> Iterator[None]:
    """Name the line at which a parser gives up a text: not where it goes back to, but the furthest that it has come."""
    try:
        yield
    except Exception as error:
        if not str(error).startswith("Could not parse"):
            raise
        if union := _UNION.search(text):
            raise BagError(f"its definition has a union, {union[1]}, and unions are not read") from None
        parser, reached = kind(text), 0

        def watched(match: Callable[..., Any]) -> Callable[..., Any]:
            def matched(at: int, *rest: Any) -> Any:
                nonlocal reached
                reached = max(reached, at)
                return match(at, *rest)

            return matched

        for name in ("literal", "regex"):
            setattr(parser, name, watched(getattr(parser, name)))
        with suppress(Exception):
            parser.specification()
        # What is looked for at the start of a line of IDL may be missing at the end of the one before.
        before = text[:reached] if text.startswith("MSG: ") else text[:reached].rstrip()
        start = before.rfind("\n") + 1
        line = " ".join(text[start : (text + "\n").index("\n", reached)].split())
        raise BagError(f"its definition cannot be read, at {line[:80]!r}") from None


def _needed(name: str, known: dict[str, Any], wide: str) -> dict[str, Any]:
    """The definitions a type is made of; those that were not given are added to `known` or come from Jazzy."""
    needed: dict[str, Any] = {}
    waiting = [name]
    while waiting:
        part = waiting.pop()
        if part in needed:
            continue
        if part not in known and part not in standard_types().fielddefs:
            known.update(_installed(part, name))
        if part in known:
            constants, fields = known[part]
            known[part] = constants, [(field, _without_wstring(description, wide)) for field, description in fields]
            needed[part] = known[part]
        else:
            needed[part] = standard_types().fielddefs[part]
        waiting += [inner for _, description in needed[part][1] if (inner := _named(description))]
        if len(needed) > MAX_FIELDS:
            raise BagError(f"needs more than {MAX_FIELDS} other types")
    return needed


def _installed(part: str, whole: str) -> dict[str, Any]:
    package, _, rest = part.partition("/")
    file = f"{rest.rpartition('/')[2]}.msg"
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    for prefix in prefixes:
        path = Path(prefix) / "share" / package / "msg" / file
        if path.is_file():
            return _parsed(part, MSG, path.read_text(encoding="utf-8"))
    if part == whole:
        raise BagError("no definition found; install its package or source its workspace")
    raise BagError(f"its definition names {part}, which is not defined in it and not installed")


def _named(description: Any) -> str:
    """Name of the message type inside a rosbags field description, a nested tuple (kind, argument); "" for none."""
    from rosbags.interfaces import Nodetype

    kind, argument = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind, argument = argument[0]
    return str(argument) if kind == Nodetype.NAME else ""


def _without_wstring(description: Any, wide: str) -> Any:
    """A wide text as a sequence of its units: rosbags has no decoder for one (`TIDMAP` in `rosbags.typesys.store`)."""
    from rosbags.interfaces import Nodetype

    def is_wide(kind: Any, argument: Any) -> bool:
        name = argument[0] if kind == Nodetype.BASE else argument
        return bool(kind in (Nodetype.BASE, Nodetype.NAME) and str(name).rpartition("/")[2] == "wstring")

    kind, argument = description
    if is_wide(kind, argument):
        return (Nodetype.SEQUENCE, ((Nodetype.BASE, (wide, 0)), 0))
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and is_wide(*argument[0]):
        raise BagError("arrays of wstring cannot be read")
    return description


def _measure(name: str, types: dict[str, Any]) -> None:
    """Refuse a type that contains itself, nests too deep, or unrolls to more fields than can be compiled."""
    from rosbags.interfaces import Nodetype

    sizes: dict[str, int] = {}

    def size(part: str, depth: int) -> int:
        if depth > MAX_DEPTH:
            raise BagError(f"is nested more than {MAX_DEPTH} deep, or contains itself")
        if part not in sizes:
            total = 0
            for _, description in types[part][1]:
                kind, argument = description
                inner = _named(description)
                one = size(inner, depth + 1) if inner else 1
                if kind == Nodetype.ARRAY:
                    (item, base), length = argument
                    if length < 1:
                        raise BagError(f"has an array of {length} elements")
                    one *= length if inner or (item == Nodetype.BASE and base[0] == "string") else 1
                total += one
            if total > MAX_FIELDS:
                raise BagError(f"has more than {MAX_FIELDS} fields with all it contains")
            sizes[part] = total
        return sizes[part]

    size(name, 0)


def _problem(error: Exception) -> str:
    """What a parser says is wrong."""
    if isinstance(error, RecursionError):
        return ": is nested too deep"
    return f": {str(error)[:80]!r}" if str(error) else ""
