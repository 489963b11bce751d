# SPDX-License-Identifier: Apache-2.0
"""Errors a user can cause. The message is one line that says what, where, and what would be right."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from iwm_power_manager.exit_codes import BAD_INPUT, CANNOT_TELL, FAILED

#: No message gets longer: a hostile file must not fill a terminal or a log.
MAX_MESSAGE = 1000
_MAX_PROBLEM = 300
#: How much alike names have to be, 0..1, for one to be taken for a slip of the other.
_NEAR = 0.7
_WORD_ENDS = re.compile(r"[\W_]+")


def one_line(text: str, limit: int = MAX_MESSAGE) -> str:
    """A text as one printable line: control characters, line ends and direction marks escaped, cut where too long."""
    shown = text[: limit + 1]
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in shown)
    return shown if len(shown) <= limit else f"{shown[: limit - 3]}..."


def spelled_like(given: str, known: Iterable[str]) -> list[str]:
    """Up to three of the known names that `given` may be a slip of, capitals or not, or a whole word of.

    The likest stand first, then those of the fewest letters.
    """
    names = {name.lower(): name for name in known}
    near = difflib.get_close_matches(given.lower(), list(names), 3, _NEAR)
    with_it = [name for name in sorted(names, key=len) if given.lower() in _WORD_ENDS.split(name)]
    return [names[name] for name in dict.fromkeys([*near, *with_it])][:3]


def did_you_mean(names: Iterable[str]) -> str:
    """Question that names these, as the end of a message; "" for none."""
    meant = " or ".join(names)
    return f"; did you mean {meant}?" if meant else ""


class IwmError(Exception):
    """Base of every error that is reported to the user as one line, without a traceback.

    Attributes
    ----------
    exit_code : of a command that it ends: what was given is refused, unless a kind of error says otherwise
    """

    exit_code = BAD_INPUT

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class FailedError(IwmError):
    """What was given is right, and yet it could not be done."""

    exit_code = FAILED


class ConfigError(IwmError):
    """A value in a user's file is wrong.

    Parameters
    ----------
    file : path of the file
    key : dotted path of the key, or a column or line ("" for the whole file)
    problem : what is wrong, with the value
    allowed : what would be right ("" if `problem` says it)
    """

    def __init__(self, file: Path | str, key: str, problem: str, allowed: str = "") -> None:
        self.file = str(file)
        self.key = key
        self.problem = problem
        self.allowed = allowed
        where = f"{file}: {key}" if key else f"{file}"
        shown = one_line(problem, _MAX_PROBLEM)
        super().__init__(f"{where}: {shown}" + (f"; allowed: {allowed}" if allowed else ""))

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, str, str, str]]:
        """Come out of a worker process as it was raised there."""
        return type(self), (self.file, self.key, self.problem, self.allowed)


class PolicyError(IwmError):
    """A policy file is missing, damaged, foreign, or was solved for another car."""


class BagError(IwmError):
    """A bag cannot be read or written."""


class NoAnswerError(BagError):
    """A bag can be read, and does not have what the answer would need."""

    exit_code = CANNOT_TELL


@contextmanager
def of_parameter(name: str) -> Iterator[None]:
    """What is wrong with a file, with the node's parameter that names it."""
    try:
        yield
    except IwmError as error:
        wrong = IwmError(f"parameter {name}: {str(error).removeprefix(f'{name}: ')}")
        wrong.exit_code = error.exit_code
        raise wrong from None


@contextmanager
def system_errors(path: Path | str, what: str, kind: type[BagError] = BagError) -> Iterator[None]:
    """What the system refuses meanwhile as the one line "path: what: reason"."""
    try:
        yield
    except OSError as error:
        raise kind(f"{path}: {what}: {error.strerror or error}") from None
