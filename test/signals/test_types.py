# SPDX-License-Identifier: Apache-2.0
"""Message types by their definitions: the bag's own wins, whatever it is written in, and none can run or hang."""

from __future__ import annotations

import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iwm_power_manager.errors import BagError
from iwm_power_manager.signals.types import MAX_DEPTH, MAX_FIELDS, definition_of, types_of

LINE = "=" * 80
HEADER = b"\0\1\0\0"
IDL = f"{LINE}\nIDL: my_msgs/msg/Speed\n\nmodule my_msgs {{ module msg {{ struct Speed {{ double value; }}; }}; }};\n"
TWIST = f"geometry_msgs/Twist twist\n{LINE}\nMSG: geometry_msgs/Twist\nfloat64 x\n"


@pytest.mark.parametrize(
    ("msgtype", "encoding", "text"),
    [
        ("my_msgs/msg/Speed", "ros2msg", "float64 value\n"),
        ("my_msgs/Speed", "ros2msg", "float64 value\n"),
        ("my_msgs/msg/Speed", "ros2msg", "# a comment\r\nfloat64 value\r\n"),
        ("my_msgs/msg/Speed", "ros2idl", IDL),
    ],
)
def test_a_definition_is_read_whatever_it_is_written_in(msgtype: str, encoding: str, text: str) -> None:
    types = types_of(msgtype, encoding, text)
    assert types.name == "my_msgs/msg/Speed"
    assert types.deserialize(HEADER + struct.pack("<d", 9.5)).value == 9.5


def test_the_definition_in_the_bag_wins_over_the_standard_one_and_changes_no_other() -> None:
    forked = types_of("geometry_msgs/msg/TwistStamped", "ros2msg", TWIST)
    assert forked.deserialize(HEADER + struct.pack("<d", 9.5)).twist.x == 9.5
    assert [
        name for name, _ in types_of("geometry_msgs/msg/TwistStamped").store.fielddefs["geometry_msgs/msg/Twist"][1]
    ] == [
        "linear",
        "angular",
    ]


def test_a_type_that_changed_between_two_drives_is_read_as_each_drive_has_it() -> None:
    old, new = (types_of("my_msgs/msg/S", "ros2msg", text) for text in ("float32 value\n", "int32 n\nfloat64 value\n"))
    assert old.deserialize(HEADER + struct.pack("<f", 1.5)).value == 1.5
    assert new.deserialize(HEADER + struct.pack("<i4xd", 1, 2.5)).value == 2.5


