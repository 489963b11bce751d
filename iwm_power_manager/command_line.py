# SPDX-License-Identifier: Apache-2.0
"""Parser of every command and node: what is wrong with a command line is said in one line."""

from __future__ import annotations

import argparse
import re
from typing import Any, NoReturn

from iwm_power_manager.errors import did_you_mean, spelled_like
from iwm_power_manager.exit_codes import BAD_INPUT

#: What argparse says of a value that is none of the choices.
_CHOICE = re.compile(r"invalid choice: '(?P<given>[^']*)' \(choose from (?P<known>.*)\)$")


class CommandParser(argparse.ArgumentParser):
    """A parser whose description and examples stand as typed, and which does not repeat its usage at an error."""

    def __init__(self, prog: str, **settings: Any) -> None:
        settings.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(prog, **settings)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is."""
        if choice := _CHOICE.search(message):
            message += did_you_mean(spelled_like(choice["given"], re.findall("'([^']*)'", choice["known"])))
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")
