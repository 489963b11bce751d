# SPDX-License-Identifier: Apache-2.0
"""Command `replay`: the control law over a recorded drive, compared, published, or asked "what if".

Exit codes: 0 done; 1 recomputed and recorded commands differ beyond the tolerance; 2 bad arguments or files;
3 there is no answer in the bag; 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from iwm_power_manager.command_line import refuse_without_effect
from iwm_power_manager.control.strategies import drivable
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import check_number
from iwm_power_manager.tools.command import described, ended, output_file
from iwm_power_manager.tools.options import number, whole

_DESCRIPTION = """\
Run the control law over a recorded drive, without DDS and without a clock: the same bag gives the same bytes every
time. Any rosbag2 recording will do, MCAP or sqlite3; other cars' topics and units are mapped by a YAML file.
"""

_EXAMPLES = """\
examples:
  Is the law still the one that was recorded? Exit code 1 if not.
    replay drive_01 --compare
  A new bag with the same inputs and the commands of another policy:
    replay drive_01 --policy policies/new.npz --strategy sdp --output drive_01_new
  What would equal split have consumed?
    replay drive_01 --what-if jalalmaab_2015 --strategy equal sdp
  Drive the real node with it, at half speed:
    replay drive_01 --publish --rate 0.5

exit codes: 0 done, 1 recomputed and recorded differ (--compare), 2 bad arguments or files, 3 they differ, but the
recording lacks steps (it began in the middle of a run) whose memory may explain all of it, or the car does not move
(--what-if), 130 interrupted
"""


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    options = _parser().parse_args(args)

    def work() -> int:
        _check(options)
        from iwm_power_manager.tools.replay_run import run

        return run(options)

    return ended("replay", work, quiet=options.quiet)


def _parser() -> argparse.ArgumentParser:
    parser = described("replay", _DESCRIPTION, _EXAMPLES)
    strategies = ", ".join(drivable())
    parser.add_argument("bag", metavar="BAG", help="folder of the bag, or one .mcap or .db3 file")
    law = parser.add_argument_group("the law; what is not given comes from the bag, else from the package")
    law.add_argument("--vehicle", metavar="YAML", help="the car")
    law.add_argument("--policy", metavar="FILE", help="policy file, or folder of policies over friction")
    law.add_argument("--strategy", metavar="NAME", nargs="+", help=strategies)
    law.add_argument("--friction", type=number(0.05, 1.5), metavar="MU", help="peak friction the strategy assumes")
    law.add_argument("--set", dest="settings", metavar="NAME=VALUE", action="append", default=[], help="a setting")
    law.add_argument("--mapping", metavar="YAML", help="fields and units of another car's bag (config/signals/)")
    out = parser.add_argument_group("results")
    out.add_argument("--output", metavar="DIR", help="write a bag: inputs as recorded, commands recomputed")
    out.add_argument("--compare", action="store_true", help="recomputed against recorded; exit code 1 if they differ")
    out.add_argument("--tolerance", type=number(0.0, 1e9), default=0.0, metavar="X", help="difference that is none")
    out.add_argument(
        "--what-if",
        metavar="YAML",
        nargs="?",
        const="",
        help="energy this car would have taken, for each --strategy; default: the car of --vehicle, else of the bag",
    )
    out.add_argument("--json", type=output_file, metavar="FILE", help="write the result as JSON; - for standard output")
    out.add_argument("--quiet", action="store_true", help="no progress bar")
    play = parser.add_argument_group("publishing")
    seconds = number(0.0, 1e9)
    play.add_argument("--publish", action="store_true", help="publish the inputs and /clock instead of computing")
    play.add_argument("--rate", type=number(0.001, 1000.0), default=1.0, metavar="X", help="times real time")
    play.add_argument("--step", action="store_true", help="go on by 10 ms at each Enter")
    play.add_argument("--start", type=seconds, default=0.0, metavar="S", help="seconds into the bag to begin at")
    play.add_argument("--end", type=seconds, metavar="S", help="seconds into the bag to end at")
    play.add_argument("--loop", action="store_true", help="begin again at the end")
    play.add_argument("--listeners", type=whole(0, 1000), default=0, metavar="N", help="wait for so many of each topic")
    play.add_argument("--topics", nargs="+", metavar="TOPIC", help="publish these only; default: all but the commands")
    return parser


def _check(options: argparse.Namespace) -> None:
    if options.publish and (options.output or options.compare or options.what_if is not None):
        raise ConfigError("arguments", "--publish", "excludes --output, --compare and --what-if")
    if options.what_if is not None and (options.output or options.compare):
        raise ConfigError("arguments", "--what-if", "excludes --output and --compare")
    if options.what_if and options.vehicle:
        raise ConfigError(
            "arguments", "--what-if", f"names another car than --vehicle: {options.what_if}", "one of them"
        )
    if options.what_if is None and len(options.strategy or []) > 1:
        raise ConfigError("arguments", "--strategy", "several make sense with --what-if only")
    only_then = "it is for --publish"
    played = dict.fromkeys(
        ("--rate", "--step", "--start", "--end", "--loop", "--listeners", "--topics"), (options.publish, only_then)
    )
    not_played = "--publish computes nothing"
    computed = dict.fromkeys(
        ("--vehicle", "--policy", "--strategy", "--friction", "--set", "--json", "--quiet"),
        (not options.publish, not_played),
    )
    refuse_without_effect(options, played | computed | {"--tolerance": (options.compare, "it is for --compare")})
    if options.end is not None:
        check_number("arguments", "--end", options.end, options.start, above=True)


if __name__ == "__main__":
    sys.exit(main())
