# SPDX-License-Identifier: Apache-2.0
"""Command line of a node, as far as a mistake in it would not be reported in one clear line by ROS itself."""

from __future__ import annotations

import itertools
import re
import shlex
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import read_yaml
from iwm_power_manager.ros.specs import ParameterError, Spec

EXIT_CODES = "exit codes: 0 ended as asked, 1 failed, 2 bad arguments, parameters or files"

_PARAMS_FILE = "--params-file"
#: What stands after ROS's options that set something.
_SETTING = dict.fromkeys(("-p", "--param"), "PARAMETER:=VALUE") | dict.fromkeys(("-r", "--remap"), "FROM:=TO")


def check_parameter_files(arguments: Sequence[str], node: str = "") -> None:
    """Refuse a parameter file that ROS would refuse in terms of its source code, or pass over without a word.

    Parameters
    ----------
    arguments : command line, with or without the program's name
    node : full name of the node, once that is known

    Raises
    ------
    ConfigError
        A file after `--params-file` is missing, unreadable or no YAML mapping, or all of it is for other nodes.
    """
    for option, path in itertools.pairwise(arguments):
        if option == _PARAMS_FILE:
            names = list(_node_names(read_yaml(path)))
            if node and names and not any(_fits(name, node) for name in names):
                raise ConfigError(path, names[0], f"is not this node, which is {node}", f"/**, or {node}")


def _node_names(content: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Names, with wildcards, of the nodes that a parameter file is for."""
    for key, inner in content.items():
        if key == "ros__parameters":
            yield above
        elif isinstance(inner, Mapping):
            yield from _node_names(inner, f"{above}/{str(key).strip('/')}")


def _fits(pattern: str, node: str) -> bool:
    """As rcl has it: `*` is one part of a name, `**` any number of them, none included."""
    parts = {"**": r"(/\w+)*", "*": r"/\w+"}
    expression = "".join(parts.get(part, "/" + re.escape(part)) for part in pattern.split("/")[1:])
    return re.fullmatch(expression, node) is not None


def parameters_help(specs: Iterable[Spec]) -> str:
    """Every parameter of a node with its default and what is allowed, as the end of its help."""
    lines = [f"  {spec.name} = {_shown(spec.default)}   [{spec.allowed()}]\n      {spec.description}" for spec in specs]
    return "parameters, their defaults and what is allowed:\n" + "\n".join(lines)


def check_arguments(
    node: str, description: str, specs: Sequence[Spec], args: Sequence[str] | None, *, examples: str
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
    parser = CommandParser(
        node,
        usage=f"{node} [-h] [--ros-args --params-file FILE -p PARAMETER:=VALUE -r FROM:=TO ...]",
        description=description,
        epilog=f"{parameters_help(specs)}\n\nexamples:\n{examples}\n{EXIT_CODES}",
    )
    if "--ros-args" not in given and set(given).intersection(("-h", "--help")):
        parser.parse_args(given[1:])
    _check_settings(given)
    if meant := _without_mark(given, {spec.name for spec in specs}):
        parser.error(f"what is for ROS has to stand behind --ros-args: {shlex.join([node, *meant])}")
    from rclpy.utilities import remove_ros_args  # which takes its time to be imported

    try:
        own = remove_ros_args(given)[1:]
    except RuntimeError as error:
        # rcl adds where in its sources that was noticed.
        raise ParameterError(" ".join(str(error).split(", at ")[0].split())) from None
    parser.parse_args(own)


def _without_mark(given: Sequence[str], parameters: Collection[str]) -> list[str]:
    """How options of ROS are written that stand before `--ros-args`, with all that stands there; [] if none do.

    rcl takes what has a `:=` there for a remapping, as ROS 1 had them: a parameter would have no effect.
    """
    end = given.index("--ros-args") if "--ros-args" in given else len(given)
    words, before = given[1:end], ["", *given[1:end]]
    meant: list[str] = []
    for word, option in zip(words, before, strict=False):
        if ":=" in word and option not in _SETTING:
            meant.append("-p" if word.partition(":=")[0] in parameters else "-r")
        meant.append(word)
    found = any(":=" in word or word in (_PARAMS_FILE, *_SETTING) for word in words)
    return ["--ros-args", *meant, *given[end + 1 :]] if found else []


def _check_settings(given: Sequence[str]) -> None:
    """What rcl refuses in terms of its parser: settings without `:=`, and texts whose quotes the shell has taken."""
    of_ros = given[given.index("--ros-args") :] if "--ros-args" in given else []
    for option, text in itertools.pairwise(of_ros):
        name, sign, value = text.partition(":=")
        if option in _SETTING and not (name and value):
            quotes = f"; an empty text is \"{name}:=''\": the shell takes quotes away" if name and sign else ""
            raise ParameterError(f"{option} {text!r} is not allowed; allowed: {_SETTING[option]}{quotes}")


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return '""' if value == "" else str(value)
