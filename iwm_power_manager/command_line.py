# SPDX-License-Identifier: Apache-2.0
"""Parser of every command and node: what is wrong with a command line is said in one line."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

from iwm_power_manager.errors import ConfigError, did_you_mean, spelled_like
from iwm_power_manager.exit_codes import BAD_INPUT

#: What argparse says of a value that is none of the choices.
_CHOICE = re.compile(r"invalid choice: '(?P<given>[^']*)' \(choose from (?P<known>.*)\)$")


class Written(str):
    """Name of a file that a command writes, - for standard output: none that it reads, and no other one's."""


class CommandParser(argparse.ArgumentParser):
    """A parser whose description and examples stand as typed, and which does not repeat its usage at an error.

    Options are written in full, so that `given` of what it has parsed holds the names of those that were given;
    `--no-x`, the other side of `--x`, is `--x` there.

    Attributes
    ----------
    meanings : what choices are, in half a sentence, for those who chose something else
    """

    meanings: Mapping[str, str] = MappingProxyType({})

    def __init__(self, prog: str, **settings: Any) -> None:
        settings.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(prog, allow_abbrev=False, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse what is known; where anything else is left, say what may have been meant."""
        words = sys.argv[1:] if args is None else list(args)
        found, unknown = super().parse_known_args(words, namespace)
        options = re.findall(r"--[a-z][\w-]*", self.format_usage())
        if unknown:
            near = [name for word in unknown for name in spelled_like(word.partition("=")[0], options)[:1]]
            self.error(f"unrecognized arguments: {' '.join(unknown)}{did_you_mean(near)}")
        names = (word.partition("=")[0] for word in words if word.startswith("--"))
        self._check_written(vars(found))
        found.given = {positive if (positive := f"--{name[5:]}") in options else name for name in names}
        return found, unknown

    def _check_written(self, values: Mapping[str, Any]) -> None:
        shown = {action.dest: (action.option_strings or [action.dest])[0] for action in self._actions}
        named = [
            (shown.get(name, name), value, os.path.realpath(value))
            for name, given in values.items()
            for value in (given if isinstance(given, list) else [given])
            if isinstance(value, Written) or (isinstance(value, str | Path) and os.path.exists(value))
        ]
        for name, value, path in named:
            other = next((other for other, again, there in named if there == path and again is not value), "")
            if isinstance(value, Written) and value not in ("", "-") and other:
                self.error(f"argument {name}: {value} would be written over what {other} names")

    def check(self, options: argparse.Namespace, useful: Mapping[str, tuple[object, str]]) -> None:
        """`refuse_without_effect`, as a mistake in the command line."""
        try:
            refuse_without_effect(options, useful)
        except ConfigError as error:
            self.error(str(error))

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is."""
        if choice := _CHOICE.search(message):
            given, known = choice["given"], re.findall("'([^']*)'", choice["known"])
            near = spelled_like(given, known)
            near = near or [name for name in known if given in re.split(r"\W+", self.meanings.get(name, ""))]
            message += did_you_mean(
                f"{name} ({self.meanings[name]})" if name in self.meanings else name for name in near
            )
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def refuse_without_effect(options: argparse.Namespace, useful: Mapping[str, tuple[object, str]]) -> None:
    """Refuse an option that was given and would change nothing; `ConfigError`.

    Parameters
    ----------
    options : as a `CommandParser` gave them
    useful : whether an option changes anything beside the others, and if not, why
    """
    for option, (has_effect, reason) in useful.items():
        if option in options.given and not has_effect:
            raise ConfigError("arguments", option, f"has no effect: {reason}")
