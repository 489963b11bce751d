"""The fast JointState codec against the generated one of rosbags."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.bags.definitions import typestore
from iwm_power_manager.signals.joint_state import JOINT_STATE, JointStateDecoder, JointStateEncoder

FIELDS = ("position", "velocity", "effort")
NAMES = st.lists(st.text("abcdefgh_", min_size=1, max_size=9), min_size=1, max_size=9, unique=True)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)


def generated(stamp_ns: int, names: list[str], frame_id: str = "", **fields: list[float]) -> bytes:
    types = typestore().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    numbers = {field: np.array(fields.get(field, []), dtype=np.float64) for field in FIELDS}
    message = types[JOINT_STATE](types["std_msgs/msg/Header"](stamp, frame_id), names, **numbers)
    return bytes(typestore().serialize_cdr(message, JOINT_STATE))


@given(names=NAMES, stamp=STAMPS, field=st.sampled_from(FIELDS), data=st.data())
def test_encoding_equals_the_generated_one_and_decoding_gives_the_numbers_back(
    names: list[str], stamp: int, field: str, data: st.DataObject
) -> None:
    values = data.draw(st.lists(st.floats(allow_nan=False), min_size=len(names), max_size=len(names)))
    encoded = JointStateEncoder(names, field)(stamp, values)
    assert encoded == generated(stamp, names, **{field: values})
    decode = JointStateDecoder(field)
    for _ in range(2):  # the first call learns the names, the second uses them
        assert decode(encoded) == (stamp, tuple(names), tuple(values))


@given(first=NAMES, second=NAMES, frame_id=st.text("xyz", max_size=5))
def test_a_decoder_notices_other_names_other_frames_and_other_fields(
    first: list[str], second: list[str], frame_id: str
) -> None:
    decode = JointStateDecoder("effort")
    for names, frame in ((first, ""), (second, ""), (second, frame_id), (first, frame_id)):
        values = [float(i) for i in range(len(names))]
        data = generated(7, names, frame, effort=values, velocity=[0.5] * len(names))
        assert decode(data) == (7, tuple(names), tuple(values))
        assert decode(data) == (7, tuple(names), tuple(values))


def test_names_without_values_and_damaged_bytes_are_refused() -> None:
    decode = JointStateDecoder("position")
    with pytest.raises(ValueError, match="2 names and 0 values"):
        decode(generated(0, ["a", "b"], effort=[1.0, 2.0]))
    with pytest.raises(Exception):  # noqa: B017 - whatever the generated decoder raises
        decode(b"\0\1\0\0\1")
