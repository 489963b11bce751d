"""Command line of a node, as far as a mistake in it would not be reported in one clear line by ROS itself."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from iwm_power_manager.files import read_yaml

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
