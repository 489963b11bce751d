# SPDX-License-Identifier: Apache-2.0
"""A DDS domain that no other run on this machine uses.

Two runs on one domain hear each other: a second car on the same topics. Each run holds a lock file for its domain, and
the tests do the same in the same folder.
"""

from __future__ import annotations

import fcntl
import os
import random
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from iwm_power_manager.errors import IwmError

#: Above 101 the ports of a domain reach into those that Linux hands out to clients.
DOMAINS = range(1, 102)


@contextmanager
def claimed_domain() -> Iterator[int]:
    """A domain nobody else has claimed; free again at the end of the block, or when the process ends.

    Raises
    ------
    IwmError
        All are claimed.
    """
    folder = Path(tempfile.gettempdir()) / f"iwm_power_manager-domains-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        with (folder / str(domain)).open("w") as claim:
            try:
                fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    raise IwmError(f"every DDS domain from {DOMAINS[0]} to {DOMAINS[-1]} is in use on this machine")
