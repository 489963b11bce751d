"""Errors a user can cause. The message is one line that says what, where, and what would be right."""

from __future__ import annotations

from pathlib import Path


class IwmError(Exception):
    """Base of every error that is reported to the user as one line, without a traceback."""


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
        super().__init__(f"{where}: {problem}" + (f"; allowed: {allowed}" if allowed else ""))


class PolicyError(IwmError):
    """A policy file is missing, damaged, foreign, or was solved for another car."""


class BagError(IwmError):
    """A bag cannot be read or written."""
