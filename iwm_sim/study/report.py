"""One self-contained HTML page: tables, charts over time, figures and settings of a run.

A page is a list of blocks, each a small frozen dataclass that knows its own HTML. The page makes no request of any
kind: style, script and data stand in the file, and its content security policy forbids the browser to fetch anything.
Charts over time are drawn in the browser from data thinned here (`thin`), so that a finger or a mouse can read values
and zoom; figures are matplotlib SVG whose colours follow the page from light to dark.
"""

from __future__ import annotations

import html
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from iwm_power_manager import __version__
from iwm_power_manager.files import atomic_write
from iwm_sim.study.palette import COLOURS, INK

#: Points a chart keeps of each series: two (smallest and largest) for each of half as many equal stretches of samples.
CHART_POINTS = 6000


class Block(Protocol):
    """A part of a page."""

    def to_html(self, number: int) -> str:
        """HTML of the block; `number` is unique on its page."""


@dataclass(frozen=True)
class Text:
    """A paragraph under an optional heading."""

    text: str
    title: str = ""

    def to_html(self, number: int) -> str:
        """HTML of the block; `number` is unique on its page."""
        return f"{_heading(self.title)}<p>{_escape(self.text)}</p>"


@dataclass(frozen=True)
class Tile:
    """One key figure: `value` in `unit`, with a line of `detail` below it."""

    name: str
    value: str
    unit: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Tiles:
    """The key figures of a run, side by side."""

    tiles: Sequence[Tile]

    def to_html(self, number: int) -> str:
        """HTML of the block; `number` is unique on its page."""
        cells = "".join(
            f'<div class="tile"><div class="name">{_escape(tile.name)}</div>'
            f'<div class="value">{_escape(tile.value)} <span class="unit">{_escape(tile.unit)}</span></div>'
            f'<div class="detail">{_escape(tile.detail)}</div></div>'
            for tile in self.tiles
        )
        return f'<div class="tiles">{cells}</div>'


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    key : key of its values in the rows
    label, unit : heading
    decimals : digits after the point of its numbers; None shows the values as text
    best : "low" or "high" prints the best value of the valid rows bold; "" none
    """

    key: str
    label: str
    unit: str = ""
    decimals: int | None = None
    best: str = ""


@dataclass(frozen=True)
class Table:
    """Rows (mappings, as read from JSON) under columns. A row whose `valid_key` is false is marked and greyed."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]
    note: str = ""
    valid_key: str = "trace_held"

    def to_html(self, number: int) -> str:
        """HTML of the block; `number` is unique on its page."""
        best = {column.key: self._best(column) for column in self.columns}
        head = "".join(
            f"<th{_text_class(column)}>{_escape(column.label)}"
            + (f'<span class="unit">{_escape(column.unit)}</span>' if column.unit else "")
            + "</th>"
            for column in self.columns
        )
        body = "".join(self._row(row, best) for row in self.rows)
        return (
            f"{_heading(self.title)}<div class=scroll><table><thead><tr>{head}</tr></thead>"
            f"<tbody>{body}</tbody></table></div>{_note(self.note)}"
        )

    def _best(self, column: Column) -> float | None:
        values = [row[column.key] for row in self.rows if self._valid(row) and _is_number(row.get(column.key))]
        if not column.best or len(values) < 2 or min(values) == max(values):
            return None
        return float(min(values) if column.best == "low" else max(values))

    def _valid(self, row: Mapping[str, Any]) -> bool:
        return bool(row.get(self.valid_key, True))

    def _row(self, row: Mapping[str, Any], best: Mapping[str, float | None]) -> str:
        cells = []
        for index, column in enumerate(self.columns):
            value = row.get(column.key)
            if column.key == self.valid_key and isinstance(value, bool | np.bool_):
                shown = badge(bool(value), "held", "lost")
            else:
                shown = _escape(format_value(value, column.decimals))
            tag = "th" if index == 0 else "td"
            is_best = _is_number(value) and best[column.key] is not None and value == best[column.key]
            classes = " ".join(
                name for name, on in (("text", column.decimals is None), ("best", is_best and self._valid(row))) if on
            )
            cells.append(f'<{tag} class="{classes}">{shown}</{tag}>' if classes else f"<{tag}>{shown}</{tag}>")
        return f"<tr{'' if self._valid(row) else ' class=invalid'}>{''.join(cells)}</tr>"


@dataclass(frozen=True)
class Series:
    """A line of a chart: values over the chart's time (NaN: a gap), in palette colour 0..7.

    A `wide` line still shows under a thin one that runs over it.
    """

    name: str
    values: ArrayLike
    colour: int = 0
    dashed: bool = False
    step: bool = False
    wide: bool = False


