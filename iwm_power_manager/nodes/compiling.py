# SPDX-License-Identifier: Apache-2.0
"""A child process that compiles what the power manager needs, while the node drives with the law as plain Python.

A process of its own, since numba keeps the interpreter's lock busy for seconds. What it has compiled is in the kernel
cache afterwards, from where the node reads it. It ends with the node, however that ends: its standard input is closed
then.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from iwm_power_manager.control.execution import COMPILED, Execution
from iwm_power_manager.errors import IwmError, one_line
from iwm_power_manager.ros.diagnostics import ERROR, OK, WARN, Status

#: The child gives way to whatever else runs on the machine.
NICE = 10

#: What it does first makes it an ordinary process that gives way to others, in memory, too, as far as the system lets
#: it, and ends it with the node.
_CHILD = f"""\
import contextlib, json, os, sys, threading
with contextlib.suppress(OSError):
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as first_to_go:
    first_to_go.write("1000")
os.nice({NICE})
def end_with_the_node():
    os.read(0, 1)  # nothing is ever written: it returns when nobody can write any more
    os._exit(1)
threading.Thread(target=end_with_the_node, daemon=True).start()
sys.path[:], values = map(json.loads, sys.argv[1:])
from iwm_power_manager.nodes.preparation import prepare
prepare(values, at_once=False)
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
        self._began_s = time.monotonic()
        self._process: subprocess.Popen[bytes] | None = None
        optimised = ["-O"] * sys.flags.optimize  # other code, by another name in the cache
        given = json.dumps(sys.path), json.dumps(dict(values), default=list)
        try:
            self._process = subprocess.Popen(
                [sys.executable, *optimised, "-c", _CHILD, *given],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                process_group=0,  # Ctrl-C is the node's affair
            )
            threading.Thread(target=self._wait, args=(self._process, load), name="compiling", daemon=True).start()
        except Exception as error:  # noqa: BLE001 - no process, thread, memory or Python: it drives all the same
            self.stop()
            self.problem = one_line(f"no process can compile it: {error}")
            self.ended = True

    def _wait(self, process: subprocess.Popen[bytes], load: Callable[[], None]) -> None:
        assert process.stderr is not None
        said = process.stderr.read().decode(errors="replace").strip().splitlines()
        try:
            if code := process.wait():
                how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
                raise IwmError(f"the process that compiles {how}")
            load()
        except Exception as error:  # noqa: BLE001 - whatever it is, the node goes on without
            self.problem = one_line(": ".join([str(error), *said[-1:]]))
        self.ended = True

    def stop(self) -> None:
        """End the child process, if it has not ended."""
        if self._process:
            self._process.kill()

    @property
    def elapsed_s(self) -> float:
        """Time since it began."""
        return time.monotonic() - self._began_s


def law_status(execution: Execution, compiling: Compiling | None) -> Status:
    """What `/diagnostics` says of how the law is run."""
    if execution is COMPILED:
        return Status("law", OK, "compiled", {})
    if execution.faults:
        return Status("law", ERROR, f"friction brakes alone where it fails: {'; '.join(execution.faults)}", {})
    until, values = "until a process of its own has compiled it", {}
    if compiling and compiling.problem:
        until = compiling.problem
    elif compiling:
        values["compiling for, s"] = f"{compiling.elapsed_s:.0f}"
    return Status("law", WARN, f"plain Python, the power split equally, {until}", values)
