# SPDX-License-Identifier: Apache-2.0
"""Drive the scenarios of real roads and say what came out: `make roads`, `python -m campaigns.roads --help`.

Exit codes: 0 every requirement is met; 1 one is not; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from campaigns.road_page import page, unknown
from campaigns.unknown_friction import all_cells, all_jumped, differs, savings
from iwm_power_manager.command_line import CommandParser, refuse_without_effect
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, drivable
from iwm_power_manager.exit_codes import DONE, FAILED
from iwm_power_manager.files import atomic_write
from iwm_power_manager.share import share_path
from iwm_power_manager.tools.command import ended, write_json
from iwm_sim.road_report import text
from iwm_sim.road_run import RoadResult, check_scenario
from iwm_sim.scenario import DEFAULT_VEHICLE, FOLDER, load_scenario


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = CommandParser(
        "roads", description="Drive scenarios of real roads with the power manager and check what they require."
    )
    result.add_argument("scenario", nargs="*", help="files, or names of config/scenarios (default: all of them)")
    result.add_argument("--strategy", choices=list(drivable()), default=DEFAULT_STRATEGY, help="(default: %(default)s)")
    result.add_argument("--unknown", action="store_true", help="what not knowing the friction costs, too (1 min)")
    result.add_argument("--policy", default="policies", metavar="DIR", help="with --unknown (default: %(default)s)")
    result.add_argument("--page", type=Path, metavar="MD", help="write the table as a page")
    result.add_argument("--json", type=Path, metavar="FILE", help="write the values as JSON")
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Drive and report; returns the exit code."""
    options = parser().parse_args(argv)
    return ended("roads", lambda: _drive(options))


def _drive(options: argparse.Namespace) -> int:
    refuse_without_effect(options, {"--policy": (options.unknown, "it is for --unknown")})
    names = options.scenario or sorted(str(path) for path in share_path(FOLDER).glob("*.yaml"))
    scenarios = [load_scenario(name) for name in names]
    settings = default_settings(options.strategy)
    results: list[RoadResult] = []
    for scenario in scenarios:
        results.append(check_scenario(scenario, settings))
        print(text(results[-1]), flush=True)
    passed = sum(result.passed for result in results)
    print(f"{passed} of {len(results)} scenarios meet all they require")
    whole = passed == len(results)
    written = page(results, options.strategy)
    if options.unknown:
        jobs = os.cpu_count() or 1
        cells, jumps = savings(all_cells(), jobs, DEFAULT_VEHICLE, options.policy), all_jumped(jobs)
        whole = whole and not any(map(differs, cells)) and all(jump.no_worse for jump in jumps)
        written += unknown(cells, jumps)
        print(unknown(cells, jumps), flush=True)
    if options.page:
        atomic_write(options.page, written.encode())
    if options.json:
        write_json(options.json, {result.scenario.name: result.values for result in results})
    return DONE if whole else FAILED


if __name__ == "__main__":
    sys.exit(main())