@pytest.mark.parametrize("unit", ["H", "I"])
def test_what_stands_behind_a_wide_text_is_read_however_wide_its_characters_are(unit: str) -> None:
    body = struct.pack(f"<I5{unit}", 5, *b"speed")
    data = HEADER + body + bytes(-len(body) % 8) + struct.pack("<d", 9.5)
    types = types_of("my_msgs/msg/S", "ros2msg", "wstring<=8 text\nfloat64 value\n", data)
    assert types.deserialize(data).value == 9.5


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("other_msgs/Thing thing\n", "names other_msgs/msg/Thing, which is not defined in it and not installed"),
        ("A a\n", f"nested more than {MAX_DEPTH} deep"),
        ("string[1000000000] a\n", f"more than {MAX_FIELDS} fields"),
        ("float64[0] a\n", "an array of 0 elements"),
        ("wstring[2] a\n", "arrays of wstring"),
        ("float64 a\nfloat64 a\n", "cannot be read"),
        ("float64 a" + " " * 300_000 + "\n", "characters; allowed"),
        ("int32 A=" + "9" * 5000 + "\n", "cannot be read"),
        (
            "m/B b\nm/B c\n"
            + "".join(f"{LINE}\nMSG: m/{chr(66 + i)}\nm/{chr(67 + i)} a\nm/{chr(67 + i)} b\n" for i in range(22))
            + f"{LINE}\nMSG: m/X\nint8 a\n",
            f"more than {MAX_FIELDS} fields",
        ),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line_with_the_type(text: str, says: str) -> None:
    with pytest.raises(BagError, match=says) as caught:
        types_of("m/msg/A", "ros2msg", text)
    assert str(caught.value).startswith("type m/msg/A: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "line", ["float64 9x", "float64", "float64[ a", "float64 value;", 'string<=5 UNIT="x"', "float64 a 1 2", "---"]
)
def test_the_line_that_is_wrong_is_named_wherever_it_stands(line: str) -> None:
    others = [f"float64 value_{i}" for i in range(4)]
    for at in range(5):
        with pytest.raises(BagError) as caught:
            types_of(
                "m/msg/A", "ros2msg", "\n".join([*others[:at], line, *others[at:], LINE, "MSG: m/B", "int8 a", ""])
            )
        assert str(caught.value) == f"type m/msg/A: its definition cannot be read, at {line!r}"


@pytest.mark.parametrize("line", ["double a:", "double", "map<string, long> a;", "double a[;", "fixed<1,2> a;"])
def test_the_line_of_an_idl_that_is_wrong_is_named(line: str) -> None:
    with pytest.raises(BagError, match="cannot be read, at") as caught:
        types_of("my_msgs/msg/Speed", "ros2idl", IDL.replace("double value;", f"\ndouble b;\n{line}\ndouble value;\n"))
    assert line in str(caught.value)


def test_a_union_is_named_as_what_is_not_read() -> None:
    union = "union Value switch (long) { case 0: double number; default: long none; };"
    text = IDL.replace("struct Speed {", f"{union} struct Speed {{ my_msgs::msg::Value extra;")
    with pytest.raises(BagError, match="type my_msgs/msg/Speed: its definition has a union, Value, and"):
        types_of("my_msgs/msg/Speed", "ros2idl", text)


def test_what_is_no_place_in_a_definition_is_said_as_it_is() -> None:
    with pytest.raises(BagError, match=r"cannot be read: 'Multidimensional arrays are not supported'"):
        types_of("my_msgs/msg/Speed", "ros2idl", IDL.replace("value;", "value[2][3];"))


def test_a_constant_in_small_letters_is_no_field() -> None:
    types = types_of("m/msg/A", "ros2msg", "int32 a = 5\nuint8 lower=1\nstring text=a b\nfloat64 value\n")
    assert types.deserialize(HEADER + struct.pack("<d", 9.5)).value == 9.5


@pytest.mark.parametrize("apart", [False, True])
def test_an_enumeration_is_its_number(apart: bool) -> None:
    enum = "enum Gear { PARK, /* a */\n DRIVE };"
    own = f"{LINE}\nIDL: my_msgs/msg/Gear\nmodule my_msgs {{ module msg {{ {enum} }}; }};\n" if apart else ""
    before = "" if apart else enum
    text = IDL.replace("struct Speed {", f"{before} struct Speed {{ my_msgs::msg::Gear gear; Gear all[2];") + own
    message = types_of("my_msgs/msg/Speed", "ros2idl", text).deserialize(HEADER + struct.pack("<3I4xd", 1, 0, 1, 9.5))
    assert (message.gear, list(message.all), message.value) == (1, [0, 1], 9.5)


@pytest.mark.parametrize("name", ["", "A", "../etc/passwd", "a/msg/B\nimport os", "a/b/c/d/e", "a/msg/", "1/2/3"])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(BagError, match="is no name of a message type"):
        types_of(name, "ros2msg", "float64 a\n")


@given(st.sampled_from(["ros2msg", "ros2idl", "jsonschema"]), st.text(max_size=200))
@example("ros2msg", "float64 a 1e999")
@example("ros2msg", 'string A="""\\"; import os')
def test_no_text_whatever_ends_in_anything_but_types_or_one_line(encoding: str, text: str) -> None:
    said = ""
    try:
        types_of("m/msg/A", encoding, text)
    except BagError as error:
        said = str(error)
    assert "\n" not in said


def test_a_definition_comes_with_what_it_depends_on() -> None:
    text, digest = definition_of("geometry_msgs/msg/TwistStamped")
    assert "MSG: builtin_interfaces/Time" in text
    assert digest.startswith("RIHS01_")
    again = types_of("geometry_msgs/msg/TwistStamped", "ros2msg", text)
    assert again.store.hash_rihs01(again.name) == digest


def test_padding_that_the_middleware_leaves_at_the_end_is_no_damage_but_more_is() -> None:
    """`rclpy.serialization` leaves up to 12 bytes of whatever was in memory behind an empty JointState."""
    kind = types_of("sensor_msgs/msg/JointState")
    message = bytes.fromhex("000100000000000000000000010000000000000000000000000000000000000000000000")
    for padding in (0, 4, 12, 19):
        assert list(kind.deserialize(message + b"x" * padding).velocity) == []
    for padding in (20, 100):
        with pytest.raises(Exception, match="size mismatch"):
            kind.deserialize(message + b"x" * padding)
