# SPDX-License-Identifier: Apache-2.0
"""What a bag may ask of this machine: the limits of `docs/files.md` for bags, and nothing else decides them.

Neither library has such limits: `rosbags` and `mcap` decompress whatever a frame says (`storage_mcap.decompress`,
`stream_reader.get_chunk_data_stream`), and a file of kilobytes may say gigabytes.
"""

from __future__ import annotations

import io
import os
import shutil
import stat
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import lz4.frame
import zstandard

from iwm_power_manager.errors import BagError, system_errors
from iwm_power_manager.share import did_you_mean

_MEBIBYTE = 1024 * 1024

#: One chunk, or one compressed message, uncompressed.
MAX_CHUNK_BYTES = 256 * _MEBIBYTE
#: What is decompressed, by what it was decompressed from; small things may be more.
MAX_RATIO = 1000
FREE_BYTES = 16 * _MEBIBYTE
#: Messages in one chunk, and the memory of those that wait for chunks that overlap theirs in time.
MAX_CHUNK_MESSAGES = 1_000_000
MAX_OVERLAP_BYTES = 512 * _MEBIBYTE
#: Memory one message takes besides its bytes: the tuple, its integers, the bytes object's head.
MESSAGE_OVERHEAD_BYTES = 250
#: Records at the top of one file, and channels in it.
MAX_RECORDS = 20_000_000
MAX_CHANNELS = 10_000
#: A clock that goes back by more, by the log times of one topic, was set; less is how late a message may come.
SET_BACK_NS = 1_000_000_000
#: Lines about what is wrong with one file.
MAX_NOTES = 100
#: `metadata.yaml`, the same text inside of a file, and one profile of quality of service.
MAX_METADATA_BYTES = 4 * _MEBIBYTE
MAX_QOS_BYTES = 64 * 1024
#: Instructions of sqlite's machine: a start, and more for each byte of the file.
SQLITE_INSTRUCTIONS = 100_000_000
SQLITE_INSTRUCTIONS_PER_BYTE = 100

#: How a compressed file or message begins: CDR begins otherwise, so no metadata is needed.
PACKED = {b"\x28\xb5\x2f\xfd": "zstd", b"\x04\x22\x4d\x18": "lz4"}
_ZSTD = zstandard.ZstdDecompressor(max_window_size=1 << 27)
_DAMAGED = (zstandard.ZstdError, RuntimeError, EOFError, MemoryError)


def check_exists(path: Path) -> os.stat_result:
    """What is known of a path; `BagError`, with the reason, if it is nowhere, or nobody may look at it."""
    try:
        return path.stat()
    except FileNotFoundError:
        raise BagError(f"{path}: does not exist{did_you_mean(path)}") from None
    except (OSError, ValueError) as error:  # the latter for names no file can have
        raise BagError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def regular_file(path: Path, folder: Path | None = None) -> int:
    """Size of a regular file; with `folder` one that lies in it.

    Raises
    ------
    BagError
        It is missing, a device, a pipe, a folder, or a link that leads out of the folder.
    """
    status = check_exists(path)
    if folder is not None and not path.resolve().is_relative_to(folder.resolve()):
        raise BagError(f"{path}: leads out of the bag")
    if not stat.S_ISREG(status.st_mode):
        raise BagError(f"{path}: is no regular file")
    return status.st_size


def decompress(compression: str, data: bytes, size: int | None = None) -> bytes:
    """A chunk's or a message's bytes.

    Parameters
    ----------
    compression : "", "zstd" or "lz4"
    data : compressed
    size : uncompressed, as the file says; None if it does not

    Raises
    ------
    BagError
        It is damaged, of another size, or too large.
    """
    most = min(MAX_CHUNK_BYTES, FREE_BYTES + MAX_RATIO * len(data))
    if size is not None and size > most:
        raise BagError(f"{len(data)} bytes say they hold {size}; allowed: <= {most}")
    if not compression:
        return data
    try:
        with _unpacking(compression, io.BytesIO(data)) as reader:
            raw = bytes(reader.read(most + 1 if size is None else size))
            with suppress(*_DAMAGED):  # what stands behind a whole frame and is none itself
                raw += reader.read(1)
    except _DAMAGED:
        raise BagError("cannot be decompressed") from None
    if len(raw) > most:
        raise BagError(f"{len(data)} bytes hold more than {most}")
    if (len(raw) != size) if size is not None else not raw:
        raise BagError("cannot be decompressed")
    return raw


def _unpacking(compression: str, source: IO[bytes]) -> Any:
    if compression not in PACKED.values():
        raise BagError(f"is compressed with {compression!r}; known: zstd, lz4")
    return _ZSTD.stream_reader(source, read_across_frames=True) if compression == "zstd" else lz4.frame.open(source)


def decompress_file(path: Path, target: Path) -> str:
    """Decompress a `.zstd` or `.lz4` file to the disk as far as it goes; returns what is wrong with it, "" for nothing.

    Raises
    ------
    BagError
        It holds more than its size, or the disk, allows, or nothing.
    """
    size = regular_file(path)
    most = min(FREE_BYTES + MAX_RATIO * size, shutil.disk_usage(target.parent).free // 2)
    written, problem = 0, ""
    with system_errors(path, "cannot be decompressed"), path.open("rb") as source, target.open("xb") as sink:
        reader = _unpacking(PACKED.get(source.read(4), "zstd"), source)
        source.seek(0)
        try:
            while piece := reader.read1(1 << 20):  # `read` would lose what stands before a damaged place
                written += len(piece)
                if written > most:
                    raise BagError(f"{path}: holds more than {most} bytes, from {size}")
                sink.write(piece)
        except _DAMAGED as error:
            problem = f"is damaged: {error}"
    if not written:
        raise BagError(f"{path}: {problem or 'holds nothing that can be decompressed'}")
    return problem
