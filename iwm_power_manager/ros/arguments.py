# SPDX-License-Identifier: Apache-2.0
"""Command line of a node, as far as a mistake in it would not be reported in one clear line by ROS itself."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Sequence

from iwm_power_manager.files import read_yaml
from iwm_power_manager.ros.specs import ParameterError, Spec

EXIT_CODES = "exit codes: 0 ended as asked, 1 could not start or failed, 2 bad arguments"

_PARAMS_FILE = "--params-file"


def check_parameter_files(arguments: Sequence[str]) -> None:
    """Refuse a parameter file that cannot be read, before ROS does so in terms of its source code.

    Parameters
    ----------
    arguments : command line, with or without the program's name

    Raises
    ------
    ConfigError
        A file after `--params-file` is missing, unreadable or no YAML mapping.
    """
    for option, path in itertools.pairwise(arguments):
        if option == _PARAMS_FILE:
            read_yaml(path)


def parameters_help(specs: Iterable[Spec]) -> str:
    """Every parameter of a node with its default and what is allowed, as the end of its help."""
    lines = [f"  {spec.name} = {_shown(spec.default)}   [{spec.allowed()}]\n      {spec.description}" for spec in specs]
    return "parameters, their defaults and what is allowed:\n" + "\n".join(lines)


def check_arguments(
    node: str, description: str, specs: Iterable[Spec], args: Sequence[str] | None, *, examples: str
) -> None:
    """Show help if it is asked for; refuse what is neither ROS's nor help. Both end the program.

    Parameters
    ----------
    node : name of the executable
    description : what it does, in one sentence
    specs : its parameters
    args : the whole command line with the program's name first; None takes the process's own
    examples : how it is called, indented lines

    Raises
    ------
    ParameterError
        What stands after `--ros-args` is wrong.
    """
    given = sys.argv if args is None else list(args)
    parser = argparse.ArgumentParser(
        prog=node,
        usage=f"{node} [-h] [--ros-args --params-file FILE -p PARAMETER:=VALUE -r FROM:=TO ...]",
        description=description,
        epilog=f"{parameters_help(specs)}\n\nexamples:\n{examples}\n{EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if "--ros-args" not in given and set(given).intersection(("-h", "--help")):
        parser.parse_args(given[1:])
    from rclpy.utilities import remove_ros_args  # which takes its time to be imported

    try:
        own = remove_ros_args(given)[1:]
    except RuntimeError as error:
        # rcl adds where in its sources that was noticed.
        raise ParameterError(" ".join(str(error).split(", at ")[0].split())) from None
    parser.parse_args(own)


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return '""' if value == "" else str(value)
