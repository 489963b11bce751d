# SPDX-License-Identifier: Apache-2.0
"""Child processes that are started, watched and stopped together, and leave nothing running behind."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from iwm_power_manager.errors import FailedError

_LAST_LINES = 12
#: How long a child that is asked to end (SIGTERM) may take before it is killed.
ASK_S = 5.0


class ChildError(FailedError):
    """A child process has failed; `last_lines` is how its output ended."""

    def __init__(self, problem: str, last_lines: Sequence[str]) -> None:
        self.last_lines = list(last_lines)
        super().__init__(problem)


class Child:
    """A process whose output goes to a file.

    Parameters
    ----------
    name : what messages call it
    command : program and arguments
    environment : all of it
    log : file that gets standard error, and standard output unless `stdout` says otherwise
    stdout : descriptor for its standard output
    """

    def __init__(
        self, name: str, command: Sequence[str], environment: Mapping[str, str], log: Path, stdout: int | None = None
    ) -> None:
        self.name = name
        self.log = log
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                command,
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=output if stdout is None else stdout,
                stderr=output,
            )

    @property
    def running(self) -> bool:
        """It has not ended yet."""
        return self.process.poll() is None

    def check(self) -> None:
        """`ChildError` if it has ended with an error."""
        code = self.process.poll()
        if code:
            how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            raise ChildError(f"the {self.name} {how} ({self.log})", self.last_lines())

    def check_running(self) -> None:
        """`ChildError` if it has ended at all."""
        self.check()
        if not self.running:
            raise ChildError(f"the {self.name} ended too early ({self.log})", self.last_lines())

    def last_lines(self) -> list[str]:
        """How its log ends."""
        return self.log.read_text("utf-8", "replace").splitlines()[-_LAST_LINES:]

    def interrupt(self, patience_s: float = 15.0) -> None:
        """Ask it to end as Ctrl-C does and wait; `ChildError` if it ends with an error, or not at all."""
        if self.running:
            self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.kill()
            raise ChildError(
                f"the {self.name} did not end within {patience_s:g} s ({self.log})", self.last_lines()
            ) from None
        self.check()

    def kill(self) -> None:
        """End it, first by asking."""
        if not self.running:
            return
        self.process.terminate()
        try:
            self.process.wait(ASK_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Children:
    """Processes of one run. Leaving the block ends every one that still runs, the last started first."""

    def __init__(self, environment: Mapping[str, str], logs: Path) -> None:
        self._environment = environment
        self._logs = logs
        self._children: list[Child] = []

    def start(self, name: str, command: Sequence[str], stdout: int | None = None) -> Child:
        """Start one; its log is `<name>.log`."""
        child = Child(name, command, self._environment, self._logs / f"{name.replace(' ', '_')}.log", stdout)
        self._children.append(child)
        return child

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # All at once first: one that waits for another would cost its whole patience.
        for child in self._children:
            if child.running:
                child.process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + 10.0
        while any(child.running for child in self._children) and time.monotonic() < deadline:
            time.sleep(0.02)
        for child in reversed(self._children):
            child.kill()
