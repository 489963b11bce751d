# SPDX-License-Identifier: Apache-2.0
"""Parser of every command and node: what is wrong with a command line is said in one line."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from iwm_power_manager.exit_codes import BAD_INPUT


class CommandParser(argparse.ArgumentParser):
    """A parser whose description and examples stand as typed, and which does not repeat its usage at an error."""

    def __init__(self, prog: str, **settings: Any) -> None:
        settings.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(prog, **settings)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is."""
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")
