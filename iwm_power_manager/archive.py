# SPDX-License-Identifier: Apache-2.0
"""NumPy archives (.npz) from strangers: bounded before anything is unpacked, without pickles."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import read_bytes

#: Bytes of all arrays of an archive, unpacked, and members in it.
MAX_ARRAY_BYTES = 512 * 2**20
MAX_MEMBERS = 64
#: What the tables of this package shrink to is a tenth; zeros in a row shrink to a thousandth.
MAX_RATIO = 200
_RATIO_COUNTS_ABOVE = 16 * 2**20


def read_npz(path: Path | str, wanted: Collection[str], kind: str) -> dict[str, NDArray[Any]]:
    """The wanted members of an archive, those it has; `kind` is what errors call it.

    Raises
    ------
    ConfigError
        It cannot be read, is no archive or a damaged one, or would take more than the limits above; it is refused by
        what it states, before anything is unpacked, and what it states is what is unpacked at most.
    """
    data = read_bytes(path)
    if not data:
        raise ConfigError(path, "", "is empty")
    if not data.startswith(b"PK\x03\x04"):
        raise ConfigError(path, "", f"is no {kind}")
    # Whatever is wrong with the bytes, and zip and npy fail in a dozen ways, it is one thing to the user.
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            problem = _too_much(entries)
            if problem:
                raise ConfigError(path, "", problem)
            names = [entry.filename.removesuffix(".npy") for entry in entries]
            return {name: _array(archive, e) for name, e in zip(names, entries, strict=True) if name in wanted}
    except ConfigError:
        raise
    except Exception as error:  # noqa: BLE001
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(path, "", f"is damaged or truncated: {reason}") from None


def _too_much(entries: list[zipfile.ZipInfo]) -> str:
    """Why an archive is refused by its directory alone; "" if it is not."""
    if len(entries) > MAX_MEMBERS:
        return f"holds {len(entries)} members, more than {MAX_MEMBERS}"
    if len({entry.filename for entry in entries}) < len(entries):
        return "holds a member twice"
    size = sum(entry.file_size for entry in entries)
    if size > MAX_ARRAY_BYTES:
        return f"would take {size:,} bytes, more than {MAX_ARRAY_BYTES:,}"
    packed = sum(entry.compress_size for entry in entries)
    if size > _RATIO_COUNTS_ABOVE and size > MAX_RATIO * packed:
        return f"would take {size:,} bytes, more than {MAX_RATIO} times what it has"
    return ""


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{entry.filename} is packed in an unknown way")
    stream = io.BytesIO(archive.read(entry))
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{entry.filename} has the unknown version {version}")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if dtype.hasobject:
        raise ValueError(f"{entry.filename} holds objects")
    # NumPy would set the stated size aside before it looks for the bytes.
    if math.prod(shape) * dtype.itemsize != len(stream.getbuffer()) - stream.tell():
        raise ValueError(f"{entry.filename} states {shape} values, and holds others")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)
