# SPDX-License-Identifier: Apache-2.0
"""Exit codes: one meaning over all commands and nodes.

Nothing is imported here: `executables` needs a code before it knows what it runs.
"""

#: All was done. For a node also: it was asked to end, by Ctrl-C or SIGTERM; `ros2 launch` calls other codes a crash.
DONE = 0
#: It was tried and did not work out (a full disk, a node that does not answer), or the answer is no (`--compare`
#: differs, a bound is missed, a scenario falls short).
FAILED = 1
#: Arguments, a parameter, or a file that was given are refused: the same call will be refused again.
BAD_INPUT = 2
#: There is no answer: the recording does not have what it would need.
CANNOT_TELL = 3
#: Ctrl-C, as a shell has it; not of nodes.
INTERRUPTED = 130
