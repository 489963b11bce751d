# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM, at any moment."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from iwm_power_manager.ros.interruption import Interruption

#: Waits over and over, so that a signal meets every place of it; a handler that can block its own thread hangs.
MEET_SIGNALS = """
import random, signal
from iwm_power_manager.ros.interruption import Interruption
for _ in range(20_000):
    interruption = Interruption(started=True)
    signal.signal(signal.SIGALRM, interruption)
    signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, 1e-4))
    while not interruption.wait(1e-5):
        pass
print("all met")
"""


@pytest.fixture
def interruption() -> Iterator[Interruption]:
    """Installed for one test."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    new = Interruption()
    new.install()
    yield new
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_signal_may_come_at_any_moment_of_a_wait() -> None:
    done = subprocess.run([sys.executable, "-c", MEET_SIGNALS], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "all met\n"


def test_wait_ends_early_when_asked_and_else_takes_its_time(interruption: Interruption) -> None:
    interruption.started = True
    began_s = time.monotonic()
    assert not interruption.wait(0.12)
    assert time.monotonic() - began_s >= 0.12
    os.kill(os.getpid(), signal.SIGTERM)
    assert interruption.wait(3600.0)


def test_the_first_signal_of_a_start_ends_it_and_the_second_does_not_disturb_its_end(
    interruption: Interruption,
) -> None:
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGINT)
    assert interruption.requested