@dataclass(frozen=True)
class Panel:
    """One axis of a chart.

    Attributes
    ----------
    label, unit : of the axis
    series : its lines
    decimals : digits after the point when a value is read
    limits : values the axis always shows
    ticks : names of values, for a signal that is a choice and not a number
    references : named levels drawn across
    """

    label: str
    unit: str
    series: Sequence[Series]
    decimals: int = 2
    limits: tuple[float, float] | None = None
    ticks: Sequence[tuple[float, str]] = ()
    references: Sequence[tuple[float, str]] = ()


@dataclass(frozen=True)
class Chart:
    """Panels over one time axis, s. Time must rise."""

    title: str
    time_s: ArrayLike
    panels: Sequence[Panel]
    note: str = ""

    def to_html(self, number: int) -> str:
        """HTML of the block; `number` is unique on its page."""
        time = np.asarray(self.time_s, dtype=np.float64)
        thin_time: NDArray[np.float64] | None = None
        panels = []
        for panel in self.panels:
            lines = []
            for series in panel.series:
                thin_time, values = thin(time, np.asarray(series.values, dtype=np.float64), CHART_POINTS)
                lines.append(
                    {
                        "name": series.name,
                        "colour": series.colour,
                        "dashed": series.dashed,
                        "step": series.step,
                        "wide": series.wide,
                        "values": _compact(values),
                    }
                )
            panels.append(
                {
                    "label": panel.label,
                    "unit": panel.unit,
                    "decimals": panel.decimals,
                    "range": panel.limits,
                    "ticks": list(panel.ticks) or None,
                    "references": list(panel.references),
                    "series": lines,
                }
            )
        if thin_time is None:
            raise ValueError(f"chart {self.title!r} has no series")
        data = json.dumps({"time": _compact(thin_time, 8), "panels": panels}, separators=(",", ":"), allow_nan=False)
        return (
            f'{_heading(self.title)}<div class="chart" id="chart-{number}">'
            f'<script type="application/json">{data.replace("<", "\\u003c")}</script></div>{_note(self.note)}'
        )


@dataclass(frozen=True)
class Picture:
    """A matplotlib figure with its caption."""

    title: str
    figure: Figure
    note: str = ""


@dataclass(frozen=True)
class Pictures:
    """Figures beside each other where there is room."""

    title: str
    pictures: Sequence[Picture]
    note: str = ""

    def to_html(self, number: int) -> str:
        """HTML of the block; `number` is unique on its page."""
        figures = "".join(
            f"<figure>{svg_of(picture.figure, f'f{number}-{index}', picture.title)}"
            f"<figcaption><b>{_escape(picture.title)}</b> {_escape(picture.note)}</figcaption></figure>"
            for index, picture in enumerate(self.pictures)
        )
        return f'{_heading(self.title)}{_note(self.note)}<div class="pictures">{figures}</div>'


@dataclass(frozen=True)
class Settings:
    """Names and values of what a run was made with."""

    title: str
    items: Mapping[str, Any]

    def to_html(self, number: int) -> str:
        """HTML of the block; `number` is unique on its page."""
        entries = "".join(
            f"<div><dt>{_escape(name)}</dt><dd>{_escape(format_value(value, None))}</dd></div>"
            for name, value in self.items.items()
        )
        return f'{_heading(self.title)}<dl class="settings">{entries}</dl>'


@dataclass(frozen=True)
class Page:
    """A whole page.

    Attributes
    ----------
    title, lead : what the page is, and the one sentence to take away
    blocks : its parts, in order
    valid : None, or whether the run it shows may be used, with `verdict` saying why
    """

    title: str
    lead: str
    blocks: Sequence[Block]
    valid: bool | None = None
    verdict: str = ""


def render(page: Page) -> str:
    """The page as one HTML document."""
    assets = files("iwm_sim.study") / "assets"
    style = (assets / "report.css").read_text("utf-8")
    script = (assets / "report.js").read_text("utf-8")
    verdict = "" if page.valid is None else f"<p>{badge(page.valid, 'valid', 'not valid')} {_escape(page.verdict)}</p>"
    body = "\n".join(block.to_html(number) for number, block in enumerate(page.blocks))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
        "script-src 'unsafe-inline'; img-src data:\">"
        f'<title>{_escape(page.title)}</title><link rel="icon" href="data:,">\n<style>\n{style}</style></head>\n'
        f'<body><header><h1>{_escape(page.title)}</h1><p class="lead">{_escape(page.lead)}</p>{verdict}</header>\n'
        f"<main>{body}</main>\n<noscript><p>The charts over time need JavaScript; tables and figures do not.</p>"
        f"</noscript>\n<footer>iwm_power_manager {_escape(__version__)}</footer>\n"
        f"<script>\n{script}</script></body></html>\n"
    )


