# SPDX-License-Identifier: Apache-2.0
"""Rows as tables: on the terminal and in Markdown. The page has its own (`report.Table`); the columns are the same."""

from __future__ import annotations

import itertools
import shutil
import textwrap
from collections.abc import Sequence
from typing import Any

from iwm_power_manager.tools.command import made_with
from iwm_sim.study.names import REFERENCE
from iwm_sim.study.report import Column, format_value
from iwm_sim.study.rows import Place, Row, policy_text


def screen() -> int:
    """Columns of the terminal; 100 where the output goes elsewhere."""
    return shutil.get_terminal_size((100, 24)).columns


def _strategy(row: Row) -> str:
    """Its name; how it was driven stands above the table."""
    return row.label.partition(", ")[0]


def _trace(row: Row) -> str:
    return "held" if row.metrics.trace_held else f"lost {row.metrics.trace_excess_mps:.2f}"


def _saving(row: Row) -> float | str | None:
    return "distance" if row.same_distance_as_equal is False else row.saving_percent


def _possible(row: Row) -> float | None:
    """Part of the possible saving, %; nothing where the strategy saves nothing."""
    return 100.0 * row.share_of_possible if row.share_of_possible and row.share_of_possible > 0.0 else None


def _period(row: Row) -> Any:
    """Decision period, s; equal split decides nothing."""
    return None if row.strategy == REFERENCE else row.made_with["settings"]["decision_period_s"]


#: Columns of the results of `evaluate`.
COLUMNS: tuple[Column[Row], ...] = (
    Column("strategy", _strategy),
    Column("used", lambda row: row.metrics.wh_per_km, "Wh/km", 2, group="energy"),
    Column("ΔSoC", lambda row: row.metrics.delta_soc_percent, "%", 3, group="energy"),
    Column("saving", _saving, "%", 2, group="energy"),
    Column("of possible", _possible, "%", 0, group="energy"),
    Column("changes", lambda row: row.metrics.share_changes_per_min, "1/min", 1, group="split"),
    Column("rms", lambda row: row.metrics.rms_speed_error_mps, "m/s", 3, group="speed error"),
    Column("max", lambda row: row.metrics.max_speed_error_mps, "m/s", 2, group="speed error"),
    Column("min", lambda row: row.metrics.min_slip, decimals=3, group="slip"),
    Column("max", lambda row: row.metrics.max_slip, decimals=3, group="slip"),
)
#: Columns only where the rows of a place differ; what is the same in all of them stands once above them.
_LOCKED = Column[Row]("locked", lambda row: row.metrics.locked_s, "s", 2)
_TRACE = Column[Row]("trace", _trace)
_DECIDES = Column[Row]("decides every", _period, "s")
_POLICY = Column[Row]("policy", policy_text)
#: A blank at which no line ends.
_TOGETHER = "\u00a0"


def text_table(rows: Sequence[Row], width: int) -> str:
    """A plain-text table for each place, under what its rows have in common; wider than `width`, it goes on below."""
    parts = []
    for place, found in itertools.groupby(rows, lambda row: row.place):
        own = list(found)
        apart = [column for column in (_LOCKED, _TRACE, _DECIDES, _POLICY) if len(_said(column, own)) > 1]
        parts += [*_heading(place, own, width), plain_table(own, (*COLUMNS, *apart), width), ""]
    return "\n".join(parts[:-1])


def _said(column: Column[Row], rows: Sequence[Row]) -> list[str]:
    """What a column shows, each once."""
    return [text for text in dict.fromkeys(map(column.shown, rows)) if text not in ("", format_value(None, None))]


def _heading(place: Place, rows: Sequence[Row], width: int) -> list[str]:
    """What all rows of a place have in common, and what is said of a single one beside its name."""
    same = {column: said[0] for column in (_LOCKED, _TRACE, _DECIDES, _POLICY) if len(said := _said(column, rows)) == 1}
    law = float(same.get(_DECIDES, 0.0)), [same.get(_POLICY, "").replace(" ", _TOGETHER)]
    how = made_with(f"{place.friction:g}", place.idle_drive, 1.0 / rows[0].made_with["dt_s"], *law)
    lines = [f"{place.cycle}, {how}".replace("policy ", f"policy{_TOGETHER}")]
    lines += [row.label.replace(", ", ": ", 1) for row in rows if ", " in row.label]
    shared = [f"{column.label} {same[column]} {column.unit}".rstrip() for column in (_LOCKED, _TRACE) if column in same]
    lines += [f"every row: {', '.join(shared)}"] if shared else []
    return [part.replace(_TOGETHER, " ") for line in lines for part in textwrap.wrap(line, width)]


def plain_table[R](rows: Sequence[R], columns: Sequence[Column[R]], width: int = 0) -> str:
    """A plain-text table under up to three lines of heading: group (once over its columns), label, unit.

    One that is wider than `width` (0: any is not) goes on below, group by group, each part with the columns before the
    first group.
    """
    text = _plain_table(rows, columns)
    if not width or max(map(len, text.splitlines())) <= width:
        return text
    parts = [list(found) for _, found in itertools.groupby(columns, lambda column: column.group)]
    keys, *groups = parts if not parts[0][0].group else [[], *parts]
    made, shown = [], list[Column[R]]()
    for group in groups:
        wider = _plain_table(rows, [*keys, *shown, *group])
        if shown and max(map(len, wider.splitlines())) > width:
            made.append(_plain_table(rows, [*keys, *shown]))
            shown = []
        shown += group
    return "\n\n".join([*made, _plain_table(rows, [*keys, *shown])])


def _plain_table[R](rows: Sequence[R], columns: Sequence[Column[R]]) -> str:
    heads = [[column.label for column in columns], [column.unit for column in columns]]
    lines = [line for line in heads if any(line)] + [[column.shown(row) for column in columns] for row in rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    groups = []
    for name, members in itertools.groupby(range(len(columns)), lambda i: columns[i].group):
        own = list(members)
        widths[own[-1]] += max(len(name) - sum(widths[i] + 2 for i in own) + 2, 0)
        groups.append(name.center(sum(widths[i] + 2 for i in own) - 2))
    over = ["  ".join(groups).rstrip()] if any(column.group for column in columns) else []
    return "\n".join(over + [_aligned(line, widths, columns) for line in lines])


def _aligned[R](cells: Sequence[str], widths: Sequence[int], columns: Sequence[Column[R]]) -> str:
    return "  ".join(
        cell.ljust(width) if column.decimals is None else cell.rjust(width)
        for cell, width, column in zip(cells, widths, columns, strict=True)
    ).rstrip()


def markdown_table[R](rows: Sequence[R], columns: Sequence[Column[R]]) -> str:
    """A Markdown table."""
    head = [f"{column.name}{f', {column.unit}' if column.unit else ''}" for column in columns]
    lines = ["| " + " | ".join(head) + " |"]
    lines.append("|" + "|".join(" --- " if column.decimals is None else " ---: " for column in columns) + "|")
    lines += ["| " + " | ".join(column.shown(row).replace("|", "\\|") for column in columns) + " |" for row in rows]
    return "\n".join(lines)
