# SPDX-License-Identifier: Apache-2.0
"""Tables as other programs write them: any separator, decimal commas, comments. What was guessed is said."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import NamedTuple

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import MAX_LINE_LENGTH, read_text, to_number

#: What `--separator` takes.
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " ", "bar": "|"}
MAX_ROWS = 2_000_000
MAX_COLUMNS = 1000
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+([eE][-+]?[0-9]+)?")
#: What Excel writes and reads before the header.
_STATED = re.compile(r"\ufeff?sep=([;,|\t])\s*")
_THOUSANDS = re.compile(r"[-+]?[0-9]{1,3}(\.[0-9]{3})+(,[0-9]+)?")


#: What people and programs write where there is no value.
_NOTHING = ("", "nan", "-", "--", "n/a", "na", "null", "none", "n.a.", "k.a.")


def is_nothing(cell: str) -> bool:
    """Whether a cell says that there is no value; those that begin with # are a spreadsheet's errors."""
    return cell.lower() in _NOTHING or cell.startswith("#")


class Table(NamedTuple):
    """Cells of a table, stripped, with the line each row stands in; `decimal` is "." or ","."""

    path: str
    rows: list[tuple[int, list[str]]]
    separator: str
    decimal: str

    def number(self, line: int, text: str, column: str) -> float:
        """A cell as a number; `ConfigError` names line and column."""
        if self.decimal == "," and _THOUSANDS.fullmatch(text):
            problem = f"{text!r} has a point, in a table of decimal commas: a mark of thousands?"
            raise ConfigError(self.path, f"line {line}, {column}", problem, "numbers without it, or --decimal point")
        plain = text.replace(",", ".") if self.decimal == "," and _DECIMAL_COMMA.fullmatch(text.strip()) else text
        try:
            return to_number(plain)
        except ValueError as error:
            raise ConfigError(self.path, f"line {line}, {column}", str(error)) from None


def read_table(path: Path | str, separator: str = "auto", decimal: str = "auto") -> Table:
    """Read a delimited text.

    Parameters
    ----------
    separator : a name of `SEPARATORS`, or auto: what a line `sep=;` before the header says, else what splits most
        lines into equally many columns
    decimal : point, comma, or auto: comma if a cell looks like one and commas separate nothing

    Raises
    ------
    ConfigError
        Unreadable, empty, too large, or rows of different lengths.
    """
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path).splitlines(), 1)
        if line.strip(" \t;,|") and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise ConfigError(path, "", "is empty")
    stated = _STATED.fullmatch(lines[0][1]) if len(lines) > 1 else None
    if stated:
        del lines[0]
    if len(lines) > MAX_ROWS:
        raise ConfigError(path, "", f"has {len(lines)} rows", f"<= {MAX_ROWS}")
    if separator != "auto":
        mark = SEPARATORS[separator]
    else:
        mark = stated[1] if stated else _separator([line for _, line in lines[:50]], decimal)
    rows = []
    for number, line in lines:
        if len(line) > MAX_LINE_LENGTH:
            raise ConfigError(path, f"line {number}", f"has {len(line)} characters", f"<= {MAX_LINE_LENGTH}")
        try:
            cells = next(csv.reader([" ".join(line.split()) if mark == " " else line], delimiter=mark, strict=True))
        except csv.Error as error:
            raise ConfigError(path, f"line {number}", f"is no table: {error}") from None
        if len(cells) > MAX_COLUMNS:
            raise ConfigError(path, f"line {number}", f"has {len(cells)} columns", f"<= {MAX_COLUMNS}")
        rows.append((number, [cell.strip() for cell in cells]))
    comma = decimal == "comma" or (
        decimal == "auto"
        and mark != ","
        and any(_DECIMAL_COMMA.fullmatch(cell) for _, cells in rows[:1000] for cell in cells)
    )
    return Table(str(path), rows, mark, "," if comma else ".")


def _separator(lines: list[str], decimal: str) -> str:
    best, score = ",", 0
    for mark in (";", "\t", "|", ",", " "):
        if mark == "," and decimal == "comma":
            continue
        counts = [len(line.split()) - 1 if mark == " " else line.count(mark) for line in lines]
        common = max(set(counts), key=counts.count)
        agree = counts.count(common) if common else 0
        if agree > score:
            best, score = mark, agree
    return best
