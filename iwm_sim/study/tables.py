"""Rows as tables: on the terminal and in Markdown. The page has its own (`report.Table`); the columns are the same."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from iwm_sim.study.report import Column, format_value

Row = Mapping[str, Any]

#: Columns of the results of `evaluate`.
COLUMNS = (
    Column("label", "strategy"),
    Column("wh_per_km", "Wh/km", "", 2),
    Column("delta_soc_percent", "ΔSoC %", "", 3),
    Column("saving_percent", "saving %", "", 2),
    Column("share_of_possible", "of possible", "", 2),
    Column("share_changes_per_min", "changes/min", "", 1),
    Column("rms_speed_error_mps", "rms error m/s", "", 3),
    Column("max_speed_error_mps", "max error m/s", "", 2),
    Column("min_slip", "min slip", "", 3),
    Column("max_slip", "max slip", "", 3),
    Column("locked_s", "locked s", "", 2),
    Column("trace", "trace"),
)

_GROUP = ("idle_drive", "cycle", "friction")


def text_table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """A plain-text table, with a heading where idle drive, cycle or friction change."""
    head = [column.label for column in columns]
    cells = [[_cell(row, column) for column in columns] for row in rows]
    widths = [max(len(line[i]) for line in [head, *cells]) for i in range(len(columns))]
    lines = []
    before = None
    for row, line in zip(rows, cells, strict=True):
        group = tuple(row[key] for key in _GROUP)
        if group != before:
            before = group
            title = f"{row['cycle']}, friction {row['friction']:g}, idle drive {row['idle_drive']}"
            lines += ["", title, _aligned(head, widths, columns)]
        lines.append(_aligned(line, widths, columns))
    return "\n".join(lines[1:])


def _cell(row: Row, column: Column) -> str:
    if column.key == "trace":
        return "held" if row["trace_held"] else f"lost by {row['trace_excess_mps']:.2f}"
    if column.key == "saving_percent" and row.get("same_distance_as_equal") is False:
        return "distance"
    return format_value(row.get(column.key), column.decimals)


def _aligned(cells: Sequence[str], widths: Sequence[int], columns: Sequence[Column]) -> str:
    return "  ".join(
        cell.ljust(width) if column.decimals is None else cell.rjust(width)
        for cell, width, column in zip(cells, widths, columns, strict=True)
    ).rstrip()


def markdown_table(rows: Sequence[Row], columns: Sequence[Column], mark: Callable[[Row], str] = lambda _: "") -> str:
    """A Markdown table; `mark` puts a sign behind a row's first cell."""
    head = [f"{column.label}{f', {column.unit}' if column.unit else ''}" for column in columns]
    lines = ["| " + " | ".join(head) + " |"]
    lines.append("|" + "|".join(" --- " if column.decimals is None else " ---: " for column in columns) + "|")
    for row in rows:
        cells = [format_value(row.get(column.key), column.decimals).replace("|", "\\|") for column in columns]
        cells[0] += mark(row)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
