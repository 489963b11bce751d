# SPDX-License-Identifier: Apache-2.0
"""Disks that are full, and folders that may not be written, also for tests that run as root."""

from __future__ import annotations

import functools
import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

_NOBODY = 65534


@contextmanager
def private_folder() -> Iterator[Path]:
    """A folder whose permissions count: as root, which may write everywhere, this process is nobody meanwhile."""
    root = os.geteuid() == 0
    # Not below tmp_path, which nobody may not enter.
    with tempfile.TemporaryDirectory(prefix="iwm-", ignore_cleanup_errors=True) as name:
        if root:
            os.chown(name, _NOBODY, _NOBODY)
            os.seteuid(_NOBODY)
        try:
            yield Path(name)
        finally:
            if root:
                os.seteuid(0)


def on_small_disk(folder: Path, options: str, command: Sequence[str]) -> list[str]:
    """The command with a tmpfs of its own mounted at `folder`, which is gone with the process.

    Skips the test where mounting is not allowed.
    """
    if not _can_mount():
        pytest.skip("neither root nor a user namespace may mount here")
    return [*_own_mounts(), f'mount -t tmpfs -o {options} none "$0" && exec "$@"', str(folder), *command]


def _own_mounts() -> list[str]:
    users = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    return ["unshare", "--mount", *users, "sh", "-c"]


@functools.cache
def _can_mount() -> bool:
    with tempfile.TemporaryDirectory() as folder:
        command = [*_own_mounts(), 'mount -t tmpfs -o size=64k none "$0"', folder]
        try:
            return subprocess.run(command, capture_output=True, check=False).returncode == 0
        except FileNotFoundError:
            return False
