# SPDX-License-Identifier: Apache-2.0
"""Rows as tables: on the terminal and in Markdown. The page has its own (`report.Table`); the columns are the same."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from iwm_power_manager.tools.command import made_with
from iwm_sim.study.report import Column
from iwm_sim.study.rows import Row, policy_text


def _trace(row: Row) -> str:
    return "held" if row.metrics.trace_held else f"lost by {row.metrics.trace_excess_mps:.2f}"


def _saving(row: Row) -> float | str | None:
    return "distance" if row.same_distance_as_equal is False else row.saving_percent


def _possible(row: Row) -> float | None:
    """Part of the possible saving, %; nothing where the strategy saves nothing."""
    return 100.0 * row.share_of_possible if row.share_of_possible and row.share_of_possible > 0.0 else None


def _period(row: Row) -> Any:
    return row.made_with["settings"]["decision_period_s"]


#: Columns of the results of `evaluate`.
COLUMNS: tuple[Column[Row], ...] = (
    Column("strategy", lambda row: row.label),
    Column("Wh/km", lambda row: row.metrics.wh_per_km, decimals=2),
    Column("ΔSoC %", lambda row: row.metrics.delta_soc_percent, decimals=3),
    Column("saving %", _saving, decimals=2),
    Column("% of possible", _possible, decimals=0),
    Column("changes/min", lambda row: row.metrics.share_changes_per_min, decimals=1),
    Column("rms error m/s", lambda row: row.metrics.rms_speed_error_mps, decimals=3),
    Column("max error m/s", lambda row: row.metrics.max_speed_error_mps, decimals=2),
    Column("min slip", lambda row: row.metrics.min_slip, decimals=3),
    Column("max slip", lambda row: row.metrics.max_slip, decimals=3),
    Column("locked s", lambda row: row.metrics.locked_s, decimals=2),
    Column("trace", _trace),
    Column("decides every s", _period, decimals=2),
    Column("policy", policy_text),
)


def text_table(rows: Sequence[Row], columns: Sequence[Column[Row]] = COLUMNS) -> str:
    """A plain-text table, with a heading where idle drive, cycle or friction change."""
    cells = [[column.shown(row) for column in columns] for row in rows]
    head = [column.label for column in columns]
    widths = [max(len(line[i]) for line in [head, *cells]) for i in range(len(columns))]
    lines = []
    before = None
    for row, line in zip(rows, cells, strict=True):
        if row.place != before:
            before = row.place
            how = made_with(f"{before.friction:g}", before.idle_drive, 1.0 / row.made_with["dt_s"])
            lines += ["", f"{before.cycle}, {how}", _aligned(head, widths, columns)]
        lines.append(_aligned(line, widths, columns))
    return "\n".join(lines[1:])


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
