# SPDX-License-Identifier: Apache-2.0
"""NumPy archives from strangers: what they would take is refused before it is taken."""

from __future__ import annotations

import io
import tracemalloc
import zipfile

import numpy as np
import pytest

from iwm_power_manager import archive
from iwm_power_manager.errors import ConfigError


def _npy(array):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=(1, 0), allow_pickle=True)
    return stream.getvalue()


def _zip(path, members, **options):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, **options) as output:
        for name, data in members.items():
            output.writestr(name, data)
    return path


def _refused(path):
    with pytest.raises(ConfigError) as caught:
        archive.read_npz(path, ("a",), "table")
    assert str(caught.value).isprintable()
    return str(caught.value)


def test_the_wanted_members_come_back(tmp_path):
    path = tmp_path / "t.npz"
    np.savez_compressed(path, a=np.arange(3.0), b=np.arange(2), c=np.zeros((2, 2), order="F"))
    found = archive.read_npz(path, ("a", "c", "missing"), "table")
    assert sorted(found) == ["a", "c"]
    assert found["a"].tolist() == [0.0, 1.0, 2.0]


def test_a_bomb_is_refused_without_taking_its_memory(tmp_path):
    zeros = _npy(np.zeros(8 * 2**20))  # 64 MiB shrink to 64 kB
    small = _zip(tmp_path / "small.npz", {"a.npy": zeros})
    many = _zip(tmp_path / "many.npz", {f"{i}.npy": zeros for i in range(9)})
    tracemalloc.start()
    assert "more than 200 times what it has" in _refused(small)
    assert "would take 603,980,928 bytes, more than 536,870,912" in _refused(many)
    assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    tracemalloc.stop()


def test_a_header_that_states_more_than_there_is_takes_no_memory(tmp_path):
    header = _npy(np.zeros(1000)).replace(b"(1000,), }      ", b"(9999999999,), }")
    tracemalloc.start()
    assert "states (9999999999,) values, and holds others" in _refused(_zip(tmp_path / "t.npz", {"a.npy": header}))
    assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    tracemalloc.stop()


def test_what_is_no_archive_of_plain_arrays_is_refused(tmp_path):
    path = tmp_path / "t.npz"
    for data, words in ((b"", "is empty"), (b"text", "is no table"), (b"PK\x03\x04 and no more", "is damaged")):
        path.write_bytes(data)
        assert words in _refused(path)
    assert "holds objects" in _refused(_zip(path, {"a.npy": _npy(np.array([{}], dtype=object))}))
    assert "holds 65 members, more than 64" in _refused(_zip(path, {f"{i}.npy": b"" for i in range(65)}))
    assert "is damaged" in _refused(_zip(path, {"a.npy": b"no array"}))
    assert "is damaged" in _refused(_zip(path, {"a.npy": _npy(np.zeros(3))[:-8]}))
    assert "unknown version (3, 0)" in _refused(_zip(path, {"a.npy": b"\x93NUMPY\x03\x00" + _npy(np.zeros(1))[8:]}))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as output:
        output.writestr("a.npy", _npy(np.zeros(3)))
    assert "packed in an unknown way" in _refused(path)
    with zipfile.ZipFile(path, "w") as output:
        output.writestr("a.npy", _npy(np.zeros(3)))
        with pytest.warns(UserWarning, match="Duplicate"):
            output.writestr("a.npy", _npy(np.ones(3)))
    assert "holds a member twice" in _refused(path)