def write_page(path: Path | str, page: Page) -> None:
    """Write the page atomically; `ConfigError` if the folder cannot be written."""
    atomic_write(path, render(page).encode())


def badge(good: bool, yes: str, no: str) -> str:
    """A marked word: never by colour alone."""
    kind, mark, word = ("good", "✓", yes) if good else ("bad", "✗", no)
    return f'<span class="badge {kind}">{mark} {_escape(word)}</span>'


def format_value(value: Any, decimals: int | None) -> str:
    """A value as the page shows it: "–" for what is missing, a true minus sign, yes / no for booleans."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not _is_number(value):
        return str(value)
    text = f"{value:.{decimals}f}" if decimals is not None else f"{value:g}" if isinstance(value, float) else str(value)
    if float(text) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def thin(
    time: NDArray[np.float64], values: NDArray[np.float64], points: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most about `points` points that keep every peak.

    The samples are cut into equal stretches; of each, the smallest and the largest value are kept in the order in
    which they came, so that no spike gets lost, however short. Time is that of the stretch's first and middle sample,
    the same for every series cut alike.

    Parameters
    ----------
    time, values : (N,) samples; NaN values are gaps
    points : largest number of points returned; N <= points returns the input

    Returns
    -------
    (M,) time and values, M <= points.
    """
    count = len(time)
    if len(values) != count:
        raise ValueError(f"{len(values)} values for {count} times")
    if count <= points:
        return time, values
    length = -(-count // (points // 2))
    stretches = -(-count // length)
    padded = np.full(stretches * length, np.nan)
    padded[:count] = values
    blocks = padded.reshape(stretches, length)
    empty = np.isnan(blocks).all(axis=1)
    low = np.where(np.isnan(blocks), np.inf, blocks).argmin(axis=1)
    high = np.where(np.isnan(blocks), -np.inf, blocks).argmax(axis=1)
    row = np.arange(stretches)
    kept = np.stack((blocks[row, np.minimum(low, high)], blocks[row, np.maximum(low, high)]), axis=1)
    kept[empty] = np.nan
    first = row * length
    middle = np.minimum(first + length // 2, count - 1)
    return time[np.stack((first, middle), axis=1)].ravel(), kept.ravel()


def svg_of(figure: Figure, prefix: str, title: str) -> str:
    """A figure as an inline SVG element.

    Text stays text (selectable, in the page's font), `palette.COLOURS` and the ink become the page's own colours, and
    every id gets `prefix`, so that the definitions of two figures on one page do not mix.
    """
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, count=1, flags=re.DOTALL)
    text = re.sub(r'\sid="([^"]+)"', rf' id="{prefix}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', text)
    text = re.sub(r"font:[^;\"]*'[^;\"]*", lambda match: _page_font(match.group(0)), text)
    for index, colour in enumerate(COLOURS):
        text = text.replace(colour, f"var(--c{index})")
    text = text.replace(INK, "var(--ink)")
    # Width and height in points would fix the size; the view box alone lets the page decide.
    text = re.sub(r'<svg([^>]*?)\swidth="[^"]*"', r"<svg\1", text, count=1)
    text = re.sub(r'<svg([^>]*?)\sheight="[^"]*"', r"<svg\1", text, count=1)
    return text.replace("<svg", f'<svg role="img" aria-label="{_escape(title)}"', 1)


def _page_font(font: str) -> str:
    size = re.search(r"([\d.]+)px", font)
    return f"font: {size.group(1) if size else '10'}px system-ui, sans-serif"


def _compact(values: NDArray[np.float64], digits: int = 7) -> list[float | int | None]:
    """Numbers of `digits` significant digits, whole ones as integers, NaN as null."""
    numbers: list[float | int | None] = []
    for value in values.tolist():
        if not math.isfinite(value):
            numbers.append(None)
            continue
        short = float(f"{value:.{digits}g}")
        numbers.append(int(short) if short.is_integer() and abs(short) < 1e15 else short)
    return numbers


def _heading(title: str) -> str:
    return f"<h2>{_escape(title)}</h2>" if title else ""


def _note(text: str) -> str:
    return f'<p class="note">{_escape(text)}</p>' if text else ""


def _text_class(column: Column) -> str:
    return ' class="text"' if column.decimals is None else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool | np.bool_)


def _escape(text: str) -> str:
    return html.escape(text, quote=True)
