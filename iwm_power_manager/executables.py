# SPDX-License-Identifier: Apache-2.0
"""What the installed commands run.

To import compiled libraries takes seconds, and Ctrl-C would end that in a traceback from wherever it was. So a command
imports its module here, and until that is done Ctrl-C ends the process on the spot. What a command needs for its work
but not for `--help`, it names in `NEEDS` and imports where it is used: `--help` then answers at once.
"""

from __future__ import annotations

import importlib
import os
import select
import signal
import sys
from functools import partial

from iwm_power_manager.exit_codes import DONE, INTERRUPTED

#: Options that are answered without what the work needs.
ASK_ONLY = frozenset({"-h", "--help", "--version"})


def leave(module: str, interrupted: int) -> int:
    """`run`; where it has used DDS, the interpreter's own end is bounded in time as well."""
    code = run(module, interrupted)
    ending = sys.modules.get("iwm_power_manager.ros.ending")
    return ending.at_exit(code) if ending is not None else code


def run(module: str, interrupted: int) -> int:
    """Import a module and run its `main`.

    Parameters
    ----------
    module : full name
    interrupted : exit code on Ctrl-C, as long as `main` does not deal with it

    Returns
    -------
    int
        Exit code; as if all was done, where whoever reads the output has had enough of it, as `head` has.
    """
    try:
        try:
            return _ended(module, interrupted)
        finally:
            if sys.stdout:
                sys.stdout.flush()
    except BrokenPipeError:
        if not _nobody_reads():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what the interpreter flushes at its end
        return DONE


def _nobody_reads() -> bool:
    """Whether standard output is a pipe that was closed at its other end."""
    output = select.poll()
    output.register(1, 0)
    return any(event & select.POLLERR for _, event in output.poll(0))


def _ended(module: str, interrupted: int) -> int:
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where it is ignored, as under nohup
        # No exception: libraries make something else of one that meets them half imported.
        signal.signal(signal.SIGINT, lambda *_: os._exit(interrupted))
    command = importlib.import_module(module)
    if not ASK_ONLY.intersection(sys.argv[1:]):
        for name in getattr(command, "NEEDS", ()):
            importlib.import_module(name)
    main = command.main
    try:
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return int(main())
    except KeyboardInterrupt:
        return interrupted
    finally:
        # The work is done. A terminal and `ros2 launch` may both pass one Ctrl-C on, and the second would kill an
        # interpreter that is clearing up, which looks like a crash.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)


import_cycle = partial(leave, "iwm_power_manager.tools.import_cycle", INTERRUPTED)
import_motor = partial(leave, "iwm_power_manager.tools.import_motor", INTERRUPTED)
power_manager = partial(leave, "iwm_power_manager.nodes.power_manager", DONE)
recorder = partial(leave, "iwm_power_manager.nodes.recorder", DONE)
replay = partial(leave, "iwm_power_manager.tools.replay", INTERRUPTED)
set_parameter = partial(leave, "iwm_power_manager.tools.set_parameter", INTERRUPTED)
solve_policy = partial(leave, "iwm_power_manager.tools.solve_policy", INTERRUPTED)
watch_car = partial(leave, "iwm_power_manager.tools.watch_car", INTERRUPTED)
