# SPDX-License-Identifier: Apache-2.0
"""A child process that compiles what the power manager needs, while the node drives with the law as plain Python.

A process of its own, since numba keeps the interpreter's lock busy for seconds. What it has compiled is in the kernel
cache afterwards, from where the node reads it. It ends with the node, however that ends: its standard input is closed
then.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

from iwm_power_manager.control.execution import COMPILED, Execution
from iwm_power_manager.errors import IwmError, one_line
from iwm_power_manager.ros.diagnostics import ERROR, OK, WARN, Status

#: The child gives way to whatever else runs on the machine.
NICE = 10

_CHILD = """\
import json, sys
sys.path[:], values = map(json.loads, sys.argv[1:])
from iwm_power_manager.nodes import compiling
compiling.compile_and_end(values)
"""


class Compiling:
    """The child process, and a thread that waits for it and loads what it has compiled.

    Parameters
    ----------
    values : of the node's parameters
    load : reads what is needed from the kernel cache; raises if it is not there

    Attributes
    ----------
    ended : there is nothing more to wait for
    problem : why there is no compiled law then; "" if there is one
    """

    def __init__(self, values: Mapping[str, Any], load: Callable[[], None]) -> None:
        self.ended = False
        self.problem = ""
        self._process = subprocess.Popen(
            [sys.executable, "-c", _CHILD, json.dumps(sys.path), json.dumps(dict(values), default=list)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            process_group=0,  # Ctrl-C is the node's affair
        )
        threading.Thread(target=self._wait, args=(load,), name="compiling", daemon=True).start()

    def _wait(self, load: Callable[[], None]) -> None:
        assert self._process.stderr is not None
        said = self._process.stderr.read().decode(errors="replace").strip().splitlines()
        try:
            if code := self._process.wait():
                how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
                raise IwmError(f"the process that compiles {how}")
            load()
        except Exception as error:  # noqa: BLE001 - whatever it is, the node goes on without
            self.problem = one_line(": ".join([str(error), *said[-1:]]))
        self.ended = True

    def stop(self) -> None:
        """End the child process, if it has not ended."""
        self._process.kill()


def law_status(execution: Execution, compiling: Compiling | None) -> Status:
    """What `/diagnostics` says of how the law is run."""
    if execution is COMPILED:
        return Status("law", OK, "compiled", {})
    if execution.faults:
        return Status("law", ERROR, f"friction brakes alone where it fails: {'; '.join(execution.faults)}", {})
    until = compiling.problem if compiling and compiling.problem else "until a process of its own has compiled it"
    return Status("law", WARN, f"plain Python, the power split equally, {until}", {})


def compile_and_end(values: Mapping[str, Any]) -> None:
    """What the child process does: prepare as the node does, and nothing but that."""
    threading.Thread(target=_end_with_the_node, daemon=True).start()
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(NICE)
    from iwm_power_manager.nodes.preparation import prepare

    prepare(values, at_once=False)


def _end_with_the_node() -> None:
    os.read(0, 1)  # nothing is ever written: it returns when nobody can write any more
    os._exit(1)
