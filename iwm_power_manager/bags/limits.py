# SPDX-License-Identifier: Apache-2.0
"""What a bag may ask of this machine: the limits of `docs/files.md` for bags, and nothing else decides them.

Neither library has such limits: `rosbags` and `mcap` decompress whatever a frame says (`storage_mcap.decompress`,
`stream_reader.get_chunk_data_stream`), and a file of kilobytes may say gigabytes.
"""

from __future__ import annotations

import io
import shutil
import stat
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from iwm_power_manager.errors import BagError
from iwm_power_manager.share import did_you_mean

_MEBIBYTE = 1024 * 1024

#: One chunk, or one compressed message, uncompressed.
MAX_CHUNK_BYTES = 256 * _MEBIBYTE
#: What is decompressed, by what it was decompressed from; small things may be more.
MAX_RATIO = 1000
FREE_BYTES = 16 * _MEBIBYTE
#: Frames of lz4 in one chunk: what is behind each is copied.
MAX_LZ4_FRAMES = 64
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

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
#: How a compressed message begins: CDR begins otherwise, so no metadata is needed.
PACKED = {ZSTD_MAGIC: "zstd", b"\x04\x22\x4d\x18": "lz4"}


def check_exists(path: Path) -> None:
    """Refuse a path that is nowhere, or that nobody may look at, with the reason; `BagError`."""
    try:
        path.stat()
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
    try:
        status = path.stat()
        if folder is not None and not path.resolve().is_relative_to(folder.resolve()):
            raise BagError(f"{path}: leads out of the bag")
    except (OSError, ValueError, RuntimeError) as error:  # the latter for names no file can have, and circles of links
        raise BagError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
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
    raw = _decompressed(compression, data, most + 1 if size is None else size + 1, size)
    if len(raw) > most:
        raise BagError(f"{len(data)} bytes hold more than {most}")
    if (len(raw) != size) if size is not None else not raw:
        raise BagError("cannot be decompressed")
    return raw


def _decompressed(compression: str, data: bytes, most: int, size: int | None) -> bytes:
    import lz4.frame
    import zstandard

    try:
        if compression == "":
            return data[:most]
        if compression == "lz4":
            raw, rest = b"", data
            for _ in range(MAX_LZ4_FRAMES):
                decoder = lz4.frame.LZ4FrameDecompressor()
                raw += decoder.decompress(rest, max_length=most - len(raw))
                rest = decoder.unused_data or b""
                if not rest or len(raw) == most:
                    break
            return raw
        if compression == "zstd":
            stated = zstandard.frame_content_size(data)
            if 0 <= stated < most:
                with suppress(zstandard.ZstdError):  # allocates what the frame says, which is allowed
                    return bytes(_zstd().decompress(data, allow_extra_data=stated == size))
            with _zstd().stream_reader(io.BytesIO(data), read_across_frames=True) as reader:
                return bytes(reader.read(most))
    except (RuntimeError, EOFError, MemoryError, zstandard.ZstdError):
        raise BagError("cannot be decompressed") from None
    raise BagError(f"is compressed with {compression!r}; known: zstd, lz4")


@lru_cache(maxsize=1)
def _zstd() -> Any:
    import zstandard

    return zstandard.ZstdDecompressor(max_window_size=1 << 27)


def decompress_file(path: Path, target: Path) -> str:
    """Decompress a `.zstd` file to the disk as far as it goes; returns what is wrong with it, "" for nothing.

    Raises
    ------
    BagError
        It holds more than its size, or the disk, allows, or nothing.
    """
    import zstandard

    size = regular_file(path)
    most = min(FREE_BYTES + MAX_RATIO * size, shutil.disk_usage(target.parent).free // 2)
    written, problem = 0, ""
    try:
        with (
            path.open("rb") as source,
            target.open("xb") as sink,
            _zstd().stream_reader(source, read_across_frames=True) as reader,
        ):
            while piece := reader.read1(1 << 20):  # `read` would lose what stands before a damaged place
                written += len(piece)
                if written > most:
                    raise BagError(f"{path}: holds more than {most} bytes, from {size}")
                sink.write(piece)
    except zstandard.ZstdError as error:
        problem = f"is damaged: {error}"
    except OSError as error:
        raise BagError(f"{path}: cannot be decompressed: {error.strerror or error}") from None
    if not written:
        raise BagError(f"{path}: {problem or 'holds nothing that can be decompressed'}")
    return problem
